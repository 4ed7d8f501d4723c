"""The catalogue of effects that a scenario may ask for: parameters, units, neutral and usual values.

The formulas themselves stand where they act: ``drivetrain`` (command to wheels), ``body`` (wheels to body
velocity) and ``localization`` (what the pose reports). Signs follow REP-103: x forward, y left, z up.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.simulate.errors import SimulateError, unknown_name
from pipeline.simulate.facts import read_facts
from pipeline.simulate.vehicles import Kind

_INF = math.inf


@dataclass(frozen=True)
class ParameterSpec:
    """One number of an effect: its unit, the value that changes nothing, and a usual one.

    ``neutral`` is NaN for a parameter that only says where an effect acts and so cannot be neutral.
    """

    name: str
    unit: str
    neutral: float
    typical: float


@dataclass(frozen=True)
class EffectSpec:
    """One effect: its id, its formula in words of the body velocity, its parameters and its vehicles."""

    id: str
    formula: str
    parameters: tuple[ParameterSpec, ...]
    kinds: tuple[Kind, ...] = ("differential", "ackermann", "mecanum", "omni")


def _read_effect(name: str, given: dict[str, Any]) -> EffectSpec:
    parameters = tuple(ParameterSpec(own, **said) for own, said in given.pop("parameters").items())
    kinds = {"kinds": tuple(given["kinds"])} if "kinds" in given else {}
    return EffectSpec(name, given["formula"], parameters, **kinds)


CATALOGUE: dict[str, EffectSpec] = {
    name: _read_effect(name, given) for name, given in read_facts("effects.toml").items()
}


class Effects:
    """The effects of one scenario with their values: complete, checked, and neutral where not asked for."""

    def __init__(self, values: Mapping[str, Mapping[str, float]]) -> None:
        self._values = {name: dict(numbers) for name, numbers in values.items()}

    def value(self, effect: str, parameter: str) -> float:
        """The value of a parameter; its neutral one when the effect was not asked for."""
        given = self._values.get(effect, {})
        if parameter in given:
            return given[parameter]
        return next(item.neutral for item in CATALOGUE[effect].parameters if item.name == parameter)

    def is_active(self, effect: str) -> bool:
        """Whether any parameter of the effect differs from its neutral value."""
        return any(
            not math.isnan(item.neutral) and self.value(effect, item.name) != item.neutral
            for item in CATALOGUE[effect].parameters
        )

    def as_mapping(self) -> dict[str, dict[str, float]]:
        """The values that were asked for, by effect and parameter."""
        return {name: dict(numbers) for name, numbers in self._values.items()}


def resolve_effects(asked: Mapping[str, Mapping[str, float] | float], kind: Kind) -> Effects:
    """Check what was asked for against the catalogue.

    Args:
        asked: effect id to its parameters, or to one number for an effect with one parameter.
        kind: the vehicle's kind.

    Raises:
        SimulateError: ``unknown_effect``, ``unknown_parameter``, ``parameter_needed``, ``bad_value`` or
            ``wrong_vehicle``.
    """
    values: dict[str, dict[str, float]] = {}
    for name, given in asked.items():
        spec = CATALOGUE.get(name)
        if spec is None:
            raise unknown_name("effect", name, sorted(CATALOGUE))
        if kind not in spec.kinds:
            what = f"{name} exists on {' or '.join(spec.kinds)} vehicles only, this one is {kind}"
            raise _refuse("wrong_vehicle", what, name, "Choose another vehicle or another effect")
        values[name] = _check_parameters(spec, given)
    return Effects(values)


def _check_parameters(spec: EffectSpec, given: Mapping[str, float] | float) -> dict[str, float]:
    names = [item.name for item in spec.parameters]
    if not isinstance(given, Mapping):
        if len(names) > 1:
            what = "one number is not enough for an effect with several parameters"
            raise _refuse("parameter_needed", what, spec.id, f"Name them: {', '.join(names)}")
        given = {names[0]: given}
    for name, value in given.items():
        if name not in names:
            known = ", ".join(f"{item.name} [{item.unit}]" for item in spec.parameters)
            what = f"{spec.id} has no parameter '{name}'"
            raise _refuse("unknown_parameter", what, spec.id, f"Its parameters are {known}")
        _check_value(spec.id, name, float(value))
    return {name: float(value) for name, value in given.items()}


_NEVER_NEGATIVE = {"limit", "threshold", "effort", "windup", "reset", "scrub", "drag"}
_UNBOUNDED = {"limit", "effort"}
_SCALES = {"wheel_radius": 0.0, "effective_track": 0.05, "lateral_scale": 0.0}


def _check_value(effect: str, name: str, value: float) -> None:
    low = -_INF
    waits = effect in {"deadband", "transport_delay", "reversal_pause"} and name == "d"
    if name in _NEVER_NEGATIVE or name.startswith("tau") or effect == "steering_play" or waits:
        low = 0.0
    elif name == "k" and effect in _SCALES:
        low = _SCALES[effect]
    if math.isnan(value) or value < low or (math.isinf(value) and name not in _UNBOUNDED):
        hint = f"Give a finite number{'' if low == -_INF else f' of at least {low:g}'}"
        raise _refuse("bad_value", f"{effect}.{name} = {value} is not possible", effect, hint)


def _refuse(code: str, what: str, effect: str, hint: str) -> SimulateError:
    return SimulateError(code, what, where=effect, hint=hint)
