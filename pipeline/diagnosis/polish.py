"""Least squares over all free numbers of a state at once, and grids for those that are not smooth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.diagnosis.problem import differentiate
from pipeline.models.effect import Search

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.diagnosis.metric import Metric
    from pipeline.diagnosis.problem import Problem
    from pipeline.diagnosis.state import Slot, State

Floats = NDArray[np.float64]

_ITERATIONS = 20
_ENOUGH = 2e-5
_NEWS = 0.02
_GRID_ROUNDS = 4
_STIFFEST = 30.0


@dataclass(frozen=True)
class Fitted:
    """A state whose numbers are the best for it.

    Attributes:
        state: the state.
        residual: its residuals, shape (n, 3).
        slots: its free numbers.
        jacobian: change of the prediction with each of them, shape (n, 3, p).
        loss: mean cost under the metric it was fitted with.
    """

    state: State
    residual: Floats
    slots: tuple[Slot, ...]
    jacobian: Floats
    loss: float


def polish(problem: Problem, metric: Metric, state: State, iterations: int = _ITERATIONS) -> Fitted:
    """Fit all free numbers of a state (Levenberg-Marquardt with bounds), grids included."""
    fitted = _descend(problem, metric, state, iterations)
    rough = [slot for slot in fitted.slots if slot.search is Search.GRID]
    for slot in rough:
        moved = _walk_grid(problem, metric, fitted, slot)
        if moved is not None:
            fitted = _descend(problem, metric, moved, iterations)
    return fitted


def solve_step(
    jacobian: Floats, residual: Floats, metric: Metric, damping: float = 0.0, hold: Floats | float = 0.0
) -> tuple[Floats, Floats]:
    """One weighted least squares step.

    Args:
        jacobian: change of the prediction with each number, shape (n, 3, p).
        residual: shape (n, 3).
        metric: cost of residuals.
        damping: Levenberg-Marquardt damping relative to the diagonal.
        hold: information that speaks for staying where each number is, shape (p,).

    Returns:
        The step, shape (p,), and the normal matrix, shape (p, p).
    """
    factor = metric.weights(residual)
    rows = (jacobian * factor[:, :, None]).reshape(-1, jacobian.shape[2])
    target = (residual * factor).reshape(-1)
    normal = np.asarray(rows.T @ rows, dtype=np.float64)
    size = np.diag(normal) + 1e-12
    stiff = normal + np.diag(size * (damping + 1e-9) + hold)
    step = np.asarray(np.linalg.solve(stiff, rows.T @ target), dtype=np.float64)
    return step, normal


def _descend(problem: Problem, metric: Metric, state: State, iterations: int) -> Fitted:
    residual = problem.find_residuals(state)
    loss = metric.loss(residual)
    slots = state.list_slots(problem.delays)
    smooth = [place for place, slot in enumerate(slots) if slot.search is not Search.GRID]
    jacobian = differentiate(problem, state, residual, slots)
    if not smooth:
        return Fitted(state, residual, slots, jacobian, loss)
    damping, is_fresh = 1e-4, True
    for _ in range(iterations):
        free = [place for place in smooth if not _pushes_out(state, slots[place], jacobian, residual, place)]
        if not free:
            break
        step, _ = solve_step(jacobian[:, :, free], residual, metric, damping)
        # What the step promises, were the model linear: where that is nothing, the fit is done.
        promised = metric.loss(residual - jacobian[:, :, free] @ step)
        if (loss - promised) / max(loss, 1e-12) < 0.5 * _ENOUGH:
            break
        trial = _move(state, [slots[place] for place in free], step)
        after = problem.find_residuals(trial)
        reached = metric.loss(after)
        if reached > loss:
            if not is_fresh:
                jacobian, is_fresh = differentiate(problem, state, residual, slots), True
                continue
            if damping > _STIFFEST:
                break
            damping = max(damping * 20.0, 1e-2)
            continue
        fall = (loss - reached) / max(loss, 1e-12)
        state, residual, loss = trial, after, reached
        damping = max(damping / 8.0, 1e-8)
        # After a small step the derivatives still serve: new ones cost a prediction for each number.
        is_fresh = fall > _NEWS
        if is_fresh:
            jacobian = differentiate(problem, state, residual, slots)
        if fall < _ENOUGH:
            break
    return Fitted(state, residual, slots, jacobian, loss)


def _move(state: State, slots: Sequence[Slot], step: Floats) -> State:
    for slot, change in zip(slots, step.tolist(), strict=True):
        state = state.write(slot, state.read(slot) + change)
    return state


def _pushes_out(state: State, slot: Slot, jacobian: Floats, residual: Floats, place: int) -> bool:
    """Whether a number stands at its bound and wants to go beyond."""
    value, (low, high) = state.read(slot), slot.bounds
    if low < value < high:
        return False
    pull = float(np.sum(jacobian[:, :, place] * residual))
    return (value <= low and pull < 0.0) or (value >= high and pull > 0.0)


def _walk_grid(problem: Problem, metric: Metric, fitted: Fitted, slot: Slot) -> State | None:
    """Shrinking grid around a number, the others following linearly; None where it is best already."""
    others = [place for place, other in enumerate(fitted.slots) if other.search is not Search.GRID]
    value = fitted.state.read(slot)
    # A moment has no size that its neighbourhood could be a share of.
    width = 8.0 * slot.step if math.isnan(fitted.state.neutral_of(slot)) else 0.5 * abs(value)
    best, best_loss = value, fitted.loss
    for _ in range(_GRID_ROUNDS):
        for at in (best - width, best - 0.5 * width, best + 0.5 * width, best + width):
            if not slot.bounds[0] <= at <= slot.bounds[1]:
                continue
            residual = problem.find_residuals(fitted.state.write(slot, at))
            if others:
                step, _ = solve_step(fitted.jacobian[:, :, others], residual, metric)
                residual = residual - fitted.jacobian[:, :, others] @ step
            loss = metric.loss(residual)
            if loss < best_loss:
                best, best_loss = at, loss
        width /= 3.0
    return None if best == value else fitted.state.write(slot, best)
