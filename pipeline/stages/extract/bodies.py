"""The vehicle among bodies whose poses come in one message: models and links of a simulator, joints."""

import re
from collections.abc import Sequence
from typing import Final

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.logs import Ragged, RaggedStrings, TopicColumns
from pipeline.stages.errors import StageError
from pipeline.stages.extract.reading import PoseArrays, axis_fields, first_text
from pipeline.vehicles import Vehicle
from pipeline.vehicles.message_types import PoseFields

_BASE: Final = re.compile(r"(::|/)base(_link|_footprint)?$")
_MOVES_M: Final = 0.5
_LISTED: Final = 8


def read_bodies(
    columns: TopicColumns, pose: PoseFields, asked: str, vehicle: Vehicle
) -> tuple[PoseArrays, str]:
    """Poses of the vehicle, NaN in messages without it, and the name by which it was found.

    Args:
        columns: a topic of the type.
        pose: its fields.
        asked: name that the configuration gives; else the vehicle is the only body that moves, of several the
            only one that is a base link, or is called after the vehicle.
        vehicle: whose names are known.

    Raises:
        StageError: ``no_body``, none is the vehicle, or several may be.
    """
    names = columns.fields[pose.names]
    if not isinstance(names, RaggedStrings):
        raise _no_body(columns.topic, "they have no names", ())
    values = np.stack(
        [
            _take_values(columns, field, names)
            for field in (*axis_fields(pose.position, "xyz"), *axis_fields(pose.orientation, "xyzw"))
        ],
        axis=-1,
    )
    code = _choose(names, values[:, :3], asked, vehicle, columns.topic)
    place = np.flatnonzero(names.codes == code)
    rows = np.repeat(np.arange(len(names)), np.diff(names.offsets))[place]
    series = np.full((len(names), 7), np.nan)
    series[rows] = values[place]
    parent = first_text(columns, pose.parent) if pose.parent else pose.fixed
    return PoseArrays(series[:, :3], series[:, 3:], parent, ""), names.values[code]


def _take_values(columns: TopicColumns, field: str, names: RaggedStrings) -> Floats:
    """One number a body, all messages end to end; NaN where a message has fewer numbers than names."""
    column = columns.fields[field]
    found = np.full(names.codes.size, np.nan)
    if isinstance(column, Ragged):
        sizes = np.diff(names.offsets)
        whole = sizes == np.diff(column.offsets)
        there = np.repeat(whole, sizes)
        found[there] = column.values[np.repeat(whole, np.diff(column.offsets))]
    return found


def _choose(names: RaggedStrings, position: Floats, asked: str, vehicle: Vehicle, topic: str) -> int:
    every = {name: code for code, name in enumerate(names.values)}
    if asked:
        if asked not in every:
            raise _no_body(topic, f"none is called {asked!r}", names.values)
        return every[asked]
    words = [word.lower() for word in (vehicle.id, *vehicle.aliases, *vehicle.recognized_by)]
    moving = [name for name, code in every.items() if _reaches(position[names.codes == code])]
    bases = [name for name in moving if _BASE.search(name)] or moving
    called = [name for name in bases if any(word in name.lower() for word in words)]
    found = bases if len(bases) == 1 else called
    if len(found) != 1:
        why = "several of them move" if moving else "none of them moves"
        raise _no_body(topic, why, moving or list(names.values))
    return every[found[0]]


def _reaches(position: Floats) -> bool:
    known = position[np.isfinite(position).all(axis=1)]
    return known.size > 0 and float(np.ptp(known[:, :2], axis=0).max()) > _MOVES_M


def _no_body(topic: str, why: str, names: Sequence[str]) -> StageError:
    return StageError(
        "no_body",
        f"{topic} gives poses of {len(names)} bodies, and which is the vehicle is not known: {why}",
        where=topic,
        hint=f"Say it in run.toml: [pose] name = one of {', '.join(names[:_LISTED]) or 'its bodies'}.",
    )
