"""What stands in a file twice counts once; what only shares its time counts as often as it happened."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import CompressionType
from mcap_files import START, read_small, record_starts, write_official

from pipeline.logs import Wanted, open_log, read_topics
from pipeline.logs.writer import LogWriter

MESSAGE, CHUNK, DATA_END = 5, 6, 15


def records(content: bytes, opcode: int) -> list[tuple[int, int]]:
    return [(a, b) for a, b in pairwise(record_starts(content)) if content[a] == opcode]


@pytest.mark.parametrize("rebuilt", [True, False], ids=["without summary", "summary behind"])
def test_a_doubled_chunk_counts_once(tmp_path: Path, *, rebuilt: bool) -> None:
    path = tmp_path / "log.mcap"
    truth = write_official(path)
    content = path.read_bytes()
    start, end = records(content, CHUNK)[3]
    section = records(content, DATA_END)[0][0]
    doubled = content[:section] + content[start:end] + (b"" if rebuilt else content[section:])
    path.write_bytes(doubled)
    data, found = read_small(path)
    assert found == truth
    assert sum(len(columns) for columns in data.topics) == len(truth)
    inside = sum(data.repeated.values())
    assert inside == data.index.message_count - len(truth) > 3
    assert set(data.repeated) <= {"/speed", "/joints", "/state"}


@pytest.mark.parametrize(
    "options", [{"use_chunking": False}, {"compression": CompressionType.NONE, "chunk_size": 1}], ids=str
)
def test_a_range_that_was_copied_into_the_file_counts_once(tmp_path: Path, options: dict[str, Any]) -> None:
    path = tmp_path / "log.mcap"
    truth = write_official(path, **options)
    content = path.read_bytes()
    starts = [start for start in record_starts(content) if content[start] in {MESSAGE, CHUNK}]
    low, high, place = starts[10], starts[40], starts[100]
    path.write_bytes(content[:place] + content[low:high] + content[place:])
    data, found = read_small(path)
    assert found == truth
    assert sum(len(columns) for columns in data.topics) == len(truth)
    assert sum(data.repeated.values()) == 30


def test_messages_of_one_time_are_kept_where_they_differ(tmp_path: Path) -> None:
    """Under simulated time many messages share their times; without fields read, too, all of them count."""
    path = tmp_path / "log.mcap"
    times = [START + row // 4 for row in range(40)]
    with LogWriter(path) as writer:
        writer.write_columns("/x", "std_msgs/msg/Float64", times, {"data": [float(row) for row in range(40)]})
    for fields in (None, ()):
        data = read_topics(path, [Wanted("/x", fields)])
        assert len(data.topics[0]) == 40
        assert not data.repeated


def test_a_recording_is_not_read_twice_for_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "log.mcap"
    write_official(path)
    monkeypatch.setattr("pipeline.logs.reader.digest_messages", None)
    index = open_log(path)
    assert not read_topics(index, [Wanted(topic) for topic in index.topics()], threads=1).repeated
