"""What the search owes a user: wrong names that were taken first are given back."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, cast

import pytest

from pipeline.core.compute import Budget
from pipeline.estimation import Input, Problem, ambiguity, fit_model, load_recording
from pipeline.estimation.ambiguity import Reached, Undecided, choose_reaching
from pipeline.estimation.diagnosis import Value
from pipeline.estimation.parts import make_weights
from pipeline.estimation.search import choose, list_rivals, prune, restart, search_effects, simplify
from pipeline.estimation.selection import USEFUL, CandidateModel, Selection, open_selection, prepare
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

    from pipeline.estimation.fit import PartFit
    from pipeline.estimation.state import State
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


def _open_two(folder: Path) -> tuple[Selection, CandidateModel]:
    """A drive with two effects, of which nothing can take the place of the first one."""
    scenario = replace(_HUSKY, effects={"effective_track": 1.6, "icr_offset": 0.15})
    selection, ideal = _open(scenario, folder / "husky")
    # Contact friction contains a wider track.
    selection.candidates = tuple(one for one in selection.candidates if one.id != "contact_friction")
    return selection, ideal


def test_what_may_not_be_named_ends_no_search(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    selection, ideal = _open_two(tmp_path)
    allowed = selection.may_stay
    monkeypatch.setattr(
        selection,
        "may_stay",
        lambda effect, state, **how: effect.id != "effective_track" and allowed(effect, state, **how),
    )
    found, _ = search_effects(selection, ideal)
    assert "effective_track" not in found.ids
    assert "icr_offset" in found.ids


def test_what_was_refused_beside_one_model_is_tried_beside_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    selection, ideal = _open_two(tmp_path)
    reweight, allowed, asked = selection.reweight, selection.may_stay, list[tuple[str, ...]]()

    def note(tested: CandidateModel) -> CandidateModel:
        asked.append(tested.ids)
        return reweight(tested)

    def refuse_first(effect: Effect, state: State, *, as_if: bool = False) -> bool:
        adapted = [ids for ids in asked if "effective_track" in ids]
        is_first = len(adapted) == 1 and asked[-1] == adapted[0] == state.ids
        return not (is_first and effect.id == "effective_track") and allowed(effect, state, as_if=as_if)

    monkeypatch.setattr(selection, "reweight", note)
    monkeypatch.setattr(selection, "may_stay", refuse_first)
    found, _ = search_effects(selection, ideal)
    assert set(found.ids) == {"effective_track", "icr_offset"}
    assert sum("effective_track" in ids for ids in asked) > 1


def test_a_search_ends_where_it_has_been_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is added is dropped again: no set is come to twice."""
    selection, ideal = _open(_HUSKY, tmp_path / "husky")
    monkeypatch.setattr("pipeline.estimation.search.prune", lambda *_: ideal)
    found, tried = search_effects(selection, ideal)
    assert found.ids == ()
    assert tried == () or all(one.ids for one in tried)


def test_the_search_says_what_was_nearly_significant(tmp_path: Path) -> None:
    selection, ideal = _open(replace(_HUSKY, effects={}), tmp_path / "husky")
    found, tried = search_effects(selection, ideal)
    assert found.ids == ()
    assert not any(selection.judge(found, one).is_significant for one in tried)


def test_an_extension_of_which_nothing_new_is_left_is_not_fitted_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    selection, ideal = _open(_HUSKY, tmp_path / "husky")
    selection.candidates = tuple(one for one in selection.candidates if one.id == "effective_track")
    evidence, refitted = selection.take_evidence(ideal), list[object]()
    assert [one.ids for one in selection.fit_hypotheses(ideal, evidence)] == [("effective_track",)]
    monkeypatch.setattr(selection, "may_stay", lambda *_, **__: False)
    monkeypatch.setattr(selection, "enter", refitted.append)
    assert selection.fit_hypotheses(ideal, evidence) == []
    assert refitted == []


def test_a_promise_that_its_fit_does_not_keep_ends_no_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From a start far away a clock promises most, and is no more than nothing when it is fitted."""
    selection, ideal = _open(_HUSKY, tmp_path / "husky")
    evidence = selection.take_evidence(ideal)
    ranked = evidence.rank_singles(0.0)
    clock = next(one for one in ranked if one.starts[0].effect.id == "clock_offset")
    promised = replace(clock, chi_square=10.0 * ranked[0].chi_square)
    monkeypatch.setattr(evidence, "rank_singles", lambda _: [promised, *ranked])
    monkeypatch.setattr(evidence, "rank_pairs", lambda _: [])
    assert selection.is_sound(selection.enter(ideal.state.add(clock.starts[0].effect)))
    fitted = selection.fit_hypotheses(ideal, evidence)
    assert ("effective_track",) in {one.ids for one in fitted}


def test_rivals_far_from_a_model_are_fitted_roughly_and_near_ones_to_the_end(tmp_path: Path) -> None:
    """A shifted centre of rotation does not stand for the track, and is no more than nothing beside it."""
    selection, ideal = _open(_HUSKY, tmp_path / "husky")
    track, centre = _give("effective_track", 1.6), _give("icr_offset", 0.1)
    found = selection.enter(ideal.state.add(track))
    states = [ideal.state.add(centre), ideal.state.add(_give("effective_track", 1.4), centre)]
    predictions, find_residuals = list[object](), selection.part.find_residuals

    def count(state: State) -> object:
        predictions.append(state)
        return find_residuals(state)

    selection.part.find_residuals = count  # type: ignore[method-assign,assignment]
    far, near = selection.approach_each(found, states, 1.1 * selection.loss(found))
    approached = len(predictions)
    assert (far.is_rough, near.is_rough) == (True, False)
    assert selection.loss(far) > 1.1 * selection.loss(found)
    assert selection.loss(near) < 1.01 * selection.loss(found)
    values = [model.state.find("effective_track").values["k"] for model in (near, found)]  # type: ignore[union-attr]
    assert values == pytest.approx([1.6, 1.6], rel=0.02)
    selection.approach_each(found, states, 0.0)
    assert len(predictions) - approached < approached


def test_rivals_are_fitted_once_for_a_model_and_again_under_new_weights_where_they_come_near(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Where nothing but turning on the spot was driven, radius and track are one number.
    spins = replace(_HUSKY, effects={"wheel_radius": 0.85}, program=Program("spins"))
    selection, ideal = _open(spins, tmp_path / "husky")
    found = selection.reweight(selection.enter(ideal.state.add(_give("wheel_radius", 0.85))))
    rivals = list_rivals(selection, found, ("wheel_radius",))
    assert ("effective_track",) in {one.ids for one in rivals}
    assert not any("wheel_radius" in one.ids for one in rivals)
    assert list_rivals(selection, found, ("wheel_radius",)) is rivals
    asked = list[object]()
    enter_each = selection.enter_each

    def note(starts: list[PartFit], *given: float) -> list[CandidateModel]:
        asked.extend(starts)
        return enter_each(starts, *given)

    found = selection.reweight(found)
    near = [one for one in rivals if selection.loss(one) < USEFUL * selection.loss(found)]
    monkeypatch.setattr(selection, "enter_each", note)
    again = list_rivals(selection, found, ("wheel_radius",))
    assert near
    assert {one.ids for one in again} == {one.ids for one in rivals}
    assert len(asked) == len(near)
    assert all(one is other.fit for one, other in zip(asked, near, strict=True))


def test_an_effect_with_clear_evidence_is_kept_without_a_fit_of_the_model_without_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    selection, ideal = _open(_HUSKY, tmp_path / "husky")
    clear = selection.enter(ideal.state.add(_give("effective_track", 1.6)))
    dropped = list[object]()
    drop_each = selection.drop_each

    def note(current: CandidateModel, groups: list[list[str]]) -> list[CandidateModel]:
        dropped.extend(groups)
        return drop_each(current, groups)

    monkeypatch.setattr(selection, "drop_each", note)
    assert prune(selection, clear) is clear
    assert dropped == []
    useless = selection.enter(clear.state.add(_give("icr_offset", 0.01)))
    assert prune(selection, useless).ids == ("effective_track",)
    assert dropped == [["icr_offset"]]


def test_a_restart_that_promises_no_better_model_ends_early(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two limits and a delay are found again from beside their values: all are asked for a better loss."""
    true = {"transport_delay": 0.34, "body_acceleration_limit": 1.5, "turn_acceleration_limit": 1.5}
    scenario = replace(_HUSKY, effects=true, program=Program("drive_steps"))
    run, vehicle = _load(scenario, tmp_path / "husky")
    context = prepare([run], vehicle, Input.COMMAND)
    part, begin = context.problem.parts[1], context.problem.start_state()
    selection, ideal = open_selection(part, begin, (), context.conditions, Budget())
    found = selection.enter(ideal.state.add(*(_give(name, value) for name, value in true.items())))
    predictions, find_residuals, enter_each = list[object](), part.find_residuals, selection.enter_each

    def count(state: State) -> object:
        predictions.append(state)
        return find_residuals(state)

    monkeypatch.setattr(part, "find_residuals", count)
    assert restart(selection, found) is found
    early = len(predictions)
    monkeypatch.setattr(selection, "approach_each", lambda _, states, __: enter_each(states))
    assert restart(selection, found) is found
    assert early < 0.5 * (len(predictions) - early)


def test_a_speed_loop_that_was_fitted_as_a_lag_is_begun_again_as_a_loop(tmp_path: Path) -> None:
    """From no integral part none is found: its derivative with the integral gain is nothing."""
    true = {"tau": 0.2, "reset": 0.3, "drag": 0.05, "bound": 1.1, "scrub": 1.2, "creep": 0.07}
    program = Program("smooth", speed_scale=0.3, turn_scale=0.4)
    scenario = replace(_HUSKY, vehicle=VEHICLES["warthog"], effects={"wheel_servo": true}, program=program)
    run, vehicle = _load(scenario, tmp_path / "warthog")
    context = prepare([run], vehicle, Input.COMMAND)
    part, begin = context.problem.parts[1], context.problem.start_state()
    selection, ideal = open_selection(part, begin, (), context.conditions, Budget())
    servo = find_effect("wheel_servo")(tau=1.0, reset=0.0, drag=0.0, bound=1.5, scrub=0.1, creep=0.07)
    lag = selection.enter(ideal.state.add(servo))
    begun = restart(selection, lag)
    assert selection.loss(begun) < 0.5 * selection.loss(lag)
    (found,) = begun.state.effects
    assert found.values["reset"] == pytest.approx(0.3, rel=0.15)
    assert found.values["scrub"] == pytest.approx(1.2, rel=0.15)


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


def test_a_model_without_an_effect_is_fitted_anew_under_other_weights(tmp_path: Path) -> None:
    scenario = replace(_HUSKY, effects={"drive_lag": 0.4}, program=Program("drive_steps"))
    run, vehicle = _load(scenario, tmp_path / "husky")
    context = prepare([run], vehicle, Input.COMMAND)
    part, begin = context.problem.parts[1], context.problem.start_state()
    selection, ideal = open_selection(part, begin, (), context.conditions, Budget())
    found = selection.enter(ideal.state.add(_give("drive_lag", 0.4)))
    before = selection.drop(found, ["drive_lag"])
    assert selection.drop(found, ["drive_lag"]) is before
    selection.take_weights(make_weights(found.fit.residual, part))
    after = selection.drop(found, ["drive_lag"])
    assert after.fit.weights is selection.weights is not before.fit.weights


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


def test_a_rival_takes_as_much_off_the_loss_as_a_name_must(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    selection, ideal = _open(_HUSKY, tmp_path / "husky")
    idle = selection.enter(ideal.state.add(find_effect("lateral_skid")().make_usual(selection.largest)))
    asked = list[float]()

    def note(_base: CandidateModel, _evidence: object, _least: float, useful: float) -> list[CandidateModel]:
        asked.append(useful)
        return []

    monkeypatch.setattr(selection, "fit_hypotheses", note)
    list_rivals(selection, idle, ("lateral_skid",))
    assert asked[0] < selection.loss(selection.drop(idle, ["lateral_skid"]))


@pytest.mark.parametrize("order", [("deadband", "turn_lag"), ("turn_lag", "deadband")])
def test_alternatives_are_compared_with_the_best_in_any_order(
    order: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    errors = {"drive_lag": 1.0, "deadband": 1.4, "turn_lag": 0.5}
    monkeypatch.setattr(ambiguity, "_measure_reached", lambda _, effects: Reached(errors[effects[0].id]))
    numbers = {
        name: {p.name: Value(1.0, 1.0, 1.0, "") for p in find_effect(name).parameters} for name in order
    }
    group = Undecided(("drive_lag", *order), "", numbers)
    chosen, groups = choose_reaching(cast("Problem", None), [find_effect("drive_lag")()], [group])
    assert [effect.id for effect in chosen] == ["turn_lag"]
    assert groups == []


def test_special_cases_that_were_refused_are_not_tried_again(tmp_path: Path) -> None:
    """A wider track alone: contact friction gives way to it, unless it may not be named."""
    scenario = replace(_HUSKY, effects={"effective_track": 1.6, "body_inertia": 0.15})
    selection, ideal = _open(scenario, tmp_path / "husky")
    whole = find_effect("contact_friction")(friction=5.0, creep=1.5, k=1.6, gyration=0.6)
    sliding = selection.reweight(selection.enter(ideal.state.add(whole)))
    assert set(simplify(selection, sliding, set()).ids) == {"effective_track", "body_inertia"}
    assert simplify(selection, sliding, {"effective_track"}) is sliding


def test_what_predicts_two_seconds_far_worse_is_no_alternative(tmp_path: Path) -> None:
    scenario = replace(_CAR, effects={"drive_lag": 0.45}, program=Program("drive_steps"), duration_s=60.0)
    run, vehicle = _load(scenario, tmp_path / "run")
    problem = Problem([run], vehicle, Input.COMMAND)
    lag = find_effect("drive_lag")(tau=0.45)

    def beside(name: str, **values: float) -> list[tuple[str, ...]]:
        numbers = {name: {key: Value(value, value, value, "") for key, value in values.items()}}
        chosen, groups = choose_reaching(problem, [lag], [Undecided(("drive_lag", name), "", numbers)])
        assert [effect.id for effect in chosen] == ["drive_lag"]
        return [item.candidates for item in groups]

    assert beside("deadband", d=0.15) == []
    assert beside("brake_lag", tau_drive=0.45, tau_brake=0.46) == [("drive_lag", "brake_lag")]
