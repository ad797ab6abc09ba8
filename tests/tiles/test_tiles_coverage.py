"""Coverage reports: what is whole, what is missing, and where."""

from __future__ import annotations

import json

import numpy as np
import pytest
import rasterio
from lattice_tiles import CRS, VERTICAL, source
from rasterio.io import MemoryFile

from ortholoc_edge.tiles.coverage import cell_share, coverage_geojson, layer_cells, shares_on
from ortholoc_edge.tiles.encode import NODATA
from ortholoc_edge.tiles.georeference import Georeference
from ortholoc_edge.tiles.lattice import Lattice, PixelBox
from ortholoc_edge.tiles.manifest import FORMAT, VERSION, Dop, DopTile, Dsm, DsmTile, Manifest, encode_crcs
from ortholoc_edge.tiles.matchability import matchability_tif

WEST, TOP = 691_200.0, 5_335_040.0
DOP_LATTICE = Lattice(west=WEST, top=TOP, pixel_m=0.2, tile_px=512, levels=5)
DSM_LATTICE = Lattice(west=WEST, top=TOP, pixel_m=1.0, tile_px=512, levels=5)
# 2 x 1 tiles of 102.4 m; DOP cells are 12.8 m, DSM cells 64 m.
DOP_BOXES = [PixelBox(0, 0, 512, 512), PixelBox(512, 0, 512, 512)]
DSM_BOX = PixelBox(0, 0, 192, 128)


def tile(kind, index, box, **more):
    note = {"file": f"{kind.__name__}/{index}.tif", "bytes": 1, "sha256": "0" * 64}
    return kind(**note, **box._asdict(), valid_fraction=1.0, segment_crc32=encode_crcs([0]), **more)


def pack(crs=CRS):
    dop_tiles = [tile(DopTile, k, box, sources=(k,)) for k, box in enumerate(DOP_BOXES)]
    dop = Dop(
        lattice=DOP_LATTICE,
        compression="webp",
        sources=[source("west.tif", "2023-06"), source("east.tif", None)],
        tiles=dop_tiles,
    )
    dsm = Dsm(
        lattice=DSM_LATTICE,
        compression="lerc_zstd",
        sources=[],
        tiles=[tile(DsmTile, 0, DSM_BOX, min_m=0.0, max_m=1.0)],
        max_z_error_m=0.0,
        nodata=NODATA,
    )
    manifest = Manifest(
        format=FORMAT,
        version=VERSION,
        created=None,
        crs=crs,
        anchor=(WEST, TOP),
        vertical=VERTICAL,
        dop=dop,
        dsm=dsm,
    )
    return manifest, Georeference(crs, VERTICAL, (WEST, TOP))


def full(box):
    return np.full((box.height // 64, box.width // 64), 100, dtype=np.uint8)


def ring_area(ring):
    x, y = np.asarray(ring).T
    return 0.5 * float(np.sum((x[:-1] - x[0]) * (y[1:] - y[0]) - (x[1:] - x[0]) * (y[:-1] - y[0])))


def by_kind(data):
    found = {}
    for feature in json.loads(data)["features"]:
        found.setdefault(feature["properties"]["kind"], []).append(feature)
    return found


def test_shares_keep_none_and_all_apart_from_almost():
    valid = np.zeros((128, 192), dtype=bool)
    valid[0, 64] = True
    valid[:64, 128:] = True
    valid[64:, :64] = True
    valid[127, 63] = False
    valid[64:96, 64:128] = True
    np.testing.assert_array_equal(cell_share(valid), [[0, 1, 100], [99, 50, 0]])
    with pytest.raises(ValueError, match="whole cells"):
        cell_share(valid[:100])


def test_a_whole_map_is_complete_and_the_dsm_beyond_it_is_named():
    manifest, georeference = pack(crs=None)
    found = by_kind(coverage_geojson(manifest, georeference, [full(b) for b in DOP_BOXES], [full(DSM_BOX)]))
    assert set(found) == {"complete", "dsm_without_dop", "dop_without_dsm", "source"}
    (complete,) = found["complete"]
    # 192 of the DOP's 204.8 m lie on the DSM, whose rim ends inside a cell.
    assert complete["properties"]["km2"] == pytest.approx(0.192 * 0.1024, rel=0.05)
    (ring,) = complete["geometry"]["coordinates"][0]
    assert ring[0] == ring[-1]
    assert ring_area(ring) == pytest.approx(192.0 * 102.4, rel=0.02)
    assert found["dsm_without_dop"][0]["properties"]["km2"] == pytest.approx(0.192 * 0.0256, rel=0.25)


def test_holes_are_clockwise_rings_and_local_metres_are_flagged():
    manifest, georeference = pack(crs=None)
    shares = [full(b) for b in DOP_BOXES]
    shares[0][3:5, 2:5] = 10
    data = coverage_geojson(manifest, georeference, shares, [full(DSM_BOX)])
    assert "no CRS" in json.loads(data)["coordinates_are"]
    (complete,) = by_kind(data)["complete"]
    outer, hole = complete["geometry"]["coordinates"][0]
    assert ring_area(outer) > 0
    assert ring_area(hole) == pytest.approx(-6 * 12.8**2)
    assert {tuple(point) for point in hole} >= {(WEST + 25.6, TOP - 38.4), (WEST + 64.0, TOP - 64.0)}
    # The tenth of the holes' cells that is valid counts.
    whole = by_kind(coverage_geojson(manifest, georeference, [full(b) for b in DOP_BOXES], [full(DSM_BOX)]))
    lost_km2 = whole["complete"][0]["properties"]["km2"] - complete["properties"]["km2"]
    assert lost_km2 == pytest.approx(0.9 * 6 * 12.8**2 / 1e6, abs=1e-4)


def test_coordinates_are_longitude_and_latitude():
    manifest, georeference = pack()
    filled = [(WEST + 50.0, TOP - 50.0, 7)]
    data = coverage_geojson(manifest, georeference, [full(b) for b in DOP_BOXES], [full(DSM_BOX)], filled)
    assert "coordinates_are" not in json.loads(data)
    found = by_kind(data)
    (hole,) = found["filled_hole"]
    position = georeference.geodetic_from_map((*filled[0][:2], 0.0))
    assert hole["geometry"]["coordinates"] == pytest.approx([position.lon_deg, position.lat_deg], abs=1e-6)
    assert hole["properties"] == {"kind": "filled_hole", "cells": 7, "m2": 7.0}
    ring = np.array(found["complete"][0]["geometry"]["coordinates"][0][0])
    west = georeference.geodetic_from_map((WEST, TOP, 0.0))
    assert np.abs(ring - (west.lon_deg, west.lat_deg)).max(axis=1).min() < 1e-6
    assert ring_area(ring) > 0


def test_sources_cover_the_tiles_that_show_them():
    manifest, georeference = pack(crs=None)
    found = by_kind(coverage_geojson(manifest, georeference, [full(b) for b in DOP_BOXES], [full(DSM_BOX)]))
    west, east = found["source"]
    assert (west["properties"]["name"], west["properties"]["date"]) == ("west.tif", "2023-06")
    assert (east["properties"]["name"], east["properties"]["date"]) == ("east.tif", None)
    corners = np.array(east["geometry"]["coordinates"][0][0])
    np.testing.assert_allclose(corners.min(axis=0), (WEST + 102.4, TOP - 102.4))
    np.testing.assert_allclose(corners.max(axis=0), (WEST + 204.8, TOP))


def test_a_large_ragged_pack_stays_small_and_equal_input_gives_equal_bytes():
    box = PixelBox(0, 0, 192 * 64, 192 * 64)
    lattice = Lattice(west=WEST, top=TOP, pixel_m=0.2, tile_px=2**16, levels=5)
    manifest, georeference = pack(crs=None)
    dop = Dop(lattice=lattice, compression="webp", sources=[], tiles=[tile(DopTile, 0, box)])
    large = Manifest(**{key: getattr(manifest, key) for key in manifest.__struct_fields__} | {"dop": dop})
    ragged = np.where(np.random.default_rng(0).random((192, 192)) < 0.5, 100, 0).astype(np.uint8)
    filled = [(WEST + k, TOP - k, k) for k in range(1000)]
    data = coverage_geojson(large, georeference, [ragged], [full(DSM_BOX)], filled)
    assert len(data) < 200_000
    assert json.loads(data)["filled_holes"] == {"count": 1000, "cells": 499_500}
    assert data == coverage_geojson(large, georeference, [ragged], [full(DSM_BOX)], reversed(filled))


def test_shares_of_larger_cells_end_where_their_area_does():
    manifest, _ = pack()
    dop, grid = layer_cells(manifest.dop, [full(b) for b in DOP_BOXES])
    assert dop.shape == (8, 16)
    shares = full(DSM_BOX)
    shares[:, 2] = 40
    dsm, dsm_grid = layer_cells(manifest.dsm, [shares])
    percent = shares_on(dsm, dsm_grid, grid)
    east_m = 12.8 * (np.arange(16) + 0.5)
    assert (percent[4] >= 50).sum() == (east_m < 128 + 0.4 * 64).sum()


def test_matchability_is_a_raster_on_the_dop_lattice_and_unknown_without_a_dsm():
    manifest, _ = pack()
    cells = [np.full((8, 8), 10, dtype=np.uint8), np.arange(64, dtype=np.uint8).reshape(8, 8)]
    cells[0][0, 0] = 255
    shares = full(DSM_BOX)
    shares[:, 2] = 0
    data = matchability_tif(manifest, cells, [shares])
    assert data == matchability_tif(manifest, cells, [shares])
    with MemoryFile(data) as memory, memory.open() as raster:
        assert raster.crs == rasterio.CRS.from_string(CRS)
        assert raster.nodata == 255
        assert raster.profile["compress"] == "deflate"
        assert raster.transform[:6] == pytest.approx((12.8, 0.0, WEST, 0.0, -12.8, TOP))
        values = raster.read(1)
    assert values.shape == (8, 16)
    assert values[0, 0] == 255
    assert (values[1:, :8] == 10).all()
    # The surface model ends 128 m from the west.
    np.testing.assert_array_equal(values[:, 8:10], cells[1][:, :2])
    assert (values[:, 10:] == 255).all()
