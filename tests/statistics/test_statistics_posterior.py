"""What another run would show: intervals hold it, and are wide where little is known."""

import numpy as np
import pytest

from pipeline.datasets.levels import draw_run
from pipeline.datasets.rank_tests import StatisticsError

GROUPS = ("asphalt", "gravel", "ice")


def draw(values: list[float], groups: list[str], group: str, *, size: float = 1.0) -> tuple[float, float]:
    drawn = draw_run(
        values,
        [0.05] * len(values),
        groups,
        group,
        usual=(size, size),
        count=2000,
        rng=np.random.default_rng(3),
    )
    low, high = np.quantile(drawn, (0.025, 0.975)).tolist()
    return low, high


@pytest.mark.parametrize(("spread", "least", "most"), [(0.0, 0.92, 0.99), (1.0, 0.90, 0.99)])
def test_intervals_hold_a_run_that_comes(spread: float, least: float, most: float) -> None:
    held = []
    for seed in range(120):
        rng = np.random.default_rng([seed, 7])
        shift = dict(zip(GROUPS, spread * rng.normal(size=3), strict=True))
        groups = list(np.repeat(GROUPS, rng.integers(2, 5, 3)))
        errors = rng.uniform(0.3, 0.6, len(groups))
        values = np.array([shift[name] for name in groups])
        values += np.hypot(0.5, errors) * rng.normal(size=len(groups))
        drawn = draw_run(values, errors, groups, "ice", usual=(1.0, 1.0), count=500, rng=rng)
        low, high = np.quantile(drawn, (0.025, 0.975))
        held.append(low <= shift["ice"] + 0.5 * rng.normal() <= high)
    assert least <= np.mean(held) <= most


def test_ground_never_driven_is_less_known_than_ground_that_was() -> None:
    values = [1.0, 1.1, 1.0, 2.0, 2.1, 2.0, 1.5, 1.4, 1.5]
    groups = list(np.repeat(GROUPS, 3))
    known, unknown = draw(values, groups, "gravel"), draw(values, groups, "mud")
    assert known[0] < 2.03 < known[1]
    assert unknown[1] - unknown[0] > 3.0 * (known[1] - known[0])
    assert unknown[0] < 1.5 < unknown[1]


def test_one_run_tells_no_more_than_the_usual_size_of_an_effect() -> None:
    low, high = draw([1.8], ["ice"], "ice", size=0.8)
    assert low < 1.8 - 0.8
    assert high > 1.8 + 0.8
    tight = draw([1.8] * 6, ["ice"] * 6, "ice", size=0.8)
    assert tight[1] - tight[0] < 0.3 * (high - low)


@pytest.mark.parametrize(
    ("errors", "groups", "size"),
    [
        ([0.1], ["a", "a"], 1.0),
        ([0.1, 0.0], ["a", "a"], 1.0),
        ([0.1, 0.1], ["a"], 1.0),
        ([0.1, 0.1], ["a", "a"], 0.0),
    ],
)
def test_what_cannot_be_is_refused(errors: list[float], groups: list[str], size: float) -> None:
    with pytest.raises(StatisticsError) as told:
        draw_run([1.0, 2.0], errors, groups, "a", usual=(size, size), count=10, rng=np.random.default_rng(1))
    assert told.value.code == "bad_errors"
