"""What is said on the bus: each payload is one of these, as JSON or MessagePack, and `schema` is about all of them.

Stamps: ``stamp_ns`` is of the daemon's monotonic clock, which orders events on this computer; ``unix_ns`` is the same
moment as the system's date has it, which is wrong where the clock was never set.
"""

from __future__ import annotations

import json
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta, Struct

from ortholoc_edge.geometry import covariance as cov
from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.frame import CameraMount
from ortholoc_edge.pipeline.outcome import Fix, Rejected
from ortholoc_edge.tiles.georeference import Georeference

Statistic = int | float | str | bool | None

# Encodings' names on the wire; zenoh knows no MessagePack by itself.
JSON, MSGPACK = "application/json", "application/msgpack"


class PoseMessage(Struct, frozen=True, kw_only=True):
    """A pose on the earth; east, north, up are true axes at the place.

    Attributes:
        lat_deg, lon_deg: WGS 84.
        height_amsl_m, height_ellipsoid_m: None where the pack's vertical datum does not give it.
        quaternion_enu_wxyz: takes the axes of the thing (a camera's right, down, forward; a body's forward, right,
            down) to east, north, up.
        covariance_enu: 6 rows of 6: position, m²; then the rotation vector about east, north, up, rad²:
            ``R_true = exp(d) @ R_estimated``.
    """

    lat_deg: float
    lon_deg: float
    height_amsl_m: float | None
    height_ellipsoid_m: float | None
    quaternion_enu_wxyz: tuple[float, float, float, float]
    covariance_enu: list[list[float]]


class FixMessage(Struct, frozen=True, kw_only=True):
    """``…/fix``: where a frame was taken.

    Attributes:
        stamp_ns, unix_ns: of mid-exposure.
        crs: of the map, ``EPSG:…``; position_map_m: of the camera, easting, northing, height in it.
        quaternion_map_from_camera_wxyz: camera axes right, down, forward; map axes grid east, grid north, up.
        covariance: 6 rows of 6, as `PoseMessage.covariance_enu`, but in map axes.
        protection_m: horizontal and vertical protection level.
        camera: the same pose on the earth. body: the vehicle's, through mount and lever arm; None where the gimbal's
            attitude was not known.
        quality: 0..1. matches, inliers: counts. rms_px: of the inliers. adhop_accepted: None where it was not run.
            stored_features: whether the pack's gave the pose. focal_px, focal_sigma_px: of the camera, sigma only of
            a calibrated one.
        timings_ms: per stage.
    """

    stamp_ns: int
    unix_ns: int
    crs: str | None
    position_map_m: tuple[float, float, float]
    quaternion_map_from_camera_wxyz: tuple[float, float, float, float]
    covariance: list[list[float]]
    protection_m: tuple[float, float]
    camera: PoseMessage
    body: PoseMessage | None
    quality: float
    matches: int
    inliers: int
    rms_px: float
    adhop_accepted: bool | None
    stored_features: bool
    focal_px: float
    focal_sigma_px: float | None
    timings_ms: dict[str, float]


class RejectionMessage(Struct, frozen=True, kw_only=True):
    """``…/rejection``: a frame that gave no fix, and why. ``measured`` against ``limit`` where the test is a number."""

    stamp_ns: int
    unix_ns: int
    reason: str
    detail: str
    measured: float | None
    limit: float | None
    timings_ms: dict[str, float]


class StateMessage(Struct, frozen=True, kw_only=True):
    """``…/state``: what the daemon is about, once a second and after each command.

    Attributes:
        status: "track", "coast" or "search". paused: by command; then no frame is localized.
        last_fix_age_s: None before the first. last_reason: why the last frame was rejected; None if it was a fix.
        rung: 0 is all detail and all frames, see `LadderMessage`. reset_counter: as told to the autopilot.
        search: what came of the last search of the map, for people; None where it is switched off.
        gnss: "ok", "suspect", "bad" or "unknown": whether it agrees with the fixes.
        autopilot: whether its heart beats. commands: whether any is accepted.
    """

    stamp_ns: int
    unix_ns: int
    status: str
    paused: bool
    last_fix_age_s: float | None
    last_reason: str | None
    rung: int
    reset_counter: int
    search: str | None
    gnss: str
    autopilot: bool
    commands: bool


class HealthMessage(Struct, frozen=True, kw_only=True):
    """``…/health``: how program and computer fare, once a second.

    Attributes:
        uptime_s: of the daemon.
        fixes, rejected, replaced: frames since the start; replaced ones were never looked at. fixes_per_s: since the
            last message. sent: messages with an estimate that the autopilot was sent.
        cpu_percent: of each core since the last message. rss_mib: of the daemon. memory_used_mib, memory_total_mib:
            of the computer. temperatures_c: of its thermal zones.
        under_voltage, throttled, hot: as the board says it.
        map_files_damaged: holes in the map. log_dropped, bus_dropped: what could not be written, or published.
    """

    stamp_ns: int
    unix_ns: int
    uptime_s: float
    fixes: int
    rejected: int
    replaced: int
    fixes_per_s: float
    sent: int
    cpu_percent: tuple[float, ...]
    rss_mib: float
    memory_used_mib: int
    memory_total_mib: int
    temperatures_c: tuple[float, ...]
    under_voltage: bool
    throttled: bool
    hot: bool
    map_files_damaged: int
    log_dropped: int
    bus_dropped: int


class AutopilotMessage(Struct, frozen=True, kw_only=True):
    """``…/autopilot``: what became of the fixes there, once a second.

    Attributes:
        connected: whether its heart beats.
        fusion: "fused", "ignored", "rejected" or "unknown": what its filter does with the fixes. fusion_since_s: for
            how long; None if never otherwise. fusion_reason: probably why.
        gnss: "ok", "suspect", "bad" or "unknown": whether GNSS agrees with the fixes. gnss_since_s: for how long.
            gnss_apart_m: horizontal, at the last fix. gnss_height_apart_m: where heights differ by a constant that
            looks like a datum's, by how much GNSS is higher.
        latency_median_ms, latency_p99_ms: from mid-exposure to sent. delay_advice: parameters to set, for people.
        on_vision: whether we commanded the source set of vision.
    """

    stamp_ns: int
    unix_ns: int
    connected: bool
    fusion: str
    fusion_since_s: float | None
    fusion_reason: str
    gnss: str
    gnss_since_s: float | None
    gnss_apart_m: float | None
    gnss_height_apart_m: float | None
    latency_median_ms: float | None
    latency_p99_ms: float | None
    delay_advice: str | None
    on_vision: bool


class LadderMessage(Struct, frozen=True, kw_only=True):
    """``…/ladder``: a step to less detail or fewer frames, or back, when it is taken.

    Attributes:
        rung, was: now and before; 0 is all detail and all frames. rungs: how many there are, the first ``details`` of
            which are of detail, the others of rate.
        rate_hz: how many frames a second are localized at most; None: all that there is time for.
        cause: "time", "load", "heat", "room" (for more), "reload". why: the same for people, with the numbers.
    """

    stamp_ns: int
    unix_ns: int
    rung: int
    was: int
    rungs: int
    details: int
    rate_hz: float | None
    cause: str
    why: str


class ConfigMessage(Struct, frozen=True, kw_only=True):
    """``…/config``, to be asked for: the configuration in force, defaults included, without what is secret."""

    config: dict[str, Any]


class StatsMessage(Struct, frozen=True, kw_only=True):
    """``…/stats``, to be asked for: all counters since the start, as in the log and at the end of a run."""

    stamp_ns: int
    unix_ns: int
    statistics: dict[str, Statistic]


# -- commands ------------------------------------------------------------------------------------------


class _Command(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    # For whoever addresses many: where it is given, it has to be this vehicle's.
    vehicle: str | None = None


class Relocalize(_Command, frozen=True, kw_only=True):
    """``…/command/relocalize``: forget the chain of fixes and search anew, from GNSS or where the autopilot believes.

    Attributes:
        trust_gnss: forget also that GNSS contradicted the fixes. Otherwise it steers nothing while it does.
    """

    trust_gnss: bool = False


class SetPrior(_Command, frozen=True, kw_only=True):
    """``…/command/set_prior``: search here, now.

    Attributes:
        lat_deg, lon_deg, height_amsl_m: of the vehicle, WGS 84 and above mean sea level.
        sigma_horizontal_m, sigma_vertical_m: 1-sigma (per axis); the wider, the longer the search takes.
    """

    lat_deg: Annotated[float, Meta(ge=-90, le=90)]
    lon_deg: Annotated[float, Meta(ge=-180, le=180)]
    height_amsl_m: Annotated[float, Meta(ge=-500, le=10_000)]
    sigma_horizontal_m: Annotated[float, Meta(ge=1, le=500)]
    sigma_vertical_m: Annotated[float, Meta(ge=1, le=500)]


Latitude = Annotated[float, Meta(ge=-90, le=90)]
Longitude = Annotated[float, Meta(ge=-180, le=180)]


class SearchFor(_Command, frozen=True, kw_only=True):
    """``…/command/search``: search the map at once, without regard to where the vehicle is believed to be.

    Attributes:
        polygon: corners (latitude, longitude) on WGS 84, degrees, of the area where the vehicle is; nowhere else is
            searched until it was found there. None: anywhere on the map, and a polygon given before is forgotten.
    """

    polygon: Annotated[tuple[tuple[Latitude, Longitude], ...], Meta(min_length=3, max_length=100)] | None = None


class Pause(_Command, frozen=True, kw_only=True):
    """``…/command/pause``: localize no more frames, send nothing to the autopilot."""


class Resume(_Command, frozen=True, kw_only=True):
    """``…/command/resume``: end a pause."""


class Snapshot(_Command, frozen=True, kw_only=True):
    """``…/command/snapshot``: write the last frame and what it came to into a file on the vehicle."""


Command = Relocalize | SetPrior | SearchFor | Pause | Resume | Snapshot


class CommandReply(Struct, frozen=True, kw_only=True):
    """What every command is answered with.

    Attributes:
        accepted: it was done, or takes effect with the next frame.
        reason, remedy: why not, and what to do about it; empty if it was.
        path: on the vehicle, of what was written.
    """

    command: str
    accepted: bool
    reason: str = ""
    remedy: str = ""
    path: str | None = None


PUBLISHED: dict[str, type[Struct]] = {
    "fix": FixMessage,
    "rejection": RejectionMessage,
    "state": StateMessage,
    "health": HealthMessage,
    "autopilot": AutopilotMessage,
    "ladder": LadderMessage,
}
Published = FixMessage | RejectionMessage | StateMessage | HealthMessage | AutopilotMessage | LadderMessage
ASKED: dict[str, type[Struct]] = {"config": ConfigMessage, "stats": StatsMessage}
COMMANDS: dict[str, type[Command]] = {
    "relocalize": Relocalize,
    "set_prior": SetPrior,
    "search": SearchFor,
    "pause": Pause,
    "resume": Resume,
    "snapshot": Snapshot,
}
NAME_OF_COMMAND: dict[type[Command], str] = {kind: name for name, kind in COMMANDS.items()}


def schema() -> dict[str, Any]:
    """JSON Schema of every payload, and which belongs to which key."""
    kinds: list[type[Struct]] = [*PUBLISHED.values(), *ASKED.values(), *COMMANDS.values(), CommandReply]
    _, components = msgspec.json.schema_components(kinds, ref_template="#/$defs/{name}")

    def reference(kind: type[Struct]) -> dict[str, str]:
        return {"$ref": f"#/$defs/{kind.__name__}"}

    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "ortholoc-edge on zenoh",
        "description": "Keys begin with ortholoc/<vehicle>/. Each payload is JSON (application/json) or the same as "
        "MessagePack (application/msgpack), as the encoding says.",
        "x-published": {name: reference(kind) for name, kind in PUBLISHED.items()},
        "x-asked": {name: reference(kind) for name, kind in ASKED.items()},
        "x-commands": {
            f"command/{name}": {"request": reference(kind), "reply": reference(CommandReply)}
            for name, kind in COMMANDS.items()
        },
        "$defs": components,
    }


def schema_text() -> str:
    """`schema` as it is published."""
    return json.dumps(schema(), indent=2, ensure_ascii=False) + "\n"


# -- outcomes as messages ------------------------------------------------------------------------------


def fix_message(fix: Fix, unix_ns: int, georeference: Georeference, mount: CameraMount | None) -> FixMessage:
    """A fix for others.

    Args:
        mount: how the camera sat on the body at the exposure; None where that is not known.
    """
    pose = fix.map_from_camera
    turn = frames.ENU_FROM_NED @ frames.map_from_ned_rotation(georeference.convergence_rad(pose.translation[:2])).T
    body = None
    if mount is not None:
        map_from_body = pose @ mount.body_from_camera.inverse()
        covariance = cov.of_moved_point(fix.covariance, map_from_body.translation - pose.translation)
        covariance[3:, 3:] += cov.turn(mount.sigma_rad)
        body = _located(map_from_body, covariance, georeference, turn)
    x, y, z = pose.translation.tolist()
    return FixMessage(
        stamp_ns=fix.stamp_ns,
        unix_ns=unix_ns,
        crs=georeference.crs,
        position_map_m=(x, y, z),
        quaternion_map_from_camera_wxyz=_quaternion(pose.rotation),
        covariance=fix.covariance.tolist(),
        protection_m=fix.protection_m,
        camera=_located(pose, fix.covariance, georeference, turn),
        body=body,
        quality=fix.quality,
        matches=fix.matches,
        inliers=fix.inliers,
        rms_px=fix.rms_px,
        adhop_accepted=fix.adhop_accepted,
        stored_features=fix.stored_features,
        focal_px=fix.camera.focal_px,
        focal_sigma_px=fix.focal_sigma_px,
        timings_ms=fix.timings_ms,
    )


def rejection_message(rejected: Rejected, unix_ns: int) -> RejectionMessage:
    """A rejection for others."""
    return RejectionMessage(
        stamp_ns=rejected.stamp_ns,
        unix_ns=unix_ns,
        reason=str(rejected.reason),
        detail=rejected.detail,
        measured=rejected.measured,
        limit=rejected.limit,
        timings_ms=rejected.timings_ms,
    )


def _located(pose: Rigid3, covariance: FloatArray, georeference: Georeference, enu_from_map: FloatArray) -> PoseMessage:
    place = georeference.geodetic_from_map(pose.translation)
    return PoseMessage(
        lat_deg=place.lat_deg,
        lon_deg=place.lon_deg,
        height_amsl_m=place.height_amsl_m,
        height_ellipsoid_m=place.height_ellipsoid_m,
        quaternion_enu_wxyz=_quaternion(enu_from_map @ pose.rotation),
        covariance_enu=cov.rotated(covariance, enu_from_map).tolist(),
    )


def _quaternion(turn: FloatArray) -> tuple[float, float, float, float]:
    w, x, y, z = np.asarray(rotation.to_quaternion(turn), dtype=np.float64).tolist()
    return w, x, y, z
