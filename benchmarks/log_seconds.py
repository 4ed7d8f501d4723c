"""Seconds of each real recording that its numbers needed: as it was driven, and its best stretches first.

    python benchmarks/log_seconds.py [WORD...]

Every recording under ../shared/logs whose name holds one of the words is diagnosed. For each number that was
named: the seconds of driving after which its interval stays within 5 %, or within 1.25 times its last width
where the recording never gets there. Then the same stretches in the order that a plan's criterion prefers: by
their derivatives alone, next comes what lowers the summed squares of half-widths over goals most in a second;
once for all numbers together, once for the number alone.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.core import SlipError
from pipeline.estimation import Input, Problem, diagnose_runs, fit_model, load_recording
from pipeline.estimation.error_regions import Curve, find_goal, format_enough, last_until
from pipeline.estimation.fit import PartFit
from pipeline.estimation.intervals import narrow_part, sum_blocks
from pipeline.estimation.parts import Part, count_seconds
from pipeline.job import Options
from pipeline.job.analyze import analyze_log
from pipeline.job.run_results import read_recording
from pipeline.models import list_effects

LOGS = Path(__file__).parents[2] / "shared" / "logs"
_NEVER = 1.25


def order_blocks(part: Part, fit: PartFit, goals: np.ndarray) -> list[int]:
    """Numbers of blocks, the most telling in a second first.

    Args:
        part: of the way.
        fit: of it.
        goals: half-width that is enough of each free number, infinite where none is asked, shape (p,).
    """
    blocks = sum_blocks(part, fit)
    seconds = np.bincount(blocks.label, count_seconds(part), minlength=blocks.count)
    whole = blocks.normals.sum(axis=0)
    # So little is known before that the first choice does not depend on it.
    total = 1e-4 * np.diag(np.maximum(np.diag(whole), 1e-9))
    left, order = list(range(blocks.count)), []
    weight = np.zeros(blocks.held.size)
    weight[: goals.size] = np.where(np.isfinite(goals), 1.0 / goals**2, 0.0)
    while left:
        now = float(weight @ np.diag(np.linalg.inv(total)))
        after = np.diagonal(np.linalg.inv(total + blocks.normals[left]), axis1=1, axis2=2) @ weight
        best = left[int(np.argmax((now - after) / np.maximum(seconds[left], 0.5)))]
        total = total + blocks.normals[best]
        order.append(best)
        left.remove(best)
    return order


@dataclass(frozen=True)
class Row:
    """A number's goal, whether that is 5 %, and the seconds until it stays within by order of stretches."""

    label: str
    goal: float
    narrow: bool
    driven_s: float
    together_s: float
    alone_s: float


def compare(part: Part, fit: PartFit) -> list[Row]:
    """Every named number of a part."""
    known = {effect.id for effect in list_effects()}
    driven = narrow_part(part, fit)
    last = driven[1][-1]
    goals, narrow = np.full(len(fit.free), np.inf), np.zeros(len(fit.free), dtype=bool)
    for place, number in enumerate(fit.free):
        if number.effect in known and number.run is None and np.isfinite(last[place]):
            goal = find_goal(number.effect, number.name, fit.state.get(number))
            narrow[place] = last[place] <= goal
            goals[place] = goal if narrow[place] else _NEVER * last[place]
    if not np.isfinite(goals).any():
        return []
    together = narrow_part(part, fit, order_blocks(part, fit, goals))
    rows = []
    for place in np.flatnonzero(np.isfinite(goals)).tolist():
        only = np.full(goals.size, np.inf)
        only[place] = goals[place]
        orders = (driven, together, narrow_part(part, fit, order_blocks(part, fit, only)))
        times = [last_until(Curve(one, half[:, place]), float(goals[place])) for one, half in orders]
        rows.append(Row(fit.free[place].label, float(goals[place]), bool(narrow[place]), *times))
    return rows


def main() -> None:
    """Diagnose, order, print."""
    words = sys.argv[1:]
    every: list[Row] = []
    for log in sorted(LOGS.glob("*.mcap")):
        if words and not any(word in log.name for word in words):
            continue
        with tempfile.TemporaryDirectory(prefix="slip-") as folder:
            options = Options(out=Path(folder), report=False, diagnosis=False)
            vehicle, recording = read_recording(analyze_log(log, options).manifest)
            try:
                diagnosis = diagnose_runs([recording], vehicle).runs[0]
            except SlipError as error:
                print(f"{log.stem}: {error}", flush=True)
                continue
            run = load_recording(recording, vehicle)
        print(f"{log.stem}: {format_enough(diagnosis.effects) or 'nothing grows'}", flush=True)
        if diagnosis.proposal is None:
            continue
        problem = Problem([run], vehicle, Input(diagnosis.input))
        fitted = fit_model(problem, diagnosis.proposal.model, exact=True)
        rows = [
            row
            for part, fit in zip(problem.parts, fitted.fits, strict=True)
            if fit.free
            for row in compare(part, fit)
        ]
        for row in rows:
            times = (
                f"{row.driven_s:6.0f} s as driven{row.together_s:6.0f} s best first{row.alone_s:6.0f} s alone"
            )
            print(
                f"    {row.label:<28}{'5 %' if row.narrow else '':<4}+- {row.goal:<9.3g}{times}", flush=True
            )
        every += rows
    for title, some in (("within 5 %", [r for r in every if r.narrow]), ("all numbers", every)):
        if some:
            together = np.median([row.driven_s / row.together_s for row in some])
            alone = np.median([row.driven_s / row.alone_s for row in some])
            print(f"{title}: {together:.2f} times fewer seconds, {alone:.2f} alone (medians of {len(some)})")


if __name__ == "__main__":
    main()
