"""Figures of slip, velocities, predictions and power over time, and distributions of slip."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.core.program import INPUT_WORDS
from pipeline.report import theme
from pipeline.report.figures import figure
from pipeline.report.figures.figure import Drawing, Figure, Section, draw_shares
from pipeline.report.scene import (
    COMPONENTS,
    LINE_BINS,
    Scene,
    Thinned,
    break_lines,
    drop_flat_rows,
    thin_series,
    thin_to_peaks,
)
from pipeline.report.templating import format_number
from pipeline.report.theme import Chart, encode_column, find_range, layer, stack, usual_ends


def draw_modulus(scene: Scene) -> Drawing | None:
    """Draw one line per input; gaps are open, stretches after a change of command shaded."""
    lines = scene.modulus_lines
    if lines is None:
        return None
    shown = find_range(lines.frame, lines.usual)
    colour = figure.series_colour(list(scene.slip), INPUT_WORDS)
    chart = figure.draw_lines(scene, ["modulus"], shown, colour).properties(
        height=150,
        title=figure.title_panel("slip speed", "m/s", shown),
        usermeta=figure.brush_over_time(),
    )
    note = figure.format_thinning(lines, rule="first, last, lowest and highest of every bin")
    rows = {"modulus": lines.frame} | figure.span_rows(scene)
    return Drawing(chart, rows, f"{figure.format_bands(scene)} {note}".strip(), _format_slip(scene))


def _format_slip(scene: Scene) -> str:
    """Median, maximum and its time for each input."""
    sentences = []
    for name, frame in scene.sound_slip.items():
        row = frame.row(frame["modulus"].arg_max() or 0, named=True)
        sentences.append(
            f"{INPUT_WORDS[name]} its median is {format_number(scene.median_modulus(name))} m/s "
            f"and it is highest, {row['modulus']:.2f} m/s, at {row['t']:.0f} s"
        )
    return "Slip speed over time: " + "; ".join(sentences) + "."


MODULUS = Figure("Slip over time", Section.HOW_BAD, draw_modulus, order=10, width="full", id="modulus")


_QUANTITIES = {
    "x": ("forward velocity v_x", "m/s"),
    "y": ("sideways velocity v_y, left positive", "m/s"),
    "w": ("yaw rate v_w, left positive", "rad/s"),
}


def draw_velocities(scene: Scene) -> Drawing | None:
    """Draw three panels over one time axis: measured, ideal from commands, ideal from wheel encoders."""
    lines = {component: scene.component_lines(component) for component in COMPONENTS}
    there = {component: line for component, line in lines.items() if line is not None}
    if not there:
        return None
    chart = stack(*(_draw_panel(scene, component, line) for component, line in there.items()))
    rows = {f"velocity_{component}": line.frame for component, line in there.items()} | model_rows(scene)
    note = figure.format_thinning(*there.values(), rule="first, last, lowest and highest of every bin")
    # Initially the page shows only the worst stretch.
    window = {} if scene.worst_span is None else {"window": list(scene.worst_span)}
    return Drawing(
        chart.properties(usermeta=figure.brush_over_time() | window),
        rows | figure.span_rows(scene),
        f"{figure.format_bands(scene)} {note}".strip(),
        _format_velocities(scene),
    )


def _draw_panel(scene: Scene, component: str, lines: Thinned) -> Chart:
    shown = find_range(lines.frame, lines.usual)
    title = figure.title_panel(*_QUANTITIES[component], shown)
    last = component == COMPONENTS[-1]
    series = [*scene.slip, "velocity", *(["model"] if scene.report.motion else [])]
    names = [f"velocity_{component}", *([f"model_{component}"] if scene.report.motion else [])]
    colour = figure.series_colour(series, figure.SERIES_WORDS)
    x = figure.time_axis(scene) if last else figure.time_axis(scene, title=None)
    return figure.draw_lines(scene, names, shown, colour, x).properties(height=118, title=title)


def model_rows(scene: Scene) -> dict[str, pl.DataFrame]:
    """The model's velocity by component, thinned: ``t value series``; empty without a model."""
    motion = scene.report.motion
    if motion is None:
        return {}
    rows = {}
    for component in COMPONENTS:
        line = motion.velocity.select("t", "piece", value=pl.col(f"v_{component}"))
        thinned = thin_series(drop_flat_rows(line, "value"), "value", bins=LINE_BINS, whole=scene.worst_span)
        rows[f"model_{component}"] = break_lines(thinned, "value").with_columns(series=pl.lit("model"))
    return rows


def _format_velocities(scene: Scene) -> str:
    """Names of the lines and their root mean square distance."""
    words = [figure.SERIES_WORDS[name] for name in scene.slip]
    return (
        "Forward velocity, sideways velocity and yaw rate over time in three panels: measured"
        + "".join(f", {word}" for word in words)
        + (", model" if scene.report.motion else "")
        + ". The distance between a line and the measured one is the slip in that direction."
    )


VELOCITIES = Figure(
    "Velocities: measured against ideal",
    Section.WHERE,
    draw_velocities,
    order=30,
    width="full",
    live=model_rows,
    id="velocities",
)


def draw_horizon_errors(scene: Scene) -> Drawing | None:
    """Draw two lines over time; None without a model."""
    motion = scene.report.motion
    if motion is None or motion.horizon_errors.is_empty():
        return None
    rows = list_horizon_errors(scene)
    ends = usual_ends(motion.horizon_errors["ideal"], exact=False)
    shown = find_range(rows["reach"], (ends[0], ends[1]))
    colour = figure.before_and_after(motion.input)
    chart = figure.draw_lines(scene, ["reach"], shown, colour).properties(
        height=130,
        title=figure.title_panel("error of a 2 s prediction", "m", shown),
        usermeta=figure.brush_over_time(),
    )
    row = motion.horizon_errors.row(motion.horizon_errors["model"].arg_max() or 0, named=True)
    medians = [float(motion.horizon_errors[name].median() or 0.0) for name in ("ideal", "model")]  # type: ignore[arg-type]
    words = (
        f"Error of two-second predictions over time: median {medians[0]:.3f} m for the ideal model, "
        f"{medians[1]:.3f} m for the model, which is worst, {row['model']:.2f} m, at {row['t']:.0f} s."
    )
    return Drawing(chart, rows | figure.span_rows(scene), words=words)


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
    Section.WHY,
    draw_horizon_errors,
    order=6,
    width="full",
    live=list_horizon_errors,
    id="reach",
)


_BINS = 600


def draw_navigator(scene: Scene) -> Drawing | None:
    """Draw slip speed over the whole run, and the visible stretch; None for a short run."""
    slip, span = scene.main_slip, scene.worst_span
    if slip is None or span is None:
        return None
    peaks = thin_to_peaks(slip.select("t", "piece", "modulus"), "modulus", bins=_BINS)
    x = figure.time_axis(scene)
    y = encode_column("modulus:Q", scale={"domain": [0.0, scene.modulus_cap], "nice": False}, axis=None)
    area = Chart.of_rows("navigator").mark("area", color=theme.CROSS, opacity=0.6, clip=True, order=False)
    window = Chart.of_rows(figure.SHOWN_SPAN).mark("rect", color=theme.MARK, opacity=0.35)
    chart = layer(area.encode(x=x, y=y), window.encode(x="t_start:Q", x2="t_end:Q")).properties(
        width=figure.WIDTH, height=44, usermeta={"brush": "zoom", "gutter": 4}
    )
    rows = {
        "navigator": break_lines(peaks, "modulus"),
        figure.SHOWN_SPAN: pl.DataFrame({"t_start": [span[0]], "t_end": [span[1]]}),
    }
    length = span[1] - span[0]
    note = f"Drawn large below: the {length:g} s with the most slip. Drag over the strip to draw others."
    words = (
        f"Slip speed {INPUT_WORDS[scene.report.main_input]} over the whole run. It is highest between "
        f"{span[0]:.0f} s and {span[1]:.0f} s, which the figure below draws large; "
        "arrow keys move the stretch."
    )
    return Drawing(chart, rows, note, words)


NAVIGATOR = Figure("The whole run", Section.WHERE, draw_navigator, order=29, width="full", id="navigator")


def draw_distribution(scene: Scene) -> Drawing | None:
    """Draw the share of time steps below each modulus."""
    if not scene.sound_slip:
        return None
    values = {name: frame["modulus"] for name, frame in scene.sound_slip.items()}
    return draw_shares("modulus_shares", values, "slip speed", of=" of a time step")


DISTRIBUTION = Figure(
    "Distribution over time steps", Section.HOW_BAD, draw_distribution, order=20, id="distribution"
)


def draw_window_norms(scene: Scene) -> Drawing | None:
    """Draw the share of windows below each norm."""
    norms = _list_norms(scene)
    if not norms:
        return None
    note = "The norm of the published figure: \u221a40 \u00d7 root mean square slip speed over 2 s."
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


WINDOW_NORMS = Figure(
    "Distribution over 2 s windows", Section.HOW_BAD, draw_window_norms, order=30, id="window_norms"
)


_PANELS = {"current": ("current of the drive", "A"), "energy_per_m": ("energy per distance", "J/m")}


def draw_power(scene: Scene) -> Drawing | None:
    """Draw the current of the drive, and below it energy per metre if a voltage was recorded."""
    table = scene.report.table("power")
    if table is None or table.is_empty():
        return None
    lines = {name: _thin(table, name) for name in _PANELS if not table[name].drop_nulls().is_empty()}
    if not lines:
        return None
    last = list(lines)[-1]
    chart = stack(
        *(_draw_power_panel(scene, name, frame, last=name == last) for name, frame in lines.items())
    )
    words = [f"{_PANELS[name][0]}: {_format_median(table[name])} {_PANELS[name][1]}" for name in lines]
    rows = {f"power_{name}": frame for name, frame in lines.items()} | figure.span_rows(scene)
    note = "Energy per distance is shown above 0.1 m/s; below zero the motors feed the battery."
    return Drawing(
        chart.properties(usermeta=figure.brush_over_time()), rows, note, f"Over time: {'; '.join(words)}."
    )


def _format_median(column: pl.Series) -> str:
    return f"median {format_number(float(np.median(column.drop_nulls().to_numpy())))}"


def _thin(table: pl.DataFrame, name: str) -> pl.DataFrame:
    line = table.select("t", pl.lit(0).alias("piece"), value=pl.col(name)).drop_nulls()
    return thin_series(line, "value", bins=LINE_BINS).select("t", "piece", "value", series=pl.lit("velocity"))


def _draw_power_panel(scene: Scene, name: str, frame: pl.DataFrame, *, last: bool) -> Chart:
    low, high = usual_ends(frame["value"], exact=True)
    shown = find_range(frame, (low, high))
    colour = figure.series_colour(["velocity"], {"velocity": "measured"})
    x = figure.time_axis(scene) if last else figure.time_axis(scene, title=None)
    chart = figure.draw_lines(scene, [f"power_{name}"], shown, colour, x)
    return chart.properties(height=100, title=figure.title_panel(*_PANELS[name], shown))


POWER = Figure("Power of the drive", Section.WHERE, draw_power, order=60, width="full", id="power")
