"""Kind of the vehicle that the signals show: a car, wheels with rollers, or joints that steer otherwise."""

from dataclasses import replace

import numpy as np

from pipeline.core import enumerate_texts
from pipeline.recording.case import Candidate, Case
from pipeline.recording.motion import Motion
from pipeline.recording.readings import SIDES, Bent, Explained, Held, Reading
from pipeline.recording.score import CLEAR, compare
from pipeline.run import LIVE_SHARE
from pipeline.sources import DriveForm
from pipeline.stages import Finding, list_steered

_MOST = 0.95
"""Quantile that is the largest of a motion: beyond it are poses that jumped."""


def find_kind(case: Case, wheels: Candidate | None, motion: Motion) -> str:
    """A car, if joints of the wheels' topic steer and the body turns by them; else nothing."""
    given = case.configuration.vehicle.list_values().get("kind")
    kind = str(given or (case.vehicle.kind if case.is_known else "ackermann"))
    if case.moves_sideways:
        # Wheels of which each moves the body sideways as those with rollers do.
        is_mecanum = wheels is not None and wheels.reading.form == "sides" and wheels.sign("aside")
        return "" if case.is_known else "mecanum" if is_mecanum else "omni"
    if wheels is None or wheels.source.form is not DriveForm.JOINTS or kind != "ackermann":
        return ""
    return "ackermann" if case.read_again(wheels, motion, kind) else ""


def leave_out_steered(case: Case, wheels: Candidate) -> bool:
    """Leave out wheels beside joints that steer, of a vehicle that is no car; whether there are any."""
    is_given = case.is_known or "kind" in case.configuration.vehicle.list_values()
    if is_given or wheels.source.form is not DriveForm.JOINTS:
        return False
    steered = list_steered(case.extraction.columns[wheels.source.signals[0].topic])
    if not steered:
        return False
    text = (
        f"not used: {wheels.source}: {enumerate_texts(steered)} steer, so this is not a differential "
        "drive, and it does not turn as a car that steers by the middle of them (several axles steer, or "
        "each wheel by itself); steering_joint and left and right under [wheels] and "
        '[vehicle] kind = "ackermann" in run.toml take it for a car'
    )
    case.findings.append(Finding("wheels_steered", "warning", text, where="wheels"))
    case.sources = replace(case.sources, wheels=None)
    return True


def settle_turn(case: Case, drive: Candidate, motion: Motion) -> None:
    """Read a body command as speed and steering angle where the body turns by these, as some cars do."""
    reading, made = drive.reading, drive.reading.explained
    first, second = reading.first, reading.second
    is_car = not case.is_known or case.vehicle.kind == "ackermann"
    is_given = case.configuration.command.yaw_rate_topic is not None or case.moves_sideways
    is_open = is_car and not is_given and not drive.is_measured and reading.form == "body"
    if not is_open or first is None or second is None or made is None or len(reading.inputs) < len(SIDES):
        return
    bent = Bent(first, second.times, second.values)
    steered = Reading("steering", reading.name, first, bent)
    other = steered.explain(motion)
    if other is None or not other.sign("turned") or made.crossed:
        return
    rivals = [made, _limit_turn(reading, made).explain(motion)]
    if all(_turns_better(other, one) for one in rivals if one is not None):
        drive.reading, drive.source = steered, replace(drive.source, form=DriveForm.STEERING)
        drive.is_angle = True


def _limit_turn(reading: Reading, made: Explained) -> Reading:
    """Yaw rates of a body command as far as the steering reaches: beyond it they grow with the speed, too."""
    first, second = reading.first, reading.second
    assert first is not None  # noqa: S101 - it has both
    assert second is not None  # noqa: S101 - it has both
    ahead, turned = np.abs(made.motion.body.real), np.abs(made.motion.yaw)
    moved = ahead > LIVE_SHARE * float(np.quantile(ahead, _MOST))
    bend = float(np.quantile(turned[moved] / ahead[moved], _MOST)) / abs(float(made.turned.gains[0]))
    speed = np.interp(second.times, first.times, np.abs(first.values)) * abs(float(made.ahead.gains[0]))
    limited = Held(second.times, np.clip(second.values, -bend * speed, bend * speed))
    return Reading("body", reading.name, first, limited)


def _turns_better(one: Explained, other: Explained) -> bool:
    """Whether the turning is clearly likelier by the first."""
    gains = [each.turned.blocks - each.none[1] for each in (one, other)]
    return gains[0].size == gains[1].size and compare(gains[0], gains[1]) > CLEAR


def report_turn(case: Case, command: Candidate | None) -> None:
    """A body command that holds steering angles; see `settle_turn`."""
    if command is None or not command.is_angle:
        return
    speed, turn = command.source.signals
    text = (
        f"{command.source} holds steering angles in place of yaw rates: the vehicle turns by the speed "
        f'times their tangent: read so, as speed_topic = "{speed}" and steering_topic = "{turn}" under '
        "[command] in run.toml do"
    )
    case.findings.append(Finding("command_corrected", "warning", text, where="command"))
