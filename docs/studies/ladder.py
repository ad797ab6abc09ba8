"""What each rung of the ladder takes of the processor: ``python docs/studies/ladder.py PACK MATCHER``.

The daemon runs in a process of its own, beside a simulated autopilot that stands in the air, with frames that are drawn
from the pack at 10 Hz and a thermal sensor that says 60 and then 85 degrees. Processor time is that of the whole daemon.
"""

from __future__ import annotations

import argparse
import logging
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from ortholoc_edge.adapters.computer import ComputerReader
from ortholoc_edge.bench import start
from ortholoc_edge.cli import bench_start
from ortholoc_edge.config import read_config
from ortholoc_edge.daemon import Daemon
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore
from ortholoc_sim.link import LinkSpec, SimulatedLink
from ortholoc_sim.site import Geopoint

HEIGHT_M = 100.0
WINDOW_S = 8.0
# A step for heat comes every ten seconds.
SETTLE_S = 1.0


def fly(folder: Path) -> None:
    """The daemon; counts its outcomes into a file."""
    logging.basicConfig(level=logging.WARNING, stream=sys.stderr)
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: threading.Thread(target=stop.set).start())
    count = 0

    def counted(*_: object) -> None:
        nonlocal count
        count += 1
        (folder / "count.new").write_text(str(count))
        (folder / "count.new").rename(folder / "count")

    Daemon(read_config(folder / "config.toml"), computer=ComputerReader(folder), on_outcome=counted).run(stop)


def measure(pack: Path, matcher: str) -> None:
    camera = bench_start._CAMERA
    args = argparse.Namespace(pack=pack, matcher=matcher, height=HEIGHT_M)
    with MapStore(Pack.open(pack)) as store, tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        place = start.find_place(store, camera, HEIGHT_M)
        below = store.pack.georeference.geodetic_from_map(place - [0.0, 0.0, HEIGHT_M])
        assert below.height_amsl_m is not None
        spec = LinkSpec(
            home=Geopoint(below.lat_deg, below.lon_deg, below.height_amsl_m), radius_m=3.0, height_m=HEIGHT_M,
            speed_m_s=0.01, wind_ned_m_s=(0.0, 0.0, 0.0), gust_m_s=0.0,
        )
        zone = folder / "sys/class/thermal/thermal_zone0"
        zone.mkdir(parents=True)
        (zone / "type").write_text("cpu-thermal")
        (zone / "temp").write_text("60000")
        with SimulatedLink(spec) as link:
            time.sleep(2.0)
            bench_start._write_frames(folder / "frames", store, link)
            text = bench_start._config(args, pack, folder / "frames", link.endpoint)
            # Heat alone leads down.
            more = "[timing]\nbudget_ms = 5000\n[ladder]\nmax_load_percent = 100\n"
            (folder / "config.toml").write_text(text + more)
            daemon = subprocess.Popen(
                [sys.executable, __file__, "--fly", str(folder)], stderr=subprocess.PIPE, text=True
            )
            rungs = [0, 0]

            def follow() -> None:
                assert daemon.stderr is not None
                for line in daemon.stderr:
                    if found := re.search(r"less, rung (\d) of (\d)", line):
                        rungs[:] = int(found[1]), int(found[2])

            threading.Thread(target=follow, daemon=True).start()
            time.sleep(6.0)
            print("| rung | processor, % of a core | frames a second | ms of it per frame |\n|---|---|---|---|")
            look(daemon.pid, folder, 0)
            (zone / "temp").write_text("85000")
            seen = 0
            while seen == 0 or seen < rungs[1]:
                while rungs[0] == seen:
                    time.sleep(0.1)
                seen = rungs[0]
                time.sleep(SETTLE_S)
                look(daemon.pid, folder, seen)
            daemon.terminate()
            daemon.wait(10.0)


def look(pid: int, folder: Path, rung: int) -> None:
    cpu_s, count, began_s = start._cpu_s(pid), int((folder / "count").read_text()), time.monotonic()
    time.sleep(WINDOW_S)
    lasted_s = time.monotonic() - began_s
    cpu_s, count = start._cpu_s(pid) - cpu_s, int((folder / "count").read_text()) - count
    print(f"| {rung} | {100 * cpu_s / lasted_s:.0f} | {count / lasted_s:.1f} | {1e3 * cpu_s / max(count, 1):.0f} |", flush=True)


if __name__ == "__main__":
    if sys.argv[1] == "--fly":
        fly(Path(sys.argv[2]))
    else:
        measure(Path(sys.argv[1]), sys.argv[2])
