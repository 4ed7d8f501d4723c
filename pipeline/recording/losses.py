"""Commands that the recorder lost, as over a radio link or by a topic of best effort.

Whether the base lost them, too, its motion tells: it obeyed what is between the commands around them, or the
last one that is recorded.
"""

from dataclasses import replace

import msgspec
import numpy as np

from pipeline.core import NORMAL_95, Floats
from pipeline.recording.case import Case
from pipeline.recording.findings import Finding
from pipeline.recording.lost_messages import number_gaps
from pipeline.recording.motion import compare
from pipeline.recording.readings import Reading

_LEAST = 0.05
"""Least share of the messages that is worth a word: by one in twenty a command at 10 Hz is 5 ms old."""
_REPEATS = 0.1
"""Least share of messages that repeat the one before of a sender that does not send at changes alone."""
_GROWTH = 1.5
"""The same: least ratio of a change after a loss to one without. Both are near 1 where changes are sent."""
_FEWEST_GAPS = 10
"""Least number of longer losses for their distribution: half of those expected is then 1.6 standard
deviations below."""


def ask_losses(case: Case) -> Case:
    """Tell which share of the commands is lost, and take those between the others that the base obeyed.

    Beforehand it is as likely that the base lost them as that it did not: the motion decides at 95 %.
    """
    command = case.command
    if len({signal.topic for signal in command.source.signals}) > 1:
        return case
    reading, section = command.reading, case.complete().command
    share, period = find_losses(reading)
    made = reading.explained
    if not share or not made.is_known:
        return case
    values: dict[str, object] = {
        "kind": "told",
        "value": share,
        "source": str(command.source),
        "period_s": period,
    }
    filled = Reading()
    if section.interpolate is None and section.hold_s is None:
        between = msgspec.structs.replace(section, interpolate=True)
        filled = case.read(command.source, is_measured=False, section=between).fitted(made.motion)
    gain = 0.0
    if filled.explained.blocks.size == made.blocks.size:
        gain = compare(filled.explained.blocks, made.blocks)
    if gain > NORMAL_95:
        case.changes.setdefault("command", {})["interpolate"] = True
        command = replace(command, reading=filled)
        values["kind"] = "interpolated"
    elif gain < -NORMAL_95:
        values["kind"] = "held"
    elif section.interpolate is None:
        values["kind"] = "undecided"
    case.findings.append(Finding("commands_lost", "warning", "command", values))
    return replace(case, command=command)


def find_losses(reading: Reading) -> tuple[float, float]:
    """Share of the messages that are lost at random, and their period [s]; zero where none are.

    The gaps are those of a clock. A loss is as likely after a loss as after a message, or likelier where a
    link fails for a while; a sender that misses every other turn of its clock, for it is slow, never misses
    many. One that sends at changes alone never repeats itself, and its changes after a pause are as those
    without.
    """
    inputs = [one for one in reading.inputs if one.times.size == reading.inputs[0].times.size]
    if not inputs:
        return 0.0, 0.0
    times = inputs[0].times
    number, period = number_gaps(times)
    counted = number[number > 0]
    lost, longer = counted > 1, counted[counted > 1] > 2  # noqa: PLR2004 - more than one message
    if longer.size < _FEWEST_GAPS or longer.mean() < 0.5 * lost.mean():
        return 0.0, 0.0
    share = 1.0 - counted.size / float(counted.sum())
    steps = _measure_steps([one.values for one in inputs])
    once, after = steps[number == 1], steps[number > 1]
    grows = float(after.mean()) > _GROWTH * float(once.mean())
    is_periodic = float(np.mean(once == 0.0)) > _REPEATS or grows
    return (share, period) if share > _LEAST and is_periodic else (0.0, 0.0)


def _measure_steps(values: list[Floats]) -> Floats:
    """Sizes of the changes between messages, over the usual sizes of what changes, shape (n - 1,)."""
    asked = np.column_stack(values)
    usual = np.maximum(np.sqrt(np.mean(asked**2, axis=0)), 1e-9)
    return np.asarray(np.linalg.norm(np.diff(asked, axis=0) / usual, axis=1))
