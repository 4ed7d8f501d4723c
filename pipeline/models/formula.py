"""Formulas: their parser, and the effect that adds one to the model."""

from __future__ import annotations

import ast
import functools
import keyword
import math
import re
import unicodedata
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Self

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.models.effect import AddedEffect, Effect, Excitation, Parameter
from pipeline.models.parameter import PLAIN, Unit, parse_unit
from pipeline.run import MotionError
from pipeline.run.signals import Rolling, RunContext, Velocity, roll_ideally
from pipeline.sources import Vehicle

Values = Mapping[str, "Floats | float"]
Evaluate = Callable[[Values], "Floats | float"]

_LONGEST_FORMULA = 500
"""Largest number of characters of a formula: five lines of a screen; a longer one is two effects."""
_LARGEST_POWER = 16
"""Largest power: far from overflow for a speed of 10 m/s."""
_DEEPEST = 40
"""Largest nesting depth of operations: far below Python's recursion limit of 1000 calls."""

# Only these tokens reach Python's parser: no text, comment or attribute, and no word directly after a number.
_FORMULA_TOKEN = re.compile(
    r"(?:(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?(?![\w.])|[^\W\d]\w*|[-+*/^(),]|\s)", re.ASCII
)
_WORD = re.compile(r"[^\W\d]\w*")


@dataclass(frozen=True)
class Expression:
    """A parsed formula.

    Attributes:
        text: the original text.
        unit: of its value.
        names: signals and parameters that it uses.
        tree: its syntax: numbers, names, + - * / **, and calls of functions by name.
        where: file and line, for error messages.
    """

    text: str
    unit: Unit
    names: frozenset[str]
    tree: ast.expr
    where: str
    _evaluate: Evaluate

    def evaluate(self, values: Values) -> Floats | float:
        """The formula's value from the values of its names.

        NaN propagates: an unknown input gives an unknown value. Any other non-finite value is an error.

        Raises:
            MotionError: ``not_finite``, a division by zero, a root of a negative number, an overflow.
        """
        exact = {
            name: value if isinstance(value, np.ndarray) else np.float64(value)
            for name, value in values.items()
        }
        try:
            with np.errstate(divide="raise", over="raise", invalid="raise", under="ignore"):
                return self._evaluate(exact)
        except FloatingPointError as error:
            at = ", ".join(
                f"{name} = {value:g}" for name, value in exact.items() if not isinstance(value, np.ndarray)
            )
            raise _bad(
                self.where,
                f"{self.text!r} is not always a finite number: {error}" + (f", at {at}" if at else ""),
                "Keep away from there, as x / max(y, 0.1) does, or narrow the bounds of a parameter.",
                "not_finite",
            ) from None


@dataclass(frozen=True)
class _Node:
    unit: Unit
    evaluate: Evaluate
    constant: float | None = None


# Plain functions take and return dimensionless numbers; the others declare the unit of their result.
_PLAIN_FUNCTIONS: dict[str, Callable[[Floats | float], Floats | float]] = {
    name: getattr(np, name) for name in ("sin", "cos", "tan", "asin", "acos", "atan", "tanh", "exp", "log")
}
_UNIT_FUNCTIONS: dict[str, tuple[Callable[[Floats | float], Floats | float], Callable[[Unit], Unit]]] = {
    "abs": (np.abs, lambda unit: unit),
    "sqrt": (np.sqrt, lambda unit: unit.power(Fraction(1, 2))),
    "sign": (np.sign, lambda _unit: PLAIN),
}
_PAIR_FUNCTIONS: dict[str, tuple[Callable[[Floats | float, Floats | float], Floats | float], bool]] = {
    "min": (np.minimum, False),
    "max": (np.maximum, False),
    "hypot": (np.hypot, False),
    "atan2": (np.arctan2, True),
}


def parse_expression(text: str, known: Mapping[str, Unit], where: str) -> Expression:
    """Parse a formula and derive its unit.

    Args:
        text: arithmetic over ``known`` names with + - * / ** (or ^), the functions sin, cos, tan, asin, acos,
            atan, atan2, tanh, exp, log, abs, sqrt, sign, min, max, hypot, and the constant pi.
        known: units of the permitted names.
        where: file and line, for error messages.

    Raises:
        MotionError: ``bad_formula``, ``unknown_signal`` or ``wrong_units``.
    """
    if len(text) > _LONGEST_FORMULA:
        raise _bad(
            where, f"the formula is longer than {_LONGEST_FORMULA} characters", "Split it into two effects."
        )
    _require_tokens(text, where)
    try:
        tree = ast.parse(" ".join(text.split()).replace("^", "**"), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise _bad(
            where, f"{text!r} is not a formula", "Write arithmetic over signals, as k * sin(yaw)."
        ) from None
    _require_shallow(tree, text, where)
    parser = _Parser(known, where, text)
    node = parser.parse(tree)
    return Expression(text, node.unit, frozenset(parser.names), tree, where, node.evaluate)


def _require_tokens(text: str, where: str) -> None:
    position = 0
    while position < len(text):
        match = _FORMULA_TOKEN.match(text, position) or _WORD.match(text, position)
        if match is None:
            what = f"{text!r} is not a formula: {text[position : position + 8]!r} has no meaning there"
            raise _bad(where, what, "Write arithmetic over signals, as k * sin(yaw).")
        position = match.end()


def _require_shallow(tree: ast.expr, text: str, where: str) -> None:
    """Reject nesting that would exceed the recursion limit elsewhere than in the parser."""
    level: list[ast.AST] = [tree]
    for _ in range(_DEEPEST):
        level = [
            inner for node in level for inner in ast.iter_child_nodes(node) if isinstance(inner, ast.expr)
        ]
        if not level:
            return
    raise _bad(where, f"{text!r} is nested more than {_DEEPEST} deep", "Split it into two effects.")


def _bad(where: str, what: str, hint: str, code: str = "bad_formula") -> MotionError:
    return MotionError(code, what, where=where, hint=hint)


class _Parser:
    """Converts a syntax tree into a tree of functions and checks units."""

    def __init__(self, known: Mapping[str, Unit], where: str, text: str) -> None:
        self.known = known
        self.where = where
        self.text = text
        self.names: set[str] = set()

    def parse(self, node: ast.expr) -> _Node:
        """Convert one node of the tree."""
        if isinstance(node, ast.Constant):
            return self._constant(node)
        if isinstance(node, ast.Name):
            return self._name(node.id)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
            inner = self.parse(node.operand)
            if isinstance(node.op, ast.UAdd):
                return inner
            constant = None if inner.constant is None else -inner.constant
            return _Node(inner.unit, lambda values: -inner.evaluate(values), constant)
        if isinstance(node, ast.BinOp):
            return self._binary(node)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords:
            return self._call(node.func.id, node.args)
        hint = "Use + - * / **, numbers, signals, parameters and functions such as sin."
        raise _bad(self.where, f"{self.text!r} holds something that is not arithmetic", hint)

    def _constant(self, node: ast.Constant) -> _Node:
        value = node.value
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise _bad(self.where, f"{value!r} is not a number", "Use plain numbers.")
        try:
            number = np.float64(value)
        except OverflowError:
            number = np.float64(np.inf)
        if not np.isfinite(number):
            raise _bad(self.where, "the formula holds a number beyond 1e308", "Write a smaller number.")
        return _Node(PLAIN, lambda _values: number, float(number))

    def _name(self, name: str) -> _Node:
        if name == "pi":
            return _Node(PLAIN, lambda _values: np.float64(np.pi), float(np.pi))
        if name not in self.known:
            hint = f"There are: {', '.join(self.known)}."
            raise _bad(self.where, f"there is no signal or parameter {name!r}", hint, "unknown_signal")
        self.names.add(name)
        return _Node(self.known[name], lambda values: values[name])

    def _binary(self, node: ast.BinOp) -> _Node:
        left = self.parse(node.left)
        right = self.parse(node.right)
        one, two = left.evaluate, right.evaluate
        if isinstance(node.op, ast.Add | ast.Sub):
            what = f"cannot add values in {left.unit} and in {right.unit}"
            self._require_same(left.unit, right.unit, what)
            if isinstance(node.op, ast.Add):
                return _Node(left.unit, lambda values: one(values) + two(values))
            return _Node(left.unit, lambda values: one(values) - two(values))
        if isinstance(node.op, ast.Mult):
            return _Node(left.unit * right.unit, lambda values: one(values) * two(values))
        if isinstance(node.op, ast.Div):
            return _Node(left.unit / right.unit, lambda values: one(values) / two(values))
        if isinstance(node.op, ast.Pow):
            power = right.constant
            if power is None or abs(power) > _LARGEST_POWER:
                raise _bad(self.where, "a power must be a small plain number", "Write for example v0**2.")
            unit = left.unit.power(Fraction(power).limit_denominator(12))
            # Python numbers would become complex or raise an exception where arrays become NaN.
            return _Node(unit, lambda values: np.asarray(one(values)) ** power)
        raise _bad(self.where, f"{self.text!r} uses an operator that is not known", "Use + - * / **.")

    def _call(self, name: str, given: list[ast.expr]) -> _Node:
        arguments = [self.parse(argument) for argument in given]
        units = "; ".join(
            f"{ast.unparse(argument)} is in {node.unit}"
            for argument, node in zip(given, arguments, strict=True)
        )
        if name in _PLAIN_FUNCTIONS and len(arguments) == 1:
            function, inner = _PLAIN_FUNCTIONS[name], arguments[0]
            self._require_same(inner.unit, PLAIN, f"{name}() needs a dimensionless argument; {units}")
            return _Node(PLAIN, lambda values: function(inner.evaluate(values)))
        if name in _UNIT_FUNCTIONS and len(arguments) == 1:
            (convert, change), only = _UNIT_FUNCTIONS[name], arguments[0]
            return _Node(change(only.unit), lambda values: convert(only.evaluate(values)))
        if name in _PAIR_FUNCTIONS and len(arguments) == 2:  # noqa: PLR2004 - a pair
            (combine, plain), (one, two) = _PAIR_FUNCTIONS[name], arguments
            self._require_same(one.unit, two.unit, f"{name}() needs arguments of one unit; {units}")
            return _Node(
                PLAIN if plain else one.unit,
                lambda values: combine(one.evaluate(values), two.evaluate(values)),
            )
        functions = ", ".join([*_PLAIN_FUNCTIONS, *_UNIT_FUNCTIONS, *_PAIR_FUNCTIONS])
        hint = f"There are: {functions}."
        raise _bad(self.where, f"there is no function {name} of {len(arguments)} arguments", hint)

    def _require_same(self, one: Unit, two: Unit, what: str) -> None:
        if one != two:
            hint = "Correct the formula or the unit of a parameter."
            raise _bad(self.where, f"{what}, in {self.text!r}", hint, "wrong_units")


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
    "t": "s",
}
"""Signals that a formula may use, and their units; ``<name>_rate`` is the time derivative."""

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

    def describe_motion(self, vehicle: Vehicle, beside: Iterable[Effect] = ()) -> str:
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


# Effects written as formulas: units, a small parser that never evaluates text, and the effect itself.
#
# A formula is arithmetic over named signals and the effect's own parameters; its unit is derived and must be
# that of the velocity to which it is added.
