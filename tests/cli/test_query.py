"""`slip results query`: the answer as a table, CSV or JSON, and one line for what cannot be answered."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import polars as pl
import pytest
from verbs import run_slip

from pipeline.cli import verbs_results
from pipeline.core import python_command
from pipeline.store import Store
from pipeline.store.parquet_tables import schema_of


def ask(out: Path, sql: str, *options: str) -> tuple[int, str, str]:
    return run_slip("results", "query", sql, "--results", out, *options)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    store = Store(tmp_path_factory.mktemp("query") / "results")
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


def test_a_query_reads_also_other_files(out: Path, tmp_path: Path) -> None:
    (tmp_path / "grip.csv").write_text("run,grip\na,0.5\n")
    other = f"read_csv('{tmp_path}/grip.csv') AS other"
    sql = f"SELECT DISTINCT run, grip FROM windows JOIN {other} USING (run)"  # noqa: S608
    assert ask(out, sql, "--to", "csv") == (0, "run,grip\na,0.5\n", "")
    code, said, err = ask(out, f"SELECT * FROM read_csv('{tmp_path}/nowhere.csv')")  # noqa: S608
    assert (code, said, len(err.splitlines())) == (1, "", 1)
    assert f"No such file or directory (os error 2): {tmp_path}/nowhere.csv" in err


def test_json_is_json_whatever_comes_out(out: Path) -> None:
    for sql, columns, row in [
        ('SELECT 1 AS "a""b"', ['a"b'], {'a"b': 1}),
        ('SELECT 1 AS "a\\b", 2 AS "\n", 3 AS "é\u2028"', ["a\\b", "\n", "é\u2028"], None),
        ('SELECT 1 AS ""', [""], {"": 1}),
        ("SELECT CAST('NaN' AS DOUBLE) AS n, CAST('inf' AS DOUBLE) AS i", ["n", "i"], {"n": None, "i": None}),
        ("SELECT X'ff00' AS b", ["b"], {"b": "ff00"}),
        ("SELECT DATE '2026-01-02' AS d", ["d"], {"d": "2026-01-02"}),
        ("SELECT TIMESTAMP '2026-01-02 03:04:05' AS t", ["t"], None),
        ("SELECT INTERVAL '1 day' AS i", ["i"], None),
        ("SELECT [1, 2] AS l", ["l"], {"l": [1, 2]}),
        ("SELECT NULL AS n, TRUE AS b", ["n", "b"], {"n": None, "b": True}),
        ("SELECT CAST(1.5 AS DECIMAL(10, 2)) AS d", ["d"], None),
    ]:
        code, said, err = ask(out, sql, "--json")
        assert (code, err) == (0, "")
        answer = json.loads(said, parse_constant=pytest.fail)
        assert answer["columns"] == columns
        if row is not None:
            assert answer["rows"] == [row]


def test_bytes_in_lists_are_spelt_out() -> None:
    # Nothing of SQL gives such a column.
    frame = pl.DataFrame({"l": [[b"\xff"], None], "s": [{"x": b"\x00"}, {"x": None}], "n": [1, 2]})
    assert json.loads(verbs_results.spell_bytes(frame).write_json()) == [
        {"l": ["ff"], "s": {"x": "00"}, "n": 1},
        {"l": None, "s": {"x": None}, "n": 2},
    ]


def test_what_cannot_be_answered_is_one_line(out: Path) -> None:
    for sql in [
        "SELECT run, run FROM runs",
        "SELECT 1 AS a, 2 AS a",
        "",
        ";",
        "SELECT",
        "(" * 5000,
        "SELECT 1; SELECT 2",
    ]:
        code, said, err = ask(out, sql, "--json")
        assert code == 1
        (told,) = json.loads(said)["errors"]
        assert "the query cannot be answered" in err
        assert told["message"] in err
        assert len(err.splitlines()) == 1


@pytest.mark.parametrize(
    ("sql", "wrong", "there"),
    [
        ("SELECT * FROM speeds", "relation 'speeds' was not found", "The tables are: runs, "),
        ("SELECT speed FROM runs", 'unable to find column "speed"', 'valid columns: ["run", "dataset", '),
        (
            "SELECT r.speed FROM runs r",
            "no column named 'speed' found in table 'r'",
            "Columns of runs: run, ",
        ),
        ("SELECT w.x FROM windows w", "no column named 'x' found in table 'w'", "Columns of windows: run,"),
    ],
)
def test_an_unknown_name_is_told_with_those_there_are(sql: str, wrong: str, there: str, out: Path) -> None:
    code, said, err = ask(out, sql)
    assert (code, said, len(err.splitlines())) == (1, "", 1)
    assert f"the query cannot be answered: {wrong}" in err
    assert there in err


def test_an_answer_that_is_no_csv_is_one_line(out: Path) -> None:
    code, said, err = ask(out, "SELECT [1, 2] AS l", "--to", "csv")
    assert (code, said) == (1, "")
    assert "--to json" in err


def test_names_and_questions_that_are_no_text_are_told_as_any(out: Path, tmp_path: Path) -> None:
    odd = tmp_path / os.fsdecode(b"results\xff")
    shutil.copytree(out, odd)
    for place, sql in ((odd, "SELECT run FROM runs"), (out, os.fsdecode(b"SELECT '\xff' AS x"))):
        code, said, err = ask(place, sql)
        assert (code, said, len(err.splitlines())) == (1, "", 1)
        assert "the query cannot be answered: 'utf-8' codec can't encode" in err
    assert ask(odd, "SELECT 4 AS n", "--to", "csv") == (0, "n\n4\n", "")


def test_a_query_may_name_thousands_of_values(out: Path) -> None:
    values = ",".join(f"'{i}'" for i in range(20_000))
    sql = f"SELECT count(*) AS n FROM windows WHERE run IN ({values},'a')"  # noqa: S608
    assert ask(out, sql, "--to", "csv") == (0, "n\n4\n", "")


def test_an_answer_is_printed_in_parts(out: Path) -> None:
    """More rows than are made text at a time."""
    many = f"SELECT a0.samples FROM {', '.join(f'windows a{i}' for i in range(9))}"  # noqa: S608
    code, said, _ = ask(out, many, "--to", "csv")
    assert (code, said) == (0, "samples\n" + "40\n" * 4**9)
    code, said, _ = ask(out, many, "--json")
    assert json.loads(said) == {"columns": ["samples"], "rows": [{"samples": 40}] * 4**9}
    assert json.loads(ask(out, "SELECT run FROM windows WHERE samples = 1", "--json")[1])["rows"] == []


def test_a_reader_of_the_answer_may_leave(out: Path) -> None:
    command = python_command(
        "-m",
        "pipeline",
        "results",
        "query",
        "SELECT a.run FROM windows a, windows b",
        "--results",
        str(out),
        "--to",
        "csv",
    )
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.close()
        assert process.wait(60) == 1
        assert process.stderr is not None
        assert process.stderr.read() == b""


def test_texts_that_are_formulas_are_none_in_csv(out: Path) -> None:
    sql = 'SELECT dataset, terrain, t_start, 1 AS "=x" FROM windows LIMIT 1'
    assert ask(out, sql, "--to", "csv") == (0, "dataset,terrain,t_start,'=x\n'=d,'-ice,-1.5,1\n", "")
