"""Examination of a log: from the columns of its candidates to a `Recording`, by a list of questions."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import msgspec

from pipeline.core import SlipError, format_line, name_first
from pipeline.recording import MISREAD
from pipeline.recording.case import Case, open_case
from pipeline.recording.command_scale import ask_scale
from pipeline.recording.drive import list_joints
from pipeline.recording.encoders import ask_joints, ask_scales, ask_sides, read_as_wheels
from pipeline.recording.evidence import RATES, equal_motion
from pipeline.recording.extract import Given
from pipeline.recording.findings import Finding
from pipeline.recording.gains import ask_gains
from pipeline.recording.geometry import Geometry, explain_wheels
from pipeline.recording.legs import ask_legs, ask_motion
from pipeline.recording.lengths import ask_lengths
from pipeline.recording.losses import ask_losses
from pipeline.recording.motion import CLEAR, FEWEST_STEPS
from pipeline.recording.odometry import ask_odometry
from pipeline.recording.outages import ask_outages
from pipeline.recording.publishers import ask_publishers, ask_tracks
from pipeline.recording.readings import SIDES, Reading
from pipeline.recording.roles import (
    ask_angle,
    ask_kind,
    ask_roles,
    ask_stamps,
    ask_whose_pose,
    leave_out_of_ground,
    name_sources,
    read_drives,
)
from pipeline.recording.signs import ask_axes, ask_frame, ask_mounting, ask_plane, ask_signs, ask_yaw_rate
from pipeline.recording.timeouts import ask_delay, ask_timeout
from pipeline.recording.units import ask_gyro, ask_metres, ask_units
from pipeline.run import GROUND_UNOBSERVABLE, Alignment
from pipeline.sources import (
    RADII_M,
    Configuration,
    ConfigurationError,
    DriveForm,
    DriveSource,
    PoseContent,
    PoseSource,
    Sources,
)


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
        is_still: whether the body hardly moves where the drive does.
        refused: why the poses say nothing, and nothing else was asked; None if they may.
        unturned: names of drives whose sides do not differ where the body turns.
    """

    sources: Sources
    configuration: Configuration
    findings: tuple[Finding, ...] = ()
    kind: str = ""
    geometry: Geometry = field(default_factory=Geometry)
    evidence: tuple[Evidence, ...] = ()
    alignment: Alignment | None = None
    is_still: bool = False
    refused: Finding | None = None
    unturned: tuple[str, ...] = ()

    @property
    def is_followed(self) -> bool:
        """Whether the pose follows what drives the vehicle, as far as the log tells."""
        known = [one for one in self.evidence if one.margin is not None and one.role != "gyro"]
        return not self.is_still and (not known or self.margin > CLEAR)

    @property
    def margin(self) -> float:
        """Vuong's statistic of the pose with what drives the vehicle against the pose alone; zero of none."""
        return max((one.margin or 0.0 for one in self.evidence if one.role != "gyro"), default=0.0)


def ask_driven(case: Case) -> Case:
    """What the wheels do of the command."""
    return replace(case, driven=explain_wheels(case.command.reading, case.wheels.reading))


QUESTIONS: tuple[Callable[[Case], Case], ...] = (
    # What there is, and in which frame and of whom the motion is.
    ask_tracks,
    ask_odometry,
    ask_motion,
    ask_legs,
    ask_gyro,
    leave_out_of_ground,
    read_drives,
    ask_plane,
    ask_frame,
    ask_whose_pose,
    # The command, and when it acts.
    ask_roles,
    ask_axes,
    ask_yaw_rate,
    ask_stamps,
    ask_publishers,
    ask_losses,
    ask_timeout,
    ask_angle,
    ask_metres,
    # Encoders, one by one and a side at a time.
    read_as_wheels,
    ask_outages,
    ask_joints,
    ask_sides,
    ask_scales,
    ask_kind,
    # Signs, units and lengths of all.
    ask_signs,
    ask_driven,
    ask_units,
    ask_gains,
    ask_delay,
    ask_mounting,
    ask_scale,
    ask_lengths,
)
"""Questions on a log in their order: each is asked with what those before it decided."""


_READ_AS = (
    "unit", "yaw_unit", "steering_unit", "per_turn", "sign", "reversed", "exchanged", "scale", "factors",
    "axes", "up", "heading_deg",
)  # fmt: skip
"""Keys of run.toml that say how the numbers of a signal are read."""
_ALIKE = 1.3
"""Ratio of a length or a scale to the one that is known, up to which they are alike."""
_UNLIKE = 7.5
"""Ratio of a yaw rate to the one that is stated from which on its unit is another: degrees and radians
are 57 times apart."""


def examine(given: Given) -> Recording:
    """Decide which reading of a log's signals makes its body move as it does.

    Where something contradicts the log as run.toml reads it, it is examined without each section's keys for
    units, signs, scales and frames, too, without all of them, and without the joints of the sides. Those
    without which nothing is contradicted that was not before, but for what the log itself corrects in their
    stead, are wrong. They are obeyed, as are those that keep the log as it is recorded where it is corrected
    without them; all are named, and no radius, gain or wiring is blamed for what they do.

    Returns:
        What is in the log; without a pose in it where nothing can stand in for one.

    Raises:
        ConfigurationError: ``joint_unknown``: run.toml names a joint that is not in the log.
    """
    _require_joints(given)
    recording = _examine(given)
    contradicted = [one for one in recording.findings if one.id in MISREAD]
    doubts = _list_doubts(recording, given)
    lines = _list_readings(given.configuration, _READ_AS)
    pose = recording.configuration.pose
    if pose != given.configuration.pose and any("pose" in part for part in lines):
        # In a frame that is corrected, another line says another thing of it.
        completed = msgspec.structs.replace(given.configuration, pose=pose)
        doubts |= _list_doubts(_examine(replace(given, configuration=completed)), given)
    lines = lines if doubts else []
    # Sides that are exchanged are corrected; of wheels that are mixed there is nothing to correct.
    lines += _list_readings(given.configuration, SIDES) if recording.unturned else []
    # Each section alone, and then all: who mistakes a unit does so in both.
    several = {role: keys for part in lines for role, keys in part.items() if not keys.keys() & {*SIDES}}
    tried = [_try_without(given, part) for part in [*lines, *([several] if len(several) > 1 else [])]]
    agreeing = [one for one in tried if one.doubts < doubts]
    agreeing += [one for one in tried if one.doubts - one.corrected < doubts - one.corrected]
    for role, made in agreeing[0].corrections.items() if agreeing else ():
        values = {"given": agreeing[0].without[role], "instead": made}
        contradicted.append(Finding("configured_wrongly", "error", role, values))
    # Of signals that run.toml reads wrongly, nothing else is said.
    return replace(recording, findings=tuple(contradicted) or recording.findings)


def _require_joints(given: Given) -> None:
    """Refuse joints that no topic of the log has.

    Raises:
        ConfigurationError: ``joint_unknown``.
    """
    for role in ("command", "wheels"):
        section = getattr(given.configuration, role)
        lists = {"left": section.left, "right": section.right, "front": section.front}
        lists |= {"steering_joint": [section.steering_joint] if section.steering_joint else None}
        lists |= {"factors": [one for one in section.factors or () if one not in SIDES]}
        if not any(lists.values()):
            continue
        drives = {one.signals[0].topic for one in given.sources.rank_drives(role)}
        topics = {
            columns.topic: joints
            for columns in given.log.data.topics
            if columns.topic in drives and (joints := list_joints(columns))
        }
        known = sorted({joint for joints in topics.values() for joint in joints})
        for key, joints in lists.items():
            unknown = [joint for joint in joints or () if joint not in known]
            if known and unknown:
                raise ConfigurationError(
                    "joint_unknown",
                    f"{key} under [{role}] names {name_first(unknown)}, which {name_first([*topics])} does "
                    "not have",
                    where=given.where,
                    hint=f"Name joints of it: {name_first(known)}.",
                )


@dataclass(frozen=True)
class _Trial:
    """A log that is examined without keys of run.toml for some sections.

    Attributes:
        without: the keys, with their values, by section.
        doubts: what contradicts it.
        corrections: lines that correct it in place of these keys, by section.
        corrected: those of the doubts that these are.
    """

    without: Mapping[str, Mapping[str, object]]
    doubts: set[tuple[str, str]]
    corrections: dict[str, list[str]]
    corrected: set[tuple[str, str]]


def _try_without(given: Given, lines: Mapping[str, Mapping[str, object]]) -> _Trial:
    """The log examined without keys of some sections."""
    plain = {
        role: msgspec.structs.replace(getattr(given.configuration, role), **dict.fromkeys(keys))
        for role, keys in lines.items()
    }
    given = replace(given, configuration=msgspec.structs.replace(given.configuration, **plain))
    made = _examine(given)
    corrections: dict[str, list[str]] = {role: [] for role in lines}
    corrected = set[tuple[str, str]]()
    for one in made.findings:
        if one.values.get("kind") != "corrected" or one.where not in corrections:
            continue
        # What the user overrules by a line that keeps the log as it is recorded is not in its place.
        overruled = {format_line(*line) for line in lines[one.where].items()}
        if overruled.isdisjoint(one.values["otherwise"]):
            corrections[one.where].append(one.values["line"])
            corrected.add((one.id, one.where))
    return _Trial(lines, _list_doubts(made, given), corrections, corrected)


def _list_readings(configuration: Configuration, keys: Sequence[str]) -> list[dict[str, dict[str, object]]]:
    """Those of some keys of run.toml that are given, with their values, a section at a time."""
    lines = list[dict[str, dict[str, object]]]()
    for role in ("command", "wheels", "pose", "imu"):
        section = getattr(configuration, role)
        given = {key: value for key in keys if (value := getattr(section, key, None)) is not None}
        if given:
            lines.append({role: given})
    return lines


def _list_doubts(recording: Recording, given: Given) -> set[tuple[str, str]]:
    """What contradicts a reading: errors, corrections, and scales that no such vehicle has."""
    doubts = {
        (one.id, one.where)
        for one in recording.findings
        if one.severity == "error" or one.id == "command_scale" or one.values.get("kind") == "corrected"
    }
    if recording.refused is not None:
        doubts.add((recording.refused.id, recording.refused.where))
    if recording.is_still or not any(
        one.ahead or one.turned for one in recording.evidence if one.role != "gyro"
    ):
        doubts.add(("still", "pose"))
    radius = given.vehicle.wheel_radius_m
    radii = (radius / _ALIKE, radius * _ALIKE) if given.is_known else RADII_M
    ranges = {"gyro": [(1.0 / _ALIKE, _ALIKE)]}
    doubts |= {("sides", one) for one in recording.unturned}
    base, turned_by = given.configuration.vehicle.wheelbase_m, recording.geometry.wheelbase
    if base and turned_by and not 1.0 / _UNLIKE < turned_by.value / base < _UNLIKE:
        doubts.add(("wheelbase", "vehicle"))
    for one in recording.evidence:
        # A gyro that is upside down is no matter of its unit.
        scale = abs(one.turned) if one.role == "gyro" else one.ahead
        usual = ranges.get(one.role, [(1.0 / _ALIKE, _ALIKE), radii])
        if not 1.0 / _UNLIKE < _compare_turning(one, recording, given) < _UNLIKE:
            doubts.add(("yaw rate", one.name))
        if scale and not any(low <= scale <= high for low, high in usual):
            doubts.add(("scale", one.name))
    return doubts


def _compare_turning(one: Evidence, recording: Recording, given: Given) -> float:
    """Turning of the body over that which a body command states, in its unit as taken; one of any other."""
    source = getattr(recording.sources, one.role, None)
    if not one.turned or not isinstance(source, DriveSource) or source.form is not DriveForm.BODY:
        return 1.0
    taken, read = (
        RATES[getattr(each.configuration, one.role).yaw_unit or "rad/s"] for each in (recording, given)
    )
    return abs(one.turned) * read / taken


def _examine(given: Given) -> Recording:
    """What is in a log, as its configuration reads it."""
    as_given = Recording(given.sources, given.configuration)
    try:
        case = open_case(given)
        if case.moves_sideways and not case.has_pose:
            return _take_by_name(case, as_given)
        for ask in QUESTIONS:
            case = ask(case)
            if case.refused is not None:
                return replace(as_given, refused=case.refused)
            if ask not in {ask_tracks, ask_odometry} and not case.motion.is_known:
                return as_given
    except SlipError:
        if given.sources.pose is None:
            raise
        # The stage `extract` raises it again.
        return as_given
    return _conclude(case)


def _conclude(case: Case) -> Recording:
    """The recording as it was decided on."""
    sources, findings = name_sources(case), case.findings
    if not case.has_pose:
        sources = _replace_pose(sources, case.wheels.source)
        findings = [*findings, _report_ground(case.wheels.source)]
    roles = {"command": case.command, "wheels": case.wheels}
    evidence = []
    for drive in case.drives:
        named = ((each, role) for role, each in roles.items() if each.source == drive.source)
        known, role = next(named, (drive, ""))
        evidence.append(describe(known.reading, role))
    if case.gyro.form:
        evidence.append(describe(case.gyro, "gyro"))
    return Recording(
        sources,
        case.complete(),
        tuple(findings),
        case.kind,
        case.geometry,
        tuple(evidence),
        case.alignment,
        case.is_still,
        unturned=_list_unturned(case),
    )


def _list_unturned(case: Case) -> tuple[str, ...]:
    """Drives whose sides do not differ where the body turns as other signals say."""
    readings = [case.command.reading, case.wheels.reading, case.gyro]
    turns = [bool(one.explained.sign("turned")) for one in readings]
    return tuple(
        one.name
        for one, is_turning in zip(readings, turns, strict=True)
        if one.form == "sides" and one.explained.is_sure and not is_turning and any(turns)
    )


def describe(reading: Reading, role: str) -> Evidence:
    """How the motion follows a reading with this role."""
    made = reading.explained
    if not made.is_known:
        sizes = [one.values.size for one in (reading.first, reading.second)]
        is_constant = not reading.inputs and max(sizes) >= FEWEST_STEPS
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


# Wheels that stand in for the pose of a log without one: what they do with the command is observable; what
# the ground does is not.

_REASON = "no pose is recorded: the motion of the wheels stands in"


def _take_by_name(case: Case, as_given: Recording) -> Recording:
    """The recording of a base that moves sideways, with wheels by type and name.

    Of its motion to the side only the wheels of a known vehicle show anything.
    """
    wheels = case.sources.wheels
    if wheels is None or case.sources.command is None or not case.is_known:
        return as_given
    return replace(as_given, sources=_replace_pose(case.sources, wheels), findings=(_report_ground(wheels),))


def _replace_pose(sources: Sources, wheels: DriveSource) -> Sources:
    """Sources with these wheels in the rank of a pose, and without a gyro, which measures the ground."""
    others = tuple(one for one in sources.rank_drives("wheels") if one != wheels)
    pose = PoseSource(wheels.signals[0].topic, _REASON, content=PoseContent.WHEELS, wheels=wheels)
    return replace(sources, wheels=None, pose=pose, imu=None, others={**sources.others, "wheels": others})


def _report_ground(wheels: DriveSource) -> Finding:
    return Finding(GROUND_UNOBSERVABLE, "warning", "pose", {"wheels": str(wheels)})
