"""Reading the spans of a file one after the other on several threads, and their common checksum."""

import zlib
from collections.abc import Callable, Iterator, Sequence
from collections.abc import Set as AbstractSet
from itertools import chain
from typing import Final, TypeVar

from pipeline.logs.source import ByteSource
from pipeline.logs.spans import FileCheck, Loaded, Span, load_span, load_together, no_file_checksum
from pipeline.logs.workers import map_in_order

Result = TypeVar("Result")

_TOGETHER: Final = 6 << 20
"""Inflated bytes of neighbouring chunks that are read together: every step in Python then serves more."""

_IN_FLIGHT: Final = 1 << 30
"""Inflated bytes that all threads together hold, unless a single chunk is larger."""

_CRC_BLOCK: Final = 1 << 20


def load_spans(
    source: ByteSource,
    spans: Sequence[Span],
    use: Callable[[Span, Loaded], Result],
    *,
    threads: int,
    wanted: AbstractSet[int] | None = None,
    file_holds: FileCheck = no_file_checksum,
) -> Iterator[Result]:
    """Read spans in order.

    Args:
        source: the file.
        spans: which stretches.
        use: what to make of each, called on the reading threads so that the chunk itself is soon forgotten;
            where only some channels are wanted, undamaged neighbours come as one, named by the first.
        threads: how many are read at once.
        wanted: numbers of the channels whose messages are needed, None for all.
        file_holds: asked when a chunk's checksum differs whether that of the whole file holds.

    Yields:
        What ``use`` returned.
    """

    def read(group: list[Span]) -> list[Result]:
        size = sum(span.inflated for span in group)
        together = load_together(source, group, size) if len(group) > 1 else None
        if together is not None:
            return [use(group[0], together)]
        return [use(span, load_span(source, span, file_holds, wanted)) for span in group]

    groups = _group_neighbours(spans) if wanted is not None else [[span] for span in spans]
    yield from chain.from_iterable(map_in_order(read, groups, threads, weigh=_weigh, limit=_IN_FLIGHT))


def _weigh(group: list[Span]) -> int:
    """Bytes that a group takes in memory."""
    return sum(max(span.inflated, span.length) for span in group)


def _group_neighbours(spans: Sequence[Span]) -> list[list[Span]]:
    """Chunks that stand one behind the other, a few megabytes together."""
    groups: list[list[Span]] = []
    size = 0
    for span in spans:
        told = _TOGETHER if span.told is None else span.inflated
        last = groups[-1][-1] if groups else None
        behind = last is not None and last.offset + last.length + last.index_length == span.offset
        size += told
        if behind and size <= _TOGETHER:
            groups[-1].append(span)
        else:
            groups.append([span])
            size = told
    return groups


def checksum_holds(source: ByteSource, end: int, crc: int) -> bool:
    """Whether the checksum of the data section, the first ``end`` bytes of a file, holds."""
    computed = 0
    for offset in range(0, end, _CRC_BLOCK):
        computed = zlib.crc32(source.read_at(offset, min(_CRC_BLOCK, end - offset)), computed)
    return computed == crc
