"""The conversation with an autopilot: who is there, what to ask and to answer; no I/O, no threads, no own clock."""

from __future__ import annotations

import logging
from collections import Counter, OrderedDict, deque
from collections.abc import Callable
from statistics import median

from ortholoc_edge.adapters.computer import ComputerStatus
from ortholoc_edge.adapters.mavlink.census import Census, LinkHealth
from ortholoc_edge.adapters.mavlink.codec import MavlinkMessage, dialect
from ortholoc_edge.adapters.mavlink.estimates import Autopilot, VisionEstimate
from ortholoc_edge.adapters.mavlink.geodesy import GeodeticOrigin
from ortholoc_edge.adapters.mavlink.gimbal import GimbalSelection
from ortholoc_edge.adapters.mavlink.latency import Ages, DelayAdvice, LatencyMeter, advise, ages_of
from ortholoc_edge.adapters.mavlink.log import LimitedLog
from ortholoc_edge.adapters.mavlink.monitor import FusionMonitor
from ortholoc_edge.adapters.mavlink.operator import OperatorDesk
from ortholoc_edge.adapters.mavlink.options import LinkOptions, Severity, SystemStatus, parse_endpoint
from ortholoc_edge.adapters.mavlink.outlet import Outlet
from ortholoc_edge.adapters.mavlink.parameters import ParameterClient
from ortholoc_edge.adapters.mavlink.release import MAX_AGE_MS, Outgoing, Release
from ortholoc_edge.adapters.mavlink.sinks import Sink
from ortholoc_edge.adapters.mavlink.sources import PendingSwitch
from ortholoc_edge.adapters.mavlink.state import AutopilotIdentity, AutopilotState
from ortholoc_edge.adapters.mavlink.status import encode_onboard_computer_status, encode_quality
from ortholoc_edge.adapters.mavlink.streams import Repeat, Stream, wanted_rates_hz
from ortholoc_edge.adapters.mavlink.telemetry import Telemetry
from ortholoc_edge.adapters.mavlink.timesync import TimeSync

logger = logging.getLogger(__name__)

Statistic = int | float | str | bool | None

_MS = 1_000_000
_S = 1_000_000_000

_AUTOPILOT_COMPONENT = 1
_AUTOPILOTS = {
    dialect.MAV_AUTOPILOT_ARDUPILOTMEGA: Autopilot.ARDUPILOT,
    dialect.MAV_AUTOPILOT_PX4: Autopilot.PX4,
}

# An autopilot sends HEARTBEAT at 1 Hz; three missing is how ground stations judge it too.
_SILENT_AFTER_NS = 3 * _S
# A serial line on which no autopilot was heard for this long: some begin to speak MAVLink only when they are spoken to
# (PX4 over USB).
_SPEAK_FIRST_AFTER_NS = 5 * _S
# An autopilot that answers other things, but this many questions for its origin in a row not, has none. One may be
# lost, and ours must not replace an origin that is there.
_ORIGIN_QUESTIONS = 3

# The same text is logged once in this time; of this many texts it is known when that was.
_TEXT_AGAIN_NS = 10 * _S
_MOST_TEXTS = 256
# ArduPilot sets its position by command only while its filter has fused none for a second. Where estimates usually are
# rarer, that is no outage but their rhythm: to set the position anew each time would undo all that the filter weighed.
_OUTAGE_NS, _OUTAGE_RATIO = 1 * _S, 2.5


def _repeat_at(rate_hz: float) -> Repeat | None:
    return Repeat(int(_S / rate_hz)) if rate_hz > 0 else None


class LinkProtocol:
    """What is said and asked, and to whom; what was heard of the vehicle is kept by its ``telemetry``.

    Its owner calls :meth:`answer` and :meth:`on_message` for each message that arrives and :meth:`poll` at least every
    50 ms, and sends what they return, in order. :meth:`answer` alone may be called while another thread is in here.
    """

    def __init__(
        self, options: LinkOptions, gimbal: GimbalSelection | None = None, max_age_ms: float = MAX_AGE_MS
    ) -> None:
        """Args: as of :class:`AutopilotLink`."""
        self._options = options
        self._log = LimitedLog()
        self.system_status = SystemStatus.BOOT
        self.computer: ComputerStatus | None = None
        self._last_sent: Outgoing | None = None
        self._sent_ns: int | None = None
        self._local_sent_ns: int | None = None
        self._pauses_ns: deque[int] = deque(maxlen=5)
        self.timesync = TimeSync()
        self.counts: Counter[str] = Counter()
        self.telemetry = Telemetry(
            self.timesync, self.counts, options.attitude_rate_hz, options.position_rate_hz, gimbal
        )
        self.release = Release(options, max_age_ms)
        self.latency = LatencyMeter()
        self.monitor = FusionMonitor()
        self.source_set = PendingSwitch()
        self.operator = OperatorDesk(self.counts)
        self._texts_told: OrderedDict[str, int] = OrderedDict()
        self._advice: DelayAdvice | None = None
        self.parameters = ParameterClient()
        self._census = Census()
        self._vehicle: AutopilotIdentity | None = None
        self._heartbeat_ns = 0
        self._silent = False
        # Ours would carry a system id that nobody has, were they sent before the vehicle's is known; but who connects
        # out must speak first, as a router learns from it where we are.
        self._endpoint_kind = parse_endpoint(options.endpoint).kind
        self.speaks_first = options.system_id != 0 or self._endpoint_kind in ("udpout", "tcp")
        self._first_poll_ns: int | None = None
        # Other autopilots' system ids, each with when it was heard last.
        self._others: dict[int, int] = {}
        self._offered_origin: GeodeticOrigin | None = None
        self._origin_unanswered = 0
        self._answers_since = False
        self._home_known = False
        self._streams: dict[str, Stream] = {}
        self._heartbeat_timer = Repeat(1 * _S)
        self._version_timer = Repeat(1 * _S, 10 * _S)
        self._origin_timer = Repeat(1 * _S)
        self._origin_watch_timer = Repeat(5 * _S)
        self._home_timer = Repeat(2 * _S, 10 * _S)
        self._monitor_timer = Repeat(_S // 2)
        self._advice_timer = Repeat(60 * _S)
        self._computer_timer = _repeat_at(options.computer_status_rate_hz)
        self._quality_timer = _repeat_at(options.quality_rate_hz)
        self._outlet = Outlet(options, self.counts, self._log)
        self._handlers: dict[str, Callable[[MavlinkMessage, int], None]] = {
            "HOME_POSITION": self._on_home,
            "AUTOPILOT_VERSION": self._on_version,
            "STATUSTEXT": self._on_status_text,
            "COMMAND_ACK": self._on_command_ack,
            "PARAM_VALUE": self._on_parameter,
            "PARAM_ERROR": lambda m, arrival_ns: self.parameters.on_error(m),
            "TIMESYNC": self._on_timesync,
        }

    # -- who we are and who they are --------------------

    @property
    def vehicle(self) -> AutopilotIdentity | None:
        return self._vehicle

    @property
    def own_system_id(self) -> int:
        """Ours: configured, else the vehicle's, else 1, the id that a vehicle has unless someone changed
        it."""
        if self._options.system_id:
            return self._options.system_id
        return self._vehicle.system_id if self._vehicle else 1

    def connected(self, now_ns: int) -> bool:
        """Whether the autopilot's heart beats."""
        return self._vehicle is not None and now_ns - self._heartbeat_ns <= _SILENT_AFTER_NS

    def trouble(self, now_ns: int) -> str | None:
        """Why nothing current is known of the vehicle, as far as that lies with the link; None if it does not."""
        others = [system for system, at_ns in self._others.items() if now_ns - at_ns <= _SILENT_AFTER_NS]
        heard = ", ".join(map(str, sorted(others)))
        if self._vehicle is None:
            if others:
                return (
                    f"the autopilot that is heard has system id {heard}, but [link] system_id is "
                    f"{self._options.system_id}; set it to that, or to 0 to take the first"
                )
            return f"no autopilot heard on {self._options.endpoint}"
        silent_ns = now_ns - self._heartbeat_ns
        if silent_ns <= _SILENT_AFTER_NS:
            return None
        trouble = f"autopilot (system {self._vehicle.system_id}) silent since {silent_ns // _S} s"
        return trouble + (f"; system {heard} is heard, but not served: restart us to take it" if others else "")

    # -- in --------------------

    def answer(self, message: MavlinkMessage, arrival_ns: int) -> MavlinkMessage | None:
        """What must be said to a message at once: our time, if our autopilot asks for it.

        It changes nothing and looks at one value only, so that it need not wait until a thread of low priority that
        asks for a state, say, is done.
        """
        vehicle = self._vehicle
        if vehicle is None or message.get_type() != "TIMESYNC" or message.tc1 != 0:
            return None
        if (message.get_srcSystem(), message.get_srcComponent()) != (vehicle.system_id, _AUTOPILOT_COMPONENT):
            return None
        return dialect.MAVLink_timesync_message(tc1=arrival_ns, ts1=message.ts1)

    def on_message(self, message: MavlinkMessage, arrival_ns: int) -> None:
        """Take in one message."""
        system, component = message.get_srcSystem(), message.get_srcComponent()
        name = message.get_type()
        self._census.take(message)
        if system == self.own_system_id and component == self._options.component_id:
            self.counts["own_echo"] += 1
            return
        if name == "HEARTBEAT" and component == _AUTOPILOT_COMPONENT:
            self._on_heartbeat(message, system, arrival_ns)
            return
        if self._is_position_for_us(message):
            self.counts[f"received.{name}"] += 1
            self.operator.take(message, arrival_ns)
            return
        if self._vehicle is None or (system, component) != (self._vehicle.system_id, _AUTOPILOT_COMPONENT):
            ours = self._vehicle is not None and system == self._vehicle.system_id
            taken = ours and self.telemetry.take_of_component(message, arrival_ns)
            self.counts[f"received.{name}" if taken else "ignored"] += 1
            return
        self.counts[f"received.{name}"] += 1
        self._census.take_vehicles(name, arrival_ns)
        if name in self._streams:
            self._streams[name].heard(arrival_ns)
        if name == "TIMESYNC" and message.tc1 == 0:
            return
        restart = self.telemetry.take(message, arrival_ns)
        if restart is not None:
            self._start_over(restart, arrival_ns)
        # Not the origin itself, which would have ended the questions.
        self._answers_since |= name in ("TIMESYNC", "COMMAND_ACK", "AUTOPILOT_VERSION", "PARAM_VALUE")
        handler = self._handlers.get(name)
        if handler is not None:
            handler(message, arrival_ns)

    def _is_position_for_us(self, message: MavlinkMessage) -> bool:
        """From anybody: an autopilot hands on what a ground station addresses to us. Not what is for all."""
        return (
            self._options.accept_positions
            and self._vehicle is not None
            and message.get_type() in ("COMMAND_INT", "COMMAND_LONG")
            and message.command == dialect.MAV_CMD_EXTERNAL_POSITION_ESTIMATE
            and message.target_system == self.own_system_id
            and message.target_component == self._options.component_id
        )

    def is_vehicle_heartbeat(self, message: MavlinkMessage) -> bool:
        """Whether this is the heartbeat of an autopilot that we may serve, not of a ground station or a
        gimbal."""
        return (
            message.get_type() == "HEARTBEAT"
            and message.get_srcComponent() == _AUTOPILOT_COMPONENT
            and self._autopilot_of(message) is not None
            and self._options.system_id in (0, message.get_srcSystem())
        )

    def _autopilot_of(self, heartbeat: MavlinkMessage) -> Autopilot | None:
        """The autopilot that a heartbeat is of: as it says, or as configured; None if it is of none that we serve.

        A derivative may have a number of its own. It is served only where somebody said what it derives from.
        """
        if heartbeat.type == dialect.MAV_TYPE_GCS or heartbeat.autopilot == dialect.MAV_AUTOPILOT_INVALID:
            return None
        said = _AUTOPILOTS.get(heartbeat.autopilot)
        return said if self._options.autopilot == "auto" else Autopilot(self._options.autopilot)

    def _is_another_autopilot(self, message: MavlinkMessage) -> bool:
        return (
            self._autopilot_of(message) is not None
            and self._options.system_id not in (0, message.get_srcSystem())
        )

    def _on_heartbeat(self, message: MavlinkMessage, system: int, arrival_ns: int) -> None:
        autopilot = self._autopilot_of(message)
        if autopilot is None or not self.is_vehicle_heartbeat(message):
            self.counts["ignored"] += 1
            if self._is_another_autopilot(message):
                self._others[system] = arrival_ns
            if self._vehicle is None and self._is_another_autopilot(message):
                self._log(
                    arrival_ns,
                    logging.WARNING,
                    "other_system",
                    f"an autopilot with system id {system} is heard, but [link] system_id is "
                    f"{self._options.system_id}, of which nothing came; set it to {system}, or to 0 to take the first",
                )
            return
        self.counts["received.HEARTBEAT"] += 1
        said = _AUTOPILOTS.get(message.autopilot)
        known = self._vehicle
        if known is not None and system != known.system_id:
            # For the life of the process: where ours fell silent, another's attitude would be a neighbour's.
            self._others[system] = arrival_ns
            self.counts["other_vehicles"] += 1
            self._log(
                arrival_ns,
                logging.WARNING,
                "other_vehicle",
                f"autopilots with system ids {known.system_id} and {system} are heard, and {known.system_id} is served "
                f"since it was first; set [link] system_id. If the autopilot was exchanged, restart this program",
            )
            return
        if known is None or known.autopilot is not autopilot:
            if self._vehicle is not None:
                self.telemetry.forget()
                self._start_over("another autopilot answers", arrival_ns)
            self._vehicle = AutopilotIdentity(system, autopilot, None)
            self._streams = self._wanted_streams(autopilot)
            logger.info("autopilot found: %s, system %d", autopilot.value, system)
            if autopilot is not said:
                name = f"of MAV_AUTOPILOT {message.autopilot}" if said is None else said.value
                logger.warning("autopilot says it is %s, configured is %s", name, autopilot.value)
        elif self._silent:
            logger.info("autopilot is back")
        self._silent = False
        self._heartbeat_ns = arrival_ns
        self.telemetry.take(message, arrival_ns)

    def _wanted_streams(self, autopilot: Autopilot) -> dict[str, Stream]:
        return {
            name: Stream(getattr(dialect, f"MAVLINK_MSG_ID_{name}"), rate_hz)
            for name, rate_hz in wanted_rates_hz(self._options, autopilot).items()
        }

    def _start_over(self, why: str, now_ns: int) -> None:
        """Ask a restarted autopilot for everything again."""
        self.counts["restarts"] += 1
        self._log(now_ns, logging.WARNING, "restart", f"autopilot: {why}; asking for its streams again")
        self.timesync.reset()
        self._home_known = False
        # The one offered before is that of a life before; the next fix brings another.
        self._offered_origin = None
        self._origin_unanswered, self._answers_since = 0, False
        if self._vehicle is not None:
            self._vehicle = AutopilotIdentity(self._vehicle.system_id, self._vehicle.autopilot, None)
        for stream in self._streams.values():
            stream.restart()
        for timer in (self._version_timer, self._origin_timer, self._home_timer):
            timer.restart()
        self.parameters.restart()
        self.source_set.settle(accepted=False, answer=None)
        self._census.restart()

    def _on_timesync(self, m: MavlinkMessage, arrival_ns: int) -> None:
        resets = self.timesync.resets
        self.timesync.answered(m.tc1, m.ts1, arrival_ns)
        if self.timesync.resets != resets:
            # What was stamped by the old clock can't be told from what comes now.
            self.telemetry.forget()
            self._start_over("its clock is another one (it stepped, or a restart went unheard)", arrival_ns)

    def _on_home(self, m: MavlinkMessage, arrival_ns: int) -> None:
        self._home_known = True

    def _on_version(self, m: MavlinkMessage, arrival_ns: int) -> None:
        v = m.flight_sw_version
        if v == 0 or self._vehicle is None:
            return
        version = (v >> 24 & 255, v >> 16 & 255, v >> 8 & 255)
        development = v & 255 != dialect.FIRMWARE_VERSION_TYPE_OFFICIAL
        known = AutopilotIdentity(self._vehicle.system_id, self._vehicle.autopilot, version, development)
        if self._vehicle != known:
            self._vehicle = known
            logger.info("autopilot's firmware: %s %s", known.autopilot.value, known.firmware)

    def _on_status_text(self, m: MavlinkMessage, arrival_ns: int) -> None:
        level = logging.WARNING if m.severity <= Severity.ERROR else logging.INFO
        # Printable only: what comes over a radio must not steer a terminal.
        text = "".join(c if c.isprintable() else "?" for c in str(m.text))
        # By the text itself: one that repeats must not hide another.
        if text in self._texts_told and arrival_ns - self._texts_told[text] < _TEXT_AGAIN_NS:
            self.counts["texts_repeated"] += 1
        else:
            self._texts_told[text] = arrival_ns
            self._texts_told.move_to_end(text)
            if len(self._texts_told) > _MOST_TEXTS:
                self._texts_told.popitem(last=False)
            logger.log(level, "autopilot says: %s", text)
        self.monitor.heard(text)

    def _on_command_ack(self, m: MavlinkMessage, arrival_ns: int) -> None:
        # Zeros: for whoever asked, from firmware that does not say whom it answers.
        if m.target_system not in (0, self.own_system_id) or m.target_component not in (0, self._options.component_id):
            self.counts["acks_for_others"] += 1
            return
        if m.command == dialect.MAV_CMD_SET_EKF_SOURCE_SET and m.result != dialect.MAV_RESULT_IN_PROGRESS:
            outcome = self.source_set.settle(accepted=m.result == dialect.MAV_RESULT_ACCEPTED, answer=m.result)
            if outcome is not None and not outcome.accepted:
                logger.warning("autopilot refuses to take EKF source set %d (result %d)", outcome.number, m.result)
        if m.result not in (dialect.MAV_RESULT_ACCEPTED, dialect.MAV_RESULT_IN_PROGRESS):
            self.counts["commands_refused"] += 1

    def _on_parameter(self, m: MavlinkMessage, arrival_ns: int) -> None:
        if self._vehicle is not None:
            self.parameters.on_value(m, self._vehicle.autopilot, arrival_ns)

    # -- out --------------------

    def _may_speak(self, now_ns: int) -> bool:
        if self._first_poll_ns is None:
            self._first_poll_ns = now_ns
        if self._endpoint_kind == "serial" and now_ns - self._first_poll_ns >= _SPEAK_FIRST_AFTER_NS:
            self.speaks_first = True
        return self._vehicle is not None or self.speaks_first

    def poll(self, now_ns: int) -> list[MavlinkMessage]:
        """What is due now."""
        out: list[MavlinkMessage] = []
        if self._may_speak(now_ns) and self._heartbeat_timer.due(now_ns):
            out.append(
                dialect.MAVLink_heartbeat_message(
                    type=dialect.MAV_TYPE_ONBOARD_CONTROLLER,
                    autopilot=dialect.MAV_AUTOPILOT_INVALID,
                    base_mode=0,
                    custom_mode=0,
                    system_status=int(self.system_status),
                    mavlink_version=3,
                )
            )
        vehicle = self._vehicle
        if vehicle is None:
            return out
        out += self.operator.poll(now_ns)
        if now_ns - self._heartbeat_ns > _SILENT_AFTER_NS:
            if not self._silent:
                self._silent = True
                self.counts["silences"] += 1
                logger.warning("autopilot silent: no heartbeat for %d s", _SILENT_AFTER_NS // _S)
            # A switch is of the moment: not one that is said to an autopilot that comes back.
            self.source_set.settle(accepted=False, answer=None)
            if self._monitor_timer.due(now_ns):
                self.monitor.silent(now_ns)
            # Nothing is asked of a mute peer; its answers to a backlog of requests would come in one burst.
            return out
        ts1 = self.timesync.due(now_ns)
        if ts1 is not None:
            out.append(dialect.MAVLink_timesync_message(tc1=0, ts1=ts1))
        self.release.believed = self._outlet.believed(vehicle)
        if vehicle.firmware_version is not None:
            # What is doubtful about the choice is told before the first estimate.
            self._outlet.sinks(vehicle)
        elif self._version_timer.due(now_ns):
            out.append(self._request(dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION))
        if (self._origin_timer if self.telemetry.origin is None else self._origin_watch_timer).due(now_ns):
            out += self._ask_origin(vehicle.system_id)
        if not self._home_known and self._home_timer.due(now_ns):
            out.append(self._request(dialect.MAVLINK_MSG_ID_HOME_POSITION))
        out += self._about_us(now_ns)
        out += [
            self._command(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, stream.message_id, stream.interval_ns / 1e3)
            for stream in self._streams.values()
            if stream.due(now_ns)
        ]
        out += self._watch(vehicle.autopilot, now_ns)
        if self.telemetry.gimbal is not None:
            out += [
                self._command(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, interval_ns / 1e3, component)
                for component, message_id, interval_ns in self.telemetry.gimbal.requests(now_ns)
            ]
        out += self.parameters.poll(now_ns, vehicle.system_id, vehicle.autopilot)
        return out

    def _ask_origin(self, system_id: int) -> list[MavlinkMessage]:
        """The question for the origin, and after it ours where there is none and we may set it."""
        out = [self._request(dialect.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)]
        if self.telemetry.origin is not None:
            return out
        self._origin_unanswered += self._answers_since
        self._answers_since = False
        offered = self._offered_origin if self._options.set_origin else None
        if offered is not None and self._origin_unanswered >= _ORIGIN_QUESTIONS:
            # Lost before the filter has started, so it goes along with each question until answered.
            out.append(self._set_origin(system_id, offered))
        return out

    def _watch(self, autopilot: Autopilot, now_ns: int) -> list[MavlinkMessage]:
        """See what becomes of the fixes; returns the command for a source set where one is due."""
        if self._monitor_timer.due(now_ns):
            self.monitor.assess(now_ns, self.state_at, autopilot)
        if self._advice_timer.due(now_ns):
            self._tell_delays()
        number = self.source_set.due(now_ns)
        return [] if number is None else [self._command(dialect.MAV_CMD_SET_EKF_SOURCE_SET, number)]

    def due_estimate(self, now_ns: int) -> Outgoing | None:
        """The estimate to send now, if any."""
        before = self.release.counts["too_old"]
        outgoing = self.release.due(now_ns, self.state_at)
        if self.release.counts["too_old"] != before:
            self._log(now_ns, logging.WARNING, "too_old", "a fix that waited too long for the line is not sent")
        return outgoing

    def is_outage(self, now_ns: int) -> bool:
        """Whether estimates flowed and none left for so long that ArduPilot takes a new position by command."""
        usual_ns = median(self._pauses_ns or (0,))
        return self._sent_ns is not None and now_ns - self._sent_ns > max(_OUTAGE_NS, _OUTAGE_RATIO * usual_ns)

    def sent(self, outgoing: Outgoing, now_ns: int, *, local: bool) -> None:
        """An estimate was handed to the line. ``local``: by a message that counts from the EKF origin, too."""
        if self._sent_ns is not None:
            self._pauses_ns.append(now_ns - self._sent_ns)
        self._last_sent, self._sent_ns = outgoing, now_ns
        if local:
            self._local_sent_ns = now_ns
        if outgoing.repeat == 0:
            self.counts["fixes_sent"] += 1
            self.latency.add(now_ns - outgoing.capture_ns)
        if self._vehicle is not None:
            self.monitor.sent(outgoing.estimate, now_ns, self.state_at, self._vehicle.autopilot)

    def sent_since(self, since_ns: int, *, local: bool = False) -> bool:
        """See :meth:`AutopilotLink.sent_since`."""
        sent_ns = self._local_sent_ns if local else self._sent_ns
        return sent_ns is not None and sent_ns > since_ns

    def delay_advice(self) -> DelayAdvice | None:
        """What the autopilot should be told of our latency; None before a fix was sent."""
        if self._vehicle is None:
            return None
        return advise(
            self._vehicle.autopilot, self.release.mode, self.latency, self._options.fixed_latency_ms,
            self.timesync.median_round_trip_ns,
        )  # fmt: skip

    def ages(self, latency_ms: float | None = None) -> Ages | None:
        """How old estimates arrive, by which the delay parameters are to be set; None while it must be measured.

        Args:
            latency_ms: from mid-exposure until a fix is there to be sent, instead of what was measured here.
        """
        meter = self.latency
        if latency_ms is not None:
            meter = LatencyMeter()
            meter.add(round(latency_ms * _MS))
        return ages_of(
            self.release.mode, meter, self._options.fixed_latency_ms, self.timesync.median_round_trip_ns
        )

    def _tell_delays(self) -> None:
        advice = self.delay_advice()
        if advice is not None and (self._advice is None or advice.differs(self._advice)):
            self._advice = advice
            logger.info("measured latency asks for %s", advice)

    def _about_us(self, now_ns: int) -> list[MavlinkMessage]:
        out: list[MavlinkMessage] = []
        # Each reading once: of a worker that hangs, the last one would look alive.
        if self.computer is not None and self._computer_timer is not None and self._computer_timer.due(now_ns):
            out.append(encode_onboard_computer_status(self.computer, now_ns))
            self.computer = None
        if self._last_sent is not None and self._quality_timer is not None and self._quality_timer.due(now_ns):
            out += encode_quality(self._last_sent.estimate, self._last_sent.capture_ns, now_ns)
        return out

    @property
    def sinks(self) -> tuple[Sink, ...]:
        """What carries estimates to the autopilot found; empty before it was found."""
        return () if self._vehicle is None else self._outlet.sinks(self._vehicle)

    def encode_estimate(
        self, estimate: VisionEstimate, now_ns: int, wall_ns: int = 0, recovery: bool = False
    ) -> list[MavlinkMessage]:
        """The messages for an estimate, in the form that the autopilot found reads; none before it was found.

        See :meth:`Outlet.encode`.
        """
        if self._vehicle is None:
            return []
        return self._outlet.encode(estimate, self._vehicle, self.telemetry.origin, now_ns, wall_ns, recovery)

    def offer_origin(self, origin: GeodeticOrigin) -> None:
        """See :meth:`AutopilotLink.offer_origin`."""
        self._offered_origin = origin

    def _request(self, message_id: int) -> MavlinkMessage:
        return self._command(dialect.MAV_CMD_REQUEST_MESSAGE, message_id)

    def _command(
        self, command: int, param1: float, param2: float = 0.0, component: int = _AUTOPILOT_COMPONENT
    ) -> MavlinkMessage:
        return dialect.MAVLink_command_long_message(
            target_system=self._vehicle.system_id if self._vehicle else 0,
            target_component=component,
            command=command,
            confirmation=0,
            param1=float(param1),
            param2=float(param2),
            param3=0.0,
            param4=0.0,
            param5=0.0,
            param6=0.0,
            param7=0.0,
        )

    @staticmethod
    def _set_origin(system_id: int, origin: GeodeticOrigin) -> MavlinkMessage:
        return dialect.MAVLink_set_gps_global_origin_message(
            target_system=system_id,
            latitude=round(origin.latitude_deg * 1e7),
            longitude=round(origin.longitude_deg * 1e7),
            altitude=round(origin.height_amsl_m * 1e3),
        )

    # -- state --------------------

    def state_at(self, stamp_ns: int) -> AutopilotState | None:
        """See :meth:`AutopilotLink.state_at`."""
        return self.telemetry.state_at(stamp_ns) if self._vehicle is not None else None

    def health(self, now_ns: int, bad_bytes: int) -> LinkHealth:
        """See :meth:`AutopilotLink.health`."""
        round_trip_ns = self.timesync.median_round_trip_ns
        return LinkHealth(
            peers=self._census.peers,
            vehicle=self._vehicle,
            connected=self.connected(now_ns),
            wanted_system_id=self._options.system_id,
            own_id_heard=self.counts["own_echo"] > 0,
            mavlink1=self._census.mavlink1,
            mavlink2=self._census.mavlink2,
            bad_bytes=bad_bytes,
            rates_hz=self._census.rates_hz(now_ns),
            wanted_rates_hz={name: _S / stream.interval_ns for name, stream in self._streams.items()},
            round_trip_ms=None if round_trip_ns is None else round_trip_ns / _MS,
            synchronised=self.timesync.synchronised,
            origin=self.telemetry.origin,
            set_origin=self._options.set_origin,
        )

    def statistics(self, now_ns: int) -> dict[str, Statistic]:
        """Counters and the state of synchronisation."""
        best = self.timesync.best(now_ns)
        round_trip = self.timesync.last_round_trip_ns
        vehicle = self._vehicle
        advice, fusion = self.delay_advice(), self.monitor.report
        return {
            **self.counts,
            **{f"release.{name}": count for name, count in self.release.counts.items()},
            "displacement_trusted": self.release.displacement_trusted,
            "latency_median_ms": self.latency.percentile_ms(50.0),
            "latency_p99_ms": self.latency.percentile_ms(99.0),
            "delay_advice": None if advice is None else str(advice),
            "fusion": fusion.state.value,
            "fusion_since_s": (now_ns - fusion.since_ns) / _S if fusion.since_ns else None,
            "fusion_reason": fusion.reason,
            "connected": self.connected(now_ns),
            "autopilot": vehicle.autopilot.value if vehicle else None,
            "vehicle_system_id": vehicle.system_id if vehicle else None,
            "firmware": vehicle.firmware if vehicle and vehicle.firmware_version else None,
            "gimbal": None if self.telemetry.gimbal is None else str(self.telemetry.gimbal),
            "origin_known": self.telemetry.origin is not None,
            "local_epoch": self.telemetry.local_epoch,
            "synchronised": self.timesync.synchronised,
            "sync_uncertainty_ms": best[1] / _MS if best else None,
            "sync_resets": self.timesync.resets,
            "round_trip_ms": round_trip / _MS if round_trip is not None else None,
        }
