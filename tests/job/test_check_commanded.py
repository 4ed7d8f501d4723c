"""What a robot does of the body command: judged in a check, and told in the verdict on a run."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, cast

import numpy as np
import polars as pl
import pytest

from pipeline.estimation.commanded import measure_commanded_turn
from pipeline.estimation.verdict import format_verdict as format_diagnosis
from pipeline.fleet.changes import AFTER, BEFORE
from pipeline.job import Options
from pipeline.job.analyze import analyze_log
from pipeline.job.check import (
    BROKEN,
    Check,
    check_as_json,
    check_runs,
    compare,
    find_usual_spread,
    keep_baseline,
)
from pipeline.job.check_sides import Sides, read_baseline, read_under
from pipeline.job.check_text import format_verdict, list_lines
from pipeline.job.run_results import load_vehicle
from pipeline.job.stored_fits import COMMANDED, COMMANDED_TURN, MULTIPLIER
from pipeline.models.catalogue import find_effect
from pipeline.models.model import Model
from pipeline.models.model_file import ModelFile
from pipeline.report.motion_view import load_motion_run
from pipeline.simulate import make_scenario, simulate_run, write_log
from pipeline.sources import find_preset
from pipeline.stages.align import measure_body_multiplier
from pipeline.store import Store

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.run import MotionRun
    from pipeline.sources import Vehicle

TRACK = 1.8
EFFECTS = {"drive_lag": {"tau": 0.3}, "effective_track": {"k": TRACK}}
KINDS = {"beside": {"vehicle": "husky"}, "alone": {"platform": "husky_a200"}}
"""Wheel commands with the body command beside them, and a body command alone with encoders."""


def drive(folder: Path, kind: str, multiplier: float, seed: int) -> tuple[Vehicle, MotionRun]:
    """A drive of a robot whose controller has this multiplier, from the log on."""
    scene = make_scenario(None, EFFECTS, seed=seed, duration_s=120.0, **KINDS[kind])  # type: ignore[arg-type]
    scene = replace(scene, vehicle=replace(scene.vehicle, controller_track_multiplier=multiplier))
    log = folder / f"{kind}_{seed}.mcap"
    write_log(simulate_run(scene), log)
    made = analyze_log(log, Options(out=folder / "results", diagnosis=False, report=False)).manifest
    vehicle = load_vehicle(made)
    return vehicle, load_motion_run(made, vehicle)


@pytest.fixture(scope="module", params=sorted(KINDS))
def sides(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Sides:
    """Before: the multiplier is 1; after: it makes up for the skidding."""
    folder = tmp_path_factory.mktemp("driven")
    vehicle, before = drive(folder, request.param, 1.0, 1)
    _, after = drive(folder, request.param, 1.875, 2)
    model = Model(vehicle, tuple(find_effect(name)().change(**values) for name, values in EFFECTS.items()))
    return read_under(ModelFile(model), {BEFORE: [before], AFTER: [after]})


@pytest.fixture(scope="module")
def found(sides: Sides) -> Check:
    return compare(sides)


def test_a_changed_multiplier_is_told_with_what_the_robot_then_does_of_its_command(found: Check) -> None:
    verdict = format_verdict(found)

    assert verdict.startswith("The robot turns at 56 -> 104 % of the commanded rate: better; ")
    assert "the controller's multiplier 1" in verdict
    assert found.list_status("changed") == [MULTIPLIER]
    assert found.changes["effective_track.k"].status == "unchanged"
    assert found.code == BROKEN
    assert ("commanded", "the robot turns at 56 -> 104 % of the commanded yaw rate") in list_lines(found)
    told = check_as_json(found, list_lines(found))["commanded_turn"]
    assert isinstance(told, dict)
    assert told["before"] == pytest.approx(1.0 / TRACK, rel=0.01)
    assert told["after"] == pytest.approx(1.875 / TRACK, rel=0.01)


def test_the_other_way_round_it_is_worse(sides: Sides) -> None:
    swapped = replace(
        sides,
        before=tuple(replace(one, numbers=replace(one.numbers, side=BEFORE)) for one in sides.after),
        after=tuple(replace(one, numbers=replace(one.numbers, side=AFTER)) for one in sides.before),
    )

    assert "104 -> 56 % of the commanded rate: worse" in format_verdict(compare(swapped))


def test_a_multiplier_that_stays_is_no_question(sides: Sides) -> None:
    again = tuple(replace(one, numbers=replace(one.numbers, side=AFTER)) for one in sides.before)
    check = compare(replace(sides, after=again))

    assert not {*COMMANDED} & {*check.changes}
    assert "commanded rate" not in format_verdict(check)


def test_without_a_body_command_nothing_is_said_of_it(sides: Sides) -> None:
    def hide(*runs: object) -> tuple[object, ...]:
        hidden = []
        for one in runs:
            values = one.numbers.values.copy()  # type: ignore[attr-defined]
            values[[sides.names.index(name) for name in COMMANDED]] = np.nan
            hidden.append(replace(one, numbers=replace(one.numbers, values=values)))  # type: ignore[type-var, attr-defined]
        return tuple(hidden)

    check = compare(replace(sides, before=hide(*sides.before), after=hide(*sides.after)))  # type: ignore[arg-type]

    assert check.commanded is None
    assert not {*COMMANDED} & {*check.changes}


def test_a_baseline_of_before_the_commanded_rate_stays_readable(found: Check, tmp_path: Path) -> None:
    path = tmp_path / "robot.json"
    # A check that is broken writes a baseline where there is none.
    keep_baseline(found, path)
    whole = read_baseline(path)
    content = json.loads(path.read_text(encoding="utf-8"))
    content["numbers"] = content["numbers"][: -len(COMMANDED)]
    for run in content["runs"]:
        run["values"] = run["values"][: -len(COMMANDED)]
        run["covariance"] = [row[: -len(COMMANDED)] for row in run["covariance"][: -len(COMMANDED)]]
    path.write_text(json.dumps(content), encoding="utf-8")

    (old,), (new,) = read_baseline(path).readings, whole.readings

    place = whole.names.index(COMMANDED_TURN)
    assert np.isnan(old.numbers.values[place:]).all()
    assert np.isfinite(new.numbers.values[place:]).all()
    np.testing.assert_array_equal(old.numbers.values[:place], new.numbers.values[:place])


def test_the_verdict_on_one_run_says_what_it_does_of_the_command() -> None:
    ladder = [
        {"effects": names, "t_mrmse_m": size, "r_mrmse_rad": size}
        for names, size in (([], 0.3), (["effective_track"], 0.01))
    ]
    clause = "turns at 56 % of the ideal rate"
    diagnosis = {"ladder": ladder, "findings": [], "effects": [{"id": "effective_track", "clause": clause}]}
    turn = {"share": 1.04, "low": 1.03, "high": 1.05, "controller_multiplier": 1.875}

    verdict = format_diagnosis({**diagnosis, "commanded_turn": turn})

    assert "It turns at 104 % of the commanded rate: its controller's multiplier is 1.88." in verdict
    # The ideal rate is the commanded one where the controller changes nothing.
    for other in (None, {**turn, "controller_multiplier": 1.0}, {**turn, "controller_multiplier": -1.0}):
        assert "commanded rate" not in format_diagnosis({**diagnosis, "commanded_turn": other})


@pytest.mark.parametrize("expected", [1.5, None], ids=["obeyed", "another"])
def test_wheels_have_a_multiplier_only_of_a_body_command_that_they_obey(expected: float | None) -> None:
    vehicle = find_preset("husky_a200")
    assert vehicle is not None
    times, draw = np.arange(0.0, 60.0, 0.05), np.random.default_rng(3)
    ahead, turn = (np.repeat(draw.uniform(-1.0, 1.0, 30), 40) for _ in range(2))
    other = np.repeat(draw.uniform(-1.0, 1.0, 30), 40)
    half = 0.5 * 1.5 * (vehicle.track_width_m or 0.0) * (other if expected is None else turn)
    radius = vehicle.wheel_radius_m
    commands = pl.DataFrame(
        {
            "t": times,
            "left": (ahead - half) / radius,
            "right": (ahead + half) / radius,
            "body_x": ahead,
            "body_w": turn,
        }
    )

    found = measure_body_multiplier(commands, vehicle)

    assert found == (None if expected is None else pytest.approx(expected, rel=1e-6))
    assert measure_body_multiplier(commands.drop("body_w"), vehicle) is None


def test_a_run_without_a_body_command_has_no_share(sides: Sides) -> None:
    fitted = sides.before[0].fitted
    assert fitted is not None
    run = fitted.problem.runs[0]
    assert measure_commanded_turn(run, sides.model.model.vehicle) is not None
    bare = replace(run, alignment=replace(run.alignment, body_multiplier=None))
    assert measure_commanded_turn(bare, sides.model.model.vehicle) is None


def test_other_runs_of_the_results_tell_how_much_runs_differ(tmp_path: Path) -> None:
    runs = [drive(tmp_path, "beside", 1.0, seed)[1] for seed in (11, 12, 13, 14)]
    store = Store(tmp_path / "results")
    manifests = {one.run: one for one in store.survey().manifests}
    vehicle = load_vehicle(manifests[runs[0].name])
    model = Model(vehicle, tuple(find_effect(name)().change(**values) for name, values in EFFECTS.items()))

    check = check_runs(ModelFile(model), [manifests[runs[0].name]], store)

    (there,) = check.sides.others.values()
    assert sorted(one.numbers.run for one in there) == sorted(run.name for run in runs[1:])
    change = check.changes["drive_lag.tau"]
    # Three runs of one terrain; the model beside the run is a side of its own.
    assert change.freedom == 2
    assert change.spread < 0.5 * find_usual_spread(check.sides.labels[0].parameter)
    assert dict(list_lines(check))["others"].startswith("3: ")
    assert "and 3 others of the vehicle" in format_verdict(check)
    assert len(cast("list[str]", check_as_json(check, list_lines(check))["others"])) == 3
