"""What a robot does of the body command: judged in a check, and told in the verdict on a run."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.datasets.changes import AFTER, BEFORE, Side
from pipeline.datasets.check import BROKEN, Check, check_as_json, compare
from pipeline.datasets.check_readings import COMMANDED, MULTIPLIER, RunReading
from pipeline.datasets.check_sides import Sides, read_under
from pipeline.models.catalogue import find_effect
from pipeline.models.model import Model
from pipeline.models.model_file import ModelFile
from pipeline.run import MotionRun, load_motion_run
from pipeline.simulate import make_scenario, simulate_run, write_log
from pipeline.sources import Vehicle, find_preset
from pipeline.sources.one_vehicle import load_vehicle
from pipeline.stages.align import measure_body_multiplier
from pipeline.words.check import format_verdict, list_lines

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


@pytest.mark.parametrize("runs", [1, 16])
@pytest.mark.parametrize(("share", "status"), [(0.02, "unchanged"), (0.2, "changed")])
def test_more_runs_do_not_make_two_percent_of_a_multiplier_a_change(
    sides: Sides, runs: int, share: float, status: str
) -> None:
    index = sides.names.index(MULTIPLIER)

    def turn(side: Side, by: float) -> tuple[RunReading, ...]:
        (one,) = sides.before
        values = one.numbers.values.copy()
        values[index] += math.log1p(by)
        return (replace(one, numbers=replace(one.numbers, side=side, values=values)),) * runs

    check = compare(replace(sides, before=turn(BEFORE, 0.0), after=turn(AFTER, share)))

    assert check.changes[MULTIPLIER].status == status


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
