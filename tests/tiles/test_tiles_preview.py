"""The preview: hills are hills, panels show what they say, and the command writes a PNG."""

from __future__ import annotations

import argparse

import cv2
import numpy as np
import pytest
from lattice_tiles import write_pack

from ortholoc_edge.cli import tiles_preview
from ortholoc_edge.errors import ConfigError
from ortholoc_edge.tiles.coverage import cell_share
from ortholoc_edge.tiles.matchability import matchability_tif
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.preview import preview, shaded

COMPLETE, DOP_ONLY = (42, 157, 92), (224, 160, 32)


def hill(side=101):
    rows, columns = np.mgrid[:side, :side] - side // 2
    return (20.0 * np.exp(-(rows**2 + columns**2) / 400.0)).astype(np.float32)


def test_a_hill_is_bright_to_the_north_west_and_dark_to_the_south_east():
    picture = shaded(hill(), 1.0).astype(float).mean(axis=2)
    north_west, south_east = picture[36, 36], picture[64, 64]
    assert north_west > 1.3 * south_east
    # A pit is the other way round.
    pit = shaded(-hill(), 1.0).astype(float).mean(axis=2)
    assert pit[36, 36] < pit[64, 64]


def test_a_hole_is_grey_without_a_cliff_around_it():
    heights = np.zeros((60, 60), dtype=np.float32) + 100.0
    heights[20:40, 20:40] = np.nan
    picture = shaded(heights, 1.0)
    outside = picture[~np.isnan(heights)]
    assert (outside == outside[0]).all()
    assert len(np.unique(picture[20:40, 20:40].reshape(-1, 3), axis=0)) == 1
    assert (shaded(np.full((4, 4), np.nan, dtype=np.float32), 1.0) == shaded(heights, 1.0)[25, 25]).all()


def pack_at(folder):
    written = write_pack(folder)
    cells = [np.full((tile.height // 64, tile.width // 64), 90, dtype=np.uint8) for tile in written.manifest.dop.tiles]
    (folder / "reports").mkdir()
    report = matchability_tif(written.manifest, cells, [cell_share(np.isfinite(written.heights))])
    (folder / "reports" / "matchability.tif").write_bytes(report)
    return Pack.open(folder)


def colours_near(picture, colour, reach=60):
    return int((np.abs(picture.astype(int) - colour).max(axis=2) < reach).sum())


def test_the_picture_shows_what_the_pack_holds(tmp_path):
    pack = pack_at(tmp_path / "pack")
    picture = preview(pack, 800)
    assert picture.dtype == np.uint8
    assert max(picture.shape[:2]) <= 800
    middle = picture.shape[0] // 2, picture.shape[1] // 2
    coverage = picture[middle[0] :, : middle[1]]
    assert colours_near(coverage, COMPLETE) > 1000
    # The surface model has a hole under the orthophoto.
    assert colours_near(coverage, DOP_ONLY, 40) > 20
    np.testing.assert_array_equal(picture, preview(pack, 800))
    with pytest.raises(ValueError, match="at least 600"):
        preview(pack, 100)


def test_a_pack_without_the_report_has_an_empty_panel(tmp_path):
    pack = pack_at(tmp_path / "pack")
    with_report = preview(pack, 700)
    (pack.path / "reports" / "matchability.tif").unlink()
    without = preview(pack, 700)
    assert without.shape == with_report.shape
    half = without.shape[1] // 2
    rows = without.shape[0] // 2
    np.testing.assert_array_equal(without[:rows], with_report[:rows])
    assert (without[rows:, half:] != with_report[rows:, half:]).any()


def command(*arguments):
    parser = argparse.ArgumentParser()
    tiles_preview.add_parser(parser.add_subparsers(required=True))
    args = parser.parse_args(["preview", *map(str, arguments)])
    return args.run(args)


def test_the_command_writes_a_png_beside_the_pack(tmp_path, capsys):
    pack_at(tmp_path / "pack")
    assert command(tmp_path / "pack", "--size", "600") == 0
    picture = cv2.imread(str(tmp_path / "pack.png"))
    assert f"{picture.shape[1]} x {picture.shape[0]} px" in capsys.readouterr().out
    with pytest.raises(ConfigError, match="inside the pack"):
        command(tmp_path / "pack", "--out", tmp_path / "pack" / "a.png")
    with pytest.raises(ConfigError, match="cannot be written"):
        command(tmp_path / "pack", "--out", tmp_path / "nowhere" / "a.png")
    with pytest.raises(SystemExit):
        command(tmp_path / "pack", "--size", "10")
