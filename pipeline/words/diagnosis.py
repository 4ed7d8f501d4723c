"""A diagnosis as lines of text: verdict, main effects and remaining error; then all other sections."""

import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import pairwise

from pipeline.core import (
    INPUT_WORDS,
    format_count,
    format_part,
    format_share,
    group_by,
    mark_finding,
    round_digits,
    suffix_unit,
)
from pipeline.models import Excitation, Number, list_effects, name_term, split_determined
from pipeline.recording import Finding, Severity
from pipeline.results import (
    ABOVE_FLOOR,
    BREVITY,
    BUDGET_SLIP,
    CHANCE,
    CHANGE,
    DETECTED_SHARE,
    ERRORS_OVER_2S,
    SEARCH_CUT,
    Named,
    RunDiagnosis,
    Step,
    Undecided,
    Unexplained,
    is_small,
    key_finding,
    list_added,
    list_rises,
    measure_excess,
    rank_main,
    split_main,
)
from pipeline.run import HORIZON_S
from pipeline.words.effects import (
    describe_cause,
    describe_instead,
    describe_motion,
    describe_number,
    describe_separation,
    format_numbers,
    format_with_range,
    is_clock,
    is_open,
    name_group,
    name_scope,
    suggest_drive,
)
from pipeline.words.errors import (
    describe_lead,
    describe_moments,
    describe_need,
    describe_regions,
    describe_unexplained,
    format_fall,
    format_rises,
    format_step,
    list_remaining_errors,
)
from pipeline.words.findings import format_finding
from pipeline.words.verdict import format_verdict

Row = tuple[str, str]

VERDICT = "verdict"
_LABEL = 10
"""Columns of a label on a screen, with the space after it."""
_INDENT = "    "
_WIDEST = 34
"""Largest column width for the values of an effect in a table of effects."""
_MOST_IN_LINE = 2
"""Most values in one line; an effect with more, as a servo, has one line per value."""
_NOT_KNOWN = "not yet known"
_UNCHANGED = "no visible change of the error over 2 s"
_WHERE_SHOWN = 3
"""Regions of the error that are listed."""
_UNOBSERVABLE_SHOWN = 8
"""Unobservable effects that are listed: more would fill a screen."""
_DETECTABLE_SHOWN = 5
"""Detection limits that are listed, the smallest ones."""
_VALUE = re.compile(r'^(\w+) = \{ value = ([^,}]+), unit = "([^"]*)"', re.MULTILINE)
_INPUTS = {
    "v0": "ideal forward speed",
    "s0": "ideal lateral speed",
    "w0": "ideal yaw rate",
    "left": "speed of the left wheels",
    "right": "speed of the right wheels",
    "left_angle": "angle that they have turned",
    "right_angle": "angle that they have turned",
}
"""Inputs of formulas in words."""
_ONE_SIDED = {
    "w0 + abs(w0)": "in left turns",
    "w0 - abs(w0)": "in right turns",
    "v0 + abs(v0)": "forward",
    "v0 - abs(v0)": "backward",
}
"""Factors of formulas that are zero but for one way of driving."""
_FINDINGS_SHOWN = 3
"""Distinct findings that are shown by default; the others are counted, and shown with `--all`."""
_HEADS_SHOWN = 4
"""Most runs that are named one a line by default; the names of more are between the first and the last."""
_EFFECTS_SHOWN = 5
"""Effects with a line by default, the largest ones; what stands out has one beside them."""
BELOW_MAIN = "each below a tenth of every error"
"""Which effects are the smaller ones."""


def has_dead_encoder(findings: Iterable[Finding]) -> bool:
    """Whether an encoder of the log is dead, at times or throughout."""
    return any(one.id in {"encoder_dead", "wheel_dead"} for one in findings)


_OF_ENCODERS = frozenset(
    {
        "digging_in",
        "pushed",
        "side_stopped",
        "sliding",
        "spinning",
        "stuck",
        "wheel_radius_wrong",
        "wheel_scale",
        "wheels_delay",
        "wheels_left_out",
    }
)
"""Findings that a dead encoder makes by itself."""
_RANK = {"error": 0, "warning": 1, "info": 3}
_LONGEST_TERM = 70
"""Characters up to which a suggested term is shown: a longer one is no formula that anybody reads."""


_LARGE = 0.1
"""Share of the time from which on it is said that a vehicle stands: the numbers of less hardly differ."""


def describe_standing(share: float | None) -> str:
    """What numbers of slip leave out where a vehicle stands for long; empty where it does not."""
    if share is None or share < _LARGE:
        return ""
    return f"standing {format_share(share)} of the time, left out of these numbers"


def describe(
    runs: Sequence[RunDiagnosis],
    following: str = "",
    *,
    simulated: Collection[str] = (),
    everything: bool = False,
) -> str:
    """A diagnosis as plain text; the common part of runs that were judged together appears once.

    Args:
        runs: of one run, or of all that were judged together.
        following: command suggested as the next step, where effects were identified.
        simulated: names of the runs whose logs are simulated.
        everything: show all sections, not only verdict, main effects and remaining error.
    """
    first, *others = runs
    heads = [f"{run.run}{'    simulated' if run.run in simulated else ''}" for run in runs]
    if len(runs) > _HEADS_SHOWN and not everything:
        count = sum(run.run in simulated for run in runs)
        said = f"    {'all' if count == len(runs) else count} simulated" if count else ""
        heads = [f"{len(runs)} runs, {runs[0].run} to {runs[-1].run}{said}"]
    heads[-1] += f"    {'together, ' if others else ''}{_name_input(first.input, first.input_reason or '')}"
    lines = list_lines(first, others, everything=everything)
    rows = format_lines(lines)
    if following and first.effects:
        rows.append(f"next      {following}")
    return "".join(f"{line}\n" for line in [*heads, *rows])


def format_lines(lines: Sequence[Row]) -> list[str]:
    """Lines as shown on a screen; the verdict has no label."""
    return [text if label == VERDICT else f"{label:<{_LABEL - 1}} {text}".rstrip() for label, text in lines]


def _name_input(source: str, reason: str) -> str:
    return f"{INPUT_WORDS[source]}{f' ({reason})' if reason else ''}"


def list_lines(
    run: RunDiagnosis, others: Sequence[RunDiagnosis] = (), *, everything: bool = False
) -> list[Row]:
    """Label and text of every line after the head; a line without a label continues the section above.

    Args:
        run: what was found.
        others: in the runs that were judged together with it.
        everything: all sections, not only verdict, main effects, what they do not explain, and findings.
    """
    verdict = format_verdict(run)
    findings = list_findings(
        {one.run: one.findings for one in (run, *others)}, verdict, everything=everything
    )
    lines = [(VERDICT, verdict)]
    if not run.ladder:
        return [*lines, *findings]
    if everything:
        return [*lines, *_list_all(run, findings)]
    return [
        *lines,
        *_label("effects", _list_main(run)),
        *_label("remaining", _list_rest(run, verdict)),
        *findings,
    ]


def _list_main(run: RunDiagnosis) -> list[str]:
    """A line for each of the main effects: its term, the error that it lowers most, its id and value."""
    main, minor, _ = _split_effects(run)
    felt, small = _split_ambiguous(run)
    undecided = {item.in_model for item in felt}
    falls = list_largest_falls(run)
    named = [one for one in main if one.id not in undecided]
    shown = [one for one in named if falls.get(one.id) != _UNCHANGED or one.stands_out]
    unseen = [one for one in named if one not in shown]
    ranked = rank_main(run)
    by_share = sorted((one.id for one in shown if one.id in ranked), key=lambda name: -ranked[name])
    listed = [one for one in shown if one.id not in by_share[_EFFECTS_SHOWN:] or one.stands_out]
    rows = [
        (
            name_term(effect.id),
            falls.get(effect.id, ""),
            ", ".join(filter(None, (f"{effect.id}: {format_short(effect)}", describe_instead(effect, run)))),
        )
        for effect in listed
    ]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    texts = [
        "  ".join(f"{text:<{width}}" for text, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
    for item in felt:
        texts.append(f"Undecided: {name_group(item.candidates)}")
        texts.append(f"{_INDENT}to separate them: {describe_separation(item)}")
    texts += _list_raising(run)
    folded = len(unseen) + len(minor)
    hidden = len(shown) - len(listed)
    counts = [format_count(hidden, "more effect")] if hidden else []
    counts += [format_count(folded, "smaller effect")] if folded else []
    counts += [f"{len(small)} undecided"] if small else []
    if counts:
        why = f"{BELOW_MAIN}; " if folded else ""
        texts.append(f"{', and '.join(counts)} ({why}--all)")
    return texts


def _list_raising(run: RunDiagnosis) -> list[str]:
    """The named effects that raise one error over 2 s by more than they lower the other."""
    named = {effect.id for effect in run.effects}
    return [
        f"with {name_term(name)} the {format_rises(before, after)}: it is named because the motion over "
        "shorter times is more likely with it"
        for before, after in pairwise(run.ladder)
        if list_rises(before, after, CHANCE) and _measure_change(before, after) > 0.0
        for name in list_added(before, after)
        if name in named
    ]


def _measure_change(before: Step, after: Step) -> float:
    """Logarithm of the product of the errors over 2 s after a step over that before it."""
    pairs = ((getattr(before, key), getattr(after, key)) for key in ERRORS_OVER_2S)
    return sum(math.log(new / old) for old, new in pairs if old > 0.0 < new)


def list_largest_falls(run: RunDiagnosis) -> dict[str, str]:
    """The error over 2 s that each effect lowers most, before and after it, by its id."""
    falls = {
        name: _format_largest_fall(before, after)
        for before, after in pairwise(run.ladder)
        for name in list_added(before, after)
    }
    falls |= {one.id: _describe_correction(one, run) for one in run.effects if one.corrected}
    ranked = rank_main(run)
    large = [one.id for one in run.effects if one.id not in ranked and one.stands_out and not one.corrected]
    return falls | {name: f"{falls[name]}, listed for its large value" for name in large if name in falls}


def _describe_correction(effect: Named, run: RunDiagnosis) -> str:
    """Which clock was corrected: that of the position may be another than that of the heading."""
    moved = any(one.id == "pose_delay" and "position_s" in one.values for one in run.findings)
    return "positions stamped d late" if is_clock(effect) and moved else "corrected before the fit"


def format_short(effect: Named) -> str:
    """The values of an effect with what they are; of more than two the first, and how many more it has.

    The name of an effect of one number with a unit says what it is: `yaw rate limit: limit = 1.01 rad/s`.
    """
    if effect.own:
        return _format_own(effect)
    if not effect.shown:
        return ""
    known = list(effect.shown.items())
    is_said = len(effect.parameters) > 1 or known[0][1].unit == "1"
    # Of two, neither stands for the other: a lag of speed is not one of turning.
    shown = [
        ", ".join(
            filter(
                None,
                (
                    format_numbers({name: value}),
                    _NOT_KNOWN
                    * (not value.doubt and not effect.corrected and is_open(effect.id, name, value)),
                    describe_number(effect.id, name) * is_said,
                ),
            )
        )
        for name, value in (known if len(known) <= _MOST_IN_LINE else known[:1])
    ]
    hidden = len(known) - len(shown)
    return "; ".join([*shown, *([f"{hidden} more"] if hidden else [])])


def _format_own(effect: Named) -> str:
    """The range over runs or terrains of the first value that differs between them and is known."""
    for name in filter(effect.own.__contains__, effect.parameters):
        known = [one[name] for one in effect.by_run if not one[name].is_undetermined]
        if known:
            low, *_, high = sorted([known[0], *known], key=lambda one: one.value)
            ends = dict.fromkeys(f"{round_digits(one.value, one.digits):.3g}" for one in (low, high))
            about = describe_number(effect.id, name)
            elsewhere = " where it is known" if len(known) < len(effect.by_run) else ""
            text = f"{name} = {' to '.join(ends)}{suffix_unit(low.unit)} {name_scope(effect)}{elsewhere}"
            return f"{text}, {about}" if about else text
    return "open in every run" if is_clock(effect) else "open on every terrain"


def _format_largest_fall(before: Step, after: Step) -> str:
    """The error over 2 s that falls most, before and after a step."""
    shares = {key: getattr(after, key) / old for key in ERRORS_OVER_2S if (old := getattr(before, key)) > 0.0}
    largest = min(shares, key=shares.__getitem__, default=None)
    return (
        ""
        if largest is None
        else format_fall(getattr(before, largest), getattr(after, largest), largest) or _UNCHANGED
    )


def _list_rest(run: RunDiagnosis, verdict: str) -> list[str]:
    """What the effects do not explain, and a suggested term."""
    rest = run.unexplained
    if rest is None or (rest.kind == "lasting" and measure_excess(run) < ABOVE_FLOOR):
        # Noise that lasts, at the noise floor, stands behind --all.
        return []
    return [describe_unexplained(rest), *list_terms(rest), format_suggestion(rest, verdict)]


def list_terms(rest: Unexplained) -> list[str]:
    """The terms of a suggested formula, with its numbers and inputs in words."""
    return [f"suggested term: {line}" for line in _list_formula(rest.formula or "")]


def _list_all(run: RunDiagnosis, findings: Sequence[Row]) -> list[Row]:
    """All sections after the verdict."""
    main, minor, unknown = _split_effects(run)
    felt, small = _split_ambiguous(run)
    falls = _list_falls(run)
    short = [effect for effect in main if len(effect.shown) <= _MOST_IN_LINE]
    width = max((len(_format_values(effect, _list_shared(effect))) for effect in short), default=0)
    effects = [text for effect in main for text in _format_effect(effect, run, falls, width)]
    effects += [text for item in felt for text in _format_ambiguous(item, falls)]
    others = [text for one in minor for text in _format_effect(one, run, falls)]
    others += [text for item in small for text in _format_ambiguous(item, falls)]
    return [
        *_label("effects", effects),
        *_label("remaining", _format_remaining(run)),
        *findings,
        *_label("smaller", others),
        *_label("open", [*(describe_motion(effect, run) for effect in unknown), _format_unknown(run)]),
        *_label("causes", [text for effect in run.effects for text in _format_causes(effect)]),
        *_label("clocks", [_format_encoders(run)]),
        *_label("ranges", [text for effect in run.effects for text in _format_range(effect)]),
        *_label("error", [f"{format_step(run.ladder[0])} over {HORIZON_S:g} s with the ideal model"]),
        *_label("where", describe_regions(run.where)[:_WHERE_SHOWN]),
        *_label("when", [describe_moments(one) for one in run.when]),
        *_label("budget", [_format_budget(run)]),
        *_label("data", [describe_need(run)]),
        *_label("unseen", _format_unobservable(run)),
        *_label("limits", [_format_detectable(run)]),
    ]


def _label(label: str, texts: Sequence[str]) -> list[Row]:
    return [("" if number else label, text) for number, text in enumerate(filter(None, texts))]


def _split_effects(run: RunDiagnosis) -> tuple[list[Named], list[Named], list[Named]]:
    """Effects that remove a tenth of the error or stand out; smaller ones; those without a number.

    What this log does not determine, or only at a bound, has no row but with `--all`.
    """
    unknown = [effect for effect in run.effects if not effect.is_determined]
    known = [effect for effect in run.effects if effect.is_determined]
    return *split_main(known, run), unknown


def _format_unknown(run: RunDiagnosis) -> str:
    """Numbers that this log does not determine."""
    texts = [
        f"{effect.id} {', '.join(unknown)}"
        for effect in run.effects
        if not effect.corrected and (unknown := _list_unknown(effect))
    ]
    return f"not determined by this log: {'; '.join(texts)}" if texts else ""


def _list_unknown(effect: Named) -> list[str]:
    """Names of its values that no run determines."""
    known = {name for one in (effect.parameters, *effect.by_run) for name in split_determined(one)[0]}
    return [name for name in effect.parameters if name not in known]


def _split_ambiguous(run: RunDiagnosis) -> tuple[list[Undecided], list[Undecided]]:
    """Groups with an effect that removes a tenth of the error or with none in the model; smaller groups."""
    small = [item for item in run.undecided if is_small(item.in_model, run)]
    return [item for item in run.undecided if item not in small], small


def _format_effect(
    effect: Named, run: RunDiagnosis, falls: Mapping[str, str], width: int = 0
) -> Iterator[str]:
    """The motion due to an effect, then its id with values, error reductions and qualifications."""
    yield describe_motion(effect, run)
    notes = [f"= {', '.join(effect.equivalent_to)}"] if effect.equivalent_to else []
    notes += [_describe_correction(effect, run)] if effect.corrected else []
    parts = [falls.get(effect.id, ""), f"({'; '.join(notes)})" if notes else ""]
    shared = _list_shared(effect)
    yield from _describe_numbers(effect.id, shared, parts, _format_values(effect, shared), width)
    where = group_by(
        (format_numbers({key: value for key, value in numbers.items() if key in effect.own}), name)
        for name, numbers in zip(run.joint, effect.by_run, strict=False)
    )
    for text, names in where.items():
        if text:
            others = f" and {len(names) - 1} more" if len(names) > 1 else ""
            yield f"{_INDENT}{text} in {names[0]}{others}"


def _describe_numbers(
    name: str, numbers: Mapping[str, Number], parts: Sequence[str], values: str, width: int = 0
) -> Iterator[str]:
    """An id with its values and notes: in one line, or with one line per value."""
    is_long = len(numbers) > _MOST_IN_LINE
    first = "" if is_long else f"{values:<{min(width, _WIDEST)}}"
    rest = "  ".join(filter(None, [first, *parts]))
    yield f"{_INDENT}{_pad_id(name)}{rest}".rstrip()
    if is_long:
        yield from (f"{_INDENT}{_pad_id('')}{_format_all({key: one})}" for key, one in numbers.items())


def _pad_id(name: str) -> str:
    """An id padded to a column, always followed by two spaces."""
    return f"{name + '  ':<20}"


def _format_ambiguous(item: Undecided, falls: Mapping[str, str]) -> Iterator[str]:
    yield f"Undecided: {name_group(item.candidates)}"
    for name in item.candidates:
        if numbers := split_determined(item.parameters.get(name, {}))[0]:
            notes = [falls.get(name, ""), "(in the model)"] if name == item.in_model else []
            yield from _describe_numbers(name, numbers, notes, _format_all(numbers))
    yield f"{_INDENT}to separate them: {describe_separation(item)}"


def _format_remaining(run: RunDiagnosis) -> list[str]:
    """The remaining error relative to the noise floor, and its structure."""
    rows = list_remaining_errors(run)
    rest = run.unexplained
    if rest is None:
        return [*rows, "" if run.effects else describe_lead(run), *_suggest_next_steps(run)]
    rows.append(describe_unexplained(rest))
    rows += list_terms(rest)
    return [*rows, format_suggestion(rest), *_suggest_next_steps(run)]


def _list_formula(text: str) -> Iterator[str]:
    """Each term of a formula as model files have it, with its numbers, and its inputs in words."""
    numbers = [(name, f"{float(value):.3g} {unit}") for name, value, unit in _VALUE.findall(text)]
    for line in text.splitlines():
        term = line.replace('"', "")
        if term.startswith("v_") and len(term) <= _LONGEST_TERM:
            names = set(re.findall(r"\w+", term))
            known = [f"{name} = {value.removesuffix(' 1')}" for name, value in numbers if name in names]
            known += [f"{name} the {words}" for name, words in _INPUTS.items() if name in names]
            known += [f"{one} acts only {words}" for one, words in _ONE_SIDED.items() if one in term]
            yield ", ".join([term, *known])


def format_suggestion(rest: Unexplained, verdict: str = "") -> str:
    """How to add a suggested formula, and what it would leave where the verdict does not say so."""
    if rest.with_formula is None:
        return ""
    remaining = format_step(rest.with_formula)
    text = "add it in `slip serve`, or in Python with `model + diagnosis.suggestion`"
    return text if remaining in verdict else f"{text}: {remaining} would remain over {HORIZON_S:g} s"


def _suggest_next_steps(run: RunDiagnosis) -> list[str]:
    """Suggested steps where no known effect explains the remaining error."""
    if measure_excess(run) < ABOVE_FLOOR:
        return []
    noted = {one.id for one in run.findings}
    if CHANGE in noted:
        causes = "load, wheels, battery, controller or terrain"
        return [
            f"next steps: find out what changed then ({causes}); cut the log there, and diagnose both parts"
        ]
    if SEARCH_CUT in noted:
        return ["next steps: diagnose the run again with a larger --budget"]
    if BREVITY in noted:
        return ["next steps: drive longer, with turns and speeds of both signs"]
    steps = ["see what `slip plan` proposes"] if run.undecided or run.unobservable_why else []
    steps += ["diagnose another run to see whether it repeats", "write the missing effect yourself"]
    how = "as a formula in `slip serve`, or in Python with `slip model new-effect`"
    return [f"next steps: {'; '.join(steps)}, {how}"]


def _format_causes(effect: Named) -> Iterator[str]:
    """Possible causes of an effect; its motion stands above, under `effects`."""
    if cause := describe_cause(effect):
        yield f"{effect.id}: {cause}"


def _format_range(effect: Named) -> Iterator[str]:
    """The expected range of values in another run on this ground, where it is known: measured or assumed."""
    for is_measured in (True, False):
        ends = [
            f"{name} {value.another_run.low:.3g} to {value.another_run.high:.3g}{suffix_unit(value.unit)}"
            for name, value in effect.parameters.items()
            if math.isfinite(value.another_run.low) and value.is_spread_measured == is_measured
        ]
        if ends:
            kind = "expected" if is_measured else "assumed"
            yield f"{kind} range between runs: {effect.id} {', '.join(ends)}"


def _format_encoders(run: RunDiagnosis) -> str:
    """How late the encoders are in the fit, beyond what was corrected against the gyro before."""
    late = run.timing.wheel_delay_s
    corrected = any(one.id == "wheels_delay" for one in run.findings)
    beyond = " beyond the delay corrected before the fit" if corrected else ""
    return f"estimated encoder delay {late * 1e3:.0f} ms{beyond}" if late else ""


def _format_budget(run: RunDiagnosis) -> str:
    """The error budget by cause: shares of the mean square slip on the leading input; empty without one."""
    for budget in run.budget if run.effects else ():
        if (budget.input, budget.quantity) == (run.input, "slip"):
            parts = [f"{name_term(one.effect)} {format_part(one.share)}" for _, one in budget.causes]
            signs = "; negative: the effect increases slip" if any("-" in part for part in parts) else ""
            total = f"{BUDGET_SLIP} {math.sqrt(budget.total):.3g} m/s"
            return f"error budget by cause ({total}): {', '.join(parts)}{signs}"
    return ""


def _list_shared(effect: Named) -> dict[str, Number]:
    """Its known values that all runs share."""
    return {name: value for name, value in effect.shown.items() if name not in effect.own}


def _format_values(effect: Named, shared: Mapping[str, Number]) -> str:
    return f"{name_scope(effect)}:" if effect.own and not shared else _format_all(shared)


def _format_all(numbers: Mapping[str, Number]) -> str:
    """Values by parameter, with their ranges between runs where these are much wider."""
    return ", ".join(f"{name} = {format_with_range(value)}" for name, value in numbers.items())


def _list_falls(run: RunDiagnosis) -> dict[str, str]:
    """Changes of the errors at the ladder step of each effect, and by how much one of them rises."""
    falls: dict[str, str] = {}
    for before, after in pairwise(run.ladder):
        rising = list_rises(before, after, CHANCE)
        falling = [
            text
            for key in ERRORS_OVER_2S
            if key not in rising
            and (text := format_fall(getattr(before, key), getattr(after, key), key)) is not None
        ]
        text = "; ".join(filter(None, [", ".join(filter(None, falling)), format_rises(before, after)]))
        for name in list_added(before, after):
            falls[name] = text or (_UNCHANGED if falling else "")
    return falls


def _format_unobservable(run: RunDiagnosis) -> list[str]:
    hidden = list(run.unobservable_why)
    if not hidden:
        return []
    shown = ", ".join(hidden[:_UNOBSERVABLE_SHOWN])
    others = f" and {len(hidden) - _UNOBSERVABLE_SHOWN} more" if len(hidden) > _UNOBSERVABLE_SHOWN else ""
    manoeuvres = dict.fromkeys(part for name in hidden for part in suggest_drive(name).split("; "))
    advice = "; ".join(list(manoeuvres)[:3])
    # Only a plan shows what a drive reaches within the limits of the site and the robot.
    needs = [kind.needs for kind in list_effects() if kind.id in hidden]
    if any(Excitation.SLOPE not in one for one in needs):
        advice += "; `slip plan` says whether its room and time are enough"
    return [
        f"not observable in this log: {shown}{others}",
        f"to observe {'it' if len(hidden) == 1 else 'them'}: {advice}",
    ]


def _format_detectable(run: RunDiagnosis) -> str:
    """Detection limits of effects that were not identified, the smallest first."""
    known = {kind.id: kind for kind in list_effects()}
    usual = {
        one.id: parameter
        for one in run.detectable
        for parameter in (known[one.id].parameters if one.id in known else ())
        if parameter.name == one.parameter
    }
    sharpest = sorted(
        (one for one in run.detectable if one.id in usual),
        key=lambda one: one.size / usual[one.id].usual_size,
    )
    shown = [
        f"{name_term(one.id)} {format_share(one.size)}"
        if one.unit == "1"
        else f"{name_term(one.id)} {one.size:.2g} {one.unit}"
        for one in sharpest[:_DETECTABLE_SHOWN]
    ]
    return f"detection limits ({DETECTED_SHARE} %): {', '.join(shown)}" if shown else ""


def list_findings(runs: Mapping[str, Sequence[Finding]], verdict: str, *, everything: bool) -> list[Row]:
    """The findings of runs, except those stated in the verdict: each once, the severe ones first.

    Args:
        runs: findings by the name of the run.
        verdict: on them.
        everything: also notes, and more than three.
    """
    by_kind: dict[tuple[Severity, str, str], dict[str, list[str]]] = {}
    for run, findings in runs.items():
        is_dead = has_dead_encoder(findings)
        for severity, one, said in _join_incidents(findings):
            text = f"perhaps by the dead encoder: {said}" if is_dead and one.id in _OF_ENCODERS else said
            if text.casefold() not in verdict.casefold():
                # Where one run is asked, two findings of a kind are two things.
                kind = (severity, one.id if len(runs) > 1 else text, one.where)
                by_kind.setdefault(kind, {}).setdefault(text, []).append(run)
    texts: list[str] = []
    notes = 0
    for (severity, *_), by_text in sorted(by_kind.items(), key=lambda one: _RANK.get(one[0][0], 2)):
        is_note = severity == "info"
        notes += is_note
        if everything or not is_note:
            texts.append(f"{mark_finding(severity)}{_format_of_runs(by_text, len(runs))}")
    if not everything and len(texts) > _FINDINGS_SHOWN:
        rest = len(texts) - _FINDINGS_SHOWN + notes
        texts = [*texts[:_FINDINGS_SHOWN], f"   {rest} more (--all)"]
    return _label("findings", texts)


def _format_of_runs(by_text: Mapping[str, Sequence[str]], asked: int) -> str:
    """A kind of finding: in how many runs, and its text in the first of those in which most say the same."""
    text = max(by_text, key=lambda one: len(by_text[one]))
    count = len({run for runs in by_text.values() for run in runs})
    first = by_text[text][0]
    if asked == 1:
        return text
    if count == 1:
        return f"{first}: {text}"
    return f"{count} runs{'' if len(by_text) == 1 else f', as in {first}'}: {text}"


def _join_incidents(findings: Sequence[Finding]) -> list[tuple[Severity, Finding, str]]:
    """Severity, first and text of every finding: incidents of one kind are one, and so are repeated ones."""
    incidents = group_by(
        (one.id, one)
        for one in findings
        if one.severity != "info" and one.t_start is not None and one.t_end is not None
    )
    timed = [(alike[0].severity, alike[0], _format_timed(alike)) for alike in incidents.values()]
    joined = {one for alike in incidents.values() for one in map(id, alike)}
    plain = group_by(((one.severity, key_finding(one)), one) for one in findings if id(one) not in joined)
    return timed + [
        (alike[0].severity, alike[0], format_finding(alike[0]) + times)
        for alike in plain.values()
        for times in [f" ({len(alike)} times)" if len(alike) > 1 else ""]
    ]


def _format_timed(alike: Sequence[Finding]) -> str:
    """Number of incidents of one kind, and the longest of them."""
    longest = max(alike, key=lambda one: (one.t_end or 0.0) - (one.t_start or 0.0))
    many = f"{len(alike)} incidents, the longest " if len(alike) > 1 else ""
    start = longest.t_start or 0.0
    # Some data begin before the first sample of all that the run needs, which is its zero.
    when = f"from {start:.1f}" if start > 0.0 else "from the start"
    return f"{many}{when} to {longest.t_end:.1f} s: {format_finding(longest)}"
