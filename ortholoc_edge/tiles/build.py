"""Two rasters to an area pack: two COGs and a manifest, complete or not there at all."""

from __future__ import annotations

import hashlib
import logging
import os
import re
import secrets
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import pyproj
import rasterio
import rasterio.shutil
from pyproj.exceptions import CRSError
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import RasterioError
from rasterio.windows import Window

from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.cog import BLOCK_PX, Cog, block_cache, quiet_georeference, raster_grid
from ortholoc_edge.tiles.collar import Collar, windows
from ortholoc_edge.tiles.georeference import (
    Georeference,
    VerticalDatum,
    VerticalKind,
    datum_shift_caveat,
    derive_vertical,
    projected_crs,
    vertical_of,
)
from ortholoc_edge.tiles.manifest import (
    FORMAT,
    MANIFEST_NAME,
    VERSION,
    Dop,
    Dsm,
    Grid,
    Manifest,
    encode_crcs,
    write_manifest,
)
from ortholoc_edge.tiles.pack import Pack

logger = logging.getLogger(__name__)

Progress = Callable[[float, str], None]

NODATA = -9999.0
_DOP_NAME, _DSM_NAME = "dop.tif", "dsm.tif"

# Values that programs write for "no data" and people forget to declare (-32768 and -32767 of int16 rasters,
# the lowest and highest float32).
_SENTINELS = (-9999.0, -32767.0, -32768.0)
_SENTINEL_MAGNITUDE = 1e30
# The Dead Sea's shore lies at -430 m, Everest at 8849 m.
_MIN_HEIGHT_M, _MAX_HEIGHT_M = -500.0, 9000.0
# Of the cells with data: up to here heights beyond these are spikes, from here on the file is not understood.
_MAX_SPIKE_SHARE = 0.01

# Zeros from the border inward are fill where hardly any (1 %) of the other heights come near zero.
_FILL_DISTANCE_M = 50.0
_MAX_NEAR_FILL_SHARE = 0.01
# Black from the border inward is fill from this share of the orthophoto on; less may be a shadow or a lake.
_MIN_BLACK_SHARE = 0.005

# LERC's error should vanish beside the DSM's own: 2 cm, less for the finer grids of low flights.
_MAX_Z_ERROR_M = 0.02
_MAX_Z_ERROR_PER_GSD = 1.0 / 20.0

# GDAL takes 5 % of the machine's memory by default.
_BUILD_CACHE_BYTES = 256 * 2**20

_SPARSE_COVERAGE = 0.5

# Of the full-resolution cells below a cell of an overview, what must have data for it to have any.
_MIN_VALID_SHARE = 0.75


@dataclass(frozen=True, slots=True)
class PackOptions:
    """How to build, and what the rasters do not say about themselves.

    Attributes:
        dop_compression, quality: of the DOP, lossy; quality 1-100.
        max_z_error_m: of the DSM's compression; None: the lower of 2 cm and a twentieth of its GSD.
        vertical: what heights are measured from; None: what the DSM's CRS says, else "unknown".
        vertical_epsg: vertical system of orthometric heights.
        geoid_undulation_m: height of the geoid above the ellipsoid in the area.
        dop_date, dsm_date: of acquisition: 2023, 2023-06 or 2023-06-04.
        attribution, licence: of the sources.
        true_ortho: whether the DOP is one; None: not known.
        dop_sigma_m, dsm_sigma_m: planimetric and vertical error of the sources, 1 sigma.
        force: replace a pack at the output path.
        created: what to write as the time of the build, UTC; None: now.
    Raises: ConfigError for a value out of range.
    """

    dop_compression: Literal["webp", "jpeg"] = "webp"
    quality: int = 85
    max_z_error_m: float | None = None
    vertical: VerticalKind | None = None
    vertical_epsg: int | None = None
    geoid_undulation_m: float | None = None
    dop_date: str | None = None
    dsm_date: str | None = None
    attribution: str | None = None
    licence: str | None = None
    true_ortho: bool | None = None
    dop_sigma_m: float | None = None
    dsm_sigma_m: float | None = None
    force: bool = False
    created: datetime | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.quality <= 100:
            raise ConfigError(f"quality {self.quality}: must lie between 1 and 100")
        if self.max_z_error_m is not None and not 0 < self.max_z_error_m <= 1:
            raise ConfigError(f"max_z_error_m {self.max_z_error_m}: must lie between 0 (exclusive) and 1 m")
        for name in ("dop_sigma_m", "dsm_sigma_m"):
            sigma = getattr(self, name)
            if sigma is not None and not (np.isfinite(sigma) and sigma >= 0):
                raise ConfigError(f"{name} {sigma}: must be a length in metres, 0 or more")
        for name in ("dop_date", "dsm_date"):
            date = getattr(self, name)
            if date is not None and not re.fullmatch(r"\d{4}(-\d{2}(-\d{2})?)?", date):
                raise ConfigError(f"{name} {date!r}: write it as 2023, 2023-06 or 2023-06-04")


class _Source(NamedTuple):
    """An opened raster that passed the checks common to both."""

    dataset: Any
    path: Path
    grid: RasterGrid
    crs: str | None
    """As in the file: a compound system names the heights, too."""


class _Written(NamedTuple):
    grid: RasterGrid
    levels: int
    valid_fraction: float
    sha256: str
    size: int
    crcs: list[int]


def build_pack(
    dop: Path,
    dsm: Path,
    out: Path,
    options: PackOptions | None = None,
    progress: Progress | None = None,
) -> Pack:
    """Build an area pack from one orthophoto and one surface model.

    Both keep their own grids. The pack is written to a directory beside ``out``, checked, and renamed;
    whatever happens before, ``out`` is as it was. Replacing a pack (``options.force``) takes two renames, so
    a power cut between them leaves the old pack under a hidden name beside ``out``.
    Args:
        dop, dsm: rasters that GDAL reads, in one projected CRS in metres, or both without CRS (local metres).
        out: directory of the pack.
        progress: called with a fraction 0-1 and what is being done.
    Raises: MapError for unusable rasters and failed writes; ConfigError for options that contradict each other.
    """
    options = options or PackOptions()
    say = progress or _silent
    out = out.resolve()
    _check_output(out, (dop, dsm), options.force)
    say(0.0, "checking rasters")
    with block_cache(_BUILD_CACHE_BYTES), _opened(dop) as dop_source, _opened(dsm) as dsm_source:
        _check_dop(dop_source)
        _check_dsm(dsm_source)
        crs = _common_crs(dop_source, dsm_source)
        _check_overlap(dop_source, dsm_source)
        anchor = _anchor(dop_source.grid)
        georeference = Georeference(crs, _vertical(options, crs, anchor, dsm_source), anchor)
        with _staging(out) as staged:
            manifest = _write(dop_source, dsm_source, staged, georeference=georeference, options=options, say=say)
            write_manifest(manifest, staged / MANIFEST_NAME)
            say(0.9, "checking the pack")
            problems = Pack.open(staged).verify()
            if problems:
                raise MapError(
                    f"{out}: what was written does not read back ({problems[0]}); check the disk and build again"
                )
            for path in (*staged.iterdir(), staged):
                _fsync(path)
            _install(staged, out)
    say(1.0, "done")
    return Pack.open(out)


def _silent(fraction: float, message: str) -> None:
    pass


def _check_output(out: Path, sources: tuple[Path, ...], force: bool) -> None:
    for source in sources:
        if source.resolve().is_relative_to(out):
            raise MapError(f"{out}: contains the source {source.name}; choose another output directory")
    if not out.exists():
        return
    if not force:
        raise MapError(f"{out}: exists already; choose another path, or replace it with --force")
    # --force deletes what it replaces, so it must not take a mistyped path for a pack.
    if not (out.is_dir() and ((out / MANIFEST_NAME).is_file() or not any(out.iterdir()))):
        raise MapError(f"{out}: exists and is no area pack; it will not be replaced, choose another path")


@contextmanager
def _opened(path: Path) -> Iterator[_Source]:
    try:
        with quiet_georeference():
            dataset = rasterio.open(path)
    except (RasterioError, OSError) as err:
        raise MapError(f"{path}: cannot be opened ({err}); give a raster that gdalinfo can read") from err
    with dataset:
        grid = raster_grid(dataset, path)
        crs = None
        if dataset.crs is not None:
            crs = dataset.crs.to_wkt()
            projected_crs(crs, str(path))
        elif grid.gsd_m < 1e-4:
            raise MapError(
                f"{path}: no CRS and pixels of {grid.gsd_m:.2g}, which looks like degrees;"
                " reproject with: gdalwarp -s_srs EPSG:4326 -t_srs EPSG:326ZZ"
            )
        yield _Source(dataset, path, grid, crs)


def _check_dop(source: _Source) -> None:
    dataset, path = source.dataset, source.path
    if dataset.colorinterp[0] == ColorInterp.palette:
        raise MapError(f"{path}: coloured by a palette; expand it with: gdal_translate -expand rgb")
    for dtype in dataset.dtypes:
        if dtype != "uint8":
            raise MapError(
                f"{path}: samples are {dtype}, the orthophoto must have 8 bits;"
                " stretch it with: gdal_translate -ot Byte -scale LOW HIGH 0 255"
            )
    if dataset.count == 2 and _alpha_band(dataset) is None:
        raise MapError(f"{path}: two bands, neither alpha; select one with: gdal_translate -b 1")


def _check_dsm(source: _Source) -> None:
    dataset, path = source.dataset, source.path
    if any(c != ColorInterp.alpha for c in dataset.colorinterp[1:]):
        raise MapError(f"{path}: {dataset.count} bands, expected one of heights; select it with: gdal_translate -b")
    if not np.issubdtype(np.dtype(dataset.dtypes[0]), np.number) or "complex" in dataset.dtypes[0]:
        raise MapError(f"{path}: samples are {dataset.dtypes[0]}, expected heights in metres")
    unit = (dataset.units[0] or "").lower()
    if unit not in ("", "m", "metre", "meter", "metres", "meters"):
        raise MapError(f"{path}: heights are in {unit}; convert them to metres with gdal_calc.py")


def _common_crs(dop: _Source, dsm: _Source) -> str | None:
    """The horizontal system of both, as "EPSG:n" where it has a code, else WKT."""
    if (dop.crs is None) != (dsm.crs is None):
        without, with_crs = (dop, dsm) if dop.crs is None else (dsm, dop)
        raise MapError(
            f"{without.path}: no CRS, but {with_crs.path.name} has one;"
            " assign the right one with: gdal_translate -a_srs EPSG:n"
        )
    if dop.crs is None or dsm.crs is None:
        return None
    ours, theirs = (projected_crs(str(source.crs), str(source.path)) for source in (dop, dsm))
    # By name in the register first: WKT of one system differs in axes and metadata from program to program.
    codes = ours.to_epsg(), theirs.to_epsg()
    same = codes[0] == codes[1] if None not in codes else ours.equals(theirs, ignore_axis_order=True)
    if not same:
        target = f"EPSG:{codes[0]}" if codes[0] else f'"{ours.name}"'
        raise MapError(
            f"{dsm.path}: CRS is {theirs.name}, that of {dop.path.name} is {ours.name};"
            f" reproject with: gdalwarp -t_srs {target} -r bilinear {dsm.path.name} OUT.tif"
        )
    return f"EPSG:{codes[0]}" if codes[0] else str(ours.to_wkt())


def _check_overlap(dop: _Source, dsm: _Source) -> None:
    a, b = dop.grid.bounds, dsm.grid.bounds
    shared = max(min(a[2], b[2]) - max(a[0], b[0]), 0.0) * max(min(a[3], b[3]) - max(a[1], b[1]), 0.0)
    if shared == 0.0:
        raise MapError(
            f"{dsm.path}: covers west, south, east, north {_rounded(b)}, {dop.path.name} covers {_rounded(a)};"
            " they do not overlap, choose rasters of one area"
        )
    coverage = shared / ((a[2] - a[0]) * (a[3] - a[1]))
    if coverage < _SPARSE_COVERAGE:
        logger.warning("%s covers only %.0f %% of the orthophoto; there is no fix outside it", dsm.path, 100 * coverage)


def _rounded(bounds: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(round(v, 1) for v in bounds)


def _anchor(grid: RasterGrid) -> tuple[float, float]:
    west, south, east, north = grid.bounds
    step = 100.0 if min(east - west, north - south) >= 400.0 else 10.0
    return round((west + east) / 2 / step) * step, round((south + north) / 2 / step) * step


def _vertical(options: PackOptions, crs: str | None, anchor: tuple[float, float], dsm: _Source) -> VerticalDatum:
    kind, epsg = options.vertical, options.vertical_epsg
    named = None if dsm.crs is None else vertical_of(dsm.crs, str(dsm.path))
    if kind is None and named is not None:
        kind, epsg = named[0], epsg if epsg is not None else named[1]
    elif kind is None:
        kind = "unknown"
    elif named is not None and kind != named[0]:
        logger.warning("%s: its CRS says %s heights, --vertical %s is taken", dsm.path, named[0], kind)
    elif named is not None and epsg is None:
        epsg = named[1]
    lat_lon = None
    if crs is not None:
        lon, lat = pyproj.Proj(projected_crs(crs, str(dsm.path)))(*anchor, inverse=True)
        lat_lon = (lat, lon)
        caveat = datum_shift_caveat(crs, lat_lon)
        if caveat is not None:
            logger.warning("%s: %s", dsm.path, caveat)
    return derive_vertical(kind, epsg, options.geoid_undulation_m, lat_lon)


@contextmanager
def _staging(out: Path) -> Iterator[Path]:
    """A directory beside ``out``: a rename within one file system is atomic, one across is a copy."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        staged = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".partial", dir=out.parent))
        # mkdtemp's 0700 would lock out the daemon's user.
        staged.chmod(0o755)
    except OSError as err:
        raise MapError(f"{out.parent}: cannot be written ({err.strerror}); choose another output path") from err
    try:
        yield staged
    except (RasterioError, OSError) as err:
        # rasterio's own text is "see previous exception"; GDAL's is at the root of the chain.
        root: BaseException = err
        while root.__cause__ is not None:
            root = root.__cause__
        free_mb = shutil.disk_usage(out.parent).free / 1e6
        raise MapError(
            f"{out}: cannot be written ({root}; {free_mb:.0f} MB free); check free space and permissions"
        ) from err
    finally:
        shutil.rmtree(staged, ignore_errors=True)


def _install(staged: Path, out: Path) -> None:
    if not out.exists():
        staged.rename(out)
    else:
        aside = out.with_name(f".{out.name}.{secrets.token_hex(4)}.old")
        out.rename(aside)
        try:
            staged.rename(out)
        except BaseException:
            aside.rename(out)
            raise
        _fsync(out.parent)
        shutil.rmtree(aside, ignore_errors=True)
    _fsync(out.parent)


def _fsync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _write(
    dop: _Source,
    dsm: _Source,
    staged: Path,
    *,
    georeference: Georeference,
    options: PackOptions,
    say: Progress,
) -> Manifest:
    max_z_error_m = options.max_z_error_m or min(_MAX_Z_ERROR_M, round(dsm.grid.gsd_m * _MAX_Z_ERROR_PER_GSD, 6))
    folder = staged / "work"
    folder.mkdir()
    work, valid_work = folder / "work.tif", folder / "valid.tif"

    valid = _normalise_dop(dop, work, lambda done: say(0.3 * done, "reading the orthophoto"))
    say(0.3, "compressing the orthophoto")
    _to_cog(work, staged / _DOP_NAME, compress=options.dop_compression.upper(), quality=options.quality)
    dop_written = _described(staged / _DOP_NAME, valid)

    work.unlink()
    valid = _normalise_dsm(dsm, work, valid_work, lambda done: say(0.6 + 0.15 * done, "reading the surface model"))
    say(0.75, "compressing the surface model")
    levelled = _with_surface_levels(work, valid_work)
    _to_cog(levelled, staged / _DSM_NAME, compress="LERC_ZSTD", max_z_error=max_z_error_m, overviews="AUTO")
    dsm_written = _described(staged / _DSM_NAME, valid)
    shutil.rmtree(folder)

    return Manifest(
        format=FORMAT,
        version=VERSION,
        created=(options.created or datetime.now(UTC)).astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        crs=georeference.crs,
        anchor=georeference.anchor,
        vertical=georeference.vertical,
        dop=Dop(
            **_common_fields(_DOP_NAME, dop, dop_written, options),
            compression=f"{options.dop_compression.upper()} quality {options.quality}",
            date=options.dop_date,
            true_ortho=options.true_ortho,
            sigma_m=options.dop_sigma_m,
        ),
        dsm=Dsm(
            **_common_fields(_DSM_NAME, dsm, dsm_written, options),
            compression="LERC_ZSTD",
            date=options.dsm_date,
            max_z_error_m=max_z_error_m,
            nodata=NODATA,
            sigma_m=options.dsm_sigma_m,
        ),
    )


def _common_fields(name: str, source: _Source, written: _Written, options: PackOptions) -> dict[str, Any]:
    return {
        "file": name,
        "gsd_m": written.grid.gsd_m,
        "grid": Grid.of(written.grid),
        "levels": written.levels,
        "valid_fraction": written.valid_fraction,
        "bytes": written.size,
        "sha256": written.sha256,
        "segment_crc32": encode_crcs(written.crcs),
        "source": source.path.name,
        "attribution": options.attribution,
        "licence": options.licence,
    }


def _described(path: Path, valid_fraction: float) -> _Written:
    data = path.read_bytes()
    with Cog(data, path) as cog:
        return _Written(
            cog.grids[0],
            len(cog.grids),
            valid_fraction,
            hashlib.sha256(data).hexdigest(),
            len(data),
            cog.segment_crcs(),
        )


def _normalise_dop(source: _Source, work: Path, done: Callable[[float], None]) -> float:
    """Copy to three bands and a mask. Returns: the share of valid pixels.

    A fourth band without the alpha flag is infrared in the state surveys' orthophotos, so only the flag makes it
    a mask.
    """
    dataset, grid = source.dataset, source.grid
    alpha = _alpha_band(dataset)
    bands = [1, 2, 3] if dataset.count - (alpha is not None) >= 3 else [1, 1, 1]

    def step(window: Window) -> tuple[Any, npt.NDArray[np.bool_]]:
        pixels = _read(source, bands, window)
        return pixels, _read(source, alpha, window) > 127 if alpha is not None else _mask(source, window)

    def black(window: Window) -> npt.NDArray[np.bool_]:
        pixels, valid = step(window)
        found: npt.NDArray[np.bool_] = valid & ~pixels.any(axis=0)
        return found

    collar = Collar(grid.width, grid.height, black)
    share = collar.cells / (grid.width * grid.height)
    if fill := share >= _MIN_BLACK_SHARE:
        logger.warning(
            "%s: black from the border inward, %.1f %% of it, taken for no data, though the file does not declare it;"
            " nearblack -setmask or gdal_edit.py -a_nodata 0 does",
            source.path,
            100 * share,
        )
    profile = _work_profile(source, count=3, dtype="uint8", photometric="RGB")
    valid_px = 0
    # Internal, so that the COG driver carries the mask into the one file.
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(work, "w", **profile) as target:
        for window in _chunks(grid, done):
            pixels, valid = step(window)
            if fill:
                valid &= ~collar.mask(window)
            # One colour outside: what a lossy source has there is noise that costs bytes.
            pixels *= valid
            target.write(pixels, window=window)
            target.write_mask(valid, window=window)
            valid_px += int(np.count_nonzero(valid))
    if valid_px == 0:
        raise MapError(f"{source.path}: no valid pixel; check its nodata value or mask with gdalinfo")
    return valid_px / (grid.width * grid.height)


def _normalise_dsm(source: _Source, work: Path, valid_work: Path, done: Callable[[float], None]) -> float:
    """Copy to float32 heights with one nodata value, and validity (0 or 1) to a raster of its own.

    Returns: the share of valid cells.
    """
    profile = _work_profile(source, count=1, dtype="float32", nodata=NODATA, predictor=3)
    valid_profile = _work_profile(source, count=1, dtype="float32")
    collar = _zero_collar(source)
    valid_px, spikes_px, undeclared = 0, 0, set()
    lowest, highest = np.inf, -np.inf
    with rasterio.open(work, "w", **profile) as target, rasterio.open(valid_work, "w", **valid_profile) as share:
        for window in _chunks(source.grid, done):
            heights, valid, sentinels = _heights(source, window)
            undeclared.update(sentinels)
            if collar is not None:
                valid &= ~collar.mask(window)
            spikes = valid & ((heights < _MIN_HEIGHT_M) | (heights > _MAX_HEIGHT_M))
            if spikes.any():
                spikes_px += int(np.count_nonzero(spikes))
                lowest = min(lowest, float(heights[spikes].min()))
                highest = max(highest, float(heights[spikes].max()))
                valid &= ~spikes
            target.write(np.where(valid, heights, NODATA).astype(np.float32), 1, window=window)
            share.write(valid.astype(np.float32), 1, window=window)
            valid_px += int(np.count_nonzero(valid))
    if spikes_px:
        spike_share = spikes_px / (valid_px + spikes_px)
        _judge_spikes(source.path, spikes_px, spike_share, lowest, highest)
    if valid_px == 0:
        raise MapError(f"{source.path}: no valid height; check its nodata value with gdalinfo")
    if undeclared:
        values = ", ".join(f"{v:g}" for v in sorted(undeclared)[:5])
        logger.warning(
            "%s: %s taken for nodata, though the file does not declare it; gdal_edit.py -a_nodata does",
            source.path,
            values,
        )
    return valid_px / (source.grid.width * source.grid.height)


def _heights(source: _Source, window: Window) -> tuple[Any, npt.NDArray[np.bool_], list[float]]:
    """Heights in metres, their validity, and the undeclared nodata values among them."""
    dataset = source.dataset
    raw = _read(source, 1, window).astype(np.float64)
    valid = _mask(source, window) & np.isfinite(raw)
    sentinels = []
    low_or_huge = valid & ((raw < _MIN_HEIGHT_M) | (raw > _SENTINEL_MAGNITUDE))
    if low_or_huge.any():
        sentinel = low_or_huge & (np.isin(raw, _SENTINELS) | (np.abs(raw) > _SENTINEL_MAGNITUDE))
        sentinels = np.unique(raw[sentinel]).tolist()
        valid &= ~sentinel
    return raw * dataset.scales[0] + dataset.offsets[0], valid, sentinels


def _zero_collar(source: _Source) -> Collar | None:
    """Heights of exactly zero from the border inward, if the rest of the surface lies far from zero."""
    grid = source.grid

    def zero(window: Window) -> npt.NDArray[np.bool_]:
        heights, valid, _ = _heights(source, window)
        found: npt.NDArray[np.bool_] = valid & (heights == 0.0)
        return found

    collar = Collar(grid.width, grid.height, zero)
    if collar.cells == 0:
        return None
    rest, near = 0, 0
    for window in windows(grid.width, grid.height):
        heights, valid, _ = _heights(source, window)
        valid &= ~collar.mask(window)
        rest += int(np.count_nonzero(valid))
        near += int(np.count_nonzero(valid & (np.abs(heights) <= _FILL_DISTANCE_M)))
    if rest == 0 or near > _MAX_NEAR_FILL_SHARE * rest:
        return None
    logger.warning(
        "%s: heights of exactly 0 from the border inward, %.1f %% of it, taken for nodata, though the file does not"
        " declare it; gdal_edit.py -a_nodata 0 does",
        source.path,
        100 * collar.cells / (grid.width * grid.height),
    )
    return collar


def _judge_spikes(path: Path, count: int, share: float, lowest: float, highest: float) -> None:
    limits = f"{_MIN_HEIGHT_M:g} to {_MAX_HEIGHT_M:g} m"
    if share >= _MAX_SPIKE_SHARE:
        raise MapError(
            f"{path}: {100 * share:.1f} % of the heights lie beyond {limits} ({lowest:g} to {highest:g} m);"
            " probably an undeclared nodata value, declare it with: gdal_edit.py -a_nodata VALUE"
        )
    logger.warning(
        "%s: %d heights (%.2g %%) beyond %s (%g to %g m) taken for nodata",
        path,
        count,
        100 * share,
        limits,
        lowest,
        highest,
    )


def _read(source: _Source, bands: int | list[int], window: Window) -> Any:
    try:
        return source.dataset.read(bands, window=window)
    except (RasterioError, OSError) as err:
        raise MapError(f"{source.path}: cannot be decoded ({err}); fetch or export it again") from err


def _mask(source: _Source, window: Window) -> npt.NDArray[np.bool_]:
    try:
        mask: npt.NDArray[np.bool_] = source.dataset.dataset_mask(window=window) > 0
    except (RasterioError, OSError) as err:
        raise MapError(f"{source.path}: mask cannot be decoded ({err}); fetch or export it again") from err
    return mask


def _alpha_band(dataset: Any) -> int | None:
    return next((k for k, c in enumerate(dataset.colorinterp, 1) if c == ColorInterp.alpha), None)


def _chunks(grid: RasterGrid, done: Callable[[float], None]) -> Iterator[Window]:
    for window in windows(grid.width, grid.height):
        yield window
        if window.col_off + window.width == grid.width:
            done((window.row_off + window.height) / grid.height)


def _work_profile(source: _Source, **more: Any) -> dict[str, Any]:
    grid = source.grid
    crs = None if source.crs is None else _rasterio_crs(source)
    return {
        "driver": "GTiff",
        "width": grid.width,
        "height": grid.height,
        "transform": source.dataset.transform,
        "crs": crs,
        "tiled": True,
        "blockxsize": BLOCK_PX,
        "blockysize": BLOCK_PX,
        "compress": "ZSTD",
        "zstd_level": 1,
        "interleave": "pixel",
        "bigtiff": "IF_SAFER",
        **more,
    }


def _rasterio_crs(source: _Source) -> Any:
    """Horizontal part only: DOP and DSM of a pack name the same system, heights are the manifest's."""
    crs = projected_crs(str(source.crs), str(source.path))
    try:
        return rasterio.CRS.from_user_input(f"EPSG:{crs.to_epsg()}" if crs.to_epsg() else crs.to_wkt())
    except (RasterioError, CRSError) as err:
        raise MapError(f"{source.path}: {crs.name} is not known to GDAL ({err}); reproject to UTM") from err


def _with_surface_levels(work: Path, valid_work: Path) -> Path:
    """Overviews in which a cell has data only where 3 in 4 of the cells below it have.

    GDAL's AVERAGE leaves out nodata, so that one valid cell of four makes a valid average, one of sixteen two
    levels up: every scattered hole would be closed with the heights around it.
    Returns: a VRT of ``work`` with these levels, beside it.
    """
    with rasterio.open(work) as full:
        profile, size = full.profile, max(full.width, full.height)
    factors: list[int] = []
    while size > BLOCK_PX:  # as the COG driver does
        factors.append(2 << len(factors))
        size = -(-size // 2)
    vrt = work.with_suffix(".vrt")
    rasterio.shutil.copy(work, vrt, driver="VRT")
    if not factors:
        return vrt
    for path in (work, valid_work):
        with rasterio.open(path, "r+") as dataset:
            dataset.build_overviews(factors, Resampling.average)
    entries = ""
    for level in range(len(factors)):
        name = f"level{level + 1}.tif"
        with (
            rasterio.open(work, overview_level=level) as averaged,
            rasterio.open(valid_work, overview_level=level) as share,
        ):
            profile.update(width=averaged.width, height=averaged.height, transform=averaged.transform)
            with rasterio.open(work.with_name(name), "w", **profile) as target:
                for window in windows(averaged.width, averaged.height):
                    heights = averaged.read(1, window=window)
                    # Rounding of GDAL's weights must not decide over exactly 3 of 4.
                    heights[share.read(1, window=window) < _MIN_VALID_SHARE - 1e-4] = NODATA
                    target.write(heights, 1, window=window)
        entries += (
            f'<Overview><SourceFilename relativeToVRT="1">{name}</SourceFilename>'
            "<SourceBand>1</SourceBand></Overview>"
        )
    vrt.write_text(vrt.read_text().replace("</VRTRasterBand>", entries + "</VRTRasterBand>"))
    return vrt


def _to_cog(work: Path, out: Path, *, overviews: str = "IGNORE_EXISTING", **compression: Any) -> None:
    """AVERAGE leaves out masked pixels, so that their colour does not bleed into an overview."""
    rasterio.shutil.copy(
        work,
        out,
        driver="COG",
        blocksize=BLOCK_PX,
        overviews=overviews,
        overview_resampling="AVERAGE",
        bigtiff="IF_SAFER",
        num_threads="ALL_CPUS",
        **compression,
    )
