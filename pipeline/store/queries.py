"""Tables of many runs: scanned over their generations, and asked in SQL."""

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import polars as pl

from pipeline.core import shorten
from pipeline.store.files import Manifest, Partition
from pipeline.store.names import QUARANTINE, StoreError, date_runs, join_inside
from pipeline.store.parquet_tables import check_rows, find_contract, schema_of
from schemas import list_contracts

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
        if entry is not None and (table in manifest.tables or f"{table}.parquet" in manifest.files):
            path = manifest.path(table)
            check_rows(path, manifest.count_rows(table))
            (current if entry.contract_version == present else others).append(path)
    pooled = join_inside(root, f"{table}.parquet")
    if pooled.exists():
        check_rows(pooled, None)
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
