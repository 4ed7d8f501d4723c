"""Dates of runs: by the name, by the clock of the log, and where the two contradict each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime

from pipeline.fleet import read_day

_EARLIEST_YEAR = 2000
"""Year before which a clock was not set: unset ones count from 1970 or 1980, no log is so old."""
_TIME_ZONE_DAYS = 1
"""Largest difference of a local date from that in UTC [days]: time zones end at 14 h; a second day would be
another date, and zero would refuse drives in the evening."""


@dataclass(frozen=True)
class RunDates:
    """Dates of runs.

    Attributes:
        days: date of each run, for example `2024-08-07`; None where it is not known.
        notes: contradictions between names and clocks, and runs whose order their clocks do not tell.
    """

    days: Mapping[str, str | None]
    notes: tuple[str, ...]


def date_runs(starts: Mapping[str, int | None]) -> RunDates:
    """Date every run: by its name where that holds a date, else by the clock of its log.

    A start that a date in a name contradicts is a placeholder, as converters write it: other runs with the
    very same start have no date.

    Args:
        starts: timestamp of the first sample of each run [ns]; None where it is not known.
    """
    named = {run: read_day(run) for run in starts}
    clocks = {run: _read_clock(start) for run, start in starts.items()}
    refused = {starts[run] for run, clock in clocks.items() if _contradicts(named[run], clock)}
    days = {run: named[run] or (None if starts[run] in refused else clocks[run]) for run in starts}
    shared: dict[tuple[int | None, str | None], list[str]] = {}
    for run, start in starts.items():
        if clocks[run] is not None:
            shared.setdefault((start, None if start in refused else days[run]), []).append(run)
    alone = [f"{runs[0]} ({clocks[runs[0]]})" for (start, _), runs in shared.items()
             if start in refused and len(runs) == 1]  # fmt: skip
    notes = [
        _note_refused(runs, clocks[runs[0]], named) if start in refused else _note_order(runs, start)
        for (start, _), runs in shared.items()
        if len(runs) > 1
    ]
    if alone:
        notes.append(f"the date in the name counts, and not that of the clock, of {', '.join(alone)}")
    return RunDates(days, tuple(notes))


def _note_refused(runs: Sequence[str], clock: str | None, named: Mapping[str, str | None]) -> str:
    """Note on runs with one start that a date in a name contradicts."""
    dated = sum(named[run] is not None for run in runs)
    others = "; the others have no date" if dated < len(runs) else ""
    return (
        f"the clocks of {len(runs)} runs start at the very same instant of {clock}, which names contradict: "
        f"the dates in the names of {dated} count{others}"
    )


def _note_order(runs: Sequence[str], start: int | None) -> str:
    """Note on runs of one date and start."""
    instant = datetime.fromtimestamp((start or 0) // 10**9, UTC)
    return (
        f"{len(runs)} runs start at the very same instant, {instant:%Y-%m-%d %H:%M:%S} UTC, and are in the "
        f"order of their names: {', '.join(sorted(runs))}"
    )


def _contradicts(named: str | None, clock: str | None) -> bool:
    """Whether two dates differ by more than time zones do."""
    if named is None or clock is None:
        return False
    return abs((date.fromisoformat(named) - date.fromisoformat(clock)).days) > _TIME_ZONE_DAYS


def _read_clock(start: int | None) -> str | None:
    """Date of a timestamp (UTC); None if the clock was not set."""
    if start is None:
        return None
    try:
        day = datetime.fromtimestamp(start / 1e9, UTC)
    except (OverflowError, OSError, ValueError):
        return None
    return day.strftime("%Y-%m-%d") if day.year >= _EARLIEST_YEAR else None
