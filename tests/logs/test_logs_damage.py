"""A damaged log gives everything that is whole, nothing that is wrong, and says what is missing."""

import struct
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType
from mcap_files import (
    START,
    WITHOUT_INDEX,
    chunk_places,
    read_damaged,
    read_small,
    record_starts,
    records_of,
    small_log,
    truth_without,
    write_official,
)

from pipeline.logs import LogError, Wanted, open_log, read_topics
from pipeline.logs.writer import LogWriter


@pytest.mark.parametrize("compression", ["zstd", "lz4", ""])
def test_a_file_cut_anywhere_gives_all_before_the_cut(tmp_path: Path, compression: str) -> None:
    content, truth = small_log(rows=30, compression=compression)
    ends = [(b, struct.unpack_from("<Q", content, a + 17)[0]) for a, b in chunk_places(content)]
    for start in record_starts(content):
        for cut in (start - 1, start, start + 1):
            found, losses = read_damaged(tmp_path / "log.mcap", content[:cut], truth)
            whole = max((last for end, last in ends if end <= cut), default=0)
            assert len(found) >= sum(time <= whole for _, time in truth), cut
            assert losses, cut


def test_a_cut_names_bytes_and_time(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    content, truth = small_log(compression="")
    start, end = chunk_places(content)[5]
    path.write_bytes(content[: (start + end) // 2])
    data, found = read_small(path)
    last = max(time for _, time in found)
    (loss,) = [loss for loss in data.losses if loss.kind == "truncated"]
    assert (loss.bytes, loss.start_ns) == ((start + end) // 2 - start, last)
    assert all(key in found for key in truth if key[1] <= last)
    assert any(key[1] > struct.unpack_from("<Q", content, start + 9)[0] for key in found)


@pytest.mark.parametrize("compression", ["zstd", "lz4", ""])
@pytest.mark.parametrize(
    ("mask", "step"),
    [pytest.param(mask, 1, marks=pytest.mark.long) for mask in (0x01, 0xFF)] + [(0xFF, 37)],
)
def test_a_flipped_byte_is_never_returned_as_good(
    tmp_path: Path, compression: str, mask: int, step: int
) -> None:
    content, truth = small_log(rows=24, compression=compression)
    chunks = chunk_places(content)
    largest = max(-(-len(truth) // len(chunks)) * 3, 12)
    for place in range(3 % step, len(content), step):
        damaged = bytearray(content)
        damaged[place] ^= mask
        found, losses = read_damaged(tmp_path / "log.mcap", bytes(damaged), truth)
        is_inside = any(start <= place < end for start, end in chunks)
        assert len(found) >= len(truth) - (largest if is_inside else 0), place
        assert losses or len(found) == len(truth), place


@pytest.mark.parametrize("size", [64, 512])
def test_zeroed_pages_cost_only_what_stood_there(tmp_path: Path, size: int) -> None:
    content, truth = small_log(compression="")
    for start in range(0, len(content), 5 * size):
        damaged = content[:start] + bytes(size) + content[start + size :]
        found, losses = read_damaged(tmp_path / "log.mcap", damaged[: len(content)], truth)
        assert not start or len(found) >= len(truth) - 40, start
        assert losses or found == truth, start


def test_a_zero_padded_tail_is_a_cut(tmp_path: Path) -> None:
    content, truth = small_log()
    for start, end in chunk_places(content)[2:5]:
        padded = content[: (start + end) // 2] + bytes(4096)
        found, losses = read_damaged(tmp_path / "log.mcap", padded, truth)
        whole, _ = read_damaged(tmp_path / "log.mcap", content[:start], truth)
        assert found.keys() >= whole.keys()
        assert "truncated" in losses


SUMMARIES: list[dict[str, Any]] = [
    {"index_types": IndexType.CHUNK},
    {"use_summary_offsets": False},
    {"enable_data_crcs": True},
    {"compression": CompressionType.LZ4},
    {"compression": CompressionType.NONE, "chunk_size": 1},
]
NO_SUMMARIES: list[dict[str, Any]] = [
    {"index_types": WITHOUT_INDEX, "use_statistics": False, "use_summary_offsets": False},
    {"index_types": IndexType.MESSAGE},
    {"repeat_schemas": False},
    {"repeat_channels": False},
    {"use_statistics": False},
]


@pytest.mark.parametrize("options", [*SUMMARIES, *NO_SUMMARIES], ids=str)
def test_no_choice_of_the_recorder_loses_anything(tmp_path: Path, options: dict[str, Any]) -> None:
    path = tmp_path / "log.mcap"
    truth = write_official(path, **options)
    data, found = read_small(path)
    assert (found, data.losses, data.index.message_count) == (truth, (), len(truth))
    assert any("rebuilt" in note for note in data.notes) == (options in NO_SUMMARIES)


def flip(content: bytes, place: int, mask: int = 0xFF) -> bytes:
    return content[:place] + bytes([content[place] ^ mask]) + content[place + 1 :]


def find_record(content: bytes, opcode: int) -> int:
    return next(start for start in record_starts(content) if content[start] == opcode)


def flip_chunk(content: bytes) -> bytes:
    start, end = chunk_places(content)[0]
    return flip(content, (start + end) // 2)


def stop_chunk(content: bytes) -> bytes:
    """The second half of a chunk and what comes next were never written."""
    start, end = chunk_places(content)[4]
    cut = (start + end) // 2
    return content[:cut] + bytes(end - cut + 100) + content[end + 100 :]


BARE = {"official": True, "enable_crcs": False}
NONE, EVERY = -1, -2
DAMAGE: dict[str, tuple[dict[str, Any], Callable[[bytes], bytes], list[str], int]] = {
    "no last magic": ({}, lambda content: content[:-8], ["damaged_summary"], NONE),
    "no footer": ({}, lambda content: content[: -8 - 29], ["damaged_summary"], NONE),
    "a cut summary": ({}, lambda content: content[: -8 - 29 - 40], ["truncated"], NONE),
    **{
        f"a wrong summary without checksum, {inside}": (
            BARE,
            lambda content, inside=inside: flip(content, find_record(content, 8) + 9 + inside, 0x10),
            ["damaged_summary"],
            NONE,
        )
        for inside in (16, 24)
    },
    "a chunk whose end was never written": ({"compression": ""}, stop_chunk, ["chunk_crc"], 4),
    "channels lost": (
        {},
        lambda content: flip_chunk(content)[: find_record(content, 0x0F)],
        ["damaged_chunk", *["unknown_channel"] * 3, "damaged_summary"],
        EVERY,
    ),
    "channels that only the cut summary names": (
        {},
        lambda content: flip_chunk(content)[:-60],
        ["truncated", "damaged_chunk"],
        0,
    ),
}
"""How a log is written, what happens to it, the losses told, and the chunk whose messages are lost."""


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_costs_what_stood_there_and_is_told(tmp_path: Path, name: str) -> None:
    options, change, told, lost = DAMAGE[name]
    content, truth = small_log(**options)
    left = truth if lost == NONE else {} if lost == EVERY else truth_without(truth, content, lost)
    assert read_damaged(tmp_path / "log.mcap", change(content), truth) == (left, told)


def test_a_lost_message_index_loses_nothing(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    whole, truth = small_log()
    content = bytearray(whole)
    for start, end in pairwise(record_starts(whole)):
        if content[start] == 7:
            content[start + 9 : end] = bytes(end - start - 9)
    path.write_bytes(content)
    data, found = read_small(path)
    assert found == truth
    (loss,) = data.losses
    assert loss.kind == "checksum_mismatch"
    assert "messages that were read are whole" in loss.text
    assert any("message indexes" in note for note in data.notes)


def write_odometry(path: Path) -> np.ndarray:
    """Uncompressed chunks that end in zeros, as the covariance of the twist does."""
    x = np.arange(60) * 0.25
    with LogWriter(path, chunk_size=3000, compression="") as writer:
        fields = {"pose.pose.position.x": x, "pose.pose.orientation.w": 1.0}
        writer.write_columns("/odom", "nav_msgs/msg/Odometry", START + np.arange(60) * 20_000_000, fields)
    return x


def test_a_damaged_chunk_that_ends_in_zeros_is_not_a_cut_one(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write_odometry(path)
    content = path.read_bytes()
    for start, end in chunk_places(content)[1:4]:
        assert not any(content[end - 64 : end])
        for place in range(start + 60, end, 97):
            damaged = bytearray(content)
            damaged[place] ^= 0x40
            path.write_bytes(damaged)
            data = read_topics(path, [Wanted("/odom", ("pose.pose.position.x",))], sha256="-")
            assert [loss.kind for loss in data.losses] == ["chunk_crc"], place
            (columns,) = data.topics
            rows = (columns.log_time - START) // 20_000_000
            assert columns.fields["pose.pose.position.x"].tolist() == (rows * 0.25).tolist()


def test_without_a_checksum_the_rest_of_a_damaged_chunk_is_lost_and_told(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    whole, truth = small_log(official=True, enable_crcs=False, compression=CompressionType.NONE)
    content = bytearray(whole)
    start, end = chunk_places(bytes(content))[4]
    first, last = struct.unpack_from("<QQ", content, start + 9)
    places = [start + 49]
    while places[-1] < end:
        places.append(places[-1] + 9 + struct.unpack_from("<Q", content, places[-1] + 1)[0])
    middle = places[len(places) // 2]
    content[middle : middle + 9] = b"\xee" * 9
    path.write_bytes(content)
    data, found = read_small(path)
    (loss,) = data.losses
    assert (loss.kind, loss.chunks, loss.bytes, loss.end_ns) == ("damaged_record", 1, end - middle, last)
    assert first <= (loss.start_ns or 0) <= last
    assert found.keys() >= {key for key in truth if key[1] <= (loss.start_ns or 0) or key[1] > last}
    assert found.items() <= truth.items()


def test_a_damaged_chunk_names_its_time(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    content, truth = small_log(compression="")
    start, end = chunk_places(content)[4]
    path.write_bytes(flip(content, end - 20, 0x10))
    data, found = read_small(path)
    (loss,) = data.losses
    assert (loss.kind, loss.chunks, loss.bytes) == ("chunk_crc", 1, end - start)
    assert (loss.start_ns, loss.end_ns) == struct.unpack_from("<QQ", content, start + 9)
    assert found == truth_without(truth, content, 4)
    assert not data.index.losses


def test_damage_in_an_unchunked_log_costs_one_message(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    content, truth = small_log(official=True, rows=40, use_chunking=False)
    assert read_damaged(path, content, truth) == (truth, [])
    places = [start for start in record_starts(content)[:-1] if content[start] == 5]
    for start in places[5:-5:7]:
        damaged = bytearray(content)
        damaged[start : start + 9] = b"\xee" * 9
        path.write_bytes(damaged)
        data, found = read_small(path)
        assert len(found) == len(truth) - 1
        assert any(loss.kind == "damaged_record" and loss.bytes for loss in data.losses)
    cut, losses = read_damaged(path, content[: places[-3] + 4], truth)
    assert len(cut) == len(truth) - 3
    assert "truncated" in losses


def test_absurd_lengths_are_refused_before_memory_is_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    content, truth = small_log()
    start, end = chunk_places(content)[2]
    for place in (start + 1, start + 9 + 16, start + 9 + 28, start + 9 + 32 + 4):
        for size in (1 << 60, (1 << 64) - 1, 1 << 34):
            damaged = bytearray(content)
            struct.pack_into("<Q", damaged, place, size)
            found, losses = read_damaged(path, bytes(damaged), truth)
            assert len(found) >= len(truth) - 12
            assert losses
            damaged = damaged[: len(content) - 60]
            found, losses = read_damaged(path, bytes(damaged), truth)
            assert len(found) >= len(truth) - 12
    assert end > start


def test_the_records_counted_here_are_the_official_ones() -> None:
    content, _ = small_log()
    assert len(records_of(content)) == len(record_starts(content)) - 1


def test_what_is_no_log_is_refused_with_one_line(tmp_path: Path) -> None:
    empty, text, folder = tmp_path / "empty.mcap", tmp_path / "text.mcap", tmp_path / "folder"
    empty.write_bytes(b"")
    text.write_bytes(b"no log at all, only text")
    folder.mkdir()
    codes = []
    for path in (empty, text, folder, tmp_path / "absent.mcap"):
        with pytest.raises(LogError) as caught:
            open_log(path)
        assert "\n" not in str(caught.value)
        codes.append(caught.value.code)
    assert codes == ["log_empty", "not_mcap", "not_a_recording", "log_not_found"]
