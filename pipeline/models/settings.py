"""A fitted model as quantities that a controller has parameters for, each with where it came from."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pipeline.models.bounds import stands_at_bound
from pipeline.models.catalogue import is_own
from pipeline.models.formula.formula_effect import FormulaEffect
from pipeline.runs.errors import MotionError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from pipeline.models.effect import Effect, Parameter
    from pipeline.models.model_file import ModelFile
    from pipeline.models.quantity import Quantity
    from pipeline.models.target import Target


@dataclass(frozen=True)
class Amount:
    """A number and where it came from.

    Attributes:
        value: in SI units.
        sources: a line for each number that it was made of; none where nothing is known.
        effects: ids of the effects among them.
    """

    value: float
    sources: tuple[str, ...] = ()
    effects: frozenset[str] = frozenset()

    @property
    def is_known(self) -> bool:
        """Whether something was measured, and it is a limit that exists."""
        return bool(self.sources) and math.isfinite(self.value)

    def change(self, function: Callable[..., float], *given: Amount) -> Amount:
        """The same thing in other terms, as a wheel's limit is the body's over the wheel's radius.

        The effects of what is given count as sources, not as something that the result stands for.
        """
        return Amount(_compute(function, self, *given), _unite(self, *given), self.effects)


def combine(function: Callable[..., float], *amounts: Amount) -> Amount:
    """The number that a function makes of several; it came from where they came from."""
    effects = frozenset[str]().union(*(amount.effects for amount in amounts))
    return Amount(_compute(function, *amounts), _unite(*amounts), effects)


def _compute(function: Callable[..., float], *amounts: Amount) -> float:
    """The function's value; a quotient by zero is not known."""
    try:
        return function(*(amount.value for amount in amounts))
    except ZeroDivisionError:
        return math.nan


def _unite(*amounts: Amount) -> tuple[str, ...]:
    return tuple(dict.fromkeys(line for amount in amounts for line in amount.sources))


@dataclass(frozen=True)
class Setting:
    """One parameter of a target.

    Attributes:
        path: names of the nodes and groups above it, its own last, dots between.
        value: as it is written: a number, or several in a row.
        sources: where it came from.
        effects: ids of effects that it stands for.
    """

    path: str
    value: float | bool | tuple[float, ...] | tuple[bool, ...]
    sources: tuple[str, ...] = ()
    effects: frozenset[str] = frozenset()


@dataclass
class Sheet:
    """The parameters of a target, in order.

    Attributes:
        head: what is said above them.
        settings: the parameters.
    """

    head: list[str] = field(default_factory=list)
    settings: list[Setting] = field(default_factory=list)

    def add(self, path: str, amount: Amount, note: str = "") -> None:
        """Add a number, unless nothing is known of it."""
        if amount.is_known:
            self._append(path, _round(amount.value), amount, note)

    def add_row(self, path: str, amounts: tuple[Amount | float, ...], note: str = "") -> None:
        """Add a parameter of several numbers, unless one of them that is no constant is not known."""
        measured = [amount for amount in amounts if isinstance(amount, Amount)]
        if all(amount.is_known for amount in measured):
            numbers = tuple(_round(a.value if isinstance(a, Amount) else a) for a in amounts)
            self._append(path, numbers, combine(lambda *_: math.nan, *measured), note)

    def _append(self, path: str, value: float | tuple[float, ...], amount: Amount, note: str) -> None:
        notes = (note,) if note else ()
        self.settings.append(Setting(path, value, (*amount.sources, *notes), amount.effects))


class Facts:
    """What a model file says of the quantities of its vehicle.

    Attributes:
        file: the model file.
        vehicle: its vehicle.
    """

    def __init__(self, file: ModelFile) -> None:
        self.file = file
        self.vehicle = file.model.vehicle

    def take(self, quantity: Quantity) -> Amount:
        """A quantity; neutral and without sources where no effect of the model is one.

        Formulas and Python of the user's own are no quantity, whatever their ids are.
        """
        values, sources, effects = [], [], []
        for effect, parameter in self._list_numbers():
            if quantity in parameter.quantities:
                values.append(effect.values[parameter.name])
                sources.append(self._describe(effect, parameter))
                effects.append(effect.id)
        return Amount(_join(quantity, values), tuple(sources), frozenset(effects))

    def measure(self, name: str) -> Amount:
        """A measure of the vehicle by the name of its field, NaN and unknown where it has none."""
        value = getattr(self.vehicle, name)
        return Amount(math.nan if value is None else value, (f"vehicle {self.vehicle.id}: {name}",))

    def list_unmapped(self, sheet: Sheet) -> list[str]:
        """Effects that no parameter of a sheet stands for, a line each with their numbers."""
        used = frozenset[str]().union(*(setting.effects for setting in sheet.settings))
        return [
            "; ".join(self._describe(effect, p) for p in effect.parameters if effect.is_used(p)) or effect.id
            for effect in self.file.model
            if effect.id not in used
        ]

    def describe_fit(self) -> str:
        """What the model was fitted on, empty before a fit."""
        runs = self.file.fit.get("runs")
        names = (
            [str(run.get("run")) for run in runs if isinstance(run, dict)] if isinstance(runs, list) else []
        )
        return f"Fitted on the {self.file.fit.get('input')} input of {', '.join(names)}." if names else ""

    def _list_numbers(self) -> Iterator[tuple[Effect, Parameter]]:
        for effect in self.file.model:
            if not isinstance(effect, FormulaEffect) and not is_own(type(effect)):
                yield from ((effect, parameter) for parameter in effect.parameters)

    def _describe(self, effect: Effect, parameter: Parameter) -> str:
        label, value = f"{effect.id}.{parameter.name}", effect.values[parameter.name]
        unit = "" if parameter.unit == "1" else f" {parameter.unit}"
        text = f"{label} = {value:.5g}{unit}"
        if label in self.file.intervals:
            low, high = self.file.intervals[label]
            text += f" (95 %: {low:.5g} to {high:.5g})"
        if rivals := self.file.list_rivals(effect.id):
            text += f", undecided: {' or '.join(rivals)} would explain as much"
        if value != parameter.neutral and stands_at_bound(value, parameter.bounds):
            text += ", at its bound: a limit of the search, no measurement"
        return text


def start_sheet(file: ModelFile, target: Target, *kinds: str) -> tuple[Facts, Sheet]:
    """Facts of a model, and a sheet that says of which vehicle it is, whose parameters it holds, what from.

    Raises:
        MotionError: ``wrong_vehicle``, the target has no parameters for this kind of vehicle.
    """
    facts = Facts(file)
    if facts.vehicle.kind not in kinds:
        raise MotionError(
            "wrong_vehicle",
            f"{target.name} has parameters for {' and '.join(kinds)} vehicles; {facts.vehicle.id} is "
            f"{facts.vehicle.kind}",
            where=facts.vehicle.id,
            hint="Export to another target: json and python take every vehicle.",
        )
    head = [
        f"{facts.vehicle.name}: {target.about}.",
        f"Names: {target.source}.",
        facts.describe_fit(),
    ]
    return facts, Sheet([line for line in head if line])


def _join(quantity: Quantity, values: list[float]) -> float:
    if values or quantity.join not in {min, max}:
        return float(quantity.join(values))
    return math.inf if quantity.join is min else 0.0


def _round(value: float) -> float:
    return float(f"{value:.5g}")
