"""What residuals are made of, told by how long they last: noise of the poses, random motion, or structure.

Neighbouring windows of half a second share a pose. Its error enters them with opposite signs (correlation
-0.5), random motion is forgotten within a second, and what lasts longer than that is neither: it is motion
that the model lacks, whether or not anything that was recorded tells of it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Flags, Floats, Ints
from pipeline.identification.comparison import Comparison
from pipeline.runs.windows import WINDOW_S

_LAGS = 6
NEAR_S = 0.07
_CLIP = 6.0
_SHARE_OF_RMS = 0.5
# Correlation times [s] of random motion, and of what lasts.
_PASSING_S = (0.25, 0.5)
_LASTING_S = (1.5, 4.0, 16.0)
# The variance itself must come out right; covariances are known less well.
_FIRST = 4.0
# Below a fiftieth of the variance nobody can tell noise from structure.
_RESOLVED = 0.02
# Correlation over one to two seconds from which on something lasts: random motion comes to 0.1.
_REPEATED = 0.18
# Differences: windows that are forgotten after three lags, and the share of the largest that is structure.
_FORGOTTEN = 3
_GROWN = 0.6
_FEWEST_LASTING = 600


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
    spread = np.maximum(1.4826 * np.median(size, axis=0), _SHARE_OF_RMS * np.sqrt(np.mean(size**2, axis=0)))
    values = np.where(known[:, None], np.clip(residuals, -_CLIP * spread, _CLIP * spread), 0.0)
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
            kept = good[first] & good[second]
            sums[:, lag] += (mine[first[kept]] * mine[second[kept]]).sum(axis=0)
            counts[lag] += int(kept.sum())
    return sums / np.maximum(counts, 1.0)


def take_own_past(comparisons: Sequence[Comparison], residuals: Floats) -> Floats:
    """Residuals without what the two windows before each, which it does not overlap, tell of it.

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
    kept = (late >= -NEAR_S) & (late <= latest_s)
    return np.flatnonzero(kept), second[kept].astype(np.int64)


def _split(covariance: Floats) -> Makeup:
    """Covariances with windows 0, 0.5, ... 3 s later by origin, by non-negative least squares."""
    from scipy.optimize import nnls  # noqa: PLC0415 - heavy

    total = float(covariance[0])
    if total <= 0.0:
        return Makeup(0.0, 0.0, np.zeros(2), np.zeros(3), np.zeros(_LAGS))
    jitter, walk = np.zeros(_LAGS + 1), np.zeros(_LAGS + 1)
    jitter[:2], walk[0] = (1.0, -0.5), 1.0
    columns = [jitter, walk, *(_repeat(time) for time in (*_PASSING_S, *_LASTING_S))]
    weight = np.ones(_LAGS + 1)
    weight[0] = _FIRST
    design = np.column_stack(columns) * weight[:, None]
    parts = np.asarray(nnls(design, covariance / total * weight)[0]) * total
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
    from scipy.optimize import nnls  # noqa: PLC0415 - heavy

    jitter = np.ones(squares.size)
    jitter[0] = 1.5
    passing = [
        jitter,
        np.ones(squares.size),
        *(1.0 - _repeat(time)[1 : squares.size + 1] for time in _PASSING_S),
    ]
    lasting = [1.0 - _repeat(time)[1 : squares.size + 1] for time in _LASTING_S]
    design, known = np.column_stack([*passing, *lasting]), len(passing)
    parts = np.asarray(nnls(design, squares)[0])
    grown = float((design[:, known:] @ parts[known:])[-1])
    if grown < _GROWN * squares[-1] or windows < _FEWEST_LASTING:
        # Differences grow a little with the time between them by chance: that is no structure.
        parts[:known], parts[known:] = nnls(design[:_FORGOTTEN, :known], squares[:_FORGOTTEN])[0], 0.0
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
