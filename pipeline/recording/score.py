"""Likelihood of a measured motion under one reading of the other signals.

Increments of a pose are a disturbance plus differences of the localization's noise: each reading is judged by
the innovations of an ARMA(1,1) process that is fitted to its own residuals, under Student's t with four
degrees of freedom. Likelihoods are summed in blocks of five seconds, and two readings are compared by
Vuong's statistic over the blocks (Vuong 1989, Econometrica 57).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.core import Flags, Floats, Ints, find_scale, list_likelihoods, recur, weigh

BLOCK_S = 5.0
"""Length of a block [s], longer than any correlation of the noise that is modelled."""
CLEAR = 3.0
"""Least Vuong statistic of a decision."""
LEAST_NATS = 0.02
"""Least gain in log-likelihood per step of a decision: below it a difference is of no importance."""
FEWEST_STEPS = 30
"""Least number of steps for a likelihood."""
_ROUNDING_S = 1e-6
_NOISES = ((0.0, 0.0), *((phi, theta) for phi in (0.0, 0.4, 0.7, 0.9) for theta in (0.0, 0.3, 0.6, 0.85)
                         if phi != theta))  # fmt: skip
"""Grid of the noise's (phi, theta)."""


_MOST_ROWS = 3000
"""Number of steps above which the noise is fitted to some of the blocks."""


@dataclass(frozen=True)
class Steps:
    """Time steps of a motion, in order.

    Attributes:
        start, end: times [s], shape (n,).
    """

    start: Floats
    end: Floats

    @cached_property
    def fresh(self) -> Flags:
        """Whether a step does not begin where the one before ended, shape (n,)."""
        return np.append(True, np.abs(self.start[1:] - self.end[:-1]) > _ROUNDING_S)

    @cached_property
    def block(self) -> Ints:
        """Number of each step's block, shape (n,)."""
        length = min(BLOCK_S, max(0.4, float(np.ptp(self.start)) / 12.0))
        number = ((self.start - self.start.min()) // length).astype(np.int64)
        return np.unique(number, return_inverse=True)[1]

    def take(self, keep: Flags) -> Steps:
        """Some of the steps."""
        return Steps(self.start[keep], self.end[keep])


@dataclass(frozen=True)
class Fit:
    """Regression under correlated noise with heavy tails.

    Attributes:
        gains: coefficients, shape (k,).
        t: their ratios to standard errors that are robust to correlation within blocks, shape (k,).
        blocks: log-likelihood of every block, shape (m,).
        turned: the same with the first coefficient of the other sign.
    """

    gains: Floats
    t: Floats
    blocks: Floats
    turned: Floats


def _whiten(values: Floats, noise: tuple[float, float], steps: Steps) -> Floats:
    """Innovations u_k = d_k - phi d_(k-1) + theta u_(k-1) of every column, restarted at gaps."""
    phi, theta = noise
    goes_on = ~steps.fresh[1:, None]
    made = np.array(values, dtype=np.float64)
    made[1:] -= np.where(goes_on, phi * values[:-1], 0.0)
    return recur(made, np.where(goes_on[:, 0], theta, 0.0))


def _solve(values: Floats, columns: Floats, rounds: int = 6) -> tuple[Floats, Floats, Floats]:
    """Gains, residuals and square roots of the weights by reweighted least squares."""
    gains: Floats = np.zeros(columns.shape[1])
    weight: Floats = np.ones(values.size)
    rest: Floats = values
    for _ in range(rounds):
        if gains.size:
            weighted = columns * weight[:, None]
            normal, right = weighted.T @ weighted, weighted.T @ (values * weight)
            gains = np.asarray(np.linalg.lstsq(normal, right, rcond=1e-12)[0], dtype=np.float64)
        rest = np.asarray(values - columns @ gains, dtype=np.float64)
        weight = np.sqrt(weigh(rest))
        if not gains.size:
            break
    return gains, rest, weight


def fit(values: Floats, columns: Floats, steps: Steps) -> Fit:
    """Fit a channel of the motion by columns.

    Args:
        values: increments, shape (n,).
        columns: explaining increments, shape (n, k); k may be zero.
        steps: the time steps.
    """
    _, rest, _ = _solve(values, columns)
    noise, best = _NOISES[0], -np.inf
    # Whole blocks of a long run show its noise.
    some = steps.block % max(1, rest.size // _MOST_ROWS) == 0
    part, few = rest[some][:, None], steps.take(some)
    for each in _NOISES:
        score = float(list_likelihoods(_whiten(part, each, few)[:, 0]).sum())
        if score > best + 2.0:
            noise, best = each, score
    white = _whiten(np.column_stack([values, columns]), noise, steps)
    design = white[:, 1:]
    gains, rest, weight = _solve(white[:, 0], design)
    blocks: Floats = np.bincount(steps.block, list_likelihoods(rest)).astype(np.float64)
    if not gains.size:
        return Fit(gains, gains, blocks, blocks)
    inverse = np.linalg.pinv((design * weight[:, None]).T @ (design * weight[:, None]))
    pulls = np.column_stack([np.bincount(steps.block, column * weight**2 * rest) for column in design.T])
    error = np.sqrt(np.maximum(np.diag(inverse @ (pulls.T @ pulls) @ inverse), 1e-30))
    other = list_likelihoods(rest + 2.0 * gains[0] * design[:, 0])
    return Fit(gains, gains / error, blocks, np.bincount(steps.block, other).astype(np.float64))


def measure_share(values: Floats, model: Floats) -> float:
    """Part of the size of some increments that a model explains, outliers discounted, from 0 to 1."""
    return 1.0 - min(1.0, (find_scale(values - model) / find_scale(values)) ** 2)


def compare(one: Floats, other: Floats) -> float:
    """Vuong's statistic of two readings by their likelihoods in blocks; positive if the first is likelier."""
    gain = one - other
    gain = gain[gain != 0.0]
    return 0.0 if gain.size < 4 else float(gain.sum() / (np.sqrt(gain.size) * gain.std() + 1e-9))  # noqa: PLR2004
