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


def test_a_speed_that_rests_on_poses_of_one_side_is_not_drawn_and_stays_in_the_tables() -> None:
    report = make_report(duration_s=200.0)
    t, segment = pl.col("t"), "segment"
    to_end = pl.min_horizontal(t - t.min().over(segment), t.max().over(segment) - t)
    spiked = {
        name: report.tables[name].with_columns(
            pl.when(to_end < 0.3).then(40.0).otherwise(column).alias(column)
        )
        for name, column in (("velocities", "v_x"), ("slip", "modulus"))
    }
    scene = Scene(RunReport(report.summary, {**report.tables, **spiked}, report.diagnosis, report.motion))
    lines, modulus, track = scene.component_lines("x"), scene.modulus_lines, scene.track
    assert lines is not None
    assert modulus is not None
    assert track is not None
    assert spiked["velocities"]["v_x"].max() == 40.0
    for drawn in (lines.frame["value"], modulus.frame["value"], track.frame["modulus"]):
        assert drawn.count() > 100
        assert drawn.max() < 20.0  # type: ignore[operator]
    text = render_report(
        RunReport(report.summary, {**report.tables, **spiked}, report.diagnosis, report.motion)
    )
    assert "40.00 m/s" not in text
    assert "nearer than 0.38 s to a gap of the poses are not drawn" in text
