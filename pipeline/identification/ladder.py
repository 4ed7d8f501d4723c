"""The ladder: the ideal model, then one effect more at each rung, on data that no rung has seen."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.identification.fit import Fitted, fit_model
from pipeline.identification.scoring import Errors, HeldOut, hold_out

if TYPE_CHECKING:
    from pipeline.identification.problem import Problem
    from pipeline.models.model import Model

NOTHING = 1e-3
# What two fits of one model differ by on other folds: a step may cost so much of one error for the other.
CHANCE = 1e-2
ERRORS_OVER_2S: Final = {"t_mrmse_m": ("position", "m"), "r_mrmse_rad": ("heading", "rad")}
"""By name in `Errors` and in JSON: of what, and the unit."""
_LEAST_SQUARE = 1e-24
_RIDGE = 1e-6


@dataclass(frozen=True)
class Rung:
    """One step of the ladder: the fit and its held-out errors."""

    fitted: Fitted
    held_out: HeldOut

    @property
    def effects(self) -> tuple[str, ...]:
        """Ids of the effects of this rung."""
        return self.fitted.model.ids

    @property
    def errors(self) -> Errors:
        """Held-out errors over all runs."""
        return self.held_out.pooled


@dataclass(frozen=True)
class Ladder:
    """Rungs from the ideal model up.

    Attributes:
        rungs: the ideal model first, all effects together last.
    """

    rungs: tuple[Rung, ...]

    @property
    def idle(self) -> tuple[str, ...]:
        """Effects that do not lower the loss on data not seen beside those of the rungs below."""
        return tuple(
            name
            for below, rung in pairwise(self.rungs)
            if compare_losses(rung.held_out, below.held_out) >= 1.0
            for name in rung.effects
            if name not in below.effects
        )

    def explained_shares(self, floor: Errors | None = None) -> tuple[float | None, ...]:
        """Share of the removable error that is gone at each rung.

        (E_ideal - E) / (E_ideal - E_floor) on the position error over 2 s; None without room between them.
        """
        ideal = self.rungs[0].errors.t_mrmse_m
        room = ideal - (0.0 if floor is None else floor.t_mrmse_m)
        if not room > 0.02 * ideal:  # two percent is no room
            return (None,) * len(self.rungs)
        return tuple((ideal - rung.errors.t_mrmse_m) / room for rung in self.rungs)


def climb(
    problem: Problem, model: Model, *, per_run: Sequence[str] = (), begun: Sequence[Rung] = ()
) -> Ladder:
    """Build the ladder of a model's effects, the most useful first.

    All effects are fitted together. At each rung the one that promises most beside those below is taken, and
    all numbers are fitted anew; the last rung is the model itself. An effect that raises an error is a rung
    like any other: `list_rises` says so.

    Args:
        problem: the runs.
        model: whose effects are taken, with their values as starts.
        per_run: as in `fit_model`.
        begun: rungs that are known: of the same effects they are taken over.
    """
    active = model.keep(effect.id for effect in problem.active_effects(model))
    whole = fit_model(problem, active, per_run=per_run, exact=True)
    known = {frozenset(rung.effects): rung for rung in begun}
    rungs: list[Rung] = []
    waiting, taken = list(whole.model.ids), list[str]()
    while True:
        rung = known.get(frozenset(taken)) or _fit_rung(problem, whole, taken, per_run)
        rungs.append(rung)
        if not waiting:
            return Ladder(tuple(rungs))
        taken.append(waiting.pop(int(np.argmin(_promise(rung.fitted, whole, waiting)))))


def _fit_rung(problem: Problem, whole: Fitted, names: Sequence[str], per_run: Sequence[str]) -> Rung:
    """The model with some of the effects, fitted from the numbers that they have in all of it."""
    fitted = whole
    if len(names) < len(whole.model.ids):
        fitted = fit_model(problem, whole.model.keep(names), per_run=per_run, start=whole)
    return Rung(fitted, hold_out(problem, fitted))


def _promise(fitted: Fitted, whole: Fitted, names: Sequence[str]) -> list[float]:
    """Loss that a fit would have with each effect beside its own, to first order: its logarithm.

    Args:
        fitted: the fit.
        whole: of all effects: each is added with the numbers that it has there.
        names: ids of the effects.
    """
    problem, residuals = fitted.problem, fitted.residuals
    own = problem.whole.differentiate(fitted.state, residuals, fitted.free)
    added = []
    for name in names:
        with_it = fitted.state.add(whole.model.effect(name))
        if whole.state.has_own(name):
            with_it = replace(with_it, own=whole.state.own)
        added.append(residuals - problem.find_residuals(with_it))
    columns = np.concatenate((own, np.array(added).transpose(1, 2, 0)), axis=2)
    weighed = columns / np.sqrt(_mean_squares(residuals))[:, None]
    size = np.sqrt((weighed**2).sum(axis=(0, 1))) + 1e-300
    rows = (weighed / size).reshape(-1, size.size)
    normal = rows.T @ rows + _RIDGE * np.eye(size.size)
    pull = rows.T @ (residuals / np.sqrt(_mean_squares(residuals))).reshape(-1)
    count, losses = own.shape[2], []
    for place in range(len(names)):
        taken = [*range(count), count + place]
        step = np.linalg.solve(normal[np.ix_(taken, taken)], pull[taken]) / size[taken]
        losses.append(_average_logs(residuals - columns[:, :, taken] @ step))
    return losses


def list_rises(
    below: Errors | Mapping[str, object], errors: Errors | Mapping[str, object], forgiven: float = NOTHING
) -> tuple[str, ...]:
    """Names in `ERRORS_OVER_2S` of the errors that are larger than one step below; never of unknown ones.

    Args:
        below: errors before the step, or the rung in JSON.
        errors: after it.
        forgiven: share by which an error may be larger, by default that of rounding.
    """
    return tuple(
        name
        for name in ERRORS_OVER_2S
        if _read_error(errors, name) > _read_error(below, name) * (1.0 + forgiven)
    )


def _read_error(errors: Errors | Mapping[str, object], name: str) -> float:
    """An error by its name; NaN where it is not known."""
    value = errors.get(name) if isinstance(errors, Mapping) else getattr(errors, name)
    return float(value) if isinstance(value, int | float) else math.nan


def compare_losses(new: HeldOut, old: HeldOut) -> float:
    """Ratio of two held-out losses, geometric over the channels, so that no scale enters."""
    known = np.isfinite(new.residuals).all(axis=1) & np.isfinite(old.residuals).all(axis=1)
    return math.exp(_average_logs(new.residuals[known]) - _average_logs(old.residuals[known]))


def _average_logs(residuals: Floats) -> float:
    return float(np.mean(np.log(_mean_squares(residuals))))


def _mean_squares(residuals: Floats) -> Floats:
    squares: Floats = np.maximum(np.mean(residuals**2, axis=0), _LEAST_SQUARE)
    return squares
