"""The collection as pystac reads it, and its figures against PROJ's and the files'."""

from __future__ import annotations

import hashlib
import json
from datetime import UTC, datetime
from pathlib import Path

import msgspec
import numpy as np
import pyproj
import pytest
import rasterio
from lattice_tiles import CRS, source, write_pack

from ortholoc_edge.errors import MapError
from ortholoc_edge.tiles.georeference import Georeference, VerticalDatum
from ortholoc_edge.tiles.lattice import Lattice, PixelBox
from ortholoc_edge.tiles.stac import COLLECTION, stac_files

SURVEY = "Landesamt für Vermessung, dl-de/by-2-0"


def write(pack):
    files = stac_files(pack.manifest, pack.georeference)
    (pack.folder / "stac").mkdir(exist_ok=True)
    for name, data in files.items():
        (pack.folder / name).write_bytes(data)
    return files


@pytest.fixture(scope="module")
def pack(tmp_path_factory):
    written = write_pack(
        tmp_path_factory.mktemp("stac") / "pack",
        dop_sources=[source("new.tif", "2023-06-04"), source("old.tif", "2021")],
        dsm_sources=[source("dsm.tif", "2020-02")],
        attribution=SURVEY,
        licence="dl-de/by-2-0",
    )
    write(written)
    return written


def load(pack, name=COLLECTION):
    return json.loads((pack.folder / name).read_text(encoding="utf-8"))


def area(ring):
    """Positive if counter-clockwise."""
    x, y = np.array(ring, dtype=float).T
    return float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) / 2)


def test_pystac_walks_the_collection_to_files_that_are_what_it_says(pack):
    pystac = pytest.importorskip("pystac")
    collection = pystac.Collection.from_file(str(pack.folder / COLLECTION))
    items = list(collection.get_items(recursive=True))
    assert sorted(item.id for item in items) == [
        "dop-691200_5334835",
        "dop-691200_5334937",
        "dop-691302_5334937",
        "dsm-691200_5334528",
    ]
    for item in items:
        assert item.get_collection() is collection
        (asset,) = item.assets.values()
        data = Path(asset.get_absolute_href()).read_bytes()
        assert asset.extra_fields["file:size"] == len(data)
        assert asset.extra_fields["file:checksum"] == "1220" + hashlib.sha256(data).hexdigest()
        with rasterio.open(asset.get_absolute_href()) as file:
            assert item.properties["proj:code"] == file.crs.to_string() == CRS
            assert item.properties["proj:shape"] == list(file.shape)
            assert item.properties["proj:bbox"] == pytest.approx(list(file.bounds))
            assert item.properties["proj:transform"] == pytest.approx(list(file.transform)[:6])
            assert item.properties["gsd"] == file.res[0]
            bands = asset.extra_fields["bands"]
            assert tuple(band["data_type"] for band in bands) == file.dtypes
            assert [band.get("nodata") for band in bands] == [file.nodata] * file.count
            assert [band["raster:spatial_resolution"] for band in bands] == [file.res[0]] * file.count
    stated = collection.extent.to_dict()
    collection.update_extent_from_items()
    assert collection.extent.spatial.to_dict() == stated["spatial"]
    first, last = collection.extent.temporal.intervals[0]
    assert (first, last) == (datetime(2020, 2, 1, tzinfo=UTC), datetime(2023, 6, 4, 23, 59, 59, tzinfo=UTC))
    assert stated["temporal"] == {"interval": [["2020-02-01T00:00:00Z", "2023-06-04T23:59:59Z"]]}


def test_the_files_are_valid_by_the_specifications_schemas(pack):
    pytest.importorskip("pystac")
    pytest.importorskip("jsonschema", reason="jsonschema is not installed")
    from pystac.validation.stac_validator import JsonSchemaSTACValidator

    # Of the core; those of extensions are on the network.
    validator = JsonSchemaSTACValidator()
    validator.validate_core(load(pack), "Collection", "1.1.0")
    for path in pack.folder.glob("stac/d*.json"):
        validator.validate_core(json.loads(path.read_text()), "Feature", "1.1.0")


def test_outlines_are_the_tiles_corners_counter_clockwise(pack):
    to_lon_lat = pyproj.Transformer.from_crs(CRS, "EPSG:4326", always_xy=True)
    for path in pack.folder.glob("stac/d*.json"):
        item = json.loads(path.read_text())
        (ring,) = item["geometry"]["coordinates"]
        assert ring[0] == ring[-1]
        assert area(ring) > 0
        west, south, east, north = item["properties"]["proj:bbox"]
        for corner in ((west, south), (east, south), (east, north), (west, north)):
            distances = np.hypot(*(np.array(ring) - to_lon_lat.transform(*corner)).T)
            assert distances.min() < 1e-7
        lon, lat = np.array(ring).T
        assert item["bbox"] == [lon.min(), lat.min(), lon.max(), lat.max()]


@pytest.mark.parametrize(
    ("dates", "interval"),
    [
        (["2024-02"], ["2024-02-01T00:00:00Z", "2024-02-29T23:59:59Z"]),
        (["2023"], ["2023-01-01T00:00:00Z", "2023-12-31T23:59:59Z"]),
        (["2023-06-04", "2021"], ["2021-01-01T00:00:00Z", "2023-06-04T23:59:59Z"]),
        (["2023-06-04", None], ["1858-01-01T00:00:00Z", "9999-12-31T23:59:59Z"]),
        ([], ["1858-01-01T00:00:00Z", "9999-12-31T23:59:59Z"]),
    ],
)
def test_an_items_interval_holds_the_dates_of_its_sources(pack, dates, interval):
    sources = [source(f"{number}.tif", day) for number, day in enumerate(dates)]
    tiles = [msgspec.structs.replace(tile, sources=()) for tile in pack.manifest.dop.tiles]
    dop = msgspec.structs.replace(pack.manifest.dop, sources=sources, tiles=tiles)
    files = stac_files(msgspec.structs.replace(pack.manifest, dop=dop), pack.georeference)
    properties = json.loads(files["stac/dop-691200_5334937.json"])["properties"]
    assert properties["datetime"] is None
    assert [properties["start_datetime"], properties["end_datetime"]] == interval
    known = None not in dates and bool(dates)
    assert properties["ortholoc:date_known"] is known
    stated = json.loads(files[COLLECTION])["extent"]["temporal"]["interval"][0]
    assert stated == (["2020-02-01T00:00:00Z", interval[1]] if known else [None, None])


def test_a_tile_has_the_dates_of_the_sources_it_shows_and_the_layers_where_they_have_none(pack):
    sources = [source("new.tif", None), source("old.tif", "2021")]
    tiles = [msgspec.structs.replace(tile, sources=(index % 2,)) for index, tile in enumerate(pack.manifest.dop.tiles)]
    dop = msgspec.structs.replace(pack.manifest.dop, sources=sources, tiles=tiles, date="2022")
    files = stac_files(msgspec.structs.replace(pack.manifest, dop=dop), pack.georeference)
    starts = [
        json.loads(files[f"stac/dop-{name}.json"])["properties"]["start_datetime"][:4]
        for name in ("691200_5334937", "691302_5334937")
    ]
    assert starts == ["2022", "2021"]


def test_a_date_that_is_none_is_refused(pack):
    dop = msgspec.structs.replace(pack.manifest.dop, sources=[source("a.tif", "2023-13")] * 2)
    with pytest.raises(MapError, match="2023-13: not in the calendar"):
        stac_files(msgspec.structs.replace(pack.manifest, dop=dop), pack.georeference)


@pytest.mark.parametrize(
    ("licence", "spdx", "url"),
    [
        ("dl-de/by-2-0", "DL-DE-BY-2.0", None),
        ("CC BY 4.0", "CC-BY-4.0", None),
        ("our own terms, https://example.org/terms; ask", "other", "https://example.org/terms"),
        (None, "other", None),
    ],
)
def test_licence_credit_and_vertical_datum(pack, licence, spdx, url):
    dop, dsm = (
        msgspec.structs.replace(layer, licence=licence, attribution=SURVEY)
        for layer in (pack.manifest.dop, pack.manifest.dsm)
    )
    files = stac_files(msgspec.structs.replace(pack.manifest, dop=dop, dsm=dsm), pack.georeference)
    collection = json.loads(files[COLLECTION])
    assert collection["license"] == spdx
    assert [link["href"] for link in collection["links"] if link["rel"] == "license"] == ([url] if url else [])
    assert (licence or "") in collection["description"]
    assert collection["providers"] == [{"name": SURVEY, "roles": ["licensor"]}]
    assert collection["summaries"]["ortholoc:vertical_datum"] == ["DHHN2016 height (EPSG:7837)"]
    assert collection["summaries"]["ortholoc:vertical_epsg"] == [7837]


def test_layers_of_different_licences_are_other_together_and_named_apart(pack):
    collection, item = load(pack), load(pack, "stac/dop-691200_5334937.json")
    assert collection["license"] == "other"
    assert item["properties"]["license"] == "DL-DE-BY-2.0"


def test_a_tile_across_180_degrees_is_cut_there(pack):
    # Fiji, whose Taveuni lies on both sides.
    crs = "EPSG:32760"
    to_map = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    east, north = to_map.transform(180.0, -17.0)
    lattice = Lattice(west=east - 256.0, top=north + 256.0, pixel_m=1.0, tile_px=512, levels=5)
    anchor = (east, north)
    boxes = [PixelBox(0, 0, 512, 512), PixelBox(512, 0, 512, 512)]
    tiles = [
        msgspec.structs.replace(pack.manifest.dop.tiles[0], **box._asdict(), file=f"dop/{index}.tif")
        for index, box in enumerate(boxes)
    ]
    manifest = msgspec.structs.replace(
        pack.manifest,
        crs=crs,
        anchor=anchor,
        dop=msgspec.structs.replace(pack.manifest.dop, lattice=lattice, tiles=tiles),
        dsm=msgspec.structs.replace(
            pack.manifest.dsm,
            lattice=lattice,
            tiles=[msgspec.structs.replace(pack.manifest.dsm.tiles[0], **boxes[0]._asdict())],
        ),
    )
    files = stac_files(manifest, Georeference(crs, VerticalDatum(kind="unknown"), anchor))
    across, beyond = (json.loads(files[f"stac/dop-{lattice.tile_name(box)}.json"]) for box in boxes)
    assert across["geometry"]["type"] == "MultiPolygon"
    rings = [polygon[0] for polygon in across["geometry"]["coordinates"]]
    spans = sorted((min(x for x, _ in ring), max(x for x, _ in ring)) for ring in rings)
    assert spans[0][0] == -180.0
    assert spans[1][1] == 180.0
    assert all(area(ring) > 0 for ring in rings)
    # 256 m on either side.
    assert across["bbox"][0] == pytest.approx(180 - 256 / 106_500, abs=1e-4)
    assert across["bbox"][2] == pytest.approx(-180 + 256 / 106_500, abs=1e-4)
    assert beyond["geometry"]["type"] == "Polygon"
    assert -180 < beyond["bbox"][0] < beyond["bbox"][2] < -179.9
    bbox = json.loads(files[COLLECTION])["extent"]["spatial"]["bbox"][0]
    assert bbox[0] == across["bbox"][0]
    assert bbox[2] == beyond["bbox"][2]


def test_a_system_as_wkt_is_given_as_wkt2(pack):
    wkt = pyproj.CRS.from_epsg(25832).to_wkt("WKT1_GDAL")
    files = stac_files(msgspec.structs.replace(pack.manifest, crs=wkt), pack.georeference)
    properties = json.loads(files["stac/dop-691200_5334937.json"])["properties"]
    assert properties["proj:code"] is None
    assert pyproj.CRS.from_wkt(properties["proj:wkt2"]).to_epsg() == 25832


def test_local_metres_have_no_place_in_a_catalogue(tmp_path):
    pack = write_pack(tmp_path / "pack", None)
    assert stac_files(pack.manifest, pack.georeference) == {}


def test_equal_manifests_give_equal_bytes(pack):
    assert stac_files(pack.manifest, pack.georeference) == stac_files(pack.manifest, pack.georeference)
