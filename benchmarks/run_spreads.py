"""How much numbers of the drivetrain differ from run to run of a vehicle on one ground, by its recordings.

Run: python benchmarks/run_spreads.py [--logs FOLDER]

Every recording is fitted with the same model, of a dead time and a lag; what runs of a ground scatter by
beyond their errors is the spread (REML, `fleet.levels`). `slip check` takes it as what is usual of single
runs. Only recordings whose vehicle was driven twice on a ground tell.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections import Counter
from pathlib import Path

from pipeline.core import SlipError
from pipeline.fleet.changes import AFTER, BEFORE
from pipeline.fleet.levels import split_levels
from pipeline.job import Options
from pipeline.job.analyze import analyze_log
from pipeline.job.check_sides import read_under
from pipeline.job.run_results import load_vehicle
from pipeline.models.catalogue import find_effect
from pipeline.models.model import Model
from pipeline.models.model_file import ModelFile
from pipeline.report.motion_view import load_motion_run
from pipeline.store import Manifest, Store

MODELS = (
    ("transport_delay", "drive_lag", "effective_track", "wheel_radius"),
    ("transport_delay", "turn_lag", "effective_track", "wheel_radius"),
)
"""A drive has one lag or two; of the dead time the larger spread counts."""
ASKED = ("transport_delay.d", "drive_lag.tau", "turn_lag.tau_mean", "turn_lag.tau_diff")


def read_numbers(manifest: Manifest, effects: tuple[str, ...]) -> dict[str, tuple[float, float]]:
    """What one recording says of the numbers that are asked, with their standard deviations."""
    vehicle = load_vehicle(manifest)
    found = [find_effect(name)() for name in effects]
    started = [
        one.change(**{parameter.name: parameter.typical for parameter in one.parameters}) for one in found
    ]
    model = Model(vehicle, tuple(sorted(started, key=lambda one: (one.place, one.rank, one.id))))
    sides = read_under(ModelFile(model), {BEFORE: (), AFTER: [load_motion_run(manifest, vehicle)]})
    (reading,) = sides.after
    rows = zip(sides.names, reading.numbers.values, reading.numbers.covariance.diagonal(), strict=True)
    return {
        name: (float(value), math.sqrt(variance))
        for name, value, variance in rows
        if name in ASKED and math.isfinite(value) and variance > 0.0
    }


def measure(results: Path) -> None:
    manifests = Store(results).survey().manifests
    ground = {one.run: f"{one.part('vehicle')['id']} on {one.details['terrain']}" for one in manifests}
    counts = Counter(ground.values())
    told = [one for one in manifests if counts[ground[one.run]] > 1]
    for effects in MODELS:
        numbers: dict[str, list[tuple[float, float, str]]] = {}
        for manifest in told:
            try:
                found = read_numbers(manifest, effects)
            except SlipError as error:
                print(f"  {manifest.run}: {error}", flush=True)
                continue
            line = ", ".join(f"{name} {value:.3f} ({error:.3f})" for name, (value, error) in found.items())
            print(f"  {manifest.run}, {ground[manifest.run]}: {line}", flush=True)
            for name, (value, error) in found.items():
                numbers.setdefault(name, []).append((value, error, ground[manifest.run]))
        for name, rows in numbers.items():
            values, errors, groups = (list(column) for column in zip(*rows, strict=True))
            fit = split_levels(values, errors, groups)
            print(
                f"{name}: {len(rows)} runs on {len(set(groups))} grounds, between runs {fit.spread_run:.3f}"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--logs", type=Path, default=Path("../shared/logs"))
    parser.add_argument("--results", type=Path, help="folder in which they are analyzed already")
    asked = parser.parse_args()
    if asked.results is not None:
        measure(asked.results)
        return
    with tempfile.TemporaryDirectory() as folder:
        for log in sorted(asked.logs.glob("*.mcap")):
            analyze_log(log, Options(out=Path(folder), diagnosis=False, report=False))
        measure(Path(folder))


if __name__ == "__main__":
    main()
