"""The gain of a preset's own unit: a log whose odometry or whose poses say another one tells it."""

from pathlib import Path

import numpy as np
from drawn_drives import DrawnDrive, record_cdr, stamp_ros, write_drawn

from pipeline.analysis import Options
from pipeline.core import Floats
from pipeline.recording.log_setup import set_up_log
from pipeline.words import format_finding

TICKS = "std_msgs/msg/Float64"
POSE = "geometry_msgs/msg/PoseStamped"
ODOMETRY = "nav_msgs/msg/Odometry"


def _add_up(speed: Floats, turn: Floats) -> tuple[Floats, Floats, Floats]:
    """Positions and headings of rates at 25 Hz."""
    yaw = np.cumsum(turn) * 0.04
    place = np.cumsum(speed * np.exp(1j * yaw)) * 0.04
    return place.real, place.imag, yaw


def ask(folder: Path, *, gain: float, has_odometry: bool, lines: str = "") -> str:
    """What is said of the gain of an F1TENTH car that counts so many turns a minute at a metre a second."""
    time = np.arange(0.0, 40.0, 0.04)
    speed = 1.2 + 0.8 * np.sin(0.7 * time)
    angle = 0.2 * np.sin(0.45 * time)
    turn = speed * np.tan(angle) / 0.25
    does = DrawnDrive(time, speed, turn, *_add_up(speed, turn))
    servo = 0.5304 - 1.2135 * angle
    stamped = stamp_ros(does)
    pose = stamped | does.pose("pose.") | {"header.frame_id": "map"}
    topics = [
        record_cdr(does, "/commands/motor/speed", TICKS, {"data": gain * np.roll(speed, -2)}),
        record_cdr(does, "/commands/servo/position", TICKS, {"data": np.roll(servo, -2)}),
        record_cdr(does, "/mocap/f1tenth/pose", POSE, pose),
    ]
    if has_odometry:
        said = stamped | {"header.frame_id": "odom", "child_frame_id": "base_link"}
        adds = DrawnDrive(time, speed, turn, *_add_up(speed, 0.6 * turn))
        said |= adds.pose("pose.pose.") | {"twist.twist.linear.x": speed, "twist.twist.angular.z": 0.6 * turn}
        topics.append(record_cdr(does, "/vesc/odom", ODOMETRY, said))
    folder.mkdir()
    (folder / "run.toml").write_text(f'[vehicle]\npreset = "f1tenth"\n{lines}', encoding="utf-8")
    setup = set_up_log(write_drawn(folder / "log.mcap", *topics), Options(out=folder))
    texts = [format_finding(one) for one in setup.choice.findings if one.id == "gain_assumed"]
    assert len(texts) < 2
    return "".join(texts)


def test_the_gain_of_a_preset_is_told_where_odometry_or_poses_say_another_one(tmp_path: Path) -> None:
    assert not ask(tmp_path / "a", gain=4614.0, has_odometry=True)
    said = ask(tmp_path / "b", gain=7400.0, has_odometry=True)
    assert "a gain of 4614 erpm per m/s is assumed" in said
    assert "/vesc/odom of this log says 7" in said
    assert "scale = 0.62" in said
    assert "the way of /mocap/f1tenth/pose says 7" in ask(tmp_path / "c", gain=7400.0, has_odometry=False)
    scaled = f"[command]\nscale = {4614.0 / 7400.0}\n"
    assert not ask(tmp_path / "d", gain=7400.0, has_odometry=True, lines=scaled)
