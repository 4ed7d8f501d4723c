"""What the search owes a user: wrong names that were taken first are given back."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from pipeline.core.compute import Budget
from pipeline.estimation import Input, Problem, fit_model, load_recording
from pipeline.estimation.search import choose, list_rivals, prune, search_effects
from pipeline.estimation.selection import CandidateModel, Selection, open_selection, prepare
from pipeline.job import Options
from pipeline.job.analyze import analyze_log
from pipeline.job.run_results import read_recording
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
    from pathlib import Path

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


def test_two_lags_take_the_place_of_the_delay_and_the_limits_that_imitate_them(tmp_path: Path) -> None:
    """Neither lag helps beside the delay alone, and beside both lags the limits are never reached."""
    wrong = ("body_speed_limit", "body_turn_limit", "transport_delay", "steering_gain")
    run, vehicle = _load(_CAR, tmp_path / "car")
    context = prepare([run], vehicle, Input.COMMAND)
    part = context.problem.parts[1]
    begin = context.problem.start_state()
    selection, current = open_selection(part, begin, context.list_drivetrain(), context.conditions, Budget())
    for name in wrong:
        effect = find_effect(name)().make_usual(context.largest)
        current = selection.enter(current.state.add(effect))
    found = search_effects(selection, selection.reweight(current))[0].state
    assert {effect.id: effect.values["tau"] for effect in found.effects} == pytest.approx(_LAGS, abs=0.01)


def test_a_delay_beside_limits_is_found_from_the_wrong_hollow_of_the_loss(tmp_path: Path) -> None:
    """A descent from a delay that had stood for the limits, too, ends with .6 s and limits that never act."""
    true = {"transport_delay": 0.34, "body_acceleration_limit": 1.5, "turn_acceleration_limit": 1.5}
    scenario = replace(_CAR, vehicle=VEHICLES["husky"], effects=true, program=Program("drive_steps"))
    run, vehicle = _load(replace(scenario, duration_s=90.0), tmp_path / "husky")
    context = prepare([run], vehicle, Input.COMMAND)
    part, begin = context.problem.parts[1], context.problem.start_state()
    selection, ideal = open_selection(part, begin, (), context.conditions, Budget())
    wrong = {"transport_delay": 0.7, "body_acceleration_limit": 15.0, "turn_acceleration_limit": 15.0}
    effects = [_give(name, value) for name, value in wrong.items()]
    astray = selection.enter(ideal.state.add(*effects))
    assert astray.state.effects[0].values["d"] > 0.5
    found = search_effects(selection, astray)[0].state
    assert {e.id: next(iter(e.values.values())) for e in found.effects} == pytest.approx(true, rel=0.05)


def test_a_dead_time_and_a_limited_torque_take_the_place_of_a_lag_and_a_ramp(tmp_path: Path) -> None:
    """Two effects for two, in a minute of driving: no exchange of one of them is better."""
    effects = {
        "transport_delay": 0.2,
        "torque_limit": {"tau": 0.3, "limit": 3.0},
        "effective_track": 1.8,
    }
    scenario = Scenario(vehicle=VEHICLES["husky"], effects=effects, duration_s=60.0, seed=112)
    run, vehicle = _load(scenario, tmp_path / "husky")
    context = prepare([run], vehicle, Input.COMMAND)
    part, begin = context.problem.whole, context.problem.start_state()
    candidates = context.list_candidates(Input.COMMAND)
    selection, ideal = open_selection(part, begin, candidates, context.conditions, Budget())
    found = search_effects(selection, ideal)[0].state
    assert {effect.id for effect in found.effects} == set(effects)


def test_one_effect_takes_the_place_of_the_two_that_imitate_it(tmp_path: Path) -> None:
    """A gain and a limit of the speed explain wheels that are slowed alike."""
    scenario = replace(
        _CAR,
        vehicle=VEHICLES["husky"],
        effects={"wheel_speed_scaling": 4.0},
        program=Program("drive_steps", speed_scale=1.2, turn_scale=1.2),
        duration_s=90.0,
    )
    run, vehicle = _load(scenario, tmp_path / "husky")
    context = prepare([run], vehicle, Input.COMMAND)
    part, begin = context.problem.parts[1], context.problem.start_state()
    selection, ideal = open_selection(part, begin, context.list_drivetrain(), context.conditions, Budget())
    wrong = {"drive_gain": 0.9, "body_speed_limit": 0.6}
    astray = selection.reweight(selection.enter(ideal.state.add(*(_give(*one) for one in wrong.items()))))
    common = list_rivals(selection, astray, ("drive_gain", "body_speed_limit"))
    (found,) = choose(selection, astray, common).state.effects
    assert found.id == "wheel_speed_scaling"
    assert found.values["limit"] == pytest.approx(4.0, rel=0.02)


def _give(name: str, value: float) -> Effect:
    """An effect of one number with a value."""
    effect = find_effect(name)()
    return effect.change(**{effect.parameters[0].name: value})


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
    problem = Problem(runs, vehicle, Input.MEASURED)
    assert [comparison.has_gyro for comparison in problem.comparisons] == [False, True]
    fitted = fit_model(problem, Model(vehicle, (find_effect("body_inertia")(),)))
    (effect,) = fitted.state.effects
    assert effect.values["tau"] == pytest.approx(0.52, abs=0.004)


def _open(scenario: Scenario, folder: Path) -> tuple[Selection, CandidateModel]:
    """The competition on the ground's part of a simulated drive, and the ideal model."""
    run, vehicle = _load(scenario, folder)
    context = prepare([run], vehicle, Input.COMMAND)
    part, begin = context.problem.behind_wheels.whole, context.problem.start_state()
    candidates = context.list_candidates(Input.MEASURED)
    return open_selection(part, begin, candidates, context.conditions, Budget())


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
    run, vehicle = _load(scenario, tmp_path / "car")
    context = prepare([run], vehicle, Input.COMMAND)
    part, begin = context.problem.parts[1], context.problem.start_state()
    selection, ideal = open_selection(part, begin, context.list_drivetrain(), context.conditions, Budget())
    found = search_effects(selection, ideal)[0].state
    assert {effect.id: effect.values["tau"] for effect in found.effects} == pytest.approx(_LAGS, abs=0.01)


def test_effects_of_which_either_will_do_are_not_both_dropped(tmp_path: Path) -> None:
    """Where nothing but turning on the spot was driven, radius and track are one number."""
    scenario = replace(_HUSKY, effects={"wheel_radius": 0.85}, program=Program("spins"))
    selection, ideal = _open(scenario, tmp_path / "husky")
    both = [find_effect(name)().make_usual(selection.largest) for name in ("wheel_radius", "effective_track")]
    kept = prune(selection, selection.enter(ideal.state.add(*both)))
    assert len(kept.ids) == 1


def test_an_effect_that_acts_beside_another_one_alone_is_not_named_without_it(tmp_path: Path) -> None:
    run, vehicle = _load(replace(_HUSKY, effects={"drive_lag": 0.4}), tmp_path / "husky")
    context = prepare([run], vehicle, Input.COMMAND)
    part, begin = context.problem.parts[1], context.problem.start_state()
    selection, _ = open_selection(part, begin, (), context.conditions, Budget())
    given = {"drive_lag": 0.4, "wheel_servo": 0.1, "motor_imbalance": 0.1}
    state = begin.add(*(_give(name, value) for name, value in given.items()))
    imbalance = state.find("motor_imbalance")
    assert imbalance is not None
    assert selection.may_stay(imbalance, state)
    assert not selection.may_stay(imbalance, state.drop(["wheel_servo"]))


def test_a_model_that_follows_a_drive_better_and_predicts_worse_is_not_better(tmp_path: Path) -> None:
    scenario = replace(_HUSKY, effects={"drive_lag": 0.4}, program=Program("drive_steps"))
    run, vehicle = _load(scenario, tmp_path / "husky")
    context = prepare([run], vehicle, Input.COMMAND)
    part, begin = context.problem.parts[1], context.problem.start_state()
    selection, ideal = open_selection(part, begin, (), context.conditions, Budget())
    found = selection.enter(ideal.state.add(_give("drive_lag", 0.4)))
    closer = replace(found.fit, residual=0.97 * found.fit.residual)
    assert selection.is_better(replace(found, fit=closer), found)
    # The same residuals of a long drive, by a state from which a prediction goes astray.
    astray = replace(found, fit=replace(closer, state=ideal.state))
    assert selection.loss(astray) < selection.loss(found)
    assert not selection.is_better(astray, found)
