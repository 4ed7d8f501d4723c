"""Command steps and their transitory spans."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.stages.inputs import find_changes, mark_transitory, number_steps

RATE = 20.0


def grid(duration: float) -> np.ndarray:
    return np.arange(round(duration * RATE)) / RATE


def as_ideal(forward: np.ndarray, turning: np.ndarray | float = 0.0) -> np.ndarray:
    return np.stack((forward, 0.0 * forward, turning + 0.0 * forward), axis=-1)


def starts_of(times: np.ndarray, ideal: np.ndarray, segment: np.ndarray | None = None) -> list[float]:
    segment = np.zeros(times.size, dtype=np.int32) if segment is None else segment
    step = number_steps(times, segment, find_changes(times, ideal, 1.0))
    assert step[0] == 0
    assert set(np.diff(step).tolist()) <= {0, 1}
    return times[np.flatnonzero(np.diff(step, prepend=-1))].tolist()


def test_held_commands_are_steps() -> None:
    times = grid(18.0)
    levels = np.array([0.5, -0.8, 0.3])[(times // 6.0).astype(int)]
    assert starts_of(times, as_ideal(levels)) == pytest.approx([0.0, 6.0, 12.0])


def test_a_short_ramp_to_a_held_speed_is_one_change() -> None:
    times = grid(12.0)
    ramp = np.clip(times - 6.0, 0.0, 0.8)
    assert starts_of(times, as_ideal(ramp)) == pytest.approx([0.0, 6.05], abs=0.06)


def test_a_command_that_never_rests_is_one_step() -> None:
    times = grid(60.0)
    assert starts_of(times, as_ideal(np.sin(2.0 * times), np.cos(1.4 * times))) == [0.0]


def test_rest_before_and_after_restless_driving_is_told_from_it() -> None:
    times = grid(30.0)
    restless = np.where((times >= 10.0) & (times < 20.0), 0.6 + 0.4 * np.sin(3.0 * times), 0.0)
    found = starts_of(times, as_ideal(restless))
    assert len(found) == 3
    assert found[1] == pytest.approx(10.0, abs=0.1)
    assert found[2] == pytest.approx(20.0, abs=1.1)


def test_noise_of_measured_wheels_makes_no_steps() -> None:
    times = grid(18.0)
    noise = np.random.default_rng(1).normal(size=times.size) * 0.01
    levels = np.array([0.5, -0.8, 0.3])[(times // 6.0).astype(int)]
    assert starts_of(times, as_ideal(levels + noise)) == pytest.approx([0.0, 6.0, 12.0])


def test_a_segment_starts_a_step_but_no_transitory_span() -> None:
    times = grid(12.0)
    ideal = as_ideal(0.5 + 0.0 * times)
    segment = (times >= 7.0).astype(np.int32)
    assert starts_of(times, ideal, segment) == [0.0, 7.0]
    transitory = mark_transitory(times, find_changes(times, ideal, 1.0), 2.0)
    assert times[transitory].max() < 2.0


@given(st.floats(0.5, 5.0))
def test_the_transitory_span_follows_every_change_for_as_long_as_asked(span: float) -> None:
    times = grid(12.0)
    ideal = as_ideal(np.where(times < 6.0, 0.5, -0.5))
    transitory = mark_transitory(times, find_changes(times, ideal, 1.0), span)
    expected = (times % 6.0) < span - 1e-6
    assert np.array_equal(transitory, expected)
