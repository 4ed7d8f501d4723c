"""Recordings other than MCAP: bags of ROS 1, and SQLite files of rosbag2.

They are read with the rosbags library: their messages are read one by one and decoded in blocks, like those
of MCAP files.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from collections.abc import Set as AbstractSet
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from io import BufferedReader, FileIO
from pathlib import Path, PosixPath
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote

import numpy as np
from mcap.records import Channel, Schema

from pipeline.logs import records as rec
from pipeline.logs.catalog import OVER_BUDGET, Catalog
from pipeline.logs.chunks import Allowance, BudgetError, InflateError, inflate_message, list_decompressors
from pipeline.logs.columns import Payloads, join_payloads
from pipeline.logs.records import Buffer, ByteSource, LogError, Loss
from pipeline.logs.remote import RemotePath, to_location

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Reader as BagReader
    from rosbags.rosbag1.reader import Chunk
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    Opened = BagReader | Sqlite3Reader

_REPAIRS: Final = {rec.ROS1_BAG: "`rosbag reindex`", rec.SQLITE_BAG: "`sqlite3 FILE .recover`"}

_TOGETHER: Final = 4 << 20
"""Size of the payloads that are passed on together [bytes]."""

_LAST_TIME: Final = (1 << 63) - 1


def catalog_bag(source: ByteSource, container: str, max_inflated: int | None) -> Catalog:
    """Catalog the contents of a bag.

    Args:
        source: the file.
        container: the kind of bag that its first bytes state.
        max_inflated: limit of its total inflated size [bytes]; None for one plausible for its size.

    Raises:
        LogError: ``log_unreadable``.
    """
    catalog = Catalog(container=container, profile="ros1" if container == rec.ROS1_BAG else "ros2")
    catalog.most_inflated = max_inflated
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
    if not rec.is_whole(source.read_at(0, rec.LONGEST_HEAD), source.size):
        text = f"the {container} is shorter than it says of itself: its end is missing"
        catalog.losses.append(Loss("truncated", text))
    catalog.notes.append(f"it is a {container}, read through rosbags, which stops where the file is damaged")
    return catalog


def _note_connection(connection: Connection, catalog: Catalog) -> None:
    number, encoding, form = connection.id, "ros1", "ros1msg"
    if catalog.container == rec.SQLITE_BAG:
        encoding = str(getattr(connection.ext, "serialization_format", ""))
        form = "ros2idl" if connection.msgdef.format.name == "IDL" else "ros2msg"
    # SQLite does not enforce the declared types of columns.
    if not all(isinstance(name, str) and name for name in (connection.topic, connection.msgtype)):
        raise ValueError("a topic has no name or no type")
    catalog.schemas[number] = Schema(number, connection.msgdef.data.encode(), form, connection.msgtype)
    catalog.channels[number] = Channel(number, connection.topic, encoding, {}, number)
    catalog.counts[number] = connection.msgcount


Held = tuple[dict[int, Payloads], list[Loss]]
"""Some messages of a bag: payloads by channel number, and the losses so far."""


def read_bag(path: Path, container: str, numbers: AbstractSet[int], most: int) -> Iterator[Held]:
    """Read the messages of some channels of a bag, a few megabytes at a time, in the order of their times.

    Args:
        path: the file.
        container: kind of the file.
        numbers: channel numbers.
        most: limit of the inflated size of a bag's chunks, or of individually compressed messages [bytes].

    Raises:
        LogError: ``log_unreadable``.
    """
    allowance = Allowance(most, most)
    collected = _Collected(allowance)
    with _open(path, container, allowance) as reader:
        wanted = [connection for connection in reader.connections if connection.id in numbers]
        if not wanted:
            return
        try:
            for connection, time, data in reader.messages(wanted):
                collected.add(connection.id, time, data)
                if collected.size > _TOGETHER:
                    yield collected.take(), []
        except MemoryError:
            raise
        except Exception as error:  # noqa: BLE001 - exceptions caused by damage have no common type
            text = f"the {container} is truncated: what comes after {collected.count} messages cannot be read"
            text += f" ({_format_error(error)})"
            kind = OVER_BUDGET if isinstance(error, BudgetError) else "damaged_record"
            collected.losses.append(Loss(kind, text, start_ns=collected.last))
    if collected.odd:
        text = f"{collected.odd} messages of the {container} have no time or no content that can be read"
        collected.losses.append(Loss("damaged_record", text))
    yield collected.take(), collected.losses


@dataclass(slots=True)
class _Collected:
    """Messages that are not yet passed on."""

    allowance: Allowance
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
def _open(path: Path, container: str, allowance: Allowance | None = None) -> Iterator[Opened]:
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
    if container == rec.ROS1_BAG:
        from rosbags.rosbag1 import Reader  # noqa: PLC0415 - few logs need it

        return Reader(_BoundedPath(path))
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader  # noqa: PLC0415 - few logs need it

    # The path becomes part of a URI, in which characters such as ? and % are special.
    return Sqlite3Reader(Path(quote(str(path.absolute()))))


def _bound_chunks(chunks: dict[int, Chunk], allowance: Allowance) -> None:
    """Limit the inflated sizes of the chunks of a ROS 1 bag to plausible values, each and in total."""
    for key, chunk in chunks.items():
        name = _name_compression(chunk)
        if name:
            chunks[key] = chunk._replace(decompressor=partial(allowance.inflate_chunk, name))


def _name_compression(chunk: Chunk) -> str:
    """Name of a chunk's compression; empty for none."""
    from rosbags.rosbag1.reader import decompressors  # noqa: PLC0415 - few logs need it

    return next((name for name in list_decompressors() if decompressors[name] is chunk.decompressor), "")


def _format_error(error: Exception) -> str:
    # The cause describes the error without the path, which is reported separately.
    return " ".join(str(error.__cause__ or error).split()) or type(error).__name__
