"""What a user is promised of a diagnosis."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from msgspec.structs import astuple

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.core import NORMAL_95
from pipeline.estimation import (
    Diagnosis,
    DiagnosisInput,
    Estimates,
    EstimationData,
    Input,
    diagnose_runs,
    load_recording,
)
from pipeline.estimation.estimates import list_values
from pipeline.estimation.intervals import Estimate
from pipeline.estimation.ladder import judge_whole
from pipeline.estimation.model_state import Free
from pipeline.models import Number, expect_another_run, find_effect, read_model, write_model
from pipeline.models.effects.side_gain import SideGain
from pipeline.models.formula import FormulaEffect
from pipeline.results import to_json
from pipeline.results.reading import read_model as read_proposed
from pipeline.simulate import (
    VEHICLES,
    Disturbance,
    Imu,
    PoseSensor,
    Program,
    Scenario,
    State,
    simulate_run,
    write_log,
)
from pipeline.simulate import (
    Recording as Recorded,
)
from pipeline.sources import Vehicle, find_preset
from pipeline.words.diagnosis import describe, list_lines
from pipeline.words.effects import describe_separation, list_readings, suggest_drive
from pipeline.words.errors import describe_structure
from pipeline.words.objects import diagnosis_as_json

_SCENE = Scenario(
    duration_s=120.0, seed=7, disturbance=Disturbance(0.02, 0.03), pose=PoseSensor(drift_m=0.005)
)


def _record(scenario: Scenario, folder: Path) -> tuple[DiagnosisInput, Vehicle]:
    log = folder / "run.mcap"
    write_log(simulate_run(scenario), log)
    manifest = analyze_log(log, Options(out=folder / "out", report=False)).manifest
    vehicle = find_preset(scenario.vehicle.name)
    assert vehicle is not None
    return DiagnosisInput(manifest.run, {name: manifest.read(name) for name in manifest.tables}), vehicle


def _diagnose(scenario: Scenario, folder: Path, **more: object) -> Diagnosis:
    recording, vehicle = _record(scenario, folder)
    return diagnose_runs([recording], vehicle, **more)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def skidding(tmp_path_factory: pytest.TempPathFactory) -> Diagnosis:
    effects = {"effective_track": 1.8, "drive_lag": 0.4}
    return _diagnose(replace(_SCENE, effects=effects), tmp_path_factory.mktemp("skidding"))


def test_what_is_missing_is_named_with_its_size(skidding: Diagnosis) -> None:
    named = {effect.id: effect for effect in skidding.runs[0].effects}
    assert set(named) == {"effective_track", "drive_lag"}
    track = named["effective_track"].parameters["k"]
    assert track.low < 1.8 < track.high
    assert named["drive_lag"].parameters["tau"].value == pytest.approx(0.4, abs=0.02)
    assert named["drive_lag"].path == "wheels"
    assert named["effective_track"].path == "measured"


def test_what_a_planner_would_not_feel_has_no_name(tmp_path: Path) -> None:
    effects = {"effective_track": 1.8, "icr_offset": 0.004}
    quiet = replace(_SCENE, effects=effects, disturbance=Disturbance(), pose=PoseSensor(), duration_s=90.0)
    diagnosis = _diagnose(quiet, tmp_path, inputs=("measured",))
    found = diagnosis.runs[0]
    assert [effect.id for effect in found.effects] == ["effective_track"]
    assert all("icr_offset" not in rung.effects for rung in found.ladder)
    run = diagnosis_as_json(diagnosis.runs[0])
    assert "icr_offset" not in str(run["model"])
    assert "icr_offset" not in describe(diagnosis.runs)


_CAR = replace(
    _SCENE, vehicle=VEHICLES["car"], program=Program(speed_scale=0.5), disturbance=Disturbance(0.01, 0.005)
)


@pytest.mark.long
@pytest.mark.parametrize("imu", [Imu(), Imu(bias_radps=0.004), None], ids=["gyro", "biased gyro", "no gyro"])
@pytest.mark.parametrize(
    ("hidden", "size", "way"),
    [
        ("steering_offset", 0.01, "wheels"),
        ("steering_sensor_offset", 0.01, "measured"),
        ("steering_sensor_play", 0.02, "measured"),
        ("yaw_drift", 0.03, "measured"),
    ],
)
def test_a_gyro_does_not_turn_one_effect_into_another(
    hidden: str, size: float, way: str, imu: Imu | None, tmp_path: Path
) -> None:
    found = _diagnose(replace(_CAR, effects={hidden: size}, imu=imu), tmp_path).runs[0]
    assert [(effect.id, effect.path) for effect in found.effects] == [(hidden, way)]
    (value,) = found.effects[0].parameters.values()
    assert value.value == pytest.approx(size, rel=0.15)


def test_an_offset_between_the_steering_sensor_and_the_tyres_is_named(tmp_path: Path) -> None:
    car = replace(_CAR, effects={"steering_sensor_offset": 0.02}, duration_s=60.0)
    found = _diagnose(car, tmp_path, inputs=("measured",)).runs[0]
    assert [effect.id for effect in found.effects] == ["steering_sensor_offset"]
    assert found.effects[0].equivalent_to == ("steering_offset",)


def test_wheels_that_spin_by_almost_half_are_small_or_slip_on_this_ground(
    tmp_path: Path,
) -> None:
    spinning = replace(_SCENE, effects={"wheel_radius": 0.6}, duration_s=60.0)
    found = _diagnose(spinning, tmp_path, inputs=("measured",)).runs[0]
    assert [effect.id for effect in found.effects] == ["wheel_radius"]
    assert {one.name for one in list_readings(found.effects[0])} == {"wheel_radius", "longitudinal_slip"}


def test_the_ladder_falls_on_data_that_no_rung_has_seen(skidding: Diagnosis) -> None:
    errors = [rung.t_mrmse_m for rung in skidding.runs[0].ladder]
    assert len(errors) == 3
    assert errors == sorted(errors, reverse=True)
    assert skidding.runs[0].explained_share > 0.9


def test_an_early_clock_is_found_corrected_and_not_lost(tmp_path: Path) -> None:
    (run,) = _diagnose(replace(_SCENE, effects={"clock_offset": -0.15}), tmp_path).runs
    assert [effect.id for effect in run.effects] == ["clock_offset"]
    assert run.effects[0].corrected
    assert run.effects[0].parameters["d"].value == pytest.approx(-0.15, abs=0.01)


def test_an_old_heading_is_found_against_the_gyro_and_rated_with_the_position_as_it_is(
    tmp_path: Path,
) -> None:
    run = _diagnose(replace(_SCENE, effects={"heading_skew": 0.1}), tmp_path).runs[0]
    (named,) = run.effects
    assert named.id == "heading_skew"
    assert named.parameters["d"].value == pytest.approx(0.1, abs=0.02)
    # The heading that is compared is the gyro's: what falls is the error of the position.
    assert run.ladder[-1].t_mrmse_m < 0.9 * run.ladder[0].t_mrmse_m


def test_driven_straight_only_turning_is_said_to_be_unobservable(tmp_path: Path) -> None:
    scenario = replace(_SCENE, effects={"effective_track": 1.8}, program=Program("straight"))
    (run,) = _diagnose(scenario, tmp_path).runs
    assert run.effects == ()
    hidden = run.unobservable_why
    assert "effective_track" in hidden
    assert "turn" in suggest_drive("effective_track")


def test_one_circle_leaves_it_undecided_with_a_manoeuvre(tmp_path: Path) -> None:
    scenario = replace(_SCENE, effects={"turning_resistance": 0.2}, program=Program("circle"))
    (run,) = _diagnose(scenario, tmp_path).runs
    assert run.effects == ()
    assert "turning_resistance" in run.undecided[0].candidates
    assert describe_separation(run.undecided[0])
    # In the place of the others it is known.
    known = run.undecided[0].parameters["turning_resistance"]["k"]
    assert known.low < 0.2 < known.high
    lines = [" ".join(text.split()) for _, text in list_lines(run, everything=True)]
    assert any(line.startswith("turning_resistance k = 0.2") for line in lines)
    assert "This log does not decide between" in lines[0]
    assert "turning resistance" in lines[0]
    held = run.undecided[0].in_model
    proposal = read_proposed(run)
    assert proposal is not None
    write_model(proposal, tmp_path / "model.toml")
    assert read_model(tmp_path / "model.toml").undecided == [list(run.undecided[0].candidates)]
    assert held in proposal.model.ids
    assert [line.split()[0] for line in lines if line.endswith("(in the model)")] == [held]
    assert any(line.startswith("to separate them: ") for line in lines)


def test_a_vehicle_that_does_not_move_gets_no_name(tmp_path: Path) -> None:
    scenario = replace(_SCENE, effects={"wheel_radius": 0.0}, disturbance=Disturbance())
    (run,) = _diagnose(scenario, tmp_path).runs
    assert run.effects == ()
    assert "not_moving" in {finding.id for finding in run.findings}
    told = describe([run])
    assert "No effect can be estimated." in told
    assert told.lower().count("the vehicle does not move") == 1


def test_a_formula_for_the_unexplained_is_a_suggestion_that_can_be_pasted_into_a_model_file(
    tmp_path: Path,
) -> None:
    def slip_in_reverse(state: State) -> tuple[float, float, float]:
        return (-0.3 * state.v0 if state.v0 < 0.0 else 0.0), 0.0, 0.0

    recording, vehicle = _record(replace(_SCENE, extra=slip_in_reverse), tmp_path)
    diagnosis = diagnose_runs([recording], vehicle)
    (run,) = diagnosis.runs
    left = run.unexplained
    assert left is not None
    assert left.channel == "x"
    assert left.formula is not None
    # The model that is written is the model of the ladder, without the formula.
    proposal = diagnosis.proposal
    assert proposal is not None
    assert proposal.model.ids == run.ladder[-1].effects
    assert not any(isinstance(effect, FormulaEffect) for effect in proposal.model)
    model = tmp_path / "model.toml"
    model.write_text(f'format = 1\n[vehicle]\npreset = "husky_a200"\n\n{left.formula}', encoding="utf-8")
    formula = read_model(model).model
    assert formula.ids == ("suggested_term",)
    # What it is said to bring is what the model has with it.
    data = EstimationData([load_recording(recording, vehicle)], vehicle, Input(run.input))
    whole = judge_whole(data, proposal.model + formula.effect("suggested_term"))
    assert left.with_formula == whole.errors
    before, after = (one.velocity_rms[0] for one in (run.ladder[-1], left.with_formula))
    assert after < 0.7 * before  # type: ignore[operator]
    assert run.noise_floor is not None
    assert left.with_formula is not None
    assert run.noise_floor.t_mrmse_m < 1.05 * left.with_formula.t_mrmse_m, "one floor with and without it"
    assert "would remain over 2 s" in describe([run])


@pytest.mark.long
def test_a_wheel_out_of_round_is_told_by_what_it_has_turned(tmp_path: Path) -> None:
    def wobble(state: State) -> tuple[float, float, float]:
        missed = 0.06 * math.sin(state.right_angle) * _SCENE.vehicle.wheel_radius_m * state.right_speed
        return 0.5 * missed, 0.0, missed / _SCENE.vehicle.track_width_m

    (run,) = _diagnose(replace(_SCENE, extra=wobble), tmp_path).runs
    assert run.effects == ()
    assert run.unexplained is not None
    assert "it repeats with every turn of the right wheel" in describe_structure(run.unexplained)
    # What a formula would leave is not below the floor: there is something left to say.
    would, floor = run.unexplained.with_formula, run.noise_floor
    assert would is not None
    assert floor is not None
    assert floor.r_mrmse_rad < 1.05 * would.r_mrmse_rad < 0.9 * run.ladder[-1].r_mrmse_rad
    assert floor.t_mrmse_m < 1.05 * would.t_mrmse_m
    assert "at the noise floor in heading" not in describe([run])


@pytest.mark.long
def test_motion_that_lasts_is_unexplained_and_its_own_past_predicts_it(tmp_path: Path) -> None:
    pushed = Disturbance(0.1, 0.15, correlation_s=4.0)
    scenario = replace(_SCENE, effects={"effective_track": 1.8}, disturbance=pushed, duration_s=240.0)
    (run,) = _diagnose(scenario, tmp_path).runs
    left = run.unexplained
    assert left is not None
    assert "w" in left.channels
    assert left.of.startswith("missed v_w, forgotten in")
    assert "of the heading error over 2 s" in describe_structure(left)
    assert left.formula is None
    # Half a second of it cannot be known from before: that is at the floor.
    assert run.noise_floor.velocity_rms[2] < 0.7 * run.ladder[-1].velocity_rms[2]


@pytest.mark.long
def test_an_encoder_that_reads_too_little_is_named_though_commands_do_not_show_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it says wrongly of the ground it says of the drive, too: the drive's part may be too faint."""
    monkeypatch.setattr(SideGain, "can_show", lambda *_: False)
    scenario = replace(_SCENE, effects={"effective_track": 1.6, "drive_lag": 0.3}, imu=Imu())
    recording, vehicle = _record(scenario, tmp_path)
    wheels = recording.tables["wheels"].with_columns(pl.col("left", "left_aligned") * 0.95)
    recording = replace(recording, tables={**recording.tables, "wheels": wheels})
    (told,) = diagnose_runs([recording], vehicle, inputs=("command", "measured")).runs
    uneven = {one.id: one for one in told.effects}["wheel_asymmetry"].parameters["e"]
    assert uneven.low < -0.0513 < uneven.high < 0.0


def test_two_runs_of_one_vehicle_are_judged_together(tmp_path: Path) -> None:
    recordings = []
    for seed in (1, 2):
        folder = tmp_path / str(seed)
        folder.mkdir()
        scenario = replace(_SCENE, effects={"effective_track": 1.6}, seed=seed)
        recording, vehicle = _record(scenario, folder)
        recordings.append(replace(recording, name=f"run{seed}"))
    runs = diagnose_runs(recordings, vehicle).runs
    assert [run.run for run in runs] == ["run1", "run2"]
    assert all([effect.id for effect in run.effects] == ["effective_track"] for run in runs)


def test_a_log_without_encoders_and_gyro_is_answered_from_the_command_alone(tmp_path: Path) -> None:
    scenario = replace(
        _SCENE,
        vehicle=VEHICLES["husky"],
        effects={"transport_delay": 0.25},
        recording=Recorded("body_command"),
        imu=Imu(),
    )
    (run,) = _diagnose(scenario, tmp_path).runs
    assert [effect.id for effect in run.effects] == ["transport_delay"]
    assert "clock_offset" in run.effects[0].equivalent_to


@pytest.mark.usefixtures("every_core")
def test_a_diagnosis_is_the_same_each_time_on_one_core_or_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording, vehicle = _record(replace(_SCENE, effects={"lateral_skid": 0.1}), tmp_path)
    first = [to_json(one) for one in diagnose_runs([recording], vehicle).runs]
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0}, raising=False)
    assert [to_json(one) for one in diagnose_runs([recording], vehicle).runs] == first


@pytest.mark.long
def test_two_lags_that_have_become_one_make_room_for_what_set_them_apart(tmp_path: Path) -> None:
    hidden = {"drive_lag": 0.55, "effective_track": 1.56, "deadband": 0.235}
    found = _diagnose(replace(_SCENE, effects=hidden), tmp_path).runs[0]
    assert {effect.id for effect in found.effects} == set(hidden)
    assert not found.undecided
    # Between the commands that stood still and those that moved: nothing was asked closer to zero.
    (dead,) = next(effect.parameters for effect in found.effects if effect.id == "deadband").values()
    assert 0.0 < dead.low < 0.235 < dead.high


def test_an_interval_holds_its_value_also_beside_the_bounds_of_its_search() -> None:
    limit = Free("body_turn_limit", "limit", (), (0.259, 50.0), 0.01)
    beside = Estimate(limit, 0.189, 0.001, 0.0005, at_bound=False, observable=True)
    assert beside.interval == pytest.approx((0.188, 0.190))
    within = Estimate(limit, 0.2595, 0.001, 0.0005, at_bound=False, observable=True)
    assert within.interval == pytest.approx((0.259, 0.2605))


def test_another_run_is_known_less_than_this_one_and_what_begins_in_this_one_not_at_all() -> None:
    track = find_effect("effective_track")().parameter("k")
    low, high = astuple(expect_another_run(track, Number(1.8, 1.78, 1.83)))
    assert low == pytest.approx(1.8 - np.hypot(0.02, NORMAL_95 * 2.0**0.5 * track.spread.size), rel=1e-5)
    assert high == pytest.approx(1.8 + np.hypot(0.03, NORMAL_95 * 2.0**0.5 * track.spread.size), rel=1e-5)
    lag = find_effect("drive_lag")().parameter("tau")
    assert expect_another_run(lag, Number(0.1, 0.09, 0.11)).low == lag.bounds[0]
    assert not np.isfinite(astuple(expect_another_run(track, Number(1.8)))).any()
    for effect, is_known in (
        (find_effect("effective_track")(k=1.8), True),
        (find_effect("terrain_change")(k_v=0.8, k_w=0.7, at_s=60.0), False),
    ):
        free = [Free(effect.id, one.name, (), one.bounds, 0.01) for one in effect.parameters]
        items = [Estimate(one, 0.75, 0.15, 0.07, at_bound=False, observable=True) for one in free]
        values = list_values(effect, Estimates(tuple(items), np.eye(len(items)), 9))
        assert all(value.high == 0.9 for value in values.values())
        assert all(np.isfinite(astuple(value.another_run)).all() == is_known for value in values.values())
