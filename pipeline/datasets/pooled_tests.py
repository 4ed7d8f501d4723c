"""Grounds compared by the means of their runs, with a spread between runs that all grounds share.

A run is the unit. Grounds of one vehicle differ in their means, and runs of one ground scatter about it. That
scatter is pooled over the grounds, so that a ground with a single run can be compared, too.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.core import CONFIDENCE, FEWEST_OF_SPREAD, Floats, student_quantile
from pipeline.datasets.rank_tests import (
    LEVEL,
    MOST_LABELLINGS,
    Interval,
    adjust_holm,
    bound_permuted,
    check_values,
    permute_means,
    smallest_p,
)


@dataclass(frozen=True)
class Difference:
    """Difference of the means of two groups, b - a.

    Attributes:
        value: the difference, in the unit of the values.
        interval: 95 % interval; of the pair alone by permutation, else of all pairs at once. None where the
            numbers of runs reject nothing, and where runs that do not scatter at all differ.
        p: two-sided p of the pair alone; NaN where runs that do not scatter at all differ.
        p_adjusted: p over all pairs.
        smallest_p: smallest p possible with these numbers of runs, whatever the difference.
    """

    value: float
    interval: Interval | None
    p: float
    p_adjusted: float
    smallest_p: float


@dataclass(frozen=True)
class MeansTest:
    """Comparison of the means of several groups.

    Attributes:
        method: the test, in words.
        spread: standard deviation between runs of a group, pooled, in the unit of the values.
        freedom: its degrees of freedom.
        differences: one a pair, in the order of the pairs.
        is_pooled: whether the tests take the pooled spread.
    """

    method: str
    spread: float
    freedom: int
    differences: tuple[Difference, ...]
    is_pooled: bool = False


def pool_spread(groups: Sequence[Floats]) -> tuple[float, int]:
    """Standard deviation of values about the means of their groups, and its degrees of freedom.

    Args:
        groups: values of each group, each shape (n,).

    Returns:
        NaN and 0 where there are too few values for a spread: it takes as many as of one group of three.
    """
    freedom = sum(group.size - 1 for group in groups)
    if freedom < FEWEST_OF_SPREAD - 1:
        return math.nan, 0
    squares = sum(float(np.sum((group - group.mean()) ** 2)) for group in groups)
    return math.sqrt(squares / freedom), freedom


def do_spreads_differ(groups: Sequence[Floats]) -> bool:
    """Whether the test of Brown and Forsythe finds unequal spreads; False where a group has fewer than three.

    Source: Brown and Forsythe, Journal of the American Statistical Association 69 (1974).
    """
    if len(groups) < 2 or any(group.size < FEWEST_OF_SPREAD for group in groups):  # noqa: PLR2004 - a pair
        return False
    from scipy.stats import levene  # noqa: PLC0415 - heavy

    # Without any scatter it is undefined: spreads are then equal.
    with np.errstate(divide="ignore", invalid="ignore"):
        return bool(levene(*groups, center="median").pvalue <= LEVEL)


def compare_means(
    groups: Sequence[Floats], pairs: Sequence[tuple[int, int]], *, tests: int = 0, unit: str = "runs"
) -> MeansTest:
    """Compare the means of groups pair by pair, with a familywise error of 5 %.

    One method serves all pairs. Where spreads between units differ it is Games-Howell; where every pair has
    enough units to be significant beside the others, exact permutation of whole units with Holm's correction;
    else Tukey-Kramer. Sources: Kramer, Biometrics 12 (1956); Games and Howell, Journal of Educational
    Statistics 1 (1976); for permutation see `bound_permuted`.

    Args:
        groups: values of each group (usually logarithms of run medians), each shape (n,), enough
            for `pool_spread`.
        pairs: indices of the groups of each pair, the lower first.
        tests: number of tests that a permutation must be significant beside; of the pairs by default.
        unit: what a value stands for, in the method's words.

    Raises:
        StatisticsError: a value is not finite, or a group is empty.
    """
    values = [check_values(group, what="values of a group") for group in groups]
    spread, freedom = pool_spread(values)
    over = f" over {len(pairs)} pairs" if len(pairs) > 1 else ""
    is_pooled = False
    if do_spreads_differ(values):
        method = f"Games-Howell{over}, spreads between {unit} differ"
        differences = _compare_games_howell(values, pairs)
    elif all(_can_permute(values[i].size, values[j].size, max(tests, len(pairs))) for i, j in pairs):
        method = f"exact permutation of whole {unit}" + f", Holm{over}" * bool(over)
        differences = _compare_permuted(values, pairs)
    else:
        is_pooled = True
        method = f"Tukey-Kramer{over}, spread between {unit} pooled"
        errors = [spread * math.sqrt(1.0 / values[i].size + 1.0 / values[j].size) for i, j in pairs]
        differences = [
            _studentize(float(values[j].mean() - values[i].mean()), error, len(values), freedom)
            for (i, j), error in zip(pairs, errors, strict=True)
        ]
    return MeansTest(method, spread, freedom, tuple(differences), is_pooled)


def _compare_games_howell(groups: Sequence[Floats], pairs: Sequence[tuple[int, int]]) -> list[Difference]:
    differences = []
    for i, j in pairs:
        parts = [float(np.var(groups[k], ddof=1)) / groups[k].size for k in (i, j)]
        freedoms = [groups[k].size - 1 for k in (i, j)]
        error = math.sqrt(sum(parts))
        weight = sum(part**2 / freedom for part, freedom in zip(parts, freedoms, strict=True))
        freedom = sum(parts) ** 2 / weight if weight > 0.0 else float(sum(freedoms))
        difference = float(groups[j].mean() - groups[i].mean())
        differences.append(_studentize(difference, error, len(groups), freedom))
    return differences


_ROUNDING = 1e-12
"""Standard error below this share of a difference is that of the arithmetic: nothing scatters."""


def _studentize(value: float, error: float, groups: int, freedom: float) -> Difference:
    """A difference with its standard error among the differences of so many groups."""
    if value == error == 0.0:
        return Difference(value, Interval(value, value), 1.0, 1.0, 0.0)
    if error <= _ROUNDING * abs(value):
        return Difference(value, None, math.nan, math.nan, math.nan)
    score, alone = abs(value) / error, freedom
    if groups > 2:  # noqa: PLR2004 - a limit of a range takes a tenth of a second: pairs alike share it
        freedom = float(f"{freedom:.2g}")
    half = error * _find_limit(groups, freedom)
    interval = Interval(value - half, value + half)
    return Difference(value, interval, _find_p(score, 2, alone), _find_p(score, groups, freedom), 0.0)


def _find_p(score: float, groups: int, freedom: float) -> float:
    """Probability that the largest difference of so many equal groups is larger, in standard errors.

    The range of means is studentized by the error of one of them, a difference by that over the root of two.
    """
    from scipy.stats import studentized_range, t  # noqa: PLC0415 - heavy

    if groups == 2:  # noqa: PLR2004 - a pair, whose range is Student's t
        return 2.0 * float(t.sf(score, freedom))
    p = float(studentized_range.sf(math.sqrt(2.0) * score, groups, freedom))
    return min(max(p, 0.0), 1.0)


@functools.lru_cache(maxsize=256)
def _find_limit(groups: int, freedom: float) -> float:
    """Difference of equal groups, in standard errors, that the largest exceeds at the significance level."""
    from scipy.stats import studentized_range, t  # noqa: PLC0415 - heavy

    if groups == 2:  # noqa: PLR2004 - as above
        return float(t.isf(0.5 * LEVEL, freedom))
    return float(studentized_range.isf(LEVEL, groups, freedom)) / math.sqrt(2.0)


def _can_permute(first: int, second: int, tests: int) -> bool:
    """Whether a permutation of so many units can be significant, and all of its labellings be counted."""
    is_countable = math.comb(first + second, first) <= MOST_LABELLINGS
    return smallest_p(first, second) * tests <= LEVEL and is_countable


def _compare_permuted(groups: Sequence[Floats], pairs: Sequence[tuple[int, int]]) -> list[Difference]:
    own = [permute_means(groups[i], groups[j]) for i, j in pairs]
    differences = []
    for (i, j), p, adjusted in zip(pairs, own, adjust_holm(own).tolist(), strict=True):
        ends = bound_permuted(groups[i], groups[j])
        value = float(groups[j].mean() - groups[i].mean())
        least = smallest_p(groups[i].size, groups[j].size)
        differences.append(Difference(value, None if ends is None else Interval(*ends), p, adjusted, least))
    return differences


def bound_levels(groups: Sequence[Floats]) -> list[Interval | None]:
    """95 % interval of the typical value of each group, by the spread between its runs.

    Slip is positive and varies between runs by a factor, so the interval is one of the mean logarithm; of the
    mean itself if a value is not positive. The spread is pooled over the groups, or each group's own where
    spreads differ.

    Args:
        groups: values of the runs of each group, each shape (n,), n >= 1.

    Returns:
        None where no spread between runs is known.

    Raises:
        StatisticsError: a group is empty, or a value is not finite.
    """
    units, positive = take_logarithms([check_values(group, what="values of a group") for group in groups])
    own = do_spreads_differ(units)
    pooled = pool_spread(units)
    intervals: list[Interval | None] = []
    for group in units:
        spread, freedom = pool_spread([group]) if own else pooled
        if freedom < 1:
            intervals.append(None)
            continue
        half = student_quantile(CONFIDENCE, freedom) * spread / math.sqrt(group.size)
        centre = float(group.mean())
        low, high = (exponentiate(end) if positive else end for end in (centre - half, centre + half))
        intervals.append(Interval(low, high))
    return intervals


_LARGEST_LOG = 700.0
"""Largest logarithm whose exponential is a double."""


def exponentiate(value: float) -> float:
    """The exponential; of what has none, the largest or smallest that a double holds."""
    return math.exp(min(max(value, -_LARGEST_LOG), _LARGEST_LOG))


def take_logarithms(groups: Sequence[Floats]) -> tuple[list[Floats], bool]:
    """Logarithms of the values if all are positive, and whether they are; slip varies by factors."""
    positive = all(bool(np.all(group > 0.0)) for group in groups)
    return [np.log(group) if positive else group for group in groups], positive
