"""Where the vehicle slipped: in words, on the map, over the commands, over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import polars as pl

from pipeline.report.figures.figure import Section
from pipeline.report.run import objects_in
from pipeline.report.scales import round_up

if TYPE_CHECKING:
    from pipeline.report.run import RunReport
    from pipeline.report.sections.page import Page

_MOST_REGIONS = 3
_WORTH_TELLING = 1.15
_SMALLEST_SHARE = 0.15
_UPPER_QUANTILE = 0.7
_SLOW = 0.05
VERBS = {"command": ("Asked to turn", "Asked to drive"), "measured": ("Turning", "Driving")}


def view_where(page: Page) -> dict[str, object]:
    """The regions that carry the slip, the linked figures, and a way to mark time without a mouse."""
    return {"regions": list_regions(page.report), "pictures": page.pictures[Section.WHERE]}


def list_regions(report: RunReport, most: int = 3) -> list[tuple[str, str]]:
    """Where the error of the ideal model is, as on the screen: each region with its part of the error."""
    if report.is_refused:
        return []
    found = []
    for entry in objects_in(report.diagnosis, "where")[:most]:
        region, text = str(entry.get("region", "")), str(entry.get("text", ""))
        found.append((region, text.removeprefix(region).removeprefix(": ")))
    return found


def find_regions(slip: pl.DataFrame | None, verbs: tuple[str, str]) -> list[tuple[str, float, float]]:
    """Regions of driving that carry more slip than their share of the time.

    Args:
        slip: slip of one input.
        verbs: how to say that the input turns, and that it drives.

    Returns:
        Words, share of the sum of squared moduli and share of the samples, the densest first, at most three.
    """
    if slip is None or slip.is_empty():
        return []
    squared = pl.col("modulus") ** 2
    total = float((slip["modulus"] ** 2).sum())
    if total <= 0.0:
        return []
    turning = _threshold(slip, "f_w")
    fast = _threshold(slip, "f_x")
    spinning = (pl.col("f_x").abs() < _SLOW) & (pl.col("f_w").abs() > _SLOW)
    candidates = {
        f"{verbs[0]} faster than {turning:g} rad/s": pl.col("f_w").abs() > turning,
        f"{verbs[1]} faster than {fast:g} m/s": pl.col("f_x").abs() > fast,
        "The transitory time after a change of command": pl.col("transitory"),
        "Turning on the spot": spinning,
        "Reversing": pl.col("f_x") < -_SLOW,
    }
    found = []
    for words, inside in candidates.items():
        part = slip.filter(inside)
        time = part.height / slip.height
        share = float(part.select(squared.sum()).item()) / total
        if share >= _SMALLEST_SHARE and time > 0.0 and share / time >= _WORTH_TELLING:
            found.append((words, share, time))
    return sorted(found, key=lambda region: region[2] / region[1])[:_MOST_REGIONS]


def _threshold(slip: pl.DataFrame, name: str) -> float:
    level = float(slip[name].abs().quantile(_UPPER_QUANTILE) or 0.0)
    return round_up(level) if level > _SLOW else _SLOW
