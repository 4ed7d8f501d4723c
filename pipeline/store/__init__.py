"""The only writer of results: whole generations of tables, published in one moment.

A run's results are a folder of Parquet tables and texts that never changes after its commit; the run's
manifest points at the current one and is replaced last. Killed at any moment, readers see the old results or
the new ones, never a mix, and the next writer cleans up. Rows that break a contract are kept and counted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.store import files
from pipeline.store.files import JSON, MANIFEST, MARKER, Manifest, hash_bytes, hash_file, hold_lock
from pipeline.store.generation import STEPS, Generation, point_latest, remove_orphans
from pipeline.store.listing import (
    KEY_MARK,
    LIST,
    REGISTER,
    LogIdentities,
    LogSighting,
    Partition,
    changed_since_sealed,
    encode_mark,
    entry_name,
    is_run_manifest,
    make_entry,
    not_sealed,
    parse_entry,
    renew_register,
    replace_listed,
    require_key,
    require_unsealed,
    see_log,
)
from pipeline.store.names import (
    QUARANTINE,
    Sample,
    StoreError,
    TableReport,
    check_file_name,
    check_home,
    check_key,
    encode_run,
    join_inside,
    name_clash,
    name_disk_errors,
)
from pipeline.store.seals import AGAIN_NOTES, LOG_NOTES, Key, Notes, encode_manifest, find_key, load_manifest

if TYPE_CHECKING:
    import polars as pl

    from pipeline.store.verification import Examination

LOCK = ".lock"
RUNS = "runs"
CLAIMS = "batch/claims"


@dataclass(frozen=True, kw_only=True)
class Survey:
    """The current generations that can be read, sorted by run, and why the others cannot."""

    manifests: tuple[Manifest, ...]
    errors: tuple[StoreError, ...]


class Store:
    """Results under one folder. Nothing is created before something is written.

    Args:
        root: the results folder.
        patience_s: how long a writer waits for another one of the same run.
        watch: called with the name of every step of a commit (`STEPS`).
    """

    def __init__(
        self, root: Path, *, patience_s: float = 60.0, watch: Callable[[str], None] = files.do_nothing
    ) -> None:
        self.root = Path(root)
        self._patience_s = patience_s
        self._watch = watch

    def manifest(self, run: str) -> Manifest | None:
        """The current generation of a run; None when there is none.

        Raises:
            StoreError: ``manifest_damaged``, ``manifest_too_new``, ``bad_run_name``, or another run's
                results stand in the folder (``name_clash``).
        """
        home = self._home_of(run)
        with name_disk_errors(home):
            manifest = load_manifest(home)
        if manifest is not None and manifest.run != run:
            raise name_clash(run, manifest.run, home)
        return manifest

    def manifests(self) -> tuple[Manifest, ...]:
        """The current generations of all runs, sorted by run.

        Raises:
            StoreError: one of them is damaged: leaving a run out silently would falsify what is computed.
        """
        survey = self.survey()
        for error in survey.errors:
            raise error
        return survey.manifests

    def survey(self) -> Survey:
        """As `manifests`, for those who can go on without the damaged ones and say so."""
        manifests, errors = [], []
        for home in self.run_dirs():
            try:
                with name_disk_errors(home):
                    manifest = load_manifest(home)
                if manifest is not None:
                    check_home(manifest.run, home, top=self.root / RUNS)
            except StoreError as error:
                errors.append(error)
                continue
            if manifest is not None:
                manifests.append(manifest)
        return Survey(
            manifests=tuple(sorted(manifests, key=lambda manifest: manifest.run)), errors=tuple(errors)
        )

    def runs(self) -> tuple[str, ...]:
        """Names of all runs that have a current generation, sorted.

        Raises:
            StoreError: as `manifests`.
        """
        return tuple(manifest.run for manifest in self.manifests())

    def run_dirs(self) -> tuple[Path, ...]:
        """Folders of all runs that have a manifest, readable or not, sorted."""
        top = self.root / RUNS
        folders = [path.parent for depth in ("*", "*/*") for path in top.glob(f"{depth}/{MANIFEST}")]
        return tuple(sorted(home for home in folders if not (home / MARKER).exists()))

    @contextmanager
    def open_generation(self, run: str, key: str) -> Iterator[Generation]:
        """Begin new results of a run, alone; without a commit nothing of them remains.

        Args:
            run: name of the run, ``stem`` or ``folder/stem``.
            key: hash of everything the results depend on; may be the current one.

        Raises:
            StoreError: ``locked``, ``bad_key``, ``bad_run_name``, a damaged manifest, or the disk refuses.
        """
        check_key(key)
        with self._lock_run(run) as home:
            previous = self.manifest(run)
            is_asked_again = previous is not None and self.is_asked_again(previous)
            if previous is not None and not is_asked_again:
                self._require_sealed(home)
            with name_disk_errors(home):
                files.remove_leftovers(home)
                remove_orphans(home, previous)
            generation = Generation(
                run=run,
                key=key,
                root=self.root,
                home=home,
                previous=previous,
                keeps_previous=previous is not None and not is_asked_again,
                key_of_results=self._key,
                watch=self._watch,
            )
            try:
                yield generation
            finally:
                generation.discard()

    def read(self, run: str, table: str) -> pl.DataFrame:
        """A table of a run's current generation.

        Raises:
            StoreError: ``no_such_run``, ``no_such_table``, or the file is gone or damaged.
        """
        manifest = self.manifest(run)
        while True:
            if manifest is None:
                hint = "Analyze its log first, or look with `slip results status` for the runs there are"
                raise StoreError(
                    "no_such_run", f"there are no results of {run!r}", where=str(self.root), hint=hint
                )
            try:
                return manifest.read(table)
            except StoreError:
                # A generation pruned between the look at the manifest and at the file has a successor.
                newer = self.manifest(run)
                if newer == manifest:
                    raise
                manifest = newer

    def scan(self, table: str, partition: Partition | None = None) -> pl.LazyFrame:
        """A table over the current generations of all runs, or one of the whole results (``datasets``).

        Args:
            table: a table's name, ``quarantine_<table>``, or ``runs`` for one row a run.
            partition: the runs to look at, told from their manifests: no file of another one is opened.

        Returns:
            The contract's columns, empty when no run has any.

        Raises:
            StoreError: ``no_such_table``, or a manifest is damaged.
        """
        from pipeline.store.parquet_tables import scan_table  # noqa: PLC0415 - heavy

        return scan_table(table, root=self.root, manifests=self.manifests(), partition=partition)

    def query(
        self, sql: str, partition: Partition | None = None, *, allow_files: bool = False
    ) -> pl.DataFrame:
        """Answer SQL over all tables by name.

        Args:
            sql: the question.
            partition: the runs to look at, as for `scan`.
            allow_files: whether the question may open files and addresses that are none of the results.

        Raises:
            StoreError: ``bad_query``, ``files_not_allowed``, or a manifest is damaged.
        """
        from pipeline.store.parquet_tables import answer_query  # noqa: PLC0415 - heavy

        return answer_query(
            sql, root=self.root, manifests=self.manifests(), partition=partition, allow_files=allow_files
        )

    def examine(self, sample: Sample | None = None) -> Examination:
        """Read everything again, or a sample; what is not what was written, and what cannot be judged."""
        from pipeline.store.verification import DiskFiles, examine_files  # noqa: PLC0415 - rarely needed

        return examine_files(DiskFiles(self.root), key=self._key, sample=sample)

    def ask_again(self, manifest: Manifest) -> None:
        """Have a run made again by whoever analyzes its log next; until then readers keep its results."""
        self.notes(AGAIN_NOTES).write(manifest.run, {"run": manifest.run, "folder": manifest.folder.name})

    def is_asked_again(self, manifest: Manifest) -> bool:
        """Whether exactly this generation is to be made again."""
        note = self.notes(AGAIN_NOTES).read(manifest.run)
        return note is not None and note.get("folder") == manifest.folder.name

    def put_on_list(self, name: str) -> None:
        """Have a manifest, or a file over all runs, on the list as it is.

        Raises:
            StoreError: ``locked``, or the disk refuses.
        """
        path = join_inside(self.root, name)
        with self._lock(path.parent), name_disk_errors(path):
            manifest = load_manifest(path.parent) if is_run_manifest(name) else None
            entry = make_entry(name, hash_file(path), manifest=manifest)
            files.make_folder(join_inside(self.root, LIST))
            files.replace_file(join_inside(self.root, entry_name(name)), entry.encode(self._key))

    def seal(self) -> None:
        """Seal results that no key seals with the key, as they are.

        Raises:
            StoreError: ``no_key``, ``sealed_already``, ``not_whole``; or the disk refuses.
        """
        from pipeline.store.verification import DiskFiles, seal_entries  # noqa: PLC0415 - rarely needed

        with self._lock_folder(self.root), name_disk_errors(self.root):
            key = require_unsealed(self._read(KEY_MARK), self._key, str(self.root))
            on_disk = DiskFiles(self.root)
            for name, data in seal_entries(on_disk, key):
                files.replace_file(join_inside(self.root, name), data, durable=False)
            files.sync_files([self.root / LIST])
            self._renew_register()
            # Last: killed before, the results are as little sealed as they were.
            self._replace(self.root / KEY_MARK, encode_mark(key))
            self._renew_register()

    def remove(self, name: str) -> None:
        """Remove a file that nobody can use any more: a damaged manifest, entry or note.

        Raises:
            StoreError: ``locked``, or the disk refuses.
        """
        path = join_inside(self.root, name)
        with self._lock(path.parent if is_run_manifest(name) else self.root), name_disk_errors(path):
            if name.startswith(f"{LIST}/"):
                self._renew_register(without=name)
            path.unlink(missing_ok=True)

    def prune(self, keep: int) -> tuple[Path, ...]:
        """Remove all but the newest ``keep`` generations of every run that are not current.

        Returns:
            The folders removed.

        Raises:
            StoreError: ``locked``, a damaged manifest, or the disk refuses.
        """
        if keep < 0:
            raise StoreError("bad_keep", f"cannot keep {keep} generations", hint="Give 0 or more")
        removed: list[Path] = []
        for manifest in self.manifests():
            with self._lock_run(manifest.run) as home:
                removed += self._prune_run(manifest.run, home, keep)
        return tuple(removed)

    def write_results_table(self, name: str, frame: pl.DataFrame) -> TableReport:
        """Write a table of the whole results, ``<name>.parquet``, in the place of the one before.

        Rows that break the contract go to ``quarantine_<name>.parquet``, removed when there are none.

        Raises:
            StoreError: ``wrong_columns``, ``no_such_table``, ``locked``, or the disk refuses.
        """
        from pipeline.store.parquet_tables import check_table  # noqa: PLC0415 - heavy

        checked = check_table(name, frame)
        valid, broken = checked.encode()
        quarantine = self.root / f"{QUARANTINE}{name}.parquet"
        with self._lock(self.root), name_disk_errors(self.root):
            self._replace(self.root / f"{name}.parquet", valid)
            if broken is not None or quarantine.exists():
                if broken is None:
                    self._renew_register(without=entry_name(quarantine.name))
                self._replace(quarantine, broken)
            self._renew_register()
        return checked.report

    def write_results_text(self, name: str, text: str) -> Path:
        """Write a text of the whole results, UTF-8, in the place of the one before.

        Raises:
            StoreError: ``bad_file_name``, ``locked``, or the disk refuses.
        """
        check_file_name(name)
        path = join_inside(self.root, name)
        with self._lock(self.root), name_disk_errors(path):
            files.make_folder(path.parent)
            files.remove_leftovers(path.parent)
            self._replace(path, text.encode())
            self._renew_register()
        return path

    def edit_results_text(self, name: str, edit: Callable[[str], str]) -> None:
        """Edit a text of the whole results; one that is not as it was written stays as it is.

        Raises:
            StoreError: as `write_results_text`.
        """
        check_file_name(name)
        path = join_inside(self.root, name)
        with self._lock(self.root), name_disk_errors(path):
            data = self._read_written(name)
            if data is not None and (edited := edit(data.decode(errors="replace")).encode()) != data:
                self._replace(path, edited)
                self._renew_register()

    def notes(self, folder: str) -> Notes:
        """Small notes beside the results, in a folder of their own."""
        return Notes(self.root, folder)

    def check_writable(self) -> None:
        """Find out before the work whether results can be written.

        Raises:
            StoreError: ``read_only``, ``permission_denied``, ``disk_full``, ``locked``, ...
        """
        with self._lock(self.root), name_disk_errors(self.root):
            probe = files.temporary_beside(self.root / "probe")
            files.write_new_file(probe, b"may be written")
            probe.unlink()

    @contextmanager
    def claim(self, name: str) -> Iterator[bool]:
        """Claim a piece of work for the length of the block, if nobody else has.

        Yields:
            Whether it is ours. Different names may, rarely, stand in each other's way.
        """
        folder = join_inside(self.root, CLAIMS)
        with name_disk_errors(folder):
            files.make_folder(folder)
        try:
            with hold_lock(folder / hash_bytes(name.encode())[:3], patience_s=0.0):
                yield True
        except StoreError as error:
            if error.code != "locked" or error.where != str(folder):
                raise
            yield False

    def _home_of(self, run: str) -> Path:
        return join_inside(self.root / RUNS, str(encode_run(run)))

    @contextmanager
    def _lock_run(self, run: str) -> Iterator[Path]:
        home = self._home_of(run)
        for folder in (home, home.parent):
            if (folder / MARKER).exists():
                raise name_clash(run, folder.parent.name, folder)
        with self._lock(home):
            yield home

    @contextmanager
    def _lock(self, folder: Path) -> Iterator[None]:
        """Hold the lock of a folder; nobody writes without the key that seals the results."""
        key = self._key
        if not require_key(self._read(KEY_MARK), key, str(self.root)) and key is not None:
            self._begin_sealed(key)
        with self._lock_folder(folder):
            yield

    @contextmanager
    def _lock_folder(self, folder: Path) -> Iterator[None]:
        with name_disk_errors(folder):
            files.make_folder(folder)
        with hold_lock(folder / LOCK, patience_s=self._patience_s):
            with name_disk_errors(folder):
                files.remove_leftovers(folder)
            yield

    @cached_property
    def _key(self) -> Key | None:
        return find_key()

    def _begin_sealed(self, key: Key) -> None:
        """Say of results that are about to begin that a key seals them."""
        with self._lock_folder(self.root):
            # Another writer may have begun them meanwhile.
            if require_key(self._read(KEY_MARK), key, str(self.root)):
                return
            if (self.root / LIST).exists() or (self.root / RUNS).exists():
                raise not_sealed(str(self.root))
            with name_disk_errors(self.root):
                self._replace(self.root / KEY_MARK, encode_mark(key))

    def _require_sealed(self, home: Path) -> None:
        """Refuse to build on a run that somebody without the key has written.

        Raises:
            StoreError: ``not_sealed``.
        """
        if self._key is None:
            return
        if self._read_written((home / MANIFEST).relative_to(self.root).as_posix()) is not None:
            return
        raise changed_since_sealed(str(home))

    def _read(self, name: str) -> bytes | None:
        """The content of a file by its name in the results; None where there is none."""
        path = join_inside(self.root, name)
        with name_disk_errors(path):
            try:
                return path.read_bytes()
            except (FileNotFoundError, NotADirectoryError):
                return None

    def _read_written(self, name: str) -> bytes | None:
        """The content of a file that is as it was written, with the key if there is one; else None."""
        data, entry = self._read(name), self._read(entry_name(name))
        with suppress(ValueError):
            listed = parse_entry(entry or b"", entry_name(name))
            if listed.is_sealed_with(self._key) and data and hash_bytes(data) in listed.sha256:
                return data
        return None

    def _replace(self, path: Path, data: bytes | None, manifest: Manifest | None = None) -> None:
        replace_listed(self.root, path, data, manifest, key=self._key)

    def _renew_register(self, *, without: str = "") -> None:
        """Bring the register up to date; only under the lock of the results folder."""
        names = (f"{LIST}/{path.name}" for path in (self.root / LIST).glob("*.json"))
        data = renew_register(self._read, names, key=self._key, without=without)
        if data is not None:
            self._replace(self.root / REGISTER, data)

    def _prune_run(self, run: str, home: Path, keep: int) -> list[Path]:
        manifest = self.manifest(run)
        with name_disk_errors(home):
            remove_orphans(home, manifest)
            if manifest is None or len(manifest.earlier) <= keep:
                return []
            doomed = [home / name for name in manifest.earlier[keep:]]
            # First the manifest forgets them: killed in between, they are orphans for the next writer.
            shorter = replace(manifest, earlier=manifest.earlier[:keep])
            self._require_sealed(home)
            self._replace(home / MANIFEST, encode_manifest(shorter), shorter)
            for folder in doomed:
                if folder.exists():
                    files.remove_folder(folder)
            point_latest(home, manifest.folder.name)
        return doomed
