"""`slip results query`: the tables of the results and nothing else; JSON whatever comes out."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import polars as pl
import pytest

from pipeline.cli import main, query_process
from pipeline.store import Store

if TYPE_CHECKING:
    from pathlib import Path


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as caught:
        main([str(argument) for argument in arguments])
    seen = capsys.readouterr()
    assert isinstance(caught.value.code, int)
    return caught.value.code, seen.out, seen.err


@pytest.fixture
def answered_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is asked, and not in which process, is the question: starting one takes most of the time."""
    monkeypatch.setattr(
        "pipeline.cli.verbs_results._answer_apart",
        lambda request, *_: query_process._answer(request),
    )


@pytest.fixture
def out(tmp_path: Path) -> Path:
    folder = tmp_path / "results"
    Store(folder).write_results_text("index.html", "x")
    frame = pl.DataFrame({"password": ["secret"]})
    frame.write_csv(tmp_path / "other.csv")
    frame.write_parquet(tmp_path / "other.parquet")
    frame.write_ipc(tmp_path / "other.ipc")
    frame.write_json(tmp_path / "other.json")
    frame.write_ndjson(tmp_path / "other.ndjson")
    return folder


READERS = [
    "read_csv('{}/other.csv')",
    "READ_CSV('{}/other.csv')",
    "\"read_csv\"('{}/other.csv')",
    "`read_parquet`('{}/other.parquet')",
    "read_parquet/* a word between */('{}/other.parquet')",
    "read_ipc\n('{}/other.ipc')",
    "read_json('{}/other.json')",
    "read_ndjson('{}/other.ndjson')",
    "read_parquet('s3://bucket/x.parquet')",
    "read_csv('http://127.0.0.1:9/x.csv')",
    "(SELECT * FROM read_csv('{}/other.csv')) AS a",
    "runs UNION ALL SELECT * FROM read_csv('{}/other.csv')",
    "scan_parquet('{}/other.parquet')",
    "read_something_new('{}/other.parquet')",
    "'{}/other.csv'",
    '"{}/other.parquet"',
]


@pytest.mark.usefixtures("answered_here")
@pytest.mark.parametrize("reader", READERS)
def test_no_other_file_is_opened(
    reader: str, capsys: pytest.CaptureFixture[str], out: Path, tmp_path: Path
) -> None:
    sql = f"SELECT * FROM {reader.format(tmp_path)}"  # noqa: S608
    code, said, err = run(capsys, "results", "query", sql, "--out", out)
    assert (code, said) == (1, "")
    assert len(err.splitlines()) == 1
    assert "secret" not in err


def test_files_are_opened_where_somebody_allows_it(
    capsys: pytest.CaptureFixture[str], out: Path, tmp_path: Path
) -> None:
    sql = f"SELECT * FROM read_csv('{tmp_path}/other.csv')"  # noqa: S608
    refused = run(capsys, "results", "query", sql, "--out", out)[2]
    assert "--allow-files" in refused
    code, said, _ = run(capsys, "results", "query", sql, "--out", out, "--allow-files", "--to", "csv")
    assert (code, said) == (0, "password\nsecret\n")


@pytest.mark.usefixtures("answered_here")
@pytest.mark.parametrize(
    ("sql", "columns", "row"),
    [
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
    ],
)
def test_json_is_json_whatever_comes_out(
    sql: str, columns: list[str], row: object, capsys: pytest.CaptureFixture[str], out: Path
) -> None:
    code, said, err = run(capsys, "results", "query", sql, "--out", out, "--json")
    assert (code, err) == (0, "")
    answer = json.loads(said, parse_constant=pytest.fail)
    assert answer["columns"] == columns
    if row is not None:
        assert answer["rows"] == [row]


def test_bytes_in_lists_are_spelt_out() -> None:
    # Nothing of SQL gives such a column.
    frame = pl.DataFrame({"l": [[b"\xff"], None], "s": [{"x": b"\x00"}, {"x": None}], "n": [1, 2]})
    assert json.loads(query_process.spell_bytes(frame).write_json()) == [
        {"l": ["ff"], "s": {"x": "00"}, "n": 1},
        {"l": None, "s": {"x": None}, "n": 2},
    ]


@pytest.mark.usefixtures("answered_here")
@pytest.mark.parametrize(
    "sql",
    [
        "SELECT run, run FROM runs",
        "SELECT 1 AS a, 2 AS a",
        "",
        ";",
        "SELECT",
        "(" * 5000,
        "SELECT 1; SELECT 2",
    ],
)
def test_what_cannot_be_answered_is_one_line(sql: str, capsys: pytest.CaptureFixture[str], out: Path) -> None:
    code, said, err = run(capsys, "results", "query", sql, "--out", out, "--json")
    assert code == 1
    (told,) = json.loads(said)["errors"]
    assert "the query cannot be answered" in err
    assert told["message"] in err
    assert len(err.splitlines()) == 1


def test_an_answer_that_is_no_csv_is_one_line(capsys: pytest.CaptureFixture[str], out: Path) -> None:
    code, said, err = run(capsys, "results", "query", "SELECT [1, 2] AS l", "--out", out, "--to", "csv")
    assert (code, said) == (1, "")
    assert "--to json" in err
