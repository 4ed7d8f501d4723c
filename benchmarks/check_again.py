"""`slip check` on readings that the benchmark `check` wrote with --out: alarms, and power as it says.

- `null`: the pairs judged again under the spreads that the catalogue declares now.
- `drawn`: pairs without a change whose numbers are drawn: the errors and correlations of a kept pair, and a
  spread between runs for each number as the catalogue declares; `--others` further runs of it are known.
  Printed is how many are called changed, and how many likely changed.
- `power`: groups of three runs a side with the errors and correlations of kept runs and half of the declared
  spreads; one number is shifted. Printed is the share of groups in which it is found, beside what the check
  says of itself, for five causes at four sizes. No run is simulated: thousands of trials take minutes.
"""

import argparse
import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from measuring import read_rows

from pipeline.core.arrays import Floats
from pipeline.datasets.changes import AFTER, BEFORE, Change, RunNumbers, Side, compare_sides
from pipeline.datasets.check import find_usual_spread
from pipeline.datasets.check_readings import USUAL_LOGARITHMS
from pipeline.models.catalogue import find_effect
from pipeline.words.check import LIKELY

KINDS = ("closed", "natural", "sets")
CAUSES = ("drive_lag.tau", "effective_track.k", "wheel_radius.k", "lateral_skid.c", "icr_offset.x_icr")
SIZES = (0.5, 0.8, 1.1, 1.5)
"""Of the smallest change that such groups are said to show."""
GROUP = 3
SHRUNK = 0.5
"""Of the declared spread: a robot whose runs differ by half of what is usual, which has to be learned."""
FEWEST = 3
"""Kept runs that have a cause, of whose errors groups are drawn."""


def find_usual(name: str) -> float:
    """Scale of the prior of a number's spread between runs."""
    if name in USUAL_LOGARITHMS:
        return USUAL_LOGARITHMS[name]
    effect, _, parameter = name.partition(".")
    return find_usual_spread(find_effect(effect)().parameter(parameter))


def read_side(row: dict[str, Any], number: int, side: Side) -> RunNumbers:
    values, covariance = (np.array(part, dtype=np.float64) for part in row["sides"][number])
    return RunNumbers(f"{row['seed']} {side}", side, values, covariance)


def judge_pairs(rows: list[dict[str, Any]]) -> None:
    pairs, alarms, within = Counter[str](), Counter[str](), Counter[str]()
    for row in rows:
        runs = [read_side(row, 0, BEFORE), read_side(row, 1, AFTER)]
        usual = np.array([find_usual(name) for name in row["names"]])
        for counted, alike in ((alarms, False), (within, True)):
            found = compare_sides(runs, usual, alike=alike)
            counted[row["kind"]] += any(one.status == "changed" for one in found)
        pairs[row["kind"]] += 1
    for kind in KINDS:
        counts = f"{pairs[kind]:4d} pairs   alarms {alarms[kind]:3d}   were runs alike {within[kind]:3d}"
        print(f"{kind:<10}{counts}")
    counts = f"{pairs.total():4d} pairs   alarms {alarms.total():3d}   were runs alike {within.total():3d}"
    print(f"all       {counts}")


def play_drawn(rows: list[dict[str, Any]], trials: int, seed: int, others: int) -> None:
    draw = np.random.default_rng([seed, 41])
    alarms = likely = within = 0
    for _ in range(trials):
        row = rows[int(draw.integers(len(rows)))]
        usual = np.array([find_usual(name) for name in row["names"]])
        sides = [read_side(row, 0, BEFORE), read_side(row, 1, AFTER)]
        spread = usual * np.abs(draw.normal(size=usual.size))

        def redraw(run: RunNumbers, spread: Floats = spread) -> RunNumbers:
            known = np.where(run.known, 0.0, np.nan)
            covariance = np.where(np.isfinite(run.covariance), run.covariance, 0.0)
            error = draw.multivariate_normal(np.zeros(spread.size), covariance, method="svd")
            return replace(run, values=known + error + spread * draw.normal(size=spread.size))

        more = [redraw(sides[int(draw.integers(2))]) for _ in range(others)]
        found = compare_sides([redraw(one) for one in sides], usual, others={"there": more} if more else {})
        statuses = [one.status for one in found]
        alarms += "changed" in statuses
        differing = [one.p for one in found if one.status == "differs"]
        likely += "changed" not in statuses and min(differing, default=1.0) <= LIKELY
        within += bool(differing) or "changed" in statuses
    told = f"{trials} drawn pairs without a change, {others} other runs: changed {alarms}"
    rates = f"({alarms / trials:.1%}), likely changed {likely} ({likely / trials:.1%})"
    print(f"{told} {rates}, beyond their own errors {within}")


def draw_group(
    kept: list[tuple[Floats, Floats]], spread: Floats, draw: np.random.Generator, side: Side, shift: Floats
) -> list[RunNumbers]:
    """Runs whose numbers are zero but for a shift, their spread and their errors."""
    found = []
    for place in draw.integers(len(kept), size=GROUP).tolist():
        _, covariance = kept[place]
        error = np.linalg.cholesky(covariance) @ draw.normal(size=spread.size)
        found.append(
            RunNumbers(
                f"{side} {len(found)}",
                side,
                shift + spread * draw.normal(size=spread.size) + error,
                covariance,
            )
        )
    return found


def play_power(rows: list[dict[str, Any]], trials: int, seed: int) -> None:
    draw = np.random.default_rng([seed, 40])
    gaps = []
    for cause in CAUSES:
        sets = Counter(tuple(row["names"]) for row in rows if cause in row["names"])
        names, _ = max(sets.items(), key=lambda one: one[1])
        kept = []
        for row in rows:
            for number in (0, 1) if tuple(row["names"]) == names else ():
                run = read_side(row, number, BEFORE)
                if run.known.all():
                    kept.append((run.values, run.covariance))
        if len(kept) < FEWEST:
            print(f"{cause:<22} too few kept runs have it")
            continue
        usual = np.array([find_usual(name) for name in names])
        place, spread = names.index(cause), SHRUNK * usual
        none = np.zeros(usual.size)
        smallest = np.median([compare(kept, spread, usual, draw, none)[place].smallest for _ in range(100)])
        for size in SIZES:
            shift = none.copy()
            shift[place] = size * float(smallest)
            groups = [compare(kept, spread, usual, draw, shift) for _ in range(trials)]
            said = float(np.mean([one[place].find_power(shift[place]) for one in groups]))
            found = float(np.mean([one[place].status == "changed" for one in groups]))
            noise = math.sqrt(max(found * (1.0 - found), 1e-4) / trials)
            gaps.append(said - found)
            rates = f"says {said:4.0%}   finds {found:4.0%} +- {1.96 * noise:.0%}"
            told = f"{cause:<22} {shift[place]:8.3g}   {rates}"
            print(f"{told}   ({len(names)} numbers, errors of {len(kept)} runs)", flush=True)
    print(
        f"largest gap {np.abs(gaps).max():.0%}, mean {np.abs(gaps).mean():.0%}, signed {np.mean(gaps):+.0%}"
    )


def compare(
    kept: list[tuple[Floats, Floats]], spread: Floats, usual: Floats, draw: np.random.Generator, shift: Floats
) -> list[Change]:
    before = draw_group(kept, spread, draw, BEFORE, np.zeros(spread.size))
    return compare_sides([*before, *draw_group(kept, spread, draw, AFTER, shift)], usual)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("part", choices=["null", "drawn", "power"])
    parser.add_argument("file", type=Path)
    parser.add_argument("--trials", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--others", type=int, default=0, help="of `drawn`: further runs of the robot")


def run(asked: argparse.Namespace) -> None:
    rows = read_rows(asked.file)
    if asked.part == "null":
        judge_pairs(rows)
    elif asked.part == "drawn":
        play_drawn(rows, asked.trials, asked.seed, asked.others)
    else:
        play_power(rows, asked.trials, asked.seed)
