"""Counters that jump, and what a position and a velocity of one wheel say together."""

import numpy as np
import pytest

from pipeline.recording.rates import (
    differentiate_angle,
    find_jumps,
    report_jumps,
    settle_joints,
    unwrap_counter,
)
from pipeline.words import format_finding

TIMES = np.arange(600) / 20.0
SPEED = 4.0 * np.sin(0.3 * TIMES) + 1.0 * np.sin(1.7 * TIMES)
ANGLE = np.cumsum(SPEED) / 20.0


def jump(series: np.ndarray, *at: tuple[int, float]) -> np.ndarray:
    made = series.copy()
    for index, size in at:
        made[index:] += size
    return made


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["ahead", "backward"])
@pytest.mark.parametrize("size", [809.3, 50.0], ids=["16 bits", "small"])
def test_a_counter_that_runs_over_is_no_motion(sign: float, size: float) -> None:
    counted = jump(sign * ANGLE, (200, size), (340, size), (341 + 60, -size))
    rate = differentiate_angle(TIMES, counted)
    np.testing.assert_allclose(rate[2:-2], sign * SPEED[2:-2], atol=0.3)
    (finding,) = report_jumps("/joint_states", TIMES, {"left": counted, "right": ANGLE})
    assert (finding.severity, finding.count) == ("info", 3)
    assert "left" in format_finding(finding)
    assert "right" not in format_finding(finding)


def test_a_counter_that_is_reset_goes_on_from_zero() -> None:
    counted = ANGLE + 400.0
    counted[300:] -= counted[300]
    assert find_jumps(TIMES, counted).tolist() == [299]
    np.testing.assert_allclose(differentiate_angle(TIMES, counted)[2:-2], SPEED[2:-2], atol=0.3)


def test_readings_that_are_repeated_and_ticks_have_no_jumps() -> None:
    held = np.repeat(ANGLE[::3], 3)
    ticks = np.round(ANGLE * 40.0)
    slow = np.floor(0.2 * TIMES)
    started = np.where(TIMES > 20.0, 6.0 * (TIMES - 20.0), 0.0)
    for series in (ANGLE, held, ticks, slow, started, np.zeros(TIMES.size)):
        assert not find_jumps(TIMES, series).size
    assert report_jumps("/joint_states", TIMES, {"left": ANGLE}) == []


def test_a_jump_between_repeated_readings_is_found() -> None:
    held = np.repeat(jump(ANGLE, (300, 809.3))[::3], 3)
    assert find_jumps(TIMES, held).size == 1


@pytest.mark.parametrize("bits", [8, 12, 16, 32])
def test_a_counter_of_any_width_is_unwrapped(bits: int) -> None:
    true = np.arange(0.0, 3.0, 1.0 / 40.0) * 2.0**bits
    assert np.array_equal(unwrap_counter(true % 2.0**bits), true)
    np.testing.assert_allclose(unwrap_counter(-true % 2.0**bits), -true, rtol=1e-9)


def settle(gain: float, scale: float = 1.0) -> tuple[str, tuple[str, ...], list[str]]:
    velocity, turned = {"left": gain * SPEED}, {"left": scale * SPEED}
    settled = settle_joints("/joint_states", velocity, turned)
    return settled.unit, settled.by_position, [one.id for one in settled.findings]


def test_a_velocity_is_measured_by_its_position() -> None:
    assert settle(1.0) == ("", (), [])
    assert settle(0.5 / np.pi) == ("rev/s", (), [])
    assert settle(30.0 / np.pi) == ("rpm", (), [])
    assert settle(0.0) == ("", ("left",), ["velocity_zero"])
    assert settle(15.0) == ("", ("left",), ["velocity_not_of_position"])
    assert settle(60.0) == ("", ("left",), ["velocity_not_of_position"])
    assert settle(-1.0) == ("", ("left",), ["velocity_not_of_position"])


def test_a_position_in_another_unit_is_told_by_its_velocity() -> None:
    assert settle(1.0, np.degrees(1.0)) == ("", (), ["position_unit"])
    assert settle(1.0, 0.5 / np.pi) == ("", (), ["position_unit"])
    # Counts of an encoder turn faster than any wheel.
    assert settle(1.0, 200.0) == ("", (), ["velocity_not_of_position"])


def test_what_does_not_follow_its_position_is_left_alone() -> None:
    velocity = {"left": np.random.default_rng(1).normal(0.0, 3.0, TIMES.size)}
    settled = settle_joints("/joint_states", velocity, {"left": SPEED})
    assert (settled.unit, settled.by_position, settled.findings) == ("", (), ())
    still = settle_joints("/joint_states", {"left": 0.0 * SPEED}, {"left": 0.0 * SPEED})
    assert not still.by_position


def test_one_side_whose_velocity_is_zero_is_replaced_alone() -> None:
    velocity, turned = {"left": 0.0 * SPEED, "right": SPEED}, {"left": SPEED, "right": SPEED}
    settled = settle_joints("/joint_states", velocity, turned)
    assert settled.by_position == ("left",)
    assert [one.id for one in settled.findings] == ["velocity_zero"]
