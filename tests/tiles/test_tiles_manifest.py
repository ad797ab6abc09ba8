import json

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ortholoc_edge.errors import MapError
from ortholoc_edge.tiles.manifest import MANIFEST_NAME, read_manifest, write_manifest
from ortholoc_edge.tiles.pack import Pack


def edit(path, change):
    file = path / MANIFEST_NAME
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def test_round_trip(holed_pack, tmp_path):
    write_manifest(holed_pack.manifest, tmp_path / MANIFEST_NAME)
    assert read_manifest(tmp_path / MANIFEST_NAME) == holed_pack.manifest
    assert len(holed_pack.manifest.dop.crcs()) > 1


def test_pack_from_before_the_sigma_of_sea_level_opens(copied):
    assert Pack.open(copied).manifest.vertical.amsl_sigma_m == 1.0
    edit(copied, lambda m: m["vertical"].pop("amsl_sigma_m"))
    assert Pack.open(copied).manifest.vertical.amsl_sigma_m is None
    edit(copied, lambda m: m["vertical"].update(amsl_sigma_m=-1.0))
    with pytest.raises(MapError, match=r"vertical\.amsl_sigma_m"):
        Pack.open(copied)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.update(version=2), r"version 2 at \$\.version"),
        (lambda m: m.update(version="1"), r"\$\.version"),
        (lambda m: m.update(format="mbtiles"), r"\$\.format"),
        (lambda m: m.pop("format"), "format"),
        (lambda m: m.pop("anchor"), "anchor"),
        (lambda m: m["dsm"].pop("nodata"), r"nodata.*\$\.dsm"),
        (lambda m: m["dop"].update(colour="red"), r"colour.*\$\.dop"),
        (lambda m: m["dop"].update(file="../../etc/passwd"), r"\$\.dop\.file"),
        (lambda m: m["dop"].update(sha256="0"), r"\$\.dop\.sha256"),
        (lambda m: m["dop"]["grid"].update(width=0), r"\$\.dop\.grid\.width"),
        (lambda m: m["dop"]["grid"].update(dy=0), r"\$\.dop\.grid"),
        (lambda m: m["dop"].update(segment_crc32="?"), r"\$\.dop\.segment_crc32"),
        (lambda m: m["dop"].update(segment_crc32="AAAA"), r"\$\.dop\.segment_crc32"),
        (lambda m: m["vertical"].update(kind="baro"), r"\$\.vertical\.kind"),
        (lambda m: m.update(crs="EPSG:2225"), "US survey foot"),
    ],
)
def test_bad_manifests_name_the_key(copied, change, message):
    edit(copied, change)
    with pytest.raises(MapError, match=message):
        Pack.open(copied)


def test_missing_pack_says_how_to_build_one(tmp_path):
    with pytest.raises(MapError, match="tiles build"):
        Pack.open(tmp_path / "nothing")


def test_missing_and_truncated_files(copied):
    dsm = copied / "dsm.tif"
    dsm.write_bytes(dsm.read_bytes()[:-1])
    with pytest.raises(MapError, match=r"dsm\.tif.*bytes.*manifest"):
        Pack.open(copied)
    dsm.unlink()
    with pytest.raises(MapError, match=r"dsm\.tif.*No such file"):
        Pack.open(copied)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(data=st.one_of(st.binary(max_size=300), st.text(max_size=100).map(str.encode)))
def test_hostile_bytes_are_a_map_error(tmp_path, data):
    (tmp_path / MANIFEST_NAME).write_bytes(data)
    with pytest.raises(MapError, match=MANIFEST_NAME):
        read_manifest(tmp_path / MANIFEST_NAME)
