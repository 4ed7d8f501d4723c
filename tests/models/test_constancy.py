"""A number of the model that changes during a run is found, with its time, and nothing where none changes."""

import re

import polars as pl
import pytest
from few import few
from motion_runs import align, extract, make_scenario, vehicle_of

from pipeline.estimation import EstimationData, Input
from pipeline.estimation.constancy import find_change
from pipeline.estimation.ladder import ModelAssessment, assess_model
from pipeline.models import Model, find_effect
from pipeline.results import Errors, RunDiagnosis, Step
from pipeline.results.reading import CHANGE
from pipeline.run import load_run
from pipeline.simulate import simulate_run
from pipeline.words import format_finding
from pipeline.words.verdict import format_verdict

HUSKY = vehicle_of("husky_a200")
PAUSE_S = 5.0

Effects = dict[str, dict[str, float]]


def judge(halves: tuple[Effects, Effects], seed: int, lengths_s: tuple[float, float]) -> ModelAssessment:
    """A run in two stretches, each with its own physics, fitted with the effects of the first."""
    tables: dict[str, list[pl.DataFrame]] = {}
    for number, (effects, length_s) in enumerate(zip(halves, lengths_s, strict=True)):
        made = simulate_run(make_scenario(effects, seed=seed + number, duration_s=length_s))
        later = number * (lengths_s[0] + PAUSE_S)
        nanoseconds = int(later * 1e9)
        for name, table in extract(made, HUSKY).items():
            moved = table.with_columns(
                pl.col("t") + later, pl.col("stamp") + nanoseconds, pl.col("log_time") + nanoseconds
            )
            if "segment" in table.columns:
                moved = moved.with_columns(pl.col("segment") + number)
            tables.setdefault(name, []).append(moved)
    joined = {name: pl.concat(parts) for name, parts in tables.items()}
    run = load_run(align(joined, HUSKY), HUSKY, name="two parts")
    model = Model(HUSKY, tuple(find_effect(name)() for name in halves[0]))
    return assess_model(EstimationData([run], HUSKY, Input.COMMAND), model)


@pytest.mark.parametrize(
    ("name", "number", "before", "after", "lengths_s"),
    few(
        [
            ("drive_lag", "tau", 0.1, 0.5, (200.0, 40.0)),
            ("effective_track", "k", 1.3, 1.7, (60.0, 180.0)),
            ("wheel_radius", "k", 1.01, 1.04, (150.0, 150.0)),
        ],
        2,
    ),
)
def test_a_number_that_changes_is_found_with_its_time(
    name: str, number: str, before: float, after: float, lengths_s: tuple[float, float]
) -> None:
    findings = find_change(judge(({name: {number: before}}, {name: {number: after}}), 40, lengths_s))
    (finding,) = findings
    assert (finding.id, finding.where, finding.values["parameter"]) == (CHANGE, name, number)
    assert finding.values["time"] == pytest.approx(lengths_s[0] + 0.5 * PAUSE_S, abs=8.0)
    assert finding.values["before"] == pytest.approx(before, rel=0.05)
    assert finding.values["after"] == pytest.approx(after, rel=0.05)
    # Both values have the digits that tell them apart.
    said = [
        float(text) for text in re.findall(r" is ([\d.]+)\D* before and ([\d.]+)", format_finding(finding))[0]
    ]
    assert said[1] - said[0] == pytest.approx(after - before, rel=0.2)
    steps = (
        Step(t_mrmse_m=0.2, r_mrmse_rad=0.1),
        Step(effects=(name,), t_mrmse_m=0.1, r_mrmse_rad=0.1),
    )
    floor = Errors(t_mrmse_m=0.01, r_mrmse_rad=0.01)
    verdict = format_verdict(RunDiagnosis("run", ladder=steps, noise_floor=floor, findings=tuple(findings)))
    assert format_finding(finding)[1:] in verdict
    assert "No known effect" not in verdict


def test_what_changes_beside_a_number_is_said() -> None:
    halves = tuple(
        {"effective_track": {"k": k}, "wheel_radius": {"k": r}} for k, r in ((1.3, 1.0), (1.7, 0.9))
    )
    (finding,) = find_change(judge(halves, 60, (120.0, 120.0)))  # type: ignore[arg-type]
    assert "effective track" in format_finding(finding)
    assert "wheel radius" in format_finding(finding)


@pytest.mark.parametrize("seed", few(range(50, 53), 3))
def test_nothing_is_found_where_no_number_changes(seed: int) -> None:
    effects = {"drive_lag": {"tau": 0.25}, "effective_track": {"k": 1.4}, "wheel_asymmetry": {"e": 0.03}}
    assert find_change(judge((effects, effects), seed, (120.0, 120.0))) == []
