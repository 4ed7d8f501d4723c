"""Logs as popular platforms publish them: chosen rightly and diagnosed without any configuration."""

from pathlib import Path

import pytest
from few import few
from platforms import hidden_effects, try_platform
from simulated_platforms import PLATFORMS, simulate_platform

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.logs import Wanted, open_log, read_topics
from pipeline.recording.log_choice import Choice, choose
from pipeline.sources import load_configuration
from pipeline.words import format_finding

VESC = "/sensors/core.state.speed, /sensors/servo_position_command.data"
AUTOWARE = (
    "/vehicle/status/velocity_status.longitudinal_velocity, "
    "/vehicle/status/steering_status.steering_tire_angle"
)
PX4 = "/fmu/in/rover_speed_setpoint.speed_body_x, /fmu/in/rover_rate_setpoint.yaw_rate_setpoint"
TICKS = "/autobot01/left_wheel_encoder_node/tick.data, /autobot01/right_wheel_encoder_node/tick.data"

EXPECTED: dict[str, tuple[str, str, str, str, str]] = {
    "husky_a200": (
        "/a200_0042/platform/cmd_vel_unstamped",
        "/a200_0042/platform/joint_states",
        "/a200_0042/lidar/icp_odom",
        "husky_a200",
        "robot_description",
    ),
    "dingo_o": (
        "/do100_0042/platform/cmd_vel_unstamped",
        "/do100_0042/platform/joint_states",
        "/do100_0042/lidar/icp_odom",
        "dingo_o",
        "robot_description",
    ),
    "ridgeback": (
        "/r100_0042/platform/cmd_vel_unstamped",
        "/r100_0042/platform/joint_states",
        "/r100_0042/lidar/icp_odom",
        "ridgeback",
        "robot_description",
    ),
    "rosbot_xl_mecanum": (
        "/cmd_vel",
        "/joint_states",
        "/slam/odom",
        "rosbot_xl_mecanum",
        "robot_description",
    ),
    "amiga": ("/canbus/twist", "/canbus/state", "/filter/state", "fitted_body", "fitted"),
    "go2_w": ("/api/sport/request", "/lf/lowstate", "/Odometry", "fitted_go2_w", "fitted"),
    "youbot": ("/cmd_vel", "/joint_states", "/tf", "youbot", "robot_description"),
    "jackal": (
        "/j100_0042/platform/cmd_vel_unstamped",
        "/j100_0042/platform/joint_states",
        "/j100_0042/lidar/icp_odom",
        "jackal",
        "robot_description",
    ),
    "warthog": (
        "/w200_0042/platform/cmd_vel_unstamped",
        "/w200_0042/platform/joint_states",
        "/w200_0042/lidar/icp_odom",
        "warthog",
        "robot_description",
    ),
    "turtlebot3_burger": ("/cmd_vel", "/joint_states", "/tf", "turtlebot3_burger", "robot_description"),
    "turtlebot3_waffle": ("/cmd_vel", "/joint_states", "/tf", "turtlebot3_waffle", "robot_description"),
    "turtlebot4": ("/cmd_vel", "/wheel_vels", "/tf", "turtlebot4", "message_types"),
    "panther": ("/panther/cmd_vel", "/panther/joint_states", "/kiss/odometry", "panther", "namespace"),
    "lynx": ("/lynx/cmd_vel", "/lynx/joint_states", "/kiss/odometry", "lynx", "namespace"),
    "rosbot_2r": ("/cmd_vel", "/joint_states", "/slam/odom", "rosbot_2r", "robot_description"),
    "scout_2": ("/cmd_vel", "/scout_status", "/Odometry", "scout_2", "message_types"),
    "hunter_2": ("/cmd_vel", "/hunter_status", "/Odometry", "hunter_2", "message_types"),
    "diff_drive_controller": (
        "/diffbot_base_controller/cmd_vel_out",
        "/joint_states",
        "/tf",
        "diffbot",
        "robot_description",
    ),
    "ackermann_steering_controller": (
        "/ackermann_steering_controller/reference",
        "/ackermann_steering_controller/controller_state",
        "/lio/odometry",
        "ackermann_bot",
        "robot_description",
    ),
    "nav2": ("/cmd_vel", "/joint_states", "/tf", "turtlebot3_waffle", "robot_description"),
    "autoware": (
        "/control/command/control_cmd",
        AUTOWARE,
        "/localization/kinematic_state",
        "autoware_sample",
        "message_types",
    ),
    "f1tenth": (
        "/commands/motor/speed.data, /commands/servo/position.data",
        VESC,
        "/pf/pose/odom",
        "f1tenth",
        "message_types",
    ),
    "tartandrive": (
        "None",
        "/wheel_rpm.rear_left+rear_right, /ros_talon/current_position.data",
        "/odometry/filtered_odom",
        "tartandrive_atv",
        "message_types",
    ),
    "f1tenth_ros1": (
        "/vesc/commands/motor/speed.data, /vesc/commands/servo/position.data",
        "/vesc/sensors/core.state.speed, /vesc/sensors/servo_position_command.data",
        "/pf/viz/inferred_pose",
        "f1tenth",
        "message_types",
    ),
    "jackal_ros1": (
        "/jackal_velocity_controller/cmd_vel",
        "/feedback",
        "/lio_sam/mapping/odometry",
        "jackal",
        "namespace",
    ),
    "px4_rover": (PX4, "/fmu/out/wheel_encoders", "/fmu/out/vehicle_odometry", "fitted_110_450", "fitted"),
    "duckiebot": (
        "/autobot01/wheels_driver_node/wheels_cmd_executed",
        TICKS,
        "/mocap/autobot01/pose",
        "duckiebot",
        "message_types",
    ),
    "leo_rover": ("/cmd_vel", "/firmware/wheel_states", "/rtabmap/odom", "leo_rover", "message_types"),
    "linorobot2": (
        "/cmd_vel",
        "/odom/unfiltered",
        "/lio_sam/mapping/odometry",
        "linorobot2_4wd",
        "robot_description",
    ),
}


def record(name: str, folder: Path, duration_s: float = 20.0) -> Choice:
    """The choice that is made for a short log of a platform."""
    platform = PLATFORMS[name]
    effects = hidden_effects(platform)
    log = simulate_platform(name, effects, out=folder / "run.mcap", seed=5, duration_s=duration_s)
    return choose(open_log(log), load_configuration(log), {})


@pytest.mark.parametrize("name", few(PLATFORMS, 5))
def test_topics_and_vehicle_of_a_platform_are_chosen_without_configuration(name: str, tmp_path: Path) -> None:
    chosen = record(name, tmp_path)
    roles = (chosen.sources.command, chosen.sources.wheels, chosen.sources.pose)
    assert (*map(str, roles), chosen.vehicle.id, chosen.vehicle_source) == EXPECTED[name]
    is_unknown = chosen.vehicle.id == "fitted_body"
    assert chosen.vehicle.stand_ins == (["wheel_radius_m", "track_width_m"] if is_unknown else [])


def test_hidden_effects_of_a_platform_are_named(tmp_path: Path) -> None:
    assert try_platform("turtlebot4", tmp_path).named


@pytest.mark.long
@pytest.mark.parametrize("name", PLATFORMS)
def test_hidden_effects_of_every_platform_are_named(name: str, tmp_path: Path) -> None:
    assert try_platform(name, tmp_path).named


def test_requests_of_another_kind_are_no_commands(tmp_path: Path) -> None:
    record("go2_w", tmp_path)
    options = Options(out=tmp_path / "out", report=False, through="extract")
    commands = analyze_log(tmp_path / "run.mcap", options).manifest.read("commands")
    # One more leans the body.
    (requests,) = read_topics(tmp_path / "run.mcap", [Wanted("/api/sport/request")]).topics
    assert commands.height == len(requests) - 1
    assert not ((commands["body_x"] - 0.3).abs() + (commands["body_w"] - 0.5).abs() < 1e-9).any()


def test_an_odometry_of_the_wheels_is_never_preferred_and_says_what_it_is(tmp_path: Path) -> None:
    chosen = record("turtlebot4", tmp_path)
    verdicts = {str(rating.source): rating for rating in chosen.ratings}
    assert verdicts["/odom"].from_wheels
    assert not verdicts["/tf"].from_wheels
    assert "too slow" in verdicts["/amcl_pose"].reason
    assert [note for note in chosen.sources.notes if note.startswith("pose, not chosen: /odom")]


def test_a_turtlebot_that_does_not_say_so_is_recognized_by_its_geometry(foreign_logs: Path) -> None:
    log = foreign_logs / "fuse_turtlebot3.bag"
    chosen = choose(open_log(log), load_configuration(log), {})
    assert chosen.vehicle_source == "fitted"
    assert chosen.vehicle.wheel_radius_m == pytest.approx(0.033, rel=0.03)
    assert chosen.vehicle.track_width_m == pytest.approx(0.287, rel=0.03)
    said = " ".join(format_finding(finding) for finding in chosen.findings)
    assert "turtlebot3_waffle" in said
    assert "wheel odometry, not a localization" in said


def test_a_recorded_robot_description_tells_the_vehicle(foreign_logs: Path) -> None:
    log = foreign_logs / "nvnmangla_roomba.db3"
    chosen = choose(open_log(log), load_configuration(log), {})
    assert (chosen.vehicle.id, chosen.vehicle_source) == ("turtlebot3_burger", "robot_description")
    assert chosen.sources.pose is not None
    assert chosen.sources.pose.wheels is not None
