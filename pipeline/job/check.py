"""A check: what changed between two drives, by cause, and whether it is more than runs differ anyway."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.program import finite_or_none
from pipeline.fleet.changes import Change, compare_sides
from pipeline.job.check_limits import Judged, Limits, judge_limits
from pipeline.job.check_numbers import ERRORS, POSITION_ERROR, USUAL_LOG_RATIO
from pipeline.job.check_sides import Baseline, Sides, format_baseline, read_sides
from pipeline.job.options import JobError
from pipeline.models.model_text import write_text

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.job.keys import Owner
    from pipeline.models.model_file import ModelFile
    from pipeline.models.parameter import Parameter
    from pipeline.store import Manifest, Store

KEPT, CANNOT_TELL, BROKEN = 0, 3, 4
"""Exit codes of a check."""
_MEDIAN = 0.67449
"""Of a half-normal distribution over its scale, which is its root mean square."""


@dataclass(frozen=True)
class Check:
    """What changed between two sides.

    Attributes:
        sides: what was compared.
        changes: of every number by name, those of the errors last.
        limits: what became of the limits; empty where none were given.
        moves: how far the changed numbers move predictions over 2 s in AFTER: [m] and [rad]; None without.
        simulated: BEFORE is a simulation, whose runs are alike.
    """

    sides: Sides
    changes: Mapping[str, Change]
    limits: tuple[Judged, ...] = ()
    moves: tuple[float, float] | None = None
    simulated: bool = False

    def list_status(self, status: str) -> list[str]:
        """Names of the numbers of a status, the surest first."""
        names = [name for name, change in self.changes.items() if change.status == status]
        return sorted(names, key=lambda name: (self.changes[name].p, self.changes[name].p_within))

    @property
    def code(self) -> int:
        """Exit code: of the limits where there are any, else of the changes."""
        if self.limits:
            outcomes = {one.outcome for one in self.limits}
            return BROKEN if "broken" in outcomes else CANNOT_TELL if "cannot tell" in outcomes else KEPT
        if self.list_status("changed"):
            return BROKEN
        known = len(self.changes) > len(self.list_status("unknown"))
        return KEPT if known and not self.list_status("differs") else CANNOT_TELL


def check_runs(
    before: Sequence[Manifest] | ModelFile | Baseline,
    after: Sequence[Manifest],
    store: Store,
    *,
    source: str | None = None,
    owner: Owner | None = None,
    limits: Limits | None = None,
    simulated: bool = False,
) -> Check:
    """Check what changed between two sides.

    Args:
        before: runs, a model file, or a baseline.
        after: runs.
        store: the results that the runs are of.
        source: `command` or `measured`; None chooses.
        owner: whose geometry counts where vehicles differ.
        limits: to be kept.
        simulated: BEFORE is a simulation: what runs differ by anyway does not count.

    Raises:
        SlipError: see `read_sides` and `judge_limits`.
    """
    return compare(read_sides(before, after, store, source=source, owner=owner), limits, simulated=simulated)


def find_usual_spread(parameter: Parameter) -> float:
    """Scale of the half-normal prior of a number's spread between runs, in its unit.

    A spread that was measured for the number is the root mean square of the prior; where none was, what was
    measured of others is its median.
    """
    size = parameter.spread.size
    return size if parameter.between_runs else size / _MEDIAN


def compare(sides: Sides, limits: Limits | None = None, *, simulated: bool = False) -> Check:
    """Compare two sides that were read under one model."""
    spreads = [find_usual_spread(label.parameter) for label in sides.labels]
    usual = np.array([*spreads, *(USUAL_LOG_RATIO for _ in ERRORS)])
    runs = [one.numbers for one in (*sides.before, *sides.after)]
    shifts = compare_sides(runs, usual, alike=simulated)
    bounds = [*(label.parameter.bounds for label in sides.labels), *((-math.inf, math.inf) for _ in ERRORS)]
    changes = {
        name: _hold(change, *ends) for name, change, ends in zip(sides.names, shifts, bounds, strict=True)
    }
    judged = () if limits is None else tuple(judge_limits(limits, sides, changes))
    return Check(sides, changes, judged, _measure_moves(sides, changes), simulated)


def keep_baseline(check: Check, path: Path) -> None:
    """Write the side AFTER as a baseline that later runs are checked against, in the place of an older one.

    Raises:
        JobError: ``baseline_stays``: the check is broken, and there is a baseline already.
        MotionError: ``baseline_unwritable``.
    """
    if check.code == BROKEN and path.exists():
        what = "the check is broken, and the baseline stays as it is"
        hint = "Delete it, if what was changed is to be the new normal."
        raise JobError("baseline_stays", what, where=str(path), hint=hint)
    write_text(path, format_baseline(check.sides), code="baseline_unwritable")


def _hold(change: Change, low: float, high: float) -> Change:
    """The change with means within the bounds, beyond which correlated errors can carry them."""
    before, after = np.clip((change.before, change.after), low, high).tolist()
    return replace(change, before=before, after=after)


def _measure_moves(sides: Sides, changes: Mapping[str, Change]) -> tuple[float, float] | None:
    """Root mean squares over AFTER of how far predictions move with the numbers that changed."""
    changed = [label for label in sides.labels if changes[label.name].status == "changed"]
    shifts = []
    for reading in sides.after if changed else ():
        fitted = reading.fitted
        if fitted is None:
            continue
        both = []
        for which in ("before", "after"):
            values: dict[str, dict[str, float]] = {}
            for label in changed:
                number = getattr(changes[label.name], which)
                values.setdefault(label.effect.id, {})[label.parameter.name] = number
            effects = fitted.state.effects_of(0)
            both.append([one.change(**values[one.id]) if one.id in values else one for one in effects])
        comparison = fitted.problem.comparisons[0]
        shifts.append(comparison.find_horizon_shifts(both[1], both[0], fitted.state.timing[0])[:2])
    if not shifts:
        return None
    far, turned = (float(np.sqrt(np.mean(np.concatenate(one) ** 2))) for one in zip(*shifts, strict=True))
    return far, turned


def find_pace(sides: Sides) -> float:
    """The speed at which errors of both sides are told [m/s]: the geometric mean of the runs of AFTER."""
    return math.exp(float(np.mean(np.log([one.pace for one in sides.after]))))


def check_as_json(check: Check, lines: Sequence[tuple[str, str]]) -> dict[str, object]:
    """The JSON object of `slip check`.

    Args:
        check: it.
        lines: of `check_text.list_lines`, the verdict first.
    """
    sides = check.sides
    rows = [tabulate_change(sides, name, change) for name, change in check.changes.items()]
    moves = None if check.moves is None else {"position_m": check.moves[0], "heading_rad": check.moves[1]}
    return {
        "verdict": lines[0][1],
        "exit_code": check.code,
        "before": {"kind": sides.kind, "runs": [one.numbers.run for one in sides.before]},
        "after": {"kind": "runs", "runs": [one.numbers.run for one in sides.after]},
        "terrains": {"before": list(sides.terrains[0]), "after": list(sides.terrains[1])},
        "input": sides.source.value,
        "simulated": check.simulated,
        "effects": list(sides.model.model.ids),
        "numbers": rows,
        "moves_predictions_over_2s": moves,
        "limits": [
            {"name": one.name, "limit": one.limit, "measured": one.measured, "outcome": one.outcome}
            for one in check.limits
        ],
        "lines": [list(line) for line in lines],
        "notes": list(sides.notes),
    }


def tabulate_change(sides: Sides, name: str, change: Change) -> dict[str, object]:
    """One number of a check in its unit, that of an error at one pace and its change as a share."""
    is_error, pace = name in ERRORS, find_pace(sides)
    unit = next((label.parameter.unit for label in sides.labels if label.name == name), "m")
    sizes = [change.before, change.after]
    parts = [change.low, change.high, change.smallest, change.spread]
    if is_error:
        unit = "m" if name == POSITION_ERROR else "rad"
        sizes, parts = [pace * math.exp(one) for one in sizes], [math.expm1(one) for one in parts]
    before, after, low, high, smallest, spread = map(finite_or_none, (*sizes, *parts))
    return {
        "number": name,
        "unit": unit,
        "status": change.status,
        "before": before,
        "after": after,
        "change_is": "share" if is_error else "difference",
        "low": low,
        "high": high,
        "p": finite_or_none(change.p),
        "p_within_runs": finite_or_none(change.p_within),
        "smallest_found": smallest,
        "spread_between_runs": spread,
        "spread_is_default": change.is_default,
        "more_runs_a_side": change.count_missing(),
    }
