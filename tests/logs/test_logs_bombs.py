"""A small file never asks for much work: bytes inflated and records read are bounded."""

import struct
import time
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap_files import START, WITHOUT_INDEX, chunk_places, record_starts, write_official, write_small

from pipeline.logs import Wanted, catalog, chunks, columns, open_log, read_topics
from pipeline.logs import records as rec

MIB = 1 << 20
HEAD = b"\x89MCAP0\r\n" + rec.HEAD.pack(rec.HEADER, 8) + bytes(8)


def text(content: str) -> bytes:
    return struct.pack("<I", len(content)) + content.encode()


def record(opcode: int, body: bytes) -> bytes:
    return rec.HEAD.pack(opcode, len(body)) + body


def schema() -> bytes:
    body = struct.pack("<H", 1) + text("demo") + text("ros2msg") + text("uint8[] data")
    return record(rec.SCHEMA, body)


def channel(number: int = 1, topic: str = "/x") -> bytes:
    return record(rec.CHANNEL, struct.pack("<HH", number, 1) + text(topic) + text("cdr") + bytes(4))


def message(size: int = 8) -> bytes:
    return record(rec.MESSAGE, struct.pack("<HIQQ", 1, 0, START, START) + bytes(size))


def chunk(content: bytes, compression: str = "zstd") -> bytes:
    packers = {"zstd": zstandard.ZstdCompressor().compress, "lz4": lz4.frame.compress, "": bytes}
    packed = packers[compression](content)
    body = struct.pack("<QQQI", START, START, len(content), 0) + text(compression)
    return record(rec.CHUNK, body + struct.pack("<Q", len(packed)) + packed)


class Work:
    """What was done while a file was read."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.inflated = self.parsed = self.digested = 0
        self._patch = monkeypatch
        self._count(chunks, "inflate", "inflated", len)
        self._count(rec, "parse_record", "parsed", lambda _: 1)
        self._count(columns, "blake2b", "digested", lambda _: 1)

    def _count(self, module: object, name: str, counter: str, measure: Callable[..., int]) -> None:
        function = getattr(module, name)

        def counting(*args: object, **options: object) -> object:
            found = function(*args, **options)
            setattr(self, counter, getattr(self, counter) + measure(found))
            return found

        self._patch.setattr(module, name, counting)


@pytest.fixture
def work(monkeypatch: pytest.MonkeyPatch) -> Work:
    return Work(monkeypatch)


def read(path: Path, content: bytes) -> dict[str, str]:
    """Write a file and read all of it: its losses by kind."""
    path.write_bytes(HEAD + content)
    index = open_log(path)
    data = read_topics(index, [Wanted(topic, ()) for topic in index.topics()], threads=1, sha256="-")
    return {loss.kind: loss.text for loss in data.losses}


def test_a_file_may_inflate_to_what_is_plausible_for_its_size() -> None:
    assert catalog.limit_inflated(8_000, None) == 512 * MIB
    assert catalog.limit_inflated(10**9, None) == 200 * 10**9, "the drives of real recordings reach 9 times"
    assert catalog.limit_inflated(10**12, None) == 1 << 40


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_chunks_beyond_the_budget_are_left_out_unread(
    tmp_path: Path, work: Work, monkeypatch: pytest.MonkeyPatch, compression: str
) -> None:
    monkeypatch.setattr(catalog, "_LEAST", 20 * MIB)
    monkeypatch.setattr(catalog, "_RATIO", 10)
    bomb = chunk(message(4 * MIB), compression)
    path = tmp_path / "log.mcap"
    losses = read(path, schema() + channel() + bomb * 12 + chunk(message()))
    size = path.stat().st_size
    most = max(20 * MIB, 10 * size)
    assert work.inflated <= 3 * most, "for the index, for the messages, for those with the same times"
    said = losses["max_inflated"]
    assert f"{12 * (4 * MIB + 31) / 1e6:.0f}" in said
    assert "of 13 chunks were left out; --max-inflated 51MB reads them" in said
    kept = open_log(path)
    assert kept.message_count == most // (4 * MIB + 31) + 1, "the small chunk behind them is read"
    (loss,) = [loss for loss in kept.losses if loss.kind == "max_inflated"]
    assert (loss.chunks, loss.start_ns, loss.end_ns) == (13 - kept.message_count, START, START)
    every = open_log(path, max_inflated=51_000_000)
    assert every.message_count == 13
    assert "max_inflated" not in {loss.kind for loss in every.losses}


@pytest.mark.parametrize("options", [{}, {"index_types": WITHOUT_INDEX}], ids=["summary", "no summary"])
def test_a_log_with_a_summary_has_a_budget_too(tmp_path: Path, options: dict[str, object]) -> None:
    path = tmp_path / "log.mcap"
    truth = write_official(path, chunk_size=700, **options)
    whole = open_log(path)
    assert not whole.losses
    assert whole.message_count == len(truth)
    some = read_topics(open_log(path, max_inflated=5_000), [Wanted("/speed")])
    assert [loss.kind for loss in some.losses] == ["max_inflated"]
    assert 0 < len(some.of("/speed")[0]) < len(truth) // 3


def test_a_size_that_is_damaged_uses_up_nothing(tmp_path: Path) -> None:
    """A chunk that says it inflates to more than its bytes can hold is refused before; the rest is read."""
    path = tmp_path / "log.mcap"
    truth = write_small(path, rows=20)
    content = bytearray(path.read_bytes()[:-200])
    place = content.index(rec.CHUNK, len(HEAD))
    struct.pack_into("<Q", content, place + 9 + 16, 1 << 50)
    path.write_bytes(content)
    index = open_log(path)
    assert "max_inflated" not in {loss.kind for loss in index.losses}
    assert index.message_count > len(truth) // 2


@pytest.mark.parametrize(
    "pattern",
    [bytes(31), b"\x05" + bytes(30), b"\0" + message(0) * 4, rec.HEAD.pack(rec.MESSAGE, 22), b"\x03\x04\x05"],
    ids=["zeros", "opcodes", "damage between records", "heads of records", "opcodes only"],
)
def test_a_chunk_of_no_records_is_told_once_and_not_searched(tmp_path: Path, pattern: bytes) -> None:
    path = tmp_path / "log.mcap"
    started = time.process_time()
    read(path, schema() + channel() + chunk(pattern * (4 * MIB // len(pattern))))
    assert time.process_time() - started < 5.0
    assert [loss.kind for loss in open_log(path).losses].count("damaged_record") == 1


def test_records_that_a_chunk_repeats_are_read_once(tmp_path: Path, work: Work) -> None:
    losses = read(tmp_path / "log.mcap", chunk(schema() + channel() * 20_000 + message()))
    assert work.parsed < 30
    assert "damaged_record" not in losses


def test_the_records_of_many_channels_are_read(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    channels = b"".join(channel(number, f"/robot/sensor_{number}") for number in range(1, 3_000))
    read(path, chunk(schema() + channels + message()))
    index = open_log(path)
    assert len(index.channels) == 2_999
    assert [loss.kind for loss in index.losses] == ["damaged_summary"]


def test_messages_whose_clock_stands_still_are_not_compared(tmp_path: Path, work: Work) -> None:
    read(tmp_path / "log.mcap", schema() + channel() + chunk(message() * 20_000))
    assert work.digested == 0


def metadata(name: str, entries: int) -> bytes:
    pairs = b"".join(text(str(number)) + text("") for number in range(entries))
    return record(rec.METADATA, text(name) + struct.pack("<I", len(pairs)) + pairs)


def test_metadata_is_read_to_a_limit_and_what_is_left_out_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_strings = []
    function = rec._Body.read_prefixed_string

    def counting(body: rec._Body) -> str:
        read_strings.append(1)
        return function(body)

    monkeypatch.setattr(rec._Body, "read_prefixed_string", counting)
    path = tmp_path / "log.mcap"
    losses = read(path, metadata("deployment", 3) + metadata("bomb", 15_000) * 20 + metadata("last", 2))
    assert len(read_strings) < 2 * 110_000
    assert "metadata records and attachments were left out" in losses["too_large"]
    assert "15 metadata" in losses["too_large"], "what comes behind is left out too"
    assert [name for name, _ in open_log(path).parts[0].catalog.metadata] == ["deployment", *["bomb"] * 6]


def test_bytes_of_metadata_are_read_to_a_limit(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    pair = text("map") + text("x" * 12 * MIB)
    large = record(rec.METADATA, text("large") + struct.pack("<I", len(pair)) + pair)
    losses = read(path, large * 8 + metadata("deployment", 3))
    assert "4 metadata records" in losses["too_large"]
    assert set(open_log(path).metadata) == {"large"}


def test_contradictions_are_told_once_for_each_channel(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(HEAD + schema() + b"".join(channel(1, f"/{row}") for row in range(2_000)))
    assert [loss.kind for loss in open_log(path).losses] == ["damaged_summary", "contradiction"]


def test_a_chunk_inside_of_a_chunk_is_not_inflated(tmp_path: Path, work: Work) -> None:
    inner = chunk(message(8 * MIB))
    losses = read(tmp_path / "log.mcap", schema() + channel() + chunk(inner * 3 + message()))
    assert work.inflated < MIB
    assert "damaged_record" in losses


def test_a_summary_that_lies_about_sizes_lets_nothing_more_be_inflated(tmp_path: Path, work: Work) -> None:
    """The budget counts what the summary says; a chunk that says otherwise of itself is not believed."""
    path = tmp_path / "log.mcap"
    write_official(path, rows=20, chunk_size=1 << 20)
    content = bytearray(path.read_bytes())
    assert not open_log(path).losses
    (start, end), *_ = chunk_places(bytes(content))
    listed = next(place for place in record_starts(bytes(content)) if content[place] == rec.CHUNK_INDEX)
    stored = chunk(message(8 * MIB))
    grown = content[:start] + stored + bytes(max(0, end - start - len(stored))) + content[end:]
    shift = len(grown) - len(content)
    index = listed + shift + 9
    struct.pack_into("<Q", grown, index + 24, len(stored))
    footer = len(grown) - 8 - 20
    struct.pack_into("<Q", grown, footer, struct.unpack_from("<Q", grown, footer)[0] + shift)
    struct.pack_into("<I", grown, footer + 16, 0)
    path.write_bytes(grown)
    read_topics(open_log(path, max_inflated=MIB), [Wanted("/speed")], threads=1)
    assert work.inflated < MIB
