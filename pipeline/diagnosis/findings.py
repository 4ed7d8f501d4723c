"""Findings of a diagnosis that are no effects: what it could not judge, or would rather not."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from pipeline.diagnosis.diagnosis import Json, RunDiagnosis
from pipeline.identification.parts import count_seconds

if TYPE_CHECKING:
    from pipeline.diagnosis.budget import Budget
    from pipeline.diagnosis.context import Context
    from pipeline.models import Effect

# Eight steps of six seconds, and fifteen: with fewer, a delay or a change of terrain stands for the truth.
_LEAST_DRIVING_S = {"measured": (48.0, "measured wheels"), "command": (90.0, "commands")}


def note_brevity(context: Context, common: RunDiagnosis) -> list[Mapping[str, Json]]:
    """A word where there was less driving than names can be trusted on."""
    least, words = _LEAST_DRIVING_S[common.input]
    driven = float(count_seconds(context.problem.whole).sum())
    if driven >= least:
        return []
    text = (
        f"{math.floor(driven)} s of driving can be compared: from {words} names are trusted from "
        f"{least:.0f} s on, with turns and speeds of both signs"
    )
    return [{"id": "little_driving", "text": text, "where": "diagnosis", "severity": "warning"}]


def note_cut(budget: Budget) -> list[Mapping[str, Json]]:
    """A word where the search was ended before it had come to its own end."""
    if not budget.was_cut:
        return []
    text = (
        f"the search was cut after {budget.seconds:g} s of CPU: this is the best answer so far, and other "
        f"explanations of it were not all tried (--budget {2.0 * budget.seconds:g}s lets it go on)"
    )
    return [{"id": "search_cut", "text": text, "where": "diagnosis", "severity": "warning"}]


def note_grounds(context: Context) -> list[Mapping[str, Json]]:
    """A word where runs on unlike ground were judged as one."""
    grounds = sorted({run.terrain for run in context.runs})
    if len(grounds) == 1:
        return []
    text = (
        f"these runs are on {', '.join(grounds)} and were judged as one: what differs between them may be "
        "named as a change within (slip compare --causes and slip fleet fit tell grounds apart)"
    )
    return [{"id": "unlike_grounds", "text": text, "where": "diagnosis", "severity": "warning"}]


def note_idle(effect: Effect) -> Mapping[str, Json]:
    """A word about an effect that does not serve to predict."""
    text = f"{effect.id} shows in half a second, but two seconds are predicted no better with it"
    return {"id": "idle_effect", "text": text, "where": effect.id, "severity": "info"}
