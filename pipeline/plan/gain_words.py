"""What a plan tells of each open question, in words."""

import math
from collections.abc import Iterator, Sequence

from pipeline.core import (
    enumerate_texts,
    format_count,
    format_digits,
    format_duration,
    name_first,
    suffix_unit,
)
from pipeline.models import name_number, name_term
from pipeline.plan.plan import ExpectedGain, Plan

Row = tuple[str, str, str]
"""A question, what the logs so far say of it, and what the drive adds."""


def list_gains(plan: Plan) -> list[Row]:
    """The open questions of a plan: those that the drive answers, in their order, then the others."""
    questions = [one for one in plan.informative if one.kind != "presence"]
    duration_s = plan.commands.duration_s
    rows = [_describe(one, duration_s) for one in questions]
    presences = [one for one in plan.informative if one.kind == "presence"]
    for is_within in (True, False):
        same = [one for one in presences if math.isfinite(one.decided_after_s) == is_within]
        if same:
            after = f"seen {_format_when(same, duration_s)}, if {'it acts' if len(same) == 1 else 'they act'}"
            rows.append((_join(same), "not seen", after))
    return [*rows, *_describe_unanswered(plan.unanswered)]


def summarize_gains(plan: Plan) -> str:
    """How many questions are open, and of how many the drive tells something."""
    answered = sum(math.isfinite(one.decided_after_s) for one in plan.informative)
    parts = [f"answers {answered} of them"] if answered else []
    if added := len(plan.informative) - answered:
        parts.append(f"adds to {added}")
    count = format_count(len(plan.gains), "question")
    return f"{count}; this drive {' and '.join(parts)}" if parts else count


def _describe(gain: ExpectedGain, duration_s: float) -> Row:
    if gain.kind != "interval":
        now = f"{name_term(gain.effects[0])} likelier" if gain.now > 0.0 else "undecided"
        return _name(gain), now, f"decided {_format_when([gain], duration_s)}"
    unit = suffix_unit(gain.unit)
    after = [f"±{format_digits(gain.expected)}{unit}"]
    if gain.drives:
        after.append(f"±{format_digits(gain.goal)} {_format_when([gain], duration_s)}")
    return _name(gain), f"{gain.value:.3g} ±{format_digits(gain.now)}{unit}", "; ".join(after)


def _describe_unanswered(gains: Sequence[ExpectedGain]) -> Iterator[Row]:
    """Questions that the drive leaves open, those that need the same together."""
    for needs in dict.fromkeys(one.needs for one in gains):
        yield _join([one for one in gains if one.needs == needs]), "not by this drive", needs


def _format_when(gains: Sequence[ExpectedGain], duration_s: float) -> str:
    """From when on all of these are answered."""
    if all(math.isfinite(one.decided_after_s) for one in gains):
        return f"after {format_duration(max(one.decided_after_s for one in gains))}"
    drives = max(one.drives for one in gains)
    return f"after {drives} such drives ({math.ceil(drives * duration_s / 60.0)} min)"


def _name(gain: ExpectedGain) -> str:
    if gain.kind == "interval":
        effect, _, parameter = gain.question.partition(" ")[0].rpartition(".")
        return name_number(effect, parameter)
    if gain.kind == "presence":
        return name_term(gain.effects[0])
    *first, last = [name_term(name) for name in gain.effects]
    return f"{enumerate_texts(first)} or {last}"


def _join(gains: Sequence[ExpectedGain]) -> str:
    # Several numbers of one effect are one name.
    names = [name_term(one.effects[0]) if one.kind == "interval" else _name(one) for one in gains]
    return name_first(dict.fromkeys(names))
