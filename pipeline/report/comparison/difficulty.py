"""Where fair measures of difficulty order the datasets differently."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.report.words import build_table, escape, say_number
from pipeline.statistics import kendall_tau, list_swaps

if TYPE_CHECKING:
    import polars as pl

MEASURES: dict[str, tuple[str, str, str]] = {
    "median_modulus": ("slip modulus", "m/s", "the published idea: fast vehicles look worse"),
    "relative_slip": ("relative slip", "1", "modulus over ideal speed, while the vehicle should move"),
    "slip_energy": (
        "slip energy",
        "J",
        "1/2 m |g_xy|\u00b2 + 1/2 I g_w\u00b2: what the ground would have to absorb",
    ),
    "unpredictability": (
        "unpredictability",
        "m/s",
        "rms slip that a fitted slip model leaves on unseen data",
    ),
    "transitory_slip": ("transitory slip", "m", "slip path that a change of command adds to the steady one"),
}
_MOST_SWAPS = 4
_FEWEST = 2


def render_difficulty(shown: pl.DataFrame) -> str:
    """Values and ranks of every measure, their agreement, and the contradictions in words.

    Args:
        shown: table `datasets` of one input.
    """
    rated = shown.drop_nulls("median_modulus").sort("median_modulus")
    head = ["dataset", *(f"{name} <small>{unit}</small>" for name, unit, _ in MEASURES.values())]
    ranks = {column: rated[column].rank("min") for column in MEASURES}
    rows = [
        [
            escape(row["dataset"]),
            *(
                say_number(row[column])
                + (f" <small>({int(ranks[column][i])})</small>" if row[column] is not None else "")
                for column in MEASURES
            ),
        ]
        for i, row in enumerate(rated.iter_rows(named=True))
    ]
    agreement = ["<i>agreement with the modulus (Kendall)</i>"]
    told: list[str] = []
    for column in MEASURES:
        both = rated.drop_nulls(column)
        if both.height < _FEWEST:
            agreement.append("\u2013")
            continue
        usual, own = both["median_modulus"].to_numpy(), both[column].to_numpy()
        agreement.append(f"{kendall_tau(usual, own):.2f}")
        told += [
            f"{both['dataset'][i]} slips more than {both['dataset'][j]} by modulus, "
            f"but less by {MEASURES[column][0]}"
            for i, j in list_swaps(usual, own)[:_MOST_SWAPS]
        ]
    table = build_table(
        head,
        [*rows, agreement],
        caption="Median over runs and, in brackets, the rank from easy to hard",
        numeric=range(1, len(head)),
    )
    meanings = "".join(
        f"<div><dt>{name} [{unit}]</dt><dd>{escape(text)}</dd></div>"
        for name, unit, text in MEASURES.values()
    )
    swaps = "".join(f"<li>{escape(line)}</li>" for line in told)
    listed = f'<p class="caption">Where they disagree</p><ul>{swaps}</ul>' if swaps else ""
    return f'{table}{listed}<dl class="facts">{meanings}</dl>'
