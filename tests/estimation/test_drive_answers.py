"""What the drive makes of a command by itself, a share of it or a ramp towards it, is named alone."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from simulated_platforms import simulate_platform

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.estimation import diagnose_runs
from pipeline.estimation.stored_diagnosis import read_recording
from pipeline.models import find_effect
from pipeline.models.parameter import Conditions, Largest
from pipeline.simulate import (
    VEHICLES,
    Disturbance,
    Ground,
    PoseSensor,
    Program,
    Scenario,
    simulate_run,
    write_log,
)
from pipeline.simulate.scenario import Commands

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.results import RunDiagnosis

_GAINS = {
    "drive_gain": {"g": 0.9},
    "gain_drift": {"k": 0.2},
    "difference_gain": {"g": 0.49},
    "side_gain": {"e": 0.06},
}
_DRIVES = {
    **_GAINS,
    "body_acceleration_limit": {"limit": 1.5},
    "turn_acceleration_limit": {"limit": 1.2},
    "grade_load": {"k": 1.2},
    "load_droop": {"d": 0.08},
    "wheel_speed_limit": {"limit": 5.0},
    "wheel_speed_scaling": {"limit": 5.0},
}
_ALIKE = {"drive_gain", "side_gain", "turn_acceleration_limit", "wheel_speed_scaling"}
"""Each has another of its kind above."""
_GROUNDS = {"grade_load": Ground(hill_m=1.0, hill_length_m=25.0)}


def _diagnose(log: Path) -> RunDiagnosis:
    options = Options(out=log.with_name("out"), report=False, diagnosis=False)
    vehicle, recording = read_recording(analyze_log(log, options).manifest)
    (told,) = diagnose_runs([recording], vehicle, inputs=("command",)).runs
    return told


def _diagnose_drive(scenario: Scenario, folder: Path) -> RunDiagnosis:
    write_log(simulate_run(scenario), folder / "run.mcap")
    return _diagnose(folder / "run.mcap")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.long) if name in _ALIKE else name for name in _DRIVES]
)
def test_it_is_named_with_its_numbers_and_nothing_beside_it(name: str, tmp_path: Path) -> None:
    """49 % of the asked difference at all rates was named a limit, and ramps a servo."""
    scenario = Scenario(
        vehicle=VEHICLES["warthog"],
        ground=_GROUNDS.get(name, Ground()),
        effects={name: _DRIVES[name]},
        duration_s=90.0,
        seed=3,
        disturbance=Disturbance(0.02, 0.02),
    )
    told = _diagnose_drive(scenario, tmp_path)
    assert [effect.id for effect in told.effects] == [name]
    found = {key: number.value for key, number in told.effects[0].parameters.items()}
    assert found == pytest.approx(_DRIVES[name], rel=0.03)


@pytest.mark.parametrize("name", _GAINS)
def test_without_encoders_a_gain_is_the_size_of_the_wheels_or_the_track(name: str) -> None:
    largest = Largest(1.0, 1.0, 5.0, 3.0, np.linspace(0.0, 60.0, 11))
    assert find_effect(name)().can_show(Conditions(largest, encoders=True))
    assert not find_effect(name)().can_show(Conditions(largest))


@pytest.mark.parametrize("name", ["drive_gain", "load_droop", "wheel_radius"])
def test_of_bursts_that_are_taken_to_be_as_fast_as_commanded_no_gain_is_found(name: str) -> None:
    largest, effect = Largest(1.0, 1.0, 5.0, 3.0, np.linspace(0.0, 60.0, 11)), find_effect(name)()
    with_wheels, without = Conditions(largest, encoders=True), Conditions(largest)
    bursts = [replace(one, bursts=True) for one in (with_wheels, without)]
    assert effect.can_show(with_wheels)
    assert [effect.can_show(one) for one in bursts] == [name == "wheel_radius", False]


def test_on_level_ground_no_slope_loads_the_wheels() -> None:
    """A candidate that cannot show costs every search."""
    largest = Largest(1.0, 1.0, 5.0, 3.0, np.linspace(0.0, 60.0, 11))
    load = find_effect("grade_load")()
    assert load.can_show(Conditions(largest, slope_rad=0.05))
    assert not load.can_show(Conditions(largest, encoders=True, slope_rad=0.01))
    assert not load.can_show(Conditions(largest, encoders=True))


@pytest.mark.long
def test_small_wheels_that_accelerate_as_cars_do_turn_faster_than_large_ones(tmp_path: Path) -> None:
    """4 m/s^2 are 78 rad/s^2 of a wheel of 5 cm: it was named a brake lag and a pause of reversals."""
    hidden = {"acceleration_limit": 78.0, "steering_lag": 0.1, "steering_gain": 0.88}
    out = tmp_path / "run.mcap"
    log = simulate_platform("f1tenth", hidden, out=out, seed=3, duration_s=120.0)
    told = _diagnose(log)
    found = {effect.id: next(iter(effect.parameters.values())).value for effect in told.effects}
    assert found == pytest.approx(hidden, rel=0.05)


@pytest.mark.long
def test_the_speed_loop_of_a_slow_robot_is_fitted_to_the_end(tmp_path: Path) -> None:
    """From a bound of 1.3 m/s, which never acts at 1 m/s, it ended beside a lag, or a gain of one side."""
    servo = {
        "tau": 0.22,
        "reset": 0.4,
        "drag": 0.055,
        "bound": 0.57,
        "no_load": 1.9,
        "scrub": 0.57,
        "creep": 0.07,
    }
    effects = {"wheel_servo": servo, "motor_imbalance": 0.22}
    scenario = Scenario(
        vehicle=VEHICLES["husky"],
        effects=effects,
        program=Program("drive_steps", step_s=4.0),
        duration_s=120.0,
        seed=15,
        disturbance=Disturbance(0.03, 0.05),
    )
    told = _diagnose_drive(scenario, tmp_path)
    named = {effect.id: effect.parameters for effect in told.effects}
    assert named.keys() == {"wheel_servo", "motor_imbalance"}
    for name in ("tau", "bound", "no_load", "scrub"):
        assert named["wheel_servo"][name].value == pytest.approx(servo[name], rel=0.05)
    assert named["motor_imbalance"]["e"].value == pytest.approx(0.22, rel=0.1)


@pytest.mark.long
def test_a_lag_behind_a_limit_is_no_torque_limit(tmp_path: Path) -> None:
    """A second limit of the same size differed by a millimetre, and was taken for what it imitated."""
    hidden = {"drive_lag": {"tau": 0.315}, "acceleration_limit": {"limit": 3.66}}
    scenario = Scenario(
        vehicle=VEHICLES["husky"],
        effects=hidden,
        program=Program("drive_steps", step_s=6.0),
        duration_s=150.0,
        seed=2,
        disturbance=Disturbance(0.03, 0.05),
    )
    told = _diagnose_drive(scenario, tmp_path)
    assert {effect.id for effect in told.effects} == {*hidden}


@pytest.mark.long
def test_a_load_taken_on_halfway_is_a_change(tmp_path: Path) -> None:
    """Seven percent less travel from a moment on, beyond any doubt, was too small for a name."""
    scenario = Scenario(
        vehicle=VEHICLES["husky"],
        effects={"terrain_change": {"k_v": 0.93, "k_w": 0.93, "at_s": 80.0}},
        duration_s=160.0,
        seed=3,
        disturbance=Disturbance(0.01, 0.01),
    )
    (named,) = _diagnose_drive(scenario, tmp_path).effects
    assert named.id == "terrain_change"
    assert named.parameters["k_v"].value == pytest.approx(0.93, abs=0.01)


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2])
def test_a_circle_one_way_does_not_decide_what_turns_it(seed: int, tmp_path: Path) -> None:
    """Sideways effects of a millimetre, which kept nothing of their promise, took the places of rivals."""
    time = np.arange(0.0, 90.0, 0.05)
    speed = np.where(time < 2.0, 0.0, 0.4)
    scenario = Scenario(
        vehicle=VEHICLES["jackal"],
        effects={"yaw_drift": {"c": 0.03}},
        duration_s=90.0,
        seed=seed,
        disturbance=Disturbance(0.01, 0.01),
        pose=PoseSensor(rate_hz=10.0, noise_m=0.004, noise_rad=0.002, drift_m=0.0, drift_rad=0.0),
        played=Commands(time, speed, speed),
    )
    told = _diagnose_drive(scenario, tmp_path)
    assert not told.effects
    (group,) = told.undecided
    assert {"wheel_asymmetry", "effective_track"} <= set(group.candidates)
