"""Builds killed at random moments: there is always the old pack or the new one, sound, and no process is left.

As a command: `python tests/tiles/kill_loop.py 50` (iterations), `--two-steps` for file systems that cannot exchange
two names. As a test: `test_tiles_kill.py`.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tile_rasters import contents, write_wide_scene

from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.pack import Pack

QUALITIES = (50, 80)
_ORPHANS_S = 10.0
# What `ortholoc-edge` runs, where two names cannot be exchanged in one step.
_TWO_STEPS = (
    "import sys; from ortholoc_edge.tiles import install; install._exchanged = lambda one, other: False;"
    "from ortholoc_edge.cli import main; sys.exit(main())"
)


def kill_loop(
    folder: Path, iterations: int, seed: int = 0, *, two_steps: bool = False, jobs: int = 2
) -> dict[str, int]:
    """Kill builds of a pack in ``folder``, look at what is there each time, and let the last one finish.

    Returns: how often what happened. Raises: AssertionError for a pack that is neither old nor new, or a process left.
    """
    rng = random.Random(seed)
    sources = write_wide_scene(folder / "sources")
    sound = {
        quality: contents(
            build_pack(*sources, folder / f"{quality}", PackOptions(vertical="unknown", quality=quality)).path
        )
        for quality in QUALITIES
    }
    place = folder / "place"
    place.mkdir()
    out = place / "pack"
    start = time.monotonic()
    _start(sources, out, QUALITIES[0], two_steps, jobs).wait()
    whole_s = time.monotonic() - start
    shutil.rmtree(out)

    seen: collections.Counter[str] = collections.Counter()
    installed: int | None = None
    for _ in range(iterations):
        wanted = next(quality for quality in QUALITIES if quality != installed)
        process = _start(sources, out, wanted, two_steps, jobs)
        try:
            _wait_for_moment(rng, process, place, whole_s, seen)
            seen["finished before"] += process.poll() is not None
            if rng.random() < 0.5:
                seen["group killed"] += 1
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
            else:
                seen["parent killed"] += 1
                process.kill()
        finally:
            process.wait()
        _no_orphans(process.pid)
        installed = _checked(out, sound, installed, wanted, seen)
        seen["work left"] += (place / ".pack.building").exists()
    wanted = next(quality for quality in QUALITIES if quality != installed)
    assert _start(sources, out, wanted, two_steps, jobs).wait() == 0
    assert contents(out) == sound[wanted], "the last build is not like one that was never cut off"
    assert [path.name for path in place.iterdir()] == ["pack"]
    return dict(seen)


def _start(sources: tuple[Path, Path], out: Path, quality: int, two_steps: bool, jobs: int) -> subprocess.Popen[bytes]:
    program = ["-c", _TWO_STEPS] if two_steps else ["-m", "ortholoc_edge"]
    arguments = ["--dop", sources[0], "--dsm", sources[1], "--out", out, "--vertical", "unknown", "--force"]
    return subprocess.Popen(
        [sys.executable, *program, "tiles", "build", *map(str, arguments), "--quality", str(quality), f"--jobs={jobs}"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def _wait_for_moment(
    rng: random.Random, process: subprocess.Popen[bytes], place: Path, whole_s: float, seen: collections.Counter[str]
) -> None:
    """Any moment of the build, or one around the exchange."""
    if rng.random() < 0.4:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(rng.uniform(0.0, 1.1 * whole_s))
        return
    seen["aimed at the exchange"] += 1
    staged = place / ".pack.building" / "pack" / "manifest.json"
    before = _stamp(staged)
    while process.poll() is None and _stamp(staged) in (before, None):
        time.sleep(0.0005)
    time.sleep(rng.uniform(0.0, 0.05))


def _stamp(path: Path) -> int | None:
    try:
        return path.stat().st_ino
    except OSError:
        return None


def _no_orphans(session: int) -> None:
    deadline = time.monotonic() + _ORPHANS_S
    while left := _members(session):
        if time.monotonic() > deadline:
            for process in left:
                os.kill(process, signal.SIGKILL)
            raise AssertionError(f"{len(left)} processes outlived the build")
        time.sleep(0.02)


def _members(session: int) -> list[int]:
    """Living processes of a session."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            with contextlib.suppress(OSError):
                # After the name, which may hold spaces: state, parent, group, session.
                fields = (folder / "stat").read_text().rpartition(")")[2].split()
                if int(fields[3]) == session and fields[0] != "Z":
                    found.append(int(folder.name))
    return found


def _checked(
    out: Path,
    sound: dict[int, dict[str, bytes]],
    installed: int | None,
    wanted: int,
    seen: collections.Counter[str],
) -> int | None:
    """The quality of the pack that is there. Raises: AssertionError if it is neither the old nor the new."""
    if not out.exists():
        if installed is None:
            seen["no pack yet"] += 1
            return None
        # Between the two steps of an exchange: the old pack is beside, and the next build puts it back.
        aside = out.parent / f".{out.name}.replaced"
        assert aside.exists(), "the old pack is gone"
        assert contents(aside) == sound[installed], "the old pack was damaged"
        seen["old pack aside"] += 1
        return installed
    assert Pack.open(out).verify() == []
    found = contents(out)
    for quality in (installed, wanted):
        if quality is not None and found == sound[quality]:
            seen["old pack" if quality == installed else "new pack"] += 1
            return quality
    raise AssertionError(f"{out}: neither the old pack nor the new one")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("iterations", type=int, nargs="?", default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--two-steps", action="store_true")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="ortholoc-kill-") as folder:
        print(kill_loop(Path(folder), args.iterations, args.seed, two_steps=args.two_steps, jobs=args.jobs))  # noqa: T201
    return 0


if __name__ == "__main__":
    sys.exit(main())
