"""Positions alone are diagnosed: with a gyro like poses, without one but for what is sideways."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.estimation import diagnose_runs
from pipeline.estimation.stored_diagnosis import read_recording
from pipeline.simulate import VEHICLES, Imu, PoseSensor, Program, Scenario, simulate_run, write_log

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.results import RunDiagnosis

_HIDDEN = {"drive_lag": 0.4, "effective_track": 1.5, "lateral_skid": 0.08}
_SIDEWAYS = {"lateral_skid", "lateral_drift", "icr_offset"}
_DRIVE = Scenario(
    vehicle=VEHICLES["warthog"],
    effects=_HIDDEN,
    program=Program("smooth", speed_scale=0.5, turn_scale=0.5),
    duration_s=120.0,
    seed=4,
    pose=PoseSensor(noise_m=0.005, reports_heading=False),
)


def _diagnose(scenario: Scenario, folder: Path) -> RunDiagnosis:
    write_log(simulate_run(scenario), folder / "run.mcap")
    options = Options(out=folder / "out", report=False, diagnosis=False)
    vehicle, recording = read_recording(analyze_log(folder / "run.mcap", options).manifest)
    return diagnose_runs([recording], vehicle).runs[0]


def test_without_a_gyro_nothing_that_is_sideways_is_named_or_bounded(tmp_path: Path) -> None:
    told = _diagnose(replace(_DRIVE, imu=None), tmp_path)
    assert {"drive_lag", "effective_track"} <= {effect.id for effect in told.effects}
    mentioned = {one.id for one in (*told.effects, *told.detectable)}
    assert not mentioned & _SIDEWAYS
    assert told.unobservable_why.keys() >= _SIDEWAYS


def test_with_a_gyro_the_numbers_are_those_that_were_hidden(tmp_path: Path) -> None:
    told = _diagnose(replace(_DRIVE, imu=Imu()), tmp_path)
    found = {one.id: one.parameters for one in told.effects}
    assert set(found) == set(_HIDDEN)
    assert found["effective_track"]["k"].value == pytest.approx(1.5, rel=0.01)
    assert found["lateral_skid"]["c"].value == pytest.approx(0.08, abs=0.005)
