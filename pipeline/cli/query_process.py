"""The process that answers a query: what the engine does to it, it does to nothing else.

The request comes on stdin as JSON, the answer goes to stdout, an error to stderr as JSON.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import msgspec

from pipeline.cli.conventions import CLEAN, FAILED, ResultsLocation, tidy_line
from pipeline.core import SlipError, end_with, silence_warnings

if TYPE_CHECKING:
    import polars as pl

STACK_BYTES = 1 << 28
"""Stack size of the threads on which the engine recurses. It needs about 3 kB for an operator, 12 kB for a
UNION ALL: 65,536 characters of them take 100 MB."""

_WIDE = 200
_ROWS_AT_ONCE = 1 << 16
"""Rows converted to text at a time, so that the answer is not in memory a second time as text."""


@dataclass(frozen=True, kw_only=True)
class QueryRequest:
    """What `slip results query` was asked.

    Attributes:
        sql: the question.
        out: results folder.
        partition: fields of a `Partition`.
        allow_files: whether it may open other files.
        to: how to print the answer.
        parent: number of the process that waits for the answer.
    """

    sql: str
    out: str
    partition: dict[str, str | None]
    allow_files: bool
    to: Literal["table", "csv", "json"]
    parent: int


def main() -> None:
    """Answer the request and exit: 0, or 1 with the error on stderr."""
    # Suppress the engine's messages when it crashes: only Python keeps the pipe of stderr.
    sys.stderr = report = os.fdopen(os.dup(2), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    request = msgspec.convert(json.load(sys.stdin), QueryRequest)
    end_with(request.parent)
    silence_warnings()
    threading.stack_size(STACK_BYTES)
    try:
        with ThreadPoolExecutor(1, thread_name_prefix="query") as pool:
            pool.submit(_answer, request).result()
        sys.stdout.flush()
    except SlipError as error:
        json.dump({name: vars(error)[name] for name in ("code", "what", "where", "hint")}, report)
        report.flush()
        sys.exit(FAILED)
    sys.exit(CLEAN)


def _answer(request: QueryRequest) -> None:
    from pipeline.store import Partition  # noqa: PLC0415 - heavy

    store = ResultsLocation(Path(request.out)).open_store()
    partition = Partition(**request.partition)
    _print(store.query(request.sql, partition, allow_files=request.allow_files), request.to)


def _print(answer: pl.DataFrame, form: Literal["table", "csv", "json"]) -> None:
    import polars as pl  # noqa: PLC0415 - heavy

    if form == "csv":
        _print_csv(answer)
    elif form == "json":
        _write(f'{{"columns": {json.dumps(answer.columns)}, "rows": [')
        for number, part in enumerate(answer.iter_slices(_ROWS_AT_ONCE)):
            _write("," * (number > 0) + spell_bytes(part).write_json()[1:-1])
        _write("]}\n")
    else:
        with pl.Config(tbl_rows=-1, tbl_cols=-1, fmt_str_lengths=_WIDE, tbl_width_chars=_WIDE):
            _write("".join(f"{tidy_line(line)}\n" for line in str(answer).split("\n")))


def _print_csv(answer: pl.DataFrame) -> None:
    import polars as pl  # noqa: PLC0415 - heavy

    from pipeline.core.untrusted import format_csv  # noqa: PLC0415 - heavy

    try:
        _write(format_csv(answer.clear()))
        for part in answer.iter_slices(_ROWS_AT_ONCE):
            _write(format_csv(part, header=False))
    except pl.exceptions.PolarsError as error:
        said = str(error).splitlines()[0]
        raise SlipError(
            "no_csv", f"the answer cannot be written as CSV: {said}", hint="Use --to json, or plain columns"
        ) from error


def _write(text: str) -> None:
    sys.stdout.buffer.write(text.encode())


def spell_bytes(answer: pl.DataFrame) -> pl.DataFrame:
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


if __name__ == "__main__":
    main()
