"""Text formats of a check: verdict, lines for a screen, Markdown, and JUnit for a build server."""

import itertools
import math
import re
from collections.abc import Iterable, Sequence
from xml.etree import ElementTree as ET

from pipeline.core import (
    enumerate_texts,
    format_angle,
    format_length,
    format_share,
    group_by,
    make_plain,
    split_interval,
    suffix_unit,
)
from pipeline.datasets import (
    ERRORS,
    HEADING_ERROR,
    LOGARITHMS,
    MULTIPLIER,
    POSITION_ERROR,
    Change,
    Check,
    Label,
    find_pace,
)
from pipeline.models import Level, Place, name_number, name_term

Line = tuple[str, str]
_MOST_NAMED = 3
"""Largest number of quantities in a sentence; the lines list all."""
STATUSES = ("changed", "differs", "unchanged", "unknown")
_MOST_ROWS = 6
"""Rows of quantities of two single recordings, so that a screen of 24 lines holds the check."""
_INDENT = "    "
_NONE = 0.1
"""Largest effect of a simulation, as a fraction of the robot's, at which the simulation lacks the effect."""
LIKELY = 0.2
"""Largest p at which a change is called likely: at most one check in five of an unchanged robot says so."""
_LEAST_SHARE = 0.01
"""Smallest share of cases that is printed as a number."""
_LEAST_P = 1e-4
"""Smallest p value that is printed."""
_WITH_SPREAD = "AFTER - BEFORE [95 % interval, with the differences between runs]"
_WITHIN = "AFTER - BEFORE [95 % interval over all rows, of these recordings alone]"
"""What stands in the third column."""
_NAMES = {
    POSITION_ERROR: "position error over 2 s",
    HEADING_ERROR: "heading error over 2 s",
    MULTIPLIER: "the controller's multiplier",
}


def format_verdict(check: Check) -> str:
    """State the changes, and whether they exceed the spread between runs, in one to four sentences."""
    changed, differs = check.list_status("changed"), check.list_status("differs")
    named = [name for name in changed if name not in LOGARITHMS]
    sentences = _format_commanded(check)
    if named and check.simulated:
        sentences.append(f"{_format_simulated(check, named)}{_format_moves(check)}")
    elif named:
        listed = enumerate_texts([_format_change(check, name) for name in named[:_MOST_NAMED]])
        others = f" and {len(named) - _MOST_NAMED} more" if len(named) > _MOST_NAMED else ""
        sentences.append(f"Changed: {listed}{others}{_format_unchanged(check, named)}{_format_moves(check)}")
    rest = "and no effect of the model explains it: run slip diagnose on AFTER"
    sentences += [f"{_format_change(check, name)}, {rest}" for name in changed if name in ERRORS]
    if not changed and differs:
        sentences += _list_doubts(check, differs)
    elif not changed and _is_one_run(check) and len(check.changes) > len(check.list_status("unknown")):
        errors = "the errors of these two recordings" if check.sides.kind == "runs" else "its errors"
        sentences += [_format_one_run(check), f"No quantity differs by more than {errors}"]
    elif not changed:
        known = len(check.changes) - len(check.list_status("unknown"))
        nothing = "No conclusion: no quantity is known on both sides"
        few = "" if check.is_compared else "; most parameters of the model cannot be compared"
        noun = "quantity" if known == 1 else "quantities"
        sentences.append(f"No change shown in {known} {noun}{few}" if known else nothing)
    sentences += [*_format_limits(check), *_format_power(check)]
    return " ".join(f"{text[:1].upper()}{text[1:]}." for text in sentences)


def _format_commanded(check: Check) -> list[str]:
    """What the robot does of the commanded yaw rate, and the controller's multiplier, where that changed."""
    changed = check.list_status("changed")
    if MULTIPLIER not in changed and (check.commanded is None or not {*changed} - {*ERRORS}):
        return []
    clauses = _list_commanded(check)
    if MULTIPLIER in changed:
        p = _format_p(check.changes[MULTIPLIER].p, 1)
        clauses.append(f"the controller's multiplier {_format_pair(check, MULTIPLIER)} ({p})")
    return ["; ".join(clauses)] if clauses else []


def _list_commanded(check: Check) -> list[str]:
    """What the robot does of the commanded yaw rate, where it differs by more than the recordings' errors."""
    change = check.commanded
    if change is None or change.status not in {"changed", "differs"}:
        return []
    nearer = "better" if abs(change.after) < abs(change.before) else "worse"
    return [f"the robot turns at {_format_shares(change)} of the commanded rate: {nearer}"]


def _format_shares(change: Change) -> str:
    before, after = (format_share(math.exp(one)) for one in (change.before, change.after))
    return f"{before.removesuffix(' %')} -> {after}"


def _is_one_run(check: Check) -> bool:
    """Whether one recording is compared with one, or with a model, and nothing tells how much runs differ."""
    return not check.is_spread_known and len(check.sides.before) == len(check.sides.after) == 1


def _format_one_run(check: Check) -> str:
    what = "One run a side" if check.sides.kind == "runs" else f"One run beside a {check.sides.kind}"
    return f"{what}: differences between runs of this robot without a change are not known"


def _list_doubts(check: Check, differs: Sequence[str]) -> list[str]:
    """What differs between the recordings, and how often runs without a change differ by as much."""
    changes = [check.changes[name] for name in differs[:_MOST_NAMED]]
    least = min(change.p_alone for change in changes)
    often = format_share(max(least, _LEAST_SHARE), 1)
    rate = f"{'less than ' if least < _LEAST_SHARE else ''}{often}"
    likely = min(change.p for change in changes) <= LIKELY
    others = [f"{len(differs) - _MOST_NAMED} more"] if len(differs) > _MOST_NAMED else []
    chance = f"runs without a change differ by as much in {rate} of cases"
    if _is_one_run(check):
        texts = [f"{_name(check, name)} by {_format_difference(check, name)}" for name in differs]
        listed = enumerate_texts([*texts[:_MOST_NAMED], *others])
        guess = "A change is likely" if likely else "This may be chance"
        both = "These two differ" if check.sides.kind == "runs" else "It differs"
        usual = f"runs of other robots differ by as much without a change in {rate} of cases"
        return [_format_one_run(check), f"{both} in {listed}", f"{guess}: {usual}"]
    listed = enumerate_texts(
        [
            f"{_name(check, name)} {_format_pair(check, name)} ({_format_p(change.p_within, 1)})"
            for name, change in zip(differs[:_MOST_NAMED], changes, strict=True)
        ]
        + others
    )
    opening = "Likely changed" if likely else "No conclusion"
    return [f"{opening}: the recordings differ in {listed}; {chance}"]


def _format_simulated(check: Check, named: Sequence[str]) -> str:
    """List the effects that a simulation lacks, and those that differ in size."""
    lacks, other = [], []
    for name in named:
        label, change = _find(check, name), check.changes[name]
        neutral = label.parameter.neutral
        is_lacking = abs(change.before - neutral) <= _NONE * abs(change.after - neutral)
        if is_lacking and label.parameter.unit != "1":
            lacks.append(f"{_name(check, name)} of {change.after:.3g} {label.parameter.unit}")
        else:
            unit = suffix_unit(label.parameter.unit)
            other.append(
                f"{_name(check, name)} is {change.before:.3g}{unit}, the robot's {change.after:.3g}{unit}"
            )
    clauses = [f"The simulation lacks {enumerate_texts(lacks)}"] if lacks else []
    if other:
        clauses.append(f"{'its' if lacks else 'the simulation: its'} {'; its '.join(other)}")
    return "; ".join(clauses)


def _format_change(check: Check, name: str) -> str:
    return f"{_name(check, name)} {_format_pair(check, name)} ({_format_p(check.changes[name].p, 1)})"


def _format_pair(check: Check, name: str) -> str:
    change = check.changes[name]
    if name in ERRORS:
        pace = find_pace(check.sides)
        show = format_length if name == POSITION_ERROR else format_angle
        before, after = (show(pace * math.exp(one)) for one in (change.before, change.after))
        return f"{before} -> {after}"
    if name == MULTIPLIER:
        return f"{math.exp(change.before):.3g} -> {math.exp(change.after):.3g}"
    label = _find(check, name)
    unit = suffix_unit(label.parameter.unit)
    return f"{change.before:.3g} -> {change.after:.3g}{unit}"


def _format_difference(check: Check, name: str) -> str:
    """After minus before with its interval and unit; of a logarithm the growth in percent."""
    parts = check.find_difference(name)
    if not all(map(math.isfinite, parts)):
        return "-"
    if name in LOGARITHMS:
        low, value, high = (100.0 * math.expm1(one) for one in (parts[1], parts[0], parts[2]))
        value_text, *ends = split_interval(value, low, high)
        unit = " %"
    else:
        value_text, *ends = split_interval(*parts)
        unit = suffix_unit(_find(check, name).parameter.unit)
    sign = "" if value_text.startswith("-") else "+"
    return f"{sign}{value_text}{unit} [{', '.join(ends)}]"


def _find(check: Check, name: str) -> Label:
    return next(label for label in check.sides.labels if label.name == name)


def _name(check: Check, name: str) -> str:
    if name in LOGARITHMS:
        return _NAMES[name]
    label = _find(check, name)
    return name_number(label.effect.id, label.parameter.name)


def _format_unchanged(check: Check, changed: Sequence[str]) -> str:
    """`, ground unchanged` if none of its parameters changed and at least one is known."""
    is_ground = {label.name: label.effect.place > Place.DRIVE for label in check.sides.labels}
    known = {name for name in check.list_status("unchanged") if not check.is_unseen(name)} & set(is_ground)
    for ground, word in ((True, "ground"), (False, "drivetrain")):
        mine = {name for name, which in is_ground.items() if which is ground}
        if mine & known and not mine & {*changed, *check.list_status("differs")}:
            return f", {word} unchanged"
    return ""


def _format_moves(check: Check) -> str:
    if check.moves is None:
        return ""
    return (
        f"; predictions over 2 s change by {format_length(check.moves[0])} and {format_angle(check.moves[1])}"
    )


def _format_limits(check: Check) -> list[str]:
    if not check.limits:
        return []
    broken = [one for one in check.limits if one.outcome == "broken"]
    open_ones = [one for one in check.limits if one.outcome == "undetermined"]
    if broken:
        text = enumerate_texts(
            [f"{one.name} {one.measured}, limit {one.limit}" for one in broken[:_MOST_NAMED]]
        )
        return [f"{len(broken)} of {len(check.limits)} limits broken: {text}"]
    if open_ones:
        return [f"{len(open_ones)} of {len(check.limits)} limits cannot be judged from these runs"]
    return [f"All {len(check.limits)} limits kept"]


def _format_power(check: Check) -> list[str]:
    """Smallest detectable changes of the best known parameters, and the number of additional runs needed."""
    asked = [
        name
        for name, change in check.changes.items()
        if change.status in {"unchanged", "differs"} and name not in LOGARITHMS
    ]
    if not asked or check.list_status("changed"):
        return []
    if _is_one_run(check):
        missing = check.changes[(check.list_status("differs") or asked)[0]].count_missing()
        needed = "a few more runs" if missing is None else f"{missing} more run{'s' * (missing != 1)}"
        side = " a side" if check.sides.kind == "runs" else ""
        return [
            f"{needed}{side} would {'decide' if check.list_status('differs') else 'show smaller changes'}"
        ]
    asked.sort(key=lambda name: _share(check, name))
    text = enumerate_texts([_format_smallest(check, name) for name in asked[:_MOST_NAMED]])
    count = len(check.sides.after) + (len(check.sides.before) if check.sides.kind != "model" else 0)
    default = any(check.changes[name].is_default for name in asked)
    others = f" and {check.count_others()} others of the vehicle" if check.count_others() else ""
    spread = " at the default spread between runs" if default and not check.simulated else ""
    runs = "this run" if count == 1 else f"these {count} runs"
    first = f"A change of less than {text} is not detectable with {runs}{others}{spread}"
    differs = check.list_status("differs")
    missing = check.changes[(differs or asked)[0]].count_missing()
    if missing is None:
        return [first]
    needed = "run per side is needed" if missing == 1 else "runs per side are needed"
    return [first, f"{missing} more {needed} {'to decide' if differs else 'to detect half of that'}"]


def _share(check: Check, name: str) -> float:
    """Smallest detectable change, divided by the parameter's usual size."""
    return check.changes[name].smallest / max(_find(check, name).parameter.usual_size, 1e-12)


def _format_smallest(check: Check, name: str) -> str:
    change, label = check.changes[name], _find(check, name)
    size = abs(change.before)
    if label.parameter.unit == "1" and size > 0.0:
        return f"{format_share(change.smallest / size)} of {_name(check, name)}"
    unit = suffix_unit(label.parameter.unit)
    return f"{change.smallest:.2g}{unit} of {_name(check, name)}"


def list_lines(check: Check, *, everything: bool = True) -> list[Line]:
    """The check as labels and texts: verdict, limits, quantities, compared runs.

    Args:
        check: the check.
        everything: a row with its id and resolution for every quantity; else what did not change is a list
            of names, but for the first ones where one run is compared with one.
    """
    lines = [("verdict", format_verdict(check))]
    lines += [(one.outcome, f"{one.name}: {one.measured} ({one.limit})") for one in check.limits]
    ranked = [name for status in STATUSES for name in check.list_status(status)]
    known = _list_known(check)
    different = [*check.list_status("changed"), *check.list_status("differs")]
    # Of two recordings the differences are the answer, as many as a screen holds.
    listed = [name for name in ranked if name in known][:_MOST_ROWS] if _is_one_run(check) else []
    shown = ranked if everything else [name for name in ranked if name in {*different, *listed}]
    texts = [_list_columns(check, name) for name in shown]
    # The reason why a quantity is unknown is longer than what stands in its column.
    columns = [row if name in known else row[:1] for name, row in zip(shown, texts, strict=True)]
    widths = [max(map(len, column)) for column in itertools.zip_longest(*columns, fillvalue="")]
    for name, row in zip(shown, texts, strict=True):
        pairs = itertools.zip_longest(row, widths, fillvalue="")
        text = "  ".join(f"{cell:<{width}}" for cell, width in pairs).rstrip()
        lines.append((_name_outcome(check, name), text))
        if everything and name in known:
            lines += [("", f"{_INDENT}{detail}") for detail in _list_details(check, name)]
    if any(name in known for name in shown):
        by_spread = check.is_spread_known and not check.simulated
        lines.append(("", _WITH_SPREAD if by_spread else _WITHIN))
    if not everything:
        lines += _list_names(check, [name for name in ranked if name not in shown])
    if check.commanded is not None:
        share = f"the robot turns at {_format_shares(check.commanded)} of the commanded yaw rate"
        lines.append(("commanded", share))
    lines += [("may be", text) for text in _list_readings(check)]
    lines += [(side, f"{len(runs)}: {', '.join(runs)}") for side, runs in _list_runs(check)]
    others = [one.numbers.run for group in check.sides.others.values() for one in group]
    if others:
        lines.append(("others", f"{len(others)}: {', '.join(others)}"))
    if all(check.sides.terrains) and check.sides.terrains[0] != check.sides.terrains[1]:
        before, after = (" and ".join(one) for one in check.sides.terrains)
        lines.append(("terrains", f"BEFORE was driven on {before}, AFTER on {after}"))
    return lines + [("note", note) for note in check.sides.notes]


def _name_outcome(check: Check, name: str) -> str:
    """The outcome of a quantity; of two recordings nobody can say that nothing changed."""
    is_unchanged = check.changes[name].status == "unchanged"
    return "unclear" if is_unchanged and _is_one_run(check) else check.name_outcome(name)


def _list_names(check: Check, names: Sequence[str]) -> list[Line]:
    """Names of the quantities of which no change is shown, a line for each outcome."""
    groups = group_by((_name_outcome(check, name), name) for name in names)
    outcomes: dict[str, set[str]] = {}
    for name in check.changes:
        outcomes.setdefault(name.partition(".")[0], set()).add(
            _name_outcome(check, name) if name in names else ""
        )
    lines = []
    for outcome, alike in groups.items():
        # An effect of several parameters is one name where all of them share an outcome.
        texts = [
            name_term(_find(check, name).effect.id)
            if name not in LOGARITHMS and len(outcomes[name.partition(".")[0]]) == 1
            else _name(check, name)
            for name in alike
        ]
        few = "; too few runs to tell" if outcome == "unclear" and not _is_one_run(check) else ""
        lines.append((outcome, enumerate_texts(list(dict.fromkeys(texts))) + few))
    return [*lines, ("", "all numbers, and the changes that could be detected: --all")] if lines else []


def _list_known(check: Check) -> list[str]:
    return [name for name, change in check.changes.items() if change.status != "unknown"]


def _list_columns(check: Check, name: str) -> list[str]:
    """A quantity as columns: its name, before and after, and the difference."""
    change = check.changes[name]
    if change.status == "unknown":
        sides = (("BEFORE", change.before), ("AFTER", change.after))
        lacking = " and ".join(side for side, value in sides if math.isnan(value))
        stated = check.sides.kind != "model" or name not in ERRORS
        why = "not determined in" if stated else "not stated by the model"
        return [_name(check, name), f"{why} {lacking}"]
    return [_name(check, name), _format_pair(check, name), _format_difference(check, name)]


def _list_details(check: Check, name: str) -> list[str]:
    """How sure a change of a quantity is, with its id, and which change would have been detected."""
    change = check.changes[name]
    within = f" ({_format_p(change.p_within)} within the recordings)" if change.status == "differs" else ""
    first = f"{name}  {_format_p(change.p)}{within}"

    def show(size: float) -> str:
        return f"a factor of {math.exp(size):.2g}" if name in LOGARITHMS else f"{size:.2g}"

    text = f"detectable change {show(change.smallest)}"
    text += "; errors scaled to the speed of AFTER" if name in ERRORS else ""
    if not check.simulated:
        count = check.count_others()
        source = "default" if change.is_default else f"with {count} others" if count else "these runs"
        text += f"; spread between runs {show(change.spread)} ({source})"
    size = "a factor of two" if name in LOGARITHMS else "a change of its own size"
    return [first, text, *([f"too few runs to detect {size}"] if check.is_unseen(name) else [])]


def _format_p(p: float, digits: int = 2) -> str:
    """`p = 0.012`; below 0.0001 only that, as the tails of the test are not known better."""
    return f"p = {p:.{digits}g}" if p >= _LEAST_P else f"p < {_LEAST_P:g}"


def _list_readings(check: Check) -> list[str]:
    """Level of a changed effect: on one terrain that of the run, else that of the terrain."""
    before, after = check.sides.terrains
    level = Level.RUN if before == after else Level.TERRAIN
    names = dict.fromkeys(
        name.partition(".")[0] for name in check.list_status("changed") if name not in LOGARITHMS
    )
    effects = {label.effect.id: label.effect for label in check.sides.labels}
    return [
        f"{name_term(name)}: {reading.text}"
        for name in names
        for reading in effects[name].readings
        if reading.level is level
    ]


def _list_runs(check: Check) -> Iterable[tuple[str, list[str]]]:
    for side, readings in (("before", check.sides.before), ("after", check.sides.after)):
        yield side, [one.numbers.run for one in readings]


def format_markdown(check: Check) -> str:
    """The check as Markdown: verdict, tables of limits and quantities."""
    rows = [f"**{_escape(format_verdict(check))}**", ""]
    if check.limits:
        rows += ["| limit | measured | outcome |", "|---|---|---|"]
        rows += [
            f"| {_escape(one.name)}: {one.limit} | {one.measured} | {one.outcome} |" for one in check.limits
        ]
        rows.append("")
    rows += ["| quantity | outcome | difference | before -> after | p |", "|---|---|---|---|---|"]
    for status in STATUSES:
        for name in check.list_status(status):
            change = check.changes[name]
            known = status != "unknown"
            pair, p = (_format_pair(check, name), f"{change.p:.2g}") if known else ("-", "-")
            outcome, difference = _name_outcome(check, name), _format_difference(check, name)
            columns = [_name(check, name), outcome, difference, pair, p]
            rows.append(f"| {' | '.join(map(_escape, columns))} |")
    rows += ["", *(f"{side}: {_escape(', '.join(runs))}  " for side, runs in _list_runs(check))]
    return "\n".join([*rows, *(f"\n> {_escape(note)}" for note in check.sides.notes)]) + "\n"


def _escape(text: str) -> str:
    """Escape names of runs and terrains, which may contain Markdown or HTML markup."""
    escaped = re.sub(r"([\\`*_\[\]|])", r"\\\1", make_plain(text))
    return escaped.replace("<", "&lt;").replace(">", "&gt;")


def format_junit(check: Check) -> str:
    """The check as JUnit: one case per limit and quantity; changed or broken ones fail, open ones skip.

    If limits are given, changed quantities do not fail: the limits decide, as for the exit code.
    """
    cases: list[tuple[str, str, str, str]] = []
    for one in check.limits:
        kind = {"broken": "failure", "undetermined": "skipped"}.get(one.outcome, "")
        cases.append(("limit", f"{one.name}: {one.limit}", kind, f"{one.measured}, limit {one.limit}"))
    gate = not check.limits
    for name, change in check.changes.items():
        kind = {"changed": "failure" if gate else "", "unchanged": ""}.get(change.status, "skipped")
        kind = "skipped" if check.is_unseen(name) else kind
        text = "  ".join(_list_columns(check, name))
        text += "" if change.status == "unknown" else f"; {'; '.join(_list_details(check, name))}"
        cases.append(("number", name, kind, text))
    counts = [sum(case[2] == kind for case in cases) for kind in ("failure", "skipped")]
    suite = ET.Element(
        "testsuite", name="slip check", tests=str(len(cases)), failures=str(counts[0]), skipped=str(counts[1])
    )
    for group, name, kind, text in cases:
        case = ET.SubElement(suite, "testcase", classname=f"slip.check.{group}", name=make_plain(name))
        if kind:
            ET.SubElement(case, kind, message=make_plain(text))
    ET.SubElement(suite, "system-out").text = make_plain(format_verdict(check))
    ET.indent(suite)
    return f'<?xml version="1.0" encoding="utf-8"?>\n{ET.tostring(suite, encoding="unicode")}\n'
