"""A simulated autopilot: its sensors, its position filter, and what it says and hears in MAVLink 2.

`AutopilotCore` is a step function: boot time and truth go in, messages come out; it does no I/O and reads no clock.
It follows one of two firmwares: `ardupilot.ArduPilot` and `px4.Px4` transcribe what each makes of an external position,
version by version, and say of each message what became of it (`VisionRecord`). A `Port` carries the messages.

What is simplified is said in each module. In common: dead reckoning is integrated from accelerometers and an attitude
that err, and corrected by an offset and a drift per axis, not by 24 states.
"""

from ortholoc_sim.autopilot.ardupilot import position_sigma_m
from ortholoc_sim.autopilot.core import AutopilotCore
from ortholoc_sim.autopilot.dialect import Message, dialect
from ortholoc_sim.autopilot.gimbal import GimbalOptions
from ortholoc_sim.autopilot.options import Airframe, AutopilotOptions, FilterOptions
from ortholoc_sim.autopilot.ports import Port, PtyPort, TcpPort, UdpPort
from ortholoc_sim.autopilot.position_filter import PositionFilter
from ortholoc_sim.autopilot.records import Verdict, VisionRecord
from ortholoc_sim.autopilot.sensors import SensorOptions

__all__ = [
    "Airframe",
    "AutopilotCore",
    "AutopilotOptions",
    "FilterOptions",
    "GimbalOptions",
    "Message",
    "Port",
    "PositionFilter",
    "PtyPort",
    "SensorOptions",
    "TcpPort",
    "UdpPort",
    "Verdict",
    "VisionRecord",
    "dialect",
    "position_sigma_m",
]
