"""Heights that come as points: XYZ text of a regular grid, and LAS or LAZ clouds, which are gridded here.

Text lists the centres of cells. A cloud from image matching has its points on a grid, too, and keeps it; one from a
scanner gets cells that hold a few points each, and of these the highest first return: the surface a camera sees.
"""

from __future__ import annotations

import gzip
import io
import struct
import zipfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.geometry.arrays import Float32Array, FloatArray
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.source import Source, named_errors

TEXT = (".xyz", ".txt", ".asc")
CLOUDS = (".laz", ".las")

_HEAD_BYTES = 2**16
_CHUNK_BYTES = 2**24
_MAX_LINE_BYTES = 2**16
_MAX_HEADER_LINES = 30
_CHUNK_POINTS = 1_000_000
_SAMPLE_POINTS = 50_000
_MAX_MEMBER_BYTES = 2**32

# A gigabyte of heights; 3 km at 20 cm.
_MAX_CELLS = 2**28
# More coordinates than this along one axis are no grid.
_MAX_COLUMNS = 2**18
_MAX_CELLS_PER_POINT = 64
# Text rounds coordinates: to half a centimetre of a 20 cm step.
_MAX_JITTER = 0.05
# Coordinates this close were one before a program computed with them.
_SAME_M = 1e-4
_MIN_GRID_SHARE = 0.3

# Sides of the cells of a scanned cloud, m, and how many first returns one should hold on average, so that few stay
# empty.
_CELLS_M = (0.5, 1.0, 2.0, 5.0)
_POINTS_PER_CELL = 2.0
# LASzip needs about two bytes a point; points that repeat exactly need far less.
_MAX_POINTS_PER_BYTE = 100
_NOISE_CLASSES = (7, 18)
_MAX_OUTSIDE_SHARE = 0.01

_NORTH_FIRST = ("y", "n", "north", "northing", "nord", "hochwert", "hw", "lat", "latitude")


@dataclass(frozen=True, slots=True)
class Layout:
    """Columns of a text: what separates them, what separates decimals, and lines to pass over first."""

    delimiter: str | None
    decimal_comma: bool
    skipped_lines: int
    north_first: bool


@contextmanager
def stream(file: Path, member: str | None) -> Iterator[IO[bytes]]:
    """The bytes of a file or of a member of a ZIP, unpacked if gzipped."""
    with ExitStack() as stack:
        if member is None:
            raw: Any = stack.enter_context(file.open("rb"))
        else:
            raw = stack.enter_context(stack.enter_context(zipfile.ZipFile(file)).open(member))
        if (member or file.name).lower().endswith(".gz"):
            raw = stack.enter_context(gzip.GzipFile(fileobj=raw))
        yield raw


def text_layout(file: Path, member: str | None, where: str) -> Layout | None:
    """How a text writes its points, from its first lines; None if these are no x, y and z."""
    with named_errors(where), stream(file, member) as source:
        head = source.read(_HEAD_BYTES)
    if b"\0" in head:
        return None
    lines = head.decode("latin-1").splitlines()
    # The last may be cut.
    for index, line in enumerate(lines[: _MAX_HEADER_LINES + 1] if len(head) < _HEAD_BYTES else lines[:-1]):
        if index > _MAX_HEADER_LINES:
            break
        layout = _line_layout(line, index, lines[index - 1] if index else "")
        if layout is not None:
            return layout
    return None


def _line_layout(line: str, index: int, header: str) -> Layout | None:
    words = line.split()
    if ";" in line:
        delimiter, comma = ";", "," in line
    elif "\t" in line.strip() or (len(words) >= 3 and not words[0].endswith(",")):
        delimiter, comma = None, any("," in word for word in words[:3])
    else:
        delimiter, comma = ",", False
    values = (line.replace(",", ".") if comma else line).split(delimiter)
    try:
        numbers = [float(value) for value in values[:3]]
    except ValueError:
        return None
    if len(numbers) < 3 or not np.isfinite(numbers[:2]).all():
        return None
    names = [name.strip(' "#').lower() for name in header.split(delimiter)]
    return Layout(delimiter, comma, index, bool(names) and names[0] in _NORTH_FIRST)


def text_grid(file: Path, member: str | None, layout: Layout, where: str) -> RasterGrid:
    """Grid of the cells whose centres a text lists, in whatever order, with whatever gaps.

    Raises: MapError if they are on none, or the text is damaged.
    """
    xs, ys, count = np.empty(0), np.empty(0), 0
    with named_errors(where, "is no regular grid of x y z"):
        for points in _text_chunks(file, member, layout):
            xs, ys = np.union1d(xs, points[:, 0]), np.union1d(ys, points[:, 1])
            count += len(points)
            if not (np.isfinite(xs[[0, -1]]).all() and np.isfinite(ys[[0, -1]]).all()):
                raise ValueError("a coordinate is not finite")
            if max(len(xs), len(ys)) > _MAX_COLUMNS:
                raise ValueError(f"more than {_MAX_COLUMNS} different coordinates; grid it, or give the cloud as LAZ")
        return _grid_of(xs, ys, count)


def _grid_of(xs: FloatArray, ys: FloatArray, count: int) -> RasterGrid:
    if len(xs) < 2 and len(ys) < 2:
        raise ValueError(f"{count} points")
    x, y = (_axis(xs) if len(xs) > 1 else None), (_axis(ys) if len(ys) > 1 else None)
    dx, dy = (x or y)[1], (y or x)[1]  # type: ignore[index]  # one of them is there
    west, columns = (xs[0] - dx / 2, 1) if x is None else (x[0] - dx / 2, x[2])
    south, rows = (ys[0] - dy / 2, 1) if y is None else (y[0] - dy / 2, y[2])
    if columns * rows > min(_MAX_CELLS, _MAX_CELLS_PER_POINT * count + 2**16):
        raise ValueError(f"{count} points on {columns} x {rows} cells")
    return RasterGrid(columns, rows, _rounded(west, dx), _rounded(south + rows * dy, dy), dx, -dy)


def _axis(values: FloatArray) -> tuple[float, float, int]:
    """First value, step and number of places of sorted values on a regular grid, some of which may be missing.

    Raises: ValueError if they are on none.
    """
    gaps = np.diff(values)
    gaps = gaps[gaps > _SAME_M]
    if len(gaps) == 0:
        raise ValueError(f"coordinates from {values[0]:g} to {values[-1]:g} are one")
    step = float(np.median(gaps[gaps < 1.5 * gaps.min()]))
    first = float(values[0])
    # A step that was rounded miscounts far away: so it is made more exact over longer and longer stretches.
    span = 16
    while True:
        part = values[:span]
        places = np.rint((part - first) / step)
        if places[-1] >= 1:
            slope, lift = np.polyfit(places, part - values[0], 1)
            step, first = float(slope), float(values[0] + lift)
        if span >= len(values):
            break
        span *= 4
    places = np.rint((values - first) / step)
    if not (step > 0 and np.abs(first + places * step - values).max() <= _MAX_JITTER * step):
        raise ValueError(f"coordinates from {values[0]:g} to {values[-1]:g} are in no even steps; grid it, or give LAZ")
    count = int(places[-1]) + 1
    for digits in range(7):
        if abs(round(step, digits) - step) * count < _MAX_JITTER * step:
            step = round(step, digits)
            break
    return float(_rounded(first, step)), step, count


def _rounded(value: float, step: float) -> float:
    """What a person would have written: the shortest decimal within a thousandth of a step."""
    return next((round(value, d) for d in range(9) if abs(round(value, d) - value) < 1e-3 * step), value)


def grid_text(source: Source, layout: Layout, progress: Callable[[float], None]) -> Float32Array:
    """Heights (H, W) of a text on its source's grid, NaN in gaps; of several in one cell the highest."""
    grid = source.grid
    heights = np.full(grid.width * grid.height, -np.inf, np.float32)
    done, total = 0, grid.width * grid.height
    with named_errors(source.where), np.errstate(over="ignore"):
        for points in _text_chunks(source.file, source.member, layout):
            px = np.rint(grid.px_from_map(points[:, :2])).astype(np.intp)
            usable = np.isfinite(points[:, 2])
            np.maximum.at(heights, (px[:, 1] * grid.width + px[:, 0])[usable], points[usable, 2].astype(np.float32))
            done += len(points)
            progress(min(done / total, 1.0))
    heights[np.isneginf(heights)] = np.nan
    return heights.reshape(grid.height, grid.width)


def _text_chunks(file: Path, member: str | None, layout: Layout) -> Iterator[FloatArray]:
    """Points (N, 3) as x, y, z."""
    columns = (1, 0, 2) if layout.north_first else (0, 1, 2)
    with stream(file, member) as source:
        for _ in range(layout.skipped_lines):
            source.readline(_MAX_LINE_BYTES)
        rest = b""
        while block := source.read(_CHUNK_BYTES):
            lines, newline, rest = (rest + block).rpartition(b"\n")
            if len(rest) > _MAX_LINE_BYTES:
                raise ValueError(f"a line of more than {_MAX_LINE_BYTES} characters")
            if newline and lines.strip():
                yield _numbers(lines, layout, columns)
        if rest.strip():
            yield _numbers(rest, layout, columns)


def _numbers(text: bytes, layout: Layout, columns: tuple[int, int, int]) -> FloatArray:
    if layout.decimal_comma:
        text = text.replace(b",", b".")
    points: FloatArray = np.loadtxt(
        io.BytesIO(text), delimiter=layout.delimiter, usecols=columns, comments=None, ndmin=2, encoding="latin-1"
    )
    return points


@dataclass(frozen=True, slots=True)
class CloudNote:
    """What a cloud's header says. ``crs``: of pyproj's, or None."""

    grid: RasterGrid
    crs: Any


def cloud_grid(file: Path, member: str | None, where: str, cell_m: float | None = None) -> CloudNote:
    """System of a LAS or LAZ file and the grid it is to be gridded on.

    Args:
        cell_m: side of its cells; None: the cloud's own grid if it has one, else the smallest of 0.5, 1, 2 and 5 m
            that holds two first returns on average.
    Raises: ConfigError if the extra is not installed; MapError for a damaged file.
    """
    with named_errors(where), _cloud(file, member) as reader:
        header = reader.header
        mins, maxs = np.array(header.mins[:2]), np.array(header.maxs[:2])
        if header.point_count == 0 or not (np.isfinite([mins, maxs]).all() and (maxs >= mins).all()):
            raise ValueError(f"{header.point_count} points within {mins} to {maxs}")
        crs = header.parse_crs()
        sample = reader.read_points(min(header.point_count, _SAMPLE_POINTS))
        own = None if cell_m is not None else _own_grid(np.asarray(sample.x), np.asarray(sample.y), mins, maxs)
        if own is None:
            first_returns = int(header.number_of_points_by_return[0]) or header.point_count
            own = _cells(mins, maxs, cell_m, first_returns)
        if own.width * own.height > _MAX_CELLS:
            raise ValueError(f"{own.width} x {own.height} cells of {own.gsd_m:g} m")
        return CloudNote(own, crs)


def _own_grid(x: FloatArray, y: FloatArray, mins: FloatArray, maxs: FloatArray) -> RasterGrid | None:
    try:
        axes = [_axis(np.unique(values)) for values in (x, y)]
    except ValueError:
        return None
    # Coordinates are stored in whole centimetres: an irregular cloud is on that grid, and fills next to none of it.
    if len(x) < _MIN_GRID_SHARE * axes[0][2] * axes[1][2]:
        return None
    lows, counts = [], []
    for (first, step, _), low, high in zip(axes, mins, maxs, strict=True):
        start, end = (round((value - first) / step) for value in (low, high))
        lows.append(first + (start - 0.5) * step)
        counts.append(end - start + 1)
    (dx, dy), (west, south) = (axes[0][1], axes[1][1]), lows
    return RasterGrid(counts[0], counts[1], _rounded(west, dx), _rounded(south + counts[1] * dy, dy), dx, -dy)


def _cells(mins: FloatArray, maxs: FloatArray, cell_m: float | None, first_returns: int) -> RasterGrid:
    if cell_m is None:
        area = float(np.prod(np.maximum(maxs - mins, 1.0)))
        fitting = (cell for cell in _CELLS_M if first_returns * cell**2 >= _POINTS_PER_CELL * area)
        cell_m = next(fitting, _CELLS_M[-1])
    # A point on the far border belongs to the last cell, not to a new one of its own.
    slack = 0.02
    west, south = (np.floor(mins / cell_m + slack) * cell_m).tolist()
    columns, rows = np.maximum(np.ceil((maxs - (west, south)) / cell_m - slack), 1).astype(int).tolist()
    return RasterGrid(columns, rows, west, south + rows * cell_m, cell_m, -cell_m)


def grid_cloud(source: Source, progress: Callable[[float], None]) -> Float32Array:
    """Heights (H, W) of a cloud on its source's grid: the highest first return per cell, NaN where there is none.

    Noise (classes 7 and 18) and withheld points are left out.
    """
    grid = source.grid
    heights = np.full(grid.width * grid.height, -np.inf, np.float32)
    outside = done = 0
    # What is too high for float32 becomes infinite, and that is no height.
    overflow = np.errstate(over="ignore")
    with named_errors(source.where), overflow, _cloud(source.file, source.member) as reader:
        total = reader.header.point_count
        for points in reader.chunk_iterator(_CHUNK_POINTS):
            kept = ~np.isin(np.asarray(points.classification), _NOISE_CLASSES)
            kept &= np.asarray(points.return_number) <= 1
            if "withheld" in points.point_format.dimension_names:
                kept &= np.asarray(points.withheld) == 0
            x, y, z = (np.asarray(values)[kept] for values in (points.x, points.y, points.z))
            u, v = grid.px_from_map(np.stack([x, y], axis=-1)).T
            column, row = np.rint(u), np.rint(v)
            # The rim's half slack of `_cells`.
            column = np.where(column == grid.width, column - (u < grid.width - 0.4), column)
            column = np.where(column == -1, column + (u > -0.6), column)
            row = np.where(row == grid.height, row - (v < grid.height - 0.4), row)
            row = np.where(row == -1, row + (v > -0.6), row)
            inside = (column >= 0) & (column < grid.width) & (row >= 0) & (row < grid.height) & np.isfinite(z)
            outside += int(np.count_nonzero(~inside))
            place = (row[inside] * grid.width + column[inside]).astype(np.intp)
            np.maximum.at(heights, place, z[inside].astype(np.float32))
            done += len(points)
            progress(min(done / total, 1.0))
        if done != total:
            raise ValueError(f"{done} of {total} points")
        if outside > _MAX_OUTSIDE_SHARE * total:
            raise ValueError(f"{outside} of {total} points lie outside the bounds that its header states")
    heights[np.isneginf(heights)] = np.nan
    return heights.reshape(grid.height, grid.width)


@contextmanager
def _cloud(file: Path, member: str | None) -> Iterator[Any]:
    try:
        # An extra: LAZ is needed on the computer that builds packs, never on the drone.
        import laspy
    except ImportError as err:
        raise ConfigError(
            f"{file}: point clouds need the extra packages; install them with: pip install 'ortholoc-edge[laz]'"
        ) from err
    if (member or file.name).lower().endswith(".laz") and not laspy.LazBackend.detect_available():
        raise ConfigError(f"{file}: LAZ needs lazrs; install it with: pip install 'ortholoc-edge[laz]'")
    with stream(file, member) as packed:
        # Decompression starts at the file's end, and a packed member can only be read forward.
        cloud = packed if member is None else io.BytesIO(packed.read(_MAX_MEMBER_BYTES + 1))
        if member is not None and cloud.seek(0, io.SEEK_END) > _MAX_MEMBER_BYTES:
            raise MapError(f"{file}: {member} is larger than 4 GiB; unpack it first")
        _check_sizes(cloud)
        try:
            with laspy.open(cloud, closefd=False) as reader:
                yield reader
        except laspy.errors.LaspyException as err:
            raise ValueError(str(err)) from err


def _check_sizes(cloud: IO[bytes]) -> None:
    """Refuse counts in the header that the file has no room for; laspy and lazrs would believe them.

    Fields as in the ASPRS LAS specification 1.4 and LASzip's: all little-endian.
    """
    size = cloud.seek(0, io.SEEK_END)
    cloud.seek(0)
    head = cloud.read(375)
    if len(head) < 227 or head[:4] != b"LASF":
        raise ValueError("no LAS header")
    header_size, points_at, records = struct.unpack_from("<HII", head, 94)
    point_format, point_bytes, count = struct.unpack_from("<BHI", head, 104)
    if head[25] >= 4:
        if len(head) < 375:
            raise ValueError("LAS header cut off")
        extra_at, extra, count = struct.unpack_from("<QIQ", head, 235)
        if extra and extra_at + 60 * extra > size:
            raise ValueError(f"{extra} extended records beyond its end")
    if not header_size + 54 * records <= points_at <= size or point_bytes < 20:
        raise ValueError(f"header with {records} records, points of {point_bytes} bytes at byte {points_at} of {size}")
    room = size - points_at
    if not point_format & 0x80:
        if count * point_bytes > room:
            raise ValueError(f"{count} points, room for {room // point_bytes}")
    elif count > _MAX_POINTS_PER_BYTE * room:
        raise ValueError(f"{count} points in {room} bytes")
    else:
        cloud.seek(points_at)
        table_at = int.from_bytes(cloud.read(8), "little", signed=True)
        if table_at == -1:  # written to a stream: then it is noted at the end
            cloud.seek(size - 8)
            table_at = int.from_bytes(cloud.read(8), "little", signed=True)
        cloud.seek(max(0, min(table_at, size)))
        chunks = int.from_bytes(cloud.read(8)[4:], "little")
        if not points_at < table_at <= size - 8 or chunks > min(count, room):
            raise ValueError(f"table of {chunks} chunks at byte {table_at} of {size}")
    cloud.seek(0)
