"""Cutting a series of poses where something broke: holes in time, jumps of the pose.

A segment is a stretch in which time runs forward without a hole and the pose moves continuously. Nothing is
interpolated or differentiated across a segment's ends.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.core import rigid
from pipeline.core.arrays import Flags, Floats, Ints, group_rows

if TYPE_CHECKING:
    import polars as pl
    from numpy.typing import NDArray

_GAUSSIAN = 1.4826
_SIDE = 4
_STEP = np.repeat([-0.5, 0.5], _SIDE)
_PLAINLY = 3.0
_LONGEST_WAIT = 1.0
_ROUNDING_S = 1e-6
_COLUMNS = ("t", "stamp", "segment", "held", "active", "latency", "outlier")


def find_gaps(times: Floats, smallest: float) -> Flags:
    """Whether a hole in time lies before each sample.

    A hole is longer than three median periods and than ``smallest`` [s].

    Args:
        times: sample times [s], shape (n,), increasing.
        smallest: the shortest hole that counts [s].

    Returns:
        Flags of shape (n,); the first is False.
    """
    if times.size < 2:  # noqa: PLR2004 - one sample has no period
        return np.zeros(times.size, dtype=bool)
    period = np.diff(times)
    limit = max(3.0 * float(np.median(period)), smallest)
    return np.concatenate(([False], period > limit * (1.0 + 1e-9)))


def find_held(position: Floats, quaternion: Floats) -> Flags:
    """Whether each pose repeats the one before it exactly; shapes (n, 3), (n, 4) -> (n,)."""
    same = np.all(np.diff(position, axis=0) == 0.0, axis=1) & np.all(
        np.diff(quaternion, axis=0) == 0.0, axis=1
    )
    return np.concatenate((np.zeros(min(1, position.shape[0]), dtype=bool), same))


def select_fresh_poses(times: Floats, held: Flags) -> Ints:
    """Indices of the poses that carry information: those that changed, and those of a vehicle at rest.

    A localization slower than its topic repeats its last estimate; such repeats are dropped. A vehicle that
    stands still repeats its pose too, for longer than the localization ever waits: those repeats are kept,
    but for the last waiting time before the next change, which may be old again.

    Args:
        times: sample times [s], shape (n,).
        held: repeats of the pose before, shape (n,).
    """
    fresh = np.flatnonzero(~held)
    if fresh.size == held.size:
        return fresh.astype(np.int64)
    if fresh.size < 3:  # noqa: PLR2004 - too few changes to know the waiting time
        stood = times[-1] - times[0] > _LONGEST_WAIT
        return np.arange(held.size, dtype=np.int64) if stood else fresh.astype(np.int64)
    waits = np.diff(times[fresh])
    longest_wait = 3.0 * float(np.median(waits))
    previous = np.maximum.accumulate(np.where(held, 0, np.arange(held.size)))
    following = np.searchsorted(fresh, np.arange(held.size), side="right")
    # Nobody saw the next change after the last repeat: it may have come at once.
    next_fresh = np.append(times[fresh], times[-1])[following]
    # Stamps on a raster meet these bounds exactly: rounding must not decide.
    stands = held & (next_fresh - times[previous] > longest_wait + _ROUNDING_S)
    old_again = next_fresh - times < float(np.median(waits)) * 1.5 - _ROUNDING_S
    return np.flatnonzero(~held | (stands & ~old_again)).astype(np.int64)


def find_jumps(
    times: Floats, position: Floats, quaternion: Floats, *, metres: float, radians: float
) -> Flags:
    """Whether the pose jumps before each sample: a correction of the map, not a motion.

    A jump stays; vibration, and poses that are stamped late, come back. So the body's own odometer over four
    poses before and four after is fitted by a straight line with a step in the middle. The step counts where
    it exceeds eight robust standard deviations of all such steps, and the given floor plus the way travelled
    in one and a half pose periods (a pose that a slow localization left out looks like that), and where a
    bend, as of a vehicle that turns round at once, does not explain the poses far better.

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
        limit = np.maximum(8.0 * _GAUSSIAN * float(np.median(size)), floor + skipped)
        # The fits around a jump see it too; the jump is where the step is largest.
        padded = np.pad(size, _SIDE - 1)
        tallest = np.lib.stride_tricks.sliding_window_view(padded, 2 * _SIDE - 1).max(axis=1)
        large = np.flatnonzero((size > limit) & (size >= tallest))
        flags[_SIDE + large[_is_stepped(along[large], ways[large])]] = True
    return flags


def _cut_windows(times: Floats, increment: Floats) -> tuple[Floats, Floats]:
    """Times (n - 7, 8) and odometer (n - 7, 3, 8) of every 2 x 4 neighbouring poses, about their means."""
    odometer = np.concatenate((np.zeros((1, 3)), np.cumsum(increment, axis=0)))
    ways = np.lib.stride_tricks.sliding_window_view(odometer, 2 * _SIDE, axis=0)
    stamps = np.lib.stride_tricks.sliding_window_view(times, 2 * _SIDE)
    return stamps - stamps.mean(axis=1, keepdims=True), ways - ways.mean(axis=2, keepdims=True)


def _is_stepped(along: Floats, ways: Floats) -> Flags:
    """Whether no bend explains a window far better: a vehicle that starts, stops or turns round bends it."""
    middle = 0.5 * (along[:, _SIDE - 1] + along[:, _SIDE])
    bend = np.abs(along - middle[:, None])
    bend = bend - bend.mean(axis=1, keepdims=True)
    return _measure_rest(along, _STEP, ways) < _PLAINLY * _measure_rest(along, bend, ways)


def _fit_beside_line(along: Floats, shape: Floats, ways: Floats) -> tuple[Floats, Floats]:
    """Coefficients (n, 3) of a shape (n, w) or (w,) and of the line beside it in windows (n, 3, w)."""
    # Frisch and Waugh: the shape's coefficient is that of the shape cleared of the line.
    overlap = np.sum(along * shape, axis=1) / np.sum(along**2, axis=1)
    cleared = shape - along * overlap[:, None]
    size = np.einsum("nw,ncw->nc", cleared, ways) / np.sum(cleared**2, axis=1)[:, None]
    slope = np.einsum("nw,ncw->nc", along, ways) / np.sum(along**2, axis=1)[:, None]
    return size, slope - size * overlap[:, None]


def _measure_rest(along: Floats, shape: Floats, ways: Floats) -> Floats:
    """Squares (n,) that a shape and the line beside it leave in windows (n, 3, w)."""
    size, slope = _fit_beside_line(along, shape, ways)
    shape = np.broadcast_to(shape, along.shape)
    left: Floats = ways - size[:, :, None] * shape[:, None, :] - slope[:, :, None] * along[:, None, :]
    rest: Floats = np.sum(left**2, axis=(1, 2))
    return rest


def measure_increments(position: Floats, quaternion: Floats) -> tuple[Floats, Floats]:
    """Body-frame increments between consecutive poses, as constant twists over each interval.

    The logarithm on SE(3): moving with the returned twist for one interval leads exactly from one pose to
    the next, so a circle gives no false lateral motion (start-frame differencing would add dt v w / 2).

    Args:
        position: shape (n, 3) [m].
        quaternion: shape (n, 4), unit length.

    Returns:
        Translations [m] and rotations [rad] in the body frame, each of shape (n - 1, 3).
    """
    inverse = rigid.invert_quaternions(quaternion[:-1])
    turn = rigid.rotation_vectors(rigid.multiply_quaternions(inverse, quaternion[1:]))
    moved = rigid.rotate(inverse, np.diff(position, axis=0))
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
    """Segment number of each sample from flags that say a break lies before it."""
    return np.cumsum(breaks, dtype=np.int64)


def find_runs(flags: Flags) -> list[tuple[int, int]]:
    """Stretches of True as (first, one past last) index pairs."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], flags.astype(np.int8), [0]))))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def cut_segments(poses: pl.DataFrame) -> list[dict[str, NDArray[Any]]]:
    """Table `poses` segment by segment in order of time, by column.

    Besides its own columns, as far as it has them, each has ``position``, shape (n, 3) [m], and
    ``quaternion``, shape (n, 4).
    """
    poses = poses.sort("segment", "t")
    columns = {name: poses[name].to_numpy() for name in _COLUMNS if name in poses.columns}
    columns["position"] = np.ascontiguousarray(poses.select("x", "y", "z").to_numpy())
    columns["quaternion"] = np.ascontiguousarray(poses.select("q_x", "q_y", "q_z", "q_w").to_numpy())
    return [
        {name: values[rows] for name, values in columns.items()} for rows in group_rows(columns["segment"])
    ]
