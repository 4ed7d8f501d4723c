"""extract -> velocity -> slip -> aggregate: pure functions from tables to tables.

Each stage also returns findings: what it noticed and mended, or could not mend. Nothing here reads or
writes a file.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import polars as pl

from pipeline.core.program import SlipError
from pipeline.core.tables import tabulate
from pipeline.logs import Loss

SURE = 5.0
"""Standard errors from which on a difference is told: of a thousand runs without one, normal noise shows
none."""


class StageError(SlipError):
    """A log or a table that holds too little for a stage."""


def blame_damage(losses: Sequence[Loss]) -> str:
    """What was lost of the log, for sentences about what is not there; empty where nothing was."""
    further = len(losses) - 1
    others = f"; {further} further loss{'es' * (further > 1)}" if further else ""
    return f" (the log is damaged: {losses[0].text}{others})" if losses else ""


Severity = Literal["info", "warning", "error"]


@dataclass(frozen=True)
class Finding:
    """One thing noticed.

    Attributes:
        id: stable identifier in snake_case.
        severity: info, warning, or error: results of this run are not to be trusted.
        text: one sentence.
        where: topic, column or channel; empty for the whole run.
        t_start: start of the stretch it concerns [s since the run's start].
        t_end: its end [s].
        value: the number behind it, in the unit that the text gives.
        count: how often.
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
    rows = [{"stage": stage, **vars(finding)} for finding in findings]
    return tabulate("findings", rows)
