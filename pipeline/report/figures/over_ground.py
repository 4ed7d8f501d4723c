"""Figures of slip over the path and over the commands."""

import polars as pl

from pipeline.core.program import INPUT_WORDS
from pipeline.report import theme
from pipeline.report.figures import figure
from pipeline.report.figures.figure import Drawing, Figure, Section
from pipeline.report.scene import Scene, break_lines
from pipeline.report.theme import Channel, Chart, encode_column, layer, make_axis, round_up

_WIDTH, _LOWEST, _HIGHEST = 480, 260, 420
_MARGIN = 0.05
_SMALLEST_SPAN_M = 1.0


def draw_trajectory(scene: Scene) -> Drawing | None:
    """Draw a map with equal scales in x and y; start and end marked, segments not joined."""
    track = scene.track
    if track is None:
        return None
    frame = track.frame
    extent = [find_extent(frame["x"]), find_extent(frame["y"])]
    height, x_domain, y_domain = fit_equal_aspect(extent[0], extent[1])
    x = _make_axis("x", scene.origin[0], x_domain)
    y = _make_axis("y", scene.origin[1], y_domain)
    base = Chart.of_rows("track")
    line = Chart.of_rows("path").mark("line", color=theme.QUIET, strokeWidth=0.8, opacity=0.5, order=False)
    path = line.encode(x=x, y=y)
    tooltip = [
        encode_column("t:Q", title="time [s]", format=".2f"),
        encode_column("modulus:Q", title="slip speed [m/s]", format=".2f"),
    ]
    dots = base.mark("circle", size=16, opacity=1).encode(
        x="x:Q", y="y:Q", color=figure.slip_colour(scene), tooltip=tooltip
    )
    marked = (
        Chart.of_rows(figure.MARKED_POINTS)
        .mark("circle", size=52, opacity=0.9, color=theme.MARK)
        .encode(x="x:Q", y="y:Q")
    )
    ends = Chart.of_rows("track_ends").encode(x="x:Q", y="y:Q")
    spots = ends.mark(
        "point", size=85, filled=True, fill=theme.PAPER, stroke=theme.INK, strokeWidth=2, opacity=1
    ).encode(
        shape=encode_column(
            "place:N", scale={"domain": ["start", "end"], "range": ["circle", "square"]}, legend=None
        )
    )
    happened = list_events(scene)
    events = [
        Chart.of_rows("events")
        .mark("point", shape="triangle-up", size=90, filled=True, opacity=1, color=theme.MARK)
        .encode(
            x="x:Q",
            y="y:Q",
            tooltip=[
                encode_column("kind:N", title="event"),
                encode_column("t:Q", title="time [s]", format=".1f"),
            ],
        )
    ]
    # Above and below, so that both are legible if a run ends where it began.
    words = [
        ends.filter(f"datum.place === '{end}'")
        .mark("text", align="left", dx=10, dy=dy, fontWeight=600, color=theme.INK)
        .encode(text="place:N")
        for end, dy in (("start", -9), ("end", 12))
    ]
    meta = figure.brush_over_plane("x", "y") | {
        "equal": {"x": extent[0], "y": extent[1], "lowest": _LOWEST, "highest": _HIGHEST}
    }
    predicted = [
        Chart.of_rows("arcs")
        .mark("line", color=theme.MODEL, strokeWidth=1.6, opacity=0.9, order=False)
        .encode(x="x:Q", y="y:Q")
    ]
    above = [*(predicted if scene.report.motion else []), *(events if happened else [])]
    chart = layer(path, marked, dots, *above, spots, *words).properties(
        width=_WIDTH, height=height, usermeta=meta
    )
    first, last = (
        frame.head(1).with_columns(place=pl.lit("start")),
        frame.tail(1).with_columns(place=pl.lit("end")),
    )
    steps = break_lines(frame.select("x", "y", "piece"), "x", "y")
    rows = (
        list_arcs(scene)
        | happened
        | {"track": frame, "path": steps, "track_ends": pl.concat([first, last])}
        | figure.marked_rows()
    )
    note = figure.format_thinning(track, rule="the highest slip of every bin")
    arcs = " Lines: where the model goes in two seconds from measured poses." if scene.report.motion else ""
    sentence = f" Triangles: {format_events(happened['events'])}." if happened else ""
    note = f"Colours end at {scene.modulus_cap:g} m/s, the 98th percentile.{arcs}{sentence} {note}".strip()
    return Drawing(chart, rows, note, format_map(scene))


def list_events(scene: Scene) -> dict[str, pl.DataFrame]:
    """Start of each motion event: ``t kind x y``; empty without any."""
    table = scene.report.tables.get("events")
    if table is None or table.is_empty():
        return {}
    east, north = scene.origin
    kind = pl.col("kind").cast(pl.String).str.replace_all("_", " ")
    return {"events": table.select(t="t_start", kind=kind, x=pl.col("x") - east, y=pl.col("y") - north)}


def format_events(events: pl.DataFrame) -> str:
    """Number of events of each kind, and start of the first."""
    counts = events.group_by("kind", maintain_order=True).agg(pl.len().alias("count"), pl.col("t").first())
    sentences = []
    for kind, count, first in counts.select("kind", "count", "t").iter_rows():
        others = f" and {count - 1} more" if count > 1 else ""
        sentences.append(f"{kind} at {first:.0f} s{others}")
    return ", ".join(sentences)


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


def fit_equal_aspect(
    x: list[float], y: list[float], *, width: float = _WIDTH
) -> tuple[float, list[float], list[float]]:
    """Height [px] and domains [m] that give x and y the same scale and contain both extents."""
    wide, tall = x[1] - x[0], y[1] - y[0]
    height = min(max(width * tall / wide, _LOWEST), _HIGHEST)
    scale = max(wide / width, tall / height)
    return round(height), _widen(x, scale * width), _widen(y, scale * height)


def _widen(extent: list[float], span: float) -> list[float]:
    middle = (extent[0] + extent[1]) / 2.0
    return [middle - span / 2.0, middle + span / 2.0]


def find_extent(values: pl.Series) -> list[float]:
    """Limits of an axis that contains the values [m], with a margin."""
    low, high = float(values.min() or 0.0), float(values.max() or 0.0)  # type: ignore[arg-type]
    span = max(high - low, _SMALLEST_SPAN_M) * (1.0 + 2.0 * _MARGIN)
    return [round(value, 4) for value in _widen([low, high], span)]


def _make_axis(name: str, offset: float, domain: list[float]) -> Channel:
    less = f", less {offset:,.0f} m" if offset else ""
    title, scale = f"{name} in the map{less} [m]", {"domain": domain, "nice": False, "zero": False}
    return make_axis(name, title, scale=scale, tickCount=5, minExtent=figure.GUTTER - 20)


def format_map(scene: Scene) -> str:
    """Size of the area, distance, and position of the largest slip."""
    if scene.track is None:
        return "There are no poses to draw."
    frame = scene.track.frame
    x, y = find_extent(frame["x"]), find_extent(frame["y"])
    sentence = f"Map of the trajectory, {x[1] - x[0]:.0f} m by {y[1] - y[0]:.0f} m, coloured by slip speed."
    known = frame.filter(pl.col("modulus").is_not_null())
    if known.is_empty():
        return sentence
    row = known.row(known["modulus"].arg_max() or 0, named=True)
    return (
        f"{sentence} Slip was highest, {row['modulus']:.2f} m/s, at x {row['x']:.1f} m, y {row['y']:.1f} m."
    )


TRAJECTORY = Figure("On the map", Section.GLANCE, draw_trajectory, order=10, live=list_arcs, id="trajectory")


_CELLS = 20
_FEWEST_SAMPLES = 3
_SMALLEST_BOUND = 0.1


def draw_command_space(scene: Scene) -> Drawing | None:
    """A heat map: colour is the median slip speed of the samples in a cell; empty cells stay empty."""
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
        color=figure.slip_colour(scene),
        tooltip=tooltip,
    )
    marked = (
        Chart.of_rows(figure.MARKED_POINTS)
        .mark("circle", size=26, opacity=0.9, color=theme.MARK, stroke=theme.INK, strokeWidth=0.5)
        .encode(x=x, y=y)
    )
    meta = figure.brush_over_plane("f_w", "f_x")
    chart = layer(heat, marked).properties(width=480, height=340, usermeta=meta)
    note = f"Cells with fewer than {_FEWEST_SAMPLES} samples are left empty."
    return Drawing(chart, list_cells(scene) | figure.marked_rows(), note, format_cells(scene))


def list_cells(scene: Scene) -> dict[str, pl.DataFrame]:
    """Cells of the plane of commands: edges, median slip speed, samples; empty without slip."""
    slip = scene.sound_slip.get(scene.report.main_input)
    return {} if slip is None else {"command_cells": _count_cells(slip)}


def _bound(slip: pl.DataFrame, name: str) -> list[float]:
    low, high = (float(slip[name].min() or 0.0), float(slip[name].max() or 0.0))  # type: ignore[arg-type]
    return [
        -round_up(-low) if low < -_SMALLEST_BOUND else -_SMALLEST_BOUND,
        round_up(high) if high > _SMALLEST_BOUND else _SMALLEST_BOUND,
    ]


def _count_cells(slip: pl.DataFrame) -> pl.DataFrame:
    """Cells of equal size over the plane of commands: edges, median slip speed, samples."""
    columns = []
    for name, short in (("f_x", "x"), ("f_w", "w")):
        low, high = _bound(slip, name)
        size = (high - low) / _CELLS
        number = ((pl.col(name) - low) / size).floor().clip(0, _CELLS - 1)
        columns += [
            (low + number * size).alias(f"{short}_low"),
            (low + (number + 1) * size).alias(f"{short}_high"),
        ]
    edges = ["x_low", "x_high", "w_low", "w_high"]
    return (
        slip.select(*columns, "modulus")
        .group_by(edges)
        .agg(modulus=pl.col("modulus").median(), samples=pl.len())
        .filter(pl.col("samples") >= _FEWEST_SAMPLES)
        .sort(edges)
    )


def format_cells(scene: Scene) -> str:
    """Commands with the most and the least slip."""
    grid = list_cells(scene).get("command_cells")
    title = "Median slip speed over ideal speed and ideal yaw rate."
    if grid is None or grid.is_empty():
        return title
    row = grid.row(grid["modulus"].arg_max() or 0, named=True)
    return (
        f"{title} It is highest, {row['modulus']:.2f} m/s, near {(row['x_low'] + row['x_high']) / 2:.2f} m/s "
        f"and {(row['w_low'] + row['w_high']) / 2:.2f} rad/s."
    )


COMMAND_SPACE = Figure(
    "Over the commands", Section.WHERE, draw_command_space, order=20, live=list_cells, id="command_space"
)
