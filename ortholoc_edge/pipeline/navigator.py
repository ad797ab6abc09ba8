"""The step that replay, simulation and flight share: predict, localize, learn."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from msgspec import Meta, Struct

from ortholoc_edge.pipeline.frame import Frame, VehicleState
from ortholoc_edge.pipeline.localizer import Localizer
from ortholoc_edge.pipeline.outcome import Outcome, Rejected
from ortholoc_edge.pipeline.prior import PosePrior
from ortholoc_edge.pipeline.tracker import Tracker


class TimingOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How old a fix may be. ``max_age_ms``: from mid-exposure; what is older is not sent, and the search of a wide
    prior ends. ArduPilot takes data older than its buffer (250 ms and the delay it is told of) for newer than they are.
    """

    max_age_ms: Annotated[float, Meta(gt=0)] = 1000.0


class Navigator:
    """Localizer and tracker as one; used by one thread.

    Attributes:
        localizer, tracker: the two.
        prior: the prediction for the last frame; None if there was none.
    """

    def __init__(self, localizer: Localizer, tracker: Tracker) -> None:
        self.localizer = localizer
        self.tracker = tracker
        self.prior: PosePrior | None = None

    def step(self, frame: Frame, state: VehicleState, proceed: Callable[[], bool] = lambda: True) -> Outcome:
        """What the frame comes to, given the vehicle's state at its exposure. ``proceed``: see `Localizer.localize`."""
        predicted = self.tracker.predict(state)
        outcome: Outcome
        if isinstance(predicted, Rejected):
            self.prior, outcome = None, predicted
        else:
            self.prior = predicted
            outcome = self.localizer.localize(frame, predicted, proceed)
        self.tracker.update(outcome, state)
        return outcome
