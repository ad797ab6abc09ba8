"""An area pack on disk: a folder of DOP and DSM tiles with their manifest."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rasterio.errors import RasterioError
from rasterio.io import MemoryFile
from rasterio.transform import Affine

from ortholoc_edge.errors import MapError
from ortholoc_edge.tiles.cog import Block, Cog, describe
from ortholoc_edge.tiles.georeference import Georeference, HeightOffsets
from ortholoc_edge.tiles.layer import check_listed, read_listed
from ortholoc_edge.tiles.manifest import (
    MANIFEST_NAME,
    SIGNATURE_NAME,
    Dop,
    Dsm,
    FileNote,
    Manifest,
    Tile,
    layer_box,
    manifest_bytes,
    parse_manifest,
    read_manifest,
)
from ortholoc_edge.tiles.signature import require
from ortholoc_edge.tiles.vrt import DOP_VRT, DSM_VRT

logger = logging.getLogger(__name__)

# What is to come, how many files are done, and of how many.
Progress = Callable[[str, int, int], None]

# A truncated card or a bad copy can spoil every block of a file; a person needs the first few.
_MAX_NAMED_BLOCKS = 20

# Beyond these a manifest is broken, and quotients of coordinates would no longer be numbers.
_PIXEL_M = 1e-3, 1e3


@dataclass(frozen=True, slots=True, eq=False)
class Pack:
    """A pack whose manifest was read and whose files were looked for.

    Attributes:
        path: the folder.
        manifest: as read.
        georeference: of the pack's map frame.
        missing: files that the manifest lists and that are not there, or not with the size it says.
        signed: whether a signature of the manifest was required and found.
        manifest_sha256: of its bytes; they hold the checksums of all files, so it names the pack's content.
    """

    path: Path
    manifest: Manifest
    georeference: Georeference
    missing: frozenset[str] = frozenset()
    signed: bool = False
    manifest_sha256: str = ""

    @staticmethod
    def open(path: Path, public_key: Path | None = None) -> Pack:
        """Read the manifest and look at the files; their contents are checked by `verify` and by `MapStore`.

        A file that is missing or has another size is no error: without a tile there is a hole in the map. All of
        them give one warning.
        Args:
            public_key: that must have signed the manifest, a PEM file; None: no signature is looked for.
        Raises: MapError naming the manifest, the key and the remedy; ConfigError for an unusable public key.
        """
        file = path / MANIFEST_NAME
        # What is parsed are the bytes that were verified, not those of a second look at the file.
        raw = manifest_bytes(file) if public_key is None else require(path, public_key)
        manifest = parse_manifest(raw, file)
        problems = {}
        for note in manifest.notes():
            try:
                check_listed(path / note.file, note)
            except MapError as err:
                problems[note.file] = str(err)
        if problems:
            logger.warning(
                "%s: %d of its %d files are missing or of the wrong size; the first: %s",
                path, len(problems), len(manifest.notes()), next(iter(problems.values())),
            )  # fmt: skip
        try:
            for layer in (manifest.dop, manifest.dsm):
                if not _PIXEL_M[0] <= layer.lattice.pixel_m <= _PIXEL_M[1]:
                    raise ValueError(f"pixels of {layer.lattice.pixel_m} m")
                layer.lattice.grid(layer_box(layer.tiles))
            georeference = Georeference(manifest.crs, manifest.vertical, manifest.anchor, _offsets(manifest.dsm))
        except ValueError as err:
            raise MapError(f"{path / MANIFEST_NAME}: {err}; rebuild the pack or copy it again") from err
        sha256 = hashlib.sha256(raw).hexdigest()
        return Pack(path, manifest, georeference, frozenset(problems), public_key is not None, sha256)

    @property
    def total_bytes(self) -> int:
        """Of all files that the manifest lists."""
        return sum(note.bytes for note in self.manifest.notes())

    def replaced(self) -> bool:
        """Whether another pack is at the path now."""
        try:
            return read_manifest(self.path / MANIFEST_NAME) != self.manifest
        except MapError:
            return False

    def verify(self, progress: Progress = lambda what, done, steps: None) -> list[str]:
        """Check every byte of every file, decode every block of every level, and look for files that are not listed.

        Args:
            progress: told before each file.
        Returns: problems, each naming the file, and the block where it is one; empty for a sound pack.
        """
        manifest, problems = self.manifest, []
        notes = manifest.notes()
        layers: dict[str, Dop | Dsm] = {}
        for layer in (manifest.dop, manifest.dsm):
            layers |= {tile.file: layer for tile in layer.tiles}
        crs = _as_stored(manifest.crs)
        for done, note in enumerate(notes):
            progress(note.file, done, len(notes))
            try:
                if isinstance(note, Tile):
                    # One by one: what was found before an error counts too.
                    for problem in self._tile_problems(note, layers[note.file], crs):
                        problems.append(problem)
                else:
                    self._read(note)
            except MapError as err:
                problems.append(str(err))
        if manifest.features is not None:
            for entry in manifest.features.tiles:
                if entry.dop_sha256 != manifest.dop.tiles[entry.dop].sha256:
                    problems.append(
                        f"{self.path / entry.file}: features of another file than"
                        f" {manifest.dop.tiles[entry.dop].file}; rebuild the pack"
                    )
        problems += [
            f"{self.path / name}: not listed in {MANIFEST_NAME}; remove it, it is none of the pack's"
            for name in self._unlisted({note.file for note in notes})
        ]
        progress("", len(notes), len(notes))
        return problems

    def _tile_problems(self, tile: Tile, layer: Dop | Dsm, crs: Any) -> Iterator[str]:
        path = self.path / tile.file
        data = read_listed(path, tile)
        intact = hashlib.sha256(data).hexdigest() == tile.sha256
        if not intact:
            yield f"{path}: SHA-256 differs from {MANIFEST_NAME}; copy the pack again"
        dtypes, nodata = (("float32",), layer.nodata) if isinstance(layer, Dsm) else (("uint8",) * 3, None)
        with Cog(data, path) as cog:
            cog.require(layer.tile_grids(tile), dtypes, nodata)
            if cog.crs != crs:
                yield f"{path}: its reference system is {cog.crs}, the manifest's is {self.manifest.crs}"
            if intact:
                if cog.segment_crcs() != tile.crcs():
                    yield f"{path}: segment_crc32 in {MANIFEST_NAME} is not this file's; rebuild the pack"
                yield from _named(path, cog.undecodable(), "cannot be decoded")
            else:
                yield from _named(path, sorted(cog.locate_damage(tile.crcs())), "differs from the build")

    def _read(self, note: FileNote) -> None:
        if hashlib.sha256(read_listed(self.path / note.file, note)).hexdigest() != note.sha256:
            raise MapError(f"{self.path / note.file}: SHA-256 differs from {MANIFEST_NAME}; copy the pack again")

    def _unlisted(self, listed: set[str]) -> list[str]:
        found = (path for path in self.path.rglob("*") if path.is_symlink() or not path.is_dir())
        names = (path.relative_to(self.path).as_posix() for path in found)
        known = {*listed, MANIFEST_NAME, SIGNATURE_NAME, DOP_VRT, DSM_VRT}
        # A GIS leaves statistics beside what it has shown.
        return sorted(name for name in names if name not in known and not name.endswith(".aux.xml"))


def _offsets(dsm: Dsm) -> HeightOffsets:
    lattice = dsm.lattice
    keyed = [(lattice.tile_key(tile.column, tile.row), tile) for tile in dsm.tiles]
    return HeightOffsets(
        lattice.west,
        lattice.top,
        lattice.pixel_m * lattice.tile_px,
        {key: t.amsl_minus_map_m for key, t in keyed if t.amsl_minus_map_m is not None},
        {key: t.ellipsoid_minus_map_m for key, t in keyed if t.ellipsoid_minus_map_m is not None},
    )


def _as_stored(crs: str | None) -> Any:
    """A reference system as a GeoTIFF gives it back: not all of a WKT survives its keys."""
    if crs is None:
        return None
    with MemoryFile() as memory:
        profile = {"driver": "GTiff", "width": 1, "height": 1, "count": 1, "dtype": "uint8"}
        try:
            with memory.open(**profile, crs=crs, transform=Affine(1, 0, 1, 0, -1, 1)):
                pass
            with memory.open() as stored:
                return stored.crs
        except RasterioError as err:
            raise MapError(f"{MANIFEST_NAME}: $.crs cannot be stored in a GeoTIFF ({err})") from err


def _named(path: Path, blocks: list[Block], what: str) -> Iterator[str]:
    yield from (f"{path}: {describe(block)} {what}" for block in blocks[:_MAX_NAMED_BLOCKS])
    if len(blocks) > _MAX_NAMED_BLOCKS:
        yield f"{path}: {len(blocks) - _MAX_NAMED_BLOCKS} more blocks"
