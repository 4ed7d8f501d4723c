"""Export as a Python function without dependencies that predicts poses from commands.

It returns the pose of the vehicle, not that reported by the localization. Steps of effects are derived from
their formulas; those of effects that have none stand in `steps.toml`.
"""

import ast
import copy
import functools
import math
import tomllib
from collections.abc import Callable, Mapping
from importlib import resources
from typing import Any, cast

import msgspec

from pipeline.core import Floats, make_plain
from pipeline.export import Facts, Target
from pipeline.models import (
    Delay,
    Effect,
    Expression,
    Filtered,
    FormulaEffect,
    Lag,
    Model,
    ModelFile,
    Place,
    Ramp,
    Written,
    is_own,
)
from pipeline.run import MotionError
from pipeline.sources import Vehicle

_PLAIN_NAMES = ("abs", "min", "max", "sign", "step", "clip")
_PLACES = tuple(stage for stage in Place if stage is not Place.LOCALIZATION)
_ROOM = resources.files("pipeline.export")
_HEAD, _TAIL = _ROOM.joinpath("function.py.in").read_text("utf-8").split("{steps}")
"""Template text before and after the effects' steps."""


class _Step(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A step as text, parameters as ``{name}``, and the names of its states, zero at the start."""

    step: str
    state: tuple[str, ...] = ()


@functools.cache
def _read_steps() -> Mapping[str, _Step]:
    return msgspec.convert(tomllib.loads(_ROOM.joinpath("steps.toml").read_text("utf-8")), dict[str, _Step])


def write_function(model: Model) -> str:
    """Source code of the function; effects of the localization are excluded.

    Raises:
        MotionError: ``not_exportable``.
    """
    vehicle = model.vehicle
    steps = [(effect.place, _write_step(effect, vehicle)) for effect in model if effect.place in _PLACES]
    names = [name for _, step in steps for name in step.state]
    parts = [_write_head(model, names)]
    for stage in _PLACES:
        if stage is Place.KINEMATICS:
            parts.append(_roll(vehicle.kind))
        if stage is Place.BODY:
            parts.append("\n    v_x, v_y, v_w = v0, s0, w0")
        parts += [f"\n    {line}" for owner, one in steps if owner is stage for line in one.step.splitlines()]
    lever_m = vehicle.kinematics.lever_m(vehicle)
    if lever_m:
        parts.append(f"\n    v_y = v_y + {lever_m!r} * v_w")
    return "".join([*parts, _TAIL.replace("{returned}", "".join(f", {name}" for name in names))])


def _write_file(file: ModelFile) -> str:
    """The function with what its values come from, their intervals and their doubts as comments above it."""
    head, _, rest = write_function(file.model).partition("\n\n")
    facts = Facts(file)
    lines = [*facts.list_origin(), *(f"  {line}" for line in facts.list_sources())]
    comment = "\n".join(f"# {make_plain(line)}" for line in lines)
    return f"{head}\n\n{comment}\n\n{rest}"


def _write_step(effect: Effect, vehicle: Vehicle) -> _Step:
    if effect.id in _read_steps() and not is_own(type(effect)):
        known = _read_steps()[effect.id]
        return _Step(_fill(known.step, effect), known.state)
    writers: dict[type[Effect], Callable[[Any], _Step]] = {
        FormulaEffect: _write_formula,
        Delay: lambda _effect: _Step(""),  # commands act with this delay
        Lag: _write_lag,
        Ramp: _write_ramp,
    }
    for family, write in writers.items():
        if isinstance(effect, family):
            return write(effect)
    if isinstance(effect, Written) and not isinstance(effect, Filtered):
        return _Step("\n".join(_write_equations(effect, vehicle.kind)))
    what = f"{effect.id} is Python of your own and cannot be written out"
    hint = "Write it as a formula in the model file, or export without it (slip model drop)."
    raise MotionError("not_exportable", what, where=effect.id, hint=hint)


def _fill(text: str, effect: Effect) -> str:
    for name, value in effect.values.items():
        text = text.replace(f"{{{name}}}", _number(value))
    return text


_MEAN, _DIFFERENCE = "(left + right) / 2.0", "(right - left)"
# Expressions of signals that the function has under another name, and how such a one is changed.
_READ = {
    "D": _DIFFERENCE,
    "M": _MEAN,
    "delta": "steering",
    "e_m": "imbalance",
    "fastest": "max(max(map(abs, split(left, right, sideways))), 1e-9)",
    "T": "until_s",
    "r": "R",
    "b": "B",
    "l": "WHEELBASE",
}
_TURN = {Place.COMMAND: "(B * MULTIPLIER)", Place.DRIVE: "B"}
_ADD = {
    "M": "left, right = left + added, right + added",
    "D": "left, right = left - added / 2.0, right + added / 2.0",
    "f_x": "left, right = left + added / R, right + added / R",
    "f_w": "left, right = left - added * {turn} / (2.0 * R), right + added * {turn} / (2.0 * R)",
}
_EACH = "left, right, sideways = join([{new} for wheel in split(left, right, sideways)])"


def _write_equations(effect: Written, kind: str) -> list[str]:
    """Lines of a formula: all its right sides see the signals before it."""
    turn = _TURN.get(effect.place, "B")
    names = {**_READ, "f_x": f"(R * {_MEAN})", "f_w": f"({_DIFFERENCE} * R / {turn})"}
    direct, lines = {}, []
    for name, expression in effect.list_equations(kind).items():
        own = {"Omega": "wheel"}.get(name, names.get(name, name))
        per_wheel = {"turning": "(R * abs(wheel) > 0.01)", "Omega": "wheel"} if name == "Omega" else {}
        text = _write(expression, effect.known, {**names, **per_wheel})
        if name == "Omega":
            lines.append(_EACH.format(new=text))
        elif name in _ADD:
            lines += [f"added = {text} - {own}", _ADD[name].format(turn=turn)]
        elif effect.adds:
            direct[own] = f"{own} + ({text})"
        else:
            direct[own] = text
    return [*lines, *([f"{', '.join(direct)} = {', '.join(direct.values())}"] if direct else [])]


def _write_lag(effect: Lag) -> _Step:
    lines, states, before = [], [], ""
    for tau, signal in effect.list_lags():
        own, state, value = _READ.get(signal, signal), f"{effect.id}_{signal}", _number(effect.values[tau])
        if tau != before:
            lines.append(f"keep = math.exp(-step_s / {value}) if {value} > 0.0 else 0.0")
        lines.append(f"{state} = {own} + ({state} - {own}) * keep")
        lines += [f"{own} = {state}"] if signal not in {"M", "D"} else []
        states.append(state)
        before = tau
    if f"{effect.id}_M" in states:
        mean, half = f"{effect.id}_M", f"{effect.id}_D / 2.0"
        lines.append(f"left, right = {mean} - {half}, {mean} + {half}")
    return _Step("\n".join(lines), tuple(states))


def _write_ramp(effect: Ramp) -> _Step:
    state, limit = f"{effect.id}_state", _number(effect.values["limit"])
    if effect.signal == "Omega":
        near = f"approach(was, wheel, {limit} * step_s)"
        pairs = f"zip({state} or [0.0] * 4, split(left, right, sideways))"
        text = f"{state} = [{near} for was, wheel in {pairs}]\nleft, right, sideways = join({state})"
    elif effect.signal == "delta":
        text = f"steering = {state} = approach({state}, steering, {limit} * step_s)"
    else:
        signal, most = ("M", f"{limit} / R") if effect.signal == "f_x" else ("D", f"{limit} * B / R")
        own = _READ[signal]
        text = f"{state} = approach({state}, {own}, {most} * step_s)\nadded = {state} - {own}\n{_ADD[signal]}"
    return _Step(text, (state,))


def _write_head(model: Model, names: list[str]) -> str:
    vehicle, text = model.vehicle, _HEAD
    delay = math.fsum(effect.delay for effect in model if isinstance(effect, Delay))
    unknown = vehicle.format_unknown()
    text = text.replace("{unknown}", f"# {unknown}\n" if unknown else "")
    for key, number in (
        ("radius", vehicle.wheel_radius_m),
        ("track", vehicle.kinematics.turning_width_m(vehicle)),
        ("wheelbase", vehicle.wheelbase_m or 1.0),
        ("multiplier", vehicle.controller_track_multiplier),
        ("delay", delay),
    ):
        text = text.replace(f"{{{key}}}", _number(number))
    text = text.replace("{zeros}", f" + (0.0,) * {len(names)}" if names else "")
    text = text.replace("{names}", f"\n    ({', '.join(names)},) = state[7:]" if names else "")
    moves_sideways = vehicle.kinematics.has_inputs("sideways")
    text = text.replace("{third}", "0.0, aside" if moves_sideways else "aside, 0.0")
    # The name comes last, so that its text is not searched for further placeholders.
    return text.replace("{name}", ascii(vehicle.name))


def _roll(kind: str) -> str:
    turning = "f_x * math.tan(steering) / WHEELBASE" if kind == "ackermann" else "R * (right - left) / B"
    return f"""
    turning = 1.0 if R * (max(abs(left), abs(right)) + abs(sideways)) > 0.01 else 0.0
    f_x = R * (left + right) / 2.0
    f_w = {turning}
    v0, s0, w0 = f_x, R * sideways, f_w"""


def _number(value: float) -> str:
    if math.isnan(value):
        return "math.nan"
    return repr(float(value)) if math.isfinite(value) else ("math.inf" if value > 0 else "-math.inf")


def _write_formula(effect: FormulaEffect) -> _Step:
    used = frozenset[str]().union(*(expression.names for expression in effect.expressions.values()))
    # An id may hold what the name of a variable may not.
    own = "".join(c if c.isascii() and (c.isalnum() or c == "_") else f"_{ord(c):x}" for c in effect.id)
    turned = used & {"left_angle", "right_angle"}
    states = {name: f"{name}_{own}" for name in sorted(turned)}
    lines = [f"{state} += {name.removesuffix('_angle')} * step_s" for name, state in states.items()]
    for channel, expression in effect.expressions.items():
        if any(name.endswith("_rate") for name in expression.names):
            what = f"{effect.id} uses the rate of a signal, which the exported function does not have"
            hint = "Export without it (slip model drop)."
            raise MotionError("not_exportable", what, where=effect.id, hint=hint)
        lines.append(f"{channel} = {channel} + ({_write(expression, effect.values, states)})")
    return _Step("\n".join(lines), tuple(states.values()))


def _write(expression: Expression, values: Mapping[str, Floats | float], names: Mapping[str, str]) -> str:
    """A formula as plain Python: values for parameters, other names for signals, functions of `math`."""
    tree = _Writer(values, names).visit(copy.deepcopy(expression.tree))
    return ast.unparse(ast.fix_missing_locations(tree))


class _Writer(ast.NodeTransformer):
    """Converts the syntax tree of a formula."""

    def __init__(self, values: Mapping[str, Floats | float], names: Mapping[str, str]) -> None:
        self._values = values
        self._names = names

    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        """A number as a float, as in the model; a long integer is not written as such."""
        return ast.Constant(float(str(node.value)))

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """Value of a parameter, the constant pi, or a signal."""
        if node.id == "pi":
            return _of_math("pi")
        if node.id in self._values:
            return ast.parse(_number(float(self._values[node.id])), mode="eval").body
        return ast.parse(self._names.get(node.id, node.id), mode="eval").body

    def visit_BinOp(self, node: ast.BinOp) -> ast.expr:
        """Use `math.pow`: Python's power of a negative number is complex, in the model it is an error."""
        left, right = self.visit(node.left), self.visit(node.right)
        if isinstance(node.op, ast.Pow):
            return ast.Call(_of_math("pow"), [left, right], [])
        return ast.BinOp(left, node.op, right)

    def visit_Call(self, node: ast.Call) -> ast.expr:
        """Call of a built-in function, of one in the template, or of one of `math`."""
        name = cast("ast.Name", node.func).id
        function = ast.Name(name) if name in _PLAIN_NAMES else _of_math(name)
        return ast.Call(function, [self.visit(argument) for argument in node.args], [])


def _of_math(name: str) -> ast.expr:
    return ast.Attribute(ast.Name("math"), name)


PYTHON = Target(
    "python",
    "a function that predicts poses from commands",
    "the function's docstring",
    write_file=_write_file,
    takes_doubtful=True,
)
