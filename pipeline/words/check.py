"""Text formats of a check: verdict, the table for a screen and as Markdown, and JUnit for a build server."""

import math
import re
from xml.etree import ElementTree as ET

from pipeline.core import (
    FEWEST_OF_SPREAD,
    STRETCH_S,
    enumerate_texts,
    format_angle,
    format_count,
    format_length,
    make_plain,
    split_interval,
    suffix_unit,
)
from pipeline.datasets import (
    COMMANDED_TURN,
    HEADING_ERROR,
    MULTIPLIER,
    POSITION_ERROR,
    CheckedNumber,
    RunsCheck,
)
from pipeline.words.tables import Cell, Column, Table

Line = tuple[str, str]
_MOST = 3
"""Numbers in a sentence; the table lists all."""
_HEAD = (
    Column("number"),
    Column("result", wide=True),
    Column("before -> after"),
    Column("difference [95 %]"),
    Column("p"),
    Column("spread of runs", wide=True),
)
_VALUES = (
    "values: of the effects of one model, fitted to each run; the diagnosis of a run chooses its own "
    "effects, with which a number may differ; remaining errors: over 2 s with that model, at equal speed"
)
_ABOUT = "p: over all numbers of this check, against how much runs differ beyond their own errors"
_ALONE = "intervals: of these recordings alone"
_SPREAD_UNKNOWN = "how much runs of this robot differ without a change is not known"
_OTHER_DRIVING = 1.25
"""Ratio of the speeds of both sides from which on it is said that they were driven differently."""
_FEW_STRETCHES = f"fewer than {FEWEST_OF_SPREAD} stretches of {STRETCH_S:g} s with a path of 2 s"
_NO_TURNS = "no turns by body commands"
_WHY_UNKNOWN = {
    POSITION_ERROR: _FEW_STRETCHES,
    HEADING_ERROR: _FEW_STRETCHES,
    COMMANDED_TURN: _NO_TURNS,
    MULTIPLIER: _NO_TURNS,
}
"""Reasons for which a number that every check has is unknown; of a parameter its runs do not determine it."""


def format_check(check: RunsCheck) -> str:
    """What changed, and whether it is more than runs differ, in one to three sentences."""
    return " ".join(f"{text[:1].upper()}{text[1:]}." for text in list_check_sentences(check))


def list_check_sentences(check: RunsCheck) -> list[str]:
    """The sentences of `format_check`, without capitals and periods."""
    unknown = f"{_SPREAD_UNKNOWN}: {_describe_missing_runs(check)}"
    changed, differs = check.list_status("changed"), check.list_status("differs")
    known = [one for one in check.numbers if one.is_known]
    sentences = _list_conditions(check)
    if check.is_single and known:
        pair = "a model and one run" if check.sides.is_model else "one run a side"
        apart = f"these recordings differ in {_list(differs)}, but " if differs else ""
        sentences += [f"Changed: {_list(changed)}"] if changed else []
        sentences.append(f"Cannot tell: {pair}")
        sentences.append(f"{apart}{unknown}")
    elif changed:
        sentences.append(f"Changed: {_list(changed)}")
    elif differs:
        sentences.append(f"No conclusion: the recordings differ in {_list(differs)}, but {unknown}")
    elif known:
        few = "" if check.is_compared else "; most parameters of the model cannot be compared"
        sentences.append(f"No change shown in {format_count(len(known), 'number')}{few}")
        coarse = [one.title for one in check.list_status("not shown") if one.is_coarse]
        sentences += [f"Too few runs to tell a change of {enumerate_texts(coarse)}"] if coarse else []
        near = [one for one in check.list_status("not shown") if not one.is_coarse]
        sentences += [f"Not shown beyond chance, but near: {_list(near)}"] if near else []
        sentences += [] if check.is_spread_known else [unknown]
    else:
        sentences.append("No conclusion: no number is known on both sides")
    outcomes = [one.outcome for one in check.limits]
    if check.limits:
        broken = enumerate_texts(
            [
                f"{one.name} {one.measured}, limit {one.limit}"
                for one in check.limits
                if one.outcome == "broken"
            ]
        )
        counts = f"{outcomes.count('kept')} of {len(outcomes)} limits kept"
        counts += f", {outcomes.count('undetermined')} cannot be judged" * ("undetermined" in outcomes)
        sentences.append(f"{counts}, broken: {broken}" if broken else counts)
    return sentences


def _list_conditions(check: RunsCheck) -> list[str]:
    """What differed between the sides beside the robot: a change may be due to it."""
    terrains = [" and ".join(one) for one in check.sides.terrains]
    paces = check.sides.paces
    sentences = []
    if all(terrains) and terrains[0] != terrains[1]:
        sentences.append(
            f"The terrains differ, {terrains[0]} before and {terrains[1]} after: a change may be the ground's"
        )
    if max(paces) > _OTHER_DRIVING * min(paces):
        sentences.append(
            f"The driving differed, {paces[0]:.2g} m/s before and {paces[1]:.2g} m/s after "
            "(root mean square, 1 rad/s as 1 m/s)"
        )
    return sentences


def _describe_missing_runs(check: RunsCheck) -> str:
    """How many more runs, and where, tell how much runs differ without a change."""
    sides, grounds = check.sides, sorted({*check.sides.terrains[0], *check.sides.terrains[1]})
    where = f" on {' or '.join(grounds)}" if grounds else ""
    side = "AFTER" if sides.is_model else "BEFORE or AFTER"
    needed = (
        f"{format_count(check.missing, 'more run')} {side}{where} {'tells' if check.missing == 1 else 'tell'}"
    )
    there = [f"{len(runs)} on {ground}" for ground, runs in sides.others.items()]
    available = f"the results have {enumerate_texts(there) or 'none'}"
    return needed + (f", or {FEWEST_OF_SPREAD} other runs on one terrain ({available})" if grounds else "")


def _list(numbers: list[CheckedNumber]) -> str:
    others = [f"{len(numbers) - _MOST} more"] if len(numbers) > _MOST else []
    return enumerate_texts([*map(describe_change, numbers[:_MOST]), *others])


def describe_change(number: CheckedNumber) -> str:
    """A change in words: what, from where to where, and its p over all numbers.

    A difference that nothing compares with how much runs differ has no p.
    """
    text = f"{number.title} {_format(number, number.before)} -> {_format(number, number.after)}"
    if number.status != "changed":
        return text
    p = _format_p(number)
    return f"{text} (p {p if p.startswith('<') else f'= {p}'})"


def _format_p(number: CheckedNumber) -> str:
    """P over all numbers; empty where no runs tell how much runs differ."""
    if not math.isfinite(number.p_adjusted):
        return ""
    return f"{number.p_adjusted:.1g}" if number.p_adjusted >= 1e-4 else "< 0.0001"  # noqa: PLR2004 - as many digits as are shown


def _format(number: CheckedNumber, value: float) -> str:
    if not math.isfinite(value):
        return "-"
    if number.is_ratio and number.unit != "1":
        return format_length(value) if number.unit == "m" else format_angle(value)
    return f"{value:.3g}{suffix_unit(number.unit)}"


def tabulate_check(check: RunsCheck) -> Table:
    """The table of a check: a row a number; differences of shares are in percent."""
    rows: list[list[str | Cell]] = []
    for one in check.numbers:
        scale, unit = (100.0, " %") if one.is_ratio else (1.0, suffix_unit(one.unit))
        difference, spread = _explain_unknown(one, is_model=check.sides.is_model), ""
        if one.is_known:
            value, low, high = split_interval(*(scale * part for part in (one.difference, one.low, one.high)))
            difference = f"{'' if value.startswith('-') else '+'}{value}{unit} [{low}, {high}]"
            spread = f"{scale * one.spread:.2g}{unit}" if math.isfinite(one.spread) else "not known"
        before, after = _format(one, one.before), _format(one, one.after)
        before = before.removesuffix(f" {after.partition(' ')[2]}")
        status = Cell(one.status, strong=one.status == "changed")
        rows.append([one.title, status, f"{before} -> {after}", difference, _format_p(one), spread])
    note = f"{_VALUES}; {_ABOUT if check.is_spread_known else _ALONE}"
    return Table("Numbers before and after", _HEAD, rows, note).drop_empty()


def _explain_unknown(number: CheckedNumber, *, is_model: bool) -> str:
    """Where and why a number is unknown; empty if it is known."""
    if is_model and number.name in _WHY_UNKNOWN and not math.isfinite(number.before):
        return "unknown before: a model file holds no drive"
    ends = (("before", number.before), ("after", number.after))
    sides = [name for name, value in ends if not math.isfinite(value)]
    why = _WHY_UNKNOWN.get(number.name, "the runs do not determine it")
    return f"unknown {' and '.join(sides)}: {why}" if sides else ""


def tabulate_limits(check: RunsCheck) -> Table:
    """The limits of a check, and whether they are kept."""
    rows: list[list[str | Cell]] = [
        [f"{one.name}: {one.limit}", one.measured, Cell(one.outcome, strong=one.outcome == "broken")]
        for one in check.limits
    ]
    return Table("Limits", (Column("limit"), Column("measured"), Column("outcome")), rows)


def list_sides(check: RunsCheck) -> dict[str, list[str]]:
    """Names of the runs of both sides, and of those that tell how much runs differ."""
    sides = check.sides
    others = [one for runs in sides.others.values() for one in runs]
    groups = {"before": sides.before, "after": sides.after, "others": others}
    return {label: [one.run for one in runs] for label, runs in groups.items() if runs}


def list_check_lines(check: RunsCheck) -> list[Line]:
    """The check as labels and texts: verdict, limits, the table, compared runs, notes."""
    lines = [("verdict", format_check(check))]
    lines += [(one.outcome, f"{one.name}: {one.measured} ({one.limit})") for one in check.limits]
    table = tabulate_check(check)
    labels = ["", *(one.status for one in check.numbers)]
    lines += zip(labels, table.align(), strict=False)
    lines += [("", table.note)] if table.note else []
    lines += [(label, f"{len(runs)}: {', '.join(runs)}") for label, runs in list_sides(check).items()]
    return lines + [("note", note) for note in check.sides.notes]


def format_markdown(check: RunsCheck) -> str:
    """The check as Markdown: verdict, limits, and the table of the screen."""
    tables = [one.to_markdown(_escape) for one in (tabulate_limits(check), tabulate_check(check)) if one.rows]
    notes = [f"> {_escape(note)}" for note in check.sides.notes]
    return "\n\n".join([f"**{_escape(format_check(check))}**", *tables, *notes]) + "\n"


def _escape(text: str) -> str:
    """Escape names of runs and terrains, which may contain Markdown or HTML markup."""
    escaped = re.sub(r"([\\`*_\[\]|])", r"\\\1", make_plain(text))
    return escaped.replace("<", "&lt;").replace(">", "&gt;")


def format_junit(check: RunsCheck) -> str:
    """The check as JUnit: one case per limit and number; changed or broken ones fail, open ones skip.

    If limits are given, changed numbers do not fail: the limits decide, as for the exit code.
    """
    kinds = {"broken": "failure", "undetermined": "skipped", "unknown": "skipped"}
    kinds |= {"differs": "skipped", "not shown": "skipped"}
    kinds |= {} if check.limits else {"changed": "failure"}
    cases: list[tuple[str, str, str, str]] = [
        ("limit", f"{one.name}: {one.limit}", one.outcome, f"{one.measured}, limit {one.limit}")
        for one in check.limits
    ]
    cases += [
        ("number", one.name, one.status, "  ".join(map(str, row)))
        for one, row in zip(check.numbers, tabulate_check(check).rows, strict=True)
    ]
    counts = {kind: sum(kinds.get(case[2]) == kind for case in cases) for kind in ("failure", "skipped")}
    suite = ET.Element(
        "testsuite",
        name="slip check",
        tests=str(len(cases)),
        failures=str(counts["failure"]),
        skipped=str(counts["skipped"]),
    )
    for group, name, outcome, text in cases:
        case = ET.SubElement(suite, "testcase", classname=f"slip.check.{group}", name=make_plain(name))
        if outcome in kinds:
            ET.SubElement(case, kinds[outcome], message=make_plain(text))
    ET.SubElement(suite, "system-out").text = make_plain(format_check(check))
    ET.indent(suite)
    return f'<?xml version="1.0" encoding="utf-8"?>\n{ET.tostring(suite, encoding="unicode")}\n'


def check_as_json(check: RunsCheck) -> dict[str, object]:
    """The JSON object of `slip check`."""
    sentences = [f"{describe_change(one)}." for one in check.list_status("changed")]
    return check.to_json(format_check(check), sentences)
