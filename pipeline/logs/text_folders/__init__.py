"""Recordings that are a folder of text tables: CSV files, or poses in the format of TUM.

A data set is a file in this folder, found by being there, that says of each of its tables which topic,
message type and fields its columns stand for. Its rows are read as the messages that were logged once.
"""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np
from mcap.records import Channel, Schema

from pipeline.logs.catalog import Catalog
from pipeline.logs.columns import Group, Payloads
from pipeline.logs.encode import Given, encode_rows
from pipeline.logs.records import LogError, Loss
from pipeline.logs.remote import to_location
from pipeline.logs.schema import definition_text, parse_msg

if TYPE_CHECKING:
    from pipeline.core.arrays import Floats, Ints
    from pipeline.logs.source import ByteSource

TEXT_TABLE: Final = "text table"

_MAX_BYTES: Final = 1 << 30
"""Largest table that is read: an IMU at 400 Hz writes as much in eight hours [bytes]."""

_KEPT_NS: Final = 1_000
"""Times are kept to the microsecond: a double holds the seconds since 1970 no finer [ns]."""

_LATEST_NS: Final = float(1 << 62)
"""Later times are no times: the year 2116 [ns]."""

_CHANNEL: Final = 1
"""A table is one channel, whose number in its file this is."""


class TextTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One file of a data set.

    Attributes:
        path: below the folder of a recording.
        topic: that its rows were logged on.
        type: message type, ``package/msg/Name``.
        time: column with the time of a row.
        tick_ns: what the time is counted in [ns].
        fields: column by field of the message, a number in the field's unit.
        texts: what a field says in every row.
        columns: names of the columns where the file has no line with them.
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
        """Names of the columns that are read, the time first."""
        return (self.time, *dict.fromkeys(self.fields.values()))


class TextFolder(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A data set whose recordings are folders of text tables.

    Attributes:
        name: what people call it.
        source: where its format was read.
        recognized_by: files that every recording of it has.
        vehicle: that drove, as presets are called.
        lacks: what its recordings do not tell, a sentence each.
        files: its tables.
    """

    name: str
    source: str
    recognized_by: list[str]
    vehicle: str
    lacks: list[str]
    files: list[TextTable]


@functools.cache
def list_text_folders() -> tuple[TextFolder, ...]:
    """The data sets that are known, by name."""
    folder = resources.files(__package__)
    formats = [
        msgspec.convert(tomllib.loads(entry.read_text(encoding="utf-8")), TextFolder)
        for entry in folder.iterdir()
        if entry.name.endswith(".toml")
    ]
    return tuple(sorted(formats, key=lambda each: each.name))


def recognize_text_folder(folder: Path) -> TextFolder | None:
    """The data set that a folder is a recording of; None where it is of none that is known."""
    for known in list_text_folders():
        if all((folder / name).is_file() for name in known.recognized_by):
            return known
    return None


def list_tables(folder: Path) -> list[Path]:
    """The tables of a folder that is a recording of text tables; none of any other folder."""
    known = recognize_text_folder(folder)
    every = [] if known is None else [folder / table.path for table in known.files]
    return [file for file in every if file.is_file()]


def find_table(file: Path) -> tuple[TextFolder, TextTable] | None:
    """The data set and table that a file belongs to; None where it belongs to none."""
    for known in list_text_folders():
        for table in known.files:
            if f"/{file.as_posix()}".endswith(f"/{table.path}"):
                folder = file.parents[table.path.count("/")]
                if recognize_text_folder(folder) == known:
                    return known, table
    return None


def catalog_table(source: ByteSource, known: TextFolder, table: TextTable) -> Catalog:
    """Find out what a table holds.

    Args:
        source: the file.
        known: its data set.
        table: which of its tables it is.

    Raises:
        LogError: ``too_large``.
    """
    rows = _read_rows(source, table)
    catalog = Catalog(container=TEXT_TABLE, profile="ros2", library=known.name, losses=rows.losses)
    definition = definition_text(table.type) or ""
    catalog.schemas[_CHANNEL] = Schema(_CHANNEL, definition.encode(), "ros2msg", table.type)
    catalog.channels[_CHANNEL] = Channel(_CHANNEL, table.topic, "cdr", {}, _CHANNEL)
    catalog.counts[_CHANNEL] = rows.times.size
    if rows.times.size:
        catalog.start_ns, catalog.end_ns = int(rows.times.min()), int(rows.times.max())
    if table.path == known.recognized_by[0]:
        # What holds for the whole recording stands with one file that every recording has.
        catalog.metadata.append(("deployment", {"vehicle": known.vehicle}))
        catalog.notes += _describe_folder(to_location(source.name), known, table)
    return catalog


def _describe_folder(file: Path, known: TextFolder, table: TextTable) -> list[str]:
    """What is worth knowing of a recording of a data set, by one of its tables."""
    folder = file.parents[table.path.count("/")]
    said = [f"it is a recording of {known.name}: {len(known.files)} text tables are known, a topic each"]
    missing = [each.path for each in known.files if not (folder / each.path).is_file()]
    if missing:
        said.append(f"not in the folder: {', '.join(missing)}")
    return [*said, *(f"{known.name}: {sentence}" for sentence in known.lacks)]


def read_table(source: ByteSource, table: TextTable) -> Payloads | None:
    """The rows of a table as the messages that they stand for; None where it has none.

    Args:
        source: the file.
        table: which table it is.

    Raises:
        LogError: ``too_large``.
    """
    rows = _read_rows(source, table)
    if not rows.times.size:
        return None
    structure = parse_msg(table.type, definition_text(table.type) or "")
    given: dict[str, Given] = {path: rows.columns[name] for path, name in table.fields.items()}
    if any(member.name == "header" for member in structure.members):
        seconds, nanoseconds = np.divmod(rows.times, 1_000_000_000)
        given |= {"header.stamp.sec": seconds, "header.stamp.nanosec": nanoseconds}
    given |= table.texts
    groups = [
        Group(block.shape[0], block.shape[1], block.reshape(-1), chosen)
        for chosen, block in encode_rows(structure, rows.times.size, given, where=table.topic)
    ]
    return Payloads(rows.times, rows.times, groups)


@dataclass(slots=True)
class _Rows:
    """Rows of a table: times [ns], shape (n,), columns of as many, and what was lost."""

    times: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    columns: Mapping[str, Floats] = field(default_factory=dict)
    losses: list[Loss] = field(default_factory=list)


def _read_rows(source: ByteSource, table: TextTable) -> _Rows:
    if source.size > _MAX_BYTES:
        what = (
            f"the table holds {source.size / 1e6:,.0f} MB, and no more than {_MAX_BYTES / 1e6:,.0f} are read"
        )
        raise LogError("too_large", what, where=source.name, hint="Cut it into several recordings")
    text = source.read_at(0, source.size).decode("utf-8-sig", "replace")
    losses: list[Loss] = []
    lines = text.splitlines()
    if lines and not text.endswith("\n"):
        # A number that is cut looks like another number.
        lines.pop()
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
        good = (at >= 0.0) & (at < _LATEST_NS / _KEPT_NS)
    if not (good.all() and len(lines) == at.size):
        count = len(lines) - int(good.sum())
        losses.append(Loss("damaged_record", f"{count} lines of {table.path} cannot be read"))
    columns = dict(zip(table.wanted, values[good].T, strict=True))
    return _Rows(at[good].astype(np.int64) * _KEPT_NS, columns, losses)


def _parse_lines(lines: Sequence[str], separator: str | None, places: Sequence[int]) -> Floats:
    """The numbers at some places of every line; lines without them are left out."""
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
