"""What a robot does of the body command: judged in a check, and told in the verdict on a run."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from simulated_platforms import scene_of

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.datasets.check import BROKEN, compare_sides
from pipeline.datasets.check_readings import COMMANDED_TURN, MULTIPLIER
from pipeline.datasets.check_sides import Sides, read_under
from pipeline.models.catalogue import find_effect
from pipeline.models.model import Model
from pipeline.models.model_file import ModelFile
from pipeline.run import MotionRun, load_motion_run
from pipeline.simulate import make_scenario, simulate_run, write_log
from pipeline.sources import Vehicle, find_preset
from pipeline.sources.one_vehicle import load_vehicle
from pipeline.stages.align import measure_body_multiplier
from pipeline.words.check import format_check

TRACK = 1.8
EFFECTS = {"drive_lag": {"tau": 0.3}, "effective_track": {"k": TRACK}}
KINDS = ("alone", "beside")
"""A body command alone with encoders, and wheel commands with the body command beside them."""


def drive(folder: Path, kind: str, multiplier: float, seed: int) -> tuple[Vehicle, MotionRun]:
    """A drive of a robot whose controller has this multiplier, from the log on."""
    if kind == "alone":
        scene = scene_of("husky_a200", EFFECTS, seed=seed, duration_s=120.0)
    else:
        scene = make_scenario(None, EFFECTS, vehicle="husky", seed=seed, duration_s=120.0)
    scene = replace(scene, vehicle=replace(scene.vehicle, controller_track_multiplier=multiplier))
    log = folder / f"{kind}_{seed}.mcap"
    write_log(simulate_run(scene), log)
    made = analyze_log(log, Options(out=folder / "results", diagnosis=False, report=False)).manifest
    vehicle = load_vehicle(made)
    return vehicle, load_motion_run(made, vehicle)


@pytest.fixture(scope="module", params=KINDS)
def sides(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Sides:
    """Before: the multiplier is 1; after: it makes up for the skidding."""
    folder = tmp_path_factory.mktemp("driven")
    vehicle, before = drive(folder, request.param, 1.0, 1)
    _, after = drive(folder, request.param, 1.875, 2)
    model = Model(vehicle, tuple(find_effect(name)().change(**values) for name, values in EFFECTS.items()))
    return read_under(ModelFile(model), ([before], [after]))


def test_a_changed_multiplier_is_told_with_what_the_robot_then_does_of_its_command(sides: Sides) -> None:
    found = compare_sides(sides)

    numbers = {one.name: one for one in found.numbers}
    assert [one.name for one in found.list_status("changed")] == [MULTIPLIER]
    assert re.search(r"controller's multiplier 1(\.0\d)? -> 1\.8\d", format_check(found))
    assert numbers["effective_track.k"].status == "unchanged"
    turned = numbers[COMMANDED_TURN]
    assert (turned.before, turned.after) == pytest.approx((1.0 / TRACK, 1.875 / TRACK), rel=0.01)
    assert found.code == BROKEN


def test_without_a_body_command_nothing_is_said_of_it(sides: Sides) -> None:
    hidden = [
        tuple(replace(one, estimates={"drive_lag.tau": one.estimates["drive_lag.tau"]}) for one in side)
        for side in (sides.before, sides.after)
    ]
    found = compare_sides(replace(sides, before=hidden[0], after=hidden[1]))
    assert {one.name: one.status for one in found.numbers}[MULTIPLIER] == "unknown"
    assert "multiplier" not in format_check(found)


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
