"""A chunk cut out of a log that nothing counts is noticed where its writer numbered the messages."""

# ruff: noqa: ANN401 - options of a writer come in many types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import CompressionType, IndexType, Writer
from mcap_files import START, payloads, record_starts, text_of

from pipeline.logs import Loss, Wanted, open_log, read_topics

ROWS = 400
FLOAT = "std_msgs/msg/Float64"
CHUNK, MESSAGE_INDEX = 6, 7
BARE = ("use_statistics", "use_summary_offsets", "repeat_channels", "repeat_schemas")


def write(path: Path, number: Callable[[int, int], int], **options: Any) -> list[tuple[int, int]]:
    """Two topics at two rates, no summary; where its chunks stand with their indexes.

    Args:
        path: the log.
        number: of a message, by how many came before it, on its channel and on all.
        options: of the writer.
    """
    bare = dict.fromkeys(
        ("use_statistics", "use_summary_offsets", "repeat_channels", "repeat_schemas"), False
    )
    with path.open("wb") as stream:
        writer = Writer(
            stream,
            chunk_size=2_000,
            compression=CompressionType.NONE,
            index_types=IndexType.MESSAGE,
            **bare,
            **options,
        )
        writer.start(profile="ros2", library="test")
        schema = writer.register_schema(FLOAT, "ros2msg", text_of(FLOAT))
        fast, slow = (writer.register_channel(topic, "cdr", schema) for topic in ("/fast", "/slow"))
        encoded = payloads(FLOAT, ROWS, {"data": [float(row) for row in range(ROWS)]})
        count = {fast: 0, slow: 0}
        for row in range(ROWS):
            for channel in (fast, slow) if row % 3 == 0 else (fast,):
                time = START + row * 10_000_000
                writer.add_message(
                    channel, time, encoded[row], time, number(count[channel], sum(count.values()))
                )
                count[channel] += 1
        writer.finish()
    content = path.read_bytes()
    starts = record_starts(content)
    chunks = [place for place, start in enumerate(starts[:-1]) if content[start] == CHUNK]
    ends = [*chunks[1:], next(p for p, s in enumerate(starts) if content[s] == 15)]
    return [(starts[a], starts[b]) for a, b in zip(chunks, ends, strict=True)]


def read(path: Path) -> list[Loss]:
    index = open_log(path)
    return list(read_topics(index, [Wanted(topic) for topic in index.topics()], threads=1, sha256="-").losses)


def cut(path: Path, start: int, end: int) -> None:
    content = path.read_bytes()
    path.write_bytes(content[:start] + content[end:])


def by_channel(own: int, _all: int) -> int:
    return own


def together(_own: int, every: int) -> int:
    return every


def none(_own: int, _all: int) -> int:
    return 0


@pytest.mark.parametrize(("number", "topics"), [(by_channel, " of /fast and /slow"), (together, "")])
def test_a_chunk_that_is_missing_is_said_with_its_times(
    tmp_path: Path, number: Callable[[int, int], int], topics: str
) -> None:
    path = tmp_path / "log.mcap"
    chunks = write(path, number)
    assert len(chunks) > 8
    assert not read(path), "a whole log has lost nothing"
    whole = open_log(path).message_count
    start, end = chunks[4]
    cut(path, start, end)
    (loss,) = read(path)
    missing = whole - open_log(path).message_count
    assert loss.kind == "missing_messages"
    assert loss.text.startswith(
        f"{missing} messages{topics} are missing between the chunks at {chunks[3][0]} and"
    )
    assert loss.start_ns is not None
    assert loss.end_ns is not None
    assert 0 < (loss.end_ns - loss.start_ns) / 10_000_000 < missing + 3


def test_where_nothing_is_counted_nothing_is_said(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    start, end = write(path, none)[4]
    cut(path, start, end)
    assert not read(path)


@pytest.mark.parametrize(
    "number",
    [
        lambda own, _all: own * 2,
        lambda own, _all: own // 2,
        lambda own, _all: own + own // 7,
        lambda _own, every: every % 50,
    ],
    ids=["by two", "in pairs", "with gaps of its own", "starting again"],
)
def test_numbers_that_are_no_count_prove_nothing(tmp_path: Path, number: Callable[[int, int], int]) -> None:
    path = tmp_path / "log.mcap"
    start, end = write(path, number)[4]
    assert not read(path)
    cut(path, start, end)
    assert not read(path)


def test_a_chunk_that_is_damaged_is_said_once(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    chunks = write(path, by_channel)
    content = bytearray(path.read_bytes())
    content[chunks[4][0] + 200] ^= 0xFF
    path.write_bytes(content)
    assert [loss.kind for loss in read(path)] == ["chunk_crc"]
