"""Reading how the computer fares: from texts as Linux writes them, and from a tree of files."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from ortholoc_edge.adapters import computer
from ortholoc_edge.adapters.computer import ComputerReader, ComputerStatus
from ortholoc_edge.adapters.mavlink.estimates import VisionEstimate
from ortholoc_edge.adapters.mavlink.status import encode_onboard_computer_status, encode_quality

STAT = """cpu  400 0 200 1400 20 0 10 0 0 0
cpu0 200 0 100 700 10 0 5 0 0 0
cpu1 200 0 100 700 10 0 5 0 0 0
intr 12345 0 0
"""
LATER = """cpu  500 0 200 1500 20 0 10 0 0 0
cpu0 275 0 100 725 10 0 5 0 0 0
cpu1 225 0 100 760 25 0 5 0 0 0
"""


def test_load_is_what_was_busy_in_between():
    before, now = computer.parse_cpu_times(STAT), computer.parse_cpu_times(LATER)
    assert before["cpu0"] == (305, 1015) and "cpu" not in before
    # 75 of 100 jiffies; 25 of 100, the wait for a disk not counted.
    assert computer.cpu_percent(before, now) == (75.0, 25.0)
    assert computer.cpu_percent({}, now) == () and computer.cpu_percent(now, now) == ()
    assert computer.parse_cpu_times("") == {} and computer.parse_cpu_times("cpu0 1 2\n\n") == {}


def test_memory_temperature_and_throttling():
    text = "MemTotal:       4096000 kB\nMemFree:  100 kB\nMemAvailable:   1024000 kB\nHuge:\nOdd: x kB\n"
    assert computer.parse_memory_mib(text) == (3000, 4000)
    assert computer.parse_memory_mib("") == (0, 0)
    assert computer.parse_temperature_c("84700\n") == 84.7
    assert computer.parse_temperature_c("") is None and computer.parse_temperature_c("-274000") is None
    # What was once (bit 16 and up) is not what is.
    assert computer.parse_pi_throttled("50000\n") == (False, False, False)
    assert computer.parse_pi_throttled("50005") == (True, True, False)
    assert computer.parse_pi_throttled("8") == (False, True, True)
    assert computer.parse_pi_throttled("volt=?") == (False, False, False)


def lay(root, files: dict[str, str]) -> None:
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def test_reader_takes_what_there_is(tmp_path):
    reader = ComputerReader(tmp_path)
    assert reader.read() == ComputerStatus((), 0, 0, (), False, False, False)
    lay(
        tmp_path,
        {
            "proc/stat": STAT,
            "proc/meminfo": "MemTotal: 2048 kB\nMemAvailable: 1024 kB\n",
            "sys/class/thermal/thermal_zone0/temp": "61250\n",
            "sys/class/thermal/thermal_zone0/type": "CPU-therm\n",
            # As a Jetson has it: no sensor behind it.
            "sys/class/thermal/thermal_zone2/temp": "100000\n",
            "sys/class/thermal/thermal_zone2/type": "PMIC-Die\n",
            "sys/class/thermal/thermal_zone1/temp": "broken\n",
            "sys/class/thermal/cooling_device0/type": "cpufreq-cpu0\n",
            "sys/class/thermal/cooling_device0/cur_state": "0\n",
            "sys/class/thermal/cooling_device1/type": "pwm-fan\n",
            "sys/class/thermal/cooling_device1/cur_state": "3\n",
        },
    )
    assert reader.read() == ComputerStatus((), 1, 2, (61.25, 100.0), False, False, False, processor_c=61.25)
    (tmp_path / "sys/class/thermal/thermal_zone0/type").write_text("acpitz\n")
    assert reader.read().processor_c is None, "no zone says that it is the processor's"
    (tmp_path / "sys/class/thermal/thermal_zone1/temp").write_text("48000\n")
    (tmp_path / "sys/class/thermal/thermal_zone1/type").write_text("x86_pkg_temp\n")
    lay(
        tmp_path,
        {
            "proc/stat": LATER,
            "sys/class/thermal/cooling_device0/cur_state": "2\n",
            "sys/class/hwmon/hwmon1/in0_lcrit_alarm": "1\n",
        },
    )
    status = reader.read()
    assert status == ComputerStatus((75.0, 25.0), 1, 2, (61.25, 48.0, 100.0), True, True, True, processor_c=48.0)
    assert status.load_percent == 50.0 and ComputerStatus((), 0, 0, (), False, False, False).load_percent is None


def test_reader_on_this_machine():
    reader = ComputerReader()
    first = reader.read()
    assert first.memory_total_mib > first.memory_used_mib > 0


def decoded(message):
    (got,) = dialect.MAVLink(None, 0, 0).parse_buffer(message.pack(dialect.MAVLink(None, 1, 197)))
    return got


def test_status_as_the_other_side_reads_it():
    status = ComputerStatus((75.4, 100.0), 3000, 4000, (84.7, -3.0), True, True, False)
    got = decoded(encode_onboard_computer_status(status, 90_000_000_000))
    assert got.get_type() == "ONBOARD_COMPUTER_STATUS"
    assert (got.time_usec, got.uptime, got.ram_usage, got.ram_total) == (90_000_000, 90_000, 3000, 4000)
    assert got.cpu_cores == [75, 100] + [255] * 6 and got.temperature_core == [85, -3] + [127] * 6
    assert got.status_flags == 1 | 2 and got.temperature_board == 127 and got.fan_speed == [32767] * 4
    # More cores than there is room for, and a wrap of the 32 bits of uptime.
    many = ComputerStatus((1.0,) * 12, 0, 0, (500.0,) * 9, False, False, True)
    got = decoded(encode_onboard_computer_status(many, (2**32 + 7) * 1_000_000))
    assert len(got.cpu_cores) == 8 and got.uptime == 7 and got.temperature_core == [126] * 8 and got.status_flags == 4


def test_quality_as_the_other_side_reads_it():
    covariance = np.diag([4.0, 9.0, 1.0, 0.01, 0.01, 0.01])
    # Carried on to now: its age is that of the frame.
    estimate = VisionEstimate(1_240_000_000, np.zeros(3), np.eye(3), covariance, 0, 0.75)
    got = {m.name: m.value for m in map(decoded, encode_quality(estimate, 1_000_000_000, 1_250_000_000))}
    assert got == {"VisQuality": 0.75, "VisSigma": pytest.approx(3.0), "VisAge": 0.25}
    assert not any(math.isnan(v) for v in got.values()) and all(len(name) <= 10 for name in got)
