"""Commands that fall silent for long: how long one is held is found in a moment, whatever their period."""

import time

import numpy as np
import pytest
from drawn_motion import draw, measured, tabulate

from pipeline.recording.readings import Held, Reading
from pipeline.recording.timeouts import find_timeout, hold

SILENT_S = 2000.0
LONGEST_S = 1.0


def send(period_s: float) -> Reading:
    """A command for five seconds after each of five starts, with long silences between."""
    starts = np.arange(5) * (SILENT_S + 5.0)
    times = (starts[:, None] + np.arange(0.0, 5.0, period_s)).ravel()
    return Reading("body", "/cmd_vel", Held(times, np.ones(times.size)), Held(times, np.sin(times)))


@pytest.mark.parametrize("period_s", [0.001, 0.1])
@pytest.mark.parametrize("seconds", [0.5, np.inf])
def test_silences_of_half_an_hour_are_filled_in_a_moment(period_s: float, seconds: float) -> None:
    reading = send(period_s)
    started = time.process_time()
    held = hold(reading, seconds).first
    assert time.process_time() - started < LONGEST_S
    # Before the end of the time, after it, and just before the next command.
    at = (np.array([5.1, 5.3, 5.6, 65.0, SILENT_S + 4.9]) - held.times[0] + 1.0) / 0.02
    np.testing.assert_array_equal(held.grid[at.astype(int)], [1.0, 1.0, *3 * [float(np.isinf(seconds))]])


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_commands_have_no_silence(count: int) -> None:
    reading = Reading("body", "/cmd_vel", *(Held(np.zeros(count), np.ones(count)) for _ in range(2)))
    assert hold(reading, 0.5) is reading
    assert find_timeout(reading, measured(tabulate(draw())), 0.5) is None
