"""Single statistics against textbooks, scipy, and brute force."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from pipeline.datasets.pairs import Group, Samples, bound_run, compare_groups
from pipeline.datasets.rank_tests import (
    StatisticsError,
    adjust_holm,
    bound_permuted,
    cliffs_delta,
    kendall_p,
    kendall_tau,
    mann_whitney,
    permute_means,
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
    values = np.array(a + b)
    observed = abs(np.mean(b) - np.mean(a))
    found = []
    for chosen in itertools.combinations(range(values.size), len(a)):
        inside = np.zeros(values.size, dtype=bool)
        inside[list(chosen)] = True
        found.append(abs(values[~inside].mean() - values[inside].mean()))
    assert len(found) == math.comb(values.size, len(a))
    assert permute_means(a, b) == pytest.approx(np.mean(np.array(found) >= observed - 1e-7), abs=1e-9)


def test_the_smallest_p_is_reached_by_sides_that_do_not_overlap() -> None:
    for n, m, p in ((3, 3, 0.10), (4, 4, 2 / 70), (5, 5, 2 / 252), (1, 3, 0.25), (1, 1, 1.0)):
        low, high = np.arange(n) * 0.01, 10.0 + np.arange(m) * 0.01
        assert smallest_p(n, m) == pytest.approx(p)
        assert permute_means(low, high) == pytest.approx(p)


def test_equal_sides_are_never_different() -> None:
    assert permute_means([1.0, 1.0], [1.0, 1.0]) == 1.0
    assert mann_whitney([1.0] * 9, [1.0] * 9) == 1.0


def test_holm_is_the_textbook_correction() -> None:
    assert adjust_holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert adjust_holm([0.9, 0.8]) == pytest.approx([1.0, 1.0])
    assert adjust_holm([]).size == 0


@given(st.integers(0, 10_000), st.integers(1, 7), st.integers(1, 7))
@settings(max_examples=60, deadline=None)
def test_the_interval_excludes_zero_exactly_where_the_test_does(seed: int, first: int, second: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.lognormal(0.0, 0.5, first), rng.lognormal(rng.uniform(0.0, 1.5), 0.5, second)
    if seed % 3 == 0:
        a, b = np.round(a) + 1.0, np.round(b) + 1.0
    bounds = bound_permuted(a, b)
    if smallest_p(first, second) > 0.05:
        assert bounds is None
    else:
        assert bounds is not None
        assert (not bounds[0] <= 0.0 <= bounds[1]) == (permute_means(a, b) <= 0.05)


def test_the_bounds_are_where_the_test_begins_to_reject() -> None:
    rng = np.random.default_rng(3)
    a, b = rng.normal(0.0, 1.0, 6), rng.normal(1.0, 2.0, 5)
    bounds = bound_permuted(a, b)
    assert bounds is not None
    for end, outward in zip(bounds, (-1e-6, 1e-6), strict=True):
        assert permute_means(a, b - end + outward) > 0.05
        assert permute_means(a, b - end - outward) <= 0.05
    there, back = bound_permuted(a, b), bound_permuted(b, a)
    assert there is not None
    assert back is not None
    assert there[0] == pytest.approx(-back[1])


def test_a_run_stands_as_parts_of_one_length_evenly_over_it() -> None:
    values = np.repeat(np.arange(1.0, 9.0), 50)
    assert Samples(values, 400.0).cut(50.0).tolist() == list(range(1, 9))
    assert Samples(values, 400.0).cut(10.0).tolist() == list(range(1, 9)), (
        "eight at most, from all of the run"
    )
    assert Samples(values, 40.0).cut(10.0).size == 4
    assert Samples(values, 9.0).cut(10.0).tolist() == [4.5]
    assert Samples(values[:3], 400.0).cut(50.0).size == 3
    assert bound_run(Samples(values, 29.0)) is None, "two parts do not determine a spread"


def single(name: str, seconds: float, median: float = 1.0) -> Group:
    rng = np.random.default_rng(round(seconds))
    values = rng.lognormal(math.log(median), 0.1, round(20 * seconds))
    return Group.of_runs(name, [Samples(values, seconds)])


@pytest.mark.parametrize("seconds", [1.0, 8.0, 29.0])
def test_runs_without_three_parts_are_not_tested(seconds: float) -> None:
    pairs = compare_groups([single("a", seconds), single("b", 600.0), single("c", 600.0, 2.0)])
    short, other, long = pairs
    for pair in (short, other):
        assert pair.p is None
        assert pair.ratio is not None
        assert "which takes 3 stretches of 10 s of each" in pair.note
    (alone,) = compare_groups([single("b", 600.0), single("c", 600.0, 2.0)])
    assert long.p == alone.p
    assert long.p is not None
    assert long.p < 0.01


def test_groups_that_do_not_scatter_are_not_tested() -> None:
    (pair,) = compare_groups([Group("a", np.full(3, 0.3)), Group("b", np.full(1, 0.7))])
    assert pair.p is None
    assert pair.low is None
    assert pair.ratio == pytest.approx(7.0 / 3.0)
    assert "no test" in pair.note


def test_mann_whitney_is_scipys() -> None:
    rng = np.random.default_rng(2)
    a, b = rng.integers(0, 12, 60).astype(float), rng.integers(2, 14, 45).astype(float)
    wanted = stats.mannwhitneyu(a, b, alternative="two-sided", method="asymptotic").pvalue
    assert mann_whitney(a, b) == pytest.approx(wanted, rel=1e-9)


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
        lambda: bound_run(Samples(np.array([1.0, math.inf]), 100.0)),
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
