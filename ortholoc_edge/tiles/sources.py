"""Files, folders and ZIPs of public geodata to sources that can be read on a grid of the pack."""

from __future__ import annotations

import logging
import os
import re
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import date as calendar_day
from fnmatch import fnmatch
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pyproj
from pyproj.exceptions import CRSError, ProjError
from rasterio.enums import ColorInterp

from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles import points
from ortholoc_edge.tiles.cog import raster_grid
from ortholoc_edge.tiles.prepare import prepare
from ortholoc_edge.tiles.resample import DopPixels, is_copied, read_dop, read_dsm, transform_caveat
from ortholoc_edge.tiles.source import Kind, Source, Stretch, fingerprint, named_errors, opened, with_common_stretch
from ortholoc_edge.tiles.vertical import vertical_of

__all__ = [
    "DopPixels",
    "Source",
    "Stretch",
    "discover",
    "fingerprint",
    "is_copied",
    "prepare",
    "read_dop",
    "read_dsm",
    "transform_caveat",
    "with_common_stretch",
]

logger = logging.getLogger(__name__)

# What --crs says for files that mean local metres.
LOCAL = "local"

_RASTERS = (".tif", ".tiff", ".jp2", ".j2k", ".jpg", ".jpeg", ".png", ".img")
_VRT = ".vrt"
# Pictures that lie about in folders: without a georeference they are previews.
_PICTURES = (".jpg", ".jpeg", ".png")
_WORLD_FILES = (".tfw", ".tifw", ".tiffw", ".jgw", ".jpgw", ".j2w", ".jp2w", ".pgw", ".pngw", ".wld")

# Formats whose windows cost as much as the whole: one tile, one stream, or text.
_SLOW_DRIVERS = ("JP2OpenJPEG", "JPEG", "PNG", "WEBP", "AAIGrid")
_LOSSY_COMPRESSION = ("JPEG", "YCbCr JPEG", "WEBP", "LERC", "JPEG2000")
# A TIFF in one or few compressed strips is one stream, too.
_SLOW_BLOCK_PX = 2**24
_MAX_BLOCK_PX = 2**28
# County mosaics have 10^10 pixels; a VRT may have more.
_MAX_PX = 2**36

_MAX_COORDINATE = 1e9
_PIXEL_RANGE = (1e-9, 1e6)

_METRES = ("", "m", "metre", "meter", "metres", "meters", "1")

# swissIMAGE ends names with the code of its system, EPSG:2056, which is no year yet.
_FIRST_YEAR, _LAST_YEAR = 1980, 2049


@dataclass(frozen=True, slots=True)
class _Found:
    """A file to probe. ``asked``: named by the user, so it must be usable."""

    file: Path
    member: str | None
    asked: bool

    @property
    def name(self) -> str:
        return self.file.name if self.member is None else f"{self.file.name}/{self.member}"

    @property
    def where(self) -> str:
        return str(self.file) if self.member is None else f"{self.file}/{self.member}"

    @property
    def suffix(self) -> str:
        return PurePosixPath(self.member or self.file.name).suffix.lower()

    @property
    def gdal_path(self) -> str:
        # A process of a cluster has another working directory.
        file = self.file.absolute()
        return str(file) if self.member is None else f"/vsizip/{{{file}}}/{self.member}"


@dataclass(slots=True)
class _Notes:
    """What to tell once for many files."""

    skipped: list[str] = field(default_factory=list)
    overruled: dict[str, list[str]] = field(default_factory=dict)


class _NotUsableError(Exception):
    """A file that does not belong to the kind asked for; in a folder it is passed over."""


def discover(
    paths: Sequence[Path],
    kind: Kind,
    *,
    assign_crs: str | Sequence[tuple[str, str]] | None = None,
    date: str | None = None,
    point_cell_m: float | None = None,
) -> list[Source]:
    """What of ``paths`` is an orthophoto, or a surface model.

    A file is a raster or a ZIP. Folders and ZIPs are searched to any depth; what does not belong is
    passed over with one line in the log: other files, pictures without georeference, and rasters that are plainly of
    the other kind. A VRT found there counts only if nothing else is found, for it shows what lies beside it; one that
    is named counts, and the files below it do not count again.
    Args:
        assign_crs: system of files that name none: world files, text. A file's own wins. "local": local
            metres. Or pairs of a pattern of names, as "*_33_*", and a system; the first that fits counts.
        date: of acquisition of all of them; None: what their metadata or names say.
        point_cell_m: side of the cells that point clouds are gridded to; None: as `points.cloud_grid` chooses.
    Returns: in the order of ``paths``, by name within a folder, each file once.
    Raises: MapError naming the file and the remedy for what is not usable; ConfigError for an unusable ``assign_crs``.
    """
    if date is not None and not re.fullmatch(r"\d{4}(-\d{2}(-\d{2})?)?", date):
        raise ConfigError(f"date {date!r}: write it as 2023, 2023-06 or 2023-06-04")
    pairs = [("*", assign_crs)] if isinstance(assign_crs, str) else list(assign_crs or ())
    systems = {crs: None if crs == LOCAL else _parsed(crs) for _, crs in pairs}
    notes = _Notes()
    sources: dict[tuple[Path, str | None], Source] = {}
    below: set[Path] = set()
    for path in paths:
        usable = 0
        for found in _searched(Path(path), notes):
            key = found.file.resolve(), found.member
            if key in sources:
                usable += 1
                continue
            fitting = next((crs for pattern, crs in pairs if fnmatch(found.name, pattern)), None)
            assigned = None if fitting is None else systems[fitting]
            try:
                source = _probe(found, kind, fitting, assigned, point_cell_m, notes)
            except _NotUsableError as err:
                if found.asked:
                    raise MapError(str(err)) from err
                notes.skipped.append(found.where)
                continue
            usable += 1
            sources[key] = source if date is None else replace(source, date=date)
            if found.asked and source.driver == "VRT" and found.member is None:
                with opened(source.path, source.where) as dataset:
                    below.update(Path(name).resolve() for name in dataset.files[1:])
        if usable == 0:
            what = "orthophoto" if kind == "dop" else "surface model"
            raise MapError(
                f"{path}: nothing in it can be used as {what}; give files that gdalinfo can read"
                " (GeoTIFF, JPEG 2000, VRT, XYZ, LAZ) or a folder or ZIP of such"
            )
    chosen = [source for (file, member), source in sources.items() if member is not None or file not in below]
    _check_alike(chosen)
    if notes.skipped:
        logger.info("%d files passed over: %s", len(notes.skipped), _listed(notes.skipped))
    for own, names in notes.overruled.items():
        logger.warning("%s: have the system %s, --crs is not used for them", _listed(names), own)
    return chosen


def _listed(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _parsed(crs: str) -> Any:
    try:
        return pyproj.CRS.from_user_input(crs)
    except CRSError as err:
        raise ConfigError(f"--crs {crs}: reference system not understood; write it as EPSG:25832") from err


def _check_alike(sources: list[Source]) -> None:
    """All have a system, or none."""
    without = [source for source in sources if source.crs is None]
    if without and len(without) < len(sources):
        other = next(source for source in sources if source.crs is not None)
        raise MapError(
            f"{without[0].where}: no reference system, but {other.name} has one; say which it is with --crs EPSG:n"
        )


# Finding files


def _searched(path: Path, notes: _Notes) -> Iterator[_Found]:
    if path.is_dir():
        rasters, mosaics = [], []
        for file in _files(path, notes):
            suffix = file.suffix.lower()
            if suffix == ".zip":
                rasters.extend(_members(file, notes))
            elif suffix == _VRT:
                mosaics.append(_Found(file, None, False))
            elif _known(file.name):
                rasters.append(_Found(file, None, False))
            elif not _sidecar(file.name):
                notes.skipped.append(str(file))
        if rasters:
            notes.skipped.extend(found.where for found in mosaics)
        yield from rasters or mosaics
    elif path.suffix.lower() == ".zip":
        yield from _members(path, notes)
    elif path.is_file():
        yield _Found(path, None, True)
    else:
        raise MapError(f"{path}: there is no such file; check the path")


def _files(folder: Path, notes: _Notes) -> list[Path]:
    """Files below a folder, sorted, without hidden ones. Links to folders are followed: large data lie on other disks,
    and what is silently left out is a hole in the map."""
    files: list[Path] = []
    seen: set[str] = set()
    for here, folders, names in os.walk(
        folder, onerror=lambda err: notes.skipped.append(str(err.filename)), followlinks=True
    ):
        real = os.path.realpath(here)
        folders[:] = [] if real in seen else sorted(name for name in folders if not name.startswith("."))
        files += [] if real in seen else [Path(here, name) for name in names if not name.startswith(".")]
        seen.add(real)
    return sorted(file for file in files if file.is_file())


def _members(archive: Path, notes: _Notes) -> list[_Found]:
    with named_errors(str(archive), "is not a readable ZIP"), zipfile.ZipFile(archive) as opened_zip:
        infos = [info for info in opened_zip.infolist() if not info.is_dir()]
    found, mosaics = [], []
    for info in sorted(infos, key=lambda one: one.filename):
        parts = PurePosixPath(info.filename).parts
        if any(part.startswith((".", "__MACOSX")) for part in parts):
            continue
        if info.flag_bits & 1:
            raise MapError(f"{archive}: {info.filename} is encrypted; unpack it first")
        member = _Found(archive, info.filename, False)
        if member.suffix == _VRT:
            mosaics.append(member)
        elif _known(info.filename):
            found.append(member)
        elif not _sidecar(info.filename):
            notes.skipped.append(member.where)
    return found or mosaics


def _known(name: str) -> bool:
    name = name.lower()
    return name.endswith((*_RASTERS, *points.CLOUDS, *points.TEXT, *(f"{suffix}.gz" for suffix in points.TEXT)))


def _sidecar(name: str) -> bool:
    """World files, projections, GDAL's metadata and overviews: they are read with the file they belong to."""
    return name.lower().endswith((*_WORLD_FILES, ".prj", ".aux.xml", ".ovr", ".msk"))


# What a file says about itself


def _probe(
    found: _Found, kind: Kind, assign_crs: str | None, assigned: Any, cell_m: float | None, notes: _Notes
) -> Source:
    name = (found.member or found.file.name).lower().removesuffix(".gz")
    if name.endswith((*points.CLOUDS, *points.TEXT)) and not _is_ascii_grid(found):
        return _probe_points(found, name, kind, assign_crs, assigned, cell_m, notes)
    with opened(found.gdal_path, found.where) as dataset:
        _check_size(dataset, found)
        picture = found.suffix in _PICTURES
        if dataset.transform.is_identity:
            what = f"{found.where}: no georeference; add its world file, or assign one with gdal_translate -a_ullr"
            raise _NotUsableError(what) if picture else MapError(what)
        grid = raster_grid(dataset, Path(found.where))
        if not _on_earth(grid):
            raise MapError(f"{found.where}: georeference {tuple(dataset.transform)[:6]} cannot be true; fetch it again")
        own = None if dataset.crs is None else pyproj.CRS.from_user_input(dataset.crs.to_wkt())
        bare = dataset.driver == "AAIGrid" or any(name.lower().endswith(_WORLD_FILES) for name in dataset.files)
        crs = _chosen_crs(found, own or _projection_beside(found), bare, assign_crs, assigned, notes)
        common: dict[str, Any] = {
            "path": found.gdal_path,
            "name": found.name,
            "kind": kind,
            "file": found.file.absolute(),
            "member": found.member,
            "grid": grid,
            **_referenced(found.where, crs, grid, kind),
            "date": _date(dataset, found),
            "driver": str(dataset.driver),
            "dtype": str(dataset.dtypes[0]),
            "slow": _is_slow(dataset, found),
        }
        _check_local(found.where, common["crs"], grid, assign_crs)
        return _probe_dop(dataset, found, common) if kind == "dop" else _probe_dsm(dataset, found, common)


def _is_ascii_grid(found: _Found) -> bool:
    if found.suffix != ".asc":
        return False
    with named_errors(found.where), points.stream(found.file, found.member) as source:
        return bool(source.read(5).lower() in (b"ncols", b"nrows", b"xllco", b"xllce"))


def _probe_points(
    found: _Found, name: str, kind: Kind, assign_crs: str | None, assigned: Any, cell_m: float | None, notes: _Notes
) -> Source:
    where = found.where
    if kind == "dop":
        raise _NotUsableError(f"{where}: points, expected a picture; give it as --dsm")
    own = None
    if name.endswith(points.CLOUDS):
        cloud = points.cloud_grid(found.file, found.member, where, cell_m)
        grid, own = cloud.grid, cloud.crs
    else:
        layout = points.text_layout(found.file, found.member, where)
        if layout is None and name.endswith(".txt"):
            raise _NotUsableError(f"{where}: no table of x, y and z; give text with three columns of numbers")
        if layout is None:
            raise MapError(f"{where}: no table of x, y and z; fetch it again")
        grid = points.text_grid(found.file, found.member, layout, where)
    crs = _chosen_crs(found, own or _projection_beside(found), True, assign_crs, assigned, notes)
    if crs is not None and crs.is_geographic:
        raise MapError(f"{where}: points in degrees; project them first, or give a raster")
    return Source(
        path=found.gdal_path,
        name=found.name,
        kind=kind,
        file=found.file.absolute(),
        member=found.member,
        grid=grid,
        **_referenced(where, crs, grid, kind),
        date=date_of_name(found.member or found.file.name) or date_of_name(found.file.name),
        bands=(1,),
        driver="las" if name.endswith(points.CLOUDS) else "xyz",
        dtype="float32",
    )


def _check_size(dataset: Any, found: _Found) -> None:
    rows, columns = dataset.block_shapes[0]
    if dataset.driver != "VRT" and dataset.width * dataset.height > _MAX_PX:
        raise MapError(f"{found.where}: {dataset.width} x {dataset.height} pixels cannot be true; fetch it again")
    if rows * columns > _MAX_BLOCK_PX:
        raise MapError(
            f"{found.where}: stored in blocks of {columns} x {rows} pixels, too large for memory;"
            " convert it with: gdal_translate -co TILED=YES"
        )


def _on_earth(grid: RasterGrid) -> bool:
    """Coordinates and pixels of any system, in degrees, feet or metres, are within these."""
    sides = sorted((grid.dx, abs(grid.dy)))
    return max(np.abs(grid.bounds)) < _MAX_COORDINATE and _PIXEL_RANGE[0] < sides[0] and sides[1] < _PIXEL_RANGE[1]


def _is_slow(dataset: Any, found: _Found) -> bool:
    if dataset.driver in _SLOW_DRIVERS:
        return True
    if found.member is not None and _compressed_member(found):
        return True
    rows, columns = dataset.block_shapes[0]
    return bool(rows * columns > _SLOW_BLOCK_PX and dataset.compression is not None)


def _compressed_member(found: _Found) -> bool:
    with zipfile.ZipFile(found.file) as archive:
        return archive.getinfo(str(found.member)).compress_type != zipfile.ZIP_STORED


def _projection_beside(found: _Found) -> Any:
    """The system in a .prj file of the same name."""
    if found.member is not None:
        return None
    beside = found.file.with_suffix(".prj")
    if not beside.is_file():
        return None
    with named_errors(str(beside)):
        text = beside.read_text("utf-8", errors="replace").strip()
        return pyproj.CRS.from_user_input(text) if text else None


def _chosen_crs(found: _Found, own: Any, bare: bool, assign_crs: str | None, assigned: Any, notes: _Notes) -> Any:
    if own is None:
        if assign_crs is None and bare:
            raise MapError(
                f"{found.where}: placed by a world file or by coordinates in text, which name no reference system;"
                " say which it is with --crs EPSG:n (or --crs local for local metres)"
            )
        return assigned
    if assigned is not None:
        if not _horizontal(own).equals(_horizontal(assigned), ignore_axis_order=True):
            notes.overruled.setdefault(own.name, []).append(found.name)
        elif not own.is_compound and assigned.is_compound:
            return assigned
    return own


def _check_local(where: str, crs: str | None, grid: RasterGrid, assign_crs: str | None) -> None:
    if crs is None and assign_crs is None and grid.gsd_m < 1e-4:
        raise MapError(
            f"{where}: no reference system and pixels of {grid.gsd_m:.2g}, which looks like degrees;"
            " say which it is with --crs EPSG:4326"
        )


def _horizontal(crs: Any) -> Any:
    crs = crs.sub_crs_list[0] if crs.is_compound else crs
    crs = crs.source_crs if crs.is_bound and crs.source_crs is not None else crs
    return crs.to_2d()


def _referenced(where: str, crs: Any, grid: RasterGrid, kind: Kind) -> dict[str, Any]:
    """Fields of a source that come from its system."""
    if crs is None:
        return {"crs": None, "vertical": None, "gsd_m": grid.gsd_m}
    flat = _horizontal(crs)
    if not (flat.is_projected or flat.is_geographic):
        raise MapError(
            f"{where}: {flat.name} is {flat.type_name}, which has no place on Earth; assign the right one with"
            " gdal_edit.py -a_srs EPSG:n, or remove it with gdal_edit.py -a_srs none for local metres"
        )
    code = flat.to_epsg()
    return {
        "crs": f"EPSG:{code}" if code else str(flat.to_wkt()),
        "vertical": vertical_of(crs.to_wkt(), where) if kind == "dsm" else None,
        "gsd_m": _true_gsd(where, flat, grid),
    }


def _true_gsd(where: str, crs: Any, grid: RasterGrid) -> float:
    """Side of a pixel in the middle, m: the grid's own in a metric system, else along geodesics, also on the web's
    Mercator map, whose metres are half ones at 60 degrees."""
    method = "" if crs.coordinate_operation is None else crs.coordinate_operation.method_name
    stretched = "Mercator" in method and "Transverse" not in method and "Oblique" not in method
    metric = crs.is_projected and all(abs(axis.unit_conversion_factor - 1.0) < 1e-12 for axis in crs.axis_info)
    if metric and not stretched:
        return grid.gsd_m
    xy = grid.map_from_px(np.array([[0, 0], [1, 0], [0, 1]]) + np.array([grid.width / 2, grid.height / 2]))
    with named_errors(where, "lies outside its reference system"):
        try:
            x, y = xy.T
            lon, lat = (x, y) if crs.is_geographic else pyproj.Proj(crs)(x, y, inverse=True, errcheck=True)
        except ProjError as err:
            raise ValueError(str(err)) from err
        geod = crs.get_geod()
        sides = [geod.inv(lon[0], lat[0], lon[k], lat[k])[2] for k in (1, 2)]
        gsd = float(np.sqrt(sides[0] * sides[1]))
        if not (np.isfinite(gsd) and gsd > 0):
            raise ValueError(f"position {xy[0].tolist()}")
    return gsd


def _probe_dop(dataset: Any, found: _Found, common: dict[str, Any]) -> Source:
    where, roles = found.where, list(dataset.colorinterp)
    if roles[0] == ColorInterp.palette:
        if dataset.count > 1 or dataset.dtypes[0] != "uint8":
            raise MapError(f"{where}: palette beside other bands; expand it with: gdal_translate -expand rgb")
        return Source(**common, bands=(1, 1, 1), palette=True)
    if dataset.count == 1 and dataset.dtypes[0] not in ("uint8", "uint16"):
        raise _NotUsableError(
            f"{where}: one band of {dataset.dtypes[0]}, which is no orthophoto; give it as --dsm if it holds heights"
        )
    types = set(dataset.dtypes)
    if len(types) > 1 or not types <= {"uint8", "uint16", "int16"}:
        raise MapError(
            f"{where}: samples are {', '.join(sorted(types))}, an orthophoto must have 8 or 16 bits;"
            " convert it with: gdal_translate -ot UInt16 -scale LOW HIGH 0 65535"
        )
    alpha = next((k for k, role in enumerate(roles, 1) if role == ColorInterp.alpha), None)
    rest = [k for k in range(1, dataset.count + 1) if k != alpha]
    named = [roles.index(role) + 1 for role in (ColorInterp.red, ColorInterp.green, ColorInterp.blue) if role in roles]
    nir = next((k for k in rest if _is_infrared(dataset, roles, k)), None)
    bands: tuple[int, ...]
    if len(named) == 3:
        bands = (named[0], named[1], named[2])
    elif len(rest) == 1:
        bands = (rest[0],) * 3
    elif len(rest) in (3, 4):
        # Infrared among three bands is a false-colour picture, which is as good to match.
        first = [k for k in rest if k != nir or len(rest) == 3]
        bands = (first[0], first[1], first[2])
    else:
        raise MapError(
            f"{where}: {len(rest)} bands that are not said to be red, green and blue;"
            " select them with: gdal_translate -b RED -b GREEN -b BLUE"
        )
    others = [k for k in rest if k not in bands]
    if nir in bands or nir is None:
        # The state surveys' fourth band is infrared; only a flag makes it anything else.
        nir = others[0] if len(others) == 1 and roles[others[0] - 1] in _UNNAMED else None
    compression = "" if dataset.compression is None else str(dataset.compression.value)
    lossy = compression in _LOSSY_COMPRESSION or dataset.driver in ("JPEG", "JP2OpenJPEG", "WEBP", "VRT")
    return Source(**common, bands=bands, nir=nir, alpha=alpha, lossy=lossy)


_UNNAMED = (ColorInterp.undefined, ColorInterp.gray)


def _is_infrared(dataset: Any, roles: list[Any], band: int) -> bool:
    text = (dataset.descriptions[band - 1] or "").lower()
    return roles[band - 1] == ColorInterp.nir or bool(re.search(r"\bnir\b|infra|\bnah", text))


def _probe_dsm(dataset: Any, found: _Found, common: dict[str, Any]) -> Source:
    where = found.where
    extra = [role for role in dataset.colorinterp[1:] if role != ColorInterp.alpha]
    if extra:
        raise _NotUsableError(
            f"{where}: {dataset.count} bands, expected one of heights; select it with: gdal_translate -b"
        )
    if not np.issubdtype(np.dtype(dataset.dtypes[0]), np.number) or "complex" in dataset.dtypes[0]:
        raise MapError(f"{where}: samples are {dataset.dtypes[0]}, expected heights in metres")
    if dataset.colorinterp[0] == ColorInterp.palette or (dataset.dtypes[0] == "uint8" and not found.asked):
        raise _NotUsableError(f"{where}: a picture, expected heights in metres; give it as --dop")
    unit = (dataset.units[0] or "").lower()
    if unit not in _METRES:
        raise MapError(f"{where}: heights are in {unit}; convert them to metres with gdal_calc.py")
    scale, offset = float(dataset.scales[0]), float(dataset.offsets[0])
    if not (np.isfinite([scale, offset]).all() and scale != 0):
        raise MapError(f"{where}: scale {scale:g} and offset {offset:g} of its heights cannot be true")
    return Source(**common, bands=(1,), scale=scale, offset=offset)


# Dates


def _date(dataset: Any, found: _Found) -> str | None:
    """When the pictures were taken, as far as the file says so.

    A TIFF's DateTime is when the *file* was made, months after the flight; so it only makes a year in the name
    more exact, or stands where nothing else does.
    """
    tags = {**dataset.tags(), **dataset.tags(ns="IMAGERY")}
    written = None
    for key, value in tags.items():
        plain = re.sub(r"[^a-z]", "", key.lower())
        if plain.startswith(("acquisitiondate", "dateacquired", "bildflug", "exifdatetimeoriginal")):
            stated = _stated_date(str(value))
            if stated is not None:
                return stated
        elif plain == "tifftagdatetime":
            written = _stated_date(str(value))
    named = date_of_name(found.member or found.file.name) or date_of_name(found.file.name)
    if named is None or (written is not None and written.startswith(named)):
        return written
    return named


def _stated_date(text: str) -> str | None:
    if match := re.match(r"\s*(\d{4})[-:/.]?(\d{2})[-:/.]?(\d{2})", text):
        return _valid_date(*match.groups())
    if match := re.match(r"\s*(\d{1,2})\.(\d{1,2})\.(\d{4})\s*$", text):
        return _valid_date(*reversed(match.groups()))
    if match := re.match(r"\s*(\d{4})(?:-(\d{2}))?\s*$", text):
        return _valid_date(*match.groups())
    return None


def _valid_date(year: str, month: str | None = None, day: str | None = None) -> str | None:
    if not _FIRST_YEAR <= int(year) <= _LAST_YEAR:
        return None
    try:
        calendar_day(int(year), int(month or 1), int(day or 1))
    except ValueError:
        return None
    return year + (f"-{int(month):02d}" if month else "") + (f"-{int(day):02d}" if month and day else "")


def date_of_name(name: str) -> str | None:
    """The date in a file's name by the surveys' conventions.

    ``..._nw_2023.jp2``, ``..._th_2020-2025.zip`` (the last year), ``swissimage-dop10_2021_2600-1199_0.1_2056.tif``,
    ``..._ni_2022-05-15.tif``, NAIP's ``..._060_20210612.tif``. A day comes before a year, the last year before others.
    """
    stem = re.sub(r"(\.[A-Za-z][A-Za-z0-9]{1,3})+$", "", PurePosixPath(name).name)
    words = re.split(r"[_ ]", stem)
    for word in words:
        if (match := re.fullmatch(r"(\d{4})-?(\d{2})-?(\d{2})", word)) and (day := _valid_date(*match.groups())):
            return day
    for word in reversed(words):
        if match := re.fullmatch(r"(\d{4})-(\d{4})", word):
            first, last = match.groups()
            if _valid_date(first) and _valid_date(last) and first <= last:
                return last
        elif (match := re.fullmatch(r"(\d{4})(?:-(\d{2}))?", word)) and (year := _valid_date(*match.groups())):
            return year
    return None
