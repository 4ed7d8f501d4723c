"""Copying the payloads of wanted channels out of a chunk, rows of equal length together."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pipeline.core.arrays import Ints, group_rows
from pipeline.logs.messages import Messages
from pipeline.logs.records import Buffer

IN_PLACE: Final = 1 << 13
"""Payloads from this size on are not copied but decoded where they stand [bytes]."""


_COMMON: Final = 16
"""A length that fewer rows share is decoded together with other rare ones."""


@dataclass(slots=True, eq=False)
class Group:
    """Equally long payloads of one channel in one span.

    Attributes:
        count: how many.
        size: bytes of each.
        data: uint8; the payloads end to end, or the whole chunk when ``start`` is given.
        rows: their numbers among the span's messages of the channel, None when they are all of them.
        start: where each payload starts in ``data``, None when they stand end to end.
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
        log_time: [ns], int64, shape (n,), in the order of the file.
        publish_time: [ns], int64.
        groups: the payloads, by length.
    """

    log_time: Ints
    publish_time: Ints
    groups: list[Group]


@dataclass(slots=True, eq=False)
class Block:
    """Payloads in one buffer, ready to be decoded.

    Attributes:
        data: uint8, shape (m,).
        start: where each payload starts in ``data``, int64, shape (n,).
        size: bytes of each payload, int64, shape (n,).
        stride: distance of neighbouring payloads when they stand end to end and are equally long, else None.
    """

    data: NDArray[np.uint8]
    start: Ints
    size: Ints
    stride: int | None


def gather_payloads(chunk: Buffer, messages: Messages, numbers: Iterable[int]) -> dict[int, Payloads]:
    """Copy the payloads of some channels out of a chunk.

    Args:
        chunk: its inflated records.
        messages: where its messages stand.
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
    """Messages of one channel that came one by one; recorded when they were published [ns]."""
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
    """Join groups for decoding: equal lengths end to end, rare lengths into one mixed block.

    Args:
        groups: with the number that the span's first message has in the channel.

    Returns:
        Blocks with the numbers of their rows in the channel.
    """
    by_size: dict[int, list[tuple[int, Group]]] = {}
    found: list[tuple[Ints, Block]] = []
    for first, group in groups:
        if group.start is None:
            by_size.setdefault(group.size, []).append((first, group))
        else:
            size = np.full(group.count, group.size, dtype=np.int64)
            found.append((_numbers(first, group), Block(group.data, group.start, size, None)))
    rare: list[tuple[int, Group]] = []
    for same in by_size.values():
        if sum(group.count for _, group in same) < _COMMON:
            rare += same
        else:
            found.append(_join(same))
    if rare:
        found.append(_join(rare))
    return found


def _join(groups: list[tuple[int, Group]]) -> tuple[Ints, Block]:
    ids = np.concatenate([_numbers(first, group) for first, group in groups])
    data = np.concatenate([group.data for _, group in groups])
    each = [group.size for _, group in groups]
    size = np.repeat(each, [group.count for _, group in groups])
    start = np.cumsum(size) - size
    return ids, Block(data, start, size, each[0] if min(each) == max(each) and each[0] else None)


def _numbers(first: int, group: Group) -> Ints:
    return first + (np.arange(group.count) if group.rows is None else group.rows)
