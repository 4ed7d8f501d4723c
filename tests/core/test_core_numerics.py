"""Quantiles, standard errors and banded systems."""

import math

import numpy as np
import pytest

from pipeline.core.arrays import jackknife_deviation, solve_banded, student_quantile


def test_no_freedom_has_no_quantile_and_all_of_it_the_normal_one() -> None:
    assert math.isnan(student_quantile(0.95, 0.0))
    assert math.isnan(student_quantile(0.95, math.nan))
    assert math.isclose(student_quantile(0.95, math.inf), 1.959963984540054)
    assert math.isclose(student_quantile(0.95, 10.0), 2.228139, rel_tol=1e-6)


def test_the_jackknife_of_a_mean_is_its_standard_error() -> None:
    values = np.random.default_rng(0).normal(size=30)
    without = (values.sum() - values) / (values.size - 1.0)
    assert jackknife_deviation(without) == pytest.approx(values.std(ddof=1) / math.sqrt(values.size))


@pytest.mark.parametrize(("count", "width"), [(1, 1), (2, 2), (3, 2), (5, 10), (500, 10)])
def test_banded_systems_are_solved_as_full_ones(count: int, width: int) -> None:
    rng = np.random.default_rng(count)
    matrix, right = np.zeros((width, count)), rng.normal(size=count)
    matrix[0] = 2.0 * width + 20.0
    full = np.diag(matrix[0])
    for lag in range(1, min(width, count)):
        matrix[lag, lag:] = rng.normal(size=count - lag)
        full += np.diag(matrix[lag, lag:], lag) + np.diag(matrix[lag, lag:], -lag)
    assert np.allclose(solve_banded(matrix, right), np.linalg.solve(full, right), rtol=1e-10, atol=1e-14)
