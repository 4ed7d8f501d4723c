"""Noise of increments: a disturbance that lasts, and white noise of the poses between which they lie.

    d_k = a_k + n_k - n_(k-1),  a an AR(1) of variance A s^2 and correlation phi^(dt/h),  var n = (1 - A) s^2

d_k is the residual of a step, measured less predicted displacement or turn; a is motion that no model
explains and n the error of the localization. Differences of poses make n anticorrelated: whoever takes
residuals as independent throws away what is slow. The innovations of a Kalman filter with these three numbers
are independent and of variance one. Its gains do not depend on the data, so that residuals and columns of a
Jacobian pass through the same filter.

Source: Ljung, System Identification, 2nd ed., section 3.2; Harvey, Forecasting, Structural Time Series Models
and the Kalman Filter, 1989, chapter 3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import Newest, compiled

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.core import Flags, Floats, Ints

CLIP = 3.0
"""Innovation [standard deviations] above which its cost grows linearly (Huber)."""
_LONGEST_S = 2.0
"""Longest correlation time of a disturbance [s]: what lasts longer is an effect, or the ground, not noise."""
_JUMP = 100.0
"""Residual [rough standard deviations] to which a larger one, as of a pose that jumps, is held."""
_LEAST = 1e-9
"""Spread [m, rad] below which residuals are rounding."""
_SAME, _SAME_EXACT, _MOST_ROUNDS = 0.05, 1e-8, 30
"""Differences of chi-square at which the likelihood of both numbers, and the numbers, have converged, and
rounds until then."""
_FAR, _CLOSER = 2.0, 0.3
"""Longest step along an axis, in radii of the points around, and factor of the radius after a step within."""
_LEAST_KEPT = 1e-6
"""Least correlation, whose logarithm is taken."""
_LOGS = 16
"""Variances whose product is taken before its logarithm."""
_SCALE_ROUNDS = 30
_SAME_SCALE, _NEAR_SCALE = 1e-6, 2e-3
"""Relative change of a scale at which it has converged, and its cost, which is wrong by the cube of that."""
_MEAN_SIZE = 1.2533
"""Ratio of the standard deviation of a normal distribution to its mean absolute value."""
_GAUSSIAN = 1.4826
"""Ratio of the standard deviation of a normal distribution to its median absolute value."""


@dataclass(frozen=True)
class Steps:
    """Increments of runs, one after the other.

    Attributes:
        spans: length of each [s], shape (n,).
        fresh: whether it does not continue the one before, shape (n,).
        run: number of its run, shape (n,).
    """

    spans: Floats
    fresh: Flags
    run: Ints

    @cached_property
    def lengths(self) -> Floats:
        """The lengths that there are, to a thousandth of a second, shape (kinds,)."""
        return self._kinds[0]

    @cached_property
    def kind(self) -> Ints:
        """Which of them each has, shape (n,)."""
        return self._kinds[1]

    @cached_property
    def _kinds(self) -> tuple[Floats, Ints]:
        lengths, kind = np.unique(np.round(self.spans, 3), return_inverse=True)
        return lengths, kind.astype(np.int64)

    def find_gains(self, step_s: float, correlation: Floats, share: Floats) -> Floats:
        """What the filters of some channels do at each step, see `_find_gains`, shape (n, 4, channels)."""

        def make() -> Floats:
            gains = np.empty((self.spans.size, 4, share.size))
            decays = np.log(np.maximum(correlation, 1e-300)) / step_s
            _find_gains(self.fresh, self.spans, decays, share, np.empty((3, share.size)), gains)
            return gains

        return self._gains.recall((step_s, correlation.tobytes(), share.tobytes()), make)

    @cached_property
    def _gains(self) -> Newest[Floats]:
        return Newest(_GAINS)

    @cached_property
    def deviations(self) -> Newest[Floats]:
        """Standard deviations of innovations by the noise in use."""
        return Newest(_GAINS)


@dataclass(frozen=True)
class Noise:
    """Noise of the three channels of increments.

    Attributes:
        step_s: time to which `correlation` refers [s].
        correlation: of the disturbance from one step to the next, shape (3,).
        share: of the disturbance in the variance of a step, shape (3,).
        scale: standard deviation [m, m, rad] in each run, which a fast one has larger, shape (runs, 3);
            infinite where a channel says nothing.
    """

    step_s: float
    correlation: Floats
    share: Floats
    scale: Floats

    @cached_property
    def known(self) -> list[int]:
        """Channels that say anything in one of the runs."""
        return [int(channel) for channel in np.flatnonzero(np.isfinite(self.scale).any(axis=0))]

    @property
    def spread(self) -> Floats:
        """Root mean square of the scale over the runs, zero in channels that say nothing, shape (3,)."""
        scale = np.where(np.isfinite(self.scale), self.scale, 0.0)
        spread: Floats = np.sqrt(np.mean(scale**2, axis=0))
        return spread

    def whiten(self, columns: Floats, steps: Steps, weights: Floats | float = 1.0) -> Floats:
        """Innovations of columns in standard deviations.

        Args:
            columns: increments, shape (n, 3, q).
            steps: the steps.
            weights: of each increment, such as that of outliers, shape (n, 3).

        Returns:
            Shape (n, 3, q); zeros in channels that say nothing.
        """
        gains, deviations = self._follow(steps)
        return _filter(columns, steps, gains, weights / deviations)

    def _follow(self, steps: Steps) -> tuple[Floats, Floats]:
        """Gains at each step, shape (n, 4, 3), and standard deviations of the innovations, shape (n, 3)."""
        gains = steps.find_gains(self.step_s, self.correlation, self.share)
        key = (self.step_s, self.correlation.tobytes(), self.share.tobytes(), self.scale.tobytes())
        return gains, steps.deviations.recall(key, lambda: gains[:, _DEVIATION] * self.scale[steps.run])

    def log_variance(self, steps: Steps, weights: Floats | float = 1.0) -> float:
        """Sum of the logarithms of the innovations' variances: what a likelihood has beside its squares.

        Args:
            steps: the steps.
            weights: of each, shape (n, 1).
        """
        _, spreads = self._follow(steps)
        known = np.isfinite(spreads)
        return 2.0 * float((np.broadcast_to(weights, spreads.shape)[known] * np.log(spreads[known])).sum())


def learn_noise(
    residual: Floats,
    steps: Steps,
    channels: Sequence[int],
    start: Noise | None = None,
    *,
    exact: bool = False,
) -> Noise:
    """Noise of residuals by maximum likelihood, outliers weighted down.

    Args:
        residual: increments, shape (n, 3).
        steps: the steps.
        channels: those that say anything.
        start: noise of nearly the same residuals.
        exact: whether they must depend on the residuals alone, and not on the start.
    """
    step_s, runs = float(np.median(steps.spans)), int(steps.run[-1]) + 1
    correlation, share, scale = np.zeros(3), np.zeros(3), np.full((runs, 3), np.inf)
    rows = [steps.run == run for run in range(runs)]
    for channel in channels:
        values = np.ascontiguousarray(residual[:, channel : channel + 1])
        rough = np.array([_measure_rough(values[mine]) for mine in rows])
        if not (rough > _LEAST).any():
            continue
        known = None if start is None else (start.correlation[channel], start.share[channel])
        scaled = np.clip(values / np.where(rough > _LEAST, rough, np.inf)[steps.run][:, None], -_JUMP, _JUMP)
        phi, part = _maximize(scaled, steps, step_s, known, exact=exact)
        correlation[channel], share[channel] = phi, part
        gains = steps.find_gains(step_s, np.array([phi]), np.array([part]))
        made = _filter(scaled[:, :, None], steps, gains, 1.0 / gains[:, _DEVIATION])
        for run, mine in enumerate(rows):
            if rough[run] > _LEAST:
                outcome = rough[run] * _measure_scale(made[mine, 0])
                scale[run, channel] = max(outcome, _LEAST)
    return Noise(step_s, correlation, share, scale)


def _measure_rough(values: Floats) -> float:
    """Spread of residuals as if they were independent."""
    if not values.size:
        return 0.0
    size = np.abs(values)
    return max(_GAUSSIAN * float(np.median(size)), 0.1 * float(size.mean()))


def _measure_scale(innovations: Floats) -> float:
    """Scale of most likelihood of innovations (n, 1), by a density that falls as exp(-`huber_cost` / 2)."""
    rows, size = np.zeros(_ROWS * _LANES), np.ascontiguousarray(np.abs(innovations))
    rows[_INVERSE] = 1.0 / max(_MEAN_SIZE * float(size.mean()), 1e-12)
    _find_scales(rows, size, np.empty(1), _SAME_SCALE)
    return 1.0 / float(rows[_INVERSE])


def huber_cost(innovations: Floats) -> Floats:
    """Square of an innovation, growing linearly above `CLIP`; of the shape of the argument."""
    size = np.abs(innovations)
    held = np.minimum(size, CLIP)
    cost: Floats = held * (2.0 * size - held)
    return cost


def find_weights(innovations: Floats) -> Floats:
    """Huber's weights, by which squares have the slope of `huber_cost`; of the shape of the argument."""
    return np.asarray(CLIP / np.maximum(np.abs(innovations), CLIP))


def _maximize(
    values: Floats, steps: Steps, step_s: float, known: tuple[float, float] | None, *, exact: bool
) -> tuple[float, float]:
    """Correlation and share of the disturbance.

    They are squares of sines: a bound is a place like others then, where the likelihood is level.
    """
    most, count = math.exp(-step_s / _LONGEST_S), values.shape[0]
    starts, radius = [(1.22, 0.35), (0.79, 1.02)], 0.3
    if known is not None and not exact:
        phi, part = (math.asin(math.sqrt(min(one, 1.0))) for one in (known[0] / most, known[1]))
        starts, radius = [(phi, part)], 0.06
    ends = []
    for start in starts:
        ends.append(np.array([*start, math.inf]))
        _descend(
            np.ascontiguousarray(values[:, 0]), steps.fresh, steps.kind, steps.lengths / step_s, most, radius,
            _SAME_EXACT if exact else _SAME, _SAME_SCALE if exact else _NEAR_SCALE, ends[-1],
            np.empty((steps.lengths.size, _LANES)), np.empty(_LANES), np.empty(_ROWS * _LANES),
            np.empty((count, _LANES)), np.empty(_LANES), np.empty(_TERMS),
        )  # fmt: skip
    phi, part, _ = min(ends, key=lambda at: float(at[2])).tolist()
    return _read(phi, most), math.sin(part) ** 2


def _list_terms(at: Floats) -> Floats:
    """Terms of a quadratic in two numbers, shape (n, 6)."""
    x, y = at.T
    return np.column_stack((np.ones(x.size), x, y, 0.5 * x * x, x * y, 0.5 * y * y))


_LANES = 8
"""Pairs of numbers whose likelihoods are computed at once."""
_AROUND: Floats = np.array(
    [(0.0, 0.0), *((math.cos(one), math.sin(one)) for one in 2.0 * np.pi * np.arange(7) / 7)]
)
_QUADRATIC: Floats = np.asarray(np.linalg.pinv(_list_terms(_AROUND)), dtype=np.float64)
"""Terms of the quadratic through the costs of these points, shape (6, 8)."""
_TERMS = 6


@compiled()
def _read(angle: float, most: float) -> float:
    """Correlation of an angle."""
    return max(most * math.sin(angle) ** 2, _LEAST_KEPT)


@compiled()
def _value(terms: Floats, x: float, y: float) -> float:
    """Quadratic of some terms at a place."""
    linear = terms[0] + terms[1] * x + terms[2] * y
    return float(linear + 0.5 * terms[3] * x * x + terms[4] * x * y + 0.5 * terms[5] * y * y)


@compiled()
def _find_axis_step(slope: float, curvature: float) -> float:
    """Step along an axis of a quadratic, at most `_FAR`.

    Downhill where it is curved downwards, too: a bound is a top where it is not the best place.
    """
    away = min(abs(slope) / max(curvature, 1e-12), _FAR) if curvature > 0.0 else _FAR
    return -math.copysign(away, slope)


@compiled()
def _find_step(terms: Floats) -> tuple[float, float]:
    """Step towards the least value of a quadratic, along each of its axes."""
    mean, half = 0.5 * (terms[3] + terms[5]), 0.5 * (terms[3] - terms[5])
    apart, angle = math.hypot(half, terms[4]), 0.5 * math.atan2(terms[4], half)
    x, y = math.cos(angle), math.sin(angle)
    one = _find_axis_step(x * terms[1] + y * terms[2], mean + apart)
    other = _find_axis_step(x * terms[2] - y * terms[1], mean - apart)
    return x * one - y * other, y * one + x * other


@compiled()
def _list_lanes(
    x: float, y: float, radius: float, most: float, lengths: Floats, keeps: Floats, shares: Floats
) -> None:
    """What `_rate` needs of a place and of those around it."""
    for k in range(shares.size):
        decay = math.log(_read(x + radius * _AROUND[k, 0], most))
        shares[k] = math.sin(y + radius * _AROUND[k, 1]) ** 2
        for length in range(lengths.size):
            keeps[length, k] = math.exp(lengths[length] * decay)


@compiled(
    "void(float64[::1], boolean[::1], int64[::1], float64[::1], float64, float64, float64, float64, "
    "float64[::1], float64[:, ::1], float64[::1], float64[::1], float64[:, ::1], float64[::1], float64[::1])"
)
def _descend(
    values: Floats,
    fresh: Flags,
    kind: Ints,
    lengths: Floats,
    most: float,
    radius: float,
    same: float,
    near: float,
    at: Floats,
    keeps: Floats,
    shares: Floats,
    rows: Floats,
    size: Floats,
    costs: Floats,
    terms: Floats,
) -> None:
    """Least cost and where, by quadratics through the costs of a point and of seven around it.

    Args:
        values: increments, shape (n,).
        fresh: steps that do not continue the one before, shape (n,).
        kind: of the length of each step, shape (n,).
        lengths: of each kind, in those that the correlation refers to, shape (kinds,).
        most: largest correlation.
        radius: of the points around.
        same: difference of costs at which it has converged.
        near: see `_find_scales`.
        at: angles of correlation and share where it begins; where it ends, and the least cost, shape (3,).
        keeps: room, shape (kinds, lanes), as are the following for `_rate`, and (6,) for the terms.
        shares: room.
        rows: room.
        size: room.
        costs: room.
        terms: room.
    """
    x, y, least = at[0], at[1], math.inf
    for _ in range(_MOST_ROUNDS):
        _list_lanes(x, y, radius, most, lengths, keeps, shares)
        _rate(values, fresh, kind, keeps, shares, rows, size, costs, near)
        lowest = costs.argmin()
        is_lower = costs[lowest] < least
        if is_lower:
            least = costs[lowest]
            at[0], at[1] = x + radius * _AROUND[lowest, 0], y + radius * _AROUND[lowest, 1]
        for term in range(_TERMS):
            terms[term] = 0.0
            for k in range(_LANES):
                terms[term] += _QUADRATIC[term, k] * costs[k]
        step_x, step_y = _find_step(terms)
        missed = least - _value(terms, step_x, step_y)
        for k in range(_LANES):
            missed = max(missed, abs(costs[k] - _value(terms, _AROUND[k, 0], _AROUND[k, 1])))
        step_x, step_y = radius * step_x, radius * step_y
        if missed < same:
            # Not the best of eight points: which one that is depends on rounding.
            at[0], at[1] = x + step_x, y + step_y
            break
        x, y = (x + step_x, y + step_y) if is_lower else (at[0], at[1])
        radius *= 1.0 if is_lower and math.hypot(step_x, step_y) >= radius else _CLOSER
    at[2] = least


def _filter(columns: Floats, steps: Steps, gains: Floats, weights: Floats) -> Floats:
    """Weighted innovations of columns (n, channels, q), weights of shape (n, channels)."""
    made = np.empty((columns.shape[2], *weights.shape))
    values = np.ascontiguousarray(columns.transpose(2, 0, 1))
    _innovate(values, steps.fresh, gains, weights, np.empty((2, weights.shape[1])), made)
    return made.transpose(1, 2, 0)


# What a filter does at a step, in this order: what remains of a disturbance, gains, standard deviation.
_KEEPS, _GAIN_A, _GAIN_N, _DEVIATION = range(4)
_GAINS = 4
"""Sets of gains that are kept: those of the noise in use, and of each channel of one that is learned."""


@compiled()
def _find_gain(share: float, keep: float, of_a: float, of_both: float, of_n: float) -> tuple[float, ...]:
    """Variance and gains of a step, and the variances after it; see the module for the equations."""
    noise = 1.0 - share
    variance = of_a + of_n - 2.0 * of_both + noise
    inverse = 1.0 / variance
    gain_a, gain_n = (of_a - of_both) * inverse, noise * inverse
    after = of_a - gain_a * gain_a * variance
    return (
        variance,
        inverse,
        gain_a,
        gain_n,
        keep * keep * after + (1.0 - keep * keep) * share,
        -keep * gain_a * gain_n * variance,
        noise - gain_n * gain_n * variance,
    )


@compiled("void(boolean[::1], float64[::1], float64[::1], float64[::1], float64[:, ::1], float64[:, :, ::1])")
def _find_gains(
    fresh: Flags, spans: Floats, decays: Floats, shares: Floats, variances: Floats, gains: Floats
) -> None:
    """Gains of the filters of a disturbance and the error of the last pose.

    Args:
        fresh: steps that do not continue the one before, shape (n,).
        spans: their lengths [s], shape (n,).
        decays: logarithm of what remains of each disturbance after a second, shape (channels,).
        shares: of each in the variance, shape (channels,).
        variances: room, shape (3, channels).
        gains: the result, shape (n, 4, channels).
    """
    for row in range(spans.size):
        for k in range(shares.size):
            if fresh[row]:
                variances[0, k], variances[1, k], variances[2, k] = shares[k], 0.0, 1.0 - shares[k]
            is_same = row > 0 and spans[row] == spans[row - 1]
            keep = gains[row - 1, _KEEPS, k] if is_same else math.exp(decays[k] * spans[row])
            variance, _, gain_a, gain_n, of_a, of_both, of_n = _find_gain(
                shares[k], keep, variances[0, k], variances[1, k], variances[2, k]
            )
            variances[0, k], variances[1, k], variances[2, k] = of_a, of_both, of_n
            gains[row, _KEEPS, k], gains[row, _DEVIATION, k] = keep, math.sqrt(variance)
            gains[row, _GAIN_A, k], gains[row, _GAIN_N, k] = gain_a, gain_n


@compiled()
def _follow(
    value: float, keep: float, gain_a: float, gain_n: float, a: float, n: float
) -> tuple[float, float, float]:
    """What is new in an increment, and the disturbance and the error of the pose after it."""
    new = value - a + n
    return new, keep * (a + gain_a * new), gain_n * new


@compiled(
    "void(float64[:, :, ::1], boolean[::1], float64[:, :, ::1], float64[:, ::1], float64[:, ::1], "
    "float64[:, :, ::1])"
)
def _innovate(
    columns: Floats, fresh: Flags, gains: Floats, weights: Floats, state: Floats, made: Floats
) -> None:
    """Innovations of columns (q, n, channels), each times its weight."""
    for column in range(columns.shape[0]):
        for row in range(columns.shape[1]):
            if fresh[row]:
                state[:] = 0.0
            for k in range(columns.shape[2]):
                new, state[0, k], state[1, k] = _follow(
                    columns[column, row, k],
                    gains[row, _KEEPS, k],
                    gains[row, _GAIN_A, k],
                    gains[row, _GAIN_N, k],
                    state[0, k],
                    state[1, k],
                )
                made[column, row, k] = new * weights[row, k]


# Rows of what `_rate` knows of each lane.
_ROWS = 14
_OF_A, _OF_BOTH, _OF_N, _A, _N, _PRODUCT, _LOGS_SUM, _INVERSE, _TOTAL, _SLOPE, _COST, _KEEP, _SIZE, _SHARE = (
    _LANES * row for row in range(_ROWS)
)


@compiled()
def _start(rows: Floats, lanes: int) -> None:
    for k in range(lanes):
        share = rows[_SHARE + k]
        rows[_OF_A + k], rows[_OF_BOTH + k], rows[_OF_N + k] = share, 0.0, 1.0 - share
        rows[_A + k], rows[_N + k] = 0.0, 0.0


@compiled()
def _take_logs(rows: Floats, lanes: int) -> None:
    for k in range(lanes):
        rows[_LOGS_SUM + k] += math.log(rows[_PRODUCT + k])
        rows[_PRODUCT + k] = 1.0


@compiled()
def _predict(rows: Floats, lanes: int, value: float) -> None:
    """One step of the filter in all lanes."""
    for k in range(lanes):
        keep = rows[_KEEP + k]
        variance, inverse, gain_a, gain_n, of_a, of_both, of_n = _find_gain(
            rows[_SHARE + k], keep, rows[_OF_A + k], rows[_OF_BOTH + k], rows[_OF_N + k]
        )
        new, a, n = _follow(value, keep, gain_a, gain_n, rows[_A + k], rows[_N + k])
        rows[_OF_A + k], rows[_OF_BOTH + k], rows[_OF_N + k] = of_a, of_both, of_n
        rows[_A + k], rows[_N + k] = a, n
        rows[_SIZE + k] = abs(new) * math.sqrt(inverse)
        rows[_PRODUCT + k] *= variance


@compiled()
def _add_costs(rows: Floats, lanes: int) -> None:
    """Add what an innovation contributes to Huber's cost and to the equation of the scale."""
    for k in range(lanes):
        z = rows[_SIZE + k] * rows[_INVERSE + k]
        held = min(CLIP, z)
        rows[_TOTAL + k] += held * z
        rows[_SLOPE + k] += held * (z + (z if z < CLIP else 0.0))
        rows[_COST + k] += held * (2.0 * z - held)


@compiled("void(float64[::1], float64[:, ::1], float64[::1], float64)")
def _find_scales(rows: Floats, size: Floats, costs: Floats, same: float) -> None:
    """Scales at which the mean of min(z^2, CLIP z) of sizes z is one, by Newton's steps, and their costs.

    Args:
        rows: what belongs to each lane; its inverse scale is the first one here, and the best one then.
        size: of innovations, shape (n, lanes).
        costs: the result, those of the innovations and of the scales, shape (lanes,).
        same: relative change at which a scale has converged.
    """
    count, lanes = size.shape
    for _ in range(_SCALE_ROUNDS):
        for k in range(lanes):
            rows[_TOTAL + k], rows[_SLOPE + k], rows[_COST + k] = 0.0, 0.0, 0.0
        for row in range(count):
            for k in range(lanes):
                rows[_SIZE + k] = size[row, k]
            _add_costs(rows, lanes)
        away = 0.0
        for k in range(lanes):
            grown = (rows[_TOTAL + k] - count) / max(rows[_SLOPE + k], 1e-300)
            # The fall by the step that follows, to second order.
            fall = grown * (rows[_TOTAL + k] - count)
            costs[k] = (
                rows[_COST + k] - 2.0 * count * math.log(rows[_INVERSE + k]) + rows[_LOGS_SUM + k] - fall
            )
            rows[_INVERSE + k] *= math.exp(-grown)
            away = max(away, abs(grown))
        if away < same:
            break


@compiled(
    "void(float64[::1], boolean[::1], int64[::1], float64[:, ::1], float64[::1], float64[::1], "
    "float64[:, ::1], float64[::1], float64)"
)
def _rate(
    values: Floats,
    fresh: Flags,
    kind: Ints,
    keeps: Floats,
    shares: Floats,
    rows: Floats,
    size: Floats,
    costs: Floats,
    same: float,
) -> None:
    """Minus twice the logarithm of the likelihood of increments, at the scales of most likelihood.

    Args:
        values: increments, shape (n,).
        fresh: steps that do not continue the one before, shape (n,).
        kind: of the length of each step, shape (n,).
        keeps: what remains of a disturbance after a step of each length, shape (kinds, lanes).
        shares: of the disturbance in the variance, shape (lanes,).
        rows: room for what belongs to each lane, shape (`_ROWS` * lanes,).
        size: room for the sizes of the innovations, shape (n, lanes).
        costs: the result, shape (lanes,).
        same: see `_find_scales`.
    """
    lanes, count = shares.size, values.size
    for k in range(lanes):
        rows[_SHARE + k], rows[_PRODUCT + k] = shares[k], 1.0
        rows[_LOGS_SUM + k], rows[_INVERSE + k] = 0.0, 0.0
    for row in range(count):
        if fresh[row]:
            _start(rows, lanes)
        for k in range(lanes):
            rows[_KEEP + k] = keeps[kind[row], k]
        _predict(rows, lanes, values[row])
        for k in range(lanes):
            size[row, k] = rows[_SIZE + k]
            rows[_INVERSE + k] += rows[_SIZE + k]
        # One logarithm for some variances, all between a thousandth and a few.
        if row % _LOGS == 0 or row == count - 1:
            _take_logs(rows, lanes)
    for k in range(lanes):
        rows[_INVERSE + k] = 1.0 / max(_MEAN_SIZE * rows[_INVERSE + k] / count, 1e-12)
    _find_scales(rows, size, costs, same)
