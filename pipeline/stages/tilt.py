"""Slopes under poses in the plane, by an orientation of an IMU.

A localization in the plane, or a receiver's course, knows a heading and no slope: where the ground is not
level, roll and pitch are those of the IMU, and the height follows from them along the path.
"""

import numpy as np

from pipeline.core import Floats, rigid
from pipeline.stages import reading

_LEVEL_RAD = 1e-3
"""Range of roll and pitch [rad] below which poses are in the plane: rounding is less, and any ground more."""
_LEAST_RAD = np.radians(3.0)
"""Half of the range of roll or pitch over nine tenths of the time from which on an IMU tells a slope: on a
level floor, starts and stops feign a degree or two."""
_UNIT = 0.1
"""Deviation of an orientation's length from one: a sensor without one gives zeros."""


def lean(
    times: Floats, position: Floats, quaternion: Floats, imu: reading.Receiver, turn: Floats
) -> tuple[Floats, Floats, float] | None:
    """Poses in the plane with the slopes of an IMU; None where poses or IMU give no reason.

    Args:
        times: of the poses [s], shape (n,).
        position: shape (n, 3) [m].
        quaternion: shape (n, 4).
        imu: orientations with their clock.
        turn: orientation of the body in the IMU's frame, shape (4,).

    Returns:
        Positions, quaternions, and the largest slope over nine tenths of the time [rad].
    """
    roll, pitch, yaw = rigid.euler_from_quaternions(quaternion)
    attitude = reading.read_attitude(imu.columns)
    if attitude is None or max(_span(roll), _span(pitch)) > _LEVEL_RAD:
        return None
    attitude, at = attitude[imu.order], imu.times[imu.order]
    known = np.isfinite(attitude).all(axis=1) & (np.abs(np.linalg.norm(attitude, axis=1) - 1.0) < _UNIT)
    if known.sum() < reading.FEWEST_MESSAGES:
        return None
    tilts = rigid.euler_from_quaternions(rigid.multiply_quaternions(attitude[known], turn[None]))[:2]
    low, high = np.quantile(tilts, (0.05, 0.95), axis=1)
    if float((high - low).max()) < 2.0 * _LEAST_RAD:
        return None
    roll, pitch = (np.interp(times, at[known], tilt) for tilt in tilts)
    leaning = rigid.quaternions_from_euler(roll, pitch, yaw)
    if _span(position[:, 2]) == 0.0:
        across = rigid.rotate(leaning, np.broadcast_to([0.0, 0.0, 1.0], position.shape))
        slope = -across[:, :2] / across[:, 2:]
        risen = (0.5 * (slope[1:] + slope[:-1]) * np.diff(position[:, :2], axis=0)).sum(axis=1)
        height = position[0, 2] + np.append(0.0, np.cumsum(np.nan_to_num(risen)))
        position = np.column_stack((position[:, :2], np.where(np.isfinite(position[:, 2]), height, np.nan)))
    return position, leaning, float(np.abs([low, high]).max())


def _span(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.ptp(known)) if known.size else 0.0
