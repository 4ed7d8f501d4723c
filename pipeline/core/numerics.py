"""Small numerical methods whose library import would take longer than their use in a diagnosis.

Importing those of SciPy (`stdtrit`, `nnls`, `solveh_banded`) takes half a second of CPU; tests compare the
results.
"""

from __future__ import annotations

import functools
import math
from statistics import NormalDist

import numpy as np

from pipeline.core.arrays import Flags, Floats
from pipeline.core.machine_code import compiled

_MANY = 400.0
"""Degrees of freedom above which the series for the quantile is exact to 1e-10."""
_SOME = 5.0
"""Degrees of freedom above which the series is closer than the normal quantile."""
_TINY = 1e-300
"""Replacement of a zero divisor in Lentz's method: the smallest double is 2e-308."""
_ROOT_HALF = math.sqrt(0.5)
_ROUNDS = 1000
"""Maximum number of steps, a guard. Both loops end by `_EXACT`, the fraction in about sqrt(`_MANY`) steps."""
_EXACT = 1e-12
"""Relative change of the result by the last step."""


@functools.lru_cache(maxsize=4096)
def student_quantile(level: float, freedom: float) -> float:
    """Quantile of Student's t for a two-sided level; NaN without degrees of freedom.

    Args:
        level: share of draws within the quantile, between 0 and 1.
        freedom: degrees of freedom, any number above 0.

    Sources: Abramowitz and Stegun, Handbook of Mathematical Functions, 26.7.5 for many degrees of freedom;
    else Newton's method on the tail, which is convex, starting from that series, or for few degrees of
    freedom from the normal quantile, which is smaller.
    """
    if not freedom > 0.0:
        return math.nan
    z = NormalDist().inv_cdf((1.0 + level) / 2.0)
    terms = (
        (z**3 + z) / 4.0,
        (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / 96.0,
        (3.0 * z**7 + 19.0 * z**5 + 17.0 * z**3 - 15.0 * z) / 384.0,
        (79.0 * z**9 + 776.0 * z**7 + 1482.0 * z**5 - 1920.0 * z**3 - 945.0 * z) / 92160.0,
    )
    near = z + sum(term / freedom ** (power + 1) for power, term in enumerate(terms))
    if freedom > _MANY:
        return near
    height = math.lgamma(0.5 * (freedom + 1.0)) - math.lgamma(0.5 * freedom)
    height -= 0.5 * math.log(freedom * math.pi)
    quantile = near if freedom > _SOME else z
    for _ in range(_ROUNDS):
        beyond = _find_tail(quantile, freedom) - (1.0 - level)
        slope = 2.0 * math.exp(height - 0.5 * (freedom + 1.0) * math.log1p(quantile**2 / freedom))
        quantile += beyond / slope
        if abs(beyond) <= _EXACT * slope * quantile:
            break
    return quantile


def normal_tail(deviations: Floats) -> Floats:
    """Upper tail probability of the standard normal distribution, shape (n,)."""
    return np.array([0.5 * math.erfc(one * _ROOT_HALF) for one in deviations.tolist()])


def jackknife_deviation(without: Floats) -> float:
    """Standard error of an estimate by the delete-one jackknife.

    Args:
        without: the estimate without each block in turn, shape (n,).

    Source: Efron and Tibshirani, An Introduction to the Bootstrap, 1993, 11.5.
    """
    return math.sqrt((without.size - 1.0) * float(np.mean((without - without.mean()) ** 2)))


def _find_tail(t: float, freedom: float) -> float:
    """Two-sided tail probability of Student's t distribution: an incomplete beta function."""
    x = freedom / (freedom + t * t)
    a, b = 0.5 * freedom, 0.5
    front = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) + a * math.log(x)
    front += b * math.log(t * t / (freedom + t * t))
    if x < (a + 1.0) / (a + b + 2.0):
        return math.exp(front) * _continue_fraction(a, b, x) / a
    return 1.0 - math.exp(front) * _continue_fraction(b, a, 1.0 - x) / b


def _continue_fraction(a: float, b: float, x: float) -> float:
    """Continued fraction of the incomplete beta function (Lentz's method; Abramowitz and Stegun 26.5.8)."""
    c, d = 1.0, 1.0 / _keep_off_zero(1.0 - (a + b) * x / (a + 1.0))
    fraction = d
    for m in range(1, _ROUNDS):
        even = m * (b - m) * x / ((a + 2 * m - 1.0) * (a + 2 * m))
        odd = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1.0))
        for part in (even, odd):
            d = 1.0 / _keep_off_zero(1.0 + part * d)
            c = _keep_off_zero(1.0 + part / c)
            fraction *= c * d
        if abs(c * d - 1.0) < _EXACT:
            break
    return fraction


def _keep_off_zero(value: float) -> float:
    return value if abs(value) > _TINY else _TINY


def solve_nonnegative(design: Floats, target: Floats) -> Floats:
    """Non-negative least squares: minimize the norm of ``design @ numbers - target``, shape (p,).

    Args:
        design: shape (n, p), p in the tens.
        target: shape (n,).

    Source: Lawson and Hanson, Solving Least Squares Problems, 1974, chapter 23.
    """
    count = design.shape[1]
    numbers, free = np.zeros(count), np.zeros(count, dtype=bool)
    least = 10.0 * np.finfo(float).eps * float(np.abs(design).sum(axis=0).max()) * max(design.shape)
    for _ in range(3 * count):
        push = design.T @ (target - design @ numbers)
        push[free] = -np.inf
        if free.all() or push.max() <= least:
            break
        free[int(push.argmax())] = True
        solved = _solve_free(design, target, free)
        while (solved[free] <= 0.0).any():
            # Longest step towards the solution without negative numbers; those that reach zero are fixed.
            falling = free & (solved <= 0.0)
            share = float(np.min(numbers[falling] / (numbers[falling] - solved[falling])))
            numbers += share * (solved - numbers)
            free &= numbers > least
            numbers[~free] = 0.0
            solved = _solve_free(design, target, free)
        numbers = solved
    return numbers


def _solve_free(design: Floats, target: Floats, free: Flags) -> Floats:
    solved = np.zeros(free.size)
    solved[free] = np.linalg.lstsq(design[:, free], target, rcond=None)[0]
    return solved


def solve_tridiagonal(diagonal: Floats, beside: Floats, right: Floats) -> Floats:
    """Solution of a symmetric positive definite tridiagonal system, shape (n,).

    Args:
        diagonal: shape (n,).
        beside: off-diagonal, shape (n - 1,).
        right: right-hand side, shape (n,).

    Source: Golub and Van Loan, Matrix Computations, 4.3.6.
    """
    solution = right.copy()
    _solve_tridiagonal(diagonal.copy(), np.ascontiguousarray(beside), solution)
    return solution


@compiled("float64[:], float64[:], float64[:]")
def _solve_tridiagonal(diagonal: Floats, beside: Floats, solution: Floats) -> None:
    """`solve_tridiagonal` in place: ``solution`` is the right-hand side; ``diagonal`` is overwritten."""
    for row in range(1, diagonal.size):
        share = beside[row - 1] / diagonal[row - 1]
        diagonal[row] -= share * beside[row - 1]
        solution[row] -= share * solution[row - 1]
    for row in range(diagonal.size - 1, -1, -1):
        # Also the last row is solved in the loop: an empty system has no memory to write to.
        if row + 1 < diagonal.size:
            solution[row] -= beside[row] * solution[row + 1]
        solution[row] /= diagonal[row]
