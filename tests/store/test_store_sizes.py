"""What a table inflates to is bounded before a row of it is handed out, however few bytes hold it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipeline.store import StoreError, check_size

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
