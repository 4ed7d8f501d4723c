"""What a table inflates to is bounded before a row of it is handed out, however few bytes hold it."""

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipeline.store import StoreError, check_size

LONG = "x" * 4_000_000


def write(path: Path, column: pa.Array, *, groups: int = 1, dictionary: bool = True) -> int:
    """A table of one column, several times; its number of rows."""
    table = pa.table({"text": column})
    page = 1 << 30
    with pq.ParquetWriter(
        path, table.schema, compression="zstd", use_dictionary=dictionary, dictionary_pagesize_limit=page
    ) as writer:
        for _ in range(groups):
            writer.write_table(table)
    return groups * table.num_rows


def repeat_text(path: Path) -> int:
    return write(path, pa.array([LONG] * 50), groups=20)


def write_plainly(path: Path) -> int:
    return write(path, pa.array([LONG] * 50), groups=2, dictionary=False)


def list_texts(path: Path) -> int:
    return write(path, pa.array([[LONG] * 100] * 20))


def nest_texts(path: Path) -> int:
    return write(path, pa.array([{"a": [{"b": LONG}] * 100}] * 20))


def list_numbers(path: Path) -> int:
    return write(path, pa.array([[0.0] * 1_000_000] * 20))


@pytest.mark.parametrize("make", [repeat_text, write_plainly, list_texts, nest_texts, list_numbers])
def test_a_small_file_of_large_columns_is_refused_in_little_memory(
    tmp_path: Path, make: Callable[[Path], int]
) -> None:
    path = tmp_path / "findings.parquet"
    rows = make(path)
    assert path.stat().st_size < 200_000
    before = pa.total_allocated_bytes()
    tracemalloc.start()
    with pytest.raises(StoreError, match=f"its {rows} rows inflate to more than") as caught:
        check_size(path, rows)
    assert tracemalloc.get_traced_memory()[1] < 1e7
    tracemalloc.stop()
    assert caught.value.code == "table_damaged"
    assert pa.total_allocated_bytes() - before < 1e7


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
