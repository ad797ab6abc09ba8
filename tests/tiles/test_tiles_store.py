import logging
import shutil
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import rasterio
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterio.env import get_gdal_config
from rasterio.windows import from_bounds
from tile_rasters import DOP_GRID, DSM_GRID, centres, colours, plane, write_raster

from ortholoc_edge.errors import MapError
from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.cog import Block, Cog, MapDamagedError
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

WEST, SOUTH, EAST, NORTH = DOP_GRID.bounds


@pytest.fixture(scope="module")
def plane_store(plane_pack):
    with MapStore(plane_pack) as store:
        yield store


@pytest.fixture(scope="module")
def holed_store(holed_pack):
    with MapStore(holed_pack) as store:
        yield store


def test_levels_share_the_extent_and_hold_the_plane(plane_store):
    """Half pixels: the value at each pixel's centre must be the plane's there, at every level."""
    assert len(plane_store.dop_grids) == 3
    assert len(plane_store.dsm_grids) == 2
    for dop_grid in plane_store.dop_grids:
        assert np.allclose(dop_grid.bounds, plane_store.bounds, rtol=0, atol=1e-6)
        window = plane_store.read(plane_store.bounds, dop_grid.gsd_m)
        assert window.dop_grid == dop_grid
        assert window.dop_valid.all()
        error = window.dop - colours(centres(window.dop_grid))
        assert np.abs(error).mean() < 1.0
    for dsm_grid in plane_store.dsm_grids:
        window = plane_store.read(plane_store.bounds, 0.1, dsm_grid.gsd_m)
        assert window.dsm_grid == dsm_grid
        error = window.dsm - plane(centres(window.dsm_grid))
        # Half a cell of the second level would be 0.06 m.
        assert np.abs(error).max() < 0.0101
        assert abs(error.mean()) < 1e-3


def test_no_level_of_the_orthophoto_is_shifted(scene, tmp_path):
    """Waves tell a shift to a hundredth of a pixel, where a ramp drowns in GDAL's rounding up of halves."""

    def waves(xy):
        x, y = 2 * np.pi * (xy[..., 0] - WEST) / 8.0, 2 * np.pi * (xy[..., 1] - SOUTH) / 9.0
        slopes = 60 * 2 * np.pi * np.stack([np.cos(x) / 8.0, np.cos(y) / 9.0, np.ones_like(x)], axis=-1)
        return 127 + 60 * np.sin(x) + 60 * np.sin(y), slopes

    grey = np.rint(waves(centres(DOP_GRID))[0]).astype(np.uint8)
    dop = write_raster(tmp_path / "waves.tif", grey[None], DOP_GRID)
    with MapStore(build_pack(dop, scene[1], tmp_path / "pack", PackOptions(quality=95))) as store:
        for grid in store.dop_grids:
            value, slopes = waves(centres(grid))
            error = value - store.read(store.bounds, grid.gsd_m).dop[..., 1]
            shift_m = np.linalg.lstsq(slopes.reshape(-1, 3), error.reshape(-1), rcond=None)[0][:2]
            assert np.abs(shift_m).max() < 0.02 * grid.gsd_m


def test_window_is_what_rasterio_reads_there(holed_store, holed_pack):
    bounds = (WEST + 55.0, SOUTH + 47.0, WEST + 75.0, SOUTH + 75.0)
    window = holed_store.read(bounds, 0.1, 0.2)
    with rasterio.open(holed_pack.path / "dop.tif") as dataset:
        place = from_bounds(*window.dop_grid.bounds, dataset.transform)
        assert np.array_equal(np.moveaxis(window.dop, -1, 0), dataset.read(window=place))
        assert np.array_equal(window.dop_valid, dataset.dataset_mask(window=place) > 0)
    with rasterio.open(holed_pack.path / "dsm.tif") as dataset:
        heights = dataset.read(1, window=from_bounds(*window.dsm_grid.bounds, dataset.transform))
    assert np.array_equal(np.isnan(window.dsm), heights == -9999.0)
    assert np.array_equal(window.dsm[~np.isnan(window.dsm)], heights[heights != -9999.0])
    assert 0 < np.isnan(window.dsm).mean() < 1
    assert 0 < window.dop_valid.mean() < 1


def test_nodata_does_not_bleed_into_overviews(holed_store):
    for grid in holed_store.dsm_grids:
        window = holed_store.read(holed_store.bounds, 0.1, grid.gsd_m)
        valid = ~np.isnan(window.dsm)
        error = np.abs(window.dsm - plane(centres(window.dsm_grid)))[valid]
        # Beside the hole an overview cell averages the part that has data.
        assert error.max() < grid.gsd_m
        assert valid.mean() == pytest.approx(1 - 130 * 137 / (739 * 655), abs=0.01)
    for grid in holed_store.dop_grids:
        window = holed_store.read(holed_store.bounds, grid.gsd_m)
        error = np.abs(window.dop - colours(centres(window.dop_grid)))[window.dop_valid]
        assert np.percentile(error, 99) < 6.0


@pytest.mark.parametrize(
    ("gsd_m", "dop_level", "dsm_level"),
    [
        (0.01, 0, 0),
        (0.1, 0, 0),
        (0.13, 0, 0),
        (0.15, 1, 1),
        (0.2, 1, 1),
        (0.27, 1, 1),
        (0.3, 2, 1),
        (50.0, 2, 1),
    ],
)
def test_level_is_the_coarsest_that_suits(plane_store, gsd_m, dop_level, dsm_level):
    window = plane_store.read((WEST + 50, SOUTH + 50, WEST + 80, SOUTH + 80), gsd_m)
    assert window.dop_grid.dx == plane_store.dop_grids[dop_level].dx
    assert window.dsm_grid.dx == plane_store.dsm_grids[dsm_level].dx
    finest = plane_store.read((WEST + 50, SOUTH + 50, WEST + 80, SOUTH + 80), gsd_m, dsm_gsd_m=0.01)
    assert finest.dsm_grid.dx == DSM_GRID.dx


@settings(max_examples=60, deadline=None)
@given(
    corner=st.tuples(st.floats(-60, 200), st.floats(-60, 200)),
    size=st.tuples(st.floats(0.001, 150), st.floats(0.001, 150)),
    gsd=st.sampled_from([0.1, 0.2, 0.4]),
)
def test_window_covers_the_region_and_no_pixel_more(plane_store, corner, size, gsd):
    west, south = WEST + corner[0], SOUTH + corner[1]
    bounds = (west, south, west + size[0], south + size[1])
    inside = (max(bounds[0], WEST), max(bounds[1], SOUTH), min(bounds[2], EAST), min(bounds[3], NORTH))
    window = plane_store.read(bounds, gsd)
    # Within a millionth of a pixel of the edge either answer is right.
    if inside[0] > inside[2] or inside[1] > inside[3]:
        assert window is None
        return
    if window is None:
        assert min(inside[2] - inside[0], inside[3] - inside[1]) < 1e-5
        return
    grid, slack = window.dop_grid, 1e-5
    assert window.dop.shape == (grid.height, grid.width, 3)
    assert window.dsm.shape == (window.dsm_grid.height, window.dsm_grid.width)
    outer = grid.bounds
    assert outer[0] <= inside[0] + slack < outer[0] + grid.dx + 2 * slack
    assert outer[2] >= inside[2] - slack > outer[2] - grid.dx - 2 * slack
    assert outer[1] <= inside[1] + slack < outer[1] - grid.dy + 2 * slack
    assert outer[3] >= inside[3] - slack > outer[3] + grid.dy - 2 * slack
    # Pixels stay on the level's own lattice.
    level = next(one for one in plane_store.dop_grids if one.dx == grid.dx)
    offset = (grid.west - level.west) / level.dx, (grid.top - level.top) / level.dy
    assert np.allclose(offset, np.rint(offset), atol=1e-6)
    # The surface model reaches beyond the orthophoto's pixel centres, for bilinear look-ups.
    corners = grid.map_from_px([[0, 0], [grid.width - 1, grid.height - 1]])
    cells = window.dsm_grid.px_from_map(corners)
    dsm_outer, dsm_map = window.dsm_grid.bounds, DSM_GRID.bounds
    if dsm_outer[0] > dsm_map[0] + 1e-6:
        assert cells[0, 0] >= 0.5
    if dsm_outer[2] < dsm_map[2] - 1e-6:
        assert cells[1, 0] <= window.dsm_grid.width - 1.5


def test_region_outside_gives_none(plane_store):
    assert plane_store.read((WEST - 50, SOUTH, WEST - 1, NORTH), 0.1) is None
    assert plane_store.read((WEST - 50, SOUTH, WEST, NORTH), 0.1) is None
    assert plane_store.read((WEST, NORTH + 1, EAST, NORTH + 9), 0.1) is None


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
def test_unusable_requests_are_refused(plane_store, arguments):
    with pytest.raises(ValueError, match=r"unusable|positive"):
        plane_store.read(*arguments)


def test_too_large_a_window_is_refused(plane_pack):
    with MapStore(plane_pack, max_pixels=100_000) as store:
        with pytest.raises(MapError, match="exceeds 100000 px"):
            store.read(store.bounds, 0.1)
        assert store.read((WEST, SOUTH, WEST + 20, SOUTH + 20), 0.1) is not None


def test_arrays_cannot_be_changed_by_a_consumer(plane_store):
    window = plane_store.read((WEST, SOUTH, WEST + 20, SOUTH + 20), 0.1)
    for array in (window.dop, window.dop_valid, window.dsm):
        assert not array.flags.writeable
        assert array.flags.c_contiguous


@given(points=st.lists(st.tuples(st.floats(-20, 170), st.floats(-20, 150)), max_size=30))
@settings(max_examples=60, deadline=None)
def test_heights_are_bilinear_and_nan_outside(plane_store, points):
    xy = np.add(np.array(points).reshape(-1, 2), (WEST, SOUTH))
    heights = plane_store.heights(xy)
    px = DSM_GRID.px_from_map(xy)
    inside = ((px >= 0) & (px <= (DSM_GRID.width - 1, DSM_GRID.height - 1))).all(axis=1)
    assert np.array_equal(np.isfinite(heights), inside)
    assert np.allclose(heights[inside], plane(xy[inside]), rtol=0, atol=0.0101)


def test_heights_at_cell_centres_are_the_raster_across_blocks(holed_store, holed_pack):
    """Centres carry all weight themselves, also where a neighbour is nodata or past the edge."""
    with rasterio.open(holed_pack.path / "dsm.tif") as dataset:
        raster = dataset.read(1).astype(np.float64)
    raster[raster == -9999.0] = np.nan
    columns, rows = np.meshgrid([0, 299, 300, 436, 437, 511, 512, 738], [0, 199, 200, 330, 511, 512, 654])
    px = np.stack([columns, rows], axis=-1).reshape(-1, 2)
    found = holed_store.heights(DSM_GRID.map_from_px(px))
    exact = DSM_GRID.px_from_map(DSM_GRID.map_from_px(px))
    # Positions in metres round; short of the centre a nodata neighbour gets a weight of 1e-10.
    clean = (exact == px).all(axis=1)
    assert clean.any()
    expected = raster[px[:, 1], px[:, 0]]
    assert np.allclose(found[clean], expected[clean], rtol=0, atol=1e-9, equal_nan=True)


def test_heights_beside_the_hole_are_nan(holed_store):
    edge = DSM_GRID.map_from_px([[299.5, 260.0], [298.5, 260.0], [350.0, 260.0], [float("nan"), 3.0]])
    assert np.array_equal(np.isnan(holed_store.heights(edge)), [True, False, True, True])


def test_several_threads_read_what_one_does(holed_store):
    rng = np.random.default_rng(7)
    corners = rng.uniform((WEST, SOUTH), (EAST - 30, NORTH - 30), size=(60, 2))
    gsds = [0.1, 0.2, 0.4] * 20
    requests = [((x, y, x + 25.0, y + 20.0), gsd) for (x, y), gsd in zip(corners, gsds, strict=True)]

    def read(request):
        window = holed_store.read(*request)
        return window.dop, window.dop_valid, window.dsm, holed_store.heights(corners)

    alone = [read(request) for request in requests]
    with ThreadPoolExecutor(8) as pool:
        together = list(pool.map(read, requests))
    for one, other in zip(alone, together, strict=True):
        assert all(np.array_equal(a, b, equal_nan=a.dtype.kind == "f") for a, b in zip(one, other, strict=True))


def test_cache_is_bounded_and_memory_is_the_files(plane_pack):
    with MapStore(plane_pack, cache_bytes=3 * 2**20) as store:
        assert get_gdal_config("GDAL_CACHEMAX") == 3 * 2**20
        assert store.compressed_bytes == sum((plane_pack.path / f).stat().st_size for f in ("dop.tif", "dsm.tif"))
        assert store.read(store.bounds, 0.1).dop.shape == (1307, 1475, 3)


def test_files_are_not_needed_after_loading(plane_pack, tmp_path):
    path = shutil.copytree(plane_pack.path, tmp_path / "pack")
    with MapStore(Pack.open(path)) as store:
        shutil.rmtree(path)
        assert store.read(store.bounds, 0.1) is not None


def test_closed_store_says_so(plane_pack):
    store = MapStore(plane_pack)
    store.close()
    store.close()
    with pytest.raises(MapError, match="closed"):
        store.read(plane_pack.manifest.dop.grid.raster_grid().bounds, 0.4)


def flip(path, at):
    data = bytearray(path.read_bytes())
    data[at] ^= 0x40
    path.write_bytes(data)


def offset_of(path, column, row, level=0):
    with rasterio.open(path) as dataset:
        item = dataset.get_tag_item(f"BLOCK_OFFSET_{column}_{row}", "TIFF", bidx=1, ovr=level - 1 if level else None)
    return int(item)


@pytest.mark.parametrize("name", ["dop.tif", "dsm.tif"])
def test_flipped_byte_in_a_tile_is_found_named_and_flown_around(copied, name, caplog):
    file = copied / name
    flip(file, offset_of(file, 1, 0) + 300)
    pack = Pack.open(copied)

    problems = pack.verify()
    assert len(problems) == 2
    assert "SHA-256" in problems[0]
    assert name in problems[1]
    assert "column 1, row 0 of level 0" in problems[1]

    with pytest.raises(MapError, match=rf"{name}: SHA-256 differs.*copy it again"):
        MapStore(pack)
    with caplog.at_level(logging.WARNING):
        store = MapStore(pack, tolerate_damage=True)
    assert "1 tiles cannot be used" in caplog.text
    with store:
        size = 512 * (DOP_GRID.dx if name == "dop.tif" else DSM_GRID.dx)
        bad = WEST + 1.2 * size, NORTH - 0.5 * size
        around = (bad[0] - 1, bad[1] - 1, bad[0] + 1, bad[1] + 1)
        with pytest.raises(MapDamagedError, match="column 1, row 0 of level 0"):
            store.read(around, 0.1, 0.2)
        assert store.read((WEST, SOUTH, WEST + 20, SOUTH + 20), 0.1, 0.2) is not None
        assert store.read(around, 0.2, 0.4) is not None  # the overviews are whole
        if name == "dsm.tif":
            with pytest.raises(MapDamagedError):
                store.heights([bad])
            assert np.isfinite(store.heights([(WEST + 10, SOUTH + 10)])).all()


def test_every_flipped_byte_is_seen(copied):
    """Head, tile, mask, gaps: each byte of the file belongs to one segment."""
    file = copied / "dop.tif"
    whole = file.read_bytes()
    pack = Pack.open(copied)
    for at in np.linspace(0, len(whole) - 1, 40).astype(int):
        file.write_bytes(whole)
        flip(file, at)
        problems = pack.verify()
        assert problems, f"byte {at}"
        with pytest.raises(MapError):
            MapStore(pack)


def test_damaged_head_is_refused_even_when_damage_is_tolerated(copied):
    file = copied / "dsm.tif"
    flip(file, offset_of(file, 0, 0, level=1) - 200)
    with pytest.raises(MapError, match=r"dsm\.tif"):
        MapStore(Pack.open(copied), tolerate_damage=True)


def test_swapped_file_of_another_pack_is_refused(copied, plane_pack):
    """Same size in the manifest, another raster: the grid tells before the pixels can mislead."""
    shutil.copy(copied / "dsm.tif", copied / "dop.tif")
    pack = Pack(copied, plane_pack.manifest, plane_pack.georeference)
    with pytest.raises(MapError, match="grid or its number of levels differs"):
        MapStore(pack)


def test_sound_pack_verifies(holed_pack):
    assert holed_pack.verify() == []


def test_undecodable_tile_is_named(holed_pack):
    """A tile that passes its checksum and still does not decode: the encoder's fault, seen by the build."""
    data = bytearray((holed_pack.path / "dsm.tif").read_bytes())
    at = offset_of(holed_pack.path / "dsm.tif", 1, 1)
    data[at : at + 64] = bytes(64)
    with Cog(bytes(data), holed_pack.path / "dsm.tif") as cog:
        assert cog.undecodable() == [Block(0, 1, 1)]
