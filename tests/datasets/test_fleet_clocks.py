"""A clock is a number of one run: no forecast carries it, and poses that a gyro dated are not moved again."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest
from test_fleet_levels import ALIKE, draw
from verbs import run_verb

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.datasets.forecast import fit_fleet, forecast_vehicle
from pipeline.models import Model, ModelFile, find_effect, read_model, write_model
from pipeline.simulate import VEHICLES, Disturbance, Imu, PoseSensor, Scenario, simulate_run, write_log

_LATE_S = 0.2
_SCENE = Scenario(
    vehicle=VEHICLES["husky"],
    effects={"effective_track": 1.7, "clock_offset": _LATE_S},
    duration_s=90.0,
    disturbance=Disturbance(0.02, 0.03),
    pose=PoseSensor(drift_m=0.005),
    imu=Imu(),
    seed=7,
)


def test_a_forecast_has_no_clock() -> None:
    clock = draw(dict.fromkeys(ALIKE, 0.2), effect="clock_offset", parameter="d", unit="s")
    estimates = pl.concat([draw(ALIKE), clock])
    forecast = forecast_vehicle(estimates, "warthog", "ice", "measured")
    assert [effect.id for effect in forecast.effects] == ["wheel_radius"]
    assert set(forecast.prior) == {"wheel_radius.k"}


def test_poses_that_gyros_have_dated_are_no_body_that_is_late() -> None:
    names = {}
    for in_model in (False, True):
        clock = {"effect": "clock_offset", "parameter": "d", "unit": "s", "in_model": in_model}
        (number,) = fit_fleet(draw({"asphalt": 0.1, "ice": 0.4}, **clock)).numbers
        names[in_model] = (number.name, number.candidates)
    assert names[False] == ("clock_offset", ("clock_offset",))
    assert names[True] == ("body_inertia", ("clock_offset", "body_inertia"))


@pytest.mark.long
def test_late_poses_that_a_gyro_dated_are_judged_with_the_clock_once(tmp_path: Path) -> None:
    out, log = tmp_path / "out", tmp_path / "first.mcap"
    write_log(simulate_run(_SCENE), log)
    diagnosed = analyze_log(log, Options(out=out, report=False, diagnosis=True)).summary["diagnosis"]
    found = {effect["id"]: effect for effect in diagnosed["effects"]}
    assert found.keys() == {"effective_track", "clock_offset"}
    assert {one["name"] for one in found["clock_offset"]["could_be"]} == {"clock_offset"}

    another = tmp_path / "another.mcap"
    write_log(simulate_run(replace(_SCENE, seed=8)), another)
    expected = tmp_path / "expected.toml"
    said = ("--vehicle", "husky_a200", "--terrain", "simulated", "--file", expected)
    predicted = _answer("fleet", ["predict"], "--results", out, *said)
    assert [effect["id"] for effect in predicted["effects"]] == ["effective_track"]
    forecast = read_model(expected).model

    late = tmp_path / "late.toml"
    clock = find_effect("clock_offset")(d=_LATE_S)
    write_model(ModelFile(Model(forecast.vehicle, (*forecast.effects, clock))), late)
    compared = _answer("model", ["compare", expected, late], "--on", another, "--results", tmp_path / "other")
    one, two = (row["carried"]["t_mrmse_m"] for row in compared["compared"])
    assert two == one
    assert one < 1.2 * compared["compared"][0]["own_fit"]["t_mrmse_m"]
    assert compared["warnings"] == ["clock_offset not fitted: the gyro gives the delay of the poses"]
    # What the run's own model leaves is measured with the clock once, too.
    assert predicted["t_mrmse_m"]["value"] < 2.0 * diagnosed["ladder"][-1]["t_mrmse_m"]


def _answer(verb: str, names: Sequence[object], *more: object) -> dict:  # type: ignore[type-arg]
    done = run_verb(verb, *names, *more, "--json")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)  # type: ignore[no-any-return]
