"""Copying the payloads of wanted channels out of a chunk, rows of equal length together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from pipeline.logs.messages import Messages
    from pipeline.logs.records import Buffer

    Ints = NDArray[np.int64]

IN_PLACE: Final = 1 << 13
"""Payloads from this size on are not copied but decoded where they stand [bytes]."""


_COMMON: Final = 16
"""A length that fewer rows share is decoded together with other rare ones."""


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Payloads in one buffer.

    Attributes:
        rows: number of each payload within its ``Payloads``, int64, shape (n,).
        data: uint8, shape (m,).
        start: where each payload starts in ``data``, int64.
        size: bytes of each payload, int64.
        stride: distance of neighbouring payloads when they stand end to end and are equally long, else None.
    """

    rows: Ints
    data: NDArray[np.uint8]
    start: Ints
    size: Ints
    stride: int | None


@dataclass(frozen=True, slots=True, eq=False)
class Payloads:
    """The messages of one channel in one span.

    Attributes:
        log_time: [ns], int64, shape (n,), in the order of the file.
        publish_time: [ns], int64.
        blocks: the payloads, by length.
    """

    log_time: Ints
    publish_time: Ints
    blocks: list[Block]


def gather_payloads(chunk: Buffer, messages: Messages, numbers: Iterable[int]) -> dict[int, Payloads]:
    """Copy the payloads of some channels out of a chunk.

    Args:
        chunk: its inflated records.
        messages: where its messages stand.
        numbers: channel numbers.
    """
    data = np.frombuffer(chunk, dtype=np.uint8)
    found: dict[int, Payloads] = {}
    for number in numbers:
        rows = np.flatnonzero(messages.channel == number)
        if rows.size:
            blocks = _gather_blocks(data, messages.start[rows], messages.size[rows])
            found[number] = Payloads(messages.log_time[rows], messages.publish_time[rows], blocks)
    return found


def _gather_blocks(data: NDArray[np.uint8], start: Ints, size: Ints) -> list[Block]:
    first = int(size[0])
    if (size == first).all():
        everyone = np.arange(size.size)
        return [_gather_equal(data, everyone, start, first)]
    order = np.argsort(size, kind="stable")
    cuts = np.flatnonzero(np.diff(size[order])) + 1
    return [_gather_equal(data, rows, start[rows], int(size[rows[0]])) for rows in np.split(order, cuts)]


def _gather_equal(data: NDArray[np.uint8], rows: Ints, start: Ints, size: int) -> Block:
    sizes = np.full(rows.size, size, dtype=np.int64)
    if size >= IN_PLACE:
        return Block(rows, data, start, sizes, None)
    if size == 0:
        return Block(rows, np.empty(0, dtype=np.uint8), np.zeros(rows.size, dtype=np.int64), sizes, None)
    window: NDArray[np.void] = np.ndarray(
        (data.size - size + 1,), dtype=f"V{size}", buffer=data.data, strides=(1,)
    )
    copied = window[start].view(np.uint8)
    return Block(rows, copied, np.arange(rows.size) * size, sizes, size)


def join_blocks(blocks: list[tuple[Ints, Block]]) -> list[tuple[Ints, Block]]:
    """Join small blocks for decoding: equal lengths end to end, rare lengths into one mixed block.

    Args:
        blocks: with each block the numbers of its rows in the whole channel.
    """
    by_size: dict[int, list[tuple[Ints, Block]]] = {}
    apart: list[tuple[Ints, Block]] = []
    for ids, block in blocks:
        size = int(block.size[0])
        if block.stride is None:
            apart.append((ids, block))
        else:
            by_size.setdefault(size, []).append((ids, block))
    joined = [_join(same) for same in by_size.values()]
    rare = [each for each in joined if each[0].size < _COMMON]
    apart += [each for each in joined if each[0].size >= _COMMON]
    return [*apart, _join(rare)] if rare else apart


def _join(blocks: list[tuple[Ints, Block]]) -> tuple[Ints, Block]:
    ids = np.concatenate([each for each, _ in blocks])
    data = np.concatenate([block.data for _, block in blocks])
    size = np.concatenate([block.size for _, block in blocks])
    start = np.cumsum(size) - size
    stride = int(size[0]) if (size == size[0]).all() else None
    return ids, Block(np.arange(ids.size), data, start, size, stride)
