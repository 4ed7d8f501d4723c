"""Residuals against the signal that explains them, before and after the model's effects."""

import numpy as np
import polars as pl

from pipeline.core.arrays import Floats
from pipeline.report import theme
from pipeline.report.axes import make_axis
from pipeline.report.figures import parts
from pipeline.report.figures.figure import Drawing, Figure, Section
from pipeline.report.motion_view import COMPONENTS, SIGNALS, MotionView
from pipeline.report.scene import Scene
from pipeline.report.vega import Chart, layer, stack

QUANTITIES = {"x": ("forward", "m/s"), "y": ("sideways", "m/s"), "w": ("yaw rate", "rad/s")}

_BINS = 18
_FEWEST = 12
_FEWEST_BINS = 4
_LEAST_SHARE = 0.05
_USUAL = {"x": "f_x", "y": "f_x_f_w", "w": "f_w"}
_QUARTILES = (0.25, 0.5, 0.75)


def draw(scene: Scene) -> Drawing | None:
    """A panel a channel: median and quartiles of the residual over its signal; None without a model."""
    motion = scene.report.motion
    if motion is None or motion.residuals.is_empty():
        return None
    rows = list_residuals(scene)
    panels = [_draw_panel(motion, component, rows[f"residual_{component}"]) for component in COMPONENTS]
    chart = stack(*panels).resolve_scale(x="independent", y="independent")
    note = (
        "Lines: medians; bands: the middle half. A line along zero leaves nothing to explain by that signal."
    )
    return Drawing(chart.properties(usermeta={"gutter": parts.GUTTER}), rows, note, _describe(motion))


def list_residuals(scene: Scene) -> dict[str, pl.DataFrame]:
    """Rows ``value low middle high series`` of every channel, in bins of equal counts."""
    motion = scene.report.motion
    if motion is None:
        return {}
    return {f"residual_{component}": _bin_residuals(motion, component) for component in COMPONENTS}


def choose_signal(motion: MotionView, component: str) -> str:
    """The signal whose bins explain most of the ideal model's residual; the usual one where none does."""
    residual = motion.residuals[f"ideal_{component}"].to_numpy()
    shares = {
        name: _explain(motion.residuals[name].to_numpy(), residual)
        for name in SIGNALS
        if name in motion.residuals.columns
    }
    best = max(shares, key=lambda name: shares[name])
    return best if shares[best] > _LEAST_SHARE else _USUAL[component]


def _explain(signal: Floats, residual: Floats) -> float:
    """Share of the spread of a residual that goes when each bin's median is taken off."""
    number = np.searchsorted(_find_edges(signal), signal, side="right")
    filled = np.flatnonzero(np.bincount(number) >= _FEWEST)
    if filled.size < _FEWEST_BINS:
        return 0.0
    rest = residual.copy()
    for each in filled:
        rest[number == each] -= np.median(residual[number == each])
    before = float(np.abs(residual).mean())
    return 1.0 - float(np.abs(rest).mean()) / before if before > 0.0 else 0.0


def _find_edges(signal: Floats) -> Floats:
    """Inner edges of bins of equal width, lone extremes in the outer ones; none for a constant."""
    low, high = np.quantile(signal, (0.005, 0.995)).tolist()
    if not high - low > 1e-9:  # noqa: PLR2004 - no width at all
        return np.zeros(0)
    edges: Floats = np.linspace(low, high, _BINS + 1)[1:-1]
    return edges


def _bin_residuals(motion: MotionView, component: str) -> pl.DataFrame:
    signal = motion.residuals[choose_signal(motion, component)].to_numpy()
    number = np.searchsorted(_find_edges(signal), signal, side="right")
    rows = []
    for series in ("ideal", "model"):
        residual = motion.residuals[f"{series}_{component}"].to_numpy()
        for each in np.unique(number):
            inside = number == each
            if inside.sum() < _FEWEST:
                continue
            low, middle, high = np.quantile(residual[inside], _QUARTILES).tolist()
            rows.append(
                {
                    "value": float(np.median(signal[inside])),
                    "low": low,
                    "middle": middle,
                    "high": high,
                    "series": series,
                }
            )
    schema = {**dict.fromkeys(("value", "low", "middle", "high"), pl.Float64), "series": pl.String}
    return pl.DataFrame(rows, schema=schema)


def _draw_panel(motion: MotionView, component: str, rows: pl.DataFrame) -> Chart:
    what, unit = QUANTITIES[component]
    signal, signal_unit = SIGNALS[choose_signal(motion, component)]
    before = rows.filter(pl.col("series") == "ideal")
    size = max(abs(float(before["low"].min() or 0.0)), abs(float(before["high"].max() or 0.0)), 1e-3)  # type: ignore[arg-type]
    x = make_axis("value", f"{signal} [{signal_unit}]", tickCount=6)
    ends = (-1.1 * size, 1.1 * size)
    y = make_axis("middle", None, ends, tickCount=3, minExtent=parts.GUTTER - 10)
    colour = parts.before_and_after(motion.input)
    base = Chart.of_rows(f"residual_{component}")
    band = base.mark("area", opacity=0.16, clip=True).encode(x=x, y="low:Q", y2="high:Q", color=colour)
    line = base.mark("line", clip=True, strokeWidth=2, point={"size": 18}).encode(x=x, y=y, color=colour)
    zero = base.mark("rule", color=theme.QUIET, strokeWidth=0.8).encode(y={"datum": 0.0})
    return layer(zero, band, line).properties(
        width=480, height=96, title={"text": f"{what} residual [{unit}]"}
    )


def _describe(motion: MotionView) -> str:
    """Which signal explains which channel, and the spread before and after."""
    told = []
    for component in COMPONENTS:
        what, unit = QUANTITIES[component]
        sizes = [
            float(np.sqrt(np.mean(motion.residuals[f"{series}_{component}"].to_numpy() ** 2)))
            for series in ("ideal", "model")
        ]
        signal = SIGNALS[choose_signal(motion, component)][0]
        told.append(
            f"{what} over {signal}, root mean square {sizes[0]:.3f} before, {sizes[1]:.3f} {unit} after"
        )
    return "Residuals against the signal that explains most of them: " + "; ".join(told) + "."


FIGURE = Figure(
    "What is left, against the signal that explains it", Section.WHY, draw, order=2, live=list_residuals
)
