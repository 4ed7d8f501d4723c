"""The manifest: the one pointer from a run to its current generation, and runs told from it alone.

It is replaced last and in one moment, so whoever follows it sees a whole generation. For several tables of
the same generation take the manifest once and read them all through it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from pipeline.store.names import QUARANTINE, StoreError, file_missing, join_inside, name_damage, table_damaged

if TYPE_CHECKING:
    import polars as pl

MANIFEST = "manifest.json"
"""Before the name of a table: the rows of it that break its contract."""

MARKER = ".generation"
"""Stands in every generation's folder and tells it from a folder of runs."""

JSON: TypeAlias = "bool | int | float | str | Sequence[JSON] | Mapping[str, JSON] | None"


@dataclass(frozen=True, kw_only=True)
class FileEntry:
    """A file of a generation: its size in bytes and its SHA-256 in hexadecimal."""

    sha256: str
    bytes: int


@dataclass(frozen=True, kw_only=True)
class TableEntry:
    """A table of a generation.

    Attributes:
        file: name of the Parquet file in the generation's folder.
        rows: rows that keep the contract.
        quarantined: rows that break it; they stand in ``quarantine_<table>.parquet``.
        sha256: of the file, in hexadecimal.
        bytes: size of the file.
        contract_version: version of the contract it was written under.
        rules: how many rows broke each rule.
    """

    file: str
    rows: int
    quarantined: int
    sha256: str
    bytes: int
    contract_version: int
    rules: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """What a run's current generation is and holds.

    Attributes:
        run: name of the run.
        key: key of the generation, as given by the writer.
        folder: folder of the generation, named by the key, with a number behind it where the key was taken.
        tables: the tables by name.
        files: all other files by name.
        details: what the writer gave with the commit.
        earlier: names of the folders of the generations before this one that are still there, newest first.
    """

    run: str
    key: str
    folder: Path
    tables: Mapping[str, TableEntry]
    files: Mapping[str, FileEntry]
    details: Mapping[str, JSON]
    earlier: tuple[str, ...] = ()

    def path(self, name: str) -> Path:
        """Path of a table or a quarantine (by its name) or of another file (by its file name).

        Raises:
            StoreError: ``no_such_table``, this generation holds neither; ``file_outside``, a link leads away.
        """
        if name in self.tables:
            return join_inside(self.folder, self.tables[name].file)
        for file in (name, f"{name}.parquet"):
            if file in self.files:
                return join_inside(self.folder, file)
        raise StoreError(
            "no_such_table",
            f"the results of {self.run!r} hold no {name!r}; they hold {', '.join(self.names()) or 'nothing'}",
            where=str(self.folder),
            hint="Analyze the log again to make it",
        )

    def count_rows(self, table: str) -> int | None:
        """Rows of a table or of its ``quarantine_<table>``; None where this generation has no such table."""
        if table in self.tables:
            return self.tables[table].rows
        entry = self.tables.get(table.removeprefix(QUARANTINE))
        return None if entry is None else entry.quarantined

    def names(self) -> tuple[str, ...]:
        """Names of all tables, then of all other files."""
        return (*sorted(self.tables), *sorted(self.files))

    def hashes(self) -> dict[str, str]:
        """SHA-256 of every file by its name in the generation's folder, sorted."""
        tables = {entry.file: entry.sha256 for entry in self.tables.values()}
        return dict(sorted((tables | {name: entry.sha256 for name, entry in self.files.items()}).items()))

    def read(self, table: str) -> pl.DataFrame:
        """A table of exactly this generation, or the ``quarantine_<table>`` of one.

        Raises:
            StoreError: ``no_such_table``; ``file_missing`` when it was pruned or deleted meanwhile;
                ``table_damaged``, it cannot be read, or has not the columns of its contract.
        """
        from pipeline.store.parquet_tables import check_rows, is_of_contract  # noqa: PLC0415 - heavy

        path = self.path(table)
        check_rows(path, self.count_rows(table))
        frame = read_parquet(path)
        entry = self.tables.get(table)
        if entry is not None and not is_of_contract(table, entry.contract_version, frame.schema):
            raise table_damaged("its columns are not those of its contract", path)
        return frame

    def part(self, *keys: str) -> Mapping[str, JSON]:
        """The object that stands in the details under these keys, one within the other; empty without one."""
        content: JSON = dict(self.details)
        for key in keys:
            content = content.get(key) if isinstance(content, dict) else None
        return content if isinstance(content, dict) else {}

    def read_json(self, name: str) -> dict[str, JSON]:
        """A JSON object of exactly this generation.

        Raises:
            StoreError: ``no_such_table``, it names no such file; ``file_missing``; ``file_damaged``, it is
                not what was written.
        """
        path = self.path(name)
        try:
            data = path.read_bytes()
            content = json.loads(data) if hash_bytes(data) == self.files[path.name].sha256 else None
        except FileNotFoundError as error:
            raise file_missing(path) from error
        except (OSError, ValueError, RecursionError):
            content = None
        if not isinstance(content, dict):
            hint = "Analyze the log again with --force; `slip results verify` lists what else is damaged"
            raise StoreError("file_damaged", "the file is not what was written", where=str(path), hint=hint)
        return content

    def summarize(self) -> dict[str, JSON]:
        """The row of a run in the table ``runs``."""
        details, log = self.details, self.part("log")
        start = self.part("stages", "extract", "context").get("start_ns")
        stamp = start if isinstance(start, int) and start > 0 else None
        return {
            "run": self.run,
            "dataset": _text(details.get("dataset")),
            "vehicle": _text(self.part("vehicle").get("id")),
            "terrain": _text(details.get("terrain")),
            "day": None if stamp is None else f"{datetime.fromtimestamp(stamp // 10**9, UTC):%Y-%m-%d}",
            "start_ns": stamp,
            "duration_s": log.get("duration_s"),
            "complete": log.get("complete"),
            "bytes": log.get("bytes"),
            "sha256": log.get("sha256"),
            "log": log.get("path"),
            "key": self.key,
            "folder": str(self.folder),
        }


def hash_bytes(data: bytes) -> str:
    """SHA-256 in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def hash_file(path: Path) -> str:
    """SHA-256 of a file in hexadecimal.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_parquet(path: Path) -> pl.DataFrame:
    """The frame in a table's file.

    Raises:
        StoreError: ``file_missing`` or ``table_damaged``.
    """
    import polars as pl  # noqa: PLC0415 - heavy, and `slip --help` imports this room

    with name_damage(path):
        return pl.read_parquet(path, glob=False)


@dataclass(frozen=True, kw_only=True)
class Partition:
    """The part of the runs that a question is about; what is not said is not asked.

    Attributes:
        vehicle: id of the vehicle.
        terrain: name of the terrain.
        dataset: name of the dataset.
        day: UTC day of the log's start, ``2026-07-31``; a beginning such as ``2026-07`` stands for all in it.
    """

    vehicle: str | None = None
    terrain: str | None = None
    dataset: str | None = None
    day: str | None = None

    def holds(self, manifest: Manifest) -> bool:
        """Whether a run belongs to it."""
        summary = manifest.summarize()
        plain = {"vehicle": self.vehicle, "terrain": self.terrain, "dataset": self.dataset}
        is_like = all(wanted is None or summary[name] == wanted for name, wanted in plain.items())
        return is_like and (self.day is None or str(summary["day"] or "").startswith(self.day))


def _text(content: object) -> str | None:
    return content if isinstance(content, str) else None
