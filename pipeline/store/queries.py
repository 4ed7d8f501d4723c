"""Questions over all runs: one table as a lazy frame, or SQL over all tables."""

import re
from collections.abc import Sequence
from pathlib import Path

import polars as pl

from pipeline.store.manifest import Manifest, summarize_run
from pipeline.store.names import QUARANTINE, StoreError, file_missing, join_inside, name_disk_errors
from pipeline.store.parquet_tables import check_rows, find_contract, schema_of
from schemas import list_contracts

_READERS = re.compile(
    r"(?:read|scan)_(?:csv|parquet|ipc|json|ndjson|avro|delta|iceberg|excel|database|\w*(?=\W*\())"
)
"""Names by which SQL opens files and addresses, wherever they stand: none is ever meant as a text."""

_TOKEN = re.compile(r"'[^']*'|\d[\w.]*|\w+|[^\s\w,]")
"""A text, a number, a word or a mark."""

_LONGEST = 65_536
"""Characters of a query. Two of them make the engine recurse once (`+1`): so it does less often than where it
crashes on the stack of `slip results query`."""

_MOST_WORDS = 1_000
"""Words and marks of a query without texts, numbers and commas: each may make the engine recurse once. On the
usual stack of 8 MB it crashes beyond 600 chained `||`, which are 1200 marks, or 600 UNION ALL, which are 1800
words."""

_DEEPEST = 40
"""Brackets within each other: the engine's parser itself refuses 48."""

_SHOWN = 500
"""Characters of a query or of a complaint about it in an error."""

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


def scan_table(table: str, *, root: Path, manifests: Sequence[Manifest]) -> pl.LazyFrame:
    """A table over the given generations and the results folder itself.

    Tables written under another version of the contract are fitted to the present one: columns that were not
    there are null, columns that are no more are left out.

    Raises:
        StoreError: ``no_such_table``; ``file_outside`` or ``not_a_file``, a link or a pipe stands for it.
    """
    if table == RUNS_TABLE:
        return pl.LazyFrame([summarize_run(manifest) for manifest in manifests], schema=_RUNS_SCHEMA)
    schema = schema_of(table)
    present = find_contract(table.removeprefix(QUARANTINE)).version
    current: list[Path] = []
    others: list[Path] = []
    for manifest in manifests:
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


def answer_query(
    sql: str, *, root: Path, manifests: Sequence[Manifest], allow_files: bool = False
) -> pl.DataFrame:
    """Answer SQL over all tables and their quarantines by name.

    Args:
        sql: the question.
        root: the results folder.
        manifests: the generations to look at.
        allow_files: whether the question may open files and addresses that are none of the results.

    Raises:
        StoreError: ``bad_query``, with what polars says about it; ``files_not_allowed``; ``file_missing``;
            ``table_damaged``, a table has not the rows that it should have.
    """
    _check_size(sql)
    reader = None if allow_files else _READERS.search(sql.lower())
    if reader is not None:
        raise StoreError(
            "files_not_allowed",
            f"the query names {reader[0]}, which opens files outside the results",
            where=_shorten(sql),
            hint="Ask the tables of the results only, or give --allow-files if the query is your own",
        )
    names = [contract.name for contract in list_contracts()]
    known = (RUNS_TABLE, *names, *(f"{QUARANTINE}{name}" for name in names))
    # With many runs, getting every table ready takes longer than the answer: only those that are spoken of.
    said = {word.lower() for word in re.findall(r"\w+", sql)}
    asked = [name for name in known if name in said]
    try:
        frames = {name: scan_table(name, root=root, manifests=manifests) for name in asked}
        with name_disk_errors(root):
            return pl.SQLContext(frames).execute(sql, eager=True)
    except StoreError:
        gone = [path for path in _list_files(asked, manifests) if not path.exists()]
        if gone:
            raise file_missing(gone[0]) from None
        raise
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, UnicodeEncodeError) as error:
        raise StoreError(
            "bad_query",
            f"the query cannot be answered: {_shorten(str(error).partition(chr(10))[0])}",
            where=_shorten(sql),
            hint=f"The tables are: {', '.join((RUNS_TABLE, *names))}",
        ) from error


def _check_size(sql: str) -> None:
    """Refuse what the engine would overflow its stack on: it ends the process then.

    Raises:
        StoreError: ``bad_query``.
    """
    words = depth = deepest = 0
    if len(sql) <= _LONGEST:
        for match in _TOKEN.finditer(sql):
            first = match[0][0]
            words += not (first == "'" or first.isdigit())
            depth += (first in "([{") - (first in ")]}")
            deepest = max(deepest, depth)
    for what, number, most in (
        ("characters", len(sql), _LONGEST),
        ("words and marks besides texts and numbers", words, _MOST_WORDS),
        ("brackets within each other", deepest, _DEEPEST),
    ):
        if number > most:
            raise StoreError(
                "bad_query",
                f"the query cannot be answered: it has {number} {what}, more than {most}",
                where=_shorten(sql),
                hint="Ask in parts, with IN (...) in place of a chain of OR",
            )


def _list_files(tables: Sequence[str], manifests: Sequence[Manifest]) -> list[Path]:
    return [manifest.path(table) for manifest in manifests for table in tables if table in manifest.tables]


def _shorten(text: str) -> str:
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]} ..."


def _fit(frame: pl.LazyFrame, schema: pl.Schema) -> pl.LazyFrame:
    known = frame.collect_schema()
    return frame.select(
        (pl.col(name) if name in known else pl.lit(None)).cast(kind, strict=False).alias(name)
        for name, kind in schema.items()
    )
