"""The real ring: recordings that a person has, each with one effect put into it, written as tasks.

A recording is read by the stages of the pipeline, as far as its tables of commands, wheels, poses and gyro;
the effect is put into these by `benchmarks/injections.py`; what comes out is written with the topics of every
other task. What the vehicle does by itself is nobody's truth: other names count neither for nor against, and
the injected effect has no number.
"""

import math
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from injections import Drive, Injection, list_injections
from numpy.typing import NDArray

from game.held_out import HORIZON_S, HeldOut, compose, measure_error, relate, walk
from game.rings import (
    FORCE_STEP,
    GYRO_STEP,
    POSITION_STEP,
    TURN_STEP,
    WHEEL_STEP,
    derive,
    describe_effect,
    describe_held_out,
    format_truth,
    list_names,
    round_to,
    write_held_out,
    write_manifest,
    write_sheet,
)
from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.core import SlipError
from pipeline.logs.writer import LogWriter
from pipeline.sources.one_vehicle import load_vehicle

Floats = NDArray[np.float64]
Json = dict[str, Any]
Tables = Mapping[str, pl.DataFrame]

FIRST_NS = 1_717_000_000_000_000_000
_LONGEST_S, _HELD_OUT_S = 190.0, 40.0
_SHORTEST_S = 60.0  # less is too little to name anything by
_LEAST_REACH_M = 0.5  # wheels in the air, a vehicle that stands: there is no motion to explain
_HOLE_S = 1.0  # poses farther apart are no driving that can be explained
_LATEST_S = 0.3  # a pose this much after the horizon still ends a window
_JOINTS = ("front_left", "front_right", "rear_left", "rear_right")


@dataclass(frozen=True)
class Recorded:
    """The stretch of a recording that is used, with an effect put into it; times from its start [s].

    Attributes:
        tables: by name; poses are fresh ones only.
        drive: geometry.
        log_s, end_s: end of the log and of the held-out stretch.
    """

    tables: Tables
    drive: Drive
    log_s: float
    end_s: float


def make_real(ring: Path, recordings: Path, root: bytes, tell: Callable[[str], None]) -> dict[str, Json]:
    """Write a task for each recording that serves, the effects in turn.

    Args:
        ring: folder of the ring.
        recordings: folder of MCAP files.
        root: from which salts follow.
        tell: called with a line after each.

    Returns:
        The truths of its tasks.
    """
    injections = list_listed()
    truths: dict[str, Json] = {}
    for path in sorted(recordings.glob("*.mcap")):
        name, injection = f"real_{len(truths) + 1:03d}", injections[len(truths) % len(injections)]
        try:
            truths[name] = write_real(path, name, injection, ring / name, derive(root, f"{name} salt").hex())
            tell(f"{name}  {path.name}: {injection.name}")
        except SlipError as problem:
            tell(f"{path.name}: left out: {problem}")
    return truths


def list_listed() -> list[Injection]:
    """Injections that the published list has a name for and that commands and poses show."""
    return [
        one
        for one in list_injections()
        if one.numbers and not one.same and "encoder" not in one.name and not one.name.startswith("wheels")
    ]


def write_real(path: Path, name: str, injection: Injection, folder: Path, salt: str) -> Json:
    """Write the task of one recording.

    Raises:
        SlipError: it cannot be read, or moves too little.
    """
    with tempfile.TemporaryDirectory(prefix="hidden_effect_") as results:
        manifest = analyze_log(path, Options(out=Path(results), report=False, diagnosis=False)).manifest
        vehicle = load_vehicle(manifest)
        tables = {
            one: manifest.read(one)
            for one in ("commands", "wheels", "poses", "imu")
            if one in manifest.tables
        }
    drive = Drive(vehicle.wheel_radius_m, vehicle.track_width_m or 0.0)
    if vehicle.kind != "differential" or not drive.track_m or not {"commands", "poses"} <= set(tables):
        raise refuse("not a differential drive with commands and poses", path.name)
    recorded = cut_stretch(injection.change(tables, drive), drive, path.name)
    held = cut_real_windows(recorded)
    folder.mkdir(parents=True, exist_ok=True)
    sensors = write_tables(recorded, folder / "log.mcap")
    commands = recorded.tables["commands"]
    times, speed, turn = read_body_commands(commands, drive)
    later = times >= recorded.log_s
    named = {"time_s": times[later], "speed_mps": speed[later], "yaw_rate_radps": turn[later]}
    write_held_out(folder, held, named, FIRST_NS)
    sheet = {"kind": "differential", "wheel_radius_m": drive.radius_m, "track_width_m": drive.track_m}
    write_sheet(folder, sheet | {"wheelbase_m": vehicle.wheelbase_m or drive.track_m, "wheels_per_side": 2})
    first, *rest = dict.fromkeys(label.split(".")[0] for label in injection.numbers)
    truth = {
        "effects": [describe_effect(first, {}) | {"same_as": rest}],
        "unlisted": None,
        "tolerated": ["other", *list_names()],
        "held_out": describe_held_out(held, floor=None),
        "scene": {"category": "real", "note": f"{injection.name}, in {path.name}", "salt": salt},
    }
    write_manifest(folder, name, recorded.log_s, sensors, "differential", format_truth(truth))
    return truth


def refuse(what: str, where: str) -> SlipError:
    """The error of a recording that makes no task."""
    return SlipError("no_task", what, where=where, hint="Give another recording")


def cut_stretch(tables: Tables, drive: Drive, where: str) -> Recorded:
    """The stretch with most poses that are new and count, with times from its start.

    Raises:
        SlipError: too short, or nothing moves.
    """
    poses = tables["poses"].filter("active", ~pl.col("held"), ~pl.col("outlier"))
    if poses.height < 2:
        raise refuse("no poses", where)
    times = poses["t"].to_numpy()
    counts = np.searchsorted(times, times + _LONGEST_S) - np.arange(times.size)
    first = int(np.argmax(counts))
    start, end_s = float(times[first]), float(times[first + counts[first] - 1] - times[first])
    steps = np.diff(times[first : first + counts[first]])
    driven_s = float(steps[steps < _HOLE_S].sum())
    # Noise alone walks any length: what counts is how far places are apart.
    reach = math.hypot(*(float(np.std(poses[axis].to_numpy())) for axis in "xy"))
    if driven_s < _SHORTEST_S or reach < _LEAST_REACH_M:
        what = f"{driven_s:.0f} s within {reach:.1f} m; a task needs {_SHORTEST_S:g} s, {_LEAST_REACH_M:g} m"
        raise refuse(what, where)
    used = {
        name: (poses if name == "poses" else table.filter("active"))
        .with_columns((pl.col("t") - start).alias("t"))
        .filter(pl.col("t").is_between(0.0, end_s))
        .sort("t")
        for name, table in tables.items()
    }
    return Recorded(used, drive, round(end_s - min(_HELD_OUT_S, 0.25 * end_s), 1), end_s)


def read_body_commands(commands: pl.DataFrame, drive: Drive) -> tuple[Floats, Floats, Floats]:
    """Times, speed and yaw rate that the commanded wheels would give the ideal vehicle."""
    left, right = (drive.radius_m * commands[side].to_numpy() for side in ("left", "right"))
    return commands["t"].to_numpy(), 0.5 * (left + right), (right - left) / drive.track_m


def cut_real_windows(recorded: Recorded) -> HeldOut:
    """Windows between measured poses of one segment; what is true at their end is what was measured."""
    poses = recorded.tables["poses"]
    times, segment = poses["t"].to_numpy(), poses["segment"].to_numpy()
    x, y, z, w = (poses[f"q_{axis}"].to_numpy() for axis in "xyzw")
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    place = np.column_stack((poses["x"].to_numpy(), poses["y"].to_numpy(), yaw))
    pairs: list[tuple[int, int]] = []
    begin = int(np.searchsorted(times, recorded.log_s))
    while begin < times.size:
        end = int(np.searchsorted(times, times[begin] + HORIZON_S))
        fits = end < times.size and segment[end] == segment[begin]
        if fits and times[end] - times[begin] < HORIZON_S + _LATEST_S:
            pairs.append((begin, end))
            begin = end
        else:
            begin += 1
    if not pairs:
        raise refuse("no 2 s of poses without a hole at its end", "held-out stretch")
    first, last = np.array(pairs).T
    moments, speed, turn = read_body_commands(recorded.tables["commands"], recorded.drive)
    velocity = np.column_stack((speed, np.zeros_like(speed), turn))[:-1]
    edges, path = walk(moments, velocity)
    at = [np.column_stack([np.interp(times[rows], edges, one) for one in path.T]) for rows in (first, last)]
    ideal = compose(place[first], relate(*at))
    return HeldOut(
        times[first], times[last], place[first], place[last], (0.0, 0.0), measure_error(ideal, place[last])
    )


def write_tables(recorded: Recorded, path: Path) -> list[str]:
    """Write the log; sensors beside its poses are returned."""
    tables = {name: table.filter(pl.col("t") < recorded.log_s) for name, table in recorded.tables.items()}
    times, speed, turn = read_body_commands(tables["commands"], recorded.drive)
    poses, sensors = tables["poses"], list[str]()
    with LogWriter(path) as writer:

        def write(topic: str, type_name: str, at: Floats, fields: Mapping[str, Any]) -> None:
            stamps = FIRST_NS + np.rint(at * 1e9).astype(np.int64)
            writer.write_columns(topic, type_name, stamps, dict(fields), header_time=stamps)

        body = {"twist.linear.x": speed, "twist.angular.z": turn, "header.frame_id": "base_link"}
        write("/cmd_vel", "geometry_msgs/msg/TwistStamped", times, body)
        place = {f"pose.pose.position.{axis}": _column(poses, axis, POSITION_STEP) for axis in "xyz"}
        attitude = {
            f"pose.pose.orientation.{axis}": _column(poses, f"q_{axis}", TURN_STEP) for axis in "xyzw"
        }
        frames = {"header.frame_id": "map", "child_frame_id": "base_link"}
        write(
            "/localization/odometry",
            "nav_msgs/msg/Odometry",
            poses["t"].to_numpy(),
            {**place, **attitude, **frames},
        )
        wheels = tables.get("wheels")
        if wheels is not None and not wheels.is_empty():
            left, right = (_column(wheels, side, WHEEL_STEP) for side in ("left", "right"))
            joints = {
                "name": [f"{one}_wheel_joint" for one in _JOINTS],
                "velocity": np.column_stack((left, right) * 2),
            }
            write("/joint_states", "sensor_msgs/msg/JointState", wheels["t"].to_numpy(), joints)
            sensors.append("encoders")
        imu = tables.get("imu")
        if imu is not None and not imu.is_empty():
            rates = {f"angular_velocity.{axis}": _column(imu, f"rate_{axis}", GYRO_STEP) for axis in "xyz"}
            forces = {
                f"linear_acceleration.{axis}": _column(imu, f"acceleration_{axis}", FORCE_STEP)
                for axis in "xyz"
            }
            unknown = np.zeros((imu.height, 9))
            unknown[:, 0] = -1.0
            told = {"header.frame_id": "imu_link", "orientation.w": 1.0, "orientation_covariance": unknown}
            write("/imu/data", "sensor_msgs/msg/Imu", imu["t"].to_numpy(), {**rates, **forces, **told})
            sensors.append("gyro")
    return sensors


def _column(table: pl.DataFrame, name: str, step: float) -> Floats:
    return round_to(np.nan_to_num(table[name].fill_null(0.0).to_numpy().astype(np.float64)), step)
