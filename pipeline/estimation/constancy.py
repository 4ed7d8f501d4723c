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

from pipeline.core import Flags, Floats
from pipeline.estimation.decision import LEAST_T, list_costs
from pipeline.estimation.folds import refit
from pipeline.estimation.held_out import find_in_test, refit_fold, score
from pipeline.recording import Finding
from pipeline.results import CHANGE, ERRORS_OVER_2S

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from pipeline.estimation.fit import PathFit
    from pipeline.estimation.held_out import HeldOut
    from pipeline.estimation.ladder import ModelAssessment
    from pipeline.estimation.model_state import Free, ModelState
    from pipeline.estimation.path_residuals import PathResiduals
    from pipeline.estimation.run_residuals import RunResiduals

_MARGIN = 2
"""Blocks at either end within which no change is looked for: one block alone has no spread."""
_FALLS = 0.1
"""Share of the errors over 2 s that two values instead of one must remove: on twelve recordings no change
removes more than 0.02."""
_ROUNDS = 5
"""Fits of a side, each with the derivatives at the end of the one before: with those of the whole run alone,
a lag of 0.5 s in the last 25 s ends at 0.37 s."""
_RIDGE = 1e-9
"""Regularization that keeps the equations solvable."""


@dataclass(frozen=True)
class _Change:
    """The most significant change of a number of a path.

    Attributes:
        index: of the path among those of the data.
        path, fit: the path and its fit.
        number: the number.
        time: end of the last block before the change [s].
        t: the change over its standard error.
    """

    index: int
    path: PathResiduals
    fit: PathFit
    number: Free
    time: float
    t: float

    @property
    def sides(self) -> tuple[Flags, Flags]:
        """Windows before the change, and those after it."""
        early: Flags = self.path.times[:, 1] <= self.time
        return early, ~early

    def fit_sides(self, starts: Sequence[PathFit], rounds: int) -> list[PathFit]:
        """Fits to the windows on either side, with residuals and derivatives of all windows.

        Args:
            starts: fits to start from.
            rounds: most fits of a side, each with the derivatives at the end of the one before.
        """
        fits = []
        for start, side in zip(starts, self.sides, strict=True):
            fit = start
            for _ in range(rounds):
                state = refit(fit, side)
                if state is fit.state:
                    break
                residual = self.path.find_residuals(state)
                columns = self.path.differentiate(state, residual, fit.free)
                fit = replace(fit, state=state, residual=residual, columns=columns)
            fits.append(fit)
        return fits

    def locate(self, fits: Sequence[PathFit]) -> _Change:
        """The change at the time at which both fits together are best: blocks are several seconds long."""
        before, after = (list_costs(self.path, self.fit.noise, fit.residual) for fit in fits)
        first = int(np.argmin(np.cumsum(before - after)))
        return replace(self, time=float(self.path.times[first, 1]))


def find_change(assessment: ModelAssessment) -> list[Finding]:
    """A finding about the most significant change of a number during a run; empty without a change.

    Of several runs that were fitted together none is examined: they differ from one another.
    """
    data, fitted = assessment.data, assessment.fitted
    if len(data.residuals_by_run) > 1:
        return []
    paths = enumerate(zip(data.paths, fitted.fits, strict=True))
    changes = [one for index, (path, fit) in paths if fit.free for one in _list_changes(index, path, fit)]
    if not changes:
        return []
    changes.sort(key=lambda one: -abs(one.t))
    one_value = score(data, fitted.state)
    (run_residuals,), examined = data.residuals_by_run, set[tuple[int, float]]()
    everywhere = np.ones(run_residuals.horizons.number.size, dtype=np.bool_)
    for rough in changes:
        nearly = rough.fit_sides([rough.fit] * 2, 1)
        change = rough.locate(nearly)
        # All numbers of a path are fitted: of two that change at one time the second is the same question.
        if (change.index, change.time) in examined:
            continue
        examined.add((change.index, change.time))
        fits = change.fit_sides(nearly, _ROUNDS)
        whole = [fitted.state.take_over(fit.state, fit.free) for fit in fits]
        if not _is_lower(_predict(run_residuals, change, [(whole, everywhere)]), one_value):
            continue
        folds = []
        for number, (fold, training) in enumerate(zip(data.folds, data.training, strict=True)):
            state, rows = refit_fold(data, fitted, number), training[change.index]
            sides = zip(fits, change.sides, strict=True)
            models = [state.take_over(refit(fit, rows & side), fit.free) for fit, side in sides]
            folds.append((models, find_in_test(run_residuals, data.whole.times, fold.test)))
        errors = _predict(run_residuals, change, folds)
        if _is_lower(errors, assessment.whole.held_out):
            others = [one.number.effect for one in changes if one.number.effect != change.number.effect]
            since = change.time - data.residuals_by_run[0].run.start_s
            return [
                _report([fit.state for fit in fits], change.number, since, errors, [*dict.fromkeys(others)])
            ]
    return []


def _report(
    sides: Sequence[ModelState],
    number: Free,
    since: float,
    errors: Mapping[str, float],
    others: Sequence[str],
) -> Finding:
    """The finding of a change.

    Args:
        sides: models before and after it.
        number: the number.
        since: time of the change since the start of the run [s].
        errors: of both models over 2 s, by their names in `Errors`.
        others: ids of effects whose numbers change significantly as well.
    """
    values = [side.get(number) for side in sides]
    effect = sides[0].find(number.effect)
    shown = {
        "parameter": number.name,
        "about": "" if effect is None else effect.parameter(number.name).about,
        "unit": number.unit,
        "time": round(since, 1),
        "since_s": since,
        "before": values[0],
        "after": values[1],
        "others": list(others),
        "errors": list(errors.values()),
    }
    return Finding(CHANGE, "warning", number.effect, shown)


def _is_lower(errors: Mapping[str, float], than: HeldOut) -> bool:
    """Whether the errors of position and heading are lower, in their geometric mean."""
    ratios = [error / max(getattr(than.pooled, name), 1e-12) for name, error in errors.items()]
    return math.sqrt(math.prod(ratios)) < 1.0 - _FALLS


def _predict(
    run_residuals: RunResiduals, change: _Change, judged: Sequence[tuple[Sequence[ModelState], Flags]]
) -> dict[str, float]:
    """Errors over 2 s with the models before and after a change, by their names in `Errors`.

    Args:
        run_residuals: the run.
        change: the change.
        judged: pairs of both models and a mask of the predictions that judge them.
    """
    early = run_residuals.horizons.times.mean(axis=1) < change.time
    squares = np.full((2, early.size), np.nan)
    for models, near in judged:
        for state, rows in zip(models, (near & early, near & ~early), strict=True):
            errors = run_residuals.find_horizon_errors(state.effects_of(0), state.timing[0])
            squares[:, rows] = np.array((errors.position, errors.yaw))[:, rows] ** 2
    return dict(zip(ERRORS_OVER_2S, np.sqrt(np.nanmean(squares, axis=1)).tolist(), strict=True))


def _list_changes(index: int, path: PathResiduals, fit: PathFit) -> Iterator[_Change]:
    """The most significant change of every number of the effects, where it is significant."""
    white, label, count = fit.white, path.unit, int(path.unit.max()) + 1
    of_row = label[white.rows]
    size = np.linalg.norm(white.columns, axis=0) + 1e-100
    columns = white.columns / size
    normals = np.array([columns[of_row == block].T @ columns[of_row == block] for block in range(count)])
    pulls = np.zeros((count, size.size))
    np.add.at(pulls, of_row, columns * white.residual[:, None])
    pulls -= pulls.mean(axis=0)
    for column, number in enumerate(fit.free):
        if not number.effect or not number.is_smooth:
            continue
        statistics = _compare_sides(normals, pulls, column)[_MARGIN - 1 : count - _MARGIN]
        best = int(np.abs(statistics).argmax()) if statistics.size else 0
        if statistics.size and abs(statistics[best]) > LEAST_T:
            time = float(path.times[label <= best + _MARGIN - 1, 1].max())
            yield _Change(index, path, fit, number, time, float(statistics[best]))


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
