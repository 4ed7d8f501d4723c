"""Which topics are chosen, on every layout that robots are known to have."""

import pytest

from pipeline.logs import ChannelInfo
from pipeline.simulate import LAYOUTS, VEHICLES, Scenario
from pipeline.simulate.messages import list_topics
from pipeline.sources import (
    Configuration,
    ConfigurationError,
    DriveForm,
    Signal,
    Sources,
    Vehicle,
    choose_sources,
    convert,
    find_preset,
)
from pipeline.sources.topics import find_pose_fields

JOINTS = "sensor_msgs/msg/JointState"
FLOAT = "std_msgs/msg/Float64"
TWIST = "geometry_msgs/msg/Twist"
STAMPED = "geometry_msgs/msg/TwistStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
POSE = "geometry_msgs/msg/PoseStamped"
POSE_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TF = "tf2_msgs/msg/TFMessage"
IMU = "sensor_msgs/msg/Imu"
STRING = "std_msgs/msg/String"
DRIVE = "ackermann_msgs/msg/AckermannDriveStamped"

ICP = {"/mapping/icp_odom": ODOMETRY}
POSES = {"localization", "tracking"}


def preset(name: str) -> Vehicle:
    return find_preset(name)


def choose(
    topics: dict[str, str],
    vehicle: str = "husky",
    configuration: dict[str, object] | None = None,
    counts: dict[str, int] | None = None,
) -> Sources:
    channels = [
        ChannelInfo(number, topic, kind, "ros2msg", "cdr", (counts or {}).get(topic, 100), {})
        for number, (topic, kind) in enumerate(topics.items())
    ]
    settings = convert(configuration or {}, "test") if configuration else Configuration()
    return choose_sources(channels, settings, preset(vehicle), where="a.mcap")


def names(sources: Sources) -> dict[str, str | None]:
    roles = {"command": sources.command, "wheels": sources.wheels, "pose": sources.pose, "imu": sources.imu}
    return {role: None if source is None else str(source) for role, source in roles.items()}


@pytest.mark.parametrize(("count", "said"), [(0, "is without any message"), (None, "is not in the log")])
def test_a_named_topic_that_cannot_be_read_says_why(count: int | None, said: str) -> None:
    topics = ICP | ({} if count is None else {"/amcl_pose": POSE})
    with pytest.raises(ConfigurationError, match=said):
        choose(topics, configuration={"pose": {"topic": "/amcl_pose"}}, counts={"/amcl_pose": 0})


CASES: dict[str, tuple[str, dict[str, str], dict[str, str | None]]] = {
    "husky with a body command": (
        "husky",
        {"/joint_states": JOINTS, "/controller/cmd_vel": STAMPED, "/mti100/data": IMU, **ICP},
        {
            "command": "/controller/cmd_vel",
            "wheels": "/joint_states",
            "pose": "/mapping/icp_odom",
            "imu": "/mti100/data",
        },
    ),
    "warthog of 2023, a Float64 a side": (
        "warthog",
        {
            "/left_drive/status/speed": FLOAT,
            "/right_drive/status/speed": FLOAT,
            "/left_drive/velocity": FLOAT,
            "/right_drive/velocity": FLOAT,
            "/mti30/data": IMU,
            **ICP,
        },
        {
            "command": "/left_drive/velocity.data, /right_drive/velocity.data",
            "wheels": "/left_drive/status/speed.data, /right_drive/status/speed.data",
            "imu": "/mti30/data",
        },
    ),
    "newer warthog names": (
        "warthog",
        {
            f"/warthog/platform/motor/{side}/{what}": FLOAT
            for side in ("left", "right")
            for what in ("status/velocity", "cmd_velocity")
        }
        | ICP,
        {
            "command": "/warthog/platform/motor/left/cmd_velocity.data, "
            "/warthog/platform/motor/right/cmd_velocity.data",
            "wheels": "/warthog/platform/motor/left/status/velocity.data, "
            "/warthog/platform/motor/right/status/velocity.data",
        },
    ),
    "joint commands beside joint states": (
        "husky",
        {"/husky/joint_commands": JOINTS, "/joint_states": JOINTS, **ICP},
        {"command": "/husky/joint_commands", "wheels": "/joint_states"},
    ),
    "a float a side that says cmd, and one that says nothing": (
        "husky",
        {f"/wheel_{side}/{what}": FLOAT for side in ("left", "right") for what in ("cmd", "velocity")}
        | {"/localization/pose": POSE_COVARIANCE},
        {
            "command": "/wheel_left/cmd.data, /wheel_right/cmd.data",
            "wheels": "/wheel_left/velocity.data, /wheel_right/velocity.data",
            "pose": "/localization/pose",
        },
    ),
    "wheel commands before the body command they come from": (
        "husky",
        {"/wheel_commands": JOINTS, "/controller/cmd_vel": STAMPED, "/joint_states": JOINTS, **ICP},
        {"command": "/wheel_commands"},
    ),
    "a plain twist and poses in transforms": (
        "jackal",
        {"/cmd_vel": TWIST, "/tf": TF, "/tf_static": TF, "/joint_states": JOINTS},
        {"command": "/cmd_vel", "pose": "/tf", "wheels": "/joint_states", "imu": None},
    ),
    "static transforms alone are no pose": ("jackal", {"/cmd_vel": TWIST, "/tf_static": TF}, {"pose": None}),
    "points of a total station": (
        "jackal",
        {"/cmd_vel": TWIST, "/total_station/point": "geometry_msgs/msg/PointStamped"},
        {"pose": "/total_station/point"},
    ),
    "points that are picked on a screen": (
        "jackal",
        {"/cmd_vel": TWIST, "/clicked_point": "geometry_msgs/msg/PointStamped"},
        {"pose": None},
    ),
    "a stamped pose": (
        "jackal",
        {"/cmd_vel": TWIST, "/robot/pose": POSE},
        {"pose": "/robot/pose"},
    ),
    "a localization before transforms, transforms before wheel odometry": (
        "jackal",
        {"/cmd_vel": TWIST, "/tf": TF, "/amcl_pose": POSE_COVARIANCE, "/platform/odom": ODOMETRY},
        {"pose": "/amcl_pose"},
    ),
    "transforms before an odometry of the controller": (
        "jackal",
        {"/cmd_vel": TWIST, "/tf": TF, "/jackal_velocity_controller/odom": ODOMETRY},
        {"pose": "/tf"},
    ),
    "a decoy odometry and a decoy command": (
        "husky",
        {
            "/platform/odom": ODOMETRY,
            "/navigation/cmd_vel": TWIST,
            "/controller/cmd_vel": STAMPED,
            "/joint_states": JOINTS,
            **ICP,
        },
        {"command": "/controller/cmd_vel", "pose": "/mapping/icp_odom"},
    ),
    "what the controller received of several commands": (
        "jackal",
        {
            "/joy_teleop/cmd_vel": TWIST,
            "/nav/cmd_vel": TWIST,
            "/twist_marker/cmd_vel": TWIST,
            "/jackal_velocity_controller/cmd_vel": TWIST,
            **ICP,
        },
        {"command": "/jackal_velocity_controller/cmd_vel"},
    ),
    "goals and initial poses are no localization": (
        "jackal",
        {"/cmd_vel": TWIST, "/goal_pose": POSE, "/initialpose": POSE_COVARIANCE, "/robot/pose": POSE},
        {"pose": "/robot/pose"},
    ),
    "a car": (
        "ackermann_car",
        {"/ackermann_cmd": DRIVE, "/joint_states": JOINTS, **ICP},
        {"command": "/ackermann_cmd", "wheels": "/joint_states"},
    ),
    "a car that reports its drive": (
        "ackermann_car",
        {"/drive": DRIVE, "/drive/status": DRIVE, **ICP},
        {"command": "/drive", "wheels": "/drive/status"},
    ),
    "a car with a number a topic": (
        "ackermann_car",
        {f"/vehicle/{what}{role}": FLOAT for what in ("speed", "steering") for role in ("", "_command")}
        | ICP,
        {
            "command": "/vehicle/speed_command.data, /vehicle/steering_command.data",
            "wheels": "/vehicle/speed.data, /vehicle/steering.data",
        },
    ),
    "ROS 1 type names": (
        "husky",
        {"/joint_states": "sensor_msgs/JointState", "/cmd_vel": "geometry_msgs/Twist", "/tf": "tf/tfMessage"},
        {"command": "/cmd_vel", "wheels": "/joint_states", "pose": "/tf"},
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_topics_are_chosen(name: str) -> None:
    vehicle, topics, expected = CASES[name]
    found = names(choose(topics, vehicle))
    assert {role: found[role] for role in expected} == expected


OF_WHEELS = (
    "/navio/wheel_odom",
    "/clio/encoder_odom",
    "/mapper/wheel_odom",
    "/slam_bot/diff_drive_controller/odom",
)


def test_a_word_in_the_robots_name_makes_wheel_odometry_no_localization() -> None:
    for topic in OF_WHEELS:
        sources = choose({"/cmd_vel": TWIST, topic: ODOMETRY, "/robot/pose": POSE})
        assert names(sources) == {"command": "/cmd_vel", "wheels": topic, "pose": "/robot/pose", "imu": None}
        # Where there is no other, it is taken for what it is.
        alone = choose({"/cmd_vel": TWIST, topic: ODOMETRY}).pose
        assert "comes from the wheels" in alone.reason


LOCALIZATIONS = (
    "/fastlio/odom", "/rtabmap/odom", "/lidar_slam/odom", "/wheel_odom/icp", "/base_controller/slam/odom",
    "/vicon/wheel_loader/odom", "/openvio/odometry", "/slam_bot/wheel_lidar_odom/map",
)  # fmt: skip


def test_a_localization_is_told_by_its_name() -> None:
    for topic in LOCALIZATIONS:
        pose = choose({"/cmd_vel": TWIST, topic: ODOMETRY, "/robot/pose": POSE}).pose
        assert (pose.topic, pose.reason) == (topic, "a localization by its name")


def test_every_simulated_layout_is_understood() -> None:
    machines = {vehicle.kind: vehicle for vehicle in VEHICLES.values()}
    for name, layout in LAYOUTS.items():
        published = list_topics(layout, Scenario(vehicle=machines[layout.kind]))
        sources = choose(
            {one.topic: one.type_name for one in published},
            "ackermann_car" if layout.kind == "ackermann" else "husky",
        )
        for source, chosen in (("command", sources.command), ("wheels", sources.wheels)):
            several = [one for one in published if one.source == source]
            # Of several commands the first is the one that the wheels get.
            first = [one.topic for one in several if one.type_name == several[0].type_name]
            signals = () if chosen is None else chosen.signals
            assert list(dict.fromkeys(signal.topic for signal in signals)) == first, name
        assert sources.pose.topic in {one.topic for one in published if one.source in POSES}, name


def test_what_is_configured_is_taken_whatever_it_is_called() -> None:
    topics = {"/a": JOINTS, "/b": JOINTS, "/wheel_commands": JOINTS, "/odd": POSE, "/i": IMU, **ICP}
    sources = choose(
        topics,
        configuration={
            "command": {"topic": "/a"},
            "wheels": {"topic": "/b"},
            "pose": {"topic": "/odd"},
            "imu": {"topic": "/i"},
        },
    )
    assert names(sources) == {"command": "/a", "wheels": "/b", "pose": "/odd", "imu": "/i"}
    assert sources.command.reason == "configured"


def test_a_field_of_any_message_can_be_a_side() -> None:
    topics = {"/drive": "my_msgs/msg/Drive", **ICP}
    found = choose(
        topics,
        configuration={"command": {"left_topic": "/drive.speed[0]", "right_topic": "/drive.speed[1]"}},
    )
    assert found.command.form is DriveForm.SIDES
    assert found.command.signals == (Signal("/drive", "speed[0]"), Signal("/drive", "speed[1]"))


def test_a_calib_state_topic_is_applied_by_default_and_can_be_turned_off() -> None:
    topics = {"/drive/calib_state": STRING, **ICP}
    applied = choose(topics).interval
    assert "--interval all" in applied.reason
    assert choose(topics, configuration={"use_intervals": "all"}).interval is None
    assert choose(topics, configuration={"interval": [{"start_s": 1.0}]}).interval is None


@pytest.mark.parametrize(
    ("configuration", "code", "words"),
    [
        ({"command": {"topic": "/nowhere"}}, "topic_not_found", ["/nowhere", "command", "/mapping/icp_odom"]),
        ({"pose": {"topic": "/joint_states"}}, "type_not_usable", ["/joint_states", "pose", "JointState"]),
        ({"imu": {"topic": "/joint_states"}}, "type_not_usable", ["/joint_states", "imu"]),
        ({"command": {"topic": "/mapping/icp_odom"}}, "type_not_usable", ["command", "left_topic"]),
        (
            {"command": {"left_topic": "/joint_states", "right_topic": "/joint_states"}},
            "field_needed",
            ["/joint_states", "field"],
        ),
        ({"command": {"speed_topic": "/joint_states.velocity[0]"}}, "field_needed", ["yaw_rate"]),
        ({"command": {"yaw_rate_topic": "/joint_states.velocity[0]"}}, "field_needed", ["speed_topic"]),
        ({"command": {"left_topic": "/nothing.x"}}, "field_needed", ["left_topic", "command.right_topic"]),
        (
            {"command": {"topic": "/joint_states"}},
            "command_is_measured",
            ["measured", "No topic", "[command]"],
        ),
        (
            {"command": {"topic": "/arm/joints"}, "wheels": {"topic": "/arm/joints"}},
            "one_of_two_roles",
            ["/arm/joints", "[command]", "[wheels]"],
        ),
        ({"wheels": {"left": ["front_left"]}}, "field_needed", ["wheels.left", "wheels.right"]),
        ({"pose": {"frames": ["map", "base_link"]}}, "topic_not_found", ["transforms", "pose.topic"]),
        ({"interval": [{"topic": "/joint_states"}]}, "type_not_usable", ["interval", "String"]),
        (
            {"interval": [{"topic": "/a"}, {"topic": "/b"}]},
            "intervals_disagree",
            ["/a", "/b", "equals"],
        ),
    ],
)
def test_a_choice_that_cannot_be_followed_is_one_clear_line(
    configuration: dict[str, object], code: str, words: list[str]
) -> None:
    with pytest.raises(ConfigurationError) as caught:
        choose({"/joint_states": JOINTS, "/arm/joints": JOINTS, **ICP}, configuration=configuration)
    said = str(caught.value)
    assert caught.value.code == code
    assert "\n" not in said
    assert [word for word in words if word not in said] == []


def test_measurements_that_are_configured_as_command_name_the_commands() -> None:
    with pytest.raises(ConfigurationError, match=r"Commands are in /cmd_vel\. Take /joint_states out"):
        choose(
            {"/joint_states": JOINTS, "/cmd_vel": TWIST, **ICP},
            configuration={"command": {"topic": "/joint_states"}},
        )


def test_a_topic_that_is_configured_for_one_role_has_no_other() -> None:
    chosen = choose({"/joints": JOINTS, **ICP}, configuration={"command": {"topic": "/joints"}})
    assert (str(chosen.command), chosen.wheels) == ("/joints", None)


@pytest.mark.parametrize(
    ("control", "vehicle", "speed"),
    [
        ("autoware_control_msgs/msg/Control", "autoware_vehicle_msgs", "longitudinal.velocity"),
        (
            "autoware_auto_control_msgs/msg/AckermannControlCommand",
            "autoware_auto_vehicle_msgs",
            "longitudinal.speed",
        ),
    ],
)
def test_both_generations_of_autoware_are_read(control: str, vehicle: str, speed: str) -> None:
    topics = {
        "/control/command/control_cmd": control,
        "/vehicle/status/velocity_status": f"{vehicle}/msg/VelocityReport",
        "/vehicle/status/steering_status": f"{vehicle}/msg/SteeringReport",
        "/localization/kinematic_state": ODOMETRY,
    }
    sources = choose(topics, "autoware")
    assert [signal.field for signal in sources.command.signals] == [speed, "lateral.steering_tire_angle"]
    assert names(sources)["wheels"] == (
        "/vehicle/status/velocity_status.longitudinal_velocity, "
        "/vehicle/status/steering_status.steering_tire_angle"
    )


def test_an_orientation_is_no_position() -> None:
    turned = ["orientation.x", "orientation.y", "orientation.z", "orientation.w"]
    assert find_pose_fields("/imu/data", turned) is None
    assert find_pose_fields("/tracker", [*turned, "p.x", "p.y"]) == ("p.x", "p.y", "")
