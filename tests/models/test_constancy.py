"""A number of the model that changes during a run is found, with its time, and nothing where none changes."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import polars as pl
import pytest
from motion_runs import align, extract, make_scenario, vehicle_of

from pipeline.estimation import Input, Problem
from pipeline.estimation.constancy import find_change
from pipeline.estimation.ladder import Judgement, judge_model
from pipeline.estimation.verdict import CHANGE, format_verdict
from pipeline.models import Model, find_effect
from pipeline.run import load_run
from pipeline.simulate import simulate_run

if TYPE_CHECKING:
    from collections.abc import Mapping

HUSKY = vehicle_of("husky_a200")
LENGTH_S, PAUSE_S = 150.0, 5.0

Effects = dict[str, dict[str, float]]


def judge(halves: tuple[Effects, Effects], seed: int) -> Judgement:
    """A run in two stretches, each with its own physics, fitted with the effects of the first."""
    tables: dict[str, list[pl.DataFrame]] = {}
    for number, effects in enumerate(halves):
        made = simulate_run(make_scenario(effects, seed=seed + number, duration_s=LENGTH_S))
        later = number * (LENGTH_S + PAUSE_S)
        nanoseconds = int(later * 1e9)
        for name, table in extract(made, HUSKY).items():
            moved = table.with_columns(
                pl.col("t") + later, pl.col("stamp") + nanoseconds, pl.col("log_time") + nanoseconds
            )
            if "segment" in table.columns:
                moved = moved.with_columns(pl.col("segment") + number)
            tables.setdefault(name, []).append(moved)
    joined = {name: pl.concat(parts) for name, parts in tables.items()}
    run = load_run(align(joined, HUSKY), HUSKY, name="two halves")
    model = Model(HUSKY, tuple(find_effect(name)() for name in halves[0]))
    return judge_model(Problem([run], HUSKY, Input.COMMAND), model)


def find(findings: list[Mapping[str, object]]) -> tuple[str, float, float, float]:
    """Effect, time and both values of a finding."""
    (finding,) = findings
    numbers = re.search(r"at (\d+) s: \w+ is ([\d.]+)\D* before and ([\d.]+)", str(finding["text"]))
    assert numbers is not None
    time, before, after = map(float, numbers.groups())
    return str(finding["where"]), time, before, after


@pytest.mark.parametrize(
    ("name", "number", "before", "after"),
    [("drive_lag", "tau", 0.1, 0.4), ("effective_track", "k", 1.3, 1.7), ("wheel_radius", "k", 1.0, 0.9)],
)
def test_a_number_that_changes_is_found_with_its_time(
    name: str, number: str, before: float, after: float
) -> None:
    halves = ({name: {number: before}}, {name: {number: after}})
    judgement = judge(halves, 40)
    findings = find_change(judgement)
    effect, time, first, second = find(findings)
    assert effect == name
    assert abs(time - LENGTH_S - 0.5 * PAUSE_S) < 8.0
    assert (first, second) == (pytest.approx(before, rel=0.1), pytest.approx(after, rel=0.1))
    steps = [
        {"t_mrmse_m": 0.2, "r_mrmse_rad": 0.1},
        {"effects": [name], "t_mrmse_m": 0.1, "r_mrmse_rad": 0.1},
    ]
    floor = {"t_mrmse_m": 0.01, "r_mrmse_rad": 0.01}
    verdict = format_verdict({"ladder": steps, "noise_floor": floor, "findings": findings})
    assert str(findings[0]["text"])[1:] in verdict
    assert "No known effect" not in verdict
    assert findings[0]["id"] == CHANGE


@pytest.mark.parametrize("seed", range(50, 56))
def test_nothing_is_found_where_no_number_changes(seed: int) -> None:
    effects = {"drive_lag": {"tau": 0.25}, "effective_track": {"k": 1.4}, "wheel_asymmetry": {"e": 0.03}}
    assert find_change(judge((effects, effects), seed)) == []
