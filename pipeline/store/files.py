"""Files that are there whole or not at all, one writer at a time, and the manifest of a run.

The manifest is the one pointer from a run to its current generation. It is replaced last and in one moment,
so whoever follows it sees a whole generation. For several tables of the same generation take the manifest
once and read them all through it.
"""

import errno
import hashlib
import os
import platform
import secrets
import shutil
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

import polars as pl

from pipeline.core import read_bounded, walk_files
from pipeline.store.names import (
    NOT_AS_WRITTEN,
    QUARANTINE,
    StoreError,
    date_runs,
    file_missing,
    join_inside,
    name_damage,
    name_disk_errors,
    path_unread,
    table_damaged,
)
from pipeline.store.stored_files import AGAIN, SUMMARY, StoredSummary, convert_stored, decode_stored

TEMPORARY = ".tmp-"
"""How the names of unfinished files and folders begin; no reader looks at them."""

_SYNCS_AT_ONCE = 8
_NO_FOLDER_SYNC = (errno.EINVAL, errno.ENOTSUP, errno.EBADF)
_NO_LINK = (errno.EXDEV, errno.EPERM, errno.EACCES, errno.EMLINK, errno.ENOTSUP, errno.ENOSYS)


def write_new_file(path: Path, data: bytes) -> None:
    """Write a file that must not exist yet, and wait until the disk has it.

    Refusing an existing file matters: it could be a hard link into an older generation.

    Raises:
        FileExistsError: there is a file already.
        OSError: the disk is full, read-only, ...; no half-written file remains.
    """
    draft_file(path, data, lambda file: os.fsync(file.fileno()))


def do_nothing(*_: object) -> None:
    """In the place of what may be done."""


def draft_file(path: Path, data: bytes, finish: Callable[[BinaryIO], None] = do_nothing) -> None:
    """As `write_new_file`, without waiting for the disk: `sync_files` does so for many at once.

    Args:
        path: the file, which must not exist yet.
        data: the content.
        finish: called with the file when all of it is written.

    Raises:
        FileExistsError: there is a file already.
        OSError: the disk is full, read-only, ...; no half-written file remains.
    """
    with path.open("xb") as file:
        try:
            file.write(data)
            file.flush()
            finish(file)
        except BaseException:
            with suppress(OSError):
                path.unlink()
            raise


def sync_files(paths: Sequence[Path]) -> None:
    """Wait until the disk has files, and the names in folders; asked for at once, as long as for one of them.

    Raises:
        OSError: the disk did not take one of them.
    """
    if not paths:
        return
    with ThreadPoolExecutor(min(len(paths), _SYNCS_AT_ONCE), thread_name_prefix="sync") as pool:
        for _ in pool.map(_sync_path, paths):
            pass


def _sync_path(path: Path) -> None:
    if path.is_dir():
        sync_folder(path)
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def replace_file(
    path: Path, data: bytes, *, when_written: Callable[[], None] = do_nothing, durable: bool = True
) -> None:
    """Put a whole new file in the place of ``path`` in one moment; readers see the old or the new one.

    Args:
        path: the file, which need not exist yet; its folder does.
        data: the new content.
        when_written: called when the new file is on the disk, before it takes the place.
        durable: whether to wait until the disk has it.

    Raises:
        OSError: the old file is untouched and nothing else remains.
    """
    temporary = temporary_beside(path)
    try:
        (write_new_file if durable else draft_file)(temporary, data)
        when_written()
        temporary.replace(path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise
    if durable:
        sync_folder(path.parent)


def temporary_beside(path: Path) -> Path:
    """A fresh hidden name in the folder of ``path``."""
    return path.parent / f"{TEMPORARY}{os.getpid()}-{secrets.token_hex(4)}"


def sync_folder(folder: Path) -> None:
    """Wait until the disk has the names of a folder.

    Some network file systems have no such call, and a folder may be writable without being readable; the
    system then writes the names in its own time.
    """
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except PermissionError:
        return
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _NO_FOLDER_SYNC:
            raise
    finally:
        os.close(descriptor)


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, each of them durable."""
    if folder.is_dir():
        return
    make_folder(folder.parent)
    with suppress(FileExistsError):
        folder.mkdir()
    sync_folder(folder.parent)


def link_or_copy(source: Path, target: Path) -> None:
    """Give a finished file a second name, or copy it where links are impossible.

    Raises:
        FileExistsError: ``target`` exists.
        OSError: the disk is full, read-only, ...
    """
    try:
        os.link(source, target)
    except OSError as error:
        if error.errno not in _NO_LINK:
            raise
        write_new_file(target, source.read_bytes())


def remove_folder(folder: Path) -> None:
    """Remove a folder so that it never stands half empty under its own name; errors as `remove_tree`."""
    doomed = temporary_beside(folder)
    folder.rename(doomed)
    remove_tree(doomed)


def remove_tree(folder: Path) -> None:
    """Remove a folder with all that is in it.

    Raises:
        StoreError: ``path_unread``, it is nested more deeply than anything that slip makes.
        OSError: the disk refuses.
    """

    def refuse(path: Path, why: str) -> None:
        raise path_unread(path, why)

    for _ in walk_files(folder, refuse):
        pass
    shutil.rmtree(folder)


def remove_leftovers(folder: Path) -> None:
    """Remove what killed writers left in ``folder``; call only under its lock; errors as `remove_tree`."""
    for entry in sorted(folder.glob(f"{TEMPORARY}*")):
        if entry.is_dir() and not entry.is_symlink():
            remove_tree(entry)
        else:
            entry.unlink()


_RETRY_S = 0.02


@contextmanager
def hold_lock(path: Path, *, patience_s: float) -> Iterator[None]:
    """Hold the lock file ``path`` for the length of the block.

    The file stays: removing it would let two writers hold two files of one name. What stands in it only
    serves the message to those who wait.

    A file system without locks (some network mounts) is refused: a file that merely exists would outlive a
    writer that was killed.

    Args:
        path: the lock file; its folder exists.
        patience_s: how long to wait for another holder.

    Raises:
        StoreError: ``locked``, another process held the lock all that time; or the disk refuses.
    """
    from filelock import FileLock, Timeout  # noqa: PLC0415 - heavy, and only writers need it

    lock = FileLock(path, thread_local=False, fallback_to_soft=False, preserve_lock_file=True)
    with name_disk_errors(path):
        try:
            lock.acquire(timeout=patience_s, poll_interval=_RETRY_S)
        except Timeout as error:
            raise StoreError(
                "locked",
                f"{_read_holder(path)} has been writing here for more than {patience_s:g} s",
                where=str(path.parent),
                hint="Wait until it is done or stop it, then run the same command again",
            ) from error
    try:
        # The note is a courtesy: a full disk must be reported by what needs the space.
        with suppress(OSError):
            path.write_text(f"process {os.getpid()} on {platform.node()}", encoding="utf-8")
        yield
    finally:
        lock.release()


def _read_holder(path: Path) -> str:
    with suppress(OSError):
        return path.read_text(encoding="utf-8", errors="replace")[:200] or "another process"
    return "another process"


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
    """A table of a generation, in the file ``<table>.parquet``.

    Attributes:
        rows: rows that keep the contract.
        quarantined: rows that break it; they stand in ``quarantine_<table>.parquet``.
        contract_version: version of the contract it was written under.
        rules: how many rows broke each rule.
    """

    rows: int
    quarantined: int
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
        files: all files by name, those of the tables included.
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

    def hashes(self) -> dict[str, str]:
        """SHA-256 of every file by its name in the generation's folder, sorted."""
        return {name: entry.sha256 for name, entry in sorted(self.files.items())}

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


@dataclass(frozen=True, kw_only=True)
class Partition:
    """The part of the runs that a question is about; what is not said is not asked.

    Attributes:
        vehicle: id of the vehicle.
        terrain: name of the terrain.
        dataset: name of the dataset.
        day: date of the run, ``2026-07-31``; a beginning such as ``2026-07`` stands for all in it.
    """

    vehicle: str | None = None
    terrain: str | None = None
    dataset: str | None = None
    day: str | None = None

    def select(self, manifests: Sequence[Manifest]) -> tuple[Manifest, ...]:
        """The runs that belong to it."""
        days = date_runs({one.run: one.start_ns for one in manifests}).days
        wanted = {"vehicle": self.vehicle, "terrain": self.terrain, "dataset": self.dataset}
        asked = {name: value for name, value in wanted.items() if value is not None}
        begins = self.day or ""
        return tuple(
            one
            for one in manifests
            if asked.items() <= one.summarize(None).items() and (days[one.run] or "").startswith(begins)
        )


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
