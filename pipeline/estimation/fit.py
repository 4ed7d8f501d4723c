"""Robust least squares over all free parameters of a part at once (Levenberg-Marquardt), part by part."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.estimation.parts import make_weights
from pipeline.estimation.proposals import propose
from pipeline.estimation.state import (
    Free,
    State,
    Weights,
    combine_columns,
    make_columns,
    pick_columns,
    weigh_columns,
)
from pipeline.models.model import Model

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.estimation.parts import Part
    from pipeline.estimation.problem import Problem
    from pipeline.models.effect import Effect, Parameter

_ITERATIONS = 20
"""Maximum number of steps of a fit."""
_ENOUGH = 1e-4
"""Relative decrease of the loss at which a fit of the search ends: a hundredth of what naming needs."""
_NEWS = 0.02
"""Relative decrease of the loss above which derivatives are recomputed."""
_FIRST_STEPS = 2
"""Steps of a fit taken regardless of their predicted decrease: the first ones are rough."""
_TRIES = 4
"""Maximum number of steps with derivatives of another fit: after four, half of the rivals on recordings are
within 1.5 % of the loss of their complete fit."""
_GRID_ROUNDS = 4
"""Number of rounds of a grid, each a third as wide as the one before."""
_STIFFEST = 30.0
"""Damping relative to the diagonal above which no further step is tried."""
_REWEIGHTED = 3
"""Maximum number of rounds of recomputing the weights from the residuals and refitting."""
_SAME_SCALE = 0.01
"""Relative change below which weights count as unchanged."""
_SETTLED = 1e-9
"""Relative decrease of the loss at which the fit of a model that is written ends."""
_SETTLED_ROUNDS = 60
"""Maximum number of rounds until parameters, weights and digits no longer change, a safeguard: half a minute
of gentle driving, which hardly determines a controller, needs 20."""
_SAME_NUMBER = 2e-4
"""Relative change below which a parameter counts as unchanged."""


@dataclass(frozen=True)
class PartFit:
    """Fit of one part of the path.

    Attributes:
        state: the fitted state.
        free: its free parameters that act on this part.
        residual: its residuals, shape (n, 3).
        jacobian: derivative of the prediction by each free parameter, shape (n, 3, p).
        weights: weights of the residuals.
        loss: mean cost under these weights, including that of the prior.
        is_fresh: whether the derivatives are those at this state; after a small step the last ones are kept.
        both_sides: whether they are central differences.
    """

    state: State
    free: tuple[Free, ...]
    residual: Floats
    jacobian: Floats
    weights: Weights
    loss: float
    is_fresh: bool = True
    both_sides: bool = False

    @property
    def smooth(self) -> list[int]:
        """Indices of the free parameters that derivatives can optimize."""
        return [index for index, number in enumerate(self.free) if number.is_smooth]

    @property
    def without_derivatives(self) -> PartFit:
        """The fit in the memory of its residuals; a fit that starts from it computes its own derivatives."""
        return replace(self, jacobian=make_columns(0, len(self.free)), is_fresh=False)


@dataclass(frozen=True)
class Fitted:
    """A model fitted to runs.

    Attributes:
        problem: the runs.
        state: model, per-run values and delays.
        fits: the fit of each part of the path.
        residuals: residuals of the whole path, shape (n, 3).
    """

    problem: Problem = field(repr=False)
    state: State
    fits: tuple[PartFit, ...] = field(repr=False)
    residuals: Floats = field(repr=False)

    @property
    def model(self) -> Model:
        """The fitted model with the effects that act on the input."""
        return Model(self.problem.vehicle, self.state.effects)

    @property
    def free(self) -> tuple[Free, ...]:
        """All fitted parameters."""
        return tuple(number for fit in self.fits for number in fit.free)

    @property
    def per_run(self) -> tuple[str, ...]:
        """Labels ``effect.name`` of the parameters with one fitted value per run."""
        own = (number.label for number in self.free if number.effect and number.run is not None)
        return tuple(dict.fromkeys(own))


def fit_model(
    problem: Problem,
    model: Model,
    *,
    per_run: Sequence[str] = (),
    start: Fitted | None = None,
    exact: bool = False,
) -> Fitted:
    """Fit a model's free parameters and the recording's delays.

    If wheels are measured as well as commanded, effects of the drivetrain are fitted from the command to
    the wheels and those of the ground from the wheels to the body: the unexplained residual of one part
    does not bias the parameters of the other.

    Args:
        problem: the runs.
        model: effects at neutral values are searched from several starts; others start at their values.
        per_run: labels ``effect.name`` or ids with one value per run.
        start: a fit of nearly the same model, whose unchanged parts are reused.
        exact: iterate until the parameters converge, so that the same model has the same estimates from
            every start; otherwise until the loss converges, which is enough to compare models.

    Returns:
        The fit; for a parameter at its bound, the data would fit better beyond it.
    """
    state = problem.start_state(() if start is None else start.state.hold(_list_common(start, model)))
    effects = problem.active_effects(model)
    fits: list[PartFit] = []
    for index, part in enumerate(problem.parts):
        mine = state.hold([effect for effect in effects if part.owns(effect)])
        known = None if start is None else start.fits[index]
        if known is not None and (known.state.effects, known.state.timing) == (mine.effects, mine.timing):
            fit = _finish(part, known, per_run, exact=exact)
        else:
            begin = (part, mine.effects, mine.timing, repr(mine.own), tuple(per_run), exact)
            fit = problem.fits.recall(begin, partial(_begin, problem, part, mine, per_run, exact=exact))
        fits.append(fit)
        own = {run: {**state.own.get(run, {}), **numbers} for run, numbers in fit.state.own.items()}
        state = replace(fit.state, effects=state.effects, own={**state.own, **own}).add(*fit.state.effects)
    return Fitted(problem, state, tuple(fits), problem.find_residuals(state))


def _begin(problem: Problem, part: Part, state: State, per_run: Sequence[str], *, exact: bool) -> PartFit:
    """The fit from a state; if ``exact``, from values as model files have them, where it ends at them.

    So the fit of a written model is the model: its values are such that no fit from them changes them.
    """
    if not exact:
        return _finish(part, _fit_part(problem, part, state, per_run), per_run, exact=False)
    for _ in range(_SETTLED_ROUNDS):
        state = state.hold([effect.rounded for effect in state.effects])
        fit = _finish(part, _fit_part(problem, part, state, per_run), per_run, exact=True)
        if _are_same(state, fit.state, [number for number in fit.free if number.effect]):
            break
        state = state.hold(fit.state.effects)
    state = fit.state.add(*(effect.rounded for effect in state.effects))
    fit = _enter(part, fit.weights, state, fit.free, Until(enough=_SETTLED))
    weights = make_weights(fit.residual, part)
    return replace(fit, weights=weights, loss=measure_loss(part, weights, fit.residual, state, fit.free))


def _are_same(one: State, other: State, free: Sequence[Free]) -> bool:
    values, others = ([state.get(number) for number in free] for state in (one, other))
    return np.allclose(values, others, rtol=_SAME_NUMBER, atol=1e-6)


def _finish(part: Part, fit: PartFit, per_run: Sequence[str], *, exact: bool) -> PartFit:
    """The fit, converged if ``exact``, with shared values as the means over the runs."""
    fit = _converge(part, fit, per_run) if exact else fit
    return replace(fit, state=fit.state.centred)


def _list_common(start: Fitted, model: Model) -> list[Effect]:
    return [effect for effect in start.state.effects if effect.id in model]


def _fit_part(problem: Problem, part: Part, state: State, per_run: Sequence[str]) -> PartFit:
    """Fit of a part of the path; effects without values are added one after the other."""
    fresh = [
        effect
        for effect in state.effects
        if effect.fixed != _names(effect)
        # A value shared by all runs is no start for the clock of each run.
        and (effect.is_neutral or (effect.id in part.clocks and not state.has_own(effect.id)))
    ]
    state = state.drop([effect.id for effect in fresh])
    weights, state = _estimate_delays(part, state)
    fit = fit_part(part, weights, state, per_run=per_run)
    for effect in fresh:
        proposal = propose(part, fit, Unset(effect), problem.largest)
        extended = fit.state if proposal is None else proposal.state
        started = extended.find(effect.id)
        # Values that the proposal does not change may be fitted here.
        extended = extended.add(effect if started is None else effect.change(**started.values))
        fit = fit_part(part, fit.weights, extended, per_run=per_run)
    for _ in range(_REWEIGHTED):
        weights = make_weights(fit.residual, part)
        if np.allclose(weights.scale, fit.weights.scale, rtol=_SAME_SCALE):
            break
        fit = fit_part(part, weights, fit, per_run=per_run)
    return fit


def _estimate_delays(part: Part, state: State) -> tuple[Weights, State]:
    """Weights, and the state with delays fitted before its effects: fitted all at once, these may diverge.

    Both settle before the effects move: a fit that starts from the values of a fitted model ends there.
    """
    weights = make_weights(part.find_residuals(state), part)
    delays = tuple(number for number in part.list_free(state) if not number.effect)
    if not state.effects or not delays or any(state.get(number) for number in delays):
        return weights, state
    fit = _converge(part, _enter(part, weights, state, delays, Until(enough=_SETTLED)), ())
    return make_weights(fit.residual, part), fit.state


def _converge(part: Part, fit: PartFit, per_run: Sequence[str]) -> PartFit:
    """The fit iterated until neither parameters nor weights change."""
    for _ in range(_SETTLED_ROUNDS):
        before, weights = fit.state, make_weights(fit.residual, part)
        fit = fit_part(part, weights, fit, per_run=per_run, enough=_SETTLED)
        if _are_same(before, fit.state, fit.free):
            break
    return fit


def _names(effect: Effect) -> frozenset[str]:
    return frozenset(parameter.name for parameter in effect.parameters)


@dataclass(frozen=True)
class Unset:
    """An effect whose values are still to be fitted, as a candidate; fixed parameters keep their values."""

    effect: Effect

    @property
    def id(self) -> str:
        """Id of the effect."""
        return self.effect.id

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Its parameters that are not fixed."""
        return tuple(p for p in self.effect.parameters if p.name not in self.effect.fixed)

    def __call__(self, **values: float) -> Effect:
        """The effect with these values."""
        return self.effect.change(**values)


@dataclass(frozen=True)
class Until:
    """Stopping criteria of a fit; see `fit_part`."""

    iterations: int = _ITERATIONS
    enough: float = _ENOUGH
    useful: float = math.inf

    def is_enough(self, steps: int, loss: float, promised: float) -> bool:
        """Whether to stop after this number of steps, from the predicted loss of the next one."""
        if steps >= _FIRST_STEPS and promised > self.useful:
            return True
        return (loss - promised) / max(loss, 1e-12) < 0.5 * self.enough


def fit_part(
    part: Part,
    weights: Weights,
    start: State | PartFit,
    iterations: int = _ITERATIONS,
    *,
    per_run: Sequence[str] = (),
    enough: float = _ENOUGH,
    useful: float = math.inf,
) -> PartFit:
    """Fit all free parameters of a state to one part of the path, including those that need a grid.

    Args:
        part: part of the path.
        weights: weights of the residuals.
        start: state to start from, or a fit, whose residuals and derivatives are reused.
        iterations: maximum number of steps.
        per_run: as in `fit_model`.
        enough: relative decrease of the loss at which the fit ends.
        useful: required loss; the fit ends early if the predicted loss of its next step is above it.
    """
    until = Until(iterations, enough, useful)
    if isinstance(start, State):
        start = _enter(part, weights, start, part.list_free(start, per_run), until)
    fit = _descend(part, replace(start, weights=weights), until)
    for number in fit.free:
        moved = None if number.is_smooth else _walk_grid(part, fit, number)
        if moved is None:
            continue
        # The grid treats the others as linear: where they are not, its loss may not be reached.
        beyond = _descend(part, _enter(part, weights, moved, fit.free, until), until)
        if beyond.loss < fit.loss:
            fit = beyond
    return fit


def _enter(part: Part, weights: Weights, state: State, free: tuple[Free, ...], until: Until) -> PartFit:
    """An unchanged state with its residuals and derivatives."""
    both = until.enough < _ENOUGH
    residual, jacobian = part.linearize(state, free, both_sides=both)
    return PartFit(state, free, residual, jacobian, weights, math.nan, both_sides=both)


def try_part(part: Part, weights: Weights, state: State, base: PartFit) -> PartFit:
    """Some steps of a fit with the derivatives of another one: of its new parameters alone they are computed.

    Args:
        part: part of the path.
        weights: weights of the residuals.
        state: state to start from.
        base: fit of a state with most of its parameters.
    """
    free = part.list_free(state)
    known = {number.key: index for index, number in enumerate(base.free)}
    new = [index for index, number in enumerate(free) if number.key not in known]
    residual, columns = part.linearize(state, [free[index] for index in new])
    jacobian = make_columns(residual.shape[0], len(free))
    jacobian[:, :, new] = columns
    old = [index for index in range(len(free)) if index not in new]
    jacobian[:, :, old] = base.jacobian[:, :, [known[free[index].key] for index in old]]
    start = PartFit(state, free, residual, jacobian, weights, math.nan)
    return replace(_descend(part, start, Until(_TRIES), new), is_fresh=False)


def _renew(
    part: Part,
    free: Sequence[Free],
    which: Sequence[int] | None,
    state: State,
    residual: Floats,
    jacobian: Floats,
    *,
    both_sides: bool,
) -> Floats:
    """The derivatives at a state: all of them, or the known ones with those of some parameters recomputed."""
    if which is None:
        return part.differentiate(state, residual, free, both_sides=both_sides)
    renewed = jacobian.copy(order="K")
    renewed[:, :, list(which)] = part.differentiate(state, residual, [free[index] for index in which])
    return renewed


def measure_loss(part: Part, weights: Weights, residual: Floats, state: State, free: Sequence[Free]) -> float:
    """Mean cost per window, including that of the prior."""
    prior: float = part.prior.cost(state, free) / residual.shape[0]
    return weights.loss(residual) + prior


def solve_step(
    jacobian: Floats,
    residual: Floats,
    weights: Weights,
    damping: float = 0.0,
    hold: Floats | float = 0.0,
    pull: Floats | float = 0.0,
) -> tuple[Floats, Floats]:
    """One weighted least squares step.

    Args:
        jacobian: derivative of the prediction by each parameter, shape (n, 3, p).
        residual: shape (n, 3).
        weights: weights of the residuals.
        damping: Levenberg-Marquardt damping relative to the diagonal.
        hold: information for the current value of each parameter, shape (p,).
        pull: gradient of the prior: information for a change, times that change, shape (p,).

    Returns:
        The step, shape (p,), and the normal matrix, shape (p, p).
    """
    factor = weights.factors(residual)
    rows = weigh_columns(jacobian, factor)
    target = (residual * factor).reshape(-1)
    normal = np.asarray(rows.T @ rows, dtype=np.float64)
    size = np.diag(normal) + 1e-12
    stiff = normal + np.diag(size * (damping + 1e-9) + hold)
    step = np.asarray(np.linalg.solve(stiff, rows.T @ target + pull), dtype=np.float64)
    return step, normal


def _descend(part: Part, start: PartFit, until: Until, which: Sequence[int] | None = None) -> PartFit:
    """Descend from a fit; of its derivatives only some are recomputed, if ``which`` gives their indices."""
    both = until.enough < _ENOUGH
    state, free, weights, residual, jacobian = (
        start.state, start.free, start.weights, start.residual, start.jacobian
    )  # fmt: skip
    renew = partial(_renew, part, free, which, both_sides=both)
    loss = measure_loss(part, weights, residual, state, free)
    smooth, damping, is_fresh = start.smooth, 1e-4, True
    if not start.is_fresh or both != start.both_sides:
        jacobian = renew(state, residual, jacobian)
    for iteration in range(until.iterations if smooth else 0):
        pull = part.prior.pull(state, free)
        moving = [
            index
            for index in smooth
            if not _pushes_out(state, free[index], jacobian[:, :, index], residual, float(pull[index]))
        ]
        if not moving:
            break
        movable, columns = [free[index] for index in moving], pick_columns(jacobian, moving)
        step, _ = solve_step(
            columns,
            residual,
            weights,
            damping,
            part.prior.weigh(state, free)[moving],
            pull[moving],
        )
        trial = state.move(movable, step.tolist())
        # Loss of the step if the model were linear: without a decrease, the fit ends.
        linear = residual - combine_columns(columns, step)
        if until.is_enough(iteration, loss, measure_loss(part, weights, linear, trial, free)):
            break
        after = part.find_residuals(trial)
        reached = measure_loss(part, weights, after, trial, free)
        if reached > loss:
            if not is_fresh:
                jacobian = renew(state, residual, jacobian)
                is_fresh = True
                continue
            if damping > _STIFFEST:
                break
            damping = max(damping * 20.0, 1e-2)
            continue
        fall = (loss - reached) / max(loss, 1e-12)
        state, residual, loss = trial, after, reached
        damping = max(damping / 8.0, 1e-8)
        # After a small step the derivatives are reused: new ones cost a prediction per parameter.
        is_fresh = fall > _NEWS
        if is_fresh:
            jacobian = renew(state, residual, jacobian)
        if fall < until.enough:
            break
    return PartFit(state, free, residual, jacobian, weights, loss, is_fresh, both)


def _pushes_out(state: State, number: Free, column: Floats, residual: Floats, prior: float) -> bool:
    """Whether a parameter is at its bound and the gradient points beyond."""
    value, (low, high) = state.get(number), number.bounds
    if low < value < high:
        return False
    pull = float(np.sum(column * residual)) + prior
    return (value <= low and pull < 0.0) or (value >= high and pull > 0.0)


def _walk_grid(part: Part, fit: PartFit, number: Free) -> State | None:
    """Search on a shrinking grid, the other parameters adapted linearly; None if nothing is better."""
    columns, weights = pick_columns(fit.jacobian, fit.smooth), fit.weights
    value = fit.state.get(number)
    # A moment in time has no magnitude to scale the width with.
    width = 8.0 * number.step if math.isnan(fit.state.neutral_of(number)) else 0.5 * abs(value)
    best, best_loss = value, fit.loss
    for _ in range(_GRID_ROUNDS):
        for at in (best - width, best - 0.5 * width, best + 0.5 * width, best + width):
            if not number.bounds[0] <= at <= number.bounds[1]:
                continue
            moved = fit.state.set(number, at)
            residual = part.find_residuals(moved)
            if fit.smooth:
                step, _ = solve_step(columns, residual, weights)
                residual = residual - combine_columns(columns, step)
            loss = measure_loss(part, weights, residual, moved, fit.free)
            if loss < best_loss:
                best, best_loss = at, loss
        width /= 3.0
    return None if best == value else fit.state.set(number, best)
