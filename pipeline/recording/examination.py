"""Examination of a log: from the columns of its candidates to a `Recording`, with poses and without."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.core import SlipError
from pipeline.recording.case import Candidate, Case, is_crossed
from pipeline.recording.command_scale import measure_command
from pipeline.recording.encoders import report_dead, resolve_wheels
from pipeline.recording.evidence import equal_motion
from pipeline.recording.geometry import (
    Geometry,
    explain_wheels,
    list_errors,
    measure_lengths,
    roll_wheels,
    take_clear,
)
from pipeline.recording.losses import resolve_losses
from pipeline.recording.motion import CLEAR, FEWEST_STEPS, Motion, measure_motion
from pipeline.recording.outages import leave_out
from pipeline.recording.publishers import resolve_publishers
from pipeline.recording.readings import Reading
from pipeline.recording.roles import (
    choose_roles,
    find_kind,
    leave_out_of_ground,
    leave_out_steered,
    name_sources,
    read_drives,
    report_stranger,
    report_turn,
    resolve_stamps,
)
from pipeline.recording.signs import (
    report_axes,
    report_mounting,
    report_signs,
    report_speed_alone,
    turn_motion,
)
from pipeline.recording.timeouts import resolve_delay, resolve_timeout
from pipeline.recording.units import correct_wheel_unit, find_units, resolve_gyro, resolve_lengths
from pipeline.run import GROUND_UNOBSERVABLE, Alignment
from pipeline.sources import (
    Configuration,
    DriveForm,
    DriveSource,
    PoseContent,
    PoseSource,
    Sources,
)
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
        is_still: whether the body hardly moves where the drive does.
    """

    sources: Sources
    configuration: Configuration
    findings: tuple[Finding, ...] = ()
    kind: str = ""
    geometry: Geometry = field(default_factory=Geometry)
    evidence: tuple[Evidence, ...] = ()
    alignment: Alignment | None = None
    cut: Cut | None = None
    is_still: bool = False

    @property
    def is_followed(self) -> bool:
        """Whether the pose follows what drives the vehicle, as far as the log tells."""
        known = [one for one in self.evidence if one.margin is not None and one.role != "gyro"]
        return not self.is_still and (not known or self.margin > CLEAR)

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
        motion, gyro = resolve_gyro(case, motion)
    except SlipError:
        # The stage `extract` raises it again.
        return as_given
    leave_out_of_ground(case, given, motion)
    drives = read_drives(case, motion)
    gyros = [] if gyro is None else [gyro]
    readings = [*(drive.reading for drive in drives), *gyros]
    motion = turn_motion(case, motion, readings)
    report_stranger(case, drives, motion)
    command, wheels = choose_roles(case, drives)
    report_axes(case, command)
    report_speed_alone(case, (command, wheels))
    resolve_stamps(case, command)
    command = resolve_publishers(case, command, wheels)
    resolve_losses(case, command)
    resolve_timeout(case, command, wheels, motion)
    report_turn(case, command)
    motion = resolve_lengths(case, motion, readings, command, wheels)
    is_judged = resolve_wheels(case, command, wheels, motion)
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
    resolve_delay(case, command, wheels, motion)
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
        case.is_still,
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


# Examination of a log without poses: its command against its measured wheels, which stand in for the pose.
#
# What the wheels do with the command is observable without a pose; what the ground does is not.

_REASON = "no pose is recorded: the motion of the wheels stands in"


def examine_drive(given: Given) -> Recording | None:
    """Let the measured wheels of a log without poses stand in for its pose.

    Returns:
        The recording; None if no candidate for wheels turns, or there is no command.
    """
    if given.may_move_sideways(given.sources):
        # Of its motion to the side only the wheels of a known vehicle show anything.
        return _take_by_name(given.sources, given.configuration) if given.is_known else None
    return _stand_in(Case(given))


def _take_by_name(sources: Sources, configuration: Configuration) -> Recording | None:
    """The recording with the wheels that were chosen by type and name."""
    if sources.wheels is None or sources.command is None:
        return None
    return Recording(_replace_pose(sources, sources.wheels), configuration, (_report_ground(sources.wheels),))


def _replace_pose(sources: Sources, wheels: DriveSource) -> Sources:
    """Sources with these wheels in the rank of a pose, and without a gyro, which measures the ground."""
    others = tuple(one for one in sources.rank_drives("wheels") if one != wheels)
    pose = PoseSource(wheels.signals[0].topic, _REASON, content=PoseContent.WHEELS, wheels=wheels)
    return replace(sources, wheels=None, pose=pose, imu=None, others={**sources.others, "wheels": others})


def _report_ground(wheels: DriveSource) -> Finding:
    return Finding(GROUND_UNOBSERVABLE, "warning", "pose", {"wheels": str(wheels)})


def _stand_in(case: Case) -> Recording | None:
    """See `examine_drive`."""
    wheels, motion = _find_wheels(case)
    if wheels is None or motion is None:
        return None
    commands = _read_commands(case, motion, wheels)
    case.sources = replace(case.sources, wheels=wheels.source)
    command, _ = choose_roles(case, commands)
    if command is None:
        return None
    steered = wheels.reading.form == "steering"
    if leave_out(case, wheels, command, None):
        kind = "ackermann" if steered else "differential"
        reading = case.read(wheels.source, is_measured=True, kind=kind, section=case.complete().wheels)
        rolled = None if reading is None else roll_wheels(reading)
        if reading is not None and rolled is not None:
            wheels.reading, motion = reading, rolled
            for one in commands:
                one.reading.explain(rolled)
    resolve_losses(case, command)
    resolve_timeout(case, command, wheels, motion)
    if wheels.reading.form == "sides":
        report_dead(case, wheels, has_pose=False)
        _find_unit(case, wheels, command)
    if not case.findings or case.findings[-1].severity != "error":
        _report_opposite(case, command, wheels)
    case.driven = explain_wheels(command.reading, wheels.reading)
    resolve_delay(case, command, wheels, None)
    sources = replace(case.sources, command=command.source)
    alignment = measure_command(case, command, wheels, "ackermann" if steered else "")
    return Recording(
        _replace_pose(sources, wheels.source),
        case.complete(),
        (*case.findings, _report_ground(wheels.source)),
        "ackermann" if steered else "",
        _measure_lengths(case, command, wheels),
        tuple(describe(one.reading, {id(command.reading): "command"}) for one in commands),
        alignment,
    )


def _find_wheels(case: Case) -> tuple[Candidate | None, Motion | None]:
    """The first candidate for wheels that turn, and their motion in its own units."""
    for number, source in enumerate(case.sources.rank_drives("wheels")):
        for kind in ("ackermann", "differential"):
            if kind == "ackermann" and source.form is not DriveForm.JOINTS:
                continue
            reading = case.read(source, is_measured=True, kind=kind)
            if reading is None or not reading.inputs:
                continue
            if kind == "ackermann" and len(reading.inputs) < 2:  # noqa: PLR2004 - no joint steers
                continue
            motion = roll_wheels(reading)
            if motion is not None:
                return Candidate(source, reading, number, is_measured=True), motion
    return None, None


def _read_commands(case: Case, motion: Motion, wheels: Candidate) -> list[Candidate]:
    """Candidates for the command, fitted to the motion of the wheels."""
    taken = {signal.topic for signal in wheels.source.signals}
    drives = []
    for number, source in enumerate(case.sources.rank_drives("command")):
        if taken & {signal.topic for signal in source.signals}:
            continue
        reading = case.read(source, is_measured=False)
        if reading is not None:
            reading.explain(motion)
            drives.append(Candidate(source, reading, number, is_measured=False))
    return drives


def _report_opposite(case: Case, command: Candidate, wheels: Candidate) -> None:
    """Signs of the command against those of the wheels: no third signal tells which of them is wrong."""
    explained = command.reading.explained
    if explained is None or not command.is_sure:
        return
    verbs = list[str]()
    if is_crossed(command):
        change = 'reversed = "left" or "right"'
        margin: float | None = explained.sign_margin
    else:
        verbs = [
            verb
            for verb, sign in (("drive", command.sign("ahead")), ("turn", command.sign("turned")))
            if sign < 0
        ]
        if not verbs:
            return
        changes = {"drive": "sign = -1 and exchanged = true", "turn": "exchanged = true"}
        change = changes[verbs[0]] if len(verbs) == 1 else "sign = -1"
        if wheels.reading.form != "sides":
            change = "sign = -1"
        margin = explained.moves
    values = {
        "kind": "command and wheels",
        "verbs": verbs,
        "source": str(command.source),
        "change": change,
        "value": margin,
    }
    case.findings.append(Finding("signs_contradict", "error", "command, wheels", values))


def _find_unit(case: Case, wheels: Candidate, command: Candidate) -> None:
    """Unit of the wheel speeds by the radius that each would mean."""
    explained = command.reading.explained
    if case.is_known or explained is None or not command.sign("ahead") or command.reading.form == "sides":
        return
    correct_wheel_unit(case, wheels, 1.0 / abs(float(explained.ahead.gains[0])), explained.shares[0])


def _measure_lengths(case: Case, command: Candidate, wheels: Candidate) -> Geometry:
    """Lengths by which the controller turns commands into motion of the wheels, whatever their signs."""
    explained, form = command.reading.explained, wheels.reading.form
    if explained is None or not command.is_sure or form == "body" or command.reading.form == "sides":
        return Geometry()
    fits = {"ahead": explained.ahead, "turned": explained.turned}
    gains = {name: abs(float(one.gains[0])) for name, one in fits.items()}
    errors = dict(zip(fits, list_errors(explained), strict=True))
    if is_crossed(command):
        # With one side reversed, the mean of the sides is half their difference, and the other way round.
        gains = {"ahead": 0.5 * gains["turned"], "turned": 2.0 * gains["ahead"]}
        errors = {"ahead": errors["turned"], "turned": errors["ahead"]}
    elif not command.sign("ahead"):
        return Geometry()
    radius, width = take_clear(case.wheel_factor() / gains["ahead"], errors["ahead"]), None
    if command.reading.form == "body" and radius is not None:
        width = take_clear(
            gains["turned"] / gains["ahead"], float(np.hypot(errors["ahead"], errors["turned"]))
        )
    if form == "steering":
        return Geometry(rolled=radius, wheelbase=width)
    return Geometry(radius=radius, track=width)
