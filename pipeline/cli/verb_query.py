"""`slip query`: SQL over the tables of all runs."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import threading
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter
from cyclopts.types import PositiveFloat

from pipeline.cli.memory_limit import choose_limit, out_of_memory
from pipeline.cli.output import CLEAN
from pipeline.cli.results_place import open_results
from pipeline.core.errors import SlipError, shorten
from pipeline.core.interpreter import THREAD_VARIABLES, python_command

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.cli.query_process import QueryRequest

_HINT = "Ask for less at once"


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
    timeout: PositiveFloat = 1800.0,
    memory: str | None = None,
    as_json: Annotated[bool, Parameter(name="--json", negative=())] = False,
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
        timeout: longest time for the answer [s].
        memory: most memory, for example 2GB (default: 80 % of the machine's).
        as_json: print one JSON object: columns and rows.
    """
    from pipeline.cli.query_process import QueryRequest  # noqa: PLC0415 - only for this verb

    partition = {"vehicle": vehicle, "terrain": terrain, "dataset": dataset, "day": day}
    request = QueryRequest(
        sql=sql,
        out=str(_fetch_results(out, sql, partition)),
        partition=partition,
        allow_files=allow_files,
        to="json" if as_json else to,
        parent=os.getpid(),
    )
    _answer_apart(request, timeout, choose_limit(memory))
    return CLEAN


def _fetch_results(out: Path, sql: str, partition: Mapping[str, str | None]) -> Path:
    """The folder of results, or that of their mirror with the tables that a query names."""
    place = open_results(out)
    if place.mirror is not None:
        from pipeline.store import Partition  # noqa: PLC0415 - only for results on an object store

        wanted = Partition(**partition)
        words = re.findall(r"\w+", sql.lower())
        place.mirror.pull_tables(words, filter(wanted.holds, place.open_store().manifests()))
    return place.root


def _answer_apart(request: QueryRequest, timeout_s: float, memory_bytes: int) -> None:
    """Have a process of its own answer, and print what it prints.

    Raises:
        SlipError: the error that it tells; ``timed_out``, ``out_of_memory`` or ``query_died``.
    """
    from pipeline.batch.memory import MemoryWatchdog  # noqa: PLC0415 - only for this verb
    from pipeline.cli.query_process import STACK_BYTES  # noqa: PLC0415 - only for this verb

    pinned = {**dict.fromkeys(THREAD_VARIABLES, "1"), "RUST_MIN_STACK": str(STACK_BYTES)}
    watchdog, is_late = MemoryWatchdog(memory_bytes), threading.Event()
    with subprocess.Popen(  # noqa: S603 - our own words
        python_command("-m", "pipeline.cli.query_process"),
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env={**pinned, **os.environ},
    ) as process:  # fmt: skip
        assert process.stdin is not None  # noqa: S101 - for types
        assert process.stdout is not None  # noqa: S101
        assert process.stderr is not None  # noqa: S101

        def give_up() -> None:
            is_late.set()
            process.kill()

        timer = threading.Timer(min(timeout_s, threading.TIMEOUT_MAX), give_up)
        watchdog.start()
        timer.start()
        try:
            # One that is dead already tells why below.
            with suppress(BrokenPipeError):
                process.stdin.write(json.dumps(asdict(request)).encode())
                process.stdin.close()
            sys.stdout.flush()
            shutil.copyfileobj(process.stdout, sys.stdout.buffer)
            told = process.stderr.read()
            code = process.wait()
        finally:
            timer.cancel()
            process.kill()
            watchdog.stop()
    if code == CLEAN:
        return
    where = shorten(request.sql)
    held = watchdog.held_by(process.pid)
    if held is not None:
        raise out_of_memory(held, memory_bytes, where, f"Give it more with --memory, or {_HINT.lower()}")
    if is_late.is_set():
        what = f"there was no answer within {timeout_s:g} s"
        raise SlipError(
            "timed_out", what, where=where, hint=f"Give it a longer --timeout, or {_HINT.lower()}"
        )
    with suppress(ValueError):
        raise SlipError(**json.loads(told))
    how = f"signal {-code}" if code < 0 else f"exit code {code}"
    last = told.decode(errors="replace").strip().rpartition("\n")[2]
    what = f"the process that answers it has died ({how}){f': {last}' if last else ''}"
    raise SlipError(
        "query_died", what, where=where, hint=f"{_HINT}; `slip verify` tells whether tables are damaged"
    )
