"""Grounds compared by the means of their runs, with a spread between runs that all grounds share.

A run is the unit. Grounds of one vehicle differ in their means, and runs of one ground scatter about it. That
scatter is pooled over the grounds, so that a ground with a single run can be compared, too. Values that are
not known alike (levels of runs that drove little) are weighed by how well they are known.
"""

import functools
import math
from collections.abc import Mapping, Sequence
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
        spread: standard deviation between runs of a group, pooled, in the unit of the values; of a run that
            is known as well as the median one, where their errors are known.
        freedom: its degrees of freedom.
        differences: one a pair, in the order of the pairs.
        is_pooled: whether the tests take the pooled spread.
    """

    method: str
    spread: float
    freedom: int
    differences: tuple[Difference, ...]
    is_pooled: bool = False


@dataclass(frozen=True)
class Errors:
    """How well values are known that were made of measurements, beside how much runs differ.

    Attributes:
        shape: covariance of the values over the variance of a measurement, shape (n, n).
        squares: sum of the squared residuals of the measurements.
        freedom: its degrees of freedom.
    """

    shape: Floats
    squares: float
    freedom: int

    @property
    def variance(self) -> float:
        """Variance of a measurement; zero where it cannot be told from that between runs."""
        return self.squares / self.freedom if self.freedom else 0.0


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
    groups: Sequence[Floats],
    pairs: Sequence[tuple[int, int]],
    *,
    tests: int = 0,
    unit: str = "runs",
    errors: Errors | None = None,
) -> MeansTest:
    """Compare the means of groups pair by pair, with a familywise error of 5 %.

    One method serves all pairs. Where spreads between units differ it is Games-Howell; where every pair has
    enough units to be significant beside the others, exact permutation of whole units with Holm's correction;
    else Tukey-Kramer. Where errors of the values are known and spreads do not differ, it is the like of
    Tukey-Kramer for weighed means (`Weighed.compare`). Sources: Kramer, Biometrics 12 (1956); Games and
    Howell, Journal of Educational Statistics 1 (1976); for permutation see `bound_permuted`.

    Args:
        groups: values of each group (usually logarithms of run medians), each shape (n,), enough
            for `pool_spread`.
        pairs: indices of the groups of each pair, the lower first.
        tests: number of tests that a permutation must be significant beside; of the pairs by default.
        unit: what a value stands for, in the method's words.
        errors: of the values of all groups, one group after the other.

    Raises:
        StatisticsError: a value is not finite, or a group is empty.
    """
    values = [check_values(group, what="values of a group") for group in groups]
    spread, freedom = pool_spread(values)
    over = f" over {len(pairs)} pairs" if len(pairs) > 1 else ""
    is_pooled = False
    if weighed := weigh_means(values, errors):
        method = f"weighed means{over}, spread between {unit} pooled, errors by cells"
        return MeansTest(method, weighed.spread, freedom, weighed.compare(pairs), is_pooled=True)
    if do_spreads_differ(values):
        method = f"Games-Howell{over}, spreads between {unit} differ"
        differences = _compare_games_howell(values, pairs)
    elif all(_can_permute(values[i].size, values[j].size, max(tests, len(pairs))) for i, j in pairs):
        method = f"exact permutation of whole {unit}" + f", Holm{over}" * bool(over)
        differences = _compare_permuted(values, pairs)
    else:
        is_pooled = True
        method = f"Tukey-Kramer{over}, spread between {unit} pooled"
        halves = [spread * math.sqrt(1.0 / values[i].size + 1.0 / values[j].size) for i, j in pairs]
        differences = [
            _studentize(float(values[j].mean() - values[i].mean()), error, len(values), freedom)
            for (i, j), error in zip(pairs, halves, strict=True)
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

_DRAWS = 10_000
"""Draws of a test: the limit of 5 % is then known to 1 %, and a p of 0.05 to 0.002."""
_CHUNK = 1000
"""Draws at once: those of a hundred groups take 40 MB."""
_HALVINGS = 50
"""Halvings of the range of a variance, to a double's precision."""


@dataclass(frozen=True)
class Weighed:
    """Means of groups of values that are not known alike.

    The covariance of the values is ``between * I + variance * shape``: how runs differ, and the errors of
    their values. Both variances are estimated, and the tests draw both from what the values and the
    measurements say of them (a sum of squares over its variance is chi-square): generalized inference,
    Weerahandi, Journal of the American Statistical Association 88 (1993). Without errors it is Tukey-Kramer.

    Attributes:
        errors: of the values.
        squares: squared differences within groups, made independent of each other, shape (d,).
        shares: their variances over that of a measurement, shape (d,).
        between: variance between runs of a group.
        weights: weights of the values in the means, shape (groups, values).
        means: means of the groups, shape (groups,).
    """

    errors: Errors
    squares: Floats
    shares: Floats
    between: float
    weights: Floats
    means: Floats

    @property
    def spread(self) -> float:
        """Standard deviation between runs of a group that are known as well as the median one."""
        usual = float(np.median(np.diag(self.errors.shape)))
        return math.sqrt(self.between + self.errors.variance * usual)

    def bound(self) -> list[Interval]:
        """Interval of the mean of each group."""
        halves = student_quantile(CONFIDENCE, self.shares.size) * self._find_error(self.weights)
        return [Interval(*ends) for ends in np.stack([self.means - halves, self.means + halves], 1).tolist()]

    def compare(self, pairs: Sequence[tuple[int, int]]) -> tuple[Difference, ...]:
        """Differences of pairs, with intervals and p over all of them."""
        contrasts = np.stack([self.weights[j] - self.weights[i] for i, j in pairs])
        values = np.array([self.means[j] - self.means[i] for i, j in pairs])
        error = self._find_error(contrasts)
        scores = np.abs(values) / error
        rng = np.random.default_rng(0)
        axes = np.linalg.eigh(self.errors.shape)
        root = axes.eigenvectors * np.sqrt(axes.eigenvalues.clip(0.0))
        largest, alone = np.empty(0), np.zeros(len(pairs))
        for _ in range(_DRAWS // _CHUNK):
            variance = self.errors.squares / rng.chisquare(self.errors.freedom, _CHUNK)
            squares = rng.chisquare(self.shares.size, _CHUNK)
            between = _solve_between(self.squares, self.shares, variance, squares)
            runs, errors = rng.standard_normal((2, _CHUNK, root.shape[0]))
            drawn = np.sqrt(between)[:, None] * runs + np.sqrt(variance)[:, None] * (errors @ root.T)
            sizes = np.abs(drawn @ contrasts.T) / error
            largest = np.append(largest, sizes.max(axis=1))
            alone += np.count_nonzero(sizes >= scores, axis=0)
        halves = float(np.quantile(largest, CONFIDENCE)) * error
        together = np.count_nonzero(largest[:, None] >= scores, axis=0)
        own, adjusted = ((1.0 + counts) / (1.0 + _DRAWS) for counts in (alone, together))
        return tuple(
            Difference(value, Interval(value - half, value + half), p, corrected, 0.0)
            for value, half, p, corrected in zip(
                *(one.tolist() for one in (values, halves, own, adjusted)), strict=True
            )
        )

    def _find_error(self, of: Floats) -> Floats:
        """Standard errors of sums of values with these weights, shape (sums, values)."""
        covariance = self.between * np.eye(of.shape[1]) + self.errors.variance * self.errors.shape
        errors: Floats = np.sqrt(np.sum(of @ covariance * of, axis=1))
        return errors


def weigh_means(groups: Sequence[Floats], errors: Errors | None) -> Weighed | None:
    """Means of groups of values whose errors are known.

    Args:
        groups: values of each group, each shape (n,).
        errors: of all values, one group after the other.

    Returns:
        None without errors, without a spread between runs, and where spreads differ from group to group.
    """
    freedom = pool_spread(groups)[1]
    if errors is None or not freedom or math.sqrt(errors.variance) <= _ROUNDING or do_spreads_differ(groups):
        return None
    values = np.concatenate(groups)
    members = np.repeat(np.eye(len(groups)), [group.size for group in groups], axis=0)
    within = np.linalg.svd(members)[0][:, len(groups) :]
    axes = np.linalg.eigh(within.T @ errors.shape @ within)
    shares: Floats = axes.eigenvalues.clip(0.0)
    squares: Floats = (axes.eigenvectors.T @ within.T @ values) ** 2
    variance, target = np.array([errors.variance]), np.array([float(freedom)])
    between = float(_solve_between(squares, shares, variance, target)[0])
    inverse = np.linalg.inv(between * np.eye(values.size) + errors.variance * errors.shape)
    weights = np.asarray(np.linalg.solve(members.T @ inverse @ members, members.T @ inverse), np.float64)
    return Weighed(errors, squares, shares, between, weights, weights @ values)


def _solve_between(squares: Floats, shares: Floats, variance: Floats, sums: Floats) -> Floats:
    """Variances between runs with which squares over their variances have these sums; at least none.

    Args:
        squares: squared differences, shape (d,).
        shares: what a measurement's variance is multiplied by in theirs, shape (d,).
        variance: variances of a measurement, shape (n,).
        sums: sums, shape (n,).
    """
    errors = np.multiply.outer(variance, shares)
    low, high = np.zeros(sums.size), squares.sum() / sums
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        is_low = (squares / (middle[:, None] + errors)).sum(axis=1) > sums
        low, high = np.where(is_low, middle, low), np.where(is_low, high, middle)
    return low


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


def foresee_significant(
    differences: Sequence[tuple[str, str, float]], counts: Mapping[str, int], spread: float, freedom: int
) -> list[tuple[str, str]]:
    """Pairs that Tukey-Kramer finds with so many runs, if differences and spread stay as they are.

    Args:
        differences: names of the groups of each pair, and their difference.
        counts: runs of each group.
        spread: standard deviation between runs of a group.
        freedom: its degrees of freedom.
    """
    limit = _find_limit(len(counts), freedom) * spread
    return [
        (a, b)
        for a, b, one in differences
        if abs(one) > limit * math.hypot(*(counts[k] ** -0.5 for k in (a, b)))
    ]


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


def level_groups(groups: Sequence[Floats], errors: Errors) -> list[tuple[float, Interval | None]]:
    """Geometric means of groups of positive levels, as `compare_means` weighs them, with their intervals.

    Args:
        groups: levels of each group, each shape (n,), n >= 1.
        errors: of the logarithms of all levels, one group after the other.
    """
    logarithms = [np.log(group) for group in groups]
    if (weighed := weigh_means(logarithms, errors)) is None:
        means = [exponentiate(float(group.mean())) for group in logarithms]
        return list(zip(means, bound_levels(groups), strict=True))
    return [
        (exponentiate(mean), Interval(exponentiate(one.low), exponentiate(one.high)))
        for mean, one in zip(weighed.means.tolist(), weighed.bound(), strict=True)
    ]


_LARGEST_LOG = 700.0
"""Largest logarithm whose exponential is a double."""


def exponentiate(value: float) -> float:
    """The exponential; of what has none, the largest or smallest that a double holds."""
    return math.exp(min(max(value, -_LARGEST_LOG), _LARGEST_LOG))


def take_logarithms(groups: Sequence[Floats]) -> tuple[list[Floats], bool]:
    """Logarithms of the values if all are positive, and whether they are; slip varies by factors."""
    positive = all(bool(np.all(group > 0.0)) for group in groups)
    return [np.log(group) if positive else group for group in groups], positive
