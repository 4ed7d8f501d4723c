"""Findings of the stages, and the error of a log with too little data for one."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import polars as pl

from pipeline.core import SlipError
from pipeline.logs import OTHER_VERSION, OVER_BUDGET, Loss

SURE = 5.0
"""Significance threshold [standard errors] for reporting a difference: of a thousand runs without one, normal
noise exceeds it in none."""


class StageError(SlipError):
    """A log or a table with too little data for a stage."""


_BOUNDS = {"too_large", OVER_BUDGET}
"""Kinds of losses of data that are whole, and more than is read."""


def blame_damage(losses: Sequence[Loss]) -> str:
    """Data lost from the log, for messages on missing data; empty without a loss."""
    further = len(losses) - 1
    others = f"; {further} further loss{'es' * (further > 1)}" if further else ""
    if not losses:
        return ""
    why = "not all of the log is read" if losses[0].kind in _BOUNDS else "the log is damaged"
    if losses[0].kind == OTHER_VERSION:
        return f" ({losses[0].text}{others})"
    return f" ({why}: {losses[0].text}{others})"


Severity = Literal["info", "warning", "error"]


@dataclass(frozen=True)
class Finding:
    """One finding.

    Attributes:
        id: stable identifier in snake_case.
        severity: info, warning, or error: results of this run are not reliable.
        text: one sentence.
        where: topic, column or channel; empty for the whole run.
        t_start: start of the stretch concerned [s since the run's start].
        t_end: its end [s].
        value: the underlying number, in the unit stated in the text.
        count: number of occurrences.
    """

    id: str
    severity: Severity
    text: str
    where: str = ""
    t_start: float | None = None
    t_end: float | None = None
    value: float | None = None
    count: int | None = None


def tabulate_findings(stage: str, findings: Sequence[Finding]) -> pl.DataFrame:
    """Findings of one stage as a table (without the run's columns)."""
    from schemas import tabulate  # noqa: PLC0415 - `slip inspect` needs no contract

    rows = [{"stage": stage, **vars(finding)} for finding in findings]
    return tabulate("findings", rows)
