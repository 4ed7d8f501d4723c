"""Damages every byte of small logs, one at a time, and counts what the reader makes of it.

Each byte is changed in three ways: one bit flipped, all bits inverted, and set to 0x00 (0xFF where it was
0x00 already). What is read is compared with the undamaged log: every message with its topic, times and
fields, and the metadata. It fails where a checksum covers the byte and something else was returned without a
word.

With --analyses 500 that many damages are made of six recordings in three formats (MCAP, bags of ROS 1, SQLite
files of rosbag2; three where ../shared is not), and each is analyzed: bits flipped, the end cut off, blocks,
chunks and messages lost. It fails where slip is neither refused nor that of the same rows of the whole
recording, within the interval of their median.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Final

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "fixtures")]

from mcap.writer import CompressionType, Writer  # noqa: E402 - the repository is put on the path first
from mcap_files import payloads, record_starts, value_in_full  # noqa: E402

from pipeline.logs import LogError, Wanted, open_log, read_topics  # noqa: E402

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

START: Final = 1_700_000_000_000_000_000
ROWS: Final = 5
POSE: Final = "string frame\nfloat64 x\nfloat64[10] covariance"
"""Messages that end in zeros, as odometry without covariance does."""

LOGS: Final[Mapping[str, Mapping[str, object]]] = {
    "zstd, chunk CRC": {"compression": CompressionType.ZSTD},
    "uncompressed, chunk CRC": {"compression": CompressionType.NONE},
    "unchunked, data CRC": {"use_chunking": False, "enable_data_crcs": True},
    "uncompressed, data CRC": {
        "compression": CompressionType.NONE,
        "enable_crcs": False,
        "enable_data_crcs": True,
    },
    "uncompressed, no checksum": {"compression": CompressionType.NONE, "enable_crcs": False},
}
"""Options of the official writer; each log also has metadata, an attachment and a summary."""

OUTCOMES: Final = (
    "identical",
    "identical, reported",
    "part lost, reported",
    "doubtful, reported",
    "refused",
    "SILENT",
)
PATTERNS: Final = ("one bit", "00/FF", "inverted")
NO_CHECKSUM: Final = "none"

Content = tuple[dict[tuple[str, str, int, int], object], object]


def write_log(path: Path, options: Mapping[str, object]) -> None:
    """A log of three topics, two chunks."""
    pose: dict[str, object] = {"frame": "odom", "x": [0.25 * row for row in range(ROWS)]}
    topics: dict[str, tuple[str, str, dict[str, object]]] = {
        "/pose": ("demo/msg/Pose", POSE, pose),
        "/speed": ("std_msgs/msg/Float64", "float64 data", {"data": [1.5 * row for row in range(ROWS)]}),
        "/state": ("std_msgs/msg/String", "string data", {"data": [f"state {row}" for row in range(ROWS)]}),
    }
    with path.open("wb") as stream:
        writer = Writer(stream, **{"chunk_size": 500, **options})  # type: ignore[arg-type]
        writer.start(profile="ros2", library="damage")
        writer.add_metadata("deployment", {"vehicle": "husky_a200", "terrain": "grass"})
        encoded = {}
        for topic, (kind, text, fields) in topics.items():
            schema = writer.register_schema(kind, "ros2msg", text.encode())
            channel = writer.register_channel(topic, "cdr", schema)
            encoded[channel] = payloads(kind, ROWS, fields, text)
        for row in range(ROWS):
            for channel, rows in encoded.items():
                time_ns = START + row * 10_000_000 + channel
                writer.add_message(channel, time_ns, rows[row], time_ns, row)
        writer.add_attachment(START, START, "map.txt", "text/plain", b"a map of the place")
        writer.finish()


def find_cover(content: bytes, options: Mapping[str, object]) -> list[str]:
    """Which checksum covers each byte: ``chunk``, ``data``, ``summary``, ``attachment`` or ``none``.

    A stored checksum covers itself; the head of a chunk is covered by the summary, which repeats it.
    """
    cover = [NO_CHECKSUM] * len(content)
    starts = record_starts(content)
    ends = dict(pairwise(starts))
    data_end = next(start for start in starts if content[start] == 0x0F)
    has_data, has_crcs = bool(options.get("enable_data_crcs")), options.get("enable_crcs", True)

    def mark(start: int, stop: int, name: str) -> None:
        cover[start:stop] = [name] * (stop - start)

    if has_data:
        mark(0, ends[data_end], "data")
    if has_crcs:
        mark(ends[data_end], starts[-1], "summary")
    for start, stop in ends.items():
        if content[start] == 0x06 and has_crcs:
            named = int.from_bytes(content[start + 37 : start + 41], "little")
            mark(start + 33, start + 37, "chunk")
            mark(start + 41 + named + 8, stop, "chunk")
        if content[start] == 0x09 and not has_data:
            mark(start + 9, stop, "attachment")
    return cover


def read_content(path: Path) -> tuple[Content, list[str]]:
    """Every message and the metadata, and the kinds of what was lost."""
    index = open_log(path)
    data = read_topics(index, [Wanted(topic) for topic in index.topics()], threads=1, sha256="-")
    found: dict[tuple[str, str, int, int], object] = {}
    for columns in data.topics:
        times = zip(columns.log_time.tolist(), columns.publish_time.tolist(), strict=True)
        for row, (log, publish) in enumerate(times):
            key = columns.topic, columns.type_name, log, publish
            found[key] = value_in_full(columns.fields, row)
    return (found, index.metadata), [loss.kind for loss in data.losses]


def judge(path: Path, truth: Content) -> str:
    """What becomes of a damaged log."""
    try:
        (found, metadata), losses = read_content(path)
    except LogError as error:
        if "\n" in str(error):
            raise AssertionError(f"no single line: {error}") from error
        return "refused"
    messages, records = truth
    if (found, metadata) == (messages, records):
        return "identical, reported" if losses else "identical"
    if not losses:
        return "SILENT"
    true = metadata == records and all(messages.get(key) == value for key, value in found.items())
    return "part lost, reported" if true else "doubtful, reported"


def damage(byte: int) -> Iterator[tuple[str, int]]:
    """The byte changed in each way."""
    yield "one bit", byte ^ 0x10
    yield "00/FF", 0x00 if byte else 0xFF
    yield "inverted", byte ^ 0xFF


def damage_log(folder: Path, options: Mapping[str, object], step: int) -> Counter[tuple[str, str, str]]:
    """Outcomes of one log by checksum, pattern and outcome."""
    whole, path = folder / "whole.mcap", folder / "damaged.mcap"
    write_log(whole, options)
    content = whole.read_bytes()
    truth, losses = read_content(whole)
    if losses:
        raise AssertionError(losses)
    cover = find_cover(content, options)
    counts: Counter[tuple[str, str, str]] = Counter()
    for place in range(0, len(content), step):
        for pattern, byte in damage(content[place]):
            path.write_bytes(content[:place] + bytes([byte]) + content[place + 1 :])
            outcome = judge(path, truth)
            counts[cover[place], pattern, outcome] += 1
            if outcome == "SILENT":
                _remember(counts, content, place)
    return counts


def _remember(counts: Counter[tuple[str, str, str]], content: bytes, place: int) -> None:
    """Count in which kind of record it was that nothing was noticed."""
    record = max((start for start in record_starts(content) if start <= place), default=0)
    counts["silent in record", f"0x{content[record]:02x}", "SILENT"] += 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--step", type=int, default=1, help="every so many bytes")
    parser.add_argument("--json", type=Path, help="also write the table there")
    parser.add_argument("--analyses", type=int, default=0, help="analyze so many damaged recordings instead")
    parser.add_argument("--workers", type=int, default=2, help="processes that analyze")


def run(given: argparse.Namespace) -> int:
    """Damage every log, print the table."""
    if given.analyses:
        from damaged_analyses import run_analyses  # noqa: PLC0415 - heavy

        return run_analyses(given.analyses, given.workers)
    print(f"{'log':27s} {'covered by':11s} {'pattern':9s}" + "".join(f"{name:>17s}" for name in OUTCOMES))
    rows = []
    silent = 0
    for name, options in LOGS.items():
        with tempfile.TemporaryDirectory() as folder:
            counts = damage_log(Path(folder), options, given.step)
        for cover in ("chunk", "data", "summary", "attachment", NO_CHECKSUM):
            for pattern in PATTERNS:
                numbers = [counts[cover, pattern, outcome] for outcome in OUTCOMES]
                if not any(numbers):
                    continue
                print(f"{name:27s} {cover:11s} {pattern:9s}" + "".join(f"{each:17d}" for each in numbers))
                rows.append(
                    {
                        "log": name,
                        "cover": cover,
                        "pattern": pattern,
                        **dict(zip(OUTCOMES, numbers, strict=True)),
                    }
                )
                silent += numbers[-1] if cover != NO_CHECKSUM else 0
        unseen = {key[1]: count for key, count in counts.items() if key[0] == "silent in record"}
        if unseen:
            print(f"{'':27s} nothing was noticed in records {unseen}")
    print(f"\nwrong or missing without a word where a checksum covers the byte: {silent}")
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 1 if silent else 0
