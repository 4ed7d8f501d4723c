"""The last step of the ladder: a linear regression of the residual, used only if it helps.

Bayesian linear regression of the residual velocity on `INPUTS` (MacKay, Neural Computation 4, 1992), channel
by channel. It is used if it lowers a held-out error over 2 s significantly and raises none.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from threadpoolctl import threadpool_limits

from pipeline.core import FOLDS, Flags, Floats, Ints, format_share, robust_spreads
from pipeline.estimation.errors import Errors
from pipeline.estimation.estimation_data import FEWEST_WINDOWS, EstimationData
from pipeline.estimation.evidence import regress
from pipeline.estimation.held_out import HeldOut, find_in_test, hold_out, number_predictions, score
from pipeline.estimation.ladder import LadderStep, ModelAssessment, find_share_removed, judge_whole
from pipeline.estimation.model_fit import Fitted, fit_model
from pipeline.estimation.model_state import ModelState
from pipeline.estimation.run_residuals import Input
from pipeline.estimation.transfer import fit_as_it_is
from pipeline.estimation.window_residuals import CLIP
from pipeline.models import (
    INPUTS,
    Bands,
    Effect,
    InputProbe,
    Late,
    LearnedInput,
    Model,
    ResidualTerm,
    drop_learned,
    find_learned,
    learned_as_table,
)
from pipeline.results import (
    ABOVE_FLOOR,
    CHANCE,
    ERRORS_OVER_2S,
    Learned,
    LearnedShare,
    format_rises,
    list_rises,
    read_error,
)
from pipeline.run import MotionRun

if TYPE_CHECKING:
    from pipeline.estimation.across_runs import Coverage, Ratios
    from pipeline.estimation.rivals import Rival

_INDEPENDENT = 0.25
"""Share of independent windows of half a second: their residuals are correlated for two seconds, as in
`acceptance._CLUSTER`."""
_LEAST_GAIN = 0.01
"""Minimum relative decrease of a channel's held-out sum of squares; below it, no term is added there."""
_WORSE = 0.02
"""Tolerated relative increase of an error on a left-out ground with a learned term."""


@dataclass(frozen=True)
class ResidualData:
    """Residuals of a model and the inputs of a learned term.

    Attributes:
        data: the runs.
        state: the model with its values.
    """

    data: EstimationData
    state: ModelState

    @cached_property
    def windows(self) -> tuple[Floats, Floats, Flags]:
        """Inputs (n, p) and residuals (n, 3) of all windows, and whether each lies within one prediction."""
        from pipeline.estimation.rivals import average_features  # noqa: PLC0415 - only where a term is learned

        known, residuals, whole = list[Floats](), list[Floats](), list[Flags]()
        for run, run_residuals in enumerate(self.data.residuals_by_run):
            probe = InputProbe()
            effects = (*self.state.effects_of(run), probe)
            residuals.append(run_residuals.find_residuals(effects, self.state.timing[run], restarted=True))
            mean, inside = average_features(run_residuals, probe.known)
            known.append(mean)
            whole.append(inside)
        return np.concatenate(known), np.concatenate(residuals), np.concatenate(whole)

    def learn(self, rows: Flags) -> ResidualTerm:
        """Learn from a mask of windows, shape (n,); the term has no inputs if there is nothing to learn."""
        inputs, residuals, whole = self.windows
        rows = rows & whole
        if rows.sum() < FEWEST_WINDOWS:
            return ResidualTerm()
        inputs, residuals, unit = inputs[rows], residuals[rows], self.data.whole.unit[rows]
        most = CLIP * np.maximum(robust_spreads(residuals), 1e-9)
        targets = np.clip(residuals, -most, most)
        scale = np.sqrt((inputs**2).mean(axis=0))
        live = np.flatnonzero(scale > 1e-9)  # noqa: PLR2004 - what is always zero tells nothing
        scaled = inputs[:, live] / scale[live]
        with threadpool_limits(1):
            adds = np.column_stack([regress_where_it_helps(scaled, target, unit) for target in targets.T])
        if not adds.any():
            return ResidualTerm()
        names = tuple(INPUTS)
        return ResidualTerm(
            LearnedInput(
                names[column],
                float(scale[column]),
                float(inputs[:, column].min()),
                float(inputs[:, column].max()),
                (float(x), float(y), float(w)),
            )
            for column, (x, y, w) in zip(live.tolist(), adds, strict=True)
        )

    def cross_validate(self, rows: Flags) -> tuple[HeldOut, HeldOut, Ints]:
        """Errors without a learned term and held-out errors with it, with unchanged physics.

        Args:
            rows: mask of the windows to use, shape (n,); predictions of others have no errors.

        Returns:
            The errors of both, and the stretch of each prediction of all runs.
        """
        data, state = self.data, self.state
        before = score(data, state)
        shapes = [errors.shape for errors in before.position]
        position, yaw = ([np.full(shape, np.nan) for shape in shapes] for _ in range(2))
        seen = [np.zeros(shape, dtype=bool) for shape in shapes]
        for fold in data.folds:
            test = fold.test & rows
            if not test.any():
                continue
            term = self.learn(rows & fold.train)
            for run, run_residuals in enumerate(data.residuals_by_run):
                mine = data.whole.run == run
                in_test = find_in_test(run_residuals, data.whole.times[mine], test[mine])
                if in_test.any():
                    held_errors = run_residuals.find_horizon_errors(
                        (*state.effects_of(run), term), state.timing[run]
                    )
                    position[run][in_test], yaw[run][in_test] = (
                        held_errors.position[in_test],
                        held_errors.yaw[in_test],
                    )
                    seen[run] |= in_test
        known = tuple(
            np.where(one, errors, np.nan) for one, errors in zip(seen, before.position, strict=True)
        )
        turned = tuple(np.where(one, errors, np.nan) for one, errors in zip(seen, before.yaw, strict=True))
        after = replace(before, position=tuple(position), yaw=tuple(yaw))
        stretches = np.concatenate(number_predictions(data))
        return replace(before, position=known, yaw=turned), after, stretches


def regress_where_it_helps(inputs: Floats, target: Floats, unit: Ints) -> Floats:
    """Coefficients, or zeros if they explain nothing in held-out stretches."""
    fold = np.unique(unit, return_inverse=True)[1] % FOLDS
    if not fold.any():  # one stretch: none is left to test on
        return np.zeros(inputs.shape[1])
    remaining = 0.0
    for number in range(FOLDS):
        test = fold == number
        if test.any():
            coefficients = regress(inputs[~test], target[~test], _INDEPENDENT)
            remaining += float(((target[test] - inputs[test] @ coefficients) ** 2).sum())
    if remaining > (1.0 - _LEAST_GAIN) * float((target**2).sum()):
        return np.zeros(inputs.shape[1])
    return regress(inputs, target, _INDEPENDENT)


def explain_no_help(before: HeldOut, after: HeldOut, stretches: Ints) -> str:
    """Reason why a learned term does not help; empty if it does.

    Args:
        before: errors without it.
        after: errors with it, at the same predictions.
        stretches: the ten-second stretch of each prediction of all runs.
    """
    old, new = (_measure_horizon_errors(one) for one in (before, after))
    if rises := format_rises(old, new, CHANCE):
        return rises
    falls = list_rises(new, old, CHANCE)
    if not falls:
        return f"no error over 2 s falls by more than {format_share(CHANCE)}"
    from pipeline.estimation.rivals import compare_errors  # noqa: PLC0415 - only where a term is learned

    for name in falls:
        one, other = (
            np.concatenate(held.position if name == "t_mrmse_m" else held.yaw) for held in (after, before)
        )
        if compare_errors(one, other, stretches).high < 0.0:
            return ""
    return "the reduction is not significant"


def _measure_horizon_errors(held_out: HeldOut) -> dict[str, object]:
    """Both errors over 2 s, from the predictions with finite errors."""
    return {
        name: float(np.sqrt(np.nanmean(np.concatenate(errors) ** 2)))
        for name, errors in zip(ERRORS_OVER_2S, (held_out.position, held_out.yaw), strict=True)
    }


@dataclass(frozen=True)
class LearnedStep:
    """A learned term on top of a fitted model.

    Attributes:
        term: the term learned from all data, with its bands.
        below: held-out errors without it.
        held_out: held-out errors with it.
        refusal: reason why it does not help; empty if it does.
    """

    term: ResidualTerm
    below: HeldOut
    held_out: HeldOut
    refusal: str

    def share_removed(self, ideal: Errors, floor: Errors) -> dict[str, tuple[float, float] | None]:
        """Explained shares of the removable error with the physics, and with the term; by error."""
        shares: dict[str, tuple[float, float] | None] = {}
        for name in ERRORS_OVER_2S:
            most, least = read_error(ideal, name), read_error(floor, name)
            before, after = (
                find_share_removed(read_error(one.pooled, name), most, least)
                for one in (self.below, self.held_out)
            )
            shares[name] = None if before is None or after is None else (before, after)
        return shares


def make_learned_step(data: EstimationData, fitted: Fitted, below: HeldOut) -> LearnedStep:
    """Learn the residual of a fitted model, and score both on held-out stretches.

    Args:
        data: the runs.
        fitted: the model without a learned term.
        below: its held-out errors.
    """
    residual_data = ResidualData(data, fitted.state)
    term = residual_data.learn(np.ones(data.whole.run.size, dtype=bool))
    if not term.inputs:
        return LearnedStep(term, below, below, "no input explains the residual")
    from pipeline.estimation.across_runs import list_ratios, make_bands  # noqa: PLC0415 - only where a term is learned

    above = hold_out(data, fitted, learn_fold(data))
    refusal = explain_no_help(below, above, np.concatenate(number_predictions(data)))
    state = fitted.state.add(term)
    bands = make_bands(list_ratios(data, state, above), _name_own(data))
    if not refusal and (apart := leave_grounds_out(data, fitted.model, fitted.per_run)) is not None:
        bands, refusal = apart.bands, apart.refusal
    return LearnedStep(ResidualTerm(term.inputs, bands), below, above, refusal)


def fit_and_hold_out(
    data: EstimationData, model: Model, per_run: Sequence[str] = ()
) -> tuple[Fitted, HeldOut]:
    """Fit the physics of a model, retrain its learned term if it has one, and score both together."""
    physics = judge_whole(data, drop_learned(model), per_run)
    fitted, below = physics.fitted, physics.held_out
    if find_learned(model) is None:
        return fitted, below
    step = make_learned_step(data, fitted, below)
    return add_term(fitted, step.term), step.held_out


def judge_with_term(data: EstimationData, name: str, model: Model, per_run: Sequence[str] = ()) -> Rival:
    """As `judge_rival`, for a model that may have a learned term, which is retrained."""
    from pipeline.estimation.rivals import Rival, judge_fit, time_fit  # noqa: PLC0415 - only where a term is learned

    fitted, fit_s = time_fit(data, drop_learned(model), per_run)
    physics = judge_fit(data, name, fitted, fit_s)
    if find_learned(model) is None:
        return physics
    start_s = time.process_time()
    term = ResidualData(data, fitted.state).learn(np.ones(data.whole.run.size, dtype=bool))
    learned_s = time.process_time() - start_s
    numbers = (physics.numbers or 0) + _count_numbers(term)
    return Rival(name, numbers, hold_out(data, fitted, learn_fold(data)), fit_s + learned_s)


def _count_numbers(term: ResidualTerm) -> int:
    return sum(bool(add) for one in term.inputs for add in one.adds)


def judge_learned_term(assessment: ModelAssessment) -> ModelAssessment:
    """The assessment of a model, with a learned term added."""
    below = assessment.whole
    step = make_learned_step(assessment.data, below.fitted, below.held_out)
    last = LadderStep(add_term(below.fitted, step.term), step.held_out)
    return replace(assessment, learned=last)


def add_term(fitted: Fitted, term: ResidualTerm) -> Fitted:
    """A fit with a learned term added, all parameters unchanged."""
    state = fitted.state.add(term)
    return replace(fitted, state=state)


def _name_own(data: EstimationData) -> str:
    return "of this run only" if len(data.runs) == 1 else "of these runs only"


Learn = Callable[[ModelState, Flags], Callable[[int], Sequence[Effect]]]


def learn_fold(data: EstimationData) -> Learn:
    """Learned term retrained without the tested stretches, as `hold_out` requires."""

    def learn(state: ModelState, rows: Flags) -> Callable[[int], Sequence[Effect]]:
        term = ResidualData(data, state).learn(rows)
        return lambda _run: (term,)

    return learn


def learn_where_it_helps(data: EstimationData) -> Learn:
    """As `learn_fold`, with a term used only if it helps on the training data: the choice is held out."""

    def learn(state: ModelState, rows: Flags) -> Callable[[int], Sequence[Effect]]:
        residual_data = ResidualData(data, state)
        term = (
            ResidualTerm()
            if explain_no_help(*residual_data.cross_validate(rows))
            else residual_data.learn(rows)
        )
        return lambda _run: (term,)

    return learn


@dataclass(frozen=True)
class GroundsOut:
    """Result of a learned term on grounds left out in turn.

    Attributes:
        bands: bands from the errors there; None if there is too little driving.
        refusal: runs on which an error rises, and by how much; empty if there are none.
    """

    bands: Bands | None
    refusal: str


def leave_grounds_out(data: EstimationData, model: Model, per_run: Sequence[str] = ()) -> GroundsOut | None:
    """Learn without each ground in turn, and score on that ground; None if all runs are on one ground.

    Args:
        data: the runs.
        model: the physics, refitted without each ground.
        per_run: as in `fit_model`; such parameters are fitted on the left-out ground, too.
    """
    grounds = sorted({run.terrain for run in data.runs})
    if len(grounds) < 2:  # noqa: PLR2004 - nothing is left where the only one is left out
        return None
    from pipeline.estimation.across_runs import list_ratios, make_bands  # noqa: PLC0415 - only where a term is learned

    ratios: list[Ratios] = []
    refusals: list[str] = []
    for ground in grounds:
        rest = _take(data, [run for run in data.runs if run.terrain != ground])
        fitted = fit_model(rest, model, per_run=per_run)
        term = ResidualData(rest, fitted.state).learn(np.ones(rest.whole.run.size, dtype=bool))
        for run in data.runs:
            if run.terrain == ground:
                there = _take(data, [run])
                state = fit_own(there, fitted.model, per_run).state
                before, after = (score(there, one) for one in (state, state.add(term)))
                ratios += list_ratios(there, state, after)
                if rises := format_rises(before.pooled, after.pooled, _WORSE):
                    refusals.append(f"learned without {ground}, on {run.name} {rises}")
    bands = make_bands(ratios, f"of {len(grounds)} terrains, each left out in turn")
    return GroundsOut(bands, "; ".join(refusals))


def _take(data: EstimationData, runs: Sequence[MotionRun]) -> EstimationData:
    return EstimationData(runs, data.vehicle, data.source, heading=data.heading)


def check_bands(
    model: Model, runs: Sequence[MotionRun], source: Input, per_run: Sequence[str] = ()
) -> list[dict[str, Coverage]]:
    """Coverage of the bands of a model, for each run by `position` and `heading`.

    Args:
        model: model; the result is empty unless it has a learned term with bands.
        runs: runs to which it is transferred.
        source: its input.
        per_run: labels of parameters with one value per run.
    """
    coverages: list[dict[str, Coverage]] = []
    term = find_learned(model)
    if term is None or term.bands is None:
        return coverages
    from pipeline.estimation.across_runs import list_ratios, measure_coverage  # noqa: PLC0415 - only where a term is learned

    for run in runs:
        there = EstimationData([run], model.vehicle, source)
        state = fit_own(there, model, per_run).state
        coverages.append(measure_coverage(term.bands, list_ratios(there, state, score(there, state))))
    return coverages


def fit_own(data: EstimationData, model: Model, per_run: Sequence[str] = ()) -> Fitted:
    """A model on runs that it was not fitted on: only clocks and parameters of single runs are fitted."""
    clocks = [f"{one.id}.{name}" for one in model if one.late is Late.POSES for name in one.values]
    return fit_as_it_is(data, model, (*clocks, *per_run))


def learn_beyond(assessment: ModelAssessment) -> LearnedStep | None:
    """A learned term on top of a judged model; None if it has one already.

    Nothing is learned from an error at the noise floor.
    """
    below, floor = assessment.whole, assessment.floor
    if find_learned(below.fitted.model) is not None:
        return None
    if all(read_error(below.errors, one) < ABOVE_FLOOR * read_error(floor, one) for one in ERRORS_OVER_2S):
        at_floor = "the remaining error is at the noise floor"
        return LearnedStep(ResidualTerm(), below.held_out, below.held_out, at_floor)
    return make_learned_step(assessment.data, below.fitted, below.held_out)


def summarize_learned(step: LearnedStep, ideal: Errors, floor: Errors) -> Learned:
    """The gain of a learned term as a result."""
    reached = step.held_out.pooled
    return Learned(
        helps=not step.refusal,
        reason=step.refusal or None,
        t_mrmse_m=reached.t_mrmse_m,
        r_mrmse_rad=reached.r_mrmse_rad,
        explained_share={
            name: LearnedShare(*one) if one else None
            for name, one in step.share_removed(ideal, floor).items()
        },
        term=None if step.refusal else learned_as_table(step.term),
    )
