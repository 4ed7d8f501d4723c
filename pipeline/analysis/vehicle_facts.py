"""What a log says of its vehicle beside its topics: description, parameters, frames of wheels."""

from collections.abc import Iterator

from pipeline.logs import (
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
from pipeline.vehicles import Controller, Description, list_metadata, read_description, read_parameters
from pipeline.vehicles.message_types import plain_type

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
        found = read_description(texts.to_list()[-1]) if isinstance(texts, Strings) and len(texts) else None
        if found is not None:
            return found
    return None


def find_controller(index: LogIndex) -> Controller | None:
    """What the controller was told of its vehicle, by parameter events and metadata."""
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
    """The transforms of a log that never move."""
    topics = [channel.topic for channel in index.channels if channel.message_count != 0]
    static = [one for one in wanted_transforms(topics) if one.topic.endswith("static")]
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


def _read(index: LogIndex, wanted: list[Wanted]) -> list[TopicColumns]:
    """Small topics; none where one cannot be read, which the log's own reading will say."""
    found: list[TopicColumns] = []
    for one in wanted:
        try:
            found += read_topics(index, [one], sha256="unused").topics
        except LogError:
            continue
    return found
