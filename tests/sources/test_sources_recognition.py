"""The vehicle that a log tells: robot descriptions, words of names, message types."""

import pytest
from simulated_platforms import PLATFORMS

from pipeline.logs import ChannelInfo
from pipeline.sources import (
    Recognized,
    find_alike_vehicles,
    find_preset,
    list_contradictions,
    read_description,
    recognize_vehicle,
)

BURGER = """<?xml version="1.0"?><robot name="turtlebot3_burger">
<link name="base_footprint"/><link name="base_link"/>
<joint name="base_joint" type="fixed"><parent link="base_footprint"/><child link="base_link"/>
 <origin xyz="0 0 0.010" rpy="0 0 0"/></joint>
<joint name="wheel_left_joint" type="continuous"><parent link="base_link"/><child link="wheel_left_link"/>
 <origin xyz="0.0 0.08 0.023" rpy="-1.57 0 0"/><axis xyz="0 0 1"/></joint>
<link name="wheel_left_link">{shape}</link>
<joint name="wheel_right_joint" type="continuous"><parent link="base_link"/><child link="wheel_right_link"/>
 <origin xyz="0.0 -0.080 0.023" rpy="-1.57 0 0"/><axis xyz="0 0 1"/></joint>
<link name="wheel_right_link">{shape}</link>
<joint name="caster_back_joint" type="continuous"><parent link="base_link"/><child link="caster"/>
 <origin xyz="-0.08 0.05 -0.004" rpy="-1.57 0 0"/><axis xyz="0 0 1"/></joint>
<link name="caster"><collision><geometry><sphere radius="0.005"/></geometry></collision></link></robot>"""
CYLINDER = '<collision><geometry><cylinder length="0.018" radius="0.033"/></geometry></collision>'
MESH = '<visual><geometry><mesh filename="package://a/left_tire.stl"/></geometry></visual>'


def recognize(
    *topics: str, types: str = "geometry_msgs/msg/Twist", metadata: dict[str, dict[str, str]] | None = None
) -> Recognized | None:
    channels = [ChannelInfo(i, topic, types, "ros2msg", "cdr", 5, {}) for i, topic in enumerate(topics)]
    return recognize_vehicle(channels, metadata or {}, None)


@pytest.mark.parametrize("shape", [CYLINDER, MESH], ids=["a cylinder", "a mesh, over the footprint"])
def test_wheels_of_a_description_give_radius_and_track(shape: str) -> None:
    found = read_description(BURGER.format(shape=shape))
    assert (found.name, found.kind) == ("turtlebot3_burger", "differential")
    assert found.wheel_radius_m == pytest.approx(0.033, abs=1e-3)
    assert found.track_width_m == pytest.approx(0.16, abs=1e-3)
    assert found.wheels == ("wheel_left_joint", "wheel_right_joint")


def test_joints_of_an_arm_on_a_base_are_no_wheels() -> None:
    arm = """<joint name="arm_mount" type="fixed"><parent link="base_link"/><child link="arm"/>
 <origin xyz="0.05 0 0.2" rpy="0 0 0"/></joint>
<joint name="shoulder" type="revolute"><parent link="arm"/><child link="upper_arm"/>
 <origin xyz="0.05 0.06 0.1" rpy="0 0 0"/><axis xyz="0 1 0"/></joint>
<joint name="wrist" type="continuous"><parent link="upper_arm"/><child link="hand"/>
 <origin xyz="0.3 -0.12 0" rpy="0 0 0"/><axis xyz="0 1 0"/></joint></robot>"""
    for shape in (CYLINDER, MESH):
        text = BURGER.format(shape=shape)
        assert read_description(text.replace("</robot>", arm)) == read_description(text)


def test_a_car_is_told_by_its_steering_joints() -> None:
    platform = PLATFORMS["ackermann_steering_controller"]
    (text,) = [one.fields["data"] for one in platform.topics if one.topic == "/robot_description"]
    found = read_description(str(text))
    assert found.kind == "ackermann"
    assert found.wheelbase_m == pytest.approx(platform.vehicle.wheelbase_m)
    assert found.track_width_m == pytest.approx(platform.vehicle.track_width_m)
    assert found.wheel_radius_m == pytest.approx(platform.vehicle.wheel_radius_m)
    assert found.base_to_rear_axle_m == 0.0
    assert found.max_steering_rad is None


@pytest.mark.parametrize(
    ("limit", "largest"), [('lower="-0.5" upper="0.6"', 0.6), ('lower="-3.2" upper="3.2"', None), ("", None)]
)
def test_a_car_turns_its_wheels_as_far_as_its_description_says(limit: str, largest: float | None) -> None:
    platform = PLATFORMS["ackermann_steering_controller"]
    (text,) = [one.fields["data"] for one in platform.topics if one.topic == "/robot_description"]
    joint = f"<limit {limit} effort='10' velocity='2'/></joint>"
    found = read_description(str(text).replace("</joint>", joint))
    assert found.max_steering_rad == largest
    recognized = recognize_vehicle([], {}, found)
    assert recognized.vehicle.max_steering_rad == largest


def test_a_text_with_entities_or_without_wheels_is_no_description() -> None:
    for text in [
        "",
        "no xml",
        "<robot/>",
        '<!DOCTYPE r [<!ENTITY a "b">]><robot name="&a;"/>',
        BURGER.format(shape=CYLINDER).replace('xyz="0.0 0.08 0.023"', 'xyz="nan x 1"'),
        BURGER.format(shape=CYLINDER).replace(
            '<parent link="base_link"/>', '<parent link="wheel_left_link"/>'
        ),
    ]:
        assert read_description(text) is None


def test_a_namespace_tells_the_platform() -> None:
    for topic, vehicle in [
        ("/a200_0042/platform/cmd_vel", "husky_a200"),
        ("/j100_0001/cmd_vel", "jackal"),
        ("/panther/cmd_vel", "panther"),
        ("/do100_0001/platform/cmd_vel", "dingo_o"),
        ("/rosbot/cmd_vel", "rosbot_2r"),
        # Of words within each other the longest counts.
        ("/rosbot_xl/cmd_vel", "rosbot_xl"),
    ]:
        found = recognize(topic)
        assert (found.vehicle.id, found.source) == (vehicle, "namespace")


def test_mecanum_wheels_are_told_by_a_description_that_speaks_of_them() -> None:
    (text,) = [one.fields["data"] for one in PLATFORMS["youbot"].topics if "description" in one.topic]
    plain = read_description(str(text).replace("youbot", "my_robot"))
    rollers = str(text).replace("youbot", "my_robot").replace("<link ", '<link name="roller_1"/><link ', 1)
    described = read_description(rollers)
    assert (plain.kind, described.kind) == ("differential", "mecanum")
    found = recognize_vehicle([], {}, described)
    assert (found.vehicle.kind, found.vehicle.wheelbase_m) == ("mecanum", pytest.approx(0.47))


def test_a_description_of_no_platform_gives_its_own_geometry() -> None:
    described = read_description(BURGER.format(shape=CYLINDER).replace("turtlebot3_burger", "my_robot"))
    found = recognize_vehicle([], {}, described)
    assert (found.vehicle.id, found.source) == ("my_robot", "robot_description")
    assert found.vehicle.track_width_m == pytest.approx(0.16, abs=1e-3)


def test_where_description_and_preset_differ_both_are_said() -> None:
    wide = BURGER.format(shape=CYLINDER).replace("0.0 0.08 0.023", "0.0 0.18 0.023")
    found = recognize_vehicle([], {}, read_description(wide))
    assert found.vehicle.id == "turtlebot3_burger"
    (note,) = found.notes
    assert (note["described"], note["known"]) == (0.26, 0.16)


def test_a_fitted_geometry_is_compared_with_the_platforms() -> None:
    assert list(find_alike_vehicles(0.0331, 0.286)) == ["turtlebot3_waffle", "turtlebot3_burger"]
    assert find_alike_vehicles(0.5, 0.1) == {}
    # A skid-steered platform turns as if its track were wider; other wheels are no guess.
    alike = find_alike_vehicles(0.165, 1.01)
    assert alike["husky_a200"] == ("Clearpath Husky A200", pytest.approx(0.55 / 1.01))
    assert "warthog_tracks" not in alike


def test_four_described_wheels_contradict_a_car_and_no_mecanum_vehicle() -> None:
    youbot, car = find_preset("youbot"), find_preset("car")
    assert youbot is not None
    assert car is not None
    (text,) = [one.fields["data"] for one in PLATFORMS["youbot"].topics if "description" in one.topic]
    described = recognize_vehicle([], {}, read_description(str(text).replace("youbot", "my_robot")))
    assert described.vehicle.kind == "differential"
    assert list_contradictions(described.vehicle, youbot) == {}
    assert list_contradictions(described.vehicle, car)["kind"] == "kind differential, not ackermann"
