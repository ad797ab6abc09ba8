"""The step that replay, simulation and flight share: predict, localize, learn."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from msgspec import Meta, Struct

from ortholoc_edge.pipeline.frame import Frame, VehicleState
from ortholoc_edge.pipeline.ladder import Ladder
from ortholoc_edge.pipeline.localizer import Localizer
from ortholoc_edge.pipeline.outcome import Outcome, Rejected
from ortholoc_edge.pipeline.prior import PosePrior
from ortholoc_edge.pipeline.tracker import Tracker


class TimingOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How old a fix may be, and how long it may take.

    ``max_age_ms``: from mid-exposure; what is older is not sent, and the search of a wide prior ends. ArduPilot takes
    data older than its buffer (250 ms and the delay it is told of) for newer than they are.
    ``budget_ms``: of a frame; structural matching takes less detail where frames take longer (load, heat), and more
    again when there is room. An autopilot wants five estimates in a second at least.
    """

    max_age_ms: Annotated[float, Meta(gt=0)] = 1000.0
    budget_ms: Annotated[float, Meta(gt=0)] = 200.0


class Navigator:
    """Localizer and tracker as one; used by one thread.

    Attributes:
        localizer, tracker: the two.
        ladder: how much detail there is time for.
        prior: the prediction for the last frame; None if there was none.
    """

    def __init__(self, localizer: Localizer, tracker: Tracker, budget_ms: float | None = None) -> None:
        """
        Args:
            budget_ms: wall time that a frame may take before detail is left out; None: any, so that a replay gives
                the same on every machine.
        """
        self.localizer = localizer
        self.tracker = tracker
        self.ladder = Ladder(localizer.rungs, budget_ms)
        self.prior: PosePrior | None = None

    def step(self, frame: Frame, state: VehicleState, proceed: Callable[[], bool] = lambda: True) -> Outcome:
        """What the frame comes to, given the vehicle's state at its exposure. ``proceed``: see `Localizer.localize`."""
        predicted = self.tracker.predict(state)
        outcome: Outcome
        if isinstance(predicted, Rejected):
            self.prior, outcome = None, predicted
        else:
            self.prior = predicted
            outcome = self.localizer.localize(frame, predicted, proceed, self.ladder.rung)
            # Only what a rung can change; and a frame that was refused before anything was matched took no time.
            if "match" in outcome.timings_ms and "structural" in outcome.timings_ms:
                self.ladder.note(outcome.timings_ms["structural"])
        self.tracker.update(outcome, state)
        return outcome
