"""What the page costs the frame path: frames localized with it off, on, watched, and attacked, in turns.

    python tests/page/page_load.py [--rounds 12] [--frames 25] [--rate 5]
    python tests/page/page_load.py --memory

Rounds of all modes alternate, so that whatever else the computer does falls on all alike. Clients are processes of
their own. Prints a table: wall time and CPU time of the localizing thread per frame, and CPU time of the page's thread.
"""

from __future__ import annotations

import argparse
import gc
import multiprocessing
import os
import random
import socket
import sys
import time
from collections.abc import Callable
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np
from ortholoc_sim.browser import watch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

MODES = ("off", "on", "watched", "four watch", "attacked")


def attack(port: int, stop: Event) -> None:
    """Requests as fast as they are taken, garbage, and connections that say nothing."""
    idle: list[socket.socket] = []
    noise = random.Random(1)
    while not stop.is_set():
        try:
            sock = socket.create_connection(("127.0.0.1", port), timeout=1.0)
            kind = noise.randrange(4)
            if kind == 0:
                sock.sendall(noise.randbytes(3000))
            elif kind == 1:
                sock.sendall(b"GET /state.json HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
                sock.recv(1 << 20)
            elif kind == 2:
                tile = f"/tiles/0/{noise.randrange(6)}/{noise.randrange(5)}.jpg"
                sock.sendall(f"GET {tile} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
                sock.recv(1 << 20)
            else:
                idle.append(sock)
                continue
            sock.close()
        except OSError:
            time.sleep(0.002)
        while len(idle) > 12:
            idle.pop(0).close()


CLIENTS: dict[str, list[Callable[[int, Event], None]]] = {
    "watched": [watch], "four watch": [watch] * 4, "attacked": [watch, attack, attack],
}  # fmt: skip


def thread_cpu_s(native_id: int) -> float:
    fields = Path(f"/proc/self/task/{native_id}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def rss_mib() -> float:
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024
    return 0.0


def memory() -> None:
    """Resident memory of a process without a localizer, as the page comes to it and is watched."""
    from ortholoc_sim import demo_pack_path

    from ortholoc_edge.geometry.camera import Camera
    from ortholoc_edge.pipeline.frame import Frame
    from ortholoc_edge.pipeline.outcome import Reason, Rejected
    from ortholoc_edge.tiles.pack import Pack
    from ortholoc_edge.tiles.store import MapStore

    store = MapStore(Pack.open(demo_pack_path()))
    store.ground_near(np.array(store.bounds).reshape(2, 2).mean(axis=0))
    image = np.random.default_rng(1).integers(0, 255, (960, 1280, 3), dtype=np.uint8)
    before = rss_mib()
    from ortholoc_edge.adapters.page.ground_page import GroundPage
    from ortholoc_edge.adapters.page.options import Listen
    from ortholoc_edge.clock import SystemClock

    about = {"matcher": "structural", "vehicle": "load"}
    camera = Camera.from_focal(1280, 960, 900.0)
    clock = SystemClock()
    page = GroundPage(Listen("127.0.0.1", 0, False, None, frozenset()), clock, store, camera, None, about)
    while page.address is None:
        time.sleep(0.01)
    idle = rss_mib()
    stop = multiprocessing.Event()
    port = int(page.address.rpartition(":")[2])
    clients = [multiprocessing.Process(target=watch, args=(port, stop)) for _ in range(4)]
    for client in clients:
        client.start()
    for number in range(150):
        stamp_ns = clock.now_ns()
        page.put(Frame(stamp_ns, image, str(number)), Rejected(stamp_ns, Reason.LATE, "x" * 40), None, None)
        time.sleep(0.1)
    watched = rss_mib()
    stop.set()
    for client in clients:
        client.join()
    page.close()
    sys.stdout.write(f"RSS MiB: {before:.1f} without the page, {idle:.1f} with it, {watched:.1f} watched by four\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=12)
    parser.add_argument("--frames", type=int, default=25)
    parser.add_argument("--rate", type=float, default=5.0)
    parser.add_argument("--memory", action="store_true")
    args = parser.parse_args()
    if args.memory:
        memory()
    else:
        latency(args)


def latency(args: argparse.Namespace) -> None:
    from replay import rendered

    from ortholoc_edge.adapters.computer import ComputerReader
    from ortholoc_edge.adapters.mavlink.link import SWITCH_INTERVAL_S
    from ortholoc_edge.matching.registry import make_method
    from ortholoc_edge.pipeline.frame import Frame, VehicleState
    from ortholoc_edge.pipeline.localizer import Localizer, LocalizerOptions
    from ortholoc_edge.pipeline.navigator import Circumstances
    from ortholoc_edge.tiles.pack import Pack
    from ortholoc_edge.tiles.store import MapStore

    sys.setswitchinterval(SWITCH_INTERVAL_S)
    poses = [rendered.pose(200.0 + 12.0 * k, 180.0 + 8.0 * k) for k in range(8)]
    pictures = [rendered.picture(pose) for pose in poses]
    priors = [rendered.prior(pose) for pose in poses]
    store = MapStore(Pack.open(rendered.store().pack.path))
    matcher = make_method("structural", working_px=640, max_keypoints=4096, threads=1)
    localizer = Localizer(rendered.CAMERA, store, matcher, LocalizerOptions())
    localizer.warm_up()
    for k in range(8):
        localizer.localize(Frame(k, pictures[k], str(k)), priors[k])
    gc.collect()
    bare = rss_mib()
    from ortholoc_edge.adapters.messages import AutopilotMessage
    from ortholoc_edge.adapters.page.ground_page import GroundPage, Health
    from ortholoc_edge.adapters.page.options import Listen
    from ortholoc_edge.clock import SystemClock

    clock = SystemClock()
    about = {"matcher": "structural", "vehicle": "load"}
    page = GroundPage(Listen("127.0.0.1", 0, False, None, frozenset()), clock, store, rendered.CAMERA, None, about)
    while page.address is None:
        time.sleep(0.01)
    port, native_id = int(page.address.rpartition(":")[2]), page._thread.native_id
    assert native_id is not None
    idle = rss_mib()
    record = AutopilotMessage(
        stamp_ns=0, unix_ns=0, connected=True, fusion="fused", fusion_since_s=1.0, fusion_reason="", gnss="ok",
        gnss_since_s=1.0, gnss_apart_m=0.5, gnss_height_apart_m=None, latency_median_ms=80.0, latency_p99_ms=120.0,
        delay_advice=None, on_vision=False,
    )  # fmt: skip
    computer = ComputerReader().read()
    wall: dict[str, list[float]] = {mode: [] for mode in MODES}
    cpu: dict[str, list[float]] = {mode: [] for mode in MODES}
    own: dict[str, list[float]] = {mode: [] for mode in MODES}
    most: dict[str, float] = dict.fromkeys(MODES, 0.0)
    count = 0
    for turn in range(args.rounds):
        for mode in MODES[turn % len(MODES) :] + MODES[: turn % len(MODES)]:
            stop = multiprocessing.Event()
            clients = [multiprocessing.Process(target=one, args=(port, stop)) for one in CLIENTS.get(mode, [])]
            for client in clients:
                client.start()
            if clients:
                time.sleep(0.3)
            page_s, since_s = thread_cpu_s(native_id), time.monotonic()
            for k in range(args.frames):
                due = since_s + k / args.rate
                time.sleep(max(0.0, due - time.monotonic()))
                count += 1
                which = count % len(poses)
                stamp_ns = clock.now_ns()
                frame = Frame(stamp_ns, pictures[which], str(count))
                began, began_cpu = time.perf_counter(), time.thread_time()
                outcome = localizer.localize(frame, priors[which])
                if mode != "off":
                    state = VehicleState(stamp_ns, np.eye(3), (0.1, 0.1, 0.1))
                    page.put(frame, outcome, state, Circumstances(count, priors[which], 0, 1, 0))
                    if k % round(args.rate) == 0:
                        page.tell(
                            Health(
                                now_ns=stamp_ns, tracker="track", paused=False, autopilot=record, vehicle="x",
                                trouble=None, computer=computer, budget_ms=200.0, rung=0, rungs=5, rate_hz=None,
                                rung_why="", statistics={"sent": 1},
                            )
                        )  # fmt: skip
                wall[mode].append(1e3 * (time.perf_counter() - began))
                cpu[mode].append(1e3 * (time.thread_time() - began_cpu))
            own[mode].append((thread_cpu_s(native_id) - page_s) / (time.monotonic() - since_s))
            most[mode] = max(most[mode], rss_mib())
            stop.set()
            for client in clients:
                client.join(10.0)
                if client.is_alive():
                    client.terminate()
    page.close()
    sys.stdout.write(f"RSS MiB: without the page {bare:.1f}, with it {idle:.1f}\n")
    sys.stdout.write("mode        frames  wall ms median/p90/p99   CPU ms median/p90/p99   page thread %  peak MiB\n")
    for mode in MODES:
        walls, cpus = np.percentile(wall[mode], (50, 90, 99)), np.percentile(cpu[mode], (50, 90, 99))
        sys.stdout.write(
            f"{mode:<11} {len(wall[mode]):6d}  {walls[0]:7.1f} {walls[1]:7.1f} {walls[2]:7.1f}     "
            f"{cpus[0]:7.1f} {cpus[1]:7.1f} {cpus[2]:7.1f}   {100 * float(np.median(own[mode])):10.2f} "
            f"{most[mode]:14.1f}\n"
        )


if __name__ == "__main__":
    main()
