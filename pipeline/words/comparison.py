"""The answer of a comparison in sentences: which ground is harder, as driven and at equal driving."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass

import polars as pl

from pipeline.core import (
    INPUT_WORDS,
    align_rows,
    format_count,
    format_share,
    format_two,
    group_by,
    number_in,
    split_interval,
)
from pipeline.datasets import (
    ALIKE,
    DIFFERENT,
    EQUAL_DRIVING,
    NOT_VALID,
    OF_TWO_RUNS,
    QUANTITIES,
    UNTESTED,
    Answer,
    Causes,
    judge_pair,
)
from pipeline.datasets.causes import CausePart
from pipeline.datasets.levels import LEVEL
from pipeline.results import BUDGET_SLIP
from pipeline.words.tables import NOTHING, Cell, Column, Table

_GROUND = "ground alone"


@dataclass(frozen=True)
class AnswerRow:
    """One row of the answer of a comparison.

    Attributes:
        of: vehicles with the main input.
        driving: what is compared: `as driven`, `at equal driving`, `ground alone`, ...
        text: the hardest and the easiest dataset, and how many pairs differ.
        input, quantity: the view that it is of.
    """

    of: str
    driving: str
    text: str
    input: str
    quantity: str


def list_answer(answer: Answer) -> list[AnswerRow]:
    """The answer, by vehicles: on the main input as driven and at equal driving, then on the other one.

    What the measured wheels show beside the commands is what the ground does alone.
    """
    # Of the other input what is compared at equal driving says most, and comes first.
    views = sorted(
        answer.views, key=lambda view: (view[0] != answer.input) * (1 + (view[1] != EQUAL_DRIVING))
    )
    return [
        _answer(answer, family, datasets, view)
        for family, datasets in answer.families.items()
        for view in views
    ]


def _answer(answer: Answer, family: str, datasets: Sequence[str], view: tuple[str, str]) -> AnswerRow:
    source, quantity = view
    levels = answer.take(answer.levels, view).filter(pl.col("dataset").is_in(list(datasets)))
    pairs = answer.take(answer.comparisons, view).rows(named=True)
    own = [row for row in pairs if row["a"] in datasets and row["b"] in datasets]
    text = _describe(levels.sort("value", descending=True), own, equal=quantity == EQUAL_DRIVING)
    about = QUANTITIES[quantity]
    if source != answer.input:
        other = _GROUND if source == "measured" else INPUT_WORDS[source]
        about = other if quantity == EQUAL_DRIVING else f"{other}, {about}"
    return AnswerRow(f"{family}, {INPUT_WORDS[answer.input]}", about, text, source, quantity)


def tabulate_answer(answer: Answer) -> Table:
    """The answer as a table: vehicles, what is compared, and what came out."""
    rows = [[row.of, row.driving, row.text] for row in list_answer(answer)]
    return Table("Which is harder", (Column("slip of"), Column("compared"), Column("answer")), rows)


def tabulate_datasets(answer: Answer, source: str) -> Table:
    """Datasets on an input: levels with their intervals, and how much was driven.

    Args:
        answer: the comparison.
        source: `command` or `measured`.
    """
    quantities = [quantity for one, quantity in answer.views if one == source]
    frame = answer.datasets.filter(pl.col("input").cast(pl.String) == source)
    columns = [Column("dataset"), Column("runs", number=True)]
    for quantity in quantities:
        columns += [Column(QUANTITIES[quantity], "m/s", number=True), Column("95 %", number=True)]
    columns += [
        Column("interval", wide=True),
        Column("2 s window norm", "m/s", number=True, wide=True),
        Column("distance", "m", number=True, wide=True),
        Column("duration", "s", number=True, wide=True),
        Column("samples", number=True, wide=True),
    ]
    levels = {
        quantity: {
            str(row["dataset"]): row
            for row in answer.take(answer.levels, (source, quantity)).sort("value").iter_rows(named=True)
        }
        for quantity in quantities
    }
    # The easiest first; those without a level last.
    order = list(dict.fromkeys([*levels[quantities[0]], *frame["dataset"].sort()]))
    rows = []
    for row in sorted(frame.iter_rows(named=True), key=lambda row: order.index(row["dataset"])):
        own = [levels[quantity].get(row["dataset"], {}) for quantity in quantities]
        texts = [text for one in own for text in (_format_cell(one.get("value")), _format_ends(one))]
        driven = [_format_cell(row[name], 0) for name in ("distance", "duration", "samples")]
        norm = _format_cell(row["median_window_norm"])
        rows.append(
            [str(row["dataset"]), str(row["runs"]), *texts, own[0].get("interval", ""), norm, *driven]
        )
    caption = f"Datasets: {answer.measure} {INPUT_WORDS[source]}"
    return Table(caption, columns, rows).drop_empty()


def tabulate_pairs(answer: Answer, view: tuple[str, str]) -> Table:
    """Pairs of datasets of one view, those that differ most surely first."""
    source, quantity = view
    frame = answer.take(answer.comparisons, view).sort("p_adjusted", "a", "b", nulls_last=True)
    rows: list[list[str | Cell]] = [
        [
            Cell(f"{row['b']} / {row['a']}", strong=judge_pair(row) == DIFFERENT),
            format_ratio(row, str(row["b"])),
            _format_cell(row["p_adjusted"]),
            _format_within(row, "shift"),
            *(_format_cell(row[name]) for name in ("cliffs_delta", "p", "spread", "freedom", "overlap")),
            *(str(row[name] or "") for name in ("size", "method", "note")),
        ]
        for row in frame.iter_rows(named=True)
    ]
    numbers = ("Cliff's delta", "p", "spread of runs", "freedom", "overlap of driving")
    columns = (
        Column("times as much slip"),
        Column("ratio [95 %]", number=True),
        Column("p adjusted", number=True),
        Column("difference [95 %]", "m/s", number=True, wide=True),
        *(Column(title, number=True, wide=True) for title in numbers),
        *(Column(title, wide=True) for title in ("size", "method", "note")),
    )
    return Table(f"Pairs {QUANTITIES[quantity]}, {INPUT_WORDS[source]}", columns, rows).drop_empty()


def _describe(levels: pl.DataFrame, pairs: list[dict[str, object]], *, equal: bool) -> str:
    """The hardest and the easiest dataset, and how many pairs differ."""
    if levels.is_empty():
        return "no number, too little driving in common"
    (hard, largest), (easy, least) = (levels.select("dataset", "value").row(k) for k in (0, -1))
    if levels.height == 1:
        return f"{hard} {format_two(largest)} m/s"
    row = next((row for row in pairs if {row["a"], row["b"]} == {hard, easy}), None)
    ratio = format_ratio(row, hard) if row else ""
    if equal:
        said = f"{hard} {ratio} times {easy}" if ratio else f"{hard} and {easy} have no driving in common"
    else:
        said = f"{hard} ({format_two(largest)} m/s) hardest, {easy} ({format_two(least)}) easiest"
    return f"{said}; {_count(pairs)}"


def _count(pairs: list[dict[str, object]]) -> str:
    """How many pairs differ, and whether these runs could tell."""
    verdicts = [judge_pair(row) for row in pairs]
    if set(verdicts) <= {UNTESTED}:
        return "no pair can be tested"
    if OF_TWO_RUNS in verdicts and DIFFERENT not in verdicts:
        count = f"{verdicts.count(OF_TWO_RUNS)} of {format_count(len(verdicts), 'pair')} significant"
        return f"{count}, but as two single runs: more runs are needed to compare the grounds"
    text = f"{verdicts.count(DIFFERENT)} of {format_count(len(verdicts), 'pair')} significant"
    return text + ": these runs do not tell them apart" * (set(verdicts) <= {ALIKE, UNTESTED})


def format_ratio(row: Mapping[str, object], over: str) -> str:
    """Ratio of one dataset of a row of `comparisons` over the other, with its interval; empty without one."""
    ratio, low, high = (number_in(row, key) for key in ("ratio", "ratio_low", "ratio_high"))
    if ratio is None or ratio <= 0.0:
        return ""
    if over == row["a"]:
        ratio, low, high = 1.0 / ratio, 1.0 / high if high else None, 1.0 / low if low else None
    ends = "" if low is None or high is None else f" [{format_two(low)}, {format_two(high)}]"
    return f"{format_two(ratio)}{ends}"


def list_shown_notes(answer: Answer) -> list[str]:
    """The notes of an answer, less that on the plain test, which only the files have."""
    return [note for note in answer.notes if note != NOT_VALID]


def summarize_answer(answer: Answer) -> dict[str, object]:
    """The JSON object of `slip compare`."""
    return {
        "input": answer.input,
        "quantity": answer.views[0][1],
        "datasets": _list_rows(answer.datasets.filter(pl.col("input").cast(pl.String) == answer.input)),
        "pairs": _list_rows(answer.take(answer.comparisons, answer.views[0])),
        "views": [
            {
                "input": source,
                "quantity": quantity,
                "levels": _list_rows(answer.take(answer.levels, (source, quantity))),
                "pairs": _list_rows(answer.take(answer.comparisons, (source, quantity))),
            }
            for source, quantity in answer.views
        ],
        "answer": [asdict(row) for row in list_answer(answer)],
        "notes": list(answer.notes),
    }


def _list_rows(frame: pl.DataFrame) -> list[dict[str, object]]:
    plain = frame.with_columns(pl.col(pl.Enum).cast(pl.String))
    return (
        plain.drop("run", "vehicle", "terrain", "dataset").to_dicts()
        if "a" in frame.columns
        else plain.to_dicts()
    )


_MOST = 3
"""Differences and notes on the screen without `--all`."""
_MOST_PAIRS = 10
"""Pairs on the screen, as many as five datasets have; the page has all."""
_LEAST_SHARE = 0.01
"""Share of a budget from which on its cause is named on a screen; the page has all."""


def format_causes(causes: Causes, *, everything: bool) -> list[str]:
    """What the causes of slip contribute, and to the differences, on one screen.

    Args:
        causes: budgets of datasets side by side.
        everything: also small causes, and all differences and notes.
    """
    lines = [f"slip {INPUT_WORDS[causes.input]} by cause, shares of its mean square"]
    for budget in causes.budgets:
        shown = [one for one in budget.parts if everything or abs(one.value) >= _LEAST_SHARE]
        parts = [f"{causes.names.get(one.name, one.name)} {format_share(one.value, 0)}" for one in shown]
        rms, runs = format_two(budget.total**0.5), format_count(budget.runs, "run")
        lines += ["", f"{budget.dataset}: {BUDGET_SLIP} {rms} m/s, {runs}", f"  {', '.join(parts)}"]
    sentences = [one.describe(causes.names) for one in causes.differences]
    return [
        *lines,
        "",
        *_shorten(sentences, "difference", everything=everything),
        *_list_notes(causes.notes, everything),
    ]


def _shorten(lines: Sequence[str], what: str, *, everything: bool) -> list[str]:
    """The lines, or the first ones and how many more there are."""
    if everything or len(lines) <= _MOST:
        return list(lines)
    return [*lines[:_MOST], f"  {format_count(len(lines) - _MOST, f'more {what}')} (--all, page)"]


def _list_notes(notes: Sequence[str], everything: bool) -> list[str]:  # noqa: FBT001 - as the option
    lines = _shorten([f"! {note}" for note in notes], "note", everything=everything)
    return ["", *lines] if lines else []


def format_answer(answer: Answer, *, everything: bool) -> list[str]:
    """Which dataset is harder, on one screen.

    Args:
        answer: the comparison.
        everything: also the tables of datasets and pairs, and all notes.
    """
    lines: list[str] = []
    shown = [
        row
        for row in list_answer(answer)
        # Of the other input the ground alone at equal driving is what everybody reads.
        if everything or row.input == answer.input or (row.input, row.quantity) == ("measured", EQUAL_DRIVING)
    ]
    for of, rows in group_by((row.of, (row.driving, row.text)) for row in shown).items():
        lines += [*([""] * bool(lines)), f"slip of {of}", *(f"  {line}" for line in align_rows(rows))]
    for source in dict.fromkeys(one for one, _ in answer.views) if everything else ():
        datasets = tabulate_datasets(answer, source)
        lines += ["", datasets.caption, *datasets.align()]
    for view in answer.views if everything else ():
        pairs = tabulate_pairs(answer, view)
        lines += ["", pairs.caption, *pairs.align()[: 1 + _MOST_PAIRS]] * bool(pairs.rows)
        omitted = len(pairs.rows) - _MOST_PAIRS
        lines += [f"... and {omitted} more pairs on the page"] * (omitted > 0)
    others = [
        INPUT_WORDS[name] for name in dict.fromkeys(one for one, _ in answer.views) if name != answer.input
    ]
    rest = ", ".join([*others, "all datasets and pairs with intervals"])
    lines += [] if everything else ["", f"{rest}: --all, or the page"]
    return [*lines, *_list_notes(list_shown_notes(answer), everything)]


def _format_cell(value: object, places: int | None = None) -> str:
    if not isinstance(value, int | float):
        return NOTHING
    return f"{value:.3g}" if places is None else f"{value:,.{places}f}"


def _format_ends(row: Mapping[str, object]) -> str:
    """The ends of a value's interval."""
    value, low, high = (row.get(key) for key in ("value", "low", "high"))
    if not (isinstance(value, float) and isinstance(low, float) and isinstance(high, float)):
        return NOTHING
    return " to ".join(split_interval(value, low, high)[1:])


def _format_within(row: Mapping[str, object], name: str) -> str:
    """A value with its interval in brackets."""
    ends = _format_ends({**row, "value": row[name]})
    return _format_cell(row[name]) + (f" [{ends.replace(' to ', ', ')}]" if ends != NOTHING else "")


def tabulate_causes(causes: Causes) -> list[Table]:
    """The budgets by cause, and the differences of two of them."""

    def format_ends(part: CausePart, form: Callable[[float], str]) -> str:
        known = part.low is not None and part.high is not None
        return f"{form(part.low or 0.0)} to {form(part.high or 0.0)}" if known else NOTHING

    def format_part(value: float) -> str:
        return format_share(value, 1)

    budgets = [
        [
            one.dataset,
            causes.names.get(part.name, part.name),
            format_part(part.value),
            format_ends(part, format_part),
        ]
        for one in causes.budgets
        for part in one.parts
    ]
    differences: list[list[str | Cell]] = [
        [
            f"{one.b} \u2212 {one.a}",
            Cell(
                causes.names.get(part.name, part.name),
                strong=part.p_adjusted is not None and part.p_adjusted <= LEVEL,
            ),
            format_two(part.value),
            format_ends(part, format_two),
            _format_cell(part.p_adjusted),
        ]
        for one in causes.differences
        for part in one.parts
    ]
    head = (Column("dataset"), Column("cause"))
    shares = (*head, Column("share", number=True), Column("95 %", number=True))
    parts = (
        *head,
        Column("difference", "m/s", number=True),
        Column("95 %", number=True),
        Column("p adjusted", number=True),
    )
    caption = f"Differences of {BUDGET_SLIP} by cause; p over the causes of a pair"
    return [
        Table("Budgets: shares of the mean square slip, means over runs", shares, budgets).drop_empty(),
        Table(caption, parts, differences).drop_empty(),
    ]
