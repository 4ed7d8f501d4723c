"""Confidence intervals of fitted parameters, with errors of clocks and lengths that a fit takes as given."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import NORMAL_95, round_digits
from pipeline.estimation.fit import invert, join_covariance, measure_cost, whiten_columns
from pipeline.estimation.path_residuals import CLOCK_STEP_S
from pipeline.models import Number, cut_interval, stands_at_bound

if TYPE_CHECKING:
    from pipeline.core import Floats
    from pipeline.estimation.fit import PathFit
    from pipeline.estimation.model_fit import Fitted
    from pipeline.estimation.model_state import Free

_RISEN = 3.84
"""Rise of chi-square at the ends of a 95 % interval."""
_STRONG = 0.8
"""Correlation that is reported: both intervals are 1.7 times as wide as that of one alone."""
_SMALLEST = 1e-9
"""Share of the largest information below which a number is not observable."""


@dataclass(frozen=True)
class Estimate:
    """A fitted parameter with its 95 % interval.

    Attributes:
        free: the parameter.
        value: the estimate.
        half: half-width of the interval.
        standard_error: standard error of the estimate.
        at_bound: whether it is at a bound, so that the interval means little.
        observable: whether the prediction depends on it at all.
        clock_error: part of the standard error due to the unknown delay of the poses.
    """

    free: Free
    value: float
    half: float
    standard_error: float
    at_bound: bool
    observable: bool
    clock_error: float = 0.0

    @property
    def interval(self) -> tuple[float, float]:
        """Both ends, cut at the bounds of the parameter; NaN if the interval is wider than their distance."""
        least, most = self.free.bounds
        if not 2.0 * self.half <= most - least:
            return math.nan, math.nan
        # Bounds of a search, as those of a limit by measured wheels, can lie beside the value.
        bounds = self.free.bounds if least <= self.value <= most else (-math.inf, math.inf)
        return cut_interval(self.value - self.half, self.value + self.half, bounds)

    @property
    def number(self) -> Number:
        """It as a number: what is said of a stored answer is what was said of it at first."""
        low, high = map(round_digits, self.interval)
        return Number(self.value, low, high, self.free.unit, self.at_bound)

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
        rows = [index for index, item in enumerate(self.items) if item.free.acts_in(run)]
        items = tuple(self.items[index] for index in rows)
        return Estimates(items, self.correlation[np.ix_(rows, rows)], self.blocks)

    @property
    def numbers(self) -> dict[str, Number]:
        """The numbers of the effects that all runs share and the data determine, by label."""
        return {
            item.free.label: item.number
            for item in self.items
            if item.free.effect and not item.free.runs and math.isfinite(item.low)
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


def estimate_intervals(fitted: Fitted) -> Estimates:
    """Intervals of all parameters of a fit.

    Innovations are independent, so that the inverse of their information is the covariance, widened where
    blocks differ by more (`fit.join_covariance`). What the fit takes as given, a clock or a dimension of the
    vehicle, widens an interval by what its standard error would change of the number.

    Args:
        fitted: a converged fit.
    """
    made = [estimate_path(fit) for fit in fitted.fits if fit.free]
    if not made:
        return NOTHING
    sizes = [len(one.items) for one in made]
    correlation = np.zeros((sum(sizes), sum(sizes)))
    for one, end, size in zip(made, np.cumsum(sizes).tolist(), sizes, strict=True):
        correlation[end - size : end, end - size : end] = one.correlation
    items = tuple(item for one in made for item in one.items)
    return Estimates(items, correlation, min(one.blocks for one in made))


def estimate_path(fit: PathFit) -> Estimates:
    """Intervals of the free parameters of one path, with the other paths unchanged."""
    count, path = len(fit.free), fit.path
    information = np.diag(fit.normal)
    observable = information > _SMALLEST**2 * float(information.max(initial=0.0))
    known = _bound_information(fit)
    plain, carried = join_covariance(fit, known), carry_clocks(fit, known)
    variance = np.diag(plain) + carried + carry_given(fit, known)
    errors = np.where(observable, np.sqrt(variance), math.nan)
    for index, number in enumerate(fit.free):
        if not number.is_smooth:
            errors[index] = _find_width(fit, number) / NORMAL_95
    correlation = plain / np.maximum(np.sqrt(np.outer(np.diag(plain), np.diag(plain))), 1e-300)
    correlation[~observable] = correlation[:, ~observable] = math.nan
    items = [
        Estimate(
            number,
            value := fit.state.get(number),
            NORMAL_95 * float(errors[index]),
            float(errors[index]),
            at_bound=stands_at_bound(value, fit.state.find_bounds(number)),
            observable=bool(observable[index]),
            clock_error=math.sqrt(float(carried[index])) if path.dates_poses else 0.0,
        )
        for index, number in enumerate(fit.free)
    ]
    return Estimates(tuple(items), correlation if count else np.zeros((0, 0)), int(path.block.max()) + 1)


def _bound_information(fit: PathFit) -> Floats:
    """Information on the numbers (p, p), each known to be within its bounds."""
    # Without it a poorly determined parameter moves far beyond its range and takes correlated ones along.
    ranges = np.array([np.subtract(*number.bounds) for number in fit.free])
    return np.asarray(fit.normal + np.diag(1.0 / ranges**2))


def find_covariance(fit: PathFit) -> Floats:
    """Covariance of the numbers of a fit with the errors of clocks and lengths, shape (p, p)."""
    known = _bound_information(fit)
    return join_covariance(fit, known) + np.diag(carry_clocks(fit, known) + carry_given(fit, known))


def _find_width(fit: PathFit, number: Free) -> float:
    """Half of the interval of a number that is not smooth, by the likelihood on either side of it."""
    value, (low, high), path = fit.state.get(number), number.bounds, fit.path
    least = measure_cost(path, fit.noise, fit.state, fit.free, fit.residual) + _RISEN * fit.overdispersion
    widths = []
    for side, room in ((-1.0, value - low), (1.0, high - value)):
        width, most = number.step / 16.0, min(64.0 * number.step, room)
        while width < most:
            moved = fit.state.set(number, value + side * width)
            if measure_cost(path, fit.noise, moved, fit.free, path.find_residuals(moved)) > least:
                break
            width *= 1.5
        widths.append(min(width, most))
    return max(widths)


def carry_clocks(fit: PathFit, information: Floats) -> Floats:
    """Variance of each number by clocks that the fit takes as given, shape (p,)."""
    path, carried = fit.path, np.zeros(len(fit.free))
    for run, error in enumerate(path.list_clock_errors(fit.state).tolist()):
        if error == 0.0:
            continue
        mine, change = path.run == run, np.zeros((*fit.residual.shape, 1))
        late = path.shift_clock(fit.state, run, CLOCK_STEP_S) - fit.residual[mine]
        change[mine, :, 0] = -error * late / CLOCK_STEP_S
        carried += _carry(fit, information, change)
    return carried


def carry_given(fit: PathFit, information: Floats) -> Floats:
    """Variance of each number by estimated dimensions of the vehicle and sensors of its drive, shape (p,)."""
    shifts = fit.path.list_shifts(fit.state)
    return np.asarray(
        sum((_carry(fit, information, shift[:, :, None]) for shift in shifts), np.zeros(len(fit.free)))
    )


def _carry(fit: PathFit, information: Floats, change: Floats) -> Floats:
    """Variance of each number by one that the fit takes as given, shape (p,).

    A delay of encoders that is fitted does not take over what remains unknown of it.

    Args:
        fit: the fit.
        information: on its numbers, shape (p, p).
        change: of the residuals by one standard error of what is given, shape (n, 3, 1).
    """
    white, carried = whiten_columns(fit, change)[:, 0], np.zeros(len(fit.free))
    moved = [index for index, number in enumerate(fit.free) if number.effect or fit.path.dates_poses]
    if moved:
        pull = fit.white.columns[:, moved].T @ white
        carried[moved] = (invert(information[np.ix_(moved, moved)]) @ pull) ** 2
    return carried


def narrow_path(fit: PathFit) -> tuple[Floats, Floats]:
    """Widths of intervals after the first blocks, which end at those of `estimate_path`.

    Returns:
        Seconds of steps until the end of each block, shape (k,), and half-widths of the 95 % interval of each
        free parameter, infinite where it is not observable yet, shape (k, p).
    """
    path, white = fit.path, fit.white
    last = np.array([item.half for item in estimate_path(fit).items])
    label, count = path.block[white.rows], int(path.block.max()) + 1
    normals = np.zeros((count, len(fit.free), len(fit.free)))
    # Steps, and so their blocks, are in order.
    ends = np.searchsorted(label, np.arange(1, count))
    for block, columns in enumerate(np.split(white.columns, ends)):
        normals[block] = columns.T @ columns
    known = np.cumsum(normals, axis=0)
    errors = np.array([np.sqrt(np.diag(invert(one))) for one in known])
    halves = last * errors / np.maximum(errors[-1], 1e-300)
    observable = np.einsum("kii->ki", known) > _SMALLEST * np.diag(known[-1])
    seconds = np.cumsum(np.bincount(path.block, path.spans, minlength=count))
    return np.asarray(seconds, dtype=np.float64), np.where(observable, halves, math.inf)
