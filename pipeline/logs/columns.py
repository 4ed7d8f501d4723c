"""Columns of messages, their field paths, and payloads copied from chunks.

A field with one number per message is a plain array; a fixed-size array is ``(n, k)``. Sequences are
concatenated values with offsets. Strings are codes into the tuple of the distinct strings.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from typing import Final, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.core import Flags, Floats, Ints, group_rows
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

_LATEST_S: Final = 1 << 33
"""Largest magnitude of a valid stamp [s]: up to the year 2242, and as long before 1970."""

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


def select_leaves(leaves: Sequence[str], fields: Sequence[str] | None, *, where: str) -> set[str]:
    """Leaf fields required by the wanted paths.

    Args:
        leaves: every leaf field of the type.
        fields: wanted paths, None for all.
        where: topic named in errors.

    Raises:
        LogError: ``field_not_found``.
    """
    if fields is None:
        return set(leaves)
    chosen: set[str] = set()
    for wanted in fields:
        selected = _leaves_of(leaves, wanted)
        if not selected:
            hint = f"The type has: {', '.join(leaves)}"
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


IN_PLACE: Final = 1 << 13
"""Minimum size of payloads that are decoded in place instead of copied [bytes]."""


_COMMON: Final = 16
"""Minimum number of rows of one length; payloads of rarer lengths are decoded together."""


@dataclass(slots=True, eq=False)
class Group:
    """Payloads of equal length of one channel in one span.

    Attributes:
        count: number of payloads.
        size: size of each payload [bytes].
        data: uint8; the concatenated payloads, or the whole chunk if ``start`` is given.
        rows: their indices among the span's messages of the channel, None if they are all of them.
        start: start of each payload in ``data``, None if they are concatenated.
    """

    count: int
    size: int
    data: NDArray[np.uint8]
    rows: Ints | None = None
    start: Ints | None = None


@dataclass(slots=True, eq=False)
class Payloads:
    """The messages of one channel in one span.

    Attributes:
        log_time: [ns], int64, shape (n,), in file order.
        publish_time: [ns], int64.
        groups: payloads by length.
    """

    log_time: Ints
    publish_time: Ints
    groups: list[Group]


@dataclass(slots=True, eq=False)
class Block:
    """Payloads in one buffer, ready to be decoded.

    Attributes:
        data: uint8, shape (m,).
        start: start of each payload in ``data``, int64, shape (n,).
        size: size of each payload [bytes], int64, shape (n,).
        stride: distance of adjacent payloads if they are concatenated and of equal length, else None.
    """

    data: NDArray[np.uint8]
    start: Ints
    size: Ints
    stride: int | None


def gather_payloads(chunk: Buffer, messages: Messages, numbers: Iterable[int]) -> dict[int, Payloads]:
    """Copy the payloads of some channels from a chunk.

    Args:
        chunk: inflated records of the chunk.
        messages: positions of its messages.
        numbers: channel numbers.
    """
    data = np.frombuffer(chunk, dtype=np.uint8)
    order = np.argsort(messages.channel, kind="stable")
    channel, start, size = messages.channel[order], messages.start[order], messages.size[order]
    log, publish = messages.log_time[order], messages.publish_time[order]
    wanted = sorted(numbers)
    low = channel.searchsorted(wanted).tolist()
    high = channel.searchsorted(wanted, side="right").tolist()
    return {
        number: Payloads(log[a:b], publish[a:b], _group_by_size(data, start[a:b], size[a:b]))
        for number, a, b in zip(wanted, low, high, strict=True)
        if b > a
    }


def join_payloads(log_time: list[int], payloads: list[Buffer]) -> Payloads:
    """Join messages of one channel that were read one by one; their log and publish times [ns] are equal."""
    time = np.array(log_time, dtype=np.int64)
    size = np.array([len(payload) for payload in payloads], dtype=np.int64)
    data = np.frombuffer(b"".join(payloads) or bytes(1), dtype=np.uint8)
    return Payloads(time, time, _group_by_size(data, np.cumsum(size) - size, size))


def _group_by_size(data: NDArray[np.uint8], start: Ints, size: Ints) -> list[Group]:
    first = int(size[0])
    if size.min() == size.max():
        return [_gather(data, None, start, first)]
    return [_gather(data, rows, start[rows], int(size[rows[0]])) for rows in group_rows(size)]


def _gather(data: NDArray[np.uint8], rows: Ints | None, start: Ints, size: int) -> Group:
    if size >= IN_PLACE:
        return Group(start.size, size, data, rows, start)
    if size == 0:
        return Group(start.size, 0, data[:0], rows)
    window: NDArray[np.void] = np.ndarray((data.size - size + 1,), f"V{size}", data, strides=(1,))
    return Group(start.size, size, window[start].view(np.uint8), rows)


def join_groups(groups: list[tuple[int, Group]]) -> list[tuple[Ints, Block]]:
    """Join groups for decoding: one block per length, rare lengths in one mixed block.

    Args:
        groups: groups, each with the index of the span's first message in the channel.

    Returns:
        Blocks, each with the indices of its rows in the channel.
    """
    by_size: dict[int, list[tuple[int, Group]]] = {}
    joined: list[tuple[Ints, Block]] = []
    for first, group in groups:
        if group.start is None:
            by_size.setdefault(group.size, []).append((first, group))
        else:
            size = np.full(group.count, group.size, dtype=np.int64)
            joined.append((_numbers(first, group), Block(group.data, group.start, size, None)))
    rare: list[tuple[int, Group]] = []
    for same in by_size.values():
        if sum(group.count for _, group in same) < _COMMON:
            rare += same
        else:
            joined.append(_join(same))
    if rare:
        joined.append(_join(rare))
    return joined


def _join(groups: list[tuple[int, Group]]) -> tuple[Ints, Block]:
    ids = np.concatenate([_numbers(first, group) for first, group in groups])
    data = np.concatenate([group.data for _, group in groups])
    each = [group.size for _, group in groups]
    size = np.repeat(each, [group.count for _, group in groups])
    start = np.cumsum(size) - size
    return ids, Block(data, start, size, each[0] if min(each) == max(each) and each[0] else None)


def _numbers(first: int, group: Group) -> Ints:
    return first + (np.arange(group.count) if group.rows is None else group.rows)


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
