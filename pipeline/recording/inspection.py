"""Health of a log: timing of its topics, losses, and the topics that an analysis would use."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.core import PAUSE_NS, Flags, Floats, Ints, SlipError
from pipeline.logs import ChannelInfo, LogIndex, Loss, Wanted, open_log, read_topics
from pipeline.recording import LogOptions
from pipeline.recording.clocks import find_pauses
from pipeline.recording.findings import Finding
from pipeline.recording.log_choice import Choice, choose, make_stand_in
from pipeline.recording.log_setup import list_unread_files, report_unused, require_messages, require_sources
from pipeline.recording.tape import measure_by_tape
from pipeline.sources import (
    UNKNOWN_VEHICLE,
    Configuration,
    Sources,
    Vehicle,
    choose_sources,
    load_configuration,
)

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
    notes: tuple[Finding, ...]
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


def inspect_log(path: Path, options: LogOptions) -> Inspection:
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
    lengths_ns = [after - last for last, after in find_pauses(log for log, _ in times.values())]
    notes = [Finding("log_note", "info", "log", {"note": note}) for note in data.notes]
    if lengths_ns:
        values = {"kind": "pause", "value": max(lengths_ns) / 1e9, "count": len(lengths_ns)}
        notes.append(Finding("clock_jump", "warning", "recorder", values))
    notes += [
        Finding("repeated_messages", "warning", topic, {"kind": "ignored", "count": count})
        for topic, count in data.repeated.items()
    ]
    notes += [*measure_by_tape(index, configuration, choice), *list_unread_files(index.path, options)]
    duration_s = index.duration_s - sum(lengths_ns) / 1e9
    return Inspection(index, topics, data.losses, tuple(notes), choice, problem, data.unchecked, duration_s)


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
    index: LogIndex, configuration: Configuration, options: LogOptions
) -> tuple[Choice | None, SlipError | None]:
    """Vehicle and sources as an analysis chooses them; its error is returned, not raised."""
    chosen: Choice | None = None
    try:
        require_messages(index)
        chosen = report_unused(choose(index, configuration, options.overrides), index)
        require_sources(chosen, index, options)
    except SlipError as error:
        return chosen or _choose_by_name(index, configuration), error
    return chosen, None


def _choose_by_name(index: LogIndex, configuration: Configuration) -> Choice | None:
    """Sources of a log whose vehicle is unknown; None if they cannot be chosen."""
    stand_in = make_stand_in(index, configuration)
    try:
        sources = choose_sources(index.channels, configuration, stand_in, where=str(index.path))
    except SlipError:
        return None
    return Choice(stand_in, "fitted", sources)
