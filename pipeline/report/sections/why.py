"""Why it slipped: what the drivetrain did, what the ground did."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.report.figures.figure import Section
from pipeline.report.run import number_in
from pipeline.report.words import say_share

if TYPE_CHECKING:
    from pipeline.report.sections.page import Page


def render_why(page: Page) -> str:
    """The split in one sentence and as a figure; empty without measured wheels."""
    split = page.report.part("split")
    shares = {name: number_in(split, name) for name in ("drivetrain", "ground", "cross")}
    told = ""
    if shares["drivetrain"] is not None and shares["ground"] is not None:
        larger = "drivetrain" if shares["drivetrain"] > shares["ground"] else "ground"
        told = (
            f'<p class="lead">Most of the slip on command arises {_PLACES[larger]}: drivetrain '
            f"{say_share(shares['drivetrain'])}, ground {say_share(shares['ground'])}, "
            f"cross term {say_share(shares['cross'])} of the mean square.</p>"
        )
    return told + page.render_figures(Section.WHY)


_PLACES = {
    "drivetrain": "between command and wheels",
    "ground": "between wheels and ground",
}
