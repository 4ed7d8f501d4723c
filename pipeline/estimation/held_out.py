"""Held-out errors of a model: blocked cross-validation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import Flags, Floats, Ints, nearest_indices
from pipeline.estimation.errors import Errors, measure_errors
from pipeline.estimation.folds import refit
from pipeline.models import LEARNED

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pipeline.estimation.comparison import Comparison
    from pipeline.estimation.model_fit import Fitted
    from pipeline.estimation.problem import Problem
    from pipeline.estimation.state import State
    from pipeline.models import Effect

    Learn = Callable[[State, Flags], Callable[[int], Sequence[Effect]]]


@dataclass(frozen=True)
class HeldOut:
    """Errors of all windows and predictions, each from a fit without its stretch.

    Attributes:
        residuals: residuals of all windows, shape (n, 3).
        position, yaw: errors of predictions, one array per run.
        pooled: errors over all runs.
        by_run: errors of each run.
    """

    residuals: Floats
    position: tuple[Floats, ...]
    yaw: tuple[Floats, ...]
    pooled: Errors
    by_run: tuple[Errors, ...]


def hold_out(problem: Problem, fitted: Fitted, learn: Learn | None = None) -> HeldOut:
    """Score a fit on held-out ten-second stretches, with gaps around them.

    All free parameters, including delays of the recording, are refitted without the tested stretches.

    Args:
        problem: the runs.
        fitted: the fit.
        learn: given the fitted state and the training windows, the effects to add to each run by its number.
    """
    residuals = np.full((problem.whole.run.size, 3), np.nan)
    errors = [np.full((2, c.horizons.number.size), np.nan) for c in problem.comparisons]
    for number, fold in enumerate(problem.folds):
        residuals[fold.test], reached = _score_fold(problem, fitted, learn, number)
        for run, (rows, near) in enumerate(reached):
            errors[run][:, rows] = near
    return summarize(problem, residuals, [one[0] for one in errors], [one[1] for one in errors])


def _score_fold(
    problem: Problem, fitted: Fitted, learn: Learn | None, number: int
) -> tuple[Floats, list[tuple[Flags, Floats]]]:
    """Errors of the model in the tested stretches of a fold.

    Returns:
        Residuals of tested windows, shape (k, 3); for each run a mask of the tested predictions, and their
        errors of position and yaw, shape (2, m).
    """
    whole, fold, state = problem.whole, problem.folds[number], refit_fold(problem, fitted, number)
    if learn is not None:
        # The learned term was trained on all stretches, these included: it is retrained.
        state = state.drop([LEARNED])
    learned = None if learn is None else learn(state, fold.train)
    residuals, reached = np.full((int(fold.test.sum()), 3), np.nan), []
    for run, comparison in enumerate(problem.comparisons):
        rows = whole.run == run
        in_test = fold.test[rows]
        near = find_in_test(comparison, whole.times[rows], in_test)
        errors = np.full((2, int(near.sum())), np.nan)
        effects = (*state.effects_of(run), *(() if learned is None else learned(run)))
        if in_test.any():
            residuals[rows[fold.test]] = comparison.find_residuals(effects, state.timing[run])[in_test]
        if near.any():
            horizon = comparison.find_horizon_errors(effects, state.timing[run])
            errors = np.array((horizon.position[near], horizon.yaw[near]))
        reached.append((near, errors))
    return residuals, reached


def refit_fold(problem: Problem, fitted: Fitted, number: int) -> State:
    """State of a fit repeated without the tested stretches of a fold."""
    state = fitted.state
    for fit, train in zip(fitted.fits, problem.training[number], strict=True):
        state = state.take_over(refit(fit, train), fit.free)
    return state


def find_in_test(comparison: Comparison, times: Floats, test: Flags) -> Flags:
    """Mask of predictions whose middle is nearest to a tested window: each is tested in one fold."""
    return test[_find_nearest(comparison, times)]


def _find_nearest(comparison: Comparison, times: Floats) -> Ints:
    """Index of the window whose middle is nearest to that of each prediction."""
    return nearest_indices(comparison.horizons.times.mean(axis=1), times.mean(axis=1))


def number_predictions(problem: Problem) -> tuple[Ints, ...]:
    """The ten-second stretch of each prediction of each run, numbered through all runs."""
    whole = problem.whole
    rows = [whole.run == run for run in range(len(problem.comparisons))]
    return tuple(
        whole.unit[mine][_find_nearest(comparison, whole.times[mine])]
        for mine, comparison in zip(rows, problem.comparisons, strict=True)
    )


def score(
    problem: Problem, state: State, learned: Callable[[int], Sequence[Effect]] | None = None
) -> HeldOut:
    """Score a state without fitting.

    Args:
        problem: the runs.
        state: the model with its values.
        learned: effects to add to each run by its number.
    """
    residuals, horizons = [], []
    for run, comparison in enumerate(problem.comparisons):
        effects = (*state.effects_of(run), *(() if learned is None else learned(run)))
        residuals.append(comparison.find_residuals(effects, state.timing[run]))
        horizons.append(comparison.find_horizon_errors(effects, state.timing[run]))
    joined = np.concatenate(residuals)
    return summarize(problem, joined, [r.position for r in horizons], [r.yaw for r in horizons])


def summarize(
    problem: Problem, residuals: Floats, position: Sequence[Floats], yaw: Sequence[Floats]
) -> HeldOut:
    """Errors from residuals and prediction errors."""
    known = np.isfinite(residuals).all(axis=1)
    pooled = measure_errors(residuals[known], np.concatenate(position), np.concatenate(yaw))
    if len(problem.comparisons) == 1:
        return HeldOut(residuals, tuple(position), tuple(yaw), pooled, (pooled,))
    by_run = tuple(
        measure_errors(residuals[(problem.whole.run == run) & known], position[run], yaw[run])
        for run in range(len(problem.comparisons))
    )
    return HeldOut(residuals, tuple(position), tuple(yaw), pooled, by_run)


def measure_by_terrain(problem: Problem, held_out: HeldOut) -> dict[str, Errors]:
    """Errors over the runs of each terrain, which is each dataset, as a model has one vehicle."""
    by_terrain = {}
    terrains = [comparison.run.terrain for comparison in problem.comparisons]
    for terrain in dict.fromkeys(terrains):
        runs = [run for run, name in enumerate(terrains) if name == terrain]
        rows = np.isin(problem.whole.run, runs) & np.isfinite(held_out.residuals).all(axis=1)
        position = np.concatenate([held_out.position[run] for run in runs])
        yaw = np.concatenate([held_out.yaw[run] for run in runs])
        by_terrain[terrain] = measure_errors(held_out.residuals[rows], position, yaw)
    return by_terrain
