"""Recorded sequences with known poses.

A flight folder holds photos and one ``*_flight.csv`` (UTF-8, comma, header), a row per photo in time order:

    filename               path of the photo, relative to the folder; empty: no photo, the row is skipped
    exif_time              "YYYY:MM:DD hh:mm:ss"; equal stamps are taken 0.1 s apart
    utm_e, utm_n, alt      camera centre in the pack's CRS and vertical datum, m
    qw, qx, qy, qz         rotation map (east, north, up) -> camera (right, down, forward)
    yaw_true_deg           heading of the body from true north; with pitch_deg and roll_deg ZYX NED angles of a
    pitch_deg, roll_deg    body whose camera looks straight down, image top toward the nose
    width, height, fx, fy, cx, cy   intrinsics of the undistorted photo, px, pixel centres at integers

An OrthoLoC sample is an ``.npz`` with ``image_query`` (H, W, 3) uint8, ``image_dop`` (h, w, 3) uint8, ``dsm``
(h, w, 3) float32 coordinates of the pixel centres (or (h, w) heights with ``scale`` and an origin at 0),
``scale`` in m (a number, or a pair whose second is negative where y falls with the row), ``extrinsics`` (3 or
4, 4) camera_from_map, ``intrinsics`` (3, 3). Heights far from the sample's median count as holes. A folder
of samples is one sequence of unrelated frames.
"""

from __future__ import annotations

import csv
import datetime
import logging
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ortholoc_edge.adapters.camera import read_image
from ortholoc_edge.errors import DatasetError
from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.arrays import Float32Array, FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.geometry.rigid import Rigid3

logger = logging.getLogger(__name__)

_EQUAL_STAMP_STEP_NS = 100_000_000
# Around the median height of a sample's surface, some hundred metres wide: beyond are blunders of its
# photogrammetry.
_MAX_BELOW_M, _MAX_ABOVE_M = 200.0, 1000.0


@dataclass(frozen=True, slots=True, eq=False)
class RecordedFrame:
    """A photo with its true pose.

    Attributes:
        name: file name without folder and ending.
        path: of the photo; decoded when asked for, so that a bad file costs one frame.
        stamp_ns: since the first photo of the sequence.
        camera: intrinsics.
        map_from_camera: truth.
        ned_from_body: (3, 3) true attitude; true north.
    """

    name: str
    path: Path
    stamp_ns: int
    camera: Camera
    map_from_camera: Rigid3
    ned_from_body: FloatArray

    def image(self) -> ImageArray:
        """RGB uint8. Raises: CameraError naming the file."""
        return read_image(self.path)


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """An OrthoLoC sample: a photo, its pose, and the rasters of the region it shows.

    Attributes:
        grid: of both rasters.
        dop: (h, w, 3) uint8 RGB.
        dsm: (h, w) float32 heights, NaN where there is no surface.
        image: (H, W, 3) uint8 RGB.
    """

    name: str
    image: ImageArray
    camera: Camera
    map_from_camera: Rigid3
    dop: ImageArray
    dsm: Float32Array
    grid: RasterGrid


def read_flight(folder: Path) -> list[RecordedFrame]:
    """The photos of a flight folder in time order.

    Raises: DatasetError naming file, row and column.
    """
    tables = sorted(folder.glob("*_flight.csv"))
    if len(tables) != 1:
        raise DatasetError(
            f"{folder}: {len(tables)} files named *_flight.csv, expected one; the format is described in "
            "docs/sequences.md"
        )
    try:
        with tables[0].open(newline="", encoding="utf-8") as lines:
            recorded = _rows(csv.DictReader(lines), tables[0], folder)
    except (OSError, UnicodeDecodeError, csv.Error) as err:
        raise DatasetError(f"{tables[0]}: not a readable CSV file ({err})") from err
    if not recorded:
        raise DatasetError(f"{tables[0]}: no row names a photo")
    return recorded


def sample_paths(source: Path) -> list[Path]:
    """The ``.npz`` files that a path names: itself, or those in the folder; empty if there are none."""
    if source.suffix == ".npz":
        return [source]
    return sorted(source.glob("*.npz")) if source.is_dir() else []


def read_sample(path: Path) -> Sample:
    """An OrthoLoC sample. Raises: DatasetError naming the file and the key."""
    try:
        # Opened here: of a damaged archive, np.load leaves its own file open.
        with path.open("rb") as file:
            archive = np.load(file, allow_pickle=False)
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise DatasetError(f"{path}: a single array, expected an archive (.npz) of a sample's keys")
            with archive:
                return _sample(archive, path)
    except DatasetError:
        raise
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as err:
        raise DatasetError(f"{path}: not a readable OrthoLoC sample ({err}); copy it again") from err


def _rows(reader: csv.DictReader[str], table: Path, folder: Path) -> list[RecordedFrame]:
    recorded: list[RecordedFrame] = []
    start: datetime.datetime | None = None
    before: datetime.datetime | None = None
    for row in reader:
        where = f"{table}, line {reader.line_num}"
        if "filename" not in row:
            raise DatasetError(f"{where}: no column filename")
        if not row["filename"]:
            continue
        when = _time(row, where)
        start = start or when
        if before is not None and when < before:
            raise DatasetError(f"{where}: exif_time {row['exif_time']} is before the photo above's; sort the rows")
        before = when
        stamp_ns = round((when - start).total_seconds() * 1e9)
        if recorded and stamp_ns <= recorded[-1].stamp_ns:
            stamp_ns = recorded[-1].stamp_ns + _EQUAL_STAMP_STEP_NS
        try:
            recorded.append(_recorded(row, where, folder, stamp_ns))
        except ValueError as err:
            raise DatasetError(f"{where}: {err}") from err
    return recorded


def _time(row: dict[str, str], where: str) -> datetime.datetime:
    # A row cut short has None there.
    text = row.get("exif_time") or ""
    try:
        return datetime.datetime.strptime(text, "%Y:%m:%d %H:%M:%S")
    except ValueError as err:
        raise DatasetError(f"{where}: exif_time {text!r} is not YYYY:MM:DD hh:mm:ss") from err


def _recorded(row: dict[str, str], where: str, folder: Path, stamp_ns: int) -> RecordedFrame:
    def number(key: str) -> float:
        try:
            value = float(row[key])
        except (KeyError, TypeError, ValueError) as err:
            raise DatasetError(f"{where}: column {key} holds {row.get(key)!r}, expected a number") from err
        if not np.isfinite(value):
            raise DatasetError(f"{where}: column {key} holds {value}")
        return value

    camera_from_map = rotation.from_quaternion([number(key) for key in ("qw", "qx", "qy", "qz")])
    path = folder / row["filename"]
    return RecordedFrame(
        name=path.stem,
        path=path,
        stamp_ns=stamp_ns,
        camera=Camera(
            int(number("width")),
            int(number("height")),
            number("fx"),
            number("fy"),
            number("cx"),
            number("cy"),
        ),
        map_from_camera=Rigid3(camera_from_map.T, np.array([number(key) for key in ("utm_e", "utm_n", "alt")])),
        ned_from_body=rotation.from_euler(
            *np.radians([number(key) for key in ("roll_deg", "pitch_deg", "yaw_true_deg")])
        ),
    )


def _sample(archive: Any, path: Path) -> Sample:
    image, dop, dsm = archive["image_query"], archive["image_dop"], archive["dsm"]
    for key, array in (("image_query", image), ("image_dop", dop)):
        if array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] != 3:
            raise DatasetError(f"{path}: {key} is {array.shape} {array.dtype}, expected (H, W, 3) uint8")
    scale = np.asarray(archive["scale"], dtype=np.float64).ravel()
    if scale.size not in (1, 2) or not np.isfinite(scale).all() or not scale.all():
        raise DatasetError(f"{path}: scale is {scale.tolist()}, expected a number or a pair, not zero")
    dx, dy = abs(float(scale[0])), float(scale[-1])
    if scale.size == 1:
        # One number is only the pixel's size; which way the rows run, the coordinates tell.
        dy = abs(dy) if _rows_run_north(dsm) else -abs(dy)
    heights, west, top = _surface(dsm, dx, dy, path)
    if heights.shape != dop.shape[:2]:
        raise DatasetError(f"{path}: image_dop {dop.shape} and dsm {dsm.shape} differ in size")
    if dy > 0:
        # Packs are north up.
        dop, heights, top, dy = dop[::-1], heights[::-1], top + dy * dop.shape[0], -dy
    extrinsics = np.asarray(archive["extrinsics"], dtype=np.float64)
    intrinsics = np.asarray(archive["intrinsics"], dtype=np.float64)
    if extrinsics.shape not in ((3, 4), (4, 4)) or intrinsics.shape != (3, 3):
        raise DatasetError(f"{path}: extrinsics {extrinsics.shape} or intrinsics {intrinsics.shape} malformed")
    return Sample(
        name=path.stem,
        image=image,
        camera=Camera(
            image.shape[1],
            image.shape[0],
            intrinsics[0, 0],
            intrinsics[1, 1],
            intrinsics[0, 2],
            intrinsics[1, 2],
        ),
        map_from_camera=_proper(extrinsics).inverse(),
        dop=dop,
        dsm=heights,
        grid=RasterGrid(dop.shape[1], dop.shape[0], west, top, dx, dy),
    )


def _rows_run_north(dsm: Any) -> bool:
    if dsm.ndim != 3 or dsm.shape[2] != 3:
        return False
    rows, columns = np.nonzero(np.isfinite(dsm[:, :, 1]))
    return len(rows) > 1 and bool(dsm[rows[-1], columns[-1], 1] > dsm[rows[0], columns[0], 1])


def _surface(dsm: Any, dx: float, dy: float, path: Path) -> tuple[Float32Array, float, float]:
    """Heights (h, w), NaN where implausible, and the outer corner of the first pixel."""
    if dsm.ndim == 2:
        return _plausible(dsm, path), 0.0, 0.0
    if dsm.ndim != 3 or dsm.shape[2] != 3:
        raise DatasetError(f"{path}: dsm is {dsm.shape}, expected (h, w, 3) coordinates or (h, w) heights")
    rows, columns = np.nonzero(np.isfinite(dsm).all(axis=2))
    if not len(rows):
        raise DatasetError(f"{path}: dsm holds no finite point")
    points = dsm[rows, columns].astype(np.float64)
    # The coordinates are of pixel centres; the median sheds their float32 rounding.
    west = float(np.median(points[:, 0] - dx * (columns + 0.5)))
    top = float(np.median(points[:, 1] - dy * (rows + 0.5)))
    misfit = np.abs(points[:, :2] - np.column_stack([dx * (columns + 0.5) + west, dy * (rows + 0.5) + top]))
    if misfit.max() > 0.5 * max(abs(dx), abs(dy)):
        raise DatasetError(
            f"{path}: dsm coordinates and scale ({dx}, {dy}) disagree by {misfit.max():.2f} m; "
            "is the sign of the second scale right?"
        )
    return _plausible(dsm[:, :, 2], path), west, top


def _plausible(heights: Any, path: Path) -> Float32Array:
    kept = np.array(heights, dtype=np.float32)
    finite = np.isfinite(kept)
    if not finite.any():
        return kept
    above_m = kept - np.median(kept[finite])
    # Comparisons with NaN are false: holes are not counted.
    wrong = (above_m < -_MAX_BELOW_M) | (above_m > _MAX_ABOVE_M)
    if wrong.any():
        logger.warning(
            "%s: %d of %d heights are more than %g m below or %g m above the median; taken as holes",
            path.stem,
            np.count_nonzero(wrong),
            np.count_nonzero(finite),
            _MAX_BELOW_M,
            _MAX_ABOVE_M,
        )
        kept[wrong] = np.nan
    return kept


def _proper(extrinsics: FloatArray) -> Rigid3:
    """Float32 files round the rotation: take the nearest true one."""
    u, _, vt = np.linalg.svd(extrinsics[:3, :3])
    return Rigid3(u @ vt, extrinsics[:3, 3])


def nadir_body() -> Rigid3:
    """``body_from_camera`` of recorded flights: straight down, image top toward the nose, no lever arm."""
    return Rigid3(frames.BODY_FROM_NADIR_CAMERA, np.zeros(3))


def attitude_of(map_from_camera: Rigid3, convergence_rad: float) -> FloatArray:
    """``ned_from_body`` (3, 3) of a pose, for the body of `nadir_body`."""
    map_from_body = map_from_camera.rotation @ frames.BODY_FROM_NADIR_CAMERA.T
    return np.asarray(frames.map_from_ned_rotation(convergence_rad).T @ map_from_body, dtype=np.float64)
