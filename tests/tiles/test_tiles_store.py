"""What flies reads: windows of many tiles as of one raster, and holes where tiles are missing or damaged."""

import functools
import hashlib
import logging
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import msgspec
import numpy as np
import packs
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterio.env import get_gdal_config
from rasterio.io import MemoryFile

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.grid import bilinear
from ortholoc_edge.tiles import encode, store
from ortholoc_edge.tiles.cache import BlockCache
from ortholoc_edge.tiles.cog import MAX_HANDLES, Cog, PixelWindow
from ortholoc_edge.tiles.lattice import LEVELS, PixelBox
from ortholoc_edge.tiles.levels import STORED_LEVELS, halved_heights, halved_image
from ortholoc_edge.tiles.manifest import MANIFEST_NAME, FeatureLayer, FeatureTile, write_manifest
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore, WindowTooLargeError

DOP_PX, DSM_PX = (960, 704), (320, 256)
DOP_BOX, DSM_BOX = PixelBox(*packs.DOP_CORNER, *DOP_PX), PixelBox(*packs.DSM_CORNER, *DSM_PX)
DOP_GRID, DSM_GRID = packs.DOP_LATTICE.grid(DOP_BOX), packs.DSM_LATTICE.grid(DSM_BOX)
WEST, SOUTH, EAST, NORTH = DOP_GRID.bounds


def pixels(width, height):
    v, u = np.mgrid[:height, :width]
    return np.stack([1 + u % 251, 1 + v % 241, 1 + u // 251 * 40 + v // 241 * 7]).astype(np.uint8)


@functools.cache
def scene():
    """Every pixel tells where it is; holes that cross tiles' borders."""
    rng = np.random.default_rng(5)
    rgb = pixels(*DOP_PX)
    valid = np.ones(rgb.shape[1:], dtype=bool)
    valid[300:450, 150:320] = False
    heights = rng.uniform(250.0, 420.0, (DSM_PX[1], DSM_PX[0])).astype(np.float32)
    heights[100:180, 40:90] = np.nan
    heights[rng.random(heights.shape) < 0.001] = np.nan
    return rgb, valid, heights


@pytest.fixture(scope="module")
def pack(tmp_path_factory):
    rgb, valid, heights = scene()
    return packs.write_pack(tmp_path_factory.mktemp("many") / "pack", rgb, heights, valid=valid, max_z_error_m=0.0)


@pytest.fixture(scope="module")
def whole():
    """The same as two files of one piece."""
    rgb, valid, heights = scene()
    dop = Cog(encode.dop_cog(rgb, valid, DOP_GRID, packs.CRS, "webp", 100), Path("whole dop"))
    dsm = Cog(encode.dsm_cog(heights, DSM_GRID, packs.CRS, 0.0), Path("whole dsm"))
    with dop, dsm:
        yield dop, dsm


@pytest.fixture(scope="module")
def sound(pack):
    with MapStore(pack) as opened:
        yield opened


@pytest.fixture
def copied(pack, tmp_path):
    return shutil.copytree(pack.path, tmp_path / "pack")


def same(a, b):
    return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")


def finer(window):
    return PixelWindow(*(2 * value for value in window))


def averaged_image(one, level, window):
    """What a COG has of a level, or the mean of the next finer one: RGB (H, W, 3) and validity."""
    if level in one.grids:
        bands, mask = one.read_image(level, window)
        return np.moveaxis(bands, 0, -1), mask
    return halved_image(*averaged_image(one, level - 1, finer(window)))


def averaged_heights(one, level, window):
    if level in one.grids:
        return one.read_heights(level, window)
    return halved_heights(averaged_heights(one, level - 1, finer(window)))[0]


def everything(opened, level=0):
    """(DOP, validity, DSM) of all tiles."""
    dop, dsm = opened.dop_grids[level], opened.dsm_grids[level]
    return (
        *opened._dop.read_rgb(level, PixelWindow(0, 0, dop.width, dop.height)),
        opened._dsm.read_heights(level, PixelWindow(0, 0, dsm.width, dsm.height)),
    )


# -- many tiles as one ---------------------------------------------------------------------------------


def test_scene_is_cut_into_tiles_whose_rims_are_cropped(pack, sound):
    assert (len(pack.manifest.dop.tiles), len(pack.manifest.dsm.tiles)) == (6, 6)
    assert {(t.width, t.height) for t in pack.manifest.dop.tiles} >= {(192, 384), (512, 320)}
    assert len(sound.dop_grids) == len(sound.dsm_grids) == LEVELS
    assert sound.dop_grids[0] == DOP_GRID
    assert sound.dsm_grids[0] == DSM_GRID
    assert sound.bounds == DOP_GRID.bounds
    assert sound.damaged == []
    rgb, valid, heights = scene()
    dop, dop_valid, dsm = everything(sound)
    assert same(dop[valid], np.moveaxis(rgb, 0, -1)[valid])
    assert same(dop_valid, valid)
    assert same(dsm, heights)


@settings(max_examples=150, deadline=None)
@given(data=st.data(), level=st.integers(0, LEVELS - 1))
def test_any_window_is_that_of_the_whole_raster(sound, whole, data, level):
    for opened, one, grids in ((sound._dop, whole[0], sound.dop_grids), (sound._dsm, whole[1], sound.dsm_grids)):
        grid = grids[level]
        assert level not in one.grids or one.grids[level] == grid
        column, row = data.draw(st.integers(0, grid.width - 1)), data.draw(st.integers(0, grid.height - 1))
        width = data.draw(st.integers(1, grid.width - column))
        window = PixelWindow(column, row, width, data.draw(st.integers(1, grid.height - row)))
        if one is whole[0]:
            rgb, valid = opened.read_rgb(level, window)
            expected, mask = averaged_image(one, level, window)
            assert same(valid, mask)
            assert same(rgb[valid], expected[mask])
        else:
            assert same(opened.read_heights(level, window), averaged_heights(one, level, window))


@settings(max_examples=100, deadline=None)
@given(points=st.lists(st.tuples(st.floats(-20, 400), st.floats(-20, 340)), max_size=40))
def test_heights_are_bilinear_also_across_tiles(sound, points):
    xy = np.add(np.array(points).reshape(-1, 2), (DSM_GRID.west, DSM_GRID.bounds[1]))
    assert np.allclose(
        sound.heights(xy), bilinear(scene()[2], DSM_GRID.px_from_map(xy)), rtol=0, atol=1e-6, equal_nan=True
    )


def test_heights_on_the_seams(sound):
    """Half way between the last cell of one tile and the first of the next: the mean of both."""
    heights = scene()[2]
    columns = np.array([63, 191])  # the last of their tiles: the first tile is cropped by 64
    rows = np.full(2, 20)
    assert np.isfinite(heights[20, [63, 64, 191, 192]]).all()
    found = sound.heights(DSM_GRID.map_from_px(np.stack([columns + 0.5, rows], axis=-1)))
    assert np.allclose(found, (heights[20, columns] + heights[20, columns + 1]) / 2.0, rtol=0, atol=1e-4)


def test_ground_near_is_the_median_of_what_is_there(sound):
    at = DSM_GRID.map_from_px([200.0, 200.0])
    assert sound.ground_near(at) == pytest.approx(335.0, abs=60.0)
    assert sound.ground_near(DSM_GRID.map_from_px([65.0, 140.0])) is not None  # in the hole: from around it
    assert sound.ground_near((WEST - 5000.0, SOUTH)) is None
    assert sound.ground_near((np.nan, SOUTH)) is None


@pytest.mark.parametrize(
    ("gsd_m", "dop_level", "dsm_level"),
    [(0.01, 0, 0), (0.25, 0, 0), (0.34, 0, 0), (0.36, 1, 0), (0.5, 1, 0), (0.72, 2, 1), (1.0, 2, 1), (50.0, 4, 3)],
)
def test_level_is_the_coarsest_that_suits(sound, gsd_m, dop_level, dsm_level):
    """Of the DOP up to the square root of two coarser, of the DSM twice the DOP's pixels."""
    region = (WEST + 50, SOUTH + 50, WEST + 150, SOUTH + 150)
    window = sound.read(region, gsd_m)
    assert window.dop_grid.dx == sound.dop_grids[dop_level].dx
    assert window.dsm_grid.dx == sound.dsm_grids[dsm_level].dx
    assert sound.read(region, gsd_m, dsm_gsd_m=0.01).dsm_grid.dx == DSM_GRID.dx


@settings(max_examples=80, deadline=None)
@given(
    corner=st.tuples(st.floats(-60, 280), st.floats(-60, 210)),
    size=st.tuples(st.floats(0.001, 300), st.floats(0.001, 300)),
    gsd=st.sampled_from([0.25, 0.5, 1.0, 4.0]),
)
def test_window_covers_the_region_and_no_pixel_more(sound, corner, size, gsd):
    west, south = WEST + corner[0], SOUTH + corner[1]
    bounds = (west, south, west + size[0], south + size[1])
    inside = (max(bounds[0], WEST), max(bounds[1], SOUTH), min(bounds[2], EAST), min(bounds[3], NORTH))
    window = sound.read(bounds, gsd)
    # Within a millionth of a pixel of the edge either answer is right.
    if inside[0] > inside[2] or inside[1] > inside[3]:
        assert window is None
        return
    if window is None:
        assert min(inside[2] - inside[0], inside[3] - inside[1]) < 1e-5
        return
    grid, slack = window.dop_grid, 1e-5
    assert window.dop_grey.shape == (grid.height, grid.width)
    assert window.dsm.shape == (window.dsm_grid.height, window.dsm_grid.width)
    outer = grid.bounds
    assert outer[0] <= inside[0] + slack < outer[0] + grid.dx + 2 * slack
    assert outer[2] >= inside[2] - slack > outer[2] - grid.dx - 2 * slack
    assert outer[1] <= inside[1] + slack < outer[1] - grid.dy + 2 * slack
    assert outer[3] >= inside[3] - slack > outer[3] + grid.dy - 2 * slack
    # Pixels stay on the level's own lattice, and their contents belong there.
    level = [one.dx for one in sound.dop_grids].index(grid.dx)
    whole_grid = sound.dop_grids[level]
    column, row = (round(v) for v in ((grid.west - WEST) / grid.dx, (grid.top - NORTH) / grid.dy))
    assert grid == whole_grid.crop(column, row, grid.width, grid.height)
    grey, valid = sound._dop.read_grey(level, PixelWindow(column, row, grid.width, grid.height))
    assert same(window.dop_grey, grey)
    assert same(window.dop_valid, valid)
    # The surface model reaches beyond the orthophoto's pixel centres, for bilinear look-ups.
    cells = window.dsm_grid.px_from_map(grid.map_from_px([[0, 0], [grid.width - 1, grid.height - 1]]))
    dsm_outer, dsm_map = window.dsm_grid.bounds, DSM_GRID.bounds
    if dsm_outer[0] > dsm_map[0] + 1e-6:
        assert cells[0, 0] >= 0.5
    if dsm_outer[2] < dsm_map[2] - 1e-6:
        assert cells[1, 0] <= window.dsm_grid.width - 1.5


def test_region_outside_gives_none(sound):
    assert sound.read((WEST - 50, SOUTH, WEST - 1, NORTH), 0.25) is None
    assert sound.read((WEST - 50, SOUTH, WEST, NORTH), 0.25) is None
    assert sound.read((WEST, NORTH + 1, EAST, NORTH + 9), 0.25) is None


@pytest.mark.parametrize(
    "arguments",
    [
        ((EAST, SOUTH, WEST, NORTH), 0.1),
        ((WEST, SOUTH, EAST, float("nan")), 0.1),
        ((WEST, SOUTH, EAST, NORTH), 0.0),
        ((WEST, SOUTH, EAST, NORTH), float("nan")),
        ((WEST, SOUTH, EAST, NORTH), 0.1, -1.0),
    ],
)
def test_unusable_requests_are_refused(sound, arguments):
    with pytest.raises(ValueError, match=r"unusable|positive"):
        sound.read(*arguments)


def test_too_large_a_window_is_refused(pack):
    with MapStore(pack, max_pixels=100_000) as opened:
        with pytest.raises(WindowTooLargeError, match="exceeds 100000 px"):
            opened.read(opened.bounds, 0.25)
        assert opened.read((WEST, SOUTH, WEST + 20, SOUTH + 20), 0.25) is not None


def test_arrays_cannot_be_changed_by_a_consumer(sound):
    window = sound.read((WEST, SOUTH, WEST + 140, SOUTH + 140), 0.25)
    for array in (window.dop_grey, window.dop_valid, window.dsm):
        assert not array.flags.writeable
        assert array.flags.c_contiguous


def test_area_without_tiles_is_a_hole(tmp_path, sound):
    """An L-shaped area, or a corridor: tiles that never were."""
    rgb, valid, heights = scene()
    gaps = frozenset({("dop", 1, 1), ("dsm", 1, 0), ("dsm", 1, 1)})
    sparse = packs.write_pack(tmp_path, rgb, heights, valid=valid, leave_out=gaps, max_z_error_m=0.0)
    assert sparse.verify() == []
    with MapStore(sparse) as opened:
        assert opened.damaged == []
        dop, dop_valid, dsm = everything(opened)
        before = everything(sound)
        in_gap = np.zeros_like(dop_valid)
        in_gap[512 - 128 :, 512 - 320 : 1024 - 320] = True
        assert not dop_valid[in_gap].any()
        assert same(dop_valid[~in_gap], before[1][~in_gap])
        assert same(dop[dop_valid], before[0][dop_valid])
        assert np.isnan(dsm[:256, 64:192]).all()
        assert same(dsm[:, 192:], before[2][:, 192:])
        beside = DSM_GRID.map_from_px([[63.0, 20.0], [63.5, 20.0], [100.0, 20.0]])
        assert list(np.isfinite(opened.heights(beside))) == [True, False, False]


# -- memory, threads, life -----------------------------------------------------------------------------


def test_several_threads_read_what_one_does(pack):
    rng = np.random.default_rng(7)
    corners = rng.uniform((WEST, SOUTH), (EAST - 60, NORTH - 60), size=(60, 2))
    requests = [((x, y, x + 90.0, y + 70.0), 0.25 * 2 ** (k % 4)) for k, (x, y) in enumerate(corners)]

    def read(opened, request):
        window = opened.read(*request)
        return window.dop_grey, window.dop_valid, window.dsm, opened.heights(corners)

    with MapStore(pack) as one, MapStore(pack) as other, ThreadPoolExecutor(8) as pool:
        alone = [read(one, request) for request in requests]
        together = list(pool.map(lambda request: read(other, request), requests))
    for a, b in zip(alone, together, strict=True):
        assert all(map(same, a, b))


@pytest.fixture
def decoded(monkeypatch):
    """Blocks in the order in which they are decoded: (file, level, column, row)."""
    found = []

    def listed(read):
        def reading(cog, level, window):
            found.append((cog.path.parent.name, cog.path.name, level, window.column, window.row))
            return read(cog, level, window)

        return reading

    for name in ("read_image", "read_heights"):
        monkeypatch.setattr(Cog, name, listed(getattr(Cog, name)))
    return found


def test_open_handles_are_bounded(pack, monkeypatch):
    opened_levels = []
    open_level = Cog.open_level
    monkeypatch.setattr(Cog, "open_level", lambda cog, level: opened_levels.append(level) or open_level(cog, level))
    with MapStore(pack) as opened:
        assert opened_levels == []  # nothing before it is asked for
        for level in (*range(LEVELS), 0):
            everything(opened, level)
            assert len(opened._dop._handles) == min(MAX_HANDLES, len(opened_levels))
        handles = opened._dop._handles
    assert len(handles) == 0


@pytest.mark.parametrize("gsd_m", [0.25, 0.5, 1.0, 2.0, 4.0])
def test_what_was_seen_before_is_not_decoded_again(pack, decoded, gsd_m):
    """Of a level that is stored or averaged; also not what only the frame before the last saw."""
    reach = min(240 * gsd_m, 120.0)
    first, other = ((x, SOUTH + 20, x + reach, SOUTH + 20 + reach) for x in (WEST + 10, WEST + 10 + 0.6 * reach))
    with MapStore(pack) as opened:
        windows = [opened.read(bounds, gsd_m) for bounds in (first, other)]
        opened.heights(DSM_GRID.map_from_px([[150.0, 150.0]]), 2 * gsd_m)
        assert len(decoded) == len(set(decoded)) > 0
        count = len(decoded)
        again = [opened.read(bounds, gsd_m) for bounds in (first, other)]
        opened.heights(DSM_GRID.map_from_px([[150.0, 150.0]]), 2 * gsd_m)
        assert len(decoded) == count
        opened.forget_decoded()
        opened.read(first, gsd_m)
        assert len(decoded) > count
    for before, after in zip(windows, again, strict=True):
        assert same(before.dop_grey, after.dop_grey)
        assert same(before.dop_valid, after.dop_valid)
        assert same(before.dsm, after.dsm)


def test_a_level_that_is_not_stored_is_held_as_it_is(pack, decoded):
    """Not as the four times as many pixels that it was averaged from."""
    with MapStore(pack) as opened:
        grid = opened.dop_grids[1]
        grey, valid = opened._dop.read_grey(1, PixelWindow(0, 0, grid.width, grid.height))
        assert {level for _, _, level, _, _ in decoded} == {0}
        assert grey.nbytes <= opened._cache.bytes <= grey.nbytes + valid.nbytes


def test_grey_is_that_of_the_colours(sound):
    for level, grid in enumerate(sound.dop_grids):
        window = PixelWindow(0, 0, grid.width, grid.height)
        rgb, valid = sound._dop.read_rgb(level, window)
        grey, grey_valid = sound._dop.read_grey(level, window)
        assert same(grey, cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))
        assert same(valid, grey_valid)
        assert not valid.all() or level == LEVELS - 1
        seen = sound.read_colour(grid.bounds, grid.gsd_m)
        assert same(seen.rgb, rgb)
        assert same(seen.valid, valid)
        assert seen.grid == grid


def test_colours_of_a_region_outside_or_too_large(pack, sound):
    assert sound.read_colour((WEST - 50, SOUTH, WEST - 1, NORTH), 0.25) is None
    with MapStore(pack, max_pixels=100_000) as opened, pytest.raises(WindowTooLargeError, match="exceeds 100000 px"):
        opened.read_colour(opened.bounds, 0.25)


def test_bytes_in_memory_are_not_copied_for_gdal():
    def resident():
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4096

    data = b"\x01" * 64_000_000
    before = resident()
    with MemoryFile(data):
        assert resident() - before < 16_000_000


@pytest.mark.parametrize("limit", [1, 300_000, 600_000])
def test_cache_is_bounded_and_memory_is_the_files(pack, sound, limit):
    with MapStore(pack, cache_bytes=limit) as opened:
        # What is decoded is held once: not by GDAL too.
        assert int(get_gdal_config("GDAL_CACHEMAX")) <= 2**20
        assert opened.compressed_bytes == sum(path.stat().st_size for path in pack.path.glob("d*/*.tif"))
        for level, (grid, dsm_grid) in enumerate(zip(sound.dop_grids, sound.dsm_grids, strict=True)):
            whole_dop = PixelWindow(0, 0, grid.width, grid.height)
            whole_dsm = PixelWindow(0, 0, dsm_grid.width, dsm_grid.height)
            assert all(map(same, opened._dop.read_grey(level, whole_dop), sound._dop.read_grey(level, whole_dop)))
            assert same(opened._dsm.read_heights(level, whole_dsm), sound._dsm.read_heights(level, whole_dsm))
            assert opened._cache.bytes <= limit
        assert (len(opened._cache) > 0) == (limit > 1)
        cache = opened._cache
    assert (len(cache), cache.bytes) == (0, 0)


def test_block_used_longest_ago_goes_first():
    cache = BlockCache(300)
    for key in "abc":
        cache.put(key, (np.zeros(60, np.uint8), np.zeros(10, np.float32)))
    assert cache.bytes == 300
    assert cache.get("a") is not None
    cache.put("d", (np.zeros(150, np.uint8),))
    assert [key for key in "abcd" if cache.get(key) is not None] == ["a", "d"]
    assert cache.bytes == 250
    cache.put("e", (np.zeros(301, np.uint8),))
    assert (len(cache), cache.bytes) == (0, 0)
    # One value that stands for all takes no memory to speak of.
    cache.put("f", (np.broadcast_to(np.True_, (500, 500)),))
    assert (len(cache), cache.bytes) == (1, 1)


def test_pack_over_the_budget_is_refused_before_anything_is_read(pack, monkeypatch):
    size = sum(path.stat().st_size for path in pack.path.glob("d*/*.tif"))
    with MapStore(pack, memory_bytes=size) as opened:
        assert opened.compressed_bytes == size
    monkeypatch.setattr(store, "LoadedLayer", None)
    remedies = r"MiB are allowed.*--area.*--max-size.*map\.memory_mb"
    with pytest.raises(MapError, match=rf"{size / 2**20:.0f} MiB to be held.*{remedies}"):
        MapStore(pack, memory_bytes=size - 1)


def test_files_are_not_needed_after_loading(copied, sound):
    with MapStore(Pack.open(copied)) as opened:
        shutil.rmtree(copied)
        assert all(map(same, everything(opened), everything(sound)))


def test_closed_store_says_so(pack, caplog):
    opened = MapStore(pack)
    opened.close()
    opened.close()
    with pytest.raises(MapError, match="closed"):
        opened.read(DOP_GRID.bounds, 1.0)
    with pytest.raises(MapError, match="closed"):
        opened.heights([(WEST + 100, SOUTH + 100)])
    assert opened.damaged == []
    assert caplog.text == ""


# -- damage --------------------------------------------------------------------------------------------


def flip(path, at):
    data = bytearray(path.read_bytes())
    data[at] ^= 0x40
    path.write_bytes(data)


def tile_of(pack, layer, column, row):
    described = getattr(pack.manifest, layer)
    return next(t for t in described.tiles if described.lattice.tile_key(t.column, t.row) == (column, row))


def offset_of(path, column=0, row=0, level=0):
    with MemoryFile(path.read_bytes()) as memory, memory.open() as dataset:
        ovr = STORED_LEVELS.index(level) - 1 if level else None
        return int(dataset.get_tag_item(f"BLOCK_OFFSET_{column}_{row}", "TIFF", bidx=1, ovr=ovr))


def assert_only_holes(opened, sound, level=0):
    """What is shown is what the sound pack shows. Returns (invalid pixels, unknown cells) more than there."""
    (dop, valid, dsm), (all_dop, all_valid, all_dsm) = everything(opened, level), everything(sound, level)
    assert not (valid & ~all_valid).any()
    assert same(dop[valid], all_dop[valid])
    known = np.isfinite(dsm)
    assert same(dsm[known], all_dsm[known])
    return int((all_valid & ~valid).sum()), int((np.isfinite(all_dsm) & ~known).sum())


def warnings_of(caplog):
    return [r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING and r.name.startswith("ortholoc")]


@pytest.mark.parametrize("layer", ["dop", "dsm"])
@pytest.mark.parametrize(
    "fault",
    [
        lambda path: path.unlink(),
        lambda path: path.write_bytes(path.read_bytes()[:-7]),
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(path.read_bytes() + b"more"),
        lambda path: (path.unlink(), path.mkdir()),
        lambda path: path.write_bytes(b"not a tile ".ljust(path.stat().st_size, b"!")),
        lambda path: flip(path, offset_of(path, level=4) - 60),
        lambda path: flip(path, 4),
    ],
    ids=["missing", "truncated", "empty", "longer", "folder", "wrong format", "head", "first offset"],
)
def test_tile_that_cannot_be_used_is_a_hole(copied, pack, sound, layer, fault, caplog):
    tile = tile_of(pack, layer, 1, 1)
    fault(copied / tile.file)
    with MapStore(Pack.open(copied)) as opened:
        assert opened.damaged == [tile.file]
        told = warnings_of(caplog)
        assert len(told) == 1
        assert tile.file in told[0]
        lost = assert_only_holes(opened, sound)
        everywhere = everything(sound)
        k = ("dop", "dsm").index(layer)
        box = (DOP_BOX, DSM_BOX)[k]
        left, upper = tile.column - box.column, tile.row - box.row
        inside = (slice(upper, upper + tile.height), slice(left, left + tile.width))
        expected = [everywhere[1][inside].sum(), np.isfinite(everywhere[2][inside]).sum()]
        assert lost[k] == expected[k] > 0
        assert lost[1 - k] == 0
        for level in range(1, LEVELS):
            assert_only_holes(opened, sound, level)
        assert len(warnings_of(caplog)) == 1
        if layer == "dsm":
            assert np.isnan(opened.heights(DSM_GRID.map_from_px([[100.5, 200.0], [63.5, 200.0]]))).all()
    with pytest.raises(MapError, match=rf"1 damaged or missing files.*{tile.file}.*map\.require_intact"):
        MapStore(Pack.open(copied), require_intact=True)


@pytest.mark.parametrize(("bad", "lost_levels"), [(0, {0, 1}), (2, {2, 3}), (4, {4})])
def test_of_a_damaged_tile_only_the_bad_block_is_a_hole(copied, pack, sound, caplog, bad, lost_levels):
    """And what is averaged from it: the other levels of the same tile are still used."""
    for layer in ("dop", "dsm"):
        tile = tile_of(pack, layer, 1, 1)
        flip(copied / tile.file, offset_of(copied / tile.file, level=bad) + 40)
    with MapStore(Pack.open(copied)) as opened:
        assert len(opened.damaged) == 2
        assert [("1 blocks are holes" in text) for text in warnings_of(caplog)] == [True, True]
        for level in range(LEVELS):
            lost = assert_only_holes(opened, sound, level)
            assert (lost[0] > 0, lost[1] > 0) == (level in lost_levels, level in lost_levels)


def test_missing_files_give_one_line_and_a_count(copied, pack, caplog):
    for tile in pack.manifest.dop.tiles[:5]:
        (copied / tile.file).unlink()
    found = Pack.open(copied)
    assert found.missing == {tile.file for tile in pack.manifest.dop.tiles[:5]}
    with MapStore(found) as opened:
        assert opened.damaged == [tile.file for tile in pack.manifest.dop.tiles[:5]]
    (told,) = warnings_of(caplog)
    assert "5 of its 12 files" in told
    assert pack.manifest.dop.tiles[0].file in told


def test_pack_without_any_usable_surface_is_refused(copied):
    for path in (copied / "dsm").iterdir():
        flip(path, 4)
    with pytest.raises(MapError, match=r"none of the 6 tiles of the DSM.*copy the pack again"):
        MapStore(Pack.open(copied))


def test_file_that_vanishes_after_the_look(copied, pack, caplog):
    found = Pack.open(copied)
    tile = tile_of(pack, "dsm", 0, 0)
    (copied / tile.file).unlink()
    with MapStore(found) as opened:
        assert opened.damaged == [tile.file]
    assert tile.file in caplog.text


def test_pack_that_is_replaced_while_it_is_read_is_refused(copied, pack, tmp_path):
    """Of the old pack's files only those would be left that both have: holes without damage."""
    found = Pack.open(copied)
    other = packs.write_pack(tmp_path / "other", pixels(64, 64), np.zeros((64, 64), dtype=np.float32))
    shutil.copytree(other.path, copied, dirs_exist_ok=True)
    with pytest.raises(MapError, match="another pack took its place"):
        MapStore(found)
    with MapStore(Pack.open(copied)) as opened:
        assert opened.damaged == []


def replaced(folder, layer, index, data):
    """Put a file in place of a tile and let the manifest say that it belongs there."""
    found = Pack.open(folder)
    described = getattr(found.manifest, layer)
    tile = described.tiles[index]
    (folder / tile.file).write_bytes(data)
    tiles = list(described.tiles)
    tiles[index] = msgspec.structs.replace(tile, bytes=len(data), sha256=hashlib.sha256(data).hexdigest())
    write_manifest(
        msgspec.structs.replace(found.manifest, **{layer: msgspec.structs.replace(described, tiles=tiles)}),
        folder / MANIFEST_NAME,
    )
    return tile.file


@pytest.mark.parametrize("layer", ["dop", "dsm"])
def test_file_that_the_manifest_calls_right_and_is_not(copied, pack, sound, layer, caplog):
    """Another tile, the other layer, no picture, nothing: seen when it is first looked at, told once."""
    described = getattr(pack.manifest, layer)
    other = (copied / getattr(pack.manifest, "dsm" if layer == "dop" else "dop").tiles[4].file).read_bytes()
    for data in ((copied / described.tiles[0].file).read_bytes(), other, b"no picture", b""):
        caplog.clear()
        name = replaced(copied, layer, 4, data)
        with MapStore(Pack.open(copied)) as opened:
            assert opened.damaged == []
            assert sum(assert_only_holes(opened, sound)) > 0
            assert_only_holes(opened, sound)
            assert opened.damaged == [name]
            assert [name in text for text in warnings_of(caplog)] == [True]


@pytest.mark.parametrize("layer", ["dop", "dsm"])
def test_block_that_does_not_decode_is_a_hole(copied, pack, sound, layer, caplog):
    """The encoder's fault: the hash is right. Other levels of the tile stay, and readers of several blocks too."""
    path = copied / getattr(pack.manifest, layer).tiles[4].file
    data = bytearray(path.read_bytes())
    at = offset_of(path, level=0)
    data[at : at + 200] = bytes(200)
    name = replaced(copied, layer, 4, bytes(data))
    with MapStore(Pack.open(copied)) as opened:
        lost = assert_only_holes(opened, sound)
        assert lost[("dop", "dsm").index(layer)] > 0
        assert assert_only_holes(opened, sound) == lost
        assert assert_only_holes(opened, sound, 2) == (0, 0)
        assert opened.damaged == [name]
        assert [name in text for text in warnings_of(caplog)] == [True]


def test_several_bad_blocks_in_a_large_tile(tmp_path, caplog):
    """A tile of 2 x 2 blocks, two of which do not decode: the other two are read one by one."""
    rng = np.random.default_rng(2)
    rgb = pixels(1024, 1024)
    heights = rng.uniform(0, 9, (256, 256)).astype(np.float32)
    lattice = msgspec.structs.replace(packs.DOP_LATTICE, tile_px=1024)
    pack = packs.write_pack(tmp_path, rgb, heights, dop_lattice=lattice, dop_corner=(0, 0), dsm_corner=(0, 0))
    path = tmp_path / pack.manifest.dop.tiles[0].file
    data = bytearray(path.read_bytes())
    for column, row in ((0, 0), (1, 1)):
        at = offset_of(path, column, row)
        data[at : at + 200] = bytes(200)
    replaced(tmp_path, "dop", 0, bytes(data))
    expected = np.ones((1024, 1024), dtype=bool)
    expected[:512, :512] = expected[512:, 512:] = False
    with MapStore(Pack.open(tmp_path)) as opened:
        for _ in range(2):
            dop, valid, _ = everything(opened)
            assert same(valid, expected)
            assert same(dop[valid], np.moveaxis(rgb, 0, -1)[valid])
        assert len(warnings_of(caplog)) == 1
    flipped = shutil.copytree(tmp_path, tmp_path.with_name("flipped"))
    problems = Pack.open(flipped).verify()
    assert sum("cannot be decoded" in problem for problem in problems) == 2
    assert any("block at column 1, row 1 of level 0" in problem for problem in problems)


# -- features ------------------------------------------------------------------------------------------


def with_features(folder, pack, contents, dop_sha256=None):
    tiles = []
    for index, data in contents.items():
        dop = pack.manifest.dop.tiles[index]
        name = dop.file.replace("dop/", "features/").replace(".tif", ".npy")
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(data)
        tiles.append(
            FeatureTile(
                file=name, bytes=len(data), sha256=hashlib.sha256(data).hexdigest(), dop=index,
                dop_sha256=dop_sha256 or dop.sha256, counts=(1, 0, 0, 0, 0),
            )
        )  # fmt: skip
    layer = FeatureLayer(matcher="sift", model_sha256="0" * 64, encoding="test", per_mpx=10.0, tiles=tiles)
    write_manifest(msgspec.structs.replace(pack.manifest, features=layer), folder / MANIFEST_NAME)
    return Pack.open(folder), [tile.file for tile in tiles]


def test_feature_files_are_held_where_asked_for(copied, pack, caplog):
    found, names = with_features(copied, pack, {0: b"first", 3: b"fourth"})
    assert found.verify() == []
    with MapStore(found) as without, MapStore(found, features=True) as opened:
        assert without.feature_bytes(0) is None
        assert [opened.feature_bytes(k) for k in range(4)] == [b"first", None, None, b"fourth"]
        assert opened.compressed_bytes == without.compressed_bytes + 11
    flip(copied / names[0], 1)
    (copied / names[1]).unlink()
    with MapStore(Pack.open(copied), features=True) as opened:
        assert [opened.feature_bytes(k) for k in (0, 3)] == [None, None]
        assert opened.damaged == names
    assert names[0] in caplog.text


def test_features_of_another_orthophoto_are_refused(copied, pack, caplog):
    found, names = with_features(copied, pack, {2: b"of another flight"}, dop_sha256="1" * 64)
    with MapStore(found, features=True) as opened:
        assert opened.feature_bytes(2) is None
    assert "features of another orthophoto" in caplog.text
    assert any(names[0] in problem for problem in found.verify())
