"""Topics of a run: their messages, each field filled from a quantity of the run, and those of a layout.

What says when and with which quantities a topic is sent is an entry of `SOURCES`.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

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
    Value,
    Vehicle,
)
from pipeline.simulate.messages import LATE_S, Field, Messages, SimulatedRun
from pipeline.simulate.scenario import Scenario

Series = dict[str, Floats]
Sampled = tuple[Floats, Floats, Series]
"""Stamps and times in the log [s], shape (n,), and quantities by name."""

_TF_PERIOD_S, _FUTURE_S = 0.05, 0.1
_TURN = 2.0 * np.pi
_COMPASS_OFF_RAD = 0.7
"""An attitude is seldom against the true north."""
_ENU_IN_NED = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])
_FRD_IN_FLU = np.array([1.0, 0.0, 0.0, 0.0])


def publish(run: SimulatedRun, topics: tuple[Published, ...]) -> list[Messages]:
    """Messages of every topic.

    Raises:
        SimulateError: ``encoders_needed``, a topic needs wheels or a gyro that the scenario leaves out.
    """
    known: dict[str, Sampled] = {}
    tables = []
    for one in topics:
        if one.source not in known:
            known[one.source] = SOURCES[one.source](run)
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


def _of_command(run: SimulatedRun) -> Sampled:
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


def read_wheels(run: SimulatedRun) -> Sampled:
    """When and what the encoders say."""
    wheels = run.wheels
    if wheels is None:
        raise refuse_missing("encoders")
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


def _of_localization(run: SimulatedRun) -> Sampled:
    position, quaternion = run.poses.in_map()
    if not run.scenario.pose.reports_heading:
        quaternion = np.tile([0.0, 0.0, 0.0, 1.0], (quaternion.shape[0], 1))
    ned = rigid.multiply_quaternions(
        np.broadcast_to(_ENU_IN_NED, quaternion.shape),
        rigid.multiply_quaternions(quaternion, np.broadcast_to(_FRD_IN_FLU, quaternion.shape)),
    )
    series = name_pose(position, quaternion) | {f"ned_q{axis}": ned[:, i] for i, axis in enumerate("xyzw")}
    return run.poses.stamp_s, run.poses.log_s, series


def _of_tracking(run: SimulatedRun) -> Sampled:
    return run.poses.stamp_s, run.poses.log_s, name_pose(run.poses.position, run.poses.quaternion)


def _of_relocalization(run: SimulatedRun) -> Sampled:
    """Localization corrects at its own pace and dates its transform ahead, so that others can look it up."""
    time = np.arange(0.0, run.scenario.duration_s, _TF_PERIOD_S)
    which = np.clip(np.searchsorted(run.poses.log_s, time, side="right") - 1, 0, None)
    turn = rigid.quaternions_from_yaw(run.poses.correction_yaw[which])
    return time + _FUTURE_S, time + LATE_S, name_pose(run.poses.correction[which], turn)


def _of_imu(run: SimulatedRun) -> Sampled:
    if run.imu is None:
        raise refuse_missing("an inertial unit")
    series = {f"rate_{axis}": run.imu.rates[:, i] for i, axis in enumerate("xyz")}
    series |= {f"force_{axis}": run.imu.accelerations[:, i] for i, axis in enumerate("xyz")}
    path = run.truth.path
    _, turn = rigid.interpolate_poses(run.imu.time_s, path.time_s, path.position, path.quaternion)
    start = np.broadcast_to(rigid.quaternions_from_yaw(np.array([_COMPASS_OFF_RAD])), turn.shape)
    turn = rigid.multiply_quaternions(start, turn)
    series |= {f"attitude_{axis}": turn[:, i] for i, axis in enumerate("xyzw")}
    return run.imu.time_s, run.imu.time_s + LATE_S, series


def _once(run: SimulatedRun) -> Sampled:
    del run
    return np.zeros(1), np.zeros(1), {}


def name_pose(position: Floats, quaternion: Floats) -> Series:
    """Quantities of poses."""
    named = {axis: position[:, i] for i, axis in enumerate("xyz")}
    return named | {f"q{axis}": quaternion[:, i] for i, axis in enumerate("xyzw")}


def refuse_missing(what: str) -> SimulateError:
    """The error for a topic whose sensor the scenario leaves out."""
    return SimulateError(
        "encoders_needed",
        f"the layout has {what}, and the scenario has none",
        where="layout",
        hint="Choose a case with encoders and an inertial unit",
    )


SOURCES: dict[str, Callable[[SimulatedRun], Sampled]] = {
    "command": _of_command,
    "wheels": read_wheels,
    "localization": _of_localization,
    "tracking": _of_tracking,
    "relocalization": _of_relocalization,
    "imu": _of_imu,
    "once": _once,
}

_XYZ, _XYZW = "xyz", "xyzw"

Fields = dict[str, Value]


def pose_fields(position: str, orientation: str) -> dict[str, Q]:
    """Fields of a pose."""
    fields = {f"{position}.{axis}": Q(axis) for axis in _XYZ}
    return fields | {f"{orientation}.{axis}": Q(f"q{axis}") for axis in _XYZW}


def twist(
    topic: str,
    *,
    stamped: bool = False,
    source: str = "command",
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


def odometry(topic: str, source: str, parent: str, child: str, *, sideways: bool = False) -> Published:
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


def transform(topic: str, source: str, parent: str, child: str) -> Published:
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
    names = [name_joint(template, corner) for corner in places]
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


def name_joint(template: str, corner: str) -> str:
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


def pose_with_covariance(topic: str, every: int) -> Published:
    """A slow localization."""
    fields: Fields = {
        **pose_fields("pose.pose.position", "pose.pose.orientation"),
        "header.frame_id": "map",
    }
    name = "geometry_msgs/msg/PoseWithCovarianceStamped"
    return Published(topic, name, "localization", fields, every=every)


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


def _list_drive(one: DriveTopic, source: str, layout: Layout, scenario: Scenario) -> list[Published]:
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
        made = mecanum_joints(topic, {corner: name_joint(layout.joints, corner) for corner in places})
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
    series = name_pose(position[None], rigid.quaternions_from_yaw(np.array([yaw])))
    known = {path: float(series[one.name][0]) for path, one in made.fields.items() if isinstance(one, Q)}
    return replace(made, fields={**made.fields, **known})
