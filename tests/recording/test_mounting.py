"""Poses of another point, or in a turned frame, than those of the body."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_motion import draw
from written_logs import write_log

from pipeline.analysis import Options
from pipeline.recording.log_setup import set_up_log
from pipeline.words import format_finding


def find(log: Path) -> dict[str, tuple[float, str]]:
    """Numbers and texts of what is said of the poses' place."""
    findings = set_up_log(log, Options(out=log.parent)).choice.findings
    return {
        one.id: (float(one.value or 0.0), format_finding(one))
        for one in findings
        if one.id in {"pose_angle", "pose_lever"}
    }


def test_of_poses_of_the_body_nothing_is_said(tmp_path: Path) -> None:
    assert find(write_log(tmp_path / "log.mcap", draw(60))) == {}


@pytest.mark.parametrize("degrees", [3.0, -2.0])
def test_a_frame_that_is_turned_a_little(degrees: float, tmp_path: Path) -> None:
    drive = draw(61)
    turned = replace(drive, yaw=drive.yaw - np.radians(degrees))
    told = find(write_log(tmp_path / "log.mcap", turned))
    angle, text = told["pose_angle"]
    assert np.degrees(angle) == pytest.approx(degrees, abs=0.3)
    assert ("left" if degrees > 0.0 else "right") in text
    (tmp_path / "run.toml").write_text(f"[pose]\nheading_deg = {degrees}\n")
    assert "pose_angle" not in find(tmp_path / "log.mcap")


@pytest.mark.parametrize("ahead_m", [0.3, -0.1])
def test_a_sensor_ahead_of_the_axle(ahead_m: float, tmp_path: Path) -> None:
    drive = draw(62)
    mounted = replace(drive, place=drive.place + ahead_m * np.exp(1j * drive.yaw))
    lever, text = find(write_log(tmp_path / "log.mcap", mounted))["pose_lever"]
    assert lever == pytest.approx(ahead_m, abs=0.02)
    assert ("behind" if ahead_m > 0.0 else "ahead of") in text
