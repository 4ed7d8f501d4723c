"""Several runs judged together: which take part, and what the others say of one."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from verbs import run_verb

from pipeline.estimation import DiagnosisInput
from pipeline.estimation.diagnosis import Diagnosis
from pipeline.estimation.together import Member, judge_together
from pipeline.results import RunDiagnosis
from pipeline.run import MotionError
from pipeline.simulate import VEHICLES, Disturbance, Scenario, simulate_run, write_log
from pipeline.sources import find_preset
from pipeline.words import format_finding


def _draw(name: str, gain: float, *findings: tuple[str, float | None]) -> DiagnosisInput:
    """A run whose body covers a share of the distance of its wheels."""
    times = np.arange(0.0, 20.0, 0.1)
    still = np.zeros(times.size)
    poses = {
        "t": times,
        "segment": np.zeros(times.size, dtype=np.int32),
        "x": gain * 0.5 * times,
        **dict.fromkeys(("y", "z", "q_x", "q_y", "q_z"), still),
        "q_w": still + 1.0,
        "held": still > 1.0,
        "active": still < 1.0,
    }
    slip = {
        "t": times,
        "input": ["measured"] * times.size,
        "step": np.zeros(times.size, dtype=np.int32),
        "suspect": still > 1.0,
        "standing": still > 1.0,
        "transitory": still > 1.0,
        "f_x": still + 0.5,
        "v_x": still + 0.5 * gain,
    }
    alignment = dict.fromkeys(
        ("wheel_delay", "latency_spread", "outlier_time", "heading_delay", "hold_time"), 0.0
    ) | dict.fromkeys(("command_scale", "track_multiplier"), 1.0)
    found = [
        {"id": one, "where": "", "severity": "error", "values": json.dumps({"value": value})}
        for one, value in findings
    ]
    tables = {
        "poses": pl.DataFrame(poses),
        "slip": pl.DataFrame(slip),
        "alignments": pl.DataFrame([{**alignment, "gyro_scale": None}]),
        **({"findings": pl.DataFrame(found)} if found else {}),
    }
    return DiagnosisInput(name, tables)


def _judge(members: Sequence[Member]) -> Diagnosis:
    """Judges all but `late`, whose poses it refuses."""
    if any(one.run.name == "late" for one in members):
        raise MotionError("too_short", "the run has 3 stretches", where="late", hint="Drive longer.")
    return Diagnosis(
        tuple(
            RunDiagnosis(one.run.name, "measured", findings=one.recording.list_findings()) for one in members
        )
    )


HUSKY = find_preset("husky")


def test_a_run_that_cannot_be_judged_is_left_out_with_its_reason() -> None:
    assert HUSKY is not None
    runs = [_draw("one", 0.9), _draw("late", 0.9), _draw("other", 0.9, ("pose_from_wheels", None))]
    judged = judge_together(runs, HUSKY, "measured", _judge).runs
    assert [one.run for one in judged] == ["one", "other", "late"]
    assert format_finding(judged[2].findings[0]) == "left out: the run has 3 stretches"
    # The error of a single run is its own.
    with pytest.raises(MotionError, match="3 stretches"):
        judge_together(runs[1:2], HUSKY, "measured", _judge)


def test_a_wrong_radius_is_slippery_ground_where_other_runs_contradict_it() -> None:
    assert HUSKY is not None
    radius = HUSKY.wheel_radius_m
    claim = ("wheel_radius_wrong", 0.34 * radius)
    runs = [_draw("ice", 0.34, claim), _draw("road", 0.85)]
    (ice, _) = judge_together(runs, HUSKY, "measured", _judge).runs
    assert [(one.id, one.severity) for one in ice.findings] == [("slippery_ground", "info")]
    assert format_finding(ice.findings[0]).startswith("the vehicle covers 34 % of the distance of its wheels")
    # Runs that agree with the radius that it implies leave it a wrong radius.
    alike = [_draw("one", 0.34, claim), _draw("other", 0.34, claim)]
    for run in judge_together(alike, HUSKY, "measured", _judge).runs:
        assert [one.id for one in run.findings] == ["wheel_radius_wrong"]


def test_the_trials_of_a_folder_count_together(tmp_path: Path) -> None:
    scene = Scenario(
        vehicle=VEHICLES["husky"],
        duration_s=14.0,
        disturbance=Disturbance(0.01, 0.01),
        effects={"effective_track": 1.8},
    )
    (tmp_path / "trials").mkdir()
    for number in range(4):
        write_log(simulate_run(replace(scene, seed=number)), tmp_path / "trials" / f"trial{number}.mcap")
    done = run_verb("diagnose", tmp_path / "trials", "--results", tmp_path / "out", "--json")
    assert done.returncode == 0
    runs = json.loads(done.stdout)["runs"]
    assert [run["run"] for run in runs] == [f"trials/trial{number}" for number in range(4)]
    for run in runs:
        (track,) = [effect for effect in run["effects"] if effect["id"] == "effective_track"]
        assert track["parameters"]["k"]["low"] < 1.8 < track["parameters"]["k"]["high"]
    # On a screen they are one answer, and the next command names the folder.
    screen = run_verb("diagnose", tmp_path / "trials", "--results", tmp_path / "out").stdout
    assert screen.count("effective track") == 1
    assert f"slip diagnose {tmp_path / 'trials'} --results" in screen
