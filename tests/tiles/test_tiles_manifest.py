"""Manifests and whole packs: what is wrong is named; nothing but a MapError, and no wrong height, comes of it."""

import json
import random
import re
import shutil
import warnings

import msgspec
import numpy as np
import packs
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ortholoc_edge.errors import MapError
from ortholoc_edge.tiles.cog import PixelWindow
from ortholoc_edge.tiles.lattice import Lattice
from ortholoc_edge.tiles.manifest import (
    MANIFEST_NAME,
    SIGNATURE_NAME,
    Tile,
    layer_bounds,
    read_manifest,
    valid_fraction,
    write_manifest,
)
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

# rasterio decodes GDAL's messages as UTF-8 and fails, without consequence, where they quote a broken file.
GDAL_QUOTES_GARBAGE = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
SMALL = {
    "dop_lattice": Lattice(west=400_000.0, top=5_300_000.0, pixel_m=0.5, tile_px=64, levels=5),
    "dsm_lattice": Lattice(west=400_000.0, top=5_300_000.0, pixel_m=1.0, tile_px=64, levels=5),
    "dop_corner": (0, 0),
    "dsm_corner": (0, 0),
    "max_z_error_m": 0.0,
}


@pytest.fixture(scope="module")
def pack(tmp_path_factory):
    """Two tiles of the DOP on one of the DSM, and a report: small enough to be spoiled some hundred times."""
    rng = np.random.default_rng(3)
    rgb = rng.integers(0, 256, (3, 64, 128), dtype=np.uint8)
    heights = rng.uniform(100, 200, (64, 64)).astype(np.float32)
    heights[10:20, 30:50] = np.nan
    folder = tmp_path_factory.mktemp("small") / "pack"
    return packs.write_pack(folder, rgb, heights, files={"reports/coverage.geojson": b"{}"}, **SMALL)


@pytest.fixture(scope="module")
def truth(pack):
    with MapStore(pack) as store:
        return shown(store)


@pytest.fixture
def copied(pack, tmp_path):
    return shutil.copytree(pack.path, tmp_path / "pack")


def shown(store):
    """By level: DOP, validity, heights of all tiles."""
    found = []
    for dop, dsm in zip(store.dop_grids, store.dsm_grids, strict=True):
        rgb, valid = store._dop.read_rgb(len(found), PixelWindow(0, 0, dop.width, dop.height))
        found.append((rgb, valid, store._dsm.read_heights(len(found), PixelWindow(0, 0, dsm.width, dsm.height))))
    return found


def edit(path, change):
    file = path / MANIFEST_NAME
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def test_round_trip(pack, tmp_path):
    write_manifest(pack.manifest, tmp_path / MANIFEST_NAME)
    manifest = read_manifest(tmp_path / MANIFEST_NAME)
    assert manifest == pack.manifest
    assert all(len(tile.crcs()) == 4 for tile in (*manifest.dop.tiles, *manifest.dsm.tiles))  # head and 3 levels
    assert layer_bounds(manifest.dsm) == (400_000.0, 5_299_936.0, 400_064.0, 5_300_000.0)
    assert layer_bounds(manifest.dop) == (400_000.0, 5_299_968.0, 400_064.0, 5_300_000.0)
    assert valid_fraction(manifest.dsm) == pytest.approx(1 - 200 / 4096)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.update(version=1), r"version 1 at \$\.version.*rebuild the pack"),
        (lambda m: m.update(version=4), r"version 4 at \$\.version"),
        (lambda m: m.update(version="2"), r"\$\.version"),
        (lambda m: m.update(format="mbtiles"), r"\$\.format"),
        (lambda m: m.pop("format"), "format"),
        (lambda m: m.pop("anchor"), "anchor"),
        (lambda m: m.update(anchor=[1e12, 1e12]), "outside the domain|not conformal|no way"),
        (lambda m: m["dsm"].pop("nodata"), r"nodata.*\$\.dsm"),
        (lambda m: m["dop"].update(colour="red"), r"colour.*\$\.dop"),
        (lambda m: m["dop"].update(tiles=[]), r"\$\.dop\.tiles"),
        (lambda m: m["dop"]["tiles"][1].update(file="../../etc/passwd"), r"\$\.dop\.tiles\[1\]\.file"),
        (lambda m: m["dop"]["tiles"][1].update(file=m["dop"]["tiles"][0]["file"]), "names a file twice"),
        (lambda m: m["dop"]["tiles"][1].update(file=MANIFEST_NAME), MANIFEST_NAME),
        (lambda m: m["dop"]["tiles"][1].update(sha256="0"), r"\$\.dop\.tiles\[1\]\.sha256"),
        (lambda m: m["dop"]["tiles"][1].update(width=100), r"\$\.dop\.tiles\[1\]\.width"),
        (lambda m: m["dop"]["tiles"][1].update(width=128), r"\$\.dop\.tiles\[1\].*crosses"),
        (lambda m: m["dop"]["tiles"][1].update(column=0), r"\$\.dop\.tiles\[1\].*second tile"),
        (lambda m: m["dop"]["tiles"][1].update(segment_crc32="?"), r"\$\.dop\.tiles\[1\]\.segment_crc32"),
        (lambda m: m["dop"]["tiles"][1].update(segment_crc32="AAA="), r"\$\.dop\.tiles\[1\]\.segment_crc32"),
        (lambda m: m["dop"]["tiles"][1].update(sources=[7]), r"\$\.dop\.tiles\[1\]\.sources"),
        (lambda m: m["dop"]["lattice"].update(pixel_m=0), r"\$\.dop\.lattice\.pixel_m"),
        (lambda m: m["dop"]["lattice"].update(pixel_m=1e-200), "pixels of 1e-200 m"),
        (lambda m: m["dop"].update(stored_levels=[]), r"\$\.dop\.stored_levels"),
        (lambda m: m["dop"].update(stored_levels=[1, 2]), r"\$\.dop\.stored_levels.*of the 5 levels"),
        (lambda m: m["dsm"].update(stored_levels=[0, 4, 2]), r"\$\.dsm\.stored_levels.*of the 5 levels"),
        (lambda m: m["dsm"].update(stored_levels=[0, 2, 5]), r"\$\.dsm\.stored_levels.*of the 5 levels"),
        (lambda m: m["dsm"].update(stored_levels=[0, 2, 2]), r"\$\.dsm\.stored_levels.*of the 5 levels"),
        (lambda m: m["dsm"]["lattice"].update(levels=4), r"\$\.dsm\.stored_levels.*of the 4 levels"),
        (lambda m: m["dsm"]["lattice"].update(tile_px=100), r"\$\.dsm\.lattice\.tile_px"),
        (lambda m: m["vertical"].update(kind="baro"), r"\$\.vertical\.kind"),
        (lambda m: m["vertical"].update(amsl_sigma_m=-1.0), r"vertical\.amsl_sigma_m"),
        (lambda m: m.update(crs="EPSG:2225"), "US survey foot"),
        (lambda m: m.update(crs="EPSG:4326"), "geographic"),
    ],
)
def test_bad_manifests_name_the_key(copied, change, message):
    edit(copied, change)
    with pytest.raises(MapError, match=message):
        Pack.open(copied)


def test_missing_pack_says_how_to_build_one(tmp_path):
    with pytest.raises(MapError, match="tiles build"):
        Pack.open(tmp_path / "nothing")


# -- verify --------------------------------------------------------------------------------------------


def test_sound_pack_verifies(copied):
    told = []
    pack = Pack.open(copied)
    assert pack.verify(lambda *step: told.append(step)) == []
    assert told[0] == (pack.manifest.dop.tiles[0].file, 0, 4)
    assert told[-1] == ("", 4, 4)
    files = [path for path in copied.rglob("*.*") if path.name != MANIFEST_NAME]
    assert pack.total_bytes == sum(path.stat().st_size for path in files)
    (copied / SIGNATURE_NAME).write_bytes(bytes(64))
    assert Pack.open(copied).verify() == []


def test_local_pack_verifies(tmp_path):
    rng = np.random.default_rng(3)
    rgb = rng.integers(0, 256, (3, 128, 128), dtype=np.uint8)
    pack = packs.write_pack(tmp_path, rgb, np.zeros((64, 64), dtype=np.float32), crs=None, **SMALL)
    assert pack.verify() == []


def spoil(path, at=-1):
    data = bytearray(path.read_bytes())
    data[at] ^= 0x10
    path.write_bytes(data)


def listed(pack, kind, index=0):
    return getattr(pack.manifest, kind).tiles[index].file


def restate(folder, index, **fields):
    edit(folder, lambda m: m["dop"]["tiles"][index].update(**fields))


@pytest.mark.parametrize(
    ("fault", "problems"),
    [
        (lambda f, p: (f / listed(p, "dop")).unlink(), [r"dop/\S+: No such file"]),
        (lambda f, p: spoil(f / listed(p, "dsm")), [r"dsm/\S+: SHA-256 differs", r"level 0 differs from the build"]),
        (lambda f, p: spoil(f / listed(p, "dsm"), 5), [r"dsm/\S+: SHA-256 differs", r"dsm/\S+.*(head|opened|read)"]),
        (lambda f, p: spoil(f / "reports/coverage.geojson"), [r"reports/coverage.geojson: SHA-256 differs"]),
        (lambda f, p: (f / "dop/more.tif").write_bytes(b""), [r"dop/more.tif: not listed"]),
        (lambda f, p: (f / ".hidden").write_bytes(b""), [r"\.hidden: not listed"]),
        (lambda f, p: (f / "link").symlink_to("/nowhere"), ["link: not listed"]),
        (lambda f, p: restate(f, 1, segment_crc32=p.manifest.dop.tiles[0].segment_crc32), ["segment_crc32"]),
        (lambda f, p: edit(f, lambda m: m.update(crs="EPSG:32632", anchor=[400_030, 5_299_960])), ["32633"] * 3),
        (lambda f, p: edit(f, lambda m: m["dsm"].update(nodata=-1.0)), [r"dsm/\S+: nodata -9999"]),
        (
            lambda f, p: edit(f, lambda m: m["dsm"]["lattice"].update(west=399_999.0)),
            [r"dsm/\S+: levels \[0, 2, 4\] of .*399999"],
        ),
        (
            lambda f, p: edit(f, lambda m: m["dop"].pop("stored_levels")),
            [r"levels \[0, 2, 4\] of.*expected \[0, 1, 2, 3, 4\]"] * 2,
        ),
    ],
)  # fmt: skip
def test_every_fault_is_named(copied, pack, fault, problems):
    fault(copied, pack)
    found = Pack.open(copied).verify()
    assert len(found) == len(problems), found
    for problem, pattern in zip(found, problems, strict=True):
        assert re.search(pattern, problem), problem


def test_every_flipped_byte_is_seen(copied, pack):
    """Head, block, mask, gaps: each byte of the file belongs to one segment."""
    opened = Pack.open(copied)
    for kind in ("dop", "dsm"):
        file = copied / listed(pack, kind)
        whole = file.read_bytes()
        for at in np.linspace(0, len(whole) - 1, 20).astype(int):
            spoil(file, at)
            assert opened.verify(), f"byte {at}"
            file.write_bytes(whole)
    assert opened.verify() == []


# -- hostile input -------------------------------------------------------------------------------------


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60, deadline=None)
@given(data=st.one_of(st.binary(max_size=300), st.text(max_size=100).map(str.encode)))
def test_hostile_bytes_are_a_map_error(tmp_path, data):
    (tmp_path / MANIFEST_NAME).write_bytes(data)
    with pytest.raises(MapError, match=MANIFEST_NAME):
        read_manifest(tmp_path / MANIFEST_NAME)


def mutated(raw, rng):
    """A manifest cut short, with flipped bits, or with a value or a key that is another one."""
    kind = rng.randrange(6)
    if kind == 0:
        return raw[: rng.randrange(len(raw))]
    if kind == 1:
        data = bytearray(raw)
        for _ in range(rng.randrange(1, 4)):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        return bytes(data)
    content = json.loads(raw)
    place, key = content, None
    while isinstance(place, dict | list) and place and (key is None or rng.random() < 0.97):
        holder, key = place, rng.choice(list(place) if isinstance(place, dict) else range(len(place)))
        place = holder[key]
    if kind == 2:
        holder[key] = rng.choice(
            [None, True, "", "x", -1, 0, 1, 64, 2**31, 2**63, 10**30, -0.5, 1e-300, 1e300, [], {}, [0, 0], "EPSG:4326"]
        )
    elif kind > 3 and isinstance(place, int | float):
        # A value that the types allow.
        holder[key] = type(place)(rng.choice([2 * place, place / 2, place + 64, place + 1, -place, 0]))
    else:
        old = holder.pop(key)
        if isinstance(holder, dict):
            holder[rng.choice(["file", "column", "nodata", "levels", "stored_levels", "width", "zzz"])] = old
    return json.dumps(content).encode()


def assert_harmless(folder, truth):
    """A pack that was tampered with opens or is refused; what it shows is what was built. Returns: whether opened."""
    try:
        pack = Pack.open(folder)
        with MapStore(pack, memory_bytes=2**24) as store:
            try:
                bounds, gsd_m = store.bounds, store.dop_grids[0].gsd_m
                middle = ((bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2)
                store.heights([middle])
                store.ground_near(middle)
                store.read(bounds, gsd_m)
            except MapError as err:
                assert "exceeds" in str(err)
                return True
            if store.dop_grids == truth[0] and store.dsm_grids == truth[1]:
                for (rgb, valid, heights), (all_rgb, _, all_heights) in zip(shown(store), truth[2], strict=True):
                    assert np.array_equal(rgb[valid], all_rgb[valid])
                    known = np.isfinite(heights)
                    assert np.array_equal(heights[known], all_heights[known])
            else:
                window = store.read(store.bounds, store.dop_grids[0].gsd_m)
                # On other pixels than were built: every tile is refused.
                if window is not None and store.dsm_grids[0].dx != truth[1][0].dx:
                    assert not np.isfinite(window.dsm).any()
    except MapError:
        return False
    return True


@pytest.fixture(scope="module")
def built(pack, truth):
    with MapStore(pack) as store:
        return store.dop_grids, store.dsm_grids, truth


def test_tampered_manifests_are_harmless(copied, built):
    rng = random.Random(11)
    file = copied / MANIFEST_NAME
    raw = file.read_bytes()
    opened = 0
    for _ in range(400):
        file.write_bytes(mutated(raw, rng))
        opened += assert_harmless(copied, built)
    assert 20 < opened < 380


@GDAL_QUOTES_GARBAGE
def test_tampered_packs_can_be_verified(copied, pack):
    rng = random.Random(13)
    files = [copied / MANIFEST_NAME, *(copied / note.file for note in pack.manifest.notes())]
    for _ in range(40):
        file = rng.choice(files)
        whole = file.read_bytes()
        file.write_bytes(garbage(whole, rng))
        try:
            problems = Pack.open(copied).verify()
        except MapError as err:
            problems = [str(err)]
        assert any(file.name in problem for problem in problems) or file.read_bytes() == whole
        file.write_bytes(whole)


def garbage(data, rng):
    kind = rng.randrange(6)
    if kind == 0:
        return data[: rng.randrange(len(data))]
    if kind == 1:
        return rng.randbytes(len(data))
    if kind == 2:
        return b"\x89PNG\r\n\x1a\n" + data[8:]
    if kind == 3:
        start = rng.randrange(len(data))
        return data[:start] + bytes(min(64, len(data) - start)) + data[start + 64 :]
    spoiled = bytearray(data)
    # The head of such a file is its first kilobyte.
    reach = min(1200, len(data)) if kind == 4 else len(data)
    for _ in range(rng.randrange(1, 6)):
        spoiled[rng.randrange(reach)] ^= 1 << rng.randrange(8)
    return bytes(spoiled)


@GDAL_QUOTES_GARBAGE
@pytest.mark.parametrize("restated", [False, True], ids=["hash differs", "hash says it is right"])
def test_tampered_tiles_are_harmless(copied, pack, built, restated):
    """Also where the manifest vouches for the file: then its heights cannot be judged, but nothing else breaks."""
    rng = random.Random(12)
    tiles: list[Tile] = [*pack.manifest.dop.tiles, *pack.manifest.dsm.tiles]
    whole = {tile.file: (copied / tile.file).read_bytes() for tile in tiles}
    manifest = (copied / MANIFEST_NAME).read_bytes()
    opened = 0
    for _ in range(80):
        tile = rng.choice(tiles)
        data = garbage(whole[tile.file], rng)
        (copied / tile.file).write_bytes(data)
        if restated:
            kind = "dop" if tile in pack.manifest.dop.tiles else "dsm"
            write_manifest(_vouched(pack.manifest, kind, tile, data), copied / MANIFEST_NAME)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                opened += assert_readable(copied)
        else:
            opened += assert_harmless(copied, built)
        (copied / tile.file).write_bytes(whole[tile.file])
    (copied / MANIFEST_NAME).write_bytes(manifest)
    assert opened > 40


def assert_readable(folder):
    try:
        with MapStore(Pack.open(folder)) as store:
            shown(store)
    except MapError:
        return False
    return True


def _vouched(manifest, kind, tile, data):
    layer = getattr(manifest, kind)
    note = packs.contents_note(data)
    tiles = [msgspec.structs.replace(t, **note) if t == tile else t for t in layer.tiles]
    return msgspec.structs.replace(manifest, **{kind: msgspec.structs.replace(layer, tiles=tiles)})
