"""Arithmetic as text: a small parser that derives units and never runs what it is given."""

import ast
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from pipeline.core import Floats
from pipeline.models.parameter import PLAIN, Unit
from pipeline.run import MotionError

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
    "step": (lambda value: np.heaviside(value, 1.0), lambda _unit: PLAIN),
}
_PAIR_FUNCTIONS: dict[str, tuple[Callable[[Floats | float, Floats | float], Floats | float], bool]] = {
    "min": (np.minimum, False),
    "max": (np.maximum, False),
    "clip": (lambda value, most: np.clip(value, -most, most), False),
    "hypot": (np.hypot, False),
    "atan2": (np.arctan2, True),
}


def parse_expression(
    text: str, known: Mapping[str, Unit], where: str, given: Mapping[str, float] | None = None
) -> Expression:
    """Parse a formula and derive its unit.

    Args:
        text: arithmetic over ``known`` names with + - * / ** (or ^), the functions sin, cos, tan, asin, acos,
            atan, atan2, tanh, exp, log, abs, sqrt, sign, step, min, max, clip, hypot, and the constant pi.
        known: units of the permitted names.
        where: file and line, for error messages.
        given: names that have a value: factors of one and minus one among them cost nothing.

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
    parser = _Parser(known, where, text, given or {})
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

    def __init__(self, known: Mapping[str, Unit], where: str, text: str, given: Mapping[str, float]) -> None:
        self.known = known
        self.given = given
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
        if name in self.given:
            number = self.given[name]
            return _Node(self.known[name], lambda _values: np.float64(number), number)
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
            if left.constant is not None and abs(left.constant) == 1.0:
                return _Node(
                    left.unit * right.unit, two if left.constant > 0.0 else lambda values: -two(values)
                )
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
