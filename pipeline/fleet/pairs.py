"""Pairwise comparison of groups of runs, tables of comparisons, and agreement on the order of terrains."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl
import polars.selectors as cs

from pipeline.core import pick
from pipeline.core.arrays import Flags, Floats, Ints
from pipeline.core.untrusted import format_csv, number_in
from pipeline.fleet import MEASURES
from pipeline.fleet.confidence import (
    Blocks,
    Comparison,
    Interval,
    bootstrap_median,
    compare_blocks,
    compare_runs,
    cut_blocks,
)
from pipeline.fleet.rank_tests import (
    DRAWS,
    FEWER_DRAWS,
    LEVEL,
    MOST_GROUPS,
    adjust_holm,
    adjust_max_t,
    find_testable,
    kendall_p,
    kendall_tau,
    mann_whitney,
    name_delta,
    runs_needed,
)
from schemas import contract_of

RUNS = "runs"
BLOCKS = "blocks"
_FEW_GROUPS = 6
"""Largest number of groups for which max-T takes `DRAWS`, above it `FEWER_DRAWS`: its time grows with the
pairs times the draws."""
_MANY_PAIRS = 200
"""Number of pairs of single runs above which each takes `FEWER_DRAWS`, to limit the time."""
ABOUT_BLOCKS = "a difference between two runs, not between terrains"


@dataclass(frozen=True)
class Samples:
    """Samples of one run.

    Attributes:
        values: the compared quantity, ascending in time, shape (n,).
        ticks: number of each sample on its uniform grid, shape (n,).
        pieces: segment number of each sample, shape (n,).
        step: usual length of a command step [grid steps].
    """

    values: Floats
    ticks: Ints
    pieces: Ints
    step: float

    @property
    def median(self) -> float:
        """Median of the run."""
        return float(np.median(self.values))


@dataclass(frozen=True)
class Group:
    """Dataset as an input of the tests: its runs."""

    name: str
    runs: tuple[Samples, ...]

    @property
    def medians(self) -> Floats:
        """Median of each run."""
        return np.array([run.median for run in self.runs])


@dataclass(frozen=True)
class Pair:
    """Comparison of two groups.

    Attributes:
        a: first group.
        b: second group.
        comparison: shift, interval, effect size and the pair's own test.
        p_adjusted: p corrected over the family of pairs with the same unit.
        smallest_p: smallest corrected p possible with these counts, whatever the difference.
        unit: `RUNS` or `BLOCKS`.
        method: test and correction in words.
        p_uncorrected: plain Mann-Whitney over all samples; not valid.
        note: remark on the interpretation; may be empty.
    """

    a: Group
    b: Group
    comparison: Comparison
    p_adjusted: float
    smallest_p: float
    unit: str
    method: str
    p_uncorrected: float
    note: str

    @property
    def size(self) -> str:
        """Cliff's delta in a word."""
        return name_delta(self.comparison.delta)


def compare_groups(groups: Sequence[Group], *, untested: Collection[frozenset[str]] = ()) -> list[Pair]:
    """Compare pairs of groups.

    Two groups of one run each are compared block by block; the result applies to these two runs only. They
    form a family of their own, corrected after Holm. All other pairs permute whole runs; their family is
    corrected by max-T, or after Holm for more than eight groups. Pairs that can never be significant do not
    count in their family (Tarone).

    Args:
        groups: groups of at least one run each, with samples.
        untested: names of pairs that are not compared.
    """
    numbered = [
        (i, j)
        for i, j in itertools.combinations(range(len(groups)), 2)
        if frozenset((groups[i].name, groups[j].name)) not in untested
    ]
    single = [(i, j) for i, j in numbered if len(groups[i].runs) == len(groups[j].runs) == 1]
    several = [pair for pair in numbered if pair not in set(single)]
    return sorted(
        [*_compare_runs(groups, several), *_compare_blocks(groups, single)],
        key=lambda pair: (pair.a.name, pair.b.name),
    )


def bound_run(run: Samples) -> Interval:
    """Interval of one run's median from its blocks; it applies to this run, not to its terrain."""
    return bootstrap_median(run.values, cut_run(run).numbers)


def cut_run(run: Samples) -> Blocks:
    """Cut the run into blocks."""
    return cut_blocks(run.values, run.ticks, run.pieces, step=run.step)


def _compare_runs(groups: Sequence[Group], pairs: Sequence[tuple[int, int]]) -> list[Pair]:
    compared = [compare_runs(groups[i].medians, groups[j].medians) for i, j in pairs]
    by_max_t = len(groups) <= MOST_GROUPS
    draws = DRAWS if len(groups) <= _FEW_GROUPS or not by_max_t else FEWER_DRAWS
    own = np.array([comparison.test.p for comparison in compared])
    smallest = np.array([max(comparison.test.smallest_p, 1.0 / (draws + 1)) for comparison in compared])
    if by_max_t:
        positive = all(np.all(group.medians > 0.0) for group in groups)
        units = [np.log(group.medians) if positive else group.medians for group in groups]
        counted, family = smallest <= LEVEL, 1
        matrix = adjust_max_t(units, pairs, draws=draws)
        adjusted = np.maximum([matrix[pair] for pair in pairs], own)[counted]
    else:
        counted, family = find_testable(smallest)
        adjusted = adjust_holm(own[counted])
    corrected = _correct(own, counted, family, adjusted)
    correction = _name_correction("max-T" if by_max_t else "Holm", int(counted.sum()))
    decided = []
    for (i, j), comparison, p, least, counts in zip(
        pairs, compared, corrected.tolist(), smallest.tolist(), counted.tolist(), strict=True
    ):
        kind = "exact" if comparison.test.exact else "random"
        decided.append(
            Pair(
                a=groups[i],
                b=groups[j],
                comparison=comparison,
                p_adjusted=p,
                smallest_p=min(least * family, 1.0),
                unit=RUNS,
                method=f"{kind} permutation of whole runs{correction * counts}",
                p_uncorrected=_ask_published(groups[i], groups[j]),
                note=_note_runs(groups[i], groups[j], least * family, 1 if by_max_t else len(pairs)),
            )
        )
    return decided


def _correct(own: Floats, counted: Flags, family: int, adjusted: Floats) -> Floats:
    """Corrected p of the pairs that count, and of the others one that is above the level."""
    corrected = np.minimum(own * family, 1.0)
    corrected[counted] = adjusted
    return corrected


def _compare_blocks(groups: Sequence[Group], pairs: Sequence[tuple[int, int]]) -> list[Pair]:
    needed = {i for pair in pairs for i in pair}
    blocks = {i: cut_run(groups[i].runs[0]) for i in needed}
    draws = DRAWS if len(pairs) <= _MANY_PAIRS else FEWER_DRAWS
    compared = [compare_blocks(blocks[i].medians, blocks[j].medians, draws=draws) for i, j in pairs]
    smallest = np.array([comparison.test.smallest_p for comparison in compared])
    counted, family = find_testable(smallest)
    own = np.array([comparison.test.p for comparison in compared])
    corrected = _correct(own, counted, family, adjust_holm(own[counted]))
    correction = _name_correction("Holm", int(counted.sum()))
    return [
        Pair(
            a=groups[i],
            b=groups[j],
            comparison=comparison,
            p_adjusted=p,
            smallest_p=min(least * family, 1.0),
            unit=BLOCKS,
            method=f"permutation of {blocks[i].medians.size} and {blocks[j].medians.size} blocks"
            f"{correction * counts}",
            p_uncorrected=_ask_published(groups[i], groups[j]),
            note=_note_blocks(groups[i], groups[j], least, family, len(pairs)),
        )
        for (i, j), comparison, p, least, counts in zip(
            pairs, compared, corrected.tolist(), smallest.tolist(), counted.tolist(), strict=True
        )
    ]


def _name_correction(name: str, pairs: int) -> str:
    return f", {name} over {pairs} pairs" if pairs > 1 else ""


def _ask_published(a: Group, b: Group) -> float:
    """Test used in published work, over all samples."""
    return mann_whitney(*(np.concatenate([run.values for run in group.runs]) for group in (a, b)))


def _note_runs(a: Group, b: Group, smallest: float, family: int) -> str:
    notes = _note_scatter(a.medians, b.medians)
    if smallest > LEVEL:
        counts = {len(a.runs), len(b.runs)}
        have = (
            f"{counts.pop()} runs per side" if len(counts) == 1 else f"{len(a.runs)} and {len(b.runs)} runs"
        )
        notes.append(f"cannot be significant with {have}; {runs_needed(family)} per side are needed")
    return "; ".join(notes)


def _note_blocks(a: Group, b: Group, smallest: float, family: int, pairs: int) -> str:
    notes = [ABOUT_BLOCKS, *_note_scatter(a.runs[0].values, b.runs[0].values)]
    if smallest > LEVEL:
        notes.append("cannot be significant: too short for enough independent blocks")
    elif smallest * family > LEVEL:
        notes.append(f"cannot be significant among {pairs} pairs; compare fewer")
    return "; ".join(notes)


def _note_scatter(a: Floats, b: Floats) -> list[str]:
    still = [values for values in (a, b) if values.size > 1 and float(np.ptp(values)) == 0.0]
    return ["one side has no variation"] if still else []


_LATEX: dict[str, tuple[tuple[str, str, int], ...]] = {
    "datasets": (
        ("dataset", "dataset", 0),
        ("runs", "runs", 0),
        ("samples", "samples", 0),
        ("distance", "distance [m]", 0),
        ("median_modulus", "median $\\|g\\|$ [m/s]", 3),
        ("low", "low", 3),
        ("high", "high", 3),
        ("median_window_norm", "window norm [m/s]", 2),
        ("published_norm", "as published", 2),
    ),
    "comparisons": (
        ("a", "a", 0),
        ("b", "b", 0),
        ("unit_of_analysis", "unit", 0),
        ("shift", "shift [m/s]", 3),
        ("low", "low", 3),
        ("high", "high", 3),
        ("cliffs_delta", "$\\delta$", 2),
        ("p", "$p$", 4),
        ("p_adjusted", "$p$ corrected", 4),
        ("smallest_p", "smallest $p$", 4),
    ),
    "causes": (
        ("dataset", "dataset", 0),
        ("runs", "runs", 0),
        ("cause", "cause", 0),
        ("share", "share", 3),
        ("low", "low", 3),
        ("high", "high", 3),
        ("rms", "slip [m/s]", 3),
    ),
    "cause_differences": (
        ("a", "a", 0),
        ("b", "b", 0),
        ("cause", "cause", 0),
        ("difference", "difference [m/s]", 3),
        ("low", "low", 3),
        ("high", "high", 3),
        ("p_adjusted", "$p$ corrected", 4),
    ),
}
_SPECIAL = {mark: rf"\{mark}" for mark in "&%$#_{}"} | {
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "\\": r"\textbackslash{}",
}


def tabulate_pairs(
    pairs: Sequence[Pair], *, by: Sequence[str], input_name: str, quantity: str, keys: Mapping[str, str]
) -> pl.DataFrame:
    """Table `comparisons`.

    Args:
        pairs: as from `compare_groups`.
        by: columns that define a dataset.
        input_name: input u.
        quantity: compared quantity.
        keys: run/generation of the runs of every group.
    """
    rows = [
        {
            "run": "*",
            "dataset": f"{pair.a.name} | {pair.b.name}",
            "vehicle": "*",
            "terrain": "*",
            "by": ",".join(by),
            "input": input_name,
            "quantity": quantity,
            "a": pair.a.name,
            "b": pair.b.name,
            "runs_a": len(pair.a.runs),
            "runs_b": len(pair.b.runs),
            "shift": pair.comparison.shift,
            **(pick(pair.comparison.interval, "low", "high") if pair.comparison.interval else {}),
            "cliffs_delta": pair.comparison.delta,
            "p": pair.comparison.test.p,
            "unit_of_analysis": pair.unit,
            **pick(pair, "size", "p_adjusted", "smallest_p", "method", "p_uncorrected", "note"),
            "keys": f"{keys[pair.a.name]} {keys[pair.b.name]}",
        }
        for pair in pairs
    ]
    frame = pl.DataFrame(rows, schema=contract_of("comparisons").schema.create_empty().schema)
    return frame.select(cs.string(), cs.float(), cs.integer(), cs.enum())


DIFFERENT, OF_TWO_RUNS, ALIKE, TOO_FEW = "different", "different runs", "alike", "too few"


def judge_pair(row: Mapping[str, object]) -> str:
    """What a row of `comparisons` says: `DIFFERENT`, `OF_TWO_RUNS`, `ALIKE` or `TOO_FEW`."""
    adjusted, smallest = (number_in(row, key) for key in ("p_adjusted", "smallest_p"))
    if adjusted is not None and adjusted <= LEVEL:
        return DIFFERENT if row["unit_of_analysis"] == RUNS else OF_TWO_RUNS
    return TOO_FEW if smallest is None or smallest > LEVEL else ALIKE


_WORDS = {
    DIFFERENT: ("differs significantly", "differ significantly"),
    OF_TWO_RUNS: ("differs, but as two single runs only", "differ, but as two single runs only"),
    ALIKE: ("shows no significant difference", "show no significant difference"),
    TOO_FEW: ("has too few runs for a test", "have too few runs for a test"),
}
"""What is said of one pair, and of several."""


def count_pairs(rows: Sequence[Mapping[str, object]]) -> str:
    """How many pairs of the table `comparisons` differ, and what is said of the others, as one sentence."""
    counts = Counter(judge_pair(row) for row in rows)
    if len(rows) == 1:
        return f"The pair of datasets {_WORDS[next(iter(counts))][0]}."
    parts = [] if counts[DIFFERENT] else ["none differs significantly"]
    parts += [f"{counts[kind]} {words[counts[kind] > 1]}" for kind, words in _WORDS.items() if counts[kind]]
    return f"Of {len(rows)} pairs of datasets, {', '.join(parts)}."


def write_csv(frame: pl.DataFrame) -> str:
    """Format a table as CSV with a header line; six decimal places."""
    return format_csv(frame, digits=6)


def write_latex(name: str, frame: pl.DataFrame) -> str:
    """Format the columns of a table that a paper shows as a LaTeX tabular (booktabs).

    Columns without values are omitted.

    Args:
        name: `datasets`, `comparisons`, `causes` or `cause_differences`.
        frame: the table.
    """
    columns = [
        column for column in _LATEX[name] if frame.is_empty() or frame[column[0]].null_count() < frame.height
    ]
    kinds = "".join("l" if frame.schema[column] in (pl.String, pl.Enum) else "r" for column, _, _ in columns)
    lines = [
        f"\\begin{{tabular}}{{{kinds}}}",
        "\\toprule",
        " & ".join(title for _, title, _ in columns) + " \\\\",
        "\\midrule",
        *(
            " & ".join(_write_cell(row[column], digits) for column, _, digits in columns) + " \\\\"
            for row in frame.iter_rows(named=True)
        ),
        "\\bottomrule",
        "\\end{tabular}",
    ]
    return "\n".join(lines) + "\n"


def _write_cell(value: object, digits: int) -> str:
    if value is None:
        return "--"
    if isinstance(value, float):
        return f"{value:.{digits}f}"
    return "".join(_SPECIAL.get(mark, mark) for mark in str(value))


@dataclass(frozen=True)
class Answer:
    """Result of a comparison.

    Attributes:
        datasets: table `datasets`, both inputs.
        comparisons: table `comparisons`.
        runs: one row per run and input with all its measures.
        input: input u of the comparisons.
        quantity: compared quantity.
        intervals: ``dataset``, ``value``, ``low``, ``high``, ``interval`` of the compared quantity.
        windows: box plot statistics of the window norms, as from `spread_windows`.
        notes: excluded runs, pairs that cannot be distinguished.
    """

    datasets: pl.DataFrame
    comparisons: pl.DataFrame
    runs: pl.DataFrame
    input: str
    quantity: str
    intervals: pl.DataFrame
    windows: pl.DataFrame
    notes: tuple[str, ...]

    @property
    def measure(self) -> str:
        """Name of the compared quantity, its length scale included."""
        if self.quantity == "published_norm":
            return "2 s window norm as published (L = 1 m)"
        (scale,) = self.datasets["length_scale"].drop_nulls().unique().to_list() or (1.0,)
        return f"median slip modulus (L = {scale:g} m)"


@dataclass(frozen=True)
class Agreement:
    """Agreement of two vehicles on the order of the terrains that both were driven on.

    Attributes:
        measure: key of `MEASURES`.
        a, b: vehicles.
        terrains: common terrains, from easy to hard for `a`.
        tau: Kendall's tau-b; None with fewer than two terrains.
        p: two-sided probability of an order as strong if there were none.
        smallest_p: smallest p possible with this number of terrains.
        text: the result in words.
    """

    measure: str
    a: str
    b: str
    terrains: tuple[str, ...]
    tau: float | None
    p: float | None
    smallest_p: float | None
    text: str


def compare_orders(datasets: pl.DataFrame) -> list[Agreement]:
    """Compare every two vehicles by every measure that both have; a terrain has the median over its datasets.

    Args:
        datasets: table `datasets` of one input; rows over several vehicles or terrains are ignored.
    """
    known = datasets.filter(pl.col("vehicle") != "*", pl.col("terrain") != "*")
    comparisons = []
    for a, b in itertools.combinations(sorted(set(known["vehicle"])), 2):
        for key, measure in MEASURES.items():
            sides = [
                known.filter(pl.col("vehicle") == vehicle)
                .drop_nulls(measure.column)
                .group_by("terrain")
                .agg(pl.col(measure.column).median().alias(vehicle))
                for vehicle in (a, b)
            ]
            comparisons.append(_order(key, a, b, sides[0].join(sides[1], on="terrain").sort(a, "terrain")))
    return comparisons


def _order(key: str, a: str, b: str, both: pl.DataFrame) -> Agreement:
    terrains = tuple(both["terrain"].to_list())
    count = len(terrains)
    if count < 2:  # noqa: PLR2004 - an order takes two
        shared = f"share {terrains[0]} only" if terrains else "have no terrain in common"
        return Agreement(
            key, a, b, terrains, None, None, None, f"{a} and {b} {shared}: no order of terrains to compare"
        )
    tau = kendall_tau(both[a], both[b])
    p, smallest = kendall_p(tau, count)
    sure = (
        f"p = {p:.2g}"
        if smallest <= LEVEL
        else f"too few terrains for significance, p = {p:.2g}; at least 5 are needed"
    )
    text = f"{a} and {b} on {count} terrains by {MEASURES[key].name}: Kendall's tau {tau:.2f}, {sure}"
    return Agreement(key, a, b, terrains, tau, p, smallest, text)
