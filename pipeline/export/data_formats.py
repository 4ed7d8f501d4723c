"""Export of a model as JSON or as dependency-free Python, and of its traction thresholds."""

from __future__ import annotations

import ast
import copy
import inspect
import json
import math
import textwrap
from datetime import date, time
from importlib import resources
from typing import cast

from pipeline.core import finite_or_none, pick
from pipeline.export import Amount, Current, Facts, Target, require_plausible, start_sheet, write_yaml
from pipeline.models.catalogue import is_own
from pipeline.models.effect import Effect, Place
from pipeline.models.formula import FormulaEffect
from pipeline.models.learned_term import ResidualTerm, learned_as_table
from pipeline.models.model import Model
from pipeline.models.model_file import ModelFile
from pipeline.models.parameter import Quantity
from pipeline.run import MotionError
from pipeline.run.signals import find_limits, trace_traction

_GEOMETRY = ("wheel_radius_m", "track_width_m", "wheelbase_m", "controller_track_multiplier")


def write_json_object(file: ModelFile, current: Current) -> str:
    """Write the model with values, intervals and units; numbers that are not finite become null."""
    vehicle = file.model.vehicle
    effects = []
    for effect in file.model:
        parameters = {}
        for parameter in effect.parameters:
            low, high = file.intervals.get(f"{effect.id}.{parameter.name}", (math.nan, math.nan))
            numbers = {"value": effect.values[parameter.name], "low": low, "high": high}
            parameters[parameter.name] = {
                **{key: finite_or_none(number) for key, number in numbers.items()},
                "unit": parameter.unit,
                **({"doubt": doubt} if (doubt := file.find_doubt(effect, parameter)) else {}),
            }
        item: dict[str, object] = {
            "id": effect.id,
            "place": effect.place.name.lower(),
            "parameters": parameters,
        }
        if isinstance(effect, FormulaEffect):
            item["formulas"] = effect.formulas
        if isinstance(effect, ResidualTerm):
            item["learned"] = learned_as_table(effect)
        effects.append(item)
    stand_ins = pick(vehicle, *vehicle.stand_ins)
    warnings = [*file.warnings, *filter(None, [vehicle.format_unknown()])]
    content = {
        "vehicle": {
            **pick(vehicle, "id", "name", "kind", *_GEOMETRY),
            **dict.fromkeys(stand_ins),
            **({"stand_ins": stand_ins} if stand_ins else {}),
        },
        "effects": effects,
        "fit": _plain(file.fit),
        **({"warnings": warnings} if warnings else {}),
    }
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _plain(value: object) -> object:
    """Value in a form that JSON can represent."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value.isoformat() if isinstance(value, date | time) else value


JSON_OBJECT = Target(
    "json", "the model with values, intervals and units", "the handbook, Models", write_json_object
)

_PLAIN_NAMES = ("abs", "min", "max", "sign")
_PLACES = tuple(stage for stage in Place if stage is not Place.LOCALIZATION)
_HEAD, _TAIL = (
    resources.files("pipeline.models").joinpath("function.py.in").read_text("utf-8").split("{steps}")
)
"""Template text before and after the effects' steps."""


def write_function(model: Model) -> str:
    """Source code of the function; effects of the localization are excluded.

    Raises:
        MotionError: ``not_exportable``.
    """
    vehicle = model.vehicle
    parts = [_write_head(model)]
    for stage in _PLACES:
        if stage is Place.KINEMATICS:
            parts.append(_roll(vehicle.kind))
        if stage is Place.BODY:
            parts.append("\n        v_x, v_y, v_w = v0, s0, w0")
        parts += [_write_step(effect, vehicle.kind) for effect in model if effect.place is stage]
    lever_m = vehicle.kinematics.lever_m(vehicle)
    if lever_m:
        parts.append(f"\n        v_y = v_y + {lever_m!r} * v_w")
    return "".join([*parts, _TAIL])


def _write_step(effect: Effect, kind: str) -> str:
    if isinstance(effect, FormulaEffect):
        return _formula(effect)
    text = None if is_own(type(effect)) else effect.choose_python(kind)
    if text is None:
        what = f"{effect.id} is Python of your own and cannot be written out"
        hint = "Write it as a formula in the model file, or export without it (slip model drop)."
        raise MotionError("not_exportable", what, where=effect.id, hint=hint)
    for name, value in effect.values.items():
        text = text.replace(f"{{{name}}}", _number(value))
    return "".join(f"\n        {line}" for line in inspect.cleandoc(text).splitlines())


def _write_head(model: Model) -> str:
    vehicle, text = model.vehicle, _HEAD
    delay = math.fsum(
        effect.values[parameter.name]
        for effect in model
        for parameter in effect.parameters
        if Quantity.COMMAND_DELAY in parameter.quantities and not is_own(type(effect))
    )
    state = [name for effect in model for name in effect.python_state]
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
    text = text.replace("{state}", "".join(f"\n    {name} = 0.0" for name in state))
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


def _formula(effect: FormulaEffect) -> str:
    lines = []
    for channel, expression in effect.expressions.items():
        if any(name.endswith("_rate") for name in expression.names):
            what = f"{effect.id} uses the rate of a signal, which the exported function does not have"
            hint = "Export without it (slip model drop)."
            raise MotionError("not_exportable", what, where=effect.id, hint=hint)
        body = ast.unparse(ast.fix_missing_locations(_Writer(effect).visit(copy.deepcopy(expression.tree))))
        lines.append(f"\n        {channel} = {channel} + ({body})")
    return "".join(lines)


class _Writer(ast.NodeTransformer):
    """Converts a formula's syntax tree to plain Python: values for parameters, functions of `math`."""

    def __init__(self, effect: FormulaEffect) -> None:
        self._values = effect.values

    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        """A number as a float, as in the model; a long integer is not written as such."""
        return ast.Constant(float(str(node.value)))

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """Value of a parameter, the constant pi, or a signal."""
        if node.id == "pi":
            return _of_math("pi")
        return ast.Constant(self._values[node.id]) if node.id in self._values else node

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


# Dependency-free Python function that predicts poses from commands.
#
# It returns the pose of the vehicle, not that reported by the localization.

PYTHON = Target(
    "python",
    "a function that predicts poses from commands",
    "the function's docstring",
    lambda file, _current: write_function(file.model),
)

_NODE = "traction_monitor.ros__parameters"
_USUAL_TOP_MPS = 1.0
"""Assumed largest speed if neither the model nor the vehicle gives one [m/s]."""


def _list_thresholds(facts: Facts) -> dict[str, Amount]:
    """Thresholds of `trace_traction` for a vehicle, and the usual ratio of body to wheel speed."""
    known = [facts.find_speed_limit(), facts.measure("max_speed_mps")]
    top = next((one for one in known if one.is_known), Amount(_USUAL_TOP_MPS, ("assumed largest speed",)))
    gain = facts.take(Quantity.RADIUS)
    limits = vars(find_limits(top.value, gain.value))
    amounts = {name: Amount(value, ("the rule's threshold",)) for name, value in limits.items()}
    for name, of in (("live", top), ("margin", top), ("excess", gain)):
        if of.sources:
            amounts[name] = Amount(limits[name], of.sources, of.effects)
    return {"usual_gain": Amount(gain.value, gain.sources or ("ideal",), gain.effects), **amounts}


def write_traction(file: ModelFile, current: Current) -> str:
    """Write a dependency-free Python function: the rule of table `events`, with this vehicle's thresholds."""
    del current
    source = textwrap.dedent(inspect.getsource(trace_traction)).replace("Sequence[float]", "list[float]")
    values = {name: float(amount.value) for name, amount in _list_thresholds(Facts(file)).items()}
    require_plausible("a threshold of traction", *values.values())
    lines = "".join(f"    {name!r}: {value:.6g},\n" for name, value in values.items() if name != "usual_gain")
    return (
        '"""Traction of a vehicle: does it dig in, spin or slide."""\n\n'
        f"VEHICLE = {file.model.vehicle.name!a}\n"
        f"USUAL_GAIN = {values['usual_gain']:.6g}  # forward speed over that of the wheels\n"
        f"LIMITS = {{\n{lines}}}\n\n\n{source}\n\n"
        "def judge_traction(wheels, turning, body, step_s):\n"
        '    """What happens now, by the last seconds: drive, digging_in, spinning or sliding.\n\n'
        "    Args:\n"
        "        wheels: forward speed by the encoders over the last 10 s or more [m/s].\n"
        "        turning: half the track times the yaw rate by the encoders [m/s].\n"
        "        body: forward speed of the localization, smoothed over half a second [m/s]. Sideways\n"
        "            motion counts up to the speed of the wheels: sliding through a turn is moving.\n"
        "        step_s: time between two of them [s].\n"
        '    """\n'
        "    usual = [USUAL_GAIN * speed for speed in wheels]\n"
        "    code = trace_traction(usual, turning, body, step_s, **LIMITS)[-1]\n"
        '    return ("drive", "digging_in", "spinning", "sliding")[code]\n'
    )


def write_thresholds(file: ModelFile, current: Current) -> str:
    """Write the thresholds as ROS 2 parameters of a node that a behaviour tree condition queries.

    Raises:
        MotionError: ``wrong_vehicle``.
    """
    del current
    facts, sheet = start_sheet(file, NAV2_TRACTION, "differential", "ackermann")
    for name, amount in _list_thresholds(facts).items():
        sheet.add(f"{_NODE}.{name}", amount)
    return write_yaml(facts, sheet)


TRACTION = Target(
    "traction",
    "a Python function that detects whether the wheels dig in, spin or slide",
    "the function's docstring",
    write_traction,
)
NAV2_TRACTION = Target(
    "nav2_traction",
    "thresholds of the function of `--to traction`, for a condition node of a Nav2 behaviour tree",
    "the handbook, Watch a recording: Nav2 declares no such node, the function is yours to wrap",
    write_thresholds,
)
