"""The pose by frame and content; wheels in the units of their types; the scale of wheels."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from clocks import SimulatedClock
from simulated_platforms import scene_of
from stage_logs import FIELD, PLAIN, TakeThrough

from pipeline.core import rigid
from pipeline.logs import Ragged, RaggedStrings, TopicColumns, open_log, read_topics
from pipeline.logs.writer import LogWriter
from pipeline.recording.log_choice import Choice, choose
from pipeline.simulate import PoseSensor, Recording, Scenario, make_scenario, simulate_run, write_log
from pipeline.sources import (
    Configuration,
    DriveSection,
    PoseSection,
    find_preset,
    find_type,
    load_configuration,
)
from pipeline.stages.clocks import Recorded, align_clocks
from pipeline.stages.drive import read_joints
from pipeline.stages.extract import Given, extract_tables
from pipeline.stages.rates import unwrap_counter
from pipeline.stages.reading import (
    PoseArrays,
    find_angle_unit,
    find_lean,
    list_wanted,
    put_upright,
    read_pose_topic,
)

SECOND = 10**9
COUNT = 600


def look(log: Path) -> Choice:
    return choose(open_log(log), load_configuration(log), {})


def record(scenario: Scenario, folder: Path) -> Path:
    write_log(simulate_run(scenario), folder / "run.mcap")
    return folder / "run.mcap"


def write_wheels_and(log: LogWriter, position: np.ndarray, yaw: np.ndarray, stamps: np.ndarray) -> None:
    """Wheels that drive at half a metre a second, and one odometry that says what is given."""
    sides = {"name": ["left_wheel", "right_wheel"], "velocity": np.full((stamps.size, 2), 0.5 / 0.165)}
    log.metadata("deployment", {"vehicle": "husky_a200"})
    log.write_columns("/joint_states", "sensor_msgs/msg/JointState", stamps, sides, header_time=stamps)
    pose = {
        "pose.pose.position.x": position,
        "pose.pose.orientation.z": np.sin(yaw / 2),
        "pose.pose.orientation.w": np.cos(yaw / 2),
        "header.frame_id": "map",
    }
    log.write_columns("/state", "nav_msgs/msg/Odometry", stamps, pose, header_time=stamps)


@pytest.fixture
def stamps() -> np.ndarray:
    return 1_700_000_000 * SECOND + np.arange(COUNT) * SECOND // 20


def test_a_position_that_never_changes_while_the_heading_lives_is_refused(
    tmp_path: Path, stamps: np.ndarray
) -> None:
    with LogWriter(tmp_path / "run.mcap") as log:
        write_wheels_and(log, np.zeros(COUNT), np.linspace(0.0, 6.0, COUNT), stamps)
    (rating,) = look(tmp_path / "run.mcap").ratings
    assert "never changes while its heading turns" in rating.refusal


def test_beside_a_pose_of_the_wheels_alone_the_drive_is_observed_and_no_ground(tmp_path: Path) -> None:
    """Nothing at all was said of the drive that is named where no pose is recorded."""
    scenario = replace(
        FIELD,
        duration_s=40.0,
        pose=PoseSensor(source="wheels", noise_m=0.0, noise_rad=0.0),
        recording=Recording("tf"),
    )
    chosen = look(record(scenario, tmp_path))
    told = {finding.id: finding.text for finding in chosen.findings}
    assert told.keys() == {"ground_unobservable", "numbers_not_used"}
    assert "wheel odometry, not a localization" in told["numbers_not_used"]
    assert chosen.sources.pose.wheels is not None


def test_a_localization_is_never_taken_for_the_wheels(tmp_path: Path) -> None:
    chosen = look(record(replace(FIELD, duration_s=40.0, recording=Recording("tf")), tmp_path))
    assert not chosen.ratings[0].from_wheels
    assert chosen.findings == ()


@pytest.mark.parametrize(
    ("layout", "track", "said"),
    [
        ("tf", 0.16, "its controller turns commands into wheel speeds"),
        ("wheel_float", 0.16 * 1.5, "an effective track"),
    ],
    ids=["body commands", "wheel commands"],
)
def test_an_unknown_vehicle_gets_the_geometry_of_its_controller_or_of_its_motion(
    tmp_path: Path, layout: str, track: float, said: str
) -> None:
    scenario = make_scenario(None, {"effective_track": 1.5}, seed=2, duration_s=60.0, vehicle="turtlebot3")
    chosen = look(record(replace(scenario, recording=Recording(layout, deployment="absent")), tmp_path))
    assert chosen.vehicle_source == "fitted"
    assert chosen.vehicle.wheel_radius_m == pytest.approx(0.033, rel=0.02)
    assert chosen.vehicle.track_width_m == pytest.approx(track, rel=0.03)
    (finding,) = chosen.findings
    assert finding.id == "vehicle_fitted"
    assert said in finding.text


@pytest.mark.parametrize("period", [2**16, 2**32])
def test_a_counter_that_begins_again_goes_on(period: int) -> None:
    true = np.arange(0.0, 3.0 * period, period / 40.0)
    assert np.array_equal(unwrap_counter(true % period), true)


def test_a_body_in_north_east_down_is_turned_upright() -> None:
    # Heading east, rolled onto nothing, one metre north of the start and two metres up.
    heading = np.pi / 2.0
    fields = {f"position[{i}]": np.array([value]) for i, value in enumerate((1.0, 0.0, -2.0))}
    quaternion = (np.cos(heading / 2.0), 0.0, 0.0, np.sin(heading / 2.0))
    fields |= {f"q[{i}]": np.array([value]) for i, value in enumerate(quaternion)}
    times = np.zeros(1, dtype=np.int64)
    columns = TopicColumns("/o", 0, "px4_msgs/msg/VehicleOdometry", times, times, None, fields, ())
    pose = read_pose_topic(columns)
    assert pose.position[0] == pytest.approx([0.0, 1.0, 2.0])
    assert np.abs(pose.quaternion[0]) == pytest.approx([0.0, 0.0, 0.0, 1.0], abs=1e-12)


@pytest.mark.parametrize("unit", ["rad", "deg"])
@pytest.mark.parametrize("turning", [0.02, 0.6])
def test_the_unit_of_a_heading_is_that_along_which_the_body_drives(
    unit: Literal["rad", "deg"], turning: float
) -> None:
    times = np.arange(0.0, 60.0, 0.1)
    yaw = 0.3 + np.cumsum(turning * np.sin(0.2 * times)) * 0.1
    # Back and forth, and with a jump of the localization.
    place = np.cumsum(0.08 * np.cos(0.1 * times) * np.exp(1j * yaw))
    place[300:] += 5.0
    theta = yaw if unit == "rad" else np.degrees(yaw)
    stamps = np.zeros(times.size, dtype=np.int64)
    columns = TopicColumns(
        "/p", 0, "geometry_msgs/msg/Pose2D", stamps, stamps, None,
        {"x": place.real, "y": place.imag, "theta": theta}, (),
    )  # fmt: skip
    pose = find_type(columns.type_name).pose
    assert pose is not None
    assert find_angle_unit(columns, pose) == unit


def test_a_sensor_that_hangs_upside_down_is_turned_over() -> None:
    half = 0.5 * np.linspace(-2.0, 2.0, 50)
    zero = np.zeros(half.size)
    upright = np.column_stack([zero, zero, np.sin(half), np.cos(half)])
    hanging = np.column_stack([np.cos(half), np.sin(half), zero, zero])
    assert find_lean(upright) is None
    stood, leant = put_upright(PoseArrays(np.zeros((50, 3)), hanging, "", ""), PoseSection())[1:]
    assert np.abs((stood * upright).sum(axis=1)) == pytest.approx(1.0)
    assert leant == pytest.approx(np.pi)


@pytest.mark.parametrize("down_deg", [0.0, 25.0])
def test_poses_of_a_camera_are_turned_upright_on_slopes_as_on_level_ground(down_deg: float) -> None:
    """Headings of a camera that looks down a little were turned about the axis along which it looks."""
    yaw = np.linspace(-2.0, 4.0, 80)
    pitch, roll = 0.1 * np.sin(3.0 * yaw), 0.05 * np.cos(2.0 * yaw)
    body = rigid.quaternions_from_euler(roll, pitch, yaw)
    looks = rigid.quaternions_from_euler(np.zeros(1), np.radians([down_deg]), np.zeros(1))
    optical = np.array([[-0.5, 0.5, -0.5, 0.5]])
    seen = rigid.multiply_quaternions(rigid.multiply_quaternions(body, looks), optical)
    stood, leant = put_upright(PoseArrays(np.zeros((80, 3)), seen, "", ""), PoseSection(heading_deg=90.0))[1:]
    found = rigid.euler_from_quaternions(stood)
    assert np.degrees(leant) == pytest.approx(90.0 + down_deg, abs=1.0)
    assert np.ptp(np.unwrap(found[2]) - yaw) < 0.02
    assert found[1] == pytest.approx(pitch, abs=0.02)
    assert found[0] == pytest.approx(roll, abs=0.02)


def test_turns_about_another_axis_are_no_mounting() -> None:
    """Motion capture with y up: which axis is up, the motion tells."""
    half = 0.5 * np.linspace(-3.0, 3.0, 80)
    zero = np.zeros(half.size)
    assert find_lean(np.column_stack([zero, np.sin(half), zero, np.cos(half)])) is None


@pytest.mark.parametrize("factor", [0.05, 0.4, 3.0])
def test_simulated_time_carries_topics_without_stamps_along(factor: float) -> None:
    simulated = np.arange(2000) * SECOND // 20
    log = 1_700_000_000 * SECOND + (simulated / factor).astype(np.int64)
    clocks, findings = align_clocks(
        {
            "pose": Recorded("/pose", log, log, simulated),
            "cmd": Recorded("/cmd_vel", log[::7], log[::7], None),
        }
    )
    assert "simulated_time" in {finding.id for finding in findings}
    assert np.array_equal(clocks["pose"].stamp, simulated)
    assert np.abs(clocks["cmd"].stamp - simulated[::7]).max() < SECOND // 100


def test_a_simulated_log_keeps_its_effects(tmp_path: Path) -> None:
    scenario = scene_of("nav2", {}, seed=3, duration_s=40.0)
    chosen = look(record(replace(scenario, clock=SimulatedClock(factor=0.3)), tmp_path))
    assert str(chosen.sources.pose) == "/tf"
    assert chosen.ratings[0].coverage == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(
    ("wheels", "vehicle", "found", "value"),
    [
        ({}, {"wheel_radius_m": 0.1}, "wheel_radius_wrong", 0.165),
        ({"unit": "deg/s"}, {}, "wheel_radius_wrong", None),
        ({}, {}, None, None),
    ],
)
def test_wheels_of_another_scale_than_the_motion_are_told(
    drive: TakeThrough,
    wheels: dict[str, object],
    vehicle: dict[str, object],
    found: str | None,
    value: float | None,
) -> None:
    taken = drive(PLAIN, {"wheels": wheels, "vehicle": vehicle})
    assert ({"wheel_radius_wrong", "unit_wrong"} & taken.ids()) == ({found} if found else set())
    if found and value:
        assert taken.finding(found).value == pytest.approx(value, rel=0.03)


@pytest.mark.parametrize(
    ("radius", "effects", "found"),
    [(0.2, {}, {"wheel_radius_wrong"}), (0.165, {"wheel_radius": 0.8}, set()), (0.175, {}, set())],
)
def test_a_body_command_tells_a_small_error_of_the_radius_from_ground_that_slips(
    drive: TakeThrough, radius: float, effects: dict[str, float], found: set[str]
) -> None:
    scenario = replace(PLAIN, effects=effects, recording=Recording(layout="husky_body_command"))
    taken = drive(scenario, {"vehicle": {"wheel_radius_m": radius}})
    assert {"wheel_radius_wrong", "unit_wrong"} & taken.ids() == found
    if found:
        assert taken.finding("wheel_radius_wrong").value == pytest.approx(0.165, rel=0.03)


def test_a_command_that_the_vehicle_cannot_follow_sideways_is_said(
    tmp_path: Path, stamps: np.ndarray
) -> None:
    with LogWriter(tmp_path / "run.mcap") as log:
        write_wheels_and(log, np.arange(COUNT) * 0.025, np.zeros(COUNT), stamps)
        command = {"linear.x": 0.5, "linear.y": np.where(np.arange(COUNT) > 300, 0.3, 0.0)}
        log.write_columns("/cmd_vel", "geometry_msgs/msg/Twist", stamps, command)
    index = open_log(tmp_path / "run.mcap")
    chosen = choose(index, Configuration(), {})
    types = {channel.topic: channel.type_name for channel in index.channels}
    data = read_topics(index, list_wanted(chosen.sources, types))
    made = extract_tables(Given(data, chosen.sources, Configuration(), chosen.vehicle, "run.mcap"))
    (finding,) = [found for found in made.findings if found.id == "sideways_command"]
    assert finding.severity == "error"
    assert "Husky A200 (differential) cannot do" in finding.text
    assert 'kind = "mecanum"' in finding.text
    assert "youbot" in finding.text
    assert finding.value == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize(
    ("unit", "gain"), [("rpm", 60.0 / (2.0 * np.pi)), ("deg/s", 180.0 / np.pi), (None, 1.0)]
)
def test_velocities_in_another_unit_than_their_positions_are_converted(unit: str | None, gain: float) -> None:
    husky = find_preset("husky_a200")
    count = 400
    times = np.arange(count) / 20.0
    speed = 3.0 + np.sin(times)
    angle = 3.0 * times - np.cos(times)
    names = RaggedStrings(np.tile([0, 1], count), ("left_wheel", "right_wheel"), np.arange(count + 1) * 2)
    fields = {
        "name": names,
        "velocity": Ragged(np.repeat(speed * gain, 2), names.offsets),
        "position": Ragged(np.repeat(angle, 2), names.offsets),
    }
    stamps = (times * SECOND).astype(np.int64)
    columns = TopicColumns(
        "/joint_states", 0, "sensor_msgs/msg/JointState", stamps, stamps, stamps, fields, ()
    )
    drive, findings = read_joints(columns, times, DriveSection(), husky)
    assert drive["left"] == pytest.approx(speed)
    assert [finding.id for finding in findings] == (["unit_wrong"] if unit else [])
    assert all(str(unit) in finding.text for finding in findings)


def test_a_pose_whose_heading_does_not_follow_the_gyro_loses(tmp_path: Path, stamps: np.ndarray) -> None:
    turn = np.sin(np.arange(COUNT) / 40.0)
    with LogWriter(tmp_path / "run.mcap") as log:
        write_wheels_and(log, np.arange(COUNT) * 0.02, np.cos(np.arange(COUNT) / 25.0), stamps)
        good = {
            "pose.position.x": np.arange(COUNT) * 0.02,
            "pose.orientation.z": np.sin(turn / 2),
            "pose.orientation.w": np.cos(turn / 2),
            "header.frame_id": "map",
        }
        log.write_columns("/other", "geometry_msgs/msg/PoseStamped", stamps, good, header_time=stamps)
        rate = {"angular_velocity.z": np.gradient(turn, 0.05)}
        log.write_columns("/imu", "sensor_msgs/msg/Imu", stamps, rate, header_time=stamps)
    chosen = look(tmp_path / "run.mcap")
    assert str(chosen.sources.pose) == "/other"
    assert "differs from the gyro's" in chosen.ratings[1].reason
