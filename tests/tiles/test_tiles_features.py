"""Precomputed features: what is stored of them, where they are found again, and what is refused."""

from __future__ import annotations

import io
import math
import shutil
from collections.abc import Mapping
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from packs import DOP_CORNER, DOP_LATTICE, contents_note, write_pack

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.arrays import BoolArray, ImageArray
from ortholoc_edge.matching.contrast import even_contrast
from ortholoc_edge.matching.types import Features, Matches
from ortholoc_edge.matching.xfeat import XFeatMatcher
from ortholoc_edge.tiles import features
from ortholoc_edge.tiles.features import FeatureIndex, extract_tile
from ortholoc_edge.tiles.manifest import MANIFEST_NAME, FeatureLayer, FeatureTile, write_manifest
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

SHA = "0" * 64
PER_MPX = 4000.0


class Dots:
    """A matcher that finds single bright pixels, at their own scale; what is around gives the descriptor."""

    name = "xfeat"
    model_sha256: str | None = SHA
    working_px = features.WORKING_PX

    def extract(self, image: ImageArray, valid: BoolArray | None = None) -> Features:
        return self.extract_unscaled(image, valid)

    def extract_unscaled(self, image: ImageArray, valid: BoolArray | None = None) -> Features:
        bright = image > 250
        bright &= np.ones(image.shape, np.bool_) if valid is None else valid
        v, u = np.nonzero(bright)
        # Of the position in the image, so that every descriptor is different.
        seeds = 1 + (u * 7919 + v) % 997
        descriptors = np.stack([np.sin((1 + k) * seeds) for k in range(64)], axis=1).astype(np.float32)
        descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
        scores = np.linspace(1.0, 0.5, len(u), dtype=np.float32)
        return Features(np.stack([u, v], axis=1).astype(np.float64), scores, descriptors)

    def match(self, query: Features, reference: Features) -> Matches:
        raise AssertionError("not asked for")


def dots(width: int, height: int, step: int = 32) -> ImageArray:
    """Grey ground with bright pixels at known places, and a slope that tells tiles apart."""
    image = np.full((height, width), 90, np.uint8)
    image[step // 2 :: step, step // 2 :: step] = 255
    return image


def levels_of(image: ImageArray, count: int = 5) -> list[tuple[ImageArray, BoolArray]]:
    """Every level has the dots of its own grid."""
    height, width = image.shape
    return [(dots(width >> k, height >> k), np.ones((height >> k, width >> k), np.bool_)) for k in range(count)]


# -- what is stored ----------------------------------------------------------


def test_descriptors_come_back_close(xfeat_model) -> None:
    rng = np.random.default_rng(4)
    scene = cv2.resize(rng.integers(40, 200, (60, 80), dtype=np.uint8), (640, 480), interpolation=cv2.INTER_CUBIC)
    for x, y, width, height, grey in rng.integers((0, 0, 8, 8, 0), (600, 440, 60, 60, 255), (80, 5)).tolist():
        scene[y : y + height, x : x + width] = grey
    found = XFeatMatcher(xfeat_model.graph, xfeat_model.sha256).extract(scene)
    codec = features._codec()
    codes = codec.encode(found.descriptors)
    assert codes.shape == (len(found), 8)
    again = codec.decode(codes)
    np.testing.assert_allclose(np.linalg.norm(again, axis=1), 1.0, atol=1e-5)
    cosine = np.einsum("nc,nc->n", found.descriptors, again)
    assert np.median(cosine) > 0.93
    assert np.percentile(cosine, 5) > 0.88


def test_code_of_a_code_is_itself() -> None:
    """Every bit counts: what decodes to a value is encoded as that value again, but for the length."""
    codec = features._codec()
    assert codec.bits.sum() == 64
    rng = np.random.default_rng(0)
    codes = rng.integers(0, 256, (200, 8), dtype=np.uint8)
    bits = np.unpackbits(codes, axis=1).astype(np.float32)
    values = codec.outputs[(bits @ codec.weights).astype(np.intp) + codec.first]
    plain = (values * codec.deviation) @ codec.axes + codec.mean
    np.testing.assert_array_equal(codec.encode(plain), codes)


def test_same_tile_same_bytes_and_positions_to_a_sixteenth_of_a_pixel() -> None:
    levels = levels_of(dots(1024, 768))
    data, counts = extract_tile(levels, Dots(), PER_MPX)
    assert extract_tile(levels, Dots(), PER_MPX) == (data, counts)
    records = np.load(io.BytesIO(data), allow_pickle=False)
    assert records.dtype == features.RECORD
    assert len(records) == sum(counts)
    assert len(counts) == 6
    part = records[counts[0] : counts[0] + counts[1]]
    px = np.stack([part["x"], part["y"]], axis=1) / 8 + 1 / 16 - 0.5
    nearest = np.rint((px - 16) / 32) * 32 + 16
    assert np.abs(px - nearest).max() <= 1 / 16
    assert len(np.unique(nearest, axis=0)) == len(part)


def test_best_of_each_neighbourhood_are_kept_up_to_the_limit() -> None:
    levels = levels_of(dots(1024, 768))
    for per_mpx in (50.0, 200.0):
        _, counts = extract_tile(levels, Dots(), per_mpx)
        assert counts[1] == round(per_mpx * 1024 * 768 * 1e-6)
    data, counts = extract_tile(levels, Dots(), 100.0)
    part = np.load(io.BytesIO(data))[counts[0] : counts[0] + counts[1]]
    quadrants = np.unique((part["x"] > 4096) * 2 + (part["y"] > 3072), return_counts=True)[1]
    assert len(quadrants) == 4
    assert quadrants.min() > 0.6 * quadrants.max()


def test_windows_meet_without_gap_or_double() -> None:
    """Dots all over a tile of several windows, each found once, but for the rim that the matcher cannot judge."""
    image = dots(1280, 960)
    _, counts = extract_tile([(image, np.ones(image.shape, np.bool_))], Dots(), 1e6)
    assert counts[1] == 40 * 30


def test_nothing_where_there_is_no_map() -> None:
    image = dots(640, 640)
    valid = np.zeros(image.shape, np.bool_)
    assert extract_tile([(image, valid)], Dots(), PER_MPX) == (b"", (0, 0))
    valid[:, :320] = True
    data, counts = extract_tile([(image, valid)], Dots(), PER_MPX)
    part = np.load(io.BytesIO(data))[counts[0] :]
    assert 0 < part["x"].max() / 8 < 320


def test_too_large_a_tile_is_refused() -> None:
    image = np.zeros((64, 4160), np.uint8)
    with pytest.raises(MapError, match="4160 x 64 px"):
        extract_tile([(image, image > 0)], Dots(), PER_MPX)


def test_contrast_of_a_place_does_not_depend_on_what_is_far_away() -> None:
    rng = np.random.default_rng(1)
    image = rng.integers(90, 110, (400, 800), dtype=np.uint8)
    other = image.copy()
    other[:, 500:] = rng.integers(0, 255, (400, 300), dtype=np.uint8)
    valid = np.ones(image.shape, np.bool_)
    one, two = even_contrast(image, valid), even_contrast(other, valid)
    assert np.abs(one[:, :350].astype(int) - two[:, :350]).max() <= 1
    # A hole is not a dark place.
    holed = valid.copy()
    holed[:, 500:] = False
    other[:, 500:] = 0
    three = even_contrast(other, holed)
    assert np.abs(one[:, :350].astype(int) - three[:, :350]).max() <= 1
    assert np.std(three[:, :480]) == pytest.approx(48, rel=0.15)


# -- in flight ---------------------------------------------------------------


@pytest.fixture(scope="module")
def pack_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four tiles of 512 px, three of them cropped, with dots across their borders."""
    folder = tmp_path_factory.mktemp("features") / "pack"
    grey = dots(704, 640)
    pack = write_pack(folder, np.stack([grey] * 3), np.full((192, 192), 100.0, np.float32))
    return with_features(pack)


def with_features(pack: Pack) -> Path:
    entries = []
    for index, tile in enumerate(pack.manifest.dop.tiles):
        data, counts = extract_tile(levels_of(np.zeros((tile.height, tile.width), np.uint8)), Dots(), 1e5)
        name = f"features/{Path(tile.file).stem}.npy"
        (pack.path / "features").mkdir(exist_ok=True)
        (pack.path / name).write_bytes(data)
        entries.append(FeatureTile(file=name, **contents_note(data), dop=index, dop_sha256=tile.sha256, counts=counts))
    layer = FeatureLayer(matcher="xfeat", model_sha256=SHA, encoding=features.ENCODING, per_mpx=1e5, tiles=entries)
    write_manifest(msgspec.structs.replace(pack.manifest, features=layer), pack.path / MANIFEST_NAME)
    return pack.path


def changed(pack_path: Path, folder: Path, changes: Mapping[str, object]) -> MapStore:
    path = shutil.copytree(pack_path, folder / "pack")
    manifest = Pack.open(path).manifest
    assert manifest.features is not None
    layer = msgspec.structs.replace(manifest.features, **changes)
    write_manifest(msgspec.structs.replace(manifest, features=layer), path / MANIFEST_NAME)
    return MapStore(Pack.open(path), features=True)


def test_features_of_a_region_over_tile_borders(pack_path: Path) -> None:
    with MapStore(Pack.open(pack_path), features=True) as store:
        index = FeatureIndex(store, Dots())
        full = store.dop_grids[0]
        assert index.grids[1] == full
        assert index.grids[0].width == 2 * full.width
        # Where dots of each tile's own picture are, on the lattice.
        expected = []
        for tile in store.pack.manifest.dop.tiles:
            u, v = np.meshgrid(np.arange(16, tile.width, 32), np.arange(16, tile.height, 32))
            corner = tile.column - DOP_CORNER[0], tile.row - DOP_CORNER[1]
            expected.append(np.stack([u.ravel(), v.ravel()], axis=1) + corner)
        places = np.concatenate(expected)
        for region in ((0, 0, full.width, full.height), (250, 300, 200, 160), (319, 383, 2, 2), (0, 0, 33, 33)):
            bounds = full.crop(*region).bounds
            found = index.read(bounds, 1)
            column, row, width, height = region
            low = np.array([column, row]) - 0.5
            inside = ((places > low) & (places < low + np.array([width, height]))).all(axis=1)
            assert len(found.px) == np.count_nonzero(inside)
            if inside.any():
                away = np.linalg.norm(found.px[:, None] - places[inside][None], axis=2)
                assert away.min(axis=1).max() <= math.sqrt(2) / 16 + 1e-9
            assert found.descriptors().shape == (len(found.px), 64)
        west, south, _, north = full.bounds
        assert len(index.read((west - 900, south, west - 500, north), 1).px) == 0
        # The coarsest scale lies on the same places of the map.
        coarse = index.read(full.bounds, 3)
        u = coarse.px[:, 0]
        assert len(coarse.px) > 4
        assert (u > -0.5).all()
        assert (u < index.grids[3].width).all()


def test_no_file_is_opened_once_features_are_loaded(pack_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    features._codec.cache_clear()
    with MapStore(Pack.open(pack_path), features=True) as store:
        index = FeatureIndex(store, Dots())

        def refuse(*_: object) -> None:
            raise OSError("a file was opened in flight")

        monkeypatch.setattr(features.resources, "files", refuse)
        assert len(index.read(store.bounds, 1).descriptors()) > 4


def test_scale_that_fits(pack_path: Path) -> None:
    with MapStore(Pack.open(pack_path), features=True) as store:
        index = FeatureIndex(store, Dots())
        pixel_m = DOP_LATTICE.pixel_m
        for part, scale in ((0.1, 0), (0.5, 0), (0.99, 0), (1.01, 1), (1.9, 1), (2.1, 2), (100.0, 5)):
            assert index.scale_for(part * pixel_m) == scale


def test_other_matchers_models_and_encodings_are_refused(pack_path: Path, tmp_path: Path) -> None:
    other = Dots()
    other.model_sha256 = "1" * 64
    with MapStore(Pack.open(pack_path), features=True) as store, pytest.raises(MapError, match="model 000000000000"):
        FeatureIndex(store, other)
    changes: tuple[tuple[dict[str, object], str], ...] = (
        ({"matcher": "sift"}, "are of sift"),
        ({"encoding": "xfeat-pca64-0"}, "encoded as xfeat-pca64-0"),
    )
    for number, (change, words) in enumerate(changes):
        with changed(pack_path, tmp_path / str(number), change) as store, pytest.raises(MapError, match=words):
            FeatureIndex(store, Dots())


def test_damaged_feature_files_are_no_features(pack_path: Path, tmp_path: Path, caplog) -> None:
    path = shutil.copytree(pack_path, tmp_path / "pack")
    first, *rest = sorted((path / "features").iterdir())
    first.write_bytes(first.read_bytes()[:-1] + b"\x00")
    with MapStore(Pack.open(path), features=True) as store:
        whole = MapStore(Pack.open(pack_path), features=True)
        bounds = store.bounds
        fewer = len(FeatureIndex(store, Dots()).read(bounds, 1).px)
        assert 0 < fewer < len(FeatureIndex(whole, Dots()).read(bounds, 1).px)
        whole.close()
    assert first.name in caplog.text
    for file in rest:
        file.unlink()
    with MapStore(Pack.open(path), features=True) as store, pytest.raises(MapError, match="damaged"):
        FeatureIndex(store, Dots())


@pytest.mark.parametrize(
    "spoil",
    [
        lambda data: b"",
        lambda data: data[:40],
        lambda data: data[: len(data) // 2],
        lambda data: data.replace(b"'<u2'", b"'<i2'"),
        lambda data: data[:128] + data[128:][::-1],
        lambda data: b"\x93NUMPY\x02" + data[7:],
        lambda data: data.replace(b"{'descr'", b"{('desc'"),
        lambda data: data.replace(b"False", b"0 0 1"),
    ],
    ids=["empty", "head", "half", "type", "order", "version", "bracket", "syntax"],
)
def test_files_that_are_listed_but_no_features_are_named(pack_path: Path, tmp_path: Path, spoil) -> None:
    manifest = Pack.open(pack_path).manifest
    assert manifest.features is not None
    tile, *others = manifest.features.tiles
    path = shutil.copytree(pack_path, tmp_path / "made" / "pack")
    data = spoil((path / tile.file).read_bytes())
    (path / tile.file).write_bytes(data)
    spoilt = msgspec.structs.replace(tile, **contents_note(data))
    layer = msgspec.structs.replace(manifest.features, tiles=[spoilt, *others])
    write_manifest(msgspec.structs.replace(manifest, features=layer), path / MANIFEST_NAME)
    with MapStore(Pack.open(path), features=True) as store, pytest.raises(MapError, match=Path(tile.file).name):
        FeatureIndex(store, Dots())
