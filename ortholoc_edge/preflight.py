"""Whether this computer can fly with a configuration: what `doctor --computer` looks at. Nothing is changed.

Each check takes what it judges, so that a test can make it up, and gives findings with their remedies.
"""

from __future__ import annotations

import ctypes
import datetime
import grp
import os
import shutil
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from ortholoc_edge.adapters.bus import bus_of
from ortholoc_edge.adapters.camera import BadFrameError, EndOfFrames, FrameSource, open_source
from ortholoc_edge.adapters.camera.stream import NETWORK
from ortholoc_edge.adapters.camera.v4l2 import Settings, device_path, differences, read_settings
from ortholoc_edge.adapters.computer import ComputerReader, ComputerStatus
from ortholoc_edge.adapters.mavlink.audit import Finding, Level
from ortholoc_edge.adapters.mavlink.options import parse_endpoint
from ortholoc_edge.adapters.mavlink.signing import read_key
from ortholoc_edge.adapters.page.options import read_token
from ortholoc_edge.clock import Clock, wall_clock_ns
from ortholoc_edge.config import Config
from ortholoc_edge.daemon import require_flyable
from ortholoc_edge.errors import CameraError, ConfigError, LinkError, MapError, OrtholocError
from ortholoc_edge.matching import models
from ortholoc_edge.matching.types import STRUCTURAL
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

_S = 1_000_000_000
# No version of this program is older: a computer without a battery begins at 1970, or when its image was made.
_OLDEST = datetime.datetime(2026, 11, 1, tzinfo=datetime.UTC)
_TIME_ERROR = 5  # adjtimex(2): the clock is not synchronised
# A Pi's firmware slows down at 80 and 85 degrees, a Jetson at 97 or so.
_HOT_C = 80.0
# Of the pipeline at its peak on seneca, beside the map.
_PIPELINE_MIB = 320
_LOOK_S = 5.0
_FRAMES_WANTED = 20
_LEAST_RATE = 0.7
# A frame that is older when it comes is old before anything is done with it.
_OLD_MS = 150.0
# Which are asked for one.
_ASKED_FOR_RATE = ("device", "picamera2")


def check_computer(config: Config, clock: Clock, environ: Mapping[str, str]) -> list[Finding]:
    """All of it; takes as long as the camera is looked at, 5 s at most, and as the pack needs to load."""
    status = ComputerReader().read()
    devices = check_devices(config, os.access)
    pictures: list[Finding] = []
    # One that is not there would be waited for.
    if not any(finding.subject == "camera" for finding in devices):
        with ExitStack() as closed_last:

            def opened() -> FrameSource:
                bus = None
                if config.camera.kind == "zenoh" and config.bus.enabled:
                    bus = bus_of(config.bus, config.camera, environ)
                    closed_last.callback(bus.close)
                return open_source(config.camera, clock, bus)

            seen = look(opened, clock, settings=_settings_of(config))
        pictures = [seen] if isinstance(seen, Finding) else check_look(config, seen)
    return [
        *check_clock(wall_clock_ns(), is_synchronised()),
        *devices,
        *check_intrinsics(config),
        *check_keys(config, environ),
        *check_pack(config, status),
        *check_model(config),
        *check_heat(status),
        *check_disk(config, _usage),
        *pictures,
    ]


# -- clock ---------------------------------------------------------------------------------------------


def is_synchronised() -> bool | None:
    """Whether the kernel holds its date for synchronised; None where it can't be asked."""
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        # Longer than struct timex, of zeros: modes = 0 only asks.
        state = libc.adjtimex(ctypes.create_string_buffer(512))
    except (OSError, AttributeError):
        return None
    return None if state < 0 else state != _TIME_ERROR


def check_clock(unix_ns: int, synchronised: bool | None) -> list[Finding]:
    """The date: frames don't need it, but logs, what is said on the bus, and signatures do."""
    date = datetime.datetime.fromtimestamp(unix_ns / _S, datetime.UTC)
    why = "logs, the bus and signing bear the date; stamps of frames and fixes don't need it"
    if date < _OLDEST:
        return [
            Finding(
                Level.WARNING, "clock", f"{date:%Y-%m-%d}", f"{_OLDEST:%Y-%m-%d} or later", why,
                "sudo timedatectl set-ntp true; without a network give the computer a clock with a battery",
            )
        ]  # fmt: skip
    if synchronised is False:
        return [
            Finding(
                Level.NOTE, "clock", "not synchronised", "synchronised before the flight", why,
                "sudo timedatectl set-ntp true, and wait for `timedatectl` to say so",
            )
        ]  # fmt: skip
    return []


# -- permissions ---------------------------------------------------------------------------------------


def check_devices(config: Config, may: Callable[[Path, int], bool]) -> list[Finding]:
    """Camera and serial line: there, and this user's to open.

    Args:
        may: `os.access`.
    """
    found = []
    for name, path in _devices(config):
        if not path.exists():
            found.append(
                Finding(
                    Level.ERROR, name, f"{path} is not there", "a device", "the daemon waits for it until it comes",
                    "plug it in, or name another in the configuration",
                )
            )  # fmt: skip
        elif not may(path, os.R_OK | os.W_OK):
            group = _group(path)
            found.append(
                Finding(
                    Level.ERROR, name, f"{path} may not be opened by this user", "read and write",
                    f"it belongs to the group {group}", f"sudo usermod -aG {group} $USER, and log in again; the unit "
                    "has the groups video and dialout",
                )
            )  # fmt: skip
    return found


def _devices(config: Config) -> list[tuple[str, Path]]:
    devices = []
    if config.camera.kind == "device":
        devices.append(("camera", Path(device_path(config.camera.place))))
    endpoint = parse_endpoint(config.link.endpoint)
    if endpoint.kind == "serial":
        devices.append(("link", Path(endpoint.address)))
    return devices


def _group(path: Path) -> str:
    gid = path.stat().st_gid
    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return str(gid)


def check_keys(config: Config, environ: Mapping[str, str]) -> list[Finding]:
    """Keys that are configured can be read; never what is in them."""
    asked: list[tuple[str, str | None, Callable[[str, Mapping[str, str]], bytes]]] = [
        ("signing key", config.link.signing_key, read_key),
        ("token of the page", config.page.token_file if config.page.enabled else None, read_token),
    ]
    findings = []
    for subject, name, read in asked:
        if name is None:
            continue
        if "/" not in name and "CREDENTIALS_DIRECTORY" not in environ:
            findings.append(
                Finding(
                    Level.NOTE, subject, f"{name!r} is a systemd credential", "readable",
                    "only the service is handed it, so it can't be looked at here",
                    f"see that the unit has LoadCredential={name}:/path/to/key",
                )
            )  # fmt: skip
            continue
        try:
            read(name, environ)
        except ConfigError as error:
            findings.append(
                _error(subject, error, "one that nobody else can read", "without it the daemon does not start")
            )
    return findings


# -- intrinsics ----------------------------------------------------------------------------------------


def check_intrinsics(config: Config) -> list[Finding]:
    """The lens has a ray for each pixel: a polynomial fitted to the middle of the picture folds back before its rim."""
    camera = config.intrinsics.camera()
    right, below = camera.width - 1.0, camera.height - 1.0
    along = np.linspace(0.0, 1.0, 33)
    rim = np.concatenate(
        [
            np.column_stack([along * right, np.zeros(33)]), np.column_stack([along * right, np.full(33, below)]),
            np.column_stack([np.zeros(33), along * below]), np.column_stack([np.full(33, right), along * below]),
        ]
    )  # fmt: skip
    blind = 1.0 - float(np.isfinite(camera.unproject(rim)).all(axis=1).mean())
    if blind == 0.0:
        return []
    return [
        Finding(
            Level.WARNING, "intrinsics", f"no ray for {blind:.0%} of the picture's rim", "one for each pixel",
            "the distortion folds back before it, so what is seen there is lost, and near it wrong",
            "calibrate with the board in the picture's corners, and fewer terms: ortholoc-edge calibrate",
        )
    ]  # fmt: skip


# -- map and model -------------------------------------------------------------------------------------


def check_pack(config: Config, status: ComputerStatus) -> list[Finding]:
    """It is whole, is of use to an autopilot, and fits into the memory."""
    options = config.map
    try:
        pack = Pack.open(Path(options.pack), None if options.public_key is None else Path(options.public_key))
        require_flyable(pack.georeference, options.pack)
        with MapStore(
            pack, memory_bytes=options.memory_mb * 2**20, features=config.reads_features,
            require_intact=options.require_intact,
        ) as store:  # fmt: skip
            damaged, mib = list(store.damaged), store.compressed_bytes / 2**20
    except (MapError, ConfigError) as error:
        return [_error("pack", error, "a pack to fly with", "without it the daemon does not start")]
    found = []
    if damaged:
        found.append(
            Finding(
                Level.WARNING, "pack", f"{len(damaged)} files are damaged or missing, {damaged[0]} say", "none",
                "there are holes in the map, and no fixes over them",
                f"ortholoc-edge tiles verify {options.pack}; copy or build it again",
            )
        )  # fmt: skip
    free_mib = status.memory_total_mib - status.memory_used_mib
    needed_mib = mib + options.cache_mb + _PIPELINE_MIB
    # Zero where /proc does not tell.
    if status.memory_total_mib and needed_mib > free_mib:
        found.append(
            Finding(
                Level.WARNING, "memory", f"{free_mib} MiB free", f"{needed_mib:.0f} MiB",
                "the kernel would end the daemon, or others", "end what else runs, or take a pack of a smaller area",
            )
        )  # fmt: skip
    return found


def check_model(config: Config) -> list[Finding]:
    """Weights are there before the flight: building them needs a network."""
    name = config.matcher.name.removeprefix(f"{STRUCTURAL}+")
    given = config.matcher.model
    if given is not None:
        if Path(given).is_file():
            return []
        what, remedy = f"{given} is no file", "name the file in [matcher] model"
    elif name in models.CATALOGUE and not models.is_stored(name):
        what, remedy = f"{name} is not built", f"ortholoc-edge models build {name}"
    else:
        return []
    return [Finding(Level.ERROR, "model", what, "there before the flight", "building it needs a network", remedy)]


# -- heat and disk -------------------------------------------------------------------------------------


def check_heat(status: ComputerStatus) -> list[Finding]:
    """What slows the computer down now."""
    found = []
    why = "frames take longer, so detail is left out, and fixes get rarer and less certain"
    warmest = max(status.temperatures_c, default=0.0)
    if status.is_under_voltage:
        found.append(
            Finding(Level.WARNING, "voltage", "too low", "5 V under load", why, "a supply for 5 A, short thick leads")
        )
    if status.is_hot or warmest >= _HOT_C:
        found.append(
            Finding(Level.WARNING, "heat", f"{warmest:.0f} °C", f"below {_HOT_C:.0f}", why, "a heat sink, moving air")
        )
    elif status.is_throttled:
        found.append(
            Finding(Level.WARNING, "heat", "the processor is held back", "its full clock", why, "look at its supply")
        )
    return found


@dataclass(frozen=True, slots=True)
class Usage:
    """Of the disk under a folder, or where it would be made."""

    free_mib: float
    is_writable: bool


def _usage(folder: Path) -> Usage:
    there = folder
    while not there.exists() and there != there.parent:
        there = there.parent
    return Usage(shutil.disk_usage(there).free / 2**20, os.access(there, os.W_OK | os.X_OK))


def check_disk(config: Config, usage: Callable[[Path], Usage]) -> list[Finding]:
    """There is room for the logs that may be written."""
    if config.log.folder is None:
        return []
    found = usage(Path(config.log.folder))
    if not found.is_writable:
        return [
            Finding(
                Level.ERROR, "log folder", f"{config.log.folder} may not be written to by this user", "writable",
                "the daemon flies without a log, and tries again",
                "give it to the user that flies, or name another [log] folder",
            )
        ]  # fmt: skip
    if found.free_mib < config.log.max_mb:
        return [
            Finding(
                Level.WARNING, "disk", f"{found.free_mib:.0f} MiB free under {config.log.folder}",
                f"{config.log.max_mb} MiB", "the flight goes on when the disk is full, its log does not",
                "make room, or lower [log] max_mb",
            )
        ]  # fmt: skip
    return []


# -- camera --------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Look:
    """Frames that were looked at.

    Attributes:
        sizes: (width, height) of each, in px.
        brightness: mean of each, 0 to 255.
        alike: how many were, bit for bit, the one before.
        bad: how many could not be read.
        rate_hz: of those that came, by their stamps; None of fewer than three.
        age_ms: by which they were late, the median; None without any.
        settings: of a V4L2 device, while it ran.
    """

    sizes: tuple[tuple[int, int], ...]
    brightness: tuple[float, ...]
    alike: int
    bad: int
    rate_hz: float | None
    age_ms: float | None = None
    settings: Settings | None = None


def _settings_of(config: Config) -> Callable[[], Settings | None]:
    camera = config.camera
    return (lambda: read_settings(device_path(camera.place))) if camera.kind == "device" else lambda: None


def look(
    opened: Callable[[], FrameSource],
    clock: Clock,
    seconds: float = _LOOK_S,
    settings: Callable[[], Settings | None] = lambda: None,
) -> Look | Finding:
    """Take frames for a while. A finding where the source can't be opened.

    Args:
        settings: asked for while the source runs.
    """
    try:
        source = opened()
    except (CameraError, ConfigError, LinkError) as error:
        return _error("camera", error, "frames", "without it the daemon does not start")
    frames: list[Frame] = []
    ages_ms: list[float] = []
    now: Settings | None = None
    bad = 0
    end_ns = clock.now_ns() + round(seconds * _S)
    try:
        while clock.now_ns() < end_ns and len(frames) < _FRAMES_WANTED:
            try:
                frame = source.read(0.2)
            except BadFrameError:
                bad += 1
                continue
            except EndOfFrames:
                break
            if frame is not None:
                frames.append(frame)
                ages_ms.append((clock.now_ns() - frame.stamp_ns) / 1e6)
            else:
                # A source that returns at once must not make this a busy loop.
                time.sleep(0.01)
        now = settings()
    except CameraError as error:
        return _error("camera", error, "frames", "it broke off while it was looked at")
    finally:
        source.close()
    span_ns = frames[-1].stamp_ns - frames[0].stamp_ns if len(frames) > 2 else 0
    return Look(
        tuple((frame.image.shape[1], frame.image.shape[0]) for frame in frames),
        tuple(float(frame.image.mean()) for frame in frames),
        sum(np.array_equal(a.image, b.image) for a, b in pairwise(frames)),
        bad,
        (len(frames) - 1) * _S / span_ns if span_ns > 0 else None,
        float(np.median(ages_ms)) if ages_ms else None,
        now,
    )


def check_look(config: Config, seen: Look) -> list[Finding]:
    """Frames come, as large and as often as they should, and something can be seen on them."""
    if not seen.sizes:
        why = f"{seen.bad} could not be read" if seen.bad else "the daemon waits for them"
        return [
            Finding(
                Level.ERROR, "camera", f"no frame in {_LOOK_S:g} s", "frames", why,
                f"look at the source with another program; it is {config.camera.kind}",
            )
        ]  # fmt: skip
    found = []
    wanted = config.intrinsics.width_px, config.intrinsics.height_px
    if others := set(seen.sizes) - {wanted}:
        width, height = sorted(others)[0]
        found.append(
            Finding(
                Level.ERROR, "camera", f"frames of {width} x {height} px", f"{wanted[0]} x {wanted[1]} px",
                "intrinsics are those of other frames, so every frame is refused",
                "calibrate at that size, or ask for the other by [camera] width_px and height_px",
            )
        )  # fmt: skip
    asked_hz = config.camera.fps or config.camera.rate_hz
    if config.camera.kind in _ASKED_FOR_RATE and seen.rate_hz is not None and seen.rate_hz < _LEAST_RATE * asked_hz:
        found.append(
            Finding(
                Level.WARNING, "camera", f"{seen.rate_hz:.1f} frames per second", f"{asked_hz:g}",
                "long exposures and uncompressed pictures over USB slow a camera down",
                "more light or a fixed exposure; MJPG in place of YUYV; or ask for what it can give",
            )
        )  # fmt: skip
    darkest = config.picture.min_brightness
    is_dark = max(seen.brightness) < darkest
    if is_dark:
        found.append(
            Finding(
                Level.WARNING, "camera", f"brightness {max(seen.brightness):.0f} of 255", f"above {darkest:g}",
                "nothing can be matched in the dark", "take the lens cap off; by night there are no fixes",
            )
        )  # fmt: skip
    # Pictures without light are alike, too.
    if config.camera.is_live and not is_dark and len(seen.sizes) > 2 and seen.alike == len(seen.sizes) - 1:
        found.append(
            Finding(
                Level.ERROR, "camera", "the same picture again and again", "frames that differ",
                "sensors have noise, so it is frozen",
                "unplug it and plug it in again; change its driver, its cable, or what serves the stream",
            )
        )  # fmt: skip
    found += [*_check_time(config, seen), *_check_settings(config, seen)]
    if seen.bad:
        found.append(
            Finding(
                Level.WARNING, "camera", f"{seen.bad} of {seen.bad + len(seen.sizes)} frames can't be read", "all",
                "they are refused", "another cable or hub; lower the rate",
            )
        )  # fmt: skip
    return found


def _check_time(config: Config, seen: Look) -> list[Finding]:
    """Stamps are of the exposure, and not long ago."""
    if config.camera.kind in NETWORK and config.camera.latency_ms == 0:
        return [
            Finding(
                Level.WARNING, "camera", "latency_ms = 0 of a stream", "what it is late by",
                "frames are stamped when they arrive, and 50 ms left out are a metre at 20 m/s",
                "measure it (docs/cameras.md) and write it into [camera] latency_ms",
            )
        ]  # fmt: skip
    if config.camera.is_live and seen.age_ms is not None and seen.age_ms > _OLD_MS:
        return [
            Finding(
                Level.WARNING, "camera", f"frames are {seen.age_ms:.0f} ms old when they come", f"{_OLD_MS:.0f} ms",
                "each fix is that much later; autopilots take 250 ms in all",
                "a wired camera instead of a stream; a lower resolution; see that nothing queues frames",
            )
        ]  # fmt: skip
    return []


def _check_settings(config: Config, seen: Look) -> list[Finding]:
    """A device does as it was told."""
    now = seen.settings
    if now is None:
        return []
    why = "it may not have it, or another program changed it"
    # The size is told from the frames themselves, and their rate from their stamps.
    found = [
        Finding(Level.WARNING, "camera", f"{one.what} {one.got}", one.wanted, why, one.remedy)
        for one in differences(config.camera, now)
        if one.what not in ("width", "height", "rate") or (one.what == "rate" and seen.rate_hz is None)
    ]
    if now.automatic and config.camera.exposure_ms is None:
        found.append(
            Finding(
                Level.NOTE, "camera", "exposure is automatic", "a fixed one, of 2 to 5 ms by day",
                "in dim light it gets long: frames are smeared, fewer, and nobody knows by how much",
                'write [camera] exposure_ms, and gain; or "auto" to have it so',
            )
        )  # fmt: skip
    return found


def _error(subject: str, error: OrtholocError, wanted: str, why: str) -> Finding:
    """Of an error, whose message says what mends it."""
    what, _, remedy = str(error).partition("; ")
    return Finding(Level.ERROR, subject, what, wanted, why, remedy or "see the message")
