"""OrthoLoC samples: a photo, its pose and the rasters of the region it shows, in one ``.npz`` (docs/samples.md).

Names and keys are those of the published data set, so that its files are read as they are and its loader reads ours.
A folder is listed by names alone; a sample is decoded when it is asked for.
"""

from __future__ import annotations

import logging
import re
import tempfile
import zipfile
import zlib
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numpy as np
import numpy.typing as npt

from ortholoc_edge.errors import DatasetError
from ortholoc_edge.geometry.arrays import Float32Array, FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.geometry.rigid import Rigid3

logger = logging.getLogger(__name__)

# Around the median height of a sample's surface, some hundred metres wide: beyond are blunders of its
# photogrammetry.
_MAX_BELOW_M, _MAX_ABOVE_M = 200.0, 1000.0
_NEEDED = ("image_query", "image_dop", "dsm", "scale", "extrinsics", "intrinsics")
_SCRATCH = ".sample-"
_FORMAT = "the format is described in docs/samples.md"
_TYPED = re.compile(r"^(?P<location>.*)_(?P<kind>R|xDOPDSM|xDOP|xDSM)(?P<index>\d*)$")

Int32Array = npt.NDArray[np.int32]
_Present = TypeVar("_Present")


class SampleKind(StrEnum):
    """What lies between the map and the photo: nothing, another orthophoto, another surface model, or both."""

    SAME = "R"
    XDOP = "xDOP"
    XDSM = "xDSM"
    XDOPDSM = "xDOPDSM"


class Split(StrEnum):
    """The published data set's folders."""

    TRAIN = "train"
    VAL = "val"
    TEST_IN_PLACE = "test_inPlace"
    TEST_OUT_PLACE = "test_outPlace"


@dataclass(frozen=True, slots=True)
class SampleFile:
    """A sample by its name alone.

    Attributes:
        location: "L01" of ``L01_xDOP0012``; of a name without a kind all of it.
        kind: SAME where the name tells none, as the data set's own loader has it.
        split: None outside the data set's folders.
    """

    path: Path
    location: str
    kind: SampleKind
    split: Split | None

    @property
    def name(self) -> str:
        return self.path.stem

    @staticmethod
    def of(path: Path) -> SampleFile:
        typed = _TYPED.match(path.stem)
        folders = [folder for folder in reversed(path.parent.parts) if folder in set(Split)]
        return SampleFile(
            path,
            typed["location"] if typed else path.stem,
            SampleKind(typed["kind"]) if typed else SampleKind.SAME,
            Split(folders[0]) if folders else None,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """A sample in its own local frame: x east, y north, z up, true metres.

    What follows ``grid`` is ground truth beyond the pose; None where the file does not have it.

    Attributes:
        name: of the file, without its ending.
        image: (H, W, 3) uint8 RGB, undistorted.
        map_from_camera: truth.
        dop: (h, w, 3) uint8 RGB.
        dsm: (h, w) float32 heights, NaN where there is no surface.
        grid: of both rasters.
        point_map: (H, W, 3) float32 points that the pixels of the photo show, NaN where unknown.
        keypoints: (N, 3) float64 points seen in the photo.
        vertices, faces: (M, 3) float32 and (L, 3) int32 indices: the surface as a mesh.
        map_from_camera_refined: the pose that fits the rasters best.
    """

    name: str
    image: ImageArray
    camera: Camera
    map_from_camera: Rigid3
    dop: ImageArray
    dsm: Float32Array
    grid: RasterGrid
    point_map: Float32Array | None = None
    keypoints: FloatArray | None = None
    vertices: Float32Array | None = None
    faces: Int32Array | None = None
    map_from_camera_refined: Rigid3 | None = None


def needed(value: _Present | None, sample: Sample, key: str) -> _Present:
    """A part of a sample's truth. Raises: DatasetError if the sample lacks it."""
    if value is None:
        raise DatasetError(
            f"{sample.name}: key {key} is missing and needed here; make the sample anew, or leave it out"
        )
    return value


# -- listing ---------------------------------------------------------------------------------------------


def sample_paths(source: Path) -> list[Path]:
    """The ``.npz`` files that a path names: itself, or those in the folder; empty if there are none."""
    if source.suffix == ".npz":
        return [source]
    return sorted(source.glob("*.npz")) if source.is_dir() else []


def find_samples(
    source: Path, kinds: Collection[SampleKind] | None = None, splits: Collection[Split] | None = None
) -> list[SampleFile]:
    """The samples of a file, or of a folder and all below it, by name; nothing is opened.

    Args:
        kinds, splits: only these; None: all.
    Raises: DatasetError if there are none.
    """
    # Not what a killed run left half written in its hidden folder.
    below = (path for path in source.rglob("*.npz") if not path.parent.name.startswith(_SCRATCH))
    paths = [source] if source.suffix == ".npz" else sorted(below)
    # Absolute, or a split's folder named "." would not be known as one; not resolved: a link's name is the sample's.
    every = [SampleFile.of(path.absolute()) for path in paths]
    if not every:
        raise DatasetError(f"{source}: no .npz file there; {_FORMAT}")
    found = [one for one in every if (kinds is None or one.kind in kinds) and (splits is None or one.split in splits)]
    if not found:
        have = ", ".join(sorted({f"{one.kind} in {one.split or 'no split'}" for one in every}))
        raise DatasetError(f"{source}: none of {len(every)} samples is of that kind and split; there are {have}")
    return found


def stream_samples(files: Iterable[SampleFile]) -> Iterator[Sample]:
    """One at a time. Raises: DatasetError at the first that can't be read."""
    for file in files:
        yield read_sample(file.path)


# -- reading ---------------------------------------------------------------------------------------------


def read_sample(path: Path) -> Sample:
    """A sample. Raises: DatasetError naming the file and the key."""
    try:
        # Opened here: of a damaged archive, np.load leaves its own file open.
        with path.open("rb") as file:
            archive = np.load(file, allow_pickle=False)
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise DatasetError(f"{path}: a single array, expected an archive (.npz) of a sample's keys; {_FORMAT}")
            with archive:
                return _sample(archive, path)
    except DatasetError:
        raise
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as err:
        raise DatasetError(f"{path}: not a readable OrthoLoC sample ({err}); copy it again") from err


def _sample(archive: Any, path: Path) -> Sample:
    missing = [key for key in _NEEDED if key not in archive]
    if missing:
        raise DatasetError(f"{path}: no key {', '.join(missing)} in it; {_FORMAT}")
    image, dop, dsm = archive["image_query"], archive["image_dop"], archive["dsm"]
    for key, array in (("image_query", image), ("image_dop", dop)):
        if array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] != 3:
            _refuse(path, key, array, "(H, W, 3) uint8")
    scale = np.asarray(archive["scale"], dtype=np.float64).ravel()
    if scale.size not in (1, 2) or not np.isfinite(scale).all() or not scale.all():
        raise DatasetError(f"{path}: scale is {scale.tolist()}, expected a number or a pair, not zero; {_FORMAT}")
    dx, dy = abs(float(scale[0])), float(scale[-1])
    if scale.size == 1:
        # One number is only the pixel's size; which way the rows run, the coordinates tell.
        dy = abs(dy) if _rows_run_north(dsm) else -abs(dy)
    heights, west, top = _surface(dsm, dx, dy, path)
    if heights.shape != dop.shape[:2]:
        raise DatasetError(f"{path}: image_dop {dop.shape} and dsm {dsm.shape} differ in size; {_FORMAT}")
    if dy > 0:
        # Packs are north up.
        dop, heights, top, dy = dop[::-1], heights[::-1], top + dy * dop.shape[0], -dy
    intrinsics = np.asarray(archive["intrinsics"], dtype=np.float64)
    if intrinsics.shape != (3, 3):
        _refuse(path, "intrinsics", intrinsics, "(3, 3)")
    vertices, faces = _mesh(archive, path)
    return Sample(
        name=path.stem,
        image=image,
        camera=_camera(image, intrinsics, path),
        map_from_camera=_pose(archive, "extrinsics", path),
        dop=dop,
        dsm=heights,
        grid=RasterGrid(dop.shape[1], dop.shape[0], west, top, dx, dy),
        point_map=_point_map(archive, image, path),
        keypoints=_points(archive, "keypoints", path),
        vertices=vertices,
        faces=faces,
        map_from_camera_refined=_pose(archive, "extrinsics_refined", path) if "extrinsics_refined" in archive else None,
    )


def _refuse(path: Path, key: str, array: npt.NDArray[Any], expected: str) -> NoReturn:
    raise DatasetError(f"{path}: {key} is {array.shape} {array.dtype}, expected {expected}; {_FORMAT}")


def _camera(image: ImageArray, matrix: FloatArray, path: Path) -> Camera:
    height, width = image.shape[:2]
    try:
        return Camera(
            width, height, float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])
        )
    except ValueError as err:
        raise DatasetError(f"{path}: intrinsics: {err}; {_FORMAT}") from err


def _pose(archive: Any, key: str, path: Path) -> Rigid3:
    matrix = np.asarray(archive[key], dtype=np.float64)
    if matrix.shape not in ((3, 4), (4, 4)):
        _refuse(path, key, matrix, "(3, 4) or (4, 4)")
    try:
        # Files in float32 round the rotation: take the nearest true one.
        u, _, vt = np.linalg.svd(matrix[:3, :3])
        return Rigid3(u @ vt, matrix[:3, 3]).inverse()
    except (ValueError, np.linalg.LinAlgError) as err:
        raise DatasetError(f"{path}: {key}: {err}; {_FORMAT}") from err


def _point_map(archive: Any, image: ImageArray, path: Path) -> Float32Array | None:
    if "point_map" not in archive:
        return None
    points = archive["point_map"]
    if points.shape != image.shape or not np.issubdtype(points.dtype, np.floating):
        _refuse(path, "point_map", points, f"{image.shape} floats as the photo's size has it")
    return np.asarray(points, dtype=np.float32)


def _points(archive: Any, key: str, path: Path) -> FloatArray | None:
    if key not in archive:
        return None
    points = archive[key]
    if points.ndim != 2 or points.shape[1] != 3 or not np.issubdtype(points.dtype, np.floating):
        _refuse(path, key, points, "(N, 3) floats")
    return np.asarray(points, dtype=np.float64)


def _mesh(archive: Any, path: Path) -> tuple[Float32Array | None, Int32Array | None]:
    vertices = _points(archive, "vertices", path)
    if vertices is None or "faces" not in archive:
        return None, None
    faces = archive["faces"]
    if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer):
        _refuse(path, "faces", faces, "(L, 3) whole numbers")
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise DatasetError(
            f"{path}: faces name vertices {faces.min()} to {faces.max()}, there are {len(vertices)}; {_FORMAT}"
        )
    return vertices.astype(np.float32), faces.astype(np.int32)


def _rows_run_north(dsm: Any) -> bool:
    if dsm.ndim != 3 or dsm.shape[2] != 3:
        return False
    rows, columns = np.nonzero(np.isfinite(dsm[:, :, 1]))
    return len(rows) > 1 and bool(dsm[rows[-1], columns[-1], 1] > dsm[rows[0], columns[0], 1])


def _surface(dsm: Any, dx: float, dy: float, path: Path) -> tuple[Float32Array, float, float]:
    """Heights (h, w), NaN where implausible, and the outer corner of the first pixel."""
    if dsm.ndim == 2:
        return _plausible(dsm, path), 0.0, 0.0
    if dsm.ndim != 3 or dsm.shape[2] != 3:
        _refuse(path, "dsm", dsm, "(h, w, 3) coordinates or (h, w) heights")
    rows, columns = np.nonzero(np.isfinite(dsm).all(axis=2))
    if not len(rows):
        raise DatasetError(f"{path}: dsm holds no finite point; leave the sample out")
    points = dsm[rows, columns].astype(np.float64)
    # The coordinates are of pixel centres; the median sheds their float32 rounding.
    west = float(np.median(points[:, 0] - dx * (columns + 0.5)))
    top = float(np.median(points[:, 1] - dy * (rows + 0.5)))
    misfit = np.abs(points[:, :2] - np.column_stack([dx * (columns + 0.5) + west, dy * (rows + 0.5) + top]))
    if misfit.max() > 0.5 * max(abs(dx), abs(dy)):
        raise DatasetError(
            f"{path}: dsm coordinates and scale ({dx}, {dy}) disagree by {misfit.max():.2f} m; "
            "is the sign of the second scale right?"
        )
    return _plausible(dsm[:, :, 2], path), west, top


def _plausible(heights: Any, path: Path) -> Float32Array:
    kept = np.array(heights, dtype=np.float32)
    finite = np.isfinite(kept)
    if not finite.any():
        return kept
    above_m = kept - np.median(kept[finite])
    # Comparisons with NaN are false: holes are not counted.
    wrong = (above_m < -_MAX_BELOW_M) | (above_m > _MAX_ABOVE_M)
    if wrong.any():
        logger.warning(
            "%s: %d of %d heights are more than %g m below or %g m above the median; taken as holes",
            path.stem,
            np.count_nonzero(wrong),
            np.count_nonzero(finite),
            _MAX_BELOW_M,
            _MAX_ABOVE_M,
        )
        kept[wrong] = np.nan
    return kept


# -- writing ---------------------------------------------------------------------------------------------


def write_sample(sample: Sample, folder: Path) -> Path:
    """Write ``folder``/NAME.npz, whole or not at all; the same sample gives the same bytes.

    Returns: the file.
    Raises: DatasetError for a sample without the truth that the format has, or a file that can't be written.
    """
    path = folder / f"{sample.name}.npz"
    values = _values(sample)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=_SCRATCH) as scratch:
            part = Path(scratch) / path.name
            np.savez_compressed(part, **values)
            part.replace(path)
    except OSError as err:
        raise DatasetError(f"{path}: can't write it ({err}); is the disk full, the folder yours?") from err
    return path


def _values(sample: Sample) -> dict[str, Any]:
    grid = sample.grid
    u, v = np.meshgrid(np.arange(grid.width), np.arange(grid.height))
    # Where there is no height there still is a place: the data set's loader takes the origin from the first pixel.
    xy = grid.map_from_px(np.stack([u, v], axis=-1))
    refined = needed(sample.map_from_camera_refined, sample, "extrinsics_refined")
    return {
        "sample_id": np.array(sample.name),
        "image_query": np.ascontiguousarray(sample.image),
        "point_map": needed(sample.point_map, sample, "point_map"),
        "image_dop": np.ascontiguousarray(sample.dop),
        "dsm": np.concatenate([xy, sample.dsm[..., None]], axis=2).astype(np.float32),
        "scale": np.array([grid.dx, grid.dy]),
        "extrinsics": _extrinsics(sample.map_from_camera),
        "intrinsics": sample.camera.matrix,
        "keypoints": needed(sample.keypoints, sample, "keypoints").astype(np.float32),
        "vertices": needed(sample.vertices, sample, "vertices"),
        "faces": needed(sample.faces, sample, "faces"),
        "extrinsics_refined": _extrinsics(refined),
    }


def _extrinsics(map_from_camera: Rigid3) -> FloatArray:
    camera_from_map = map_from_camera.inverse()
    return np.column_stack([camera_from_map.rotation, camera_from_map.translation])
