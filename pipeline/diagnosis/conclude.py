"""From what the search found to what is said."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, cast

import numpy as np

from pipeline.diagnosis import leftover
from pipeline.diagnosis.diagnosis import Named, RunDiagnosis, Value
from pipeline.diagnosis.library import is_term
from pipeline.diagnosis.naming_rules import join_classes, list_equivalents
from pipeline.diagnosis.plausibility import find_implausible, is_large_enough
from pipeline.diagnosis.rating import rate_effects
from pipeline.diagnosis.unexplained import find_places
from pipeline.diagnosis.where import map_errors, pick_regions
from pipeline.motion import Input, ModelFile, MotionError
from pipeline.motion.describe import errors_as_json, ladder_as_json
from pipeline.motion.workshop import note_fit

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.diagnosis.diagnose import Explored
    from pipeline.diagnosis.diagnosis import Json
    from pipeline.diagnosis.ground import Ground
    from pipeline.diagnosis.naming_rules import Clocks
    from pipeline.diagnosis.problem import Problem
    from pipeline.diagnosis.subject import Recording
    from pipeline.motion import Effect, Estimates, Timing
    from pipeline.motion.workshop import Judgement

_DRAWS = 400
_WORTH = 0.01
_CLOCKS = frozenset({"clock_offset", "heading_skew"})


def refuse(recording: Recording, source: str, recordings: Sequence[Recording]) -> RunDiagnosis:
    """The diagnosis of a run of which a fit would mean nothing."""
    return RunDiagnosis(
        recording.name,
        source,
        joint=tuple(one.name for one in recordings),
        findings=tuple(cast("Mapping[str, Json]", f) for f in recording.list_findings()),
    )


def summarize(ground: Ground, source: Input, ways: Sequence[Explored], clocks: Clocks) -> RunDiagnosis:
    """What is common to the runs that were judged together."""
    body = ways[0]
    undecided = [item for way in ways for item in way.undecided]
    open_ids = {item.candidates[0] for item in undecided}
    found = _gather(ways, clocks)
    known = frozenset().union(*(way.search.arena.kept for way in ways))
    timing = body.search.final.state.timing
    terms = [effect for effect in body.search.final.state.effects if is_term(effect.id)]
    judgement = _rate(ground, source, [*found, *terms], timing)
    estimates = None if judgement is None else judgement.estimates
    unexplained = leftover.describe(ground, ways)
    named = tuple(
        _describe(effect, ground, ways, estimates, judgement)
        for effect in found
        if not _parts(effect) & open_ids and effect.id not in known
    )
    named = leftover.mark_tentative(named, ways, unexplained)
    problem: Problem = body.search.arena.problem
    start = body.search.start
    comparisons = ground.compare(source)
    residual = start.fitted.residual
    if source.value != body.search.way:
        problem = ground.pose_body(source)
        residual = problem.find_residuals(start.state)
    places = np.concatenate([find_places(comparison) for comparison in comparisons])
    regions = map_errors(problem, residual, places)
    hidden = {name for item in undecided for name in item.candidates} | {effect.id for effect in found}
    hidden |= set().union(*(_parts(effect) for effect in found)) if found else set()
    unobservable = {u.id: u for way in ways for u in way.unobservable if u.id not in hidden}
    shares = () if judgement is None else judgement.ladder.explained_shares(judgement.floor)
    last = shares[-1] if shares else None
    return RunDiagnosis(
        run="",
        input=source.value,
        joint=tuple(run.name for run in ground.runs),
        effects=named,
        undecided=tuple(undecided),
        unobservable=tuple(unobservable.values()),
        unexplained=unexplained,
        ladder=() if judgement is None else tuple(_rungs(judgement)),
        noise_floor={} if judgement is None else cast("Mapping[str, Json]", errors_as_json(judgement.floor)),
        explained_share=math.nan if last is None else last,
        regions=tuple(regions),
        where=tuple(pick_regions(regions, residual, body.search.arena.noise[: residual.shape[0]])),
        timing={"runs": cast("Json", list(clocks.timing))},
        by_way=_describe_ways(ground, ways, source, [*found, *terms]),
        consistency=_compare_ways(found, estimates) if len(ways) > 1 else {},
        disturbance=leftover.describe_disturbance(body, unexplained),
        proposal=None if judgement is None else note_fit(ModelFile(judgement.fitted.model), judgement),
    )


def of_run(common: RunDiagnosis, recording: Recording, number: int, ground: Ground) -> RunDiagnosis:
    """The common diagnosis with one run's own name, findings and delays."""
    findings = [cast("Mapping[str, Json]", f) for f in recording.list_findings()]
    findings += [
        {
            "id": "implausible_effect",
            "text": effect.implausible,
            "where": effect.id,
            "severity": "warning",
        }
        for effect in common.effects
        if effect.implausible is not None
    ]
    runs = cast("Sequence[Mapping[str, Json]]", common.timing["runs"])
    del ground
    return replace(common, run=recording.name, findings=tuple(findings), timing=runs[number])


def _gather(ways: Sequence[Explored], clocks: Clocks) -> list[Effect]:
    """Everything that was found, clocks and classes put under their names."""
    effects = {
        effect.id: effect
        for way in ways
        for effect in way.search.final.state.effects
        if not is_term(effect.id) and effect.id != "clock_offset"
    }
    effects |= {effect.id: effect for effect in clocks.effects}
    joined = join_classes(list(effects.values()))
    return sorted(joined, key=lambda effect: (effect.place, effect.rank, effect.id))


def _rate(
    ground: Ground, source: Input, effects: Sequence[Effect], timing: Sequence[Timing]
) -> Judgement | None:
    try:
        return rate_effects(ground, source, effects, timing).judgement
    except MotionError:
        return None


def _parts(effect: Effect) -> set[str]:
    """Ids under which an effect was searched."""
    return {"icr_offset", "icr_lateral"} if effect.id == "lever_arm" else {effect.id}


def _describe(
    effect: Effect,
    ground: Ground,
    ways: Sequence[Explored],
    estimates: Estimates | None,
    judgement: Judgement | None,
) -> Named:
    way = _way_of(effect, ways)
    gain, selected = _measure_gain(effect, way)
    fitted = effect
    if judgement is not None and effect.id in judgement.fitted.model:
        joint = judgement.fitted.model.effect(effect.id)
        # Where the whole way from command to body has no room for it, its own way's number is what was found.
        if is_large_enough(joint):
            fitted = joint
        else:
            estimates = None
    return Named(
        id=effect.id,
        parameters=_list_values(fitted, estimates),
        gain=gain,
        equivalent_to=list_equivalents(effect, ground),
        confused_with=effect.confused_with,
        corrected=effect.id in _CLOCKS and ground.has_gyro,
        way=way.search.way,
        selected=selected,
        implausible=find_implausible(fitted),
    )


def _way_of(effect: Effect, ways: Sequence[Explored]) -> Explored:
    for way in ways:
        if _parts(effect) & set(way.search.final.ids):
            return way
    return ways[0]


def _measure_gain(effect: Effect, way: Explored) -> tuple[float, float]:
    """Relative rise of the held-out loss without an effect, and how often that is worth a name."""
    arena, final = way.search.arena, way.search.final
    names = _parts(effect) & set(final.ids)
    if effect.id in _CLOCKS and not names:
        names = {"clock_offset"} & set(final.ids)
    if effect.id == "clock_offset" and not names:
        state = replace(
            final.state, timing=tuple(replace(one, pose_delay_s=0.0) for one in final.state.timing)
        )
        without = arena.enter(state)
    else:
        without = arena.drop(final, names)
    metric, unit = arena.metric, arena.problem.unit
    before = np.bincount(unit, metric.cost(without.held))
    after = np.bincount(unit, metric.cost(final.held))
    gain = float(before.sum()) / max(float(after.sum()), 1e-12) - 1.0
    draws = np.random.default_rng(0).integers(0, before.size, (_DRAWS, before.size))
    falls = 1.0 - after[draws].sum(axis=1) / np.maximum(before[draws].sum(axis=1), 1e-12)
    return gain, float(np.mean(falls >= _WORTH))


def _list_values(effect: Effect, estimates: Estimates | None) -> dict[str, Value]:
    known = {} if estimates is None else {item.free.label: item for item in estimates.items}
    values = {}
    for parameter in effect.parameters:
        value = effect.values[parameter.name]
        if not math.isfinite(value):
            continue
        item = known.get(f"{effect.id}.{parameter.name}")
        low, high = (math.nan, math.nan) if item is None else (item.low, item.high)
        values[parameter.name] = Value(value, low, high, parameter.unit)
    return values


def _rungs(judgement: Judgement) -> list[Mapping[str, Json]]:
    rungs = []
    for rung in ladder_as_json(judgement.ladder, judgement.floor):
        names: list[str] = []
        for name in cast("list[str]", rung["effects"]):
            plain = "unexplained" if is_term(name) else name
            if plain not in names:
                names.append(plain)
        rungs.append(cast("Mapping[str, Json]", {**rung, "effects": names}))
    return rungs


def _describe_ways(
    ground: Ground, ways: Sequence[Explored], source: Input, effects: Sequence[Effect]
) -> dict[str, Json]:
    """Ladders of the ground and of the drivetrain apart."""
    if len(ways) == 1:
        return {}
    described: dict[str, Json] = {}
    body, wheels = ways[0].search, ways[1].search
    if source is Input.COMMAND:
        judgement = _rate(ground, Input.MEASURED, effects, body.final.state.timing)
        if judgement is not None:
            described["measured"] = {
                "effects": [e.id for e in effects if e.id in judgement.fitted.model and not is_term(e.id)],
                "ladder": cast("Json", _rungs(judgement)),
                "noise_floor": cast("Json", errors_as_json(judgement.floor)),
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


def _compare_ways(effects: Sequence[Effect], estimates: Estimates | None) -> dict[str, Json]:
    """Values found on an effect's own way against those of the whole way from command to body."""
    compared: dict[str, Json] = {}
    for item in () if estimates is None else estimates.items:
        effect = next((e for e in effects if e.id == item.free.effect), None)
        if effect is None or not math.isfinite(item.standard_error):
            continue
        there = effect.values[item.free.name]
        span = max(3.0 * item.standard_error, 0.05 * abs(item.value))
        compared[item.free.label] = {
            "on_its_way": round(there, 6),
            "command_to_body": round(item.value, 6),
            "agrees": abs(there - item.value) <= span,
        }
    return compared
