"""Figures of residuals: over time, against signals, and of each effect."""

import numpy as np
import polars as pl

from pipeline.core import Floats
from pipeline.estimation.effect_signature import SINCE_STEP, VARIABLES, Signature
from pipeline.report import figures, format_known_share, format_number, theme
from pipeline.report.figures import Figure
from pipeline.report.motion_view import COMPONENTS, SIGNALS, MotionView
from pipeline.report.scene import LINE_BINS, Scene, break_lines, thin_series
from pipeline.report.theme import Chart, Drawing, layer, make_axis, stack, usual_ends


def draw_horizon_errors(scene: Scene) -> Drawing | None:
    """Draw two lines over time; None without a model."""
    motion = scene.report.motion
    if motion is None or motion.horizon_errors.is_empty():
        return None
    errors, rows = motion.horizon_errors, list_horizon_errors(scene)
    chart = figures.draw_lines(
        ["reach"],
        rows["reach"],
        usual_ends(errors["ideal"], exact=False),
        ("error of a 2 s prediction", "m"),
        figures.before_and_after(motion.input),
        x=figures.time_axis(scene),
        height=130,
    ).properties(usermeta=figures.brush_over_time())
    row = errors.row(errors["model"].arg_max() or 0, named=True)
    medians = [float(np.median(errors[name].to_numpy())) for name in ("ideal", "model")]
    words = (
        f"Error of two-second predictions over time: median {medians[0]:.3f} m for the ideal model, "
        f"{medians[1]:.3f} m for the model, which is worst, {row['model']:.2f} m, at {row['t']:.0f} s."
    )
    return Drawing(chart, rows | figures.span_rows(scene), words=words)


def list_horizon_errors(scene: Scene) -> dict[str, pl.DataFrame]:
    """Rows ``t value series``, thinned to peaks; empty without a model."""
    motion = scene.report.motion
    if motion is None:
        return {}
    lines = []
    for name in ("ideal", "model"):
        line = motion.horizon_errors.select("t", "piece", value=pl.col(name))
        thinned = thin_series(line, "value", bins=LINE_BINS)
        lines.append(break_lines(thinned, "value").with_columns(series=pl.lit(name)))
    return {"reach": pl.concat(lines)}


REACH = Figure(
    "reach", "Predictions over two seconds", draw_horizon_errors, width="full", live=list_horizon_errors
)

QUANTITIES = {"x": ("forward", "m/s"), "y": ("lateral", "m/s"), "w": ("yaw rate", "rad/s")}

_BINS = 18
_FEWEST = 12
_FEWEST_BINS = 4
_LEAST_SHARE = 0.05
_USUAL = {"x": "f_x", "y": "f_x_f_w", "w": "f_w"}
_QUARTILES = (0.25, 0.5, 0.75)


def draw_residuals(scene: Scene) -> Drawing | None:
    """Draw a panel per channel: median and quartiles of the residual by signal; None without a model."""
    motion = scene.report.motion
    if motion is None or motion.residuals.is_empty():
        return None
    rows = list_residuals(scene)
    panels = [_draw_panel(motion, component, rows[f"residual_{component}"]) for component in COMPONENTS]
    chart = stack(*panels).properties(usermeta={"gutter": figures.GUTTER})
    note = "Lines: medians; bands: interquartile range. A line along zero means no dependence on that signal."
    return Drawing(chart, rows, note, _format_residuals(motion))


def list_residuals(scene: Scene) -> dict[str, pl.DataFrame]:
    """Rows ``value low middle high series`` of every channel, in bins of equal width."""
    motion = scene.report.motion
    if motion is None:
        return {}
    return {f"residual_{component}": _bin_residuals(motion, component) for component in COMPONENTS}


def choose_signal(motion: MotionView, component: str) -> str:
    """Signal whose bins explain most of the ideal model's residual; the default if none does."""
    residual = motion.residuals[f"ideal_{component}"].to_numpy()
    shares = {
        name: _explain(motion.residuals[name].to_numpy(), residual)
        for name in SIGNALS
        if name in motion.residuals.columns
    }
    best = max(shares, key=lambda name: shares[name])
    return best if shares[best] > _LEAST_SHARE else _USUAL[component]


def _explain(signal: Floats, residual: Floats) -> float:
    """Relative reduction of a residual's mean absolute value by subtracting each bin's median."""
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
    """Inner edges of bins of equal width, with outliers in the outer bins; empty for a constant."""
    low, high = np.quantile(signal, (0.005, 0.995)).tolist()
    if not high - low > 1e-9:  # noqa: PLR2004 - no width at all
        return np.zeros(0)
    edges: Floats = np.linspace(low, high, _BINS + 1)[1:-1]
    return edges


def _bin_residuals(motion: MotionView, component: str) -> pl.DataFrame:
    signal = motion.residuals[choose_signal(motion, component)].to_numpy()
    number = np.searchsorted(_find_edges(signal), signal, side="right")
    rows = [
        (float(np.median(signal[inside])), *np.quantile(residual[inside], _QUARTILES).tolist(), series)
        for series in ("ideal", "model")
        for residual in [motion.residuals[f"{series}_{component}"].to_numpy()]
        for inside in (number == each for each in np.flatnonzero(np.bincount(number) >= _FEWEST))
    ]
    schema = {**dict.fromkeys(("value", "low", "middle", "high"), pl.Float64), "series": pl.String}
    return pl.DataFrame(rows, schema=schema, orient="row")


def _draw_panel(motion: MotionView, component: str, rows: pl.DataFrame) -> Chart:
    what, unit = QUANTITIES[component]
    signal, signal_unit = VARIABLES[choose_signal(motion, component)]
    before = rows.filter(pl.col("series") == "ideal")
    size = max(abs(float(before["low"].min() or 0.0)), abs(float(before["high"].max() or 0.0)), 1e-3)  # type: ignore[arg-type]
    x = make_axis("value", f"{signal} [{signal_unit}]", tickCount=6)
    ends = (-1.1 * size, 1.1 * size)
    y = make_axis("middle", None, ends, tickCount=3, minExtent=figures.GUTTER - 10)
    colour = figures.before_and_after(motion.input)
    base = Chart.of_rows(f"residual_{component}")
    band = base.mark("area", opacity=0.16, clip=True).encode(x=x, y="low:Q", y2="high:Q", color=colour)
    line = base.mark("line", clip=True, strokeWidth=2, point={"size": 18}).encode(x=x, y=y, color=colour)
    zero = base.mark("rule", color=theme.QUIET, strokeWidth=0.8).encode(y={"datum": 0.0})
    return layer(zero, band, line).properties(
        width=480, height=96, title={"text": f"{what} residual [{unit}]"}
    )


def _format_residuals(motion: MotionView) -> str:
    """Signal that explains each channel, and the spread before and after."""
    sentences = []
    for component in COMPONENTS:
        what, unit = QUANTITIES[component]
        sizes = [
            float(np.sqrt(np.mean(motion.residuals[f"{series}_{component}"].to_numpy() ** 2)))
            for series in ("ideal", "model")
        ]
        signal = VARIABLES[choose_signal(motion, component)][0]
        sentences.append(
            f"{what} over {signal}, root mean square {sizes[0]:.3f} before, {sizes[1]:.3f} {unit} after"
        )
    return "Residuals against the signal that explains most of them: " + "; ".join(sentences) + "."


RESIDUALS = Figure(
    "residuals", "Residual against the signal that explains most of it", draw_residuals, live=list_residuals
)

_SERIES = {"before": "error without it", "after": "with it", "curve": "its effect"}


def draw_signatures(scene: Scene) -> dict[str, Drawing]:
    """One panel per effect, by its id; empty without a model."""
    motion = scene.report.motion
    if motion is None:
        return {}
    colour = theme.INPUT_COLOURS.get(motion.input, theme.QUIET)
    return {one.effect: _draw_signature(one, colour) for one in motion.signatures}


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


def _draw_signature(signature: Signature, colour: str) -> Drawing:
    what, unit = QUANTITIES[signature.channel]
    variable, variable_unit = VARIABLES[signature.variable]
    share = signature.variable == SINCE_STEP
    error = f"{what} error, share of the step" if share else f"{what} error [{unit}]"
    colours = {"before": colour, "after": theme.MODEL, "curve": theme.INK}
    shade = figures.series_colour(_SERIES, colours, "circle")
    wide, tall = {"zero": False, "nice": False, "padding": 8}, {"nice": False, "padding": 12}
    x = make_axis("value", f"{variable} [{variable_unit}]", scale=wide, tickCount=6, grid=False)
    y = make_axis("mean", None, scale=tall, tickCount=5, minExtent=figures.GUTTER - 10)
    base = Chart.of_rows(_name_rows(signature))
    zero = base.mark("rule", color=theme.QUIET, strokeWidth=0.8).encode(y={"datum": 0.0})
    measured = base.filter("datum.series !== 'curve'")
    bars = measured.mark("rule", strokeWidth=1.2).encode(x=x, y="low:Q", y2="high:Q", color=shade)
    points = measured.mark("circle", size=42, opacity=1).encode(x=x, y=y, color=shade)
    curve = base.filter("datum.series === 'curve'").mark("line", strokeWidth=1.8, order=False)
    chart = layer(zero, curve.encode(x=x, y=y, color=shade), bars, points).properties(
        width=480, height=170, title={"text": error}, usermeta={"gutter": figures.GUTTER}
    )
    before, after = (
        format_number(float(np.sqrt(np.mean(values**2)))) for values in (signature.before, signature.after)
    )
    return Drawing(
        chart,
        {_name_rows(signature): _tabulate(signature)},
        f"{format_known_share(signature.explained)} of its effect follows from the {variable} alone.",
        f"{error} against {variable} [{variable_unit}], in {signature.value.size} bins: root mean square "
        f"{before} without {signature.effect}, {after} with it.",
    )


SIGNATURE = Figure("signature", "Each effect: model and measurement", draw_signatures, live=list_signatures)
