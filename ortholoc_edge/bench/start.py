"""How long a daemon takes from the start of its process until it is ready, and until an autopilot has its first fix."""

from __future__ import annotations

import math
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import msgspec
import numpy as np

from ortholoc_edge.errors import OrtholocError
from ortholoc_edge.geometry.arrays import FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.prior import footprint
from ortholoc_edge.pipeline.render import Terrain, render
from ortholoc_edge.tiles.store import MapStore

_S = 1_000_000_000
_TIMEOUT_S = 60.0
_POLL_S = 0.002
# Around the footprint.
_MARGIN_M = 30.0
# Of a view that must show map, for it to be a fair one.
_MIN_VALID = 0.98
_GROUND_GSD_M = 4.0
# Of the rings around the pack's middle on which a place is looked for, as a part of the pack's shorter side.
_RINGS, _PLACES = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3), 8


class Start(msgspec.Struct, frozen=True, kw_only=True):
    """One start.

    Attributes:
        ready_s: until READY=1; first_s: until the autopilot heard its first estimate. Both from before the process was
            made.
        ready_cpu_s, first_cpu_s: processor time that the daemon had taken by then, which other work on the computer
            does not lengthen as it does the others.
    """

    ready_s: float
    first_s: float
    ready_cpu_s: float
    first_cpu_s: float


# From a camera's axes to the map's, looking straight down, north up.
_DOWN = np.diag([1.0, -1.0, -1.0])


def find_place(store: MapStore, camera: Camera, height_m: float) -> FloatArray:
    """(3,) near the pack's middle, so high above ground, from where a camera that looks down sees map all over.

    Raises: OrtholocError if there is none.
    """
    west, south, east, north = store.bounds
    side_m = min(east - west, north - south)
    for ring in _RINGS:
        for k in range(_PLACES if ring else 1):
            angle = 2.0 * math.pi * k / _PLACES
            xy = np.array([(west + east) / 2, (south + north) / 2]) + ring * side_m * np.array(
                [math.cos(angle), math.sin(angle)]
            )
            ground_m = store.ground_near(xy, _GROUND_GSD_M)
            if ground_m is None:
                continue
            place = np.array([*xy, ground_m + height_m])
            if view_from(store, camera, Rigid3(_DOWN, place)) is not None:
                return place
    raise OrtholocError(f"{store.pack.path}: no view of {height_m:.0f} m above ground near its middle is full of map")


def view_from(store: MapStore, camera: Camera, map_from_camera: Rigid3) -> ImageArray | None:
    """The map (H, W) as a camera sees it, made a little darker and softer than it is; None where map is missing."""
    ground_m = store.ground_near(map_from_camera.translation[:2], _GROUND_GSD_M)
    if ground_m is None:
        return None
    seen = footprint(camera, map_from_camera, ground_m)
    (west, south), (east, north) = seen.min(axis=0) - _MARGIN_M, seen.max(axis=0) + _MARGIN_M
    gsd_m = (float(map_from_camera.translation[2]) - ground_m) / camera.focal_px
    window = store.read((float(west), float(south), float(east), float(north)), gsd_m)
    if window is None:
        return None
    local = store.pack.georeference.local_frame(map_from_camera.translation[:2], ground_m)
    terrain = Terrain.of(window, local)
    if terrain is None:
        return None
    view = render(terrain, camera, local.local_from_map_pose(map_from_camera))
    if view.valid.mean() < _MIN_VALID:
        return None
    softer = cv2.GaussianBlur(view.image, (0, 0), 0.7)
    return np.asarray(np.clip(0.85 * softer + 10.0, 0, 255), dtype=np.uint8)


def time_start(config: Path, first_ns: Callable[[], int | None]) -> Start:
    """Start the daemon once, wait for its first estimate, end it.

    Args:
        first_ns: when an estimate came first, of `time.monotonic_ns`; None while none has.
    Raises: OrtholocError with the daemon's last words if it ends, or takes more than a minute.
    """
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as supervisor:
        address = Path(folder) / "notify"
        supervisor.bind(str(address))
        supervisor.setblocking(False)
        words = Path(folder) / "stderr"
        with words.open("w", encoding="utf-8") as stderr:
            began_ns = time.monotonic_ns()
            process = subprocess.Popen(
                [sys.executable, "-m", "ortholoc_edge", "run", "--config", str(config)],
                env={**os.environ, "NOTIFY_SOCKET": str(address)}, stderr=stderr, stdin=subprocess.DEVNULL,
            )  # fmt: skip
            try:
                ready_ns = _ready(supervisor, process, began_ns, words)
                ready_cpu_s = _cpu_s(process.pid)
                while (came_ns := first_ns()) is None:
                    _check(process, began_ns, words, "its first estimate")
                    time.sleep(_POLL_S)
                first_cpu_s = _cpu_s(process.pid)
            finally:
                process.terminate()
                try:
                    process.wait(10.0)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
    return Start(
        ready_s=(ready_ns - began_ns) / _S, first_s=(came_ns - began_ns) / _S,
        ready_cpu_s=ready_cpu_s, first_cpu_s=first_cpu_s,
    )  # fmt: skip


def _cpu_s(pid: int) -> float:
    """Of a process with all its threads."""
    # Behind the name, which may hold blanks: the 12th and 13th field are user and system time.
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _ready(supervisor: socket.socket, process: subprocess.Popen[bytes], began_ns: int, words: Path) -> int:
    while True:
        try:
            if b"READY=1" in supervisor.recv(4096).split(b"\n"):
                return time.monotonic_ns()
        except BlockingIOError:
            _check(process, began_ns, words, "ready")
            time.sleep(_POLL_S)


def _check(process: subprocess.Popen[bytes], began_ns: int, words: Path, what: str) -> None:
    ended = process.poll()
    if ended is None and time.monotonic_ns() - began_ns < _TIMEOUT_S * _S:
        return
    last = " | ".join(words.read_text(encoding="utf-8", errors="replace").splitlines()[-3:])
    how = f"took more than {_TIMEOUT_S:.0f} s" if ended is None else f"ended with {ended}"
    raise OrtholocError(f"the daemon {how} before {what}; it said: {last}")


def forget(paths: Iterable[Path]) -> int:
    """Have the system drop files from its memory, as after a restart of the computer; how many bytes that was."""
    dropped = 0
    for path in paths:
        try:
            with path.open("rb") as file:
                size = os.fstat(file.fileno()).st_size
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        except OSError:
            continue
        dropped += size
    return dropped


def program_files() -> list[Path]:
    """What a start reads of the program: the interpreter's library, its packages, and ours."""
    roots = {Path(path) for path in sys.path if path and Path(path).is_dir()}
    roots.add(Path(__file__).resolve().parents[1])
    files = (path for root in roots for path in root.rglob("*"))
    return [path for path in files if path.suffix in (".py", ".pyc", ".so") or ".so." in path.name]
