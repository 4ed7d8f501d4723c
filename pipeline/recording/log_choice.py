"""Choice of a log's vehicle and of the topics of every role, from the log and the configuration.

1. Words of names, message types and a robot description identify the vehicle unless the user names it; of a
   recording whose end is lost, the other recordings of its folder may.
2. Types and names rank the topics of every role.
3. All candidates are read with the data that the run needs. Their content decides which of several is the
   pose, and by its motion `pipeline.recording` decides the rest; the stages reuse the columns.
4. The geometry of an unidentified vehicle is estimated from the wheels and the pose.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import msgspec

from pipeline.core import NORMAL_95, return_freed_memory
from pipeline.logs import (
    ChannelInfo,
    LogError,
    LogIndex,
    Ragged,
    RaggedStrings,
    Strings,
    TopicColumns,
    TransformBuffer,
    Wanted,
    read_topics,
    wanted_transforms,
)
from pipeline.recording.extract import Given
from pipeline.recording.findings import Finding, Severity
from pipeline.recording.folder import find_in_folder
from pipeline.recording.log_columns import LogColumns
from pipeline.recording.topic_values import find_sideways_share, list_wanted, with_texts
from pipeline.sources import (
    CONFIGURED,
    UNKNOWN_VEHICLE,
    Configuration,
    ConfigurationError,
    Controller,
    Description,
    DriveForm,
    DriveSource,
    PoseSource,
    Recognized,
    Sources,
    Vehicle,
    VehicleSource,
    apply_parameters,
    choose_sources,
    find_preset,
    find_type,
    is_localization,
    list_contradictions,
    list_metadata,
    list_named,
    make_vehicle,
    plain_type,
    read_description,
    read_frames,
    read_parameters,
    recognize_vehicle,
    resolve_vehicle,
)
from pipeline.store import JSON

if TYPE_CHECKING:
    from pipeline.recording import Recording
    from pipeline.recording.geometry import Geometry
    from pipeline.recording.pose_choice import PoseRating

_EVENTS = "rcl_interfaces/ParameterEvent"
_LISTS = ("new_parameters", "changed_parameters")
_VALUE = "value.double_value"


def find_description(index: LogIndex) -> Description | None:
    """The robot description of a log."""
    topics = [
        channel.topic
        for channel in index.channels
        if channel.message_count != 0 and channel.topic.endswith("robot_description")
    ]
    for columns in _read(index, [Wanted(topic, ("data",)) for topic in topics]):
        texts = columns.fields.get("data")
        description = (
            read_description(texts.to_list()[-1]) if isinstance(texts, Strings) and len(texts) else None
        )
        if description is not None:
            return description
    return None


def find_controller(index: LogIndex) -> Controller | None:
    """Vehicle parameters of the controller, from parameter events and metadata."""
    topics = [
        channel.topic
        for channel in index.channels
        if channel.message_count != 0 and plain_type(channel.type_name) == _EVENTS
    ]
    fields = ("node", *(f"{name}[].{field}" for name in _LISTS for field in ("name", _VALUE)))
    parameters = list_metadata(index.metadata)
    for columns in _read(index, [Wanted(topic, fields) for topic in topics]):
        parameters += _list_events(columns)
    return read_parameters(parameters)


def find_static_frames(index: LogIndex) -> TransformBuffer:
    """The static transforms of a log."""
    types = {channel.topic: channel.type_name for channel in index.channels if channel.message_count != 0}
    static = [one for one in wanted_transforms(types) if one.topic.endswith("static")]
    return TransformBuffer(_read(index, static))


def _list_events(columns: TopicColumns) -> Iterator[tuple[str, str, float]]:
    nodes = columns.fields["node"]
    if not isinstance(nodes, Strings):
        return
    named = nodes.to_list()
    for part in _LISTS:
        names, values = columns.fields[f"{part}[].name"], columns.fields[f"{part}[].{_VALUE}"]
        if not isinstance(names, RaggedStrings) or not isinstance(values, Ragged):
            continue
        for row, node in enumerate(named):
            for name, value in zip(names.row(row), values.row(row).tolist(), strict=True):
                yield node, name, float(value)


def _read(index: LogIndex, wanted: list[Wanted]) -> Sequence[TopicColumns]:
    """Read small topics, skipping unreadable ones, which the main reading of the log reports."""
    if not wanted:
        return ()
    try:
        return read_topics(index, wanted, sha256="unused", skip_unfit=True).topics
    except LogError:
        return ()


_MOST_UNFIT = 5
"""Topics without a needed field that are left out of a log: each costs a reading of the others."""
_AS_DRAWN = 0.1
"""Absolute logarithm of the controller's wheel radius over the height of a wheel's frame, up to which it is
that."""
_STAND_INS: Mapping[str, float] = {"wheel_radius_m": 0.1, "track_width_m": 0.5}
_STEERED = ("ackermann_msgs/", "autoware_control_msgs/", "autoware_auto_control_msgs/", "hunter_msgs/")


@dataclass(frozen=True)
class Choice:
    """A log's vehicle and topics.

    Attributes:
        vehicle: geometry and limits.
        vehicle_source: source of the vehicle's identification.
        sources: topics of every role.
        ratings: candidates for the pose, the best first; empty if nothing was compared.
        findings: findings on the choice.
        log: columns that were read for the choice; None where nothing was to be compared.
        recording: what the signals show; None without a pose.
    """

    vehicle: Vehicle
    vehicle_source: VehicleSource
    sources: Sources
    ratings: tuple[PoseRating, ...] = ()
    findings: tuple[Finding, ...] = ()
    log: LogColumns | None = None
    recording: Recording | None = None

    def take_log(self) -> LogColumns:
        """The columns of a log that can be analyzed, which were read to choose its pose."""
        assert self.log is not None  # noqa: S101 - without a pose the log is refused
        return self.log

    def list_fitted(self) -> list[str]:
        """Lines of the section [vehicle] of run.toml for what was fitted; none where no length was."""
        vehicle = self.vehicle
        if self.vehicle_source != "fitted" or not vehicle.errors:
            return []
        used = [
            each.name
            for each in vehicle.kinematics.geometry
            if (each.required or each.name in vehicle.errors) and each.name not in vehicle.stand_ins
        ]
        lengths = {name: value for name in used if (value := getattr(vehicle, name)) is not None}
        return [f'kind = "{vehicle.kind}"', *(f"{name} = {value:.4g}" for name, value in lengths.items())]

    def to_json(self, types: Mapping[str, str]) -> dict[str, JSON]:
        """The documented keys ``choices``, ``vehicle_source`` and ``signals``, of a guess ``vehicle_fitted``.

        Args:
            types: message type by topic.
        """
        choices: dict[str, JSON] = {}
        for role in ("command", "wheels", "pose", "imu"):
            source = getattr(self.sources, role)
            choices[role] = (
                None
                if source is None
                else {
                    "topic": str(source),
                    "type": types.get(
                        source.signals[0].topic if isinstance(source, DriveSource) else source.topic
                    ),
                    "reason": source.reason,
                    "others": [
                        {"topic": str(other), "reason": other.reason}
                        for other in self.sources.others.get(role, ())
                    ],
                }
            )
        signals: list[JSON] = []
        if self.recording is not None:
            signals = [dict(vars(one)) for one in self.recording.evidence]
        described: dict[str, JSON] = {
            "choices": choices,
            "vehicle_source": self.vehicle_source,
            "signals": signals,
        }
        if lines := self.list_fitted():
            errors = self.vehicle.errors
            values = {name: float(getattr(self.vehicle, name)) for name in errors}
            described["vehicle_fitted"] = {
                "run_toml": "\n".join(["[vehicle]", *lines, ""]),
                **{
                    name: {
                        "value": value,
                        "low": value - NORMAL_95 * errors[name],
                        "high": value + NORMAL_95 * errors[name],
                    }
                    for name, value in values.items()
                },
            }
        return described


def choose(index: LogIndex, configuration: Configuration, overrides: Mapping[str, object]) -> Choice:
    """Choose vehicle and topics of a log; topics whose messages never have a needed field are left out.

    Args:
        index: index of the log.
        configuration: configuration of the user, including the command line.
        overrides: its values from the command line.

    Raises:
        ConfigurationError: the configuration does not fit the log; the vehicle is unknown and cannot be
            fitted; several robots.
        LogError: the log cannot be read.
    """
    named, description, controller = (
        list_named(configuration),
        find_description(index),
        find_controller(index),
    )
    findings: list[Finding] = []
    while True:
        try:
            recognized = recognize_vehicle(index.channels, index.metadata, description, named)
            chosen = _choose_readable(index, configuration, overrides, recognized, controller)
        except LogError as error:
            # Of some encodings, only the messages tell which fields there are.
            topic = next((one for one in index.topics() if error.where == f"{index.path}, topic {one}"), None)
            is_wanted = topic in named or len(findings) == _MOST_UNFIT
            if error.code != "field_not_found" or topic is None or is_wanted:
                raise
            findings.append(Finding("topic_left_out", "warning", topic, {"why": error.what}))
            index = replace(index, channels=tuple(one for one in index.channels if one.topic != topic))
        else:
            return replace(chosen, findings=(*findings, *chosen.findings))


def _choose_readable(
    index: LogIndex,
    configuration: Configuration,
    overrides: Mapping[str, object],
    recognized: Recognized | None,
    controller: Controller | None,
) -> Choice:
    where = str(index.path)
    known: dict[str, float] = {}
    if recognized is None:
        recognized, known = _recognize_geometry(index, configuration, controller)
    elif controller is not None:
        recognized = apply_parameters(recognized, controller)
    beside: tuple[Finding, ...] = ()
    if recognized is None and not _is_named(index, configuration):
        recognized, beside = find_in_folder(index)
    problem: ConfigurationError | None = None
    try:
        vehicle, source = _name_vehicle(index, configuration, overrides, recognized)
    except ConfigurationError as error:
        if error.code != "vehicle_unknown" or configuration.vehicle.preset is not None:
            raise
        problem, vehicle, source = error, make_stand_in(index, configuration), "fitted"
    channels, sources, findings = _leave_out_silent(index, configuration, vehicle)
    if source not in {"flag", "configuration"} and _asks_sideways(index, vehicle, sources):
        vehicle = find_preset(vehicle.sideways_preset) or vehicle
        sources = choose_sources(channels, configuration, vehicle, where=where)
    vehicle = _apply_controller(vehicle, sources, configuration, controller)
    findings += [*_list_silent(channels, configuration, vehicle, sources, where), *beside]
    findings += [
        Finding("vehicle_choice", "info", "vehicle", note)
        for note in (recognized.notes if recognized else ())
    ]
    recorded = find_preset(index.deployment.get("vehicle") or "")
    witnesses = [*filter(None, [recognized]), *([Recognized(recorded, "metadata")] if recorded else [])]
    contradiction = next(_list_contradictions(witnesses, vehicle, source), None)
    findings += [contradiction[0]] if contradiction else []
    chosen = Choice(vehicle, source, sources, findings=tuple(findings))
    chosen = _choose_pose(chosen, channels, index, configuration)
    chosen = _settle_by_motion(chosen, *contradiction) if contradiction else chosen
    taken = chosen.sources
    if taken.command is None and taken.wheels is not None and taken.pose is not None:
        finding = Finding("no_command", "info", "command")
        chosen = replace(chosen, findings=(*chosen.findings, finding))
    # The content may leave no drive: what was chosen by name is a drive all the same.
    fits = problem is not None and taken.pose is not None and (sources.wheels or sources.command) is not None
    # Missing data are reported before an unknown vehicle.
    if problem is None or not fits:
        return chosen
    return _fit_vehicle(chosen, configuration, problem, known)


def _is_named(index: LogIndex, configuration: Configuration) -> bool:
    """Whether the user or the log names a vehicle, or the user gives one of its lengths or its kind."""
    return bool(index.deployment.get("vehicle")) or bool(configuration.vehicle.list_values())


def _choose_pose(
    chosen: Choice, channels: Sequence[ChannelInfo], index: LogIndex, configuration: Configuration
) -> Choice:
    """The choice with the pose by its content, or with wheels that stand in for it."""
    sources = chosen.sources
    if sources.pose is None and not _lacks_pose(
        channels, configuration, chosen.vehicle, sources, str(index.path)
    ):
        return chosen
    rivals = [one for one in sources.others.get("pose", ()) if isinstance(one, PoseSource)]
    if len(rivals) >= MOST_POSES:
        rivals, finding = _leave_out_poses(index, rivals)
        sources = replace(sources, others={**sources.others, "pose": tuple(rivals)})
        chosen = replace(chosen, sources=sources, findings=(*chosen.findings, finding))
    drives = [*sources.rank_drives("command"), *sources.rank_drives("wheels")]
    log = LogColumns(read_topics(index, list_wanted(sources, index.types, [*rivals, *drives])))
    return_freed_memory()
    given = Given(log, sources, configuration, chosen.vehicle, where=str(index.path))
    return _let_wheels_stand_in(chosen, given) if sources.pose is None else _compare(chosen, given)


def _lacks_pose(
    channels: Sequence[ChannelInfo],
    configuration: Configuration,
    vehicle: Vehicle,
    sources: Sources,
    where: str,
) -> bool:
    """Whether a log with commands and measured wheels was made without recording any pose.

    A topic for poses without any message was meant to be recorded: the log is refused, and names it.
    """
    if sources.command is None or sources.wheels is None:
        return False
    return choose_sources(_announce(channels), configuration, vehicle, where=where).pose is None


def _announce(channels: Sequence[ChannelInfo]) -> list[ChannelInfo]:
    """The channels as if those without messages had as many as any other."""
    most = max(1, *(one.message_count for one in channels))
    return [replace(one, message_count=one.message_count or most) for one in channels]


def _list_silent(
    channels: Sequence[ChannelInfo],
    configuration: Configuration,
    vehicle: Vehicle,
    sources: Sources,
    where: str,
) -> list[Finding]:
    """Findings on topics that would be taken for a role if they had messages."""
    silent = {one.topic for one in channels if one.message_count == 0}
    if not silent:
        return []
    try:
        announced = choose_sources(_announce(channels), configuration, vehicle, where=where)
    except ConfigurationError:
        # With them the log has several robots.
        return []
    findings = []
    for role in ("command", "wheels", "pose", "imu"):
        first, taken = getattr(announced, role), getattr(sources, role)
        signals = first.signals if isinstance(first, DriveSource) else [first] if first else []
        for topic in sorted(silent.intersection(one.topic for one in signals)):
            values = {"kind": "another" if taken else "none", "topic": topic, "taken": str(taken)}
            findings.append(Finding("topic_without_messages", "warning", role, values))
    return findings


def _let_wheels_stand_in(chosen: Choice, given: Given) -> Choice:
    """The choice for a log without poses; unchanged if its wheels cannot stand in for one."""
    from pipeline.recording import examine  # noqa: PLC0415 - heavy

    recording = examine(given)
    if recording.sources.pose is None:
        return chosen
    return replace(
        chosen,
        sources=recording.sources,
        findings=(*chosen.findings, *recording.findings),
        log=given.log,
        recording=recording,
    )


MOST_POSES = 40
"""Maximum number of poses whose content is compared: each costs a reading of the drive's topics, too, and the
platforms of `tests/fixtures/platforms` record at most ten."""


def _leave_out_poses(index: LogIndex, rivals: Sequence[PoseSource]) -> tuple[list[PoseSource], Finding]:
    """The rivals of the pose with most messages, in their order, and a finding on the others."""
    messages = Counter[str]()
    for channel in index.channels:
        messages[channel.topic] += channel.message_count or 0
    fullest = set(sorted(rivals, key=lambda rival: -messages[rival.topic])[: MOST_POSES - 1])
    count = len(rivals) + 1
    values = {"count": count - MOST_POSES, "all": count, "compared": MOST_POSES}
    finding = Finding("poses_left_out", "warning", "pose", values)
    return [rival for rival in rivals if rival in fullest], finding


def _may_be_odometry(pose: PoseSource | None) -> bool:
    """Whether only the content distinguishes this pose from wheel odometry."""
    return pose is not None and pose.reason != CONFIGURED and not is_localization(pose.topic)


def _name_vehicle(
    index: LogIndex,
    configuration: Configuration,
    overrides: Mapping[str, object],
    recognized: Recognized | None,
) -> tuple[Vehicle, VehicleSource]:
    section, recorded = configuration.vehicle, index.deployment.get("vehicle")
    vehicle = resolve_vehicle(
        section,
        recorded=recorded,
        recognized=recognized.vehicle if recognized else None,
        where=str(index.path),
    )
    if section.preset is not None or section.wheel_radius_m is not None:
        return vehicle, "flag" if "vehicle" in overrides else "configuration"
    if find_preset(recorded or "") is not None or recognized is None:
        return vehicle, "metadata"
    return vehicle, recognized.source


def make_stand_in(index: LogIndex, configuration: Configuration) -> Vehicle:
    """Placeholder vehicle of the kind that the topics suggest; with unit geometry, gains are lengths."""
    types = {channel.type_name for channel in index.channels if channel.message_count != 0}
    steered = any(name.startswith(_STEERED) for name in types)
    kind = str(configuration.vehicle.list_values().get("kind", "ackermann" if steered else "differential"))
    return Vehicle(
        id=UNKNOWN_VEHICLE,
        name="unknown vehicle",
        kind=kind,
        wheel_radius_m=1.0,
        track_width_m=1.0,
        wheelbase_m=1.0,
    )


def _recognize_geometry(
    index: LogIndex, configuration: Configuration, controller: Controller | None
) -> tuple[Recognized | None, dict[str, float]]:
    """Vehicle from the wheel frames and the controller's parameters, and the known geometry."""
    geometry = {} if controller is None else controller.geometry
    section, recorded = configuration.vehicle, find_preset(index.deployment.get("vehicle") or "")
    if section.preset is not None or section.wheel_radius_m is not None or recorded is not None:
        return None, geometry
    kind, framed = read_frames(find_static_frames(index))
    known = {**framed, **geometry}
    if controller is not None and controller.kind != "differential":
        kind = controller.kind
    name = "robot" if controller is None else controller.name
    vehicle = make_vehicle(name, kind, known)
    if vehicle is None:
        return None, known
    return Recognized(vehicle, "parameters" if geometry else "transforms"), known


def _asks_sideways(index: LogIndex, vehicle: Vehicle, sources: Sources) -> bool:
    """Whether a platform that is also built with such wheels is commanded to move sideways."""
    if not vehicle.sideways_preset or sources.command is None:
        return False
    return find_sideways_share(_read_commands(index, [sources.command]), sources.command) > 0.0


def _leave_out_silent(
    index: LogIndex, configuration: Configuration, vehicle: Vehicle
) -> tuple[Sequence[ChannelInfo], Sources, list[Finding]]:
    """Channels and topics of every role without unreadable text commands, and findings on those excluded."""
    channels = list(index.channels)
    sources = choose_sources(channels, configuration, vehicle, where=str(index.path))
    chosen = sources.command
    if chosen is None or chosen.reason == CONFIGURED or not _is_text(index, chosen):
        return channels, sources, []
    texts = [one for one in sources.rank_drives("command") if _is_text(index, one)]
    readable = {
        columns.topic for columns in _read_commands(index, texts) if with_texts(columns).log_time.size
    }
    if chosen.signals[0].topic in readable:
        return channels, sources, []
    silent = list(dict.fromkeys(one.signals[0].topic for one in texts))
    silent = [topic for topic in silent if topic not in readable]
    unread = set(silent)
    channels = [channel for channel in channels if channel.topic not in unread]
    sources = choose_sources(channels, configuration, vehicle, where=str(index.path))
    return channels, sources, [Finding("no_readable_text", "warning", silent[0], {"topics": silent})]


def _is_text(index: LogIndex, command: DriveSource) -> bool:
    return find_type(index.types[command.signals[0].topic]).text is not None


def _read_commands(index: LogIndex, commands: Sequence[DriveSource]) -> Sequence[TopicColumns]:
    each = (list_wanted(Sources(command, None, None, None, None), index.types) for command in commands)
    return read_topics(index, [wanted for some in each for wanted in some], sha256="unused").topics


def _apply_controller(
    vehicle: Vehicle, sources: Sources, configuration: Configuration, controller: Controller | None
) -> Vehicle:
    """Apply the recorded track multiplier, or the vendor's if its own controller received the command."""
    command = sources.command
    if command is None or configuration.vehicle.controller_track_multiplier is not None:
        return vehicle
    multiplier = None if controller is None else controller.values.get("controller_track_multiplier")
    if multiplier is None:
        if not command.signals[0].topic.endswith(tuple(vehicle.controller.topics)):
            return vehicle
        multiplier = vehicle.controller.track_multiplier
    return msgspec.structs.replace(vehicle, controller_track_multiplier=multiplier)


def _list_contradictions(
    witnesses: Sequence[Recognized], vehicle: Vehicle, source: VehicleSource
) -> Iterator[tuple[Finding, Vehicle]]:
    """Findings on a chosen vehicle that what the log shows or says contradicts, each with that vehicle."""
    for one in witnesses:
        dimensions = list_contradictions(one.vehicle, vehicle)
        differing = [*dimensions.values()]
        is_given = source in {"flag", "configuration", "metadata"} and source != one.source
        if is_given and differing and one.vehicle.sideways_preset != vehicle.id:
            values = {
                "source": one.source,
                "indicated": one.vehicle.name,
                "differing": differing,
                "dimensions": [*dimensions],
                "vehicle": vehicle.name,
                "is_flag": source == "flag",
            }
            yield Finding("vehicle_contradiction", "warning", "vehicle", values), one.vehicle


_SAME_RADIUS = 1.3
"""Ratio of the radius by the motion to that of a vehicle, up to which wheels may have it and slip."""


def _settle_by_motion(chosen: Choice, contradiction: Finding, other: Vehicle) -> Choice:
    """The choice, with a finding where wheels roll as those of the vehicle that the log indicates alone."""
    recording, stated = chosen.recording, chosen.vehicle.wheel_radius_m
    if recording is None:
        return chosen
    for one in recording.evidence:
        drive = getattr(chosen.sources, one.role, None)
        if not isinstance(drive, DriveSource) or drive.form not in {DriveForm.JOINTS, DriveForm.SIDES}:
            continue
        section = getattr(recording.configuration, one.role)
        if not one.ahead or section.unit not in {None, "rad/s"} or section.scale is not None:
            continue
        fits = [
            radius is not None and abs(math.log(abs(one.ahead) / radius)) < math.log(_SAME_RADIUS)
            for radius in (stated, other.wheel_radius_m)
        ]
        if fits == [False, True]:
            values = {
                "source": contradiction.values["source"],
                "indicated": other.name,
                "vehicle": chosen.vehicle.name,
                "is_flag": chosen.vehicle_source == "flag",
                "value": abs(one.ahead),
                "radius_m": stated,
            }
            finding = Finding("vehicle_by_motion", "error", "vehicle", values)
            return replace(chosen, findings=(*chosen.findings, finding))
    return chosen


def _compare(chosen: Choice, given: Given) -> Choice:
    """Choose among the poses by their content, then the other roles by the motion of the pose."""
    from pipeline.recording import examine  # noqa: PLC0415 - heavy
    from pipeline.recording.pose_choice import rate_poses, replace_pose  # noqa: PLC0415 - heavy

    sources, ratings, findings = chosen.sources, chosen.ratings, list(chosen.findings)
    if sources.others.get("pose") or _may_be_odometry(sources.pose):
        ratings = rate_poses(given)
        best = ratings[0] if ratings else None
        useless = best.refusal if best is not None and best.stands else ""
        # An odometry that is published twice measures the wheels all the same.
        bare = chosen.sources if best is not None and best.same_as else replace_pose(sources, ratings)
        sources = replace_pose(sources, ratings)
        if best is not None and best.from_wheels:
            whose = f"those of {best.same_as}, " if best.same_as else ""
            useless = (
                f"they are wheel odometry, not a localization: {whose}computed from the wheels, they say "
                "nothing of the ground"
            )
        if best is not None and useless:
            bare = replace(bare, pose=None)
            alone = _let_wheels_stand_in(replace(chosen, sources=bare), replace(given, sources=bare))
            if alone.recording is not None and (alone.recording.is_followed or not best.same_as):
                what = f"the poses of {best.source}: {useless}"
                unused = Finding("numbers_not_used", "warning", best.source.topic, {"what": what})
                return replace(alone, findings=(*alone.findings, unused))
        if best is not None and best.from_wheels:
            why = (
                {"kind": "is another", "pose": str(best.source), "same_as": best.same_as}
                if best.same_as
                else {"kind": "is the only one"}
            )
            where = "pose" if best.same_as else str(best.source)
            findings.append(Finding("pose_from_wheels", "error", where, why))
    recording = examine(replace(given, sources=sources))
    if recording.refused is not None:
        whole = replace(chosen, ratings=ratings, log=given.log, recording=recording)
        return _do_without_pose(whole, replace(given, sources=sources), recording.refused)
    for other in _list_equals(ratings) if not recording.is_followed or _is_astray(ratings) else ():
        instead = replace_pose(chosen.sources, [other, *(one for one in ratings if one is not other)])
        made = examine(replace(given, sources=instead))
        if made.is_followed and (made.margin > recording.margin or not recording.is_followed):
            values = {"pose": str(other.source), "other": str(ratings[0].source)}
            findings.append(Finding("pose_of_another", "info", "pose", values))
            ratings = (other, *(one for one in ratings if one is not other))
            recording = made
            break
    return replace(
        chosen,
        sources=recording.sources,
        ratings=ratings,
        findings=(*findings, *recording.findings),
        log=given.log,
        recording=recording,
    )


def _do_without_pose(chosen: Choice, given: Given, refused: Finding) -> Choice:
    """The choice without a pose that was refused: with the next one, or the wheels in its stead."""
    from pipeline.recording.pose_choice import replace_pose  # noqa: PLC0415 - heavy

    rest = [one for one in chosen.ratings[1:] if not (one.refusal or one.from_wheels)]
    noted = replace(chosen, findings=(*chosen.findings, refused))
    if rest:
        return _compare(noted, replace(given, sources=replace_pose(given.sources, rest)))
    bare = replace(given.sources, pose=None)
    alone = _let_wheels_stand_in(replace(noted, sources=bare, recording=None), replace(given, sources=bare))
    if alone.recording is not None:
        return alone
    error = Finding("pose_contradicts_itself", "error", "pose", {"source": refused.values["source"]})
    return replace(noted, findings=(*noted.findings, error))


_ASTRAY = 0.2
"""Share of a pose's path that the wheels do not explain, from which on it may be that of another body."""


def _is_astray(ratings: Sequence[PoseRating]) -> bool:
    beside = ratings[0].beside_wheels if ratings else None
    return beside is not None and beside > _ASTRAY


def _list_equals(ratings: Sequence[PoseRating]) -> list[PoseRating]:
    """Candidates for the pose that names and frames rate as the best one."""
    return [
        one for one in ratings[1:] if not (one.refusal or one.from_wheels) and one.score == ratings[0].score
    ]


_ANOTHER_BASE = 2.0
"""Ratio of the wheelbase by which a car turns to its own one beyond which it is no slip of its tyres."""


def _fit_vehicle(
    chosen: Choice,
    configuration: Configuration,
    problem: ConfigurationError,
    recorded: Mapping[str, float],
) -> Choice:
    """Geometry of an unidentified vehicle: what is given, else recorded, else what its signals show.

    Args:
        chosen: choice with a placeholder of unit geometry, and the recording.
        configuration: configuration of the user.
        problem: error to raise if wheels have no known radius, and nothing else drives the vehicle.
        recorded: geometry recorded in the log.
    """
    from pipeline.recording.geometry import LENGTHS, describe_vehicle  # noqa: PLC0415 - heavy

    recording, sources = chosen.recording, chosen.sources
    if recording is None or chosen.log is None:
        raise problem
    topics = chosen.log.data.topics
    given = {key: value for key, value in configuration.vehicle.list_values().items() if key != "preset"}
    kind = str(given.get("kind") or recording.kind or chosen.vehicle.kind)
    if "kind" not in given and kind != "mecanum" and find_sideways_share(topics, sources.command):
        # The arrangement of the wheels is unknown: only body motion can be evaluated.
        kind = "omni"
    known = {
        **_trust_frames(read_frames(TransformBuffer(topics))[1], recording.geometry),
        **recorded,
        **given,
    }
    lengths = recording.geometry.list_lengths(kind)
    fitted = {key: length.value for key, length in lengths.items()}
    errors = {key: float(length.error) for key, length in lengths.items() if key not in known}
    values = {key: value for key, value in {**fitted, **known}.items() if key in LENGTHS}
    findings = [*chosen.findings, *_contradict_wheelbase(recording.geometry, kind, given)]
    contradiction = _contradict_radius(recording.geometry, known)
    if contradiction:
        values = {key: value for key, value in values.items() if key in known}
    standing_in = None if sources.pose is None else sources.pose.wheels
    drives = [drive for drive in (sources.wheels, sources.command, standing_in) if drive is not None]
    is_body = all(drive.form is DriveForm.BODY for drive in drives)
    needed = {"differential": ("wheel_radius_m",), "mecanum": LENGTHS}.get(kind, ())
    if not is_body and (kind == "omni" or any(key not in values for key in needed)):
        if standing_in is not None:
            return _take_unit_wheels(chosen, problem, kind, {**values, **given})
        if sources.command is None or sources.command.form is not DriveForm.BODY:
            raise problem
        why = _explain_left_out(recording, str(sources.wheels), contradiction)
        about = {"wheels": str(sources.wheels), **why}
        findings.append(Finding("wheels_left_out", "warning", "wheels", about))
        sources, is_body, kind = replace(sources, wheels=None), True, kind.replace("mecanum", "omni")
    if kind == "ackermann" and "wheelbase_m" not in values:
        if standing_in is not None:
            return _take_unit_wheels(chosen, problem, kind, {**values, **given})
        raise problem
    assumed = {key: value for key, value in _STAND_INS.items() if key not in values}
    if kind == "ackermann":
        assumed.pop("track_width_m", None)
    used: dict[str, object] = {**(assumed if is_body else {}), **values}
    name, described = describe_vehicle(recording.geometry, kind, used, [*known], is_body=is_body)
    bare = {"name": "fitted vehicle", "track_width_m": None, "wheelbase_m": None}
    vehicle = msgspec.structs.replace(
        chosen.vehicle,
        **{**bare, "id": name, "kind": kind, **assumed, **values, **given},
        stand_ins=[*assumed],
        errors={} if is_body else errors,
    )
    is_given = all(key in known for key in values) and not is_body
    severity: Severity = "info" if is_given else "warning"
    findings.append(Finding("vehicle_fitted", severity, "vehicle", described))
    return replace(
        chosen,
        vehicle=vehicle,
        vehicle_source="fitted",
        sources=sources,
        findings=tuple(findings),
    )


def _trust_frames(framed: Mapping[str, float], seen: Geometry) -> Mapping[str, object]:
    """Lengths by the frames of wheels, without a radius that is not the one which the controller counts on.

    The height of a frame is where a wheel is drawn.
    """
    drawn = framed.get("wheel_radius_m")
    if drawn is None or seen.radius is None or abs(math.log(seen.radius.value / drawn)) < _AS_DRAWN:
        return framed
    return {key: value for key, value in framed.items() if key != "wheel_radius_m"}


def _explain_left_out(
    recording: Recording, wheels: str, contradiction: Mapping[str, Sequence[float]]
) -> dict[str, object]:
    """Why wheels are not used whose vehicle is not known."""
    if contradiction:
        return {"kind": "radius contradicted", **contradiction}
    read = {one.name for one in recording.evidence}
    return {"kind": "no sides" if read and wheels not in read else "radius unknown"}


def _contradict_radius(seen: Geometry, known: Mapping[str, object]) -> dict[str, list[float]]:
    """Wheel radii [m] by commands and poses that differ, with their 95 % intervals; empty without."""
    one, other = seen.radius, seen.rolled
    if "wheel_radius_m" in known or one is None or other is None or not seen.is_contradicted:
        return {}
    sizes = {"commanded_m": one, "rolled_m": other}
    return {name: [length.value, *length.interval] for name, length in sizes.items()}


def _contradict_wheelbase(seen: Geometry, kind: str, given: Mapping[str, object]) -> list[Finding]:
    """That a car turns as one of another wheelbase than the user's; else nothing."""
    base, length = given.get("wheelbase_m"), seen.wheelbase
    if kind != "ackermann" or not isinstance(base, float) or length is None:
        return []
    low, high = length.interval
    if abs(math.log(length.value / base)) < math.log(_ANOTHER_BASE) or low < base < high:
        return []
    values = {"given": base, "value": length.value, "low": low, "high": high, "dimensions": ["wheelbase_m"]}
    return [Finding("wheelbase_contradicted", "warning", "vehicle", values)]


def _take_unit_wheels(
    chosen: Choice, problem: ConfigurationError, kind: str, values: Mapping[str, object]
) -> Choice:
    """Usual lengths for a log without poses whose commands are of the same kind as what its wheels measure.

    Args:
        chosen: choice with a placeholder of unit geometry.
        problem: error to raise if the commands are motion of the body, which the wheels do not follow.
        kind: of the vehicle.
        values: of the vehicle that were given, or that the signals show.
    """
    command = chosen.sources.command
    if command is None or command.form is DriveForm.BODY:
        why = "the wheels follow the commands too loosely to show its geometry"
        what = f"{problem.what}, and {why}"
        raise ConfigurationError(problem.code, what, where=problem.where, hint=problem.hint)
    needed = (*_STAND_INS,) if kind == "differential" else ("wheel_radius_m", "wheelbase_m")
    lengths = {**_STAND_INS, "wheelbase_m": 1.0}
    assumed = {key: lengths[key] for key in needed if key not in values}
    bare = {"name": "fitted vehicle", "wheelbase_m": None, "id": "fitted_wheels", "kind": kind}
    vehicle = msgspec.structs.replace(chosen.vehicle, **{**bare, **assumed, **values}, stand_ins=[*assumed])
    finding = Finding("vehicle_fitted", "warning", "vehicle", {"kind": "wheels alone", "assumed": assumed})
    findings = (*chosen.findings, finding)
    return replace(chosen, vehicle=vehicle, vehicle_source="fitted", findings=findings)
