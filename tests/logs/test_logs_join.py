"""A topic on several channels is one series, in the order in which it was recorded."""

import numpy as np
import pytest

from pipeline.logs import Ragged, RaggedStrings, Strings, TopicColumns, join_channels


def channel(number: int, times: list[int], **fields: object) -> TopicColumns:
    stamps = np.array(times, dtype=np.int64)
    return TopicColumns(
        "/joints", number, "sensor_msgs/msg/JointState", stamps, stamps + 1, stamps - 1, fields, ()
    )  # type: ignore[arg-type]


def lists(*rows: list[float]) -> Ragged:
    offsets = np.cumsum([0, *(len(row) for row in rows)])
    return Ragged(np.array([value for row in rows for value in row]), offsets)


def names(*rows: list[str]) -> RaggedStrings:
    values = tuple(dict.fromkeys(name for row in rows for name in row))
    codes = np.array([values.index(name) for row in rows for name in row], dtype=np.int32)
    return RaggedStrings(codes, values, np.cumsum([0, *(len(row) for row in rows)]))


def test_messages_of_two_channels_are_put_in_order() -> None:
    one = channel(
        1, [10, 30, 50], x=np.array([1.0, 3.0, 5.0]), frame=Strings(np.array([0, -1, 0], np.int32), ("a",)),
        velocity=lists([1.0], [3.0, 3.5], []), name=names(["l"], ["l", "r"], []),
    )  # fmt: skip
    two = channel(
        2, [20, 40], x=np.array([2.0, 4.0]), frame=Strings(np.array([0, 1], np.int32), ("b", "a")),
        velocity=lists([2.0, 2.5], [4.0]), name=names(["r", "l"], ["m"]),
    )  # fmt: skip
    joined = join_channels([one, two])

    assert joined is not None
    assert joined.log_time.tolist() == [10, 20, 30, 40, 50]
    assert joined.publish_time.tolist() == [11, 21, 31, 41, 51]
    assert joined.header_time is not None
    assert joined.header_time.tolist() == [9, 19, 29, 39, 49]
    assert joined.fields["x"].tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert joined.fields["frame"].to_list() == ["a", "b", "", "a", "a"]
    velocity, joint = joined.fields["velocity"], joined.fields["name"]
    assert [velocity.row(i).tolist() for i in range(5)] == [[1.0], [2.0, 2.5], [3.0, 3.5], [4.0], []]
    assert [joint.row(i) for i in range(5)] == [["l"], ["r", "l"], ["l", "r"], ["m"], []]


def test_one_channel_stays_itself() -> None:
    only = channel(1, [1, 2], x=np.zeros(2))
    assert join_channels([only]) is only


@pytest.mark.parametrize("other", [{"y": np.zeros(1)}, {"x": lists([1.0])}])
def test_channels_that_differ_are_not_joined(other: dict[str, object]) -> None:
    assert join_channels([channel(1, [1], x=np.zeros(1)), channel(2, [2], **other)]) is None
