"""Held-out errors of a model: blocked cross-validation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import Flags, Floats, Ints, nearest_indices
from pipeline.estimation.errors import measure_errors
from pipeline.estimation.folds import refit
from pipeline.results import Errors

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pipeline.estimation.estimation_data import EstimationData
    from pipeline.estimation.model_fit import Fitted
    from pipeline.estimation.model_state import ModelState
    from pipeline.estimation.run_residuals import RunResiduals
    from pipeline.models import Effect

    Learn = Callable[[ModelState, Flags], Callable[[int], Sequence[Effect]]]


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


def hold_out(data: EstimationData, fitted: Fitted, learn: Learn | None = None) -> HeldOut:
    """Score a fit on held-out ten-second stretches, with gaps around them.

    All free parameters, including delays of the recording, are refitted without the tested stretches.

    Args:
        data: the runs.
        fitted: the fit.
        learn: given the fitted state and the training windows, the effects to add to each run by its number.
    """
    residuals = np.full((data.whole.run.size, 3), np.nan)
    errors = [np.full((2, c.horizons.number.size), np.nan) for c in data.residuals_by_run]
    for number, fold in enumerate(data.folds):
        residuals[fold.test], reached = _score_fold(data, fitted, learn, number)
        for run, (rows, near) in enumerate(reached):
            errors[run][:, rows] = near
    return summarize(data, residuals, [one[0] for one in errors], [one[1] for one in errors])


def _score_fold(
    data: EstimationData, fitted: Fitted, learn: Learn | None, number: int
) -> tuple[Floats, list[tuple[Flags, Floats]]]:
    """Errors of the model in the tested stretches of a fold.

    Returns:
        Residuals of tested windows, shape (k, 3); for each run a mask of the tested predictions, and their
        errors of position and yaw, shape (2, m).
    """
    whole, fold, state = data.whole, data.folds[number], refit_fold(data, fitted, number)
    learned = None if learn is None else learn(state, fold.train)
    residuals, reached = np.full((int(fold.test.sum()), 3), np.nan), []
    for run, run_residuals in enumerate(data.residuals_by_run):
        rows = whole.run == run
        in_test = fold.test[rows]
        near = find_in_test(run_residuals, whole.times[rows], in_test)
        errors = np.full((2, int(near.sum())), np.nan)
        effects = (*state.effects_of(run), *(() if learned is None else learned(run)))
        if in_test.any():
            residuals[rows[fold.test]] = run_residuals.find_residuals(effects, state.timing[run])[in_test]
        if near.any():
            horizon = run_residuals.find_horizon_errors(effects, state.timing[run])
            errors = np.array((horizon.position[near], horizon.yaw[near]))
        reached.append((near, errors))
    return residuals, reached


def refit_fold(data: EstimationData, fitted: Fitted, number: int) -> ModelState:
    """State of a fit repeated without the tested stretches of a fold."""
    state = fitted.state
    for fit, train in zip(fitted.fits, data.training[number], strict=True):
        state = state.take_over(refit(fit, train), fit.free)
    return state


def find_in_test(run_residuals: RunResiduals, times: Floats, test: Flags) -> Flags:
    """Mask of predictions whose middle is nearest to a tested window: each is tested in one fold."""
    return test[_find_nearest(run_residuals, times)]


def _find_nearest(run_residuals: RunResiduals, times: Floats) -> Ints:
    """Index of the window whose middle is nearest to that of each prediction."""
    return nearest_indices(run_residuals.horizons.times.mean(axis=1), times.mean(axis=1))


def number_predictions(data: EstimationData) -> tuple[Ints, ...]:
    """The ten-second stretch of each prediction of each run, numbered through all runs."""
    whole = data.whole
    rows = [whole.run == run for run in range(len(data.residuals_by_run))]
    return tuple(
        whole.unit[mine][_find_nearest(run_residuals, whole.times[mine])]
        for mine, run_residuals in zip(rows, data.residuals_by_run, strict=True)
    )


def score(
    data: EstimationData, state: ModelState, learned: Callable[[int], Sequence[Effect]] | None = None
) -> HeldOut:
    """Score a state without fitting.

    Args:
        data: the runs.
        state: the model with its values.
        learned: effects to add to each run by its number.
    """
    residuals, horizons = [], []
    for run, run_residuals in enumerate(data.residuals_by_run):
        effects = (*state.effects_of(run), *(() if learned is None else learned(run)))
        residuals.append(run_residuals.find_residuals(effects, state.timing[run]))
        horizons.append(run_residuals.find_horizon_errors(effects, state.timing[run]))
    joined = np.concatenate(residuals)
    return summarize(data, joined, [r.position for r in horizons], [r.yaw for r in horizons])


def summarize(
    data: EstimationData, residuals: Floats, position: Sequence[Floats], yaw: Sequence[Floats]
) -> HeldOut:
    """Errors from residuals and prediction errors."""
    known = np.isfinite(residuals).all(axis=1)
    pooled = measure_errors(residuals[known], np.concatenate(position), np.concatenate(yaw))
    if len(data.residuals_by_run) == 1:
        return HeldOut(residuals, tuple(position), tuple(yaw), pooled, (pooled,))
    by_run = tuple(
        measure_errors(residuals[(data.whole.run == run) & known], position[run], yaw[run])
        for run in range(len(data.residuals_by_run))
    )
    return HeldOut(residuals, tuple(position), tuple(yaw), pooled, by_run)


def measure_by_terrain(data: EstimationData, held_out: HeldOut) -> dict[str, Errors]:
    """Errors over the runs of each terrain, which is each dataset, as a model has one vehicle."""
    by_terrain = {}
    terrains = [run_residuals.run.terrain for run_residuals in data.residuals_by_run]
    for terrain in dict.fromkeys(terrains):
        runs = [run for run, name in enumerate(terrains) if name == terrain]
        rows = np.isin(data.whole.run, runs) & np.isfinite(held_out.residuals).all(axis=1)
        position = np.concatenate([held_out.position[run] for run in runs])
        yaw = np.concatenate([held_out.yaw[run] for run in runs])
        by_terrain[terrain] = measure_errors(held_out.residuals[rows], position, yaw)
    return by_terrain
