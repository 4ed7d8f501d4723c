"""The messages of a run: for each topic its type, times and fields."""

from dataclasses import dataclass, replace

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.core.rigid import quaternions_from_yaw
from pipeline.simulate.drivetrain import CORNERS, apply_ideal_model, invert_ideal_model
from pipeline.simulate.layouts import CommandTopic, Layout, PoseTopic, WheelTopic
from pipeline.simulate.programs import Commands, make_wishes
from pipeline.simulate.run import SimulatedRun, integrate_odometry
from pipeline.simulate.streams import open_stream, spread_times

Field = Floats | float | str | list[str]

_LATE_S = 0.002
_FUTURE_S = 0.1
_TF_PERIOD_S = 0.05


@dataclass(frozen=True)
class Sheet:
    """Messages of one topic, in true seconds.

    Attributes:
        topic, type_name: where and what.
        log_s: when the recorder got them, shape (n,).
        header_s: what their headers say, shape (n,), or None for a type without header.
        fields: values by field path; an array has one row a message.
        stamp: where the stamp stands: ``header``, or a field, microseconds if it begins with ``timestamp``.
    """

    topic: str
    type_name: str
    log_s: Floats
    header_s: Floats | None
    fields: dict[str, Field]
    stamp: str = "header"


def command_sheets(run: SimulatedRun, layout: Layout) -> list[Sheet]:
    """Messages of everything that was asked."""
    return [sheet for topic in layout.commands for sheet in _write_command(run, layout, topic, run.commands)]


def _write_command(run: SimulatedRun, layout: Layout, topic: CommandTopic, commands: Commands) -> list[Sheet]:
    vehicle = run.scenario.vehicle
    time = commands.time_s
    log = time + run.scenario.recording.command_latency_s
    if topic.form in {"twist", "twist_stamped"}:
        stamped = topic.form == "twist_stamped"
        prefix = "twist." if stamped else ""
        rate = commands.yaw_rate(vehicle)
        fields: dict[str, Field] = {f"{prefix}linear.x": commands.speed_mps, f"{prefix}angular.z": rate}
        if commands.sideways_mps is not None:
            fields[f"{prefix}linear.y"] = commands.sideways_mps
        if stamped:
            fields["header.frame_id"] = "base_link"
        name = "geometry_msgs/msg/TwistStamped" if stamped else "geometry_msgs/msg/Twist"
        return [Sheet(topic.topics[0], name, log, time if stamped else None, fields)]
    if topic.form == "ackermann":
        return [_write_ackermann(topic.topics[0], log, time, commands.speed_mps, commands.turn)]
    if topic.form == "float_speed_steering":
        return _write_floats(topic.topics, log, (commands.speed_mps, commands.turn))
    left, right = (
        side * run.scenario.recording.command_scale
        for side in invert_ideal_model(vehicle, commands.speed_mps, commands.turn)
    )
    if topic.form == "float_sides":
        return _write_floats(topic.topics, log, (left, right))
    names, sides = _name_joints(layout, vehicle.wheels_per_side)
    # A command lists the rear wheels first and an encoder the front ones: only names can tell them apart.
    names, sides = names[::-1], sides[::-1]
    speeds = np.stack([left if side == "left" else right for side in sides], axis=1)
    return [
        Sheet(topic.topics[0], "sensor_msgs/msg/JointState", log, time, {"name": names, "velocity": speeds})
    ]


def _write_ackermann(topic: str, log: Floats, time: Floats, speed: Floats, steering: Floats) -> Sheet:
    fields: dict[str, Field] = {"drive.speed": speed, "drive.steering_angle": steering}
    return Sheet(topic, "ackermann_msgs/msg/AckermannDriveStamped", log, time, fields)


def _write_floats(topics: tuple[str, ...], log: Floats, values: tuple[Floats, ...]) -> list[Sheet]:
    return [
        Sheet(topic, "std_msgs/msg/Float64", log, None, {"data": column})
        for topic, column in zip(topics, values, strict=True)
    ]


def _name_joints(layout: Layout, wheels_per_side: int) -> tuple[list[str], list[str]]:
    axles = {1: [""], 2: ["front_", "rear_"]}.get(
        wheels_per_side, [f"axle_{number}_" for number in range(1, wheels_per_side + 1)]
    )
    sides = [side for _ in axles for side in ("left", "right")]
    names = [layout.joints.format(f"{axle}{side}") for axle in axles for side in ("left", "right")]
    return names, sides


def wheel_sheets(run: SimulatedRun, layout: Layout) -> list[Sheet]:
    """Messages of the encoders, if there are any."""
    return [sheet for topic in layout.wheels for sheet in _write_wheels(run, layout, topic)]


def _write_wheels(run: SimulatedRun, layout: Layout, topic: WheelTopic) -> list[Sheet]:
    wheels, encoders, vehicle = run.wheels, run.scenario.encoders, run.scenario.vehicle
    if wheels is None or encoders is None:
        return []
    time = wheels.time_s
    log = time + _LATE_S
    speed = 0.5 * vehicle.wheel_radius_m * (wheels.left + wheels.right)
    if topic.form == "float_sides":
        return _write_floats(topic.topics, log, (wheels.left, wheels.right))
    if topic.form == "float_speed_steering":
        return _write_floats(topic.topics, log, (speed, wheels.steering))
    if topic.form == "ackermann":
        return [_write_ackermann(topic.topics[0], log, time, speed, wheels.steering)]
    if vehicle.kind == "ackermann":
        names = ["rear_left_wheel", "rear_right_wheel", "front_left_steering", "front_right_steering"]
        turned = [wheels.left_angle, wheels.right_angle, wheels.steering, wheels.steering]
        turning = [wheels.left, wheels.right, np.zeros_like(time), np.zeros_like(time)]
    else:
        names, sides = _name_joints(layout, vehicle.wheels_per_side)
        turned = [wheels.left_angle if side == "left" else wheels.right_angle for side in sides]
        turning = [wheels.left if side == "left" else wheels.right for side in sides]
        if wheels.corners is not None and wheels.corner_angles is not None:
            # The same order as the names.
            turned, turning = (
                [by[place] for place in CORNERS] for by in (wheels.corner_angles, wheels.corners)
            )
    fields: dict[str, Field] = {"name": names}
    if encoders.report != "velocity" or vehicle.kind == "ackermann":
        fields["position"] = np.stack(turned, axis=1)
    if encoders.report != "position":
        fields["velocity"] = np.stack(turning, axis=1)
    return [Sheet(topic.topics[0], "sensor_msgs/msg/JointState", log, time, fields)]


def pose_sheets(run: SimulatedRun, topic: PoseTopic) -> list[Sheet]:
    """Messages of the localization."""
    poses = run.poses
    if topic.form == "tf":
        return _write_tf(run, topic.topic)
    position, quaternion = poses.in_map()
    name, prefix = {
        "odometry": ("nav_msgs/msg/Odometry", "pose.pose."),
        "pose_stamped": ("geometry_msgs/msg/PoseStamped", "pose."),
        "pose_covariance": ("geometry_msgs/msg/PoseWithCovarianceStamped", "pose.pose."),
    }[topic.form]
    fields = _name_pose(prefix, "position", "orientation", position, quaternion)
    fields["header.frame_id"] = "map"
    if topic.form == "odometry":
        fields["child_frame_id"] = run.scenario.pose.child_frame
    return [Sheet(topic.topic, name, poses.log_s, poses.stamp_s, fields)]


def static_sheets(run: SimulatedRun, layout: Layout) -> list[Sheet]:
    """Where sensors are mounted, as far as readers need it."""
    sensor = run.scenario.pose
    mounted: list[tuple[str, tuple[float, float], float]] = []
    if layout.pose.form == "tf" and run.imu is not None:
        mounted.append(("imu_link", (0.0, 0.0), 0.0))
    if sensor.child_frame != "base_link":
        mounted.append((sensor.child_frame, (sensor.mount_x_m, sensor.mount_y_m), sensor.mount_yaw_rad))
    return [
        Sheet(
            "/tf_static",
            "tf2_msgs/msg/TFMessage",
            np.zeros(1),
            np.zeros(1),
            _name_transform(
                "base_link", name, np.array([[*place, 0.0]]), quaternions_from_yaw(np.array([yaw]))
            ),
        )
        for name, place, yaw in mounted
    ]


def _name_pose(prefix: str, place: str, turn: str, position: Floats, quaternion: Floats) -> dict[str, Field]:
    fields: dict[str, Field] = {f"{prefix}{place}.{axis}": position[:, i] for i, axis in enumerate("xyz")}
    fields |= {f"{prefix}{turn}.{axis}": quaternion[:, i] for i, axis in enumerate("xyzw")}
    return fields


def _write_tf(run: SimulatedRun, topic: str) -> list[Sheet]:
    poses = run.poses
    odometry = _name_transform("odom", "base_link", poses.position, poses.quaternion)
    # Localization corrects at its own pace and dates its transform ahead, so that others can look it up.
    time = np.arange(0.0, run.scenario.duration_s, _TF_PERIOD_S)
    which = np.clip(np.searchsorted(poses.log_s, time, side="right") - 1, 0, None)
    turn = quaternions_from_yaw(poses.correction_yaw[which])
    corrections = _name_transform("map", "odom", poses.correction[which], turn)
    name = "tf2_msgs/msg/TFMessage"
    return [
        Sheet(topic, name, poses.log_s, poses.stamp_s, odometry),
        Sheet(topic, name, time + _LATE_S, time + _FUTURE_S, corrections),
    ]


def _name_transform(parent: str, child: str, position: Floats, quaternion: Floats) -> dict[str, Field]:
    fields = _name_pose("transforms[].transform.", "translation", "rotation", position, quaternion)
    fields["transforms[].header.frame_id"] = parent
    fields["transforms[].child_frame_id"] = child
    return fields


def imu_sheets(run: SimulatedRun, layout: Layout) -> list[Sheet]:
    """Messages of the inertial unit, if there is one; it estimates no orientation and says so."""
    if run.imu is None or not layout.imu:
        return []
    imu = run.imu
    unknown = np.zeros((imu.time_s.size, 9))
    unknown[:, 0] = -1.0
    fields: dict[str, Field] = {"header.frame_id": "imu_link", "orientation_covariance": unknown}
    fields["orientation.w"] = 1.0
    for i, axis in enumerate("xyz"):
        fields[f"angular_velocity.{axis}"] = imu.rates[:, i]
        fields[f"linear_acceleration.{axis}"] = imu.accelerations[:, i]
    return [Sheet(layout.imu, "sensor_msgs/msg/Imu", imu.time_s + _LATE_S, imu.time_s, fields)]


def state_sheets(run: SimulatedRun) -> list[Sheet]:
    """Messages that say which part of the run counts, if a person drives first."""
    by_hand = run.scenario.recording.hand_driven_s
    if by_hand is None:
        return []
    time = np.arange(0.0, run.scenario.duration_s, 0.1)
    topic, name = "/drive/calib_state", "std_msgs/msg/String"
    return [
        Sheet(topic, name, time[time < by_hand], None, {"data": "idle"}),
        Sheet(topic, name, time[time >= by_hand], None, {"data": "calib"}),
    ]


def decoy_sheets(run: SimulatedRun) -> list[Sheet]:
    """Messages that a hasty reader takes for the pose or the command."""
    scenario = run.scenario
    sheets: list[Sheet] = []
    if scenario.recording.decoys in {"commands", "both"}:
        wished = make_wishes(scenario, "decoy")
        fields: dict[str, Field] = {"linear.x": wished.speed_mps, "angular.z": wished.turn}
        sheets.append(Sheet("/navigation/cmd_vel", "geometry_msgs/msg/Twist", wished.time_s, None, fields))
    if scenario.recording.decoys in {"odometry", "both"} and run.wheels is not None:
        wheels = run.wheels
        path = integrate_odometry(scenario.vehicle, wheels, start=(0.0, 0.0, 0.0))
        speed, rate = apply_ideal_model(scenario.vehicle, wheels.left, wheels.right, wheels.steering)
        fields = _name_pose("pose.pose.", "position", "orientation", path.position[:-1], path.quaternion[:-1])
        fields |= {"header.frame_id": "odom", "child_frame_id": "base_link"}
        fields |= {"twist.twist.linear.x": speed, "twist.twist.angular.z": rate}
        time = wheels.time_s
        sheets.append(Sheet("/platform/odom", "nav_msgs/msg/Odometry", time + _LATE_S, time, fields))
    return sheets


def cut_gaps(run: SimulatedRun, sheets: list[Sheet]) -> list[Sheet]:
    """Take out what the recorder missed, on every topic alike."""
    recording = run.scenario.recording
    starts = spread_times(
        recording.gaps,
        duration_s=run.scenario.duration_s,
        generator=open_stream(run.scenario.seed, "gaps"),
    )
    for start in starts.tolist():
        sheets = [_cut_out(sheet, start, start + recording.gap_s) for sheet in sheets]
    return sheets


def _cut_out(sheet: Sheet, start_s: float, end_s: float) -> Sheet:
    kept = (sheet.log_s < start_s) | (sheet.log_s >= end_s)
    return replace(
        sheet,
        log_s=sheet.log_s[kept],
        header_s=None if sheet.header_s is None else sheet.header_s[kept],
        fields={
            path: value[kept] if isinstance(value, np.ndarray) else value
            for path, value in sheet.fields.items()
        },
    )
