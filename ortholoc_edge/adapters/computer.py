"""How the computer fares that we run on: load, memory, heat, throttling; read from /proc and /sys of Linux."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

# Bits of the Raspberry Pi's get_throttled that are true now; from bit 16 on they say "since the start".
_PI_UNDER_VOLTAGE, _PI_FREQUENCY_CAPPED, _PI_THROTTLED, _PI_SOFT_LIMIT = 1, 2, 4, 8
# Parts of thermal zones' names on a Raspberry Pi (cpu-thermal), a Jetson (CPU-therm, cpu-thermal, soc0-thermal), other
# ARM boards and x86 (x86_pkg_temp).
_PROCESSOR_ZONES = ("cpu", "soc", "pkg")
_PI_THROTTLED_FILE = "sys/devices/platform/soc/soc:firmware/get_throttled"


@dataclass(frozen=True, slots=True)
class ComputerStatus:
    """At one time.

    Attributes:
        cpu_percent: (cores,) since the reading before; empty at the first.
        memory_used_mib, memory_total_mib: used is what can't be had without swapping.
        temperatures_c: of the thermal zones that can be read, in their order.
        is_under_voltage, is_throttled, is_hot: as the board says it now; False where it says nothing.
        processor_c: of the hottest zone that is the processor's by its name; None where none is. Other zones may be hot
            for good (Jetsons have one that always says 100 degrees).
    """

    cpu_percent: tuple[float, ...]
    memory_used_mib: int
    memory_total_mib: int
    temperatures_c: tuple[float, ...]
    is_under_voltage: bool
    is_throttled: bool
    is_hot: bool
    processor_c: float | None = None

    @property
    def load_percent(self) -> float | None:
        """Of all cores together; None at the first reading."""
        return sum(self.cpu_percent) / len(self.cpu_percent) if self.cpu_percent else None

    @property
    def is_strained(self) -> bool:
        """Hot, or slowed down by what less work would cure; of a weak supply it would not."""
        return self.is_hot or (self.is_throttled and not self.is_under_voltage)


def parse_cpu_times(stat: str) -> dict[str, tuple[int, int]]:
    """(busy, all) jiffies of each core, by its name in /proc/stat, "cpu3" say."""
    times = {}
    for line in stat.splitlines():
        name, *rest = line.split() or [""]
        if name.startswith("cpu") and name != "cpu" and len(rest) >= 5:
            # Guest time is in user time already; waiting for a disk is idle.
            values = [int(v) for v in rest[:8]]
            times[name] = sum(values) - values[3] - values[4], sum(values)
    return times


def cpu_percent(before: dict[str, tuple[int, int]], now: dict[str, tuple[int, int]]) -> tuple[float, ...]:
    """Of the cores that both know; one that did not count on in between is left out."""
    both = [(before[name], now[name]) for name in now if name in before]
    return tuple(100.0 * max(0, b[0] - a[0]) / (b[1] - a[1]) for a, b in both if b[1] > a[1])


def parse_memory_mib(meminfo: str) -> tuple[int, int]:
    """(used, total); zeros where the file does not tell."""
    kib = {}
    for line in meminfo.splitlines():
        name, _, rest = line.partition(":")
        with contextlib.suppress(ValueError, IndexError):
            kib[name] = int(rest.split()[0])
    total = kib.get("MemTotal", 0)
    return (total - kib.get("MemAvailable", total)) // 1024, total // 1024


def parse_temperature_c(text: str) -> float | None:
    """Of a thermal zone, in thousandths of a degree; None for what no computer in use has."""
    try:
        value = int(text) / 1e3
    except ValueError:
        return None
    return value if -60.0 < value < 150.0 else None


def parse_pi_throttled(text: str) -> tuple[bool, bool, bool]:
    """(under voltage, throttled, hot) now, of the firmware's hexadecimal word."""
    try:
        word = int(text.strip(), 16)
    except ValueError:
        return False, False, False
    hot = bool(word & _PI_SOFT_LIMIT)
    return bool(word & _PI_UNDER_VOLTAGE), bool(word & (_PI_FREQUENCY_CAPPED | _PI_THROTTLED)) or hot, hot


def resident_mib(root: Path = Path("/")) -> float:
    """Memory of this process that is in RAM; 0 where /proc does not tell."""
    try:
        pages = int((root / "proc/self/statm").read_text(encoding="ascii").split()[1])
    except (OSError, ValueError, IndexError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


class ComputerReader:
    """Reads a `ComputerStatus`. Sensors may hold a read for some milliseconds, so not in the link's thread."""

    def __init__(self, root: Path = Path("/")) -> None:
        self._root = root
        self._times: dict[str, tuple[int, int]] = {}

    def read(self) -> ComputerStatus:
        """What can't be read is left out, or told as zero or False; nothing raises."""
        times = parse_cpu_times(self._text("proc/stat"))
        busy = cpu_percent(self._times, times)
        self._times = times
        used, total = parse_memory_mib(self._text("proc/meminfo"))
        zones = self._temperatures_c()
        under_voltage, throttled, hot = parse_pi_throttled(self._text(_PI_THROTTLED_FILE))
        slowed = self._is_cpu_slowed_for_heat()
        return ComputerStatus(
            busy,
            used,
            total,
            tuple(celsius for _, celsius in zones),
            under_voltage or any(text.strip() == "1" for text in self._texts("sys/class/hwmon", "*/in0_lcrit_alarm")),
            throttled or slowed,
            hot or slowed,
            max((celsius for kind, celsius in zones if any(name in kind for name in _PROCESSOR_ZONES)), default=None),
        )

    def _temperatures_c(self) -> list[tuple[str, float]]:
        """The zones' kinds, in small letters, and what they say."""
        found = []
        for zone in sorted((self._root / "sys/class/thermal").glob("thermal_zone*")):
            celsius = parse_temperature_c(self._text_of(zone / "temp"))
            if celsius is not None:
                found.append((self._text_of(zone / "type").lower(), celsius))
        return found

    def _is_cpu_slowed_for_heat(self) -> bool:
        """Whether the kernel's thermal governor holds a CPU's clock down: its cooling device is not at zero."""
        for device in sorted((self._root / "sys/class/thermal").glob("cooling_device*")):
            kind, state = (self._text_of(device / name).strip() for name in ("type", "cur_state"))
            if kind.lower().startswith(("cpufreq", "thermal-cpufreq", "processor")) and state not in ("", "0"):
                return True
        return False

    def _text(self, path: str) -> str:
        return self._text_of(self._root / path)

    def _texts(self, folder: str, pattern: str) -> Iterable[str]:
        return (self._text_of(path) for path in sorted((self._root / folder).glob(pattern)))

    @staticmethod
    def _text_of(path: Path) -> str:
        try:
            return path.read_text(encoding="ascii", errors="replace")
        except OSError:
            return ""
