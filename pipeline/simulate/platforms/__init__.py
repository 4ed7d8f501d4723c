"""What popular platforms publish, so that logs with exactly their topics, types and frames can be made.

A platform is one file here: its vehicle, and its topics. A topic is one of the few that many platforms share
(``twist = TOPIC`` and what the function `twist` takes), or says its type, source, constants and quantities.
"""

import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING, Any

from pipeline.simulate.facts import Layout, PoseTopic, Vehicle, find_vehicle, unknown_name
from pipeline.simulate.published import Json, Published, Q, Source, Value

_WIDTH_M = 0.05


def describe_robot(name: str, vehicle: Vehicle, joints: Mapping[str, str]) -> str:
    """A description in which every wheel is a joint of base_link.

    Args:
        name: of the robot.
        vehicle: its geometry.
        joints: names of the wheel joints by their place, ``front_left`` and the like; ``left`` for the only
            axle. Places that begin with ``steer`` steer.
    """
    parts = ['<link name="base_link"/>']
    for corner, joint in joints.items():
        y = 0.5 * vehicle.track_width_m * (1.0 if corner.endswith("left") else -1.0)
        if vehicle.kind == "ackermann":
            x = vehicle.wheelbase_m if "front" in corner or corner.startswith("steer") else 0.0
        else:
            x = vehicle.wheelbase_m * {"front": 0.5, "rear": -0.5}.get(corner.split("_")[0], 0.0)
        parts.append(_write_joint(joint, (x, y), vehicle.wheel_radius_m, steers=corner.startswith("steer")))
    return f'<?xml version="1.0"?><robot name="{name}">{"".join(parts)}</robot>'


def _write_joint(joint: str, position: tuple[float, float], radius_m: float, *, steers: bool) -> str:
    link = joint.removesuffix("_joint") + "_link"
    shape = f'<cylinder radius="{radius_m}" length="{_WIDTH_M}"/>'
    geometry = "" if steers else f"<collision><geometry>{shape}</geometry></collision>"
    kind, axis = ("revolute", "0 0 1") if steers else ("continuous", "0 1 0")
    return (
        f'<link name="{link}">{geometry}</link><joint name="{joint}" type="{kind}">'
        f'<parent link="base_link"/><child link="{link}"/>'
        f'<origin xyz="{position[0]} {position[1]} 0" rpy="0 0 0"/><axis xyz="{axis}"/></joint>'
    )


_XYZ, _XYZW = "xyz", "xyzw"

Fields = dict[str, Value]


@dataclass(frozen=True)
class Platform:
    """A platform: the vehicle, and what it publishes.

    Attributes:
        vehicle: geometry as the vendor states it.
        topics: everything in a log.
    """

    vehicle: Vehicle
    topics: tuple[Published, ...]

    @property
    def layout(self) -> Layout:
        """As a layout of topics."""
        return Layout(self.vehicle.kind, (), (), PoseTopic("odometry", ""), topics=self.topics)


def pose_fields(position: str, orientation: str) -> dict[str, Q]:
    """Fields of a pose."""
    fields = {f"{position}.{axis}": Q(axis) for axis in _XYZ}
    return fields | {f"{orientation}.{axis}": Q(f"q{axis}") for axis in _XYZW}


def twist(
    topic: str, *, stamped: bool = False, source: Source = "command", sideways: bool = False
) -> Published:
    """A body command; a ``wish`` is one that never reaches the controller."""
    prefix, name = ("twist.", "TwistStamped") if stamped else ("", "Twist")
    fields = {f"{prefix}linear.x": Q("speed"), f"{prefix}angular.z": Q("yaw_rate")}
    if sideways:
        fields[f"{prefix}linear.y"] = Q("sideways")
    return Published(
        topic, f"geometry_msgs/msg/{name}", source, fields, stamp="header" if stamped else "none"
    )


def odometry(topic: str, source: Source, parent: str, child: str, *, sideways: bool = False) -> Published:
    """An odometry; one of the wheels says their speed as well."""
    fields: Fields = {
        **pose_fields("pose.pose.position", "pose.pose.orientation"),
        "header.frame_id": parent,
        "child_frame_id": child,
    }
    if source != "localization":
        fields |= {"twist.twist.linear.x": Q("speed"), "twist.twist.angular.z": Q("yaw_rate")}
        if sideways:
            fields["twist.twist.linear.y"] = Q("sideways")
    return Published(topic, "nav_msgs/msg/Odometry", source, fields)


def transform(topic: str, source: Source, parent: str, child: str) -> Published:
    """A moving transform."""
    inner = "transforms[].transform."
    fields: Fields = {
        **pose_fields(f"{inner}translation", f"{inner}rotation"),
        "transforms[].header.frame_id": parent,
        "transforms[].child_frame_id": child,
    }
    return Published(topic, "tf2_msgs/msg/TFMessage", source, fields)


def mecanum_joints(topic: str, names: Mapping[str, str]) -> Published:
    """Joint states of four wheels that differ, named by their place (`CORNERS`)."""
    values: Fields = {
        "name": list(names.values()),
        "position": tuple(Q(f"{corner}_angle") for corner in names),
        "velocity": tuple(Q(corner) for corner in names),
    }
    return Published(topic, "sensor_msgs/msg/JointState", "wheels", values)


def joints(topic: str, template: str, places: Sequence[str], fields: str = "both") -> Published:
    """Joint states of the wheels; ``fields`` may be ``position`` alone."""
    names = [_name_joint(template, corner) for corner in places]
    turned = tuple(Q("steering") if p.startswith("steer") else Q(f"{_side(p)}_angle") for p in places)
    rolling = tuple(Q("zero") if p.startswith("steer") else Q(_side(p)) for p in places)
    values: Fields = {"name": names, "position": turned}
    return Published(
        topic,
        "sensor_msgs/msg/JointState",
        "wheels",
        values if fields == "position" else values | {"velocity": rolling},
    )


def _side(corner: str) -> str:
    return corner.rsplit("_", 1)[-1]


def _name_joint(template: str, corner: str) -> str:
    """Name of the wheel joint of a place, or of its steering joint."""
    name = template.format(corner.removeprefix("steer_"))
    return name.replace("wheel", "steering") if corner.startswith("steer") else name


def imu(topic: str, *, attitude: bool = False) -> Published:
    """An inertial unit, perhaps with an attitude."""
    fields: Fields = {"header.frame_id": "imu_link", "orientation.w": 1.0}
    if attitude:
        fields |= {f"orientation.{axis}": Q(f"attitude_{axis}") for axis in _XYZW}
    fields |= {f"angular_velocity.{axis}": Q(f"rate_{axis}") for axis in _XYZ}
    fields |= {f"linear_acceleration.{axis}": Q(f"force_{axis}") for axis in _XYZ}
    return Published(topic, "sensor_msgs/msg/Imu", "imu", fields)


def fix(topic: str, every: int = 2) -> Published:
    """Fixes of a receiver of satellites."""
    fields: Fields = {name: Q(name) for name in ("latitude", "longitude", "altitude")}
    fields |= {"header.frame_id": "gps_link", "status.status": Q("fixed")}
    return Published(topic, "sensor_msgs/msg/NavSatFix", "satellites", fields, every=every)


def ground_velocity(topic: str, every: int = 2) -> Published:
    """Velocities over ground, as nmea_navsat_driver gives them: east, north."""
    fields: Fields = {"twist.linear.x": Q("east_speed"), "twist.linear.y": Q("north_speed")}
    fields["header.frame_id"] = "gps_link"
    return Published(topic, "geometry_msgs/msg/TwistStamped", "satellites", fields, every=every)


def pose_with_covariance(topic: str, every: int) -> Published:
    """A slow localization."""
    fields: Fields = {
        **pose_fields("pose.pose.position", "pose.pose.orientation"),
        "header.frame_id": "map",
    }
    name = "geometry_msgs/msg/PoseWithCovarianceStamped"
    return Published(topic, name, "localization", fields, every=every)


def describe(topic: str, name: str, vehicle: Vehicle, template: str, places: Sequence[str]) -> Published:
    """A robot description."""
    text = describe_robot(name, vehicle, {corner: _name_joint(template, corner) for corner in places})
    return Published(topic, "std_msgs/msg/String", "once", {"data": text}, stamp="none")


_SHARED: dict[str, Callable[..., Published]] = {
    made.__name__: made
    for made in (
        *(twist, odometry, transform, mecanum_joints, joints),
        *(imu, fix, ground_velocity, pose_with_covariance, describe),
    )
}


def _read_value(given: Any) -> Value:  # noqa: ANN401 - as the file has it
    """A quantity by its name, perhaps with a gain; several; or a JSON object of some."""
    if isinstance(given, list):
        return tuple(Q(each) if isinstance(each, str) else Q(**each) for each in given)
    if isinstance(given, str):
        return Q(given)
    return Json({key: Q(name) for key, name in given["json"].items()}) if "json" in given else Q(**given)


def _read_topic(entry: dict[str, Any], vehicle: Vehicle) -> Published:
    for name in _SHARED.keys() & entry:
        options = {"vehicle": vehicle} if name == "describe" else {}
        return _SHARED[name](entry.pop(name), **entry, **options)
    fields = entry.pop("constants", {})
    fields |= {path: _read_value(given) for path, given in entry.pop("quantities", {}).items()}
    return Published(entry.pop("topic"), entry.pop("type"), entry.pop("source"), fields, **entry)


def _read_platform(text: str) -> Platform:
    content = tomllib.loads(text)
    given = content["vehicle"]
    vehicle = find_vehicle(given) if isinstance(given, str) else Vehicle(**given)
    return Platform(vehicle, tuple(_read_topic(entry, vehicle) for entry in content["topics"]))


PLATFORMS: dict[str, Platform] = {
    file.name.removesuffix(".toml"): _read_platform(file.read_text("utf-8"))
    for file in sorted(resources.files(__name__).iterdir(), key=lambda file: file.name)
    if file.name.endswith(".toml")
}


def find_platform(name: str) -> Platform:
    """A platform by its name.

    Raises:
        SimulateError: ``unknown_platform``.
    """
    if name not in PLATFORMS:
        raise unknown_name("platform", name, sorted(PLATFORMS))
    return PLATFORMS[name]
