"""Readings of encoders that are missing (NaN, or a silent driver) are unknown, and no speed of zero."""

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from few import few

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.core.arrays import Floats
from pipeline.simulate import Encoders, Recording, make_scenario, simulate_run, write_log
from pipeline.stages.pose_choice import integrate_between
from pipeline.stages.rates import differentiate_angle


def fall_silent(time: Floats) -> Floats:
    """A motor driver without readings for eight seconds, as a broadcaster repeats them."""
    return np.where((time > 20.0) & (time < 28.0), np.nan, 0.0)


def every_other(time: Floats) -> Floats:
    """Wheels in one message of the topic, an arm in the next."""
    return np.where(np.arange(time.size) % 2, np.nan, 0.0)


@pytest.mark.parametrize(("report", "lose"), few([("velocity", fall_silent), ("position", every_other)], 2))
def test_an_unknown_vehicle_is_fitted_without_readings_that_are_missing(
    lose: Callable[[Floats], Floats], report: str, tmp_path: Path
) -> None:
    scenario = make_scenario(
        None, {"effective_track": 1.3}, seed=2, duration_s=100.0, vehicle="turtlebot3", layout="tf"
    )
    scenario = replace(
        scenario,
        encoders=Encoders(rate_hz=40.0, report=report),
        recording=Recording("tf", deployment="absent"),
    )
    run = simulate_run(scenario)
    assert run.wheels is not None
    lost = {
        one.name: values + lose(run.wheels.time_s)
        for one in fields(run.wheels)
        if one.name not in {"time_s", "steering"}
        and (values := getattr(run.wheels, one.name)) is not None
        and values.ndim == 1
    }
    write_log(replace(run, wheels=replace(run.wheels, **lost)), tmp_path / "run.mcap")
    outcome = analyze_log(
        tmp_path / "run.mcap", Options(out=tmp_path / "results", report=False, diagnosis=True)
    )
    findings = {one["id"]: one["text"] for one in outcome.manifest.read("findings").to_dicts()}
    assert "a wheel radius of 0.033 m and a track of 0.16 m" in findings["vehicle_fitted"]
    assert "sliding" not in findings
    effects = {one["id"]: one["parameters"] for one in outcome.summary["diagnosis"]["effects"]}
    assert effects["effective_track"]["k"]["value"] == pytest.approx(1.3, rel=0.01)
    assert "wheel_radius" not in effects
    ladder = outcome.summary["diagnosis"]["ladder"]
    floor = outcome.summary["diagnosis"]["noise_floor"]
    assert ladder[-1]["r_mrmse_rad"] < 2.0 * floor["r_mrmse_rad"]


def test_a_rate_is_integrated_over_what_was_read() -> None:
    time = np.arange(0.0, 10.0, 0.1)
    rate = np.where(np.arange(time.size) % 2, np.nan, 2.0)
    rate[(time > 4.0) & (time < 6.0)] = np.nan
    start = np.array([1.0, 3.0, 4.5, 7.0])
    moved = integrate_between(start, start + 1.0, time, rate)
    assert moved == pytest.approx([2.0, 2.0, np.nan, 2.0], nan_ok=True)


def test_a_wrapped_wheel_angle_with_missing_readings_is_unwrapped() -> None:
    time = np.arange(0.0, 20.0, 0.05)
    angle = (3.0 * time + np.pi) % (2.0 * np.pi) - np.pi
    angle[1::2] = np.nan
    rate = differentiate_angle(time, angle)
    assert np.isnan(rate[1::2]).all()
    assert rate[::2] == pytest.approx(np.full(200, 3.0))
