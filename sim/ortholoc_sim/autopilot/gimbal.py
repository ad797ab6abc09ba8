"""The gimbal that the simulated autopilot speaks for."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_sim.autopilot.dialect import Message, dialect

_MS, _S = 1_000_000, 1_000_000_000


@dataclass(frozen=True, slots=True)
class GimbalOptions:
    """A stabilised gimbal: level in roll, held against the horizon in pitch and against the nose in yaw.

    Attributes:
        pitch_deg: its middle, -90 is straight down. sweep_deg, sweep_s: it nods about that by so much, in such a time.
        yaw_deg: from the nose, clockwise.
        delay_ms: its reports tell where it looked so long before their stamps.
        error_deg: constant, of the roll and the pitch that it reports.
    """

    pitch_deg: float = -50.0
    sweep_deg: float = 10.0
    sweep_s: float = 12.0
    yaw_deg: float = 0.0
    delay_ms: float = 30.0
    error_deg: tuple[float, float] = (0.3, -0.4)

    def ned_from_gimbal(self, ned_from_body: FloatArray, boot_ns: int) -> FloatArray:
        """(3, 3), true, at a boot time."""
        heading_rad = rotation.to_euler(ned_from_body)[2] + math.radians(self.yaw_deg)
        return rotation.from_euler(0.0, self._pitch_rad(boot_ns), heading_rad)

    def report(self, boot_ns: int) -> Message:
        """As ArduPilot sends it: roll and pitch against the horizon, yaw against the nose."""
        roll_deg, pitch_deg = self.error_deg
        pitch_rad = self._pitch_rad(boot_ns - round(self.delay_ms * _MS)) + math.radians(pitch_deg)
        q = rotation.to_quaternion(rotation.from_euler(math.radians(roll_deg), pitch_rad, math.radians(self.yaw_deg)))
        nan = math.nan
        return dialect.MAVLink_gimbal_device_attitude_status_message(
            target_system=0, target_component=0, time_boot_ms=boot_ns // _MS % 2**32,
            flags=dialect.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME, q=[float(v) for v in q], angular_velocity_x=nan,
            angular_velocity_y=nan, angular_velocity_z=nan, failure_flags=0, delta_yaw=nan, delta_yaw_velocity=nan,
            gimbal_device_id=1,
        )  # fmt: skip

    def _pitch_rad(self, boot_ns: int) -> float:
        phase = 2.0 * math.pi * (boot_ns / _S / self.sweep_s)
        return math.radians(self.pitch_deg + self.sweep_deg * math.sin(phase))
