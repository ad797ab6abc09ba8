"""The work of a build in pieces that run anywhere: each reads sources and writes one file and one record.

A piece is named by the hash of all that goes into it, and finished when its record is there; so a build that was
cut off goes on where it was, and one with another quality keeps the heights.
"""

from __future__ import annotations

import functools
import hashlib
import os
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2
import msgspec
import numpy as np
import rasterio
from rasterio.errors import RasterioError
from rasterio.io import MemoryFile

from ortholoc_edge import parallel
from ortholoc_edge.errors import ConfigError, MapError, OrtholocError
from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, ImageArray
from ortholoc_edge.matching.registry import make_matcher
from ortholoc_edge.parallel import Purpose, Workers
from ortholoc_edge.tiles import coverage, encode, features, matchability
from ortholoc_edge.tiles.area import MapArea
from ortholoc_edge.tiles.cog import Cog, quiet_georeference
from ortholoc_edge.tiles.holes import fill_small_holes
from ortholoc_edge.tiles.lattice import LEVELS, Lattice, PixelBox
from ortholoc_edge.tiles.levels import STORED_LEVELS
from ortholoc_edge.tiles.manifest import encode_crcs
from ortholoc_edge.tiles.mosaic import dop_mosaic, dsm_mosaic
from ortholoc_edge.tiles.prepare import prepare
from ortholoc_edge.tiles.sources import Source, fingerprint

# Part of every hash: raise it when the same input makes other bytes.
_RECIPE = 3
_WORKER_CACHE_BYTES = 64 * 2**20
_PURPOSE = Purpose("build", MapError)
# Of SHA-256, before each record: a disk that lost power may hand back anything.
_DIGEST_BYTES = 32


# Inside of Record "bytes" is a field.
_Data = bytes


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """What a piece of work wrote; a file's name is that of the record.

    Attributes:
        bytes, sha256: of the file; 0 and "" where there was nothing to write.
        valid_fraction: of a tile.
        segment_crc32: of a tile.
        shown: sources that contributed a pixel, as indices into the job's sources.
        share: per 64 x 64 px cell, percent of valid pixels, (H/64, W/64) uint8 in row order.
        matchability: of a DOP tile, per cell, likewise.
        min_m, max_m, filled_cells: of a DSM tile.
        filled: centres and cell counts of the small holes that were closed: (easting, northing, cells).
        counts: features per level, of a feature file.
    """

    bytes: int = 0
    sha256: str = ""
    valid_fraction: float = 0.0
    segment_crc32: str = ""
    shown: tuple[int, ...] = ()
    share: _Data = b""
    matchability: _Data = b""
    min_m: float = 0.0
    max_m: float = 0.0
    filled_cells: int = 0
    filled: tuple[tuple[float, float, int], ...] = ()
    counts: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class PrepareJob:
    """Bring an awkward source into a form from which windows can be read fast."""

    source: Source


@dataclass(frozen=True, slots=True)
class DopJob:
    """One tile of the orthophoto from its sources, newest first."""

    sources: tuple[Source, ...]
    lattice: Lattice
    box: PixelBox
    crs: str | None
    area: MapArea | None
    compression: encode.Compression
    quality: int


@dataclass(frozen=True, slots=True)
class DsmJob:
    """One tile of the surface model from its sources, newest first."""

    sources: tuple[Source, ...]
    lattice: Lattice
    box: PixelBox
    crs: str | None
    area: MapArea | None
    max_z_error_m: float
    max_hole_cells: int


@dataclass(frozen=True, slots=True)
class FeatureJob:
    """Features of one tile of the orthophoto, from the sources and not from what compression leaves of them."""

    sources: tuple[Source, ...]
    lattice: Lattice
    box: PixelBox
    crs: str | None
    area: MapArea | None
    matcher: str
    model_sha256: str
    encoding: str
    per_mpx: float


TileJob = DopJob | DsmJob | FeatureJob
Job = PrepareJob | TileJob
_J = TypeVar("_J", bound=Job)


def job_name(job: Job) -> str:
    """Hash of all that goes into a piece of work."""
    digest = hashlib.sha256()
    digest.update(f"{_RECIPE} {type(job).__name__} {rasterio.__version__} {rasterio.__gdal_version__}".encode())
    sources = (job.source,) if isinstance(job, PrepareJob) else job.sources
    for source in sources:
        digest.update(fingerprint(source).encode())
    if not isinstance(job, PrepareJob):
        rest = tuple(getattr(job, name) for name in job.__slots__ if name not in ("sources", "area"))
        digest.update(repr(rest).encode())
        digest.update(_area_key(job.area))
    return digest.hexdigest()[:32]


def _area_key(area: MapArea | None) -> bytes:
    """The numbers of an area alone: its pickle may differ after the way to another process."""
    if area is None:
        return b"everywhere"
    shapes = [[ring.tolist() for ring in polygon] for polygon in area.polygons]
    return repr((shapes, [(strip.line.tolist(), strip.half_width_m) for strip in area.strips])).encode()


def finished(job: TileJob, folder: Path) -> Record | None:
    """The record of an earlier run, if its file is there and has the bytes that it should."""
    name = job_name(job)
    try:
        stored = (folder / f"{name}.record").read_bytes()
        if stored[:_DIGEST_BYTES] != hashlib.sha256(stored[_DIGEST_BYTES:]).digest():
            return None
        record = msgspec.msgpack.decode(stored[_DIGEST_BYTES:], type=Record)
        if record.bytes and _sha256((folder / name).read_bytes()) != record.sha256:
            return None
    except (OSError, msgspec.MsgspecError):
        return None
    return record


def run_job(job: Job, folder: Path) -> Record | Source:
    """Do a piece of work, in any process that sees ``folder``.

    Raises: MapError and ConfigError for what is wrong with its input; nothing else that can be foreseen.
    """
    if isinstance(job, PrepareJob):
        return prepare(job.source, folder)
    if isinstance(job, DopJob):
        data, record = _dop_tile(job)
    elif isinstance(job, DsmJob):
        data, record = _dsm_tile(job)
    else:
        data, record = _feature_tile(job)
    name = job_name(job)
    if data:
        write_file(folder / name, data)
        record = msgspec.structs.replace(record, bytes=len(data), sha256=_sha256(data))
    encoded = msgspec.msgpack.encode(record)
    write_file(folder / f"{name}.record", hashlib.sha256(encoded).digest() + encoded)
    return record


def write_file(path: Path, data: bytes) -> None:
    """All of it or nothing, also after a power cut.

    Raises: MapError naming the file and the free space.
    """
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as err:
        part.unlink(missing_ok=True)
        raise MapError(f"{path}: cannot be written ({err.strerror}); check free space and permissions") from err


def _dop_tile(job: DopJob) -> tuple[bytes, Record]:
    grid = job.lattice.grid(job.box)
    rgb, valid, nir, shown = dop_mosaic(job.sources, grid, job.crs, job.area)
    if not shown:
        return b"", Record()
    data = encode.dop_cog(rgb, valid, grid, job.crs, job.compression, job.quality)
    _check_dop(data, valid)
    cells = matchability.cells(np.ascontiguousarray(np.moveaxis(rgb, 0, -1)), valid, grid.gsd_m, nir)
    return data, Record(
        valid_fraction=float(valid.mean()),
        segment_crc32=_segments(data),
        shown=shown,
        share=coverage.cell_share(valid).tobytes(),
        matchability=cells.tobytes(),
    )


def _dsm_tile(job: DsmJob) -> tuple[bytes, Record]:
    grid = job.lattice.grid(job.box)
    heights, wanted, shown = dsm_mosaic(job.sources, grid, job.crs, job.area)
    if not shown:
        return b"", Record()
    heights, holes = fill_small_holes(heights, wanted, job.max_hole_cells)
    data = encode.dsm_cog(heights, grid, job.crs, job.max_z_error_m)
    _check_dsm(data, heights, job.max_z_error_m)
    valid = np.isfinite(heights)
    centres = grid.map_from_px([(hole.column, hole.row) for hole in holes]) if holes else np.empty((0, 2))
    return data, Record(
        valid_fraction=float(valid.mean()),
        segment_crc32=_segments(data),
        shown=shown,
        share=coverage.cell_share(valid).tobytes(),
        min_m=float(np.nanmin(heights)),
        max_m=float(np.nanmax(heights)),
        filled_cells=sum(hole.cells for hole in holes),
        filled=tuple(
            (round(float(east), 3), round(float(north), 3), hole.cells)
            for (east, north), hole in zip(centres, holes, strict=True)
        ),
    )


def _feature_tile(job: FeatureJob) -> tuple[bytes, Record]:
    rgb, valid, _, shown = dop_mosaic(job.sources, job.lattice.grid(job.box), job.crs, job.area)
    if not shown:
        return b"", Record()
    matcher = _matcher(job.matcher, job.model_sha256)
    grey = cv2.cvtColor(np.ascontiguousarray(np.moveaxis(rgb, 0, -1)), cv2.COLOR_RGB2GRAY)
    data, counts = features.extract_tile(_levels(np.asarray(grey, dtype=np.uint8), valid), matcher, job.per_mpx)
    return data, Record(counts=tuple(counts))


def _levels(grey: ImageArray, valid: BoolArray) -> list[tuple[ImageArray, BoolArray]]:
    """A picture (H, W) and its overviews as GDAL averages them: over the valid pixels, valid where any is."""
    levels = [(grey, valid)]
    share = valid.astype(np.float32)
    for level in range(1, LEVELS):
        size = grey.shape[1] >> level, grey.shape[0] >> level
        weight = cv2.resize(share, size, interpolation=cv2.INTER_AREA)
        total = cv2.resize(grey * share, size, interpolation=cv2.INTER_AREA)
        mean = np.divide(total, weight, out=np.zeros_like(total), where=weight > 0)
        levels.append((np.rint(mean).astype(np.uint8), np.asarray(weight > 0, dtype=bool)))
    return levels


@functools.cache
def _matcher(name: str, model_sha256: str) -> Any:
    matcher = make_matcher(name, working_px=features.WORKING_PX, max_keypoints=features.MAX_KEYPOINTS, threads=1)
    if matcher.model_sha256 != model_sha256:
        raise ConfigError(
            f"matcher {name}: this machine's model has SHA-256 {matcher.model_sha256}, the build's {model_sha256};"
            f" build it alike everywhere with: ortholoc-edge models build {name}"
        )
    return matcher


def _segments(data: bytes) -> str:
    with Cog(data, Path("tile")) as cog:
        return encode_crcs(cog.segment_crcs())


def _check_dop(data: bytes, valid: BoolArray) -> None:
    """Decode every stored level of what will be flown with, while the truth is at hand."""
    with quiet_georeference(), MemoryFile(data) as memory:
        for number in range(len(STORED_LEVELS)):
            with _stored(memory, number) as dataset:
                dataset.read()
                if number == 0 and not np.array_equal(dataset.dataset_mask() > 0, valid):
                    raise MapError("a compressed tile lost its mask; this GDAL is not fit to build, update rasterio")


def _check_dsm(data: bytes, heights: Float32Array, max_z_error_m: float) -> None:
    with quiet_georeference(), MemoryFile(data) as memory:
        for number in range(len(STORED_LEVELS)):
            with _stored(memory, number) as dataset:
                found = dataset.read(1)
            if number > 0:
                continue
            hole = np.isnan(heights)
            # Float32 at 9000 m resolves half a millimetre.
            worst = float(np.abs(found - heights)[~hole].max(initial=0.0))
            if not np.array_equal(found == np.float32(encode.NODATA), hole) or worst > max_z_error_m + 1e-3:
                raise MapError(
                    f"a compressed tile is off by {worst:.3f} m, {max_z_error_m} m were asked for;"
                    " this GDAL is not fit to build, update rasterio"
                )


def _stored(memory: MemoryFile, number: int) -> Any:
    try:
        return memory.open() if number == 0 else memory.open(overview_level=number - 1)
    except RasterioError as err:
        raise MapError(f"a compressed tile does not read back ({err}); update rasterio") from err


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


# -- where the pieces run ------------------------------------------------------------------------------


def run_all(jobs: Sequence[_J], folder: Path, workers: Workers = Workers()) -> Iterator[tuple[_J, Record | Source]]:  # noqa: B008
    """Run pieces of work and give each with its result, in any order.

    Args:
        folder: where files and records go; with Dask all workers must see it under this path.
    Raises: MapError and ConfigError of the pieces; MapError if a worker dies; ConfigError without Dask.
    """
    if workers.dask is None and (workers.processes <= 1 or len(jobs) <= 1):
        # Here errors need not be values, so they are as they were raised.
        for job in jobs:
            yield job, run_job(job, folder)
        return
    work = functools.partial(_guarded, folder=folder)
    with _probe(folder) as seen:
        for job, result in parallel.run_all(jobs, work, workers, _PURPOSE, name=job_name, seen=seen):
            yield job, _unpacked(result)


@contextmanager
def _probe(folder: Path) -> Iterator[Path]:
    """A file that only who shares the folder sees: elsewhere there may be one of its name."""
    probe = folder / f".shared.{os.getpid()}"
    probe.touch()
    try:
        yield probe
    finally:
        probe.unlink()


def _guarded(job: Job, folder: Path) -> Record | Source | tuple[str, str]:
    """Errors as values: those of libraries may not survive the way through a pipe."""
    cv2.setNumThreads(1)
    try:
        with rasterio.Env(GDAL_CACHEMAX=_WORKER_CACHE_BYTES, GDAL_NUM_THREADS="1"):
            return run_job(job, folder)
    except ConfigError as err:
        return "config", str(err)
    except OrtholocError as err:
        return "map", str(err)
    except MemoryError:
        return "map", "a piece of the build ran out of memory; use fewer processes: --jobs 1"
    except Exception:
        return "map", f"a piece of the build failed unexpectedly, please report it:\n{traceback.format_exc()}"


def _unpacked(result: Any) -> Record | Source:
    if isinstance(result, tuple):
        kind, message = result
        raise ConfigError(message) if kind == "config" else MapError(message)
    assert isinstance(result, Record | Source), "a job gives a record or a source"
    return result
