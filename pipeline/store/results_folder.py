"""A folder of results: its runs, their generations, the tables over all runs, and questions in SQL."""

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import polars as pl

from pipeline.core import read_bounded_text, shorten
from pipeline.store import files
from pipeline.store.checksums import AGAIN_NOTES, Notes, encode_manifest, load_manifest
from pipeline.store.files import (
    MANIFEST,
    MARKER,
    Manifest,
    Partition,
    hash_bytes,
    hold_lock,
)
from pipeline.store.generation import Generation, point_latest, remove_orphans
from pipeline.store.names import (
    QUARANTINE,
    Sample,
    StoreError,
    TableReport,
    check_file_name,
    check_home,
    check_key,
    date_runs,
    encode_run,
    join_inside,
    name_clash,
    name_disk_errors,
)
from pipeline.store.parquet_tables import check_size, check_table, find_contract, schema_of
from pipeline.store.verification import DiskFiles, Examination, examine_files
from schemas import list_contracts

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
            with name_disk_errors(home):
                files.remove_leftovers(home)
                remove_orphans(home, previous)
            generation = Generation(
                run=run,
                key=key,
                home=home,
                previous=previous,
                keeps_previous=previous is not None and not is_asked_again,
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
        return scan_table(table, root=self.root, manifests=self.manifests(), partition=partition)

    def query(self, sql: str, partition: Partition | None = None) -> pl.DataFrame:
        """Answer SQL over all tables by name.

        Args:
            sql: the question.
            partition: the runs to look at, as for `scan`.

        Raises:
            StoreError: ``bad_query``, or a manifest or a table is damaged.
        """
        return answer_query(sql, root=self.root, manifests=self.manifests(), partition=partition)

    def examine(self, sample: Sample | None = None) -> Examination:
        """Read everything again, or a sample; what is not what was written, and what cannot be judged."""
        return examine_files(DiskFiles(self.root), sample=sample)

    def ask_again(self, manifest: Manifest) -> None:
        """Have a run made again by whoever analyzes its log next; until then readers keep its results."""
        self.notes(AGAIN_NOTES).write(manifest.run, {"run": manifest.run, "folder": manifest.folder.name})

    def is_asked_again(self, manifest: Manifest) -> bool:
        """Whether exactly this generation is to be made again."""
        note = self.notes(AGAIN_NOTES).read(manifest.run)
        return note is not None and note.get("folder") == manifest.folder.name

    def remove(self, name: str) -> None:
        """Remove a file that nobody can use any more: a damaged manifest or note.

        Raises:
            StoreError: ``locked``, or the disk refuses.
        """
        path = join_inside(self.root, name)
        with self._lock(path.parent if path.name == MANIFEST else self.root), name_disk_errors(path):
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
        checked = check_table(name, frame)
        valid, broken = checked.encode()
        quarantine = self.root / f"{QUARANTINE}{name}.parquet"
        with self._lock(self.root), name_disk_errors(self.root):
            files.replace_file(self.root / f"{name}.parquet", valid)
            if broken is None:
                quarantine.unlink(missing_ok=True)
            else:
                files.replace_file(quarantine, broken)
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
            files.replace_file(path, text.encode())
        return path

    def edit_results_text(self, name: str, edit: Callable[[str], str]) -> None:
        """Edit a text of the whole results, if it is there and is one.

        Raises:
            StoreError: as `write_results_text`.
        """
        check_file_name(name)
        path = join_inside(self.root, name)
        with self._lock(self.root), name_disk_errors(path):
            if not path.is_file():
                return
            try:
                text = read_bounded_text(path)
            except UnicodeDecodeError:
                return
            if (edited := edit(text)) != text:
                files.replace_file(path, edited.encode())

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
        with name_disk_errors(folder):
            files.make_folder(folder)
        with hold_lock(folder / LOCK, patience_s=self._patience_s):
            with name_disk_errors(folder):
                files.remove_leftovers(folder)
            yield

    def _prune_run(self, run: str, home: Path, keep: int) -> list[Path]:
        manifest = self.manifest(run)
        with name_disk_errors(home):
            remove_orphans(home, manifest)
            if manifest is None or len(manifest.earlier) <= keep:
                return []
            doomed = [home / name for name in manifest.earlier[keep:]]
            # First the manifest forgets them: killed in between, they are orphans for the next writer.
            shorter = replace(manifest, earlier=manifest.earlier[:keep])
            files.replace_file(home / MANIFEST, encode_manifest(shorter))
            for folder in doomed:
                if folder.exists():
                    files.remove_folder(folder)
            point_latest(home, manifest.folder.name)
        return doomed


# Tables of many runs: scanned over their generations, and asked in SQL.

_QUESTION = re.compile(
    r"(?>\s|\(|--[^\n]*(?:\n|$)|/\*.*?\*/)*+(?:SELECT|WITH|FROM)\b", re.IGNORECASE | re.DOTALL
)
"""The beginning of a query, behind comments; the engine also takes FROM before SELECT."""


RUNS_TABLE = "runs"
"""A table that is made of the manifests: one row a run."""


_RUNS_SCHEMA = pl.Schema(
    {
        "run": pl.String(),
        "dataset": pl.String(),
        "vehicle": pl.String(),
        "terrain": pl.String(),
        "day": pl.String(),
        "start_ns": pl.Int64(),
        "duration_s": pl.Float64(),
        "complete": pl.Boolean(),
        "bytes": pl.Int64(),
        "sha256": pl.String(),
        "log": pl.String(),
        "key": pl.String(),
        "folder": pl.String(),
    }
)


def scan_table(
    table: str, *, root: Path, manifests: Sequence[Manifest], partition: Partition | None = None
) -> pl.LazyFrame:
    """A table over the given generations and the results folder itself.

    Tables written under another version of the contract are fitted to the present one: columns that were not
    there are null, columns that are no more are left out.

    Args:
        table: its name.
        root: the results folder.
        manifests: the generations, which date each other.
        partition: those of them to look at.

    Raises:
        StoreError: ``no_such_table``; ``file_outside`` or ``not_a_file``, a link or a pipe stands for it.
    """
    if table == RUNS_TABLE:
        days = date_runs({one.run: one.start_ns for one in manifests}).days
        rows = [one.summarize(days[one.run]) for one in _select(manifests, partition)]
        return pl.LazyFrame(rows, schema=_RUNS_SCHEMA)
    schema = schema_of(table)
    present = find_contract(table.removeprefix(QUARANTINE)).version
    current: list[Path] = []
    others: list[Path] = []
    for manifest in _select(manifests, partition):
        entry = manifest.tables.get(table.removeprefix(QUARANTINE))
        if entry is not None and f"{table}.parquet" in manifest.files:
            path = manifest.path(table)
            check_size(path, manifest.count_rows(table))
            (current if entry.contract_version == present else others).append(path)
    pooled = join_inside(root, f"{table}.parquet")
    if pooled.exists():
        check_size(pooled, None)
        others.append(pooled)
    frames = [_fit(pl.scan_parquet(path, glob=False), schema) for path in others]
    if current:
        frames.insert(0, pl.scan_parquet(current, glob=False))
    return pl.concat(frames) if frames else pl.LazyFrame(schema=schema)


def _select(manifests: Sequence[Manifest], partition: Partition | None) -> Sequence[Manifest]:
    return manifests if partition is None else partition.select(manifests)


def answer_query(
    sql: str, *, root: Path, manifests: Sequence[Manifest], partition: Partition | None = None
) -> pl.DataFrame:
    """Answer SQL over all tables and their quarantines by name.

    Args:
        sql: the question.
        root: the results folder.
        manifests: the generations, which date each other.
        partition: those of them to look at.

    Raises:
        StoreError: ``bad_query``, with what polars says about it; ``file_missing`` or ``table_damaged``, a
            table is not what its manifest says.
    """
    _check_kind(sql)
    names = [contract.name for contract in list_contracts()]
    known = (RUNS_TABLE, *names, *(f"{QUARANTINE}{name}" for name in names))
    # With many runs, getting every table ready takes longer than the answer: only those that are spoken of.
    said = {word.lower() for word in re.findall(r"\w+", sql)}
    asked = [name for name in known if name in said]
    try:
        scan = partial(scan_table, root=root, manifests=manifests, partition=partition)
        return pl.SQLContext({name: scan(name) for name in asked}).execute(sql, eager=True)
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, UnicodeEncodeError, OSError) as error:
        what = str(error).partition("\n")[0]
        hint = f"The tables are: {', '.join((RUNS_TABLE, *names))}"
        if "no column named" in what:
            columns = ((name, _RUNS_SCHEMA if name == RUNS_TABLE else schema_of(name)) for name in asked)
            hint = "; ".join(f"Columns of {name}: {', '.join(schema)}" for name, schema in columns)
        raise StoreError(
            "bad_query", f"the query cannot be answered: {what}", where=shorten(sql), hint=hint
        ) from error


def _check_kind(sql: str) -> None:
    """Refuse what is no question.

    Raises:
        StoreError: ``bad_query``.
    """
    if _QUESTION.match(sql) is None:
        raise StoreError(
            "bad_query",
            "the query cannot be answered: it does not begin with SELECT or WITH",
            where=shorten(sql),
            hint="Queries read tables and never change them: SELECT run, vehicle FROM runs",
        )


def _fit(frame: pl.LazyFrame, schema: pl.Schema) -> pl.LazyFrame:
    known = frame.collect_schema()
    return frame.select(
        (pl.col(name) if name in known else pl.lit(None)).cast(kind, strict=False).alias(name)
        for name, kind in schema.items()
    )
