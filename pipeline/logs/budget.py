"""How far the chunks of a file may inflate in all, so that a small file cannot keep its reader busy."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from pipeline.logs.errors import Loss
from pipeline.logs.inflate import largest_plausible
from pipeline.logs.spans import SpanKind

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pipeline.logs.catalog import Catalog
    from pipeline.logs.spans import Span

OVER_BUDGET: Final = "max_inflated"
"""Kind of the loss of chunks that are beyond the limit."""

_LEAST: Final = 512 << 20
"""Bytes that any file may inflate to: some seconds of work, whatever they hold."""

_RATIO: Final = 200
"""Times its size that a file may inflate to. The drives of 703 recordings reach 9, images that hardly change
50; a file of nothing but empty maps may reach more."""

_MOST: Final = 1 << 40
"""Bytes that no file may inflate to: the largest recordings are some hundred gigabytes."""


def limit_inflated(size: int, most: int | None) -> int:
    """Bytes that a file of a size may inflate to: what the user allows, else what is plausible."""
    return min(_MOST, max(_LEAST, _RATIO * size)) if most is None else most


def keep_within(catalog: Catalog, size: int, most: int | None) -> None:
    """Leave out of a catalog the chunks that inflate to more than its file may, and say so.

    Nothing is inflated for it: a chunk that holds more than it says is refused when it is read.

    Args:
        catalog: of the file.
        size: bytes of the file.
        most: bytes that it may inflate to; None for what is plausible for its size.
    """
    allowed = limit_inflated(size, most)
    total = sum(_work(span.inflated, span.length) for span in catalog.spans)
    if total <= allowed:
        return
    kept: list[Span] = []
    left_out: list[Span] = []
    taken = 0
    for span in catalog.spans:
        work = _work(span.inflated, span.length)
        fits = span.kind is SpanKind.LOOSE or taken + work <= allowed
        taken += work if fits else 0
        (kept if fits else left_out).append(span)
    catalog.spans = kept
    text = (
        f"the chunks of the file inflate to {_spell(total)}, {total / size:.0f} times its size, and no more "
        f"than {_spell(allowed)} are read: {len(left_out)} of {len(left_out) + len(kept)} chunks were left "
        f"out; --max-inflated {-(-total // 10**6)}MB reads them"
    )
    catalog.losses.append(
        Loss(
            OVER_BUDGET,
            text,
            bytes=sum(span.length for span in left_out),
            chunks=len(left_out),
            start_ns=min(_list_known(span.start_ns for span in left_out), default=None),
            end_ns=max(_list_known(span.end_ns for span in left_out), default=None),
        )
    )


def _work(inflated: int, stored: int) -> int:
    """Bytes that inflating a chunk gives; none where its size is refused."""
    return inflated if inflated <= largest_plausible(stored) else 0


def _list_known(times: Iterable[int | None]) -> list[int]:
    return [time for time in times if time is not None]


def _spell(size: int) -> str:
    return f"{size / 1e6:,.1f} MB"
