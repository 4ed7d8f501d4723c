"""Logs whose hidden effects are drawn by seed, and the answers to them.

What is drawn spans what field logs have: vehicles, topic layouts, programs, pose rates and noise, random
motion, drop-outs, jumps, decoys. The generator of the logs shares no code with the estimators. A category and
a seed give the same bytes in every version: drawn logs are what versions of the diagnosis are compared on.
"""

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from game.closed_loop import close_loop
from game.odd import DRAWN, ODD
from game.rigid_bodies import MACHINES, SkidSteer, simulate_skid_steer
from game.sizes import draw_size
from pipeline.simulate import (
    LAYOUTS,
    SLOPE_EFFECTS,
    VEHICLES,
    Disturbance,
    Encoders,
    Ground,
    Imu,
    PoseSensor,
    Program,
    Recording,
    Scenario,
    list_effects,
    simulate_run,
    write_log,
)

Category = Literal[
    "single", "small", "sets", "empty", "poor", "odd", "rigid", "equipped", "cars", "natural", "late",
    "joint", "hills",
]  # fmt: skip
# New ones go last: a category draws by its place.
CATEGORIES: tuple[Category, ...] = (
    "single", "small", "sets", "empty", "poor", "odd", "rigid", "equipped", "cars", "natural", "late",
    "joint", "hills",
)  # fmt: skip

DIFFERENTIAL = (
    "wheel_radius", "wheel_asymmetry", "effective_track", "icr_offset", "icr_lateral", "lateral_skid",
    "speed_slip", "turning_resistance", "slope_creep", "lateral_drift", "yaw_drift", "time_drift",
    "terrain_change", "drive_lag", "turn_lag", "transport_delay", "body_speed_limit", "body_turn_limit",
    "turn_droop", "acceleration_limit", "wheel_speed_limit", "deadband", "body_inertia", "heading_skew",
    "yaw_misalignment", "lever_arm", "clock_offset",
)  # fmt: skip
CAR = ("steering_offset", "steering_gain", "steering_lag", "understeer")
MORE = (
    "steering_sensor_offset", "speed_track", "brake_lag", "reversal_pause", "side_lag", "steering_play",
    "wheel_servo", "drive_gain", "difference_gain", "side_gain", "body_acceleration_limit",
    "turn_acceleration_limit", "grade_load", "wheel_speed_scaling", "contact_friction", "torque_limit",
    "effective_wheelbase", "gain_drift", "steering_rate_limit", "steering_sensor_play",
    "motor_imbalance", "slope_slip", "side_slope_slip", "side_slope_creep", "side_slope_turn",
    "load_droop", "tyre_torsion",
)  # fmt: skip
"""Hidden alone: pools of several effects draw what they always drew."""
EMPTY = ("plain", "jumps", "noisy", "tilted")
# In closed loop, with random motion of its usual size and three times that; asked for by name, too.
CLOSED = ("closed", "closed_rough")
MACHINERY = ("track", "payload", "small_wheels", "slope", "slow_motors", "low_grip")
_CARS = 0.1
_BOTH_AXES = 0.4
_SLOPE = 0.18
"""Standard deviation of the ground's gradient: the steepest slope that a drive of minutes meets is .25."""
_ONLY_CARS = {spec.id for spec in list_effects() if spec.kinds == ("ackermann",)}
# On top of these two an equipped vehicle has one effect more, or nothing.
_EQUIPMENT = ("effective_track", "drive_lag")
_MORE = tuple(name for name in DIFFERENTIAL if name not in {*_EQUIPMENT, "turn_lag"})
_POOR = tuple(name for name in DIFFERENTIAL if name != "slope_creep")
POOLS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("single", "small"), DIFFERENTIAL + CAR + MORE),
    "equipped": (*_MORE, "nothing"),
    "empty": EMPTY + CLOSED,
    "poor": _POOR + CAR,
    "odd": tuple(sorted(ODD)),
    "rigid": MACHINERY,
    "natural": (*DIFFERENTIAL, "nothing"),
    "late": (*(name for name in DIFFERENTIAL if name != "clock_offset"), "nothing"),
    # What changes within a run is no run's like another's.
    "joint": (
        *(name for name in DIFFERENTIAL if name not in {"clock_offset", "terrain_change", "time_drift"}),
        "nothing",
    ),
    "hills": (*SLOPE_EFFECTS, "grade_load", "nothing"),
}
_CAR_SETS = (
    ("drive_lag", "steering_lag"), ("transport_delay", "icr_offset"), ("transport_delay", "understeer"),
    ("understeer", "drive_lag", "steering_lag"), ("steering_offset", "drive_lag"), ("icr_offset",),
    ("steering_lag", "transport_delay"), ("steering_gain", "icr_offset", "drive_lag"),
    ("wheel_radius", "steering_lag"), ("acceleration_limit", "steering_lag"),
    ("understeer", "steering_gain"), ("steering_offset", "icr_offset"),
)  # fmt: skip
# How far ahead of the rear axle base_link stands: a small car's quarter, a sedan's middle [m].
_CAR_MIDDLE_M = (0.3, 1.35)
_NOTHING = 0.4
_BESIDE = (
    (), ("effective_track",), ("effective_track", "drive_lag"), ("effective_track", "transport_delay"),
    ("drive_lag", "icr_offset"), ("wheel_radius", "turn_lag"),
)  # fmt: skip


@dataclass(frozen=True)
class Answer:
    """What a log hides.

    Attributes:
        category: kind of riddle.
        effects: id to parameters, as simulated.
        odd: name of physics that no catalogue has.
        channel: channels that the odd physics acts on.
        program: what was driven.
        note: anything else.
        clocks: how late poses are in each of several runs, against what else the run recorded [s].
    """

    category: str
    effects: dict[str, dict[str, float]] = field(default_factory=dict)
    odd: str = ""
    channel: str = ""
    program: str = ""
    note: str = ""
    clocks: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Riddle:
    """A scenario to simulate with its answer; `more` are further runs of the vehicle."""

    scenario: Scenario
    answer: Answer
    machine: SkidSteer | None = None
    more: tuple[Scenario, ...] = ()


def draw_riddle(category: Category, seed: int, effect: str | None = None, *, closed: bool = False) -> Riddle:
    """The riddle of a seed.

    Args:
        category: kind of riddle.
        seed: from which everything is drawn.
        effect: one of the category's `POOLS`: the effect, the kind of empty log, the odd physics, the
            machine; drawn when None.
        closed: driven by a controller that follows way points, where the category leaves the driving open.
    """
    maker: dict[Category, Callable[[np.random.Generator, int, str | None], Riddle]] = {
        "single": partial(_draw_single, category="single", share=1.0),
        "small": partial(_draw_single, category="small", share=0.4),
        "equipped": _draw_equipped,
        "sets": lambda g, s, _e: _draw_set(g, s),
        "empty": _draw_empty,
        "poor": _draw_poor,
        "odd": _draw_odd,
        "rigid": _draw_rigid,
        "cars": lambda g, s, _e: _draw_cars(g, s),
        "natural": _draw_natural,
        "late": _draw_late,
        "joint": _draw_joint,
        "hills": _draw_hills,
    }
    if effect is None:
        generator = np.random.default_rng([CATEGORIES.index(category), seed])
        riddle = maker[category](generator, seed, None)
    else:
        # Logs of one seed must share no noise, or many effects on few seeds would count as many logs.
        generator = np.random.default_rng([CATEGORIES.index(category), seed, zlib.crc32(effect.encode())])
        riddle = maker[category](generator, int(generator.integers(2**31)), effect)
    return _close(riddle, generator) if closed else riddle


def _close(riddle: Riddle, draw: np.random.Generator) -> Riddle:
    """The riddle driven in closed loop; as it is where its driving is the riddle, and on cars."""
    fixed = riddle.machine is not None or riddle.answer.category == "poor"
    if fixed or riddle.scenario.vehicle.kind != "differential" or riddle.scenario.played is not None:
        return riddle
    scene, *further = (close_loop(one, draw) for one in (riddle.scenario, *riddle.more))
    return Riddle(scene, replace(riddle.answer, program="closed loop"), more=tuple(further))


def write_riddle(riddle: Riddle, path: Path) -> list[Path]:
    """Simulate and record a riddle, its further runs beside it.

    Returns:
        The logs; nothing of the answer is in them.
    """
    if riddle.machine is None:
        run = simulate_run(riddle.scenario)
    else:
        run = simulate_skid_steer(riddle.scenario, riddle.machine)
    paths = [path, *(path.with_stem(f"{path.stem}_{n}") for n in range(1, len(riddle.more) + 1))]
    for made, log in zip((run, *map(simulate_run, riddle.more)), paths, strict=True):
        write_log(made, log)
    return paths


def _draw_scene(draw: np.random.Generator, seed: int, effect: str | None = None) -> Scenario:
    """Everything but the riddle itself."""
    car = effect in _ONLY_CARS or (
        effect in {"drive_lag", "wheel_radius", "time_drift"} and draw.random() < _CARS
    )
    name = "car" if car else str(draw.choice(["husky", "husky", "warthog", "jackal", "marmotte"]))
    vehicle = VEHICLES[name]
    layouts = [key for key, item in LAYOUTS.items() if item.kind == vehicle.kind]
    layout = str(draw.choice(layouts))
    program = str(draw.choice(["drive_steps", "drive_steps", "smooth", "teleop", "stop_and_go"]))
    scale = 0.6 if name in {"warthog", "car"} else 1.0
    rate = float(draw.choice([20.0, 20.0, 50.0, 100.0]))
    noise = float(draw.choice([0.001, 0.003, 0.01]))
    return Scenario(
        vehicle=vehicle,
        program=Program(
            program,  # type: ignore[arg-type]
            rate_hz=float(draw.choice([10.0, 20.0, 50.0])),
            speed_scale=scale,
            turn_scale=scale,
            step_s=float(draw.choice([3.0, 4.0, 6.0])),
            jitter_s=float(draw.choice([0.0, 0.005])),
        ),
        duration_s=float(draw.choice([120.0, 180.0, 300.0, 600.0], p=[0.3, 0.3, 0.3, 0.1])),
        seed=seed,
        disturbance=Disturbance(0.03, 0.05),
        pose=PoseSensor(
            rate_hz=rate,
            noise_m=noise,
            noise_rad=0.5 * noise,
            noise_z_m=noise,
            noise_tilt_rad=0.25 * noise,
            drift_m=float(draw.choice([0.0, 0.005, 0.015])),
            drift_rad=float(draw.choice([0.0, 0.003])),
            jitter_s=float(draw.choice([0.0, 0.004])),
            latency_s=0.05,
            latency_jitter_s=0.005,
            dropouts=int(draw.integers(0, 4)),
            jumps=int(draw.integers(0, 3)),
        ),
        encoders=Encoders(),
        imu=Imu(bias_radps=float(draw.normal(0.0, 0.005)), sign=int(draw.choice([1, 1, 1, -1]))),  # type: ignore[arg-type]
        recording=Recording(layout, decoys=str(draw.choice(["none", "odometry", "both"]))),  # type: ignore[arg-type]
        start_pose=(0.0, 0.0, float(draw.uniform(-3.0, 3.0))),
    )


def _draw_single(
    draw: np.random.Generator, seed: int, effect: str | None, *, category: str, share: float
) -> Riddle:
    chosen = effect or str(draw.choice(DIFFERENTIAL + CAR))
    scene = _excite(_draw_scene(draw, seed, chosen), chosen, draw)
    # Motors differ where a servo drives them.
    names = (chosen, "wheel_servo") if chosen == "motor_imbalance" else (chosen,)
    asked = {name: draw_size(name, scene, share, draw) for name in names}
    return Riddle(replace(scene, effects=asked), Answer(category, asked, program=scene.program.name))


def _excite(scene: Scenario, effect: str, draw: np.random.Generator) -> Scenario:
    """What an effect needs to show at all: a slope, or both directions."""
    if effect in {*SLOPE_EFFECTS, "grade_load"}:
        tilt = math.radians(float(draw.uniform(6.0, 11.0)))
        way = float(draw.uniform(0.0, 2.0 * math.pi))
        scene = replace(scene, ground=Ground(tilt * math.cos(way), tilt * math.sin(way)))
    if effect in {"terrain_change", "time_drift", "gain_drift"}:
        scene = replace(scene, duration_s=max(scene.duration_s, 240.0))
    return scene


def _draw_set(draw: np.random.Generator, seed: int) -> Riddle:
    pools = (
        ("effective_track", "drive_lag"), ("drive_lag", "lateral_skid"), ("effective_track", "turn_lag"),
        ("effective_track", "icr_offset", "drive_lag"), ("body_inertia", "effective_track"),
        ("transport_delay", "effective_track"), ("yaw_misalignment", "effective_track"),
        ("speed_slip", "turning_resistance"), ("wheel_asymmetry", "lateral_drift"),
        ("body_turn_limit", "drive_lag", "effective_track"), ("wheel_radius", "transport_delay"),
        ("acceleration_limit", "effective_track"), ("deadband", "effective_track", "icr_offset"),
        ("heading_skew", "effective_track"), ("yaw_drift", "icr_lateral", "drive_lag"),
        ("slope_creep", "effective_track"), ("lever_arm", "effective_track", "transport_delay"),
        ("turning_resistance", "effective_track", "turn_lag"),
    )  # fmt: skip
    names = pools[int(draw.integers(len(pools)))]
    scene = _draw_scene(draw, seed)
    for name in names:
        scene = _excite(scene, name, draw)
    asked = {name: draw_size(name, scene, float(draw.uniform(0.7, 1.0)), draw) for name in names}
    return Riddle(replace(scene, effects=asked), Answer("sets", asked, program=scene.program.name))


def _draw_equipped(draw: np.random.Generator, seed: int, effect: str | None) -> Riddle:
    """A vehicle that already has effective track and drive lag, and one thing more, or nothing."""
    chosen = effect or str(draw.choice(_MORE))
    scene = _excite(_draw_scene(draw, seed), chosen, draw)
    asked = {
        "effective_track": {"k": float(draw.uniform(1.4, 1.9))},
        "drive_lag": {"tau": float(draw.uniform(0.3, 0.7))},
    }
    if chosen != "nothing":
        asked[chosen] = draw_size(chosen, scene, 1.0, draw)
    answer = Answer("equipped", asked, program=scene.program.name, note=chosen)
    return Riddle(replace(scene, effects=asked), answer)


def _draw_empty(draw: np.random.Generator, seed: int, effect: str | None) -> Riddle:
    car = CAR[0] if draw.random() < _CARS else None
    scene = _draw_scene(draw, seed, car)
    kind = effect or str(draw.choice(EMPTY))
    if kind == "jumps":
        scene = replace(scene, pose=replace(scene.pose, jumps=6))
    elif kind == "noisy":
        scene = replace(scene, pose=replace(scene.pose, rate_hz=10.0, noise_m=0.02, noise_rad=0.01))
    elif kind == "tilted":
        scene = replace(scene, ground=Ground(math.radians(7.0), math.radians(-4.0)))
    elif kind in CLOSED:
        rough = 1.0 if kind == "closed" else 3.0
        scene = _draw_scene(draw, seed)
        scene = replace(scene, disturbance=Disturbance(0.03 * rough, 0.05 * rough))
        scene = close_loop(replace(scene, duration_s=float(draw.uniform(60.0, 120.0))), draw)
    return Riddle(scene, Answer("empty", program=scene.program.name, note=kind))


def _draw_poor(draw: np.random.Generator, seed: int, effect: str | None) -> Riddle:
    chosen = effect or str(draw.choice(_POOR))
    scene = _draw_scene(draw, seed, chosen if chosen in CAR else None)
    # A car cannot spin on the spot.
    ways = ["straight", "circle"] if scene.vehicle.kind == "ackermann" else ["straight", "circle", "spins"]
    program = str(draw.choice(ways))
    scene = replace(scene, program=replace(scene.program, name=program))  # type: ignore[arg-type]
    size = draw_size(chosen, scene, 1.0, draw)
    if program == "circle" and "limit" in size:
        # The circle asks for six tenths of everything: a limit beyond it would hide nothing at all.
        size = {"limit": 0.6 * size["limit"]}
    asked = {chosen: size}
    return Riddle(replace(scene, effects=asked), Answer("poor", asked, program=program))


def _draw_odd(draw: np.random.Generator, seed: int, effect: str | None) -> Riddle:
    name = effect or str(draw.choice(DRAWN))
    odd = ODD[name]
    scene = _draw_scene(draw, seed)
    scene = replace(
        scene,
        extra=odd.make(scene.vehicle) if odd.make else None,
        machinery=partial(odd.drive, scene.vehicle) if odd.drive else None,
        ground=odd.ground,
        duration_s=max(scene.duration_s, 180.0),
    )
    answer = Answer("odd", odd=name, channel=odd.channels, program=scene.program.name)
    return Riddle(scene, answer)


def _draw_cars(draw: np.random.Generator, seed: int) -> Riddle:
    """Cars: one to three effects, of timing above all; many record neither encoders nor a gyro."""
    names = _CAR_SETS[int(draw.integers(len(_CAR_SETS)))]
    scene = _draw_scene(draw, seed, CAR[0])
    asked = {name: draw_size(name, scene, float(draw.uniform(0.7, 1.0)), draw) for name in names}
    if "icr_offset" in asked:
        asked["icr_offset"] = {"x_icr": -float(draw.uniform(*_CAR_MIDDLE_M))}
    sensors = str(draw.choice(["all", "no encoders", "poses only"]))
    if sensors != "all":
        scene = replace(scene, encoders=None, imu=scene.imu if sensors == "no encoders" else None)
    answer = Answer("cars", asked, program=scene.program.name, note=sensors)
    return Riddle(replace(scene, effects=asked), answer)


def _draw_natural(draw: np.random.Generator, seed: int, effect: str | None) -> Riddle:
    """A minute or two of driving as people drive, over ground that moves the vehicle at random."""
    chosen = effect or _draw_one_or_none(draw, POOLS["natural"])
    scene = _draw_scene(draw, seed)
    rough = float(draw.choice([1.0, 3.0]))
    scene = replace(
        scene,
        program=replace(scene.program, name=str(draw.choice(["smooth", "teleop", "stop_and_go"]))),  # type: ignore[arg-type]
        disturbance=Disturbance(0.03 * rough, 0.05 * rough),
    )
    asked = {} if chosen == "nothing" else {chosen: draw_size(chosen, scene, 1.0, draw)}
    scene = _excite(scene, chosen, draw)
    scene = replace(scene, duration_s=float(draw.uniform(60.0, 120.0)), effects=asked)
    return Riddle(scene, Answer("natural", asked, program=scene.program.name, note=f"rough {rough:g}"))


def _draw_late(draw: np.random.Generator, seed: int, effect: str | None) -> Riddle:
    """Poses that are late, wander, and are repeated until the next scan is through."""
    chosen = effect or _draw_one_or_none(draw, POOLS["late"])
    scene = _excite(_draw_scene(draw, seed), chosen, draw)
    asked = {} if chosen == "nothing" else {chosen: draw_size(chosen, scene, 1.0, draw)}
    asked["clock_offset"] = {"d": float(draw.uniform(0.1, 0.4))}
    pose = replace(scene.pose, rate_hz=20.0, update_hz=float(draw.choice([5.0, 10.0])), drift_m=0.02)
    scene = replace(scene, pose=pose, effects=asked)
    return Riddle(scene, Answer("late", asked, program=scene.program.name, note=chosen))


def _draw_joint(draw: np.random.Generator, seed: int, effect: str | None) -> Riddle:
    """Two to four runs of one vehicle without a gyro, the clock of each set anew."""
    chosen = effect or _draw_one_or_none(draw, POOLS["joint"])
    scene = replace(_excite(_draw_scene(draw, seed), chosen, draw), imu=None, duration_s=120.0)
    asked = {} if chosen == "nothing" else {chosen: draw_size(chosen, scene, 1.0, draw)}
    clocks = [round(float(late), 3) for late in draw.uniform(-0.05, 0.3, int(draw.integers(2, 5)))]
    scenes = [
        replace(
            scene,
            seed=seed + 1_000_000 * number,
            program=replace(scene.program, name=str(draw.choice(["drive_steps", "smooth", "teleop"]))),  # type: ignore[arg-type]
            start_pose=(0.0, 0.0, float(draw.uniform(-3.0, 3.0))),
            effects={**asked, "clock_offset": {"d": late}},
        )
        for number, late in enumerate(clocks)
    ]
    # Without encoders and odometry a clock and the drive's delay are one number.
    layout = LAYOUTS[scene.recording.layout]
    told = scene.recording.decoys != "none" or any("wheels" in row.values() for row in layout.topics)
    alike = 0.0 if told else asked.get("transport_delay", {}).get("d", 0.0)
    seen = [late + alike for late in clocks]
    asked["clock_offset"] = {"d": seen[0]}
    answer = Answer("joint", asked, program=scenes[0].program.name, note=chosen, clocks=seen)
    return Riddle(scenes[0], answer, more=tuple(scenes[1:]))


def _draw_hills(draw: np.random.Generator, seed: int, effect: str | None) -> Riddle:
    """Hills of up to a quarter of slope, and what gravity does there, along or across the body or both."""
    chosen = effect or str(draw.choice(POOLS["hills"]))
    scene = _draw_scene(draw, seed)
    program = str(draw.choice(["smooth", "teleop", "stop_and_go", "drive_steps", "slalom"]))
    length = float(draw.uniform(12.0, 30.0))
    names = [chosen, *_BESIDE[int(draw.integers(len(_BESIDE)))]]
    other = {"slope_slip": "side_slope_slip", "slope_creep": "side_slope_creep"}.get(chosen)
    if other is not None and draw.random() < _BOTH_AXES:
        names.append(other)
    scene = replace(
        scene,
        program=replace(scene.program, name=program),  # type: ignore[arg-type]
        duration_s=180.0,
        ground=Ground(hill_m=_SLOPE * length / (2.0 * math.pi), hill_length_m=length),
    )
    sensors = str(draw.choice(["all", "no encoders"]))
    if sensors != "all":
        scene = replace(scene, encoders=None)
    asked = {name: draw_size(name, scene, 1.0, draw) for name in names if name != "nothing"}
    answer = Answer("hills", asked, program=program, note=f"{chosen}, {sensors}")
    return Riddle(replace(scene, effects=asked), answer)


def _draw_one_or_none(draw: np.random.Generator, pool: tuple[str, ...]) -> str:
    """One of a pool, or nothing as often as a log of the field may have nothing to find."""
    return "nothing" if draw.random() < _NOTHING else str(draw.choice(pool[:-1]))


def _draw_rigid(draw: np.random.Generator, seed: int, effect: str | None) -> Riddle:
    kind = effect or str(draw.choice(MACHINERY))
    scene = _draw_scene(draw, seed)
    name = str(draw.choice(["husky", "warthog"]))
    machine = MACHINES[name]
    layouts = [key for key, item in LAYOUTS.items() if item.kind == "differential"]
    scene = replace(
        scene,
        vehicle=VEHICLES[name],
        recording=replace(scene.recording, layout=str(draw.choice(layouts))),
        duration_s=150.0,
        disturbance=Disturbance(),
        program=replace(scene.program, name="drive_steps", speed_scale=0.5, turn_scale=0.5),
    )
    # What makes bodies on rigid wheels turn less and follow late is friction in four contacts.
    expected: dict[str, dict[str, float]] = {"contact_friction": {}}
    if kind == "payload":
        load = 35.0 if name == "husky" else 250.0
        machine = replace(machine, payload_kg=load, payload_x_m=-0.15 if name == "husky" else -0.3)
        expected["icr_offset"] = {}
    elif kind == "small_wheels":
        machine = replace(machine, left_radius_scale=0.94)
        expected["wheel_asymmetry"] = {}
    elif kind == "slope":
        scene = replace(scene, ground=Ground(math.radians(10.0)))
        expected |= {"slope_creep": {}, "side_slope_creep": {}}
    elif kind == "slow_motors":
        scene = replace(scene, effects={"drive_lag": {"tau": 0.5}})
        expected["drive_lag"] = {"tau": 0.5}
    elif kind == "low_grip":
        machine = replace(machine, friction=0.2)
    return Riddle(scene, Answer("rigid", expected, note=kind, program="drive_steps"), machine)
