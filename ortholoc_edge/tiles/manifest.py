"""`manifest.json`: what an area pack holds, as strict structs."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, TypeVar

import msgspec
import numpy as np

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.georeference import HeightOffset, VerticalDatum
from ortholoc_edge.tiles.lattice import CROP_PX, Bounds, Lattice, PixelBox

MANIFEST_NAME = "manifest.json"
SIGNATURE_NAME = "manifest.sig"
FORMAT = "ortholoc-pack"
VERSION = 3
# Version 2: every level is stored.
_READ = (2, VERSION)

_T = TypeVar("_T", bound=msgspec.Struct)

_Bytes = Annotated[int, msgspec.Meta(ge=0)]
_Positive = Annotated[float, msgspec.Meta(gt=0)]
# Beyond these a number is a mistake or an attack, and the offsets go to the autopilot.
_Sigma = Annotated[float, msgspec.Meta(ge=0, le=1000)]
_Height = Annotated[float, msgspec.Meta(ge=-12_000, le=12_000)]
_Fraction = Annotated[float, msgspec.Meta(ge=0, le=1)]
_Px = Annotated[int, msgspec.Meta(ge=0, multiple_of=CROP_PX)]
_SidePx = Annotated[int, msgspec.Meta(ge=CROP_PX, multiple_of=CROP_PX)]
_Index = Annotated[int, msgspec.Meta(ge=0)]
# Folders of the pack, no "..": a manifest must not be able to name a file outside it.
_FilePath = Annotated[str, msgspec.Meta(pattern=r"^([A-Za-z0-9_][A-Za-z0-9_.-]*/){0,3}[A-Za-z0-9_-][A-Za-z0-9_.-]*$")]
_Sha256 = Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{64}$")]
_Date = Annotated[str, msgspec.Meta(pattern=r"^\d{4}(-\d{2}(-\d{2})?)?$")]


class FileNote(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A file of the pack and what it must be."""

    file: _FilePath
    bytes: _Bytes
    sha256: _Sha256


class Tile(FileNote, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One COG.

    Attributes:
        column, row, width, height: its full-resolution pixels on the layer's lattice.
        valid_fraction: share of pixels with data.
        segment_crc32: base64 of little-endian uint32: CRC-32 of the file's head and of each block's bytes in
            the order of the file. It tells *which* block of a damaged file is bad, which the SHA-256 cannot.
        sources: that it shows, as indices into the layer's list, uppermost first.
    """

    column: _Px
    row: _Px
    width: _SidePx
    height: _SidePx
    valid_fraction: _Fraction
    segment_crc32: str
    sources: tuple[_Index, ...] = ()

    @property
    def box(self) -> PixelBox:
        return PixelBox(self.column, self.row, self.width, self.height)

    def crcs(self) -> list[int]:
        """``segment_crc32`` decoded. Raises: ValueError if it is not base64 of whole words."""
        return [int(v) for v in np.frombuffer(base64.b64decode(self.segment_crc32, validate=True), dtype="<u4")]


class DopTile(Tile, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``matchability``: mean over its cells, 0 to 1; None: not computed."""

    matchability: _Fraction | None = None


class DsmTile(Tile, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Heights of one tile.

    Attributes:
        min_m, max_m: lowest and highest height.
        filled_fraction: share of cells that were small holes in the source and got heights from their rims.
        amsl_minus_map_m, ellipsoid_minus_map_m: as in `VerticalDatum`, at the tile's centre.
    """

    min_m: _Height
    max_m: _Height
    filled_fraction: _Fraction = 0.0
    amsl_minus_map_m: HeightOffset | None = None
    ellipsoid_minus_map_m: HeightOffset | None = None


class SourceNote(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A file that a layer was built from.

    Attributes:
        name: of the file, without its folders.
        date: of acquisition, 2023, 2023-06 or 2023-06-04.
        crs: of the file, "EPSG:n" or WKT; None: none.
        gsd_m: of the file, in metres.
        resampled: whether its pixels had to be resampled onto the layer's lattice.
    """

    name: str
    date: _Date | None = None
    crs: str | None = None
    gsd_m: _Positive | None = None
    resampled: bool = False


class Layer(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What DOP and DSM have in common.

    Attributes:
        lattice: of the pixels.
        stored_levels: that the tiles hold, 0 first; those between are averaged from the next finer one, see
            `tiles.levels`. None: all.
        compression: of the TIFFs, for people.
        sources: that the layer was built from, newest first.
        date: of acquisition, where one holds for all.
        attribution, licence: of the sources, to be shown with the map.
    """

    lattice: Lattice
    compression: str
    sources: list[SourceNote]
    date: _Date | None = None
    attribution: str | None = None
    licence: str | None = None
    stored_levels: Annotated[tuple[_Index, ...], msgspec.Meta(min_length=1)] | None = None

    @property
    def stored(self) -> tuple[int, ...]:
        """Levels that the tiles hold, 0 first."""
        return tuple(range(self.lattice.levels)) if self.stored_levels is None else self.stored_levels

    def tile_grids(self, tile: Tile) -> dict[int, RasterGrid]:
        """Grids of a tile by stored level."""
        return {level: self.lattice.grid(tile.box, level) for level in self.stored}

    @property
    def gsd_m(self) -> float:
        return self.lattice.pixel_m


class Dop(Layer, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The orthophoto. ``true_ortho``: roofs upright over their walls; ``sigma_m``: planimetric error, 1 sigma."""

    tiles: Annotated[list[DopTile], msgspec.Meta(min_length=1)]
    true_ortho: bool | None = None
    sigma_m: _Sigma | None = None


class Dsm(Layer, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The surface model. ``max_z_error_m``: by compression; ``sigma_m``: vertical error of the source, 1 sigma."""

    tiles: Annotated[list[DsmTile], msgspec.Meta(min_length=1)]
    max_z_error_m: _Sigma
    nodata: float
    sigma_m: _Sigma | None = None


class FeatureTile(FileNote, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Features of one DOP tile.

    Attributes:
        dop: index of the tile in the DOP's list.
        dop_sha256: of the file they were extracted from.
        counts: features per scale.
    """

    dop: _Index
    dop_sha256: _Sha256
    counts: tuple[_Index, ...]


class FeatureLayer(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Precomputed features of the DOP, one file per tile that has any.

    Attributes:
        matcher: that they were extracted with and serve.
        model_sha256: of its graph.
        encoding: of the descriptors, see `tiles.features`.
        per_mpx: features kept per million pixels of each scale.
    """

    matcher: str
    model_sha256: _Sha256
    encoding: str
    per_mpx: _Positive
    tiles: list[FeatureTile]


class Alignment(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How far the DSM's edges lie from the DOP's, as measured at build time; None: not enough edges to tell.

    Attributes:
        east_m, north_m: by which the DSM must be moved to lie on the DOP.
        sigma_m: of either.
        samples: patches that agree.
    """

    east_m: float
    north_m: float
    sigma_m: _Sigma
    samples: _Index


class Manifest(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Root of `manifest.json`.

    Attributes:
        created: UTC, ISO 8601; None unless SOURCE_DATE_EPOCH was set, so that equal input gives equal bytes.
        crs: "EPSG:n" or WKT of the horizontal system; None for local metres.
        anchor: (easting, northing) m, round, near the centre: the origin of local coordinates.
        vertical: with the offsets at the anchor; the DSM's tiles have them each.
        features: precomputed, or None.
        alignment: of DOP and DSM, or None.
        files: everything else in the folder but the mosaics: STAC, reports.
    """

    format: str
    version: int
    created: str | None
    crs: str | None
    anchor: tuple[float, float]
    vertical: VerticalDatum
    dop: Dop
    dsm: Dsm
    features: FeatureLayer | None = None
    alignment: Alignment | None = None
    files: list[FileNote] = []

    def notes(self) -> list[FileNote]:
        """Every file of the pack but the manifest and its signature."""
        features = [] if self.features is None else self.features.tiles
        return [*self.dop.tiles, *self.dsm.tiles, *features, *self.files]


class _Head(msgspec.Struct):
    format: str
    version: int


def layer_box(tiles: Sequence[Tile]) -> PixelBox:
    """The box that holds all of a layer's tiles."""
    column, row = min(t.column for t in tiles), min(t.row for t in tiles)
    right, bottom = max(t.column + t.width for t in tiles), max(t.row + t.height for t in tiles)
    return PixelBox(column, row, right - column, bottom - row)


def layer_bounds(layer: Dop | Dsm) -> Bounds:
    """(west, south, east, north) of the box that holds all of a layer's tiles, m."""
    return layer.lattice.grid(layer_box(layer.tiles)).bounds


def valid_fraction(layer: Dop | Dsm) -> float:
    """Share of the layer's pixels, inside its tiles, that have data."""
    pixels = [tile.width * tile.height for tile in layer.tiles]
    return sum(n * t.valid_fraction for n, t in zip(pixels, layer.tiles, strict=True)) / sum(pixels)


def encode_crcs(crcs: Sequence[int]) -> str:
    return base64.b64encode(np.asarray(crcs, dtype="<u4").tobytes()).decode("ascii")


def write_manifest(manifest: Manifest, path: Path) -> None:
    path.write_bytes(msgspec.json.format(msgspec.json.encode(manifest), indent=2) + b"\n")


def read_manifest(path: Path) -> Manifest:
    """Parse and check a manifest.

    Raises: MapError naming the file, the key and the remedy.
    """
    return parse_manifest(manifest_bytes(path), path)


def manifest_bytes(path: Path) -> bytes:
    """A manifest as it is on disk, which is what a signature is over. Raises: MapError if it cannot be read."""
    try:
        return path.read_bytes()
    except FileNotFoundError as err:
        pack = path.parent
        if (aside := pack.parent / f".{pack.name}.replaced").exists():
            raise MapError(
                f"{pack}: a build was cut off while it replaced this pack; the old one lies at {aside}, rename it back"
            ) from err
        raise MapError(
            f"{pack}: no area pack, {path.name} is missing; build one with: ortholoc-edge tiles build"
        ) from err
    except OSError as err:
        raise MapError(f"{path}: cannot be read ({err.strerror}); check the path and its permissions") from err


def parse_manifest(raw: bytes, path: Path) -> Manifest:
    """Check the bytes of a manifest; ``path`` is for messages. Raises: MapError naming file, key and remedy."""
    # The head first: a newer format would fail on keys, and the version is the better message.
    head = _decoded(raw, _Head, path)
    if head.format != FORMAT:
        raise MapError(f"{path}: format {head.format!r} at $.format, expected {FORMAT!r}; is it an area pack?")
    if head.version not in _READ:
        raise MapError(
            f"{path}: version {head.version} at $.version, this program reads {' and '.join(map(str, _READ))};"
            " rebuild the pack with this program or update the program"
        )
    manifest = _decoded(raw, Manifest, path)
    _check(manifest, path)
    return manifest


def _check(manifest: Manifest, path: Path) -> None:
    """What the types cannot say: tiles inside one tile of their lattice and none twice, and no file twice."""

    def refuse(key: str, what: str) -> MapError:
        return MapError(f"{path}: {key}: {what}; rebuild the pack or copy it again")

    for name, layer in (("dop", manifest.dop), ("dsm", manifest.dsm)):
        _check_layer(name, layer, refuse)
    if manifest.features is not None:
        for index, entry in enumerate(manifest.features.tiles):
            if entry.dop >= len(manifest.dop.tiles):
                raise refuse(f"$.features.tiles[{index}].dop", "names a tile that is not listed")
    names = [note.file for note in manifest.notes()]
    if len(set(names)) != len(names):
        raise refuse("$", "names a file twice")
    if MANIFEST_NAME in names or SIGNATURE_NAME in names:
        raise refuse("$", f"lists {MANIFEST_NAME} or {SIGNATURE_NAME}")


def _check_layer(name: str, layer: Dop | Dsm, refuse: Callable[[str, str], MapError]) -> None:
    lattice, seen = layer.lattice, set()
    if not np.isfinite([lattice.west, lattice.top, lattice.pixel_m]).all():
        raise refuse(f"$.{name}.lattice", "not finite")
    if layer.stored[0] != 0 or list(layer.stored) != sorted({*layer.stored} & {*range(lattice.levels)}):
        raise refuse(f"$.{name}.stored_levels", f"not some of the {lattice.levels} levels in order from 0 on")
    for index, tile in enumerate(layer.tiles):
        key = f"$.{name}.tiles[{index}]"
        first = lattice.tile_key(tile.column, tile.row)
        if first != lattice.tile_key(tile.column + tile.width - 1, tile.row + tile.height - 1):
            raise refuse(key, f"{tile.box} crosses a tile's border")
        if first in seen:
            raise refuse(key, f"a second tile at {first}")
        seen.add(first)
        if any(source >= len(layer.sources) for source in tile.sources):
            raise refuse(f"{key}.sources", "names a source that is not listed")
        try:
            tile.crcs()
        except ValueError as err:
            raise refuse(f"{key}.segment_crc32", str(err)) from err


def _decoded(raw: bytes, kind: type[_T], path: Path) -> _T:
    try:
        return msgspec.json.decode(raw, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError) as err:
        raise MapError(f"{path}: {err}; rebuild the pack or copy it again") from err
