"""How far a model is from the measurements, always on data that its fit has not seen."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.arrays import Flags, Floats
from pipeline.core.parallel import map_parallel
from pipeline.core.timegrid import nearest_indices
from pipeline.identification.folds import refit

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from pipeline.identification.comparison import Comparison
    from pipeline.identification.fit import Fitted
    from pipeline.identification.problem import Problem
    from pipeline.identification.state import State


@dataclass(frozen=True)
class Errors:
    """Errors of a model.

    Attributes:
        velocity_rms: rms of displacement over half a second, over half a second: x, y [m/s], w [rad/s].
        velocity_spread: 1.4826 times the median size of the same: far below the rms, few stretches
            carry the error.
        t_mrmse_m: root mean square position error over windows and steps of a 2 s horizon [m].
        r_mrmse_rad: the same of the wrapped yaw [rad].
        t_mean_m, r_mean_rad: the published variant: mean of the per-step error norms.
        t_median_m, r_median_rad: median of the same: what most predictions are like.
        windows: how many windows were scored.
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
        """These errors over others: x, y, w, T, R."""
        mine = (*self.velocity_rms, self.t_mrmse_m, self.r_mrmse_rad)
        theirs = (*other.velocity_rms, other.t_mrmse_m, other.r_mrmse_rad)
        x, y, w, t, r = (a / b if b > 0.0 else float("nan") for a, b in zip(mine, theirs, strict=True))
        return x, y, w, t, r


@dataclass(frozen=True)
class HeldOut:
    """Errors at every window and prediction, each from a fit that had not seen its stretch.

    Attributes:
        residuals: of all windows, shape (n, 3).
        position, yaw: errors of predictions, one array a run.
        pooled: errors over all runs.
        by_run: errors of each run.
    """

    residuals: Floats
    position: tuple[Floats, ...]
    yaw: tuple[Floats, ...]
    pooled: Errors
    by_run: tuple[Errors, ...]


def hold_out(problem: Problem, fitted: Fitted) -> HeldOut:
    """Score a fit on ten-second stretches that it has not seen, with gaps round them.

    Every free number, delays of the recording included, is fitted anew without the tested stretches.
    """
    return next(hold_out_models(problem, fitted, [()]))


def hold_out_models(
    problem: Problem, fitted: Fitted, dropped: Sequence[Collection[str]]
) -> Iterator[HeldOut]:
    """Score a fit without some of its effects, as `hold_out` does, for each of several such sets.

    Args:
        problem: the runs.
        fitted: the fit, repeated with all effects without each fold of the problem.
        dropped: ids of effects that are then left out. A fold's models follow each other, so that what one
            has in common with the one before is kept.
    """
    numbers = range(len(problem.training))
    found = map_parallel(partial(_score_fold, problem, fitted, dropped), numbers)
    for model in range(len(dropped)):
        residuals = np.full((problem.whole.run.size, 3), np.nan)
        reach = [np.full((2, c.horizons.number.size), np.nan) for c in problem.comparisons]
        for fold, (rest, reached) in zip(problem.folds, found, strict=True):
            residuals[fold.test] = rest[model]
            for errors, (told, near) in zip(reach, reached, strict=True):
                errors[:, told] = near[model]
        yield summarize(problem, residuals, [one[0] for one in reach], [one[1] for one in reach])


def _score_fold(
    problem: Problem, fitted: Fitted, dropped: Sequence[Collection[str]], number: int
) -> tuple[Floats, list[tuple[Flags, Floats]]]:
    """What the models err by in the tested stretches of a fold.

    Returns:
        Residuals of tested windows, shape (models, k, 3); of each run which predictions are tested, and their
        errors of position and yaw, shape (models, 2, m).
    """
    whole, fold, state = problem.whole, problem.folds[number], fitted.state
    for part, fit, train in zip(problem.parts, fitted.fits, problem.training[number], strict=True):
        state = state.take_over(refit(part, fit, train), fit.free)
    models = [state.drop(names) for names in dropped]
    residuals, reached = np.full((len(models), int(fold.test.sum()), 3), np.nan), []
    for run, comparison in enumerate(problem.comparisons):
        rows = whole.run == run
        tested = fold.test[rows]
        told = _find_tested(comparison, whole.times[rows], tested)
        errors = np.full((len(models), 2, int(told.sum())), np.nan)
        for place, model in enumerate(models):
            if tested.any():
                residuals[place, rows[fold.test]] = whole.find_run_residuals(model, run)[tested]
            if told.any():
                reach = comparison.find_horizon_errors(model.effects_of(run), model.timing[run])
                errors[place] = reach.position[told], reach.yaw[told]
        reached.append((told, errors))
    return residuals, reached


def _find_tested(comparison: Comparison, times: Floats, test: Flags) -> Flags:
    """Predictions of which the middle lies nearest to a tested window: each is tested in one fold."""
    middle, windows = comparison.horizons.times.mean(axis=1), times.mean(axis=1)
    return test[nearest_indices(middle, windows)]


def score(problem: Problem, state: State) -> HeldOut:
    """Score a state as it is, nothing fitted."""
    reach = [
        c.find_horizon_errors(state.effects_of(run), state.timing[run])
        for run, c in enumerate(problem.comparisons)
    ]
    return summarize(
        problem, problem.find_residuals(state), [r.position for r in reach], [r.yaw for r in reach]
    )


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
    """Errors of the runs of each terrain together: of each dataset, a model having one vehicle."""
    found = {}
    terrains = [comparison.run.terrain for comparison in problem.comparisons]
    for terrain in dict.fromkeys(terrains):
        runs = [run for run, name in enumerate(terrains) if name == terrain]
        rows = np.isin(problem.whole.run, runs) & np.isfinite(held_out.residuals).all(axis=1)
        position = np.concatenate([held_out.position[run] for run in runs])
        yaw = np.concatenate([held_out.yaw[run] for run in runs])
        found[terrain] = measure_errors(held_out.residuals[rows], position, yaw)
    return found


def measure_errors(residuals: Floats, position: Floats, yaw: Floats) -> Errors:
    """Errors of residuals (n, 3) and of prediction errors (m,); NaN where nothing was predicted."""
    position, yaw = position[np.isfinite(position)], yaw[np.isfinite(yaw)]
    known = residuals if len(residuals) else np.full((1, 3), np.nan)
    rms = np.sqrt(np.mean(known**2, axis=0))
    spread = 1.4826 * np.median(np.abs(known), axis=0)
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
