"""Plans in closed loop: a poor first log, its plan, a drive of it with the hidden physics, and the check.

Each draw hides one to three effects in a simulated vehicle and drives it poorly. The plan is driven by the
simulator, which shares no code with the plan's models; then both logs are diagnosed together. Printed are the
promised and the reached half-width of every interval, what else was promised, and how much of it was kept. A
file of scores that exists is continued: its seeds are not played again.
"""

import argparse
import json
import tempfile
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
from measuring import add_row, read_rows

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.core import SlipError
from pipeline.estimation import DiagnosisInput, diagnose_runs
from pipeline.estimation.stored_diagnosis import read_recording
from pipeline.plan import (
    check_plan,
    choose_limits,
    choose_topic,
    make_plan,
    parse_area,
    read_plan,
    study,
    write_plan,
)
from pipeline.simulate import (
    Disturbance,
    PoseSensor,
    Program,
    Scenario,
    find_vehicle,
    make_scenario,
    simulate_run,
    write_log,
)
from pipeline.simulate.programs import read_played
from pipeline.sources import Vehicle

VEHICLES = ("husky", "jackal", "marmotte", "car")
# What a plan on level ground can show; sizes are the simulator's usual ones times 0.7 to 1.3.
DIFFERENTIAL = (
    "effective_track", "icr_offset", "lateral_skid", "wheel_asymmetry", "drive_lag", "transport_delay",
    "body_inertia", "yaw_misalignment", "lateral_drift", "turning_resistance", "acceleration_limit",
    "deadband",
)  # fmt: skip
CAR = ("steering_offset", "steering_gain", "steering_lag", "understeer", "drive_lag", "lateral_skid")
PROGRAMS = ("straight", "circle", "smooth")
_AREAS = {"car": "80x60m"}
_CAR_MPS = 4.0
_SECONDS = 60.0


@dataclass
class Score:
    """What became of one draw: its promises with their outcomes, and whether the drive left its area."""

    seed: int
    vehicle: str
    truth: list[str]
    promises: list[dict[str, object]] = field(default_factory=list)
    left_area: bool = False
    duration_s: float = 0.0
    error: str = ""


def draw_scenario(seed: int) -> tuple[str, Scenario]:
    """A vehicle with hidden effects, driven poorly for half a minute."""
    generator = np.random.default_rng([seed, 17])
    name = str(generator.choice(VEHICLES))
    pool = CAR if name == "car" else DIFFERENTIAL
    ids = generator.choice(pool, size=int(generator.integers(1, 4)), replace=False).tolist()
    scenario = make_scenario(None, {i: {} for i in ids}, seed=seed, duration_s=30.0, vehicle=name)
    effects = {
        i: {
            key: value * float(generator.uniform(0.7, 1.3)) if value != 1.0 else value
            for key, value in values.items()
        }
        if isinstance(values, dict)
        else values
        for i, values in scenario.effects.items()
    }
    program = Program(str(generator.choice(PROGRAMS)), speed_scale=0.4, turn_scale=0.4)  # type: ignore[arg-type]
    noise = float(generator.uniform(0.002, 0.006))
    return name, replace(
        scenario,
        effects=effects,
        program=program,
        pose=PoseSensor(noise_m=noise, noise_rad=0.5 * noise),
        disturbance=Disturbance(0.01 * find_vehicle(name).max_speed_mps, 0.005, 0.5),
    )


def play(seed: int, folder: Path) -> Score:
    """One draw, from the poor log to the joint diagnosis."""
    name, scenario = draw_scenario(seed)
    score = Score(seed, name, sorted(scenario.effects))
    try:
        vehicle, before = record(scenario, folder / "before.mcap")
        studied = study([before], vehicle)
        limits = choose_limits(vehicle, studied.largest, speed_mps=_CAR_MPS if name == "car" else None)
        area = parse_area(_AREAS.get(name, "20x10m"), vehicle)
        plan = make_plan(studied, limits, area, _SECONDS, choose_topic(vehicle))
        if not plan.manoeuvres:
            return score
        score.duration_s = plan.commands.duration_s
        played = read_played(write_plan(plan, folder / "plan")[-1], scenario.vehicle)
        seconds = float(played.time_s[-1]) + 0.5
        driven = replace(scenario, played=played, duration_s=seconds, seed=seed + 500_000)
        way = simulate_run(driven).truth.path.position
        score.left_area = not replace(area, margin_m=0.0).holds(way[:, 0] + 1j * way[:, 1])
        _, after = record(driven, folder / "after.mcap")
        check = check_plan(read_plan(folder / "plan"), diagnose_runs([before, after], vehicle).runs[0])
        score.promises = [*check.outcomes]
    except SlipError as error:
        score.error = str(error)
    return score


def record(scenario: Scenario, path: Path) -> tuple[Vehicle, DiagnosisInput]:
    """Simulate a run, analyze it, and give it as it is diagnosed."""
    write_log(simulate_run(scenario), path)
    options = Options(out=path.parent / "results", report=False, diagnosis=False)
    return read_recording(analyze_log(path, options).manifest)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--draws", type=int, default=12)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path)


def run(asked: argparse.Namespace) -> None:
    """Play and count."""
    scores = [Score(**row) for row in read_rows(asked.out)]
    known = {score.seed for score in scores}
    for seed in range(asked.seed, asked.seed + asked.draws):
        if seed in known:
            continue
        with tempfile.TemporaryDirectory(prefix="slip-") as folder:
            scores.append(play(seed, Path(folder)))
        print(json.dumps(asdict(scores[-1])), flush=True)
        add_row(asked.out, asdict(scores[-1]))
    promises = [one for score in scores for one in score.promises]
    intervals = [one for one in promises if "±" in str(one["promised"])]
    driven = [score for score in scores if score.duration_s]
    print(f"draws {len(scores)}, errors {sum(bool(s.error) for s in scores)}, plans driven {len(driven)}")
    for title, those in (("promises", promises), ("of these, intervals", intervals)):
        print(f"{title} kept: {sum(bool(one['kept']) for one in those)} of {len(those)}")
    print(f"drives that left the area: {sum(score.left_area for score in driven)} of {len(driven)}")
