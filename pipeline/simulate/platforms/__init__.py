"""What popular platforms publish, so that logs with exactly their topics, types and frames can be made.

A platform is one file here: its vehicle, and its topics. A topic is one of the few that many platforms share
(``twist = TOPIC`` and what the function `twist` takes), or says its type, source, constants and quantities:
its fields, each filled from a quantity of the run.
"""

import json
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from typing import Any, Literal

import numpy as np

from pipeline.core import Floats, rigid
from pipeline.simulate.drivetrain import apply_ideal_model, invert_ideal_model
from pipeline.simulate.facts import (
    DriveTopic,
    Json,
    Layout,
    PoseTopic,
    Published,
    Q,
    SimulateError,
    Source,
    Value,
    Vehicle,
    describe_robot,
    find_vehicle,
    open_stream,
    unknown_name,
)
from pipeline.simulate.messages import LATE_S, Field, Messages, SimulatedRun
from pipeline.simulate.programs import make_wishes, walk_in_plane
from pipeline.simulate.scenario import Scenario, integrate_cells
from pipeline.simulate.sensors import to_earth

Series = dict[str, Floats]

_TF_PERIOD_S, _FUTURE_S = 0.05, 0.1
_TURN = 2.0 * np.pi
_COMPASS_OFF_RAD = 0.7
"""An attitude is seldom against the true north."""
_DOPPLER_S = 0.05
_DOPPLER_NOISE_MPS = 0.03
_BATTERY_V, _IDLE_W, _RESISTANCE_N = 36.0, 40.0, 120.0
_ENU_IN_NED = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])
_FRD_IN_FLU = np.array([1.0, 0.0, 0.0, 0.0])


def publish(run: SimulatedRun, topics: tuple[Published, ...]) -> list[Messages]:
    """Messages of every topic.

    Raises:
        SimulateError: ``encoders_needed``, a topic needs wheels or a gyro that the scenario leaves out.
    """
    known: dict[str, tuple[Floats, Floats, Series]] = {}
    tables = []
    for one in topics:
        if one.source not in known:
            known[one.source] = _SOURCES[one.source](run)
        stamp, log, series = known[one.source]
        rows = slice(None, None, one.every)
        fields = {path: _fill(value, series, rows) for path, value in one.fields.items()}
        header = None if one.stamp == "none" else stamp[rows]
        tables.append(Messages(one.topic, one.type_name, log[rows], header, fields, one.stamp))
    return tables


def _fill(value: Value, series: Series, rows: slice) -> Field:
    if isinstance(value, Json):
        columns = [_take(each, series, rows).tolist() for each in value.numbers.values()]
        return [json.dumps(dict(zip(value.numbers, row, strict=True))) for row in zip(*columns, strict=True)]
    if isinstance(value, tuple):
        return np.stack([_take(each, series, rows) for each in value], axis=1)
    return _take(value, series, rows) if isinstance(value, Q) else value


def _take(quantity: Q, series: Series, rows: slice) -> Floats:
    values = series[quantity.name][rows]
    if (quantity.gain, quantity.offset) != (1.0, 0.0):
        values = quantity.gain * values + quantity.offset
    return np.floor(values) if quantity.whole else values


def _of_command(run: SimulatedRun) -> tuple[Floats, Floats, Series]:
    commands, vehicle, recording = run.commands, run.scenario.vehicle, run.scenario.recording
    turned = recording.command_scale if recording.command_turn_scale is None else recording.command_turn_scale
    left, right = invert_ideal_model(
        vehicle, recording.command_scale * commands.speed_mps, turned * commands.turn
    )
    series = {
        "speed": commands.speed_mps,
        "yaw_rate": commands.yaw_rate(vehicle),
        "steering": commands.turn,
        "left": left,
        "right": right,
        "sideways": commands.sideways,
    }
    return commands.time_s, commands.time_s + recording.command_latency_s, series


def _of_wish(run: SimulatedRun) -> tuple[Floats, Floats, Series]:
    wished = make_wishes(run.scenario, "wish")
    series = {"speed": wished.speed_mps, "yaw_rate": wished.turn, "sideways": wished.sideways}
    return wished.time_s, wished.time_s, series


def _of_wheels(run: SimulatedRun) -> tuple[Floats, Floats, Series]:
    wheels = run.wheels
    if wheels is None:
        raise _missing("encoders")
    speed, rate = apply_ideal_model(run.scenario.vehicle, wheels.left, wheels.right, wheels.steering)
    series = {
        name: getattr(wheels, name) for name in ("left", "right", "left_angle", "right_angle", "steering")
    }
    series |= {"speed": speed, "yaw_rate": rate, "zero": np.zeros_like(speed)}
    series["sideways"] = wheels.sideways_mps(run.scenario.vehicle)
    series |= dict(wheels.corners or {})
    series |= {f"{corner}_angle": angle for corner, angle in (wheels.corner_angles or {}).items()}
    series |= {f"{side}_turns": series[f"{side}_angle"] / _TURN for side in ("left", "right")}
    if run.imu is not None:
        # Where one message holds both.
        for name, values in (("rate", run.imu.rates), ("force", run.imu.accelerations)):
            for i, axis in enumerate("xyz"):
                series[f"{name}_{axis}"] = np.interp(wheels.time_s, run.imu.time_s, values[:, i])
    return wheels.time_s, wheels.time_s + LATE_S, series


def _of_odometry(run: SimulatedRun, *, gyro: bool = False) -> tuple[Floats, Floats, Series]:
    stamp, log, series = _of_wheels(run)
    rate = series["yaw_rate"]
    if gyro:
        if run.imu is None:
            raise _missing("an inertial unit")
        rate = np.interp(stamp, run.imu.time_s, run.imu.rates[:, 2])
    step = float(np.median(np.diff(stamp)))
    heading = integrate_cells(rate, step_s=step)
    speed, aside = series["speed"], series["sideways"]
    position = walk_in_plane(speed, aside, heading, step_s=step)[:-1]
    named = _name(position, rigid.quaternions_from_yaw(heading[:-1]))
    return stamp, log, named | {"speed": speed, "yaw_rate": rate, "sideways": aside}


def _of_filter(run: SimulatedRun) -> tuple[Floats, Floats, Series]:
    return _of_odometry(run, gyro=True)


def _of_localization(run: SimulatedRun) -> tuple[Floats, Floats, Series]:
    position, quaternion = run.poses.in_map()
    if not run.scenario.pose.reports_heading:
        quaternion = np.tile([0.0, 0.0, 0.0, 1.0], (quaternion.shape[0], 1))
    ned = rigid.multiply_quaternions(
        np.broadcast_to(_ENU_IN_NED, quaternion.shape),
        rigid.multiply_quaternions(quaternion, np.broadcast_to(_FRD_IN_FLU, quaternion.shape)),
    )
    series = _name(position, quaternion) | {f"ned_q{axis}": ned[:, i] for i, axis in enumerate("xyzw")}
    return run.poses.stamp_s, run.poses.log_s, series


def _of_tracking(run: SimulatedRun) -> tuple[Floats, Floats, Series]:
    return run.poses.stamp_s, run.poses.log_s, _name(run.poses.position, run.poses.quaternion)


def _of_relocalization(run: SimulatedRun) -> tuple[Floats, Floats, Series]:
    """Localization corrects at its own pace and dates its transform ahead, so that others can look it up."""
    time = np.arange(0.0, run.scenario.duration_s, _TF_PERIOD_S)
    which = np.clip(np.searchsorted(run.poses.log_s, time, side="right") - 1, 0, None)
    turn = rigid.quaternions_from_yaw(run.poses.correction_yaw[which])
    return time + _FUTURE_S, time + LATE_S, _name(run.poses.correction[which], turn)


def _of_satellites(run: SimulatedRun) -> tuple[Floats, Floats, Series]:
    """What a receiver says whose antenna is where the localization's sensor is."""
    poses, sensor, path = run.poses, run.scenario.pose, run.truth.path
    latitude, longitude, altitude = to_earth(poses.in_map()[0])
    arm = np.zeros(3)
    if sensor.child_frame != "base_link":
        arm = np.array([sensor.mount_x_m, sensor.mount_y_m, 0.0])
    before, after = (
        position + rigid.rotate(turn, np.broadcast_to(arm, position.shape))
        for position, turn in (
            rigid.interpolate_poses(poses.sampled_s + by, path.time_s, path.position, path.quaternion)
            for by in (-_DOPPLER_S, _DOPPLER_S)
        )
    )
    noise = open_stream(run.scenario.seed, "satellites").standard_normal((poses.stamp_s.size, 2))
    velocity = (after - before)[:, :2] / (2.0 * _DOPPLER_S) + _DOPPLER_NOISE_MPS * noise
    series = {"latitude": latitude, "longitude": longitude, "altitude": altitude}
    series |= {"east_speed": velocity[:, 0], "north_speed": velocity[:, 1], "fixed": np.zeros_like(latitude)}
    return poses.stamp_s, poses.log_s, series


def _of_correction(run: SimulatedRun) -> tuple[Floats, Floats, Series]:
    """The localization over the odometry at the odometry's stamps, as a matcher of every scan gives it."""
    stamp, _, drift = _of_odometry(run)
    position, quaternion = run.poses.in_map()
    at = np.clip(stamp, run.poses.stamp_s[0], run.poses.stamp_s[-1])
    order = np.argsort(run.poses.stamp_s, kind="stable")
    there, turned = rigid.interpolate_poses(at, run.poses.stamp_s[order], position[order], quaternion[order])
    offset = np.stack([drift[axis] for axis in "xyz"], axis=1)
    turn = rigid.multiply_quaternions(
        turned, rigid.invert_quaternions(np.stack([drift[f"q{axis}"] for axis in "xyzw"], axis=1))
    )
    series = _name(there - rigid.rotate(turn, offset), turn)
    return stamp, stamp + run.scenario.pose.latency_s, series


def _of_imu(run: SimulatedRun) -> tuple[Floats, Floats, Series]:
    if run.imu is None:
        raise _missing("an inertial unit")
    series = {f"rate_{axis}": run.imu.rates[:, i] for i, axis in enumerate("xyz")}
    series |= {f"force_{axis}": run.imu.accelerations[:, i] for i, axis in enumerate("xyz")}
    path = run.truth.path
    _, turn = rigid.interpolate_poses(run.imu.time_s, path.time_s, path.position, path.quaternion)
    start = np.broadcast_to(rigid.quaternions_from_yaw(np.array([_COMPASS_OFF_RAD])), turn.shape)
    turn = rigid.multiply_quaternions(start, turn)
    series |= {f"attitude_{axis}": turn[:, i] for i, axis in enumerate("xyzw")}
    return run.imu.time_s, run.imu.time_s + LATE_S, series


def _of_battery(run: SimulatedRun) -> tuple[Floats, Floats, Series]:
    """What the wheels draw: an idle load, and rolling resistance over the speed of the rims."""
    stamp, log, series = _of_wheels(run)
    rims = run.scenario.vehicle.wheel_radius_m * (np.abs(series["left"]) + np.abs(series["right"]))
    current = -(_IDLE_W + _RESISTANCE_N * 0.5 * rims) / _BATTERY_V
    return stamp, log, {"voltage": np.full_like(current, _BATTERY_V), "current": current}


def _once(run: SimulatedRun) -> tuple[Floats, Floats, Series]:
    del run
    return np.zeros(1), np.zeros(1), {}


def _name(position: Floats, quaternion: Floats) -> Series:
    named = {axis: position[:, i] for i, axis in enumerate("xyz")}
    return named | {f"q{axis}": quaternion[:, i] for i, axis in enumerate("xyzw")}


def _missing(what: str) -> SimulateError:
    return SimulateError(
        "encoders_needed",
        f"the platform publishes {what}, and the scenario has none",
        where="platform",
        hint="Choose a case with encoders and an inertial unit",
    )


_SOURCES: dict[Source, Callable[[SimulatedRun], tuple[Floats, Floats, Series]]] = {
    "command": _of_command,
    "wish": _of_wish,
    "wheels": _of_wheels,
    "odometry": _of_odometry,
    "filter": _of_filter,
    "localization": _of_localization,
    "tracking": _of_tracking,
    "relocalization": _of_relocalization,
    "satellites": _of_satellites,
    "correction": _of_correction,
    "imu": _of_imu,
    "battery": _of_battery,
    "once": _once,
}

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
    topic: str,
    *,
    stamped: bool = False,
    source: Source = "command",
    sideways: bool = False,
    frame: str | None = None,
) -> Published:
    """A body command; a ``wish`` is one that never reaches the controller."""
    prefix, name = ("twist.", "TwistStamped") if stamped else ("", "Twist")
    fields: Fields = {f"{prefix}linear.x": Q("speed"), f"{prefix}angular.z": Q("yaw_rate")}
    if sideways:
        fields[f"{prefix}linear.y"] = Q("sideways")
    if frame is not None:
        fields["header.frame_id"] = frame
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


def imu(topic: str, *, attitude: bool = False, is_unknown: bool = False) -> Published:
    """An inertial unit, perhaps with an attitude, or one that says that it has none."""
    fields: Fields = {"header.frame_id": "imu_link", "orientation.w": 1.0}
    if is_unknown:
        nothing = Q("rate_x", 0.0, 0.0)
        fields["orientation_covariance"] = (replace(nothing, offset=-1.0), *[nothing] * 8)
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


def list_topics(layout: Layout, scenario: Scenario) -> tuple[Published, ...]:
    """Topics of a log in a layout that says forms of messages only."""
    sensor = scenario.pose
    topics = [one for each in layout.commands for one in _list_drive(each, "command", layout, scenario)]
    if scenario.encoders is not None:
        topics += [one for each in layout.wheels for one in _list_drive(each, "wheels", layout, scenario)]
    topics += _list_pose(layout.pose, sensor.child_frame)
    if layout.pose.form == "tf" and scenario.imu is not None:
        topics.append(_mount("imu_link", np.zeros(3), 0.0))
    if sensor.child_frame != "base_link":
        position = np.array([sensor.mount_x_m, sensor.mount_y_m, 0.0])
        topics.append(_mount(sensor.child_frame, position, sensor.mount_yaw_rad))
    if layout.imu and scenario.imu is not None:
        topics.append(imu(layout.imu, is_unknown=True))
    return tuple(topics)


def _list_drive(one: DriveTopic, source: Source, layout: Layout, scenario: Scenario) -> list[Published]:
    topic, vehicle = one.topics[0], scenario.vehicle
    if one.form in {"twist", "twist_stamped"}:
        stamped = one.form == "twist_stamped"
        frame = "base_link" if stamped else None
        return [twist(topic, stamped=stamped, sideways=vehicle.moves_sideways, frame=frame)]
    if one.form == "ackermann":
        fields: Fields = {"drive.speed": Q("speed"), "drive.steering_angle": Q("steering")}
        return [Published(topic, "ackermann_msgs/msg/AckermannDriveStamped", source, fields)]
    if one.form != "joint_state":
        names = ("left", "right") if one.form == "float_sides" else ("speed", "steering")
        return [
            Published(each, "std_msgs/msg/Float64", source, {"data": Q(name)}, stamp="none")
            for each, name in zip(one.topics, names, strict=True)
        ]
    places = _list_places(vehicle)
    if source == "command":
        # A command lists the rear wheels first and an encoder the front ones: only names can tell them apart.
        asked = joints(topic, layout.joints, places[::-1])
        return [replace(asked, source=source, fields=_leave_out(asked.fields, "position"))]
    if vehicle.moves_sideways:
        made = mecanum_joints(topic, {corner: _name_joint(layout.joints, corner) for corner in places})
    else:
        made = joints(topic, layout.joints, places)
    report = "both" if scenario.encoders is None else scenario.encoders.report
    lacks = {"position": "velocity", "velocity": "" if vehicle.kind == "ackermann" else "position"}
    return [replace(made, fields=_leave_out(made.fields, lacks.get(report, "")))]


def _leave_out(fields: Mapping[str, Value], name: str) -> Fields:
    return {path: value for path, value in fields.items() if path != name}


def _list_places(vehicle: Vehicle) -> list[str]:
    """Places of the joints of a vehicle."""
    if vehicle.kind == "ackermann":
        return ["rear_left", "rear_right", "steer_front_left", "steer_front_right"]
    several = [f"axle_{number}_" for number in range(1, vehicle.wheels_per_side + 1)]
    axles = {1: [""], 2: ["front_", "rear_"]}.get(vehicle.wheels_per_side, several)
    return [f"{axle}{side}" for axle in axles for side in ("left", "right")]


def _list_pose(one: PoseTopic, child: str) -> list[Published]:
    if one.form == "tf":
        return [
            transform(one.topic, "tracking", "odom", "base_link"),
            transform(one.topic, "relocalization", "map", "odom"),
        ]
    if one.form == "pose_stamped":
        fields: Fields = {**pose_fields("pose.position", "pose.orientation"), "header.frame_id": "map"}
        return [Published(one.topic, "geometry_msgs/msg/PoseStamped", "localization", fields)]
    if one.form == "pose_covariance":
        return [pose_with_covariance(one.topic, 1)]
    return [odometry(one.topic, "localization", "map", child)]


def _mount(child: str, position: Floats, yaw: float) -> Published:
    """Where a sensor is on the vehicle."""
    made = transform("/tf_static", "once", "base_link", child)
    series = _name(position[None], rigid.quaternions_from_yaw(np.array([yaw])))
    known = {path: float(series[one.name][0]) for path, one in made.fields.items() if isinstance(one, Q)}
    return replace(made, fields={**made.fields, **known})


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
