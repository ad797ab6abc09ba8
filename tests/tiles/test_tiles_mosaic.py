"""Many sources to one pack: copied pixel for pixel, in their order, warped once, inside an area."""

import json
import shutil
import subprocess

import cv2
import numpy as np
import pyproj
import pytest
import rasterio
from tile_rasters import (
    CRS,
    WIDE_DOP,
    WIDE_DSM,
    centres,
    contents,
    dop_of,
    dsm_heights,
    dsm_of,
    plane,
    textured,
    write_raster,
)

from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.area import read_area
from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.holes import fill_small_holes

LOSSLESS = {"quality": 100}


def built(dop, dsm, out, **options):
    return build_pack(dop, dsm, out, PackOptions(**({"vertical": "unknown"} | options)))


def cut(folder, name, bands, grid, columns, rows, crs=CRS, **profile):
    """A raster in files that are cut at the given columns and rows."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    edges = [0, *columns, grid.width], [0, *rows, grid.height]
    for left, right in zip(edges[0], edges[0][1:], strict=False):
        for upper, lower in zip(edges[1], edges[1][1:], strict=False):
            part = bands[:, upper:lower, left:right]
            place = grid.crop(left, upper, right - left, lower - upper)
            paths.append(write_raster(folder / f"{name}_{left}_{upper}.tif", part, place, crs, **profile))
    return paths


@pytest.fixture(scope="module")
def pieces(tmp_path_factory):
    """(DOP, DSM) folders of a scene in six and four files, cut where the pack's tiles are not."""
    folder = tmp_path_factory.mktemp("pieces")
    cut(folder / "dop", "dop", textured(WIDE_DOP), WIDE_DOP, (100, 333), (201,))
    cut(folder / "dsm", "dsm", dsm_heights(WIDE_DSM), WIDE_DSM, (171,), (99,))
    return folder / "dop", folder / "dsm"


@pytest.fixture(scope="module")
def mosaic(pieces, tmp_path_factory):
    return built(*pieces, tmp_path_factory.mktemp("mosaic") / "pack", **LOSSLESS)


def test_sources_on_the_lattice_are_copied(mosaic, wide_scene, tmp_path):
    manifest = mosaic.manifest
    pixels, valid = dop_of(mosaic, WIDE_DOP)
    assert valid.all()
    assert np.array_equal(np.moveaxis(pixels, -1, 0), textured(WIDE_DOP))
    error = np.abs(dsm_of(mosaic, WIDE_DSM) - dsm_heights(WIDE_DSM)[0])
    assert error.max() <= manifest.dsm.max_z_error_m + 1e-4
    assert (len(manifest.dop.sources), len(manifest.dsm.sources)) == (6, 4)
    assert not any(source.resampled for source in [*manifest.dop.sources, *manifest.dsm.sources])
    # Each tile names what it shows, and nothing beside the source has data.
    assert sorted({k for tile in manifest.dop.tiles for k in tile.sources}) == list(range(6))
    assert sum(t.valid_fraction * t.width * t.height for t in manifest.dop.tiles) == pytest.approx(704 * 448)
    # Cut or whole, the tiles are the same files.
    whole = built(*wide_scene, tmp_path / "whole", **LOSSLESS)
    files = contents(whole.path)
    assert {n: b for n, b in contents(mosaic.path).items() if n.endswith(".tif")} == {
        n: b for n, b in files.items() if n.endswith(".tif")
    }


def test_tiles_are_cut_alike_in_neighbouring_packs(pieces, mosaic, tmp_path):
    part = built(*pieces, tmp_path / "part", area=read_area("401408,5299200,402000,5299500", None), **LOSSLESS)
    [tile] = part.manifest.dop.tiles
    lattice = part.manifest.dop.lattice
    assert tile.file in {one.file for one in mosaic.manifest.dop.tiles}
    west, south, east, north = lattice.grid(tile.box).bounds
    assert ((west - 401408) % 128, (5299200 - south) % 128) == (0, 0)
    assert east - west <= 592 + 2 * 128 and north - south <= 300 + 2 * 128


def test_levels_are_exactly_on_the_lattice(mosaic):
    for layer in (mosaic.manifest.dop, mosaic.manifest.dsm):
        for tile in layer.tiles:
            for number, level in enumerate(layer.stored):
                options = {} if level == 0 else {"overview_level": number - 1}
                with rasterio.open(mosaic.path / tile.file, **options) as dataset:
                    grid = layer.lattice.grid(tile.box, level)
                    assert (dataset.width, dataset.height) == (grid.width, grid.height)
                    assert dataset.bounds == pytest.approx(grid.bounds, abs=1e-6)
                    assert (dataset.transform.a, dataset.transform.e) == pytest.approx((grid.dx, grid.dy))


def test_newest_lies_on_top_then_the_finest(wide_scene, tmp_path):
    half = WIDE_DOP.crop(0, 0, 352, 448)
    strip = WIDE_DOP.crop(0, 0, 704, 128)
    small = RasterGrid(200, 100, WIDE_DOP.west + 200.0, WIDE_DOP.top - 400.0, 1.0, -1.0)
    grey = np.full((3, 100, 200), 77, np.uint8)
    dop = [
        wide_scene[0],
        write_raster(tmp_path / "west_2019.tif", textured(half, 1), half),
        write_raster(tmp_path / "north_2023.tif", textured(strip, 2), strip),
        write_raster(tmp_path / "fine_2019.tif", grey, small),
    ]
    pack = built(dop, wide_scene[1], tmp_path / "pack", **LOSSLESS)
    expected = textured(WIDE_DOP)
    expected[:, :, :352] = textured(half, 1)
    expected[:, 200:250, 100:200] = 77
    expected[:, :128] = textured(strip, 2)
    assert np.array_equal(np.moveaxis(dop_of(pack, WIDE_DOP)[0], -1, 0), expected)
    named = [(one.name, one.date, one.gsd_m, one.resampled) for one in pack.manifest.dop.sources]
    assert named == [
        ("north_2023.tif", "2023", 2.0, False),
        ("fine_2019.tif", "2019", 1.0, True),
        ("west_2019.tif", "2019", 2.0, False),
        ("wide_dop.tif", None, 2.0, False),
    ]
    # The other way round, the same bytes.
    assert contents(built(dop[::-1], wide_scene[1], tmp_path / "back", **LOSSLESS).path) == contents(pack.path)


def test_hidden_sources_are_not_listed(wide_scene, tmp_path):
    below = write_raster(tmp_path / "below_2001.tif", textured(WIDE_DOP, 5), WIDE_DOP)
    above = write_raster(tmp_path / "above_2002.tif", textured(WIDE_DOP, 6), WIDE_DOP)
    pack = built([below, above], wide_scene[1], tmp_path / "pack")
    assert [one.name for one in pack.manifest.dop.sources] == ["above_2002.tif"]
    assert {tile.sources for tile in pack.manifest.dop.tiles} == {(0,)}


def smooth(lon, lat):
    """RGB (3, ...) of a picture that changes slowly with the place on Earth."""
    east, north = (lon - 12.0) * 3000.0, (lat - 48.0) * 3000.0
    return np.stack([120 + east, 120 + north, 120 + 0.5 * (east - north)])


def smooth_on(grid, crs):
    to_lonlat = pyproj.Transformer.from_crs(crs, "EPSG:4258", always_xy=True)
    return smooth(*to_lonlat.transform(*np.moveaxis(centres(grid), -1, 0)))


def test_other_zone_is_warped_and_the_own_is_not(tmp_path):
    """Two zones meet at 12 degrees east, where their grids are turned by 4.5 degrees against each other."""
    east, north = pyproj.Transformer.from_crs("EPSG:4258", "EPSG:25832", always_xy=True).transform(12.0, 48.0)
    east, north = round(east, -1), round(north, -1)
    own = RasterGrid(500, 400, east - 1000.0, north + 400.0, 2.0, -2.0)
    east33, north33 = pyproj.Transformer.from_crs("EPSG:4258", "EPSG:25833", always_xy=True).transform(12.0, 48.0)
    other = RasterGrid(300, 400, round(east33, -1) - 100.0, round(north33, -1) + 400.0, 2.0, -2.0)
    own_pixels = np.rint(smooth_on(own, "EPSG:25832")).astype(np.uint8)
    # Even numbers are the own zone's, so that one sees which one a pixel came from.
    own_pixels[2] &= 0xFE
    dop = [
        write_raster(tmp_path / "own_2023.tif", own_pixels, own, "EPSG:25832"),
        write_raster(
            tmp_path / "other_2022.tif", np.rint(smooth_on(other, "EPSG:25833")).astype(np.uint8), other, "EPSG:25833"
        ),
    ]
    cells = RasterGrid(500, 400, own.west, own.top, 4.0, -4.0)
    dsm = write_raster(tmp_path / "dsm.tif", np.full((1, 400, 500), 500, np.float32), cells, "EPSG:25832")
    pack = built(dop, dsm, tmp_path / "pack", **LOSSLESS)
    assert pack.manifest.crs == "EPSG:25832"
    assert [(s.name, s.crs, s.resampled) for s in pack.manifest.dop.sources] == [
        ("own_2023.tif", "EPSG:25832", False),
        ("other_2022.tif", "EPSG:25833", True),
    ]
    assert pack.manifest.dop.sources[1].gsd_m == pytest.approx(2.0, rel=0.2)
    assert np.array_equal(np.moveaxis(dop_of(pack, own)[0], -1, 0), own_pixels)
    beside = RasterGrid(200, 300, own.bounds[2], north + 300.0, 2.0, -2.0)
    pixels, valid = dop_of(pack, beside)
    assert valid.all()
    error = np.abs(np.moveaxis(pixels, -1, 0) - smooth_on(beside, "EPSG:25832"))
    # Rounding twice is half a level each; one pixel more or less would be 0.3.
    assert error.max() < 1.2
    assert error.mean() < 0.4
    # The other system wins if it is asked for.
    turned = built(dop, dsm, tmp_path / "turned", pack_crs="EPSG:25833")
    assert turned.manifest.crs == "EPSG:25833"
    assert [s.resampled for s in turned.manifest.dop.sources] == [True, False]
    assert [s.resampled for s in turned.manifest.dsm.sources] == [True]


@pytest.mark.parametrize(("dop_gsd", "dsm_gsd"), [(0.1, 1.0), (0.2, 1.0), (0.15, 0.5)])
def test_usual_pixel_sizes(tmp_path, dop_gsd, dsm_gsd):
    """Tile sides that are no round metres, in a corner where four tiles meet."""
    side = {0.1: 409.6, 0.2: 819.2, 0.15: 4096 * 0.15}[dop_gsd]
    east, north = round(400_000 / side) * side, round(5_300_000 / side) * side
    west, top = np.floor((east - 30) / dsm_gsd) * dsm_gsd, np.ceil((north + 20) / dsm_gsd) * dsm_gsd
    grid = RasterGrid(round(60 / dop_gsd), round(51 / dop_gsd), west, top, dop_gsd, -dop_gsd)
    cells = RasterGrid(round(60 / dsm_gsd), round(51 / dsm_gsd), west, top, dsm_gsd, -dsm_gsd)
    pixels = textured(grid)
    dop = cut(tmp_path / "dop", "dop", pixels, grid, (77,), (130,))
    dsm = write_raster(tmp_path / "dsm.tif", plane(centres(cells)).astype(np.float32)[None], cells)
    pack = built(dop, dsm, tmp_path / "pack", **LOSSLESS)
    assert len(pack.manifest.dop.tiles) == 4
    found, valid = dop_of(pack, grid)
    assert valid.all()
    assert np.array_equal(np.moveaxis(found, -1, 0), pixels)
    assert np.abs(dsm_of(pack, cells) - plane(centres(cells))).max() < 0.06
    assert pack.verify() == []


def test_area_cuts_the_map(pieces, tmp_path):
    area = read_area("400950,5299100,402000,5299850", None)
    pack = built(*pieces, tmp_path / "pack", area=area, **LOSSLESS)
    mask = area.on_map(CRS).mask(WIDE_DOP)
    assert 0.4 < mask.mean() < 0.7
    pixels, valid = dop_of(pack, WIDE_DOP)
    assert np.array_equal(valid, mask)
    assert np.array_equal(np.moveaxis(pixels, -1, 0)[:, mask], textured(WIDE_DOP)[:, mask])
    # And a cell around it, to interpolate from.
    cells = cv2.dilate(area.on_map(CRS).mask(WIDE_DSM).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    found = np.isfinite(dsm_of(pack, WIDE_DSM))
    assert found[cells].all()
    assert not found[cv2.dilate(cells.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0].any()
    with pytest.raises(ConfigError, match="do not meet"):
        built(*pieces, tmp_path / "far", area=read_area("500000,5299100,501000,5299850", None))
    assert not (tmp_path / "far").exists()


def test_corridor_along_a_route(pieces, tmp_path):
    to_lonlat = pyproj.Transformer.from_crs(CRS, "EPSG:4326", always_xy=True)
    line = [to_lonlat.transform(*xy) for xy in ((401_000, 5_299_800), (401_600, 5_299_500), (402_200, 5_299_800))]
    route = tmp_path / "route.geojson"
    route.write_text(json.dumps({"type": "LineString", "coordinates": line}))
    pack = built(*pieces, tmp_path / "pack", area=read_area(str(route), 200.0), **LOSSLESS)
    _, valid = dop_of(pack, WIDE_DOP)
    xy = centres(WIDE_DOP)
    a, b, c = (np.array(p, float) for p in ((401_000, 5_299_800), (401_600, 5_299_500), (402_200, 5_299_800)))
    distance = np.minimum(_distance(xy, a, b), _distance(xy, b, c))
    assert valid[distance < 98.0].all()
    assert not valid[distance > 102.0].any()


def _distance(xy, a, b):
    along = np.clip(((xy - a) @ (b - a)) / ((b - a) @ (b - a)), 0, 1)
    return np.linalg.norm(xy - a - along[..., None] * (b - a), axis=-1)


# -- small holes ---------------------------------------------------------------------------------------


def test_small_holes_are_closed_where_their_rim_is_a_plane(wide_scene, tmp_path):
    heights = dsm_heights(WIDE_DSM)
    truth = heights[0].copy()
    roof = np.s_[100:120, 200:220]
    heights[0][roof] += 12.0
    holes = {
        "plane": np.s_[50:54, 60:64],
        "one": np.s_[20:21, 30:31],
        "large": np.s_[70:75, 60:64],
        "edge of the roof": np.s_[98:102, 205:208],
        "border": np.s_[0:2, 40:42],
    }
    for place in holes.values():
        heights[0][place] = np.nan
    dsm = write_raster(tmp_path / "dsm.tif", heights, WIDE_DSM)
    pack = built(wide_scene[0], dsm, tmp_path / "pack")
    found = dsm_of(pack, WIDE_DSM)
    closed = {name for name, place in holes.items() if np.isfinite(found[place]).all()}
    still = {name for name, place in holes.items() if np.isnan(found[place]).all()}
    assert (closed, still) == ({"plane", "one"}, {"large", "edge of the roof", "border"})
    for name in closed:
        assert np.abs(found[holes[name]] - truth[holes[name]]).max() < 0.06
    cells = sum(t.filled_fraction * t.width * t.height for t in pack.manifest.dsm.tiles)
    assert cells == pytest.approx(17)
    report = json.loads((pack.path / "reports/coverage.geojson").read_text())
    named = [feature["properties"] for feature in report["features"] if feature["geometry"]["type"] == "Point"]
    assert sorted(one["cells"] for one in named) == [1, 16]
    untouched = dsm_of(built(wide_scene[0], dsm, tmp_path / "open", max_hole_cells=0), WIDE_DSM)
    assert np.array_equal(np.isnan(untouched), np.isnan(heights[0]))


def test_holes_outside_the_area_stay():
    heights = np.fromfunction(lambda v, u: 0.1 * u + 0.2 * v, (40, 40)).astype(np.float32)
    heights[10:12, 10:12] = heights[30, 30] = np.nan
    wanted = np.ones((40, 40), bool)
    wanted[30, 30] = False
    filled, holes = fill_small_holes(heights, wanted, 16)
    assert [(hole.column, hole.row, hole.cells) for hole in holes] == [(10.5, 10.5, 4)]
    assert np.argwhere(np.isnan(filled)).tolist() == [[30, 30]]
    assert filled[11, 10] == pytest.approx(3.2, abs=1e-5)
    assert np.isnan(heights[10, 10]), "the argument is not touched"
    nothing = np.full((8, 8), np.nan, np.float32)
    assert fill_small_holes(nothing, wanted[:8, :8], 64) == (nothing, [])


# -- other programs ------------------------------------------------------------------------------------


def test_tiles_are_valid_cogs(mosaic):
    cog_validate = pytest.importorskip("rio_cogeo").cog_validate
    for tile in [*mosaic.manifest.dop.tiles, *mosaic.manifest.dsm.tiles]:
        valid, errors, warnings = cog_validate(mosaic.path / tile.file, strict=True)
        assert (valid, errors, warnings) == (True, [], [])


def _tool(name):
    tool = shutil.which(name)
    if tool is None:
        pytest.skip(f"GDAL's {name} is not installed here")
    return tool


def _run(*arguments):
    done = subprocess.run(list(map(str, arguments)), capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return done


def test_gdal_tools_open_tiles_and_mosaics(mosaic, tmp_path):
    info, translate = _tool("gdalinfo"), _tool("gdal_translate")
    shutil.copytree(mosaic.path, tmp_path / "pack")
    tiles = [*mosaic.manifest.dop.tiles, *mosaic.manifest.dsm.tiles]
    for name in ("dop.vrt", "dsm.vrt", tiles[0].file, tiles[-1].file):
        done = _run(info, "-json", tmp_path / "pack" / name)
        assert json.loads(done.stdout)["coordinateSystem"]["wkt"]
        assert "ERROR" not in done.stderr
    for name, grid in (("dop", WIDE_DOP), ("dsm", WIDE_DSM)):
        west, south, east, north = grid.bounds
        source, target = tmp_path / "pack" / f"{name}.vrt", tmp_path / f"{name}.tif"
        window = ("-projwin", west, north, east, south)
        done = subprocess.run(
            [translate, "-q", *map(str, window), str(source), str(target)],
            capture_output=True, text=True, timeout=60, check=False,
        )  # fmt: skip
        if "WEBP" in done.stderr or "LERC" in done.stderr:
            pytest.skip(f"this GDAL cannot decompress: {done.stderr.splitlines()[0]}")
        assert done.returncode == 0, done.stderr
        with rasterio.open(target) as dataset:
            found = dataset.read()
        if name == "dop":
            assert np.array_equal(found[:3], textured(WIDE_DOP))
        else:
            assert np.abs(found[0] - dsm_heights(WIDE_DSM)[0]).max() < 0.06
    assert mosaic.verify() == []


def test_pystac_opens_the_collection(mosaic):
    pystac = pytest.importorskip("pystac")
    collection = pystac.Collection.from_file(str(mosaic.path / "stac" / "collection.json"))
    items = list(collection.get_items())
    tiles = [*mosaic.manifest.dop.tiles, *mosaic.manifest.dsm.tiles]
    assert len(items) == len(tiles)
    for item in items:
        for asset in item.get_assets().values():
            href = asset.get_absolute_href()
            with rasterio.open(href) as dataset:
                assert dataset.count in (1, 3)


def test_a_mosaic_without_one_system_is_refused(wide_scene, tmp_path):
    bare = write_raster(tmp_path / "bare.tif", textured(WIDE_DOP), WIDE_DOP, crs=None)
    with pytest.raises(MapError, match=r"bare\.tif: no reference system.*--crs"):
        built([wide_scene[0], bare], wide_scene[1], tmp_path / "pack")
    assert built([wide_scene[0], bare], wide_scene[1], tmp_path / "pack", source_crs=CRS).manifest.crs == CRS
