"""One file of public geodata: what it says about itself, and its pixels in one form whatever the format.

Here every pixel is judged on its own: colours become 8 bits, heights become metres, and what a file declares as no
data, or what cannot be a height, is not valid. Judgements that need the whole raster are `tiles.prepare`'s.
"""

from __future__ import annotations

import hashlib
import struct
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import rasterio
from pyproj.exceptions import ProjError
from rasterio.enums import Resampling
from rasterio.errors import NodataShadowWarning, NotGeoreferencedWarning, RasterioError
from rasterio.windows import Window

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.arrays import BoolArray, FloatArray, ImageArray
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.georeference import VerticalKind

Kind = Literal["dop", "dsm"]

# GDAL guesses the format from the content. Only raster formats that geodata comes in: a damaged file must not be
# taken for a PDF or for a web service to be asked.
DRIVERS = (
    *("GTiff", "VRT", "JP2OpenJPEG", "JPEG", "PNG", "WEBP", "HFA", "AAIGrid", "EHdr", "ENVI"),
    *("ERS", "GPKG", "MRF", "SAGA"),
)

# Values that programs write for "no data" and people forget to declare (-32768 and -32767 of int16 rasters,
# the lowest and highest float32).
SENTINELS = (-9999.0, -32767.0, -32768.0)
_SENTINEL_MAGNITUDE = 1e30
# The Dead Sea's shore lies at -430 m, Everest at 8849 m.
MIN_HEIGHT_M, MAX_HEIGHT_M = -500.0, 9000.0

# Of the histogram of a 16-bit orthophoto, what is cut off at either end: glints and the darkest shadows.
_STRETCH_SHARES = (0.005, 0.995)
_SAMPLE_PX = 1024

# What rasterio, PROJ, NumPy, zipfile and laspy raise for a damaged file, a file of another format, or absurd sizes.
READ_ERRORS = (
    *(RasterioError, ProjError, OSError, ValueError, LookupError, TypeError, ArithmeticError, MemoryError),
    *(zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, struct.error),
)


@dataclass(frozen=True, slots=True)
class Stretch:
    """What becomes 0 and 255 of a 16-bit orthophoto: of its colours, and of its infrared."""

    rgb: tuple[float, float]
    nir: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class Source:
    """A raster, or points on a grid, with all that reading needs; it can go to another process.

    Attributes:
        path: what GDAL opens; for a member of a ZIP a path of its virtual file system.
        name: for people: the file's name without folders, ``archive.zip/member`` inside a ZIP.
        kind: what it is read as.
        file, member: where its bytes are: the file on the disk, and the member if that is a ZIP.
        grid: of its pixels, in the units of ``crs`` (which may be degrees).
        gsd_m: true size of a pixel in its middle.
        crs: horizontal system, "EPSG:n" or WKT; None: local metres.
        vertical: what the system says about heights, see `vertical.vertical_of`.
        date: of acquisition, 2023, 2023-06 or 2023-06-04.
        bands: red, green, blue, or the heights; counted from 1.
        nir, alpha: of the orthophoto, if it has them.
        palette: whether band 1 is an index into a table of colours.
        dtype: of the samples as stored.
        scale, offset: metres from stored heights.
        driver: GDAL's name of the format; "xyz" and "las" for points.
        lossy: whether pixels may differ a little from what was written.
        slow: whether reading a window costs as much as reading most of the file.
        stretch: of a 16-bit orthophoto, see :func:`with_common_stretch`.
    """

    path: str
    name: str
    kind: Kind
    file: Path
    member: str | None
    grid: RasterGrid
    gsd_m: float
    crs: str | None
    vertical: tuple[VerticalKind, int | None] | None
    date: str | None
    bands: tuple[int, ...]
    driver: str
    dtype: str
    nir: int | None = None
    alpha: int | None = None
    palette: bool = False
    scale: float = 1.0
    offset: float = 0.0
    lossy: bool = False
    slow: bool = False
    stretch: Stretch | None = None

    @property
    def where(self) -> str:
        """File and member with their folders, to start messages with."""
        return str(self.file) if self.member is None else f"{self.file}/{self.member}"

    @property
    def points(self) -> bool:
        """Whether it is text or a point cloud, that only `tiles.prepare` makes readable."""
        return self.driver in ("xyz", "las")


class Colours(NamedTuple):
    """Colour bands (K, H, W) as stored, the infrared last if there is one, and their validity (H, W)."""

    bands: npt.NDArray[Any]
    valid: BoolArray


class Heights(NamedTuple):
    """Heights (H, W) float64 in metres, which are valid, and what of the rest was not declared.

    Attributes:
        undeclared: values taken for nodata though the file does not say so.
        spikes: cells (H, W) whose height is impossible.
    """

    metres: FloatArray
    valid: BoolArray
    undeclared: list[float]
    spikes: BoolArray


@contextmanager
def named_errors(where: str, what: str = "cannot be read") -> Iterator[None]:
    """Turn what a damaged or foreign file makes the libraries raise into a MapError that names it."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            # A file that declares nodata and has an alpha band or a mask: the latter counts.
            warnings.simplefilter("ignore", NodataShadowWarning)
            yield
    except READ_ERRORS as err:
        root: BaseException = err
        while root.__cause__ is not None:
            root = root.__cause__
        raise MapError(f"{where}: {what} ({root or type(root).__name__}); fetch or export it again") from err


@contextmanager
def opened(path: str, where: str, drivers: Sequence[str] = DRIVERS) -> Iterator[Any]:
    """A rasterio dataset of one of the formats. Raises: MapError, also for errors in the body."""
    with named_errors(where), _dataset(path, drivers) as dataset:
        yield dataset


def _dataset(path: str, drivers: Sequence[str]) -> Any:
    # rasterio takes strings apart ("a!b", "zip+file:"), which names of files may look like.
    target = path if path.startswith("/vsizip/") else Path(path)
    refused = None
    for driver in drivers:
        try:
            return rasterio.open(target, driver=driver)
        except RasterioError as err:
            # A format that knows the file as its own says what is wrong with it.
            if refused is None or "not recognized" in str(refused):
                refused = err
    raise refused or OSError("no format to try")


def read_colours(source: Source, dataset: Any, window: Window) -> Colours:
    """A window inside an orthophoto. Validity: its mask, its alpha band, or its nodata value."""
    rows, columns = int(window.height), int(window.width)
    wanted = [*source.bands, *([source.nir] if source.nir else [])]
    distinct = sorted(set(wanted))
    if source.alpha is not None:
        stored = dataset.read([*distinct, source.alpha], window=window)
        valid = stored[-1] > np.iinfo(stored.dtype).max // 2
    else:
        stored = dataset.read(distinct, window=window)
        valid = dataset.dataset_mask(window=window) > 0
    if source.palette:
        table = np.zeros((256, 4), dtype=np.uint8)
        for index, colour in dataset.colormap(1).items():
            if 0 <= index < 256:
                table[index] = colour
        painted = table[stored[0]]
        return Colours(np.moveaxis(painted[..., :3], -1, 0), valid & (painted[..., 3] > 127))
    # Reflectance below nothing is noise.
    bands = np.maximum(stored[[distinct.index(k) for k in wanted]], 0)
    assert bands.shape[1:] == valid.shape == (rows, columns)
    return Colours(bands, valid)


def read_heights(source: Source, dataset: Any, window: Window) -> Heights:
    """A window inside a surface model."""
    stored = dataset.read(source.bands[0], window=window)
    # Signalling NaN, which damaged files have, warns when it is widened.
    with np.errstate(invalid="ignore"):
        raw = stored.astype(np.float64)
    valid = (dataset.dataset_mask(window=window) > 0) & np.isfinite(raw)
    undeclared: list[float] = []
    low_or_huge = valid & ((raw < MIN_HEIGHT_M) | (raw > _SENTINEL_MAGNITUDE))
    if low_or_huge.any():
        sentinel = low_or_huge & (np.isin(raw, SENTINELS) | (np.abs(raw) > _SENTINEL_MAGNITUDE))
        undeclared = np.unique(raw[sentinel]).tolist()
        valid &= ~sentinel
    with np.errstate(over="ignore", invalid="ignore"):
        metres = raw * source.scale + source.offset
        spikes = valid & ~((metres >= MIN_HEIGHT_M) & (metres <= MAX_HEIGHT_M))
    return Heights(metres, valid & ~spikes, undeclared, spikes)


def to_byte(bands: npt.NDArray[Any], source: Source) -> ImageArray:
    """Colour bands (K, H, W) as stored, or resampled as floats, to 8 bits; the infrared's stretch is its own.

    Raises: MapError for 16 bits without a stretch: each file's own would show as seams.
    """
    if bands.dtype == np.uint8:
        return bands
    values = bands.astype(np.float32)
    if source.dtype != "uint8":
        if source.stretch is None:
            raise MapError(f"{source.where}: 16-bit samples and no common stretch; call with_common_stretch first")
        for index in range(len(values)):
            infrared = index >= len(source.bands)
            low, high = (source.stretch.nir if infrared else None) or source.stretch.rgb
            values[index] = (values[index] - low) * np.float32(255.0 / (high - low))
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def with_common_stretch(sources: list[Source]) -> list[Source]:
    """Give all 16-bit orthophotos the same linear stretch to 8 bits, so that tiles meet without seams.

    From the 0.5 and 99.5 % quantiles of decimated reads of all of them, the three colours together so that their
    balance stays, the infrared on its own. Zeros and the highest value are left out: mostly undeclared collars.
    Raises: MapError if one cannot be read.
    """
    deep = [source for source in sources if _is_deep(source)]
    if not deep:
        return list(sources)
    colours, infrared = np.zeros(2**16, np.int64), np.zeros(2**16, np.int64)
    for source in deep:
        with opened(source.path, source.where, (source.driver,)) as dataset:
            shape = min(_SAMPLE_PX, dataset.height), min(_SAMPLE_PX, dataset.width)
            valid = dataset.dataset_mask(out_shape=shape) > 0
            for band in dict.fromkeys([*source.bands, *([source.nir] if source.nir else [])]):
                sample = dataset.read(band, out_shape=shape, resampling=Resampling.nearest)
                if source.alpha is not None:
                    valid &= dataset.read(source.alpha, out_shape=shape) > 0
                counted = valid & (sample > 0) & (sample < np.iinfo(sample.dtype).max)
                counts = np.bincount(sample[counted], minlength=2**16)
                if band == source.nir:
                    infrared += counts
                else:
                    colours += counts
    rgb = _quantiles(colours)
    stretch = Stretch(rgb, _quantiles(infrared) if infrared.any() else None)
    return [replace(one, stretch=stretch) if _is_deep(one) else one for one in sources]


def _is_deep(source: Source) -> bool:
    return source.kind == "dop" and source.dtype != "uint8"


def _quantiles(counts: npt.NDArray[np.int64]) -> tuple[float, float]:
    total = counts.sum()
    if total == 0:
        return 0.0, 1.0
    low, high = (int(np.searchsorted(np.cumsum(counts), share * total)) for share in _STRETCH_SHARES)
    return float(low), float(max(high, low + 1))


def fingerprint(source: Source) -> str:
    """32 hex digits that change when the file, what lies beside it, its place in a ZIP or how it is read changes.

    The file counts by path, size and time of change: reading the bytes of a whole state would take hours.
    Raises: MapError if the file is gone.
    """
    files = [source.file]
    if source.driver == "VRT" and source.member is None:
        with opened(source.path, source.where, (source.driver,)) as dataset:
            files = [source.file, *sorted(Path(name) for name in dataset.files)]
    notes = []
    # Masks, and what GDAL cannot write into the file itself, as a nodata value of a JPEG 2000.
    beside = [Path(f"{file}{suffix}") for file in files for suffix in (".msk", ".aux.xml")]
    files += [file for file in beside if source.member is None and file.is_file()]
    for file in dict.fromkeys(files):
        try:
            stat = file.stat()
        except OSError as err:
            raise MapError(f"{file}: cannot be read ({err.strerror}); was it moved?") from err
        notes.append((str(file), stat.st_size, stat.st_mtime_ns))
    return hashlib.sha256(repr((notes, source)).encode()).hexdigest()[:32]
