"""Rigid motions: what goes there comes back, whatever the rotation."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core import rigid

angles = st.floats(-np.pi, np.pi)
numbers = st.floats(-100.0, 100.0)
vectors = st.tuples(numbers, numbers, numbers).map(lambda v: np.array([v]))
# The logarithm is one to one below half a turn.
rotations = (
    st.tuples(*[st.floats(-1.0, 1.0)] * 3, st.floats(0.0, np.pi - 1e-6))
    .filter(lambda v: np.linalg.norm(v[:3]) > 1e-3)
    .map(lambda v: np.array([v[:3]]) / np.linalg.norm(v[:3]) * v[3])
)


def as_quaternion(rotation: np.ndarray) -> np.ndarray:
    return rigid.quaternions_from_vectors(rotation)


@given(st.floats(-1e4, 1e4))
def test_wrapped_angles_lie_within_half_a_turn_and_point_the_same_way(angle: float) -> None:
    wrapped = float(rigid.wrap_angle(np.array([angle]))[0])
    assert -np.pi <= wrapped <= np.pi
    assert np.allclose([np.cos(wrapped), np.sin(wrapped)], [np.cos(angle), np.sin(angle)], atol=1e-9)


def test_half_a_turn_wraps_to_plus_pi() -> None:
    assert np.allclose(rigid.wrap_angle(np.array([np.pi, -np.pi, 3.0 * np.pi])), np.pi)


@given(rotations)
def test_exponential_and_logarithm_are_inverses(rotation: np.ndarray) -> None:
    assert np.allclose(rigid.rotation_vectors(as_quaternion(rotation)), rotation, atol=1e-9)


@given(rotations)
def test_a_quaternion_and_its_negative_are_one_rotation(rotation: np.ndarray) -> None:
    quaternion = as_quaternion(rotation)
    assert np.allclose(rigid.rotation_vectors(-quaternion), rigid.rotation_vectors(quaternion), atol=1e-9)


@given(rotations, vectors)
def test_rotating_there_and_back_changes_nothing(rotation: np.ndarray, vector: np.ndarray) -> None:
    quaternion = as_quaternion(rotation)
    back = rigid.rotate(rigid.invert_quaternions(quaternion), rigid.rotate(quaternion, vector))
    assert np.allclose(back, vector, atol=1e-9)


@given(rotations, rotations, vectors)
def test_a_product_applies_its_second_factor_first(
    first: np.ndarray, second: np.ndarray, vector: np.ndarray
) -> None:
    both = rigid.multiply_quaternions(as_quaternion(first), as_quaternion(second))
    one_by_one = rigid.rotate(as_quaternion(first), rigid.rotate(as_quaternion(second), vector))
    assert np.allclose(rigid.rotate(both, vector), one_by_one, atol=1e-9)


@given(rotations)
def test_rotations_keep_lengths_and_unit_quaternions_stay_so(rotation: np.ndarray) -> None:
    quaternion = as_quaternion(rotation)
    assert np.isclose(np.linalg.norm(quaternion), 1.0)
    assert np.isclose(np.linalg.norm(rigid.rotate(quaternion, np.array([[3.0, 4.0, 12.0]]))), 13.0)


@given(angles, st.floats(-1.5, 1.5), angles)
def test_euler_angles_come_back(roll: float, pitch: float, yaw: float) -> None:
    given_angles = [np.array([roll]), np.array([pitch]), np.array([yaw])]
    quaternion = rigid.quaternions_from_euler(*given_angles)
    found = rigid.euler_from_quaternions(quaternion)
    again = rigid.quaternions_from_euler(*found)
    assert np.isclose(np.abs(np.sum(again * quaternion)), 1.0, atol=1e-9)


def test_pitch_above_zero_puts_the_nose_down() -> None:
    nose = rigid.rotate(
        rigid.quaternions_from_euler(np.zeros(1), np.array([0.2]), np.zeros(1)), np.array([[1.0, 0.0, 0.0]])
    )
    assert nose[0, 2] < 0.0


@given(rotations, rotations)
def test_slerp_starts_at_its_start_and_ends_at_its_end(first: np.ndarray, second: np.ndarray) -> None:
    start, end = as_quaternion(first), as_quaternion(second)
    assert np.allclose(rigid.slerp(start, end, np.zeros(1)), start, atol=1e-9)
    assert np.isclose(np.abs(np.sum(rigid.slerp(start, end, np.ones(1)) * end)), 1.0, atol=1e-9)


@given(rotations, rotations, st.floats(0.0, 1.0))
def test_slerp_turns_evenly(first: np.ndarray, second: np.ndarray, fraction: float) -> None:
    start, end = as_quaternion(first), as_quaternion(second)
    whole = rigid.rotation_vectors(rigid.multiply_quaternions(rigid.invert_quaternions(start), end))
    between = rigid.slerp(start, end, np.array([fraction]))
    part = rigid.rotation_vectors(rigid.multiply_quaternions(rigid.invert_quaternions(start), between))
    assert np.isclose(np.linalg.norm(part), fraction * np.linalg.norm(whole), atol=1e-8)


def test_slerp_takes_the_short_way_round() -> None:
    start = rigid.quaternions_from_yaw(np.array([np.radians(170.0)]))
    end = rigid.quaternions_from_yaw(np.array([np.radians(-170.0)]))
    _, _, yaw = rigid.euler_from_quaternions(rigid.slerp(start, end, np.array([0.5])))
    assert np.isclose(np.abs(yaw[0]), np.pi)


def test_poses_are_held_outside_their_range() -> None:
    times = np.array([1.0, 2.0])
    position = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    quaternion = rigid.quaternions_from_yaw(np.array([0.0, 1.0]))
    at, attitude = rigid.interpolate_poses(np.array([0.0, 1.5, 9.0]), times, position, quaternion)
    assert np.allclose(at[:, 0], [0.0, 0.5, 1.0])
    assert np.allclose(rigid.euler_from_quaternions(attitude)[2], [0.0, 0.5, 1.0])


def test_one_pose_stands_for_all_times() -> None:
    at, attitude = rigid.interpolate_poses(
        np.array([0.0, 5.0]), np.array([1.0]), np.array([[1.0, 2.0, 3.0]]), np.array([[0.0, 0.0, 0.0, 1.0]])
    )
    assert at.shape == (2, 3)
    assert attitude.shape == (2, 4)
