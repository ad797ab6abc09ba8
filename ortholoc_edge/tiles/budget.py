"""How large a pack will be, from compressed samples of it; and what to give up so that it fits."""

from __future__ import annotations

import functools
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
_SAMPLES = 32
_SAMPLE_PX = 512
# Steps of a sequence that fills a square evenly, however far it is followed.
_GOLDEN = 0.7548776662466927, 0.5698402909980532
# 1-sigma of the estimate: the scatter of the samples, and what remains where they do not scatter (small blocks
# compress worse). A budget is met with two of them to spare.
_SYSTEMATIC = 0.04
_SIGMAS = 2.0
# STAC, mosaics, reports and the manifest's entry.
_BYTES_PER_TILE = 9_000

_QUALITIES = (85, 75, 65, 55, 45)
_Z_ERRORS_M = (0.02, 0.05, 0.1)
# Pixels of DSM and DOP of public geodata: 1 m and 20 cm.
_MAX_DSM_RATIO = 5.0
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
        # Bytes and their 1-sigma by what they depend on.
        self._known: dict[tuple[object, ...], tuple[float, float]] = {}
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
        self._dop, self._dsm = _joined(self._dop), _joined(self._dsm)

    def estimate(self, settings: Settings) -> Estimate:
        """Size at settings whose pixel sizes are the plan's times a power of two."""
        dop_key = settings.dop_gsd_m, settings.compression, settings.quality
        if dop_key not in self._known:
            self._known[dop_key] = self._layer(self._plan.dop, settings.dop_gsd_m, self._dop, settings)
        dsm_key = settings.dsm_gsd_m, settings.max_z_error_m
        if dsm_key not in self._known:
            self._known[dsm_key] = self._layer(self._plan.dsm, settings.dsm_gsd_m, self._dsm, settings)
        (dop_mean, dop_sigma), (dsm_mean, dsm_sigma) = self._known[dop_key], self._known[dsm_key]
        shrink = (self._plan.dop.lattice.pixel_m / settings.dop_gsd_m) ** 2
        valid = float(np.mean([valid.mean() for _, valid in self._dop]))
        mpx = self._plan.dop.pixels * valid * shrink / 1e6
        features = mpx * bytes_per_mpx(settings.features_per_mpx)
        # Coarser pixels do not make fewer tiles, but for the first step: their sides are some 800 m.
        tiles = len(self._plan.dop.tiles) + len(self._plan.dsm.tiles)
        return Estimate(
            dop_mean, dsm_mean, features, tiles * _BYTES_PER_TILE, float(np.hypot(dop_sigma, dsm_sigma))
        )

    def _layer(
        self, layer: LayerPlan, gsd_m: float, samples: list[_Sample], settings: Settings
    ) -> tuple[float, float]:
        """Mean and 1-sigma of a layer's bytes."""
        factor = max(round(gsd_m / layer.lattice.pixel_m), 1)
        # What a file takes whatever its size counts once per tile, not once per sample, of which hundreds fill one.
        values, valid = samples[0]
        empty = _compressed(np.zeros_like(values[:, :16, :16]), np.ones((16, 16), bool), gsd_m, settings)
        per_pixel = []
        for values, valid in samples:
            small = _shrunk(values.astype(np.float32), factor).astype(np.float32)
            there = _shrunk(valid[None].astype(np.float32), factor)[0] >= 0.5
            if values.dtype == np.uint8:
                small = np.rint(small).astype(np.uint8)
            per_pixel.append(max(_compressed(small, there, gsd_m, settings) - empty, 0) / valid.size)
        mean = float(np.mean(per_pixel)) * layer.pixels
        sigma = float(np.std(per_pixel)) / np.sqrt(len(per_pixel)) * layer.pixels
        return mean + len(layer.tiles) * empty, float(np.hypot(sigma, _SYSTEMATIC * mean))


def _compressed(values: npt.NDArray[Any], valid: BoolArray, gsd_m: float, settings: Settings) -> int:
    """Bytes of an orthophoto (3, H, W) uint8 or of heights (1, H, W) as a tile."""
    # Not at 0, 0, which with pixels of 1 m would be no georeference.
    grid = RasterGrid(values.shape[2], values.shape[1], gsd_m, gsd_m, gsd_m, -gsd_m)
    if values.dtype == np.uint8:
        return len(encode.dop_cog(values, valid, grid, None, settings.compression, settings.quality))
    return len(encode.dsm_cog(values[0], grid, None, settings.max_z_error_m))


def settings_within(sampler: Sampler, wanted: Settings, max_bytes: int) -> tuple[Settings, Estimate]:
    """The best settings, not above the wanted ones, whose pack fits.

    A coarser pixel comes after quality: at 45 a WEBP still shows more of the ground than the same picture at half
    the resolution. Raises: ConfigError if nothing fits.
    """
    smallest: Estimate | None = None
    for factor in _COARSENINGS:
        candidates = _candidates(wanted, factor)
        smallest = sampler.estimate(candidates[-1])
        if not _fits(smallest, max_bytes):
            continue
        found = ((settings, sampler.estimate(settings)) for settings in candidates)
        return next((one for one in found if _fits(one[1], max_bytes)), (candidates[-1], smallest))
    assert smallest is not None, "there is a candidate"
    raise ConfigError(
        f"--max-size {max_bytes / 1e6:.1f} MB: even at the coarsest pixels tried the pack takes about"
        f" {smallest.bytes / 1e6:.1f} MB; choose a smaller --area or a larger size"
    )


def _fits(estimate: Estimate, max_bytes: int) -> bool:
    return estimate.bytes + _SIGMAS * estimate.sigma_bytes <= max_bytes


def _candidates(wanted: Settings, factor: int) -> list[Settings]:
    """With pixels coarser by ``factor``, from the best to the smallest."""
    qualities = [wanted.quality, *(q for q in _QUALITIES if q < wanted.quality)]
    errors = [wanted.max_z_error_m, *(e for e in _Z_ERRORS_M if e > wanted.max_z_error_m)]
    dop_gsd_m = wanted.dop_gsd_m * factor
    # A surface model that is coarse beside the orthophoto costs little, and has nothing to spare.
    fitting = [k for k in _COARSENINGS if k <= factor and wanted.dsm_gsd_m * k <= _MAX_DSM_RATIO * dop_gsd_m]
    coarser = replace(wanted, dop_gsd_m=dop_gsd_m, dsm_gsd_m=wanted.dsm_gsd_m * max(fitting, default=1))
    return [
        replace(coarser, quality=qualities[min(k, len(qualities) - 1)], max_z_error_m=errors[min(k, len(errors) - 1)])
        for k in range(max(len(qualities), len(errors)))
    ]


def _spread(layer: LayerPlan) -> list[tuple[int, PixelBox]]:
    """Boxes spread evenly over the layer's area, each with the index of its tile."""
    ends = np.cumsum([tile.box.width * tile.box.height for tile in layer.tiles])
    # No more of them than would cover it once.
    count = min(_SAMPLES, -(-int(ends[-1]) // _SAMPLE_PX**2))
    boxes: dict[tuple[int, PixelBox], None] = {}
    for k in range(count):
        index = int(np.searchsorted(ends, (k + 0.5) / count * ends[-1]))
        box = layer.tiles[index].box
        width, height = min(_SAMPLE_PX, box.width), min(_SAMPLE_PX, box.height)
        # Along rows and columns of their own: samples on a line would miss what lies beside it.
        across, down = (_GOLDEN[0] * k + 0.5) % 1.0, (_GOLDEN[1] * k + 0.5) % 1.0
        column = box.column + round((box.width - width) * across) // CROP_PX * CROP_PX
        row = box.row + round((box.height - height) * down) // CROP_PX * CROP_PX
        boxes[index, PixelBox(column, row, width, height)] = None
    return list(boxes)


def _joined(samples: list[_Sample]) -> list[_Sample]:
    """Samples four by four, as a square: the overviews of a single one would be padding for the most part."""
    full = [one for one in samples if one[1].shape == (_SAMPLE_PX, _SAMPLE_PX)]
    rest = [one for one in samples if one[1].shape != (_SAMPLE_PX, _SAMPLE_PX)]
    groups = len(full) // 4
    squares = []
    for group in range(groups):
        # Far from each other, so that each square is like the whole.
        four = full[group::groups][:4]
        values, valid = (
            np.concatenate([np.concatenate([four[k][i], four[k + 1][i]], axis=-1) for k in (0, 2)], axis=-2)
            for i in (0, 1)
        )
        squares.append((values, valid))
    return [*squares, *full[4 * groups :], *rest]


def _shrunk(values: npt.NDArray[Any], factor: int) -> npt.NDArray[Any]:
    """Means over blocks of a stack (K, H, W), its sides padded to the multiples of 16 that a tile needs."""
    count, rows, columns = values.shape
    blocks = values[:, : rows // factor * factor, : columns // factor * factor]
    blocks = blocks.reshape(count, rows // factor, factor, columns // factor, factor).mean(axis=(2, 4))
    pads = [(0, 0), *((0, -side % 2 ** (LEVELS - 1)) for side in blocks.shape[1:])]
    return np.pad(blocks, pads, mode="edge")
