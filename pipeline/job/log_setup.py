"""Set-up of one log: configuration, vehicle and topics; inspection of its content and health."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.core.arrays import Ints
from pipeline.core.program import SlipError
from pipeline.job import JobError, Options
from pipeline.job.log_choice import UNKNOWN_VEHICLE, Choice, choose
from pipeline.logs import ChannelInfo, LogIndex, Loss, Wanted, open_log, read_topics, spell_location
from pipeline.sources import (
    Configuration,
    DriveForm,
    Sources,
    Vehicle,
    choose_sources,
    find_preset,
    load_configuration,
)
from pipeline.sources.message_types import MessageType, find_type, plain_type
from pipeline.sources.topics import TRANSFORM_TYPES
from pipeline.stages import blame_damage
from pipeline.store import Store

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


def set_up_log(path: Path, options: Options, index: LogIndex | None = None) -> LogSetup:
    """Open a log and determine configuration, vehicle and topics.

    Args:
        path: the recording.
        options: options of the user.
        index: index of the log, if it has been read already.

    Raises:
        LogError: the log cannot be read.
        ConfigurationError: the configuration is wrong or the vehicle unknown.
        JobError: the log has no pose, or neither command nor measured wheels.
    """
    index = index or open_log(path, max_inflated=options.max_inflated)
    path = index.path
    configuration = load_configuration(
        path, given=options.config, fleet=options.fleet, overrides=options.overrides
    )
    recorded = index.deployment
    if not index.channels:
        what = "no message of the log can be read" if index.losses else "the log holds no message"
        hint = "Check that the recording was not cut off before its first message."
        what += blame_damage(index.losses)
        raise JobError("log_without_messages", what, where=str(path), hint=hint)
    chosen = choose(index, configuration, options.overrides)
    _require_sources(chosen.sources, index, options)
    vehicle = chosen.vehicle
    terrain = configuration.run.terrain or recorded.get("terrain") or UNKNOWN
    dataset = configuration.run.dataset or f"{vehicle.id}_{terrain}"
    return LogSetup(path, index, configuration, vehicle, terrain, dataset, chosen.sources, chosen)


def _require_sources(sources: Sources, index: LogIndex, options: Options) -> None:
    topics = {channel.topic: f"{channel.topic} ({channel.type_name})" for channel in index.channels}
    empty = {channel.topic for channel in index.channels if channel.message_count == 0}
    there = ", ".join(text for topic, text in sorted(topics.items()) if topic not in empty)
    there += f". Without any message: {', '.join(sorted(empty))}" if empty else ""
    if sources.pose is None:
        what = "no topic can serve as pose (an odometry, a pose, or transforms)" + blame_damage(index.losses)
        named = "Name it in run.toml ([pose] topic = ...)"
        hint = f"{named if _may_be_named(index, 'pose', 'fix') else _RECORD_POSE}. The log has: {there}."
        raise JobError("no_pose", what, where=str(index.path), hint=hint)
    wanted = {"command": sources.command, "measured": sources.wheels}
    if all(wanted[name] is None for name in options.inputs):
        roles = " or ".join("command" if name == "command" else "measured wheels" for name in options.inputs)
        what = f"no topic can serve as {roles}{blame_damage(index.losses)}"
        named = "Name it in run.toml ([command] topic = ..., or left_topic and right_topic)"
        is_there = _may_be_named(index, "drive", "number", "joints")
        hint = f"{named if is_there else _RECORD_DRIVE}. The log has: {there}."
        raise JobError("no_command", what, where=str(index.path), hint=hint)


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
    # Single fields of any type can be named as signals of a drive, but not of a pose.
    strange = "number" in parts and any(
        find_type(name) == MessageType() and name.partition("/")[0] not in _KNOWN_PACKAGES
        and name not in TRANSFORM_TYPES
        for name in types
    )  # fmt: skip
    return strange or any(getattr(find_type(name), part) is not None for name in types for part in parts)


def name_plainly(path: Path) -> str:
    r"""Name of the run of a log unless another run has it: folder/stem.

    Bytes of a file name that are not UTF-8 are written as ``\xe9``.
    """
    name = f"{path.parent.name}/{path.stem}" if path.parent.name else path.stem
    return os.fsencode(name).decode("utf-8", "backslashreplace")


def name_run(path: Path, sha256: str, store: Store) -> str:
    """Name of the run of a log: folder/stem, with eight digits of its hash if another run has that name.

    Logs of equal content share a run: a copy of a log that has results gets the name of its run.
    """
    absolute = path.resolve()
    plain = name_plainly(absolute)
    manifest = store.manifest(plain)
    if manifest is None:
        for known in store.survey().manifests:
            if known.part("log").get("sha256") == sha256:
                return known.run
        return plain
    before = manifest.part("log")
    if before.get("sha256") == sha256 or before.get("path") == spell_location(absolute):
        return plain
    return f"{plain}-{sha256[:8]}"


_GAP_PERIODS = 3.0
_SMALLEST_GAP_S = 0.12


@dataclass(frozen=True)
class TopicHealth:
    """Timing of one channel.

    Attributes:
        topic: name.
        type_name: message type.
        messages: number of messages.
        rate_hz: inverse of the median period of log times; None with fewer than two messages.
        largest_gap_s: longest time between two messages.
        gaps: intervals between messages longer than three periods (and 0.12 s).
        latency_s: median of log time minus header stamp; None without stamps.
    """

    topic: str
    type_name: str
    messages: int
    rate_hz: float | None = None
    largest_gap_s: float | None = None
    gaps: int = 0
    latency_s: float | None = None


@dataclass(frozen=True)
class Inspection:
    """Health of a log: index, topics, losses, data without checksum, and the topics that would be used."""

    index: LogIndex
    topics: tuple[TopicHealth, ...]
    losses: tuple[Loss, ...]
    notes: tuple[str, ...]
    choice: Choice | None
    problem: str
    unchecked: str = ""

    @property
    def vehicle(self) -> Vehicle | None:
        """The vehicle; None if it is unknown."""
        known = self.choice is not None and not self.problem and self.choice.vehicle.id != UNKNOWN_VEHICLE
        return self.choice.vehicle if known and self.choice is not None else None

    @property
    def sources(self) -> Sources | None:
        """Topics that would be used; None if they cannot be chosen."""
        return self.choice.sources if self.choice is not None else None


def inspect_log(
    path: Path, *, config: Path | None, overrides: Mapping[str, object], max_inflated: int | None = None
) -> Inspection:
    """Inspect a log.

    Args:
        path: the recording.
        config: configuration file to use instead of the one beside the log.
        overrides: configuration values from the command line, nested like the file.
        max_inflated: limit of the decompressed size of its chunks [bytes]; None for one by its file size.

    Raises:
        LogError: the log cannot be read.
        ConfigurationError: the configuration is wrong.
    """
    index = open_log(path, max_inflated=max_inflated)
    configuration = load_configuration(path, given=config, overrides=overrides)
    channels = [channel for channel in index.channels if channel.message_count]
    data = read_topics(index, [Wanted(topic, ()) for topic in dict.fromkeys(c.topic for c in channels)])
    times = {columns.channel_id: (columns.log_time, columns.header_time) for columns in data.topics}
    topics = tuple(
        _measure_topic(channel, *times.get(channel.id, (np.zeros(0, dtype=np.int64), None)))
        for channel in index.channels
    )
    choice, problem = _choose(index, configuration, overrides)
    notes = data.notes + tuple(
        f"{count} messages of {topic} are byte-for-byte copies of others: each counts once"
        for topic, count in data.repeated.items()
    )
    return Inspection(index, topics, data.losses, notes, choice, problem, data.unchecked)


def _measure_topic(channel: ChannelInfo, log_time: Ints, header_time: Ints | None) -> TopicHealth:
    plain = TopicHealth(channel.topic, channel.type_name, channel.message_count)
    if log_time.size < 2:  # noqa: PLR2004 - one message has no rate
        return plain
    periods = np.diff(np.sort(log_time)).astype(np.float64) / 1e9
    median = float(np.median(periods))
    latency = None
    if header_time is not None and header_time.any():
        latency = float(np.median(log_time - header_time)) / 1e9
    return replace(
        plain,
        rate_hz=1.0 / median if median > 0.0 else None,
        largest_gap_s=float(periods.max()),
        gaps=int((periods > max(_GAP_PERIODS * median, _SMALLEST_GAP_S)).sum()),
        latency_s=latency,
    )


def _choose(
    index: LogIndex, configuration: Configuration, overrides: Mapping[str, object]
) -> tuple[Choice | None, str]:
    """Vehicle and sources as an analysis would choose them; an error is returned as text, not raised."""
    try:
        return choose(index, configuration, overrides), ""
    except SlipError as error:
        problem = str(error)
    # The choice of topics hardly depends on the vehicle: any differential one replaces an unknown one.
    stand_in = find_preset("husky_a200")
    if stand_in is None:
        return None, problem
    try:
        sources = choose_sources(index.channels, configuration, stand_in, where=str(index.path))
    except SlipError:
        return None, problem
    return Choice(stand_in, "fitted", sources), problem
