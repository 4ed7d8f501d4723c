"""What can be simulated, by TOML files of this folder: vehicles, effects, layouts and topics."""

import math
import tomllib
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import resources
from typing import Any, Literal, get_args

import numpy as np

from pipeline.core import Floats, SlipError, guess_names

Series = Mapping[str, Floats]
"""Quantities of the run by name, shape (n,) each."""
Field = Floats | float | str | list[str]


@dataclass(frozen=True)
class Q:
    """A quantity of the run: ``gain * quantity + offset``, cut to a whole number where one is wanted."""

    name: str
    gain: float = 1.0
    offset: float = 0.0
    whole: bool = False

    def __call__(self, series: Series) -> Floats:
        """Its values, shape (n,)."""
        values = series[self.name]
        if (self.gain, self.offset) != (1.0, 0.0):
            values = self.gain * values + self.offset
        return np.floor(values) if self.whole else values


Value = tuple[Q, ...] | Callable[[Series], Field] | str | list[str] | float


@dataclass(frozen=True)
class Published:
    """A topic.

    Attributes:
        topic, type_name: where and what.
        source: whose times and quantities it has, an entry of `SOURCES`.
        fields: by field path a quantity, several for an array, what is made of some, or a constant.
        every: one message in so many is published.
        stamp: ``header``, or ``none``.
    """

    topic: str
    type_name: str
    source: str
    fields: Mapping[str, Value] = field(default_factory=dict)
    every: int = 1
    stamp: str = "header"


class SimulateError(SlipError):
    """A scenario that cannot be simulated: unknown name, wrong parameter, impossible value."""


def unknown_name(kind: str, name: str, known: list[str]) -> SimulateError:
    """The error for a name that is not in a list.

    Args:
        kind: what the name should be, for example ``effect``.
        name: what was given.
        known: the names that exist.

    Returns:
        An error with code ``unknown_<kind>`` whose hint says the nearest names, and all of them or what lists
        them.
    """
    every = f"Known: {', '.join(known)}"
    if kind in {"case", "effect"}:
        every = f"`slip simulate --cases` lists every {kind}."
    hint = f"{guess_names(name, known)}{every}"
    return SimulateError(f"unknown_{kind}", f"no {kind} is called {name!r}", where=name, hint=hint)


def read_facts(name: str) -> dict[str, Any]:
    """The tables of one of the files."""
    return tomllib.loads(resources.files("pipeline.simulate").joinpath(name).read_text("utf-8"))


def open_stream(seed: int, purpose: str) -> np.random.Generator:
    """A generator that depends on the seed and the purpose alone.

    A sensor or an effect that is added leaves every other purpose's numbers as they were.
    """
    return np.random.default_rng([seed, zlib.crc32(purpose.encode())])


def spread_times(count: int, *, duration_s: float, generator: np.random.Generator) -> Floats:
    """One random time [s] in each of ``count`` equal parts of the middle 80 %, so that faults stay apart."""
    part = 0.8 * duration_s / max(count, 1)
    return 0.1 * duration_s + (np.arange(count) + generator.uniform(0.2, 0.8, count)) * part


# Vehicles that can be simulated: geometry and the command space their programs draw from.
#
# Radii, tracks and speeds are those of the vendors' data sheets and of the published DRIVE recordings.

Kind = Literal["differential", "ackermann", "mecanum", "omni"]


@dataclass(frozen=True)
class Vehicle:
    """Geometry and limits of one vehicle.

    Attributes:
        name: how it calls itself in the log's deployment record.
        kind: ``differential`` (wheels or tracks a side), ``ackermann`` (steered front axle, base_link on
            the rear axle), ``mecanum`` (four wheels) or ``omni`` (wheels on a circle of that diameter).
        wheel_radius_m: nominal radius.
        track_width_m: nominal distance between left and right wheels.
        wheelbase_m: distance between the axles; matters for ``ackermann`` and ``mecanum``.
        max_speed_mps: largest speed a program asks for.
        max_turn_radps: largest yaw rate a program asks for (not Ackermann).
        max_steering_rad: largest steering angle a program asks for (Ackermann).
        max_sideways_mps: largest sideways speed a program asks for (mecanum, omni).
        wheels_per_side: how many joints a side has in a JointState.
        controller_track_multiplier: the onboard controller turns a body command into wheel speeds with this
            multiple of the nominal track (mecanum: of track and wheelbase).
    """

    name: str
    kind: Kind
    wheel_radius_m: float
    track_width_m: float
    wheelbase_m: float
    max_speed_mps: float
    max_turn_radps: float = 0.0
    max_steering_rad: float = 0.0
    wheels_per_side: int = 2
    controller_track_multiplier: float = 1.0
    max_sideways_mps: float = 0.0

    @property
    def moves_sideways(self) -> bool:
        """Whether it can be asked to."""
        return self.kind in {"mecanum", "omni"}

    @property
    def lever_m(self) -> float:
        """Half of what a difference of speed between the sides turns the vehicle over."""
        span = self.track_width_m + (self.wheelbase_m if self.kind == "mecanum" else 0.0)
        return 0.5 * span


VEHICLES = {name: Vehicle(**given) for name, given in read_facts("vehicles.toml").items()}
_ALIASES = {vehicle.name: key for key, vehicle in VEHICLES.items()} | {"ackermann": "car"}


def find_vehicle(name: str) -> Vehicle:
    """The named vehicle.

    Raises:
        SimulateError: ``unknown_vehicle``.
    """
    key = _ALIASES.get(name, name)
    if key not in VEHICLES:
        raise unknown_name("vehicle", name, sorted(VEHICLES))
    return VEHICLES[key]


# The catalogue of effects that a scenario may ask for: parameters, units, neutral and usual values.
#
# The formulas themselves stand where they act: ``drivetrain`` (command to wheels), ``body`` (wheels to body
# velocity) and ``localization`` (what the pose reports). Signs follow REP-103: x forward, y left, z up.


@dataclass(frozen=True)
class ParameterSpec:
    """One number of an effect: its unit, the value that changes nothing, a usual one, and the least possible.

    ``neutral`` is NaN for a parameter that only says where an effect acts and so cannot be neutral.
    """

    name: str
    unit: str
    neutral: float
    typical: float
    least: float = -math.inf


@dataclass(frozen=True)
class EffectSpec:
    """One effect: its id, its formula in words of the body velocity, its parameters and its vehicles.

    ``adds`` has formulas of what is added to ``v_x``, ``v_y`` and ``v_w``, for an effect whose physics is not
    written in this room: arithmetic and functions of `math` over parameters and attributes of `State`.
    """

    id: str
    formula: str
    parameters: tuple[ParameterSpec, ...]
    kinds: tuple[Kind, ...] = ("differential", "ackermann", "mecanum", "omni")
    adds: Mapping[str, str] = field(default_factory=dict)


def _read_effect(name: str, given: dict[str, Any]) -> EffectSpec:
    parameters = tuple(ParameterSpec(own, **said) for own, said in given.pop("parameters").items())
    return EffectSpec(name, given["formula"], parameters, tuple(given.get("kinds", get_args(Kind))))


CATALOGUE: dict[str, EffectSpec] = {
    name: _read_effect(name, given) for name, given in read_facts("effects.toml").items()
}


class Effects:
    """The effects of one scenario with their values, neutral where not asked for.

    Attributes:
        asked: what was asked for, by effect and parameter.
        written: effects among them that are not in the catalogue.
    """

    def __init__(
        self, asked: Mapping[str, Mapping[str, float]], written: tuple[EffectSpec, ...] = ()
    ) -> None:
        self.asked, self.written = asked, written
        numbers = {
            (spec.id, one): asked.get(spec.id, {}).get(one.name, one.neutral)
            for spec in (*CATALOGUE.values(), *written)
            for one in spec.parameters
        }
        self._numbers = {(effect, one.name): number for (effect, one), number in numbers.items()}
        self._active = {
            effect
            for (effect, one), number in numbers.items()
            if number != one.neutral and not math.isnan(one.neutral)
        }

    def value(self, effect: str, parameter: str) -> float:
        """The value of a parameter; its neutral one when the effect was not asked for."""
        return self._numbers[effect, parameter]

    def is_active(self, effect: str) -> bool:
        """Whether any parameter of the effect differs from its neutral value."""
        return effect in self._active


def resolve_effects(
    asked: Mapping[str, Mapping[str, float] | float], kind: Kind, written: tuple[EffectSpec, ...] = ()
) -> Effects:
    """Check what was asked for against the catalogue.

    Args:
        asked: effect id to its parameters, or to one number for an effect with one parameter.
        kind: the vehicle's kind.
        written: effects that are not in the catalogue, by their formulas.

    Raises:
        SimulateError: ``unknown_effect``, ``unknown_parameter``, ``parameter_needed``, ``bad_value`` or
            ``wrong_vehicle``.
    """
    values: dict[str, dict[str, float]] = {}
    known = CATALOGUE | {spec.id: spec for spec in written}
    for name, given in asked.items():
        spec = known.get(name)
        if spec is None:
            raise unknown_name("effect", name, sorted(known))
        if kind not in spec.kinds:
            what = f"{name} exists on {' or '.join(spec.kinds)} vehicles only, this one is {kind}"
            raise _refuse("wrong_vehicle", what, name, "Choose another vehicle or another effect")
        values[name] = _check_parameters(spec, given)
    return Effects(values, tuple(spec for spec in written if spec.id in values))


def _check_parameters(spec: EffectSpec, given: Mapping[str, float] | float) -> dict[str, float]:
    known = {item.name: item for item in spec.parameters}
    if not isinstance(given, Mapping):
        if len(known) > 1:
            what = "one number is not enough for an effect with several parameters"
            raise _refuse("parameter_needed", what, spec.id, f"Name them: {', '.join(known)}")
        given = dict.fromkeys(known, given)
    for name, value in given.items():
        if name not in known:
            units = ", ".join(f"{item.name} [{item.unit}]" for item in spec.parameters)
            what = f"{spec.id} has no parameter '{name}'"
            raise _refuse("unknown_parameter", what, spec.id, f"Its parameters are {units}")
        least = known[name].least
        # Only what is without limit where it changes nothing may be infinite.
        is_endless = math.isinf(value) and not math.isinf(known[name].neutral)
        if math.isnan(value) or value < least or is_endless:
            hint = f"Give a finite number{'' if least == -math.inf else f' of at least {least:g}'}"
            raise _refuse("bad_value", f"{spec.id}.{name} = {float(value)} is not possible", spec.id, hint)
    return {name: float(value) for name, value in given.items()}


def _refuse(code: str, what: str, effect: str, hint: str) -> SimulateError:
    return SimulateError(code, what, where=effect, hint=hint)


# Topic layouts: which topics a robot's log has, and in which form each carries its numbers.
#
# The names are those of the published recordings and of common robot configurations.


@dataclass(frozen=True)
class Layout:
    """The topics of a log.

    Attributes:
        kind: vehicles that have it.
        topics: topics, or rows of them as `messages.read_topic` takes them.
    """

    kind: Kind
    topics: tuple[Published | Mapping[str, Any], ...]


LAYOUTS: dict[str, Layout] = {
    name: Layout(given["kind"], tuple(given["topics"])) for name, given in read_facts("layouts.toml").items()
}


def find_layout(layout: str | Layout, vehicle: Vehicle) -> Layout:
    """The layout of that name, or the one given, if it fits the vehicle.

    Args:
        layout: a name of `LAYOUTS`, ``usual`` for what such a vehicle usually has, or a layout.
        vehicle: whose log it shall be.

    Raises:
        SimulateError: ``unknown_layout`` or ``wrong_vehicle``.
    """
    if isinstance(layout, str):
        name = _choose_usual(vehicle) if layout == "usual" else layout
        if name not in LAYOUTS:
            raise unknown_name("layout", name, ["usual", *sorted(LAYOUTS)])
        known = LAYOUTS[name]
    else:
        name, known = "layout", layout
    if known.kind != vehicle.kind:
        fitting = sorted(key for key, item in LAYOUTS.items() if item.kind == vehicle.kind)
        what = f"this layout is for {known.kind} vehicles, this one is {vehicle.kind}"
        raise SimulateError("wrong_vehicle", what, where=name, hint=f"Choose one of {', '.join(fitting)}")
    return known


def _choose_usual(vehicle: Vehicle) -> str:
    if vehicle.kind != "differential":
        return vehicle.kind
    return {"husky_a200": "husky", "warthog": "warthog"}.get(vehicle.name, "tf")
