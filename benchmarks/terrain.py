"""Slip by number of passes: what the map says of drawn drives with and without such ground, and of real ones.

- `drawn`: laps of a Husky over ground that every pass compacts, at several rates, and over ground that does
  not change. Printed is how often a finding is reported, and how often its interval holds the truth.
- `real`: recordings of a folder, each mapped; printed is what is found of the number of passes.
"""

import argparse
import math
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from measuring import RECORDINGS, add_row

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.datasets.terrain import PassEffect
from pipeline.datasets.terrain_map import draw_up_terrain
from pipeline.simulate import VEHICLES, Disturbance, Program, Scenario, simulate_run, write_log
from pipeline.simulate.path import CompactedGround
from pipeline.simulate.scenario import Commands
from pipeline.store import Store

KEPT = (1.0, 0.95, 0.9, 0.8)
"""Share of the loss that each pass leaves; the first is ground that does not change."""
FIRST = 0.3
DISTURBED_MPS = 0.03
"""Wanders off the circle by half a metre in eight laps: patches of the ground are larger than that."""
PATCH_M = 4.0
LAPS = 8
LAP_S = 60.0


def draw_laps(seed: int, kept: float) -> Scenario:
    """Laps of a circle at a pace that a driver varies.

    Ground that takes the same share of speed and turning leaves the circle as it is, without a controller.
    """
    draw = np.random.default_rng([seed, 41])
    times = np.arange(0.0, LAPS * LAP_S, 0.05)
    knots = np.arange(0.0, times[-1] + 20.0, 10.0)
    pace = np.interp(times, knots, draw.uniform(0.9, 1.1, knots.size))
    vehicle = VEHICLES["husky"]
    return Scenario(
        vehicle=vehicle,
        seed=seed,
        duration_s=float(times[-1]),
        program=Program("smooth"),
        played=Commands(times, 0.8 * pace, 2.0 * math.pi / LAP_S * pace),
        disturbance=Disturbance(DISTURBED_MPS),
        effects={"drive_lag": {"tau": float(draw.uniform(0.1, 0.4))}},
        extra=CompactedGround(FIRST, kept, PATCH_M, rough=0.3),
    )


def measure_drawn(seed: int, kept: float, scratch: Path) -> PassEffect:
    """The effect that is measured of a drawn drive."""
    log = scratch / "run.mcap"
    write_log(simulate_run(draw_laps(seed, kept)), log)
    analyze_log(log, Options(out=scratch / "out", diagnosis=False, report=False, force=True))
    (effect,) = draw_up_terrain(Store(scratch / "out")).effects
    return effect


def play_drawn(seed: int, runs: int, out: Path | None) -> None:
    for kept in KEPT:
        found, held, effects = 0, 0, []
        for number in range(seed, seed + runs):
            with tempfile.TemporaryDirectory() as folder:
                effect = measure_drawn(number, kept, Path(folder))
            row: Mapping[str, object] = {**vars(effect), "kept": kept, "seed": number}
            add_row(out, row)
            print(f"  {number} {kept:g}: {effect.describe()}", flush=True)
            found += effect.is_significant
            held += effect.low <= kept - 1.0 <= effect.high
            effects.append(effect.change)
        told = f"truth {kept - 1.0:+.0%} a pass: median {np.nanmedian(effects):+.1%}"
        print(f"{told}, told in {found} of {runs}, within the interval in {held}", flush=True)


def play_real(logs: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for log in sorted(logs.glob("*.mcap")):
            analyze_log(log, Options(out=Path(folder), diagnosis=False, report=False))
        drawn = draw_up_terrain(Store(Path(folder)))
    for effect in drawn.effects:
        print(effect.describe())
    for note in drawn.notes:
        print(f"! {note}")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("part", nargs="?", default="drawn", choices=["drawn", "real"])
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--logs", type=Path, default=RECORDINGS)
    parser.add_argument("--out", type=Path)


def run(asked: argparse.Namespace) -> None:
    if asked.part == "real":
        play_real(asked.logs)
    else:
        play_drawn(asked.seed, asked.runs, asked.out)
