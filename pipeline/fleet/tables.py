"""Comparisons as tables: for the store, for spreadsheets, and for papers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import polars as pl
import polars.selectors as cs

from pipeline.core.numbers import pick
from pipeline.core.tables import format_csv
from pipeline.fleet.pairs import Pair
from schemas import contract_of

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
        pairs: as of `compare_groups`.
        by: columns that make a dataset.
        input_name: what u was.
        quantity: what was compared.
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


def write_csv(frame: pl.DataFrame) -> str:
    """A table as CSV with a line of names; six digits behind the point."""
    return format_csv(frame, digits=6)


def write_latex(name: str, frame: pl.DataFrame) -> str:
    """The columns of a table that a paper shows, as a LaTeX tabular (booktabs).

    Columns without any value are left out.

    Args:
        name: `datasets`, `comparisons`, `causes` or `cause_differences`.
        frame: that table.
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
    """What came of it.

    Attributes:
        datasets: table `datasets`, both inputs.
        comparisons: table `comparisons`.
        runs: one row a run and input with all its numbers.
        input: what u is in the comparisons.
        quantity: what was compared.
        intervals: ``dataset``, ``value``, ``low``, ``high``, ``interval`` of what was compared.
        windows: box plot numbers of the window norms, as of `spread_windows`.
        notes: what must be known: runs left out, pairs that cannot be told apart.
    """

    datasets: pl.DataFrame
    comparisons: pl.DataFrame
    runs: pl.DataFrame
    input: str
    quantity: str
    intervals: pl.DataFrame
    windows: pl.DataFrame
    notes: tuple[str, ...]
