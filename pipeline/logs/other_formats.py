"""Recordings other than MCAP: bags, and folders of text tables.

Text tables are CSV files, or poses in the TUM format. Each data set has a TOML file in the
folder `text_folders`, which is discovered automatically. It maps the columns of each table to a topic, a
message type and fields. Rows are read as the messages that were originally logged.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np
from mcap.records import Channel, Schema

from pipeline.logs import records as rec
from pipeline.logs.bags import Held, catalog_bag, read_bag
from pipeline.logs.catalog import Catalog
from pipeline.logs.columns import Block, Payloads, join_blocks
from pipeline.logs.records import ByteSource, LogError, Loss
from pipeline.logs.remote import to_location
from pipeline.logs.schema import definition_text, parse_msg

if TYPE_CHECKING:
    from pipeline.core import Floats, Ints
    from pipeline.logs.writer import Given


def catalog_other(source: ByteSource, container: str, max_inflated: int | None) -> Catalog | None:
    """Catalog the contents of a bag or a text table; None for any other file.

    Args:
        source: the file.
        container: the kind of bag that its first bytes state; empty for none.
        max_inflated: limit of the size of what a bag yields [bytes]; None for one plausible for its size.

    Raises:
        LogError: ``log_unreadable`` for a bag, ``too_large`` for a text table.
    """
    described = find_table(to_location(source.name))
    if described is not None:
        return _catalog_table(source, *described)
    return catalog_bag(source, container, max_inflated) if container else None


def read_other(
    source: ByteSource, path: Path, container: str, numbers: AbstractSet[int], most: int
) -> Iterator[Held]:
    """Read the messages of some channels of a bag or a text table in the order of the file.

    Args:
        source: the file.
        path: its path.
        container: kind of the file.
        numbers: channel numbers.
        most: limit of the size of what a bag yields [bytes].

    Raises:
        LogError: ``log_unreadable`` for a bag, ``too_large`` for a text table.
    """
    described = find_table(path) if container == rec.TEXT_TABLE else None
    if described is None:
        return read_bag(path, container, numbers, most)
    rows = _read_table(source, described[1])
    held = {} if rows is None else dict.fromkeys(numbers, rows)
    return iter([(held, [])] if numbers else [])


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
