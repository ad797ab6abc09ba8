"""A recorded flight over the generated country: ``python -m ortholoc_sim.photos PACK OUT``.

The photos are what a drone would take at another time of year than any survey and in another light: crops, some
trees and roofs differ from every orthophoto. Written as docs/sequences.md has it, so that `replay` and the benchmarks
read them like any flight.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from ortholoc_edge.bench import sequence
from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.arrays import FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.tiles.georeference import Georeference
from ortholoc_edge.tiles.manifest import layer_bounds
from ortholoc_edge.tiles.pack import Pack
from ortholoc_sim.camera import Placement, Renderer, Sensor
from ortholoc_sim.country import FLIGHT, Country, Look
from ortholoc_sim.wide import country_scene

CAMERA = Camera.from_focal(640, 480, 540.0)
# Of a flight's table (docs/sequences.md).
COLUMNS = ("filename", "exif_time", "utm_e", "utm_n", "alt", "qw", "qx", "qy", "qz", "yaw_true_deg", "pitch_deg",
           "roll_deg", "width", "height", "fx", "fy", "cx", "cy")  # fmt: skip
_TEXEL_M = 0.2
_MARGIN_M = 30.0
_SPEED_M_S = 15.0
_MAX_TILT_DEG = 15.0


@dataclass(frozen=True, slots=True, eq=False)
class Photo:
    """A picture and where it was taken."""

    image: ImageArray
    map_from_camera: Rigid3


def photograph(
    country: Country,
    crs: str,
    grid_scale: float,
    camera: Camera,
    map_from_camera: Rigid3,
    look: Look = FLIGHT,
    seed: int = 0,
) -> ImageArray:
    """(H, W, 3) RGB picture of the country from a pose in ``crs`` (heights as in the country's surface).

    Args:
        grid_scale: metres of ``crs`` per true metre there.
        seed: of the sensor's noise.
    Raises: ValueError if the camera sees the horizon.
    """
    eye = map_from_camera.translation
    outline = _footprint(camera, map_from_camera, _lowest(country, crs, eye))
    points = np.concatenate([outline, eye[None, :2]])
    west, south = np.floor(points.min(axis=0) - _MARGIN_M)
    east, north = np.ceil(points.max(axis=0) + _MARGIN_M)
    scene, corner = country_scene(country, crs, look, (west, south, east, north), _TEXEL_M)
    renderer = Renderer(scene, Placement(*corner, grid_scale), Sensor())
    return renderer.render(camera, map_from_camera, seed)


def poses(
    country: Country, georeference: Georeference, points_m: FloatArray, height_agl_m: float, seed: int
) -> Iterator[Rigid3]:
    """Poses over map points (N, 2): heading along them, tilted by up to 15 degrees."""
    crs = _crs(georeference)
    rng = np.random.default_rng([seed, 60])
    headings = np.gradient(points_m, axis=0)
    for xy, ahead in zip(points_m, headings, strict=True):
        frame = country.frame_from(xy[None], crs)
        ground_m = float(country.height(frame[:, 0], frame[:, 1], FLIGHT)[0])
        roll, pitch = np.clip(rng.normal(0.0, 5.0, 2), -_MAX_TILT_DEG, _MAX_TILT_DEG)
        yaw = np.arctan2(ahead[0], ahead[1]) + np.radians(rng.normal(0.0, 6.0))
        # From grid north: the map's axes stand in for north, east, down.
        ned_from_body = rotation.from_euler(np.radians(roll), np.radians(pitch), float(yaw))
        map_from_body = frames.map_from_ned_rotation(0.0) @ ned_from_body
        eye = np.array([*xy, ground_m + height_agl_m * rng.uniform(0.95, 1.05)])
        yield Rigid3(map_from_body @ frames.BODY_FROM_NADIR_CAMERA, eye)


def write_flight(
    pack: Path, out: Path, *, points_m: FloatArray, height_agl_m: float = 120.0, seed: int = 5, progress: bool = False
) -> None:
    """Write photos at map points (N, 2) of a pack of the generated country, and their ``*_flight.csv``.

    Raises: MapError if the pack names no CRS.
    """
    georeference = Pack.open(pack).georeference
    country, crs = Country(seed), _crs(georeference)
    out.mkdir(parents=True, exist_ok=True)
    start = datetime(2024, 10, 12, 15, 0, 0)
    gone_s = 0.0
    before = points_m[0]
    with (out / "generated_flight.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(COLUMNS)
        found = poses(country, georeference, points_m, height_agl_m, seed)
        for k, pose in enumerate(tqdm(found, total=len(points_m), disable=not progress, unit="photo")):
            eye = pose.translation
            scale = georeference.grid_scale(eye[:2], float(eye[2]))
            image = photograph(country, crs, scale, CAMERA, pose, seed=k)
            name = f"photo_{k:04d}.jpg"
            cv2.imwrite(str(out / name), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
            gone_s += float(np.linalg.norm(eye[:2] - before)) / _SPEED_M_S
            before = eye[:2]
            when = start + timedelta(seconds=round(gone_s))
            table.writerow(flight_row(name, when, pose, CAMERA, georeference))


def flight_row(
    filename: str, when: datetime, map_from_camera: Rigid3, camera: Camera, georeference: Georeference
) -> list[str]:
    """A row of a ``*_flight.csv``, in the order of `COLUMNS`."""
    eye = map_from_camera.translation
    attitude = sequence.attitude_of(map_from_camera, georeference.convergence_rad(eye[:2]))
    roll, pitch, yaw = np.degrees(rotation.to_euler(attitude))
    quaternion = rotation.to_quaternion(map_from_camera.rotation.T)
    size_and_focal = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return [filename, when.strftime("%Y:%m:%d %H:%M:%S"), *(f"{v:.4f}" for v in eye),
            *(f"{v:.10f}" for v in quaternion), f"{yaw:.6f}", f"{pitch:.6f}", f"{roll:.6f}",
            *(str(v) for v in size_and_focal)]  # fmt: skip


def lawnmower(bounds: tuple[float, float, float, float], step_m: float, count: int) -> FloatArray:
    """(count, 2) points along rows over a box, ``step_m`` apart, the rows spread over the whole height."""
    west, south, east, north = bounds
    per_row = max(2, round((east - west) / step_m))
    rows = max(1, -(-count // per_row))
    points = []
    for row in range(rows):
        x = np.linspace(west, east, per_row)
        y = south + (row + 0.5) * (north - south) / rows
        points += [(float(v), y) for v in (x if row % 2 == 0 else x[::-1])]
    return np.array(points[:count])


def _crs(georeference: Georeference) -> str:
    if georeference.crs is None:
        raise MapError("the pack has no CRS, so nothing says where in the generated country it lies")
    return str(georeference.crs.to_string() if hasattr(georeference.crs, "to_string") else georeference.crs)


def _lowest(country: Country, crs: str, eye: FloatArray) -> float:
    around = eye[:2] + np.array([[0.0, 0.0], [80.0, 0.0], [-80.0, 0.0], [0.0, 80.0], [0.0, -80.0]])
    frame = country.frame_from(around, crs)
    return float(country.height(frame[:, 0], frame[:, 1], FLIGHT).min()) - 8.0


def _footprint(camera: Camera, map_from_camera: Rigid3, ground_m: float) -> FloatArray:
    """(4, 2) where the corners' rays meet the ground."""
    corners = np.array([[0, 0], [camera.width - 1, 0], [camera.width - 1, camera.height - 1], [0, camera.height - 1]])
    rays = camera.unproject(corners.astype(np.float64)) @ map_from_camera.rotation.T
    if (rays[:, 2] > -0.15 * np.linalg.norm(rays, axis=1)).any():
        raise ValueError("the camera sees the horizon; tilt it down")
    eye = map_from_camera.translation
    return np.asarray(eye[:2] + rays[:, :2] * ((ground_m - eye[2]) / rays[:, 2:]), dtype=np.float64)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Take photos over a pack of the generated country.")
    parser.add_argument("pack", type=Path, metavar="PACK")
    parser.add_argument("out", type=Path, metavar="OUT", help="folder of the flight")
    parser.add_argument("--frames", type=int, default=40, help="photos (default: %(default)s)")
    parser.add_argument("--step", type=float, default=80.0, metavar="M", help="between photos (default: %(default)s)")
    parser.add_argument("--height", type=float, default=120.0, metavar="M", help="above ground (default: %(default)s)")
    parser.add_argument(
        "--side-m", type=float, metavar="M", help="keep to a square of this side around the pack's centre"
    )
    parser.add_argument("--seed", type=int, default=5, help="of the country (default: %(default)s)")
    options = parser.parse_args(arguments)
    west, south, east, north = layer_bounds(Pack.open(options.pack).manifest.dop)
    middle = (west + east) / 2, (south + north) / 2
    half = [0.45 * (east - west), 0.45 * (north - south)]
    if options.side_m is not None:
        half = [min(options.side_m / 2, h) for h in half]
    box = (middle[0] - half[0], middle[1] - half[1], middle[0] + half[0], middle[1] + half[1])
    points = lawnmower(box, options.step, options.frames)
    write_flight(options.pack, options.out, points_m=points, height_agl_m=options.height, seed=options.seed,
                 progress=True)  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main())
