"""What a plan expects of evidence, and that a drive with hidden physics brings it."""

import json
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from plan_game import record
from scipy.special import stdtrit
from verbs import run_verb

import slip
from pipeline.analysis import Options
from pipeline.api import suggest_plan
from pipeline.api.drives import PlannedDrive
from pipeline.cli.screen import format_run
from pipeline.estimation.stored_diagnosis import read_stored_diagnosis
from pipeline.models import Largest, Number, find_effect
from pipeline.plan import (
    FILES,
    PlanError,
    Studied,
    check_plan,
    choose_limits,
    choose_topic,
    list_commands,
    make_plan,
    parse_area,
    study,
)
from pipeline.plan.plan import DECIDED_T, Assessment, Question, find_strength
from pipeline.plan.plan_files import StoredPlan
from pipeline.results import Named, RunDiagnosis, Undecided, Unobservable
from pipeline.simulate import Program, make_scenario
from pipeline.sources import find_preset

ONE = Question("a.k within 0.01", ("a",), "interval", 0.01, rows=((0,),))
ACTS = Question("whether a acts", ("a",), "presence", DECIDED_T, rows=((0,),))


def _assess(known: float, blocks: list[float], before_s: float = 0.0) -> Assessment:
    """One number, and one manoeuvre of these blocks."""
    shown = np.array(blocks).reshape(-1, 1, 1)
    return Assessment(known * np.eye(1), shown, np.zeros(len(blocks), np.int64), before_s)


def test_the_strength_of_one_number_is_what_a_refit_of_the_others_leaves() -> None:
    generator = np.random.default_rng(1)
    columns = generator.standard_normal((120, 4))
    _, left, *_ = np.linalg.lstsq(columns[:, :3], columns[:, 3], rcond=None)
    assert find_strength(columns.T @ columns, [(0, 1, 2, 3)]) == pytest.approx(float(left[0]), rel=1e-6)
    # Of several, the weakest.
    both = find_strength(columns.T @ columns, [(0, 1, 2, 3), (1, 2, 3, 0)])
    assert both <= find_strength(columns.T @ columns, [(0, 1, 2, 3)])


def test_a_decision_needs_several_stretches_however_large_one_is() -> None:
    uneven, even = _assess(1e-9, [1e6, 1.0, 1.0, 1.0]), _assess(1e-9, [1e3] * 4)
    told, share = uneven.expect(ACTS, np.ones(1))
    assert told.expected > DECIDED_T
    assert share < 0.5
    assert even.expect(ACTS, np.ones(1))[1] == 1.0


def test_evidence_for_an_effect_is_that_of_the_drive_alone() -> None:
    """The runs so far were not enough to see it, whatever they were expected to show."""
    told, _ = _assess(1e4, [36.0] * 4, before_s=60.0).expect(ACTS, np.ones(1))
    assert told.expected == pytest.approx(0.5 * np.sqrt(4 * 36.0))


def test_an_interval_starts_from_what_the_diagnosis_states() -> None:
    known = _assess(800.0, [100.0] * 8, before_s=56.0)
    for now in (0.1, 1.0):
        wide = replace(ONE, now=now)
        assert known.expect(wide, np.zeros(1))[0].expected == pytest.approx(now, rel=0.2)
        # As much driving again.
        narrowed = known.expect(wide, np.ones(1))[0]
        assert 0.6 < narrowed.expected / known.expect(wide, np.zeros(1))[0].expected < 0.75
        assert narrowed.expected < narrowed.at_most


def test_an_interval_is_promised_only_where_few_blocks_would_show_it_too() -> None:
    """The jackknife of few blocks scatters: simulated here, nineteen of twenty stay below the bound."""
    blocks = 10
    told, _ = _assess(1e-9, [1.0] * blocks).expect(ONE, np.ones(1))
    draws = np.random.default_rng(0).standard_normal((4000, blocks))
    stated = stdtrit(blocks - 1.0, 0.975) * draws.std(axis=1, ddof=1) / np.sqrt(blocks)
    assert np.mean(stated <= told.at_most) == pytest.approx(0.95, abs=0.01)
    assert np.mean(stated <= told.expected) < 0.65


def _diagnose(effects: tuple[str, ...] = (), undecided: tuple[tuple[str, ...], ...] = ()) -> RunDiagnosis:
    named = tuple(Named(name, {"k": Number(1.5, 1.48, 1.52, "1")}, 0.5) for name in effects)
    return RunDiagnosis("run", "command", effects=named, undecided=tuple(Undecided(one) for one in undecided))


def _list_kept(plan: StoredPlan, diagnosis: RunDiagnosis) -> list[object]:
    return [one["kept"] for one in check_plan(plan, diagnosis).outcomes]


def test_promises_are_checked_against_what_came_out() -> None:
    pair = Question("a or b", ("a", "b"), "separation", DECIDED_T, expected=6.0)
    narrow, tight = (replace(ONE, expected=0.9 * most, at_most=most) for most in (0.03, 0.01))
    plan = StoredPlan("husky", [], [pair, narrow, tight])
    assert _list_kept(plan, _diagnose(("a",))) == [True, True, False]
    still = check_plan(plan, _diagnose((), (("a", "b"),)))
    assert [one["measured"] for one in still.outcomes] == ["still open", "not found", "not found"]
    assert still.open[0].startswith("a or b: ")
    # Beside what is named a rival may not be seen: that decides; with nothing named it does not.
    hidden = {"b": Unobservable("collinear with what was named")}
    told = check_plan(plan, msgspec.structs.replace(_diagnose(("a",)), unobservable_why=hidden)).outcomes[0]
    assert (told["kept"], told["measured"]) == (True, "a")
    assert not _list_kept(plan, msgspec.structs.replace(_diagnose(), unobservable_why=hidden))[0]


def test_what_a_straight_drive_hides_is_what_the_plan_decides(tmp_path: Path) -> None:
    """Half a minute straight ahead shows nothing of turning, nor whether a lag is that of turning too."""
    scenario = make_scenario(None, {"drive_lag": {"tau": 0.3}}, seed=3, duration_s=30.0, vehicle="husky")
    straight = replace(scenario, program=Program("straight", speed_scale=0.4, turn_scale=0.4))
    vehicle, recording = record(straight, tmp_path / "straight.mcap")
    studied = study([recording], vehicle)
    limits = choose_limits(vehicle, studied.largest)
    plan = make_plan(studied, limits, parse_area("20x10m", vehicle), 60.0, choose_topic(vehicle))
    decided = {name for one in plan.decided for name in one.effects}
    assert {"drive_lag", "turn_lag", "lateral_skid", "icr_offset"} <= decided
    assert {name for name, _ in plan.manoeuvres} - {"straight with steps of speed"}


def test_limits_are_what_the_runs_commanded() -> None:
    vehicle = find_preset("husky_a200")
    assert vehicle is not None
    driven = Largest(0.6, 0.4, 3.0, 1.0, np.zeros(11))
    limits = choose_limits(vehicle, driven)
    assert (limits.speed_mps, limits.turn) == (0.6, 0.4)
    # What is asked for goes before, and the vehicle's own limits before both.
    asked = choose_limits(vehicle, driven, speed_mps=50.0, acceleration_mps2=0.3)
    assert asked.speed_mps == vehicle.max_speed_mps
    assert (asked.acceleration_mps2, asked.turn) == (0.3, 0.4)
    # A run that only turned has reached no speed.
    turned = choose_limits(vehicle, Largest(0.0, 0.4, 3.0, 1.0, np.zeros(11)))
    assert turned.speed_mps == vehicle.max_speed_mps
    unknown = msgspec.structs.replace(vehicle, max_speed_mps=None)
    with pytest.raises(PlanError, match="--max-speed"):
        choose_limits(unknown)


def test_without_a_run_every_effect_of_the_vehicle_is_open() -> None:
    vehicle = find_preset("car")
    assert vehicle is not None
    limits, area = choose_limits(vehicle, speed_mps=4.0), parse_area("80x60m", vehicle)
    plan = make_plan(Studied(vehicle), limits, area, 120.0, choose_topic(vehicle))
    asked = {name for one in plan.questions for name in one.effects}
    assert {"understeer", "steering_offset", "drive_lag"} <= asked
    assert all(vehicle.kind in find_effect(name).kinds for name in asked)
    assert plan.type_name.startswith("ackermann_msgs/")


def _run(*arguments: str | Path, code: int = 0) -> str:
    done = run_verb(*arguments)
    assert done.returncode == code, done.stderr
    return done.stdout if code == 0 else done.stderr


@pytest.mark.parametrize(
    ("candidates", "flags"), [(("body_inertia", "lateral_skid"), ""), (("slope_creep", "slope_slip"), None)]
)
def test_a_plan_is_the_next_step_only_where_its_drive_decides(
    stored_run: Path, monkeypatch: pytest.MonkeyPatch, candidates: tuple[str, ...], flags: str | None
) -> None:
    results = stored_run / "results"
    run = slip.load("field/wide", results=results)
    stored = read_stored_diagnosis(run.manifest)
    assert stored is not None
    is_open = msgspec.structs.replace(stored, undecided=(Undecided(candidates),))
    monkeypatch.setattr("pipeline.api.drives.find_diagnosis", lambda *_: is_open)
    suggested = suggest_plan("field/wide", Options(out=results))
    assert suggested == flags
    screen = format_run(run.summary, unchanged=False, plan=suggested)
    assert ("slip plan field/wide    the drive" in screen) == (flags is not None)


def test_a_plan_says_that_no_log_holds_commands_on_its_topic(stored_run: Path) -> None:
    manifest = slip.load("field/wide", results=stored_run / "results").manifest
    recorded = list_commands(manifest)
    vehicle = find_preset("husky_a200")
    assert vehicle is not None
    # Where wheel speeds are commanded it is the usual topic of the vehicle.
    assert recorded == ["/wheel_commands", "/controller/cmd_vel"]
    assert choose_topic(vehicle, manifest)[0] == "/controller/cmd_vel"
    limits, area = choose_limits(vehicle, speed_mps=0.8), parse_area("20x10m", vehicle)
    plan = make_plan(Studied(vehicle), limits, area, 60.0, ("/base/cmd_vel", "geometry_msgs/msg/Twist"))
    files = tuple(Path(name) for name in FILES)
    for known, is_said in ((tuple(recorded), True), ((), False)):
        screen = " ".join(PlannedDrive(plan, files, 60.0, recorded=known).describe())
        assert ("on /base/cmd_vel, those are on /wheel_commands and /controller" in screen) == is_said


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
    husky, results = ("--vehicle", "husky"), ("--results", tmp_path / "results")
    _run("simulate", *hidden, "--program", "circle", *husky, "--duration", "40", "--file", before)
    made = json.loads(_run("plan", before, *results, "--time", "2min", "--folder", folder, "--json"))
    (undecided,) = (one for one in made["promises"] if one["kind"] == "separation")
    assert set(undecided["effects"]) == {"yaw_misalignment", "icr_offset"}
    assert made["topic"] == "/controller/cmd_vel"
    assert made["duration_s"] <= 120.0
    played = ("--seed", "5", "--play", folder / "plan.mcap")
    _run("simulate", *hidden, *husky, *played, "--file", after)
    checked = json.loads(_run("plan", "--check", folder, after, *results, "--json"))
    assert [one["question"] for one in checked["kept"]] == [one["question"] for one in made["promises"]]
    assert all(one["kept"] for one in checked["kept"])
    assert "icr_offset" in {one["measured"] for one in checked["kept"]}
    assert checked["next"] is None
    own = _run("plan", "--check", folder, before, *results, code=1)
    assert "no stretch of these commands matches the plan" in own
    toml = folder / "plan.toml"
    toml.write_text(toml.read_text("utf-8").replace('"husky', '"warthog', 1), "utf-8")
    assert "the plan is for warthog" in _run("plan", "--check", folder, after, *results, code=1)
