"""When a command acts: never before it is sent, and how late."""

from dataclasses import replace

import numpy as np

from pipeline.recording.case import Candidate, Case
from pipeline.recording.motion import Motion
from pipeline.recording.readings import DELAYS_S, Explained, Reading
from pipeline.recording.score import CLEAR, LEAST_NATS, compare
from pipeline.stages import Finding

_ERROR_S = 0.06
"""Error of a delay [s] beyond that of its fit: over the platforms and cases that are drawn without a delay it
is found from -.04 to .06 s, by values that are held and by a lag that stands for a part of it."""
_EARLIER_S = np.arange(-3.0, DELAYS_S[0], 0.05)
"""Delays [s] of commands that are stamped after nearly all that they do."""


def settle_delay(
    case: Case, command: Candidate | None, wheels: Candidate | None, motion: Motion | None
) -> None:
    """Correct the times of a command that acts before it is sent, and tell a dead time.

    Three readings are compared: it acts before its stamp, which no command does; at once, however slowly what
    it drives follows; or after a dead time, as that of a drive, or of stamps that are early. Of poses, which
    are late themselves, the first one alone says something.

    Args:
        case: the log, with what its wheels do of the command.
        command: the candidate for it.
        wheels: the candidate for them.
        motion: of the poses; None where wheels stand in for them.
    """
    if command is None or not command.is_sure or case.configuration.command.late_s is not None:
        return
    reading = command.reading
    if case.driven is not None and wheels is not None:
        followed, beside = "the wheels", [one.topic for one in wheels.source.signals]
        made = _compare(replace(reading, third=None, third_crossed=None), case.driven)
    elif motion is not None and reading.explained is not None and case.sources.pose is not None:
        followed, beside = "poses", [case.sources.pose.topic]
        made = _compare(reading, reading.explained)
    else:
        return
    if made is None or (made.delay > 0.0 and case.driven is None):
        return
    if made.delay > 0.0:
        text = (
            f"{followed} begin to follow {command.source} {made.delay:.2f} s after its stamps, then with a "
            f"lag of {made.lag:.2f} s: the drive answers so late, or the stamps are early; no other signal "
            f"tells which (late_s = {-made.delay:.2f} under [command] in run.toml takes them for early)"
        )
        case.findings.append(Finding("command_delay", "info", text, where="command", value=made.delay))
        return
    late = round(-made.delay, 2)
    topics = [*(one.topic for one in command.source.signals), *beside]
    clocks = {case.extraction.clocks[topic].clock for topic in topics if topic in case.extraction.clocks}
    by_body = reading.explained is not None and reading.explained.delay < -_ERROR_S
    if clocks == {"header"} and not by_body:
        # Times of recording are late by the way there; of two clocks either may be wrong.
        text = (
            f"{followed} follow {command.source} {late:.2f} s before it is sent, which nothing can: its "
            f"stamps are late, or those of {followed} early, and no other signal tells which (late_s = "
            f"{late:g} under [command] in run.toml corrects the first)"
        )
        case.findings.append(Finding("command_late", "warning", text, where="command", value=late))
        return
    what = f"the stamps of {command.source} are {late:.2f} s late, for {followed} follow it before it is sent"
    case.correct("command", what, f"late_s = {late:g}", {"late_s": late})
    case.driven = None if case.driven is None else replace(made, delay=made.delay + late)


def _compare(reading: Reading, made: Explained) -> Explained | None:
    """The fit with a delay; None where it is not clearly better than a lag alone.

    Args:
        reading: the command.
        made: its fit with the usual delays.
    """
    if made.delay <= DELAYS_S[0]:
        made = reading.fit_to(made.motion, _EARLIER_S, crossed=made.crossed)
    if abs(made.delay) <= _ERROR_S:
        return None
    at_once = reading.fit_to(made.motion, np.zeros(1), crossed=made.crossed)
    nats = float((made.blocks - at_once.blocks).sum()) / made.motion.moved.size
    return made if nats > LEAST_NATS and compare(made.blocks, at_once.blocks) > CLEAR else None
