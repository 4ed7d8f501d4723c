"""Slopes under poses in the plane, by an orientation of an IMU.

A localization in the plane, or a receiver's course, knows a heading and no slope: where the ground is not
level, roll and pitch are those of the IMU, and the height follows from them along the path. Its specific
force, which is gravity and the acceleration of the body, tells which way it is mounted.
"""

import numpy as np

from pipeline.core import Floats, arrays, rigid
from pipeline.stages import reading

_LEVEL_RAD = 1e-3
"""Range of roll and pitch [rad] below which poses are in the plane: rounding is less, and any ground more."""
_LEAST_RAD = np.radians(3.0)
"""Half of the range of roll or pitch over nine tenths of the time from which on an IMU tells a slope: on a
level floor, starts and stops feign a degree or two."""
_UNIT = 0.1
"""Deviation of an orientation's length from one: a sensor without one gives zeros."""
_UPRIGHT = 0.9
"""Share of the specific force that is upward where an orientation belongs to it: the rest is acceleration."""
_WINDOW_S = 1.0
"""Span over which accelerations are compared [s]: shorter ones are noise of the poses."""
_FOLLOWS = 0.3
"""Least share of a body's acceleration that its IMU's is explained by, where that tells its mounting."""
_TURNED_RAD = np.radians(30.0)
"""Least angle of a mounting [rad]: nobody mounts an IMU askew by less and says nothing, and noise may."""


def lean(
    times: Floats, position: Floats, quaternion: Floats, imu: reading.Receiver, turn: Floats | None
) -> tuple[Floats, Floats, float, float] | None:
    """Poses in the plane with the slopes of an IMU; None where poses or IMU give no reason.

    Args:
        times: of the poses [s], shape (n,).
        position: shape (n, 3) [m].
        quaternion: shape (n, 4).
        imu: orientations with their clock.
        turn: orientation of the body in the IMU's frame, shape (4,); None where nothing says it.

    Returns:
        Positions, quaternions, the largest slope over nine tenths of the time, and the angle from ahead to
        the IMU's x axis where only its accelerations tell it, else zero [rad].
    """
    roll, pitch, yaw = rigid.euler_from_quaternions(quaternion)
    attitude = reading.read_attitude(imu.columns)
    if attitude is None or max(_span(roll), _span(pitch)) > _LEVEL_RAD:
        return None
    force = reading.read_imu(imu.columns)[1][imu.order]
    attitude, at = attitude[imu.order], imu.times[imu.order]
    known = np.isfinite(attitude).all(axis=1) & (np.abs(np.linalg.norm(attitude, axis=1) - 1.0) < _UNIT)
    if known.sum() < reading.FEWEST_MESSAGES:
        return None
    attitude, at, force = attitude[known], at[known], force[known]
    angle = 0.0 if turn is not None else _find_mounting(times, position, yaw, (at, attitude, force))
    if angle is None:
        return None
    if turn is None:
        turn = rigid.quaternions_from_yaw(np.array([-angle]))[0]
    tilts = rigid.euler_from_quaternions(rigid.multiply_quaternions(attitude, turn[None]))[:2]
    low, high = np.quantile(tilts, (0.05, 0.95), axis=1)
    if float((high - low).max()) < 2.0 * _LEAST_RAD:
        return None
    roll, pitch = (np.interp(times, at, tilt) for tilt in tilts)
    leaning = rigid.quaternions_from_euler(roll, pitch, yaw)
    if _span(position[:, 2]) == 0.0:
        across = rigid.rotate(leaning, np.broadcast_to([0.0, 0.0, 1.0], position.shape))
        slope = -across[:, :2] / across[:, 2:]
        risen = (0.5 * (slope[1:] + slope[:-1]) * np.diff(position[:, :2], axis=0)).sum(axis=1)
        height = position[0, 2] + np.append(0.0, np.cumsum(np.nan_to_num(risen)))
        position = np.column_stack((position[:, :2], np.where(np.isfinite(position[:, 2]), height, np.nan)))
    return position, leaning, float(np.abs([low, high]).max()), angle


def _find_mounting(
    times: Floats, position: Floats, yaw: Floats, imu: tuple[Floats, Floats, Floats]
) -> float | None:
    """Angle from ahead to the x axis of an IMU by accelerations [rad].

    Zero where nothing tells; None where its orientation is not that of its specific force.

    Args:
        times: of the poses [s], shape (n,).
        position: of the poses [m], shape (n, 3).
        yaw: of the poses [rad], shape (n,).
        imu: times [s], orientations and specific forces [m/s^2] of the IMU, shape (m,), (m, 4) and (m, 3).
    """
    at, attitude, force = imu
    size = np.linalg.norm(np.nan_to_num(force), axis=1)
    if float(np.median(size)) < 1.0:
        return 0.0
    if float(np.median(rigid.rotate(attitude, force)[:, 2] / np.maximum(size, 1.0))) < _UPRIGHT:
        return None
    good = np.isfinite(position).all(axis=1) & np.isfinite(yaw) & (np.diff(times, prepend=-np.inf) > 0.0)
    times, plane = times[good], position[good, :2]
    inside = (at > times[0] + _WINDOW_S) & (at < times[-1] - _WINDOW_S) & np.isfinite(force).all(axis=1)
    at, attitude, force = at[inside], attitude[inside], force[inside]
    if at.size < reading.FEWEST_MESSAGES:
        return 0.0
    roll, pitch, _ = rigid.euler_from_quaternions(attitude)
    level = rigid.rotate(rigid.quaternions_from_euler(roll, pitch, np.zeros(roll.size)), force)
    # Means over the window: the change of the velocity over it is that of the acceleration.
    velocity = arrays.differentiate_locally(times, times, plane, _WINDOW_S)
    moved = arrays.differentiate_locally(at, times, velocity, _WINDOW_S)
    summed = np.column_stack([arrays.integrate_rate(at, part) for part in level[:, :2].T])
    felt = arrays.differentiate_locally(at, at, summed, 2.0 * _WINDOW_S)
    body = (moved[:, 0] + 1j * moved[:, 1]) * np.exp(-1j * np.interp(at, times, yaw[good]))
    sensed = felt[:, 0] + 1j * felt[:, 1]
    sensed = sensed - sensed.mean()
    # A turned sensor feels what the body does, turned back.
    shared = np.vdot(sensed, body)
    power = float((np.vdot(body, body) * np.vdot(sensed, sensed)).real)
    angle = float(np.angle(shared))
    is_clear = float(abs(shared) ** 2) > _FOLLOWS * power and abs(angle) > _TURNED_RAD
    return angle if is_clear else 0.0


def _span(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.ptp(known)) if known.size else 0.0
