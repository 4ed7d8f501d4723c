"""Base classes of effects: declared parameters, a stage of the command path, one method for that stage."""

from __future__ import annotations

import enum
import inspect
import math
import sys
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Mapping
from copy import copy
from functools import cached_property
from types import MappingProxyType
from typing import ClassVar, Literal, Self, TypeVar

from pipeline.core import suffix_unit
from pipeline.models.pairs import list_pairs
from pipeline.models.parameter import (
    Asked,
    Conditions,
    Excitation,
    Largest,
    Least,  # noqa: F401 - what a file of an effect needs
    Level,
    Meaning,
    Parameter,
    Part,
    Plausible,  # noqa: F401 - what a file of an effect needs
    Search,  # noqa: F401 - what a file of an effect needs
    Spread,  # noqa: F401 - what a file of an effect needs
)
from pipeline.models.words import MOST_DIGITS, Sentences, find_words
from pipeline.run import Commands, Floats, MotionError, Rolling, RunContext, Velocity, Wheels
from pipeline.sources import Vehicle, list_kinds

# An effect's docstring is its manual page: what happens, the formula, the parameters, the source. Effects are
# values: changing a parameter makes another effect.

INF = math.inf
NAN = math.nan

_USUAL_LIMIT = 0.7
"""Start value of a limit as a share of the largest command: it acts in the fastest part of a run."""
_USUAL_MOMENT = 0.5
"""Start value of a change point as a share of the run: both sides have the same amount of data."""


class Place(enum.IntEnum):
    """Stage of the command path at which an effect acts, in this order."""

    COMMAND = 1
    DRIVE = 2
    KINEMATICS = 3
    BODY = 4
    GROUND = 5
    CENTRE = 6
    LOCALIZATION = 7


class Late(enum.Enum):
    """What an effect with a delay as its only parameter delays; sensors may measure that delay beforehand."""

    POSES = "poses are stamped late"
    HEADING = "the heading is older than its position"
    COMMANDS = "the wheels follow their commands late, of which a delay of the encoders is a part"
    BODY = "the body follows its wheels late, which hides a delay of the encoders"


ACKERMANN = ("ackermann",)
SIDEWAYS = ("mecanum", "omni")
SIDES = ("differential", *SIDEWAYS)
"""Kinds of vehicles that turn by a speed difference between their sides."""
WHEELED = ("differential", "ackermann", "mecanum")
"""Kinds of vehicles whose individual wheel speeds are known."""
ANY = list_kinds()


class Effect(ABC):
    """One physical cause of a deviation from the ideal velocity.

    Facts about pairs of the catalogue's effects are those of `pairs.toml`.

    Attributes:
        id: stable name.
        place: stage at which it acts; `rank` orders the effects of one stage.
        parameters: declared parameters.
        starts: start values of all parameters together, where single parameters are poorly determined.
        kinds: kinds of vehicles it exists on.
        needs: excitation that a run must contain to identify it.
        confused_with: effects with nearly the same response at first order or under poor excitation.
        equivalent_to: effects that no recording in which `is_equivalent` holds distinguishes from it.
        equivalent_when: what holds then, in words.
        same_in_one_motion: effects not distinguishable from it by driving straight only, or turning only.
        same_at_one_speed: effects not distinguishable from it while one speed only is commanded.
        contains: effects that are special cases of it: it explains whatever they explain.
        acts_with: effects of which a model must have one for it to act; empty if it acts alone.
        companions: effects that usually act beside it, with which a search begins at once.
        parts: parameters of other effects as which it is searched; identified together, they are this effect.
        tied_to: effects of whose parameter one motion determines only the product or ratio with its own.
        late: what it delays, if a delay is its only parameter.
        scale_role: what a wrong scale of the encoders seems to be: a gain of the drive and a factor on the
            radius; empty for all other effects.
        has_state: whether it remembers what was before, in the drive.
        readings: its interpretation if its parameters prove to belong to the vehicle, the ground or a run,
            where one run cannot distinguish these.
        values: parameter values by name.
        fixed: names of parameters that a fit does not change.
        open_numbers: names of parameters that sentences leave out.
        shown_digits: significant digits of parameters, and of what sentences compute from them, by name; all
            that a sentence has for others.
    """

    id: str
    place: Place
    rank: ClassVar[int] = 0
    parameters: tuple[Parameter, ...]
    starts: tuple[Mapping[str, float], ...] = ()
    kinds: tuple[str, ...] = ANY
    needs: tuple[Excitation, ...] = (Excitation.DRIVING,)
    confused_with: tuple[str, ...] = ()
    equivalent_to: tuple[str, ...] = ()
    equivalent_when: str = ""
    same_in_one_motion: tuple[str, ...] = ()
    same_at_one_speed: tuple[str, ...] = ()
    contains: tuple[str, ...] = ()
    acts_with: tuple[str, ...] = ()
    companions: tuple[str, ...] = ()
    parts: tuple[Part, ...] = ()
    tied_to: tuple[str, ...] = ()
    late: Late | None = None
    scale_role: Literal["", "gain", "radius"] = ""
    has_state: bool = False
    readings: tuple[Meaning, ...] = ()
    open_numbers: frozenset[str] = frozenset()
    shown_digits: Mapping[str, int] = MappingProxyType({})

    def __init_subclass__(cls) -> None:
        """Add the facts about pairs of the catalogue."""
        super().__init_subclass__()
        for name, others in list_pairs().get(cls.__dict__.get("id", ""), {}).items():
            setattr(cls, name, others)

    def __init__(self, *, fixed: Iterable[str] = (), **values: float) -> None:
        self.values: Mapping[str, float] = self._complete(values)
        self.fixed = frozenset(fixed)

    def __repr__(self) -> str:
        numbers = ", ".join(f"{name}={value:g}" for name, value in self.values.items())
        return f"{self.id}({numbers})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Effect) and self.key == other.key and self.fixed == other.fixed

    def __hash__(self) -> int:
        return hash(self.key)

    def omit_open(self, names: Iterable[str]) -> Self:
        """The same effect with parameters that its sentences leave out."""
        effect = copy(self)
        effect.open_numbers = frozenset(names)
        return effect

    def limit_digits(self, digits: Mapping[str, int]) -> Self:
        """The same effect whose sentences have at most so many significant digits, by parameter."""
        effect = copy(self)
        effect.shown_digits = digits
        return effect

    @cached_property
    def key(self) -> tuple[object, ...]:
        """Id and values as a hashable key."""
        return (self.id, *(None if math.isnan(value) else value for value in self.values.values()))

    @property
    def is_neutral(self) -> bool:
        """Whether every parameter that has a neutral value is at it."""
        return not self.list_acting()

    @classmethod
    def find_page(cls) -> str:
        """Its manual page: what happens, the formula, the parameters, the source."""
        return inspect.cleandoc(sys.modules[cls.__module__].__doc__ or cls.__doc__ or "")

    @classmethod
    def acts_in(cls, ids: Collection[str]) -> bool:
        """Whether it acts in a model of these effects, see `acts_with`."""
        return not cls.acts_with or not set(cls.acts_with).isdisjoint(ids)

    @property
    def delay(self) -> float:
        """The only parameter of a delaying effect [s]."""
        (value,) = self.values.values()
        return value

    @classmethod
    def of_delay(cls, seconds: float) -> Self:
        """A delaying effect with this delay [s], clipped to its bounds."""
        (parameter,) = cls.parameters
        return cls().change_within(**{parameter.name: seconds})

    @property
    def ground_labels(self) -> tuple[str, ...]:
        """Labels of parameters that may differ on another ground, by their nature or until runs decide."""
        acts_there = self.place in {Place.BODY, Place.GROUND}
        may_be = acts_there or any(reading.level is Level.TERRAIN for reading in self.readings)
        return tuple(
            f"{self.id}.{p.name}"
            for p in self.parameters
            if p.level is Level.TERRAIN or (p.level is None and may_be and self.late is not Late.POSES)
        )

    @property
    def searched_as(self) -> frozenset[str]:
        """Ids of the effects as which it is searched."""
        return frozenset(part.effect for part in self.parts) or frozenset({self.id})

    @classmethod
    def join(cls, parts: Mapping[str, Effect]) -> Self:
        """The effect composed of those of its parts that were identified, by id."""
        return cls().change(
            **{
                part.name: part.factor * parts[part.effect].values[part.parameter]
                for part in cls.parts
                if part.effect in parts
            }
        )

    def describe_motion(
        self, vehicle: Vehicle, beside: Iterable[Effect] = (), asked: Asked | None = None
    ) -> str:
        """What the vehicle does, with numbers: the words of `words.toml`, or all parameters.

        Args:
            vehicle: its nominal geometry.
            beside: all effects of the model, for numbers that depend on other effects.
            asked: what the run asked for, for numbers that depend on it; None without a run.
        """
        said = self._make_sentences(vehicle, beside, asked)
        if said.words.motion:
            return said.describe_motion()
        known = [p for p in self.parameters if p.name not in self.open_numbers]
        shown = {p: min(self.shown_digits.get(p.name, MOST_DIGITS), MOST_DIGITS) for p in known}
        numbers = [f"{p.name} = {self.values[p.name]:.{n}g}{suffix_unit(p.unit)}" for p, n in shown.items()]
        return f"{said.title}: {', '.join(numbers)}"

    def describe_clause(
        self, vehicle: Vehicle, beside: Iterable[Effect] = (), asked: Asked | None = None
    ) -> str:
        """What the vehicle does, with numbers, as a clause of a sentence; see `describe_motion`."""
        said = self._make_sentences(vehicle, beside, asked)
        does = said.describe_clause() if said.words.motion else ""
        return does or f"shows signs of {self.id.replace('_', ' ')}"

    def describe_instead(self, vehicle: Vehicle) -> str:
        """What would show the same if one of `equivalent_to` acted in its place; empty without words."""
        return self._make_sentences(vehicle, (), None).describe_instead()

    def _make_sentences(self, vehicle: Vehicle, beside: Iterable[Effect], asked: Asked | None) -> Sentences:
        beside = tuple(beside)
        others = {one.id: next(iter(one.values.values()), 1.0) for one in beside}
        title = self.id.replace("_", " ").capitalize()
        values = {**self.values, **self.list_seen(vehicle, beside, asked)}
        words, unknown, digits = find_words(self.id), self.open_numbers, self.shown_digits
        return Sentences(title, words, values, vehicle, unknown, others, digits)

    def list_seen(
        self, vehicle: Vehicle, beside: Iterable[Effect] = (), asked: Asked | None = None
    ) -> Mapping[str, float]:
        """Numbers that its sentences have beside its own: what a person sees of it, by name.

        Args:
            vehicle: its nominal geometry.
            beside: all effects of the model.
            asked: what the run asked for; None without a run.
        """
        return {}

    def can_show(self, conditions: Conditions) -> bool:
        """Whether the sensors and the driving can identify it at all."""
        return True

    def is_degenerate(self, conditions: Conditions) -> bool:
        """Whether, with these values, it has no effect in these runs or reduces to another effect."""
        return False

    def is_equivalent(self, conditions: Conditions) -> bool:
        """Whether these runs do not distinguish it from the effects in `equivalent_to`."""
        return True

    def is_outside(self, vehicle: Vehicle) -> bool:
        """Whether the value is too large for this vehicle, and belongs to the effect that it is part of."""
        return False

    def collapse(self) -> Effect | None:
        """The simpler effect to which it reduces when it is degenerate; None where there is none."""
        return None

    def list_softer(self, largest: Largest) -> tuple[Effect, ...]:
        """Smooth forms of this effect to try as alternatives, although they have more parameters."""
        return ()

    def depends_on(self, other: Effect) -> bool:
        """Whether one motion determines only its product or ratio with the parameter of another effect."""
        return other.id in self.tied_to

    def is_used(self, parameter: Parameter) -> bool:
        """Whether a parameter is used: of two alternative parameters, only the one that is given."""
        if parameter.instead_of:
            return math.isfinite(self.values[parameter.name])
        return not any(
            p.instead_of == parameter.name and math.isfinite(self.values[p.name]) for p in self.parameters
        )

    def make_usual(self, largest: Largest) -> Self:
        """The same effect with typical values, clipped to its bounds."""
        return self.change_within(**self.list_usual(largest))

    def change_within(self, **values: float) -> Self:
        """The effect with other values, finite ones clipped to their bounds: those of another are wider."""
        for name, value in values.items():
            low, high = self.parameter(name).bounds
            values[name] = min(max(value, low), high) if math.isfinite(value) else value
        return self.change(**values)

    def list_acting(self) -> list[Parameter]:
        """Parameters that are not neutral, of those that have a neutral value."""
        return [p for p in self.parameters if not math.isnan(p.neutral) and self.values[p.name] != p.neutral]

    def list_starts(self, largest: Largest) -> list[dict[str, float]]:
        """Start values of all parameters together."""
        return [dict(values) for values in self.starts]

    def list_alike(self) -> list[Self]:
        """Other values that make nearly the same motion: a fit that ended here may belong there."""
        return []

    def list_usual(self, largest: Largest) -> dict[str, float]:
        """Typical values: a limit below the largest command, a change point in the middle of the run."""
        shares = {"": None, "duration": _USUAL_MOMENT}
        usual = {}
        for p in self.parameters:
            share = shares.get(p.relative_to, _USUAL_LIMIT)
            if not p.instead_of:
                usual[p.name] = p.typical if share is None else largest.take(share, p.relative_to)
        return usual

    def parameter(self, name: str) -> Parameter:
        """The declared parameter.

        Raises:
            MotionError: ``unknown_parameter``.
        """
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        known = ", ".join(f"{p.name} [{p.unit}]" for p in self.parameters)
        what = f"the effect {self.id} has no parameter {name!r}"
        raise MotionError("unknown_parameter", what, where=f"{self.id}.{name}", hint=f"It has: {known}.")

    def change(self, **values: float) -> Self:
        """The same effect with other values.

        Raises:
            MotionError: ``unknown_parameter`` or ``out_of_bounds``.
        """
        return self._copy({**self.values, **values}, self.fixed)

    @property
    def rounded(self) -> Self:
        """The same effect with its values as model files have them."""
        return self.change(**{p.name: p.round(self.values[p.name]) for p in self.parameters})

    @property
    def unfitted(self) -> Self:
        """The same effect at neutral values, but for parameters that a fit must not change."""
        return self.change(**{one.name: one.neutral for one in self.parameters if one.name not in self.fixed})

    def fix(self, *names: str) -> Self:
        """The same effect with parameters that a fit must not change.

        Raises:
            MotionError: ``unknown_parameter``.
        """
        return self._copy(self.values, self.fixed | {self.parameter(name).name for name in names})

    def loosen(self, *names: str) -> Self:
        """The same effect with parameters that a fit may change again.

        Raises:
            MotionError: ``unknown_parameter``.
        """
        return self._copy(self.values, self.fixed - {self.parameter(name).name for name in names})

    def _copy(self, values: Mapping[str, float], fixed: Iterable[str]) -> Self:
        return type(self)(fixed=fixed, **values)

    def _complete(self, given: Mapping[str, float]) -> dict[str, float]:
        for name, value in given.items():
            parameter = self.parameter(name)
            low, high = parameter.bounds
            neutral = value == parameter.neutral or (math.isnan(value) and math.isnan(parameter.neutral))
            hint = "Give a value inside the bounds."
            if not neutral and not math.isfinite(value):
                what = f"{name} = {value:g} is not a finite number"
                raise MotionError("out_of_bounds", what, where=f"{self.id}.{name}", hint=hint)
            if not neutral and not low <= value <= high:
                what = f"{name} = {value:g}{suffix_unit(parameter.unit)} is outside of {low:g} to {high:g}"
                raise MotionError("out_of_bounds", what, where=f"{self.id}.{name}", hint=hint)
        return {p.name: float(given.get(p.name, p.neutral)) for p in self.parameters}


class CommandEffect(Effect):
    """Acts on commands at their own time stamps."""

    place = Place.COMMAND

    @abstractmethod
    def change_commands(self, commands: Commands, context: RunContext) -> Commands:
        """Commands that the drive receives in place of these."""


class DriveEffect(Effect):
    """Acts between the commands that the drive receives and the wheel speeds."""

    place = Place.DRIVE

    @abstractmethod
    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """Wheel speeds in place of these."""


class KinematicEffect(Effect):
    """Acts between the wheels and the body velocity, before ground effects."""

    place = Place.KINEMATICS

    @abstractmethod
    def roll(self, rolling: Rolling, context: RunContext) -> Rolling:
        """Rolling velocity in place of this, before ground effects."""


class BodyEffect(Effect):
    """Computes the body velocity from the rolling velocity.

    Attributes:
        is_kinematic: whether the ratio of yaw rates is part of it, so that effects of the ground act on the
            motion that it results in.
    """

    place = Place.BODY
    is_kinematic: ClassVar[bool] = False

    @abstractmethod
    def move_body(self, rolling: Rolling, context: RunContext) -> Velocity:
        """Body velocity before ground effects are added."""


Column = tuple["Floats | float", "Floats | float", "Floats | float"]


class AddedEffect(Effect):
    """Adds a term to the velocity, computed from the model only, never from measured velocities."""

    place = Place.GROUND

    @abstractmethod
    def add_to(self, total: Velocity, rolling: Rolling, velocity: Velocity, context: RunContext) -> Velocity:
        """Add the effect to ``total``.

        Args:
            total: velocity so far, other effects of this stage included.
            rolling: v0, w0 of the model.
            velocity: input of this stage; ground effects, which act in parallel, must not use it.
            context: the run.
        """


class LinearEffect(AddedEffect):
    """Adds the sum of parameter times column."""

    @abstractmethod
    def columns(self, rolling: Rolling, velocity: Velocity, context: RunContext) -> Mapping[str, Column]:
        """Contribution of one unit of each parameter to v_x, v_y, v_w; arguments as of `add_to`."""

    def add_to(self, total: Velocity, rolling: Rolling, velocity: Velocity, context: RunContext) -> Velocity:
        """Add all columns, each times its parameter."""
        for name, (x, y, w) in self.columns(rolling, velocity, context).items():
            value = self.values[name]
            total = total.add(
                *(None if isinstance(part, float) and part == 0.0 else value * part for part in (x, y, w))
            )
        return total


class ReportEffect(Effect):
    """Acts on the reports of the localization."""

    place = Place.LOCALIZATION

    @abstractmethod
    def report(self, velocity: Velocity, context: RunContext) -> Velocity:
        """Velocity as derived from the reported poses."""

    def delay_s(self) -> float:
        """Delay of the position stamps beyond that of the heading, or beyond the known delay [s]."""
        return 0.0

    def report_gyro(self, velocity: Velocity, context: RunContext) -> Velocity:
        """As `report`, with the heading of a gyro instead of that of the poses."""
        return self.report(velocity, context)


Declared = TypeVar("Declared", Effect, type[Effect])


def find_late(effects: Iterable[Declared], late: Late) -> Declared | None:
    """The effect with this delay; None without one."""
    return next((effect for effect in effects if effect.late is late), None)
