"""Exports of a fitted model to what people run: controller parameters, JSON, a plain Python function."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING

from pipeline.motion.effect import Place
from pipeline.motion.formula.formula_effect import FormulaEffect
from pipeline.motion.python_text import write_function

if TYPE_CHECKING:
    from pipeline.motion.model import Model
    from pipeline.motion.model_file import ModelFile

__all__ = ["export_json", "export_python", "export_ros2_control"]

_MAPPED = ("effective_track", "wheel_radius", "wheel_asymmetry", "body_speed_limit", "body_turn_limit")


def export_ros2_control(file: ModelFile) -> str:
    """Parameters of a `diff_drive_controller` and of nav2's `velocity_smoother`, as YAML.

    Effective track, wheel radius, wheel asymmetry and the two body limits have a parameter there; everything
    else is listed in a comment, because no parameter would make the controller know it.
    """
    model = file.model
    lines = [f"# Parameters for {model.vehicle.name}, from a fitted motion model."]
    unmapped = [effect.id for effect in model if effect.id not in _MAPPED]
    if unmapped:
        lines.append(f"# No parameter of the controller stands for: {', '.join(unmapped)}.")
    track_m = model.vehicle.track_width_m
    if model.vehicle.kind != "differential" or track_m is None:
        return "\n".join([*lines, "# The vehicle is no differential drive: nothing maps.", ""])
    radius = _value(model, "wheel_radius", "k", 1.0)
    uneven = _value(model, "wheel_asymmetry", "e", 0.0)
    speed = _value(model, "body_speed_limit", "limit", math.inf)
    turn = _value(model, "body_turn_limit", "limit", math.inf)
    lines += [
        "diff_drive_controller:",
        "  ros__parameters:",
        f"    wheel_separation: {_write_double(track_m)}",
        f"    wheel_radius: {_write_double(model.vehicle.wheel_radius_m)}",
        f"    wheel_separation_multiplier: {_write_double(_value(model, 'effective_track', 'k', 1.0))}",
        f"    left_wheel_radius_multiplier: {_write_double(radius * (1.0 - uneven / 2.0))}",
        f"    right_wheel_radius_multiplier: {_write_double(radius * (1.0 + uneven / 2.0))}",
    ]
    if math.isfinite(speed):
        lines += [
            f"    linear.x.max_velocity: {_write_double(speed)}",
            f"    linear.x.min_velocity: {_write_double(-speed)}",
        ]
    if math.isfinite(turn):
        lines += [
            f"    angular.z.max_velocity: {_write_double(turn)}",
            f"    angular.z.min_velocity: {_write_double(-turn)}",
        ]
    if math.isfinite(speed) and math.isfinite(turn):
        lines += [
            "velocity_smoother:",
            "  ros__parameters:",
            f"    max_velocity: [{_write_double(speed)}, 0.0, {_write_double(turn)}]",
            f"    min_velocity: [{_write_double(-speed)}, 0.0, {_write_double(-turn)}]",
        ]
    return "\n".join([*lines, ""])


def export_json(file: ModelFile) -> str:
    """The model with values, intervals and units as one JSON object; numbers that are not finite are null."""
    vehicle = file.model.vehicle
    effects = []
    for effect in file.model:
        parameters = {}
        for parameter in effect.parameters:
            low, high = file.intervals.get(f"{effect.id}.{parameter.name}", (math.nan, math.nan))
            numbers = {"value": effect.values[parameter.name], "low": low, "high": high}
            parameters[parameter.name] = {
                **{key: number if math.isfinite(number) else None for key, number in numbers.items()},
                "unit": parameter.unit,
            }
        item: dict[str, object] = {
            "id": effect.id,
            "place": effect.place.name.lower(),
            "parameters": parameters,
        }
        if isinstance(effect, FormulaEffect):
            item["formulas"] = effect.formulas
        effects.append(item)
    content = {
        "vehicle": {
            "id": vehicle.id,
            "kind": vehicle.kind,
            "wheel_radius_m": vehicle.wheel_radius_m,
            "track_width_m": vehicle.track_width_m,
            "wheelbase_m": vehicle.wheelbase_m,
            "controller_track_multiplier": vehicle.controller_track_multiplier,
        },
        "effects": effects,
        "fit": _plain(file.fit),
        **({"warnings": list(file.warnings)} if file.warnings else {}),
    }
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def export_python(file: ModelFile) -> str:
    """A Python function without dependencies that predicts poses from commands.

    Effects of the localization are left out: the function says where the vehicle is, not what is reported.

    Raises:
        MotionError: ``not_exportable``, an effect is a class of the user's own or needs what a planner lacks.
    """
    return write_function(file.model.keep(e.id for e in file.model if e.place is not Place.LOCALIZATION))


def _write_double(value: float) -> str:
    """A number that YAML reads as a double: ROS 2 refuses an integer for a parameter declared as one."""
    text = repr(float(f"{value:.5g}"))
    mantissa, mark, exponent = text.partition("e")
    return text if not mark or "." in mantissa else f"{mantissa}.0e{exponent}"


def _value(model: Model, effect: str, name: str, otherwise: float) -> float:
    return model.effect(effect).values[name] if effect in model else otherwise


def _plain(value: object) -> object:
    """A value as JSON can hold it."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
