"""Logs of strangers: what is not the vehicle's is told from what is, nothing is left out in silence."""

import re
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_drives import (
    DrawnDrive,
    DrawnTopic,
    record_cdr,
    record_json,
    record_twist,
    stamp_ros,
    write_drawn,
)
from drawn_motion import GAIN, RADIUS, TRACK, draw

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.core import Floats, SlipError
from pipeline.recording.log_setup import LogSetup, set_up_log
from pipeline.words import format_finding

POSE = "geometry_msgs/msg/PoseStamped"
TWIST = "geometry_msgs/msg/TwistStamped"
JOINTS = "sensor_msgs/msg/JointState"


class Robot:
    """A robot that follows its commands late, at 10 Hz: what it is asked, what it does, and its wheels."""

    def __init__(self, seed: int = 71) -> None:
        drive = draw(seed)
        at = drive.rows
        left, right = drive.wheels()
        place = drive.place
        self.asked = DrawnDrive(drive.time[at], *drive.asked[at].T, x=place.real, y=place.imag, yaw=drive.yaw)
        self.does = DrawnDrive(
            drive.time[at], drive.speed[at], drive.rate[at], place.real, place.imag, drive.yaw
        )
        self.wheels = np.column_stack([left[at], right[at]])

    def command(self) -> DrawnTopic:
        return record_twist(self.asked)

    def pose(self, topic: str = "/lio/pose") -> DrawnTopic:
        fields = stamp_ros(self.does) | self.does.pose("pose.") | {"header.frame_id": "map"}
        return record_cdr(self.does, topic, POSE, fields)

    def velocity(self, topic: str, *, of_map: bool) -> DrawnTopic:
        speed, yaw = self.does.speed, self.does.yaw * of_map
        linear = {"twist.linear.x": speed * np.cos(yaw), "twist.linear.y": speed * np.sin(yaw)}
        return record_cdr(self.does, topic, TWIST, linear | {"twist.angular.z": self.does.turn})

    def joints(self, topic: str, names: list[str], rates: Floats) -> DrawnTopic:
        fields = {"name": [names] * len(rates), "velocity": [[*map(float, row)] for row in rates]}
        return record_cdr(self.does, topic, JOINTS, stamp_ros(self.does) | fields)

    def base(self, topic: str = "/joint_states") -> DrawnTopic:
        return self.joints(topic, ["left_wheel_joint", "right_wheel_joint"], self.wheels)

    def number(self, topic: str, values: Floats, kind: str = "Float64") -> DrawnTopic:
        return record_cdr(self.does, topic, f"std_msgs/msg/{kind}", {"data": values})


def set_up(tmp_path: Path, *topics: DrawnTopic) -> LogSetup:
    return set_up_log(write_drawn(tmp_path / "log.mcap", *topics), Options(out=tmp_path))


def told(setup: LogSetup) -> str:
    return " ".join(format_finding(one) for one in setup.choice.findings)


def test_velocities_along_the_axes_of_a_map_make_no_mecanum(tmp_path: Path) -> None:
    robot = Robot()
    velocity = robot.velocity("/robot/velocity", of_map=True)
    setup = set_up(tmp_path, robot.command(), velocity, robot.base(), robot.pose())
    assert (str(setup.sources.command), str(setup.sources.wheels)) == ("/cmd_vel", "/joint_states")
    assert setup.vehicle.kind == "differential"
    assert setup.vehicle.track_width_m == pytest.approx(TRACK, rel=0.03)
    assert "not used: /robot/velocity: its velocities are along the axes of a map" in told(setup)


def test_velocities_of_which_one_axis_is_unknown_make_no_mecanum(tmp_path: Path) -> None:
    robot = Robot()
    turn = robot.does.turn
    linear = {"twist.linear.x": np.full(turn.size, np.nan), "twist.linear.y": robot.does.speed}
    broken = record_cdr(robot.does, "/robot/velocity", TWIST, linear | {"twist.angular.z": turn})
    setup = set_up(tmp_path, robot.command(), broken, robot.base(), robot.pose())
    assert (str(setup.sources.command), str(setup.sources.wheels)) == ("/cmd_vel", "/joint_states")
    assert setup.vehicle.kind == "differential"
    assert "not used: /robot/velocity: it has no number for the speed ahead" in told(setup)


@pytest.mark.parametrize("of_map", [False, True], ids=["body", "map"])
def test_a_measured_motion_is_no_command_where_nothing_else_is_recorded(
    of_map: bool,  # noqa: FBT001
    tmp_path: Path,
) -> None:
    robot = Robot()
    with pytest.raises(SlipError, match=r"Not used: /robot/velocity: it.* (measures|axes)") as caught:
        set_up(tmp_path, robot.velocity("/robot/velocity", of_map=of_map), robot.pose())
    assert caught.value.code == "no_command"


@pytest.mark.parametrize("names", [["joint_1", "joint_2"], ["left_elbow", "right_elbow"]], ids=["one", "two"])
def test_joints_of_an_arm_are_not_taken_for_the_wheels(names: list[str], tmp_path: Path) -> None:
    robot = Robot()
    time = robot.does.time
    arm = robot.joints("/arm/joint_states", names, np.column_stack([np.sin(time), np.cos(0.7 * time)]))
    setup = set_up(tmp_path, robot.command(), arm, robot.base("/base/joint_states"), robot.pose())
    assert str(setup.sources.wheels) == "/base/joint_states"
    assert "not used: /arm/joint_states" in told(setup)
    assert setup.vehicle.wheel_radius_m == pytest.approx(RADIUS, rel=0.03)


def test_messages_of_an_arm_in_the_topic_of_the_wheels_are_no_broken_wheels(tmp_path: Path) -> None:
    robot = Robot()
    names = ["left_arm_shoulder", "right_arm_shoulder"]
    arm = robot.joints("/joint_states", names, np.column_stack([np.sin(robot.does.time), robot.does.time]))
    base = robot.base()
    mixed = replace(
        base,
        times=np.concatenate([base.times, arm.times + 7_000_000]),
        messages=[*base.messages, *arm.messages],
    )
    log = write_drawn(tmp_path / "log.mcap", robot.command(), mixed, robot.pose())
    made = analyze_log(log, Options(out=tmp_path / "results", report=False, diagnosis=False))
    assert made.manifest.read("wheels").height == base.times.size
    assert "break the contract" not in " ".join(made.manifest.read("findings")["text"].to_list())


def test_of_two_bodies_the_one_that_is_driven_is_the_vehicle(tmp_path: Path) -> None:
    robot, person = Robot(), Robot(seed=72)
    poses = robot.pose("/mocap/robot/pose"), person.pose("/mocap/helmet/pose")
    setup = set_up(tmp_path, robot.command(), *poses)
    assert str(setup.sources.pose) == "/mocap/robot/pose"
    assert "is taken for the pose, and not /mocap/helmet/pose" in told(setup)


def test_of_two_bodies_the_follower_is_not_the_vehicle(tmp_path: Path) -> None:
    robot = Robot()
    leader, behind = robot.pose("/mocap/leader/pose"), robot.pose("/mocap/follower/pose")
    follower = replace(behind, times=behind.times + 1_500_000_000)
    late = stamp_ros(replace(robot.does, time=robot.does.time + 1.5))
    fields = late | robot.does.pose("pose.") | {"header.frame_id": "map"}
    follower = replace(
        follower, messages=record_cdr(robot.does, "/mocap/follower/pose", POSE, fields).messages
    )
    setup = set_up(tmp_path, robot.command(), robot.base(), leader, follower)
    assert str(setup.sources.pose) == "/mocap/leader/pose"


def test_an_odometry_whose_velocities_turn_with_its_own_heading_is_left_out(tmp_path: Path) -> None:
    robot = Robot()
    left, right = RADIUS * robot.wheels.T
    speed, rate = 0.5 * (left + right), (right - left) / TRACK
    yaw = np.cumsum(rate) * 0.1
    twist = {"linear.x": speed * np.cos(yaw), "linear.y": speed * np.sin(yaw), "angular.z": rate}
    fields = {f"twist.twist.{name}": values for name, values in twist.items()}
    place = np.cumsum(speed * np.exp(1j * yaw)) * 0.1
    frames = {
        "header.frame_id": "odom",
        "pose.pose.position.x": place.real,
        "pose.pose.position.y": place.imag,
    }
    turned = {"pose.pose.orientation.z": np.sin(yaw / 2.0), "pose.pose.orientation.w": np.cos(yaw / 2.0)}
    kind = "nav_msgs/msg/Odometry"
    odometry = record_cdr(robot.does, "/odom", kind, stamp_ros(robot.does) | fields | frames | turned)
    setup = set_up(tmp_path, robot.command(), odometry, robot.pose())
    assert setup.sources.wheels is None
    assert "not used: /odom: its velocities are along the axes of a map" in told(setup)


def test_commanded_wheel_speeds_are_in_the_unit_of_those_that_follow(tmp_path: Path) -> None:
    robot = Robot()
    turn = 0.5 * TRACK * robot.asked.turn
    asked = {"left": robot.asked.speed - turn, "right": robot.asked.speed + turn}
    topics = [robot.number(f"/{side}_wheel/command", values) for side, values in asked.items()]
    for side, rate in zip(asked, robot.wheels.T, strict=True):
        topics.append(robot.number(f"/{side}_wheel/velocity", RADIUS * rate))
    setup = set_up(tmp_path, *topics, robot.pose())
    assert setup.configuration.wheels.unit == setup.configuration.command.unit == "m/s"


@pytest.mark.parametrize(("unit", "factor"), [("m/s", 1.0), ("mm/s", 1e3)], ids=["m", "mm"])
def test_wheel_speeds_of_rims_are_in_the_unit_of_their_name(unit: str, factor: float, tmp_path: Path) -> None:
    robot = Robot()
    names = {side: f"/{side}_wheel/{unit.replace('/', '_')}/velocity" for side in ("left", "right")}
    speeds = [
        robot.number(name, factor * RADIUS * rate)
        for name, rate in zip(names.values(), robot.wheels.T, strict=True)
    ]
    setup = set_up(tmp_path, robot.command(), *speeds, robot.pose())
    assert setup.configuration.wheels.unit == unit
    assert setup.vehicle.track_width_m == pytest.approx(TRACK, rel=0.03)


@pytest.mark.parametrize(
    ("form", "times"),
    [("joints", 7.0), ("joints", 30.0), ("numbers", 7.0), ("numbers", 30.0), ("numbers", 0.02)],
)
def test_wheels_of_a_radius_that_no_vehicle_has_are_on_another_scale(
    form: str, times: float, tmp_path: Path
) -> None:
    robot = Robot()
    rates = times * robot.wheels
    wheels = [robot.joints("/joint_states", ["left_wheel_joint", "right_wheel_joint"], rates)]
    if form == "numbers":
        names = ("/left_wheel/velocity", "/right_wheel/velocity")
        wheels = [robot.number(name, rate) for name, rate in zip(names, rates.T, strict=True)]
    setup = set_up(tmp_path, robot.command(), *wheels, robot.pose())
    radius = setup.vehicle.wheel_radius_m
    assert 0.02 < radius < 0.5 * setup.vehicle.track_width_m
    assert re.search(r"[\d.]+ times those of wheels of 0.1 m, as ticks are", told(setup))
    wheels_as = setup.configuration.wheels
    # Wheels before a gear of 30 may as well be in degrees: both are said.
    as_scale = None if wheels_as.unit == "deg/s" else pytest.approx(1.0 / times, rel=0.03)
    assert wheels_as.scale == as_scale


@pytest.mark.parametrize("times", [7.0, 15.0])
def test_a_gear_of_a_known_vehicle_is_no_unit(times: float, tmp_path: Path) -> None:
    robot = Robot()
    wheels = robot.joints("/joint_states", ["left_wheel_joint", "right_wheel_joint"], times * robot.wheels)
    given = {"vehicle": {"kind": "differential", "wheel_radius_m": RADIUS, "track_width_m": TRACK}}
    log = write_drawn(tmp_path / "log.mcap", robot.command(), wheels, robot.pose())
    setup = set_up_log(log, Options(out=tmp_path, overrides=given))
    assert setup.configuration.wheels.unit is None
    found = next(one for one in setup.choice.findings if one.id == "wheels_scaled")
    assert found.value == pytest.approx(times, rel=0.03)


def test_an_odometry_whose_pose_is_not_filled_shows_the_drive(tmp_path: Path) -> None:
    robot = Robot()
    left, right = RADIUS * robot.wheels.T
    fields = {"twist.twist.linear.x": 0.5 * (left + right), "twist.twist.angular.z": (right - left) / TRACK}
    frames = {
        "header.frame_id": "odom",
        "child_frame_id": "base_link",
        "pose.pose.orientation.w": np.ones(1000),
    }
    odometry = record_cdr(
        robot.does, "/odom", "nav_msgs/msg/Odometry", stamp_ros(robot.does) | fields | frames
    )
    setup = set_up(tmp_path, robot.command(), odometry)
    assert setup.is_drive_alone
    assert "not used: the poses of /odom: only 1 new of 1000 poses" in told(setup)


def test_a_twist_with_covariance_that_is_named_after_wheels_measures_them(tmp_path: Path) -> None:
    robot = Robot()
    left, right = RADIUS * robot.wheels.T
    fields = {"twist.twist.linear.x": 0.5 * (left + right), "twist.twist.angular.z": (right - left) / TRACK}
    kind = "geometry_msgs/msg/TwistWithCovarianceStamped"
    twist = record_cdr(robot.does, "/wheel_twist", kind, stamp_ros(robot.does) | fields)
    setup = set_up(tmp_path, robot.command(), twist, robot.pose())
    assert str(setup.sources.wheels) == "/wheel_twist"


def test_a_twist_that_is_named_after_wheels_is_no_command(tmp_path: Path) -> None:
    robot = Robot()
    left, right = RADIUS * robot.wheels.T
    fields = {"twist.linear.x": 0.5 * (left + right), "twist.angular.z": (right - left) / TRACK}
    twist = record_cdr(robot.does, "/wheel/twist", TWIST, stamp_ros(robot.does) | fields)
    setup = set_up(tmp_path, robot.command(), twist, robot.pose())
    assert (str(setup.sources.command), str(setup.sources.wheels)) == ("/cmd_vel", "/wheel/twist")


def record_own(robot: Robot, topic: str, kind: str, fields: Mapping[str, Floats]) -> DrawnTopic:
    rows = zip(*(values.tolist() for values in fields.values()), strict=True)
    return record_json(robot.does, topic, kind, [dict(zip(fields, row, strict=True)) for row in rows])


@pytest.mark.parametrize(
    ("left", "right", "unit"),
    [
        ("/base.rpm_fl", "/base.rpm_fr", 'unit = "rpm"'),
        ("/base.motorL_speed", "/base.motorR_speed", "the motion shows their unit"),
        ("/lwheel.data", "/rwheel.data", "the motion shows their unit"),
        ("/left_encoder.data", "/right_encoder.data", 'unit = "ticks", per_turn = 1000}'),
    ],
)
def test_sides_are_known_by_any_of_their_usual_names(
    left: str, right: str, unit: str, tmp_path: Path
) -> None:
    robot = Robot()
    fields = dict(zip((left, right), robot.wheels.T, strict=True))
    if left.endswith(".data"):
        topics = [
            robot.number(name.removesuffix(".data"), np.cumsum(values).astype(int), "Int32")
            for name, values in fields.items()
        ]
    else:
        own = {name.partition(".")[2]: values for name, values in fields.items()}
        topics = [record_own(robot, "/base", "own.Base", own)]
    said = told(set_up(tmp_path, robot.command(), *topics, robot.pose()))
    assert unit in said
    (line,) = re.findall(r"in run.toml: (wheels = {.*?})", said)
    # A line that is offered can be pasted as it stands.
    offered = tomllib.loads(line)["wheels"]
    assert {"left_topic": left, "right_topic": right}.items() <= offered.items()


def test_a_command_of_an_own_type_and_a_joystick_are_offered(tmp_path: Path) -> None:
    robot = Robot()
    asked = {"speed": robot.asked.speed, "turn_rate": robot.asked.turn}
    command = record_own(robot, "/drive", "own.Drive", asked)
    axes = np.column_stack([robot.asked.turn, robot.asked.speed])
    joystick = record_cdr(robot.asked, "/joy", "sensor_msgs/msg/Joy", {"axes": axes}, "float32[] axes")
    said = told(set_up(tmp_path, command, joystick, robot.base(), robot.pose()))
    assert 'command = {speed_topic = "/drive.speed", yaw_rate_topic = "/drive.turn_rate"}' in said
    assert "/joy (a joystick)" in said


def test_fixes_once_a_second_are_said_to_be_too_slow(tmp_path: Path) -> None:
    robot = Robot()
    east, north = np.stack([robot.does.x, robot.does.y]) + np.random.default_rng(73).normal(size=(2, 1000))
    degrees = {"latitude": 47.0 + north / 111_000.0, "longitude": 8.0 + east / 75_000.0}
    fixes = record_cdr(
        robot.does, "/fix", "sensor_msgs/msg/NavSatFix", stamp_ros(robot.does) | degrees,
        rows=np.arange(0, robot.does.time.size, 10),
    )  # fmt: skip
    log = write_drawn(tmp_path / "log.mcap", robot.command(), fixes)
    with pytest.raises(SlipError, match=r"come at 1 Hz .at least 4 Hz are needed. and show no course"):
        analyze_log(log, Options(out=tmp_path / "results", report=False, diagnosis=False))


@pytest.mark.parametrize(
    ("kind", "names", "per_degree", "number"),
    [
        ("SensorGps", ("latitude_deg", "longitude_deg", "altitude_msl_m"), 1.0, "float64"),
        ("SensorGps", ("lat", "lon", "alt"), 1e7, "int32"),
        ("VehicleGpsPosition", ("lat", "lon", "alt"), 1e7, "int32"),
    ],
)
def test_fixes_of_px4_are_read_in_each_of_its_layouts(
    kind: str, names: tuple[str, str, str], per_degree: float, number: str, tmp_path: Path
) -> None:
    robot = Robot()
    east, north = robot.does.x, robot.does.y
    degrees = [47.0 + north / 111_200.0, 8.0 + east / 75_900.0, np.full(east.size, 0.4)]
    values = [np.round(one * per_degree) if number == "int32" else one for one in degrees]
    fields = dict(zip(names, (one.astype(number) for one in values), strict=True))
    fields |= {"timestamp": robot.does.stamps // 1000, "fix_type": np.full(east.size, 6)}
    fields["fix_type"][:50] = 1
    layout = "\n".join(["uint64 timestamp", "uint8 fix_type", *(f"{number} {name}" for name in names)])
    fixes = record_cdr(robot.does, "/fmu/out/vehicle_gps_position", f"px4_msgs/msg/{kind}", fields, layout)
    setup = set_up(tmp_path, robot.command(), fixes)
    assert str(setup.sources.pose) == "/fmu/out/vehicle_gps_position"
    (asked,) = [one for one in setup.choice.recording.evidence if one.role == "command"]
    assert asked.ahead == pytest.approx(1.0, abs=0.1)


def test_the_first_of_several_poses_in_a_frame_is_read(tmp_path: Path) -> None:
    robot = Robot()
    yaw = 0.5 * robot.does.yaw
    other = {
        "position": {"x": 5.0, "y": 5.0, "z": 0.0},
        "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
    }
    messages = [
        {
            "timestamp": {"sec": int(at // 10**9), "nsec": int(at % 10**9)},
            "frame_id": "map",
            "poses": [
                {
                    "position": {"x": float(x), "y": float(y), "z": 0.0},
                    "orientation": {"x": 0.0, "y": 0.0, "z": np.sin(half), "w": np.cos(half)},
                },
                other,
            ],
        }
        for at, x, y, half in zip(robot.does.stamps, robot.does.x, robot.does.y, yaw, strict=True)
    ]
    poses = record_json(robot.does, "/bodies", "foxglove.PosesInFrame", messages)
    setup = set_up(tmp_path, robot.command(), robot.base(), poses)
    assert str(setup.sources.pose) == "/bodies"
    assert setup.choice.recording.is_followed


def test_a_robot_that_is_pushed_is_not_said_to_stand(tmp_path: Path) -> None:
    robot = Robot()
    idle = record_twist(replace(robot.asked, speed=0.0 * robot.asked.speed, turn=0.0 * robot.asked.turn))
    log = write_drawn(tmp_path / "log.mcap", idle, robot.pose())
    made = analyze_log(log, Options(out=tmp_path / "results", report=False, diagnosis=False))
    said = " ".join(made.manifest.read("findings")["text"].to_list())
    assert "but it moved" in said
    assert "it was pushed" in said


def test_a_base_that_gives_up_without_key_presses_is_not_called_slow(tmp_path: Path) -> None:
    rng, time, timeout_s = np.random.default_rng(74), np.arange(0.0, 150.0, 0.05), 0.6
    presses, begun = [], 1.0
    while begun < 140.0:
        asked = rng.choice([-0.4, 0.3, 0.5]), rng.choice([-0.8, 0.0, 0.8])
        count = int(rng.integers(1, 6))
        presses += [(begun + 0.4 * number, *asked) for number in range(count)]
        begun += 0.4 * count + rng.uniform(1.2, 2.5)
    at, *asked = np.array(presses).T
    last = np.searchsorted(at, time, side="right") - 1
    is_held = (last >= 0) & (time - at[last] < timeout_s)
    speed, turn = (follow(np.where(is_held, values[last], 0.0), 0.25) for values in asked)
    yaw = np.cumsum(turn) * 0.05
    place = np.cumsum(speed * np.exp(1j * yaw)) * 0.05 + rng.normal(0.0, 0.002, time.size)
    robot = Robot()
    robot.does = DrawnDrive(time, speed, turn, place.real, place.imag, yaw)
    rows = np.searchsorted(time, at)
    said = {
        f"{kind}.{axis}": values[last]
        for kind, axis, values in zip(("linear", "angular"), "xz", asked, strict=True)
    }
    keys = record_cdr(robot.does, "/cmd_vel", "geometry_msgs/msg/Twist", said, rows=rows)
    setup = set_up(tmp_path, keys, robot.pose())
    assert setup.configuration.command.hold_s == pytest.approx(timeout_s, abs=0.06)
    (command,) = [one for one in setup.choice.recording.evidence if one.role == "command"]
    assert command.ahead == pytest.approx(1.0, abs=0.05)


def follow(values: Floats, lag: float) -> Floats:
    """A first-order lag of values every .05 s."""
    made, state = np.zeros_like(values), 0.0
    for row, value in enumerate(values.tolist()):
        made[row] = state
        state += 0.05 / lag * (value - state)
    return made


def test_of_a_joystick_no_gain_is_told(tmp_path: Path) -> None:
    robot = Robot()
    axes = np.column_stack([robot.asked.turn, robot.asked.speed / 0.8])
    joystick = record_cdr(robot.asked, "/joy", "sensor_msgs/msg/Joy", {"axes": axes}, "float32[] axes")
    lines = '[command]\nspeed_topic = "/joy.axes[1]"\nyaw_rate_topic = "/joy.axes[0]"'
    (tmp_path / "run.toml").write_text(lines, encoding="utf-8")
    setup = set_up(tmp_path, joystick, robot.base(), robot.pose())
    scales = setup.alignment.command_scale, setup.alignment.command_turn_scale
    assert scales == pytest.approx((0.8, GAIN), rel=0.03)
    assert "have no sure unit" in told(setup)


def test_the_radius_of_the_wheels_of_an_unknown_car_is_no_scale_of_its_commands(tmp_path: Path) -> None:
    """Its wheels were said to turn 3.34 times as fast as commanded, and to a drive gain of .3."""
    drive, radius, wheelbase = draw(31), 0.3, 2.5
    speed, angle = drive.speed[drive.rows], 0.4 * drive.asked[drive.rows, 1]
    yaw = np.cumsum(speed * np.tan(angle) / wheelbase) * 0.1
    place = np.cumsum(speed * np.exp(1j * yaw)) * 0.1
    does = DrawnDrive(drive.time[drive.rows], speed, 0.0 * yaw, place.real, place.imag, yaw)
    asked = {"drive.speed": drive.asked[drive.rows, 0], "drive.steering_angle": angle}
    names = [["rear_left_wheel_joint", "rear_right_wheel_joint", "front_steering_joint"]] * yaw.size
    joints = stamp_ros(does) | {
        "name": names,
        "position": np.column_stack((0.0 * angle, 0.0 * angle, angle)).tolist(),
        "velocity": np.column_stack((speed / radius, speed / radius, 0.0 * angle)).tolist(),
    }
    setup = set_up(
        tmp_path,
        record_cdr(does, "/drive", "ackermann_msgs/msg/AckermannDriveStamped", stamp_ros(does) | asked),
        record_cdr(does, "/joint_states", JOINTS, joints),
        record_cdr(
            does, "/ndt_pose", POSE, stamp_ros(does) | does.pose("pose.") | {"header.frame_id": "map"}
        ),
    )
    assert setup.vehicle.wheel_radius_m == pytest.approx(radius, rel=0.05)
    assert "times as fast as commanded" not in told(setup)


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_speed_that_counts_backward_is_corrected_in_a_drive_of_three_seconds(
    sense: float, tmp_path: Path
) -> None:
    """It has less than thirty steps of a tenth of a second in motion: nothing was asked of its signs."""
    rng, radius, wheelbase = np.random.default_rng(3), 0.05, 0.25
    time = np.arange(0.0, 3.2, 0.02)
    asked, angle = np.where(time > 0.2, 2.5, 0.0), 0.2 * np.sin(3.0 * time)
    speed = np.clip(2.5 * (time - 0.3) / 0.6, 0.0, 2.5)
    yaw = np.cumsum(speed * np.tan(angle) / wheelbase) * 0.02
    place = np.cumsum(speed * np.exp(1j * yaw)) * 0.02 + rng.normal(0.0, 5e-4, (2, time.size)).T @ (1.0, 1j)
    does = DrawnDrive(time, speed, 0.0 * yaw, place.real, place.imag, yaw)
    turned, none = sense * speed / radius, 0.0 * angle
    joints = stamp_ros(does) | {
        "name": [["rear_left_wheel_joint", "rear_right_wheel_joint", "front_steering_joint"]] * time.size,
        "position": np.column_stack((none, none, angle)).tolist(),
        "velocity": np.column_stack((turned, turned, none)).tolist(),
    }
    wish = stamp_ros(does) | {"drive.speed": asked, "drive.steering_angle": angle}
    setup = set_up(
        tmp_path,
        record_cdr(does, "/drive", "ackermann_msgs/msg/AckermannDriveStamped", wish),
        record_cdr(does, "/joint_states", JOINTS, joints),
        record_cdr(does, "/mocap", POSE, stamp_ros(does) | does.pose("pose.") | {"header.frame_id": "map"}),
    )
    assert setup.configuration.wheels.sign == (-1 if sense < 0.0 else None)
    assert ("counts backward: corrected" in told(setup)) == (sense < 0.0)


@pytest.mark.parametrize("axles", [("",), ("front_", "rear_")], ids=["sides", "axles"])
def test_numbers_named_as_sides_are_the_wheels_where_nothing_else_drives(
    axles: tuple[str, ...], tmp_path: Path
) -> None:
    """A log with them and poses was refused, with the line that would have taken them."""
    robot = Robot()
    speeds = dict(zip(("left", "right"), RADIUS * robot.wheels.T, strict=True))
    fields = {f"{axle}{side}": speed for axle in axles for side, speed in speeds.items()}
    definition = "".join(f"float64 {name}\n" for name in fields)
    topic = record_cdr(robot.does, "/base/wheel_velocity", "own_msgs/msg/Wheels", fields, definition)
    setup = set_up(tmp_path, topic, robot.pose())
    assert setup.sources.wheels is not None
    assert "taken for the left and right wheels" in told(setup)
    assert setup.vehicle.track_width_m == pytest.approx(TRACK / GAIN, rel=0.03)


@pytest.mark.parametrize("turns", [True, False], ids=["turns", "straight"])
def test_a_speed_without_a_yaw_rate_is_told_where_the_vehicle_turns(*, turns: bool, tmp_path: Path) -> None:
    """Ten degrees of heading were at the noise floor of it."""
    robot = Robot()
    if not turns:
        way = np.cumsum(robot.does.speed) * 0.1
        robot.does = replace(robot.does, turn=0.0 * way, yaw=0.0 * way, x=way, y=0.0 * way)
    linear = {"twist.linear.x": 1.05 * robot.does.speed}
    speed = record_cdr(robot.does, "/vehicle/twist", TWIST, stamp_ros(robot.does) | linear)
    setup = set_up(tmp_path, speed, robot.pose())
    assert ("a yaw rate of zero throughout" in told(setup)) == turns


def test_a_difference_of_wheels_of_an_unknown_track_says_at_which_it_is(tmp_path: Path) -> None:
    """One of 1 % was told as 2.2 %, which it would be at half a metre."""
    robot = Robot()
    turning = {"twist.linear.x": robot.does.speed, "twist.angular.z": robot.does.turn / GAIN}
    odometry = record_cdr(robot.does, "/wheel_odom/twist", TWIST, stamp_ros(robot.does) | turning)
    setup = set_up(tmp_path, robot.command(), odometry, robot.pose())
    assert "a difference of the wheels is that at a track of 0.5 m" in told(setup)


@pytest.mark.parametrize("name", ["/wheel_{}_rpm", "/motors/{}/speed", "/{}wheel_vel"])
def test_topics_of_single_wheels_are_paired_by_short_names(name: str, tmp_path: Path) -> None:
    robot = Robot()
    sides = ("l", "r") if name.startswith("/{") else ("fl", "fr")
    topics = [
        robot.number(name.format(side), speed) for side, speed in zip(sides, robot.wheels.T, strict=True)
    ]
    setup = set_up(tmp_path, record_twist(robot.asked), *topics, robot.pose())
    assert [signal.topic for signal in setup.sources.wheels.signals] == [name.format(side) for side in sides]


LEGS = [f"{leg}_{part}" for leg in ("lf", "rf", "lh_left", "rh_right") for part in ("HAA", "HFE", "KFE")]


def record_legs(robot: Robot, kind: str) -> DrawnTopic:
    """Joints of four legs at 10 Hz: each swings about an angle of its own."""
    does, count = robot.does, len(LEGS)
    phase = np.cumsum(1.3 * np.abs(does.speed) + 0.4 * np.abs(does.turn))
    at = phase[:, None] + np.arange(count)
    if kind == JOINTS:
        return robot.joints("/joint_states", LEGS, 0.5 * np.gradient(np.sin(at), does.time, axis=0))
    messages = [
        {
            "joint_names": LEGS,
            "interface_values": [
                {"interface_names": ["position"], "values": [float(angle)]} for angle in row
            ],
        }
        for row in 0.3 * np.sin(at) + np.linspace(-1.5, 0.8, count)
    ]
    return record_json(does, "/dynamic_joint_states", "control_msgs/msg/DynamicJointState", messages)


@pytest.mark.parametrize("kind", [JOINTS, "control_msgs/msg/DynamicJointState"])
def test_joints_of_legs_are_no_wheels(kind: str, tmp_path: Path) -> None:
    robot = Robot(seed=73)
    setup = set_up(tmp_path, robot.command(), record_legs(robot, kind), robot.pose())
    assert (str(setup.sources.command), setup.sources.wheels) == ("/cmd_vel", None)
    assert "its joints swing and do not turn round" in told(setup)
    assert "encoder" not in told(setup)
    with pytest.raises(SlipError, match=r"command or measured wheels.*joints swing") as caught:
        set_up(tmp_path, record_legs(robot, kind), robot.pose())
    assert caught.value.code == "no_command"
    assert "Name it" not in str(caught.value)


def test_wheels_that_go_back_and_forth_are_no_legs(tmp_path: Path) -> None:
    robot = Robot()
    time = robot.does.time
    speed = 0.09 * np.cos(1.1 * time)
    turn = 0.15 * np.cos(0.7 * time)
    yaw = np.cumsum(turn) * 0.1
    x, y = (np.cumsum(speed * part) * 0.1 for part in (np.cos(yaw), np.sin(yaw)))
    robot.does = robot.asked = DrawnDrive(time, speed, turn, x, y, yaw)
    robot.wheels = np.column_stack([speed - 0.5 * TRACK * turn, speed + 0.5 * TRACK * turn]) / RADIUS
    assert np.ptp(np.cumsum(robot.wheels, axis=0) * 0.1, axis=0).max() < np.pi
    setup = set_up(tmp_path, robot.command(), robot.base(), robot.pose())
    assert str(setup.sources.wheels) == "/joint_states"
