"""Public geodata as survey offices publish it, generated: ``python -m ortholoc_sim.geodata OUT --side-km 10``.

An area on the border of UTM zones 32 and 33 (12 degrees east): the western office publishes square sheets in
EPSG:25832, the eastern in EPSG:25833, turned by 4.6 degrees against them, and both go on to the border and somewhat
beyond. Orthophotos (DOP) and surface models (DSM) come in the formats that offices use, of several years, with the
traps that their data has: four bands that are not RGBA, 16 bits, no CRS, a black collar, holes, two epochs of one
place. What is at a place is `country`'s answer, so sheets fit whatever their grid.
"""

from __future__ import annotations

import argparse
import gzip
import importlib.util
import io
import os
import sys
import zipfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
import rasterio.shutil
from pyproj import Transformer
from rasterio.enums import ColorInterp
from rasterio.io import MemoryFile
from rasterio.transform import Affine
from tqdm import tqdm

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_sim.country import CENTRE, FRAME, SURVEYS, Country, hole_mask

WEST_CRS, EAST_CRS = FRAME, "EPSG:25833"
# Heights above the German zero level (DHHN2016), which only some formats can say.
VERTICAL_EPSG = 7837
BORDER_DEG = 12.0
NODATA = -9999.0
DSM_YEAR = 2021
# A stored value of a 16-bit orthophoto is this times the 8-bit one plus an offset: 12 bits, as cameras have.
_WIDE_GAIN, _WIDE_OFFSET = 14, 120
_COLLAR_BEYOND_M = 15.0
_JPEG_QUALITY = 90

# In turn along the rows of sheets, north-west first; each zone has its own habits.
_DOP_FORMATS = {
    WEST_CRS: ("jp2", "tif", "zip", "tif16", "cog", "jpg", "tif", "zip", "cog"),
    EAST_CRS: ("rgbi", "zip", "cog", "tif", "jp2"),
}
# What does not say its CRS is of one zone only: whoever builds a pack can then name it for all of them.
_DSM_FORMATS = {WEST_CRS: ("zip_xyz", "tif", "laz", "xyz_gz", "cog"), EAST_CRS: ("tif", "zip_tif", "cog")}
# Big or slow, so once per area and zone: the next ones are plain.
_RARE = {"tif16": "tif", "jpg": "cog", "rgbi": "tif", "laz": "tif", "zip_xyz": "zip_tif", "xyz_gz": "tif"}
_RARE_KEPT = {"tif16": 1, "jpg": 3, "rgbi": 2, "laz": 1, "zip_xyz": 3, "xyz_gz": 3}


@dataclass(frozen=True, slots=True)
class Sheet:
    """One published file.

    Attributes:
        kind: "dop" or "dsm".
        crs, west_m, south_m, side_m: its square; the file names ``crs`` unless its format is "jpg" or text.
        year: of acquisition, a key of `country.SURVEYS`.
        format: how it is written.
        collar: whether everything beyond the border is black.
        gsd_m: pixel.
        path: of the file.
    """

    kind: str
    crs: str
    west_m: float
    south_m: float
    side_m: float
    year: int
    format: str
    collar: bool
    gsd_m: float
    path: Path

    @property
    def grid(self) -> RasterGrid:
        count = round(self.side_m / self.gsd_m)
        return RasterGrid(count, count, self.west_m, self.south_m + self.side_m, self.gsd_m, -self.gsd_m)


@dataclass(frozen=True, slots=True)
class Published:
    """An area on disk.

    Attributes:
        dop, dsm: folders, for `tiles build`; what names no CRS there (JPEG, XYZ) is in EPSG:25832.
        sheets: all files.
        country: the truth: ``colour`` and ``height`` at points of `country.FRAME`.
        bounds: (west, south, east, north) of the area in `country.FRAME`, m; the sheets reach beyond it.
    """

    dop: Path
    dsm: Path
    sheets: tuple[Sheet, ...]
    country: Country
    bounds: tuple[float, float, float, float]


def write_area(
    out: Path,
    *,
    side_km: float = 10.0,
    dop_gsd_m: float = 0.2,
    dsm_gsd_m: float = 1.0,
    sheet_m: float = 1000.0,
    seed: int = 5,
    jobs: int = 1,
    progress: Callable[[Sheet], None] | None = None,
) -> Published:
    """Write the area's sheets below ``out`` (``dop/``, ``dsm/``). The same arguments give the same pixels.

    Args:
        sheet_m: side of the sheets, a multiple of both pixel sizes.
        jobs: processes.
        progress: called with each sheet that is done.
    Raises: ValueError if the sheets' sides are no whole number of pixels.
    """
    for gsd in (dop_gsd_m, dsm_gsd_m):
        if abs(sheet_m / gsd - round(sheet_m / gsd)) > 1e-6:
            raise ValueError(f"sheets of {sheet_m} m are no whole number of {gsd} m pixels")
    half = side_km * 500.0
    west, south = (round((c - half) / sheet_m) * sheet_m for c in _centre())
    count = max(1, round(side_km * 1000.0 / sheet_m))
    bounds = (west, south, west + count * sheet_m, south + count * sheet_m)
    squares = {WEST_CRS: _western(bounds, sheet_m), EAST_CRS: _eastern(bounds, sheet_m)}
    sheets = [
        *_dop_sheets(out / "dop", squares, sheet_m, dop_gsd_m),
        *_dsm_sheets(out / "dsm", squares, sheet_m, dsm_gsd_m),
    ]
    for folder in (out / "dop", out / "dsm"):
        folder.mkdir(parents=True, exist_ok=True)
    # Slow ones first, so that no process ends long after the others.
    order = sorted(range(len(sheets)), key=lambda k: -_effort(sheets[k]))
    if jobs == 1:
        for k in order:
            write_sheet(sheets[k], seed)
            if progress is not None:
                progress(sheets[k])
    else:
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
            for sheet in pool.map(_written, ((sheets[k], seed) for k in order)):
                if progress is not None:
                    progress(sheet)
    return Published(out / "dop", out / "dsm", tuple(sheets), Country(seed), bounds)


def write_sheet(sheet: Sheet, seed: int) -> None:
    """Write one file."""
    country = Country(seed)
    if sheet.kind == "dop":
        rgb = country.rgb(sheet.grid, sheet.crs, SURVEYS[sheet.year])
        if sheet.collar:
            rgb[_beyond_border(sheet)] = 0
        _write_dop(sheet, rgb)
    else:
        heights = country.heights(sheet.grid, sheet.crs, SURVEYS[sheet.year])
        heights[hole_mask(country, sheet.grid, sheet.crs)] = np.nan
        _write_dsm(sheet, heights)


def _written(task: tuple[Sheet, int]) -> Sheet:
    # One process, one core: OpenCV's own threads would fight the other processes.
    cv2.setNumThreads(1)
    write_sheet(*task)
    return task[0]


def _effort(sheet: Sheet) -> float:
    return (sheet.side_m / sheet.gsd_m) ** 2 * {"jp2": 4.0, "zip_xyz": 8.0, "xyz_gz": 8.0}.get(sheet.format, 1.0)


# --- which sheets ---


def _centre() -> tuple[float, float]:
    """Of the area: near the border where it passes `country.CENTRE`, which has houses, forest and a lake around it."""
    lon_lat = Transformer.from_crs(FRAME, "EPSG:4258", always_xy=True)
    a, b = (lon_lat.transform(CENTRE[0] + d, CENTRE[1])[0] for d in (0.0, 1000.0))
    return CENTRE[0] + (BORDER_DEG - a) / (b - a) * 1000.0 - 100.0, CENTRE[1]


def _western(bounds: tuple[float, float, float, float], side: float) -> list[tuple[float, float]]:
    """South-west corners of sheets on the area that are not wholly beyond the border, north first."""
    west, south, east, north = bounds
    corners = [(x, y) for y in np.arange(north - side, south - 1, -side) for x in np.arange(west, east - 1, side)]
    return [(float(x), float(y)) for x, y in corners if _longitudes(x, y, side, WEST_CRS).min() < BORDER_DEG]


def _eastern(bounds: tuple[float, float, float, float], side: float) -> list[tuple[float, float]]:
    to_east = Transformer.from_crs(FRAME, EAST_CRS, always_xy=True)
    back = Transformer.from_crs(EAST_CRS, FRAME, always_xy=True)
    west, south, east, north = bounds
    outline = np.array([[west, south], [east, south], [east, north], [west, north]])
    turned = np.stack(to_east.transform(outline[:, 0], outline[:, 1]), axis=1)
    low, high = np.floor(turned.min(axis=0) / side) * side, np.ceil(turned.max(axis=0) / side) * side
    found = []
    for y in np.arange(high[1] - side, low[1] - 1, -side):
        for x in np.arange(low[0], high[0] - 1, side):
            square = np.array([[x, y], [x + side, y], [x + side, y + side], [x, y + side]])
            there = np.stack(back.transform(square[:, 0], square[:, 1]), axis=1)
            shared, _ = cv2.intersectConvexConvex(
                (there - outline[0]).astype(np.float32), (outline - outline[0]).astype(np.float32)
            )
            if shared > 0.002 * side**2 and _longitudes(x, y, side, EAST_CRS).max() > BORDER_DEG:
                found.append((float(x), float(y)))
    return found


def _longitudes(x: float, y: float, side: float, crs: str) -> FloatArray:
    lon_lat = Transformer.from_crs(crs, "EPSG:4258", always_xy=True)
    lon, _ = lon_lat.transform(np.array([x, x + side, x + side, x]), np.array([y, y, y + side, y + side]))
    return np.asarray(lon, dtype=np.float64)


def _formats(kinds: tuple[str, ...], count: int) -> list[str]:
    left = dict(_RARE_KEPT)
    chosen = []
    for k in range(count):
        kind = kinds[k % len(kinds)]
        while kind in _RARE:
            if left[kind] > 0 and (kind != "laz" or importlib.util.find_spec("laspy")):
                left[kind] -= 1
                break
            kind = _RARE[kind]
        chosen.append(kind)
    return chosen


def _dop_sheets(
    folder: Path, squares: dict[str, list[tuple[float, float]]], side: float, gsd: float
) -> Iterator[Sheet]:
    for crs, corners in squares.items():
        zone, land = crs[-2:], "xw" if crs == WEST_CRS else "xe"
        # The border runs through the middle of that sheet more than through that of others.
        split = [np.abs(_longitudes(x, y, side, crs) - BORDER_DEG).max() for x, y in corners]
        collar = int(np.argmin(split)) if crs == WEST_CRS else -1
        for k, ((x, y), form) in enumerate(zip(corners, _formats(_DOP_FORMATS[crs], len(corners)), strict=True)):
            years = [2021 if (x // side + 2 * (y // side)) % 5 == 0 else 2023]
            if k % 7 == 1:  # an older flight of the same place lies beside the newer
                years.append(2019)
            for year in years:
                kind = "tif" if k == collar or year == 2019 else form
                bands = "rgbi" if kind in ("jp2", "rgbi") else "rgb"
                stem = f"dop{round(gsd * 100):02d}{bands}_{zone}_{_corner(x, side)}_{_corner(y, side)}"
                name = f"{stem}_{_km(side)}_{land}_{year}.{_ending(kind)}"
                yield Sheet("dop", crs, x, y, side, year, kind, k == collar and year != 2019, gsd,
                            folder / name)  # fmt: skip


def _dsm_sheets(
    folder: Path, squares: dict[str, list[tuple[float, float]]], side: float, gsd: float
) -> Iterator[Sheet]:
    for crs, corners in squares.items():
        zone, land = crs[-2:], "xw" if crs == WEST_CRS else "xe"
        for (x, y), form in zip(corners, _formats(_DSM_FORMATS[crs], len(corners)), strict=True):
            stem = f"dom{gsd:g}_{zone}_{_corner(x, side)}_{_corner(y, side)}"
            name = f"{stem}_{_km(side)}_{land}_{DSM_YEAR}.{_ending(form)}"
            yield Sheet("dsm", crs, x, y, side, DSM_YEAR, form, False, gsd, folder / name)


def _corner(value: float, side: float) -> str:
    """Names count kilometres; sheets below that size (tests) count metres."""
    return f"{round(value / 1000)}" if side % 1000 == 0 else f"{round(value)}"


def _km(side: float) -> str:
    return f"{side / 1000:g}".replace(".", "")


def _ending(form: str) -> str:
    return {"jp2": "jp2", "zip": "zip", "jpg": "jpg", "zip_xyz": "zip", "zip_tif": "zip", "xyz_gz": "xyz.gz",
            "laz": "laz"}.get(form, "tif")  # fmt: skip


# --- content ---


def _beyond_border(sheet: Sheet) -> BoolArray:
    """(H, W) whether a pixel lies more than some metres east of the border."""
    grid = sheet.grid
    ends = np.array([[0.0, 0.0], [grid.width - 1.0, 0.0], [0.0, grid.height - 1.0]])
    xy = grid.map_from_px(ends)
    lon_lat = Transformer.from_crs(sheet.crs, "EPSG:4258", always_xy=True)
    lon, lat = lon_lat.transform(xy[:, 0], xy[:, 1])
    beyond = (lon - BORDER_DEG) * 111_320.0 * np.cos(np.radians(lat[0])) - _COLLAR_BEYOND_M
    across, down = (beyond[1] - beyond[0]) / (grid.width - 1), (beyond[2] - beyond[0]) / (grid.height - 1)
    return np.asarray(
        beyond[0] + across * np.arange(grid.width)[None] + down * np.arange(grid.height)[:, None] > 0, dtype=bool
    )


def infrared(rgb: ImageArray) -> ImageArray:
    """(H, W) a near-infrared band that goes with a picture: plants are bright, soil and roofs as in red, water dark."""
    red, green, blue = (rgb[..., k].astype(np.int16) for k in range(3))
    plants = green + 2 * (green - red) + (green - blue)
    # Of what is drawn only water is bluer than red.
    soil = np.where(blue > red, 0, red + red // 4)
    return np.asarray(np.clip(np.maximum(plants, soil), 4, 255), dtype=np.uint8)


# --- files ---


def _profile(grid: RasterGrid, crs: str | None, count: int, dtype: str, **more: Any) -> dict[str, Any]:
    return {
        "driver": "GTiff", "width": grid.width, "height": grid.height, "count": count, "dtype": dtype, "crs": crs,
        "transform": Affine(grid.dx, 0.0, grid.west, 0.0, grid.dy, grid.top), **more,
    }  # fmt: skip


def _write_dop(sheet: Sheet, rgb: ImageArray) -> None:
    bands = np.moveaxis(rgb, 2, 0)
    if sheet.format in ("jp2", "rgbi"):
        bands = np.concatenate([bands, infrared(rgb)[None]])
    jpeg = {"compress": "JPEG", "jpeg_quality": _JPEG_QUALITY, "photometric": "YCBCR", "interleave": "pixel",
            "tiled": True}  # fmt: skip
    match sheet.format:
        case "tif":
            _write_tif(sheet.path, sheet.grid, sheet.crs, bands, **jpeg)
        case "tif16":
            wide = bands.astype(np.uint16) * np.uint16(_WIDE_GAIN) + np.uint16(_WIDE_OFFSET)
            _write_tif(sheet.path, sheet.grid, sheet.crs, wide, compress="DEFLATE", zlevel=1, predictor=2, tiled=True,
                       photometric="RGB")  # fmt: skip
        case "rgbi":
            # The fourth band is undefined, not alpha, as offices write it.
            _write_tif(sheet.path, sheet.grid, sheet.crs, bands, compress="DEFLATE", zlevel=1, predictor=2, tiled=True,
                       photometric="RGB", alpha="NO")  # fmt: skip
        case "cog":
            _write_copy(sheet, bands, driver="COG", compress="JPEG", quality=_JPEG_QUALITY, num_threads=1)
        case "jp2":
            _write_copy(sheet, bands, driver="JP2OpenJPEG", quality=9, reversible="NO", ycbcr420="NO")
        case "jpg":
            encoded = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY + 4])[1]
            sheet.path.write_bytes(encoded.tobytes())
            grid = sheet.grid
            # World files place the centre of the first pixel.
            lines = (grid.dx, 0.0, 0.0, grid.dy, grid.west + grid.dx / 2, grid.top + grid.dy / 2)
            sheet.path.with_suffix(".jgw").write_text("".join(f"{v:.4f}\n" for v in lines))
        case "zip":
            members = []
            half = sheet.grid.width // 2
            for row in (0, half):
                for column in (0, half):
                    width, height = (sheet.grid.width - half if k else half for k in (column, row))
                    grid = sheet.grid.crop(column, row, width, height)
                    part = bands[:, row : row + height, column : column + width]
                    with MemoryFile() as file:
                        with file.open(**_profile(grid, sheet.crs, 3, "uint8", **jpeg)) as target:
                            target.write(part)
                        members.append((f"{sheet.path.stem}_{row // half}{column // half}.tif", file.read()))
            _write_zip(sheet.path, [*members, ("readme.txt", b"generated, not a real place\r\n")])


def _write_dsm(sheet: Sheet, heights: Float32Array) -> None:
    vertical = f"{sheet.crs}+{VERTICAL_EPSG}"
    holes = np.where(np.isnan(heights), np.float32(NODATA), heights)
    common = {"compress": "DEFLATE", "predictor": 3, "zlevel": 6, "nodata": NODATA}
    match sheet.format:
        case "tif":
            _write_tif(sheet.path, sheet.grid, vertical, holes[None], tiled=True, **common)
        case "cog":
            _write_copy(sheet, holes[None], crs=vertical, nodata=NODATA, driver="COG", compress="DEFLATE",
                        predictor="YES", num_threads=1)  # fmt: skip
        case "zip_tif":
            with MemoryFile() as file:
                with file.open(**_profile(sheet.grid, vertical, 1, "float32", **common)) as target:
                    target.write(holes, 1)
                _write_zip(sheet.path, [(f"{sheet.path.stem}.tif", file.read())])
        case "zip_xyz":
            _write_zip(sheet.path, [(f"{sheet.path.stem}.xyz", _xyz(sheet.grid, heights))])
        case "xyz_gz":
            # The time of writing would make equal data unequal.
            with sheet.path.open("wb") as raw, gzip.GzipFile("", "wb", 5, raw, mtime=0) as packed:
                packed.write(_xyz(sheet.grid, heights))
        case "laz":
            _write_laz(sheet, heights)


def _write_tif(path: Path, grid: RasterGrid, crs: str, bands: Any, **options: Any) -> None:
    with rasterio.open(path, "w", **_profile(grid, crs, len(bands), str(bands.dtype), **options)) as target:
        target.write(bands)


def _write_copy(sheet: Sheet, bands: Any, crs: str | None = None, nodata: float | None = None, **options: Any) -> None:
    """For drivers that only copy."""
    profile = _profile(sheet.grid, crs or sheet.crs, len(bands), str(bands.dtype), nodata=nodata)
    with MemoryFile() as work:
        with work.open(**profile, **({"photometric": "RGB", "alpha": "NO"} if len(bands) == 4 else {})) as target:
            target.write(bands)
            if len(bands) == 4:
                target.colorinterp = (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.undefined)
        rasterio.shutil.copy(work.name, sheet.path, **options)
    # What GDAL could not put into the file itself; offices don't ship it.
    sheet.path.with_name(sheet.path.name + ".aux.xml").unlink(missing_ok=True)


def _write_zip(path: Path, members: Sequence[tuple[str, bytes]]) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=4) as archive:
        for name, data in members:
            # A fixed date: equal data, equal bytes.
            entry = zipfile.ZipInfo(name, (2024, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_STORED if name.endswith(".tif") else zipfile.ZIP_DEFLATED
            archive.writestr(entry, data)


def _xyz(grid: RasterGrid, heights: Float32Array) -> bytes:
    """Lines of easting, northing, height of the pixels' centres, from the south; holes are left out."""
    rows, columns = np.nonzero(np.isfinite(heights[::-1]))
    rows = grid.height - 1 - rows
    xy = grid.map_from_px(np.stack([columns, rows], axis=1))
    out = io.StringIO()
    for x, y, z in zip(xy[:, 0].tolist(), xy[:, 1].tolist(), heights[rows, columns].tolist(), strict=True):
        out.write(f"{x:.2f} {y:.2f} {z:.2f}\n")
    return out.getvalue().encode()


def _write_laz(sheet: Sheet, heights: Float32Array) -> None:
    laspy: Any = importlib.import_module("laspy")
    pyproj_crs: Any = importlib.import_module("pyproj").CRS
    rows, columns = np.nonzero(np.isfinite(heights))
    xy = sheet.grid.map_from_px(np.stack([columns, rows], axis=1))
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.offsets = np.array([sheet.west_m, sheet.south_m, 0.0])
    header.scales = np.array([0.01, 0.01, 0.01])
    header.creation_date = None
    header.add_crs(pyproj_crs.from_user_input(f"{sheet.crs}+{VERTICAL_EPSG}"))
    points = laspy.LasData(header)
    points.x, points.y, points.z = xy[:, 0], xy[:, 1], heights[rows, columns].astype(np.float64)
    points.return_number[:] = 1
    points.number_of_returns[:] = 1
    points.write(str(sheet.path))


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Write public geodata of a generated area on a zone border.")
    parser.add_argument("out", type=Path, metavar="OUT", help="folder; gets dop/ and dsm/")
    parser.add_argument("--side-km", type=float, default=10.0, help="of the square area (default: %(default)s)")
    parser.add_argument("--dop-gsd", type=float, default=0.2, metavar="M", help="DOP pixel (default: %(default)s)")
    parser.add_argument("--dsm-gsd", type=float, default=1.0, metavar="M", help="DSM pixel (default: %(default)s)")
    parser.add_argument("--sheet", type=float, default=1000.0, metavar="M", help="side of one (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=5, help="of the country (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes (default: %(default)s)")
    options = parser.parse_args(arguments)
    # Beside this one, one thread per process.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    cv2.setNumThreads(1)
    with tqdm(unit="sheet", file=sys.stderr) as bar:
        area = write_area(
            options.out, side_km=options.side_km, dop_gsd_m=options.dop_gsd, dsm_gsd_m=options.dsm_gsd,
            sheet_m=options.sheet, seed=options.seed, jobs=options.jobs, progress=lambda _: bar.update(),
        )  # fmt: skip
    size = sum(f.stat().st_size for f in options.out.rglob("*") if f.is_file())
    print(f"{len(area.sheets)} files, {size / 1e6:.0f} MB; area {area.bounds} in {FRAME}", file=sys.stderr)  # noqa: T201
    return 0


if __name__ == "__main__":
    sys.exit(main())
