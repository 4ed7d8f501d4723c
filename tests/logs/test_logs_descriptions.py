"""Which copy of a schema or channel counts, and what is said where no checksum covers it."""

# ruff: noqa: ANN401 - options of a writer come in many types
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, Writer
from mcap_files import START, payloads, record_starts

from pipeline.logs import LogData, Wanted, open_log, read_topics

ROWS = 251
KIND = "demo/msg/Motion"
DEFINITION = "float64 linear\nfloat64 angular"
SCHEMA, CHANNEL, CHUNK, DATA_END, FOOTER = 3, 4, 6, 15, 2


def write(path: Path, **options: Any) -> bytes:
    """A log of one topic in many chunks, each with a CRC."""
    values = {"linear": np.arange(ROWS) * 0.5, "angular": np.arange(ROWS) * 0.25}
    with path.open("wb") as stream:
        writer = Writer(stream, **{"chunk_size": 700, "compression": CompressionType.ZSTD, **options})
        writer.start(profile="ros2", library="test")
        schema = writer.register_schema(KIND, "ros2msg", DEFINITION.encode())
        channel = writer.register_channel("/motion", "cdr", schema)
        for row, payload in enumerate(payloads(KIND, ROWS, values, DEFINITION)):
            writer.add_message(channel, START + row, payload, START + row)
        writer.finish()
    return path.read_bytes()


def change_letter(content: bytes, word: bytes, last: bytes, *, copy: int = -1) -> bytearray:
    """One letter of a word in a copy of a record, by default in the summary's."""
    places = []
    place = content.find(word)
    while place >= 0:
        places.append(place)
        place = content.find(word, place + 1)
    damaged = bytearray(content)
    end = places[copy] + len(word)
    damaged[end - 1 : end] = last
    return damaged


def zero_summary_crc(content: bytearray) -> bytearray:
    footer = record_starts(bytes(content))[-2]
    assert content[footer] == FOOTER
    content[footer + 9 + 16 : footer + 9 + 20] = bytes(4)
    return content


def read(path: Path, content: bytes) -> LogData:
    path.write_bytes(content)
    return read_topics(open_log(path), [Wanted("/motion")], threads=1, sha256="-")


@pytest.mark.parametrize("stale", [False, True], ids=["no summary CRC", "stale summary CRC"])
def test_a_schema_under_a_checksum_wins_over_the_summarys(tmp_path: Path, *, stale: bool) -> None:
    path = tmp_path / "log.mcap"
    damaged = change_letter(write(path), b"angular", b"p")
    data = read(path, damaged if stale else zero_summary_crc(damaged))
    (columns,) = data.topics
    assert set(columns.fields) == {"linear", "angular"}
    assert columns.fields["angular"].tolist() == [0.25 * row for row in range(ROWS)]
    assert "damaged_summary" in [loss.kind for loss in data.losses]
    assert not data.unchecked


def test_a_channel_under_a_checksum_wins_over_the_summarys(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    data = read(path, zero_summary_crc(change_letter(write(path), b"/motion", b"m")))
    assert data.index.topics() == ("/motion",)
    assert [loss.kind for loss in data.losses] == ["damaged_summary"]


@pytest.mark.parametrize("data_crc", [False, True])
def test_definitions_that_nothing_covers_are_said(tmp_path: Path, *, data_crc: bool) -> None:
    """Messages in a chunk with CRC, their schema and channel before it, no summary."""
    path = tmp_path / "log.mcap"
    content = write(path)
    schema = struct.pack("<H", 1) + b"".join(
        struct.pack("<I", len(each)) + each for each in (KIND.encode(), b"ros2msg", DEFINITION.encode())
    )
    channel = struct.pack("<HH", 1, 1) + struct.pack("<I", 7) + b"/motion" + struct.pack("<I", 3) + b"cdr"
    described = b"".join(
        struct.pack("<BQ", opcode, len(body)) + body
        for opcode, body in ((SCHEMA, schema), (CHANNEL, channel + bytes(4)))
    )
    starts = record_starts(content)
    (first, *_) = [start for start in starts if content[start] == CHUNK]
    inside = pack_messages(content)
    body = content[:first] + described + inside
    crc = zlib.crc32(body) if data_crc else 0
    end = struct.pack("<BQI", DATA_END, 4, crc) + struct.pack("<BQQQI", FOOTER, 20, 0, 0, 0) + content[:8]
    data = read(path, body + end)
    assert len(data.topics[0]) == ROWS
    assert not data.losses
    if data_crc:
        assert not data.unchecked
    else:
        said = "no checksum covers what the log says of /motion"
        assert data.unchecked.startswith(said)


def pack_messages(content: bytes) -> bytes:
    """The messages of a log in one uncompressed chunk with a CRC that holds no schema and no channel."""
    messages = b""
    for start in record_starts(content):
        if content[start] != CHUNK:
            continue
        size = struct.unpack_from("<Q", content, start + 1)[0]
        records = zstandard.ZstdDecompressor().decompress(content[start + 9 + 44 : start + 9 + size])
        place = 0
        while place < len(records):
            length = struct.unpack_from("<Q", records, place + 1)[0]
            if records[place] == 5:
                messages += records[place : place + 9 + length]
            place += 9 + length
    body = struct.pack("<QQQII", START, START + ROWS, len(messages), zlib.crc32(messages), 0)
    body += struct.pack("<Q", len(messages)) + messages
    return struct.pack("<BQ", CHUNK, len(body)) + body


@pytest.mark.parametrize("copy", [0, -1], ids=["in the data", "in the summary"])
def test_copies_that_differ_and_that_no_checksum_covers_are_told(tmp_path: Path, copy: int) -> None:
    """The one in the data counts, and whether it is damaged nobody knows."""
    path = tmp_path / "log.mcap"
    content = write(path, enable_crcs=False, compression=CompressionType.NONE, chunk_size=1 << 20)
    data = read(path, bytes(change_letter(content, b"angular", b"p", copy=copy)))
    assert set(data.topics[0].fields) == {"linear", "angulap" if copy == 0 else "angular"}
    assert [loss.kind for loss in data.losses] == ["damaged_summary", "contradiction"]
