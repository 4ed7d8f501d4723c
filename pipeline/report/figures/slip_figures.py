"""Figures of slip: over the path, the commands and time; steps of commands."""

import numpy as np
import polars as pl

from pipeline.core import INPUT_WORDS, Floats, format_length, format_share
from pipeline.report import figures, format_number, theme
from pipeline.report.figures import Figure
from pipeline.report.scene import Scene, break_lines
from pipeline.report.theme import (
    Chart,
    Drawing,
    encode_column,
    layer,
    make_axis,
    round_up,
    stack,
)
from schemas.run_tables import COUNTED


def draw_trajectory(scene: Scene) -> Drawing | None:
    """Draw a map with equal scales in x and y; start and end marked, segments not joined."""
    track = scene.track
    if track is None:
        return None
    frame = track.frame
    x, y, properties = figures.make_map(frame, scene.origin, (260, 420))
    at = {"x": "x:Q", "y": "y:Q"}
    line = Chart.of_rows("path").mark("line", color=theme.QUIET, strokeWidth=0.8, opacity=0.5, order=False)
    tooltip = [
        encode_column("t:Q", title="time [s]", format=".2f"),
        encode_column("modulus:Q", title="slip modulus [m/s]", format=".2f"),
    ]
    dots = Chart.of_rows("track").mark("circle", size=16, opacity=1)
    dots = dots.encode(**at, color=figures.slip_colour(scene), tooltip=tooltip)
    marked = Chart.of_rows(figures.MARKED_POINTS).mark("circle", size=52, opacity=0.9, color=theme.MARK)
    charts, rows = [line.encode(x=x, y=y), marked.encode(**at), dots], list_arcs(scene)
    note = f"Colours end at {scene.modulus_cap:g} m/s, the 98th percentile."
    if rows:
        arcs = Chart.of_rows("arcs").mark(
            "line", color=theme.MODEL, strokeWidth=1.6, opacity=0.9, order=False, clip=True
        )
        charts.append(arcs.encode(**at))
        note += " Lines: where the model goes in two seconds from measured poses."
    events = list_events(scene)
    if events is not None:
        triangle = Chart.of_rows("events").mark(
            "point", shape="triangle-up", size=90, filled=True, opacity=1, color=theme.MARK
        )
        what = [
            encode_column("kind:N", title="event"),
            encode_column("t:Q", title="time [s]", format=".1f"),
        ]
        charts.append(triangle.encode(**at, tooltip=what))
        rows["events"] = events
        note += f" Triangles: {format_events(events)}."
    ends = Chart.of_rows("track_ends").encode(**at)
    places = {"domain": ["start", "end"], "range": ["circle", "square"]}
    spots = ends.mark(
        "point", size=85, filled=True, fill=theme.PAPER, stroke=theme.INK, strokeWidth=2, opacity=1
    ).encode(shape=encode_column("place:N", scale=places, legend=None))
    # Above and below, so that both are legible if a run ends where it began.
    words = [
        ends.filter(f"datum.place === '{end}'")
        .mark("text", align="left", dx=10, dy=dy, fontWeight=600, color=theme.INK)
        .encode(text="place:N")
        for end, dy in (("start", -9), ("end", 12))
    ]
    properties["usermeta"] |= figures.brush_over_plane("x", "y") | {"dots": {"track": "measured"}}
    chart = layer(*charts, spots, *words).properties(**properties)
    rows |= {
        "track": frame,
        "path": break_lines(frame.select("x", "y", "piece"), "x", "y"),
        "track_ends": pl.concat([frame.head(1), frame.tail(1)]).with_columns(
            place=pl.Series(["start", "end"])
        ),
        figures.MARKED_POINTS: figures.EMPTY_POINTS,
    }
    note += f" {figures.format_thinning(track, rule='the highest slip of every bin')}"
    return Drawing(chart, rows, note.strip(), format_map(scene))


def list_events(scene: Scene) -> pl.DataFrame | None:
    """Start of each motion event: ``t kind x y``; None without any."""
    table = scene.report.table("events")
    if table is None:
        return None
    east, north = scene.origin
    kind = pl.col("kind").cast(pl.String).str.replace_all("_", " ")
    return table.select(t="t_start", kind=kind, x=pl.col("x") - east, y=pl.col("y") - north)


def format_events(events: pl.DataFrame) -> str:
    """Number of events of each kind, and start of the first."""
    counts = events.group_by("kind", maintain_order=True).agg(pl.len().alias("count"), pl.col("t").first())
    return ", ".join(
        f"{kind} at {first:.0f} s{f' and {count - 1} more' if count > 1 else ''}"
        for kind, count, first in counts.select("kind", "count", "t").iter_rows()
    )


def list_arcs(scene: Scene) -> dict[str, pl.DataFrame]:
    """Predicted paths as one broken line: ``t x y``; empty without a model."""
    motion = scene.report.motion
    if motion is None:
        return {}
    east, north = scene.origin
    # Over a whole run they would cover the path.
    shown = motion.arcs.filter(pl.col("piece") % 2 == 0)
    moved = shown.with_columns(pl.col("x") - east, pl.col("y") - north)
    return {"arcs": break_lines(moved, "x", "y")}


def format_map(scene: Scene) -> str:
    """Size of the area, distance, and position of the largest slip."""
    if scene.track is None:
        return "There are no poses to draw."
    frame = scene.track.frame
    sizes = [float(np.ptp(frame[name].to_numpy())) for name in "xy"]
    sentence = f"Map of the trajectory, {' by '.join(map(format_length, sizes))}, coloured by slip modulus."
    known = frame.filter(pl.col("modulus").is_not_null())
    if known.is_empty():
        return sentence
    row = known.row(known["modulus"].arg_max() or 0, named=True)
    return (
        f"{sentence} Slip was highest, {row['modulus']:.2f} m/s, at x {row['x']:.1f} m, y {row['y']:.1f} m."
    )


TRAJECTORY = Figure("trajectory", "On the map", draw_trajectory, live=list_arcs)

_CELLS = 20
_FEWEST_SAMPLES = 3
_SMALLEST_BOUND = 0.1


def draw_command_space(scene: Scene) -> Drawing | None:
    """A heat map: colour is the median slip modulus of the samples in a cell; empty cells stay empty."""
    slip = scene.sound_slip.get(scene.report.main_input)
    if slip is None:
        return None
    bounds = {name: _bound(slip, name) for name in ("f_x", "f_w")}
    words = INPUT_WORDS[scene.report.main_input]
    turn, speed = f"ideal yaw rate f_w {words} [rad/s]", f"ideal speed f_x {words} [m/s]"
    x = make_axis("f_w", turn, bounds["f_w"], tickCount=6)
    y = make_axis("f_x", speed, bounds["f_x"], tickCount=6, minExtent=26)
    tooltip = [
        encode_column("modulus:Q", title="median slip [m/s]", format=".2f"),
        encode_column("samples:Q", title="samples", format=","),
    ]
    base = Chart.of_rows("command_cells")
    heat = base.mark("rect").encode(
        x="w_low:Q",
        x2="w_high:Q",
        y="x_low:Q",
        y2="x_high:Q",
        color=figures.slip_colour(scene),
        tooltip=tooltip,
    )
    marked = (
        Chart.of_rows(figures.MARKED_POINTS)
        .mark("circle", size=26, opacity=0.9, color=theme.MARK, stroke=theme.INK, strokeWidth=0.5)
        .encode(x=x, y=y)
    )
    meta = figures.brush_over_plane("f_w", "f_x")
    chart = layer(heat, marked).properties(width=480, height=340, usermeta=meta)
    note = f"Cells with fewer than {_FEWEST_SAMPLES} samples are left empty."
    rows = list_cells(scene) | {figures.MARKED_POINTS: figures.EMPTY_POINTS}
    return Drawing(chart, rows, note, format_cells(scene))


def list_cells(scene: Scene) -> dict[str, pl.DataFrame]:
    """Cells of equal size over the plane of commands: edges, median slip modulus, samples.

    Empty without slip.
    """
    slip = scene.sound_slip.get(scene.report.main_input)
    if slip is None:
        return {}
    edges = {}
    for name, short in (("f_x", "x"), ("f_w", "w")):
        low, high = _bound(slip, name)
        size = (high - low) / _CELLS
        number = ((pl.col(name) - low) / size).floor().clip(0, _CELLS - 1)
        edges[f"{short}_low"] = low + number * size
        edges[f"{short}_high"] = low + (number + 1) * size
    grid = (
        slip.select("modulus", **edges)
        .group_by(*edges)
        .agg(modulus=pl.col("modulus").median(), samples=pl.len())
        .filter(pl.col("samples") >= _FEWEST_SAMPLES)
    )
    return {"command_cells": grid.sort(*edges)}


def _bound(slip: pl.DataFrame, name: str) -> list[float]:
    low, high = (float(slip[name].min() or 0.0), float(slip[name].max() or 0.0))  # type: ignore[arg-type]
    return [
        -round_up(-low) if low < -_SMALLEST_BOUND else -_SMALLEST_BOUND,
        round_up(high) if high > _SMALLEST_BOUND else _SMALLEST_BOUND,
    ]


def format_cells(scene: Scene) -> str:
    """Commands with the most and the least slip."""
    grid = list_cells(scene).get("command_cells")
    title = "Median slip modulus over ideal speed and ideal yaw rate."
    if grid is None or grid.is_empty():
        return title
    row = grid.row(grid["modulus"].arg_max() or 0, named=True)
    return (
        f"{title} It is highest, {row['modulus']:.2f} m/s, near {(row['x_low'] + row['x_high']) / 2:.2f} m/s "
        f"and {(row['w_low'] + row['w_high']) / 2:.2f} rad/s."
    )


COMMAND_SPACE = Figure("command_space", "Over the commands", draw_command_space, live=list_cells)


def draw_modulus(scene: Scene) -> Drawing | None:
    """Draw one line per input over the whole run, in which the enlarged stretch is marked."""
    lines, span = scene.modulus_lines, scene.worst_span
    if lines is None:
        return None
    residual = {} if scene.main_residual is None else {"model": "with the model"}
    colour = figures.series_colour({name: INPUT_WORDS[name] for name in scene.slip} | residual)
    rows = {"modulus": lines.frame} | figures.span_rows(scene)
    note, meta = figures.format_bands(scene, lines), figures.brush_over_time()
    if span is not None:
        rows[figures.SHOWN_SPAN] = pl.DataFrame({"t_start": [span[0]], "t_end": [span[1]]})
        meta["brush"] = "zoom"
        length = span[1] - span[0]
        note = f"Enlarged below: the {length:g} s with the most slip. Drag here to draw others. {note}"
    chart = figures.draw_lines(
        ["modulus"],
        lines.frame,
        lines.usual,
        ("slip modulus", "m/s"),
        colour,
        x=figures.time_axis(scene),
        height=120,
        bands=figures.shade_spans(*(name for name in rows if name != "modulus")),
    )
    return Drawing(chart.properties(usermeta=meta), rows, note.strip(), _format_slip(scene))


def _format_slip(scene: Scene) -> str:
    """Median, maximum and its time for each input."""
    sentences = []
    for name, frame in scene.sound_slip.items():
        drawn = frame.select(pl.when(~pl.col("end")).then("modulus")).to_series()
        row = frame.row(drawn.arg_max() or 0, named=True)
        sentences.append(
            f"{INPUT_WORDS[name]} its median is {format_number(scene.median_modulus(name))} m/s "
            f"and it is highest, {row['modulus']:.2f} m/s, at {row['t']:.0f} s"
        )
    if scene.main_residual is not None:
        median = scene.main_residual.filter(COUNTED)["residual_modulus"].median()
        sentences.append(f"the model leaves a median of {format_number(median)} m/s")  # type: ignore[arg-type]
    text = "Slip modulus over time: " + "; ".join(sentences) + "."
    if scene.worst_span is None:
        return text
    start, end = scene.worst_span
    return f"{text} The next figure draws {start:.0f} s to {end:.0f} s large; arrow keys move the stretch."


MODULUS = Figure("modulus", "Slip over time", draw_modulus, width="full")

_CHANNELS = {"x": ("forward velocity", 0.15), "w": ("yaw rate", 0.15)}
_BEFORE_S, _AFTER_S, _RATE_HZ = 0.5, 3.0, 20.0
_FEWEST = 2
_WORDS = {"command": "command", "velocity": "measured", "model": "model"}


def draw_step_response(scene: Scene) -> Drawing | None:
    """Draw a panel each for speed and yaw rate; None if too few steps are held for long enough."""
    rows = list_responses(scene)
    panels = [
        _draw_response(component, list(rows[f"response_{component}"]["series"].unique(maintain_order=True)))
        for component in _CHANNELS
        if f"response_{component}" in rows
    ]
    if not panels:
        return None
    chart = stack(*panels).properties(usermeta={"gutter": figures.GUTTER})
    note = (
        "Change since half a second before the step, median over commands held for three seconds; 1 is the "
        "commanded change."
    )
    return Drawing(chart, rows, note, _format_step_response(rows))


def list_responses(scene: Scene) -> dict[str, pl.DataFrame]:
    """Rows ``t value series`` of each channel with steps; empty without any."""
    slip = scene.slip.get("command")
    if slip is None:
        return {}
    motion = scene.report.motion
    tables = {}
    for component, (_, smallest) in _CHANNELS.items():
        t, asked = slip["t"].to_numpy(), slip[f"f_{component}"].to_numpy()
        starts, low, high = find_steps(t, asked, smallest=smallest)
        if starts.size < _FEWEST:
            continue
        lines = {"command": (t, asked), "velocity": (t, slip[f"v_{component}"].to_numpy())}
        if motion is not None and motion.input == "command":
            lines["model"] = (motion.velocity["t"].to_numpy(), motion.velocity[f"v_{component}"].to_numpy())
        since = np.arange(-_BEFORE_S, _AFTER_S, 1.0 / _RATE_HZ)
        frames = []
        for series, (times, values) in lines.items():
            at = np.interp((starts[:, None] + since).ravel(), times, values).reshape(starts.size, -1)
            # Measured velocities are smoothed over time, and just before the step hold half of it.
            middle = np.median((at - at[:, :1]) / (high - low)[:, None], axis=0)
            frames.append(pl.DataFrame({"t": since, "value": middle}).with_columns(series=pl.lit(series)))
        tables[f"response_{component}"] = pl.concat(frames)
    return tables


def find_steps(t: Floats, asked: Floats, *, smallest: float) -> tuple[Floats, Floats, Floats]:
    """Find steps of a held command.

    Args:
        t: times [s], increasing.
        asked: the command's ideal velocity.
        smallest: minimum height of a step.

    Returns:
        Times of the steps [s], and the values before and after them, each of shape (k,); the command is
        constant for long enough before and after a step.
    """
    jumps = np.flatnonzero(np.abs(np.diff(asked)) > smallest)
    starts, low, high = [], [], []
    for jump in jumps.tolist():
        begin, end = np.searchsorted(t, (t[jump] - _BEFORE_S, t[jump + 1] + _AFTER_S - 0.1))
        whole = t[jump + 1] + _AFTER_S - 0.1 <= t[-1] and t[jump] - _BEFORE_S >= t[0]
        joined = whole and float(np.diff(t[begin:end]).max(initial=0.0)) < 3.0 / _RATE_HZ
        before, after = asked[begin : jump + 1], asked[jump + 1 : end]
        still = joined and np.ptp(before) < 0.1 * smallest and np.ptp(after) < 0.1 * smallest
        if still:
            starts.append(float(t[jump + 1]))
            low.append(float(before[-1]))
            high.append(float(after[0]))
    return np.array(starts), np.array(low), np.array(high)


def _draw_response(component: str, series: list[str]) -> Chart:
    last = component == list(_CHANNELS)[-1]
    look = {"title": "time since the step [s]" if last else None, "labels": last, "grid": False}
    x = encode_column("t:Q", scale={"domain": [-_BEFORE_S, _AFTER_S], "nice": False}, axis=look)
    y = make_axis("value", None, (-0.25, 1.4), values=[0, 0.5, 1], minExtent=figures.GUTTER - 10)
    colour = figures.series_colour({name: _WORDS[name] for name in series})
    line = Chart.of_rows(f"response_{component}").mark("line", clip=True, strokeWidth=2)
    title = {"text": f"{_CHANNELS[component][0]}, share of the step"}
    return line.encode(x=x, y=y, color=colour).properties(width=480, height=96, title=title)


def _format_step_response(responses: dict[str, pl.DataFrame]) -> str:
    """Time at which the measured response reaches 63 % of the step."""
    sentences = []
    for name, rows in responses.items():
        line = rows.filter(pl.col("series") == "velocity")
        reached = line.filter((pl.col("value") >= 0.632) & (pl.col("t") > 0.0))["t"]  # noqa: PLR2004 - 1 - 1/e
        when = f"63 % after {reached[0]:.2f} s" if reached.len() else "never 63 %"
        ends = float(line["value"].tail(10).median() or 0.0)  # type: ignore[arg-type]
        sentences.append(f"{_CHANNELS[name[-1]][0]}: {when}, {format_share(ends)} in the end")
    return "Median response to a step of the command. " + "; ".join(sentences) + "."


STEP_RESPONSE = Figure(
    "step_response", "After a step of the command", draw_step_response, live=list_responses
)
