"""Tolerant access to stored JSON objects: missing values and those of another type are omitted."""

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path


def read_object(path: Path) -> dict[str, object]:
    """The object in a file; empty if there is none or it cannot be read."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def number_in(source: Mapping[str, object], key: str) -> float | None:
    """A finite number under a key, or None."""
    return _take_number(source.get(key))


def numbers_in(source: Mapping[str, object], key: str) -> list[float | None]:
    """A list of numbers under a key; other entries become None."""
    return [_take_number(entry) for entry in _take_list(source.get(key))]


def mapping_in(source: Mapping[str, object], key: str) -> Mapping[str, object]:
    """An object under a key; empty if missing."""
    value = source.get(key)
    return value if isinstance(value, Mapping) else {}


def objects_in(source: Mapping[str, object], key: str) -> list[Mapping[str, object]]:
    """A list of objects under a key; empty if missing, without entries of other types."""
    return [entry for entry in _take_list(source.get(key)) if isinstance(entry, Mapping)]


def _take_number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    # Integers as well: one of 400 digits exceeds the range of a double.
    return float(value) if abs(value) <= sys.float_info.max else None


def _take_list(value: object) -> Sequence[object]:
    return value if isinstance(value, Sequence) and not isinstance(value, str) else ()
