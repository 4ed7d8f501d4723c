"""Lengths of the controller of drives whose wheels do not do all that they are told."""

from pathlib import Path

import numpy as np
import pytest
from drawn_drives import DrawnDrive, DrawnTopic, record_cdr, record_json, record_twist, stamp_ros, write_drawn

from pipeline.analysis import Options
from pipeline.core import Floats
from pipeline.recording.log_setup import LogSetup, set_up_log

STEP = 0.05
LAG = 0.2


def write_drive(
    tmp_path: Path,
    radius: float,
    track: float,
    *,
    top: float = np.inf,
    gains: tuple[float, float] = (1.0, 1.0),
    form: str = "joints",
    has_pose: bool = True,
    seconds: float = 100.0,
    turns_in: tuple[float, float] = (0.0, np.inf),
    drawn_m: float | None = None,
) -> LogSetup:
    """A log of a base whose sides turn by gains, and no faster than a limit of the rim [m/s].

    Its fastest command ahead is 1 m/s; it turns between two times alone, and draws its wheels at a height.
    """
    rng = np.random.default_rng(12)
    time = np.arange(0.0, seconds, STEP)
    hold = np.searchsorted(np.cumsum(rng.uniform(1.5, 4.0, 80)), time)
    speed = (rng.uniform(0.2, 1.0, 80) * rng.choice([1.0, 1.0, 1.0, -1.0], 80))[hold]
    turn = rng.uniform(-0.8, 0.8, 80)[hold] / track * 0.5
    turn = np.where((time > turns_in[0]) & (time < turns_in[1]), turn, 0.0)
    sides = []
    for sign, gain in zip((-1.0, 1.0), gains, strict=True):
        asked = np.clip(gain * (speed + 0.5 * sign * track * turn), -top, top)
        made = np.zeros(time.size)
        for row in range(1, time.size):
            made[row] = made[row - 1] + STEP / LAG * (asked[row - 1] - made[row - 1])
        sides.append(made)
    left, right = sides
    ahead, yaw = 0.5 * (left + right), np.append(0.0, np.cumsum((right - left)[:-1] / track) * STEP)
    place = np.append(0.0, np.cumsum(ahead[:-1] * np.exp(1j * yaw[:-1])) * STEP)
    noise = rng.normal(0.0, 0.002, (3, time.size))
    does = DrawnDrive(time, speed, turn, place.real + noise[0], place.imag + noise[1], yaw + noise[2])
    topics = [record_twist(does), *record_wheels(does, left / radius, right / radius, form)]
    if drawn_m is not None:
        topics.append(record_wheel_frames(does, track, drawn_m))
    if has_pose:
        fields = stamp_ros(does) | does.pose("pose.") | {"header.frame_id": "map"}
        topics.append(record_cdr(does, "/lio/pose", "geometry_msgs/msg/PoseStamped", fields))
    return set_up_log(write_drawn(tmp_path / "log.mcap", *topics), Options(out=tmp_path))


def record_wheels(drive: DrawnDrive, left: Floats, right: Floats, form: str) -> list[DrawnTopic]:
    if form == "numbers":
        pairs = {"/left_wheel/velocity": left, "/right_wheel/velocity": right}
        return [record_cdr(drive, name, "std_msgs/msg/Float64", {"data": one}) for name, one in pairs.items()]
    fields = {
        "name": [["left_wheel_joint", "right_wheel_joint"]] * left.size,
        "velocity": np.column_stack([left, right]).tolist(),
    }
    return [record_cdr(drive, "/joint_states", "sensor_msgs/msg/JointState", stamp_ros(drive) | fields)]


def record_wheel_frames(drive: DrawnDrive, track: float, height: float) -> DrawnTopic:
    """Transforms of both wheels, at one height over base_footprint."""
    sides = {"left": 0.5 * track, "right": -0.5 * track}
    messages = [
        {
            "transforms": [
                {
                    "header": {"stamp": {"sec": int(at), "nanosec": 0}, "frame_id": "base_footprint"},
                    "child_frame_id": f"wheel_{side}_link",
                    "transform": {
                        "translation": {"x": 0.0, "y": y, "z": height},
                        "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
                    },
                }
                for side, y in sides.items()
            ]
        }
        for at in drive.time
    ]
    return record_json(drive, "/tf", "tf2_msgs/msg/TFMessage", messages)


@pytest.mark.parametrize(
    ("radius", "track", "top", "form"),
    [(0.1, 0.5, 0.55, "joints"), (0.165, 0.55, 0.7, "numbers"), (0.036, 0.235, 0.5, "joints")],
)
def test_lengths_of_a_controller_are_those_of_wheels_below_their_limit(
    radius: float, track: float, top: float, form: str, tmp_path: Path
) -> None:
    vehicle = write_drive(tmp_path, radius, track, top=top, form=form).vehicle
    assert vehicle.wheel_radius_m == pytest.approx(radius, rel=0.02)
    assert vehicle.track_width_m == pytest.approx(track, rel=0.03)


@pytest.mark.parametrize(
    ("gains", "form"), [((0.94, 1.0), "joints"), ((1.0, 0.9), "numbers"), ((1.08, 1.0), "joints")]
)
def test_sides_that_differ_leave_the_radius_to_the_poses(
    gains: tuple[float, float], form: str, tmp_path: Path
) -> None:
    setup = write_drive(tmp_path, 0.1, 0.5, gains=gains, form=form)
    assert setup.sources.wheels is not None
    assert setup.vehicle.wheel_radius_m == pytest.approx(0.1, rel=0.01)
    assert setup.vehicle.track_width_m == pytest.approx(0.5, rel=0.03)


def test_without_a_pose_the_lengths_are_those_of_wheels_below_their_limit(tmp_path: Path) -> None:
    vehicle = write_drive(tmp_path, 0.1, 0.5, top=0.55, has_pose=False).vehicle
    assert vehicle.wheel_radius_m == pytest.approx(0.1, rel=0.02)


def test_a_track_that_one_stretch_of_turning_shows_is_a_wide_guess(tmp_path: Path) -> None:
    vehicle = write_drive(tmp_path, 0.1, 0.3, has_pose=False, seconds=24.0, turns_in=(10.0, 18.0)).vehicle
    assert vehicle.track_width_m == pytest.approx(0.3, rel=0.05)
    assert vehicle.errors["track_width_m"] > 0.2 * 0.3
    assert not vehicle.stand_ins


def test_the_controller_knows_its_radius_better_than_the_frames_of_its_wheels(tmp_path: Path) -> None:
    vehicle = write_drive(tmp_path, 0.035, 0.235, drawn_m=0.025).vehicle
    assert vehicle.wheel_radius_m == pytest.approx(0.035, rel=0.02)
    assert vehicle.track_width_m == pytest.approx(0.235, rel=0.02)
