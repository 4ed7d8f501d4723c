"""Rigid motions in the plane and in space, and segmentation of pose series."""

from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from pipeline.core.arrays import ROUNDING_S, Flags, Floats, Ints, group_rows, robust_spread

# Rigid motions in the plane and in space, vectorised over the first axis.
#
# Quaternions are (x, y, z, w), unit length, and rotate vectors of the child frame into the parent frame, as
# in ROS messages. Angles are in radians. SciPy's `Rotation` refuses a quaternion of zeros, which is what an
# unset orientation has: what takes quaternions of a log is written out here.

GRAVITY_MPS2 = 9.80665
"""Standard gravity [m/s^2] (ISO 80000-3)."""
_TINY = 1e-12
"""Angle [rad] below which the first term of a series is exact to rounding."""


def wrap_angle(angle: Floats) -> Floats:
    """Bring angles [rad] into (-pi, pi]."""
    return np.pi - np.mod(np.pi - angle, 2.0 * np.pi)


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


def find_heights(quaternion: Floats) -> Floats:
    """Heights of z axes, from -1 to 1, of unit quaternions of shape (..., 4)."""
    return np.asarray(1.0 - 2.0 * (quaternion[..., 0] ** 2 + quaternion[..., 1] ** 2))


def rotate(quaternion: Floats, vector: Floats) -> Floats:
    """Rotate vectors (n, 3) by unit quaternions (n, 4)."""
    axis, scalar = quaternion[..., :3], quaternion[..., 3:]
    twice = 2.0 * np.cross(axis, vector)
    return vector + scalar * twice + np.cross(axis, twice)


def rotation_vectors(quaternion: Floats) -> Floats:
    """Logarithm of unit quaternions (n, 4): rotation vectors (n, 3) [rad] of at most pi."""
    flipped = np.where(quaternion[..., 3:] < 0.0, -quaternion, quaternion)
    sine = np.linalg.norm(flipped[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, flipped[..., 3:])
    scale = np.where(sine > _TINY, angle / np.maximum(sine, _TINY), 2.0)
    return flipped[..., :3] * scale


def quaternions_from_vectors(vector: Floats) -> Floats:
    """Exponential of rotation vectors (n, 3) [rad]: unit quaternions (n, 4)."""
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    # NumPy's sinc is that of pi x.
    return np.concatenate((0.5 * np.sinc(angle / (2.0 * np.pi)) * vector, np.cos(0.5 * angle)), axis=-1)


def quaternions_from_yaw(yaw: Floats) -> Floats:
    """Unit quaternions (n, 4) of rotations about z by ``yaw`` [rad], shape (n,)."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - heavy

    return np.asarray(Rotation.from_euler("z", yaw[..., None]).as_quat())


def quaternions_from_euler(roll: Floats, pitch: Floats, yaw: Floats) -> Floats:
    """Unit quaternions (n, 4) of intrinsic z-y-x rotations (yaw, then pitch, then roll) [rad]."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - heavy

    return np.asarray(Rotation.from_euler("ZYX", np.stack((yaw, pitch, roll), axis=-1)).as_quat())


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
    before = np.clip(np.searchsorted(times, at, side="right") - 1, 0, times.size - 2)
    span = times[before + 1] - times[before]
    fraction = np.clip((at - times[before]) / span, 0.0, 1.0)
    between = position[before] + (position[before + 1] - position[before]) * fraction[:, None]
    return between, slerp(quaternion[before], quaternion[before + 1], fraction)


# Segmentation of a series of poses at gaps in time and jumps of the pose.
#
# In a segment, time increases without a gap and the pose is continuous. Nothing is interpolated or
# differentiated across the ends of a segment.

_SIDE = 4
"""Number of poses on each side of a jump: with two, a line and a step use three of the four degrees of
freedom."""
_STEP = np.repeat([-0.5, 0.5], _SIDE)
_PLAINLY = 3.0
"""Ratio of the squared residuals of a step to those of a bend above which it is a bend; half or double change
no finding of three recordings (`make bench NAME=constants`)."""
LONGEST_WAIT_S = 1.5
"""Longest time between two poses of a waiting localization [s]; above it, waiting and a vehicle at rest are
not distinguishable. On the recordings 99 of 100 times are at most 1.2 s. Half and double change no finding of
two recordings."""
_FEWEST_CORRECTIONS = 10
"""Minimum number of corrections of a localization for a period."""
_RARE_S = 10.0
"""Time between corrections [s] above which they are events, as loop closures, and no noise."""
_COLUMNS = ("t", "stamp", "segment", "held", "active", "latency", "outlier")


_LONGEST_GAP_S = 10.0
"""Longest time between two samples of one segment [s]: nothing is known of the motion in between, and a grid
laid over it would grow with the time, not with the samples."""


def find_gaps(times: Floats, smallest: float) -> Flags:
    """Whether a gap in time precedes each sample.

    A gap is longer than three median periods and than ``smallest`` [s], or than `_LONGEST_GAP_S`.

    Args:
        times: sample times [s], shape (n,), increasing.
        smallest: minimum length of a gap [s].

    Returns:
        Flags of shape (n,); the first is False.
    """
    if times.size < 2:  # noqa: PLR2004 - one sample has no period
        return np.zeros(times.size, dtype=bool)
    period = np.diff(times)
    limit = max(min(3.0 * float(np.median(period)), _LONGEST_GAP_S), smallest)
    return np.concatenate(([False], period > limit * (1.0 + 1e-9)))


def find_held(position: Floats, quaternion: Floats) -> Flags:
    """Whether each pose is identical to the previous one; shapes (n, 3), (n, 4) -> (n,)."""
    same = np.all(np.diff(position, axis=0) == 0.0, axis=1) & np.all(
        np.diff(quaternion, axis=0) == 0.0, axis=1
    )
    return np.concatenate((np.zeros(min(1, position.shape[0]), dtype=bool), same))


def select_fresh_poses(times: Floats, held: Flags) -> Ints:
    """Indices of the poses that carry information: those that changed, and those of a vehicle at rest.

    A localization slower than its topic repeats its last estimate; such repeats are dropped. A vehicle at
    rest also repeats its pose, for longer than any wait of the localization: these repeats are retained,
    except in the last waiting time before the next change, where they may be outdated.

    Args:
        times: sample times [s], shape (n,).
        held: whether each pose repeats the previous one, shape (n,).
    """
    fresh = np.flatnonzero(~held)
    if fresh.size == held.size:
        return fresh.astype(np.int64)
    if fresh.size < 3:  # noqa: PLR2004 - too few changes to know the waiting time
        stood = times[-1] - times[0] > LONGEST_WAIT_S
        return np.arange(held.size, dtype=np.int64) if stood else fresh.astype(np.int64)
    waits = np.diff(times[fresh])
    longest_wait = 3.0 * float(np.median(waits))
    previous = np.maximum.accumulate(np.where(held, 0, np.arange(held.size)))
    following = np.searchsorted(fresh, np.arange(held.size), side="right")
    # The next change after the last repeat is not recorded: it may follow at once.
    next_fresh = np.append(times[fresh], times[-1])[following]
    # Stamps on a raster coincide with these bounds: the result must not depend on rounding.
    stands = held & (next_fresh - times[previous] > longest_wait + ROUNDING_S)
    old_again = next_fresh - times < float(np.median(waits)) * 1.5 - ROUNDING_S
    return np.flatnonzero(~held | (stands & ~old_again)).astype(np.int64)


def find_jumps(
    times: Floats, position: Floats, quaternion: Floats, *, metres: float, radians: float
) -> Flags:
    """Whether the pose jumps before each sample: a correction of the map, not a motion.

    A jump is permanent; vibration and late stamps are not. A straight line with a step in the middle is
    therefore fitted to the sum of body increments over four poses before and four after. The step is a jump
    if it exceeds both eight robust standard deviations of all such steps and the given minimum plus the
    distance travelled in one and a half pose periods (the effect of a pose that a slow localization omits),
    and if a bend, as of a vehicle that reverses at once, does not explain the poses far better.

    Args:
        times: sample times [s], shape (n,), strictly increasing.
        position: shape (n, 3) [m].
        quaternion: shape (n, 4), unit length.
        metres: smallest translation that counts as a jump [m].
        radians: smallest rotation that counts as a jump [rad].

    Returns:
        Flags of shape (n,); False for the first and last poses that lack neighbours.
    """
    flags = np.zeros(times.size, dtype=bool)
    if times.size < 2 * _SIDE:
        return flags
    move, turn = measure_increments(position, quaternion)
    for increment, floor in ((move, metres), (turn, radians)):
        along, ways = _cut_windows(times, increment)
        step, rate = _fit_beside_line(along, _STEP, ways)
        size = np.linalg.norm(step, axis=1)
        skipped = 1.5 * float(np.median(np.diff(times))) * np.linalg.norm(rate, axis=1)
        limit = np.maximum(8.0 * robust_spread(size), floor + skipped)
        # Fits near a jump contain it too; the jump is at the largest step.
        padded = np.pad(size, _SIDE - 1)
        tallest = np.lib.stride_tricks.sliding_window_view(padded, 2 * _SIDE - 1).max(axis=1)
        large = np.flatnonzero((size > limit) & (size >= tallest))
        flags[_SIDE + large[_is_stepped(along[large], ways[large])]] = True
    return flags


def _cut_windows(times: Floats, increment: Floats) -> tuple[Floats, Floats]:
    """Times (n - 7, 8) and odometer (n - 7, 3, 8) of all 2 x 4 consecutive poses, without their means."""
    odometer = np.concatenate((np.zeros((1, 3)), np.cumsum(increment, axis=0)))
    ways = np.lib.stride_tricks.sliding_window_view(odometer, 2 * _SIDE, axis=0)
    stamps = np.lib.stride_tricks.sliding_window_view(times, 2 * _SIDE)
    return stamps - stamps.mean(axis=1, keepdims=True), ways - ways.mean(axis=2, keepdims=True)


def _is_stepped(along: Floats, ways: Floats) -> Flags:
    """Whether no bend explains a window far better: a vehicle that starts, stops or reverses makes a bend."""
    middle = 0.5 * (along[:, _SIDE - 1] + along[:, _SIDE])
    bend = np.abs(along - middle[:, None])
    bend = bend - bend.mean(axis=1, keepdims=True)
    return _measure_rest(along, _STEP, ways) < _PLAINLY * _measure_rest(along, bend, ways)


def _fit_beside_line(along: Floats, shape: Floats, ways: Floats) -> tuple[Floats, Floats]:
    """Coefficients (n, 3) of a shape (n, w) or (w,) and of a line, fitted jointly to windows (n, 3, w)."""
    # Frisch and Waugh: the coefficient of the shape is that of its residual from the line.
    overlap = np.sum(along * shape, axis=1) / np.sum(along**2, axis=1)
    cleared = shape - along * overlap[:, None]
    size = np.einsum("nw,ncw->nc", cleared, ways) / np.sum(cleared**2, axis=1)[:, None]
    slope = np.einsum("nw,ncw->nc", along, ways) / np.sum(along**2, axis=1)[:, None]
    return size, slope - size * overlap[:, None]


def _measure_rest(along: Floats, shape: Floats, ways: Floats) -> Floats:
    """Sum of squared residuals (n,) of a shape and a line in windows (n, 3, w)."""
    size, slope = _fit_beside_line(along, shape, ways)
    shape = np.broadcast_to(shape, along.shape)
    remaining: Floats = ways - size[:, :, None] * shape[:, None, :] - slope[:, :, None] * along[:, None, :]
    rest: Floats = np.sum(remaining**2, axis=(1, 2))
    return rest


def measure_increments(position: Floats, quaternion: Floats, places: int = 1) -> tuple[Floats, Floats]:
    """Body-frame increments between poses, as constant twists over each interval.

    The logarithm on SE(3): moving with the returned twist for one interval leads exactly from one pose to
    the next, so a circle gives no false lateral motion (start-frame differencing would add dt v w / 2).

    Args:
        position: shape (n, 3) [m].
        quaternion: shape (n, 4), unit length.
        places: from each pose to the other one: one if they follow each other.

    Returns:
        Translations [m] and rotations [rad] in the body frame, each of shape (n - places, 3).
    """
    inverse = invert_quaternions(quaternion[:-places])
    turn = rotation_vectors(multiply_quaternions(inverse, quaternion[places:]))
    moved = rotate(inverse, position[places:] - position[:-places])
    angle = np.linalg.norm(turn, axis=1, keepdims=True)
    # Inverse left Jacobian of SO(3) (Sola et al., arXiv:1812.01537, eq. 146), with its series near zero.
    safe = np.maximum(angle, 1e-4)
    third = np.where(
        angle < 1e-4,  # noqa: PLR2004 - below it the series is exact to rounding
        1.0 / 12.0,
        1.0 / safe**2 - 1.0 / (2.0 * safe * np.tan(safe / 2.0)),
    )
    half = np.cross(turn, moved)
    return moved - 0.5 * half + third * np.cross(turn, half), turn


def number_segments(breaks: Flags) -> Ints:
    """Segment number of each sample from flags of a break before it."""
    return np.cumsum(breaks, dtype=np.int64)


def find_runs(flags: Flags) -> list[tuple[int, int]]:
    """Stretches of True as (first, one past last) index pairs."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], flags.astype(np.int8), [0]))))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def cut_segments(poses: pl.DataFrame) -> list[dict[str, NDArray[Any]]]:
    """Columns of table `poses` for each segment, in order of time.

    Besides the columns that the table contains, each segment has ``position``, shape (n, 3) [m], and
    ``quaternion``, shape (n, 4).
    """
    poses = poses.sort("segment", "t")
    columns = {name: poses[name].to_numpy() for name in _COLUMNS if name in poses.columns}
    columns["position"] = np.ascontiguousarray(poses.select("x", "y", "z").to_numpy())
    columns["quaternion"] = np.ascontiguousarray(poses.select("q_x", "q_y", "q_z", "q_w").to_numpy())
    return [
        {name: values[rows] for name, values in columns.items()} for rows in group_rows(columns["segment"])
    ]


def measure_period(times: Floats) -> float:
    """Median time between the corrections of a localization [s]; zero if they are few, or rare.

    Args:
        times: of the corrections [s], shape (n,).
    """
    period = float(np.median(np.diff(times))) if times.size >= _FEWEST_CORRECTIONS else 0.0
    return period if period < _RARE_S else 0.0
