"""The search in a process of its own: what it finds, and what becomes of it when it is killed, or its owner is."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from replay import rendered

from ortholoc_edge.geometry import rotation
from ortholoc_edge.pipeline.finder import Answer, Ask
from ortholoc_edge.pipeline.localizer import LocalizerOptions
from ortholoc_edge.pipeline.outcome import Fix, Rejected
from ortholoc_edge.pipeline.search import Sighting
from ortholoc_edge.search_process import MapSeeker, SearchProcess, SearchSetup

TRUTH = rendered.pose(roll_deg=2.0, pitch_deg=-3.0)


def setup(**changes: object) -> SearchSetup:
    made = SearchSetup(
        rendered.store().pack.path, None, rendered.CAMERA, LocalizerOptions(), threads=1, max_mb=64, memory_bytes=2**28
    )
    return replace(made, **changes)  # type: ignore[arg-type]


def ask(stamp_ns: int = 7) -> Ask:
    grey = np.asarray(cv2.cvtColor(rendered.picture(TRUTH), cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    believed = rotation.exp([0.004, -0.007, math.radians(7.0)]) @ TRUTH.rotation
    height_m = float(TRUTH.translation[2]) + 2.0
    return Ask(stamp_ns, Sighting(grey, rendered.CAMERA, believed, math.radians(10.0), math.nan, height_m), None, ())


def wait_for(what: Callable[[], object], limit_s: float = 60.0) -> object:
    until = time.monotonic() + limit_s
    while time.monotonic() < until:
        if (got := what()) is not None:
            return got
        time.sleep(0.02)
    raise AssertionError(f"not within {limit_s} s")


def answer_of(process: SearchProcess) -> Answer:
    got = wait_for(process.take)
    assert isinstance(got, Answer)
    return got


def is_running(pid: int) -> bool:
    try:
        # A zombie has ended.
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_found_by_another_process_below_everything_else_which_may_be_killed() -> None:
    process = SearchProcess(setup())
    try:
        assert process.pid is None, "started when it is needed"
        assert process.idle
        process.ask(ask())
        assert not process.idle
        answer = answer_of(process)
        assert (answer.trouble, process.idle, process.take()) == ("", True, None)
        assert isinstance(answer.outcome, Fix)
        assert np.linalg.norm(answer.outcome.map_from_camera.translation - TRUTH.translation) < 1.0
        assert answer.own[0].score >= answer.own[-1].score
        assert answer.took_s > 0.0
        pid = process.pid
        assert pid is not None
        assert os.getpriority(os.PRIO_PROCESS, pid) == 19
        assert os.sched_getscheduler(pid) == os.SCHED_IDLE
        own = int(Path("/proc/self/oom_score_adj").read_text())
        assert int(Path(f"/proc/{pid}/oom_score_adj").read_text()) == min(own + 500, 1000)
        # The same process the second time; killed in the middle of it.
        process.ask(ask(8))
        assert process.pid == pid
        os.kill(pid, signal.SIGKILL)
        answer = answer_of(process)
        assert isinstance(answer.outcome, Rejected)
        assert "the search's process ended (exit code -9" in answer.trouble
        assert process.idle
        process.ask(ask(9))
        answer = answer_of(process)
        assert isinstance(answer.outcome, Fix)
        assert answer.outcome.stamp_ns == 9
    finally:
        process.close()


def test_a_map_that_can_not_be_read_is_trouble_and_not_the_end(tmp_path: Path) -> None:
    process = SearchProcess(setup(pack=tmp_path / "no-pack"))
    for _ in range(2):
        process.ask(ask())
        answer = answer_of(process)
        assert isinstance(answer.outcome, Rejected)
        assert "no-pack" in answer.trouble
    process.close()


def test_a_map_that_takes_too_much_memory_is_not_searched() -> None:
    seeker = MapSeeker(setup(max_mb=0))
    assert "and 0 are allowed; search a part, fly higher, or allow more" in seeker.answer(ask()).trouble
    seeker.close()


def test_closed_in_the_middle_it_ends_at_once() -> None:
    process = SearchProcess(setup())
    process.ask(ask())
    pid = wait_for(lambda: process.pid)
    assert isinstance(pid, int)
    process.close()
    process.close()
    assert not is_running(pid)
    assert not process.idle


def test_it_ends_with_its_owner() -> None:
    """Also where that is killed, so that it can't say so."""
    code = (
        "import time; from pathlib import Path\n"
        "from ortholoc_edge.geometry.camera import Camera\n"
        "from ortholoc_edge.pipeline.localizer import LocalizerOptions\n"
        "from ortholoc_edge.search_process import SearchProcess, SearchSetup\n"
        "camera = Camera.from_focal(64, 48, 50.0)\n"
        "process = SearchProcess(SearchSetup(Path('none'), None, camera, LocalizerOptions(), 1, 1, 1))\n"
        "process._started(); print(process.pid, flush=True); time.sleep(60)"
    )
    root = Path(__file__).parents[2]
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, cwd=root, text=True) as owner:
        assert owner.stdout is not None
        pid = int(owner.stdout.readline())
        assert is_running(pid)
        owner.kill()
    wait_for(lambda: None if is_running(pid) else True, 10.0)
