"""Examination of a log: from the columns of its candidates to a `Recording`."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from pipeline.core import SlipError
from pipeline.recording.case import Case
from pipeline.recording.command_scale import measure_command
from pipeline.recording.delays import settle_delay
from pipeline.recording.encoders import settle_wheels
from pipeline.recording.evidence import equal_motion
from pipeline.recording.geometry import Geometry, explain_wheels, measure_lengths
from pipeline.recording.kinds import find_kind, leave_out_steered, report_turn
from pipeline.recording.motion import measure_motion
from pipeline.recording.mounting import report_mounting
from pipeline.recording.readings import Reading
from pipeline.recording.roles import (
    choose_roles,
    leave_out_of_ground,
    name_sources,
    read_drives,
    settle_stamps,
)
from pipeline.recording.score import CLEAR, FEWEST_STEPS
from pipeline.recording.signs import report_signs, turn_motion
from pipeline.recording.timeouts import settle_timeout
from pipeline.recording.units import find_units, settle_gyro, settle_lengths
from pipeline.run import Alignment
from pipeline.sources import Configuration, Sources
from pipeline.stages import Cut, Finding, Given


@dataclass(frozen=True)
class Evidence:
    """How the motion follows a signal.

    Attributes:
        name: its topics.
        role: ``command``, ``wheels``, ``gyro``, or empty if it is not used.
        reason: why it is not used, or nothing is known of it; else empty.
        margin: Vuong's statistic of the motion with it against the motion alone; None if too little of it is
            recorded.
        ahead, turned: motion over signal, in the signal's units; zero where it is not excited.
        late_s: delay of the motion [s].
    """

    name: str
    role: str
    reason: str = ""
    margin: float | None = None
    ahead: float = 0.0
    turned: float = 0.0
    late_s: float = 0.0


@dataclass(frozen=True)
class Recording:
    """What is in a log.

    Attributes:
        sources: topic of every role.
        configuration: the user's, completed by what the log shows.
        findings: what was decided, and why.
        kind: kind of vehicle that the signals show; empty if they show none.
        geometry: lengths by the signals.
        evidence: on every signal that was tried.
        alignment: corrections of the command; None where nothing shows them.
        cut: the poses, cut into segments; None where they were not read.
    """

    sources: Sources
    configuration: Configuration
    findings: tuple[Finding, ...] = ()
    kind: str = ""
    geometry: Geometry = field(default_factory=Geometry)
    evidence: tuple[Evidence, ...] = ()
    alignment: Alignment | None = None
    cut: Cut | None = None

    @property
    def is_followed(self) -> bool:
        """Whether the pose follows what drives the vehicle, as far as the log tells."""
        known = [one for one in self.evidence if one.margin is not None and one.role != "gyro"]
        return not known or self.margin > CLEAR

    @property
    def margin(self) -> float:
        """Vuong's statistic of the pose with what drives the vehicle against the pose alone; zero of none."""
        return max((one.margin or 0.0 for one in self.evidence if one.role != "gyro"), default=0.0)


def examine(given: Given) -> Recording:
    """Decide which reading of a log's signals makes its pose move as it does."""
    as_given = Recording(given.sources, given.configuration)
    if given.sources.pose is None:
        return as_given
    try:
        case = Case(given)
        motion = measure_motion(case.extraction.poses())
        if motion is None:
            return as_given
        motion, gyro = settle_gyro(case, motion)
    except SlipError:
        # The stage `extract` raises it again.
        return as_given
    leave_out_of_ground(case, given, motion)
    drives = read_drives(case, motion)
    gyros = [] if gyro is None else [gyro]
    readings = [*(drive.reading for drive in drives), *gyros]
    motion = turn_motion(case, motion, readings)
    command, wheels = choose_roles(case, drives)
    settle_stamps(case, command)
    settle_timeout(case, command, wheels, motion)
    report_turn(case, command)
    motion = settle_lengths(case, motion, readings, command, wheels)
    is_judged = settle_wheels(case, command, wheels, motion)
    kind = find_kind(case, wheels, motion)
    if wheels is not None and not kind and leave_out_steered(case, wheels):
        wheels = None
    if command is not None and command.reading.form == "steering":
        kind = kind or "ackermann"
    if not is_judged:
        report_signs(case, motion, command, wheels, gyro)
    if wheels is not None and case.changes.get("wheels", {}).keys() & {"sign", "exchanged"}:
        case.read_again(wheels, motion, (kind if kind == "ackermann" else "") or "differential")
    if command is not None and wheels is not None:
        case.driven = explain_wheels(command.reading, wheels.reading)
    find_units(case, command, wheels)
    settle_delay(case, command, wheels, motion)
    report_mounting(case, (wheels, command))
    alignment = measure_command(case, command, wheels, kind)
    used = (("command", command), ("wheels", wheels))
    roles = {id(one.reading): role for role, one in used if one is not None}
    roles |= {id(gyro): "gyro"} if gyro is not None else {}
    return Recording(
        name_sources(case, command, wheels),
        case.complete(),
        tuple(case.findings),
        kind,
        # Lengths that are known are not measured again.
        Geometry() if case.is_known or kind == "omni" else measure_lengths(case, command, wheels),
        tuple(describe(drive.reading, roles) for drive in drives)
        + tuple(describe(one, roles) for one in gyros),
        alignment,
        case.extraction.cut,
    )


def describe(reading: Reading, roles: Mapping[int, str]) -> Evidence:
    """How the motion follows a reading, with its role by identity."""
    made, role = reading.explained, roles.get(id(reading), "")
    if made is None:
        sizes = [one.values.size for one in (reading.first, reading.second) if one is not None]
        is_constant = not reading.inputs and max(sizes, default=0) >= FEWEST_STEPS
        why = "it is the same throughout" if is_constant else "too little of it is recorded beside the motion"
        return Evidence(reading.name, role, why)
    gains = (float(made.ahead.gains[0]), float(made.turned.gains[0]))
    reason = "" if role else "another is as likely" if made.is_sure else "the motion does not follow it"
    if not role and all(equal_motion(reading)):
        reason = "it measures the motion"
    return Evidence(
        reading.name,
        role,
        reason,
        made.moves,
        *gains,
        made.lag + made.delay,
    )
