"""The log of outcomes: complete while it can be written, and never a reason to stop flying."""

from __future__ import annotations

import contextlib
import json
import resource
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from ortholoc_edge.adapters import recorder as module
from ortholoc_edge.adapters.recorder import FILE_NAME, Recorder
from ortholoc_edge.errors import OrtholocError
from ortholoc_edge.pipeline.outcome import Reason, Rejected


def outcome(stamp_ns: int, detail: str = "nothing there") -> Rejected:
    return Rejected(stamp_ns, Reason.MAP_NODATA, detail)


def stamps(*paths: Path) -> list[int]:
    return [json.loads(line)["stamp_ns"] for path in paths for line in path.read_text("utf-8").splitlines()]


def wait_for(condition: Callable[[], object], seconds: float = 10.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "did not happen in time"
        time.sleep(0.005)


def test_every_outcome_is_a_line(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "new" / "log", 1)
    for stamp_ns in range(50):
        recorder.put(f"photo_{stamp_ns}.jpg" if stamp_ns % 2 else None, outcome(stamp_ns))
    recorder.close()
    path = tmp_path / "new" / "log" / FILE_NAME
    assert stamps(path) == list(range(50))
    assert recorder.dropped == 0
    line = json.loads(path.read_text("utf-8").splitlines()[1])
    assert line["name"] == "photo_1.jpg"
    assert (line["fix"], line["reason"]) == (False, "map_nodata")


def test_a_restart_goes_on_in_the_same_file(tmp_path: Path) -> None:
    for start in (0, 10):
        recorder = Recorder(tmp_path, 1)
        recorder.put(None, outcome(start))
        recorder.close()
    assert stamps(tmp_path / FILE_NAME) == [0, 10]


def test_rotation_keeps_the_last_and_the_limit(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, 1)
    detail = "x" * 20_000
    for stamp_ns in range(120):
        recorder.put(None, outcome(stamp_ns, detail))
        if stamp_ns % 50 == 49:
            wait_for(recorder._queue.empty)
    recorder.close()
    files = [tmp_path / "outcomes.1.jsonl", tmp_path / FILE_NAME]
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in files}
    kept = stamps(*files)
    assert kept == list(range(kept[0], 120))
    assert sum(path.stat().st_size for path in files) < 2**20 + 2 * 21_000
    assert recorder.dropped == 0


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
    recorder = Recorder(tmp_path, 64)
    for stamp_ns in range(5):
        recorder.put(None, outcome(stamp_ns))
    path = tmp_path / FILE_NAME
    wait_for(lambda: path.stat().st_size > 0 and recorder._queue.empty())
    wait_for(lambda: path.read_bytes().count(b"\n") == 5)
    with full_disk(path.stat().st_size + 10):
        for stamp_ns in range(5, 15):
            recorder.put(None, outcome(stamp_ns))
        wait_for(lambda: recorder.dropped == 10)
    for stamp_ns in range(15, 20):
        recorder.put(None, outcome(stamp_ns))
    recorder.close()
    assert recorder.dropped == 10
    warnings = [record for record in caplog.records if "can't write the log" in record.message]
    assert len(warnings) == 1, "one warning for one full disk"
    lines = path.read_bytes().splitlines()
    whole = []
    for line in lines:
        try:
            whole.append(json.loads(line)["stamp_ns"])
        except ValueError:
            # The part of a line that still fitted.
            continue
    assert whole[:5] == list(range(5))
    assert set(range(15, 20)) <= set(whole), "what came after the disk had room again is there, each on its line"


def test_close_on_a_full_disk_does_not_raise(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, 64)
    with full_disk(10):
        recorder.put(None, outcome(1))
        wait_for(lambda: recorder.dropped == 1)
        recorder.close()


def test_slow_disk_drops_and_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_QUEUE_LENGTH", 4)
    # Nobody takes from the queue, as during a write that hangs.
    monkeypatch.setattr(Recorder, "_run", lambda self: None)
    recorder = Recorder(tmp_path, 1)
    started = time.monotonic()
    for stamp_ns in range(10):
        recorder.put(None, outcome(stamp_ns))
    assert time.monotonic() - started < 1.0
    assert recorder.dropped == 6
    recorder._queue.get()
    recorder.close()


def test_hung_disk_does_not_hang_the_shutdown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The queue is full and nobody takes from it: close must come back all the same."""
    monkeypatch.setattr(module, "_QUEUE_LENGTH", 2)
    monkeypatch.setattr(module, "_CLOSE_WAIT_S", 0.2)
    monkeypatch.setattr(Recorder, "_run", lambda self: None)
    recorder = Recorder(tmp_path, 1)
    for stamp_ns in range(3):
        recorder.put(None, outcome(stamp_ns))
    thread = threading.Thread(target=recorder.close, daemon=True)
    thread.start()
    thread.join(timeout=8.0)
    assert not thread.is_alive(), "close still waits"


def test_rotation_that_fails_is_survived(tmp_path: Path) -> None:
    (tmp_path / "outcomes.1.jsonl" / "in the way").mkdir(parents=True)
    recorder = Recorder(tmp_path, 1)
    for stamp_ns in range(30):
        recorder.put(None, outcome(stamp_ns, "x" * 50_000))
    wait_for(recorder._queue.empty)
    assert recorder._thread.is_alive()
    (tmp_path / "outcomes.1.jsonl" / "in the way").rmdir()
    (tmp_path / "outcomes.1.jsonl").rmdir()
    recorder.put(None, outcome(100))
    recorder.close()
    assert 100 in stamps(tmp_path / "outcomes.1.jsonl")


def test_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way", encoding="utf-8")
    with pytest.raises(OrtholocError, match=r"file.*log\.folder"):
        Recorder(tmp_path / "file" / "log", 1)
