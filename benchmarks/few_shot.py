"""A terrain left out: what the fleet expects there, and what a few seconds of driving add.

Run: python benchmarks/few_shot.py RESULTS [--input command|measured] [--leave terrain|run] [--vehicle V]
[--begin S] [--jobs N]. RESULTS are analyzed and diagnosed recordings (slip batch LOGS). Every
terrain of a vehicle, or every run alone, is left out in turn. The model is that which the other runs let
expect. Printed is its error over 2 s on all that was driven after the first minute, in metres: of the ideal
model, of the expected numbers (prior), of fits to 5, 20 and 60 s from --begin on with the prior and without,
and of its own fit to that rest, on stretches held out. Then what `slip fleet predict` expected of the run:
median slip modulus of the slip and error over 2 s, and what they were.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import multiprocessing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast

import numpy as np
import polars as pl

from pipeline.core import SlipError
from pipeline.estimation.across_runs import fit_with_prior
from pipeline.estimation.comparison import Input
from pipeline.estimation.fit import fit_model
from pipeline.estimation.folds import hold_out, score
from pipeline.estimation.problem import Problem
from pipeline.job.compared_runs import read_digest
from pipeline.job.next_drive import forecast_deployment
from pipeline.job.prediction import find_estimates, predict_deployment
from pipeline.job.run_results import load_vehicle
from pipeline.models.model import Model
from pipeline.report.motion_view import load_motion_run
from pipeline.run.windows import cut_run, find_driven
from pipeline.store import Store

if TYPE_CHECKING:
    from pipeline.estimation.fit import Fitted
    from pipeline.job.prediction import Expected
    from pipeline.store import Manifest

SECONDS = (5.0, 20.0, 60.0)
LEFT_S = 60.0


@dataclass(frozen=True)
class Task:
    """A run to judge, without the runs on its terrain or without itself."""

    results: Path
    run: str
    vehicle: str
    terrain: str
    source: Literal["command", "measured"]
    leave: Literal["terrain", "run"]
    begin_s: float


@dataclass(frozen=True)
class Row:
    """Errors over 2 s [m] on the rest of a run; NaN where a fit is not possible."""

    task: Task
    ideal: float
    prior: float
    few: tuple[float, ...]
    alone: tuple[float, ...]
    own: float
    expected: tuple[Expected, Expected]
    was: tuple[float, float]


def judge(task: Task) -> Row | str:
    try:
        return _judge(task)
    except SlipError as error:
        return f"{task.run}: {error}"


def _judge(task: Task) -> Row:
    store = Store(task.results)
    manifest = store.manifest(task.run)
    if manifest is None:
        raise KeyError(task.run)
    gone = {"run": task.run} if task.leave == "run" else {"vehicle": task.vehicle, "terrain": task.terrain}
    left_out = (
        find_estimates(store).filter(pl.col(name) == value for name, value in gone.items())["run"].unique()
    )
    known = (store.manifest(name) for name in left_out)
    without = [read_digest(one) for one in known if one is not None]
    forecast = forecast_deployment(store, task.vehicle, task.terrain, task.source, without=without)
    vehicle = load_vehicle(manifest)
    run = load_motion_run(manifest, vehicle)
    source = Input(task.source)
    model = Model(vehicle, forecast.effects)
    fresh = model.swap(*(effect.change(**{p.name: p.neutral for p in effect.parameters}) for effect in model))
    rest = Problem([cut_run(run, find_driven(run, LEFT_S))], vehicle, source)
    few, alone = np.full((2, len(SECONDS)), math.nan)
    begin = find_driven(run, task.begin_s) if task.begin_s else -math.inf
    for place, seconds in enumerate(SECONDS):
        if task.begin_s + seconds <= LEFT_S:
            with contextlib.suppress(SlipError):
                end = find_driven(run, task.begin_s + seconds)
                first = Problem([cut_run(run, begin, end)], vehicle, source)
                few[place] = carry(rest, fit_with_prior(first, model, forecast.prior))
                alone[place] = carry(rest, fit_model(first, fresh, exact=True))
    expected = predict_deployment(store, forecast)
    whole = Problem([run], vehicle, source)
    own = hold_out(rest, fit_model(rest, model, exact=True))
    return Row(
        task,
        score(rest, rest.start_state()).pooled.t_mrmse_m,
        score(rest, rest.start_state(model.effects)).pooled.t_mrmse_m,
        tuple(few),
        tuple(alone),
        own.pooled.t_mrmse_m,
        (expected.median_modulus, expected.t_mrmse_m),
        (
            measure_slip(manifest, task.source),
            score(whole, whole.start_state(model.effects)).pooled.t_mrmse_m,
        ),
    )


def measure_slip(manifest: Manifest, source: str) -> float:
    """Median slip modulus of a run [m/s]."""
    rows = manifest.read("aggregates").filter(pl.col("subset") == "all", pl.col("input") == source)
    return float(rows["median_modulus"].item())


def carry(rest: Problem, fitted: Fitted) -> float:
    """Error of a fit, as it is, on the rest."""
    return score(rest, fitted.state).pooled.t_mrmse_m


def list_tasks(
    results: Path,
    source: Literal["command", "measured"],
    leave: Literal["terrain", "run"],
    only: str | None,
    begin_s: float,
) -> list[Task]:
    runs = find_estimates(Store(results)).select("run", "vehicle", "terrain").unique().sort("run")
    return [
        Task(results, run, vehicle, terrain, source, leave, begin_s)
        for run, vehicle, terrain in runs.iter_rows()
        if terrain != "unknown" and only in {None, vehicle}
    ]


def show(rows: list[Row]) -> None:
    names = [f"{kind} {seconds:g}" for kind in ("few", "alone") for seconds in SECONDS]
    print(f"{'run':<52}" + "".join(f"{name:>9}" for name in ("ideal", "prior", *names, "own")))
    for row in rows:
        values = (row.ideal, row.prior, *row.few, *row.alone, row.own)
        label = f"{row.task.vehicle}/{row.task.terrain}/{Path(row.task.run).name}"[:51]
        print(f"{label:<52}" + "".join(f"{value:>9.3f}" for value in values))
    own = np.array([row.own for row in rows])
    prior = np.array([row.prior for row in rows])
    few, alone = np.array([row.few for row in rows]), np.array([row.alone for row in rows])
    print(f"\nover own fit, median: prior {np.median(prior / own):.2f}", end="")
    fitted = [place for place in range(len(SECONDS)) if np.isfinite(few[:, place]).any()]
    for place in fitted:
        ratios = (np.nanmedian(side[:, place] / own) for side in (few, alone))
        print("; {:g} s with prior {:.2f}, alone {:.2f}".format(SECONDS[place], *ratios), end="")
    for place in fitted:
        against = few[:, place] / alone[:, place]
        known = np.isfinite(against)
        worse = int((against[known] > 1.02).sum())  # two percent are chance
        print(
            f"\n{SECONDS[place]:g} s: with the prior over alone, median {np.nanmedian(against):.2f}, "
            f"worst {np.nanmax(against):.2f}; worse by more than 2 % in {worse} of {int(known.sum())}",
            end="",
        )
    print()
    for place, what in enumerate(
        ("median slip modulus of the slip [m/s]", "error over 2 s of the prior [m]")
    ):
        print(f"\n{what}: expected, was")
        held = 0
        for row in rows:
            expected, was = row.expected[place], row.was[place]
            inside = expected.interval.low <= was <= expected.interval.high
            held += inside
            print(
                f"{Path(row.task.run).name:<52}{expected.value:>8.3f} [{expected.interval.low:.3f}, "
                f"{expected.interval.high:.3f}]{was:>9.3f}{'' if inside else '  outside'}"
            )
        print(f"{held} of {len(rows)} inside")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path)
    parser.add_argument("--input", choices=("command", "measured"), default="command")
    parser.add_argument("--leave", choices=("terrain", "run"), default="terrain")
    parser.add_argument("--vehicle")
    parser.add_argument("--begin", type=float, default=0.0, help="seconds of driving before the few")
    parser.add_argument("--jobs", type=int, default=2)
    chosen = parser.parse_args()
    source = cast("Literal['command', 'measured']", chosen.input)
    leave = cast("Literal['terrain', 'run']", chosen.leave)
    tasks = list_tasks(chosen.results, source, leave, chosen.vehicle, chosen.begin)
    with multiprocessing.get_context("spawn").Pool(chosen.jobs) as pool:
        judged = pool.map(judge, tasks, chunksize=1)
    for note in judged:
        if isinstance(note, str):
            print(note)
    show([row for row in judged if isinstance(row, Row)])


if __name__ == "__main__":
    main()
