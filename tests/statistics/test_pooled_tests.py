"""Tests of means with a pooled spread, against scipy and by hand."""

import math
from itertools import combinations

import numpy as np
import pytest
from scipy import stats

from pipeline.datasets.pooled_tests import bound_levels, compare_means, do_spreads_differ
from pipeline.datasets.rank_tests import StatisticsError, adjust_holm, bound_permuted, permute_means

PAIRS = list(combinations(range(3), 2))


def draw(*sizes: int, spreads: tuple[float, ...] = (0.3, 0.3, 0.3)) -> list[np.ndarray]:
    rng = np.random.default_rng(sum(sizes))
    return [rng.normal(0.2 * i, spreads[i], size) for i, size in enumerate(sizes)]


@pytest.mark.parametrize("sizes", [(3, 3, 3), (2, 5, 3), (3, 9, 2)])
def test_tukey_kramer_is_scipys(sizes: tuple[int, ...]) -> None:
    groups = draw(*sizes)
    assert not do_spreads_differ(groups)
    found, wanted = compare_means(groups, PAIRS), stats.tukey_hsd(*groups)
    ends = wanted.confidence_interval()
    assert found.method == "Tukey-Kramer over 3 pairs, spread between runs pooled"
    for (i, j), one in zip(PAIRS, found.differences, strict=True):
        assert one.value == pytest.approx(wanted.statistic[j, i])
        assert one.p_adjusted == pytest.approx(wanted.pvalue[j, i], abs=1e-6)
        assert one.interval is not None
        assert one.interval.low == pytest.approx(ends.low[j, i], abs=1e-6)
        assert one.interval.high == pytest.approx(ends.high[j, i], abs=1e-6)


def test_the_p_of_one_pair_is_that_of_students_t() -> None:
    a, b, _ = draw(3, 2, 3)
    (found,) = compare_means([a, b], [(0, 1)]).differences
    wanted = stats.ttest_ind(a, b).pvalue
    assert found.p == pytest.approx(wanted, abs=1e-6)
    assert found.p_adjusted == pytest.approx(wanted, abs=1e-6)


def test_a_single_run_is_tested_by_the_spread_of_the_others() -> None:
    groups = [np.array([0.0, 0.2]), np.array([0.1, 0.3]), np.array([2.0])]
    found = compare_means(groups, PAIRS)
    assert found.freedom == 2
    assert found.spread == pytest.approx(math.sqrt(0.04 / 2))
    range_of_means = math.sqrt(2.0) * 1.9 / (found.spread * math.sqrt(1.0 + 0.5))
    wanted = stats.studentized_range.sf(range_of_means, 3, 2)
    assert found.differences[1].p_adjusted == pytest.approx(wanted, abs=1e-9)


def test_where_spreads_differ_games_howell_is_scipys_welch_for_one_pair() -> None:
    groups = draw(9, 9, spreads=(0.05, 1.0, 0.0))
    assert do_spreads_differ(groups)
    found = compare_means(groups, [(0, 1)])
    assert found.method.startswith("Games-Howell")
    wanted = stats.ttest_ind(*groups, equal_var=False).pvalue
    assert found.differences[0].p_adjusted == pytest.approx(wanted, abs=1e-6)


def test_where_every_pair_has_enough_runs_whole_runs_are_permuted() -> None:
    groups = draw(5, 5, 6)
    found = compare_means(groups, PAIRS)
    assert found.method == "exact permutation of whole runs, Holm over 3 pairs"
    own = [permute_means(groups[i], groups[j]) for i, j in PAIRS]
    assert [one.p for one in found.differences] == own
    assert [one.p_adjusted for one in found.differences] == pytest.approx(adjust_holm(own))
    ends = found.differences[0].interval
    assert ends is not None
    assert (ends.low, ends.high) == bound_permuted(groups[0], groups[1])


def test_runs_that_are_enough_for_one_pair_are_not_permuted_beside_others() -> None:
    groups = draw(4, 4, 4)
    assert compare_means(groups[:2], [(0, 1)]).method.startswith("exact permutation")
    assert compare_means(groups, PAIRS).method.startswith("Tukey-Kramer")
    assert compare_means(groups[:2], [(0, 1)], tests=3).method.startswith("Tukey-Kramer")


def test_intervals_of_many_groups_exclude_zero_exactly_where_their_p_is_below_5_percent() -> None:
    rng = np.random.default_rng(3)
    groups = [rng.normal(0.1 * i, 0.05 * (1 + i % 4), 5) for i in range(6)]
    groups[5] = rng.normal(0.5, 3.0, 5)
    found = compare_means(groups, list(combinations(range(6), 2)))
    assert found.method.startswith("Games-Howell")
    assert len({one.p_adjusted <= 0.05 for one in found.differences}) == 2
    for one in found.differences:
        assert one.interval is not None
        assert (not one.interval.low <= 0.0 <= one.interval.high) == (one.p_adjusted <= 0.05)


@pytest.mark.parametrize("level", [1.0, 0.3])
def test_runs_without_any_scatter_are_equal_or_not_tested(level: float) -> None:
    (equal,) = compare_means([np.full(2, level), np.full(2, level)], [(0, 1)]).differences
    assert equal.p == 1.0
    (other,) = compare_means([np.full(3, level), np.full(1, 2.0 * level)], [(0, 1)]).differences
    assert other.value == pytest.approx(level)
    assert math.isnan(other.p)
    assert math.isnan(other.p_adjusted)
    assert other.interval is None
    assert not do_spreads_differ([np.ones(4), 2.0 * np.ones(4)])


def test_intervals_of_levels_pool_the_spread_and_are_scipys_for_one_group() -> None:
    values = np.array([1.1, 0.9, 1.4, 1.2])
    low, high = stats.t.interval(0.95, 3, loc=values.mean(), scale=stats.sem(values))
    (typical,) = bound_levels([np.exp(values)])
    assert typical is not None
    assert (typical.low, typical.high) == pytest.approx((math.exp(low), math.exp(high)))
    (mean,) = bound_levels([values - 1.0])
    assert mean is not None
    assert (mean.low, mean.high) == pytest.approx((low - 1.0, high - 1.0)), "not all are positive"
    first, single = bound_levels([np.exp(values), np.array([2.0])])
    assert first is not None
    assert single is not None
    assert math.log(single.high / single.low) == pytest.approx(2.0 * math.log(first.high / first.low))
    assert bound_levels([np.ones(2), np.ones(1)]) == [None, None], "two runs do not determine a spread"


def test_what_no_mean_can_be_made_of_is_refused() -> None:
    with pytest.raises(StatisticsError):
        compare_means([np.array([1.0, math.nan]), np.ones(2)], [(0, 1)])
    with pytest.raises(StatisticsError):
        bound_levels([np.zeros(0)])
