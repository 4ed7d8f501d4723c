"""Look-up of logs and runs, set-up of one log (configuration, vehicle, topics), and keys of stages."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from pipeline.core import SlipError, guess_names
from pipeline.core.arrays import PAUSE_NS, Flags, Floats, Ints
from pipeline.job import ANALYZE_FIRST, STAGES, JobError, Options
from pipeline.logs import (
    TRANSFORM_TYPES,
    ChannelInfo,
    LogIndex,
    Loss,
    Ragged,
    RemotePath,
    Wanted,
    list_fields,
    locate_recorded,
    open_log,
    read_topics,
    spell_location,
    stem_of,
    to_location,
)
from pipeline.recording.log_choice import UNKNOWN_VEHICLE, Choice, choose, make_stand_in
from pipeline.run import Alignment
from pipeline.sources import (
    Configuration,
    DriveForm,
    Sources,
    Vehicle,
    choose_sources,
    load_configuration,
)
from pipeline.sources.candidates import COMMANDED
from pipeline.sources.message_types import MessageType, describe_types, find_type, plain_type
from pipeline.sources.topics import find_pose_fields
from pipeline.stages import Finding, Severity, blame_damage
from pipeline.stages.clocks import describe_pauses, find_pauses
from pipeline.store import Manifest, Store

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
    _require_messages(index)
    chosen = choose(index, configuration, options.overrides)
    _require_sources(chosen.sources, index, options)
    if chosen.recording is not None:
        configuration = chosen.recording.configuration
    chosen = _report_unused(chosen, index)
    vehicle = chosen.vehicle
    terrain = configuration.run.terrain or recorded.get("terrain") or UNKNOWN
    dataset = configuration.run.dataset or f"{vehicle.id}_{terrain}"
    return LogSetup(path, index, configuration, vehicle, terrain, dataset, chosen.sources, chosen)


def _report_unused(chosen: Choice, index: LogIndex) -> Choice:
    """The choice with findings on what might be wheels or commands, and is not used."""
    return replace(chosen, findings=(*chosen.findings, *_list_unused(index, chosen.sources)))


def _list_unused(index: LogIndex, sources: Sources) -> list[Finding]:
    """Findings on numbers that may be those of a left and a right wheel, and whose type does not say so."""
    drives = [drive for drive in (sources.command, sources.wheels) if drive is not None]
    used = {signal.topic for drive in drives for signal in drive.signals}
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
        if values is None or values.shape[1] != 2 or not np.ptp(values, axis=0).all():  # noqa: PLR2004 - two sides
            continue
        role = "command" if COMMANDED.search(topic.lower()) else "wheels"
        text = (
            f"not used: {topic} (two numbers a message), whose meaning is not known; if they are the left "
            f'and right wheels, in run.toml: [{role}] left_topic = "{topic}.{field}[0]"; '
            f'right_topic = "{topic}.{field}[1]"; unit = "rad/s" (or "m/s", "rpm", "rad")'
        )
        severity: Severity = "info" if getattr(sources, role) else "warning"
        findings.append(Finding("numbers_not_used", severity, text, where=topic))
    return findings if sources.wheels is not None else [*findings, *_list_sides(index, used)]


_OF_A_WHEEL = re.compile("wheel|motor|rpm|tick|encoder|count|speed|vel")
_MOST_SIDES = 3
"""Maximum number of pairs that are named."""


def _list_sides(index: LogIndex, used: Collection[str]) -> Iterator[Finding]:
    """Findings on pairs of numbers that are named as those of left and right wheels, of unknown types."""
    unknown = {
        topic: paths
        for topic, paths in list_fields(index).items()
        if topic not in used and find_type(index.types.get(topic, "")) == MessageType()
    }
    numbers = {f"{topic}.{path}": topic for topic, paths in unknown.items() for path in paths}
    pairs = ((left, left.replace("left", "right")) for left in numbers if "left" in left)
    named = ((left, right) for left, right in pairs if right in numbers and _OF_A_WHEEL.search(left.lower()))
    for left, right in islice(named, _MOST_SIDES):
        text = (
            f"not used: {left} and {right}, whose meaning is not known; if they are the left and right "
            f'wheels, in run.toml: [wheels] left_topic = "{left}"; right_topic = "{right}"; unit = "rad/s" '
            '(or "m/s", "rpm", "rad", "ticks" with per_turn)'
        )
        yield Finding("numbers_not_used", "warning", text, where=numbers[left])


def _require_messages(index: LogIndex) -> None:
    if not index.channels:
        what = "no message of the log can be read" if index.losses else "the log holds no message"
        hint = "Check that the recording was not cut off before its first message."
        what += blame_damage(index.losses)
        raise JobError("log_without_messages", what, where=str(index.path), hint=hint)


def _require_sources(sources: Sources, index: LogIndex, options: Options) -> None:
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
        raise JobError("no_pose", what, where=str(index.path), hint=hint)
    if sources.pose.wheels is not None and "command" not in options.inputs:
        what = f"the log holds no pose: its wheels ({sources.pose.wheels}) stand in for it, and are no input"
        hint = "Analyze what the wheels do with the commands: --input command; or record a localization."
        raise JobError("no_pose", what, where=str(index.path), hint=hint)
    wanted = {"command": sources.command, "measured": sources.wheels}
    if all(wanted[name] is None for name in options.inputs):
        roles = " or ".join("command" if name == "command" else "measured wheels" for name in options.inputs)
        what = f"no topic can serve as {roles}{blame_damage(index.losses)}"
        named = "Name it in run.toml ([command] topic = ..., or left_topic and right_topic)"
        is_there = _may_be_named(index, "drive", "number", "numbers", "joints")
        hint = f"{named if is_there else _RECORD_DRIVE}. The log has: {there}."
        raise JobError("no_command", what, where=str(index.path), hint=hint)


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


def name_plainly(path: Path) -> str:
    r"""Name of the run of a log unless another run has it: folder/stem.

    Bytes of a file name that are not UTF-8 are written as ``\xe9``.
    """
    stem = stem_of(path)
    name = f"{path.parent.name}/{stem}" if path.parent.name else stem
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
        messages: number of messages that can be read; of an encoding that cannot be read, those of the index.
        messages_stated: number of messages that the index of the log states.
        rate_hz: messages per second without the gaps; None with fewer than two messages.
        largest_gap_s: longest time between two messages.
        gaps: intervals between messages longer than three periods (and 0.12 s).
        latency_s: median of log time minus header stamp; None without stamps.
    """

    topic: str
    type_name: str
    messages: int
    messages_stated: int
    rate_hz: float | None = None
    largest_gap_s: float | None = None
    gaps: int = 0
    latency_s: float | None = None


@dataclass(frozen=True)
class Inspection:
    """Health of a log: index, topics, losses, data without checksum, topics to use, and why it is refused.

    Its duration does not count the silences of a clock that was set, see `clocks.find_pauses`.
    """

    index: LogIndex
    topics: tuple[TopicHealth, ...]
    losses: tuple[Loss, ...]
    notes: tuple[str, ...]
    choice: Choice | None
    problem: SlipError | None
    unchecked: str = ""
    duration_s: float = 0.0

    @property
    def messages(self) -> int:
        """Number of messages of all topics that can be read."""
        return sum(topic.messages for topic in self.topics)

    @property
    def vehicle(self) -> Vehicle | None:
        """The vehicle; None if it is unknown."""
        known = None if self.choice is None else self.choice.vehicle
        return known if known is not None and known.id != UNKNOWN_VEHICLE else None

    @property
    def sources(self) -> Sources | None:
        """Topics that would be used; None if they cannot be chosen."""
        return self.choice.sources if self.choice is not None else None


def inspect_log(path: Path, options: Options) -> Inspection:
    """Inspect a log.

    Args:
        path: the recording.
        options: options of the user.

    Raises:
        LogError: the log cannot be read.
        ConfigurationError: the configuration is wrong.
    """
    index = open_log(path, max_inflated=options.max_inflated)
    configuration = load_configuration(path, given=options.config, overrides=options.overrides)
    channels = [channel for channel in index.channels if channel.message_count]
    data = read_topics(index, [Wanted(topic, ()) for topic in dict.fromkeys(c.topic for c in channels)])
    times = {columns.channel_id: (columns.log_time, columns.header_time) for columns in data.topics}
    topics = tuple(
        _measure_topic(channel, data.readable, *times.get(channel.id, (np.zeros(0, dtype=np.int64), None)))
        for channel in index.channels
    )
    choice, problem = _choose(index, configuration, options)
    pauses = find_pauses(log_time for log_time, _ in times.values())
    notes = (
        *data.notes,
        *([describe_pauses(pauses)] if pauses else []),
        *(
            f"{count} messages of {topic} are byte-for-byte copies of others: duplicates are ignored"
            for topic, count in data.repeated.items()
        ),
    )
    duration_s = index.duration_s - sum(after - last for last, after in pauses) / 1e9
    return Inspection(index, topics, data.losses, notes, choice, problem, data.unchecked, duration_s)


def _measure_topic(
    channel: ChannelInfo, readable: Mapping[int, int], log_time: Ints, header_time: Ints | None
) -> TopicHealth:
    stated = channel.message_count
    plain = TopicHealth(channel.topic, channel.type_name, readable.get(channel.id, stated), stated)
    if log_time.size < 2:  # noqa: PLR2004 - one message has no rate
        return plain
    periods = np.diff(np.sort(log_time)).astype(np.float64) / 1e9
    median = float(np.median(periods))
    gaps = periods > max(_GAP_PERIODS * median, _SMALLEST_GAP_S)
    latency = None
    if header_time is not None and header_time.any():
        latency = float(np.median(log_time - header_time)) / 1e9
    return replace(
        plain,
        rate_hz=_measure_rate(periods, gaps),
        largest_gap_s=float(periods.max()),
        gaps=int(gaps.sum()),
        latency_s=latency,
    )


def _measure_rate(periods: Floats, gaps: Flags) -> float | None:
    """Messages per second without the gaps [Hz]; with them where they are most of the time; None of none.

    Silences of a clock that was set are no time in which messages were missing.
    """
    recorded = periods * 1e9 <= PAUSE_NS
    periods, gaps = periods[recorded], gaps[recorded]
    between = periods if periods[gaps].sum() > 0.5 * periods.sum() else periods[~gaps]
    seconds = float(between.sum())
    return between.size / seconds if seconds > 0.0 else None


def _choose(
    index: LogIndex, configuration: Configuration, options: Options
) -> tuple[Choice | None, SlipError | None]:
    """Vehicle and sources as an analysis chooses them; its error is returned, not raised."""
    chosen: Choice | None = None
    try:
        _require_messages(index)
        chosen = choose(index, configuration, options.overrides)
        _require_sources(chosen.sources, index, options)
    except SlipError as error:
        return chosen or _choose_by_name(index, configuration), error
    return _report_unused(chosen, index), None


def _choose_by_name(index: LogIndex, configuration: Configuration) -> Choice | None:
    """Sources of a log whose vehicle is unknown; None if they cannot be chosen."""
    stand_in = make_stand_in(index, configuration)
    try:
        sources = choose_sources(index.channels, configuration, stand_in, where=str(index.path))
    except SlipError:
        return None
    return Choice(stand_in, "fitted", sources)


def find_run(text: str, store: Store) -> Manifest:
    """The current results of a run, by its name, its stem, or the path of its log.

    Raises:
        JobError: no run matches, or several runs do.
    """
    survey = store.survey()
    manifests = survey.manifests
    if not manifests:
        unread = f"; {len(survey.errors)} cannot be read" if survey.errors else ""
        gone = "" if store.root.exists() else " (the folder of results does not exist)"
        what = f"{text!r} is neither a log nor a run: no run has been analyzed yet{gone}{unread}"
        raise JobError("no_such_run", what, where=str(store.root), hint=ANALYZE_FIRST)
    path = spell_location(Path(text).resolve())
    fitting = [
        manifest
        for manifest in manifests
        if text in {manifest.run, manifest.run.rsplit("/", 1)[-1]} or recorded_path(manifest) == path
    ]
    if len(fitting) == 1:
        return fitting[0]
    names = ", ".join(manifest.run for manifest in (fitting or manifests))
    what = f"several runs are called {text!r}" if fitting else f"there is no run {text!r}"
    known = [manifest.run if "/" in text else manifest.run.rsplit("/", 1)[-1] for manifest in manifests]
    near = "" if fitting else guess_names(text, dict.fromkeys(known))
    hint = f"Say which of: {names}." if fitting else f"{near}There are: {names}."
    raise JobError("no_such_run", what, where=str(store.root), hint=hint)


def find_log(text: str, out: Path) -> Path:
    """The log that a user refers to by its path or by the name of a run that has results.

    Raises:
        JobError: neither matches, or the run's log no longer exists.
        LogError: as `find_recorded_log`.
    """
    path = to_location(text)
    if isinstance(path, RemotePath) or path.exists() or path.suffix:
        return path
    return find_recorded_log(find_run(text, Store(out)), hint="Give the path it has now.")


def find_recorded_log(manifest: Manifest, *, hint: str) -> Path:
    """The log of a run.

    Args:
        manifest: manifest of the run.
        hint: hint of the error if the log no longer exists.

    Raises:
        JobError: ``log_gone``.
        LogError: ``remote_not_followed``, ``no_object_store``.
    """
    log = locate_recorded(recorded_path(manifest))
    if not log.exists():
        raise JobError("log_gone", "the log of this run no longer exists", where=str(log), hint=hint)
    return log


def recorded_path(manifest: Manifest) -> str:
    """Path of the log of a run."""
    return str(manifest.part("log").get("path", ""))


Owner = Literal["model", "run"]
_LENGTHS = ("wheel_radius_m", "track_width_m", "wheelbase_m", "base_to_rear_axle_m")

# Model files store six digits.
_ROUNDING = 1e-5


def agree_on_vehicle(model: Vehicle | None, runs: Mapping[str, Vehicle], owner: Owner | None) -> Vehicle:
    """Vehicle whose geometry is used for a model and runs.

    Args:
        model: vehicle of the model; None stands for that of the first run.
        runs: vehicle of each run, by name. The controller's track multiplier is always that of the
            recording.
        owner: whose geometry to use if they differ; None raises an error.

    Raises:
        JobError: ``vehicle_contradiction``: ``owner`` is not ``model``, and the runs differ from each other;
            or it is None, and they differ from the model.
    """
    first, own = next(iter(runs.items()))
    chosen = own if model is None or owner == "run" else model
    if owner == "model":
        return chosen
    for name, vehicle in runs.items():
        if differing := _list_differences(own, vehicle):
            what = f"it is of a {_format(vehicle, differing)}, {first} of a {_format(own, differing)}"
            hint = "Give runs of one vehicle, or --vehicle-of model" + (
                f" for that of {first}." * (not model)
            )
            raise JobError("vehicle_contradiction", what, where=name, hint=hint)
    if differing := _list_differences(chosen, own):
        what = f"the run is of a {_format(own, differing)}, the model is for a {_format(chosen, differing)}"
        hint = "Choose the geometry: --vehicle-of model, or --vehicle-of run."
        raise JobError("vehicle_contradiction", what, where=first, hint=hint)
    return chosen


def _list_differences(one: Vehicle, other: Vehicle) -> list[str]:
    """Names of the geometry in which two vehicles differ; values that one of them lacks do not count."""
    names = ["kind"] if one.kind != other.kind else []
    for name in _LENGTHS:
        values = getattr(one, name), getattr(other, name)
        if None not in values and not math.isclose(*values, rel_tol=_ROUNDING):
            names.append(name)
    return names


def _format(vehicle: Vehicle, names: Sequence[str]) -> str:
    values = ((name, getattr(vehicle, name)) for name in names)
    facts = (f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}" for name, value in values)
    return f"{vehicle.name} ({', '.join(facts)})"


# Keys of stages: a stage is up to date if its key equals that of the existing results.
#
# A key is a hash of the previous stage's key, of the stage's own configuration and of the stage's version.
# The version must be incremented with every change of what the stage computes.

VERSIONS: Mapping[str, int] = {"extract": 14, "velocity": 7, "slip": 16, "aggregate": 4}
EXTRACTED = ("commands", "wheels", "poses", "imu", "power")
TABLES: Mapping[str, tuple[str, ...]] = {
    "extract": (*EXTRACTED, "alignments"),
    "velocity": ("velocities",),
    "slip": ("slip", "windows", "events"),
    "aggregate": ("aggregates",),
}
_DIGITS = 16


def key_stages(
    run: str, sha256: str, setup: LogSetup, inputs: tuple[str, ...], model: str | None = None
) -> dict[str, str]:
    """Key of every stage of a run, in order; ``model`` is the hash of the model for the residual slip."""
    # The contracts import a table library that help and usage errors do not need.
    from pipeline.logs import OVER_BUDGET  # noqa: PLC0415
    from schemas import contract_of  # noqa: PLC0415

    plain = msgspec.to_builtins(setup.configuration)
    pose_limits = {name: plain["velocity"][name] for name in ("jump_m", "jump_rad", "gap_s")}
    own = {
        "extract": {
            "log": sha256,
            "run": [run, setup.dataset, setup.terrain],
            "vehicle": msgspec.to_builtins(setup.vehicle),
            "roles": [plain[role] for role in ("command", "wheels", "pose", "imu", "interval")],
            "use_intervals": plain["use_intervals"],
            "limits": pose_limits,
            "message_types": describe_types(one.type_name for one in setup.index.channels),
        },
        "velocity": plain["velocity"],
        "slip": {"slip": plain["slip"], "inputs": inputs, "model": model},
        "aggregate": {},
    }
    if setup.configuration.run.map is not None:
        own["extract"]["map"] = setup.configuration.run.map
    # A higher limit reads more of the log.
    unread = [loss.text for loss in setup.index.losses if loss.kind == OVER_BUDGET]
    if unread:
        own["extract"]["left_out"] = unread
    # The losses of a bag are known only after reading it.
    catalogs = [part.catalog for part in setup.index.parts]
    allowed = [catalog.most_inflated for catalog in catalogs if catalog.most_inflated is not None]
    if allowed:
        own["extract"]["max_inflated"] = allowed
    keys: dict[str, str] = {}
    above = ""
    for stage in STAGES:
        contracts = {table: contract_of(table).version for table in (*TABLES[stage], "findings")}
        above = hash_json([above, stage, VERSIONS[stage], own[stage], contracts])
        keys[stage] = above
    return keys


def hash_json(content: object) -> str:
    """First sixteen hexadecimal digits of the SHA-256 of a JSON value with sorted keys."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:_DIGITS]
