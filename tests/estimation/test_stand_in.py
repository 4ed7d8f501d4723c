"""What halves an error is named, though no vehicle was seen with its numbers: as a stand-in."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import pytest

from pipeline.estimation import diagnose_runs
from pipeline.estimation.diagnosis import Named, Value
from pipeline.estimation.diagnosis_lines import describe
from pipeline.estimation.estimates import find_doubt
from pipeline.job import Options
from pipeline.job.analyze import analyze_log
from pipeline.job.run_results import read_recording
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


def test_a_lag_that_halves_the_error_is_named_though_it_is_longer_than_any_that_was_seen(
    tmp_path: Path,
) -> None:
    """It was declined without a word, and the error stayed."""
    scenario = Scenario(
        vehicle=VEHICLES["car"],
        effects={"drive_lag": 4.2},
        program=Program("teleop", speed_scale=0.4),
        duration_s=120.0,
        seed=3,
        disturbance=Disturbance(0.01, 0.005),
        pose=PoseSensor(),
        imu=Imu(),
    )
    write_log(simulate_run(scenario), tmp_path / "run.mcap")
    options = Options(out=tmp_path / "out", report=False, diagnosis=False)
    vehicle, recording = read_recording(analyze_log(tmp_path / "run.mcap", options).manifest)
    diagnosis = diagnose_runs([recording], vehicle)
    (run,) = diagnosis.runs
    lag = next(effect for effect in run.effects if effect.id == "drive_lag")
    assert lag.parameters["tau"].value == pytest.approx(4.2, rel=0.1)
    assert lag.tentative
    text = " ".join(describe(diagnosis, everything=True).split())
    assert f"tau = {lag.parameters['tau'].value:.3g} s is outside the observed range (0 to 3 s" in text
    assert run.to_json()["effects"][0]["tentative"]  # type: ignore[index]


def test_an_interval_that_includes_no_effect_in_every_run_is_reason_not_to_name_it() -> None:
    def skew(*runs: Value) -> Named:
        numbers = tuple({"d": value} for value in runs)
        return Named(
            "heading_skew", numbers[0], 0.1, (), (),
            corrected=False, path="measured", selected=1.0, motion="", by_run=numbers,
        )  # fmt: skip

    unsure, sure = Value(0.02, -0.01, 0.05, "s"), Value(0.03, 0.01, 0.05, "s")
    doubt = find_doubt(skew(unsure, unsure), {})
    assert doubt is not None
    assert doubt["id"] == "insignificant_effect"
    assert "includes 0 s (no effect)" in str(doubt["text"])
    assert find_doubt(skew(unsure, sure), {}) is None
    assert find_doubt(skew(Value(0.02, math.nan, math.nan, "s")), {}) is None
