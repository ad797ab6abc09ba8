"""Packs of arrays, written without the builder: what the side that flies is tested with."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ortholoc_edge.tiles import encode
from ortholoc_edge.tiles.cog import Cog
from ortholoc_edge.tiles.georeference import VerticalDatum
from ortholoc_edge.tiles.lattice import LEVELS, Lattice, PixelBox
from ortholoc_edge.tiles.levels import STORED_LEVELS
from ortholoc_edge.tiles.manifest import (
    FORMAT,
    MANIFEST_NAME,
    VERSION,
    Dop,
    DopTile,
    Dsm,
    DsmTile,
    FileNote,
    Manifest,
    SourceNote,
    encode_crcs,
    write_manifest,
)
from ortholoc_edge.tiles.pack import Pack

CRS = "EPSG:32633"
# Pixel (0, 0) of the arrays lies inside of the first tile, so that tiles at the rim are cropped.
DOP_LATTICE = Lattice(west=400_000.0, top=5_300_000.0, pixel_m=0.25, tile_px=512, levels=LEVELS)
DSM_LATTICE = Lattice(west=400_000.0, top=5_300_000.0, pixel_m=1.0, tile_px=128, levels=LEVELS)
DOP_CORNER, DSM_CORNER = (320, 128), (64, 0)
VERTICAL = VerticalDatum(
    kind="orthometric", amsl_minus_map_m=0.0, ellipsoid_minus_map_m=46.0, derivation="test", amsl_sigma_m=1.0
)


def write_pack(
    folder: Path,
    rgb: np.ndarray,
    heights: np.ndarray,
    *,
    valid: np.ndarray | None = None,
    dop_lattice: Lattice = DOP_LATTICE,
    dsm_lattice: Lattice = DSM_LATTICE,
    dop_corner: tuple[int, int] = DOP_CORNER,
    dsm_corner: tuple[int, int] = DSM_CORNER,
    crs: str | None = CRS,
    vertical: VerticalDatum = VERTICAL,
    offsets: Mapping[tuple[int, int], tuple[float | None, float | None]] | None = None,
    leave_out: frozenset[tuple[str, int, int]] = frozenset(),
    files: Mapping[str, bytes] | None = None,
    max_z_error_m: float = 0.01,
    stored: tuple[int, ...] = STORED_LEVELS,
    **changes: Any,
) -> Pack:
    """Write a pack of lossless DOP tiles and DSM tiles.

    Args:
        rgb: (3, H, W) uint8; heights: (h, w) float32, NaN where there are none; sides are multiples of 64.
        valid: (H, W) bool of the DOP.
        dop_corner, dsm_corner: column and row of the arrays' first pixel on the lattices.
        offsets: (amsl, ellipsoid) by key of the DSM's tiles.
        leave_out: (layer, column, row) of tiles that the pack does not have, counted in tiles.
        files: others, to be written and listed.
        stored: levels that the tiles hold.
        changes: of the manifest.
    """
    folder.mkdir(parents=True, exist_ok=True)
    valid = np.ones(rgb.shape[1:], dtype=bool) if valid is None else valid
    dop_tiles, dsm_tiles = [], []
    box = PixelBox(*dop_corner, rgb.shape[2], rgb.shape[1])
    for tile in dop_lattice.tiles(box):
        if ("dop", *dop_lattice.tile_key(tile.column, tile.row)) in leave_out:
            continue
        at = _slices(tile, dop_corner)
        data = encode.dop_cog(rgb[:, *at], valid[at], dop_lattice.grid(tile), crs, "webp", 100, stored)
        dop_tiles.append(
            DopTile(
                **_note(folder, f"dop/{dop_lattice.tile_name(tile)}.tif", data),
                **tile._asdict(),
                **_contents(data, float(valid[at].mean())),
            )
        )
    box = PixelBox(*dsm_corner, heights.shape[1], heights.shape[0])
    for tile in dsm_lattice.tiles(box):
        key = dsm_lattice.tile_key(tile.column, tile.row)
        if ("dsm", *key) in leave_out:
            continue
        part = heights[_slices(tile, dsm_corner)]
        data = encode.dsm_cog(part, dsm_lattice.grid(tile), crs, max_z_error_m, stored)
        known = part[np.isfinite(part)]
        amsl, ellipsoid = (offsets or {}).get(key, (None, None))
        dsm_tiles.append(
            DsmTile(
                **_note(folder, f"dsm/{dsm_lattice.tile_name(tile)}.tif", data),
                **tile._asdict(),
                **_contents(data, len(known) / part.size),
                min_m=float(known.min(initial=math.inf)) if len(known) else 0.0,
                max_m=float(known.max(initial=-math.inf)) if len(known) else 0.0,
                amsl_minus_map_m=amsl,
                ellipsoid_minus_map_m=ellipsoid,
            )
        )
    west, south, east, north = dop_lattice.grid(PixelBox(*dop_corner, rgb.shape[2], rgb.shape[1])).bounds
    fields: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "created": None,
        "crs": crs,
        "anchor": (round((west + east) / 2, -1), round((south + north) / 2, -1)),
        "vertical": vertical,
        "dop": Dop(
            lattice=dop_lattice,
            stored_levels=stored,
            compression="WEBP lossless",
            sources=[SourceNote(name="dop.tif")],
            tiles=dop_tiles,
        ),
        "dsm": Dsm(
            lattice=dsm_lattice,
            stored_levels=stored,
            compression="LERC_ZSTD",
            sources=[SourceNote(name="dsm.tif")],
            tiles=dsm_tiles,
            max_z_error_m=max_z_error_m,
            nodata=encode.NODATA,
        ),
        "files": [FileNote(**_note(folder, name, data)) for name, data in (files or {}).items()],
    }
    write_manifest(Manifest(**(fields | changes)), folder / MANIFEST_NAME)
    return Pack.open(folder)


def _slices(tile: PixelBox, corner: tuple[int, int]) -> tuple[slice, slice]:
    column, row = tile.column - corner[0], tile.row - corner[1]
    return slice(row, row + tile.height), slice(column, column + tile.width)


def _note(folder: Path, name: str, data: bytes) -> dict[str, Any]:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return {"file": name} | contents_note(data)


def contents_note(data: bytes) -> dict[str, Any]:
    """What a manifest says of a file's bytes."""
    return {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def _contents(data: bytes, valid_fraction: float) -> dict[str, Any]:
    with Cog(data, Path("tile")) as cog:
        return {"valid_fraction": valid_fraction, "segment_crc32": encode_crcs(cog.segment_crcs())}
