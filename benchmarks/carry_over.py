"""Numbers of one run on another run of the same ground, beside a fit to that run.

Recordings under ../shared/logs whose name holds one of the words (all without any) are analyzed and diagnosed
into the results where they are not yet; without recordings nothing is done, and it says so. For every two
runs of a vehicle on one ground, the model that the first one's diagnosis names predicts the second: with its
numbers as they are, and with the same effects fitted to that run and held out in it. Clocks are fitted in
both. Printed are the ratios of the errors over 2 s.
"""

import argparse
import statistics
from itertools import permutations
from pathlib import Path

from measured_tables import INPUTS
from measuring import RECORDINGS
from rivals import METRICS, NAMED, Recording

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.core import SlipError
from pipeline.estimation import Input, fit_model, hold_out
from pipeline.store import Store


def compare(one: Recording, other: Recording) -> list[float]:
    """Errors of position and heading with the numbers of the first run over those of a fit to the second."""
    carried = one.entries[NAMED].carry_to(other).pooled
    own = hold_out(other.data, fit_model(other.data, one.models[NAMED])).pooled
    return [getattr(carried, metric) / getattr(own, metric) for metric in METRICS]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("words", nargs="*", help="recordings whose name holds one of them; all")
    parser.add_argument("--results", type=Path, required=True, help="where they are, or are to be, analyzed")


def run(given: argparse.Namespace) -> None:
    """Print a row for every two runs, and the medians."""
    store = Store(given.results)
    logs = [
        log
        for log in sorted(RECORDINGS.glob("*.mcap"))
        if not given.words or any(word in log.name for word in given.words)
    ]
    if not logs:
        print("there is no such recording here: nothing is compared")
    manifests = [
        analyze_log(log, Options(out=store.root, report=False, diagnosis=True)).manifest for log in logs
    ]
    for source, words in INPUTS.items():
        recordings = []
        for manifest in manifests:
            try:
                recordings.append(Recording(manifest, store, Input(source), learns=False))
            except SlipError as error:
                print(f"left out: {error}")
        rows = []
        for one, other in permutations(recordings, 2):
            if (one.vehicle.id, one.terrain) == (other.vehicle.id, other.terrain):
                rows.append(compare(one, other))
                ratios = "  ".join(f"{ratio:5.2f}" for ratio in rows[-1])
                print(f"{words:<9}{ratios}  {one.name} on {other.name}", flush=True)
        for index, name in enumerate(("position", "heading") if rows else ()):
            column = [row[index] for row in rows]
            middle, worst = statistics.median(column), max(column)
            print(f"{words:<9}{name}: median {middle:.3f}, worst {worst:.2f} of {len(column)}")
