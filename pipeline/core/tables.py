"""Conversion of rows to tables of the contracts, and to CSV."""

from collections.abc import Iterable, Mapping

import polars as pl
import polars.selectors as cs

_FORMULA = "=+\\-@\t\r\n\uff1d\uff0b\uff0d\uff20"
"""First characters of a spreadsheet formula, after OWASP, "CSV Injection"; the last four are wide forms."""


def tabulate(table: str, rows: Iterable[Mapping[str, object]]) -> pl.DataFrame:
    """Rows as a table, without the columns that every table has; missing values are null."""
    from schemas import Table, contract_of  # noqa: PLC0415 - `slip inspect` needs no contract

    kinds = contract_of(table).schema.create_empty().schema
    own = {name: kind for name, kind in kinds.items() if name not in Table.column_names()}
    return pl.DataFrame(list(rows), schema=own, orient="row")


def format_csv(frame: pl.DataFrame, *, header: bool = True, digits: int | None = None) -> str:
    """A table as CSV, safe for spreadsheets: a text that looks like a formula gets a leading quote.

    Args:
        frame: a table without nested columns; numbers, also negative ones, are unchanged.
        header: whether the first line contains the column names.
        digits: number of decimal places; None for all.

    Raises:
        PolarsError: a column cannot be represented in CSV.
    """
    names = pl.Series(frame.columns, dtype=pl.String)
    safe = dict(zip(frame.columns, names.to_frame("").select(_quote(pl.col(""))).to_series(), strict=True))
    texts = frame.with_columns(_quote((cs.string() | cs.enum() | cs.categorical()).cast(pl.String)))
    return texts.rename(safe).write_csv(include_header=header, float_precision=digits)


def unquote_formulas(frame: pl.DataFrame) -> pl.DataFrame:
    """The original texts of a table that `format_csv` wrote."""
    return frame.with_columns(cs.string().str.replace(f"^'('*[{_FORMULA}])", "$1"))


def _quote(text: pl.Expr) -> pl.Expr:
    # Existing leading quotes get one more, so that the original text can be restored.
    return text.str.replace(f"^('*[{_FORMULA}])", "'$1")
