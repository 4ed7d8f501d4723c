"""What a plan expects of evidence, and that a drive with hidden physics brings it."""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import msgspec
import numpy as np
import pytest
from motion_runs import simulate
from numpy.typing import NDArray
from plan_game import draw_scenario, record
from scipy.special import stdtrit
from verbs import run_verb

from pipeline.estimation import EstimationData, Input, load_recording
from pipeline.models import Excitation, find_effect
from pipeline.plan import Commands, DrivenRange, choose_limits
from pipeline.plan.plan import ExpectedGain
from pipeline.plan.plan_files import StoredPlan, check_plan
from pipeline.plan.questions import DECIDED_T, Answerable, Evidence, Groups, Precision, Separation, ask_apart
from pipeline.plan.rehearsal import Hypothesis, Rehearsal, Senses, assume, learn, measure_driven_range
from pipeline.results import Named, RunDiagnosis, Undecided, Unobservable, Value
from pipeline.simulate import Program, find_vehicle
from pipeline.sources import find_preset


def test_what_a_refit_leaves_is_the_residual_of_least_squares() -> None:
    generator = np.random.default_rng(1)
    groups, rows, numbers = 4, 30, 3
    columns = generator.standard_normal((groups, rows, numbers))
    apart = generator.standard_normal((groups, rows))
    weak = 1e-9 * np.eye(numbers)
    evidence = Evidence(
        np.einsum("grp,grq->gpq", columns, columns),
        np.einsum("grp,gr->gp", columns, apart),
        (apart**2).sum(axis=1),
        weak,
    )
    _, left, *_ = np.linalg.lstsq(columns.reshape(-1, numbers), apart.reshape(-1), rcond=None)
    assert evidence.separate(np.ones(groups)).sum() == pytest.approx(float(left[0]), rel=1e-6)


def test_a_decision_needs_several_stretches_however_large_one_is() -> None:
    model = Hypothesis((), (), np.zeros((0, 0)))
    question = Separation("a or b", ("a", "b"), (model, model), both_ways=False)
    plenty = np.array([1e6, 1.0, 1.0, 1.0])
    evidence = Evidence(np.zeros((4, 0, 0)), np.zeros((4, 0)), plenty, np.zeros((0, 0)))
    groups = Groups(np.full(4, 10.0), np.arange(4))
    assert Answerable(question, (evidence,), groups).measure(np.ones(4)) > DECIDED_T
    assert Answerable(question, (evidence,), groups).answer(np.ones(4)) < 0.5
    even = Evidence(np.zeros((4, 0, 0)), np.zeros((4, 0)), np.full(4, 1e3), np.zeros((0, 0)))
    assert Answerable(question, (even,), groups).answer(np.ones(4)) == 1.0
    assert Answerable(question, (even,), groups).answer(np.array([1.0, 1.0, 0.0, 0.0])) < 1.0


def test_the_evidence_of_the_logs_so_far_counts() -> None:
    model = Hypothesis((), (), np.zeros((0, 0)))
    # Four stretches of a drive that alone reach t = 3.
    evidence = Evidence(np.zeros((4, 0, 0)), np.zeros((4, 0)), np.full(4, 9.0), np.zeros((0, 0)))
    groups, drive = Groups(np.full(4, 10.0), np.arange(4), before_s=60.0), np.ones(4)
    for now, reached in ((0.0, 3.0), (4.0, 5.0)):
        question = Separation("a or b", ("a", "b"), (model, model), both_ways=False, now=now)
        one = Answerable(question, (evidence,), groups)
        assert float(one.measure(drive)) == pytest.approx(reached)
        assert (float(one.answer(drive)) >= 1.0) == (reached >= DECIDED_T)
        # Three times the drive decides also what the logs say nothing of.
        assert float(one.answer(3.0 * drive)) == 1.0


def test_an_interval_starts_from_what_the_diagnosis_states() -> None:
    model = Hypothesis((), (), np.zeros((0, 0)))
    evidence = Evidence(np.full((8, 1, 1), 100.0), np.zeros((8, 1)), np.zeros(8), np.array([[800.0]]))
    groups, drive = Groups(np.full(8, 7.0), np.arange(8), before_s=56.0), np.ones(8)
    plain, wide = (
        Answerable(Precision("k", ("k",), model, 0, 0.01, now), (evidence,), groups) for now in (0.0, 1.0)
    )
    assert float(wide.measure(0.0 * drive)) == pytest.approx(1.0)
    # As much driving again narrows both by the same factor.
    narrowed = [float(one.measure(drive) / one.measure(0.0 * drive)) for one in (plain, wide)]
    assert narrowed[0] == pytest.approx(narrowed[1])
    assert 0.6 < narrowed[0] < 0.75


def test_what_is_named_is_kept_apart_from_what_looks_like_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Either lag of a car that only drove a circle may be a delay, until both are driven differently."""
    scenario = draw_scenario(2003)[1]
    assert sorted(scenario.effects) == ["drive_lag", "steering_lag"]
    vehicle, recording = record(scenario, tmp_path / "circle.mcap")
    effects = [find_effect(name)() for name in ("drive_lag", "steering_lag")]
    knowledge = learn([load_recording(recording, vehicle)], vehicle, effects)
    asked = {question.text: question for question in ask_apart(knowledge)}
    assert set(asked) == {"drive_lag or acceleration_limit", "steering_lag or transport_delay"}
    with monkeypatch.context() as patch:
        # Half a minute tells both from one delay, with twice the evidence that it takes.
        patch.setattr("pipeline.plan.questions.DECIDED_T", 2.5 * DECIDED_T)
        asked = {question.text: question for question in ask_apart(knowledge)}
    both = asked["drive_lag and steering_lag or transport_delay"]
    assert [model.names for model in both.models] == [{"drive_lag", "steering_lag"}, {"transport_delay"}]
    assert not any("steering_lag" in one.effects for one in ask_apart(knowledge, ["steering_lag"]))
    # A log that tells them apart leaves nothing to ask.
    program = Program("drive_steps")
    vehicle, recording = record(replace(scenario, program=program, duration_s=90.0), tmp_path / "long.mcap")
    knowledge = learn([load_recording(recording, vehicle)], vehicle, effects)
    assert ask_apart(knowledge) == []


def test_an_interval_is_promised_only_where_few_blocks_would_show_it_too() -> None:
    """The jackknife of few blocks scatters: simulated here, nineteen of twenty stay below the bound."""
    model = Hypothesis((), (), np.zeros((0, 0)))
    question = Precision("k", ("k",), model, 0, 1.0, 1.0)
    blocks = 10
    evidence = Evidence(np.ones((blocks, 1, 1)), np.zeros((blocks, 1)), np.zeros(blocks), 1e-9 * np.eye(1))
    one = Answerable(question, (evidence,), Groups(np.full(blocks, 7.0), np.arange(blocks)))
    draws = np.random.default_rng(0).standard_normal((4000, blocks))
    stated = stdtrit(blocks - 1.0, 0.975) * draws.std(axis=1, ddof=1) / np.sqrt(blocks)
    every = np.ones(blocks)
    assert np.mean(stated <= one.bound(every)) == pytest.approx(0.95, abs=0.01)
    assert np.mean(stated <= one.measure(every)) < 0.65


def test_draws_stay_inside_the_bounds_and_spread_as_is_known() -> None:
    vehicle = find_preset("husky_a200")
    assert vehicle is not None
    lag = find_effect("drive_lag")(tau=0.3)
    model = assume(vehicle).suppose([lag])
    generator = np.random.default_rng(0)
    drawn = [next(iter(model.draw(generator)[0].values.values())) for _ in range(300)]
    assert min(drawn) >= lag.parameter("tau").bounds[0]
    assert np.std(drawn) > 0.1


def _diagnose(effects: tuple[str, ...] = (), undecided: tuple[tuple[str, ...], ...] = ()) -> RunDiagnosis:
    named = tuple(Named(name, {"k": Value(1.5, 1.48, 1.52, "1")}, 0.5) for name in effects)
    return RunDiagnosis("run", "command", effects=named, undecided=tuple(Undecided(one) for one in undecided))


def test_promises_are_checked_against_what_came_out() -> None:
    pair = ExpectedGain("a or b", ("a", "b"), "separation", 5.0, 0.0, 6.0, 20.0, 1)
    narrow = ExpectedGain("a.k within 0.03", ("a",), "interval", 0.03, 0.1, 0.02, 20.0, 1)
    tight = replace(narrow, question="a.k within 0.01", goal=0.01, expected=0.01)
    plan = StoredPlan("husky", [], [pair, narrow, tight])
    assert [one.is_met for one in check_plan(plan, _diagnose(("a",))).answers] == [True, True, False]
    still = check_plan(plan, _diagnose((), (("a", "b"),)))
    assert [one.is_met for one in still.answers] == [False, False, False]
    # Beside what is named a rival may not be seen: that decides; with nothing named it does not.
    hidden = {"b": Unobservable("collinear with what was named")}
    told = check_plan(plan, msgspec.structs.replace(_diagnose(("a",)), unobservable_why=hidden)).answers[0]
    assert (told.is_met, told.measured) == (True, "a")
    assert (
        not check_plan(plan, msgspec.structs.replace(_diagnose(), unobservable_why=hidden)).answers[0].is_met
    )


def _run(*arguments: str | Path, code: int = 0) -> str:
    done = run_verb(*arguments)
    assert done.returncode == code, done.stderr
    return done.stdout if code == 0 else done.stderr


@pytest.mark.long
def test_a_plan_for_nothing_says_what_it_needs(tmp_path: Path) -> None:
    assert "--vehicle" in _run("plan", "--folder", tmp_path / "plan", code=1)
    assert "this is not a plan" not in _run("plan", "--check", tmp_path / "gone", "x.mcap", code=1)
    (tmp_path / "plan.toml").write_text("vehicle = 3\n", encoding="utf-8")
    assert "this is not a plan" in _run("plan", "--check", tmp_path / "plan.toml", "x.mcap", code=1)
    assert not (tmp_path / "plan").exists()


@pytest.mark.long
def test_a_circle_leaves_open_what_the_plan_then_decides(tmp_path: Path) -> None:
    """Log, plan, drive of the plan with the hidden physics, check: as a user does it."""
    hidden = [
        argument
        for effect in ("effective_track=1.6", "drive_lag=0.25", "icr_offset=0.08")
        for argument in ("--effect", effect)
    ]
    before, after, folder = tmp_path / "circle.mcap", tmp_path / "drive.mcap", tmp_path / "plan"
    _run(
        "simulate", *hidden, "--program", "circle", "--vehicle", "husky", "--duration", "40", "--file", before
    )
    made = json.loads(_run("plan", before, "--results", tmp_path / "results", "--folder", folder, "--json"))
    pairs = [one for one in made["promises"] if "expected_t" in one]
    assert any("icr_offset" in one["effects"] for one in pairs)
    assert made["topic"] == "/controller/cmd_vel"
    assert made["duration_s"] <= 60.0
    _run(
        "simulate",
        *hidden,
        "--vehicle",
        "husky",
        "--seed",
        "5",
        "--play",
        folder / "plan.mcap",
        "--file",
        after,
    )
    checked = json.loads(_run("plan", "--check", folder, after, "--results", tmp_path / "results", "--json"))
    decided = [
        one["question"] for one in made["promises"] if one["decided_after_s"] or one["kind"] == "interval"
    ]
    assert [one["question"] for one in checked["kept"]] == decided
    assert all(one["kept"] for one in checked["kept"])
    rivals = [one for one in checked["kept"] if {"or", "icr_offset"} <= set(one["question"].split())]
    assert {one["measured"] for one in rivals} == {"icr_offset"}
    assert checked["next"] is None
    own = _run("plan", "--check", folder, before, "--results", tmp_path / "results", code=1)
    assert "no stretch of these commands matches the plan" in own
    toml = folder / "plan.toml"
    toml.write_text(toml.read_text("utf-8").replace('"husky', '"warthog', 1), "utf-8")
    assert "the plan is for warthog" in _run(
        "plan", "--check", folder, after, "--results", tmp_path / "results", code=1
    )


def _answer(
    names: tuple[str, ...],
    normal: list[float],
    prior: float,
    excited: Mapping[Excitation, NDArray[np.bool_]] = MappingProxyType({}),
) -> Answerable:
    """A question on one number, with this information of groups of ten seconds and of the logs so far."""
    model = Hypothesis(tuple(find_effect(name)() for name in names), (), np.zeros((0, 0)))
    question = Precision("k", names, model, 0, 0.1, 0.1)
    size = len(normal)
    evidence = Evidence(
        np.array(normal).reshape(-1, 1, 1), np.zeros((size, 1)), np.zeros(size), np.array([[prior]])
    )
    return Answerable(question, (evidence,), Groups(np.full(size, 10.0), np.arange(size), 20.0, excited))


@pytest.mark.parametrize("effect", ["wheel_radius", "effective_track", "lateral_drift", "yaw_misalignment"])
def test_nothing_is_promised_without_what_its_effect_declares_to_need(effect: str) -> None:
    excited = {need: np.ones((8, 1), dtype=bool) for need in Excitation}
    drive = np.ones(8)
    assert float(_answer((effect,), [2500.0] * 8, 2500.0, excited=excited).answer(drive)) == 1.0
    for need in find_effect(effect).needs:
        lacking = {**excited, need: np.zeros((8, 1), dtype=bool)}
        one = _answer((effect,), [2500.0] * 8, 2500.0, excited=lacking)
        assert float(one.answer(drive)) < 1.0


def test_what_commands_excite_is_read_off_them() -> None:
    vehicle = find_preset("husky_a200")
    assert vehicle is not None
    still, drive = np.zeros(100), np.full(100, 0.5)
    # Ten seconds of spinning to the left, then of driving forward.
    commands = Commands(np.append(still, drive), np.append(drive, still))
    rehearsal = Rehearsal(commands, vehicle, Senses(), np.zeros(1))
    excited = rehearsal.find_excitation(np.array([0.0, 5.0, 10.0]))
    assert excited[Excitation.DRIVING].tolist() == [[False], [True]]
    assert excited[Excitation.TURNING].tolist() == [[True, False], [False, False]]
    assert excited[Excitation.BOTH_SIGNS].tolist() == [[False, False], [True, False]]
    # Level ground has no slopes, and how large a command must be is told by the information on a question.
    assert not {Excitation.SLOPE, Excitation.LARGE, Excitation.SMALL} & {*excited}


def test_limits_are_what_the_runs_reached() -> None:
    vehicle = find_preset("husky_a200")
    assert vehicle is not None
    reached = DrivenRange(0.6, 0.4, 1.7, 0.2)
    limits = choose_limits(vehicle, reached)
    assert (limits.speed_mps, limits.turn) == (0.6, 0.4)
    assert (limits.acceleration_mps2, limits.lateral_mps2) == (1.7, 0.2)
    assert reached.list_used(limits) == ["speed", "yaw rate", "acceleration", "sideways"]
    # What is asked for goes before, and the vehicle's own limits before both.
    asked = choose_limits(vehicle, reached, speed_mps=50.0, acceleration_mps2=0.3, lateral_mps2=5.0)
    assert asked.speed_mps == vehicle.max_speed_mps
    assert (asked.acceleration_mps2, asked.lateral_mps2, asked.turn) == (0.3, 5.0, 0.4)
    # A run that only turned has reached no speed.
    assert choose_limits(vehicle, DrivenRange(yaw_rate_radps=0.4)).speed_mps == vehicle.max_speed_mps


@pytest.mark.parametrize(("speed", "turn"), [(0.3, 0.5), (0.8, 0.2)])
def test_what_a_run_reached_is_measured(speed: float, turn: float) -> None:
    slow = replace(find_vehicle("husky"), max_speed_mps=speed, max_turn_radps=turn)
    made = simulate({}, duration_s=60.0, vehicle=slow, program=Program("smooth"))
    preset = find_preset("husky_a200")
    assert preset is not None
    reached = measure_driven_range(EstimationData([made], preset, Input.COMMAND))
    assert 0.5 * speed < reached.speed_mps <= 1.01 * speed
    assert 0.5 * turn < reached.yaw_rate_radps <= 1.01 * turn
    assert 0.05 < reached.acceleration_mps2 < 3.0
    assert not reached.lateral_mps2 > speed * turn
