"""Channels whose messages are decoded one by one by others: JSON and protobuf.

Messages become nested values first, then columns of their leaf fields.
"""

from __future__ import annotations

import json
import math
import sys
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from pipeline.core.arrays import Ints
from pipeline.logs.cdr import MAX_TEXT
from pipeline.logs.channel import Rejected
from pipeline.logs.columns import Ragged, RaggedStrings
from pipeline.logs.errors import LogError, unsupported
from pipeline.logs.fields import STAMPS, select_leaves

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from pipeline.logs.columns import Column
    from pipeline.logs.payloads import Block


Value: TypeAlias = "float | str | bool | list[Value] | dict[str, Value] | None"
Leaf: TypeAlias = "float | str | bool"
_LARGEST_INTEGER = 1 << 63
_MOST_CELLS = 20_000_000
"""Rows times fields of a topic: messages that name their fields at will would fill any memory."""
_TIMES = {"nanos": "nanosec", "seconds": "sec", "nsec": "nanosec", "secs": "sec", "nsecs": "nanosec"}


class ObjectDecoder:
    """Decodes payloads one by one into nested values.

    Args:
        decode: from a payload to the message; raises ``ValueError`` when it cannot.
        fields: wanted paths, None for all.
        where: the topic, for messages.
    """

    def __init__(self, decode: Callable[[bytes], Value], fields: Sequence[str] | None, *, where: str) -> None:
        self._decode = decode
        self._fields = fields
        self._where = where
        self._rows: dict[int, dict[str, list[Leaf]]] = {}
        self._several: set[str] = set()
        self.rejected: list[Rejected] = []
        self.notes: tuple[str, ...] = ()
        self.shortened: dict[str, int] = {}

    def decode(self, ids: Ints, block: Block) -> None:
        """Decode a block; ``ids`` are the numbers of its rows in the channel."""
        wrong: list[int] = []
        spans = zip(ids.tolist(), block.start.tolist(), block.size.tolist(), strict=True)
        for position, (row, start, size) in enumerate(spans):
            try:
                leaves: dict[str, list[Leaf]] = {}
                for path, value, several in _walk(
                    self._decode(block.data[start : start + size].tobytes()), "", inside=False
                ):
                    leaves.setdefault(path, [])
                    if several:
                        self._several.add(path)
                    if value is not None:
                        leaves[path].append(self._bound(path, value))
                self._rows[row] = leaves
            except (ValueError, RecursionError):
                wrong.append(position)
        if wrong:
            lost = int(block.size[wrong].sum())
            self.rejected.append(Rejected("undecodable", "the payload cannot be parsed", ids[wrong], lost))

    def _bound(self, path: str, value: Leaf) -> Leaf:
        if isinstance(value, int) and abs(value) >= _LARGEST_INTEGER:
            largest = sys.float_info.max
            return float(value) if -largest <= value <= largest else math.inf * (1 if value > 0 else -1)
        if not isinstance(value, str):
            return value
        # JSON can spell half of a character, which no table can hold.
        value = value if value.isascii() else value.encode(errors="replace").decode()
        if len(value) <= MAX_TEXT:
            return value
        self.shortened[path] = self.shortened.get(path, 0) + 1
        return f"{value[:MAX_TEXT]} (cut, of {len(value)} characters)"

    def columns(self, rows: Ints) -> dict[str, Column]:
        """Columns of the given rows, in their order.

        Raises:
            LogError: ``field_not_found`` when no message has a wanted field; ``too_many_fields``.
        """
        messages = [self._rows[row] for row in rows.tolist()]
        leaves = tuple(dict.fromkeys(path for message in messages for path in message))
        if not messages:
            return {}
        chosen = select_leaves(leaves, self._fields, where=self._where)
        chosen |= {path for path in leaves if path.startswith(STAMPS)}
        if len(chosen) * len(messages) > _MOST_CELLS:
            raise LogError(
                "too_many_fields",
                f"its {len(messages)} messages have {len(chosen)} different fields, which no table can hold",
                where=self._where,
                hint="Leave the topic out",
            )
        return {path: self._column(path, messages) for path in leaves if path in chosen}

    def _column(self, path: str, messages: list[dict[str, list[Leaf]]]) -> Column:
        lists = [message.get(path, []) for message in messages]
        flat = [value for values in lists for value in values]
        offsets = np.r_[0, np.cumsum([len(values) for values in lists], dtype=np.int64)]
        if any(isinstance(value, str) for value in flat):
            numbers: dict[str, int] = {}
            codes = np.array([numbers.setdefault(str(v), len(numbers)) for v in flat], dtype=np.int32)
            column = RaggedStrings(codes, tuple(numbers), offsets)
            return column if path in self._several else column.at(0)
        values = np.array(flat) if flat else np.empty(0)
        if values.dtype == object:
            values = np.array([float(value) for value in flat])
        if path in self._several:
            return Ragged(values, offsets)
        return values if values.size == len(messages) else Ragged(values, offsets).at(0)


def decode_json(payload: bytes) -> Value:
    """The value of a JSON text.

    Raises:
        ValueError: it is none.
    """
    value: Value = json.loads(payload)
    return value


def protobuf_decoder(schema: bytes, type_name: str, *, where: str) -> Callable[[bytes], Value]:
    """A decoder of protobuf messages through ``mcap-protobuf-support``.

    Args:
        schema: serialized ``FileDescriptorSet``.
        type_name: full name of the message.
        where: the topic, for messages.

    Raises:
        LogError: ``unsupported_encoding`` when the package is absent or the schema is damaged.
    """
    try:
        from google.protobuf.message import (  # type: ignore[import-untyped]  # noqa: PLC0415 - an extra
            DecodeError,
        )
        from mcap.exceptions import McapError  # noqa: PLC0415 - an extra
        from mcap.records import Schema  # noqa: PLC0415 - an extra
        from mcap_protobuf.decoder import DecoderFactory  # noqa: PLC0415 - an extra
    except ImportError:
        what = "protobuf messages need another package"
        raise unsupported(what, where, "Install mcap-protobuf-support") from None
    try:
        parse = DecoderFactory().decoder_for(
            "protobuf", Schema(id=1, name=type_name, encoding="protobuf", data=schema)
        )
    except (DecodeError, McapError, TypeError, KeyError, ValueError) as error:
        raise unsupported(f"the protobuf schema is damaged ({error})", where) from None
    if parse is None:
        raise unsupported("the protobuf schema is damaged (its type is not in it)", where)

    def decode(payload: bytes) -> Value:
        try:
            return _plain(parse(payload))
        except DecodeError as error:
            raise ValueError(str(error)) from None

    return decode


def _plain(message: object, above: frozenset[str] = frozenset()) -> Value:
    """A protobuf message, known only by its descriptor, as nested values; maps are left out.

    Args:
        message: the message, or a value in one.
        above: names of the types that it stands in.
    """
    # Of the class: a field may bear any name.
    descriptor = getattr(type(message), "DESCRIPTOR", None)
    if descriptor is None:
        if isinstance(message, bytes):
            return list(message)
        return message if isinstance(message, str | bool | int | float) else None
    inside = above | {descriptor.full_name}
    found: dict[str, Value] = {}
    for field in descriptor.fields:
        value = getattr(message, field.name)
        if isinstance(value, str | bytes | bool | int | float):
            found[field.name] = _plain(value)
        elif hasattr(type(value), "DESCRIPTOR"):
            # What is not set is read as its defaults, which would never end in a type that holds itself.
            is_set = type(message).HasField(message, field.name)  # type: ignore[attr-defined]
            if is_set or field.message_type.full_name not in inside:
                found[field.name] = _plain(value, inside)
        elif not hasattr(value, "items"):
            found[field.name] = [_plain(each, inside) for each in value]
    return found


def _walk(value: Value, path: str, *, inside: bool) -> Iterator[tuple[str, Leaf | None, bool]]:
    if isinstance(value, dict):
        for key, below in value.items():
            name = _TIMES.get(key, key) if path.endswith(("stamp", "timestamp")) else key
            yield from _walk(below, f"{path}.{name}" if path else name, inside=inside)
    elif isinstance(value, list):
        yield from _walk_list(value, path)
    elif value is not None or path:
        yield path, value, inside


def _walk_list(values: list[Value], path: str) -> Iterator[tuple[str, Leaf | None, bool]]:
    if not values:
        yield path, None, True
    for value in values:
        name = f"{path}[]" if isinstance(value, dict) else path
        yield from _walk(value, name, inside=True)
