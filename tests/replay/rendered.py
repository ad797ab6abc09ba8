"""Pictures of the generated world in the flight's epoch with their true poses, over the committed demo pack.

Made once per session, whichever folder asks first: the world takes seconds.
"""

from __future__ import annotations

import csv
import functools
import math
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from affine import Affine
from ortholoc_sim import demo_pack_path
from ortholoc_sim.camera import Placement, Renderer
from ortholoc_sim.epoch import FLIGHT
from ortholoc_sim.make_demo_pack import DEMO_SOUTH_M, DEMO_SPEC, DEMO_WEST_M
from ortholoc_sim.world import build_scene, generate

from ortholoc_edge.geometry import covariance as cov
from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.arrays import FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.matching.sift import SiftMatcher
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.prior import PosePrior
from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.georeference import Georeference
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore
from ortholoc_edge.tiles.window import MapWindow

SHARED = Path(os.environ.get("ORTHOLOC_EDGE_SHARED", Path(__file__).resolve().parents[2].parent / "shared"))
REAL = SHARED / "data" / "real"

# 70 by 53 m from 70 m up.
CAMERA = Camera.from_focal(480, 360, 405.0)
# Metres from the pack's south-west corner, in its middle: houses, trees, roads.
MIDDLE = (300.0, 250.0)
HEIGHT_M = 90.0


@functools.cache
def store() -> MapStore:
    """The demo pack's, which nobody closes."""
    return MapStore(Pack.open(demo_pack_path()))


def georeference() -> Georeference:
    return store().pack.georeference


@functools.cache
def sift() -> SiftMatcher:
    return SiftMatcher()


@functools.cache
def _renderer() -> Renderer:
    xy = (DEMO_WEST_M + MIDDLE[0], DEMO_SOUTH_M + MIDDLE[1])
    scale = georeference().grid_scale(xy, 400.0)
    return Renderer(build_scene(generate(DEMO_SPEC), FLIGHT), Placement(DEMO_WEST_M, DEMO_SOUTH_M, scale))


def attitude(roll_deg: float = 0.0, pitch_deg: float = 0.0, yaw_deg: float = 0.0) -> FloatArray:
    """``ned_from_body``, true north."""
    return rotation.from_euler(*np.radians([roll_deg, pitch_deg, yaw_deg]))


def pose(
    east_m: float = MIDDLE[0],
    north_m: float = MIDDLE[1],
    height_m: float = HEIGHT_M,
    *,
    roll_deg: float = 0.0,
    pitch_deg: float = 0.0,
    yaw_deg: float = 30.0,
) -> Rigid3:
    """``map_from_camera`` of a nadir camera under a body: metres from the pack's corner and above its ground."""
    xy = np.array([DEMO_WEST_M + east_m, DEMO_SOUTH_M + north_m])
    ground_m = store().ground_near(xy)
    assert ground_m is not None
    map_from_ned = frames.map_from_ned_rotation(georeference().convergence_rad(xy))
    turn = map_from_ned @ attitude(roll_deg, pitch_deg, yaw_deg) @ frames.BODY_FROM_NADIR_CAMERA
    return Rigid3(turn, np.array([*xy, ground_m + height_m]))


_pictures: dict[tuple[Camera, bytes], ImageArray] = {}


def picture(map_from_camera: Rigid3, camera: Camera = CAMERA) -> ImageArray:
    """(H, W, 3) RGB, read-only; drawn once."""
    key = camera, map_from_camera.rotation.tobytes() + map_from_camera.translation.tobytes()
    if key not in _pictures:
        image = _renderer().render(camera, map_from_camera, seed=3)
        image.flags.writeable = False
        _pictures[key] = image
    return _pictures[key]


def frame(map_from_camera: Rigid3, camera: Camera = CAMERA) -> Frame:
    return Frame(7, picture(map_from_camera, camera), "rendered")


def prior(
    truth: Rigid3,
    error_m: tuple[float, float, float] = (2.5, -3.0, 2.0),
    error_deg: tuple[float, float, float] = (0.7, -0.8, 2.5),
    *,
    sigma_m: tuple[float, float] = (3.0, 3.0),
    sigma_deg: tuple[float, float, float] = (1.0, 1.0, 3.0),
) -> PosePrior:
    """The truth moved by ``error_m`` (east, north, up) and turned by ``error_deg`` about map axes."""
    turned = rotation.exp(np.radians(error_deg)) @ truth.rotation
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.diag(np.square([sigma_m[0], sigma_m[0], sigma_m[1]]))
    covariance[3:, 3:] = cov.attitude(
        turned @ frames.BODY_FROM_NADIR_CAMERA.T, tuple(math.radians(s) for s in sigma_deg)
    )
    return PosePrior(Rigid3(turned, truth.translation + error_m), covariance)


def errors(found: Rigid3, truth: Rigid3) -> tuple[float, float]:
    """Metres and degrees."""
    return (
        float(np.linalg.norm(found.translation - truth.translation)),
        math.degrees(rotation.angle_between(found.rotation, truth.rotation)),
    )


@functools.cache
def real_store(name: str) -> MapStore:
    """Of a real set's rasters, built once per session; skips where they are not."""
    folder = REAL / name
    sources = folder / f"{name}_dop.tif", folder / f"{name}_dsm.tif"
    if not all(source.is_file() for source in sources):
        pytest.skip(f"recorded flight {folder} is not here; set ORTHOLOC_EDGE_SHARED")
    with tempfile.TemporaryDirectory(prefix="ortholoc-test-") as scratch:
        # The store holds the files in memory.
        return MapStore(build_pack(*sources, Path(scratch) / name, PackOptions(vertical="unknown")))


def write_flight(folder: Path, poses: Sequence[Rigid3], camera: Camera = CAMERA, seconds: int = 5) -> Path:
    """A recorded sequence as `ortholoc_edge.bench.sequence` documents it, of rendered pictures."""
    rows = []
    for index, map_from_camera in enumerate(poses):
        name = f"photos/frame_{index:02d}.jpg"
        write_picture(folder / name, picture(map_from_camera, camera))
        east, north, height = map_from_camera.translation
        convergence = georeference().convergence_rad(map_from_camera.translation[:2])
        ned_from_body = (
            frames.map_from_ned_rotation(convergence).T @ map_from_camera.rotation @ frames.BODY_FROM_NADIR_CAMERA.T
        )
        roll, pitch, yaw = np.degrees(rotation.to_euler(ned_from_body))
        qw, qx, qy, qz = rotation.to_quaternion(map_from_camera.rotation.T)
        second = seconds * index
        rows.append(
            {
                "filename": name,
                "exif_time": f"2024:10:03 10:{second // 60:02d}:{second % 60:02d}",
                "utm_e": east, "utm_n": north, "alt": height,
                "qw": qw, "qx": qx, "qy": qy, "qz": qz,
                "yaw_true_deg": yaw, "pitch_deg": pitch, "roll_deg": roll,
                "width": camera.width, "height": camera.height,
                "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
            }
        )  # fmt: skip
    with (folder / "rendered_flight.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return folder


def map_window(reach_m: float, gsd_m: float) -> MapWindow:
    """The map within ``reach_m`` of the pack's middle."""
    x, y = pose().translation[:2]
    window = store().read((x - reach_m, y - reach_m, x + reach_m, y + reach_m), gsd_m)
    assert window is not None
    return window


def write_map(window: MapWindow, dop: Path, dsm: Path, crs: str | None = "EPSG:32632") -> None:
    """Plain GeoTIFFs of a window of this pack's, as packs are built from."""
    grid = window.dop_grid
    picture = store().read_colour(grid.bounds, grid.gsd_m)
    assert picture is not None
    assert picture.grid == grid
    for path, bands, own in (
        (dop, np.moveaxis(picture.rgb, 2, 0), grid),
        (dsm, window.dsm[None], window.dsm_grid),
    ):
        with rasterio.open(
            path, "w", driver="GTiff", width=own.width, height=own.height, count=len(bands), dtype=bands.dtype.name,
            crs=crs, transform=Affine(own.dx, 0, own.west, 0, own.dy, own.top),
        ) as target:  # fmt: skip
            target.write(bands)


def write_picture(path: Path, image: ImageArray) -> Path:
    """As JPEG or PNG, by its ending."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image[..., ::-1])
    return path
