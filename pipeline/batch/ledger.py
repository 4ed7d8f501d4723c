"""What became of each log the last time: one note a log, so that an unchanged log is not even opened.

The ledger decides nothing that the results do not confirm: a log counts as done only while the results hold
the generation that its note names. Losing a note costs a look at the log.
"""

import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace

import msgspec

from pipeline.store import JSON, LOG_NOTES, LogSighting, Mirror, Store, StoreError

STATES = ("done", "unchanged", "lossy", "failed", "quarantined")
"""What a log can come out as; each of them is counted."""

FATAL_KILLS = 2
"""A log that has killed this many workers is not tried again until it, or what is done with it, changes."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """What is known of a log.

    Attributes:
        log: what the file looked like when it was worked on.
        basis: hash of everything beside the log that its results depend on (`hash_basis`).
        state: ``done``, ``lossy``, ``failed``, ``quarantined``, or ``copy`` of another log's content.
        run: name of its run; empty when it has none.
        key: generation that was made.
        code: of the error.
        reason: of the failure, or what was lost; of a copy, the run it is a copy of.
        hint: what to do about it.
        kills: workers it has killed in this shape.
        has_report: whether the generation holds a report.
        seconds: time it took.
        peak_bytes: most memory its worker held.
        fetched_bytes: bytes fetched from an object store for it.
        at: when it was worked on [s since 1970].
    """

    log: LogSighting
    basis: str
    state: str
    run: str = ""
    key: str = ""
    code: str = ""
    reason: str = ""
    hint: str = ""
    kills: int = 0
    has_report: bool = False
    seconds: float = 0.0
    peak_bytes: int = 0
    fetched_bytes: int = 0
    at: float = field(default=0.0)

    def fits(self, log: LogSighting, basis: str) -> bool:
        """Whether neither the log nor what it is worked on with has changed."""
        return self.log.is_same_file(log) and self.basis == basis


class Ledger:
    """The entries of a results folder.

    Args:
        store: the results.
        mirror: where entries are published, if the results are on an object store.
    """

    def __init__(self, store: Store, mirror: Mirror | None = None) -> None:
        self._mirror = mirror
        self._notes = store.notes(LOG_NOTES)

    def read_all(self) -> Mapping[str, Entry]:
        """Every entry by the path of its log."""
        found: dict[str, Entry] = {}
        for content in self._notes.read_all():
            entry = _as_entry(content)
            if entry is not None:
                found[entry.log.path] = entry
        return found

    def read(self, path: str) -> Entry | None:
        """The entry of a log."""
        content = self._notes.read(path)
        return None if content is None else _as_entry(content)

    def write(self, entry: Entry) -> None:
        """Note what became of a log now."""
        stamped = replace(entry, at=round(time.time(), 3))
        content: dict[str, JSON] = msgspec.to_builtins(stamped)
        self._notes.write(entry.log.path, content)
        if self._mirror is not None:
            # A lost entry costs a look at the log.
            with suppress(StoreError):
                self._mirror.push_note(entry.log.path)


def _as_entry(content: Mapping[str, JSON]) -> Entry | None:
    try:
        return msgspec.convert(content, Entry)
    except msgspec.ValidationError:
        # An entry of another version: the log is looked at afresh.
        return None
