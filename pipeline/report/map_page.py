"""Page of `slip fleet map`: kinetic energy against terrain complexity."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl

from pipeline.core import INPUT_WORDS, FigureFormat
from pipeline.datasets import ZONES, DeploymentMap, Measure
from pipeline.report import Cell, Column, Picture, Table, bracket_unit, format_number, theme, write_page
from pipeline.report.page import add_figures, render_figures
from pipeline.report.theme import Channel, Chart, Drawing, encode_column, layer, make_axis
from pipeline.store import Store

_LETTER, _LINE = 6.7, 13.0
_MARK = 9.0
_STEPS = (0.0, 14.0, -14.0, 28.0, -28.0, 42.0, -42.0)


@dataclass(frozen=True)
class Box:
    """Rectangle in pixels, y upward."""

    left: float
    right: float
    low: float
    high: float

    def overlaps(self, other: Box) -> bool:
        """Whether two rectangles share a point."""
        return (
            self.left < other.right
            and other.left < self.right
            and self.low < other.high
            and other.low < self.high
        )


def arrange_labels(
    marks: Sequence[tuple[float, float]],
    names: Sequence[str],
    *,
    width: float,
    obstacles: Sequence[Box] = (),
    furthest: float = 42.0,
    apart: float = 0.0,
) -> list[tuple[float, float] | None]:
    """Place labels greedily in the given order; returns the left end of each label's middle line.

    Each label tries right and left of its mark, then some lines higher and lower; the first position on the
    map that hides nothing is used.

    Args:
        marks: positions in pixels, y upward.
        names: the labels, one per mark.
        width: width of the map in pixels.
        obstacles: other areas that must stay visible.
        apart: distance from other marks, so that a label cannot be attributed to them [pixels].
        furthest: largest vertical distance of a label from its mark [pixels].

    Returns:
        A position for each label, None without one.
    """
    taken = list(obstacles)
    own = [Box(x - _MARK, x + _MARK, y - _MARK, y + _MARK) for x, y in marks]
    others = [Box(box.left - apart, box.right + apart, box.low, box.high) for box in own]
    placed: list[tuple[float, float] | None] = []
    steps = [step for step in _STEPS if abs(step) <= furthest]
    for i, ((x, y), name) in enumerate(zip(marks, names, strict=True)):
        long = _LETTER * len(name)
        places = [(edge, y + step) for step in steps for edge in (x + _MARK + 3.0, x - _MARK - 3.0 - long)]
        hidden = [*taken, own[i], *others[:i], *others[i + 1 :]]
        free = [
            corner
            for corner in places
            if corner[0] >= 0.0
            and corner[0] + long <= width
            and not any(_frame(corner, long).overlaps(box) for box in hidden)
        ]
        if not free:
            placed.append(None)
            continue
        taken.append(_frame(free[0], long))
        placed.append(free[0])
    return placed


def _frame(corner: tuple[float, float], long: float) -> Box:
    x, y = corner
    return Box(x, x + long, y - _LINE / 2.0, y + _LINE / 2.0)


_LOWEST, _HIGHEST = 1.0, 1.0e6
_ARROW = 1.9
_WIDTH, _HEIGHT = 720.0, 520.0
_PHONE_WIDTH, _NARROW = 260.0, 480
_BESIDE = 12
_NEAR = 20.0
"""Vertical distance above which a label has a leader line to its mark [pixels]."""
_ZONE_NAME, _ZONE_LINE = 85.0, 22.0
_SHAPES = {
    "kinematic": "circle",
    "dynamic": "square",
    "learned": "diamond",
    "dataset": "cross",
    "several": "triangle-right",
    "unknown": "stroke",
}
_ZONE_OPACITY = {"low": 0.0, "medium": 0.45, "high": 0.85}


def draw_map(points: pl.DataFrame, own: pl.DataFrame, about: str, words: str) -> Drawing:
    """Draw deployments, kinetic energy [J, log] against terrain complexity, with own datasets on top.

    Args:
        points: as from `rank_deployments`.
        own: as from `rank_datasets`; may be empty.
        about: measure of their colour, with its unit.
        words: alternative text.
    """
    own = number_datasets(own)
    arrows = points.filter(pl.col("bound").is_in(["upper", "lower"])).with_columns(
        pl.when(pl.col("bound") == "lower")
        .then(pl.col("energy") * _ARROW)
        .otherwise(pl.col("energy") / _ARROW)
        .alias("end")
    )
    rows = {
        "zones": _tabulate_zones(),
        "names": _name_marks(points, own),
        "literature": points,
        "bounds": arrows,
        "own": own,
    }
    layers = [_shade_zones(), _name_zones(), *_draw_leaders(), *_draw_bounds(), *_draw_literature(points)]
    if not own.is_empty():
        layers.append(_draw_own(about))
    layers += _draw_names()
    chart = layer(*layers).resolve_scale(color="independent", shape="independent")
    note = (
        "Arrows: bounds. Hollow: mass or speed unconfirmed, inferred or second-hand. The complexity is a "
        "convention (slope, roughness, sinkage, friction); the zones end where log10(energy / J) + "
        "complexity / 10 is 3.5 and 4.8. Hover over a mark to read a name that has no room; "
        "on a narrow screen own datasets have the numbers of the table."
    )
    chart = chart.properties(width=_WIDTH, height=_HEIGHT, usermeta={"gutter": 70})
    return Drawing(chart, rows, note, words)


def number_datasets(own: pl.DataFrame) -> pl.DataFrame:
    """Own datasets in the order of their numbers: by descending energy."""
    return own.sort("energy", "dataset", descending=[True, False])


def _tabulate_zones() -> pl.DataFrame:
    """Lower and upper edge of each risk zone at both ends of the axis, and the position of its name."""
    rows = []
    start = -1.0e9
    for name, end in ZONES:
        for power in (0.0, 10.0):
            low, high = (10.0 ** min(max(edge - power / 10.0, 0.0), 6.0) for edge in (start, end))
            rows.append((f"{name} risk", power, low, high, _ZONE_OPACITY[name]))
        start = end
    return pl.DataFrame(rows, schema=["zone", "place", "low", "high", "opacity"], orient="row")


def _energy(field: str) -> Channel:
    scale = {"type": "log", "domain": [_LOWEST, _HIGHEST]}
    return make_axis(field, "maximum kinetic energy [J]", scale=scale, format="~s", tickCount=6)


def _complexity(field: str = "complexity") -> Channel:
    return encode_column(
        f"{field}:Q",
        scale={"domain": [0.0, 10.0], "nice": False},
        axis={"title": "terrain complexity (0 flat asphalt, 10 impassable)", "tickCount": 10},
    )


def _shade_zones() -> Chart:
    shaded: Chart = (
        Chart.of_rows("zones")
        .mark("area", color=theme.SUSPECT, clip=True)
        .encode(
            x=_complexity("place"),
            y=_energy("low"),
            y2="high:Q",
            detail="zone:N",
            opacity=encode_column("opacity:Q", scale=None, legend=None),
        )
    )
    return shaded


def _name_zones() -> Chart:
    named: Chart = (
        Chart.of_rows("zones")
        .mark("text", align="right", baseline="top", dx=-6, dy=6, color=theme.QUIET, fontStyle="italic")
        .encode(x=_complexity("place"), y=_energy("high"), text="zone:N")
        .filter("datum.place == 10")
    )
    return named


def _draw_bounds() -> list[Chart]:
    base = Chart.of_rows("bounds").encode(x=_complexity())
    heads = [
        base.mark("point", shape=shape, size=36, filled=True, color=theme.QUIET, opacity=1)
        .encode(y=_energy("end"))
        .filter(f"datum.bound == '{bound}'")
        for bound, shape in (("upper", "triangle-down"), ("lower", "triangle-up"))
    ]
    return [base.mark("rule", color=theme.QUIET).encode(y=_energy("energy"), y2="end:Q"), *heads]


def _draw_literature(points: pl.DataFrame) -> list[Chart]:
    kinds = [kind for kind in _SHAPES if kind in set(points["model_type"])]
    shape = encode_column(
        "model_type:N",
        scale={"domain": kinds, "range": [_SHAPES[kind] for kind in kinds]},
        legend={"title": "model"},
    )
    marks = (
        Chart.of_rows("literature")
        .mark("point", size=80, strokeWidth=1.4, opacity=1)
        .encode(
            x=_complexity(),
            y=_energy("energy"),
            shape=shape,
            stroke={"value": theme.MEASURED},
            fill={"condition": {"test": "datum.sure", "value": theme.CROSS}, "value": theme.PAPER},
            tooltip=[
                "key:N",
                "vehicle:N",
                "terrain:N",
                encode_column("energy:Q", format=",.3~r", title="J"),
                "bound:N",
            ],
        )
    )
    return [marks]


def _draw_own(about: str) -> Chart:
    colour = encode_column(
        "value:Q",
        scale={"range": list(theme.SLIP_RAMP), "interpolate": "rgb"},
        legend={"title": f"own runs: {about}", "gradientLength": 150, "gradientThickness": 8, "tickCount": 3},
    )
    marks: Chart = (
        Chart.of_rows("own")
        .mark(
            "point", size=170, filled=True, shape="circle", stroke=theme.MEASURED, strokeWidth=1.5, opacity=1
        )
        .encode(
            x=_complexity(),
            y=_energy("energy"),
            color=colour,
            tooltip=[
                "dataset:N",
                "runs:Q",
                encode_column("energy:Q", format=",.3~r", title="J"),
                encode_column("value:Q", format=".3", title=about),
            ],
        )
    )
    return marks


def _draw_leaders() -> list[Chart]:
    """Draw lines from marks to the labels that are some lines higher or lower."""
    base = (
        Chart.of_rows("names")
        .encode(x=_complexity("place"), x2="place:Q", y=_energy("energy"), y2="height:Q")
        .filter(f"datum.led && datum.wide == (width >= {_NARROW})")
    )
    return [
        base.mark("rule", color=theme.QUIET, strokeWidth=0.8, x2Offset=offset).filter(
            f"datum.side == '{side}'"
        )
        for side, offset in (("right", _BESIDE), ("left", -_BESIDE))
    ]


def _draw_names() -> list[Chart]:
    base = (
        Chart.of_rows("names")
        .encode(x=_complexity("place"), y=_energy("height"), text="name:N")
        .filter(f"datum.wide == (width >= {_NARROW})")
    )
    quiet: dict[str, Any] = {"fontSize": 10, "color": theme.QUIET}
    strong: dict[str, Any] = {"fontSize": 10.5, "fontWeight": 600, "color": theme.INK}
    sides: dict[str, dict[str, Any]] = {
        "right": {"align": "left", "dx": _BESIDE},
        "left": {"align": "right", "dx": -_BESIDE},
    }
    return [
        base.filter(f"datum.side == '{side}'").mark("text", baseline="middle", **look, **spot).filter(whose)
        for whose, look in (("!datum.own", quiet), ("datum.own", strong))
        for side, spot in sides.items()
    ]


def _name_marks(points: pl.DataFrame, own: pl.DataFrame) -> pl.DataFrame:
    """Labels with their positions, own datasets first; for wide screens and for narrow ones."""
    marks = pl.concat(
        [
            own.select(
                pl.col("dataset").alias("name"), "complexity", "energy", pl.lit(value=True).alias("own")
            ),
            points.select(
                pl.col("key").alias("name"), "complexity", "energy", pl.lit(value=False).alias("own")
            ),
        ]
    )
    # A narrow map has no room for whole names: own datasets are labelled by their number in the table.
    number = pl.when(pl.col("own")).then(pl.int_range(1, pl.len() + 1).cast(pl.String)).otherwise("name")
    return pl.concat(
        [
            _arrange_names(marks, _WIDTH, furthest=42.0, apart=0.0).with_columns(wide=pl.lit(value=True)),
            _arrange_names(
                marks.with_columns(name=number), _PHONE_WIDTH, furthest=14.0, apart=6.0
            ).with_columns(wide=pl.lit(value=False)),
        ]
    )


def _arrange_names(marks: pl.DataFrame, width: float, *, furthest: float, apart: float) -> pl.DataFrame:
    """Labels with a position on a map of that width [pixels]; the others appear on touching their mark."""
    across, up = width / 10.0, _HEIGHT / (math.log10(_HIGHEST) - math.log10(_LOWEST))
    pixels = [
        (x * across, math.log10(energy) * up)
        for x, energy in zip(marks["complexity"].to_list(), marks["energy"].to_list(), strict=True)
    ]
    corners = [math.log10(high) * up for high in _tabulate_zones().filter(pl.col("place") == 10.0)["high"]]  # noqa: PLR2004 - the end of the axis
    zones = [Box(width - _ZONE_NAME, width, top - _ZONE_LINE, top) for top in corners]
    placed = arrange_labels(
        pixels, marks["name"].to_list(), width=width, obstacles=zones, furthest=furthest, apart=apart
    )
    return marks.select(
        "name",
        "own",
        "energy",
        pl.col("complexity").alias("place"),
        pl.Series(
            "led",
            [at is not None and abs(at[1] - y) > _NEAR for at, (_, y) in zip(placed, pixels, strict=True)],
        ),
        pl.Series("side", [_name_side(at, x) for at, (x, _) in zip(placed, pixels, strict=True)]),
        pl.Series("height", [at and 10.0 ** (at[1] / up) for at in placed], dtype=pl.Float64),
    ).drop_nulls("height")


def _name_side(spot: tuple[float, float] | None, mark: float) -> str:
    return "right" if spot is None or spot[0] > mark else "left"


_LITERATURE = (
    Column("deployment"), Column("mass", "kg", number=True), Column("known"),
    Column("speed", "m/s", number=True), Column("known"), Column("kinetic energy", "J", number=True),
    Column("complexity", number=True), Column("risk"), Column("publication"), Column("remarks"),
)  # fmt: skip


def picture_map(drawn: DeploymentMap) -> Picture:
    """Return the map as a figure."""
    points, own, measure = drawn.points, drawn.own, drawn.measure
    high = points.filter(pl.col("zone") == "high")["key"].to_list()
    words = (
        f"{points.height} deployments of the literature and {own.height} own datasets, by kinetic energy and "
        f"terrain complexity. At high risk: {', '.join(high) or 'none'}."
    )
    about = f"{measure.name} {INPUT_WORDS[drawn.input]}{bracket_unit(measure.unit)}"
    return Picture("deployment_map", "The map", draw_map(points, own, about, words))


def render_map(drawn: DeploymentMap) -> str:
    """Render the complete page as HTML."""
    deployments, points, own = drawn.deployments, drawn.points, drawn.own
    facts = [f"{deployments.height} deployments", f"{points.height} on the map", f"{own.height} own datasets"]
    return render_figures(
        "report/templates/map.html",
        [picture_map(drawn)],
        title="Deployment map",
        facts=facts,
        notes=drawn.notes,
        own=_tabulate_own(own, drawn.measure, drawn.input),
        literature=_tabulate_literature(deployments, points),
        left=deployments.filter(~pl.col("key").is_in(points["key"].to_list())).to_dicts(),
        runs=drawn.keys,
    )


def _tabulate_own(own: pl.DataFrame, measure: Measure, input_name: str) -> Table:
    rows = [
        [
            Cell(row["dataset"], before=str(number)),
            str(row["runs"]),
            format_number(row["energy"]),
            format_number(row["complexity"], digits=2),
            format_number(row["value"]),
            row["zone"],
        ]
        for number, row in enumerate(number_datasets(own).iter_rows(named=True), start=1)
    ]
    head = (
        Column("dataset"), Column("runs", number=True), Column("kinetic energy", "J", number=True),
        Column("complexity", number=True), Column(measure.name, measure.unit, number=True), Column("risk"),
    )  # fmt: skip
    caption = f"Largest kinetic energy of any run; {measure.name} {INPUT_WORDS[input_name]}, median over runs"
    return Table(caption, head, rows)


def _tabulate_literature(deployments: pl.DataFrame, points: pl.DataFrame) -> Table:
    joined = points.select("key", "complexity", "zone").join(deployments, on="key").sort("year", "key")
    signs = {"upper": "\u2264\u202f", "lower": "\u2265\u202f", "uncertain": "~\u202f"}
    rows = [
        [
            row["key"],
            format_number(row["mass_kg"]),
            str(row["mass_status"]),
            format_number(row["speed_mps"]),
            str(row["speed_status"]),
            signs.get(row["kinetic_energy_bound"], "") + format_number(row["kinetic_energy_j"]),
            format_number(row["complexity"], digits=2),
            row["zone"],
            Cell(small=", ".join(filter(None, (row["title"], row["venue"])))),
            row["remarks"] or "",
        ]
        for row in joined.iter_rows(named=True)
    ]
    return Table("Values as published; computed energies, bounds marked", _LITERATURE, rows)


# Deployment map on one offline page: kinetic energy against terrain complexity.
#
# Deployments of the literature by kind of model, bounds as arrows, uncertain rows hollow; own datasets
# coloured by their slip.


def write_map(store: Store, drawn: DeploymentMap, figures: FigureFormat | None = None) -> Path:
    """Write `map.html`, and the figure if a format is given; return the path of the page."""
    path = write_page(store, "map.html", render_map(drawn))
    add_figures(store, lambda: [picture_map(drawn)], figures)
    return path
