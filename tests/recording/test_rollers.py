"""Mecanum wheels that nobody describes: their lengths, and a side that counts backward."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_motion import RADIUS, STEP, Drive, draw
from written_logs import write_log

from pipeline.analysis import Options
from pipeline.recording.log_setup import set_up_log
from pipeline.recording.readings import Held
from pipeline.words import format_finding

TOGETHER = 1.0
"""Track and wheelbase [m]: half of it is the lever of a wheel."""


def draw_sideways(seed: int) -> tuple[Drive, np.ndarray]:
    """A drive that also moves to the left, and what is asked: ahead, to the left, of the heading."""
    drive = draw(seed)
    aside = np.random.default_rng(seed).uniform(-0.6, 0.6, 200)[(drive.time / 2.0).astype(int)]
    place = np.cumsum((drive.asked[:, 0] + 1j * aside) * np.exp(1j * np.cumsum(drive.asked[:, 1]) * STEP))
    noise = np.random.default_rng(seed).normal(0.0, 0.002, (2, drive.rows.size))
    yaw = np.cumsum(drive.asked[:, 1])[drive.rows] * STEP
    drive = replace(drive, place=STEP * place[drive.rows] + noise[0] + 1j * noise[1], yaw=yaw + noise[0])
    return drive, np.column_stack([drive.asked[:, 0], aside, drive.asked[:, 1]])


@pytest.mark.parametrize("backward", ["", "left", "right"])
def test_an_unknown_mecanum_is_measured_whatever_its_encoders_count(backward: str, tmp_path: Path) -> None:
    drive, asked = draw_sideways(61)
    ahead, aside, turn = asked.T * [[1.0], [1.0], [0.5 * TOGETHER]]
    joints = {}
    for end, outward in (("front", 1.0), ("rear", -1.0)):
        for side, sense in (("left", -1.0), ("right", 1.0)):
            speed = (ahead + sense * (outward * aside + turn)) / RADIUS
            sign = -1.0 if side == backward else 1.0
            joints[f"{end}_{side}_wheel_joint"] = Held(drive.time[::5], sign * speed[::5])
    setup = set_up_log(
        write_log(tmp_path / "log.mcap", drive, joints=joints, asked=asked), Options(out=tmp_path)
    )
    assert setup.vehicle.kind == "mecanum"
    assert setup.vehicle.wheel_radius_m == pytest.approx(RADIUS, rel=0.03)
    assert setup.vehicle.kinematics.turning_width_m(setup.vehicle) == pytest.approx(TOGETHER, rel=0.03)
    assert setup.configuration.wheels.reversed == (backward or None)
    told = [format_finding(one) for one in setup.choice.findings if one.id == "wheels_corrected"]
    assert len(told) == bool(backward)


def test_joints_that_do_not_say_where_they_are_leave_the_body_command(tmp_path: Path) -> None:
    drive, asked = draw_sideways(62)
    joints = {f"wheel_{k}": Held(drive.time[::5], asked[::5, 0] / RADIUS) for k in range(1, 5)}
    log = write_log(tmp_path / "log.mcap", drive, joints=joints, asked=asked)
    setup = set_up_log(log, Options(out=tmp_path))
    assert setup.sources.wheels is None
    assert any("not used: /joint_states" in format_finding(one) for one in setup.choice.findings)
