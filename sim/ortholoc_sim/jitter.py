"""What telemetry, flight log and ground page cost the frame path, or the search of the map beside it: the daemon with
all of them and with none, in turns.

The aircraft hovers, so that the same pictures, drawn once, fit every life of the daemon. A frame's time is from its
stamp until its fix is in the simulated autopilot's socket.
"""

from __future__ import annotations

import json
import multiprocessing
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ortholoc_edge.bench.metrics import Spread
from ortholoc_edge.cli.install_service import service_file
from ortholoc_edge.clock import SystemClock
from ortholoc_edge.errors import OrtholocError
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore
from ortholoc_sim import demo_pack_path
from ortholoc_sim.autopilot import FilterOptions, UdpPort
from ortholoc_sim.browser import watch
from ortholoc_sim.camera import Renderer
from ortholoc_sim.flight import FlightOptions, fly, placement, site_and_route
from ortholoc_sim.loop import ClosedLoop, LoopOptions
from ortholoc_sim.rig import free_ports, zenoh_session
from ortholoc_sim.supervised import Rules, Supervisor, daemon_command
from ortholoc_sim.vehicle import VehicleOptions
from ortholoc_sim.world import build_scene, generate

_S = 1_000_000_000
RATE_HZ = 10.0
# Of each life: connecting, loading, the first searches.
_SETTLING = 20
_LEG_M = 1.0
_CORNER_M = 150.0
_REST_S = 30
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 92]
Tables = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class Jitter:
    """What rounds came to. ``off``, ``on``: all frames, ms. ``p99_ratio``: on over off; ``round_p99_ratios``: of each
    round by itself, whose median bears a disturbance of one. ``lost``: frames without a fix, off and on."""

    rounds: int
    off: Spread
    on: Spread
    off_p95: float
    on_p95: float
    p99_ratio: float
    median_ratio: float
    round_p99_ratios: tuple[float, ...]
    lost: tuple[int, int]


def measure(
    folder: Path, rounds: int, frames: int, on_round: Callable[[int], None] = lambda _: None, *, search: bool = False
) -> Jitter:
    """Fly so many rounds, each with and without, in alternating order.

    Args:
        folder: for pictures, configuration and logs.
        frames: of each life of the daemon, at `RATE_HZ`.
        search: with and without a search that does not end, where the vehicle is not, and nothing else.
    Raises: OrtholocError if the daemon does not come to fixes.
    """
    options = FlightOptions(route_m=((250.0, 230.0), (250.0 + _LEG_M, 230.0)))
    pack = Pack.open(demo_pack_path())
    site, route = site_and_route(pack, options)
    renderer = Renderer(
        build_scene(generate(options.spec), options.epoch), placement(pack, site, options.spec), options.sensor
    )
    vehicle = VehicleOptions(wind_ned_m_s=(0.0, 0.0, 0.0), gust_m_s=0.0)
    autopilot = replace(options.autopilot, filter=FilterOptions(stamps="timesync", converged_after=0))
    clock, stop, failures = SystemClock(), threading.Event(), list[BaseException]()
    with ExitStack() as resources:
        port = resources.enter_context(closing(UdpPort()))
        start_ns = clock.now_ns() - _REST_S * _S
        loop = ClosedLoop(
            site,
            LoopOptions(route, speed_m_s=1.0, climb_m=0.0, gnss_until_s=1e9, vehicle=vehicle, autopilot=autopilot),
            start_ns,
        )  # fmt: skip
        # At rest before its picture is taken.
        loop.advance(clock.now_ns())
        truth = loop.samples[-1].truth
        pose = site.camera_pose(truth.position_ned_m, truth.ned_from_body, options.mount.body_from_camera())
        pictures = folder / "pictures"
        pictures.mkdir(parents=True, exist_ok=True)
        for number in range(frames):
            drawn = cv2.cvtColor(renderer.render(options.camera, pose, number), cv2.COLOR_RGB2BGR)
            if not cv2.imwrite(str(pictures / f"{number:05d}.jpg"), drawn, _JPEG):
                raise OrtholocError(f"{pictures}: can't write pictures there")
        end_ns = start_ns + 10**6 * _S
        thread = threading.Thread(target=fly, args=(loop, port, clock, end_ns, stop, failures), daemon=True)
        thread.start()
        resources.callback(thread.join, 5.0)
        resources.callback(stop.set)
        lives: dict[bool, list[list[float]]] = {False: [], True: []}
        for number in range(rounds):
            for loaded in (False, True) if number % 2 == 0 else (True, False):
                tables = _tables(options, pictures, f"udpout:127.0.0.1:{port.port}")
                lives[loaded].append(_life(folder, tables, loaded, loop, search))
                if failures:
                    raise OrtholocError(f"jitter: {failures[0]!r}") from failures[0]
            on_round(number + 1)
    return _summary(lives[False], lives[True], frames)


def _tables(options: FlightOptions, pictures: Path, link: str) -> dict[str, dict[str, Any]]:
    camera = options.camera
    return {
        "camera": {"source": f"folder:{pictures}", "rate_hz": RATE_HZ},
        "intrinsics": {
            "width_px": camera.width, "height_px": camera.height, "fx": camera.fx, "fy": camera.fy, "cx": camera.cx,
            "cy": camera.cy,
        },
        "map": {"pack": str(demo_pack_path())},
        "link": {
            "endpoint": link, "release": "raw", "computer_status_rate_hz": 0.0, "quality_rate_hz": 0.0,
        },
        # One resolution for both, whatever the computer does meanwhile.
        "timing": {"max_age_ms": 5000.0, "budget_ms": 5000.0},
        "ladder": {"max_load_percent": 100.0},
    }  # fmt: skip


def _life(
    folder: Path, tables: dict[str, dict[str, Any]], loaded: bool, loop: ClosedLoop, search: bool
) -> list[float]:
    """One life of the daemon: times of its frames, ms."""
    with ExitStack() as resources:
        bus, page = free_ports(2)
        if search:
            tables["bus"] = {"enabled": True, "listen": [f"tcp/127.0.0.1:{bus}"], "commands": True}
        elif loaded:
            tables["link"] |= {"computer_status_rate_hz": 1.0, "quality_rate_hz": 1.0}
            tables["log"] = {"folder": str(folder / "log"), "frames": "all", "max_mb": 64}
            tables["bus"] = {"enabled": True, "listen": [f"tcp/127.0.0.1:{bus}"], "image_rate_hz": 5.0}
            tables["page"] = {"enabled": True, "listen": f"127.0.0.1:{page}"}
        path = folder / "vehicle.toml"
        path.write_text(
            "".join(
                f"[{name}]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in table.items())
                for name, table in tables.items()
            ),
            encoding="utf-8",
        )
        rules = Rules.of_unit(service_file("ortholoc-edge.service"))
        before = len(loop.autopilot.vision)
        supervisor = resources.enter_context(Supervisor(daemon_command(path), rules, folder, {}))
        _wait(lambda: supervisor.is_ready, supervisor)
        if loaded and search:
            _search(f"tcp/127.0.0.1:{bus}")
        elif loaded:
            _listeners(resources, bus, page)
        _wait(lambda: supervisor.count("ended") > 0, supervisor)
        if supervisor.count("started") > 1:
            raise OrtholocError(f"jitter: the daemon failed; {supervisor.tail()}")
        records = loop.autopilot.vision[before:]
    taken = sorted({record.capture_ns: record.arrival_ns for record in records}.items())
    return [(arrival_ns - capture_ns) / 1e6 for capture_ns, arrival_ns in taken[_SETTLING:]]


def _search(endpoint: str) -> None:
    """Have the daemon search in the pack's south-west corner, where the vehicle is not, without an end."""
    pack = Pack.open(demo_pack_path())
    with MapStore(pack) as store:
        west, south, _, _ = store.bounds
    corners = []
    for east, north in ((0.0, 0.0), (_CORNER_M, 0.0), (0.0, _CORNER_M)):
        place = pack.georeference.geodetic_from_map(np.array([west + east, south + north, 0.0]))
        corners.append([place.lat_deg, place.lon_deg])
    with closing(zenoh_session("client", connect=endpoint)) as session:
        replies = session.get("ortholoc/vehicle/command/search", payload=json.dumps({"polygon": corners}))
        accepted = [json.loads(reply.ok.payload.to_bytes())["accepted"] for reply in replies if reply.ok is not None]
    if accepted != [True]:
        raise OrtholocError(f"jitter: the daemon does not search: {accepted}")


def _listeners(resources: ExitStack, bus: int, page: int) -> None:
    """A ground station on the bus and a browser on the page, in processes of their own."""
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    listeners = [
        context.Process(target=_listen, args=(f"tcp/127.0.0.1:{bus}", stop), daemon=True),
        context.Process(target=watch, args=(page, stop), daemon=True),
    ]
    for listener in listeners:
        listener.start()
        resources.callback(listener.join, 5.0)
    resources.callback(stop.set)


def _listen(endpoint: str, stop: Any) -> None:
    session = zenoh_session("client", connect=endpoint)
    session.declare_subscriber("ortholoc/**", lambda sample: sample.payload.to_bytes())
    stop.wait()
    session.close()


def _wait(condition: Callable[[], bool], supervisor: Supervisor, seconds: float = 300.0) -> None:
    end_s = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end_s:
            raise OrtholocError(f"jitter: the daemon did not come so far; {supervisor.tail()}")
        time.sleep(0.05)


def _summary(off: Sequence[Sequence[float]], on: Sequence[Sequence[float]], frames: int) -> Jitter:
    wanted = frames - _SETTLING
    for lives in (off, on):
        if min(len(life) for life in lives) < wanted // 2:
            raise OrtholocError("jitter: less than half of the frames of a life gave a fix; see daemon.log")
    all_off, all_on = np.concatenate(off), np.concatenate(on)
    ratios = [float(np.percentile(b, 99) / np.percentile(a, 99)) for a, b in zip(off, on, strict=True)]
    return Jitter(
        rounds=len(off),
        off=Spread.of(all_off),
        on=Spread.of(all_on),
        off_p95=float(np.percentile(all_off, 95)),
        on_p95=float(np.percentile(all_on, 95)),
        p99_ratio=float(np.percentile(all_on, 99) / np.percentile(all_off, 99)),
        median_ratio=float(np.median(all_on) / np.median(all_off)),
        round_p99_ratios=tuple(ratios),
        lost=(wanted * len(off) - len(all_off), wanted * len(on) - len(all_on)),
    )
