"""A simulated autopilot on a real line, for any companion program: ``python -m ortholoc_sim.link``.

It flies a vehicle in real time by its own estimate, speaks MAVLink 2 over UDP, TCP or a pseudo-terminal, and tells what
it did with each position that it was sent. `SimulatedLink` is the same for a test in Python. docs/simulated-link.md has
examples, and what the events hold.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import msgspec
import numpy as np

from ortholoc_edge.cli.arguments import non_negative, positive, seed, within
from ortholoc_edge.clock import Clock, SystemClock
from ortholoc_edge.errors import ConfigError, OrtholocError
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_sim.autopilot import (
    Airframe,
    AutopilotOptions,
    FilterOptions,
    Message,
    Port,
    PtyPort,
    SensorOptions,
    TcpPort,
    UdpPort,
    VisionRecord,
)
from ortholoc_sim.fixed_wing import FixedWingOptions
from ortholoc_sim.gnss import GnssEvent
from ortholoc_sim.line import PERFECT, LineOptions
from ortholoc_sim.loop import STEP_NS, ClosedLoop, LoopOptions
from ortholoc_sim.route import circle, read_waypoints, site_at
from ortholoc_sim.site import Geopoint
from ortholoc_sim.vehicle import VehicleOptions

_S = 1_000_000_000
_HOME = Geopoint(48.8026, 11.0033, 382.7)
_NEVER_S = 1e9
# It may fly for days: the truth is remembered for as long as a position may be old, records for some hours.
_KEEP_S, _KEEP_RECORDS = 20.0, 100_000
_SPEED_M_S: dict[Airframe, float] = {"multirotor": 9.0, "fixed-wing": 18.0}
_MOST_WAIT_S = 0.05

Event = dict[str, Any]


@dataclass(frozen=True, slots=True)
class LinkSpec:
    """One simulated autopilot.

    Attributes:
        firmware: "ardupilot-4.5" to "ardupilot-4.8", "px4-1.14" to "px4-1.18", with a patch number or without.
        over: what carries it. address: of UDP and TCP, port 0 takes a free one. peer: whom to send to before anybody
            has spoken, UDP only. line: what lies between.
        home: centre of the circle, and where heights count from.
        route: "circle" around home, or a waypoint file (QGC WPL 110).
        radius_m, height_m: of the circle.
        airframe: what flies. speed_m_s: over ground; None: 9, or 18 of a fixed wing.
        gnss: what happens to it, see `GnssEvent`.
        wind_ned_m_s, gust_m_s: wind.
        stock: parameters as they come from the factory instead of set up for vision. parameters: set over them.
        switching, origin: see `AutopilotOptions`.
        stamps: "firmware" has the time of a measurement as the firmware does; "ideal" from the shortest round trip of
            TIMESYNC at once.
        streams: send the usual messages unasked.
        seed: of all that is random: same seed, same flight.
    """

    firmware: str = "ardupilot-4.6"
    over: Literal["udp", "tcp", "pty"] = "udp"
    address: tuple[str, int] = ("127.0.0.1", 0)
    peer: tuple[str, int] | None = None
    line: LineOptions | None = None
    home: Geopoint = _HOME
    route: str = "circle"
    radius_m: float = 150.0
    height_m: float = 100.0
    airframe: Airframe = "multirotor"
    speed_m_s: float | None = None
    gnss: tuple[GnssEvent, ...] = ()
    wind_ned_m_s: tuple[float, float, float] = (1.5, -1.0, 0.0)
    gust_m_s: float = 0.6
    stock: bool = False
    parameters: Mapping[str, int | float] = field(default_factory=dict)
    switching: Literal["script", "command"] = "script"
    origin: Literal["gnss", "none"] = "gnss"
    stamps: Literal["firmware", "ideal"] = "firmware"
    streams: bool = False
    system_id: int = 1
    seed: int = 1
    sensors: SensorOptions = field(default_factory=SensorOptions)

    def vehicle(self) -> VehicleOptions | FixedWingOptions:
        """What flies, in this wind."""
        if self.airframe == "fixed-wing":
            return FixedWingOptions(wind_ned_m_s=self.wind_ned_m_s, gust_m_s=self.gust_m_s)
        return VehicleOptions(wind_ned_m_s=self.wind_ned_m_s, gust_m_s=self.gust_m_s)

    def autopilot(self) -> AutopilotOptions:
        """Raises: ConfigError for a firmware that is not simulated."""
        stack, version = parse_firmware(self.firmware)
        ideal = self.stamps == "ideal"
        jitter = stack == "ardupilot" and not ideal
        try:
            return AutopilotOptions(
                seed=self.seed + 3,
                system_id=self.system_id,
                firmware=version,
                sensors=self.sensors,
                filter=FilterOptions(stamps="jitter" if jitter else "timesync", converged_after=0 if ideal else 500),
                streams_by_default=self.streams,
                stack=stack,
                set_up="stock" if self.stock else "vision",
                parameters=self.parameters,
                switching=self.switching,
                origin=self.origin,
            )
        except ValueError as error:
            raise ConfigError(str(error)) from error


def parse_firmware(text: str) -> tuple[Literal["ardupilot", "px4"], tuple[int, int, int]]:
    """``px4-1.16`` or ``ardupilot-4.5.7``. Raises: ConfigError."""
    match = re.fullmatch(r"(ardupilot|px4)-(\d+)\.(\d+)(?:\.(\d+))?", text)
    if match is None:
        raise ConfigError(f"firmware {text!r} can't be read; write ardupilot-4.6 or px4-1.16")
    return ("px4" if match[1] == "px4" else "ardupilot"), (int(match[2]), int(match[3]), int(match[4] or 0))


class SimulatedLink:
    """A simulated autopilot that flies and answers while it is open. A context manager.

    Attributes:
        spec: as given.
        endpoint: where a companion finds it: ``udpout:``, ``tcp:`` or ``serial:``, as our ``[link] endpoint`` takes it.
        device: the same as pymavlink takes it.
    """

    def __init__(
        self, spec: LinkSpec, on_event: Callable[[Event], None] | None = None, clock: Clock | None = None
    ) -> None:
        """
        Args:
            on_event: gets every event (see docs/simulated-link.md), in the thread that flies.
        Raises: ConfigError for what can't be simulated; OSError if the address can't be had.
        """
        self.spec = spec
        self._clock = clock or SystemClock()
        self._on_event = on_event
        autopilot = spec.autopilot()
        site = site_at(spec.home, autopilot.stack)
        closed = spec.route == "circle"
        route = circle(site, spec.radius_m, spec.height_m) if closed else read_waypoints(Path(spec.route), site)
        self._site = site
        speed_m_s = spec.speed_m_s if spec.speed_m_s is not None else _SPEED_M_S[spec.airframe]
        options = LoopOptions(
            route, speed_m_s, climb_m=0.0, gnss_until_s=_NEVER_S, gnss=spec.gnss, vehicle=spec.vehicle(),
            autopilot=autopilot, seed=spec.seed, closed=closed, keep_s=_KEEP_S,
        )  # fmt: skip
        self._lock = threading.RLock()
        self._stop = threading.Event()
        self._failure: BaseException | None = None
        try:
            self._start_ns = self._clock.now_ns()
            self.loop = ClosedLoop(site, options, self._start_ns)
        except ValueError as error:
            raise ConfigError(str(error)) from error
        self._told = 0
        self._next_state_ns = self._start_ns
        self._thread = threading.Thread(target=self._run, name="simulated-link", daemon=True)
        self._port = self._open()
        self.endpoint = self._port.endpoint
        kind, _, rest = self.endpoint.partition(":")
        self.device = rest.rpartition(":")[0] if kind == "serial" else self.endpoint

    def _open(self) -> Port:
        spec, clock = self.spec, self._clock
        if spec.over == "udp":
            return UdpPort(spec.system_id, spec.address, spec.peer, spec.line, clock, spec.seed)
        if spec.over == "tcp":
            return TcpPort(spec.system_id, spec.address, spec.line, clock, spec.seed)
        return PtyPort(spec.system_id, spec.line, clock, spec.seed)

    def __enter__(self) -> SimulatedLink:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Land. Raises: OrtholocError if the simulation failed meanwhile."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join()
        self._port.close()
        if self._failure is not None:
            raise OrtholocError(f"simulated link: {self._failure}") from self._failure

    # -- what a test may ask and do, from any thread --------------------

    @property
    def failed(self) -> bool:
        """Whether the simulation ended by itself; `close` tells why."""
        return self._failure is not None

    @property
    def now_s(self) -> float:
        """Seconds flown."""
        return (self.loop.now_ns - self._start_ns) / _S

    @property
    def records(self) -> list[VisionRecord]:
        """What became of each position that it was sent; of very many, of the last."""
        with self._lock:
            return list(self.loop.autopilot.vision)

    @property
    def error_m(self) -> float:
        """Horizontal, of its own position."""
        with self._lock:
            autopilot = self.loop.autopilot
            return float(np.hypot(*(autopilot.position_ned_m - autopilot.true_position_m)[:2]))

    def true_local_m(self) -> FloatArray:
        """(3,) where the vehicle is now, in the frame of LOCAL_POSITION_NED: what a perfect companion would send."""
        with self._lock:
            return self.loop.autopilot.public_from_inner(self.loop.autopilot.true_position_m)

    def true_place(self) -> Geopoint:
        """The same on Earth."""
        with self._lock:
            return self._site.geopoint(self.loop.samples[-1].truth.position_ned_m if self.loop.samples else np.zeros(3))

    def counts(self) -> dict[str, int]:
        """Messages received, by name, and what else was counted."""
        with self._lock:
            return {**self.loop.autopilot.counts, "bad_data": self._port.bad_data}

    def reboot(self) -> None:
        """Restart the autopilot. The vehicle stays in the air."""
        with self._lock:
            self.loop.autopilot.reboot()

    def set_parameter(self, name: str, value: float) -> None:
        """As PARAM_SET would. Raises: KeyError for a name that it does not have."""
        with self._lock:
            table = self.loop.autopilot.parameters
            table.set(name, float(value) if isinstance(table[name], float) else round(value))

    def wait_for(self, condition: Callable[[], bool], timeout_s: float = 20.0) -> None:
        """Wait until something holds. Raises: TimeoutError; OrtholocError if the simulation ended."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            if self._failure is not None:
                raise OrtholocError(f"simulated link: {self._failure}") from self._failure
            if time.monotonic() > deadline:
                raise TimeoutError(f"did not happen within {timeout_s:g} s")
            self._stop.wait(0.01)

    # -- in the thread --------------------

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                self._turn()
        except BaseException as error:
            self._failure = error
            self._stop.set()

    def _turn(self) -> None:
        """Fly as far as the clock is, carry messages, and wait for the next of either."""
        now_ns = self._clock.now_ns()
        with self._lock:
            self._port.send(self._heard(self.loop.advance(now_ns)))
            self._tell(now_ns)
        due_ns = self.loop.now_ns + STEP_NS
        arrives_ns = self._port.next_ns()
        if arrives_ns is not None:
            due_ns = min(due_ns, arrives_ns)
        wait_s = min(_MOST_WAIT_S, max(0.0, (due_ns - self._clock.now_ns()) / _S))
        select.select([self._port], [], [], wait_s)
        with self._lock:
            messages = self._port.receive()
            if messages:
                self._port.send(self.loop.receive(messages, self._clock.now_ns()))
                self._tell(self._clock.now_ns())

    def _heard(self, messages: list[Message]) -> list[Message]:
        if self._on_event is not None:
            for message in messages:
                if message.get_type() == "STATUSTEXT":
                    text = message.text
                    said = text.decode("ascii", "replace") if isinstance(text, bytes) else text
                    self._on_event({"kind": "text", "t_s": round(self.now_s, 3), "text": said.rstrip("\0")})
        return messages

    def _tell(self, now_ns: int) -> None:
        """What is new since the last call."""
        autopilot = self.loop.autopilot
        if len(autopilot.vision) > 2 * _KEEP_RECORDS:
            del autopilot.vision[:_KEEP_RECORDS]
            self._told = max(0, self._told - _KEEP_RECORDS)
        if self._on_event is None:
            return
        while self._told < len(autopilot.vision):
            self._on_event(self._vision_event(autopilot.vision[self._told]))
            self._told += 1
        if now_ns >= self._next_state_ns and self.loop.samples:
            self._next_state_ns += _S
            self._on_event(self._state_event())

    def _vision_event(self, record: VisionRecord) -> Event:
        # Against the truth at the time that the autopilot took it for; of the last step, if that is now.
        truth = self.loop.truth_at(self.loop.owner_ns(record.capture_ns))
        if truth is None and self.loop.samples:
            truth = self.loop.samples[-1].truth
        off_m = None
        if truth is not None and np.isfinite(record.position_ned_m[:2]).all():
            true = self._site.autopilot_from_ned(truth.position_ned_m)
            off_m = round(float(np.hypot(*(record.position_ned_m - true)[:2])), 3)
        innovation = record.innovation_m
        return {
            "kind": "vision",
            "t_s": round(self.now_s, 3),
            "message": record.message,
            "verdict": str(record.verdict),
            "why": record.why,
            "age_ms": round((record.arrival_ns - record.capture_ns) / 1e6, 1),
            "sigma_m": round(record.sigma_m, 3),
            "innovation_m": None if innovation is None else round(innovation, 3),
            "off_m": off_m,
            "reset_counter": record.reset_counter,
        }

    def _state_event(self) -> Event:
        autopilot = self.loop.autopilot
        place = self._site.geopoint(self.loop.samples[-1].truth.position_ned_m)
        return {
            "kind": "state",
            "t_s": round(self.now_s, 3),
            "lat_deg": round(place.lat_deg, 7),
            "lon_deg": round(place.lon_deg, 7),
            "amsl_m": round(place.height_amsl_m, 2),
            "error_m": round(self.error_m, 3),
            "gnss": autopilot.gnss,
            "synchronised": autopilot.synchronised,
        }


# -- the command -------------------------------------------------------------


def as_text(event: Event) -> str:
    """One line for people."""
    start = f"{event['t_s']:8.2f} s  "
    if event["kind"] == "vision":
        parts = [f"sigma {event['sigma_m']:.2f} m", f"{event['age_ms']:.0f} ms old"]
        parts += [] if event["innovation_m"] is None else [f"innovation {event['innovation_m']:.2f} m"]
        parts += [] if event["off_m"] is None else [f"{event['off_m']:.2f} m off the truth"]
        why = f" ({event['why']})" if event["why"] else ""
        return f"{start}{event['message']} {event['verdict']}{why}: {', '.join(parts)}"
    if event["kind"] == "open":
        return f"{start}{event['firmware']} flies; a companion finds it at {event['endpoint']}"
    if event["kind"] == "text":
        return f"{start}says: {event['text']}"
    if event["kind"] == "state":
        gnss = "GNSS" if event["gnss"] else "no GNSS"
        return f"{start}its position is {event['error_m']:.2f} m off, {gnss}"
    heard = ", ".join(f"{name} {count}" for name, count in sorted(event["counts"].items()))
    return f"{start}landed; it heard {heard}"


def _arguments() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m ortholoc_sim.link",
        description="Flies a simulated vehicle in real time and speaks MAVLink 2 as its autopilot, to any companion "
        "program. Tells what it did with each position that it was sent. Ends with Ctrl-C.",
    )
    parser.add_argument(
        "--firmware", default="ardupilot-4.6", help="ardupilot-4.5 to -4.8, px4-1.14 to -1.18 (%(default)s)"
    )
    over = parser.add_mutually_exclusive_group()
    over.add_argument("--udp", metavar="[HOST:]PORT", help="listen there (default: 127.0.0.1:14550)")
    over.add_argument("--udpout", metavar="[HOST:]PORT", help="send there at once, as an autopilot behind a radio does")
    over.add_argument("--tcp", metavar="[HOST:]PORT", help="serve one companion at a time")
    over.add_argument("--pty", action="store_true", help="a pseudo-terminal, whose name is told")
    probability = within("a probability", float, 0.0, 1.0)
    line = parser.add_argument_group("the line between")
    line.add_argument(
        "--baud", type=within("a whole number", int, 0, 10_000_000), default=0, metavar="N",
        help="of a serial line; 0 is infinitely fast",
    )  # fmt: skip
    line.add_argument("--delay-ms", type=non_negative, default=0.0, metavar="MS")
    line.add_argument("--jitter-ms", type=non_negative, default=0.0, metavar="MS")
    line.add_argument("--loss", type=probability, default=0.0, metavar="P", help="probability that a frame is lost")
    line.add_argument(
        "--corruption", type=probability, default=0.0, metavar="P", help="probability of a wrong bit, per byte"
    )
    flight = parser.add_argument_group("the flight")
    flight.add_argument("--home", metavar="LAT,LON,AMSL", help="default: 48.8026,11.0033,382.7")
    flight.add_argument("--route", default="circle", metavar="FILE|circle", help="a QGC WPL 110 file, or around home")
    flight.add_argument("--airframe", choices=("multirotor", "fixed-wing"), default="multirotor")
    flight.add_argument("--speed", type=positive, metavar="M/S", help="over ground (9, a fixed wing 18)")
    flight.add_argument("--wind", default="1.5,-1", metavar="N,E", help="m/s that the air moves north and east")
    flight.add_argument("--gnss-loss-at", type=non_negative, metavar="S")
    flight.add_argument("--gnss-back-at", type=non_negative, metavar="S")
    flight.add_argument("--spoof", metavar="M/S[,DEG]", help="GNSS walks away at this speed, in this direction (90)")
    flight.add_argument("--spoof-at", type=non_negative, metavar="S", help="(30)")
    flight.add_argument("--reboot-at", type=non_negative, metavar="S", help="restart the autopilot in flight")
    flight.add_argument("--duration", type=positive, metavar="S", help="end by itself")
    pilot = parser.add_argument_group("the autopilot")
    pilot.add_argument("--stock", action="store_true", help="parameters from the factory, not set up for vision")
    pilot.add_argument("--param", action="append", default=[], metavar="NAME=VALUE")
    pilot.add_argument("--switching", choices=("script", "command"), default="script", help="of ArduPilot's source set")
    pilot.add_argument("--no-origin", action="store_true", help="without GNSS from the start: it waits for an origin")
    pilot.add_argument("--stamps", choices=("firmware", "ideal"), default="firmware")
    pilot.add_argument("--streams", action="store_true", help="send the usual messages unasked")
    pilot.add_argument("--system-id", type=within("a system id", int, 1, 255), default=1, metavar="N")
    parser.add_argument("--seed", type=seed, default=1)
    parser.add_argument("--json", action="store_true", help="one JSON object a line")
    return parser


def _numbers(text: str, what: str, least: int, most: int) -> list[float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not least <= len(numbers) <= most or not all(math.isfinite(v) for v in numbers):
        raise ConfigError(f"{what} {text!r} is not {least if least == most else f'{least} to {most}'} numbers")
    return numbers


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not port.isdigit() or not 0 <= int(port) <= 65535:
        raise ConfigError(f"address {text!r} has no port from 0 to 65535; write HOST:PORT or PORT")
    return host or "127.0.0.1", int(port)


def _events(args: argparse.Namespace) -> tuple[GnssEvent, ...]:
    if args.gnss_back_at is not None and args.gnss_loss_at is None:
        raise ConfigError("--gnss-back-at goes with --gnss-loss-at: GNSS has to be lost before it comes back")
    if args.spoof_at is not None and args.spoof is None:
        raise ConfigError("--spoof-at goes with --spoof, which says how fast GNSS walks away")
    events = []
    if args.no_origin:
        events.append(GnssEvent(kind="lost", from_s=0.0))
    if args.gnss_loss_at is not None:
        events.append(GnssEvent(kind="lost", from_s=args.gnss_loss_at, until_s=args.gnss_back_at))
    if args.spoof is not None:
        rate, *towards = _numbers(args.spoof, "--spoof", 1, 2)
        from_s = 30.0 if args.spoof_at is None else args.spoof_at
        events.append(
            GnssEvent(kind="spoofed", from_s=from_s, rate_m_s=rate, towards_deg=towards[0] if towards else 90.0)
        )
    return tuple(events)


def _parameters(pairs: list[str]) -> dict[str, float]:
    found = {}
    for pair in pairs:
        name, _, value = pair.partition("=")
        found[name] = _numbers(value, f"--param {name}", 1, 1)[0]
    return found


def spec_of(args: argparse.Namespace) -> LinkSpec:
    """Raises: ConfigError that names what can't be used."""
    over: Literal["udp", "tcp", "pty"] = "pty" if args.pty else "tcp" if args.tcp else "udp"
    home = _HOME if args.home is None else Geopoint(*_numbers(args.home, "--home", 3, 3))
    line = LineOptions(
        baud=args.baud, delay_ms=args.delay_ms, jitter_ms=args.jitter_ms, loss=args.loss, corruption=args.corruption
    )
    north, east = _numbers(args.wind, "--wind", 2, 2)
    try:
        gnss = _events(args)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    return LinkSpec(
        firmware=args.firmware,
        over=over,
        address=("127.0.0.1", 0) if args.udpout else _address(args.tcp or args.udp or "14550"),
        peer=_address(args.udpout) if args.udpout else None,
        line=None if line == PERFECT else line,
        home=home,
        route=args.route,
        airframe=args.airframe,
        speed_m_s=args.speed,
        gnss=gnss,
        wind_ned_m_s=(north, east, 0.0),
        stock=args.stock,
        parameters=_parameters(args.param),
        switching=args.switching,
        origin="none" if args.no_origin else "gnss",
        stamps=args.stamps,
        streams=args.streams,
        system_id=args.system_id,
        seed=args.seed,
    )


def main(argv: list[str] | None = None) -> int:
    """The command; returns its exit code."""
    args = _arguments().parse_args(argv)
    ended = threading.Event()

    def tell(event: Event) -> None:
        try:
            sys.stdout.write((json.dumps(event) if args.json else as_text(event)) + "\n")
            sys.stdout.flush()
        except BrokenPipeError:
            ended.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    try:
        link = SimulatedLink(spec_of(args), tell)
        line = msgspec.to_builtins(link.spec.line) if link.spec.line else {}
        tell({"kind": "open", "t_s": 0.0, "endpoint": link.endpoint, "firmware": args.firmware, "line": line})
        with link:
            restarts_s = args.reboot_at
            while not ended.wait(0.05) and not link.failed:
                if args.duration is not None and link.now_s >= args.duration:
                    break
                if restarts_s is not None and link.now_s >= restarts_s:
                    restarts_s = None
                    link.reboot()
            summary = {"kind": "end", "t_s": round(link.now_s, 3), "counts": link.counts()}
        tell(summary)
    except OSError as error:
        sys.stderr.write(f"error: address can't be had: {error}\n")
        return 1
    except OrtholocError as error:
        sys.stderr.write(f"error: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
