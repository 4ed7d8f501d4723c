"""Diagnoses of runs from the results of the search."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace

from pipeline.estimation import unexplained as residual_structure
from pipeline.estimation.additions import find_refused
from pipeline.estimation.ambiguity import (
    Clocks,
    join_classes,
    list_equivalents,
    take_judged,
)
from pipeline.estimation.apportion import apportion, find_moments
from pipeline.estimation.commanded import measure_commanded_turn
from pipeline.estimation.constancy import find_change
from pipeline.estimation.diagnosis import Diagnosis
from pipeline.estimation.driving_need import Curve, measure_need, narrow_intervals, thin_growth
from pipeline.estimation.error_regions import find_main_region, is_narrow, map_errors, pick_regions
from pipeline.estimation.estimates import (
    list_by_run,
    list_estimates,
    note_brevity,
    note_cut,
    was_aligned,
)
from pipeline.estimation.ladder import ModelAssessment, assess_model, list_order, note_fit
from pipeline.estimation.largest import measure_asked
from pipeline.estimation.plausibility import measure_moves, note_unusual
from pipeline.estimation.run_residuals import Input
from pipeline.models import (
    LEAST_DELAY_S,
    UNDECIDED,
    Effect,
    Excitation,
    Late,
    Model,
    ModelFile,
    Number,
    Place,
    find_effect,
    find_late_effect,
    format_model,
)
from pipeline.recording import Finding
from pipeline.results import (
    ABOVE_FLOOR,
    CHANGE,
    SEARCH_CUT,
    Delays,
    Detectable,
    Named,
    PathLadder,
    Refused,
    Region,
    RunDiagnosis,
    Step,
    Undecided,
    Unexplained,
    Unobservable,
    measure_excess,
)
from pipeline.run import MotionError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.estimation.decision import Judged, Search, SearchResult
    from pipeline.estimation.estimation_data import EstimationData
    from pipeline.estimation.recordings import DiagnosisInput
    from pipeline.models import FormulaEffect

_CLOCKS = frozenset({Late.POSES, Late.HEADING})


@dataclass(frozen=True)
class PathResult:
    """Results of the search on one path.

    Attributes:
        name: of the path in results: `command` to body, `measured` wheels to body, or command to `wheels`.
        search: how it was searched.
        found: what was found.
        formula: for what the effects leave; None without.
        undecided: alternatives to the identified effects.
        unobservable: effects that are not observable on this path.
        detectable: detection limits of the other effects that were not identified.
    """

    name: str
    search: Search
    outcome: SearchResult
    formula: FormulaEffect | None
    undecided: tuple[Undecided, ...]
    unobservable: Mapping[str, Unobservable]
    detectable: tuple[Detectable, ...]

    def judge(self, effect: Effect) -> Judged | None:
        """How an effect, or one of its parts, was judged; None where it was not searched for here."""
        return next((one for name, one in self.outcome.judged.items() if name in effect.searched_as), None)


def refuse(recording: DiagnosisInput, source: str, recordings: Sequence[DiagnosisInput]) -> RunDiagnosis:
    """The diagnosis of a run for which a fit is meaningless."""
    return RunDiagnosis(
        recording.name,
        source,
        joint=tuple(one.name for one in recordings),
        findings=recording.list_findings(),
    )


def summarize(
    data: EstimationData, source: Input, results: Sequence[PathResult], clocks: Clocks, length_scale_m: float
) -> tuple[Diagnosis, Sequence[Delays]]:
    """The common diagnosis of runs that were judged together.

    Returns:
        It as the only run of a diagnosis, and the delays of each run.
    """
    body = results[0]
    taken = _gather(results, clocks, data)
    known = frozenset().union(*(result.search.given for result in results))
    undecided = [*(item for result in results for item in result.undecided), *clocks.undecided]
    inputs = tuple(dict.fromkeys((source, Input(body.name))))
    assessments = _assess_paths(data, inputs, Model(data.vehicle, tuple(taken)))
    assessment = assessments.get(source.value)
    open_ids = {item.candidates[0] for item in undecided}
    added = [e for e in taken if not e.searched_as & open_ids and e.id not in known]
    widths = {} if assessment is None else narrow_intervals(assessment.fitted)
    named = _order(tuple(_name(one, data, results, assessment, widths) for one in added), assessment)
    if assessment is not None:
        undecided = take_judged(undecided, assessment)
    # What the wheels leave is a matter of the ground, wherever the model starts.
    ground = assessments.get(body.name, assessment)
    suggestion = None
    if ground is not None and body.formula is not None:
        suggestion = residual_structure.suggest(ground, body.formula, assessment or ground)
    if ground is not None and suggestion is not None:
        # What a formula leaves is nearer to what nothing explains.
        own = body.name if body.name in assessments else source.value
        ground = assessments[own] = dataclasses.replace(ground, suggested=suggestion.ground)
        if assessment is not None:
            assessment = dataclasses.replace(assessment, suggested=suggestion.leading)
            assessments[source.value] = assessment
    region = _find_region(data, assessment)
    windows, start = data.whole, body.outcome.start.state
    residual = windows.find_residuals(start)
    regions = map_errors(windows, residual, windows.find_places())
    hidden = {name for item in undecided for name in item.candidates}.union(
        *({effect.id, *effect.searched_as, *effect.contains} for effect in taken)
    )
    unobservable = {n: one for result in results for n, one in result.unobservable.items() if n not in hidden}
    last = None if assessment is None else assessment.ladder.explained_shares(assessment.floor)[-1]
    proposal = None if assessment is None else note_fit(_begin(assessment, undecided), assessment)
    ids = () if proposal is None else proposal.model.ids
    common = RunDiagnosis(
        input=source.value,
        joint=tuple(run.name for run in data.runs),
        vehicle=data.vehicle,
        effects=named,
        undecided=tuple(
            replace(
                item,
                in_model=next((name for name in item.candidates if name in ids), None),
                parameters={name: _leave_open(values) for name, values in item.parameters.items()},
            )
            for item in undecided
        ),
        unobservable_why=unobservable,
        detectable=tuple(one for result in results for one in result.detectable if one.id not in hidden),
        unexplained=_find_unexplained(results, region) if suggestion is None else suggestion.unexplained,
        findings=(
            *note_cut(body.search.budget),
            *note_unusual(named),
            *_note_not_followed(results),
            *(() if assessment is None else find_change(assessment)),
        ),
        ladder=() if assessment is None else assessment.ladder.as_result(assessment.floor),
        noise_floor=None if assessment is None else assessment.floor,
        explained_share=math.nan if last is None else last,
        where=tuple(pick_regions(regions, residual, windows.noise)),
        when=() if assessment is None else find_moments(assessment),
        by_path=_summarize_paths(results, source, assessments.get("measured")),
        disturbance=residual_structure.summarize_disturbance(body.outcome.final),
        concentrated=region,
        model=None if proposal is None else format_model(proposal),
        budget=tuple(
            budget for one in assessments.values() for budget in apportion(one, length_scale_m=length_scale_m)
        ),
        need=measure_need(named, widths),
    )
    cut = {SEARCH_CUT, CHANGE}.intersection(one.id for one in common.findings)
    is_open = measure_excess(common) >= ABOVE_FLOOR and not cut and not common.has_suggestion
    if assessment is not None and is_open:
        refused = find_refused(assessment.whole)
        common = replace(
            common, refused=tuple(Refused(one.effect.id, one.refusal, one.errors) for one in refused)
        )
    estimates = tuple(number for one in assessments.values() for number in list_estimates(data, one, named))
    fitted = assessment.fitted if assessment else None
    return Diagnosis((common,), proposal, estimates), clocks.list_runs(fitted)


def _leave_open(values: Mapping[str, Number]) -> dict[str, Number]:
    """Values of one of several alternatives: each is undecided, unless there is a graver doubt."""
    return {
        name: replace(one, doubt=one.doubt if one.is_undetermined else UNDECIDED, stretches=0)
        for name, one in values.items()
    }


def _find_unexplained(results: Sequence[PathResult], region: Region | None) -> Unexplained | None:
    """What no effect and no formula explains: what lasts, or where nearly all of it is."""
    lasting = (residual_structure.find_lasting(result.outcome.final, result.name) for result in results)
    outcome = next(filter(None, lasting), None)
    if outcome is None and region is not None and is_narrow(region):
        return Unexplained(
            "region", region.share, region.channel, (region.channel,), results[0].name, region=region
        )
    return outcome


def _find_region(data: EstimationData, assessment: ModelAssessment | None) -> Region | None:
    """The region with most of the remaining error; None where it is spread evenly."""
    if assessment is None:
        return None
    windows, residual = data.whole, assessment.whole.held_out.residuals
    known = np.where(np.isfinite(residual), residual, 0.0)
    return find_main_region(windows, known, windows.find_places())


def _begin(assessment: ModelAssessment, undecided: Sequence[Undecided]) -> ModelFile:
    groups = [list(item.candidates) for item in undecided]
    return ModelFile(assessment.fitted.model, fit={"undecided": groups})


def of_run(
    common: RunDiagnosis, recording: DiagnosisInput, number: int, delays: Delays, data: EstimationData
) -> RunDiagnosis:
    """The common diagnosis with the name, findings and delays of one run."""
    effects = tuple(
        replace(one, parameters=one.by_run[number]) if one.by_run else one for one in common.effects
    )
    for clock in (one for one in effects if find_effect(one.id).late is Late.POSES):
        (late,) = clock.parameters.values()
        delays = replace(delays, pose_delay_s=round(late.value, 4))
    return replace(
        common,
        run=recording.name,
        effects=effects,
        findings=(
            *common.findings,
            *note_brevity(data, common),
            *(relate_delay(one, effects, delays) for one in recording.list_findings()),
        ),
        timing=delays,
        when=tuple(one for one in common.when if one.run == number),
        commanded_turn=measure_commanded_turn(data.runs[number], data.vehicle),
        asked=measure_asked(data.runs[number : number + 1], data.vehicle),
    )


def relate_delay(finding: Finding, named: Sequence[Named], delays: Delays) -> Finding:
    """A finding of the recording with what the diagnosis says of the same delay.

    The gyro tells the delay of the heading alone. What an effect of the drive does at a change of the command
    is no dead time, unless a dead time is named, too.
    """
    kinds = [find_effect(one.id) for one in named]
    values: dict[str, object] = {}
    if finding.id == "pose_delay" and any(one.late is Late.POSES for one in kinds):
        heading, position = delays.yaw_delay_s, delays.pose_delay_s
        if heading is not None and position is not None and abs(position - heading) >= LEAST_DELAY_S:
            values = {"position_s": position}
    elif finding.id == "command_delay" and all(one.late is not Late.COMMANDS for one in kinds):
        slow = [one.id for one in kinds if one.place <= Place.DRIVE and Excitation.CHANGES in one.needs]
        values = {"explained_by": slow} if slow else {}
    return replace(finding, values={**finding.values, **values})


def _note_not_followed(results: Sequence[PathResult]) -> list[Finding]:
    """A finding where the wheels do something else than they are told."""
    finals = [one.outcome.final for one in results]
    if all(fit.path.is_followed(fit.residual) for fit in finals):
        return []
    return [Finding("drive_not_followed", "warning", "wheels")]


def _gather(results: Sequence[PathResult], clocks: Clocks, data: EstimationData) -> list[Effect]:
    """All identified effects, with clock effects and composite effects under their own ids."""
    effects = {
        effect.id: effect
        for result in results
        for effect in result.outcome.final.state.effects
        if effect.late is not Late.POSES and effect.id in (*result.outcome.new, *result.outcome.start.ids)
    }
    effects |= {effect.id: effect for effect in clocks.effects}
    joined = join_classes(list(effects.values()), data.vehicle)
    return sorted(joined, key=lambda effect: (effect.place, effect.rank, effect.id))


def _assess_paths(data: EstimationData, inputs: Sequence[Input], model: Model) -> dict[str, ModelAssessment]:
    """The model of these effects judged from each input to the body."""
    # In sequence, so that the ground path of the model is fitted once for both.
    judged = {source.value: _assess_path(data, model, source) for source in inputs}
    return {name: one for name, one in judged.items() if one is not None}


def _choose_data(data: EstimationData, source: Input) -> EstimationData:
    return data if source is data.source else data.behind_wheels


def _assess_path(data: EstimationData, model: Model, source: Input) -> ModelAssessment | None:
    """The model judged from one input to the body; None where that is not possible."""
    with contextlib.suppress(MotionError):
        return assess_model(_choose_data(data, source), model)
    return None


def _name(
    effect: Effect,
    data: EstimationData,
    results: Sequence[PathResult],
    assessment: ModelAssessment | None,
    widths: Mapping[str, Curve],
) -> Named:
    result = next((one for one in results if one.judge(effect) is not None), results[0])
    judged = result.judge(effect)
    by_run = list_by_run(effect, data, assessment)
    values = by_run[0]
    return Named(
        id=effect.id,
        parameters=values,
        gain=math.nan if judged is None else judged.gain / max(1.0 - judged.gain, 1e-12),
        equivalent_to=list_equivalents(effect, data),
        confused_with=tuple(dict.fromkeys((*effect.confused_with, *_list_trading(effect, data, assessment)))),
        corrected=was_aligned(effect, data),
        path=result.name,
        selection_frequency=math.nan if judged is None else judged.frequency,
        moves=None if assessment is None else measure_moves(assessment.fitted, effect),
        growth=thin_growth(
            None if judged is None else _grow_evidence(result, judged),
            {name: widths[label] for name in values if (label := f"{effect.id}.{name}") in widths},
        ),
        by_run=by_run if len(by_run) > 1 else (),
    )


def _grow_evidence(result: PathResult, judged: Judged) -> Curve:
    """Evidence for an effect in standard errors by the seconds of driving."""
    path = result.search.path
    seconds = np.cumsum(np.bincount(path.unit, path.spans, minlength=judged.evidence.size))
    return Curve(np.asarray(seconds, dtype=np.float64), np.sqrt(np.maximum(np.cumsum(judged.evidence), 0.0)))


def _list_trading(effect: Effect, data: EstimationData, assessment: ModelAssessment | None) -> list[str]:
    """Ids of effects whose estimate is correlated with a clock, or of clocks correlated with an effect."""
    if assessment is None:
        return []
    estimates, model = assessment.estimates, assessment.fitted.model
    clocks = {one.id for one in model if one.late in _CLOCKS}
    pairs = [{one.effect, other.effect} for one, other, _ in estimates.list_correlated()]
    pairs += [{one, name} for one in clocks for name in model.effect(one).confused_with if name in model]
    if data.has_gyro:
        # A clock that was corrected beforehand is not a parameter of the fit.
        aligned = find_late_effect(Late.POSES).id
        clocks.add(aligned)
        pairs += [{aligned, item.free.effect} for item in estimates.items if item.trades_with_clock]
    pairs = [pair for pair in pairs if effect.id in pair and pair & clocks and "" not in pair]
    return sorted(set().union(*pairs) - {effect.id})


def _order(named: tuple[Named, ...], assessment: ModelAssessment | None) -> tuple[Named, ...]:
    """Named effects in the order of the ladder, those without a step last."""
    ranked = [] if assessment is None else list_order(assessment.ladder.steps)
    return tuple(sorted(named, key=lambda one: [*ranked, one.id].index(one.id)))


def _summarize_paths(
    results: Sequence[PathResult], source: Input, measured: ModelAssessment | None
) -> dict[str, PathLadder]:
    """Separate ladders of the ground and of the drivetrain."""
    if len(results) == 1:
        return {}
    described: dict[str, PathLadder] = {}
    wheels = results[1].outcome
    if source is Input.COMMAND and measured is not None:
        steps, floor = measured.ladder.as_result(measured.floor), measured.floor
        described["measured"] = PathLadder(measured.fitted.model.ids, steps, floor)
    spans = wheels.final.path.spans[:, None]
    steps = tuple(
        Step(
            velocity_rms=tuple(np.sqrt(((one.residual / spans) ** 2).mean(axis=0)).tolist()),
            effects=tuple(one.ids),
        )
        for one in (wheels.start, wheels.final)
    )
    described["wheels"] = PathLadder(tuple(wheels.new), steps)
    return described
