"""The step that replay, simulation and flight share: predict, localize, learn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta, Struct

from ortholoc_edge.pipeline.frame import Frame, VehicleState
from ortholoc_edge.pipeline.gate import GateOptions
from ortholoc_edge.pipeline.ladder import Ladder, LadderOptions
from ortholoc_edge.pipeline.localizer import Localizer
from ortholoc_edge.pipeline.outcome import Fix, Outcome, Rejected
from ortholoc_edge.pipeline.picture import PictureOptions, Seen, Watch, grey_rows, motion_px_s, unfit
from ortholoc_edge.pipeline.prior import PosePrior
from ortholoc_edge.pipeline.tracker import Order, Tracker, TrackerOptions
from ortholoc_edge.pipeline.witness import WitnessOptions


class TimingOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How old a fix may be, and how long it may take.

    ``max_age_ms``: from mid-exposure; what is older is not sent, and the search of a wide prior ends. ArduPilot takes
    data older than its buffer (250 ms and the delay it is told of) for newer than they are.
    ``budget_ms``: of a frame; where frames take longer they are matched in less detail, and in more again when there is
    room (`pipeline.ladder`). An autopilot wants five estimates in a second at least.
    """

    max_age_ms: Annotated[float, Meta(gt=0)] = 1000.0
    budget_ms: Annotated[float, Meta(gt=0)] = 200.0


class Tuning(Struct, frozen=True, kw_only=True):
    """Options that may change in flight and that an outcome depends on."""

    gate: GateOptions
    tracker: TrackerOptions
    witness: WitnessOptions


@dataclass(frozen=True, slots=True, eq=False)
class Circumstances:
    """What a step depended on besides its frame, its state and the steps before: with these it can be taken again.

    Attributes:
        number: of the step since the start, from 0; one that failed has used up its own.
        prior: the prediction; None where there was none.
        rung: of detail, for `Localizer.localize`.
        proceeded: how often it was told to go on before it was told to stop, or did not ask any more.
        reset_counter: the tracker's before the step; others may raise it between steps.
        orders: what the tracker was told since the step before.
        tuning: options that are no longer those of the start; None while they are.
        repeats: how many frames just before showed the same picture.
    """

    number: int
    prior: PosePrior | None
    rung: int
    proceeded: int
    reset_counter: int
    orders: tuple[Order, ...] = ()
    tuning: Tuning | None = None
    repeats: int = 0


class Navigator:
    """Localizer and tracker as one; used by one thread.

    Attributes:
        localizer, tracker: the two.
        ladder: how much detail, and how many frames, there is time for.
        last: what the last step depended on; None before the first.
    """

    def __init__(
        self,
        localizer: Localizer,
        tracker: Tracker,
        budget_ms: float | None = None,
        picture: PictureOptions | None = None,
        ladder: LadderOptions | None = None,
    ) -> None:
        """
        Args:
            budget_ms: wall time that a frame may take before detail is left out; None: any, so that a replay gives
                the same on every machine.
            picture: what a frame must be to be matched; None: anything, as photos of a recorded sequence are.
            ladder: what else detail and frames are left out for; None: the defaults.
        """
        self.localizer = localizer
        self.tracker = tracker
        self._picture = picture
        self._watch = Watch()
        self.ladder = Ladder(localizer.rungs, budget_ms, ladder)
        self.last: Circumstances | None = None
        self._steps = 0
        self._orders: list[Order] = []
        self._tuning: Tuning | None = None

    @property
    def prior(self) -> PosePrior | None:
        """The prediction for the last frame; None if there was none."""
        return None if self.last is None else self.last.prior

    def give(self, order: Order) -> None:
        """Tell the tracker, with the next step."""
        self._orders.append(order)

    def retune(self, tuning: Tuning) -> None:
        """Go on with other options."""
        self._tuning = tuning
        self.localizer.retune(tuning.gate)
        self.tracker.retune(tuning.tracker, tuning.witness)

    def step(self, frame: Frame, state: VehicleState, proceed: Callable[[], bool] = lambda: True) -> Outcome:
        """What the frame comes to, given the vehicle's state at its exposure. ``proceed``: see `Localizer.localize`."""
        outcome = self._step(frame, state, proceed, self.ladder.detail)
        took_ms = outcome.timings_ms
        # A frame that was refused before anything was matched took no time. A search by features takes long on any
        # rung, and detail is what it needs: where structural matching did not say how long frames take, fixes do.
        if "structural" in took_ms:
            self.ladder.note(took_ms["structural"], frame.stamp_ns)
        elif "match" in took_ms and isinstance(outcome, Fix):
            self.ladder.note(took_ms["total"], frame.stamp_ns)
        return outcome

    def step_again(self, frame: Frame, state: VehicleState, was: Circumstances) -> Outcome:
        """A recorded step, after those before it: the same outcome, however fast this computer is."""
        self.tracker.reset_counter = was.reset_counter
        if was.tuning is not None and was.tuning != self._tuning:
            self.retune(was.tuning)
        self._orders = list(was.orders)
        return self._step(frame, state, _yes(was.proceeded), was.rung, was.repeats)

    def localize_again(self, frame: Frame, state: VehicleState, was: Circumstances) -> Outcome | None:
        """A recorded step without those before it, from the prediction that it had; None if it had none."""
        if was.prior is None:
            return None
        if was.tuning is not None:
            self.localizer.retune(was.tuning.gate)
        seen = self._see(frame, was.repeats)
        return self._localize(frame, state, was.prior, seen, _yes(was.proceeded), was.rung)

    def _step(
        self,
        frame: Frame,
        state: VehicleState,
        proceed: Callable[[], bool],
        rung: int,
        repeats: int | None = None,
    ) -> Outcome:
        """``repeats``: as recorded; None: they are counted."""
        orders, self._orders = tuple(self._orders), []
        seen = self._see(frame, repeats)
        try:
            return self._ordered(orders, frame, state, proceed, rung, seen)
        except BaseException:
            # The step is in no log; with the next one they will be, and take effect again.
            self._orders = [*orders, *self._orders]
            raise

    def _see(self, frame: Frame, repeats: int | None) -> Seen:
        if self._picture is None:
            return Seen(None, 0)
        return self._watch.see(frame.image) if repeats is None else Seen(grey_rows(frame.image), repeats)

    def _ordered(
        self,
        orders: tuple[Order, ...],
        frame: Frame,
        state: VehicleState,
        proceed: Callable[[], bool],
        rung: int,
        seen: Seen,
    ) -> Outcome:
        number, reset_counter, proceeded = self._steps, self.tracker.reset_counter, 0
        self._steps += 1
        for order in orders:
            self.tracker.take(order)

        def counted() -> bool:
            nonlocal proceeded
            on = proceed()
            proceeded += on
            return on

        predicted = self.tracker.predict(state)
        outcome: Outcome
        if isinstance(predicted, Rejected):
            prior, outcome = None, predicted
        else:
            prior, outcome = predicted, self._localize(frame, state, predicted, seen, counted, rung)
        self.last = Circumstances(number, prior, rung, proceeded, reset_counter, orders, self._tuning, seen.repeats)
        self.tracker.update(outcome, state)
        return outcome

    def _localize(
        self,
        frame: Frame,
        state: VehicleState,
        prior: PosePrior,
        seen: Seen,
        proceed: Callable[[], bool],
        rung: int,
    ) -> Outcome:
        """What the frame comes to where it is fit to be matched."""
        if self._picture is not None:
            refused = unfit(frame, seen, self._smear_px(frame, state, prior), self._picture)
            if refused is not None:
                return refused
        return self.localizer.localize(frame, prior, proceed, rung)

    def _smear_px(self, frame: Frame, state: VehicleState, prior: PosePrior) -> float | None:
        """How far the ground is predicted to move in the picture while the shutter is open."""
        mount = self.tracker.mount(state)
        if frame.exposure_ns is None or mount is None:
            return None
        height_m = self.localizer.height_above_ground_m(prior)
        if height_m is None:
            return None
        motion = motion_px_s(self.localizer.working_camera, height_m, state, mount)
        return None if motion is None else motion * frame.exposure_ns * 1e-9


def _yes(times: int) -> Callable[[], bool]:
    """Go on so often, then stop."""
    left = times

    def proceed() -> bool:
        nonlocal left
        left -= 1
        return left >= 0

    return proceed
