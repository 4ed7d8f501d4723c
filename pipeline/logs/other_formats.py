"""Recordings other than MCAP: bags of ROS 1, SQLite files of rosbag2, and folders of text tables.

Bags are read with the rosbags library: their messages are read one by one and decoded in blocks, like those
of MCAP files. Text tables are CSV files, or poses in the TUM format. Each data set has a TOML file in the
folder `text_folders`, which is discovered automatically. It maps the columns of each table to a topic, a
message type and fields. Rows are read as the messages that were originally logged.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache, partial
from importlib import resources
from io import BufferedReader, FileIO
from pathlib import Path, PosixPath
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote

import msgspec
import numpy as np
from mcap.records import Channel, Schema

from pipeline.logs import records as rec
from pipeline.logs.catalog import OVER_BUDGET, Catalog
from pipeline.logs.chunks import Allowance, BudgetError, InflateError, inflate_message, list_decompressors
from pipeline.logs.columns import Block, Payloads, join_blocks, join_payloads
from pipeline.logs.records import Buffer, ByteSource, LogError, Loss
from pipeline.logs.remote import RemotePath, to_location
from pipeline.logs.schema import definition_text, parse_msg

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Reader as BagReader
    from rosbags.rosbag1.reader import Chunk
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    from pipeline.core import Floats, Ints
    from pipeline.logs.writer import Given

    Opened = BagReader | Sqlite3Reader

_REPAIRS: Final = {rec.ROS1_BAG: "`rosbag reindex`", rec.SQLITE_BAG: "`sqlite3 FILE .recover`"}

_TOGETHER: Final = 4 << 20
"""Size of the payloads that are passed on together [bytes]."""


def catalog_other(source: ByteSource, container: str, max_inflated: int | None) -> Catalog | None:
    """Catalog the contents of a bag or a text table; None for any other file.

    Args:
        source: the file.
        container: the kind of bag that its first bytes state; empty for none.
        max_inflated: limit of the total inflated size of a bag [bytes]; None for one plausible for its size.

    Raises:
        LogError: ``log_unreadable`` for a bag, ``too_large`` for a text table.
    """
    described = find_table(to_location(source.name))
    if described is not None:
        return _catalog_table(source, *described)
    if not container:
        return None
    catalog = _catalog_bag(source, container)
    catalog.most_inflated = max_inflated
    return catalog


def _catalog_bag(source: ByteSource, container: str) -> Catalog:
    """Catalog the contents of a bag."""
    catalog = Catalog(container=container, profile="ros1" if container == rec.ROS1_BAG else "ros2")
    path = to_location(source.name)
    with _refuse_damage(path, container), _open(path, container) as reader:
        for connection in reader.connections:
            _note_connection(connection, catalog)
        metadata: Any = getattr(reader, "metadata", reader)
        if any(catalog.counts.values()):
            catalog.start_ns = rec.clip_time(int(metadata.start_time))
            catalog.end_ns = rec.clip_time(int(metadata.end_time) - 1)
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
"""Some messages of a bag, or those of a text table: payloads by channel number, and the losses so far."""


def read_other(
    source: ByteSource, path: Path, container: str, numbers: AbstractSet[int], most: int
) -> Iterator[Held]:
    """Read the messages of some channels of a bag or a text table in the order of their times.

    Args:
        source: the file.
        path: its path.
        container: kind of the file.
        numbers: channel numbers.
        most: limit of the inflated size of a bag's chunks, or of individually compressed messages [bytes].

    Raises:
        LogError: ``log_unreadable`` for a bag, ``too_large`` for a text table.
    """
    described = find_table(path) if container == rec.TEXT_TABLE else None
    if described is None:
        return _read_bag(path, container, numbers, most)
    rows = _read_table(source, described[1])
    held = {} if rows is None else dict.fromkeys(numbers, rows)
    return iter([(held, [])] if numbers else [])


def _read_bag(path: Path, container: str, numbers: AbstractSet[int], most: int) -> Iterator[Held]:
    """Read the messages of a bag, a few megabytes at a time."""
    allowance = Allowance(most, most)
    with _open(path, container, allowance) as reader:
        about: Any = getattr(reader, "metadata", reader)
        # A clock that is not set shows no time at all; a time of a few messages is damaged.
        unset = int(about.start_time) > rec.LATEST_NS or int(about.end_time) <= 0
        collected = _Collected(allowance, unset)
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
    """Messages that are not yet passed on, and whether the clock of the recorder was not set."""

    allowance: Allowance
    unset: bool
    size: int = 0
    count: int = 0
    odd: int = 0
    last: int | None = None
    losses: list[Loss] = field(default_factory=list)
    messages: dict[int, tuple[list[int], list[Buffer]]] = field(default_factory=dict)

    def add(self, number: int, time: object, data: object) -> None:
        if not isinstance(time, int) or not isinstance(data, bytes):
            self.odd += 1
            return
        if not self.unset and time != rec.clip_time(time):
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
        times.append(rec.clip_time(time))
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


_MAX_BYTES: Final = 1 << 30
"""Maximum size of a table [bytes]: that of an IMU at 400 Hz in eight hours."""

_MAX_LINES: Final = 12_000_000
"""Maximum number of lines of a table: those of an IMU at 400 Hz in eight hours."""

_KEPT_NS: Final = 1_000
"""Resolution of times [ns]: a double resolves seconds since 1970 to about one microsecond."""

_CHANNEL: Final = 1
"""Channel number of a table, which has only one channel."""


class TextTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One file of a data set.

    Attributes:
        path: path relative to the folder of a recording.
        topic: topic of its rows.
        type: message type, ``package/msg/Name``.
        time: column with the time of a row.
        tick_ns: unit of the time [ns].
        fields: column by field of the message, numbers in the field's unit.
        texts: constant texts by field.
        columns: names of the columns if the file has no header line.
    """

    path: str
    topic: str
    type: str
    time: str
    tick_ns: int
    fields: dict[str, str]
    texts: dict[str, str] = {}
    columns: list[str] = []

    @property
    def wanted(self) -> tuple[str, ...]:
        """Names of the columns to read, the time first."""
        return (self.time, *dict.fromkeys(self.fields.values()))


class TextFolder(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A data set whose recordings are folders of text tables.

    Attributes:
        name: display name.
        source: source of its format.
        recognized_by: files that every recording of it has.
        vehicle: name of the vehicle's preset.
        lacks: information missing from its recordings, one sentence each.
        files: its tables.
    """

    name: str
    source: str
    recognized_by: list[str]
    vehicle: str
    lacks: list[str]
    files: list[TextTable]


@cache
def list_text_folders() -> tuple[TextFolder, ...]:
    """The known data sets, sorted by name."""
    folder = resources.files("pipeline.logs") / "text_folders"
    formats = [
        msgspec.convert(tomllib.loads(entry.read_text(encoding="utf-8")), TextFolder)
        for entry in folder.iterdir()
        if entry.name.endswith(".toml")
    ]
    return tuple(sorted(formats, key=lambda each: each.name))


def recognize_text_folder(folder: Path) -> TextFolder | None:
    """The known data set of which a folder is a recording; None if there is none."""
    for known in list_text_folders():
        if all((folder / name).is_file() for name in known.recognized_by):
            return known
    return None


def list_tables(folder: Path) -> list[Path]:
    """The existing tables of a folder that is a recording of text tables; empty for other folders."""
    known = recognize_text_folder(folder)
    every = [] if known is None else [folder / table.path for table in known.files]
    return [file for file in every if file.is_file()]


def find_table(file: Path) -> tuple[TextFolder, TextTable] | None:
    """The data set and table of a file; None if it belongs to none."""
    for known in list_text_folders():
        for table in known.files:
            if f"/{file.as_posix()}".endswith(f"/{table.path}"):
                folder = file.parents[table.path.count("/")]
                if recognize_text_folder(folder) == known:
                    return known, table
    return None


def _catalog_table(source: ByteSource, known: TextFolder, table: TextTable) -> Catalog:
    """Catalog the contents of a table of a data set."""
    rows = _read_rows(source, table)
    catalog = Catalog(container=rec.TEXT_TABLE, profile="ros2", library=known.name, losses=rows.losses)
    definition = definition_text(table.type) or ""
    catalog.schemas[_CHANNEL] = Schema(_CHANNEL, definition.encode(), "ros2msg", table.type)
    catalog.channels[_CHANNEL] = Channel(_CHANNEL, table.topic, "cdr", {}, _CHANNEL)
    catalog.counts[_CHANNEL] = rows.times.size
    if rows.times.size:
        catalog.start_ns, catalog.end_ns = int(rows.times.min()), int(rows.times.max())
    if table.path == known.recognized_by[0]:
        # Metadata of the whole recording are added to one file that every recording has.
        catalog.metadata.append(("deployment", {"vehicle": known.vehicle}))
        catalog.notes += _describe_folder(to_location(source.name), known, table)
    return catalog


def _describe_folder(file: Path, known: TextFolder, table: TextTable) -> list[str]:
    """Notes on a recording of a data set, given one of its tables."""
    folder = file.parents[table.path.count("/")]
    said = [f"it is a recording of {known.name}: {len(known.files)} text tables are known, a topic each"]
    missing = [each.path for each in known.files if not (folder / each.path).is_file()]
    if missing:
        said.append(f"not in the folder: {', '.join(missing)}")
    return [*said, *(f"{known.name}: {sentence}" for sentence in known.lacks)]


def _read_table(source: ByteSource, table: TextTable) -> Payloads | None:
    """Read the rows of a table as messages; None if it has no rows."""
    rows = _read_rows(source, table)
    if not rows.times.size:
        return None
    from pipeline.logs.writer import encode_rows  # noqa: PLC0415 - for such folders alone

    structure = parse_msg(table.type, definition_text(table.type) or "")
    given: dict[str, Given] = {path: rows.columns[name] for path, name in table.fields.items()}
    if any(member.name == "header" for member in structure.members):
        seconds, nanoseconds = np.divmod(rows.times, 1_000_000_000)
        given |= {"header.stamp.sec": seconds, "header.stamp.nanosec": nanoseconds}
    given |= table.texts
    written, blocks = [], []
    for chosen, encoded in encode_rows(structure, rows.times.size, given, where=table.topic):
        size = np.full(chosen.size, encoded.shape[1])
        written.append(chosen)
        blocks.append(Block(encoded.reshape(-1), np.cumsum(size) - size, size))
    whole, order = join_blocks(blocks), np.argsort(np.concatenate(written))
    return Payloads(rows.times, rows.times, Block(whole.data, whole.start[order], whole.size[order]))


@dataclass(slots=True)
class _Rows:
    """Rows of a table: times [ns], shape (n,), columns of shape (n,), and losses."""

    times: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    columns: Mapping[str, Floats] = field(default_factory=dict)
    losses: list[Loss] = field(default_factory=list)


def _read_rows(source: ByteSource, table: TextTable) -> _Rows:
    if source.size > _MAX_BYTES:
        raise _too_large(source, source.size / 1e6, _MAX_BYTES / 1e6, "MB")
    content = bytes(source.read_at(0, source.size))
    count = content.count(b"\n")
    if count > _MAX_LINES:
        raise _too_large(source, count, _MAX_LINES, "lines")
    losses: list[Loss] = []
    *lines, last = content.decode("utf-8-sig", "replace").split("\n")
    if last:
        # A cut number may be read as a different number.
        losses.append(Loss("truncated", f"the last line of {table.path} has no end and is left out"))
    separator = None if table.columns else ","
    names = table.columns
    if not names:
        names = [name.strip() for name in lines.pop(0).split(",")] if lines else []
    absent = [name for name in table.wanted if name not in names]
    if absent:
        text = f"{table.path} has no column {', '.join(absent)}: nothing of it is read"
        return _Rows(losses=[*losses, Loss("damaged_record", text)])
    places = [names.index(name) for name in table.wanted]
    lines = [line for line in lines if line.strip() and not line.lstrip().startswith("#")]
    values = _parse_lines(lines, separator, places)
    with np.errstate(invalid="ignore"):
        at = np.rint(values[:, 0] * (table.tick_ns / _KEPT_NS))
        good = (at >= 0.0) & (at < rec.LATEST_NS / _KEPT_NS)
    if not (good.all() and len(lines) == at.size):
        count = len(lines) - int(good.sum())
        losses.append(Loss("damaged_record", f"{count} lines of {table.path} cannot be read"))
    columns = dict(zip(table.wanted, values[good].T, strict=True))
    return _Rows(at[good].astype(np.int64) * _KEPT_NS, columns, losses)


def _too_large(source: ByteSource, size: float, most: float, unit: str) -> LogError:
    what = f"the table holds {size:,.0f} {unit}, and no more than {most:,.0f} are read"
    return LogError("too_large", what, where=source.name, hint="Cut it into several recordings")


def _parse_lines(lines: Sequence[str], separator: str | None, places: Sequence[int]) -> Floats:
    """Numbers in the given columns of every line, shape (n, k); lines without them are omitted."""
    if not lines:
        return np.zeros((0, len(places)))
    try:
        return np.loadtxt(lines, delimiter=separator, usecols=places, ndmin=2, dtype=np.float64)
    except ValueError:
        rows = list(_parse_each(lines, separator, places))
        return np.array(rows, dtype=np.float64).reshape(-1, len(places))


def _parse_each(lines: Sequence[str], separator: str | None, places: Sequence[int]) -> Iterator[list[float]]:
    for line in lines:
        texts = line.split(separator)
        try:
            yield [float(texts[column]) for column in places]
        except (ValueError, IndexError):
            continue
