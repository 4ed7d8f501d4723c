"""Questions over all runs: one table as a lazy frame, or SQL over all tables."""

from __future__ import annotations

from typing import TYPE_CHECKING

import polars as pl

from pipeline.store.errors import StoreError, name_disk_errors
from pipeline.store.tables import QUARANTINE, find_contract, schema_of
from schemas import list_contracts

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from pipeline.store.manifest import Manifest


def scan_table(table: str, *, root: Path, manifests: Sequence[Manifest]) -> pl.LazyFrame:
    """A table over the given generations and the results folder itself.

    Tables written under another version of the contract are fitted to the present one: columns that were not
    there are null, columns that are no more are left out.

    Raises:
        StoreError: ``no_such_table``.
    """
    schema = schema_of(table)
    present = find_contract(table.removeprefix(QUARANTINE)).version
    current: list[Path] = []
    others: list[Path] = []
    for manifest in manifests:
        entry = manifest.tables.get(table.removeprefix(QUARANTINE))
        if entry is not None and (table in manifest.tables or f"{table}.parquet" in manifest.files):
            path = manifest.folder / f"{table}.parquet"
            (current if entry.contract_version == present else others).append(path)
    if (root / f"{table}.parquet").exists():
        others.append(root / f"{table}.parquet")
    frames = [_fit(pl.scan_parquet(path, glob=False), schema) for path in others]
    if current:
        frames.insert(0, pl.scan_parquet(current, glob=False))
    return pl.concat(frames) if frames else pl.LazyFrame(schema=schema)


def answer_query(sql: str, *, root: Path, manifests: Sequence[Manifest]) -> pl.DataFrame:
    """Answer SQL over all tables and their quarantines by name.

    Raises:
        StoreError: ``bad_query``, with what polars says about it.
    """
    names = [contract.name for contract in list_contracts()]
    frames = {
        name: scan_table(name, root=root, manifests=manifests)
        for name in (*names, *(f"{QUARANTINE}{name}" for name in names))
    }
    try:
        with name_disk_errors(root):
            return pl.SQLContext(frames).execute(sql, eager=True)
    except pl.exceptions.PolarsError as error:
        raise StoreError(
            "bad_query",
            f"the query cannot be answered: {str(error).splitlines()[0]}",
            where=sql,
            hint=f"The tables are: {', '.join(names)}",
        ) from error


def _fit(frame: pl.LazyFrame, schema: pl.Schema) -> pl.LazyFrame:
    found = frame.collect_schema()
    return frame.select(
        (pl.col(name) if name in found else pl.lit(None)).cast(kind, strict=False).alias(name)
        for name, kind in schema.items()
    )
