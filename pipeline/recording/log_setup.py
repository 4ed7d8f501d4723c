"""Set-up of one log: its configuration, vehicle and topics, and what it lacks for an analysis."""

from dataclasses import dataclass, replace
from pathlib import Path

from pipeline.logs import TRANSFORM_TYPES, LogIndex, list_fields, open_log
from pipeline.recording import LogOptions, RecordingError
from pipeline.recording.log_choice import Choice, choose
from pipeline.recording.unused import list_unused
from pipeline.run import Alignment
from pipeline.sources import (
    Configuration,
    DriveForm,
    MessageType,
    Sources,
    Vehicle,
    find_pose_fields,
    find_type,
    load_configuration,
    plain_type,
)
from pipeline.stages import blame_damage

UNKNOWN = "unknown"


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


def set_up_log(path: Path, options: LogOptions, index: LogIndex | None = None) -> LogSetup:
    """Open a log and determine configuration, vehicle and topics.

    Args:
        path: the recording.
        options: options of the user.
        index: index of the log, if it has been read already.

    Raises:
        LogError: the log cannot be read.
        ConfigurationError: the configuration is wrong or the vehicle unknown.
        RecordingError: the log has no pose, or neither command nor measured wheels.
    """
    index = index or open_log(path, max_inflated=options.max_inflated)
    path = index.path
    configuration = load_configuration(
        path, given=options.config, fleet=options.fleet, overrides=options.overrides
    )
    recorded = index.deployment
    require_messages(index)
    chosen = report_unused(choose(index, configuration, options.overrides), index)
    require_sources(chosen, index, options)
    if chosen.recording is not None:
        configuration = chosen.recording.configuration
    vehicle = chosen.vehicle
    terrain = configuration.run.terrain or recorded.get("terrain") or UNKNOWN
    dataset = configuration.run.dataset or f"{vehicle.id}_{terrain}"
    return LogSetup(path, index, configuration, vehicle, terrain, dataset, chosen.sources, chosen)


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
        is_there = _may_be_named(index, "drive", "number", "numbers", "joints")
        unused = [one.text for one in chosen.findings if one.id == "numbers_not_used"]
        named = ". ".join([*(unused or [_RECORD_DRIVE]), *([named] if is_there else [])])
        hint = f"{named[0].upper()}{named[1:]}. The log has: {there}."
        raise RecordingError("no_command", what, where=str(index.path), hint=hint)


def _suggest_pose(index: LogIndex) -> str:
    """Topics whose fields look like poses, and the lines that use them; empty if there are none."""
    by_topic = {topic: find_pose_fields(topic, fields) for topic, fields in list_fields(index).items()}
    lines = [
        "{} looks like a pose, of a type that is not known; to use it, in run.toml: [pose] {}".format(
            topic,
            "; ".join(
                f'{key} = "{topic}.{path}"' for key, path in zip(("x", "y", "yaw"), three, strict=True)
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


_RECORD_POSE = "None of its topics holds any: record a localization's odometry or poses, or the transforms"


_RECORD_DRIVE = "None of its topics holds any: record the commands, or the speeds of the wheels"


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
