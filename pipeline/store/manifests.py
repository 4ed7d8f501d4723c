"""The manifest of a run: the one pointer to its current generation, and what that holds.

It is replaced last and in one moment, so whoever follows it sees a whole generation. For several tables of
the same generation take the manifest once and read them all through it.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import msgspec
import polars as pl

from pipeline.core import PathError, read_bounded, resolve_inside
from pipeline.store.checksums import check_checksum, encode_checked
from pipeline.store.files import hash_bytes
from pipeline.store.names import (
    GENERATION,
    NOT_AS_WRITTEN,
    QUARANTINE,
    StoreError,
    TableEntry,
    file_missing,
    is_file_name,
    join_inside,
    name_damage,
    name_disk_errors,
    table_damaged,
)
from pipeline.store.stored_files import AGAIN, SUMMARY, StoredSummary, convert_stored, decode_stored

MANIFEST = "manifest.json"

JSON: TypeAlias = "bool | int | float | str | Sequence[JSON] | Mapping[str, JSON] | None"


@dataclass(frozen=True, kw_only=True)
class FileEntry:
    """A file of a generation: its size in bytes and its SHA-256 in hexadecimal."""

    sha256: str
    bytes: int


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """What a run's current generation is and holds.

    Attributes:
        run: name of the run.
        key: key of the generation, as given by the writer.
        number: of the generation, from 1; those with lower numbers are older, there are none above it.
        tables: the tables by name.
        files: all files by name, those of the tables included.
        details: what the writer gave with the commit.
        again: whether it is to be made again by whoever analyzes its log next.
        home: folder of the run; not in the file.
    """

    run: str
    key: str
    number: Annotated[int, msgspec.Meta(ge=1)]
    tables: Mapping[str, TableEntry]
    files: Mapping[str, FileEntry]
    details: Mapping[str, Any]
    again: bool = False
    home: Path = Path()

    @property
    def folder(self) -> Path:
        """Folder of the generation."""
        return folder_of(self.home, self.number)

    def path(self, name: str) -> Path:
        """Path of a table or a quarantine (by its name) or of another file (by its file name).

        Raises:
            StoreError: ``no_such_table``, this generation holds neither; ``file_outside``, a link leads away.
        """
        for file in (f"{name}.parquet", name):
            if file in self.files:
                return join_inside(self.folder, file)
        raise StoreError(
            "no_such_table",
            f"the results of {self.run!r} hold no {name!r}; they hold "
            f"{', '.join(sorted(self.tables)) or 'nothing'}",
            where=str(self.folder),
            hint="Analyze the log again to make it",
        )

    def count_rows(self, table: str) -> int | None:
        """Rows of a table or of its ``quarantine_<table>``; None where this generation has no such table."""
        if table in self.tables:
            return self.tables[table].rows
        entry = self.tables.get(table.removeprefix(QUARANTINE))
        return None if entry is None else entry.quarantined

    def find_damage(self, needed: Collection[str] = ()) -> StoreError | None:
        """What `read` raises of the first table whose file is of another size; nothing is read.

        Args:
            needed: tables whose files may not be missing either.
        """
        for name in self.tables:
            path = self.folder / f"{name}.parquet"
            if not path.exists():
                if name in needed:
                    return file_missing(path)
            elif path.stat().st_size != self.files[path.name].bytes:
                return table_damaged(NOT_AS_WRITTEN, path)
        return None

    def read(self, table: str) -> pl.DataFrame:
        """A table of exactly this generation, or the ``quarantine_<table>`` of one.

        Raises:
            StoreError: ``no_such_table``; ``file_missing`` when it was pruned or deleted meanwhile;
                ``table_damaged``, it cannot be read, or has not the columns of its contract.
        """
        from pipeline.store.parquet_tables import is_of_contract  # noqa: PLC0415 - heavy

        path = self.path(table)
        frame = read_parquet(path, self.count_rows(table))
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
        if not path.is_file():
            raise file_missing(path)
        with name_disk_errors(path):
            data = read_bounded(path)
        if hash_bytes(data) != self.files[path.name].sha256:
            what = "the file has changed since it was written"
            raise StoreError("file_damaged", what, where=str(path), hint=AGAIN)
        content = decode_stored(data, dict[str, Any], path)
        if name == SUMMARY:
            convert_stored(content, StoredSummary, path)
        return content

    @property
    def start_ns(self) -> int | None:
        """Timestamp of the log's first sample [ns]; None if it is not known."""
        start = self.part("stages", "extract", "context").get("start_ns")
        return start if isinstance(start, int) and start > 0 else None

    def summarize(self, day: str | None) -> dict[str, JSON]:
        """The row of a run in the table ``runs``, with the date that `date_runs` gives it."""
        details, log = self.details, self.part("log")
        return {
            "run": self.run,
            "dataset": _text(details.get("dataset")),
            "vehicle": _text(self.part("vehicle").get("id")),
            "terrain": _text(details.get("terrain")),
            "day": day,
            "start_ns": self.start_ns,
            "duration_s": log.get("duration_s"),
            "complete": log.get("complete"),
            "bytes": log.get("bytes"),
            "sha256": log.get("sha256"),
            "log": log.get("path"),
            "key": self.key,
            "folder": str(self.folder),
        }


def folder_of(home: Path, number: int) -> Path:
    """Folder of a generation."""
    return home / f"generation-{number}"


def list_generations(home: Path) -> dict[int, Path]:
    """Folders of a run's generations by their numbers, the newest first."""
    folders = [(int(name[1]), path) for path in home.glob("*") if (name := GENERATION.fullmatch(path.name))]
    return dict(sorted(folders, reverse=True))


def encode_manifest(manifest: Manifest) -> bytes:
    """The manifest as the content of its file.

    Raises:
        StoreError: ``bad_details``, the details hold something JSON has no word for.
    """
    content = asdict(manifest)
    del content["home"]
    try:
        return encode_checked(content, indent=1)
    except (TypeError, ValueError) as error:
        hint = "Give texts, finite numbers, lists and mappings with text keys only"
        raise StoreError(
            "bad_details", f"the details of a generation must be JSON: {error}", where=manifest.run, hint=hint
        ) from error


def load_manifest(home: Path) -> Manifest | None:
    """The manifest in a run's folder; None when there is none.

    Raises:
        StoreError: ``manifest_damaged``; ``other_version``, another version of slip wrote it; ``not_a_file``;
            ``file_outside``, it is a link that leads away.
        OSError: the file cannot be read.
    """
    try:
        data = read_bounded(join_inside(home, MANIFEST))
    except (FileNotFoundError, NotADirectoryError):
        return None
    return parse_manifest(data, home)


def parse_manifest(data: bytes, home: Path) -> Manifest:
    """The manifest in the content of its file.

    Args:
        data: the content.
        home: the run's folder.

    Raises:
        StoreError: ``manifest_damaged``; ``other_version``, it is whole, but not as this version writes it.
    """
    path = home / MANIFEST
    try:
        check_checksum(data)
        manifest = replace(msgspec.json.decode(data, type=Manifest), home=home)
        _check_names(manifest)
    except msgspec.ValidationError as error:
        what = f"another version of slip wrote the results ({error})"
        hint = "Use that version, or another folder with --results"
        raise StoreError("other_version", what, where=str(path), hint=hint) from error
    except (ValueError, RecursionError, PathError) as error:
        said = error.what if isinstance(error, PathError) else " ".join(str(error).split())
        hint = "Delete this one file and analyze its log again"
        raise StoreError(
            "manifest_damaged", f"the manifest is damaged ({said})", where=str(path), hint=hint
        ) from error
    return manifest


def _check_names(manifest: Manifest) -> None:
    # Files are read by these names: an edited one must not lead elsewhere.
    resolve_inside(manifest.home, manifest.folder.name)
    for name in (*manifest.tables, *manifest.files):
        if not is_file_name(name) or ("/" in name and name not in manifest.files):
            raise ValueError(f"it names {name!r}")
    for table in manifest.tables:
        if f"{table}.parquet" not in manifest.files:
            raise ValueError(f"it names no file for the table {table!r}")


def read_parquet(path: Path, rows: int | None = None) -> pl.DataFrame:
    """The frame in a table's file, whose size is checked before any row is read.

    Args:
        path: the Parquet file.
        rows: as the manifest has it; None where no manifest speaks of the file.

    Raises:
        StoreError: ``file_missing`` or ``table_damaged``.
    """
    from pipeline.store.parquet_tables import check_size  # noqa: PLC0415 - heavy

    check_size(path, rows)
    with name_damage(path):
        return pl.read_parquet(path, glob=False)


def _text(content: object) -> str | None:
    return content if isinstance(content, str) else None
