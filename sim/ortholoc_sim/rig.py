"""The daemon as it is installed, on a simulated aircraft: a process of its own under a supervisor, frames over zenoh.

`ortholoc-edge sim` has the daemon in its own process; here it is one that can be killed, stopped and measured apart.
The aircraft circles a closed route without GNSS, steered by what its autopilot makes of the fixes. All is in real time.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import shutil
import signal
import socket
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np

from ortholoc_edge.adapters.camera import EndOfFrames
from ortholoc_edge.cli.install_service import service_file
from ortholoc_edge.clock import SystemClock
from ortholoc_edge.errors import OrtholocError
from ortholoc_edge.geometry.arrays import ImageArray
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.tiles.pack import Pack
from ortholoc_sim import demo_pack_path
from ortholoc_sim.autopilot import UdpPort, Verdict
from ortholoc_sim.flight import FlightOptions, SimulatedCamera, Studio, fly, placement, site_and_route
from ortholoc_sim.loop import ClosedLoop, LoopOptions, true_camera_pose
from ortholoc_sim.supervised import Rules, Supervisor, daemon_command

_S = 1_000_000_000
VEHICLE = "rig"
_KEY = f"{VEHICLE}/camera"
_UNIT = "ortholoc-edge.service"
# Samples of the truth are needed for as long as a fix may be late.
_KEEP_S = 20.0
_KEEP_RECORDS = 20_000
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 92]
_PATIENCE_S = 60.0


@dataclass(frozen=True, slots=True)
class RigOptions:
    """One rig.

    Attributes:
        rate_hz: of the camera.
        gnss_until_s: after takeoff; then it is gone for good.
        settings: of the daemon's configuration, by table; over what the rig needs.
        environment: added to the daemon's.
        flight: camera, world, route, sensors; the route is closed.
    """

    rate_hz: float = 5.0
    gnss_until_s: float = 15.0
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    environment: Mapping[str, str] = field(default_factory=dict)
    flight: FlightOptions = field(default_factory=FlightOptions)


@dataclass(frozen=True, slots=True)
class Arrival:
    """A fix as the bus brought it. ``at_s``: time.monotonic(). ``error_m``: against the truth, 3D; None where that is
    forgotten. ``timings_ms``: per stage."""

    at_s: float
    stamp_ns: int
    error_m: float | None
    sigma_m: float
    timings_ms: Mapping[str, float]


class Rig:
    """A context manager: inside, the aircraft flies and the daemon is kept running.

    Attributes:
        supervisor: of the daemon; `stop_daemon` and `start_daemon` replace it.
        fixes, rejections: as the bus brought them; rejections as (time.monotonic(), reason).
        is_camera_plugged: set it to False, and no frame goes out.
    """

    def __init__(self, folder: Path, options: RigOptions | None = None) -> None:
        """
        Args:
            folder: for the configuration, logs and what the daemon says.
        """
        self.folder, self.options = folder, options or RigOptions()
        self.fixes: list[Arrival] = []
        self.rejections: list[tuple[float, str]] = []
        self.is_camera_plugged = True
        self._clock = SystemClock()
        self._stop = threading.Event()
        self._failures: list[BaseException] = []
        self._loop: ClosedLoop | None = None
        self._resources = ExitStack()
        self._settings = self.options.settings
        self._camera_port, self._our_port, self._bus_port, self._page_port, self._router_port = free_ports(5)

    @property
    def bus_endpoint(self) -> str:
        """Where the daemon listens."""
        return f"tcp/127.0.0.1:{self._bus_port}"

    @property
    def router_endpoint(self) -> str:
        """Of a zenoh router that the daemon connects to where there is one."""
        return f"tcp/127.0.0.1:{self._router_port}"

    @property
    def page_port(self) -> int:
        """Of the ground page, on loopback."""
        return self._page_port

    @property
    def config_path(self) -> Path:
        return self.folder / "vehicle.toml"

    @property
    def log_folder(self) -> Path:
        return self.folder / "log"

    @property
    def pack_path(self) -> Path:
        """A copy: what is done to it harms nobody."""
        return self.folder / "pack"

    def __enter__(self) -> Rig:
        with ExitStack() as resources:
            self._set_up(resources)
            self._resources = resources.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._resources.close()

    def _set_up(self, resources: ExitStack) -> None:
        options, flight = self.options, self.options.flight
        self.folder.mkdir(parents=True, exist_ok=True)
        if not self.pack_path.exists():
            shutil.copytree(flight.pack or demo_pack_path(), self.pack_path)
        pack = Pack.open(self.pack_path)
        site, route = site_and_route(pack, flight)

        def pose_at(stamp_ns: int) -> Rigid3 | None:
            return None if self._loop is None else true_camera_pose(self._loop, site, flight.mount, stamp_ns)

        self._pose_at = pose_at
        studio = Studio(flight.spec, flight.epoch, placement(pack, site, flight.spec), flight.sensor, flight.camera)
        camera = SimulatedCamera(studio, pose_at, options.rate_hz, self._clock)
        resources.callback(camera.shut_down)
        port = resources.enter_context(closing(UdpPort(flight.autopilot.system_id)))
        self._session = resources.enter_context(closing(zenoh_session("peer", f"tcp/127.0.0.1:{self._our_port}")))
        self._session.declare_subscriber(f"ortholoc/{VEHICLE}/fix", self._on_fix)
        self._session.declare_subscriber(f"ortholoc/{VEHICLE}/rejection", self._on_rejection)
        self._link = f"udpout:127.0.0.1:{port.port}"
        self._write_config()
        self.camera_program = CameraProgram(f"tcp/127.0.0.1:{self._camera_port}", _KEY)
        resources.callback(self.camera_program.kill)
        self.camera_program.start()
        camera.wait_ready()
        start_ns = self._clock.now_ns()
        self._loop = ClosedLoop(
            site,
            LoopOptions(
                route, flight.speed_m_s, gnss_until_s=options.gnss_until_s, vehicle=flight.vehicle,
                autopilot=replace(flight.autopilot, seed=flight.autopilot.seed + flight.seed), seed=flight.seed,
                closed=True, keep_s=_KEEP_S,
            ),
            start_ns,
        )  # fmt: skip
        end_ns = start_ns + 365 * 86400 * _S
        camera.roll(start_ns + _S, end_ns)
        threads = [
            threading.Thread(
                target=fly, args=(self._loop, port, self._clock, end_ns, self._stop, self._failures), daemon=True
            ),
            threading.Thread(target=self._film, args=(camera,), name="rig-camera", daemon=True),
        ]
        for thread in threads:
            thread.start()
            resources.callback(thread.join, 5.0)
        resources.callback(self._stop.set)
        self.supervisor = self._supervisor()
        resources.callback(self.stop_daemon)
        self.supervisor.__enter__()

    def _supervisor(self) -> Supervisor:
        rules = Rules.of_unit(service_file(_UNIT))
        return Supervisor(daemon_command(self.config_path), rules, self.folder, self.options.environment)

    def stop_daemon(self) -> int | None:
        """As `systemctl stop`; its exit code."""
        return self.supervisor.close()

    def start_daemon(self) -> None:
        """As `systemctl start`, after `stop_daemon`."""
        self.supervisor = self._supervisor()
        self.supervisor.__enter__()

    def reconfigure(self, settings: Mapping[str, Mapping[str, Any]]) -> None:
        """Write another configuration; the daemon reads it when it starts."""
        self._settings = settings
        self._write_config()

    def _write_config(self) -> None:
        camera = self.options.flight.camera
        peers = (self._camera_port, self._our_port, self._router_port)
        tables: dict[str, dict[str, Any]] = {
            "camera": {"source": f"zenoh:{_KEY}"},
            "intrinsics": {
                "width_px": camera.width, "height_px": camera.height, "fx": camera.fx, "fy": camera.fy,
                "cx": camera.cx, "cy": camera.cy, "distortion": list(camera.distortion),
            },
            "map": {"pack": str(self.pack_path)},
            "link": {"endpoint": self._link},
            # A machine that also draws the camera's pictures and flies the aircraft.
            "timing": {"max_age_ms": 3000.0},
            "log": {"folder": str(self.log_folder)},
            "bus": {
                "enabled": True, "vehicle": VEHICLE, "listen": [self.bus_endpoint],
                "connect": [f"tcp/127.0.0.1:{port}" for port in peers], "image_rate_hz": 1.0,
            },
            "page": {"enabled": True, "listen": f"127.0.0.1:{self._page_port}"},
        }  # fmt: skip
        for name, given in self._settings.items():
            tables[name] = {**tables.get(name, {}), **given}
        text = "".join(
            f"[{name}]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in table.items())
            for name, table in tables.items()
        )
        self.config_path.write_text(text, encoding="utf-8")

    # -- what happens in the air: each in a thread of its own ---------------------------------------------

    def _film(self, camera: SimulatedCamera) -> None:
        while not self._stop.is_set():
            try:
                frame = camera.read(0.2)
            except EndOfFrames:
                return
            except BaseException as error:
                self._failures.append(error)
                return
            if frame is not None and self.is_camera_plugged:
                attachment = json.dumps({"stamp_ns": frame.stamp_ns, "name": frame.name}).encode()
                self.camera_program.publish(_jpeg(frame.image), attachment)

    def _on_fix(self, sample: Any) -> None:
        at_s = time.monotonic()
        fix = json.loads(sample.payload.to_bytes())
        truth = self._pose_at(fix["stamp_ns"])
        error_m = None
        if truth is not None:
            error_m = float(np.linalg.norm(np.array(fix["position_map_m"]) - truth.translation))
        sigma_m = float(np.sqrt(max(fix["covariance"][0][0], fix["covariance"][1][1])))
        self.fixes.append(Arrival(at_s, fix["stamp_ns"], error_m, sigma_m, fix["timings_ms"]))

    def _on_rejection(self, sample: Any) -> None:
        self.rejections.append((time.monotonic(), json.loads(sample.payload.to_bytes())["reason"]))

    # -- for whoever looks --------------------------------------------------------------------------------

    def wait_for(self, condition: Callable[[], Any], what: str, seconds: float = _PATIENCE_S) -> float:
        """How long it took, s. Raises: OrtholocError if it does not come about, or the aircraft falls."""
        begun_s = time.monotonic()
        while not condition():
            if self._failures:
                raise OrtholocError(f"rig: {self._failures[0]!r}") from self._failures[0]
            if time.monotonic() - begun_s > seconds:
                raise OrtholocError(f"rig: {what} did not happen within {seconds:g} s; {self.supervisor.tail()}")
            time.sleep(0.02)
        return time.monotonic() - begun_s

    def fly_until(self, at_s: float) -> None:
        """Until time.monotonic() is ``at_s``. Raises: OrtholocError if the aircraft falls."""
        self.wait_for(lambda: time.monotonic() >= at_s, "time", at_s - time.monotonic() + _PATIENCE_S)

    def wait_for_fixes(self, count: int, seconds: float = _PATIENCE_S) -> float:
        """Until so many more fixes came; how long it took, s."""
        wanted = len(self.fixes) + count
        return self.wait_for(lambda: len(self.fixes) >= wanted, f"{count} fixes", seconds)

    def autopilot_error_m(self) -> float:
        """How far off, level, the autopilot believes itself to be now."""
        assert self._loop is not None
        sample = self._loop.samples[-1]
        return float(np.hypot(*(sample.estimate_m - sample.true_m)[:2]))

    def fused(self) -> int:
        """Estimates that the autopilot took in so far, of the last some thousand."""
        assert self._loop is not None
        vision = self._loop.autopilot.vision
        # Nobody else prunes it, and it flies for hours.
        if len(vision) > 2 * _KEEP_RECORDS:
            del vision[:_KEEP_RECORDS]
        return sum(record.verdict in (Verdict.FUSED, Verdict.RESET) for record in list(vision))

    def ask(self, key: str) -> dict[str, Any]:
        """What the daemon answers on ``ortholoc/rig/KEY``. Raises: OrtholocError if it does not."""
        for reply in self._session.get(f"ortholoc/{VEHICLE}/{key}", timeout=5.0):
            if reply.ok is not None:
                answer: dict[str, Any] = json.loads(reply.ok.payload.to_bytes())
                return answer
        raise OrtholocError(f"rig: the daemon does not answer on {key}")


def _jpeg(image: ImageArray) -> bytes:
    return cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), _JPEG)[1].tobytes()


def zenoh_session(mode: str, listen: str | None = None, connect: str | None = None) -> Any:
    """A session that finds nobody by itself."""
    import zenoh

    config = zenoh.Config()
    settings: dict[str, Any] = {"mode": mode, "scouting/multicast/enabled": False}
    settings["listen/endpoints"] = [] if listen is None else [listen]
    settings["connect/endpoints"] = [] if connect is None else [connect]
    if connect is not None:
        settings["connect/timeout_ms"] = round(_PATIENCE_S * 1000)
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def free_ports(count: int) -> list[int]:
    """Ports that nobody listens on now."""
    with ExitStack() as held:
        return [held.enter_context(socket.create_server(("127.0.0.1", 0))).getsockname()[1] for _ in range(count)]


class CameraProgram:
    """The program that has the camera, a process of its own: what it is given it publishes."""

    def __init__(self, endpoint: str, key: str) -> None:
        self._endpoint, self._key = endpoint, key
        self._lock = threading.Lock()
        self._pipe: Connection | None = None
        self._process: Any = None

    def start(self) -> None:
        context = multiprocessing.get_context("spawn")
        pipe, theirs = context.Pipe()
        process = context.Process(target=_publish, args=(self._endpoint, self._key, theirs), daemon=True)
        process.start()
        theirs.close()
        with self._lock:
            self._pipe, self._process = pipe, process

    def publish(self, payload: bytes, attachment: bytes) -> None:
        """Lost where the program does not run."""
        with self._lock, contextlib.suppress(OSError):
            if self._pipe is not None:
                self._pipe.send((payload, attachment))

    def kill(self) -> None:
        """As the kernel does when memory runs out: SIGKILL."""
        with self._lock:
            pipe, process, self._pipe, self._process = self._pipe, self._process, None, None
        if pipe is not None:
            process.kill()
            process.join()
            pipe.close()


def _publish(endpoint: str, key: str, pipe: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    session = zenoh_session("peer", endpoint)
    publisher = session.declare_publisher(key)
    try:
        while True:
            payload, attachment = pipe.recv()
            publisher.put(payload, attachment=attachment)
    except (EOFError, OSError):
        session.close()
