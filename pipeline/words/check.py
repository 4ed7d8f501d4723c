"""Text formats of a check: verdict, the table for a screen and as Markdown, and JUnit for a build server."""

import math
import re
from xml.etree import ElementTree as ET

from pipeline.core import (
    enumerate_texts,
    format_angle,
    format_count,
    format_length,
    make_plain,
    split_interval,
    suffix_unit,
)
from pipeline.datasets import CheckedNumber, RunsCheck
from pipeline.words.tables import Cell, Column, Table

Line = tuple[str, str]
_MOST = 3
"""Numbers in a sentence; the table lists all."""
_HEAD = (
    Column("number"),
    Column("result", wide=True),
    Column("before -> after"),
    Column("difference [95 %]"),
    Column("runs differ"),
)
_SPREAD_UNKNOWN = "how much runs of this robot differ without a change is not known"
_FEWEST = 3
"""Runs a side from which on they tell how much runs differ."""


def format_check(check: RunsCheck) -> str:
    """What changed, and whether it is more than runs differ, in one to three sentences."""
    return " ".join(f"{text[:1].upper()}{text[1:]}." for text in list_check_sentences(check))


def list_check_sentences(check: RunsCheck) -> list[str]:
    """The sentences of `format_check`, without capitals and periods."""
    is_few = min(len(check.sides.before), len(check.sides.after)) < _FEWEST
    unknown = f"{_SPREAD_UNKNOWN}{': three runs a side, or other runs, tell' * is_few}"
    changed, differs = check.list_status("changed"), check.list_status("differs")
    known = [one for one in check.numbers if one.is_known]
    sentences = list[str]()
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
        unclear = [one.title for one in check.list_status("unclear")]
        sentences += [f"Too few runs to tell a change of {enumerate_texts(unclear)}"] if unclear else []
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
    p = f"p = {number.p_adjusted:.1g}" if number.p_adjusted >= 1e-4 else "p < 0.0001"  # noqa: PLR2004 - as many digits as are shown
    return f"{text} ({p})"


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
        difference, spread = "", ""
        if one.is_known:
            value, low, high = split_interval(*(scale * part for part in (one.difference, one.low, one.high)))
            difference = f"{'' if value.startswith('-') else '+'}{value}{unit} [{low}, {high}]"
            size = f"{scale * one.spread:.2g}{unit}" if one.spread else "by errors"
            spread = size if math.isfinite(one.spread) else "not known"
        before, after = _format(one, one.before), _format(one, one.after)
        before = before.removesuffix(f" {after.partition(' ')[2]}")
        status = Cell(one.status, strong=one.status == "changed")
        rows.append([one.title, status, f"{before} -> {after}", difference, spread])
    note = "" if check.is_spread_known else "intervals: of these recordings alone"
    return Table("Numbers before and after", _HEAD, rows, note)


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


def describe_terrains(check: RunsCheck) -> str:
    """That both sides were driven on different terrains; empty if they were not."""
    before, after = (" and ".join(one) for one in check.sides.terrains)
    is_known = before and after and before != after
    return f"BEFORE was driven on {before}, AFTER on {after}" if is_known else ""


def list_check_lines(check: RunsCheck) -> list[Line]:
    """The check as labels and texts: verdict, limits, the table, compared runs, notes."""
    lines = [("verdict", format_check(check))]
    lines += [(one.outcome, f"{one.name}: {one.measured} ({one.limit})") for one in check.limits]
    table = tabulate_check(check)
    labels = ["", *(one.status for one in check.numbers)]
    lines += zip(labels, table.align(), strict=False)
    lines += [("", table.note)] if table.note else []
    lines += [(label, f"{len(runs)}: {', '.join(runs)}") for label, runs in list_sides(check).items()]
    lines += [("terrains", text)] if (text := describe_terrains(check)) else []
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
    kinds |= {"differs": "skipped", "unclear": "skipped"}
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
