"""Findings of the stages, and the error of a log with too little data for one."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import msgspec

from pipeline.core import SlipError
from pipeline.logs import OTHER_VERSION, OVER_BUDGET, Loss

SURE = 5.0
"""Significance threshold [standard errors] for reporting a difference: of a thousand runs without one, normal
noise exceeds it in none."""


class StageError(SlipError):
    """A log or a table with too little data for a stage."""


_WHOLE = {
    **dict.fromkeys(("too_large", OVER_BUDGET), "not all of the log is read"),
    "truncated": "the file ends early, or is still being written",
}
"""What is said of losses, by kind, where the data that are there are whole; of others the log is damaged."""


def blame_damage(losses: Sequence[Loss]) -> str:
    """Data lost from the log, for messages on missing data; empty without a loss."""
    further = len(losses) - 1
    others = f"; {further} further loss{'es' * (further > 1)}" if further else ""
    if not losses:
        return ""
    kinds = {one.kind for one in losses}
    why = _WHOLE.get(losses[0].kind, "") if len(kinds) == 1 else ""
    if losses[0].kind == OTHER_VERSION:
        return f" ({losses[0].text}{others})"
    return f" ({why or 'the log is damaged'}: {losses[0].text}{others})"


Severity = Literal["info", "warning", "error"]


class Finding(msgspec.Struct, frozen=True, omit_defaults=True):
    """What was noticed of a run, by a stage or by the diagnosis; `pipeline.words.findings` has its sentence.

    Attributes:
        id: stable identifier in snake_case.
        severity: info, warning, or error: results of this run are not reliable.
        where: topic, column or channel; empty for the whole run.
        values: numbers, texts and lists of the sentence by name, as JSON has them; ``value`` is the number
            behind the finding, ``count`` how often it occurs, ``kind`` which of several sentences it is.
        t_start: start of the stretch concerned [s since the run's start].
        t_end: its end [s].
    """

    id: str
    severity: Severity
    where: str = ""
    values: Mapping[str, Any] = {}
    t_start: float | None = None
    t_end: float | None = None

    @property
    def value(self) -> float | None:
        """The number behind it; None without one."""
        value = self.values.get("value")
        return float(value) if isinstance(value, int | float) else None

    @property
    def count(self) -> int | None:
        """How often it occurs; None where that is not counted."""
        count = self.values.get("count")
        return count if isinstance(count, int) else None
