"""`manifest.json`: what an area pack holds, as strict structs."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, TypeVar

import msgspec
import numpy as np

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.georeference import VerticalDatum

MANIFEST_NAME = "manifest.json"
FORMAT = "ortholoc-pack"
VERSION = 1

_T = TypeVar("_T", bound=msgspec.Struct)

_Count = Annotated[int, msgspec.Meta(ge=1)]
_Bytes = Annotated[int, msgspec.Meta(ge=0)]
_Positive = Annotated[float, msgspec.Meta(gt=0)]
_Sigma = Annotated[float, msgspec.Meta(ge=0)]
_Fraction = Annotated[float, msgspec.Meta(ge=0, le=1)]
# No separators: a manifest must not be able to name a file outside its pack.
_FileName = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$")]
_Sha256 = Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{64}$")]


class Grid(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A `RasterGrid` in JSON; see there."""

    width: _Count
    height: _Count
    west: float
    top: float
    dx: _Positive
    dy: float

    @staticmethod
    def of(grid: RasterGrid) -> Grid:
        return Grid(
            width=grid.width, height=grid.height, west=grid.west, top=grid.top, dx=grid.dx, dy=grid.dy
        )

    def raster_grid(self) -> RasterGrid:
        return RasterGrid(self.width, self.height, self.west, self.top, self.dx, self.dy)


class RasterFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One raster of the pack.

    Attributes:
        file: name inside the pack.
        gsd_m: ground sampling distance of the full resolution, m.
        grid: of the full resolution.
        levels: full resolution and its overviews.
        compression: of the TIFF.
        valid_fraction: share of pixels with data.
        bytes, sha256: of the file.
        segment_crc32: base64 of little-endian uint32: CRC-32 of the file's head and of each tile's bytes in
            the order of the file. It tells *which* tile of a damaged file is bad, which the SHA-256 cannot.
        date: of acquisition, as the publisher gives it (2023-06-04, 2023).
        attribution, licence: of the source, to be shown with the map.
        source: name of the file it was built from.
    """

    file: _FileName
    gsd_m: _Positive
    grid: Grid
    levels: _Count
    compression: str
    valid_fraction: _Fraction
    bytes: _Bytes
    sha256: _Sha256
    segment_crc32: str
    source: str
    date: str | None = None
    attribution: str | None = None
    licence: str | None = None

    def crcs(self) -> list[int]:
        """``segment_crc32`` decoded. Raises: ValueError if it is not base64 of whole words."""
        return [
            int(v) for v in np.frombuffer(base64.b64decode(self.segment_crc32, validate=True), dtype="<u4")
        ]


class Dop(RasterFile, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The orthophoto. ``true_ortho``: roofs upright over their walls; ``sigma_m``: planimetric error, 1 sigma."""

    true_ortho: bool | None = None
    sigma_m: _Sigma | None = None


class Dsm(RasterFile, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The surface model. ``max_z_error_m``: by compression; ``sigma_m``: vertical error of the source, 1 sigma."""

    max_z_error_m: _Sigma
    nodata: float
    sigma_m: _Sigma | None = None


class Manifest(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Root of `manifest.json`.

    Attributes:
        created: UTC, ISO 8601.
        crs: "EPSG:n" or WKT of the horizontal system; None for local metres.
        anchor: (easting, northing) m, round, near the centre: the origin of local coordinates.
    """

    format: str
    version: int
    created: str
    crs: str | None
    anchor: tuple[float, float]
    vertical: VerticalDatum
    dop: Dop
    dsm: Dsm


class _Head(msgspec.Struct):
    format: str
    version: int


def encode_crcs(crcs: Sequence[int]) -> str:
    return base64.b64encode(np.asarray(crcs, dtype="<u4").tobytes()).decode("ascii")


def write_manifest(manifest: Manifest, path: Path) -> None:
    path.write_bytes(msgspec.json.format(msgspec.json.encode(manifest), indent=2) + b"\n")


def read_manifest(path: Path) -> Manifest:
    """Parse and check a manifest.

    Raises: MapError naming the file, the key and the remedy.
    """
    try:
        raw = path.read_bytes()
    except FileNotFoundError as err:
        raise MapError(
            f"{path.parent}: no area pack, {path.name} is missing; build one with: ortholoc-edge tiles build"
        ) from err
    except OSError as err:
        raise MapError(
            f"{path}: cannot be read ({err.strerror}); check the path and its permissions"
        ) from err
    # The head first: a newer format would fail on keys, and the version is the better message.
    head = _decoded(raw, _Head, path)
    if head.format != FORMAT:
        raise MapError(
            f"{path}: format {head.format!r} at $.format, expected {FORMAT!r}; is it an area pack?"
        )
    if head.version != VERSION:
        raise MapError(
            f"{path}: version {head.version} at $.version, this program reads {VERSION};"
            " rebuild the pack with this program or update the program"
        )
    manifest = _decoded(raw, Manifest, path)
    for name, entry in (("dop", manifest.dop), ("dsm", manifest.dsm)):
        try:
            entry.grid.raster_grid()
        except ValueError as err:
            raise MapError(f"{path}: $.{name}.grid: {err}; rebuild the pack or copy it again") from err
        try:
            entry.crcs()
        except ValueError as err:
            raise MapError(
                f"{path}: $.{name}.segment_crc32: {err}; rebuild the pack or copy it again"
            ) from err
    return manifest


def _decoded(raw: bytes, kind: type[_T], path: Path) -> _T:
    try:
        return msgspec.json.decode(raw, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError) as err:
        raise MapError(f"{path}: {err}; rebuild the pack or copy it again") from err
