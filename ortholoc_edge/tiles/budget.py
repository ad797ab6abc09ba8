"""How large a pack will be, from compressed samples of it; and what to give up so that it fits."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ortholoc_edge.errors import ConfigError
from ortholoc_edge.geometry.arrays import BoolArray
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles import encode
from ortholoc_edge.tiles.features import bytes_per_mpx
from ortholoc_edge.tiles.lattice import CROP_PX, LEVELS, PixelBox
from ortholoc_edge.tiles.mosaic import dop_mosaic, dsm_mosaic
from ortholoc_edge.tiles.plan import LayerPlan, Plan
from ortholoc_edge.tiles.prepare import prepare

# (K, H, W) values and their validity (H, W).
_Sample = tuple[npt.NDArray[Any], BoolArray]

# Samples per layer, spread over its tiles, and their side. A tile's own overviews are counted in.
_SAMPLES = 12
_SAMPLE_PX = 512
# 1-sigma of the estimate is the scatter of the samples; a budget is met with two of them to spare.
_SIGMAS = 2.0
# STAC, mosaics, reports and the manifest's entry.
_BYTES_PER_TILE = 12_000

_QUALITIES = (85, 75, 65, 55, 45)
_Z_ERRORS_M = (0.02, 0.05, 0.1)
_COARSENINGS = (1, 2, 4, 8)


@dataclass(frozen=True, slots=True)
class Estimate:
    """Bytes of a pack and their 1-sigma."""

    dop_bytes: float
    dsm_bytes: float
    feature_bytes: float
    other_bytes: float
    sigma_bytes: float

    @property
    def bytes(self) -> float:
        return self.dop_bytes + self.dsm_bytes + self.feature_bytes + self.other_bytes


@dataclass(frozen=True, slots=True)
class Settings:
    """What a size depends on."""

    dop_gsd_m: float
    dsm_gsd_m: float
    compression: encode.Compression
    quality: int
    max_z_error_m: float
    features_per_mpx: float = 0.0


class Sampler:
    """Samples of a plan's layers at its own pixel sizes, read once and compressed as often as asked."""

    def __init__(self, plan: Plan, folder: Path) -> None:
        """Read the samples. ``folder``: for sources that must be prepared first."""
        self._plan = plan
        self._dop: list[_Sample] = []
        self._dsm: list[_Sample] = []
        # Preparing looks at all of a source, which many samples may share.
        prepared = functools.cache(lambda source: prepare(source, folder))
        for index, box in _spread(plan.dop):
            grid = plan.dop.lattice.grid(box)
            sources = [prepared(plan.dop.sources[k]) for k in plan.dop.tiles[index].sources]
            picture = dop_mosaic(sources, grid, plan.crs, plan.area)
            self._dop.append((picture.rgb, picture.valid))
        for index, box in _spread(plan.dsm):
            grid = plan.dsm.lattice.grid(box)
            sources = [prepared(plan.dsm.sources[k]) for k in plan.dsm.tiles[index].sources]
            heights = dsm_mosaic(sources, grid, plan.crs, plan.area).heights
            self._dsm.append((heights[None], np.isfinite(heights)))

    def estimate(self, settings: Settings) -> Estimate:
        """Size at settings whose pixel sizes are the plan's times a power of two."""
        dop_mean, dop_sigma = self._layer(self._plan.dop, settings.dop_gsd_m, self._dop, settings)
        dsm_mean, dsm_sigma = self._layer(self._plan.dsm, settings.dsm_gsd_m, self._dsm, settings)
        shrink = (self._plan.dop.lattice.pixel_m / settings.dop_gsd_m) ** 2
        valid = float(np.mean([valid.mean() for _, valid in self._dop]))
        mpx = self._plan.dop.pixels * valid * shrink / 1e6
        features = mpx * bytes_per_mpx(settings.features_per_mpx)
        tiles = len(self._plan.dop.tiles) * max(shrink, 0.25) + len(self._plan.dsm.tiles)
        return Estimate(
            dop_mean, dsm_mean, features, tiles * _BYTES_PER_TILE, float(np.hypot(dop_sigma, dsm_sigma))
        )

    def _layer(
        self, layer: LayerPlan, gsd_m: float, samples: list[_Sample], settings: Settings
    ) -> tuple[float, float]:
        """Mean and 1-sigma of a layer's bytes."""
        factor = max(round(gsd_m / layer.lattice.pixel_m), 1)
        per_pixel = []
        for values, valid in samples:
            small = _shrunk(values.astype(np.float32), factor)
            # Not at 0, 0, which with pixels of 1 m would be no georeference.
            grid = RasterGrid(small.shape[2], small.shape[1], gsd_m, gsd_m, gsd_m, -gsd_m)
            if values.dtype == np.uint8:
                there = _shrunk(valid[None].astype(np.float32), factor)[0] >= 0.5
                picture = np.rint(small).astype(np.uint8)
                data = encode.dop_cog(picture, there, grid, None, settings.compression, settings.quality)
            else:
                data = encode.dsm_cog(small[0], grid, None, settings.max_z_error_m)
            per_pixel.append(len(data) / valid.size)
        mean = float(np.mean(per_pixel)) * layer.pixels
        sigma = float(np.std(per_pixel)) / np.sqrt(len(per_pixel)) * layer.pixels
        return mean, float(sigma)


def settings_within(sampler: Sampler, wanted: Settings, max_bytes: int) -> tuple[Settings, Estimate]:
    """The best settings, not above the wanted ones, whose pack fits.

    A coarser pixel comes after quality: at 45 a WEBP still shows more of the ground than the same picture at half
    the resolution. Raises: ConfigError if nothing fits.
    """
    smallest: Estimate | None = None
    for settings in _candidates(wanted):
        found = sampler.estimate(settings)
        if found.bytes + _SIGMAS * found.sigma_bytes <= max_bytes:
            return settings, found
        smallest = found
    assert smallest is not None, "there is a candidate"
    raise ConfigError(
        f"--max-size {max_bytes / 1e6:.1f} MB: even at the coarsest pixels tried the pack takes about"
        f" {smallest.bytes / 1e6:.1f} MB; choose a smaller --area or a larger size"
    )


def _candidates(wanted: Settings) -> Iterator[Settings]:
    qualities = [wanted.quality, *(q for q in _QUALITIES if q < wanted.quality)]
    errors = [wanted.max_z_error_m, *(e for e in _Z_ERRORS_M if e > wanted.max_z_error_m)]
    for factor in _COARSENINGS:
        coarser = replace(wanted, dop_gsd_m=wanted.dop_gsd_m * factor, dsm_gsd_m=wanted.dsm_gsd_m * factor)
        for k in range(max(len(qualities), len(errors))):
            yield replace(
                coarser,
                quality=qualities[min(k, len(qualities) - 1)],
                max_z_error_m=errors[min(k, len(errors) - 1)],
            )


def _spread(layer: LayerPlan) -> list[tuple[int, PixelBox]]:
    """Tiles spread evenly over the layer, and a box near the middle of each."""
    count = min(_SAMPLES, len(layer.tiles))
    boxes = []
    for k in range(_SAMPLES):
        index = (2 * k + 1) * len(layer.tiles) // (2 * _SAMPLES) if count == _SAMPLES else k % count
        box = layer.tiles[index].box
        width, height = min(_SAMPLE_PX, box.width), min(_SAMPLE_PX, box.height)
        # Several samples of one tile lie apart along its diagonal.
        part = (k // count + 0.5) / -(-_SAMPLES // count)
        column = box.column + int((box.width - width) * part) // CROP_PX * CROP_PX
        row = box.row + int((box.height - height) * part) // CROP_PX * CROP_PX
        if (index, PixelBox(column, row, width, height)) not in boxes:
            boxes.append((index, PixelBox(column, row, width, height)))
    return boxes


def _shrunk(values: npt.NDArray[Any], factor: int) -> npt.NDArray[Any]:
    """Means over blocks of a stack (K, H, W), its sides padded to the multiples of 16 that a tile needs."""
    count, rows, columns = values.shape
    blocks = values[:, : rows // factor * factor, : columns // factor * factor]
    blocks = blocks.reshape(count, rows // factor, factor, columns // factor, factor).mean(axis=(2, 4))
    pads = [(0, 0), *((0, -side % 2 ** (LEVELS - 1)) for side in blocks.shape[1:])]
    return np.pad(blocks, pads, mode="edge")
