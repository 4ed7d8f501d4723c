"""Set-up of one log: configuration, vehicle and topics, what it lacks, and what it has of no known type."""

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import islice, product
from pathlib import Path

import msgspec
import numpy as np

from pipeline.core import SlipError, format_line, format_section
from pipeline.logs import TRANSFORM_TYPES, LogIndex, Ragged, Wanted, list_fields, open_log, read_topics
from pipeline.recording import LogOptions, RecordingError
from pipeline.recording.findings import Finding, Severity, blame_damage
from pipeline.recording.log_choice import Choice, choose
from pipeline.recording.readings import SIDES
from pipeline.recording.tape import add_lengths, measure_by_tape
from pipeline.recording.units import JOYSTICK
from pipeline.run import Alignment
from pipeline.sources import (
    COMMANDED,
    MEASURED,
    Configuration,
    ConfigurationError,
    DriveForm,
    MessageType,
    Signal,
    Sources,
    Vehicle,
    explain_unread,
    find_pose_fields,
    find_type,
    load_configuration,
    plain_type,
)

UNKNOWN = "unknown"
_OF_FIELDS = ("left_topic", "right_topic", "speed_topic", "yaw_rate_topic", "steering_topic")
"""Keys of a drive that may name a field of a topic."""


@dataclass(frozen=True)
class LogSetup:
    """Everything known about a log before its messages are read."""

    path: Path
    index: LogIndex
    configuration: Configuration
    vehicle: Vehicle
    terrain: str
    dataset: str
    sources: Sources
    choice: Choice

    @property
    def is_body_commanded(self) -> bool:
        """Whether the command is a body command, which the controller turns into wheel speeds."""
        source = self.sources.command
        return source is not None and source.form is DriveForm.BODY

    @property
    def alignment(self) -> Alignment:
        """What the examination of the log found, and how long a command is valid, of what corrects it."""
        known = None if self.choice.recording is None else self.choice.recording.alignment
        known = known or Alignment(track_multiplier=self.vehicle.controller_track_multiplier)
        return replace(known, hold_s=self.configuration.command.hold_s)

    @property
    def is_drive_alone(self) -> bool:
        """Whether measured wheels stand in for a pose that is not recorded."""
        return self.sources.pose is not None and self.sources.pose.wheels is not None


def set_up_log(path: Path, options: LogOptions) -> LogSetup:
    """Open a log and determine configuration, vehicle and topics.

    Args:
        path: the recording.
        options: options of the user.

    Raises:
        LogError: the log cannot be read.
        ConfigurationError: the configuration is wrong or the vehicle unknown.
        RecordingError: the log has no pose, or neither command nor measured wheels.
    """
    index = open_log(path, max_inflated=options.max_inflated)
    path = index.path
    configuration = load_configuration(
        path,
        given=options.config,
        fleet=options.fleet,
        listed=options.listed,
        overrides=options.overrides,
    )
    recorded = index.deployment
    require_messages(index)
    _require_elements(index, configuration)
    unread = list_unread_files(path, options)
    try:
        chosen, configuration = _choose(index, configuration, options)
    except SlipError as error:
        raise add_lengths(error, [*unread, *measure_by_tape(index, configuration)]) from None
    by_tape = measure_by_tape(index, configuration, chosen)
    chosen = replace(chosen, findings=(*unread, *chosen.findings, *by_tape))
    if chosen.recording is not None:
        configuration = chosen.recording.configuration
    vehicle = chosen.vehicle
    terrain = configuration.run.terrain or recorded.get("terrain") or UNKNOWN
    dataset = configuration.run.dataset or f"{vehicle.id}_{terrain}"
    return LogSetup(path, index, configuration, vehicle, terrain, dataset, chosen.sources, chosen)


def list_unread_files(path: Path, options: LogOptions) -> list[Finding]:
    """A finding on files beside a log that look like its configuration, and are not read; else nothing."""
    why = "" if options.config else explain_unread(path)
    return [Finding("file_not_read", "warning", "log", {"why": why})] if why else []


def _require_elements(index: LogIndex, configuration: Configuration) -> None:
    """Refuse a number of an array that no message has.

    Raises:
        ConfigurationError: ``element_not_found``.
    """
    for role, key in product(("command", "wheels"), _OF_FIELDS):
        signal = Signal.parse(getattr(getattr(configuration, role), key) or "")
        for path in signal.fields() if signal.topic in index.topics() else ():
            name, _, number = path.removesuffix("]").partition("[")
            count = _count_elements(index, signal.topic, name) if number.isdecimal() else 0
            if 0 < count <= int(number or 0):
                what = f"{key} = {signal} under [{role}], but {name} of {signal.topic} has {count} numbers"
                hint = f"They are counted from 0: the last one is {name}[{count - 1}]."
                raise ConfigurationError("element_not_found", what, where=str(index.path), hint=hint)


def _count_elements(index: LogIndex, topic: str, field: str) -> int:
    """Most elements that a message has in a field; zero of a field that is no array."""
    read = read_topics(index, [Wanted(topic, (field,))], sha256="unused", skip_unfit=True).topics
    columns = [column for one in read if isinstance(column := one.fields.get(field), Ragged)]
    return max((int(np.diff(one.offsets).max(initial=0)) for one in columns), default=0)


def _choose(
    index: LogIndex, configuration: Configuration, options: LogOptions
) -> tuple[Choice, Configuration]:
    """Vehicle and sources, and the configuration with what their names show."""
    chosen = choose(index, configuration, options.overrides)
    sides = _find_only_sides(index, chosen.sources)
    if sides is not None:
        left, right = sides.left, sides.right
        wheels = msgspec.structs.replace(configuration.wheels, left_topic=left, right_topic=right)
        configuration = msgspec.structs.replace(configuration, wheels=wheels)
        taken = choose(index, configuration, options.overrides)
        values = {"left": left, "right": right}
        finding = Finding("sides_by_name", "warning", sides.topic, values)
        chosen = replace(taken, findings=(*taken.findings, finding))
    chosen = report_unused(chosen, index)
    require_sources(chosen, index, options)
    return chosen, configuration


def report_unused(chosen: Choice, index: LogIndex) -> Choice:
    """The choice with findings on what might be wheels or commands, and is not used."""
    return replace(chosen, findings=(*chosen.findings, *list_unused(index, chosen.sources)))


def require_messages(index: LogIndex) -> None:
    """Refuse a log without any message that can be read.

    Raises:
        RecordingError: ``log_without_messages``.
    """
    if not index.channels:
        what = "no message of the log can be read" if index.losses else "the log holds no message"
        hint = "Check that the recording was not cut off before its first message."
        what += blame_damage(index.losses)
        raise RecordingError("log_without_messages", what, where=str(index.path), hint=hint)


def require_sources(chosen: Choice, index: LogIndex, options: LogOptions) -> None:
    """Refuse a log without a pose, or without any of the inputs that are asked for.

    Raises:
        RecordingError: ``no_pose``, ``no_command``.
    """
    sources = chosen.sources
    topics = {channel.topic: f"{channel.topic} ({channel.type_name})" for channel in index.channels}
    empty = {channel.topic for channel in index.channels if channel.message_count == 0}
    there = ", ".join(text for topic, text in sorted(topics.items()) if topic not in empty)
    there += f". Without any message: {', '.join(sorted(empty))}" if empty else ""
    if sources.pose is None:
        what = "no topic can serve as pose (an odometry, a pose, or transforms)" + blame_damage(index.losses)
        what += _describe_stand_in(sources, index)
        named = "Name it in run.toml ([pose] topic = ...)"
        named = named if _may_be_named(index, "pose", "fix") else _suggest_pose(index) or _RECORD_POSE
        hint = f"{named}. The log has: {there}."
        raise RecordingError("no_pose", what, where=str(index.path), hint=hint)
    if sources.pose.wheels is not None and "command" not in options.inputs:
        what = f"the log holds no pose: its wheels ({sources.pose.wheels}) stand in for it, and are no input"
        hint = "Analyze what the wheels do with the commands: --input command; or record a localization."
        raise RecordingError("no_pose", what, where=str(index.path), hint=hint)
    wanted = {"command": sources.command, "measured": sources.wheels}
    if all(wanted[name] is None for name in options.inputs):
        roles = " or ".join("command" if name == "command" else "measured wheels" for name in options.inputs)
        what = f"no topic can serve as {roles}{blame_damage(index.losses)}"
        named = "Name it in run.toml ([command] topic = ..., or left_topic and right_topic)"
        findings = [one for one in chosen.findings if one.id == "numbers_not_used"]
        unused = [f"not used: {one.values['what']}" for one in findings]
        # Joints that are no drive by their content are none by being named.
        unusable = {
            one.where for one in findings if find_type(index.types.get(one.where, "")).joints is not None
        }
        rest = tuple(one for one in index.channels if one.topic not in unusable)
        is_there = _may_be_named(replace(index, channels=rest), "drive", "number", "numbers", "joints")
        named = ". ".join([*(unused or [_RECORD_DRIVE]), *([named] if is_there else [])])
        hint = f"{named[0].upper()}{named[1:]}. The log has: {there}."
        raise RecordingError("no_command", what, where=str(index.path), hint=hint)


def _suggest_pose(index: LogIndex) -> str:
    """Topics whose fields look like poses, and the lines that use them; empty if there are none."""
    by_topic = {
        topic: find_pose_fields(topic, fields)
        for topic, fields in list_fields(index).items()
        if plain_type(index.types[topic]).partition("/")[0] not in _KNOWN_PACKAGES
    }
    lines = [
        "{} looks like a pose, of a type that is not known; to use it, in run.toml: {}".format(
            topic,
            format_section(
                "pose",
                [f'{key} = "{topic}.{path}"' for key, path in zip(("x", "y", "yaw"), three, strict=True)],
            ),
        )
        for topic, three in sorted(by_topic.items())
        if three is not None and three[2]
    ]
    positions = [
        f"{topic} has positions ({three[0]}, {three[1]}) of a type that is not known, and no heading in one "
        "field: publish them as geometry_msgs/PoseStamped"
        for topic, three in sorted(by_topic.items())
        if three is not None and not three[2]
    ]
    return ". ".join(lines or positions)


def _describe_stand_in(sources: Sources, index: LogIndex) -> str:
    """What a log without poses lacks for a diagnosis of its drive alone."""
    if sources.command is None and sources.wheels is None:
        return ""
    if sources.wheels is None:
        return f", and the log has commands without measured wheels: {_WITH_BOTH}"
    if sources.command is None:
        return f", and the log has measured wheels without commands: {_WITH_BOTH}"
    silent = [
        channel.topic
        for channel in index.channels
        if not channel.message_count
        and (
            plain_type(channel.type_name) in TRANSFORM_TYPES or find_type(channel.type_name).pose is not None
        )
    ]
    if silent:
        return f", and {', '.join(sorted(silent))} is without any message"
    why = "they do not turn, or give no motion"
    return f", and its measured wheels ({sources.wheels}) cannot stand in for it: {why}"


_WITH_BOTH = "with both, the drive alone could be diagnosed"


_RECORD_POSE = "None of its topics holds poses: record a localization's odometry or poses, or the transforms"


_RECORD_DRIVE = "None of its topics holds a drive: record the commands, or the speeds of the wheels"


_KNOWN_PACKAGES = (
    "actionlib_msgs", "diagnostic_msgs", "foxglove", "foxglove_msgs", "geometry_msgs", "nav_msgs",
    "rcl_interfaces", "rosgraph_msgs", "sensor_msgs", "std_msgs", "visualization_msgs",
)  # fmt: skip
"""Packages whose usable message types are all known."""


def _may_be_named(index: LogIndex, *parts: str) -> bool:
    """Whether a topic with messages has a type that may contain one of the parts, so that it can be named."""
    types = {plain_type(channel.type_name) for channel in index.channels if channel.message_count}
    if "pose" in parts and types.intersection(TRANSFORM_TYPES):
        return True
    # Single fields of any type can be named as signals of a drive; those of a pose are looked for by name.
    strange = "number" in parts and any(
        find_type(name) == MessageType() and name.partition("/")[0] not in _KNOWN_PACKAGES
        and name not in TRANSFORM_TYPES
        for name in types
    )  # fmt: skip
    return strange or any(getattr(find_type(name), part) is not None for name in types for part in parts)


# Numbers that may be the wheels or the command of a log, of types that do not say so: how to use them.

_RIGHT_OF: Mapping[str, str] = {
    "left": "right", "port": "starboard", "l": "r",
    "fl": "fr", "rl": "rr", "bl": "br", "lf": "rf", "lr": "rr",
}  # fmt: skip
"""The word of the right side for one of the left."""
_LEFT = re.compile(
    r"(?i:left)|(?<![A-Za-z])(?i:port|fl|rl|bl|lf|lr|l)(?![A-Za-z])|(?<![A-Za-z])[lL](?=(?i:wheel|motor|enc))"
    r"|(?<=[a-z])(?:FL|RL|BL|LF|LR|L)(?![A-Za-z])"
)
_AHEAD = re.compile(r"front|(?<![a-z])(?:fl|lf)(?![a-z])")
_OF_A_WHEEL = re.compile("wheel|motor|rpm|tick|enc|count|speed|vel|pwm|duty|throttle")
_NOT_OF_TURNING = re.compile("curr|volt|temp|torque|effort|error|fault|power|status|radius|diameter|pressure")
_COMMANDED = re.compile(COMMANDED.pattern + "|pwm|duty|throttle")
_SPEED = re.compile(r"^(speed|velocity|linear(_velocity|_speed|_x)?|forward(_speed)?|v|vx|v_x|throttle)$")
_TURN = re.compile(r"^(yaw_?rate|turn_?rate|omega|angular(_velocity|_speed|_z)?|turn|w|wz|w_z)$")
_STEER = re.compile(r"^(steering(_angle)?|steer|delta)$")
_UNITS: Mapping[str, tuple[tuple[str, ...], str]] = {
    "tick|count|enc": (('unit = "ticks"', "per_turn = 1000"), " (ticks of a whole turn)"),
    "rpm": (('unit = "rpm"',), ""),
}
_ANY_UNIT = ' (the motion shows their unit; unit = "rad/s", "m/s", "rpm" or "rad" gives it)'
_AXES = {"speed_topic": 1, "yaw_rate_topic": 0}
_WHEELS = {2: "two", 4: "four", 6: "six"}
"""Numbers of wheels of a vehicle that turns by the speeds of its sides."""
_SEVERAL = (
    "wheels of both sides (put the number of a left one for 0 and that of a right one for 1, counted from 0)"
)
_MOST = 3
"""Maximum number of lines that are offered for a role."""


def list_unused(index: LogIndex, sources: Sources) -> list[Finding]:
    """Findings on numbers that may be wheels or a command where the log has none, or on pairs of numbers."""
    drives = [drive for drive in (sources.command, sources.wheels) if drive is not None]
    used = {signal.topic for drive in drives for signal in drive.signals}
    findings = _list_pairs(index, sources, used)
    if sources.wheels is not None and sources.command is not None:
        return findings
    unknown = _list_unknown(index, used)
    missing = {role for role in ("command", "wheels") if getattr(sources, role) is None}
    sides = list(_find_sides(unknown))
    for role in sorted(missing):
        findings += islice((_offer(one) for one in sides if one.role == role), _MOST)
    if "command" in missing:
        findings += islice(_list_commands(unknown, index), _MOST)
    return findings


def _list_pairs(index: LogIndex, sources: Sources, used: Collection[str]) -> list[Finding]:
    """Messages of a number a wheel, as two of a left and a right one."""
    fields = {
        topic: numbers.field
        for topic, kind in index.types.items()
        if topic not in used and (numbers := find_type(kind).numbers) is not None
    }
    wanted = [Wanted(topic, (field,)) for topic, field in fields.items()]
    findings = []
    for columns in read_topics(index, wanted, sha256="unused", skip_unfit=True).topics if wanted else ():
        topic, field = columns.topic, fields[columns.topic]
        column = columns.fields.get(field)
        values = column.fixed() if isinstance(column, Ragged) else None
        count = 0 if values is None else values.shape[1]
        is_side = count == len(SIDES) or (count in _WHEELS and _OF_A_WHEEL.search(topic.lower()))
        if values is None or not is_side or not np.ptp(values, axis=0).all():
            continue
        role = "command" if COMMANDED.search(topic.lower()) else "wheels"
        topics = [
            format_line(f"{side}_topic", f"{topic}.{field}[{number}]") for number, side in enumerate(SIDES)
        ]
        line = format_section(role, topics)
        what = (
            f"{topic} ({_WHEELS[count]} numbers a message), whose meaning is not known; if they are "
            f"{'the left and right wheels' if count == len(SIDES) else _SEVERAL}, in run.toml: "
            f"{line}{_ANY_UNIT}"
        )
        severity: Severity = "info" if getattr(sources, role) else "warning"
        findings.append(Finding("numbers_not_used", severity, topic, {"what": what}))
    return findings


@dataclass(frozen=True)
class _Sides:
    """Numbers named as those of left and right wheels: their topic, paths, and the likeliest role."""

    topic: str
    left: str
    right: str
    role: str


def _list_unknown(index: LogIndex, used: Collection[str]) -> dict[str, Collection[str]]:
    """Fields of the topics of unknown types."""
    return {
        topic: paths
        for topic, paths in list_fields(index).items()
        if topic not in used and find_type(index.types.get(topic, "")) == MessageType()
    }


def _find_sides(unknown: Mapping[str, Collection[str]]) -> Iterator[_Sides]:
    numbers = {f"{topic}.{path}": topic for topic, paths in unknown.items() for path in paths}
    for left, topic in numbers.items():
        right, lower = _LEFT.sub(_name_right, left), left.lower()
        if right == left or right not in numbers or _NOT_OF_TURNING.search(lower):
            continue
        if _OF_A_WHEEL.search(lower):
            is_command = _COMMANDED.search(lower) and not MEASURED.search(lower)
            yield _Sides(topic, left, right, "command" if is_command else "wheels")


def _find_only_sides(index: LogIndex, sources: Sources) -> _Sides | None:
    """The one pair that may be the wheels of a log without any drive; both axles of one topic are a pair."""
    if sources.command is not None or sources.wheels is not None or sources.pose is None:
        return None
    pairs = [one for one in _find_sides(_list_unknown(index, ())) if one.role == "wheels"]
    axles = {one.topic for one in pairs}, {bool(_AHEAD.search(one.left.lower())) for one in pairs}
    if len(pairs) == len(SIDES) and [len(some) for some in axles] == [1, 2]:
        (one, other), (topic,) = pairs, axles[0]
        left, right = (
            f"{first}+{second.removeprefix(f'{topic}.')}"
            for first, second in ((one.left, other.left), (one.right, other.right))
        )
        return _Sides(topic, left, right, "wheels")
    return pairs[0] if len(pairs) == 1 else None


def _offer(sides: _Sides) -> Finding:
    """The line that takes numbers for a role."""
    unit, about = next(
        (of for word, of in _UNITS.items() if re.search(word, sides.left.lower())), ((), _ANY_UNIT)
    )
    topics = (format_line("left_topic", sides.left), format_line("right_topic", sides.right))
    what = (
        f"{sides.left} and {sides.right}, whose meaning is not known; if they are the left and "
        f"right wheels, in run.toml: {format_section(sides.role, (*topics, *unit))}{about}"
    )
    return Finding("numbers_not_used", "warning", sides.topic, {"what": what})


def _name_right(match: re.Match[str]) -> str:
    word = match[0]
    right = _RIGHT_OF[word.lower()]
    return right.upper() if word.isupper() else right.capitalize() if word[0].isupper() else right


def _list_commands(unknown: Mapping[str, Collection[str]], index: LogIndex) -> Iterator[Finding]:
    """Messages with a speed and a turn that may be a command, and joysticks."""
    for topic, paths in unknown.items():
        if MEASURED.search(topic.lower()):
            continue
        if plain_type(index.types[topic]) == JOYSTICK:
            axes = [format_line(key, f"{topic}.axes[{one}]") for key, one in _AXES.items()]
            what = (
                f"{topic} (a joystick); if two of its axes are the command, in run.toml: "
                f"{format_section('command', axes)} (which axes, the set-up of its driver says)"
            )
            yield Finding("numbers_not_used", "warning", topic, {"what": what})
            continue
        ends = {path: path.rpartition(".")[2].lower() for path in paths}
        speeds = [path for path, end in ends.items() if _SPEED.search(end)]
        turns = [("yaw_rate_topic", path) for path, end in ends.items() if _TURN.search(end)]
        turns += [("steering_topic", path) for path, end in ends.items() if _STEER.search(end)]
        if speeds and turns:
            key, turn = turns[0]
            lines = (format_line("speed_topic", f"{topic}.{speeds[0]}"), format_line(key, f"{topic}.{turn}"))
            what = (
                f"{topic} (a speed and a turn), whose meaning is not known; if it is the command, "
                f"in run.toml: {format_section('command', lines)}"
            )
            yield Finding("numbers_not_used", "warning", topic, {"what": what})
