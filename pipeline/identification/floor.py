"""The noise floor: the part of the error that is noise of the poses and random motion.

A localization that wanders for seconds cannot be told from motion by its high frequencies, and a jittery one
is far worse than they say. So the floor is measured the other way round. Whatever of a model's residuals can
be predicted from commands or wheels, lagged, multiplied and turned into the map, could be removed by some
model. Of the rest, what lasts longer than a second is motion that something must have caused, even where
nothing that was recorded tells what; noise and random motion are what remains.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.identification.persistence import split_residuals
from pipeline.identification.scoring import HeldOut, measure_errors
from pipeline.models.forward import Timing

if TYPE_CHECKING:
    from pipeline.identification.comparison import Comparison
    from pipeline.identification.problem import Problem
    from pipeline.identification.scoring import Errors

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

_LAGS_S = (0.15, 0.3, 0.6, 1.2, 2.4)
_RIDGES = (3e-4, 3e-3, 3e-2, 3e-1)
_CLIP = 4.0


def estimate_floor(problem: Problem, held_out: HeldOut) -> Errors:
    """The error that would stay if the cause of everything that lasts were known, as far as these runs tell.

    A ridge regression of the held-out residuals on functions of the input, fitted with the same blocks and
    gaps, removes what is predictable; what remains is divided by how long it lasts (see `persistence`). The
    predictions of two seconds shrink as the same parts do when they are added up over that time.

    Args:
        problem: the runs.
        held_out: the best model's held-out errors: the better it is, the sharper the floor.

    Returns:
        Errors of which every part is at most the model's own.
    """
    residuals = held_out.residuals
    known: Flags = np.asarray(np.isfinite(residuals).all(axis=1))
    left = _remove_predictable(problem, residuals, known)
    makeup = split_residuals(problem.comparisons, left)
    square = np.mean(left[known] ** 2, axis=0)
    floor = square * [1.0 - part.lasting_share for part in makeup]
    # Positions of predictions err by both speeds, and by a heading that errs on the way.
    before = np.sqrt(np.mean(residuals[known] ** 2, axis=0))
    predictable = square / np.maximum(before**2, 1e-24)
    after = np.linspace(0.25, 2.0, 8)
    whole = np.array([part.spread_after(after, lasting=True).mean() for part in makeup])
    noise = np.array([part.spread_after(after, lasting=False).mean() for part in makeup])
    whole /= np.maximum(predictable, 1e-12)
    speed = np.concatenate([_measure_speed(comparison) for comparison in problem.comparisons])
    lever = 0.3 * np.mean((speed * after.mean()) ** 2)
    weights = np.array([1.0, 1.0, lever])
    along = np.sqrt(min(float(weights @ noise) / max(float(weights @ whole), 1e-24), 1.0))
    around = np.sqrt(min(float(noise[2]) / max(float(whole[2]), 1e-24), 1.0))
    shrink = np.sqrt(floor / np.maximum(square, 1e-24))
    position = np.concatenate(held_out.position) * along
    yaw = np.concatenate(held_out.yaw) * around
    return replace(measure_errors(left[known] * shrink, position, yaw), windows=int(known.sum()))


def hold_below(floor: Errors, reached: Errors) -> Errors:
    """A floor of which no part is above what a model has reached: by then it was no floor."""
    names = ("t_mrmse_m", "r_mrmse_rad", "t_mean_m", "r_mean_rad", "t_median_m", "r_median_rad")
    return replace(
        floor,
        velocity_rms=_take_lower(floor.velocity_rms, reached.velocity_rms),
        velocity_spread=_take_lower(floor.velocity_spread, reached.velocity_spread),
        **{name: min(getattr(floor, name), getattr(reached, name)) for name in names},
    )


def _take_lower(
    one: tuple[float, float, float], other: tuple[float, float, float]
) -> tuple[float, float, float]:
    return min(one[0], other[0]), min(one[1], other[1]), min(one[2], other[2])


def _remove_predictable(problem: Problem, residuals: Floats, known: Flags) -> Floats:
    """Residuals without what a regression on the inputs predicts of them, where that makes them smaller."""
    features = np.concatenate([describe_inputs(comparison) for comparison in problem.comparisons])
    left = residuals.copy()
    best = np.sqrt(np.mean(residuals[known] ** 2, axis=0))
    for predicted in _predict_held_out(problem, features, residuals, known):
        rest = residuals - predicted
        size = np.sqrt(np.mean(rest[known] ** 2, axis=0))
        better = size < best
        left[:, better], best[better] = rest[:, better], size[better]
    return left


def _measure_speed(comparison: Comparison) -> Floats:
    """Speed of the input at the middle of every window [m/s], shape (n,)."""
    velocity = comparison.predict_velocity((), Timing())
    middle, times = comparison.windows.times.mean(axis=1), comparison.context.times
    along = np.asarray(np.interp(middle, times, velocity.x), dtype=np.float64)
    if not comparison.context.vehicle.kinematics.has_inputs("sideways"):
        return along
    return np.asarray(np.hypot(along, np.interp(middle, times, velocity.y)), dtype=np.float64)


def describe_inputs(comparison: Comparison) -> Floats:
    """Functions of the input at the middle of every window, shape (n, features)."""
    around = comparison.context
    velocity = comparison.predict_velocity((), Timing())
    middle = comparison.windows.times.mean(axis=1)
    along, around_w = _average(velocity.x, around.step_s), _average(velocity.w, around.step_s)

    def look(signal: Floats, late: float) -> Floats:
        return np.asarray(np.interp(middle - late, around.times, signal), dtype=np.float64)

    v, w = look(along, 0.0), look(around_w, 0.0)
    columns = [
        np.ones(v.size),
        v,
        w,
        v * w,
        v * np.abs(v),
        v * np.abs(w),
        w * np.abs(w),
        np.sign(v) * np.abs(w),
    ]
    columns += [np.abs(v), np.abs(w), np.abs(v) * w, v**2 * w, w**3, v**3]
    for late in _LAGS_S:
        one, two = look(along, late), look(around_w, late)
        columns += [one, two, one * two, np.abs(one) * two, one * np.abs(two)]
    yaw = look(around.from_start[:, 2], 0.0)
    moving = np.clip(np.abs(v) + np.abs(w), 0.0, 0.1) * 10.0
    columns += [moving, np.sin(yaw) * moving, np.cos(yaw) * moving]
    columns += [np.sin(look(around.attitude[:, i], 0.0)) * moving for i in (0, 1)]
    since = (middle - around.start_s) / max(around.duration_s, 1e-9)
    columns += [since * v, since * w]
    if around.vehicle.kinematics.has_inputs("sideways"):
        aside = _average(velocity.y, around.step_s)
        s = look(aside, 0.0)
        columns += [
            s,
            s * w,
            s * np.abs(s),
            s * np.abs(w),
            s * np.abs(v),
            v * np.abs(s),
            np.sign(s),
            np.abs(s),
        ]
        columns += [s**3, s**2 * w, since * s]
        for late in _LAGS_S:
            one, two = look(aside, late), look(around_w, late)
            columns += [one, one * two]
    return np.column_stack(columns)


def _average(signal: Floats, step_s: float) -> Floats:
    """Running mean over a quarter of a second."""
    width = max(round(0.25 / step_s), 1)
    total = np.concatenate(([0.0], np.cumsum(signal)))
    low = np.clip(np.arange(signal.size) - width // 2, 0, signal.size)
    high = np.clip(np.arange(signal.size) + width // 2 + 1, 0, signal.size)
    mean: Floats = (total[high] - total[low]) / (high - low)
    return mean


def _predict_held_out(problem: Problem, features: Floats, residuals: Floats, known: Flags) -> Floats:
    """Residuals as predicted from the inputs by regressions that had not seen their stretches.

    Returns:
        shape (ridges, n, 3).
    """
    predicted = np.zeros((len(_RIDGES), *residuals.shape))
    spread = 1.4826 * np.median(np.abs(residuals[known]), axis=0) + 1e-12
    target = np.clip(residuals, -_CLIP * 3.0 * spread, _CLIP * 3.0 * spread)
    for fold in problem.folds:
        tested, rows = fold.test & known, fold.train & known
        if not tested.any() or rows.sum() < 2 * features.shape[1]:
            continue
        centre = features[rows].mean(axis=0)
        scale = features[rows].std(axis=0)
        scale[scale == 0.0] = 1.0
        design = (features[rows] - centre) / scale
        normal = design.T @ design / design.shape[0]
        mean = target[rows].mean(axis=0)
        pull = design.T @ (target[rows] - mean) / design.shape[0]
        looked_at = (features[tested] - centre) / scale
        for number, ridge in enumerate(_RIDGES):
            weights = np.linalg.solve(normal + ridge * np.eye(normal.shape[0]), pull)
            predicted[number, tested] = mean + looked_at @ weights
    return predicted
