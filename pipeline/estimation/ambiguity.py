"""What a log does not decide: explanations that fit as well as the chosen one, and unobservable effects."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace

from pipeline.core import Floats, Ints
from pipeline.estimation.decision import LEAST_T, STABLE_T, Search, SearchResult
from pipeline.estimation.estimates import list_first_run
from pipeline.estimation.fit import PathFit, whiten_columns
from pipeline.estimation.intervals import estimate_path
from pipeline.estimation.run_residuals import Input
from pipeline.models import (
    LEAST_DELAY_S,
    STANDING,
    Effect,
    Largest,
    Late,
    Number,
    find_late,
    find_late_effect,
    list_effects,
)
from pipeline.models import Search as HowSearched
from pipeline.results import Delays, Detectable, Undecided, Unobservable
from pipeline.run import MotionRun
from pipeline.sources import Vehicle

if TYPE_CHECKING:
    from pipeline.estimation.estimation_data import EstimationData
    from pipeline.estimation.ladder import ModelAssessment
    from pipeline.estimation.model_fit import Fitted

DETECTED = LEAST_T + 1.3
"""Size of an effect [standard errors] that is named in nine of ten logs."""


def find_undecided(search: Search, outcome: SearchResult) -> Iterator[Undecided]:
    """For every identified effect, the alternatives among which the data do not decide."""
    candidates = {candidate.id: candidate for candidate in search.candidates}
    for name in outcome.new:
        effect = outcome.final.state.find(name)
        if effect is None:
            continue
        rivals = {one.other: one.fit for one in outcome.rivals if one.effect == name}
        largest = search.conditions.largest
        same = effect.same_in_one_motion if largest.is_one_motion else ()
        # Whichever fits the transients better: what a drive does at another speed is not known.
        same += effect.same_at_one_speed if largest.is_one_speed else ()
        alike = [
            one
            for one in dict.fromkeys(same)
            if one in candidates and one not in outcome.final.ids and _is_asked(candidates[one](), largest)
        ]
        names = [*dict.fromkeys([*rivals, *alike])]
        if names:
            numbers = {name: _read_numbers(outcome.final, name)}
            numbers |= {other: _read_numbers(fit, other) for other, fit in rivals.items()}
            yield Undecided((name, *names), numbers)


def _is_asked(effect: Effect, largest: Largest) -> bool:
    """Whether a run asks for the motion that an effect limits: the speed or the turning."""
    asked = {"speed": largest.speed, "turn": largest.turn}
    return all(asked.get(p.relative_to, math.inf) > STANDING for p in effect.parameters)


def _read_numbers(fit: PathFit, name: str) -> dict[str, Number]:
    """Values of an effect of a model in the first run, with their intervals."""
    return list_first_run(fit.state, estimate_path(fit))[name]


def take_judged(items: Iterable[Undecided], assessment: ModelAssessment) -> list[Undecided]:
    """The same groups, with the values and intervals of a judged model for the effects in it."""
    estimated = list_first_run(assessment.fitted.state, assessment.estimates)
    return [
        replace(item, parameters={name: estimated.get(name, old) for name, old in item.parameters.items()})
        for item in items
    ]


_SURE = 4.0
"""Standard errors from which on a delay of the heading is beyond doubt."""
_SKEWED_CLOCK = 0.03
"""Smallest reported pose delay [s] where the heading is delayed against the positions."""


@dataclass(frozen=True)
class Clocks:
    """Clock effects and delays of the runs.

    Attributes:
        effects: delays of poses and of heading, as far as they are significant.
        timing: of every run.
        undecided: a late heading whose position may be late, too.
    """

    effects: tuple[Effect, ...]
    timing: tuple[Delays, ...]
    undecided: tuple[Undecided, ...] = ()

    def list_runs(self, fitted: Fitted | None) -> list[Delays]:
        """`timing`, with the delays of the encoders in the fit of the written model, if there is one."""
        if fitted is None:
            return list(self.timing)
        return [
            row if row.wheel_delay_s is None else replace(row, wheel_delay_s=round(delay.wheel_delay_s, 4))
            for row, delay in zip(self.timing, fitted.state.timing, strict=True)
        ]


def read_clocks(data: EstimationData, outcome: SearchResult, source: Input) -> Clocks:
    """Identify clock effects: with a gyro the delays of heading and position are known separately."""
    state = outcome.final.state
    extra = find_late(state.effects, Late.POSES)
    rows, positions, skews, certain = [], [], [], []
    for number, (timing, run) in enumerate(zip(state.timing, data.runs, strict=True)):
        yaw = run.alignment.heading_delay_s
        own = find_late(state.effects_of(number), Late.POSES)
        heading_delay = own.delay if own is not None else 0.0
        late = yaw + heading_delay
        positions.append(late)
        skews.append(heading_delay)
        certain.append(_is_late(run))
        rows.append(
            Delays(
                heading="gyro" if run.gyro_fit is not None else "pose",
                pose_delay_s=round(late, 4),
                yaw_delay_s=None if run.gyro_fit is None else round(yaw, 4),
                wheel_delay_s=round(timing.wheel_delay_s, 4) if source is Input.MEASURED else None,
            )
        )
    late_effects: list[Effect] = []
    late, heading_delay = float(np.mean(positions)), float(np.mean(skews))
    # Only a heading older than its position is reported as such; the opposite is a late position.
    is_named = extra is not None and extra.id in {*outcome.new, *outcome.start.ids}
    skewed = is_named and data.has_gyro and heading_delay < 0.0
    if skewed:
        late_effects.append(find_late_effect(Late.HEADING).of_delay(-heading_delay))
    least = max(LEAST_DELAY_S, _SKEWED_CLOCK if skewed else 0.0)
    known = any(certain) if data.has_gyro else is_named
    if known and max(map(abs, positions)) >= least:
        clock = find_late_effect(Late.POSES).of_delay(late)
        if data.has_gyro and not data.largest.moves_both_ways:
            # The gyro gives the heading delay; relating it to the position clock needs driving and turning.
            skew = find_late_effect(Late.HEADING)()
            return Clocks(tuple(late_effects), tuple(rows), (Undecided((clock.id, skew.id)),))
        late_effects.append(clock)
    return Clocks(tuple(late_effects), tuple(rows))


def _is_late(run: MotionRun) -> bool:
    """Whether the reported heading is late or early against the gyro beyond doubt."""
    gyro = run.gyro_fit
    delay = abs(run.alignment.heading_delay_s)
    return gyro is not None and delay >= LEAST_DELAY_S and delay > _SURE * gyro.delay_error_s


def join_classes(effects: Sequence[Effect], vehicle: Vehicle) -> list[Effect]:
    """Effects with parts joined to their composite if all were identified or one can only be part of it."""
    joined = {effect.id: effect for effect in effects}
    for kind in list_effects():
        parts = kind().searched_as
        is_whole = any(joined[part].is_outside(vehicle) for part in parts & joined.keys())
        if kind.parts and (is_whole or parts <= joined.keys()):
            joined = {name: effect for name, effect in joined.items() if name not in parts} | {
                kind.id: kind.join(joined)
            }
    return list(joined.values())


def list_equivalents(effect: Effect, data: EstimationData) -> tuple[str, ...]:
    """Effects equivalent to this one under the conditions of the recordings."""
    return effect.equivalent_to if effect.is_equivalent(data.conditions) else ()


def find_unobservable(
    search: Search, outcome: SearchResult
) -> tuple[dict[str, Unobservable], list[Detectable]]:
    """Candidates that would not be named in this log at their typical size, nor if they show only once.

    Returns:
        These, and the detection thresholds of the other effects that are linear in one parameter.
    """
    fit, path = outcome.matrix.fit, search.path
    own = fit.white.columns
    basis = np.linalg.qr(own / (np.linalg.norm(own, axis=0) + 1e-12))[0] if own.size else own
    unit = path.unit[fit.white.rows]
    unobservable, seen = dict[str, Unobservable](), list[Detectable]()
    for candidate in search.candidates:
        if candidate.id in fit.ids or not candidate().acts_in(fit.ids):
            continue
        usual = candidate().make_usual(search.conditions.largest)
        shift = fit.residual - path.find_residuals(fit.state.add(usual))
        column = whiten_columns(fit, shift[:, :, None])[:, 0]
        beside = column - basis @ (basis.T @ column) if own.size else column
        if _is_seen(beside, unit):
            seen += _find_detectable(usual, math.sqrt(float(beside @ beside)))
            continue
        reason = "collinear with what was named" if _is_seen(column, unit) else "no excitation"
        unobservable[candidate.id] = Unobservable(reason)
    return unobservable, seen


def _is_seen(column: Floats, unit: Ints) -> bool:
    """Whether a column of innovations is significant, also without its strongest ten seconds."""
    power = np.bincount(unit, column**2)
    total = float(power.sum())
    return total >= LEAST_T**2 and total - float(power.max()) >= STABLE_T**2


def _find_detectable(usual: Effect, standard_errors: float) -> list[Detectable]:
    """Detection threshold of an effect of one parameter; its motion is proportional to it."""
    (parameter, *others) = usual.parameters
    distance = abs(usual.values[parameter.name] - parameter.neutral)
    if others or parameter.search is not HowSearched.DIRECT or not math.isfinite(distance):
        return []
    least = 0.0 if parameter.least is None else parameter.least.size
    size = max(distance * DETECTED / standard_errors, least)
    return [Detectable(usual.id, parameter.name, parameter.unit, size)]
