"""What the tests promise, on simulated runs that do not differ though their samples say so.

Rejection rates are compared with binomial bounds of the number of repetitions: 2.6 standard errors, so that a
correct test fails here once in two hundred seeds, and the seeds are fixed.
"""

import math
from itertools import combinations

import numpy as np
import pytest
from simulated_runs import RATE, simulate_runs

from pipeline.datasets.pairs import Group, Samples, bound_run, compare_groups
from pipeline.datasets.pooled_tests import Difference, MeansTest, bound_levels, compare_means
from pipeline.datasets.rank_tests import mann_whitney
from pipeline.datasets.steps import find_changes

SPREAD = 0.1


def rejections_allowed(level: float, repetitions: int) -> tuple[float, float]:
    error = math.sqrt(level * (1.0 - level) / repetitions)
    return level - 2.6 * error, level + 2.6 * error


def compare_once(
    runs: int, rng: np.random.Generator, *, seconds: float, memory: float, factor: float = 1.0
) -> Difference:
    sides = [
        np.log(
            np.median(
                simulate_runs(runs, seconds=seconds, memory=memory, spread=SPREAD, rng=rng, median=median),
                axis=1,
            )
        )
        for median in (1.0, factor)
    ]
    (difference,) = compare_means(sides, [(0, 1)]).differences
    return difference


@pytest.mark.parametrize(("runs", "attainable"), [(3, 0.05), (4, 2 / 70), (5, 12 / 252)])
def test_whole_runs_are_rejected_at_the_attainable_level(runs: int, attainable: float) -> None:
    rng = np.random.default_rng(100 + runs)
    repetitions = 800
    found = [compare_once(runs, rng, seconds=30.0, memory=1.0) for _ in range(repetitions)]
    rate = np.mean([one.p <= 0.05 for one in found])
    low, high = rejections_allowed(attainable, repetitions)
    assert low <= rate <= high
    covered = [one.interval is None or one.interval.low <= 0.0 <= one.interval.high for one in found]
    assert np.mean(covered) == pytest.approx(1.0 - rate), "an interval excludes what its test rejects"


@pytest.mark.parametrize(("first", "second"), [(4, 4), (6, 3), (7, 7)])
def test_intervals_of_a_difference_hold_it(first: int, second: int) -> None:
    rng = np.random.default_rng(first)
    hits = []
    for _ in range(400):
        sides = [rng.normal(level, 0.3, count) for level, count in ((0.0, first), (0.5, second))]
        found = compare_means(sides, [(0, 1)]).differences[0].interval
        assert found is not None
        hits.append(found.low <= 0.5 <= found.high)
    assert 0.92 <= np.mean(hits) <= 0.99


@pytest.mark.parametrize("runs", [3, 4, 6])
def test_intervals_over_runs_hold_the_truth(runs: int) -> None:
    rng = np.random.default_rng(10 + runs)
    hits = []
    for _ in range(600):
        medians = np.median(simulate_runs(runs, seconds=30.0, memory=1.0, spread=SPREAD, rng=rng), axis=1)
        (found,) = bound_levels([medians])
        assert found is not None
        hits.append(found.low <= 1.0 <= found.high)
    assert 0.92 <= np.mean(hits) <= 0.97


def compare_parts(*sides: np.ndarray) -> float:
    """p of two runs by their parts; 1 where they are not tested."""
    (pair,) = compare_groups(
        [
            Group.of_runs(name, [Samples(side, side.size / RATE)])
            for name, side in zip("ab", sides, strict=True)
        ]
    )
    return 1.0 if pair.p is None else pair.p


@pytest.mark.parametrize(
    ("memory", "shorter"),
    [
        (2.0, 30.0),
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in ((0.5, 30.0), (0.5, 100.0), (2.0, 100.0), (2.0, 600.0))
        ),
    ],
)
def test_single_runs_of_unequal_lengths_keep_the_level(memory: float, shorter: float) -> None:
    rng = np.random.default_rng(round(shorter))
    repetitions = 400
    false = []
    for _ in range(repetitions):
        sides = [
            simulate_runs(1, seconds=seconds, memory=memory, spread=0.0, rng=rng)[0]
            for seconds in (600.0, shorter)
        ]
        false.append(compare_parts(*sides) <= 0.05)
    assert np.mean(false) <= rejections_allowed(0.05, repetitions)[1]


@pytest.mark.long
@pytest.mark.parametrize(("memory", "seconds"), [(0.5, 200.0), (2.0, 300.0)])
def test_blocks_of_single_runs_keep_the_level_that_plain_samples_break(memory: float, seconds: float) -> None:
    rng = np.random.default_rng(round(10 * memory))
    repetitions = 250
    blocks, plain = [], []
    for _ in range(repetitions):
        sides = simulate_runs(2, seconds=seconds, memory=memory, spread=0.0, rng=rng)
        blocks.append(compare_parts(*sides) <= 0.05)
        plain.append(mann_whitney(*sides) <= 0.05)
    assert np.mean(blocks) <= rejections_allowed(0.05, repetitions)[1]
    assert np.mean(plain) > 0.5


def test_the_interval_of_one_run_holds_its_own_median() -> None:
    rng = np.random.default_rng(5)
    hits = []
    for _ in range(150):
        (values,) = simulate_runs(1, seconds=300.0, memory=1.0, spread=0.0, rng=rng)
        found = bound_run(Samples(values, values.size / RATE))
        assert found is not None
        hits.append(found.low <= 1.0 <= found.high)
    assert 0.90 <= np.mean(hits) <= 0.985


def test_a_family_controls_the_pair_that_is_equal_while_a_third_differs() -> None:
    rng = np.random.default_rng(7)
    repetitions = 200
    false, powers = [], []
    for _ in range(repetitions):
        found = alarms([rng.normal(level, SPREAD, 6) for level in (0.0, 0.0, 1.0)])
        equal, *others = [one.p_adjusted for one in found.differences]
        false.append(equal <= 0.05)
        powers.append(max(others) <= 0.05)
    assert np.mean(false) <= rejections_allowed(0.05, repetitions)[1]
    assert np.mean(powers) > 0.95


def alarms(groups: list[np.ndarray]) -> MeansTest:
    return compare_means(groups, list(combinations(range(len(groups)), 2)))


@pytest.mark.parametrize(
    ("sizes", "spreads", "method"),
    [
        ((3, 2, 2, 1, 1), (0.2,) * 5, "Tukey-Kramer"),
        ((3, 1), (0.2, 0.2), "Tukey-Kramer"),
        ((3, 3, 3), (0.2,) * 3, ""),
        ((6, 6, 6), (0.2,) * 3, ""),
        ((9, 7), (0.02, 0.5), "Games-Howell"),
    ],
)
def test_grounds_that_are_one_alarm_once_in_twenty(
    sizes: tuple[int, ...], spreads: tuple[float, ...], method: str
) -> None:
    rng = np.random.default_rng([len(sizes), *sizes])
    repetitions = 200
    found = [
        alarms([rng.normal(0.0, spread, size) for size, spread in zip(sizes, spreads, strict=True)])
        for _ in range(repetitions)
    ]
    rate = np.mean([min(one.p_adjusted for one in test.differences) <= 0.05 for test in found])
    low, high = rejections_allowed(0.05, repetitions)
    assert low <= rate <= high
    assert np.mean([test.method.startswith(method) for test in found]) > 0.9


def test_power_grows_with_the_difference_and_the_runs() -> None:
    rng = np.random.default_rng(8)
    power = {
        (runs, factor): np.mean(
            [compare_once(runs, rng, seconds=120.0, memory=1.0, factor=factor).p <= 0.05 for _ in range(150)]
        )
        for runs in (4, 6)
        for factor in (1.2, 1.7)
    }
    assert power[4, 1.7] > 0.9
    assert power[6, 1.2] > power[4, 1.2]


def test_chance_makes_a_step_in_a_series_once_in_twenty() -> None:
    rng = np.random.default_rng(9)
    found = [bool(find_changes(rng.normal(0.0, 1.0, 15), seed=seed)) for seed in range(300)]
    assert np.mean(found) <= rejections_allowed(0.05, 300)[1]


@pytest.mark.long
def test_long_nulls_at_every_memory() -> None:
    rng = np.random.default_rng(11)
    repetitions = 1_000
    for memory in (0.5, 1.0, 2.5):
        rejected = []
        for _ in range(repetitions):
            sides = simulate_runs(2, seconds=600.0, memory=memory, spread=0.0, rng=rng)
            rejected.append(compare_parts(*sides) <= 0.05)
        assert np.mean(rejected) <= rejections_allowed(0.05, repetitions)[1]
    for runs, attainable in ((4, 2 / 70), (5, 12 / 252)):
        found = [compare_once(runs, rng, seconds=120.0, memory=1.0).p <= 0.05 for _ in range(2_000)]
        low, high = rejections_allowed(attainable, 2_000)
        assert low <= np.mean(found) <= high
