"""Bags of ROS 1, opened with the rosbags library, and SQLite files of rosbag2.

Their messages are read one by one and decoded in blocks, like those of MCAP files. Damage costs the messages
in it: of a ROS 1 bag the index says where the next one begins. What a file yields is charged to an allowance,
however it was stored: chunks may inflate, several index entries may name one message, and columns of a
database may be computed.
"""

from __future__ import annotations

import os
import sqlite3
import struct
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from io import BufferedReader, FileIO
from pathlib import Path, PosixPath
from typing import TYPE_CHECKING, Any, Final, NamedTuple
from urllib.parse import quote

import numpy as np
from mcap.records import Channel, Schema

from pipeline.core import format_count, shorten
from pipeline.logs import records as rec
from pipeline.logs.catalog import OVER_BUDGET, Catalog
from pipeline.logs.chunks import Allowance, BudgetError, InflateError, inflate_message, list_decompressors
from pipeline.logs.columns import Payloads, join_payloads
from pipeline.logs.records import Buffer, ByteSource, LogError, Loss
from pipeline.logs.remote import RemotePath, to_location

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader
    from rosbags.rosbag1.reader import Chunk, IndexData

_REPAIRS: Final = {rec.ROS1_BAG: "`rosbag reindex`", rec.SQLITE_BAG: "`sqlite3 FILE .recover`"}

_TOGETHER: Final = 4 << 20
"""Size of the payloads that are passed on together [bytes]."""

_MOST_LOSSES: Final = 20
"""Maximum number of losses of a bag that are told one by one."""

Held = tuple[dict[int, Payloads], list[Loss]]
"""Some messages of a bag, or those of a text table: payloads by channel number, and the losses so far."""


class _Topic(NamedTuple):
    """A topic of a bag: number, name, type, encoding and definition of its messages, how many they are."""

    number: int
    name: str
    type_name: str
    encoding: str
    form: str
    definition: str
    messages: int


def catalog_bag(source: ByteSource, container: str, max_inflated: int | None) -> Catalog:
    """Catalog the contents of a bag.

    Args:
        source: the file.
        container: the kind of bag.
        max_inflated: limit of the size of what it yields [bytes]; None for one plausible for its size.

    Raises:
        LogError: ``log_unreadable``.
    """
    catalog = Catalog(container=container, profile="ros1" if container == rec.ROS1_BAG else "ros2")
    catalog.most_inflated = max_inflated
    path = to_location(source.name)
    with _refuse_damage(path, container), _open(path, container) as bag:
        for topic in bag.topics:
            # SQLite does not enforce the declared types of columns.
            if not all(isinstance(name, str) and name for name in (topic.name, topic.type_name)):
                raise ValueError("a topic has no name or no type")
            catalog.schemas[topic.number] = Schema(
                topic.number, topic.definition.encode(), topic.form, topic.type_name
            )
            catalog.channels[topic.number] = Channel(
                topic.number, topic.name, topic.encoding, {}, topic.number
            )
            catalog.counts[topic.number] = topic.messages
        if any(catalog.counts.values()):
            catalog.start_ns, catalog.end_ns = map(rec.clip_time, bag.times)
        catalog.bag_chunks, catalog.compressions = bag.chunk_count, bag.compressions
        catalog.losses += bag.losses
    if not rec.is_whole(source.read_at(0, rec.LONGEST_HEAD), source.size):
        text = f"the {container} is shorter than it says of itself: its end is missing"
        catalog.losses.append(Loss("truncated", text))
    catalog.notes.append(f"it is a {container}")
    return catalog


def read_bag(path: Path, container: str, numbers: AbstractSet[int], most: int) -> Iterator[Held]:
    """Read the messages of some channels of a bag, a few megabytes at a time, in the order of the file.

    Args:
        path: the file.
        container: the kind of bag.
        numbers: channel numbers.
        most: limit of the size of what it yields [bytes].

    Raises:
        LogError: ``log_unreadable``.
    """
    if not numbers:
        return
    with _open(path, container) as bag:
        # A clock that is not set shows no time at all; a time of a few messages is damaged.
        collected = _Collected(Allowance(most, most), bag.times[1] < 0 or bag.times[0] > rec.LATEST_NS)
        try:
            for number, at, data in bag.read_messages(numbers, Allowance(most, most)):
                collected.add(number, at, data)
                if collected.size > _TOGETHER:
                    yield collected.take(), []
        except MemoryError:
            raise
        except Exception as error:  # noqa: BLE001 - exceptions caused by damage have no common type
            text = (
                f"what comes after {collected.count} messages of the {container} is not read "
                f"({_format_error(error)})"
            )
            kind = OVER_BUDGET if isinstance(error, BudgetError) else "damaged_record"
            collected.losses.append(Loss(kind, text, start_ns=collected.last))
        collected.losses += bag.missed
    if collected.odd:
        text = f"{collected.odd} messages of the {container} have no time or no content that can be read"
        collected.losses.append(Loss("damaged_record", text))
    yield collected.take(), collected.losses


@dataclass(slots=True)
class _Collected:
    """Messages that are not yet passed on, and whether the clock of the recorder was not set."""

    allowance: Allowance
    unset: bool
    size: int = 0
    count: int = 0
    odd: int = 0
    last: int | None = None
    losses: list[Loss] = field(default_factory=list)
    messages: dict[int, tuple[list[int], list[Buffer]]] = field(default_factory=dict)

    def add(self, number: int, at: object, data: object) -> None:
        if not isinstance(at, int) or not isinstance(data, bytes):
            self.odd += 1
            return
        if not self.unset and at != rec.clip_time(at):
            self.odd += 1
            return
        try:
            payload = inflate_message(data)
        except InflateError:
            self.odd += 1
            return
        self.allowance.take(len(payload))
        times, payloads = self.messages.setdefault(number, ([], []))
        times.append(rec.clip_time(at))
        payloads.append(payload)
        self.size += len(payload)
        self.count += 1
        self.last = times[-1]

    def take(self) -> dict[int, Payloads]:
        taken = {
            number: join_payloads(time, time, payloads)
            for number, (times, payloads) in self.messages.items()
            for time in [np.array(times, dtype=np.int64)]
        }
        self.messages, self.size = {}, 0
        return taken


@contextmanager
def _refuse_damage(path: Path, container: str) -> Iterator[None]:
    """Convert every failure to open a bag to one error."""
    try:
        yield
    except (MemoryError, LogError):
        raise
    except Exception as error:
        hint = f"Copy it from its origin again, or repair it there with {_REPAIRS[container]}"
        why = _format_error(error)
        with suppress(OSError), path.open("rb") as file:
            if not rec.is_whole(file.read(rec.LONGEST_HEAD), path.stat().st_size):
                why = "its end is missing"
        raise LogError(
            "log_unreadable",
            f"the {container} cannot be opened ({why})",
            where=str(path),
            hint=hint,
        ) from error


@contextmanager
def _open(path: Path, container: str) -> Iterator[_RosBag | _Database]:
    if isinstance(path, RemotePath):
        hint = "Copy it to this machine, or convert it to MCAP"
        raise LogError(
            "log_unreadable", f"a {container} is not read from an object store", where=str(path), hint=hint
        )
    with _refuse_damage(path, container):
        bag = _RosBag(path) if container == rec.ROS1_BAG else _Database(path)
    with closing(bag):
        yield bag


def _format_error(error: Exception) -> str:
    # The cause describes the error without the path, which is reported separately.
    return shorten(" ".join(str(error.__cause__ or error).split())) or type(error).__name__


class _BoundedFile(BufferedReader):
    """A file whose reads are limited to its remaining size: lengths in a bag may be damaged."""

    def read(self, size: int | None = -1, /) -> bytes:
        """The next bytes; allocates no more memory than there are bytes."""
        remaining = os.fstat(self.fileno()).st_size - self.tell()
        return super().read(remaining if size is None or size < 0 else min(size, remaining))


class _BoundedPath(PosixPath):
    """A path for rosbags that opens a bounded file."""

    def open(self, *_args: object, **_options: object) -> _BoundedFile:  # type: ignore[override]
        """Open it for reading."""
        return _BoundedFile(FileIO(self))


def _open_tolerant(path: Path, broken: set[int]) -> Reader:
    """Open a ROS 1 bag; chunks whose heads or indexes are damaged are added to ``broken`` by position."""
    from rosbags.rosbag1 import Reader, reader  # noqa: PLC0415 - few logs need it

    class Tolerant(Reader):
        def read_chunk(self) -> Chunk:
            """Head of a chunk; one without content if it is damaged."""
            assert self.bio is not None  # noqa: S101 - it is open
            position = self.bio.tell()
            try:
                return super().read_chunk()
            except Exception:  # noqa: BLE001 - exceptions caused by damage have no common type
                broken.add(position)
                return reader.Chunk(0, position, bytes)

        def read_index_data(self, pos: int, indexes: dict[int, list[IndexData]]) -> None:
            """Entries of the next index record of a chunk, unless it is damaged, or one before it."""
            read: dict[int, list[IndexData]] = defaultdict(list)
            if pos in broken:
                return
            try:
                super().read_index_data(pos, read)
            except Exception:  # noqa: BLE001 - likewise
                broken.add(pos)
                return
            for number, entries in read.items():
                indexes[number] += entries

    bag = Tolerant(_BoundedPath(path))
    bag.open()
    return bag


class _RosBag:
    """A bag of ROS 1.

    Attributes:
        topics: its topics.
        times: first and last log time [ns].
        chunk_count: number of its chunks.
        compressions: their compressions; ``""`` is none.
        losses: damage that was found by opening it.
        missed: messages that could not be read so far.
    """

    def __init__(self, path: Path) -> None:
        broken: set[int] = set()
        self._reader = _open_tolerant(path, broken)
        self.topics = [
            _Topic(one.id, one.topic, one.msgtype, "ros1", "ros1msg", one.msgdef.data, one.msgcount)
            for one in self._reader.connections
        ]
        self.times = self._reader.start_time, self._reader.end_time - 1
        self.chunk_count = len(self._reader.chunks)
        self.compressions = {_name_compression(chunk) for chunk in self._reader.chunks.values()}
        self.losses = self._find_unindexed(broken)
        self.missed: list[Loss] = []

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    def _find_unindexed(self, broken: AbstractSet[int]) -> list[Loss]:
        """Losses of messages that the summaries of chunks count and their indexes do not have."""
        indexed = Counter(
            (entry.chunk_pos, number) for number, entries in self._reader.indexes.items() for entry in entries
        )
        losses = []
        for info in self._reader.chunk_infos:
            counts = info.connection_counts
            if info.pos not in broken and all(indexed[info.pos, one] == counts[one] for one in counts):
                continue
            text = f"the index of the chunk at byte {info.pos} is damaged: messages that it had are left out"
            times = (info.start_time, info.end_time - 1) if counts else (None, None)
            losses.append(Loss("damaged_record", text, 0, 1, *times))
        return _join_losses(losses)

    def read_messages(
        self, numbers: AbstractSet[int], allowance: Allowance
    ) -> Iterator[tuple[int, int, bytes]]:
        """Number, log time [ns] and content of the messages of some topics, chunk by chunk.

        Args:
            numbers: the topics.
            allowance: charged with the content of the chunks.

        Raises:
            BudgetError: the allowance is used up.
        """
        entries: dict[int, list[tuple[int, int, int]]] = defaultdict(list)
        for number in sorted(numbers & self._reader.indexes.keys()):
            for entry in self._reader.indexes[number]:
                entries[entry.chunk_pos].append((entry.offset, number, entry.time))
        missed: list[Loss] = []
        for position, here in sorted(entries.items()):
            lost: list[int] = []
            why, content = "", b""
            try:
                content = self._inflate(self._reader.chunks[position], allowance)
            except (MemoryError, BudgetError):
                raise
            except Exception as error:  # noqa: BLE001 - exceptions caused by damage have no common type
                why = _format_error(error)
            for offset, number, at in sorted(here):
                try:
                    data = _read_message(content, offset, number, at)
                except Exception as error:  # noqa: BLE001 - likewise
                    why = why or _format_error(error)
                    lost.append(at)
                    continue
                yield number, at, data
            if lost:
                count = format_count(len(lost), "message")
                text = f"{count} in the chunk at byte {position} cannot be read ({why})"
                missed.append(Loss("damaged_record", text, 0, 1, min(lost), max(lost)))
        self.missed = _join_losses(missed)

    def _inflate(self, chunk: Chunk, allowance: Allowance) -> bytes:
        file: Any = self._reader.bio
        file.seek(chunk.datapos)
        stored: bytes = file.read(chunk.datasize)
        if len(stored) < chunk.datasize:
            raise InflateError("its end is missing")
        name = _name_compression(chunk)
        if name:
            return allowance.inflate_chunk(name, stored)
        allowance.take(len(stored))
        return stored


_WORD: Final = struct.Struct("<I")
_TIME: Final = struct.Struct("<II")
_CONNECTION, _MESSAGE = b"\x07", b"\x02"

_LONGEST_HEADER: Final = 1 << 16
"""Maximum size of the header of a record [bytes]: it holds numbers, and the name of a topic."""

_MOST_BETWEEN: Final = 100
"""Maximum number of records of connections in front of a message."""


def _parse_header(content: bytes, offset: int) -> tuple[dict[bytes, bytes], int]:
    """Fields of the header of a record, and where it ends."""
    (size,) = _WORD.unpack_from(content, offset)
    if size > _LONGEST_HEADER:
        raise InflateError("the header of a record is longer than any")
    position, end = offset + _WORD.size, offset + _WORD.size + size
    fields: dict[bytes, bytes] = {}
    while position < end:
        (length,) = _WORD.unpack_from(content, position)
        position += _WORD.size + length
        name, _, value = content[position - length : position].partition(b"=")
        fields[name] = value
    return fields, end


def _read_message(content: bytes, offset: int, number: int, at: int) -> bytes:
    """Content of the message at an offset of a chunk.

    Raises:
        InflateError: there is another record, or none.
    """
    wanted = _MESSAGE, _WORD.pack(number), _TIME.pack(*divmod(at, 10**9))
    for _ in range(_MOST_BETWEEN):
        fields, position = _parse_header(content, offset)
        (size,) = _WORD.unpack_from(content, position)
        offset = position + _WORD.size + size
        if fields.get(b"op") != _CONNECTION:
            break
    if tuple(map(fields.get, (b"op", b"conn", b"time"))) != wanted:
        raise InflateError("the index names a message that is not there")
    if offset > len(content):
        raise InflateError("a message is longer than its chunk")
    return content[offset - size : offset]


def _join_losses(losses: Sequence[Loss]) -> list[Loss]:
    """Losses of chunks; one for all of very many."""
    if len(losses) <= _MOST_LOSSES:
        return [*losses]
    starts = [one.start_ns for one in losses if one.start_ns is not None]
    ends = [one.end_ns for one in losses if one.end_ns is not None]
    text = f"messages in {len(losses):,} chunks cannot be read; the first: {losses[0].text}"
    return [Loss(losses[0].kind, text, 0, len(losses), min(starts, default=None), max(ends, default=None))]


def _name_compression(chunk: Chunk) -> str:
    """Name of a chunk's compression; empty for none."""
    from rosbags.rosbag1.reader import decompressors  # noqa: PLC0415 - few logs need it

    return next((name for name in list_decompressors() if decompressors[name] is chunk.decompressor), "")


_LEAST_ROW: Final = 1 << 16
"""Size of a row that any database may hold [bytes]; no row of a larger one has more bytes than its file."""

_CPU_S: Final = 3.0
_CPU_BYTES_PER_S: Final = 5e6
"""CPU time that SQLite may take for a file: a few seconds, and its size at 5 MB/s; it reads far more."""

_CHECKED: Final = 100
"""Steps of SQLite's machine between two checks of the time: those of some ten rows."""

_COMPUTED: Final = {2, 3}
"""Kinds of columns in SQLite's description of a table that are computed, not stored."""


class _Database:
    """An SQLite file of rosbag2.

    A value is bounded by the size of the file, and so is the time of all queries: what looks like a table may
    be computed. The attributes are those of `_RosBag`.
    """

    def __init__(self, path: Path) -> None:
        size = path.stat().st_size
        self._spent, self._most_s = 0.0, _CPU_S + size / _CPU_BYTES_PER_S
        self._begin: float | None = None
        # The path becomes part of a URI, in which characters such as ? and % are special.
        address = f"file:{quote(str(path.absolute()))}?immutable=1&mode=ro"
        self._database = sqlite3.connect(address, uri=True, check_same_thread=False)
        self.chunk_count, self.compressions, self.losses = 0, set[str](), list[Loss]()
        self.missed: list[Loss] = []
        try:
            self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(size, _LEAST_ROW))
            self._database.set_progress_handler(self._is_over, _CHECKED)
            self.times = (0, 0)
            self.topics = self._list_topics()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._database.close()

    def _is_over(self) -> bool:
        begin = time.thread_time() if self._begin is None else self._begin
        return self._spent + time.thread_time() - begin > self._most_s

    def _query(self, text: str, values: Sequence[object] = ()) -> Iterator[tuple[Any, ...]]:
        """Rows of a query, one at a time.

        Raises:
            InflateError: the query runs on, or a value has more bytes than the file.
        """
        rows: sqlite3.Cursor | None = None
        while True:
            self._begin = time.thread_time()
            try:
                rows = self._database.execute(text, values) if rows is None else rows
                row = rows.fetchone()
            except sqlite3.DataError as error:
                raise InflateError(f"a value in it has more bytes than the file: {error}") from None
            except sqlite3.OperationalError as error:
                if str(error) != "interrupted":
                    raise
                raise InflateError(f"reading it takes more than {self._most_s:.0f} s of CPU time") from None
            finally:
                self._spent += time.thread_time() - self._begin
            if row is None:
                return
            yield row

    def _list_topics(self) -> list[_Topic]:
        tables = {name for (name,) in self._query("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"topics", "messages"} <= tables:
            raise InflateError("not a recording: tables are missing from the database")
        described = "SELECT hidden FROM sqlite_master, pragma_table_xinfo(sqlite_master.name)"
        if _COMPUTED & {hidden for (hidden,) in self._query(described)}:
            raise InflateError("its tables have computed columns, which no recorder writes")
        whole = "min(timestamp) FILTER (WHERE typeof(timestamp) = 'integer'"
        counted = {
            number: (count, first, last)
            for number, count, first, last in self._query(
                f"SELECT topic_id, count(*), coalesce({whole} AND timestamp >= 0), {whole})), "  # noqa: S608 - our own words
                f"{whole.replace('min', 'max', 1)}) FROM messages GROUP BY topic_id"
            )
        }
        timed = [(first, last) for _, first, last in counted.values() if first is not None]
        if timed:
            self.times = min(first for first, _ in timed), max(last for _, last in timed)
        definitions: dict[object, tuple[str, str]] = {}
        if "message_definitions" in tables:
            columns = "topic_type, encoding, encoded_message_definition"
            for name, encoding, text in self._query(f"SELECT {columns} FROM message_definitions"):  # noqa: S608
                definitions.setdefault(name, (str(encoding), str(text)))
        return [
            _Topic(
                int(number),
                name,
                type_name,
                str(encoding),
                *definitions.get(type_name, ("ros2msg", "")),
                counted.get(number, (0,))[0],
            )
            for number, name, type_name, encoding in self._query(
                "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
            )
        ]

    def read_messages(self, numbers: AbstractSet[int], _: Allowance) -> Iterator[tuple[int, object, object]]:
        """Number, log time [ns] and content of the messages of some topics, as they are stored.

        Raises:
            InflateError: as `_query`.
        """
        marks = ", ".join("?" for _ in numbers)
        text = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks})"  # noqa: S608
        yield from self._query(text, sorted(numbers))
