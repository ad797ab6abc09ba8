"""The daemon's configuration: TOML to checked values. Wrong keys and values are named with their path."""

from __future__ import annotations

import difflib
import json
import math
import re
import tomllib
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta, Struct, field

from ortholoc_edge.adapters.bus import BusOptions
from ortholoc_edge.adapters.camera import CameraOptions
from ortholoc_edge.adapters.flight_log import LogOptions
from ortholoc_edge.adapters.mavlink import GimbalSelection, LinkOptions
from ortholoc_edge.adapters.page.options import PageOptions
from ortholoc_edge.adapters.page.options import refused as page_refused
from ortholoc_edge.adapters.secret import LEFT_OUT, without_credentials
from ortholoc_edge.calibration.files import read_camera
from ortholoc_edge.errors import ConfigError
from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.matching.providers import ProviderName
from ortholoc_edge.matching.types import STRUCTURAL
from ortholoc_edge.pipeline.finder import SearchOptions
from ortholoc_edge.pipeline.ladder import LadderOptions
from ortholoc_edge.pipeline.localizer import LocalizerOptions
from ortholoc_edge.pipeline.navigator import TimingOptions
from ortholoc_edge.pipeline.picture import PictureOptions
from ortholoc_edge.pipeline.tracker import TrackerOptions
from ortholoc_edge.pipeline.witness import WitnessOptions

# The coarsest level of XFeat's network is at 1/32.
_XFEAT_MULTIPLE_PX = 32


class Intrinsics(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A pinhole camera with OpenCV's distortion (k1, k2, p1, p2, k3); pixel centres at integers.

    Attributes:
        file, file_camera: where the others were read from, and which of its cameras, if they were (`read_config`). A
            configuration that is kept, in a flight log, say, has what the file said then, and needs it no more.
    """

    file: Annotated[str, Meta(min_length=1)] | None = None
    file_camera: Annotated[str, Meta(min_length=1)] | None = None
    width_px: Annotated[int, Meta(ge=16)]
    height_px: Annotated[int, Meta(ge=16)]
    fx: Annotated[float, Meta(gt=0)]
    fy: Annotated[float, Meta(gt=0)]
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        # Built once here: msgspec names the table, and nothing fails later in the air.
        self.camera()

    def camera(self) -> Camera:
        return Camera(self.width_px, self.height_px, self.fx, self.fy, self.cx, self.cy, self.distortion)


# What may stand beside ``file``: which of its cameras, and the size where the file does not say it.
_BESIDE_FILE = frozenset({"file", "file_camera", "width_px", "height_px"})


class MountOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the camera sits on the vehicle, or in a gimbal on it.

    Attributes:
        preset: one of `frames.MOUNTS`. "nadir-nose-up": straight down, image top toward the nose; so also
            "nadir-right-up", "nadir-tail-up", "nadir-left-up". "forward": along the nose, level; in a gimbal, along
            its line of sight.
        roll_deg, pitch_deg, yaw_deg: the mount is turned by these from the preset, about the body's axes (the
            gimbal's), as ZYX angles. A camera that looks forward and down by 60 degrees is "forward" with
            pitch_deg = -60.
        lever_arm_m: of the camera from the body's reference point: forward, right, down. With a gimbal: of the point
            that it turns about.
        gimbal: "none": a fixed mount. "auto": the one that is heard. "device": the one of ``gimbal_device``.
        gimbal_device: MAVLink's gimbal device id, see `GimbalSelection.device`.
        gimbal_delay_ms: a report tells the attitude of so long before its stamp.
        gimbal_max_age_ms: a frame farther than this from the nearest report has no attitude, and gives no fix.
        gimbal_sigma_deg: 1-sigma of the gimbal's own tilt and heading, at rest; while it turns more is added for
            what its reports' times are worth.
        gimbal_arm_m: the camera from the point that the gimbal turns about, in the gimbal's axes: forward along the
            line of sight, right, down.
    """

    preset: str = "nadir-nose-up"
    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0
    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gimbal: Literal["none", "auto", "device"] = "none"
    gimbal_device: Annotated[int, Meta(ge=1, le=255)] | None = None
    gimbal_delay_ms: Annotated[float, Meta(ge=0, le=500)] = 0.0
    gimbal_max_age_ms: Annotated[float, Meta(gt=0, le=2000)] = 200.0
    gimbal_sigma_deg: tuple[Annotated[float, Meta(gt=0)], Annotated[float, Meta(gt=0)]] = (1.0, 2.0)
    gimbal_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if self.preset not in frames.MOUNTS:
            raise ValueError(f"preset {self.preset!r} is no mount; write one of {', '.join(frames.MOUNTS)}")
        if self.gimbal != "none" and self.preset != "forward":
            raise ValueError(
                f"preset {self.preset!r} with a gimbal: a gimbal looks forward when its angles are zero and tells by "
                'its pitch that it looks down; write preset = "forward"'
            )
        if (self.gimbal == "device") != (self.gimbal_device is not None):
            raise ValueError(
                f"gimbal = {self.gimbal!r} with gimbal_device = {self.gimbal_device}: the number goes with "
                '"device" and only with it'
            )
        if self.gimbal == "none" and any(self.gimbal_arm_m):
            raise ValueError(f"gimbal_arm_m = {list(self.gimbal_arm_m)} without a gimbal; put it into lever_arm_m")

    def body_from_camera(self) -> Rigid3:
        """Of a fixed mount; of a camera in a gimbal see :meth:`body_from_camera_in`."""
        return Rigid3(self._turn(), np.array(self.lever_arm_m))

    def body_from_camera_in(self, body_from_gimbal: FloatArray) -> Rigid3:
        """Of a camera in a gimbal whose axes stand so (3, 3)."""
        pivot = Rigid3(body_from_gimbal, np.array(self.lever_arm_m))
        return pivot @ Rigid3(self._turn(), np.array(self.gimbal_arm_m))

    def gimbal_selection(self) -> GimbalSelection | None:
        """What the link needs to know of the gimbal; None without one."""
        if self.gimbal == "none":
            return None
        return GimbalSelection(
            self.gimbal_device, round(self.gimbal_delay_ms * 1e6), round(self.gimbal_max_age_ms * 1e6)
        )

    def _turn(self) -> FloatArray:
        turn = rotation.from_euler(
            math.radians(self.roll_deg), math.radians(self.pitch_deg), math.radians(self.yaw_deg)
        )
        return np.asarray(turn @ frames.MOUNTS[self.preset], dtype=np.float64)


class MapOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which area pack, and how much memory it may take.

    ``memory_mb``: limit of its compressed files, which all are held; a larger pack is refused at the start.
    ``cache_mb``: limit of decoded blocks, in grey and heights, besides; a view of structural matching takes 4 to 6,
    one of features up to 14.
    ``require_intact``: refuse a pack with missing or damaged files instead of flying with holes in the map.
    ``public_key``: PEM file; refuse a pack that this key did not sign. None: a signature is not looked for.
    """

    pack: str
    cache_mb: Annotated[int, Meta(ge=1)] = 8
    memory_mb: Annotated[int, Meta(ge=1)] = 768
    require_intact: bool = False
    public_key: Annotated[str, Meta(min_length=1)] | None = None


class MatcherOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which matcher: "structural" needs no model; "structural+xfeat" takes XFeat for frames that it can't place.

    The others are for matchers of features. ``model``: a file instead of the built one; ``model_sha256``: what it must
    hash to. ``provider``: what computes the networks, of those that the installed ONNX Runtime has. ``working_px``:
    long side at which frames are matched: time grows with its square. A multiple of 32 for xfeat.
    """

    name: str = "structural"
    working_px: Annotated[int, Meta(ge=128, le=4096)] = 640
    max_keypoints: Annotated[int, Meta(ge=64, le=16384)] = 4096
    threads: Annotated[int, Meta(ge=1, le=64)] = 1
    model: str | None = None
    model_sha256: str | None = None
    provider: ProviderName = "cpu"

    def __post_init__(self) -> None:
        if "xfeat" in self.name and self.working_px % _XFEAT_MULTIPLE_PX:
            below = self.working_px - self.working_px % _XFEAT_MULTIPLE_PX
            raise ValueError(
                f"working_px = {self.working_px} is no multiple of {_XFEAT_MULTIPLE_PX}, as the matcher {self.name} "
                f"needs; write {below} or {below + _XFEAT_MULTIPLE_PX}"
            )


class AttitudeOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How well the autopilot knows its attitude: 1-sigma of roll, pitch, yaw in degrees, mount included."""

    sigma_deg: tuple[Annotated[float, Meta(gt=0)], Annotated[float, Meta(gt=0)], Annotated[float, Meta(gt=0)]] = (
        1.0,
        1.0,
        3.0,
    )


class Config(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The whole file; tables are described at their classes and in config/example.toml."""

    camera: CameraOptions
    intrinsics: Intrinsics
    map: MapOptions
    link: LinkOptions
    mount: MountOptions = field(default_factory=MountOptions)
    matcher: MatcherOptions = field(default_factory=MatcherOptions)
    picture: PictureOptions = field(default_factory=PictureOptions)
    localizer: LocalizerOptions = field(default_factory=LocalizerOptions)
    tracker: TrackerOptions = field(default_factory=TrackerOptions)
    witness: WitnessOptions = field(default_factory=WitnessOptions)
    search: SearchOptions = field(default_factory=SearchOptions)
    attitude: AttitudeOptions = field(default_factory=AttitudeOptions)
    timing: TimingOptions = field(default_factory=TimingOptions)
    ladder: LadderOptions = field(default_factory=LadderOptions)
    log: LogOptions = field(default_factory=LogOptions)
    bus: BusOptions = field(default_factory=BusOptions)
    page: PageOptions = field(default_factory=PageOptions)

    @property
    def reads_features(self) -> bool:
        """Whether the pack's precomputed features are wanted: structural matching takes none."""
        return self.localizer.precomputed_features != "never" and self.matcher.name != STRUCTURAL


def read_config(path: Path) -> Config:
    """Parse and check a configuration file.

    Raises: ConfigError naming the file and the key.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as err:
        raise ConfigError(f"{path}: can't be read ({err})") from err
    try:
        raw = tomllib.loads(text)
        # Before the tables are made: they would name only themselves, not the key.
        _raise_first(path, _not_finite(raw, "$"))
        _read_intrinsics_file(path, raw)
        config = msgspec.convert(raw, Config)
    except tomllib.TOMLDecodeError as err:
        raise ConfigError(f"{path}: not TOML: {err}") from err
    except msgspec.ValidationError as err:
        raise ConfigError(f"{path}: {err}; {_allowed(str(err))}") from err
    _raise_first(path, _contradictions(config))
    return config


def _read_intrinsics_file(path: Path, raw: dict[str, Any]) -> None:
    """Put what the file of ``[intrinsics] file`` says into the table, in the place of its name."""
    table = raw.get("intrinsics")
    if not isinstance(table, dict) or "file" not in table:
        if isinstance(table, dict) and "file_camera" in table:
            raise ConfigError(f"{path}: `$.intrinsics.file_camera` without `$.intrinsics.file`, whose camera it names")
        return
    both = sorted(set(table) - _BESIDE_FILE)
    if both:
        raise ConfigError(
            f"{path}: `$.intrinsics.file` and `$.intrinsics.{both[0]}`: the file says what the camera is; leave one of "
            "them out"
        )
    beside = msgspec.convert({"intrinsics": table}, _Beside).intrinsics
    try:
        camera = read_camera(path.parent / beside.file, beside.file_camera, (beside.width_px, beside.height_px))
    except ConfigError as err:
        raise ConfigError(f"{path}: `$.intrinsics.file`: {err}") from err
    table |= {
        "width_px": camera.width, "height_px": camera.height, "fx": camera.fx, "fy": camera.fy, "cx": camera.cx,
        "cy": camera.cy, "distortion": list(camera.distortion),
    }  # fmt: skip


class _BesideFile(Struct, frozen=True, kw_only=True):
    """``[intrinsics]`` with a file, before it is read."""

    file: Annotated[str, Meta(min_length=1)]
    file_camera: Annotated[str, Meta(min_length=1)] | None = None
    width_px: Annotated[int, Meta(ge=16)] | None = None
    height_px: Annotated[int, Meta(ge=16)] | None = None


class _Beside(Struct, frozen=True, kw_only=True):
    """For the key's whole name in msgspec's refusals."""

    intrinsics: _BesideFile


def config_text(config: Config) -> str:
    """As JSON, for `config_from_text`; infinite numbers, which only programs set, are written as Infinity."""
    return json.dumps(msgspec.to_builtins(config))


def without_secrets(config: Config) -> dict[str, Any]:
    """As plain values, for others to read: without names and passwords in addresses, and without where keys are."""
    plain: dict[str, Any] = _masked(json.loads(config_text(config)))
    return plain


# In tables of any depth.
_SECRET_KEYS = frozenset({"signing_key", "signing_state", "private_key", "token_file"})


def _masked(value: Any) -> Any:
    if isinstance(value, dict):
        return {
            name: LEFT_OUT if name in _SECRET_KEYS and part is not None else _masked(part)
            for name, part in value.items()
        }
    if isinstance(value, list):
        return [_masked(part) for part in value]
    if isinstance(value, str):
        return without_credentials(value)
    return value


def config_from_text(text: str) -> Config:
    """Raises: ValueError (of which msgspec's errors are)."""
    return msgspec.convert(json.loads(text), Config)


_UNKNOWN = re.compile(r"unknown field `([^`]*)`(?: - at `\$\.?([\w.]*)`)?")


def _allowed(message: str) -> str:
    """What a key that does not exist may have been meant to be."""
    found = _UNKNOWN.search(message)
    if found is None:
        return "see config/example.toml for what is allowed"
    kind: Any = Config
    for part in (found[2] or "").split("."):
        if part:
            kind = typing.get_type_hints(kind)[part]
    names = [field.encode_name for field in msgspec.structs.fields(kind)]
    near = difflib.get_close_matches(found[1], names, n=1)
    meant = f"did you mean `{near[0]}`? " if near else ""
    table = f"[{found[2]}]" if found[2] else "the file"
    return f"{meant}{table} has: {', '.join(names)}"


def _raise_first(path: Path, problems: Iterator[str]) -> None:
    for problem in problems:
        raise ConfigError(f"{path}: {problem}")


def _not_finite(value: Any, key: str) -> Iterator[str]:
    """TOML knows nan and inf, and no bound of a range holds nan back."""
    if isinstance(value, dict):
        for name, part in value.items():
            yield from _not_finite(part, f"{key}.{name}")
    elif isinstance(value, list | tuple):
        for index, part in enumerate(value):
            yield from _not_finite(part, f"{key}[{index}]")
    elif isinstance(value, float) and not math.isfinite(value):
        yield f"`{key}` is {value}; write a finite number"


def _contradictions(config: Config) -> Iterator[str]:
    if not config.link.send:
        yield "`$.link.send` is empty, so no fix would reach the autopilot; write [\"auto\"]"
    if config.page.enabled and (why := page_refused(config.page)) is not None:
        yield f"`$.page.listen`: {why}"
    for side in ("width_px", "height_px"):
        asked, calibrated = getattr(config.camera, side), getattr(config.intrinsics, side)
        if asked is not None and asked != calibrated:
            yield (
                f"`$.camera.{side}` asks for {asked}, but `$.intrinsics.{side}` is {calibrated}; intrinsics must be "
                "those of the frames as they arrive"
            )


def read_intrinsics(path: Path, width: int, height: int) -> Camera:
    """Intrinsics from JSON, for an image of a given size.

    Either our own keys (`Intrinsics`; another size of the same aspect is scaled) or ``{"intrinsics": 3x3}`` as
    OrthoLoC's files have it, which belongs to the image as it is.
    Raises: ConfigError naming the file and the key.
    """
    try:
        raw = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as err:
        raise ConfigError(f"{path}: can't be read as JSON ({err})") from err
    try:
        if isinstance(raw, dict) and "intrinsics" in raw:
            matrix: FloatArray = np.array(raw["intrinsics"], dtype=np.float64)
            if matrix.shape != (3, 3):
                raise ConfigError(f"{path}: intrinsics is {matrix.shape}, expected 3 x 3")
            return Camera(width, height, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
        given = msgspec.convert(raw, Intrinsics).camera()
    except (msgspec.ValidationError, ValueError, TypeError) as err:
        raise ConfigError(
            f"{path}: {err}; expected width_px, height_px, fx, fy, cx, cy and optionally distortion, "
            'or {"intrinsics": 3x3}'
        ) from err
    if (given.width, given.height) == (width, height):
        return given
    if abs(given.width * height - given.height * width) > max(width, height):
        raise ConfigError(
            f"{path}: intrinsics are for {given.width} x {given.height} px, the image has {width} x {height}: "
            "another aspect; crop the image as it was calibrated"
        )
    return given.resized(width, height)
