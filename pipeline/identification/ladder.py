"""The ladder: the ideal model, then one effect more at each rung, on data that no rung has seen."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING

from pipeline.identification.fit import Fitted, fit_model
from pipeline.identification.scoring import HeldOut, hold_out

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.identification.problem import Problem
    from pipeline.identification.scoring import Errors
    from pipeline.models.model import Model

_NOTHING = 1e-3
_LEAST_SQUARE = 1e-24


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
    """Rungs from the ideal model up, and effects that did not lower the error on data not seen."""

    rungs: tuple[Rung, ...]
    idle: tuple[str, ...]

    def explained_shares(self, floor: Errors | None = None) -> tuple[float | None, ...]:
        """Share of the removable error that is gone at each rung.

        (E_ideal - E) / (E_ideal - E_floor) on the position error over 2 s; None without room between them.
        """
        ideal = self.rungs[0].errors.t_mrmse_m
        room = ideal - (0.0 if floor is None else floor.t_mrmse_m)
        if not room > 0.02 * ideal:  # two percent is no room
            return (None,) * len(self.rungs)
        return tuple((ideal - rung.errors.t_mrmse_m) / room for rung in self.rungs)


def climb(problem: Problem, model: Model, *, per_run: Sequence[str] = ()) -> Ladder:
    """Build the ladder of a model's effects, the most useful first.

    At each rung every remaining effect is tried on top of those below; the one that lowers the loss most is
    taken if it lowers the held-out loss too, and the error over 2 s does not rise: else the next best one is.
    Effects that do neither are left out and named.

    Args:
        problem: the runs.
        model: whose effects may be taken, with their values as starts.
        per_run: as in `fit_model`.
    """
    base = model.ideal
    fitted = fit_model(problem, base)
    rungs = [Rung(fitted, hold_out(problem, fitted))]
    rest = [effect.id for effect in problem.active_effects(model)]
    hoped = dict.fromkeys(rest, inf)
    while rest:
        waiting = dict(hoped)
        while waiting:
            name, candidate = _take_best(problem, model, fitted, waiting, per_run)
            hoped.update(waiting)
            held_out = hold_out(problem, candidate)
            if compare_losses(held_out, rungs[-1].held_out) >= 1.0:
                return Ladder(tuple(rungs), tuple(rest))
            if "t_mrmse_m" not in list_rises(rungs[-1].errors, held_out.pooled):
                break
            del waiting[name]
        else:
            break
        fitted = candidate
        rungs.append(Rung(candidate, held_out))
        rest.remove(name)
        del hoped[name]
    return Ladder(tuple(rungs), tuple(rest))


def _take_best(
    problem: Problem, model: Model, fitted: Fitted, hoped: dict[str, float], per_run: Sequence[str]
) -> tuple[str, Fitted]:
    """The effect that lowers the loss most; one that brought less before is tried only if that could win.

    Args:
        problem: the runs.
        model: with the effects' starts.
        fitted: the rung below.
        hoped: what each effect brought when it was last tried; updated.
        per_run: as in `fit_model`.
    """
    below = _scale_free(fitted)
    best: tuple[float, str, Fitted] | None = None
    for name in sorted(hoped, key=lambda one: -hoped[one]):
        if best is not None and best[0] >= hoped[name]:
            break
        candidate = fit_model(problem, fitted.model + model.effect(name), per_run=per_run, start=fitted)
        hoped[name] = below - _scale_free(candidate)
        if best is None or hoped[name] > best[0]:
            best = hoped[name], name, candidate
    if best is None:
        raise ValueError("no effect to take")
    return best[1], best[2]


def list_rises(below: Errors, errors: Errors) -> tuple[str, ...]:
    """Errors over 2 s that are larger than one step below: `t_mrmse_m`, `r_mrmse_rad`; never unknown ones."""
    names = ("t_mrmse_m", "r_mrmse_rad")
    return tuple(name for name in names if getattr(errors, name) > getattr(below, name) * (1.0 + _NOTHING))


def compare_losses(new: HeldOut, old: HeldOut) -> float:
    """Ratio of two held-out losses, geometric over the channels, so that no scale enters."""
    from numpy import exp, isfinite, log, maximum, mean  # noqa: PLC0415 - names that read well here

    known = isfinite(new.residuals).all(axis=1) & isfinite(old.residuals).all(axis=1)
    squares = [maximum(mean(side.residuals[known] ** 2, axis=0), _LEAST_SQUARE) for side in (new, old)]
    return float(exp(mean(log(squares[0] / squares[1]))))


def _scale_free(fitted: Fitted) -> float:
    from numpy import log, maximum, mean  # noqa: PLC0415 - names that read well here

    return float(mean(log(maximum(mean(fitted.residuals**2, axis=0), _LEAST_SQUARE))))
