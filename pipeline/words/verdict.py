"""The verdict on a run in one to three sentences: how far off, what the robot does, what remains."""

import math
from collections.abc import Iterable, Sequence
from itertools import groupby

from pipeline.core import enumerate_texts, format_share
from pipeline.models import FEW_STRETCHES, name_term
from pipeline.recording import Finding
from pipeline.results import (
    ABOVE_FLOOR,
    BREVITY,
    CHANGE,
    ERRORS_OVER_2S,
    SEARCH_CUT,
    Named,
    RunDiagnosis,
    Step,
    find_refusal,
    has_no_pose,
    list_excess,
    measure_excess,
    rank_main,
)
from pipeline.run import HORIZON_S
from pipeline.words.effects import describe_clause, list_names, name_group
from pipeline.words.errors import format_excess, format_step
from pipeline.words.findings import format_finding

NOT_FITTED_TO_RUN = "the data of this run do not support a fit"
NOTHING_MISSING = "No effect is missing"
_NOTHING_EVIDENT = "No effect is evident"
_ASSUMED = "its speeds are by an assumed gain of {used:g}, where this log says {value:.4g}"
NO_GROUND = "the log holds no pose: slip is that of the wheels against their commands, not that of the ground"
_TENTATIVE = " (tentative)"
_UNKNOWN = "no known effect explains the rest"
_MOST_CLAUSES = 3
"""Effects that a verdict names; others are in the table below it."""
_SAME_MULTIPLIER = 0.05
"""Absolute logarithm of a multiplier up to which the ideal yaw rate is the commanded one, but for errors."""
_LONGEST = 400
"""Characters that a verdict may have: as much as is read at a glance."""


def format_refusal(findings: Iterable[Finding]) -> str:
    """The verdict on a run that was not diagnosed: what forbids a fit; empty where nothing does."""
    refusal = find_refusal(findings)
    return _join(format_finding(refusal), "No effect can be estimated") if refusal else ""


def format_verdict(run: RunDiagnosis) -> str:
    """The verdict on a run, the same on every face of the program.

    Returns:
        One to three sentences of at most 400 characters.
    """
    if refusal := format_refusal(run.findings):
        return refusal
    ladder = run.ladder
    if not ladder:
        why = (format_finding(one).rstrip(".") for one in run.findings if one.where == "diagnosis")
        return _join(f"No effect can be estimated: {next(why, NOT_FITTED_TO_RUN)}")
    opening = f"Over {HORIZON_S:g} s the ideal model is {format_step(ladder[0])} off"
    scope = [NO_GROUND] if has_no_pose(run.findings) else []
    scope += [_ASSUMED.format(**one.values) for one in run.findings if one.id == "gain_assumed"]
    is_sized = not math.isnan(ladder[0].t_mrmse_m)
    if not is_sized:
        opening = "No stretch of good poses is long enough to tell an error"
    if len(ladder) == 1:
        return _join(f"{opening}{_compare(run)}", *_format_nothing(run), *scope)
    clauses = _list_clauses(run)
    rest = [*scope, *_list_commanded(run)]
    rest += [text] if (text := "; ".join(filter(None, _list_open_ends(run)))) else []
    remaining = f"{format_step(ladder[-1])} remain{_compare(run)}"
    verdict = ""
    for count in range(len(clauses), -1, -1):
        clause = f"{_join_clauses(clauses[:count])}; " if count else ""
        after = f"{clause}with {_name_model(ladder[-1], count)} in the model {remaining}"
        verdict = _join(opening, *([after] if is_sized else filter(None, [clause[:-2]])), *rest)
        if len(verdict) <= _LONGEST:
            break
    suggested = f"{verdict[:-1]}{_suggest(run)}."
    return suggested if verdict.endswith(f"{_UNKNOWN[1:]}.") and len(suggested) <= _LONGEST else verdict


def _list_commanded(run: RunDiagnosis) -> list[str]:
    """What the robot does of the commanded yaw rate, where its controller commands other wheel speeds."""
    turn = run.commanded_turn
    if turn is None or turn.controller_multiplier <= 0.0:
        return []
    if abs(math.log(turn.controller_multiplier)) < _SAME_MULTIPLIER:
        return []
    text = f"it turns at {format_share(turn.share)} of the commanded rate"
    return [f"{text}: its controller's multiplier is {turn.controller_multiplier:.3g}"]


def _list_open_ends(run: RunDiagnosis) -> tuple[str, str, str]:
    """What the log does not decide, what changes during it, and why error remains, as clauses."""
    noted = {one.id: one for one in run.findings}
    why = ""
    if BREVITY in noted:
        why = "the run is too short for certainty"
    elif SEARCH_CUT in noted:
        why = "the budget ended the search for effects early"
    elif CHANGE not in noted and measure_excess(run) >= ABOVE_FLOOR:
        why = describe_refused(run) or _UNKNOWN
    change = noted.get(CHANGE)
    return _describe_choice(run), "" if change is None else format_finding(change), why


def _format_nothing(run: RunDiagnosis) -> list[str]:
    """Sentences on a run of whose errors no effect removes any."""
    corrected = [clause for one in run.effects if (clause := describe_clause(one, run))]
    sentences = [f"{_join_clauses(corrected[:_MOST_CLAUSES])}, which is corrected"] if corrected else []
    noted = {one.id for one in run.findings}
    if BREVITY in noted:
        return [*sentences, "The run is too short to determine the cause"]
    if SEARCH_CUT in noted:
        return [*sentences, "The budget ended the search for effects early"]
    if not list_excess(run):
        return [*sentences, "The noise floor of this run is not known"]
    is_named = run.unexplained is not None and run.unexplained.with_formula is not None
    if measure_excess(run) < ABOVE_FLOOR and not is_named:
        is_at_floor = format_excess(measure_excess(run)) == format_excess(1.0)
        return sentences or [NOTHING_MISSING if is_at_floor else _NOTHING_EVIDENT]
    if run.undecided:
        return [
            *sentences,
            f"The cause is {name_group(run.undecided[0].candidates)}, which this log does not separate",
        ]
    return [*sentences, describe_refused(run) or f"No known effect explains the error{_suggest(run)}"]


def describe_refused(run: RunDiagnosis) -> str:
    """What the refused effect that leaves least would leave, and why it has no name; empty without one."""
    if not run.refused:
        return ""
    one = run.refused[0]
    return f"{name_term(one.id)} would leave {format_step(one.errors)}, but {one.reason}"


def _suggest(run: RunDiagnosis) -> str:
    """What a suggested formula would leave of the error, as the end of a sentence; empty without one."""
    rest = run.unexplained
    if rest is None or rest.with_formula is None:
        return ""
    return f": a suggested term would leave {format_step(rest.with_formula)}"


def _list_clauses(run: RunDiagnosis) -> list[str]:
    """What the robot does by the largest of the main effects, in the order of the ladder."""
    undecided = {one.in_model for one in run.undecided}
    named = {one.id: one for one in run.effects if one.is_determined}
    ranked = rank_main(run)
    clauses = {
        name: f"{clause}{_TENTATIVE * _is_tentative(named[name])}"
        for name in ranked
        if name in named and name not in undecided and (clause := describe_clause(named[name], run))
    }
    largest = sorted(clauses, key=lambda name: -ranked[name])[:_MOST_CLAUSES]
    return [clause for name, clause in clauses.items() if name in largest]


def _is_tentative(effect: Named) -> bool:
    """Whether few stretches of the drive tell one of its numbers."""
    return any(value.doubt == FEW_STRETCHES for value in effect.parameters.values())


def _describe_choice(run: RunDiagnosis) -> str:
    """The main effect that the log does not name, as a clause: `this log does not decide between A and B`."""
    main = rank_main(run)
    chosen = next((one for one in run.undecided if one.in_model in main), None)
    if chosen is None:
        return ""
    return f"this log does not decide between {enumerate_texts(list_names(chosen.candidates))}"


def _join_clauses(clauses: Sequence[str]) -> str:
    """Clauses in their order as one sentence, neighbours with the same subject joined."""
    groups = groupby(clauses, key=lambda one: one.startswith("the "))
    sentences = [
        one for own, some in groups for one in (some if own else [f"the robot {enumerate_texts([*some])}"])
    ]
    return ", and ".join(filter(None, [", ".join(sentences[:-1]), *sentences[-1:]]))


def _name_model(step: Step, shown: int) -> str:
    """The effects of the whole model in words, of which so many were just said."""
    count = len(step.effects)
    if count == shown:
        return {1: "this", 2: "both"}.get(count, "these")
    return {1: "one effect", 2: "two effects"}.get(count, "all effects")


def _compare(run: RunDiagnosis) -> str:
    """The error of the last step in times the noise floor; empty where it is not known."""
    times = {ERRORS_OVER_2S[key][0]: one for key, one in list_excess(run).items()}
    if not times:
        return ""
    said = {of: format_excess(one) for of, one in times.items()}
    (most, first), *rest = sorted(said.items(), key=lambda one: -times[one[0]])
    if len(times) == len(ERRORS_OVER_2S) and len(set(said.values())) == 1:
        return f", {first} the noise floor"
    others = "".join(
        f" and {other}{' the noise floor' if other == 'at' else ''} in {of}" for of, other in rest
    )
    return f", {first} the noise floor in {most}{others}"


def _join(*sentences: str) -> str:
    return " ".join(f"{text[:1].upper()}{text[1:]}." for text in sentences)
