"""Figures about packs: the arithmetic on known answers, and a localizer process on a real pack."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine

from ortholoc_edge.bench import packs
from ortholoc_edge.errors import DatasetError
from ortholoc_edge.tiles.build import PackOptions, build_pack


def _raster(path: Path, bands: np.ndarray, gsd_m: float, **more: object) -> Path:
    with rasterio.open(
        path, "w", driver="GTiff", count=len(bands), height=bands.shape[1], width=bands.shape[2], dtype=bands.dtype,
        transform=Affine(gsd_m, 0, 600_000, 0, -gsd_m, 5_000_000), crs="EPSG:32632", **more,
    ) as target:  # fmt: skip
        target.write(bands)
    return path


def _measured(te_m: list[list[float]]) -> packs.Measured:
    errors = np.array(te_m)
    return packs.Measured(errors, errors / 2, 2.0, 4_000_000, 1_000_000, 500_000, 30_000)


def test_averaging_takes_valid_pixels_only(tmp_path: Path) -> None:
    dop = np.zeros((3, 4, 6), np.uint8)
    dop[:] = [[10, 20, 100, 100, 7, 7], [30, 40, 100, 100, 7, 7], [1, 1, 2, 2, 3, 3], [1, 1, 2, 2, 3, 3]]
    dsm = np.full((1, 4, 6), 5.0, np.float32)
    dsm[0, 0, 0], dsm[0, 2:, 2:4] = 9.0, -9999.0
    fine_dop = _raster(tmp_path / "a_dop.tif", dop, 0.1)
    fine_dsm = _raster(tmp_path / "a_dsm.tif", dsm, 0.5, nodata=-9999.0)
    coarse = packs.coarsened(tmp_path, fine_dop, fine_dsm, 0.2, 1.0)
    with rasterio.open(coarse[0]) as raster:
        assert raster.read(1).tolist() == [[25, 100, 7], [1, 2, 3]]
        assert raster.transform.a == pytest.approx(0.2)
    with rasterio.open(coarse[1]) as raster:
        assert raster.read(1).tolist() == [[6.0, 5.0, 5.0], [5.0, -9999.0, 5.0]]


def test_averaging_refuses_pixels_that_do_not_divide(tmp_path: Path) -> None:
    dop = _raster(tmp_path / "a_dop.tif", np.zeros((3, 4, 4), np.uint8), 0.15)
    with pytest.raises(DatasetError, match="don't make up"):
        packs.coarsened(tmp_path, dop, dop, 0.2, 1.0)


def test_a_row_compares_frame_by_frame_with_the_reference() -> None:
    reference = _measured([[0.1, 0.2, 0.4], [0.1, 0.2, np.inf]])
    worse = _measured([[0.2, 0.4, 0.8], [0.2, np.inf, 0.1]])
    row = packs.size_row("worse", [worse], [reference])
    assert row.te_ratio == pytest.approx(2.0)  # medians of 0.2 0.4 0.8 0.2 over 0.1 0.2 0.4 0.1: both fixed these
    assert row.frame_ratio == pytest.approx(2.0)
    assert row.frame_ratio_low == row.frame_ratio_high == pytest.approx(2.0)
    assert row.recall == pytest.approx(5 / 6)
    assert row.mb_per_km2 == pytest.approx(2.75)
    same = packs.size_row("same", [reference, reference], [reference, reference])
    assert (same.te_ratio, same.te_ratio_low, same.te_ratio_high, same.frames) == (1.0, 1.0, 1.0, 12)
    assert same.mb_per_km2 == pytest.approx(2.75)


def test_variants_change_one_thing_and_the_reference_is_lossless() -> None:
    chosen = packs.variants([90, 75], [75], [0.05, 0.1], [1000.0], "xfeat", 75)
    assert chosen[0].options.quality == 100
    assert chosen[0].options.max_z_error_m == 1e-4
    assert len({v.name for v in chosen}) == len(chosen) == 6
    assert [v.features for v in chosen] == [False] * 5 + [True]


def test_reads_are_measured_per_level(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    dop = _raster(tmp_path / "dop.tif", rng.integers(1, 255, (3, 640, 640), dtype=np.uint8), 0.2)
    dsm = _raster(tmp_path / "dsm.tif", rng.normal(100, 1, (1, 128, 128)).astype(np.float32), 1.0)
    pack = build_pack(dop, dsm, tmp_path / "pack", PackOptions(vertical="unknown"))
    rows = list(packs.measure_reads(pack, windows=3, size_px=(96, 64)))
    assert [row.level for row in rows] == [0, 1, 2, 3, 4]
    assert all(0 < row.warm_median_ms <= row.warm_p99_ms for row in rows)
    assert rows[0].cold_median_ms > rows[0].warm_median_ms
    built = packs.measure_build([dop], [dsm], tmp_path / "again", PackOptions(vertical="unknown"), 1)
    assert built.km2 == pytest.approx(0.128**2)
    assert built.km2_per_minute_per_core == built.km2_per_minute > 0
