"""The last batch over the results: when it began and ended, and what became of the logs it did not finish."""

from collections.abc import Mapping
from dataclasses import dataclass

from pipeline.core import LONGEST_TEXT, UNFINISHED, number_in, shorten
from pipeline.store.checksums import LOG_NOTES
from pipeline.store.results_folder import Store

LAST_BATCH = "batch/ended", "last"
"""Folder and name of its note: ``began`` and ``at``, its end [s since 1970]; ``stopped``; how many logs are
in each of `UNFINISHED`; ``failed``; and ``left_out``, the paths that it could not look at."""


@dataclass(frozen=True, kw_only=True)
class LastBatch:
    """The last batch.

    Attributes:
        began: when it began, whether or not it worked on a log [s since 1970]; None without one.
        ended: when it ended; None if it is still running or was killed.
        stopped: whether a signal ended it.
        unfinished: how many logs are in each of `UNFINISHED`.
        failed: why it failed before it came to the logs; empty if it did not.
        worked: when a batch last worked on a log; None if none has.
    """

    began: float | None
    ended: float | None
    stopped: bool
    unfinished: Mapping[str, int]
    failed: str
    worked: float | None

    @property
    def is_idle(self) -> bool:
        """Whether it worked on no log."""
        return self.began is not None and (self.worked or 0.0) < self.began


def read_last_batch(store: Store) -> LastBatch:
    """Read the last batch from its note and those on the logs."""
    folder, name = LAST_BATCH
    note = store.notes(folder).read(name) or {}
    times = (number_in(one, "at") or 0.0 for one in store.notes(LOG_NOTES).read_all())
    return LastBatch(
        began=number_in(note, "began"),
        ended=number_in(note, "at"),
        stopped=bool(note.get("stopped")),
        unfinished={state: round(number_in(note, state) or 0.0) for state in UNFINISHED},
        failed=shorten(" ".join(str(note.get("failed") or "").split()), LONGEST_TEXT),
        worked=max(times, default=0.0) or None,
    )
