"""Two robots in one log: the command of one never meets the pose of the other."""

import pytest
from test_sources_topics import (
    CASES,
    DRIVE,
    FLOAT,
    ICP,
    IMU,
    JOINTS,
    ODOMETRY,
    POSE,
    TF,
    TWIST,
    choose,
    names,
)

from pipeline.sources import ConfigurationError

TWO = {
    "/robot1/cmd_vel": TWIST,
    "/robot1/odom": ODOMETRY,
    "/robot1/joint_states": JOINTS,
    "/robot1/imu": IMU,
    "/robot2/cmd_vel": TWIST,
    "/robot2/icp_odom": ODOMETRY,
    "/robot2/joint_states": JOINTS,
    "/robot2/imu": IMU,
    "/tf": TF,
}

REFUSED = {
    "the command of one and the pose of the other": {"/robot1/cmd_vel": TWIST, "/robot2/odom": ODOMETRY},
    "two whole robots": TWO,
    "called after vehicles": {"/husky/cmd_vel": TWIST, "/warthog/odom": ODOMETRY},
    "by their letter": {"/robot_a/cmd_vel": TWIST, "/robot_b/odom": POSE},
    "by their serial number": {"/a200_0001/platform/cmd_vel": TWIST, "/a200_0002/sensors/odom": ODOMETRY},
    "in a namespace of all": {"/fleet/r1/joint_commands": JOINTS, "/fleet/r2/odom": ODOMETRY},
    "a signal a side": {f"/ugv1/{side}/cmd": FLOAT for side in ("left", "right")} | {"/ugv2/odom": ODOMETRY},
    "by what they hold": {
        f"/{name}/{topic}": kind
        for name in ("alice", "bob")
        for topic, kind in (("cmd_vel", TWIST), ("odom", POSE))
    },
    "transforms of the other": {"/car1/ackermann_cmd": DRIVE, "/car2/tf": TF},
    "a pose of nobody does not help": {"/robot1/cmd_vel": TWIST, "/robot2/odom": ODOMETRY, **ICP, "/tf": TF},
}


def test_two_robots_are_refused_until_one_is_named() -> None:
    for topics in REFUSED.values():
        with pytest.raises(ConfigurationError) as caught:
            choose(topics)
        said = str(caught.value)
        assert caught.value.code == "several_robots"
        assert "\n" not in said
        assert "run.toml" in said
        assert "[pose] topic = " in said
        spaces = {topic.split("/")[-2 if "fleet" in topic else 1] for topic in topics}
        robots = spaces - {"mapping", "tf", "fleet"}
        assert [robot for robot in robots if robot not in said] == []


@pytest.mark.parametrize(
    ("configuration", "robot"),
    [
        ({"command": {"topic": "/robot1/cmd_vel"}}, "robot1"),
        ({"command": {"topic": "/robot2/cmd_vel"}}, "robot2"),
        ({"pose": {"topic": "/robot2/icp_odom"}}, "robot2"),
        ({"wheels": {"topic": "/robot1/joint_states"}}, "robot1"),
    ],
)
def test_who_names_one_topic_gets_the_others_of_that_robot(
    configuration: dict[str, object], robot: str
) -> None:
    sources = choose(TWO, configuration=configuration)
    assert {str(source).split("/")[1] for source in names(sources).values()} == {robot}
    assert any(note.startswith(f"robot: {robot}; ") for note in sources.notes)


def test_who_names_both_gets_both() -> None:
    topics = REFUSED["the command of one and the pose of the other"]
    configured = {"command": {"topic": "/robot1/cmd_vel"}, "pose": {"topic": "/robot2/odom"}}
    assert names(choose(topics, configuration=configured))["pose"] == "/robot2/odom"
    frames = {"command": {"topic": "/robot1/cmd_vel"}, "pose": {"frames": ["map", "robot1/base_link"]}}
    assert names(choose(TWO, configuration=frames))["pose"] == "/tf (map -> robot1/base_link)"


def test_the_only_whole_robot_is_taken_and_said() -> None:
    sources = choose({"/robot1/cmd_vel": TWIST, "/robot1/odom": ODOMETRY, "/robot2/odom": ODOMETRY})
    assert names(sources)["pose"] == "/robot1/odom"
    assert any("robot2" in note for note in sources.notes)


ONE = {
    "a namespace and what is global": (
        {"/robot1/cmd_vel": TWIST, "/robot1/joint_states": JOINTS, "/tf": TF, **ICP, "/imu/data": IMU},
        {"command": "/robot1/cmd_vel", "pose": "/mapping/icp_odom", "imu": "/imu/data"},
    ),
    "sensors with numbers": (
        {"/cmd_vel": TWIST, "/lidar1/odom": ODOMETRY, "/lidar2/odom": ODOMETRY, "/mti30/data": IMU},
        {"command": "/cmd_vel", "pose": "/lidar1/odom"},
    ),
    "what a controller and a localization are called": (
        {
            "/platform/cmd_vel": TWIST,
            "/platform/odom": ODOMETRY,
            "/husky_velocity_controller/cmd_vel": TWIST,
            "/husky_velocity_controller/odom": ODOMETRY,
            **ICP,
        },
        {"pose": "/mapping/icp_odom"},
    ),
    "a vehicle's name beside its controller's": (
        {"/warthog/platform/cmd_vel": TWIST, "/warthog_velocity_controller/odom": ODOMETRY},
        {"command": "/warthog/platform/cmd_vel", "pose": "/warthog_velocity_controller/odom"},
    ),
    "left and right": (
        {"/drive_l/joint_states": JOINTS, "/drive_r/joint_states": JOINTS, "/drive_l/odom": ODOMETRY},
        {"pose": "/drive_l/odom"},
    ),
}


@pytest.mark.parametrize("name", ONE)
def test_one_robot_is_chosen_for_as_ever(name: str) -> None:
    topics, expected = ONE[name]
    found = names(choose(topics))
    assert {role: found[role] for role in expected} == expected


def test_no_known_layout_is_taken_for_several_robots() -> None:
    for vehicle, topics, _ in CASES.values():
        assert not any(note.startswith("robot:") for note in choose(topics, vehicle).notes)
