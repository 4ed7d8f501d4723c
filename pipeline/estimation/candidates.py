"""Candidates: effects that a model may lack, at all their starts, and what each changes."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from pipeline.estimation.fit import whiten_columns
from pipeline.estimation.model_state import stack_columns
from pipeline.estimation.terms import is_term
from pipeline.models import Effect, Parameter, Search

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from pipeline.core import Floats
    from pipeline.estimation.fit import PathFit
    from pipeline.estimation.model_state import ModelState
    from pipeline.models import Largest

PRICE = 25.0
"""Fall of chi-square that each number of a model must bring: five standard errors."""
_UNUSUAL = 8.0
"""The same for an effect that no controller has a parameter for: before any data it is e^4 times less common
than a wrong track, a lag or a limit."""
SHAPES = 8640
"""Shapes of formulas that a term is the best of, for which it pays: for those of the terms alone it displaces
effects of the catalogue that are right (a lateral skid, drawn sets, seed 44)."""
_NO_TRACE = 1e-6
"""Size of an innovation below which a number has no influence."""
_FAINT = 0.3
"""Size of what a number of typical size changes [standard errors] below which it is not fitted: noise that
hides an effect is learned from residuals that hold it."""
_LEAST_SHARE = 0.05
"""Least share of a start's effect that the data must ask for."""


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
class Trial:
    """A start of a candidate and what it changes.

    Attributes:
        effect: with its start values.
        names: parameters of the columns; empty where the column is the secant of the whole effect.
        columns: change of the prediction, shape (n, 3, k); the last one is that from the model to a start
            that is not neutral.
        own: start values of a clock of each run, whose columns are secants.
        replaces: ids of effects of the model that are special cases of it. They are gone where it comes: its
            last column is the way from the model with them to the model with it in their place.
    """

    effect: Effect
    names: tuple[str, ...]
    columns: Floats = field(repr=False)
    own: tuple[float, ...] = ()
    replaces: frozenset[str] = frozenset()

    @property
    def numbers(self) -> int:
        """Free numbers of a fit from here."""
        if self.own:
            return len(self.own)
        free = (name for name, value in self.effect.values.items() if math.isfinite(value))
        return len(set(free) - self.effect.fixed)

    @property
    def price(self) -> float:
        """Fall of chi-square that it must bring."""
        return PRICE * self.numbers + find_rarity(self.effect)

    @property
    def is_one_number(self) -> bool:
        """Whether it is a secant of one number, a share of which may be what the data ask for."""
        acting = self.effect.list_acting()
        is_secant = not self.names and not self.own and not self.replaces
        return is_secant and [p.search for p in acting] == [Search.STARTS]

    def add_to(self, state: ModelState, step: Sequence[float]) -> ModelState:
        """The state with the effect, its linear numbers moved by a step of the columns."""
        if self.own:
            delays = (np.clip(step, -1.0, 1.0) * self.own).tolist()
            return state.add(self.effect).set_clocks(self.effect, delays)
        changed = {
            name: self.effect.values[name] + change for name, change in zip(self.names, step, strict=False)
        }
        return state.add(self.effect.change_within(**changed))

    def is_possible(self, step: Sequence[float]) -> bool:
        """Whether the data ask for the effect, and not for its opposite where that has no meaning."""
        if self.own or (self.replaces and not self.names):
            return True
        if not self.names:
            values = self.effect.values
            (parameter, *others) = (p for p in self.effect.parameters if math.isfinite(values[p.name]))
            (low, high), neutral = parameter.bounds, parameter.neutral
            if others or not low < neutral < high:
                return step[0] > _LEAST_SHARE
            return low <= neutral + step[0] * (values[parameter.name] - neutral) <= high
        for name, change in zip(self.names, step, strict=False):
            parameter = self.effect.parameter(name)
            least, most = (bound == parameter.neutral for bound in parameter.bounds)
            if self.effect.values[name] == parameter.neutral and (
                (least and change < 0.0) or (most and change > 0.0)
            ):
                return False
        return True


def find_rarity(effect: Effect) -> float:
    """What an effect must bring for being unusual, or one of many shapes."""
    if is_term(effect.id):
        return _UNUSUAL + 2.0 * math.log(SHAPES)
    return 0.0 if any(p.quantities for p in effect.parameters) else _UNUSUAL


def list_all_trials(fit: PathFit, candidates: Sequence[Candidate], largest: Largest) -> tuple[Trial, ...]:
    """All starts of all candidates that change anything, each with the columns of its numbers."""
    trials = (trial for candidate in candidates for trial in list_trials(fit, candidate, largest))
    return tuple(filter(None, (_leave_out_silent(fit, trial) for trial in trials)))


def _leave_out_silent(fit: PathFit, trial: Trial) -> Trial | None:
    """The trial without numbers that have no influence; None if none has."""
    white = whiten_columns(fit, trial.columns)
    size = np.sqrt(np.einsum("ij,ij->j", white, white))
    if not np.isfinite(size).all() or not (size > _NO_TRACE).any():
        return None
    count = len(trial.names)
    if not count:
        return trial
    usual = np.array([trial.effect.parameter(name).usual_size for name in trial.names])
    loud = size[:count] * usual > _FAINT
    if loud.all():
        return trial
    if not loud.any():
        return None
    # In straight driving, a change of ground changes one gain: the other one is fixed.
    silent = [name for name, is_loud in zip(trial.names, loud.tolist(), strict=True) if not is_loud]
    names = tuple(name for name in trial.names if name not in silent)
    keep = [*np.flatnonzero(loud).tolist(), *range(count, trial.columns.shape[2])]
    return replace(trial, effect=trial.effect.fix(*silent), names=names, columns=trial.columns[:, :, keep])


def list_trials(fit: PathFit, candidate: Candidate, largest: Largest) -> Iterator[Trial]:
    """All starts of an effect with their columns."""
    path = fit.path
    if candidate.id in path.clocks:
        yield _start_clocks(fit, candidate, largest)
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
    replaces = frozenset(candidate().contains).intersection(fit.ids)
    state = fit.state.drop(replaces) if replaces else fit.state
    looked = [one for start, direct in zip(starts, changed, strict=True) for one in (start, *direct.values())]
    path.look_ahead([state.add(one) for one in looked if not one.is_neutral])
    for start, direct in zip(starts, changed, strict=True):
        is_same = direct and start.is_neutral and not replaces
        base = fit.residual if is_same else path.find_residuals(state.add(start))
        columns = [
            (base - path.find_residuals(state.add(one))) / start.parameter(name).step
            for name, one in direct.items()
        ]
        columns += [] if is_same else [fit.residual - base]
        yield Trial(start, tuple(direct), stack_columns(columns), replaces=replaces)
    parts = [effect for effect in fit.state.effects if effect.id in replaces]
    if (values := inherit(candidate.parameters, parts)) and not any(map(fit.state.has_own, replaces)):
        yield _start_at_parts(fit, candidate().change_within(**values), state, replaces)


def inherit(parameters: Sequence[Parameter], parts: Sequence[Effect]) -> dict[str, float]:
    """Values at which an effect does what its special cases do: those of equal names, and time constants."""
    values: dict[str, float] = {}
    for part in parts:
        is_lag = {*part.values} == {"tau"}
        for p in parameters:
            name = "tau" if is_lag and p.name.startswith("tau") else p.name
            if math.isfinite(part.values.get(name, math.nan)):
                values[p.name] = part.values[name]
    return values


def _start_at_parts(fit: PathFit, start: Effect, state: ModelState, replaces: frozenset[str]) -> Trial:
    """An effect in the place of its special cases, begun at their values, with the derivatives there."""
    path, base = fit.path, state.add(start)
    residual = path.find_residuals(base)
    free = [one for one in path.list_free(base) if one.effect == start.id and one.is_smooth and not one.runs]
    columns = path.differentiate(base, residual, free)
    return Trial(
        start,
        tuple(one.name for one in free),
        np.concatenate((columns, (fit.residual - residual)[:, :, None]), axis=2),
        replaces=replaces,
    )


def _start_clocks(fit: PathFit, candidate: Candidate, largest: Largest) -> Trial:
    """Each run's clock at the start whose secant promises most in that run."""
    path, starts = fit.path, [candidate(**values) for values in list_starts(candidate, largest)]
    shifts = [fit.residual - path.find_residuals(fit.state.add(start)) for start in starts]
    white = whiten_columns(fit, stack_columns(shifts))
    label = path.run[fit.white.rows]
    pulls, sizes = (
        np.array([np.bincount(label, values) for values in (white * other).T])
        for other in (fit.white.residual[:, None], white)
    )
    chosen = np.argmax(np.maximum(pulls, 0.0) ** 2 / np.maximum(sizes, 1e-12), axis=0)
    columns = np.zeros((*fit.residual.shape, chosen.size))
    for run, index in enumerate(chosen.tolist()):
        rows = path.run == run
        columns[rows, :, run] = shifts[index][rows]
    return Trial(starts[0], (), columns, tuple(starts[index].delay for index in chosen.tolist()))


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
