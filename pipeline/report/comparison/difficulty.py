"""Where fair measures of difficulty order the datasets differently."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.fleet.measures import MEASURES
from pipeline.fleet.statistics.ranks import kendall_tau, list_swaps
from pipeline.report.elements import Cell, Column, Table
from pipeline.report.words import MISSING, say_number

if TYPE_CHECKING:
    import polars as pl

_MOST_SWAPS = 4
_FEWEST = 2


def tabulate_difficulty(shown: pl.DataFrame) -> Table:
    """Values and ranks of every measure, and how far each agrees with the modulus.

    Args:
        shown: table `datasets` of one input.
    """
    rated = _rate(shown)
    columns = [measure.column for measure in MEASURES.values()]
    ranks = {column: rated[column].rank("min") for column in columns}
    rows: list[list[str | Cell]] = [
        [
            str(row["dataset"]),
            *(
                Cell(
                    say_number(row[column]),
                    small=f"({int(ranks[column][i])})" if row[column] is not None else "",
                )
                for column in columns
            ),
        ]
        for i, row in enumerate(rated.iter_rows(named=True))
    ]
    both = {column: rated.drop_nulls(column) for column in columns}
    agreement = (
        MISSING
        if pair.height < _FEWEST
        else f"{kendall_tau(pair['median_modulus'].to_numpy(), pair[column].to_numpy()):.2f}"
        for column, pair in both.items()
    )
    rows.append([Cell("agreement with the modulus (Kendall)", tag="i"), *agreement])
    head = [Column("dataset"), *(Column(one.name, one.unit, number=True) for one in MEASURES.values())]
    return Table("Median over runs and, in brackets, the rank from easy to hard", head, rows)


def list_contradictions(shown: pl.DataFrame) -> list[str]:
    """Pairs of datasets that a measure orders otherwise than the modulus does, in words."""
    told = []
    for measure in MEASURES.values():
        both = _rate(shown).drop_nulls(measure.column)
        if both.height >= _FEWEST:
            swaps = list_swaps(both["median_modulus"].to_numpy(), both[measure.column].to_numpy())
            told += [
                f"{both['dataset'][i]} slips more than {both['dataset'][j]} by modulus, "
                f"but less by {measure.name}"
                for i, j in swaps[:_MOST_SWAPS]
            ]
    return told


def _rate(shown: pl.DataFrame) -> pl.DataFrame:
    return shown.drop_nulls("median_modulus").sort("median_modulus")
