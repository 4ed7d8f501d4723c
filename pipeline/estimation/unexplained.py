"""What no effect of the catalogue explains: a formula, or motion that lasts."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, cast

import numpy as np

from pipeline.estimation.candidates import SHAPES
from pipeline.estimation.decision import EQUAL, LEAST_T, Search, SearchResult, find_cost
from pipeline.estimation.fit import fit_path
from pipeline.estimation.ladder import judge_whole, lowers_errors
from pipeline.estimation.terms import CHANNELS, is_term, join_formula, list_terms
from pipeline.models import Timing, format_effect
from pipeline.results import Disturbance, Unexplained
from pipeline.run import MotionError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.core import Floats
    from pipeline.estimation.fit import PathFit
    from pipeline.estimation.ladder import LadderStep, ModelAssessment
    from pipeline.estimation.run_residuals import RunResiduals
    from pipeline.models import FormulaEffect

_SAME = 0.8
"""Share of what a formula explains from which on an effect of the catalogue explains the same."""
_LASTS_S = 1.5
"""Correlation time of a disturbance from which on it lasts."""
_LEAST_SHARE = 0.5
"""Share of the residual's variance that lasts, from which on it is reported."""
_LEAST_OF_MOTION = 0.05
"""Share of the motion below which what lasts is not reported."""


def search_formula(
    search: Search, outcome: SearchResult, *, sideways: bool
) -> tuple[SearchResult, FormulaEffect | None]:
    """A formula of some terms for what the accepted effects leave, or for one that only imitates it.

    Terms pass the same acceptance as effects, at the price of the shapes that they are the best of. What an
    effect of the catalogue would explain as well is no formula, whether or not it was accepted.

    Returns:
        The effects that stay, and the formula; None where none is accepted.
    """
    first, *others = search.path.residuals_by_run
    wheels = not others and first.context.vehicle.kind == "differential"
    final, terms = outcome.final, list_terms(sideways=sideways, wheels=wheels)
    wide = replace(search, candidates=terms, least_t=math.sqrt(LEAST_T**2 + 2.0 * math.log(SHAPES)))
    fit, judged = wide.choose_proven(final)
    if _list_terms(fit) and len(fit.ids) > len(_list_terms(fit)) + len(search.given):
        # What an effect and a term say together, another term may say alone.
        chosen = [(fit, judged), wide.choose_proven(outcome.start)]
        fit, judged = min(chosen, key=lambda one: find_cost(one[0]))
    gone = set(final.ids) - set(fit.ids)
    named = [one for one in _list_terms(fit) if one.id in judged and not judged[one.id].refusal]
    fall = find_cost(final) - find_cost(fit)
    matrix = outcome.matrix
    if (
        not named
        or fall < EQUAL
        or any(-matrix.expect_change(one) > _SAME * fall for one in matrix.list_singles())
    ):
        return outcome, None
    base = fit_path(search.path, final.state.drop(gone), noise=final.noise) if gone else final
    return replace(outcome, final=base), join_formula(named)


def _list_terms(fit: PathFit) -> list[FormulaEffect]:
    return [cast("FormulaEffect", one) for one in fit.state.effects if is_term(one.id)]


@dataclass(frozen=True)
class Suggestion:
    """A formula that no effect of the catalogue is.

    Attributes:
        unexplained: what is said of it.
        ground: the model with it, from the input that it was found on.
        leading: the same from the input that the diagnosis speaks of; None where it lowers no error there.
    """

    unexplained: Unexplained
    ground: LadderStep
    leading: LadderStep | None


def suggest(
    assessment: ModelAssessment, formula: FormulaEffect, leading: ModelAssessment
) -> Suggestion | None:
    """A formula as a suggestion, with the model with it; None where it does not lower the errors.

    Args:
        assessment: of the model without it, from what it was found on.
        formula: with its values.
        leading: of that model from the input that the diagnosis speaks of, whose errors are those said.
    """
    with suppress(MotionError):
        step = judge_whole(assessment.data, assessment.fitted.model + formula)
        if not lowers_errors(assessment.whole.errors, step.errors):
            return None
        before, after = (
            np.mean(held.residuals**2, axis=0, where=np.isfinite(held.residuals))
            for held in (assessment.whole.held_out, step.held_out)
        )
        falls = 1.0 - after / np.maximum(before, 1e-18)
        # What the term itself changes, where that falls: the other effects of the model changed with it.
        own = np.array([name in formula.formulas for name in CHANNELS])
        index = int(np.argmax(np.where(own & (falls > 0.0), falls, falls - 1e3)))
        channel = CHANNELS[index][-1]
        fitted = step.fitted.model.effect(formula.id)
        channels = tuple(name[-1] for name, fall in zip(CHANNELS, falls.tolist(), strict=True) if fall > 0.0)
        said: LadderStep | None = step
        if leading is not assessment:
            said = judge_whole(leading.data, leading.fitted.model + formula)
            # What the wheels show may be too little from commands to promise anything of them.
            said = said if lowers_errors(leading.whole.errors, said.errors) else None
        unexplained = Unexplained(
            "formula",
            float(falls[index]),
            channel,
            channels or (channel,),
            assessment.data.source.value,
            formula=format_effect(fitted),
            with_formula=None if said is None else said.errors,
        )
        return Suggestion(unexplained, step, said)
    return None


def find_lasting(fit: PathFit, path: str) -> Unexplained | None:
    """Motion that lasts longer than noise does and that no recorded signal predicts; None without."""
    noise = fit.noise
    spans = float(np.median(fit.path.spans))
    times = -noise.step_s / np.log(np.clip(noise.correlation, 1e-12, 1.0 - 1e-12))
    sizes = np.sqrt(noise.share) * noise.spread / spans
    asked = measure_asked(fit.path.residuals_by_run)
    rms = np.sqrt((fit.residual**2).mean(axis=0)) / spans
    shares = np.minimum((sizes / np.maximum(rms, 1e-12)) ** 2, 1.0)
    lasts = (times >= _LASTS_S) & (shares >= _LEAST_SHARE) & (sizes >= _LEAST_OF_MOTION * asked)
    if not lasts.any():
        return None
    order = np.argsort(-np.where(lasts, sizes / asked, 0.0))
    every = [CHANNELS[index][-1] for index in order.tolist() if lasts[index]]
    lasting = {letter: float(sizes["xyw".index(letter)]) for letter in every}
    return Unexplained("lasting", float(shares[order[0]]), every[0], tuple(every), path, sizes=lasting)


def measure_asked(residuals_by_run: Sequence[RunResiduals]) -> Floats:
    """Motion that was asked for, rms of x, y, w; sideways it is measured by the way forward."""
    velocities = [run_residuals.predict_velocity((), Timing()) for run_residuals in residuals_by_run]
    x, y, w = (
        math.sqrt(float(np.mean(np.concatenate([getattr(one, name) for one in velocities]) ** 2)))
        for name in ("x", "y", "w")
    )
    return np.maximum([x, max(x, y), w], 1e-9)


def summarize_disturbance(fit: PathFit) -> Disturbance:
    """What is left of x, y, w."""
    noise, spans = fit.noise, fit.path.spans[:, None]
    scale = noise.spread
    return Disturbance(
        rms=tuple(np.sqrt(((fit.residual / spans) ** 2).mean(axis=0)).tolist()),
        lasting=tuple((np.sqrt(noise.share) * scale / noise.step_s).tolist()),
        pose_noise=tuple((np.sqrt(1.0 - noise.share) * scale).tolist()),
    )
