"""Motion of one rigid body by its poses: increments ahead, to the left and of the heading; what fits it.

They are measured over steps of a tenth of a second, or over those of the poses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import polars as pl

from pipeline.core import (
    CONFIDENCE,
    Complex,
    Flags,
    Floats,
    Ints,
    find_scale,
    fit_robustly,
    list_likelihoods,
    recur,
    rigid,
    robust_spread,
    student_quantile,
)
from pipeline.run import LIVE_SHARE

BLOCK_S = 5.0
"""Length of a block [s], longer than any correlation of the noise that is modelled."""
CLEAR = 3.0
"""Least Vuong statistic of a decision."""
LEAST_NATS = 0.02
"""Least gain in log-likelihood per step of a decision: below it a difference is of no importance."""
FEWEST_STEPS = 30
"""Least number of steps for a likelihood."""
_ENOUGH_STEPS = 3 * FEWEST_STEPS
"""Number of steps into which a record is divided at least, where its poses are as many: a signal need not be
recorded beside all of them."""
ONE_SCALE = 0.2
"""Relative spread above which ratios of two speeds do not have one value: a scale is constant, slip is
not."""
DRIVEN_S = 10.0
"""Driving [s] in one of the blocks that the first gain of a fit is compared between: time enough for starts,
stops and turns, so that what differs is not the manoeuvre alone."""
_ROUNDING_S = 1e-6
_NOISES = ((0.0, 0.0), *((phi, theta) for phi in (0.0, 0.4, 0.7, 0.9) for theta in (0.0, 0.3, 0.6, 0.85)
                         if phi != theta))  # fmt: skip
"""Grid of the noise's (phi, theta)."""


_LEAST_FREEDOM = 0.5
"""Least number of degrees of freedom of a spread: with less, one block has more than five times the weight of
the other."""
_LEAST_ERROR = 1e-15
"""Least standard error, to keep quotients finite."""
_ROUNDS = 6
"""Reweightings of a fit."""
_MOST_ROWS = 3000
"""Number of steps above which the noise is fitted to some of the blocks."""


@dataclass(frozen=True)
class Steps:
    """Time steps of a motion, in order.

    Attributes:
        start, end: times [s], shape (n,).
    """

    start: Floats
    end: Floats

    @cached_property
    def fresh(self) -> Flags:
        """Whether a step does not begin where the one before ended, shape (n,)."""
        return np.append(True, np.abs(self.start[1:] - self.end[:-1]) > _ROUNDING_S)

    @cached_property
    def block(self) -> Ints:
        """Number of each step's block, shape (n,)."""
        length = min(BLOCK_S, max(0.4, float(np.ptp(self.start)) / 12.0))
        number = ((self.start - self.start.min()) // length).astype(np.int64)
        return np.unique(number, return_inverse=True)[1]

    def take(self, keep: Flags) -> Steps:
        """Some of the steps."""
        return Steps(self.start[keep], self.end[keep])


@dataclass(frozen=True)
class MotionFit:
    """Regression under correlated noise with heavy tails.

    Attributes:
        gains: coefficients, shape (k,).
        t: their ratios to standard errors that are robust to correlation within blocks, shape (k,).
        blocks: log-likelihood of every block, shape (m,).
        turned: the same with the first coefficient of the other sign.
        spread: half the width of the 95 % interval in which the first coefficient is over ten seconds of
            driving, by how far it is from those of such blocks, see `measure_spread`.
    """

    gains: Floats
    t: Floats
    blocks: Floats
    turned: Floats
    spread: float = math.inf


def _whiten(values: Floats, noise: tuple[float, float], steps: Steps) -> Floats:
    """Innovations u_k = d_k - phi d_(k-1) + theta u_(k-1) of every column, restarted at gaps."""
    phi, theta = noise
    goes_on = ~steps.fresh[1:, None]
    made = np.array(values, dtype=np.float64)
    made[1:] -= np.where(goes_on, phi * values[:-1], 0.0)
    return recur(made, np.where(goes_on[:, 0], theta, 0.0))


def fit(values: Floats, columns: Floats, steps: Steps) -> MotionFit:
    """Fit a channel of the motion by columns.

    Args:
        values: increments, shape (n,).
        columns: explaining increments, shape (n, k); k may be zero.
        steps: the time steps.
    """
    rest = fit_robustly(columns, values, measure=find_scale, rounds=_ROUNDS).rest
    noise, best = _NOISES[0], -np.inf
    # Whole blocks of a long run show its noise.
    some = steps.block % max(1, rest.size // _MOST_ROWS) == 0
    part, few = rest[some][:, None], steps.take(some)
    for each in _NOISES:
        score = float(list_likelihoods(_whiten(part, each, few)[:, 0]).sum())
        if score > best + 2.0:
            noise, best = each, score
    white = _whiten(np.column_stack([values, columns]), noise, steps)
    design = white[:, 1:]
    made = fit_robustly(design, white[:, 0], measure=find_scale, rounds=_ROUNDS)
    gains, rest = made.gains, made.rest
    blocks: Floats = np.bincount(steps.block, list_likelihoods(rest)).astype(np.float64)
    if not gains.size:
        return MotionFit(gains, gains, blocks, blocks)
    error = np.maximum(made.find_errors(design, steps.block), _LEAST_ERROR)
    other = list_likelihoods(rest + 2.0 * gains[0] * design[:, 0])
    turned: Floats = np.bincount(steps.block, other).astype(np.float64)
    spread = measure_spread(values - columns[:, 1:] @ gains[1:], columns[:, 0], float(gains[0]), steps)
    return MotionFit(gains, gains / error, blocks, turned, spread)


def measure_spread(values: Floats, column: Floats, gain: float, steps: Steps) -> float:
    """Half the width of the 95 % interval in which a gain is over another ten seconds of driving.

    Every block of ten seconds has a gain of its own by least squares, which counts by the square of its
    column. What differs between them (slip, limits of the drive, errors of poses) is no noise that averages
    out over a drive: another drive differs as they do.

    Args:
        values: increments, shape (n,).
        column: explaining increments, shape (n,).
        gain: of all increments; the blocks are compared with it, not with their mean.
        steps: the time steps.

    Returns:
        The half width; infinite where less than two blocks count.
    """
    driven = np.cumsum(steps.end - steps.start)
    count = max(2, int(driven[-1] // DRIVEN_S))
    block = np.minimum((count * driven / driven[-1]).astype(np.int64), count - 1)
    power, product = (np.bincount(block, column * one, count) for one in (column, values))
    there = power > 0.0
    own = product[there] / power[there]
    share = power[there] / power.sum()
    freedom = 1.0 / float(share @ share) - 1.0 if there.any() else 0.0
    if freedom < _LEAST_FREEDOM:
        return math.inf
    # Of n blocks the variance has n - 1 degrees of freedom; one more is about their mean by 1 + 1 / n of it.
    variance = float(share @ (own - gain) ** 2) * (freedom + 2.0) / freedom
    return student_quantile(CONFIDENCE, freedom) * math.sqrt(variance)


def measure_share(values: Floats, model: Floats) -> float:
    """Part of the size of some increments that a model explains, outliers discounted, from 0 to 1."""
    return 1.0 - min(1.0, (find_scale(values - model) / find_scale(values)) ** 2)


def find_one_ratio(moved: Floats, driven: Floats, fewest: int) -> float | None:
    """Median of one speed over another; None if the ratio is not constant.

    Args:
        moved: shape (n,); NaN where unknown.
        driven: in the same order, which counts where it is well above that of standing.
        fewest: least number of samples that count.
    """
    size = np.where(np.isfinite(moved), np.nan_to_num(np.abs(driven)), 0.0)
    live = size > LIVE_SHARE * float(np.max(size, initial=0.0))
    if live.sum() < fewest:
        return None
    ratio = moved[live] / driven[live]
    middle = float(np.median(ratio))
    return middle if robust_spread(ratio - middle) <= ONE_SCALE * abs(middle) else None


def compare(one: Floats, other: Floats) -> float:
    """Vuong's statistic of two readings by their likelihoods in blocks; positive if the first is likelier."""
    gain = one - other
    gain = gain[gain != 0.0]
    return 0.0 if gain.size < 4 else float(gain.sum() / (np.sqrt(gain.size) * gain.std() + 1e-9))  # noqa: PLR2004


STEP_S = 0.1
_Z = 2
_STEEPEST = math.sqrt(0.5)
"""Cosine of the angle by which no ground tilts a vehicle: 45 degrees, over both sides of a hill."""
_PLANES = ((1, 2), (0, 2), (0, 1))
"""Axes of the plane across each axis, the body's own x first where it lies in the plane."""


@dataclass(frozen=True)
class Motion:
    """Increments of a pose.

    Attributes:
        steps: the time steps, n of them.
        moved: displacements in the plane of motion, shape (n,), as complex numbers [m].
        middle: recorded heading in the middle of each step [rad].
        turned: change of the recorded heading [rad].
        up: axis across the plane of motion, ``x``, ``y`` or ``z``; whether it points up, other signals tell.
        flip: whether the heading is read the other way round.
        offset_deg: angle that is added to the heading.
    """

    steps: Steps
    moved: Complex
    middle: Floats
    turned: Floats
    up: str
    flip: bool = False
    offset_deg: float = 0.0

    @property
    def is_known(self) -> bool:
        """Whether there is any."""
        return self.moved.size > 0

    @property
    def body(self) -> Complex:
        """Displacements in the vehicle's frame [m]: ahead + 1j * left."""
        sense = -1.0 if self.flip else 1.0
        body: Complex = self.moved * np.exp(-1j * (sense * self.middle + np.radians(self.offset_deg)))
        return body

    @property
    def yaw(self) -> Floats:
        """Changes of the heading [rad]."""
        return -self.turned if self.flip else self.turned

    @property
    def rates(self) -> tuple[Floats, Floats]:
        """Times in the middle of the steps [s], shape (n,), and velocities of the body, shape (n, 3).

        Each is the mean over three steps: that of one is mostly noise of the poses.
        """
        elapsed = self.steps.end - self.steps.start
        moved = (part / elapsed for part in (self.body.real, self.body.imag, self.yaw))
        velocity = [np.convolve(rate, np.full(3, 1.0 / 3.0), "same") for rate in moved]
        return 0.5 * (self.steps.start + self.steps.end), np.column_stack(velocity)

    def turn(self, *, flip: bool, offset_deg: float) -> Motion:
        """The same poses in another frame."""
        return replace(self, flip=flip, offset_deg=offset_deg)

    def take(self, keep: Flags) -> Motion:
        """Some of the steps."""
        return replace(
            self,
            steps=self.steps.take(keep),
            moved=self.moved[keep],
            middle=self.middle[keep],
            turned=self.turned[keep],
        )

    def find_course_deg(self) -> tuple[float, float]:
        """Angle from the heading to the axis along which the body moves, modulo 180, and its concentration.

        The concentration is 1 where all motion is along one axis, and 0 without one.
        """
        power = float((np.abs(self.moved) ** 2).sum())
        moment = ((self.moved * np.exp(-1j * self.middle)) ** 2).sum()
        return float(np.degrees(0.5 * np.angle(moment))), float(abs(moment)) / max(power, 1e-12)


_NOTHING: Floats = np.zeros(0)
NO_MOTION = Motion(Steps(_NOTHING, _NOTHING), np.zeros(0, dtype=np.complex128), _NOTHING, _NOTHING, "z")
"""A motion of which too little is recorded."""


def measure_motion(poses: pl.DataFrame, *, is_level: bool = False) -> Motion:
    """Increments of the poses over steps of a tenth of a second or of their period.

    Args:
        poses: table `poses` as extracted.
        is_level: whether the plane of motion is across z, whatever the poses show.

    Returns:
        The motion; `NO_MOTION` with fewer than thirty steps.
    """
    fresh = poses.filter(
        ~pl.col("held") & pl.col("x").is_finite() & pl.col("q_w").is_finite() & pl.col("active")
    )
    if fresh.height <= FEWEST_STEPS:
        return NO_MOTION
    time = fresh["t"].to_numpy()
    position = fresh.select("x", "y", "z").to_numpy()
    quaternion = fresh.select("q_x", "q_y", "q_z", "q_w").to_numpy()
    period = float(np.median(np.diff(time)))
    length = find_step(time[-1] - time[0], period)
    rows = _choose_rows(time, 0.95 * length)
    if len(rows) <= FEWEST_STEPS:
        return NO_MOTION
    time, position, quaternion = time[rows], position[rows], quaternion[rows]
    segment = fresh["segment"].to_numpy()[rows]
    axis, up, yaw = _find_plane(position, quaternion, is_level=is_level)
    first, second = _PLANES[axis]
    # A positive turn about y leads from x to -z.
    plane = position[:, first] + (-1j if axis == 1 else 1j) * position[:, second]
    elapsed, moved, turned = np.diff(time), np.diff(plane), np.diff(yaw)
    whole = (elapsed > 0.3 * length) & (elapsed < 3.0 * length) & (np.diff(segment) == 0)
    if whole.sum() < FEWEST_STEPS:
        return NO_MOTION
    speed = np.abs(moved) / np.maximum(elapsed, 1e-3)
    fastest = 20.0 * max(float(np.quantile(speed[whole], 0.9)), 0.02)
    sane = whole & (speed < fastest) & (np.abs(turned) < 12.0 * elapsed)
    if sane.sum() < FEWEST_STEPS:
        return NO_MOTION
    middle = yaw[:-1] + 0.5 * turned
    return Motion(
        Steps(time[:-1][sane], time[1:][sane]),
        moved[sane],
        middle[sane],
        turned[sane],
        up,
    )


def find_step(lasted: float, period: float = 0.0) -> float:
    """Length of the steps [s] of a record: of a short one they are shorter, so that they are enough.

    Their noise is fitted, whatever their length.

    Args:
        lasted: from its first to its last message [s].
        period: of its messages [s], below which no step says more; zero of what holds in between.
    """
    return max(period, min(STEP_S, lasted / _ENOUGH_STEPS))


def _choose_rows(time: Floats, length: float) -> list[int]:
    """Rows that are at least a length apart [s]."""
    rows = [0]
    for row, at in enumerate(time.tolist()):
        if at - time[rows[-1]] >= length:
            rows.append(row)
    return rows


def _find_plane(position: Floats, quaternion: Floats, *, is_level: bool) -> tuple[int, str, Floats]:
    """Index of the axis across the plane of motion, its name, and the headings about it.

    The usual axis is z. Another one counts if the body turns most about it and moves along it least, and no
    ground would be so steep about z.
    """
    change = rigid.multiply_quaternions(quaternion[1:], rigid.invert_quaternions(quaternion[:-1]))
    rotation = 2.0 * change[:, :3] * np.sign(change[:, 3:])
    turning = (np.clip(rotation, -0.5, 0.5) ** 2).sum(axis=0)
    apart = min(8, position.shape[0] // 4)
    extent = np.quantile(np.abs(position[apart:] - position[:-apart]), 0.8, axis=0)
    axis = int(np.argmax(turning))
    # The cosine of the angle by which the body has leant since the first pose.
    since = rigid.multiply_quaternions(quaternion, rigid.invert_quaternions(quaternion[:1]))
    tilted = float(np.quantile(rigid.find_heights(since), 0.05))
    is_steep = tilted < _STEEPEST or extent[_Z] > math.hypot(extent[0], extent[1])
    if axis != _Z and (is_level or not (is_steep and int(np.argmin(extent)) == axis)):
        axis = _Z
    if axis == _Z:
        yaw = rigid.euler_from_quaternions(quaternion)[2]
    else:
        yaw = 2.0 * np.arctan2(quaternion[:, axis], quaternion[:, 3])
    return axis, "xyz"[axis], np.unwrap(yaw)
