"""What MAVSDK makes of us, one JSON object a line. Runs in the peers' Python, never in ours.

``forward URL URL``: a ground station between two connections, that passes each what comes over the other, until its
stdin ends. ``addressee SYSTEM``: it is that system's autopilot and decodes the frames, hexadecimal, one a line, that it
gets on stdin. ``companion URL PARAMETER``: it is the companion of an autopilot: reads its version, its mission and a
parameter, sets that to 2, uploads the mission without its last item, and sends a vision position at each line of stdin.
"""

from __future__ import annotations

import json
import os
import sys
import time
from typing import Any

from mavsdk.component_type import ComponentType
from mavsdk.connection_result import ConnectionResult
from mavsdk.enums import ForwardingOption
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.info import Info, InfoError, InfoResult
from mavsdk.plugins.mavlink_direct import MavlinkDirect
from mavsdk.plugins.mission_raw import MissionRaw
from mavsdk.plugins.mocap import AngleBody, Covariance, Mocap, PositionBody, VisionPositionEstimate
from mavsdk.plugins.param import Param
from mavsdk.plugins.telemetry import Telemetry

OURS = 197
# MAVSDK logs to stdout; that goes to stderr, so that only our lines are on the pipe.
records = os.fdopen(os.dup(1), "w", buffering=1)
os.dup2(2, 1)


def tell(kind: str, **values: Any) -> None:
    records.write(json.dumps({"kind": kind, **values}) + "\n")


def tell_message(message: Any, _: Any) -> None:
    if message.component_id == OURS:
        fields = json.loads(message.fields_json)
        tell("message", name=message.message_name, system=message.system_id, fields=fields)


def tell_odometry(odometry: Any, _: Any) -> None:
    at, q = odometry.position_body, odometry.q
    tell(
        "odometry",
        stamp_us=odometry.time_usec,
        position_m=[at.x_m, at.y_m, at.z_m],
        q=[q.w, q.x, q.y, q.z],
        covariance=list(odometry.pose_covariance.covariance_matrix),
    )


def check(result: ConnectionResult) -> None:
    if result != ConnectionResult.SUCCESS:
        raise SystemExit(f"MAVSDK can't connect: {result!r}")


def firmware(info: Info) -> Any:
    """MAVSDK asks the autopilot for it by itself."""
    for _ in range(200):
        try:
            return info.get_version()
        except InfoError as error:
            if error.result != InfoResult.INFORMATION_NOT_RECEIVED_YET:
                raise
            time.sleep(0.1)
    raise SystemExit("MAVSDK got no AUTOPILOT_VERSION")


def forward(urls: list[str]) -> None:
    mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    for url in urls:
        check(mavsdk.add_any_connection_with_forwarding(url, ForwardingOption.ON))
    system = mavsdk.first_autopilot(20.0)
    if system is None:
        raise SystemExit("MAVSDK found no autopilot")
    direct, telemetry = MavlinkDirect(system), Telemetry(system)
    direct.subscribe_message("", tell_message)
    telemetry.subscribe_odometry(tell_odometry)
    telemetry.subscribe_status_text(lambda text, _: tell("text", severity=text.type.name, text=text.text))
    version = firmware(Info(system))
    tell(
        "vehicle",
        mavsdk=mavsdk.version(),
        system=system.get_system_id(),
        autopilot=system.autopilot_type().name,
        firmware=[version.flight_sw_major, version.flight_sw_minor, version.flight_sw_patch],
    )
    for _ in sys.stdin:
        systems = {one.get_system_id(): sorted(one.component_ids()) for one in mavsdk.get_systems()}
        tell("systems", systems=systems)
    mavsdk.destroy()


def addressee(system_id: int) -> None:
    mavsdk = Mavsdk(Configuration.create_manual(system_id, 1, False))
    check(mavsdk.add_any_connection("raw://"))
    directs: list[MavlinkDirect] = []
    for line in sys.stdin:
        mavsdk.pass_received_raw_bytes(bytes.fromhex(line))
        while not directs:
            time.sleep(0.05)
            directs = [MavlinkDirect(system) for system in mavsdk.get_systems()]
            for direct in directs:
                direct.subscribe_message("", tell_message)
            tell("listening")
    mavsdk.destroy()


def companion(url: str, parameter: str) -> None:
    mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER))
    check(mavsdk.add_any_connection(url))
    system = mavsdk.first_autopilot(20.0)
    if system is None:
        raise SystemExit("MAVSDK found no autopilot")
    telemetry, missions, parameters = Telemetry(system), MissionRaw(system), Param(system)
    telemetry.subscribe_flight_mode(lambda mode, _: tell("mode", name=mode.name))
    telemetry.subscribe_position(lambda at, _: tell("position", lat_deg=at.latitude_deg, lon_deg=at.longitude_deg))
    version = firmware(Info(system))
    items = missions.download_mission()
    before = parameters.get_param_int(parameter)
    parameters.set_param_int(parameter, 2)
    names = parameters.get_all_params()
    missions.upload_mission(items[:-1])
    tell(
        "vehicle",
        firmware=[version.flight_sw_major, version.flight_sw_minor, version.flight_sw_patch],
        autopilot=system.autopilot_type().name,
        items=[len(items), len(missions.download_mission())],
        parameter=[before, parameters.get_param_int(parameter)],
        parameters=len(names.int_params) + len(names.float_params),
    )
    mocap = Mocap(system)
    for line in sys.stdin:
        x, y, z = (float(part) for part in line.split())
        sigma = [0.25 if n in (0, 6, 11, 15, 18, 20) else 0.0 for n in range(21)]
        mocap.set_vision_position_estimate(
            VisionPositionEstimate(
                time.monotonic_ns() // 1000, PositionBody(x, y, z), AngleBody(0.0, 0.0, 0.0), Covariance(sigma), 0
            )
        )
    mavsdk.destroy()


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["forward", *urls]:
            forward(urls)
        case ["addressee", number]:
            addressee(int(number))
        case ["companion", url, parameter]:
            companion(url, parameter)
        case other:
            raise SystemExit(f"{other} is not understood; see the docstring")
