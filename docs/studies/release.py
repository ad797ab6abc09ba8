"""Ways to send fixes to simulated autopilots that stamp them as they do: how far off they are, how sure they believe they are.

    python docs/studies/release.py [--seconds 65] [--seeds 2]

Faster than real time: fixes are the truth with 0.8 m of noise per axis, two a second, each ready some time after its
capture; the daemon's own protocol and release, every message packed and parsed; GNSS is lost at 10 s. Figures of
docs/release.md come from here.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from ortholoc_sim import demo_pack_path
from ortholoc_sim.autopilot import AutopilotOptions, FilterOptions, dialect
from ortholoc_sim.flight import FlightOptions, site_and_route
from ortholoc_sim.loop import ClosedLoop, LoopOptions

from ortholoc_edge.adapters.mavlink import LinkOptions
from ortholoc_edge.adapters.mavlink.codec import FrameParser
from ortholoc_edge.adapters.mavlink.estimates import VisionEstimate
from ortholoc_edge.adapters.mavlink.geodesy import Place
from ortholoc_edge.adapters.mavlink.protocol import LinkProtocol
from ortholoc_edge.tiles.pack import Pack

_S = 1_000_000_000
_START = 5_000 * _S
_NOISE_M = 0.8


def ardupilot(viso_ms: float) -> AutopilotOptions:
    return AutopilotOptions(filter=FilterOptions(stamps="jitter", viso_delay_ms=viso_ms))


def px4(minor: int, **parameters: float) -> AutopilotOptions:
    """Synchronised before the flight; its clock is PX4's own business."""
    return AutopilotOptions(
        stack="px4", firmware=(1, minor, 0), filter=FilterOptions(converged_after=0), parameters=parameters
    )


def fly(mode: str, latency_s: float, jitter_s: float, autopilot: AutopilotOptions, seconds: float, seed: int):
    """(horizontal errors (N,), errors over the filter's own sigma (N,)) after GNSS was lost, of PX4 7 s later."""
    autopilot = replace(autopilot, seed=3 + seed)
    site, route = site_and_route(Pack.open(demo_pack_path()), FlightOptions(autopilot=autopilot))
    held_ms = autopilot.filter.viso_delay_ms if autopilot.stack == "ardupilot" else 0.0
    since_ns = 0 if autopilot.stack == "ardupilot" else 7 * _S
    loop = ClosedLoop(site, LoopOptions(route, seed=seed, autopilot=autopilot), _START)
    protocol = LinkProtocol(LinkOptions(endpoint="udp:127.0.0.1:1", release=mode, fixed_latency_ms=held_ms or 250.0))
    ours, theirs = dialect.MAVLink(None, 1, 197), dialect.MAVLink(None, 1, 1)
    to_us, to_it = FrameParser(), FrameParser()
    rng = np.random.default_rng(seed)
    ready: list[tuple[int, VisionEstimate]] = []
    errors, ratios = [], []
    for tick in range(round(seconds * 50)):
        now = _START + tick * _S // 50
        replies = []
        for sent in loop.advance(now):
            for message in to_us.feed(sent.pack(theirs), now):
                protocol.on_message(message, now)
                replies += filter(None, [protocol.answer(message, now)])
        replies += protocol.poll(now)
        truth = loop.truth_at(now - _S // 50)
        if truth is not None and tick % 25 == 0:
            position = site.autopilot_from_ned(truth.position_ned_m) + rng.normal(0.0, _NOISE_M, 3)
            covariance = np.diag([_NOISE_M**2] * 3 + [1e-4] * 3)
            at = site.geopoint_from_autopilot(position)
            fix = VisionEstimate(
                now - _S // 50, position, truth.ned_from_body, covariance,
                place=Place(at.lat_deg, at.lon_deg, at.height_amsl_m), origin=protocol.telemetry.origin,
            )
            ready.append((now + round((latency_s + jitter_s * rng.random()) * _S), fix))
        while ready and ready[0][0] <= now:
            protocol.release.take(ready.pop(0)[1], now, protocol.state_at)
        outgoing = protocol.release.due(now, protocol.state_at)
        if outgoing is not None:
            replies += protocol.encode_estimate(outgoing.estimate, now)
            protocol.sent(outgoing, now, local=True)
        for reply in replies:
            for answer in loop.receive(to_it.feed(reply.pack(ours), now), now):
                for message in to_us.feed(answer.pack(theirs), now):
                    protocol.on_message(message, now)
        if now > loop.gnss_lost_ns + since_ns and loop.samples:
            sample = loop.samples[-1]
            difference = (sample.estimate_m - sample.true_m)[:2]
            errors.append(float(np.hypot(*difference)))
            ratios.append(float(difference @ difference) / 2.0 / float(loop.autopilot.filter.variance_m2.mean()))
    return np.array(errors), np.array(ratios)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=65.0)
    parser.add_argument("--seeds", type=int, default=2)
    args = parser.parse_args()
    print("| autopilot | mode | latency s | parameters | error median, p90, max m | NEES / 2 |\n|---|---|---|---|---|---|")
    for mode, latency_s, jitter_s, autopilot in (
        ("fast-forward", 0.2, 0.1, ardupilot(0.0)),
        ("fixed-latency", 0.12, 0.1, ardupilot(250.0)),
        ("raw", 0.2, 0.1, ardupilot(200.0)),
        ("fast-forward", 0.5, 0.2, ardupilot(0.0)),
        ("raw", 0.5, 0.2, ardupilot(250.0)),
        ("fast-forward", 0.2, 0.1, px4(16)),
        ("raw", 0.1, 0.05, px4(16)),
        ("fast-forward", 0.2, 0.1, px4(18)),
        ("raw", 0.2, 0.1, px4(18, EKF2_AGP0_DELAY=250.0, EKF2_DELAY_MAX=400.0)),
    ):
        flights = [fly(mode, latency_s, jitter_s, autopilot, args.seconds, seed) for seed in range(1, args.seeds + 1)]
        errors, ratios = (np.concatenate(parts) for parts in zip(*flights, strict=True))
        spread = f"{np.median(errors):.2f}, {np.percentile(errors, 90):.2f}, {errors.max():.2f}"
        latency = f"{latency_s:g} to {latency_s + jitter_s:g}"
        px = autopilot.stack == "px4"
        told = autopilot.parameters if px else {"VISO_DELAY_MS": autopilot.filter.viso_delay_ms}
        named = ", ".join(f"{name} {value:g}" for name, value in told.items())
        who = f"{autopilot.stack} {autopilot.firmware[0]}.{autopilot.firmware[1]}"
        print(f"| {who} | {mode} | {latency} | {named} | {spread} | {ratios.mean():.2f} |", flush=True)


if __name__ == "__main__":
    main()
