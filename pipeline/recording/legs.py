"""The motion that all else is compared with; joints that swing, as those of legs: they are no wheels."""

from dataclasses import replace

import numpy as np

from pipeline.core import Floats, SlipError
from pipeline.recording.case import NO_CANDIDATE, Candidate, Case
from pipeline.recording.drive import choose_sides
from pipeline.recording.findings import Finding
from pipeline.recording.geometry import roll_wheels
from pipeline.recording.motion import NO_MOTION, measure_motion
from pipeline.recording.readings import SIDES
from pipeline.sources import CONFIGURED, DriveForm, DriveSource

_MOST_RAD = np.pi
"""Range of a joint that swings: less than half a turn. The angle of a wheel, if it is wrapped, has a turn."""
_LEAST_RAD = 0.05
"""Range below which a joint stands."""
_LARGEST_M = 1.0
"""Radius [m] that no wheel of a robot exceeds: what carries the body farther for its angle is none."""
_SWINGS = 4.0
"""Path of a joint over its range from which on it goes back and forth, and does not stop after a part."""


def ask_motion(case: Case) -> Case:
    """The motion that all else is compared with: that of the poses, or else of the first wheels that turn."""
    if case.has_pose:
        return replace(case, motion=measure_motion(case.extraction.poses()))
    for number, source in enumerate(case.sources.rank_drives("wheels")):
        # Joints that steer are those of a car.
        for kind in ("ackermann", "differential") if source.form is DriveForm.JOINTS else ("differential",):
            reading = case.read(source, is_measured=True, kind=kind)
            if kind == "ackermann" and len(reading.inputs) < len(SIDES):
                continue
            motion = roll_wheels(reading)
            if motion.is_known:
                wheels = Candidate(source, reading, number, is_measured=True)
                return replace(
                    case, motion=motion, wheels=wheels, sources=replace(case.sources, wheels=source)
                )
    return case


def ask_legs(case: Case) -> Case:
    """Leave out topics all of whose joints swing while the body goes farther than any wheel would roll so."""
    sources = {
        source.signals: source
        for source in (*case.sources.rank_drives("wheels"), *case.sources.rank_drives("command"))
        if source.form is DriveForm.JOINTS and source.reason != CONFIGURED
    }
    swings = {key: source for key, source in sources.items() if _swing(case, source)}
    for source in swings.values():
        what = f"{source}: its joints swing and do not turn round, as those of legs: they are no wheels"
        case.findings.append(Finding("numbers_not_used", "warning", source.signals[0].topic, {"what": what}))
        case = case.leave_out(source)
    if not swings:
        return case
    case = replace(case, moves_sideways=case.given.may_move_sideways(case.sources))
    return case if case.has_pose else ask_motion(replace(case, wheels=NO_CANDIDATE, motion=NO_MOTION))


def _swing(case: Case, source: DriveSource) -> bool:
    """Whether all joints of a topic that would be wheels swing, and none of those that move turns round."""
    try:
        angles = case.extraction.read_angles(source)
    except SlipError:
        return False
    chosen = choose_sides(sorted(angles), case.configuration.wheels)
    ranges = []
    for name in (*chosen["left"], *chosen["right"]):
        angle = angles[name][np.isfinite(angles[name])]
        size = float(np.ptp(angle)) if angle.size else 0.0
        if size < _LEAST_RAD:
            continue
        if size > _MOST_RAD or float(np.abs(np.diff(angle)).sum()) < _SWINGS * size:
            return False
        ranges.append(size)
    return len(ranges) > 1 and _measure_extent(case) > _LARGEST_M * max(ranges)


def _measure_extent(case: Case) -> float:
    """How far the body goes in one direction of its own [m]: by its poses, or else as it is commanded."""
    if case.has_pose:
        body = case.motion.body
        extents = (np.cumsum(part) for part in (body.real, body.imag) if part.size)
        return max((float(np.ptp(extent)) for extent in extents), default=0.0)
    command = case.sources.command
    if command is None or command.form is not DriveForm.BODY:
        return 0.0
    speed = case.read(command, is_measured=False).first
    steps: Floats = speed.values[:-1] * np.diff(speed.times)
    return float(np.ptp(np.cumsum(steps[np.isfinite(steps)]))) if steps.size else 0.0
