"""Levels that tiles hold, levels that are averaged when they are read, and what lies where there is no data."""

import json
from pathlib import Path

import numpy as np
import packs
import pytest
import rasterio
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterio.enums import MaskFlags, Resampling
from rasterio.io import MemoryFile

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles import encode
from ortholoc_edge.tiles.cog import Cog, PixelWindow
from ortholoc_edge.tiles.lattice import LEVELS
from ortholoc_edge.tiles.levels import STORED_LEVELS, filled, halved_heights, halved_image, next_stored
from ortholoc_edge.tiles.manifest import MANIFEST_NAME
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

GRID = RasterGrid(512, 384, 400_000.0, 5_300_000.0, 0.25, -0.25)


def noise(seed, rows=384, columns=512):
    """RGB (3, H, W) and a validity with a rim, a large hole and scattered ones."""
    rng = np.random.default_rng(seed)
    rgb = rng.integers(0, 256, (3, rows, columns), dtype=np.uint8)
    valid = rng.random((rows, columns)) > 0.1
    valid[:, :37] = valid[100:203, 111:240] = False
    valid[250:, 300:] = True
    return rgb, valid


def last(rgb):
    return np.ascontiguousarray(np.moveaxis(rgb, 0, -1))


# -- averages ------------------------------------------------------------------------------------------


def test_halved_image_is_what_gdal_averages():
    rgb, valid = noise(1)
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), MemoryFile() as memory:
        profile = {"driver": "GTiff", "count": 3, "width": 512, "height": 384, "dtype": "uint8", "photometric": "RGB"}
        place = rasterio.Affine(0.25, 0, 4e5, 0, -0.25, 5.3e6)
        with memory.open(**profile, transform=place) as target:
            target.write(rgb)
            target.write_mask(valid)
            target.build_overviews([2, 4], Resampling.average)
        found = last(rgb), valid
        for level in (0, 1):
            with memory.open(overview_level=level) as overview:
                found = halved_image(*found)
                assert np.array_equal(overview.dataset_mask() > 0, found[1])
                assert np.array_equal(last(overview.read())[found[1]], found[0][found[1]])


def test_halved_image_is_the_mean_of_valid_pixels():
    rgb, valid = noise(2)
    mean, there = halved_image(last(rgb), valid)
    four = (192, 2, 256, 2)
    count = valid.reshape(four).sum(axis=(1, 3))
    sums = (rgb * valid).reshape(3, *four).sum(axis=(2, 4), dtype=np.int64)
    assert np.array_equal(there, count > 0)
    assert set(np.unique(count)) == {0, 1, 2, 3, 4}
    expected = np.floor(sums / np.maximum(count, 1) + 0.5)
    assert np.array_equal(mean, np.moveaxis(expected, 0, -1))


def test_halved_heights_need_three_quarters():
    nan = np.nan
    heights = np.array([[1, 2, 1, nan, nan, nan], [3, 4, 2, 3, 5, 7]], dtype=np.float32)
    mean, share = halved_heights(heights)
    assert np.array_equal(mean, np.float32([[2.5, 2.0, nan]]), equal_nan=True)
    assert np.array_equal(share, [[1.0, 0.75, 0.0]])
    # With shares that are not whole: 1 + 1 + 0.75 + 0.75 of 4 is enough, 1 + 0.75 + 0.75 is not.
    shares = np.array([[1, 1, 1, 0.75], [0.75, 0.75, 0.75, 0]], dtype=np.float32)
    mean, share = halved_heights(np.array([[1, 2, 1, 2], [3, 4, 3, nan]], dtype=np.float32), shares)
    assert mean[0, 0] == pytest.approx((1 + 2 + 0.75 * 3 + 0.75 * 4) / 3.5)
    assert share[0, 0] == 0.875
    assert np.isnan(mean[0, 1])
    sound = np.arange(16, dtype=np.float32).reshape(4, 4)
    for given_share in (None, np.ones((4, 4), dtype=np.float32)):
        mean, share = halved_heights(sound, given_share)
        assert mean.tolist() == [[2.5, 4.5], [10.5, 12.5]]
        assert (share == 1.0).all()


def test_next_stored():
    assert [next_stored(STORED_LEVELS, level) for level in range(LEVELS)] == [0, 0, 2, 2, 4]
    assert [next_stored((0, 3), level) for level in range(LEVELS)] == [0, 0, 0, 3, 3]


# -- where there is no data ----------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 99), rows=st.integers(1, 40), columns=st.integers(1, 40), share=st.floats(0, 1))
def test_only_what_is_invalid_is_filled(seed, rows, columns, share):
    rng = np.random.default_rng(seed)
    rgb = rng.integers(0, 256, (rows, columns, 3), dtype=np.uint8)
    valid = rng.random((rows, columns)) < share
    before = rgb.copy()
    found = filled(rgb, valid)
    assert np.array_equal(rgb, before), "the argument is not touched"
    assert found.shape == rgb.shape
    assert np.array_equal(found[valid], rgb[valid])
    if not valid.any():
        assert not found.any()


def test_fill_continues_what_is_there():
    rgb = np.zeros((256, 256, 3), dtype=np.uint8)
    rgb[:, :128], rgb[:, 128:] = (200, 100, 50), (40, 80, 160)
    rgb[64:192] = 255  # to be replaced
    valid = np.ones((256, 256), dtype=bool)
    valid[64:192] = False
    found = filled(rgb, valid).astype(int)
    left, right = np.array([200, 100, 50]), np.array([40, 80, 160])
    hole = found[64:192]
    assert (np.abs(hole - left).sum(axis=-1) < np.abs(hole - right).sum(axis=-1))[:, :96].all()
    assert (np.abs(hole - left).sum(axis=-1) > np.abs(hole - right).sum(axis=-1))[:, 160:].all()
    # No step at the rim, but where two colours meet.
    plain = np.r_[:112, 144:256]
    for inside, outside in ((64, 63), (191, 192)):
        assert np.abs(found[inside] - found[outside])[plain].max() <= 12
    assert np.abs(np.diff(found[64:192], axis=0)).max() <= 24
    # Nothing of what was there before shows, and all values lie between those of the valid ones.
    assert (found[64:192] <= (200, 100, 160)).all()
    assert (found[64:192] >= (40, 80, 50)).all()


def test_a_filled_hole_costs_less_than_a_black_one(monkeypatch):
    rows, columns = np.mgrid[:384, :512]
    rgb = np.stack([150 + 40 * np.sin(rows / 9 + k) + 30 * np.cos(columns / 7) for k in range(3)]).astype(np.uint8)
    valid = np.hypot(rows - 190, columns - 260) < 150 + 12 * np.sin(columns / 11)
    size = len(encode.dop_cog(rgb, valid, GRID, packs.CRS, quality=75))
    monkeypatch.setattr(encode, "filled", lambda picture, valid: picture * valid[..., None])
    assert size < 0.9 * len(encode.dop_cog(rgb, valid, GRID, packs.CRS, quality=75))


def test_what_is_invalid_reads_black():
    rgb, valid = noise(3)
    with Cog(encode.dop_cog(rgb, valid, GRID, packs.CRS, quality=75), Path("tile")) as cog:
        bands, found = cog.read_image(0, PixelWindow(0, 0, 512, 384))
    assert np.array_equal(found, valid)
    assert not bands[:, ~valid].any()


def test_a_tile_without_holes_has_no_mask():
    rgb, valid = noise(4)
    for mask, expected in ((valid, MaskFlags.per_dataset), (np.ones_like(valid), MaskFlags.all_valid)):
        data = encode.dop_cog(rgb, mask, GRID, packs.CRS)
        with MemoryFile(data) as memory, memory.open() as tile:
            assert tile.mask_flag_enums == ([expected],) * 3
            assert np.array_equal(tile.dataset_mask() > 0, mask)
        for number, level in enumerate(STORED_LEVELS[1:]):
            step = 2**level
            with MemoryFile(data) as memory, memory.open(overview_level=number) as tile:
                below = mask.reshape(384 // step, step, 512 // step, step)
                assert np.array_equal(tile.dataset_mask() > 0, below.any(axis=(1, 3)))


# -- read from a pack ----------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=[STORED_LEVELS, (0, 3), (0,)], ids=str)
def lossy(request, tmp_path_factory):
    """A pack with holes over several tiles, whose levels differ from those of the uncompressed rasters."""
    rgb, valid = noise(5, 704, 960)
    rng = np.random.default_rng(6)
    heights = rng.uniform(250, 420, (256, 320)).astype(np.float32)
    heights[rng.random(heights.shape) < 0.1] = np.nan
    folder = tmp_path_factory.mktemp("lossy")
    original = encode.dop_cog
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(encode, "dop_cog", lambda a, v, g, crs, kind, _, stored: original(a, v, g, crs, kind, 60, stored))
        pack = packs.write_pack(folder, rgb, heights, valid=valid, max_z_error_m=0.5, stored=request.param)
    assert pack.verify() == []
    with MapStore(pack) as store:
        yield pack, store


def whole(grid):
    return PixelWindow(0, 0, grid.width, grid.height)


def test_a_level_that_is_not_stored_is_the_mean_of_the_next_finer_one(lossy):
    pack, store = lossy
    assert (len(store.dop_grids), len(store.dsm_grids)) == (LEVELS, LEVELS)
    for level in range(LEVELS):
        if level in pack.manifest.dop.stored:
            image = store._dop.read_rgb(level, whole(store.dop_grids[level]))
            heights, share = store._dsm.read_heights(level, whole(store.dsm_grids[level])), None
            continue
        image, (heights, share) = halved_image(*image), halved_heights(heights, share)
        found = store._dop.read_rgb(level, whole(store.dop_grids[level]))
        assert found[0].shape[:2] == (store.dop_grids[level].height, store.dop_grids[level].width)
        assert np.array_equal(found[1], image[1])
        assert np.array_equal(found[0], image[0])
        assert not found[1].all() or level == LEVELS - 1
        assert np.array_equal(store._dsm.read_heights(level, whole(store.dsm_grids[level])), heights, equal_nan=True)


@settings(max_examples=60, deadline=None)
@given(data=st.data(), level=st.integers(1, LEVELS - 1))
def test_windows_anywhere_are_cut_from_the_whole_level(lossy, data, level):
    _, store = lossy
    for kind, grid in ((store._dop, store.dop_grids[level]), (store._dsm, store.dsm_grids[level])):
        column, row = data.draw(st.integers(0, grid.width - 1)), data.draw(st.integers(0, grid.height - 1))
        width, height = data.draw(st.integers(1, grid.width - column)), data.draw(st.integers(1, grid.height - row))
        window, at = PixelWindow(column, row, width, height), np.s_[row : row + height, column : column + width]
        if kind is store._dop:
            for read in (kind.read_rgb, kind.read_grey):
                for part, all_of_it in zip(read(level, window), read(level, whole(grid)), strict=True):
                    assert np.array_equal(part, all_of_it[at])
        else:
            part, all_of_it = kind.read_heights(level, window), kind.read_heights(level, whole(grid))
            assert np.array_equal(part, all_of_it[at], equal_nan=True)


def test_window_of_a_level_that_is_not_stored_lies_where_it_should(tmp_path):
    """Through the store's own reading: every pixel tells its place, to the rounding of its mean."""
    rows, columns = np.mgrid[:704, :960]
    rgb = np.stack([columns % 256, rows % 256, columns // 256 * 40 + rows // 256 * 7]).astype(np.uint8)
    heights = np.fromfunction(lambda v, u: 300 + 0.1 * u + 0.2 * v, (256, 320)).astype(np.float32)
    pack = packs.write_pack(tmp_path / "pack", rgb, heights, max_z_error_m=0.0)
    west, _, _, north = packs.DOP_LATTICE.grid(pack.manifest.dop.tiles[0].box).bounds
    with MapStore(pack) as store:
        window = store.read_colour((west + 10.3, north - 61.2, west + 51.7, north - 20.9), 0.5)
    assert window.grid.dx == 0.5
    centres = window.grid.map_from_px([[0.0, 0.0], [7.0, 3.0]])
    for (x, y), (column, row) in zip(centres, ((0, 0), (7, 3)), strict=True):
        expected = np.array([(x - west) / 0.25 - 0.5, (north - y) / 0.25 - 0.5])
        assert np.abs(window.rgb[row, column, :2] - expected).max() <= 0.5


# -- packs of version 2 --------------------------------------------------------------------------------


def test_an_old_pack_with_all_levels_opens(tmp_path):
    rgb, valid = noise(7, 704, 960)
    heights = np.random.default_rng(8).uniform(250, 420, (256, 320)).astype(np.float32)
    heights[20:60, 30:90] = np.nan
    old = packs.write_pack(
        tmp_path / "old", rgb, heights, valid=valid, stored=tuple(range(LEVELS)), version=2, max_z_error_m=0.0
    )
    new = packs.write_pack(tmp_path / "new", rgb, heights, valid=valid, max_z_error_m=0.0)
    path = old.path / MANIFEST_NAME
    manifest = json.loads(path.read_text())
    assert manifest["version"] == 2
    for name in ("dop", "dsm"):
        del manifest[name]["stored_levels"]
    path.write_text(json.dumps(manifest))
    opened = Pack.open(old.path)
    assert opened.manifest.dop.stored == opened.manifest.dsm.stored == tuple(range(LEVELS))
    assert opened.verify() == []
    tile = opened.manifest.dop.tiles[0]
    with MapStore(opened) as before, MapStore(new) as after:
        for level in range(LEVELS):
            there = before._dop.read_rgb(level, whole(before.dop_grids[level]))
            # Lossless, so that the stored means are those of what is stored.
            assert all(map(np.array_equal, there, after._dop.read_rgb(level, whole(after.dop_grids[level]))))
            found = before._dsm.read_heights(level, whole(before.dsm_grids[level]))
            assert np.isnan(found).any()
            assert np.array_equal(found, after._dsm.read_heights(level, whole(after.dsm_grids[level])), equal_nan=True)
    with MemoryFile((old.path / tile.file).read_bytes()) as memory, memory.open() as dataset:
        assert dataset.overviews(1) == [2, 4, 8, 16]


def test_overviews_that_do_not_halve_are_refused():
    with MemoryFile() as memory:
        place = rasterio.Affine(0.25, 0, 4e5, 0, -0.25, 5.3e6)
        profile = {"driver": "GTiff", "width": 1536, "height": 1536, "count": 3, "dtype": "uint8", "tiled": True}
        with memory.open(**profile, blockxsize=512, blockysize=512, transform=place) as target:
            target.build_overviews([3])
        with Cog(bytes(memory.read()), Path("thirds.tif")) as cog, pytest.raises(MapError, match=r"thirds.*\[3\]"):
            _ = cog.grids
