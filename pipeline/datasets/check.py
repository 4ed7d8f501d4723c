"""Check of two groups of runs: one table of what changed against how much runs differ, and limits."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from pipeline.core import (
    FEWEST_OF_SPREAD,
    TomlError,
    finite_or_none,
    format_share,
    guess_names,
    parse_toml,
    read_bounded_text,
    require_finite,
    suffix_unit,
)
from pipeline.datasets.check_readings import (
    COMMANDED_TURN,
    ERRORS,
    HEADING_ERROR,
    LOGARITHMS,
    MULTIPLIER,
    POSITION_ERROR,
    Estimate,
    RunReading,
)
from pipeline.datasets.check_sides import AFTER, BEFORE, Sides, read_sides
from pipeline.datasets.levels import Levels, adjust, fit_levels
from pipeline.datasets.pooling import ComparisonError
from pipeline.models import ModelFile, name_number
from pipeline.sources import Fault, Owner, convert_to
from pipeline.store import Manifest, Store

CHANCE = 0.02
"""Level of a check's tests: it reports a change where there is none in at most one of fifty checks."""
_POWER = 0.8
"""Probability of detecting a change of the smallest visible size."""
KEPT, UNDETERMINED, BROKEN = 0, 3, 4
"""Exit codes of a check."""
_HINT = "The handbook, Check a change, lists the keys."
_LEAST_VARIANCE = 1e-24
_SHARE = 0.25
"""Change of the share of a commanded turn or of a multiplier that must not be missed."""
Outcome = Literal["kept", "broken", "undetermined"]
Status = Literal["changed", "differs", "not shown", "unchanged", "unknown"]


Limit = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
"""In SI units, or a fraction; no quantity of a model is larger."""


class Bound(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One limit: `min` and `max` of the value in AFTER, `change` as a fraction of the value in BEFORE."""

    min: Limit | None = None
    max: Limit | None = None
    change: Limit | None = None


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of a file of limits.

    Attributes:
        error: limits of the model's errors over 2 s: `position` [m], `heading` [rad].
        parameter: limits by ``effect.parameter``, in the parameter's SI unit.
        slip: limits of the median slip modulus by terrain [m/s].
    """

    error: dict[Literal["position", "heading"], Bound] = {}
    parameter: dict[str, Bound] = {}
    slip: dict[str, Bound] = {}

    def list_bounds(self) -> Iterator[tuple[str, Bound]]:
        """All limits with the name of what they limit."""
        yield from ((f"error.{key}", bound) for key, bound in self.error.items())
        yield from self.parameter.items()
        yield from ((f"slip.{ground}", bound) for ground, bound in self.slip.items())


def read_limits(path: Path) -> Limits:
    """Read a file of limits.

    Raises:
        ComparisonError: ``bad_limits``: it does not exist, or a key or value in it is wrong.
    """
    where = str(path)
    try:
        tree = parse_toml(read_bounded_text(path))
        require_finite(tree)
    except OSError as error:
        what = f"the limits cannot be read ({error.strerror})"
        raise ComparisonError("bad_limits", what, where=where, hint=_HINT) from error
    except TomlError as error:
        where = where if error.line is None else f"{path}, line {error.line}"
        raise ComparisonError("bad_limits", str(error), where=where, hint=_HINT) from error
    except UnicodeDecodeError as error:
        what = f"the limits are not valid: {error}"
        raise ComparisonError("bad_limits", what, where=where, hint=_HINT) from error
    limits = convert_to(Limits, tree)
    if isinstance(limits, Fault):
        what = f"the limits are not valid: {limits.what}"
        raise ComparisonError("bad_limits", what, where=where, hint=limits.hint or _HINT)
    wrong = [text for name, bound in limits.list_bounds() if (text := _find_nonsense(name, bound))]
    if wrong or not any(limits.list_bounds()):
        raise ComparisonError("bad_limits", [*wrong, "the file sets no limit"][0], where=where, hint=_HINT)
    return limits


def _find_nonsense(name: str, bound: Bound) -> str:
    if bound == Bound():
        return f"{name} has no min, max or change"
    if bound.min is not None and bound.max is not None and bound.min > bound.max:
        return f"the min of {name} is above its max"
    if bound.change is not None and not bound.change > 0.0:
        return f"the change of {name} is not positive: it is a share, 0.1 is ten percent"
    return ""


@dataclass(frozen=True)
class CheckedNumber:
    """One row of a check: a quantity on both sides; unknown numbers are NaN.

    Attributes:
        name: ``effect.parameter``, or one of `LOGARITHMS`, or ``slip.`` with a terrain.
        title: what it is, in words.
        unit: its unit.
        is_ratio: whether difference, low, high, spread and smallest are shares of the value.
        before, after: means of the sides, errors at the speed of AFTER.
        after_low, after_high: 95 % interval of the mean of these runs AFTER.
        difference, low, high: after minus before with its 95 % interval; by the errors of these recordings
            alone where no runs tell how much runs differ.
        spread: how much runs differ, as a standard deviation; NaN where no runs tell.
        freedom: its degrees of freedom: runs that tell it, less one a group.
        chance: probability of a difference as large by the errors of these recordings, and by `spread` where
            runs tell it.
        chance_adjusted: the same over all numbers of the check (Benjamini and Hochberg).
        smallest: change that these runs show with a probability of 80 %.
        size: largest change that may be missed of what is `unchanged`: distance of a parameter from doing
            nothing, at least the usual one; a doubling of errors; a quarter of the share of a commanded turn
            and of the controller's multiplier.
    """

    name: str
    title: str
    unit: str
    is_ratio: bool
    before: float = math.nan
    after: float = math.nan
    after_low: float = math.nan
    after_high: float = math.nan
    difference: float = math.nan
    low: float = math.nan
    high: float = math.nan
    spread: float = math.nan
    freedom: float = 0.0
    chance: float = math.nan
    chance_adjusted: float = math.nan
    smallest: float = math.nan
    size: float = 1.0

    @property
    def is_known(self) -> bool:
        """Whether both sides have an estimate."""
        return math.isfinite(self.chance)

    @property
    def p(self) -> float:
        """Probability of a difference as large without a change; NaN where `spread` is not known."""
        return self.chance if math.isfinite(self.spread) else math.nan

    @property
    def p_adjusted(self) -> float:
        """`p` over all numbers of the check."""
        return self.chance_adjusted if math.isfinite(self.spread) else math.nan

    @property
    def status(self) -> Status:
        """What is shown of the number.

        `differs` is beyond the errors of these recordings, where no runs tell how much runs differ. What is
        `not shown` may have changed: its interval does not hold zero, or a change as large as `size` could
        have been missed.
        """
        if not self.is_known:
            return "unknown"
        if self.chance_adjusted > CHANCE:
            return "unchanged" if self.low <= 0.0 <= self.high and not self.is_coarse else "not shown"
        return "changed" if math.isfinite(self.spread) else "differs"

    @property
    def is_coarse(self) -> bool:
        """Whether a change as large as `size` could have been missed."""
        return not self.smallest <= self.size

    def to_json(self) -> dict[str, object]:
        """The row of `slip check --json`."""
        names = (
            *("before", "after", "after_low", "after_high", "difference", "low", "high"),
            *("spread", "freedom", "p", "p_adjusted", "smallest", "size"),
        )
        numbers = {name: finite_or_none(getattr(self, name)) for name in names}
        change = "share" if self.is_ratio else "difference"
        return {"number": self.name, "unit": self.unit, "status": self.status, "change_is": change, **numbers}


@dataclass(frozen=True)
class JudgedLimit:
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


@dataclass(frozen=True)
class RunsCheck:
    """Changes between two sides.

    Attributes:
        sides: both sides.
        numbers: all quantities, the surest change first.
        limits: outcomes of the limits; empty if none were given.
    """

    sides: Sides
    numbers: tuple[CheckedNumber, ...]
    limits: tuple[JudgedLimit, ...] = ()

    def list_status(self, status: Status) -> list[CheckedNumber]:
        """Numbers of a status."""
        return [one for one in self.numbers if one.status == status]

    @property
    def is_spread_known(self) -> bool:
        """Whether some runs tell how much runs of this robot differ without a change."""
        return any(math.isfinite(one.spread) for one in self.numbers if one.name != MULTIPLIER)

    @property
    def missing(self) -> int:
        """Further runs on the sides from which on they tell how much runs differ; 0 if they do."""
        groups = [group for group, _ in self.sides.grouped]
        return 0 if self.is_spread_known else max(FEWEST_OF_SPREAD - 1 - len(groups) + len({*groups}), 1)

    @property
    def is_single(self) -> bool:
        """Whether there is one run a side, and nothing tells how much runs differ."""
        counts = {len(side) for side in (self.sides.before, self.sides.after)}
        return counts == {1} and not self.is_spread_known

    @property
    def is_compared(self) -> bool:
        """Whether most of the model's numbers can be compared: a few do not show that nothing changed."""
        model = [one for one in self.numbers if one.name not in LOGARITHMS]
        known = [one for one in model if one.is_known]
        return 2 * len(known) >= len(model) and any(one.is_known for one in self.numbers)

    @property
    def code(self) -> int:
        """Exit code: by the limits if any are given, else by the changes."""
        if self.limits:
            outcomes = {one.outcome for one in self.limits}
            return BROKEN if "broken" in outcomes else UNDETERMINED if "undetermined" in outcomes else KEPT
        if self.list_status("changed"):
            return BROKEN
        coarse = [one for one in self.list_status("not shown") if one.is_coarse]
        missed = any(one.name not in LOGARITHMS for one in coarse)
        is_open = self.is_single or missed or bool(self.list_status("differs"))
        is_decided = self.is_compared and not is_open
        return KEPT if is_decided else UNDETERMINED

    def to_json(self, verdict: str, sentences: Sequence[str]) -> dict[str, object]:
        """The JSON object of `slip check`, with its verdict, and a sentence for each change."""
        sides = self.sides
        error = next(one for one in self.numbers if one.name == POSITION_ERROR)
        changed = self.list_status("changed")
        effects = [label.name for label in sides.labels]
        shown = ("before", "after", "low", "high")
        return {
            "verdict": verdict,
            "kept": {KEPT: True, BROKEN: False}.get(self.code),
            "exit_code": self.code,
            "before": {
                "kind": "model" if sides.is_model else "runs",
                "runs": [one.run for one in sides.before],
            },
            "after": {"kind": "runs", "runs": [one.run for one in sides.after]},
            "others": [one.run for runs in sides.others.values() for one in runs],
            "input": sides.source.value,
            "effects": list(sides.model.model.ids),
            "changes": [
                {
                    "effect": one.name.partition(".")[0] if one.name in effects else None,
                    "parameter": one.name.partition(".")[2] if one.name in effects else one.name,
                    "before": one.before,
                    "after": one.after,
                    "p_adjusted": one.p_adjusted,
                    "sentence": sentence,
                }
                for one, sentence in zip(changed, sentences, strict=True)
            ],
            "error": {key: finite_or_none(getattr(error, key) + (key in {"low", "high"})) for key in shown}
            | {"ratio": finite_or_none(1.0 + error.difference)},
            "smallest_visible_change": {one.name: finite_or_none(one.smallest) for one in self.numbers},
            "numbers": [one.to_json() for one in self.numbers],
            "limits": [vars(one) for one in self.limits],
            "notes": list(sides.notes),
        }


def check_runs(
    before: Sequence[Manifest] | ModelFile,
    after: Sequence[Manifest],
    store: Store,
    *,
    source: str | None = None,
    owner: Owner | None = None,
    limits: Limits | None = None,
    simulated: bool = False,
) -> RunsCheck:
    """Test for changes between two sides.

    Args:
        before: runs, or a model file.
        after: runs.
        store: results that contain the runs.
        source: `command` or `measured`; None chooses.
        owner: geometry to use where vehicles differ.
        limits: limits to evaluate.
        simulated: BEFORE is a simulation, whose runs do not differ.

    Raises:
        SlipError: see `read_sides`; ``unknown_limit``: the model of the check has no such quantity.
    """
    return compare_sides(
        read_sides(before, after, store, source=source, owner=owner), limits, simulated=simulated
    )


def compare_sides(sides: Sides, limits: Limits | None = None, *, simulated: bool = False) -> RunsCheck:
    """Compare two sides that were fitted with one model."""
    pace = math.exp(float(np.mean(np.log([one.pace for one in sides.after]))))
    blank = [
        CheckedNumber(
            label.name,
            name_number(label.effect.id, label.parameter.name),
            label.parameter.unit,
            is_ratio=False,
        )
        for label in sides.labels
    ]
    blank += [
        CheckedNumber(name, _TITLES[name], unit, is_ratio=True, size=1.0 if name in ERRORS else _SHARE)
        for name in LOGARITHMS
        for unit in [ERRORS.get(name, "1")]
    ]
    kinds = {label.name: label.parameter for label in sides.labels}
    numbers = []
    for one in blank:
        number = _compare(one, sides, simulated=simulated, scale=pace if one.name in ERRORS else 1.0)
        if (kind := kinds.get(one.name)) is not None:
            before, after = np.clip((number.before, number.after), *kind.bounds).tolist()
            neutral = kind.neutral if math.isfinite(kind.neutral) else 0.0
            size = max(abs(before - neutral), abs(after - neutral), kind.usual_size)
            number = replace(number, before=before, after=after, size=size)
        numbers.append(number)
    adjusted = adjust([finite_or_none(one.chance) for one in numbers])
    judged = [
        replace(one, chance_adjusted=math.nan if p is None else p)
        for one, p in zip(numbers, adjusted, strict=True)
    ]
    judged.sort(key=lambda one: (not one.is_known, one.chance_adjusted, one.chance if one.is_known else 0.0))
    check = RunsCheck(sides, tuple(judged))
    return (
        check if limits is None else replace(check, limits=tuple(_judge(limits, check, simulated=simulated)))
    )


_TITLES = {
    POSITION_ERROR: "remaining position error",
    HEADING_ERROR: "remaining heading error",
    COMMANDED_TURN: "share of asked yaw rate",
    MULTIPLIER: "controller's multiplier",
}


def _compare(blank: CheckedNumber, sides: Sides, *, simulated: bool, scale: float = 1.0) -> CheckedNumber:
    """Compare one quantity of both sides."""
    known = [(group, estimate) for group, run in sides.grouped if (estimate := _read(run, blank.name))]
    counts = {side: sum(group == side for group, _ in known) for side in (BEFORE, AFTER)}
    if not all(counts.values()):
        means = {
            side: float(np.mean([value for group, (value, _) in known if group == side]))
            if count
            else math.nan
            for side, count in counts.items()
        }
        before, after = (_show(blank, means[side], scale) for side in (BEFORE, AFTER))
        return replace(blank, before=before, after=after)
    groups = [group for group, _ in known]
    values = np.array([value for _, (value, _) in known])
    variances = np.array([max(error**2, _LEAST_VARIANCE) for _, (_, error) in known])
    # A multiplier is the same in all runs of a side, and so is its error.
    is_set = blank.name == MULTIPLIER
    if is_set:
        variances = variances * np.array([counts.get(group, 1) for group in groups])
    within = fit_levels(values, groups, variances, spread=0.0)
    fit = within if simulated or is_set else fit_levels(values, groups, variances)
    is_known = fit.is_known
    fit = fit if is_known else within
    one = fit.compare(BEFORE, AFTER)
    show = math.expm1 if blank.is_ratio else float
    end = within.bound(within.names.index(AFTER))
    return replace(
        blank,
        before=_show(blank, _mean(fit, BEFORE), scale),
        after=_show(blank, _mean(fit, AFTER), scale),
        after_low=_show(blank, end[0], scale),
        after_high=_show(blank, end[1], scale),
        difference=show(one.value),
        low=show(one.low),
        high=show(one.high),
        spread=show(fit.spread) if is_known else math.nan,
        freedom=fit.freedom if is_known and not (simulated or is_set) else 0.0,
        chance=one.p,
        smallest=show(one.error * _count_errors(fit)),
    )


def _count_errors(fit: Levels) -> float:
    """Standard errors that a change must have to be shown with a probability of `_POWER`."""
    from scipy.stats import t  # noqa: PLC0415 - heavy

    return float(t.isf(0.5 * CHANCE, fit.freedom) + t.isf(1.0 - _POWER, fit.freedom))


def _mean(fit: Levels, side: str) -> float:
    return float(fit.means[fit.names.index(side)])


def _show(number: CheckedNumber, value: float, scale: float) -> float:
    return scale * math.exp(value) if number.is_ratio else value


def _read(run: RunReading, name: str) -> Estimate | None:
    """Estimate of a run; None if it has none."""
    if not name.startswith("slip."):
        return run.estimates.get(name)
    return run.slip if run.terrain == name[len("slip.") :] and math.isfinite(run.slip[1]) else None


def _judge(limits: Limits, check: RunsCheck, *, simulated: bool) -> Iterator[JudgedLimit]:
    """Evaluate every limit, by the intervals of the table."""
    numbers = {one.name: one for one in check.numbers}
    for name, bound in limits.list_bounds():
        if name.startswith("slip."):
            blank = CheckedNumber(name, name, "m/s", is_ratio=True)
            number = _compare(blank, check.sides, simulated=simulated)
            if not math.isfinite(number.after_low):
                alone = _compare(blank, replace(check.sides, before=check.sides.after), simulated=simulated)
                number = replace(
                    blank, after=alone.after, after_low=alone.after_low, after_high=alone.after_high
                )
        elif name in numbers:
            number = numbers[name]
        else:
            known = ", ".join(label.name for label in check.sides.labels) or "none"
            hint = f"{guess_names(name, [*numbers])}The model of this check has: {known}."
            raise ComparisonError("unknown_limit", f"no number is called {name}", where="limits", hint=hint)
        yield from _judge_number(number, bound, check.sides)


def _judge_number(number: CheckedNumber, bound: Bound, sides: Sides) -> Iterator[JudgedLimit]:
    unit = suffix_unit(number.unit)
    if bound.min is not None or bound.max is not None:
        ends = (number.after_low, number.after_high)
        known = all(map(math.isfinite, ends))
        text = (
            f"{number.after:.3g} [{ends[0]:.3g}, {ends[1]:.3g}]{unit}" if known else _explain(number, sides)
        )
        low = -math.inf if bound.min is None else bound.min
        high = math.inf if bound.max is None else bound.max
        parts = [f"at least {bound.min:.3g}"] if bound.min is not None else []
        parts += [f"at most {bound.max:.3g}"] if bound.max is not None else []
        yield JudgedLimit(number.name, f"{' and '.join(parts)}{unit}", text, _judge_ends(ends, low, high))
    if bound.change is not None:
        known = math.isfinite(number.spread)
        ends = (number.low, number.high) if known else (math.nan, math.nan)
        if number.is_ratio:
            limit, low, high = f"grows by at most {format_share(bound.change)}", -math.inf, bound.change
            shares = [f"{100.0 * one:+.2g}" for one in (number.difference, *ends)]
            text = f"{shares[0]} % [{shares[1]}, {shares[2]}] at equal speed"
        else:
            high = bound.change * abs(number.before)
            limit, low = f"change at most {bound.change:.3g} of {number.before:.3g}", -high
            text = f"{number.difference:+.3g} [{ends[0]:+.3g}, {ends[1]:+.3g}]{unit}"
        text = text if known else "how much runs differ is not known"
        yield JudgedLimit(number.name, limit, text, _judge_ends(ends, low, high))


def _judge_ends(ends: tuple[float, float], low: float, high: float) -> Outcome:
    if ends[0] >= low and ends[1] <= high:
        return "kept"
    return "broken" if ends[1] < low or ends[0] > high else "undetermined"


def _explain(number: CheckedNumber, sides: Sides) -> str:
    """Why a number is not known AFTER; a terrain that no run has is likely misspelt."""
    start, _, ground = number.name.partition(".")
    if start != "slip":
        return "not observable"
    known = sorted({name for side in sides.terrains for name in side})
    if ground in known:
        return f"the slip on {ground} is not known AFTER"
    grounds = f"the runs are on {', '.join(known)}" if known else "no run names its terrain"
    return f"no run is on {ground}. {guess_names(ground, known)}{grounds[0].upper()}{grounds[1:]}"
