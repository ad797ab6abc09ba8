"""Recorded sequences with known poses.

A flight folder holds photos and one ``*_flight.csv`` (UTF-8, comma, header), a row per photo in time order:

    filename               path of the photo, relative to the folder; empty: no photo, the row is skipped
    exif_time              "YYYY:MM:DD hh:mm:ss"; equal stamps are taken 0.1 s apart
    utm_e, utm_n, alt      camera centre in the pack's CRS and vertical datum, m
    qw, qx, qy, qz         rotation map (east, north, up) -> camera (right, down, forward)
    yaw_true_deg           heading of the body from true north; with pitch_deg and roll_deg ZYX NED angles of a
    pitch_deg, roll_deg    body whose camera looks straight down, image top toward the nose
    width, height, fx, fy, cx, cy   intrinsics of the undistorted photo, px, pixel centres at integers
"""

from __future__ import annotations

import csv
import datetime
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ortholoc_edge.adapters.camera import read_image
from ortholoc_edge.errors import DatasetError
from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.arrays import FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3

_EQUAL_STAMP_STEP_NS = 100_000_000


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


def nadir_body() -> Rigid3:
    """``body_from_camera`` of recorded flights: straight down, image top toward the nose, no lever arm."""
    return Rigid3(frames.BODY_FROM_NADIR_CAMERA, np.zeros(3))


def attitude_of(map_from_camera: Rigid3, convergence_rad: float) -> FloatArray:
    """``ned_from_body`` (3, 3) of a pose, for the body of `nadir_body`."""
    map_from_body = map_from_camera.rotation @ frames.BODY_FROM_NADIR_CAMERA.T
    return np.asarray(frames.map_from_ned_rotation(convergence_rad).T @ map_from_body, dtype=np.float64)
