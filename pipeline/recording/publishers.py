"""Two publishers that send on one topic by turns: commands, as of a joystick beside a planner, or poses.

Which command a drive obeys depends on when it reads, so that nothing is concluded from what they ask for.
Poses of two robots, or of two estimators of one, jump to and fro between two tracks, one of which is taken.
"""

from dataclasses import replace
from typing import Literal

import numpy as np

from pipeline.core import Floats
from pipeline.recording.case import NO_CANDIDATE, Case
from pipeline.recording.findings import Finding
from pipeline.recording.motion import measure_motion
from pipeline.recording.outages import write_spans
from pipeline.recording.readings import Reading
from pipeline.run import LIVE_SHARE
from pipeline.sources import OutageSection

_RETURNS = 0.1
"""Largest difference of two commands of one publisher, as a fraction of that to the other's between them."""
_RETURNS_S = 1.0
"""Time [s] within which both publishers send again: a slower one is a command like any other."""
_MOST_BETWEEN = 20
"""Largest number of messages of one publisher between two of the other."""
_FEWEST_TURNS = 8
"""Least number of turns in a row: nobody presses a key four times in as many seconds."""
_RETURNING = 0.8
"""Least share of turns that return: of values that are noise, one in five returns by chance."""
_JOINED_S = 10.0
"""Pause of the commands [s] in which the turns of two publishers do not show, and go on."""
_UNEVEN = 0.3
"""Least range of the intervals between messages [medians]: those of one publisher that switches are even."""
_UNLIKE = 0.5
"""Explained shares of one track's motion over those of the other, up to which it is another body's."""
_MOST = 0.5
"""Share of the driving from which on the turns are no exception, and the command is of no use."""


def ask_tracks(case: Case) -> Case:
    """Of poses that alternate between two tracks, those of the one that what drives the vehicle explains.

    One that the user names is obeyed, and told where the other is the vehicle's.
    """
    pose = case.sources.pose
    if pose is None or case.extraction.find_tracks() is None:
        return case
    drives = {"command": case.sources.command, "wheels": case.sources.wheels}
    readings = [case.read(one, is_measured=role == "wheels") for role, one in drives.items() if one]
    each = [case.extraction.take_pose(replace(pose, track=number)) for number in (1, 2)]
    shares = []
    for extraction in each:
        motion = measure_motion(extraction.poses())
        made = [(one.name, one.fitted(motion).explained) for one in readings]
        shares.append(max(((sum(of.shares), name) for name, of in made if of.is_sure), default=(0.0, "")))
    (less, _), (most, by) = sorted(shares)
    why = "both" if less > _UNLIKE * most else "told" if most else "neither"
    number = 1 + shares.index(max(shares))
    if pose.track:
        if why == "told" and number != pose.track:
            wrong = {"given": {"track": pose.track}, "instead": [f"track = {number}"]}
            case.findings.append(Finding("configured_wrongly", "error", "pose", wrong))
        return case
    values = {
        "kind": why,
        "frames": [*case.extraction.frames] if all(case.extraction.frames) else [],
        "source": str(pose),
        "by": by,
        "number": number,
    }
    if why == "told":
        case.findings.append(Finding("track_taken", "warning", "pose", values))
    else:
        case.findings.append(Finding("tracks_mixed", "error", "pose", values))
    sources = replace(case.sources, pose=replace(pose, track=number))
    return replace(case, extraction=each[number - 1], sources=sources)


def ask_publishers(case: Case) -> Case:
    """Leave out where two publishers command by turns, or the command if that is nearly all."""
    command, wheels = case.command, case.wheels
    if case.complete().command.ignore is not None:
        return case
    reading = command.reading
    times, asked = _read_commands(reading)
    spans = find_turns(times, asked)
    if not spans:
        return case
    live = np.linalg.norm(asked, axis=1) > 0.0
    inside = np.logical_or.reduce([(times >= start) & (times <= end) for start, end in spans])
    zeros = float(np.mean(~live[inside]))
    unit = case.make_unit(command.source, "differential")
    table = case.extraction.read_drive(command.source, case.complete().command, unit, held=True)
    clock = (table["log_time"].to_numpy() - case.extraction.data.index.start_ns) / 1e9
    ends = [np.interp(span, table["t"].to_numpy(), clock).tolist() for span in spans]
    values: dict[str, object] = {
        "kind": "told",
        "value": zeros,
        "count": len(spans),
        "source": str(command.source),
        "start_s": ends[0][0],
        "end_s": ends[0][1],
    }
    is_rest_used = bool(np.mean(inside[live]) < _MOST)
    is_replaced = not is_rest_used and wheels.is_sure
    if is_rest_used:
        ignore = [
            OutageSection(start_s=float(np.floor(1e2 * start) / 1e2), end_s=float(np.ceil(1e2 * end) / 1e2))
            for start, end in ends
        ]
        case.changes.setdefault("command", {})["ignore"] = ignore
        values |= {"kind": "left out", "line": f"ignore = {write_spans(ignore)}"}
    elif is_replaced:
        values["kind"] = "replaced"
    is_usable = is_rest_used or is_replaced
    name = "command_mixed" if is_usable else "commands_mixed"
    severity: Literal["warning", "error"] = "warning" if is_usable else "error"
    case.findings.append(Finding(name, severity, "command", values))
    if is_replaced:
        return replace(case.leave_out(command.source), command=NO_CANDIDATE)
    read = case.read(command.source, is_measured=False, section=case.complete().command)
    if not (is_rest_used and read.form and reading.explained.is_known):
        return case
    return replace(case, command=replace(command, reading=read.fitted(reading.explained.motion)))


def _read_commands(reading: Reading) -> tuple[Floats, Floats]:
    """Times [s] of the commands, shape (n,), and their values over their usual sizes, shape (n, k)."""
    times = reading.inputs[0].times if reading.inputs else np.zeros(0)
    inputs = [one.values for one in reading.inputs if one.times.size == times.size]
    values = np.column_stack(inputs) if inputs else np.zeros((0, 1))
    return times, values / np.maximum(np.sqrt(np.mean(values**2, axis=0)), 1e-9) if times.size else values


def find_turns(times: Floats, asked: Floats) -> list[tuple[float, float]]:
    """Stretches in which two publishers send commands by turns, with their ends [s].

    Every message of one that follows the other's repeats what it asked for before.

    Args:
        times: of the messages [s], increasing, shape (n,).
        asked: commands over their usual sizes, shape (n, k).
    """
    if times.size <= _FEWEST_TURNS:
        return []
    size = np.linalg.norm(asked, axis=1)
    steps = np.append(0.0, np.linalg.norm(np.diff(asked, axis=0), axis=1))
    turns = steps > LIVE_SHARE * float(np.quantile(size, 0.95))
    returns = np.zeros(times.size, dtype=bool)
    for back in range(2, _MOST_BETWEEN + 2):
        is_near = times[back:] - times[:-back] < _RETURNS_S
        is_same = np.linalg.norm(asked[back:] - asked[:-back], axis=1) < _RETURNS * steps[back:]
        returns[back:] |= is_near & is_same
    rows = np.flatnonzero(turns)
    # The first message of each of them returns to nothing.
    parts = np.split(rows, 1 + np.flatnonzero(np.diff(times[rows]) > _RETURNS_S))
    mixed = [
        (int(part[0]), int(part[-1]))
        for part in parts
        if part.size >= _FEWEST_TURNS and returns[part].mean() > _RETURNING
    ]
    spans: list[tuple[int, int]] = []
    for first, last in mixed:
        if spans and times[first] - times[spans[-1][1]] < _JOINED_S:
            spans[-1] = (spans[-1][0], last)
        else:
            spans.append((first, last))
    return [(float(times[a]), float(times[b])) for a, b in spans if _is_uneven(times[a : b + 1])]


def _is_uneven(times: Floats) -> bool:
    """Whether the intervals between messages are those of two publishers."""
    low, middle, high = np.quantile(np.diff(times), (0.1, 0.5, 0.9))
    return bool(high - low > _UNEVEN * middle)
