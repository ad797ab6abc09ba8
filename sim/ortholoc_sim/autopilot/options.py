"""Who a simulated autopilot is, how it is set up and how its sensors err."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from ortholoc_sim.autopilot.gimbal import GimbalOptions
from ortholoc_sim.autopilot.sensors import SensorOptions

Version = tuple[int, int, int]
Stack = Literal["ardupilot", "px4"]
Airframe = Literal["multirotor", "fixed-wing"]

_S = 1_000_000_000
# Whose rules of reading are known: autopilot-contract.md, 2.3 to 2.5.
KNOWN: dict[Stack, tuple[tuple[int, int], tuple[int, int]]] = {"ardupilot": ((4, 5), (4, 8)), "px4": ((1, 14), (1, 18))}


@dataclass(frozen=True, slots=True)
class FilterOptions:
    """The position filter. What has the name of an ArduPilot parameter goes into its table; a PX4 has its own.

    Attributes:
        pos_m_nse: VISO_POS_M_NSE, the least sigma believed of a vision position, m.
        gate: EK3_POS_I_GATE / 100, sigmas.
        glitch_radius_m: EK3_GLITCH_RAD.
        viso_delay_ms: VISO_DELAY_MS; counts with ``stamps="jitter"``.
        quality_min: VISO_QUAL_MIN, per cent; -1 takes all.
        timeout_s: after which a position that keeps being refused is taken; more where a velocity is fused besides.
        stamps: how a measurement's capture time is had. PX4 does it by "timesync". ArduPilot does not: it answers
            TIMESYNC but stamps external navigation by the least delay seen lately (contract 2.6), which is "jitter".
            So for ArduPilot "timesync", the default, judges the fixes and our protocol, "jitter" what an untuned
            vehicle would make of them. What each way of sending comes to: docs/release.md.
        converged_after: PX4 believes stamps only after so many round trips of TIMESYNC (500, 50 s), and takes the time
            of arrival before. 0: it was synchronised before the flight began.
        offset_noise, drift_noise: of the filter's own model of its dead reckoning, m and m/s per root second.
    """

    pos_m_nse: float = 0.2
    gate: float = 5.0
    timeout_s: float = 7.0
    glitch_radius_m: float = 25.0
    viso_delay_ms: float = 10.0
    quality_min: int = 0
    stamps: Literal["timesync", "jitter"] = "timesync"
    converged_after: int = 500
    drift_noise: float = 0.10
    offset_noise: float = 0.10


@dataclass(frozen=True, slots=True)
class AutopilotOptions:
    """Who it is and how it errs.

    Attributes:
        stack, firmware: whose rules it follows, of which version (ArduPilot 4.5 to 4.8, PX4 1.14 to 1.18).
        set_up: "vision" has the parameters that the daemon's documentation asks for, "stock" those of the firmware.
        parameters: set over those, by name.
        switching: how ArduPilot changes its source set. "script": to the first set with GNSS while there is a fix, else
            to the first with vision, as a Lua script does; "command": only by MAV_CMD_SET_EKF_SOURCE_SET, which also
            ends the script's doing.
        origin: whether GNSS set the EKF origin before the flight, or it waits to be told one.
        gimbal: the one that it speaks for, if any.
        boot_offset_ns: its clock where the owner's begins.
    """

    seed: int = 3
    system_id: int = 1
    firmware: Version = (4, 8, 0)
    sensors: SensorOptions = field(default_factory=SensorOptions)
    filter: FilterOptions = field(default_factory=FilterOptions)
    # Boot long before the companion's clock began, so that nobody gets by without relating the two.
    boot_offset_ns: int = 86_400 * _S + 123_456_789
    streams_by_default: bool = False
    gimbal: GimbalOptions | None = None
    stack: Stack = "ardupilot"
    set_up: Literal["vision", "stock"] = "vision"
    parameters: Mapping[str, int | float] = field(default_factory=dict)
    switching: Literal["script", "command"] = "script"
    origin: Literal["gnss", "none"] = "gnss"

    def __post_init__(self) -> None:
        oldest, newest = KNOWN[self.stack]
        if not oldest <= self.firmware[:2] <= newest:
            raise ValueError(
                f"firmware {'.'.join(map(str, self.firmware))} of {self.stack} is not simulated; its rules are known "
                f"from {oldest[0]}.{oldest[1]} to {newest[0]}.{newest[1]}"
            )
        if self.stack == "px4" and self.filter.stamps != "timesync":
            raise ValueError(f"filter.stamps is {self.filter.stamps!r}, which only ArduPilot has; PX4 has 'timesync'")
