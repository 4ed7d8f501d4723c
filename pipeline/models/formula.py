"""The effect that adds a formula of a model file to the velocity."""

import functools
import keyword
import math
import unicodedata
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from pipeline.core import Floats
from pipeline.models.effect import AddedEffect, Effect, Excitation, Parameter
from pipeline.models.expression import Expression, parse_expression
from pipeline.models.parameter import Asked, Unit, parse_unit
from pipeline.run import MotionError, Rolling, RunContext, Velocity, roll_ideally
from pipeline.sources import Vehicle

# A formula is arithmetic over named signals and the effect's own parameters; its unit is derived and must be
# that of the velocity to which it is added.


@dataclass(frozen=True)
class _Driven:
    """Data from which signals are read."""

    rolling: Rolling
    context: RunContext

    @functools.cached_property
    def ideal(self) -> Rolling:
        """Ideal motion for the same wheel speeds."""
        return roll_ideally(self.rolling.wheels, self.context)


# Signals that also have a rate, with their units.
_SIGNALS: Mapping[str, tuple[str, Callable[[_Driven], Floats]]] = {
    "v0": ("m/s", lambda now: now.rolling.v0),
    "w0": ("rad/s", lambda now: now.rolling.w0),
    "s0": ("m/s", lambda now: now.rolling.velocity.y),
    "f_x": ("m/s", lambda now: now.ideal.v0),
    "f_w": ("rad/s", lambda now: now.ideal.w0),
    "roll": ("rad", lambda now: now.context.attitude[:, 0]),
    "pitch": ("rad", lambda now: now.context.attitude[:, 1]),
    "yaw": ("rad", lambda now: now.context.attitude[:, 2]),
    "x": ("m", lambda now: now.context.position[:, 0]),
    "y": ("m", lambda now: now.context.position[:, 1]),
    "left": ("rad/s", lambda now: now.rolling.wheels.left),
    "right": ("rad/s", lambda now: now.rolling.wheels.right),
    "steering": ("rad", lambda now: now.rolling.wheels.steering),
}
_BASE_UNITS = {name: unit for name, (unit, _) in _SIGNALS.items()}
SIGNAL_UNITS: Mapping[str, str] = {
    **_BASE_UNITS,
    **{f"{name}_rate": f"{unit}/s" if "/" not in unit else f"{unit}^2" for name, unit in _BASE_UNITS.items()},
    "left_angle": "rad",
    "right_angle": "rad",
    "t": "s",
}
"""Signals that a formula may use, and their units; ``<name>_rate`` is the time derivative, ``<side>_angle``
what a wheel has turned since the start of the run."""

_TAKEN = {"id", "note", "pi", "self", "name", "formulas", "parameters", "fixed", "where"}
"""Names with another meaning in a model file or in the effect itself."""

CHANNELS: Mapping[str, str] = {"v_x": "m/s", "v_y": "m/s", "v_w": "rad/s"}


@functools.lru_cache(maxsize=1024)
def _parse(channel: str, text: str, own: tuple[tuple[str, str], ...], where: str) -> Expression:
    """The parsed formula of a channel, with the names and units of its own parameters."""
    units = {name: parse_unit(unit, where) for name, unit in own}
    expression = parse_expression(text, {**_parse_signal_units(), **units}, where)
    wanted = parse_unit(CHANNELS[channel], where)
    if expression.unit != wanted:
        what = f"{channel} = {text!r} is in {expression.unit}, not in {wanted}"
        hint = "Correct the formula or the unit of a parameter."
        raise MotionError("wrong_units", what, where=where, hint=hint)
    return expression


class FormulaEffect(AddedEffect):
    """Adds formulas to the velocity, in parallel with the other ground effects.

    Args:
        name: id of the effect.
        formulas: by channel (``v_x``, ``v_y``, ``v_w``).
        parameters: parameters of the formulas.
        fixed: names of parameters that a fit does not change.
        where: file and line, for error messages.
        values: of the parameters.

    Attributes:
        expressions: the parsed formulas by channel.

    Raises:
        MotionError: a formula cannot be parsed, uses an unknown name, has another unit than its channel, or
            does not vanish at the parameters' neutral values.
    """

    needs = (Excitation.DRIVING,)

    def __init__(
        self,
        name: str,
        formulas: Mapping[str, str],
        parameters: tuple[Parameter, ...],
        *,
        fixed: Iterable[str] = (),
        where: str = "",
        **values: float,
    ) -> None:
        self.id = name
        self.parameters = parameters
        self.formulas = dict(formulas)
        self._where = where or name
        self._check_names()
        self.expressions = self._parse_all()
        self._check_parameters()
        super().__init__(fixed=fixed, **values)
        self._check_neutral()

    def __getstate__(self) -> dict[str, object]:
        """The state without the parsed formulas."""
        return {name: value for name, value in vars(self).items() if name != "expressions"}

    def __setstate__(self, state: Mapping[str, object]) -> None:
        """Restore the state and parse the formulas again."""
        vars(self).update(state)
        self.expressions = self._parse_all()

    def _parse_all(self) -> dict[str, Expression]:
        own = tuple((p.name, p.unit) for p in self.parameters)
        return {channel: _parse(channel, text, own, self._where) for channel, text in self.formulas.items()}

    @property
    def key(self) -> tuple[object, ...]:
        """Id, values and formulas as a hashable key."""
        return (*super().key, *self.formulas.items())

    def describe(self) -> str:
        """The manual page of the effect."""
        lines = [f"{self.id}: a formula of the model file.", ""]
        lines += [f"    {channel} += {text}" for channel, text in self.formulas.items()]
        return "\n".join(lines)

    def describe_motion(
        self, vehicle: Vehicle, beside: Iterable[Effect] = (), asked: Asked | None = None
    ) -> str:
        """The formulas themselves."""
        return "Formula: " + ", ".join(f"{channel} += {text}" for channel, text in self.formulas.items())

    def add_to(self, total: Velocity, rolling: Rolling, velocity: Velocity, context: RunContext) -> Velocity:
        """Add the formulas' values."""
        now = _Driven(rolling, context)
        added = {}
        for channel, expression in self.expressions.items():
            known: dict[str, Floats | float] = {
                name: self.values[name] if name in self.values else _read(now, name)
                for name in expression.names
            }
            added[channel] = expression.evaluate(known)
        return total.add(added.get("v_x"), added.get("v_y"), added.get("v_w"))

    def _copy(self, values: Mapping[str, float], fixed: Iterable[str]) -> Self:
        # The parsed formulas do not depend on the values.
        other = object.__new__(type(self))
        vars(other).update(vars(self))
        other.values = self._complete(dict(values))
        other.fixed = frozenset(fixed)
        return other

    def _check_names(self) -> None:
        for name in (p.name for p in self.parameters):
            proper = name.isidentifier() and unicodedata.is_normalized("NFKC", name)
            if proper and name not in {*SIGNAL_UNITS, *CHANNELS, *_TAKEN} and not keyword.iskeyword(name):
                continue
            what = "is taken" if proper else "is not a name"
            text = f"the parameter {name[:80]!r} cannot be called so: the name {what}"
            raise self._refuse("name_taken", text, "Choose another name, of letters, digits and _.")

    def _check_parameters(self) -> None:
        used = frozenset[str]().union(*(e.names for e in self.expressions.values()))
        for parameter in self.parameters:
            if parameter.name not in used:
                what = f"the parameter {parameter.name!r} stands in no formula"
                raise self._refuse("unused_parameter", what, "Use it or drop it.")

    def _check_neutral(self) -> None:
        """Require formulas that vanish at neutral values: the ladder compares with models without them."""
        generator = np.random.default_rng(1)
        signals = {name: generator.uniform(0.1, 1.0, 8) for name in SIGNAL_UNITS}
        neutral = {p.name: p.neutral for p in self.parameters}
        for channel, expression in self.expressions.items():
            value = np.asarray(expression.evaluate({**signals, **neutral}))
            if not np.allclose(value, 0.0, atol=1e-12):
                what = f"{channel} = {expression.text!r} is not zero at the parameters' neutral values"
                hint = "Give `neutral` to a parameter so that the formula vanishes there, or add a factor."
                raise self._refuse("not_neutral", what, hint)

    def _refuse(self, code: str, what: str, hint: str) -> MotionError:
        return MotionError(code, what, where=self._where, hint=hint)


@functools.cache
def _parse_signal_units() -> Mapping[str, Unit]:
    return {name: parse_unit(unit, name) for name, unit in SIGNAL_UNITS.items()}


def _read(now: _Driven, name: str) -> Floats:
    if name == "t":
        return now.context.times
    if name in ("left_angle", "right_angle"):
        speed: Floats = getattr(now.rolling.wheels, name.removesuffix("_angle"))
        return np.cumsum(speed) * now.context.step_s
    if name in _SIGNALS:
        return _SIGNALS[name][1](now)
    rate = np.gradient(_SIGNALS[name.removesuffix("_rate")][1](now)) / now.context.step_s
    # The rate is not defined across spans.
    rate[now.context.spans.first] = 0.0
    rate[np.maximum(now.context.spans.first - 1, 0)] = 0.0
    return np.where(np.isfinite(rate), rate, 0.0)


def make_parameter(name: str, unit: str, bounds: tuple[float, float], *, neutral: float = 0.0) -> Parameter:
    """A parameter of a formula."""
    low, high = bounds
    wide = high - low if math.isfinite(high - low) else 1.0
    return Parameter(
        name, unit, bounds, neutral, "parameter of a formula", neutral + 0.1 * wide, step=1e-3 * wide
    )
