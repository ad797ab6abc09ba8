"""What files, folders and ZIPs say about themselves."""

import logging
import pickle
import warnings
import zipfile

import numpy as np
import pytest
import rasterio
import rasterio.shutil
from affine import Affine
from rasterio.enums import ColorInterp, WktVersion
from rasterio.errors import NotGeoreferencedWarning

from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.sources import date_of_name, discover, fingerprint, prepare, read_dop, read_dsm

CRS = "EPSG:25832"
GRID = RasterGrid(60, 40, 350_000.0, 5_650_000.0, 0.5, -0.5)


def raster(path, bands, *, grid=GRID, crs=CRS, colorinterp=None, tags=None, mask=None, driver="GTiff", **profile):
    bands = np.asarray(bands)
    path.parent.mkdir(parents=True, exist_ok=True)
    profile = {
        "driver": driver,
        "width": bands.shape[2],
        "height": bands.shape[1],
        "count": len(bands),
        "dtype": bands.dtype.name,
        "crs": crs,
        "transform": Affine(grid.dx, 0, grid.west, 0, grid.dy, grid.top),
        **profile,
    }
    with warnings.catch_warnings(), rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        target = rasterio.open(path, "w", **profile)
    with target:
        if colorinterp is not None:
            target.colorinterp = colorinterp
        target.write(bands)
        if mask is not None:
            target.write_mask(mask)
        if tags is not None:
            target.update_tags(**tags)
    return path


def picture(count=3, grid=GRID, dtype="uint8", seed=0):
    top = 250 if dtype == "uint8" else 4000
    return np.random.default_rng(seed).integers(5, top, (count, grid.height, grid.width)).astype(dtype)


def relief(grid=GRID):
    return np.random.default_rng(1).uniform(200, 260, (1, grid.height, grid.width)).astype(np.float32)


def zipped(path, *files, compression=zipfile.ZIP_STORED, folder=""):
    with zipfile.ZipFile(path, "w", compression) as archive:
        for file in files:
            archive.write(file, folder + file.name)
    return path


def only(path, kind="dop", **options):
    (source,) = discover([path], kind, **options)
    return source


def test_geotiff_says_where_it_is(tmp_path):
    pixels = picture()
    source = only(raster(tmp_path / "dop20rgb_32_350_5649_1_nw_2023.tif", pixels))
    assert (source.grid, source.crs, source.gsd_m, source.date) == (GRID, CRS, 0.5, "2023")
    assert source.name == "dop20rgb_32_350_5649_1_nw_2023.tif"
    # It goes to worker processes, which read the same from it.
    again = pickle.loads(pickle.dumps(source))
    assert again == source and fingerprint(again) == fingerprint(source)
    assert np.array_equal(read_dop(again, GRID, CRS).rgb, pixels)


def test_fingerprint_changes_with_file_and_options(tmp_path):
    path = raster(tmp_path / "a.tif", picture())
    first = fingerprint(only(path))
    assert fingerprint(only(path, date="2020")) != first
    raster(path, picture(seed=3, grid=RasterGrid(61, 40, 0, 0, 1, -1)))
    assert fingerprint(only(path)) != first
    source = only(path)
    path.unlink()
    with pytest.raises(MapError, match=r"a\.tif.*moved"):
        fingerprint(source)


def test_folder_is_searched_and_what_does_not_belong_is_passed_over(tmp_path, caplog):
    raster(tmp_path / "b" / "deep" / "two.TIF", picture())
    raster(tmp_path / "a" / "one.tif", picture())
    raster(tmp_path / "a" / "preview.png", picture(), driver="PNG", crs=None, transform=Affine.identity())
    raster(tmp_path / "a" / "dom.tif", relief())
    (tmp_path / "readme.txt").write_text("Geobasis NRW 2023\n")
    (tmp_path / "meta.xml").write_text("<a/>")
    (tmp_path / ".hidden.tif").write_bytes(b"nothing")
    with caplog.at_level(logging.INFO):
        found = discover([tmp_path], "dop")
    assert [source.name for source in found] == ["one.tif", "two.TIF"]
    (line,) = [r.getMessage() for r in caplog.records if r.name.startswith("ortholoc")]
    assert line.startswith("4 files passed over")
    # The same folder holds the surface model, as georaffer leaves it.
    assert [source.name for source in discover([tmp_path], "dsm")] == ["dom.tif"]


def test_each_file_counts_once(tmp_path):
    path = raster(tmp_path / "one.tif", picture())
    link = tmp_path / "other"
    link.symlink_to(tmp_path)
    assert len(discover([path, tmp_path, path, link / "one.tif"], "dop")) == 1


def test_vrt_and_what_lies_below_it_count_once(tmp_path):
    tile = raster(tmp_path / "tile.tif", picture())
    vrt = tmp_path / "mosaic.vrt"
    with rasterio.open(tile) as dataset:
        rasterio.shutil.copy(dataset, vrt, driver="VRT")
    assert [s.name for s in discover([tmp_path], "dop")] == ["tile.tif"]
    assert [s.name for s in discover([vrt], "dop")] == ["mosaic.vrt"]
    assert [s.name for s in discover([vrt, tmp_path], "dop")] == ["mosaic.vrt"]
    assert [s.name for s in discover([tmp_path, vrt], "dop")] == ["mosaic.vrt"]
    # A folder with nothing but the mosaic: its tiles are elsewhere.
    (tmp_path / "above").mkdir()
    above = tmp_path / "above" / "mosaic.vrt"
    above.write_text(vrt.read_text().replace('relativeToVRT="1">', 'relativeToVRT="1">../'))
    assert [s.name for s in discover([above.parent], "dop")] == ["mosaic.vrt"]
    before = fingerprint(only(vrt))
    raster(tile, picture(grid=RasterGrid(60, 40, 0, 0, 1, -1), seed=8), compress="LZW")
    assert fingerprint(only(vrt)) != before


@pytest.mark.parametrize("compression", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_zip_with_folders_inside(tmp_path, compression):
    inner = raster(tmp_path / "in" / "dop_33250-5888.tif", picture())
    archive = zipped(tmp_path / "dop_(x) {1}.zip", inner, compression=compression, folder="daten/dop/")
    source = only(archive)
    assert source.name == "dop_(x) {1}.zip/daten/dop/dop_33250-5888.tif"
    assert source.slow == (compression == zipfile.ZIP_DEFLATED)
    assert np.array_equal(read_dop(source, GRID, CRS).rgb, picture())
    plain = prepare(source, tmp_path / "work")
    assert (plain == source) == (compression == zipfile.ZIP_STORED)
    assert np.array_equal(read_dop(plain, GRID, CRS).rgb, picture())


def test_one_name_in_two_zips_is_two_sources(tmp_path):
    tile = raster(tmp_path / "in" / "tile.tif", picture())
    archives = [zipped(tmp_path / f"{name}.zip", tile) for name in "ab"]
    assert [s.name for s in discover(archives, "dop")] == ["a.zip/tile.tif", "b.zip/tile.tif"]
    assert len(discover([tmp_path], "dop")) == 3


def test_nothing_usable_is_an_error(tmp_path):
    (tmp_path / "a.xml").write_text("<a/>")
    archive = zipped(tmp_path / "x.zip", tmp_path / "a.xml")
    for path in (tmp_path, archive):
        with pytest.raises(MapError, match="nothing in it"):
            discover([path], "dop")
    with pytest.raises(MapError, match="no such file"):
        discover([tmp_path / "none.tif"], "dop")
    text = tmp_path / "a.tif"
    text.write_text("not a raster")
    for path in (text, tmp_path):
        with pytest.raises(MapError, match=r"a\.tif: cannot be read .*not recognized"):
            discover([path], "dop")
    broken = tmp_path / "broken.zip"
    broken.write_bytes(archive.read_bytes()[:-30])
    with pytest.raises(MapError, match=r"broken\.zip: is not a readable ZIP"):
        discover([broken], "dop")


# Reference systems


def world_file(path, grid=GRID):
    """A picture placed by a world file alone, whose origin is the centre of the first pixel."""
    # Smooth: JPEG makes another noise of noise.
    pixels = np.sort(np.sort(picture(), axis=1), axis=2)
    raster(path, pixels, crs=None, driver={"jpg": "JPEG", "png": "PNG", "tif": "GTiff"}[path.suffix[1:]])
    for extra in path.parent.glob(f"{path.name}.aux.xml"):
        extra.unlink()
    beside = path.with_suffix("." + path.suffix[1] + path.suffix[3] + "w")
    beside.write_text(f"{grid.dx}\n0\n0\n{grid.dy}\n{grid.west + grid.dx / 2}\n{grid.top + grid.dy / 2}\n")
    return path, pixels


@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_world_file_needs_a_system(tmp_path, suffix):
    path, pixels = world_file(tmp_path / f"tile.{suffix}")
    with pytest.raises(MapError, match=rf"tile\.{suffix}: placed by a world file.*--crs"):
        only(path)
    source = only(path, assign_crs=CRS)
    assert (source.crs, source.grid) == (CRS, GRID)
    assert only(path, assign_crs="local").crs is None
    path.with_suffix(".prj").write_text(rasterio.CRS.from_epsg(25832).to_wkt(version=WktVersion.WKT1_ESRI))
    assert only(path).crs == CRS
    got = read_dop(prepare(source, tmp_path / "work"), GRID, CRS)
    assert np.abs(got.rgb.astype(int) - pixels).mean() <= (0 if suffix == "png" else 12)


def test_world_file_of_a_zipped_picture(tmp_path):
    path, pixels = world_file(tmp_path / "tile.png")
    archive = zipped(tmp_path / "t.zip", path, path.with_suffix(".pgw"), compression=zipfile.ZIP_DEFLATED)
    source = prepare(only(archive, assign_crs=CRS), tmp_path / "work")
    assert source.grid == GRID
    assert np.array_equal(read_dop(source, GRID, CRS).rgb, pixels)


def test_own_system_wins(tmp_path, caplog):
    path = raster(tmp_path / "a.tif", picture())
    assert only(path, assign_crs="EPSG:25833").crs == CRS
    assert "a.tif: have the system ETRS89 / UTM zone 32N, --crs is not used" in caplog.text
    caplog.clear()
    assert only(path, assign_crs=CRS).crs == CRS
    assert not caplog.records
    with pytest.raises(ConfigError, match=r"--crs EPSG:1.*write it as"):
        only(path, assign_crs="EPSG:1")


def test_local_metres_only_if_none_has_a_system(tmp_path):
    one, other = (raster(tmp_path / name, picture(), crs=crs) for name, crs in (("a.tif", None), ("b.tif", CRS)))
    assert only(one).crs is None
    with pytest.raises(MapError, match=r"a\.tif: no reference system, but b\.tif has one"):
        discover([one, other], "dop")
    assert {s.crs for s in discover([one, other], "dop", assign_crs=CRS)} == {CRS}


def test_compound_system_names_the_heights(tmp_path):
    compound = raster(tmp_path / "a.tif", relief(), crs="EPSG:25832+7837")
    assert only(compound, "dsm").crs == CRS
    assert only(compound, "dsm").vertical == ("orthometric", 7837)
    flat = raster(tmp_path / "b.tif", relief())
    assert only(flat, "dsm").vertical is None
    assert only(flat, "dsm", assign_crs="EPSG:25832+7837").vertical == ("orthometric", 7837)
    feet = raster(tmp_path / "c.tif", relief(), crs="EPSG:26910+6360")
    with pytest.raises(MapError, match=r"foot|feet|ft"):
        only(feet, "dsm")


def test_degrees_have_a_size_in_metres(tmp_path):
    grid = RasterGrid(60, 40, 8.0, 51.0, 1e-5, -1e-5)
    source = only(raster(tmp_path / "a.tif", picture(grid=grid), grid=grid, crs="EPSG:4326"))
    # 1e-5 degrees at 51 N: 1.1126 m north, 0.7019 m east.
    assert source.crs == "EPSG:4326" and source.gsd_m == pytest.approx(np.sqrt(1.1126 * 0.7019), rel=1e-3)
    local = raster(tmp_path / "b.tif", picture(grid=grid), grid=grid, crs=None)
    with pytest.raises(MapError, match="looks like degrees"):
        only(local)


def test_feet_of_a_grid_have_a_size_in_metres(tmp_path):
    grid = RasterGrid(60, 40, 6_000_000.0, 2_100_000.0, 1.0, -1.0)
    source = only(raster(tmp_path / "a.tif", picture(grid=grid), grid=grid, crs="EPSG:2227"))
    assert source.gsd_m == pytest.approx(0.3048, rel=1e-3)


@pytest.mark.parametrize("crs", ['LOCAL_CS["site",UNIT["metre",1]]'])
def test_system_without_a_place_is_refused(tmp_path, crs):
    with pytest.raises(MapError, match="no place on Earth"):
        only(raster(tmp_path / "a.tif", picture(), crs=rasterio.CRS.from_wkt(crs)))


@pytest.mark.parametrize("form", [{"GeoJP2": "YES", "GMLJP2": "NO"}, {"GeoJP2": "NO", "GMLJP2": "YES"}, {}, None])
def test_axis_order_north_east_is_no_trap(tmp_path, form):
    """Czech tiles: EPSG:3045 counts north first."""
    if form is None:
        path = raster(tmp_path / "a.tif", picture(), crs="EPSG:3045")
    else:
        memory = raster(tmp_path / "in.tif", picture(), crs="EPSG:3045")
        path = tmp_path / "a.jp2"
        rasterio.shutil.copy(memory, path, driver="JP2OpenJPEG", QUALITY="100", REVERSIBLE="YES", **form)
    source = prepare(only(path), tmp_path / "work")
    assert (source.crs, source.grid) == ("EPSG:3045", GRID)
    assert np.array_equal(read_dop(source, GRID, "EPSG:3045").rgb, picture())
    # EPSG:25833 is the same system with the axes the other way.
    assert np.array_equal(read_dop(source, GRID, "EPSG:25833").rgb, picture())


def test_without_georeference_or_straightness(tmp_path):
    bare = raster(tmp_path / "a.tif", picture(), transform=Affine.identity())
    with pytest.raises(MapError, match="no georeference"):
        only(bare)
    turned = raster(tmp_path / "b.tif", picture(), transform=Affine.translation(1e5, 5e6) @ Affine.rotation(10))
    with pytest.raises(MapError, match="rotated"):
        only(turned)


# Bands


@pytest.mark.parametrize("grey", [1, 2])
def test_grey(tmp_path, grey):
    pixels = picture(grey)
    roles = [ColorInterp.gray, ColorInterp.alpha][:grey]
    if grey == 2:
        pixels[1] = np.where(pixels[1] > 100, 255, 0)
    got = read_dop(only(raster(tmp_path / "a.tif", pixels, colorinterp=roles)), GRID, CRS)
    valid = pixels[1] > 0 if grey == 2 else np.ones(pixels.shape[1:], bool)
    assert np.array_equal(got.valid, valid)
    assert all(np.array_equal(band, pixels[0] * valid) for band in got.rgb)


RGB = [ColorInterp.red, ColorInterp.green, ColorInterp.blue]


def test_infrared_is_not_alpha(tmp_path):
    pixels = picture(4)
    pixels[3, :20] = 0
    source = only(raster(tmp_path / "a.tif", pixels, colorinterp=[*RGB, ColorInterp.undefined]))
    assert (source.nir, source.alpha) == (4, None)
    got = read_dop(source, GRID, CRS)
    assert got.valid.all() and np.array_equal(got.rgb, pixels[:3]) and np.array_equal(got.nir, pixels[3])


def test_alpha_is_a_mask(tmp_path):
    pixels = picture(4)
    pixels[3] = 255
    pixels[3, :20] = 0
    got = read_dop(only(raster(tmp_path / "a.tif", pixels, colorinterp=[*RGB, ColorInterp.alpha])), GRID, CRS)
    assert got.nir is None and not got.valid[:20].any() and got.valid[20:].all() and not got.rgb[:, :20].any()


def test_alpha_that_is_infrared_is_found_out(tmp_path, caplog):
    path = raster(tmp_path / "a.tif", picture(4), colorinterp=[*RGB, ColorInterp.alpha])
    source = prepare(only(path), tmp_path / "work")
    assert "band 4 is said to be alpha" in caplog.text
    got = read_dop(source, GRID, CRS)
    assert got.valid.all() and np.array_equal(got.nir, picture(4)[3])


def test_named_bands_in_any_order(tmp_path):
    pixels = picture(5)
    pixels[4] = 255
    roles = [ColorInterp.nir, ColorInterp.blue, ColorInterp.green, ColorInterp.red, ColorInterp.alpha]
    path = raster(tmp_path / "a.tif", pixels, colorinterp=roles)
    source = only(path)
    assert (source.bands, source.nir, source.alpha) == ((4, 3, 2), 1, 5)
    got = read_dop(source, GRID, CRS)
    assert np.array_equal(got.rgb, pixels[[3, 2, 1]]) and np.array_equal(got.nir, pixels[0])


def test_infrared_by_its_description(tmp_path):
    path = raster(tmp_path / "a.tif", picture(4), photometric="MINISBLACK")
    with rasterio.open(path, "r+") as dataset:
        dataset.descriptions = ["NIR", "red", "green", "blue"]
    source = only(path)
    assert (source.bands, source.nir) == ((2, 3, 4), 1)


def test_palette_is_expanded(tmp_path):
    index = np.random.default_rng(0).integers(0, 4, (1, GRID.height, GRID.width)).astype(np.uint8)
    table = {0: (10, 20, 30, 255), 1: (200, 100, 0, 255), 2: (0, 0, 0, 0), 3: (250, 250, 250, 255)}
    path = tmp_path / "a.tif"
    raster(path, index, photometric="PALETTE")
    with rasterio.open(path, "r+") as dataset:
        dataset.write_colormap(1, table)
    source = only(path)
    expected = np.moveaxis(np.array([table[k][:3] for k in range(4)], np.uint8)[index[0]], -1, 0)
    for one in (source, prepare(source, tmp_path / "work")):
        assert np.array_equal(read_dop(one, GRID, CRS).rgb, expected)
    assert not prepare(source, tmp_path / "work").palette


@pytest.mark.parametrize(
    ("bands", "dtype", "message"),
    [(2, "uint8", "2 bands"), (6, "uint8", "6 bands"), (3, "float32", "samples are float32"), (1, "int32", "--dsm")],
)
def test_unusable_bands(tmp_path, bands, dtype, message):
    path = raster(tmp_path / "a.tif", picture(bands).astype(dtype), photometric="MINISBLACK")
    with pytest.raises(MapError, match=rf"a\.tif: .*{message}"):
        only(path)


def test_unusable_heights(tmp_path):
    with pytest.raises(MapError, match="3 bands"):
        only(raster(tmp_path / "a.tif", picture()), "dsm")
    path = raster(tmp_path / "b.tif", relief())
    with rasterio.open(path, "r+") as dataset:
        dataset.units = ("US survey foot",)
    with pytest.raises(MapError, match="heights are in us survey foot; convert"):
        only(path, "dsm")


def test_scaled_heights(tmp_path):
    stored = np.rint(relief() * 10).astype(np.int16)
    stored[0, 0, 0] = -32768
    path = raster(tmp_path / "a.tif", stored - 1000, nodata=-33)
    with rasterio.open(path, "r+") as dataset:
        dataset.scales, dataset.offsets = (0.1,), (100.0,)
    got = read_dsm(only(path, "dsm"), GRID, CRS)
    assert np.allclose(got[1:], stored[0, 1:] / 10, atol=1e-4)


# Dates


@pytest.mark.parametrize(
    ("name", "date"),
    [
        ("dop10rgbi_32_280_5652_1_nw_2023.jp2", "2023"),
        ("dom1_32_600_5600_1_th_2020-2025.zip", "2025"),
        ("dop20rgb_32_370_5500_2_rp_2022.jp2", "2022"),
        ("swissimage-dop10_2021_2600-1199_0.1_2056.tif", "2021"),
        ("swisssurface3d-raster_2019_2600-1199_0.5_2056_5728.tif", "2019"),
        ("NRW_32_280_5652_2021.tif", "2021"),
        ("dop20rgbi_32_548_5798_2_ni_2022-05-15.tif", "2022-05-15"),
        ("m_3807708_sw_18_060_20210612.tif", "2021-06-12"),
        ("m_3807708_sw_18_060_20210612_20211010.tif", "2021-06-12"),
        ("tile_2023-06.tif", "2023-06"),
        ("dom1_32_600_5600_1_th_2020.xyz.gz", "2020"),
        ("dop_33250-5888.zip", None),
        ("32686_5369.tif", None),
        ("32686_5369_20_DOM.tif", None),
        ("dop20rgb_32_387_5394_2_bw.zip", None),
        ("a_20211345.tif", None),
        ("a_1066.tif", None),
        ("1980_1990.tif", "1990"),
    ],
)
def test_date_of_name(name, date):
    assert date_of_name(name) == date


@pytest.mark.parametrize(
    ("name", "tags", "date"),
    [
        ("a.tif", {"TIFFTAG_DATETIME": "2023:06:04 12:34:56"}, "2023-06-04"),
        ("a_2023.tif", {"TIFFTAG_DATETIME": "2023:06:04 12:34:56"}, "2023-06-04"),
        # The file was made a year after the flight.
        ("a_2022.tif", {"TIFFTAG_DATETIME": "2023:06:04 12:34:56"}, "2022"),
        ("a_2022.tif", {"ACQUISITION_DATE": "2021-05-01T10:00:00Z"}, "2021-05-01"),
        ("a.tif", {"Bildflugdatum": "1.5.2021"}, "2021-05-01"),
        ("a.tif", {"TIFFTAG_DATETIME": "0000:00:00 00:00:00"}, None),
        ("a.tif", {}, None),
    ],
)
def test_date_of_file(tmp_path, name, tags, date):
    path = raster(tmp_path / name, picture(), tags=tags)
    assert only(path).date == date
    assert only(path, date="2011-11").date == "2011-11"


def test_date_of_a_zip_serves_its_members(tmp_path):
    tile = raster(tmp_path / "tile.tif", picture())
    assert only(zipped(tmp_path / "dop_th_2020-2025.zip", tile)).date == "2025"


def test_date_of_the_user_must_be_one(tmp_path):
    with pytest.raises(ConfigError, match="write it as 2023"):
        discover([tmp_path], "dop", date="June")
