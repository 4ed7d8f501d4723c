"""Deployments compared by cause: parts add up, the unit is the run, and few runs are told so."""

import math

import numpy as np
import polars as pl
import pytest

from pipeline.datasets.causes import compare_causes
from pipeline.datasets.pairs import BLOCKS, RUNS

ASPHALT = {"effective_track": 0.8, "turn_lag": 0.3, "disturbance": 0.1, "localization_noise": 0.05}
ICE = {"effective_track": 0.8, "wheel_radius": 1.5, "disturbance": 0.4, "localization_noise": 0.05}
LEFT = ("disturbance", "localization_noise")


def draw(
    group: str, amounts: dict[str, float], runs: int, *, spread: float = 0.1, seed: int = 0
) -> pl.DataFrame:
    """Budgets of runs whose mean squares scatter about the given ones."""
    rng = np.random.default_rng([seed, *group.encode()])
    rows = []
    for number in range(runs):
        squares = {name: amount * math.exp(spread * rng.normal()) for name, amount in amounts.items()}
        total = sum(squares.values())
        rows += [
            {
                "group": group,
                "run": f"{group}_{number}",
                "name": name,
                "kind": name if name in LEFT else "effect",
                "mean_square": square,
                "share": square / total,
                "low": square / total - 0.02,
                "high": square / total + 0.02,
            }
            for name, square in squares.items()
        ]
    return pl.DataFrame(rows)


def test_budgets_and_differences_add_up() -> None:
    rows = pl.concat([draw("asphalt", ASPHALT, 4), draw("ice", ICE, 5)])
    budgets, (difference,) = compare_causes(rows)
    totals = {}
    for budget in budgets:
        assert sum(part.value for part in budget.parts) == pytest.approx(1.0)
        own = rows.filter(pl.col("group") == budget.dataset)
        assert budget.total == pytest.approx(
            own.group_by("run").agg(pl.col("mean_square").sum())["mean_square"].mean()
        )
        assert all(part.low < part.value < part.high for part in budget.parts)  # type: ignore[operator]
        totals[budget.dataset] = math.sqrt(budget.total)
    assert (difference.a, difference.b) == ("asphalt", "ice")
    assert difference.total == pytest.approx(totals["ice"] - totals["asphalt"])
    assert sum(part.value for part in difference.parts) == pytest.approx(difference.total)
    assert difference.unit == RUNS


def test_what_makes_the_difference_is_named_and_what_is_alike_is_not() -> None:
    _, (difference,) = compare_causes(pl.concat([draw("asphalt", ASPHALT, 6), draw("ice", ICE, 6)]))
    parts = {part.name: part for part in difference.parts}
    assert difference.parts[0].name == "wheel_radius"
    assert parts["wheel_radius"].p_adjusted < 0.05
    assert parts["turn_lag"].high < 0.0
    assert parts["turn_lag"].p_adjusted < 0.05
    assert parts["effective_track"].low < 0.0 < parts["effective_track"].high
    assert parts["effective_track"].p_adjusted > 0.05
    told = difference.describe({"wheel_radius": "longitudinal_slip"})
    assert told.startswith("ice has 0.")
    assert "m/s more RMS slip over half a second than asphalt; by cause in m/s: +" in told
    assert "longitudinal_slip" in told.partition("; significant: ")[2]


def test_equal_deployments_are_rarely_said_to_differ() -> None:
    said = 0
    for seed in range(60):
        rows = pl.concat([draw("a", ASPHALT, 5, seed=seed), draw("b", ASPHALT, 5, seed=seed)])
        _, (difference,) = compare_causes(rows)
        said += any(part.p_adjusted < 0.05 for part in difference.parts)
    # Of 60 with a chance of 5 %, more than 8 come in fewer than one of a hundred trials.
    assert said <= 8


@pytest.mark.parametrize("runs", [(3, 1), (1, 3), (2, 2)])
def test_a_cause_that_one_side_lacks_is_not_tested_by_the_spread_of_zeros(runs: tuple[int, int]) -> None:
    rows = pl.concat([draw("asphalt", ASPHALT, runs[0]), draw("ice", ICE, runs[1])])
    _, (difference,) = compare_causes(rows)
    parts = {part.name: part for part in difference.parts}
    for name, holds in (("wheel_radius", runs[1]), ("turn_lag", runs[0])):
        assert (parts[name].p_adjusted is None) == (holds < 3)
        assert parts[name].value != 0.0
    ground = parts["disturbance"]
    assert 0.0 < float(str(ground.p_adjusted)) < 0.1
    assert float(str(ground.low)) < ground.value < float(str(ground.high))


def test_two_single_runs_have_their_own_intervals_and_no_test() -> None:
    rows = pl.concat([draw("a", ASPHALT, 1), draw("b", ASPHALT, 1, seed=1)])
    _, (difference,) = compare_causes(rows)
    assert difference.unit == BLOCKS
    assert all(part.p_adjusted is None and part.low is not None for part in difference.parts)
    assert difference.describe({}).endswith("; too few runs for a test")
