"""Noise floor (repeatability of the motion under the same input) and components of the residuals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import isotonic_regression, nnls

from pipeline.core.arrays import Flags, Floats, Ints, guarded_spreads
from pipeline.estimation.comparison import Comparison
from pipeline.estimation.folds import Errors
from pipeline.estimation.parts import CLIP, average_lags, find_live
from pipeline.models.model import Timing
from pipeline.run.windows import WINDOW_S

if TYPE_CHECKING:
    from pipeline.estimation.problem import Problem

# Components of residuals by correlation time: noise of the poses, random motion, and structure.
#
# Neighbouring windows of half a second share a pose. Its error enters them with opposite signs (correlation
# -0.5). Random motion is uncorrelated after a second. A component with a longer correlation time is neither:
# it is motion that the model lacks, whether or not it depends on a recorded signal.

_LAGS = 6
"""Number of lags of the autocovariance that distinguish jitter from a random walk."""
NEAR_S = 0.07
"""Tolerance of the start of a paired window [s]."""
# Correlation times [s] of random motion, and of structure.
_PASSING_S: tuple[float, ...] = (0.25, 0.5)
_LASTING_S: tuple[float, ...] = (1.5, 4.0, 16.0)
"""Correlation times of structure, which a model could still explain [s]."""
# Weight of the variance itself: covariances are known less accurately.
_FIRST = 4.0
# Share of the variance below which noise is not distinguishable from structure.
_RESOLVED = 0.02
# Threshold of the mean correlation over one to two seconds for structure: random motion comes to 0.1.
_REPEATED = 0.18
# For differences: number of lags after which noise is uncorrelated, and the threshold for structure.
_FORGOTTEN = 3
_LONGEST_S = 2.5
"""Longest correlation time of noise [s]: as long as the time that paired windows are apart."""
_GROWN = 0.85
"""Share of the last square by which structure must have grown to be distinguished from noise."""
_FEWEST_LASTING = 600
"""Minimum number of windows for estimating structure."""


@dataclass(frozen=True)
class Makeup:
    """Residual variance of one channel by origin.

    Attributes:
        jitter: variance by errors of single poses.
        walk: variance by a random walk: independent errors of each window.
        passing: variance of random motion, by correlation time, shape (k,).
        lasting: variance of structure, by correlation time, shape (l,).
        correlation: correlation with the window 0.5, 1, ... s later, shape (lags,).
        passing_s: correlation times of random motion [s].
    """

    jitter: float
    walk: float
    passing: Floats
    lasting: Floats
    correlation: Floats
    passing_s: tuple[float, ...] = _PASSING_S

    @property
    def lasting_share(self) -> float:
        """Share of structure in the variance."""
        total = self.jitter + self.walk + float(self.passing.sum()) + float(self.lasting.sum())
        return float(self.lasting.sum()) / total if total > 0.0 else 0.0

    @property
    def pose_noise(self) -> float:
        """Error of a single pose [m or rad]: a window is the difference of two over its length."""
        return WINDOW_S * math.sqrt(0.5 * self.jitter)

    def spread_after(self, seconds: Floats) -> Floats:
        """Variance of the integral of the residual without structure over ``seconds``, shape (n,)."""
        total = self.jitter * WINDOW_S**2 + self.walk * WINDOW_S * seconds
        for share, time in zip(self.passing.tolist(), self.passing_s, strict=True):
            total = total + share * _grow(seconds, time) / _grow(np.array([WINDOW_S]), time) * WINDOW_S**2
        return total


def split_residuals(comparisons: Sequence[Comparison], residuals: Floats) -> tuple[Makeup, Makeup, Makeup]:
    """Components of the residuals x, y, w of a model.

    Args:
        comparisons: runs with the windows.
        residuals: shape (n, 3); NaN rows are ignored.
    """
    covariance = _covary(comparisons, residuals)
    x, y, w = (_split(row) for row in covariance)
    return x, y, w


def _covary(comparisons: Sequence[Comparison], residuals: Floats) -> Floats:
    """Mean products of residuals of windows 0, 0.5, ... 3 s apart, outliers clipped, shape (3, lags + 1)."""
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
    """Residuals less their regression on the two preceding windows that do not overlap (prewhitening).

    Args:
        comparisons: runs with the windows.
        residuals: x, y, w, shape (n, 3); the result is zero for windows without predecessors.
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
    """Indices of windows, and of the first window that begins a gap after the end of each.

    Args:
        times: start and end of each window [s], shape (n, 2).
        gap_s: time from the end of the one to the start of the other [s].
        latest_s: tolerance by which the other may begin later [s].
    """
    wanted = times[:, 1] + gap_s
    second = np.minimum(np.searchsorted(times[:, 0], wanted - NEAR_S), times.shape[0] - 1)
    late = times[second, 0] - wanted
    mask = (late >= -NEAR_S) & (late <= latest_s)
    return np.flatnonzero(mask), second[mask].astype(np.int64)


def _split(covariance: Floats) -> Makeup:
    """Components of the covariances with windows 0, 0.5, ... 3 s later, by non-negative least squares."""
    total = float(covariance[0])
    if total <= 0.0:
        return Makeup(0.0, 0.0, np.zeros(2), np.zeros(3), np.zeros(_LAGS))
    jitter, walk = np.zeros(_LAGS + 1), np.zeros(_LAGS + 1)
    jitter[:2], walk[0] = (1.0, -0.5), 1.0
    columns = [jitter, walk, *(_repeat(time) for time in (*_PASSING_S, *_LASTING_S))]
    weight = np.ones(_LAGS + 1)
    weight[0] = _FIRST
    design = np.column_stack(columns) * weight[:, None]
    parts = nnls(design, covariance / total * weight)[0] * total
    known = len(_PASSING_S) + 2
    if covariance[2:5].mean() < _REPEATED * total:
        # A finite sample of random motion is correlated by chance: that is not structure.
        parts[1] += parts[known:].sum()
        parts[known:] = 0.0
    noise = float(parts[:known].sum())
    if noise < _RESOLVED * total:
        parts[known:] *= (1.0 - _RESOLVED) / max(float(parts[known:].sum()) / total, 1e-12)
        parts[1] += _RESOLVED * total - noise
    return Makeup(
        float(parts[0]), float(parts[1]), parts[2:known], parts[known:], np.asarray(covariance[1:] / total)
    )


def split_differences(squares: Floats, windows: int, corrected_s: float = 0.0) -> Makeup:
    """Components of the motion of one channel under the same input.

    Args:
        squares: half the mean squares of the differences of windows 0, 0.5, 1, ... s apart, NaN where there
            are too few, shape (k,), k <= 6.
        windows: number of windows: with few of them, structure is not distinguishable from chance.
        corrected_s: time between two corrections of the localization [s], between which its error grows
            steadily: motion for half of it is noise.
    """
    passing, lasting = _PASSING_S, _LASTING_S
    if corrected_s > 0.0:
        passing = (*passing, min(0.5 * corrected_s, _LONGEST_S))
        lasting = tuple(time for time in lasting if time > 2.0 * corrected_s) or lasting[-1:]
    jitter = np.ones(squares.size)
    jitter[0] = 1.5
    grown = (1.0 - _repeat(time)[1 : squares.size + 1] for time in (*passing, *lasting))
    design, known = np.column_stack([jitter, np.ones(squares.size), *grown]), 2 + len(passing)
    measured = np.isfinite(squares)
    if not measured.any():
        measured, squares = ~measured, np.full(squares.size, _LEAST)
    design, squares = design[measured], squares[measured]
    parts = nnls(design, squares)[0]
    structure = float((design[:, known:] @ parts[known:])[-1])
    if structure < _GROWN * squares[-1] or windows < _FEWEST_LASTING:
        # Differences grow a little with the time between them by chance: that is not structure.
        parts[:known] = nnls(design[:_FORGOTTEN, :known], squares[:_FORGOTTEN])[0]
        parts[known:] = 0.0
    # Noise within two standard errors of the first square cannot be told from none.
    least = 2.0 * math.sqrt(2.0 * _PAIRS_EACH / max(windows, 1)) * float(squares[0])
    parts[1] += max(least - float(design[0, :known] @ parts[:known]), 0.0)
    correlation = 1.0 - squares / squares[-1]
    return Makeup(float(parts[0]), float(parts[1]), parts[2:known], parts[known:], correlation, passing)


def _repeat(time: float) -> Floats:
    """Correlation of window means of a signal with a correlation time of ``time`` seconds."""
    ratio = WINDOW_S / time
    alone = 2.0 * (ratio - 1.0 + np.exp(-ratio))
    apart = (1.0 - np.exp(-ratio)) ** 2 * np.exp(-ratio * np.arange(_LAGS))
    return np.concatenate(([1.0], apart / alone))


def _grow(seconds: Floats, time: float) -> Floats:
    """Variance of the integral of such a signal of variance one."""
    ratio = seconds / time
    return 2.0 * time**2 * (ratio - 1.0 + np.exp(-ratio))


# Noise floor: repeatability of the motion under the same input, independent of any model.
#
# Two displacements over half a second, zero to two seconds apart, differ by changes of the input and the
# attitude, and by noise of the poses and random motion. The former part is small and locally linear, so that
# a regression of differences on differences removes it (a difference-based estimator of variance:
# Rice, Annals of Statistics 12 (1984); with regressors Yatchew, Economics Letters 57 (1997)); half the mean
# square of its residuals is the floor, for any vehicle. If the residuals are larger for pairs of which the
# regression explains much than for the others, the relation is not linear, and only the others are used.
# Slow changes cancel out, and differences that grow with the time between windows (`persistence`) are
# excluded.

# Gaps from the end of one window to the start of the other [s]: at zero they share a pose.
_GAPS_S = (0.0, 0.5, 1.0, 1.5, 2.0)
_LATEST_S = 0.5
"""Tolerance of the start of a window after a gap [s]."""
# Lags of the input before a window [quarters of a second].
_HISTORY_QUARTERS = (0, 1, 2, 3, 4, 6, 8)
_QUIET_SHARE = 0.7
"""Share of window pairs, those with the smallest changes, from which noise is measured."""
_FEWEST = 20
"""Minimum number of windows for a mean square."""
_STRATA = 5
"""Classes of pairs by yaw rate, each weighted by its part of all pairs."""
_STRATUM = 100
"""Minimum number of pairs per class by yaw rate."""
# Number of classes of pairs, by how much the regression explains of them.
_CLASSES = 12
_FEWEST_IN_CLASS = 30
"""Minimum number of pairs per class."""
_CLEARLY = 4.0
"""Threshold [standard errors] for calling one mean square smaller than another."""
_HELD_SPREADS = 3.0
"""Clipping limit of differences [robust standard deviations]."""
_ROUNDS = 5
"""Number of rounds of reweighting."""
_RIDGE = 1e-3
"""Regularization of the regression, as a share of the mean information."""
# Windows overlap by half, and each is part of two differences.
_PAIRS_EACH = 1.7
_MOST_FREEDOM = 0.5
"""Upper limit of the leverage of a window."""
_MOVING_MPS = 0.1
"""Sum of ideal speeds [m/s] and yaw rate [rad/s] below which a vehicle counts as partly at rest."""
_LEAST = 1e-18
"""Square below which noise is rounding."""


def estimate_floor(problem: Problem) -> Errors:
    """The errors of a model that explains everything but noise and random motion.

    They refer to measured wheels if all runs have them, else to the command. They are zero if hardly any
    windows of these runs can be compared.

    Args:
        problem: the runs; fitted values have no influence.
    """
    comparisons = problem.parts[0].comparisons
    described = [_list_conditions(comparison) for comparison in comparisons]
    repeats = np.array([_measure_repeats(comparisons, described, gap) for gap in _GAPS_S])
    squares = repeats[:, 0] * np.array([_smooth_falling(shares) for shares in repeats[:, 1].T]).T
    # Differences that grow with the time between windows are structure: they have an unknown cause.
    windows = sum(history.shape[0] for history, _ in described)
    corrected = max(comparison.run.corrected_s for comparison in comparisons)
    x, y, w = (split_differences(np.maximum(row, _LEAST), windows, corrected) for row in squares.T)
    after = np.linspace(0.25, 2.0, 8)
    turned = w.spread_after(after)
    speed = np.concatenate([np.abs(history[:, 0, 0]) for history, _ in described])
    along = x.spread_after(after) + y.spread_after(after)
    position = np.sqrt(along + float(np.mean(speed**2)) * after**2 * _share_lever(w, turned))
    yaw = np.sqrt(turned)
    rms = np.sqrt([part.jitter + part.walk + part.passing.sum() for part in (x, y, w)])
    # For normal errors, the size of two coordinates is Rayleigh distributed, that of one half-normal.
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
    """Variance of the mean heading error over the prediction: of its first pose, and of a walk since then."""
    start = np.full(turned.size, w.pose_noise**2)
    return start + np.maximum(turned - 2.0 * start, 0.0) / 3.0


def _list_conditions(comparison: Comparison) -> tuple[Floats, Floats]:
    """The input before each window, shape (n, lags, 2 or 3), and all regressors, shape (n, p)."""
    history = average_lags(comparison, comparison.predict_velocity((), Timing()))[:, _HISTORY_QUARTERS, :]
    context, middle = comparison.context, comparison.windows.times.mean(axis=1)
    roll, pitch = (np.interp(middle, context.times, column) for column in context.attitude[:, :2].T)
    yaw = np.interp(middle, context.times, context.from_start[:, 2])
    moves = np.clip(np.abs(history[:, 0]).sum(axis=1) / _MOVING_MPS, 0.0, 1.0)[:, None]
    world = moves * np.column_stack((np.sin(yaw), np.cos(yaw), np.sin(roll), np.sin(pitch)))
    curve = history[:, :, 0] * history[:, :, 1]
    regressors = [history.reshape(history.shape[0], -1), curve, world]
    if context.vehicle.kinematics.has_inputs("steering"):
        # A car turns the less for its steering the faster it is; what that adds changes within a turn.
        regressors.append(history[:, 0, 0] * curve[:, 0])
    return history, np.column_stack(regressors)


def _measure_repeats(
    comparisons: tuple[Comparison, ...], described: list[tuple[Floats, Floats]], gap_s: float
) -> Floats:
    """Half the mean square of the difference of two windows under the same input, x, y, w; NaN if unknown.

    Returns:
        The value of all pairs, and the share of it for pairs with little effect of changes, shape (2, 3).
    """
    differences, features, turning, moving, standing, lively = [], [], [], [], [], []
    for comparison, (history, recorded) in zip(comparisons, described, strict=True):
        first, second = pair_windows(comparison.windows.times, gap_s, _LATEST_S if gap_s > 0.0 else NEAR_S)
        residual, live = comparison.find_residuals((), Timing()), find_live(history)
        differences.append(residual[second] - residual[first])
        features.append(recorded[second] - recorded[first])
        turning.append(np.abs(history[:, 0, 1])[np.array((first, second))].max(axis=0))
        lively.append(live)
        moving.append(live[first] & live[second])
        standing.append(~live[first] & ~live[second])
    rest, change, turns = map(np.concatenate, (differences, features, turning))
    moves, stands = np.concatenate(moving), np.concatenate(standing)
    if moves.sum() < _FEWEST:
        return np.full((2, 3), np.nan)
    square, alike = _take_away_changes(rest[moves], change[moves], turns[moves])
    still = 0.5 * np.mean(rest[stands] ** 2, axis=0) if stands.sum() >= _FEWEST else square
    share = float(np.concatenate(lively).mean())
    return np.array((share * square + (1.0 - share) * still, alike))


def _take_away_changes(rest: Floats, change: Floats, turning: Floats) -> Floats:
    """Half the mean square of differences (n, 3) less their regression on changes (n, p); see `_average`.

    Each class of yaw rates (n,) counts by its part of all pairs: noise may grow with it, and calm pairs are
    mostly straight.
    """
    scaled = change / (np.sqrt((change**2).mean(axis=0)) + 1e-9)
    size = np.abs(scaled).max(axis=1)
    strata = np.array_split(np.argsort(turning, kind="stable"), min(_STRATA, max(size.size // _STRATUM, 1)))
    limit, least = np.quantile(size, _QUIET_SHARE), min(5 * _FEWEST, size.size) // len(strata)
    chosen = [
        rows[np.argsort(size[rows], kind="stable")[: max(int((size[rows] <= limit).sum()), least)]]
        for rows in strata
    ]
    quiet, ends = np.concatenate(chosen), np.cumsum([rows.size for rows in chosen])[:-1]
    shares = [rows.size / size.size for rows in strata]
    rest, scaled, count = rest[quiet], scaled[quiet], quiet.size
    normal = scaled.T @ scaled / count
    ridge = _RIDGE * float(np.trace(normal)) / normal.shape[0] + 1e-12
    inverse = np.linalg.inv(normal + ridge * np.eye(normal.shape[0]))
    weights, residual = np.zeros((normal.shape[0], 3)), rest
    for _ in range(_ROUNDS):
        held = np.concatenate([_hold(part) for part in np.split(residual, ends)])
        weights = weights + inverse @ (scaled.T @ held / count - ridge * weights)
        residual = rest - scaled @ weights
    leverage = np.einsum("ij,jk,ik->i", scaled, inverse, scaled) * _PAIRS_EACH / count
    free = 1.0 - np.minimum(leverage, _MOST_FREEDOM)
    owed = np.abs(scaled) @ np.abs(weights)
    total, alike = np.zeros(3), np.zeros(3)
    parts = zip(shares, *(np.split(values, ends) for values in (residual, owed, free)), strict=True)
    for share, part, mine, freedom in parts:
        squares = 0.5 * _hold(part) ** 2
        each = np.array([_average(*one, freedom) for one in zip(squares.T, mine.T, strict=True)])
        total += each[:, 0] * share
        alike += each.prod(axis=1) * share
    return np.array((total, alike / np.maximum(total, _LEAST)))


def _average(squares: Floats, owed: Floats, free: Floats) -> tuple[float, float]:
    """Mean of squares (n,) per degree of freedom, and its share without classes that grow with ``owed``."""
    classes = min(_CLASSES, max(owed.size // _FEWEST_IN_CLASS, 1))
    edges = np.linspace(0, owed.size, classes + 1).astype(np.int64)[1:]
    order = np.argsort(owed, kind="stable")
    total, freedom = np.cumsum(squares[order])[edges - 1], np.cumsum(free[order])[edges - 1]
    least, seen = total / freedom, edges / _PAIRS_EACH
    beyond = (total[-1] - total[:-1]) / (freedom[-1] - freedom[:-1])
    error = least[:-1] * np.sqrt(2.0 / seen[:-1] + 2.0 / (seen[-1] - seen[:-1]))
    alike = least[:-1][beyond - least[:-1] > _CLEARLY * error]
    return float(least[-1]), float(min([least[-1], *alike]) / max(least[-1], _LEAST))


def _smooth_falling(shares: Floats) -> Floats:
    """Shares by gap as they fall with it: the least squares fit that never rises, one where all are unknown.

    What is not linear grows with the gap; one share for all gaps would make structure of it.
    """
    known = np.flatnonzero(np.isfinite(shares))
    if not known.size:
        return np.ones(shares.size)
    smooth: Floats = np.interp(
        np.arange(shares.size), known, isotonic_regression(shares[known], increasing=False).x
    )
    return smooth


def _hold(values: Floats) -> Floats:
    """Values clipped at three spreads: residuals of pose jumps or late transients are not noise."""
    size = np.abs(values)
    spread = guarded_spreads(size)
    return np.clip(values, -_HELD_SPREADS * spread, _HELD_SPREADS * spread)
