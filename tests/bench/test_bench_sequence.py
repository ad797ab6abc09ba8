"""The reader of flights: what it takes, and how it says what it does not."""

import csv
import io
from pathlib import Path

import numpy as np
import pytest

from ortholoc_edge.bench import sequence
from ortholoc_edge.errors import CameraError, DatasetError
from ortholoc_edge.geometry import frames, rotation
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
