"""Quantiles and standard errors."""

import math

import numpy as np
import pytest

from pipeline.core.arrays import bound_median, jackknife_deviation, student_quantile


def test_no_freedom_has_no_quantile_and_all_of_it_the_normal_one() -> None:
    assert math.isnan(student_quantile(0.95, 0.0))
    assert math.isnan(student_quantile(0.95, math.nan))
    assert math.isclose(student_quantile(0.95, math.inf), 1.959963984540054)
    assert math.isclose(student_quantile(0.95, 10.0), 2.228139, rel_tol=1e-6)


def test_the_jackknife_of_a_mean_is_its_standard_error() -> None:
    values = np.random.default_rng(0).normal(size=30)
    without = (values.sum() - values) / (values.size - 1.0)
    assert jackknife_deviation(without) == pytest.approx(values.std(ddof=1) / math.sqrt(values.size))


def test_the_interval_of_a_median_is_that_of_other_stretches_of_driving() -> None:
    random = np.random.default_rng(3)
    times = np.arange(0.0, 300.0, 0.05)
    held = 0
    for _ in range(40):
        # Slip that lasts: within a stretch of ten seconds all samples are about the same.
        values = np.repeat(random.normal(1.0, 0.3, 30), 200) + random.normal(0.0, 0.01, 6000)
        low, high = bound_median(values, times) or (np.nan, np.nan)
        held += low <= 1.0 <= high
    assert held >= 34  # of 40; as if samples were independent it is 3
    assert bound_median(values[:300], times[:300]) is None
    assert bound_median(values[:0], times[:0]) is None
