"""The verdict on a run in one to three sentences: how far off, what the robot does, what remains."""

from __future__ import annotations

import math
from itertools import groupby, pairwise
from typing import TYPE_CHECKING, TypeVar, cast

from pipeline.core import enumerate_texts, format_share
from pipeline.core.untrusted import mapping_in, number_in, objects_in
from pipeline.estimation.error_regions import ABOVE_FLOOR, BREVITY, format_errors, format_excess
from pipeline.estimation.ladder import ERRORS_OVER_2S
from pipeline.models import catalogue
from pipeline.recording import FAULTS
from pipeline.run.signals import GROUND_UNOBSERVABLE
from pipeline.run.windows import HORIZON_S

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    Content = Mapping[str, object]

Entry = TypeVar("Entry")

FATAL = ("not_moving", "pose_from_wheels", *FAULTS)
"""Findings of which one makes every fit meaningless: no effect is named."""
CHANGE = "changing_number"
"""The finding of a run during which a number of the model changes."""
SEARCH_CUT = "search_cut"
"""The finding of a run whose budget ended the search for effects before it was complete."""
CAUSE_NAMES = {"localization_noise": "localization noise"}
"""Causes of an error budget in words, where these differ from the id."""
NOT_FITTED_TO_RUN = "the data of this run do not support a fit"
NOTHING_MISSING = "No effect is missing"
NO_GROUND = "the log holds no pose: slip is that of the wheels against their commands, not that of the ground"
_MAIN_SHARE = 0.1
"""Of the ideal model's error over 2 s, in metres or radians: an effect that removes less is a smaller one."""
_MOST_CLAUSES = 3
"""Effects that a verdict names; others are in the table below it."""
_MOST_ALTERNATIVES = 3
"""Alternatives of an effect that it names."""
_SAME_MULTIPLIER = 0.05
"""Absolute logarithm of a multiplier up to which the ideal yaw rate is the commanded one, but for errors."""
_LONGEST = 400
"""Characters that a verdict may have: as much as is read at a glance."""


def has_no_pose(run: Content) -> bool:
    """Whether the log of a run, as JSON, holds no pose, so that only its drivetrain is observable."""
    return any(one.get("id") == GROUND_UNOBSERVABLE for one in objects_in(run, "findings"))


def find_refusal(run: Content) -> str:
    """The finding of a run, as JSON, that makes every fit meaningless; empty where there is none."""
    return next((str(one["text"]) for one in objects_in(run, "findings") if one.get("id") in FATAL), "")


def format_verdict(diagnosis: Content) -> str:
    """The verdict on a run, the same on every face of the program.

    Args:
        diagnosis: the JSON object of one run of ``slip diagnose --json``; of a run that was not diagnosed
            its findings alone.

    Returns:
        One to three sentences of at most 400 characters; empty where nothing was diagnosed or refused.
    """
    findings = objects_in(diagnosis, "findings")
    if refusal := find_refusal(diagnosis):
        return _join(refusal, "No effect can be estimated")
    if "ladder" not in diagnosis:
        return ""
    ladder = objects_in(diagnosis, "ladder")
    if not ladder:
        why = (str(one["text"]).rstrip(".") for one in findings if one.get("where") == "diagnosis")
        return _join(f"No effect can be estimated: {next(why, NOT_FITTED_TO_RUN)}")
    opening = f"Over {HORIZON_S:g} s the ideal model is {format_errors(ladder[0])} off"
    scope = [NO_GROUND] if has_no_pose(diagnosis) else []
    if len(ladder) == 1:
        return _join(f"{opening}{_compare(diagnosis, ', ')}", *_format_nothing(diagnosis), *scope)
    clauses = _list_clauses(diagnosis)
    rest = [*scope, *_list_commanded(diagnosis)]
    rest += [text] if (text := "; ".join(filter(None, _list_open_ends(diagnosis)))) else []
    remaining = f"{format_errors(ladder[-1])} remain{_compare(diagnosis, ', ')}"
    verdict = ""
    for count in range(min(len(clauses), _MOST_CLAUSES), -1, -1):
        said = dict([*clauses.items()][:count])
        clause = f"{_join_clauses([*said.values()])}; " if count else ""
        model = _name_model(ladder[-1], count)
        verdict = _join(opening, f"{clause}with {model} in the model {remaining}", *rest)
        if len(verdict) <= _LONGEST:
            break
    return verdict


def _list_commanded(diagnosis: Content) -> list[str]:
    """What the robot does of the commanded yaw rate, where its controller commands other wheel speeds."""
    turn = mapping_in(diagnosis, "commanded_turn")
    share, multiplier = number_in(turn, "share"), number_in(turn, "controller_multiplier")
    if share is None or multiplier is None or multiplier <= 0.0:
        return []
    if abs(math.log(multiplier)) < _SAME_MULTIPLIER:
        return []
    text = f"it turns at {format_share(share)} of the commanded rate"
    return [f"{text}: its controller's multiplier is {multiplier:.3g}"]


def _list_open_ends(diagnosis: Content) -> tuple[str, str, str]:
    """What the log does not decide, what changes during it, and why error remains, as clauses."""
    noted = {one.get("id"): str(one.get("text")) for one in objects_in(diagnosis, "findings")}
    why = ""
    if BREVITY in noted:
        why = "the run is too short for certainty"
    elif SEARCH_CUT in noted:
        why = "the budget ended the search for effects early"
    elif CHANGE not in noted and measure_excess(diagnosis) >= ABOVE_FLOOR:
        why = "no known effect explains the rest"
    return _describe_choice(diagnosis), noted.get(CHANGE, ""), why


def rank_effects(ladder: Sequence[Content]) -> dict[str, float]:
    """Effects in the order in which they are listed everywhere: that of the ladder.

    Args:
        ladder: rungs with ``effects``, ``t_mrmse_m`` and ``r_mrmse_rad``, from the ideal model up.

    Returns:
        The share of the ideal model's error over 2 s that each removes, in position or heading, by id.
    """
    shares: dict[str, float] = {}
    for before, after in pairwise(ladder):
        falls = [
            (number - other) / ideal
            for key in ERRORS_OVER_2S
            if (ideal := number_in(ladder[0], key))
            and (number := number_in(before, key)) is not None
            and (other := number_in(after, key)) is not None
        ]
        for name in list_added(before, after):
            shares.setdefault(name, max(falls, default=0.0))
    return shares


def rank_main(ladder: Sequence[Content]) -> dict[str, float]:
    """Those of `rank_effects` up to the last one that removes a tenth of the error, at least one effect.

    What removes less before it stays in the list, so that each error continues from the one above.
    """
    ranked = rank_effects(ladder)
    large = [number for number, share in enumerate(ranked.values()) if share >= _MAIN_SHARE]
    return dict([*ranked.items()][: max([*large, 0]) + 1])


def split_main(
    effects: Sequence[Entry], ladder: Sequence[Content], read: Callable[[Entry], tuple[object, bool]]
) -> tuple[list[Entry], list[Entry]]:
    """The effects of `rank_main` with the clocks that were corrected, and the smaller effects.

    A clock that was corrected before the first fit has no step of the ladder that could show it to be small.

    Args:
        effects: that were named.
        ladder: as in `rank_main`.
        read: the id of one of them, and whether it was corrected.

    Returns:
        Main and smaller effects in their order; where `rank_main` lists none, all are main.
    """
    first = rank_main(ladder)
    if not first.keys() & {read(effect)[0] for effect in effects}:
        return list(effects), []
    is_main = [name in first or corrected for name, corrected in map(read, effects)]
    main = [effect for effect, chosen in zip(effects, is_main, strict=True) if chosen]
    return main, [effect for effect, chosen in zip(effects, is_main, strict=True) if not chosen]


def is_small(name: str, ladder: Sequence[Content]) -> bool:
    """Whether the ladder contains an effect that `rank_main` does not list."""
    ids = {added for before, after in pairwise(ladder) for added in list_added(before, after)}
    return name in ids - set(rank_main(ladder))


def _format_nothing(diagnosis: Content) -> list[str]:
    """Sentences on a run of whose errors no effect removes any."""
    corrected = [str(one["clause"]) for one in objects_in(diagnosis, "effects") if one.get("clause")]
    sentences = [f"{_join_clauses(corrected[:_MOST_CLAUSES])}, which is corrected"] if corrected else []
    noted = {one.get("id") for one in objects_in(diagnosis, "findings")}
    if BREVITY in noted:
        return [*sentences, "The run is too short to determine the cause"]
    if SEARCH_CUT in noted:
        return [*sentences, "The budget ended the search for effects early"]
    if not _list_excess(diagnosis):
        return [*sentences, "The noise floor of this run is not known"]
    if measure_excess(diagnosis) < ABOVE_FLOOR and not diagnosis.get("unexplained"):
        return sentences or [NOTHING_MISSING]
    open_groups = [
        name_group(cast("Sequence[str]", one["candidates"])) for one in objects_in(diagnosis, "undecided")
    ]
    if open_groups:
        return [*sentences, f"The cause is {open_groups[0]}, which this log does not separate"]
    return [*sentences, "No known effect explains the error"]


def _list_clauses(diagnosis: Content) -> dict[str, str]:
    """What the robot does by each main effect of the ladder, by its id, in its order."""
    undecided = {one.get("in_model") for one in objects_in(diagnosis, "undecided")}
    known = {
        str(one["id"]): str(one["clause"])
        for one in objects_in(diagnosis, "effects")
        if one.get("clause") and one["id"] not in undecided and _is_determined(one)
    }
    main = rank_main(objects_in(diagnosis, "ladder"))
    return {name: known[name] for name in main if name in known}


def _is_determined(effect: Content) -> bool:
    """Whether the log determines a number of an effect, or its clock was corrected beforehand."""
    numbers = mapping_in(effect, "parameters")
    undetermined = [bool(mapping_in(numbers, key).get("undetermined")) for key in numbers]
    return bool(effect.get("corrected")) or not undetermined or not all(undetermined)


def _describe_choice(diagnosis: Content) -> str:
    """The main effect that the log does not name, as a clause: `this log does not decide between A and B`."""
    main = rank_main(objects_in(diagnosis, "ladder"))
    for one in objects_in(diagnosis, "undecided"):
        if one.get("in_model") in main:
            names = _list_names(cast("Sequence[str]", one["candidates"]))
            return f"this log does not decide between {enumerate_texts(names)}"
    return ""


def list_added(before: Content, after: Content) -> list[str]:
    """Ids of the effects that a rung of the ladder has beyond the one below."""
    return [name for name in _list_ids(after) if name not in _list_ids(before)]


def name_group(candidates: Sequence[str]) -> str:
    """Alternatives in words: `body inertia or lateral skid`; of many the first two, and how many more."""
    names = _list_names(candidates)
    return " or ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))


def _list_names(candidates: Sequence[str]) -> list[str]:
    names = [name_effect(name) for name in candidates]
    return [*names[:2], f"{len(names) - 2} others"] if len(names) > _MOST_ALTERNATIVES else names


def name_effect(name: str) -> str:
    """An effect by its term in place of its id: `lateral centre of rotation`."""
    term = catalogue.name_effect(name)
    return f"{term[:1].lower()}{term[1:]}"


def _join_clauses(clauses: Sequence[str]) -> str:
    """Clauses in their order as one sentence, neighbours with the same subject joined."""
    groups = groupby(clauses, key=lambda one: one.startswith("the "))
    return ", and ".join(f"{'' if own else 'the robot '}{enumerate_texts([*some])}" for own, some in groups)


def _name_model(step: Content, shown: int) -> str:
    """The effects of the whole model in words, of which so many were just said."""
    count = len(_list_ids(step))
    if count == shown:
        return {1: "this", 2: "both"}.get(count, "these")
    return {1: "one effect", 2: "two effects"}.get(count, "all effects")


def _compare(diagnosis: Content, before: str) -> str:
    """The error of the last rung in times the noise floor; empty where it is not known."""
    times = {ERRORS_OVER_2S[key][0]: one for key, one in _list_excess(diagnosis).items()}
    if not times:
        return ""
    said = {of: format_excess(one) for of, one in times.items()}
    (most, first), *rest = sorted(said.items(), key=lambda one: -times[one[0]])
    if len(times) == len(ERRORS_OVER_2S) and len(set(said.values())) == 1:
        return f"{before}{first} the noise floor"
    others = "".join(
        f" and {other}{' the noise floor' if other == 'at' else ''} in {of}" for of, other in rest
    )
    return f"{before}{first} the noise floor in {most}{others}"


def measure_excess(diagnosis: Content) -> float:
    """The larger error of the last rung over its noise floor; 0 where that is not known."""
    return max(_list_excess(diagnosis).values(), default=0.0)


def _list_excess(diagnosis: Content) -> dict[str, float]:
    """The errors of the last rung over the noise floor, where that is known."""
    last, floor = objects_in(diagnosis, "ladder")[-1], mapping_in(diagnosis, "noise_floor")
    return {
        key: error / least
        for key in ERRORS_OVER_2S
        if (error := number_in(last, key)) is not None and (least := number_in(floor, key))
    }


def _join(*sentences: str) -> str:
    return " ".join(f"{text[:1].upper()}{text[1:]}." for text in sentences)


def _list_ids(step: Content) -> list[str]:
    names = step.get("effects")
    return [str(name) for name in names] if isinstance(names, list | tuple) else []
