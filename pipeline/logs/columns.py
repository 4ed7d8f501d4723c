"""Columns of messages, their field paths, and payloads copied from chunks.

A field with one number per message is a plain array; a fixed-size array is ``(n, k)``. Sequences are
concatenated values with offsets. Strings are codes into the tuple of the distinct strings.
"""

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from typing import Final, Self, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.core import Flags, Floats, Ints, name_first
from pipeline.logs.chunks import MESSAGE_OVERHEAD, Messages
from pipeline.logs.records import Buffer, LogError

Numbers: TypeAlias = NDArray[np.generic]
Offsets: TypeAlias = Ints

Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(frozen=True, slots=True, eq=False)
class Ragged:
    """One sequence per message.

    Attributes:
        values: values of all messages, concatenated, shape (m,) or (m, k).
        offsets: message i has ``values[offsets[i]:offsets[i + 1]]``; int64, shape (n + 1,).
    """

    values: Numbers
    offsets: Offsets

    def __len__(self) -> int:
        return self.offsets.size - 1

    def row(self, index: int) -> Numbers:
        """Values of one message."""
        return self.values[self.offsets[index] : self.offsets[index + 1]]

    def fixed(self) -> Numbers | None:
        """The values as (n, k, ...) if every message has equally many, else None."""
        return _fold_equal_rows(self.values, self.offsets)

    def at(self, position: int) -> Floats:
        """Value at index ``position`` of every message, NaN where a message is shorter; shape (n,)."""
        values = np.full(len(self), np.nan)
        there = np.diff(self.offsets) > position
        values[there] = self.values[self.offsets[:-1][there] + position]
        return values


@dataclass(frozen=True, slots=True, eq=False)
class Strings:
    """One string per message.

    Attributes:
        codes: index into ``values``, int32, shape (n,); -1 where the message has none.
        values: distinct strings.
    """

    codes: NDArray[np.int32]
    values: tuple[str, ...]

    def __len__(self) -> int:
        return self.codes.size

    def to_list(self) -> list[str]:
        """String of every message; empty if it has none."""
        return [self.values[code] if code >= 0 else "" for code in self.codes.tolist()]


@dataclass(frozen=True, slots=True, eq=False)
class RaggedStrings:
    """One sequence of strings per message.

    Attributes:
        codes: indices into ``values`` of all messages, concatenated, int32, shape (m,).
        values: the distinct strings.
        offsets: message i has ``codes[offsets[i]:offsets[i + 1]]``; int64, shape (n + 1,).
    """

    codes: NDArray[np.int32]
    values: tuple[str, ...]
    offsets: Offsets

    @classmethod
    def of_texts(cls, lists: Sequence[Sequence[str]]) -> Self:
        """The strings of every message as a column."""
        numbers: dict[str, int] = {}
        codes = [numbers.setdefault(text, len(numbers)) for texts in lists for text in texts]
        offsets = np.cumsum([0, *map(len, lists)], dtype=np.int64)
        return cls(np.array(codes, dtype=np.int32), tuple(numbers), offsets)

    def __len__(self) -> int:
        return self.offsets.size - 1

    def row(self, index: int) -> list[str]:
        """Strings of one message."""
        return [self.values[code] for code in self.codes[self.offsets[index] : self.offsets[index + 1]]]

    def fixed(self) -> NDArray[np.int32] | None:
        """The codes as (n, k) if every message has equally many, else None."""
        return _fold_equal_rows(self.codes, self.offsets)

    def at(self, position: int) -> Strings:
        """String at index ``position`` of every message, code -1 where a message is shorter."""
        codes = np.full(len(self), -1, dtype=np.int32)
        there = np.diff(self.offsets) > position
        codes[there] = self.codes[self.offsets[:-1][there] + position]
        return Strings(codes, self.values)


def _fold_equal_rows(values: NDArray[Scalar], offsets: Ints) -> NDArray[Scalar] | None:
    counts = np.diff(offsets)
    if counts.size == 0 or (counts != counts[0]).any():
        return None
    return values.reshape(counts.size, int(counts[0]), *values.shape[1:])


Column: TypeAlias = Numbers | Ragged | Strings | RaggedStrings


STAMPS: Final = ("header.stamp.", "timestamp.")
"""Paths of the stamps in messages: ROS headers, and the protobuf and JSON types of Foxglove."""

_LATEST_S: Final = 1 << 32
"""Largest magnitude of a valid stamp [s]: up to the year 2106, and as long before 1970."""

_INDEXED: Final = re.compile(r"^(?P<path>.*[^\]])\[(?P<number>\d+)\]$")


def join_times(seconds: NDArray[np.generic], nanoseconds: NDArray[np.generic]) -> tuple[Ints, Flags]:
    """Stamps [ns] from seconds and nanoseconds, 0 for what is no time, and whether each is one."""
    known: Flags = (np.abs(seconds) <= _LATEST_S) & (np.abs(nanoseconds) <= _LATEST_S)
    whole, rest = (np.where(known, one, 0).astype(np.int64) for one in (seconds, nanoseconds))
    return whole * 1_000_000_000 + rest, known


def complete_stamps(stamp: Ints, known: Flags, log_time: Ints) -> Ints | None:
    """Stamps [ns], with those that are no time placed by their log times; None if these are most.

    Args:
        stamp: as recorded, shape (n,).
        known: whether each is a time.
        log_time: of the messages [ns].
    """
    if known.all():
        return stamp
    if 2 * int(known.sum()) <= known.size:
        return None
    usual = round(float(np.median(stamp[known] - log_time[known])))
    return np.where(known, stamp, log_time + usual)


def select_leaves(
    leaves: Sequence[str], fields: Sequence[str] | None, optional: Collection[str] = (), *, where: str
) -> set[str]:
    """Leaf fields required by the wanted paths.

    Args:
        leaves: every leaf field of the type.
        fields: wanted paths, None for all.
        optional: those of them that may be absent.
        where: topic named in errors.

    Raises:
        LogError: ``field_not_found``.
    """
    if fields is None:
        return set(leaves)
    chosen: set[str] = set()
    for wanted in fields:
        selected = _leaves_of(leaves, wanted)
        if not selected and wanted not in optional:
            hint = f"The type has: {name_first(leaves)}"
            raise LogError("field_not_found", f"there is not a field {wanted}", where=where, hint=hint)
        chosen.update(selected)
    return chosen


def derive_columns(
    columns: Mapping[str, Column], fields: Sequence[str] | None, leaves: Sequence[str]
) -> dict[str, Column]:
    """Columns of the wanted paths, from those of the leaf fields.

    Args:
        columns: columns by leaf field.
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


@dataclass(slots=True, eq=False)
class Block:
    """Payloads in one buffer, ready to be decoded.

    Attributes:
        data: uint8, shape (m,).
        start: start of each payload in ``data``, int64, shape (n,).
        size: size of each payload [bytes], int64, shape (n,).
    """

    data: NDArray[np.uint8]
    start: Ints
    size: Ints


@dataclass(slots=True, eq=False)
class Payloads:
    """The messages of one channel in one span.

    Attributes:
        log_time: [ns], int64, shape (n,), in file order.
        publish_time: [ns], int64.
        block: their payloads.
    """

    log_time: Ints
    publish_time: Ints
    block: Block


def gather_payloads(chunk: Buffer, messages: Messages, numbers: Iterable[int]) -> dict[int, Payloads]:
    """Copy the payloads of some channels from a chunk.

    Args:
        chunk: inflated records of the chunk.
        messages: positions of its messages.
        numbers: channel numbers.
    """
    view, payloads = memoryview(chunk), {}
    for number in numbers:
        rows = np.flatnonzero(messages.channel == number)
        if rows.size:
            start, size = messages.start[rows], messages.size[rows]
            spans = zip(start.tolist(), (start + size).tolist(), strict=True)
            payloads[number] = join_payloads(
                messages.log_time[rows], messages.publish_time[rows], [view[low:high] for low, high in spans]
            )
    return payloads


def join_payloads(log_time: Ints, publish_time: Ints, payloads: Sequence[Buffer]) -> Payloads:
    """Copy messages of one channel, with their log and publish times [ns], into one block."""
    size = np.array([len(payload) for payload in payloads], dtype=np.int64)
    data = np.frombuffer(b"".join(payloads), dtype=np.uint8)
    return Payloads(log_time, publish_time, Block(data, np.cumsum(size) - size, size))


def join_blocks(blocks: Sequence[Block]) -> Block:
    """Blocks in order as one."""
    sizes = [block.data.size for block in blocks]
    starts = [block.start + first for block, first in zip(blocks, np.cumsum(sizes) - sizes, strict=True)]
    return Block(
        np.concatenate([block.data for block in blocks]),
        np.concatenate(starts),
        np.concatenate([block.size for block in blocks]),
    )


# Messages that occur more than once in a recording: duplicated chunks, ranges copied into the file.
#
# Two messages of one channel are equal if all bytes of their records are: number, times, content. If no two
# messages have equal times, as in nearly all recordings, nothing is read for this check.

Key = tuple[int, int, bytes]

_DIGEST: Final = 16

_MOST_ALIKE: Final = 1000
"""Maximum number of copies of a message: more messages with equal times indicate a stopped clock."""


def share_times(log_time: Ints, publish_time: Ints) -> Ints:
    """Indices of the messages with the same log and publish time [ns] as a few others, ascending."""
    if (log_time[1:] > log_time[:-1]).all():
        return np.empty(0, dtype=np.int64)
    order = np.lexsort((publish_time, log_time))
    log, publish = log_time[order], publish_time[order]
    begins = np.append(True, (log[1:] != log[:-1]) | (publish[1:] != publish[:-1]))
    alike = np.diff(np.append(np.flatnonzero(begins), log.size))
    chosen = np.repeat((alike > 1) & (alike <= _MOST_ALIKE), alike)
    return np.sort(order[chosen])


def digest_messages(chunk: Buffer, messages: Messages, times: Mapping[int, Ints]) -> dict[int, list[Key]]:
    """Log time, publish time and digest of the messages logged at certain times, in file order.

    Args:
        chunk: inflated records.
        messages: positions of its messages.
        times: log times to search for [ns] by channel number, ascending.
    """
    digests_of: dict[int, list[Key]] = {}
    view = memoryview(chunk)
    for number, wanted in times.items():
        chosen = np.flatnonzero(messages.channel == number)
        log = messages.log_time[chosen]
        chosen = chosen[wanted[np.minimum(np.searchsorted(wanted, log), wanted.size - 1)] == log]
        start = messages.start[chosen] - MESSAGE_OVERHEAD
        spans = zip(start.tolist(), (messages.start + messages.size)[chosen].tolist(), strict=True)
        digests = [blake2b(view[low:high], digest_size=_DIGEST).digest() for low, high in spans]
        log, publish = messages.log_time[chosen].tolist(), messages.publish_time[chosen].tolist()
        digests_of[number] = list(zip(log, publish, digests, strict=True))
    return digests_of


def find_repeated(keys: Iterable[Key]) -> list[int]:
    """Positions of the keys that occurred before."""
    seen: set[Key] = set()
    repeated = []
    for position, key in enumerate(keys):
        if key in seen:
            repeated.append(position)
        seen.add(key)
    return repeated
