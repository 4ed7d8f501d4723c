"""One run's results in the making: written beside the current generation, published in one moment."""

import shutil
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import polars as pl

from pipeline.store import files
from pipeline.store.checksums import encode_manifest, load_manifest
from pipeline.store.files import (
    JSON,
    MANIFEST,
    MARKER,
    FileEntry,
    Manifest,
    TableEntry,
    hash_bytes,
    hash_file,
    read_parquet,
    remove_folder,
    temporary_beside,
)
from pipeline.store.names import (
    NO_FACTS,
    QUARANTINE,
    StoreError,
    TableReport,
    check_file_name,
    file_missing,
    join_inside,
    name_disk_errors,
)
from pipeline.store.parquet_tables import CheckedTable, check_table, read_facts

LATEST = "latest"


def name_free_folder(home: Path, key: str, taken: Collection[str] = ()) -> Path:
    """The folder for a new generation: the key, with a number behind it where the key is taken.

    A generation made again under the same key gets a folder of its own, because a folder cannot be replaced
    in one moment, and the readers of the old one must not find the new one's files in it.

    Args:
        home: the run's folder.
        key: key of the generation.
        taken: names that the manifest knows: a generation that somebody deleted still has its own.
    """
    folder, number = home / key, 1
    while folder.name in taken or folder.exists():
        number += 1
        folder = home / f"{key}.{number}"
    return folder


def point_latest(home: Path, folder: str) -> None:
    """Point the link ``latest`` at a generation; it is a convenience, so failing is no error."""
    temporary = temporary_beside(home / LATEST)
    with suppress(OSError):
        temporary.symlink_to(folder, target_is_directory=True)
        try:
            temporary.replace(home / LATEST)
        except OSError:
            temporary.unlink()


def remove_orphans(home: Path, current: Manifest | None) -> None:
    """Remove generations that no manifest names: of writers killed just before their last step.

    Call only under the run's lock.
    """
    named = {current.folder.name, *current.earlier} if current else set()
    for marker in sorted(home.glob(f"*/{MARKER}")):
        if marker.parent.name not in named and not marker.parent.is_symlink():
            remove_folder(marker.parent)


STEPS = (
    "opened",
    "file_written",
    "folder_synced",
    "folder_renamed",
    "manifest_written",
    "manifest_replaced",
    "latest_replaced",
)
"""The moments of a generation that `Store` reports to ``watch``, in this order, the second once a file."""


class Generation:
    """A generation that nobody sees until `commit`.

    Made by `Store.open_generation`, which holds the run's lock as long as the generation is open.

    Attributes:
        run: name of the run.
        key: key of the generation.
        previous: the manifest that was current when the lock was taken; None for a new run.
    """

    def __init__(
        self,
        *,
        run: str,
        key: str,
        home: Path,
        previous: Manifest | None,
        keeps_previous: bool,
        watch: Callable[[str], None],
    ) -> None:
        self.run = run
        self.key = key
        self.previous = previous
        self._keeps_previous = keeps_previous
        self._home = home
        self._watch = watch
        self._folder = files.temporary_beside(home / key)
        self._tables: dict[str, TableEntry] = {}
        self._files: dict[str, FileEntry] = {}
        self._drafts: list[Path] = []
        self._is_open = True
        with name_disk_errors(self._folder):
            self._folder.mkdir()
        watch("opened")

    def write_table(
        self, name: str, frame: pl.DataFrame, facts: Mapping[str, float] = NO_FACTS
    ) -> TableReport:
        """Hold a frame against its contract and write it; rows that break a rule go to the quarantine.

        Args:
            name: table name.
            frame: exactly the contract's columns, in any order.
            facts: numbers of the whole table that its contract declares.

        Raises:
            StoreError: ``wrong_columns``, ``no_such_table``, ``written_twice``, or the disk refuses.
        """
        return self.write_checked(check_table(name, frame, facts))

    def replace_table(self, name: str, frame: pl.DataFrame) -> None:
        """Write a table of this generation once more; its rows, its facts and its quarantine stay.

        Args:
            name: a table that was written or taken over.
            frame: exactly the contract's columns, in any order; every row keeps the contract.

        Raises:
            StoreError: ``no_such_table``, ``wrong_columns``, ``broken_rows``, or the disk refuses.
        """
        self._require_open()
        before = self._require_table(name)
        path = self._folder / f"{name}.parquet"
        checked = check_table(name, frame, read_facts(path))
        if checked.report.rows != before.rows:
            what = f"{name} has {before.rows} rows, and is to be replaced by {checked.report.rows} good ones"
            raise self._refuse("broken_rows", what, "Replace values, and keep the rows")
        data, _ = checked.encode()
        with name_disk_errors(path):
            # A table that was taken over is a link to the file of the generation before.
            path.unlink()
            self._draft(path, data)
        self._watch("file_written")
        self._files[path.name] = FileEntry(sha256=hash_bytes(data), bytes=len(data))
        self._tables[name] = replace(before, contract_version=checked.contract.version)

    def write_checked(self, checked: CheckedTable) -> TableReport:
        """Write a table that was held against its contract.

        Raises:
            StoreError: ``written_twice``, or the disk refuses.
        """
        name = checked.contract.name
        valid, rest = checked.encode()
        self._write(f"{name}.parquet", valid)
        if rest is not None:
            self._write(f"{QUARANTINE}{name}.parquet", rest)
        self._tables[name] = TableEntry(contract_version=checked.contract.version, **vars(checked.report))
        return checked.report

    @property
    def table_names(self) -> tuple[str, ...]:
        """Tables written or taken over so far, in that order."""
        return tuple(self._tables)

    def read_table(self, name: str) -> pl.DataFrame:
        """A table of this generation as it will be read later: without the rows that went to quarantine.

        Raises:
            StoreError: ``no_such_table``, it was neither written nor taken over so far.
        """
        self._require_table(name)
        return read_parquet(self._folder / f"{name}.parquet")

    def write_text(self, name: str, text: str) -> None:
        """Write a text file, UTF-8.

        Raises:
            StoreError: ``bad_file_name``, ``written_twice``, or the disk refuses.
        """
        self.write_bytes(name, text.encode())

    def write_bytes(self, name: str, data: bytes) -> None:
        """Write a file; errors as of `write_text`."""
        check_file_name(name)
        self._write(name, data)

    def reuse_table(self, name: str) -> TableReport:
        """Take a table, and its quarantine, over from the previous generation unchanged.

        Raises:
            StoreError: ``no_such_table`` when the previous generation has none; ``file_missing`` or
                ``file_damaged`` when what is there is not what was written.
        """
        entry = None if self.previous is None else self.previous.tables.get(name)
        if self.previous is None or entry is None:
            raise self._nothing_to_reuse(name)
        self._link(f"{name}.parquet")
        if (broken := f"{QUARANTINE}{name}.parquet") in self.previous.files:
            self._link(broken)
        self._tables[name] = entry
        return TableReport(rows=entry.rows, quarantined=entry.quarantined, rules=entry.rules)

    def reuse_file(self, name: str) -> None:
        """Take a file that is no table over from the previous generation unchanged.

        Raises:
            StoreError: as `reuse_table`.
        """
        self._link(name)

    def reuse_all(self, *others: str) -> None:
        """Take over all tables and files of the previous generation but the ``others``; as `reuse_table`."""
        if self.previous is None:
            raise self._nothing_to_reuse("table")
        for name in self.previous.files:
            if name not in others:
                self._link(name)
        self._tables |= self.previous.tables

    def commit(self, details: Mapping[str, JSON]) -> Manifest:
        """Publish the generation: from here on every reader sees it, and nothing of the one before.

        Args:
            details: what the run's keeper wants to find again: identity of the log, stage keys, versions.

        Raises:
            StoreError: ``bad_details``, or the disk refuses; readers go on seeing the generation before.
        """
        self._require_open()
        with name_disk_errors(self._home):
            manifest = self._make_manifest(details)
            data = encode_manifest(manifest)
            self._draft(self._folder / MARKER, b"")
            folders = sorted(path for path in self._folder.rglob("*") if path.is_dir())
            files.sync_files([*self._drafts, *folders, self._folder])
            self._watch("folder_synced")
            self._folder.rename(manifest.folder)
            self._folder = manifest.folder
            files.sync_folder(self._home)
            self._watch("folder_renamed")
            files.replace_file(
                self._home / MANIFEST, data, when_written=lambda: self._watch("manifest_written")
            )
            self._watch("manifest_replaced")
        self._is_open = False
        point_latest(self._home, manifest.folder.name)
        self._watch("latest_replaced")
        return manifest

    def discard(self) -> None:
        """Remove what was not published; without effect after a commit."""
        self._is_open = False
        try:
            current = load_manifest(self._home)
        except (StoreError, OSError):
            # Without a look at the manifest this may be the current generation: the next writer decides.
            return
        # The manifest on disk decides: a commit interrupted right behind its last step is a commit.
        if current is None or current.folder != self._folder:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _taken(self) -> tuple[str, ...]:
        """Names of generations that the manifest of before knows."""
        return () if self.previous is None else (self.previous.folder.name, *self.previous.earlier)

    def _make_manifest(self, details: Mapping[str, JSON]) -> Manifest:
        return Manifest(
            run=self.run,
            key=self.key,
            folder=name_free_folder(self._home, self.key, self._taken()),
            tables=self._tables,
            files=self._files,
            details=details,
            # What is made again because it is damaged is nothing to look back at.
            earlier=self._taken() if self._keeps_previous else self._taken()[1:],
        )

    def _write(self, name: str, data: bytes) -> None:
        self._require_new(name)
        path = self._folder / name
        with name_disk_errors(path):
            files.make_folder(path.parent)
            self._draft(path, data)
        self._watch("file_written")
        self._files[name] = FileEntry(sha256=hash_bytes(data), bytes=len(data))

    def _draft(self, path: Path, data: bytes) -> None:
        files.draft_file(path, data)
        self._drafts.append(path)

    def _link(self, name: str) -> None:
        self._require_new(name)
        entry = None if self.previous is None else self.previous.files.get(name)
        if self.previous is None or entry is None:
            raise self._nothing_to_reuse(name)
        source = join_inside(self.previous.folder, name)
        with name_disk_errors(source):
            try:
                digest = hash_file(source)
            except FileNotFoundError as error:
                raise file_missing(source) from error
            if digest != entry.sha256:
                raise StoreError(
                    "file_damaged",
                    "a file of the results has changed since it was written",
                    where=str(source),
                    hint="Analyze the log again with --force",
                )
            files.make_folder((self._folder / name).parent)
            files.link_or_copy(source, self._folder / name)
        self._watch("file_written")
        self._files[name] = entry

    def _require_open(self) -> None:
        if not self._is_open:
            hint = "Open a new one; a generation never changes after its commit"
            raise self._refuse("generation_closed", f"the generation {self.key} is closed", hint)

    def _require_new(self, name: str) -> None:
        self._require_open()
        if name in self._files:
            hint = "Write each table and file of a generation once"
            raise self._refuse("written_twice", f"{name} was written already", hint)

    def _require_table(self, name: str) -> TableEntry:
        if name not in self._tables:
            what = f"the generation holds no {name!r} so far"
            raise self._refuse("no_such_table", what, "Run the stage before, or analyze the whole log")
        return self._tables[name]

    def _nothing_to_reuse(self, name: str) -> StoreError:
        what = f"the results before hold no {name!r} to take over"
        return self._refuse("no_such_table", what, "Compute it instead: analyze the log with --force")

    def _refuse(self, code: str, what: str, hint: str) -> StoreError:
        return StoreError(code, what, where=self.run, hint=hint)
