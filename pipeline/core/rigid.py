"""Rigid motions in the plane and in space, vectorised over the first axis.

Quaternions are (x, y, z, w), unit length, and rotate vectors of the child frame into the parent frame,
as in ROS messages. Angles are in radians.
"""

import numpy as np

from pipeline.core.arrays import Floats

_TINY = 1e-12


def wrap_angle(angle: Floats) -> Floats:
    """Bring angles [rad] into (-pi, pi]."""
    return np.pi - np.mod(np.pi - angle, 2.0 * np.pi)


def unwrap_yaw(yaw: Floats) -> Floats:
    """Remove the 2 pi jumps of a yaw series [rad], shape (n,)."""
    return np.unwrap(yaw)


def multiply_quaternions(first: Floats, second: Floats) -> Floats:
    """Hamilton product of quaternions of shape (n, 4); apply ``second``, then ``first``."""
    ax, ay, az, aw = np.moveaxis(first, -1, 0)
    bx, by, bz, bw = np.moveaxis(second, -1, 0)
    return np.stack(
        (
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ),
        axis=-1,
    )


def invert_quaternions(quaternion: Floats) -> Floats:
    """Inverse of unit quaternions of shape (n, 4)."""
    conjugated: Floats = quaternion * np.array([-1.0, -1.0, -1.0, 1.0])
    return conjugated


def rotate(quaternion: Floats, vector: Floats) -> Floats:
    """Rotate vectors (n, 3) by unit quaternions (n, 4)."""
    axis, scalar = quaternion[..., :3], quaternion[..., 3:]
    twice = 2.0 * np.cross(axis, vector)
    return vector + scalar * twice + np.cross(axis, twice)


def rotation_vectors(quaternion: Floats) -> Floats:
    """Logarithm of unit quaternions (n, 4): rotation vectors (n, 3) [rad], the short way round."""
    flipped = np.where(quaternion[..., 3:] < 0.0, -quaternion, quaternion)
    sine = np.linalg.norm(flipped[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, flipped[..., 3:])
    scale = np.where(sine > _TINY, angle / np.maximum(sine, _TINY), 2.0)
    return flipped[..., :3] * scale


def quaternions_from_vectors(vector: Floats) -> Floats:
    """Exponential of rotation vectors (n, 3) [rad]: unit quaternions (n, 4)."""
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    scale = np.where(angle > _TINY, np.sin(angle / 2.0) / np.maximum(angle, _TINY), 0.5)
    return np.concatenate((vector * scale, np.cos(angle / 2.0)), axis=-1)


def quaternions_from_yaw(yaw: Floats) -> Floats:
    """Unit quaternions (n, 4) of rotations about z by ``yaw`` [rad], shape (n,)."""
    zero = np.zeros_like(yaw)
    return np.stack((zero, zero, np.sin(yaw / 2.0), np.cos(yaw / 2.0)), axis=-1)


def quaternions_from_euler(roll: Floats, pitch: Floats, yaw: Floats) -> Floats:
    """Unit quaternions (n, 4) of intrinsic z-y-x rotations (yaw, then pitch, then roll) [rad]."""
    sr, cr = np.sin(roll / 2.0), np.cos(roll / 2.0)
    sp, cp = np.sin(pitch / 2.0), np.cos(pitch / 2.0)
    sy, cy = np.sin(yaw / 2.0), np.cos(yaw / 2.0)
    return np.stack(
        (
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ),
        axis=-1,
    )


def euler_from_quaternions(quaternion: Floats) -> tuple[Floats, Floats, Floats]:
    """Roll, pitch, yaw [rad] (z-y-x), each of shape (n,), of unit quaternions (n, 4)."""
    x, y, z, w = np.moveaxis(quaternion, -1, 0)
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return roll, pitch, yaw


def slerp(start: Floats, end: Floats, fraction: Floats) -> Floats:
    """Interpolate unit quaternions (n, 4) by ``fraction`` (n,) in [0, 1] on the short arc."""
    delta = rotation_vectors(multiply_quaternions(invert_quaternions(start), end))
    return multiply_quaternions(start, quaternions_from_vectors(delta * fraction[..., None]))


def interpolate_poses(
    at: Floats, times: Floats, position: Floats, quaternion: Floats
) -> tuple[Floats, Floats]:
    """Poses at ``at`` (m,) from poses at increasing ``times`` (n,); held constant outside the range.

    Args:
        at: query times, same unit as ``times``.
        times: strictly increasing, shape (n,), n >= 1.
        position: shape (n, 3) [m].
        quaternion: shape (n, 4), unit length.

    Returns:
        Positions (m, 3) and quaternions (m, 4).
    """
    if times.size == 1:
        return np.repeat(position, at.size, axis=0), np.repeat(quaternion, at.size, axis=0)
    left = np.clip(np.searchsorted(times, at, side="right") - 1, 0, times.size - 2)
    span = times[left + 1] - times[left]
    fraction = np.clip((at - times[left]) / span, 0.0, 1.0)
    between = position[left] + (position[left + 1] - position[left]) * fraction[:, None]
    return between, slerp(quaternion[left], quaternion[left + 1], fraction)
