"""Autocorrelation of residuals: structure that a model has left over lives for seconds, noise does not."""

from __future__ import annotations

from typing import TYPE_CHECKING

import altair as alt
import numpy as np
import polars as pl
from numpy.typing import NDArray

from pipeline.report import theme
from pipeline.report.figures import parts
from pipeline.report.figures.figure import Drawing, Figure, Section, Width
from pipeline.report.figures.residuals import QUANTITIES
from pipeline.report.motion_view import COMPONENTS

if TYPE_CHECKING:
    from pipeline.report.scene import Scene

Floats = NDArray[np.float64]

_LONGEST_S = 5.0
_FEWEST = 40


def draw_autocorrelation(scene: Scene) -> Drawing | None:
    """A panel a channel, before and after; None without a model or with too few windows."""
    motion = scene.report.motion
    if motion is None or motion.residuals.height < _FEWEST:
        return None
    rows = list_autocorrelations(scene)
    panels = []
    for component in COMPONENTS:
        last = component == COMPONENTS[-1]
        x = alt.X(
            "lag:Q",
            scale=alt.Scale(domain=[0.0, _LONGEST_S]),
            axis=alt.Axis(title="time between windows [s]" if last else None, labels=last, grid=False),
        )
        y = alt.Y(
            "value:Q",
            scale=alt.Scale(domain=[-0.6, 1.0], nice=False),
            axis=alt.Axis(title=None, values=[-0.5, 0, 0.5, 1], format=",~r", minExtent=parts.GUTTER - 10),
        )
        name = f"autocorrelation_{component}"
        line = alt.Chart(alt.NamedData(name)).mark_line(clip=True, strokeWidth=2)
        drawn = line.encode(x=x, y=y, color=parts.before_and_after(motion.input))
        zero = alt.Chart(alt.NamedData(name)).mark_rule(color=theme.QUIET, strokeWidth=0.8)
        panels.append(
            alt.layer(zero.encode(y=alt.datum(0.0)), drawn).properties(
                width=480, height=96, title=alt.Title(f"{QUANTITIES[component][0]} residual [1]")
            )
        )
    note = "Near zero from the first half second on: noise. Above 0.3 for seconds: structure is left."
    return Drawing(alt.vconcat(*panels).properties(usermeta={"gutter": parts.GUTTER}), rows, note)


def list_autocorrelations(scene: Scene) -> dict[str, pl.DataFrame]:
    """Rows ``lag value series`` of every channel, windows that overlap left out; empty without a model."""
    motion = scene.report.motion
    if motion is None:
        return {}
    t = motion.residuals["t"].to_numpy()
    rows = {}
    for component in COMPONENTS:
        frames = []
        for series in ("ideal", "model"):
            lags, values = correlate(t, motion.residuals[f"{series}_{component}"].to_numpy())
            frames.append(pl.DataFrame({"lag": lags, "value": values}).with_columns(series=pl.lit(series)))
        rows[f"autocorrelation_{component}"] = pl.concat(frames)
    return rows


def correlate(t: Floats, residual: Floats) -> tuple[Floats, Floats]:
    """Autocorrelation over lags up to five seconds.

    Args:
        t: middles of the windows [s], increasing.
        residual: at the windows; pairs across a hole take no part.

    Returns:
        Lags [s] and correlations, both of shape (k,), the first at lag zero.
    """
    step = float(np.median(np.diff(t)))
    centred = residual - np.median(residual)
    limit = 6.0 * 1.4826 * float(np.median(np.abs(centred))) + 1e-12
    centred = np.clip(centred, -limit, limit)
    power = float(np.mean(centred**2)) + 1e-24
    lags, values = [0.0], [1.0]
    for lag in range(1, int(_LONGEST_S / step) + 1):
        if lag >= t.size:
            break
        together = np.abs(t[lag:] - t[:-lag] - lag * step) < 0.5 * step
        if together.sum() < _FEWEST // 2:
            break
        lags.append(lag * step)
        values.append(float(np.mean(centred[lag:][together] * centred[:-lag][together])) / power)
    return np.array(lags), np.array(values)


def describe_autocorrelation(scene: Scene) -> str:
    """The correlation after one second, before and after."""
    motion = scene.report.motion
    if motion is None or motion.residuals.height < _FEWEST:
        return "There is no model to draw."
    t = motion.residuals["t"].to_numpy()
    told = []
    for component in COMPONENTS:
        after = []
        for series in ("ideal", "model"):
            lags, values = correlate(t, motion.residuals[f"{series}_{component}"].to_numpy())
            after.append(float(np.interp(1.0, lags, values)))
        told.append(f"{QUANTITIES[component][0]} {after[0]:.2f} before, {after[1]:.2f} after")
    return "Autocorrelation of residuals one second apart: " + "; ".join(told) + "."


FIGURE = Figure(
    id="autocorrelation",
    title="Does what is left repeat itself?",
    section=Section.WHY,
    order=2,
    width=Width.HALF,
    draw=draw_autocorrelation,
    describe=describe_autocorrelation,
)
