"""What a file says of sizes never decides how much memory is taken."""

import struct
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap_files import FLOAT, START, TEXT

from pipeline.core.compute import map_in_order
from pipeline.logs import LogError, Strings, Wanted, open_log, read_topics
from pipeline.logs import cdr as cdr_module
from pipeline.logs.chunks import InflateError, inflate, inflate_start
from pipeline.logs.writer import LogWriter

MIB = 1 << 20


def pack_zstd(size: int, *, told: bool) -> bytes:
    compressor = zstandard.ZstdCompressor(write_content_size=told).compressobj(size=size if told else -1)
    return b"".join(compressor.compress(bytes(MIB)) for _ in range(size // MIB)) + compressor.flush()


def pack_lz4(size: int, *, told: bool) -> bytes:
    return lz4.frame.compress(bytes(size), store_size=told)


@pytest.mark.parametrize("told", [True, False], ids=["size in the frame", "no size in the frame"])
@pytest.mark.parametrize(("compression", "pack"), [("zstd", pack_zstd), ("lz4", pack_lz4)])
def test_a_frame_that_inflates_to_more_than_its_chunk_says_is_refused(
    compression: str, pack: Callable[..., bytes], *, told: bool
) -> None:
    packed = pack(64 * MIB, told=told)
    with pytest.raises(InflateError):
        inflate(packed, compression, 1000)
    assert len(inflate_start(packed, compression, 1000)) <= 1000


@pytest.mark.parametrize("size", [300 * MIB, 2**31, 2**62])
def test_a_chunk_that_grows_as_no_recording_does_is_refused_unseen(size: int) -> None:
    with pytest.raises(InflateError, match=r"cannot hold|as no recording does"):
        inflate(bytes(40_000), "zstd", size)


def write_bomb(path: Path, chunks: int, size: int) -> None:
    """Chunks of a few kilobytes that each inflate to much."""
    message = struct.pack("<BQHIQQ", 5, size - 9, 1, 0, START, START) + bytes(4)
    schema = struct.pack("<BQHI", 3, 2 + 4 + 4 + 4 + 7 + 4 + 12, 1, 4) + b"demo"
    schema += struct.pack("<I", 7) + b"ros2msg" + struct.pack("<I", 12) + b"uint8[] data"
    channel = struct.pack("<BQHHI", 4, 2 + 2 + 4 + 2 + 4 + 3 + 4, 1, 1, 2) + b"/x"
    channel += struct.pack("<I", 3) + b"cdr" + struct.pack("<I", 0)
    records = message[:-4] + bytes(size - len(message) + 4)
    packed = zstandard.ZstdCompressor().compress(records)
    body = struct.pack("<QQQII", START, START, size, 0, 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    chunk = struct.pack("<BQ", 6, len(body)) + body
    head = struct.pack("<BQII", 1, 8, 0, 0)
    path.write_bytes(b"\x89MCAP0\r\n" + head + schema + channel + chunk * chunks)


@pytest.mark.long
def test_bombs_on_many_threads_stay_within_the_budget_of_all(tmp_path: Path) -> None:
    """24 chunks of a few kB that inflate to 128 MiB each: 3 GiB on 16 threads."""
    path = tmp_path / "bomb.mcap"
    write_bomb(path, 24, 128 * MIB)
    assert path.stat().st_size < MIB
    code = (
        "import sys\n"
        "from pipeline.logs import *\n"
        "index = open_log(sys.argv[1])\n"
        "data = read_topics(index, [Wanted('/x', ())], threads=16, sha256='-')\n"
        "status = open('/proc/self/status').read()\n"
        "print(next(l.split()[1] for l in status.splitlines() if l.startswith('VmHWM')))\n"
    )
    root = Path(__file__).parents[2]
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, cwd=root, check=False
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.split()[-1]) < 1.75 * MIB, "kilobytes: 1 GiB in flight, and what is used of it"


def test_no_more_is_in_flight_than_the_limit() -> None:
    held, most, lock = [0], [0], threading.Lock()
    weights = [30, 30, 30, 250, 10, 10, 90, 90, 5] * 5

    def work(weight: int) -> int:
        with lock:
            held[0] += weight
            most[0] = max(most[0], held[0])
        return weight

    for number, weight in enumerate(map_in_order(work, weights, 4, weigh=lambda weight: weight, limit=100)):
        assert weight == weights[number]
        with lock:
            held[0] -= weight
    assert 90 <= most[0] <= 250


def test_a_huge_string_is_cut_and_said(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    huge = "x" * (8 * MIB)
    with LogWriter(path) as writer:
        times = START + np.arange(6)
        writer.write_columns("/text", TEXT, times, {"data": [huge] * 3 + ["short"] * 3})
        writer.write_columns("/x", FLOAT, times, {"data": np.arange(6.0)})
    data = read_topics(path, [Wanted("/text"), Wanted("/x")])
    column = data.of("/text")[0].fields["data"]
    assert isinstance(column, Strings)
    assert [len(text) for text in column.values] == [cdr_module.MAX_TEXT + len(" (cut, of 8388608 bytes)"), 5]
    (loss,) = data.losses
    assert (loss.kind, "3 strings in data of /text" in loss.text) == ("long_string", True)


def test_more_strings_than_memory_bears_are_refused_with_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path) as writer:
        texts = [f"{row:050d}" for row in range(300)]
        writer.write_columns("/text", TEXT, START + np.arange(300), {"data": texts})
    assert len(read_topics(path, [Wanted("/text")]).of("/text")[0]) == 300
    monkeypatch.setattr(cdr_module, "MAX_TEXTS", 10_000)
    with pytest.raises(LogError, match="distinct strings of data take more") as caught:
        read_topics(path, [Wanted("/text")])
    assert caught.value.code == "too_many_strings"


def test_a_huge_terrain_is_a_name_of_bearable_length(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path) as writer:
        writer.metadata("deployment", {"vehicle": "husky_a200", "terrain": "g" * (8 * MIB)})
        writer.write_columns("/x", FLOAT, START + np.arange(6), {"data": np.arange(6.0)})
    recorded = open_log(path).deployment
    assert recorded == {"vehicle": "husky_a200", "terrain": "g" * 200 + "... (cut, of 8,388,608 characters)"}
