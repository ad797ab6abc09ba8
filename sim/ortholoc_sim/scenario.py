"""Scenarios of simulated flights: TOML files to checked values. Wrong keys and values are named with their path.

Every file holds the long form; its ``[short]`` table repeats what is smaller where there is little time, such as in CI.
docs/simulation.md describes the keys.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct, field

from ortholoc_edge.adapters.mavlink import LinkOptions
from ortholoc_edge.config import AttitudeOptions, Intrinsics, MatcherOptions, MountOptions
from ortholoc_edge.errors import ConfigError
from ortholoc_edge.pipeline.finder import SearchOptions
from ortholoc_edge.pipeline.outcome import Reason
from ortholoc_edge.pipeline.tracker import TrackerOptions
from ortholoc_edge.pipeline.witness import WitnessOptions
from ortholoc_sim.autopilot import AutopilotOptions, FilterOptions, GimbalOptions, SensorOptions, Verdict
from ortholoc_sim.autopilot.options import KNOWN
from ortholoc_sim.crossdomain import Kind
from ortholoc_sim.gnss import GnssEvent
from ortholoc_sim.line import LineOptions
from ortholoc_sim.recorded import Light

_NO_LINE = "udpout:127.0.0.1:1"
SHORT = "short"
_MOST_M, _MOST_WHOLE_M = 10_000.0, 3000.0

Positive = Annotated[float, Meta(gt=0)]
Pair = tuple[float, float]


class WorldTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[world]``: the place that is flown over: generated (`place.make_place`), or that of an area pack.

    Attributes:
        pack: folder of an area pack with a reference system and heights above sea level, or "demo", the shipped one.
            The camera sees its own orthophoto over its own surface model, in another ``light`` (`recorded`); the sizes
            and the seed are then of no use.
        kind: "place", with façades, markings and cars, drawn whole; or "country": plainer, without end, drawn where it
            is flown over, for areas up to 100 km2.
    """

    kind: Literal["place", "country"] = "place"

    pack: str | None = None
    light: Light = field(default_factory=Light)
    seed: Annotated[int, Meta(ge=0)] = 1
    width_m: Annotated[float, Meta(ge=200, le=_MOST_M)] = 1200.0
    height_m: Annotated[float, Meta(ge=200, le=_MOST_M)] = 1000.0
    gsd_m: Annotated[float, Meta(ge=0.05, le=1)] = 0.25

    def __post_init__(self) -> None:
        if self.kind == "place" and max(self.width_m, self.height_m) > _MOST_WHOLE_M:
            raise ValueError(
                f"{self.width_m:g} x {self.height_m:g} m of a place, which is drawn whole: at most {_MOST_WHOLE_M:g} m "
                'each; kind = "country" goes up to 100 km2'
            )


class MapTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[map]``: the area pack that the daemon has.

    Attributes:
        kind: what lies between map and flight, see `crossdomain.Kind`.
        world_seed: of another place, laid where this one is: the wrong pack. None: the world's own.
        mirrored: east and west exchanged.
        height_error_m: added to the surface model's heights: a mistaken datum.
        hole_m: west, south, east, north in m from the world's corner, where the surface model has no heights.
        damaged: share of the pack's tiles whose bytes are wrong.
    """

    kind: Kind = Kind.SAME
    world_seed: Annotated[int, Meta(ge=0)] | None = None
    mirrored: bool = False
    height_error_m: float = 0.0
    hole_m: tuple[float, float, float, float] | None = None
    damaged: Annotated[float, Meta(ge=0, le=1)] = 0.0


class RouteTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[route]``: ``waypoints_m`` are (east, north) from the world's south-west corner, corners rounded with
    ``corner_radius_m`` where their legs have room for it: at 12 m/s a vehicle that accelerates at 2.5 m/s2 can't fly a
    tighter one than 58 m. The flight begins at the first, ``climb_m`` below the height of flight, and ends after
    ``duration_s``, or with the route if that is left out."""

    waypoints_m: Annotated[tuple[Pair, ...], Meta(min_length=2)]
    height_agl_m: Positive = 120.0
    speed_m_s: Positive = 12.0
    climb_m: Annotated[float, Meta(ge=0)] = 20.0
    corner_radius_m: Annotated[float, Meta(ge=0)] = 120.0
    duration_s: Positive | None = None


class WindTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[wind]``: where from (degrees from north), how fast, and 1-sigma of its gusts."""

    from_deg: float = 250.0
    speed_m_s: Annotated[float, Meta(ge=0, le=30)] = 5.0
    gust_m_s: Annotated[float, Meta(ge=0, le=10)] = 0.6


class CameraTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[camera]``: the one on board.

    Attributes:
        rate_hz: of frames. delay_ms: from mid-exposure until a frame is there.
        noise, blur_px, vignetting, gain, jpeg_quality: flaws, see `camera.Sensor`.
        exposure_ms: of the shutter, which smears. readout_ms: of a rolling shutter, first row to last; 0: a global one.
    """

    width_px: Annotated[int, Meta(ge=64, le=4096)] = 640
    height_px: Annotated[int, Meta(ge=64, le=4096)] = 480
    focal_px: Positive = 540.0
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    rate_hz: Annotated[float, Meta(gt=0, le=60)] = 2.0
    delay_ms: Annotated[float, Meta(ge=0, le=2000)] = 40.0
    noise: Annotated[float, Meta(ge=0)] = 2.5
    blur_px: Annotated[float, Meta(ge=0)] = 0.6
    vignetting: Annotated[float, Meta(ge=0, le=1)] = 0.22
    gain: Positive = 1.0
    jpeg_quality: Annotated[int, Meta(ge=0, le=100)] = 88
    exposure_ms: Annotated[float, Meta(ge=0, le=1000)] = 2.0
    readout_ms: Annotated[float, Meta(ge=0, le=200)] = 0.0

    def intrinsics(self) -> Intrinsics:
        return Intrinsics(
            width_px=self.width_px, height_px=self.height_px, fx=self.focal_px, fy=self.focal_px,
            cx=(self.width_px - 1) / 2, cy=(self.height_px - 1) / 2, distortion=self.distortion,
        )  # fmt: skip


class MiscalibrationTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[miscalibration]``: by how much the camera is other than the daemon is told, for `calibrate-flight` to find.

    Attributes:
        mount_deg: roll, pitch, yaw: what is missing in those of ``[mount]``.
        stamp_late_ms: frames are stamped so long after mid-exposure: what is missing in the daemon's ``latency_ms``.
        focal: the focal length is longer by this part than the daemon's.
    """

    mount_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    stamp_late_ms: Annotated[float, Meta(ge=-500, le=500)] = 0.0
    focal: Annotated[float, Meta(gt=-0.5, lt=1.0)] = 0.0

    def told(self, intrinsics: Intrinsics) -> Intrinsics:
        """What the daemon is told of the intrinsics as they are."""
        longer = 1.0 + self.focal
        return msgspec.structs.replace(intrinsics, fx=intrinsics.fx / longer, fy=intrinsics.fy / longer)

    def true_mount(self, told: MountOptions) -> MountOptions:
        """How the camera sits, of what the daemon is told."""
        roll, pitch, yaw = self.mount_deg
        return msgspec.structs.replace(
            told, roll_deg=told.roll_deg + roll, pitch_deg=told.pitch_deg + pitch, yaw_deg=told.yaw_deg + yaw
        )


class GimbalTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[gimbal]``: see `autopilot.GimbalOptions`; goes with ``[mount] gimbal``."""

    pitch_deg: float = -50.0
    sweep_deg: float = 10.0
    sweep_s: Positive = 12.0
    yaw_deg: float = 0.0
    delay_ms: Annotated[float, Meta(ge=0)] = 30.0
    error_deg: Pair = (0.3, -0.4)

    def options(self) -> GimbalOptions:
        return GimbalOptions(self.pitch_deg, self.sweep_deg, self.sweep_s, self.yaw_deg, self.delay_ms, self.error_deg)


class AutopilotTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[autopilot]``: who flies.

    Attributes:
        stack, firmware: whose rules, of which version; None: the newest known. switching: see
            `autopilot.AutopilotOptions`.
        stamps, viso_delay_ms: see `autopilot.FilterOptions`; PX4 has "timesync" whatever is written.
        yaw_error_deg: constant, of the heading that it believes. system_id: its own.
    """

    stack: Literal["ardupilot", "px4"] = "ardupilot"
    firmware: tuple[int, int, int] | None = None
    switching: Literal["script", "command"] = "script"

    stamps: Literal["timesync", "jitter"] = "jitter"
    viso_delay_ms: Annotated[float, Meta(ge=0, le=250)] = 10.0
    yaw_error_deg: float = 2.0
    acceleration_bias: Annotated[float, Meta(ge=0)] = SensorOptions().acceleration_bias
    system_id: Annotated[int, Meta(ge=1, le=255)] = 1

    def __post_init__(self) -> None:
        # Its own checks name what can't be simulated; msgspec adds the table.
        self.options(0, None)

    def options(self, seed: int, gimbal: GimbalOptions | None) -> AutopilotOptions:
        oldest_and_newest = KNOWN[self.stack]
        return AutopilotOptions(
            seed=seed,
            system_id=self.system_id,
            firmware=self.firmware or (*oldest_and_newest[1], 0),
            sensors=SensorOptions(yaw_bias_deg=self.yaw_error_deg, acceleration_bias=self.acceleration_bias),
            filter=FilterOptions(
                stamps="timesync" if self.stack == "px4" else self.stamps,
                viso_delay_ms=self.viso_delay_ms,
                # It was synchronised before the flight began: 50 s of it would be the shorter part.
                converged_after=0,
            ),
            gimbal=gimbal,
            stack=self.stack,
            switching=self.switching,
        )


class LatencyTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[latency]``: how long the simulated computer takes for a frame: log-normal. The defaults are like the measured
    ones of docs/benchmarks.md; ``hypothesis_ms``: for each further place that a prior allows; ``search_ms``: of the
    whole map, beside the frames."""

    median_ms: Positive = 180.0
    p99_ms: Positive = 420.0
    hypothesis_ms: Annotated[float, Meta(ge=0)] = 60.0
    search_ms: Annotated[float, Meta(ge=0)] = 3000.0

    def __post_init__(self) -> None:
        if self.p99_ms < self.median_ms:
            raise ValueError(f"p99_ms = {self.p99_ms:g} is below median_ms = {self.median_ms:g}")


class TimingTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[timing]``: of the daemon. It has no ``budget_ms``, since wall time must not decide here."""

    max_age_ms: Positive = 1000.0


FaultKind = Literal[
    "camera_stalls", "frames_black", "frames_duplicated", "frames_out_of_order", "frames_late", "frames_frozen",
    "frames_of_water", "line_down", "autopilot_mute", "autopilot_reboots", "clock_steps", "computer_slow",
    "daemon_killed",
]  # fmt: skip


class Fault(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One of ``[[fault]]``.

    Attributes:
        from_s, until_s: since the start of the flight; without an end it lasts.
            "daemon_killed" ends with a new daemon, which knows nothing of the first.
        amount: of "frames_late" the delay in ms, of "clock_steps" the step in ms, of "computer_slow" the factor.
    """

    kind: FaultKind
    from_s: Annotated[float, Meta(ge=0)] = 0.0
    until_s: Annotated[float, Meta(gt=0)] | None = None
    amount: Positive | None = None

    def __post_init__(self) -> None:
        if self.until_s is not None and self.until_s <= self.from_s:
            raise ValueError(f"until_s = {self.until_s:g} is not after from_s = {self.from_s:g}")
        wants = self.kind in ("frames_late", "clock_steps", "computer_slow")
        if wants != (self.amount is not None):
            raise ValueError(f"kind {self.kind!r} {'needs an' if wants else 'takes no'} amount")

    def holds(self, t_s: float) -> bool:
        """Whether it is on at a time since the start."""
        return self.from_s <= t_s and (self.until_s is None or t_s < self.until_s)


class Expectations(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[expect]``: what must come of it.

    Attributes:
        route_p95_m: limit of the true horizontal distance from the route, 95th percentile, since the first GNSS event.
        lost_m: the vehicle must have been at least so far from where it believed it was.
        back_within_s: after the last fault has ended the autopilot must know within so long where it is, to 10 m, and
            for good.
        resets: how often the autopilot must be told that estimates start anew; the first one counts for nothing.
        false_fixes: most of them.
        fixed: least and most share of the frames that give a fix.
        nees: least and most of the mean NEES over its degrees of freedom.
        reasons: rejections that must occur. says, says_not: parts of STATUSTEXT that must, and must not.
        verdicts: of the autopilot's filter on what it received that must occur; fused: least share of it taken in
            while vision was in use.
    """

    route_p95_m: Positive | None = None
    lost_m: Positive | None = None
    back_within_s: Positive | None = None
    resets: Annotated[int, Meta(ge=0)] | None = None
    false_fixes: Annotated[int, Meta(ge=0)] = 0
    fixed: tuple[Annotated[float, Meta(ge=0, le=1)], Annotated[float, Meta(ge=0, le=1)]] = (0.0, 1.0)
    nees: tuple[Annotated[float, Meta(ge=0)], Annotated[float, Meta(gt=0)]] | None = None
    reasons: tuple[Reason, ...] = ()
    says: tuple[str, ...] = ()
    says_not: tuple[str, ...] = ()
    verdicts: tuple[Verdict, ...] = ()
    fused: Annotated[float, Meta(ge=0, le=1)] | None = None


class Scenario(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One file; tables are described at their classes.

    Attributes:
        name: of the file. title: one line for people.
        fixes: whether the companion works at all; False shows what becomes of the flight without it.
        search: of the daemon; off unless a file says otherwise, so that each flight shows what the tracker does alone.
    """

    name: str
    title: Annotated[str, Meta(min_length=1)]
    route: RouteTable
    fixes: bool = True
    matcher: MatcherOptions = field(default_factory=MatcherOptions)
    world: WorldTable = field(default_factory=WorldTable)
    map: MapTable = field(default_factory=MapTable)
    wind: WindTable = field(default_factory=WindTable)
    camera: CameraTable = field(default_factory=CameraTable)
    mount: MountOptions = field(default_factory=MountOptions)
    miscalibration: MiscalibrationTable = field(default_factory=MiscalibrationTable)
    gimbal: GimbalTable | None = None
    autopilot: AutopilotTable = field(default_factory=AutopilotTable)
    line: LineOptions = field(default_factory=LineOptions)
    link: LinkOptions = field(default_factory=lambda: LinkOptions(endpoint=_NO_LINE))
    latency: LatencyTable = field(default_factory=LatencyTable)
    timing: TimingTable = field(default_factory=TimingTable)
    tracker: TrackerOptions = field(default_factory=TrackerOptions)
    witness: WitnessOptions = field(default_factory=WitnessOptions)
    attitude: AttitudeOptions = field(default_factory=AttitudeOptions)
    search: SearchOptions = field(default_factory=lambda: SearchOptions(enabled=False))
    gnss: tuple[GnssEvent, ...] = ()
    fault: tuple[Fault, ...] = ()
    expect: Expectations = field(default_factory=Expectations)

    def __post_init__(self) -> None:
        if (self.mount.gimbal != "none") != (self.gimbal is not None):
            raise ValueError(
                f"[mount] gimbal = {self.mount.gimbal!r} {'without' if self.gimbal is None else 'with'} a [gimbal] "
                "table; one goes with the other"
            )
        if self.gimbal is not None and any(fault.kind in ("clock_steps", "autopilot_reboots") for fault in self.fault):
            raise ValueError("a [gimbal] moves by the autopilot's clock: not with clock_steps or autopilot_reboots")
        if self.world.pack is not None:
            # Its size is the pack's: `stage.make_grounds` looks.
            if self.map != MapTable():
                raise ValueError("[map] is of generated worlds; over [world] pack the map is that pack")
            return
        if self.world.kind == "country" and self.map != MapTable(kind=self.map.kind, damaged=self.map.damaged):
            raise ValueError('over a world of kind "country" only [map] kind and damaged can be set')
        for east, north in self.route.waypoints_m:
            if not (0 <= east <= self.world.width_m and 0 <= north <= self.world.height_m):
                raise ValueError(
                    f"waypoint ({east:g}, {north:g}) lies outside the world of {self.world.width_m:g} x "
                    f"{self.world.height_m:g} m"
                )


def shipped() -> dict[str, Path]:
    """The scenarios that come with the package, by name."""
    return {path.stem: path for path in sorted((Path(__file__).parent / "scenarios").glob("*.toml"))}


def find_scenario(name: str) -> Path:
    """The file of a shipped scenario's name, or the file itself. Raises: ConfigError if there is neither."""
    known = shipped()
    if name in known:
        return known[name]
    if Path(name).is_file():
        return Path(name)
    raise ConfigError(f"scenario {name!r}: neither a file nor one of {', '.join(known)}")


def read_scenario(path: Path, short: bool = False) -> Scenario:
    """Parse and check a file.

    Args:
        short: with what its ``[short]`` table replaces.
    Raises: ConfigError naming the file and the key.
    """
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as err:
        raise ConfigError(f"{path}: can't be read ({err})") from err
    except tomllib.TOMLDecodeError as err:
        raise ConfigError(f"{path}: not TOML: {err}") from err
    smaller = raw.pop(SHORT, None)
    if short:
        if not isinstance(smaller, dict):
            raise ConfigError(f"{path}: has no [short] table, so there is no short form of it")
        raw = _merged(raw, smaller)
    return _converted(path, raw)


def _converted(path: Path, raw: dict[str, Any]) -> Scenario:
    if "name" in raw:
        raise ConfigError(f"{path}: `$.name`: a scenario's name is its file's")
    baud = raw.get("line", {}).get("baud", 0) if isinstance(raw.get("line"), dict) else 0
    if isinstance(raw.setdefault("link", {}), dict):
        if "endpoint" in raw["link"]:
            raise ConfigError(f"{path}: `$.link.endpoint`: the simulated line is in [line]")
        raw["link"]["endpoint"] = f"serial:/dev/simulated:{baud}" if isinstance(baud, int) and baud else _NO_LINE
        # What a computer tells of its load is not the same twice.
        raw["link"].setdefault("computer_status_rate_hz", 0.0)
    try:
        return msgspec.convert({**raw, "name": path.stem}, Scenario)
    except msgspec.ValidationError as err:
        raise ConfigError(f"{path}: {err}; docs/simulation.md has what is allowed") from err


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Tables are merged key by key, all else is replaced."""
    both = dict(base)
    for key, value in over.items():
        before = both.get(key)
        both[key] = _merged(before, value) if isinstance(before, dict) and isinstance(value, dict) else value
    return both
