"""Sizes of differences against brute force, and single runs that are compared by their parts."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulated_runs import RATE, simulate_runs

from pipeline.datasets.pairs import (
    Group,
    SlipSamples,
    cliffs_delta,
    compare_groups,
    mann_whitney,
    shift_between,
)

SIDE = st.lists(st.integers(-50, 50).map(float), min_size=1, max_size=5).map(np.array)


@given(SIDE, SIDE)
@settings(max_examples=40, deadline=None)
def test_the_shift_and_delta_are_those_of_all_pairs(a: np.ndarray, b: np.ndarray) -> None:
    pairs = [y - x for x in a for y in b]
    assert shift_between(a, b) == pytest.approx(float(np.median(pairs)), abs=1e-12)
    above, below = sum(p > 0 for p in pairs), sum(p < 0 for p in pairs)
    assert cliffs_delta(a, b) == pytest.approx((above - below) / len(pairs))


def sample(values: np.ndarray, seconds: float) -> SlipSamples:
    """Samples that are spread over a time."""
    return SlipSamples(values, np.arange(values.size) * (seconds / values.size))


def test_a_run_stands_as_parts_of_one_length_evenly_over_it() -> None:
    values = np.repeat(np.arange(1.0, 9.0), 50)
    eight = list(range(1, 9))
    assert sample(values, 400.0).cut(50.0).tolist() == eight
    assert sample(values, 400.0).cut(10.0).tolist() == eight, "eight at most, from all of the run"
    assert sample(values, 40.0).cut(10.0).size == 4
    assert sample(values, 9.0).cut(10.0).tolist() == [4.5]
    assert sample(values, 19.0).bound() is None, "two parts do not determine a spread"


def single(name: str, seconds: float, median: float = 1.0) -> Group:
    rng = np.random.default_rng(round(seconds))
    values = rng.lognormal(math.log(median), 0.1, round(20 * seconds))
    return Group.of_runs(name, [sample(values, seconds)])


@pytest.mark.parametrize("seconds", [1.0, 29.0])
def test_runs_without_three_parts_are_not_tested(seconds: float) -> None:
    groups = [single("a", seconds), single("b", 600.0), single("c", 600.0, 2.0)]
    short, other, long = compare_groups(groups)
    for pair in (short, other):
        assert pair["p"] is None
        assert pair["ratio"] is not None
        assert "too short for a test: 3 stretches of 10 s of each" in str(pair["note"])
    (alone,) = compare_groups(groups[1:])
    assert long["p"] == alone["p"]
    assert float(str(long["p"])) < 0.01


def test_groups_that_do_not_scatter_are_not_tested() -> None:
    (pair,) = compare_groups([Group("a", np.full(3, 0.3)), Group("b", np.full(1, 0.7))])
    assert (pair["p"], pair["low"]) == (None, None)
    assert pair["ratio"] == pytest.approx(7.0 / 3.0)
    assert "no test" in str(pair["note"])


def compare_parts(*sides: np.ndarray) -> float:
    """p of two runs by their parts; 1 where they are not tested."""
    runs = [[sample(side, side.size / RATE)] for side in sides]
    (pair,) = compare_groups([Group.of_runs(name, run) for name, run in zip("ab", runs, strict=True)])
    return 1.0 if pair["p"] is None else float(str(pair["p"]))


@pytest.mark.parametrize(
    ("memory", "lengths"),
    [
        (2.0, (600.0, 30.0)),
        (2.0, (300.0, 300.0)),
        pytest.param(0.5, (600.0, 100.0), marks=pytest.mark.long),
    ],
)
def test_parts_of_equal_single_runs_keep_the_level_that_samples_break(
    memory: float, lengths: tuple[float, float]
) -> None:
    rng, repetitions = np.random.default_rng(round(lengths[1])), 250
    parts, plain = [], []
    for _ in range(repetitions):
        sides = [simulate_runs(1, seconds=one, memory=memory, spread=0.0, rng=rng)[0] for one in lengths]
        parts.append(compare_parts(*sides) <= 0.05)
        plain.append(mann_whitney(*sides) <= 0.05)
    assert np.mean(parts) <= 0.05 + 2.6 * math.sqrt(0.05 * 0.95 / repetitions)
    assert np.mean(plain) > 0.5
