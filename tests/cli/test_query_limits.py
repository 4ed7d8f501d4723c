"""`slip results query` ends with one line whatever the engine does; each query in a process of its own."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING
from unittest.mock import patch

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from verbs import run_program, run_verb

from pipeline.core import slip_command
from pipeline.store import Manifest, Store, StoreError
from pipeline.store.checksums import encode_manifest
from pipeline.store.files import MANIFEST
from pipeline.store.parquet_tables import schema_of

if TYPE_CHECKING:
    from pathlib import Path


RunSlip = Callable[..., subprocess.CompletedProcess[str]]


def ask(
    out: Path, sql: str, *options: str, run: RunSlip = run_verb, **environment: str
) -> tuple[int, str, str]:
    with patch.dict(os.environ, environment):
        done = run("results", "query", sql, "--out", out, *options)
    return done.returncode, done.stdout, done.stderr


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    store = Store(tmp_path_factory.mktemp("limits") / "results")
    schema = schema_of("windows")
    kept = {"run": "a", "dataset": "=d", "vehicle": "v", "terrain": "-ice", "input": "measured"}
    rows = pl.DataFrame(
        [{name: kept.get(name, None if kind == pl.String else 0) for name, kind in schema.items()}] * 4,
        schema_overrides={"transitory": pl.Int64},
    )
    frame = rows.with_columns(
        t_start=-2.0 * pl.int_range(pl.len()) - 1.5, t_end=pl.lit(1.0), samples=pl.lit(40)
    )
    with store.open_generation("a", "k") as generation:
        generation.write_table(
            "windows", frame.select(pl.col(name).cast(kind) for name, kind in schema.items())
        )
        generation.commit({})
    return store.root


ENDLESS = [
    "SELECT " + "+".join(["1"] * 20_001),
    " UNION ALL ".join(["SELECT 1"] * 1500),
    "SELECT " + "||".join(["run"] * 1000) + " FROM runs",  # noqa: S608
    "SELECT 1" + "::INT" * 10_000,
    "SELECT run" + " IS NULL" * 3000 + " FROM runs",
    " EXCEPT ".join(["SELECT run FROM runs"] * 1000),
    "SELECT 1 FROM " + ", ".join(f"runs a{i}" for i in range(1000)),  # noqa: S608
    "SELECT " + "(" * 41 + "1" + ")" * 41,
    "SELECT run FROM runs WHERE run IN (" + ",".join(f"'{i}'" for i in range(10_000)) + ")",  # noqa: S608
]


@pytest.mark.parametrize("sql", ENDLESS, ids=lambda sql: sql[:20])
def test_what_would_overflow_the_stack_is_refused(sql: str, out: Path) -> None:
    code, said, err = ask(out, sql)
    assert (code, said) == (1, "")
    assert len(err.splitlines()) == 1
    assert "the query cannot be answered: it has" in err
    with pytest.raises(StoreError, match="more than"):
        Store(out).query(sql)


def test_queries_of_the_allowed_length_are_answered(out: Path) -> None:
    values = ",".join(f"'{i}'" for i in range(5000))
    for sql in (
        "SELECT count(*) AS n FROM windows WHERE run IN (" + values + ",'a')",  # noqa: S608
        "SELECT sum(n) AS n FROM (" + " UNION ALL ".join(["SELECT 1 AS n"] * 4) + ")",  # noqa: S608
        "SELECT " + "+".join(["1"] * 4) + " AS n",
        "SELECT " + "(" * 40 + "4" + ")" * 40 + " AS n",
    ):
        assert ask(out, sql, "--to", "csv") == (0, "n\n4\n", "")
    sql = "SELECT " + "||".join(["run"] * 330) + " AS n FROM windows LIMIT 1"  # noqa: S608
    assert ask(out, sql, "--to", "csv") == (0, f"n\n{'a' * 330}\n", "")


def double(times: int) -> str:
    """A query whose plan has two to that power parts."""
    later = "".join(
        f", c{i} AS (SELECT run FROM c{i - 1} UNION ALL SELECT run FROM c{i - 1})"  # noqa: S608 - ours
        for i in range(1, times)
    )
    return f"WITH c0 AS (SELECT run FROM runs){later} SELECT * FROM c{times - 1}"  # noqa: S608


def cross(times: int) -> str:
    """A query with four to that power rows."""
    return f"SELECT a0.samples FROM {', '.join(f'windows a{i}' for i in range(times))}"  # noqa: S608 - ours


def test_a_query_that_fills_the_memory_is_one_line(out: Path) -> None:
    code, said, err = ask(out, cross(14), "--memory", "300MB")
    assert (code, said) == (1, "")
    assert len(err.splitlines()) == 1
    assert "more than 0.3 GB" in err
    assert "--memory" in err


def test_a_query_that_takes_too_long_is_one_line(out: Path) -> None:
    code, said, err = ask(out, double(40), "--timeout", "0.2", "--memory", "100GB")
    assert (code, said) == (1, "")
    assert len(err.splitlines()) == 1
    assert "there was no answer within 0.2 s" in err


def test_names_and_questions_that_are_no_text_are_told_as_any(out: Path, tmp_path: Path) -> None:
    odd = tmp_path / os.fsdecode(b"results\xff")
    shutil.copytree(out, odd)
    for place, sql in ((odd, "SELECT run FROM runs"), (out, os.fsdecode(b"SELECT '\xff' AS x"))):
        code, said, err = ask(place, sql)
        assert (code, said, len(err.splitlines())) == (1, "", 1)
        assert "the query cannot be answered: 'utf-8' codec can't encode" in err
    assert ask(odd, "SELECT 4 AS n", "--to", "csv") == (0, "n\n4\n", "")


@pytest.mark.parametrize("timeout", ["1e30", "inf"])
def test_a_time_beyond_all_clocks_is_no_limit(timeout: str, out: Path) -> None:
    assert ask(out, "SELECT 4 AS n", "--to", "csv", "--timeout", timeout) == (0, "n\n4\n", "")


def test_a_process_that_dies_is_one_line(out: Path, tmp_path: Path) -> None:
    """What the engine does to its process when it aborts or overflows its stack."""
    for how, words in (
        ("os.abort()", "signal 6"),
        ("os.kill(os.getpid(), 11)", "signal 11"),
        ("1 / 0", "ZeroDiv"),
    ):
        (tmp_path / "sitecustomize.py").write_text(
            "import os, sys\n"
            "if 'pipeline.cli.query_process' in sys.orig_argv:\n"
            "    import pipeline.store as results\n"
            f"    results.Store.query = lambda *_, **__: {how}\n"
        )
        code, said, err = ask(out, "SELECT 1", PYTHONPATH=str(tmp_path))
        assert (code, said) == (1, "")
        assert len(err.splitlines()) == 1
        assert "the process that answers it has died" in err
        assert words in err


def inflate(path: Path, rows: int) -> None:
    """Put a table of so many equal rows in the place of another: it takes hardly any bytes."""
    schema = pq.read_schema(path)
    one = pq.read_table(path).slice(0, 1).combine_chunks()
    piece = pa.Table.from_arrays(
        [pa.repeat(one.column(name)[0], 1 << 20) if not pa.types.is_dictionary(one.schema.field(name).type)
         else pa.DictionaryArray.from_arrays(
             pa.array(np.zeros(1 << 20, dtype=np.uint32)), one.column(name).chunk(0).dictionary)
         for name in schema.names],
        schema=schema,
    )  # fmt: skip
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:
        for _ in range(rows >> 20):
            writer.write_table(piece)


def rewrite(manifest: Manifest, rows: int) -> None:
    entry = replace(manifest.tables["windows"], rows=rows)
    path = manifest.folder.parent / MANIFEST
    path.write_bytes(encode_manifest(replace(manifest, tables={"windows": entry})))


@pytest.mark.parametrize("admits", [False, True], ids=["manifest is old", "manifest says so too"])
def test_a_small_file_of_endless_rows_is_not_read(*, admits: bool, out: Path, tmp_path: Path) -> None:
    store = Store(tmp_path / "results")
    frame = Store(out).scan("windows").collect()
    with store.open_generation("a", "k") as generation:
        generation.write_table("windows", frame)
        manifest = generation.commit({})
    path, rows = manifest.path("windows"), 4 << 20
    inflate(path, rows)
    assert path.stat().st_size < rows / 4
    if admits:
        rewrite(manifest, rows)
    code, said, err = ask(store.root, "SELECT sum(samples) AS n FROM windows")
    assert (code, said) == (1, "")
    assert f"{rows} rows" in err
    assert "--force" in err
    with pytest.raises(StoreError, match=f"{rows} rows") as caught:
        store.read("a", "windows")
    assert caught.value.code == "table_damaged"
    with pytest.raises(StoreError, match=f"{rows} rows"):
        store.scan("windows")


def test_an_answer_is_printed_in_parts(out: Path) -> None:
    """More rows than are made text at a time."""
    many = cross(9)
    code, said, _ = ask(out, many, "--to", "csv")
    assert (code, said) == (0, "samples\n" + "40\n" * 4**9)
    code, said, _ = ask(out, many, "--json")
    assert json.loads(said) == {"columns": ["samples"], "rows": [{"samples": 40}] * 4**9}
    assert json.loads(ask(out, "SELECT run FROM windows WHERE samples = 1", "--json")[1])["rows"] == []


def test_a_reader_of_the_answer_may_leave(out: Path) -> None:
    command = slip_command(
        "results", "query", "SELECT a.run FROM windows a, windows b", "--out", str(out), "--to", "csv"
    )
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.close()
        assert process.wait(60) == 1
        assert process.stderr is not None
        assert process.stderr.read() == b""


def test_texts_that_are_formulas_are_none_in_csv(out: Path) -> None:
    sql = 'SELECT dataset, terrain, t_start, 1 AS "=x" FROM windows LIMIT 1'
    assert ask(out, sql, "--to", "csv", run=run_program) == (
        0,
        "dataset,terrain,t_start,'=x\n'=d,'-ice,-1.5,1\n",
        "",
    )
