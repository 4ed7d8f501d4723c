"""The ladder: stepwise addition of a model's effects, scored on held-out data."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from pipeline.core import pick
from pipeline.estimation.driving_need import list_numbers
from pipeline.estimation.errors import measure_errors
from pipeline.estimation.estimation_data import EstimationData
from pipeline.estimation.floor import estimate_floor
from pipeline.estimation.held_out import HeldOut, hold_out
from pipeline.estimation.intervals import Estimates, estimate_intervals
from pipeline.estimation.model_fit import Fitted, fit_model
from pipeline.estimation.run_residuals import RunResiduals
from pipeline.estimation.window_residuals import average_windows, locate_windows
from pipeline.export import (
    DRIVEN_SPEED,
    DRIVEN_TURN,
    LOWER_SPEED,
    REACHED_ACCELERATION,
    REACHED_TURN_ACCELERATION,
)
from pipeline.models import Model, ModelFile, Number, Timing
from pipeline.results import CHANCE, ERRORS_OVER_2S, Errors, Step, as_written, list_rises, to_json
from pipeline.run import STILL_MPS
from pipeline.sources import RANGES

_LEAST_ROOM = 0.02
"""Minimum removable error, from the ideal model's to the floor, as a share of the ideal model's error."""
_DRIVEN_QUANTILE = 0.99
"""Quantile of the driven speed: the maximum would be that of one bad pose."""
_REACHED_S = 0.1
"""Time over which an acceleration is measured [s], two or three cycles of a controller."""


@dataclass(frozen=True)
class LadderStep:
    """One step of the ladder: the fit and its held-out errors."""

    fitted: Fitted
    held_out: HeldOut

    @property
    def effects(self) -> tuple[str, ...]:
        """Ids of the effects of this step."""
        return self.fitted.model.ids

    @property
    def errors(self) -> Errors:
        """Held-out errors over all runs."""
        return self.held_out.pooled

    def drop(self, name: str) -> LadderStep:
        """The model without one effect, refitted."""
        rest = [one for one in self.effects if one != name]
        return fit_step(self.fitted.data, self.fitted, rest)


@dataclass(frozen=True)
class Ladder:
    """Steps from the ideal model to the whole model.

    Attributes:
        steps: the ideal model first, all effects together last.
    """

    steps: tuple[LadderStep, ...]

    @property
    def idle(self) -> tuple[str, ...]:
        """Effects whose step lowers no held-out error by more than chance."""
        return tuple(
            name
            for below, step in pairwise(self.steps)
            if not np.any(np.array(step.errors.ratios(below.errors)) < 1.0 - CHANCE)
            for name in step.effects
            if name not in below.effects
        )

    def explained_shares(self, floor: Errors | None = None) -> tuple[float | None, ...]:
        """Share of the removable error that is explained at each step.

        (E_ideal - E) / (E_ideal - E_floor) on the position error over 2 s; None if they hardly differ.
        """
        ideal, least = self.steps[0].errors.t_mrmse_m, 0.0 if floor is None else floor.t_mrmse_m
        return tuple(find_share_removed(step.errors.t_mrmse_m, ideal, least) for step in self.steps)

    def as_result(self, floor: Errors | None = None) -> tuple[Step, ...]:
        """Its steps: their errors, the explained share of the removable error, and which errors rise."""
        shares = (math.nan if share is None else share for share in self.explained_shares(floor))
        below = (self.steps[0], *self.steps)
        return tuple(
            Step.of(step.errors, step.effects, share, list_rises(before.errors, step.errors))
            for before, step, share in zip(below, self.steps, shares, strict=False)
        )


def find_share_removed(error: float, ideal: float, floor: float) -> float | None:
    """Explained share of the removable error, from the ideal model's to the floor; None if both are equal."""
    room = ideal - floor
    return (ideal - error) / room if room > _LEAST_ROOM * ideal else None


def climb(data: EstimationData, model: Model, *, per_run: Sequence[str] = ()) -> Ladder:
    """Build the ladder of a model's effects, that effect next which most lowers the errors over 2 s.

    All effects are fitted together. Errors with one more are predicted with the values of that fit; of
    effects that lower them alike, the earlier one of the model comes first. At each step all parameters are
    refitted, from the values of the whole model; the last step is the model itself. An effect that raises an
    error is also a step: `list_rises` reports it.

    Args:
        data: the runs.
        model: model with the effects, whose values are the starts.
        per_run: as in `fit_model`.
    """
    return _climb_to(judge_whole(data, model, per_run), per_run)


def _climb_to(whole: LadderStep, per_run: Sequence[str]) -> Ladder:
    """The ladder up to a judged model: each step is what the model with only these effects is elsewhere."""
    data, model = whole.fitted.data, whole.fitted.model
    steps, taken = list[LadderStep](), list[str]()
    while len(taken) < len(whole.effects):
        steps.append(judge_whole(data, model.keep(taken), per_run))
        taken.append(_choose_next(data, whole.fitted, taken, steps[0].errors))
    return Ladder((*steps, whole))


def _choose_next(data: EstimationData, whole: Fitted, taken: Sequence[str], ideal: Errors) -> str:
    """The effect of a fit, beside those already taken, with the lowest predicted error."""
    first, *others = (name for name in whole.model.ids if name not in taken)
    if not others:
        return first
    errors = {name: _predict_error(data, whole, [*taken, name], ideal) for name in (first, *others)}
    least = min(errors.values())
    return next((name for name, error in errors.items() if error <= least + CHANCE), first)


def judge_whole(data: EstimationData, model: Model, per_run: Sequence[str] = ()) -> LadderStep:
    """The exact fit of a model's effects that act on the input, with its held-out errors.

    Whatever is said of a model's error on these runs is this; from the same values, it is the same to the
    last digit.
    """
    active = model.keep(effect.id for effect in data.active_effects(model))
    fitted = fit_model(data, active, per_run=per_run, exact=True)
    return LadderStep(fitted, hold_out(data, fitted))


def _predict_error(data: EstimationData, whole: Fitted, names: Sequence[str], ideal: Errors) -> float:
    """Sum of both errors over 2 s with some effects of a fit, relative to those of the ideal model.

    Where nothing can be predicted over 2 s, it is that of the velocities' errors.
    """
    state = whole.state.drop(set(whole.model.ids) - set(names))
    horizons = [
        run_residuals.find_horizon_errors(state.effects_of(run), state.timing[run])
        for run, run_residuals in enumerate(data.residuals_by_run)
    ]
    position, yaw = (np.concatenate([getattr(one, name) for one in horizons]) for name in ("position", "yaw"))
    is_known = np.isfinite(position).any()
    residuals = np.empty((0, 3)) if is_known else data.find_residuals(state)
    ratios = measure_errors(residuals, position, yaw).ratios(ideal)
    return sum(ratios[3:] if is_known else ratios[:3])


def list_order(steps: Sequence[LadderStep]) -> list[str]:
    """Ids of the effects in the order in which steps add them."""
    return list(dict.fromkeys(name for step in steps for name in step.effects))


def fit_step(
    data: EstimationData, whole: Fitted, names: Sequence[str], per_run: Sequence[str] = ()
) -> LadderStep:
    """The model with some of its effects, fitted from the whole model as far as a comparison needs it."""
    if not names:
        # It has only delays: they are estimated as elsewhere, not from those of the whole model.
        return judge_whole(data, whole.model.ideal)
    fitted = fit_model(data, whole.model.keep(names), per_run=per_run, start=whole)
    return LadderStep(fitted, hold_out(data, fitted))


def raises_errors(below: Errors | Mapping[str, object], errors: Errors | Mapping[str, object]) -> bool:
    """Whether a step raises both errors over 2 s, or one by more than chance and the other falls no more."""
    if len(list_rises(below, errors)) == len(ERRORS_OVER_2S):
        return True
    return bool(list_rises(below, errors, CHANCE)) and not list_rises(errors, below, CHANCE)


def lowers_errors(below: Errors | Mapping[str, object], errors: Errors | Mapping[str, object]) -> bool:
    """Whether a step lowers an error over 2 s by more than chance, and both together."""
    if raises_errors(below, errors) or not list_rises(errors, below, CHANCE):
        return False
    after, before = (math.prod(as_written(one, name) for name in ERRORS_OVER_2S) for one in (errors, below))
    return after < before


@dataclass(frozen=True)
class ModelAssessment:
    """Fit, ladder and estimates of a model on runs.

    Attributes:
        data: the runs.
        whole: all effects of the model, fitted together, with their held-out errors.
        estimates: its parameters with intervals.
        per_run: labels with one value per run.
        suggested: the effects with a suggested formula; None without one.
    """

    data: EstimationData
    whole: LadderStep
    estimates: Estimates
    per_run: tuple[str, ...] = ()
    suggested: LadderStep | None = None

    @cached_property
    def ideal(self) -> LadderStep:
        """The ideal model."""
        return judge_whole(self.data, self.whole.fitted.model.ideal)

    @cached_property
    def ladder(self) -> Ladder:
        """Held-out errors from the ideal to the whole model."""
        return _climb_to(self.whole, self.per_run)

    @property
    def fitted(self) -> Fitted:
        """The fit of all effects."""
        return self.whole.fitted

    @cached_property
    def numbers(self) -> dict[str, Number]:
        """Its numbers by label with what the driving makes doubtful; nothing is where a fleet adds to it."""
        has_prior = any(path.prior.numbers for path in self.data.paths)
        return self.estimates.numbers if has_prior else list_numbers(self.data, self.fitted, self.estimates)

    @cached_property
    def floor(self) -> Errors:
        """The noise floor of the runs, by what the physics leaves, and a suggested formula."""
        return estimate_floor(self.data, (self.suggested or self.whole).fitted.state)


def assess_model(data: EstimationData, model: Model, *, per_run: Sequence[str] = ()) -> ModelAssessment:
    """Fit a model.

    Args:
        data: the runs.
        model: its effects at neutral values are searched, others start from their values.
        per_run: labels with one value per run.
    """
    whole = judge_whole(data, model, per_run)
    return ModelAssessment(data, whole, estimate_intervals(whole.fitted), tuple(per_run))


def note_fit(file: ModelFile, assessment: ModelAssessment) -> ModelFile:
    """The model file with fitted values, intervals, and the data of the fit.

    Effects that do not act on the input keep their values.
    """
    fitted = assessment.fitted.model
    model = file.model.swap(*(effect for effect in fitted if effect.id in file.model))
    others = {label: one for label, one in file.numbers.items() if label.partition(".")[0] not in fitted.ids}
    data, estimates = assessment.data, assessment.estimates
    fit: dict[str, object] = {
        "input": data.source.value,
        "blocks": estimates.blocks,
        "noise_floor": to_json(assessment.floor),
        "runs": [
            {
                "run": run_residuals.run.name,
                "sha256": run_residuals.run.sha256,
                "terrain": run_residuals.run.terrain,
                "pose_delay_s": run_residuals.run.alignment.heading_delay_s,
                "wheel_delay_s": timing.wheel_delay_s,
                **driven,
                **_measure_reached(run_residuals, fitted, timing),
            }
            for run_residuals, timing, driven in zip(
                data.residuals_by_run, assessment.fitted.state.timing, measure_driven(data), strict=True
            )
        ],
        "ladder": [
            {
                "effects": list(step.effects),
                "velocity_rms": list(step.errors.velocity_rms),
                "t_mrmse_m": step.errors.t_mrmse_m,
                "r_mrmse_rad": step.errors.r_mrmse_rad,
            }
            for step in assessment.ladder.steps
        ],
    }
    own = [
        {
            "run": data.names[run],
            "parameter": item.free.label,
            **pick(item, "value", *(("low", "high") if math.isfinite(item.low) else ())),
        }
        for run in range(len(data.names))
        for item in estimates.items
        if item.free.effect and run in item.free.runs
    ]
    if own:
        fit["own"] = own
    # A dimension that one run only contradicts may be right, and the ground of that run slippery.
    contradicted = frozenset.intersection(*(one.run.contradicted for one in data.residuals_by_run))
    dimensions = pick(model.vehicle, *sorted(contradicted & {*RANGES}))
    if dimensions:
        fit["contradicted"] = dimensions
    per_run = tuple(dict.fromkeys((*file.per_run, *assessment.fitted.per_run)))
    # Other runs may distinguish effects that those of the diagnosis could not.
    names = [run["run"] for run in file.list_fitted("runs")]
    if names in ([], list(data.names)):
        ids = set(model.ids)
        undecided = [group for group in file.undecided if ids.intersection(group)]
        fit |= {key: rows for key, rows in (("undecided", undecided),) if rows}
    return replace(file, model=model, per_run=per_run, numbers=others | assessment.numbers, fit=fit)


def _measure_reached(run_residuals: RunResiduals, model: Model, timing: Timing) -> dict[str, float]:
    """Largest forward and yaw acceleration of a model over a tenth of a second of a run.

    The motion of poses is too noisy for them.
    """
    velocity = run_residuals.predict_velocity(run_residuals.list_active(model), timing)
    step = run_residuals.grid.step_s
    count = max(1, round(_REACHED_S / step))
    signals = {REACHED_ACCELERATION: velocity.x, REACHED_TURN_ACCELERATION: velocity.w}
    return {
        key: round(float(np.abs(one[count:] - one[:-count]).max()) / (count * step), 4)
        for key, one in signals.items()
        if one.size > count
    }


def measure_driven(data: EstimationData) -> list[dict[str, float]]:
    """Driven speed and yaw rate of each run over windows of half a second: the 99th percentile.

    Of the speed also the lower quartile of the windows in which it drives.
    """
    windows, driven = data.whole, []
    for run, run_residuals in enumerate(data.residuals_by_run):
        velocity = run_residuals.predict_velocity((), Timing())
        ideal = average_windows(run_residuals, velocity, locate_windows(run_residuals))
        measured = np.abs(windows.find_run_residuals(data.start_state(), run) + ideal)
        speed, _, turn = np.quantile(measured, _DRIVEN_QUANTILE, axis=0).tolist()
        moving = measured[:, 0][measured[:, 0] > STILL_MPS]
        lower = {LOWER_SPEED: round(float(np.quantile(moving, 0.25)), 4)} if moving.size else {}
        driven.append({DRIVEN_SPEED: round(speed, 4), DRIVEN_TURN: round(turn, 4), **lower})
    return driven
