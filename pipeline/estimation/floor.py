"""The noise floor: how well motion repeats itself while the input does, and what residuals are made of."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.arrays import Flags, Floats, Ints, guarded_spreads
from pipeline.core.numerics import solve_nonnegative
from pipeline.estimation.comparison import Comparison
from pipeline.estimation.folds import Errors
from pipeline.estimation.parts import CLIP, average_lags, find_live
from pipeline.models.model import Timing
from pipeline.run.windows import WINDOW_S

if TYPE_CHECKING:
    from pipeline.estimation.problem import Problem

# What residuals are made of, told by how long they last: noise of the poses, random motion, or structure.
#
# Neighbouring windows of half a second share a pose. Its error enters them with opposite signs (correlation
# -0.5), random motion is forgotten within a second, and what lasts longer than that is neither: it is motion
# that the model lacks, whether or not anything that was recorded tells of it.

_LAGS = 6
"""Lags of the autocovariance that jitter and random walk are told apart by."""
NEAR_S = 0.07
"""Windows count as neighbours when they begin within so much of each other [s]."""
# Correlation times [s] of random motion, and of what lasts.
_PASSING_S = (0.25, 0.5)
_LASTING_S = (1.5, 4.0, 16.0)
"""Correlation times of what a model could still explain [s]."""
# The variance itself must come out right; covariances are known less well.
_FIRST = 4.0
# Below a fiftieth of the variance nobody can tell noise from structure.
_RESOLVED = 0.02
# Correlation over one to two seconds from which on something lasts: random motion comes to 0.1.
_REPEATED = 0.18
# Differences: windows that are forgotten after three lags, and the share of the largest that is structure.
_FORGOTTEN = 3
_GROWN = 0.6
"""Share of the final square by which lasting structure must have grown to be told from noise."""
_FEWEST_LASTING = 600
"""Windows that lasting structure needs."""


@dataclass(frozen=True)
class Makeup:
    """One channel's residual variance by origin.

    Attributes:
        jitter: of errors of single poses.
        walk: of errors that add up from window to window without memory.
        passing: of random motion, by `_PASSING_S`, shape (2,).
        lasting: of structure, by `_LASTING_S`, shape (3,).
        correlation: with the window 0.5, 1, ... s later, shape (lags,).
    """

    jitter: float
    walk: float
    passing: Floats
    lasting: Floats
    correlation: Floats

    @property
    def lasting_share(self) -> float:
        """Share of the variance that is structure."""
        total = self.jitter + self.walk + float(self.passing.sum()) + float(self.lasting.sum())
        return float(self.lasting.sum()) / total if total > 0.0 else 0.0

    @property
    def pose_noise(self) -> float:
        """Error of a single pose [m or rad]: a window takes the difference of two over its length."""
        return WINDOW_S * math.sqrt(0.5 * self.jitter)

    def spread_after(self, seconds: Floats, *, lasting: bool) -> Floats:
        """Variance of the integral of the residual over ``seconds``, with or without what lasts.

        Args:
            seconds: shape (n,).
            lasting: whether structure counts.
        """
        total = self.jitter * WINDOW_S**2 + self.walk * WINDOW_S * seconds
        for share, time in zip(self.passing.tolist(), _PASSING_S, strict=True):
            total = total + share * _grow(seconds, time) / _grow(np.array([WINDOW_S]), time) * WINDOW_S**2
        if lasting:
            for share, time in zip(self.lasting.tolist(), _LASTING_S, strict=True):
                total = total + share * _grow(seconds, time) / _grow(np.array([WINDOW_S]), time) * WINDOW_S**2
        return total


def split_residuals(comparisons: Sequence[Comparison], residuals: Floats) -> tuple[Makeup, Makeup, Makeup]:
    """What the residuals x, y, w of a model are made of.

    Args:
        comparisons: whose windows they are.
        residuals: shape (n, 3); NaN rows count nothing.
    """
    covariance = _covary(comparisons, residuals)
    x, y, w = (_split(row) for row in covariance)
    return x, y, w


def _covary(comparisons: Sequence[Comparison], residuals: Floats) -> Floats:
    """Mean products of residuals of windows 0, 0.5, ... 3 s apart, outliers held, shape (3, lags + 1)."""
    sums, counts = np.zeros((3, _LAGS + 1)), np.zeros(_LAGS + 1)
    known: Flags = np.asarray(np.isfinite(residuals).all(axis=1))
    if not known.any():
        return sums
    size = np.abs(residuals[known])
    spread = guarded_spreads(size)
    values = np.where(known[:, None], np.clip(residuals, -CLIP * spread, CLIP * spread), 0.0)
    shift = 0
    for comparison in comparisons:
        times = comparison.windows.times
        rows = slice(shift, shift + times.shape[0])
        shift += times.shape[0]
        mine, good = values[rows], known[rows]
        sums[:, 0] += (mine[good] ** 2).sum(axis=0)
        counts[0] += int(good.sum())
        for lag in range(1, _LAGS + 1):
            first, second = pair_windows(times, (lag - 1) * WINDOW_S)
            mask = good[first] & good[second]
            sums[:, lag] += (mine[first[mask]] * mine[second[mask]]).sum(axis=0)
            counts[lag] += int(mask.sum())
    return sums / np.maximum(counts, 1.0)


def take_own_past(comparisons: Sequence[Comparison], residuals: Floats) -> Floats:
    """Residuals without what the two windows before each, which it does not overlap, say about it.

    Args:
        comparisons: whose windows they are.
        residuals: x, y, w, shape (n, 3); where nothing goes before a window it is zero.
    """
    past = np.full((2, *residuals.shape), np.nan)
    shift = 0
    for comparison in comparisons:
        times = comparison.windows.times
        for lag in (1, 2):
            first, second = pair_windows(times, (lag - 1) * WINDOW_S)
            past[lag - 1, shift + second] = residuals[shift + first]
        shift += times.shape[0]
    known = np.isfinite(past).all(axis=(0, 2))
    fresh = np.zeros(residuals.shape)
    for channel in range(residuals.shape[1]):
        design, target = past[:, known, channel].T, residuals[known, channel]
        fresh[known, channel] = target - design @ np.linalg.lstsq(design, target, rcond=None)[0]
    return fresh


def pair_windows(times: Floats, gap_s: float, latest_s: float = NEAR_S) -> tuple[Ints, Ints]:
    """Windows, and the first of those that begin a gap after their ends.

    Args:
        times: start and end of each window [s], shape (n, 2).
        gap_s: from the end of the one to the start of the other [s].
        latest_s: how much later the other may begin [s].
    """
    wanted = times[:, 1] + gap_s
    second = np.minimum(np.searchsorted(times[:, 0], wanted - NEAR_S), times.shape[0] - 1)
    late = times[second, 0] - wanted
    mask = (late >= -NEAR_S) & (late <= latest_s)
    return np.flatnonzero(mask), second[mask].astype(np.int64)


def _split(covariance: Floats) -> Makeup:
    """Covariances with windows 0, 0.5, ... 3 s later by origin, by non-negative least squares."""
    total = float(covariance[0])
    if total <= 0.0:
        return Makeup(0.0, 0.0, np.zeros(2), np.zeros(3), np.zeros(_LAGS))
    jitter, walk = np.zeros(_LAGS + 1), np.zeros(_LAGS + 1)
    jitter[:2], walk[0] = (1.0, -0.5), 1.0
    columns = [jitter, walk, *(_repeat(time) for time in (*_PASSING_S, *_LASTING_S))]
    weight = np.ones(_LAGS + 1)
    weight[0] = _FIRST
    design = np.column_stack(columns) * weight[:, None]
    parts = solve_nonnegative(design, covariance / total * weight) * total
    known = len(_PASSING_S) + 2
    if covariance[2:5].mean() < _REPEATED * total:
        # Sampled random motion repeats itself by chance: that is no structure.
        parts[1] += parts[known:].sum()
        parts[known:] = 0.0
    noise = float(parts[:known].sum())
    if noise < _RESOLVED * total:
        parts[known:] *= (1.0 - _RESOLVED) / max(float(parts[known:].sum()) / total, 1e-12)
        parts[1] += _RESOLVED * total - noise
    return Makeup(
        float(parts[0]), float(parts[1]), parts[2:known], parts[known:], np.asarray(covariance[1:] / total)
    )


def split_differences(squares: Floats, windows: int) -> Makeup:
    """What one channel's motion under the same input is made of.

    Args:
        squares: half the mean squares of the differences of windows 0.5, 1, ... s apart, shape (k,), k <= 6.
        windows: how many there are: in few nobody can tell what lasts from chance.
    """
    jitter = np.ones(squares.size)
    jitter[0] = 1.5
    passing = [
        jitter,
        np.ones(squares.size),
        *(1.0 - _repeat(time)[1 : squares.size + 1] for time in _PASSING_S),
    ]
    lasting = [1.0 - _repeat(time)[1 : squares.size + 1] for time in _LASTING_S]
    design, known = np.column_stack([*passing, *lasting]), len(passing)
    parts = solve_nonnegative(design, squares)
    grown = float((design[:, known:] @ parts[known:])[-1])
    if grown < _GROWN * squares[-1] or windows < _FEWEST_LASTING:
        # Differences grow a little with the time between them by chance: that is no structure.
        parts[:known] = solve_nonnegative(design[:_FORGOTTEN, :known], squares[:_FORGOTTEN])
        parts[known:] = 0.0
    # Noise within two standard errors of the first square cannot be told from none.
    least = 2.0 * math.sqrt(2.0 * _PAIRS_EACH / max(windows, 1)) * float(squares[0])
    parts[1] += max(least - float(design[0, :known] @ parts[:known]), 0.0)
    return Makeup(
        float(parts[0]), float(parts[1]), parts[2:known], parts[known:], 1.0 - squares / squares[-1]
    )


def _repeat(time: float) -> Floats:
    """Correlation of window means of a signal that is forgotten within ``time`` seconds."""
    ratio = WINDOW_S / time
    alone = 2.0 * (ratio - 1.0 + np.exp(-ratio))
    apart = (1.0 - np.exp(-ratio)) ** 2 * np.exp(-ratio * np.arange(_LAGS))
    return np.concatenate(([1.0], apart / alone))


def _grow(seconds: Floats, time: float) -> Floats:
    """Variance of the integral of such a signal of variance one."""
    ratio = seconds / time
    return 2.0 * time**2 * (ratio - 1.0 + np.exp(-ratio))


# The noise floor: how well motion repeats itself while the input does, which no model has to do with.
#
# Two displacements over half a second, none to two seconds apart, differ by what the input and the attitude
# did differently, and by noise of the poses and random motion. The former is small and locally linear, so
# that a regression of differences on differences takes it away (a difference-based estimator of variance:
# Rice, Annals of Statistics 12 (1984); with regressors Yatchew, Economics Letters 57 (1997)); half the mean
# square of the rest is the floor, whatever is true of the vehicle. Where more is left of pairs of which the
# regression explains much than of the others, it is no line, and only the others count. What changes slowly
# cancels out, and what makes windows differ the more the further they are apart (`persistence`) is no part of
# it.

# From the end of one window to the start of the other [s]: at zero they share a pose.
_GAPS_S = (0.0, 0.5, 1.0, 1.5, 2.0)
_LATEST_S = 0.5
"""Latest partner of a window behind a gap [s]."""
# Quarters of a second before a window at which the input is looked at.
_HISTORY_QUARTERS = (0, 1, 2, 3, 4, 6, 8)
_QUIET_SHARE = 0.7
"""Share of windows, the quietest, from which noise is measured."""
_FEWEST = 20
"""Windows below which a mean square is not used."""
# Pairs by how much is explained of them, and from how many standard errors on more is left of the later ones.
_CLASSES = 12
_FEWEST_IN_CLASS = 30
"""Windows in a class of motion."""
_CLEARLY = 4.0
"""Standard errors by which a square must be below another to be smaller."""
_HELD_SPREADS = 3.0
"""Robust standard deviations at which differences are held."""
_ROUNDS = 5
"""Rounds of reweighting."""
_RIDGE = 1e-3
"""Share of the mean information that keeps the regression solvable."""
# Windows overlap by half, and each stands in two differences.
_PAIRS_EACH = 1.7
_MOST_FREEDOM = 0.5
"""Largest leverage of a window that counts."""
_MOVING_MPS = 0.1
"""Sum of ideal speeds [m/s] and yaw rate [rad/s] below which a vehicle counts as partly at rest."""
_LEAST = 1e-18
"""Square below which noise is rounding."""


def estimate_floor(problem: Problem) -> Errors:
    """The errors that a model would be left with that knew everything but noise and random motion.

    Against measured wheels where all runs have them, else against the command. Zero where hardly any windows
    of these runs can be compared.

    Args:
        problem: the runs; what is fitted to them does not matter.
    """
    comparisons = problem.parts[0].comparisons
    described = [_list_conditions(comparison) for comparison in comparisons]
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


def _list_conditions(comparison: Comparison) -> tuple[Floats, Floats]:
    """The input before every window, shape (n, lags, 2 or 3), and all that was recorded, shape (n, p)."""
    history = average_lags(comparison, comparison.predict_velocity((), Timing()))[:, _HISTORY_QUARTERS, :]
    context, middle = comparison.context, comparison.windows.times.mean(axis=1)
    roll, pitch = (np.interp(middle, context.times, column) for column in context.attitude[:, :2].T)
    yaw = np.interp(middle, context.times, context.from_start[:, 2])
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
    weights, residual = np.zeros((normal.shape[0], 3)), rest
    for _ in range(_ROUNDS):
        weights = weights + inverse @ (scaled.T @ _hold(residual) / count - ridge * weights)
        residual = rest - scaled @ weights
    leverage = np.einsum("ij,jk,ik->i", scaled, inverse, scaled) * _PAIRS_EACH / count
    free = 1.0 - np.minimum(leverage, _MOST_FREEDOM)
    owed = np.abs(scaled) @ np.abs(weights)
    squares = 0.5 * _hold(residual) ** 2
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
    spread = guarded_spreads(size)
    return np.clip(values, -_HELD_SPREADS * spread, _HELD_SPREADS * spread)
