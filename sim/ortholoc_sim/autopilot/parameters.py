"""The autopilot's parameters: which ones each firmware has, as they come from the factory and as vision wants them, and
MAVLink's protocol for them, which each stack speaks in its own way.

ArduPilot casts every number to the float of the message, PX4 copies the four bytes of its integers there; ArduPilot
takes a value of any type, PX4 only its own. Neither answers for a name that it does not have.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from typing import Any

from ortholoc_sim.autopilot.dialect import Message, dialect
from ortholoc_sim.autopilot.options import AutopilotOptions, FilterOptions, Stack, Version

Number = int | float

_NAME_BYTES = 16
_REQUESTED_BY_NAME = 65535
# One answer to PARAM_REQUEST_LIST each: 37 bytes, so that a list does not choke a line.
_LIST_INTERVAL_NS = 10_000_000


def _ardupilot(version: Version, filter_options: FilterOptions, vision: bool) -> dict[str, Number]:
    """An int is an integer parameter, a float a real one."""
    sources = {
        f"EK3_SRC{n}_{what}": value
        for n, posxy, velxy, velz in ((1, 3, 3, 3), (2, 0, 0, 0), (3, 0, 0, 0))
        for what, value in (("POSXY", posxy), ("VELXY", velxy), ("POSZ", 1), ("VELZ", velz), ("YAW", 1))
    }
    # Renamed when more than two receivers came (4.6), and when the ids of MAVLink got a prefix of their own (4.7).
    receivers = ("GPS1_TYPE", "GPS2_TYPE", "GPS1_DELAY_MS", "GPS2_DELAY_MS")
    if version < (4, 6, 0):
        receivers = ("GPS_TYPE", "GPS_TYPE2", "GPS_DELAY_MS", "GPS_DELAY_MS2")
    own_id = "MAV_SYSID" if version >= (4, 7, 0) else "SYSID_THISMAV"
    table: dict[str, Number] = {
        own_id: 1,
        "AHRS_EKF_TYPE": 3,
        "EK3_ENABLE": 1,
        "EK3_GLITCH_RAD": round(filter_options.glitch_radius_m),
        "EK3_POS_I_GATE": round(100.0 * filter_options.gate),
        "EK3_POSNE_M_NSE": 0.5,
        "EK3_VELNE_M_NSE": 0.3,
        "EK3_SRC_OPTIONS": 1,
        **sources,
        "VISO_TYPE": 0,
        "VISO_DELAY_MS": round(filter_options.viso_delay_ms),
        "VISO_ORIENT": 0,
        "VISO_SCALE": 1.0,
        "VISO_POS_X": 0.0,
        "VISO_POS_Y": 0.0,
        "VISO_POS_Z": 0.0,
        "VISO_POS_M_NSE": filter_options.pos_m_nse,
        "VISO_YAW_M_NSE": 0.2,
        "VISO_VEL_M_NSE": 0.1,
        "VISO_QUAL_MIN": filter_options.quality_min,
        receivers[0]: 1,
        receivers[1]: 0,
        receivers[2]: 0,
        receivers[3]: 0,
        **{f"RC{n}_OPTION": 0 for n in range(5, 17)},
        **{f"SERIAL{n}_PROTOCOL": protocol for n, protocol in enumerate((2, 2, 5, 5, -1, -1, -1), start=1)},
        **{f"SERIAL{n}_BAUD": baud for n, baud in enumerate((57, 57, 38, 38, 57, 57, 57), start=1)},
    }
    if vision:
        table |= {"VISO_TYPE": 1, "EK3_SRC2_POSXY": 6, "EK3_SRC_OPTIONS": 0, "RC8_OPTION": 90, "SERIAL2_BAUD": 921}
    return table


def _px4(version: Version, vision: bool) -> dict[str, Number]:
    slots = range(4) if version >= (1, 18, 0) else ()
    table: dict[str, Number] = {
        "MAV_SYS_ID": 1,
        "EKF2_EV_CTRL": 0,
        "EKF2_EV_DELAY": 0.0,
        "EKF2_EV_NOISE_MD": 0,
        "EKF2_EVP_NOISE": 0.1,
        "EKF2_EVV_NOISE": 0.1,
        "EKF2_EVA_NOISE": 0.1,
        "EKF2_EVP_GATE": 5.0,
        "EKF2_EVV_GATE": 3.0,
        "EKF2_EV_QMIN": 0,
        "EKF2_EV_POS_X": 0.0,
        "EKF2_EV_POS_Y": 0.0,
        "EKF2_EV_POS_Z": 0.0,
        "EKF2_HGT_REF": 1,
        "EKF2_DELAY_MAX": 200.0,
        "EKF2_GPS_CTRL": 7,
        "EKF2_GPS_P_NOISE": 0.5,
        "EKF2_GPS_P_GATE": 5.0,
        "EKF2_GPS_V_NOISE": 0.3,
        "EKF2_GPS_V_GATE": 5.0,
        "EKF2_NOAID_TOUT": 5_000_000,
        "EKF2_NOAID_NOISE": 10.0,
        "MAV_0_CONFIG": 101,
        "MAV_0_MODE": 0,
        "MAV_1_CONFIG": 0,
        "MAV_1_MODE": 2,
        "MAV_2_CONFIG": 0,
        "MAV_2_MODE": 0,
        "MAV_PROTO_VER": 0,
        "SER_TEL1_BAUD": 57600,
        "SER_TEL2_BAUD": 921600,
        **{
            f"EKF2_AGP{n}_{what}": value
            for n in slots
            for what, value in (("ID", 0), ("CTRL", 0), ("MODE", 0), ("DELAY", 0.0), ("NOISE", 1.0), ("GATE", 3.0))
        },
    }
    if (1, 15, 0) <= version < (1, 18, 0):  # one source, over ROS 2 alone
        table |= {"EKF2_AGP_CTRL": 0, "EKF2_AGP_DELAY": 0.0, "EKF2_AGP_NOISE": 0.9, "EKF2_AGP_GATE": 3.0}
    if vision:
        table |= {"EKF2_EV_CTRL": 1, "EKF2_HGT_REF": 0, "MAV_1_CONFIG": 102}
        table |= {"EKF2_AGP0_ID": 1, "EKF2_AGP0_CTRL": 1} if slots else {}
    return table


# What takes effect only when the autopilot starts again.
_AT_BOOT = {
    "ardupilot": ("VISO_TYPE", "VISO_DELAY_MS", "EK3_ENABLE", "GPS1_TYPE", "GPS2_TYPE", "GPS_TYPE", "GPS_TYPE2"),
    "px4": (
        "EKF2_EV_DELAY", "EKF2_HGT_REF", "EKF2_DELAY_MAX",
        *(f"EKF2_AGP{n}_{what}" for n in range(4) for what in ("ID", "DELAY")),
    ),
}  # fmt: skip


class Parameters(Mapping[str, Number]):
    """The table, as told to others; `active` is what the firmware goes by.

    Raises: ValueError for a value given of a name that this firmware does not have.
    """

    def __init__(self, options: AutopilotOptions) -> None:
        self._stack: Stack = options.stack
        vision = options.set_up == "vision"
        self._table = (
            _px4(options.firmware, vision)
            if options.stack == "px4"
            else _ardupilot(options.firmware, options.filter, vision)
        )
        for name in ("MAV_SYS_ID", "MAV_SYSID", "SYSID_THISMAV"):
            if name in self._table:
                self._table[name] = options.system_id
        for name, value in options.parameters.items():
            if name not in self._table:
                version = ".".join(map(str, options.firmware))
                raise ValueError(f"parameter {name} is not one that the simulated {options.stack} {version} has")
            self._table[name] = float(value) if isinstance(self._table[name], float) else round(value)
        self._at_boot: dict[str, Number] = {}
        self.reboot()

    def __getitem__(self, name: str) -> Number:
        return self._table[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._table)

    def __len__(self) -> int:
        return len(self._table)

    def set(self, name: str, value: Number) -> None:
        """Change one that there is."""
        self._table[name] = value

    def reboot(self) -> None:
        """All that was set is in effect."""
        self._at_boot = {name: self._table[name] for name in _AT_BOOT[self._stack] if name in self._table}

    def active(self, name: str) -> float:
        """The value in effect; 0 for what this firmware does not have."""
        return float(self._at_boot.get(name, self._table.get(name, 0)))


class ParameterServer:
    """Answers PARAM_REQUEST_READ, PARAM_REQUEST_LIST and PARAM_SET. One list at a time, and not at once."""

    def __init__(self, parameters: Parameters, stack: Stack) -> None:
        self.parameters = parameters
        self._bytewise = stack == "px4"
        self._names = sorted(parameters)
        self._listed: int | None = None
        self._next_ns = 0

    def handle(self, message: Message) -> list[Message]:
        """Of the three kinds, addressed to us."""
        kind = message.get_type()
        if kind == "PARAM_REQUEST_LIST":
            self._listed = 0
            return []
        name = self._asked(message)
        if name is None:
            return []
        if kind == "PARAM_SET":
            value = self._value(message, self.parameters[name])
            if value is None:
                return []
            self.parameters.set(name, value)
            return [self._tell(name, self._names.index(name))]
        by_index = message.param_index >= 0
        return [self._tell(name, message.param_index if by_index else _REQUESTED_BY_NAME)]

    def step(self, now_ns: int) -> list[Message]:
        """What of a list is due."""
        if self._listed is None or now_ns < self._next_ns:
            return []
        self._next_ns = now_ns + _LIST_INTERVAL_NS
        index = self._listed
        self._listed = index + 1 if index + 1 < len(self._names) else None
        return [self._tell(self._names[index], index)]

    def _asked(self, message: Message) -> str | None:
        if message.get_type() == "PARAM_REQUEST_READ" and message.param_index >= 0:
            return self._names[message.param_index] if message.param_index < len(self._names) else None
        name = message.param_id
        text = (name.decode("ascii", "replace") if isinstance(name, bytes) else str(name)).rstrip("\0")[:_NAME_BYTES]
        return text if text in self.parameters else None

    def _value(self, message: Message, old: Number) -> Number | None:
        """The number that the firmware would store; None where it refuses."""
        if self._bytewise:
            kind = dialect.MAV_PARAM_TYPE_INT32 if isinstance(old, int) else dialect.MAV_PARAM_TYPE_REAL32
            if message.param_type != kind:
                return None  # "param types mismatch"
            if isinstance(old, int):
                return int(struct.unpack("<i", _first_bytes(message))[0])
        value = float(message.param_value)
        if not math.isfinite(value):
            return None
        return round(value) if isinstance(old, int) else value

    def _tell(self, name: str, index: int) -> Message:
        value = self.parameters[name]
        if isinstance(value, float):
            kind, sent = dialect.MAV_PARAM_TYPE_REAL32, value
        elif self._bytewise:
            kind, sent = dialect.MAV_PARAM_TYPE_INT32, float(struct.unpack("<f", struct.pack("<i", value))[0])
        else:
            kind = dialect.MAV_PARAM_TYPE_INT8 if abs(value) < 128 else dialect.MAV_PARAM_TYPE_INT16
            sent = float(value)
        return dialect.MAVLink_param_value_message(
            param_id=name.encode(), param_value=sent, param_type=kind, param_count=len(self._names), param_index=index
        )


def _first_bytes(message: Message) -> bytes:
    """Of the payload, 4. As a float, an integer may be no number at all, so they are taken from the frame itself."""
    frame: Any = message.get_msgbuf()
    if not frame:  # never packed
        return struct.pack("<f", message.param_value)
    data = bytes(frame)
    header = 6 if data[0] == 0xFE else 10
    return data[header : header + data[1]].ljust(4, b"\0")[:4]
