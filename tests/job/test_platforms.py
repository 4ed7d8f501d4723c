"""Logs as popular platforms publish them: chosen rightly and diagnosed without any configuration."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from platforms import hidden_effects, try_platform

from pipeline.core import SlipError
from pipeline.job import JobError, Options, log_choice
from pipeline.job.analyze import analyze_log
from pipeline.job.keys import set_up_log
from pipeline.job.log_choice import Choice, choose
from pipeline.logs import LogData, Wanted, open_log, read_topics
from pipeline.simulate import PLATFORMS, simulate_case
from pipeline.sources import load_configuration

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
    log = simulate_case(None, effects, out=folder / "run.mcap", seed=5, duration_s=duration_s, platform=name)
    return choose(open_log(log), load_configuration(log), {})


@pytest.mark.parametrize("name", PLATFORMS)
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


def rewrite_requests(log: Path, text: bytes, copies: int = 0) -> None:
    """Have all requests to the service of a log say a text, filled up with spaces; copies are topics, too."""
    out = log.with_suffix(".new")
    with log.open("rb") as source, out.open("wb") as stream:
        reader, writer = make_reader(source), Writer(stream)
        writer.start(reader.get_header().profile)
        channels: dict[int, int] = {}
        schemas: dict[int, int] = {}
        more: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if channel.id not in channels:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                schemas[schema.id] = known
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, known)
            data = message.data
            if channel.topic == "/api/sport/request":
                data, count = re.subn(rb'{"x"[^}]*}', lambda found: text.ljust(len(found[0])), data)
                assert count == 1
                for number in range(copies):
                    name = f"/copy{number}{channel.topic}"
                    if number not in more:
                        more[number] = writer.register_channel(
                            name, channel.message_encoding, schemas[schema.id]
                        )
                    writer.add_message(more[number], message.log_time, data, message.publish_time)
            writer.add_message(channels[channel.id], message.log_time, data, message.publish_time)
        writer.finish()
    out.replace(log)


def test_many_services_that_say_no_command_are_read_together_and_said_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record("go2_w", tmp_path)
    log = tmp_path / "run.mcap"
    rewrite_requests(log, b"not JSON", copies=20)
    reads: list[int] = []

    def read(*arguments: object, **options: object) -> LogData:
        reads.append(1)
        return read_topics(*arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(log_choice, "read_topics", read)
    chosen = choose(open_log(log), load_configuration(log), {})
    assert chosen.sources.command is None
    (text,) = [finding.text for finding in chosen.findings if finding.id == "no_readable_text"]
    assert "and 16 more is a readable command: the topics were left out" in text
    assert len(reads) < 10


@pytest.mark.parametrize("text", [b"not JSON", b'{"speed": 1}'])
def test_requests_that_all_say_something_else_are_left_out_with_a_word(tmp_path: Path, text: bytes) -> None:
    record("go2_w", tmp_path)
    log = tmp_path / "run.mcap"
    rewrite_requests(log, text)
    chosen = choose(open_log(log), load_configuration(log), {})
    assert chosen.sources.command is None
    assert str(chosen.sources.wheels) == "/lf/lowstate"
    notes = {finding.id: finding.text for finding in chosen.findings}
    assert "/api/sport/request" in notes["no_readable_text"]
    assert "no_command" in notes
    manifest = analyze_log(log, Options(out=tmp_path / "out", report=False)).manifest
    assert "no_readable_text" in str(manifest.read_json("summary.json")["findings"])
    # Who names the topic is told that it holds none.
    (tmp_path / "run.toml").write_text('[command]\ntopic = "/api/sport/request"\n', encoding="utf-8")
    with pytest.raises(SlipError, match="has no readable message"):
        analyze_log(log, Options(out=tmp_path / "out", report=False))


def test_an_odometry_of_the_wheels_is_never_preferred_and_says_what_it_is(tmp_path: Path) -> None:
    chosen = record("turtlebot4", tmp_path)
    verdicts = {str(rating.source): rating for rating in chosen.ratings}
    assert verdicts["/odom"].from_wheels
    assert not verdicts["/tf"].from_wheels
    assert "too slow" in verdicts["/amcl_pose"].reason
    assert [note for note in chosen.sources.notes if note.startswith("pose, not chosen: /odom")]


def test_a_field_of_one_of_several_structures_can_be_a_side(tmp_path: Path) -> None:
    record("scout_2", tmp_path)
    paths = {
        side: f"/scout_status.actuator_states[{number}].rpm" for side, number in (("left", 1), ("right", 0))
    }
    text = f'[wheels]\nleft_topic = "{paths["left"]}"\nright_topic = "{paths["right"]}"\nunit = "rpm"\n'
    (tmp_path / "run.toml").write_text(text, encoding="utf-8")
    options = Options(out=tmp_path / "out", report=False, through="extract")
    wheels = analyze_log(tmp_path / "run.mcap", options).manifest.read("wheels")
    poses = analyze_log(tmp_path / "run.mcap", options).manifest.read("poses")
    assert wheels["left"].abs().max() > 1.0
    turned = (0.16459 * 0.5 * (wheels["left"] + wheels["right"])).to_numpy()
    driven = np.diff(poses["x"].to_numpy()) ** 2 + np.diff(poses["y"].to_numpy()) ** 2
    assert np.abs(turned).sum() / 20.0 == pytest.approx(np.sqrt(driven).sum(), rel=0.2)


def test_a_robot_without_a_pose_is_refused_before_its_vehicle_is_asked_for(foreign_logs: Path) -> None:
    with pytest.raises(JobError) as caught:
        set_up_log(foreign_logs / "abitobot.mcap", Options())
    assert caught.value.code == "no_pose"
    assert "/joint_states" in str(caught.value)


def test_a_turtlebot_that_does_not_say_so_is_recognized_by_its_geometry(foreign_logs: Path) -> None:
    log = foreign_logs / "fuse_turtlebot3.bag"
    chosen = choose(open_log(log), load_configuration(log), {})
    assert chosen.vehicle_source == "fitted"
    assert chosen.vehicle.wheel_radius_m == pytest.approx(0.033, rel=0.03)
    assert chosen.vehicle.track_width_m == pytest.approx(0.287, rel=0.03)
    said = " ".join(finding.text for finding in chosen.findings)
    assert "turtlebot3_waffle" in said
    assert "forward slip is not observable" in said


def test_a_recorded_robot_description_tells_the_vehicle(foreign_logs: Path) -> None:
    log = foreign_logs / "nvnmangla_roomba.db3"
    chosen = choose(open_log(log), load_configuration(log), {})
    assert (chosen.vehicle.id, chosen.vehicle_source) == ("turtlebot3_burger", "robot_description")
    assert chosen.ratings[0].from_wheels


def test_a_log_without_pose_and_wheels_is_refused_with_that_reason(foreign_logs: Path) -> None:
    with pytest.raises(JobError) as caught:
        set_up_log(foreign_logs / "philipsltd_full_nav.db3", Options())
    assert caught.value.code == "no_pose"
