"""A command that nothing follows, beside one that a simulated body follows at once."""

from pathlib import Path

import numpy as np
import pytest
from drawn_drives import DrawnDrive, DrawnTopic, record_cdr, record_twist, stamp_ros, write_drawn

from pipeline.analysis import Options
from pipeline.core import Floats
from pipeline.recording.log_setup import LogSetup, set_up_log

RADIUS, TRACK = 0.165, 0.55


def wander(seed: int, count: int, hold_s: float) -> Floats:
    """Smooth numbers from -1 to 1 at 20 Hz, as of a closed loop."""
    rng = np.random.default_rng(seed)
    time = 0.05 * np.arange(count)
    knots = np.arange(-hold_s, time[-1] + hold_s, hold_s)
    return np.asarray(np.interp(time, knots, rng.uniform(-1.0, 1.0, knots.size)))


def drive_at_once(seed: int, seconds: float = 100.0) -> DrawnDrive:
    count = int(20 * seconds)
    time = 0.05 * np.arange(count)
    stands = (time < 2.0) | (time > seconds - 2.0)
    speed, turn = (np.where(stands, 0.0, one) for one in (0.6 + 0.1 * wander(seed, count, 3.0),
                                                          0.6 * wander(seed + 1, count, 1.5)))  # fmt: skip
    yaw = np.append(0.0, np.cumsum(turn[:-1]) * 0.05)
    step = 0.05 * speed * np.exp(1j * (yaw + 0.025 * turn))
    place = np.append(0.0, np.cumsum(step[:-1]))
    noise = np.random.default_rng(seed + 2).normal(0.0, 0.01, (3, count))
    return DrawnDrive(time, speed, turn, place.real + noise[0], place.imag + noise[1], yaw + 0.5 * noise[2])


def drive_otherwise(drive: DrawnDrive, seed: int) -> DrawnDrive:
    """Commands of the same hours that are another drive's: ahead most of the time, too."""
    count = drive.time.size
    still = np.abs(drive.speed) < 0.01
    speed, turn = 0.5 + 0.2 * wander(seed, count, 5.0), wander(seed + 1, count, 4.0)
    return DrawnDrive(drive.time, np.where(still, 0.0, speed), np.where(still, 0.0, turn), *(drive.x,) * 3)


def record_numbers(drive: DrawnDrive, kind: str) -> list[DrawnTopic]:
    half = 0.5 * TRACK * drive.turn
    rates = {"left": (drive.speed - half) / RADIUS, "right": (drive.speed + half) / RADIUS}
    kinds = {"cmd": 0.0, "velocity": 0.003}
    rng = np.random.default_rng(5)
    return [
        record_cdr(drive, f"/wheel_{side}/{name}", kind, {"data": rate + rng.normal(0.0, noise, rate.size)})
        for name, noise in kinds.items()
        for side, rate in rates.items()
    ]


def record_pose(drive: DrawnDrive) -> DrawnTopic:
    fields = stamp_ros(drive) | drive.pose("pose.") | {"header.frame_id": "map"}
    return record_cdr(drive, "/lio/pose", "geometry_msgs/msg/PoseStamped", fields)


def set_up(tmp_path: Path, *topics: DrawnTopic) -> LogSetup:
    return set_up_log(write_drawn(tmp_path / "log.mcap", *topics), Options(out=tmp_path))


@pytest.mark.parametrize(("kind", "seed"), [("Float64", 3), ("Float32", 40)])
def test_wheel_commands_are_taken_beside_a_body_command_that_nothing_follows(
    kind: str, seed: int, tmp_path: Path
) -> None:
    drive = drive_at_once(seed)
    decoy = record_twist(drive_otherwise(drive, seed + 8), "/navigation/cmd_vel")
    setup = set_up(tmp_path, decoy, record_pose(drive), *record_numbers(drive, f"std_msgs/msg/{kind}"))
    assert str(setup.sources.command) == "/wheel_left/cmd.data, /wheel_right/cmd.data"
    assert "role_by_motion" not in {one.id for one in setup.choice.findings}


@pytest.mark.parametrize("seed", [3, 21])
def test_a_body_command_is_taken_whose_name_is_less_usual_than_that_of_one_that_nothing_follows(
    seed: int, tmp_path: Path
) -> None:
    drive = drive_at_once(seed)
    decoy = record_twist(drive_otherwise(drive, seed + 8), "/cmd_vel")
    followed = record_twist(drive, "/base/command")
    setup = set_up(tmp_path, decoy, followed, record_pose(drive))
    assert str(setup.sources.command) == "/base/command"


def test_a_command_that_equals_the_motion_at_once_is_one_where_nothing_else_is_followed(
    tmp_path: Path,
) -> None:
    drive = drive_at_once(3)
    setup = set_up(tmp_path, record_twist(drive, "/cmd_vel"), record_pose(drive))
    assert str(setup.sources.command) == "/cmd_vel"
