"""What is said where no effect is named: that nothing is missing is said only of what shows it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_diagnoses import FLOOR, draw_diagnosis
from test_diagnosis import _SCENE, _diagnose

from pipeline.estimation.conclude import relate_delay
from pipeline.recording import Finding
from pipeline.results import Delays, Named
from pipeline.simulate import VEHICLES
from pipeline.simulate.scenario import Commands
from pipeline.words.diagnosis import describe
from pipeline.words.errors import describe_rest, describe_structure
from pipeline.words.findings import format_finding
from pipeline.words.objects import diagnosis_as_json
from pipeline.words.verdict import NOTHING_MISSING, format_verdict

_HUSKY = replace(_SCENE, vehicle=VEHICLES["husky"])
_CLAIMS = (
    NOTHING_MISSING,
    "not depend on any recorded signal",
    "no term that was tried predicts",
)


def test_a_run_of_18_s_is_too_short_to_tell(tmp_path: Path) -> None:
    diagnosis = _diagnose(replace(_HUSKY, duration_s=18.0), tmp_path)
    assert not diagnosis.runs[0].effects
    screen = describe(diagnosis.runs)
    assert "The run is too short to determine the cause." in screen
    assert not any(claim in screen for claim in _CLAIMS)


def test_a_run_that_is_long_enough_may_miss_nothing(tmp_path: Path) -> None:
    diagnosis = _diagnose(_HUSKY, tmp_path)
    assert NOTHING_MISSING in describe(diagnosis.runs)
    assert diagnosis.runs[0].concentrated is None
    assert "not depend on any recorded signal" in describe_rest(diagnosis.runs[0])


def test_an_effect_that_shows_once_is_told_as_refused_and_why(tmp_path: Path) -> None:
    times = np.arange(0.0, 150.0, 0.05)
    turn = np.where((times > 20.0) & (times < 27.0), 0.6, 0.0)
    speed = np.where((times > 2.0) & (times < 148.0), 0.8, 0.0)
    scene = replace(
        _HUSKY,
        effects={"effective_track": 1.6},
        duration_s=150.0,
        played=Commands(times, speed, turn),
        imu=None,
        encoders=None,
    )
    (run,) = _diagnose(scene, tmp_path, inputs=("command",)).runs
    assert not run.effects
    first, *_ = run.refused
    assert first.id == "effective_track"
    assert first.errors.r_mrmse_rad < 0.6 * run.ladder[0].r_mrmse_rad
    verdict = format_verdict(run)
    assert "Effective track would leave " in verdict
    assert re.search(
        r"too few stretches of the drive \(\d+ % of resampled recordings, 85 % required\)", verdict
    )
    assert "No known effect" not in describe([run], everything=True)
    assert diagnosis_as_json(run)["refused"][0]["effect"] == "effective_track"


@pytest.mark.parametrize(
    ("names", "explained"),
    [
        (("wheel_servo", "effective_track"), "by wheel servo, without a dead time"),
        (("wheel_servo", "transport_delay"), ""),
        (("effective_track",), ""),
    ],
)
def test_a_late_answer_that_the_drive_explains_is_no_dead_time(
    names: tuple[str, ...], explained: str
) -> None:
    told = {"value": 0.35, "lag_s": 0.54, "source": "/cmd", "followed": "wheels"}
    finding = Finding("command_delay", "info", "command", told)
    said = format_finding(relate_delay(finding, [Named(name) for name in names], Delays()))
    assert ("late_s" in said) == (not explained)
    assert explained in said


def test_a_heading_and_a_position_that_are_late_unequally_are_told_as_two() -> None:
    finding, clock = Finding("pose_delay", "info", "pose", {"value": 0.254}), [Named("clock_offset")]
    for position, said in {0.17: "0.17 s late by the fit", 0.25: "poses are 0.25 s late against"}.items():
        delays = Delays("gyro", pose_delay_s=position, yaw_delay_s=0.254)
        assert said in format_finding(relate_delay(finding, clock, delays))
    unnamed = Delays("gyro", pose_delay_s=0.17, yaw_delay_s=0.254)
    assert "0.17" not in format_finding(relate_delay(finding, [], unnamed))


@pytest.mark.parametrize(("excess", "said"), [(1.1, NOTHING_MISSING), (1.4, "No effect is evident")])
def test_above_the_floor_nobody_knows_that_nothing_is_missing(excess: float, said: str) -> None:
    diagnosis = draw_diagnosis({}, [(FLOOR["t_mrmse_m"], excess * FLOOR["r_mrmse_rad"])])
    assert format_verdict(diagnosis).endswith(f"{said}.")


def test_an_error_that_a_wet_patch_makes_is_told_by_where_it_is(tmp_path: Path) -> None:
    # Nearly all turning within the patch is driven in the first fifth of the run.
    patch = {"terrain_change": {"k_v": 0.85, "k_w": 0.6, "at_x": -1.5}}
    diagnosis = _diagnose(replace(_HUSKY, effects=patch, duration_s=150.0), tmp_path)
    (run,) = diagnosis.runs
    assert run.unexplained is not None
    assert "from 0 to 30 s (20 % of the time): 90 % of the yaw error" in describe_structure(run.unexplained)
    assert describe_structure(run.unexplained) in describe(diagnosis.runs)
    assert not any(claim in f"{describe(diagnosis.runs)} {diagnosis_as_json(run)}" for claim in _CLAIMS)
