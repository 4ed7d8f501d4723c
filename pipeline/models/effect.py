"""What an effect is: declared parameters, a place on the command's way, and one method that acts there."""

from __future__ import annotations

import enum
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from copy import copy
from string import Formatter
from typing import ClassVar, Self, TypeVar

from pipeline.core.program import format_share
from pipeline.models.parameter import (
    Conditions,
    Excitation,
    Largest,
    Least,  # noqa: F401 - what a file of an effect needs
    Level,
    Parameter,
    Part,
    Plausible,  # noqa: F401 - what a file of an effect needs
    Reading,
    Search,  # noqa: F401 - what a file of an effect needs
    Spread,  # noqa: F401 - what a file of an effect needs
    TwinRole,
)
from pipeline.run.recording import MotionError
from pipeline.run.signals import Commands, Floats, Rolling, RunContext, Velocity, Wheels
from pipeline.sources import Vehicle
from pipeline.sources.kinematics import list_kinds


def name_side(value: float) -> str:
    """The side that a number is on which counts to the left."""
    return "left" if value >= 0.0 else "right"


def format_share_of_gain(gain: float) -> str:
    """How much less or more than one a gain is: `29 % less`."""
    return f"{format_share(abs(1.0 - gain), 0)} {'less' if gain <= 1.0 else 'more'}"


# What an effect is: declared parameters, a place on the command's way, and one method that acts there.
#
# An effect's docstring is its manual page: what happens, the formula, the parameters, the source. Effects are
# values: changing a parameter makes another effect.

INF = math.inf
NAN = math.nan

_USUAL_LIMIT = 0.7
"""Of the largest command, at which a limit is tried: it then acts in the fastest part of a run."""
_USUAL_MOMENT = 0.5
"""Of a run, at which a change is tried: both sides then know as much."""


class Place(enum.IntEnum):
    """Where on a command's way an effect acts, in this order."""

    COMMAND = 1
    DRIVE = 2
    KINEMATICS = 3
    BODY = 4
    GROUND = 5
    CENTRE = 6
    LOCALIZATION = 7


class Late(enum.Enum):
    """What an effect makes late whose only number is a delay: sensors may know that delay beforehand."""

    POSES = "poses are stamped late"
    HEADING = "the heading is older than its position"
    BODY = "the body follows its wheels late, which hides a delay of the encoders"


ACKERMANN = ("ackermann",)
SIDEWAYS = ("mecanum", "omni")
SIDES = ("differential", *SIDEWAYS)
"""Vehicles that turn by a difference of speed between their sides."""
WHEELED = ("differential", "ackermann", "mecanum")
"""Vehicles whose single wheels are known."""
ANY = list_kinds()


class Effect(ABC):
    """One physical reason why the velocity differs from the ideal one.

    Attributes:
        id: stable name.
        place: where it acts; `rank` orders the effects of one place.
        parameters: its numbers.
        starts: values to start all of its numbers from together, where one number alone says little.
        kinds: kinds of vehicles it exists on.
        needs: what a run must contain to show it.
        confused_with: effects that look alike at first order or under poor driving.
        equivalent_to: effects that cannot be told from it at all, under `equivalent_when`, which
            `is_equivalent` looks for in recordings.
        same_in_one_motion: effects that cannot be told from it by driving straight only, or turning only.
        contains: effects that are special cases of it: it explains whatever they explain.
        parts: numbers of other effects under which it is searched; found together, they are named as it.
        late: what it makes late, where its only number is a delay.
        twin: which numbers of the exported twin's body are its own; None where that body cannot hold it.
        motion: its name and numbers in a sentence, as `{name}`; of the first one also `{size}`, its absolute
            value in units of which SI has `size_in`, `{way}`, of `ways` the one for its sign, `{percent}`,
            and `{share}`, how much less or more than one `share_of` makes of it (a constant, and what it is
            multiplied by).
        clause: what the vehicle does as the predicate of "the robot", or a clause of its own that begins with
            "the"; it takes the words of `motion`, `{degrees}`, the size of an angle, and `{rim}`, the speed
            at the rim of a wheel of this rate. Empty where `motion` says it behind its colon.
        python: its step in the exported function, numbers as `{name}`; None where there is none.
        python_state: names that its step carries on to the next one; zero at the start.
        readings: what it is if its numbers prove to be a property of the vehicle, the ground or a run, where
            one run cannot tell these apart.
        values: the numbers themselves.
        fixed: names of parameters that a fit leaves alone.
        open_numbers: names of parameters that sentences leave out.
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
    contains: tuple[str, ...] = ()
    parts: tuple[Part, ...] = ()
    late: Late | None = None
    twin: TwinRole | None = None
    motion: str = ""
    clause: str = ""
    ways: tuple[str, str] = ("left", "right")
    size_in: float = 1.0
    share_of: tuple[float, float] = (0.0, 1.0)
    python: str | None = None
    python_state: tuple[str, ...] = ()
    readings: tuple[Reading, ...] = ()
    open_numbers: frozenset[str] = frozenset()

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
        """The same effect, whose sentences leave out some of its numbers."""
        effect = copy(self)
        effect.open_numbers = frozenset(names)
        return effect

    @property
    def key(self) -> tuple[object, ...]:
        """What the effect does, as a hashable value."""
        return (self.id, *(None if math.isnan(value) else value for value in self.values.values()))

    @property
    def is_neutral(self) -> bool:
        """Whether every parameter that can be neutral is."""
        return all(math.isnan(p.neutral) or self.values[p.name] == p.neutral for p in self.parameters)

    @property
    def delay(self) -> float:
        """The number of an effect that makes something late, its only one [s]."""
        (value,) = self.values.values()
        return value

    @classmethod
    def of_delay(cls, seconds: float) -> Self:
        """The effect, of one that makes something late, with a delay brought inside its bounds [s]."""
        (parameter,) = cls.parameters
        low, high = parameter.bounds
        return cls().change(**{parameter.name: min(max(seconds, low), high)})

    @property
    def ground_labels(self) -> tuple[str, ...]:
        """Labels of the numbers that another ground may change: by their nature, or where runs must tell."""
        acts_there = self.place in {Place.BODY, Place.GROUND}
        may_be = acts_there or any(reading.level is Level.TERRAIN for reading in self.readings)
        return tuple(
            f"{self.id}.{p.name}"
            for p in self.parameters
            if p.level is Level.TERRAIN or (p.level is None and may_be and self.late is not Late.POSES)
        )

    @property
    def searched_as(self) -> frozenset[str]:
        """Ids under which it is searched."""
        return frozenset(part.effect for part in self.parts) or frozenset({self.id})

    @classmethod
    def join(cls, parts: Mapping[str, Effect]) -> Self:
        """The effect made of those of its parts that were found, by id."""
        return cls().change(
            **{
                part.name: part.factor * parts[part.effect].values[part.parameter]
                for part in cls.parts
                if part.effect in parts
            }
        )

    def describe_motion(self, vehicle: Vehicle, beside: Iterable[Effect] = ()) -> str:
        """What the vehicle does, with numbers; without a `motion` what the docstring begins with.

        Args:
            vehicle: its nominal geometry.
            beside: all effects of the model, which some of its numbers are read with.
        """
        if self.motion:
            name, colon, numbers = self.motion.partition(": ")
            filled = self._fill(numbers, vehicle) if colon else ""
            return f"{name}: {filled}" if filled else self._fill(name, vehicle)
        summary = (type(self).__doc__ or self.id).strip().splitlines()[0].rstrip(".")
        return summary.partition(": ")[2] or summary

    def describe_clause(self, vehicle: Vehicle, beside: Iterable[Effect] = ()) -> str:
        """What the vehicle does, with numbers, as a clause of a sentence; see `clause`."""
        if self.clause:
            return self._fill(self.clause, vehicle) or f"shows {self.id.replace('_', ' ')}"
        does = self.describe_motion(vehicle, beside).partition(": ")[2].removeprefix("the robot ")
        return does.replace("base_link", "the reference point") or f"shows {self.id.replace('_', ' ')}"

    def _fill(self, template: str, vehicle: Vehicle) -> str:
        """A template with its numbers, without its parts between commas that tell one of `open_numbers`."""
        (name_of_first, first), *_ = self.values.items()
        base, slope = self.share_of
        size = abs(first) * self.size_in
        words: dict[str, float | str] = {
            **self.values,
            "size": size,
            "way": self.ways[first < 0.0],
            "share": format_share_of_gain(base + slope * first),
            "percent": format_share(first, 3),
            "degrees": math.degrees(size),
            "rim": abs(first) * vehicle.wheel_radius_m,
        }
        parts = []
        for part in template.split(", "):
            names = [name for _, name, _, _ in Formatter().parse(part) if name]
            if self.open_numbers.isdisjoint(name if name in self.values else name_of_first for name in names):
                parts.append(part.format(**words))
        return ", ".join(parts)

    def choose_python(self, kind: str) -> str | None:
        """Its step in the exported function on a kind of vehicle; see `python`."""
        return self.python

    def can_show(self, conditions: Conditions) -> bool:
        """Whether sensors and driving let it be told at all."""
        return True

    def is_degenerate(self, conditions: Conditions) -> bool:
        """Whether it is, with these numbers, nothing in these runs or another effect in disguise."""
        return False

    def is_equivalent(self, conditions: Conditions) -> bool:
        """Whether nothing in these runs tells it from those that it is equivalent to."""
        return True

    def is_outside(self, vehicle: Vehicle) -> bool:
        """Whether a vehicle of this size has no such number: it is that of the effect it is part of."""
        return False

    def collapse(self) -> Effect | None:
        """The simpler effect that it has become when it is degenerate; None where there is none."""
        return None

    def list_softer(self, largest: Largest) -> tuple[Effect, ...]:
        """Effects that bend where this one breaks, to be tried as such though they have more numbers."""
        return ()

    def depends_on(self, other: Effect) -> bool:
        """Whether one motion shows only the ratio of its number to that of another effect."""
        return False

    def is_used(self, parameter: Parameter) -> bool:
        """Whether a parameter takes part: of two that stand for each other only the one that is given."""
        if parameter.instead_of:
            return math.isfinite(self.values[parameter.name])
        return not any(
            p.instead_of == parameter.name and math.isfinite(self.values[p.name]) for p in self.parameters
        )

    def make_usual(self, largest: Largest) -> Self:
        """The same effect at a usual size, brought inside its bounds."""
        values = self._list_usual(largest)
        bounds = {p.name: p.bounds for p in self.parameters}
        return self.change(
            **{name: min(max(value, bounds[name][0]), bounds[name][1]) for name, value in values.items()}
        )

    def _list_usual(self, largest: Largest) -> dict[str, float]:
        """Usual values: a limit below what was asked for, a moment in the middle of the run."""
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

    def fix(self, *names: str) -> Self:
        """The same effect with parameters that a fit must leave alone.

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
            if not neutral and not math.isfinite(value):
                what = f"{name} = {value:g} is not a finite number"
                hint = "Give a value inside the bounds."
                raise MotionError("out_of_bounds", what, where=f"{self.id}.{name}", hint=hint)
            if not neutral and not low <= value <= high:
                unit = "" if parameter.unit == "1" else f" {parameter.unit}"
                what = f"{name} = {value:g}{unit} is outside of {low:g} to {high:g}"
                hint = "Give a value inside the bounds."
                raise MotionError("out_of_bounds", what, where=f"{self.id}.{name}", hint=hint)
        return {p.name: float(given.get(p.name, p.neutral)) for p in self.parameters}


class CommandEffect(Effect):
    """Acts on commands at their own stamps."""

    place = Place.COMMAND

    @abstractmethod
    def change_commands(self, commands: Commands, context: RunContext) -> Commands:
        """What the drive is told in place of these commands."""


class DriveEffect(Effect):
    """Acts between what the drive is told and what the wheels do."""

    place = Place.DRIVE

    @abstractmethod
    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """What the wheels do in place of this."""


class KinematicEffect(Effect):
    """Acts between the wheels and the body velocity before the ground acts."""

    place = Place.KINEMATICS

    @abstractmethod
    def roll(self, rolling: Rolling, context: RunContext) -> Rolling:
        """The body velocity before the ground, in place of this."""


class BodyEffect(Effect):
    """Makes the body's velocity out of the rolling velocity."""

    place = Place.BODY

    @abstractmethod
    def move_body(self, rolling: Rolling, context: RunContext) -> Velocity:
        """Velocity of the body before ground effects are added."""


Column = tuple["Floats | float", "Floats | float", "Floats | float"]


class AddedEffect(Effect):
    """Adds something to the velocity, made of the model and never of measurements."""

    place = Place.GROUND

    @abstractmethod
    def add_to(self, total: Velocity, rolling: Rolling, velocity: Velocity, context: RunContext) -> Velocity:
        """Add the effect to ``total``.

        Args:
            total: velocity so far, other effects of this place included.
            rolling: v0, w0 of the model.
            velocity: what this place acts on; ground effects, which act in parallel, must not use it.
            context: the run.
        """


class LinearEffect(AddedEffect):
    """Adds parameter times column."""

    @abstractmethod
    def columns(self, rolling: Rolling, velocity: Velocity, context: RunContext) -> Mapping[str, Column]:
        """What one unit of each parameter adds to v_x, v_y, v_w.

        Args:
            rolling: v0, w0 of the model.
            velocity: what this place acts on; ground effects, which act in parallel, must not use it.
            context: the run.
        """

    def add_to(self, total: Velocity, rolling: Rolling, velocity: Velocity, context: RunContext) -> Velocity:
        """Add all columns, each times its parameter."""
        for name, (x, y, w) in self.columns(rolling, velocity, context).items():
            value = self.values[name]
            total = total.add(
                *(None if isinstance(part, float) and part == 0.0 else value * part for part in (x, y, w))
            )
        return total


class ReportEffect(Effect):
    """Acts on what the localization reports."""

    place = Place.LOCALIZATION

    @abstractmethod
    def report(self, velocity: Velocity, context: RunContext) -> Velocity:
        """Velocity as the reported poses show it."""

    def delay_s(self) -> float:
        """How late the reported position is stamped beyond its heading, or beyond what is known [s]."""
        return 0.0

    def report_gyro(self, velocity: Velocity, context: RunContext) -> Velocity:
        """As `report`, where the heading is a gyro's and not the poses' own."""
        return self.report(velocity, context)


Declared = TypeVar("Declared", Effect, type[Effect])


def find_late(effects: Iterable[Declared], late: Late) -> Declared | None:
    """The effect that makes this late, None without."""
    return next((effect for effect in effects if effect.late is late), None)
