"""Encoders that misread are the finding, not a drive gain and a wheel radius that undo each other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.estimation import diagnose_runs
from pipeline.estimation.stored_diagnosis import read_recording
from pipeline.results import RunDiagnosis
from pipeline.simulate import make_scenario, simulate_run, write_log
from pipeline.words import format_finding


def judge(folder: Path, effects: dict[str, float], reads: float, configured: str = "") -> RunDiagnosis:
    """Diagnosis of a drive whose encoders read a share of the true speeds."""
    scenario = make_scenario(
        None,
        {"drive_lag": 0.3, **effects},
        seed=3,
        duration_s=100.0,
        vehicle="husky",
        layout="husky_body_command",
    )
    run = simulate_run(scenario)
    assert run.wheels is not None
    names = ("left", "right", "left_angle", "right_angle")
    read = replace(run.wheels, **{name: reads * getattr(run.wheels, name) for name in names})
    write_log(replace(run, wheels=read), folder / "run.mcap")
    (folder / "run.toml").write_text(configured)
    options = Options(out=folder / "results", report=False, diagnosis=False)
    vehicle, recording = read_recording(analyze_log(folder / "run.mcap", options).manifest)
    (judged,) = diagnose_runs([recording], vehicle).runs
    return judged


def list_ids(judged: RunDiagnosis) -> set[str]:
    return {effect.id for effect in judged.effects}


@pytest.mark.long
@pytest.mark.parametrize("reads", [0.95, 1.08])
def test_encoders_that_misread_are_named_with_the_line_that_mends_them(reads: float, tmp_path: Path) -> None:
    judged = judge(tmp_path, {"effective_track": 1.3}, reads)
    assert list_ids(judged) == {"drive_lag", "effective_track"}
    (track,) = (one for one in judged.effects if one.id == "effective_track")
    assert track.parameters["k"].value == pytest.approx(1.3, rel=0.01)
    (found,) = (one for one in judged.findings if one.id == "encoder_scale")
    assert found.value == pytest.approx(reads, rel=2e-3)
    assert f"{'5 % low' if reads < 1.0 else '8 % high'}" in format_finding(found)
    line = format_finding(found).split("; ")[1].split(" under")[0]
    mended = judge(tmp_path, {"effective_track": 1.3}, reads, f"[wheels]\n{line}\n")
    assert list_ids(mended) == {"drive_lag", "effective_track"}
    assert "encoder_scale" not in {one.id for one in mended.findings}


@pytest.mark.long
def test_a_radius_and_a_gain_that_do_not_undo_each_other_are_both_named(tmp_path: Path) -> None:
    judged = judge(tmp_path, {"wheel_radius": 1.05, "drive_gain": 0.9}, 1.0)
    assert list_ids(judged) == {"drive_lag", "wheel_radius", "drive_gain"}
    assert "encoder_scale" not in {one.id for one in judged.findings}


def test_a_radius_alone_is_named(tmp_path: Path) -> None:
    assert list_ids(judge(tmp_path, {"wheel_radius": 1.05}, 1.0)) == {"drive_lag", "wheel_radius"}


def test_a_coincidence_is_said_and_can_be_claimed(tmp_path: Path) -> None:
    """No signal tells wheels of another radius behind a gain that undoes it from encoders that misread."""
    effects = {"wheel_radius": 1.0 / 0.95, "drive_gain": 0.95}
    judged = judge(tmp_path, effects, 1.0)
    (found,) = (one for one in judged.findings if one.id == "encoder_scale")
    assert found.value == pytest.approx(0.95, rel=2e-3)
    assert "another radius and the drive has that gain by coincidence, scale = 1" in format_finding(found)
    claimed = judge(tmp_path, effects, 1.0, "[wheels]\nscale = 1\n")
    assert list_ids(claimed) == {"drive_lag", "wheel_radius", "drive_gain"}
    assert "encoder_scale" not in {one.id for one in claimed.findings}
