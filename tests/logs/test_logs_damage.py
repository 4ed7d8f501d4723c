"""A damaged log gives everything that is whole, nothing that is wrong, and says what is missing."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType
from mcap_files import (
    START,
    WITHOUT_INDEX,
    Truth,
    chunk_places,
    read_damaged,
    read_small,
    record_starts,
    records_of,
    write_official,
    write_small,
)

from pipeline.logs import LogError, Wanted, open_log, read_topics
from pipeline.logs.writer import LogWriter


@pytest.mark.parametrize("compression", ["zstd", "lz4", ""])
def test_a_file_cut_anywhere_gives_all_before_the_cut(tmp_path: Path, compression: str) -> None:
    path = tmp_path / "log.mcap"
    truth = write_small(path, rows=30, compression=compression)
    content = path.read_bytes()
    chunks = chunk_places(content)
    starts = record_starts(content)
    times = sorted(time for _, time in truth)
    ends = [(b, struct.unpack_from("<Q", content, a + 17)[0]) for a, b in chunks]
    for start in starts:
        for cut in (start - 1, start, start + 1):
            found, losses = read_damaged(path, content[:cut], truth)
            whole = max((last for end, last in ends if end <= cut), default=0)
            before_cut = sum(time <= whole for time in times)
            assert len(found) >= before_cut, cut
            assert losses, cut


def test_a_cut_names_bytes_and_time(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    truth = write_small(path, compression="")
    content = path.read_bytes()
    start, end = chunk_places(content)[5]
    path.write_bytes(content[: (start + end) // 2])
    data, found = read_small(path)
    last = max(time for _, time in found)
    (loss,) = [loss for loss in data.losses if loss.kind == "truncated"]
    assert loss.bytes == (start + end) // 2 - start
    assert loss.start_ns == last
    assert all(key in found for key in truth if key[1] <= last)
    assert any(key[1] > struct.unpack_from("<Q", content, start + 9)[0] for key in found)


def flip_bytes(path: Path, truth: Truth, content: bytes, places: range, mask: int) -> None:
    largest = max(int(np.ceil(len(truth) / len(chunk_places(content)))) * 3, 12)
    inside = np.zeros(len(content), dtype=bool)
    for start, end in chunk_places(content):
        inside[start:end] = True
    for place in places:
        damaged = bytearray(content)
        damaged[place] ^= mask
        found, losses = read_damaged(path, bytes(damaged), truth)
        assert len(found) >= len(truth) - (largest if inside[place] else 0), place
        if len(found) < len(truth):
            assert losses, place


@pytest.mark.parametrize("compression", ["zstd", ""])
def test_a_flipped_byte_is_never_returned_as_good(tmp_path: Path, compression: str) -> None:
    path = tmp_path / "log.mcap"
    truth = write_small(path, rows=24, compression=compression)
    content = path.read_bytes()
    flip_bytes(path, truth, content, range(3, len(content), 17), 0xFF)


@pytest.mark.long
@pytest.mark.parametrize("mask", [0x01, 0xFF])
@pytest.mark.parametrize("compression", ["zstd", "lz4", ""])
def test_no_flipped_byte_is_ever_returned_as_good(tmp_path: Path, compression: str, mask: int) -> None:
    path = tmp_path / "log.mcap"
    truth = write_small(path, rows=24, compression=compression)
    content = path.read_bytes()
    flip_bytes(path, truth, content, range(len(content)), mask)


@pytest.mark.parametrize("size", [64, 512])
def test_zeroed_pages_cost_only_what_stood_there(tmp_path: Path, size: int) -> None:
    path = tmp_path / "log.mcap"
    truth = write_small(path, compression="")
    content = path.read_bytes()
    for start in range(0, len(content), 5 * size):
        damaged = content[:start] + bytes(size) + content[start + size :]
        found, losses = read_damaged(path, damaged[: len(content)], truth)
        if start:
            assert len(found) >= len(truth) - 40, start
            assert losses or found == truth, start


def test_a_zero_padded_tail_is_a_cut(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    truth = write_small(path)
    content = path.read_bytes()
    for start, end in chunk_places(content)[2:5]:
        cut = (start + end) // 2
        found, losses = read_damaged(path, content[:cut] + bytes(4096), truth)
        whole, _ = read_damaged(path, content[:start], truth)
        assert found.keys() >= whole.keys()
        assert "truncated" in losses


@pytest.mark.parametrize("lost", [8, 8 + 29, 8 + 29 + 40])
def test_a_lost_footer_loses_no_message(tmp_path: Path, lost: int) -> None:
    path = tmp_path / "log.mcap"
    truth = write_small(path)
    found, losses = read_damaged(path, path.read_bytes()[:-lost], truth)
    assert found == truth
    assert losses


def test_a_log_without_summary_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    truth = write_official(path, index_types=WITHOUT_INDEX, use_statistics=False, use_summary_offsets=False)
    data, found = read_small(path)
    assert found == truth
    assert not data.losses
    assert data.index.message_count == len(truth)
    assert any("rebuilt" in note for note in data.notes)


@pytest.mark.parametrize(
    "options",
    [
        {"index_types": IndexType.CHUNK},
        {"index_types": IndexType.MESSAGE},
        {"repeat_schemas": False},
        {"repeat_channels": False},
        {"use_statistics": False},
        {"use_summary_offsets": False},
        {"enable_data_crcs": True},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE, "chunk_size": 1},
    ],
    ids=str,
)
def test_no_choice_of_the_recorder_loses_anything(tmp_path: Path, options: dict[str, Any]) -> None:
    path = tmp_path / "log.mcap"
    truth = write_official(path, **options)
    data, found = read_small(path)
    assert found == truth
    assert not data.losses
    assert data.index.message_count == len(truth)


def test_a_wrong_summary_without_checksum_is_found_out(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    truth = write_official(path, enable_crcs=False)
    content = bytearray(path.read_bytes())
    index = next(start for start in record_starts(bytes(content)) if content[start] == 8)
    for place in (index + 9 + 16, index + 9 + 24):
        damaged = bytearray(content)
        damaged[place] ^= 0x10
        found, losses = read_damaged(path, bytes(damaged), truth)
        assert found == truth
        assert losses == ["damaged_summary"]


def test_messages_whose_channel_is_lost_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    truth = write_small(path)
    content = bytearray(path.read_bytes()[:-60])
    start, end = chunk_places(path.read_bytes())[0]
    summary = next(s for s in record_starts(path.read_bytes()) if path.read_bytes()[s] == 0x0F)
    content[(start + end) // 2] ^= 0xFF
    found, losses = read_damaged(path, bytes(content[:summary]), truth)
    assert not found
    assert losses.count("unknown_channel") == 3


def test_a_lost_message_index_loses_nothing(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    truth = write_small(path)
    content = bytearray(path.read_bytes())
    for start in record_starts(bytes(content))[:-1]:
        if content[start] == 7:
            length = int.from_bytes(content[start + 1 : start + 9], "little")
            content[start + 9 : start + 9 + length] = bytes(length)
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


def test_a_chunk_whose_end_was_never_written_is_lost_and_told(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    truth = write_small(path, compression="")
    content = path.read_bytes()
    start, end = chunk_places(content)[4]
    cut = (start + end) // 2
    found, losses = read_damaged(path, content[:cut] + bytes(end - cut + 100) + content[end + 100 :], truth)
    assert "chunk_crc" in losses
    first, last = struct.unpack_from("<QQ", content, start + 9)
    assert found == {key: value for key, value in truth.items() if not first <= key[1] <= last}


def test_without_a_checksum_the_rest_of_a_damaged_chunk_is_lost_and_told(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    truth = write_official(path, enable_crcs=False, compression=CompressionType.NONE)
    content = bytearray(path.read_bytes())
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


def test_where_the_summary_is_cut_its_records_name_what_a_damaged_chunk_named(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    truth = write_small(path)
    content = bytearray(path.read_bytes()[:-60])
    start, end = chunk_places(path.read_bytes())[0]
    content[(start + end) // 2] ^= 0xFF
    found, losses = read_damaged(path, bytes(content), truth)
    assert len(found) > len(truth) // 2
    assert "unknown_channel" not in losses


def test_a_damaged_chunk_names_its_time(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    truth = write_small(path, compression="")
    content = bytearray(path.read_bytes())
    start, end = chunk_places(bytes(content))[4]
    content[end - 20] ^= 0x10
    path.write_bytes(content)
    data, found = read_small(path)
    (loss,) = data.losses
    first, last = struct.unpack_from("<QQ", content, start + 9)
    assert (loss.kind, loss.chunks, loss.bytes) == ("chunk_crc", 1, end - start)
    assert (loss.start_ns, loss.end_ns) == (first, last)
    assert found == {key: value for key, value in truth.items() if not first <= key[1] <= last}
    assert not data.index.losses


@pytest.mark.parametrize("rows", [40])
def test_damage_in_an_unchunked_log_costs_one_message(tmp_path: Path, rows: int) -> None:
    path = tmp_path / "log.mcap"
    truth = write_official(path, rows=rows, use_chunking=False)
    content = path.read_bytes()
    _, found = read_small(path)
    assert found == truth
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
    truth = write_small(path)
    content = path.read_bytes()
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


def test_the_records_counted_here_are_the_official_ones(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write_small(path)
    content = path.read_bytes()
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
