"""Reading the spans of a file one after the other on several threads, and judging them together."""

from __future__ import annotations

import zlib
from functools import cache
from itertools import chain
from typing import TYPE_CHECKING, Final, TypeVar

from pipeline.logs.spans import SpanKind, load_span, load_together
from pipeline.logs.workers import map_in_order

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from collections.abc import Set as AbstractSet

    from pipeline.logs.source import ByteSource
    from pipeline.logs.spans import Excuse, Loaded, Span

Result = TypeVar("Result")

_SEVERAL: Final = 3
"""When the checksums of so many chunks differ and none holds, the writer's are wrong, not the data."""

_TOGETHER: Final = 6 << 20
"""Inflated bytes of neighbouring chunks that are read together: every step in Python then serves more."""

_CRC_BLOCK: Final = 1 << 20


def load_spans(
    source: ByteSource,
    spans: Sequence[Span],
    use: Callable[[Span, Loaded], Result],
    *,
    threads: int,
    wanted: AbstractSet[int] | None = None,
    data_section: tuple[int, int] | None = None,
) -> Iterator[Result]:
    """Read spans in order.

    Args:
        source: the file.
        spans: which stretches.
        use: what to make of each, called on the reading threads so that the chunk itself is soon forgotten;
            where only some channels are wanted, undamaged neighbours come as one, named by the first.
        threads: how many are read at once.
        wanted: numbers of the channels whose messages are needed, None for all.
        data_section: where the data section ends and its checksum, None when it has none.

    Yields:
        What ``use`` returned.
    """

    @cache
    def whole_file() -> str | None:
        whole = data_section is not None and _checksum(source, data_section[0]) == data_section[1]
        return "the checksum of the whole file holds" if whole else None

    def read_with(excuse: Excuse) -> Callable[[list[Span]], list[tuple[bool, Result]]]:
        def read(group: list[Span]) -> list[tuple[bool, Result]]:
            told = sum(span.told.uncompressed_size for span in group if span.told is not None)
            together = load_together(source, group, told) if len(group) > 1 else None
            if together is not None:
                return [(False, use(group[0], together))]
            return [read_alone(span) for span in group]

        def read_alone(span: Span) -> tuple[bool, Result]:
            loaded = load_span(source, span, excuse, wanted)
            differs = any(loss.kind == "chunk_crc" for loss in loaded.losses)
            return differs, use(span, loaded)

        return read

    groups = _group_neighbours(spans) if wanted is not None else [[span] for span in spans]
    held: list[Result] = []
    only_differing = True
    for differs, result in chain.from_iterable(map_in_order(read_with(whole_file), groups, threads)):
        if only_differing and differs:
            held.append(result)
            continue
        only_differing = False
        yield from held
        held = []
        yield result
    if len(held) >= _SEVERAL and all(span.kind is SpanKind.CHUNK for span in spans):
        reason = f"the checksums of all {len(held)} chunks differ: the recorder wrote wrong ones"
        for _, result in chain.from_iterable(map_in_order(read_with(lambda: reason), groups, threads)):
            yield result
    else:
        yield from held


def _group_neighbours(spans: Sequence[Span]) -> list[list[Span]]:
    """Chunks that stand one behind the other, a few megabytes together."""
    groups: list[list[Span]] = []
    size = 0
    for span in spans:
        told = _TOGETHER if span.told is None else span.told.uncompressed_size
        last = groups[-1][-1] if groups else None
        behind = last is not None and last.offset + last.length + last.index_length == span.offset
        size += told
        if behind and size <= _TOGETHER:
            groups[-1].append(span)
        else:
            groups.append([span])
            size = told
    return groups


def _checksum(source: ByteSource, end: int) -> int:
    crc = 0
    for offset in range(0, end, _CRC_BLOCK):
        crc = zlib.crc32(source.read_at(offset, min(_CRC_BLOCK, end - offset)), crc)
    return crc
