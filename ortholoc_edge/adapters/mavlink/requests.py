"""What others ask of us over MAVLink: to look for the vehicle where somebody knows it to be, a pilot by landmarks, say.

MAV_CMD_EXTERNAL_POSITION_ESTIMATE to our own system and component; the same command goes to autopilots, from us too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from ortholoc_edge.adapters.mavlink.codec import MavlinkMessage, dialect

COMMAND = dialect.MAV_CMD_EXTERNAL_POSITION_ESTIMATE
# Of who does not say how sure it is, m.
_UNSAID_SIGMA_M = 50.0
_SIGMAS_M = (1.0, 20_000.0)
_UNSET = 2**31 - 1


@dataclass(frozen=True, slots=True)
class PositionRequest:
    """Where somebody says that the vehicle is.

    Attributes:
        lat_deg, lon_deg: WGS 84. sigma_m: horizontal 1-sigma per axis.
        system, component: who asks, and is to be answered.
    """

    lat_deg: float
    lon_deg: float
    sigma_m: float
    system: int
    component: int


def position_request(message: MavlinkMessage, system: int, component: int) -> PositionRequest | None:
    """The request that a message is, if it is one to us.

    Args:
        system, component: ours; system 0 as long as it is not known, when nothing can be meant for us. A command to all
            is meant for the autopilot.
    Raises: ValueError for one that can't be: no place on the earth, or none that is as near as it says.
    """
    kind = message.get_type()
    if kind not in ("COMMAND_INT", "COMMAND_LONG") or message.command != COMMAND:
        return None
    if system == 0 or (message.target_system, message.target_component) != (system, component):
        return None
    if kind == "COMMAND_INT":
        if _UNSET in (message.x, message.y):
            raise ValueError("no latitude and longitude")
        lat_deg, lon_deg = message.x * 1e-7, message.y * 1e-7
    else:
        # Single precision: a metre or two.
        lat_deg, lon_deg = float(message.param5), float(message.param6)
    # A comparison with NaN is false.
    if not (abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0):
        raise ValueError(f"latitude {lat_deg:g}, longitude {lon_deg:g}")
    sigma_m = _UNSAID_SIGMA_M if math.isnan(message.param3) else float(message.param3)
    low_m, high_m = _SIGMAS_M
    if not 0.0 <= sigma_m <= high_m:
        raise ValueError(f"an accuracy of {sigma_m:g} m")
    return PositionRequest(lat_deg, lon_deg, max(sigma_m, low_m), message.get_srcSystem(), message.get_srcComponent())


def acknowledgement(system: int, component: int, accepted: bool) -> MavlinkMessage:
    """The answer to who asked."""
    result = dialect.MAV_RESULT_ACCEPTED if accepted else dialect.MAV_RESULT_DENIED
    return dialect.MAVLink_command_ack_message(
        command=COMMAND, result=result, target_system=system, target_component=component
    )
