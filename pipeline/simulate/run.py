"""From a scenario to a simulated run: the truth, and what its sensors report."""

from dataclasses import dataclass

import numpy as np

from pipeline.core import Floats, euler_from_quaternions, quaternions_from_yaw
from pipeline.simulate.drivetrain import apply_ideal_model, drive_wheels
from pipeline.simulate.facts import (
    Effects,
    Published,
    SimulateError,
    Vehicle,
    find_layout,
    open_stream,
    resolve_effects,
)
from pipeline.simulate.path import Path, integrate_path, move_body
from pipeline.simulate.programs import make_commands, walk_in_plane
from pipeline.simulate.scenario import BodyMotion, Commands, Drive, Scenario, integrate_cells
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
    motion = move_body(
        drive,
        vehicle,
        effects,
        disturbance=scenario.disturbance,
        generator=open_stream(seed, "disturbance"),
    )
    if scenario.upset is not None:
        motion = scenario.upset(motion, drive.step_s)
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
    return SimulatedRun(scenario, truth, _as_recorded(scenario, truth.commands), poses, wheels, imu)


def _check_frame(scenario: Scenario) -> None:
    layout = find_layout(scenario.recording.layout, scenario.vehicle)
    rows = [row for row in layout.topics if not isinstance(row, Published)]
    if scenario.pose.child_frame != "base_link" and rows and not any("odometry" in row for row in rows):
        what = f"the pose of this layout cannot be of {scenario.pose.child_frame}"
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
    by_hand = scenario.recording.hand_driven_s
    if by_hand is None:
        return commands
    # The command topic keeps repeating zeros while a person drives by radio, past the computer.
    live = commands.time_s >= by_hand
    sideways = None if commands.sideways_mps is None else commands.sideways_mps * live
    return Commands(commands.time_s, commands.speed_mps * live, commands.turn * live, sideways)
