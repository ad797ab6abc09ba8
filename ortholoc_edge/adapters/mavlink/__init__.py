"""The link to the autopilot: MAVLink 2 over UDP, TCP or a serial line.

Layers, from the wire up: `transport` moves bytes, `codec` turns them into messages, `protocol` knows what to say and
`telemetry` what was heard of the vehicle, without doing I/O or reading a clock, and `link` owns the one thread that
does both.
"""

from ortholoc_edge.adapters.mavlink.codec import MavlinkMessage
from ortholoc_edge.adapters.mavlink.gimbal import GimbalSelection
from ortholoc_edge.adapters.mavlink.link import AutopilotLink
from ortholoc_edge.adapters.mavlink.operator import GivenPlace
from ortholoc_edge.adapters.mavlink.options import LinkOptions, Severity, SystemStatus
from ortholoc_edge.adapters.mavlink.protocol import Statistic
from ortholoc_edge.adapters.mavlink.state import AutopilotIdentity, AutopilotState, GnssPosition

__all__ = [
    "AutopilotIdentity", "AutopilotLink", "AutopilotState", "GimbalSelection", "GivenPlace", "GnssPosition",
    "LinkOptions", "MavlinkMessage", "Severity", "Statistic", "SystemStatus",
]  # fmt: skip
