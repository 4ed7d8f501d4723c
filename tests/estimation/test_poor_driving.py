"""What a user is told where the driving cannot decide: the candidates, or that the log says nothing of it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest
from few import few

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.estimation import DiagnosisInput, diagnose_runs
from pipeline.results import RunDiagnosis
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
from pipeline.sources import find_preset


def _drive(program: str, effects: Mapping[str, object], folder: Path, vehicle: str = "husky") -> RunDiagnosis:
    scenario = Scenario(
        vehicle=VEHICLES[vehicle],
        effects=effects,  # type: ignore[arg-type]
        program=Program(name=program),  # type: ignore[arg-type]
        duration_s=120.0,
        seed=11,
        disturbance=Disturbance(0.02, 0.03),
        pose=PoseSensor(drift_m=0.005),
        imu=Imu(),
    )
    write_log(simulate_run(scenario), folder / "run.mcap")
    manifest = analyze_log(folder / "run.mcap", Options(out=folder / "out", report=False)).manifest
    preset = find_preset(VEHICLES[vehicle].name)
    assert preset is not None
    tables = {name: manifest.read(name) for name in manifest.tables}
    return diagnose_runs([DiagnosisInput(manifest.run, tables)], preset).runs[0]


@pytest.mark.parametrize("program", few(["straight", "spins"], 2))
def test_an_old_heading_is_no_old_position_unless_the_vehicle_drives_and_turns(
    program: str, tmp_path: Path
) -> None:
    found = _drive(program, {"heading_skew": 0.12}, tmp_path)
    assert not found.effects
    assert {"clock_offset", "heading_skew"} in [set(item.candidates) for item in found.undecided]


def test_one_circle_does_not_tell_a_droop_from_a_limit(tmp_path: Path) -> None:
    """At one turning rate a droop is a gain of the turn, which has a number less."""
    found = _drive("circle", {"turn_droop": {"threshold": 1.2, "gain": 0.4}}, tmp_path)
    assert not found.effects
    assert any({"body_turn_limit", "difference_gain"} <= set(item.candidates) for item in found.undecided)


@pytest.mark.parametrize(
    ("program", "limit", "also", "never"),
    [
        ("straight", "wheel_speed_limit", "body_speed_limit", "body_turn_limit"),
        ("spins", "body_turn_limit", "wheel_speed_limit", "body_speed_limit"),
    ],
)
def test_one_motion_does_not_tell_a_limit_of_the_body_from_one_of_its_wheels(
    program: str, limit: str, also: str, never: str, tmp_path: Path
) -> None:
    value = 4.0 if limit == "wheel_speed_limit" else 0.7
    found = _drive(program, {limit: {"limit": value}}, tmp_path)
    (group,) = found.undecided
    assert {limit, also} <= set(group.candidates)
    assert never not in group.candidates


@pytest.mark.long
def test_a_change_of_ground_on_a_straight_is_a_change_of_speed(tmp_path: Path) -> None:
    found = _drive("straight", {"terrain_change": {"k_v": 0.8, "k_w": 0.75}}, tmp_path)
    named = {effect.id: effect for effect in found.effects}
    assert set(named) == {"terrain_change"}
    assert named["terrain_change"].parameters["k_v"].value == pytest.approx(0.8, abs=0.02)


def test_what_shows_but_once_cannot_be_told(tmp_path: Path) -> None:
    found = _drive("circle", {"steering_lag": 0.4}, tmp_path, vehicle="car")
    assert not found.effects
    assert "steering_lag" in found.unobservable_why


def test_straight_only_does_not_tell_one_lag_from_two(tmp_path: Path) -> None:
    found = _drive("straight", {"turn_lag": {"tau_mean": 0.3, "tau_diff": 1.0}}, tmp_path)
    assert not found.effects
    assert {"drive_lag", "turn_lag"} in [set(item.candidates) for item in found.undecided]


def test_encoders_split_no_hairs_between_what_one_circle_makes_alike(tmp_path: Path) -> None:
    found = _drive("circle", {"steering_gain": 0.85}, tmp_path, vehicle="car")
    assert not found.effects
    told = {name for item in found.undecided for name in item.candidates} | found.unobservable_why.keys()
    assert "steering_gain" in told


def test_a_straight_does_not_tell_the_clock_of_poses_from_that_of_encoders(tmp_path: Path) -> None:
    assert not _drive("straight", {}, tmp_path).effects
