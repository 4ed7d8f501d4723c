"""Maximum likelihood fits of a model to one path: Gauss-Newton on innovations.

The noise is that of the model's own residuals, learned together with its numbers. A cost is in units of
chi-square: a step that promises less than a twentieth of one is not worth taking.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import FOLDS
from pipeline.estimation.model_state import combine_columns, flatten, pick_columns
from pipeline.estimation.noise import find_weights, huber_cost

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.core import Flags, Floats, Ints
    from pipeline.estimation.model_state import Free, FreeKey, ModelState
    from pipeline.estimation.noise import Noise
    from pipeline.estimation.path_residuals import HorizonError, PathResiduals

_ENOUGH = 0.05
"""Fall of chi-square below which a step is not worth taking."""
_SETTLED = 1e-8
"""The same for a model that is written: six digits of its numbers are the same from every start."""
_ASTRAY = 100.0
"""Expected fall over the least so far, above which steps lead nowhere."""
_FLATTER, _LONGEST = 1.5, 64.0
"""Fall over that which a step promises, from which it is doubled, and the longest in steps."""
_NEWS = 1.0
"""Fall above which derivatives, and the noise, are computed anew."""
_CONVERGING = 0.3
"""Ratio of what two steps with the same derivatives promise, above which these are computed anew."""
_MORE_THAN_EXPECTED = 8.0
"""Falls of chi-square, in those that a step promises, that the rest of a fit may bring: of 900 fits to
recordings, one in fifty brought more."""
_NO_INFLUENCE = 1e-6
"""Change of the innovations, in standard deviations over the whole run, by a parameter's step: a number with
less, such as that of a limit that is never reached, stays where it is."""
_MOST_STEPS = 30
"""Steps of a fit."""
_GRID = ((1.0, 8), (0.3, 3), (0.1, 2))
"""Grids of a number without derivatives: their spacing in its steps, and the values on either side."""
_MOST_WALKS = 4
"""Times that numbers without derivatives are searched in turn with the others."""
_LOOSEST, _STIFFEST = 1e-6, 30.0
"""Damping relative to the diagonal at first, and above which no further step is tried."""
_FEWEST_HELD = 3
"""Runs from which on whole runs are held out in place of blocks."""
RIDGE = 1e-9
"""Regularization of normal equations of columns of unit size."""


@dataclass(frozen=True)
class White:
    """Innovations of a fit, weighted by Huber's weights and those of the runs, in one column of rows.

    Attributes:
        residual: shape (m,).
        columns: of the fit's numbers, shape (m, p).
        rows: step of each, shape (m,).
        weights: square roots of the weights, shape (n, 3), by which other columns are multiplied.
    """

    residual: Floats
    columns: Floats
    rows: Ints
    weights: Floats


@dataclass(frozen=True)
class PathFit:
    """Fit of one path.

    Attributes:
        path: the path.
        state: the fitted model.
        free: its numbers that act on this path.
        residual: measured less predicted increments, shape (n, 3).
        columns: derivative of the prediction by each number, shape (n, 3, p).
        noise: of the residuals.
    """

    path: PathResiduals = field(repr=False)
    state: ModelState
    free: tuple[Free, ...]
    residual: Floats = field(repr=False)
    columns: Floats = field(repr=False)
    noise: Noise

    @property
    def smooth(self) -> list[int]:
        """Indices of the numbers that derivatives optimize."""
        return [index for index, number in enumerate(self.free) if number.is_smooth]

    @property
    def ids(self) -> tuple[str, ...]:
        """Ids of the effects."""
        return self.state.ids

    @property
    def numbers(self) -> int:
        """How many numbers were fitted."""
        return len(self.free)

    @cached_property
    def white(self) -> White:
        """Its innovations."""
        return whiten(self.path, self.noise, self.residual, self.columns)

    @cached_property
    def normal(self) -> Floats:
        """Information on its numbers, that of the prior included, shape (p, p)."""
        prior = np.diag(self.path.prior.weigh(self.state, self.free)) if self.free else np.zeros((0, 0))
        columns: Floats = self.white.columns
        return columns.T @ columns + prior

    @cached_property
    def widths(self) -> dict[FreeKey, float]:
        """Over what derivatives are taken next: standard error of each number if all others were known."""
        known = np.sqrt(np.diag(self.normal)).tolist()
        return {
            number.key: 1.0 / one if one > 0.0 else math.inf
            for number, one in zip(self.free, known, strict=True)
        }

    @cached_property
    def score(self) -> float:
        """Minus twice the logarithm of the likelihood: smaller is better, also between kinds of noise."""
        path = self.path
        cost = measure_cost(path, self.noise, self.state, self.free, self.residual)
        return cost + self.noise.log_variance(path.steps, path.weight)

    @cached_property
    def overdispersion(self) -> float:
        """Mean square of its weighted innovations, at least one."""
        count = max(self.white.residual.size - self.numbers, 1)
        return max(_sum_squares(self.white.residual) / count, 1.0)

    @cached_property
    def expected(self) -> float:
        """Score that is expected after its next step."""
        return self.score - _solve(self, _LOOSEST)[2]

    @cached_property
    def covariance(self) -> Floats:
        """Covariance of its numbers, shape (p, p); see `join_covariance`."""
        return join_covariance(self, self.normal)

    @cached_property
    def held_out(self) -> Floats:
        """Residuals of every step under numbers fitted without its fold, shape (n, 3)."""
        return hold_out(self, self.noise, make_folds(self.path))

    @cached_property
    def horizon_errors(self) -> Sequence[HorizonError]:
        """Held-out errors over each of `HORIZONS_S`."""
        return self.path.list_horizon_errors(self.held_out)


def whiten(path: PathResiduals, noise: Noise, residual: Floats, columns: Floats) -> White:
    """Weighted innovations of a residual (n, 3) and of columns (n, 3, p)."""
    made = noise.whiten(residual[:, :, None], path.steps)
    weights: Floats = np.sqrt(path.weight * find_weights(made[:, :, 0]))
    flat = _line_up(made * weights[:, :, None], noise)[:, 0]
    rows = np.repeat(np.arange(residual.shape[0]), len(noise.known))
    return White(flat, _line_up(noise.whiten(columns, path.steps, weights), noise), rows, weights)


def whiten_columns(fit: PathFit, columns: Floats) -> Floats:
    """Columns (n, 3, q) in the rows of a fit's innovations, shape (m, q)."""
    return _line_up(fit.noise.whiten(columns, fit.path.steps, fit.white.weights), fit.noise)


def _line_up(white: Floats, noise: Noise) -> Floats:
    """Innovations (n, 3, q) of the channels that say anything, shape (m, q)."""
    return flatten(white if len(noise.known) == white.shape[1] else white[:, noise.known])


def _sum_squares(values: Floats) -> float:
    return float(values @ values)


def join_covariance(fit: PathFit, normal: Floats) -> Floats:
    """Covariance from the information, and from how blocks differ where that is more.

    A number that changes from block to block, or from run to run, is known less well than noise alone
    allows (cluster-robust covariance: White, Econometrica 48, 1980; Cameron and Miller, 2015).
    """
    if not fit.free:
        return np.zeros((0, 0))
    inverse = invert(normal)
    plain = fit.overdispersion * inverse
    white, path = fit.white, fit.path
    label = path.run if path.run[-1] + 1 >= _FEWEST_RUNS else path.unit
    count = int(label.max()) + 1
    if count < _FEWEST_RUNS:
        return plain
    pulls = np.zeros((count, len(fit.free)))
    np.add.at(pulls, label[white.rows], white.columns * white.residual[:, None])
    moved = (pulls - pulls.mean(axis=0)) @ inverse
    robust = count / (count - 1.0) * moved.T @ moved
    factors = np.sqrt(np.maximum(np.diag(robust) / np.maximum(np.diag(plain), 1e-300), 1.0))
    joined: Floats = plain * np.outer(factors, factors)
    return joined


_FEWEST_RUNS = 8
"""Fewest blocks, or runs, from whose differences a covariance is estimated."""


def invert(normal: Floats) -> Floats:
    """Inverse of an information matrix, columns scaled to unit size; huge where nothing is known."""
    size = np.sqrt(np.maximum(np.diag(normal), 1e-24))
    scaled = normal / np.outer(size, size) + RIDGE * np.eye(size.size)
    inverse: Floats = np.linalg.inv(scaled) / np.outer(size, size)
    return inverse


def fit_path(
    path: PathResiduals,
    start: ModelState,
    *,
    noise: Noise | None = None,
    per_run: Sequence[str] = (),
) -> PathFit:
    """Fit all numbers of a state to one path, with the noise of its residuals.

    What belongs to each run alone has the mean over the runs as its shared value then.

    Args:
        path: the path.
        start: state to start from.
        noise: of nearly the same residuals; None to learn it from those of the start.
        per_run: labels with one value per run.
    """
    free, residual = path.list_free(start, per_run), path.find_residuals(start)
    columns = path.differentiate(start, residual, free)
    return _fit_to_the_end(PathFit(path, start, free, residual, columns, path.learn(residual, noise)))


def settle(fit: PathFit) -> PathFit:
    """The place where no derivative pulls any more, by Newton's steps: a fit ends there from every start.

    The cost has many dents where limits and friction begin to act; what wide derivatives see has few. Whole
    steps would lead from dent to dent: they become shorter with each one that leads no nearer (stochastic
    approximation with Kesten's rule: Annals of Mathematical Statistics 29, 1958).
    """
    path, least = fit.path, math.inf
    best = fit = replace(fit, noise=path.learn(fit.residual, fit.noise, exact=True))
    further, before = 0, math.inf
    for _ in range(_MOST_STEPS):
        moving, step, expected = _solve(fit, _LOOSEST)
        if expected < least:
            best, least = fit, expected
        if expected < _SETTLED or expected > _ASTRAY * least:
            break
        further, before = further + (expected > before), expected
        state = fit.state.move(moving, [one / (1 + further) for one in step])
        residual = path.find_residuals(state)
        noise = path.learn(residual, fit.noise, exact=True)
        moved = replace(fit, state=state, residual=residual, noise=noise)
        fit = _differentiate(moved, fit.widths)
    return replace(best, state=best.state.centred)


def go_on(fit: PathFit) -> PathFit:
    """A rough fit taken to its end, with the noise of its own residuals."""
    learned = replace(fit, noise=fit.path.learn(fit.residual, fit.noise))
    return _fit_to_the_end(_differentiate(learned, fit.widths))


def _fit_to_the_end(fit: PathFit) -> PathFit:
    if not fit.free:
        return fit
    fit = _descend(fit)
    for _ in range(_MOST_WALKS if len(fit.smooth) < len(fit.free) else 0):
        before = fit.score
        fit = _walk_grids(fit)
        if before - fit.score < _ENOUGH:
            break
    return replace(fit, state=fit.state.centred)


def begin_fit(path: PathResiduals, start: ModelState, noise: Noise) -> PathFit:
    """A fit before its first step."""
    free, residual = path.list_free(start), path.find_residuals(start)
    return PathFit(path, start, free, residual, path.differentiate(start, residual, free), noise)


def fit_roughly(fit: PathFit, steps: int, target: float = math.inf) -> PathFit:
    """Some steps of a fit, with the noise as it is.

    Args:
        fit: where to begin.
        steps: most steps.
        target: score that it must come below: it ends early where its steps do not promise that.
    """
    return _walk_grids(_descend(fit, rough=steps, target=target)) if fit.free else fit


def _differentiate(fit: PathFit, widths: Mapping[FreeKey, float]) -> PathFit:
    """The fit with the derivatives of its place."""
    return replace(fit, columns=fit.path.differentiate(fit.state, fit.residual, fit.free, widths))


def _walk_grids(fit: PathFit) -> PathFit:
    """Search each number without derivatives once; see `_walk_grid`."""
    for number in fit.free:
        if not number.is_smooth:
            fit = _walk_grid(fit, number)
    return fit


def measure_cost(
    path: PathResiduals, noise: Noise, state: ModelState, free: Sequence[Free], residual: Floats
) -> float:
    """Huber's cost of innovations, and that of the prior."""
    innovations = noise.whiten(residual[:, :, None], path.steps)[:, :, 0]
    return float((path.weight * huber_cost(innovations)).sum()) + path.prior.cost(state, free)


def _descend(fit: PathFit, *, rough: int = 0, target: float = math.inf) -> PathFit:
    """Levenberg-Marquardt steps, numbers held to their bounds; the noise is learned anew on the way.

    Derivatives are computed anew after a step that was news, and where steps without become hardly smaller:
    at the end they are those of the last place but for steps that were none.

    Args:
        fit: where to begin.
        rough: most steps of a rough descent, by the noise as it is; its derivatives are those before the last
            step. 0 for a whole one.
        target: see `fit_path`.
    """
    path, free = fit.path, fit.free
    most = rough or _MOST_STEPS
    unlearned = find_unlearned(path)
    damping, fallen, is_fresh, before = _LOOSEST, 0.0, True, math.inf
    cost = measure_cost(path, fit.noise, fit.state, free, fit.residual)
    most_cost = target - fit.noise.log_variance(path.steps, path.weight)
    for count in range(1, most + 1 if fit.smooth else 1):
        moving, step, expected_fall = _solve(fit, damping)
        if is_fresh and damping <= _LOOSEST and cost - _MORE_THAN_EXPECTED * expected_fall > most_cost:
            break
        fall = 0.0
        if expected_fall >= _ENOUGH and (is_fresh or expected_fall < _CONVERGING * before):
            state, residual, fall = _try_step(fit, moving, step, cost, expected_fall)
        if fall > 0.0:
            fit, cost, fallen = replace(fit, state=state, residual=residual), cost - fall, fallen + fall
            damping = max(damping / 30.0, 1e-9)
            if fall <= _NEWS:
                is_fresh, before = False, expected_fall
                continue
        elif is_fresh and expected_fall >= _ENOUGH and damping <= _STIFFEST:
            damping = max(damping * 30.0, 1e-2)
            continue
        elif (is_fresh or expected_fall < _ENOUGH) and fallen <= unlearned:
            break
        if fallen > unlearned and not rough:
            fit = replace(fit, noise=path.learn(fit.residual, fit.noise))
            cost, fallen = measure_cost(path, fit.noise, fit.state, free, fit.residual), 0.0
            most_cost = target - fit.noise.log_variance(path.steps, path.weight)
        if (fall > 0.0 or not is_fresh) and count != rough:
            fit = _differentiate(fit, fit.widths)
        is_fresh, before = True, math.inf
    return fit


def _try_step(
    fit: PathFit, moving: Sequence[Free], step: Sequence[float], cost: float, expected_fall: float
) -> tuple[ModelState, Floats, float]:
    """State, residual and fall of the cost after a step, doubled while it falls further.

    Where the cost falls by more than a step promised, it is less curved than its derivatives say, and as
    many short steps would be needed: along a trade of a delay with slip, fits ended half-way.
    """
    path, best, times = fit.path, (fit.state, fit.residual, 0.0), 1.0
    while True:
        state = fit.state.move(moving, [times * one for one in step])
        residual = path.find_residuals(state)
        fall = cost - measure_cost(path, fit.noise, state, fit.free, residual)
        if fall <= max(best[2], 0.0):
            return best if times > 1.0 else (state, residual, fall)
        best, times = (state, residual, fall), 2.0 * times
        if fall < _FLATTER * expected_fall or times > _LONGEST:
            return best


def find_unlearned(path: PathResiduals) -> float:
    """Fall of chi-square after which the noise need not be learned anew.

    After a fall f, that would change near f^2 / 4n of the likelihood of n steps.
    """
    return math.sqrt(4.0 * _ENOUGH * path.spans.size)


def _solve(fit: PathFit, damping: float) -> tuple[list[Free], list[float], float]:
    """The numbers that move, their step, and the fall of the cost that it promises."""
    path, free, white = fit.path, fit.free, fit.white
    pulls = white.columns.T @ white.residual + path.prior.pull(fit.state, free)
    moving = [
        index
        for index in fit.smooth
        if math.sqrt(fit.normal[index, index]) * free[index].step > _NO_INFLUENCE
        and not _is_pushed_out(fit.state, free[index], float(pulls[index]))
    ]
    if not moving:
        return [], [], 0.0
    normal = fit.normal[np.ix_(moving, moving)]
    size = np.sqrt(np.maximum(np.diag(normal), 1e-24))
    scaled = normal / np.outer(size, size) + (RIDGE + damping) * np.eye(size.size)
    step = np.linalg.solve(scaled, pulls[moving] / size) / size
    return [free[index] for index in moving], step.tolist(), float(step @ pulls[moving])


def _is_pushed_out(state: ModelState, number: Free, pull: float) -> bool:
    """Whether a number is at a bound and is pulled beyond it."""
    value, (low, high) = state.get(number), number.bounds
    return (value <= low and pull < 0.0) or (value >= high and pull > 0.0)


def _walk_grid(fit: PathFit, number: Free) -> PathFit:
    """Search a number on ever finer grids, the others adapted linearly; then all of them are fitted."""
    path, noise, smooth = fit.path, fit.noise, fit.smooth
    columns = pick_columns(fit.columns, smooth)
    value = fit.state.get(number)
    best, least = value, measure_cost(path, noise, fit.state, fit.free, fit.residual)
    inverse = invert(fit.normal[np.ix_(smooth, smooth)])
    for spacing, count in _GRID:
        values = best + spacing * number.step * np.arange(-count, count + 1)
        for at in np.delete(values, count).tolist():
            if not number.bounds[0] <= at <= number.bounds[1]:
                continue
            residual = path.find_residuals(fit.state.set(number, at))
            if smooth:
                white = whiten(path, noise, residual, columns)
                residual = residual - combine_columns(columns, inverse @ (white.columns.T @ white.residual))
            cost = measure_cost(path, noise, fit.state, fit.free, residual)
            # Values between which no command lies are alike but for rounding.
            if cost < least - _ENOUGH:
                best, least = at, cost
    if best == value:
        return fit
    state = fit.state.set(number, best)
    residual = path.find_residuals(state)
    moved = replace(fit, state=state, residual=residual)
    beyond = _descend(_differentiate(moved, fit.widths))
    return beyond if beyond.score < fit.score else fit


def make_folds(path: PathResiduals) -> Ints:
    """Fold of each step: of runs where there are some, else of blocks, shape (n,)."""
    label = path.run if int(path.run.max(initial=0)) + 1 >= _FEWEST_HELD else path.block
    number: Ints = np.unique(label, return_inverse=True)[1] % FOLDS
    return number


def hold_out(fit: PathFit, noise: Noise, folds: Ints) -> Floats:
    """Residuals of every step under numbers fitted without its fold, by one step from the fit, shape (n, 3).

    Args:
        fit: the fit.
        noise: by which the folds are fitted.
        folds: fold of each step, shape (n,).
    """
    held, smooth = np.array(fit.residual), fit.smooth
    if not smooth:
        return held
    columns = pick_columns(fit.columns, smooth)
    white = whiten(fit.path, noise, fit.residual, columns)
    normal, pull = white.columns.T @ white.columns, white.columns.T @ white.residual
    own = 0.01 * np.diag(np.diag(normal))
    fold_of_row = folds[white.rows]
    for fold in np.unique(folds).tolist():
        rows = fold_of_row == fold
        out, gone = white.columns[rows], white.residual[rows]
        step = invert(normal - out.T @ out + own) @ (pull - out.T @ gone)
        mine: Flags = folds == fold
        held[mine] -= combine_columns(columns[mine], step)
    return held
