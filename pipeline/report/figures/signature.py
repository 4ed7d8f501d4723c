"""The signature of each effect: the residual without and with it, against the variable that it acts on."""

import numpy as np
import polars as pl

from pipeline.identification.signature import SINCE_STEP, VARIABLES, Signature
from pipeline.report import theme
from pipeline.report.axes import make_axis
from pipeline.report.figures import parts
from pipeline.report.figures.figure import Drawing, Figure, Section
from pipeline.report.figures.residuals import QUANTITIES
from pipeline.report.scene import Scene
from pipeline.report.vega import Chart, encode_column, layer, stack
from pipeline.report.words import say_number, say_share

_SERIES = {"before": "error without it", "after": "with it", "curve": "what it does"}


def draw(scene: Scene) -> Drawing | None:
    """All effects below each other; None without a model, or of one without effects."""
    panels = list_panels(scene)
    if not panels:
        return None
    chart = stack(*(panel.chart for panel in panels.values())).resolve_scale(x="independent")
    note, words = (
        "Error bars: 95 % between blocks of ten seconds.",
        [panel.words for panel in panels.values()],
    )
    chart = chart.properties(usermeta={"gutter": parts.GUTTER})
    return Drawing(chart, list_signatures(scene), note, " ".join(words))


def list_panels(scene: Scene) -> dict[str, Drawing]:
    """A panel an effect, by its id; empty without a model."""
    motion = scene.report.motion
    if motion is None:
        return {}
    colour = theme.INPUT_COLOURS.get(motion.input, theme.QUIET)
    return {
        one.effect: Drawing(
            _draw_panel(one, colour), {_name_rows(one): _tabulate(one)}, _note(one), _describe(one)
        )
        for one in motion.signatures
    }


def list_signatures(scene: Scene) -> dict[str, pl.DataFrame]:
    """Rows ``value mean low high series`` of every effect; empty without a model."""
    motion = scene.report.motion
    return {} if motion is None else {_name_rows(one): _tabulate(one) for one in motion.signatures}


def _name_rows(signature: Signature) -> str:
    return f"signature_{signature.effect}"


def _tabulate(signature: Signature) -> pl.DataFrame:
    nothing = np.full(signature.value.size, np.nan)
    series = {
        "curve": (signature.curve, nothing),
        "before": (signature.before, signature.before_error),
        "after": (signature.after, signature.after_error),
    }
    return pl.concat(
        pl.DataFrame(
            {"value": signature.value, "mean": mean, "low": mean - error, "high": mean + error}
        ).with_columns(pl.col("low", "high").fill_nan(None), series=pl.lit(name))
        for name, (mean, error) in series.items()
    )


def _name_axes(signature: Signature) -> tuple[str, str]:
    """The variable and the residual, in words with units."""
    what, unit = QUANTITIES[signature.channel]
    variable, own_unit = VARIABLES[signature.variable]
    error = (
        f"{what} error, share of the step [1]"
        if signature.variable == SINCE_STEP
        else f"{what} error [{unit}]"
    )
    return f"{variable} [{own_unit}]", error


def _draw_panel(signature: Signature, colour: str) -> Chart:
    variable, error = _name_axes(signature)
    scale = {"domain": list(_SERIES), "range": [colour, theme.MODEL, theme.INK]}
    label = " : ".join(f"datum.value === '{name}' ? '{words}'" for name, words in _SERIES.items())
    legend = {"title": None, "labelExpr": f"{label} : datum.value", "symbolType": "circle", "symbolSize": 60}
    shade = encode_column("series:N", scale=scale, legend=legend)
    wide = {"zero": False, "nice": False, "padding": 8}
    x = make_axis("value", variable, scale=wide, tickCount=6, grid=False)
    tall = {"nice": False, "padding": 12}
    y = make_axis("mean", None, scale=tall, tickCount=5, minExtent=parts.GUTTER - 10)
    base = Chart.of_rows(_name_rows(signature))
    zero = base.mark("rule", color=theme.QUIET, strokeWidth=0.8).encode(y={"datum": 0.0})
    measured = base.filter("datum.series !== 'curve'")
    bars = measured.mark("rule", strokeWidth=1.2).encode(x=x, y="low:Q", y2="high:Q", color=shade)
    points = measured.mark("circle", size=42, opacity=1).encode(x=x, y=y, color=shade)
    curve = base.filter("datum.series === 'curve'").mark("line", strokeWidth=1.8, order=False)
    return layer(zero, curve.encode(x=x, y=y, color=shade), bars, points).properties(
        width=480, height=170, title={"text": error}, usermeta={"gutter": parts.GUTTER}
    )


def _note(signature: Signature) -> str:
    variable = VARIABLES[signature.variable][0]
    return f"{say_share(signature.explained)} of what it does is a function of the {variable}."


def _describe(signature: Signature) -> str:
    variable, error = _name_axes(signature)
    sizes = [say_number(float(np.sqrt(np.mean(values**2)))) for values in (signature.before, signature.after)]
    return (
        f"{error} against {variable}, in {signature.value.size} bins: root mean square {sizes[0]} without "
        f"{signature.effect}, {sizes[1]} with it."
    )


_TITLE = "What each effect does, and what was measured of it"
FIGURE = Figure(_TITLE, Section.EFFECT, draw, order=0, panels=list_panels, live=list_signatures)
