"""Single statistics against textbooks, scipy, and brute force."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from pipeline.datasets.confidence import (
    bootstrap_median,
    compare_blocks,
    integrated_time,
    number_blocks,
)
from pipeline.datasets.rank_tests import (
    StatisticsError,
    adjust_holm,
    adjust_max_t,
    bound_permuted,
    cliffs_delta,
    kendall_p,
    kendall_tau,
    mann_whitney,
    permute_means,
    permute_studentized,
    shift_between,
    smallest_p,
)
from pipeline.datasets.steps import find_changes

NUMBERS = st.floats(-100.0, 100.0, allow_nan=False).map(lambda value: round(value, 3))
SIDE = st.lists(NUMBERS, min_size=1, max_size=5)


@given(SIDE, SIDE)
@settings(max_examples=60, deadline=None)
def test_the_shift_and_delta_are_those_of_all_pairs(a: list[float], b: list[float]) -> None:
    pairs = [y - x for x in a for y in b]
    assert shift_between(a, b) == pytest.approx(float(np.median(pairs)), abs=1e-12)
    above, below = sum(p > 0 for p in pairs), sum(p < 0 for p in pairs)
    assert cliffs_delta(a, b) == pytest.approx((above - below) / len(pairs))
    assert cliffs_delta(a, b) == -cliffs_delta(b, a)


@given(SIDE, SIDE)
@settings(max_examples=60, deadline=None)
def test_the_exact_permutation_counts_every_labelling(a: list[float], b: list[float]) -> None:
    test = permute_means(a, b)
    values = np.array(a + b)
    observed = abs(np.mean(b) - np.mean(a))
    found = []
    for chosen in itertools.combinations(range(values.size), len(a)):
        inside = np.zeros(values.size, dtype=bool)
        inside[list(chosen)] = True
        found.append(abs(values[~inside].mean() - values[inside].mean()))
    assert test.exact
    assert test.arrangements == math.comb(values.size, len(a))
    assert test.p == pytest.approx(np.mean(np.array(found) >= observed - 1e-7), abs=1e-9)
    assert test.p >= 1.0 / test.arrangements


def test_the_smallest_p_is_reached_by_sides_that_do_not_overlap() -> None:
    for n, m, p in ((3, 3, 0.10), (4, 4, 2 / 70), (5, 5, 2 / 252), (1, 3, 0.25), (1, 1, 1.0)):
        low, high = np.arange(n) * 0.01, 10.0 + np.arange(m) * 0.01
        assert smallest_p(n, m) == pytest.approx(p)
        assert permute_means(low, high).p == pytest.approx(p)


def test_many_units_are_relabelled_at_random_and_never_give_zero() -> None:
    a, b = np.zeros(30) + np.arange(30) * 1e-3, np.ones(30)
    for permute in (permute_means, permute_studentized):
        test = permute(a, b)
        assert not test.exact
        assert test.p == test.smallest_p == 1 / 10_000


def test_equal_sides_are_never_different() -> None:
    assert permute_means([1.0, 1.0], [1.0, 1.0]).p == 1.0
    assert permute_studentized([2.0] * 20, [2.0] * 20).p == 1.0
    assert mann_whitney([1.0] * 9, [1.0] * 9) == 1.0


def test_holm_is_the_textbook_correction() -> None:
    assert adjust_holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert adjust_holm([0.9, 0.8]) == pytest.approx([1.0, 1.0])
    assert adjust_holm([]).size == 0


def test_max_t_keeps_the_p_of_a_large_difference_where_holm_loses_it() -> None:
    rng = np.random.default_rng(1)
    groups = [rng.normal(level, 0.05, 4) for level in (0.0, 0.0, 3.0)]
    corrected = adjust_max_t(groups)
    plain = [permute_means(groups[i], groups[j]).p for i, j in ((0, 1), (0, 2), (1, 2))]
    assert corrected[0, 2] == pytest.approx(2 / 70)
    assert corrected[1, 2] == pytest.approx(2 / 70)
    assert corrected[0, 1] > 0.05
    assert adjust_holm(plain)[1] > 0.05


def test_closed_testing_of_four_groups_is_that_of_all_hypotheses_one_by_one() -> None:
    """Every hypothesis that holds a pair is enumerated here on its own, with the labels of all its sets."""
    rng = np.random.default_rng(4)
    kinds = ((0.0, 3.0), (0.5, 3.0), (10.0, 1.0), (12.0, 1.0))
    groups = [rng.normal(level, spread, 4) for level, spread in kinds]
    expected = np.zeros((4, 4))
    for partition in ([[0, 1]], [[2, 3]], [[0, 1], [2, 3]]):
        nulls = []
        for chosen in partition:
            units = np.concatenate([groups[i] for i in chosen])
            rows = [list(row) for row in itertools.combinations(range(8), 4)]
            means = np.array([units[row].mean() for row in rows])
            nulls.append(np.abs(2.0 * means - 2.0 * units.mean()) * math.sqrt(2.0))
        observed = max(null[0] for null in nulls)
        both = np.array([max(pair) for pair in itertools.product(*nulls)])
        p = float(np.mean(both >= observed - 1e-9))
        for i, j in partition:
            expected[i, j] = max(expected[i, j], p)
    corrected = adjust_max_t(groups, [(0, 1), (2, 3)])
    assert corrected[0, 1] == pytest.approx(expected[0, 1])
    assert corrected[2, 3] == pytest.approx(expected[2, 3])
    assert expected[2, 3] > permute_means(groups[2], groups[3]).p, "both sets of equal groups decide together"


def test_all_six_pairs_of_four_groups_hold_what_their_partitions_say() -> None:
    rng = np.random.default_rng(12)
    groups = [rng.normal(level, 1.0, 4) for level in (0.0, 2.0, 20.0, 22.0)]
    corrected = adjust_max_t(groups, draws=499)
    apart = adjust_max_t(groups, [(0, 1), (2, 3)])
    assert corrected[0, 1] >= apart[0, 1] - 1e-9
    assert corrected[2, 3] >= apart[2, 3] - 1e-9
    assert max(corrected[0, 2], corrected[1, 3]) <= 0.05


@given(st.integers(0, 10_000), st.integers(1, 7), st.integers(1, 7))
@settings(max_examples=60, deadline=None)
def test_the_interval_excludes_zero_exactly_where_the_test_does(seed: int, first: int, second: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.lognormal(0.0, 0.5, first), rng.lognormal(rng.uniform(0.0, 1.5), 0.5, second)
    if seed % 3 == 0:
        a, b = np.round(a) + 1.0, np.round(b) + 1.0
    blocks, of_blocks = compare_blocks(a, b, draws=499)
    ends = None if blocks.interval is None else (blocks.interval.low, blocks.interval.high)
    for bounds, test in ((bound_permuted(a, b), permute_means(a, b)), (ends, of_blocks)):
        if test.smallest_p > 0.05:
            assert bounds is None
        else:
            assert bounds is not None
            assert (not bounds[0] <= 0.0 <= bounds[1]) == (test.p <= 0.05)


def test_the_bounds_are_where_the_test_begins_to_reject() -> None:
    rng = np.random.default_rng(3)
    a, b = rng.normal(0.0, 1.0, 6), rng.normal(1.0, 2.0, 5)
    blocks = rng.normal(0.0, 1.0, 25), rng.normal(0.5, 3.0, 12)
    for sides, studentized, permute in (((a, b), False, permute_means), (blocks, True, permute_studentized)):
        bounds = bound_permuted(*sides, studentized=studentized)
        assert bounds is not None
        for end, outward in zip(bounds, (-1e-6, 1e-6), strict=True):
            assert permute(sides[0], sides[1] - end + outward).p > 0.05
            assert permute(sides[0], sides[1] - end - outward).p <= 0.05
    there, back = bound_permuted(a, b), bound_permuted(b, a)
    assert there is not None
    assert back is not None
    assert there[0] == pytest.approx(-back[1])


def test_both_ends_of_the_interval_of_a_run_are_widened_for_few_blocks() -> None:
    rng = np.random.default_rng(5)
    levels = np.array([-1.5, -0.5, 0.5, 1.5])
    offsets = rng.normal(0.0, 1.0, 500)
    values = np.concatenate([level + side * offsets for level in levels for side in (-1.0, 1.0)])
    blocks = np.repeat(np.arange(4), 1_000)
    found = bootstrap_median(values, blocks, draws=4_000)
    drawn = rng.integers(4, size=(4_000, 4))
    medians = [np.median(values.reshape(4, -1)[row]) for row in drawn]
    low, high = np.quantile(medians, (0.025, 0.975))
    # Student's t of three degrees of freedom over the normal quantile, and the deviation of four for three.
    widened = 3.182 / 1.960 * math.sqrt(4 / 3)
    assert found.low == pytest.approx(widened * low, rel=0.1)
    assert found.high == pytest.approx(widened * high, rel=0.1)


@given(st.lists(st.lists(NUMBERS, min_size=1, max_size=3), min_size=2, max_size=3))
@settings(max_examples=25, deadline=None)
def test_corrected_p_is_never_below_the_pairs_own(groups: list[list[float]]) -> None:
    corrected = adjust_max_t(groups)
    assert np.array_equal(corrected, corrected.T)
    for i, j in itertools.combinations(range(len(groups)), 2):
        assert corrected[i, j] >= permute_means(groups[i], groups[j]).p - 1e-9


def test_mann_whitney_is_scipys() -> None:
    rng = np.random.default_rng(2)
    a, b = rng.integers(0, 12, 60).astype(float), rng.integers(2, 14, 45).astype(float)
    wanted = stats.mannwhitneyu(a, b, alternative="two-sided", method="asymptotic").pvalue
    assert mann_whitney(a, b) == pytest.approx(wanted, rel=1e-9)


def test_the_integrated_time_of_a_known_process_comes_back() -> None:
    rng = np.random.default_rng(3)
    rho, count = 0.95, 200_000
    values = np.zeros(count)
    noise = rng.standard_normal(count)
    for i in range(1, count):
        values[i] = rho * values[i - 1] + noise[i]
    true = 1.0 + 2.0 * rho / (1.0 - rho)
    ticks = np.arange(count)
    assert integrated_time(values, ticks) == pytest.approx(true, rel=0.1)
    kept = (ticks % 120) < 100
    assert integrated_time(values[kept], ticks[kept]) == pytest.approx(true, rel=0.1)


@given(
    st.lists(st.integers(1, 60), min_size=1, max_size=6),
    st.floats(1.0, 50.0),
)
@settings(max_examples=60, deadline=None)
def test_no_block_crosses_a_piece_or_is_shorter_than_it_must(sizes: list[int], length: float) -> None:
    ticks = np.concatenate([np.arange(size) + 1_000 * i for i, size in enumerate(sizes)])
    pieces = np.repeat(np.arange(len(sizes)), sizes)
    blocks = number_blocks(ticks, pieces, length)
    assert sorted(set(blocks.tolist())) == list(range(blocks.max() + 1))
    for number in range(blocks.max() + 1):
        inside = blocks == number
        assert len(set(pieces[inside].tolist())) == 1
        size = sizes[pieces[inside][0]]
        assert inside.sum() >= min(math.floor(length), size)
        assert inside.sum() < 2 * length + 1 or size < length


def test_a_step_in_a_series_is_found_where_it_is() -> None:
    rng = np.random.default_rng(5)
    series = np.concatenate((rng.normal(1.8, 0.03, 12), rng.normal(2.1, 0.03, 9)))
    (change,) = find_changes(series)
    assert change.index == 12
    assert change.before == pytest.approx(1.8, abs=0.03)
    assert change.after == pytest.approx(2.1, abs=0.03)
    assert find_changes(series[:5]) == ()
    assert find_changes(np.ones(30)) == ()


@pytest.mark.parametrize(
    "ask",
    [
        lambda: permute_means([1.0, math.nan], [1.0]),
        lambda: shift_between([], [1.0]),
        lambda: bootstrap_median([1.0, math.inf], [0, 0]),
        lambda: find_changes([1.0, math.nan]),
    ],
)
def test_what_no_statistic_can_be_made_of_is_refused(ask) -> None:  # noqa: ANN001
    with pytest.raises(StatisticsError) as caught:
        ask()
    assert caught.value.code in ("not_finite", "too_few_values")


@pytest.mark.parametrize("count", [2, 4, 6])
def test_kendall_p_counts_all_orders(count: int) -> None:
    taus = [kendall_tau(np.arange(count), order) for order in itertools.permutations(range(count))]
    for tau in set(taus):
        p, smallest = kendall_p(tau, count)
        assert p == pytest.approx(np.mean(np.abs(taus) >= abs(tau) - 1e-9))
        assert smallest == pytest.approx(2 / len(taus))
