"""A small pack in the system of a survey office: what sidecars are made from, and checked against."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import packs

from ortholoc_edge.tiles.georeference import Georeference, VerticalDatum
from ortholoc_edge.tiles.lattice import Lattice
from ortholoc_edge.tiles.manifest import MANIFEST_NAME, Manifest, SourceNote, write_manifest

CRS = "EPSG:25832"
VERTICAL = VerticalDatum(kind="orthometric", name="DHHN2016 height", epsg=7837)
DOP_LATTICE = Lattice(west=691_200.0, top=5_335_040.0, pixel_m=0.2, tile_px=512, levels=5)
DSM_LATTICE = Lattice(west=691_200.0, top=5_335_040.0, pixel_m=1.0, tile_px=512, levels=5)


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
    """Three DOP tiles, cropped, with a masked patch, where a rectangle would have four; one DSM tile with a hole."""
    rows, columns = np.mgrid[0:256, 0:320]
    # Equal within 16 x 16 pixels, so that every overview has exactly these colours too.
    rgb = np.stack([columns // 16 * 10, rows // 16 * 12, 200 - columns // 16 * 5]).astype(np.uint8)
    valid = np.ones((256, 320), dtype=bool)
    valid[192:, 128:] = False
    valid[32:64, 112:160] = False
    heights = (400.0 + np.mgrid[0:128, 0:128][0] // 16).astype(np.float32)
    heights[16:48, 32:64] = np.nan
    pack = packs.write_pack(
        folder,
        rgb,
        heights,
        valid=valid,
        dop_lattice=DOP_LATTICE,
        dsm_lattice=DSM_LATTICE,
        dop_corner=(384, 320),
        dsm_corner=(64, 64),
        crs=crs,
        vertical=VERTICAL,
        leave_out=frozenset({("dop", 1, 1)}),
        max_z_error_m=0.0,
    )
    dop, dsm = pack.manifest.dop, pack.manifest.dsm
    shown = tuple(range(len(dop_sources)))
    tiles = [msgspec.structs.replace(tile, sources=shown) for tile in dop.tiles]
    dop = msgspec.structs.replace(dop, tiles=tiles, sources=list(dop_sources), **dop_options)
    dsm = msgspec.structs.replace(dsm, sources=list(dsm_sources))
    manifest = msgspec.structs.replace(pack.manifest, dop=dop, dsm=dsm)
    write_manifest(manifest, folder / MANIFEST_NAME)
    return Written(folder, manifest, pack.georeference, rgb, valid, heights)


def source(name: str, date: str | None) -> SourceNote:
    return SourceNote(name=name, date=date, crs=CRS, gsd_m=0.2)
