import base64
import json
from typing import Any

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from report_synthesis import Floats, make_report

from pipeline.report.figures.signal_figures import break_holes, pack_signals, thin_to_ends, view_signals
from pipeline.report.scene import (
    RunReport,
    Scene,
    break_lines,
    drop_flat_rows,
    find_spans,
    thin_series,
    thin_to_peaks,
)


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


def read_packed(packed: dict[str, Any], name: str) -> tuple[Floats, Floats]:
    """Times [s] and values, as the script of the page reads them."""
    numbers = {
        key: np.frombuffer(base64.b64decode(text), dtype=kind).astype(np.float64)
        for key, text, kind in (
            ("t", packed["t"], "<i4"),
            ("value", packed["columns"][name]["values"], "<i2"),
        )
    }
    column = packed["columns"][name]
    values = np.where(numbers["value"] < 0.0, np.nan, column["low"] + column["step"] * numbers["value"])
    return numbers["t"] / 1e3, values


def test_packed_signals_keep_every_peak_and_a_long_run_takes_no_more_room() -> None:
    sizes = []
    for duration_s in (60.0, 3000.0):
        report = make_report(duration_s=duration_s)
        slip = report.tables["slip"]
        peak = pl.when(pl.int_range(pl.len()) == 17).then(9.0).otherwise(pl.col("g_x"))
        slip = slip.with_columns(g_x=peak)
        scene = Scene(RunReport(report.summary, {**report.tables, "slip": slip}))
        view = view_signals(scene)
        packed: dict[str, Any] = view["packed"]  # type: ignore[assignment]
        t, values = read_packed(packed["slip from commands"], "g_x")
        whole = slip.filter(pl.col("input") == "command").sort("t")
        assert np.nanmax(values) == pytest.approx(9.0)
        assert t.size <= max(3000, whole.height if whole.height <= 3000 else 0)
        near = t[np.nanargmax(values)] - float(whole["t"][17])
        assert abs(near) <= 3.0 * duration_s / 3000.0 + 0.06
        if whole.height <= 3000:
            np.testing.assert_allclose(values, whole["g_x"].to_numpy(), atol=1e-3)
            np.testing.assert_allclose(t, whole["t"].to_numpy(), atol=6e-4)
        assert set(packed) == set(view["tables"])  # type: ignore[call-overload]
        sizes.append(len(json.dumps(packed)))
    assert max(sizes) < 500_000


def test_missing_values_of_a_signal_break_its_line() -> None:
    gaps = pl.DataFrame({"t": [0.0, 0.1, 0.2, 5.0, 5.1], "a": [1.0, None, 2.0, 3.0, 1.0]})
    t, values = read_packed(pack_signals(gaps), "a")
    np.testing.assert_allclose(t, gaps["t"].to_numpy())
    np.testing.assert_allclose(values, gaps["a"].to_numpy(), atol=1e-3)
    drawn = break_holes(gaps.select("t", value="a"))
    assert drawn["value"].to_list() == [1.0, None, 2.0, None, 3.0, 1.0]


def test_of_a_group_of_rows_lowest_and_highest_remain_in_their_order() -> None:
    values = [3.0, 1.0, 2.0, None, None, None, 5.0]
    frame = pl.DataFrame({"t": np.arange(7.0), "a": values})
    assert thin_to_ends(frame, 7).equals(frame)
    thinned = thin_to_ends(frame, 5)
    assert thinned["a"].to_list() == [3.0, 1.0, None, None, 5.0, 5.0]
    assert thinned["t"].to_list() == [0.0, 1.0, 3.0, 4.0, 6.0, 6.0]
