"""From a scenario to a simulated run, and the messages of it: topic, type, times and fields."""

from dataclasses import dataclass, replace

import numpy as np

from pipeline.core import Floats, euler_from_quaternions, quaternions_from_yaw
from pipeline.simulate.drivetrain import CORNERS, apply_ideal_model, drive_wheels, invert_ideal_model
from pipeline.simulate.facts import (
    CommandTopic,
    Effects,
    Layout,
    PoseTopic,
    SimulateError,
    Vehicle,
    WheelTopic,
    find_layout,
    open_stream,
    resolve_effects,
    spread_times,
)
from pipeline.simulate.incidents import (
    brake_wheels,
    disturb_body,
    freeze_poses,
    record_commands,
    send_commands,
)
from pipeline.simulate.path import BodyMotion, Path, integrate_path, move_body
from pipeline.simulate.programs import make_commands, make_wishes, walk_in_plane
from pipeline.simulate.scenario import Scenario
from pipeline.simulate.sensors import ImuReadings, Poses, WheelReadings, read_encoders, read_imu, report_poses
from pipeline.simulate.signals import Commands, Drive, integrate_cells

_SETTLED_M = 1e-6
"""Two passes over hills that are this close to each other are one."""
_MOST_PASSES = 40


@dataclass(frozen=True)
class Truth:
    """What really happened; never written to a log.

    Attributes:
        commands: what the drive was really told, hand driving included.
        drive: wheels and steering on the integration grid.
        motion: velocities before slope and place acted.
        path: true pose and body velocity.
        effects: the effects that acted.
    """

    commands: Commands
    drive: Drive
    motion: BodyMotion
    path: Path
    effects: Effects


@dataclass(frozen=True)
class SimulatedRun:
    """One run: its scenario, the truth, and what is recorded.

    Attributes:
        scenario: what was asked for.
        truth: what happened.
        commands: body commands as recorded.
        poses: what the localization reported.
        wheels: what the encoders reported, or None.
        imu: what the inertial unit reported, or None.
    """

    scenario: Scenario
    truth: Truth
    commands: Commands
    poses: Poses
    wheels: WheelReadings | None
    imu: ImuReadings | None


def simulate_run(scenario: Scenario) -> SimulatedRun:
    """Simulate a scenario; the same scenario gives the same arrays, bit for bit.

    Raises:
        SimulateError: an unknown effect, parameter or program, an impossible value, or a combination that
            makes no sense.
    """
    effects = resolve_effects(scenario.effects, scenario.vehicle.kind, scenario.written)
    truth = _drive(scenario, effects, None)
    if effects.is_active("grade_load"):
        truth = _carry_grade(scenario, effects, truth)
    return record_truth(scenario, truth)


def _carry_grade(scenario: Scenario, effects: Effects, truth: Truth) -> Truth:
    """The run whose wheels bear the slope that they drive over, by Picard's iteration.

    Raises:
        SimulateError: ``bad_value``, a load so large that the run does not settle.
    """
    middles = (np.arange(truth.motion.v0.size) + 0.5) * scenario.step_s
    for _ in range(_MOST_PASSES):
        pitch = np.interp(middles, truth.path.time_s, euler_from_quaternions(truth.path.quaternion)[1])
        before, truth = truth, _drive(scenario, effects, pitch)
        if float(np.max(np.abs(truth.path.position - before.path.position))) < _SETTLED_M:
            return truth
    what = "the slope and the wheels' speed on it do not settle"
    raise SimulateError("bad_value", what, where="grade_load", hint="Give a smaller load or a shorter run")


def _drive(scenario: Scenario, effects: Effects, pitch: Floats | None) -> Truth:
    """What happens where the body has a pitch [rad] in each cell, as far as the wheels feel it."""
    vehicle, seed = scenario.vehicle, scenario.seed
    commands, drive = ask_wheels(scenario, effects, scenario.step_s, pitch)
    if scenario.machinery is not None:
        drive = scenario.machinery(drive)
    drive = brake_wheels(drive, scenario.incidents)
    motion = move_body(
        drive,
        vehicle,
        effects,
        disturbance=scenario.disturbance,
        ground_input=scenario.ground_input,
        generator=open_stream(seed, "disturbance"),
    )
    motion = disturb_body(motion, scenario.incidents, vehicle, drive.step_s)
    path = integrate_path(
        motion,
        drive,
        effects,
        ground=scenario.ground,
        extra=scenario.extra,
        start=scenario.start_pose,
        generator=open_stream(seed, "hills"),
    )
    return Truth(commands, drive, motion, path, effects)


def ask_wheels(
    scenario: Scenario, effects: Effects, step_s: float, pitch: Floats | None = None
) -> tuple[Commands, Drive]:
    """The commands of a scenario, and what its drive makes of them in steps of so many seconds."""
    vehicle, duration, hold_s = scenario.vehicle, scenario.duration_s, scenario.program.hold_s
    commands = scenario.played or make_commands(
        scenario.program, vehicle, duration_s=duration, generator=open_stream(scenario.seed, "program")
    )
    commands = send_commands(commands, scenario.incidents)
    return commands, drive_wheels(
        commands,
        vehicle,
        effects,
        hold_s=hold_s,
        step_s=step_s,
        cell_count=round(duration / step_s),
        pitch=pitch,
    )


def record_truth(scenario: Scenario, truth: Truth) -> SimulatedRun:
    """Let the scenario's sensors look at what happened, whoever computed it.

    Raises:
        SimulateError: ``encoders_needed`` when the pose is wheel odometry and there are no encoders;
            ``bad_value`` for another child frame in messages that cannot name it; a layout that is unknown
            or does not fit.
    """
    _check_frame(scenario)
    duration, seed = scenario.duration_s, scenario.seed
    wheels = imu = None
    if scenario.encoders is not None:
        wheels = read_encoders(scenario.encoders, truth.drive, duration_s=duration, seed=seed)
    if scenario.imu is not None:
        imu = read_imu(scenario.imu, truth.path, duration_s=duration, seed=seed)
    seen = truth.path
    if scenario.pose.source == "wheels":
        if wheels is None:
            what = "a pose from wheels needs encoders"
            hint = "Add encoders to the scenario or let the pose come from localization"
            raise SimulateError("encoders_needed", what, where="pose.source", hint=hint)
        seen = integrate_odometry(scenario.vehicle, wheels, start=scenario.start_pose)
    poses = report_poses(scenario.pose, seen, truth.effects, duration_s=duration, seed=seed)
    poses = freeze_poses(poses, scenario.incidents)
    return SimulatedRun(scenario, truth, _as_recorded(scenario, truth.commands), poses, wheels, imu)


def _check_frame(scenario: Scenario) -> None:
    layout = find_layout(scenario.recording.layout, scenario.vehicle)
    if scenario.pose.child_frame != "base_link" and layout.pose.form != "odometry":
        what = f"a pose as {layout.pose.form} cannot be of {scenario.pose.child_frame}"
        hint = "Choose a layout whose pose is an odometry message"
        raise SimulateError("bad_value", what, where="pose.child_frame", hint=hint)


def integrate_odometry(vehicle: Vehicle, wheels: WheelReadings, *, start: tuple[float, float, float]) -> Path:
    """Wheel odometry: the ideal model of the encoders, each reading held until the next."""
    time = wheels.time_s
    step = float(np.median(np.diff(time)))
    speed, rate = apply_ideal_model(vehicle, wheels.left, wheels.right, wheels.steering)
    aside = wheels.sideways_mps(vehicle)
    heading = start[2] + integrate_cells(rate, step_s=step)
    position = np.array([*start[:2], 0.0]) + walk_in_plane(speed, aside, heading, step_s=step)
    edges = np.append(time, time[-1] + step)
    velocity = np.stack((speed, aside, rate), axis=1)
    return Path(edges, position, quaternions_from_yaw(heading), velocity)


def _as_recorded(scenario: Scenario, commands: Commands) -> Commands:
    commands = record_commands(commands, scenario.incidents)
    by_hand = scenario.recording.hand_driven_s
    if by_hand is None:
        return commands
    # The command topic keeps repeating zeros while a person drives by radio, past the computer.
    live = commands.time_s >= by_hand
    sideways = None if commands.sideways_mps is None else commands.sideways_mps * live
    return Commands(commands.time_s, commands.speed_mps * live, commands.turn * live, sideways)


Field = Floats | float | str | list[str]

_LATE_S = 0.002
_FUTURE_S = 0.1
_TF_PERIOD_S = 0.05


@dataclass(frozen=True)
class Messages:
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


def command_tables(run: SimulatedRun, layout: Layout) -> list[Messages]:
    """Messages of everything that was asked."""
    return [table for topic in layout.commands for table in _write_command(run, layout, topic, run.commands)]


def _write_command(
    run: SimulatedRun, layout: Layout, topic: CommandTopic, commands: Commands
) -> list[Messages]:
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
        return [Messages(topic.topics[0], name, log, time if stamped else None, fields)]
    if topic.form == "ackermann":
        return [_write_ackermann(topic.topics[0], log, time, commands.speed_mps, commands.turn)]
    if topic.form == "float_speed_steering":
        return _write_floats(topic.topics, log, (commands.speed_mps, commands.turn))
    recording = run.scenario.recording
    turned = recording.command_scale if recording.command_turn_scale is None else recording.command_turn_scale
    left, right = invert_ideal_model(
        vehicle, recording.command_scale * commands.speed_mps, turned * commands.turn
    )
    if topic.form == "float_sides":
        return _write_floats(topic.topics, log, (left, right))
    names, sides = _name_joints(layout, vehicle.wheels_per_side)
    # A command lists the rear wheels first and an encoder the front ones: only names can tell them apart.
    names, sides = names[::-1], sides[::-1]
    speeds = np.stack([left if side == "left" else right for side in sides], axis=1)
    return [
        Messages(
            topic.topics[0], "sensor_msgs/msg/JointState", log, time, {"name": names, "velocity": speeds}
        )
    ]


def _write_ackermann(topic: str, log: Floats, time: Floats, speed: Floats, steering: Floats) -> Messages:
    fields: dict[str, Field] = {"drive.speed": speed, "drive.steering_angle": steering}
    return Messages(topic, "ackermann_msgs/msg/AckermannDriveStamped", log, time, fields)


def _write_floats(topics: tuple[str, ...], log: Floats, values: tuple[Floats, ...]) -> list[Messages]:
    return [
        Messages(topic, "std_msgs/msg/Float64", log, None, {"data": column})
        for topic, column in zip(topics, values, strict=True)
    ]


def _name_joints(layout: Layout, wheels_per_side: int) -> tuple[list[str], list[str]]:
    axles = {1: [""], 2: ["front_", "rear_"]}.get(
        wheels_per_side, [f"axle_{number}_" for number in range(1, wheels_per_side + 1)]
    )
    sides = [side for _ in axles for side in ("left", "right")]
    names = [layout.joints.format(f"{axle}{side}") for axle in axles for side in ("left", "right")]
    return names, sides


def wheel_tables(run: SimulatedRun, layout: Layout) -> list[Messages]:
    """Messages of the encoders, if there are any."""
    return [table for topic in layout.wheels for table in _write_wheels(run, layout, topic)]


def _write_wheels(run: SimulatedRun, layout: Layout, topic: WheelTopic) -> list[Messages]:
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
                [by[corner] for corner in CORNERS] for by in (wheels.corner_angles, wheels.corners)
            )
    fields: dict[str, Field] = {"name": names}
    if encoders.report != "velocity" or vehicle.kind == "ackermann":
        fields["position"] = np.stack(turned, axis=1)
    if encoders.report != "position":
        fields["velocity"] = np.stack(turning, axis=1)
    return [Messages(topic.topics[0], "sensor_msgs/msg/JointState", log, time, fields)]


def pose_tables(run: SimulatedRun, topic: PoseTopic) -> list[Messages]:
    """Messages of the localization."""
    poses = run.poses
    if topic.form == "tf":
        return _write_tf(run, topic.topic)
    position, quaternion = poses.in_map()
    if not run.scenario.pose.reports_heading:
        quaternion = np.tile([0.0, 0.0, 0.0, 1.0], (quaternion.shape[0], 1))
    name, prefix = {
        "odometry": ("nav_msgs/msg/Odometry", "pose.pose."),
        "pose_stamped": ("geometry_msgs/msg/PoseStamped", "pose."),
        "pose_covariance": ("geometry_msgs/msg/PoseWithCovarianceStamped", "pose.pose."),
    }[topic.form]
    fields = _name_pose(prefix, "position", "orientation", position, quaternion)
    fields["header.frame_id"] = "map"
    if topic.form == "odometry":
        fields["child_frame_id"] = run.scenario.pose.child_frame
    return [Messages(topic.topic, name, poses.log_s, poses.stamp_s, fields)]


def static_tables(run: SimulatedRun, layout: Layout) -> list[Messages]:
    """Where sensors are mounted, as far as readers need it."""
    sensor = run.scenario.pose
    mounted: list[tuple[str, tuple[float, float], float]] = []
    if layout.pose.form == "tf" and run.imu is not None:
        mounted.append(("imu_link", (0.0, 0.0), 0.0))
    if sensor.child_frame != "base_link":
        mounted.append((sensor.child_frame, (sensor.mount_x_m, sensor.mount_y_m), sensor.mount_yaw_rad))
    return [
        Messages(
            "/tf_static",
            "tf2_msgs/msg/TFMessage",
            np.zeros(1),
            np.zeros(1),
            _name_transform(
                "base_link", name, np.array([[*position, 0.0]]), quaternions_from_yaw(np.array([yaw]))
            ),
        )
        for name, position, yaw in mounted
    ]


def _name_pose(
    prefix: str, position_name: str, turn: str, position: Floats, quaternion: Floats
) -> dict[str, Field]:
    fields: dict[str, Field] = {
        f"{prefix}{position_name}.{axis}": position[:, i] for i, axis in enumerate("xyz")
    }
    fields |= {f"{prefix}{turn}.{axis}": quaternion[:, i] for i, axis in enumerate("xyzw")}
    return fields


def _write_tf(run: SimulatedRun, topic: str) -> list[Messages]:
    poses = run.poses
    odometry = _name_transform("odom", "base_link", poses.position, poses.quaternion)
    # Localization corrects at its own pace and dates its transform ahead, so that others can look it up.
    time = np.arange(0.0, run.scenario.duration_s, _TF_PERIOD_S)
    which = np.clip(np.searchsorted(poses.log_s, time, side="right") - 1, 0, None)
    turn = quaternions_from_yaw(poses.correction_yaw[which])
    corrections = _name_transform("map", "odom", poses.correction[which], turn)
    name = "tf2_msgs/msg/TFMessage"
    return [
        Messages(topic, name, poses.log_s, poses.stamp_s, odometry),
        Messages(topic, name, time + _LATE_S, time + _FUTURE_S, corrections),
    ]


def _name_transform(parent: str, child: str, position: Floats, quaternion: Floats) -> dict[str, Field]:
    fields = _name_pose("transforms[].transform.", "translation", "rotation", position, quaternion)
    fields["transforms[].header.frame_id"] = parent
    fields["transforms[].child_frame_id"] = child
    return fields


def imu_tables(run: SimulatedRun, layout: Layout) -> list[Messages]:
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
    return [Messages(layout.imu, "sensor_msgs/msg/Imu", imu.time_s + _LATE_S, imu.time_s, fields)]


def state_tables(run: SimulatedRun) -> list[Messages]:
    """Messages that say which part of the run counts, if a person drives first."""
    by_hand = run.scenario.recording.hand_driven_s
    if by_hand is None:
        return []
    time = np.arange(0.0, run.scenario.duration_s, 0.1)
    topic, name = "/drive/calib_state", "std_msgs/msg/String"
    return [
        Messages(topic, name, time[time < by_hand], None, {"data": "idle"}),
        Messages(topic, name, time[time >= by_hand], None, {"data": "calib"}),
    ]


def decoy_tables(run: SimulatedRun) -> list[Messages]:
    """Messages that a hasty reader takes for the pose or the command."""
    scenario = run.scenario
    tables: list[Messages] = []
    if scenario.recording.decoys in {"commands", "both"}:
        wished = make_wishes(scenario, "decoy")
        fields: dict[str, Field] = {"linear.x": wished.speed_mps, "angular.z": wished.turn}
        tables.append(Messages("/navigation/cmd_vel", "geometry_msgs/msg/Twist", wished.time_s, None, fields))
    if scenario.recording.decoys in {"odometry", "both"} and run.wheels is not None:
        wheels = run.wheels
        path = integrate_odometry(scenario.vehicle, wheels, start=(0.0, 0.0, 0.0))
        speed, rate = apply_ideal_model(scenario.vehicle, wheels.left, wheels.right, wheels.steering)
        fields = _name_pose("pose.pose.", "position", "orientation", path.position[:-1], path.quaternion[:-1])
        fields |= {"header.frame_id": "odom", "child_frame_id": "base_link"}
        fields |= {"twist.twist.linear.x": speed, "twist.twist.angular.z": rate}
        time = wheels.time_s
        tables.append(Messages("/platform/odom", "nav_msgs/msg/Odometry", time + _LATE_S, time, fields))
    return tables


def cut_gaps(run: SimulatedRun, tables: list[Messages]) -> list[Messages]:
    """Take out what the recorder missed, on every topic alike."""
    recording = run.scenario.recording
    starts = spread_times(
        recording.gaps,
        duration_s=run.scenario.duration_s,
        generator=open_stream(run.scenario.seed, "gaps"),
    )
    for start in starts.tolist():
        tables = [_cut_out(table, start, start + recording.gap_s) for table in tables]
    return tables


def _cut_out(table: Messages, start_s: float, end_s: float) -> Messages:
    mask = (table.log_s < start_s) | (table.log_s >= end_s)
    return replace(
        table,
        log_s=table.log_s[mask],
        header_s=None if table.header_s is None else table.header_s[mask],
        fields={
            path: value[mask] if isinstance(value, np.ndarray) else value
            for path, value in table.fields.items()
        },
    )
