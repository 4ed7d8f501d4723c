"""The answer of a comparison in sentences: which ground is harder, as driven and at equal driving."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import polars as pl

from pipeline.core import (
    INPUT_WORDS,
    enumerate_texts,
    format_count,
    format_share,
    format_two,
    number_in,
)
from pipeline.datasets import (
    ALIKE,
    AS_PUBLISHED,
    DIFFERENT,
    NO_SPREAD,
    NOT_VALID,
    OF_TWO_RUNS,
    SPEED_EDGES,
    UNTESTED,
    Answer,
    View,
    compare_orders,
    foresee_pairs,
    judge_pair,
)

_AS_HARD = 0.1
"""Datasets whose slip is within a tenth of the largest are named together with it."""
_LITTLE = 1.05
"""Factor below which driving or ground contributes nothing: it would be shown as 1.0."""


Ratios = tuple[float, float | None, float | None]
"""A ratio and the ends of its interval, which may not be known."""


@dataclass(frozen=True)
class Line:
    """A line of the answer.

    Attributes:
        family: vehicles that it is about.
        input: input u.
        driving: `as driven`, `at equal driving`, `the ground alone`, `as published`, `the difference`, or
            `to know more`.
        text: the sentence, without these.
    """

    family: str
    input: str
    driving: str
    text: str


def list_lines(answer: Answer) -> list[Line]:
    """The answer, at most five lines for each vehicle and input."""
    lines = []
    for family, datasets in answer.families.items():
        labels = shorten_names(family, datasets)
        for name in answer.inputs:
            driven = _take(answer.find_view(name, equal=False), datasets)
            equal = _take(answer.find_view(name, equal=True), datasets)
            if driven is None:
                continue
            published = answer.quantity == AS_PUBLISHED
            word = "as published" if published else "as driven"
            lines.append(Line(family, name, word, _describe_driven(driven, labels)))
            extremes = _find_extremes(driven)
            if published or extremes is None:
                continue
            if equal is None:
                lines.append(
                    Line(family, name, "at equal driving", "no number, too little driving in common")
                )
                continue
            lines.append(Line(family, name, "at equal driving", _describe_equal(equal, labels)))
            alone = _take(answer.find_view("measured", equal=True), datasets)
            if name == answer.input != "measured" and alone is not None and _find_extremes(alone):
                text = f"{_describe_equal(alone, labels)} (from wheel encoders)"
                lines.append(Line(family, name, "the ground alone", text))
            if text := _split_difference(driven, equal, extremes, labels):
                carrier = answer.carriers.get((name, frozenset(extremes)), "")
                text += f"; as driven it is carried by {carrier}" * bool(carrier)
                lines.append(Line(family, name, "the difference", text))
            undriven = _find_undriven(answer, name, [one for one, _ in equal.levels], labels)
            if advice := _advise_runs(equal, undriven):
                lines.append(Line(family, name, "to know more", advice))
    return lines


def shorten_names(family: str, datasets: Collection[str]) -> dict[str, str]:
    """Names of the datasets of a vehicle without its name, where all begin with it."""
    start = f"{family}_"
    common = all(name.startswith(start) and name != start for name in datasets)
    return {name: name.removeprefix(start) if common else name for name in datasets}


@dataclass(frozen=True)
class _Part:
    """A view of the datasets of one family: their levels from the largest, and their pairs."""

    levels: list[tuple[str, float]]
    pairs: dict[frozenset[str], Mapping[str, object]]

    def divide(self, a: str, b: str) -> tuple[Ratios, Mapping[str, object]] | None:
        """Ratio of b over a with its interval, and the row of the pair; None without a number."""
        row = self.pairs.get(frozenset((a, b)))
        ratio = orient_ratio(row, b) if row else None
        return (ratio, row) if row and ratio else None

    @property
    def has_difference(self) -> bool:
        """Whether any pair differs, or none can be tested."""
        verdicts = {judge_pair(row) for row in self.pairs.values()} - {UNTESTED}
        return not verdicts or bool(verdicts - {ALIKE})

    def count(self) -> str:
        """How many pairs are significant."""
        verdicts = [judge_pair(row) for row in self.pairs.values()]
        decided = [verdict for verdict in verdicts if verdict != UNTESTED]
        if not decided:
            return "no pair can be tested"
        is_one = len(verdicts) == 1
        if OF_TWO_RUNS in decided and DIFFERENT not in decided:
            which = "they" if is_one else f"{decided.count(OF_TWO_RUNS)} of {len(verdicts)} pairs"
            return f"{which} differ, but as two single runs: more runs are needed to compare the grounds"
        if is_one:
            return f"{'a' if DIFFERENT in decided else 'no'} significant difference"
        return f"{decided.count(DIFFERENT) or 'none'} of {len(verdicts)} pairs significant"


def orient_ratio(row: Mapping[str, object], over: str) -> Ratios | None:
    """Ratio of one dataset of a row of `comparisons` over the other, with its interval; None without one.

    Args:
        row: the row.
        over: the dataset in the numerator.
    """
    ratio, low, high = (number_in(row, key) for key in ("ratio", "ratio_low", "ratio_high"))
    if ratio is None or ratio <= 0.0:
        return None
    if over == row["b"]:
        return ratio, low, high
    return 1.0 / ratio, 1.0 / high if high else None, 1.0 / low if low else None


def format_ratio(ratio: Ratios | None) -> str:
    """A ratio with its interval in brackets, two significant digits; empty without one."""
    if ratio is None:
        return ""
    value, low, high = ratio
    ends = "" if low is None or high is None else f" [{format_two(low)}, {format_two(high)}]"
    return f"{format_two(value)}{ends}"


@dataclass(frozen=True)
class PairLine:
    """A pair of datasets in one line; what is not known is empty.

    Attributes:
        hard, easy: the datasets, that with more slip as driven first.
        driven: ratio of their slip as driven, with its interval.
        is_driven_sure: whether it is significant.
        equal: the same at equal driving.
        is_equal_sure: whether that is significant.
        driving: what of the ratio as driven is the driving, a factor.
        common: driving in common.
        carrier: the cause that carries the difference as driven.
        p_driven, p_equal: p over all pairs.
    """

    hard: str
    easy: str
    driven: str
    is_driven_sure: bool
    equal: str
    is_equal_sure: bool
    driving: str
    common: str
    carrier: str
    p_driven: float | None
    p_equal: float | None


def list_pairs(answer: Answer, input_name: str) -> list[PairLine]:
    """All tested pairs on an input, the surest at equal driving first, then the surest as driven."""
    driven, equal = (answer.find_view(input_name, equal=one) for one in (False, True))
    if driven is None:
        return []
    others = {(row["a"], row["b"]): row for row in equal.comparisons.iter_rows(named=True)} if equal else {}
    labels = {
        name: label
        for family, datasets in answer.families.items()
        for name, label in shorten_names(family, datasets).items()
    }
    if len(answer.families) > 1:
        labels = {name: name for name in labels}
    lines = []
    for row in driven.comparisons.iter_rows(named=True):
        other = others.get((row["a"], row["b"]), {})
        shift = number_in(row, "shift") or 0.0
        whole = number_in(row, "ratio")
        hard, easy = ("b", "a") if (shift if whole is None else whole - 1.0) >= 0.0 else ("a", "b")
        ratios = [orient_ratio(one, row[hard]) if one else None for one in (row, other)]
        parts = [ratio[0] for ratio in ratios if ratio]
        share, bins = number_in(other, "overlap"), number_in(other, "bins")
        lines.append(
            PairLine(
                hard=labels[row[hard]],
                easy=labels[row[easy]],
                driven=format_ratio(ratios[0]),
                is_driven_sure=judge_pair(row) == DIFFERENT,
                equal=format_ratio(ratios[1]) or "no number" * bool(other),
                is_equal_sure=bool(other) and judge_pair(other) == DIFFERENT,
                driving=format_two(parts[0] / parts[1]) if len(parts) > 1 else "",
                common="" if share is None or bins is None else _format_overlap(share, int(bins)),
                carrier=answer.carriers.get((input_name, frozenset((row["a"], row["b"]))), ""),
                p_driven=number_in(row, "p_adjusted"),
                p_equal=number_in(other, "p_adjusted"),
            )
        )
    return sorted(
        lines,
        key=lambda one: (
            *(math.inf if p is None else p for p in (one.p_equal, one.p_driven)),
            one.hard,
            one.easy,
        ),
    )


def _format_overlap(share: float, bins: int) -> str:
    return f"{format_share(share)}, {format_count(bins, 'cell')}" if bins else "none"


def _take(view: View | None, datasets: Sequence[str]) -> _Part | None:
    if view is None:
        return None
    own = pl.col("dataset").is_in(list(datasets))
    levels = view.levels.filter(own, pl.col("value").is_not_null()).sort("value", descending=True)
    rows = view.comparisons.filter(pl.col("a").is_in(list(datasets)), pl.col("b").is_in(list(datasets)))
    pairs: dict[frozenset[str], Mapping[str, object]] = {
        frozenset((row["a"], row["b"])): row for row in rows.iter_rows(named=True)
    }
    return _Part(list(levels.select("dataset", "value").iter_rows()), pairs) if levels.height else None


def _find_extremes(part: _Part) -> tuple[str, str] | None:
    """The easiest and the hardest dataset; None of a single one."""
    return (part.levels[-1][0], part.levels[0][0]) if len(part.levels) > 1 else None


def _describe_driven(part: _Part, labels: Mapping[str, str]) -> str:
    (first, largest), *others = part.levels
    if not others:
        return f"{labels[first]} {format_two(largest)} m/s"
    easy, smallest = part.levels[-1]
    if not part.has_difference:
        ends = f"from {labels[easy]} ({format_two(smallest)}) to {labels[first]} ({format_two(largest)} m/s)"
        return f"{ends}; {part.count()}"
    hard = [first, *(name for name, value in others[:-1] if value >= (1.0 - _AS_HARD) * largest)]
    values = dict(part.levels)
    numbers = [f"{labels[name]} ({format_two(values[name])}{' m/s' * (name == first)})" for name in hard]
    easiest = f"{labels[easy]} ({format_two(smallest)}) easiest"
    return f"{enumerate_texts(numbers)} hardest, {easiest}; {part.count()}"


def _describe_equal(part: _Part, labels: Mapping[str, str]) -> str:
    extremes = _find_extremes(part)
    if extremes is None:
        return "no driving in common with another dataset, no number"
    easiest, hardest = extremes
    quotient = part.divide(easiest, hardest)
    if quotient is None:
        return f"{labels[hardest]} and {labels[easiest]} have no driving in common; {part.count()}"
    ratio, row = quotient
    said = f"{labels[hardest]} {format_ratio(ratio)} times {labels[easiest]}"
    if not part.has_difference:
        return f"{said}; {part.count()}: these runs do not tell them apart"
    sure = ", not significant" if judge_pair(row) == ALIKE else ""
    return f"{said}{sure}; {part.count()}"


def _split_difference(
    driven: _Part, equal: _Part, extremes: tuple[str, str], labels: Mapping[str, str]
) -> str:
    """What of the largest ratio as driven is driving, and what is ground."""
    easiest, hardest = extremes
    whole, ground = driven.divide(easiest, hardest), equal.divide(easiest, hardest)
    a, b = labels[easiest], labels[hardest]
    # Of a difference that may be chance, no part is anything's.
    if whole is None or judge_pair(whole[1]) == ALIKE:
        return ""
    if ground is None:
        return f"{b} and {a} have no driving in common, so the two cannot be separated"
    (whole_factor, *_), (ground_factor, *_) = whole[0], ground[0]
    driving = whole_factor / ground_factor
    common = f"{format_share(number_in(ground[1], 'overlap') or 0.0)} of the driving in common"
    start = f"{b} is {format_two(whole_factor)} times {a} as driven"
    if driving <= _LITTLE:
        return f"{start}, and the driving does not explain it ({common})"
    if ground_factor <= _LITTLE:
        return f"{start}, and all of it is the driving ({common})"
    sure = ", not significant" if judge_pair(ground[1]) == ALIKE else ""
    return (
        f"{start}: a factor {format_two(driving)} is the driving, {format_two(ground_factor)} remains at "
        f"equal driving{sure} ({common})"
    )


_REPEATED = frozenset({"dataset", "vehicle", "terrain"})
"""Columns of which a new run may have the same value."""


def _advise_runs(equal: _Part, undriven: Sequence[str]) -> str:
    """Runs that would make differences at equal driving significant, and how to drive them; or nothing."""
    rows = equal.pairs.values()
    # A run, or a month, cannot be driven again.
    if not all(_REPEATED.issuperset(str(row["by"]).split(",")) for row in rows):
        return ""
    if any(row["note"] == NO_SPREAD for row in rows):
        return "two more runs on any of these grounds would show how much runs of one ground differ"
    foreseen = foresee_pairs(rows)
    if not foreseen:
        return ""
    first, *later = foreseen
    count = format_count(first.added, "more run")
    text = f"{count} on each ground would make about {len(first.pairs)} of {len(rows)} pairs significant"
    text += "".join(f", {one.added} more {len(one.pairs)}" for one in later)
    return "; ".join([f"{text}, if runs go on to differ as these do", *undriven])


def _find_undriven(
    answer: Answer, input_name: str, datasets: Sequence[str], labels: Mapping[str, str]
) -> list[str]:
    """Datasets that lack the highest speeds of all others, and from which speed on."""
    own = answer.bins.filter(pl.col("input") == input_name, pl.col("group").is_in(list(datasets)))
    fastest = dict(own.group_by("group").agg(pl.col("speed").max()).iter_rows())
    slow = min(fastest, key=lambda name: fastest[name])
    others = min((speed for name, speed in fastest.items() if name != slow), default=0)
    if fastest[slow] >= others:
        return []
    return [f"drive {labels[slow]} above {SPEED_EDGES[fastest[slow]]:g} m/s, too, as the others were"]


def title_line(line: Line) -> str:
    """What a line is about: vehicles and input."""
    return f"{line.family}, {INPUT_WORDS[line.input]}"


def list_shown_notes(answer: Answer) -> list[str]:
    """The notes of an answer, less that on the plain test, which only the files have."""
    return [note for note in answer.notes if note != NOT_VALID]


def summarize_answer(answer: Answer) -> dict[str, object]:
    """The JSON object of `slip compare`."""
    return {
        "input": answer.input,
        "quantity": answer.quantity,
        "datasets": _list_rows(answer.datasets.filter(pl.col("input") == answer.input)),
        "pairs": _list_pair_rows(answer.comparisons),
        "answer": [vars(line) for line in list_lines(answer)],
        "views": [
            {
                "input": view.input,
                "quantity": view.quantity,
                "levels": _list_rows(view.levels),
                "pairs": _list_pair_rows(view.comparisons),
            }
            for view in answer.views
        ],
        "carried_by": [
            {"input": name, "pair": sorted(pair), "by": by} for (name, pair), by in answer.carriers.items()
        ],
        "orders": [
            vars(one) for one in compare_orders(answer.datasets.filter(pl.col("input") == answer.input))
        ],
        "notes": list(answer.notes),
    }


def _list_pair_rows(comparisons: pl.DataFrame) -> list[dict[str, object]]:
    return _list_rows(comparisons.drop("run", "dataset", "vehicle", "terrain"))


def _list_rows(frame: pl.DataFrame) -> list[dict[str, object]]:
    return frame.with_columns(pl.col(pl.Enum).cast(pl.String)).to_dicts()
