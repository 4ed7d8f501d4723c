"""A folder of results: its runs, their generations, the tables over all runs, and questions in SQL."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TypeAlias

import polars as pl

from pipeline.core import read_bounded_text, shorten
from pipeline.store.checksums import Notes
from pipeline.store.files import (
    TEMPORARY,
    find_holder,
    hash_bytes,
    hold_lock,
    make_folder,
    read_holder,
    remove,
    replace_file,
    temporary_beside,
    write_file,
)
from pipeline.store.generation import Generation
from pipeline.store.manifests import (
    MANIFEST,
    Manifest,
    encode_manifest,
    list_generations,
    load_manifest,
)
from pipeline.store.names import (
    QUARANTINE,
    Sample,
    StoreError,
    TableEntry,
    check_file_name,
    check_home,
    date_runs,
    encode_run,
    join_inside,
    name_clash,
    name_disk_errors,
)
from pipeline.store.parquet_tables import check_size, check_table, find_contract, schema_of
from pipeline.store.verification import RUNS, Examination, examine_results
from schemas import list_contracts

LOCK = ".lock"
CLAIMS = "batch/claims"

Asked: TypeAlias = Mapping[str, str | None]
"""The part of the runs that a question is about: ``vehicle``, ``terrain``, ``dataset`` and ``day``, a date or
the beginning of one; what is None is not asked."""

_ALL: Asked = MappingProxyType({})


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
    """

    def __init__(self, root: Path, *, patience_s: float = 60.0) -> None:
        self.root = Path(root)
        self._patience_s = patience_s

    def manifest(self, run: str) -> Manifest | None:
        """The current generation of a run; None when there is none.

        Raises:
            StoreError: ``manifest_damaged``, ``other_version``, ``bad_run_name``, or another run's results
                stand in the folder (``name_clash``).
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
                    manifests.append(manifest)
            except StoreError as error:
                errors.append(error)
        return Survey(manifests=tuple(sorted(manifests, key=lambda one: one.run)), errors=tuple(errors))

    def runs(self) -> tuple[str, ...]:
        """Names of all runs that have a current generation, sorted.

        Raises:
            StoreError: as `manifests`.
        """
        return tuple(manifest.run for manifest in self.manifests())

    def run_dirs(self) -> tuple[Path, ...]:
        """Folders of all runs that have a manifest, readable or not, sorted."""
        top = self.root / RUNS
        return tuple(
            sorted(path.parent for depth in ("*", "*/*") for path in top.glob(f"{depth}/{MANIFEST}"))
        )

    def list_writers(self) -> dict[str, str]:
        """Who writes which run now: holders by the path of the run's folder below ``runs``."""
        top = self.root / RUNS
        locks = sorted(path for depth in ("*", "*/*") for path in top.glob(f"{depth}/{LOCK}"))
        held = ((path.parent.relative_to(top).as_posix(), find_holder(path)) for path in locks)
        return {name: holder for name, holder in held if holder}

    def find_writer(self, manifest: Manifest) -> str:
        """Who writes new results of a run now; empty where nobody does."""
        return find_holder(manifest.home / LOCK)

    @contextmanager
    def open_generation(self, run: str, key: str) -> Iterator[Generation]:
        """Begin new results of a run, alone; without a commit nothing of them remains.

        Args:
            run: name of the run, ``stem`` or ``folder/stem``.
            key: hash of everything the results depend on; may be the current one.

        Raises:
            StoreError: ``locked``, ``bad_run_name``, a damaged manifest, or the disk refuses.
        """
        home = self._home_of(run)
        with self._lock(home):
            previous = self.manifest(run)
            with name_disk_errors(home):
                for number, folder in list_generations(home).items():
                    # Of a writer that was killed just before its last step.
                    if previous is None or number > previous.number:
                        remove(folder)
                generation = Generation(run=run, key=key, home=home, previous=previous)
            try:
                yield generation
            finally:
                if not generation.is_published:
                    with suppress(OSError):
                        remove(generation.folder)

    def scan(
        self, table: str, manifests: Sequence[Manifest] | None = None, asked: Asked = _ALL
    ) -> pl.LazyFrame:
        """A table over the current generations of runs, with that of the whole results (``datasets``).

        Tables written under another version of the contract are fitted to the present one: columns that were
        not there are null, columns that are no more are left out.

        Args:
            table: a table's name, ``quarantine_<table>``, or ``runs`` for one row a run.
            manifests: the runs, which date each other; None for all.
            asked: those of them to look at, told from their manifests: no file of another one is opened.

        Returns:
            The contract's columns, empty when no run has any.

        Raises:
            StoreError: ``no_such_table``; a manifest or a table is damaged; ``file_outside`` or
                ``not_a_file``, a link or a pipe stands for it.
        """
        manifests = self.manifests() if manifests is None else manifests
        if table == RUNS_TABLE:
            return pl.LazyFrame([row for _, row in _list_rows(manifests, asked)], schema=_RUNS_SCHEMA)
        schema = schema_of(table)
        name = table.removeprefix(QUARANTINE)
        present = find_contract(name).version
        current: list[Path] = []
        others: list[Path] = []
        for manifest in [one for one, _ in _list_rows(manifests, asked)] if asked else manifests:
            if name in manifest.tables and f"{table}.parquet" in manifest.files:
                path = manifest.path(table)
                check_size(path, manifest.count_rows(table))
                is_present = manifest.tables[name].contract_version == present
                (current if is_present else others).append(path)
        pooled = join_inside(self.root, f"{table}.parquet")
        if pooled.exists():
            check_size(pooled, None)
            others.append(pooled)
        frames = [pl.scan_parquet(current, glob=False)] if current else []
        frames += [_fit(pl.scan_parquet(path, glob=False), schema) for path in others]
        return pl.concat(frames) if frames else pl.LazyFrame(schema=schema)

    def query(self, sql: str, asked: Asked = _ALL) -> pl.DataFrame:
        """Answer SQL over all tables and their quarantines by name.

        Args:
            sql: the question.
            asked: the runs to look at, as for `scan`.

        Raises:
            StoreError: ``bad_query``, with what polars says about it; ``file_missing`` or ``table_damaged``,
                a table is not what its manifest says; a manifest is damaged.
        """
        if _QUESTION.match(sql) is None:
            what = "the query cannot be answered: it does not begin with SELECT or WITH"
            hint = "Queries read tables and never change them: SELECT run, vehicle FROM runs"
            raise StoreError("bad_query", what, where=shorten(sql), hint=hint)
        names = [contract.name for contract in list_contracts()]
        known = (RUNS_TABLE, *names, *(f"{QUARANTINE}{name}" for name in names))
        # With many runs, getting every table ready takes longer than the answer: only those spoken of.
        said = {word.lower() for word in re.findall(r"\w+", sql)}
        spoken = [name for name in known if name in said]
        scan = partial(self.scan, manifests=self.manifests(), asked=asked)
        try:
            return pl.SQLContext({name: scan(name) for name in spoken}).execute(sql, eager=True)
        except (
            pl.exceptions.PolarsError,
            pl.exceptions.PanicException,
            UnicodeEncodeError,
            OSError,
        ) as error:
            what = str(error).partition("\n")[0]
            hint = f"The tables are: {', '.join((RUNS_TABLE, *names))}"
            if "no column named" in what:
                columns = ((name, _RUNS_SCHEMA if name == RUNS_TABLE else schema_of(name)) for name in spoken)
                hint = "; ".join(f"Columns of {name}: {', '.join(schema)}" for name, schema in columns)
            raise StoreError(
                "bad_query", f"the query cannot be answered: {what}", where=shorten(sql), hint=hint
            ) from error

    def examine(self, sample: Sample | None = None) -> Examination:
        """Read everything again, or a sample; what is not what was written, and what cannot be judged."""
        return examine_results(self.root, sample)

    def ask_again(self, manifest: Manifest) -> None:
        """Have a run made again by whoever analyzes its log next; until then readers keep its results.

        Raises:
            StoreError: ``locked``, or the disk refuses.
        """
        self._edit(manifest, replace(manifest, again=True))

    def move_log(self, manifest: Manifest, path: str) -> Manifest:
        """The manifest of a run with the path its log has now; failing to write it is no error."""
        moved = replace(manifest, details={**manifest.details, "log": {**manifest.part("log"), "path": path}})
        with suppress(StoreError):
            self._edit(manifest, moved)
        return moved

    def _edit(self, manifest: Manifest, edited: Manifest) -> None:
        with self._lock(manifest.home), name_disk_errors(manifest.home):
            if load_manifest(manifest.home) == manifest:
                replace_file(manifest.home / MANIFEST, encode_manifest(edited))

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
        removed: list[Path] = []
        for manifest in self.manifests():
            if len(list_old(manifest)) <= keep:
                continue
            with self._lock(manifest.home), name_disk_errors(manifest.home):
                for folder in list_old(manifest)[keep:]:
                    remove(folder)
                    removed.append(folder)
        return tuple(removed)

    def write_results_table(self, name: str, frame: pl.DataFrame) -> TableEntry:
        """Write a table of the whole results, ``<name>.parquet``, in the place of the one before.

        Rows that break the contract go to ``quarantine_<name>.parquet``, removed when there are none.

        Raises:
            StoreError: ``wrong_columns``, ``no_such_table``, ``locked``, or the disk refuses.
        """
        checked = check_table(name, frame)
        with self._lock(self.root), name_disk_errors(self.root):
            for prefix, data in zip(("", QUARANTINE), checked.encode(), strict=True):
                path = self.root / f"{prefix}{name}.parquet"
                if data is None:
                    path.unlink(missing_ok=True)
                else:
                    replace_file(path, data)
        return checked.report

    def write_results_text(self, name: str, text: str) -> Path:
        """Write a text of the whole results, UTF-8, in the place of the one before.

        Raises:
            StoreError: ``bad_file_name``, ``locked``, or the disk refuses.
        """
        check_file_name(name)
        path = join_inside(self.root, name)
        with self._lock(self.root), name_disk_errors(path):
            replace_file(path, text.encode())
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
                replace_file(path, edited.encode())

    def notes(self, folder: str) -> Notes:
        """Small notes beside the results, in a folder of their own."""
        return Notes(self.root, folder)

    def check_writable(self) -> None:
        """Find out before the work whether results can be written.

        Raises:
            StoreError: ``read_only``, ``permission_denied``, ``disk_full``, ``locked``, ...
        """
        with self._lock(self.root), name_disk_errors(self.root):
            probe = temporary_beside(self.root / "probe")
            write_file(probe, b"may be written", durable=True)
            probe.unlink()

    @contextmanager
    def claim(self, name: str) -> Iterator[str]:
        """Claim a piece of work for the length of the block, if nobody else has.

        Yields:
            Empty if it is ours, or who holds it since when. Different names may, rarely, stand in each
            other's way.
        """
        folder = join_inside(self.root, CLAIMS)
        with name_disk_errors(folder):
            make_folder(folder)
        try:
            with hold_lock(folder / hash_bytes(name.encode())[:3], patience_s=0.0):
                yield ""
        except StoreError as error:
            if error.code != "locked" or error.where != str(folder):
                raise
            yield read_holder(folder / hash_bytes(name.encode())[:3])

    def _home_of(self, run: str) -> Path:
        return join_inside(self.root / RUNS, str(encode_run(run)))

    @contextmanager
    def _lock(self, folder: Path) -> Iterator[None]:
        with name_disk_errors(folder):
            make_folder(folder)
        with hold_lock(folder / LOCK, patience_s=self._patience_s):
            with name_disk_errors(folder):
                # What killed writers left.
                for path in folder.glob(f"{TEMPORARY}*"):
                    remove(path)
            yield


def list_old(manifest: Manifest) -> list[Path]:
    """Folders of the generations of a run before the current one, the newest first."""
    return [path for number, path in list_generations(manifest.home).items() if number < manifest.number]


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


def _list_rows(manifests: Sequence[Manifest], asked: Asked) -> list[tuple[Manifest, Mapping[str, object]]]:
    """Runs, and their rows in the table ``runs``: of all, those that were asked for."""
    days = date_runs({one.run: one.start_ns for one in manifests}).days
    rows = [(one, one.summarize(days[one.run])) for one in manifests]
    wanted = {name: text for name, text in asked.items() if text is not None}
    begins = wanted.pop("day", "")
    return [
        (one, row)
        for one, row in rows
        if wanted.items() <= row.items() and (days[one.run] or "").startswith(begins)
    ]


def _fit(frame: pl.LazyFrame, schema: pl.Schema) -> pl.LazyFrame:
    known = frame.collect_schema()
    return frame.select(
        (pl.col(name) if name in known else pl.lit(None)).cast(kind, strict=False).alias(name)
        for name, kind in schema.items()
    )
