"""The columns of a log, each topic as one series, and what was computed of them: once for all who read it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import TypeVar, TypeVarTuple, cast

import numpy as np

from pipeline.logs import LogData, TopicColumns, join_channels
from pipeline.recording import topic_values
from pipeline.recording.findings import Finding

Asked = TypeVarTuple("Asked")
Made = TypeVar("Made")
_KEPT = 3
"""Latest results of a function that are kept: those of many candidates for a pose would fill the memory."""


class LogColumns:
    """The columns of a log that were read.

    Ratings of poses, the examination and the run extract the same log from other sources and another
    configuration; what either computes of equal arguments is not computed again.

    Args:
        data: as it was read.

    Attributes:
        data: the same without absurd numbers.
        findings: on these.
    """

    def __init__(self, data: LogData) -> None:
        topics, self.findings = topic_values.remove_absurd(data.topics)
        self.data = replace(data, topics=topics)
        self._joined: dict[str, tuple[TopicColumns | None, tuple[Finding, ...]]] = {}
        self._made: dict[object, list[tuple[tuple[object, ...], object]]] = {}

    def join(self, topic: str) -> tuple[TopicColumns | None, tuple[Finding, ...]]:
        """All channels of a topic as one series, None without messages, and findings on it."""
        if topic not in self._joined:
            findings: list[Finding] = []
            self._joined[topic] = self._join_channels(topic, findings), tuple(findings)
        return self._joined[topic]

    def once(self, make: Callable[[*Asked], Made], *given: *Asked) -> Made:
        """What a pure function makes of arguments, computed where it was not asked for them lately."""
        made = self._made.setdefault(make, [])
        for before, result in made:
            if _are_equal(before, given):
                return cast("Made", result)
        result = make(*given)
        self._made[make] = [*made[1 - _KEPT :], (given, result)]
        return result

    def list_types(self, channels: Sequence[TopicColumns]) -> list[str]:
        """Types of channels as recorded, each once."""
        ids = {columns.channel_id for columns in channels}
        return list(dict.fromkeys(one.type_name for one in self.data.index.channels if one.id in ids))

    def _join_channels(self, topic: str, findings: list[Finding]) -> TopicColumns | None:
        """All channels of a topic as one series; if they cannot be joined, the one with most messages."""
        # All texts of a topic may be unreadable.
        recorded = self.data.of(topic)
        stamped = [topic_values.with_stamps(columns) for columns in recorded if columns.log_time.size]
        channels = [columns for columns in stamped if columns.log_time.size]
        if len(channels) <= 1:
            return channels[0] if channels else None
        types = self.list_types(channels)
        if len(types) > 1:
            channels = _make_alike(channels)
        joined = join_channels(channels)
        count = len(channels)
        if joined is not None and len(types) > 1:
            lacks_stamps = joined.header_time is None and any(one.header_time is not None for one in stamped)
            values = {"count": len(types), "types": types, "lacks_stamps": lacks_stamps}
            findings.append(Finding("several_types", "warning", topic, values))
            return joined
        if joined is not None:
            findings.append(Finding("several_channels", "info", topic, {"kind": "joined", "count": count}))
            return joined
        findings.append(Finding("several_channels", "warning", topic, {"kind": "fullest", "count": count}))
        return max(channels, key=lambda columns: columns.log_time.size)


def _make_alike(channels: Sequence[TopicColumns]) -> list[TopicColumns]:
    """Channels of several types with the fields that all have, and with stamps if all have them."""
    shared = set.intersection(*(set(columns.fields) for columns in channels))
    stamped = all(columns.header_time is not None for columns in channels)
    return [
        replace(
            columns,
            header_time=columns.header_time if stamped else None,
            fields={name: column for name, column in columns.fields.items() if name in shared},
        )
        for columns in channels
    ]


def _are_equal(one: object, other: object) -> bool:
    """Whether two arguments are equal, arrays by their numbers."""
    if one is other:
        return True
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    parts, others = _list_parts(one), _list_parts(other)
    if type(one) is not type(other) or len(parts) != len(others):
        return False
    return all(map(_are_equal, parts, others)) if parts else bool(one == other)


def _list_parts(one: object) -> Sequence[object]:
    """What an argument consists of; nothing of a plain value."""
    if isinstance(one, Mapping):
        return (*one, *one.values())
    if is_dataclass(one):
        return [getattr(one, each.name) for each in fields(one)]
    return one if isinstance(one, tuple) else ()
