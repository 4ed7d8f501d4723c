"""The tasks of HiddenEffect, drawn by seed: vehicle, driving, sensors, and what is hidden.

Uses the simulator alone, which shares no code with the estimators. The rigid ring asks the simulator for no
effect at all: its causes are masses, radii, grip, motors and slopes of rigid bodies in contact (MuJoCo).
"""

from __future__ import annotations

import math
import sys
import tomllib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "hidden"))

from closed_loop import close_loop
from effect_sizes import draw_size
from outside_physics import Outside, draw_named, draw_unlisted

from pipeline.simulate import (
    LAYOUTS,
    MACHINES,
    VEHICLES,
    Disturbance,
    Encoders,
    Ground,
    Imu,
    PoseSensor,
    Program,
    Recording,
    Scenario,
    SkidSteer,
)

Ring = Literal["open", "sealed", "rigid"]
NAMES: dict[str, dict[str, Any]] = tomllib.loads(Path(__file__).with_name("names.toml").read_text("utf-8"))
SIMULATED = {str(entry.get("slip", name)): name for name, entry in NAMES.items() if entry.get("slip", name)}
"""Names of the published list by the simulator's."""

HORIZON_S = 2.0
"""How far a pose is predicted: the horizon of the project's errors, a planner's next manoeuvre."""
_EMPTY, _ONE, _SEVERAL = 0.2, 0.42, 0.24
_DISTURBANCE = Disturbance(0.03, 0.05)
_KINDS = {
    "skid_steer": ("husky", "warthog", "jackal"),
    "differential": ("turtlebot3", "marmotte"),
    "ackermann": ("car",),
    "mecanum": ("youbot",),
}
_SHARES = (0.4, 0.2, 0.2, 0.2)
_PROGRAMS = {
    "designed": ("drive_steps", "drive_steps", "slalom", "ramps"),
    "natural": ("smooth", "teleop", "stop_and_go"),
}
_CAUSES = ("track", "payload", "small_wheels", "slope", "slow_motors", "low_grip")
# What a cause in contact looks like besides, and physics that no name fits: neither counts for or against.
# The last two: a velocity servo of finite stiffness gives way to the friction of scrubbing wheels.
_BY_CONTACT = (
    "slip_in_turns", "slip_with_speed", "outward_skid", "turn_gain_with_speed", "body_inertia", "turn_lag",
    "wheel_radius_scale", "wheel_control_loop", "turn_droop",
)  # fmt: skip
_COMMANDS = {"ackermann": ("ackermann", "/ackermann_cmd")}
_SLOW_MOTORS_S = 0.5
_CAR_SIZES = {"icr_offset": 4.0, "icr_lateral": 4.0, "lever_arm": 4.0, "lateral_skid": 2.0}


@dataclass(frozen=True)
class Hidden:
    """One effect of the published list with the values at which it acts; None where nobody knows them."""

    name: str
    parameters: dict[str, float | None]
    same_as: tuple[str, ...] = ()


@dataclass(frozen=True)
class Task:
    """What is recorded, and what it hides.

    Attributes:
        id: of the task, and the name of its folder.
        scenario: over the log and the held-out stretch after it.
        kind: of the vehicle, as the vehicle sheet has it.
        log_s: length of the log [s].
        driving: ``designed``, ``natural`` or ``closed_loop``.
        hidden: effects of the published list.
        outside: physics that the simulator's catalogue does not have.
        machine: rigid bodies; None for a vehicle of formulas.
        tolerated: names that count neither for nor against.
        cause: of the rigid ring, in words.
    """

    id: str
    scenario: Scenario
    kind: str
    log_s: float
    driving: str
    hidden: tuple[Hidden, ...] = ()
    outside: Outside | None = None
    machine: SkidSteer | None = None
    tolerated: tuple[str, ...] = ()
    cause: str = ""


@dataclass(frozen=True)
class Lengths:
    """Seconds of log, drawn between two ends, and of the held-out stretch."""

    shortest_s: float = 120.0
    longest_s: float = 180.0
    held_out_s: float = field(default=40.0)


def draw_task(ring: Ring, number: int, seed: int, lengths: Lengths) -> Task:
    """The task of a number; the seed says everything about it."""
    draw = np.random.default_rng(seed)
    name = f"{ring}_{number:03d}"
    return (
        _draw_rigid(name, draw, seed, lengths) if ring == "rigid" else _draw_plain(name, draw, seed, lengths)
    )


def _draw_plain(name: str, draw: np.random.Generator, seed: int, lengths: Lengths) -> Task:
    kind = str(draw.choice(list(_KINDS), p=_SHARES))
    rolled = float(draw.random())
    outside = rolled >= _EMPTY + _ONE + _SEVERAL and kind in {"skid_steer", "differential"}
    count = 0 if rolled < _EMPTY or outside else 1 if rolled < _EMPTY + _ONE else int(draw.integers(2, 4))
    log_s = round(float(draw.uniform(lengths.shortest_s, lengths.longest_s)), 1)
    scene = _draw_scene(kind, draw, seed, log_s + lengths.held_out_s)
    task = Task(name, scene, kind, log_s, "designed")
    driving = str(draw.choice(["designed", "natural", "closed_loop"], p=[0.4, 0.4, 0.2]))
    if driving == "closed_loop" and (outside or kind not in {"skid_steer", "differential"}):
        driving = "natural"
    if driving != "closed_loop":
        program = replace(scene.program, name=str(draw.choice(_PROGRAMS[driving])))  # type: ignore[arg-type]
        task = replace(task, scenario=replace(scene, program=program))
    task = replace(task, driving=driving)
    if outside:
        return _add_outside(task, draw)
    task = _add_effects(task, _choose_effects(kind, count, scene, draw), draw)
    if driving == "closed_loop":
        task = replace(task, scenario=close_loop(task.scenario, draw))
    return task


def _draw_scene(kind: str, draw: np.random.Generator, seed: int, duration_s: float) -> Scenario:
    vehicle = VEHICLES[str(draw.choice(_KINDS[kind]))]
    scale = 0.6 if vehicle.max_speed_mps > 3.0 else 1.0
    noise = float(draw.choice([0.001, 0.003, 0.01]))
    wheels, gyro = {0: (True, True), 1: (False, True), 2: (True, False), 3: (False, False)}[
        int(draw.choice(4, p=[0.5, 0.2, 0.15, 0.15]))
    ]
    imu = Imu(rate_hz=20.0, bias_radps=float(draw.normal(0.0, 0.005)))
    return Scenario(
        vehicle=vehicle,
        program=Program(
            rate_hz=10.0,
            speed_scale=scale,
            turn_scale=0.9 if kind == "ackermann" else scale,
            step_s=float(draw.choice([3.0, 4.0, 6.0])),
        ),
        duration_s=duration_s,
        seed=seed,
        disturbance=_DISTURBANCE,
        pose=PoseSensor(
            rate_hz=10.0,
            noise_m=noise,
            noise_rad=0.5 * noise,
            noise_z_m=0.0,
            noise_tilt_rad=0.0,
            latency_jitter_s=0.0,
            drift_m=float(draw.choice([0.0, 0.005, 0.015])),
            dropouts=int(draw.integers(0, 3)),
            jumps=int(draw.integers(0, 2)),
        ),
        encoders=Encoders(rate_hz=10.0, report="velocity") if wheels else None,
        imu=imu if gyro else None,
        recording=Recording(_make_layout(vehicle.kind), deployment="absent"),
        start_pose=(0.0, 0.0, float(draw.uniform(-3.0, 3.0))),
    )


def _make_layout(kind: str) -> Any:  # noqa: ANN401 - the simulator's layout, which it does not export
    """The same topics in every log: names and types of the common ROS 2 packages."""
    form, topic = _COMMANDS.get(kind, ("twist_stamped", "/cmd_vel"))
    base = LAYOUTS["ackermann" if kind == "ackermann" else "mecanum"]
    commands = (replace(base.commands[0], form=form, topics=(topic,)),)  # type: ignore[arg-type]
    pose = replace(base.pose, topic="/localization/odometry")
    return replace(base, kind=kind, commands=commands, pose=pose)  # type: ignore[arg-type]


def _choose_effects(kind: str, count: int, scene: Scenario, draw: np.random.Generator) -> list[str]:
    """Names by the simulator, at most one of each family."""
    fitting = [
        known
        for known, name in SIMULATED.items()
        if kind in NAMES[name].get("kinds", _KINDS)
        # A car's steering stands for its yaw rate; without a sensor there is nothing that it differs from.
        and not (kind == "ackermann" and known in {"body_turn_limit", "yaw_drift"})
        and not (scene.encoders is None and known == "steering_sensor_offset")
    ]
    chosen: list[str] = []
    for known in draw.permutation(fitting).tolist():
        families = {NAMES[SIMULATED[other]]["family"] for other in chosen}
        if len(chosen) < count and NAMES[SIMULATED[known]]["family"] not in families:
            chosen.append(known)
    return chosen


def _add_effects(task: Task, chosen: list[str], draw: np.random.Generator) -> Task:
    scene = task.scenario
    asked: dict[str, dict[str, float]] = {}
    hidden: list[Hidden] = []
    for known in chosen:
        if known == "slope_drift":
            tilt, way = math.radians(float(draw.uniform(6.0, 11.0))), float(draw.uniform(0.0, math.tau))
            scene = replace(scene, ground=Ground(tilt * math.cos(way), tilt * math.sin(way)))
        values = _draw_values(known, scene, float(draw.uniform(0.6, 1.1)), draw)
        neutral = {
            name: given.get("neutral") for name, given in NAMES[SIMULATED[known]]["parameters"].items()
        }
        told = neutral | values
        if known == "terrain_change":
            values["at_s"] = told["at_s"] = round(float(draw.uniform(0.35, 0.65)) * task.log_s, 1)
        if known == "time_drift":
            # The simulator's k counts over the held-out stretch, too; the published one over the log.
            values["k"] *= scene.duration_s / task.log_s
        asked[known] = values
        hidden.append(Hidden(SIMULATED[known], told, _list_same(known, scene)))
    return replace(task, scenario=replace(scene, effects=asked), hidden=tuple(hidden))


def _draw_values(known: str, scene: Scenario, share: float, draw: np.random.Generator) -> dict[str, float]:
    if known == "lateral_scale":
        return {"k": 1.0 - 0.2 * share}
    if known == "roller_slip":
        return {"k": 0.3 * share}
    # A car turns a tenth as fast as a small robot: what goes with its turning is drawn larger.
    more = _CAR_SIZES.get(known, 1.0) if scene.vehicle.kind == "ackermann" else 1.0
    return {name: more * float(value) for name, value in draw_size(known, scene, share, draw).items()}


def _list_same(known: str, scene: Scenario) -> tuple[str, ...]:
    """Other names for the same motion, in this log."""
    same = tuple(NAMES[SIMULATED[known]].get("same_as", ()))
    blind = scene.encoders is None and scene.imu is None
    clocks = ("clock_offset", "transport_delay")
    # Poses and commands are all there is: whose clock is off does not show.
    return (
        (*same, *(SIMULATED[other] for other in clocks if other != known))
        if blind and known in clocks
        else same
    )


def _add_outside(task: Task, draw: np.random.Generator) -> Task:
    vehicle = task.scenario.vehicle
    outside = (draw_named if draw.random() < 0.5 else draw_unlisted)(vehicle, draw)
    machinery = outside.machinery
    scene = replace(task.scenario, extra=outside.push, machinery=machinery, ground=outside.ground)
    hidden = (Hidden(outside.name, {**outside.parameters}),) if outside.name else ()
    return replace(
        task,
        scenario=scene,
        hidden=hidden,
        outside=outside,
        tolerated=tuple(SIMULATED[known] for known in outside.tolerated),
    )


def _draw_rigid(name: str, draw: np.random.Generator, seed: int, lengths: Lengths) -> Task:
    vehicle = str(draw.choice(["husky", "warthog"]))
    cause, machine = str(draw.choice(_CAUSES)), MACHINES[vehicle]
    machine = replace(machine, friction=float(draw.uniform(0.4, 0.8)))
    log_s = round(float(draw.uniform(lengths.shortest_s, lengths.longest_s)), 1)
    scene = _draw_scene("skid_steer", draw, seed, log_s + lengths.held_out_s)
    driving = str(draw.choice(["designed", "natural"]))
    scene = replace(
        scene,
        vehicle=VEHICLES[vehicle],
        disturbance=Disturbance(),
        program=replace(
            scene.program,
            name=str(draw.choice(_PROGRAMS[driving])),  # type: ignore[arg-type]
            speed_scale=0.5,
            turn_scale=0.5,
        ),
    )
    hidden, words = [Hidden("effective_track", {"k": None})], "wheels that scrub in every turn"
    size, small = float(draw.uniform(0.8, 1.2)), vehicle == "husky"
    if cause == "payload":
        load, behind = (35.0, 0.15) if small else (250.0, 0.3)
        machine = replace(machine, payload_kg=load * size, payload_x_m=-behind)
        hidden.append(_hide("rotation_centre_forward"))
        words = f"a load of {load * size:.0f} kg {behind} m behind the middle"
    elif cause == "small_wheels":
        machine = replace(machine, left_radius_scale=1.0 - 0.06 * size)
        hidden.append(_hide("wheel_radius_difference"))
        words = f"left wheels {6 * size:.1f} % smaller"
    elif cause == "slope":
        scene = replace(scene, ground=Ground(math.radians(10.0 * size)))
        hidden.append(_hide("downhill_drift"))
        words = f"a slope of {10 * size:.1f} degrees"
    elif cause == "slow_motors":
        # A flywheel: servo and torque stay large, so that the time constant is inertia over stiffness.
        inertia = _SLOW_MOTORS_S * size * machine.servo_nms
        machine = replace(machine, armature_kgm2=inertia, torque_nm=10.0 * machine.torque_nm)
        hidden.append(_hide("drive_lag"))
        words = f"motors with flywheels of {inertia:.0f} kg m^2"
    elif cause == "low_grip":
        machine = replace(machine, friction=0.2)
        words = "little grip"
    tolerated = (
        "other",
        *_BY_CONTACT,
        *(("drive_lag", "wheel_acceleration_limit") if cause == "low_grip" else ()),
    )
    return Task(
        name,
        scene,
        "skid_steer",
        log_s,
        driving,
        tuple(hidden),
        machine=machine,
        tolerated=tolerated,
        cause=words,
    )


def _hide(name: str) -> Hidden:
    """An effect that contact makes: whether it acts is known, its number is not."""
    return Hidden(name, dict.fromkeys(NAMES[name]["parameters"]), tuple(NAMES[name].get("same_as", ())))
