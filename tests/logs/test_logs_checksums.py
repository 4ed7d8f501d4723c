"""What checksums cover is never returned wrong, and what none covers is said."""

import struct
from pathlib import Path
from typing import Any

import damage
import lz4.frame
import pytest
import zstandard
from mcap.writer import CompressionType, Writer
from mcap_files import (
    chunk_places,
    payloads,
    read_damaged,
    read_small,
    record_starts,
    small_log,
    small_truth,
    truth_without,
    write_official,
)

from pipeline.logs import definition_text


@pytest.mark.parametrize("change", [0x01, 0xFF0000, 0xFFFFFFFF])
def test_a_chunk_whose_stored_checksum_is_damaged_is_lost_and_told(tmp_path: Path, change: int) -> None:
    content, truth = small_log()
    damaged, place = bytearray(content), chunk_places(content)[3][0] + 9 + 24
    struct.pack_into("<I", damaged, place, struct.unpack_from("<I", content, place)[0] ^ change)
    left = truth_without(truth, content, 3)
    assert read_damaged(tmp_path / "log.mcap", bytes(damaged), truth) == (left, ["chunk_crc"])


@pytest.mark.parametrize("compression", ["zstd", ""])
def test_chunks_that_are_all_damaged_are_not_whole(tmp_path: Path, compression: str) -> None:
    """That every checksum differs is no evidence: here every chunk has the same bit wrong."""
    whole, truth = small_log(compression=compression)
    content, chunks = bytearray(whole), chunk_places(whole)
    for _, end in chunks:
        content[end - 20] ^= 0x10
    found, losses = read_damaged(tmp_path / "log.mcap", bytes(content), truth)
    assert not found
    assert losses.count("chunk_crc") + losses.count("damaged_chunk") == len(chunks) >= 9


@pytest.mark.parametrize(
    "options", [{"use_chunking": False}, {"enable_crcs": False, "compression": CompressionType.NONE}], ids=str
)
def test_the_checksum_of_the_data_section_is_used(tmp_path: Path, options: dict[str, Any]) -> None:
    path = tmp_path / "log.mcap"
    truth = write_official(path, enable_data_crcs=True, **options)
    data, found = read_small(path)
    assert found == truth
    assert not data.losses
    assert not data.unchecked
    content = path.read_bytes()
    section = next(start for start in record_starts(content) if content[start] == 0x0F)
    for place in range(20, section, 211):
        damaged = bytearray(content)
        damaged[place] ^= 0x08
        path.write_bytes(damaged)
        data, found = read_small(path)
        assert data.losses, place
        if found != truth and len(found) == len(truth):
            (text,) = [loss.text for loss in data.losses if loss.kind == "checksum_mismatch"]
            assert "any value may be wrong" in text


def test_a_log_without_checksums_is_called_unchecked(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write_official(path, enable_crcs=False)
    data, _ = read_small(path)
    assert not data.losses
    assert data.unchecked == "no checksum covers its messages: damage in them cannot be detected"
    write_official(path)
    assert not read_small(path)[0].unchecked


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_checksum_inside_the_compression_is_used(tmp_path: Path, compression: str) -> None:
    path = tmp_path / "log.mcap"
    truth = write_official(path, enable_crcs=False, compression=CompressionType.NONE, chunk_size=1 << 20)
    content = path.read_bytes()
    ((start, end),) = chunk_places(content)
    records = content[start + 49 : end]
    packed = {
        "zstd": zstandard.ZstdCompressor(write_checksum=True).compress(records),
        "lz4": lz4.frame.compress(records, content_checksum=True),
    }[compression]
    name = compression.encode()
    body = content[start + 9 : start + 37] + struct.pack("<I", len(name)) + name
    body += struct.pack("<Q", len(packed)) + packed
    chunk = b"\x06" + struct.pack("<Q", len(body)) + body
    path.write_bytes(content[:start] + chunk)
    data, found = read_small(path)
    assert found == truth
    assert not data.unchecked
    for place in range(len(chunk) - len(packed) + 20, len(chunk), 29):
        damaged = bytearray(chunk)
        damaged[place] ^= 0x04
        found, losses = read_damaged(path, content[:start] + bytes(damaged), truth)
        # Another distance to the same bytes is no damage.
        assert found == truth or (not found and "damaged_chunk" in losses)


@pytest.mark.parametrize(("opcode", "inside"), [(3, 8), (4, 10), (0x0D, 22), (0x0C, 6)])
def test_what_the_file_holds_twice_is_compared(tmp_path: Path, opcode: int, inside: int) -> None:
    """Without any checksum a damaged schema, channel or name of metadata is told by its other copy."""
    path = tmp_path / "log.mcap"
    topics, _ = small_truth(20)
    with path.open("wb") as stream:
        writer = Writer(stream, enable_crcs=False, compression=CompressionType.NONE)
        writer.start(profile="ros2", library="test")
        writer.add_metadata("deployment", {"vehicle": "husky_a200"})
        kind, time, fields = topics["/speed"]
        schema = writer.register_schema(kind, "ros2msg", (definition_text(kind) or "").encode())
        channel = writer.register_channel("/speed", "cdr", schema)
        for time_ns, payload in zip(time.tolist(), payloads(kind, time.size, fields), strict=True):
            writer.add_message(channel, time_ns, payload, time_ns)
        writer.finish()
    content = bytearray(path.read_bytes())
    assert not read_small(path)[0].losses
    place = next(start for start in record_starts(bytes(content)) if content[start] == opcode)
    content[place + 9 + inside] ^= 0x01
    path.write_bytes(content)
    data, _ = read_small(path)
    assert "contradiction" in [loss.kind for loss in data.losses]


def test_what_the_statistics_count_and_nobody_finds_is_told(tmp_path: Path) -> None:
    content, truth = small_log(official=True, enable_crcs=False, use_chunking=False)
    place = [start for start in record_starts(content) if content[start] == 5][7]
    damaged = content[:place] + b"\x85" + content[place + 1 :]
    assert read_damaged(tmp_path / "log.mcap", damaged, truth)[1] == ["missing_messages"]


@pytest.mark.parametrize("name", [name for name in damage.LOGS if "no checksum" not in name])
def test_no_damaged_byte_that_a_checksum_covers_is_returned_as_good(tmp_path: Path, name: str) -> None:
    """Some bytes of `make bench NAME=damage`, which tries them all."""
    counts = damage.damage_log(tmp_path, damage.LOGS[name], 61)
    wrong = [key for key in counts if key[2] == "SILENT" and key[0] not in ("none", "silent in record")]
    assert not wrong
    assert sum(counts.values()) > 50
