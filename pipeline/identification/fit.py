"""Fitting: robust least squares over all free numbers at once, after a search for good starts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.identification.problem import Free, Problem, State, needs_search
from pipeline.identification.robust import Weights, estimate_scales, measure_loss, solve_step, weigh_system
from pipeline.identification.starts import find_starts, refine_grid

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.models.model import Model

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

_MOST_ITERATIONS = 25
_CONVERGED = 1e-6
_NEWS = 0.02


@dataclass(frozen=True)
class Fitted:
    """A fitted state and what is needed to judge it.

    Attributes:
        state: model, per-run values and delays.
        free: the numbers that were fitted.
        weights: of the residuals.
        residuals: of all windows, shape (n, 3).
        jacobian: change of the residuals with each number, shape (n, 3, p).
        loss: mean robust loss over windows and channels.
        used: windows that took part, shape (n,).
    """

    state: State
    free: tuple[Free, ...]
    weights: Weights
    residuals: Floats
    jacobian: Floats
    loss: float
    used: Flags = field(repr=False)

    @property
    def model(self) -> Model:
        """The fitted model."""
        return self.state.model


def fit_model(
    problem: Problem,
    model: Model,
    *,
    per_run: Sequence[str] = (),
    start: State | None = None,
    used: Flags | None = None,
    weights: Weights | None = None,
) -> Fitted:
    """Fit a model's free parameters and the recording's delays.

    Args:
        problem: the runs.
        model: effects at neutral values are searched from several starts; others start where they are.
        per_run: labels ``effect.name`` or ids whose values belong to each run alone.
        start: state to start from, without a search, in place of the model's own values.
        used: windows to fit, all by default.
        weights: scales to use; by default they are found along the way.

    Returns:
        The fit; a number at its bound says that the data ask for more.
    """
    used = np.ones(problem.run_of.size, dtype=bool) if used is None else used
    free = problem.list_free(model, per_run)
    given = weights
    if start is None:
        state = find_starts(problem, model, free, used)
    else:
        state = State(model, start.own, start.timing)
    residuals = problem.find_residuals(state)
    weights = given or estimate_scales(problem, residuals, used)
    smooth = tuple(number for number in free if not needs_search(number))
    jacobian = problem.differentiate(state, smooth, residuals)
    for _ in range(3 if given is None else 1):
        state, residuals, jacobian = _descend(problem, smooth, weights, used, (state, residuals, jacobian))
        if len(smooth) < len(free):
            state = refine_grid(problem, state, free, weights, used)
            residuals = problem.find_residuals(state)
            jacobian = problem.differentiate(state, smooth, residuals)
            state, residuals, jacobian = _descend(
                problem, smooth, weights, used, (state, residuals, jacobian)
            )
        if given is None:
            before, weights = weights, estimate_scales(problem, residuals, used)
            if np.allclose(before.scale, weights.scale, rtol=0.01):
                break
    if len(smooth) < len(free):
        jacobian = problem.differentiate(state, free, residuals)
    loss = measure_loss(problem, residuals, weights, used)
    return Fitted(state, free, weights, residuals, jacobian, loss, used)


def _descend(
    problem: Problem,
    free: Sequence[Free],
    weights: Weights,
    used: Flags,
    at: tuple[State, Floats, Floats],
) -> tuple[State, Floats, Floats]:
    """Levenberg-Marquardt until the loss no longer falls."""
    state, residuals, jacobian = at
    if not free:
        return at
    bounds = np.array([number.bounds for number in free])
    loss = measure_loss(problem, residuals, weights, used)
    damping, is_fresh = 1e-4, True
    for _ in range(_MOST_ITERATIONS):
        normal, gradient = weigh_system(problem, residuals, jacobian, weights, used)
        values = np.array([state.get(number) for number in free])
        fell = 0.0
        while damping < 1e6:  # noqa: PLR2004 - beyond it no step is left
            step = solve_step(normal, gradient, values, bounds, damping)
            moved = _move(state, free, values + step)
            trial = problem.find_residuals(moved)
            new = measure_loss(problem, trial, weights, used)
            if new < loss:
                fell = (loss - new) / loss
                state, residuals, loss = moved, trial, new
                damping = max(damping / 10.0, 1e-7)
                break
            if not is_fresh:
                break
            if np.abs(step / np.maximum(np.abs(values), 1e-2)).max(initial=0.0) < 1e-5:  # noqa: PLR2004
                return state, residuals, jacobian
            damping *= 10.0
        if is_fresh and fell < _CONVERGED:
            break
        # After a small step the derivatives still serve: new ones cost a prediction for each number.
        is_fresh = not _CONVERGED <= fell < _NEWS
        if is_fresh:
            jacobian = problem.differentiate(state, free, residuals)
    return state, residuals, jacobian


def _move(state: State, free: Sequence[Free], values: Floats) -> State:
    for number, value in zip(free, values.tolist(), strict=True):
        state = state.set(number, value)
    return state
