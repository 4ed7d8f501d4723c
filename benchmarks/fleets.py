"""Simulated fleets: three vehicles on four terrains, three to five runs each, effects hidden at known levels.

Each of N fleets is driven in simulation, diagnosed run by run from its measured wheels, and fitted as `slip
fleet fit` does; printed is whose each hidden number was, whose it is said to be, and how often intervals hold
the truth, those forecast of every run from the others among them. One run of each fleet is damaged: a tyre is
flat. With --drawn, estimates of N fleets are drawn in place of runs, by the size of what is hidden in
scatters of a run: the size from which levels are told.
"""

import argparse
import multiprocessing
import sys
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import polars as pl
from measuring import add_row, read_rows

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "fixtures"))

from motion_runs import make_scenario, tables_of, vehicle_of

from pipeline.core import SlipError
from pipeline.datasets.forecast import RUNS_SHARE, decide_level, fit_fleet, forecast_vehicle
from pipeline.datasets.levels import draw_run, split_levels
from pipeline.datasets.rank_tests import Interval
from pipeline.estimation import Recording, diagnose_runs
from pipeline.simulate import find_vehicle, simulate_run

TERRAINS = ("asphalt", "gravel", "sand", "ice")
VEHICLES = ("husky", "warthog", "jackal")
LEVELS = ("vehicle", "terrain", "run")
# Effect, parameter, value that does nothing, and size: what is hidden is about so far from it.
HIDDEN = (
    ("effective_track", "k", 1.0, 0.5),
    ("wheel_radius", "k", 1.0, -0.12),
    ("lateral_skid", "c", 0.0, 0.08),
    ("icr_offset", "x_icr", 0.0, 0.12),
    ("wheel_asymmetry", "e", 0.0, 0.05),
    ("yaw_misalignment", "psi", 0.0, 0.05),
)
PER_VEHICLE = 4
FLAT_TYRE = ("wheel_asymmetry", "e", 0.1)
FEW_RUNS = ((2,), (4,), (2, 2), (1, 1, 1), (3, 1, 1, 1, 2), (4, 4, 4, 4))
# What is the vehicle's or the ground's varies from run to run by so much of its size.
OWN_SPREAD = 0.05
DURATION_S = 180.0


Task = tuple[str, str, str, dict[str, dict[str, float]], int]
"""Run, vehicle, terrain, hidden effects and seed."""


@dataclass(frozen=True)
class Secret:
    """One hidden number of a vehicle.

    Attributes:
        level: whose it is.
        neutral: value that does nothing.
        centre: what the vehicle's runs have in common.
        terrains: mean by terrain.
        runs: value by run.
    """

    level: str
    neutral: float
    centre: float
    terrains: dict[str, float]
    runs: dict[str, float]


@dataclass
class Fleet:
    """Runs of vehicles, and what is hidden in them: by vehicle and (effect, parameter)."""

    runs: dict[str, list[tuple[str, str]]] = field(default_factory=dict)
    secrets: dict[str, dict[tuple[str, str], Secret]] = field(default_factory=dict)
    damaged: str = ""


def draw_fleet(seed: int) -> Fleet:
    """A fleet with unbalanced runs: every level is hidden somewhere."""
    rng = np.random.default_rng([seed, 16])
    fleet = Fleet()
    for vehicle in VEHICLES:
        counts = rng.integers(3, 6, len(TERRAINS))
        fleet.runs[vehicle] = [
            (f"{vehicle}_{terrain}_{number}", terrain)
            for terrain, count in zip(TERRAINS, counts, strict=True)
            for number in range(count)
        ]
        chosen = rng.choice(len(HIDDEN), PER_VEHICLE, replace=False)
        fleet.secrets[vehicle] = {
            HIDDEN[which][:2]: hide(rng, str(rng.choice(LEVELS)), HIDDEN[which], fleet.runs[vehicle])
            for which in chosen.tolist()
        }
    names = [name for runs in fleet.runs.values() for name, _ in runs]
    fleet.damaged = str(rng.choice(names))
    return fleet


def hide(
    rng: np.random.Generator,
    level: str,
    what: tuple[str, str, float, float],
    runs: list[tuple[str, str]],
    own: float = OWN_SPREAD,
) -> Secret:
    """A number with a level: alike everywhere, by terrain, or by run."""
    _, _, neutral, size = what
    size *= rng.uniform(0.7, 1.3)
    steps = rng.permutation(np.linspace(0.1, 1.9, len(TERRAINS)))
    common = {"vehicle": np.ones(len(TERRAINS)), "terrain": steps, "run": np.zeros(len(TERRAINS))}[level]
    terrains = {name: neutral + size * float(part) for name, part in zip(TERRAINS, common, strict=True)}
    spread = abs(size) * (own if level != "run" else 0.7)
    values = {name: terrains[terrain] + spread * float(rng.normal()) for name, terrain in runs}
    return Secret(level, neutral, neutral + size * float(common.mean()), terrains, values)


def drive(task: Task) -> list[dict[str, object]]:
    """Rows of the table `estimates` of one simulated run."""
    name, vehicle, terrain, effects, seed = task
    scenario = make_scenario(effects, seed=seed, duration_s=DURATION_S, vehicle=find_vehicle(vehicle))
    made = simulate_run(scenario)
    preset = vehicle_of(made.scenario.vehicle.name)
    try:
        diagnosis = diagnose_runs([Recording(name, tables_of(made, preset))], preset, inputs=("measured",))
    except SlipError as error:
        print(f"  {name}: {error}", flush=True)
        return []
    common = {"run": name, "dataset": f"{vehicle}_{terrain}", "vehicle": vehicle, "terrain": terrain}
    return [{**common, **row} for row in diagnosis.tabulate("estimates", name).to_dicts()]


def list_tasks(fleet: Fleet, seed: int) -> list[Task]:
    tasks = []
    for vehicle, runs in fleet.runs.items():
        for name, terrain in runs:
            effects: dict[str, dict[str, float]] = {}
            for (effect, parameter), secret in fleet.secrets[vehicle].items():
                effects[effect] = {parameter: secret.runs[name]}
            if name == fleet.damaged:
                effect, parameter, size = FLAT_TYRE
                old = effects.get(effect, {}).get(parameter, 0.0)
                effects[effect] = {parameter: old + size}
            tasks.append((name, vehicle, terrain, effects, 10_000 * seed + len(tasks)))
    return tasks


class Score:
    """What was said of hidden numbers, and how often intervals held them."""

    def __init__(self) -> None:
        self.told: Counter[tuple[str, str]] = Counter()
        self.held: Counter[str] = Counter()
        self.asked: Counter[str] = Counter()
        self.invented: Counter[str] = Counter()
        self.faint = 0
        self.radius_for_slip = 0

    def add(self, fleet: Fleet, estimates: pl.DataFrame) -> None:
        numbers = {(one.vehicle, (one.effect, one.parameter)): one for one in fit_fleet(estimates).numbers}
        for vehicle, secrets in fleet.secrets.items():
            for label, secret in secrets.items():
                number = numbers.pop((vehicle, label), None)
                named = 0 if number is None else number.named
                if number is None or 2 * named < len(fleet.runs[vehicle]):
                    self.faint += 1
                    continue
                level = "open" if number.level is None else number.level.value
                self.told[secret.level, level] += 1
                slips = label[0] == "wheel_radius" and secret.level == "terrain"
                self.radius_for_slip += slips and number.name == "wheel_radius"
                self._hold("common value", number.fit.interval, secret.centre)
                for name, mean in number.fit.groups.items():
                    self._hold("terrain", mean.interval, secret.terrains[name])
            self._forecast(fleet, vehicle, estimates.filter(pl.col("vehicle") == vehicle))
        for (vehicle, label), number in numbers.items():
            level = "open" if number.level is None else number.level.value
            self.invented[level] += 1
            print(f"  not hidden: {vehicle} {'.'.join(label)} {level} {number.because}", flush=True)

    def _forecast(self, fleet: Fleet, vehicle: str, estimates: pl.DataFrame) -> None:
        """Every run from the others, but the damaged one."""
        for name, terrain in fleet.runs[vehicle]:
            if name == fleet.damaged:
                continue
            others = estimates.filter(pl.col("run") != name)
            for number in forecast_vehicle(others, vehicle, terrain, "measured").numbers:
                secret = fleet.secrets[vehicle].get((number.effect, number.parameter))
                if secret is not None:
                    self._hold("another run", Interval(*number.ends), secret.runs[name])

    def _hold(self, what: str, interval: Interval | None, truth: float) -> None:
        if interval is not None:
            self.asked[what] += 1
            self.held[what] += interval.low <= truth <= interval.high

    def show(self) -> None:
        print(f"\n{'hidden as':<12}{'right':>12}{'open':>8}{'wrong':>12}")
        for level in LEVELS:
            row = {said: count for (truth, said), count in self.told.items() if truth == level}
            wrong = sum(row.values()) - row.get(level, 0) - row.get("open", 0)
            print(f"{level:<12}{row.get(level, 0):>12}{row.get('open', 0):>8}{wrong:>12}")
        total = sum(self.told.values())
        right = sum(count for (truth, said), count in self.told.items() if truth == said)
        print(f"right {right} of {total} ({right / max(total, 1):.1%}); named in too few runs: {self.faint}")
        print(f"wheel_radius said for slip of the ground: {self.radius_for_slip}")
        for what, asked in self.asked.items():
            print(f"intervals of {what}: {self.held[what]} of {asked} hold ({self.held[what] / asked:.1%})")
        print(f"numbers that were not hidden: {dict(self.invented)}")


def play_driven(fleets: int, seed: int, jobs: int, out: Path | None, *, resume: bool) -> None:
    score = Score()
    done = {(row["seed"], row["run"]): row["rows"] for row in (read_rows(out) if resume else ())}
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        for number in range(seed, seed + fleets):
            fleet = draw_fleet(number)
            tasks = list_tasks(fleet, number)
            left = [task for task in tasks if (number, task[0]) not in done]
            for task, part in zip(left, pool.imap(drive, left), strict=True):
                done[number, task[0]] = part
                add_row(out, {"seed": number, "run": task[0], "rows": part})
            rows = [row for task in tasks for row in done[number, task[0]]]
            runs = sum(len(part) for part in fleet.runs.values())
            print(f"fleet {number}: {runs} runs, a flat tyre in {fleet.damaged}", flush=True)
            score.add(fleet, pl.DataFrame(rows))
    score.show()


def play_drawn(fleets: int, seed: int) -> None:
    """Estimates drawn by size: spread between terrains, or distance from doing nothing, in run scatters.

    The last columns say how often intervals hold: of the common value, of terrains, and of the number that a
    run to come has, on a terrain with runs and on a new one.
    """
    heads = "".join(f"{name:>9}" for name in ("common", "terrain", "run", "run new"))
    print(f"{'hidden as':<10}{'size':>6}{'right':>8}{'open':>8}{'wrong':>8}{heads}")
    for level in LEVELS:
        for size in (1.0, 2.0, 4.0, 8.0):
            told: Counter[str] = Counter()
            held, asked = [0, 0, 0, 0], [0, 0, 0, 0]
            for number in range(fleets):
                rng = np.random.default_rng([seed, number, LEVELS.index(level), int(size)])
                terrains = np.repeat(TERRAINS, rng.integers(3, 6, len(TERRAINS)))
                shift = {name: size * float(rng.normal()) for name in TERRAINS}
                share = {"vehicle": 0.7, "terrain": 0.7, "run": 0.7 * size}[level]
                errors = rng.uniform(0.5, 1.0, terrains.size)
                centre = size if level == "vehicle" else 0.0
                truth = {name: centre + (shift[name] if level == "terrain" else 0.0) for name in TERRAINS}
                values = np.array([truth[name] for name in terrains.tolist()])
                values += np.hypot(share, errors) * rng.normal(size=terrains.size)
                fit = split_levels(values, errors, terrains.tolist())
                said, _ = decide_level(fit, 0.0)
                told["open" if said is None else said.value] += 1
                means = [(mean.interval, truth[name]) for name, mean in fit.groups.items()]
                for place, (interval, value) in enumerate([(fit.interval, centre), *means]):
                    if interval is not None:
                        asked[min(place, 1)] += 1
                        held[min(place, 1)] += interval.low <= value <= interval.high
                # A run that comes, on a terrain that is known and on one that is not.
                new = size * float(rng.normal()) if level == "terrain" else 0.0
                comes = ((TERRAINS[-1], truth[TERRAINS[-1]]), ("mud", centre + new))
                for place, (name, mean) in enumerate(comes, start=2):
                    usual = (size, RUNS_SHARE * size)
                    drawn = draw_run(values, errors, terrains.tolist(), name, usual=usual, count=400, rng=rng)
                    low, high = np.quantile(drawn, (0.025, 0.975))
                    asked[place] += 1
                    held[place] += bool(low <= mean + share * float(rng.normal()) <= high)
            rates = [told[level], told["open"], fleets - told[level] - told["open"]]
            shares = "".join(f"{rate / fleets:>8.1%}" for rate in rates)
            holds = "".join(f"{h / max(a, 1):>9.1%}" for h, a in zip(held, asked, strict=True))
            print(f"{level:<10}{size:>6g}{shares}{holds}", flush=True)


def play_few(fleets: int, seed: int) -> None:
    """Forecasts from few runs: how often they hold the run that comes, and how wide they are.

    Spreads, and errors of the estimates, are drawn from small to large, in usual sizes of a number: those
    that real recordings show.
    """
    print(f"\n{'runs on each terrain':<22}{'there':>8}{'wide':>7}{'elsewhere':>11}{'wide':>7}")
    for counts in FEW_RUNS:
        terrains = [f"{number}" for number, count in enumerate(counts) for _ in range(count)]
        held, widths = np.zeros((fleets, 2)), np.zeros((fleets, 2))
        for number in range(fleets):
            rng = np.random.default_rng([seed, number, *counts])
            run, terrain = np.exp(rng.uniform(np.log(0.03), np.log((1.0, 1.4))))
            errors = np.exp(rng.uniform(np.log(0.02), np.log(0.15), len(terrains)))
            means = terrain * rng.normal(size=len(counts) + 1)
            values = means[[int(name) for name in terrains]]
            values = values + np.hypot(run, errors) * rng.normal(size=len(terrains))
            for place, which in enumerate((0, len(counts))):
                drawn = draw_run(
                    values, errors, terrains, f"{which}", usual=(1.0, RUNS_SHARE), count=1000, rng=rng
                )
                low, high = np.quantile(drawn, (0.025, 0.975))
                held[number, place] = low <= means[which] + run * rng.normal() <= high
                widths[number, place] = high - low
        (there, elsewhere), (wide, wider) = held.mean(axis=0), np.median(widths, axis=0)
        label = ", ".join(map(str, counts))
        print(f"{label:<22}{there:>8.1%}{wide:>7.2f}{elsewhere:>11.1%}{wider:>7.2f}", flush=True)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--fleets", type=int, default=2)
    parser.add_argument("--drawn", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, help="file to add a JSON line to for each run that is driven")
    parser.add_argument("--resume", action="store_true", help="go on where the file of --out ends")


def run(chosen: argparse.Namespace) -> None:
    if chosen.drawn:
        play_drawn(chosen.drawn, chosen.seed)
        play_few(chosen.drawn, chosen.seed)
    else:
        play_driven(chosen.fleets, chosen.seed, chosen.jobs, chosen.out, resume=chosen.resume)
