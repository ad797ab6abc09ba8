"""Whether a surface model that was moved is found out, by how much, and that a field gives no answer."""

from __future__ import annotations

import hashlib

import cv2
import numpy as np
import pytest
from lattice_tiles import CRS, VERTICAL, source

from ortholoc_edge.tiles.alignment import consensus, correlations, find_peak, measure, misplaced, warnings
from ortholoc_edge.tiles.encode import NODATA, dop_cog, dsm_cog
from ortholoc_edge.tiles.georeference import Georeference
from ortholoc_edge.tiles.lattice import Lattice, PixelBox
from ortholoc_edge.tiles.levels import STORED_LEVELS
from ortholoc_edge.tiles.manifest import (
    FORMAT,
    VERSION,
    Alignment,
    Dop,
    DopTile,
    Dsm,
    DsmTile,
    Manifest,
    encode_crcs,
)
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

WEST, TOP = 691_200.0, 5_335_040.0
DOP_M, DSM_M = 0.25, 0.5


def town(seed, side_m, houses_per_ha=30.0):
    """Heights and brightness of a town at 0.25 m: turned boxes on rolling ground, and streaks without height."""
    random = np.random.default_rng(seed)
    side = round(side_m / DOP_M)
    heights = cv2.GaussianBlur(random.normal(0.0, 1.0, (side, side)).astype(np.float32), (0, 0), 40.0) * 60.0
    grey = 110.0 + cv2.GaussianBlur(random.normal(0.0, 1.0, (side, side)).astype(np.float32), (0, 0), 6.0) * 40.0
    for _ in range(round(side_m**2 / 1e4 * houses_per_ha)):
        centre, size = random.uniform(0, side, 2), random.uniform(16, 56, 2)
        corners = cv2.boxPoints((centre.tolist(), size.tolist(), random.uniform(0, 90))).astype(np.int32)
        roof = np.zeros((side, side), dtype=np.uint8)
        cv2.fillConvexPoly(roof, corners, 1)
        heights[roof > 0] += random.uniform(3.0, 9.0)
        grey[roof > 0] = random.uniform(60.0, 190.0)
    for _ in range(20):
        ends = random.uniform(0, side, (2, 2)).astype(int).tolist()
        cv2.line(grey, ends[0], ends[1], random.uniform(70.0, 160.0), 12)
    grey += random.normal(0.0, 3.0, grey.shape)
    heights += random.normal(0.0, 0.03, grey.shape)
    return heights, np.clip(grey, 0, 255).astype(np.uint8)


def shifted(heights, east_m, north_m):
    """The surface model at 0.5 m of a scene, displaced."""
    moved = cv2.warpAffine(
        heights,
        np.array([[1.0, 0.0, east_m / DOP_M], [0.0, 1.0, -north_m / DOP_M]]),
        heights.shape[::-1],
        borderMode=cv2.BORDER_REFLECT,
    )
    return cv2.resize(moved, (moved.shape[1] // 2, moved.shape[0] // 2), interpolation=cv2.INTER_AREA)


def write(folder, grey, dsm_tiles, dsm_lattice, dsm_sources=()):
    """A pack of one DOP tile and the given [(box, heights, sources)]."""
    (folder / "dop").mkdir(parents=True)
    (folder / "dsm").mkdir()

    def note(name, data, box):
        (folder / name).write_bytes(data)
        return {
            "file": name,
            "bytes": len(data),
            "sha256": hashlib.sha256(data).hexdigest(),
            "segment_crc32": encode_crcs([0]),
            "valid_fraction": 1.0,
            **box._asdict(),
        }

    side = grey.shape[0]
    dop_lattice = Lattice(west=WEST, top=TOP, pixel_m=DOP_M, tile_px=side, levels=5)
    box = PixelBox(0, 0, side, side)
    rgb = np.repeat(grey[None], 3, axis=0)
    data = dop_cog(rgb, np.ones(grey.shape, dtype=bool), dop_lattice.grid(box), CRS, quality=85)
    dop = Dop(
        lattice=dop_lattice,
        stored_levels=STORED_LEVELS,
        compression="webp",
        sources=[],
        tiles=[DopTile(**note("dop/a.tif", data, box))],
    )
    tiles = []
    for k, (place, heights, sources) in enumerate(dsm_tiles):
        data = dsm_cog(heights, dsm_lattice.grid(place), CRS, 0.01)
        entry = note(f"dsm/{k}.tif", data, place)
        tiles.append(DsmTile(**entry, sources=sources, min_m=float(heights.min()), max_m=float(heights.max())))
    dsm = Dsm(
        lattice=dsm_lattice,
        stored_levels=STORED_LEVELS,
        compression="lerc_zstd",
        sources=list(dsm_sources),
        tiles=tiles,
        max_z_error_m=0.01,
        nodata=NODATA,
    )
    manifest = Manifest(
        format=FORMAT,
        version=VERSION,
        created=None,
        crs=CRS,
        anchor=(WEST, TOP),
        vertical=VERTICAL,
        dop=dop,
        dsm=dsm,
    )
    return Pack(folder, manifest, Georeference(CRS, VERTICAL, (WEST, TOP)))


def measured(folder, heights, grey):
    side = heights.shape[0]
    lattice = Lattice(west=WEST, top=TOP, pixel_m=DSM_M, tile_px=side, levels=5)
    with MapStore(write(folder, grey, [(PixelBox(0, 0, side, side), heights, ())], lattice)) as store:
        return measure(store)


@pytest.fixture(scope="module")
def scene():
    return town(0, 384.0)


@pytest.mark.parametrize("east_m, north_m", [(0.0, 0.0), (0.25, -0.25), (-0.5, 0.0), (1.5, -1.0), (0.0, 4.0)])
def test_a_shift_is_measured_below_a_quarter_of_a_cell(tmp_path, scene, east_m, north_m):
    heights, grey = scene
    found = measured(tmp_path / "pack", shifted(heights, east_m, north_m), grey)
    assert found is not None
    # By which the surface model must be moved to be right again.
    assert found.east_m == pytest.approx(-east_m, abs=0.12)
    assert found.north_m == pytest.approx(-north_m, abs=0.12)
    assert 0.1 <= found.sigma_m < 0.3
    assert found.samples >= 6
    told = warnings(found, DSM_M)
    assert bool(told) == (max(abs(east_m), abs(north_m)) > 0.2)


def test_a_field_gives_no_answer(tmp_path):
    _, grey = town(1, 256.0, houses_per_ha=0.0)
    random = np.random.default_rng(2)
    heights = random.normal(100.0, 0.05, (512, 512)).astype(np.float32)
    assert measured(tmp_path / "pack", heights, grey) is None
    assert warnings(None, DSM_M) == []


def test_a_town_over_another_towns_heights_gives_no_answer(tmp_path, scene):
    other, _ = town(3, 384.0)
    assert measured(tmp_path / "pack", shifted(other, 0.0, 0.0), scene[1]) is None


def test_warnings_name_the_shift_in_metres_and_cells():
    found = Alignment(east_m=0.5, north_m=-0.5, sigma_m=0.2, samples=12)
    (text,) = warnings(found, 1.0)
    assert "0.71 m (0.7 of its cells)" in text
    assert "+0.50 m east and -0.50 m north" in text
    assert warnings(found, 2.0) == []
    assert warnings(Alignment(east_m=0.5, north_m=-0.5, sigma_m=0.4, samples=12), 1.0) == []


def test_peaks_are_found_below_a_cell_and_not_at_the_border():
    v, u = np.mgrid[-12:13, -12:13].astype(np.float64)
    noise = np.random.default_rng(4).normal(0.0, 0.005, u.shape)
    peak = find_peak(np.exp(-((u - 3.3) ** 2 + (v + 2.25) ** 2) / 6.0) + noise)
    assert peak is not None
    assert (peak.east, peak.south) == pytest.approx((3.3, -2.25), abs=0.15)
    assert peak.significance > 10
    assert find_peak(u + v) is None
    assert consensus([], 1.0) is None


def test_a_tile_that_lies_where_another_belongs_is_named(tmp_path):
    # Two tiles of 160 m side by side whose files were swapped.
    heights, grey = town(5, 320.0)
    surface = shifted(heights, 0.0, 0.0)
    lattice = Lattice(west=WEST, top=TOP, pixel_m=DSM_M, tile_px=320, levels=5)
    west, east = surface[:320, :320], surface[:320, 320:]
    boxes = PixelBox(0, 0, 320, 320), PixelBox(320, 0, 320, 320)
    sources = [source("west.tif", None), source("east.tif", None)]

    def found(name, first, second):
        tiles = [(boxes[0], first, (0,)), (boxes[1], second, (1,))]
        with MapStore(write(tmp_path / name, grey, tiles, lattice, sources)) as store:
            return misplaced(store)

    assert found("right", west, east) == []
    first, second = found("swapped", east, west)
    assert "west.tif" in first
    assert "160 m east" in first
    assert "east.tif" in second
    assert "160 m west" in second


def test_holes_of_both_layers_are_no_edges(scene):
    # A round hole that both share would fit at any wrong shift of theirs.
    from ortholoc_edge.geometry.grid import RasterGrid
    from ortholoc_edge.tiles.window import MapWindow

    rows, columns = np.mgrid[:400, :400]
    hole = np.hypot(rows - 200, columns - 200) < 40
    random = np.random.default_rng(6)
    grid = RasterGrid(400, 400, WEST, TOP, DSM_M, -DSM_M)
    grey = np.clip(random.normal(120, 5, (400, 400)), 0, 255).astype(np.uint8)
    grey[hole] = 0
    heights = np.where(hole, np.nan, random.normal(100, 0.1, (400, 400))).astype(np.float32)
    window = MapWindow(grey, ~hole, grid, heights, grid)
    surfaces = correlations(window)
    assert len(surfaces) >= 16
    assert consensus(surfaces, DSM_M) is None
