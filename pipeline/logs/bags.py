"""Bags: the catalog of one of ROS 1, and SQLite files of rosbag2, whose messages are read one by one.

What a database yields is charged to an allowance, however it is stored: its columns may be computed.
"""

import sqlite3
import time
from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import numpy as np
from mcap.records import Channel, Schema

from pipeline.core import format_size, shorten
from pipeline.logs import records as rec
from pipeline.logs.catalog import OVER_BUDGET, Catalog
from pipeline.logs.chunks import InflateError, inflate_message
from pipeline.logs.columns import Payloads, join_payloads
from pipeline.logs.records import Buffer, ByteSource, LogError, Loss
from pipeline.logs.remote import RemotePath, to_location
from pipeline.logs.ros1 import catalog_ros1

_REPAIRS: Final = {rec.ROS1_BAG: "`rosbag reindex`", rec.SQLITE_BAG: "`sqlite3 FILE .recover`"}

_TOGETHER: Final = 4 << 20
"""Size of the payloads that are passed on together [bytes]."""

Held = tuple[dict[int, Payloads], list[Loss]]
"""Some messages of a database, payloads by channel number, and the losses so far."""


def catalog_bag(source: ByteSource, container: str) -> Catalog:
    """Catalog the contents of a bag.

    Args:
        source: the file.
        container: the kind of bag.

    Raises:
        LogError: ``log_unreadable``.
    """
    catalog = Catalog(container=container, profile="ros1" if container == rec.ROS1_BAG else "ros2")
    path = to_location(source.name)
    if container == rec.SQLITE_BAG and isinstance(path, RemotePath):
        what = f"a {container} is not read from an object store"
        hint = "Copy it to this machine, or convert it to MCAP"
        raise LogError("log_unreadable", what, where=str(path), hint=hint)
    is_whole = rec.is_whole(source.read_at(0, rec.LONGEST_HEAD), source.size)
    try:
        if container == rec.ROS1_BAG:
            catalog_ros1(source, catalog)
        else:
            with closing(_Database(path)) as database:
                database.fill(catalog)
    except (MemoryError, LogError):
        raise
    except Exception as error:
        hint = f"Copy it from its origin again, or repair it there with {_REPAIRS[container]}"
        why = _format_error(error) if is_whole else "its end is missing"
        what = f"the {container} cannot be opened ({why})"
        raise LogError("log_unreadable", what, where=str(path), hint=hint) from error
    if not is_whole:
        text = f"the {container} is shorter than it says of itself: its end is missing"
        catalog.losses.append(Loss("truncated", text))
    catalog.notes.append(f"it is a {container}")
    return catalog


def read_database(path: Path, catalog: Catalog, numbers: AbstractSet[int], most: int) -> Iterator[Held]:
    """Read the messages of some channels of an SQLite file, a few megabytes at a time, in its order.

    Args:
        path: the file.
        catalog: its catalog.
        numbers: channel numbers.
        most: limit of the size of what it yields [bytes].
    """
    held: dict[int, tuple[list[int], list[Buffer]]] = {}
    size = count = odd = total = 0
    last: int | None = None
    losses = []
    kind, why = "damaged_record", ""
    # A clock that is not set shows no time at all; a time of a few messages is damaged.
    is_unset = catalog.end_ns == 0 or catalog.start_ns == rec.LATEST_NS
    with closing(_Database(path)) as database:
        try:
            for number, at, data in database.read_messages(numbers):
                payload: Buffer | None = None
                if isinstance(data, bytes) and isinstance(at, int) and (is_unset or at == rec.clip_time(at)):
                    with suppress(InflateError):
                        payload = inflate_message(data)
                if payload is None:
                    odd += 1
                    continue
                total += len(payload)
                if total > most:
                    kind = OVER_BUDGET
                    why = (
                        f"its content is more than {format_size(most)}, and no more is read; "
                        "a larger --max-inflated reads more"
                    )
                    break
                times, payloads = held.setdefault(number, ([], []))
                times.append(last := rec.clip_time(at))
                payloads.append(payload)
                count, size = count + 1, size + len(payload)
                if size > _TOGETHER:
                    yield _join(held), []
                    held, size = {}, 0
        except (sqlite3.Error, InflateError) as error:
            why = _format_error(error)
    if why:
        text = f"what comes after {count} messages of the {rec.SQLITE_BAG} is not read ({why})"
        losses.append(Loss(kind, text, start_ns=last))
    if odd:
        text = f"{odd} messages of the {rec.SQLITE_BAG} have no time or no content that can be read"
        losses.append(Loss("damaged_record", text))
    yield _join(held), losses


def _join(held: dict[int, tuple[list[int], list[Buffer]]]) -> dict[int, Payloads]:
    joined = {}
    for number, (times, payloads) in held.items():
        time_ns = np.array(times, dtype=np.int64)
        joined[number] = join_payloads(time_ns, time_ns, payloads)
    return joined


def _format_error(error: Exception) -> str:
    return shorten(" ".join(str(error).split())) or type(error).__name__


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
    be computed.
    """

    def __init__(self, path: Path) -> None:
        size = path.stat().st_size
        self._spent, self._most_s = 0.0, _CPU_S + size / _CPU_BYTES_PER_S
        self._begin: float | None = None
        # The path becomes part of a URI, in which characters such as ? and % are special.
        address = f"file:{quote(str(path.absolute()))}?immutable=1&mode=ro"
        self._database = sqlite3.connect(address, uri=True, check_same_thread=False)
        self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(size, _LEAST_ROW))
        self._database.set_progress_handler(self._is_over, _CHECKED)

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

    def fill(self, catalog: Catalog) -> None:
        """Add topics, counts and times to a catalog.

        Raises:
            InflateError: it is not a recording, or as `_query`.
            ValueError: a topic has no name or no type.
        """
        tables = {name for (name,) in self._query("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"topics", "messages"} <= tables:
            raise InflateError("not a recording: tables are missing from the database")
        described = "SELECT hidden FROM sqlite_master, pragma_table_xinfo(sqlite_master.name)"
        if _COMPUTED & {hidden for (hidden,) in self._query(described)}:
            raise InflateError("its tables have computed columns, which no recorder writes")
        definitions: dict[object, tuple[str, str]] = {}
        if "message_definitions" in tables:
            columns = "topic_type, encoding, encoded_message_definition"
            for name, encoding, text in self._query(f"SELECT {columns} FROM message_definitions"):  # noqa: S608
                definitions.setdefault(name, (str(encoding), str(text)))
        columns = "id, name, type, serialization_format"
        for number, name, type_name, encoding in self._query(f"SELECT {columns} FROM topics ORDER BY id"):  # noqa: S608
            # SQLite does not enforce the declared types of columns.
            if not all(isinstance(text, str) and text for text in (name, type_name)):
                raise ValueError("a topic has no name or no type")
            form, definition = definitions.get(type_name, ("ros2msg", ""))
            catalog.schemas[number] = Schema(number, definition.encode(), form, type_name)
            catalog.channels[number] = Channel(number, name, str(encoding), {}, number)
            catalog.counts[number] = 0
        whole = "min(timestamp) FILTER (WHERE typeof(timestamp) = 'integer'"
        for number, count, first, last in self._query(
            f"SELECT topic_id, count(*), coalesce({whole} AND timestamp >= 0), {whole})), "  # noqa: S608 - our own words
            f"{whole.replace('min', 'max', 1)}) FROM messages GROUP BY topic_id"
        ):
            if number in catalog.counts:
                catalog.counts[number] = count
            if first is not None:
                catalog.add_times(rec.clip_time(first), rec.clip_time(last))

    def read_messages(self, numbers: AbstractSet[int]) -> Iterator[tuple[int, Any, Any]]:
        """Number, log time [ns] and content of the messages of some topics, as they are stored.

        Raises:
            InflateError: as `_query`.
        """
        marks = ", ".join("?" for _ in numbers)
        text = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks})"  # noqa: S608
        yield from self._query(text, sorted(numbers))
