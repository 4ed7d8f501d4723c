"""Field paths: which leaves they mean, and the columns they name."""

import re
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pipeline.core.arrays import Ints
from pipeline.logs.columns import Column, Ragged, RaggedStrings
from pipeline.logs.errors import LogError

STAMPS: Final = ("header.stamp.", "timestamp.")
"""Where messages carry the time they are about: ROS headers, and the protobuf and JSON types of Foxglove."""

_LATEST_S: Final = 1 << 33
"""Seconds beyond the year 2242, and as many before 1970: no stamp of a recording."""

_INDEXED: Final = re.compile(r"^(?P<path>.*[^\]])\[(?P<number>\d+)\]$")


def join_stamp(seconds: NDArray[np.generic], nanoseconds: NDArray[np.generic]) -> Ints | None:
    """Stamps [ns] of seconds and nanoseconds, None where one of them is no time at all."""
    if not ((np.abs(seconds) <= _LATEST_S) & (np.abs(nanoseconds) <= _LATEST_S)).all():
        return None
    return seconds.astype(np.int64) * 1_000_000_000 + nanoseconds.astype(np.int64)


def select_leaves(leaves: Sequence[str], fields: Sequence[str] | None, *, where: str) -> set[str]:
    """Leaf fields that the wanted paths need.

    Args:
        leaves: every leaf field of the type.
        fields: wanted paths, None for all.
        where: the topic, for messages.

    Raises:
        LogError: ``field_not_found``.
    """
    if fields is None:
        return set(leaves)
    chosen: set[str] = set()
    for wanted in fields:
        found = _leaves_of(leaves, wanted)
        if not found:
            hint = f"The type has: {', '.join(leaves)}"
            raise LogError("field_not_found", f"there is no field {wanted}", where=where, hint=hint)
        chosen.update(found)
    return chosen


def derive_columns(
    columns: Mapping[str, Column], fields: Sequence[str] | None, leaves: Sequence[str]
) -> dict[str, Column]:
    """The columns that the wanted paths name, from those of the leaf fields.

    Args:
        columns: by leaf field.
        fields: wanted paths, None for all.
        leaves: every leaf field of the type.
    """
    if fields is None:
        return {path: columns[path] for path in leaves}
    named: dict[str, Column] = {}
    for wanted in fields:
        match = _INDEXED.match(wanted)
        if match is not None and match["path"] in columns:
            named[wanted] = _element(columns[match["path"]], int(match["number"]))
            continue
        for path in _leaves_of(leaves, wanted):
            named[path] = columns[path]
    return named


def _leaves_of(leaves: Sequence[str], wanted: str) -> list[str]:
    match = _INDEXED.match(wanted)
    plain = match["path"] if match else wanted
    if plain in leaves:
        return [plain]
    if match is not None:
        return []
    return [path for path in leaves if path.startswith((f"{wanted}.", f"{wanted}[]."))]


def _element(column: Column, number: int) -> Column:
    if isinstance(column, Ragged | RaggedStrings):
        return column.at(number)
    if isinstance(column, np.ndarray) and column.ndim > 1:
        inside = number < column.shape[1]
        return column[:, number] if inside else np.full(column.shape[0], np.nan)
    return column
