"""Figures of residuals: against signals, their own past, the input, and each effect."""

from collections.abc import Callable

import numpy as np
import polars as pl

from pipeline.core import Floats
from pipeline.estimation.effect_signature import (
    FEWEST,
    LONGEST_S,
    SINCE_STEP,
    VARIABLES,
    Signature,
    autocorrelate,
    cross_correlate,
)
from pipeline.report import figures, format_known_share, format_number, theme
from pipeline.report.figures import Figure, Section
from pipeline.report.motion_view import COMPONENTS, SIGNALS, MotionView
from pipeline.report.scene import LINE_BINS, Scene, break_lines, thin_series
from pipeline.report.theme import (
    Chart,
    Drawing,
    encode_column,
    find_range,
    layer,
    make_axis,
    stack,
    usual_ends,
)


def draw_horizon_errors(scene: Scene) -> Drawing | None:
    """Draw two lines over time; None without a model."""
    motion = scene.report.motion
    if motion is None or motion.horizon_errors.is_empty():
        return None
    rows = list_horizon_errors(scene)
    ends = usual_ends(motion.horizon_errors["ideal"], exact=False)
    shown = find_range(rows["reach"], (ends[0], ends[1]))
    colour = figures.before_and_after(motion.input)
    chart = figures.draw_lines(scene, ["reach"], shown, colour).properties(
        height=130,
        title=figures.title_panel("error of a 2 s prediction", "m", shown),
        usermeta=figures.brush_over_time(),
    )
    row = motion.horizon_errors.row(motion.horizon_errors["model"].arg_max() or 0, named=True)
    medians = [float(motion.horizon_errors[name].median() or 0.0) for name in ("ideal", "model")]  # type: ignore[arg-type]
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
    "Predictions over two seconds",
    Section.REST,
    draw_horizon_errors,
    order=6,
    width="full",
    live=list_horizon_errors,
    id="reach",
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
    chart = stack(*panels).resolve_scale(x="independent", y="independent")
    note = "Lines: medians; bands: interquartile range. A line along zero means no dependence on that signal."
    return Drawing(
        chart.properties(usermeta={"gutter": figures.GUTTER}), rows, note, _format_residuals(motion)
    )


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
    "Residual against the signal that explains most of it",
    Section.REST,
    draw_residuals,
    order=2,
    live=list_residuals,
    id="residuals",
)

Correlation = tuple[Floats, Floats, float]


def draw_autocorrelation(scene: Scene) -> Drawing | None:
    """Draw a panel per channel, before and after; None without a model or with too few windows."""
    rows = list_autocorrelations(scene)
    if not rows:
        return None
    titles = {component: f"{QUANTITIES[component][0]} residual" for component in COMPONENTS}
    chart = draw_correlations(scene, "autocorrelation", titles, (0.0, "time between windows [s]"))
    note = "Grey: 95 % band of white noise. A curve outside of it for seconds shows unmodelled structure."
    return Drawing(chart, rows, note, _format_autocorrelation(rows))


def draw_correlations(scene: Scene, name: str, titles: dict[str, str], axis: tuple[float, str]) -> Chart:
    """Draw a panel for each title, before and after, with the confidence bounds in grey.

    Args:
        scene: the run, with a model.
        name: name of the rows, to which ``_`` and the channel are appended.
        titles: titles of the panels, by channel.
        axis: first lag [s], and title of the axis.
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
        y = make_axis("value", None, ends, values=ticks, minExtent=figures.GUTTER - 10)
        base = Chart.of_rows(f"{name}_{component}")
        colour = figures.before_and_after(motion.input if motion else "")
        band = base.filter("datum.series === 'model'").mark("area", color=theme.SHADE, clip=True)
        zero = base.mark("rule", color=theme.QUIET, strokeWidth=0.8).encode(y={"datum": 0.0})
        line = base.mark("line", clip=True, strokeWidth=2).encode(x=x, y=y, color=colour)
        drawn = layer(band.encode(x=x, y="low:Q", y2="high:Q"), zero, line)
        panels.append(drawn.properties(width=480, height=96, title={"text": title}))
    return stack(*panels).properties(usermeta={"gutter": figures.GUTTER})


def list_autocorrelations(scene: Scene) -> dict[str, pl.DataFrame]:
    """As `list_correlations`, for the autocorrelation of residuals."""
    return list_correlations(scene, "autocorrelation", lambda _motion, _component: autocorrelate)


def list_correlations(
    scene: Scene, name: str, choose: Callable[[MotionView, str], Callable[[Floats, Floats], Correlation]]
) -> dict[str, pl.DataFrame]:
    """Rows ``lag value low high series`` of every channel; empty without a model or with too few windows.

    Args:
        scene: the run.
        name: prefix of the row names, before the channel.
        choose: function from run and channel to the correlation of residuals at times [s].
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


def _tabulate_correlations(correlations: dict[str, Correlation]) -> pl.DataFrame:
    """Lags, correlations and bounds by series as rows ``lag value low high series``."""
    frames = [
        pl.DataFrame({"lag": lags, "value": values}).with_columns(
            low=pl.lit(-bound), high=pl.lit(bound), series=pl.lit(series)
        )
        for series, (lags, values, bound) in correlations.items()
    ]
    return pl.concat(frames)


def _format_autocorrelation(rows: dict[str, pl.DataFrame]) -> str:
    """The correlation at the lag nearest to one second, before and after, and the bound."""
    parts, lag = [], 0.0
    for name, frame in rows.items():
        later = frame.filter(pl.col("lag") > 0.0)
        if later.is_empty():
            continue
        lag = float(later["lag"][int((later["lag"] - 1.0).abs().arg_min() or 0)])
        values = dict(later.filter(pl.col("lag") == lag).select("series", "value").iter_rows())
        parts.append(f"{QUANTITIES[name[-1]][0]} {values['ideal']:.2f} before, {values['model']:.2f} after")
    if not parts:
        return ""
    bound = float(next(iter(rows.values()))["high"][0])
    return (
        f"Autocorrelation of residuals {lag:.2g} s apart: {'; '.join(parts)}; noise stays below {bound:.2f}."
    )


AUTOCORRELATION = Figure(
    "Autocorrelation of the residual",
    Section.REST,
    draw_autocorrelation,
    order=4,
    live=list_autocorrelations,
    id="autocorrelation",
)

_WORDS = {"f_x": "speed", "f_y": "lateral speed", "f_w": "yaw rate", "f_x_f_w": "speed \u00d7 yaw rate"}


def draw_crosscorrelation(scene: Scene) -> Drawing | None:
    """Draw a panel per channel, before and after; None without a model or with too few windows."""
    rows, motion = list_crosscorrelations(scene), scene.report.motion
    if not rows or motion is None:
        return None
    inputs = choose_inputs(motion)
    titles = {one: f"{QUANTITIES[one][0]} residual with {_WORDS[inputs[one]]}" for one in inputs}
    axis = (-LONGEST_S, "lag of the residual behind the input [s]")
    note = "Grey: 95 % band without correlation. Positive times: the input precedes the residual."
    return Drawing(
        draw_correlations(scene, "crosscorrelation", titles, axis),
        rows,
        note,
        _format_crosscorrelation(rows),
    )


def choose_inputs(motion: MotionView) -> dict[str, str]:
    """Input to correlate with each channel's residual; for the lateral one that of turning while driving."""
    moves_aside = bool(motion.residuals["f_y"].abs().max() or 0.0)
    return {"x": "f_x", "y": "f_y" if moves_aside else "f_x_f_w", "w": "f_w"}


def list_crosscorrelations(scene: Scene) -> dict[str, pl.DataFrame]:
    """As `list_correlations`, for the correlation of residuals with the input."""
    return list_correlations(
        scene,
        "crosscorrelation",
        lambda motion, component: (
            lambda t, residual: cross_correlate(
                t, motion.residuals[choose_inputs(motion)[component]].to_numpy(), residual
            )
        ),
    )


def _format_crosscorrelation(rows: dict[str, pl.DataFrame]) -> str:
    """Largest correlation with the input, before and after."""
    sentences = []
    for name, frame in rows.items():
        most = dict(frame.group_by("series").agg(pl.col("value").abs().max()).iter_rows())
        bound = float(frame.filter(pl.col("series") == "model")["high"][0])
        words = f"{most['ideal']:.2f} before, {most['model']:.2f} after, bound {bound:.2f}"
        sentences.append(f"{QUANTITIES[name[-1]][0]} {words}")
    return f"Largest correlation of residuals with the input within five seconds: {'; '.join(sentences)}."


CROSSCORRELATION = Figure(
    "Cross-correlation of the residual with the input",
    Section.REST,
    draw_crosscorrelation,
    order=5,
    id="crosscorrelation",
)

_SERIES = {"before": "error without it", "after": "with it", "curve": "its effect"}


def list_panels(scene: Scene) -> dict[str, Drawing]:
    """One panel per effect, by its id; empty without a model."""
    motion = scene.report.motion
    if motion is None:
        return {}
    colour = theme.INPUT_COLOURS.get(motion.input, theme.QUIET)
    return {
        one.effect: Drawing(
            _draw_panel_of_signature(one, colour),
            {_name_rows(one): _tabulate(one)},
            _note(one),
            _format_signature(one),
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
    """Variable and residual, in words with units."""
    what, unit = QUANTITIES[signature.channel]
    variable, own_unit = VARIABLES[signature.variable]
    error = (
        f"{what} error, share of the step" if signature.variable == SINCE_STEP else f"{what} error [{unit}]"
    )
    return f"{variable} [{own_unit}]", error


def _draw_panel_of_signature(signature: Signature, colour: str) -> Chart:
    variable, error = _name_axes(signature)
    scale = {"domain": list(_SERIES), "range": [colour, theme.MODEL, theme.INK]}
    label = " : ".join(f"datum.value === '{name}' ? '{words}'" for name, words in _SERIES.items())
    legend = {"title": None, "labelExpr": f"{label} : datum.value", "symbolType": "circle", "symbolSize": 60}
    shade = encode_column("series:N", scale=scale, legend=legend)
    wide = {"zero": False, "nice": False, "padding": 8}
    x = make_axis("value", variable, scale=wide, tickCount=6, grid=False)
    tall = {"nice": False, "padding": 12}
    y = make_axis("mean", None, scale=tall, tickCount=5, minExtent=figures.GUTTER - 10)
    base = Chart.of_rows(_name_rows(signature))
    zero = base.mark("rule", color=theme.QUIET, strokeWidth=0.8).encode(y={"datum": 0.0})
    measured = base.filter("datum.series !== 'curve'")
    bars = measured.mark("rule", strokeWidth=1.2).encode(x=x, y="low:Q", y2="high:Q", color=shade)
    points = measured.mark("circle", size=42, opacity=1).encode(x=x, y=y, color=shade)
    curve = base.filter("datum.series === 'curve'").mark("line", strokeWidth=1.8, order=False)
    return layer(zero, curve.encode(x=x, y=y, color=shade), bars, points).properties(
        width=480, height=170, title={"text": error}, usermeta={"gutter": figures.GUTTER}
    )


def _note(signature: Signature) -> str:
    variable = VARIABLES[signature.variable][0]
    return f"{format_known_share(signature.explained)} of its effect is a function of the {variable}."


def _format_signature(signature: Signature) -> str:
    variable, error = _name_axes(signature)
    sizes = [
        format_number(float(np.sqrt(np.mean(values**2)))) for values in (signature.before, signature.after)
    ]
    return (
        f"{error} against {variable}, in {signature.value.size} bins: root mean square {sizes[0]} without "
        f"{signature.effect}, {sizes[1]} with it."
    )


_TITLE = "Each effect: model and measurement"
SIGNATURE = Figure(
    _TITLE, Section.EFFECT, None, order=0, panels=list_panels, live=list_signatures, id="signature"
)
