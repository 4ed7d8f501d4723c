"""Two publishers on one topic, of commands or of poses: found by turns, and a single one is not accused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_drives import (
    STEP_S,
    TWIST,
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

from pipeline.core import Floats, SlipError
from pipeline.recording.pose_topics import find_tracks
from pipeline.recording.publishers import find_turns


def send(period_s: float, first_s: float, last_s: float, value: float | Floats) -> tuple[Floats, Floats]:
    """Times of messages and their values, shape (n, 2)."""
    times = np.arange(first_s, last_s, period_s)
    return times, np.broadcast_to(value, (times.size, 2)) * np.ones((1, 2))


def mix(*publishers: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    times, asked = (np.concatenate(parts) for parts in zip(*publishers, strict=True))
    order = np.argsort(times, kind="stable")
    return times[order], asked[order]


def test_turns_are_found_where_they_are() -> None:
    for period_s in [0.05, 0.1, 0.23]:
        for other in [0.0, -0.7]:
            ((start, end),) = find_turns(*mix(send(0.1, 0.0, 60.0, 1.0), send(period_s, 20.037, 40.0, other)))
            assert start == pytest.approx(20.0, abs=0.5)
            assert end == pytest.approx(40.0, abs=0.5)


def test_one_publisher_is_not_accused() -> None:
    times = np.arange(0.0, 60.0, 0.1) + np.random.default_rng(1).uniform(0.0, 0.005, 600)
    noise = np.random.default_rng(2).normal(size=(600, 1))
    pressed = np.where(times % 2.0 < 1.0, 1.0, 0.0)[:, None]
    switching = np.where(np.arange(600) % 2, 1.0, -1.0)[:, None]
    for asked in (noise, pressed, np.sin(times)[:, None], switching):
        assert find_turns(times, asked) == []


def test_what_two_publishers_ask_for_by_turns_is_left_out(tmp_path: Path) -> None:
    drive = draw_drive(120.0)
    real = record_twist(drive)
    rows = drive.rows(30.0, 60.0)
    zeros = record_cdr(drive, "/cmd_vel", TWIST, {"linear.x": 0.0 * drive.time}, rows=rows)
    both = replace(
        real,
        times=np.concatenate((real.times, zeros.times + 17_000_000)),
        messages=[*real.messages, *zeros.messages],
    )
    fields = stamp_ros(drive) | drive.pose("pose.") | {"header.frame_id": "map"}
    poses = record_cdr(drive, "/lio/pose", "geometry_msgs/msg/PoseStamped", fields)
    log = write_drawn(tmp_path / "log.mcap", both, poses)
    findings = extract_drawn(log, "findings").to_dicts()
    (text,) = [one["text"] for one in findings if one["id"] == "command_mixed"]
    assert "two publishers send commands on /cmd_vel by turns from 30 to 57 s" in text
    commands = extract_drawn(log, "commands")
    inside = (commands["t"] > 31.0) & (commands["t"] < 56.0)
    assert not commands.filter(inside)["active"].any()
    assert commands.filter((commands["t"] < 29.0) | (commands["t"] > 58.0))["active"].all()


def drive_other(drive: DrawnDrive) -> DrawnDrive:
    """A robot that starts elsewhere and drives otherwise, in the same time."""
    time, goes = drive.time, drive.time % 17.0 > 4.0
    speed = np.where(goes, 0.5 + 0.2 * np.sin(0.53 * time + 1.0), 0.0)
    turn = np.where(goes, 0.6 * np.sin(0.61 * time + 0.5), 0.0)
    yaw = 1.0 + np.cumsum(turn) * STEP_S
    x, y = (np.cumsum(speed * part) * STEP_S for part in (np.cos(yaw), np.sin(yaw)))
    return replace(drive, x=4.0 + x, y=3.0 + y, yaw=yaw)


def record_poses(drive: DrawnDrive, kind: str, late_s: float = 0.0) -> DrawnTopic:
    """Poses on a topic of a type, stamped and recorded late."""
    fields = {
        "tf2_msgs/msg/TFMessage": {
            "transforms[].header.frame_id": [["odom"]] * drive.time.size,
            "transforms[].child_frame_id": [["base_link"]] * drive.time.size,
            "transforms[].header.stamp.sec": (drive.stamps + int(1e9 * late_s))[:, None] // 10**9,
            "transforms[].header.stamp.nanosec": (drive.stamps + int(1e9 * late_s))[:, None] % 10**9,
            "transforms[].transform.translation.x": drive.x[:, None],
            "transforms[].transform.translation.y": drive.y[:, None],
            "transforms[].transform.rotation.z": np.sin(drive.yaw / 2.0)[:, None],
            "transforms[].transform.rotation.w": np.cos(drive.yaw / 2.0)[:, None],
        },
        "nav_msgs/msg/Odometry": {"header.frame_id": "odom"} | drive.pose("pose.pose."),
        "geometry_msgs/msg/PoseStamped": {"header.frame_id": "map"} | drive.pose("pose."),
    }[kind]
    topic = "/tf" if "tf2" in kind else "/odom"
    made = record_cdr(drive, topic, kind, fields)
    return replace(made, times=made.times + int(1e9 * late_s))


@pytest.mark.parametrize(
    "kind", ["tf2_msgs/msg/TFMessage", "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"]
)
@pytest.mark.parametrize("number", [1, 2])
def test_of_two_publishers_of_poses_the_one_that_follows_the_command_is_taken(
    kind: str, number: int, tmp_path: Path
) -> None:
    drive = draw_drive(90.0)
    bodies = [drive, drive_other(drive)] if number == 1 else [drive_other(drive), drive]
    poses = [record_poses(one, kind, late_s) for one, late_s in zip(bodies, (0.0, 0.017), strict=True)]
    log = write_drawn(tmp_path / "log.mcap", record_twist(drive), *poses)
    np.testing.assert_allclose(extract_drawn(log)["x"], drive.x, atol=1e-9)
    text = read_findings(log)["track_taken"]
    assert "by turns: its poses jump to and fro between two tracks" in text
    assert f"which follow /cmd_vel ([pose] track = {number} in run.toml" in text
    assert ("odom -> base_link" in text) == ("tf2" in kind)
    other = extract_drawn(log, pose={"track": 3 - number})
    np.testing.assert_allclose(other["x"], bodies[2 - number].x, atol=1e-9)
    told = read_findings(log, pose={"track": 3 - number})["configured_wrongly"]
    assert (
        f"[pose] in run.toml (or in a fleet.toml above it) gives track = {3 - number}, which contradicts"
        in told
    )
    assert f"without it track = {number} is found" in told


def test_two_tracks_that_both_follow_the_command_are_told_and_nothing_is_estimated(tmp_path: Path) -> None:
    drive = draw_drive(90.0)
    yaw = 0.9 * drive.yaw
    x, y = (np.cumsum(drive.speed * part) * STEP_S for part in (np.cos(yaw), np.sin(yaw)))
    estimators = [drive, replace(drive, x=x, y=y, yaw=yaw)]
    kind = "tf2_msgs/msg/TFMessage"
    poses = [record_poses(one, kind, late_s) for one, late_s in zip(estimators, (0.0, 0.017), strict=True)]
    log = write_drawn(tmp_path / "log.mcap", record_twist(drive), *poses)
    (found,) = [one for one in extract_drawn(log, "findings").to_dicts() if one["id"] == "tracks_mixed"]
    assert found["severity"] == "error"
    assert "both of which follow what drives the vehicle" in found["text"]
    assert "[pose] track = 1 or 2" in found["text"]
    assert "tracks_mixed" not in read_findings(log, pose={"track": 2})


def test_a_track_of_a_single_publisher_is_refused(tmp_path: Path) -> None:
    drive = draw_drive(90.0)
    poses = record_poses(drive, "geometry_msgs/msg/PoseStamped")
    log = write_drawn(tmp_path / "log.mcap", record_twist(drive), poses)
    with pytest.raises(SlipError, match="do not alternate between two"):
        extract_drawn(log, pose={"track": 1})


def test_noise_jumps_and_single_outliers_are_no_second_track() -> None:
    rng = np.random.default_rng(3)
    time = np.arange(0.0, 120.0, 0.1)
    way = np.column_stack((0.8 * time, np.sin(0.2 * time), 0.0 * time))
    noisy = way + rng.normal(size=way.shape)
    standing = rng.normal(size=way.shape)
    corrected = way + np.where(time > 60.0, 5.0, 0.0)[:, None]
    outliers = way + np.where(np.arange(time.size) % 30 == 7, 5.0, 0.0)[:, None]
    shaken = way + 0.1 * np.where(rng.uniform(size=time.size) < 0.3, 1.0, 0.0)[:, None]
    for position in (way, noisy, 0.1 * noisy, 0.05 * standing, standing, corrected, outliers, shaken):
        assert find_tracks(time, position, 0.1) is None
    mixed = np.where((np.arange(time.size) % 3 == 2)[:, None], way[::-1], way)
    found = find_tracks(time, mixed, 0.1)
    assert found is not None
    assert found[:6].tolist() == [1, 1, 2, 1, 1, 2]


def record_localization(drive: DrawnDrive) -> DrawnTopic:
    """Poses of a body that turns less than its wheels say."""
    yaw = drive.yaw / 1.3
    x, y = (np.cumsum(drive.speed * part) * STEP_S for part in (np.cos(yaw), np.sin(yaw)))
    x, y = np.stack((x, y)) + np.random.default_rng(5).normal(scale=0.01, size=(2, x.size))
    fields = {"header.frame_id": "map"} | replace(drive, x=x, y=y, yaw=yaw).pose("pose.")
    return record_cdr(drive, "/lio/pose", "geometry_msgs/msg/PoseStamped", fields)


def record_odometry(drive: DrawnDrive, late_s: float = 0.0, per_rad: float = 1.0) -> DrawnTopic:
    """Odometry with the speeds of the wheels, whose yaw rate may be in another unit."""
    fields = {"header.frame_id": "odom", "child_frame_id": "base_link"} | drive.pose("pose.pose.")
    fields |= {"twist.twist.linear.x": drive.speed, "twist.twist.angular.z": per_rad * drive.turn}
    made = record_cdr(drive, "/odom", "nav_msgs/msg/Odometry", fields)
    return replace(made, times=made.times + int(1e9 * late_s))


def test_speeds_that_two_publishers_send_by_turns_are_not_used(tmp_path: Path) -> None:
    drive = draw_drive(90.0)
    poses = record_localization(drive)
    both = [record_odometry(drive), record_odometry(drive_other(drive), 0.017)]
    log = write_drawn(tmp_path / "log.mcap", record_twist(drive), poses, *both)
    assert "two publishers send on it by turns" in read_findings(log)["numbers_not_used"]
    with pytest.raises(SlipError, match="hold no 'wheels'"):
        extract_drawn(log, "wheels")


def test_the_unit_of_speeds_is_that_by_which_their_own_pose_moves(tmp_path: Path) -> None:
    drive = draw_drive(90.0)
    poses = record_localization(drive)
    odometry = record_odometry(drive, per_rad=180.0 / np.pi)
    log = write_drawn(tmp_path / "log.mcap", record_twist(drive), poses, odometry)
    text = read_findings(log)["wheels_corrected"]
    assert "the yaw rate of /odom is in deg/s" in text
    assert 'yaw_unit = "deg/s" under [wheels]' in text
    (tmp_path / "given").mkdir()
    again = write_drawn(tmp_path / "given" / "log.mcap", record_twist(drive), poses, odometry)
    assert "wheels_corrected" not in read_findings(again, wheels={"yaw_unit": "deg/s"})
