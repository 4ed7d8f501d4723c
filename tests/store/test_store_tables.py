"""What is in the Parquet files: the same frame, units and frames, the same bytes; broken rows kept apart."""

import datetime as dt
import subprocess
import sys
from decimal import Decimal
from pathlib import Path

import dataframely as dy
import polars as pl
import pyarrow.parquet as pq
import pytest
from store_samples import break_windows, make_slip, make_windows

from pipeline.store import Store, StoreError
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


def test_broken_rows_go_to_the_quarantine_with_the_names_of_the_rules(store: Store) -> None:
    frame = break_windows(make_windows("r", 1, rows=6))
    with store.open_generation("r", "k") as generation:
        report = generation.write_table("windows", frame)
        manifest = generation.commit({})
    assert (report.rows, report.quarantined) == (4, 2)
    assert set(report.rules) == {"terrain|nullability", "segment|min", "t_end|check"} | {
        rule for rule in report.rules if rule.startswith("t_end|")
    }
    assert store.read("r", "windows").equals(frame.filter(pl.int_range(pl.len()).is_in([0, 2, 4, 5])))

    entry = manifest.tables["windows"]
    assert (entry.rows, entry.quarantined, entry.rules) == (4, 2, report.rules)
    broken = store.read("r", "quarantine_windows")
    assert broken.drop("broken_rules").equals(frame.filter(pl.int_range(pl.len()).is_in([1, 3])))
    assert broken["broken_rules"].to_list()[0] == ["terrain|nullability"]
    assert {"segment|min", "t_end|check"} <= set(broken["broken_rules"].to_list()[1])
    assert pq.read_schema(manifest.path("quarantine_windows")).field("t_end").metadata[b"unit"] == b"s"


def test_rows_that_are_all_broken_leave_an_empty_table(store: Store) -> None:
    frame = make_windows("r", 1, rows=4).with_columns(samples=pl.lit(0, pl.Int32))
    with store.open_generation("r", "k") as generation:
        assert generation.write_table("windows", frame).rules == {"samples|min": 4}
        generation.commit({})
    assert store.read("r", "windows").equals(frame.clear())


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


def test_unknown_table_names_those_there_are() -> None:
    with pytest.raises(StoreError, match="velocities"):
        schema_of("velocity")
