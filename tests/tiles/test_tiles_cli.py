import argparse
import json

import pytest

from ortholoc_edge.cli import tiles
from ortholoc_edge.errors import ConfigError, MapError


def run(*arguments):
    parser = argparse.ArgumentParser()
    tiles.add_parser(parser.add_subparsers())
    args = parser.parse_args(["tiles", *map(str, arguments)])
    return args.run(args)


def build(scene, out, *more):
    return run("build", "--dop", scene[0], "--dsm", scene[1], "--out", out, *more)


def test_build_info_verify(scene, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    out = tmp_path / "pack"
    assert build(scene, out, "--attribution", "© Survey", "--dop-date", "2023-06", "--no-true-ortho") == 0
    printed = capsys.readouterr()
    assert "EPSG:32633" in printed.out
    assert "© Survey" in printed.out
    assert "--geoid-undulation-m" in printed.err

    assert run("info", out) == 0
    table = capsys.readouterr().out
    for text in ("2023-11-14T22:13:20Z", "WEBP quality 85", "0.01 m by compression", "2023-06", "3 levels"):
        assert text in table
    assert run("info", out, "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["crs"] == "EPSG:32633"
    assert facts["area_km2"] == pytest.approx(147.5 * 130.7 / 1e6)
    assert facts["dop"]["true_ortho"] is False
    assert facts["centre"]["convergence_deg"] == pytest.approx(-1.0, abs=0.05)
    assert facts["vertical"]["kind"] == "unknown"
    assert facts["dsm"]["coverage_percent"] == 100.0

    assert run("verify", out) == 0
    assert "sound" in capsys.readouterr().out
    data = bytearray((out / "dsm.tif").read_bytes())
    data[-30] ^= 1
    (out / "dsm.tif").write_bytes(data)
    assert run("verify", out) == 1
    assert "dsm.tif" in capsys.readouterr().out


def test_local_pack_is_described(tmp_path, real_pack, capsys):
    pack, _ = real_pack("demo")
    assert run("info", pack.path) == 0
    assert "none, local metres" in capsys.readouterr().out


def test_errors_are_of_the_package(scene, tmp_path, monkeypatch):
    build(scene, tmp_path / "pack", "--vertical", "ellipsoid", "--geoid-undulation-m", "46.5")
    with pytest.raises(MapError, match="--force"):
        build(scene, tmp_path / "pack")
    with pytest.raises(ConfigError, match="quality"):
        build(scene, tmp_path / "other", "--quality", "101")
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "yesterday")
    with pytest.raises(ConfigError, match="SOURCE_DATE_EPOCH"):
        build(scene, tmp_path / "other")


@pytest.mark.parametrize("action", ["build", "info", "verify"])
def test_help_names_defaults(action, capsys):
    with pytest.raises(SystemExit) as stop:
        run(action, "--help")
    assert stop.value.code == 0
    assert "default" in capsys.readouterr().out or action == "verify"
