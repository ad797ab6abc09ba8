"""``tiles info`` and ``tiles verify`` on packs of arrays."""

import argparse
import json

import msgspec
import numpy as np
import packs
import pytest

from ortholoc_edge.cli import tiles_inspect
from ortholoc_edge.errors import MapError
from ortholoc_edge.tiles.georeference import VerticalDatum
from ortholoc_edge.tiles.manifest import (
    MANIFEST_NAME,
    SIGNATURE_NAME,
    Alignment,
    FeatureLayer,
    FeatureTile,
    SourceNote,
    write_manifest,
)


def run(*arguments):
    parser = argparse.ArgumentParser()
    tiles_inspect.add_parser(parser.add_subparsers())
    args = parser.parse_args([*map(str, arguments)])
    return args.run(args)


@pytest.fixture
def pack(tmp_path):
    """2 x 2 km2 of nothing in particular: DOP of 4 m, of which a quarter has no data, DSM of 8 m."""
    heights = np.full((128, 128), 300.0, dtype=np.float32)
    heights[:64, :64] = np.nan
    heights[100, 100] = 417.25
    valid = np.ones((256, 256), dtype=bool)
    valid[:128, :128] = False
    change = {"pixel_m": 4.0, "tile_px": 128}
    pack = packs.write_pack(
        tmp_path / "pack",
        np.zeros((3, 256, 256), dtype=np.uint8),
        heights,
        valid=valid,
        dop_lattice=msgspec.structs.replace(packs.DOP_LATTICE, **change),
        dsm_lattice=msgspec.structs.replace(packs.DSM_LATTICE, pixel_m=8.0, tile_px=64),
        dop_corner=(0, 0),
        dsm_corner=(0, 0),
        offsets={(0, 0): (-0.5, 46.0), (1, 1): (-0.25, 46.0)},
        vertical=VerticalDatum(
            kind="orthometric", name="DHHN2016 height", epsg=7837, amsl_minus_map_m=-0.4, amsl_sigma_m=0.1
        ),
        files={"reports/coverage.geojson": b"{}"},
    )
    manifest = pack.manifest
    first = manifest.dop.tiles[0]
    dop = msgspec.structs.replace(
        manifest.dop,
        tiles=[msgspec.structs.replace(first, matchability=0.5), *manifest.dop.tiles[1:]],
        sources=[
            SourceNote(name="new.tif", date="2024-05-01"),
            SourceNote(name="old.tif", date="2019"),
            SourceNote(name="a.tif"),
            SourceNote(name="b.tif"),
        ],
        true_ortho=False,
        attribution="© Survey",
        licence="dl-de/by-2-0",
    )
    features = FeatureLayer(
        matcher="xfeat", model_sha256="ab" * 32, encoding="int8x64", per_mpx=500.0,
        tiles=[
            FeatureTile(
                **packs.contents_note(b"features"), file="features/1.npy", dop=0, dop_sha256=first.sha256, counts=(7, 3)
            )
        ],
    )  # fmt: skip
    (pack.path / "features").mkdir()
    (pack.path / "features/1.npy").write_bytes(b"features")
    write_manifest(
        msgspec.structs.replace(
            manifest,
            dop=dop,
            features=features,
            alignment=Alignment(east_m=0.3, north_m=-0.1, sigma_m=0.05, samples=40),
        ),
        pack.path / MANIFEST_NAME,
    )
    return pack.path


def test_facts_as_json(pack, capsys):
    assert run("info", pack, "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["format"] == 3
    assert facts["crs"] == "EPSG:32633"
    assert facts["extent_m"] == {"west": 400_000.0, "south": 5_298_976.0, "east": 401_024.0, "north": 5_300_000.0}
    assert facts["extent_deg"]["west"] < facts["centre"]["longitude_deg"] < facts["extent_deg"]["east"]
    assert facts["extent_deg"]["south"] < facts["centre"]["latitude_deg"] < facts["extent_deg"]["north"]
    assert facts["centre"]["convergence_deg"] == pytest.approx(-0.99, abs=0.05)
    # Area is that with data, not the box.
    assert facts["area_km2"] == pytest.approx(0.75 * 1.024**2, abs=1e-6)
    rasters = sum(path.stat().st_size for path in pack.glob("d*/*.tif"))
    assert facts["mb_per_km2"]["without_features"] == pytest.approx(rasters / 1e6 / facts["area_km2"], abs=1e-4)
    assert facts["mb_per_km2"]["with_features"] == pytest.approx((rasters + 8) / 1e6 / facts["area_km2"], abs=1e-4)
    assert facts["memory_bytes"] == rasters + 8
    assert facts["bytes"] == rasters + 8 + 2
    assert facts["vertical"]["by_tile"] == {"amsl_minus_map_m": [-0.5, -0.25], "ellipsoid_minus_map_m": [46.0, 46.0]}
    assert facts["dop"]["source_dates"] == ["2019", "2024-05-01"]
    assert (facts["dop"]["tiles"], facts["dop"]["matchability"], facts["dop"]["true_ortho"]) == (4, 0.5, False)
    assert facts["dop"]["levels_m"] == [4.0, 8.0, 16.0, 32.0, 64.0]
    # The tile without heights has no range of them.
    assert facts["dsm"]["height_m"] == [300.0, 417.25]
    assert facts["features"]["count"] == 10
    assert facts["alignment"]["east_m"] == 0.3
    assert facts["signature"] is False
    assert facts["missing"] == []


def test_facts_as_a_table(pack, capsys):
    (pack / SIGNATURE_NAME).write_bytes(bytes(64))
    (pack / "reports/coverage.geojson").unlink()
    assert run("info", pack) == 0
    table = capsys.readouterr().out
    for text in (
        "format 3", "not dated", "EPSG:32633", "0.7864 km2", "DHHN2016 height",
        "by tile -0.50 to -0.25 m", "1 sigma 0.1 m",
        "4 m/px, 5 levels to 64 m/px", "4 of up to 128 px, 512 m", "75.0 % of the tiles", "© Survey", "dl-de/by-2-0",
        "2019 to 2024-05-01", "new.tif, old.tif, a.tif and 1 more", "300.00 to 417.25 m", "50 of 100 on average",
        "10 for xfeat, int8x64", "+0.30 m east, -0.10 m north", "present, not checked", "MISSING", "coverage.geojson",
    ):  # fmt: skip
        assert text in table, text


def test_local_pack_has_no_degrees(tmp_path, capsys):
    small = np.zeros((3, 64, 64), dtype=np.uint8), np.zeros((64, 64), dtype=np.float32)
    pack = packs.write_pack(tmp_path / "pack", *small, crs=None)
    assert run("info", pack.path) == 0
    assert "none, local metres" in capsys.readouterr().out
    assert run("info", pack.path, "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["centre"] is None
    assert facts["extent_deg"] is None


def test_verify_tells_what_is_wrong(pack, capsys):
    assert run("verify", pack) == 0
    told = capsys.readouterr()
    assert "sound, 10 files" in told.out
    assert "signed" not in told.out
    tile = next((pack / "dsm").iterdir())
    tile.write_bytes(tile.read_bytes()[:-1])
    (pack / "stray.txt").write_text("")
    assert run("verify", pack) == 1
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2
    assert tile.name in lines[0]
    assert "stray.txt" in lines[1]


def test_verify_wants_the_signature_where_a_key_is_named(pack, tmp_path):
    from ortholoc_edge.tiles.signature import generate, sign

    private, public = generate(tmp_path / "key")
    with pytest.raises(MapError, match=SIGNATURE_NAME):
        run("verify", pack, "--public-key", public)
    sign(pack, private)
    assert run("verify", pack, "--public-key", public) == 0
