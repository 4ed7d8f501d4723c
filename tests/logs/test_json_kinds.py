"""JSON messages of which some have a field of another kind than the rest: missing there, as null is."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap_files import START, read_one, write_channels

from pipeline.logs import Ragged, Strings, TransformBuffer, Wanted, read_topics

ODD = ["a", "1.0", "", True, False, [1.0], [], ["a"], [[1]], {"a": 1.0}, {}, None, "\ud800", [None]]


def write(path: Path, messages: list[object], type_name: str = "T") -> Path:
    encoded = [json.dumps(message).encode() for message in messages]
    write_channels(path, [("/j", type_name, "jsonschema", b"{}", "json", encoded)])
    return path


@pytest.mark.parametrize("odd", ODD, ids=repr)
@pytest.mark.parametrize("at", [0, 2, 4])
def test_what_is_no_number_among_numbers_is_missing(odd: object, at: int, tmp_path: Path) -> None:
    messages: list[object] = [{"pose": {"x": float(row)}, "n": row} for row in range(5)]
    messages[at] = {"pose": {"x": odd}, "n": odd}
    columns = read_one(write(tmp_path / "log.mcap", messages), "/j")
    assert len(columns) == 5
    for name in ("pose.x", "n"):
        column = columns.fields[name]
        assert isinstance(column, np.ndarray)
        expected = [float(row) if row != at else np.nan for row in range(5)]
        np.testing.assert_array_equal(column.astype(np.float64), expected)


@pytest.mark.parametrize("odd", ODD, ids=repr)
def test_what_is_no_number_in_a_list_of_numbers_keeps_the_places_of_the_others(
    odd: object, tmp_path: Path
) -> None:
    messages: list[object] = [{"v": [1.0, 2.0, 3.0]} for _ in range(4)]
    messages[1] = {"v": [1.0, odd, 3.0]} if not isinstance(odd, list | dict) else {"v": odd}
    column = read_one(write(tmp_path / "log.mcap", messages), "/j").fields["v"]
    assert isinstance(column, Ragged)
    assert len(column) == 4
    assert column.row(3).tolist() == [1.0, 2.0, 3.0]
    if not isinstance(odd, list | dict):
        np.testing.assert_array_equal(column.row(1), [1.0, np.nan, 3.0])


@given(st.lists(st.one_of(st.integers(-9, 9), st.sampled_from(ODD)), min_size=1, max_size=20))
def test_whatever_messages_hold_most_decide(
    tmp_path_factory: pytest.TempPathFactory, values: list[object]
) -> None:
    path = tmp_path_factory.mktemp("mixed") / "log.mcap"
    column = read_one(write(path, [{"a": value} for value in values]), "/j").fields.get("a")
    numbers = [isinstance(v, int) and not isinstance(v, bool) for v in values]
    if 2 * sum(numbers) > len(values):
        assert isinstance(column, np.ndarray)
        for value, is_number, read in zip(values, numbers, column.tolist(), strict=True):
            assert read == value if is_number else np.isnan(read)
    elif column is not None:
        assert len(column) == len(values)


def test_texts_stay_texts(tmp_path: Path) -> None:
    column = read_one(
        write(tmp_path / "log.mcap", [{"a": "x"}, {"a": 1}, {"a": "y"}, {"a": None}]), "/j"
    ).fields["a"]
    assert isinstance(column, Strings)
    assert column.to_list() == ["x", "1", "y", ""]


@pytest.mark.parametrize("odd", [*ODD, 1e300, -(10**30)], ids=repr)
def test_a_message_without_a_stamp_is_placed_by_its_log_time(odd: object, tmp_path: Path) -> None:
    stamp = {"sec": START // 10**9, "nanosec": 0}
    messages: list[object] = [{"header": {"stamp": dict(stamp)}, "v": 1.0} for _ in range(5)]
    messages[3] = {"header": {"stamp": stamp | {"sec": odd}}, "v": 1.0}
    columns = read_one(write(tmp_path / "log.mcap", messages), "/j")
    assert columns.header_time is not None
    late = columns.log_time - columns.header_time
    assert late[3] == round(float(np.median(np.delete(late, 3))))
    messages[3] = {"v": 1.0, "header": odd}
    assert read_one(write(tmp_path / "log.mcap", messages), "/j").header_time is not None


@pytest.mark.parametrize(
    "path", ["header", "header.stamp", "header.stamp.sec", "transform.translation.x", "transform"]
)
@pytest.mark.parametrize("odd", ODD, ids=repr)
def test_one_odd_transform_leaves_the_others(path: str, odd: object, tmp_path: Path) -> None:
    def transform(row: int) -> dict[str, object]:
        return {
            "header": {"stamp": {"sec": 1000 + row, "nanosec": 0}, "frame_id": "map"},
            "child_frame_id": "base_link",
            "transform": {
                "translation": {"x": float(row), "y": 0.0, "z": 0.0},
                "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
            },
        }

    several = [transform(row) for row in range(6)]
    at = several[2]
    *above, last = path.split(".")
    for key in above:
        at = at[key]  # type: ignore[assignment]
    at[last] = odd
    log = write(tmp_path / "log.mcap", [{"transforms": [one]} for one in several], "tf2_msgs/msg/TFMessage")
    buffer = TransformBuffer(read_topics(log, [Wanted("/j")]).topics)
    series = buffer.lookup_series("map", "base_link")
    assert series.time.size >= 4
