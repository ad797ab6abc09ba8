"""An area pack on disk: a folder with a DOP, a DSM and their manifest."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from ortholoc_edge.errors import MapError
from ortholoc_edge.tiles.cog import Cog, describe
from ortholoc_edge.tiles.georeference import Georeference
from ortholoc_edge.tiles.manifest import MANIFEST_NAME, Manifest, RasterFile, read_manifest

# A truncated card or a bad copy can spoil every tile; a person needs the first few.
_MAX_NAMED_TILES = 20


@dataclass(frozen=True, slots=True, eq=False)
class Pack:
    """A pack whose manifest was read and whose files are there with the right sizes.

    Attributes:
        path: the folder.
        manifest: as read.
        georeference: of the pack's map frame.
    """

    path: Path
    manifest: Manifest
    georeference: Georeference

    @staticmethod
    def open(path: Path) -> Pack:
        """Read the manifest and look at the files; their contents are checked by `verify` and by `MapStore`.

        Raises: MapError naming the file, the key and the remedy.
        """
        manifest = read_manifest(path / MANIFEST_NAME)
        for entry in (manifest.dop, manifest.dsm):
            file = path / entry.file
            try:
                size = file.stat().st_size
            except OSError as err:
                raise MapError(f"{file}: {err.strerror}; rebuild the pack or copy it again") from err
            if size != entry.bytes:
                raise MapError(
                    f"{file}: {size} bytes, the manifest says {entry.bytes}; rebuild the pack or copy it again"
                )
        return Pack(path, manifest, Georeference(manifest.crs, manifest.vertical, manifest.anchor))

    @property
    def rasters(self) -> tuple[RasterFile, RasterFile]:
        return self.manifest.dop, self.manifest.dsm

    def verify(self) -> list[str]:
        """Check every byte and decode every tile of every level.

        Returns: problems, each naming file and tile; empty for a sound pack.
        """
        problems: list[str] = []
        for entry in self.rasters:
            try:
                problems += self._verify(entry)
            except MapError as err:
                problems.append(str(err))
        return problems

    def load(self, entry: RasterFile) -> tuple[Cog, bool]:
        """One raster read to memory and opened, and whether its SHA-256 is the manifest's.

        Raises: MapError if it cannot be read or is another raster than the manifest describes.
        """
        path = self.path / entry.file
        try:
            data = path.read_bytes()
        except OSError as err:
            raise MapError(f"{path}: cannot be read ({err.strerror}); copy the pack again") from err
        intact = hashlib.sha256(data).hexdigest() == entry.sha256
        cog = Cog(data, path)
        if cog.grids[0] != entry.grid.raster_grid() or len(cog.grids) != entry.levels:
            cog.close()
            raise MapError(
                f"{path}: its grid or its number of levels differs from {MANIFEST_NAME};"
                " rebuild the pack or copy it again"
            )
        return cog, intact

    def _verify(self, entry: RasterFile) -> list[str]:
        path = self.path / entry.file
        cog, intact = self.load(entry)
        with cog:
            if intact:
                tiles = [(block, "cannot be decoded") for block in cog.undecodable()]
                problems = []
            else:
                tiles = [
                    (block, "differs from the build") for block in sorted(cog.locate_damage(entry.crcs()))
                ]
                problems = [
                    f"{path}: SHA-256 differs from {MANIFEST_NAME}; rebuild the pack or copy it again"
                ]
        problems += [f"{path}: {describe(block)} {what}" for block, what in tiles[:_MAX_NAMED_TILES]]
        if len(tiles) > _MAX_NAMED_TILES:
            problems.append(f"{path}: {len(tiles) - _MAX_NAMED_TILES} more tiles")
        return problems
