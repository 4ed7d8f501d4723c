"""Exports of a fitted model to what people run: controller parameters, JSON, a plain Python function."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING

import yaml

from pipeline.models.catalogue import is_own
from pipeline.models.effect import Place
from pipeline.models.formula.formula_effect import FormulaEffect
from pipeline.models.python_text import write_function

if TYPE_CHECKING:
    from pipeline.models.effect import Effect
    from pipeline.models.model import Model
    from pipeline.models.model_file import ModelFile

__all__ = ["export_json", "export_python", "export_ros2_control"]

_MAPPED = ("effective_track", "wheel_radius", "wheel_asymmetry", "body_speed_limit", "body_turn_limit")


def export_ros2_control(file: ModelFile) -> str:
    """Parameters of a `diff_drive_controller` and of nav2's `velocity_smoother`, as YAML.

    Effective track, wheel radius, wheel asymmetry and the two body limits have a parameter there; everything
    else is listed in a comment, because no parameter would make the controller know it.
    """
    model = file.model
    lines = [_comment(f"Parameters for {model.vehicle.name}, from a fitted motion model.")]
    unmapped = [effect.id for effect in model if not _is_mapped(effect)]
    if unmapped:
        lines.append(_comment(f"No parameter of the controller stands for: {', '.join(unmapped)}."))
    track_m = model.vehicle.track_width_m
    if model.vehicle.kind != "differential" or track_m is None:
        return "\n".join([*lines, "# The vehicle is no differential drive: nothing maps.", ""])
    radius = _value(model, "wheel_radius", "k", 1.0)
    uneven = _value(model, "wheel_asymmetry", "e", 0.0)
    speed = _value(model, "body_speed_limit", "limit", math.inf)
    turn = _value(model, "body_turn_limit", "limit", math.inf)
    controller: dict[str, object] = {
        "wheel_separation": _round(track_m),
        "wheel_radius": _round(model.vehicle.wheel_radius_m),
        "wheel_separation_multiplier": _round(_value(model, "effective_track", "k", 1.0)),
        "left_wheel_radius_multiplier": _round(radius * (1.0 - uneven / 2.0)),
        "right_wheel_radius_multiplier": _round(radius * (1.0 + uneven / 2.0)),
    }
    if math.isfinite(speed):
        controller |= {"linear.x.max_velocity": _round(speed), "linear.x.min_velocity": _round(-speed)}
    if math.isfinite(turn):
        controller |= {"angular.z.max_velocity": _round(turn), "angular.z.min_velocity": _round(-turn)}
    nodes: dict[str, object] = {"diff_drive_controller": {"ros__parameters": controller}}
    if math.isfinite(speed) and math.isfinite(turn):
        most = {
            "max_velocity": _Row((_round(speed), 0.0, _round(turn))),
            "min_velocity": _Row((_round(-speed), 0.0, _round(-turn))),
        }
        nodes["velocity_smoother"] = {"ros__parameters": most}
    text: str = yaml.dump(nodes, Dumper=_Dumper, sort_keys=False, default_flow_style=False)
    return "\n".join([*lines, text])


class _Row(tuple[float, ...]):
    """Numbers that stand in one line."""

    __slots__ = ()


class _Dumper(yaml.SafeDumper):  # type: ignore[misc]
    """Plain YAML; every float is written as ROS 2 takes it for a double."""


_Dumper.add_representer(
    _Row, lambda dumper, row: dumper.represent_sequence("tag:yaml.org,2002:seq", row, flow_style=True)
)


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


def _round(value: float) -> float:
    return float(f"{value:.5g}")


def _comment(text: str) -> str:
    """A comment of one line, whatever names stand in it."""
    return "# " + "".join(c if c.isprintable() else " " for c in text)


def _value(model: Model, effect: str, name: str, otherwise: float) -> float:
    return (
        model.effect(effect).values[name]
        if effect in model and _is_mapped(model.effect(effect))
        else otherwise
    )


def _is_mapped(effect: Effect) -> bool:
    """Whether the controller has its parameters; a formula or Python of that name is something else."""
    return effect.id in _MAPPED and not isinstance(effect, FormulaEffect) and not is_own(type(effect))


def _plain(value: object) -> object:
    """A value as JSON can hold it."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
