"""OrthoLoC samples: what the reader takes and how it says what it does not, and that what is written is read again."""

import zipfile
from pathlib import Path

import numpy as np
import pytest
from made_samples import by_confidence

from ortholoc_edge.bench import samples
from ortholoc_edge.bench.ground_truth import GroundTruthMatcher
from ortholoc_edge.bench.runner import sample_store
from ortholoc_edge.errors import DatasetError
from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.rigid import Rigid3

SHARED = Path(__file__).resolve().parents[2].parent / "shared"
REAL = SHARED / "data" / "real"


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
    sample = samples.read_sample(written(tmp_path, sample_values(rows_north=rows_north, scale=scale)))
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
    sample = samples.read_sample(written(tmp_path, values))
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
        dsm = samples.read_sample(written(tmp_path, values)).dsm
    assert {tuple(at) for at in np.argwhere(np.isnan(dsm))} == {*gone, (9, 9)}
    assert "S0: 3 of 191 heights" in caplog.text


def test_the_delivered_sample_with_spikes_makes_a_pack(caplog):
    path = REAL / "seneca" / "samples" / "SENECA_R0000.npz"
    if not path.is_file():
        pytest.skip(f"{path} is not there: the real samples lie outside the repository")
    sample = samples.read_sample(path)
    assert "SENECA_R0000: 275 of" in caplog.text
    with sample_store(sample) as store:
        assert store.ground_near(sample.map_from_camera.translation[:2]) is not None


def test_four_by_four_extrinsics_rounded_to_float32(tmp_path):
    values = sample_values()
    turn = rotation.from_euler(0.3, 2.9, 0.7)
    values["extrinsics"] = np.eye(4, dtype=np.float32)
    values["extrinsics"][:3, :3] = turn
    values["extrinsics"][:3, 3] = [1, 2, 3]
    sample = samples.read_sample(written(tmp_path, values))
    assert np.allclose(sample.map_from_camera.rotation, turn.T, atol=1e-6)
    assert isinstance(sample.map_from_camera, Rigid3)


def test_heights_alone_have_their_origin_at_zero(tmp_path):
    values = sample_values(scale="number")
    values["dsm"] = values["dsm"][..., 2]
    grid = samples.read_sample(written(tmp_path, values)).grid
    assert (grid.west, grid.top, grid.dy) == (0.0, 0.0, -0.5)


def full_values():
    """All keys of the format; the photo's rays end on the level z = 5."""
    values = sample_values()
    v, u = np.mgrid[:30, :40]
    depth = 75.0
    x, y = 104.0 + (u - 19.5) / 50 * depth, 197.0 - (v - 14.5) / 51 * depth
    points = np.stack([x, y, np.full_like(x, 5.0)], axis=-1).astype(np.float32)
    points[4, 7] = np.nan
    return values | {
        "sample_id": np.array("S0"),
        "point_map": points,
        "keypoints": points[10:12, 3].copy(),
        "vertices": np.array([[100, 200, 5], [108, 200, 5], [100, 194, 6], [108, 194, 7]], np.float32),
        "faces": np.array([[0, 2, 1], [1, 2, 3]], np.int32),
        "extrinsics_refined": np.column_stack([np.diag([1.0, -1.0, -1.0]), [-104.01, 197.0, 80.02]]),
    }


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
    "nan extrinsics": ({"extrinsics": np.full((3, 4), np.nan)}, "extrinsics"),
    "mirrored extrinsics": ({"extrinsics": np.column_stack([np.diag([1.0, 1, -1]), np.zeros(3)])}, "extrinsics"),
    "no focal length": ({"intrinsics": np.zeros((3, 3))}, "focal length"),
    "pickle": ({"scale": np.array([{"a": 1}], dtype=object)}, "S0.npz"),
    "words": ({"scale": np.array("half a metre")}, "S0.npz"),
    "point map of another size": ({"point_map": np.zeros((12, 16, 3), np.float32)}, "point_map"),
    "point map of integers": ({"point_map": np.zeros((30, 40, 3), np.int32)}, "point_map"),
    "flat keypoints": ({"keypoints": np.zeros((5, 2), np.float32)}, "keypoints"),
    "vertices of words": ({"vertices": np.array([["a", "b", "c"]])}, "vertices"),
    "faces of floats": ({"faces": np.zeros((2, 3), np.float32)}, "faces"),
    "faces beyond the vertices": ({"faces": np.array([[0, 1, 4]])}, "faces"),
    "faces before the vertices": ({"faces": np.array([[0, 1, -1]])}, "faces"),
    "mirrored refined pose": (
        {"extrinsics_refined": np.column_stack([np.diag([1.0, 1, -1]), np.zeros(3)])},
        "extrinsics_refined",
    ),
    "short refined pose": ({"extrinsics_refined": np.eye(3)}, "extrinsics_refined"),
}


@pytest.mark.parametrize(("change", "words"), BROKEN.values(), ids=BROKEN)
def test_malformed_samples_are_named(tmp_path, change, words):
    values = {k: v for k, v in (full_values() | change).items() if v is not None}
    with pytest.raises(DatasetError, match=words) as raised:
        samples.read_sample(written(tmp_path, values))
    assert "S0.npz" in str(raised.value)


@pytest.mark.parametrize("kept", [0, 3, 100, 0.5, 0.95])
def test_truncated_samples_are_named(tmp_path, kept):
    path = written(tmp_path, sample_values())
    data = path.read_bytes()
    path.write_bytes(data[: kept if isinstance(kept, int) else int(kept * len(data))])
    with pytest.raises(DatasetError, match=r"S0\.npz"):
        samples.read_sample(path)


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
            samples.read_sample(path)
    with (tmp_path / "S1.npz").open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(DatasetError, match=r"S1\.npz"):
        samples.read_sample(tmp_path / "S1.npz")
    with pytest.raises(DatasetError, match=r"S2\.npz"):
        samples.read_sample(tmp_path / "S2.npz")


@pytest.mark.parametrize("rows_north", [False, True])
def test_what_is_written_is_read_again_and_the_same(tmp_path, rows_north):
    values = full_values()
    if rows_north:
        for key in ("image_dop", "dsm"):
            values[key] = values[key][::-1]
        values["scale"] = np.array([0.5, 0.5])
    values["dsm"][3, 5, 2] = np.nan
    first = samples.read_sample(written(tmp_path, values))
    path = samples.write_sample(first, tmp_path / "out")
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["S0.npz"]
    again = samples.read_sample(path)
    # Bit for bit, whichever way the rows ran: what was read is already the north-up form that is written.
    for key in ("image", "dop", "dsm", "point_map", "keypoints", "vertices", "faces"):
        assert getattr(first, key).dtype == getattr(again, key).dtype
        assert np.array_equal(getattr(first, key), getattr(again, key), equal_nan=key in ("dsm", "point_map")), key
    assert again.camera == first.camera
    assert again.grid.bounds == pytest.approx(first.grid.bounds, abs=1e-5)
    assert (again.grid.width, again.grid.height, again.grid.dx, again.grid.dy) == (16, 12, 0.5, -0.5)
    for a, b in ((first.map_from_camera, again.map_from_camera), (refined(first), refined(again))):
        assert np.allclose(a.rotation, b.rotation, atol=1e-12)
        assert np.allclose(a.translation, b.translation, atol=1e-12)
    assert refined(again).translation[2] == pytest.approx(80.02)
    assert samples.write_sample(again, tmp_path / "twice").read_bytes() == path.read_bytes()


def refined(sample):
    assert sample.map_from_camera_refined is not None
    return sample.map_from_camera_refined


def test_written_keys_and_types_are_those_of_the_data_set(tmp_path):
    values = full_values()
    values["dsm"][0, 0, 2] = np.nan
    path = samples.write_sample(samples.read_sample(written(tmp_path, values)), tmp_path / "out")
    with np.load(path) as archive:
        found = {key: (archive[key].dtype.kind, archive[key].dtype.itemsize, archive[key].ndim) for key in archive}
        assert str(archive["sample_id"]) == "S0"
        assert archive["scale"].tolist() == [0.5, -0.5]
        # The data set's loader takes the origin of the raster from its first pixel, known or not.
        assert archive["dsm"][0, 0, :2] == pytest.approx((100.25, 199.75))
        assert np.isnan(archive["dsm"][0, 0, 2])
        assert np.allclose(archive["extrinsics"], values["extrinsics"])
        assert np.array_equal(archive["point_map"], values["point_map"], equal_nan=True)
    assert list(found) == [
        "sample_id", "image_query", "point_map", "image_dop", "dsm", "scale", "extrinsics", "intrinsics", "keypoints",
        "vertices", "faces", "extrinsics_refined",
    ]  # fmt: skip
    floats = {"point_map": 3, "dsm": 3, "keypoints": 2, "vertices": 2}
    assert {key: found[key] for key in floats} == {key: ("f", 4, ndim) for key, ndim in floats.items()}
    assert found["image_query"] == found["image_dop"] == ("u", 1, 3)
    assert found["faces"] == ("i", 4, 2)


def test_a_sample_without_its_truth_is_read_but_not_written(tmp_path):
    sample = samples.read_sample(written(tmp_path, sample_values()))
    assert sample.point_map is None
    assert sample.faces is None
    with pytest.raises(DatasetError, match=r"S0: key extrinsics_refined is missing"):
        samples.write_sample(sample, tmp_path / "out")
    with pytest.raises(DatasetError, match="point_map"):
        samples.needed(sample.point_map, sample, "point_map")


def test_a_sample_that_can_not_be_written_leaves_nothing(tmp_path):
    sample = samples.read_sample(written(tmp_path, full_values()))
    (tmp_path / "file").touch()
    with pytest.raises(DatasetError, match=r"file/S0\.npz: can't write it"):
        samples.write_sample(sample, tmp_path / "file")


@pytest.mark.parametrize(
    ("name", "location", "kind"),
    [
        ("L01_R0000", "L01", "R"),
        ("L08_xDOP0126", "L08", "xDOP"),
        ("L08_xDSM0126", "L08", "xDSM"),
        ("L34_xDOPDSM0128", "L34", "xDOPDSM"),
        ("urban_residential_xDOPDSM", "urban_residential", "xDOPDSM"),
        # Of the data set's demo: same domain, and R says so in no place that could be told from the name.
        ("highway_Rural", "highway_Rural", "R"),
        ("highway_rural", "highway_rural", "R"),
    ],
)
def test_a_name_tells_location_and_kind(name, location, kind):
    file = samples.SampleFile.of(Path("full") / "test_inPlace" / f"{name}.npz")
    assert (file.name, file.location, file.kind, file.split) == (name, location, kind, "test_inPlace")


def test_a_data_set_is_listed_by_kind_and_split_and_nothing_is_opened(tmp_path):
    for name in ("train/L01_R0000", "train/L01_xDOP0000", "test_outPlace/L08_R0000", "test_outPlace/L08_xDOPDSM0000"):
        path = tmp_path / "full" / f"{name}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"no archive")
    (tmp_path / "demo.npz").write_bytes(b"no archive")
    (tmp_path / "full" / "train" / ".sample-killed").mkdir()
    (tmp_path / "full" / "train" / ".sample-killed" / "L01_R0001.npz").touch()
    every = samples.find_samples(tmp_path)
    assert [(f.name, f.split) for f in every] == [
        ("demo", None),
        ("L08_R0000", "test_outPlace"),
        ("L08_xDOPDSM0000", "test_outPlace"),
        ("L01_R0000", "train"),
        ("L01_xDOP0000", "train"),
    ]
    same = samples.find_samples(tmp_path, {samples.SampleKind.SAME}, {samples.Split.TRAIN, samples.Split.VAL})
    assert [f.name for f in same] == ["L01_R0000"]
    assert samples.find_samples(tmp_path / "full" / "train")[0].split is samples.Split.TRAIN
    assert samples.find_samples(tmp_path / "demo.npz")[0].name == "demo"
    with pytest.raises(DatasetError, match=r"none of 5 samples .* R in no split, .*xDOP in train,"):
        samples.find_samples(tmp_path, splits={samples.Split.VAL})
    with pytest.raises(DatasetError, match=r"no \.npz file"):
        samples.find_samples(tmp_path / "nothing")


def test_samples_stream_one_at_a_time(tmp_path):
    written(tmp_path, full_values()).rename(tmp_path / "A.npz")
    (tmp_path / "B.npz").write_bytes(b"no archive")
    stream = samples.stream_samples(samples.find_samples(tmp_path))
    assert next(stream).name == "A"
    with pytest.raises(DatasetError, match=r"B\.npz"):
        next(stream)


def test_sample_paths(tmp_path):
    for name in ("b.npz", "a.npz", "c.txt"):
        (tmp_path / name).touch()
    assert [p.name for p in samples.sample_paths(tmp_path)] == ["a.npz", "b.npz"]
    assert samples.sample_paths(tmp_path / "a.npz") == [tmp_path / "a.npz"]
    assert samples.sample_paths(tmp_path / "c.txt") == []


@pytest.mark.parametrize("name", ["seneca", "copr"])
def test_real_samples_reproject_their_own_surface(name):
    paths = samples.sample_paths(REAL / name / "samples")
    if not paths:
        pytest.skip(f"{REAL / name}/samples is not there: the real samples lie outside the repository")
    sample = samples.read_sample(paths[0])
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


@pytest.mark.parametrize("name", ["ortholoc_demo/DEMO_R0000", "caliterra/samples/CALITERRA_R0001"])
def test_confident_true_matches_of_real_samples_give_the_true_pose(name):
    """The paper's appendix: above 0.95 the errors are 0.00 m and 0.00 degrees."""
    path = REAL / f"{name}.npz"
    if not path.is_file():
        pytest.skip(f"{path} is not there: the real samples lie outside the repository")
    found = by_confidence(samples.read_sample(path), GroundTruthMatcher(stride_px=6))
    for one in found[2:]:
        assert one.error.te_m < 0.005
        assert one.error.re_deg < 0.005
        assert one.error.rpe_px < 0.05


def test_real_samples_are_written_as_they_were_read(tmp_path):
    path = REAL / "copr" / "samples" / "COPR_R0000.npz"
    if not path.is_file():
        pytest.skip(f"{path} is not there: the real samples lie outside the repository")
    written_again = samples.write_sample(samples.read_sample(path), tmp_path)
    with np.load(path) as before, np.load(written_again) as after:
        assert set(before) == set(after)
        for key in ("sample_id", "image_query", "point_map", "image_dop", "keypoints", "vertices", "faces"):
            assert before[key].dtype == after[key].dtype
            assert np.array_equal(before[key], after[key], equal_nan=key == "point_map"), key
        for key in ("scale", "extrinsics", "intrinsics", "extrinsics_refined"):
            assert np.allclose(before[key], after[key], atol=1e-6), key
        # But for the blunders, which are holes.
        kept = np.isfinite(after["dsm"]).all(axis=2)
        assert np.isfinite(before["dsm"]).all(axis=2).sum() - kept.sum() == 156
        assert np.allclose(before["dsm"][kept], after["dsm"][kept], atol=1e-4)
