"""Calibration files of others: the same camera from each form, and a refusal of what `Camera` can't be."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ortholoc_edge.calibration.files import describe, fit, opencv_yaml_of, read_camera, toml_of
from ortholoc_edge.cli import main
from ortholoc_edge.config import config_from_text, config_text, read_config
from ortholoc_edge.errors import ConfigError
from ortholoc_edge.geometry.camera import Camera

EXAMPLE = (Path(__file__).resolve().parents[2] / "config" / "example.toml").read_text(encoding="utf-8")
CAMERA = Camera(1280, 720, 910.5, 911.25, 642.0, 355.5, (-0.28, 0.09, 0.0008, -0.0005, 0.01))
FOUR = Camera(1280, 720, 910.5, 911.25, 642.0, 355.5, (-0.28, 0.09, 0.0008, -0.0005, 0.0))
PLAIN = Camera(1280, 720, 910.5, 911.25, 642.0, 355.5)

OPENCV = """%YAML:1.0
---
calibration_time: "Mon 30 Nov 2026 20:00:00"
image_width: 1280
image_height: 720
board_width: 9
flags: 0
fisheye_model: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 9.1050000000000000e+02, 0., 642., 0., 911.25, 355.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -0.28, 9.0e-02, 8e-4, -5.0e-04, 0.01 ]
avg_reprojection_error: 2.1e-01
"""
KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.09, 0.0008, -0.0005]
  distortion_model: radtan
  intrinsics: [910.5, 911.25, 642.0, 355.5]
  resolution: [1280, 720]
  rostopic: /cam0/image_raw
"""
TWO = KALIBR + KALIBR.replace("cam0", "cam1").replace("910.5", "800.0").replace("911.25", "801.0")
ROS = """image_width: 1280
image_height: 720
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [910.5, 0, 642.0, 0, 911.25, 355.5, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.28, 0.09, 0.0008, -0.0005, 0.01]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [800, 0, 640, 0, 0, 800, 360, 0, 0, 0, 1, 0]
"""
ROS_TOPIC = """header: {stamp: {sec: 1, nanosec: 2}, frame_id: cam}
height: 720
width: 1280
distortion_model: rational_polynomial
d: [-0.28, 0.09, 0.0008, -0.0005, 0.01, 0.0, 0.0, 0.0]
k: [910.5, 0.0, 642.0, 0.0, 911.25, 355.5, 0.0, 0.0, 1.0]
r: [1, 0, 0, 0, 1, 0, 0, 0, 1]
p: [800, 0, 640, 0, 0, 800, 360, 0, 0, 0, 1, 0]
binning_x: 0
binning_y: 0
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}
"""
BY_HAND = """camera_matrix: [[910.5, 0, 642.0], [0, 911.25, 355.5], [0, 0, 1]]
dist_coeff: [[-0.28, 0.09, 8e-4, -5e-4, 1e-2]]
resolution: [1280, 720]
"""
ORB_SLAM = """%YAML:1.0
Camera.type: "PinHole"
Camera.fx: 910.5
Camera.fy: 911.25
Camera.cx: 642.0
Camera.cy: 355.5
Camera.k1: -0.28
Camera.k2: 0.09
Camera.p1: 8e-4
Camera.p2: -5e-4
Camera.k3: 0.01
Camera.width: 1280
Camera.height: 720
Camera.fps: 30
"""
FORMS = {
    "opencv": (OPENCV, CAMERA), "kalibr": (KALIBR, FOUR), "ros": (ROS, CAMERA), "ros_topic": (ROS_TOPIC, CAMERA),
    "by_hand": (BY_HAND, CAMERA), "orb_slam": (ORB_SLAM, CAMERA),
    "json": (json.dumps({"width_px": 1280, "height_px": 720, "fx": 910.5, "fy": 911.25, "cx": 642, "cy": 355.5}),
             PLAIN),
    "old_opencv": (OPENCV.replace("camera_matrix", "Camera_Matrix").replace("distortion_c", "Distortion_C")
                   .replace("image_width", "image_Width").replace("image_height", "image_Height"), CAMERA),
    "no_distortion": (KALIBR.replace("distortion_model: radtan", "distortion_model: none"), PLAIN),
}  # fmt: skip


def written(folder: Path, text: str, name: str = "camera.yaml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("form", FORMS)
def test_each_form_says_the_same_camera(tmp_path, form):
    text, camera = FORMS[form]
    assert read_camera(written(tmp_path, text)) == camera


def test_what_opencv_itself_writes_and_reads(tmp_path):
    path = tmp_path / "written.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 1280)
    storage.write("image_height", 720)
    storage.write("camera_matrix", CAMERA.matrix)
    storage.write("distortion_coefficients", np.array([CAMERA.distortion]))
    storage.release()
    assert read_camera(path) == CAMERA
    storage = cv2.FileStorage(str(written(tmp_path, opencv_yaml_of(CAMERA))), cv2.FILE_STORAGE_READ)
    assert np.allclose(storage.getNode("camera_matrix").mat(), CAMERA.matrix)
    assert np.allclose(storage.getNode("distortion_coefficients").mat(), CAMERA.distortion)
    assert storage.getNode("image_width").real() == 1280


@settings(max_examples=60, deadline=None)
@given(
    st.builds(
        lambda w, h, f, g, x, y, d: Camera(w, h, f * w, g * w, (w - 1) / 2 + x * w, (h - 1) / 2 + y * h, tuple(d)),
        st.integers(1000, 8000), st.integers(1000, 8000), st.floats(1.0, 3.0), st.floats(1.0, 3.0),
        st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.lists(st.floats(-0.9, 0.9), min_size=5, max_size=5),
    )
)  # fmt: skip
def test_what_is_written_is_read_again(tmp_path_factory, camera):
    folder = tmp_path_factory.mktemp("written", numbered=True)
    for name, text in (("camera.toml", toml_of(camera, ["a line"])), ("camera.yaml", opencv_yaml_of(camera))):
        again = read_camera(written(folder, text, name))
        assert (again.width, again.height) == (camera.width, camera.height)
        for ours, theirs in ((camera.matrix, again.matrix), (camera.distortion, again.distortion)):
            assert np.allclose(ours, theirs, rtol=1e-9, atol=1e-12)


def changed(text: str, old: str, new: str) -> str:
    assert text.count(old) == 1, old
    return text.replace(old, new)


REFUSED = [
    (TWO, r"has cam0, cam1; name the one that is meant: file_camera = \"cam0\""),
    (KALIBR.replace("pinhole\n", "omni\n"), r"camera_model 'omni' is no pinhole; calibrate with .*pinhole-radtan"),
    (KALIBR.replace("radtan", "equi"), r"equidistant.*not k1, k2, p1, p2, k3; calibrate.*convert-calibration .*--fit"),
    (KALIBR.replace("radtan", "fov"), r"distortion_model 'fov'.*pinhole-radtan"),
    (KALIBR.replace("[910.5, 911.25, 642.0, 355.5]", "[910.5, 911.25, 642.0]"), r"`intrinsics` has 3 numbers"),
    (KALIBR.replace("[1280, 720]", "[720, 1280]"), r"principal point's cx .*width first"),
    (ROS.replace("plumb_bob", "equidistant").replace(", 0.01]", "]").replace("cols: 5", "cols: 4"),
     r"equidistant.*--fit"),
    (ROS.replace("plumb_bob", "thin_lens"), r"`distortion_model` 'thin_lens' is none of"),
    (changed(ROS_TOPIC, "0.0, 0.0, 0.0]\nk", "0.0, 0.1, 0.0]\nk"), r"rational.*not k1, k2, p1, p2, k3"),
    (changed(ROS_TOPIC, "binning_x: 0", "binning_x: 2"), r"`binning_x` is 2.*calibrate those that fly"),
    (changed(ROS_TOPIC, "y_offset: 0, height: 0", "y_offset: 60, height: 600"), r"`roi` is a part of the picture"),
    (changed(OPENCV, "fisheye_model: 0", "fisheye_model: 1"), r"5 coefficients of distortion; equidistant.* has 4"),
    (changed(OPENCV, "image_width: 1280\n", ""), r"does not say of what size.*image_width.*or write width_px beside"),
    (changed(OPENCV, "cols: 3", "cols: 4"), r"`camera_matrix` has 9 numbers, not 3 rows of 4"),
    (changed(OPENCV, "data: [ 9.1050000000000000e+02, 0.,", "data: [ 9.1050000000000000e+02, 0.7,"), r"skew of 0.7 px"),
    (changed(OPENCV, "data: [ 9.1050000000000000e+02", "data: [ .Nan"), r"`camera_matrix` is '.Nan'; write a finite"),
    (changed(OPENCV, "9.1050000000000000e+02", "0.0"), r"focal length fx of 0 px does not go with"),
    (changed(OPENCV, "9.1050000000000000e+02", "3.6"), r"focal length fx of 3.6 px.*is it in px"),
    (changed(BY_HAND, "1e-2]]", "1e-2, 3e-2]]"), r"`dist_coeff` has 6 numbers; OpenCV's distortion has 4, 5, 8"),
    (BY_HAND + "K: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n", r"`camera_matrix` and `K` say different things"),
    (BY_HAND + "resolution: [640, 480]\n", r"`resolution` stands there twice"),
    (BY_HAND + "image_width: 640\n", r"`image_width` is 640, `resolution` says 1280"),
    (BY_HAND + "fx: 900\n", r"`camera_matrix` and `fx` both say the focal length"),
    ("intrinsics: [910.5, 911.25, 642.0, 355.5]\nresolution: [1280, 720]\n", r"4 numbers, whose order is not known"),
    ("fx: 910\nfy: 910\ncx: 640\n", r"neither a `camera_matrix` nor `cy`"),
    ("<?xml version='1.0'?><opencv_storage/>", r"XML; write it as YAML"),
    ("just words", r"no keys in it"),
    ("a: [1, 2", r"not YAML"),
    ("a: !!python/object/apply:os.system ['touch /tmp/never']", r"not YAML.*could not determine a constructor"),
    ("a: " + "[" * 5000, r"not YAML"),
    ("x" * (1 << 21), r"more than 1 MiB; not a calibration"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "why"), REFUSED)
def test_what_is_refused_names_file_key_and_remedy(tmp_path, text, why):
    path = written(tmp_path, text)
    with pytest.raises(ConfigError, match=f"(?s)camera.yaml: .*{why}"):
        read_camera(path)


@given(st.binary(max_size=400) | st.text(max_size=200).map(str.encode) | st.builds(
    lambda at, byte: OPENCV.encode()[:at] + bytes([byte]) + OPENCV.encode()[at + 1:],
    st.integers(0, len(OPENCV) - 1), st.integers(0, 255)))  # fmt: skip
@settings(max_examples=150, deadline=None)
def test_hostile_bytes_are_refused_or_a_camera(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("hostile", numbered=True) / "camera.yaml"
    path.write_bytes(data)
    try:
        found = read_camera(path)
    except ConfigError as err:
        assert "camera.yaml" in str(err)
    else:
        assert found.width == 1280


def equidistant(k: tuple[float, float, float, float], focal: float = 910.5) -> str:
    text = KALIBR.replace("radtan", "equi").replace("-0.28, 0.09, 0.0008, -0.0005", ", ".join(map(str, k)))
    return text.replace("910.5", str(focal)).replace("911.25", str(focal))


def test_a_fisheye_is_approached_as_far_as_it_can_be(tmp_path):
    """Against OpenCV's own fisheye: what the fitted camera projects lies where the fisheye's points lie. 70 degrees
    wide it is more than a pixel off in the corners, which is not enough."""
    k = (-0.02, 0.004, -0.001, 0.0002)
    path = written(tmp_path, equidistant(k))
    fitted = fit(path, describe(path))
    rays = np.stack(np.meshgrid(np.linspace(-0.68, 0.68, 9), np.linspace(-0.38, 0.38, 7), [1.0]), -1).reshape(-1, 3)
    matrix = np.array([[910.5, 0, 642.0], [0, 910.5, 355.5], [0, 0, 1]])
    theirs, _ = cv2.fisheye.projectPoints(rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), matrix, np.array(k))
    off = np.linalg.norm(fitted.camera.project(rays) - theirs.reshape(-1, 2), axis=1)
    assert off.max() < 1.1 * fitted.worst_px + 0.01
    assert 0.05 < fitted.rms_px < fitted.worst_px and 0.5 < fitted.worst_px < 1.5


def test_a_rational_lens_is_approached(tmp_path):
    coefficients = np.array([0.4, 0.05, 0.0008, -0.0005, 0.002, 0.68, 0.12, 0.01])
    text = ROS.replace("plumb_bob", "rational_polynomial").replace("cols: 5", "cols: 8")
    text = text.replace("-0.28, 0.09, 0.0008, -0.0005, 0.01", ", ".join(map(str, coefficients)))
    path = written(tmp_path, text)
    fitted = fit(path, describe(path))
    rays = np.stack(np.meshgrid(np.linspace(-0.7, 0.7, 9), np.linspace(-0.4, 0.4, 7), [1.0]), -1).reshape(-1, 3)
    theirs, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), CAMERA.matrix, coefficients)
    off = np.linalg.norm(fitted.camera.project(rays) - theirs.reshape(-1, 2), axis=1)
    assert off.max() < 1.1 * fitted.worst_px + 0.01 and fitted.worst_px < 0.5


def test_a_lens_that_no_pinhole_is_can_not_be_approached(tmp_path):
    path = written(tmp_path, equidistant((0.0, 0.0, 0.0, 0.0), focal=300.0))
    with pytest.raises(ConfigError, match="90 degrees and more"):
        fit(path, describe(path))


# -- in a vehicle's file -------------------------------------------------------------------------------


def vehicle(folder: Path, intrinsics: str) -> Path:
    begin, end = EXAMPLE.index("\n[intrinsics]"), EXAMPLE.index("\n[mount]")
    return written(folder, f"{EXAMPLE[:begin]}\n[intrinsics]\n{intrinsics}\n{EXAMPLE[end:]}", "drone.toml")


def test_a_vehicle_names_its_calibration(tmp_path):
    """Beside its own file, wherever the daemon was started; and a log has what the file said."""
    written(tmp_path, OPENCV)
    config = read_config(vehicle(tmp_path, 'file = "camera.yaml"'))
    assert config.intrinsics.camera() == CAMERA and config.intrinsics.file == "camera.yaml"
    (tmp_path / "camera.yaml").unlink()
    assert config_from_text(config_text(config)) == config
    written(tmp_path, TWO)
    assert read_config(vehicle(tmp_path, 'file = "camera.yaml"\nfile_camera = "cam1"')).intrinsics.fx == 800.0
    written(tmp_path, changed(OPENCV, "image_width: 1280\nimage_height: 720\n", ""))
    beside = 'file = "camera.yaml"\nwidth_px = 1280\nheight_px = 720'
    assert read_config(vehicle(tmp_path, beside)).intrinsics.camera() == CAMERA
    written(tmp_path, toml_of(CAMERA), "camera.toml")
    assert read_config(vehicle(tmp_path, 'file = "camera.toml"')).intrinsics.camera() == CAMERA


@pytest.mark.parametrize(
    ("intrinsics", "why"),
    [
        ('file = "camera.yaml"\nfx = 910.0', r"`\$\.intrinsics\.file` and `\$\.intrinsics\.fx`.*leave one of them out"),
        ('file = "camera.yaml"\nwidth_px = 640', r"`\$\.intrinsics\.file`: .*calibrated with pictures of 1280 x 720"),
        ('file = "camera.yaml"\nwidth_px = "wide"', r"Expected `int \| null`.* at `\$\.intrinsics\.width_px`"),
        ('file = "other.yaml"', r"other\.yaml: can't be read .*; name a calibration of OpenCV, Kalibr, ROS or ours"),
        ('file = ""', r"Expected `str` of length >= 1 - at `\$\.intrinsics\.file`"),
        ('file_camera = "cam0"', r"`\$\.intrinsics\.file_camera` without `\$\.intrinsics\.file`"),
        ('file = "camera.yaml"\nfile_camera = "cam0"', r"camera 'cam0' is asked for, and the file is of one camera"),
    ],
)
def test_a_wrong_reference_is_refused(tmp_path, intrinsics, why):
    written(tmp_path, OPENCV)
    with pytest.raises(ConfigError, match=f"drone.toml: .*{why}"):
        read_config(vehicle(tmp_path, intrinsics))


def test_a_camera_asked_for_another_size_is_refused(tmp_path):
    written(tmp_path, OPENCV)
    path = vehicle(tmp_path, 'file = "camera.yaml"')
    path.write_text(changed(path.read_text(), "# width_px = 1280     # asked", "width_px = 640     # asked"))
    with pytest.raises(ConfigError, match=r"`\$\.camera\.width_px` asks for 640, but .*width_px` is 1280"):
        read_config(path)


def test_check_config_tells_what_the_file_says(tmp_path, capsys):
    written(tmp_path, OPENCV)
    assert main(["check-config", str(vehicle(tmp_path, 'file = "camera.yaml"'))]) == 0
    told = capsys.readouterr().out
    assert "intrinsics of camera.yaml: 1280 x 720 px, focal length 910.9 px (70 degrees wide)" in told


def test_a_calibration_can_be_moved(tmp_path, capsys):
    assert main(["convert-calibration", str(written(tmp_path, ROS))]) == 0
    assert read_camera(written(tmp_path, capsys.readouterr().out, "moved.toml")) == CAMERA
    out = tmp_path / "moved.yaml"
    assert main(["convert-calibration", str(tmp_path / "moved.toml"), "--to", "opencv", "--out", str(out)]) == 0
    assert read_camera(out) == CAMERA
    assert main(["convert-calibration", str(written(tmp_path, TWO))]) == 78
    assert 'file_camera = "cam0"' in capsys.readouterr().err
    assert main(["convert-calibration", str(written(tmp_path, equidistant((0.1, 0.2, 0.0, 0.0)))), "--fit"]) == 1
    assert "px is the most" in capsys.readouterr().err
