"""Arrays: types, sampling on uniform grids, robust regression, quantiles, likelihoods of heavy tails."""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from pipeline.core.text import CONFIDENCE, FEWEST_OF_SPREAD

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]
Complex = NDArray[np.complex128]

_POINTS = 4096
"""Number of tabulated points of the unit circle, a power of two: the remainder of an angle in `turn_units` is
at most 8e-4 rad."""
_CIRCLE: Complex = np.exp(2j * np.pi * np.arange(_POINTS) / _POINTS)


def join_parts(real: Floats, imaginary: Floats | float) -> Complex:
    """Complex numbers from their real and imaginary parts, shape (n,)."""
    joined = np.empty(real.shape, dtype=np.complex128)
    joined.real, joined.imag = real, imaginary
    return joined


def group_rows(number: NDArray[Any]) -> list[Ints]:
    """Row indices grouped by number, groups and rows in ascending order."""
    order = np.argsort(number, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(number[order])) + 1)


_RESAMPLES = 200
"""Bootstrap resamples: they give the standard deviation to a twentieth."""


def resample_median(values: Floats, times: Floats) -> Floats:
    """Medians of bootstrap samples, drawn by stretches of ten seconds: samples next to each other are alike.

    Args:
        values: shape (n,).
        times: their times [s], increasing, shape (n,).

    Returns:
        The medians, shape (k,); none where there are fewer stretches than for a spread.
    """
    stretches = group_rows(number_stretches(times - times[:1]))
    if len(stretches) < FEWEST_OF_SPREAD:
        return np.empty(0)
    drawn = np.random.default_rng(0).integers(len(stretches), size=(_RESAMPLES, len(stretches))).tolist()
    return np.array([np.median(values[np.concatenate([stretches[i] for i in one])]) for one in drawn])


def bound_median(values: Floats, times: Floats) -> tuple[float, float] | None:
    """95 % interval of a median over other stretches of ten seconds of the same driving.

    Args:
        values: shape (n,).
        times: their times [s], increasing, shape (n,).

    Returns:
        None where there are fewer stretches than for a spread.
    """
    drawn = resample_median(values, times)
    if not drawn.size:
        return None
    low, high = np.quantile(drawn, (0.5 * (1.0 - CONFIDENCE), 0.5 * (1.0 + CONFIDENCE))).tolist()
    return low, high


def recur(values: Floats, factors: Floats) -> Floats:
    """Solve x_k = v_k + f_k x_(k-1) for each column.

    Args:
        values: v, shape (n,) or (n, c).
        factors: f of the rows after the first, shape (n - 1,).
    """
    # LAPACK takes columns: rows would be copied.
    bands = np.ones((2, values.shape[0]), order="F")
    bands[1, :-1] = -factors
    solved, _ = scipy.linalg.lapack.dtbtrs(bands, values, uplo="L", diag="U")
    return np.asarray(solved, dtype=np.float64)


def turn_units(angle: Floats) -> Complex:
    """exp(i angle) of angles [rad], shape (n,): tabulated points of the circle times a series.

    The remainder is at most 8e-4 rad: its fifth and higher powers are below rounding.
    """
    nearest = np.rint(angle * (_POINTS / (2.0 * np.pi)))
    rest = angle - nearest * (2.0 * np.pi / _POINTS)
    square = rest * rest
    turned = join_parts(1.0 - square * (0.5 - square / 24.0), rest * (1.0 - square / 6.0))
    turned *= _CIRCLE.take(nearest.astype(np.int64) & (_POINTS - 1))
    return turned


# Sampling in time: holding, interpolating and differentiating series on uniform grids.
#
# Times are float64 seconds, increasing. Nothing here crosses a segment: callers pass one segment at a time.

ROUNDING_S = 1e-6
"""Times [s] that differ by less are equal: a double resolves a stamp since 1970 to 2.4e-7 s."""
SILENT_S = 0.25
"""Time from the nearest message [s] above which wheel and gyro signals are unknown: `PERIODS` at 20 Hz."""
PAUSE_NS = 3_600_000_000_000
"""Silence of all topics [ns] above which the clock of the recorder was set, or its recording paused: no
drive contains an hour of which nothing was recorded."""
_FEWEST_POINTS = 4
"""Minimum number of poses of a quadratic fit: its coefficients plus one, to average noise. With eight, slow
poses are smoothed more: the median slip of one recording falls by 0.2 % (`make bench NAME=constants`)."""
_BLOCK = 4096
"""Number of queries fitted at a time, which limits memory; results do not depend on it."""
PERIODS = 5.0
"""Number of typical periods after which a message is missing, not late; with half of it, two lost messages
stop a vehicle."""
SHORTEST_PERIOD = 1e-3
"""Assumed period of samples with equal stamps [s]."""


def hold_indices(at: Floats, times: Floats) -> Ints:
    """Index of the last sample at or before each query time; -1 before the first sample."""
    # Stamps are converted between nanoseconds and seconds: a sample at exactly the query time is known.
    return np.searchsorted(times, at + 1e-7, side="right").astype(np.int64) - 1


def nearest_indices(at: Floats, times: Floats) -> Ints:
    """Index of the sample nearest to each query time; ``times`` of shape (n,), n >= 1, increasing."""
    after = np.clip(np.searchsorted(times, at), 1, max(times.size - 1, 1))
    after = np.minimum(after, times.size - 1)
    before = np.maximum(after - 1, 0)
    return np.where(times[after] - at < at - times[before], after, before).astype(np.int64)


def count_steps(times: Floats, span: float) -> int:
    """Number of samples in a span of time, at least one.

    Args:
        times: increasing [s], shape (n,), n >= 2.
        span: [s].
    """
    return max(round(span / max(float(np.median(np.diff(times))), SHORTEST_PERIOD)), 1)


def spread_equal(times: Floats) -> Floats:
    """Times [s] in order, equal ones apart by rounding so that slopes over them are finite; shape (n,)."""
    ordered = np.maximum.accumulate(times)
    least = max(1e-12, 4.0 * float(np.spacing(np.abs(ordered).max(initial=0.0))))
    return np.asarray(ordered + np.arange(times.size) * least, dtype=np.float64)


def differentiate_locally(at: Floats, times: Floats, values: Floats, window: float) -> Floats:
    """First derivative by a local quadratic fit (Savitzky and Golay 1964, for uneven sampling).

    Args:
        at: query times [s], shape (m,), inside the range of ``times``.
        times: strictly increasing sample times [s], shape (n,), n >= 2.
        values: samples, shape (n, k), any unit.
        window: full width of the window [s]; with fewer than four samples it grows to the nearest four (or
            all), and at the ends of the series it is one-sided.

    Returns:
        Derivatives at ``at``, shape (m, k), unit of ``values`` per second.
    """
    first, last = _choose_neighbours(at, times, window)
    derivative = np.empty((at.size, values.shape[1]))
    for begin in range(0, at.size, _BLOCK):
        rows = slice(begin, min(begin + _BLOCK, at.size))
        derivative[rows] = _fit_slopes(at[rows], times, values, first[rows], last[rows], window)
    return derivative


def _choose_neighbours(at: Floats, times: Floats, window: float) -> tuple[Ints, Ints]:
    """First and one-past-last sample of each query's neighbourhood."""
    fewest = min(_FEWEST_POINTS, times.size)
    first = np.searchsorted(times, at - window / 2.0 - 1e-9).astype(np.int64)
    last = np.searchsorted(times, at + window / 2.0 + 1e-9, side="right").astype(np.int64)
    for _ in range(fewest):
        short = last - first < fewest
        if not short.any():
            break
        before = np.where(first > 0, at - times[np.maximum(first - 1, 0)], np.inf)
        after = np.where(last < times.size, times[np.minimum(last, times.size - 1)] - at, np.inf)
        # Of two equally near samples the earlier one, independent of rounding.
        earlier = before <= after + 1e-9
        first = np.where(short & earlier, first - 1, first)
        last = np.where(short & ~earlier, last + 1, last)
    return first, last


def _fit_slopes(at: Floats, times: Floats, values: Floats, first: Ints, last: Ints, window: float) -> Floats:
    """Slopes at the query times of quadratics fitted to each neighbourhood."""
    width = int((last - first).max())
    index = first[:, None] + np.arange(width)
    inside = index < last[:, None]
    index = np.minimum(index, times.size - 1)
    offset = np.where(inside, (times[index] - at[:, None]) / window, 0.0)
    powers = np.stack((inside.astype(float), offset, offset**2), axis=-1)
    normal = np.einsum("mwi,mwj->mij", powers, powers)
    # With two or three points, or with equal times, the quadratic is undetermined: a small ridge on the
    # curvature makes the fit a line there, with no effect elsewhere.
    normal[:, 2, 2] += 1e-9
    reference = values[np.clip(first, 0, times.size - 1)]
    right = np.einsum("mwi,mwk->mik", powers, (values[index] - reference[:, None, :]) * inside[..., None])
    return np.linalg.solve(normal, right)[:, 1, :] / window


STRETCH_S = 10.0
"""Length of stretches treated as independent [s]: residuals are correlated over one to two seconds. Half of
it would count a slow disturbance twice; double would leave six stretches of two minutes."""


def number_stretches(since: Floats, length: float = STRETCH_S) -> Ints:
    """Number of the stretch of ``length`` [s] that contains each time [s], shape (n,).

    Stamps on a raster coincide with the ends of stretches: without a tolerance, the result would depend on
    the start time of the recorder.
    """
    number: Ints = ((since + ROUNDING_S) // length).astype(np.int64)
    return number


def interpolate_linearly(at: Floats, times: Floats, values: Floats) -> Floats:
    """Columns of ``values`` (n, k) at query times (m,); held constant outside the range."""
    return np.stack([np.interp(at, times, column) for column in values.T], axis=-1)


def integrate_rate(times: Floats, rate: Floats) -> Floats:
    """Cumulative trapezoidal integral of ``rate`` (n,) over ``times`` (n,), starting at zero, shape (n,)."""
    steps = np.diff(times) * (rate[1:] + rate[:-1]) / 2.0
    return np.append(0.0, np.cumsum(steps))[: times.size]


_GAUSSIAN = 1.4826
"""Ratio of the standard deviation of a normal distribution to its median absolute value."""
_SHARE_OF_RMS = 0.5
"""Minimum robust spread of a column as a share of its RMS: for normal values the spread is the RMS, for
values that are mostly zero it is zero."""
_LEAST = 1e-9
"""Minimum spread, to keep quotients finite."""


def find_median_size(values: Floats) -> float:
    """Median absolute value."""
    return float(np.median(np.abs(values)))


def robust_spread(values: Floats) -> float:
    """Standard deviation about zero, estimated from the median absolute value."""
    return _GAUSSIAN * find_median_size(values)


def robust_spreads(values: Floats) -> Floats:
    """`robust_spread` of every column, shape (n, ...) to (...)."""
    spreads: Floats = _GAUSSIAN * np.median(np.abs(values), axis=0)
    return spreads


def guarded_spreads(values: Floats, clip: float = np.inf, least: float = _LEAST) -> Floats:
    """Robust spread of every column, at least half the RMS of the values clipped at ``clip`` spreads.

    If a vehicle mostly drives straight, the median does not describe the residuals of its turns.
    """
    middle = np.maximum(robust_spreads(values), least)
    clipped = np.sqrt(np.mean(np.minimum(np.abs(values), clip * middle) ** 2, axis=0))
    spreads: Floats = np.maximum(middle, _SHARE_OF_RMS * clipped)
    return spreads


def guarded_spread(values: Floats, clip: float = np.inf, least: float = _LEAST) -> float:
    """`guarded_spreads` of one column, shape (n,)."""
    return float(guarded_spreads(values[:, None], clip, least)[0])


@functools.lru_cache(maxsize=4096)
def student_quantile(level: float, freedom: float) -> float:
    """Quantile of Student's t for a two-sided level; NaN without degrees of freedom.

    Args:
        level: share of draws within the quantile, between 0 and 1.
        freedom: degrees of freedom, any number above 0.
    """
    return float(scipy.special.stdtrit(freedom, (1.0 + level) / 2.0)) if freedom > 0.0 else math.nan


def jackknife_deviation(without: Floats) -> float:
    """Standard error of an estimate by the delete-one jackknife.

    Args:
        without: the estimate without each block in turn, shape (n,).

    Source: Efron and Tibshirani, An Introduction to the Bootstrap, 1993, 11.5.
    """
    return math.sqrt((without.size - 1.0) * float(np.mean((without - without.mean()) ** 2)))


# Student's t with four degrees of freedom: noise most of which is Gaussian, and some of which is far off.

FREEDOM = 4.0
LOG_PEAK = math.log(0.375)
"""Logarithm of the density at zero in units of the scale."""
_ROUNDS = 10
"""Number of reweightings; five or twenty change no finding of three recordings
(`make bench NAME=constants`)."""
_BOUND = 3.0
"""Residual [scales] from which on its weight falls with its size (Huber)."""
_RANK = 1e-12
"""Share of the largest eigenvalue below which columns do not determine a coefficient."""


def find_scale(rest: Floats) -> float:
    """Scale of some residuals by reweighting."""
    squares = np.square(rest)
    power, weighed = max(1.5 * float(np.median(squares)), 1e-16), np.empty_like(squares)
    for _ in range(12):
        np.divide(squares, power, out=weighed)
        weighed += FREEDOM
        np.divide(squares, weighed, out=weighed)
        power = max((FREEDOM + 1.0) * float(np.add.reduce(weighed) / squares.size), 1e-16)
    return math.sqrt(power)


def list_likelihoods(rest: Floats, scale: float | Floats | None = None) -> Floats:
    """Log-likelihood of every residual, less `LOG_PEAK`; by default with the one scale that they have."""
    scale = find_scale(rest) if scale is None else scale
    made: Floats = -np.log(scale) - 0.5 * (FREEDOM + 1.0) * np.log1p((rest / scale) ** 2 / FREEDOM)
    return made


def weigh(rest: Floats, scale: float) -> Floats:
    """Weight of every residual in a regression, shape (n,)."""
    made: Floats = (FREEDOM + 1.0) / (FREEDOM + (rest / scale) ** 2)
    return made


def weigh_bounded(rest: Floats, scale: float) -> Floats:
    """The same, with one for all near residuals and the same influence of all far ones (Huber)."""
    made: Floats = np.minimum(1.0, _BOUND * scale / np.maximum(np.abs(rest), _LEAST))
    return made


class RobustFit(NamedTuple):
    """A robust linear regression.

    Attributes:
        gains: coefficients, shape (p,).
        rest: residuals, shape (n,).
        weights: of the rows, shape (n,).
        scale: of the residuals.
    """

    gains: Floats
    rest: Floats
    weights: Floats
    scale: float

    def find_errors(self, design: Floats, block: Ints) -> Floats:
        """Standard errors of the coefficients that are robust to correlation within blocks, shape (p,).

        Args:
            design: columns, shape (n, p).
            block: number of the block of every row, shape (n,).
        """
        inverse = np.linalg.pinv((design * self.weights[:, None]).T @ design)
        pulls = np.column_stack(
            [np.bincount(block, column * self.weights * self.rest) for column in design.T]
        )
        return np.asarray(np.sqrt(np.maximum(np.diag(inverse @ (pulls.T @ pulls) @ inverse), 0.0)))


def fit_robustly(
    design: Floats,
    values: Floats,
    *,
    measure: Callable[[Floats], float] = find_median_size,
    weigh: Callable[[Floats, float], Floats] = weigh,
    least: float = 0.0,
    ridge: float = 0.0,
    group: Ints | None = None,
    rounds: int = _ROUNDS,
) -> RobustFit:
    """Robust linear regression: a minority of outliers has little weight.

    Args:
        design: columns, shape (n, p).
        values: target, shape (n,).
        measure: scale of residuals: `find_median_size` or `robust_spread`, its 1.5-fold, which no minority
            moves, or `find_scale`, the likeliest.
        weigh: weights of residuals of a scale: `weigh`, by which far ones count for nothing, or
            `weigh_bounded`, by which they count as if they were near.
        least: difference below which all fit alike, added to the scale in squares.
        ridge: share of a column's power that is added to it: what few rows do not determine stays small.
        group: number of the group of every row, each with an offset of its own, shape (n,).
        rounds: number of reweightings, at least one.

    Source: Holland and Welsch, Robust regression using iteratively reweighted least-squares, 1977.
    """
    size = np.sqrt(np.mean(design**2, axis=0)) + ridge
    size[size == 0.0] = 1.0
    scaled = design / size
    columns, target = scaled, values
    weights, gains, rest, scale = np.ones(values.size), np.zeros(size.size), values, 0.0
    for _ in range(rounds):
        if group is not None:
            columns, target = _centre(scaled, group, weights), _centre(values[:, None], group, weights)[:, 0]
        weighted = columns * weights[:, None]
        normal = weighted.T @ columns + ridge * values.size * np.eye(size.size)
        gains = np.asarray(np.linalg.lstsq(normal, weighted.T @ target, rcond=_RANK)[0], dtype=np.float64)
        rest = target - columns @ gains
        scale = max(math.hypot(measure(rest), least), _LEAST)
        weights = weigh(rest, scale)
    return RobustFit(gains / size, rest, weights, scale)


def _centre(columns: Floats, group: Ints, weights: Floats) -> Floats:
    """Columns without the weighted means of their groups, shape (n, p)."""
    total = np.bincount(group, weights)
    means = np.column_stack([np.bincount(group, weights * one) for one in columns.T]) / total[:, None]
    return np.asarray(columns - means[group], dtype=np.float64)
