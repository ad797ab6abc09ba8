"""What area packs cost and give: quality against size, memory, reads, building.

Measured on what is flown: packs that the builder wrote, read by the store, localized by the pipeline.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from affine import Affine
from msgspec import Struct
from rasterio.errors import RasterioError

from ortholoc_edge.bench import sequence
from ortholoc_edge.bench.pack_process import ANY_BYTES, pack_km2
from ortholoc_edge.bench.replay import FrameResult, PriorKind, PriorNoise
from ortholoc_edge.bench.runner import run_flight
from ortholoc_edge.errors import DatasetError
from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray
from ortholoc_edge.matching.types import AnyMatcher
from ortholoc_edge.parallel import Workers
from ortholoc_edge.pipeline.localizer import LocalizerOptions
from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import CACHE_BYTES, MapStore

_MB = 1e6
_BOOTSTRAPS = 4000


# --- quality against size ---


@dataclass(frozen=True, slots=True)
class Variant:
    """A way to build a pack. ``name`` for people; ``features`` whether the localizer uses precomputed ones."""

    name: str
    options: PackOptions

    @property
    def features(self) -> bool:
        return self.options.features is not None


def variants(
    qualities: Sequence[int],
    jpeg: Sequence[int],
    z_errors_m: Sequence[float],
    features: Sequence[float],
    matcher: str,
    quality: int = PackOptions().quality,
) -> list[Variant]:
    """The reference first: lossless DOP, DSM to a tenth of a millimetre. Then one thing at a time is changed.

    Args:
        qualities, jpeg: of WEBP and JPEG, with the builder's own DSM error.
        z_errors_m: with WEBP of ``quality``.
        features: per million pixels, precomputed for ``matcher``, with WEBP of ``quality``.
    """
    plain = PackOptions(vertical="unknown", max_z_error_m=0.05, quality=quality)
    found = [Variant("reference: lossless, 0.1 mm", replace(plain, quality=100, max_z_error_m=1e-4))]
    found += [Variant(f"WEBP {q}, DSM 5 cm", replace(plain, quality=q)) for q in qualities]
    found += [Variant(f"JPEG {q}, DSM 5 cm", replace(plain, quality=q, dop_compression="jpeg")) for q in jpeg]
    found += [
        Variant(f"WEBP {plain.quality}, DSM {100 * z:g} cm", replace(plain, max_z_error_m=z))
        for z in z_errors_m
        if z != plain.max_z_error_m or plain.quality not in qualities
    ]
    found += [
        Variant(
            f"WEBP {plain.quality}, DSM 5 cm, features {n:g}/Mpx",
            replace(plain, features=matcher, features_per_mpx=n),
        )
        for n in features
    ]
    return found


class SizeRow(Struct, frozen=True, kw_only=True):
    """What one variant came to.

    Attributes:
        mb_per_km2: of DOP, DSM and features, per km2 of orthophoto; ``beside_mb`` is all else in the pack, which
            hardly grows with the area.
        te_ratio: median TE over the reference's; te_ratio_low, te_ratio_high: 95 % by bootstrap over the photos.
        frame_ratio: median over frames of TE over the same frame's with the reference, and its interval.
    """

    variant: str
    frames: int
    dop_mb_per_km2: float
    dsm_mb_per_km2: float
    features_mb_per_km2: float
    beside_mb: float
    recall: float
    te_median_m: float
    re_median_deg: float
    te_ratio: float
    te_ratio_low: float
    te_ratio_high: float
    frame_ratio: float
    frame_ratio_low: float
    frame_ratio_high: float

    @property
    def mb_per_km2(self) -> float:
        return self.dop_mb_per_km2 + self.dsm_mb_per_km2 + self.features_mb_per_km2


@dataclass(slots=True)
class Measured:
    """Errors of one variant on one flight: (seeds, photos), infinite without a fix; and its sizes."""

    te_m: FloatArray
    re_deg: FloatArray
    km2: float
    dop_bytes: int
    dsm_bytes: int
    feature_bytes: int
    beside_bytes: int


def coarsened(folder: Path, dop: Path, dsm: Path, dop_gsd_m: float, dsm_gsd_m: float) -> tuple[Path, Path]:
    """Copies of a flight's rasters at the pixel sizes of public geodata, by averaging whole blocks of pixels.

    Returns: paths of DOP (with a mask) and DSM (nodata -9999) in ``folder``.
    Raises: DatasetError for rasters whose pixels are no whole fraction.
    """
    try:
        with rasterio.open(dop) as source:
            step = _step(source, dop_gsd_m)
            rgb, valid = source.read([1, 2, 3]), source.dataset_mask() > 0
            transform, crs = source.transform, source.crs
        shown, share = _block_means(rgb.astype(np.float32), valid, step)
        # A pixel at the edge of the data counts where most of it has data.
        full = share >= 0.5
        picture: ImageArray = np.clip(np.round(shown), 0, 255).astype(np.uint8) * full
        out_dop = folder / "coarse_dop.tif"
        with (
            rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
            rasterio.open(out_dop, "w", **_profile(picture, transform, step, crs), photometric="RGB") as target,
        ):
            target.write(picture)
            target.write_mask(full)
        with rasterio.open(dsm) as source:
            step = _step(source, dsm_gsd_m)
            heights, valid = source.read([1]), source.dataset_mask() > 0
            transform, crs = source.transform, source.crs
        means, share = _block_means(heights.astype(np.float32), valid, step)
        surface: Float32Array = np.where(share >= 0.5, means, -9999.0).astype(np.float32)
        out_dsm = folder / "coarse_dsm.tif"
        with rasterio.open(out_dsm, "w", **_profile(surface, transform, step, crs), nodata=-9999.0) as target:
            target.write(surface)
    except (RasterioError, OSError) as err:
        raise DatasetError(f"{dop.parent}: rasters can't be read or written ({err})") from err
    return out_dop, out_dsm


def _step(source: Any, gsd_m: float) -> int:
    ratio = gsd_m / source.transform.a
    if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6:
        raise DatasetError(f"{source.name}: pixels of {source.transform.a} m don't make up {gsd_m} m")
    step: int = round(ratio)
    return step


def _block_means(bands: Float32Array, valid: BoolArray, step: int) -> tuple[Float32Array, Float32Array]:
    """Means (C, h, w) over what is valid of blocks of ``step`` x ``step`` pixels, and that share (h, w)."""
    rows, columns = valid.shape[0] // step, valid.shape[1] // step
    four = (rows, step, columns, step)
    weight = valid[: rows * step, : columns * step].reshape(four).sum(axis=(1, 3)).astype(np.float32)
    cut = np.where(valid, bands, 0)[:, : rows * step, : columns * step]
    sums = cut.reshape(len(bands), *four).sum(axis=(2, 4), dtype=np.float64)
    return (sums / np.maximum(weight, 1)).astype(np.float32), weight / step**2


def _profile(bands: Any, transform: Affine, step: int, crs: Any) -> dict[str, Any]:
    return {
        "driver": "GTiff",
        "count": len(bands),
        "height": bands.shape[1],
        "width": bands.shape[2],
        "dtype": bands.dtype,
        "crs": crs,
        "transform": Affine(transform.a * step, 0.0, transform.c, 0.0, transform.e * step, transform.f),
        "compress": "deflate",
        "tiled": True,
    }


def measure_variant(
    flight: Path, pack: Pack, matcher: AnyMatcher, features: bool, kind: PriorKind, seeds: int, adhop: bool = True
) -> Measured:
    """Localize a flight on a pack with several seeds of all noise."""
    recorded = sequence.read_flight(flight)
    with MapStore(pack, features=features, memory_bytes=ANY_BYTES) as store:
        runs = [
            [
                _error(r)
                for r in run_flight(recorded, store, matcher, LocalizerOptions(adhop=adhop), kind, PriorNoise(), seed)
            ]
            for seed in range(seeds)
        ]
    errors = np.array(runs)
    manifest = pack.manifest
    features_of = [] if manifest.features is None else manifest.features.tiles
    return Measured(
        errors[..., 0],
        errors[..., 1],
        pack_km2(pack),
        sum(t.bytes for t in manifest.dop.tiles),
        sum(t.bytes for t in manifest.dsm.tiles),
        sum(t.bytes for t in features_of),
        sum(f.bytes for f in manifest.files),
    )


def _error(result: FrameResult) -> tuple[float, float]:
    return (np.inf, np.inf) if result.error is None else (result.error.te_m, result.error.re_deg)


def size_row(name: str, measured: Sequence[Measured], reference: Sequence[Measured], seed: int = 0) -> SizeRow:
    """A row from one flight, or from several together (their photos pooled, their sizes added)."""
    te = np.concatenate([m.te_m for m in measured], axis=1)
    re = np.concatenate([m.re_deg for m in measured], axis=1)
    base = np.concatenate([m.te_m for m in reference], axis=1)
    km2 = sum(m.km2 for m in measured)
    rng = np.random.default_rng(seed)
    photos = te.shape[1]
    # Whole photos are drawn, with all their seeds: a photo's runs resemble one another.
    drawn = [rng.integers(0, photos, photos) for _ in range(_BOOTSTRAPS)] if photos > 1 else [np.arange(photos)]
    totals = np.array([_ratio_of_medians(te[:, k], base[:, k]) for k in drawn])
    singles = np.array([_median_ratio(te[:, k], base[:, k]) for k in drawn])
    good = (te <= 1.0) & (re <= 1.0)
    return SizeRow(
        variant=name,
        frames=te.size,
        dop_mb_per_km2=sum(m.dop_bytes for m in measured) / _MB / km2,
        dsm_mb_per_km2=sum(m.dsm_bytes for m in measured) / _MB / km2,
        features_mb_per_km2=sum(m.feature_bytes for m in measured) / _MB / km2,
        beside_mb=sum(m.beside_bytes for m in measured) / _MB,
        recall=float(good.mean()),
        te_median_m=_median(te),
        re_median_deg=_median(re),
        te_ratio=_ratio_of_medians(te, base),
        te_ratio_low=_percentile(totals, 2.5),
        te_ratio_high=_percentile(totals, 97.5),
        frame_ratio=_median_ratio(te, base),
        frame_ratio_low=_percentile(singles, 2.5),
        frame_ratio_high=_percentile(singles, 97.5),
    )


def _median(errors: FloatArray) -> float:
    finite = errors[np.isfinite(errors)]
    return float(np.median(finite)) if finite.size else float("nan")


def _percentile(values: FloatArray, percent: float) -> float:
    finite = values[np.isfinite(values)]
    return float(np.percentile(finite, percent)) if finite.size else float("nan")


def _both(te: FloatArray, base: FloatArray) -> BoolArray:
    return np.asarray(np.isfinite(te) & np.isfinite(base), dtype=bool)


def _ratio_of_medians(te: FloatArray, base: FloatArray) -> float:
    """Over the frames that both fixed: recall says what one of them lost."""
    both = _both(te, base)
    return float(np.median(te[both]) / np.median(base[both])) if both.any() else float("nan")


def _median_ratio(te: FloatArray, base: FloatArray) -> float:
    both = _both(te, base)
    return float(np.median(te[both] / base[both])) if both.any() else float("nan")


# --- reads ---


class ReadRow(Struct, frozen=True, kw_only=True):
    """Wall times of reading windows of one level, ms."""

    level: int
    gsd_m: float
    windows: int
    cold_median_ms: float
    cold_p99_ms: float
    warm_median_ms: float
    warm_p99_ms: float


def measure_reads(
    pack: Pack, *, windows: int, size_px: tuple[int, int] = (640, 480), cache_bytes: int = CACHE_BYTES, seed: int = 0
) -> Iterator[ReadRow]:
    """Read windows of ``size_px`` DOP pixels with their DSM, at places with data: once with an empty cache of decoded
    blocks, then again."""
    rng = np.random.default_rng(seed)
    tiles = pack.manifest.dop.tiles
    lattice = pack.manifest.dop.lattice
    weights = np.array([t.width * t.height * t.valid_fraction for t in tiles])
    with MapStore(pack, memory_bytes=ANY_BYTES, cache_bytes=cache_bytes) as store:
        for level, grid in enumerate(store.dop_grids):
            half = np.array(size_px) * grid.gsd_m / 2
            cold, warm = [], []
            for _ in range(windows):
                tile = lattice.grid(tiles[int(rng.choice(len(tiles), p=weights / weights.sum()))].box).bounds
                at = rng.uniform(tile[:2], tile[2:])
                bounds = (at[0] - half[0], at[1] - half[1], at[0] + half[0], at[1] + half[1])
                store.forget_decoded()
                cold.append(_timed_ms(store, bounds, grid.gsd_m))
                warm.append(_timed_ms(store, bounds, grid.gsd_m))
            yield ReadRow(
                level=level,
                gsd_m=grid.gsd_m,
                windows=windows,
                cold_median_ms=float(np.median(cold)),
                cold_p99_ms=float(np.percentile(cold, 99)),
                warm_median_ms=float(np.median(warm)),
                warm_p99_ms=float(np.percentile(warm, 99)),
            )


def _timed_ms(store: MapStore, bounds: tuple[float, float, float, float], gsd_m: float) -> float:
    start = time.perf_counter()
    store.read(bounds, gsd_m)
    return (time.perf_counter() - start) * 1e3


# --- building ---


class BuildRow(Struct, frozen=True, kw_only=True):
    """One build. ``where``: "processes" or "Dask"; ``workers`` of them, one thread each."""

    where: str
    workers: int
    km2: float
    wall_s: float
    megabytes: float

    @property
    def km2_per_minute(self) -> float:
        return self.km2 / self.wall_s * 60

    @property
    def km2_per_minute_per_core(self) -> float:
        return self.km2_per_minute / self.workers


def measure_build(
    dop: Sequence[Path], dsm: Sequence[Path], out: Path, options: PackOptions, workers: int, dask: str | None = None
) -> BuildRow:
    """Build a pack at ``out``, which must not exist. Wall time of all of it: looking at the sources, work, checks."""
    start = time.perf_counter()
    pack = build_pack(dop, dsm, out, options, None, Workers(1 if dask else workers, dask))
    wall_s = time.perf_counter() - start
    return BuildRow(
        where="Dask" if dask else "processes",
        workers=workers,
        km2=pack_km2(pack),
        wall_s=wall_s,
        megabytes=sum(note.bytes for note in pack.manifest.notes()) / _MB,
    )
