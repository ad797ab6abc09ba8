"""Any mix of public geodata to an area pack, complete or not there at all."""

from __future__ import annotations

import hashlib
import logging
import math
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.parallel import Workers
from ortholoc_edge.tiles import alignment, coverage, encode, features, matchability, stac, vrt
from ortholoc_edge.tiles.area import Area
from ortholoc_edge.tiles.budget import Estimate, Sampler, Settings, settings_within
from ortholoc_edge.tiles.cog import block_cache
from ortholoc_edge.tiles.features import PER_MPX
from ortholoc_edge.tiles.georeference import Georeference, VerticalDatum, VerticalKind
from ortholoc_edge.tiles.install import install, work_folder
from ortholoc_edge.tiles.lattice import CROP_PX, Lattice, PixelBox, meeting
from ortholoc_edge.tiles.levels import STORED_LEVELS
from ortholoc_edge.tiles.manifest import (
    FORMAT,
    MANIFEST_NAME,
    VERSION,
    Alignment,
    Dop,
    DopTile,
    Dsm,
    DsmTile,
    FeatureLayer,
    FeatureTile,
    FileNote,
    Manifest,
    SourceNote,
    layer_box,
    write_manifest,
)
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.plan import LayerPlan, Plan, lat_lon_of, make_plan, named_vertical
from ortholoc_edge.tiles.sources import Source, discover, with_common_stretch
from ortholoc_edge.tiles.store import MapStore
from ortholoc_edge.tiles.systems import datum_shift_caveat
from ortholoc_edge.tiles.tasks import (
    DopJob,
    DsmJob,
    FeatureJob,
    Job,
    PrepareJob,
    Record,
    TileJob,
    finished,
    job_name,
    run_all,
    write_file,
)
from ortholoc_edge.tiles.vertical import derive_offsets

logger = logging.getLogger(__name__)

Progress = Callable[[float, str], None]
# What heights are measured from, and the EPSG code of that.
_Heights = tuple[VerticalKind, int | None]

# LERC's error should vanish beside the DSM's own (0.1 to 0.3 m): 5 cm, less for the finer grids of low flights.
_MAX_Z_ERROR_M = 0.05
_MAX_Z_ERROR_PER_GSD = 1.0 / 20.0

_BUILD_CACHE_BYTES = 256 * 2**20
# Of the DOP, what the check of DOP against DSM reads: memory must not grow with the area.
_MAX_CHECKED_BYTES = 256 * 2**20
_GROUP_TILES = 3
# Below the hidden folder: pieces of work, and sources that were made plain.
_WORK = "work"
# CPU time of a pixel's features, of that of its compression.
_FEATURE_EFFORT = 5.0
# A size budget that was missed is tried again at lower quality, this often.
_MAX_TRIALS = 4


@dataclass(frozen=True, slots=True)
class PackOptions:
    """How to build, and what the sources do not say about themselves.

    Attributes:
        dop_compression, quality: of the DOP; quality 1-100, WEBP is lossless at 100.
        max_z_error_m: of the DSM's compression; None: the lower of 5 cm and a twentieth of its GSD.
        dop_gsd_m, dsm_gsd_m: pixel sizes of the pack; None: those of the sources.
        max_size_bytes: of the whole pack; quality, then pixel sizes give way. None: no limit.
        area: what to keep; None: everything.
        source_crs: of sources that do not say it: one, or pairs of a pattern of names and a CRS; the first that fits.
        pack_crs: of the pack; None: that of most of the orthophoto.
        max_hole_cells: largest hole of the DSM that is closed, where its rim is a plane; 0: none.
        features: matcher whose features of the DOP are precomputed; None: none.
        features_per_mpx: how many are kept per million pixels of each level.
        vertical: what heights are measured from; None: what the DSM's CRS says.
        vertical_epsg: vertical system of orthometric heights.
        geoid_undulation_m: height of the geoid above the ellipsoid in the area.
        dop_date, dsm_date: of acquisition, instead of what the sources say: 2023, 2023-06 or 2023-06-04.
        attribution, licence: of the sources.
        true_ortho: whether the DOP is one; None: not known.
        dop_sigma_m, dsm_sigma_m: planimetric and vertical error of the sources, 1 sigma.
        force: replace a pack at the output path.
        created: what to write as the time of the build, UTC; None: nothing, so that equal input gives equal bytes.
    Raises: ConfigError for a value out of range.
    """

    dop_compression: encode.Compression = "webp"
    quality: int = 85
    max_z_error_m: float | None = None
    dop_gsd_m: float | None = None
    dsm_gsd_m: float | None = None
    max_size_bytes: int | None = None
    area: Area | None = None
    source_crs: str | tuple[tuple[str, str], ...] | None = None
    pack_crs: str | None = None
    max_hole_cells: int = 16
    features: str | None = None
    features_per_mpx: float = PER_MPX
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
        if self.max_size_bytes is not None and self.max_size_bytes < 1:
            raise ConfigError(f"max_size_bytes {self.max_size_bytes}: must be positive")
        if not (np.isfinite(self.features_per_mpx) and self.features_per_mpx > 0):
            raise ConfigError(f"features_per_mpx {self.features_per_mpx}: must be positive")
        if self.max_hole_cells < 0:
            raise ConfigError(f"max_hole_cells {self.max_hole_cells}: must be 0 or more")
        for name in ("dop_sigma_m", "dsm_sigma_m"):
            sigma = getattr(self, name)
            if sigma is not None and not (np.isfinite(sigma) and sigma >= 0):
                raise ConfigError(f"{name} {sigma}: must be a length in metres, 0 or more")
        for name in ("dop_date", "dsm_date"):
            date = getattr(self, name)
            if date is not None and not _is_date(date):
                raise ConfigError(f"{name} {date!r}: write it as 2023, 2023-06 or 2023-06-04, a day of the calendar")


def _is_date(text: str) -> bool:
    if not re.fullmatch(r"\d{4}(-\d{2}(-\d{2})?)?", text):
        return False
    try:
        datetime.strptime((text + "-01-01")[:10], "%Y-%m-%d")
    except ValueError:
        return False
    return True


@dataclass(frozen=True, slots=True)
class Preview:
    """What a build would do: for the dry run."""

    plan: Plan
    settings: Settings
    estimate: Estimate


def build_pack(
    dop: Path | Sequence[Path],
    dsm: Path | Sequence[Path],
    out: Path,
    options: PackOptions | None = None,
    progress: Progress | None = None,
    workers: Workers | None = None,
    finish: Callable[[Path], None] | None = None,
) -> Pack:
    """Build an area pack from orthophotos and surface models.

    The work is done in a hidden folder beside ``out``, where a build that was cut off is taken up again; only a
    complete and checked pack takes the name ``out``, in one step.

    Args:
        dop, dsm: files and folders; see `sources.discover`.
        out: folder of the pack.
        progress: called with a fraction 0-1 and what is being done.
        finish: called with the complete folder before it takes its name: what else belongs to it, as a signature.
    Raises: MapError for unusable sources and failed writes; ConfigError for options that contradict each other.
    """
    options, workers = options or PackOptions(), workers or Workers()
    say = progress or _silent
    dop, dsm = _paths(dop), _paths(dsm)
    out = out.resolve()
    _check_output(out, (*dop, *dsm), options.force)
    say(0.0, "looking at the sources")
    with block_cache(_BUILD_CACHE_BYTES):
        layers = _discovered(dop, dsm, options)
        heights = _vertical_kind(options, layers[1])
        model_sha256 = None if options.features is None else features.model_of(options.features)
        with _explained(out), work_folder(out) as folder:
            plan, settings, _ = _settled(layers, heights, options, folder, estimated=False)
            for trial in range(_MAX_TRIALS):
                staged = _Build(plan, settings, heights, options, model_sha256, folder, workers, say).run()
                size = sum(path.stat().st_size for path in staged.rglob("*") if path.is_file())
                limit = options.max_size_bytes
                if limit is None or size <= limit:
                    break
                # Only the orthophoto gives way.
                dop_bytes = sum(path.stat().st_size for path in (staged / "dop").iterdir())
                share = 1 - (size - limit) / dop_bytes
                if trial == _MAX_TRIALS - 1 or settings.quality <= 10 or share <= 0:
                    raise MapError(
                        f"{out}: {size / 1e6:.1f} MB at quality {settings.quality}, more than --max-size allows;"
                        " give it a smaller --area or --dop-gsd a coarser value"
                    )
                # Bytes of a lossy picture fall somewhat slower than its quality number.
                lower = int(settings.quality * share**1.5)
                settings = replace(settings, quality=max(min(lower, settings.quality - 3), 10))
                logger.info("%s: %.1f MB is too much; again at quality %d", out, size / 1e6, settings.quality)
            if finish is not None:
                finish(staged)
            install(staged, out)
    say(1.0, "done")
    return Pack.open(out)


def preview_build(
    dop: Path | Sequence[Path], dsm: Path | Sequence[Path], out: Path, options: PackOptions
) -> Preview:
    """What `build_pack` would do, and how large the pack would be. Leaves nothing behind.

    Raises: as `build_pack`.
    """
    out = out.resolve()
    _check_output(out, (*_paths(dop), *_paths(dsm)), options.force)
    with block_cache(_BUILD_CACHE_BYTES), _explained(out):
        layers = _discovered(_paths(dop), _paths(dsm), options)
        heights = _vertical_kind(options, layers[1])
        # Not the build's own folder: what is done there already must outlive this.
        there = next(folder for folder in out.parents if folder.is_dir())
        with tempfile.TemporaryDirectory(prefix=f".{out.name}.estimate.", dir=there) as scratch:
            plan, settings, estimate = _settled(layers, heights, options, Path(scratch))
            assert estimate is not None, "asked for"
            return Preview(plan, settings, estimate)


def _silent(fraction: float, message: str) -> None:
    pass


def _paths(given: Path | Sequence[Path]) -> tuple[Path, ...]:
    return (given,) if isinstance(given, Path) else tuple(given)


def _check_output(out: Path, sources: Sequence[Path], force: bool) -> None:
    for source in sources:
        if source.resolve().is_relative_to(out) or out.is_relative_to(source.resolve()):
            raise MapError(f"{out}: contains the source {source.name} or lies in it; choose another output directory")
    if not out.exists():
        return
    if not force:
        raise MapError(f"{out}: exists already; choose another path, or replace it with --force")
    # --force deletes what it replaces, so it must not take a mistyped path for a pack.
    if not (out.is_dir() and (_is_pack(out) or not any(out.iterdir()))):
        raise MapError(f"{out}: exists and is no area pack; it will not be replaced, choose another path")
    # Found now, not when all tiles are done.
    if out.is_mount():
        raise MapError(
            f"{out}: a file system is mounted there, so it cannot be replaced in one step; name a folder in it"
        )


def _is_pack(folder: Path) -> bool:
    """Also a damaged one, or of another version. Programs for browsers have a manifest of that name, too."""
    try:
        return FORMAT.encode() in (folder / MANIFEST_NAME).read_bytes()
    except OSError:
        return False


@contextmanager
def _explained(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as err:
        where = out.parent if out.parent.exists() else Path("/")
        free_mb = shutil.disk_usage(where).free / 1e6
        raise MapError(
            f"{out}: cannot be written ({err}; {free_mb:.0f} MB free); check free space and permissions"
        ) from err


def _discovered(
    dop: Sequence[Path], dsm: Sequence[Path], options: PackOptions
) -> tuple[list[Source], list[Source]]:
    pictures = discover(dop, "dop", assign_crs=options.source_crs, date=options.dop_date)
    heights = discover(dsm, "dsm", assign_crs=options.source_crs, date=options.dsm_date)
    return with_common_stretch(pictures), heights


def _planned(layers: tuple[list[Source], list[Source]], options: PackOptions) -> Plan:
    return make_plan(
        *layers,
        pack_crs=options.pack_crs,
        dop_gsd_m=options.dop_gsd_m,
        dsm_gsd_m=options.dsm_gsd_m,
        area=options.area,
    )


def _settings(plan: Plan, options: PackOptions) -> Settings:
    dsm_gsd_m = plan.dsm.lattice.pixel_m
    max_z_error_m = options.max_z_error_m or min(_MAX_Z_ERROR_M, round(dsm_gsd_m * _MAX_Z_ERROR_PER_GSD, 6))
    return Settings(
        dop_gsd_m=plan.dop.lattice.pixel_m,
        dsm_gsd_m=dsm_gsd_m,
        compression=options.dop_compression,
        quality=options.quality,
        max_z_error_m=max_z_error_m,
        features_per_mpx=0.0 if options.features is None else options.features_per_mpx,
    )


def _settled(
    layers: tuple[list[Source], list[Source]],
    heights: _Heights,
    options: PackOptions,
    folder: Path,
    estimated: bool = True,
) -> tuple[Plan, Settings, Estimate | None]:
    """The plan, at pixel sizes and quality that fit the size budget; with an estimate if there is a budget or one is
    wanted."""
    plan = _planned(layers, options)
    _check_heights(plan, heights, options)
    settings = _settings(plan, options)
    if options.max_size_bytes is None:
        return plan, settings, Sampler(plan, folder / _WORK).estimate(settings) if estimated else None
    settings, estimate = settings_within(Sampler(plan, folder / _WORK), settings, options.max_size_bytes)
    logger.info(
        "for %.0f MB: DOP %.3g m/px at quality %d, DSM %.3g m/px within %.3g m, about %.1f MB",
        options.max_size_bytes / 1e6,
        settings.dop_gsd_m,
        settings.quality,
        settings.dsm_gsd_m,
        settings.max_z_error_m,
        estimate.bytes / 1e6,
    )
    fitted = replace(options, dop_gsd_m=settings.dop_gsd_m, dsm_gsd_m=settings.dsm_gsd_m)
    return _planned(layers, fitted), settings, estimate


def _check_heights(plan: Plan, heights: _Heights, options: PackOptions) -> None:
    """Say what is wrong with heights and places in the area now, not when all tiles are done.

    Raises: as `derive_offsets`.
    """
    lat_lon = None
    if plan.crs is not None:
        west, south, east, north = plan.bounds
        corners = [(west, south), (east, south), (east, north), (west, north)]
        lat_lon = lat_lon_of(plan.crs, [((west + east) / 2, (south + north) / 2), *corners])
        caveat = datum_shift_caveat(plan.crs, (float(lat_lon[0, 0]), float(lat_lon[0, 1])))
        if caveat is not None:
            logger.warning("%s: %s", plan.crs, caveat)
    derive_offsets(*heights, options.geoid_undulation_m, lat_lon)


def _vertical_kind(options: PackOptions, dsm: Sequence[Source]) -> _Heights:
    """Kind and EPSG code of the heights, by the options or the sources.

    Raises: ConfigError if neither says it: a silent mix-up is an altitude error of 30 to 50 m.
    """
    kind, epsg = options.vertical, options.vertical_epsg
    named = named_vertical(dsm)
    if kind is None and named is None:
        raise ConfigError(
            f"{dsm[0].name}: its CRS does not say what heights are measured from; say it with --vertical orthometric"
            " [--vertical-epsg 7837], --vertical ellipsoid --geoid-undulation-m METRES, or, if nobody knows and no"
            " autopilot will use the pack, --vertical unknown"
        )
    if kind is None:
        assert named is not None, "checked"
        kind = named[0]
    if named is not None and kind != named[0]:
        logger.warning("%s: its CRS says %s heights, --vertical %s is taken", dsm[0].name, named[0], kind)
    elif named is not None and epsg is not None and named[1] not in (None, epsg):
        logger.warning("%s: its CRS says EPSG:%d, --vertical-epsg %d is taken", dsm[0].name, named[1], epsg)
    elif named is not None and epsg is None:
        epsg = named[1]
    return kind, epsg


class _Build:
    """One build at given settings: from a plan to a staged pack."""

    def __init__(
        self,
        plan: Plan,
        settings: Settings,
        heights: _Heights,
        options: PackOptions,
        model_sha256: str | None,
        folder: Path,
        workers: Workers,
        say: Progress,
    ) -> None:
        self._plan = plan
        self._settings = settings
        self._vertical = heights
        self._options = options
        self._model_sha256 = model_sha256
        self._work = folder / _WORK
        self._staged = folder / "pack"
        self._workers = workers
        self._say = say
        self._names: dict[TileJob, str] = {}

    def run(self) -> Path:
        """Returns: the folder of the complete pack, checked."""
        self._work.mkdir(exist_ok=True)
        # A pack that was staged before a kill may be an old one, exchanged out of its place.
        shutil.rmtree(self._staged, ignore_errors=True)
        self._staged.mkdir()
        plan, settings = self._plan, self._settings
        dop_sources, dsm_sources = self._prepared()
        dop_jobs = [
            DopJob(
                tuple(dop_sources[k] for k in tile.sources),
                plan.dop.lattice,
                tile.box,
                plan.crs,
                plan.area,
                settings.compression,
                settings.quality,
            )
            for tile in plan.dop.tiles
        ]
        dsm_jobs = [
            DsmJob(
                tuple(dsm_sources[k] for k in tile.sources),
                plan.dsm.lattice,
                tile.box,
                plan.crs,
                plan.area,
                settings.max_z_error_m,
                self._options.max_hole_cells,
            )
            for tile in plan.dsm.tiles
        ]
        feature_jobs: list[FeatureJob] = []
        if self._options.features is not None and self._model_sha256 is not None:
            feature_jobs = [
                FeatureJob(
                    job.sources,
                    job.lattice,
                    job.box,
                    job.crs,
                    job.area,
                    self._options.features,
                    self._model_sha256,
                    features.ENCODING,
                    self._options.features_per_mpx,
                )
                for job in dop_jobs
            ]
        records = self._done([*dop_jobs, *dsm_jobs, *feature_jobs])
        dop_records, rest = records[: len(dop_jobs)], records[len(dop_jobs) :]
        dsm_records, feature_records = rest[: len(dsm_jobs)], rest[len(dsm_jobs) :]
        manifest = self._manifest(dop_records, dop_jobs, dsm_records, dsm_jobs)
        if feature_jobs:
            manifest = self._with_features(manifest, feature_jobs, feature_records)
        self._say(0.92, "checking the orthophoto against the surface model")
        manifest = self._with_reports(manifest, dop_records, dsm_records)
        write_manifest(manifest, self._staged / MANIFEST_NAME)
        self._say(0.98, "checking the pack")
        if missing := Pack.open(self._staged).missing:
            raise MapError(f"{self._staged}: {min(missing)} was not written as it should; check the disk")
        return self._staged

    # -- work ------------------------------------------------------------------------------------------

    def _prepared(self) -> tuple[list[Source], list[Source]]:
        """The sources of DOP and DSM in forms that windows can be read from."""
        layers = self._plan.dop, self._plan.dsm
        sources = tuple(list(layer.sources) for layer in layers)
        places = {
            PrepareJob(layer.sources[k]): (number, k)
            for number, layer in enumerate(layers)
            for k in sorted({k for tile in layer.tiles for k in tile.sources})
        }
        for done, (job, source) in enumerate(self._run(list(places)), 1):
            assert isinstance(job, PrepareJob) and isinstance(source, Source), "preparing gives a source"
            number, k = places[job]
            sources[number][k] = source
            self._say(0.2 * done / len(places), "reading sources")
        return sources[0], sources[1]

    def _done(self, jobs: Sequence[TileJob]) -> list[Record]:
        """Records of all pieces of work, those of an earlier run taken over."""
        names = {job: job_name(job) for job in jobs}
        self._names.update(names)
        records = {job: finished(job, self._work) for job in jobs}
        waiting = [job for job in jobs if records[job] is None]
        if len(waiting) < len(jobs):
            logger.info("%d of %d pieces are there from an earlier run", len(jobs) - len(waiting), len(jobs))
        total, done = sum(map(_effort, waiting)), 0.0
        for job, made in self._run(waiting):
            assert isinstance(made, Record) and not isinstance(job, PrepareJob), "a tile gives a record"
            if job_name(job) != names[job]:
                others = " or another" if len(job.sources) > 1 else ""
                raise MapError(
                    f"{job.sources[0].where}{others}: was written while the build read it; build again when it is"
                    " complete"
                )
            records[job] = made
            done += _effort(job)
            self._say(0.2 + 0.72 * done / total, "extracting features" if isinstance(job, FeatureJob) else "tiles")
        return [record for job in jobs if (record := records[job]) is not None]

    def _run(self, jobs: Sequence[Job]) -> Iterator[tuple[Job, Record | Source]]:
        return run_all(jobs, self._work, self._workers)

    # -- what it makes -----------------------------------------------------------------------------------

    def _manifest(
        self,
        dop_records: Sequence[Record],
        dop_jobs: Sequence[DopJob],
        dsm_records: Sequence[Record],
        dsm_jobs: Sequence[DsmJob],
    ) -> Manifest:
        plan, options, settings = self._plan, self._options, self._settings
        dop_tiles, dsm_tiles = [], []
        dop_order, dsm_order = _shown(plan.dop, dop_records), _shown(plan.dsm, dsm_records)
        for tile, job, record in zip(plan.dop.tiles, dop_jobs, dop_records, strict=True):
            if record.bytes:
                cells = np.frombuffer(record.matchability, np.uint8)
                known = cells[cells != matchability.NO_MAP]
                dop_tiles.append(
                    DopTile(
                        **self._tile("dop", plan.dop.lattice, tile.box, job, record),
                        sources=tuple(dop_order[tile.sources[k]] for k in record.shown),
                        matchability=round(float(known.mean()) / 100.0, 4) if len(known) else None,
                    )
                )
        for tile, dsm_job, record in zip(plan.dsm.tiles, dsm_jobs, dsm_records, strict=True):
            if record.bytes:
                dsm_tiles.append(
                    DsmTile(
                        **self._tile("dsm", plan.dsm.lattice, tile.box, dsm_job, record),
                        sources=tuple(dsm_order[tile.sources[k]] for k in record.shown),
                        min_m=record.min_m,
                        max_m=record.max_m,
                        filled_fraction=record.filled_cells / (tile.box.width * tile.box.height),
                    )
                )
        for name, tiles, layer in (("orthophoto", dop_tiles, plan.dop), ("surface model", dsm_tiles, plan.dsm)):
            if not tiles:
                raise MapError(
                    f"{layer.sources[0].name}: no valid pixel of the {name} inside the area; check its nodata value"
                    " or mask with gdalinfo, and --area"
                )
        dop = Dop(
            lattice=plan.dop.lattice,
            tiles=dop_tiles,
            stored_levels=STORED_LEVELS,
            compression=_described(settings),
            sources=_notes(plan.dop, dop_order, plan.crs),
            date=options.dop_date,
            attribution=options.attribution,
            licence=options.licence,
            true_ortho=options.true_ortho,
            sigma_m=options.dop_sigma_m,
        )
        dsm = Dsm(
            lattice=plan.dsm.lattice,
            tiles=dsm_tiles,
            stored_levels=STORED_LEVELS,
            compression="LERC_ZSTD",
            sources=_notes(plan.dsm, dsm_order, plan.crs),
            date=options.dsm_date,
            attribution=options.attribution,
            licence=options.licence,
            max_z_error_m=settings.max_z_error_m,
            nodata=encode.NODATA,
            sigma_m=options.dsm_sigma_m,
        )
        anchor = _anchor(plan.dop.lattice, layer_box(dop_tiles))
        vertical, dsm_tiles = self._heights(anchor, dsm)
        created = None
        if options.created is not None:
            created = options.created.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        return Manifest(
            format=FORMAT,
            version=VERSION,
            created=created,
            crs=plan.crs,
            anchor=anchor,
            vertical=vertical,
            dop=dop,
            dsm=msgspec.structs.replace(dsm, tiles=dsm_tiles),
        )

    def _tile(
        self, layer: str, lattice: Lattice, box: PixelBox, job: TileJob, record: Record
    ) -> dict[str, Any]:
        file = f"{layer}/{lattice.tile_name(box)}.tif"
        self._take(job, file)
        return {
            "file": file,
            "bytes": record.bytes,
            "sha256": record.sha256,
            "column": box.column,
            "row": box.row,
            "width": box.width,
            "height": box.height,
            "valid_fraction": record.valid_fraction,
            "segment_crc32": record.segment_crc32,
        }

    def _take(self, job: TileJob, file: str) -> None:
        """The file of a piece of work under its name in the pack; the work keeps it, for a build cut off now."""
        target = self._staged / file
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(self._work / self._names[job], target)
        except OSError:
            shutil.copyfile(self._work / self._names[job], target)

    def _heights(self, anchor: tuple[float, float], dsm: Dsm) -> tuple[VerticalDatum, list[DsmTile]]:
        """The vertical datum at the anchor, and the tiles with the offsets of their own."""
        crs, stated_m = self._plan.crs, self._options.geoid_undulation_m
        if crs is None:
            return derive_offsets(*self._vertical, stated_m, None, quiet=True)[0], dsm.tiles
        centres = []
        for tile in dsm.tiles:
            west, south, east, north = dsm.lattice.grid(tile.box).bounds
            centres.append(((west + east) / 2, (south + north) / 2))
        lat_lon = lat_lon_of(crs, [anchor, *centres])
        vertical, amsl, ellipsoid = derive_offsets(*self._vertical, stated_m, lat_lon, quiet=True)
        tiles = [
            msgspec.structs.replace(
                tile,
                amsl_minus_map_m=None if amsl is None else round(float(amsl[k + 1]), 4),
                ellipsoid_minus_map_m=None if ellipsoid is None else round(float(ellipsoid[k + 1]), 4),
            )
            for k, tile in enumerate(dsm.tiles)
        ]
        return vertical, tiles

    def _with_features(
        self, manifest: Manifest, jobs: Sequence[TileJob], records: Sequence[Record]
    ) -> Manifest:
        """With the features of the tiles that are in the pack, bound to them."""
        assert self._options.features is not None and self._model_sha256 is not None, "asked for"
        numbers = {(tile.column, tile.row): number for number, tile in enumerate(manifest.dop.tiles)}
        tiles = []
        for job, record in zip(jobs, records, strict=True):
            number = numbers.get((job.box.column, job.box.row))
            if not record.bytes or number is None:
                continue
            tile = manifest.dop.tiles[number]
            file = f"features/{Path(tile.file).stem}.npy"
            self._take(job, file)
            tiles.append(
                FeatureTile(
                    file=file,
                    bytes=record.bytes,
                    sha256=record.sha256,
                    dop=number,
                    dop_sha256=tile.sha256,
                    counts=record.counts,
                )
            )
        layer = FeatureLayer(
            matcher=self._options.features,
            model_sha256=self._model_sha256,
            encoding=features.ENCODING,
            per_mpx=self._options.features_per_mpx,
            tiles=tiles,
        )
        return msgspec.structs.replace(manifest, features=layer)

    def _with_reports(
        self, manifest: Manifest, dop_records: Sequence[Record], dsm_records: Sequence[Record]
    ) -> Manifest:
        """With everything beside the tiles: what the checks found, mosaics and STAC for a GIS."""
        georeference = Georeference(manifest.crs, manifest.vertical, manifest.anchor)
        manifest = msgspec.structs.replace(manifest, alignment=self._checked(manifest))
        dop_cells = [record for record in dop_records if record.bytes]
        dsm_cells = [record for record in dsm_records if record.bytes]
        reports = {
            "reports/coverage.geojson": coverage.coverage_geojson(
                manifest,
                georeference,
                [_cells(tile, record.share) for tile, record in zip(manifest.dop.tiles, dop_cells, strict=True)],
                [_cells(tile, record.share) for tile, record in zip(manifest.dsm.tiles, dsm_cells, strict=True)],
                [hole for record in dsm_cells for hole in record.filled],
            ),
            "reports/matchability.tif": matchability.matchability_tif(
                manifest,
                [_cells(tile, record.matchability) for tile, record in zip(manifest.dop.tiles, dop_cells, strict=True)],
                [_cells(tile, record.share) for tile, record in zip(manifest.dsm.tiles, dsm_cells, strict=True)],
            ),
            **stac.stac_files(manifest, georeference),
        }
        notes = []
        for file, data in reports.items():
            target = self._staged / file
            target.parent.mkdir(parents=True, exist_ok=True)
            write_file(target, data)
            notes.append(FileNote(file=file, bytes=len(data), sha256=hashlib.sha256(data).hexdigest()))
        # Not listed: a GIS writes its statistics into them, and nothing in flight reads them.
        write_file(self._staged / vrt.DOP_VRT, vrt.mosaic(manifest.dop, manifest.crs))
        write_file(self._staged / vrt.DSM_VRT, vrt.mosaic(manifest.dsm, manifest.crs))
        return msgspec.structs.replace(manifest, files=notes)

    def _checked(self, manifest: Manifest) -> Alignment | None:
        """How DOP and DSM lie on each other; what looks wrong is logged."""
        dop = _groups(manifest.dop)
        boxes = [manifest.dop.lattice.grid(tile.box).bounds for tile in dop]
        dsm = [
            tile
            for tile in manifest.dsm.tiles
            if any(meeting(manifest.dsm.lattice.grid(tile.box).bounds, box) for box in boxes)
        ]
        if not dsm:
            return None
        part = msgspec.structs.replace(
            manifest,
            dop=msgspec.structs.replace(manifest.dop, tiles=dop),
            dsm=msgspec.structs.replace(manifest.dsm, tiles=dsm),
            features=None,
        )
        georeference = Georeference(manifest.crs, manifest.vertical, manifest.anchor)
        staged = Pack(self._staged, part, georeference)
        # A store makes GDAL's cache small.
        with block_cache(_BUILD_CACHE_BYTES), MapStore(staged, cache_bytes=_BUILD_CACHE_BYTES) as store:
            found = alignment.measure(store)
            problems = [*alignment.warnings(found, manifest.dsm.gsd_m), *alignment.misplaced(store)]
        for problem in problems:
            logger.warning("%s", problem)
        return found


def _effort(job: TileJob) -> float:
    """CPU time of a piece of work, roughly and relative to others: for the progress."""
    return job.box.width * job.box.height * (_FEATURE_EFFORT if isinstance(job, FeatureJob) else 1.0)


def _shown(layer: LayerPlan, records: Sequence[Record]) -> dict[int, int]:
    """Sources of the plan that are visible in the pack, and their numbers in its list."""
    seen = {tile.sources[k] for tile, record in zip(layer.tiles, records, strict=True) for k in record.shown}
    return {k: number for number, k in enumerate(sorted(seen))}


def _notes(layer: LayerPlan, order: dict[int, int], crs: str | None) -> list[SourceNote]:
    return [
        SourceNote(
            name=layer.sources[k].name,
            date=layer.sources[k].date,
            crs=layer.sources[k].crs,
            gsd_m=round(layer.sources[k].gsd_m, 6),
            resampled=layer.resampled(k, crs),
        )
        for k in order
    ]


def _described(settings: Settings) -> str:
    if settings.compression == "webp" and settings.quality == 100:
        return "WEBP lossless"
    return f"{settings.compression.upper()} quality {settings.quality}"


def _anchor(lattice: Lattice, box: PixelBox) -> tuple[float, float]:
    west, south, east, north = lattice.grid(box).bounds
    step = 100.0 if min(east - west, north - south) >= 400.0 else 10.0
    return round((west + east) / 2 / step) * step, round((south + north) / 2 / step) * step


def _cells(tile: DopTile | DsmTile, data: bytes) -> np.ndarray:
    return np.frombuffer(data, np.uint8).reshape(tile.height // CROP_PX, tile.width // CROP_PX)


def _groups(dop: Dop) -> list[DopTile]:
    """All tiles of a small orthophoto; of a large one groups of neighbours, spread over it.

    Neighbours, because where a surface model lies a tile off, the right place must be among what is read.
    """
    groups: dict[tuple[int, int], list[DopTile]] = {}
    for tile in dop.tiles:
        column, row = dop.lattice.tile_key(tile.column, tile.row)
        groups.setdefault((column // _GROUP_TILES, row // _GROUP_TILES), []).append(tile)
    keys = sorted(groups)
    share = _MAX_CHECKED_BYTES / sum(tile.bytes for tile in dop.tiles)
    step = max(math.ceil(1.0 / share), 1)
    return [tile for key in keys[min(step // 2, len(keys) - 1) :: step] for tile in groups[key]]
