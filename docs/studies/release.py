"""Ways to send fixes to a simulated ArduPilot that stamps them as it does: how far off it is, how sure it believes it is.

    python docs/studies/release.py [--seconds 65] [--seeds 2]

Faster than real time: fixes are the truth with 0.8 m of noise per axis, two a second, each ready some time after its
capture; the daemon's own protocol and release, every message packed and parsed; GNSS is lost at 10 s. Figures of
docs/release.md come from here.
"""

from __future__ import annotations

import argparse
import numpy as np
from ortholoc_sim import demo_pack_path
from ortholoc_sim.autopilot import AutopilotOptions, FilterOptions, dialect
from ortholoc_sim.flight import FlightOptions, site_and_route
from ortholoc_sim.loop import ClosedLoop, LoopOptions

from ortholoc_edge.adapters.mavlink import LinkOptions
from ortholoc_edge.adapters.mavlink.codec import FrameParser
from ortholoc_edge.adapters.mavlink.estimates import VisionEstimate
from ortholoc_edge.adapters.mavlink.protocol import LinkProtocol
from ortholoc_edge.tiles.pack import Pack

_S = 1_000_000_000
_START = 5_000 * _S
_NOISE_M = 0.8


def fly(mode: str, latency_s: float, jitter_s: float, viso_ms: float, seconds: float, seed: int):
    """(horizontal errors (N,), errors over the filter's own sigma (N,)) after GNSS was lost."""
    site, route = site_and_route(Pack.open(demo_pack_path()), FlightOptions())
    autopilot = AutopilotOptions(filter=FilterOptions(stamps="jitter", viso_delay_ms=viso_ms), seed=3 + seed)
    loop = ClosedLoop(site, LoopOptions(route, seed=seed, autopilot=autopilot), _START)
    protocol = LinkProtocol(LinkOptions(endpoint="udp:127.0.0.1:1", release=mode, fixed_latency_ms=viso_ms or 250.0))
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
            fix = VisionEstimate(now - _S // 50, position, truth.ned_from_body, covariance)
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
        if now > loop.gnss_lost_ns and loop.samples:
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
    print("| mode | latency s | VISO_DELAY_MS | error median, p90, max m | NEES / 2 |\n|---|---|---|---|---|")
    for mode, latency_s, jitter_s, viso_ms in (
        ("fast-forward", 0.2, 0.1, 0.0),
        ("fixed-latency", 0.12, 0.1, 250.0),
        ("raw", 0.2, 0.1, 200.0),
        ("fast-forward", 0.5, 0.2, 0.0),
        ("raw", 0.5, 0.2, 250.0),
    ):
        flights = [fly(mode, latency_s, jitter_s, viso_ms, args.seconds, seed) for seed in range(1, args.seeds + 1)]
        errors, ratios = (np.concatenate(parts) for parts in zip(*flights, strict=True))
        spread = f"{np.median(errors):.2f}, {np.percentile(errors, 90):.2f}, {errors.max():.2f}"
        latency = f"{latency_s:g} to {latency_s + jitter_s:g}"
        print(f"| {mode} | {latency} | {viso_ms:.0f} | {spread} | {ratios.mean():.2f} |", flush=True)


if __name__ == "__main__":
    main()
