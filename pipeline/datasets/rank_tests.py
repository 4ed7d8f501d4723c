"""Rank and permutation tests, and p values corrected for multiple comparisons."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pipeline.core import CONFIDENCE, Flags, Floats, SlipError

# Medians, permutation tests and effect sizes: functions of arrays, usable alone.
#
# Slip is autocorrelated, so the unit is not the sample but the run, or a part of one run if there is only
# one. This module is independent of logs, tables and vehicles.

LEVEL = 1.0 - CONFIDENCE
"""Significance level."""


class StatisticsError(SlipError):
    """Values for which a statistic is not defined."""


@dataclass(frozen=True)
class Interval:
    """The two ends of a confidence interval of 95 %."""

    low: float
    high: float


def check_values(values: ArrayLike, *, what: str, fewest: int = 1) -> Floats:
    """Return the values as a flat array of finite numbers.

    Args:
        values: any numbers, shape (n,).
        what: name of the values in an error.
        fewest: minimum number of values.

    Raises:
        StatisticsError: ``not_finite`` or ``too_few_values``.
    """
    checked = np.asarray(values, dtype=np.float64).ravel()
    wrong = int(np.count_nonzero(~np.isfinite(checked)))
    if wrong:
        text = f"{wrong} of {checked.size} {what} are not finite numbers"
        raise StatisticsError("not_finite", text, hint="Leave them out before, and say so")
    if checked.size < fewest:
        text = f"there are {checked.size} {what}, and {fewest} are needed"
        hint = "Add runs, or compare what there is run against run"
        raise StatisticsError("too_few_values", text, hint=hint)
    return checked


_WORDS = ((0.147, "negligible"), (0.33, "small"), (0.474, "medium"))
"""Upper limits of Cliff's delta for each name (Romano et al. 2006)."""


def shift_between(a: ArrayLike, b: ArrayLike) -> float:
    """Hodges-Lehmann shift: the median of all differences b - a, in the unit of the values.

    Source: Hodges and Lehmann, Annals of Mathematical Statistics 34 (1963).

    Args:
        a: values of one side, shape (n,).
        b: values of the other side, shape (m,).

    Raises:
        StatisticsError: a side is empty or contains a value that is not finite.
    """
    first, second = check_values(a, what="values"), check_values(b, what="values")
    return float(np.median(second[:, None] - first[None, :]))


def cliffs_delta(a: ArrayLike, b: ArrayLike) -> float:
    """Cliff's delta in [-1, 1]: how much more often a value of b is above one of a than below it.

    Vargha and Delaney's A12 of b over a is (delta + 1) / 2. Source: Cliff, Psychological Bulletin 114 (1993).

    Args:
        a: values of one side, shape (n,).
        b: values of the other side, shape (m,).

    Raises:
        StatisticsError: a side is empty or contains a value that is not finite.
    """
    first, second = check_values(a, what="values"), check_values(b, what="values")
    from scipy.stats import mannwhitneyu  # noqa: PLC0415 - heavy

    above = float(mannwhitneyu(second, first, method="asymptotic").statistic)
    pairs = first.size * second.size
    return (above - (pairs - above)) / pairs


def name_delta(delta: float) -> str:
    """Cliff's delta in a word: negligible, small, medium or large.

    The limits 0.147, 0.33 and 0.474 are those of Romano et al. (2006), for normal values the same as Cohen's.
    """
    size = abs(delta)
    return next((word for limit, word in _WORDS if size < limit), "large")


def mann_whitney(a: ArrayLike, b: ArrayLike) -> float:
    """Two-sided p of the Mann-Whitney test in its normal approximation, with ties and continuity.

    For correlated samples this p is not valid: two equal runs of ten minutes are called different in two
    cases of three. Source: Mann and Whitney, Annals of Mathematical Statistics 18 (1947).

    Args:
        a: samples of one side, shape (n,).
        b: samples of the other side, shape (m,).

    Raises:
        StatisticsError: a side is empty or contains a value that is not finite.
    """
    first, second = check_values(a, what="samples"), check_values(b, what="samples")
    if np.ptp(np.concatenate((first, second))) == 0.0:
        return 1.0
    from scipy.stats import mannwhitneyu  # noqa: PLC0415 - heavy

    return float(mannwhitneyu(first, second, method="asymptotic").pvalue)


def kendall_tau(a: ArrayLike, b: ArrayLike) -> float:
    """Kendall's tau-b: 1 for the same order, -1 for the reverse; 0 if one measure has only ties.

    Source: Kendall, Biometrika 33 (1945).

    Args:
        a: one measure of n things, shape (n,).
        b: the other measure of the same things, shape (n,).

    Raises:
        StatisticsError: fewer than two things, or a value that is not finite.
    """
    first, second = check_values(a, what="values", fewest=2), check_values(b, what="values", fewest=2)
    from scipy.stats import kendalltau  # noqa: PLC0415 - heavy

    tau = float(kendalltau(first, second).statistic)
    return 0.0 if math.isnan(tau) else tau


def kendall_p(tau: float, count: int) -> tuple[float, float]:
    """Two-sided p of Kendall's tau under no association, and the smallest p possible with `count` things.

    Exact for orders without ties: the number of orders with each number of discordant pairs follows from a
    recursion over the things (Kendall, Biometrika 30, 1938).

    Args:
        tau: as from `kendall_tau`.
        count: number of ordered things, at least two.
    """
    chances = np.ones(1)
    for size in range(2, count + 1):
        chances = np.convolve(chances, np.full(size, 1.0 / size))
    levels = np.abs(1.0 - 2.0 * np.arange(chances.size) / (chances.size - 1))
    return float(chances[levels >= abs(tau) - 1e-9].sum()), float(chances[levels >= 1.0 - 1e-9].sum())


def list_swaps(a: ArrayLike, b: ArrayLike) -> list[tuple[int, int]]:
    """Pairs (i, j) with ``a[i] > a[j]`` but ``b[i] < b[j]``, the strongest contradiction in ranks first.

    Raises:
        StatisticsError: a value is not finite.
    """
    first, second = check_values(a, what="values"), check_values(b, what="values")
    rank_a, rank_b = first.argsort().argsort(), second.argsort().argsort()
    swaps = [
        (i, j)
        for i in range(first.size)
        for j in range(first.size)
        if first[i] > first[j] and second[i] < second[j]
    ]
    return sorted(swaps, key=lambda pair: (_gap(rank_a, rank_b, pair), pair))


def _gap(
    rank_a: np.ndarray[tuple[int], np.dtype[np.intp]],
    rank_b: np.ndarray[tuple[int], np.dtype[np.intp]],
    pair: tuple[int, int],
) -> int:
    i, j = pair
    return -min(int(rank_a[i] - rank_a[j]), int(rank_b[j] - rank_b[i]))


# Permutation tests: the values stay, the labels are permuted.
#
# The only assumption is that the units (runs, or parts of one run) are exchangeable if there is no
# difference. Samples of one run are not: they are correlated. Source: Good, Permutation,
# Parametric and Bootstrap Tests of Hypotheses (2005).

MOST_LABELLINGS = 20_000
"""Largest number of labellings to enumerate: up to 8 units per side (12,870); 9 per side have 48,620."""
TIE = 1e-9
"""Relative tolerance for equal statistics: sums in another order differ by rounding."""


def permute_means(a: ArrayLike, b: ArrayLike) -> float:
    """Two-sided p of the difference of means, by all labellings of the units; never zero.

    Args:
        a: one value per unit (usually the logarithm of a run's median), shape (n,).
        b: the same for the other side, shape (m,).

    Raises:
        StatisticsError: a side is empty or contains a value that is not finite.
    """
    return _Labellings.make(a, b).find_p(0.0)


def bound_permuted(a: ArrayLike, b: ArrayLike) -> tuple[float, float] | None:
    """Bounds of the difference b - a: the shifts of b that the permutation test does not reject.

    They exclude zero exactly if the test's p is at most `LEVEL`. Source: Good, Permutation, Parametric and
    Bootstrap Tests of Hypotheses (2005), section 3.2.

    Args:
        a: one value per unit, shape (n,).
        b: the same for the other side, shape (m,).

    Returns:
        None if the units are too few for a p of `LEVEL`: no shift can be rejected.

    Raises:
        StatisticsError: a side is empty or contains a value that is not finite.
    """
    labellings = _Labellings.make(a, b)
    low, high = (labellings.find_end(direction) for direction in (-1.0, 1.0))
    return None if low is None or high is None else (low, high)


def smallest_p(first: int, second: int) -> float:
    """Smallest p possible with ``first`` and ``second`` units in a two-sided permutation test.

    With as many units on both sides the mirrored labelling is as extreme: 2 of all, otherwise 1 of all.
    """
    return min((2.0 if first == second else 1.0) / math.comb(first + second, first), 1.0)


@functools.lru_cache(maxsize=8)
def list_labellings(first: int, second: int) -> Flags:
    """All labellings of first + second units.

    Returns:
        True if a unit belongs to the first side, shape (labellings, first + second).
    """
    count = first + second
    chosen = np.array(list(itertools.combinations(range(count), first)), dtype=np.intp)
    marks = np.zeros((len(chosen), count), dtype=bool)
    np.put_along_axis(marks, chosen.reshape(-1, first), values=True, axis=1)
    return marks


_DOUBLINGS = 60
"""Largest number of doublings of a distance: the last is beyond any shift that a double can resolve."""
_HALVINGS = 40
"""Halvings of a distance: the last digits of a double are left."""


@dataclass(frozen=True)
class _Labellings:
    """All labellings of the units of two sides; the first is the given one.

    Attributes:
        values: of all units about their mean, those of the first side before those of the second, shape (n,).
        marks: which units belong to the first side, shape (labellings, n).
    """

    values: Floats
    marks: Flags

    @classmethod
    def make(cls, a: ArrayLike, b: ArrayLike) -> _Labellings:
        """List the labellings of the units of both sides."""
        first, second = check_values(a, what="values"), check_values(b, what="values")
        values = np.concatenate((first, second))
        return cls(values - values.mean(), list_labellings(first.size, second.size))

    @property
    def sizes(self) -> tuple[int, int]:
        """Numbers of units of both sides."""
        first = int(np.count_nonzero(self.marks[0]))
        return first, self.values.size - first

    @functools.cached_property
    def _sums(self) -> Floats:
        """Sums over the first side of values and of units of the second side, shape (2, labellings)."""
        sums: Floats = (self.marks @ np.column_stack((self.values, ~self.marks[0]))).T
        return sums

    def find_p(self, shift: float) -> float:
        """Two-sided p of the hypothesis that the second side is the first one plus a shift."""
        (first, second), (sums, others) = self.sizes, self._sums
        moved = sums - shift * others
        size = np.abs((self.values.sum() - shift * second - moved) / second - moved / first)
        return float(np.mean(size >= size[0] - TIE * float(size.max())))

    def find_end(self, direction: float) -> float | None:
        """The last shift in a direction from the observed one that is not rejected; None without an end."""
        first, _ = self.sizes
        inner = float(self.values[first:].mean() - self.values[:first].mean())
        extent = float(np.ptp(self.values))
        if smallest_p(*self.sizes) > LEVEL:
            return None
        if extent == 0.0:
            return inner
        outer = inner + direction * extent
        # Zero is on the side of the interval on which its own test puts it.
        if direction * inner < 0.0:
            inner, outer = (0.0, direction * extent) if self.find_p(0.0) > LEVEL else (inner, 0.0)
        for _ in range(_DOUBLINGS):
            if self.find_p(outer) <= LEVEL:
                break
            inner, outer = outer, outer + 2.0 * (outer - inner)
        else:
            return None
        for _ in range(_HALVINGS):
            middle = 0.5 * (inner + outer)
            inner, outer = (middle, outer) if self.find_p(middle) > LEVEL else (inner, middle)
        return inner


def adjust_holm(p_values: ArrayLike) -> Floats:
    """Holm's step-down correction (Scandinavian Journal of Statistics 6, 1979).

    Args:
        p_values: one per pair, shape (n,).

    Returns:
        Corrected p values in the same order, shape (n,).

    Raises:
        StatisticsError: a p value is not finite.
    """
    values = check_values(p_values, what="p values", fewest=0)
    order = np.argsort(values, kind="stable")
    stepped = np.maximum.accumulate(values[order] * np.arange(values.size, 0, -1))
    corrected = np.empty_like(values)
    corrected[order] = np.minimum(stepped, 1.0)
    return corrected


def connect_groups(pairs: Iterable[tuple[int, int]]) -> list[tuple[int, ...]]:
    """The sets of groups that pairs connect, in order; groups by their index."""
    sets: list[set[int]] = []
    for pair in pairs:
        joined = set(pair).union(*(one for one in sets if not one.isdisjoint(pair)))
        sets = [*(one for one in sets if one.isdisjoint(pair)), joined]
    return sorted(tuple(sorted(one)) for one in sets)
