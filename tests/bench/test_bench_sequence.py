"""Readers of flights and samples: what they take, and how they say what they do not."""

import csv
import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from ortholoc_edge.bench import sequence
from ortholoc_edge.bench.runner import sample_store
from ortholoc_edge.errors import CameraError, DatasetError
from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.tiles.georeference import Georeference, VerticalDatum

SHARED = Path(__file__).resolve().parents[2].parent / "shared"
REAL = SHARED / "data" / "real"

ROW = {
    "filename": "queries/a.jpg",
    "exif_time": "2020:06:01 12:00:00",
    "utm_e": "500000.5",
    "utm_n": "5300000.25",
    "alt": "350.0",
    # Straight down, image top to the north: a half turn about east.
    "qw": "0",
    "qx": "1",
    "qy": "0",
    "qz": "0",
    "yaw_true_deg": "0",
    "pitch_deg": "0",
    "roll_deg": "0",
    "width": "1024",
    "height": "768",
    "fx": "800",
    "fy": "801",
    "cx": "511.5",
    "cy": "383.5",
}


def flight(folder, rows, name="x_flight.csv"):
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(rows[0]), restval="")
    writer.writeheader()
    writer.writerows(rows)
    (folder / name).write_text(text.getvalue(), encoding="utf-8")
    return folder


def test_a_flight_is_read(tmp_path):
    rows = [
        ROW,
        ROW | {"filename": ""},
        ROW | {"filename": "queries/b.jpg"},
        ROW | {"filename": "queries/c.jpg", "exif_time": "2020:06:01 12:00:05", "yaw_true_deg": "90"},
    ]
    recorded = sequence.read_flight(flight(tmp_path, rows))
    assert [r.name for r in recorded] == ["a", "b", "c"]
    assert [r.stamp_ns for r in recorded] == [0, 100_000_000, 5_000_000_000]
    first = recorded[0]
    assert first.path == tmp_path / "queries/a.jpg"
    assert np.allclose(first.map_from_camera.translation, (500_000.5, 5_300_000.25, 350.0))
    assert np.allclose(first.map_from_camera.rotation, np.diag([1.0, -1.0, -1.0]))
    assert np.allclose(first.ned_from_body, np.eye(3))
    assert np.allclose(recorded[2].ned_from_body @ [1, 0, 0], [0, 1, 0])
    assert (first.camera.width, first.camera.height, first.camera.fy) == (1024, 768, 801.0)
    with pytest.raises(CameraError, match=r"a\.jpg"):
        first.image()


def without(key):
    return {k: v for k, v in ROW.items() if k != key}


@pytest.mark.parametrize(
    ("row", "column"),
    [(without(key), key) for key in ("utm_e", "alt", "qw", "yaw_true_deg", "fx", "width", "exif_time", "filename")]
    + [(ROW | {key: value}, key) for key in ("utm_n", "qz", "roll_deg", "cy") for value in ("", "nan", "inf", "12,5")]
    + [(ROW | {"exif_time": value}, "exif_time") for value in ("", "2020-06-01 12:00:00", "2020:13:01 00:00:00")]
    + [
        (ROW | {"qx": "0"}, "quaternion"),
        (ROW | {"width": "0"}, "camera"),
        (ROW | {"fx": "-5"}, "camera"),
    ],
)
def test_bad_rows_name_file_line_and_column(tmp_path, row, column):
    good = {k: ROW[k] for k in row}
    with pytest.raises(DatasetError) as raised:
        sequence.read_flight(flight(tmp_path, [good, row]))
    message = str(raised.value)
    assert "x_flight.csv" in message
    assert "line 3" in message or column not in ROW or column not in row
    assert "line" in message
    assert column in message


def test_a_row_cut_short_is_named(tmp_path):
    flight(tmp_path, [ROW])
    table = tmp_path / "x_flight.csv"
    table.write_text(table.read_text() + "queries/b.jpg\n")
    with pytest.raises(DatasetError, match=r"line 3: exif_time ''"):
        sequence.read_flight(tmp_path)
    table.write_text(table.read_text().replace("queries/b.jpg\n", "queries/b.jpg,2020:06:01 12:00:09,5\n"))
    with pytest.raises(DatasetError, match="line 3: column"):
        sequence.read_flight(tmp_path)


def test_line_numbers_are_those_of_the_file(tmp_path):
    flight(tmp_path, [ROW, ROW | {"alt": "high"}])
    table = tmp_path / "x_flight.csv"
    head, first, second = table.read_text().splitlines()
    table.write_text("\n".join([head, "", first, "", second]) + "\n")
    with pytest.raises(DatasetError, match="line 5: column alt"):
        sequence.read_flight(tmp_path)


def test_time_that_runs_backward_is_named(tmp_path):
    rows = [ROW, ROW | {"exif_time": "2020:06:01 11:59:59"}]
    with pytest.raises(DatasetError, match="line 3: exif_time"):
        sequence.read_flight(flight(tmp_path, rows))


def test_stamps_rise_through_a_long_burst_of_equal_times(tmp_path):
    rows = [ROW] * 15 + [ROW | {"exif_time": "2020:06:01 12:00:01"}]
    stamps = [r.stamp_ns for r in sequence.read_flight(flight(tmp_path, rows))]
    assert (np.diff(stamps) > 0).all()


def test_folders_without_one_table_are_refused(tmp_path):
    with pytest.raises(DatasetError, match="0 files named"):
        sequence.read_flight(tmp_path)
    flight(tmp_path, [ROW])
    flight(tmp_path, [ROW], "y_flight.csv")
    with pytest.raises(DatasetError, match="2 files named"):
        sequence.read_flight(tmp_path)


def test_a_table_without_photos_is_refused(tmp_path):
    with pytest.raises(DatasetError, match="no row names a photo"):
        sequence.read_flight(flight(tmp_path, [ROW | {"filename": ""}]))


@pytest.mark.parametrize("data", [b"\xff\xfe\x00garbage\n\x80", b"", b"\x00\x00\x00", b"filename,exif_time\n\xe4,1\n"])
def test_hostile_bytes_are_a_dataset_error(tmp_path, data):
    (tmp_path / "x_flight.csv").write_bytes(data)
    with pytest.raises(DatasetError, match=r"x_flight\.csv"):
        sequence.read_flight(tmp_path)


# -- real flights ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "epsg"), [("seneca", 32617), ("caliterra", 32614), ("copr", 32611)])
def test_attitude_columns_and_quaternion_of_real_flights_agree(name, epsg):
    if not (REAL / name).is_dir():
        pytest.skip(f"{REAL / name} is not there: the real flights lie outside the repository")
    recorded = sequence.read_flight(REAL / name)
    assert len(recorded) >= 10
    at = recorded[0].map_from_camera.translation[:2]
    georeference = Georeference(f"EPSG:{epsg}", VerticalDatum(kind="unknown"), (float(at[0]), float(at[1])))
    for one in recorded:
        convergence = georeference.convergence_rad(one.map_from_camera.translation[:2])
        from_angles = frames.map_from_ned_rotation(convergence) @ one.ned_from_body @ frames.BODY_FROM_NADIR_CAMERA
        assert np.degrees(rotation.angle_between(from_angles, one.map_from_camera.rotation)) < 0.05, one.name
        again = sequence.attitude_of(one.map_from_camera, convergence)
        assert np.degrees(rotation.angle_between(again, one.ned_from_body)) < 0.05, one.name
        # Looking down from above: seconds apart at most a few minutes.
        assert one.map_from_camera.rotation[2, 2] < -0.8


@pytest.mark.parametrize("name", ["seneca", "copr"])
def test_real_samples_reproject_their_own_surface(name):
    paths = sequence.sample_paths(REAL / name / "samples")
    if not paths:
        pytest.skip(f"{REAL / name}/samples is not there: the real samples lie outside the repository")
    sample = sequence.read_sample(paths[0])
    with np.load(paths[0]) as archive:
        point_map = archive["point_map"][::64, ::64].reshape(-1, 3).astype(float)
        v, u = np.mgrid[: sample.camera.height : 64, : sample.camera.width : 64]
    px = sample.camera.project(sample.map_from_camera.inverse().apply(point_map))
    known = np.isfinite(px).all(axis=1)
    assert known.sum() > 50
    errors = np.linalg.norm(px - np.column_stack([u.ravel(), v.ravel()]), axis=1)[known]
    # README: point_map reprojects within 0.4 px, for centres at integers.
    assert np.median(errors) < 0.3
    # The raster's grid agrees with the coordinates that the file states.
    assert sample.grid.dy < 0
    assert sample.dsm.shape == sample.dop.shape[:2] == (sample.grid.height, sample.grid.width)


# -- samples -----------------------------------------------------------------------------------------------


def sample_values(*, rows_north=False, scale="pair", size=(12, 16)):
    """Pixels of 0.5 m; the corner of the first pixel at (100, 200); heights tell row and column."""
    height, width = size
    dy = 0.5 if rows_north else -0.5
    v, u = np.mgrid[:height, :width]
    z = 10 + v + 0.01 * u
    dsm = np.stack([100 + 0.5 * (u + 0.5), 200 + dy * (v + 0.5), z], axis=-1).astype(np.float32)
    scales = {"pair": np.array([0.5, dy]), "number": np.float64(0.5), "one": np.array([0.5])}
    return {
        "image_query": np.zeros((30, 40, 3), np.uint8),
        "image_dop": np.repeat(np.arange(height, dtype=np.uint8)[:, None, None], width, 1).repeat(3, 2),
        "dsm": dsm,
        "scale": scales[scale],
        "extrinsics": np.column_stack([np.diag([1.0, -1.0, -1.0]), [-104.0, 197.0, 80.0]]),
        "intrinsics": np.array([[50.0, 0, 19.5], [0, 51.0, 14.5], [0, 0, 1]]),
    }


def written(folder, values):
    path = folder / "S0.npz"
    np.savez(path, **values)
    return path


@pytest.mark.parametrize("scale", ["pair", "number", "one"])
@pytest.mark.parametrize("rows_north", [False, True])
def test_scale_of_every_kind_gives_a_north_up_raster(tmp_path, scale, rows_north):
    sample = sequence.read_sample(written(tmp_path, sample_values(rows_north=rows_north, scale=scale)))
    grid = sample.grid
    assert (grid.dx, grid.dy) == (0.5, -0.5)
    assert grid.bounds == pytest.approx((100, 200, 108, 206) if rows_north else (100, 194, 108, 200), abs=1e-4)
    # Rows turn over together with the grid: the row next to the corner (100, 200) has value 0 and height 10.
    row = 11 if rows_north else 0
    assert sample.dop[row, 0, 0] == 0
    assert sample.dsm[row, 3] == pytest.approx(10.03)
    x, y = grid.map_from_px([3, row])
    assert (x, y) == pytest.approx((101.75, 200.25 if rows_north else 199.75), abs=1e-4)


def test_sample_pose_camera_and_holes(tmp_path):
    values = sample_values()
    values["dsm"][3, 4] = np.nan
    sample = sequence.read_sample(written(tmp_path, values))
    assert sample.name == "S0"
    # camera_from_map of a camera looking down from (104, 197, 80).
    assert np.allclose(sample.map_from_camera.translation, (104.0, 197.0, 80.0))
    assert np.allclose(sample.map_from_camera.rotation, np.diag([1.0, -1.0, -1.0]))
    assert (sample.camera.width, sample.camera.height) == (40, 30)
    assert (sample.camera.fx, sample.camera.fy, sample.camera.cx, sample.camera.cy) == (50.0, 51.0, 19.5, 14.5)
    assert np.isnan(sample.dsm[3, 4])
    assert np.isfinite(sample.dsm).sum() == 12 * 16 - 1


@pytest.mark.parametrize("kind", ["coordinates", "heights"])
def test_implausible_heights_are_holes_and_are_told(tmp_path, caplog, kind):
    """As in seneca's delivered sample: 275 of 729 272 heights lie 700 m below the ground."""
    values = sample_values()
    median = float(np.median(values["dsm"][..., 2]))
    kept = {(0, 0): -190.0, (0, 1): 990.0}
    gone = {(3, 4): -210.0, (5, 6): 1010.0, (7, 8): -719.0}
    values["dsm"][9, 9, 2] = np.nan
    for at, above in (kept | gone).items():
        values["dsm"][(*at, 2)] = median + above
    if kind == "heights":
        values["dsm"] = values["dsm"][..., 2]
    with caplog.at_level("WARNING"):
        dsm = sequence.read_sample(written(tmp_path, values)).dsm
    assert {tuple(at) for at in np.argwhere(np.isnan(dsm))} == {*gone, (9, 9)}
    assert "S0: 3 of 191 heights" in caplog.text


def test_the_delivered_sample_with_spikes_makes_a_pack(caplog):
    path = REAL / "seneca" / "samples" / "SENECA_R0000.npz"
    if not path.is_file():
        pytest.skip(f"{path} is not there: the real samples lie outside the repository")
    sample = sequence.read_sample(path)
    assert "SENECA_R0000: 275 of" in caplog.text
    with sample_store(sample) as store:
        assert store.ground_near(sample.map_from_camera.translation[:2]) is not None


def test_four_by_four_extrinsics_rounded_to_float32(tmp_path):
    values = sample_values()
    turn = rotation.from_euler(0.3, 2.9, 0.7)
    values["extrinsics"] = np.eye(4, dtype=np.float32)
    values["extrinsics"][:3, :3] = turn
    values["extrinsics"][:3, 3] = [1, 2, 3]
    sample = sequence.read_sample(written(tmp_path, values))
    assert np.allclose(sample.map_from_camera.rotation, turn.T, atol=1e-6)
    assert isinstance(sample.map_from_camera, Rigid3)


def test_heights_alone_have_their_origin_at_zero(tmp_path):
    values = sample_values(scale="number")
    values["dsm"] = values["dsm"][..., 2]
    grid = sequence.read_sample(written(tmp_path, values)).grid
    assert (grid.west, grid.top, grid.dy) == (0.0, 0.0, -0.5)


BROKEN = {
    "missing key": ({"dsm": None}, "dsm"),
    "grey photo": ({"image_query": np.zeros((30, 40), np.uint8)}, "image_query"),
    "float orthophoto": ({"image_dop": np.zeros((12, 16, 3), np.float32)}, "image_dop"),
    "other size": ({"image_dop": np.zeros((13, 16, 3), np.uint8)}, "differ in size"),
    "zero scale": ({"scale": np.array([0.5, 0.0])}, "scale"),
    "nan scale": ({"scale": np.float64(np.nan)}, "scale"),
    "three scales": ({"scale": np.ones(3)}, "scale"),
    "wrong sign": ({"scale": np.array([0.5, 0.5])}, "scale"),
    "wrong size of pixel": ({"scale": np.array([0.25, -0.25])}, "scale"),
    "no surface": ({"dsm": np.full((12, 16, 3), np.nan, np.float32)}, "dsm"),
    "flat list": ({"dsm": np.zeros(5, np.float32)}, "dsm"),
    "small extrinsics": ({"extrinsics": np.eye(3)}, "extrinsics"),
    "nan extrinsics": ({"extrinsics": np.full((3, 4), np.nan)}, "S0.npz"),
    "mirrored extrinsics": ({"extrinsics": np.column_stack([np.diag([1.0, 1, -1]), np.zeros(3)])}, "S0.npz"),
    "no focal length": ({"intrinsics": np.zeros((3, 3))}, "focal length"),
    "pickle": ({"scale": np.array([{"a": 1}], dtype=object)}, "S0.npz"),
    "words": ({"scale": np.array("half a metre")}, "S0.npz"),
}


@pytest.mark.parametrize(("change", "words"), BROKEN.values(), ids=BROKEN)
def test_malformed_samples_are_named(tmp_path, change, words):
    values = {k: v for k, v in (sample_values() | change).items() if v is not None}
    with pytest.raises(DatasetError, match=words) as raised:
        sequence.read_sample(written(tmp_path, values))
    assert "S0.npz" in str(raised.value)


@pytest.mark.parametrize("kept", [0, 3, 100, 0.5, 0.95])
def test_truncated_samples_are_named(tmp_path, kept):
    path = written(tmp_path, sample_values())
    data = path.read_bytes()
    path.write_bytes(data[: kept if isinstance(kept, int) else int(kept * len(data))])
    with pytest.raises(DatasetError, match=r"S0\.npz"):
        sequence.read_sample(path)


def test_damaged_and_foreign_files_are_named(tmp_path):
    path = tmp_path / "S0.npz"
    np.savez_compressed(path, **sample_values())
    data = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        start = archive.getinfo("dsm.npy").header_offset
    # Behind the member's header: every byte there is under its checksum.
    for at in range(start + 80, start + 400, 40):
        path.write_bytes(data[:at] + bytes(b ^ 0xFF for b in data[at : at + 4]) + data[at + 4 :])
        with pytest.raises(DatasetError, match=r"S0\.npz"):
            sequence.read_sample(path)
    with (tmp_path / "S1.npz").open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(DatasetError, match=r"S1\.npz"):
        sequence.read_sample(tmp_path / "S1.npz")
    with pytest.raises(DatasetError, match=r"S2\.npz"):
        sequence.read_sample(tmp_path / "S2.npz")


def test_sample_paths(tmp_path):
    for name in ("b.npz", "a.npz", "c.txt"):
        (tmp_path / name).touch()
    assert [p.name for p in sequence.sample_paths(tmp_path)] == ["a.npz", "b.npz"]
    assert sequence.sample_paths(tmp_path / "a.npz") == [tmp_path / "a.npz"]
    assert sequence.sample_paths(tmp_path / "c.txt") == []
