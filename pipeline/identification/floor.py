"""The noise floor: how well motion repeats itself while the input does, which no model has to do with.

Two displacements over half a second, none to two seconds apart, differ by what the input and the attitude did
differently, and by noise of the poses and random motion. The former is small and locally linear, so that a
regression of differences on differences takes it away (a difference-based estimator of variance: Rice,
Annals of Statistics 12 (1984); with regressors Yatchew, Economics Letters 57 (1997)); half the mean square of
the rest is the floor, whatever is true of the vehicle. Where more is left of pairs of which the regression
explains much than of the others, it is no line, and only the others count. What changes slowly cancels out,
and what makes windows differ the more the further they are apart (`persistence`) is no part of it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.identification.parts import average_lags, find_live
from pipeline.identification.persistence import NEAR_S, Makeup, pair_windows, split_differences
from pipeline.identification.scoring import Errors
from pipeline.models.forward import Timing

if TYPE_CHECKING:
    from pipeline.identification.comparison import Comparison
    from pipeline.identification.problem import Problem


# From the end of one window to the start of the other [s]: at zero they share a pose.
_GAPS_S = (0.0, 0.5, 1.0, 1.5, 2.0)
_LATEST_S = 0.5
# Quarters of a second before a window at which the input is looked at.
_LAGS = (0, 1, 2, 3, 4, 6, 8)
_QUIET_SHARE = 0.7
_FEWEST = 20
# Pairs by how much is explained of them, and from how many standard errors on more is left of the later ones.
_CLASSES = 12
_FEWEST_IN_CLASS = 30
_CLEARLY = 4.0
_CLIP = 3.0
_SHARE_OF_RMS = 0.5
_ROUNDS = 5
_RIDGE = 1e-3
# Windows overlap by half, and each stands in two differences.
_PAIRS_EACH = 1.7
_MOST_FREEDOM = 0.5
_MOVING_MPS = 0.1
_LEAST = 1e-18


def estimate_floor(problem: Problem) -> Errors:
    """The errors that a model would be left with that knew everything but noise and random motion.

    Against measured wheels where all runs have them, else against the command. Zero where hardly any windows
    of these runs can be compared.

    Args:
        problem: the runs; what is fitted to them does not matter.
    """
    comparisons = problem.parts[0].comparisons
    described = [_describe(comparison) for comparison in comparisons]
    repeats = np.array([_measure_repeats(comparisons, described, gap) for gap in _GAPS_S])
    # One share for all gaps: how they differ tells noise from motion.
    squares = repeats[:, 0] * np.nan_to_num(np.nanmedian(repeats[:, 1], axis=0), nan=1.0)
    # What grows with the time between windows lasts: something causes it, though nobody knows what.
    windows = sum(history.shape[0] for history, _ in described)
    x, y, w = (split_differences(np.maximum(np.nan_to_num(row), _LEAST), windows) for row in squares.T)
    after = np.linspace(0.25, 2.0, 8)
    turned = w.spread_after(after, lasting=False)
    speed = np.concatenate([np.abs(history[:, 0, 0]) for history, _ in described])
    along = x.spread_after(after, lasting=False) + y.spread_after(after, lasting=False)
    position = np.sqrt(along + float(np.mean(speed**2)) * after**2 * _share_lever(w, turned))
    yaw = np.sqrt(turned)
    rms = np.sqrt([part.jitter + part.walk + part.passing.sum() for part in (x, y, w)])
    # Of normal errors: of two coordinates the size is Rayleigh's, of one it is half-normal.
    return Errors(
        velocity_rms=(float(rms[0]), float(rms[1]), float(rms[2])),
        velocity_spread=(float(rms[0]), float(rms[1]), float(rms[2])),
        t_mrmse_m=float(np.sqrt(np.mean(position**2))),
        r_mrmse_rad=float(np.sqrt(np.mean(yaw**2))),
        t_mean_m=0.5 * math.sqrt(math.pi) * float(position.mean()),
        r_mean_rad=math.sqrt(2.0 / math.pi) * float(yaw.mean()),
        t_median_m=math.sqrt(math.log(2.0)) * float(position.mean()),
        r_median_rad=0.6745 * float(yaw.mean()),
        windows=windows,
    )


def _share_lever(w: Makeup, turned: Floats) -> Floats:
    """Variance of the mean heading error on the way: of the pose it began with, and of a walk since then."""
    start = np.full(turned.size, w.pose_noise**2)
    return start + np.maximum(turned - 2.0 * start, 0.0) / 3.0


def _describe(comparison: Comparison) -> tuple[Floats, Floats]:
    """The input before every window, shape (n, lags, 2 or 3), and all that was recorded, shape (n, p)."""
    history = average_lags(comparison, comparison.predict_velocity((), Timing()))[:, _LAGS, :]
    around, middle = comparison.context, comparison.windows.times.mean(axis=1)
    roll, pitch = (np.interp(middle, around.times, column) for column in around.attitude[:, :2].T)
    yaw = np.interp(middle, around.times, around.from_start[:, 2])
    moves = np.clip(np.abs(history[:, 0]).sum(axis=1) / _MOVING_MPS, 0.0, 1.0)[:, None]
    world = moves * np.column_stack((np.sin(yaw), np.cos(yaw), np.sin(roll), np.sin(pitch)))
    curve = history[:, :, 0] * history[:, :, 1]
    return history, np.column_stack((history.reshape(history.shape[0], -1), curve, world))


def _measure_repeats(
    comparisons: tuple[Comparison, ...], described: list[tuple[Floats, Floats]], gap_s: float
) -> Floats:
    """Half the mean square of the difference of two windows under the same input, x, y, w; NaN if unknown.

    Returns:
        Of all pairs, and the share of it that is left where little is owed to changes, shape (2, 3).
    """
    differences, features, moving, standing, lively = [], [], [], [], []
    for comparison, (history, recorded) in zip(comparisons, described, strict=True):
        first, second = pair_windows(comparison.windows.times, gap_s, _LATEST_S if gap_s > 0.0 else NEAR_S)
        residual, live = comparison.find_residuals((), Timing()), find_live(history)
        differences.append(residual[second] - residual[first])
        features.append(recorded[second] - recorded[first])
        lively.append(live)
        moving.append(live[first] & live[second])
        standing.append(~live[first] & ~live[second])
    rest, change = np.concatenate(differences), np.concatenate(features)
    moves, stands = np.concatenate(moving), np.concatenate(standing)
    if moves.sum() < _FEWEST:
        return np.full((2, 3), np.nan)
    square, alike = _take_away_changes(rest[moves], change[moves])
    still = 0.5 * np.mean(rest[stands] ** 2, axis=0) if stands.sum() >= _FEWEST else square
    share = float(np.concatenate(lively).mean())
    return np.array((share * square + (1.0 - share) * still, alike))


def _take_away_changes(rest: Floats, change: Floats) -> Floats:
    """Half the mean square of differences (n, 3), without what they owe to changes (n, p); see `_average`."""
    scaled = change / (np.sqrt((change**2).mean(axis=0)) + 1e-9)
    size = np.abs(scaled).max(axis=1)
    quiet = np.argsort(size, kind="stable")[: max(int(_QUIET_SHARE * size.size), min(size.size, 5 * _FEWEST))]
    rest, scaled, count = rest[quiet], scaled[quiet], quiet.size
    normal = scaled.T @ scaled / count
    ridge = _RIDGE * float(np.trace(normal)) / normal.shape[0] + 1e-12
    inverse = np.linalg.inv(normal + ridge * np.eye(normal.shape[0]))
    weights, left = np.zeros((normal.shape[0], 3)), rest
    for _ in range(_ROUNDS):
        weights = weights + inverse @ (scaled.T @ _hold(left) / count - ridge * weights)
        left = rest - scaled @ weights
    leverage = np.einsum("ij,jk,ik->i", scaled, inverse, scaled) * _PAIRS_EACH / count
    free = 1.0 - np.minimum(leverage, _MOST_FREEDOM)
    owed = np.abs(scaled) @ np.abs(weights)
    squares = 0.5 * _hold(left) ** 2
    return np.array([_average(*one, free) for one in zip(squares.T, owed.T, strict=True)]).T


def _average(squares: Floats, owed: Floats, free: Floats) -> tuple[float, float]:
    """Mean of squares (n,) by degree of freedom, and its share without those that grow with what is owed."""
    classes = min(_CLASSES, max(owed.size // _FEWEST_IN_CLASS, 1))
    edges = np.linspace(0, owed.size, classes + 1).astype(np.int64)[1:]
    order = np.argsort(owed, kind="stable")
    total, freedom = np.cumsum(squares[order])[edges - 1], np.cumsum(free[order])[edges - 1]
    least, seen = total / freedom, edges / _PAIRS_EACH
    beyond = (total[-1] - total[:-1]) / (freedom[-1] - freedom[:-1])
    error = least[:-1] * np.sqrt(2.0 / seen[:-1] + 2.0 / (seen[-1] - seen[:-1]))
    alike = least[:-1][beyond - least[:-1] > _CLEARLY * error]
    return float(least[-1]), float(min([least[-1], *alike]) / max(least[-1], _LEAST))


def _hold(values: Floats) -> Floats:
    """Values held at three spreads: what a jump of the poses or a late transient leaves is no noise."""
    size = np.abs(values)
    spread = np.maximum(1.4826 * np.median(size, axis=0), _SHARE_OF_RMS * np.sqrt(np.mean(size**2, axis=0)))
    return np.clip(values, -_CLIP * spread, _CLIP * spread)
