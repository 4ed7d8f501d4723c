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
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import minimize

from pipeline.core import compiled

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
_SAME, _MOST_ROUNDS = 0.005, 80
"""Difference of chi-square at which the likelihood of both numbers has converged, and rounds until then."""
_FARTHEST = 8.0
"""Largest logit of a share or a correlation."""
_LOGS = 16
"""Variances whose product is taken before its logarithm."""
_SCALE_ROUNDS = 30
_SAME_SCALE = 1e-4
"""Relative change of a scale at which it has converged."""
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

    def spread_after(self, seconds: Floats) -> tuple[Floats, Floats]:
        """Variances of the sum of increments over times by poses and by disturbance, shape (m, 3) each."""
        count = np.maximum(seconds / self.step_s, 1.0)[:, None]
        phi, variance = self.correlation, self.spread**2
        poses = np.broadcast_to(2.0 * (1.0 - self.share) * variance, (count.size, 3))
        grown = count * (1.0 + phi) / (1.0 - phi) - 2.0 * phi * (1.0 - phi**count) / (1.0 - phi) ** 2
        return poses, self.share * variance * grown


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
    """Correlation and share of the disturbance."""
    most = math.exp(-step_s / _LONGEST_S)

    def read(at: Sequence[float]) -> tuple[float, float]:
        phi, part = (1.0 / (1.0 + math.exp(-min(max(one, -_FARTHEST), _FARTHEST))) for one in at)
        return phi * most, part

    flat, size = np.ascontiguousarray(values[:, 0]), np.empty(values.shape[0])

    def cost(at: Floats) -> float:
        return _find_cost(flat, steps.fresh, steps.spans, step_s, *read(at.tolist()), size)

    starts, width = [(2.0, -2.0), (0.0, 1.0)], 1.2
    if known is not None and not exact:
        logits = (math.log(max(one, 1e-9) / max(1.0 - one, 1e-9)) for one in (known[0] / most, known[1]))
        # Near the ends the likelihood is flat, and nothing would lead away from there.
        first, second = (min(max(one, -_FARTHEST / 2.0), _FARTHEST / 2.0) for one in logits)
        starts, width = [(first, second)], 0.4
    outcome = [
        minimize(
            cost,
            np.array(start),
            method="Nelder-Mead",
            options={
                # Where one of them says nothing, as the correlation of no disturbance, it may be anything.
                "maxiter": _MOST_ROUNDS,
                "xatol": math.inf,
                "fatol": _SAME,
                "initial_simplex": np.add(start, [[0.0, 0.0], [-width, 0.0], [0.0, -width]]),
            },
        )
        for start in starts
    ]
    return read(min(outcome, key=lambda one: float(one.fun)).x.tolist())


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
    scale = max(1.2533 * mean / size.size, 1e-12)
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


@compiled("float64(float64[::1], boolean[::1], float64[::1], float64, float64, float64, float64[::1])")
def _find_cost(
    values: Floats, fresh: Flags, spans: Floats, step_s: float, phi: float, share: float, size: Floats
) -> float:
    """Minus twice the logarithm of the likelihood of increments, at the scale of most likelihood.

    Args:
        values: increments, shape (n,).
        fresh: steps that do not continue the one before, shape (n,).
        spans: length of each step [s], shape (n,).
        step_s: time to which the correlation refers [s].
        phi: correlation of the disturbance.
        share: its share in the variance.
        size: room for the sizes of the innovations, shape (n,).
    """
    noise, decay = 1.0 - share, math.log(max(phi, 1e-300)) / step_s
    of_a, of_both, of_n, a, n, span, keep = share, 0.0, noise, 0.0, 0.0, 0.0, 1.0
    logs, product = 0.0, 1.0
    for row in range(values.size):
        if fresh[row]:
            of_a, of_both, of_n, a, n = share, 0.0, noise, 0.0, 0.0
        variance = of_a + of_n - 2.0 * of_both + noise
        inverse = 1.0 / variance
        gain_a, gain_n = (of_a - of_both) * inverse, noise * inverse
        if spans[row] != span:
            span = spans[row]
            keep = math.exp(decay * span)
        fresh_part = values[row] - a + n
        size[row] = abs(fresh_part) * math.sqrt(inverse)
        a = keep * (a + gain_a * fresh_part)
        n = gain_n * fresh_part
        after = of_a - gain_a * gain_a * variance
        of_both = -keep * gain_a * gain_n * variance
        of_n = noise - gain_n * gain_n * variance
        of_a = keep * keep * after + (1.0 - keep * keep) * share
        # One logarithm for some variances, all between a thousandth and a few.
        product *= variance
        if row % _LOGS == 0:
            logs, product = logs + math.log(product), 1.0
    logs += math.log(product)
    scale, cost = _find_scale(size), 0.0
    for value in size:
        z = value / scale
        held = min(z, CLIP)
        cost += held * (2.0 * z - held)
    return cost + 2.0 * size.size * math.log(scale) + logs


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
