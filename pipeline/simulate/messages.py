"""Topics of a run: their messages, each field filled from a quantity of the run, and those of a layout.

What says when and with which quantities a topic is sent is an entry of `SOURCES`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from pipeline.core import Floats, rigid
from pipeline.simulate.drivetrain import apply_ideal_model, invert_ideal_model
from pipeline.simulate.facts import (
    Field,
    Layout,
    Published,
    Q,
    Series,
    SimulateError,
    Value,
    Vehicle,
)
from pipeline.simulate.programs import make_wishes
from pipeline.simulate.run import SimulatedRun, integrate_odometry
from pipeline.simulate.scenario import Messages, Scenario

Sampled = tuple[Floats, Floats, dict[str, Floats]]
"""Stamps and times in the log [s], shape (n,), and quantities by name."""

Reading = TypeVar("Reading")

LATE_S = 0.002
"""From a reading to the recorder [s]."""
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
        taken = {"stamp": stamp[rows]} | {name: values[rows] for name, values in series.items()}
        fields = {path: _fill(value, taken) for path, value in one.fields.items()}
        header = None if one.stamp == "none" else stamp[rows]
        tables.append(Messages(one.topic, one.type_name, log[rows], header, fields))
    return tables


def _fill(value: Value, series: Series) -> Field:
    if isinstance(value, tuple):
        return np.stack([each(series) for each in value], axis=1)
    return value(series) if callable(value) else value


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
    wheels = need(run.wheels, "encoders")
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
    imu, path = need(run.imu, "an inertial unit"), run.truth.path
    series = {f"rate_{axis}": imu.rates[:, i] for i, axis in enumerate("xyz")}
    series |= {f"force_{axis}": imu.accelerations[:, i] for i, axis in enumerate("xyz")}
    _, turn = rigid.interpolate_poses(imu.time_s, path.time_s, path.position, path.quaternion)
    start = np.broadcast_to(rigid.quaternions_from_yaw(np.array([_COMPASS_OFF_RAD])), turn.shape)
    turn = rigid.multiply_quaternions(start, turn)
    series |= {f"attitude_{axis}": turn[:, i] for i, axis in enumerate("xyzw")}
    return imu.time_s, imu.time_s + LATE_S, series


def of_wishes(run: SimulatedRun, purpose: str) -> Sampled:
    """Commands that never reach the controller."""
    wished = make_wishes(run.scenario, purpose)
    series = {"speed": wished.speed_mps, "yaw_rate": wished.turn, "sideways": wished.sideways}
    return wished.time_s, wished.time_s, series


def of_odometry(run: SimulatedRun) -> Sampled:
    """Where the wheels alone say that the vehicle is."""
    stamp, log, series = read_wheels(run)
    path = integrate_odometry(run.scenario.vehicle, need(run.wheels, "encoders"), start=(0.0, 0.0, 0.0))
    return stamp, log, series | name_pose(path.position[:-1], path.quaternion[:-1])


def _of_state(run: SimulatedRun) -> Sampled:
    """Which part of the run counts, if a person drives first."""
    time = np.arange(0.0, run.scenario.duration_s, 0.1)
    return time, time, {"counts": (time >= (run.scenario.recording.hand_driven_s or 0.0)).astype(np.float64)}


def _once(run: SimulatedRun) -> Sampled:
    del run
    return np.zeros(1), np.zeros(1), {}


def name_pose(position: Floats, quaternion: Floats) -> dict[str, Floats]:
    """Quantities of poses."""
    named = {axis: position[:, i] for i, axis in enumerate("xyz")}
    return named | {f"q{axis}": quaternion[:, i] for i, axis in enumerate("xyzw")}


def need(reading: Reading | None, what: str) -> Reading:
    """What a sensor read.

    Raises:
        SimulateError: ``encoders_needed``, the scenario leaves it out.
    """
    if reading is None:
        raise SimulateError(
            "encoders_needed",
            f"the layout has {what}, and the scenario has none",
            where="layout",
            hint="Choose a case with encoders and an inertial unit",
        )
    return reading


SOURCES: dict[str, Callable[[SimulatedRun], Sampled]] = {
    "command": _of_command,
    "wheels": read_wheels,
    "localization": _of_localization,
    "tracking": _of_tracking,
    "relocalization": _of_relocalization,
    "imu": _of_imu,
    "decoy": partial(of_wishes, purpose="decoy"),
    "odometry": of_odometry,
    "state": _of_state,
    "once": _once,
}

_XYZ, _XYZW = "xyz", "xyzw"

Fields = dict[str, Value]


_TWIST = {"linear.x": "speed", "linear.y": "sideways", "angular.z": "yaw_rate"}


def pose_fields(position: str, orientation: str) -> dict[str, Q]:
    """Fields of a pose."""
    fields = {f"{position}.{axis}": Q(axis) for axis in _XYZ}
    return fields | {f"{orientation}.{axis}": Q(f"q{axis}") for axis in _XYZW}


_POSE_IN_POSE = pose_fields("pose.pose.position", "pose.pose.orientation")


def twist(
    topic: str, *, stamped: bool = False, source: str = "command", frame: str | None = None
) -> Published:
    """A body command; a ``wish`` is one that never reaches the controller."""
    prefix, name, stamp = ("twist.", "TwistStamped", "header") if stamped else ("", "Twist", "none")
    fields: Fields = {f"{prefix}{path}": Q(name) for path, name in _TWIST.items()}
    if frame is not None:
        fields["header.frame_id"] = frame
    return Published(topic, f"geometry_msgs/msg/{name}", source, fields, stamp=stamp)


def odometry(topic: str, source: str, parent: str, child: str) -> Published:
    """An odometry; one of the wheels says their speed as well."""
    fields: Fields = {**_POSE_IN_POSE, "header.frame_id": parent, "child_frame_id": child}
    if source != "localization":
        fields |= {f"twist.twist.{path}": Q(name) for path, name in _TWIST.items()}
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


def mount(child: str, position: Sequence[float] = (0.0, 0.0, 0.0), yaw: float = 0.0) -> Published:
    """Where a sensor is on the vehicle."""
    made = transform("/tf_static", "once", "base_link", child)
    series = name_pose(np.array([position]), rigid.quaternions_from_yaw(np.array([yaw])))
    known = {path: float(one(series)[0]) for path, one in made.fields.items() if isinstance(one, Q)}
    return replace(made, fields={**made.fields, **known})


def joints(
    topic: str,
    template: str = "{}_wheel",
    places: Sequence[str] = (),
    fields: str = "both",
    source: str = "wheels",
    *,
    each: bool = False,
) -> Published:
    """Joint states of the wheels.

    Args:
        topic: where.
        template: names of the joints, with ``{}`` for a place.
        places: ``front_left`` and the like, ``steer_front_left`` of a joint that steers.
        fields: ``position`` or ``velocity`` alone, or both.
        source: of their motion.
        each: whether wheels of a side differ, as on a vehicle that moves sideways.
    """
    named = {corner: corner if each else corner.rsplit("_", 1)[-1] for corner in places}
    steers = [corner.startswith("steer") for corner in places]
    turned = tuple(Q("steering" if s else f"{named[p]}_angle") for p, s in zip(places, steers, strict=True))
    rolling = tuple(Q("zero" if s else named[p]) for p, s in zip(places, steers, strict=True))
    values: Fields = {"name": [name_joint(template, corner) for corner in places]}
    values |= {"position": turned} if fields != "velocity" else {}
    values |= {"velocity": rolling} if fields != "position" else {}
    return Published(topic, "sensor_msgs/msg/JointState", source, values)


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


def pose_stamped(topic: str) -> Published:
    """A localization that says nothing of its errors."""
    fields: Fields = {**pose_fields("pose.position", "pose.orientation"), "header.frame_id": "map"}
    return Published(topic, "geometry_msgs/msg/PoseStamped", "localization", fields)


def pose_with_covariance(topic: str, every: int = 1) -> Published:
    """A localization, perhaps a slow one."""
    fields: Fields = {**_POSE_IN_POSE, "header.frame_id": "map"}
    kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
    return Published(topic, kind, "localization", fields, every=every)


def number(topic: str, source: str, quantity: str) -> Published:
    """One quantity alone."""
    return Published(topic, "std_msgs/msg/Float64", source, {"data": Q(quantity)}, stamp="none")


FORMS: dict[str, Callable[..., Published]] = {
    made.__name__: made
    for made in (
        *(twist, odometry, transform, mount, joints),
        *(imu, pose_stamped, pose_with_covariance, number),
    )
}
"""What a row of a layout may be, by the key with its topic."""


def read_topic(row: Mapping[str, Any]) -> Published:
    """The topic of a row: one of `FORMS` with what it takes, or type, source, constants and quantities."""
    given = dict(row)
    for name in FORMS.keys() & row:
        return FORMS[name](given.pop(name), **given)
    fields: Fields = given.pop("constants", {})
    fields = fields | {path: _read_value(one) for path, one in given.pop("quantities", {}).items()}
    return Published(given.pop("topic"), given.pop("type"), given.pop("source"), fields, **given)


def _read_value(given: Any) -> Q | tuple[Q, ...]:  # noqa: ANN401 - as a file has it
    """A quantity by its name, perhaps with a gain; or several."""
    if isinstance(given, list):
        return tuple(Q(one) if isinstance(one, str) else Q(**one) for one in given)
    return Q(given) if isinstance(given, str) else Q(**given)


def list_topics(layout: Layout, scenario: Scenario) -> tuple[Published, ...]:
    """Topics of a log in a layout, without those whose sensor the scenario leaves out."""
    sensor, recording = scenario.pose, scenario.recording
    missing = set() if scenario.encoders is not None else {"wheels", "odometry"}
    missing |= set() if scenario.imu is not None else {"imu"}
    topics: list[Published] = []
    for row in layout.topics:
        if isinstance(row, Published):
            topics.append(row)
            continue
        if "mount" not in row or scenario.imu is not None:
            topics.append(read_topic(_fit_row(row, scenario)))
        if "odometry" in row and sensor.child_frame != "base_link":
            position = (sensor.mount_x_m, sensor.mount_y_m, 0.0)
            topics.append(mount(sensor.child_frame, position, sensor.mount_yaw_rad))
    if recording.hand_driven_s is not None:
        fields: Fields = {"data": lambda series: np.where(series["counts"], "calib", "idle").tolist()}
        topics.append(Published("/drive/calib_state", "std_msgs/msg/String", "state", fields, stamp="none"))
    if recording.decoys in {"commands", "both"}:
        topics.append(twist("/navigation/cmd_vel", source="decoy"))
    if recording.decoys in {"odometry", "both"}:
        topics.append(odometry("/platform/odom", "odometry", "odom", "base_link"))
    return tuple(one for one in topics if one.source not in missing)


def _fit_row(row: Mapping[str, Any], scenario: Scenario) -> dict[str, Any]:
    """A row with what a vehicle and its sensors decide: joints, and the frame of the pose."""
    vehicle = scenario.vehicle
    if "odometry" in row:
        return {**row, "child": scenario.pose.child_frame}
    if "joints" not in row:
        return dict(row)
    places = _list_places(vehicle)
    if row.get("source") == "command":
        # A command lists the rear wheels first and an encoder the front ones: only names can tell them apart.
        return {**row, "places": places[::-1], "fields": "velocity"}
    report = "both" if scenario.encoders is None else scenario.encoders.report
    fields = "both" if vehicle.kind == "ackermann" and report == "velocity" else report
    return {**row, "places": places, "fields": fields, "each": vehicle.moves_sideways}


def _list_places(vehicle: Vehicle) -> list[str]:
    """Places of the joints of a vehicle."""
    if vehicle.kind == "ackermann":
        return ["rear_left", "rear_right", "steer_front_left", "steer_front_right"]
    several = [f"axle_{number}_" for number in range(1, vehicle.wheels_per_side + 1)]
    axles = {1: [""], 2: ["front_", "rear_"]}.get(vehicle.wheels_per_side, several)
    return [f"{axle}{side}" for axle in axles for side in ("left", "right")]
