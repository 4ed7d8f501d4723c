"""Candidates: effects that a model lacks, and what one or two of them would explain, to first order."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations, pairwise
from typing import TYPE_CHECKING, Protocol

import numpy as np

from pipeline.estimation.fit import RIDGE, invert, whiten_columns
from pipeline.estimation.model_state import stack_columns
from pipeline.models import Effect, Parameter, Search

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from pipeline.core import Flags, Floats, Ints
    from pipeline.estimation.fit import PathFit
    from pipeline.estimation.model_state import ModelState
    from pipeline.models import Largest

PRICE = 25.0
"""Fall of chi-square that each number of a model must bring: five standard errors."""
_NO_TRACE = 1e-6
"""Size of an innovation below which a number has no influence."""
_FAINT = 0.3
"""Size of what a number of typical size changes [standard errors] below which it is not fitted: noise that
hides an effect is learned from residuals that hold it."""
_INDEPENDENT = 0.02
"""Share of a column that the model's own columns, or those of its partner, must leave."""
_LEAST_SHARE = 0.05
"""Least share of a start's effect that the data must ask for."""
_SATURATED = 1e-3
"""Regularization of the fit of all candidates at once, columns of unit size."""
_PASSES = 2
"""Times that the noise is learned from what no candidate explains."""
_PAIRED = 16
"""Candidates that are combined in pairs."""


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
    """

    effect: Effect
    names: tuple[str, ...]
    columns: Floats = field(repr=False)
    own: tuple[float, ...] = ()

    @property
    def numbers(self) -> int:
        """Free numbers of a fit from here."""
        if self.own:
            return len(self.own)
        free = (name for name, value in self.effect.values.items() if math.isfinite(value))
        return len(set(free) - self.effect.fixed)

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
        if self.own:
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


@dataclass(frozen=True)
class Extension:
    """One or two candidates that could be added to a model.

    Attributes:
        trials: a start of each.
        step: of their columns, in the order of the trials.
        gain: expected fall of chi-square.
    """

    trials: tuple[Trial, ...]
    step: tuple[float, ...]
    gain: float

    @property
    def names(self) -> tuple[str, ...]:
        """Ids of the effects."""
        return tuple(trial.effect.id for trial in self.trials)

    @property
    def net(self) -> float:
        """Expected gain less the price of its numbers."""
        return self.gain - PRICE * sum(trial.numbers for trial in self.trials)

    def _steps(self) -> Iterator[tuple[Trial, tuple[float, ...]]]:
        begin = 0
        for trial in self.trials:
            end = begin + trial.columns.shape[2]
            yield trial, self.step[begin:end]
            begin = end

    @property
    def is_possible(self) -> bool:
        """Whether each of the effects is, see `Trial.is_possible`."""
        return all(trial.is_possible(step) for trial, step in self._steps())

    def add_to(self, state: ModelState) -> ModelState:
        """The state with the effects at their expected values."""
        for trial, step in self._steps():
            state = trial.add_to(state, step)
        return state


class Screen:
    """What candidates would explain of a fitted model's residuals.

    Args:
        fit: the model.
        candidates: effects that could be added.
        largest: reference of relative starts.
    """

    def __init__(self, fit: PathFit, candidates: Sequence[Candidate], largest: Largest) -> None:
        self.fit = fit
        trials = (
            trial
            for candidate in candidates
            if candidate.id not in fit.ids
            for trial in list_trials(fit, candidate, largest)
        )
        self.trials = tuple(filter(None, (_leave_out_silent(fit, trial) for trial in trials)))
        columns = [fit.columns, *(trial.columns for trial in self.trials)]
        ends = np.cumsum([column.shape[2] for column in columns]).tolist()
        self._places = [np.arange(begin, end) for begin, end in pairwise(ends)]
        self._own = ends[0]
        self._columns = np.concatenate(columns, axis=2)

    @cached_property
    def saturated(self) -> PathFit:
        """The fit with the noise of what no candidate explains.

        The noise of present residuals takes a slow hidden effect for a slow disturbance, and hides it.
        """
        fit, path = self.fit, self.fit.path
        chosen = [*range(self._own), *self._list_best_columns(fit)]
        for _ in range(_PASSES if len(chosen) > self._own else 0):
            white = whiten_columns(fit, self._columns[:, :, chosen])
            size = np.sqrt(np.einsum("ij,ij->j", white, white)) + 1e-12
            normal = (white / size).T @ (white / size) + _SATURATED * np.eye(size.size)
            step = np.linalg.solve(normal, (white / size).T @ fit.white.residual) / size
            rest = fit.residual - self._columns[:, :, chosen] @ step
            fit = replace(fit, noise=path.learn(rest, fit.noise))
        return fit

    def _list_best_columns(self, fit: PathFit) -> list[int]:
        """Columns of the best start of each candidate."""
        normal, pull, _ = _project(fit, self._columns, self._own)
        best: dict[str, tuple[float, Ints]] = {}
        for trial, places in zip(self.trials, self._places, strict=True):
            at = places - self._own
            step = invert(normal[np.ix_(at, at)]) @ pull[at]
            gain = float(step @ pull[at])
            if trial.effect.id not in best or gain > best[trial.effect.id][0]:
                best[trial.effect.id] = gain, places
        return [position for _, places in best.values() for position in places]

    @cached_property
    def _projected(self) -> tuple[Floats, Floats, Floats, Flags]:
        """Normal matrix and pull of the candidates' columns of unit size beside the model.

        Returns:
            Both, by the standard deviation of the innovations, the columns' sizes, and whether the model
            leaves enough of each.
        """
        fit = self.saturated
        normal, pull, alone = _project(fit, self._columns, self._own)
        remaining = np.diag(normal)
        size = np.sqrt(np.maximum(remaining, 1e-24))
        deviation = math.sqrt(max(float(np.mean(fit.white.residual**2)), 1e-6))
        scaled = normal / np.outer(size, size) + RIDGE * np.eye(size.size)
        return scaled, pull / (size * deviation), size / deviation, remaining >= _INDEPENDENT * alone

    @cached_property
    def _alone(self) -> list[Extension | None]:
        """Each trial as an extension, possible or not; None where it is not independent."""
        return [self._measure((index,)) for index in range(len(self.trials))]

    def list_singles(self) -> list[Extension]:
        """The best start of each candidate that is possible, by gain less price."""
        best: dict[str, Extension] = {}
        for extension in self.list_starts():
            best.setdefault(extension.names[0], extension)
        return list(best.values())

    def list_starts(self) -> list[Extension]:
        """Every start of every candidate that is possible, by gain less price."""
        possible = [one for one in self._alone if one is not None and one.is_possible]
        return sorted(possible, key=lambda one: -one.net)

    def list_pairs(self) -> list[Extension]:
        """Pairs that explain more than each of the two alone pays for, by gain less price."""
        # Beside another effect a value may be possible that is not alone.
        nets = {index: one.net for index, one in enumerate(self._alone) if one is not None}
        best = {self.trials[index].effect.id: index for index in sorted(nets, key=nets.__getitem__)}
        leading = sorted(best.values(), key=nets.__getitem__, reverse=True)[:_PAIRED]
        pairs = (self._measure(pair) for pair in combinations(leading, 2))
        paying = [pair for pair in pairs if pair is not None and pair.is_possible and pair.net > 0.0]
        return sorted(paying, key=lambda one: -one.net)

    def _measure(self, indices: tuple[int, ...]) -> Extension | None:
        """Some trials as an extension, possible or not; None where it is not independent."""
        normal, pull, size, is_left = self._projected
        at = np.concatenate([self._places[index] for index in indices]) - self._own
        if not is_left[at].all():
            return None
        inverse = np.linalg.inv(normal[at[:, None], at])
        # What the other columns leave of each, as a share.
        if len(indices) > 1 and (1.0 / np.diag(inverse)).min() < _INDEPENDENT:
            return None
        step = inverse @ pull[at]
        trials = tuple(self.trials[index] for index in indices)
        return Extension(trials, tuple((step / size[at]).tolist()), float(step @ pull[at]))


def _project(fit: PathFit, columns: Floats, own: int) -> tuple[Floats, Floats, Floats]:
    """Normal matrix and pull of candidates' columns, those of the model projected out, and squared sizes."""
    white = whiten_columns(fit, columns)
    mine, rest = white[:, :own], white[:, own:]
    sizes: Floats = np.einsum("ij,ij->j", rest, rest)
    residual = fit.white.residual
    if own:
        basis = np.linalg.qr(mine / (np.linalg.norm(mine, axis=0) + 1e-12))[0]
        rest = rest - basis @ (basis.T @ rest)
        residual = residual - basis @ (basis.T @ residual)
    return rest.T @ rest, rest.T @ residual, sizes


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
    return Trial(trial.effect.fix(*silent), names, trial.columns[:, :, keep])


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
    looked = [one for start, direct in zip(starts, changed, strict=True) for one in (start, *direct.values())]
    path.look_ahead([fit.state.add(one) for one in looked if not one.is_neutral])
    for start, direct in zip(starts, changed, strict=True):
        is_same = direct and start.is_neutral
        base = fit.residual if is_same else path.find_residuals(fit.state.add(start))
        columns = [
            (base - path.find_residuals(fit.state.add(one))) / start.parameter(name).step
            for name, one in direct.items()
        ]
        columns += [] if is_same else [fit.residual - base]
        yield Trial(start, tuple(direct), stack_columns(columns))


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
