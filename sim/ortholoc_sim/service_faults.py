"""Faults while the installed daemon flies, each with what must come of it; `run` does them and tells what happened.

All of one flight: between two faults the vehicle is on its route again, with fixes. A wrong fix fails whatever it was.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import multiprocessing
import os
import shutil
import signal
import socket
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from ortholoc_edge.errors import OrtholocError
from ortholoc_edge.matching import models
from ortholoc_sim.rig import VEHICLE, Rig, RigOptions, zenoh_session

_S = 1_000_000_000
# A fix farther off would mislead; those of the rig are within a metre or two.
WRONG_M = 10.0
_OUTAGE_S = 8.0
_BACK_S, _RESTART_S = 5.0, 10.0
_DISK_BYTES = 6 << 20
_CLIENTS = 8
# Of the fixes per second before a fault that must not touch them.
_LEAST_RATE = 0.6
# Less than the small disk has, so that it is another's fault when that is full.
_SETTINGS = {"log": {"max_mb": 3}}


class NotPossibleError(Exception):
    """The fault can't be made on this computer; the text says why."""


@dataclass(frozen=True, slots=True)
class Row:
    """One fault: what was done, what happened, and whether that is as it must be; None where it could not be tried."""

    fault: str
    done: str
    happened: str
    passed: bool | None


@dataclass(frozen=True, slots=True)
class _Fault:
    name: str
    done: str
    make: Callable[[Rig, float], tuple[str, bool]]


def run(folder: Path, names: Sequence[str] = (), on_row: Callable[[Row], None] = lambda _: None) -> list[Row]:
    """Make the faults of these names, or all, in the order of `FAULTS`.

    Raises: OrtholocError if the rig can't be set up, or never comes back.
    """
    rows = []
    faults = [fault for fault in FAULTS if not names or fault.name in names]
    # Both are felt by whoever does not need them: a disk to unmount, a library under every look at the clock.
    environment = _changeable_clock(folder) if any(fault.make is _clock_stepped for fault in faults) else {}
    with contextlib.ExitStack() as resources:
        rig = Rig(folder, RigOptions(settings=_SETTINGS, environment=environment))
        rig.log_folder.mkdir(parents=True, exist_ok=True)
        if any(fault.make in (_disk_full, _log_read_only) for fault in faults):
            with contextlib.suppress(NotPossibleError):
                resources.enter_context(_small_disk(rig.log_folder))
        resources.enter_context(rig)
        for fault in faults:
            rig.wait_for(lambda: rig.supervisor.is_ready, "READY=1")
            expected_hz = 10.0 / rig.wait_for_fixes(10)
            seen = len(rig.fixes)
            try:
                happened, passed = fault.make(rig, expected_hz)
                rig.wait_for_fixes(3)
                # One whose time is nowhere near the flight's is wrong, too.
                wrong = sum(f.error_m is None or f.error_m > WRONG_M for f in rig.fixes[seen:])
                row = Row(fault.name, fault.done, f"{happened}; wrong fixes {wrong}", passed and not wrong)
            except NotPossibleError as error:
                row = Row(fault.name, fault.done, f"not tried: {error}", None)
            rows.append(row)
            on_row(row)
    return rows


@dataclass(frozen=True, slots=True)
class _Flown:
    """Fixes, and estimates that the autopilot took in, while a fault lasted that must touch neither."""

    fixes: int
    expected: float
    fused: int

    @property
    def as_before(self) -> bool:
        """Drawing sets the rate of frames, and a busy computer draws slowly: held against the time before."""
        return self.fixes >= _LEAST_RATE * self.expected and self.fused > 0

    def __str__(self) -> str:
        return f"{self.fixes} fixes ({self.expected:.0f} expected), {self.fused} estimates fused"


def _fly(rig: Rig, expected_hz: float) -> _Flown:
    fixes, fused = len(rig.fixes), rig.fused()
    time.sleep(_OUTAGE_S)
    return _Flown(len(rig.fixes) - fixes, expected_hz * _OUTAGE_S, rig.fused() - fused)


# -- the faults: each begins and ends with a flight that has fixes ------------------------------------------


def _camera_unplugged(rig: Rig, _: float) -> tuple[str, bool]:
    starts = rig.supervisor.count("started")
    rig.is_camera_plugged = False
    # What was under way.
    time.sleep(1.0)
    lost = len(rig.fixes)
    time.sleep(_OUTAGE_S - 1.0)
    status, came = rig.ask("state")["status"], len(rig.fixes) - lost
    rig.is_camera_plugged = True
    back_s = rig.wait_for_fixes(1)
    restarts = rig.supervisor.count("started") - starts
    return (
        f"no fixes ({came}), published as {status!r}, no restart ({restarts}); first fix {back_s:.1f} s after "
        "it was back",
        came == 0 and status != "track" and not restarts and back_s < _BACK_S,
    )


def _camera_program_killed(rig: Rig, _: float) -> tuple[str, bool]:
    starts = rig.supervisor.count("started")
    rig.camera_program.kill()
    time.sleep(3.0)
    rig.camera_program.start()
    # zenoh tries again after 1, 2, 4 s, and a program takes its time to start.
    back_s, restarts = rig.wait_for_fixes(1), rig.supervisor.count("started") - starts
    return f"first fix {back_s:.1f} s after it was started again, no restart ({restarts})", (
        not restarts and back_s < 2.0 * _BACK_S
    )


def _disk_full(rig: Rig, expected_hz: float) -> tuple[str, bool]:
    if not rig.log_folder.is_mount():
        raise NotPossibleError("a small disk can't be mounted here; run as root")
    # The cap would make room; this is another program's fault.
    ballast = rig.log_folder / "ballast"
    dropped = rig.ask("stats")["statistics"]["log_dropped"]
    with contextlib.suppress(OSError), ballast.open("wb") as file:
        while True:
            file.write(bytes(4096))
            file.flush()
    flown = _fly(rig, expected_hz)
    lost = rig.ask("stats")["statistics"]["log_dropped"] - dropped
    ballast.unlink()
    before = _log_bytes(rig)
    written_s = rig.wait_for(lambda: _log_bytes(rig) > before, "a log that goes on")
    return (
        f"{flown}; {lost} frames not logged, counted; the log went on {written_s:.1f} s after there was room",
        flown.as_before and lost > 0 and written_s < _BACK_S,
    )


def _log_read_only(rig: Rig, _: float) -> tuple[str, bool]:
    if not rig.log_folder.is_mount():
        raise NotPossibleError("a small disk can't be mounted here; run as root")
    rig.stop_daemon()
    _mount("-o", "remount,ro", str(rig.log_folder))
    begun, said = len(rig.fixes), len(rig.supervisor.said())
    try:
        rig.start_daemon()
        ready_s = rig.wait_for(lambda: rig.supervisor.is_ready, "READY=1")
        fix_s = ready_s + rig.wait_for_fixes(1)
        time.sleep(3.0)
        fixes = len(rig.fixes) - begun
        now_said = rig.supervisor.said()[said:]
        named = f"{rig.log_folder}: can't write the log" in now_said
    finally:
        _mount("-o", "remount,rw", str(rig.log_folder))
    before = _log_bytes(rig)
    written_s = rig.wait_for(lambda: _log_bytes(rig) > before, "a log that goes on")
    return (
        f"started all the same, first fix {fix_s:.1f} s after, {fixes} fixes without a log"
        f"{', named in the journal' if named else ''}; the log began {written_s:.1f} s after it could be written",
        named and fixes > 0 and fix_s < _RESTART_S and written_s < _BACK_S,
    )


def _router_gone(rig: Rig, expected_hz: float) -> tuple[str, bool]:
    context = multiprocessing.get_context("spawn")
    router = context.Process(target=_route, args=(rig.router_endpoint,), daemon=True)
    router.start()
    try:
        at_router_s = _fix_at(rig, rig.router_endpoint)
    finally:
        router.kill()
        router.join()
    flown = _fly(rig, expected_hz)
    again = context.Process(target=_route, args=(rig.router_endpoint,), daemon=True)
    again.start()
    try:
        back_s = _fix_at(rig, rig.router_endpoint)
    finally:
        again.kill()
        again.join()
    return (
        f"a station behind the router had fixes {at_router_s:.1f} s after it came; without it {flown}; the station had "
        f"fixes again {back_s:.1f} s after it was back",
        flown.as_before and back_s < 2.0 * _RESTART_S,
    )


def _web_client_stalled(rig: Rig, expected_hz: float) -> tuple[str, bool]:
    with contextlib.ExitStack() as stalled:
        for _ in range(_CLIENTS):
            client = stalled.enter_context(socket.create_connection(("127.0.0.1", rig.page_port), timeout=5.0))
            # Nothing is ever read: what the daemon sends fills both buffers.
            client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
            client.sendall(b"GET /events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        half = stalled.enter_context(socket.create_connection(("127.0.0.1", rig.page_port), timeout=5.0))
        half.sendall(b"GET /state.json HTTP/1.1\r\nHost:")
        flown = _fly(rig, expected_hz)
        begun_s = time.monotonic()
        served = True
        try:
            address = f"http://127.0.0.1:{rig.page_port}/state.json"
            with urllib.request.urlopen(address, timeout=5.0) as answer:
                served = answer.status == 200
        except OSError:
            served = False
        took_ms = (time.monotonic() - begun_s) * 1000.0
    return (
        f"{flown}; another client was {f'served in {took_ms:.0f} ms' if served else 'not served'}",
        flown.as_before and served,
    )


def _clock_stepped(rig: Rig, expected_hz: float) -> tuple[str, bool]:
    file = rig.folder / _CLOCK_FILE
    if not file.exists():
        raise NotPossibleError("libfaketime is not installed (pip install libfaketime)")
    starts = rig.supervisor.count("started")

    def ahead_s() -> float:
        state = rig.ask("state")
        # Both clocks of the daemon at one moment, against ours.
        return float(state["unix_ns"] - state["stamp_ns"] - (time.time_ns() - time.monotonic_ns())) / _S

    told, ok = [], True
    for offset in (3600, -3600, 0):
        file.write_text(f"{offset:+d}", encoding="ascii")
        flown = _fly(rig, expected_hz)
        step_s = ahead_s()
        ok = ok and flown.as_before and abs(step_s - offset) < 5.0
        told.append(f"{step_s:+.0f} s: {flown}")
    restarts = rig.supervisor.count("started") - starts
    return f"its date off by {'; '.join(told)}; no restart ({restarts})", ok and not restarts


def _stopped(rig: Rig, _: float) -> tuple[str, bool]:
    starts = rig.supervisor.count("started")
    rig.supervisor.send(signal.SIGSTOP)
    pid = rig.supervisor.pid
    time.sleep(10.0)
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGCONT)
    back_s, restarts = rig.wait_for_fixes(1), rig.supervisor.count("started") - starts
    how = "the watchdog ended it and it was started again" if restarts else "it went on"
    return f"{how}; first fix {back_s:.1f} s after SIGCONT", back_s < _RESTART_S


def _killed(rig: Rig, _: float) -> tuple[str, bool]:
    rig.supervisor.send(signal.SIGKILL)
    begun_s = time.monotonic()
    rig.wait_for(lambda: not rig.supervisor.is_ready, "the end of the daemon")
    rig.wait_for(lambda: rig.supervisor.is_ready, "READY=1")
    ready_s = time.monotonic() - begun_s
    rig.wait_for_fixes(1)
    back_s = time.monotonic() - begun_s
    return f"ready again after {ready_s:.1f} s, first fix after {back_s:.1f} s", back_s < _RESTART_S


def _model_replaced(rig: Rig, expected_hz: float) -> tuple[str, bool]:
    try:
        stored = models.ensure("xfeat")
    except OrtholocError as error:
        raise NotPossibleError(f"XFeat's model can't be had ({error})") from error
    graph = rig.folder / "xfeat.onnx"
    good = stored.graph
    graph.write_bytes(good)
    matcher = {
        "matcher": {
            "name": "structural+xfeat", "model": str(graph), "model_sha256": stored.sha256,
        }
    }  # fmt: skip
    rig.stop_daemon()
    rig.reconfigure({**_SETTINGS, **matcher})
    rig.start_daemon()
    rig.wait_for_fixes(5)
    # In place, as a careless copy over it does.
    graph.write_bytes(good[: len(good) // 2] + b"not this" * 1000)
    flown = _fly(rig, expected_hz)
    rig.supervisor.send(signal.SIGKILL)
    starts = rig.supervisor.count("started")
    rig.wait_for(lambda: rig.supervisor.count("started") >= starts + 2, "two starts")
    refused = not rig.supervisor.is_ready and str(graph) in rig.supervisor.tail()
    graph.write_bytes(good)
    back_s = rig.wait_for_fixes(1)
    rig.stop_daemon()
    rig.reconfigure(_SETTINGS)
    rig.start_daemon()
    return (
        f"{flown} with the one in memory; killed then, it "
        f"{'refused to start, naming the file' if refused else 'did not name the file'}, and had a fix {back_s:.1f} s "
        "after the right one was back",
        flown.as_before and refused and back_s < _RESTART_S,
    )


FAULTS: tuple[_Fault, ...] = (
    _Fault("camera unplugged", f"no frames for {_OUTAGE_S:g} s", _camera_unplugged),
    _Fault("camera's program killed", "SIGKILL, as when memory runs out; started 3 s later", _camera_program_killed),
    _Fault("disk full", f"the flight log's disk filled for {_OUTAGE_S:g} s", _disk_full),
    _Fault("log read-only", "started with a flight log's disk that can't be written", _log_read_only),
    _Fault("zenoh router gone", f"killed, and back {_OUTAGE_S:g} s later", _router_gone),
    _Fault("web clients stalled", f"{_CLIENTS} that never read, one that never ends its request", _web_client_stalled),
    _Fault("clock stepped", "an hour ahead, an hour back, and right again", _clock_stepped),
    _Fault("stopped", "SIGSTOP, SIGCONT 10 s later; the watchdog's limit is 10 s", _stopped),
    _Fault("killed", "SIGKILL", _killed),
    _Fault("model replaced", "its file overwritten; then SIGKILL; then the right file back", _model_replaced),
)


# -- what they need -----------------------------------------------------------------------------------------

_CLOCK_FILE = "clock"


def _changeable_clock(folder: Path) -> dict[str, str]:
    """An environment in which the date goes by a file; empty without libfaketime."""
    found = importlib.util.find_spec("libfaketime")
    if found is None or found.origin is None:
        return {}
    libraries = sorted(Path(found.origin).parent.rglob("libfaketime.so*"))
    if not libraries:
        return {}
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / _CLOCK_FILE
    file.write_text("+0", encoding="ascii")
    return {
        "LD_PRELOAD": str(libraries[0]), "FAKETIME_TIMESTAMP_FILE": str(file), "FAKETIME_CACHE_DURATION": "1",
        "FAKETIME_DONT_FAKE_MONOTONIC": "1",
    }  # fmt: skip


@contextlib.contextmanager
def _small_disk(folder: Path) -> Iterator[None]:
    """Raises: NotPossibleError without the right to mount one."""
    _mount("-t", "tmpfs", "-o", f"size={_DISK_BYTES}", "tmpfs", str(folder))
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=False, capture_output=True)


def _mount(*arguments: str) -> None:
    if shutil.which("mount") is None:
        raise NotPossibleError("there is no mount")
    done = subprocess.run(["mount", *arguments], check=False, capture_output=True, text=True)
    if done.returncode:
        raise NotPossibleError(f"mount: {done.stderr.strip()}")


def _log_bytes(rig: Rig) -> int:
    total = 0
    for path in rig.log_folder.glob("*.mcap"):
        with contextlib.suppress(FileNotFoundError):
            total += path.stat().st_size
    return total


def _route(endpoint: str) -> None:
    session = zenoh_session("router", endpoint)
    try:
        while True:
            time.sleep(1.0)
    finally:
        session.close()


def _fix_at(rig: Rig, endpoint: str) -> float:
    """How long until a station that connects there has a fix, s."""
    begun_s = time.monotonic()
    got: list[int] = []
    station = zenoh_session("client", connect=endpoint)
    try:
        station.declare_subscriber(
            f"ortholoc/{VEHICLE}/fix", lambda sample: got.append(json.loads(sample.payload.to_bytes())["stamp_ns"])
        )
        rig.wait_for(lambda: bool(got), "a fix behind the router")
    finally:
        station.close()
    return time.monotonic() - begun_s
