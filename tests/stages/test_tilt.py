"""Poses in the plane get the slope that an IMU tells, and nothing where it tells none."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_drives import (
    STEP_S,
    DrawnDrive,
    DrawnTopic,
    draw_drive,
    extract_drawn,
    read_findings,
    record_cdr,
    record_twist,
    stamp_ros,
    write_drawn,
)

from pipeline.core import Floats, rigid


def record_poses(drive: DrawnDrive, pitch: float = 0.0) -> DrawnTopic:
    """Poses in the plane, or with pitch up to an angle."""
    fields = stamp_ros(drive) | drive.pose("pose.") | {"header.frame_id": "map"}
    leaning = rigid.quaternions_from_euler(0.0 * drive.yaw, pitch * np.sin(drive.time), drive.yaw)
    fields |= {f"pose.orientation.{name}": leaning[:, i] for i, name in enumerate("xyzw")}
    return record_cdr(drive, "/amcl/pose", "geometry_msgs/msg/PoseStamped", fields)


def record_imu(
    drive: DrawnDrive, slope: float, *, turned: bool = False, down: bool = False, oriented: bool = True
) -> DrawnTopic:
    """Orientations on a plane that rises to the north, in an IMU that looks ahead, or to the left.

    Without orientations it has accelerations with a noise of .5 m/s^2 and a bias of .1 m/s^2.
    """
    normal = np.array([0.0, -np.sin(slope), np.cos(slope)])
    # In the frame of the heading, which is of a magnetometer that is a radian off.
    ahead, left = normal[1] * np.sin(drive.yaw), normal[1] * np.cos(drive.yaw)
    roll, pitch = np.arctan2(-left, normal[2]), np.arctan2(ahead, np.hypot(left, normal[2]))
    body = rigid.quaternions_from_euler(roll, pitch, drive.yaw + 1.0)
    if turned:
        quarter = np.array([[0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]])
        body = rigid.multiply_quaternions(body, quarter)
    fields = stamp_ros(drive) | {"header.frame_id": "imu_link", "angular_velocity.z": drive.turn}
    fields |= {f"orientation.{name}": body[:, i] for i, name in enumerate("xyzw")}
    moved = np.column_stack((np.gradient(drive.speed, STEP_S), drive.speed * drive.turn, 0.0 * drive.turn))
    moved = moved[:, [1, 0, 2]] * [1.0, -1.0, 1.0] if turned else moved
    gravity = rigid.rotate(
        rigid.invert_quaternions(body), np.broadcast_to([0.0, 0.0, -9.81 if down else 9.81], moved.shape)
    )
    force = moved + gravity
    if not oriented:
        # As of a driver that fills in no orientation and says so by the covariance.
        fields |= {f"orientation.{name}": 0.0 * drive.yaw for name in "xyz"}
        fields |= {"orientation.w": 1.0 + 0.0 * drive.yaw}
        force = force + np.random.default_rng(3).normal(0.1, 0.5, force.shape)
    fields |= {f"linear_acceleration.{name}": force[:, i] for i, name in enumerate("xyz")}
    return record_cdr(drive, "/imu/data", "sensor_msgs/msg/Imu", fields)


def record_mounting(drive: DrawnDrive) -> DrawnTopic:
    count, half = drive.time.size, [float(np.sqrt(0.5))]
    frames = {"header.frame_id": ["base_link"], "child_frame_id": ["imu_link"]}
    turn = {"transform.rotation.z": half, "transform.rotation.w": half}
    fields = {f"transforms[].{name}": [value] * count for name, value in (frames | turn).items()}
    return record_cdr(drive, "/tf_static", "tf2_msgs/msg/TFMessage", fields)


@pytest.mark.parametrize(
    ("turned", "is_known"), [(False, False), (True, True), (True, False)], ids=["ahead", "told", "felt"]
)
def test_slope_and_height_of_poses_in_the_plane_are_those_of_an_imu(
    tmp_path: Path, *, turned: bool, is_known: bool
) -> None:
    """Which way it looks a transform tells, or what it feels of the driving."""
    drive, slope = draw_drive(60.0), np.radians(12.0)
    topics = [record_twist(drive), record_poses(drive), record_imu(drive, slope, turned=turned)]
    topics += [record_mounting(drive)] if is_known else []
    log = write_drawn(tmp_path / "log.mcap", *topics)
    poses = extract_drawn(log)
    assert poses["z"].to_numpy() == pytest.approx(np.tan(slope) * (drive.y - drive.y[0]), abs=0.1)
    quaternion = poses.select("q_x", "q_y", "q_z", "q_w").to_numpy()
    up = rigid.rotate(quaternion, np.broadcast_to([0.0, 0.0, 1.0], (poses.height, 3)))
    assert up == pytest.approx(np.broadcast_to([0.0, -np.sin(slope), np.cos(slope)], up.shape), abs=0.02)
    said = read_findings(log)["slope_by_imu"]
    assert "up to 12 degrees" in said
    assert ("90 degrees to the left of ahead" in said) == (turned and not is_known)


@pytest.mark.parametrize(
    ("turned", "is_known"), [(False, False), (True, True), (True, False)], ids=["ahead", "told", "felt"]
)
def test_accelerations_alone_tell_a_slope(tmp_path: Path, *, turned: bool, is_known: bool) -> None:
    """Less those of the poses they are gravity, averaged over two seconds."""
    drive, slope = draw_drive(120.0), np.radians(12.0)
    imu = record_imu(drive, slope, turned=turned, oriented=False)
    topics = [record_twist(drive), record_poses(drive), imu, *([record_mounting(drive)] if is_known else [])]
    log = write_drawn(tmp_path / "log.mcap", *topics)
    poses = extract_drawn(log)
    quaternion = poses.select("q_x", "q_y", "q_z", "q_w").to_numpy()
    up = rigid.rotate(quaternion, np.broadcast_to([0.0, 0.0, 1.0], (poses.height, 3)))
    off = up - np.array([0.0, -np.sin(slope), np.cos(slope)])
    assert np.sqrt(np.mean(off**2, axis=0)).max() < 0.04
    assert "slope_by_imu" in read_findings(log)


def test_accelerations_on_a_floor_tell_no_slope(tmp_path: Path) -> None:
    drive = draw_drive(120.0)
    topic = record_imu(drive, 0.0, oriented=False)
    poses = extract_drawn(write_drawn(tmp_path / "log.mcap", record_twist(drive), record_poses(drive), topic))
    assert (poses["z"] == 0.0).all()


def test_an_orientation_that_is_not_of_its_specific_force_tells_no_slope(tmp_path: Path) -> None:
    """One of north, east, down has the other sign of pitch."""
    drive = draw_drive(60.0)
    topic = record_imu(replace(drive, yaw=-drive.yaw), np.radians(12.0), down=True)
    poses = extract_drawn(write_drawn(tmp_path / "log.mcap", record_twist(drive), record_poses(drive), topic))
    assert (poses["z"] == 0.0).all()


@pytest.mark.parametrize(("slope", "pitch"), [(1.0, 0.0), (12.0, 0.1)], ids=["floor", "known"])
def test_a_floor_stays_level_and_slopes_that_are_known_stay(
    slope: float, pitch: float, tmp_path: Path
) -> None:
    drive = draw_drive(60.0)
    poses = extract_drawn(
        write_drawn(
            tmp_path / "log.mcap",
            record_twist(drive),
            record_poses(drive, pitch),
            record_imu(drive, np.radians(slope)),
        )
    )
    assert (poses["z"] == 0.0).all()
    assert poses["q_y"].abs().max() < max(pitch, 1e-6)


def record_tilt(drive: DrawnDrive, roll: Floats, pitch: Floats) -> DrawnTopic:
    body = rigid.quaternions_from_euler(roll, pitch, drive.yaw)
    fields = stamp_ros(drive) | {"header.frame_id": "imu_link", "angular_velocity.z": drive.turn}
    fields |= {f"orientation.{name}": body[:, i] for i, name in enumerate("xyzw")}
    return record_cdr(drive, "/imu/data", "sensor_msgs/msg/Imu", fields)


def test_a_filter_that_takes_accelerations_for_gravity_tells_no_slope(tmp_path: Path) -> None:
    """Heights of a floor that it made up were jumps of the localization."""
    drive = draw_drive(60.0)
    ahead, left = 3.0 * np.gradient(drive.speed, STEP_S), 3.0 * drive.speed * drive.turn
    topic = record_tilt(drive, np.arctan(left / 9.81), -np.arctan(ahead / 9.81))
    poses = extract_drawn(write_drawn(tmp_path / "log.mcap", record_twist(drive), record_poses(drive), topic))
    assert (poses["z"] == 0.0).all()


def test_what_does_not_turn_with_the_heading_is_no_slope_and_that_of_the_mounting(tmp_path: Path) -> None:
    """On rounds over a slope of 10 degrees to the north an IMU leans by 6 degrees more."""
    time = np.arange(0.0, 90.0, STEP_S)
    speed, turn = 0.8 + 0.1 * np.sin(0.5 * time), np.full(time.size, 0.3)
    yaw, slope, mounted = 0.3 * time, np.radians(10.0), np.radians(6.0)
    x, y = (np.cumsum(speed * part) * STEP_S for part in (np.cos(yaw), np.sin(yaw)))
    drive = DrawnDrive(time, speed, turn, x, y, yaw)
    roll, pitch = slope * np.cos(yaw), -slope * np.sin(yaw)
    topic = record_tilt(drive, roll, pitch + mounted)
    poses = extract_drawn(write_drawn(tmp_path / "log.mcap", record_twist(drive), record_poses(drive), topic))
    leaning = rigid.euler_from_quaternions(poses.select("q_x", "q_y", "q_z", "q_w").to_numpy())
    assert np.degrees(leaning[1]) == pytest.approx(np.degrees(np.interp(poses["t"], time, pitch)), abs=0.5)
