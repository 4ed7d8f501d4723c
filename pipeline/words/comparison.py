"""The answer of a comparison in sentences: which ground is harder, as driven and at equal driving."""

from collections.abc import Mapping, Sequence

import polars as pl

from pipeline.core import (
    INPUT_WORDS,
    align_rows,
    format_count,
    format_share,
    format_two,
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

_GROUND = "ground alone"


def list_answer(answer: Answer, *, main_only: bool = False) -> list[tuple[str, str, str]]:
    """The answer: vehicles with the input, what is compared, and a sentence; two lines each.

    Args:
        answer: the comparison.
        main_only: of the other input only what the ground alone does: measured wheels at equal driving.
    """
    lines = []
    for source, quantity in sorted(answer.views, key=lambda view: view[0] != answer.input):
        is_ground = main_only and source != answer.input
        if is_ground and (source, quantity) != ("measured", EQUAL_DRIVING):
            continue
        levels = answer.take(answer.levels, (source, quantity))
        pairs = answer.take(answer.comparisons, (source, quantity)).rows(named=True)
        for family, datasets in answer.families.items():
            own = levels.filter(pl.col("dataset").is_in(list(datasets))).sort("value", descending=True)
            rows = [row for row in pairs if row["a"] in datasets and row["b"] in datasets]
            text = _describe(own, rows, equal=quantity == EQUAL_DRIVING)
            title = f"{family}, {INPUT_WORDS[answer.input if is_ground else source]}"
            lines.append((title, _GROUND if is_ground else QUANTITIES[quantity], text))
    return sorted(lines, key=lambda line: [one for one, _, _ in lines].index(line[0]))


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
        "answer": [
            {"of": title, "driving": about, "text": text} for title, about, text in list_answer(answer)
        ],
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
        lines += ["", f"{budget.dataset}: root mean square {rms} m/s, {runs}", f"  {', '.join(parts)}"]
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
    title = ""
    for head, about, text in list_answer(answer, main_only=not everything):
        lines += ([""] * bool(lines) + [f"slip of {head}"]) * (head != title)
        title = head
        lines.append(f"  {about:<18}{text}")
    for view in answer.views if everything else ():
        about = f"{QUANTITIES[view[1]]}, {INPUT_WORDS[view[0]]}"
        levels = [
            (row["dataset"], _format_cell(row["value"]), _format_ends(row), row["interval"])
            for row in answer.take(answer.levels, view).sort("value").iter_rows(named=True)
        ]
        pairs = [
            (f"{row['b']} / {row['a']}", format_ratio(row, row["b"]), _format_cell(row["p_adjusted"]))
            for row in answer.take(answer.comparisons, view)
            .sort("p_adjusted", nulls_last=True)
            .iter_rows(named=True)
        ]
        lines += ["", *align_rows([(f"{answer.measure} {about}", "m/s", "95 % interval", ""), *levels])]
        lines += [
            "",
            *align_rows([("times as much slip", "ratio", "p adjusted"), *pairs[:_MOST_PAIRS]]),
        ] * bool(pairs)
        omitted = len(pairs) - _MOST_PAIRS
        lines += [f"... and {omitted} more pairs on the page"] * (omitted > 0)
    others = [
        INPUT_WORDS[name] for name in dict.fromkeys(one for one, _ in answer.views) if name != answer.input
    ]
    rest = ", ".join([*others, "all datasets and pairs with intervals"])
    lines += [] if everything else ["", f"{rest}: --all, or the page"]
    return [*lines, *_list_notes(list_shown_notes(answer), everything)]


def _format_cell(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, int | float) else "-"


def _format_ends(row: Mapping[str, object]) -> str:
    value, low, high = (row.get(key) for key in ("value", "low", "high"))
    if not (isinstance(value, float) and isinstance(low, float) and isinstance(high, float)):
        return "-"
    return " to ".join(split_interval(value, low, high)[1:])
