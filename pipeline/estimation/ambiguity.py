"""What a log does not decide: explanations that fit as well as the chosen one, and unobservable effects."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.estimation.acceptance import (
    DECIDED_T,
    LEAST_GAIN,
    LEAST_T,
    STABLE_T,
    compare_rivals,
    find_innovations,
    project_out,
    scale_evidence,
)
from pipeline.estimation.diagnosis import Value
from pipeline.estimation.estimates import list_first_run
from pipeline.estimation.evidence import Noise
from pipeline.estimation.fit import Fitted, PartFit, fit_model
from pipeline.estimation.folds import hold_out
from pipeline.estimation.intervals import estimate_part
from pipeline.estimation.ladder import Judgement
from pipeline.estimation.problem import Problem
from pipeline.estimation.search import SearchResult, list_rivals
from pipeline.estimation.selection import CandidateModel, Context, Selection
from pipeline.models import Model, find_effect
from pipeline.models.catalogue import find_late_effect, list_effects, suggest_manoeuvre
from pipeline.models.effect import Effect, Late, Search, find_late
from pipeline.models.parameter import LEAST_DELAY_S
from pipeline.run import MotionError, MotionRun
from pipeline.sources import Vehicle

_AS_GOOD = 0.01
"""Fraction of the loss by which the chosen effect must be better than an alternative."""
_REACHES = 0.02
"""Fraction by which the 2 s error of another model must be lower for that model to be chosen."""
_FAR_WORSE = 1.5
"""Ratio to the lowest 2 s error above which a model is no alternative: true ones differ by less than a tenth
(`make bench NAME=game/play`, `cars` and `natural`, 985000-985050)."""
_ALIKE = 0.7
"""Correlation between the prediction changes of two effects above which they are alternatives."""
DETECTED = LEAST_T + 1.3
"""Size of an effect [standard errors] that is named in nine of ten logs."""
DETECTED_SHARE = 90
"""Share of logs with an effect of that size in which it is named [percent]."""


@dataclass(frozen=True)
class Undecided:
    """Effects of which one acts, but the log does not determine which.

    Attributes:
        candidates: ids, the chosen one first.
        separate_by: manoeuvre that distinguishes them.
        numbers: values of each one in place of the others, in the first run, by id and parameter.
    """

    candidates: tuple[str, ...]
    separate_by: str
    numbers: Mapping[str, Mapping[str, Value]] = field(default_factory=dict)


def find_undecided(selection: Selection, final: CandidateModel) -> list[Undecided]:
    """For every identified effect, the alternatives that fit as well."""
    groups = []
    for effect in final.state.effects:
        if effect.id in selection.given or selection.budget.is_spent():
            continue
        without = selection.drop(final, [effect.id])
        alike = _list_alike(selection, without, final, effect)
        # Several rivals may have collapsed to the same simpler effect.
        by_name: dict[str, CandidateModel] = {}
        for candidate in list_rivals(selection, final, (effect.id,)):
            new = [name for name in candidate.ids if name not in final.ids]
            if len(new) != 1 or not _is_as_good(selection, final, candidate):
                continue
            rival = selection.enter(candidate.state) if candidate.is_rough else candidate
            if _does_the_same(selection, without, final, rival):
                by_name.setdefault(new[0], rival)
        known = dict.fromkeys([*by_name, *alike])
        # An effect with more parameters is no rival, even where a simpler rival exists.
        names = [name for name in known if name in alike or not _is_extended(selection, name, effect)]
        if names:
            rest = [c() for c in selection.candidates if c.id in names]
            models = {effect.id: final} | {name: by_name[name] for name in names if name in by_name}
            numbers = {name: _read_numbers(selection, model, name) for name, model in models.items()}
            groups.append(Undecided((effect.id, *names), suggest_manoeuvre(effect, *rest), numbers))
    return groups


def choose_reaching(
    problem: Problem, effects: Sequence[Effect], undecided: Sequence[Undecided]
) -> tuple[list[Effect], list[Undecided]]:
    """Choose from each group that the evidence does not separate the effect with the lowest 2 s error.

    Args:
        problem: the runs, from the leading input to the body.
        effects: all identified effects, one of each group among them.
        undecided: the groups, the identified effect first in each.

    Returns:
        The effects, and the groups with the chosen one first, without those that predict far worse, or that
        another part of the path contradicts (a lag of the body beside late encoders is no alternative where
        the wheels follow their commands at once); a group with no alternative is dropped.
    """
    chosen, groups, best = list(effects), list[Undecided](), None
    for item in undecided:
        first, *others = item.candidates
        here = next((index for index, effect in enumerate(chosen) if effect.id == first), None)
        reached = dict[str, Reached]()
        for name in others if here is not None else ():
            if name not in item.numbers or any(effect.id == name for effect in chosen):
                continue
            best = best or _measure_reached(problem, chosen)
            reached.setdefault(first, best)
            values = {key: value.value for key, value in item.numbers[name].items()}
            swapped = [*chosen[:here], find_effect(name)().change(**values), *chosen[here + 1 :]]  # type: ignore[operator]
            reached[name] = other = _measure_reached(problem, swapped)
            is_better = other.error < (1.0 - _REACHES) * best.error or best.is_far_worse(other)
            if is_better and not other.is_far_worse(best):
                chosen, best, first = swapped, other, name
        worse = {name for name, one in reached.items() if best is not None and one.is_far_worse(best)}
        rest = [name for name in item.candidates if name != first and name not in worse]
        if rest:
            groups.append(replace(item, candidates=(first, *rest)))
    return chosen, groups


@dataclass(frozen=True)
class Reached:
    """How well a model predicts.

    Attributes:
        error: geometric mean of the held-out errors of position and heading over 2 s; infinite where unknown.
        fits: its fit to every part of the path.
    """

    error: float
    fits: tuple[PartFit, ...] = ()

    def is_far_worse(self, best: Reached) -> bool:
        """Whether it predicts far worse than another model, or does so in a part of the path."""
        if self.error > _FAR_WORSE * best.error:
            return True
        # Losses are squares of errors.
        return any(
            one.weights.loss(own.residual) > _FAR_WORSE**2 * one.weights.loss(one.residual)
            for own, one in zip(self.fits, best.fits, strict=False)
        )


def _measure_reached(problem: Problem, effects: Sequence[Effect]) -> Reached:
    try:
        fitted = fit_model(problem, Model(problem.vehicle, tuple(effects)))
        errors = hold_out(problem, fitted).pooled
    except MotionError:
        return Reached(math.inf)
    return Reached(math.sqrt(errors.t_mrmse_m * errors.r_mrmse_rad), fitted.fits)


def _read_numbers(selection: Selection, model: CandidateModel, name: str) -> Mapping[str, Value]:
    """Values of an effect of a model in the first run, with their intervals."""
    return list_first_run(model.state, estimate_part(selection.part, model.fit))[name]


def take_judged(items: Iterable[Undecided], judgement: Judgement) -> list[Undecided]:
    """The same groups, with the values and intervals of a judged model for the effects in it."""
    estimated = list_first_run(judgement.fitted.state, judgement.estimates)
    return [
        replace(item, numbers={name: estimated.get(name, numbers) for name, numbers in item.numbers.items()})
        for item in items
    ]


def _list_alike(
    selection: Selection, without: CandidateModel, final: CandidateModel, effect: Effect
) -> list[str]:
    """Ids of alternatives despite more parameters: smooth forms, and what one motion or speed leaves open."""
    known = {candidate.id for candidate in selection.candidates}
    softer = [
        (other.id, selection.enter(without.state.add(other)))
        for other in effect.list_softer(selection.largest)
        if other.id in known
    ]
    alike = [
        name
        for name, rival in softer
        if _is_as_good(selection, final, rival)
        and _does_the_same(selection, without, final, rival)
        and selection.is_sound(rival)
    ]
    same = effect.same_in_one_motion if selection.largest.is_one_motion else ()
    # Whichever fits the transients better: what a drive does at another speed is not known.
    same += effect.same_at_one_speed if selection.largest.is_one_speed else ()
    return alike + [name for name in dict.fromkeys(same) if name in known.difference(final.ids)]


def _is_as_good(selection: Selection, final: CandidateModel, rival: CandidateModel) -> bool:
    """Whether the chosen model is better by a negligible or an insignificant amount."""
    if selection.loss(rival) < (1.0 + _AS_GOOD) * selection.loss(final):
        return True
    noise = selection.noise or selection.take_evidence(final).noise
    return compare_rivals(noise, rival.fit.residual, final.fit.residual) < DECIDED_T


def _does_the_same(
    selection: Selection, without: CandidateModel, final: CandidateModel, rival: CandidateModel
) -> bool:
    """Whether two effects change the prediction alike; small effects that do not are no alternatives."""
    base = without.fit.residual
    one = (base - final.fit.residual) / selection.weights.scale
    other = (base - rival.fit.residual) / selection.weights.scale
    size = float(np.sqrt(np.sum(one**2) * np.sum(other**2)))
    return size > 0.0 and float(np.sum(one * other)) > _ALIKE * size


def _is_extended(selection: Selection, name: str, effect: Effect) -> bool:
    """Whether an effect has more parameters than the other, or contains the other as a special case."""
    rival = next(candidate() for candidate in selection.candidates if candidate.id == name)
    numbers = sum(bool(np.isfinite(value)) for value in effect.values.values())
    return effect.id in rival.contains or len([p for p in rival.parameters if not p.instead_of]) > numbers


_SURE = 4.0
"""Standard errors from which on a delay of the heading is beyond doubt."""
_SKEWED_CLOCK = 0.03
"""Smallest reported pose delay [s] where the heading is delayed against the positions."""


@dataclass(frozen=True)
class Clocks:
    """Clock effects and delays of the runs.

    Attributes:
        effects: delays of poses and of heading, as far as they are significant.
        timing: of every run, with the keys of the JSON output.
        undecided: a late heading whose position may be late, too.
    """

    effects: tuple[Effect, ...]
    timing: tuple[Mapping[str, float | str | None], ...]
    undecided: tuple[Undecided, ...] = ()

    def list_runs(self, fitted: Fitted | None) -> list[Mapping[str, float | str | None]]:
        """`timing`, with the delays of the encoders in the fit of the written model, if there is one."""
        if fitted is None:
            return list(self.timing)
        return [
            row if row["wheel_delay_s"] is None else {**row, "wheel_delay_s": round(delay.wheel_delay_s, 4)}
            for row, delay in zip(self.timing, fitted.state.timing, strict=True)
        ]


def read_clocks(context: Context, body: SearchResult) -> Clocks:
    """Identify clock effects: with a gyro the delays of heading and position are known separately."""
    state = body.final.state
    extra = find_late(state.effects, Late.POSES)
    rows, positions, skews, certain = [], [], [], []
    for number, (timing, run) in enumerate(zip(state.timing, context.runs, strict=True)):
        yaw = run.alignment.heading_delay_s
        own = find_late(state.effects_of(number), Late.POSES)
        heading_delay = own.delay if own is not None else 0.0
        late = yaw + heading_delay
        positions.append(late)
        skews.append(heading_delay)
        certain.append(_is_late(run))
        rows.append(
            {
                "heading": "gyro" if run.gyro_fit is not None else "pose",
                "pose_delay_s": round(late, 4),
                "yaw_delay_s": None if run.gyro_fit is None else round(yaw, 4),
                "wheel_delay_s": round(timing.wheel_delay_s, 4) if body.path == "measured" else None,
            }
        )
    late_effects: list[Effect] = []
    late, heading_delay = float(np.mean(positions)), float(np.mean(skews))
    # Only a heading older than its position is reported as such; the opposite is a late position.
    skewed = extra is not None and context.has_gyro and heading_delay < 0.0
    if skewed:
        late_effects.append(find_late_effect(Late.HEADING).of_delay(-heading_delay))
    least = max(LEAST_DELAY_S, _SKEWED_CLOCK if skewed else 0.0)
    known = extra is not None if not context.has_gyro else any(certain)
    if known and max(map(abs, positions)) >= least:
        clock = find_late_effect(Late.POSES).of_delay(late)
        if context.has_gyro and not context.largest.moves_both_ways:
            # The gyro gives the heading delay; relating it to the position clock needs driving and turning.
            skew = find_late_effect(Late.HEADING)()
            pair = Undecided((clock.id, skew.id), suggest_manoeuvre(clock, skew))
            return Clocks(tuple(late_effects), tuple(rows), (pair,))
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


def list_equivalents(effect: Effect, context: Context) -> tuple[str, ...]:
    """Effects equivalent to this one under the conditions of the recordings."""
    return effect.equivalent_to if effect.is_equivalent(context.conditions) else ()


@dataclass(frozen=True)
class Unobservable:
    """An effect that is not observable in this log.

    Attributes:
        id: id of the effect.
        reason: the run does not excite it, or it is collinear with a named effect.
        manoeuvre: manoeuvre that makes it observable.
    """

    id: str
    reason: Literal["no excitation", "collinear with what was named"]
    manoeuvre: str


@dataclass(frozen=True)
class Detectable:
    """Detection threshold of an effect that was not named in this log.

    Attributes:
        id: id of the effect.
        parameter, unit: its parameter.
        size: threshold, as a distance from the neutral value of the parameter.
    """

    id: str
    parameter: str
    unit: str
    size: float


def find_unobservable(
    selection: Selection, final: CandidateModel
) -> tuple[list[Unobservable], list[Detectable]]:
    """Candidates that would not be named in this log at their typical size, nor if they show only once.

    Returns:
        These, and the detection thresholds of the other effects that are linear in one parameter.
    """
    noise = selection.noise or selection.take_evidence(final).noise
    rows, factor = noise.tiles.rows, selection.weights.factors(final.fit.residual)
    own = noise.whiten(final.fit.jacobian[rows])
    loss = selection.weights.cost(final.fit.residual).sum()
    innovations, spread = find_innovations(noise, final.fit.residual)
    unobservable, seen = [], []
    for candidate in selection.list_acting(final.ids):
        if final.state.find(candidate.id) is not None:
            continue
        with_it = final.state.add(candidate().make_usual(selection.largest))
        shift = final.fit.residual - selection.part.find_residuals(with_it)
        column = noise.whiten(shift[rows, :, None])[:, :, 0]
        separate = project_out(own, column)
        independent = float((separate**2).sum()) / max(float((column**2).sum()), 1e-300)
        column, separate = (scale_evidence(innovations, spread, one) for one in (column, separate))
        alone, beside = (math.sqrt(float((one**2).sum())) for one in (column, separate))
        if beside >= LEAST_T and _is_spread(noise, separate):
            share = float(((shift * factor) ** 2).sum() / loss) * independent
            seen += _find_detectable(candidate().make_usual(selection.largest), beside, share)
            continue
        is_shown = alone >= LEAST_T and _is_spread(noise, column)
        reason: Literal["no excitation", "collinear with what was named"] = (
            "collinear with what was named" if is_shown else "no excitation"
        )
        unobservable.append(Unobservable(candidate.id, reason, suggest_manoeuvre(candidate())))
    return unobservable, seen


def _is_spread(noise: Noise, column: Floats) -> bool:
    """Whether a column of innovations is significant without its strongest ten seconds."""
    power = np.bincount(noise.tiles.unit, (column**2).sum(axis=1))
    return math.sqrt(float(power.sum() - power.max())) >= STABLE_T


def _find_detectable(usual: Effect, standard_errors: float, share: float) -> list[Detectable]:
    """Detection threshold of an effect of one parameter; its motion is proportional to it.

    Args:
        usual: the effect at a typical size.
        standard_errors: that size in standard errors.
        share: share of the model's loss that it then removes; below the minimum it is not named.
    """
    (parameter, *others) = usual.parameters
    distance = abs(usual.values[parameter.name] - parameter.neutral)
    if others or parameter.search is not Search.DIRECT or not math.isfinite(distance):
        return []
    size = distance * max(DETECTED / standard_errors, math.sqrt(LEAST_GAIN / share))
    least = 0.0 if parameter.least is None else parameter.least.size
    return [Detectable(usual.id, parameter.name, parameter.unit, max(size, least))]
