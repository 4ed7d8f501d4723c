"""Whether a number of the model changes during a run: a structural break at a time that nobody recorded.

A lag that grows when a load is taken on is no function of any input, and a model with one value for it is
wrong on both sides of the change. At every time the model is extended by one number, the change of one of its
own numbers from then on; the Wald statistic of that change is largest at the break (tests for parameter
instability with unknown change point: Andrews, Econometrica 61, 1993). Its standard error is that of sums
over blocks, as residuals are autocorrelated. A change is reported if it is significant and if the model,
fitted before and after it, predicts better what it was not fitted to.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import suffix_unit
from pipeline.core.arrays import Flags, Floats
from pipeline.estimation.acceptance import LEAST_T
from pipeline.estimation.error_regions import format_errors
from pipeline.estimation.folds import find_in_test, refit, score
from pipeline.estimation.intervals import sum_blocks
from pipeline.estimation.ladder import ERRORS_OVER_2S
from pipeline.estimation.terms import is_term
from pipeline.estimation.verdict import CHANGE, name_effect

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from pipeline.estimation.diagnosis import Json
    from pipeline.estimation.fit import PartFit
    from pipeline.estimation.folds import HeldOut
    from pipeline.estimation.ladder import Judgement
    from pipeline.estimation.parts import Part
    from pipeline.estimation.problem import Problem
    from pipeline.estimation.state import Free, State

_TRIM = 0.15
"""Share of the blocks at either end within which a change cannot be told from noise (Andrews 1993)."""
_FALLS = 0.1
"""Share of the errors over 2 s that two values instead of one must remove: on twelve recordings no change
removes more than 0.02."""
_RIDGE = 1e-9
"""Regularization that keeps the equations solvable."""


@dataclass(frozen=True)
class _Change:
    """The most significant change of a number of a part of the path.

    Attributes:
        index: of the part among those of the problem.
        part, fit: the part and its fit.
        number: the number.
        time: end of the last block before the change [s].
        t: the change over its standard error.
    """

    index: int
    part: Part
    fit: PartFit
    number: Free
    time: float
    t: float

    def fit_sides(self, state: State, train: Flags) -> list[State]:
        """The model fitted to the windows before the change, and to those after it."""
        early = self.part.times[:, 1] <= self.time
        sides = (refit(self.part, self.fit, train & side) for side in (early, ~early))
        return [state.take_over(side, self.fit.free) for side in sides]

    def locate(self, sides: Sequence[State]) -> _Change:
        """The change at the time at which both models together fit best: blocks are several seconds long."""
        before, after = (self.fit.weights.cost(self.part.find_residuals(side)) for side in sides)
        first = int(np.argmin(np.cumsum(before - after)))
        return replace(self, time=float(self.part.times[first, 1]))


def find_change(judgement: Judgement) -> list[Mapping[str, Json]]:
    """A finding about the most significant change of a number during a run; empty without a change.

    Of several runs that were fitted together none is examined: they differ from one another.
    """
    problem, state = judgement.problem, judgement.fitted.state
    if len(problem.comparisons) > 1:
        return []
    parts = enumerate(zip(problem.parts, judgement.fitted.fits, strict=True))
    changes = [one for index, (part, fit) in parts if fit.free for one in _list_changes(index, part, fit)]
    for change in sorted(changes, key=lambda one: -abs(one.t)):
        windows = np.ones(change.part.run.size, dtype=np.bool_)
        change = change.locate(change.fit_sides(state, windows))  # noqa: PLW2901 - the same, more exactly
        sides = change.fit_sides(state, windows)
        if not _is_lower(_predict(problem, change, [sides]), score(problem, state)):
            continue
        folds = [change.fit_sides(state, training[change.index]) for training in problem.training]
        errors = _predict(problem, change, folds)
        if not _is_lower(errors, judgement.whole.held_out):
            continue
        number, since = change.number, change.time - problem.comparisons[0].run.start_s
        before, after = (f"{side.get(number):.2g}{suffix_unit(number.unit)}" for side in sides)
        text = (
            f"the {name_effect(number.effect)} changes during the run, at {since:.0f} s: {number.name} "
            f"is {before} before and {after} after; with both values {format_errors(errors)} remain"
        )
        return [{"id": CHANGE, "text": text, "where": number.effect, "severity": "warning"}]
    return []


def _is_lower(errors: Mapping[str, float], than: HeldOut) -> bool:
    """Whether the errors of position and heading are lower, in their geometric mean."""
    ratios = [error / max(getattr(than.pooled, name), 1e-12) for name, error in errors.items()]
    return math.sqrt(math.prod(ratios)) < 1.0 - _FALLS


def _predict(problem: Problem, change: _Change, fitted: Sequence[Sequence[State]]) -> dict[str, float]:
    """Errors over 2 s with the models before and after a change, by their names in `Errors`.

    Args:
        problem: the run.
        change: the change.
        fitted: both models; of every fold, fitted without its stretches, or one pair for the whole run.
    """
    (comparison,) = problem.comparisons
    early = comparison.horizons.times.mean(axis=1) < change.time
    squares = np.full((2, early.size), np.nan)
    near_folds = [find_in_test(comparison, problem.whole.times, fold.test) for fold in problem.folds]
    if len(fitted) == 1:
        near_folds = [np.ones_like(early)]
    for sides, near in zip(fitted, near_folds, strict=True):
        for state, rows in zip(sides, (near & early, near & ~early), strict=True):
            errors = comparison.find_horizon_errors(state.effects_of(0), state.timing[0])
            squares[:, rows] = np.array((errors.position, errors.yaw))[:, rows] ** 2
    return dict(zip(ERRORS_OVER_2S, np.sqrt(np.nanmean(squares, axis=1)).tolist(), strict=True))


def _list_changes(index: int, part: Part, fit: PartFit) -> Iterator[_Change]:
    """The most significant change of every number of the effects, where it is significant."""
    blocks = sum_blocks(part, fit)
    numbers, label = blocks.numbers, blocks.label
    size = np.sqrt(np.einsum("bii->i", numbers.normals)) + 1e-100
    normals, pulls = numbers.normals / np.outer(size, size), numbers.gradients / size
    pulls = pulls - pulls.mean(axis=0)
    margin = max(int(np.ceil(_TRIM * blocks.count)), 2)
    for column, number in enumerate(fit.free):
        if not number.effect or is_term(number.effect) or not number.is_smooth:
            continue
        statistics = _compare_sides(normals, pulls, column)[margin - 1 : blocks.count - margin]
        best = int(np.abs(statistics).argmax()) if statistics.size else 0
        if statistics.size and abs(statistics[best]) > LEAST_T:
            time = float(part.times[label <= best + margin - 1, 1].max())
            yield _Change(index, part, fit, number, time, float(statistics[best]))


def _compare_sides(normals: Floats, pulls: Floats, index: int) -> Floats:
    """Change of a number after each block over its standard error, with all numbers fitted again.

    Args:
        normals: normal matrices of the blocks, shape (b, p, p).
        pulls: gradients of the blocks, which sum to zero, shape (b, p).
        index: of the number.

    Returns:
        Shape (b - 1,).
    """
    whole = normals.sum(axis=0) + _RIDGE * np.eye(normals.shape[1])
    columns, statistics = normals[:, :, index], np.zeros(normals.shape[0] - 1)
    for last in range(statistics.size):
        later = np.arange(normals.shape[0])[:, None] > last
        beside = np.linalg.solve(whole, (columns * later).sum(axis=0))
        influence = (pulls[:, index] * later[:, 0]) - pulls @ beside
        information = float((columns * later).sum(axis=0) @ (np.eye(beside.size)[index] - beside))
        if information < _RIDGE:
            continue
        change = float(influence.sum()) / information
        rest = pulls + change * (normals @ beside - columns * later)
        influence = rest[:, index] * later[:, 0] - rest @ beside
        statistics[last] = change * information / max(float(np.sqrt(np.sum(influence**2))), 1e-300)
    return statistics
