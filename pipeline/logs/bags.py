"""Recordings other than MCAP: ROS 1 bags and SQLite files of rosbag2, read with the rosbags library.

Their messages are read one by one and decoded in blocks, like those of MCAP files.
"""

from __future__ import annotations

import bz2
import os
import re
from collections.abc import Callable, Iterator, Mapping
from collections.abc import Set as AbstractSet
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache, partial
from io import BufferedReader, FileIO
from pathlib import Path, PosixPath
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote

from mcap.records import Channel, Schema

from pipeline.logs.catalog import OVER_BUDGET, Catalog
from pipeline.logs.chunks import InflateError, inflate_message, largest_plausible
from pipeline.logs.columns import Payloads, join_payloads
from pipeline.logs.records import Buffer, LogError, Loss
from pipeline.logs.remote import RemotePath, to_location

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Reader as BagReader
    from rosbags.rosbag1.reader import Chunk
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    from pipeline.logs.source import ByteSource

    Opened = BagReader | Sqlite3Reader

ROS1_BAG: Final = "ROS 1 bag"
SQLITE_BAG: Final = "rosbag2 SQLite file"
_MAGICS: Final = {b"#ROSBAG V": ROS1_BAG, b"SQLite format 3\0": SQLITE_BAG}

LONGEST_MAGIC: Final = max(map(len, _MAGICS))
LONGEST_HEAD: Final = 1 << 12
"""Number of bytes at the start of a bag that state its kind and its length."""

_INDEX_PLACE: Final = re.compile(rb"index_pos=(.{8})", re.DOTALL)

_REPAIRS: Final = {ROS1_BAG: "`rosbag reindex`", SQLITE_BAG: "`sqlite3 FILE .recover`"}

_TOGETHER: Final = 4 << 20
"""Size of the payloads that are passed on together [bytes]."""

_LAST_TIME: Final = (1 << 63) - 1


def detect_container(head: bytes) -> str:
    """Kind of bag of a file that starts with ``head``; empty for other files."""
    return next((kind for magic, kind in _MAGICS.items() if head.startswith(magic)), "")


def is_whole(head: bytes, size: int) -> bool:
    """Whether a bag is at least as long as its head states.

    Args:
        head: its first `LONGEST_HEAD` bytes.
        size: size of the file [bytes].
    """
    if detect_container(head) == ROS1_BAG:
        # The recorder states the position of the index once it has written it.
        match = _INDEX_PLACE.search(head)
        return match is not None and 0 < int.from_bytes(match[1], "little") <= size
    page = int.from_bytes(head[16:18], "big")
    pages = int.from_bytes(head[28:32], "big")
    # A page size of 64 KiB is stored as 1.
    return size >= max(pages, 1) * (page if page > 1 else 1 << 16)


def is_written_to(path: Path) -> bool:
    """Whether a transaction is in progress in an SQLite file."""
    return any(path.with_name(path.name + end).exists() for end in ("-journal", "-wal"))


def catalog_bag(source: ByteSource, container: str) -> Catalog:
    """Catalog the contents of a bag.

    Args:
        source: the file.
        container: `ROS1_BAG` or `SQLITE_BAG`.

    Raises:
        LogError: ``log_unreadable``.
    """
    catalog = Catalog(container=container, profile="ros1" if container == ROS1_BAG else "ros2")
    path = to_location(source.name)
    with _refuse_damage(path, container), _open(path, container) as reader:
        for connection in reader.connections:
            _note_connection(connection, catalog)
        metadata: Any = getattr(reader, "metadata", reader)
        if any(catalog.counts.values()):
            catalog.start_ns = max(0, int(metadata.start_time))
            catalog.end_ns = min(_LAST_TIME, int(metadata.end_time) - 1)
        chunks: Mapping[int, Any] = getattr(reader, "chunks", {})
        catalog.bag_chunks = len(chunks)
        catalog.compressions = {_name_compression(chunk) for chunk in chunks.values()}
    if not is_whole(source.read_at(0, LONGEST_HEAD), source.size):
        text = f"the {container} is shorter than it says of itself: its end is missing"
        catalog.losses.append(Loss("truncated", text))
    catalog.notes.append(f"it is a {container}, read through rosbags, which stops where the file is damaged")
    return catalog


def _note_connection(connection: Connection, catalog: Catalog) -> None:
    number, encoding, form = connection.id, "ros1", "ros1msg"
    if catalog.container == SQLITE_BAG:
        encoding = str(getattr(connection.ext, "serialization_format", ""))
        form = "ros2idl" if connection.msgdef.format.name == "IDL" else "ros2msg"
    # SQLite does not enforce the declared types of columns.
    if not all(isinstance(name, str) and name for name in (connection.topic, connection.msgtype)):
        raise ValueError("a topic has no name or no type")
    catalog.schemas[number] = Schema(number, connection.msgdef.data.encode(), form, connection.msgtype)
    catalog.channels[number] = Channel(number, connection.topic, encoding, {}, number)
    catalog.counts[number] = connection.msgcount


class _BudgetError(Exception):
    """The inflated size exceeds the limit of the file."""


@dataclass(slots=True)
class _Allowance:
    """Remaining bytes that a bag may inflate to, out of ``most``."""

    most: int
    remaining: int

    def take(self, size: int) -> None:
        """Charge inflated bytes.

        Raises:
            _BudgetError: they exceed the limit.
        """
        self.remaining -= size
        if self.remaining < 0:
            raise _BudgetError(
                f"it decompresses to more than {self.most / 1e6:,.1f} MB, and no more is read; "
                "a larger --max-inflated reads more"
            )

    def inflate_chunk(self, name: str, stored: bytes) -> bytes:
        """Inflate a chunk with the given compression, up to a plausible size.

        Raises:
            InflateError: it is cut, or larger.
            _BudgetError: it exceeds the limit.
        """
        decompressor = _list_decompressors()[name]()
        most = min(largest_plausible(len(stored)), self.remaining + 1)
        inflated: bytes = decompressor.decompress(stored, max_length=most)
        self.take(len(inflated))
        if not decompressor.eof:
            raise InflateError(f"{len(stored)} bytes of a chunk are cut, or hold more than is plausible")
        return inflated


@dataclass(slots=True)
class BagMessages:
    """Some messages of a bag: payloads by channel number, and the losses so far."""

    payloads: dict[int, Payloads] = field(default_factory=dict)
    losses: list[Loss] = field(default_factory=list)


def read_bag(path: Path, container: str, numbers: AbstractSet[int], most: int) -> Iterator[BagMessages]:
    """Read the messages of some channels in the order of their times, a few megabytes at a time.

    Args:
        path: the file.
        container: `ROS1_BAG` or `SQLITE_BAG`.
        numbers: channel numbers.
        most: limit of the inflated size of its chunks, or of individually compressed messages [bytes].

    Raises:
        LogError: ``log_unreadable``.
    """
    allowance = _Allowance(most, most)
    collected = _Collected(allowance)
    with _open(path, container, allowance) as reader:
        wanted = [connection for connection in reader.connections if connection.id in numbers]
        if not wanted:
            return
        try:
            for connection, time, data in reader.messages(wanted):
                collected.add(connection.id, time, data)
                if collected.size > _TOGETHER:
                    yield BagMessages(collected.take())
        except MemoryError:
            raise
        except Exception as error:  # noqa: BLE001 - exceptions caused by damage have no common type
            text = f"the {container} is truncated: what comes after {collected.count} messages cannot be read"
            text += f" ({_format_error(error)})"
            kind = OVER_BUDGET if isinstance(error, _BudgetError) else "damaged_record"
            collected.losses.append(Loss(kind, text, start_ns=collected.last))
    if collected.odd:
        text = f"{collected.odd} messages of the {container} have no time or no content that can be read"
        collected.losses.append(Loss("damaged_record", text))
    yield BagMessages(collected.take(), collected.losses)


@dataclass(slots=True)
class _Collected:
    """Messages that are not yet passed on."""

    allowance: _Allowance
    size: int = 0
    count: int = 0
    odd: int = 0
    last: int | None = None
    losses: list[Loss] = field(default_factory=list)
    messages: dict[int, tuple[list[int], list[Buffer]]] = field(default_factory=dict)

    def add(self, number: int, time: object, data: object) -> None:
        if not isinstance(time, int) or not 0 <= time <= _LAST_TIME or not isinstance(data, bytes):
            self.odd += 1
            return
        try:
            payload = inflate_message(data)
        except InflateError:
            self.odd += 1
            return
        if payload is not data:
            self.allowance.take(len(payload))
        times, payloads = self.messages.setdefault(number, ([], []))
        times.append(time)
        payloads.append(payload)
        self.size += len(payload)
        self.count += 1
        self.last = time

    def take(self) -> dict[int, Payloads]:
        taken = {number: join_payloads(*lists) for number, lists in self.messages.items()}
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
            if not is_whole(file.read(LONGEST_HEAD), path.stat().st_size):
                why = "its end is missing"
        raise LogError(
            "log_unreadable",
            f"the {container} cannot be opened ({why})",
            where=str(path),
            hint=hint,
        ) from error


@contextmanager
def _open(path: Path, container: str, allowance: _Allowance | None = None) -> Iterator[Opened]:
    if isinstance(path, RemotePath):
        hint = "Copy it to this machine, or convert it to MCAP"
        raise LogError(
            "log_unreadable", f"a {container} is not read from an object store", where=str(path), hint=hint
        )
    with _refuse_damage(path, container):
        reader = _make_reader(path, container)
        reader.open()
        if allowance is not None:
            _bound_chunks(getattr(reader, "chunks", {}), allowance)
    try:
        yield reader
    finally:
        reader.close()


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


def _make_reader(path: Path, container: str) -> Opened:
    if container == ROS1_BAG:
        from rosbags.rosbag1 import Reader  # noqa: PLC0415 - few logs need it

        return Reader(_BoundedPath(path))
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader  # noqa: PLC0415 - few logs need it

    # The path becomes part of a URI, in which characters such as ? and % are special.
    return Sqlite3Reader(Path(quote(str(path.absolute()))))


@cache
def _list_decompressors() -> dict[str, Callable[[], bz2.BZ2Decompressor]]:
    """Factories of decompressors by the name of the compression."""
    from lz4.frame import LZ4FrameDecompressor  # noqa: PLC0415 - few logs need it

    return {"bz2": bz2.BZ2Decompressor, "lz4": LZ4FrameDecompressor}


def _bound_chunks(chunks: dict[int, Chunk], allowance: _Allowance) -> None:
    """Limit the inflated sizes of the chunks of a ROS 1 bag to plausible values, each and in total."""
    for key, chunk in chunks.items():
        name = _name_compression(chunk)
        if name:
            chunks[key] = chunk._replace(decompressor=partial(allowance.inflate_chunk, name))


def _name_compression(chunk: Chunk) -> str:
    """Name of a chunk's compression; empty for none."""
    from rosbags.rosbag1.reader import decompressors  # noqa: PLC0415 - few logs need it

    return next((name for name in _list_decompressors() if decompressors[name] is chunk.decompressor), "")


def _format_error(error: Exception) -> str:
    # The cause describes the error without the path, which is reported separately.
    return " ".join(str(error.__cause__ or error).split()) or type(error).__name__
