"""How fast the link to the autopilot is and whether it lasts, over real sockets and pseudo-terminals.

The autopilot at the other end is a process of its own, so that neither side waits for the other's interpreter, and
runs at real-time priority where that is allowed: it stands for another computer. Both read CLOCK_MONOTONIC.
"""

from __future__ import annotations

import contextlib
import gc
import multiprocessing
import os
import random
import select
import socket
import struct
import tempfile
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import Final, Literal

import cv2
import msgspec
import numpy as np

from ortholoc_edge.adapters.mavlink import AutopilotLink, LinkOptions
from ortholoc_edge.adapters.mavlink.codec import FrameParser, MavlinkMessage, dialect
from ortholoc_edge.adapters.mavlink.estimates import VisionEstimate
from ortholoc_edge.clock import SystemClock
from ortholoc_edge.errors import LinkError
from ortholoc_edge.geometry import frames
from ortholoc_edge.geometry.arrays import ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.matching.registry import make_method
from ortholoc_edge.matching.types import STRUCTURAL
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.localizer import Localizer, LocalizerOptions
from ortholoc_edge.pipeline.outcome import Fix
from ortholoc_edge.pipeline.prior import PosePrior
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

WireKind = Literal["udp", "tcp", "pty"]
ReleaseKind = Literal["raw", "fast-forward"]
RELEASES: Final[tuple[ReleaseKind, ...]] = ("raw", "fast-forward")

_S = 1_000_000_000
_BAUD = 921600
_ASKED_HZ = 50.0
# Fixes handed over: where each goes out by itself as many as measure well, else as many as are found in flight.
_FIX_HZ: Final[dict[ReleaseKind, float]] = {"raw": 20.0, "fast-forward": 4.0}
_STREAM_HZ = {"ATTITUDE_QUATERNION": 50.0, "LOCAL_POSITION_NED": 20.0}
_SYSTEM = 1
_PATIENCE_S = 15.0


# -- the other end ---------------------------------------------------------------------------------


class _Udp:
    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._peer: tuple[str, int] | None = None
        self.address = f"udpout:127.0.0.1:{self._socket.getsockname()[1]}"

    def fileno(self) -> int:
        return self._socket.fileno()

    def read(self) -> bytes:
        data, self._peer = self._socket.recvfrom(65535)
        return data

    def write(self, data: bytes) -> None:
        if self._peer is not None:
            self._socket.sendto(data, self._peer)

    def cut(self) -> None:
        """There is no connection to cut."""


class _Tcp:
    def __init__(self) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self._connection: socket.socket | None = None
        self.address = f"tcp:127.0.0.1:{self._server.getsockname()[1]}"

    def fileno(self) -> int:
        return (self._connection or self._server).fileno()

    def read(self) -> bytes:
        if self._connection is None:
            self._connection = self._server.accept()[0]
            self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return b""
        data = self._connection.recv(65536)
        if not data:
            self.cut()
        return data

    def write(self, data: bytes) -> None:
        if self._connection is not None:
            self._connection.sendall(data)

    def cut(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None


class _Pty:
    """``path`` is a link to the device: it stays when the device is exchanged, as /dev/serial/by-id does."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._master = self._slave = -1
        self._open()
        self.address = f"serial:{path}:{_BAUD}"

    def _open(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self._path.unlink(missing_ok=True)
        self._path.symlink_to(os.ttyname(self._slave))

    def fileno(self) -> int:
        return self._master

    def read(self) -> bytes:
        return os.read(self._master, 65536)

    def write(self, data: bytes) -> None:
        os.write(self._master, data)

    def cut(self) -> None:
        """Pull the device out and put another one in."""
        for end in (self._master, self._slave):
            os.close(end)
        self._open()


def _is_realtime_now() -> bool:
    """Take real-time priority, if that is allowed."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    except OSError:
        return False
    return True


def _open_wire(kind: WireKind, folder: str) -> _Udp | _Tcp | _Pty:
    return _Udp() if kind == "udp" else _Tcp() if kind == "tcp" else _Pty(Path(folder) / "ttyVEHICLE")


class _Peer:
    """What the process does: beats, streams, asks for the time; notes when answers and estimates arrive, to ns."""

    def __init__(self, wire: _Udp | _Tcp | _Pty) -> None:
        self._wire = wire
        self._mav, self._parser = dialect.MAVLink(None, _SYSTEM, 1), FrameParser()
        self._rng = random.Random(0)
        self._due = {"beat": 0.0, "ask": 0.0, **dict.fromkeys(_STREAM_HZ, 0.0)}
        self._asked = 0
        self.answers: list[int] = []
        self.estimates: list[tuple[int, int]] = []

    def wait_s(self) -> float:
        """Until something is to be said."""
        return max(0.0, min(self._due.values()) - time.monotonic())

    def hear(self) -> None:
        data = b""
        with contextlib.suppress(OSError):  # a pty whose other side is closed
            data = self._wire.read()
        arrival_ns = time.monotonic_ns()
        if not data:
            time.sleep(0.002)
        for message in self._parser.feed(data, arrival_ns):
            if message.get_type() == "ODOMETRY":
                self.estimates.append((round(message.x), arrival_ns))
            elif message.get_type() == "TIMESYNC" and message.tc1 == 0:
                self._say(dialect.MAVLink_timesync_message(tc1=arrival_ns, ts1=message.ts1))
            elif message.get_type() == "TIMESYNC" and message.ts1 == self._asked:
                self.answers.append(arrival_ns - self._asked)

    def say_what_is_due(self) -> None:
        if self._is_due("beat", 0.5):
            self._say(dialect.MAVLink_heartbeat_message(2, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, 0, 0, 4, 3))
        boot_ms = time.monotonic_ns() // 1_000_000 % 2**32
        if self._is_due("ATTITUDE_QUATERNION", 1.0 / _STREAM_HZ["ATTITUDE_QUATERNION"]):
            self._say(dialect.MAVLink_attitude_quaternion_message(boot_ms, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        if self._is_due("LOCAL_POSITION_NED", 1.0 / _STREAM_HZ["LOCAL_POSITION_NED"]):
            self._say(dialect.MAVLink_local_position_ned_message(boot_ms, 0.0, 0.0, -80.0, 0.0, 0.0, 0.0))
        # At times of its own, lest it keep step with anything here.
        if self._is_due("ask", self._rng.uniform(0.5, 1.5) / _ASKED_HZ):
            self._asked = time.monotonic_ns()
            self._say(dialect.MAVLink_timesync_message(tc1=0, ts1=self._asked))

    def _is_due(self, name: str, interval_s: float) -> bool:
        now = time.monotonic()
        if now < self._due[name]:
            return False
        self._due[name] = now + interval_s
        return True

    def _say(self, message: MavlinkMessage) -> None:
        # Nobody there, or the buffer is full: the next one will do.
        with contextlib.suppress(OSError):
            self._wire.write(bytes(message.pack(self._mav)))
        self._mav.seq = (self._mav.seq + 1) % 256


def _autopilot(kind: WireKind, folder: str, pipe: Connection) -> None:
    """The process. Commands by the pipe: "mark" forgets what was noted, "cut" breaks the connection, "tell" sends what
    was noted."""
    is_realtime = _is_realtime_now()
    wire = _open_wire(kind, folder)
    pipe.send((wire.address, is_realtime))
    peer = _Peer(wire)
    while True:
        readable, _, _ = select.select([wire, pipe], [], [], peer.wait_s())
        if wire in readable:
            peer.hear()
        if pipe in readable:
            try:
                command = pipe.recv()
            except EOFError:
                return
            if command == "cut":
                wire.cut()
            elif command == "tell":
                pipe.send((peer.answers, peer.estimates))
            else:
                peer.answers, peer.estimates = [], []
        peer.say_what_is_due()


class Autopilot:
    """The process at the other end; a context manager."""

    def __init__(self, kind: WireKind) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="ortholoc-link-")
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_autopilot, args=(kind, self._folder.name, theirs), daemon=True)
        self._process.start()
        theirs.close()
        if not self._pipe.poll(60.0):
            self.close()
            raise LinkError("the autopilot's process did not start within 60 s")
        self.endpoint, self.is_realtime = self._pipe.recv()

    def __enter__(self) -> Autopilot:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        self._pipe.close()
        self._process.join(5.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._process.close()
        self._folder.cleanup()

    def mark(self) -> None:
        """Forget what was noted so far."""
        self._pipe.send("mark")

    def cut(self) -> None:
        """Break the connection; it can be made again at once."""
        self._pipe.send("cut")

    def told(self) -> tuple[list[int], list[tuple[int, int]]]:
        """Since the mark: round trips of TIMESYNC, ns; and of each estimate how far north it was, m, and when it
        arrived, ns."""
        self._pipe.send("tell")
        answers, estimates = self._pipe.recv()
        return answers, estimates


# -- load ------------------------------------------------------------------------------------------


class LocalizerLoad:
    """Threads of this process that localize without a pause; a context manager."""

    def __init__(self, pack: Path, threads: int) -> None:
        """Raises: LinkError if a view straight down on the pack's middle gives no fix: that would be no fair load."""
        self._stop = threading.Event()
        self._steps = [0] * threads
        self.failure: BaseException | None = None
        self._resources = ExitStack()
        self._threads = []
        with ExitStack() as resources:
            for index in range(threads):
                store = resources.enter_context(MapStore(Pack.open(pack)))
                camera = Camera.from_focal(640, 480, 540.0)
                matcher = make_method(STRUCTURAL, working_px=640, max_keypoints=1024, threads=1)
                localizer = Localizer(camera, store, matcher, LocalizerOptions())
                resources.callback(localizer.close)
                localizer.warm_up()
                frame, prior = _view_down(store, camera)
                if not isinstance(localizer.localize(frame, prior), Fix):
                    raise LinkError(f"{pack}: a view straight down on its middle gives no fix; name another pack")
                work = partial(self._run, index, localizer, frame, prior)
                self._threads.append(threading.Thread(target=work, name=f"load-{index}"))
            self._resources = resources.pop_all()

    @property
    def steps(self) -> int:
        """Frames localized so far."""
        return sum(self._steps)

    def __enter__(self) -> LocalizerLoad:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()
        self._resources.close()

    def _run(self, index: int, localizer: Localizer, frame: Frame, prior: PosePrior) -> None:
        try:
            while not self._stop.is_set():
                localizer.localize(frame, prior)
                self._steps[index] += 1
        except Exception as error:
            self.failure = error


def _view_down(store: MapStore, camera: Camera) -> tuple[Frame, PosePrior]:
    """A frame cut from the map's middle as a camera sees it straight down, and a prior 3 m off."""
    west, south, east, north = store.bounds
    middle = np.array([(west + east) / 2.0, (south + north) / 2.0])
    gsd_m = store.dop_grids[0].gsd_m
    half = np.array([camera.width, camera.height]) * gsd_m / 2.0
    low, high = middle - half, middle + half
    window = store.read((float(low[0]), float(low[1]), float(high[0]), float(high[1])), gsd_m)
    ground_m = store.ground_near(middle)
    if window is None or ground_m is None:
        raise LinkError("the middle of the pack is empty, so there is nothing to localize on")
    image: ImageArray = np.asarray(cv2.resize(window.dop_grey, (camera.width, camera.height)), dtype=np.uint8)
    place = np.array([*middle, ground_m + gsd_m * camera.fx])
    turn = frames.map_from_ned_rotation(0.0) @ frames.BODY_FROM_NADIR_CAMERA
    covariance = np.diag(np.square([5.0, 5.0, 4.0, 0.02, 0.02, 0.05]))
    return Frame(0, image, "map"), PosePrior(Rigid3(turn, place + np.array([3.0, -2.0, 1.0])), covariance)


# -- time ------------------------------------------------------------------------------------------


class Spread(msgspec.Struct, frozen=True, kw_only=True):
    """Of one kind of time, ms."""

    count: int
    median_ms: float
    p99_ms: float
    max_ms: float


class Latencies(msgspec.Struct, frozen=True, kw_only=True):
    """Of one wire under one load.

    Attributes:
        estimate: from handing a fix over until the bytes of the first estimate of it were read at the other end.
        timesync: from the other end's question to our answer there.
        is_realtime: whether the other end ran at real-time priority; if not, its own waiting is in the figures.
        load_fps: frames that the load localized, per second.
    """

    wire: str
    load: str
    release: ReleaseKind
    estimate: Spread
    timesync: Spread
    is_realtime: bool
    load_fps: float


def spread(times_ns: list[int]) -> Spread:
    """Raises: LinkError where there is nothing to speak of."""
    if not times_ns:
        raise LinkError("nothing came through the link while it was measured")
    ms = np.array(times_ns) / 1e6
    return Spread(
        count=len(times_ns),
        median_ms=float(np.median(ms)),
        p99_ms=float(np.percentile(ms, 99)),
        max_ms=float(ms.max()),
    )


def _link_to(autopilot: Autopilot, release: ReleaseKind = "raw") -> AutopilotLink:
    return AutopilotLink(LinkOptions(endpoint=autopilot.endpoint, release=release), SystemClock())


def measure(
    kind: WireKind, seconds: float, load: LocalizerLoad | None, seed: int, release: ReleaseKind = "raw"
) -> Latencies:
    """Both times over one wire. Of what is made of a fix the first counts: repeats have no time of their own.

    Raises: LinkError if the link does not come up.
    """
    rng = random.Random(seed)
    with Autopilot(kind) as autopilot, _link_to(autopilot, release) as link:
        _wait_until(lambda: link.connected() and link.statistics()["synchronised"] is True, "the link is up")
        autopilot.mark()
        steps, begin = (0 if load is None else load.steps), time.monotonic()
        sent_ns: list[int] = []
        while time.monotonic() - begin < seconds:
            time.sleep(rng.uniform(0.5, 1.5) / _FIX_HZ[release])
            # Each a metre on from the last: that is how its arrival is known.
            place = np.array([float(len(sent_ns)), 2.0, -80.0])
            estimate = VisionEstimate(time.monotonic_ns(), place, np.eye(3), np.eye(6))
            sent_ns.append(time.monotonic_ns())
            link.send_estimate(estimate)
        took = time.monotonic() - begin
        if load is not None and load.failure is not None:
            raise LinkError(f"the load failed: {load.failure!r}") from load.failure
        done = 0 if load is None else load.steps - steps
        # The last one is on its way.
        time.sleep(0.1)
        answers, arrived = autopilot.told()
        first: dict[int, int] = {}
        for number, arrival_ns in arrived:
            first.setdefault(number, arrival_ns)
        return Latencies(
            wire=kind,
            load="idle" if load is None else "localizing",
            release=release,
            estimate=spread([arrival_ns - sent_ns[number] for number, arrival_ns in first.items()]),
            timesync=spread(answers),
            is_realtime=autopilot.is_realtime,
            load_fps=done / took,
        )


def _wait_until(condition: Callable[[], bool], what: str, seconds: float = _PATIENCE_S) -> float:
    """Seconds that it took. Raises: LinkError."""
    begin = time.monotonic()
    while not condition():
        if time.monotonic() - begin > seconds:
            raise LinkError(f"{what}: not within {seconds:.0f} s")
        time.sleep(0.005)
    return time.monotonic() - begin


# -- connect and disconnect ------------------------------------------------------------------------


class Usage(msgspec.Struct, frozen=True, kw_only=True):
    """What this process holds."""

    threads: int
    descriptors: int
    rss_mib: float


class Soak(msgspec.Struct, frozen=True, kw_only=True):
    """A loop of: a new link, an estimate through it, the connection cut, an estimate through the new one, the link
    closed.

    Attributes:
        early: after the first rounds, when what is loaded once is loaded. late: at the end.
        longest_back_s: from a cut until the autopilot's heartbeat counted again.
    """

    wire: str
    seconds: float
    rounds: int
    early: Usage
    late: Usage
    peak_rss_mib: float
    longest_back_s: float

    @property
    def holds_nothing_more(self) -> bool:
        """Whether threads and descriptors are as many as before, and memory grew by less than 4 MiB, which is what
        an allocator's arenas come and go by."""
        return (
            self.late.threads <= self.early.threads
            and self.late.descriptors <= self.early.descriptors
            and self.late.rss_mib - self.early.rss_mib < _RSS_SLACK_MIB
        )


def usage() -> Usage:
    """Of this process, after collecting garbage."""
    gc.collect()
    resident_pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return Usage(
        threads=threading.active_count(),
        descriptors=len(list(Path("/proc/self/fd").iterdir())),
        rss_mib=resident_pages * os.sysconf("SC_PAGE_SIZE") / 2**20,
    )


_WARM_ROUNDS = 5
_RSS_SLACK_MIB = 4.0


def soak(kind: WireKind, seconds: float, progress: Callable[[int], None] = lambda rounds: None) -> Soak:
    """Connect and disconnect for so long, ten rounds at least.

    Raises: LinkError where a link does not come up, come back or end.
    """
    begin, rounds, longest_s, peak = time.monotonic(), 0, 0.0, 0.0
    early = late = usage()
    with Autopilot(kind) as autopilot:
        while rounds < 2 * _WARM_ROUNDS or time.monotonic() - begin < seconds:
            longest_s = max(longest_s, _round(autopilot))
            rounds += 1
            late = usage()
            peak = max(peak, late.rss_mib)
            if rounds == _WARM_ROUNDS:
                early = late
            progress(rounds)
    return Soak(
        wire=kind,
        seconds=time.monotonic() - begin,
        rounds=rounds,
        early=early,
        late=late,
        peak_rss_mib=peak,
        longest_back_s=longest_s,
    )


def _round(autopilot: Autopilot) -> float:
    link = _link_to(autopilot)
    with link:
        _wait_until(link.connected, "a new link is up")
        link.send_estimate(VisionEstimate(time.monotonic_ns(), np.zeros(3), np.eye(3), np.eye(6)))
        _wait_until(lambda: link.statistics().get("sent.ODOMETRY") == 1, "an estimate is sent")
        autopilot.cut()
        _wait_until(lambda: link.statistics()["reconnects"] == 1, "the cut is noticed")
        heard = link.statistics().get("received.HEARTBEAT", 0)
        back_s = _wait_until(lambda: link.statistics().get("received.HEARTBEAT", 0) != heard, "the link is back")
        link.send_estimate(VisionEstimate(time.monotonic_ns(), np.zeros(3), np.eye(3), np.eye(6)))
        _wait_until(lambda: link.statistics().get("sent.ODOMETRY") == 2, "an estimate is sent again")
    if link.is_alive() or link.failure is not None:
        raise LinkError(f"a link did not end as it should: {link.failure!r}")
    return back_s


# -- hostile bytes ---------------------------------------------------------------------------------

# What the receiver has code for, and some that it has not.
_FUZZED = (
    "HEARTBEAT", "ATTITUDE_QUATERNION", "ATTITUDE", "LOCAL_POSITION_NED", "GPS_RAW_INT", "GPS_GLOBAL_ORIGIN",
    "HOME_POSITION", "SYSTEM_TIME", "EXTENDED_SYS_STATE", "EKF_STATUS_REPORT", "ESTIMATOR_STATUS", "AUTOPILOT_VERSION",
    "STATUSTEXT", "COMMAND_ACK", "TIMESYNC", "PARAM_VALUE", "GIMBAL_DEVICE_ATTITUDE_STATUS", "MOUNT_ORIENTATION",
    "SETUP_SIGNING", "RADIO_STATUS", "LOGGING_DATA", "FILE_TRANSFER_PROTOCOL",
)  # fmt: skip


class Fuzz(msgspec.Struct, frozen=True, kw_only=True):
    """What came of hostile bytes; ``is_heard_after``: whether the next heartbeats counted as if nothing had been."""

    fed_bytes: int
    seconds: float
    messages: int
    bad_frames: int
    unknown_frames: int
    refused_frames: int
    internal_errors: int
    is_heard_after: bool
    growth_mib: float


def hostile_bytes(rng: random.Random) -> Iterator[bytes]:
    """Pieces without end: noise full of start bytes; whole frames with any bits in their fields; such frames with
    bits flipped, cut, doubled, or a length that is not theirs."""
    while True:
        choice = rng.random()
        if choice < 0.25:
            noise = bytearray(rng.randbytes(rng.randint(1, 400)))
            for _ in range(len(noise) // 20):
                noise[rng.randrange(len(noise))] = rng.choice((0xFD, 0xFE))
            yield bytes(noise)
            continue
        frame = bytearray(_arbitrary_frame(rng))
        if choice > 0.6:
            for _ in range(rng.randint(1, 4)):
                kind = rng.randrange(4)
                at = rng.randrange(len(frame))
                if kind == 0:
                    frame[at] ^= 1 << rng.randrange(8)
                elif kind == 1 and len(frame) > 1:
                    del frame[at:]
                elif kind == 2:
                    frame[at:at] = frame[: rng.randint(0, 40)]
                elif len(frame) > 1:
                    frame[1] = rng.randrange(256)
                if not frame:
                    break
        yield bytes(frame)


def _arbitrary_frame(rng: random.Random) -> bytes:
    """With a right checksum: what is in it reaches the handlers."""
    kind = getattr(dialect, f"MAVLink_{rng.choice(_FUZZED).lower()}_message")
    sender = dialect.MAVLink(None, rng.choice((_SYSTEM, _SYSTEM, _SYSTEM, 255, 0)), rng.choice((1, 1, 1, 154, 197)))
    sender.seq = rng.randrange(256)
    if rng.random() < 0.2:
        sender.signing.secret_key, sender.signing.sign_outgoing = rng.randbytes(32), True
        sender.signing.timestamp = rng.randrange(2**48)
    body = object.__new__(kind)
    dialect.MAVLink_message.__init__(body, kind.id, kind.msgname)
    size = kind.unpacker.size
    payload = rng.randbytes(size)
    if rng.random() < 0.3:  # floats that are none
        at = rng.randrange(max(1, size - 4))
        odd = struct.pack("<f", rng.choice((float("nan"), float("inf"), -float("inf"), 1e38)))
        payload = (payload[:at] + odd + payload[at + 4 :])[:size]
    # MAVLink 1 has no room for messages beyond 255, and packs no signature.
    version_1 = kind.id < 256 and not sender.signing.sign_outgoing and rng.random() < 0.1
    return bytes(body._pack(sender, kind.crc_extra, payload, force_mavlink1=version_1))


def fuzz(size_bytes: int, seed: int, options: dict[str, object] | None = None) -> Fuzz:
    """Feed so many hostile bytes to a link over a pseudo-terminal, and see that it serves on.

    Args:
        options: of the link, beside its endpoint.
    """
    rng = random.Random(seed)
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    beat = dialect.MAVLink_heartbeat_message(2, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, 0, 0, 4, 3)
    whole = bytes(beat.pack(dialect.MAVLink(None, _SYSTEM, 1)))
    endpoint = f"serial:{os.ttyname(slave)}:{_BAUD}"
    link = AutopilotLink(msgspec.convert({"endpoint": endpoint, **(options or {})}, LinkOptions), SystemClock())

    def write(data: bytes) -> None:
        while data:
            readable, writable, _ = select.select([master], [master], [], 5.0)
            if not readable and not writable:
                raise LinkError("the link reads no more")
            if readable:
                os.read(master, 65536)
            if writable:
                with contextlib.suppress(BlockingIOError):
                    data = data[os.write(master, data) :]

    def number(name: str) -> int:
        value = link.statistics().get(name, 0)
        return value if isinstance(value, int) else 0

    fed, begin = 0, time.monotonic()
    try:
        with link:
            write(whole)
            before = usage()
            for piece in hostile_bytes(rng):
                write(piece)
                fed += len(piece)
                if fed >= size_bytes:
                    break
            took = time.monotonic() - begin
            # A stray header's claim is let go when nothing follows; then the first whole frame counts.
            heard = number("messages") + number("unsigned_refused")

            def is_heard() -> bool:
                write(whole)
                time.sleep(0.05)
                return number("messages") + number("unsigned_refused") >= heard + 10

            try:
                _wait_until(is_heard, "the link hears again", 5.0)
                is_heard_after = True
            except LinkError:
                is_heard_after = False
            after = usage()
            found = {name: number(name) for name in ("messages", "bad_frames", "unknown_frames", "internal_errors")}
            refused = sum(
                number(name)
                for name in ("unsigned_refused", "signature_bad", "signature_replayed", "signature_too_old")
            )
    finally:
        os.close(master)
        os.close(slave)
    if link.failure is not None:
        raise LinkError(f"the link's thread ended: {link.failure!r}") from link.failure
    return Fuzz(
        fed_bytes=fed,
        seconds=took,
        refused_frames=refused,
        is_heard_after=is_heard_after,
        growth_mib=after.rss_mib - before.rss_mib,
        **found,
    )
