"""Permutation tests: the values keep, the labels move.

The only assumption is that the units (runs, or blocks of one run) could have been labelled otherwise if there
were no difference. Samples of one run could not: they are correlated. Source: Good, Permutation, Parametric
and Bootstrap Tests of Hypotheses (2005); studentized: Janssen, Statistics and Probability Letters 36 (1997).
"""

import functools
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pipeline.core.arrays import Flags, Floats
from pipeline.fleet.statistics.arrays import check_values

LARGEST_EXACT = 20_000
DRAWS = 9_999
_TIE = 1e-9


@dataclass(frozen=True)
class PermutationTest:
    """What a permutation test says.

    Attributes:
        p: two-sided p value; never zero.
        smallest_p: the smallest p that so many units can give, whatever the difference.
        arrangements: labellings that were looked at.
        exact: whether these are all there are.
    """

    p: float
    smallest_p: float
    arrangements: int
    exact: bool


def permute_means(a: ArrayLike, b: ArrayLike, *, seed: int = 0, draws: int = DRAWS) -> PermutationTest:
    """Test the difference of means by relabelling whole units; for a handful of runs a side.

    All labellings are counted where they are at most `LARGEST_EXACT`; otherwise ``draws`` random ones.

    Args:
        a: one number a unit (usually the logarithm of a run's median), shape (n,).
        b: the same for the other side, shape (m,).
        seed: of the random labellings.
        draws: how many random labellings.

    Raises:
        StatisticsError: a side is empty or holds a value that is not finite.
    """
    return _permute(a, b, _differ_by_means, seed=seed, draws=draws)


def permute_studentized(a: ArrayLike, b: ArrayLike, *, seed: int = 0, draws: int = DRAWS) -> PermutationTest:
    """As `permute_means`, with Welch's t: keeps its level when the sides scatter differently; for many units.

    Raises:
        StatisticsError: a side is empty or holds a value that is not finite.
    """
    return _permute(a, b, _differ_by_welch, seed=seed, draws=draws)


def smallest_p(first: int, second: int, *, draws: int = DRAWS) -> float:
    """The smallest p that ``first`` and ``second`` units can give in a two-sided permutation test.

    With as many units on both sides the mirrored labelling is as extreme: 2 of all, otherwise 1 of all.
    """
    total = math.comb(first + second, first)
    if total > LARGEST_EXACT:
        return 1.0 / (draws + 1)
    return min((2.0 if first == second else 1.0) / total, 1.0)


@functools.lru_cache(maxsize=8)
def list_labellings(first: int, second: int, *, seed: int, draws: int = DRAWS) -> Flags:
    """Labellings of first + second units: all of them, or random ones with the given one in front.

    Returns:
        True where a unit belongs to the first side, shape (labellings, first + second).
    """
    count = first + second
    total = math.comb(count, first)
    if total <= LARGEST_EXACT:
        chosen = np.array(list(itertools.combinations(range(count), first)), dtype=np.intp)
        marks = np.zeros((total, count), dtype=bool)
        np.put_along_axis(marks, chosen.reshape(total, first), values=True, axis=1)
        return marks
    generator = np.random.default_rng(seed)
    marks = np.zeros((draws + 1, count), dtype=bool)
    marks[:, :first] = True
    marks[1:] = generator.permuted(marks[1:], axis=1)
    return marks


def _permute(
    a: ArrayLike,
    b: ArrayLike,
    statistic: Callable[[Floats, Flags], Floats],
    *,
    seed: int,
    draws: int,
) -> PermutationTest:
    first, second = check_values(a, what="values"), check_values(b, what="values")
    values = np.concatenate((first, second))
    values = values - values.mean()
    marks = list_labellings(first.size, second.size, seed=seed, draws=draws)
    found = np.abs(statistic(values, marks))
    given = np.zeros((1, values.size), dtype=bool)
    given[0, : first.size] = True
    observed = float(np.abs(statistic(values, given))[0])
    as_extreme = int(np.count_nonzero(found >= observed - _TIE * float(found.max())))
    total = math.comb(values.size, first.size)
    return PermutationTest(
        p=as_extreme / found.size,
        smallest_p=smallest_p(first.size, second.size, draws=draws),
        arrangements=found.size,
        exact=total <= LARGEST_EXACT,
    )


def _differ_by_means(values: Floats, marks: Flags) -> Floats:
    first = marks.sum(axis=1)
    total = float(values.sum())
    inside: Floats = marks @ values
    difference: Floats = (total - inside) / (values.size - first) - inside / first
    return difference


def _differ_by_welch(values: Floats, marks: Flags) -> Floats:
    first = marks.sum(axis=1)
    second = values.size - first
    sums, squares = marks @ values, marks @ values**2
    left, right = sums / first, (values.sum() - sums) / second
    spread_left = (squares / first - left**2) / np.maximum(first - 1, 1)
    spread_right = ((np.sum(values**2) - squares) / second - right**2) / np.maximum(second - 1, 1)
    error = np.sqrt(np.maximum(spread_left + spread_right, 0.0))
    floor = _TIE * max(float(np.abs(values).max()), 1.0e-300)
    difference: Floats = (right - left) / np.maximum(error, floor)
    return difference
