"""The statement of a watch as others see it: the very rows that its terminal shows, kept beside the results.

`slip watch` writes it with every look, `slip serve` shows it. Nothing is worded or computed twice.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from pipeline.store import Store

if TYPE_CHECKING:
    from pipeline.store import JSON

_FOLDER = "live"
_SHOWN = 5
"""Watched recordings that a page shows, the newest first: the rest is history."""
_MOST_ROWS, _LONGEST = 200, 1000
"""Rows of a statement and characters of one that are shown: the results may be a stranger's."""


class LiveStatement(msgspec.Struct, kw_only=True):
    """What a watch said last.

    Attributes:
        log: the recording.
        rows: label and text of each row; a row without a label goes on with the one before.
        time: when it was said [s since 1970].
        ended: whether the watch has ended; the rows are then the diagnosis of the whole recording.
    """

    log: str
    rows: list[tuple[str, str]]
    time: float
    ended: bool = False


def write_statement(
    results: Path, log: Path, rows: Sequence[tuple[str, str]], *, ended: bool = False
) -> None:
    """Keep what a watch says now in the place of what it said before."""
    said = LiveStatement(log=str(log), rows=list(rows), time=time.time(), ended=ended)
    content: dict[str, JSON] = msgspec.to_builtins(said)
    Store(results).notes(_FOLDER).write(str(log.resolve()), content)


def read_statements(store: Store) -> list[LiveStatement]:
    """What watches of these results said last, the newest first; what no watch wrote is left out."""
    statements = []
    for note in store.notes(_FOLDER).read_all():
        try:
            said = msgspec.convert(note, LiveStatement)
        except msgspec.ValidationError:
            continue
        rows = [(label[:_LONGEST], text[:_LONGEST]) for label, text in said.rows[:_MOST_ROWS]]
        statements.append(msgspec.structs.replace(said, log=said.log[:_LONGEST], rows=rows))
    return sorted(statements, key=lambda said: -said.time)[:_SHOWN]
