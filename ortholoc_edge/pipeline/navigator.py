"""The step that replay, simulation and flight share: predict, localize, learn."""

from __future__ import annotations

from ortholoc_edge.pipeline.frame import Frame, VehicleState
from ortholoc_edge.pipeline.localizer import Localizer
from ortholoc_edge.pipeline.outcome import Outcome, Rejected
from ortholoc_edge.pipeline.prior import PosePrior
from ortholoc_edge.pipeline.tracker import Tracker


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

    def step(self, frame: Frame, state: VehicleState) -> Outcome:
        """What the frame comes to, given the vehicle's state at its exposure."""
        predicted = self.tracker.predict(state)
        outcome: Outcome
        if isinstance(predicted, Rejected):
            self.prior, outcome = None, predicted
        else:
            self.prior = predicted
            outcome = self.localizer.localize(frame, predicted)
        self.tracker.update(outcome, state)
        return outcome
