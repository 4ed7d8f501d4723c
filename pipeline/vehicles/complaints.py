"""What is wrong in a configuration: the line it stands in, and the words that would do."""

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import msgspec

from pipeline.core.errors import shorten
from pipeline.vehicles.configuration import Configuration
from pipeline.vehicles.errors import ConfigurationError
from pipeline.vehicles.presets import find_preset, list_presets

_PLACE = re.compile(r"at `\$\.?([^`]*)`")
_UNKNOWN = re.compile(r"unknown field `([^`]*)`")
_VALUE = re.compile(r"value '([^']*)'")
_STEP = re.compile(r"[A-Za-z_]\w*|\[")


def describe_fault(error: msgspec.ValidationError, where: str, source: Path | None) -> ConfigurationError:
    """The error of a configuration that does not fit.

    Args:
        error: what is wrong with it.
        where: the file, or what stands in the place of one.
        source: the file, to name the line.
    """
    message = str(error)
    place, unknown, value = (_find(pattern, message) for pattern in (_PLACE, _UNKNOWN, _VALUE))
    steps = _STEP.findall(place)
    if unknown:
        keys = ", ".join(sorted(_list_keys(steps)))
        hint = f"The keys there are: {keys}." if keys else "The handbook, Configuration, lists the keys."
        steps.append(unknown)
    else:
        words = ", ".join(str(word) for word in _list_words(steps))
        hint = f"Write one of: {words}." if words else "The handbook, Configuration, lists keys and units."
    return ConfigurationError(
        "config_invalid",
        f"the configuration is not valid: {shorten(_readable(message))}",
        where=_name_line(where, source, steps, value),
        hint=hint,
    )


def check_preset(tree: Mapping[str, object], source: Path) -> None:
    """Refuse a preset that nobody knows where it is named, not where a log needs it.

    Raises:
        ConfigurationError: ``vehicle_unknown``.
    """
    vehicle = tree.get("vehicle")
    name = vehicle.get("preset") if isinstance(vehicle, dict) else None
    if isinstance(name, str) and find_preset(name) is None:
        known = ", ".join(sorted(preset.id for preset in list_presets()))
        raise ConfigurationError(
            "vehicle_unknown",
            f"no vehicle preset is called {name!r}",
            where=_name_line(str(source), source, ["vehicle", "preset"], name),
            hint=f"Write one of: {known}; or the vehicle's own values in its place.",
        )


def _find(pattern: re.Pattern[str], message: str) -> str:
    found = pattern.search(message)
    return found[1] if found else ""


def _readable(message: str) -> str:
    return (
        message.replace("Object contains unknown field", "unknown key")
        .replace(" - at `$.", " in `")
        .replace("`$`", "the top level")
    )


def _walk(steps: Iterable[str]) -> Iterator[msgspec.inspect.Type]:
    """The types that a place in the configuration may have."""
    kinds: list[msgspec.inspect.Type] = [msgspec.inspect.type_info(Configuration)]
    for step in steps:
        inner: list[msgspec.inspect.Type] = []
        for kind in _spread(kinds):
            if step == "[" and isinstance(kind, msgspec.inspect.ListType | msgspec.inspect.VarTupleType):
                inner.append(kind.item_type)
            elif isinstance(kind, msgspec.inspect.StructType):
                inner += [field.type for field in kind.fields if field.encode_name == step]
        kinds = inner
    return _spread(kinds)


def _spread(kinds: Iterable[msgspec.inspect.Type]) -> Iterator[msgspec.inspect.Type]:
    for kind in kinds:
        if isinstance(kind, msgspec.inspect.UnionType):
            yield from _spread(kind.types)
        else:
            yield kind


def _list_words(steps: Iterable[str]) -> list[object]:
    literals = (kind for kind in _walk(steps) if isinstance(kind, msgspec.inspect.LiteralType))
    return [word for kind in literals for word in kind.values]


def _list_keys(steps: Iterable[str]) -> list[str]:
    structs = (kind for kind in _walk(steps) if isinstance(kind, msgspec.inspect.StructType))
    return [field.encode_name for kind in structs for field in kind.fields]


def name_key(source: Path, key: str) -> str:
    """The file and, where it can be told, the line that sets a dotted key."""
    return _name_line(str(source), source, key.split("."), "")


def _name_line(where: str, source: Path | None, steps: list[str], value: str) -> str:
    number = None if source is None else _find_line(source, [step for step in steps if step != "["], value)
    return where if number is None else f"{where}, line {number}"


def _find_line(source: Path, names: list[str], value: str) -> int | None:
    """Number of the line that sets a key, or opens its section; None when it cannot be told."""
    try:
        lines = source.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return None
    if not names:
        return None
    above = names[:-1]
    key = re.compile(rf"\s*\"?{re.escape(names[-1])}\"?\s*=")
    section: list[str] = []
    for number, line in enumerate(lines, start=1):
        opened = _read_header(line)
        if opened:
            section = opened.split(".")
            if section[-len(names) :] == names and not value:
                return number
        elif key.match(line) and section[len(section) - len(above) :] == above and value in line:
            return number
    return None


def _read_header(line: str) -> str:
    """Name of the section that a line opens; empty where it opens none."""
    text = line.strip()
    name, closed, _ = text.lstrip("[").partition("]")
    return name.strip() if text.startswith("[") and closed else ""
