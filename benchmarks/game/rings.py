"""The rings of the game: folders of tasks that need no part of `slip`, and their truths beside them.

    make bench NAME=game/rings [ARGS="--rings open rigid"]
    make bench NAME=game/rings ARGS="--rings real --recordings FOLDER"
    make bench NAME=game/rings ARGS="--rings open --sealed"

open    drawn riddles of all categories of one log: how well effects of the catalogue's forms are found.
rigid   rigid bodies, contact and friction (MuJoCo), which share no formula with the catalogue: how well that
        carries over to physics that nobody wrote down as effects.
real    recordings of yours, each with one effect put into it: how well it carries over to real noise.

These three ask three questions; a ring whose truth is not told yet is one of them with `--sealed`: its seed
is drawn, used and forgotten. In every ring the truth stands outside of the tasks, in a folder that the maker
holds; a task has the SHA-256 of its truth, which is salted, so that no guess can be checked against it.
Without `--sealed` everything comes of `--seed`, and the same seed gives the same bytes.
"""

import argparse
import csv
import hashlib
import json
import math
import secrets
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tomlkit
from numpy.typing import NDArray

from game.draw import Answer, Category, Riddle, draw_riddle
from game.held_out import HORIZON_S, HeldOut, cut_windows
from game.odd import ODD
from game.rigid_bodies import simulate_skid_steer
from game.score import TRUTH_FORMAT
from pipeline.simulate import (
    LAYOUTS,
    Encoders,
    Layout,
    Recording,
    Scenario,
    SimulatedRun,
    list_effects,
    simulate_run,
    write_log,
)
from pipeline.simulate.scenario import Commands

Floats = NDArray[np.float64]
Json = dict[str, Any]
Ring = Literal["open", "rigid", "real"]

VERSION = "2.0"
TASK_FORMAT = "hidden-effect-task/2"
SEED = 20261
RINGS: tuple[Ring, ...] = ("open", "rigid", "real")
MIX: tuple[Category, ...] = (
    "single", "small", "sets", "equipped", "cars", "natural", "late", "empty", "odd", "poor",
)  # fmt: skip
"""Categories of the open ring, in turn: all that are one log."""
_COUNTS = {"open": 60, "rigid": 16}
_SEED_BYTES = 16  # 128 bits: nobody finds a seed by trying
_LONGEST_S, _HELD_OUT_S, _POSES_HZ = 190.0, 40.0, 10.0
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

# What contact does to any skid-steer made of rigid bodies, beside what was built into it. Scrub slows the
# wheels, too, as their controllers have no integral part: the encoders' difference falls .067 rad/s short of
# the command at every rate of turn (seed 993004). A curve's centripetal force takes grip from scrubbing, so
# that turning gains with speed: on a Warthog .54 of the wheels' rate on the spot, .76 at 2.5 m/s and 1 rad/s
# (`test_a_fast_curve_turns_more_of_what_its_wheels_ask_than_a_spin`).
_CONTACT = (
    "effective_track", "icr_offset", "lateral_skid", "body_inertia", "turning_resistance", "speed_slip",
    "wheel_radius", "drive_lag", "turn_lag", "acceleration_limit", "difference_gain", "turn_droop",
    "wheel_servo", "speed_track", "contact_friction", "other",
)  # fmt: skip
_BUILT_IN = {
    "payload": ("icr_lateral",),
    "small_wheels": ("wheel_asymmetry", "icr_lateral"),
    "slope": ("slope_slip", "side_slope_slip", "side_slope_turn"),
}
_NEUTRAL = {(spec.id, item.name): item.neutral for spec in list_effects() for item in spec.parameters}

Told = Callable[[str], None]


def make_truth(answer: Answer) -> Json:
    """What a riddle hides, as the scorer reads it."""
    rigid, odd = answer.category == "rigid", ODD.get(answer.odd)
    tolerated = [*_CONTACT, *_BUILT_IN.get(answer.note, ())] if rigid else list(odd.alike) if odd else []
    effects = [describe_effect(name, values, rigid=rigid) for name, values in answer.effects.items()]
    unlisted = {"about": odd.about, "channels": list(odd.channels)} if odd else None
    return {"effects": effects, "unlisted": unlisted, "tolerated": tolerated, "held_out": None}


def describe_effect(name: str, values: Mapping[str, float], *, rigid: bool = False) -> Json:
    """An effect of a truth; `scale` is what the width of an interval is measured by."""
    parameters = {}
    for key, value in values.items():
        neutral = _NEUTRAL[name, key]
        size = abs(value - neutral) if math.isfinite(neutral) else abs(value)
        parameters[key] = {"value": value, "scale": size or None}
    # What contact makes of turning may be said by either name.
    same = ["effective_track"] if rigid and name == "contact_friction" else []
    return {"name": name, "parameters": parameters, "same_as": same}


def list_names() -> Json:
    """The published list: every effect with its formula and the units of its parameters."""
    return {
        spec.id: {
            "formula": spec.formula,
            "vehicles": list(spec.kinds),
            "parameters": {
                item.name: {
                    "unit": item.unit,
                    "neutral": item.neutral if math.isfinite(item.neutral) else None,
                }
                for item in spec.parameters
            },
        }
        for spec in list_effects()
    }


def write_task(riddle: Riddle, name: str, folder: Path, salt: str) -> Json:
    """Simulate a riddle with the topics of every task, and write its folder.

    Returns:
        Its truth, which stands nowhere in the folder.
    """
    scene = _plain(riddle.scenario)
    run = simulate_run(scene) if riddle.machine is None else simulate_skid_steer(scene, riddle.machine)
    run = _read_by_sensors(run)
    log_s = round(scene.duration_s - min(_HELD_OUT_S, 0.25 * scene.duration_s), 1)
    held = cut_windows(run, log_s)
    folder.mkdir(parents=True, exist_ok=True)
    write_log(_cut_log(run, log_s), folder / "log.mcap", marked=False)
    later = run.commands.time_s >= log_s
    vehicle = scene.vehicle
    commands = _name_commands(run.commands, vehicle.kind, later)
    write_held_out(folder, held, commands, round(scene.clock.start_ns))
    write_sheet(
        folder,
        {
            "kind": vehicle.kind,
            "wheel_radius_m": vehicle.wheel_radius_m,
            "track_width_m": vehicle.track_width_m,
            "wheelbase_m": vehicle.wheelbase_m,
            "wheels_per_side": vehicle.wheels_per_side,
            "command_timeout_s": scene.program.hold_s,
        },
    )
    sensors = [one for one, has in (("encoders", run.wheels), ("gyro", run.imu)) if has is not None]
    truth = make_truth(riddle.answer)
    for effect in truth["effects"]:
        if effect["name"] == "time_drift":
            # The simulator's k counts over the held-out stretch, too; that of the truth over the log.
            effect["parameters"]["k"] = {
                key: value * log_s / scene.duration_s for key, value in effect["parameters"]["k"].items()
            }
    truth["held_out"] = describe_held_out(held, floor=held.floor)
    truth["scene"] = {"category": riddle.answer.category, "note": riddle.answer.note, "salt": salt}
    write_manifest(folder, name, log_s, sensors, vehicle.kind, format_truth(truth))
    return truth


def _plain(scene: Scenario) -> Scenario:
    """The same scene with the same topics as every other, and no longer than a task is."""
    kind = scene.vehicle.kind
    base = LAYOUTS["ackermann" if kind == "ackermann" else "mecanum"].topics
    command = base[0] if kind == "ackermann" else {"twist": "/cmd_vel", "stamped": True, "frame": "base_link"}
    pose_row = {"odometry": "/localization/odometry", "source": "localization", "parent": "map", "child": ""}
    layout = Layout(kind, (command, base[1], pose_row, base[3]))
    pose = replace(scene.pose, rate_hz=min(scene.pose.rate_hz, _POSES_HZ), noise_z_m=0.0, noise_tilt_rad=0.0)
    return replace(
        scene,
        duration_s=min(scene.duration_s, _LONGEST_S),
        program=replace(scene.program, rate_hz=10.0),
        pose=pose,
        encoders=None if scene.encoders is None else Encoders(rate_hz=10.0, report="velocity"),
        imu=None if scene.imu is None else replace(scene.imu, rate_hz=20.0, sign=1),
        recording=Recording(layout, deployment="absent"),
    )


def format_truth(truth: Json) -> bytes:
    """The bytes of a truth, of which the hash is published."""
    whole = {"format": TRUTH_FORMAT, "version": VERSION, **truth}
    return (json.dumps(whole, indent=1, sort_keys=True, allow_nan=False) + "\n").encode()


def describe_held_out(held: HeldOut, floor: tuple[float, float] | None) -> Json:
    """The held-out part of a truth; no floor where nobody knows the physics."""
    return {
        "poses": np.round(held.ends, _DIGITS).tolist(),
        "floor": None if floor is None else {"position_m": floor[0], "yaw_rad": floor[1]},
        "ideal": {"position_m": held.ideal[0], "yaw_rad": held.ideal[1]},
    }


def write_manifest(
    folder: Path, name: str, log_s: float, sensors: Sequence[str], kind: str, truth: bytes
) -> None:
    """task.toml: what the task is, which file holds what, and the hash of its truth."""
    topics = {
        "commands": "/ackermann_cmd" if kind == "ackermann" else "/cmd_vel",
        "poses": "/localization/odometry",
    }
    more = {"encoders": "/joint_states", "gyro": "/imu/data"}
    content = {
        "format": TASK_FORMAT,
        "version": VERSION,
        "id": name,
        "ring": name.partition("_")[0],
        "log": "log.mcap",
        "log_s": log_s,
        "vehicle": "vehicle.toml",
        "sensors": ["poses", *sensors],
        "topics": topics | {one: more[one] for one in sensors},
        "held_out": {
            "commands": "held_out_commands.csv",
            "windows": "held_out_windows.csv",
            "horizon_s": HORIZON_S,
        },
        "truth_sha256": hashlib.sha256(truth).hexdigest(),
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


def derive(root: bytes, purpose: str) -> bytes:
    """Bytes for one purpose, from which nothing of the root or of another purpose follows."""
    return hashlib.sha256(root + purpose.encode()).digest()[:_SEED_BYTES]


def make_ring(ring: Ring, out: Path, root: bytes, count: int, tell: Told) -> dict[str, Json]:
    """Write the tasks of a ring that is simulated.

    Args:
        ring: its name.
        out: folder of all rings.
        root: from which the seeds of its tasks follow.
        count: tasks.
        tell: called with a line after each.

    Returns:
        The truths of its tasks.
    """
    truths = {}
    for number in range(1, count + 1):
        begun = time.perf_counter()
        category = "rigid" if ring == "rigid" else MIX[(number - 1) % len(MIX)]
        name, place = f"{ring}_{number:03d}", f"{ring} {number}"
        riddle = draw_riddle(category, int.from_bytes(derive(root, place), "big"))
        truths[name] = write_task(riddle, name, out / ring / name, derive(root, f"{place} salt").hex())
        tell(f"{name}  {time.perf_counter() - begun:.1f} s")
    return truths


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, default=Path("rings"), help="folder of the rings")
    parser.add_argument("--truths", type=Path, default=Path("truths"), help="folder of their truths")
    parser.add_argument("--rings", nargs="+", choices=RINGS, default=list(RINGS))
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--sealed", action="store_true", help="a seed that is drawn and stored nowhere")
    parser.add_argument("--tasks", type=int, help="a ring; 60, of the rigid one 16, when not given")
    parser.add_argument("--recordings", type=Path, help="folder of your own recordings, for the real ring")


def run(given: argparse.Namespace) -> None:
    """Write the rings that were asked for, each in place of what stood there."""
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "names.json").write_text(json.dumps(list_names(), indent=1) + "\n", encoding="utf-8")
    shutil.copyfile(Path(__file__).with_name("score.py"), given.out / "score.py")
    seed = secrets.token_bytes(32) if given.sealed else str(given.seed).encode()
    root = hashlib.sha256(f"HiddenEffect {VERSION} ".encode() + seed).digest()
    for ring in given.rings:
        begun = time.perf_counter()
        if ring == "real" and given.recordings is None:
            print("real: left out; it needs recordings: --recordings FOLDER")
            continue
        for folder in (given.out / ring, given.truths / ring):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
        if ring == "real":
            from game.recorded import make_real  # noqa: PLC0415 - it alone reads recordings

            truths = make_real(given.out / ring, given.recordings, root, _print)
        else:
            truths = make_ring(ring, given.out, root, given.tasks or _COUNTS[ring], _print)
        for name, truth in truths.items():
            (given.truths / ring / f"{name}.json").write_bytes(format_truth(truth))
        size = sum(path.stat().st_size for path in (given.out / ring).rglob("*") if path.is_file())
        print(f"{ring}: {len(truths)} tasks, {size / 1e6:.1f} MB, {time.perf_counter() - begun:.0f} s")


def _print(line: str) -> None:
    print(line, flush=True)
