"""Real orthophotos and surface models through builder and store."""

import numpy as np
import pytest
import rasterio
from rasterio.windows import from_bounds

from ortholoc_edge.tiles.store import MapStore


@pytest.mark.parametrize(("name", "dop_error"), [("caliterra", 2.0), ("copr", 3.0), ("demo", 5.0)])
def test_real_maps_survive(real_pack, name, dop_error):
    """The middle half of the map through the store, against the same pixels of the source."""
    pack, (dop_source, dsm_source) = real_pack(name)
    with MapStore(pack) as store:
        west, south, east, north = store.bounds
        width, height = (east - west) / 4, (north - south) / 4
        region = (west + width, south + height, east - width, north - height)
        window = store.read(region, pack.manifest.dop.gsd_m, pack.manifest.dsm.gsd_m)
        picture = store.read_colour(region, pack.manifest.dop.gsd_m)
    with rasterio.open(dop_source) as source:
        place = from_bounds(*window.dop_grid.bounds, source.transform).round_offsets().round_lengths()
        pixels = np.moveaxis(source.read(window=place), 0, -1)
        valid = source.dataset_mask(window=place) > 0
    assert np.array_equal(window.dop_valid, valid)
    difference = np.abs(picture.rgb.astype(np.int16) - pixels)[valid]
    assert difference.mean() < dop_error

    with rasterio.open(dsm_source) as source:
        place = from_bounds(*window.dsm_grid.bounds, source.transform).round_offsets().round_lengths()
        heights = source.read(1, window=place)
    nodata = heights == -9999.0
    # Small holes may have been closed, nothing opened.
    assert np.isfinite(window.dsm[~nodata]).all()
    assert np.abs(window.dsm - heights)[~nodata].max() <= pack.manifest.dsm.max_z_error_m + 1e-5


