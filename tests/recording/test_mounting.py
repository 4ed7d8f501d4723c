"""Poses of another point, or in a turned frame, than those of the body."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_drives import DrawnTopic, draw_drive, record_cdr, record_twist, stamp_ros, write_drawn
from drawn_motion import STEP, draw
from written_logs import write_log

from pipeline.analysis import Options
from pipeline.core import SlipError
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
    assert ("ahead of" if ahead_m > 0.0 else "behind") in text


def test_at_one_speed_nothing_tells_a_sensor_ahead_from_a_slide(tmp_path: Path) -> None:
    drive = draw(63)
    rng = np.random.default_rng(5)
    turn = np.full(drive.time.size, 0.2)
    yaw = (np.cumsum(turn) * STEP)[drive.rows] + rng.normal(0.0, 0.003, drive.rows.size)
    # An odometry that adds up its speeds: it never moves sideways.
    place = np.cumsum(1.5 * 10.0 * STEP * np.exp(1j * np.append(yaw[0], yaw[:-1])))
    circle = replace(drive, place=place, yaw=yaw, speed=1.5 + 0.0 * turn, rate=turn)
    asked = np.tile([1.5, 0.3], (turn.size, 1))
    assert "pose_lever" not in find(write_log(tmp_path / "log.mcap", circle, asked=asked, is_measured=False))


def tumble(axis: str, kind: str, seed: int) -> list[DrawnTopic]:
    """Poses that an IMU integrates on a body that rocks about an axis as it walks, and the IMU's rates."""
    of, rng = draw_drive(30.0), np.random.default_rng(seed)
    time, count = of.time, of.time.size
    angles = {
        "x": 0.05 * np.sin(8.0 * time),
        "y": 0.05 * np.cos(8.0 * time),
        "z": np.cumsum(np.cumsum(rng.normal(0.0, 0.01, count))) * 0.01,
    }
    angles[axis] = 0.4 * np.sin(7.0 * time) + 0.08 * time
    half = {name: 0.5 * one for name, one in angles.items()}
    # Small angles, but for that of the axis.
    quaternion = {name: np.sin(one) for name, one in half.items()} | {"w": np.cos(half[axis])}
    norm = np.sqrt(sum(one**2 for one in quaternion.values()))
    way = 0.02 * time**2
    ahead = "y" if axis == "x" else "x"
    place = {axis: 0.05 * way, ahead: 0.4 * way, "z": 0.6 * way}
    inner = "pose.pose." if kind.endswith("Odometry") else "pose."
    fields = stamp_ros(of) | {"header.frame_id": "map"}
    fields |= {f"{inner}position.{name}": one for name, one in place.items()}
    fields |= {f"{inner}orientation.{name}": one / norm for name, one in quaternion.items()}
    rates = {name: np.gradient(one, time) + rng.normal(0.0, 0.5, count) for name, one in angles.items()}
    gyro = stamp_ros(of) | {f"angular_velocity.{name}": one for name, one in rates.items()}
    return [
        record_cdr(of, "/imu/odometry", kind, fields),
        record_cdr(of, "/imu", "sensor_msgs/msg/Imu", gyro),
    ]


@pytest.mark.parametrize(
    ("axis", "kind"), [("x", "nav_msgs/msg/Odometry"), ("y", "geometry_msgs/msg/PoseStamped")]
)
def test_an_axis_that_no_signal_agrees_on_is_asked_and_not_taken(
    axis: str, kind: str, tmp_path: Path
) -> None:
    topics = tumble(axis, kind, seed=8)
    with pytest.raises(SlipError, match="no topic can serve as command or measured wheels"):
        set_up_log(write_drawn(tmp_path / "alone.mcap", *topics), Options(out=tmp_path))
    asked = record_twist(draw_drive(30.0))
    setup = set_up_log(write_drawn(tmp_path / "log.mcap", asked, *topics), Options(out=tmp_path))
    told = {one.id: format_finding(one) for one in setup.choice.findings}
    assert f"the body turns most about the {axis} axis of /imu/odometry" in told["pose_undecided"]
    assert "pose_turned" not in told
    assert setup.configuration.pose.up is None
