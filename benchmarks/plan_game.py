"""Plans in closed loop: a poor first log, its diagnosis, a plan, a drive of it with the hidden physics.

Each draw hides one to three effects in a simulated vehicle and drives it poorly. The plan is driven by
the simulator, which shares no code with the plan's models; then both logs are diagnosed together. One promise
of each plan, drawn at random, is tested at its own second too: the drive is ended there and diagnosed again.
One line a draw, then the rates. A file of scores that exists is continued: its seeds are not played again.
"""

import argparse
import json
import tempfile
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np
from measuring import add_row, read_rows

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.core import SlipError
from pipeline.estimation import Recording, diagnose_runs
from pipeline.estimation.stored_diagnosis import read_recording
from pipeline.plan import parse_area
from pipeline.plan.next_drive import Wish, plan_drive, study
from pipeline.plan.plan import Plan
from pipeline.plan.plan_files import check_plan, read_plan, write_plan
from pipeline.results import Named
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
_SECONDS = 60.0


@dataclass
class Score:
    """What became of one draw."""

    seed: int
    vehicle: str
    program: str
    truth: list[str]
    first: list[str]
    undecided: list[list[str]]
    promised: int = 0
    kept: int = 0
    intervals: int = 0
    intervals_kept: int = 0
    seconds: int = 0
    seconds_kept: int = 0
    broken: list[str] = field(default_factory=list)
    pairs: int = 0
    decided: int = 0
    joint: list[str] | None = None
    wrong: list[str] | None = None
    left_area: bool = False
    duration_s: float = 0.0
    plan_s: float = 0.0
    cpu_s: float = 0.0
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
    score = Score(seed, name, scenario.program.name, sorted(scenario.effects), [], [])
    try:
        vehicle, before = record(scenario, folder / "before.mcap")
        studied = study([before], vehicle)
        score.first = [effect.id for effect in studied.diagnosis.effects]
        score.undecided = [list(group.candidates) for group in studied.diagnosis.undecided]
        begun = time.perf_counter()
        wish = Wish(
            parse_area(_AREAS.get(name, "20x10m"), vehicle),
            _SECONDS,
            speed_mps=4.0 if name == "car" else None,
        )
        plan = plan_drive(vehicle, studied, wish, [before])
        score.plan_s = round(time.perf_counter() - begun, 1)
        score.duration_s = plan.commands.duration_s
        if plan.manoeuvres:
            _drive(plan, scenario, vehicle, before, folder, score)
    except SlipError as error:
        score.error = str(error)
    return score


def _drive(
    plan: Plan, scenario: Scenario, vehicle: Vehicle, before: Recording, folder: Path, score: Score
) -> None:
    path = write_plan(plan, folder / "plan")[-1]
    stored = read_plan(folder / "plan")
    played = read_played(path, scenario.vehicle)
    driven = replace(
        scenario, played=played, duration_s=float(played.time_s[-1]) + 0.5, seed=scenario.seed + 500_000
    )
    way = simulate_run(driven).truth.path.position
    score.left_area = bool(
        (np.abs(way[:, 0]) > 0.5 * plan.area.length_m).any()
        or (np.abs(way[:, 1]) > 0.5 * plan.area.width_m).any()
    )
    _, after = record(driven, folder / "after.mcap")
    diagnosis = diagnose_runs([before, after], vehicle).runs[0]
    check = check_plan(stored, diagnosis)
    score.promised, score.kept = len(check.answers), sum(one.is_met for one in check.answers)
    widths = [
        one.is_met
        for answer, one in zip(stored.promises, check.answers, strict=True)
        if answer.kind == "interval"
    ]
    score.intervals, score.intervals_kept = len(widths), sum(widths)
    score.broken = [f"{one.question}: {one.measured}" for one in check.answers if not one.is_met]
    score.joint = [effect.id for effect in diagnosis.effects]
    truth = set(score.truth)
    score.wrong = [effect.id for effect in diagnosis.effects if not _is_true(effect, truth)]
    for group in score.undecided:
        if truth & set(group):
            score.pairs += 1
            score.decided += any(_is_true(e, truth & set(group)) for e in diagnosis.effects)
    if stored.promises:
        drawn = np.random.default_rng([score.seed, 23]).integers(len(stored.promises))
        one = stored.promises[int(drawn)]
        _, cut = record(replace(driven, duration_s=one.decided_after_s), folder / "cut.mcap")
        joint = diagnose_runs([before, cut], vehicle).runs[0]
        tested = check_plan(msgspec.structs.replace(stored, promises=[one]), joint).answers[0]
        score.seconds, score.seconds_kept = 1, int(tested.is_met)
        if not tested.is_met:
            score.broken.append(f"after {one.decided_after_s:g} s, {tested.question}: {tested.measured}")


def _is_true(effect: Named, truth: set[str]) -> bool:
    return bool({effect.id, *effect.equivalent_to} & truth)


def record(scenario: Scenario, path: Path) -> tuple[Vehicle, Recording]:
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
        begun = time.process_time()
        with tempfile.TemporaryDirectory(prefix="slip-") as folder:
            score = play(seed, Path(folder))
        score.cpu_s = round(time.process_time() - begun, 1)
        scores.append(score)
        print(json.dumps(asdict(score)), flush=True)
        add_row(asked.out, asdict(score))
    _report(scores)


def _report(scores: list[Score]) -> None:
    driven = [score for score in scores if score.joint is not None]
    print(f"draws {len(scores)}, errors {sum(bool(s.error) for s in scores)}, plans driven {len(driven)}")
    print(f"undecided groups that hold a hidden effect, decided for it: {_rate(driven, 'decided', 'pairs')}")
    print(f"promises kept at the end of the plan: {_rate(driven, 'kept', 'promised')}")
    print(f"of these, intervals: {_rate(driven, 'intervals_kept', 'intervals')}")
    print(f"promises kept at their own second, one a plan: {_rate(driven, 'seconds_kept', 'seconds')}")
    print(f"drives with a wrong name: {sum(bool(s.wrong) for s in driven)} of {len(driven)}")
    print(f"drives that left the area: {sum(s.left_area for s in driven)} of {len(driven)}")
    print(f"slowest plan: {max((s.plan_s for s in scores), default=0.0)} s")
    print(f"CPU a draw: {sum(s.cpu_s for s in scores) / max(len(scores), 1):.1f} s")


def _rate(scores: list[Score], part: str, whole: str) -> str:
    kept, asked = (sum(getattr(score, name) for score in scores) for name in (part, whole))
    return f"{kept} of {asked} ({kept / max(asked, 1):.1%})"
