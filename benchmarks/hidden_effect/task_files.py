"""A task as files: a folder with task.toml, the log, the vehicle sheet, held-out commands; and its truth."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from held_out import HeldOut, cut_windows
from numpy.typing import NDArray
from task_draws import HORIZON_S, NAMES, Hidden, Task

from pipeline.simulate import SimulatedRun, simulate_run, simulate_skid_steer, write_log
from pipeline.simulate.programs import Commands

Floats = NDArray[np.float64]
Json = dict[str, Any]

VERSION = "1.0"
TASK_FORMAT, TRUTH_FORMAT = "hidden-effect-task/1", "hidden-effect-truth/1"
# Steps of sensors [m, 1, rad/s, m/s^2, rad/s], as powers of two: what is finer would be noise to store.
POSITION_STEP, TURN_STEP, GYRO_STEP, FORCE_STEP, WHEEL_STEP = (
    2.0**-12,
    2.0**-14,
    2.0**-11,
    2.0**-5,
    2.0**-9,
)
_TICK_S = 1e-4
_DIGITS = 6


def write_task(task: Task, folder: Path) -> Json:
    """Simulate a task and write its folder.

    Returns:
        Its truth, which stands nowhere in the folder.
    """
    scene = task.scenario
    run = simulate_run(scene) if task.machine is None else simulate_skid_steer(scene, task.machine)
    run = _read_by_sensors(run)
    held = cut_windows(task, run)
    folder.mkdir(parents=True, exist_ok=True)
    write_log(_cut_log(run, task.log_s), folder / "log.mcap", marked=False)
    first = round(scene.clock.start_ns)
    later = run.commands.time_s >= task.log_s
    write_held_out(folder, held, _name_commands(run.commands, task.kind, later), first)
    vehicle = scene.vehicle
    write_sheet(
        folder,
        {
            "kind": task.kind,
            "wheel_radius_m": vehicle.wheel_radius_m,
            "track_width_m": vehicle.track_width_m,
            "wheelbase_m": vehicle.wheelbase_m,
            "wheels_per_side": vehicle.wheels_per_side,
            "command_timeout_s": scene.program.hold_s,
        },
    )
    sensors = [name for name, has in (("encoders", run.wheels), ("gyro", run.imu)) if has is not None]
    write_manifest(folder, task.id, task.log_s, ["poses", *sensors], list_topics(task.kind, sensors))
    outside = task.outside
    unlisted = None
    if outside is not None and not outside.name:
        unlisted = {"about": outside.about, "channels": list(outside.channels)}
    return {
        "effects": [describe_hidden(hidden) for hidden in task.hidden],
        "unlisted": unlisted,
        "tolerated": list(task.tolerated),
        "held_out": describe_held_out(held, floor=held.floor),
        "scene": {
            "kind": task.kind,
            "driving": task.driving,
            "sensors": ["poses", *sensors],
            "cause": task.cause,
        },
    }


def describe_hidden(hidden: Hidden) -> Json:
    """An effect of a truth; `scale` is what a width of an interval is measured by."""
    known = NAMES[hidden.name]["parameters"]
    parameters = {}
    for name, value in hidden.parameters.items():
        size = None if value is None else abs(value - known[name].get("neutral", 0.0)) or None
        parameters[name] = {"value": value, "scale": size}
    return {"name": hidden.name, "parameters": parameters, "same_as": list(hidden.same_as)}


def describe_held_out(held: HeldOut, floor: tuple[float, float] | None) -> Json:
    """The held-out part of a truth; no floor where nobody knows the physics."""
    return {
        "poses": np.round(held.ends, _DIGITS).tolist(),
        "floor": None if floor is None else {"position_m": floor[0], "yaw_rad": floor[1]},
        "ideal": {"position_m": held.ideal[0], "yaw_rad": held.ideal[1]},
    }


def list_topics(kind: str, sensors: Sequence[str]) -> dict[str, str]:
    """The topics of a log by what they say."""
    topics = {
        "commands": "/ackermann_cmd" if kind == "ackermann" else "/cmd_vel",
        "poses": "/localization/odometry",
    }
    more = {"encoders": "/joint_states", "gyro": "/imu/data"}
    return topics | {name: more[name] for name in sensors}


def write_manifest(
    folder: Path, name: str, log_s: float, sensors: Sequence[str], topics: Mapping[str, str]
) -> None:
    """task.toml: what the task is, and which file holds what."""
    ring = name.partition("_")[0]
    content = {
        "format": TASK_FORMAT,
        "version": VERSION,
        "id": name,
        "ring": ring,
        "log": "log.mcap",
        "log_s": log_s,
        "vehicle": "vehicle.toml",
        "sensors": list(sensors),
        "topics": dict(topics),
        "held_out": {
            "commands": "held_out_commands.csv",
            "windows": "held_out_windows.csv",
            "horizon_s": HORIZON_S,
        },
    }
    (folder / "task.toml").write_text(tomlkit.dumps(content), encoding="utf-8")


def write_sheet(folder: Path, sheet: Mapping[str, object]) -> None:
    """vehicle.toml: what the maker says of the vehicle, not what is true of it."""
    (folder / "vehicle.toml").write_text(tomlkit.dumps(dict(sheet)), encoding="utf-8")


def write_held_out(folder: Path, held: HeldOut, commands: Mapping[str, Floats], first_ns: int) -> None:
    """The commands of the held-out stretch, and its windows: first pose, and the stamp of the last one."""
    stamps = [_stamp(first_ns, times) for times in (commands["time_s"], held.starts_s, held.ends_s)]
    columns = {name: values for name, values in commands.items() if name != "time_s"}
    _write_csv(folder / "held_out_commands.csv", {"stamp_ns": stamps[0], **columns})
    x, y, yaw = held.starts.T
    windows = {"start_ns": stamps[1], "x": x, "y": y, "yaw": yaw, "end_ns": stamps[2]}
    _write_csv(folder / "held_out_windows.csv", windows)


def _stamp(first_ns: int, times_s: Floats) -> NDArray[np.int64]:
    return first_ns + np.rint(times_s * 1e9).astype(np.int64)


def _write_csv(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    with path.open("w", newline="", encoding="ascii") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(columns)
        for row in zip(*(values.tolist() for values in columns.values()), strict=True):
            writer.writerow([round(value, _DIGITS) if isinstance(value, float) else value for value in row])


def _name_commands(commands: Commands, kind: str, rows: NDArray[np.bool_]) -> dict[str, Floats]:
    """What was asked of the body; a car is asked for a steering angle."""
    turn = "steering_rad" if kind == "ackermann" else "yaw_rate_radps"
    named = {
        "time_s": commands.time_s[rows],
        "speed_mps": commands.speed_mps[rows],
        turn: commands.turn[rows],
    }
    return named | ({} if commands.sideways_mps is None else {"sideways_mps": commands.sideways_mps[rows]})


def _read_by_sensors(run: SimulatedRun) -> SimulatedRun:
    """The run as sensors with finite steps read it: its log takes a third of the room."""
    poses = replace(
        run.poses,
        stamp_s=round_to(run.poses.stamp_s, _TICK_S),
        log_s=round_to(run.poses.log_s, _TICK_S),
        position=round_to(run.poses.position, POSITION_STEP),
        quaternion=round_to(run.poses.quaternion, TURN_STEP),
    )
    commands = replace(run.commands, time_s=round_to(run.commands.time_s, _TICK_S))
    wheels, imu = run.wheels, run.imu
    if wheels is not None:
        corners = wheels.corners
        rough = {name: round_to(getattr(wheels, name), WHEEL_STEP) for name in ("left", "right")}
        steps = {name: round_to(values, WHEEL_STEP) for name, values in (corners or {}).items()}
        angles = {
            name: round_to(getattr(wheels, name), TURN_STEP)
            for name in ("left_angle", "right_angle", "steering")
        }
        wheels = replace(wheels, **rough, **angles, corners=steps or None)
    if imu is not None:
        imu = replace(
            imu,
            rates=round_to(imu.rates, GYRO_STEP),
            accelerations=round_to(imu.accelerations, FORCE_STEP),
        )
    return replace(run, poses=poses, commands=commands, wheels=wheels, imu=imu)


def round_to(values: Floats, step: float) -> Floats:
    """Values at the steps of a sensor."""
    return np.rint(values / step) * step


def _cut_log(run: SimulatedRun, end_s: float) -> SimulatedRun:
    """The part that is recorded: what was received before the held-out stretch."""
    poses, commands, wheels, imu = run.poses, run.commands, run.wheels, run.imu
    early = commands.time_s < end_s
    sideways = None if commands.sideways_mps is None else commands.sideways_mps[early]
    commands = Commands(commands.time_s[early], commands.speed_mps[early], commands.turn[early], sideways)
    before = np.maximum(poses.log_s, poses.stamp_s) < end_s
    poses = replace(poses, **{name: values[before] for name, values in vars(poses).items()})
    if wheels is not None:
        now = wheels.time_s < end_s
        kept = {
            name: {place: column[now] for place, column in values.items()}
            if isinstance(values, Mapping)
            else values[now]
            for name, values in vars(wheels).items()
            if values is not None
        }
        wheels = replace(wheels, **kept)
    if imu is not None:
        now = imu.time_s < end_s
        imu = replace(imu, **{name: values[now] for name, values in vars(imu).items()})
    scene = replace(run.scenario, duration_s=end_s)
    return replace(run, scenario=scene, commands=commands, poses=poses, wheels=wheels, imu=imu)
