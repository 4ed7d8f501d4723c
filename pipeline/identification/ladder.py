"""The ladder: the ideal model, then one effect more at each rung, on data that no rung has seen."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf, nan, prod
from typing import Final

from pipeline.identification.fit import Fitted, fit_model
from pipeline.identification.problem import Problem
from pipeline.identification.scoring import Errors, HeldOut, hold_out
from pipeline.models.model import Model

NOTHING = 1e-3
# What two fits of one model differ by on other folds: a rung may cost so much of one error for the other.
CHANCE = 1e-2
ERRORS_OVER_2S: Final = {"t_mrmse_m": ("position", "m"), "r_mrmse_rad": ("heading", "rad")}
"""By name in `Errors` and in JSON: of what, and the unit."""
_LEAST_SQUARE = 1e-24
_WORTH_JOINING = 0.5
"""Product of the ratios of both errors over 2 s: far below what one of them may rise by."""


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
        rungs: the ideal model first.
        idle: effects that did not lower the error on data not seen.
        whole: all effects together, where they were tried and are no rung.
    """

    rungs: tuple[Rung, ...]
    idle: tuple[str, ...]
    whole: Rung | None = None

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

    At each rung every remaining effect is tried on top of those below; the one that lowers the loss most is
    taken if it lowers the held-out loss too. Neither error over 2 s rises from rung to rung by more than
    chance (1 %): effects that lower them only together are one rung. Effects that do not help are left out
    and named.

    Args:
        problem: the runs.
        model: whose effects may be taken, with their values as starts.
        per_run: as in `fit_model`.
        begun: rungs that are known, from the ideal model up.
    """
    rungs = list(begun)
    if not rungs:
        fitted = fit_model(problem, model.ideal, exact=True)
        rungs = [Rung(fitted, hold_out(problem, fitted))]
    last = rungs[-1]
    waiting = (effect.id for effect in problem.active_effects(model) if effect.id not in last.effects)
    hoped = dict.fromkeys(waiting, inf)
    tried: list[Rung] = []
    while hoped:
        taken = _take_next(problem, model, last, rungs[-1], hoped, per_run, tried)
        if taken is None:
            break
        name, last = taken
        del hoped[name]
        if not list_rises(rungs[-1].errors, last.errors, CHANCE):
            rungs.append(last)
    if last is not rungs[-1]:
        rungs = _join_rungs(rungs, last)
    rungs[-1] = _start_from_model(problem, model, rungs[-1], per_run)
    # What was taken since the last rung has not made up for the error that it raised.
    active = problem.active_effects(model)
    left = tuple(effect.id for effect in active if effect.id not in rungs[-1].effects)
    whole = next((rung for rung in tried if left and len(rung.effects) == len(active)), None)
    if whole is not None:
        whole = _start_from_model(problem, model, whole, per_run)
    return Ladder(tuple(rungs), left, whole)


def _join_rungs(rungs: list[Rung], last: Rung) -> list[Rung]:
    """Rungs with the last one in the place of those that lie below one of its errors by chance.

    Where one error is at its floor, an effect that takes away most of the other may raise it a little.
    """
    gains = [
        _read_error(last.errors, name) / max(_read_error(rungs[-1].errors, name), _LEAST_SQUARE)
        for name in ERRORS_OVER_2S
    ]
    if not prod(gains) < _WORTH_JOINING:
        return rungs
    kept = [n for n, rung in enumerate(rungs) if not list_rises(rung.errors, last.errors, CHANCE)]
    return [*rungs[: kept[-1] + 1], last] if kept else rungs


def _start_from_model(problem: Problem, model: Model, top: Rung, per_run: Sequence[str]) -> Rung:
    """The last rung with the model's own values as starts, where these end at a smaller loss.

    A moment or a limit that stood for other effects on the rungs below may have gone where no descent
    brings it back from.
    """
    if len(top.effects) < 2 or all(number.is_smooth for number in top.fitted.free):  # noqa: PLR2004
        return top
    fitted = fit_model(problem, model.keep(top.effects), per_run=per_run, exact=True)
    return Rung(fitted, hold_out(problem, fitted)) if _scale_free(fitted) < _scale_free(top.fitted) else top


def _take_next(
    problem: Problem,
    model: Model,
    last: Rung,
    shown: Rung,
    hoped: dict[str, float],
    per_run: Sequence[str],
    tried: list[Rung],
) -> tuple[str, Rung] | None:
    """The most useful effect that raises no error; else the most useful one; None where none helps.

    Every rung that is tried is put down in ``tried``.
    """
    waiting, first = dict(hoped), None
    while waiting:
        name, fitted = _take_best(problem, model, last.fitted, waiting, per_run)
        hoped.update(waiting)
        # Settled, so that a rung is the same whatever its numbers were begun with.
        rung = _settle(problem, fitted, per_run)
        tried.append(rung)
        if compare_losses(rung.held_out, last.held_out) >= 1.0:
            break
        first = first or (name, rung)
        if not list_rises(shown.errors, rung.errors, CHANCE):
            return name, rung
        del waiting[name]
    return first


def _settle(problem: Problem, fitted: Fitted, per_run: Sequence[str]) -> Rung:
    exact = fit_model(problem, fitted.model, per_run=per_run, start=fitted, exact=True)
    return Rung(exact, hold_out(problem, exact))


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
    return float(value) if isinstance(value, int | float) else nan


def compare_losses(new: HeldOut, old: HeldOut) -> float:
    """Ratio of two held-out losses, geometric over the channels, so that no scale enters."""
    from numpy import exp, isfinite, log, maximum, mean  # noqa: PLC0415 - names that read well here

    known = isfinite(new.residuals).all(axis=1) & isfinite(old.residuals).all(axis=1)
    squares = [maximum(mean(side.residuals[known] ** 2, axis=0), _LEAST_SQUARE) for side in (new, old)]
    return float(exp(mean(log(squares[0] / squares[1]))))


def _scale_free(fitted: Fitted) -> float:
    from numpy import log, maximum, mean  # noqa: PLC0415 - names that read well here

    return float(mean(log(maximum(mean(fitted.residuals**2, axis=0), _LEAST_SQUARE))))
