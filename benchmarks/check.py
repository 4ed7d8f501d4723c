"""Does `slip check` keep its word: false alarms, the power that it states, and the cause that it names.

- `null`: pairs of drawn logs of one vehicle without a change, a third each in closed loop, driven naturally,
  and with effects; each log is diagnosed as `slip check` would. Printed is how many pairs raise an alarm.
- `power`: pools of runs of one vehicle whose numbers differ from run to run as the catalogue declares; groups
  drawn from them are checked under the vehicle's model. Printed is the share of groups in which the cause is
  found, beside what the check says of itself, for five causes at four sizes; and the false alarms.
- `causes`: tyres, payload and a controller changed between four runs a side, the first of each diagnosed.
- `real`: recordings of ../shared/logs from a results folder with diagnoses: quarters of each against each
  other, and recordings of one vehicle on one ground. Printed are alarms and how much errors differ.
"""

import argparse
import itertools
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from measuring import add_row, read_rows

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "fixtures"))

from game.closed_loop import close_loop
from game.draw import draw_riddle
from motion_runs import as_run, make_scenario, tables_of, vehicle_of

from pipeline.core import SlipError
from pipeline.datasets.changes import AFTER, BEFORE
from pipeline.datasets.check import Check, compare, find_usual_spread
from pipeline.datasets.check_readings import ERRORS, RunReading
from pipeline.datasets.check_sides import Sides, read_under, unite_effects
from pipeline.estimation import Recording, diagnose_runs
from pipeline.estimation.stored_diagnosis import find_diagnosis
from pipeline.models.catalogue import find_effect
from pipeline.models.model import Model
from pipeline.models.model_file import ModelFile
from pipeline.results.reading import read_model
from pipeline.run import MotionRun, load_motion_run, load_run
from pipeline.run.windows import cut_run
from pipeline.simulate import Disturbance, Program, Scenario, find_vehicle, simulate_run
from pipeline.sources.one_vehicle import load_vehicle
from pipeline.store import Store

KINDS = ("closed", "natural", "sets")
BASE = {
    "drive_lag": {"tau": 0.3},
    "effective_track": {"k": 1.6},
    "wheel_radius": {"k": 0.97},
    "lateral_skid": {"c": 0.1},
    "icr_offset": {"x_icr": 0.1},
}
PROGRAMS = ("smooth", "teleop", "stop_and_go")
SIZES = (0.5, 0.8, 1.1, 1.5)
"""Of the smallest change that groups are said to show."""
GROUP = 3
CHANGES = {
    "wheel_radius": {"wheel_radius": {"k": 0.93}},
    "drive_lag": {"drive_lag": {"tau": 0.55}},
    "transport_delay": {"transport_delay": {"d": 0.25}},
}
"""Tyres that lost pressure, half a payload on the drive, a controller that answers a moment later: the effect
that is to be named, and what it is from then on."""
CAUSE_RUNS = 4
PARTS = 4


def diagnose(scene: Scenario, name: str) -> tuple[MotionRun, Model | None]:
    """A simulated run, and the model that its diagnosis wrote."""
    made = simulate_run(scene)
    vehicle = vehicle_of(made.scenario.vehicle.name)
    tables = tables_of(made, vehicle)
    run = load_run(tables, vehicle, name=name)
    file = diagnose_runs([Recording(name, tables)], vehicle).proposal
    return run, None if file is None else file.model


def check_pair(
    before: Sequence[tuple[MotionRun, Model | None]], after: Sequence[tuple[MotionRun, Model | None]]
) -> Check:
    """A check of diagnosed runs, as `slip check` makes it."""
    model = next(model for _, model in (*before, *after) if model is not None)
    effects = unite_effects(*([model for _, model in side] for side in (before, after)))
    sides = {BEFORE: [run for run, _ in before], AFTER: [run for run, _ in after]}
    starts = {run.name: own for run, own in (*before, *after) if own is not None}
    return compare(read_under(ModelFile(Model(model.vehicle, effects)), sides, starts=starts))


def redrive(scene: Scenario, kind: str, seed: int) -> Scenario:
    """Another drive of the same vehicle: other commands, other noise."""
    draw = np.random.default_rng([seed, 77])
    other = replace(scene, seed=seed + 500_009, start_pose=(0.0, 0.0, float(draw.uniform(-3.0, 3.0))))
    if kind == "closed":
        return close_loop(replace(other, disturbance=Disturbance(0.03, 0.05)), draw)
    names = PROGRAMS if kind == "natural" else ("drive_steps", "smooth", "teleop")
    return replace(other, program=replace(other.program, name=str(draw.choice(names))))


def draw_null(seed: int) -> tuple[str, Scenario, Scenario]:
    """A vehicle that drives twice without a change."""
    kind = KINDS[seed % len(KINDS)]
    if kind == "closed":
        scene = replace(draw_riddle("sets", seed).scenario, duration_s=100.0)
        one = close_loop(
            replace(scene, disturbance=Disturbance(0.03, 0.05)), np.random.default_rng([seed, 76])
        )
        return kind, one, redrive(scene, kind, seed)
    category = "natural" if kind == "natural" else "sets"
    scene = draw_riddle(category, seed).scenario
    scene = replace(scene, duration_s=min(scene.duration_s, 150.0))
    return kind, scene, redrive(scene, kind, seed)


def tell(check: Check) -> list[str]:
    return [f"{name} {change.before:.3g} -> {change.after:.3g} (p {change.p:.1g})"
            for name, change in check.changes.items() if change.status == "changed"]  # fmt: skip


def play_null(seed: int, pairs: int, out: Path | None) -> None:
    done = {row["seed"] for row in read_rows(out)}
    for number in range(seed, seed + pairs):
        if number in done:
            continue
        kind, one, two = draw_null(number)
        try:
            sides = [[diagnose(scene, f"{side} {number}")] for side, scene in ((BEFORE, one), (AFTER, two))]
            if all(model is None for side in sides for _, model in side):
                print(f"  {number} {kind}: neither log has a model to compare", flush=True)
                continue
            found = check_pair(*sides)
        except SlipError as error:
            print(f"  {number} {kind}: {error}", flush=True)
            continue
        alike = compare(found.sides, simulated=True)
        names = list(found.changes)
        rows = [found.sides.names.index(name) for name in names]
        kept = [[one.numbers.values[rows].tolist(), one.numbers.covariance[np.ix_(rows, rows)].tolist()]
                for one in (*found.sides.before, *found.sides.after)]  # fmt: skip
        add_row(out, {"seed": number, "kind": kind, "changed": tell(found), "within": tell(alike),
                      "names": names, "sides": kept})  # fmt: skip
        for what, check in (("ALARM", found), ("within", alike)):
            if tell(check):
                print(f"  {number} {kind} {what}: {'; '.join(tell(check))}", flush=True)


def vary(draw: np.random.Generator, shifted: tuple[str, float] | None = None) -> dict[str, dict[str, float]]:
    """Numbers of the vehicle in one run: they differ from run to run as is declared."""
    found: dict[str, dict[str, float]] = {}
    for name, values in BASE.items():
        for key, value in values.items():
            parameter = find_effect(name)().parameter(key)
            moved = value + find_usual_spread(parameter) * SHRUNK * float(draw.normal())
            if shifted is not None and shifted[0] == f"{name}.{key}":
                moved += shifted[1]
            found[name] = {key: float(np.clip(moved, *parameter.bounds))}
    return found


SHRUNK = 0.5
"""Of the declared spread: a robot whose runs differ by half of what is usual, which has to be learned."""


def draw_scene(draw: np.random.Generator, effects: object, duration_s: float) -> Scenario:
    """A drive of the vehicle as people drive."""
    return make_scenario(
        effects,
        seed=int(draw.integers(2**31)),
        duration_s=duration_s,
        vehicle=find_vehicle("husky"),
        disturbance=Disturbance(0.03, 0.05),
        program=Program(str(draw.choice(PROGRAMS))),  # type: ignore[arg-type]
    )


def read_pool(
    file: ModelFile, draw: np.random.Generator, count: int, shifted: tuple[str, float] | None
) -> list[RunReading]:
    """Runs of the vehicle under its model."""
    runs = []
    for _ in range(count):
        scene = draw_scene(draw, vary(draw, shifted), 120.0)
        runs.append(as_run(simulate_run(scene)))
    return list(read_under(file, {BEFORE: (), AFTER: runs}).after)


def draw_groups(
    before: Sequence[RunReading], after: Sequence[RunReading], count: int, draw: np.random.Generator
) -> Iterator[tuple[list[RunReading], list[RunReading]]]:
    """Groups of runs, before and after, none of a run twice."""
    alike = before is after
    for _ in range(count):
        first = draw.choice(len(before), GROUP, replace=False).tolist()
        rest = [place for place in range(len(after)) if not (alike and place in first)]
        second = draw.choice(rest, GROUP, replace=False).tolist()
        yield [before[n] for n in first], [after[n] for n in second]


def check_group(
    file: ModelFile, before: Sequence[RunReading], after: Sequence[RunReading], template: Sides
) -> Check:
    sides = replace(template, model=file, before=tuple(as_side(one, BEFORE) for one in before),
                    after=tuple(as_side(one, AFTER) for one in after))  # fmt: skip
    return compare(sides)


def as_side(one: RunReading, side: str) -> RunReading:
    return replace(one, numbers=replace(one.numbers, side=side), fitted=None)  # type: ignore[arg-type]


def play_power(seed: int, pool: int, out: Path | None) -> None:
    draw = np.random.default_rng([seed, 38])
    vehicle = vehicle_of(find_vehicle("husky").name)
    effects = [find_effect(name)().change(**values) for name, values in BASE.items()]
    file = ModelFile(Model(vehicle, tuple(sorted(effects, key=lambda one: (one.place, one.rank)))))
    base = read_pool(file, draw, 2 * pool, None)
    scene = make_scenario(vary(draw), seed=seed, vehicle=find_vehicle("husky"))
    template = read_under(file, {BEFORE: (), AFTER: [as_run(simulate_run(scene))]})
    checks = [check_group(file, *sides, template) for sides in draw_groups(base, base, 200, draw)]
    alarms = sum(bool(tell(one)) for one in checks)
    print(f"no change: {alarms} alarms in {len(checks)} groups of {2 * pool} runs", flush=True)
    causes = [f"{name}.{key}" for name, values in BASE.items() for key in values]
    gaps = []
    for cause in causes:
        smallest = float(np.median([check.changes[cause].smallest for check in checks]))
        for size in SIZES:
            change = size * smallest
            shifted = read_pool(file, draw, pool, (cause, change))
            groups = [check_group(file, *sides, template) for sides in draw_groups(base, shifted, 100, draw)]
            place = template.names.index(cause)
            means = [np.mean([one.numbers.values[place] for one in side]) for side in (base, shifted)]
            true = float(means[1] - means[0])
            said = float(np.mean([one.changes[cause].find_power(abs(true)) for one in groups]))
            found = float(np.mean([one.changes[cause].status == "changed" for one in groups]))
            other = float(np.mean([any(row.split()[0] != cause for row in tell(one)) for one in groups]))
            gaps.append(abs(said - found))
            row = {"cause": cause, "change": change, "said": said, "found": found, "other": other}
            add_row(out, row)
            told = f"{cause:<22} {change:8.3g}   says {said:4.0%}   finds {found:4.0%}"
            print(f"{told}   another cause {other:4.0%}", flush=True)
    print(f"largest gap {max(gaps):.0%}, mean {np.mean(gaps):.0%}")


def play_causes(seed: int, pairs: int, out: Path | None) -> None:
    draw = np.random.default_rng([seed, 39])
    for cause, changed in CHANGES.items():
        right = wrong = 0
        for _ in range(pairs):
            models, sides = [], []
            for effects in (BASE, {**BASE, **changed}):
                scenes = [draw_scene(draw, effects, 120.0) for _ in range(CAUSE_RUNS)]
                first, model = diagnose(scenes[0], f"{cause} {len(sides)}")
                models.append([model])
                sides.append([first, *(as_run(simulate_run(scene)) for scene in scenes[1:])])
            file = ModelFile(Model(vehicle_of(find_vehicle("husky").name), unite_effects(*models)))
            found = compare(read_under(file, {BEFORE: sides[0], AFTER: sides[1]}))
            named = {row.split(".")[0] for row in tell(found)} - {"error"}
            right += cause in named
            wrong += bool(named - {cause})
            add_row(out, {"cause": cause, "changed": tell(found)})
            print(f"  {cause}: {'; '.join(tell(found)) or 'nothing'}", flush=True)
        print(f"{cause:<20} right in {right} of {pairs}, another cause beside it in {wrong}", flush=True)


def play_real(results: Path) -> None:
    store = Store(results)
    kept: dict[tuple[str, str], list[tuple[MotionRun, Model]]] = {}
    quarters = alarms = within = 0
    logs: list[float] = []
    for manifest in store.survey().manifests:
        diagnosis = find_diagnosis(store.root, manifest)
        file = None if diagnosis is None else read_model(diagnosis)
        if file is None:
            continue
        vehicle = load_vehicle(manifest)
        run = load_motion_run(manifest, vehicle)
        kept.setdefault((vehicle.id, str(manifest.details.get("terrain"))), []).append((run, file.model))
        times = run.track.times[run.track.active]
        edges = np.quantile(times, np.linspace(0.0, 1.0, PARTS + 1)).tolist()
        parts = [cut_run(run, low, high) for low, high in itertools.pairwise(edges)]
        own = ModelFile(Model(vehicle, unite_effects([file.model])))
        for one, two in itertools.combinations(parts, 2):
            try:
                found = compare(read_under(own, {BEFORE: [one], AFTER: [two]}))
            except SlipError:
                continue
            alike = compare(found.sides, simulated=True)
            quarters, alarms, within = quarters + 1, alarms + bool(tell(found)), within + bool(tell(alike))
            if tell(found):
                print(f"  {run.name}: {'; '.join(tell(found))}", flush=True)
    print(f"quarters of recordings: {alarms} alarms in {quarters} pairs; were runs alike {within}")
    alarms, pairs = 0, 0
    for runs in kept.values():
        for one, two in itertools.combinations(runs, 2):
            found = check_pair([one], [two])
            pairs, alarms = pairs + 1, alarms + bool(tell(found))
            logs += [found.changes[name].difference / math.sqrt(2.0) for name in ERRORS]
            print(f"  {one[0].name} -> {two[0].name}: {'; '.join(tell(found)) or 'nothing'}", flush=True)
    spread = math.sqrt(float(np.nanmean(np.square(logs)))) if logs else math.nan
    print(f"recordings of one ground: {alarms} alarms in {pairs} pairs; log errors differ by {spread:.2f}")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("part", nargs="?", default="null", choices=["null", "power", "causes", "real"])
    parser.add_argument("--pairs", type=int, default=24, help="pairs; runs of each pool of `power`")
    parser.add_argument("--seed", type=int, default=38000)
    parser.add_argument("--results", type=Path, default=Path("results"))
    parser.add_argument("--out", type=Path)


def run(asked: argparse.Namespace) -> None:
    if asked.part == "real":
        play_real(asked.results)
    else:
        {"null": play_null, "power": play_power, "causes": play_causes}[asked.part](
            asked.seed, asked.pairs, asked.out
        )
