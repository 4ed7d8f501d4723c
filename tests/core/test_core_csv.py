"""CSV that no spreadsheet runs."""

import io
from pathlib import Path

import polars as pl
import pytest

import pipeline
from pipeline.core.untrusted import format_csv

TEXTS = ["=1+1", "+1", "-x", "@x", "\tx", "\rx", "\nx", "\uff1d1", "'=1", "''=1"]
PLAIN = ["", "a=b", "'x", "x-y", " =1", None]


@pytest.mark.parametrize(
    "kind", [pl.String(), pl.Categorical(), pl.Enum(TEXTS)], ids=["text", "category", "enum"]
)
def test_texts_that_are_formulas_get_a_quote(kind: pl.DataType) -> None:
    frame = pl.DataFrame({"a": pl.Series(TEXTS).cast(kind), "-n": -1.5})
    found = pl.read_csv(io.StringIO(format_csv(frame)), infer_schema=False)
    assert found["a"].to_list() == [f"'{text}" for text in TEXTS]
    assert found["'-n"].unique().to_list() == ["-1.5"]
    assert found["a"].str.slice(1).to_list() == TEXTS


def test_other_texts_and_all_numbers_stay() -> None:
    frame = pl.DataFrame({"a": PLAIN, "n": -1, "x": -1.5, "t": "x"})
    assert format_csv(frame) == frame.write_csv()
    assert format_csv(frame.clear()) == "a,n,x,t\n"


def test_tables_of_comparisons_hold_no_formula() -> None:
    frame = pl.DataFrame({"dataset": ["=cmd"], "terrain": ["@ice"], "median": [-0.123456789]})
    assert format_csv(frame, digits=6) == "dataset,terrain,median\n'=cmd,'@ice,-0.123457\n"
    small = pl.DataFrame({"p": [2.7182818e-10, 0.0, None], "n": [123456789.0, 1.0, 2.0]})
    assert format_csv(small, digits=6) == "p,n\n2.71828e-10,123457000.0\n0.0,1.0\n,2.0\n"


def test_one_function_writes_all_csv() -> None:
    room = Path(pipeline.__file__).parent
    found = [
        path
        for path in room.rglob("*.py")
        for _ in range(path.read_text(encoding="utf-8").count(".write_csv("))
    ]
    assert found == [room / "core" / "untrusted.py"]
