"""Where the vehicle slipped: in words, on the map, over the commands, over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.report.figures.figure import Section
from pipeline.report.run import RunReport, objects_in

if TYPE_CHECKING:
    from pipeline.report.sections import Page


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
