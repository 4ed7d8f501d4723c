"""Bringing the many ways to give a column into the few that are written."""

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from pipeline.core.arrays import Ints
from pipeline.logs.columns import Column, Ragged, RaggedStrings, Strings
from pipeline.logs.decode import Leaf, plan_fields, wanted_leaves
from pipeline.logs.errors import LogError
from pipeline.logs.schema import Structure, leaf_paths

Given: TypeAlias = "NDArray[np.generic] | Ragged | RaggedStrings | Strings | float | str | Sequence[object]"
"""A value for all messages, or one for each."""


def normalize_columns(
    structure: Structure, rows: int, fields: Mapping[str, Given], *, where: str
) -> dict[str, Column]:
    """Bring given values into the columns that reading would return.

    A single number or string stands for all messages, and so does one list of strings for a sequence of
    strings. For a field in a sequence of structures, one value a message makes sequences of one, an array
    (n, k) sequences of k; the sequences of one message are equally long.

    Args:
        structure: the type.
        rows: how many messages.
        fields: values by leaf path.
        where: topic, for messages.

    Raises:
        LogError: ``field_not_found``, ``bad_column``.
    """
    leaves = tuple(leaf_paths(structure))
    for path in fields:
        if path not in leaves:
            hint = f"The type has: {', '.join(leaves)}"
            raise LogError("field_not_found", f"there is no field {path}", where=where, hint=hint)
    if rows == 0:
        return {}
    wanted = dict(wanted_leaves(plan_fields(structure, set(fields))))
    columns: dict[str, Column] = {}
    for path, leaf in wanted.items():
        try:
            columns[path] = _normalize(fields[path], leaf, rows, inside="[]." in path)
        except (ValueError, TypeError, OverflowError) as error:
            hint = f"Give one value, or {rows} of the field's type"
            raise LogError("bad_column", f"field {path}: {error}", where=where, hint=hint) from None
    _match_sequences(columns, rows, where)
    return columns


def _normalize(given: Given, leaf: Leaf, rows: int, *, inside: bool) -> Column:
    if leaf.text:
        return _normalize_texts(given, leaf, rows, inside=inside)
    if isinstance(given, Ragged):
        return Ragged(_cast(given.values, leaf.nothing.dtype), _check_offsets(given.offsets, rows))
    if leaf.ragged and isinstance(given, Sequence) and not isinstance(given, str):
        each_row = [np.atleast_1d(np.asarray(each)) for each in given]
        sizes = [row.size for row in each_row]
        if len(set(sizes)) > 1:
            joined = np.concatenate(each_row)
            return Ragged(_cast(joined, leaf.nothing.dtype), _check_offsets(np.r_[0, np.cumsum(sizes)], rows))
    values = _cast(np.asarray(given), leaf.nothing.dtype)
    width = leaf.nothing.shape[1:]
    if leaf.ragged:
        values = (
            values.reshape(rows, -1)
            if values.ndim and values.shape[0] == rows
            else np.broadcast_to(values, (rows, values.size if values.ndim else 1))
        )
        count = values.shape[1]
        return Ragged(values.reshape(-1), np.arange(rows + 1, dtype=np.int64) * count)
    return np.broadcast_to(values, (rows, *width))


def _normalize_texts(given: Given, leaf: Leaf, rows: int, *, inside: bool) -> Column:
    if isinstance(given, RaggedStrings):
        _check_offsets(given.offsets, rows)
        return given if leaf.ragged else Strings(given.codes, given.values)
    if isinstance(given, Strings):
        if given.codes.size != rows:
            raise ValueError(f"{given.codes.size} strings for {rows} messages")
        if not leaf.ragged:
            return given
        return RaggedStrings(given.codes, given.values, np.arange(rows + 1, dtype=np.int64))
    if isinstance(given, str):
        codes = np.zeros(rows, dtype=np.int32)
        return _normalize_texts(Strings(codes, (given,)), leaf, rows, inside=inside)
    if not isinstance(given, Sequence | np.ndarray):
        raise TypeError(f"{given!r} is no string")
    items = given.tolist() if isinstance(given, np.ndarray) else list(given)
    nested = bool(items) and not isinstance(items[0], str)
    if leaf.ragged and not nested and (not inside or len(items) != rows):
        items, nested = [items] * rows, True
    if len(items) != rows:
        raise ValueError(f"{len(items)} strings for {rows} messages")
    lists = [_as_list(each) for each in items]
    numbers: dict[str, int] = {}
    codes = np.array([numbers.setdefault(t, len(numbers)) for each in lists for t in each], dtype=np.int32)
    if not leaf.ragged:
        return Strings(codes, tuple(numbers))
    offsets = np.r_[0, np.cumsum([len(each) for each in lists], dtype=np.int64)]
    return RaggedStrings(codes, tuple(numbers), offsets)


def _as_list(given: object) -> list[str]:
    if isinstance(given, Sequence | np.ndarray) and not isinstance(given, str):
        return [str(text) for text in given]
    return [str(given)]


def _cast(values: NDArray[np.generic], kind: np.dtype[np.generic]) -> NDArray[np.generic]:
    if kind == values.dtype:
        return values
    with np.errstate(invalid="ignore"):
        cast = values.astype(kind)
    if kind.kind in "iu" and not (cast == values).all():
        raise ValueError(f"the values do not fit {kind.name}")
    return cast


def _check_offsets(offsets: Ints, rows: int) -> Ints:
    if offsets.size != rows + 1:
        raise ValueError(f"sequences of {offsets.size - 1} messages for {rows}")
    return offsets.astype(np.int64)


def _match_sequences(columns: Mapping[str, Column], rows: int, where: str) -> None:
    counts: dict[str, tuple[str, Ints]] = {}
    for path, column in columns.items():
        owner, inside, _ = path.rpartition("[].")
        if not inside or not isinstance(column, Ragged | RaggedStrings):
            continue
        known = counts.setdefault(owner, (path, np.diff(column.offsets)))
        if not np.array_equal(known[1], np.diff(column.offsets)):
            raise LogError(
                "bad_column",
                f"fields {known[0]} and {path} have sequences of different lengths",
                where=where,
                hint=f"Give both for the same elements of the {rows} messages",
            )
