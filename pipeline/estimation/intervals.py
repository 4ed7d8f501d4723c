"""Confidence intervals of fitted parameters by a block jackknife, as residuals are autocorrelated."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.core import NORMAL_95, TIMES_PER_BLOCK
from pipeline.core.arrays import Floats, Ints, count_freedom, group_rows, robust_spreads, student_quantile
from pipeline.estimation.fit import Fitted, PartFit
from pipeline.estimation.parts import Part, count_seconds
from pipeline.estimation.problem import Problem
from pipeline.estimation.state import DELAY_STEP, Free
from pipeline.models.parameter import cut_interval, stands_at_bound

_HUBER = 3.0  # clipping limit of residuals [robust standard deviations] before they are correlated
_SHORTEST_BLOCK_S = 6.0  # minimum length of a block [s], however short the autocorrelation time
SHORTEST_TIME_S = _SHORTEST_BLOCK_S / TIMES_PER_BLOCK
"""Lower limit of the autocorrelation time of residuals [s]."""
_ALWAYS_CARRIED = 0.25
"""Share of a clock's error invisible in residuals: lines between readings miss up to an eighth of a bend."""
_RISEN = 1.92  # half of 3.84, the 95 % point of chi-square with one degree of freedom
_LONGEST_S = 20.0  # largest lag of the autocorrelation [s]: beyond it, noise would dominate the sum
_STRONG = 0.8  # correlation that is reported: both intervals are 1.7 times as wide as that of one alone


@dataclass(frozen=True)
class Estimate:
    """A fitted parameter with its 95 % interval.

    Attributes:
        free: the parameter.
        value: the estimate.
        half: half-width of the interval; the larger one if it is asymmetric.
        standard_error: standard error of the estimate.
        at_bound: whether it is at a bound, so that the interval means little.
        observable: whether the prediction depends on it at all.
        clock_error: part of the standard error due to the unknown delay of the poses.
        ends: distances of the lower and the upper end; None: both are `half`.
    """

    free: Free
    value: float
    half: float
    standard_error: float
    at_bound: bool
    observable: bool
    clock_error: float = 0.0
    ends: tuple[float, float] | None = None

    @property
    def interval(self) -> tuple[float, float]:
        """Both ends, cut at the bounds of the parameter; NaN if the interval is wider than their distance."""
        least, most = self.free.bounds
        if not 2.0 * self.half <= most - least:
            return math.nan, math.nan
        below, above = self.ends or (self.half, self.half)
        return cut_interval(self.value - below, self.value + above, self.free.bounds)

    @property
    def low(self) -> float:
        """Lower end of the interval."""
        return self.interval[0]

    @property
    def high(self) -> float:
        """Upper end of the interval."""
        return self.interval[1]

    @property
    def trades_with_clock(self) -> bool:
        """Whether most of its variance is due to the clock."""
        return self.clock_error**2 > 0.5 * self.standard_error**2

    @property
    def deviation(self) -> float:
        """Standard deviation of the normal distribution with this interval: wide for few blocks."""
        return self.half / NORMAL_95


@dataclass(frozen=True)
class Estimates:
    """All parameters of a fit: `items`, their `correlation` (p, p), and the number of `blocks`."""

    items: tuple[Estimate, ...]
    correlation: Floats
    blocks: int

    def choose_run(self, run: int) -> Estimates:
        """Estimates of the parameters that act in a run."""
        rows = [index for index, item in enumerate(self.items) if item.free.run in {None, run}]
        items = tuple(self.items[index] for index in rows)
        return Estimates(items, self.correlation[np.ix_(rows, rows)], self.blocks)

    @property
    def shared_intervals(self) -> dict[str, tuple[float, float]]:
        """Finite intervals of the effects' parameters that all runs share, by label."""
        return {
            item.free.label: item.interval
            for item in self.items
            if item.free.effect and item.free.run is None and math.isfinite(item.low)
        }

    def list_correlated(self) -> list[tuple[Free, Free, float]]:
        """Pairs of parameters that the data hardly distinguish, with their correlation."""
        return [
            (self.items[j].free, one.free, value)
            for i, one in enumerate(self.items)
            for j in range(i)
            if abs(value := float(self.correlation[i, j])) > _STRONG
        ]

    def find(self, label: str) -> Estimate:
        """The estimate of ``effect.name``.

        Raises:
            KeyError: it was not fitted.
        """
        for item in self.items:
            if item.free.label == label:
                return item
        raise KeyError(label)


NOTHING = Estimates((), np.zeros((0, 0)), 0)
"""Estimates of a model that was not fitted."""


def estimate_intervals(problem: Problem, fitted: Fitted) -> Estimates:
    """Intervals of all parameters of a fit.

    Each block is left out once and the fit is repeated through its derivatives: a parameter that depends on
    one block has a wide interval (delete-a-group jackknife; Shao and Tu, The Jackknife and Bootstrap, 1995,
    and CR3 of cluster-robust regression). Blocks are command steps; if those are short against the
    correlation time of the residuals, several are joined, to at least five integrated autocorrelation times
    and six seconds. The interval is symmetric. Its Student's t has the effective degrees of freedom of the
    parameter: two turns in ten blocks measure the track twice, not ten times (Bell and McCaffrey, Survey
    Methodology 28, 2002).
    A clock with a known standard error is one more parameter of the same equations, with that error as its
    prior: it widens an interval as far as both change the residuals alike (`_find_halves`).
    With a prior, which is for runs of few blocks, the interval is that of the Laplace approximation of the
    posterior.

    Args:
        problem: the runs.
        fitted: a converged fit.
    """
    made = [
        estimate_part(part, fit) for part, fit in zip(problem.parts, fitted.fits, strict=True) if fit.free
    ]
    if not made:
        return NOTHING
    sizes = [len(one.items) for one in made]
    correlation = np.zeros((sum(sizes), sum(sizes)))
    for one, end, size in zip(made, np.cumsum(sizes).tolist(), sizes, strict=True):
        correlation[end - size : end, end - size : end] = one.correlation
    items = tuple(item for one in made for item in one.items)
    return Estimates(items, correlation, min(one.blocks for one in made))


def estimate_part(
    part: Part, fit: PartFit, step: Floats | None = None, label: Ints | None = None
) -> Estimates:
    """Intervals of the free parameters of one part, with the other parts unchanged.

    Args:
        part: part of the path.
        fit: a converged fit of it, or one that ``step`` leads to its minimum.
        step: that step of the free parameters, shape (p,).
        label: blocks of these residuals (`join_blocks`), if known.
    """
    count = len(fit.free)
    blocks, moved = sum_blocks(part, fit, label), np.zeros(count)
    if step is not None:
        blocks, moved = blocks.move(step), step
    correlation = np.full((count, count), np.nan)
    precision = _find_halves(part, fit, blocks)
    rows = precision.rows
    deviation = np.sqrt(np.diag(precision.spread))
    correlation[np.ix_(rows, rows)] = precision.spread / np.maximum(np.outer(deviation, deviation), 1e-300)
    without, halves, errors = (np.full(count, np.nan) for _ in range(3))
    without[rows], halves[rows], errors[rows] = deviation, precision.halves, precision.errors
    carried = np.nan_to_num(np.sqrt(np.maximum(errors**2 - without**2, 0.0)))
    items = []
    for index, number in enumerate(fit.free):
        value = fit.state.get(number) + float(moved[index])
        ends = None if number.is_smooth else _find_ends(part, fit, number)
        half = float(halves[index]) if ends is None else max(ends)
        items.append(
            Estimate(
                number,
                value,
                half,
                float(errors[index]),
                at_bound=stands_at_bound(value, fit.state.find_bounds(number)),
                observable=index in rows,
                clock_error=float(carried[index]) if part.dates_poses else 0.0,
                ends=ends,
            )
        )
    return Estimates(tuple(items), correlation, blocks.count)


def narrow_part(part: Part, fit: PartFit, order: Sequence[int] | None = None) -> tuple[Floats, Floats]:
    """Widths of intervals from the first blocks only, as a function of their number, with the final model.

    The parameters are moved to the best fit of those blocks in one step, and the same jackknife follows:
    the last width is that of `estimate_part`.

    Args:
        part: part of the path.
        fit: a converged fit of it.
        order: numbers of blocks in the order of their use; by default in order of time.

    Returns:
        Seconds of windows until the end of each block, shape (k,), and half-widths of the 95 % interval of
        each free parameter, infinite where it is not observable and for parameters that derivatives cannot
        optimize, shape (k, p).
    """
    blocks = sum_blocks(part, fit)
    used = np.arange(blocks.count) if order is None else np.asarray(order, dtype=np.int64)
    seconds = np.cumsum(np.bincount(blocks.label, count_seconds(part), minlength=blocks.count)[used])
    halves = np.full((blocks.count, len(fit.free)), np.inf)
    for count in range(1, blocks.count + 1):
        first = blocks.take(used[:count])
        if count < blocks.count:
            total, rows, size = _find_observable(part, fit, first.numbers)
            first = first.move(_solve(total, first.numbers.gradients.sum(axis=0), rows, size))
        precision = _find_halves(part, fit, first)
        halves[count - 1, precision.rows] = np.where(np.isfinite(precision.halves), precision.halves, np.inf)
    halves[:, [index for index, number in enumerate(fit.free) if not number.is_smooth]] = np.inf
    return np.asarray(seconds, dtype=np.float64), halves


@dataclass(frozen=True)
class _Halves:
    """Widths of the m observable parameters.

    Attributes:
        rows: indices of these parameters, shape (m,).
        spread: covariance with fixed clocks, NaN for a single block, shape (m, m).
        halves: half-widths of the 95 % intervals, clocks included, shape (m,).
        errors: standard errors, clocks included, shape (m,).
    """

    rows: Ints
    spread: Floats
    halves: Floats
    errors: Floats


def _find_halves(part: Part, fit: PartFit, blocks: Blocks) -> _Halves:
    """Widths of the intervals around a fit's parameters, including the errors of clocks that it fixes.

    The half-width is the smaller one of two. Either clocks are fitted together with the parameters: the
    half-width then contains the shift and the variance of each parameter, and a share of the propagated
    clock errors. Or clocks are not estimated from the residuals, and their errors are propagated in full.
    """
    total, rows, size = _find_observable(part, fit, blocks.numbers)
    covariance = _find_spread(part, fit, blocks.numbers, total, rows, size)
    if covariance is None:
        unknown = np.full((rows.size, rows.size), np.nan)
        return _Halves(rows, unknown, np.diag(unknown), np.diag(unknown))
    spread, wide = covariance
    clocks = range(len(fit.free), blocks.held.size)
    shared = blocks.normals.sum(axis=0)[: len(fit.free)]
    carried = np.array([_solve(total, shared[:, clock], rows, size)[rows] for clock in clocks])
    whole = np.sum(carried**2, axis=0) if carried.size else np.zeros(rows.size)
    halves: Floats = wide * np.sqrt(np.diag(spread) + whole)
    if carried.size:
        all_of, every, length = _find_observable(part, fit, blocks)
        beside = _find_spread(part, fit, blocks, all_of, every, length)
        pull = np.where(blocks.held > 0.0, blocks.gradients.sum(axis=0), 0.0)
        shift = np.abs(_solve(all_of, pull, every, length)[rows])
        if beside is not None and np.isin(rows, every).all():
            mine = np.searchsorted(every, rows)
            variance = np.diag(beside[0])[mine] + _ALWAYS_CARRIED**2 * whole
            halves = np.minimum(halves, shift + beside[1][mine] * np.sqrt(variance))
    return _Halves(rows, spread, halves, halves / wide)


def _find_observable(part: Part, fit: PartFit, blocks: Blocks) -> tuple[Floats, Ints, Floats]:
    """Normal matrix with the priors, the indices of observable parameters, and the size of each parameter."""
    known = np.array(blocks.held)
    known[: len(fit.free)] += part.prior.weigh(fit.state, fit.free)
    normal = blocks.normals.sum(axis=0) + np.diag(known)
    size = np.sqrt(np.maximum(np.diag(normal), 0.0))
    rows = np.flatnonzero(size > 1e-9 * max(float(size.max(initial=0.0)), 1e-300))
    return normal + np.diag(_weigh_bounds(fit, size.size)), rows, size


def _weigh_bounds(fit: PartFit, count: int) -> Floats:
    """Information that parameters err by no more than their range, zero for clocks, shape (count,)."""
    # Without it a poorly determined parameter moves far beyond its range and takes correlated ones along.
    ranges = np.array([np.subtract(*number.bounds) for number in fit.free])
    return np.append(1.0 / ranges**2, np.zeros(count - ranges.size))


def _find_spread(
    part: Part, fit: PartFit, blocks: Blocks, total: Floats, rows: Ints, size: Floats
) -> tuple[Floats, Floats] | None:
    """Covariance of the observable parameters, and half-widths of their 95 % intervals [standard errors]."""
    if rows.size and part.prior.numbers:
        scale = np.outer(size[rows], size[rows])
        spread: Floats = part.prior.excess * np.linalg.inv(total[np.ix_(rows, rows)] / scale) / scale
        return spread, np.full(rows.size, NORMAL_95)
    if rows.size and blocks.count > 1:
        spread, wide = _jackknife(blocks, total, rows, size)
        return spread + _carry_priors(fit, blocks, total, rows, size)[np.ix_(rows, rows)], wide
    return None


def _solve(total: Floats, pull: Floats, rows: Ints, size: Floats) -> Floats:
    """Solution of the normal equations for a right side, zero for unobservable parameters, shape (p,)."""
    scale = size[rows]
    scaled = total[np.ix_(rows, rows)] / np.outer(scale, scale) + 1e-9 * np.eye(rows.size)
    moved = np.zeros(size.size)
    moved[rows] = np.linalg.solve(scaled, pull[rows] / scale) / scale
    return moved


def _carry_priors(fit: PartFit, blocks: Blocks, total: Floats, rows: Ints, size: Floats) -> Floats:
    """Covariance from the priors on clocks and bounds, shape (p, p)."""
    carried = np.zeros_like(total)
    for pull in np.diag(blocks.held + np.sqrt(_weigh_bounds(fit, blocks.held.size))) if rows.size else ():
        moved = _solve(total, pull, rows, size)
        carried += np.outer(moved, moved)
    return carried


def _shift_clocks(part: Part, fit: PartFit) -> Floats:
    """Change of every prediction by one standard error of each run's clock, shape (n, 3, clocks)."""
    shifts = []
    for run, error in enumerate(part.list_clock_errors().tolist()):
        if error == 0.0:
            continue
        mine, change = part.run == run, np.zeros(fit.residual.shape)
        late = part.shift_clock(fit.state, run, DELAY_STEP) - fit.residual[mine]
        change[mine] = -error * late / DELAY_STEP
        shifts.append(change)
    return np.stack(shifts, axis=2) if shifts else np.zeros((*fit.residual.shape, 0))


def _find_ends(part: Part, fit: PartFit, number: Free) -> tuple[float, float]:
    """Distances of the interval's ends for a parameter that is not smooth, by the profile likelihood.

    The likelihood ratio is divided by the number of residuals per independent one.
    """
    value, (low, high) = fit.state.get(number), number.bounds
    base, repeats = _sum_losses(fit, fit.residual), count_repeats(part, fit)
    ends = []
    for side, room in ((-1.0, value - low), (1.0, high - value)):
        width, most = number.step / 16.0, min(64.0 * number.step, room)
        while width < most:
            moved = fit.state.set(number, value + side * width)
            if _sum_losses(fit, part.find_residuals(moved)) - base > _RISEN * repeats:
                break
            width *= 1.5
        ends.append(min(width, most))
    return ends[0], ends[1]


def _sum_losses(fit: PartFit, residual: Floats) -> float:
    return 0.5 * float(fit.weights.cost(residual).sum())


def join_blocks(part: Part, fit: PartFit) -> Ints:
    """Number of the block of every window: command steps, joined if they are too short."""
    length = max(_SHORTEST_BLOCK_S, TIMES_PER_BLOCK * integrate_correlation(part, fit))
    joined = np.empty(part.block.size, dtype=np.int64)
    number, begin, last_run, last_block = -1, -np.inf, -1, -1
    middle = part.times.mean(axis=1)
    for index, (run, block) in enumerate(zip(part.run.tolist(), part.block.tolist(), strict=True)):
        if run != last_run or (block != last_block and middle[index] - begin >= length - 1.0):
            number += 1
            begin = middle[index]
        last_run, last_block = run, block
        joined[index] = number
    return joined


def count_repeats(part: Part, fit: PartFit) -> float:
    """Number of residuals per independent one: correlation time over their distance."""
    stride = float(np.median(np.diff(part.times.mean(axis=1))))
    return max(integrate_correlation(part, fit) / max(stride, 1e-3), 1.0)


def integrate_correlation(part: Part, fit: PartFit) -> float:
    """Integrated autocorrelation time [s] of the residuals: the longest of the channels."""
    spread = robust_spreads(fit.residual)
    normal = fit.residual / np.maximum(spread, 1e-12)
    normal = np.clip(normal, -_HUBER, _HUBER)
    middle = part.times.mean(axis=1)
    step = float(np.median(np.diff(middle)))
    near = (np.diff(middle) < 2.0 * step) & (np.diff(part.run) == 0)
    label = np.concatenate(([0], np.cumsum(~near)))
    longest = 0.0
    for channel in normal.T[list(part.channels)]:
        centred = channel - channel.mean()
        power = float(np.mean(centred**2))
        if power <= 0.0:
            continue
        total = 0.5
        most = min(int(_LONGEST_S / step), centred.size // 4)
        for lag in range(1, most):
            same = label[lag:] == label[:-lag]
            if same.sum() < 50:  # noqa: PLR2004 - too few pairs to know
                break
            value = float(np.mean(centred[lag:][same] * centred[:-lag][same])) / power
            if value <= 0.0:
                break
            # Bartlett's weights: large lags count little, and the sum does not jump at a threshold.
            total += (1.0 - lag / most) * value
        longest = max(longest, 2.0 * total * step)
    return longest


@dataclass(frozen=True)
class Blocks:
    """Normal equations per block of p parameters: those of a fit, and after them its fixed clocks.

    Attributes:
        label: number of the block of every window, shape (n,).
        normals: normal matrices; a clock's unit is its standard error, shape (k, p, p).
        gradients: gradients, shape (k, p).
        held: prior information on the clocks, zero for the parameters of the fit, shape (p,).
    """

    label: Ints
    normals: Floats
    gradients: Floats
    held: Floats

    @property
    def count(self) -> int:
        """Number of blocks."""
        return int(self.normals.shape[0])

    @property
    def numbers(self) -> Blocks:
        """The same for the parameters alone, with fixed clocks."""
        free = np.flatnonzero(self.held == 0.0)
        inner = self.normals[:, free][:, :, free]
        return replace(self, normals=inner, gradients=self.gradients[:, free], held=self.held[free])

    def take(self, numbers: Ints) -> Blocks:
        """The blocks with these numbers."""
        return replace(self, normals=self.normals[numbers], gradients=self.gradients[numbers])

    def move(self, step: Floats) -> Blocks:
        """The same after a step of the parameters, with or without the clocks."""
        return replace(self, gradients=self.gradients - self.normals[:, :, : step.size] @ step)


def sum_blocks(part: Part, fit: PartFit, label: Ints | None = None) -> Blocks:
    """Normal matrix and gradient of every block.

    Args:
        part: part of the path.
        fit: fit of it.
        label: blocks of these residuals, if known.
    """
    if label is None:
        label = join_blocks(part, fit)
    factor = fit.weights.factors(fit.residual)[:, :, None]
    clocks = _shift_clocks(part, fit)
    changes = np.concatenate((fit.jacobian, clocks), axis=2)
    normals, gradients = [], []
    for rows in group_rows(label):
        columns = (changes[rows] * factor[rows]).reshape(-1, changes.shape[2])
        normals.append(columns.T @ columns)
        gradients.append((fit.residual[rows] * factor[rows][:, :, 0]).reshape(-1) @ columns)
    blocks = Blocks(label, np.array(normals), np.array(gradients), np.zeros(changes.shape[2]))
    total, rows, size = _find_observable(part, fit, blocks)
    rested = blocks.move(_solve(total, blocks.gradients.sum(axis=0), rows, size))
    for clock in range(len(fit.free), changes.shape[2]):
        # Blocks vary more than by their normal matrices: residuals are autocorrelated, not white noise.
        influence = _solve(total, np.eye(changes.shape[2])[clock], rows, size)
        varies = float(np.sum((rested.gradients @ influence) ** 2)) / max(
            float(influence @ total @ influence), 1e-300
        )
        blocks.held[clock] = max(varies, 1.0)
    return blocks


def _jackknife(blocks: Blocks, total: Floats, rows: Ints, size: Floats) -> tuple[Floats, Floats]:
    """Covariance of the parameters by leaving out each block, shape (rows, rows), and Student's t."""
    scale = size[rows]
    small = blocks.normals[:, rows][:, :, rows] / np.outer(scale, scale)
    without = total[np.ix_(rows, rows)] / np.outer(scale, scale) - small + 1e-9 * np.eye(rows.size)
    moved = np.linalg.solve(without, (blocks.gradients[:, rows] / scale)[:, :, None])[:, :, 0] / scale
    moved -= moved.mean(axis=0)
    spread: Floats = (blocks.count - 1.0) / blocks.count * moved.T @ moved
    freedom = count_freedom(small, without).tolist()
    return spread, np.array([student_quantile(0.95, one) for one in freedom])
