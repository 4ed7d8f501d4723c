"""The map of what to expect: passes are counted as driven, and their effect is told only beyond chance."""

import math

import numpy as np
import polars as pl
import pytest

from pipeline.core.arrays import Floats
from pipeline.datasets.terrain import (
    Drive,
    PassEffect,
    list_crossings,
    measure_pass_effects,
    sum_cells,
)

STEP_S = 0.05
RADIUS_M = 8.0
LAP_S = 60.0


def make_drive(x: Floats, y: Floats, slip: Floats | float = 0.1, speed: float = 1.0) -> Drive:
    """A run along a path at a speed, which loses a share of it."""
    times = np.arange(x.size) * STEP_S
    unknown, none = np.full(x.size, np.nan), np.zeros(x.size)
    columns = {
        "t": times,
        "x": x,
        "y": y,
        "heading": np.arctan2(np.gradient(y), np.gradient(x)),
        "ideal": np.full(x.size, speed),
        "slip": speed * np.broadcast_to(slip, x.shape).astype(np.float64),
        "turn": none,
        "energy": unknown,
        "lean": unknown,
        "power": unknown,
        "transitory": none,
    }
    return Drive("run", "husky_snow", "husky", "snow", "map yard", columns)


def draw_laps(change: float, seed: int, laps: int = 7) -> pl.DataFrame:
    """Crossings of laps of a circle whose slip changes by a share with each of them; noise lasts seconds."""
    draw = np.random.default_rng(seed)
    times = np.arange(0.0, laps * LAP_S, STEP_S)
    angle = 2.0 * math.pi * times / LAP_S
    lap = np.floor(times / LAP_S)
    knots = np.arange(0.0, times[-1] + 10.0, 3.0)
    noise = np.interp(times, knots, draw.normal(scale=0.15, size=knots.size))
    place = 0.3 * np.sin(3.0 * angle)
    slip = 0.2 * np.exp(lap * math.log1p(change) + noise + place)
    return list_crossings(make_drive(RADIUS_M * np.cos(angle), RADIUS_M * np.sin(angle), slip))


def measure(crossings: pl.DataFrame) -> PassEffect:
    (effect,) = measure_pass_effects(crossings)
    return effect


def test_a_path_along_an_edge_crosses_each_cell_once() -> None:
    x = np.arange(0.0, 40.0, 0.05)
    found = list_crossings(make_drive(x, 0.3 * np.sin(2.0 * x)))
    assert found["passes"].to_numpy().max() == 0
    assert {0, -1} == set(found["j"].to_list())


def test_every_lap_is_a_pass_over_its_cells() -> None:
    found = draw_laps(0.0, 0, laps=4)
    most = found.group_by("i", "j").agg(pl.col("passes").max() + 1)["passes"].to_numpy()
    assert np.median(most) == 4
    assert found.filter(pl.col("passes") == 3)["t"].to_numpy().min() >= 3.0 * LAP_S - 1.0


def test_cells_say_what_crossings_showed() -> None:
    x = np.concatenate([np.arange(0.0, 20.0, 0.05), np.arange(20.0, 0.0, -0.05)])
    there = np.arange(x.size) < x.size // 2
    cells = sum_cells(list_crossings(make_drive(x, np.full(x.size, 1.0), np.where(there, 0.1, 0.3))))
    middle = cells.filter(pl.col("x") == 9.0).row(0, named=True)
    assert (middle["y"], middle["passes"], middle["runs"], middle["terrain"]) == (1.0, 2, 1, "snow")
    assert middle["slip"] == pytest.approx(0.2)
    assert (middle["slip_low"], middle["slip_high"]) == (pytest.approx(0.15), pytest.approx(0.25))
    assert middle["power"] is None


@pytest.mark.parametrize("change", [-0.12, 0.08])
def test_what_each_pass_changes_is_told_with_an_interval_that_holds_it(change: float) -> None:
    effects = [measure(draw_laps(change, seed)) for seed in range(30)]
    assert all(effect.is_significant for effect in effects)
    assert sum(effect.low <= change <= effect.high for effect in effects) >= 26
    verb = "falls" if change < 0.0 else "grows"
    assert f"husky_snow: slip {verb} by " in effects[0].describe()
    assert "per pass [" in effects[0].describe()


@pytest.mark.long
def test_ground_that_does_not_change_is_seldom_said_to() -> None:
    effects = [measure(draw_laps(0.0, seed)) for seed in range(100, 180)]
    assert sum(effect.is_significant for effect in effects) <= 8
    assert "does not depend on the number of passes beyond chance" in effects[0].describe()


def test_speed_and_turning_are_not_taken_for_passes() -> None:
    """A driver who gets faster with every lap, on ground whose slip grows with speed alone."""
    draw = np.random.default_rng(3)
    found = draw_laps(0.0, 3)
    speed = 0.5 * np.exp(0.1 * found["passes"].to_numpy() + draw.normal(scale=0.1, size=found.height))
    slip = 0.1 * (speed / 0.5) ** 2 * np.exp(draw.normal(scale=0.05, size=found.height))
    faster = found.with_columns(pl.Series("speed", speed), pl.Series("slip", slip))
    assert measure(faster).low < 0.0 < measure(faster).high
    assert measure(faster.with_columns(pl.lit(1.0).alias("speed"))).low > 0.0
