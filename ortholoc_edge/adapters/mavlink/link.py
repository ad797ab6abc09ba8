"""The thread that owns the link to the autopilot."""

from __future__ import annotations

import contextlib
import logging
import os
import select
import socket
import threading
import traceback
from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from types import TracebackType
from typing import Any

from ortholoc_edge.adapters.computer import ComputerStatus
from ortholoc_edge.adapters.mavlink.bandwidth import plan_line
from ortholoc_edge.adapters.mavlink.census import LinkHealth
from ortholoc_edge.adapters.mavlink.codec import FrameParser, MavlinkMessage, dialect
from ortholoc_edge.adapters.mavlink.estimates import VisionEstimate
from ortholoc_edge.adapters.mavlink.geodesy import GeodeticOrigin
from ortholoc_edge.adapters.mavlink.gimbal import GimbalSelection
from ortholoc_edge.adapters.mavlink.latency import Ages, DelayAdvice
from ortholoc_edge.adapters.mavlink.log import LimitedLog
from ortholoc_edge.adapters.mavlink.monitor import FusionReport
from ortholoc_edge.adapters.mavlink.operator import LeavePlace
from ortholoc_edge.adapters.mavlink.options import LinkOptions, Severity, SystemStatus, parse_endpoint
from ortholoc_edge.adapters.mavlink.parameters import Number, Reading, Written
from ortholoc_edge.adapters.mavlink.protocol import LinkProtocol, Statistic
from ortholoc_edge.adapters.mavlink.release import MAX_AGE_MS
from ortholoc_edge.adapters.mavlink.signing import ACCEPTED, STORE_INTERVAL_S, Verdict, make_signing
from ortholoc_edge.adapters.mavlink.sinks import Sink
from ortholoc_edge.adapters.mavlink.sources import Outcome
from ortholoc_edge.adapters.mavlink.state import AutopilotIdentity, AutopilotState
from ortholoc_edge.adapters.mavlink.transport import IN_LIMIT_BYTES, Transport, open_transport
from ortholoc_edge.clock import Clock, wall_clock_ns
from ortholoc_edge.errors import LinkError
from ortholoc_edge.geometry.arrays import FloatArray

logger = logging.getLogger(__name__)

_S = 1_000_000_000

# A TCP peer that stays mute this long is taken for half open: its end is gone and nobody told us.
_TCP_SILENCE_NS = 10 * _S
_BACKOFF_MIN_S, _BACKOFF_MAX_S = 0.5, 10.0
_SELECT_TIMEOUT_S = 0.05
_GIVE_UP_AFTER_ERRORS = 10
# Not the command of a recovery, which may go before an estimate.
_CARRY_ESTIMATES = {sink.value.upper() for sink in Sink if sink is not Sink.EXTERNAL_POSITION_ESTIMATE}
_CARRY_LOCAL = {sink.value.upper() for sink in Sink if sink.local}
# For `sys.setswitchinterval`, by who owns the process: how long the link's thread waits at most for a thread that
# computes in Python. By default 5 ms, each time that it comes back from the kernel.
SWITCH_INTERVAL_S = 1e-4
_REFUSED = {
    Verdict.UNSIGNED_REFUSED: "a frame without signature is refused; give its sender the key, or set require_signed "
    "to false",
    Verdict.BAD_SIGNATURE: "a frame signed with another key is refused; see that both sides have the same",
    Verdict.REPLAYED: "a signed frame that is not newer than those before is refused; if this goes on, its sender "
    "lost its clock",
    Verdict.TOO_OLD: "a signed frame more than a minute old is refused; its sender's clock, or ours, is wrong",
}


def _take_priority() -> None:
    """Let this thread run as soon as something arrives, before what computes.

    Linux otherwise lets a thread that is at work finish its slice of about 3 ms, which an answer to TIMESYNC then
    waits for. Allowed to root and where RLIMIT_RTPRIO is above zero (LimitRTPRIO= of the unit); it goes without.
    """
    try:
        os.sched_setscheduler(threading.get_native_id(), os.SCHED_FIFO, os.sched_param(1))
    except OSError as error:
        logger.info("the link's thread has no real-time priority (%s); answers wait for what computes", error.strerror)


class AutopilotLink:
    """The daemon's side of the link; every method may be called from any thread.

    Nothing is raised once started: a link that is down shows in :meth:`statistics`, in ``state_at(...)`` and
    in the log, and is opened again with a growing pause. If the thread meets a defect of our own again and
    again it ends, and :attr:`failure` says why; the daemon should then end too.
    """

    def __init__(
        self,
        options: LinkOptions,
        clock: Clock,
        gimbal: GimbalSelection | None = None,
        max_age_ms: float = MAX_AGE_MS,
    ) -> None:
        """
        Args:
            gimbal: the one that carries the camera; None: a fixed mount.
            max_age_ms: a fix that is older when the line has room for it is dropped and counted.
        Raises: ConfigError if the endpoint can't be understood, a serial line can't carry what is asked of it, or the
            signing key can't be used.
        """
        self._endpoint = parse_endpoint(options.endpoint)
        self._plan = plan_line(options, self._endpoint, has_gimbal=gimbal is not None)
        self._plan.require_fit()
        self._options, self._clock = options, clock
        self._protocol = LinkProtocol(options, gimbal, max_age_ms)
        self._mav = dialect.MAVLink(None, 0, options.component_id)
        self._signing = make_signing(options, os.environ)
        if self._signing is not None:
            self._signing.prepare(self._mav)
        self._signing_thread: threading.Thread | None = None
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._transport: Transport | None = None
        self._wake_pair: tuple[socket.socket, socket.socket] | None = None
        self._texts: deque[MavlinkMessage] = deque(maxlen=16)
        self._text_id = 0
        self._log = LimitedLog()
        self._counts: Counter[str] = Counter()
        self._parsers: dict[Any, FrameParser] = {}
        self._retired = Counter[str]()
        self._open_ok = False
        self._peer_is_vehicle = False
        self.failure: BaseException | None = None
        # When the thread came round last; ahead of now while it waits before it opens the device again.
        self.beat_ns = clock.now_ns()

    def __enter__(self) -> AutopilotLink:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def start(self, open_now: bool = False) -> None:
        """Start the thread. A device that is not there yet is waited for.

        Args:
            open_now: open the device here and now instead.
        Raises: LinkError if ``open_now`` and it can't be opened; ConfigError if signing's stamps can't be stored.
        """
        if self._thread is not None:
            raise RuntimeError("this link was started before; make a new one")
        for line in self._plan.lines():
            logger.info("%s", line)
        if (warning := self._plan.timesync_warning()) is not None:
            logger.warning("%s", warning)
        if self._signing is not None:
            self._signing.start(self._clock.now_ns(), wall_clock_ns())
        if open_now:
            try:
                self._transport = open_transport(self._endpoint)
            except OSError as error:
                raise LinkError(
                    f"link endpoint {self._options.endpoint} can't be opened: {error}; check that the device "
                    "exists, is not in use, and that the user may open it"
                ) from error
        receiver, sender = self._wake_pair = socket.socketpair()
        receiver.setblocking(False)
        sender.setblocking(False)
        self._thread = threading.Thread(
            target=self._run, args=(receiver,), name="autopilot-link", daemon=True
        )
        self._thread.start()
        if self._signing is not None:
            # On its own: a card that takes a second to store a stamp must not hold up an answer to TIMESYNC.
            self._signing_thread = threading.Thread(target=self._store_stamps, name="signing-stamps", daemon=True)
            self._signing_thread.start()

    def stop(self) -> None:
        """End the thread and close the device. Idempotent."""
        self._stop.set()
        self._wake()
        if self._thread is not None:
            self._thread.join(timeout=5.0)
            if self._thread.is_alive():
                logger.error("the autopilot link's thread did not end within 5 s; its device stays open")
                return
        if self._signing_thread is not None and self._signing is not None:
            self._signing_thread.join(timeout=5.0)
            self._signing.finish()
        if self._transport is not None:
            self._transport.close()
            self._transport = None
        for end in self._wake_pair or ():
            end.close()

    def is_alive(self) -> bool:
        """Whether the thread runs."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def vehicle(self) -> AutopilotIdentity | None:
        """The autopilot found, or None so far."""
        with self._lock:
            return self._protocol.vehicle

    def connected(self) -> bool:
        """Whether the autopilot's heartbeat came within 3 s."""
        with self._lock:
            return self._protocol.connected(self._clock.now_ns())

    def state_at(self, stamp_ns: int) -> AutopilotState | None:
        """What the autopilot knew at a stamp of our clock; None before an autopilot was found.

        Attitude is interpolated on the sphere, or carried on by its rates up to 0.2 s beyond the history; it
        is never merely the latest. Parts that are not known at that stamp are None.
        """
        with self._lock:
            return self._protocol.state_at(stamp_ns)

    def turns_before(self, stamp_ns: int, ages_ns: Sequence[int]) -> FloatArray | None:
        """How the body was turned some times before a stamp of our clock, against how it is at the stamp: (K, 3)
        rotation vectors about the body's axes at the stamp. None where its attitude is not known at one of them."""
        with self._lock:
            return self._protocol.telemetry.turns_before(stamp_ns, ages_ns)

    @property
    def sinks(self) -> tuple[Sink, ...]:
        """The messages that carry estimates to the autopilot found; empty before it was found."""
        with self._lock:
            return self._protocol.sinks

    def send_estimate(self, estimate: VisionEstimate) -> None:
        """Hand a fix over; when and how often it goes out is ``options.release``'s. One that was not sent yet is
        replaced and counted: newer is better.
        The first one after an outage (`LinkProtocol.is_outage`) is told as such, if ``options.recovery`` allows it.
        """
        with self._lock:
            self._counts["estimates_dropped"] += self._protocol.release.take(
                estimate, self._clock.now_ns(), self._protocol.state_at
            )
        self._wake()

    def sent_since(self, since_ns: int, *, local: bool = False) -> bool:
        """Whether an estimate left the link after ``since_ns``: the line took it, whatever became of it there.

        Args:
            local: count only messages that count from the EKF origin, the ones that ArduPilot's ExternalNav takes.
        """
        with self._lock:
            return self._protocol.sent_since(since_ns, local=local)

    @property
    def fusion(self) -> FusionReport:
        """What the autopilot's filter does with our fixes."""
        with self._lock:
            return self._protocol.monitor.report

    @property
    def delay_advice(self) -> DelayAdvice | None:
        """The delay parameters that the measured latency asks for; None before a fix was sent."""
        with self._lock:
            return self._protocol.delay_advice()

    def ages(self, latency_ms: float | None = None) -> Ages | None:
        """How old estimates are when they arrive: known of the mode of release, or measured; None before that.

        Args:
            latency_ms: from mid-exposure until a fix is there to be sent, where it was measured elsewhere.
        """
        with self._lock:
            return self._protocol.ages(latency_ms)

    def trouble(self) -> str | None:
        """Why nothing current is known of the vehicle, where the link is to blame; None where it is not."""
        with self._lock:
            if not self._open_ok:
                return f"link endpoint {self._options.endpoint} is not open"
            return self._protocol.trouble(self._clock.now_ns())

    @property
    def fixes_sent(self) -> int:
        """How many fixes went out, each counted once however often it was carried on."""
        with self._lock:
            return self._protocol.counts["fixes_sent"]

    @property
    def restarts(self) -> int:
        """How often the autopilot restarted, or another took its place."""
        with self._lock:
            return self._protocol.counts["restarts"]

    @property
    def latency_ms(self) -> tuple[float | None, float | None]:
        """Median and 99th percentile from mid-exposure to sent; None before a fix was."""
        with self._lock:
            meter = self._protocol.latency
            return meter.percentile_ms(50.0), meter.percentile_ms(99.0)

    def take_source_set(self, number: int) -> None:
        """Command an ArduPilot to use a source set; repeated until it answers, five times at most. What came of it
        is told by :meth:`source_set_outcome`."""
        with self._lock:
            self._protocol.source_set.ask(number)
        self._wake()

    def source_set_outcome(self) -> Outcome | None:
        """Of a :meth:`take_source_set` that came to its end since the last call, if one did."""
        with self._lock:
            return self._protocol.source_set.take_outcome()

    def take_places(self, leave: LeavePlace) -> None:
        """From now on, hand over where people say the vehicle is, if ``options.accept_positions`` allows it.

        Args:
            leave: called in the link's thread, must return at once.
        """
        with self._lock:
            self._protocol.operator.leave = leave

    def send_status_text(self, severity: Severity, text: str) -> None:
        """Show a line at the ground station. Cut at 200 characters; of more than 16 waiting parts the oldest
        go."""
        data = text.encode("ascii", "replace")[:200]
        parts = [data[i : i + 50] for i in range(0, len(data), 50)] or [b""]
        if len(parts) > 1 and len(parts[-1]) == 50:
            # Only a null character tells that a part is the last (MAVLink, STATUSTEXT); a full one has no room for it.
            parts.append(b"")
        with self._lock:
            # Id 0 says that a text is whole; others tie its parts together.
            self._text_id = self._text_id % 65535 + 1
            for i, part in enumerate(parts):
                if len(self._texts) == self._texts.maxlen:
                    self._counts["texts_dropped"] += 1
                self._texts.append(
                    dialect.MAVLink_statustext_message(
                        severity=int(severity),
                        text=part,
                        id=self._text_id if len(parts) > 1 else 0,
                        chunk_seq=i,
                    )
                )
        self._wake()

    def set_system_status(self, status: SystemStatus) -> None:
        """What the next HEARTBEAT says."""
        with self._lock:
            self._protocol.system_status = status

    def report_computer(self, status: ComputerStatus) -> None:
        """What the next ONBOARD_COMPUTER_STATUS says; each status is told once, at the configured rate."""
        with self._lock:
            self._protocol.computer = status

    def offer_origin(self, origin: GeodeticOrigin) -> None:
        """Set the EKF origin if the autopilot turns out to have none and ``options.set_origin`` allows it.

        That is so once it answered other things, but three questions for its origin not. Repeated until it tells one,
        which then counts, whether it is ours or not. Forgotten when the autopilot restarts.
        """
        with self._lock:
            self._protocol.offer_origin(origin)

    def read_parameters(self, names: Iterable[str]) -> None:
        """Ask the autopilot for these; :meth:`parameters` tells what came. Before one was found they wait.

        Raises: ValueError for a name that MAVLink can't carry.
        """
        with self._lock:
            self._protocol.parameters.read(names)

    def write_parameter(self, name: str, value: Number) -> None:
        """Set one that was read; :meth:`written_parameters` tells the outcome. One at a time.

        Raises: ValueError if it was not read, another is being set, or its type can't hold the value.
        """
        with self._lock:
            self._protocol.parameters.write(name, value)

    def parameters(self) -> tuple[Mapping[str, Reading], bool]:
        """What was asked for, as far as it is known; and whether all questions and changes are settled."""
        with self._lock:
            return self._protocol.parameters.readings, not self._protocol.parameters.busy

    def written_parameters(self) -> list[Written]:
        """Changes that came to an end since the last call."""
        with self._lock:
            return self._protocol.parameters.take_written()

    def health(self) -> LinkHealth:
        """Who is on the link and how well it carries."""
        with self._lock:
            bad_bytes = self._retired["bad_bytes"] + sum(p.bad_bytes for p in self._parsers.values())
            return self._protocol.health(self._clock.now_ns(), bad_bytes)

    def statistics(self) -> dict[str, Statistic]:
        """Counters since the start, flat: ``sent.NAME``, ``received.NAME``, ``bad_frames``, ``reconnects``
        ..."""
        with self._lock:
            parsers = list(self._parsers.values())
            return {
                "open": self._open_ok,
                "reconnects": self._counts["reconnects"],
                "estimates_dropped": self._counts["estimates_dropped"],
                **self._counts,
                "bad_frames": self._retired["bad_frames"] + sum(p.bad_frames for p in parsers),
                "bad_bytes": self._retired["bad_bytes"] + sum(p.bad_bytes for p in parsers),
                "unknown_frames": self._retired["unknown_frames"] + sum(p.unknown_frames for p in parsers),
                **self._protocol.statistics(self._clock.now_ns()),
            }

    # -- in the thread --------------------

    def _wake(self) -> None:
        # Full: it is about to wake anyway. Closed: there is nothing to wake.
        if self._wake_pair is not None:
            with contextlib.suppress(OSError):
                self._wake_pair[1].send(b"\0")

    def _store_stamps(self) -> None:
        while not self._stop.wait(STORE_INTERVAL_S):
            try:
                if self._signing is not None:
                    self._signing.store()
            except OSError as error:
                self._counts["stamps_not_stored"] += 1
                self._log(
                    self._clock.now_ns(), logging.ERROR, "stamps",
                    f"signing's stamps can't be stored: {error}; after a crash the autopilot may refuse our frames",
                )  # fmt: skip

    def _run(self, wake_receiver: socket.socket) -> None:
        _take_priority()
        try:
            self._connect_and_serve(wake_receiver)
        except BaseException as error:
            self.failure = error
            logger.exception("the autopilot link ends")

    def _connect_and_serve(self, wake_receiver: socket.socket) -> None:
        backoff_s = _BACKOFF_MIN_S
        while not self._stop.is_set():
            try:
                if self._transport is None:
                    self._transport = open_transport(self._endpoint)
            except OSError as error:
                self._counts["open_failures"] += 1
                self._log(
                    self._clock.now_ns(),
                    logging.WARNING,
                    "open",
                    f"link endpoint {self._options.endpoint} can't be opened: {error}; trying again",
                )
                self._pause(backoff_s)
                backoff_s = min(2.0 * backoff_s, _BACKOFF_MAX_S)
                continue
            logger.info("link open: %s", self._options.endpoint)
            self._open_ok = True
            before = self._counts["messages"]
            try:
                self._serve(self._transport, wake_receiver)
            except OSError as error:
                self._counts["reconnects"] += 1
                self._log(
                    self._clock.now_ns(),
                    logging.WARNING,
                    "lost",
                    f"link {self._options.endpoint} lost: {error}; opening again",
                )
            self._open_ok = False
            with self._lock:
                for parser in self._parsers.values():
                    self._retire(parser)
                self._parsers.clear()
                self._peer_is_vehicle = False
            self._transport.close()
            self._transport = None
            if not self._stop.is_set():
                # A peer that accepts and hangs up at once must not be called upon without end.
                if self._counts["messages"] > before:
                    backoff_s = _BACKOFF_MIN_S
                self._pause(backoff_s)
                backoff_s = min(2.0 * backoff_s, _BACKOFF_MAX_S)

    def _pause(self, seconds: float) -> None:
        self.beat_ns = self._clock.now_ns() + round(seconds * _S)
        self._stop.wait(seconds)

    def _serve(self, transport: Transport, wake_receiver: socket.socket) -> None:
        errors_in_a_row = 0
        last_heard_ns: int | None = None
        while not self._stop.is_set():
            writers = [transport] if transport.pending() else []
            readers: list[Transport | socket.socket] = [transport, wake_receiver]
            readable, writable, _ = select.select(readers, writers, [], self._wait_s())
            if wake_receiver in readable:
                with contextlib.suppress(BlockingIOError):
                    wake_receiver.recv(4096)
            if writable:
                transport.flush()
            self.beat_ns = now_ns = self._clock.now_ns()
            arrived = self._receive(transport, now_ns) if transport in readable else []
            if arrived:
                last_heard_ns = now_ns
            elif (
                self._endpoint.kind == "tcp"
                and last_heard_ns is not None
                and now_ns - last_heard_ns > _TCP_SILENCE_NS
            ):
                raise ConnectionError(f"nothing came for {_TCP_SILENCE_NS // _S} s")
            errors = self._exchange(transport, arrived, now_ns)
            # A defect of ours must not take attitude and estimates from the vehicle; unless it stays.
            errors_in_a_row = errors_in_a_row + 1 if errors else 0
            if errors_in_a_row >= _GIVE_UP_AFTER_ERRORS:
                raise errors[-1]

    def exchange(self, transport: Transport) -> None:
        """Take in what has arrived and say what is due, in the caller's thread: for an owner of simulated time, who
        calls it whenever something arrived and at least every 50 ms, and never `start`.

        Raises: what went wrong inside; on a real line that would be left out and counted.
        """
        self._open_ok = True
        now_ns = self._clock.now_ns()
        errors = self._exchange(transport, self._receive(transport, now_ns), now_ns)
        if errors:
            raise errors[0]

    def _exchange(self, transport: Transport, arrived: list[tuple[bytes, Any]], now_ns: int) -> list[Exception]:
        errors: list[Exception] = []
        for data, peer in arrived:
            errors += self._take(transport, data, peer, now_ns)
        try:
            self._say(transport)
        except OSError:
            raise
        except Exception as error:
            errors.append(self._left_out(error))
        return errors

    def _receive(self, transport: Transport, now_ns: int) -> list[tuple[bytes, Any]]:
        before = transport.cut_datagrams
        arrived = transport.receive()
        if transport.cut_datagrams > before:
            self._counts["cut_datagrams"] += transport.cut_datagrams - before
            self._log(
                now_ns, logging.WARNING, "cut",
                f"a datagram of more than {IN_LIMIT_BYTES} bytes is cut to that; have its sender make smaller ones",
            )  # fmt: skip
        return arrived

    def _left_out(self, error: Exception) -> Exception:
        self._counts["internal_errors"] += 1
        told = "".join(traceback.format_exception(error))
        self._log(self._clock.now_ns(), logging.ERROR, "internal", f"autopilot link: one item was left out\n{told}")
        return error

    def _wait_s(self) -> float:
        """Until something is due, and never long."""
        with self._lock:
            next_ns = self._protocol.release.next_ns()
        if next_ns is None:
            return _SELECT_TIMEOUT_S
        left_s = (next_ns - self._clock.now_ns()) / _S
        # What was due before waits for the line, which select tells of; a loop without a pause would not help it.
        return _SELECT_TIMEOUT_S if left_s <= 0.0 else min(left_s, _SELECT_TIMEOUT_S)

    def _take(self, transport: Transport, data: bytes, peer: Any, now_ns: int) -> list[Exception]:
        """Take in what arrived; returns the errors of ours that single messages met with."""
        with self._lock:
            parser = self._parsers.get(peer)
            if parser is None:
                # Any host can send us datagrams, each with a parser of its own; the oldest goes.
                if len(self._parsers) >= 8:
                    self._retire(self._parsers.pop(next(iter(self._parsers))))
                parser = self._parsers[peer] = FrameParser(lambda message: self._accepts(transport, message, peer))
        errors = []
        for message in parser.feed(data, now_ns):
            try:
                self._take_message(transport, message, peer, now_ns)
            except OSError:
                raise
            except Exception as error:
                errors.append(self._left_out(error))
        return errors

    def _take_message(self, transport: Transport, message: MavlinkMessage, peer: Any, now_ns: int) -> None:
        self._counts["messages"] += 1
        self._counts[f"received_bytes.{message.get_type()}"] += len(message.get_msgbuf())
        answer = self._protocol.answer(message, now_ns)
        if answer is not None:
            self._send(transport, answer)
        with self._lock:
            self._protocol.on_message(message, now_ns)
            vehicle = self._protocol.vehicle
        # Replies go where our autopilot is. Until it was heard, to whoever speaks MAVLink.
        ours = vehicle is not None and message.get_srcSystem() == vehicle.system_id
        if ours and self._protocol.is_vehicle_heartbeat(message):
            transport.prefer(peer)
            self._peer_is_vehicle = True
        elif not self._peer_is_vehicle:
            transport.prefer(peer)

    def _accepts(self, transport: Transport, message: MavlinkMessage, peer: Any) -> bool:
        """Whether a frame's signature lets it count."""
        if self._signing is None:
            return True
        now_ns = self._clock.now_ns()
        verdict = self._signing.check(message, now_ns, wall_clock_ns())
        if verdict in ACCEPTED:
            return True
        self._counts[verdict.value] += 1
        system, component = message.get_srcSystem(), message.get_srcComponent()
        self._log(now_ns, logging.WARNING, verdict.value, f"{_REFUSED[verdict]} (system {system}, {component})")
        if verdict is Verdict.TOO_OLD and not self._peer_is_vehicle:
            # Its clock catches up as soon as it hears a signed frame of ours, for which it must be spoken to.
            transport.prefer(peer)
            with self._lock:
                self._protocol.speaks_first = True
        return False

    def _retire(self, parser: FrameParser) -> None:
        for name in ("bad_frames", "bad_bytes", "unknown_frames"):
            self._retired[name] += getattr(parser, name)

    def _say(self, transport: Transport) -> None:
        now_ns = self._clock.now_ns()
        with self._lock:
            messages = self._protocol.poll(now_ns)
            # While bytes wait, an estimate stays where a newer one can still replace it.
            too_old = self._protocol.release.counts["too_old"]
            outgoing = None if transport.pending() else self._protocol.due_estimate(now_ns)
            self._counts["estimates_dropped"] += self._protocol.release.counts["too_old"] - too_old
            if outgoing is not None:
                encoded = []
                if self._protocol.connected(now_ns):
                    wall_ns = wall_clock_ns()
                    is_outage = self._protocol.is_outage(now_ns)
                    encoded = self._protocol.encode_estimate(outgoing.estimate, now_ns, wall_ns, is_outage)
                if not encoded:
                    self._counts["estimates_dropped"] += 1
            else:
                encoded = []
            while self._texts:
                messages.append(self._texts.popleft())
        went_out = {message.get_type() for message in encoded if self._send(transport, message)}
        if outgoing is not None and went_out & _CARRY_ESTIMATES:
            with self._lock:
                self._protocol.sent(outgoing, now_ns, local=bool(went_out & _CARRY_LOCAL))
        for message in messages:
            self._send(transport, message)

    def _send(self, transport: Transport, message: MavlinkMessage) -> bool:
        """Whether the line took it."""
        self._mav.srcSystem = self._protocol.own_system_id
        if self._signing is not None:
            self._signing.sign_next(self._mav, self._clock.now_ns(), wall_clock_ns())
        frame = bytes(message.pack(self._mav))
        if transport.send(frame):
            self._mav.seq = (self._mav.seq + 1) % 256
            self._counts[f"sent.{message.get_type()}"] += 1
            self._counts[f"sent_bytes.{message.get_type()}"] += len(frame)
            return True
        self._counts["unsent"] += 1
        if message.get_type() in _CARRY_ESTIMATES:
            self._counts["estimates_dropped"] += 1
        return False
