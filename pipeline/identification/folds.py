"""Blocked cross-validation: ten-second stretches are judged under numbers that were fitted without them.

Residuals of field data are autocorrelated: stretches are whole, and gaps separate what is fitted from what is
judged.
"""

from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Flags, Floats
from pipeline.identification.columns import (
    combine_columns,
    flatten,
    pick_columns,
    pick_windows,
    weigh_columns,
)
from pipeline.identification.fit import PartFit, measure_loss, solve_step
from pipeline.identification.parts import Part
from pipeline.identification.state import State
from pipeline.identification.weights import Weights

FOLDS = 5
GAP_S = 1.5
_CHORD_STEPS = 3
_NOTHING = 1e-6
_LEAST_SHARE = 0.01


@dataclass(frozen=True)
class Fold:
    """Windows that are fitted and windows that are judged."""

    train: Flags
    test: Flags


def make_folds(part: Part) -> tuple[Fold, ...]:
    """Five folds of ten-second stretches, with gaps of 1.5 s between what is fitted and what is judged."""
    tests = [part.unit % FOLDS == number for number in range(FOLDS)]
    return tuple(Fold(~find_near(part, part, test), test) for test in tests)


def find_near(part: Part, tested: Part, test: Flags) -> Flags:
    """Windows of a part that lie within the gap of tested windows of the same runs, shape (n,).

    Args:
        part: whose windows.
        tested: the part whose windows are judged; may be the same.
        test: which of those are, shape (m,).
    """
    near = np.zeros(part.run.size, dtype=bool)
    for run in np.unique(part.run).tolist():
        rows, judged = part.run == run, (tested.run == run) & test
        starts, ends = np.sort(tested.times[judged, 0]), np.sort(tested.times[judged, 1])
        # A window is near when more tested ones have begun before its end than have ended before its start.
        later = np.searchsorted(starts, part.times[rows, 1] + GAP_S)
        earlier = np.searchsorted(ends, part.times[rows, 0] - GAP_S)
        near[rows] = later > earlier
    return near


def hold_out_part(fit: PartFit, folds: tuple[Fold, ...]) -> Floats:
    """Residuals of every window under numbers fitted without it and its surroundings, shape (n, 3).

    To first order, through the derivatives: what a search needs many times.
    """
    smooth = fit.smooth
    held = np.array(fit.residual)
    if not smooth:
        return held
    jacobian, factor = pick_columns(fit.jacobian, smooth), fit.weights.factors(fit.residual)
    rows, target = jacobian * factor[:, :, None], fit.residual * factor
    whole = _sum_normals(rows, target)
    hold = _LEAST_SHARE * np.diag(whole[0])
    for fold in folds:
        if not fold.test.any() or not fold.train.any():
            continue
        # What is fitted is nearly everything: all of it less what is left out.
        out = _sum_normals(pick_windows(rows, ~fold.train), target[~fold.train])
        normal, gradient = whole[0] - out[0], whole[1] - out[1]
        stiff = normal + np.diag((np.diag(normal) + 1e-12) * 1e-9 + hold)
        step = np.asarray(np.linalg.solve(stiff, gradient), dtype=np.float64)
        held[fold.test] -= combine_columns(pick_windows(jacobian, fold.test), step)
    return held


def _sum_normals(rows: Floats, target: Floats) -> tuple[Floats, Floats]:
    """Normal matrix (p, p) and gradient (p,) of weighted columns (n, 3, p) and residuals (n, 3)."""
    flat = flatten(rows)
    return flat.T @ flat, flat.T @ target.reshape(-1)


def refit(part: Part, fit: PartFit, train: Flags) -> State:
    """The fit repeated on some windows only, from its own solution and with its own derivatives.

    Args:
        part: that was fitted.
        fit: fit to all windows.
        train: windows to fit, shape (n,).
    """
    smooth, state, residual = fit.smooth, fit.state, fit.residual
    if not smooth or not train.any():
        return state
    weights, hold = _take(fit.weights, train), _hold(fit)
    jacobian = pick_windows(pick_columns(fit.jacobian, smooth), train)
    free = [fit.free[place] for place in smooth]
    loss = measure_loss(part, weights, residual[train], state, fit.free)
    for _ in range(_CHORD_STEPS):
        pull = part.prior.pull(state, fit.free)[smooth]
        held = hold + part.prior.weigh(state, fit.free)[smooth]
        step, _ = solve_step(jacobian, residual[train], weights, hold=held, pull=pull)
        moved = state.move(free, step.tolist())
        promised = measure_loss(
            part, weights, residual[train] - combine_columns(jacobian, step), moved, fit.free
        )
        if loss - promised < _NOTHING * loss:
            break
        trial = part.find_residuals(moved)
        new = measure_loss(part, weights, trial[train], moved, fit.free)
        if new >= loss:
            break
        state, residual, loss = moved, trial, new
    return state


def _hold(fit: PartFit) -> Floats:
    """Information that speaks for staying: what acts in a few moments may act in one fold only."""
    rows = weigh_columns(pick_columns(fit.jacobian, fit.smooth), fit.weights.factors(fit.residual))
    hold: Floats = _LEAST_SHARE * np.einsum("ij,ij->j", rows, rows)
    return hold


def _take(weights: Weights, rows: Flags) -> Weights:
    return Weights(weights.scale[rows], weights.clip[rows])
