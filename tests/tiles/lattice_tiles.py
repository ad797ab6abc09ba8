"""A small pack's tiles on disk, without the builder: what sidecars are made from, and checked against."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ortholoc_edge.tiles.encode import NODATA, dop_cog, dsm_cog
from ortholoc_edge.tiles.georeference import Georeference, VerticalDatum
from ortholoc_edge.tiles.lattice import Lattice, PixelBox
from ortholoc_edge.tiles.manifest import (
    FORMAT,
    MANIFEST_NAME,
    VERSION,
    Dop,
    DopTile,
    Dsm,
    DsmTile,
    Manifest,
    SourceNote,
    encode_crcs,
    write_manifest,
)

CRS = "EPSG:25832"
VERTICAL = VerticalDatum(kind="orthometric", name="DHHN2016 height", epsg=7837)
# The corner of tiles, so that the pack below has a border in both directions.
DOP_LATTICE = Lattice(west=691_200.0, top=5_335_040.0, pixel_m=0.2, tile_px=512, levels=5)
DSM_LATTICE = Lattice(west=691_200.0, top=5_335_040.0, pixel_m=1.0, tile_px=512, levels=5)
# Rim tiles are cropped; one tile of the four is missing, as where an area is no rectangle.
DOP_BOXES = [PixelBox(384, 320, 128, 192), PixelBox(512, 320, 192, 192), PixelBox(384, 512, 128, 64)]
DSM_BOXES = [PixelBox(64, 64, 128, 128)]


@dataclass(frozen=True)
class Written:
    """``rgb`` (3, H, W), ``valid`` (H, W) and ``heights`` (H, W) over the layers' boxes, as given to the encoder."""

    folder: Path
    manifest: Manifest
    georeference: Georeference
    rgb: np.ndarray
    valid: np.ndarray
    heights: np.ndarray


def write_pack(folder: Path, crs: str | None = CRS, dop_sources=(), dsm_sources=(), **dop_options) -> Written:
    """Three DOP tiles with a masked patch and one DSM tile with a hole, and their manifest."""
    (folder / "dop").mkdir(parents=True)
    (folder / "dsm").mkdir()
    rows, columns = np.mgrid[0:256, 0:320]
    # Equal within 16 x 16 pixels, so that every overview has exactly these colours too.
    rgb = np.stack([columns // 16 * 10, rows // 16 * 12, 200 - columns // 16 * 5]).astype(np.uint8)
    valid = np.ones((256, 320), dtype=bool)
    valid[192:, 128:] = False
    valid[32:64, 112:160] = False
    heights = (400.0 + np.mgrid[0:128, 0:128][0] // 16).astype(np.float32)
    heights[16:48, 32:64] = np.nan

    dop_tiles = []
    for box in DOP_BOXES:
        part = np.s_[box.row - 320 : box.row - 320 + box.height, box.column - 384 : box.column - 384 + box.width]
        data = dop_cog(rgb[:, *part], valid[part], DOP_LATTICE.grid(box), crs, quality=100)
        note = _write(folder, f"dop/{DOP_LATTICE.tile_name(box)}.tif", data, box)
        share = float(valid[part].mean())
        dop_tiles.append(DopTile(**note, valid_fraction=share, sources=tuple(range(len(dop_sources)))))
    dsm_tiles = []
    for box in DSM_BOXES:
        data = dsm_cog(heights, DSM_LATTICE.grid(box), crs, 0.0)
        note = _write(folder, f"dsm/{DSM_LATTICE.tile_name(box)}.tif", data, box)
        dsm_tiles.append(DsmTile(**note, valid_fraction=0.9375, min_m=400.0, max_m=407.0))
    anchor = (691_300.0, 5_334_900.0)
    manifest = Manifest(
        format=FORMAT,
        version=VERSION,
        created=None,
        crs=crs,
        anchor=anchor,
        vertical=VERTICAL,
        dop=Dop(lattice=DOP_LATTICE, compression="webp", sources=list(dop_sources), tiles=dop_tiles, **dop_options),
        dsm=Dsm(
            lattice=DSM_LATTICE,
            compression="lerc_zstd",
            sources=list(dsm_sources),
            tiles=dsm_tiles,
            max_z_error_m=0.0,
            nodata=NODATA,
        ),
    )
    write_manifest(manifest, folder / MANIFEST_NAME)
    return Written(folder, manifest, Georeference(crs, VERTICAL, anchor), rgb, valid, heights)


def source(name: str, date: str | None) -> SourceNote:
    return SourceNote(name=name, date=date, crs=CRS, gsd_m=0.2)


def _write(folder: Path, name: str, data: bytes, box: PixelBox) -> dict:
    (folder / name).write_bytes(data)
    return {
        "file": name,
        "bytes": len(data),
        "sha256": hashlib.sha256(data).hexdigest(),
        "segment_crc32": encode_crcs([0]),
        **box._asdict(),
    }
