"""Decoding of channels to columns, from messages in CDR, ROS 1, JSON or protobuf."""

from __future__ import annotations

import itertools
import json
import math
import sys
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final, TypeAlias

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Schema

from pipeline.core import LONGEST_NAME, Flags, Ints
from pipeline.logs.cdr import DIALECTS, MAX_TEXT, OTHER_ENCAPSULATIONS, ROS1, Cursor, Dialect
from pipeline.logs.columns import (
    STAMPS,
    Block,
    Column,
    Payloads,
    Ragged,
    RaggedStrings,
    join_blocks,
    select_leaves,
)
from pipeline.logs.decode import Decoder, Piece, join_pieces, plan_fields, wanted_leaves
from pipeline.logs.index import ChannelInfo
from pipeline.logs.records import LogError, unsupported
from pipeline.logs.schema import (
    SchemaError,
    Structure,
    bundled_structure,
    contains_text,
    leaf_paths,
    parse_idl,
    parse_msg,
)

_ENOUGH: Final = 4 << 20
"""Size of the payloads that are collected before they are decoded together [bytes]."""

_ENCAPSULATION: Final = 4


@dataclass(frozen=True, slots=True)
class Rejected:
    """Messages that could not be decoded.

    Attributes:
        kind: ``undecodable`` or ``unsupported_encoding``.
        reason: cause.
        rows: their indices in the channel, int64.
        bytes: total size of their payloads [bytes].
    """

    kind: str
    reason: str
    rows: Ints
    bytes: int


class StructuredDecoder:
    """Decodes CDR and ROS 1 payloads of a type.

    Args:
        structure: the type.
        paths: wanted leaf fields.
        encoding: ``"cdr"`` or ``"ros1"``.
        exact: whether messages longer than the type are rejected, for a type that is not from the log.
    """

    def __init__(self, structure: Structure, paths: set[str], encoding: str, *, exact: bool = False) -> None:
        self._plan = plan_fields(structure, paths)
        self._ros1 = encoding == "ros1"
        self._decoder = Decoder(self._plan, exact)
        self._leaves = dict(wanted_leaves(self._plan))
        self._pieces: dict[str, list[Piece]] = {path: [] for path in self._leaves}
        self._ids: list[Ints] = []
        self.rejected: list[Rejected] = []

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on the decoded messages."""
        longer = self._decoder.longer
        return (f"{longer} messages hold more bytes than their type describes",) if longer else ()

    @property
    def shortened(self) -> dict[str, int]:
        """Number of strings that were too long and were cut, by field."""
        vocabularies = self._decoder.vocabularies
        return {path: words.shortened for path, words in vocabularies.items() if words.shortened}

    def decode(self, ids: Ints, block: Block) -> None:
        """Decode a block; ``ids`` are the indices of its rows in the channel."""
        if self._ros1:
            self._decode_alike(ids, block, ROS1, np.arange(ids.size))
            return
        short = block.size < _ENCAPSULATION
        if short.any():
            self._reject("undecodable", "shorter than an encapsulation header", ids, block, short)
        kinds = np.full(ids.size, -1, dtype=np.int64)
        whole = np.flatnonzero(~short)
        kinds[whole] = (
            block.data[block.start[whole]].astype(np.int64) << 8 | block.data[block.start[whole] + 1]
        )
        for kind in np.unique(kinds[whole]).tolist():
            chosen = kinds == kind
            if kind in DIALECTS:
                self._decode_alike(ids, block, DIALECTS[kind], np.flatnonzero(chosen))
            elif kind in OTHER_ENCAPSULATIONS:
                reason = f"the encapsulation {OTHER_ENCAPSULATIONS[kind]} is not supported"
                self._reject("unsupported_encoding", reason, ids, block, chosen)
            else:
                self._reject("undecodable", f"0x{kind:04x} is not an encapsulation", ids, block, chosen)

    def _decode_alike(self, ids: Ints, block: Block, dialect: Dialect, chosen: Ints) -> None:
        base, limit = block.start[chosen] + dialect.header, block.size[chosen] - dialect.header
        pieces, whole = self._decoder.decode(Cursor(block.data, base, limit, chosen, dialect))
        self._ids.append(ids[whole])
        for path, piece in pieces.items():
            self._pieces[path].append(piece)
        if whole.size < chosen.size:
            missing = np.ones(ids.size, dtype=np.bool_)
            missing[whole] = False
            missing &= np.isin(np.arange(ids.size), chosen)
            self._reject("undecodable", "the payload does not fit its type", ids, block, missing)

    def _reject(self, kind: str, reason: str, ids: Ints, block: Block, wrong: Flags) -> None:
        self.rejected.append(Rejected(kind, reason, ids[wrong], int(block.size[wrong].sum())))

    def columns(self, rows: Ints) -> dict[str, Column]:
        """Columns of the given rows, in their order; may be called once, because it frees the values."""
        ids = np.concatenate([np.empty(0, dtype=np.int64), *self._ids])
        row_of = np.empty(int(ids.max(initial=-1)) + 1, dtype=np.int64)
        row_of[ids] = np.arange(ids.size)
        order = row_of[rows]
        vocabularies = self._decoder.vocabularies
        return {
            path: join_pieces(leaf, self._pieces.pop(path), order, vocabularies.get(path))
            for path, leaf in self._leaves.items()
        }


@dataclass(slots=True)
class ChannelBuffer:
    """Collects the payloads of one channel and decodes them a few megabytes at a time.

    Attributes:
        decoder: decoder of the channel.
        count: number of messages so far.
    """

    decoder: StructuredDecoder | ObjectDecoder
    _log: list[Ints] = field(default_factory=list)
    _publish: list[Ints] = field(default_factory=list)
    _pending: list[Block] = field(default_factory=list)
    _pending_bytes: int = 0
    _decoded: int = 0
    count: int = 0

    def add(self, payloads: Payloads) -> None:
        """Add the messages of the next span."""
        self._log.append(payloads.log_time)
        self._publish.append(payloads.publish_time)
        self._pending.append(payloads.block)
        self._pending_bytes += payloads.block.data.size
        self.count += payloads.log_time.size
        if self._pending_bytes > _ENOUGH:
            self._flush()

    def _flush(self) -> None:
        if self._pending:
            self.decoder.decode(np.arange(self._decoded, self.count), join_blocks(self._pending))
        self._pending, self._pending_bytes, self._decoded = [], 0, self.count

    def times(self) -> tuple[Ints, Ints]:
        """Log and publish times [ns] of all messages, in file order."""
        empty = np.empty(0, dtype=np.int64)
        return np.concatenate([empty, *self._log]), np.concatenate([empty, *self._publish])

    def finish(self, repeated: Ints) -> tuple[Ints, Ints, Ints]:
        """Decode the rest; returns log and publish times [ns] and indices of all valid rows, by log time.

        Args:
            repeated: indices of messages to omit because they are copies of earlier ones.
        """
        self._flush()
        log, publish = self.times()
        good = np.ones(log.size, dtype=np.bool_)
        good[repeated] = False
        for rejected in self.decoder.rejected:
            good[rejected.rows] = False
        rows = np.flatnonzero(good)
        order = rows[np.argsort(log[rows], kind="stable")]
        return log[order], publish[order], order

    def times_of(self, rows: Ints) -> tuple[int | None, int | None]:
        """First and last log time [ns] of some rows."""
        if not rows.size:
            return None, None
        log = np.concatenate(self._log)[rows]
        return int(log.min()), int(log.max())


# Channels whose messages are decoded individually by other libraries: JSON and protobuf.
#
# Messages are converted to nested values, then to columns of their leaf fields.

Value: TypeAlias = "float | str | bool | list[Value] | dict[str, Value] | None"
Leaf: TypeAlias = "float | str | bool"
_LARGEST_INTEGER = 1 << 63
_MOST_CELLS, _CELLS_PER_VALUE = 1_000_000, 16
"""Maximum number of rows times fields of a topic: so many, and so many for each value in its messages. Memory
otherwise grows with the square of messages whose fields have ever new names."""
_TIMES = {"nanos": "nanosec", "seconds": "sec", "nsec": "nanosec", "secs": "sec", "nsecs": "nanosec"}


def _name_kind(value: Leaf | None) -> str:
    """Kind of a value; empty for null."""
    if value is None:
        return ""
    return "flag" if isinstance(value, bool) else "text" if isinstance(value, str) else "number"


@dataclass(slots=True)
class _Read:
    """What the messages have under one path: by row, the values, and whether they are a list or in one."""

    values: dict[int, list[Leaf | None]] = field(default_factory=dict)
    several: set[int] = field(default_factory=set)


class ObjectDecoder:
    """Decodes payloads one by one into nested values, of which the wanted fields are kept.

    Args:
        decode: decodes one payload; raises ``ValueError`` on failure.
        fields: wanted paths, None for all.
        optional: those of them that all messages may lack.
        where: topic named in errors.
    """

    def __init__(
        self,
        decode: Callable[[bytes], Value],
        fields: Sequence[str] | None,
        optional: Collection[str] = (),
        *,
        where: str,
    ) -> None:
        self._decode = decode
        self._fields = fields
        self._optional = optional
        self._where = where
        # None for what is not wanted: the name alone is known.
        self._read: dict[str, _Read | None] = {}
        self.rejected: list[Rejected] = []
        self.notes: tuple[str, ...] = ()
        self.shortened: dict[str, int] = {}

    def decode(self, ids: Ints, block: Block) -> None:
        """Decode a block; ``ids`` are the indices of its rows in the channel."""
        wrong: list[int] = []
        spans = zip(ids.tolist(), block.start.tolist(), block.size.tolist(), strict=True)
        for position, (row, start, size) in enumerate(spans):
            try:
                value = self._decode(block.data[start : start + size].tobytes())
                leaves = list(_walk(value, "", inside=False))
            except (ValueError, RecursionError):
                wrong.append(position)
                continue
            for path, values, several in leaves:
                if (read := self._find(path)) is not None:
                    bounded = [None if value is None else self._bound(path, value) for value in values]
                    read.values.setdefault(row, []).extend(bounded)
                    if several:
                        read.several.add(row)
        if wrong:
            lost = int(block.size[wrong].sum())
            self.rejected.append(Rejected("undecodable", "the payload cannot be parsed", ids[wrong], lost))

    def _bound(self, path: str, value: Leaf) -> Leaf:
        if isinstance(value, int) and abs(value) >= _LARGEST_INTEGER:
            largest = sys.float_info.max
            return float(value) if -largest <= value <= largest else math.inf * (1 if value > 0 else -1)
        if not isinstance(value, str):
            return value
        # JSON can contain a lone surrogate, which tables cannot store.
        value = value if value.isascii() else value.encode(errors="replace").decode()
        if len(value) <= MAX_TEXT:
            return value
        self.shortened[path] = self.shortened.get(path, 0) + 1
        return f"{value[:MAX_TEXT]} (cut, of {len(value)} characters)"

    def _find(self, path: str) -> _Read | None:
        """Where the values of a path are kept; None if it is not wanted."""
        if path not in self._read:
            is_wanted = path.startswith(STAMPS) or bool(
                select_leaves((path,), self._fields, self._fields or (), where=self._where)
            )
            self._read[path] = _Read() if is_wanted else None
        return self._read[path]

    def columns(self, rows: Ints) -> dict[str, Column]:
        """Columns of the given rows, in their order.

        Raises:
            LogError: ``field_not_found``, no message has a wanted field; ``too_many_fields``.
        """
        if not rows.size:
            return {}
        select_leaves(tuple(self._read), self._fields, self._optional, where=self._where)
        read = {path: one for path, one in self._read.items() if one is not None}
        most = _MOST_CELLS + _CELLS_PER_VALUE * sum(len(one.values) for one in read.values())
        if len(read) * rows.size > most:
            raise LogError(
                "too_many_fields",
                f"its {rows.size} messages have {len(read)} different fields, which no table can hold",
                where=self._where,
                hint="Leave the topic out",
            )
        return {path: self._column(one, rows.tolist()) for path, one in read.items()}

    def _column(self, read: _Read, rows: list[int]) -> Column:
        """Values of one path. What is of another kind than in most messages is missing, as null is."""
        there = [row for row in rows if row in read.values]
        several = 2 * sum(row in read.several for row in there) > len(there)
        lists = [read.values.get(row, []) if (row in read.several) == several else [] for row in rows]
        kinds = Counter(map(_name_kind, itertools.chain.from_iterable(lists)))
        del kinds[""]
        # Of equally many a number: all that is used of a message are numbers, but for names.
        kind = max(kinds, key=lambda name: (kinds[name], name == "number"), default="number")
        if kind == "text":
            texts = [[str(value) for value in values if value is not None] for values in lists]
            column = RaggedStrings.of_texts(texts)
            return column if several else column.at(0)
        if not several:
            lists = [values or [None] for values in lists]
        flat = [v if _name_kind(v) == kind else math.nan for values in lists for v in values]
        values = np.array(flat) if flat else np.empty(0)
        if not several:
            return values
        return Ragged(values, np.r_[0, np.cumsum([len(values) for values in lists], dtype=np.int64)])


def decode_json(payload: bytes) -> Value:
    """Value of a JSON text.

    Raises:
        ValueError: the text is not JSON.
    """
    value: Value = json.loads(payload)
    return value


def protobuf_decoder(schema: bytes, type_name: str, *, where: str) -> Callable[[bytes], Value]:
    """Decoder of protobuf messages, from ``mcap-protobuf-support``.

    Args:
        schema: serialized ``FileDescriptorSet``.
        type_name: full name of the message type.
        where: topic named in errors.

    Raises:
        LogError: ``unsupported_encoding``, the package is not installed or the schema is damaged.
    """
    try:
        from google.protobuf.message import (  # type: ignore[import-untyped]  # noqa: PLC0415 - an extra
            DecodeError,
        )
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
    """Convert a protobuf message to nested values by its descriptor; maps are omitted.

    Args:
        message: the message, or a value in one.
        above: names of the types that enclose it.
    """
    # From the class, because a field of the message may have the same name.
    descriptor = getattr(type(message), "DESCRIPTOR", None)
    if descriptor is None:
        if isinstance(message, bytes):
            return list(message)
        return message if isinstance(message, str | bool | int | float) else None
    inside = above | {descriptor.full_name}
    values: dict[str, Value] = {}
    for declared in descriptor.fields:
        value = getattr(message, declared.name)
        if (within := declared.containing_oneof) is not None and within.name == f"_{declared.name}":
            # What is declared as optional, and not set, is missing rather than zero.
            value = value if _is_set(message, declared.name) else None
        if isinstance(value, str | bytes | bool | int | float):
            values[declared.name] = _plain(value)
        elif hasattr(type(value), "DESCRIPTOR"):
            # Unset fields are read as their defaults, which would not terminate in a recursive type.
            is_set = _is_set(message, declared.name)
            if is_set or declared.message_type.full_name not in inside:
                values[declared.name] = _plain(value, inside)
        elif value is not None and not hasattr(value, "items"):
            values[declared.name] = [_plain(each, inside) for each in value]
    return values


def _is_set(message: object, name: str) -> bool:
    """Whether a field of a protobuf message is set."""
    return bool(type(message).HasField(message, name))  # type: ignore[attr-defined]


def _walk(value: Value, path: str, *, inside: bool) -> Iterator[tuple[str, list[Leaf | None], bool]]:
    """Paths of the leaves with their values, and whether these are in a list.

    Longer paths than any type has are left out: those of nested keys would take many times their bytes.
    """
    if len(path) > LONGEST_NAME:
        return
    if isinstance(value, dict):
        for key, below in value.items():
            name = _TIMES.get(key, key) if path.endswith(("stamp", "timestamp")) else key
            yield from _walk(below, f"{path}.{name}" if path else name, inside=inside)
    elif isinstance(value, list):
        yield from _walk_list(value, path)
    elif value is not None or path:
        yield path, [value], inside


def _walk_list(values: list[Value], path: str) -> Iterator[tuple[str, list[Leaf | None], bool]]:
    if not values:
        yield path, [], True
    for value in values:
        name = f"{path}[]" if isinstance(value, dict) else path
        yield from _walk(value, name, inside=True)


_EMPTY: Final = "the schema is empty"
_STAMP: Final = ("header.stamp.sec", "header.stamp.nanosec")


@dataclass(frozen=True, slots=True, eq=False)
class Recipe:
    """Decoder of one channel.

    Attributes:
        decoder: the decoder.
        leaves: all leaf fields of the type; empty if they are known only from the messages.
        notes: remarks for the user.
        is_bundled: whether the definition is not from the log.
    """

    decoder: StructuredDecoder | ObjectDecoder
    leaves: tuple[str, ...]
    notes: tuple[str, ...] = ()
    is_bundled: bool = False


def decoder_for(
    info: ChannelInfo,
    schema: bytes,
    fields: tuple[str, ...] | None,
    optional: Collection[str] = (),
    *,
    where: str,
) -> Recipe:
    """Choose the decoder of a channel.

    Args:
        info: the channel.
        schema: data of its schema.
        fields: wanted field paths, None for all.
        optional: those of them that the channel may lack.
        where: log named in errors.

    Raises:
        LogError: ``unsupported_encoding``, ``field_not_found``.
    """
    origin = f"{where}, topic {info.topic}"
    if info.message_encoding == "json":
        return Recipe(ObjectDecoder(decode_json, fields, optional, where=origin), ())
    if info.message_encoding == "protobuf":
        decode = protobuf_decoder(schema, info.type_name, where=origin)
        return Recipe(ObjectDecoder(decode, fields, optional, where=origin), ())
    structure, notes = _structure_of(info, schema, fields, origin)
    leaves = tuple(leaf_paths(structure))
    chosen = select_leaves(leaves, fields, optional, where=origin)
    chosen |= {path for path in _STAMP if path in leaves}
    is_bundled = bool(notes and structure.members)
    decoder = StructuredDecoder(structure, chosen, info.message_encoding, exact=is_bundled)
    return Recipe(decoder, leaves, notes, is_bundled)


def _structure_of(
    info: ChannelInfo, schema: bytes, fields: tuple[str, ...] | None, where: str
) -> tuple[Structure, tuple[str, ...]]:
    if info.message_encoding not in ("cdr", "ros1"):
        what = f"messages are encoded as {info.message_encoding!r}"
        raise unsupported(what, where, "Leave the topic out, or convert the log to cdr")
    structure, reason = _parse(info.type_name, info.schema_encoding, schema)
    if structure is None:
        structure = bundled_structure(info.type_name) if info.message_encoding == "cdr" else None
        if structure is None and reason == _EMPTY and not fields:
            return Structure(info.type_name, ()), (f"{_EMPTY}; of its messages only the times were read",)
        if structure is None:
            what = f"type {info.type_name or '(none)'}: {reason}, and none is bundled"
            raise unsupported(what, where, "Record it again with its definition, or leave the topic out")
        return structure, (f"{reason}; the bundled one of {info.type_name} was used",)
    if contains_text(structure, "wstring"):
        raise unsupported("the type holds wide strings, whose layout differs between vendors", where)
    return structure, ()


@lru_cache(maxsize=64)
def _parse(type_name: str, encoding: str, schema: bytes) -> tuple[Structure | None, str]:
    """Type defined by a schema, and an empty text; or None and the reason. Channels share schemas."""
    text = schema.decode("utf-8", "replace")
    if not text.strip():
        return None, _EMPTY
    try:
        if encoding == "ros2idl":
            return parse_idl(type_name, text), ""
        if encoding in ("ros2msg", "ros1msg"):
            return parse_msg(type_name, text, dialect=encoding), ""
    except SchemaError as error:
        return None, f"the definition cannot be read ({error})"
    return None, f"the schema encoding {encoding!r} is not known"
