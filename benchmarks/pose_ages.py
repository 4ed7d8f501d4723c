"""How near the estimated ages of poses are to those that the gyro shows where their headings are withheld.

    python benchmarks/pose_ages.py [LOG...] [--set NAME=VALUE ...]

Of each log, every other six seconds of headings are withheld from the last solution, then the others; the
fit of the gyro knows all. Ages of the withheld poses in turns (faster than 0.7 rad/s) are compared with those
of their headings: robust spread of the difference [ms] with no ages at all and with the estimated ones, by
speed. --set changes numbers of `pipeline.stages.timing`. Without a log, the recordings under ../shared/logs.
Logs whose poses do not differ in age are left out.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from pipeline.core import SlipError
from pipeline.core.arrays import Flags, Floats, robust_spread
from pipeline.job import Options
from pipeline.job.analyze import analyze_log
from pipeline.run import MotionRun
from pipeline.run.heading import fit_gyro
from pipeline.stages import align, timing

LOGS = Path(__file__).parents[2] / "shared" / "logs"
WITHHELD_S = 6.0
TURNING = 0.7
SPEEDS = ((0.3, 1.0), (1.0, 2.0), (2.0, 9.0))
FEWEST = 40


def read_run(log: Path) -> MotionRun | None:
    """The run with its original stamps, as `timing.estimate_latency` gets it."""
    seen: list[MotionRun] = []

    def keep(run: MotionRun) -> tuple[Floats, float]:
        seen.append(run)
        return timing.estimate_latency(run)

    with tempfile.TemporaryDirectory() as folder, patch.object(align, "estimate_latency", keep):
        try:
            analyze_log(log, Options(out=Path(folder), report=False, diagnosis=False))
        except SlipError as error:
            sys.stderr.write(f"{log.name}: {error}\n")
    return seen[0] if seen else None


def compare(run: MotionRun) -> Iterator[tuple[float, float, float]]:
    """Slowest speed of a class [m/s], and spreads [ms] without ages and with the estimated ones."""
    latency, spread = timing.estimate_latency(run)
    corrected = replace(run, track=replace(run.track, times=run.track.times - latency))
    gyro = fit_gyro(corrected)
    if spread == 0.0 or gyro is None:
        return
    seen = timing._look(run, corrected.track, gyro, latency)
    times = run.track.times
    ordered = np.maximum.accumulate(corrected.track.times) + 1e-4 * np.arange(times.size)
    speed = np.abs(np.gradient(run.track.path, ordered))
    for part in range(2):
        withheld: Flags = np.asarray((times - times[0]) // WITHHELD_S % 2 == part)
        told = replace(seen, telling=seen.telling & ~withheld, good=seen.good & ~withheld)
        ages, _ = timing._estimate(run.track, told, np.zeros(times.size))
        for low, high in SPEEDS:
            rows = seen.good & withheld & (np.abs(seen.rate) > TURNING) & (speed > low) & (speed < high)
            if rows.sum() >= FEWEST:
                rest = [robust_spread((seen.age - one)[rows]) * 1e3 for one in (np.zeros(times.size), ages)]
                yield low, rest[0], rest[1]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("logs", nargs="*", type=Path)
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", dest="values")
    asked = parser.parse_args()
    for name, _, value in (one.partition("=") for one in asked.values):
        setattr(timing, name, type(getattr(timing, name))(float(value)))
    ratios: dict[float, list[float]] = {}
    for log in asked.logs or sorted(LOGS.glob("*.mcap")):
        run = read_run(log)
        for low, before, after in compare(run) if run is not None else ():
            print(f"{log.stem[-40:]:<42}{low:>5} m/s and more{before:>8.0f} ms{after:>8.0f} ms", flush=True)
            ratios.setdefault(low, []).append(after / before)
    for low, all_ratios in sorted(ratios.items()):
        print(f"{low} m/s and more: {np.exp(np.mean(np.log(all_ratios))):.2f} (geometric mean of ratios)")


if __name__ == "__main__":
    main()
