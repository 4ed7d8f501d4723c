"""Damages of recordings in three formats, and what an analysis makes of each: for `damage.py`."""

from __future__ import annotations

import sqlite3
import struct
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
import polars as pl
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_files import record_starts
from measuring import RECORDINGS
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.core import Floats, SlipError, arrays

SAMPLES: Final = Path(__file__).parents[1] / "data_samples"
SECONDS: Final = 45.0
"""Length of the drive that is written in every format [s]."""
_CHUNK: Final = 50_000
_TRANSFORMS: Final = "geometry_msgs/TransformStamped[] transforms\n"
_OTHERS: Final = (
    RECORDINGS / "warthog_wheels_grass_2024_7_29_14h46s15.mcap",
    RECORDINGS.parent / "foreign" / "fuse_turtlebot3.bag",
    RECORDINGS.parent / "foreign" / "nvnmangla_roomba.db3",
)
OUTCOMES: Final = ("refused", "told", "silent, equal", "WRONG, told", "WRONG, silent", "CRASH")
"""What becomes of a damaged recording. *Told*: its losses are, and slip is that of the same rows of the whole
recording; *silent, equal*: nothing is told, and slip is that; *wrong*: it is not."""
KINDS: Final = ("bit flips", "cut", "lost block", "lost chunk", "lost messages")


def _open_writer(path: Path) -> BagWriter:
    """Writer of a bag of ROS 1 with small chunks."""
    writer = BagWriter(path)
    writer.chunk_threshold = _CHUNK
    return writer


def write_formats(
    folder: Path, source: Path = SAMPLES / "mystery_2.mcap", seconds: float = SECONDS
) -> list[Path]:
    """The beginning of a log as MCAP, as a bag of ROS 1, and as an SQLite file of rosbag2."""
    store, old = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)
    old.register(get_types_from_msg(_TRANSFORMS, "tf2_msgs/msg/TFMessage"))
    stem = f"{source.stem}_part"
    bag, database = (
        _open_writer(folder / f"{stem}.bag"),
        FolderWriter(folder / stem, version=9, storage_plugin=StoragePlugin.SQLITE3),
    )
    connections = {}
    with (
        bag,
        database,
        source.open("rb") as stream,
        (folder / f"{stem}.mcap").open("wb") as target,
    ):
        writer = Writer(target, chunk_size=_CHUNK)
        writer.start(profile="ros2", library="damage")
        begin = None
        for schema, channel, message in make_reader(stream).iter_messages():
            if schema is None:
                continue
            kind = schema.name
            begin = message.log_time if begin is None else begin
            if message.log_time - begin > 1e9 * seconds or kind not in store.types or kind not in old.types:
                continue
            if channel.topic not in connections:
                given = writer.register_schema(kind, schema.encoding, schema.data)
                connections[channel.topic] = (
                    bag.add_connection(channel.topic, kind, typestore=old),
                    database.add_connection(channel.topic, kind, typestore=store),
                    writer.register_channel(channel.topic, "cdr", given),
                )
            one, other, number = connections[channel.topic]
            bag.write(one, message.log_time, store.cdr_to_ros1(message.data, kind))
            database.write(other, message.log_time, message.data)
            writer.add_message(number, message.log_time, message.data, message.publish_time)
        writer.finish()
    (file,) = (folder / stem).glob("*.db3")
    return [folder / f"{stem}.mcap", folder / f"{stem}.bag", file]


# What damages a recording.


def flip_bits(path: Path, rng: np.random.Generator) -> None:
    """One bit anywhere, or up to thirty."""
    content = bytearray(path.read_bytes())
    for place in rng.integers(0, len(content), rng.choice((1, 1, 3, 30))):
        content[place] ^= 1 << int(rng.integers(8))
    path.write_bytes(content)


def cut(path: Path, rng: np.random.Generator) -> None:
    """The end is missing, as of a recorder that died."""
    size = path.stat().st_size
    with path.open("r+b") as file:
        file.truncate(int(size * rng.uniform(0.05, 0.99)))


def lose_block(path: Path, rng: np.random.Generator) -> None:
    """Some kilobytes are zeros, as after a disk fails, or are not there."""
    content = path.read_bytes()
    size = min(int(2.0 ** rng.uniform(9.0, 15.0)), len(content) // 2)
    start = int(rng.integers(0, len(content) - size))
    rest = b"" if rng.random() < 0.5 else bytes(size)
    path.write_bytes(content[:start] + rest + content[start + size :])


def lose_chunk(path: Path, rng: np.random.Generator) -> None:
    """A whole chunk is missing; of SQLite, a page is zeros."""
    content = path.read_bytes()
    if path.suffix == ".db3":
        page = int(rng.integers(1, len(content) // 4096))
        path.write_bytes(content[: 4096 * page] + bytes(4096) + content[4096 * (page + 1) :])
        return
    if path.suffix == ".mcap":
        starts = record_starts(content)
        spans = [(start, end) for start, end in pairwise(starts) if content[start] == 6]
    else:
        spans = _list_bag_chunks(content)
    start, end = spans[int(rng.integers(len(spans)))]
    path.write_bytes(content[:start] + content[end:])


def _list_bag_chunks(content: bytes) -> list[tuple[int, int]]:
    """Ends of the chunks of a bag of ROS 1."""
    spans, place = [], content.index(b"\n") + 1
    while place < len(content):
        (head,) = struct.unpack_from("<I", content, place)
        (size,) = struct.unpack_from("<I", content, place + 4 + head)
        end = place + 8 + head + size
        if b"op=\x05" in content[place + 4 : place + 4 + head]:
            spans.append((place, end))
        place = end
    return spans


def lose_messages(path: Path, rng: np.random.Generator) -> None:
    """Messages are missing, as of a recorder or a network that was too slow: a stretch, or some at random."""
    count, topics = _count_messages(path)
    kept = np.ones(count, dtype=bool)
    one = rng.choice(topics) if rng.random() < 0.5 else -1
    of_it = np.ones(count, dtype=bool) if one < 0 else topics == one
    if rng.random() < 0.5:
        start = rng.uniform(0.0, 0.8)
        place = np.arange(count) / count
        kept &= ~(of_it & (place >= start) & (place < start + rng.uniform(0.05, 0.4)))
    else:
        kept &= ~(of_it & (rng.random(count) < rng.uniform(0.05, 0.5)))
    _keep_messages(path, kept)


def _count_messages(path: Path) -> tuple[int, np.ndarray]:
    """Number of messages, and of the topic of each, in the order of the file."""
    if path.suffix == ".db3":
        with closing(sqlite3.connect(path)) as base:
            topics = [row[0] for row in base.execute("SELECT topic_id FROM messages ORDER BY id")]
    elif path.suffix == ".mcap":
        with path.open("rb") as stream:
            topics = [channel.id for _, channel, _ in make_reader(stream).iter_messages()]
    else:
        with _open_bag(path) as bag:
            topics = [connection.id for connection, _, _ in bag.messages()]
    return len(topics), np.array(topics)


def _open_bag(path: Path):  # noqa: ANN202 - a context of rosbags
    from rosbags.rosbag1 import Reader  # noqa: PLC0415 - beside the writer of the same name

    return Reader(path)


def _keep_messages(path: Path, kept: np.ndarray) -> None:
    """Write a recording anew with some of its messages."""
    if path.suffix == ".db3":
        with closing(sqlite3.connect(path)) as base:
            ids = [row[0] for row in base.execute("SELECT id FROM messages ORDER BY id")]
            gone = [(one,) for one, keep in zip(ids, kept.tolist(), strict=True) if not keep]
            base.executemany("DELETE FROM messages WHERE id = ?", gone)
            base.commit()
        return
    other = path.with_suffix(f".kept{path.suffix}")
    if path.suffix == ".mcap":
        with path.open("rb") as stream, other.open("wb") as target:
            writer = Writer(target, chunk_size=_CHUNK)
            writer.start(profile="ros2", library="damage")
            numbers: dict[int, int] = {}
            reader = make_reader(stream)
            rows = reader.iter_messages()
            for keep, (schema, channel, message) in zip(kept.tolist(), rows, strict=True):
                if channel.id not in numbers:
                    given = writer.register_schema(schema.name, schema.encoding, schema.data) if schema else 0
                    numbers[channel.id] = writer.register_channel(
                        channel.topic, channel.message_encoding, given, dict(channel.metadata)
                    )
                if keep:
                    place = numbers[channel.id]
                    writer.add_message(place, message.log_time, message.data, message.publish_time)
            for record in reader.iter_metadata():
                writer.add_metadata(record.name, record.metadata)
            writer.finish()
    else:
        with _open_bag(path) as bag, _open_writer(other) as target:
            known = {}
            for connection in bag.connections:
                known[connection.id] = target.add_connection(
                    connection.topic,
                    connection.msgtype,
                    msgdef=connection.msgdef.data,
                    md5sum=connection.digest,
                )
            for keep, (connection, time, data) in zip(kept.tolist(), bag.messages(), strict=True):
                if keep:
                    target.write(known[connection.id], time, data)
    other.replace(path)


DAMAGES: Final[Mapping[str, Callable[[Path, np.random.Generator], None]]] = dict(
    zip(KINDS, (flip_bits, cut, lose_block, lose_chunk, lose_messages), strict=True)
)


# What an analysis makes of it.


@dataclass(frozen=True)
class Analyzed:
    """What an analysis says of a recording.

    Attributes:
        refusal: the line of its refusal; empty if it is none.
        losses: whether losses are told.
        slip: moduli [m/s] with their times, absolute [ns] and since the beginning [s], by input.
    """

    refusal: str
    losses: bool = False
    slip: Mapping[str, pl.DataFrame] | None = None


def analyze(path: Path) -> Analyzed:
    """Analyze a recording, without diagnosis and report.

    Raises:
        AssertionError: a refusal of several lines.
    """
    with tempfile.TemporaryDirectory() as folder:
        try:
            made = analyze_log(path, Options(out=Path(folder), report=False, diagnosis=False))
        except SlipError as error:
            if "\n" in str(error):
                raise AssertionError(f"no single line: {error}") from error
            return Analyzed(str(error))
        rows = made.manifest.read("slip").select("input", "stamp", "t", "modulus").drop_nulls()
        parts = {str(name): part.sort("stamp") for (name,), part in rows.group_by("input")}
        return Analyzed(made.refusal, made.lossy, parts)


_STEP_S: Final = 0.05
"""Step of the rows of slip [s]."""
_FEWEST: Final = 20
"""Least number of rows, a second, whose median is compared."""


def is_equal(whole: pl.DataFrame, part: pl.DataFrame) -> bool:
    """Whether the median of slip lies within the 95 % interval of the median of the same rows of the whole.

    Slip is correlated over about a second: seconds are counted, not rows. Of a log of which a time is damaged
    the rows are found by their times since its beginning.
    """
    if part.height < _FEWEST:
        return True
    pairs = [_pair(whole, part, name) for name in ("stamp", "t")]
    same, rows = max(pairs, key=lambda pair: pair[1].size)
    if rows.size < _FEWEST:
        return False
    seconds = rows.size * _STEP_S
    half = min(0.5, 0.98 / np.sqrt(seconds))
    low, high = np.quantile(same, (0.5 - half, 0.5 + half))
    margin = 1e-6 + 0.01 * float(np.median(same))
    return bool(low - margin <= float(np.median(rows)) <= high + margin)


def _pair(whole: pl.DataFrame, part: pl.DataFrame, name: str) -> tuple[Floats, Floats]:
    """Moduli of the rows of the whole, and of those of the part at the same times."""
    times, all_times = (one[name].to_numpy().astype(np.float64) for one in (part, whole))
    nearest = arrays.nearest_indices(times, all_times)
    known = np.abs(all_times[nearest] - times) < (1e9 if name == "stamp" else 1.0) * _STEP_S
    return whole["modulus"].to_numpy()[nearest[known]], part["modulus"].to_numpy()[known]


def judge(whole: Analyzed, path: Path) -> tuple[str, str]:
    """What becomes of a damaged recording, one of `OUTCOMES`, and details of what is wrong."""
    try:
        part = analyze(path)
    except Exception as error:  # noqa: BLE001 - whatever it is, it is no line for a user
        return "CRASH", f"{type(error).__name__}: {error}"
    if part.refusal or part.slip is None:
        return "refused", ""
    known = whole.slip or {}
    wrong = [
        name
        for name, rows in part.slip.items()
        if whole.refusal or name not in known or not is_equal(known[name], rows)
    ]
    if wrong:
        medians = (f"{name} {_median(known.get(name))} -> {_median(part.slip[name])} m/s" for name in wrong)
        return f"WRONG, {'told' if part.losses else 'silent'}", "; ".join(medians)
    return ("told" if part.losses else "silent, equal"), ""


def _median(rows: pl.DataFrame | None) -> str:
    return "none" if rows is None else f"{float(np.median(rows['modulus'].to_numpy())):.3g}"


@dataclass(frozen=True)
class Damage:
    """One damage: of which recording, of which kind, and its number, which seeds it."""

    recording: Path
    kind: str
    number: int


def damage_one(damage: Damage, whole: Analyzed) -> tuple[Damage, str, str]:
    """Damage a copy of a recording, and judge it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / damage.recording.name
        path.write_bytes(damage.recording.read_bytes())
        DAMAGES[damage.kind](path, np.random.default_rng(damage.number))
        return damage, *judge(whole, path)


def list_damages(recordings: Sequence[Path], count: int) -> Iterator[Damage]:
    """Damages of all kinds of all recordings, by turns."""
    for number in range(count):
        kind, recording = number % len(KINDS), number // len(KINDS) % len(recordings)
        yield Damage(recordings[recording], KINDS[kind], number)


def run_analyses(count: int, workers: int) -> int:
    """Damage recordings, analyze each, print the table; 1 if a number is wrong."""
    with tempfile.TemporaryDirectory() as folder, ProcessPoolExecutor(workers) as pool:
        recordings = [*write_formats(Path(folder)), *(path for path in _OTHERS if path.exists())]
        wholes = dict(zip(recordings, pool.map(analyze, recordings), strict=True))
        jobs = list(list_damages(recordings, count))
        counts: Counter[tuple[str, str, str]] = Counter()
        made = pool.map(damage_one, jobs, [wholes[job.recording] for job in jobs])
        for damage, outcome, details in made:
            counts[damage.recording.name, damage.kind, outcome] += 1
            if details:
                print(
                    f"{damage.recording.name}, {damage.kind}, number {damage.number}: {outcome}: {details}",
                    flush=True,
                )
    print(f"\n{'recording':38s} {'damage':14s} {'damages':>8s}" + "".join(f"{one:>15s}" for one in OUTCOMES))
    keys = sorted({key[:2] for key in counts})
    for name, kind in keys:
        numbers = [counts[name, kind, outcome] for outcome in OUTCOMES]
        print(f"{name[:38]:38s} {kind:14s} {sum(numbers):8d}" + "".join(f"{each:15d}" for each in numbers))
    totals = [sum(each for key, each in counts.items() if key[2] == outcome) for outcome in OUTCOMES]
    print(f"{'all':53s} {sum(totals):8d}" + "".join(f"{each:15d}" for each in totals))
    return int(any(totals[3:]))
