"""Start values of an effect to add to a model: one least squares step from each of several starts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from pipeline.core.arrays import Flags, Floats
from pipeline.estimation.state import combine_columns, pick_columns, stack_columns, weigh_columns
from pipeline.models.effect import Effect, Parameter, Search

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pipeline.estimation.fit import PartFit
    from pipeline.estimation.parts import Part
    from pipeline.estimation.state import State
    from pipeline.models.parameter import Largest

EffectClass = type[Effect]
TERM = "term_"


class Candidate(Protocol):
    """Constructor of an effect from values: a class of the catalogue, or a formula term."""

    @property
    def id(self) -> str:
        """Id of the effects it makes."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Their parameters."""

    def __call__(self, **values: float) -> Effect:
        """The effect with these values."""


_LEAST_SHARE = 0.05
"""Minimum step along a secant, as a share of the start, for a shape to be tried."""
_NO_TRACE = 1e-6
"""Change of weighted residuals below which a parameter has no influence."""
_FAINT = 3.0
"""Weighted size of a typical change below which a parameter is fixed."""


@dataclass(frozen=True)
class Trial:
    """A start of an effect and its influence on the residuals.

    Attributes:
        effect: effect with its start values.
        names: parameters of the derivatives in the columns; empty if the column is a secant.
        columns: change of the prediction, shape (n, 3, p).
        shift: change of the residual between the model and the start, shape (n, 3).
        own: starts of a clock of each single run, by run; its columns are secants, one per run.
    """

    effect: Effect
    names: tuple[str, ...]
    columns: Floats
    shift: Floats
    own: tuple[float, ...] = ()


@dataclass(frozen=True)
class Proposal:
    """An effect with values to start a fit from.

    Attributes:
        state: the model with it.
        trial: its start.
        loss: predicted loss after one step.
    """

    state: State
    trial: Trial
    loss: float


def propose(part: Part, fit: PartFit, candidate: Candidate, largest: Largest) -> Proposal | None:
    """The start of a candidate with the smallest predicted loss; None if no start has an influence.

    Args:
        part: part of the path to explain.
        fit: fit of the model to add to.
        candidate: effect to try; not in the model.
        largest: reference values of relative starts.
    """
    base = _weigh(fit)
    proposals = (_make_proposal(base, trial) for trial in list_trials(part, fit, candidate, largest))
    return min((one for one in proposals if one is not None), key=lambda one: one.loss, default=None)


def list_trials(part: Part, fit: PartFit, candidate: Candidate, largest: Largest) -> Iterator[Trial]:
    """All starts of an effect with their columns."""
    if candidate.id in part.clocks:
        yield _start_clocks(part, fit, candidate, largest)
        return
    starts = [candidate(**values) for values in list_starts(candidate, largest)]
    changed = [
        {
            p.name: start.change(**{p.name: p.neutral + p.step})
            for p in start.parameters
            if p.search is Search.DIRECT and math.isfinite(p.neutral) and p.name not in start.fixed
        }
        for start in starts
    ]
    looked = [one for start, direct in zip(starts, changed, strict=True) for one in (start, *direct.values())]
    part.look_ahead([fit.state.add(one) for one in looked if not one.is_neutral])
    for start, direct in zip(starts, changed, strict=True):
        is_same = direct and start.is_neutral
        base = fit.residual if is_same else part.find_residuals(fit.state.add(start))
        shift = fit.residual - base
        if not direct:
            yield Trial(start, (), shift[:, :, None], np.zeros_like(shift))
            continue
        columns = [
            (base - part.find_residuals(fit.state.add(one))) / start.parameter(name).step
            for name, one in direct.items()
        ]
        yield Trial(start, tuple(direct), stack_columns(columns), shift)


def _start_clocks(part: Part, fit: PartFit, candidate: Candidate, largest: Largest) -> Trial:
    """Each run's clock at the start whose secant has the largest predicted gain in that run."""
    starts = [candidate(**values) for values in list_starts(candidate, largest)]
    shifts = [fit.residual - part.find_residuals(fit.state.add(start)) for start in starts]
    factor, best = fit.weights.factors(fit.residual), []
    for shift in shifts:
        rows = shift * factor
        pull = np.bincount(part.run, (rows * fit.residual * factor).sum(axis=1))
        size = np.bincount(part.run, (rows**2).sum(axis=1))
        best.append(np.maximum(pull, 0.0) ** 2 / np.maximum(size, 1e-12))
    chosen = np.argmax(best, axis=0)
    columns = np.zeros((*fit.residual.shape, chosen.size))
    for run, index in enumerate(chosen.tolist()):
        rows = part.run == run
        columns[rows, :, run] = shifts[index][rows]
    own = tuple(starts[index].delay for index in chosen.tolist())
    return Trial(starts[0], (), columns, np.zeros_like(fit.residual), own)


def list_starts(candidate: Candidate, largest: Largest) -> list[dict[str, float]]:
    """Start values of an effect; parameters with a linear influence stay neutral."""
    if given := candidate().list_starts(largest):
        return given
    searched = [p for p in candidate.parameters if p.search is not Search.DIRECT]
    if not searched:
        return [{}]
    alone = [{p.name: value} for p in searched for value in _list_values(p, largest)]
    if len(searched) == 1:
        return alone
    together = [
        dict(zip([p.name for p in searched], values, strict=True))
        for values in zip(*(_list_values(p, largest) for p in searched), strict=False)
    ]
    return alone + together


def _list_values(parameter: Parameter, largest: Largest) -> list[float]:
    low, high = parameter.bounds
    values = [largest.take(share, parameter.relative_to) for share in parameter.starts]
    return [value for value in values if low <= value <= high]


def _find_traced(trial: Trial, size: Floats) -> Flags:
    """Parameters of an effect with influence at typical size, with any influence if none has; shape (p,)."""
    if not trial.names:
        return np.ones(size.size, dtype=bool)
    parameters = [trial.effect.parameter(name) for name in trial.names]
    usual = np.array([abs(p.typical - p.neutral) for p in parameters])
    traced: Flags = size * usual > _FAINT
    return traced if traced.any() else size > _NO_TRACE


@dataclass(frozen=True)
class _Base:
    """A fit with its share of the normal equations of every joint step.

    Attributes:
        fit: the fit.
        factor: factors of its residuals, shape (n, 3).
        size: norm of each weighted column of its Jacobian, shape (p,).
        rows: these columns with unit norm, shape (3 n, p).
        normal: normal matrix of these columns, shape (p, p).
    """

    fit: PartFit
    factor: Floats
    size: Floats
    rows: Floats
    normal: Floats


def _weigh(fit: PartFit) -> _Base:
    factor = fit.weights.factors(fit.residual)
    rows, size = _scale(fit.jacobian, factor)
    return _Base(fit, factor, size, rows, rows.T @ rows)


def _scale(columns: Floats, factor: Floats) -> tuple[Floats, Floats]:
    """Weighted columns with unit norm, shape (3 n, p), and their norms."""
    rows = weigh_columns(columns, factor)
    size = np.sqrt(np.einsum("ij,ij->j", rows, rows)) + 1e-12
    return rows / size, size


def _make_proposal(base: _Base, trial: Trial) -> Proposal | None:
    """Proposal after one joint step of the parameters of the model and of the added effect."""
    loud = leave_out_silent(trial, base.factor)
    if loud is None:
        return None
    trial, rows, size = loud
    fit, own = base.fit, base.size.size
    residual = fit.residual - trial.shift
    target = (residual * base.factor).reshape(-1)
    across = base.rows.T @ rows
    normal = np.block([[base.normal, across], [across.T, rows.T @ rows]]) + 1e-7 * np.eye(own + size.size)
    moved = np.linalg.solve(normal, np.concatenate((base.rows.T @ target, rows.T @ target)))
    step = moved / np.concatenate((base.size, size))
    mine, effect = step[own:], trial.effect
    after = residual - combine_columns(fit.jacobian, step[:own]) - combine_columns(trial.columns, mine)
    state = fit.state
    for number, change in zip(fit.free, step[:own].tolist(), strict=True):
        if number.is_smooth:
            state = state.set(number, state.get(number) + change)
    if trial.own:
        delays = np.clip(mine, -1.0, 1.0) * trial.own
        state = state.add(effect).set_clocks(effect, delays.tolist())
        return Proposal(state, trial, fit.weights.loss(after))
    if not trial.names and mine[0] < _LEAST_SHARE:
        return None
    for name, change in zip(trial.names, mine.tolist(), strict=False):
        low, high = effect.parameter(name).bounds
        effect = effect.change(**{name: min(max(effect.values[name] + change, low), high)})
    return Proposal(state.add(effect), trial, fit.weights.loss(after))


def leave_out_silent(trial: Trial, factor: Floats) -> tuple[Trial, Floats, Floats] | None:
    """The trial without parameters that have no influence, and its `_scale`; None if none has."""
    rows, size = _scale(trial.columns, factor)
    if not (size > _NO_TRACE).any():
        return None
    traced = _find_traced(trial, size)
    if traced.all():
        return trial, rows, size
    # In straight driving, a change of ground changes one gain: the other one is fixed.
    silent = [n for n, seen in zip(trial.names, traced.tolist(), strict=True) if not seen]
    loud = tuple(name for name in trial.names if name not in silent)
    traced_trial = Trial(
        trial.effect.fix(*silent),
        loud,
        pick_columns(trial.columns, np.flatnonzero(traced).tolist()),
        trial.shift,
    )
    return traced_trial, rows[:, traced], size[traced]
