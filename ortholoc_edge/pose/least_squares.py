"""Robust least squares by Levenberg-Marquardt, whatever the parameters are: a pose, or a camera and many poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from ortholoc_edge.geometry.arrays import FloatArray

State = TypeVar("State")

_ITERATIONS = 30
# Where the Huber loss turns linear, in standard deviations: for Gaussian errors in two dimensions that keeps 93 % of
# the efficiency.
HUBER_BEND = 1.345


@dataclass(frozen=True, slots=True, eq=False)
class Quadratic:
    """A cost around a state: ``cost + gradient . step + step . normal . step / 2``, of P parameters.

    ``cost`` is infinite where the state is impossible; the rest is unused then.
    """

    cost: float
    normal: FloatArray
    gradient: FloatArray


def minimise(
    start: State, quadratic: Callable[[State], Quadratic], moved: Callable[[State, FloatArray], State]
) -> State:
    """The state of least cost near a start.

    Args:
        quadratic: the cost at a state, linearised.
        moved: a state after a step (P,).
    """
    state, here = start, quadratic(start)
    if not np.isfinite(here.cost):
        return state
    damping = 1e-4
    for _ in range(_ITERATIONS):
        try:
            damped = here.normal + damping * np.diag(np.diag(here.normal) + 1e-12)
            step = np.asarray(np.linalg.solve(damped, -here.gradient), dtype=np.float64)
        except np.linalg.LinAlgError:
            break
        stepped = moved(state, step)
        there = quadratic(stepped)
        if np.isfinite(there.cost) and there.cost <= here.cost:
            done = here.cost - there.cost <= 1e-10 * here.cost
            state, here = stepped, there
            damping = max(damping * 0.1, 1e-10)
            if done:
                break
        else:
            damping *= 10.0
            if damping > 1e8:
                break
    return state


def huber(residuals: FloatArray, jacobian: FloatArray, scale: float) -> Quadratic:
    """Of residuals (N, 2) with a Jacobian (N, 2, P), under the Huber loss that turns linear at ``scale``."""
    cost = huber_cost(residuals, scale)
    if not np.isfinite(cost):
        return Quadratic(cost, np.empty((0, 0)), np.empty(0))
    weighted = jacobian * huber_weights(residuals, scale)[:, None, None]
    return Quadratic(cost, np.einsum("nip,niq->pq", weighted, jacobian), np.einsum("nip,ni->p", weighted, residuals))


def huber_scale(residuals: FloatArray, max_error_px: float) -> float:
    """Where the loss turns linear: `HUBER_BEND` robust sigmas, within bounds."""
    sigma = 1.4826 * float(np.median(np.abs(residuals)))
    return float(np.clip(HUBER_BEND * sigma, 0.05 * max_error_px, max_error_px))


def huber_weights(residuals: FloatArray, scale: float) -> FloatArray:
    norms = np.linalg.norm(residuals, axis=1)
    return np.asarray(np.minimum(1.0, scale / np.maximum(norms, 1e-12)), dtype=np.float64)


def huber_cost(residuals: FloatArray, scale: float) -> float:
    norms = np.linalg.norm(residuals, axis=1)
    return float(np.where(norms <= scale, 0.5 * norms**2, scale * (norms - 0.5 * scale)).sum())
