"""What is written is what was given, for our reader and for the official one."""

import pickle
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_files import FLOAT, JOINTS, START, TEXT, assert_equals_official, read_small, write_small

from pipeline.logs import LogError, Wanted, bundled_types, open_log, read_topics
from pipeline.logs.writer import LogWriter

ODOMETRY = "nav_msgs/msg/Odometry"


@pytest.mark.parametrize("compression", ["zstd", "lz4", ""])
def test_what_is_written_is_read_by_both_readers(tmp_path: Path, compression: str) -> None:
    path = tmp_path / "log.mcap"
    truth = write_small(path, compression=compression)
    data, found = read_small(path)
    assert found == truth
    assert not data.losses
    assert assert_equals_official(path) == len(truth)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert sum(1 for _ in reader.iter_messages()) == len(truth)
        summary = reader.get_summary()
        assert [record.name for record in reader.iter_metadata()] == ["deployment"]
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(truth)
    assert summary.statistics.chunk_count == len(summary.chunk_indexes) > 3


def test_the_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    write_small(tmp_path / "a.mcap")
    write_small(tmp_path / "b.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_a_failed_write_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write_small(path)
    before = path.read_bytes()
    writer = LogWriter(path)
    writer.write_columns("/x", FLOAT, np.array([START]), {"data": 1.0})
    writer.__exit__(RuntimeError, RuntimeError("stop"), None)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("kind", "fields", "code"),
    [
        ("vendor_msgs/msg/Thing", {}, "unknown_type"),
        (FLOAT, {"value": 1.0}, "field_not_found"),
        (FLOAT, {"data": np.zeros(7)}, "bad_column"),
        ("std_msgs/msg/Int32", {"data": 0.5}, "bad_column"),
        (TEXT, {"data": ["a", "b"]}, "bad_column"),
        (JOINTS, {"velocity": [1.0], "name": 3.0}, "bad_column"),
    ],
)
def test_what_cannot_be_written_is_said(tmp_path: Path, kind: str, fields: dict[str, Any], code: str) -> None:
    with LogWriter(tmp_path / "log.mcap") as writer:
        with pytest.raises(LogError) as caught:
            writer.write_columns("/x", kind, START + np.arange(3), fields)
        assert caught.value.code == code
    assert open_log(tmp_path / "log.mcap").message_count == 0


def test_times_before_1970_are_refused(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "log.mcap") as writer, pytest.raises(LogError) as caught:
        writer.write_columns("/x", FLOAT, np.array([-1]), {"data": 1.0})
    assert caught.value.code == "bad_column"


def test_every_bundled_type_can_be_written_empty(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path) as writer:
        for kind in bundled_types():
            writer.write_columns(f"/{kind}", kind, np.array([START, START + 1]), {})
    assert assert_equals_official(path) == 2 * len(bundled_types())


def test_a_type_with_its_own_definition(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path) as writer:
        writer.write_columns(
            "/x", "demo/msg/Pair", np.array([START]), {"b": 2.5}, definition="int8 a\nfloat64 b\n"
        )
    assert read_topics(path, [Wanted("/x")]).of("/x")[0].fields["b"].tolist() == [2.5]


def test_what_was_read_crosses_a_process_boundary(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write_small(path)
    index = pickle.loads(pickle.dumps(open_log(path)))  # noqa: S301 - our own bytes
    data = pickle.loads(pickle.dumps(read_topics(index, [Wanted("/speed")])))  # noqa: S301 - our own bytes
    assert len(data.of("/speed")[0]) == 60


def test_a_hundred_thousand_messages_are_written_in_seconds(tmp_path: Path) -> None:
    times = START + np.arange(100_000) * 10_000_000
    begin = time.process_time()
    with LogWriter(tmp_path / "log.mcap") as writer:
        writer.write_columns(
            "/odom", ODOMETRY, times, {"pose.pose.position.x": times * 1e-9}, header_time=times
        )
    assert time.process_time() - begin < 3.0
