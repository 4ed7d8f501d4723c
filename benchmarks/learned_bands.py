"""Coverage of the 95 % bands of a learned term on a ground left out, over the real recordings.

Run: python benchmarks/learned_bands.py [--results build/rivals] [--vehicle warthog]. Recordings under
../shared/logs are analyzed and diagnosed into the results where they are not yet; without recordings nothing
is done, and it says so.

Each ground is left out in turn. The effects that at least half of the diagnoses on the other grounds name are
fitted to all runs there together, and a learned term on what they leave; its bands come from leaving out each
of those grounds in turn. On the ground left out only clocks are fitted. The term is taken even where
`slip model add` would refuse it, and the last column says whether. Told is the share of the errors
within 2 s that the bands hold as they are, and following the run.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from rivals import LOGS, NAMED, Recording, open_recordings
from threadpoolctl import threadpool_limits

from pipeline.estimation import Input, Problem
from pipeline.estimation.across_runs import Coverage, list_ratios, measure_coverage
from pipeline.estimation.fit import fit_model
from pipeline.estimation.folds import HeldOut, score
from pipeline.estimation.learned_step import ResidualData, fit_own, leave_grounds_out
from pipeline.estimation.terms import is_term
from pipeline.models import Model
from pipeline.store import Store


def agree_on_effects(runs: Sequence[Recording]) -> Model:
    """The effects that at least half of the diagnoses of runs name, formulas left out."""
    effects = {e.id: e for run in runs for e in run.models[NAMED] if not is_term(e.id)}
    named = Counter(e.id for run in runs for e in run.models[NAMED])
    return Model(runs[0].vehicle, tuple(e for name, e in effects.items() if 2 * named[name] >= len(runs)))


def judge(ground: str, every: Sequence[Recording]) -> list[tuple[str, ...]]:
    """Rows of the runs of a ground that is left out, and one of all of them."""
    rest, out = ([one for one in every if (one.terrain == ground) is is_out] for is_out in (False, True))
    source = rest[0].problem.source
    problem = Problem([run for one in rest for run in one.problem.runs], rest[0].vehicle, source)
    fitted = fit_model(problem, agree_on_effects(rest))
    term = ResidualData(problem, fitted.state).learn(np.ones(problem.whole.run.size, dtype=bool))
    apart = leave_grounds_out(problem, fitted.model)
    bands = None if apart is None else apart.bands
    rows, ratios = [], []
    for one in out:
        states = [fit_own(one.problem, model).state for model in (fitted.model, fitted.model + term)]
        before, after = (score(one.problem, state) for state in states)
        ratios += (mine := list_ratios(one.problem, states[1], after))
        held = {} if bands is None else measure_coverage(bands, mine)
        rows.append((one.name, ground, *show_errors(before, after), *list_shares(held), ""))
    held = {} if bands is None else measure_coverage(bands, ratios)
    refused = "yes" if apart is not None and apart.refusal else "no"
    return [*rows, (f"all on {ground}", ground, "", "", *list_shares(held), refused)]


def show_errors(before: HeldOut, after: HeldOut) -> tuple[str, str]:
    one, other = before.pooled, after.pooled
    turns = " -> ".join(f"{math.degrees(errors.r_mrmse_rad):.2f}" for errors in (one, other))
    return f"{one.t_mrmse_m:.3f} -> {other.t_mrmse_m:.3f}", turns


def list_shares(held: Mapping[str, Coverage]) -> list[str]:
    found = held.values()
    return [f"{share:.1%}" for share in (*(one.as_it_is for one in found), *(one.followed for one in found))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--results", type=Path, default=Path("build/rivals"))
    parser.add_argument("--vehicle", default="warthog", help="of which five grounds were recorded")
    chosen = parser.parse_args()
    logs = sorted(LOGS.glob("*.mcap"))
    if not logs:
        print(f"skipped: no recordings in {LOGS.name}")
        return
    with threadpool_limits(1):
        found = open_recordings(Store(chosen.results), Input.COMMAND, logs, learns=False)
        every = [one for one in found if one.vehicle.id == chosen.vehicle]
        heads = ("recording", "ground left out", "position [m]", "heading [deg]")
        hows, whats = ("as they are", "following"), ("position", "heading")
        heads += (*(f"{what}, {how}" for how in hows for what in whats), "refused")
        print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}")
        for ground in sorted({one.terrain for one in every}):
            for row in judge(ground, every):
                print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
