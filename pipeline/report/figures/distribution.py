"""How the slip modulus is distributed over the time steps."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.report.figures.figure import Drawing, Figure, Section
from pipeline.report.figures.shares import describe_medians, draw_shares, tabulate_shares

if TYPE_CHECKING:
    from pipeline.report.scene import Scene


def draw(scene: Scene) -> Drawing | None:
    """The share of time steps below each modulus."""
    if not scene.sound_slip:
        return None
    curves, medians = tabulate_shares({name: frame["modulus"] for name, frame in scene.sound_slip.items()})
    chart = draw_shares("modulus_shares", medians, title="slip modulus of a time step [m/s]")
    rows = {"modulus_shares": curves, "modulus_shares_medians": medians}
    return Drawing(chart, rows, words=describe_medians(medians, "slip modulus"))


FIGURE = Figure("Distribution over time steps", Section.HOW_BAD, draw, order=20)
