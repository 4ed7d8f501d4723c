"""Time grids, and the derivative that every velocity comes from."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core import arrays
from pipeline.recording.drive import interpolate_repeats
from pipeline.stages.velocity import make_grid

WINDOW_S = 0.75


@given(st.floats(-10.0, 10.0), st.floats(-5.0, 5.0), st.floats(-5.0, 5.0), st.integers(0, 10**6))
def test_the_derivative_of_a_quadratic_is_exact_whatever_the_sampling(
    offset: float, slope: float, bend: float, seed: int
) -> None:
    generator = np.random.default_rng(seed)
    times = np.arange(0.0, 5.0, 0.1) + generator.uniform(-0.045, 0.045, 50)
    times = times[generator.uniform(size=50) > 0.2]
    values = (offset + slope * times + bend * times**2)[:, None]
    at = np.linspace(times[0], times[-1], 100)
    found = arrays.differentiate_locally(at, times, values, WINDOW_S)[:, 0]
    assert np.allclose(found, slope + 2.0 * bend * at, atol=1e-4 * (1.0 + abs(slope) + abs(bend)))


def test_the_derivative_is_exact_at_both_ends_of_a_segment() -> None:
    times = np.arange(0.0, 3.0, 0.05)
    values = (times**2)[:, None]
    ends = np.array([times[0], times[-1]])
    found = arrays.differentiate_locally(ends, times, values, WINDOW_S)[:, 0]
    assert np.allclose(found, 2.0 * ends, atol=1e-6)


@pytest.mark.parametrize("count", [2, 3, 4])
def test_few_samples_give_the_slope_of_their_line(count: int) -> None:
    times = np.arange(count) * 0.5
    found = arrays.differentiate_locally(np.array([0.25]), times, (3.0 * times)[:, None], WINDOW_S)
    assert np.allclose(found, 3.0, atol=1e-6)


def test_sparse_samples_widen_the_window_to_the_nearest_four() -> None:
    times = np.arange(0.0, 20.0, 1.0)
    found = arrays.differentiate_locally(np.array([9.5]), times, (times**2)[:, None], WINDOW_S)
    assert np.allclose(found, 19.0, atol=1e-6)


def test_blocks_of_queries_make_no_difference() -> None:
    times = np.arange(0.0, 300.0, 0.05)
    values = np.sin(times)[:, None]
    at = np.arange(0.0, 299.0, 0.05)
    whole = arrays.differentiate_locally(at, times, values, WINDOW_S)
    part = arrays.differentiate_locally(at[4090:4100], times, values, WINDOW_S)
    assert np.array_equal(whole[4090:4100], part)


def amplitude(frequency: float) -> float:
    """Share of a sinusoidal velocity's amplitude that the derivative at 20 Hz keeps."""
    times = np.arange(0.0, 40.0, 0.05)
    omega = 2.0 * np.pi * frequency
    at = times[(times > 5.0) & (times < 35.0)]
    found = arrays.differentiate_locally(at, times, np.sin(omega * times)[:, None] / omega, WINDOW_S)[:, 0]
    return float(np.sqrt(2.0 * np.mean(found**2)))


def test_the_derivative_keeps_what_the_published_spline_halves() -> None:
    # The published smoothing spline keeps 50 % at 0.36 Hz; a local quadratic over 0.75 s keeps 94 %,
    # and falls to a half at 1.06 Hz (measured with this function).
    assert amplitude(0.36) == pytest.approx(0.936, abs=0.005)
    assert amplitude(1.06) == pytest.approx(0.5, abs=0.01)


@given(st.floats(-100.0, 100.0), st.floats(0.0, 50.0), st.sampled_from([10.0, 20.0, 33.0, 50.0]))
def test_a_grid_spans_its_range_in_equal_steps(start: float, length: float, rate: float) -> None:
    grid = make_grid(start, start + length, rate)
    assert grid[0] == start
    assert grid[-1] <= start + length + 1e-6
    assert grid[-1] > start + length - 1.0 / rate - 1e-6
    assert np.allclose(np.diff(grid), 1.0 / rate)


def test_a_grid_forgives_rounding_at_its_end() -> None:
    assert make_grid(0.1, 0.1 + 0.05 * 3 - 1e-9, 20.0).size == 4


def test_a_held_value_is_the_last_one_known() -> None:
    times = np.array([1.0, 2.0, 3.0])
    at = np.array([0.5, 1.0, 1.9, 2.0 - 5e-8, 10.0])
    assert arrays.hold_indices(at, times).tolist() == [-1, 0, 0, 1, 2]


@given(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))
def test_integrating_a_linear_rate_is_exact(offset: float, slope: float) -> None:
    times = np.array([0.0, 0.1, 0.4, 1.0, 1.5])
    found = arrays.integrate_rate(times, offset + slope * times)
    assert np.allclose(found, offset * times + slope * times**2 / 2.0)


@pytest.mark.parametrize("count", [0, 1])
def test_an_integral_has_as_many_rows_as_its_times(count: int) -> None:
    assert arrays.integrate_rate(np.zeros(count), np.ones(count)).tolist() == [0.0] * count


def test_interpolation_holds_its_ends() -> None:
    values = np.array([[0.0, 1.0], [2.0, 3.0]])
    found = arrays.interpolate_linearly(np.array([-1.0, 0.5, 9.0]), np.array([0.0, 1.0]), values)
    assert found.tolist() == [[0.0, 1.0], [1.0, 2.0], [2.0, 3.0]]


@pytest.mark.parametrize(("rate", "steps"), [(20.0, 10), (1.0, 1), (1e6, 500)])
def test_steps_of_a_span_are_at_least_one_and_shared_stamps_are_a_millisecond_apart(
    rate: float, steps: int
) -> None:
    assert arrays.count_steps(np.arange(20) / rate, 0.5) == steps


@given(st.floats(0.0, 1e4), st.sampled_from([0.05, 0.1, 0.02]))
def test_stretches_are_the_same_whenever_the_recorder_was_started(start: float, step: float) -> None:
    raster = np.arange(2000) * step
    found = arrays.number_stretches((raster + start) - (raster[0] + start), 10.0)
    assert np.array_equal(found, np.arange(2000) // round(10.0 / step))


def hold(times: arrays.Floats, values: arrays.Floats, every: int, first: int = 0) -> arrays.Floats:
    """Each value that is read, repeated until the next one is."""
    rows = np.arange(times.size)
    return values[np.maximum((rows - first) // every * every + first, 0)]


@pytest.mark.parametrize("first", [0, 2])
def test_repeated_readings_are_linear_between_readings(first: int) -> None:
    times = np.arange(0.0, 60.0, 0.05)
    true = 2.0 * np.sin(0.9 * times)
    filled, period = interpolate_repeats(times, hold(times, true, 5, first))
    assert period == pytest.approx(0.25)
    inside = slice(first, times.size - 5)
    assert np.abs(filled - true)[inside].max() < 0.02
    assert np.abs(hold(times, true, 5, first) - true)[inside].max() > 0.3


def test_readings_at_rest_last_until_one_period_before_they_change() -> None:
    times = np.arange(0.0, 30.0, 0.05)
    true = np.where(times < 10.0, 0.0, np.minimum(times - 10.0, 5.0))
    filled, _ = interpolate_repeats(times, hold(times, true, 5))
    assert np.all(filled[times < 9.99] == 0.0)
    assert np.all(filled[times > 15.3] == 5.0)
    assert np.abs(filled - true).max() < 0.26 * 0.25


def test_readings_of_which_none_is_repeated_stay_as_they_are() -> None:
    generator = np.random.default_rng(5)
    times = np.cumsum(0.02 + 0.01 * generator.random(2000))
    values = np.cumsum(generator.standard_normal(times.size))
    values[400:900] = values[400]
    assert np.array_equal(interpolate_repeats(times, values)[0], values)


def test_steps_that_last_for_seconds_are_no_repeated_readings() -> None:
    times = np.arange(0.0, 60.0, 0.05)
    values = np.floor(times / 4.0)
    filled, period = interpolate_repeats(times, values)
    assert period == 0.0
    assert np.array_equal(filled, values)


def test_readings_that_are_missing_stay_so() -> None:
    times = np.arange(0.0, 20.0, 0.05)
    values = hold(times, np.sin(times), 4)
    values[100:120] = np.nan
    filled, period = interpolate_repeats(times, values)
    assert period == pytest.approx(0.2)
    assert np.array_equal(np.isnan(filled), np.isnan(values))
