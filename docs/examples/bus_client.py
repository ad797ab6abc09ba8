"""Follow a vehicle on zenoh, ask it, and command it. Needs `pip install eclipse-zenoh` and nothing of ours.

    python bus_client.py --connect tcp/127.0.0.1:7447 --vehicle hawk                 # fixes and states, as they come
    python bus_client.py --connect tcp/127.0.0.1:7447 --vehicle hawk --ask config
    python bus_client.py --connect tcp/127.0.0.1:7447 --vehicle hawk --command set_prior \\
        '{"lat_deg": 48.1, "lon_deg": 11.5, "height_amsl_m": 620, "sigma_horizontal_m": 40, "sigma_vertical_m": 10}'

Written for `[bus] encoding = "json"`; docs/bus.md has the keys, docs/bus.schema.json what is in each.
"""

from __future__ import annotations

import argparse
import json
import queue
import sys
import time
from typing import Any

import zenoh


def open_session(endpoint: str) -> Any:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    # Else it would look for routers all over the field's network.
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    return zenoh.open(config)


def follow(session: Any, vehicle: str, seconds: float) -> None:
    """Print fixes, rejections and states; and whether the vehicle's daemon is there at all."""
    # zenoh's thread only hands over.
    samples: queue.Queue[Any] = queue.Queue(100)
    session.declare_subscriber(f"ortholoc/{vehicle}/*", zenoh.handlers.Callback(samples.put))
    session.liveliness().declare_subscriber(f"ortholoc/{vehicle}/alive", samples.put, history=True)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            sample = samples.get(timeout=0.2)
        except queue.Empty:
            continue
        name = str(sample.key_expr).rpartition("/")[2]
        if name == "alive":
            print("alive" if sample.kind == zenoh.SampleKind.PUT else "gone", flush=True)
        elif str(sample.encoding) == "application/json":
            print(line(name, json.loads(sample.payload.to_bytes())), flush=True)


def line(name: str, message: dict[str, Any]) -> str:
    if name == "fix":
        where = message["body"] or message["camera"]
        east_m, north_m = (where["covariance_enu"][i][i] ** 0.5 for i in (0, 1))
        return f"fix {where['lat_deg']:.7f} {where['lon_deg']:.7f} within {max(east_m, north_m):.2f} m (1 sigma)"
    if name == "rejection":
        return f"no fix: {message['reason']} {message['detail']}"
    if name == "state":
        return f"state {message['status']}{', paused' if message['paused'] else ''}, GNSS {message['gnss']}"
    return name


def ask(session: Any, key: str, payload: str | None = None) -> int:
    """Print the answer; 0 if there was one that is no refusal."""
    encoding = None if payload is None else "application/json"
    code = 1
    for reply in session.get(key, payload=payload, encoding=encoding, timeout=10.0):
        answer = reply.ok or reply.err
        text = answer.payload.to_string()
        print(text, flush=True)
        if reply.ok is not None and json.loads(text).get("accepted", True):
            code = 0
    return code


def main() -> int:
    parser = argparse.ArgumentParser(description="Follow, ask and command a vehicle on zenoh.")
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", help="zenoh endpoint (default: %(default)s)")
    parser.add_argument("--vehicle", default="vehicle", help="(default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=1e9, help="how long to follow (default: for ever)")
    parser.add_argument("--ask", metavar="KEY", help="fix, state, health, config, stats")
    parser.add_argument("--command", nargs="+", metavar=("NAME", "JSON"), help="relocalize, set_prior, search, pause, "
                        "resume, snapshot")  # fmt: skip
    args = parser.parse_args()
    with open_session(args.connect) as session:
        if args.command:
            name, payload = args.command[0], args.command[1] if len(args.command) > 1 else "{}"
            return ask(session, f"ortholoc/{args.vehicle}/command/{name}", payload)
        if args.ask:
            return ask(session, f"ortholoc/{args.vehicle}/{args.ask}")
        follow(session, args.vehicle, args.seconds)
    return 0


if __name__ == "__main__":
    sys.exit(main())
