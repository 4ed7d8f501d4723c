"""From a scenario to a simulated run with its incidents, and its messages: topic, type, times, fields."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.core import Flags, Floats, euler_from_quaternions, quaternions_from_yaw
from pipeline.simulate.drivetrain import apply_ideal_model, drive_wheels
from pipeline.simulate.facts import (
    Effects,
    SimulateError,
    Vehicle,
    find_layout,
    open_stream,
    resolve_effects,
    spread_times,
)
from pipeline.simulate.path import BodyMotion, Path, integrate_path, move_body
from pipeline.simulate.programs import make_commands, make_wishes, walk_in_plane
from pipeline.simulate.scenario import Commands, Drive, Incident, IncidentKind, Scenario, integrate_cells
from pipeline.simulate.sensors import ImuReadings, Poses, WheelReadings, read_encoders, read_imu, report_poses

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

LATE_S = 0.002
"""From a reading to the recorder [s]."""


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
        fields = {f"pose.pose.position.{axis}": path.position[:-1, i] for i, axis in enumerate("xyz")}
        fields |= {f"pose.pose.orientation.{axis}": path.quaternion[:-1, i] for i, axis in enumerate("xyzw")}
        fields |= {"header.frame_id": "odom", "child_frame_id": "base_link"}
        fields |= {"twist.twist.linear.x": speed, "twist.twist.angular.z": rate}
        time = wheels.time_s
        tables.append(Messages("/platform/odom", "nav_msgs/msg/Odometry", time + LATE_S, time, fields))
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


# Incidents of a simulated drive: signals that drop, repeat or stop, and a body that is stuck or pushed.


def _mark(incidents: Sequence[Incident], kinds: Sequence[IncidentKind], times: Floats) -> Flags:
    marked = np.zeros(times.size, dtype=bool)
    for incident in incidents:
        if incident.kind in kinds:
            marked |= incident.contains(times)
    return marked


def send_commands(commands: Commands, incidents: Sequence[Incident]) -> Commands:
    """The commands that the drive hears."""
    return _drop(
        _silence(commands, _mark(incidents, ("pushed",), commands.time_s)),
        _mark(incidents, ("commands_silent",), commands.time_s),
    )


def record_commands(commands: Commands, incidents: Sequence[Incident]) -> Commands:
    """Of the commands that the drive heard, those that the command topic holds."""
    return _silence(commands, _mark(incidents, ("manual_driving",), commands.time_s))


def _silence(commands: Commands, zero: Flags) -> Commands:
    sideways = None if commands.sideways_mps is None else commands.sideways_mps * ~zero
    speed, turn = commands.speed_mps * ~zero, commands.turn * ~zero
    return replace(commands, speed_mps=speed, turn=turn, sideways_mps=sideways)


def _drop(commands: Commands, gone: Flags) -> Commands:
    sideways = None if commands.sideways_mps is None else commands.sideways_mps[~gone]
    time, speed, turn = commands.time_s[~gone], commands.speed_mps[~gone], commands.turn[~gone]
    return replace(commands, time_s=time, speed_mps=speed, turn=turn, sideways_mps=sideways)


def _find_middles(cell_count: int, step_s: float) -> Floats:
    return np.asarray((np.arange(cell_count) + 0.5) * step_s, dtype=np.float64)


def brake_wheels(drive: Drive, incidents: Sequence[Incident]) -> Drive:
    """The drive under emergency stops."""
    times = _find_middles(drive.left.size, drive.step_s)
    share = np.ones(times.size)
    for incident in incidents:
        if incident.kind in {"emergency_stop", "sliding"}:
            ends = [
                incident.start_s,
                incident.start_s + _STOPS_IN_S,
                incident.end_s,
                incident.end_s + _STARTS_IN_S,
            ]
            share *= np.interp(times, ends, [1.0, 0.0, 0.0, 1.0])
    corners = drive.corners
    if corners is not None:
        corners = {corner: wheel * share for corner, wheel in corners.items()}
    return replace(drive, left=drive.left * share, right=drive.right * share, corners=corners)


def disturb_body(
    motion: BodyMotion, incidents: Sequence[Incident], vehicle: Vehicle, step_s: float
) -> BodyMotion:
    """The body's motion where it is stuck or pushed."""
    times = _find_middles(motion.v0.size, step_s)
    velocity = motion.velocity * ~_mark(incidents, ("stuck",), times)[:, None]
    for incident in incidents:
        inside = incident.contains(times)
        if not inside.any():
            continue
        passed = (times[inside] - incident.start_s) / (incident.end_s - incident.start_s)
        if incident.kind == "digging_in":
            velocity[inside] *= np.maximum(1.0 - 2.0 * passed, 0.0)[:, None]
        elif incident.kind == "spinning":
            velocity[inside] *= _SPIN_SHARE
        elif incident.kind == "sliding":
            velocity[inside] = velocity[max(int(np.argmax(inside)) - 1, 0)] * (1.0 - passed)[:, None]
    pushed = _mark(incidents, ("pushed",), times)
    velocity[pushed, 0] += _PUSH_SHARE * min(vehicle.max_speed_mps, 1.0)
    return replace(motion, velocity=velocity)


def freeze_poses(poses: Poses, incidents: Sequence[Incident]) -> Poses:
    """The poses of a localization that repeats the last one."""
    rows = np.arange(poses.stamp_s.size)
    for incident in incidents:
        if incident.kind == "localization_frozen":
            inside = incident.contains(poses.sampled_s)
            rows[inside] = max(int(np.searchsorted(poses.sampled_s, incident.start_s)) - 1, 0)
    return replace(poses, position=poses.position[rows], quaternion=poses.quaternion[rows])


_STOPS_IN_S = 0.15


_STARTS_IN_S = 0.2


_PUSH_SHARE = 0.5
"""Of the vehicle's largest speed, at which it is pushed."""


_SPIN_SHARE = 0.25
"""Of the wheels' motion, that spinning ones bring."""
