"""Less detail, then fewer frames, where the computer does not keep up or gets hot; more again when there is room.

Rungs go from 0, all of it, down: first those of detail (resolution and number of features, `Localizer.rungs`), then, at
the least detail, those of rate. Frames that take too long step down in detail only: fewer of them would come no sooner.
A busy computer does so, too. Heat goes down to the last rung: what is not computed warms nothing.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from dataclasses import dataclass
from enum import Enum
from statistics import fmean, median
from typing import Annotated

from msgspec import Meta, Struct

logger = logging.getLogger(__name__)

_S = 1_000_000_000

# Frames whose median decides for a step down, and of which all but some must leave room for a step up: a search now
# and then must not keep detail out. Slow to rise: a processor that was throttled for heat heats up again.
_FRAMES_DOWN, _FRAMES_UP, _WITHOUT_ROOM = 5, 50, 5
# Of the budget, what these frames may take at most before the next one up is tried, which takes up to 1.6 times
# as long (docs/studies/structural.md).
_ROOM = 0.55
# Readings of the computer, one a second: so many hot ones in a row, or the mean of so many loads. A step cools slowly.
_HOT_READINGS, _LOADS = 3, 5
_HEAT_AGAIN_NS = 10 * _S
# Below the limit by which load is too much, in per cent of all cores, before more is asked of them.
_LOAD_MARGIN = 15.0
# After any step, before one up. A rung that had to be left again within the trial is tried the next time after twice as
# long: what its detail costs in time and heat is only known on it, and where that is too much nothing may swing.
_WAIT_NS, _MOST_WAIT_NS = 10 * _S, 640 * _S
_TRIAL_NS = 600 * _S
_KEPT_STEPS = 32


class LadderOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The ``[ladder]`` table: what besides ``[timing] budget_ms`` takes detail and frames, and what gives them back.

    Attributes:
        rates_hz: how many frames a second are localized at most on the rungs below the least detail; falling. Between
            fixes the autopilot is told the last one carried on, for `LinkOptions.max_repeat_s`.
        hot_c: a processor this hot, or one that is throttled, steps down. cool_c: it must be no hotter to step up.
        max_load_percent: of all cores together; a busier computer steps down in detail. 100: none ever is.
    """

    rates_hz: tuple[Annotated[float, Meta(gt=0, le=1000)], ...] = (5.0, 2.0)
    hot_c: Annotated[float, Meta(ge=0, le=150)] = 78.0
    cool_c: Annotated[float, Meta(ge=0, le=150)] = 70.0
    max_load_percent: Annotated[float, Meta(gt=0, le=100)] = 95.0

    def __post_init__(self) -> None:
        if list(self.rates_hz) != sorted(set(self.rates_hz), reverse=True):
            raise ValueError(f"rates_hz = {list(self.rates_hz)} must fall from each rung to the next")
        if self.cool_c >= self.hot_c:
            raise ValueError(f"cool_c = {self.cool_c} must be below hot_c = {self.hot_c}, or the ladder swings")


@dataclass(frozen=True, slots=True)
class Strain:
    """The computer, at one time.

    Attributes:
        load_percent: of all cores together; None: not known. processor_c: None where no sensor is the processor's.
        throttled: its clock is held down.
    """

    load_percent: float | None = None
    processor_c: float | None = None
    throttled: bool = False


class Cause(Enum):
    """Why a step was taken."""

    TIME = "time"
    LOAD = "load"
    HEAT = "heat"
    ROOM = "room"
    RELOAD = "reload"


@dataclass(frozen=True, slots=True)
class Step:
    """From one rung to another.

    Attributes:
        rung, was: now and before. why: for people, with the numbers.
        rate_hz: frames a second at most from now on; None: all.
    """

    stamp_ns: int
    rung: int
    was: int
    cause: Cause
    why: str
    rate_hz: float | None


class Ladder:
    """Which rung keeps frames within a budget and the computer cool. Used by one thread.

    Args:
        details: how many rungs of detail there are.
        budget_ms: wall time that a frame may take; None or infinite: any, and the rung stays 0 whatever the computer
            suffers, since a replay must be the same everywhere.
    """

    def __init__(self, details: int, budget_ms: float | None, options: LadderOptions | None = None) -> None:
        self._details, self._options = details, options or LadderOptions()
        self._budget_ms = budget_ms if budget_ms is not None and math.isfinite(budget_ms) else None
        self._rung = 0
        self._took_ms: deque[float] = deque(maxlen=_FRAMES_UP)
        self._loads: deque[float] = deque(maxlen=_LOADS)
        self._strain, self._hot_readings = Strain(), 0
        self._stepped_ns: int | None = None
        # Of each rung: when it was last reached from below, and how long to wait before that is tried.
        self._raised_ns: dict[int, int] = {}
        self._wait_ns: dict[int, int] = {}
        self._due_ns: int | None = None
        self._steps: deque[Step] = deque(maxlen=_KEPT_STEPS)
        self._last_step: Step | None = None

    @property
    def rung(self) -> int:
        return self._rung

    @property
    def rungs(self) -> int:
        """How many there are."""
        return self._details + len(self._options.rates_hz)

    @property
    def details(self) -> int:
        """How many of them, the first, are of detail."""
        return self._details

    @property
    def detail(self) -> int:
        """The rung of detail, for `Localizer.localize`."""
        return min(self._rung, self._details - 1)

    @property
    def rate_hz(self) -> float | None:
        """How many frames a second are localized at most; None: all that there is time for."""
        reduced = self._rung - self._details
        return self._options.rates_hz[reduced] if reduced >= 0 else None

    @property
    def budget_ms(self) -> float | None:
        """Of a frame; None: any."""
        return self._budget_ms

    @property
    def last_step(self) -> Step | None:
        """None before the first."""
        return self._last_step

    def take_steps(self) -> list[Step]:
        """Those that were not taken yet, to be told."""
        taken = list(self._steps)
        self._steps.clear()
        return taken

    def allow(self, budget_ms: float, options: LadderOptions, now_ns: int) -> None:
        """Other limits from now on. A ladder that has no budget gets none."""
        self._options = options
        if self._budget_ms is not None:
            self._budget_ms = budget_ms
        if self._rung > self.rungs - 1:
            self._step(self.rungs - 1 - self._rung, Cause.RELOAD, "there are fewer rungs", now_ns)

    def is_due(self, stamp_ns: int) -> bool:
        """Whether a frame is to be localized at the present rate; frames' stamps rise."""
        rate_hz = self.rate_hz
        if rate_hz is None:
            self._due_ns = None
            return True
        if self._due_ns is not None and stamp_ns < self._due_ns:
            return False
        # On the raster, so that the camera's own does not make it slower; but no two at once after a pause.
        period_ns = round(_S / rate_hz)
        following_ns = stamp_ns if self._due_ns is None else self._due_ns
        self._due_ns = following_ns + period_ns if stamp_ns - following_ns < period_ns else stamp_ns + period_ns
        return True

    def note(self, took_ms: float, now_ns: int) -> None:
        """A frame on the present rung took so long."""
        if self._budget_ms is None:
            return
        self._took_ms.append(took_ms)
        if self._rung < self._details - 1 and len(self._took_ms) >= _FRAMES_DOWN:
            middle_ms = median(list(self._took_ms)[-_FRAMES_DOWN:])
            if middle_ms > self._budget_ms:
                why = f"frames take {middle_ms:.0f} ms, {self._budget_ms:.0f} are allowed"
                self._step(1, Cause.TIME, why, now_ns)
                return
        self._rise(now_ns)

    def observe(self, strain: Strain, now_ns: int) -> None:
        """How the computer fares; to be told once a second."""
        if self._budget_ms is None:
            return
        self._strain = strain
        if strain.load_percent is not None:
            self._loads.append(strain.load_percent)
        self._hot_readings = self._hot_readings + 1 if self._is_hot() else 0
        if self._hot_readings >= _HOT_READINGS and self._rung < self.rungs - 1:
            if self._stepped_ns is None or now_ns - self._stepped_ns >= _HEAT_AGAIN_NS:
                self._step(1, Cause.HEAT, self._heat(), now_ns)
            return
        if len(self._loads) == _LOADS and self._rung < self._details - 1:
            load = fmean(self._loads)
            if load > self._options.max_load_percent:
                self._step(1, Cause.LOAD, f"processor busy to {load:.0f} %", now_ns)
                return
        self._rise(now_ns)

    def _is_hot(self) -> bool:
        celsius = self._strain.processor_c
        return self._strain.throttled or (celsius is not None and celsius >= self._options.hot_c)

    def _heat(self) -> str:
        celsius = self._strain.processor_c
        words = "processor throttled" if self._strain.throttled else "processor hot"
        return words if celsius is None else f"{words}, {celsius:.0f} C"

    def _rise(self, now_ns: int) -> None:
        """Step up if everything leaves room for it."""
        if self._rung == 0:
            return
        target = self._rung - 1
        if self._stepped_ns is not None and now_ns - self._stepped_ns < self._wait_ns.get(target, _WAIT_NS):
            return
        celsius = self._strain.processor_c
        if self._strain.throttled or (celsius is not None and celsius > self._options.cool_c):
            return
        if self._loads and fmean(self._loads) > self._options.max_load_percent - _LOAD_MARGIN:
            return
        if self._rung >= self._details:
            self._step(-1, Cause.ROOM, "processor cool again", now_ns)
            return
        if self._budget_ms is None or len(self._took_ms) < _FRAMES_UP:
            return
        most_ms = sorted(self._took_ms)[-1 - _WITHOUT_ROOM]
        if most_ms < _ROOM * self._budget_ms:
            self._step(-1, Cause.ROOM, f"nine of ten frames took {most_ms:.0f} ms at most", now_ns)

    def _step(self, change: int, cause: Cause, why: str, now_ns: int) -> None:
        was, self._rung = self._rung, self._rung + change
        if change < 0:
            self._raised_ns[self._rung] = now_ns
        elif (raised_ns := self._raised_ns.pop(was, None)) is not None:
            failed = now_ns - raised_ns < _TRIAL_NS
            self._wait_ns[was] = min(2 * self._wait_ns.get(was, _WAIT_NS), _MOST_WAIT_NS) if failed else _WAIT_NS
        self._stepped_ns = now_ns
        # What the other rung took says nothing about this one.
        self._took_ms.clear()
        self._loads.clear()
        self._last_step = Step(now_ns, self._rung, was, cause, why, self.rate_hz)
        self._steps.append(self._last_step)
        rate = "" if self.rate_hz is None else f", {self.rate_hz:g} frames a second"
        logger.warning(
            "%s, rung %d of %d%s: %s",
            "less" if change > 0 else "more", self._rung, self.rungs - 1, rate, why,
        )  # fmt: skip
