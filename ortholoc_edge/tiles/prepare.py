"""Judgement of whole sources, and the awkward ones made plain before their tiles are read.

What only the whole raster tells: fill around a survey that nobody declared, nodata taken for heights, infrared passed
off as transparency. And what would cost a whole decoding for each tile (one JPEG 2000 tile, packed members of ZIPs,
text, clouds) is decoded once, into a tiled GeoTIFF.
"""

from __future__ import annotations

import logging
import os
import re
import secrets
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pyproj
import rasterio
from affine import Affine
from rasterio.windows import Window

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.arrays import BoolArray
from ortholoc_edge.tiles import points
from ortholoc_edge.tiles.collar import Collar, windows
from ortholoc_edge.tiles.source import (
    MAX_HEIGHT_M,
    MIN_HEIGHT_M,
    READ_ERRORS,
    Source,
    fingerprint,
    named_errors,
    opened,
    read_colours,
    read_heights,
)

logger = logging.getLogger(__name__)

Progress = Callable[[float], None]

NODATA = -9999.0
_BLOCK_PX = 512

# Of the cells with data: up to here heights beyond the Earth's are spikes, from here on the file is not understood.
_MAX_SPIKE_SHARE = 0.01
# Zeros from the border inward are fill where hardly any (1 %) of the other heights come near zero.
_FILL_DISTANCE_M = 50.0
_MAX_NEAR_FILL_SHARE = 0.01
# Black or white from the border inward is fill from this share of the orthophoto on; less may be a shadow or a lake.
# Where it is not fill after all, little is lost: an area without any contrast has nothing to match.
_MIN_FILL_SHARE = 0.005
# What lossy compression makes of fill (see tests): far from the picture, and in the blocks that it shares with it.
_LOSSY_LEVELS = 3
_RIM_LEVELS, _RIM_PX = 32, 8
# An alpha band is 0 or 255 nearly everywhere; infrared is neither.
_MAX_HALF_TRANSPARENT = 0.2
_SAMPLE_PX = 512
# Larger ones (mosaics of a whole state) are taken as they are: looking at each pixel would take hours.
_MAX_JUDGED_PX = 2**32


def prepare(source: Source, folder: Path, progress: Progress | None = None) -> Source:
    """Judge a source, and make it plain if it is awkward.

    What is not valid in it as a whole is marked so in a copy: black or white fill that touches an orthophoto's border,
    heights of 0 that touch the border of a model that lies elsewhere. A warning says so.
    Args:
        folder: for the copies. Each is written under another name first, and used again if it is there; its name
            changes with the file and with how it is read.
        progress: called with 0-1.
    Returns: the source itself, or one of the copy with the same name, date and place.
    Raises: MapError for a damaged file, for heights that cannot be understood, and if the copy cannot be written.
    """
    say = progress or _silent
    stem = re.sub(r"[^A-Za-z0-9_-]+", "_", PurePosixPath(source.name).stem)[-40:]
    ready = folder / f"{stem}_{fingerprint(replace(source, stretch=None))[:16]}.tif"
    if (copy := _made_before(source, ready)) is not None:
        return copy
    current = source
    with _workplace(folder) as work:
        if source.points:
            current = _gridded(source, work / "gridded.tif", say)
        elif source.slow or source.palette:
            unpacked = _unpacked(source, work)
            write = _write_dop if source.kind == "dop" else _write_dsm
            current = write(unpacked, work / "plain.tif", None, say)
        if source.grid.width * source.grid.height > _MAX_JUDGED_PX:
            logger.info("%s: too large to look for undeclared nodata as a whole", source.where)
        elif source.kind == "dop":
            current = _without_fill(_with_true_alpha(current, source), source, work / "judged.tif", say)
        else:
            current = _without_zeros(current, source, work / "judged.tif", say)
        if current.file.parent != work:
            return replace(current, stretch=source.stretch)
        _sync(current.file)
        current.file.replace(ready)
        _sync(folder)
    return _copy_of(source, ready)


def _silent(done: float) -> None:
    pass


@contextmanager
def _workplace(folder: Path) -> Iterator[Path]:
    """A directory inside ``folder``, from which a rename into it is atomic."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{secrets.token_hex(4)}.", suffix=".partial", dir=folder))
    except OSError as err:
        raise MapError(f"{folder}: cannot be written ({err.strerror}); choose another output path") from err
    try:
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except READ_ERRORS as err:
        free_mb = shutil.disk_usage(path.parent).free / 1e6
        raise MapError(f"{path.parent}: cannot be written ({err}; {free_mb:.0f} MB free); make room for it") from err


def _made_before(source: Source, ready: Path) -> Source | None:
    if not ready.is_file():
        return None
    try:
        with opened(str(ready), source.where, ("GTiff",)) as dataset:
            same = (dataset.width, dataset.height) == (source.grid.width, source.grid.height)
        return _copy_of(source, ready) if same else None
    except MapError:
        return None


def _copy_of(source: Source, path: Path) -> Source:
    """The source whose pixels :func:`_write_dop` or :func:`_write_dsm` wrote to ``path``."""
    common: dict[str, Any] = {"path": str(path), "file": path, "member": None, "driver": "GTiff", "slow": False}
    if source.kind == "dsm":
        return replace(source, **common, dtype="float32", bands=(1,), scale=1.0, offset=0.0)
    grey = len(set(source.bands)) == 1 and not source.palette
    bands = (1, 1, 1) if grey else (1, 2, 3)
    # Infrared that was passed off as alpha is found again in the copy: it has a fourth band, or a second.
    with opened(str(path), source.where, ("GTiff",)) as dataset:
        nir = dataset.count if dataset.count > len(set(bands)) else None
    dtype = "uint8" if source.dtype == "uint8" else "uint16"
    return replace(source, **common, dtype=dtype, bands=bands, nir=nir, alpha=None, palette=False, lossy=False)


def _unpacked(source: Source, work: Path) -> Source:
    """A member of a ZIP beside its sidecars as files: going back in a packed stream means unpacking it anew."""
    if source.member is None:
        return source
    with named_errors(source.where):
        inner = PurePosixPath(source.member)
        with zipfile.ZipFile(source.file) as archive:
            for info in archive.infolist():
                name = PurePosixPath(info.filename)
                if name.parent == inner.parent and name.name.split(".")[0] == inner.name.split(".")[0]:
                    if info.file_size > shutil.disk_usage(work).free:
                        raise MapError(f"{work.parent}: no room for {info.file_size / 1e6:.0f} MB; make some")
                    with archive.open(info) as packed, (work / name.name).open("wb") as target:
                        shutil.copyfileobj(packed, target)
    return replace(source, path=str(work / inner.name), file=source.file)


def _gridded(source: Source, path: Path, say: Progress) -> Source:
    if source.driver == "las":
        heights = points.grid_cloud(source, say)
    else:
        layout = points.text_layout(source.file, source.member, source.where)
        if layout is None:
            raise MapError(f"{source.where}: no x y z in its first lines; fetch it again")
        heights = points.grid_text(source, layout, say)
    with _writing(path), rasterio.open(path, "w", **_profile(source, 1, "float32"), nodata=NODATA) as target:
        for window in windows(source.grid.width, source.grid.height):
            part = heights[window.toslices()]
            target.write(np.where(np.isnan(part), np.float32(NODATA), part), 1, window=window)
    return _copy_of(source, path)


def _profile(source: Source, count: int, dtype: str) -> dict[str, Any]:
    grid = source.grid
    return {
        "driver": "GTiff",
        "width": grid.width,
        "height": grid.height,
        "count": count,
        "dtype": dtype,
        "transform": Affine(grid.dx, 0.0, grid.west, 0.0, grid.dy, grid.top),
        "crs": None if source.crs is None else _wkt(source.crs),
        "tiled": True,
        "blockxsize": _BLOCK_PX,
        "blockysize": _BLOCK_PX,
        "compress": "ZSTD",
        "zstd_level": 1,
        "predictor": 3 if dtype == "float32" else 2,
        "interleave": "pixel",
        "bigtiff": "IF_SAFER",
    }


def _wkt(crs: str) -> str:
    return str(pyproj.CRS.from_user_input(crs).to_wkt("WKT2_2019"))


def _steps(source: Source, say: Progress) -> Iterator[Window]:
    grid = source.grid
    for window in windows(grid.width, grid.height):
        yield window
        if window.col_off + window.width == grid.width:
            say((window.row_off + window.height) / grid.height)


# Orthophotos


def _write_dop(
    source: Source, path: Path, fill: Callable[[Window, npt.NDArray[Any]], BoolArray] | None, say: Progress
) -> Source:
    """Copy the colours, the infrared and the mask; ``fill`` gives what is to be left out of a window."""
    grey = len(set(source.bands)) == 1 and not source.palette
    kept = [0] if grey else [0, 1, 2]
    if source.nir is not None:
        kept.append(3)
    dtype = "uint8" if source.dtype == "uint8" else "uint16"
    profile = _profile(source, len(kept), dtype) | {"photometric": "MINISBLACK" if grey else "RGB", "alpha": "NO"}
    with (
        opened(source.path, source.where, (source.driver,)) as dataset,
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        _writing(path),
        rasterio.open(path, "w", **profile) as target,
    ):
        for window in _steps(source, say):
            with named_errors(source.where):
                bands, valid = read_colours(source, dataset, window)
                if fill is not None:
                    valid &= ~fill(window, bands)
            stored = np.clip(bands[kept], 0, None).astype(dtype) * valid
            target.write(stored, window=window)
            target.write_mask(valid, window=window)
    return _copy_of(source, path)


def _with_true_alpha(current: Source, source: Source) -> Source:
    """Programs flag the fourth band of any TIFF as alpha unless told otherwise, infrared too."""
    if current.alpha is None or len(set(current.bands)) != 3 or current.nir is not None:
        return current
    with opened(current.path, current.where, (current.driver,)) as dataset:
        shape = min(_SAMPLE_PX, dataset.height), min(_SAMPLE_PX, dataset.width)
        sample = dataset.read(current.alpha, out_shape=shape)
    opaque = np.iinfo(sample.dtype).max
    between = float(np.mean((sample > opaque // 50) & (sample < opaque - opaque // 50)))
    if between <= _MAX_HALF_TRANSPARENT:
        return current
    logger.warning(
        "%s: band %d is said to be alpha, but %.0f %% of it is neither 0 nor full; taken for infrared."
        " gdal_edit.py -colorinterp_%d undefined says so in the file",
        source.where,
        current.alpha,
        100 * between,
        current.alpha,
    )
    return replace(current, nir=current.alpha, alpha=None)


def _without_fill(current: Source, source: Source, path: Path, say: Progress) -> Source:
    """Mark black or white from the border inward as not valid, if there is much of it."""
    tolerance = _LOSSY_LEVELS if source.lossy else 0
    with opened(current.path, current.where, (current.driver,)) as dataset:
        collars = []
        for name, marked in (("black", _dark), ("white", _bright)):
            if name == "white" and current.dtype not in ("uint8", "uint16"):
                continue

            def found(window: Window, marked: Callable[[Any, int], BoolArray] = marked) -> BoolArray:
                with named_errors(source.where):
                    bands, valid = read_colours(current, dataset, window)
                    result: BoolArray = valid & marked(bands[:3], tolerance)
                    return result

            collar = Collar(current.grid.width, current.grid.height, found)
            share = collar.cells / (current.grid.width * current.grid.height)
            if share < _MIN_FILL_SHARE:
                continue
            logger.warning(
                "%s: %s from the border inward, %.1f %% of it, taken for no data, though the file does not declare it;"
                " nearblack -setmask or gdal_edit.py -a_nodata does",
                source.where,
                name,
                100 * share,
            )
            collars.append((collar, marked))
        if not collars:
            return current

        def fill(window: Window, bands: npt.NDArray[Any]) -> BoolArray:
            out = np.zeros(bands.shape[1:], bool)
            for collar, marked in collars:
                inside = collar.mask(window)
                if tolerance and inside.any():
                    kernel = np.ones((2 * _RIM_PX + 1,) * 2, np.uint8)
                    near = cv2.dilate(inside.astype(np.uint8), kernel) > 0
                    inside = inside | (near & marked(bands[:3], _RIM_LEVELS))
                out |= inside
            return out

        return _write_dop(current, path, fill, say)


def _dark(bands: npt.NDArray[Any], tolerance: int) -> BoolArray:
    found: BoolArray = bands.max(axis=0) <= tolerance
    return found


def _bright(bands: npt.NDArray[Any], tolerance: int) -> BoolArray:
    found: BoolArray = bands.min(axis=0) >= np.iinfo(bands.dtype).max - tolerance
    return found


# Surface models


def _write_dsm(source: Source, path: Path, fill: Callable[[Window], BoolArray] | None, say: Progress) -> Source:
    """Copy heights as float32; impossible ones stay, to be judged."""
    with (
        opened(source.path, source.where, (source.driver,)) as dataset,
        _writing(path),
        rasterio.open(path, "w", **_profile(source, 1, "float32"), nodata=NODATA) as target,
    ):
        for window in _steps(source, say):
            with named_errors(source.where):
                metres, valid, _, spikes = read_heights(source, dataset, window)
                valid |= spikes
                if fill is not None:
                    valid &= ~fill(window)
                with np.errstate(over="ignore"):
                    stored = np.where(valid, metres, NODATA).astype(np.float32)
            target.write(stored, 1, window=window)
    return _copy_of(source, path)


def _without_zeros(current: Source, source: Source, path: Path, say: Progress) -> Source:
    """Judge all heights, and mark zeros from the border inward as not valid if the rest lies far from zero."""
    grid = current.grid
    with opened(current.path, current.where, (current.driver,)) as dataset:

        def zero(window: Window) -> BoolArray:
            with named_errors(source.where):
                metres, valid, _, _ = read_heights(current, dataset, window)
                result: BoolArray = valid & (metres == 0.0)
                return result

        collar = Collar(grid.width, grid.height, zero)
        valid_px = spikes_px = near_zero = 0
        lowest, highest, undeclared = np.inf, -np.inf, set()
        for window in windows(grid.width, grid.height):
            with named_errors(source.where):
                metres, valid, sentinels, spikes = read_heights(current, dataset, window)
            undeclared.update(sentinels)
            valid &= ~collar.mask(window)
            valid_px += int(np.count_nonzero(valid))
            near_zero += int(np.count_nonzero(valid & (np.abs(metres) <= _FILL_DISTANCE_M)))
            if spikes.any():
                spikes_px += int(np.count_nonzero(spikes))
                lowest = min(lowest, float(metres[spikes].min()))
                highest = max(highest, float(metres[spikes].max()))
        if spikes_px:
            _judge_spikes(source.where, spikes_px, spikes_px / (valid_px + spikes_px), lowest, highest)
        if undeclared:
            values = ", ".join(f"{v:g}" for v in sorted(undeclared)[:5])
            logger.warning(
                "%s: %s taken for nodata, though the file does not declare it; gdal_edit.py -a_nodata does",
                source.where,
                values,
            )
        if collar.cells == 0 or valid_px == 0 or near_zero > _MAX_NEAR_FILL_SHARE * valid_px:
            return current
        logger.warning(
            "%s: heights of exactly 0 from the border inward, %.1f %% of it, taken for nodata, though the file does not"
            " declare it; gdal_edit.py -a_nodata 0 does",
            source.where,
            100 * collar.cells / (grid.width * grid.height),
        )
        return _write_dsm(current, path, collar.mask, say)


def _judge_spikes(where: str, count: int, share: float, lowest: float, highest: float) -> None:
    limits = f"{MIN_HEIGHT_M:g} to {MAX_HEIGHT_M:g} m"
    if share >= _MAX_SPIKE_SHARE:
        raise MapError(
            f"{where}: {100 * share:.1f} % of the heights lie beyond {limits} ({lowest:g} to {highest:g} m);"
            " probably an undeclared nodata value, declare it with: gdal_edit.py -a_nodata VALUE"
        )
    logger.warning(
        "%s: %d heights (%.2g %%) beyond %s (%g to %g m) taken for nodata",
        where,
        count,
        100 * share,
        limits,
        lowest,
        highest,
    )
