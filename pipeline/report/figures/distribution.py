"""How the slip modulus is distributed over the time steps."""

from pipeline.report.figures.figure import Drawing, Figure, Section
from pipeline.report.figures.shares import draw_shares
from pipeline.report.scene import Scene


def draw(scene: Scene) -> Drawing | None:
    """The share of time steps below each modulus."""
    if not scene.sound_slip:
        return None
    values = {name: frame["modulus"] for name, frame in scene.sound_slip.items()}
    return draw_shares("modulus_shares", values, "slip modulus", of=" of a time step")


FIGURE = Figure("Distribution over time steps", Section.HOW_BAD, draw, order=20)
