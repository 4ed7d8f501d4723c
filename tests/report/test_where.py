from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from report_synthesis import make_report

from pipeline.report import RunReport, render_report
from pipeline.report.scene import Scene
from pipeline.report.sections.where import find_regions

VERBS = ("Turning", "Driving")


def make_slip(modulus: np.ndarray, *, f_x: np.ndarray, f_w: np.ndarray) -> pl.DataFrame:
    return pl.DataFrame({"modulus": modulus, "f_x": f_x, "f_w": f_w}).with_columns(
        transitory=pl.lit(value=False)
    )


def test_slip_in_fast_turns_is_told_as_such() -> None:
    rng = np.random.default_rng(3)
    f_w = rng.uniform(-2.0, 2.0, 5000)
    turning = np.abs(f_w) > 1.5
    slip = make_slip(np.where(turning, 2.0, 0.1), f_x=np.full(5000, 1.0), f_w=f_w)
    regions = find_regions(slip, VERBS)
    words, share, time = regions[0]
    assert words in {"Turning faster than 1.4 rad/s", "Turning faster than 1.5 rad/s"}
    assert share > 0.95
    assert time == pytest.approx(turning.mean(), abs=0.06)


def test_slip_that_is_the_same_everywhere_has_no_place() -> None:
    rng = np.random.default_rng(4)
    slip = make_slip(np.ones(5000), f_x=rng.uniform(-1, 1, 5000), f_w=rng.uniform(-2, 2, 5000))
    assert find_regions(slip, VERBS) == []
    assert find_regions(slip.with_columns(modulus=pl.lit(0.0)), VERBS) == []
    assert find_regions(None, VERBS) == []


def test_suspect_stretches_carry_no_region() -> None:
    report = make_report(duration_s=60.0)
    told = render_report(report).split('class="regions"')[1].split("</ul>")[0]
    wild = pl.when(pl.col("suspect")).then(pl.col("modulus") + 1e3).otherwise(pl.col("modulus"))
    tables = {**report.tables, "slip": report.tables["slip"].with_columns(modulus=wild)}
    page = render_report(RunReport(report.summary, tables))
    assert page.split('class="regions"')[1].split("</ul>")[0] == told


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
