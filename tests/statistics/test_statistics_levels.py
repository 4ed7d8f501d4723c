"""Levels of a number over runs: against closed forms, and how often what is said is so."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import f_oneway, t

from pipeline.datasets.levels import split_levels
from pipeline.datasets.rank_tests import StatisticsError

TINY = 1e-6


@given(st.integers(2, 6), st.integers(2, 6), st.floats(0.0, 3.0), st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_of_balanced_runs_the_variances_are_those_of_anova(
    groups: int, runs: int, spread: float, seed: int
) -> None:
    # With estimates that are sure, restricted likelihood is analysis of variance wherever that is positive.
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(groups, 1)) * spread + rng.normal(size=(groups, runs))
    within = values.var(axis=1, ddof=1).mean()
    between = values.mean(axis=1).var(ddof=1) - within / runs
    if between <= 0.0:
        total = values.var(ddof=1)
        within, between = total, 0.0
    labels = [f"g{number}" for number in range(groups) for _ in range(runs)]
    found = split_levels(values.ravel(), np.full(values.size, TINY), labels)
    assert found.value == pytest.approx(values.mean(), abs=1e-6)
    assert found.spread_run**2 == pytest.approx(within, rel=2e-3)
    assert found.spread_group**2 == pytest.approx(between, rel=1e-2, abs=2e-3)
    assert found.freedom == groups * (runs - 1)


def test_the_chance_of_equal_groups_is_that_of_one_way_anova() -> None:
    rng = np.random.default_rng(4)
    values = rng.normal(size=(3, 5)) + np.array([[0.0], [0.5], [1.0]])
    found = split_levels(values.ravel(), np.full(15, TINY), [name for name in "abc" for _ in range(5)])
    assert found.p_groups == pytest.approx(f_oneway(*values).pvalue, rel=1e-3)


def test_one_group_of_sure_runs_has_the_t_interval_of_the_mean() -> None:
    values = np.array([1.0, 1.3, 0.8, 1.1])
    found = split_levels(values, np.full(4, TINY), ["a"] * 4)
    half = t.ppf(0.975, 3) * values.std(ddof=1) / 2.0
    assert found.interval is not None
    assert (found.interval.low, found.interval.high) == pytest.approx((1.05 - half, 1.05 + half), abs=1e-4)
    assert math.isnan(found.spread_group)
    assert math.isnan(found.p_groups)


def test_a_run_that_is_sure_counts_more_than_one_that_is_not() -> None:
    found = split_levels([1.0, 1.01, 0.99, 5.0], [0.01, 0.01, 0.01, 4.0], ["a", "a", "b", "b"])
    assert found.value == pytest.approx(1.0, abs=0.02)
    assert found.p_runs > 0.3
    assert found.chi_square < 1.5


def test_one_run_has_a_value_and_nothing_else() -> None:
    found = split_levels([2.0], [0.1], ["a"])
    assert found.value == pytest.approx(2.0)
    assert found.interval is None
    assert math.isnan(found.spread_run)
    assert found.groups["a"].interval is None


@pytest.mark.parametrize(
    ("values", "errors", "groups"),
    [([], [], []), ([1.0], [0.0], ["a"]), ([1.0, 2.0], [0.1], ["a", "b"]), ([np.nan], [0.1], ["a"])],
)
def test_what_cannot_be_split_is_refused(values: list[float], errors: list[float], groups: list[str]) -> None:
    with pytest.raises(StatisticsError):
        split_levels(values, errors, groups)


@pytest.mark.parametrize(
    ("spread_group", "spread_run", "error"),
    [
        pytest.param(0.0, 0.1, 0.05, marks=pytest.mark.long),
        (0.3, 0.1, 0.05),
        pytest.param(0.3, 0.02, 0.1, marks=pytest.mark.long),
    ],
)
def test_intervals_hold_the_truth_and_tests_are_wrong_as_rarely_as_they_say(
    spread_group: float, spread_run: float, error: float
) -> None:
    rng, fleets = np.random.default_rng(6), 150
    held = held_groups = groups = false = 0
    for _ in range(fleets):
        counts = rng.integers(3, 6, 4)
        number = np.repeat(np.arange(4), counts)
        shift = spread_group * rng.normal(size=4)
        errors = error * rng.uniform(0.7, 1.4, number.size)
        values = 1.0 + shift[number] + np.hypot(spread_run, errors) * rng.normal(size=number.size)
        found = split_levels(values, errors, [f"g{one}" for one in number])
        assert found.interval is not None
        held += found.interval.low <= 1.0 <= found.interval.high
        for place, one in enumerate(found.groups.values()):
            assert one.interval is not None
            held_groups += one.interval.low <= 1.0 + shift[place] <= one.interval.high
            groups += 1
        false += spread_group == 0.0 and found.p_groups < 0.01
    # Three binomial standard errors about 95 %: as wide as 150 fleets allow.
    assert 0.895 <= held / fleets <= 0.998
    assert 0.92 <= held_groups / groups <= 0.985
    assert false / fleets <= 0.04
