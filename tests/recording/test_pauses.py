"""The time-out of a base from the pauses of its commands: its interval holds the true one."""

import numpy as np
import pytest
from few import few

from pipeline.core import Floats
from pipeline.recording.geometry import roll_wheels
from pipeline.recording.readings import Held, Reading
from pipeline.recording.timeouts import CommandTimeout, find_hold, find_timeout, hold

TIMEOUT_S = 0.5
STEP_S = 0.02
PERIOD_S = 0.05
ON_S, TURN_S = 4.0, 8.0


def send(starts: Floats, speeds: Floats, zeros: int | Floats = 0) -> tuple[Floats, Floats]:
    """Stamps and values of commands for four seconds from each start, and so many of zero after them."""
    count = round(ON_S / PERIOD_S)
    counts = count + np.broadcast_to(zeros, starts.shape).astype(int)
    stamps = [start + PERIOD_S * np.arange(one) for start, one in zip(starts, counts, strict=True)]
    values = [np.where(np.arange(one) < count, speed, 0.0) for speed, one in zip(speeds, counts, strict=True)]
    return np.concatenate(stamps), np.concatenate(values)


def find(stamps: Floats, values: Floats, time: Floats, speed: Floats) -> CommandTimeout | None:
    wheels = Reading("body", "", Held(time, speed), Held(time, 1e-3 * np.sin(time)))
    motion = roll_wheels(wheels)
    assert motion.is_known
    return find_timeout(Reading("body", "", Held(stamps, values), Held(stamps, 0.0 * values)), motion, 0.5)


def drive_by_keys(kind: str, up: float, down: float) -> CommandTimeout | None:
    """A base that nobody tells to stop, with limits [m/s^2] or lags [s] of starts and of stops."""
    rng = np.random.default_rng(5)
    starts = 5.0 + TURN_S * np.arange(15) + rng.uniform(0.0, 0.1, 15)
    stamps, values = send(starts, rng.uniform(0.5, 1.5, 15))
    time = np.arange(0.0, starts[-1] + TURN_S, STEP_S)
    last = np.maximum(np.searchsorted(stamps, time, side="right") - 1, 0)
    asked = np.where((time >= stamps[last]) & (time - stamps[last] < TIMEOUT_S), values[last], 0.0)
    speed, state = np.zeros(time.size), 0.0
    for row, one in enumerate(asked.tolist()):
        speed[row], off = state, one - state
        ramp = min(max(off, -down * STEP_S), up * STEP_S)
        state += ramp if kind == "limit" else off * STEP_S / (up if off > 0.0 else down)
    return find(stamps, values, time, speed)


@pytest.mark.parametrize(("kind", "rate"), [("limit", 2.0), ("lag", 0.2)])
def test_starts_stand_in_for_stops_of_a_base_that_does_both_alike(kind: str, rate: float) -> None:
    told = drive_by_keys(kind, rate, rate)
    assert told.seconds == pytest.approx(TIMEOUT_S, abs=0.03)
    assert told.high - told.low < 0.1


@pytest.mark.parametrize(
    ("kind", "up", "down"),
    [("limit", 1.0, 3.0), ("limit", 3.0, 1.0), ("lag", 0.1, 0.4), ("lag", 0.4, 0.1), ("lag", 0.05, 0.3)],
)
def test_a_base_that_stops_otherwise_than_it_starts_is_less_sure(kind: str, up: float, down: float) -> None:
    told = drive_by_keys(kind, up, down)
    assert told.low <= TIMEOUT_S <= told.high


def test_nothing_is_told_where_starts_are_much_slower_than_stops() -> None:
    assert drive_by_keys("limit", 0.6, 3.0) is None


@pytest.mark.parametrize(("silences", "stops"), few([(5, 5), (3, 12)], 2))
def test_the_interval_of_few_pauses_holds_the_time_out(silences: int, stops: int) -> None:
    """Response times vary by 0.04 s from one stop to the next."""
    rng, count, runs = np.random.default_rng(6), silences + stops, 300
    held = []
    for _ in range(runs):
        starts = 5.0 + TURN_S * np.arange(count) + rng.uniform(0.0, 0.1, count)
        is_silent = np.append(rng.permutation(count - 1) < silences, False)
        speeds = rng.uniform(0.5, 1.5, count)
        stamps, values = send(starts, speeds, np.where(is_silent, 0, 20))
        response = 0.25 + np.clip(rng.normal(0.0, 0.04, count), -0.1, 0.1)
        # A silence begins with the last command, an ordinary stop with the first of zero.
        ends = starts + ON_S + response + np.where(is_silent, TIMEOUT_S - PERIOD_S, 0.0)
        time = np.arange(0.0, starts[-1] + TURN_S, STEP_S)
        row = np.maximum(np.searchsorted(starts, time) - 1, 0)
        speed = np.where((time > starts[row] + 0.2) & (time < ends[row]), speeds[row], 0.0)
        told = find(stamps, values, time, speed)
        if told is not None:
            held.append(told.low <= TIMEOUT_S <= told.high)
    assert len(held) > 0.9 * runs
    assert np.mean(held) > 0.9


@pytest.mark.parametrize("timeout_s", few([0.3, 0.5, np.inf], 2))
@pytest.mark.parametrize("period_s", few([1.0, 2.0], 2))
def test_a_base_that_waits_less_than_its_commander_drives_in_bursts(
    period_s: float, timeout_s: float
) -> None:
    """Commands at changes and once a second or two: no pause stands out of the others."""
    rng = np.random.default_rng(6)
    changes = np.cumsum(rng.uniform(1.5, 4.0, 45))
    stamps = np.sort(np.append(changes, np.arange(0.0, changes[-1], period_s)))
    at = np.searchsorted(changes, stamps, side="right") - 1
    values = np.where(at >= 0, rng.uniform(-1.0, 1.0, changes.size)[at], 0.0)
    time = np.arange(0.0, stamps[-1], STEP_S)
    last = np.maximum(np.searchsorted(stamps, time, side="right") - 1, 0)
    asked = np.where(time - stamps[last] < timeout_s, values[last], 0.0)
    speed, state = np.zeros(time.size), 0.0
    for row, one in enumerate(asked.tolist()):
        speed[row] = state
        state += (one - state) * STEP_S / 0.2
    motion = roll_wheels(Reading("body", "", Held(time, speed), Held(time, 1e-3 * np.sin(time))))
    assert motion.is_known
    command = Reading("body", "", Held(stamps, values, may_stand=True), Held(stamps, 0.0 * values))
    found = find_hold(command, motion)
    if np.isinf(timeout_s):
        assert found is None
        return
    assert found.low <= timeout_s <= found.high
    assert found.seconds == pytest.approx(timeout_s, abs=0.05)


@pytest.mark.parametrize("timeout_s", [0.6, 1.2, 5.0], ids=str)
def test_a_message_counts_whatever_silence_ends_with_it(timeout_s: float) -> None:
    """Gaps of whole periods are a little longer or shorter than these by rounding."""
    stamps = np.delete(1.2 * np.arange(400), np.arange(50, 350, 7))
    values = np.random.default_rng(8).uniform(0.5, 1.0, stamps.size)
    command = Reading("body", "", Held(stamps, values, may_stand=True), Held(stamps, 0.0 * values))
    held = hold(command, timeout_s).first
    at = np.searchsorted(held.times, stamps + 1e-9, side="right") - 1
    assert np.array_equal(held.values[at], values)
