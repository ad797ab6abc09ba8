"""A simulated autopilot flown by hand, and messages for it."""

from __future__ import annotations

import math

import numpy as np
from ortholoc_sim.autopilot import AutopilotCore, AutopilotOptions, Message, SensorOptions, Verdict, dialect
from ortholoc_sim.site import Site
from ortholoc_sim.vehicle import Truth

S = 1_000_000_000
BOOT = 1000 * S
OUR_OFFSET = 7_000 * S + 12_345  # the companion's clock minus boot time
QUIET = SensorOptions(
    tilt_deg=0.0, yaw_bias_deg=0.0, yaw_deg=0.0, gyro_bias_deg_s=0.0, gyro_noise_deg_s=0.0, acceleration_bias=0.0,
    accelerometer_bias=0.0, acceleration_noise=0.0, climb_m_s=0.0, gnss_m=1e-6, gnss_velocity_m_s=1e-6,
    baro_walk_m=0.0, baro_noise_m=0.0,
)  # fmt: skip


def truth(north: float = 0.0, east: float = 0.0, speed_north: float = 0.0) -> Truth:
    return Truth(np.array([north, east, -90.0]), np.array([speed_north, 0.0, 0.0]), np.eye(3), np.zeros(3))


class Rig:
    """A core flown by hand: 10 ms steps, the vehicle north at a constant speed, GNSS gone after half a second."""

    def __init__(self, site: Site, speed: float = 0.0, gnss_s: float = 0.5, **options: object) -> None:
        self.site, self.speed = site, speed
        self.now, self.north = BOOT, 0.0
        options.setdefault("sensors", QUIET)
        self.core = AutopilotCore(AutopilotOptions(**options), site, truth())  # type: ignore[arg-type]
        self.sent: list[Message] = []
        self.core.gnss = gnss_s > 0.0
        self.fly(gnss_s)
        self.core.gnss = False
        self.fly(0.1)

    def fly(self, seconds: float) -> None:
        for _ in range(round(seconds * 100)):
            self.now += S // 100
            self.north += self.speed * 0.01
            for message in self.core.step(self.now, truth(self.north, 0.0, self.speed), 0.01):
                self.sent.append(message)
                if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                    own_ns = self.now - self.core.rebooted_ns
                    answer = dialect.MAVLink_timesync_message(tc1=own_ns + OUR_OFFSET, ts1=message.ts1)
                    self.core.handle(answer, self.now)

    def said(self, name: str) -> list[Message]:
        return [message for message in self.sent if message.get_type() == name]

    def see(self, north: float, east: float, sigma: float = 0.5, age_s: float = 0.0, **changes: object) -> Verdict:
        """Send an ODOMETRY with one sigma in the newest layout of ArduPilot; says what became of it."""
        covariance = [0.0] * 21
        covariance[0] = covariance[6] = sigma**2 / 2
        covariance[20] = 0.01
        fields: dict[str, object] = {
            "time_usec": (self.now + OUR_OFFSET - round(age_s * S)) // 1000,
            "frame_id": dialect.MAV_FRAME_LOCAL_FRD,
            "child_frame_id": dialect.MAV_FRAME_BODY_FRD,
            "x": north, "y": east, "z": -90.0, "q": [1.0, 0.0, 0.0, 0.0],
            "vx": math.nan, "vy": math.nan, "vz": math.nan,
            "rollspeed": 0.0, "pitchspeed": 0.0, "yawspeed": 0.0,
            "pose_covariance": covariance, "velocity_covariance": [math.nan] * 21,
            "reset_counter": 0, "estimator_type": dialect.MAV_ESTIMATOR_TYPE_VISION, "quality": 80,
        }  # fmt: skip
        fields.update(changes)
        self.core.handle(dialect.MAVLink_odometry_message(**fields), self.now)
        return self.verdict

    def see_ned(self, north: float, east: float, sigma: float = 0.5, age_s: float = 0.0, **changes: object) -> Verdict:
        """The same as PX4 wants it; what becomes of it shows when the horizon has reached it, 0.25 s later."""
        covariance = [0.0] * 21
        covariance[0] = covariance[6] = sigma**2
        seen = len(self.core.vision)
        self.see(north, east, 0.0, age_s, frame_id=dialect.MAV_FRAME_LOCAL_NED, pose_covariance=covariance, **changes)
        if len(self.core.vision) == seen:
            self.fly(0.25 - age_s)
        return self.verdict

    def command(self, number: int, *params: float, **fields: object) -> int:
        """MAV_RESULT of a COMMAND_LONG."""
        seven = [*params, *[0.0] * (7 - len(params))]
        message = dialect.MAVLink_command_long_message(1, 1, number, 0, *seven)
        answers = self.core.handle(message, self.now)
        self.sent += answers
        return int(answers[0].result)

    @property
    def verdict(self) -> Verdict:
        return self.core.vision[-1].verdict if self.core.vision else Verdict.UNHEARD

    @property
    def error(self) -> np.ndarray:
        return (self.core.position_ned_m - self.core.true_position_m)[:2]

    @property
    def at(self) -> np.ndarray:
        return self.core.true_position_m
