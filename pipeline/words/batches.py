"""When the last batch ended and how, and what it left unfinished."""

from collections.abc import Mapping
from datetime import UTC, datetime

from pipeline.core import format_count, name_state
from pipeline.store import LastBatch


def describe_batch(batch: LastBatch) -> str:
    """When the last batch began and how it ended, as what is said of it; empty where there was none."""
    if batch.began is None:
        return ""
    began = f"began on {_format_moment(batch.began)}"
    if batch.ended is None:
        return f"{began} and did not end: it is still running, or it was killed"
    how = "was stopped" if batch.stopped else "failed" if batch.failed else "ended"
    why = batch.failed or describe_unfinished(batch.unfinished)
    text = f"{began} and {how} on {_format_moment(batch.ended)}{f': {why}' if why else ''}"
    if not batch.is_idle or why:
        return text
    worked = "never" if batch.worked is None else _format_moment(batch.worked)
    return f"{text} (the last that worked on a log: {worked})"


def describe_unfinished(counts: Mapping[str, int]) -> str:
    """How many logs are in which state: ``1 log interrupted, 3 logs not started``; empty where none is."""
    return ", ".join(f"{format_count(n, 'log')} {name_state(state)}" for state, n in counts.items() if n)


def _format_moment(seconds: float) -> str:
    try:
        return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M UTC}"
    except (ValueError, OverflowError, OSError):
        return "an unknown date"
