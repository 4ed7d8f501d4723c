"""Quantiles and standard errors."""

import math

import numpy as np
import pytest

from pipeline.core.arrays import jackknife_deviation, student_quantile


def test_no_freedom_has_no_quantile_and_all_of_it_the_normal_one() -> None:
    assert math.isnan(student_quantile(0.95, 0.0))
    assert math.isnan(student_quantile(0.95, math.nan))
    assert math.isclose(student_quantile(0.95, math.inf), 1.959963984540054)
    assert math.isclose(student_quantile(0.95, 10.0), 2.228139, rel_tol=1e-6)


def test_the_jackknife_of_a_mean_is_its_standard_error() -> None:
    values = np.random.default_rng(0).normal(size=30)
    without = (values.sum() - values) / (values.size - 1.0)
    assert jackknife_deviation(without) == pytest.approx(values.std(ddof=1) / math.sqrt(values.size))
