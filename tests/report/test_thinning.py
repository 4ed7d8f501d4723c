import numpy as np
import polars as pl
from hypothesis import given
from hypothesis import strategies as st

from pipeline.report.scene import break_lines, drop_flat_rows, find_spans, thin_series, thin_to_peaks


@st.composite
def lines(draw: st.DrawFn) -> pl.DataFrame:
    values = draw(st.lists(st.integers(-3, 3).map(float), min_size=2, max_size=300))
    pieces = np.cumsum(draw(st.lists(st.booleans(), min_size=len(values), max_size=len(values))))
    t = np.arange(len(values)) * 0.05
    return pl.DataFrame({"t": t, "value": values, "piece": pieces.astype(np.int32)})


@given(lines(), st.integers(1, 20))
def test_a_thinned_line_keeps_peaks_ends_and_order(line: pl.DataFrame, bins: int) -> None:
    thinned = thin_series(line, "value", bins=bins)
    assert thinned["t"].is_sorted()
    assert thinned.join(line, on=["t", "value", "piece"], how="anti").is_empty()
    for pick in (pl.col("value").min(), pl.col("value").max(), pl.col("t").min(), pl.col("t").max()):
        by_piece = [frame.group_by("piece").agg(pick).sort("piece") for frame in (thinned, line)]
        assert by_piece[0].equals(by_piece[1])


@given(lines(), st.integers(1, 20))
def test_peaks_of_every_piece_survive_on_the_map(line: pl.DataFrame, bins: int) -> None:
    thinned = thin_to_peaks(line, "value", bins=bins)
    highest = [frame.group_by("piece").agg(pl.col("value").max()).sort("piece") for frame in (thinned, line)]
    assert highest[0].equals(highest[1])


@given(lines())
def test_a_line_without_its_flat_rows_is_the_same_line(line: pl.DataFrame) -> None:
    bent = drop_flat_rows(line, "value")
    for (number,), piece in line.group_by("piece"):
        left = bent.filter(pl.col("piece") == number)
        drawn = np.interp(piece["t"].to_numpy(), left["t"].to_numpy(), left["value"].to_numpy())
        np.testing.assert_allclose(drawn, piece["value"].to_numpy(), atol=1e-12)


@given(lines())
def test_no_line_is_drawn_from_one_piece_to_the_next(line: pl.DataFrame) -> None:
    broken = break_lines(line, "value")
    assert broken.drop_nulls().equals(line.drop("piece"))
    assert broken["value"].null_count() == line["piece"].n_unique() - 1
    edges = line.filter(pl.col("piece") != pl.col("piece").shift(-1))["t"]
    assert broken.filter(pl.col("value").is_null())["t"].equals(edges)


def test_spans_end_one_period_after_their_last_row_and_never_cross_a_segment() -> None:
    rows = pl.DataFrame(
        {
            "t": [0.0, 0.1, 0.2, 0.3, 0.4, 0.5],
            "segment": [0, 0, 0, 0, 1, 1],
            "flag": [True, True, False, True, True, False],
        }
    )
    spans = find_spans(rows, "flag", period=0.1)
    assert spans.rows() == [(0.0, 0.2), (0.3, 0.4), (0.4, 0.5)]
