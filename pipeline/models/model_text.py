"""Model files as text: plain TOML with units, values and intervals, one line per parameter."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec
import tomlkit

from pipeline.core import naming_os_errors, round_digits
from pipeline.logs.index import SUFFIXES, stem_of
from pipeline.models.effect import (
    Effect,
    Parameter,
)
from pipeline.models.formula import FormulaEffect
from pipeline.models.model_file import CONTRADICTED, FORMAT, ModelFile
from pipeline.models.number import Number
from pipeline.run import MotionError
from pipeline.sources import FLEET_FILE, RANGES, RUN_FILE, Vehicle, find_preset, is_model
from pipeline.store import replace_file


def write_model(file: ModelFile, path: Path) -> None:
    """Write a model file atomically: a reader sees the old one or the new one.

    Raises:
        MotionError: ``model_unwritable``; ``model_misplaced``.
    """
    check_target(path)
    write_text(path, format_model(file), code="model_unwritable")


def check_target(path: Path) -> None:
    """Check that a model may be written to a path.

    Raises:
        MotionError: ``model_misplaced``, the path is a configuration of logs.
    """
    if not path.is_file() or is_model(path):
        return
    for log in path.parent.glob("*"):
        if log.name.endswith(SUFFIXES) and path.name in {FLEET_FILE, RUN_FILE, f"{stem_of(log)}.toml"}:
            what = f"it is the configuration of {log.name}, which a model would replace"
            hint = "Give the model another name, for example model.toml."
            raise MotionError("model_misplaced", what, where=str(path), hint=hint)


def write_text(path: Path, text: str, *, code: str) -> None:
    """Write a text file atomically.

    Raises:
        MotionError: with this code, if the file cannot be written.
    """
    hint = "Check the folder and its permissions."
    with naming_os_errors(MotionError, code, "cannot be written", where=path, hint=hint):
        replace_file(path, text.encode())


def format_model(file: ModelFile) -> str:
    """The text of a model file."""
    lines = [
        "# A motion model: a vehicle, and the physical effects by which it differs from the ideal one.",
        "# `slip effects ID` explains an effect; `slip model show` this file.",
        f"format = {FORMAT}",
    ]
    if file.note:
        lines.append(f"note = {format_value(file.note)}")
    lines += ["", *_format_vehicle(file.model.vehicle)]
    lines += [f"# {name} is {CONTRADICTED}" for name in file.contradicted]
    for effect in file.model:
        lines += ["", *_list_lines(effect, file)]
    if file.fit:
        lines += ["", "# What the values were fitted on.", *_format_table("fit", file.fit)]
    return "\n".join(lines) + "\n"


def format_effect(effect: Effect) -> str:
    """An effect as text of a model file, without intervals."""
    return "\n".join(_list_lines(effect)) + "\n"


def _list_lines(effect: Effect, file: ModelFile | None = None) -> list[str]:
    lines = ["[[effect]]", f"id = {format_value(effect.id)}"]
    if isinstance(effect, FormulaEffect):
        lines += [f"{channel} = {format_value(text)}" for channel, text in effect.formulas.items()]
    return lines + [_format_parameter(effect, parameter, file) for parameter in effect.parameters]


def _format_vehicle(vehicle: Vehicle) -> list[str]:
    preset = find_preset(vehicle.id)
    lines = ["[vehicle]"]
    values = msgspec.structs.asdict(vehicle)
    known = {} if preset is None else msgspec.structs.asdict(preset)
    # A vehicle of the same name may lack what the preset knows, and a file has no word for that.
    if (
        preset is not None
        and vehicle.kind == preset.kind
        and not any(values[key] is None and known[key] is not None for key in RANGES)
    ):
        lines.append(f"preset = {format_value(preset.id)}")
        return lines + [f"{key} = {_exactly(values[key])}" for key in RANGES if values[key] != known[key]]
    lines += [f"name = {format_value(vehicle.name)}", f"kind = {format_value(vehicle.kind)}"]
    lines += [f"{key} = {_exactly(values[key])}" for key in RANGES if values[key] is not None]
    if vehicle.stand_ins:
        names = ", ".join(map(format_value, vehicle.stand_ins))
        lines.append("# Not known: their values only convert body motion into wheel speeds and back.")
        lines.append(f"stand_ins = [{names}]")
    return lines


def _format_parameter(effect: Effect, parameter: Parameter, file: ModelFile | None) -> str:
    label, value = f"{effect.id}.{parameter.name}", effect.values[parameter.name]
    parts = [] if math.isnan(value) else [f"value = {_exactly(parameter.round(value))}"]
    noted = (file and file.numbers.get(label)) or Number(value)
    if math.isfinite(noted.low):
        parts += [f"low = {format_value(noted.low)}", f"high = {format_value(noted.high)}"]
    parts.append(f"unit = {format_value(parameter.unit)}")
    if isinstance(effect, FormulaEffect):
        parts.append(f"bounds = [{', '.join(map(_exactly, parameter.bounds))}]")
        if parameter.neutral != 0.0:
            parts.append(f"neutral = {_exactly(parameter.neutral)}")
    if parameter.name in effect.fixed:
        parts.append("fixed = true")
    if file is not None and not {label, effect.id}.isdisjoint(file.per_run):
        parts.append("per_run = true")
    parts += [f"doubt = {format_value(noted.doubt)}"] * bool(noted.doubt)
    parts += [f"stretches = {noted.stretches}"] * bool(noted.stretches)
    number = None if file is None else file.find_number(effect.rounded, parameter)
    remark = "" if number is None else "; ".join(filter(None, (number.reason, number.elsewhere)))
    return f"{_key(parameter.name)} = {{ {', '.join(parts)} }}" + (f"  # {remark}" if remark else "")


def _format_table(name: str, table: Mapping[str, object]) -> list[str]:
    """A table with its plain keys first, then lists of tables as [[name.key]]."""
    lines = [f"[{name}]"]
    for key, value in table.items():
        if not _is_tables(value):
            lines.append(f"{_key(key)} = {format_value(value)}")
    for key, value in table.items():
        if _is_tables(value) and isinstance(value, Sequence):
            for row in value:
                lines += [
                    "",
                    f"[[{name}.{_key(key)}]]",
                    *(f"{_key(k)} = {format_value(v)}" for k, v in row.items()),
                ]
    return lines


def _is_tables(value: object) -> bool:
    return (
        isinstance(value, Sequence)
        and not isinstance(value, str)
        and bool(value)
        and all(isinstance(item, Mapping) for item in value)
    )


def format_value(value: object) -> str:
    """A value in TOML; lists and tables are written in one line, without the values that are unknown."""
    if isinstance(value, Mapping):
        known = {key: one for key, one in value.items() if one is not None}
        return "{ " + ", ".join(f"{_key(k)} = {format_value(v)}" for k, v in known.items()) + " }"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "[" + ", ".join(format_value(item) for item in value) + "]"
    if isinstance(value, float):
        value = round_digits(value)
    return str(tomlkit.item(value).as_string())


def _key(name: str) -> str:
    return str(tomlkit.key(name).as_string())


def _exactly(value: float) -> str:
    return str(tomlkit.item(float(value)).as_string())
