"""The pages of `slip fleet fit`, `slip fleet trend` and `slip plan`."""

import itertools
import re
from collections.abc import Mapping, Sequence
from typing import cast

import numpy as np
import polars as pl

from pipeline.fleet.trend import (
    ParameterTrend,
    Series,
    Trend,
    format_change,
    format_power,
    format_quiet,
    format_step,
)
from pipeline.plan.plan import SAFETY, Plan
from pipeline.report import theme
from pipeline.report.figures import Drawing
from pipeline.report.page import list_ways, render_figures
from pipeline.report.scene import format_ends, mapping_in, number_in, objects_in
from pipeline.report.templating import (
    Cell,
    Column,
    Picture,
    Table,
    begin_large,
    format_number,
    render_template,
)
from pipeline.report.theme import Channel, Chart, build_spec, encode_column, layer, share_rows, stack

_LEVELS = (
    Column("parameter"), Column("level"), Column("value", number=True), Column("95 %", number=True),
    Column("between terrains", number=True), Column("between runs", number=True),
    Column("reduced chi-square", number=True), Column("found in", "runs", number=True),
)  # fmt: skip
_TERRAINS = (
    Column("parameter"), Column("terrain"), Column("mean", number=True), Column("95 %", number=True),
    Column("runs", number=True),
)  # fmt: skip


def render_fleet(content: Mapping[str, object]) -> str:
    """The whole page as HTML.

    Args:
        content: the JSON object of `slip fleet fit`, with its `keys`.
    """
    rows = objects_in(content, "parameters")
    runs = mapping_in(content, "runs")
    reasons: dict[str, list[str]] = {}
    for row in rows:
        if row["level"] is None:
            reasons.setdefault(f"{row['because']} ({row['vehicle']})", []).append(_label(row))
    vehicles = []
    for number, name in enumerate(runs):
        own = [row for row in rows if row["vehicle"] == name]
        levels = Table(
            f"Parameters of {name} by level",
            _LEVELS,
            [_list(row) for row in own],
        )
        means = [row_means for row in own for row_means in _list_terrains(row)]
        vehicles.append(
            (f"vehicle-{number}", name, levels, Table(f"Means of {name} by terrain", _TERRAINS, means))
        )
    keys = cast("Sequence[str]", content["keys"])
    return render_figures(
        "report/templates/fleet.html",
        [],
        title="Parameters by level: vehicle, terrain, run",
        facts=[
            f"{len(counted)} {word}{'s' * (len(counted) != 1)}"
            for word, counted in (("vehicle", runs), ("run", keys), ("number", rows))
        ],
        summary=str(content.get("summary") or ""),
        vehicles=vehicles,
        open=[
            *(f"{why}: {', '.join(labels)}" for why, labels in reasons.items()),
            *cast("Sequence[str]", content["notes"]),
        ],
        runs=keys,
    )


def _label(row: Mapping[str, object]) -> str:
    return f"{row['effect']}.{row['parameter']}"


def _list(row: Mapping[str, object]) -> list[str | Cell]:
    spreads = [format_number(number_in(row, f"spread_{kind}")) for kind in ("terrain", "run")]
    return [
        Cell(str(row["name"]), small=_label(row), notes=[str(row["because"])] if row["level"] else ()),
        str(row["level"] or "open"),
        _format_value(row, row),
        format_ends(row),
        *spreads,
        format_number(number_in(row, "chi_square")),
        f"{row['named']} of {row['runs']}",
    ]


def _list_terrains(row: Mapping[str, object]) -> list[list[str | Cell]]:
    terrains = mapping_in(row, "terrains")
    means = {name: mapping_in(terrains, name) for name in terrains}
    return [
        [
            Cell(small=_label(row)),
            name,
            _format_value(mean, row),
            format_ends(mean),
            str(mean["runs"]),
        ]
        for name, mean in means.items()
    ]


def _format_value(of: Mapping[str, object], row: Mapping[str, object]) -> Cell:
    return Cell(format_number(number_in(of, "value")), small="" if row["unit"] == "1" else str(row["unit"]))


_FEWEST_POINTS = 3
_LATER = ("finding ", "suspect share", "warnings")


def render_trend(trend: Trend) -> str:
    """The whole page as HTML; series and parameters with fewer than three runs are left out."""
    series, parameters, keys, alerts = trend.series, trend.parameters, trend.keys, trend.alerts
    vehicles = list(dict.fromkeys(one.vehicle for one in parameters))
    names = list(dict.fromkeys(one.group for one in series))
    groups = [
        (f"vehicle-{number}", f"Parameters of {name}", _draw_vehicle(parameters, name, number))
        for number, name in enumerate(vehicles)
    ] + [
        (
            f"group-{number}",
            f"Slip and data of {name}",
            _draw_group([one for one in series if one.group == name], number),
        )
        for number, name in enumerate(names)
    ]
    return render_figures(
        "report/templates/trend.html",
        [picture for _, _, pictures in groups for picture in pictures],
        title="Trends",
        facts=[
            f"{len(parameters)} parameters of {len(vehicles)} vehicle{'s' * (len(vehicles) != 1)}",
            f"{len(series)} series of {len(names)} group{'s' * (len(names) != 1)}",
            f"{len(keys)} runs",
            f"{len(alerts)} alert{'s' * (len(alerts) != 1)}",
        ],
        alerts=[alert.text for alert in alerts],
        quiet=begin_large(format_quiet(series, parameters)),
        notes=trend.notes,
        groups=[group for group in groups if group[2]],
        runs=keys,
    )


def _draw_vehicle(parameters: Sequence[ParameterTrend], vehicle: str, number: int) -> list[Picture]:
    own = [one for one in parameters if one.vehicle == vehicle and one.points.height >= _FEWEST_POINTS]
    own.sort(key=lambda one: (not one.changes, -one.named, one.label))
    pictures = []
    for index, one in enumerate(own):
        name = f"parameter_{number}_{index}"
        text = "; ".join(format_change(one, change) for change in one.changes) or "no change"
        odd = f". Left out, apart from the others: {', '.join(one.odd)}" if one.odd else ""
        words = (
            f"{one.points.height} runs, last {one.latest:.3g}. {begin_large(text)}; {format_power(one)}{odd}."
        )
        pictures.append(Picture(name, f"{one.label}{_format_unit(one)}", _draw_parameter(one, name, words)))
    return pictures


def _draw_parameter(trend: ParameterTrend, name: str, words: str) -> Drawing:
    """Runs with the intervals of their estimates, on the limits that all lie within, by ground."""
    rows = _number(trend.points)
    base = Chart.of_rows(f"{name}_points").encode(x=_along(rows))
    axis = {"title": None, "format": ",.3~r", "tickCount": 4, "minExtent": 44}
    value = encode_column("value:Q", axis=axis, scale={"zero": False})
    limits = base.mark("rule", strokeWidth=9, color=theme.CROSS, opacity=0.3).encode(
        y="limit_low:Q", y2="limit_high:Q"
    )
    levels = base.mark("tick", thickness=2.5, width=14, color=theme.ON_COMMAND, orient="horizontal").encode(
        y="level:Q"
    )
    errors = base.mark("rule", color=theme.SLIP).encode(y="low:Q", y2="high:Q")
    grounds = sorted(set(rows["terrain"]))
    legend = {"title": "ground"} if len(grounds) > 1 else None
    dots = base.mark("point", size=46, filled=True, color=theme.SLIP, opacity=1).encode(
        y=value,
        shape=encode_column("terrain:N", legend=legend, scale={"domain": grounds}),
        tooltip=[
            *(f"{column}:N" for column in ("run", "day", "terrain")),
            *(encode_column(f"{column}:Q", format=".4") for column in ("value", "level")),
        ],
    )
    chart = layer(limits, levels, errors, dots).properties(width=640, height=140, usermeta={"gutter": 60})
    power = begin_large(format_power(trend))
    note = f"{power}. Bars: where all runs lie at 95 %; strokes: level on that ground."
    return Drawing(chart, {f"{name}_points": rows}, note, words)


def _format_unit(of: Series | ParameterTrend) -> str:
    return f" [{of.unit}]" if of.unit not in ("", "1") else ""


def _number(points: pl.DataFrame) -> pl.DataFrame:
    return points.drop("order").with_row_index("order").with_columns(pl.col("order").cast(pl.Float64))


def _along(points: pl.DataFrame) -> Channel:
    about = f"runs in the order of their dates, {points['day'][0]} to {points['day'][-1]}"
    return encode_column(
        "order:Q",
        axis={"title": about, "labels": False, "grid": False},
        scale={"domain": [-0.5, points.height - 0.5], "nice": False, "zero": False},
    )


def _draw_group(series: Sequence[Series], number: int) -> list[Picture]:
    own = [one for one in series if one.points.height >= _FEWEST_POINTS]
    own.sort(key=lambda one: (not one.steps, one.quantity.startswith(_LATER), one.quantity))
    return [_picture(one, f"trend_{number}_{index}") for index, one in enumerate(own)]


def _picture(series: Series, name: str) -> Picture:
    steps = "; ".join(format_step(series, step) for step in series.steps)
    words = f"{series.points.height} runs, last {series.latest:.3g}. {begin_large(steps) or 'No step'}."
    return Picture(
        name, f"{series.quantity}{_format_unit(series)}", _draw_series(series, name, words), "half"
    )


def _draw_series(series: Series, name: str, words: str) -> Drawing:
    points = _number(series.points)
    levels = _tabulate_levels(series)
    axis = {"title": None, "format": ",~r", "tickCount": 4, "minExtent": 44}
    dots = (
        Chart.of_rows(f"{name}_points")
        .mark("point", size=46, filled=True, color=theme.SLIP, opacity=0.9)
        .encode(
            x=_along(points),
            y=encode_column("value:Q", axis=axis, scale={"zero": False}),
            tooltip=["run:N", "day:N", encode_column("value:Q", format=".4")],
        )
    )
    lines = (
        Chart.of_rows(f"{name}_levels")
        .mark("rule", strokeWidth=2.5, color=theme.ON_COMMAND)
        .encode(x="start:Q", x2="end:Q", y="value:Q")
    )
    chart = layer(lines, dots).properties(width=640, height=120, usermeta={"gutter": 60})
    rows = {f"{name}_points": points, f"{name}_levels": levels}
    note = "; ".join(begin_large(format_step(series, step)) for step in series.steps)
    return Drawing(chart, rows, note, words)


def _tabulate_levels(series: Series) -> pl.DataFrame:
    runs = series.points["run"].to_list()
    edges = [0, *(runs.index(step.run) for step in series.steps), len(runs)]
    return pl.DataFrame(
        {
            "start": [edge - 0.5 for edge in edges[:-1]],
            "end": [edge - 0.5 for edge in edges[1:]],
            "value": [
                float(series.points["value"][start:end].to_numpy().mean())
                for start, end in itertools.pairwise(edges)
            ],
        }
    )


# One pose in so many, and so many ways beside the base's.
_EVERY = 4
_MOST_WAYS = 24
_WIDTH = 640
# The part of the area that is drawn: times as far as the drive leads, and at least.
_ROOM = 1.2
_LEAST = 0.1
_PLACE = re.compile(r'<div id="planned">.*?</div>', re.DOTALL)


def preview_plan(plan: Plan) -> dict[str, object]:
    """The way and the promises in short, for a page that draws it: figures, rows, and lines of text."""
    picture = _draw_ways(plan, most=8, every=2 * _EVERY)
    return {
        "figures": {picture.id: build_spec(picture.drawing)},
        "rows": share_rows([picture.drawing]),
        "dark": dict(theme.DARK_TWINS),
        "words": picture.drawing.words,
        "safety": SAFETY,
        "drives": bool(plan.manoeuvres),
        "area": f"{plan.area.length_m:g} x {plan.area.width_m:g} m",
        "duration_s": plan.commands.duration_s,
        **_plan_as_view(plan),
    }


def show_planned(page: str, planned: Mapping[str, object]) -> str:
    """The report of a run with what was planned after it.

    Args:
        page: the report.
        planned: the preview of the plan, with the ``address`` of its page seen from the report; may be empty.
    """
    shown = render_template("report/templates/sections/planned.html", planned=planned)
    return _PLACE.sub(lambda _: shown, page, count=1)


def render_plan(plan: Plan, catalogue: str = "") -> str:
    """The whole page as HTML; it asks the network for nothing.

    Args:
        plan: what to drive.
        catalogue: address of the page over all runs, seen from the plan's; empty where there is none.
    """
    area, limits = plan.area, plan.limits
    turn = f"{limits.turn:.3g} {'rad of steering' if plan.steered else 'rad/s'}"
    return render_figures(
        "report/templates/plan.html",
        [_draw_ways(plan), _draw_commands(plan)],
        title="What to drive next",
        ways=list_ways(catalogue),
        facts=[
            plan.vehicle,
            f"{plan.commands.duration_s:.0f} s",
            f"{area.length_m:g} x {area.width_m:g} m",
            f"at most {limits.speed_mps:.3g} m/s, {turn}, {limits.acceleration_mps2:.3g} m/s2",
        ],
        safety=SAFETY,
        **_plan_as_view(plan),
        manoeuvres=[f"{start:.0f} s: {name}" for name, start in plan.manoeuvres],
    )


def _plan_as_view(plan: Plan) -> dict[str, object]:
    """How it is played, what it promises, and what it leaves open."""
    return {
        "play": f"ros2 bag play plan.mcap ({plan.topic}, {plan.type_name})",
        "promises": [
            f"after {one.decided_after_s:.0f} s: {one.question} "
            + (f"(t = {one.expected:.1f})" if one.kind == "separation" else f"(+- {one.expected:.2g})")
            for one in plan.promises
        ],
        "rest": plan.format_rest(),
        "impossible": plan.list_impossible(),
    }


def _draw_ways(plan: Plan, most: int = _MOST_WAYS, every: int = _EVERY) -> Picture:
    """The way that is expected, those of other models, and the area."""
    ways = plan.ways[:: max(len(plan.ways) // most, 1), ::every]
    rows = pl.concat(
        pl.DataFrame(
            {
                "x": path.real,
                "y": path.imag,
                "model": np.full(path.size, number),
                "order": np.arange(path.size),
            }
        )
        for number, path in enumerate(ways)
    )
    half_x, half_y = 0.5 * plan.area.length_m, 0.5 * plan.area.width_m
    # A drive that needs little of the area is drawn larger.
    share = _ROOM * max(float(np.abs(ways.real).max()) / half_x, float(np.abs(ways.imag).max()) / half_y)
    share = min(max(share, _LEAST), 1.0)
    seen_x, seen_y = share * half_x, share * half_y
    edge = pl.DataFrame(
        {
            "x": [-half_x, half_x, half_x, -half_x, -half_x],
            "y": [-half_y, -half_y, half_y, half_y, -half_y],
            "order": [0, 1, 2, 3, 4],
        }
    )
    wide, tall = ({"domain": [-seen, seen], "nice": False} for seen in (seen_x, seen_y))
    along = encode_column("x:Q", title="ahead of the start [m]", scale=wide)
    aside = encode_column("y:Q", title="to the left [m]", scale=tall)

    def line(name: str, colour: str, opacity: float, *detail: str) -> Chart:
        chart = Chart.of_rows(name).mark("line", color=colour, opacity=opacity, strokeWidth=1.5, clip=True)
        drawn: Chart = chart.encode(x=along, y=aside, order="order:Q", detail=list(detail))
        return drawn

    chart = layer(
        line("plan_area", theme.QUIET, 1.0),
        line("plan_ways", theme.CROSS, 0.4, "model:N"),
        line("plan_way", theme.ON_COMMAND, 1.0),
    ).properties(
        width=_WIDTH,
        height=round(_WIDTH * seen_y / seen_x),
        usermeta={"equal": {"x": [-seen_x, seen_x], "y": [-seen_y, seen_y], "lowest": 80, "highest": 640}},
    )
    tables = {"plan_area": edge, "plan_ways": rows, "plan_way": rows.filter(pl.col("model") == 0)}
    words = (
        f"From the middle of an area of {plan.area.length_m:g} x {plan.area.width_m:g} m and back to within "
        f"{plan.home_m:.1f} m: in blue by the model that explains the logs so far, in grey by others that "
        "they do not rule out."
    )
    return Picture("ways", "Path", Drawing(chart, tables, words, words))


def _draw_commands(plan: Plan) -> Picture:
    """Commanded speed and turn over time."""
    turn = "steering [rad]" if plan.steered else "yaw rate [rad/s]"
    rows = pl.DataFrame({"t": plan.commands.times, "speed": plan.commands.speed, "turn": plan.commands.turn})
    panels = [
        Chart.of_rows("plan_commands")
        .mark("line", color=theme.ON_COMMAND, strokeWidth=1.5)
        .encode(x=encode_column("t:Q", title="time [s]"), y=encode_column(f"{name}:Q", title=title))
        .properties(width=_WIDTH, height=110)
        for name, title in (("speed", "speed [m/s]"), ("turn", turn))
    ]
    words = f"Speed and {turn.partition(' [')[0]} of the commands over {plan.commands.duration_s:.0f} s."
    drawing = Drawing(stack(*panels), {"plan_commands": rows}, words=words)
    return Picture("commands", "Commands", drawing)
