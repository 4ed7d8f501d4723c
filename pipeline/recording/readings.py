"""Signals that may explain a motion: a command, the wheels or a gyro, with free gains and a free delay.

A reading has two inputs: speed and yaw rate of a body, speeds of the left and the right wheels, or speed and
steering angle. They are held on a fine grid, delayed, and integrated over the steps of the motion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.core import Complex, Flags, Floats, join_parts, recur
from pipeline.recording.motion import (
    CLEAR,
    FEWEST_STEPS,
    LEAST_NATS,
    NO_MOTION,
    Motion,
    MotionFit,
    Steps,
    compare,
    fit,
    measure_share,
)

GRID_S = 0.02
_SLOW_S = 0.4
"""Period [s] from which on a signal may be sent on changes only: then it holds until the next one."""
_FEWEST_CHANGES = 4
"""Least number of messages of a command: a start and a stop ahead, and of a turn."""
_LEAST = 1e-6
"""Size up to which a value is rounding in any unit, as 4e-9 m/s ahead of a base that goes to its side."""
_FEW_CELLS = 2.0
"""Cells of the grid without a signal that are no gap."""
_LONGEST_S = 6.0 * 3600.0
"""Distance [s] from the middle message beyond which a stamp is wrong, or more of a drive adds nothing."""
SIDES = ("left", "right")
DELAYS_S = np.arange(-0.3, 0.81, 0.05)
_LAGS_S = (0.0, 0.08, 0.16, 0.25, 0.35, 0.5, 0.8)
_MOST_ROWS = 2000
"""Number of steps on which delays are compared first."""
_PARTS = 10
"""Parts of a drive, of equal path, among which a gain is looked for that changes during it."""
_FEWEST_PARTS = 3
"""Least number of them on either side of a change: one may be that in which it lies."""
_VARIES = 0.5 * math.log(2.0)
"""Logarithm up to which gains of one side differ; those of both sides are apart by a factor of two."""


class Held:
    """A signal, held between its samples, and its integrals after a first-order lag and a delay.

    Args:
        times: increasing [s], shape (n,).
        values: NaN where unknown, shape (n,).
        may_stand: whether one value throughout says something, as that of a command does.
        counts: whether the vehicle is driven by its commands, shape (n,); throughout if it is not given.
    """

    def __init__(
        self, times: Floats, values: Floats, *, may_stand: bool = False, counts: Flags | None = None
    ) -> None:
        known = np.isfinite(values)
        if known.any():
            known &= np.abs(times - np.median(times[known])) < _LONGEST_S
        self.times, self.values = times[known], values[known]
        live = np.ones(self.values.size, dtype=bool) if counts is None else counts[known]
        self.live, self.may_stand = live, may_stand
        read = self.values[live]
        # A command that is sent on changes only has few messages, and says something all the time.
        enough = read.size >= (_FEWEST_CHANGES if may_stand else FEWEST_STEPS)
        self.is_constant = not (enough and bool(np.ptp(read) > _LEAST))
        self.moves = not self.is_constant or (enough and may_stand and bool((np.abs(read) > _LEAST).any()))
        self._sums: dict[float, Floats] = {}
        self._is_known = enough
        if not enough:
            return
        self._start = float(self.times[0]) - 1.0
        grid = np.arange(self._start, self.times[-1] + 2.0, GRID_S)
        before = np.searchsorted(self.times, grid, side="right") - 1
        period = float(np.median(np.diff(self.times)))
        is_steady = period < _SLOW_S and self.times.size > 2 * FEWEST_STEPS
        longest = max(0.6, 6.0 * period) if is_steady else np.inf
        last = np.maximum(before, 0)
        missing = (before < 0) | (grid - self.times[last] > longest) | ~live[last]
        self._missing = np.append(0.0, np.cumsum(missing))
        self.grid = np.where(before < 0, 0.0, self.values[last])

    @property
    def held_share(self) -> float:
        """Fraction of the samples of a moving signal that repeat the one before."""
        moving = self.values[1:] != 0.0
        return float(np.mean(np.diff(self.values)[moving] == 0.0)) if moving.any() else 1.0

    def is_there(self, steps: Steps) -> Flags:
        """Whether the signal is recorded over each step and .4 s before."""
        if not self._is_known:
            return np.zeros(steps.start.size, dtype=bool)
        index = np.arange(self._missing.size)
        first, last = (
            np.interp((at - self._start) / GRID_S, index, self._missing)
            for at in (steps.start - 0.4, steps.end)
        )
        inside = (steps.start >= self.times[0]) & (steps.end <= self.times[-1] + 1.0)
        return np.asarray((last - first < _FEW_CELLS) & inside)

    def lagged(self, lag: float) -> Floats:
        """The signal on its grid after a first-order lag."""
        return follow(self.grid, lag)

    def forget(self) -> None:
        """Free the integrals, one for every lag that was tried: of many long signals they fill the memory."""
        self._sums.clear()

    def integrate(self, steps: Steps, lag: float, delay: float | Floats) -> Floats:
        """Integral over each step, shape (n,), or after each of some delays of shape (k, 1), shape (k, n)."""
        if lag not in self._sums:
            self._sums[lag] = np.append(0.0, np.cumsum(self.lagged(lag))) * GRID_S
        total = self._sums[lag]
        return _look_up(total, (steps.end - delay - self._start) / GRID_S) - _look_up(
            total, (steps.start - delay - self._start) / GRID_S
        )


NO_SIGNAL = Held(np.zeros(0), np.zeros(0))
"""A signal that is not recorded."""


def follow(values: Floats, lag: float) -> Floats:
    """First-order lag on the grid, without the delay of half a cell that a filter of held values has."""
    if lag <= 0.0:
        return values
    share = math.exp(-GRID_S / lag)
    made = recur((1.0 - share) * values, np.full(values.size - 1, share))
    made[1:] = 0.5 * (made[1:] + made[:-1])
    return made


def _look_up(total: Floats, at: Floats) -> Floats:
    at = np.clip(at, 0.0, total.size - 1.001)
    cell = at.astype(np.int64)
    return np.asarray(total[cell] + (at - cell) * (total[cell + 1] - total[cell]))


class Bent(Held):
    """Speed times the tangent of a steering angle, each lagged before the product."""

    def __init__(self, speed: Held, times: Floats, angle: Floats) -> None:
        self._recorded = times, angle
        self._angle = Held(times, angle)
        self.__dict__.update({key: value for key, value in vars(speed).items() if key != "_sums"})
        self._sums = {}
        self._speed = speed
        self.moves = speed.moves and self._angle.moves
        self.is_constant = speed.is_constant and self._angle.is_constant
        if self.moves:
            at = np.searchsorted(
                self._angle.times, self._start + GRID_S * np.arange(speed.grid.size), side="right"
            )
            self._bent = np.where(at > 0, self._angle.values[np.maximum(at - 1, 0)], 0.0)

    def rescale(self, factor: float) -> Bent:
        """The same with an angle in another unit."""
        times, angle = self._recorded
        return Bent(self._speed, times, factor * angle)

    def drive(self, speed: Held) -> Bent:
        """The same with another speed."""
        return Bent(speed, *self._recorded)

    def lagged(self, lag: float) -> Floats:
        """The product on the grid, both factors after a first-order lag."""
        angle = np.clip(follow(self._bent, lag), -1.4, 1.4)
        return np.asarray(follow(self._speed.grid, lag) * np.tan(angle))

    def is_there(self, steps: Steps) -> Flags:
        """Whether both factors are recorded over each step."""
        return np.asarray(super().is_there(steps) & self._angle.is_there(steps))


@dataclass(frozen=True, eq=False)
class Explained:
    """A motion explained by a reading.

    Attributes:
        motion: where the reading is recorded and something moves.
        crossed: whether one side of the drive counts backward.
        lag, delay: [s].
        ahead, turned: fits of both channels.
        none: likelihoods of both channels without the reading.
        other: likelihood with (or without) one side reversed; None where it was not tried.
        shares: of both channels, the part of their size that is explained, from 0 to 1.
        aside: fit of the motion to the left, and its likelihood without the reading; None if not asked.
        across: the same of the motion in both directions, whatever the angle of its frame.
    """

    motion: Motion
    crossed: bool
    lag: float
    delay: float
    ahead: MotionFit
    turned: MotionFit
    none: tuple[Floats, Floats]
    other: Floats | None
    shares: tuple[float, float] = (0.0, 0.0)
    aside: tuple[MotionFit, Floats] | None = None
    across: tuple[MotionFit, Floats] | None = None

    @property
    def is_known(self) -> bool:
        """Whether enough of the reading is recorded beside the motion."""
        return self.motion.is_known

    @property
    def blocks(self) -> Floats:
        """Log-likelihood of every block."""
        return self.turned.blocks + (self.ahead.blocks if self.across is None else self.across[0].blocks)

    @property
    def nothing(self) -> Floats:
        """The same without the reading."""
        return self.none[1] + (self.none[0] if self.across is None else self.across[1])

    @property
    def moves(self) -> float:
        """Vuong statistic of the reading against none."""
        return compare(self.blocks, self.nothing)

    @property
    def nats(self) -> float:
        """Gain in log-likelihood per step."""
        return float((self.blocks - self.nothing).sum()) / self.motion.moved.size

    @property
    def is_sure(self) -> bool:
        """Whether the motion follows the reading."""
        return self.moves > CLEAR and self.nats > LEAST_NATS

    @property
    def sign_margin(self) -> float:
        """Vuong statistic of the sides' signs against one of them reversed."""
        return np.inf if self.other is None else compare(self.blocks, self.other)

    def sign(self, channel: str) -> int:
        """Sign of the gain of ``ahead``, ``turned`` or ``aside`` where it is clear, else zero."""
        pairs = {"ahead": (self.ahead, self.none[0]), "turned": (self.turned, self.none[1])}
        if channel == "aside" and self.aside is not None:
            pairs[channel] = self.aside
        if channel not in pairs or not self.is_sure:
            return 0
        one, none = pairs[channel]
        # What drives straight on explains nothing of the turning: its noise has either sign.
        nats = float((one.blocks - none).sum()) / self.motion.moved.size
        # The other sign is what is to be refused: where a vehicle stands, both are as far off.
        if nats < LEAST_NATS or abs(one.t[0]) < CLEAR or compare(one.blocks, one.turned) < CLEAR:
            return 0
        return int(np.sign(one.gains[0]))


_NO_FIT = MotionFit(np.zeros(1), np.zeros(1), np.zeros(0), np.zeros(0))
UNEXPLAINED = Explained(
    NO_MOTION,
    crossed=False,
    lag=0.0,
    delay=0.0,
    ahead=_NO_FIT,
    turned=_NO_FIT,
    none=(_NO_FIT.blocks, _NO_FIT.blocks),
    other=None,
)
"""A motion beside which too little of a reading is recorded: nothing is known of either."""


_AS_IT_IS = 0.5
"""Least share of both channels that signals explain as they are: near zero where a side is reversed."""


def _find_change(gains: Sequence[float]) -> tuple[float, ...]:
    """Gains before and after the time at which they change most; none where they vary otherwise as well.

    One part on either side may have any gain: that in which they change.
    """
    best, most = tuple[float, ...](), 2.0 * _VARIES
    for cut in range(_FEWEST_PARTS, len(gains) - _FEWEST_PARTS + 1):
        sides = [np.array(side) for side in (gains[:cut], gains[cut:])]
        middles = [float(np.median(np.log(np.abs(side)))) for side in sides]
        odd = [
            int((np.abs(np.log(np.abs(side)) - middle) > _VARIES).sum())
            for side, middle in zip(sides, middles, strict=True)
        ]
        if max(odd) <= 1 and abs(middles[1] - middles[0]) > most:
            best, most = tuple(float(np.median(side)) for side in sides), abs(middles[1] - middles[0])
    return best


@dataclass(frozen=True, eq=False)
class Reading:
    """Two inputs that may explain a motion; one without inputs is that of signals that do not exist.

    Attributes:
        form: ``body`` (speed, yaw rate), ``sides`` (left, right), ``steering`` (speed, speed times the
            tangent of the angle) or ``gyro`` (nothing, yaw rate); empty of nothing.
        name: for people.
        first, second: the inputs.
        third: of a base that moves sideways, what moves it to the left, in the unit of the first.
        third_crossed: the same if the wheels of the right side count backward.
        explained: the motion that it was fitted to, see `fitted`.
    """

    form: str = ""
    name: str = ""
    first: Held = NO_SIGNAL
    second: Held = NO_SIGNAL
    third: Held = NO_SIGNAL
    third_crossed: Held = NO_SIGNAL
    explained: Explained = field(default=UNEXPLAINED, kw_only=True)

    @property
    def inputs(self) -> Sequence[Held]:
        """Inputs that move."""
        return [one for one in (self.first, self.second, self.third) if one.moves]

    @property
    def is_constant(self) -> bool:
        """Whether it says one thing throughout, so that nothing tells when the motion follows it."""
        return all(one.is_constant for one in self.inputs)

    @property
    def dead_side(self) -> str:
        """The one of two sides that does not turn while the other one does; empty if there is none."""
        sides = zip(SIDES, (self.first, self.second), strict=True)
        dead = [name for name, one in sides if one not in self.inputs]
        return dead[0] if len(dead) == 1 else ""

    def columns(
        self, steps: Steps, lag: float, delay: float | Floats, *, crossed: bool
    ) -> tuple[Floats, Floats]:
        """Increments ahead and of the heading, in the reading's own units; see `Held.integrate`."""
        one, two = (
            each.integrate(steps, lag, delay)
            if each.moves
            else np.zeros(np.broadcast_shapes(np.shape(delay), steps.start.shape))
            for each in (self.first, self.second)
        )
        if self.form == "sides":
            return (0.5 * (one - two), -one - two) if crossed else (0.5 * (one + two), two - one)
        return (two, one) if crossed and self.form == "body" else (one, two)

    def fit_halves(self, channel: str) -> tuple[float, ...]:
        """Gains of ``ahead`` or ``turned`` before and after they change, or in two halves of the path.

        They change where parts of equal path have one gain up to some time, and another one from then on.

        Returns:
            Two gains; none where one of them is not clear.
        """
        made = self.explained
        motion, is_ahead = made.motion, channel == "ahead"
        if not made.is_known:
            return ()
        columns = self.columns(motion.steps, made.lag, made.delay, crossed=made.crossed)
        column, values = (columns[0], motion.body.real) if is_ahead else (columns[1], motion.yaw)
        path = np.cumsum(np.abs(values))

        def fit_parts(count: int) -> tuple[float, ...]:
            number = np.minimum(count * path / path[-1], count - 1).astype(np.int64)
            parts = [number == part for part in range(count)]
            if min(part.sum() for part in parts) < FEWEST_STEPS:
                return ()
            fits = [fit(values[part], column[part, None], motion.steps.take(part)) for part in parts]
            is_clear = all(abs(float(one.t[0])) > CLEAR for one in fits)
            return tuple(float(one.gains[0]) for one in fits) if is_clear else ()

        return _find_change(fit_parts(_PARTS)) or fit_parts(2)

    def columns_aside(self, steps: Steps, lag: float, delay: float, *, crossed: bool) -> Floats:
        """Increments to the left, in the reading's own units; none, or one, of shape (n, 1)."""
        aside = self.third_crossed if crossed else self.third
        if not aside.moves:
            return np.zeros((steps.start.size, 0))
        return aside.integrate(steps, lag, delay)[:, None]

    def fitted(self, whole: Motion) -> Reading:
        """The reading with a motion that it explains."""
        return replace(self, explained=self.explain(whole))

    def explain(self, whole: Motion) -> Explained:
        """Fit the motion; `UNEXPLAINED` where too little is recorded."""
        if not (whole.is_known and self.inputs):
            return UNEXPLAINED
        keep = np.logical_and.reduce([one.is_there(whole.steps) for one in self.inputs])
        busy = self._find_busy(whole)
        if (keep & busy).sum() >= FEWEST_STEPS:
            keep &= busy
        if keep.sum() < FEWEST_STEPS:
            return UNEXPLAINED
        motion = whole.take(keep)
        two = [one for one in (self.first, self.second) if one in self.inputs]
        may_cross = self.form in {"sides", "body"} and len(two) == len(SIDES)
        may_cross = may_cross and (self.third is NO_SIGNAL or self.third_crossed is not NO_SIGNAL)
        made = self.fit_to(motion, DELAYS_S, crossed=False)
        # Laps of one radius are explained either way, for speed and yaw rate are proportional: where the
        # signals explain the motion as they are, nothing is reversed.
        if may_cross and min(made.shares) <= _AS_IT_IS:
            crossed = self.fit_to(motion, DELAYS_S, crossed=True)
            one, other = (made, crossed) if compare(crossed.blocks, made.blocks) < CLEAR else (crossed, made)
            made = replace(one, other=other.blocks)
        return made

    def _find_busy(self, motion: Motion) -> Flags:
        """Steps near which something is asked, or moves: at rest, noise would make all driving an outlier."""
        steps = motion.steps
        elapsed = steps.end - steps.start
        busy = np.zeros(elapsed.size, dtype=bool)
        for one in self.inputs:
            busy |= _is_large(one.integrate(steps, 0.0, 0.0) / elapsed, 0.02)
        wide = max(1, int(1.5 / float(np.median(elapsed))))
        near = np.convolve(busy, np.ones(2 * wide + 1))[wide : wide + busy.size] >= 1.0
        ahead, yaw = motion.body.real, motion.yaw
        return np.asarray(near | _is_large(ahead / elapsed, 0.2) | _is_large(yaw / elapsed, 0.2))

    def fit_to(self, motion: Motion, delays: Floats, *, crossed: bool) -> Explained:
        """Fit all of a motion.

        Args:
            motion: where the reading is recorded.
            delays: that are tried first, shape (k,), and near which the delay is [s].
            crossed: whether one side counts backward.
        """
        lag, delay = self._find_delay(motion, delays, crossed=crossed)
        ahead, yaw = motion.body.real, motion.yaw
        first, second = self.columns(motion.steps, lag, delay, crossed=crossed)
        empty = np.zeros((yaw.size, 0))
        # The pose may be beside the axle's middle, unless its own turning is what drives it ahead.
        lever = bool(np.dot(first, yaw) ** 2 < 0.5 * np.dot(first, first) * np.dot(yaw, yaw))
        beside = yaw[:, None] if lever else empty
        driven, turned = (
            fit(ahead, np.column_stack([first, beside]), motion.steps),
            fit(yaw, second[:, None], motion.steps),
        )
        made = Explained(
            motion,
            crossed,
            lag,
            delay,
            driven,
            turned,
            (fit(ahead, beside, motion.steps).blocks, fit(yaw, empty, motion.steps).blocks),
            None,
            (
                measure_share(ahead, float(driven.gains[0]) * first),
                measure_share(yaw, float(turned.gains[0]) * second),
            ),
        )
        aside = self.columns_aside(motion.steps, lag, delay, crossed=crossed)
        if aside.size:
            across = motion.body.imag
            to_left = (
                fit(across, np.column_stack([aside, beside]), motion.steps),
                fit(across, beside, motion.steps).blocks,
            )
            asked = join_parts(first, aside[:, 0])
            hands = [fit_across(motion, [one, 1j * one], lever=lever) for one in (asked, np.conj(asked))]
            best = max(hands, key=lambda one: float(one.blocks.sum()))
            in_plane = best, fit_across(motion, [], lever=lever).blocks
            made = replace(made, aside=to_left, across=in_plane)
        for one in (self.first, self.second, self.third, self.third_crossed):
            one.forget()
        return made

    def _find_delay(self, motion: Motion, delays: Floats, *, crossed: bool) -> tuple[float, float]:
        """Lag and delay [s] by the least residual, jumps of the pose limited."""
        count = motion.moved.size
        some = np.ones(count, dtype=bool)
        if count > _MOST_ROWS:
            some = np.zeros(count, dtype=bool)
            some[np.linspace(0, count - 1, _MOST_ROWS).astype(np.int64)] = True
        part = motion.take(some)
        body, yaw = part.body, part.yaw
        limits = [float(np.quantile(values**2, 0.97)) for values in (body.real, yaw)]
        scores: dict[tuple[float, float], float] = {}

        def score(lag: float, delays: Floats) -> None:
            """Log-likelihoods of both channels, each with its own gain and its squares limited."""
            lag, delays = round(lag, 3), np.round(delays, 3)
            columns = self.columns(part.steps, lag, delays[:, None], crossed=crossed)
            channels = list(zip((body.real, yaw), columns, limits, strict=True))
            total, aside = np.zeros(delays.size), self.third_crossed if crossed else self.third
            if aside.moves:
                across = aside.integrate(part.steps, lag, delays[:, None])
                total -= [
                    yaw.size * np.log(_miss_across(body, one)) for one in join_parts(columns[0], across)
                ]
                del channels[0]
            for values, column, limit in channels:
                power = np.einsum("ij,ij->i", column, column)
                gains = np.divide(column @ values, power, out=np.zeros_like(power), where=power > 0.0)
                rest = values - column * gains[:, None]
                total -= 0.5 * values.size * np.log(np.minimum(rest**2, limit).mean(axis=1) + 1e-14)
            scores.update(zip(((lag, float(one)) for one in delays), total.tolist(), strict=True))

        # Beside a delay that is given a lag may be any.
        for lag in _LAGS_S if delays.size > 1 else np.arange(0.0, 2.0, 0.1):
            score(float(lag), delays)
        for step in (0.03, 0.01):
            lag, delay = max(scores, key=lambda key: scores[key])
            # One that is given is as it is.
            near = np.array([-step, 0.0, step]) if delays.size > 1 else np.zeros(1)
            for longer in (-step, 0.0, step):
                score(max(0.0, lag + longer), delay + near)
        return max(scores, key=lambda key: scores[key])


def _miss_across(body: Complex, asked: Complex) -> float:
    """Mean square of a motion beside what is asked for, in a frame of any angle and either hand."""
    squares = []
    for one in (asked, np.conj(asked)):
        gain = np.vdot(one, body) / max(float(np.vdot(one, one).real), 1e-30)
        squares.append(np.abs(body - gain * one) ** 2)
    widest = float(np.quantile(np.abs(body) ** 2, 0.97))
    return min(float(np.mean(np.minimum(square, widest))) for square in squares) + 1e-14


def stack(values: Complex) -> Floats:
    """Parts of complex numbers one after the other, shape (2 n,)."""
    return np.concatenate((values.real, values.imag))


def fit_across(motion: Motion, columns: Sequence[Complex], *, lever: bool) -> MotionFit:
    """Fit the motion in the plane, both directions alike.

    Args:
        motion: of the body.
        columns: explaining increments ahead + 1j * left, shape (n,) each.
        lever: whether the pose may be beside the middle.
    """
    steps = Steps(np.tile(motion.steps.start, 2), np.tile(motion.steps.end, 2))
    arms = [motion.yaw + 0j, 1j * motion.yaw] if lever else []
    parts = [stack(np.asarray(one, dtype=np.complex128)) for one in (*columns, *arms)]
    design = np.column_stack(parts) if parts else np.zeros((steps.start.size, 0))
    return fit(stack(motion.body), design, steps)


def _is_large(values: Floats, share: float) -> Flags:
    return np.asarray(np.abs(values) > share * float(np.quantile(np.abs(values), 0.95)))
