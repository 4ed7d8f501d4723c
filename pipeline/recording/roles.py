"""Roles of signals: which of the candidates are the command and the wheels, and of which kind of vehicle."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.core import Floats, format_line
from pipeline.recording.case import NO_CANDIDATE, Candidate, Case
from pipeline.recording.drive import list_steered
from pipeline.recording.evidence import ONE_LINE, equal_motion, is_named_measured, rate_command
from pipeline.recording.findings import Finding
from pipeline.recording.motion import CLEAR, FEWEST_STEPS, NO_MOTION, Motion, compare, fit
from pipeline.recording.readings import SIDES, UNEXPLAINED, Bent, Explained, Held, Reading
from pipeline.recording.units import resolve_steering
from pipeline.run import LIVE_SHARE
from pipeline.sources import COMMANDED, CONFIGURED, DriveForm, DriveSource, Sources

_STILL = 0.1
"""Gain of the motion on the drive below which a body stands: on ice it is .13 to .26 of the wheels."""
_EXPLAINED = 0.9
"""Share of the motion that a signal in a strange unit explains, and vibration does not."""
_SMALLEST_M = 0.1
"""Radius of a wheel [m] that counts as small."""
_MOST = 20
"""Candidates of a role that are compared, the likeliest by type and name: each costs a fit."""
_BOTH_WAYS = 0.02
"""Share of a drive in one direction from which on it goes that way."""
_MARGIN = 4.0
"""Gain of another command over the one by type and name that decides [nats]."""


def read_drives(case: Case) -> Case:
    """The candidates for the command and for wheels that can be read, fitted to the motion.

    The likeliest of each by type and name come first. Of wheels that are the motion nothing explains more.
    """
    commands, wheels = (case.sources.rank_drives(role) for role in ("command", "wheels"))
    if not case.has_pose:
        stand_ins = {signal.topic for signal in case.wheels.source.signals}
        commands = [one for one in commands if not stand_ins & {signal.topic for signal in one.signals}]
        wheels = []
    drives, taken = list[Candidate](), set()
    for is_measured, sources in ((False, commands), (True, wheels)):
        for rank, source in enumerate(sources[:_MOST]):
            key = (source.form, source.signals)
            if key in taken:
                continue
            taken.add(key)
            reading = case.read(source, is_measured=is_measured)
            if not reading.form and is_measured and source == case.sources.wheels:
                reading = _read_by_motion(case, source)
            if not reading.form and source.form is DriveForm.JOINTS:
                # A tricycle has one wheel that drives, and no sides.
                reading = case.read(source, is_measured=is_measured, kind="ackermann")
            if reading.form:
                drive = Candidate(source, reading.fitted(case.motion), rank, is_measured)
                drives.append(_read_turn(case, resolve_steering(case, drive)))
    return _leave_out_sizes(case, drives)


def leave_out_of_ground(case: Case) -> Case:
    """Leave out velocities along the axes of a map: turned by the heading, they are of rolling wheels.

    Those without a number ahead say nothing of it, nor of a base that moves sideways.
    """
    if not case.moves_sideways or case.vehicle.kinematics.has_inputs("sideways"):
        return case
    of_role = (case.sources.rank_drives(role) for role in ("command", "wheels"))
    drives = {source.signals: source for sources in of_role for source in sources}
    for source in drives.values():
        reading = Reading()
        if source.form is DriveForm.BODY and source.reason != CONFIGURED:
            reading = case.read(source, is_measured=True)
        if why := _explain_of_ground(reading, case.motion):
            what = {"what": f"{source}: {why}"}
            case.findings.append(Finding("numbers_not_used", "info", source.signals[0].topic, what))
            case = case.leave_out(source)
    return replace(case, moves_sideways=case.given.may_move_sideways(case.sources))


def _explain_of_ground(reading: Reading, motion: Motion) -> str:
    """Why the velocities of a reading say nothing of a body that moves sideways; empty where they may."""
    ahead, aside, turning = reading.first, reading.third, reading.second
    if not aside.moves:
        return ""
    if not ahead.times.size:
        return "it has no number for the speed ahead"
    at = 0.5 * (motion.steps.start + motion.steps.end)
    known = np.searchsorted(ahead.times, at, side="right") > 0
    at, headings = at[known], [motion.middle[known]]
    velocity = np.interp(at, ahead.times, ahead.values) + 1j * np.interp(at, aside.times, aside.values)
    if turning.moves:
        # An odometry has a heading of its own.
        turned = np.cumsum(turning.values[:-1] * np.diff(turning.times))
        headings.append(np.interp(at, turning.times[1:], turned))
    power = max(float(np.sum(np.abs(velocity) ** 2)), 1e-12)
    turns = [1.0, *(np.exp(-1j * heading) for heading in headings)]
    lines = [abs(np.sum((velocity * turn) ** 2)) / power for turn in turns]
    if lines[0] < ONE_LINE < max(lines[1:]):
        return "its velocities are along the axes of a map, and not ahead and to the left of the body"
    return ""


def _read_by_motion(case: Case, source: DriveSource) -> Reading:
    """Joints whose names show no side, each put on the side on which it turns."""
    motion = case.motion
    columns = case.extraction.columns.get(source.signals[0].topic)
    if source.form is not DriveForm.JOINTS or columns is None or case.configuration.wheels.left is not None:
        return Reading()
    times, joints = case.extraction.read_rates(source)
    body = np.column_stack([motion.body.real, motion.yaw])
    sides: dict[str, list[str]] = {"left": [], "right": []}
    for name, rate in joints.items():
        signal = Held(times, rate)
        if not signal.moves:
            continue
        keep = signal.is_there(motion.steps)
        if keep.sum() < FEWEST_STEPS:
            continue
        steps = motion.steps.take(keep)
        made = fit(signal.integrate(steps, 0.0, 0.0), body[keep], steps)
        if min(abs(made.t)) > CLEAR:
            sides["left" if made.gains[0] * made.gains[1] < 0.0 else "right"].append(name)
    if not (sides["left"] and sides["right"]):
        return Reading()
    line = "; ".join(format_line(side, names) for side, names in sides.items())
    case.correct("wheels", "sides by motion", {"source": str(source), **sides}, line, dict(sides))
    section = case.complete().wheels
    return case.read(source, is_measured=True, section=section)


def _leave_out_sizes(case: Case, drives: Sequence[Candidate]) -> Case:
    """The candidates without wheel speeds that are sizes alone, as of sensors that know no direction."""
    asked = [one.reading.first.values for one in drives if one.reading.form == "body" and one.is_sure]
    back = max((min(_share_back(one), _share_back(-one)) for one in asked), default=0.0)
    signed = []
    for one in drives:
        sides = [] if one.reading.form != "sides" else one.reading.inputs
        if back < _BOTH_WAYS or not sides or any(side.values.min() < 0.0 for side in sides):
            signed.append(one)
            continue
        case.findings.append(Finding("wheels_unsigned", "warning", "wheels", {"wheels": str(one.source)}))
        case = case.leave_out(one.source)
    return replace(case, drives=tuple(signed))


def ask_roles(case: Case) -> Case:
    """Command and wheels: those by type and name, unless the motion says otherwise."""
    if _is_still(case):
        nothing = [replace(one, reading=replace(one.reading, explained=UNEXPLAINED)) for one in case.drives]
        case = replace(case, is_still=True, drives=tuple(nothing))
    drives = case.drives
    sure = [one for one in drives if one.is_sure and not one.reading.is_constant]
    earliest = min((one.reading.explained.lag + one.reading.explained.delay for one in sure), default=0.0)
    named = command = _find(drives, case.sources.command)
    # Plain numbers have their roles by name alone: the motion may follow both, and tell them apart. Where
    # it does not follow the command, the vehicle is driven by other means.
    is_followed = any(one is command for one in sure)
    rivals = [
        one for one in sure if not one.is_measured or (is_followed and one.source.form is DriveForm.SIDES)
    ]
    likely = _leave_out_others(rivals)
    if likely and command.source.reason != CONFIGURED:
        rates = {id(one): rate_command(one.reading, one.rank, earliest) for one in likely}
        best = max(likely, key=lambda one: rates[id(one)])
        if not command.is_there or rates[id(best)] > rates.get(id(command), -np.inf) + _MARGIN:
            if command.is_there:
                _report_command(case, best, command)
            command = best
    if command.is_there and _is_no_command(command):
        what = {"what": f"{command.source}: it measures the motion, which equals it at once"}
        case.findings.append(Finding("numbers_not_used", "info", command.source.signals[0].topic, what))
        case, command = replace(case, sources=replace(case.sources, command=None)), NO_CANDIDATE
    if not case.has_pose:
        # Wheels of which nothing is asked show nothing.
        return replace(case, command=command, motion=case.motion if command.is_there else NO_MOTION)
    wheels = _find_wheels(case, command)
    if wheels.is_there and wheels.is_of(command.source):
        # What is named as a command measures what the other asks for.
        is_sides = named is not command and named.reading.form == "sides"
        wheels = named if is_sides else NO_CANDIDATE
    elif not wheels.is_there and case.sources.wheels is None:
        # A pair of sides that is no command measures the wheels.
        is_free = not command.is_there
        spare = [one for one in rivals if one is not command and one.reading.form == "sides"]
        spare = [
            one
            for one in spare
            if is_free or one.source.form is DriveForm.SIDES or is_named_measured(one.reading.name)
        ]
        wheels = max(spare, key=lambda one: -one.rank, default=NO_CANDIDATE)
        if command.reading.form == "sides" and not is_named_measured(wheels.reading.name):
            wheels = NO_CANDIDATE
    return replace(case, command=command, wheels=wheels)


def _leave_out_others(rivals: Sequence[Candidate]) -> list[Candidate]:
    """The candidates for the command that the motion follows as another one, both ahead and in turning.

    Any command of a vehicle that drives ahead explains a part of that, by its mean.
    """
    followed = list(rivals)
    for index, axis in enumerate(("ahead", "turned")):
        shares = {id(one): one.reading.explained.shares[index] for one in rivals}
        shown = [
            shares[id(one)] for one in rivals if not one.is_measured and one.reading.explained.sign(axis)
        ]
        followed = [one for one in followed if shares[id(one)] >= _UNLIKE * max(shown, default=0.0)]
    return followed


_HELD = 0.5
"""Share of samples that repeat the one before, from which on a signal is held, as commands are."""


def _is_no_command(one: Candidate) -> bool:
    """Whether a candidate for a command states the motion as it is, and changes as it does."""
    is_named = one.source.reason == CONFIGURED or COMMANDED.search(str(one.source).lower())
    ahead, turned = equal_motion(one.reading)
    if one.is_measured or is_named or not (turned if one.sign("turned") else ahead):
        return False
    return float(np.mean([each.held_share for each in one.reading.inputs])) < _HELD


def _find_wheels(case: Case, command: Candidate) -> Candidate:
    """Wheels by type and name, or others that the motion follows where it does not follow these."""
    source, drives = case.sources.wheels, case.drives
    wheels = _find(drives, source)
    made = wheels.reading.explained
    # An encoder that dies is settled later: of that of the other side something is followed.
    is_open = not wheels.is_there or (
        made.is_known and max(abs(made.ahead.t[0]), abs(made.turned.t[0])) < CLEAR
    )
    if source is None or source.reason == CONFIGURED or not is_open:
        return wheels
    others = [one for one in drives if one.is_measured and one.is_sure and one not in (wheels, command)]
    if not others:
        return wheels
    values = {
        "kind": "not followed" if wheels.is_there else "sides not found",
        "wheels": str(source),
        "taken": str(others[0].source),
    }
    case.findings.append(Finding("wheels_left_out", "info", "wheels", values))
    return others[0]


def _is_still(case: Case) -> bool:
    """Whether the body hardly moves where the drive does: it is stuck, lifted, or another body."""
    named = (_find(case.drives, source) for source in (case.sources.command, case.sources.wheels))
    first = next((one for one in named if one.is_there), NO_CANDIDATE)
    made = first.reading.explained
    if not made.is_known or first.reading.form == "steering":
        return False
    scale = case.vehicle.wheel_radius_m if case.is_known and first.reading.form == "sides" else 1.0
    least = _STILL * scale if case.is_known or first.reading.form == "body" else _STILL * _SMALLEST_M
    fits = [made.ahead, made.turned, *([made.aside[0]] if made.aside is not None else [])]
    gains = max(abs(float(one.gains[0])) for one in fits)
    return gains < least and max(made.shares) < _EXPLAINED


_GOES = 0.3
"""Way of a body over that of its command from which on it moves: wheels that spin move it less."""
_UNLIKE = 0.5
"""Share of a motion, its half, that a command explains where it is followed: of another body .29 at most."""
_FAR_S = 2.0
"""Time [s] of a way: over it the noise of poses is small beside a motion."""
_FEWEST_BLOCKS = 12
"""Least number of blocks of the motion, a minute: in less a body that is driven may not show it."""


def ask_whose_pose(case: Case) -> Case:
    """Tell poses that move otherwise than all that is commanded or measured, as those of another body.

    Of a log of which a part is lost, it is not known whether they do so unless something is seen to drive
    them: it is told, too.
    """
    first, motion = _find(case.drives, case.sources.command), case.motion
    made = first.reading.explained
    if not (case.has_pose and first.is_there) or any(one.is_sure for one in case.drives):
        return case
    if case.extraction.data.losses and first.source.reason != CONFIGURED:
        values = {"kind": "log damaged", "pose": str(case.sources.pose), "command": str(first.source)}
        case.findings.append(Finding("not_driven", "error", "pose", values))
        return case
    if not made.is_known or first.reading.form != "body":
        return case
    asked = first.reading.columns(motion.steps, made.lag, made.delay, crossed=False)[0]
    positions = np.append(0.0, np.cumsum(motion.body * np.exp(1j * (np.cumsum(motion.yaw) - motion.yaw))))
    rows = np.append(np.flatnonzero(np.diff(motion.steps.start // _FAR_S, prepend=-1.0)), asked.size)
    moved, expected = (
        float(np.abs(np.diff(one[rows])).sum()) for one in (positions, np.append(0.0, np.cumsum(asked)))
    )
    is_unlike = max(made.shares) < _UNLIKE and made.blocks.size >= _FEWEST_BLOCKS
    if not is_unlike or moved < _GOES * expected:
        return case
    about: dict[str, object] = {
        "kind": "another body",
        "value": moved,
        "pose": str(case.sources.pose),
        "command": str(first.source),
    }
    case.findings.append(Finding("not_driven", "error", "pose", about))
    return case


def _find(drives: Sequence[Candidate], source: DriveSource | None) -> Candidate:
    return next((one for one in drives if one.is_of(source)), NO_CANDIDATE)


def _report_command(case: Case, chosen: Candidate, other: Candidate) -> None:
    values = {"command": str(chosen.source), "other": str(other.source)}
    case.findings.append(Finding("role_by_motion", "info", "command", values))


def ask_stamps(case: Case) -> Case:
    """Take the times of recording of a command that is stamped after it was recorded."""
    command = case.command
    if case.ahead is None or not command.is_of(case.ahead[0]):
        return case
    values = {"source": str(command.source), "ahead_s": case.ahead[1]}
    case.correct("command", "clock ahead", values, 'time = "log"', {"time": "log"})
    return case


def name_sources(case: Case) -> Sources:
    """The sources with their roles, without notes on a choice by name that no longer holds."""
    made = case.sources
    for role, drive in (("command", case.command), ("wheels", case.wheels)):
        before, source = getattr(made, role), drive.source
        if not drive.is_there or source == before:
            continue
        rest = [one for one in (before, *made.others.get(role, ())) if one is not None and one != source]
        notes = tuple(note for note in made.notes if not note.startswith(f"{role}:"))
        made = replace(made, others={**made.others, role: tuple(rest)}, notes=notes)
        made = replace(made, command=source) if role == "command" else replace(made, wheels=source)
    return made


def _share_back(speeds: Floats) -> float:
    """Share of the moving samples in which something goes backward."""
    top = float(np.quantile(np.abs(speeds), 0.95)) if speeds.size else 0.0
    moving = np.abs(speeds) > LIVE_SHARE * top
    return float(np.mean(speeds[moving] < 0.0)) if moving.any() else 0.0


# Kind of the vehicle that the signals show: a car, wheels with rollers, or joints that steer otherwise.

_LARGEST = 0.95
"""Quantile that is the largest of a motion: beyond it are poses that jumped."""


def ask_kind(case: Case) -> Case:
    """The kind of the vehicle that wheels and command show."""
    if not case.has_pose:
        # Wheels stand in for a pose as what they are.
        return replace(case, kind="ackermann" if case.wheels.reading.form == "steering" else "")
    case = _find_kind(case)
    if case.wheels.is_there and not case.kind:
        case = _leave_out_steered(case)
    is_steered = case.command.reading.form == "steering" and not case.kind
    return replace(case, kind="ackermann") if is_steered else case


def _find_kind(case: Case) -> Case:
    """A car, if joints of the wheels' topic steer and the body turns by them; else nothing."""
    wheels, given = case.wheels, case.configuration.vehicle.list_values().get("kind")
    kind = str(given or (case.vehicle.kind if case.is_known else "ackermann"))
    if case.moves_sideways:
        # Wheels of which each moves the body sideways as those with rollers do.
        is_mecanum = wheels.reading.form == "sides" and wheels.sign("aside")
        return replace(case, kind="" if case.is_known else "mecanum" if is_mecanum else "omni")
    if wheels.source.form is not DriveForm.JOINTS or kind != "ackermann":
        return case
    again = case.read_again(kind)
    return replace(again, kind=kind) if again is not case and again.wheels.sign("turned") else case


def _leave_out_steered(case: Case) -> Case:
    """Leave out wheels beside joints that steer, of a vehicle that is no car."""
    wheels, is_given = case.wheels, case.is_known or "kind" in case.configuration.vehicle.list_values()
    if is_given or wheels.source.form is not DriveForm.JOINTS:
        return case
    steered = list_steered(case.extraction.columns[wheels.source.signals[0].topic])
    if not steered:
        return case
    values = {"wheels": str(wheels.source), "joints": list(steered)}
    case.findings.append(Finding("wheels_steered", "warning", "wheels", values))
    return replace(case, sources=replace(case.sources, wheels=None), wheels=NO_CANDIDATE)


def _read_turn(case: Case, drive: Candidate) -> Candidate:
    """Read a body command as speed and steering angle where the body turns by these, as some cars do."""
    reading, made = drive.reading, drive.reading.explained
    first, second = reading.first, reading.second
    is_car = not case.is_known or case.vehicle.kind == "ackermann"
    is_given = case.configuration.command.yaw_rate_topic is not None or case.moves_sideways
    is_open = is_car and not is_given and not drive.is_measured and reading.form == "body"
    if not (is_open and made.is_known) or len(reading.inputs) < len(SIDES):
        return drive
    bent = Bent(first, second.times, second.values)
    steered = Reading("steering", reading.name, first, bent).fitted(case.motion)
    other = steered.explained
    if not other.sign("turned") or made.crossed:
        return drive
    rivals = [made, _limit_turn(reading, made).explain(case.motion)]
    if not all(_turns_better(other, one) for one in rivals if one.is_known):
        return drive
    return replace(
        drive, reading=steered, source=replace(drive.source, form=DriveForm.STEERING), is_angle=True
    )


def _limit_turn(reading: Reading, made: Explained) -> Reading:
    """Yaw rates of a body command as far as the steering reaches: beyond it they grow with the speed, too."""
    first, second = reading.first, reading.second
    ahead, turned = np.abs(made.motion.body.real), np.abs(made.motion.yaw)
    moved = ahead > LIVE_SHARE * float(np.quantile(ahead, _LARGEST))
    bend = float(np.quantile(turned[moved] / ahead[moved], _LARGEST)) / abs(float(made.turned.gains[0]))
    speed = np.interp(second.times, first.times, np.abs(first.values)) * abs(float(made.ahead.gains[0]))
    limited = Held(second.times, np.clip(second.values, -bend * speed, bend * speed))
    return Reading("body", reading.name, first, limited)


def _turns_better(one: Explained, other: Explained) -> bool:
    """Whether the turning is clearly likelier by the first."""
    gains = [each.turned.blocks - each.none[1] for each in (one, other)]
    return gains[0].size == gains[1].size and compare(gains[0], gains[1]) > CLEAR


def ask_angle(case: Case) -> Case:
    """A body command that holds steering angles; see `_read_turn`."""
    command = case.command
    if not command.is_angle:
        return case
    speed, turn = command.source.signals
    values = {
        "kind": "steering angles",
        "source": str(command.source),
        "speed": str(speed),
        "turn": str(turn),
    }
    case.findings.append(Finding("command_corrected", "warning", "command", values))
    return case
