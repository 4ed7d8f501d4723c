import numpy as np
import polars as pl
import pytest
from report_synthesis import make_report

from pipeline.report.page import render_report
from pipeline.report.scene import RunReport, Scene


def test_the_worst_stretch_is_where_most_slip_is_and_keeps_every_point() -> None:
    report = make_report(duration_s=200.0)
    slip = report.tables["slip"]
    more = (
        pl.when(pl.col("t").is_between(130.0, 150.0))
        .then(3.0 * pl.col("modulus"))
        .otherwise(pl.col("modulus"))
    )
    tables = {**report.tables, "slip": slip.with_columns(modulus=more)}
    scene = Scene(RunReport(report.summary, tables))
    span = scene.worst_span
    assert span is not None
    assert span == pytest.approx((130.0, 150.0), abs=3.0)
    assert Scene(make_report(duration_s=25.0)).worst_span is None
    drawn = scene.component_lines("x")
    assert drawn is not None
    measured = drawn.frame.filter((pl.col("series") == "velocity") & pl.col("t").is_between(*span))
    assert measured.height == tables["velocities"].filter(pl.col("t").is_between(*span)).height


def test_a_map_far_from_its_origin_counts_from_the_start() -> None:
    report = make_report(duration_s=20.0)
    assert Scene(report).origin == (0.0, 0.0)
    far = report.tables["velocities"].with_columns(x=pl.col("x") + 332_100.4, y=pl.col("y") + 5_181_200.0)
    moved = RunReport(report.summary, {**report.tables, "velocities": far})
    near, shifted = Scene(report).track, Scene(moved).track
    assert near is not None
    assert shifted is not None
    np.testing.assert_allclose(shifted.frame["x"] - 0.4, near.frame["x"], atol=1e-6)
    assert "less 5,181,200 m" in render_report(moved)
    assert '"domain":[33' not in render_report(moved)
