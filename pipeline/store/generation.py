"""One run's results in the making: written beside the current generation, published in one moment."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl

from pipeline.store.files import (
    hash_bytes,
    hash_file,
    link_or_copy,
    make_folder,
    replace_file,
    sync_path,
    temporary_beside,
    write_file,
)
from pipeline.store.manifests import (
    MANIFEST,
    FileEntry,
    Manifest,
    encode_manifest,
    folder_of,
    read_parquet,
)
from pipeline.store.names import (
    NO_FACTS,
    QUARANTINE,
    StoreError,
    TableEntry,
    check_file_name,
    file_missing,
    name_disk_errors,
)
from pipeline.store.parquet_tables import CheckedTable, check_table, read_facts

LATEST = "latest"
"""Link to the current generation, for people; programs follow the manifest."""

_SYNCS_AT_ONCE = 8


class Generation:
    """A generation that nobody sees until `commit`.

    Made by `Store.open_generation`, which holds the run's lock as long as the generation is open. It stands
    in a folder with a higher number than the current one, and what is not committed is removed.

    Attributes:
        run: name of the run.
        key: key of the generation.
        previous: the manifest that was current when the lock was taken; None for a new run.
        folder: where it is written.
        is_published: whether readers see it, or may.
    """

    def __init__(self, *, run: str, key: str, home: Path, previous: Manifest | None) -> None:
        self.run = run
        self.key = key
        self.previous = previous
        self.is_published = False
        self._number = 1 if previous is None else previous.number + 1
        self.folder = folder_of(home, self._number)
        self._home = home
        self._tables: dict[str, TableEntry] = {}
        self._files: dict[str, FileEntry] = {}
        self.folder.mkdir()

    def write_table(
        self, name: str, frame: pl.DataFrame, facts: Mapping[str, float] = NO_FACTS
    ) -> TableEntry:
        """Hold a frame against its contract and write it; rows that break a rule go to the quarantine.

        Args:
            name: table name.
            frame: exactly the contract's columns, in any order.
            facts: numbers of the whole table that its contract declares.

        Raises:
            StoreError: ``wrong_columns``, ``no_such_table``, or the disk refuses.
        """
        return self.write_checked(check_table(name, frame, facts))

    def write_checked(self, checked: CheckedTable) -> TableEntry:
        """Write a table that was held against its contract.

        Raises:
            StoreError: the disk refuses.
        """
        name = checked.contract.name
        valid, rest = checked.encode()
        self._write(f"{name}.parquet", valid)
        if rest is not None:
            self._write(f"{QUARANTINE}{name}.parquet", rest)
        self._tables[name] = checked.report
        return checked.report

    def replace_table(self, name: str, frame: pl.DataFrame) -> None:
        """Write a table of this generation once more; its rows, its facts and its quarantine stay.

        Args:
            name: a table that was written or taken over.
            frame: exactly the contract's columns, in any order; every row keeps the contract.

        Raises:
            StoreError: ``no_such_table``, ``wrong_columns``, ``broken_rows``, or the disk refuses.
        """
        before, path = self._require_table(name), self.folder / f"{name}.parquet"
        checked = check_table(name, frame, read_facts(path))
        if checked.report.rows != before.rows:
            what = f"{name} has {before.rows} rows, and is to be replaced by {checked.report.rows} good ones"
            raise StoreError("broken_rows", what, where=self.run, hint="Replace values, and keep the rows")
        self._write(path.name, checked.encode()[0])
        self._tables[name] = replace(before, contract_version=checked.report.contract_version)

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
        return read_parquet(self.folder / f"{name}.parquet")

    def write_text(self, name: str, text: str) -> None:
        """Write a text file, UTF-8.

        Raises:
            StoreError: ``bad_file_name``, or the disk refuses.
        """
        self.write_bytes(name, text.encode())

    def write_bytes(self, name: str, data: bytes) -> None:
        """Write a file; errors as of `write_text`."""
        check_file_name(name)
        self._write(name, data)

    def reuse_table(self, name: str) -> None:
        """Take a table, and its quarantine, over from the previous generation unchanged.

        Raises:
            StoreError: ``no_such_table`` when the previous generation has none; ``file_missing`` or
                ``file_damaged`` when what is there is not what was written.
        """
        before = self._require_before(f"{name}.parquet")
        for file in (f"{name}.parquet", f"{QUARANTINE}{name}.parquet"):
            if file in before.files:
                self.reuse_file(file)
        self._tables[name] = before.tables[name]

    def reuse_file(self, name: str) -> None:
        """Take a file that is no table over from the previous generation unchanged.

        Raises:
            StoreError: as `reuse_table`.
        """
        before = self._require_before(name)
        source, entry = before.path(name), before.files[name]
        with name_disk_errors(source):
            try:
                digest = hash_file(source)
            except FileNotFoundError as error:
                raise file_missing(source) from error
            if digest != entry.sha256:
                what = "a file of the results has changed since it was written"
                hint = "Analyze the log again with --force"
                raise StoreError("file_damaged", what, where=str(source), hint=hint)
            make_folder((self.folder / name).parent)
            link_or_copy(source, self.folder / name)
        self._files[name] = entry

    def reuse_all(self, *others: str) -> None:
        """Take over all tables and files of the previous generation but the ``others``; as `reuse_table`."""
        before = self._require_before("")
        for name in before.files:
            if name not in others:
                self.reuse_file(name)
        self._tables |= before.tables

    def commit(self, details: Mapping[str, Any]) -> Manifest:
        """Publish the generation: from here on every reader sees it, and nothing of the one before.

        Args:
            details: what the run's keeper wants to find again: identity of the log, stage keys, versions.

        Raises:
            StoreError: ``bad_details``, or the disk refuses; readers go on seeing the generation before.
        """
        manifest = Manifest(
            run=self.run,
            key=self.key,
            number=self._number,
            tables=self._tables,
            files=self._files,
            details=details,
            home=self._home,
        )
        data = encode_manifest(manifest)
        with name_disk_errors(self._home):
            paths = [*self.folder.rglob("*"), self.folder, self._home]
            # Asked for at once, as long as for one of them.
            with ThreadPoolExecutor(_SYNCS_AT_ONCE, thread_name_prefix="sync") as pool:
                list(pool.map(sync_path, paths))
            # What is interrupted from here on may have been published.
            self.is_published = True
            replace_file(self._home / MANIFEST, data)
        with suppress(OSError):
            temporary = temporary_beside(self._home / LATEST)
            temporary.symlink_to(self.folder.name, target_is_directory=True)
            temporary.replace(self._home / LATEST)
        return manifest

    def _write(self, name: str, data: bytes) -> None:
        path = self.folder / name
        with name_disk_errors(path):
            make_folder(path.parent)
            # A file that was taken over is a link to that of the generation before.
            path.unlink(missing_ok=True)
            write_file(path, data, durable=False)
        self._files[name] = FileEntry(sha256=hash_bytes(data), bytes=len(data))

    def _require_table(self, name: str) -> TableEntry:
        if name not in self._tables:
            what = f"the generation holds no {name!r} so far"
            hint = "Run the stage before, or analyze the whole log"
            raise StoreError("no_such_table", what, where=self.run, hint=hint)
        return self._tables[name]

    def _require_before(self, name: str) -> Manifest:
        if self.previous is None or (name and name not in self.previous.files):
            what = f"the results before hold no {name!r} to take over"
            hint = "Compute it instead: analyze the log with --force"
            raise StoreError("no_such_table", what, where=self.run, hint=hint)
        return self.previous
