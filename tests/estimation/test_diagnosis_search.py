"""What the search owes a user: wrong names that were taken first are given back."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.estimation import EstimationData, Input, fit_model, load_recording
from pipeline.estimation.decision import Search
from pipeline.estimation.estimation_data import prepare_data
from pipeline.estimation.fit import fit_path
from pipeline.estimation.path_residuals import BodyResiduals
from pipeline.estimation.stored_diagnosis import read_recording
from pipeline.models import Model, find_effect
from pipeline.simulate import (
    VEHICLES,
    Disturbance,
    Imu,
    PoseSensor,
    Program,
    Scenario,
    simulate_run,
    write_log,
)

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from pipeline.estimation.candidates import Candidate
    from pipeline.estimation.model_state import ModelState
    from pipeline.models import Effect
    from pipeline.run import MotionRun
    from pipeline.sources import Vehicle

_LAGS = {"drive_lag": 0.45, "steering_lag": 0.38}
_CAR = Scenario(
    vehicle=VEHICLES["car"],
    effects=_LAGS,
    program=Program("circle", speed_scale=0.4, turn_scale=0.4),
    duration_s=40.0,
    seed=5,
    disturbance=Disturbance(0.01, 0.005),
    pose=PoseSensor(),
    imu=Imu(),
)


def _load(scenario: Scenario, folder: Path) -> tuple[MotionRun, Vehicle]:
    folder.mkdir()
    write_log(simulate_run(scenario), folder / "run.mcap")
    options = Options(out=folder / "out", report=False, diagnosis=False)
    vehicle, recording = read_recording(analyze_log(folder / "run.mcap", options).manifest)
    return load_recording(recording, vehicle), vehicle


def _prepare(scenario: Scenario, folder: Path) -> EstimationData:
    run, vehicle = _load(scenario, folder)
    return prepare_data([run], vehicle, Input.COMMAND)


def _search(
    data: EstimationData, effects: Sequence[Effect], candidates: Sequence[Candidate] = ()
) -> ModelState:
    """What a search of the drivetrain names that begins at a model."""
    candidates = candidates or data.list_drivetrain()
    search = Search(data.paths[1], tuple(candidates), data.conditions)
    found = search.run(data.start_state(effects))
    return found.final.state.hold([one for one in found.final.state.effects if one.id in found.new])


def _give(name: str, value: float) -> Effect:
    """An effect of one number with a value."""
    effect = find_effect(name)()
    return effect.change(**{effect.parameters[0].name: value})


def test_two_lags_take_the_place_of_the_delay_and_the_limits_that_imitate_them(tmp_path: Path) -> None:
    """Neither lag helps beside the delay alone, and beside both lags the limits are never reached."""
    names = ("body_speed_limit", "body_turn_limit", "transport_delay", "steering_gain")
    data = _prepare(_CAR, tmp_path / "car")
    found = _search(data, [find_effect(name)().make_usual(data.largest) for name in names])
    assert {effect.id: effect.values["tau"] for effect in found.effects} == pytest.approx(_LAGS, abs=0.01)


def test_a_delay_beside_limits_is_found_from_the_wrong_hollow_of_the_loss(tmp_path: Path) -> None:
    """A descent from a delay that had stood for the limits, too, ends with .6 s and limits that never act."""
    true = {"transport_delay": 0.34, "body_acceleration_limit": 1.5, "turn_acceleration_limit": 1.5}
    scenario = replace(_CAR, vehicle=VEHICLES["husky"], effects=true, program=Program("drive_steps"))
    data = _prepare(replace(scenario, duration_s=90.0), tmp_path / "husky")
    wrong = {"transport_delay": 0.7, "body_acceleration_limit": 15.0, "turn_acceleration_limit": 15.0}
    found = _search(data, [_give(*one) for one in wrong.items()])
    assert {e.id: next(iter(e.values.values())) for e in found.effects} == pytest.approx(true, rel=0.05)


@pytest.mark.long
def test_a_dead_time_and_a_limited_torque_take_the_place_of_a_lag_and_a_ramp(tmp_path: Path) -> None:
    """Two effects for two, in a minute of driving: no exchange of one of them is better."""
    effects = {
        "transport_delay": 0.2,
        "torque_limit": {"tau": 0.3, "limit": 3.0},
        "effective_track": 1.8,
    }
    scenario = Scenario(vehicle=VEHICLES["husky"], effects=effects, duration_s=60.0, seed=112)
    data = _prepare(scenario, tmp_path / "husky")
    whole = BodyResiduals(data.residuals_by_run)
    search = Search(whole, data.list_candidates(Input.COMMAND), data.conditions)
    assert set(search.run(data.start_state()).new) == set(effects)


def test_one_effect_takes_the_place_of_the_two_that_imitate_it(tmp_path: Path) -> None:
    """A gain and a limit of the speed explain wheels that are slowed alike."""
    scenario = replace(
        _CAR,
        vehicle=VEHICLES["husky"],
        effects={"wheel_speed_scaling": 4.0},
        program=Program("drive_steps", speed_scale=1.2, turn_scale=1.2),
        duration_s=90.0,
    )
    data = _prepare(scenario, tmp_path / "husky")
    wrong = {"drive_gain": 0.9, "body_speed_limit": 0.6}
    (found,) = _search(data, [_give(*one) for one in wrong.items()]).effects
    assert found.id == "wheel_speed_scaling"
    assert found.values["limit"] == pytest.approx(4.0, rel=0.02)


def test_a_run_without_a_usable_gyro_leaves_the_clock_of_another_run_free(tmp_path: Path) -> None:
    """A straight drive dates nothing by its gyro; the encoders' delay of the turning run went into a lag."""
    runs = []
    for name, seed in (("straight", 3), ("smooth", 4)):
        scenario = replace(
            _CAR,
            vehicle=VEHICLES["jackal"],
            effects={"body_inertia": 0.52},
            program=Program(name),  # type: ignore[arg-type]
            seed=seed,
        )
        run, vehicle = _load(scenario, tmp_path / name)
        runs.append(run)
    data = EstimationData(runs, vehicle, Input.MEASURED)
    assert [run_residuals.has_gyro for run_residuals in data.residuals_by_run] == [False, True]
    fitted = fit_model(data, Model(vehicle, (find_effect("body_inertia")(),)))
    (effect,) = fitted.state.effects
    assert effect.values["tau"] == pytest.approx(0.52, abs=0.004)


_HUSKY = replace(
    _CAR,
    vehicle=VEHICLES["husky"],
    effects={"effective_track": 1.6},
    program=Program("teleop"),
    duration_s=90.0,
)


def test_two_lags_of_a_car_are_found_together(tmp_path: Path) -> None:
    """One of them alone is imitated by a delay; the pair is better than any pair with a delay."""
    scenario = replace(
        _CAR, program=Program("drive_steps", speed_scale=0.6, turn_scale=0.6), duration_s=120.0
    )
    found = _search(_prepare(scenario, tmp_path / "car"), ())
    assert {effect.id: effect.values["tau"] for effect in found.effects} == pytest.approx(_LAGS, abs=0.01)


def test_effects_of_which_either_will_do_are_not_both_dropped(tmp_path: Path) -> None:
    """Where nothing but turning on the spot was driven, radius and track are one number."""
    scenario = replace(_HUSKY, effects={"wheel_radius": 0.85}, program=Program("spins"))
    data = _prepare(scenario, tmp_path / "husky")
    names = ("wheel_radius", "effective_track")
    both = [find_effect(name)().make_usual(data.largest) for name in names]
    search = Search(data.paths[0], (), data.conditions)
    assert len(search.run(data.start_state(both)).new) == 1


def test_an_effect_that_acts_beside_another_one_alone_is_no_candidate_without_it(tmp_path: Path) -> None:
    data = _prepare(replace(_HUSKY, effects={"drive_lag": 0.4}), tmp_path / "husky")
    search = Search(data.paths[1], data.list_drivetrain(), data.conditions)
    fit = fit_path(search.path, data.start_state([_give("drive_lag", 0.4)]))
    assert "motor_imbalance" in {one.id for one in search.candidates}
    assert "motor_imbalance" not in {trial.effect.id for trial in search.make_matrix(fit).trials}
    assert find_effect("motor_imbalance")().acts_in(("wheel_servo",))
