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

from pipeline.core import compiled

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pipeline.core import Flags, Floats, Ints

CLIP = 3.0
"""Innovation [standard deviations] above which its cost grows linearly (Huber)."""
_LONGEST_S = 2.0
"""Longest correlation time of a disturbance [s]: what lasts longer is an effect, or the ground, not noise."""
_JUMP = 100.0
"""Residual [rough standard deviations] to which a larger one, as of a pose that jumps, is held."""
_LEAST = 1e-9
"""Spread [m, rad] below which residuals are rounding."""
_SAME, _SAME_EXACT, _MOST_ROUNDS = 0.005, 1e-8, 30
"""Differences of chi-square at which the likelihood of both numbers, and the numbers, have converged, and
rounds until then."""
_FAR, _CLOSER = 2.0, 0.3
"""Longest step along an axis, in radii of the points around, and factor of the radius after a step within."""
_LEAST_KEPT = 1e-6
"""Least correlation, whose logarithm is taken."""
_LOGS = 16
"""Variances whose product is taken before its logarithm."""
_SCALE_ROUNDS = 30
_SAME_SCALE = 1e-6
"""Relative change of a scale at which it has converged."""
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

    @property
    def known(self) -> list[int]:
        """Channels that say anything in one of the runs."""
        return [int(channel) for channel in np.flatnonzero(np.isfinite(self.scale).any(axis=0))]

    @property
    def spread(self) -> Floats:
        """Root mean square of the scale over the runs, zero in channels that say nothing, shape (3,)."""
        scale = np.where(np.isfinite(self.scale), self.scale, 0.0)
        spread: Floats = np.sqrt(np.mean(scale**2, axis=0))
        return spread

    def whiten(self, columns: Floats, steps: Steps) -> Floats:
        """Innovations of columns in standard deviations, before any weight of outliers.

        Args:
            columns: increments, shape (n, 3, q).
            steps: the steps.

        Returns:
            Shape (n, 3, q); zeros in channels that say nothing.
        """
        white = np.zeros(columns.shape)
        for channel in self.known:
            values = np.ascontiguousarray(columns[:, channel, :])
            made, spreads = self._filter(values, steps, channel)
            white[:, channel, :] = made / (spreads * self.scale[steps.run, channel])[:, None]
        return white

    def log_variance(self, steps: Steps) -> float:
        """Sum of the logarithms of the innovations' variances: what a likelihood has beside its squares."""
        total, nothing = 0.0, np.zeros((steps.run.size, 1))
        for channel in self.known:
            spreads = self._filter(nothing, steps, channel)[1] * self.scale[steps.run, channel]
            total += 2.0 * float(np.log(spreads[np.isfinite(spreads)]).sum())
        return total

    def _filter(self, values: Floats, steps: Steps, channel: int) -> tuple[Floats, Floats]:
        return _filter(values, steps, self.step_s, self.correlation[channel], self.share[channel])


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
        made, deviations = _filter(scaled, steps, step_s, phi, part)
        correlation[channel], share[channel] = phi, part
        for run, mine in enumerate(rows):
            if rough[run] > _LEAST:
                outcome = rough[run] * _measure_scale(made[mine, 0] / deviations[mine])
                scale[run, channel] = max(outcome, _LEAST)
    return Noise(step_s, correlation, share, scale)


def _measure_rough(values: Floats) -> float:
    """Spread of residuals as if they were independent."""
    if not values.size:
        return 0.0
    size = np.abs(values)
    return max(_GAUSSIAN * float(np.median(size)), 0.1 * float(size.mean()))


def _measure_scale(innovations: Floats) -> float:
    """Scale of most likelihood of innovations with a density that falls as exp(-`huber_cost` / 2)."""
    return _find_scale(np.abs(innovations))


def huber_cost(innovations: Floats) -> Floats:
    """Square of an innovation, growing linearly above `CLIP`; of the shape of the argument."""
    size = np.abs(innovations)
    held = np.minimum(size, CLIP)
    cost: Floats = held * (2.0 * size - held)
    return cost


def _maximize(
    values: Floats, steps: Steps, step_s: float, known: tuple[float, float] | None, *, exact: bool
) -> tuple[float, float]:
    """Correlation and share of the disturbance.

    They are squares of sines: a bound is a place like others then, where the likelihood is level.
    """
    most = math.exp(-step_s / _LONGEST_S)
    flat, size = np.ascontiguousarray(values[:, 0]), np.empty((values.shape[0], _LANES))
    costs, rows = np.empty(_LANES), np.empty(_ROWS * _LANES)

    def read(at: Floats) -> tuple[Floats, Floats]:
        phi, part = np.ascontiguousarray(np.sin(at.T) ** 2)
        return np.maximum(most * phi, _LEAST_KEPT), part

    def rate(at: Floats) -> Floats:
        phi, part = read(at)
        keeps = np.exp(np.outer(steps.lengths / step_s, np.log(phi)))
        _rate(flat, steps.fresh, steps.kind, keeps, part, rows, size, costs)
        return costs

    starts, radius = np.array([(1.22, 0.35), (0.79, 1.02)]), 0.3
    if known is not None and not exact:
        starts, radius = np.arcsin(np.sqrt(np.minimum([(known[0] / most, known[1])], 1.0))), 0.06
    same = _SAME_EXACT if exact else _SAME
    best = min((_descend(rate, start, radius, same) for start in starts), key=lambda one: one[0])
    phi, part = read(best[1][None])
    return float(phi[0]), float(part[0])


def _descend(
    rate: Callable[[Floats], Floats], center: Floats, radius: float, same: float
) -> tuple[float, Floats]:
    """Least cost and where, by quadratics through the costs of a point and of seven around it."""
    least, where = math.inf, np.array(center)
    for _ in range(_MOST_ROUNDS):
        at = center + radius * _AROUND
        costs = rate(at)
        lowest = int(costs.argmin())
        is_lower = costs[lowest] < least
        if is_lower:
            least, where = float(costs[lowest]), at[lowest]
        level, *slope, xx, xy, yy = _QUADRATIC @ costs
        curvature, axes = np.linalg.eigh(np.array([[xx, xy], [xy, yy]]))
        along = axes.T @ slope
        # Downhill where it is curved downwards, too: a bound is a top where it is not the best place.
        away = np.where(curvature > 0.0, np.abs(along) / np.maximum(curvature, 1e-12), _FAR)
        step = axes @ -np.copysign(np.minimum(away, _FAR), along)
        terms = _list_terms(np.vstack((step, _AROUND))) @ (level, *slope, xx, xy, yy)
        if max(least - float(terms[0]), float(np.abs(costs - terms[1:]).max())) < same:
            # Not the best of eight points: which one that is depends on rounding.
            return least, np.asarray(center + radius * step)
        center = np.asarray(center + radius * step) if is_lower else where
        radius *= 1.0 if is_lower and math.hypot(*step) >= 1.0 else _CLOSER
    return least, where


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


def _filter(values: Floats, steps: Steps, step_s: float, phi: float, share: float) -> tuple[Floats, Floats]:
    """Innovations of columns (n, q), and their standard deviations for a variance of one, shape (n,)."""
    made, deviations = np.empty(values.shape), np.empty(steps.run.size)
    state = np.empty((2, values.shape[1]))
    _walk(values, steps.fresh, steps.spans, step_s, phi, share, state, made, deviations)
    return made, deviations


@compiled("float64(float64[::1])")
def _find_scale(size: Floats) -> float:
    """Scale s at which the mean of min(z^2, CLIP z) of the sizes z = size / s is one."""
    mean = 0.0
    for value in size:
        mean += value
    scale = max(_MEAN_SIZE * mean / size.size, 1e-12)
    for _ in range(_SCALE_ROUNDS):
        total, slope = 0.0, 0.0
        for value in size:
            z = value / scale
            held = min(z, CLIP)
            total += held * z
            slope += held * (z if z > CLIP else 2.0 * z)
        grown = (total - size.size) / max(slope, 1e-300)
        scale *= math.exp(grown)
        if abs(grown) < _SAME_SCALE:
            break
    return scale


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
    """One step of the filter in all lanes; see the module for the equations."""
    for k in range(lanes):
        share, keep, of_a, of_both = rows[_SHARE + k], rows[_KEEP + k], rows[_OF_A + k], rows[_OF_BOTH + k]
        noise = 1.0 - share
        variance = of_a + rows[_OF_N + k] - 2.0 * of_both + noise
        inverse = 1.0 / variance
        gain_a, gain_n = (of_a - of_both) * inverse, noise * inverse
        fresh_part = value - rows[_A + k] + rows[_N + k]
        rows[_SIZE + k] = abs(fresh_part) * math.sqrt(inverse)
        rows[_A + k] = keep * (rows[_A + k] + gain_a * fresh_part)
        rows[_N + k] = gain_n * fresh_part
        rows[_OF_BOTH + k] = -keep * gain_a * gain_n * variance
        rows[_OF_N + k] = noise - gain_n * gain_n * variance
        after = of_a - gain_a * gain_a * variance
        rows[_OF_A + k] = keep * keep * after + (1.0 - keep * keep) * share
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


@compiled()
def _scale(rows: Floats, lanes: int, size: Floats, costs: Floats) -> float:
    """Costs at the present scales; moves the scales, and returns the largest relative change."""
    for k in range(lanes):
        rows[_TOTAL + k], rows[_SLOPE + k], rows[_COST + k] = 0.0, 0.0, 0.0
    count = size.shape[0]
    for row in range(count):
        for k in range(lanes):
            rows[_SIZE + k] = size[row, k]
        _add_costs(rows, lanes)
    away = 0.0
    for k in range(lanes):
        grown = (rows[_TOTAL + k] - count) / max(rows[_SLOPE + k], 1e-300)
        costs[k] = rows[_COST + k] - 2.0 * count * math.log(rows[_INVERSE + k]) + rows[_LOGS_SUM + k]
        rows[_INVERSE + k] *= math.exp(-grown)
        away = max(away, abs(grown))
    return away


@compiled(
    "void(float64[::1], boolean[::1], int64[::1], float64[:, ::1], float64[::1], float64[::1], "
    "float64[:, ::1], float64[::1])"
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
    for _ in range(_SCALE_ROUNDS):
        if _scale(rows, lanes, size, costs) < _SAME_SCALE:
            break


@compiled(
    "void(float64[:, ::1], boolean[::1], float64[::1], float64, float64, float64, float64[:, ::1], "
    "float64[:, ::1], float64[::1])"
)
def _walk(
    values: Floats,
    fresh: Flags,
    spans: Floats,
    step_s: float,
    phi: float,
    share: float,
    state: Floats,
    made: Floats,
    deviations: Floats,
) -> None:
    """Kalman filter of a disturbance and the error of the last pose; see the module for the equations."""
    noise, decay = 1.0 - share, math.log(max(phi, 1e-300)) / step_s
    of_a, of_both, of_n, span, keep = share, 0.0, noise, 0.0, 1.0
    for row in range(values.shape[0]):
        if fresh[row]:
            of_a, of_both, of_n = share, 0.0, noise
            for column in range(values.shape[1]):
                state[0, column], state[1, column] = 0.0, 0.0
        variance = of_a + of_n - 2.0 * of_both + noise
        gain_a, gain_n = (of_a - of_both) / variance, noise / variance
        if spans[row] != span:
            span = spans[row]
            keep = math.exp(decay * span)
        for column in range(values.shape[1]):
            fresh_part = values[row, column] - state[0, column] + state[1, column]
            made[row, column] = fresh_part
            state[0, column] = keep * (state[0, column] + gain_a * fresh_part)
            state[1, column] = gain_n * fresh_part
        deviations[row] = math.sqrt(variance)
        after = of_a - gain_a * gain_a * variance
        of_both = -keep * gain_a * gain_n * variance
        of_n = noise - gain_n * gain_n * variance
        of_a = keep * keep * after + (1.0 - keep * keep) * share
