"""Whatever a log is full of - names, keys, topics - what is said of it is short, and memory stays small."""

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from mcap_files import START, read_one, write_channels
from verbs import run_verb

from pipeline.cli.conventions import explain_logs, fold_line
from pipeline.core import LONGEST_NAME, LONGEST_TEXT, SlipError, name_first, shorten
from pipeline.logs import LogError, Loss, Wanted, open_log, read_topics
from pipeline.logs import index as index_module


def write_json(path: Path, messages: list[object], type_name: str = "T") -> Path:
    encoded = [json.dumps(message).encode() for message in messages]
    write_channels(path, [("/j", type_name, "jsonschema", b"{}", "json", encoded)])
    return path


@given(st.lists(st.text(min_size=1, max_size=2 * LONGEST_NAME), max_size=30), st.integers(2, 12))
def test_a_list_of_names_says_how_many_it_leaves_out(names: list[str], most: int) -> None:
    said = name_first(names, most)
    assert len(said) < (most + 1) * (LONGEST_NAME + 50)
    if len(names) > most:
        assert said.endswith(f" and {len(names) - most + 1} more")
    elif all(len(name) <= LONGEST_NAME for name in names):
        assert said == " and ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))


def test_lists_and_texts_read_as_sentences_do() -> None:
    assert name_first([]) == ""
    assert name_first(["a", "b", "c"]) == "a, b and c"
    assert name_first([f"k{k}" for k in range(41_003)], 4) == "k0, k1, k2 and 41,000 more"
    assert shorten("x" * 41_000, 3) == "xxx... (cut, of 41,000 characters)"


def test_errors_losses_and_tables_hold_texts_of_a_few_lines() -> None:
    error = SlipError("code", "w" * 10**6, hint="h" * 10**6)
    for text in (error.what, error.hint, Loss("kind", "t" * 10**6).text):
        assert len(text) < LONGEST_TEXT + 50
    assert max(map(len, explain_logs("failed", [("a.mcap", "r" * 10**6, "do")]))) < LONGEST_TEXT + 50


@given(st.integers(0, 10), st.sampled_from(["w", "word ", "two  fields ", "1 m "]), st.integers(40, 120))
@settings(deadline=None)
def test_a_line_of_any_length_is_folded(indent: int, word: str, width: int) -> None:
    line = " " * indent + "label     " + word * 20_000
    parts = fold_line(line, width)
    assert "".join(parts).replace(" ", "") == line.replace(" ", "")
    assert all(len(part) <= width or " " not in part.strip() for part in parts)


@pytest.mark.parametrize("width", ["100", "0"])
def test_a_topic_of_ever_new_keys_is_inspected_in_short_lines(
    tmp_path: Path, width: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", width)
    messages: list[object] = [{f"k{row}_{key}": 1 for key in range(100)} for row in range(100)]
    log = write_json(tmp_path / "log.mcap", messages, "nav_msgs/Odometry")
    told = run_verb("inspect", log)
    assert max(map(len, told.stdout.splitlines())) < 2 * LONGEST_TEXT
    with pytest.raises(LogError, match=r"The type has: k0_0, .* and 9,993 more"):
        read_topics(log, [Wanted("/j", ("pose.pose.position.x",))])


def test_memory_of_ever_new_keys_grows_with_the_bytes(tmp_path: Path) -> None:
    peaks = []
    for rows in (100, 400):
        messages: list[object] = [
            {"x": row, **{f"k{row}_{key}": 1 for key in range(50)}} for row in range(rows)
        ]
        log = write_json(tmp_path / f"{rows}.mcap", messages)
        tracemalloc.start()
        (columns,) = read_topics(log, [Wanted("/j", ("x",))]).of("/j")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert np.asarray(columns.fields["x"]).tolist() == list(range(rows))
    assert peaks[1] < 6 * peaks[0]
    with pytest.raises(LogError, match="different fields, which no table can hold"):
        read_topics(log, [Wanted("/j")])


def test_keys_in_keys_have_no_paths_of_any_length(tmp_path: Path) -> None:
    nested: object = 1
    for level in range(300):
        nested = {"n": nested, f"leaf{level}": 1}
    columns = read_one(write_json(tmp_path / "log.mcap", [nested, {"x": 1.0}]), "/j")
    assert max(map(len, columns.fields)) < 2 * LONGEST_NAME
    assert "x" in columns.fields


def write_many(path: Path, topics: int, name: str = "/t") -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data")
        for number in range(topics):
            channel = writer.register_channel(f"{name}{number}", "cdr", schema)
            writer.add_message(channel, START + number, b"\0\1\0\0" + bytes(8), START + number)
        writer.finish()
    return path


@pytest.mark.parametrize("has_summary", [True, False])
def test_of_very_many_topics_the_first_are_read_and_the_others_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, has_summary: bool
) -> None:
    monkeypatch.setattr(index_module, "_MOST_TOPICS", 20)
    log = write_many(tmp_path / "log.mcap", 50)
    if not has_summary:
        log.write_bytes(log.read_bytes()[:-100])
    index = open_log(log)
    (loss,) = [one for one in index.losses if one.kind == "too_large"]
    assert loss.text.startswith("the log has 50 topics: the first 20 are read, and not /t20, ")
    assert loss.text.endswith(" and 23 more")
    assert set(index.topics()) == {f"/t{number}" for number in range(20)}
    data = read_topics(index, [Wanted(topic) for topic in index.topics()])
    assert sum(map(len, data.topics)) == index.message_count == 20
    told = run_verb("inspect", log)
    assert "the first 20 are read" in told.stdout
    assert told.returncode == 3


def test_a_topic_with_a_name_of_a_megabyte_is_called_by_its_first_letters(tmp_path: Path) -> None:
    log = write_many(tmp_path / "log.mcap", 2, "/" + "long" * 250_000)
    index = open_log(log)
    assert all(len(topic) < LONGEST_NAME + 50 for topic in index.topics())
    assert sum(map(len, read_topics(index, [Wanted(topic) for topic in index.topics()]).topics)) == 2
    assert max(map(len, run_verb("inspect", log, "--all").stdout.splitlines())) < 2 * LONGEST_TEXT


ODOMETRY = {
    "header": {"stamp": {"sec": 1, "nanosec": 0}, "frame_id": "odom"},
    "child_frame_id": "base_link",
    "pose": {
        "pose": {"position": {"x": 1.0, "y": 2.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    },
}


def test_what_a_topic_may_lack_has_no_column_and_gaps_where_some_have_it(tmp_path: Path) -> None:
    wanted = Wanted("/j", ("a", "b"), optional=frozenset({"b"}))
    log = write_json(tmp_path / "log.mcap", [{"a": 1.0}, {"a": 2.0}])
    (columns,) = read_topics(log, [wanted]).of("/j")
    assert list(columns.fields) == ["a"]
    log = write_json(tmp_path / "log.mcap", [{"a": 1.0}, {"a": 2.0, "b": 3.0}, {"b": 4.0}])
    (columns,) = read_topics(log, [wanted]).of("/j")
    np.testing.assert_array_equal(np.asarray(columns.fields["b"]), [np.nan, 3.0, 4.0])
    np.testing.assert_array_equal(np.asarray(columns.fields["a"]), [1.0, 2.0, np.nan])
    log = write_json(tmp_path / "log.mcap", [{"b": 1.0}])
    with pytest.raises(LogError, match="there is not a field a") as caught:
        read_topics(log, [wanted])
    assert caught.value.where.endswith("topic /j")
    assert not read_topics(log, [wanted], skip_unfit=True).topics


@pytest.mark.parametrize(
    "twist", [{}, {"twist": {"twist": {"linear": {"x": 0.5}, "angular": {"z": 0.1}}}}], ids=["none", "some"]
)
def test_odometry_and_commands_without_optional_numbers_are_read(
    tmp_path: Path, twist: dict[str, object]
) -> None:
    rows = 400
    commands, poses = [], []
    for row in range(rows):
        commands.append(json.dumps({"linear": {"x": 0.5}, "angular": {"z": 0.2 * np.sin(row / 20)}}).encode())
        angle = 0.1 * np.sin(row / 20)
        pose = {
            "position": {"x": 0.01 * row, "y": 0.0},
            "orientation": {"x": 0.0, "y": 0.0, "z": np.sin(angle), "w": np.cos(angle)},
        }
        stamp = divmod(START + row * 50_000_000, 10**9)
        header = {"stamp": {"sec": stamp[0], "nanosec": stamp[1]}, "frame_id": "odom"}
        poses.append(json.dumps({**ODOMETRY, "header": header, "pose": {"pose": pose}, **twist}).encode())
    log = tmp_path / "log.mcap"
    with log.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        for topic, kind, messages in (
            ("/cmd_vel", "geometry_msgs/Twist", commands),
            ("/odom", "nav_msgs/Odometry", poses),
        ):
            channel = writer.register_channel(
                topic, "json", writer.register_schema(kind, "jsonschema", b"{}")
            )
            for row, message in enumerate(messages):
                writer.add_message(channel, START + row * 50_000_000, message, START + row * 50_000_000)
        writer.finish()
    told = run_verb(
        "results", "stage", "extract", log, "--vehicle", "husky_a200", "--results", tmp_path / "out", "--json"
    )
    assert told.returncode in {0, 3}, told.stderr
    made = json.loads(told.stdout)["rows"]
    assert made["poses"] == made["commands"] == rows
