"""The whole diagnosis: clocks, excitation, search, the residual, and lines of text about it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, cast

import numpy as np

from pipeline.core.compute import both_cores
from pipeline.core.program import INPUT_WORDS
from pipeline.estimation import conclude
from pipeline.estimation.acceptance import describe_threshold
from pipeline.estimation.ambiguity import Clocks, Undecided, find_undecided, read_clocks
from pipeline.estimation.comparison import Input, InputChoice, choose_input
from pipeline.estimation.diagnosis import Diagnosis, Json, Named, RunDiagnosis, say_numbers
from pipeline.estimation.error_regions import describe_enough, format_remaining_error
from pipeline.estimation.estimates import BREVITY, Declined, list_declined
from pipeline.estimation.search import (
    DETECTED_SHARE,
    Detectable,
    SearchResult,
    Unobservable,
    find_unobservable,
    search_body,
    search_wheels,
)
from pipeline.estimation.selection import Budget, Context, prepare, usual_budget
from pipeline.estimation.unexplained import (
    LEAST_OF_DRIVE,
    Explainable,
    boost_residuals,
    collect_terms,
    describe_windows,
    find_places,
    measure_asked,
    search_formula,
)
from pipeline.models import Effect, Excitation, Model
from pipeline.models.catalogue import find_effect
from pipeline.run import MotionRun, load_run
from pipeline.run.windows import HORIZON_S
from pipeline.sources import Vehicle
from pipeline.stages.checks import FAULTS

if TYPE_CHECKING:
    import polars as pl

# Where one of these stands, a fit means nothing: no effect is named.
FATAL = ("not_moving", "pose_from_wheels", *FAULTS)


@dataclass(frozen=True)
class Recording:
    """One run as the stages left it.

    Attributes:
        name: of the run.
        tables: `poses`, `alignments`, `commands`, `wheels`, `imu`, `slip`, `findings`; those that the
            log lacks may miss.
        sha256: of the recording.
        path: of the log.
        length_scale_m: of the slip modulus [m].
    """

    name: str
    tables: Mapping[str, pl.DataFrame] = field(repr=False)
    sha256: str = ""
    path: str = ""
    length_scale_m: float = 1.0

    def list_findings(self) -> list[dict[str, object]]:
        """What the stages noticed: id, text, where, severity and the number behind it."""
        table = self.tables.get("findings")
        if table is None or table.is_empty():
            return []
        kept = [name for name in ("id", "text", "where", "severity", "value") if name in table.columns]
        return table.select(kept).to_dicts()


def load_recording(recording: Recording, vehicle: Vehicle) -> MotionRun:
    """The run as arrays."""
    return load_run(recording.tables, vehicle, name=recording.name, sha256=recording.sha256)


@dataclass(frozen=True)
class Explored:
    """A way with all that was found on it.

    Attributes:
        search: the search, its final model with formula terms where they serve better.
        undecided: rivals of what was named.
        declined: what may act, too, with too little evidence for a name.
        unobservable: what this way could not tell.
        detectable: how large what was not named would have had to be.
        explainable: what can still be predicted; None where it was not asked.
    """

    search: SearchResult
    undecided: tuple[Undecided, ...]
    declined: tuple[Declined, ...]
    unobservable: tuple[Unobservable, ...]
    detectable: tuple[Detectable, ...]
    explainable: Explainable | None


def diagnose_runs(
    recordings: Sequence[Recording],
    vehicle: Vehicle,
    *,
    inputs: Sequence[str] = ("command", "measured"),
    model: Model | None = None,
    budget_s: float | None = None,
    tell: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Say which physical effects are missing from the model of one run, or of several of one vehicle jointly.

    Args:
        recordings: the runs' tables.
        vehicle: their vehicle.
        inputs: `command`, `measured` or both; with both, the command leads and the wheels serve to tell the
            drivetrain from the ground.
        model: what is known already; what is missing beyond it is said. The ideal model when None.
        budget_s: CPU time that the search may take [s]; by default a minute for ten minutes of driving.
        tell: told what was found so far.

    Returns:
        One diagnosis a run; runs that were judged together share their effects.

    Raises:
        DiagnosisError: ``too_short`` or ``no_input``.
    """
    fatal = [f for recording in recordings for f in recording.list_findings() if f["id"] in FATAL]
    leading = "command" if "command" in inputs else "measured"
    if fatal:
        return Diagnosis(tuple(conclude.refuse(recording, leading, recordings) for recording in recordings))
    runs = [load_recording(recording, vehicle) for recording in recordings]
    known = () if model is None else model.effects
    chosen = choose_input(runs, inputs[0] if len(inputs) == 1 else None, known)
    context = prepare(runs, vehicle, chosen.source)
    driven = sum(run.duration_s for run in runs)
    budget = Budget(usual_budget(driven) if budget_s is None else budget_s, tell)
    with both_cores(context.list_shared()):
        ways, clocks = _explore(context, chosen.source, known, budget)
        return _conclude(recordings, context, chosen, ways, clocks)


def _explore(
    context: Context, source: Input, known: Sequence[Effect], budget: Budget
) -> tuple[list[Explored], Clocks]:
    """All ways that the recording opens: the ground alone and the drivetrain alone, or both at once."""
    if source is Input.MEASURED or context.has_encoders:
        body = _explore_body(context, Input.MEASURED, known, budget)
        ways = [body]
        if source is Input.COMMAND:
            ways.append(_explore_wheels(context, known, body.search, budget))
    else:
        body = _explore_body(context, Input.COMMAND, known, budget)
        ways = [body]
    return ways, read_clocks(context, body.search)


def _explore_body(context: Context, source: Input, known: Sequence[Effect], budget: Budget) -> Explored:
    found = search_body(context, source, known, budget)
    comparisons = found.selection.part.comparisons
    places = np.concatenate([find_places(comparison) for comparison in comparisons])
    final = search_formula(found.selection, found.start, found.final, places)
    # Where a formula says what is left, nobody asks what else could.
    features = None if collect_terms(final) else describe_windows(comparisons)[0]
    explainable = None if features is None else boost_residuals(found.selection, final, features)
    found = replace(found, final=final)
    return _gather(found, explainable)


def _explore_wheels(
    context: Context, known: Sequence[Effect], body: SearchResult, budget: Budget
) -> Explored:
    found = search_wheels(context, known, body, budget)
    selection, final = found.selection, found.final
    left = np.sqrt((final.held**2).mean(axis=0)) / measure_asked(selection)
    if not (left > LEAST_OF_DRIVE).any():
        return _gather(found, None)
    features = describe_windows(selection.part.comparisons)[0]
    return _gather(found, boost_residuals(selection, final, features))


def _gather(found: SearchResult, explainable: Explainable | None) -> Explored:
    undecided = find_undecided(found.selection, found.final)
    unobservable, detectable = find_unobservable(found.selection, found.final)
    return Explored(
        found,
        tuple(undecided),
        tuple(list_declined(found)),
        tuple(unobservable),
        tuple(detectable),
        explainable,
    )


def _conclude(
    recordings: Sequence[Recording],
    context: Context,
    chosen: InputChoice,
    ways: Sequence[Explored],
    clocks: Clocks,
) -> Diagnosis:
    common: RunDiagnosis = conclude.summarize(
        context, chosen.source, ways, clocks, recordings[0].length_scale_m
    )
    common = replace(common, input_reason=chosen.reason)
    return Diagnosis(
        tuple(
            conclude.of_run(common, recording, number, context) for number, recording in enumerate(recordings)
        )
    )


_LABEL = 10
_WHERE_SHOWN = 3
NOT_FITTED_TO_RUN = "the data of this run do not support a fit"
NOTHING_MISSING = "none: the error is within what the localization can resolve"
_UNOBSERVABLE_SHOWN = 8
_DETECTABLE_SHOWN = 5


def describe(diagnosis: Diagnosis, following: str = "") -> str:
    """A diagnosis in plain text; of runs that were judged together what they share is said once.

    Args:
        diagnosis: what was found.
        following: the command that goes on from it, where effects were named.
    """
    first = diagnosis.runs[0]
    rows = _describe_alone(first) if len(diagnosis.runs) == 1 else _describe_together(diagnosis)
    if first.effects and following:
        rows.append(("next", following))
    return _write(rows)


def _describe_together(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    first = diagnosis.runs[0]
    names = [run.run for run in diagnosis.runs]
    rows = [("runs", names[0]), *(("", name) for name in names[1:]), ("", f"together, {_name_way(first)}")]
    rows += _list_shared(first)
    for run in diagnosis.runs:
        rows += _label("findings", [f"{run.run}: {finding['text']}" for finding in _grave(run)])
    return rows


def _write(rows: Sequence[tuple[str, str]]) -> str:
    return "".join(f"{label:<{_LABEL}}{text}".rstrip() + "\n" for label, text in rows)


def _describe_alone(run: RunDiagnosis) -> list[tuple[str, str]]:
    return [("run", f"{run.run}    {_name_way(run)}"), *list_lines(run)]


def describe_stored(told: Mapping[str, object], following: str = "") -> str:
    """The text of `describe` for one run whose JSON object was stored with its `list_lines`."""
    reason = str(told.get("input_reason") or "")
    run = RunDiagnosis(str(told["run"]), str(told["input"]), reason)
    lines = cast("Sequence[tuple[str, str]]", told["lines"])
    rows = [("run", f"{run.run}    {_name_way(run)}"), *((label, text) for label, text in lines)]
    return _write([*rows, ("next", following)] if told["effects"] and following else rows)


def _name_way(run: RunDiagnosis) -> str:
    reason = f" ({run.input_reason})" if run.input_reason else ""
    return f"{INPUT_WORDS[run.input]}{reason}"


def list_lines(diagnosis: RunDiagnosis) -> list[tuple[str, str]]:
    """Label and text of every line but the run's own; a line without a label goes on with the one above."""
    grave = _label("findings", [str(finding["text"]) for finding in _grave(diagnosis)])
    if not diagnosis.ladder:
        return [*grave, *_list_shared(diagnosis)]
    return [*_list_shared(diagnosis), *grave]


def _list_shared(diagnosis: RunDiagnosis) -> list[tuple[str, str]]:
    """Lines of what all runs that were judged together have in common."""
    if not diagnosis.ladder:
        return [("effects", f"none: {NOT_FITTED_TO_RUN}")]
    first, last = diagnosis.ladder[0], diagnosis.ladder[-1]
    ideal = f"of the ideal model over 2 s     {_number(first, 't_mrmse_m')} m   "
    lines = [("error", f"{ideal}{_number(first, 'r_mrmse_rad')} rad")]
    lines += _label("where", [region.sentence for region in diagnosis.where[:_WHERE_SHOWN]])
    lines += _label("effects", _describe_missing(diagnosis))
    if len(diagnosis.ladder) > 1:
        error, floor = (one.get("t_mrmse_m") for one in (last, diagnosis.noise_floor))
        lines += _label("", [format_remaining_error(error, floor, diagnosis.explained_share)])
    lines += _label("budget", [_describe_budget(diagnosis)])
    lines += _label("data", [describe_enough(diagnosis.effects)])
    lines += _label("minor", _describe_immaterial(diagnosis))
    lines += _label("unseen", _describe_unobservable(diagnosis))
    return [*lines, *_label("bounds", [_describe_detectable(diagnosis)])]


def _label(label: str, texts: Sequence[str]) -> list[tuple[str, str]]:
    return [("" if number else label, text) for number, text in enumerate(filter(None, texts))]


def _describe_missing(diagnosis: RunDiagnosis) -> list[str]:
    rows: list[str] = []
    falls = _list_falls(diagnosis)
    width = max((len(_values(effect)) for effect in diagnosis.effects), default=0) + 2
    for effect in diagnosis.effects:
        notes = []
        if effect.equivalent_to:
            notes.append(f"= {', '.join(effect.equivalent_to)}")
        if effect.corrected:
            notes.append("timing, corrected")
        if effect.tentative:
            notes.append("tentative")
        note = f"  ({'; '.join(notes)})" if notes else ""
        rows.append(f"{effect.id:<20}{_values(effect):<{width}}{falls.get(effect.id, '')}{note}")
        pairs = zip(diagnosis.joint, effect.by_run, strict=False)
        own = [f"{say_numbers(numbers)} in {run}" for run, numbers in pairs]
        texts = own or [effect.sentence, _say_another_run(effect)]
        texts += [one.sentence for one in effect.unless]
        rows += [f"{'':<20}{text}" for text in texts if text]
    for item in diagnosis.undecided:
        held = diagnosis.find_held(item)
        fall = f"  {falls[held]}" if held in falls else ""
        rows.append(f"{'undecided':<20}{' or '.join(item.candidates)}{fall}")
        numbers = ((name, item.numbers[name]) for name in item.candidates if name in item.numbers)
        rows += [f"{'':<20}as {name}: {say_numbers(values)}" for name, values in numbers]
        text = (
            f"the model uses {held}; to separate them: {item.separate_by}"
            if held
            else f"to separate them: {item.separate_by}"
        )
        rows.append(f"{'':<20}{text}")
    if diagnosis.unexplained is not None:
        left = diagnosis.unexplained
        rows.append(f"{'unexplained':<20}{left.share:.0%} of the residual: {left.where}")
        if left.formula is not None:
            terms = [line for line in left.formula.splitlines() if line.startswith("v_")]
            rows += [f"{'':<20}suggested term {line}" for line in terms]
    if not rows:
        rows.append(_describe_nothing(diagnosis))
    return rows


def _describe_nothing(diagnosis: RunDiagnosis) -> str:
    """The verdict where no effect is named and no structure was found."""
    if any(finding["id"] == BREVITY for finding in diagnosis.findings):
        return "no effect is named: the run is too short to tell"
    if diagnosis.lead:
        return f"no effect is named: {diagnosis.lead}"
    return NOTHING_MISSING


def _describe_budget(diagnosis: RunDiagnosis) -> str:
    """The error budget by cause: shares of the mean square slip on the leading input; empty without one."""
    for budget in diagnosis.budgets if diagnosis.effects else ():
        if (budget.input, budget.quantity) == (diagnosis.input, "slip"):
            parts = [f"{one.name.replace('_noise', ' noise')} {one.share:z.0%}" for one in budget.shares]
            return f"error budget by cause (RMS slip {math.sqrt(budget.total):.3g} m/s): {', '.join(parts)}"
    return ""


def _describe_immaterial(diagnosis: RunDiagnosis) -> list[str]:
    """Effects below the detection threshold, and the threshold."""
    if not diagnosis.immaterial:
        return []
    width = max(len(_values(effect)) for effect in diagnosis.immaterial) + 2
    rows = [
        f"{effect.id:<20}{_values(effect):<{width}}changes predictions by "
        f"{effect.moves.position_m * 1e3:.2g} mm and {effect.moves.heading_rad * 1e3:.2g} mrad"
        for effect in diagnosis.immaterial
        if effect.moves is not None
    ]
    return [*rows, f"below the detection threshold over {HORIZON_S:g} s: {describe_threshold()}"]


def _values(effect: Named) -> str:
    return "a clock offset of each run:" if effect.by_run else say_numbers(effect.parameters)


def _say_another_run(effect: Named) -> str:
    """The range in which another run on this ground is expected; empty where it is not known."""
    ends = [
        f"{name} {value.another_run[0]:.3g} to {value.another_run[1]:.3g}{value.suffix}"
        for name, value in effect.parameters.items()
        if math.isfinite(value.another_run[0])
    ]
    return f"expected range between runs: {', '.join(ends)}" if ends else ""


def _list_falls(diagnosis: RunDiagnosis) -> dict[str, str]:
    """How the error fell on the rung of each effect."""
    falls: dict[str, str] = {}
    for before, after in zip(diagnosis.ladder[:-1], diagnosis.ladder[1:], strict=True):
        old = set(cast("Sequence[str]", before["effects"]))
        text = (
            f"{_number(before, 't_mrmse_m')} -> {_number(after, 't_mrmse_m')} m, "
            f"{_number(before, 'r_mrmse_rad')} -> {_number(after, 'r_mrmse_rad')} rad"
        )
        for name in cast("Sequence[str]", after["effects"]):
            if name not in old:
                falls[name] = text
    return falls


def _describe_unobservable(diagnosis: RunDiagnosis) -> list[str]:
    hidden = [item.id for item in diagnosis.unobservable]
    if not hidden:
        return []
    shown = ", ".join(hidden[:_UNOBSERVABLE_SHOWN])
    more = f" and {len(hidden) - _UNOBSERVABLE_SHOWN} more" if len(hidden) > _UNOBSERVABLE_SHOWN else ""
    manoeuvres: list[str] = []
    for item in diagnosis.unobservable:
        for part in item.manoeuvre.split("; "):
            if part not in manoeuvres:
                manoeuvres.append(part)
    advice = "; ".join(manoeuvres[:3])
    # What a drive reaches within the limits of a place and a robot only its rehearsal shows.
    if any(Excitation.SLOPE not in find_effect(name).needs for name in hidden):
        advice += "; `slip plan` says whether its room and time are enough"
    return [
        f"not observable in this log: {shown}{more}",
        f"to observe {'it' if len(hidden) == 1 else 'them'}: {advice}",
    ]


def _describe_detectable(diagnosis: RunDiagnosis) -> str:
    """Upper bounds of effects that were not found, the tightest first."""
    usual = {one.id: find_effect(one.id)().parameter(one.parameter) for one in diagnosis.detectable}
    sharpest = sorted(diagnosis.detectable, key=lambda one: one.size / usual[one.id].usual_size)
    shown = [
        f"{one.id.replace('_', ' ')} {100.0 * one.size:.2g} %"
        if one.unit == "1"
        else f"{one.id.replace('_', ' ')} {one.size:.2g} {one.unit}"
        for one in sharpest[:_DETECTABLE_SHOWN]
    ]
    return f"upper bounds ({DETECTED_SHARE} %): {', '.join(shown)}" if shown else ""


def _grave(diagnosis: RunDiagnosis) -> list[Mapping[str, Json]]:
    return [finding for finding in diagnosis.findings if finding.get("severity") != "info"][:4]


def _number(content: Mapping[str, Json], key: str) -> str:
    value = content.get(key)
    return f"{value:.3g}" if isinstance(value, int | float) else "-"
