"""How the published quantity, the 2 s window norm, is distributed."""

import polars as pl

from pipeline.report.figures.figure import Drawing, Figure, Section
from pipeline.report.figures.shares import draw_shares
from pipeline.report.scene import Scene


def draw(scene: Scene) -> Drawing | None:
    """The share of windows below each norm."""
    norms = _list_norms(scene)
    if not norms:
        return None
    note = "The norm of the published figure: \u221a40 \u00d7 root mean square modulus of 2 s."
    return draw_shares("norm_shares", norms, "2 s window norm", note=note)


def _list_norms(scene: Scene) -> dict[str, pl.Series]:
    windows = scene.report.table("windows")
    if windows is None:
        return {}
    if "suspect" in windows.columns:
        windows = windows.filter(~pl.col("suspect"))
    by_input = {
        name: windows.filter(pl.col("input").cast(pl.String) == name)["window_norm"]
        for name in scene.report.inputs
    }
    return {name: norms for name, norms in by_input.items() if not norms.is_empty()}


FIGURE = Figure("Distribution over 2 s windows", Section.HOW_BAD, draw, order=30)
