"""Autocorrelation of residuals: structure that a model has left over lives for seconds, noise does not."""

from collections.abc import Callable

import polars as pl

from pipeline.core.arrays import Floats
from pipeline.identification.correlation import FEWEST, LONGEST_S, autocorrelate
from pipeline.report import theme
from pipeline.report.axes import make_axis
from pipeline.report.figures import parts
from pipeline.report.figures.figure import Drawing, Figure, Section
from pipeline.report.figures.residuals import QUANTITIES
from pipeline.report.motion_view import COMPONENTS, MotionView
from pipeline.report.scene import Scene
from pipeline.report.vega import Chart, encode_column, layer, stack

Correlation = tuple[Floats, Floats, float]


def draw(scene: Scene) -> Drawing | None:
    """A panel a channel, before and after; None without a model or with too few windows."""
    rows = list_autocorrelations(scene)
    if not rows:
        return None
    titles = {component: f"{QUANTITIES[component][0]} residual [1]" for component in COMPONENTS}
    chart = draw_correlations(scene, "autocorrelation", titles, (0.0, "time between windows [s]"))
    note = "Grey: where 95 % of white noise would stay. Outside of it for seconds: structure is left."
    return Drawing(chart, rows, note, _describe(rows))


def draw_correlations(scene: Scene, name: str, titles: dict[str, str], axis: tuple[float, str]) -> Chart:
    """A panel for each of the titles, before and after, with the bounds in grey.

    Args:
        scene: the run, with a model.
        name: of the rows, to which ``_`` and the channel are added.
        titles: of the panels, by channel.
        axis: where the lags begin [s], and what they are.
    """
    panels = []
    motion = scene.report.motion
    for component, title in titles.items():
        last = component == list(titles)[-1]
        lags = {"domain": [axis[0], LONGEST_S]}
        x = encode_column(
            "lag:Q", scale=lags, axis={"title": axis[1] if last else None, "labels": last, "grid": False}
        )
        ends, ticks = (-1.0 if axis[0] else -0.6, 1.0), [-0.5, 0, 0.5, 1]
        y = make_axis("value", None, ends, values=ticks, minExtent=parts.GUTTER - 10)
        base = Chart.of_rows(f"{name}_{component}")
        colour = parts.before_and_after(motion.input if motion else "")
        band = base.filter("datum.series === 'model'").mark("area", color=theme.SHADE, clip=True)
        zero = base.mark("rule", color=theme.QUIET, strokeWidth=0.8).encode(y={"datum": 0.0})
        line = base.mark("line", clip=True, strokeWidth=2).encode(x=x, y=y, color=colour)
        drawn = layer(band.encode(x=x, y="low:Q", y2="high:Q"), zero, line)
        panels.append(drawn.properties(width=480, height=96, title={"text": title}))
    return stack(*panels).properties(usermeta={"gutter": parts.GUTTER})


def list_autocorrelations(scene: Scene) -> dict[str, pl.DataFrame]:
    """As `list_correlations`, of residuals with themselves."""
    return list_correlations(scene, "autocorrelation", lambda _motion, _component: autocorrelate)


def list_correlations(
    scene: Scene, name: str, choose: Callable[[MotionView, str], Callable[[Floats, Floats], Correlation]]
) -> dict[str, pl.DataFrame]:
    """Rows ``lag value low high series`` of every channel; empty without a model or with too few windows.

    Args:
        scene: the run.
        name: what rows of a channel are called, before the channel.
        choose: by run and channel the correlation of residuals at times [s].
    """
    motion = scene.report.motion
    if motion is None or motion.residuals.height < FEWEST:
        return {}
    t = motion.residuals["t"].to_numpy()
    return {
        f"{name}_{component}": _tabulate_correlations(
            {
                series: choose(motion, component)(t, motion.residuals[f"{series}_{component}"].to_numpy())
                for series in ("ideal", "model")
            }
        )
        for component in COMPONENTS
    }


def _tabulate_correlations(found: dict[str, Correlation]) -> pl.DataFrame:
    """Lags, correlations and bounds by series as rows ``lag value low high series``."""
    frames = [
        pl.DataFrame({"lag": lags, "value": values}).with_columns(
            low=pl.lit(-bound), high=pl.lit(bound), series=pl.lit(series)
        )
        for series, (lags, values, bound) in found.items()
    ]
    return pl.concat(frames)


def _describe(rows: dict[str, pl.DataFrame]) -> str:
    """The correlation after one second, before and after, and the bound."""
    told = []
    for name, frame in rows.items():
        near = frame.filter((pl.col("lag") - 1.0).abs() < 0.01)  # noqa: PLR2004 - rounding
        values = dict(near.select("series", "value").iter_rows())
        after = f"{values.get('ideal', 0.0):.2f} before, {values.get('model', 0.0):.2f} after"
        told.append(f"{QUANTITIES[name[-1]][0]} {after}")
    bound = float(next(iter(rows.values()))["high"][0])
    return f"Autocorrelation of residuals one second apart: {'; '.join(told)}; noise stays below {bound:.2f}."


FIGURE = Figure("Does what is left repeat itself?", Section.WHY, draw, order=4, live=list_autocorrelations)
