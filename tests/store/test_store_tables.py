"""Tables: what is in their files, and asked over all runs, lazily and in SQL, in bounded memory."""

import datetime as dt
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from decimal import Decimal
from pathlib import Path

import dataframely as dy
import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from polars.testing import assert_frame_equal
from store_samples import make_slip, make_windows, write_generation

from pipeline.store import Manifest, Store, StoreError, check_size
from pipeline.store.manifests import encode_manifest
from pipeline.store.parquet_tables import check_table, encode_parquet, schema_of
from schemas import Contract, Table, list_contracts

HERE = Path(__file__).parents[1] / "fixtures"


class Everything(Table):
    """One column of every type."""

    VERSION = 7

    flag = dy.Bool(nullable=True)
    i8 = dy.Int8(nullable=True)
    i16 = dy.Int16(nullable=True)
    i32 = dy.Int32(nullable=True)
    i64 = dy.Int64(nullable=True, metadata={"unit": "ns", "frame": "log clock"})
    u8 = dy.UInt8(nullable=True)
    u64 = dy.UInt64(nullable=True)
    f32 = dy.Float32(nullable=True)
    f64 = dy.Float64(nullable=True, metadata={"unit": "m/s"})
    text = dy.String(nullable=True)
    blob = dy.Binary(nullable=True)
    kind = dy.Enum(("ä", "b"), nullable=True)
    date = dy.Date(nullable=True)
    time = dy.Time(nullable=True)
    moment = dy.Datetime(time_zone="UTC", nullable=True)
    span = dy.Duration(nullable=True)
    money = dy.Decimal(12, 3, nullable=True)
    names = dy.List(dy.String(), nullable=True)
    pair = dy.Struct({"a": dy.Float64(nullable=True), "b": dy.List(dy.Int64())}, nullable=True)


EVERYTHING = Contract("everything", Everything.VERSION, Everything)


def make_everything() -> pl.DataFrame:
    row = {
        "run": "r", "dataset": "d", "vehicle": "v", "terrain": "é", "flag": True, "i8": -128, "i16": 1,
        "i32": -1, "i64": 2**62, "u8": 255, "u64": 2**64 - 1, "f32": 0.5, "f64": -0.0, "text": "\u2028 x",
        "blob": b"\x00\xff", "kind": "ä", "date": dt.date(2026, 1, 2), "time": dt.time(1, 2, 3, 4),
        "moment": dt.datetime(2026, 1, 2, 3, 4, 5, 6, dt.UTC), "span": dt.timedelta(microseconds=-5),
        "money": Decimal("-1.234"), "names": ["a", ""], "pair": {"a": None, "b": [1, 2]},
    }  # fmt: skip
    nothing = dict.fromkeys(row) | dict.fromkeys(("run", "dataset", "vehicle", "terrain"), "x")
    return pl.DataFrame([row, nothing, row], schema=Everything.create_empty().schema)


def test_every_type_comes_back(tmp_path: Path) -> None:
    frame = make_everything()
    path = tmp_path / "everything.parquet"
    path.write_bytes(encode_parquet(EVERYTHING, frame))
    back = pl.read_parquet(path)
    assert back.schema == frame.schema
    assert back.equals(frame)
    metadata = pq.read_schema(path).metadata
    assert (metadata[b"contract"], metadata[b"contract_version"]) == (b"everything", b"7")
    assert pq.read_schema(path).field("i64").metadata[b"frame"] == b"log clock"


def test_units_and_frames_are_in_the_file(tmp_path: Path) -> None:
    for contract in list_contracts():
        empty = contract.schema.create_empty()
        path = tmp_path / "table.parquet"
        path.write_bytes(check_table(contract.name, empty).encode()[0])
        schema = pq.read_schema(path)
        assert schema.metadata[b"contract"].decode() == contract.name
        assert int(schema.metadata[b"contract_version"]) == contract.version
        for column in empty.columns:
            metadata = schema.field(column).metadata or {}
            found = {
                key.decode(): value.decode() for key, value in metadata.items() if not key.startswith(b"_PL_")
            }
            assert found == contract.metadata_of(column)
        assert pl.read_parquet(path).schema == empty.schema


def test_same_frame_gives_same_bytes_however_it_was_put_together() -> None:
    whole = make_slip("r", 1)
    pieces = pl.concat([whole[:7], whole[7:300], whole[300:]], rechunk=False)
    shuffled = pieces.select(sorted(pieces.columns))
    assert pieces.n_chunks() == 3
    assert check_table("slip", shuffled).encode() == check_table("slip", whole).encode()


def test_same_frame_gives_same_bytes_in_another_process() -> None:
    program = (
        "from store_samples import *; from pipeline.store.files import hash_bytes;"
        "from pipeline.store.parquet_tables import check_table;"
        "table = check_table('windows', break_windows(make_windows('r', 1)));"
        "print(hash_bytes(table.encode()[0]), hash_bytes(table.encode()[1]))"
    )
    paths = f"{HERE}:{HERE.parents[1]}"
    hashes = {
        subprocess.run(
            [sys.executable, "-c", program],
            env={"PYTHONHASHSEED": seed, "PYTHONPATH": paths},
            capture_output=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    }
    assert len(hashes) == 1


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda frame: frame.drop("samples"), "column samples is missing"),
        (lambda frame: frame.with_columns(more=1), "column more is unknown"),
        (
            lambda frame: frame.with_columns(pl.col("samples").cast(pl.Int64)),
            "column samples is Int64 instead",
        ),
        (lambda frame: frame.with_columns(pl.col("input").cast(pl.String)), "column input is String instead"),
    ],
)
def test_wrong_columns_are_named(store: Store, change: object, complaint: str) -> None:
    assert callable(change)
    frame = change(make_windows("r", 1))
    with pytest.raises(StoreError, match=complaint) as caught, store.open_generation("r", "k") as generation:
        generation.write_table("windows", frame)
    assert caught.value.code == "wrong_columns"


def rewrite(manifest: Manifest) -> None:
    """Write the manifest of a run as somebody would who knows how it is made."""
    (manifest.home / "manifest.json").write_bytes(encode_manifest(manifest))


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
        rewrite(replace(manifest, tables={"windows": entry}))
    for read in (
        lambda: store.query("SELECT sum(samples) AS n FROM windows"),
        lambda: store.manifests()[0].read("windows"),
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
    entry = replace(manifest.tables["windows"], contract_version=0)
    rewrite(replace(manifest, tables={"windows": entry}))

    found = store.scan("windows").collect()
    assert found.schema == schema_of("windows")
    old = found.filter(pl.col("run") == "old")
    assert old["samples"].null_count() == old.height == manifest.tables["windows"].rows
    assert old["segment"].unique().to_list() == [3]
    assert found.filter(pl.col("run") == "new")["samples"].unique().to_list() == [40]


LONG = "x" * 4_000_000


def repeat(count: int) -> pa.DictionaryArray:
    """A long text many times, which takes the memory of one."""
    return pa.DictionaryArray.from_arrays(pa.array([0] * count, pa.int32()), pa.array([LONG]))


def list_in(rows: int, inner: pa.Array) -> pa.ListArray:
    """Entries in lists of equal lengths."""
    ends = np.linspace(0, len(inner), rows + 1).astype(np.int32)
    return pa.ListArray.from_arrays(pa.array(ends), inner)


def write(path: Path, column: pa.Array, *, groups: int = 1, dictionary: bool = True) -> int:
    """A table of one column, several times; its number of rows."""
    table = pa.table({"text": column})
    with pq.ParquetWriter(
        path,
        table.schema,
        compression="zstd",
        use_dictionary=dictionary,
        dictionary_pagesize_limit=1 << 30,
        store_schema=False,
    ) as writer:
        for _ in range(groups):
            writer.write_table(table)
    return groups * table.num_rows


def repeat_text(path: Path) -> int:
    return write(path, repeat(50), groups=20)


def write_plainly(path: Path) -> int:
    return write(path, pa.array([LONG] * 20), groups=2, dictionary=False)


def list_texts(path: Path) -> int:
    return write(path, list_in(20, repeat(2000)))


def nest_texts(path: Path) -> int:
    return write(path, list_in(20, pa.StructArray.from_arrays([repeat(2000)], ["inner"])))


def list_numbers(path: Path) -> int:
    return write(path, list_in(20, pa.array(np.zeros(20_000_000))))


@pytest.mark.parametrize("make", [repeat_text, write_plainly, list_texts, nest_texts, list_numbers])
def test_a_small_file_of_large_columns_is_refused_in_little_memory(
    tmp_path: Path, make: Callable[[Path], int]
) -> None:
    path = tmp_path / "findings.parquet"
    rows = make(path)
    assert path.stat().st_size < 200_000
    before = pa.default_memory_pool().max_memory()
    with pytest.raises(StoreError, match=f"its {rows} rows inflate to more than") as caught:
        check_size(path, rows)
    assert caught.value.code == "table_damaged"
    assert pa.default_memory_pool().max_memory() - before < 5e7


@pytest.mark.parametrize(
    "column",
    [
        ["a vehicle of a season, by its whole name", "another"] * 350_000,
        [["first_rule", "second_rule"]] * 100_000,
        [None, "x"] * 5000,
        ["x" * 1000 + str(number) for number in range(2000)],
    ],
    ids=["names", "rules", "nulls", "sentences"],
)
def test_texts_beside_numbers_are_read(tmp_path: Path, column: list[object]) -> None:
    path = tmp_path / "slip.parquet"
    numbers = np.random.default_rng(1).normal(size=len(column))
    pq.write_table(pa.table({"text": pa.array(column), "number": numbers}), path, compression="zstd")
    check_size(path, len(column))
