"""Damaged, truncated and foreign inputs of builds and packs: only errors that the package names.

As a command: `python tests/tiles/fuzz_builds.py 2000` (cases), `--seed N`. As a test: `test_tiles_fuzz.py`.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import io
import json
import logging
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from tile_rasters import CRS, RasterGrid, dsm_heights, textured, write_raster

from ortholoc_edge.errors import OrtholocError
from ortholoc_edge.tiles.area import read_area
from ortholoc_edge.tiles.build import PackOptions, build_pack, preview_build
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

# A case takes a tenth of a second.
HANG_S = 60
_DOP = RasterGrid(96, 80, 400_000.0, 5_300_000.0, 0.5, -0.5)
_DSM = RasterGrid(48, 40, 400_000.0, 5_300_000.0, 1.0, -1.0)
_LONLAT = ((13.66155, 47.84522), (13.66190, 47.84490))

Mutation = Callable[[random.Random, bytes], bytes]


class Inputs:
    """Sound inputs of every kind, and a sound pack."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        pixels, heights = textured(_DOP), dsm_heights(_DSM)
        tiled = {"tiled": True, "blockxsize": 16, "blockysize": 16}
        self.dop = {
            "plain.tif": write_raster(folder / "plain.tif", pixels, _DOP),
            "lzw.tif": write_raster(folder / "lzw.tif", pixels, _DOP, compress="lzw", **tiled),
            "jpeg.tif": write_raster(folder / "jpeg.tif", pixels, _DOP, compress="jpeg", photometric="ycbcr"),
            "words.tif": write_raster(folder / "words.tif", pixels.astype(np.uint16) * 64, _DOP, compress="deflate"),
            "dop.jp2": write_raster(folder / "dop.jp2", pixels, _DOP, driver="JP2OpenJPEG"),
        }
        self.dsm = {
            "dsm.tif": write_raster(folder / "dsm.tif", heights, _DSM, nodata=-9999.0),
            "flat.tif": write_raster(folder / "flat.tif", heights, _DSM, compress="deflate", predictor=3, **tiled),
            "whole.tif": write_raster(folder / "whole.tif", heights.astype(np.int16), _DSM, compress="lzw"),
        }
        rows = [
            f"{400_000.5 + u:.1f} {5_299_999.5 - v:.1f} {heights[0, v, u]:.2f}" for v in range(40) for u in range(48)
        ]
        (folder / "points.xyz").write_text("\n".join(rows) + "\n")
        self.dsm["points.xyz"] = folder / "points.xyz"
        for layer, name in ((self.dop, "plain.tif"), (self.dsm, "dsm.tif")):
            path = folder / f"{name}.zip"
            with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
                archive.write(layer[name], name)
            layer[path.name] = path
        line = {"type": "LineString", "coordinates": [list(point) for point in _LONLAT]}
        (folder / "route.geojson").write_text(json.dumps(line))
        text = " ".join(f"{lon},{lat},0" for lon, lat in _LONLAT)
        (folder / "route.kml").write_text(
            '<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark><LineString>'
            f"<coordinates>{text}</coordinates></LineString></Placemark></Document></kml>"
        )
        items = [
            {"type": "SimpleItem", "command": 16, "frame": 3, "params": [0, 0, 0, None, lat, lon, 50]}
            for lon, lat in _LONLAT
        ]
        (folder / "route.plan").write_text(json.dumps({"fileType": "Plan", "mission": {"items": items}, "version": 1}))
        self.areas = {name: folder / name for name in ("route.geojson", "route.kml", "route.plan")}
        self.pack = build_pack(self.dop["plain.tif"], self.dsm["dsm.tif"], folder / "pack", _options()).path
        foreign = cv2.imencode(".png", np.zeros((20, 20, 3), np.uint8))[1].tobytes()
        self.foreign = [b"", b"\n", b"%PDF-1.4\n", b"PK\x03\x04" + bytes(30), b"II*\0" + b"\xff" * 40, foreign]
        self.foreign += [b"{" * 5000, b"\0" * 4096]
        self.foreign += [path.read_bytes() for path in (*self.dop.values(), *self.dsm.values())]


def fuzz(folder: Path, cases: int, seed: int) -> tuple[dict[str, int], list[str]]:
    """Returns: how often what happened, and each error that the package does not name, with how to get it again."""
    inputs = Inputs(folder / "inputs")
    seen: collections.Counter[str] = collections.Counter()
    found = []
    for number in range(cases):
        rng = random.Random(f"{seed} {number}")
        kind = rng.choices(["dop", "dsm", "area", "manifest", "pack"], [4, 4, 2, 4, 3])[0]
        place = folder / "case"
        place.mkdir()
        try:
            with _limited(HANG_S), _quiet():
                seen[f"{kind}: {_one(rng, kind, inputs, place)}"] += 1
        except OrtholocError as err:
            assert str(err), "an error says what is wrong"
            seen[f"{kind}: refused"] += 1
        except Exception:
            seen[f"{kind}: UNNAMED"] += 1
            found.append(f"seed {seed} case {number} ({kind}):\n{traceback.format_exc()}")
        finally:
            shutil.rmtree(place)
    return dict(sorted(seen.items())), found


def _options(**changes: object) -> PackOptions:
    return PackOptions(**({"vertical": "unknown", "source_crs": CRS, "dop_compression": "jpeg"} | changes))


def _one(rng: random.Random, kind: str, inputs: Inputs, place: Path) -> str:
    dop, dsm = inputs.dop["plain.tif"], inputs.dsm["dsm.tif"]
    if kind in ("dop", "dsm"):
        name = rng.choice(sorted(inputs.dop if kind == "dop" else inputs.dsm))
        path = place / name
        path.write_bytes(_mutated(rng, (inputs.dop if kind == "dop" else inputs.dsm)[name].read_bytes(), inputs))
        # Beside a sound one, or alone.
        extra = [dop if kind == "dop" else dsm] if rng.random() < 0.3 else []
        layers = ([path, *extra], [dsm]) if kind == "dop" else ([dop], [path, *extra])
        if rng.random() < 0.1:
            preview_build(*layers, place / "out", _options())
            return "estimated"
        return _sound(build_pack(*layers, place / "out", _options()))
    if kind == "area":
        name = rng.choice(sorted(inputs.areas))
        path = place / name
        path.write_bytes(_mutated(rng, inputs.areas[name].read_bytes(), inputs))
        return _sound(build_pack(dop, dsm, place / "out", _options(area=read_area(str(path), 10.0))))
    pack = place / "pack"
    shutil.copytree(inputs.pack, pack)
    file = pack / "manifest.json"
    if kind == "manifest" and rng.random() < 0.6:
        file.write_text(json.dumps(_restructured(rng, json.loads(file.read_text()))))
    elif kind == "manifest":
        file.write_bytes(_mutated(rng, file.read_bytes(), inputs))
    else:
        files = sorted(path for path in pack.rglob("*") if path.is_file() and path != file)
        for path in rng.sample(files, rng.randint(1, 2)):
            if rng.random() < 0.15:
                path.unlink()
            else:
                path.write_bytes(_mutated(rng, path.read_bytes(), inputs))
    return _used(Pack.open(pack))


def _sound(pack: Pack) -> str:
    problems = pack.verify()
    assert problems == [], problems
    return _used(pack) + " pack"


def _used(pack: Pack) -> str:
    sound = not pack.verify()
    with MapStore(pack) as store:
        for gsd in (0.5, 3.0):
            store.read(store.bounds, gsd, 2 * gsd)
        west, south, east, north = store.bounds
        store.heights(np.array([[(west + east) / 2, (south + north) / 2]]))
        store.ground_near(np.array([west, south]))
    return "sound" if sound else "opened with damage"


def _mutated(rng: random.Random, data: bytes, inputs: Inputs) -> bytes:
    kind = rng.choice(["cut", "bits", "bits", "head", "zeros", "foreign", "twice", "swap"])
    changed = bytearray(data)
    size = len(changed)
    if kind == "cut":
        del changed[rng.randrange(size) :]
    elif kind in ("bits", "head"):
        # What a format says about itself is at its beginning or its end.
        reach = min(size, 400) if kind == "head" else size
        for _ in range(rng.choice([1, 1, 3, 20])):
            changed[rng.randrange(reach)] ^= 1 << rng.randrange(8)
    elif kind == "zeros":
        start = rng.randrange(size)
        changed[start : start + rng.randint(1, 600)] = bytes(min(size - start, rng.randint(1, 600)))
    elif kind == "foreign":
        return rng.choice(inputs.foreign)
    elif kind == "twice":
        changed += data[rng.randrange(size) :]
    else:
        start = rng.randrange(size)
        changed[start : start + 8] = rng.randbytes(8)
    return bytes(changed)


_VALUES = (
    *(None, True, -1, 0, 1, 63, 64, 2**31, 2**63, -(2**70), 1e300, -1e-300, 0.5),
    *("", "x", "../../etc/passwd", "/dev/zero"),
    *("EPSG:4326", "EPSG:99999", "NaN", "a" * 3000, "\ud83d\ude00", [], {}, [1, 2], [[]], {"a": 1}),
)


def _restructured(rng: random.Random, manifest: dict[str, object]) -> dict[str, object]:
    """One value of a manifest changed, removed, or a key added; the text stays JSON."""
    holders = list(_holders(manifest))
    holder = rng.choice(holders)
    keys = list(holder) if isinstance(holder, dict) else range(len(holder))
    if not keys or rng.random() < 0.05:
        manifest["surprise"] = rng.choice(_VALUES)
        return manifest
    key = rng.choice(list(keys))
    value = holder[key]
    if rng.random() < 0.15:
        del holder[key]
    elif isinstance(value, int | float) and not isinstance(value, bool) and rng.random() < 0.6:
        holder[key] = rng.choice([value + 1, value - 1, value * 2, -value, value + 64, value + 512, value * 1000])
    elif isinstance(value, list) and value and rng.random() < 0.5:
        holder[key] = value * 2 if rng.random() < 0.5 else value[:-1]
    else:
        holder[key] = rng.choice(_VALUES)
    return manifest


def _holders(value: object) -> Iterator[object]:
    if isinstance(value, dict | list):
        yield value
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _holders(inner)


class _HungError(Exception):
    pass


@contextlib.contextmanager
def _limited(seconds: int) -> Iterator[None]:
    def ring(number: int, frame: object) -> None:
        raise _HungError(f"no end after {seconds} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    logging.disable(logging.CRITICAL)
    try:
        with contextlib.redirect_stderr(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("error")
            yield
    finally:
        logging.disable(logging.NOTSET)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", type=int, nargs="?", default=2000)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    start = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="ortholoc-fuzz-") as folder:
        seen, found = fuzz(Path(folder), args.cases, args.seed)
    print("\n".join(found))  # noqa: T201
    print(json.dumps(seen, indent=1), f"{time.monotonic() - start:.0f} s")  # noqa: T201
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
