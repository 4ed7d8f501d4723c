"""Writing a model file: plain TOML with units, values and intervals, one line a parameter."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import msgspec

from pipeline.motion.errors import MotionError
from pipeline.motion.formula.formula_effect import FormulaEffect
from pipeline.motion.model_file import FORMAT
from pipeline.store.files import replace_file
from pipeline.vehicles import find_preset

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.motion.effect import Effect, Parameter
    from pipeline.motion.model_file import ModelFile
    from pipeline.vehicles import Vehicle

_GEOMETRY = (
    "wheel_radius_m",
    "track_width_m",
    "wheelbase_m",
    "base_to_rear_axle_m",
    "mass_kg",
    "max_speed_mps",
    "max_yaw_rate_radps",
    "max_steering_rad",
    "controller_track_multiplier",
)
_DIGITS = 6


def write_model(file: ModelFile, path: Path) -> None:
    """Write a model file in one moment: a reader sees the old one or the new one.

    Raises:
        MotionError: ``model_unwritable``; ``model_incomplete``, see `format_model`.
    """
    text = format_model(file)
    try:
        replace_file(path, text.encode())
    except OSError as error:
        raise MotionError(
            "model_unwritable",
            f"cannot be written: {error.strerror}",
            where=str(path),
            hint="Check the folder and its permissions.",
        ) from None


def format_model(file: ModelFile) -> str:
    """The text of a model file.

    Raises:
        MotionError: ``model_incomplete``, effects were left out when it was read and would be lost.
    """
    if file.left_out:
        raise MotionError(
            "model_incomplete",
            f"{', '.join(file.left_out)} would be lost: {', '.join(file.effect_files)} is not trusted",
            where=", ".join(file.left_out),
            hint="Read it and trust it (slip model trust), or take its effects out of the file by hand.",
        )
    lines = [
        "# A motion model: a vehicle, and the physical effects by which it differs from the ideal one.",
        "# `slip effects ID` explains an effect; `slip model show` this file.",
        f"format = {FORMAT}",
    ]
    if file.note:
        lines.append(f"note = {_text(file.note)}")
    if file.effect_files:
        lines.append(f"effects = [{', '.join(_text(name) for name in file.effect_files)}]")
    lines += ["", *_format_vehicle(file.model.vehicle)]
    for effect in file.model:
        lines += ["", "[[effect]]", f"id = {_text(effect.id)}"]
        if isinstance(effect, FormulaEffect):
            lines += [f"{channel} = {_text(text)}" for channel, text in effect.formulas.items()]
        lines += [_format_parameter(file, effect, parameter) for parameter in effect.parameters]
    if file.fit:
        lines += ["", "# What the values were fitted on.", *_format_table("fit", file.fit)]
    return "\n".join(lines) + "\n"


def _format_vehicle(vehicle: Vehicle) -> list[str]:
    preset = find_preset(vehicle.id)
    lines = ["[vehicle]"]
    values = msgspec.structs.asdict(vehicle)
    if preset is not None:
        lines.append(f"preset = {_text(preset.id)}")
        known = msgspec.structs.asdict(preset)
        return lines + [f"{key} = {_value(values[key])}" for key in _GEOMETRY if values[key] != known[key]]
    lines += [f"name = {_text(vehicle.name)}", f"kind = {_text(vehicle.kind)}"]
    return lines + [f"{key} = {_value(values[key])}" for key in _GEOMETRY if values[key] is not None]


def _format_parameter(file: ModelFile, effect: Effect, parameter: Parameter) -> str:
    label, value = f"{effect.id}.{parameter.name}", effect.values[parameter.name]
    parts = [] if math.isnan(value) else [f"value = {_value(value)}"]
    if label in file.intervals:
        low, high = file.intervals[label]
        parts += [f"low = {_value(low)}", f"high = {_value(high)}"]
    parts.append(f"unit = {_text(parameter.unit)}")
    if isinstance(effect, FormulaEffect):
        parts.append(f"bounds = [{_value(parameter.bounds[0])}, {_value(parameter.bounds[1])}]")
        if parameter.neutral != 0.0:
            parts.append(f"neutral = {_value(parameter.neutral)}")
    if parameter.name in effect.fixed:
        parts.append("fixed = true")
    if label in file.per_run or effect.id in file.per_run:
        parts.append("per_run = true")
    return f"{parameter.name} = {{ {', '.join(parts)} }}"


def _format_table(name: str, table: Mapping[str, object]) -> list[str]:
    """A table with its plain keys first, then lists of tables as [[name.key]]."""
    lines = [f"[{name}]"]
    for key, value in table.items():
        if not _is_tables(value):
            lines.append(f"{key} = {_value(value)}")
    for key, value in table.items():
        if _is_tables(value) and isinstance(value, Sequence):
            for row in value:
                lines += ["", f"[[{name}.{key}]]", *(f"{k} = {_value(v)}" for k, v in row.items())]
    return lines


def _is_tables(value: object) -> bool:
    return (
        isinstance(value, Sequence)
        and not isinstance(value, str)
        and bool(value)
        and all(isinstance(item, Mapping) for item in value)
    )


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return _number(value)
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{k} = {_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    return str(value) if isinstance(value, int) else _text(str(value))


def _number(value: float) -> str:
    if not math.isfinite(value):
        return "nan" if math.isnan(value) else ("inf" if value > 0 else "-inf")
    text = f"{value:.{_DIGITS}g}"
    return text if any(mark in text for mark in ".en") else f"{text}.0"


def _text(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    plain = "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in escaped)
    return f'"{plain}"'
