"""Held-out errors of a model: blocked cross-validation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from pipeline.core import (
    FOLDS,
    JSON_DIGITS,
    Flags,
    Floats,
    Ints,
    finite_or_none,
    nearest_indices,
    pick_finite,
    robust_spreads,
)
from pipeline.estimation.fit import PartFit, invert
from pipeline.models import LEARNED

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pipeline.estimation.comparison import Comparison
    from pipeline.estimation.model_fit import Fitted
    from pipeline.estimation.problem import Problem
    from pipeline.estimation.state import State
    from pipeline.estimation.window_residuals import WindowResiduals
    from pipeline.models import Effect

    Learn = Callable[[State, Flags], Callable[[int], Sequence[Effect]]]

# Blocked cross-validation: ten-second stretches are tested with parameters fitted without them.
#
# Residuals of field data are autocorrelated: stretches are not divided, and gaps separate training windows
# from test windows.

GAP_S = 1.5
"""Gap between training and test windows [s]: residuals are correlated for about a second."""
_LEAST_SHARE = 0.01
"""Regularization of each parameter in a fold, as a share of the information of the whole run."""


@dataclass(frozen=True)
class Fold:
    """Masks of the training windows and of the test windows."""

    train: Flags
    test: Flags


class _Rows(Protocol):
    """Rows with a run and times: windows, or the steps of a part."""

    run: Ints
    times: Floats


def make_folds(windows: WindowResiduals) -> tuple[Fold, ...]:
    """Five folds of ten-second stretches, with gaps of 1.5 s between training and test windows."""
    tests = [windows.unit % FOLDS == number for number in range(FOLDS)]
    return tuple(Fold(~find_near(windows, windows, test), test) for test in tests)


def find_near(rows: _Rows, held: _Rows, test: Flags) -> Flags:
    """Mask of rows within the gap of test rows of the same runs, shape (n,).

    Args:
        rows: the rows.
        held: those with the test rows; may be the same.
        test: mask of these, shape (m,).
    """
    near = np.zeros(rows.run.size, dtype=bool)
    for run in np.unique(rows.run).tolist():
        mine, judged = rows.run == run, (held.run == run) & test
        starts, ends = np.sort(held.times[judged, 0]), np.sort(held.times[judged, 1])
        # A row is near if more test rows begin before its end than end before its start.
        later = np.searchsorted(starts, rows.times[mine, 1] + GAP_S)
        earlier = np.searchsorted(ends, rows.times[mine, 0] - GAP_S)
        near[mine] = later > earlier
    return near


def refit(fit: PartFit, train: Flags) -> State:
    """State of the fit on some steps only, by one step from its solution with its own derivatives.

    Args:
        fit: fit to all steps.
        train: mask of the steps to fit, shape (n,).
    """
    smooth, state = fit.smooth, fit.state
    if not smooth or not train.any():
        return state
    white = fit.white
    columns = white.columns[:, smooth]
    own = _LEAST_SHARE * np.diag(np.einsum("ij,ij->j", columns, columns))
    free = [fit.free[index] for index in smooth]
    prior = fit.part.prior
    rows = train[white.rows]
    normal = columns[rows].T @ columns[rows] + own + np.diag(prior.weigh(state, fit.free)[smooth])
    pull = columns[rows].T @ white.residual[rows] + prior.pull(state, fit.free)[smooth]
    return state.move(free, (invert(normal) @ pull).tolist())


@dataclass(frozen=True)
class Errors:
    """Errors of a model.

    Attributes:
        velocity_rms: rms of displacement over half a second, over half a second: x, y [m/s], w [rad/s].
        velocity_spread: 1.4826 times the median size of the same; far below the rms if few stretches
            contain most of the error.
        t_mrmse_m: root mean square position error over windows and steps of a 2 s horizon [m].
        r_mrmse_rad: the same of the wrapped yaw [rad].
        t_mean_m, r_mean_rad: the published variant: mean of the per-step error norms.
        t_median_m, r_median_rad: median of the same: the error of a typical prediction.
        windows: number of windows scored.
    """

    velocity_rms: tuple[float, float, float]
    velocity_spread: tuple[float, float, float]
    t_mrmse_m: float
    r_mrmse_rad: float
    t_mean_m: float
    r_mean_rad: float
    t_median_m: float
    r_median_rad: float
    windows: int

    def ratios(self, other: Errors) -> tuple[float, float, float, float, float]:
        """Ratios of these errors to others: x, y, w, T, R."""
        mine = (*self.velocity_rms, self.t_mrmse_m, self.r_mrmse_rad)
        theirs = (*other.velocity_rms, other.t_mrmse_m, other.r_mrmse_rad)
        x, y, w, t, r = (a / b if b > 0.0 else float("nan") for a, b in zip(mine, theirs, strict=True))
        return x, y, w, t, r


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


def measure_errors(residuals: Floats, position: Floats, yaw: Floats) -> Errors:
    """Errors of residuals (n, 3) and of prediction errors (m,); NaN without predictions."""
    position, yaw = position[np.isfinite(position)], yaw[np.isfinite(yaw)]
    known = residuals if len(residuals) else np.full((1, 3), np.nan)
    rms = np.sqrt(np.mean(known**2, axis=0))
    spread = robust_spreads(known)
    none = np.full(1, np.nan)
    position, yaw = (position, yaw) if position.size else (none, none)
    return Errors(
        velocity_rms=_triple(rms),
        velocity_spread=_triple(spread),
        t_mrmse_m=float(np.sqrt(np.mean(position**2))),
        r_mrmse_rad=float(np.sqrt(np.mean(yaw**2))),
        t_mean_m=float(position.mean()),
        r_mean_rad=float(yaw.mean()),
        t_median_m=float(np.median(position)),
        r_median_rad=float(np.median(yaw)),
        windows=int(residuals.shape[0]),
    )


def _triple(values: Floats) -> tuple[float, float, float]:
    x, y, w = values.tolist()
    return x, y, w


def errors_as_json(errors: Errors) -> dict[str, object]:
    """The documented error keys and the published variant."""

    def cut(value: float) -> float | None:
        return finite_or_none(value, JSON_DIGITS)

    return {
        "velocity_rms": [cut(value) for value in errors.velocity_rms],
        "velocity_spread": [cut(value) for value in errors.velocity_spread],
        **pick_finite(errors, "t_mrmse_m", "r_mrmse_rad", digits=JSON_DIGITS),
        "published_t_mean_m": cut(errors.t_mean_m),
        "published_r_mean_rad": cut(errors.r_mean_rad),
        **pick_finite(errors, "t_median_m", "r_median_rad", digits=JSON_DIGITS),
        "windows": errors.windows,
    }
