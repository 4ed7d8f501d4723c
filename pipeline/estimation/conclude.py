"""Diagnoses of runs from the results of the search."""

from __future__ import annotations

import contextlib
import math
from dataclasses import replace
from typing import TYPE_CHECKING, cast

import numpy as np

from pipeline.core import format_share
from pipeline.core.arrays import Floats
from pipeline.estimation import unexplained as residual_structure
from pipeline.estimation.acceptance import HALVES, LEAST_GAIN, find_idle, grow_evidence, measure_moves
from pipeline.estimation.ambiguity import (
    Clocks,
    Undecided,
    choose_reaching,
    join_classes,
    list_equivalents,
    take_judged,
)
from pipeline.estimation.apportion import apportion, find_moments
from pipeline.estimation.commanded import measure_commanded_turn
from pipeline.estimation.comparison import Input
from pipeline.estimation.constancy import find_change
from pipeline.estimation.diagnosis import Json, Named, RunDiagnosis, Unexplained
from pipeline.estimation.error_regions import (
    ABOVE_FLOOR,
    Curve,
    Growth,
    find_main_region,
    map_errors,
    narrow_intervals,
    pick_regions,
)
from pipeline.estimation.estimates import (
    Unless,
    find_doubt,
    find_unless,
    format_stand_in,
    list_by_run,
    list_estimates,
    note_brevity,
    note_cut,
    note_grounds,
    note_idle,
    restore,
    restore_known,
    was_aligned,
)
from pipeline.estimation.folds import errors_as_json
from pipeline.estimation.ladder import (
    Judgement,
    judge_model,
    ladder_as_json,
    list_order,
    list_raising,
    note_fit,
)
from pipeline.estimation.learned_step import learn_beyond
from pipeline.estimation.parts import BodyPart, Part
from pipeline.estimation.selection import Context
from pipeline.estimation.terms import is_term
from pipeline.estimation.unexplained import find_places
from pipeline.models import Effect, Model, ModelFile, find_effect
from pipeline.models.catalogue import find_late_effect
from pipeline.models.effect import Late, find_late
from pipeline.models.parameter import Quantity
from pipeline.run import MotionError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence

    from pipeline.estimation import Explored, Recording
    from pipeline.estimation.problem import Problem
    from pipeline.estimation.state import State

_DRAWS = 400  # resamples of ten-second blocks: a probability near 0.95 has a standard error of 0.01
_LEAST_LEAD = 0.1
"""Share of the held-out loss for mentioning an effect that is not significant: ten times `LEAST_GAIN`."""
_CLOCKS = frozenset({Late.POSES, Late.HEADING})


def refuse(recording: Recording, source: str, recordings: Sequence[Recording]) -> RunDiagnosis:
    """The diagnosis of a run for which a fit is meaningless."""
    return RunDiagnosis(
        recording.name,
        source,
        joint=tuple(one.name for one in recordings),
        findings=tuple(cast("Mapping[str, Json]", f) for f in recording.list_findings()),
    )


def summarize(
    context: Context, source: Input, paths: Sequence[Explored], clocks: Clocks, length_scale_m: float
) -> RunDiagnosis:
    """The common diagnosis of runs that were judged together."""
    body = paths[0]
    undecided = [item for path in paths for item in path.undecided if not is_term(item.candidates[0])]
    undecided += clocks.undecided
    taken, undecided = choose_reaching(context.problem, _gather(paths, clocks, context), undecided)
    open_ids = {item.candidates[0] for item in undecided}
    known = frozenset().union(*(path.search.selection.given for path in paths))
    inputs = tuple(dict.fromkeys((source, Input(body.search.path))))
    on_ground = {e.id: _path_of(e, paths) is body for e in taken if e.id not in known}
    idle: list[str] = []
    doubts: list[Mapping[str, Json]] = []
    immaterial: list[Named] = []
    while True:
        # The values of the other effects, and what they bring, change without those that were left out.
        useless = _list_idle(context, inputs, _join(context, taken, open_ids), on_ground)
        idle += useless
        taken = [effect for effect in taken if effect.id not in useless]
        undecided = [item for item in undecided if item.candidates[0] not in useless]
        judgements = _judge_ways(context, inputs, taken, open_ids)
        added = [e for e in taken if not e.searched_as & open_ids and e.id not in known]
        judgement = judgements.get(source.value)
        described = _name_all(added, context, paths, judgement)
        doubted = {one.id: d for one in described if (d := find_doubt(one, context.conditions.exceeded))}
        new = {name: one for name, one in doubted.items() if not _is_needed(one, judgement)}
        small = [one for one in described if one.id not in new and one.moves and not one.moves.is_material]
        # What screen and page show of the model that is written raises no error either.
        raising = [] if new or small else [one for one in _list_raising(judgement) if one in on_ground]
        excluded = {*new, *(one.id for one in small), *raising}
        if not excluded:
            break
        doubts += new.values()
        immaterial += small
        idle += raising
        taken = [effect for effect in taken if effect.id not in excluded]
        undecided = [item for item in undecided if item.candidates[0] not in excluded]
    unexplained = residual_structure.describe(paths, judgement, lead := _find_lead(paths, judgement))
    part, start = context.problem.whole, body.search.start
    residual = part.find_residuals(start.state)
    places = find_places(part.comparisons)
    hidden = {name for item in undecided for name in item.candidates}.union(
        *({effect.id, *effect.searched_as} for effect in taken)
    )
    described = tuple(replace(one, as_if=format_stand_in(one)) for one in _order(described, judgement))
    named = _mark_tentative(described, judgements, doubted)
    if judgement is not None:
        undecided = take_judged(undecided, judgement)
        near = (one for path in paths for one in path.not_significant)
        conditions = list(find_unless(judgement, named, near, hidden))
        named = _note_unless(named, conditions)
        doubts += [*(one.note for name, one in conditions if name is None), *find_change(judgement)]
        hidden.update(one.id for _, one in conditions)
    stated = hidden.union(*(effect.contains for effect in taken))
    unobservable = {u.id: u for path in paths for u in path.unobservable if u.id not in hidden}
    last = None if judgement is None else judgement.ladder.explained_shares(judgement.floor)[-1]
    return RunDiagnosis(
        run="",
        input=source.value,
        joint=tuple(run.name for run in context.runs),
        effects=named,
        immaterial=tuple(immaterial),
        undecided=tuple(undecided),
        unobservable=tuple(unobservable.values()),
        detectable=tuple(one for path in paths for one in path.detectable if one.id not in stated),
        unexplained=unexplained,
        findings=(
            *note_cut(body.search.selection.budget),
            *note_grounds(context),
            *doubts,
            *map(note_idle, idle),
        ),
        ladder=() if judgement is None else tuple(_list_steps(judgement)),
        noise_floor={} if judgement is None else cast("Mapping[str, Json]", errors_as_json(judgement.floor)),
        explained_share=math.nan if last is None else last,
        learned={} if judgement is None else learn_beyond(judgement),
        where=tuple(pick_regions(map_errors(part, residual, places), residual, part.noise)),
        when=() if judgement is None else find_moments(judgement),
        timing={"runs": cast("Json", clocks.list_runs(judgement.fitted if judgement else None))},
        by_path=_summarize_paths(paths, source, judgements.get("measured")),
        disturbance=residual_structure.summarize_disturbance(
            body, _describe_rest(unexplained, lead, _find_room(judgement))
        ),
        lead=lead,
        proposal=None if judgement is None else note_fit(_begin(judgement, undecided, named), judgement),
        budgets=tuple(
            budget for one in judgements.values() for budget in apportion(one, length_scale_m=length_scale_m)
        ),
        estimates=tuple(
            number for one in judgements.values() for number in list_estimates(context, one, named)
        ),
    )


def _list_raising(judgement: Judgement | None) -> list[str]:
    """Effects of the written model whose steps raise its errors, see `list_raising`."""
    if judgement is None:
        return []
    written = _list_written(judgement.fitted.model)
    return [name for name in list_raising(judgement) if name in written]


def _find_lead(paths: Sequence[Explored], judgement: Judgement | None) -> str:
    """Sentence stating what the residual of the final model indicates: a region or an insignificant effect.

    Empty where it indicates nothing that was recorded.
    """
    search = paths[0].search
    part = search.selection.part
    region = find_main_region(part, search.final.held, find_places(part.comparisons))
    if region is not None:
        return f"the remaining error is not spread evenly: {region.sentence}"
    room = _find_room(judgement)
    near = [one for path in paths for one in path.not_significant]
    nearest = max(near, key=lambda one: one.gain, default=None)
    if nearest is None or not room > ABOVE_FLOOR or nearest.gain < _LEAST_LEAD:
        return ""
    return (
        f"the remaining error is {room:.1f} times the noise floor; {nearest.effect.id} would remove "
        f"{format_share(nearest.gain)} of the held-out loss, but is not significant"
    )


def _find_room(judgement: Judgement | None) -> float:
    """The final error in position over the noise floor; NaN if either is unknown."""
    floor = 0.0 if judgement is None else judgement.floor.t_mrmse_m
    return judgement.whole.errors.t_mrmse_m / floor if judgement and floor > 0.0 else math.nan


def _describe_rest(unexplained: Unexplained | None, lead: str, room: float) -> str:
    """Sentence on the residual, apart from what is unexplained."""
    if unexplained is not None:
        return "Apart from this dependence, the residual is disturbance and localization noise"
    if not lead and room > ABOVE_FLOOR:
        times = f"{room:.1f} times the noise floor"
        return f"The remaining error is {times}, and no term that was tried predicts it"
    return lead or "The residual does not depend on any recorded signal: disturbance and localization noise"


def _begin(judgement: Judgement, undecided: Sequence[Undecided], named: Sequence[Named]) -> ModelFile:
    groups = [list(item.candidates) for item in undecided]
    unless = [
        {"parameter": f"{effect.id}.{name}", "effect": one.id, "value": value.value}
        for effect in named
        for one in effect.unless
        for name, value in one.instead.items()
    ]
    return ModelFile(judgement.fitted.model, fit={"undecided": groups, "unless": unless})


def of_run(common: RunDiagnosis, recording: Recording, number: int, context: Context) -> RunDiagnosis:
    """The common diagnosis with the name, findings and delays of one run."""
    findings = [*common.findings, *note_brevity(context, common)]
    findings += [cast("Mapping[str, Json]", f) for f in recording.list_findings()]
    runs = cast("Sequence[Mapping[str, Json]]", common.timing["runs"])
    beside = [restore(e.id, e.by_run[number] if e.by_run else e.parameters) for e in common.effects]
    effects, immaterial = (
        tuple(_choose_run(one, number, context, beside) for one in some)
        for some in (common.effects, common.immaterial)
    )
    timing = dict(runs[number])
    for clock in (one for one in effects if find_effect(one.id).late is Late.POSES):
        (late,) = clock.parameters.values()
        timing["pose_delay_s"] = round(late.value, 4)
    return replace(
        common, run=recording.name, effects=effects, immaterial=immaterial, findings=tuple(findings),
        timing=timing, when=tuple(one for one in common.when if one.run == number),
        commanded_turn=measure_commanded_turn(context.runs[number], context.vehicle),
    )  # fmt: skip


def _choose_run(effect: Named, number: int, context: Context, beside: Sequence[Effect]) -> Named:
    """An effect with its values in one of the runs, described beside the other effects."""
    if not effect.by_run:
        return effect
    acting = restore_known(effect.id, values := effect.by_run[number])
    words = [word(context.vehicle, beside) for word in (acting.describe_motion, acting.describe_clause)]
    return replace(effect, parameters=values, motion=words[0], clause=words[1])


def _gather(paths: Sequence[Explored], clocks: Clocks, context: Context) -> list[Effect]:
    """All identified effects, with clock effects and composite effects under their own ids."""
    effects = {
        effect.id: effect
        for path in paths
        for effect in path.search.final.state.effects
        if not is_term(effect.id) and effect.late is not Late.POSES
    }
    effects |= {effect.id: effect for effect in clocks.effects}
    joined = join_classes(list(effects.values()), context.vehicle)
    return sorted(joined, key=lambda effect: (effect.place, effect.rank, effect.id))


def _list_idle(
    context: Context, inputs: Sequence[Input], model: Model, on_ground: Mapping[str, bool]
) -> list[str]:
    """Effects of a model that do not serve predictions, see `find_idle`.

    Args:
        context: the runs.
        inputs: from which they are predicted; the last one is that of the ground.
        model: with all effects.
        on_ground: whether an effect acts on the ground, not in the drivetrain, by id; others stay.
    """
    # An encoder error affects both the ground and the drivetrain; from commands the two cancel.
    duties = {name: inputs[-1:] if is_ground else inputs[:1] for name, is_ground in on_ground.items()}
    drive = {name for name, is_ground in on_ground.items() if not is_ground}
    problems = {one: _find_problem(context, one) for one in inputs}
    return find_idle(model, problems, duties, drive, _list_written(model))


def _list_written(model: Model) -> list[str]:
    """Effects that may not raise the errors of the written model.

    An encoder that counts wrong looks like another radius: its part in the drive, which cancels it from
    commands, may be too faint to be found, and the encoder is named all the same.
    """
    radii = {Quantity.RADIUS, Quantity.RADIUS_DIFFERENCE}
    return [one.id for one in model if radii.isdisjoint(q for p in one.parameters for q in p.quantities)]


def _judge_ways(
    context: Context,
    inputs: Sequence[Input],
    effects: Sequence[Effect],
    open_ids: set[str],
) -> dict[str, Judgement]:
    """The model of these effects judged from each input to the body."""
    model = _join(context, effects, open_ids)
    # In sequence, so that the ground part of the model is fitted once for both.
    judged = {source.value: _judge_path(context, model, source) for source in inputs}
    return {name: one for name, one in judged.items() if one is not None}


def _find_problem(context: Context, source: Input) -> Problem:
    return context.problem if source is context.problem.source else context.problem.behind_wheels


def _join(context: Context, effects: Sequence[Effect], open_ids: set[str]) -> Model:
    """The model of some effects.

    An undecided effect on which the values of others depend is left out: their values are stated without it.
    """
    acting = [
        effect
        for effect in effects
        if not (effect.id in open_ids and any(other.depends_on(effect) for other in effects))
    ]
    return Model(context.vehicle, tuple(acting))


def _judge_path(context: Context, model: Model, source: Input) -> Judgement | None:
    """The model judged from one input to the body; None where that is not possible."""
    with contextlib.suppress(MotionError):
        return judge_model(_find_problem(context, source), model)
    return None


def _name_all(
    effects: Sequence[Effect], context: Context, paths: Sequence[Explored], judgement: Judgement | None
) -> tuple[Named, ...]:
    widths = {} if judgement is None else narrow_intervals(judgement.fitted)
    return tuple(_name(effect, context, paths, judgement, widths) for effect in effects)


def _name(
    effect: Effect,
    context: Context,
    paths: Sequence[Explored],
    judgement: Judgement | None,
    widths: Mapping[str, Curve],
) -> Named:
    path = _path_of(effect, paths)
    gain, selected, evidence = _measure_gain(effect, path)
    by_run = list_by_run(effect, context, judgement)
    values = by_run[0]
    acting, beside = restore_known(effect.id, values), () if judgement is None else judgement.fitted.model
    return Named(
        id=effect.id,
        parameters=values,
        gain=gain,
        equivalent_to=list_equivalents(effect, context),
        confused_with=tuple(
            dict.fromkeys((*effect.confused_with, *_list_trading(effect, context, judgement)))
        ),
        corrected=was_aligned(effect, context),
        path=path.search.path,
        selected=selected,
        motion=acting.describe_motion(context.vehicle, beside),
        clause=acting.describe_clause(context.vehicle, beside),
        moves=None if judgement is None else measure_moves(judgement, effect),
        growth=Growth(
            evidence,
            {name: widths[label] for name in values if (label := f"{effect.id}.{name}") in widths},
        ),
        by_run=by_run if len(by_run) > 1 else (),
    )


def _list_trading(effect: Effect, context: Context, judgement: Judgement | None) -> list[str]:
    """Ids of effects whose estimate is correlated with a clock, or of clocks correlated with an effect."""
    if judgement is None:
        return []
    estimates, model = judgement.estimates, judgement.fitted.model
    clocks = {one.id for one in model if one.late in _CLOCKS}
    pairs = [{one.effect, other.effect} for one, other, _ in estimates.list_correlated()]
    pairs += [{one, name} for one in clocks for name in model.effect(one).confused_with if name in model]
    if context.has_gyro:
        # A clock that was corrected beforehand is not a parameter of the fit.
        aligned = find_late_effect(Late.POSES).id
        clocks.add(aligned)
        pairs += [{aligned, item.free.effect} for item in estimates.items if item.trades_with_clock]
    pairs = [pair for pair in pairs if effect.id in pair and pair & clocks and "" not in pair]
    return sorted(set().union(*pairs) - {effect.id})


def _is_needed(doubt: Mapping[str, Json], judgement: Judgement | None) -> bool:
    """Whether an effect is doubted for its interval only, and a 2 s error doubles without it."""
    if judgement is None or doubt["id"] != "insignificant_effect":
        return False
    without = judgement.whole.drop(str(doubt["where"])).errors
    return min(judgement.whole.errors.ratios(without)[3:]) <= HALVES


def _mark_tentative(
    named: tuple[Named, ...], judgements: Mapping[str, Judgement], doubted: Collection[str]
) -> tuple[Named, ...]:
    """Mark as tentative: stand-ins, effects with open values, effects that lower no error on their path."""
    return tuple(
        replace(
            effect,
            tentative=bool(effect.as_if or effect.id in doubted)
            or (effect.path in judgements and effect.id in judgements[effect.path].ladder.idle),
        )
        for effect in named
    )


def _note_unless(
    named: Iterable[Named], conditions: Sequence[tuple[str | None, Unless]]
) -> tuple[Named, ...]:
    """Named effects with the insignificant effects that would change their values."""
    return tuple(replace(one, unless=tuple(un for n, un in conditions if n == one.id)) for one in named)


def _order(named: tuple[Named, ...], judgement: Judgement | None) -> tuple[Named, ...]:
    """Named effects in the order of the ladder, those without a step last."""
    ranked = [] if judgement is None else list_order(judgement.ladder.steps)
    return tuple(sorted(named, key=lambda one: [*ranked, one.id].index(one.id)))


def _path_of(effect: Effect, paths: Sequence[Explored]) -> Explored:
    for path in paths:
        if effect.searched_as & set(path.search.final.ids):
            return path
    return paths[0]


def _measure_gain(effect: Effect, path: Explored) -> tuple[float, float, Curve]:
    """Relative rise of the held-out loss without an effect, its selection frequency, and its t by time."""
    selection, final = path.search.selection, path.search.final
    names = effect.searched_as & set(final.ids)
    clock = find_late(final.state.effects, Late.POSES)
    if effect.late in _CLOCKS and not names and clock is not None:
        names = frozenset({clock.id})
    held = selection.drop(final, names).held if names else _delay_poses(selection.part, final.state)
    before = np.bincount(selection.part.unit, selection.weights.cost(held))
    after = np.bincount(selection.part.unit, selection.weights.cost(final.held))
    gain = float(before.sum()) / max(float(after.sum()), 1e-12) - 1.0
    draws = np.random.default_rng(0).integers(0, before.size, (_DRAWS, before.size))
    falls = 1.0 - after[draws].sum(axis=1) / np.maximum(before[draws].sum(axis=1), 1e-12)
    noise = selection.noise or selection.take_evidence(final).noise
    reduced = selection.drop(final, names).fit.residual if names else held
    growing = Curve(*grow_evidence(selection.part, noise, reduced, final.fit.residual))
    return gain, float(np.mean(falls >= LEAST_GAIN)), growing


def _delay_poses(part: Part, state: State) -> Floats:
    """Residuals with the original pose stamps, before alignment."""
    if not isinstance(part, BodyPart):
        return part.find_residuals(state)
    delays = [comparison.run.alignment.heading_delay_s for comparison in part.comparisons]
    return np.concatenate([part.shift_clock(state, run, -late) for run, late in enumerate(delays)])


def _list_steps(judgement: Judgement) -> list[Mapping[str, Json]]:
    return cast("list[Mapping[str, Json]]", ladder_as_json(judgement.ladder, judgement.floor))


def _summarize_paths(paths: Sequence[Explored], source: Input, measured: Judgement | None) -> dict[str, Json]:
    """Separate ladders of the ground and of the drivetrain."""
    if len(paths) == 1:
        return {}
    described: dict[str, Json] = {}
    wheels = paths[1].search
    if source is Input.COMMAND and measured is not None:
        described["measured"] = {
            "effects": list(measured.fitted.model.ids),
            "ladder": cast("Json", _list_steps(measured)),
            "noise_floor": cast("Json", errors_as_json(measured.floor)),
        }
    described["wheels"] = {
        "effects": list(wheels.new),
        "ladder": [
            {
                "effects": list(one.ids),
                "velocity_rms": [round(float(v), 6) for v in np.sqrt((one.held**2).mean(axis=0))],
            }
            for one in (wheels.start, wheels.final)
        ],
    }
    return described
