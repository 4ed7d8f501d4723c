"""Methods that stand in for SciPy's where loading it costs more than their answer."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import solveh_banded
from scipy.optimize import nnls
from scipy.special import ndtr, stdtrit

from pipeline.core.arrays import (
    _solve_banded,
    jackknife_deviation,
    normal_tail,
    solve_banded,
    solve_nonnegative,
    student_quantile,
)


@pytest.mark.parametrize("level", [0.5, 0.68, 0.9, 0.95, 0.99, 0.9999])
def test_quantiles_of_student_are_those_of_scipy(level: float) -> None:
    freedoms = [0.5, 1.0, 1.3, 2.0, 3.7, 9.0, 30.0, 99.5, 399.0, 401.0, 1e4, 1e6]
    ours = [student_quantile(level, freedom) for freedom in freedoms]
    assert np.allclose(ours, stdtrit(freedoms, (1.0 + level) / 2.0), rtol=1e-8)


def test_no_freedom_has_no_quantile_and_all_of_it_the_normal_one() -> None:
    assert math.isnan(student_quantile(0.95, 0.0))
    assert math.isnan(student_quantile(0.95, math.nan))
    assert math.isclose(student_quantile(0.95, math.inf), 1.959963984540054)


def test_the_tail_of_the_normal_distribution_is_that_of_scipy() -> None:
    deviations = np.array([-9.0, -1.0, 0.0, 0.5, 3.0, 8.0, 30.0])
    assert np.allclose(normal_tail(deviations), ndtr(-deviations), rtol=1e-12, atol=0.0)


def test_the_jackknife_of_a_mean_is_its_standard_error() -> None:
    values = np.random.default_rng(0).normal(size=30)
    without = (values.sum() - values) / (values.size - 1.0)
    assert jackknife_deviation(without) == pytest.approx(values.std(ddof=1) / math.sqrt(values.size))


@pytest.mark.parametrize("seed", range(40))
def test_non_negative_least_squares_are_those_of_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows, columns = int(rng.integers(3, 12)), int(rng.integers(1, 10))
    design = rng.random((rows, columns)) if seed % 2 else rng.normal(size=(rows, columns))
    target = rng.normal(size=rows) + design.sum(axis=1)
    ours, theirs = solve_nonnegative(design, target), nnls(design, target)[0]
    assert (ours >= 0.0).all()
    left = np.linalg.norm(design @ ours - target) - np.linalg.norm(design @ theirs - target)
    assert abs(left) < 1e-9
    if columns <= rows:
        assert np.allclose(ours, theirs, atol=1e-8)


def test_a_target_that_no_number_comes_nearer_to_gives_zeros() -> None:
    assert solve_nonnegative(np.ones((4, 2)), -np.ones(4)).tolist() == [0.0, 0.0]


@pytest.mark.parametrize(("count", "width"), [(1, 1), (2, 2), (3, 2), (5, 10), (500, 2), (500, 10)])
def test_banded_systems_are_solved_as_by_scipy(count: int, width: int) -> None:
    rng = np.random.default_rng(count)
    matrix, right = np.zeros((width, count)), rng.normal(size=count)
    for lag in range(1, min(width, count)):
        matrix[lag, lag:] = rng.normal(size=count - lag)
    matrix[0] = 2.0 * width + 20.0
    upper = matrix[::-1]
    theirs = solveh_banded(upper[-min(width, count) :], right)
    assert np.allclose(solve_banded(matrix, right), theirs, rtol=1e-10, atol=1e-14)


def test_an_empty_system_writes_no_memory() -> None:
    around = np.ones(3)
    for inside in (around[1:1], np.empty(0)):
        _solve_banded(inside.reshape(0, 2), inside)
    assert around.tolist() == [1.0, 1.0, 1.0]
    assert solve_banded(np.ones((1, 1)), np.array([2.0])).tolist() == [2.0]
