"""Correlation of residuals with the input: what the model does with its input is right where none is left."""

import polars as pl

from pipeline.identification.correlation import LONGEST_S, cross_correlate
from pipeline.report.figures.autocorrelation import draw_correlations, list_correlations
from pipeline.report.figures.figure import Drawing, Figure, Section
from pipeline.report.figures.residuals import QUANTITIES
from pipeline.report.motion_view import MotionView
from pipeline.report.scene import Scene

_WORDS = {"f_x": "speed", "f_y": "sideways speed", "f_w": "yaw rate", "f_x_f_w": "speed \u00d7 yaw rate"}


def draw(scene: Scene) -> Drawing | None:
    """A panel a channel, before and after; None without a model or with too few windows."""
    rows, motion = list_crosscorrelations(scene), scene.report.motion
    if not rows or motion is None:
        return None
    inputs = choose_inputs(motion)
    titles = {one: f"{QUANTITIES[one][0]} residual with {_WORDS[inputs[one]]} [1]" for one in inputs}
    axis = (-LONGEST_S, "how long before the residual the input was [s]")
    note = "Grey: where 95 % of residuals stay that know nothing of the input. Right of zero it is the past."
    return Drawing(draw_correlations(scene, "crosscorrelation", titles, axis), rows, note, _describe(rows))


def choose_inputs(motion: MotionView) -> dict[str, str]:
    """The input that each channel's residual is set beside; sideways that of turning while driving."""
    moves_aside = bool(motion.residuals["f_y"].abs().max() or 0.0)
    return {"x": "f_x", "y": "f_y" if moves_aside else "f_x_f_w", "w": "f_w"}


def list_crosscorrelations(scene: Scene) -> dict[str, pl.DataFrame]:
    """As `list_correlations`, of residuals with the input."""
    return list_correlations(
        scene,
        "crosscorrelation",
        lambda motion, component: (
            lambda t, residual: cross_correlate(
                t, motion.residuals[choose_inputs(motion)[component]].to_numpy(), residual
            )
        ),
    )


def _describe(rows: dict[str, pl.DataFrame]) -> str:
    """The largest correlation with the input, before and after."""
    told = []
    for name, frame in rows.items():
        most = dict(frame.group_by("series").agg(pl.col("value").abs().max()).iter_rows())
        bound = float(frame.filter(pl.col("series") == "model")["high"][0])
        words = f"{most['ideal']:.2f} before, {most['model']:.2f} after, bound {bound:.2f}"
        told.append(f"{QUANTITIES[name[-1]][0]} {words}")
    return f"Largest correlation of residuals with the input within five seconds: {'; '.join(told)}."


FIGURE = Figure("Does what is left follow the input?", Section.WHY, draw, order=5)
