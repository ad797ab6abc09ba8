"""Flight logs: complete while they can be written, readable wherever they end, flown again bit for bit, and never a
reason to stop flying."""

from __future__ import annotations

import contextlib
import json
import logging
import re
import resource
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import jsonschema
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from ortholoc_sim.lockstep import fly
from ortholoc_sim.scenario import find_scenario, read_scenario
from pipeline.scenes_pipeline import fix

from ortholoc_edge.adapters import flight_log as module
from ortholoc_edge.adapters.flight_log import FlightLog, LogOptions
from ortholoc_edge.bench.flight_log import log_files, read_frames, read_header
from ortholoc_edge.cli import main
from ortholoc_edge.errors import DatasetError
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.frame import CameraMount, Frame, VehicleState
from ortholoc_edge.pipeline.navigator import Circumstances
from ortholoc_edge.pipeline.outcome import Reason, Rejected
from ortholoc_edge.pipeline.prior import PosePrior
from ortholoc_edge.tiles.georeference import Georeference, VerticalDatum

S = 1_000_000_000
NEW_YEAR_NS = 1_798_761_600 * S  # 2027-01-01
GEOREFERENCE = Georeference(
    "EPSG:32632", VerticalDatum(kind="ellipsoid", ellipsoid_minus_map_m=0.0), (649_000.0, 5_318_000.0)
)
HEADER = {"config": "{}", "pack": "/packs/one", "pack_sha256": "ab", "matcher": "structural", "model_sha256": None}
IMAGE = np.random.default_rng(3).integers(0, 255, (24, 32), dtype=np.uint8)


def made(folder: Path, max_mb: int = 64, frames: Any = "all", started_ns: int = 0) -> FlightLog:
    options = LogOptions(folder=str(folder), max_mb=max_mb, frames=frames)
    return FlightLog(options, GEOREFERENCE, HEADER, started_ns, NEW_YEAR_NS)


def refused(stamp_ns: int, detail: str = "nothing there") -> Rejected:
    return Rejected(stamp_ns, Reason.MAP_NODATA, detail)


def a_state(stamp_ns: int) -> VehicleState:
    return VehicleState(
        stamp_ns, np.eye(3), (0.01, float("nan"), 0.05), np.array([1.0, np.inf, 1 / 3]), 7,
        np.array([649_100.0, 5_318_100.0, 500.0]), (2.0, 3.0), CameraMount(Rigid3.identity(), (0.1, 0.2)), "why",
    )  # fmt: skip


def was(prior: bool = True, number: int = 0) -> Circumstances:
    return Circumstances(number, PosePrior(Rigid3.identity(), np.eye(6) / 3) if prior else None, 1, 5, 255)


def put(log: FlightLog, stamp_ns: int, image: Any = IMAGE, detail: str = "nothing there") -> None:
    outcome = refused(stamp_ns, detail)
    log.put(Frame(stamp_ns, image, f"{stamp_ns}"), outcome, (outcome, a_state(stamp_ns), was()))


def messages(path: Path) -> list[tuple[str, str, Any, int]]:
    """Topic, schema's name, message and time; each message fits its schema."""
    with path.open("rb") as file:
        found = []
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert schema is not None
            content = json.loads(message.data)
            jsonschema.validate(content, json.loads(schema.data))
            found.append((channel.topic, schema.name, content, message.log_time))
        return found


def stamps(folder: Path) -> list[int]:
    return [step.record.stamp_ns for path in sorted(folder.glob("*.mcap")) for step in read_frames(path)]


def wait_for(condition: Callable[[], object], seconds: float = 10.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "did not happen in time"
        time.sleep(0.005)


def test_what_foxglove_finds(tmp_path: Path) -> None:
    log = made(tmp_path / "new" / "log")
    pose = fix((649_100.0, 5_318_100.0, 512.0), stamp_ns=5 * S)
    log.put(Frame(5 * S, IMAGE, "five"), pose, (pose, a_state(5 * S), was()))
    log.note(6 * S, {"fixes": 1, "gnss": None})
    log.put(None, refused(7 * S))
    log.close()
    (path,) = (tmp_path / "new" / "log").iterdir()
    assert path.name == "flight-00001-20270101T000000Z-000.mcap"
    found = {(topic, name): (content, time_ns) for topic, name, content, time_ns in messages(path)}
    image, time_ns = found["/camera", "foxglove.CompressedImage"]
    assert image["timestamp"] == {"sec": NEW_YEAR_NS // S + 5, "nsec": 0}
    assert time_ns == NEW_YEAR_NS + 5 * S
    location, _ = found["/fix", "foxglove.LocationFix"]
    back = GEOREFERENCE.map_from_geodetic(
        location["latitude"], location["longitude"], height_ellipsoid_m=location["altitude"]
    )
    assert np.allclose(back, (649_100.0, 5_318_100.0, 512.0), atol=1e-3)
    placed, _ = found["/pose", "foxglove.PoseInFrame"]
    assert placed["pose"]["position"] == pytest.approx({"x": 100.0, "y": 100.0, "z": 512.0})
    assert found["/ortholoc/health", "ortholoc.Health"][0]["statistics"] == {"fixes": 1, "gnss": None}
    outcomes = [content for topic, _, content, _ in messages(path) if topic == "/ortholoc/outcome"]
    assert [(one["stamp_ns"], one["fix"]) for one in outcomes] == [(5 * S, True), (7 * S, False)]
    assert log.dropped == 0


def test_covariance_of_the_location_is_east_north_up(tmp_path: Path) -> None:
    log = made(tmp_path)
    pose = replace(fix((649_100.0, 5_318_100.0, 512.0)), covariance=np.diag([1.0, 4.0, 9.0, 0.1, 0.1, 0.1]))
    log.put(None, pose)
    log.close()
    (path,) = tmp_path.iterdir()
    (location,) = (content for topic, _, content, _ in messages(path) if topic == "/fix")
    # Grid north is 1.5 degrees off the true one there.
    covariance = np.reshape(location["position_covariance"], (3, 3))
    assert np.allclose(np.diag(covariance), (1.0, 4.0, 9.0), atol=0.01)
    assert covariance[0, 1] == pytest.approx(3.0 * np.radians(1.49), rel=0.1)


def test_a_step_comes_back_as_it_was(tmp_path: Path) -> None:
    log = made(tmp_path)
    put(log, 9 * S)
    log.put(Frame(10 * S, IMAGE, "ten"), refused(10 * S), (refused(10 * S), a_state(10 * S), was(False, 4)))
    log.close()
    (path,) = tmp_path.iterdir()
    header = read_header(path)
    assert (header.pack, header.pack_sha256, header.part) == ("/packs/one", "ab", 0)
    assert header.session == "00001-20270101T000000Z"
    first, second = read_frames(path)
    assert np.array_equal(first.image, IMAGE)
    state, circumstances = first.record.state(), first.record.circumstances()
    want = a_state(9 * S)
    assert np.array_equal(state.ned_from_body, want.ned_from_body)
    assert np.array_equal(state.odometry_ned_m, [1.0, np.nan, 1 / 3], equal_nan=True), "not finite is not a number"
    assert np.isnan(state.attitude_sigma_rad[1])
    assert (state.odometry_epoch, state.position_sigma_m, state.no_attitude_because) == (7, (2.0, 3.0), "why")
    assert state.mount is not None
    assert state.mount.sigma_rad == (0.1, 0.2)
    assert circumstances.prior is not None
    assert np.array_equal(circumstances.prior.covariance, np.eye(6) / 3), "in every bit"
    assert (circumstances.rung, circumstances.proceeded, circumstances.reset_counter) == (1, 5, 255)
    assert second.record.circumstances().prior is None
    assert [first.record.number, second.record.number] == [0, 4]


@pytest.mark.parametrize(
    ("frames", "side_px", "whole"), [("thumbnails", 320, False), ("none", None, False), ("all", 640, True)]
)
def test_pictures_as_asked(tmp_path: Path, frames: str, side_px: int | None, whole: bool) -> None:
    log = made(tmp_path, frames=frames)
    colour = np.zeros((480, 640, 3), np.uint8)
    colour[:, :, 0] = 250
    put(log, S, colour)
    log.close()
    (path,) = tmp_path.iterdir()
    pictures = [content for topic, _, content, _ in messages(path) if topic == "/camera"]
    assert len(pictures) == (side_px is not None)
    (step,) = read_frames(path)
    assert step.record.whole == whole
    if whole:
        assert np.array_equal(step.image, cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY))
    else:
        assert step.image is None
    if frames == "thumbnails":
        data = np.frombuffer(module.base64.b64decode(pictures[0]["data"]), np.uint8)
        small = cv2.imdecode(data, cv2.IMREAD_COLOR)
        assert small.shape == (240, 320, 3)
        assert small[0, 0].argmax() == 2, "red, as OpenCV has it last"


@pytest.mark.parametrize(
    "image", [np.zeros((0, 0), np.uint8), np.zeros((4, 4), np.float32), np.zeros((2, 2, 2, 2), np.uint8)]
)
def test_what_is_no_picture_is_logged_without(tmp_path: Path, image: Any) -> None:
    log = made(tmp_path)
    put(log, S, image)
    log.close()
    assert stamps(tmp_path) == [S]
    assert log.dropped == 0


def test_each_life_has_a_file_of_its_own(tmp_path: Path) -> None:
    for start in (0, 10):
        log = made(tmp_path)
        put(log, start)
        log.close()
    assert [path.name for path in sorted(tmp_path.iterdir())] == [
        "flight-00001-20270101T000000Z-000.mcap",
        "flight-00002-20270101T000000Z-000.mcap",
    ]
    assert [step.record.stamp_ns for path in log_files(tmp_path) for step in read_frames(path)] == [10]


def test_what_a_power_cut_left_of_a_beginning_does_not_hide_the_flight(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    log = made(tmp_path)
    put(log, S)
    log.close()
    (tmp_path / "flight-00002-19700101T000000Z-000.mcap").write_bytes(b"")
    assert [read_header(path).session for path in log_files(tmp_path)] == ["00001-20270101T000000Z"]
    assert any("00002" in record.message and "left out" in record.message for record in caplog.records)


def test_with_a_clock_that_was_never_set_the_parts_of_this_life_go_last(tmp_path: Path) -> None:
    before = made(tmp_path, max_mb=1)
    noise = np.random.default_rng(1).integers(0, 255, (180, 240), dtype=np.uint8)
    for number in range(12):
        put(before, number * S, noise)
        wait_for(before._queue.empty)
    before.close()
    options = LogOptions(folder=str(tmp_path), max_mb=1, frames="all")
    now = FlightLog(options, GEOREFERENCE, HEADER, 0, 0)
    for number in range(14):
        put(now, number * S, noise)
        wait_for(now._queue.empty)
    now.close()
    assert [step.record.stamp_ns // S for path in log_files(tmp_path) for step in read_frames(path)] == list(range(14))


def test_the_oldest_go_and_the_limit_is_kept(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("not ours", encoding="utf-8")
    log = made(tmp_path, max_mb=1)
    noise = np.random.default_rng(1).integers(0, 255, (180, 240), dtype=np.uint8)
    for number in range(60):
        put(log, number * S, noise)
        wait_for(log._queue.empty)
    log.close()
    files = sorted(tmp_path.glob("*.mcap"))
    assert 4 <= len(files) <= 9
    assert sum(path.stat().st_size for path in files) < 2**20 + 2**17
    kept = stamps(tmp_path)
    assert kept == [number * S for number in range(kept[0] // S, 60)]
    assert kept[0] > 0
    assert log.dropped == 0
    assert (tmp_path / "notes.txt").exists()
    headers = [read_header(path) for path in log_files(tmp_path)]
    assert [header.part for header in headers] == list(range(headers[0].part, headers[0].part + len(files)))


@pytest.fixture(scope="module")
def whole_log(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    folder = tmp_path_factory.mktemp("whole")
    log = made(folder)
    for number in range(6):
        put(log, number * S)
        log.note(number * S, {"fixes": number, "text": "x" * 1200})
    log.close()
    (path,) = folder.iterdir()
    return path.read_bytes()


def read_damaged(data: bytes, folder: Path) -> list[int] | None:
    path = folder / "flight-damaged-000.mcap"
    path.write_bytes(data)
    logging.disable()
    try:
        return [step.record.stamp_ns for step in read_frames(path)]
    except DatasetError as error:
        assert path.name in str(error)
        return None
    finally:
        logging.disable(logging.NOTSET)


def test_a_log_that_was_cut_off_is_read_up_to_there(whole_log: bytes, tmp_path: Path) -> None:
    everything = [number * S for number in range(6)]
    lengths = []
    for end in range(0, len(whole_log), 97):
        found = read_damaged(whole_log[:end], tmp_path)
        assert found is None or found == everything[: len(found)]
        lengths.append(len(found or []))
    assert lengths == sorted(lengths)
    assert lengths[-1] == 6
    assert set(lengths) >= set(range(7)), "each second's frame can be had when it was written"


@settings(max_examples=150, deadline=None)
@given(bits=st.lists(st.integers(0, 2**24), min_size=1, max_size=4))
def test_a_damaged_log_is_never_misread(
    whole_log: bytes, tmp_path_factory: pytest.TempPathFactory, bits: list[int]
) -> None:
    spoilt = bytearray(whole_log)
    for bit in bits:
        spoilt[bit // 8 % len(spoilt)] ^= 1 << bit % 8
    found = read_damaged(bytes(spoilt), tmp_path_factory.getbasetemp())
    # Checksums guard chunks; what lies between them can at most end the reading.
    everything = [number * S for number in range(6)]
    assert found is None or found == everything[: len(found)] or set(found) < set(everything)


@contextlib.contextmanager
def full_disk(limit_bytes: int) -> Iterator[None]:
    """Files can't grow beyond a limit: EFBIG, as ENOSPC of a full disk, from the same call.

    Not a fixture: the limit holds for the whole process, and a test runner whose output goes to a file reports
    before fixtures end.
    """
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def test_full_disk_drops_and_counts_and_recovers(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    log = made(tmp_path)
    for number in range(5):
        put(log, number * S)
    path = tmp_path / "flight-00001-20270101T000000Z-000.mcap"
    wait_for(lambda: log._queue.empty() and len(stamps(tmp_path)) == 5)
    with full_disk(100):
        for number in range(5, 15):
            put(log, number * S)
        wait_for(lambda: log.dropped == 10)
        assert list(tmp_path.iterdir()) == [path], "tries leave no files"
    for number in range(15, 20):
        put(log, number * S)
    log.close()
    assert log.dropped == 10
    warnings = [record for record in caplog.records if "can't write the log" in record.message]
    assert len(warnings) == 1, "one warning for one full disk"
    assert stamps(tmp_path) == [number * S for number in (*range(5), *range(15, 20))]
    assert [read_header(one).part for one in sorted(tmp_path.iterdir())] == [0, 1]


def test_close_on_a_full_disk_does_not_raise(tmp_path: Path) -> None:
    log = made(tmp_path)
    with full_disk(10):
        put(log, S)
        wait_for(lambda: log.dropped == 1)
        log.close()


def test_slow_disk_drops_and_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_QUEUE_LENGTH", 4)
    # Nobody takes from the queue, as during a write that hangs.
    monkeypatch.setattr(FlightLog, "_run", lambda self: None)
    log = made(tmp_path)
    for number in range(10):
        put(log, number * S)
    assert log.dropped == 6
    log._queue.get()
    log.close()
    assert log._file is not None
    log._file.abandon()


def test_hung_disk_does_not_hang_the_shutdown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The queue is full and nobody takes from it: close must come back all the same."""
    monkeypatch.setattr(module, "_QUEUE_LENGTH", 2)
    monkeypatch.setattr(module, "_CLOSE_WAIT_S", 0.2)
    monkeypatch.setattr(FlightLog, "_run", lambda self: None)
    log = made(tmp_path)
    for number in range(3):
        put(log, number * S)
    thread = threading.Thread(target=log.close, daemon=True)
    thread.start()
    thread.join(timeout=8.0)
    assert not thread.is_alive(), "close still waits"
    assert log._file is not None
    log._file.abandon()


def test_a_defect_of_logging_ends_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    log = made(tmp_path)
    log.put(Frame(S, IMAGE, "one"), refused(S, detail=object()), None)  # type: ignore[arg-type]
    put(log, 2 * S)
    log.close()
    assert log.dropped == 1
    assert stamps(tmp_path) == [2 * S]
    assert any(record.message == "flight log" for record in caplog.records)


def test_a_folder_that_cannot_be_written_is_named_and_tried_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A restart in flight, on a card that went read-only, must still give the vehicle its position."""
    obstacle = tmp_path / "file"
    obstacle.write_text("in the way", encoding="utf-8")
    log = made(obstacle / "log")
    assert re.search(r"file.*log\.folder", caplog.text)
    for tenths in range(10, 60, 5):
        put(log, tenths * S // 10)
        wait_for(lambda dropped=log.dropped: log.dropped > dropped or log._queue.empty())
    wait_for(lambda: log.dropped == 10)
    assert caplog.text.count("can't write") == 1, "it is said once, not with each try"
    obstacle.unlink()
    put(log, 9 * S)
    log.close()
    assert stamps(obstacle / "log") == [9 * S]


def test_what_is_no_log_is_named(tmp_path: Path) -> None:
    for name, content in {"empty": b"", "text": b"hello", "magic": b"\x89MCAP0\r\n" + bytes(40)}.items():
        path = tmp_path / f"{name}.mcap"
        path.write_bytes(content)
        with pytest.raises(DatasetError, match=f"{name}.mcap.*not a flight log"):
            read_header(path)
    assert log_files(tmp_path) == []


# -- flown again ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def flown_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flown")
    scenario = read_scenario(find_scenario("water_only"), short=True)
    fly(scenario, 1, folder / "packs", log=folder / "log")
    return folder / "log"


def replayed(source: Path, capsys: pytest.CaptureFixture[str], *more: str) -> tuple[int, dict[str, Any]]:
    capsys.readouterr()
    code = main(["replay", str(source), "--json", *more])
    return code, json.loads(capsys.readouterr().out)


def test_a_flight_comes_out_the_same_in_every_bit(
    flown_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    code, found = replayed(flown_log, capsys, "--out", str(out))
    assert code == 0
    assert found["steps"] == found["repeated"] == found["same"] >= 5
    page = (out / "report.html").read_text(encoding="utf-8")
    shown = json.loads(page.split('<script type="application/json" id="data">')[1].split("</script>")[0])["frames"]
    assert len(shown) == found["steps"]
    assert sum("fix" in frame["mark"] for frame in shown) == found["fixes"]
    assert any(frame["picture"] for frame in shown) and any("believed" in frame["mark"] for frame in shown)
    assert found["other_libraries"] == {}
    assert 1 <= found["fixes"] < found["steps"], "fixes and refusals"
    assert (found["alone"], found["left_out"], found["furthest_m"]) == (0, 0, 0.0)


def test_from_a_log_whose_beginning_is_gone(
    flown_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (path,) = flown_log.iterdir()
    header = read_header(path)
    options = LogOptions(folder=str(tmp_path), max_mb=64, frames="all")
    fields = {name: getattr(header, name) for name in HEADER}
    log = FlightLog(options, GEOREFERENCE, fields, 0, 0)
    steps = list(read_frames(path))
    for step in steps[2:]:
        outcome = refused(step.record.stamp_ns)
        frame = Frame(step.record.stamp_ns, step.image, step.record.name)
        log.put(frame, outcome, (outcome, step.record.state(), step.record.circumstances()))
    log.close()
    code, found = replayed(tmp_path, capsys)
    assert (found["repeated"], found["alone"]) == (len(steps) - 2, len(steps) - 2)
    fixes = sum(bool(step.record.outcome["fix"]) for step in steps[2:])
    assert found["other_verdict"] == fixes > 0, "we wrote refusals; it found the fixes of the flight"
    assert code == 1


@pytest.mark.parametrize(
    ("options", "words"),
    [(["--seed", "3"], "--seed does not go with a flight log"), (["--matcher", "sift"], "--matcher does not go")],
)
def test_options_of_other_sequences_are_refused(
    flown_log: Path, options: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(flown_log), *options]) == 78
    assert words in capsys.readouterr().err


def test_another_pack_is_refused(flown_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (path,) = flown_log.iterdir()
    pack = tmp_path / "pack"
    shutil.copytree(read_header(path).pack, pack)
    assert replayed(flown_log, capsys, "--pack", str(pack))[0] == 0, "a copy is the same pack"
    manifest = pack / "manifest.json"
    manifest.write_text(manifest.read_text("utf-8") + "\n", encoding="utf-8")
    assert main(["replay", str(flown_log), "--pack", str(pack)]) == 1
    assert "not the pack that was flown with" in capsys.readouterr().err


def test_a_log_is_profiled_against_its_full_detail(flown_log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--scales", "1,0.5", "--matcher", "sift", "--passes", "1", "--warm-up", "1", "--json"]
    assert main(["profile", "--frames", str(flown_log), *words]) == 0
    found = json.loads(capsys.readouterr().out)
    full, half = found["rows"]
    assert full["frames"] == half["frames"] >= 5
    assert (full["accuracy"], full["agreement"], half["accuracy"]) == (None, None, None)
    assert 0 <= half["agreement"]["same_verdict"] <= 1
    assert (full["setting"]["working_px"], half["setting"]["working_px"]) == (640, 320)
    assert "map_features" in half["stages_ms"]


def test_thumbnails_are_no_replay(tmp_path: Path, flown_log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (path,) = flown_log.iterdir()
    header = read_header(path)
    log = FlightLog(
        LogOptions(folder=str(tmp_path)), GEOREFERENCE, {name: getattr(header, name) for name in HEADER}, 0, 0
    )
    put(log, S)
    log.close()
    assert main(["replay", str(tmp_path)]) == 1
    assert 'frames = "all"' in capsys.readouterr().err
