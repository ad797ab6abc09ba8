"""Files that say what a camera is: OpenCV's, Kalibr's, ROS's and our own, to a `Camera`.

All are read as data (YAML by PyYAML's safe loader, without tags but OpenCV's matrix): nothing in them is ever run.
Of what they say, only that is taken which has one meaning. A lens that `Camera` can't be is refused, never cut short.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ortholoc_edge.errors import ConfigError
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.camera import Camera

# Calibration files have kilobytes; a film given by mistake should not fill the memory.
_MAX_BYTES = 1 << 20
# A principal point farther from the middle, as a part of the picture's side: the size is that of other pictures, or has
# its sides exchanged. 4:3 for 3:4 puts it at 0.17, 16:9 for 9:16 at 0.39.
_MAX_OFF_CENTRE = 0.15
# Of the focal length over the picture's long side: fields of view from 157 down to 3 degrees.
_PLAUSIBLE_FOCAL = (0.1, 20.0)
# A skew of this part of the focal length is the rounding of a file that has one by form.
_NO_SKEW = 1e-6
_RADTAN, _RATIONAL, _EQUIDISTANT = "radial-tangential", "rational", "equidistant (fisheye)"
_COEFFICIENTS = {_RADTAN: 5, _RATIONAL: 8, _EQUIDISTANT: 4}
# By other people's names. Kalibr's "equi" and ROS's and OpenCV's fisheye are the same polynomial of the angle.
_MODELS = {
    "plumb_bob": _RADTAN, "radtan": _RADTAN, "pinhole": _RADTAN, "none": _RADTAN, "brown": _RADTAN, "opencv": _RADTAN,
    "rational_polynomial": _RATIONAL, "equidistant": _EQUIDISTANT, "equi": _EQUIDISTANT, "fisheye": _EQUIDISTANT,
    "kannalabrandt8": _EQUIDISTANT,
}  # fmt: skip
# Names without case, dots, dashes and underscores, and without a leading "Camera." or "Camera1.".
_MATRIX = ("cameramatrix", "k", "mtx", "m1", "intrinsicmatrix", "intrinsics")
_DISTORTION = ("distortioncoefficients", "distcoeffs", "distcoeff", "distcoefs", "distortion", "dist", "d", "d1")
_WIDTH, _HEIGHT = ("imagewidth", "width", "widthpx"), ("imageheight", "height", "heightpx")
_SIZE = ("imagesize", "cameraresolution", "resolution", "size")
_BY_NAME = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


@dataclass(frozen=True, slots=True)
class Described:
    """A camera as a file has it.

    Attributes:
        form: of the file, in words.
        width, height: px.
        fx, fy, cx, cy: px; the centre of the first pixel is (0, 0), as with OpenCV, Kalibr and ROS.
        model: of the lens, one of `_COEFFICIENTS`. coefficients: as many as it has there.
    """

    form: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str
    coefficients: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Fitted:
    """A lens of another model as `Camera` can be it.

    Attributes:
        worst_px, rms_px: by how much it puts points elsewhere, over the whole picture.
    """

    camera: Camera
    worst_px: float
    rms_px: float


def read_camera(path: Path, name: str | None = None, size: tuple[int | None, int | None] = (None, None)) -> Camera:
    """The camera that a calibration file says.

    Args:
        name: of one of several in a file of Kalibr's.
        size: width and height, px, where the file may lack them; where it has them they must be these.
    Raises: ConfigError naming the file, the key and what helps; also for a lens that `Camera` can't be.
    """
    found = describe(path, name, size)
    # Without k4 to k6 the rational lens is ours; a fisheye is none, with or without coefficients.
    if found.model == _EQUIDISTANT or any(found.coefficients[5:]):
        raise ConfigError(
            f"{path}: {found.form} with a lens of the model {found.model}, which is not k1, k2, p1, p2, k3; calibrate "
            f"with these (ROS: plumb_bob, Kalibr: pinhole-radtan, or `ortholoc-edge calibrate`), or see how near they "
            f"come: ortholoc-edge convert-calibration {path} --fit"
        )
    return _checked(path, found, found.coefficients[:5])


def fit(path: Path, found: Described) -> Fitted:
    """The nearest `Camera` of a lens of another model: k1, k2, p1, p2, k3 by least squares over the picture.

    The focal lengths and the principal point stay: near the axis both models are the same.
    Raises: ConfigError where the lens has points of the picture that no pinhole sees.
    """
    across = np.stack(
        np.meshgrid(np.linspace(-0.5, found.width - 0.5, 41), np.linspace(-0.5, found.height - 0.5, 31)), axis=-1
    ).reshape(-1, 2)
    seen = (across - (found.cx, found.cy)) / (found.fx, found.fy)
    ideal = _ideal(found, seen)
    if not np.isfinite(ideal).all():
        raise ConfigError(
            f"{path}: {found.form}: the lens sees 90 degrees and more off its axis in the picture's corners, which no "
            "pinhole does; crop the picture, or take a longer lens"
        )
    x, y = ideal.T
    r2 = x * x + y * y
    columns = np.stack(
        [
            np.stack([x * r2, y * r2], axis=-1),
            np.stack([x * r2**2, y * r2**2], axis=-1),
            np.stack([2.0 * x * y, r2 + 2.0 * y * y], axis=-1),
            np.stack([r2 + 2.0 * x * x, 2.0 * x * y], axis=-1),
            np.stack([x * r2**3, y * r2**3], axis=-1),
        ],
        axis=-1,
    )
    in_px = np.array([found.fx, found.fy])
    rows, wanted = (columns * in_px[:, None]).reshape(-1, 5), ((seen - ideal) * in_px).reshape(-1)
    coefficients = np.linalg.lstsq(rows, wanted, rcond=None)[0]
    off = np.linalg.norm((rows @ coefficients - wanted).reshape(-1, 2), axis=1)
    camera = _checked(path, found, coefficients.tolist())
    return Fitted(camera, float(off.max()), float(np.sqrt((off**2).mean())))


def describe(path: Path, name: str | None = None, size: tuple[int | None, int | None] = (None, None)) -> Described:
    """What a file says, whatever the lens; for the arguments and what is raised see `read_camera`."""
    text = _text(path)
    if path.suffix.lower() == ".toml":
        return _ours(path, text, name, size)
    if text.lstrip().startswith("<"):
        raise ConfigError(f"{path}: XML; write it as YAML: cv2.FileStorage of a name that ends in .yml")
    raw = _yaml(path, text)
    kalibr = {key: value for key, value in raw.items() if isinstance(value, dict) and "camera_model" in value}
    if "camera_model" in raw:
        kalibr = {"the file": raw}
    if kalibr:
        return _kalibr(path, _chosen(path, kalibr, name), size)
    if name is not None:
        raise ConfigError(f"{path}: a camera {name!r} is asked for, and the file is of one camera without a name")
    return _matrices(path, raw, size)


def toml_of(camera: Camera, head: Sequence[str] = ()) -> str:
    """The ``[intrinsics]`` of a vehicle's file; ``head``: lines of comment before it."""
    values = {
        "width_px": f"{camera.width}", "height_px": f"{camera.height}",
        "fx": _number(camera.fx), "fy": _number(camera.fy), "cx": _number(camera.cx), "cy": _number(camera.cy),
        "distortion": f"[{', '.join(_number(value) for value in camera.distortion)}]",
    }  # fmt: skip
    lines = [*(f"# {line}" for line in head), "[intrinsics]", *(f"{key} = {text}" for key, text in values.items())]
    return "\n".join(lines) + "\n"


def opencv_yaml_of(camera: Camera) -> str:
    """As OpenCV's calibration sample names things, for cv2.FileStorage."""
    matrix = [_number(value) for value in camera.matrix.ravel().tolist()]
    distortion = [_number(value) for value in camera.distortion]
    return (
        f"%YAML:1.0\n---\nimage_width: {camera.width}\nimage_height: {camera.height}\n"
        f"camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ {', '.join(matrix)} ]\n"
        f"distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 5\n   dt: d\n"
        f"   data: [ {', '.join(distortion)} ]\n"
    )


def _number(value: float) -> str:
    """With a point, which YAML 1.1 and TOML want of a float."""
    text = f"{value:.10g}"
    return text if re.search(r"[.]", text) else text.replace("e", ".0e") if "e" in text else f"{text}.0"


# -- files ---------------------------------------------------------------------------------------------


def _text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            data = file.read(_MAX_BYTES + 1)
        if len(data) > _MAX_BYTES:
            raise ConfigError(f"{path}: more than {_MAX_BYTES >> 20} MiB; not a calibration file")
        return data.decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as err:
        raise ConfigError(f"{path}: can't be read ({err}); name a calibration of OpenCV, Kalibr, ROS or ours") from err


def _yaml(path: Path, text: str) -> dict[Any, Any]:
    """JSON is YAML, too."""
    # Only where a file is read: the daemon of a vehicle with intrinsics of its own needs none of it.
    import yaml

    class Loader(yaml.SafeLoader):  # type: ignore[misc]
        """Knows OpenCV's matrix, and refuses what is said twice."""

        def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
            keys = [self.construct_object(key, deep=True) for key, _ in node.value]
            twice = [key for number, key in enumerate(keys) if key in keys[:number]]
            if twice:
                raise ConfigError(f"{path}: `{twice[0]}` stands there twice; leave one of them out")
            found: dict[Any, Any] = super().construct_mapping(node, deep=True)
            return found

    def matrix(loader: Loader, node: yaml.Node) -> dict[Any, Any]:
        if not isinstance(node, yaml.MappingNode):
            raise ConfigError(f"{path}: `!!opencv-matrix` without rows, cols and data")
        return loader.construct_mapping(node)

    Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", matrix)
    # OpenCV before 5 begins with "%YAML:1.0", which is no directive of YAML's.
    text = re.sub(r"\A%YAML:1\.0[ \t]*\r?\n", "", text)
    try:
        found = yaml.load(text, Loader=Loader)
    except (yaml.YAMLError, RecursionError, ValueError, TypeError) as err:
        where = str(err).replace("\n", " ")
        raise ConfigError(f"{path}: not YAML ({where}); name a calibration of OpenCV, Kalibr, ROS or ours") from err
    if not isinstance(found, dict):
        raise ConfigError(f"{path}: no keys in it; name a calibration of OpenCV, Kalibr, ROS or ours")
    return found


def _ours(path: Path, text: str, name: str | None, size: tuple[int | None, int | None]) -> Described:
    try:
        raw = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as err:
        raise ConfigError(f"{path}: not TOML: {err}") from err
    if name is not None:
        raise ConfigError(f"{path}: a camera {name!r} is asked for, and our TOML is of one camera without a name")
    table = raw.get("intrinsics", raw)
    if not isinstance(table, dict) or "fx" not in table:
        raise ConfigError(f"{path}: no [intrinsics] with fx in it; `ortholoc-edge calibrate` writes such a file")
    known = {"width_px", "height_px", "fx", "fy", "cx", "cy", "distortion"}
    unknown = sorted(set(table) - known)
    if unknown:
        raise ConfigError(f"{path}: `{unknown[0]}` is no key of [intrinsics]; it has {', '.join(sorted(known))}")
    return _matrices(path, table, size, form="TOML")


def _chosen(path: Path, cameras: Mapping[Any, dict[Any, Any]], name: str | None) -> dict[Any, Any]:
    names = ", ".join(str(key) for key in cameras)
    if name is None:
        if len(cameras) > 1:
            raise ConfigError(f'{path}: has {names}; name the one that is meant: file_camera = "{next(iter(cameras))}"')
        return next(iter(cameras.values()))
    if name not in cameras:
        raise ConfigError(f"{path}: has no camera {name!r}, only {names}")
    return cameras[name]


# -- Kalibr --------------------------------------------------------------------------------------------


def _kalibr(path: Path, raw: Mapping[Any, Any], size: tuple[int | None, int | None]) -> Described:
    model, lens = str(raw.get("camera_model")).lower(), str(raw.get("distortion_model", "none")).lower()
    if model != "pinhole":
        raise ConfigError(
            f"{path}: Kalibr's camera_model {model!r} is no pinhole; calibrate with `--models pinhole-radtan`, or "
            "with `ortholoc-edge calibrate`"
        )
    if lens not in ("radtan", "equi", "none"):
        raise ConfigError(
            f"{path}: Kalibr's distortion_model {lens!r} is not k1, k2, p1, p2, k3; calibrate with "
            "`--models pinhole-radtan`, or with `ortholoc-edge calibrate`"
        )
    four = _numbers(path, "intrinsics", raw.get("intrinsics"))
    if len(four) != 4:
        raise ConfigError(f"{path}: `intrinsics` has {len(four)} numbers; a pinhole of Kalibr's has fu, fv, pu, pv")
    coefficients = [] if lens == "none" else _numbers(path, "distortion_coeffs", raw.get("distortion_coeffs"))
    if lens != "none" and len(coefficients) != 4:
        raise ConfigError(f"{path}: `distortion_coeffs` has {len(coefficients)} numbers; {lens} of Kalibr's has 4")
    width, height = _size(path, _plain(path, {"resolution": raw.get("resolution")}), size)
    return _described(path, "Kalibr", (width, height), four, _MODELS[lens], coefficients)


# -- OpenCV, ROS, and what people write by hand --------------------------------------------------------


def _matrices(
    path: Path, raw: Mapping[Any, Any], size: tuple[int | None, int | None], form: str | None = None
) -> Described:
    plain = _plain(path, raw)
    if (model := str(plain.get("distortionmodel", "")).lower()) and model not in _MODELS:
        raise ConfigError(
            f"{path}: `distortion_model` {model!r} is none of {', '.join(_MODELS)}; calibrate with plumb_bob, or with "
            "`ortholoc-edge calibrate`"
        )
    if form is None:
        form = "ROS camera_info" if model else "OpenCV"
    _check_whole(path, plain)
    four = _four(path, plain)
    given = _given(path, plain, _DISTORTION)
    by_name = {key: _float(path, plain.spelled[key], plain[key]) for key in _BY_NAME if key in plain}
    if given is not None and by_name:
        raise ConfigError(f"{path}: the distortion stands there twice, as `{given[0]}` and as `{next(iter(by_name))}`")
    coefficients = [] if given is None else _numbers(path, given[0], given[1])
    if by_name:
        coefficients = [by_name.get(key, 0.0) for key in _BY_NAME]
        if not any(coefficients[5:]):
            del coefficients[5:]
    kind = _MODELS.get(model or str(plain.get("type", "pinhole")).lower(), _RADTAN)
    if plain.get("fisheyemodel") not in (None, 0, False, "0"):
        kind = _EQUIDISTANT
    if kind != _EQUIDISTANT:
        kind = _by_length(path, given[0] if given else "distortion", coefficients)
    return _described(path, form, _size(path, plain, size), four, kind, coefficients)


class _Plain(dict[str, Any]):
    """Values by their keys without what people write differently; ``spelled``: the keys as they stand there."""

    spelled: dict[str, str]


def _plain(path: Path, raw: Mapping[Any, Any]) -> _Plain:
    found = _Plain()
    found.spelled = {}
    for key, value in raw.items():
        short = re.sub(r"[._\- ]", "", re.sub(r"^camera1?\.", "", str(key).lower()))
        if short in found and found[short] != value:
            raise ConfigError(
                f"{path}: `{found.spelled[short]}` and `{key}` say different things; leave one of them out"
            )
        found[short], found.spelled[short] = value, str(key)
    return found


def _check_whole(path: Path, plain: _Plain) -> None:
    """ROS: of binned pictures, or of a part of them, the matrix is that of others."""
    for key in ("binningx", "binningy"):
        if plain.get(key) not in (None, 0, 1):
            raise ConfigError(
                f"{path}: `{plain.spelled[key]}` is {plain[key]}: the matrix is of pictures without binning; calibrate "
                "those that fly"
            )
    region = plain.get("roi")
    if isinstance(region, dict) and any(region.get(key) for key in ("x_offset", "y_offset", "width", "height")):
        raise ConfigError(f"{path}: `roi` is a part of the picture; calibrate the pictures that fly")


def _four(path: Path, plain: _Plain) -> list[float]:
    """fx, fy, cx, cy."""
    given = _given(path, plain, _MATRIX)
    named = [key for key in ("fx", "fy", "cx", "cy") if key in plain]
    if given is None:
        if len(named) != 4:
            lacking = next(key for key in ("fx", "fy", "cx", "cy") if key not in plain)
            raise ConfigError(
                f"{path}: neither a `camera_matrix` nor `{lacking}`; name a calibration of OpenCV, Kalibr, ROS or ours"
            )
        return [_float(path, plain.spelled[key], plain[key]) for key in named]
    if named:
        other = plain.spelled[named[0]]
        raise ConfigError(f"{path}: `{given[0]}` and `{other}` both say the focal length; leave one of them out")
    key, value = given
    numbers = _numbers(path, key, value)
    if len(numbers) == 4 and isinstance(value, list) and not isinstance(value[0], list):
        raise ConfigError(f"{path}: `{key}` has 4 numbers, whose order is not known; write fx, fy, cx, cy by name")
    if len(numbers) != 9:
        raise ConfigError(f"{path}: `{key}` has {len(numbers)} numbers; a camera matrix has 3 rows of 3")
    matrix: FloatArray = np.array(numbers).reshape(3, 3)
    if abs(matrix[0, 1]) > _NO_SKEW * abs(matrix[0, 0]):
        raise ConfigError(f"{path}: `{key}` has a skew of {matrix[0, 1]:g} px; calibrate without one")
    if matrix[1, 0] != 0.0 or matrix[2].tolist() != [0.0, 0.0, 1.0]:
        raise ConfigError(f"{path}: `{key}` is no camera matrix: rows fx 0 cx, 0 fy cy, 0 0 1")
    return [float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])]


def _given(path: Path, plain: _Plain, names: Sequence[str]) -> tuple[str, Any] | None:
    """The one key, as it stands there, of several that mean the same, and its value."""
    there = [name for name in names if plain.get(name) is not None]
    if not there:
        return None
    if any(plain[name] != plain[there[0]] for name in there[1:]):
        one, other = (plain.spelled[name] for name in there[:2])
        raise ConfigError(f"{path}: `{one}` and `{other}` say different things; leave one of them out")
    return plain.spelled[there[0]], plain[there[0]]


def _by_length(path: Path, key: str, coefficients: list[float]) -> str:
    """OpenCV tells its models apart by how many numbers there are: k1, k2, p1, p2, k3, k4, k5, k6, s1, …"""
    if len(coefficients) not in (0, 4, 5, 8, 12, 14):
        raise ConfigError(
            f"{path}: `{key}` has {len(coefficients)} numbers; OpenCV's distortion has 4, 5, 8, 12 or 14: k1, k2, p1, "
            "p2, k3, …"
        )
    if any(coefficients[8:]):
        raise ConfigError(
            f"{path}: `{key}` has a thin prism or a tilted sensor; calibrate without CALIB_THIN_PRISM_MODEL and "
            "CALIB_TILTED_MODEL, or with `ortholoc-edge calibrate`"
        )
    del coefficients[8:]
    return _RATIONAL if len(coefficients) == 8 else _RADTAN


def _size(path: Path, plain: _Plain, size: tuple[int | None, int | None]) -> tuple[int, int]:
    found: list[int | None] = [None, None]
    pair = _given(path, plain, _SIZE)
    if pair is not None:
        numbers = _numbers(path, pair[0], pair[1])
        if len(numbers) != 2:
            raise ConfigError(f"{path}: `{pair[0]}` has {len(numbers)} numbers; it is the width and the height, px")
        found = [_whole(path, pair[0], number) for number in numbers]
    for side, names in enumerate((_WIDTH, _HEIGHT)):
        given = _given(path, plain, names)
        if given is None:
            continue
        value = _whole(path, given[0], _float(path, *given))
        if found[side] is not None and found[side] != value:
            raise ConfigError(f"{path}: `{given[0]}` is {value}, `{pair[0] if pair else ''}` says {found[side]}")
        found[side] = value
    both = []
    for in_file, wanted, name in zip(found, size, ("width_px", "height_px"), strict=True):
        if in_file is None and wanted is None:
            raise ConfigError(
                f"{path}: does not say of what size the calibrated pictures are; add image_width and image_height, or "
                f"write {name} beside the file's name"
            )
        if in_file is not None and wanted is not None and in_file != wanted:
            raise ConfigError(
                f"{path}: calibrated with pictures of {found[0]} x {found[1]} px, not {size[0]} x {size[1]}; calibrate "
                "at the size that flies"
            )
        both.append(in_file if in_file is not None else wanted)
    width, height = both
    assert width is not None and height is not None
    return width, height


def _described(
    path: Path, form: str, size: tuple[int, int], four: Sequence[float], model: str, coefficients: Sequence[float]
) -> Described:
    count = _COEFFICIENTS[model]
    if len(coefficients) > count or (model == _EQUIDISTANT and len(coefficients) not in (0, 4)):
        raise ConfigError(f"{path}: {len(coefficients)} coefficients of distortion; {model} has {count}")
    padded = (*coefficients, *([0.0] * (count - len(coefficients))))
    fx, fy, cx, cy = four
    return Described(form, *size, fx, fy, cx, cy, model, padded)


def _checked(path: Path, found: Described, distortion: Sequence[float]) -> Camera:
    """A camera that can be, of pictures of that size."""
    least, most = (part * max(found.width, found.height) for part in _PLAUSIBLE_FOCAL)
    for key, focal in (("fx", found.fx), ("fy", found.fy)):
        if not least <= focal <= most:
            raise ConfigError(
                f"{path}: a focal length {key} of {focal:g} px does not go with pictures of {found.width} x "
                f"{found.height} px ({least:g} to {most:g}); is it in px, and is the camera calibrated at all?"
            )
    for key, centre, side in (("cx", found.cx, found.width), ("cy", found.cy, found.height)):
        off = abs(centre - (side - 1) / 2) / side
        if not off <= _MAX_OFF_CENTRE:
            raise ConfigError(
                f"{path}: the principal point's {key} of {centre:g} px is {off:.0%} of {side} px off the middle "
                f"(at most {_MAX_OFF_CENTRE:.0%}); is {found.width} x {found.height} the size of the calibrated "
                "pictures, width first?"
            )
    k1, k2, p1, p2, k3 = distortion
    try:
        return Camera(found.width, found.height, found.fx, found.fy, found.cx, found.cy, (k1, k2, p1, p2, k3))
    except ValueError as err:
        raise ConfigError(f"{path}: {err}") from err


def _ideal(found: Described, seen: FloatArray) -> FloatArray:
    """(N, 2) x / z and y / z of what the lens puts at (N, 2); NaN where it sees 90 degrees and more off the axis."""
    if found.model == _EQUIDISTANT:
        k = found.coefficients
        at = np.linalg.norm(seen, axis=1)
        angle = at.copy()
        for _ in range(50):
            squared = angle**2
            grown = 1.0 + squared * (k[0] + squared * (k[1] + squared * (k[2] + squared * k[3])))
            slope = 3.0 * k[0] + squared * (5.0 * k[1] + squared * (7.0 * k[2] + squared * 9.0 * k[3]))
            angle = angle - (angle * grown - at) / (1.0 + squared * slope)
        inside = (np.abs(angle) < 0.5 * math.pi - 1e-3) & np.isfinite(angle)
        tangent = np.tan(np.where(inside, angle, 0.0))
        scale = np.where(at > 1e-12, tangent / np.maximum(at, 1e-12), 1.0)
        return np.where(inside[:, None], seen * scale[:, None], np.nan)
    # By its own Newton's method `Camera` inverts the first five; the rational's denominator is divided out around it.
    k1, k2, p1, p2, k3, k4, k5, k6 = (*found.coefficients, 0.0, 0.0, 0.0)[:8]
    xy = seen.copy()
    for _ in range(200):
        x, y = xy.T
        r2 = x * x + y * y
        radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        tangential = np.stack(
            [2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y], axis=-1
        )
        # Halfway, since the whole step of the usual fixed point swings in strong distortion.
        xy = 0.5 * xy + 0.5 * (seen - tangential) / radial[:, None]
    forward = xy * radial[:, None] + tangential
    return np.where((np.abs(forward - seen).max(axis=1) < 1e-6)[:, None], xy, np.nan)


def _numbers(path: Path, key: str, value: Any) -> list[float]:
    """Of a list, a list of lists, or a matrix of OpenCV's or ROS's."""
    if isinstance(value, dict):
        numbers = _numbers(path, key, value.get("data"))
        rows, cols = (_whole(path, f"{key}.{side}", _float(path, key, value.get(side))) for side in ("rows", "cols"))
        if rows * cols != len(numbers):
            raise ConfigError(f"{path}: `{key}` has {len(numbers)} numbers, not {rows} rows of {cols}")
        return numbers
    if not isinstance(value, list):
        raise ConfigError(f"{path}: `{key}` is {_shown(value)}; write a list of numbers")
    numbers = []
    for part in value:
        numbers += _numbers(path, key, part) if isinstance(part, list) else [_float(path, key, part)]
    return numbers


def _float(path: Path, key: str, value: Any) -> float:
    try:
        # YAML 1.1, which PyYAML speaks, takes 1e-3 for a word.
        number = float(value) if isinstance(value, int | float | str) and not isinstance(value, bool) else math.nan
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ConfigError(f"{path}: `{key}` is {_shown(value)}; write a finite number")
    return number


def _whole(path: Path, key: str, number: float) -> int:
    if number != int(number) or number < 1:
        raise ConfigError(f"{path}: `{key}` is {number:g}; write a whole number above zero")
    return int(number)


def _shown(value: Any) -> str:
    text = "nothing" if value is None else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
