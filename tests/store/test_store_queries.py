"""Tables over all runs: lazily, in SQL, across versions of a contract; tables of the whole results."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from polars.testing import assert_frame_equal
from store_samples import break_windows, make_slip, make_windows, write_generation

from pipeline.store import Store, StoreError
from pipeline.store.checksums import decode_checked, encode_checked, encode_manifest
from pipeline.store.files import MANIFEST
from pipeline.store.parquet_tables import check_table, schema_of
from schemas import list_contracts


def test_no_runs_give_the_columns_of_the_contract(store: Store) -> None:
    for contract in list_contracts():
        name = contract.name  # type: ignore[attr-defined]
        assert store.scan(name).collect().equals(schema_of(name).to_frame())
        sql = f"SELECT count(*) AS n FROM {name}"  # noqa: S608 - the name is one of ours
        assert store.query(sql)["n"].to_list() == [0]


def test_scan_sees_the_current_generation_of_every_run(store: Store) -> None:
    write_generation(store, "a", "k", 1)
    write_generation(store, "a", "l", 2)
    write_generation(store, "folder/b", "k", 3)
    with store.open_generation("empty", "k") as generation:
        generation.commit({})
    expected = pl.concat([make_slip("a", 2), make_slip("folder/b", 3)])
    assert_frame_equal(store.scan("slip").collect(), expected)
    assert store.scan("quarantine_windows").collect()["run"].to_list() == ["a"] * 2 + ["folder/b"] * 2


def test_scan_of_an_unknown_table_names_those_there_are(store: Store) -> None:
    with pytest.raises(StoreError, match=r"'speeds'.*velocities"):
        store.scan("speeds")


def test_query_joins_tables(store: Store) -> None:
    write_generation(store, "a", "k", 1)
    write_generation(store, "b", "k", 2)
    found = store.query(
        "SELECT s.run, count(*) AS n FROM slip s JOIN (SELECT DISTINCT run, step FROM windows) w "
        "ON s.run = w.run AND s.step = w.step GROUP BY s.run ORDER BY s.run"
    )
    assert found.rows() == [("a", 500), ("b", 500)]


@pytest.mark.parametrize("sql", ["SELECT", "SELECT * FROM speeds", "SELECT speed FROM slip"])
def test_query_that_cannot_be_answered_says_so(store: Store, sql: str) -> None:
    write_generation(store, "a", "k", 1)
    with pytest.raises(StoreError) as caught:
        store.query(sql)
    assert caught.value.code == "bad_query"
    assert "\n" not in str(caught.value)


def test_query_over_a_file_that_is_gone_says_how_it_is_made_again(store: Store) -> None:
    manifest = write_generation(store, "a", "k", 1)
    manifest.path("slip").unlink()
    with pytest.raises(StoreError, match=r"slip results verify --repair") as caught:
        store.query("SELECT count(*) FROM slip")
    assert (caught.value.code, caught.value.where) == ("file_missing", str(manifest.folder / "slip.parquet"))


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


@pytest.mark.parametrize("admits", [False, True], ids=["manifest is old", "manifest says so too"])
def test_a_small_file_of_endless_rows_is_not_read(*, admits: bool, store: Store) -> None:
    manifest = write_generation(store, "a", "k", 1)
    path, rows = manifest.path("windows"), 4 << 20
    inflate(path, rows)
    assert path.stat().st_size < rows / 4
    if admits:
        entry = replace(manifest.tables["windows"], rows=rows)
        (manifest.folder.parent / MANIFEST).write_bytes(
            encode_manifest(replace(manifest, tables={"windows": entry}))
        )
    for read in (
        lambda: store.query("SELECT sum(samples) AS n FROM windows"),
        lambda: store.read("a", "windows"),
        lambda: store.scan("windows"),
    ):
        with pytest.raises(StoreError, match=rf"{rows} rows.*--force") as caught:
            read()
        assert caught.value.code == "table_damaged"


@pytest.mark.parametrize(
    "sql", ["DROP TABLE slip", "-- SELECT\n drop table slip", "SHOW TABLES", "SELECTED", ""]
)
def test_what_is_no_question_is_refused_and_removes_no_results(store: Store, sql: str) -> None:
    write_generation(store, "a", "k", 1)
    with pytest.raises(StoreError, match="does not begin with SELECT or WITH") as caught:
        store.query(sql)
    assert caught.value.code == "bad_query"
    for asked in (
        "select 500",
        "(/* all\n */ SELECT 500 UNION SELECT 500)",
        "-- how\nWITH a AS (SELECT 500) SELECT * FROM a",
    ):
        assert store.query(asked).rows() == [(500,)]
    assert store.scan("slip").collect().height == 500


def test_tables_of_an_older_contract_are_fitted(store: Store) -> None:
    manifest = write_generation(store, "old", "k", 1)
    write_generation(store, "new", "k", 2)
    older = manifest.read("windows").drop("samples").with_columns(gone=1, segment=pl.lit(3, pl.Int64))
    older.write_parquet(manifest.path("windows"))
    path = manifest.folder.parent / "manifest.json"
    content: Any = decode_checked(path.read_bytes())
    content["tables"]["windows"]["contract_version"] = 0
    path.write_bytes(encode_checked(content))

    found = store.scan("windows").collect()
    assert found.schema == schema_of("windows")
    old = found.filter(pl.col("run") == "old")
    assert old["samples"].null_count() == old.height == manifest.tables["windows"].rows
    assert old["segment"].unique().to_list() == [3]
    assert found.filter(pl.col("run") == "new")["samples"].unique().to_list() == [40]


def test_table_of_the_whole_results_is_replaced(store: Store) -> None:
    first = break_windows(make_windows("*", 1, rows=6))
    report = store.write_results_table("windows", first)
    assert (report.rows, report.quarantined) == (4, 2)
    assert store.scan("windows").collect().height == 4
    assert store.scan("quarantine_windows").collect().height == 2

    second = make_windows("*", 2, rows=8)
    store.write_results_table("windows", second)
    assert (store.root / "windows.parquet").read_bytes() == check_table("windows", second).encode()[0]
    assert_frame_equal(store.scan("windows").collect(), second)
    assert {path.name for path in store.root.iterdir()} == {
        "windows.parquet",
        ".lock",
    }


def test_text_of_the_whole_results_is_replaced(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    path = store.write_results_text("comparison.html", "é")
    assert path == store.root / "comparison.html"
    assert path.read_bytes() == "é".encode()

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", refuse)
        with pytest.raises(StoreError) as caught:
            store.write_results_text("comparison.html", "new")
    assert caught.value.code == "disk_full"
    assert path.read_text() == "é"
    assert {path.name for path in store.root.iterdir()} == {
        "comparison.html",
        ".lock",
    }
    with pytest.raises(StoreError):
        store.write_results_text("../comparison.html", "")


def test_leftovers_of_killed_writers_are_removed(store: Store, tmp_path: Path) -> None:
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / ".tmp-1-dead").write_bytes(b"half")
    store.write_results_text("map.html", "map")
    assert {path.name for path in store.root.iterdir()} == {"map.html", ".lock"}
