"""What a diagnosis says of a run, as values, as JSON and as tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, cast

from pipeline.core.program import JSON_DIGITS, finite_or_none, pick_finite
from pipeline.estimation.acceptance import LEAST_TURN_RAD, LEAST_WAY_SHARE, Moves
from pipeline.estimation.error_regions import Growth, Region, format_enough
from pipeline.estimation.verdict import format_verdict
from pipeline.models.catalogue import find_effect
from pipeline.models.model_text import format_model
from pipeline.models.parameter import UNDETERMINED, Level, Reading
from pipeline.run.windows import HORIZON_S

if TYPE_CHECKING:
    import polars as pl

    from pipeline.estimation.ambiguity import Undecided
    from pipeline.estimation.apportion import SlipBudget
    from pipeline.estimation.estimates import Unless
    from pipeline.estimation.search import Detectable, Unobservable
    from pipeline.models import ModelFile

Json = None | bool | int | float | str | Sequence["Json"] | Mapping[str, "Json"]

_ENDS = ("share", "low", "high")
CAUSE = ". Cause: "
"""Between an effect and its possible causes in the sentence of a named effect."""


@dataclass(frozen=True)
class Value:
    """A number with its 95 % interval, NaN where there is none, and whether it may go no further.

    `another_run` is the interval in which another run of the vehicle on this ground would show it.
    """

    value: float
    low: float
    high: float
    unit: str
    at_bound: bool = False
    another_run: tuple[float, float] = (math.nan, math.nan)

    @property
    def is_undetermined(self) -> bool:
        """Whether the runs leave it open: no interval narrower than all it can be, or at its bound."""
        return self.at_bound or not math.isfinite(self.high - self.low)

    @property
    def half(self) -> float:
        """The wider half of its interval: the other may end at what the number can be."""
        return max(self.high - self.value, self.value - self.low)

    @property
    def suffix(self) -> str:
        """Its unit behind a number, empty where it has none."""
        return "" if self.unit == "1" else f" {self.unit}"

    def __str__(self) -> str:
        """As it is told: the number, its interval where there is one, and whether it may go no further."""
        text = f"{self.value:.3g}{self.suffix}"
        if math.isfinite(self.low):
            text += f" [{self.low:.3g}, {self.high:.3g}]"
        if self.at_bound:
            return f"{text} (at its bound)"
        return f"{text} ({UNDETERMINED})" if self.is_undetermined else text

    def move(self, change: float) -> Value:
        """The number with its intervals, larger by a change that is known."""
        low, high = self.another_run
        return replace(
            self, value=self.value + change, low=self.low + change, high=self.high + change,
            another_run=(low + change, high + change),
        )  # fmt: skip

    def to_json(self) -> dict[str, Json]:
        """What this run says."""
        return {
            **_numbers(self, "value", "low", "high"),
            "unit": self.unit,
            "at_bound": self.at_bound,
            "undetermined": self.is_undetermined,
        }


def format_numbers(numbers: Mapping[str, Value]) -> str:
    """Numbers of an effect by name, with their intervals."""
    return ", ".join(f"{name} = {value}" for name, value in numbers.items())


@dataclass(frozen=True)
class Named:
    """An effect that is missing from the model.

    Attributes:
        id: the simplest of its class.
        parameters: its numbers.
        gain: relative rise of the held-out loss when it alone is dropped.
        equivalent_to: other names of the same thing.
        confused_with: what it looks like at first order.
        corrected: whether it is a clock that was corrected before any model: no effect of the written one.
        path: on which way it was found: `command`, `measured` or `wheels`.
        selected: share of resampled recordings in which it is still worth its place.
        motion: what the vehicle does by it, with its numbers.
        tentative: it lowers no error on its own path, or it is named as a stand-in.
        moves: how far it moves predictions over 2 s; None where the model does not hold it.
        growth: what was known of it by when; None where the model does not hold it.
        by_run: its numbers in each of the runs that were judged together, where each has its own; those of
            this run are `parameters`.
        unless: effects that may act beside it, with which its numbers are others.
        as_if: in words which of its numbers are beyond the observed range, so that it is a stand-in; empty
            where none is.
        clause: what the vehicle does by it as a clause of a sentence, with its numbers.
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
    tentative: bool = False
    moves: Moves | None = None
    growth: Growth | None = None
    by_run: tuple[Mapping[str, Value], ...] = ()
    unless: tuple[Unless, ...] = ()
    as_if: str = ""
    clause: str = ""

    @property
    def readings(self) -> tuple[Reading, ...]:
        """What it is if it belongs to the vehicle, the ground or the run, which one run cannot tell."""
        known = find_effect(self.id).readings
        if self.corrected:
            # A gyro has dated the poses: what is late is their clock, and not the body.
            known = tuple(one for one in known if one.name == self.id)
        return tuple(one for one in known if one.level is Level.RUN) if self.by_run else known

    @property
    def tellings(self) -> tuple[Mapping[str, Value], ...]:
        """Its numbers, once or for each run."""
        return self.by_run or (self.parameters,)

    @property
    def sentence(self) -> str:
        """The effect with its numbers, and its possible causes where one run cannot separate them."""
        if self.as_if:
            return f"{self.motion}; {self.as_if}, so that the cause is another effect"
        texts = {reading.name: reading.text for reading in reversed(self.readings)}
        if len(texts) <= 1:
            return self.motion
        between = ", or " if any(" or " in text for text in texts.values()) else " or "
        return f"{self.motion}{CAUSE}{between.join(texts.values())}; a run on another surface separates them."

    @property
    def doubt(self) -> str:
        """What is to be said behind its clause where it is no plain fact; else empty."""
        if self.as_if:
            return " (a stand-in for another cause)"
        return " (tentative)" if self.tentative else ""

    def to_json(self) -> dict[str, Json]:
        """The promised keys, and more."""
        return {
            "id": self.id,
            "sentence": self.sentence,
            "clause": self.clause + self.doubt,
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
            "tentative": self.tentative,
            "level": None,
            "could_be": [
                {"level": one.level.value, "name": one.name, "text": one.text} for one in self.readings
            ],
            "moves": None if self.moves is None else _numbers(self.moves, *vars(self.moves)),
            "growth": None if self.growth is None else self.growth.to_json(),
            "unless": [
                {
                    "effect": one.id,
                    "parameters": _values(one.parameters),
                    **_numbers(one, "gain", "evidence"),
                    "instead": _values(one.instead),
                    "text": one.sentence,
                }
                for one in self.unless
            ],
        }


@dataclass(frozen=True)
class EstimatedNumber:
    """A number of an effect in a run, whether or not the effect was named: what fleets are fitted to.

    Attributes:
        input: `command` or `measured`, from which the model predicts.
        effect, parameter, unit: which number.
        value: the estimate; of an effect that was not named what one step of a joint fit gives it.
        standard_error: half of its 95 % interval over 1.96.
        named: whether the diagnosis names the effect.
        at_bound: whether it stopped at a bound of the search.
        in_model: whether the written model holds the effect: one of each undecided group, too.
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
    """Structure that no catalogued effect takes.

    Attributes:
        share: of the held-out loss of the named model that a function of the recorded signals takes away; or
            of the residual's variance that lasts longer than noise and random motion do.
        channel: x, y or w.
        channels: every channel with structure.
        where: in words.
        formula: a formula effect as text of a model file; None where none was found.
        partial: what the structure depends on most: name, and mean error by value; empty where it depends on
            nothing that was recorded.
        path: on which way it was found.
    """

    share: float
    channel: str
    channels: tuple[str, ...]
    where: str
    formula: str | None
    partial: Mapping[str, Json]
    path: str

    def to_json(self) -> dict[str, Json]:
        """The promised keys, and more."""
        return {
            "share": _clean(self.share),
            "channel": self.channel,
            "channels": list(self.channels),
            "where": self.where,
            "formula": self.formula,
            "partial_dependence": self.partial,
            "found_on": self.path,
        }


@dataclass(frozen=True)
class RunDiagnosis:
    """What is missing from the model of one run, or of several runs of one vehicle together.

    Attributes:
        run: its name.
        input: `command` or `measured`, from which the model predicts.
        input_reason: why; empty where nothing was fitted.
        joint: names of all runs that were judged together.
        effects: what is missing.
        immaterial: what is missing, too, but moves no prediction so far that it would be felt.
        undecided: explanations that are as good as each other.
        unobservable: what this log could not tell.
        detectable: how large the other effects that are not named would have had to be to be seen.
        unexplained: structure without a name; None without.
        findings: what the stages and the diagnosis noticed.
        ladder: rungs with their held-out errors.
        noise_floor: how well motion repeats itself under the same input, as errors.
        explained_share: of the removable error; NaN without room.
        where: the few that carry most of it.
        timing: delays, and whose heading was used.
        by_path: ladders of the drivetrain and of the ground apart, where there are encoders.
        disturbance: rms of the residual in x, y, w, and the part of it that lasts for seconds.
        lead: what the residual of the final model points to, in words; empty where to nothing recorded.
        proposal: model file with what was named, fitted; None where nothing could be judged.
        budgets: the causes of the slip and the 2 s errors of the ideal model, of each input.
        estimates: numbers of all effects that these runs determine.
        learned: what a learned term does beyond them, see `learned_as_json`; empty where nothing was judged.
    """

    run: str
    input: str
    input_reason: str = ""
    joint: tuple[str, ...] = ()
    effects: tuple[Named, ...] = ()
    immaterial: tuple[Named, ...] = ()
    undecided: tuple[Undecided, ...] = ()
    unobservable: tuple[Unobservable, ...] = ()
    detectable: tuple[Detectable, ...] = ()
    unexplained: Unexplained | None = None
    findings: tuple[Mapping[str, Json], ...] = ()
    ladder: tuple[Mapping[str, Json], ...] = ()
    noise_floor: Mapping[str, Json] = field(default_factory=dict)
    explained_share: float = math.nan
    where: tuple[Region, ...] = ()
    timing: Mapping[str, Json] = field(default_factory=dict)
    by_path: Mapping[str, Json] = field(default_factory=dict)
    disturbance: Mapping[str, Json] = field(default_factory=dict)
    lead: str = ""
    proposal: ModelFile | None = None
    budgets: tuple[SlipBudget, ...] = ()
    estimates: tuple[EstimatedNumber, ...] = ()
    learned: Mapping[str, Json] = field(default_factory=dict)

    def find_held(self, item: Undecided) -> str | None:
        """Which of the candidates stands in the model, so that its error is that of any of them."""
        ids = () if self.proposal is None else self.proposal.model.ids
        return next((name for name in item.candidates if name in ids), None)

    def to_json(self) -> dict[str, Json]:
        """The promised keys of `slip diagnose --json` for one run, and more."""
        content = self._list_content()
        return {"run": self.run, "verdict": format_verdict(content), **content}

    def _list_content(self) -> dict[str, Json]:
        return {
            "input": self.input,
            "input_reason": self.input_reason or None,
            "joint_with": [name for name in self.joint if name != self.run],
            "effects": [effect.to_json() for effect in self.effects],
            "immaterial": [effect.to_json() for effect in self.immaterial],
            "materiality": {
                "way_share": LEAST_WAY_SHARE,
                "heading_rad": LEAST_TURN_RAD,
                "horizon_s": HORIZON_S,
            },
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
            "timing": dict(self.timing),
            "by_way": dict(self.by_path),
            "disturbance": dict(self.disturbance),
            "model": None if self.proposal is None else format_model(self.proposal),
            "budget": [budget_as_json(budget) for budget in self.budgets],
            "enough": format_enough(self.effects) or None,
            "learned": dict(self.learned),
        }


@dataclass(frozen=True)
class Diagnosis:
    """The diagnosis of one run, or of several of one vehicle together."""

    runs: tuple[RunDiagnosis, ...]

    def to_json(self) -> list[dict[str, Json]]:
        """One object a run."""
        return [run.to_json() for run in self.runs]

    def tabulate(self, table: str, run: str) -> pl.DataFrame:
        """One run's rows of `ladder`, `parameters`, `budget` or `estimates` (without the run's own columns).

        Rungs with the noise floor, numbers of named effects, causes of slip and errors, numbers of all.
        """
        from pipeline.core.tables import tabulate  # noqa: PLC0415 - heavy

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
            **_numbers(share, *_ENDS, "alone", "last"),
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


def budget_as_json(budget: SlipBudget) -> dict[str, Json]:
    """The keys of `slip compare --causes` for one run, for each input and quantity."""
    residual: dict[str, Json] = {
        share.kind: _numbers(share, *_ENDS) for share in budget.shares if share.kind != "effect"
    }
    return {
        "input": budget.input,
        "quantity": budget.quantity,
        "total": _clean(budget.total),
        "unit": budget.unit,
        "stretches": budget.stretches,
        "shares": [
            {"effect": share.name, **_numbers(share, *_ENDS, "alone", "last")}
            for share in budget.shares
            if share.kind == "effect"
        ],
        **residual,
    }


def _clean(value: float) -> float | None:
    """A number for JSON: six digits, null where there is none."""
    return finite_or_none(value, JSON_DIGITS)


def _numbers(item: object, *names: str) -> dict[str, Json]:
    return {**pick_finite(item, *names, digits=JSON_DIGITS)}


def _values(values: Mapping[str, Value]) -> dict[str, Json]:
    return {name: value.to_json() for name, value in values.items()}
