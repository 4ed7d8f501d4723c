"""Contents of a run's diagnosis as values, as JSON and as tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, cast

from pipeline.core import (
    JSON_DIGITS,
    count_places,
    finite_or_none,
    format_interval,
    pick_finite,
    round_digits,
    split_interval,
    suffix_unit,
)
from pipeline.estimation.error_regions import Growth, Region, format_enough
from pipeline.estimation.plausibility import Moves
from pipeline.estimation.verdict import format_verdict
from pipeline.models import format_model
from pipeline.models.catalogue import find_effect
from pipeline.models.parameter import AT_BOUND, UNDETERMINED, Level, Reading

if TYPE_CHECKING:
    import polars as pl

    from pipeline.estimation.ambiguity import Detectable, Undecided, Unobservable
    from pipeline.estimation.apportion import Moments, SlipBudget
    from pipeline.estimation.commanded import CommandedTurn
    from pipeline.models import ModelFile

Json = None | bool | int | float | str | Sequence["Json"] | Mapping[str, "Json"]

CAUSE = ". Cause: "
"""Separator between an effect and its possible causes in the sentence of a named effect."""
_TIGHT = 10.0
"""Expected range between runs over the interval in this run above which a row says so: a limit that clips the
samples of one run is known to a fraction of a percent there, and not in the next run."""


@dataclass(frozen=True)
class Value:
    """A value with its 95 % interval, NaN where there is none, and whether it is at its bound.

    `another_run`: expected interval in another run on this ground. `one_sided`: `Parameter.is_one_sided`.
    `is_spread_measured`: whether the spread between runs was measured, not only assumed.
    """

    value: float
    low: float
    high: float
    unit: str
    at_bound: bool = False
    another_run: tuple[float, float] = (math.nan, math.nan)
    one_sided: bool = False
    is_spread_measured: bool = False

    @property
    def is_undetermined(self) -> bool:
        """Whether the runs do not determine it: no finite interval, one limit only, or at its bound."""
        return self.at_bound or self.one_sided or not math.isfinite(self.high - self.low)

    @property
    def half(self) -> float:
        """The wider half of its interval: the other half may be cut at a bound of the parameter."""
        return max(self.high - self.value, self.value - self.low)

    @property
    def digits(self) -> int:
        """Significant digits that its interval supports, at least one; as in JSON where it has none."""
        if not self.value or not 0.0 < self.half < math.inf:
            return JSON_DIGITS
        places = count_places(self.half)
        return min(max(math.floor(math.log10(abs(self.value))) + places + 1, 1), JSON_DIGITS)

    @property
    def suffix(self) -> str:
        """The unit as a suffix of a number; empty where dimensionless."""
        return suffix_unit(self.unit)

    def __str__(self) -> str:
        """The value as text, with its interval where there is one, and whether it is at its bound."""
        text = f"{round_digits(self.value, self.digits):.3g}{self.suffix}"
        if math.isfinite(self.high - self.low):
            text = format_interval(self.value, self.low, self.high, self.unit)
        elif math.isfinite(self.low):
            text += f" [{self.low:.3g}, {self.high:.3g}]"
        if self.at_bound:
            return f"{text} ({AT_BOUND})"
        return f"{text} ({UNDETERMINED})" if self.is_undetermined else text

    def format_with_range(self) -> str:
        """The value as text; where its interval says little about another run, that it is this run's.

        The range between runs stands beside it where it was measured how much runs differ.
        """
        low, high = self.another_run
        if not high - low > _TIGHT * (self.high - self.low):
            return str(self)
        _, *ends = split_interval(self.value, low, high)
        return f"{self} this run" + (f", [{', '.join(ends)}] another" if self.is_spread_measured else "")

    def move(self, change: float) -> Value:
        """The value and its intervals shifted by a known amount."""
        low, high = self.another_run
        return replace(
            self, value=self.value + change, low=self.low + change, high=self.high + change,
            another_run=(low + change, high + change),
        )  # fmt: skip

    def to_json(self) -> dict[str, Json]:
        """The estimate of this run."""
        return {
            **_numbers(self, "value", "low", "high"),
            "unit": self.unit,
            "at_bound": self.at_bound,
            "undetermined": self.is_undetermined,
        }


def split_determined(numbers: Mapping[str, Value]) -> tuple[dict[str, Value], dict[str, Value]]:
    """Values that the runs determine, and those that they leave open or that are at a bound."""
    known = {name: value for name, value in numbers.items() if not value.is_undetermined}
    return known, {name: value for name, value in numbers.items() if name not in known}


def format_numbers(numbers: Mapping[str, Value]) -> str:
    """Values of an effect by parameter, with their intervals."""
    return ", ".join(f"{name} = {value}" for name, value in numbers.items())


@dataclass(frozen=True)
class Named:
    """An effect that is missing from the model.

    Attributes:
        id: the simplest of its class.
        parameters: its values.
        gain: relative rise of the held-out loss when it alone is dropped.
        equivalent_to: ids of equivalent effects.
        confused_with: effects that look alike at first order.
        corrected: whether it is a clock corrected before any fit, which the written model does not contain.
        path: on which it was identified: `command`, `measured` or `wheels`.
        selected: share of resampled recordings in which its gain reaches the threshold.
        motion: the vehicle's motion due to it as text, with its values.
        moves: its change of predictions over 2 s; None where the model does not contain it.
        growth: its evidence and intervals by driving time; None where the model does not contain it.
        by_run: its values in each of the runs that were judged together, where each has its own; those of
            this run are `parameters`.
        clause: the vehicle's motion due to it as a clause of a sentence, with its values.
    """

    id: str
    parameters: Mapping[str, Value]
    gain: float
    equivalent_to: tuple[str, ...]
    confused_with: tuple[str, ...]
    corrected: bool
    path: str
    selected: float
    motion: str
    moves: Moves | None = None
    growth: Growth | None = None
    by_run: tuple[Mapping[str, Value], ...] = ()
    clause: str = ""

    @property
    def readings(self) -> tuple[Reading, ...]:
        """Its meanings as a property of the vehicle, the ground or the run, which one run cannot separate."""
        known = find_effect(self.id).readings
        if self.corrected:
            # The delay comes from the gyro, so it is that of the pose clock and not of the body.
            known = tuple(one for one in known if one.name == self.id)
        return tuple(one for one in known if one.level is Level.RUN) if self.by_run else known

    @property
    def is_determined(self) -> bool:
        """Whether the runs determine one of its numbers; a corrected clock was measured beforehand."""
        return self.corrected or bool(self.by_run) or not self.parameters or bool(self.shown)

    @property
    def shown(self) -> Mapping[str, Value]:
        """The values that the runs determine; all those of a corrected clock."""
        return self.parameters if self.corrected else split_determined(self.parameters)[0]

    @property
    def sentence(self) -> str:
        """The effect with its values, and its possible causes where one run cannot separate them."""
        texts = {reading.name: reading.text for reading in reversed(self.readings)}
        if len(texts) <= 1:
            return self.motion
        between = ", or " if any(" or " in text for text in texts.values()) else " or "
        return f"{self.motion}{CAUSE}{between.join(texts.values())}; a run on another surface separates them."

    def to_json(self) -> dict[str, Json]:
        """The documented keys, and more."""
        return {
            "id": self.id,
            "sentence": self.sentence,
            "clause": self.clause,
            "parameters": {
                name: value.to_json()
                | {"another_run": dict(zip(("low", "high"), map(_clean, value.another_run), strict=True))}
                for name, value in self.parameters.items()
            },
            "gain": _clean(self.gain),
            "equivalent_to": list(self.equivalent_to),
            "confused_with": list(self.confused_with),
            "corrected": self.corrected,
            "found_on": self.path,
            "selection_frequency": _clean(self.selected),
            "level": None,
            "could_be": [
                {"level": one.level.value, "name": one.name, "text": one.text} for one in self.readings
            ],
            "moves": None if self.moves is None else _numbers(self.moves, *vars(self.moves)),
            "growth": None if self.growth is None else self.growth.to_json(),
        }


@dataclass(frozen=True)
class EstimatedNumber:
    """Estimate of a parameter in a run, whether or not the effect was identified: the data of fleet fits.

    Attributes:
        input: `command` or `measured`, from which the model predicts.
        effect, parameter, unit: which parameter.
        value: the estimate; for an effect that was not identified, that of one step of a joint fit.
        standard_error: half of its 95 % interval over 1.96.
        named: whether the diagnosis names the effect.
        at_bound: whether it is at a bound of the search.
        in_model: whether the written model contains the effect, including one of each undecided group.
    """

    input: str
    effect: str
    parameter: str
    unit: str
    value: float
    standard_error: float
    named: bool
    at_bound: bool
    in_model: bool


@dataclass(frozen=True)
class Unexplained:
    """Structure of the residual that no catalogued effect explains.

    Attributes:
        share: of the held-out loss of the model that a function of the recorded signals removes; or of the
            residual's variance that is correlated for longer than noise and random motion.
        channel: x, y or w.
        channels: every channel with structure.
        where: as text.
        formula: a formula effect as text of a model file, a suggestion that no model holds; None where none
            was found, or it does not lower the errors over 2 s.
        partial: signal that the structure depends on most: name, and mean error by value; empty where it
            depends on no recorded signal.
        path: of the search that identified it.
        reached: held-out errors of the model with the formula; empty without one.
    """

    share: float
    channel: str
    channels: tuple[str, ...]
    where: str
    formula: str | None
    partial: Mapping[str, Json]
    path: str
    reached: Mapping[str, Json] = field(default_factory=dict)

    def to_json(self) -> dict[str, Json]:
        """The documented keys, and more."""
        return {
            "share": _clean(self.share),
            "channel": self.channel,
            "channels": list(self.channels),
            "where": self.where,
            "formula": self.formula,
            "with_formula": dict(self.reached) or None,
            "partial_dependence": self.partial,
            "found_on": self.path,
        }


@dataclass(frozen=True)
class RunDiagnosis:
    """Effects missing from the model of one run, or of several runs of one vehicle together.

    Attributes:
        run: its name.
        input: `command` or `measured`, from which the model predicts.
        input_reason: reason for this input; empty where nothing was fitted.
        joint: names of all runs that were judged together.
        effects: missing effects.
        undecided: alternatives that fit equally well.
        unobservable: effects not observable in this log.
        detectable: detection limits of the other effects that were not identified.
        unexplained: residual structure without a known cause; None without.
        findings: of the stages and of the diagnosis.
        ladder: steps with their held-out errors.
        noise_floor: repeatability of the motion under the same input, as errors.
        explained_share: of the removable error; NaN where the ideal model is at the noise floor.
        where: the few regions with most of the error of the ideal model.
        when: the times with half of the error that the model leaves.
        timing: delays, and the source of the heading.
        by_path: separate ladders of the drivetrain and of the ground, where there are encoders.
        disturbance: RMS of the residual in x, y, w, and its part that is correlated over seconds.
        lead: sentence on what the residual of the final model indicates; empty without an indication.
        proposal: model file with the identified effects, fitted; None where no model could be judged.
        budgets: causes of the slip and of the 2 s errors of the ideal model, for each input.
        estimates: parameters of all effects that these runs determine.
        learned: gain of a learned term beyond them, see `learned_as_json`; empty where nothing was judged.
        commanded_turn: share of the commanded yaw rate that the robot reaches; None without a body command.
    """

    run: str
    input: str
    input_reason: str = ""
    joint: tuple[str, ...] = ()
    effects: tuple[Named, ...] = ()
    undecided: tuple[Undecided, ...] = ()
    unobservable: tuple[Unobservable, ...] = ()
    detectable: tuple[Detectable, ...] = ()
    unexplained: Unexplained | None = None
    findings: tuple[Mapping[str, Json], ...] = ()
    ladder: tuple[Mapping[str, Json], ...] = ()
    noise_floor: Mapping[str, Json] = field(default_factory=dict)
    explained_share: float = math.nan
    where: tuple[Region, ...] = ()
    when: tuple[Moments, ...] = ()
    timing: Mapping[str, Json] = field(default_factory=dict)
    by_path: Mapping[str, Json] = field(default_factory=dict)
    disturbance: Mapping[str, Json] = field(default_factory=dict)
    lead: str = ""
    proposal: ModelFile | None = None
    budgets: tuple[SlipBudget, ...] = ()
    estimates: tuple[EstimatedNumber, ...] = ()
    learned: Mapping[str, Json] = field(default_factory=dict)
    commanded_turn: CommandedTurn | None = None

    def find_held(self, item: Undecided) -> str | None:
        """The candidate that the model contains, whose error is that of any of them; None without."""
        ids = () if self.proposal is None else self.proposal.model.ids
        return next((name for name in item.candidates if name in ids), None)

    def to_json(self) -> dict[str, Json]:
        """The documented keys of `slip diagnose --json` for one run, and more."""
        content = self._list_content()
        return {"run": self.run, "verdict": format_verdict(content), **content}

    def _list_content(self) -> dict[str, Json]:
        return {
            "input": self.input,
            "input_reason": self.input_reason or None,
            "joint_with": [name for name in self.joint if name != self.run],
            "effects": [effect.to_json() for effect in self.effects],
            "undecided": [
                {
                    "candidates": list(item.candidates),
                    "separate_by": item.separate_by,
                    "in_model": self.find_held(item),
                    "parameters": {effect: _values(values) for effect, values in item.numbers.items()},
                }
                for item in self.undecided
            ],
            "unobservable": [item.id for item in self.unobservable],
            "unobservable_why": {
                item.id: {"reason": item.reason, "manoeuvre": item.manoeuvre} for item in self.unobservable
            },
            "detectable": [
                {"effect": one.id, "parameter": one.parameter, **_numbers(one, "size"), "unit": one.unit}
                for one in self.detectable
            ],
            "unexplained": None if self.unexplained is None else self.unexplained.to_json(),
            "findings": list(self.findings),
            "ladder": list(self.ladder),
            "noise_floor": dict(self.noise_floor),
            "explained_share": _clean(self.explained_share),
            "where": [
                {
                    "channel": region.channel,
                    "kind": region.kind,
                    "region": region.text,
                    **_numbers(region, "share", "time_share", "expected", "rms"),
                    "text": region.sentence,
                }
                for region in self.where
            ],
            "when": [one.to_json() for one in self.when],
            "timing": dict(self.timing),
            "by_way": dict(self.by_path),
            "disturbance": dict(self.disturbance),
            "model": None if self.proposal is None else format_model(self.proposal),
            "budget": [budget.to_json() for budget in self.budgets],
            "enough": format_enough(self.effects, self.findings) or None,
            "learned": dict(self.learned),
            "commanded_turn": None if self.commanded_turn is None else self.commanded_turn.to_json(),
        }


@dataclass(frozen=True)
class Diagnosis:
    """The diagnosis of one run, or of several of one vehicle together."""

    runs: tuple[RunDiagnosis, ...]

    def to_json(self) -> list[dict[str, Json]]:
        """One object per run."""
        return [run.to_json() for run in self.runs]

    def tabulate(self, table: str, run: str) -> pl.DataFrame:
        """One run's rows of `ladder`, `parameters`, `budget` or `estimates` (without the run's own columns).

        Steps and noise floor, values of named effects, causes of slip and errors, estimates of all effects.
        """
        from schemas import tabulate  # noqa: PLC0415 - heavy

        return tabulate(table, [row for item in self.runs if item.run == run for row in _ROWS[table](item)])


def _ladder_rows(item: RunDiagnosis) -> list[dict[str, Json]]:
    rows: list[dict[str, Json]] = []
    before: set[str] = set()
    rungs = [("rung", step) for step in item.ladder]
    if item.noise_floor:
        rungs.append(("floor", item.noise_floor))
    for number, (kind, step) in enumerate(rungs):
        names = [str(name) for name in cast("Sequence[Json]", step.get("effects", []))]
        x, y, w = cast("Sequence[float]", step["velocity_rms"])
        rows.append(
            {
                "input": item.input,
                "rung": number,
                "added": ", ".join(name for name in names if name not in before),
                "effects": ", ".join(names),
                "rms_x": x,
                "rms_y": y,
                "rms_w": w,
                "t_mrmse": step["t_mrmse_m"],
                "r_mrmse": step["r_mrmse_rad"],
                "explained_share": step.get("explained_share"),
                "kind": kind,
            }
        )
        before |= set(names)
    return rows


def _parameter_rows(item: RunDiagnosis) -> list[dict[str, Json]]:
    return [
        {"input": item.input, "effect": effect.id, "parameter": name, **value.to_json()}
        for effect in item.effects
        for name, value in effect.parameters.items()
        if math.isfinite(value.value)
    ]


def _budget_rows(item: RunDiagnosis) -> list[dict[str, Json]]:
    return [
        {
            "input": budget.input,
            "quantity": budget.quantity,
            "kind": share.kind,
            "name": share.name,
            "mean_square": share.share * budget.total,
            "unit": budget.unit,
            **share.pick("alone", "last"),
            "stretches": budget.stretches,
        }
        for budget in item.budgets
        for share in budget.shares
    ]


_ROWS: Mapping[str, Callable[[RunDiagnosis], list[dict[str, Json]]]] = {
    "ladder": _ladder_rows,
    "parameters": _parameter_rows,
    "budget": _budget_rows,
    "estimates": lambda item: [vars(number) for number in item.estimates],
}


def _clean(value: float) -> float | None:
    """A number for JSON: six digits, null where it is not finite."""
    return finite_or_none(value, JSON_DIGITS)


def _numbers(item: object, *names: str) -> dict[str, Json]:
    return {**pick_finite(item, *names, digits=JSON_DIGITS)}


def _values(values: Mapping[str, Value]) -> dict[str, Json]:
    return {name: value.to_json() for name, value in values.items()}
