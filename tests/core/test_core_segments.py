"""Cutting poses into segments, and the increments between them."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core import rigid
from pipeline.core import rigid as segments

speeds = st.floats(-5.0, 5.0)
turn_rates = st.floats(-3.0, 3.0)


def drive_circle(
    speed: float, yaw_rate: float, times: np.ndarray, tilt: tuple[float, float] = (0.0, 0.0)
) -> tuple[np.ndarray, np.ndarray]:
    """Poses of a vehicle on a circle, on a plane tilted by (roll, pitch)."""
    yaw = yaw_rate * times
    # The chord, in the direction half-way: exact however slowly it turns.
    chord = speed * times * np.sinc(yaw / (2.0 * np.pi))
    flat = np.stack((chord * np.cos(0.5 * yaw), chord * np.sin(0.5 * yaw), 0.0 * yaw), axis=-1)
    plane = rigid.quaternions_from_euler(np.array([tilt[0]]), np.array([tilt[1]]), np.zeros(1))
    plane = np.repeat(plane, times.size, axis=0)
    quaternion = rigid.multiply_quaternions(plane, rigid.quaternions_from_yaw(yaw))
    return rigid.rotate(plane, flat), quaternion


@given(speeds, turn_rates, st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_a_constant_twist_comes_back_exactly_on_any_tilted_plane(
    speed: float, yaw_rate: float, roll: float, pitch: float
) -> None:
    times = np.arange(20) * 0.1
    move, turn = segments.measure_increments(*drive_circle(speed, yaw_rate, times, (roll, pitch)))
    assert np.allclose(move, [speed * 0.1, 0.0, 0.0], atol=1e-9)
    assert np.allclose(turn, [0.0, 0.0, yaw_rate * 0.1], atol=1e-9)


@pytest.mark.parametrize("angle", [3.1, np.pi - 1e-6, -3.14])
def test_increments_of_nearly_half_a_turn_are_exact(angle: float) -> None:
    radius = 2.0 / angle
    position = np.array([[0.0, 0.0, 0.0], [radius * np.sin(angle), radius * (1.0 - np.cos(angle)), 0.0]])
    move, turn = segments.measure_increments(position, rigid.quaternions_from_yaw(np.array([0.0, angle])))
    assert np.allclose(move, [[2.0, 0.0, 0.0]], atol=1e-6)
    assert np.allclose(turn, [[0.0, 0.0, angle]], atol=1e-9)


@given(st.floats(1e-9, 1e-3))
def test_increments_are_smooth_where_the_series_takes_over(angle: float) -> None:
    position, quaternion = drive_circle(1.0, angle, np.array([0.0, 1.0]))
    move, _ = segments.measure_increments(position, quaternion)
    assert np.allclose(move, [[1.0, 0.0, 0.0]], atol=1e-6)


@given(st.lists(st.floats(0.05, 0.4), min_size=2, max_size=30), st.integers(0, 10**6))
def test_following_the_increments_leads_back_to_the_poses(periods: list[float], seed: int) -> None:
    generator = np.random.default_rng(seed)
    position = generator.normal(size=(len(periods), 3))
    quaternion = rigid.quaternions_from_vectors(generator.normal(size=(len(periods), 3)) * 0.5)
    move, turn = segments.measure_increments(position, quaternion)
    # One small step of the twist after the other must end at the next pose.
    at, attitude = position[:-1].copy(), quaternion[:-1].copy()
    parts = 300
    for _ in range(parts):
        half = rigid.multiply_quaternions(attitude, rigid.quaternions_from_vectors(turn / parts / 2.0))
        at = at + rigid.rotate(half, move / parts)
        attitude = rigid.multiply_quaternions(attitude, rigid.quaternions_from_vectors(turn / parts))
    assert np.allclose(at, position[1:], atol=1e-3)


def test_a_hole_is_longer_than_three_periods_and_than_the_smallest() -> None:
    times = np.array([0.0, 0.05, 0.1, 0.15, 0.31, 0.36, 0.47])
    assert segments.find_gaps(times, 0.12).tolist() == [False, False, False, False, True, False, False]
    assert not segments.find_gaps(times, 0.2).any()
    slow = np.arange(10) * 0.25
    assert not segments.find_gaps(slow, 0.12).any()


@pytest.mark.parametrize("count", [0, 1])
def test_no_samples_have_no_holes(count: int) -> None:
    assert segments.find_gaps(np.zeros(count), 0.1).tolist() == [False] * count


def test_a_held_pose_repeats_position_and_attitude() -> None:
    position = np.array([[0.0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 0, 0]])
    quaternion = np.array([[0.0, 0, 0, 1], [0, 0, 0, 1], [0, 0, 0, 1], [0, 0, 0.1, np.sqrt(0.99)]])
    assert segments.find_held(position, quaternion).tolist() == [False, True, False, False]


def hold_flags(changes: np.ndarray, count: int) -> np.ndarray:
    held = np.ones(count, dtype=bool)
    held[changes] = False
    return held


def test_repeats_of_a_slow_localization_are_dropped() -> None:
    times = np.arange(200) * 0.05
    fresh = np.arange(0, 200, 4)
    assert segments.select_fresh_poses(times, hold_flags(fresh, 200)).tolist() == fresh.tolist()


def test_repeats_of_a_standing_vehicle_are_kept() -> None:
    times = np.arange(400) * 0.05
    # Moves for 5 s, stands for 10 s, moves again: scans at 5 Hz are repeated at 20 Hz.
    changes = np.concatenate((np.arange(0, 100, 4), np.arange(300, 400, 4)))
    kept = segments.select_fresh_poses(times, hold_flags(changes, 400))
    standing = kept[(times[kept] > 5.0) & (times[kept] < 14.5)]
    assert standing.size > 150
    # The last repeats before it moves again may be old by a scan: they would put the start too late.
    assert not np.any((times[kept] > 14.75) & (times[kept] < 14.99))


def test_a_vehicle_that_stands_throughout_keeps_all_its_poses() -> None:
    times = np.arange(30) * 0.1
    held = np.array([False] + [True] * 29)
    assert segments.select_fresh_poses(times, held).size == 30


def test_a_moment_of_repeats_alone_says_nothing() -> None:
    assert segments.select_fresh_poses(np.arange(4) * 0.1, np.array([False, True, True, True])).tolist() == [
        0
    ]


def noisy_drive(seed: int = 0, *, noise: float = 0.003, rate: float = 20.0) -> tuple[np.ndarray, ...]:
    times = np.arange(0.0, 30.0, 1.0 / rate)
    position, quaternion = drive_circle(1.0, 0.3, times)
    generator = np.random.default_rng(seed)
    position = position + generator.normal(size=position.shape) * noise
    shake = generator.normal(size=position.shape) * noise / 2.0
    return times, position, rigid.multiply_quaternions(quaternion, rigid.quaternions_from_vectors(shake))


def find(times: np.ndarray, position: np.ndarray, quaternion: np.ndarray) -> list[int]:
    found = segments.find_jumps(times, position, quaternion, metres=0.1, radians=0.1)
    return np.flatnonzero(found).tolist()


@pytest.mark.parametrize("place", [8, 300, 590])
def test_a_correction_of_the_map_is_found_where_it_happens(place: int) -> None:
    times, position, quaternion = noisy_drive()
    position[place:] += [0.3, 0.3, 0.0]
    assert find(times, position, quaternion) == [place]


def test_a_jump_of_the_heading_alone_is_found() -> None:
    times, position, quaternion = noisy_drive()
    turned = rigid.quaternions_from_yaw(np.full(300, 0.4))
    quaternion[300:] = rigid.multiply_quaternions(turned, quaternion[300:])
    assert 300 in find(times, position, quaternion)


@given(st.integers(0, 1000))
def test_noise_and_vibration_are_no_jumps(seed: int) -> None:
    times, position, quaternion = noisy_drive(seed, noise=0.03)
    assert find(times, position, quaternion) == []


def test_a_single_wild_pose_that_comes_back_is_no_jump() -> None:
    times, position, quaternion = noisy_drive()
    position[300] += [0.1, 0.0, 0.0]
    assert find(times, position, quaternion) == []


def test_scans_that_were_skipped_are_no_jumps() -> None:
    times, position, quaternion = noisy_drive(rate=5.0)
    kept = np.ones(times.size, dtype=bool)
    kept[[40, 41, 80]] = False
    assert find(times[kept], position[kept], quaternion[kept]) == []


def test_a_vehicle_that_turns_round_at_once_does_not_jump() -> None:
    times = np.arange(0.0, 20.0, 0.05)
    speed = np.where(times < 10.0, 4.5, -4.5)
    position = np.stack((np.cumsum(speed) * 0.05, 0.0 * times, 0.0 * times), axis=-1)
    quaternion = rigid.quaternions_from_yaw(0.0 * times)
    assert find(times, position, quaternion) == []


def test_a_handful_of_poses_is_not_judged() -> None:
    times, position, quaternion = (part[:7] for part in noisy_drive())
    assert find(times, position, quaternion) == []


@given(st.lists(st.booleans(), max_size=40))
def test_runs_of_flags_cover_exactly_the_flags(flags: list[bool]) -> None:
    found = segments.find_runs(np.array(flags, dtype=bool))
    covered = [index for first, end in found for index in range(first, end)]
    assert covered == [index for index, flag in enumerate(flags) if flag]
    assert all(end < first for (_, end), (first, _) in pairwise(found))


def test_segments_are_counted_from_their_breaks() -> None:
    breaks = np.array([False, False, True, False, True])
    assert segments.number_segments(breaks).tolist() == [0, 0, 1, 1, 2]
