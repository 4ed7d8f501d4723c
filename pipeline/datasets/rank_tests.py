"""Rank and permutation tests, and p values corrected for multiple comparisons."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pipeline.core import CONFIDENCE, Flags, Floats, SlipError

# Medians, intervals, permutation tests and effect sizes: functions of arrays, usable alone.
#
# Slip is autocorrelated, so the unit is not the sample but the run, or a block of one run if there is only
# one. This module is independent of logs, tables and vehicles.

LEVEL = 1.0 - CONFIDENCE
"""Significance level."""


class StatisticsError(SlipError):
    """Values for which a statistic is not defined."""


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
# The only assumption is that the units (runs, or blocks of one run) are exchangeable if there is no
# difference. Samples of one run are not: they are correlated. Source: Good, Permutation,
# Parametric and Bootstrap Tests of Hypotheses (2005); studentized: Janssen, Statistics and Probability
# Letters 36 (1997).

LARGEST_EXACT = 20_000
"""Largest number of labellings to enumerate: up to 8 units per side (12,870); 9 per side have 48,620."""
DRAWS = 9_999
"""Random labellings: p = 0.05 is then known to a standard error of 0.002."""
FEWER_DRAWS = 1_999
"""Random labellings if many tests are made: p = 0.05 is then known to a standard error of 0.005."""
TIE = 1e-9
"""Relative tolerance for equal statistics: sums in another order differ by rounding."""


@dataclass(frozen=True)
class PermutationTest:
    """Result of a permutation test.

    Attributes:
        p: two-sided p value; never zero.
        smallest_p: smallest p possible with this number of units, whatever the difference.
        arrangements: number of evaluated labellings.
        exact: whether these are all labellings.
    """

    p: float
    smallest_p: float
    arrangements: int
    exact: bool


def permute_means(a: ArrayLike, b: ArrayLike, *, seed: int = 0, draws: int = DRAWS) -> PermutationTest:
    """Test the difference of means by relabelling whole units; for a few runs per side.

    All labellings are enumerated if they are at most `LARGEST_EXACT`; otherwise ``draws`` random ones.

    Args:
        a: one value per unit (usually the logarithm of a run's median), shape (n,).
        b: the same for the other side, shape (m,).
        seed: seed of the random labellings.
        draws: number of random labellings.

    Raises:
        StatisticsError: a side is empty or contains a value that is not finite.
    """
    return _Labellings.make(a, b, studentized=False, seed=seed, draws=draws).test


def permute_studentized(a: ArrayLike, b: ArrayLike, *, seed: int = 0, draws: int = DRAWS) -> PermutationTest:
    """As `permute_means`, with Welch's t: keeps its level for unequal variances; for many units.

    Raises:
        StatisticsError: a side is empty or contains a value that is not finite.
    """
    return _Labellings.make(a, b, studentized=True, seed=seed, draws=draws).test


def bound_permuted(
    a: ArrayLike,
    b: ArrayLike,
    *,
    studentized: bool = False,
    level: float = LEVEL,
    seed: int = 0,
    draws: int = DRAWS,
) -> tuple[float, float] | None:
    """Bounds of the difference b - a: the shifts of b that the permutation test does not reject.

    They exclude zero exactly if the test's p is at most ``level``. Source: Good, Permutation, Parametric and
    Bootstrap Tests of Hypotheses (2005), section 3.2.

    Args:
        a: one value per unit, shape (n,).
        b: the same for the other side, shape (m,).
        studentized: whether the test is `permute_studentized`, else `permute_means`.
        level: probability of bounds that miss the difference.
        seed: seed of the random labellings.
        draws: number of random labellings.

    Returns:
        None if the units are too few for a p of ``level``: no shift can be rejected.

    Raises:
        StatisticsError: a side is empty or contains a value that is not finite.
    """
    labellings = _Labellings.make(a, b, studentized=studentized, seed=seed, draws=draws)
    low, high = (labellings.find_end(direction, level) for direction in (-1.0, 1.0))
    return None if low is None or high is None else (low, high)


def smallest_p(first: int, second: int, *, draws: int = DRAWS) -> float:
    """Smallest p possible with ``first`` and ``second`` units in a two-sided permutation test.

    With as many units on both sides the mirrored labelling is as extreme: 2 of all, otherwise 1 of all.
    """
    total = math.comb(first + second, first)
    if total > LARGEST_EXACT:
        return 1.0 / (draws + 1)
    return min((2.0 if first == second else 1.0) / total, 1.0)


@functools.lru_cache(maxsize=8)
def list_labellings(first: int, second: int, *, seed: int, draws: int = DRAWS) -> Flags:
    """All labellings of first + second units, or random ones after the given one.

    Returns:
        True if a unit belongs to the first side, shape (labellings, first + second).
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


_DOUBLINGS = 60
"""Largest number of doublings of a distance: the last is beyond any shift that a double can resolve."""
_HALVINGS = 40
"""Halvings of a distance: the last digits of a double are left."""


@dataclass(frozen=True)
class _Labellings:
    """All labellings of the units of two sides, or random ones; the first is the given one.

    Attributes:
        values: of all units about their mean, those of the first side before those of the second, shape (n,).
        marks: which units belong to the first side, shape (labellings, n).
        studentized: whether Welch's t is compared between labellings, else the difference of means.
        draws: number of random labellings.
    """

    values: Floats
    marks: Flags
    studentized: bool
    draws: int

    @classmethod
    def make(cls, a: ArrayLike, b: ArrayLike, *, studentized: bool, seed: int, draws: int) -> _Labellings:
        """List the labellings of the units of both sides."""
        first, second = check_values(a, what="values"), check_values(b, what="values")
        values = np.concatenate((first, second))
        marks = list_labellings(first.size, second.size, seed=seed, draws=draws)
        return cls(values - values.mean(), marks, studentized, draws)

    @property
    def sizes(self) -> tuple[int, int]:
        """Numbers of units of both sides."""
        first = int(np.count_nonzero(self.marks[0]))
        return first, self.values.size - first

    @property
    def test(self) -> PermutationTest:
        """The test of equal sides."""
        first, second = self.sizes
        return PermutationTest(
            p=self.find_p(0.0),
            smallest_p=smallest_p(first, second, draws=self.draws),
            arrangements=self.marks.shape[0],
            exact=math.comb(first + second, first) <= LARGEST_EXACT,
        )

    @functools.cached_property
    def _sums(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Sums over the first side: of values, of units of the second side, of squares, of their values."""
        other = (~self.marks[0]).astype(np.float64)
        columns = np.column_stack((self.values, other, self.values**2, self.values * other))
        sums: Floats = self.marks @ columns
        return sums[:, 0], sums[:, 1], sums[:, 2], sums[:, 3]

    def find_p(self, shift: float) -> float:
        """Two-sided p of the hypothesis that the second side is the first one plus a shift."""
        statistics = self._differ(shift)
        as_extreme = np.count_nonzero(statistics >= statistics[0] - TIE * float(statistics.max()))
        return int(as_extreme) / statistics.size

    def _differ(self, shift: float) -> Floats:
        """Size of the statistic of each labelling, with the shift taken off the second side."""
        (first, second), (sums, others, squares, products) = self.sizes, self._sums
        moved = self.values - shift * ~self.marks[0]
        sums = sums - shift * others
        mean_first, mean_second = sums / first, (moved.sum() - sums) / second
        difference: Floats = np.abs(mean_second - mean_first)
        if not self.studentized:
            return difference
        whole = float(moved @ moved)
        squares = squares - 2.0 * shift * products + shift**2 * others
        spread_first = (squares / first - mean_first**2) / max(first - 1, 1)
        spread_second = ((whole - squares) / second - mean_second**2) / max(second - 1, 1)
        error = np.sqrt(np.maximum(spread_first + spread_second, 0.0))
        studentized: Floats = difference / np.maximum(error, TIE * max(math.sqrt(whole), 1.0e-300))
        return studentized

    def find_end(self, direction: float, level: float) -> float | None:
        """The last shift in a direction from the observed one that is not rejected; None without an end."""
        first, _ = self.sizes
        inner = float(self.values[first:].mean() - self.values[:first].mean())
        extent = float(np.ptp(self.values))
        if smallest_p(*self.sizes, draws=self.draws) > level:
            return None
        if extent == 0.0:
            return inner
        outer = inner + direction * extent
        # Zero is on the side of the interval on which its own test puts it.
        if direction * inner < 0.0:
            inner, outer = (0.0, direction * extent) if self.find_p(0.0) > level else (inner, 0.0)
        for _ in range(_DOUBLINGS):
            if self.find_p(outer) <= level:
                break
            inner, outer = outer, outer + 2.0 * (outer - inner)
        else:
            return None
        for _ in range(_HALVINGS):
            middle = 0.5 * (inner + outer)
            inner, outer = (middle, outer) if self.find_p(middle) > level else (inner, middle)
        return inner


MOST_GROUPS = 8
"""Largest number of groups for max-T: closed testing visits all partitions, 4,140 of 8 and 21,147 of 9."""
_MOST_RUNS = 1_000
"""Upper limit of the search for a number of runs; a family of 23 pairs needs 6 per side."""


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


def find_testable(smallest: ArrayLike, *, level: float = LEVEL) -> tuple[Flags, int]:
    """The pairs that can be significant beside each other, and the number for which to correct.

    A pair whose smallest p is above the level over that number is never significant, whatever its data, and
    does not count. Source: Tarone, Biometrics 46 (1990).

    Args:
        smallest: smallest p possible of each pair, shape (n,).
        level: significance level.
    """
    values = check_values(smallest, what="smallest p", fewest=0)
    for count in range(1, values.size + 1):
        testable: Flags = values * count <= level
        if np.count_nonzero(testable) <= count:
            return testable, count
    return np.zeros(0, dtype=bool), 1


def adjust_max_t(
    groups: Sequence[ArrayLike],
    pairs: Collection[tuple[int, int]] | None = None,
    *,
    seed: int = 0,
    draws: int = DRAWS,
) -> Floats:
    """Corrected p of pairs of groups: closed testing with the largest difference (max-T).

    A pair is called different only if every hypothesis in which it is equal, together with any other pairs,
    is rejected. Each hypothesis splits the groups into sets of equal ones. Its test relabels the units within
    each set and takes the largest weighted difference of means, so it is exact, and the familywise error is
    controlled for any true configuration. For few runs it is more powerful than `adjust_holm`: a large
    difference keeps the p of its own pair. A hypothesis is tested by its pairs that count after Tarone
    (`find_testable`), if it has any: groups of few runs would only hide differences of others. Pairs whose
    smallest p is above the level are left out. Sources: Marcus, Peritz and Gabriel, Biometrika 63 (1976);
    Westfall and Young, Resampling-Based Multiple Testing (1993).

    Args:
        groups: units of each group (usually logarithms of run medians); at most `MOST_GROUPS` groups.
        pairs: the pairs of groups to test, each as (lower index, higher index); all by default.
        seed: seed of random labellings, used above `LARGEST_EXACT` labellings.
        draws: number of random labellings.

    Returns:
        Corrected p values, symmetric, one on the diagonal and for pairs that are left out, shape
        (groups, groups).

    Raises:
        StatisticsError: a group is empty or contains a value that is not finite.
        ValueError: there are more than `MOST_GROUPS` groups.
    """
    if len(groups) > MOST_GROUPS:
        raise ValueError(f"closed testing takes at most {MOST_GROUPS} groups, not {len(groups)}")
    values = [check_values(group, what="values of a group") for group in groups]
    asked = list(itertools.combinations(range(len(values)), 2) if pairs is None else pairs)
    smallest = np.array([smallest_p(values[i].size, values[j].size, draws=draws) for i, j in asked])
    possible = {asked[index] for index in np.flatnonzero(smallest <= LEVEL)}
    testable = {asked[index] for index in np.flatnonzero(find_testable(smallest)[0])}
    nulls: dict[tuple[int, ...], tuple[float, Floats]] = {}
    corrected = dict.fromkeys(possible, 0.0)
    for partition in _list_partitions(tuple(range(len(values)))):
        equal = {pair for pair in possible if any(set(pair) <= set(chosen) for chosen in partition)}
        # A set that the pairs do not connect is the union of others.
        if not equal or connect_groups(equal) != sorted(chosen for chosen in partition if len(chosen) > 1):
            continue
        counted = equal & testable or equal
        sets = connect_groups(counted)
        for chosen in sets:
            if chosen not in nulls:
                within = [(chosen.index(i), chosen.index(j)) for i, j in counted if {i, j} <= set(chosen)]
                units = [values[i] for i in chosen]
                nulls[chosen] = _list_largest(units, within, seed=seed, draws=draws)
        observed = max(nulls[chosen][0] for chosen in sets)
        tie = TIE * max(float(nulls[chosen][1].max()) for chosen in sets)
        none_above = 1.0
        for chosen in sets:
            none_above *= 1.0 - float(np.mean(nulls[chosen][1] >= observed - tie))
        for pair in equal:
            corrected[pair] = max(corrected[pair], 1.0 - none_above)
    matrix = np.ones((len(values), len(values)))
    for (i, j), p in corrected.items():
        matrix[i, j] = matrix[j, i] = min(p, 1.0)
    return matrix


def connect_groups(pairs: Iterable[tuple[int, int]]) -> list[tuple[int, ...]]:
    """The sets of groups that pairs connect, in order; groups by their index."""
    sets: list[set[int]] = []
    for pair in pairs:
        joined = set(pair).union(*(one for one in sets if not one.isdisjoint(pair)))
        sets = [*(one for one in sets if one.isdisjoint(pair)), joined]
    return sorted(tuple(sorted(one)) for one in sets)


def runs_needed(pairs: int, *, level: float = LEVEL) -> int:
    """Minimum number of runs per side for Holm's correction of ``pairs`` pairs to reach ``level``.

    4 for one pair, 5 for up to six, 6 for up to 23.
    """
    for runs in range(2, _MOST_RUNS):
        if 2.0 / math.comb(2 * runs, runs) * max(pairs, 1) <= level:
            return runs
    return _MOST_RUNS


def _list_largest(
    groups: list[Floats], pairs: Sequence[tuple[int, int]], *, seed: int, draws: int
) -> tuple[float, Floats]:
    """Largest weighted difference between pairs of the groups: observed, and for every labelling."""
    sizes = np.array([group.size for group in groups])
    values = np.concatenate(groups)
    values = values - values.mean()
    labels = np.repeat(np.arange(sizes.size), sizes)
    rows = _list_labels(tuple(sizes.tolist()), seed, draws)
    means = np.stack([(rows == i) @ values / sizes[i] for i in range(sizes.size)], axis=1)
    given = np.array([values[labels == i].mean() for i in range(sizes.size)])[None, :]
    return float(_take_largest(given, sizes, pairs)[0]), _take_largest(means, sizes, pairs)


def _take_largest(
    means: Floats, sizes: np.ndarray[tuple[int], np.dtype[np.int_]], pairs: Sequence[tuple[int, int]]
) -> Floats:
    largest = np.zeros(means.shape[0])
    for i, j in pairs:
        weight = math.sqrt(sizes[i] * sizes[j] / (sizes[i] + sizes[j]))
        largest = np.maximum(largest, weight * np.abs(means[:, i] - means[:, j]))
    return largest


@functools.lru_cache(maxsize=256)
def _list_labels(
    sizes: tuple[int, ...], seed: int, draws: int
) -> np.ndarray[tuple[int, int], np.dtype[np.int8]]:
    """Labels of all labellings of groups with these sizes, or of the given one and random ones."""
    labels = np.repeat(np.arange(len(sizes), dtype=np.int8), sizes)
    total = math.factorial(sum(sizes)) // math.prod(math.factorial(size) for size in sizes)
    if total <= LARGEST_EXACT:
        return np.array(list(_list_arrangements(list(sizes))), dtype=np.int8)
    rows = np.tile(labels, (draws + 1, 1))
    rows[1:] = np.random.default_rng(seed).permuted(rows[1:], axis=1)
    return rows


def _list_arrangements(counts: list[int]) -> Iterator[tuple[int, ...]]:
    if not any(counts):
        yield ()
        return
    for label, count in enumerate(counts):
        if count:
            rest = [*counts[:label], count - 1, *counts[label + 1 :]]
            for tail in _list_arrangements(rest):
                yield (label, *tail)


def _list_partitions(items: tuple[int, ...]) -> Iterator[list[tuple[int, ...]]]:
    """All partitions of the items into sets."""
    if not items:
        yield []
        return
    head, rest = items[0], items[1:]
    for size in range(len(rest) + 1):
        for friends in itertools.combinations(rest, size):
            others = tuple(item for item in rest if item not in friends)
            for partition in _list_partitions(others):
                yield [(head, *friends), *partition]
