"""Vehicle, guidance and autopilot closed into a loop: time and messages go in, messages come out.

The vehicle is steered by what the autopilot believes, never by the truth. No threads, no sockets, no clock: the owner
(`flight` in real time, a test as fast as it can) says what time it is.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, field

import numpy as np
import rasterio

from ortholoc_edge.config import MountOptions
from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_sim.autopilot import Airframe, AutopilotCore, AutopilotOptions, Message
from ortholoc_sim.fixed_wing import FixedWing, FixedWingOptions
from ortholoc_sim.gnss import GnssEvent, gnss_at
from ortholoc_sim.site import Site
from ortholoc_sim.vehicle import Craft, Guidance, Truth, Vehicle, VehicleOptions, wrapped

STEP_NS = 10_000_000
_S = 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class LoopOptions:
    """One flight.

    Attributes:
        route_map_m: (N, 3) waypoints in map coordinates; the flight starts at the first, ``climb_m`` below.
        speed_m_s: over ground; of a fixed wing as far as its airspeed allows.
        vehicle: what flies: a multirotor or a fixed wing.
        gnss_until_s: after the start; then it is gone.
        gnss: what else happens to it.
        closed: whether the last waypoint leads to the first again, without an end.
        keep_s: samples older than this may be forgotten; a flight without an end has to.
    """

    route_map_m: FloatArray
    speed_m_s: float = 9.0
    climb_m: float = 20.0
    gnss_until_s: float = 10.0
    gnss: tuple[GnssEvent, ...] = ()
    vehicle: VehicleOptions | FixedWingOptions = field(default_factory=VehicleOptions)
    autopilot: AutopilotOptions = field(default_factory=AutopilotOptions)
    seed: int = 1
    closed: bool = False
    keep_s: float = math.inf


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """The loop at one step.

    Attributes:
        stamp_ns: the owner's clock.
        truth: in the simulation's NED.
        true_m, estimate_m: (3,) NED of the autopilot.
        dead_reckoned_m: (2,) what it would believe without us since GNSS was lost; None before.
    """

    stamp_ns: int
    truth: Truth
    true_m: FloatArray
    estimate_m: FloatArray
    dead_reckoned_m: FloatArray | None


class ClosedLoop:
    """The simulated aircraft.

    Attributes:
        autopilot: for its counts and records.
        samples: every step so far, but see `LoopOptions.keep_s`. Appended by the owner's thread; others may read what
            is there.
    """

    def __init__(self, site: Site, options: LoopOptions, start_ns: int) -> None:
        self.options = options
        self._start_ns = self._now_ns = start_ns
        self._clock_step_ns = 0
        # As a ground station uploads it: latitude and longitude, which the autopilot turns into its own metres.
        route = [
            site.autopilot_from_ned(site.ned_from_map(waypoint))
            for waypoint in np.asarray(options.route_map_m, dtype=np.float64)
        ]
        start = site.ned_from_map(options.route_map_m[0]) + np.array([0.0, 0.0, options.climb_m])
        course = route[1] - route[0]
        self._guidance = self._guide(np.array(route), options.closed)
        heading = float(np.arctan2(course[1], course[0]))
        self._vehicle: Craft
        airframe: Airframe
        if isinstance(options.vehicle, FixedWingOptions):
            self._vehicle, airframe = FixedWing(options.vehicle, start, heading, options.seed), "fixed-wing"
        else:
            self._vehicle = Vehicle(options.vehicle, start, np.zeros(3), heading, options.seed)
            airframe = "multirotor"
        self.autopilot = AutopilotCore(options.autopilot, site, self._vehicle.truth, airframe)
        self.autopilot.mission.set_route(np.array(route))
        self._revision = self.autopilot.mission.revision
        self.samples: list[Sample] = []
        self._stamps: list[int] = []

    def _guide(self, route: FloatArray, closed: bool = False) -> Guidance:
        options = self.options
        if not isinstance(options.vehicle, FixedWingOptions):
            return Guidance(route, options.speed_m_s, closed=closed)
        # It needs room to turn, and cannot hover at the end.
        wing = options.vehicle
        return Guidance(
            route, options.speed_m_s, wing.max_climb_m_s, 2.0 * wing.airspeed_m_s, closed=closed,
            loiter_radius_m=1.6 * wing.least_turn_radius_m,
        )  # fmt: skip

    @property
    def now_ns(self) -> int:
        """Time simulated so far, the owner's clock."""
        return self._now_ns

    @property
    def on_last_leg(self) -> bool:
        """Whether the guidance flies to the last waypoint."""
        return self._guidance.leg >= len(self._guidance.waypoints_ned_m) - 2

    @property
    def gnss_lost_ns(self) -> int:
        """When GNSS goes, the owner's clock."""
        return self._start_ns + round(self.options.gnss_until_s * _S)

    def boot_ns(self, now_ns: int) -> int:
        """The autopilot's clock at ``now_ns`` of the owner's."""
        return now_ns - self._start_ns + self.options.autopilot.boot_offset_ns + self._clock_step_ns

    def step_clock(self, by_ns: int) -> None:
        """Set the autopilot's clock forward, as a defect does."""
        self._clock_step_ns += by_ns

    def owner_ns(self, boot_ns: int) -> int:
        """The owner's clock at a time of the autopilot's."""
        return boot_ns - self.boot_ns(self._start_ns) + self._start_ns + self.autopilot.rebooted_ns

    def receive(self, messages: list[Message], now_ns: int) -> list[Message]:
        """Hand over messages that arrived; returns the answers."""
        return [answer for message in messages for answer in self.autopilot.handle(message, self.boot_ns(now_ns))]

    def advance(self, now_ns: int) -> list[Message]:
        """Fly until ``now_ns`` in whole steps; returns what the autopilot sends."""
        out: list[Message] = []
        # Each step asks PROJ where it is; without an environment of rasterio's around it, that is set up each time.
        with rasterio.Env():
            while self._now_ns + STEP_NS <= now_ns:
                out += self._step()
        return out

    def _step(self) -> list[Message]:
        dt = STEP_NS / _S
        autopilot, vehicle = self.autopilot, self._vehicle
        if autopilot.mission.revision != self._revision:
            self._revision = autopilot.mission.revision
            self._guidance = self._guide(autopilot.route())
        autopilot.mission.current = autopilot.mission.target(self._guidance.leg)
        velocity, heading = self._guidance.wanted(autopilot.position_ned_m)
        yaw = rotation.to_euler(autopilot.ned_from_body)[2]
        vehicle.step(dt, velocity - autopilot.velocity_ned_m_s, wrapped(heading - yaw))
        self._now_ns += STEP_NS
        signal = gnss_at(self.options.gnss, (self._now_ns - self._start_ns) / _S)
        autopilot.gnss = signal.available and self._now_ns < self.gnss_lost_ns
        autopilot.gnss_offset_m, autopilot.gnss_noise = signal.offset_ned_m, signal.noise
        truth = vehicle.truth
        out = autopilot.step(self.boot_ns(self._now_ns), truth, dt)
        self.samples.append(
            Sample(self._now_ns, truth, autopilot.true_position_m, autopilot.position_ned_m, autopilot.dead_reckoned_m)
        )
        self._stamps.append(self._now_ns)
        if self._stamps[0] < self._now_ns - 2.0 * self.options.keep_s * _S:
            # Half at a time, so that it costs nothing per step.
            old = bisect_right(self._stamps, self._now_ns - round(self.options.keep_s * _S))
            del self.samples[:old], self._stamps[:old]
        return out

    def truth_at(self, stamp_ns: int) -> Truth | None:
        """The truth at a stamp of the owner's clock, interpolated; None before the start and in the future."""
        after = bisect_right(self._stamps, stamp_ns)
        if after == 0 or after >= len(self._stamps):
            return None
        a, b = self.samples[after - 1], self.samples[after]
        t = (stamp_ns - a.stamp_ns) / (b.stamp_ns - a.stamp_ns)
        return Truth(
            (1 - t) * a.truth.position_ned_m + t * b.truth.position_ned_m,
            (1 - t) * a.truth.velocity_ned_m_s + t * b.truth.velocity_ned_m_s,
            rotation.slerp(a.truth.ned_from_body, b.truth.ned_from_body, t),
            (1 - t) * a.truth.rates_body_rad_s + t * b.truth.rates_body_rad_s,
        )


def true_camera_pose(loop: ClosedLoop, site: Site, mount: MountOptions, stamp_ns: int) -> Rigid3 | None:
    """``map_from_camera`` as it really is at a stamp of the owner's clock; None before the start and in the future."""
    truth = loop.truth_at(stamp_ns)
    if truth is None:
        return None
    gimbal = loop.options.autopilot.gimbal
    if gimbal is None:
        mounted = mount.body_from_camera()
    else:
        turned = gimbal.ned_from_gimbal(truth.ned_from_body, loop.boot_ns(stamp_ns))
        mounted = mount.body_from_camera_in(truth.ned_from_body.T @ turned)
    return site.camera_pose(truth.position_ned_m, truth.ned_from_body, mounted)
