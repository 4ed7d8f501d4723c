"""`slip query`: SQL over the tables of all runs."""

from __future__ import annotations

import json as json_format
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from pipeline.cli.output import CLEAN, tidy_line
from pipeline.cli.results_place import open_results
from pipeline.core.errors import SlipError

if TYPE_CHECKING:
    import polars as pl

_WIDE = 200


def query(  # noqa: D417 - arguments document themselves
    sql: Annotated[str, Parameter(help="for example: SELECT * FROM runs")],
    /,
    *,
    out: Path = Path("results"),
    vehicle: str | None = None,
    terrain: str | None = None,
    dataset: str | None = None,
    day: str | None = None,
    to: Literal["table", "csv", "json"] = "table",
    allow_files: Annotated[bool, Parameter(negative=())] = False,
    json: Annotated[bool, Parameter(negative=())] = False,
) -> int:
    """Answer SQL over the tables (slip, windows, aggregates, datasets, ...) and `runs`, one row a run.

    Args:
        out: results folder.
        vehicle: only runs of this vehicle; files of other runs are not opened.
        terrain: only runs on this terrain.
        dataset: only runs of this dataset.
        day: only runs of this UTC day, 2026-07-31, or of a month, 2026-07.
        to: how to print the answer.
        allow_files: let the query open files and addresses of its own (read_csv, read_parquet, ...).
        json: print one JSON object: columns and rows.
    """
    from pipeline.store import Partition  # noqa: PLC0415 - only for this verb

    partition = Partition(vehicle=vehicle, terrain=terrain, dataset=dataset, day=day)
    place = open_results(out)
    store = place.open_store()
    if place.mirror is not None:
        words = re.findall(r"\w+", sql.lower())
        place.mirror.pull_tables(words, filter(partition.holds, store.manifests()))
    answer = store.query(sql, partition, allow_files=allow_files)
    _print(answer, "json" if json else to)
    return CLEAN


def _print(answer: pl.DataFrame, form: Literal["table", "csv", "json"]) -> None:
    import polars as pl  # noqa: PLC0415 - heavy

    if form == "csv":
        try:
            sys.stdout.write(answer.write_csv())
        except pl.exceptions.PolarsError as error:
            said = str(error).splitlines()[0]
            raise SlipError(
                "no_csv", f"the answer cannot be CSV: {said}", hint="Use --to json, or ask for plain columns"
            ) from error
    elif form == "json":
        names = json_format.dumps(answer.columns)
        sys.stdout.write(f'{{"columns": {names}, "rows": {_spell_bytes(answer).write_json()}}}\n')
    else:
        with pl.Config(tbl_rows=-1, tbl_cols=-1, fmt_str_lengths=_WIDE, tbl_width_chars=_WIDE):
            sys.stdout.write("".join(f"{tidy_line(line)}\n" for line in str(answer).split("\n")))


def _spell_bytes(answer: pl.DataFrame) -> pl.DataFrame:
    """The same table with bytes as hexadecimal digits: JSON has no word for them."""
    import polars as pl  # noqa: PLC0415 - heavy

    return answer.with_columns(
        pl.Series(column.name, [_spell(value) for value in column.to_list()], strict=False)
        for column in answer
        if "Binary" in str(column.dtype)
    )


def _spell(value: object) -> object:
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, list):
        return [_spell(each) for each in value]
    if isinstance(value, dict):
        return {name: _spell(each) for name, each in value.items()}
    return value
