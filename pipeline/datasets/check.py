"""Check of two groups of runs: changes by cause, tested against the spread between runs, and limits."""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from pipeline.core import (
    NORMAL_95,
    TomlError,
    finite_or_none,
    format_interval,
    format_share,
    guess_names,
    parse_toml,
    read_bounded_text,
    require_finite,
    suffix_unit,
)
from pipeline.datasets.changes import AFTER, BEFORE, Change, RunNumbers, compare_sides
from pipeline.datasets.check_readings import (
    COMMANDED,
    COMMANDED_TURN,
    ERRORS,
    HEADING_ERROR,
    LOGARITHMS,
    MULTIPLIER,
    POSITION_ERROR,
    USUAL_LOG_RATIO,
    USUAL_LOGARITHMS,
    RunReading,
    widen,
)
from pipeline.datasets.check_sides import Baseline, Sides, format_baseline, read_sides
from pipeline.datasets.pooling import ComparisonError
from pipeline.models import ModelFile, Parameter, write_text
from pipeline.sources import Fault, Owner, convert_to
from pipeline.store import Manifest, Store

Outcome = Literal["kept", "broken", "undetermined"]
_HINT = "The handbook, Check a change, lists the keys."


Limit = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
"""In SI units, or a fraction; no quantity of a model is larger."""


class Bound(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One limit: `min` and `max` of the value in AFTER, `change` as a fraction of the value in BEFORE."""

    min: Limit | None = None
    max: Limit | None = None
    change: Limit | None = None


class ErrorBounds(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Limits of the model's errors over 2 s: `position` [m], `heading` [rad]."""

    position: Bound | None = None
    heading: Bound | None = None


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of a file of limits.

    Attributes:
        error: limits of the model's errors over 2 s.
        parameter: limits by ``effect.parameter``, in the parameter's SI unit.
        slip: limits of the median slip modulus by terrain [m/s].
    """

    error: ErrorBounds = ErrorBounds()
    parameter: dict[str, Bound] = {}
    slip: dict[str, Bound] = {}


@dataclass(frozen=True)
class Judged:
    """One limit and its outcome.

    Attributes:
        name: name of the limited quantity.
        limit: the limit as text.
        measured: the measured value as text, with its 95 % interval.
        outcome: `kept` or `broken` if the whole interval lies inside or outside the limit; else undetermined.
    """

    name: str
    limit: str
    measured: str
    outcome: Outcome


def read_limits(path: Path) -> Limits:
    """Read a file of limits.

    Raises:
        ComparisonError: ``bad_limits``: it does not exist, or a key or value in it is wrong.
    """
    try:
        tree = parse_toml(read_bounded_text(path))
        require_finite(tree)
    except OSError as error:
        what = f"the limits cannot be read ({error.strerror})"
        raise ComparisonError("bad_limits", what, where=str(path), hint=_HINT) from error
    except TomlError as error:
        where = str(path) if error.line is None else f"{path}, line {error.line}"
        raise ComparisonError("bad_limits", str(error), where=where, hint=_HINT) from error
    except UnicodeDecodeError as error:
        what = f"the limits are not valid: {error}"
        raise ComparisonError("bad_limits", what, where=str(path), hint=_HINT) from error
    limits = convert_to(Limits, tree)
    if isinstance(limits, Fault):
        what = f"the limits are not valid: {limits.what}"
        raise ComparisonError("bad_limits", what, where=str(path), hint=limits.hint or _HINT)
    for name, bound in _list_bounds(limits):
        _require_sense(path, name, bound)
    if not any(True for _ in _list_bounds(limits)):
        raise ComparisonError("bad_limits", "the file sets no limit", where=str(path), hint=_HINT)
    return limits


def _list_bounds(limits: Limits) -> Iterator[tuple[str, Bound]]:
    for key, bound in (("position", limits.error.position), ("heading", limits.error.heading)):
        if bound is not None:
            yield f"error.{key}", bound
    yield from limits.parameter.items()
    yield from ((f"slip.{ground}", bound) for ground, bound in limits.slip.items())


def _require_sense(path: Path, name: str, bound: Bound) -> None:
    what = ""
    if bound == Bound():
        what = f"{name} has no min, max or change"
    elif bound.min is not None and bound.max is not None and bound.min > bound.max:
        what = f"the min of {name} is above its max"
    elif bound.change is not None and not bound.change > 0.0:
        what = f"the change of {name} is not positive: it is a share, 0.1 is ten percent"
    if what:
        raise ComparisonError("bad_limits", what, where=str(path), hint=_HINT)


def judge_limits(limits: Limits, sides: Sides, changes: Mapping[str, Change]) -> list[Judged]:
    """Evaluate every limit.

    The value of AFTER is the mean of its runs, with the estimation errors only; the interval of a change also
    includes the spread between runs.

    Args:
        limits: limits, from `read_limits`.
        sides: both sides of the check.
        changes: changes by name of the quantity.

    Raises:
        ComparisonError: ``unknown_limit``: the model of the check has no such quantity.
    """
    judged: list[Judged] = []
    units = {label.name: label.parameter.unit for label in sides.labels}
    names = [*units, *ERRORS]
    for key, bound in _list_bounds(limits):
        if key.startswith("slip."):
            judged += _judge_slip(key, bound, sides)
            continue
        if key not in names:
            known = ", ".join(units) or "none"
            hint = f"{guess_names(key, names)}The model of this check has: {known}."
            raise ComparisonError("unknown_limit", f"no number is called {key}", where="limits", hint=hint)
        index, change = names.index(key), changes[key]
        if key in {POSITION_ERROR, HEADING_ERROR}:
            unit = "m" if key == POSITION_ERROR else "rad"
            own = [one.pace for one in sides.after]
            value, deviation = _average_logs(sides.after, index, own)
            judged += _judge_log(key, bound, unit, (value, deviation), change)
            continue
        value, deviation = _average(sides.after, index)
        half = NORMAL_95 * deviation
        judged += _judge_ends(key, bound, units[key], value, (value - half, value + half))
        if bound.change is not None:
            allowed = bound.change * abs(change.before)
            ends = (change.low, change.high)
            outcome = _compare(ends, -allowed, allowed)
            text = f"{change.difference:+.3g} [{ends[0]:+.3g}, {ends[1]:+.3g}]{suffix_unit(units[key])}"
            judged.append(
                Judged(key, f"change at most {bound.change:.3g} of {change.before:.3g}", text, outcome)
            )
    return judged


def _average(readings: Sequence[RunReading], index: int) -> tuple[float, float]:
    """Mean of a quantity over runs, and its standard error from the estimation errors of the runs."""
    known = [one.numbers for one in readings if one.numbers.known[index]]
    if not known:
        return math.nan, math.nan
    variances = [float(one.covariance[index, index]) for one in known]
    return float(np.mean([one.values[index] for one in known])), math.sqrt(sum(variances)) / len(known)


def _average_logs(readings: Sequence[RunReading], index: int, paces: Sequence[float]) -> tuple[float, float]:
    """As `_average`, for the logarithm of an error, not normalized by the speed of the runs."""
    value, deviation = _average(readings, index)
    known = [pace for one, pace in zip(readings, paces, strict=True) if one.numbers.known[index]]
    return value + (float(np.mean(np.log(known))) if known else math.nan), deviation


def _judge_slip(key: str, bound: Bound, sides: Sides) -> list[Judged]:
    ground = key.partition(".")[2]
    before, after = (
        [one for one in side if one.terrain == ground and math.isfinite(one.slip[1])]
        for side in (sides.before, sides.after)
    )
    if not after:
        return [Judged(key, _format_limit(bound, "m/s"), _format_no_run(ground, sides), "undetermined")]
    value = float(np.mean([one.slip[0] for one in after]))
    deviation = math.sqrt(sum(one.slip[1] ** 2 for one in after)) / len(after)
    change = None
    if before:
        runs = [
            RunNumbers(one.numbers.run, side, np.array([one.slip[0]]), np.array([[one.slip[1] ** 2]]))
            for side, readings in ((BEFORE, before), (AFTER, after))
            for one in readings
        ]
        (change,) = compare_sides(runs, np.array([USUAL_LOG_RATIO]))
    return _judge_log(key, bound, "m/s", (value, deviation), change)


def _format_no_run(ground: str, sides: Sides) -> str:
    """Explain why the slip on a terrain is unknown; a name that no run has is likely misspelt."""
    known = sorted({name for side in sides.terrains for name in side})
    if ground in known:
        is_driven = any(one.terrain == ground for one in sides.after)
        return f"the slip on {ground} is not known" if is_driven else f"no run AFTER on {ground}"
    grounds = f"the runs are on {', '.join(known)}" if known else "no run names its terrain"
    return f"no run is on {ground}. {guess_names(ground, known)}{grounds[0].upper()}{grounds[1:]}"


def _judge_log(
    key: str, bound: Bound, unit: str, value: tuple[float, float], change: Change | None
) -> list[Judged]:
    """Evaluate limits of a quantity that is estimated as a logarithm; only the growth of it is limited."""
    middle, half = value[0], NORMAL_95 * value[1]
    ends = (math.exp(middle - half), math.exp(middle + half))
    judged = _judge_ends(key, bound, unit, math.exp(middle), ends)
    if bound.change is not None:
        low, high = (math.nan, math.nan) if change is None else (change.low, change.high)
        text = "nothing to compare with"
        if change is not None and math.isfinite(low):
            grown = (math.expm1(one) for one in (change.difference, low, high))
            text = "{} [{}, {}] at equal speed".format(*map(_format_growth, grown))
        outcome = _compare((low, high), -math.inf, math.log1p(bound.change))
        judged.append(Judged(key, f"grows by at most {format_share(bound.change)}", text, outcome))
    return judged


def _format_growth(growth: float) -> str:
    return f"{'+' if growth > 0.0 else ''}{format_share(growth, 0)}"


def _judge_ends(key: str, bound: Bound, unit: str, value: float, ends: tuple[float, float]) -> list[Judged]:
    if bound.min is None and bound.max is None:
        return []
    low = -math.inf if bound.min is None else bound.min
    high = math.inf if bound.max is None else bound.max
    known = math.isfinite(value) and math.isfinite(ends[0])
    text = f"{format_interval(value, *ends)}{suffix_unit(unit)}" if known else "not observable"
    return [Judged(key, _format_limit(bound, unit), text, _compare(ends, low, high))]


def _compare(ends: tuple[float, float], low: float, high: float) -> Outcome:
    if ends[0] >= low and ends[1] <= high:
        return "kept"
    return "broken" if ends[1] < low or ends[0] > high else "undetermined"


def _format_limit(bound: Bound, unit: str) -> str:
    low = [] if bound.min is None else [f"at least {bound.min:.3g}"]
    high = [] if bound.max is None else [f"at most {bound.max:.3g}"]
    return f"{' and '.join([*low, *high])}{suffix_unit(unit)}".strip()


KEPT, UNDETERMINED, BROKEN = 0, 3, 4
"""Exit codes of a check."""
_MEDIAN = 0.67449
"""Median of a half-normal distribution, divided by its scale (its root mean square)."""


@dataclass(frozen=True)
class Check:
    """Changes between two sides.

    Attributes:
        sides: both sides.
        changes: changes of all quantities by name, the logarithms last.
        limits: outcomes of the limits; empty if none were given.
        moves: RMS shift of predictions over 2 s in AFTER by the changes, [m] and [rad]; None without changes.
        simulated: BEFORE is a simulation, whose runs have no spread.
        commanded: share of the commanded yaw rate that the robot reaches, as a logarithm; None where unknown.
    """

    sides: Sides
    changes: Mapping[str, Change]
    limits: tuple[Judged, ...] = ()
    moves: tuple[float, float] | None = None
    simulated: bool = False
    commanded: Change | None = None

    def list_status(self, status: str) -> list[str]:
        """Names of the quantities of a status, in order of increasing p-value."""
        names = [name for name, change in self.changes.items() if change.status == status]
        return sorted(names, key=lambda name: (self.changes[name].p, self.changes[name].p_within))

    def count_others(self) -> int:
        """Number of further runs of the vehicle that tell how much runs differ."""
        return sum(map(len, self.sides.others.values()))

    @property
    def is_spread_known(self) -> bool:
        """Whether some runs tell how much runs of this robot differ without a change."""
        return self.simulated or any(change.freedom > 0 for change in self.changes.values())

    def find_difference(self, name: str) -> tuple[float, float, float]:
        """Difference of a quantity and its 95 % interval: of these recordings where the spread is unknown."""
        change = self.changes[name]
        ends = (change.low, change.high) if self.is_spread_known else change.within
        return (change.difference, *ends)

    def is_unseen(self, name: str) -> bool:
        """Whether no change of a quantity was shown, and one of its own size could have been missed.

        That size is its distance from the neutral value, at least the usual one; of an error a doubling.
        """
        change = self.changes[name]
        if change.status != "unchanged" or name in LOGARITHMS:
            return change.status == "unchanged" and change.smallest > math.log(2.0)
        parameter = next(label.parameter for label in self.sides.labels if label.name == name)
        neutral = parameter.neutral if math.isfinite(parameter.neutral) else 0.0
        distances = (abs(change.before - neutral), abs(change.after - neutral))
        return not change.smallest <= max(*distances, parameter.usual_size)

    def name_outcome(self, name: str) -> str:
        """Status of a quantity; `unclear` in place of unchanged where a change could have been missed."""
        return "unclear" if self.is_unseen(name) else self.changes[name].status

    @property
    def code(self) -> int:
        """Exit code: by the limits if any are given, else by the changes."""
        if self.limits:
            outcomes = {one.outcome for one in self.limits}
            return BROKEN if "broken" in outcomes else UNDETERMINED if "undetermined" in outcomes else KEPT
        if self.list_status("changed"):
            return BROKEN
        return KEPT if self.is_compared and not self.list_status("differs") else UNDETERMINED

    @property
    def is_compared(self) -> bool:
        """Whether most of the model's numbers can be compared: a few do not show that nothing changed."""
        unknown, numbers = self.list_status("unknown"), {*self.changes} - {*LOGARITHMS}
        return len(unknown) < len(self.changes) and 2 * len(numbers & {*unknown}) <= len(numbers)


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
    """Test for changes between two sides.

    Args:
        before: runs, a model file, or a baseline.
        after: runs.
        store: results that contain the runs.
        source: `command` or `measured`; None chooses.
        owner: geometry to use where vehicles differ.
        limits: limits to evaluate.
        simulated: BEFORE is a simulation: the spread between runs is ignored.

    Raises:
        SlipError: see `read_sides` and `judge_limits`.
    """
    return compare(read_sides(before, after, store, source=source, owner=owner), limits, simulated=simulated)


def find_usual_spread(parameter: Parameter) -> float:
    """Scale of the half-normal prior of a parameter's spread between runs, in its unit.

    If the spread was measured for this parameter, it is the root mean square of the prior; otherwise the
    value measured for other parameters is the median of the prior.
    """
    size = parameter.spread.size
    return size if parameter.between_runs else size / _MEDIAN


def compare(sides: Sides, limits: Limits | None = None, *, simulated: bool = False) -> Check:
    """Compare two sides that were fitted with one model.

    What differs is looked at again with errors by the likelihood at the other side's value (`widen`).
    """
    asked: dict[str, Change] = {}
    while True:
        check = _compare_once(sides, limits, simulated=simulated)
        names = {label.name for label in sides.labels}
        fresh = {
            name: check.changes[name]
            for status in ("changed", "differs")
            for name in check.list_status(status)
            if name in names and name not in asked
        }
        if not fresh:
            return check
        asked |= fresh
        before, after = (
            {name: getattr(one, side) for name, one in fresh.items()} for side in (BEFORE, AFTER)
        )
        sides = replace(
            sides,
            before=tuple(widen(one, sides.labels, after) for one in sides.before),
            after=tuple(widen(one, sides.labels, before) for one in sides.after),
        )


def _compare_once(sides: Sides, limits: Limits | None, *, simulated: bool) -> Check:
    spreads = [find_usual_spread(label.parameter) for label in sides.labels]
    usual = np.array([*spreads, *(USUAL_LOGARITHMS[name] for name in LOGARITHMS)])
    names = [name for name in sides.names if name not in COMMANDED]
    names += [MULTIPLIER] if _is_set_anew(sides) else []

    turned = sides.names.index(MULTIPLIER)
    counts = {
        side: sum(bool(one.numbers.known[turned]) for one in runs)
        for side, runs in ((BEFORE, sides.before), (AFTER, sides.after))
    }

    def compare_named(some: Sequence[str]) -> list[Change]:
        places = [sides.names.index(name) for name in some]

        def pick(one: RunReading) -> RunNumbers:
            numbers = one.numbers
            covariance = numbers.covariance.copy()
            # The error of a multiplier is that of its side, whose mean it stays.
            covariance[turned, turned] *= max(counts[numbers.side], 1)
            return replace(
                numbers, values=numbers.values[places], covariance=covariance[np.ix_(places, places)]
            )

        return compare_sides(
            [pick(one) for one in (*sides.before, *sides.after)],
            usual[places],
            alike=simulated,
            others={name: [pick(one) for one in group] for name, group in sides.others.items()},
        )

    shifts = compare_named(names)
    # It follows from the multiplier and the parameters, which are tested: no question of its own.
    (commanded,) = compare_named([COMMANDED_TURN])
    ends = {label.name: label.parameter.bounds for label in sides.labels}
    changes = {
        name: _hold(change, *ends.get(name, (-math.inf, math.inf)))
        for name, change in zip(names, shifts, strict=True)
    }
    judged = () if limits is None else tuple(judge_limits(limits, sides, changes))
    moves = _measure_moves(sides, changes)
    known = None if commanded.status == "unknown" else commanded
    return Check(sides, changes, judged, moves, simulated, known)


def _is_set_anew(sides: Sides) -> bool:
    """Whether both sides know the controller's multiplier, and it is not the same in all runs."""
    index = sides.names.index(MULTIPLIER)
    values = [[one.numbers.values[index] for one in side] for side in (sides.before, sides.after)]
    known = [[value for value in side if math.isfinite(value)] for side in values]
    return all(known) and len({*itertools.chain(*known)}) > 1


def keep_baseline(check: Check, path: Path) -> None:
    """Write the side AFTER as a baseline for later checks, replacing an older one.

    Raises:
        ComparisonError: ``baseline_stays``: the check is broken, or a number differs, and a baseline already
            exists.
        MotionError: ``baseline_unwritable``.
    """
    differing = check.list_status("differs")
    if (check.code == BROKEN or differing) and path.exists():
        why = "the check is broken" if check.code == BROKEN else f"the runs differ in {', '.join(differing)}"
        what = f"{why}, and the baseline stays as it is"
        hint = "Delete it, if what is measured now is to be the new normal."
        raise ComparisonError("baseline_stays", what, where=str(path), hint=hint)
    write_text(path, format_baseline(check.sides), code="baseline_unwritable")


def _hold(change: Change, low: float, high: float) -> Change:
    """Clip the means to the parameter's bounds, which correlated errors can push them beyond."""
    before, after = np.clip((change.before, change.after), low, high).tolist()
    return replace(change, before=before, after=after)


def _measure_moves(sides: Sides, changes: Mapping[str, Change]) -> tuple[float, float] | None:
    """RMS shift of the predictions of AFTER caused by the changed parameters: [m] and [rad]."""
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
        run_residuals = fitted.data.residuals_by_run[0]
        shifts.append(run_residuals.find_horizon_shifts(both[1], both[0], fitted.state.timing[0])[:2])
    if not shifts:
        return None
    far, turned = (float(np.sqrt(np.mean(np.concatenate(one) ** 2))) for one in zip(*shifts, strict=True))
    return far, turned


def find_pace(sides: Sides) -> float:
    """Reference speed for the errors of both sides [m/s]: geometric mean over the runs of AFTER."""
    return math.exp(float(np.mean(np.log([one.pace for one in sides.after]))))


def check_as_json(check: Check, lines: Sequence[tuple[str, str]]) -> dict[str, object]:
    """The JSON object of `slip check`.

    Args:
        check: the check.
        lines: lines from `check_text.list_lines`, the verdict first.
    """
    sides = check.sides
    rows = [
        tabulate_change(sides, name, change) | {"status": check.name_outcome(name)}
        for name, change in check.changes.items()
    ]
    share = check.commanded
    moves = None if check.moves is None else {"position_m": check.moves[0], "heading_rad": check.moves[1]}
    return {
        "verdict": lines[0][1],
        "exit_code": check.code,
        "before": {"kind": sides.kind, "runs": [one.numbers.run for one in sides.before]},
        "after": {"kind": "runs", "runs": [one.numbers.run for one in sides.after]},
        "others": [one.numbers.run for group in sides.others.values() for one in group],
        "terrains": {"before": list(sides.terrains[0]), "after": list(sides.terrains[1])},
        "input": sides.source.value,
        "simulated": check.simulated,
        "effects": list(sides.model.model.ids),
        "numbers": rows,
        "commanded_turn": None if share is None else tabulate_change(sides, COMMANDED_TURN, share),
        "moves_predictions_over_2s": moves,
        "limits": [
            {"name": one.name, "limit": one.limit, "measured": one.measured, "outcome": one.outcome}
            for one in check.limits
        ],
        "lines": [list(line) for line in lines],
        "notes": list(sides.notes),
    }


def tabulate_change(sides: Sides, name: str, change: Change) -> dict[str, object]:
    """One quantity of a check in its unit; an error at the reference speed, its change as a fraction."""
    is_logarithm = name in LOGARITHMS
    unit = next((label.parameter.unit for label in sides.labels if label.name == name), "1")
    sizes = [change.before, change.after]
    parts = [change.low, change.high, *change.within, change.smallest, change.spread]
    if is_logarithm:
        unit = {POSITION_ERROR: "m", HEADING_ERROR: "rad"}.get(name, "1")
        pace = find_pace(sides) if name in ERRORS else 1.0
        sizes, parts = [pace * math.exp(one) for one in sizes], [math.expm1(one) for one in parts]
    before, after, low, high, low_within, high_within, smallest, spread = map(
        finite_or_none, (*sizes, *parts)
    )
    return {
        "number": name,
        "unit": unit,
        "status": change.status,
        "before": before,
        "after": after,
        "change_is": "share" if is_logarithm else "difference",
        "low": low,
        "high": high,
        "low_within_runs": low_within,
        "high_within_runs": high_within,
        "p": finite_or_none(change.p),
        "p_within_runs": finite_or_none(change.p_within),
        "p_alone": finite_or_none(change.p_alone),
        "smallest_found": smallest,
        "spread_between_runs": spread,
        "spread_is_default": change.is_default,
        "spread_freedom": change.freedom,
        "more_runs_a_side": change.count_missing(),
    }
