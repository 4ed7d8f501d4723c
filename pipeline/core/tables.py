"""Rows as tables of the contracts."""

from collections.abc import Iterable, Mapping

import polars as pl

from schemas import Table, contract_of


def tabulate(table: str, rows: Iterable[Mapping[str, object]]) -> pl.DataFrame:
    """Rows by column as a table, without the columns that every table has; what a row lacks is null."""
    kinds = contract_of(table).schema.create_empty().schema
    own = {name: kind for name, kind in kinds.items() if name not in Table.column_names()}
    return pl.DataFrame(list(rows), schema=own, orient="row")
