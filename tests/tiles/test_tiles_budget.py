"""Sizes foretold from samples, and settings that meet a budget."""

import cv2
import numpy as np
import pytest
from tile_rasters import DSM_GRID, RasterGrid, write_raster

from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.tiles.build import PackOptions, build_pack, preview_build

GRID = RasterGrid(1152, 1024, DSM_GRID.west, DSM_GRID.top, 0.25, -0.25)
CELLS = RasterGrid(288, 256, DSM_GRID.west, DSM_GRID.top, 1.0, -1.0)


def size(pack):
    return sum(path.stat().st_size for path in pack.path.rglob("*") if path.is_file())


def ground(shape, seed):
    """Texture of all sizes, smoother in one half."""
    rng = np.random.default_rng(seed)
    rows, columns = shape
    field = np.zeros(shape)
    for side in (4, 16, 64):
        coarse = rng.normal(size=(rows // side + 2, columns // side + 2))
        field += cv2.resize(coarse, (columns, rows), interpolation=cv2.INTER_CUBIC) * side**0.5
    field[:, : columns // 2] = cv2.GaussianBlur(field, (0, 0), 6)[:, : columns // 2]
    return field


@pytest.fixture(scope="module")
def textured_scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("textured")
    pixels = np.clip(120 + 9 * np.stack([ground((1024, 1152), k) for k in range(3)]), 1, 255).astype(np.uint8)
    heights = (300 + 0.3 * ground((256, 288), 9))[None].astype(np.float32)
    return write_raster(folder / "dop.tif", pixels, GRID), write_raster(folder / "dsm.tif", heights, CELLS)


def options(**changes):
    return PackOptions(**({"vertical": "unknown"} | changes))


@pytest.mark.parametrize("changes", [{}, {"quality": 95}, {"dop_compression": "jpeg"}, {"dop_gsd_m": 0.5}])
def test_estimate_is_near_the_size(textured_scene, tmp_path, changes):
    estimate = preview_build(*textured_scene, tmp_path / "pack", options(**changes)).estimate
    found = size(build_pack(*textured_scene, tmp_path / "pack", options(**changes)))
    assert abs(estimate.bytes - found) < max(0.15 * found, 2 * estimate.sigma_bytes)


def test_estimate_of_a_real_map(real_pack, tmp_path):
    built, sources = real_pack("copr")
    estimate = preview_build(*sources, tmp_path / "pack", options()).estimate
    found = size(built)
    assert abs(estimate.bytes - found) < max(0.15 * found, 2 * estimate.sigma_bytes)


@pytest.mark.parametrize("share", [0.8, 0.25])
def test_budget_is_met(textured_scene, tmp_path, share):
    whole = preview_build(*textured_scene, tmp_path / "pack", options()).estimate.bytes
    limit = int(share * whole)
    asked = options(max_size_bytes=limit)
    preview = preview_build(*textured_scene, tmp_path / "pack", asked)
    pack = build_pack(*textured_scene, tmp_path / "pack", asked)
    assert size(pack) <= limit
    # And not thrown away.
    assert size(pack) > 0.3 * limit
    assert pack.manifest.dop.gsd_m == preview.settings.dop_gsd_m == preview.plan.dop.lattice.pixel_m
    assert pack.manifest.dop.compression == f"WEBP quality {preview.settings.quality}"
    assert pack.manifest.dsm.max_z_error_m == preview.settings.max_z_error_m
    assert len(pack.manifest.dop.tiles) == len(preview.plan.dop.tiles)
    assert pack.manifest.dop.gsd_m > 0.25 or share > 0.25
    assert pack.verify() == []


def test_wide_budget_changes_nothing(textured_scene, tmp_path):
    free = preview_build(*textured_scene, tmp_path / "pack", options())
    held = preview_build(*textured_scene, tmp_path / "pack", options(max_size_bytes=10**9))
    assert held.settings == free.settings
    assert held.estimate == free.estimate


@pytest.mark.parametrize("action", ["build", "preview"])
def test_impossible_budget_is_refused_and_leaves_nothing(textured_scene, tmp_path, action):
    asked = options(max_size_bytes=5_000)
    with pytest.raises(ConfigError, match=r"--max-size 0.0 MB: even at the coarsest.*--area"):
        (build_pack if action == "build" else preview_build)(*textured_scene, tmp_path / "pack", asked)
    assert list(tmp_path.iterdir()) == []


def test_missed_budget_is_tried_again(textured_scene, tmp_path, monkeypatch):
    """The estimate was too low: the quality falls until the pack fits, and the heights are not done again."""
    from ortholoc_edge.tiles import build

    whole = size(build_pack(*textured_scene, tmp_path / "whole", options()))
    monkeypatch.setattr(
        build, "settings_within", lambda sampler, wanted, limit: (wanted, sampler.estimate(wanted))
    )
    pack = build_pack(*textured_scene, tmp_path / "pack", options(max_size_bytes=int(0.85 * whole)))
    assert size(pack) <= 0.85 * whole
    assert int(pack.manifest.dop.compression.split()[-1]) < 75
    with pytest.raises(MapError, match="more than --max-size allows"):
        build_pack(*textured_scene, tmp_path / "small", options(max_size_bytes=5_000))
    assert not (tmp_path / "small").exists()


def test_dry_run_leaves_nothing_and_spares_a_build_s_work(textured_scene, tmp_path):
    preview_build(*textured_scene, tmp_path / "new" / "pack", options())
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ZeroDivisionError):
        build_pack(*textured_scene, tmp_path / "pack", options(), lambda done, what: 1 / (done < 0.9))
    work = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    assert any(path.suffix == ".record" for path in work)
    preview_build(*textured_scene, tmp_path / "pack", options())
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == work
