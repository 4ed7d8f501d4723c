"""Encoders of the wheels: dead, backward, dying, or on another scale, each read anew as corrected."""

from pipeline.recording.case import Candidate, Case, is_crossed
from pipeline.recording.motion import Motion
from pipeline.recording.outages import leave_out
from pipeline.recording.readings import SIDES
from pipeline.recording.wheel_scales import settle_joints, settle_scales
from pipeline.sources import DriveSection
from pipeline.stages import Finding


def settle_wheels(case: Case, command: Candidate | None, wheels: Candidate | None, motion: Motion) -> bool:
    """Correct single encoders, the wheels read anew after each; whether signs of sides are judged."""
    if wheels is None:
        return _report_sides(case, motion, command, wheels)
    if not wheels.is_measured and case.configuration.wheels != DriveSection():
        case.read_again(wheels, motion)
    # An encoder that dies is on no other scale before.
    if leave_out(case, wheels, command, motion):
        wheels.reading.explained = None
        case.read_again(wheels, motion)
    if settle_joints(case, wheels, motion):
        case.read_again(wheels, motion)
    is_judged = _report_sides(case, motion, command, wheels)
    if "reversed" in case.changes.get("wheels", {}):
        # What is wrong beside a side that is corrected shows now.
        is_judged = not case.read_again(wheels, motion)
    if settle_scales(case, wheels, motion):
        case.read_again(wheels, motion)
    return is_judged


def _report_sides(case: Case, motion: Motion, command: Candidate | None, wheels: Candidate | None) -> bool:
    """A side that is dead or counts backward; whether one was found."""
    if wheels is not None and wheels.reading.form == "sides" and report_dead(case, wheels):
        return True
    of_wheels = wheels is not None and wheels.is_sure and is_crossed(wheels)
    of_command = command is not None and command.is_sure and is_crossed(command)
    if of_wheels and wheels is not None and wheels.reading.explained is not None and not of_command:
        # Of a heading that was turned the command tells which way is ahead.
        is_behind = bool(motion.offset_deg) and command is not None and command.sign("ahead") < 0
        is_right = (wheels.reading.explained.ahead.gains[0] > 0.0) != is_behind
        side = "right" if is_right else "left"
        margin = wheels.reading.explained.sign_margin
        case.correct(
            "wheels",
            f"the {side} wheels' encoder counts backward",
            f'reversed = "{side}"',
            {"reversed": side},
            margin,
        )
        return True
    if of_command and command is not None and command.reading.explained is not None:
        explained = command.reading.explained
        # A body command reaches the right side as speed plus turn.
        is_right = (
            (explained.ahead.gains[0] < 0.0)
            if command.reading.form == "body"
            else explained.ahead.gains[0] > 0
        )
        side = "right" if is_right else "left"
        also = (
            "and its encoder with it"
            if of_wheels
            else "and its encoder counts what it does"
            if wheels is not None
            else "as far as commands and poses tell"
        )
        text = (
            f"the {side} side of the drive runs backward against its command, {also}: the polarity of "
            "its motor is wrong; exchange its wires, or turn its sign in the driver"
        )
        case.findings.append(
            Finding("motor_reversed", "error", text, where="command", value=explained.sign_margin)
        )
        return True
    return False


def report_dead(case: Case, wheels: Candidate, without: str = "") -> bool:
    """A side whose encoder is dead; whether one is.

    Args:
        case: the log.
        wheels: their candidate, a speed a side.
        without: what is missed without it; by default the log is analyzed from commands.
    """
    dead = wheels.reading.dead_side
    if not dead:
        return False
    other = next(side for side in SIDES if side != dead)
    rest = without or f"take --input command, or correct [wheels] {dead}"
    text = f"the {dead} wheels' encoder reads the same throughout while the {other} wheels turn: "
    text += f"it is dead ({rest})"
    case.findings.append(Finding("wheel_dead", "error", text, where=f"wheels {dead}"))
    return True
