"""Seconds until a question is answered: plans against DRIVE's random steps, figure eights and a person.

    python benchmarks/plan_compare.py [--seeds 3] [--seed 1] [--out times.jsonl]

The same simulated vehicle with the same hidden effects, poses and noise is driven by each protocol for 150 s,
without encoders and gyro. A target is answered at the second of the log from which it stays answered: track
and lag when both intervals are within 5 %; a pair when the loss on unseen data tells the hidden effect from
its rival with t = 5. Plans know the vehicle and the noise of a slow first log of half a minute, no number of
any effect; they are played again and again. `plan` may ask for steps as DRIVE does, `gentle` has the usual
limits of `slip plan`. One line a target, then medians; a target that 150 s do not answer counts as longer
than any, and as 150 s in the ratio, which is the median over all draws.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from json_lines import add_row, read_rows
from plan_game import record

from pipeline.estimation import Input, Problem, fit_model, load_recording
from pipeline.estimation.acceptance import grow_evidence
from pipeline.estimation.error_regions import Curve, find_goal, last_until, narrow_intervals
from pipeline.estimation.evidence import learn_noise, tile_windows
from pipeline.estimation.parts import count_seconds
from pipeline.models import Model, find_effect
from pipeline.plan import LEAD_S, RATE_HZ, choose_limits, parse_area
from pipeline.plan.plan import Request, find_largest, make_plan
from pipeline.plan.questions import DECIDED_T, Question, Separation, ask_numbers
from pipeline.plan.rehearsal import assume, learn
from pipeline.simulate import (
    Disturbance,
    PoseSensor,
    Program,
    Scenario,
    make_scenario,
)
from pipeline.simulate.programs import Commands

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.estimation.parts import Part
    from pipeline.plan.rehearsal import Knowledge
    from pipeline.sources import Vehicle

VEHICLES = ("husky", "jackal", "marmotte")
NUMBERS = ("effective_track", "drive_lag")
# The hidden effect first.
PAIRS = (
    ("lateral_skid", "yaw_misalignment"),
    ("icr_offset", "lateral_skid"),
    ("drive_lag", "transport_delay"),
    ("turning_resistance", "effective_track"),
    ("drive_lag", "acceleration_limit"),
)
PROTOCOLS = ("plan", "gentle", "DRIVE", "eights", "human")
_DURATION_S = 150.0
_PLAN_S = 60.0
_AREA = "100x100m"


def draw_scenario(name: str, hidden: tuple[str, ...], seed: int) -> Scenario:
    """A vehicle with hidden effects of 0.7 to 1.3 times their usual size."""
    generator = np.random.default_rng([seed, 31])
    scenario = make_scenario(None, {i: {} for i in hidden}, seed=seed, duration_s=_DURATION_S, vehicle=name)
    effects = {
        i: {key: value * float(generator.uniform(0.7, 1.3)) for key, value in values.items()}
        for i, values in scenario.effects.items()
        if not isinstance(values, float)
    }
    noise = float(generator.uniform(0.002, 0.006))
    return replace(
        scenario,
        effects=effects,
        encoders=None,
        imu=None,
        pose=PoseSensor(noise_m=noise, noise_rad=0.5 * noise),
        disturbance=Disturbance(
            0.02 * scenario.vehicle.max_speed_mps, 0.05 * scenario.vehicle.max_turn_radps, 0.5
        ),
    )


def drive(protocol: str, scenario: Scenario, asked: tuple[str, ...], *, pair: bool) -> Scenario:
    """The scenario driven by a protocol."""
    if protocol == "DRIVE":
        return replace(scenario, program=Program("drive_steps"))
    if protocol == "human":
        return replace(scenario, program=Program("teleop"))
    time: NDArray[np.float64] = np.arange(round(_DURATION_S * RATE_HZ)) / RATE_HZ
    if protocol == "eights":
        vehicle = scenario.vehicle
        rate = 0.5 * vehicle.max_turn_radps
        side = np.where((time // (2.0 * np.pi / rate)) % 2 == 0, 1.0, -1.0)
        return replace(
            scenario, played=Commands(time, np.full(time.size, 0.5 * vehicle.max_speed_mps), side * rate)
        )
    speed, turn = _plan(scenario, asked, pair=pair, gentle=protocol == "gentle")
    return replace(scenario, played=Commands(time, np.resize(speed, time.size), np.resize(turn, time.size)))


def _plan(
    scenario: Scenario, asked: tuple[str, ...], *, pair: bool, gentle: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Commands of a plan that knows the vehicle and the question, and nothing of the hidden numbers."""
    knowledge = _listen(scenario)
    preset = knowledge.vehicle
    limits = choose_limits(
        preset, speed_mps=scenario.vehicle.max_speed_mps, yaw_rate_radps=scenario.vehicle.max_turn_radps
    )
    if not gentle:
        limits = replace(
            limits,
            acceleration_mps2=RATE_HZ * limits.speed_mps,
            turn_rate=RATE_HZ * limits.turn,
            lateral_mps2=math.inf,
        )
    largest = find_largest(knowledge, limits, _PLAN_S)
    usual = [find_effect(name)().make_usual(largest) for name in asked]
    questions: list[Question]
    if pair:
        questions = [
            Separation(
                " or ".join(asked), asked, (knowledge.suppose(usual[:1]), knowledge.suppose(usual[1:]))
            )
        ]
    else:
        questions = list(ask_numbers(knowledge.suppose(usual)))
    plan = make_plan(knowledge, questions, Request(limits, parse_area(_AREA, preset), _PLAN_S))
    # Played again, it does not stand still again.
    moving = slice(round(LEAD_S * RATE_HZ), None)
    return plan.commands.speed[moving], plan.commands.turn[moving]


def _listen(scenario: Scenario) -> Knowledge:
    """What is known before: the vehicle, and how noisy its poses and its ground are."""
    slow = Program("smooth", speed_scale=0.4, turn_scale=0.4)
    first = replace(scenario, program=slow, duration_s=30.0, seed=scenario.seed + 500_000)
    with tempfile.TemporaryDirectory(prefix="slip-") as folder:
        vehicle, recording = record(first, Path(folder) / "first.mcap")
        learned = learn(
            [load_recording(recording, vehicle)], vehicle, [find_effect(name)() for name in scenario.effects]
        )
    return replace(assume(vehicle), noise=learned.noise)


def measure(scenario: Scenario, asked: tuple[str, ...], folder: Path, *, pair: bool) -> float:
    """Seconds since driving began until the question stays answered; infinite where it is not."""
    vehicle, recording = record(scenario, folder / "log.mcap")
    problem = Problem([load_recording(recording, vehicle)], vehicle, Input.COMMAND)
    if pair:
        return _time_pair(problem, vehicle, asked)
    fitted = fit_model(problem, Model(problem.vehicle, tuple(find_effect(name)() for name in asked)))
    curves = narrow_intervals(fitted)
    state = fitted.state
    times = []
    for effect in state.effects:
        for name, value in effect.values.items():
            curve = curves.get(f"{effect.id}.{name}")
            if curve is not None:
                times.append(last_until(curve, find_goal(effect.id, name, value)))
    return _find_elapsed(problem.whole, max(times))


def _find_elapsed(part: Part, driven_s: float) -> float:
    """Time on the log's clock [s] when so much has been driven: standing still counts as well."""
    if math.isinf(driven_s):
        return driven_s
    at = np.searchsorted(np.cumsum(count_seconds(part)), driven_s - 1e-6)
    return float(part.times[at, 1] - part.times[0, 0])


def _time_pair(problem: Problem, vehicle: Vehicle, asked: tuple[str, ...]) -> float:
    part = problem.whole
    fits = [fit_model(problem, Model(vehicle, (find_effect(name)(),))).fits[0] for name in asked]
    tiles = tile_windows(part)
    noise = learn_noise(tiles, part.channels, fits[0].residual[tiles.rows])
    seconds, t = grow_evidence(part, noise, fits[1].residual, fits[0].residual)
    return _find_elapsed(part, last_until(Curve(seconds, -t), -DECIDED_T))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = read_rows(options.out)
    known = {(row["seed"], row["vehicle"], row["target"]) for row in rows}
    for seed in range(options.seed, options.seed + options.seeds):
        for vehicle in VEHICLES:
            for asked in (NUMBERS, *PAIRS):
                pair = asked in PAIRS
                target = " or ".join(asked) if pair else "track and lag to 5 %"
                if (seed, vehicle, target) in known:
                    continue
                row: dict[str, object] = {"seed": seed, "vehicle": vehicle, "target": target}
                for protocol in PROTOCOLS:
                    scenario = draw_scenario(vehicle, asked[:1] if pair else asked, seed)
                    with tempfile.TemporaryDirectory(prefix="slip-") as folder:
                        driven = drive(protocol, scenario, asked, pair=pair)
                        row[protocol] = round(measure(driven, asked, Path(folder), pair=pair), 1)
                rows.append(row)
                print(json.dumps(row), flush=True)
                add_row(options.out, row)
    report(rows)


def report(rows: list[dict[str, object]]) -> None:
    """Print medians by target, and how many times longer DRIVE takes than the plan."""
    targets = list(dict.fromkeys(str(row["target"]) for row in rows))
    print(
        f"{'median seconds':<40}{'draws':>6}" + "".join(f"{name:>9}" for name in PROTOCOLS) + "  DRIVE/plan"
    )
    for target in [*targets, "all"]:
        mine = [row for row in rows if target in {"all", row["target"]}]
        times = {name: np.array([float(str(row[name])) for row in mine]) for name in PROTOCOLS}
        told = "".join(f"{_say(float(np.median(times[name]))):>9}" for name in PROTOCOLS)
        drive, plan = (np.minimum(times[name], _DURATION_S) for name in ("DRIVE", "plan"))
        print(f"{target:<40}{len(mine):>6}{told}  {np.median(drive / plan):.1f}")
    open_ = {name: sum(math.isinf(float(str(row[name]))) for row in rows) for name in PROTOCOLS}
    print(
        f"not answered in {_DURATION_S:g} s: {', '.join(f'{name} {count}' for name, count in open_.items())}"
    )


def _say(value: float) -> str:
    return f"{value:.1f}" if math.isfinite(value) else f">{_DURATION_S:g}"


if __name__ == "__main__":
    main()
