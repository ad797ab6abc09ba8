"""``doctor``: what is wrong with the link, the autopilot's settings or this computer, and what mends it."""

from __future__ import annotations

import argparse
import json
import logging
import os
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec

from ortholoc_edge.adapters.mavlink import AutopilotLink, LinkOptions
from ortholoc_edge.adapters.mavlink.audit import Finding, Level, Situation
from ortholoc_edge.adapters.mavlink.checkup import Checkup
from ortholoc_edge.adapters.mavlink.parameters import Answer, Written
from ortholoc_edge.adapters.mavlink.signing import beside
from ortholoc_edge.cli.arguments import non_negative, positive
from ortholoc_edge.clock import SystemClock
from ortholoc_edge.config import Config, read_config

logger = logging.getLogger(__name__)

_S = 1_000_000_000
# MAV_COMP_ID_ONBOARD_COMPUTER4: through a router it may run beside the daemon, which is 197.
_COMPONENT = 194
_POLL_S = 0.05
# A rate is told by what came in this time, after the streams were asked for.
_LISTEN_NS = 6 * _S
# Three repetitions of setting, and as many of reading back.
_WRITE_PATIENCE_S = 10.0


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "doctor",
        help="what is wrong with the autopilot's link and settings, or with this computer",
        description="Listens to the autopilot, reads the parameters that matter to vision, and prints what is wrong, "
        "why, and the command that mends it; docs/autopilot.md explains them. No parameter is changed without "
        "--fix; the autopilot is asked for streams of messages on this link (SET_MESSAGE_INTERVAL), as by the daemon. "
        "With --computer it looks at this computer instead: clock, devices, keys, pack, model, memory, heat, disk and "
        "the camera's pictures; the daemon must not run, since a camera is one program's. "
        "Exit status: 0 nothing wrong, 1 something is (notes don't count) or the link can't be opened, 2 usage, 78 the "
        "configuration or the endpoint can't be used.",
    )
    parser.add_argument("--link", metavar="ENDPOINT", help="udp:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or "
                        "serial:/dev/ttyX:BAUD (default: of --config)")  # fmt: skip
    parser.add_argument("--config", type=Path, metavar="FILE", help="the daemon's; tells the messages, the ids and the "
                        "mount's lever arm")  # fmt: skip
    parser.add_argument("--system-id", type=_system_id, metavar="N", help="the autopilot's (default: of --config, or "
                        "the first autopilot heard)")  # fmt: skip
    parser.add_argument("--latency-ms", type=non_negative, metavar="MS", help="what localizing takes, from "
                        "mid-exposure until a fix is there, as the daemon measures it. The delay parameters are held "
                        "against what [link] release makes of it: about 0 with fast-forward (assumed without --config),"
                        " fixed_latency_ms with fixed-latency, this value with raw")  # fmt: skip
    parser.add_argument("--computer", action="store_true", help="look at this computer instead of the autopilot; needs "
                        "--config")  # fmt: skip
    parser.add_argument("--fix", action="store_true", help="set the parameters, after a question for each")
    parser.add_argument("--yes", action="store_true", help="with --fix: don't ask")
    parser.add_argument("--json", action="store_true", help="as JSON (default: text)")
    parser.add_argument("--timeout", type=positive, default=30.0, metavar="S", help="how long to listen and ask at "
                        "most (default: %(default)s)")  # fmt: skip
    parser.set_defaults(run=run, usage_error=parser.error)


def _system_id(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 255:
        raise argparse.ArgumentTypeError(f"{text!r} is not a system id from 1 to 255")
    return int(text)


def run(args: argparse.Namespace) -> int:
    if args.link is None and args.config is None:
        args.usage_error("give --link ENDPOINT or --config FILE")
    if args.yes and not args.fix:
        args.usage_error("--yes is for --fix")
    if args.computer and (args.config is None or args.link is not None or args.fix):
        args.usage_error("--computer goes with --config FILE, and neither with --link nor with --fix")
    config = None if args.config is None else read_config(args.config)
    if args.computer and config is not None:
        return _computer(config, as_json=args.json)
    options = LinkOptions(endpoint=args.link) if config is None else config.link
    changes: dict[str, Any] = {"component_id": _COMPONENT}
    if args.link is not None:
        changes["endpoint"] = args.link
    if args.system_id is not None:
        changes["system_id"] = args.system_id
    options = beside(msgspec.structs.replace(options, **changes), "doctor", os.environ)
    clock = SystemClock()
    link = AutopilotLink(options, clock)
    checkup = Checkup(
        link, options,
        lever_arm_m=None if config is None else config.mount.lever_arm_m,
        # Without either the autopilot may be right for a release that isn't known here.
        ages=lambda: None if config is None and args.latency_ms is None else link.ages(args.latency_ms),
    )  # fmt: skip
    assumed = "" if config is not None else ", assumed for want of --config"
    release = f'release = "{options.way_of_release}"{assumed}'
    link.start(open_now=True)
    try:
        _listen(link, checkup, clock, args.timeout)
        situation, findings = checkup.situation(), checkup.findings()
        if not args.json:
            _print_situation(options.endpoint, release, situation)
            _print_findings(findings)
        written: list[Written] = []
        if args.fix:
            written = _fix(link, clock, findings, ask=_yes if args.yes else _ask)
            if written:
                # A change may bring up what did not show before.
                checkup.read()
                _wait(lambda: checkup.step(clock.now_ns()), clock, args.timeout)
                situation, after = checkup.situation(), checkup.findings()
                if not args.json:
                    _print_outcome(written, findings, after)
                findings = after
        if args.json:
            print(json.dumps(_facts(options, situation, findings, written), indent=2))
    finally:
        link.stop()
    return 1 if any(finding.level is not Level.NOTE for finding in findings) else 0


def _computer(config: Config, *, as_json: bool) -> int:
    # Not at the top: it opens maps and cameras, which the rest does not need.
    from ortholoc_edge.adapters.camera import prepare
    from ortholoc_edge.preflight import check_computer

    prepare(config.camera)
    findings = check_computer(config, SystemClock(), os.environ)
    if as_json:
        print(json.dumps({"findings": [asdict(finding) for finding in findings]}, indent=2))
    else:
        _print_findings(findings)
    return 1 if any(finding.level is not Level.NOTE for finding in findings) else 0


def _listen(link: AutopilotLink, checkup: Checkup, clock: SystemClock, timeout_s: float) -> None:
    """Until the parameters are known and streams were heard for a while, or the time is over."""
    found_ns: int | None = None

    def done() -> bool:
        nonlocal found_ns
        if found_ns is None and link.vehicle is not None:
            found_ns = clock.now_ns()
        known = checkup.step(clock.now_ns())
        return known and found_ns is not None and clock.now_ns() - found_ns >= _LISTEN_NS

    _wait(done, clock, timeout_s)


def _wait(done: Callable[[], bool], clock: SystemClock, timeout_s: float) -> bool:
    deadline_ns = clock.now_ns() + round(timeout_s * _S)
    while not done():
        if clock.now_ns() >= deadline_ns:
            return False
        time.sleep(_POLL_S)
    return True


# -- changes -------------------------------------------------------------------------------------------


def _ask(finding: Finding) -> bool:
    name, value = finding.change or ("", 0)
    print(f"set {name} from {finding.found} to {value:g}? [y/N] ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def _yes(finding: Finding) -> bool:
    return True


def _not_known_disarmed(link: AutopilotLink, clock: SystemClock) -> str | None:
    """Why parameters must not be set now; None where the vehicle is known to be disarmed."""
    state = link.state_at(clock.now_ns())
    if state is None or not link.connected():
        return "whether the vehicle is armed is not known, for want of a heartbeat"
    return "the vehicle is armed" if state.armed else None


def _fix(
    link: AutopilotLink, clock: SystemClock, findings: list[Finding], ask: Callable[[Finding], bool]
) -> list[Written]:
    written: list[Written] = []
    for finding in findings:
        if finding.change is None or not ask(finding):
            continue
        # After the question: it may have been armed while that waited for its answer.
        why = _not_known_disarmed(link, clock)
        if why is not None:
            logger.error("%s; nothing %sis changed", why, "more " if written else "")
            break
        name, value = finding.change
        try:
            link.write_parameter(name, value)
        except ValueError as error:
            written.append(Written(name, value, None, False, str(error)))
            continue
        outcome: list[Written] = []

        def settled(outcome: list[Written] = outcome) -> bool:
            outcome += link.written_parameters()
            return bool(outcome)

        if not _wait(settled, clock, _WRITE_PATIENCE_S):
            # Further changes would fail the same way.
            written.append(Written(name, value, None, False, "the link was lost meanwhile"))
            break
        written += outcome
    return written


# -- what is printed -----------------------------------------------------------------------------------


def _print_situation(endpoint: str, release: str, situation: Situation) -> None:
    health = situation.health
    rows = [("link", endpoint), ("heard", ", ".join(_peers(situation)) or "nobody")]
    if health.vehicle is not None:
        vehicle = health.vehicle
        rows.append(("autopilot", f"{vehicle.autopilot.value} {vehicle.firmware}, system {vehicle.system_id}"))
        round_trip = "no answer" if health.round_trip_ms is None else f"round trip {health.round_trip_ms:.1f} ms"
        rows.append(("clock", f"{round_trip}, {'' if health.synchronised else 'not '}synchronised"))
        for i, (name, wanted_hz) in enumerate(health.wanted_rates_hz.items()):
            rate = health.rates_hz.get(name)
            rows.append(("" if i else "streams", f"{name} {'-' if rate is None else f'{rate:g}'} of {wanted_hz:g} Hz"))
        origin = health.origin
        text = "none"
        if origin is not None:
            text = f"{origin.latitude_deg:.7f}, {origin.longitude_deg:.7f}, {origin.height_amsl_m:.2f} m AMSL"
        rows.append(("origin", text))
        answers = [reading.answer for reading in situation.readings.values()]
        absent = answers.count(Answer.ABSENT)
        text = f"{answers.count(Answer.VALUE)} of {len(answers)} read"
        rows.append(("parameters", text + (f", {absent} not in this firmware" if absent else "")))
        if situation.ages is not None:
            rows.append(("delay", f"estimates are {situation.ages.middle_ms:.0f} ms old on arrival, with {release}"))
    width = max(len(name) for name, _ in rows) + 2
    for name, text in rows:
        print(f"{name:<{width}}{text}")


def _peers(situation: Situation) -> list[str]:
    return [f"{peer.system_id}/{peer.component_id} {peer.role}" for peer in situation.health.peers]


def _print_findings(findings: list[Finding]) -> None:
    print()
    for finding in findings:
        reboot = ", after a reboot" if finding.reboot else ""
        print(f"{finding.level:<9}{finding.subject}: {finding.found}; wanted: {finding.wanted}{reboot}")
        print(f"{'':<9}{finding.why}")
        print(f"{'':<9}{finding.remedy}")
    counts = [
        f"{number} {level}{'' if number == 1 else 's'}"
        for level in Level
        if (number := sum(finding.level is level for finding in findings))
    ]
    print(", ".join(counts) if counts else "nothing wrong")


def _print_outcome(written: list[Written], before: list[Finding], after: list[Finding]) -> None:
    print()
    for change in written:
        if change.accepted:
            print(f"{change.name} = {change.wanted:g}, read back")
        else:
            print(f"{change.name} is not {change.wanted:g}: {change.why}")
    names = _to_reboot(written, before)
    if names:
        print(f"restart the autopilot for {', '.join(names)}")
    print("\nafter the changes:", end="")
    _print_findings(after)


def _to_reboot(written: list[Written], findings: list[Finding]) -> list[str]:
    reboot = {finding.subject for finding in findings if finding.reboot}
    return [change.name for change in written if change.accepted and change.name in reboot]


def _facts(
    options: LinkOptions, situation: Situation, findings: list[Finding], written: list[Written]
) -> dict[str, Any]:
    health, origin = situation.health, situation.health.origin
    return {
        "link": options.endpoint,
        "autopilot": None if situation.autopilot is None else situation.autopilot.value,
        "firmware": None if situation.firmware is None else ".".join(map(str, situation.firmware)),
        "development_build": health.vehicle is not None and health.vehicle.development,
        "system_id": None if health.vehicle is None else health.vehicle.system_id,
        "connected": health.connected,
        "sinks": sorted(situation.sinks),
        "peers": [asdict(peer) for peer in health.peers],
        "round_trip_ms": health.round_trip_ms,
        "synchronised": health.synchronised,
        "release": options.way_of_release,
        "age_ms": None if situation.ages is None else situation.ages.middle_ms,
        "rates_hz": dict(health.rates_hz),
        "wanted_rates_hz": dict(health.wanted_rates_hz),
        "origin": None if origin is None else asdict(origin),
        "parameters": {name: reading.value for name, reading in situation.readings.items()},
        "findings": [asdict(finding) for finding in findings],
        "changes": [asdict(change) for change in written],
    }
