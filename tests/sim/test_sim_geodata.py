"""Generated geodata: sheets show the one country, whatever their grid, format and process."""

from __future__ import annotations

import gzip
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from ortholoc_sim.country import CENTRE, FLIGHT, FRAME, SURVEYS, Country
from ortholoc_sim.geodata import EAST_CRS, NODATA, WEST_CRS, Published, Sheet, write_area, write_sheet
from ortholoc_sim.photos import CAMERA, photograph
from pyproj import Transformer
from rasterio.enums import ColorInterp

from ortholoc_edge.geometry import frames
from ortholoc_edge.geometry.grid import RasterGrid, bilinear
from ortholoc_edge.geometry.rigid import Rigid3

_SIDE_M = 200.0


@pytest.fixture(scope="module")
def area(tmp_path_factory: pytest.TempPathFactory) -> Published:
    return write_area(tmp_path_factory.mktemp("geodata"), side_km=0.6, sheet_m=_SIDE_M, dop_gsd_m=0.25)


def _opened(sheet: Sheet) -> str:
    if sheet.path.suffix == ".zip":
        return f"/vsizip/{sheet.path}/{next(n for n in _members(sheet) if n.endswith(('.tif', '.xyz')))}"
    return f"/vsigzip/{sheet.path}" if sheet.path.suffix == ".gz" else str(sheet.path)


def _members(sheet: Sheet) -> list[str]:
    with zipfile.ZipFile(sheet.path) as archive:
        return archive.namelist()


def _shift_px(a: np.ndarray, b: np.ndarray) -> float:
    window = cv2.createHanningWindow(a.shape[::-1], cv2.CV_64F)
    # Copies: phaseCorrelate works on its arguments.
    (u, v), _ = cv2.phaseCorrelate(a.astype(np.float64).copy(), b.astype(np.float64).copy(), window)
    return float(np.hypot(u, v))


def test_area_has_both_zones_all_formats_and_the_traps(area: Published) -> None:
    assert {s.crs for s in area.sheets} == {WEST_CRS, EAST_CRS}
    assert {s.format for s in area.sheets if s.kind == "dop"} == {"jp2", "tif", "tif16", "rgbi", "zip", "cog", "jpg"}
    assert {"tif", "zip_xyz", "xyz_gz", "zip_tif", "cog"} <= {s.format for s in area.sheets if s.kind == "dsm"}
    assert sum(s.collar for s in area.sheets) == 1
    places: dict[tuple[str, float, float], set[int]] = {}
    for sheet in area.sheets:
        if sheet.kind == "dop":
            places.setdefault((sheet.crs, sheet.west_m, sheet.south_m), set()).add(sheet.year)
    assert any(2019 in years and len(years) == 2 for years in places.values())


def test_every_file_opens_with_its_grid_and_crs(area: Published) -> None:
    for sheet in area.sheets:
        if sheet.format == "laz":
            continue
        with rasterio.open(_opened(sheet)) as raster:
            assert raster.transform.a == pytest.approx(sheet.gsd_m)
            west = raster.transform.c
            assert sheet.west_m - 1e-6 <= west < sheet.west_m + sheet.side_m
            if sheet.format in ("jpg", "zip_xyz", "xyz_gz"):
                assert raster.crs is None
            else:
                assert f"UTM zone {sheet.crs[-2:]}N" in raster.crs.to_wkt()
            if sheet.format in ("jp2", "rgbi"):
                assert raster.count == 4
                assert ColorInterp.alpha not in raster.colorinterp
            if sheet.format == "tif16":
                assert raster.dtypes == ("uint16",) * 3
                assert raster.read(1).max() > 255


@pytest.mark.parametrize("crs", [WEST_CRS, EAST_CRS])
@pytest.mark.parametrize("form", ["jp2", "tif"])
def test_orthophotos_show_the_truth_in_their_own_grid(area: Published, crs: str, form: str) -> None:
    sheet = next(s for s in area.sheets if s.kind == "dop" and s.crs == crs and s.format == form and not s.collar)
    with rasterio.open(sheet.path) as raster:
        shown = raster.read([1, 2, 3])[:, 200:456, 200:456].mean(axis=0)
    u, v = np.meshgrid(np.arange(200, 456), np.arange(200, 456))
    points = sheet.grid.map_from_px(np.stack([u.ravel(), v.ravel()], axis=1))
    frame = area.country.frame_from(points, crs)
    truth = area.country.colour(frame[:, 0], frame[:, 1], SURVEYS[sheet.year], 0.25).mean(axis=1).reshape(256, 256)
    assert _shift_px(shown, truth) < 0.15
    assert np.corrcoef(shown.ravel(), truth.ravel())[0, 1] > 0.93


def test_zones_fit_at_the_border() -> None:
    country, look = Country(), SURVEYS[2023]
    west = RasterGrid(400, 400, 714_760.0, 5_548_100.0, 0.25, -0.25)
    middle = country.frame_from(np.array([[285_240.0, 5_548_020.0]]), EAST_CRS)[0]
    assert np.hypot(*(middle - (714_810.0, 5_548_050.0))) < 200.0
    shown = country.rgb(west, FRAME, look).mean(axis=2).astype(np.float32)
    # The same 100 m x 100 m drawn on the other zone's grid, then looked up point by point.
    u, v = np.meshgrid(np.arange(40, 360), np.arange(40, 360))
    points = west.map_from_px(np.stack([u.ravel(), v.ravel()], axis=1))
    east_points = np.stack(_to_east(points), axis=1)
    low = np.floor(east_points.min(axis=0)) - 2
    size = np.ceil((east_points.max(axis=0) + 2 - low) * 4).astype(int)
    east = RasterGrid(int(size[0]), int(size[1]), low[0], low[1] + size[1] / 4, 0.25, -0.25)
    other = bilinear(country.rgb(east, EAST_CRS, look).mean(axis=2).astype(np.float32), east.px_from_map(east_points))
    here = shown[40:360, 40:360]
    assert _shift_px(here, other.reshape(here.shape)) < 0.1
    assert np.corrcoef(here.ravel(), other)[0, 1] > 0.97


def _to_east(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    east, north = Transformer.from_crs(FRAME, EAST_CRS, always_xy=True).transform(points[:, 0], points[:, 1])
    return np.asarray(east), np.asarray(north)


def test_content_does_not_depend_on_the_tiling() -> None:
    country, look = Country(), SURVEYS[2021]
    whole = RasterGrid(500, 400, CENTRE[0] - 60, CENTRE[1] + 40, 0.25, -0.25)
    part = whole.crop(130, 90, 300, 250)
    difference = np.abs(
        country.rgb(whole, FRAME, look)[90:340, 130:430].astype(int) - country.rgb(part, FRAME, look).astype(int)
    )
    assert (difference > 3).mean() < 0.002
    heights = country.heights(whole, FRAME, look)[90:340, 130:430] - country.heights(part, FRAME, look)
    assert np.abs(heights).mean() < 0.005
    assert (np.abs(heights) > 0.05).mean() < 0.002


def test_surface_models_hold_the_truth_and_have_holes(area: Published) -> None:
    holes = 0
    for sheet in (s for s in area.sheets if s.kind == "dsm" and s.format in ("tif", "cog")):
        with rasterio.open(sheet.path) as raster:
            heights = raster.read(1)
            assert raster.nodata == NODATA
        holes += int((heights == NODATA).sum())
        px = np.array([[31, 17], [120, 80], [66, 150], [150, 33]])
        stored = heights[px[:, 1], px[:, 0]]
        frame = area.country.frame_from(sheet.grid.map_from_px(px), sheet.crs)
        truth = area.country.height(frame[:, 0], frame[:, 1], SURVEYS[sheet.year])
        valid = stored != NODATA
        # Off a steep edge; at one, a pixel of the truth is on the other side.
        assert np.median(np.abs(stored - truth)[valid]) < 0.05
    assert holes > 50


def test_text_heights_name_pixel_centres(area: Published) -> None:
    sheet = next(s for s in area.sheets if s.format == "xyz_gz")
    text = gzip.decompress(sheet.path.read_bytes()).splitlines()
    lines = np.array([[float(v) for v in line.split()] for line in text])
    px = sheet.grid.px_from_map(lines[:, :2])
    assert np.abs(px - np.round(px)).max() < 1e-6
    assert 390.0 < lines[:, 2].min() < lines[:, 2].max() < 470.0


def test_collar_is_black_beyond_the_border(area: Published) -> None:
    sheet = next(s for s in area.sheets if s.collar)
    with rasterio.open(sheet.path) as raster:
        picture = raster.read()
    assert (picture[:, :, -40:] < 12).mean() > 0.3
    assert (picture[:, :, :40] > 20).mean() > 0.9


def test_epochs_differ_but_show_one_place() -> None:
    country = Country()
    grid = RasterGrid(600, 600, CENTRE[0] - 75, CENTRE[1] + 75, 0.25, -0.25)
    old, new = (country.rgb(grid, FRAME, SURVEYS[year]).astype(int) for year in (2019, 2023))
    assert np.abs(old - new).mean() > 10
    edges = [cv2.Canny(picture.astype(np.uint8), 100, 200).astype(np.float64) for picture in (old, new)]
    assert _shift_px(cv2.GaussianBlur(edges[0], (0, 0), 2), cv2.GaussianBlur(edges[1], (0, 0), 2)) < 1.0


def test_equal_arguments_give_equal_bytes(area: Published, tmp_path: Path) -> None:
    for kind, form in (("dop", "zip"), ("dop", "cog"), ("dsm", "xyz_gz"), ("dsm", "cog")):
        sheet = next(s for s in area.sheets if (s.kind, s.format) == (kind, form))
        again = Sheet(**{name: getattr(sheet, name) for name in Sheet.__slots__} | {"path": tmp_path / sheet.path.name})
        write_sheet(again, area.country.seed)
        assert again.path.read_bytes() == sheet.path.read_bytes(), form


def test_a_photo_lies_where_its_pose_says() -> None:
    country = Country()
    eye = np.array([CENTRE[0] + 30.0, CENTRE[1] + 60.0, 520.0])
    nadir = Rigid3(frames.map_from_ned_rotation(0.0) @ frames.BODY_FROM_NADIR_CAMERA, eye)
    image = photograph(country, FRAME, 1.0, CAMERA, nadir)
    # The ground below the camera, at the scale of its height there.
    height = float(country.height(eye[:1], eye[1:2], FLIGHT)[0])
    gsd = (eye[2] - height) / CAMERA.fx
    grid = RasterGrid(240, 240, eye[0] - 120 * gsd, eye[1] + 120 * gsd, gsd, -gsd)
    below = country.rgb(grid, FRAME, FLIGHT).mean(axis=2)
    row, column = round(CAMERA.cy + 0.5) - 120, round(CAMERA.cx + 0.5) - 120
    seen = image[row : row + 240, column : column + 240].mean(axis=2)
    assert _shift_px(below, seen) < 1.0
