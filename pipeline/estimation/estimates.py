"""Values of effects with intervals (identified, not significant, all), and findings."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace as replace_fields

from pipeline.core import NORMAL_95
from pipeline.core.arrays import number_stretches
from pipeline.estimation.driving_need import measure_driven
from pipeline.estimation.fit import PathFit, find_unlearned, invert
from pipeline.estimation.intervals import Estimate, Estimates, estimate_path
from pipeline.estimation.ladder import ModelAssessment
from pipeline.estimation.model_fit import Fitted
from pipeline.estimation.model_state import ModelState, combine_columns
from pipeline.models import (
    Effect,
    Interval,
    Late,
    Model,
    Number,
    expect_another_run,
    find_late,
    is_of_one_run,
    list_effects,
)
from pipeline.recording import Finding
from pipeline.results import (
    BREVITY,
    SEARCH_CUT,
    EstimatedNumber,
    Named,
    RunDiagnosis,
)
from pipeline.run import MotionRun

if TYPE_CHECKING:
    from pipeline.core import Budget
    from pipeline.estimation.estimation_data import EstimationData

_NOTHING: Mapping[str, Number] = {}
_UNKNOWN = Number(math.nan)
_PASSES = 2
"""Steps of the estimate of an effect that a model lacks, the noise learned anew after each."""


def list_values(
    effect: Effect, estimates: Estimates | None, noted: Mapping[str, Number] = _NOTHING
) -> dict[str, Number]:
    """Values of an effect with the intervals of a fit, NaN where the fit has none, and their doubts.

    Args:
        effect: with its values.
        estimates: of the fit; None without one.
        noted: what the driving makes doubtful, by label; see `ModelAssessment.numbers`.
    """
    known = {} if estimates is None else {item.free.label: item.number for item in estimates.items}
    numbers = {}
    for parameter in effect.parameters:
        value, label = effect.values[parameter.name], f"{effect.id}.{parameter.name}"
        if not math.isfinite(value):
            continue
        fitted, said = known.get(label, _UNKNOWN), noted.get(label, _UNKNOWN)
        fitted = replace_fields(fitted, value=value, doubt=said.doubt, stretches=said.stretches)
        number = fitted.doubt_as(parameter)
        own = number.at_bound or is_of_one_run(effect.parameters)
        numbers[parameter.name] = replace_fields(
            number,
            another_run=Interval() if own else expect_another_run(parameter, number),
            is_spread_measured=parameter.between_runs is not None,
        )
    return numbers


def list_first_run(state: ModelState, estimates: Estimates) -> dict[str, dict[str, Number]]:
    """Values of every effect of a fitted state in the first run, by id."""
    first = estimates.choose_run(0)
    return {effect.id: list_values(effect, first) for effect in state.effects_of(0)}


def read_clock(effect: Effect, run: MotionRun) -> dict[str, Number]:
    """Pose delay from a run's gyro, with the error of the gyro fit; fits of the motion do not change it.

    Its interval is that of the mean delay of the run. Delays of single poses vary about it, each for some
    seconds, so that every stretch of ten seconds tells one. Half a gyro sample is part of it: a stamp may
    mark the beginning or the end of a sample. Where poses are repeated until the next one is computed, a pose
    may be as old as the time between two of them when it is first published.
    """
    (parameter,) = effect.parameters
    value = effect.values[parameter.name]
    half = math.nan
    if run.gyro_fit is not None and run.gyro is not None:
        sampling = 0.5 * float(np.median(np.diff(run.gyro[0]))) / NORMAL_95
        stretches = np.unique(number_stretches(run.track.times - run.track.times[0])).size
        varying = run.alignment.latency_spread_s / math.sqrt(stretches)
        half = NORMAL_95 * math.sqrt(run.gyro_fit.delay_error_s**2 + varying**2 + sampling**2)
    number = Number(value, value - half - run.repeats_s, value + half, parameter.unit)
    there, is_measured = expect_another_run(parameter, number), parameter.between_runs is not None
    return {parameter.name: replace_fields(number, another_run=there, is_spread_measured=is_measured)}


def list_estimates(
    data: EstimationData, assessment: ModelAssessment, named: Sequence[Named]
) -> Iterator[EstimatedNumber]:
    """Estimates of one judged model, of the corrected clocks, and of the effects that the model lacks.

    Effects that contain one of the model, or are contained in one, are left out.

    Args:
        data: the runs.
        assessment: a model on them.
        named: effects that the diagnosis names.
    """
    source, model = assessment.data.source, assessment.fitted.model
    ids = {effect.id for effect in named}
    known = {effect.id for effect in list_effects()}
    candidates = {e.id: e() for e in (*data.list_candidates(source), *data.list_drivetrain())}
    rivals = [
        effect for effect in candidates.values() if effect.id not in ids and not _overlaps(effect, model)
    ]
    for item in (*assessment.estimates.items, *estimate_unnamed(assessment.fitted, rivals)):
        error, number = item.deviation, item.free
        if number.effect in known and not number.runs and math.isfinite(item.value + error) and error > 0.0:
            yield EstimatedNumber(
                source.value, number.effect, number.name, number.unit, item.value, error,
                named=number.effect in ids, at_bound=item.at_bound, in_model=number.effect in model,
            )  # fmt: skip
    for effect in named:
        for name, value in effect.parameters.items():
            error = (value.high - value.low) / (2.0 * NORMAL_95)
            if effect.id not in model and effect.corrected and math.isfinite(error) and error > 0.0:
                yield EstimatedNumber(
                    source.value, effect.id, name, value.unit, value.value, error,
                    named=True, at_bound=value.at_bound, in_model=False,
                )  # fmt: skip


def _overlaps(effect: Effect, model: Model) -> bool:
    """Whether an effect is a special case of one of the model, or the other way round."""
    return any(effect.id in one.contains or one.id in effect.contains for one in model)


def note_brevity(data: EstimationData, common: RunDiagnosis) -> list[Finding]:
    """A finding where the driving is too short for reliable identification."""
    driven, least = measure_driven(data)
    if driven >= least:
        return []
    values = {"runs": len(data.runs), "driven_s": driven, "least_s": least, "input": common.input}
    return [Finding(BREVITY, "warning", "diagnosis", values)]


def note_cut(budget: Budget) -> list[Finding]:
    """A finding where the budget stopped the search before it was complete."""
    if not budget.was_cut:
        return []
    return [Finding(SEARCH_CUT, "warning", "diagnosis", {"budget_s": budget.seconds})]


def estimate_unnamed(fitted: Fitted, candidates: Iterable[Effect]) -> tuple[Estimate, ...]:
    """Estimates of effects that a fitted model lacks, each added to it alone, by one joint step.

    Excluded are effects that the model has, that do not act on its input, or whose parameters derivatives
    cannot optimize, and parameters that are not observable or undetermined within their bounds.

    Args:
        fitted: a converged fit.
        candidates: effects at neutral values.
    """
    estimates: list[Estimate] = []
    for effect in candidates:
        if effect.id in fitted.model or not all(math.isfinite(p.neutral) for p in effect.parameters):
            continue
        fit = next((fit for fit in fitted.fits if fit.path.owns(effect)), None)
        estimates += [] if fit is None else _estimate_added(fit, effect)
    return tuple(estimates)


def _estimate_added(fit: PathFit, effect: Effect) -> list[Estimate]:
    path, added = fit.path, fit.state.add(effect)
    new = tuple(n for n in path.list_free(added) if n.effect == effect.id)
    if not all(number.is_smooth for number in new):
        return []
    columns = path.differentiate(added, fit.residual, new)
    grown = replace(
        fit, state=added, free=(*fit.free, *new), columns=np.concatenate((fit.columns, columns), axis=2)
    )
    total = np.zeros(len(grown.free))
    for _ in range(_PASSES):
        pull = grown.white.columns.T @ grown.white.residual
        step = invert(grown.normal) @ pull
        total += step
        grown = replace(grown, residual=grown.residual - combine_columns(grown.columns, step))
        if float(step @ pull) <= find_unlearned(path):
            break
        # The noise of residuals that still hold an effect would hide it.
        grown = replace(grown, noise=path.learn(grown.residual, grown.noise))
    moved = dict(zip(grown.free, total.tolist(), strict=True))
    made = {item.free: item for item in estimate_path(grown).items}
    if not all(made[number].observable for number in new):
        return []
    return [
        replace(made[number], value=made[number].value + moved[number], at_bound=False)
        for number in new
        if math.isfinite(made[number].low)
    ]


def was_aligned(effect: Effect, data: EstimationData) -> bool:
    """Whether an effect is a clock offset that the gyro corrected before any model was fitted."""
    return effect.late is Late.POSES and data.has_gyro


def list_by_run(
    effect: Effect, data: EstimationData, assessment: ModelAssessment | None
) -> tuple[dict[str, Number], ...]:
    """Values of an effect: by run where runs or grounds have their own, else once."""
    if was_aligned(effect, data):
        delays = [run.alignment.heading_delay_s for run in data.runs]
        skew = None if assessment is None else find_late(assessment.fitted.model, Late.HEADING)
        beyond = effect.delay - float(np.mean(delays)) if skew is None else -skew.delay
        return tuple(
            read_clock(effect.of_delay(beyond + delay), run)
            for delay, run in zip(delays, data.runs, strict=True)
        )
    if assessment is None or effect.id not in assessment.fitted.model:
        return (list_values(effect, None),)
    acting = assessment.fitted.state.list_as_it_acts(assessment.fitted.model.effect(effect.id))
    by_run = [
        list_values(one, assessment.estimates.choose_run(run), assessment.numbers)
        for run, one in enumerate(acting)
    ]
    if effect.late is Late.POSES:
        # Where only some runs have a gyro, the delay that it corrected is part of the clock.
        by_run = [
            {name: value.move(run.alignment.heading_delay_s) for name, value in numbers.items()}
            for numbers, run in zip(by_run, data.runs, strict=False)
        ]
    return tuple(by_run)
