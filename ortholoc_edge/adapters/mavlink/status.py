"""What is said of ourselves to ground stations and logs, as MAVLink messages; pure functions."""

from __future__ import annotations

from ortholoc_edge.adapters.computer import ComputerStatus
from ortholoc_edge.adapters.mavlink.codec import MavlinkMessage, dialect
from ortholoc_edge.adapters.mavlink.estimates import VisionEstimate, horizontal_sigma_m

_U8, _U32, _I8, _I16 = 2**8 - 1, 2**32 - 1, 2**7 - 1, 2**15 - 1
_MS = 1_000_000


def encode_onboard_computer_status(status: ComputerStatus, now_ns: int) -> MavlinkMessage:
    """ONBOARD_COMPUTER_STATUS. What is not known carries the field's highest value, as the definition has it; uptime
    is of the computer, from whose start the monotonic clock counts."""
    cores = [min(100, round(value)) for value in status.cpu_percent[:8]]
    heat = [max(-128, min(_I8 - 1, round(value))) for value in status.temperatures_c[:8]]
    flags = (
        dialect.COMPUTER_STATUS_FLAGS_UNDER_VOLTAGE * status.is_under_voltage
        | dialect.COMPUTER_STATUS_FLAGS_CPU_THROTTLE * status.is_throttled
        | dialect.COMPUTER_STATUS_FLAGS_THERMAL_THROTTLE * status.is_hot
    )
    return dialect.MAVLink_onboard_computer_status_message(
        time_usec=now_ns // 1000,
        uptime=now_ns // _MS % 2**32,
        type=0,  # a mission computer, primary
        cpu_cores=cores + [_U8] * (8 - len(cores)),
        cpu_combined=[_U8] * 10,
        gpu_cores=[_U8] * 4,
        gpu_combined=[_U8] * 10,
        temperature_board=_I8,
        temperature_core=heat + [_I8] * (8 - len(heat)),
        fan_speed=[_I16] * 4,
        ram_usage=status.memory_used_mib,
        ram_total=status.memory_total_mib,
        storage_type=[_U32] * 4,
        storage_usage=[_U32] * 4,
        storage_total=[_U32] * 4,
        link_type=[_U32] * 6,
        link_tx_rate=[_U32] * 6,
        link_rx_rate=[_U32] * 6,
        link_tx_max=[_U32] * 6,
        link_rx_max=[_U32] * 6,
        status_flags=flags,
    )


def encode_quality(estimate: VisionEstimate, capture_ns: int, now_ns: int) -> list[MavlinkMessage]:
    """NAMED_VALUE_FLOAT, three of them, for plots beside a flight log: quality 0..1, horizontal 1-sigma in m and age
    in s (since the frame was taken) of the last estimate that was sent."""
    values = {
        "VisQuality": estimate.quality,
        "VisSigma": horizontal_sigma_m(estimate),
        "VisAge": (now_ns - capture_ns) / 1e9,
    }
    return [
        dialect.MAVLink_named_value_float_message(
            time_boot_ms=now_ns // _MS % 2**32, name=name.encode("ascii"), value=value
        )
        for name, value in values.items()
    ]
