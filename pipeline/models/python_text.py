"""The text of a plain Python function that computes a model."""

from __future__ import annotations

import ast
import copy
import math
from typing import TYPE_CHECKING, cast

from pipeline.models.catalogue import is_own
from pipeline.models.formula.formula_effect import FormulaEffect
from pipeline.runs.errors import MotionError

if TYPE_CHECKING:
    from pipeline.models.effect import Effect
    from pipeline.models.model import Model
    from pipeline.vehicles import Vehicle

# What each effect does in one step; `{k}` and the like become the fitted numbers.
_ON_COMMAND = {
    "body_speed_limit": """
        asked = R * (left + right) / 2.0
        excess = (asked - max(-{limit}, min({limit}, asked))) / R
        left, right = left - excess, right - excess""",
    "body_turn_limit": """
        asked = (right - left) * R / (B * MULTIPLIER)
        excess = (asked - max(-{limit}, min({limit}, asked))) * B * MULTIPLIER / (2.0 * R)
        left, right = left + excess, right - excess""",
    "deadband": """
        left = 0.0 if R * abs(left) < {d} else left
        right = 0.0 if R * abs(right) < {d} else right""",
    "wheel_speed_limit": """
        left = max(-{limit}, min({limit}, left))
        right = max(-{limit}, min({limit}, right))""",
}
_CAR_TURN_LIMIT = """
        moving = max(abs(R * (left + right) / 2.0), 1e-9)
        widest = math.atan({limit} * WHEELBASE / moving)
        steering = max(-widest, min(widest, steering))"""
_ON_DRIVE = {
    "acceleration_limit": """
        most = {limit} * step_s
        limited_left = approach(limited_left, left, most)
        limited_right = approach(limited_right, right, most)
        left, right = limited_left, limited_right""",
    "drive_lag": """
        keep = math.exp(-step_s / {tau}) if {tau} > 0.0 else 0.0
        lag_left = left + (lag_left - left) * keep
        lag_right = right + (lag_right - right) * keep
        left, right = lag_left, lag_right""",
    "turn_lag": """
        keep = math.exp(-step_s / {tau_mean}) if {tau_mean} > 0.0 else 0.0
        lag_mean = (left + right) / 2.0 + (lag_mean - (left + right) / 2.0) * keep
        keep = math.exp(-step_s / {tau_diff}) if {tau_diff} > 0.0 else 0.0
        lag_difference = right - left + (lag_difference - (right - left)) * keep
        left, right = lag_mean - lag_difference / 2.0, lag_mean + lag_difference / 2.0""",
    "turn_droop": """
        lost = (1.0 - {gain}) * (right - left - max(-{threshold}, min({threshold}, right - left)))
        left, right = left + lost / 2.0, right - lost / 2.0""",
    "steering_gain": """
        steering = {g} * steering""",
    "steering_lag": """
        keep = math.exp(-step_s / {tau}) if {tau} > 0.0 else 0.0
        lag_steering = steering + (lag_steering - steering) * keep
        steering = lag_steering""",
    "steering_offset": """
        steering = steering + {o}""",
}
_ON_ROLLING = {
    "wheel_asymmetry": """
        v0, w0 = v0 + {e} * B * w0 / 4.0, w0 + {e} * v0 / B""",
    "effective_track": """
        w0 = w0 / {k}""",
    "wheel_radius": """
        v0, w0 = {k} * v0, {k} * w0""",
    "steering_sensor_offset": """
        w0 = w0 + v0 * (math.tan(steering + {o}) - math.tan(steering)) / WHEELBASE""",
    "understeer": """
        w0 = w0 / max(1.0 + {K} / WHEELBASE * v0 * v0, 0.05)""",
    "time_drift": """
        fade = 1.0 - {k} * t / until_s
        v0, w0 = fade * v0, fade * w0""",
    "terrain_change": """
        if (x > {at_x}) if {has_x} else (t >= {at_s}):
            v0, w0 = {k_v} * v0, {k_w} * w0""",
}
_ON_BODY = {
    "body_inertia": """
        keep = math.exp(-step_s / {tau}) if {tau} > 0.0 else 0.0
        slide_w = w0 + (slide_w - w0) * keep
        turn = slide_w * step_s
        ahead, aside = v0 + (slide_x - v0) * keep, slide_y * keep
        slide_x = ahead * math.cos(turn) + aside * math.sin(turn)
        slide_y = aside * math.cos(turn) - ahead * math.sin(turn)
        v_x, v_y, v_w = slide_x, slide_y, slide_w""",
}
_ON_GROUND = {
    "lateral_skid": """
        v_y = v_y - {c} * v0 * w0""",
    "speed_slip": """
        v_x = v_x - {k} * v0 * abs(v0)""",
    "turning_resistance": """
        v_x = v_x - {k} * v0 * abs(w0)""",
    "slope_drift": """
        v_x = v_x + {k} * math.sin(pitch) * turning
        v_y = v_y - {k} * math.cos(pitch) * math.sin(roll) * turning""",
    "lateral_drift": """
        v_y = v_y + {c} * turning""",
    "yaw_drift": """
        v_w = v_w + {c} * turning""",
}
_ON_CENTRE = {
    "icr_lateral": """
        v_x = v_x + {y_icr} * v_w""",
    "icr_offset": """
        v_y = v_y - {x_icr} * v_w""",
}
_PLAIN_NAMES = ("abs", "min", "max", "sign")
_STAGES = (_ON_COMMAND, _ON_DRIVE, _ON_ROLLING, _ON_BODY, _ON_GROUND, _ON_CENTRE)
_HEAD = '''"""Motion of a vehicle from its commands. Made by `slip model export`; needs nothing but Python."""

import math

VEHICLE = {name}
R = {radius}  # wheel radius [m]
B = {track}  # track width [m]
WHEELBASE = {wheelbase}  # [m]
MULTIPLIER = {multiplier}  # of the controller's track


def approach(value, target, most):
    """Move a value towards a target by at most so much."""
    return target if abs(target - value) <= most else value + math.copysign(most, target - value)


def sign(value):
    """-1, 0 or 1."""
    return (value > 0.0) - (value < 0.0)


def predict(commands, until_s, step_s=0.005, pose=(0.0, 0.0, 0.0), roll=0.0, pitch=0.0):
    """Predict the motion of a vehicle that stands at the start.

    Args:
        commands: (time [s], left, right) wheel speeds [rad/s] in order of time, held until the next; on a
            car (time, axle, axle, steering [rad]).
        until_s: end of the prediction [s], from zero.
        step_s: integration step [s].
        pose: x [m], y [m], yaw [rad] at the start.
        roll: of the ground [rad].
        pitch: of the ground [rad], nose down above zero.

    Returns:
        A list of (time, x, y, yaw, v_x, v_y, v_w).
    """
    x, y, yaw = pose
    limited_left = limited_right = lag_left = lag_right = lag_mean = lag_difference = lag_steering = 0.0
    slide_x = slide_y = slide_w = 0.0
    rows = []
    index = -1
    for number in range(round(until_s / step_s)):
        t = (number + 0.5) * step_s
        while index + 1 < len(commands) and commands[index + 1][0] <= t - {delay}:
            index += 1
        _, left, right, steering = (*commands[index], 0.0)[:4] if index >= 0 else (0.0, 0.0, 0.0, 0.0)'''
_TAIL = """
        middle = yaw + v_w * step_s / 2.0
        x += (v_x * math.cos(middle) - v_y * math.sin(middle)) * step_s
        y += (v_x * math.sin(middle) + v_y * math.cos(middle)) * step_s
        yaw += v_w * step_s
        rows.append(((number + 1) * step_s, x, y, yaw, v_x, v_y, v_w))
    return rows
"""


def write_function(model: Model) -> str:
    """The function's source.

    Raises:
        MotionError: ``not_exportable``.
    """
    vehicle = model.vehicle
    delay = model.effect("transport_delay").values["d"] if "transport_delay" in model else 0.0
    parts = [_write_head(vehicle, delay)]
    written = {"transport_delay"}
    for number, stage in enumerate(_STAGES):
        if number == _STAGES.index(_ON_ROLLING):
            parts.append(_roll(vehicle.kind))
        if number == _STAGES.index(_ON_BODY):
            parts.append("\n        v_x, v_y, v_w = v0, 0.0, w0")
        for effect in model:
            if isinstance(effect, FormulaEffect):
                if stage is _ON_GROUND:
                    parts.append(_formula(effect))
                    written.add(effect.id)
            elif effect.id in stage and not is_own(type(effect)):
                parts.append(
                    _fill(
                        effect, _CAR_TURN_LIMIT if _is_car_limit(effect, vehicle.kind) else stage[effect.id]
                    )
                )
                written.add(effect.id)
    missing = [effect.id for effect in model if effect.id not in written]
    if missing:
        raise MotionError(
            "not_exportable",
            f"{missing[0]} is Python of your own and cannot be written out",
            where=missing[0],
            hint="Write it as a formula in the model file, or export without it (slip model drop).",
        )
    lever_m = vehicle.kinematics.lever_m(vehicle)
    if lever_m:
        parts.append(f"\n        v_y = v_y + {lever_m!r} * v_w")
    return "".join([*parts, _TAIL])


def _write_head(vehicle: Vehicle, delay: float) -> str:
    text = _HEAD
    for key, number in (
        ("radius", vehicle.wheel_radius_m),
        ("track", vehicle.track_width_m or 1.0),
        ("wheelbase", vehicle.wheelbase_m or 1.0),
        ("multiplier", vehicle.controller_track_multiplier),
        ("delay", delay),
    ):
        text = text.replace(f"{{{key}}}", _number(number))
    # The name last: what stands in it is not looked at again.
    return text.replace("{name}", ascii(vehicle.name))


def _is_car_limit(effect: Effect, kind: str) -> bool:
    return effect.id == "body_turn_limit" and kind == "ackermann"


def _roll(kind: str) -> str:
    turning = "f_x * math.tan(steering) / WHEELBASE" if kind == "ackermann" else "R * (right - left) / B"
    return f"""
        turning = 1.0 if R * max(abs(left), abs(right)) > 0.01 else 0.0
        f_x = R * (left + right) / 2.0
        f_w = {turning}
        v0, w0 = f_x, f_w"""


def _fill(effect: Effect, text: str) -> str:
    values = dict(effect.values)
    for name, value in values.items():
        text = text.replace(f"{{{name}}}", _number(value))
    return text.replace("{has_x}", str(math.isfinite(values.get("at_x", math.nan))))


def _number(value: float) -> str:
    if math.isnan(value):
        return "math.nan"
    return repr(float(value)) if math.isfinite(value) else ("math.inf" if value > 0 else "-math.inf")


def _formula(effect: FormulaEffect) -> str:
    lines = []
    for channel, expression in effect.expressions.items():
        if any(name.endswith("_rate") for name in expression.names):
            raise MotionError(
                "not_exportable",
                f"{effect.id} uses the rate of a signal, which the exported function does not have",
                where=effect.id,
                hint="Export without it (slip model drop).",
            )
        body = ast.unparse(ast.fix_missing_locations(_Writer(effect).visit(copy.deepcopy(expression.tree))))
        lines.append(f"\n        {channel} = {channel} + ({body})")
    return "".join(lines)


class _Writer(ast.NodeTransformer):
    """Turns a formula's syntax into that of plain Python: numbers for parameters, functions of `math`."""

    def __init__(self, effect: FormulaEffect) -> None:
        self._values = effect.values

    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        """A number, as the model computes with it: never a whole one of any length."""
        return ast.Constant(float(str(node.value)))

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """A parameter's number, the constant pi, or a signal."""
        if node.id == "pi":
            return _of_math("pi")
        return ast.Constant(self._values[node.id]) if node.id in self._values else node

    def visit_BinOp(self, node: ast.BinOp) -> ast.expr:
        """Python's own power of a negative number is complex; that of `math` is an error, as in the model."""
        left, right = self.visit(node.left), self.visit(node.right)
        if isinstance(node.op, ast.Pow):
            return ast.Call(_of_math("pow"), [left, right], [])
        return ast.BinOp(left, node.op, right)

    def visit_Call(self, node: ast.Call) -> ast.expr:
        """A call of a function that is built in, stands above, or is one of `math`."""
        name = cast("ast.Name", node.func).id
        function = ast.Name(name) if name in _PLAIN_NAMES else _of_math(name)
        return ast.Call(function, [self.visit(argument) for argument in node.args], [])


def _of_math(name: str) -> ast.expr:
    return ast.Attribute(ast.Name("math"), name)
