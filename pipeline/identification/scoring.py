"""How far a model is from the measurements, always on data that its fit has not seen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.identification.problem import needs_search
from pipeline.identification.robust import measure_loss, solve_step, weigh_system
from pipeline.identification.starts import refine_grid

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.identification.fit import Fitted
    from pipeline.identification.problem import Problem, State
    from pipeline.identification.robust import Weights

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Integers = NDArray[np.int64]

FOLDS = 5
GAP_S = 1.5
_CHORD_STEPS = 3


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
    """Errors at every window and prediction, each from a fit that had not seen its block.

    Attributes:
        residuals: of all windows, shape (n, 3).
        position, yaw: errors of predictions, one array a run.
        loss: mean robust loss under `weights`.
        block_loss: the same by block; NaN for blocks without a window.
        weights: scales of the full fit.
        pooled: errors over all runs.
        by_run: errors of each run.
    """

    residuals: Floats
    position: tuple[Floats, ...]
    yaw: tuple[Floats, ...]
    loss: float
    block_loss: Floats
    weights: Weights
    pooled: Errors
    by_run: tuple[Errors, ...]


def assign_folds(problem: Problem, folds: int = FOLDS) -> Integers:
    """Fold of every block, in turn; blocks are command steps, so neighbours fall into different folds."""
    blocks = np.unique(problem.block_of)
    fold = np.full(int(blocks.max()) + 1, -1, dtype=np.int64)
    fold[blocks] = np.arange(blocks.size) % folds
    return fold


def list_training(problem: Problem, tested: Flags) -> Flags:
    """Windows that a fit may see when others are tested: those not within the gap of any of them."""
    training = ~tested
    for run in range(len(problem.comparisons)):
        rows = problem.run_of == run
        times = problem.times[rows]
        at = tested[rows]
        if not at.any():
            continue
        starts, ends = times[at, 0] - GAP_S, times[at, 1] + GAP_S
        # A window is near when more tested ones have begun before its end than have ended before its start.
        near = np.searchsorted(np.sort(starts), times[:, 1]) > np.searchsorted(np.sort(ends), times[:, 0])
        training[rows] &= ~near
    return training


def refit(problem: Problem, fitted: Fitted, used: Flags) -> State:
    """The fit repeated on some windows only, from its own solution and with its own derivatives.

    Args:
        problem: the runs.
        fitted: fit to all windows.
        used: windows to fit, shape (n,).
    """
    state, residuals = fitted.state, fitted.residuals
    if not fitted.free or not used.any():
        return state
    if any(needs_search(number) for number in fitted.free):
        state = refine_grid(problem, state, fitted.free, fitted.weights, used)
        residuals = problem.find_residuals(state)
    rows = [i for i, number in enumerate(fitted.free) if not needs_search(number)]
    free = [fitted.free[i] for i in rows]
    jacobian = fitted.jacobian[:, :, rows]
    bounds = np.array([number.bounds for number in free]).reshape(-1, 2)
    loss = measure_loss(problem, residuals, fitted.weights, used)
    for _ in range(_CHORD_STEPS if free else 0):
        normal, gradient = weigh_system(problem, residuals, jacobian, fitted.weights, used)
        values = np.array([state.get(number) for number in free])
        step = solve_step(normal, gradient, values, bounds, 1e-6)
        moved = state
        for number, value in zip(free, (values + step).tolist(), strict=True):
            moved = moved.set(number, value)
        trial = problem.find_residuals(moved)
        new = measure_loss(problem, trial, fitted.weights, used)
        if new >= loss:
            break
        state, residuals, loss = moved, trial, new
    return state


def hold_out(problem: Problem, fitted: Fitted, *, folds: int = FOLDS) -> HeldOut:
    """Score a fit on blocks of command steps that it has not seen, with gaps round them.

    Every free number, delays of the recording included, is fitted anew without the tested blocks.
    """
    fold = assign_folds(problem, folds)
    residuals = np.full(fitted.residuals.shape, np.nan)
    position = [np.full(c.horizons.number.size, np.nan) for c in problem.comparisons]
    yaw = [np.full(c.horizons.number.size, np.nan) for c in problem.comparisons]
    for number in range(folds):
        tested = fold[problem.block_of] == number
        if not tested.any():
            continue
        state = refit(problem, fitted, list_training(problem, tested))
        _fill(problem, state, tested, residuals)
        for run, comparison in enumerate(problem.comparisons):
            rows = fold[np.minimum(problem.horizon_blocks(run), fold.size - 1)] == number
            if rows.any():
                reach = comparison.find_reach(state.effects_of(run), state.timing[run])
                position[run][rows], yaw[run][rows] = reach.position[rows], reach.yaw[rows]
    return summarize(problem, fitted.weights, residuals, position, yaw)


def score(problem: Problem, state: State, weights: Weights) -> HeldOut:
    """Score a state as it is; for runs that its fit has not seen, or for a floor."""
    residuals = problem.find_residuals(state)
    reach = [
        c.find_reach(state.effects_of(run), state.timing[run]) for run, c in enumerate(problem.comparisons)
    ]
    return summarize(problem, weights, residuals, [r.position for r in reach], [r.yaw for r in reach])


def _fill(problem: Problem, state: State, tested: Flags, residuals: Floats) -> None:
    for run in range(len(problem.comparisons)):
        rows = problem.run_of == run
        if tested[rows].any():
            residuals[rows & tested] = problem.find_run_residuals(state, run)[tested[rows]]


def summarize(
    problem: Problem, weights: Weights, residuals: Floats, position: Sequence[Floats], yaw: Sequence[Floats]
) -> HeldOut:
    """Errors from residuals and prediction errors."""
    known = np.isfinite(residuals).all(axis=1)
    size = np.abs(weights.normalise(residuals, problem))
    losses = np.where(size <= 3.0, 0.5 * size**2, 3.0 * (size - 1.5)).mean(axis=1)  # noqa: PLR2004 - Huber
    count = np.bincount(problem.block_of[known])
    block = np.bincount(problem.block_of[known], losses[known]) / np.maximum(count, 1)
    by_run = tuple(
        measure_errors(residuals[(problem.run_of == run) & known], position[run], yaw[run])
        for run in range(len(problem.comparisons))
    )
    pooled = measure_errors(residuals[known], np.concatenate(position), np.concatenate(yaw))
    return HeldOut(
        residuals=residuals,
        position=tuple(position),
        yaw=tuple(yaw),
        loss=float(losses[known].mean()),
        block_loss=np.where(count > 0, block, np.nan),
        weights=weights,
        pooled=pooled,
        by_run=by_run,
    )


def measure_by_terrain(problem: Problem, held_out: HeldOut) -> dict[str, Errors]:
    """Errors of the runs of each terrain together: of each dataset, a model having one vehicle."""
    found = {}
    terrains = [comparison.run.terrain for comparison in problem.comparisons]
    for terrain in dict.fromkeys(terrains):
        runs = [run for run, name in enumerate(terrains) if name == terrain]
        rows = np.isin(problem.run_of, runs) & np.isfinite(held_out.residuals).all(axis=1)
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
