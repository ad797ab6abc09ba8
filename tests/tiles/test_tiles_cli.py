import argparse
import json
import re

import pytest
from tile_rasters import contents

from ortholoc_edge.cli import tiles
from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.tiles.pack import Pack


def run(*arguments):
    parser = argparse.ArgumentParser()
    tiles.add_parser(parser.add_subparsers())
    args = parser.parse_args(["tiles", *map(str, arguments)])
    return args.run(args)


def build(scene, out, *more):
    vertical = () if "--vertical" in more else ("--vertical", "unknown")
    return run("build", "--dop", scene[0], "--dsm", scene[1], "--out", out, "--jobs", 1, *vertical, *more)


def test_build_info_verify(scene, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    out = tmp_path / "pack"
    assert build(scene, out, "--attribution", "© Survey", "--dop-date", "2023-06", "--no-true-ortho") == 0
    printed = capsys.readouterr()
    assert "EPSG:32633" in printed.out
    assert "© Survey" in printed.out
    assert "--geoid-undulation-m" in printed.err
    assert "left" in printed.err, "a bar with the time that is left"

    assert run("info", out) == 0
    table = capsys.readouterr().out
    for text in ("2023-11-14T22:13:20Z", "WEBP quality 85", "0.01 m by compression", "2023-06", "5 levels"):
        assert text in table
    assert run("verify", out) == 0
    assert "sound" in capsys.readouterr().out
    [tile] = (out / "dsm").iterdir()
    data = bytearray(tile.read_bytes())
    data[-30] ^= 1
    tile.write_bytes(data)
    assert run("verify", out) == 1
    assert tile.name in capsys.readouterr().out


def test_dry_run_prints_the_estimate_and_stops(wide_scene, tmp_path, capsys):
    out = tmp_path / "new" / "pack"
    assert build(wide_scene, out, "--dry-run") == 0
    table = capsys.readouterr().out
    assert re.search(r"in all +about 0\.\d+ MB, give or take 0\.\d+", table)
    assert "4 + 2 tiles" in table
    assert build(wide_scene, out, "--dry-run", "--json", "--dop-gsd", "4") == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["crs"] == "EPSG:32633"
    assert facts["dop"]["gsd_m"] == 4.0
    assert facts["dop"]["sources"] == facts["dop"]["resampled"] == 1
    assert facts["dsm"]["resampled"] == 0
    assert 0 < facts["megabytes_sigma"] < facts["megabytes"] < 1
    assert build(wide_scene, out, "--dry-run", "--json", "--max-size", "150kB") == 0
    held = json.loads(capsys.readouterr().out)
    assert held["megabytes"] <= 0.15
    assert list(tmp_path.iterdir()) == []


def test_built_pack_as_json_inside_an_area(wide_scene, tmp_path, capsys):
    area = "400950,5299100,402000,5299850"
    assert build(wide_scene, tmp_path / "pack", "--json", "--area", area, "--jobs", 2) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["crs"] == "EPSG:32633"
    assert Pack.open(tmp_path / "pack").verify() == []


def test_errors_are_of_the_package(scene, tmp_path, monkeypatch):
    build(scene, tmp_path / "pack", "--vertical", "ellipsoid", "--geoid-undulation-m", "46.5")
    with pytest.raises(MapError, match="--force"):
        build(scene, tmp_path / "pack")
    other = tmp_path / "other"
    with pytest.raises(ConfigError, match="quality"):
        build(scene, other, "--quality", "101")
    with pytest.raises(ConfigError, match="--jobs 0"):
        build(scene, other, "--jobs", "0")
    with pytest.raises(ConfigError, match=r"--corridor 50: goes along a route; name one with --area"):
        build(scene, other, "--corridor", "50")
    with pytest.raises(ConfigError, match="--vertical orthometric"):
        run("build", "--dop", scene[0], "--dsm", scene[1], "--out", other)
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "yesterday")
    with pytest.raises(ConfigError, match="SOURCE_DATE_EPOCH"):
        build(scene, other)
    assert not other.exists()


def test_signed_before_it_has_its_name(scene, tmp_path):
    """A key that cannot be used leaves the old pack, signed or not, where it is."""
    out = tmp_path / "pack"
    build(scene, out)
    before = contents(out)
    (tmp_path / "key.pem").write_text("no key")
    pytest.importorskip("cryptography")
    with pytest.raises(ConfigError, match=r"key\.pem"):
        build(scene, out, "--force", "--quality", "50", "--sign", tmp_path / "key.pem")
    assert contents(out) == before


@pytest.mark.parametrize(
    ("text", "size"),
    [("400MB", 400_000_000), ("2g", 2_000_000_000), ("1.5 KiB", 1536), ("123", 123), ("2GiB", 2**31)],
)
def test_sizes(text, size):
    assert tiles.tiles_build._bytes(text) == size


@pytest.mark.parametrize("text", ["", "MB", "-5MB", "4 apples", "1e9", "nan"])
def test_what_is_no_size(text, wide_scene, tmp_path, capsys):
    with pytest.raises(SystemExit):
        build(wide_scene, tmp_path / "pack", f"--max-size={text}")
    assert "is no size" in capsys.readouterr().err


@pytest.mark.parametrize("action", ["build", "info", "verify"])
def test_help_names_defaults(action, capsys):
    with pytest.raises(SystemExit) as stop:
        run(action, "--help")
    assert stop.value.code == 0
    assert "default" in capsys.readouterr().out or action == "verify"
