"""The one page of what sets runs side by side: sentences, figures, tables, notes."""

from collections.abc import Mapping
from pathlib import Path

import polars as pl

from pipeline.core import INPUT_WORDS, FigureFormat
from pipeline.datasets import DeploymentMap
from pipeline.report import Cell, Column, Picture, Table, bracket_unit, format_number, theme, write_page
from pipeline.report.page import add_figures, render_figures
from pipeline.report.theme import Chart, Drawing, encode_column, layer, make_axis
from pipeline.store import Store


def tabulate_frame(caption: str, frame: pl.DataFrame, units: Mapping[str, str] | None = None) -> Table:
    """A table of Polars as one of a page, without the columns that are empty.

    Args:
        caption: what it shows.
        frame: the table; ``_`` in names of columns becomes a space.
        units: units of columns.
    """
    columns = [
        Column(name.replace("_", " "), (units or {}).get(name, ""), number=kind.is_numeric())
        for name, kind in frame.schema.items()
    ]
    rows: list[list[str | Cell]] = [
        [
            format_number(value) if isinstance(value, float) else "" if value is None else str(value)
            for value in row
        ]
        for row in frame.iter_rows()
    ]
    return Table(caption, columns, rows).drop_empty()


def write_map(store: Store, drawn: DeploymentMap, figures: FigureFormat | None = None) -> Path:
    """Write `map.html`, and its figure if a format is given; return the path of the page."""
    about = f"{drawn.measure.name} {INPUT_WORDS[drawn.input]}{bracket_unit(drawn.measure.unit)}"
    units = {"energy": "J", "value": drawn.measure.unit}
    named = drawn.own.rename({"value": drawn.measure.name.replace(" ", "_")})
    page = render_figures(
        "report/templates/datasets.html",
        [_draw_map(drawn, about)],
        title="Deployment map",
        facts=[f"{drawn.points.height} deployments", f"{drawn.own.height} own datasets"],
        lines=[],
        tables=[
            tabulate_frame(f"Own datasets: largest kinetic energy of a run, {about}", named, units),
            tabulate_frame("The literature", drawn.points, units),
        ],
        notes=[*drawn.notes, f"not on the map, as mass, speed or terrain is not published: {_join(drawn)}"],
        runs=drawn.keys,
    )
    path = write_page(store, "map.html", page)
    add_figures(store, lambda: [_draw_map(drawn, about)], figures)
    return path


def _join(drawn: DeploymentMap) -> str:
    return ", ".join(drawn.missing) or "none"


def _draw_map(drawn: DeploymentMap, about: str) -> Picture:
    """Kinetic energy against terrain complexity, own datasets as large points."""
    axes = {
        "x": make_axis(
            "complexity", "terrain complexity (0 flat asphalt, 10 impassable)", (0.0, 10.0), tickCount=10
        ),
        "y": make_axis("energy", "largest kinetic energy [J]", scale={"type": "log"}, format="~s"),
    }
    literature = (
        Chart.of_rows("literature")
        .mark("point", size=70, strokeWidth=1.4, opacity=1, stroke=theme.MEASURED)
        .encode(
            **axes,
            fill={"condition": {"test": "datum.sure", "value": theme.CROSS}, "value": theme.PAPER},
            tooltip=["key:N", "vehicle:N", "terrain:N", "energy:Q", "bound:N"],
        )
    )
    marks = (
        Chart.of_rows("own")
        .mark("point", size=170, filled=True, opacity=1)
        .encode(
            **axes,
            color=encode_column("value:Q", scale={"range": list(theme.SLIP_RAMP)}, legend={"title": about}),
            tooltip=["dataset:N", "runs:Q", "energy:Q", "value:Q"],
        )
    )
    names = Chart.of_rows("own").mark("text", align="left", dx=12, fontWeight=600).encode(
        **axes, text="dataset:N"
    )  # fmt: skip
    chart = layer(literature, marks, names).properties(width=720, height=520)
    note = "Hollow: mass, speed or terrain is not known well. Point at a mark to read what it is."
    words = f"{drawn.points.height} deployments of the literature and {drawn.own.height} own datasets."
    rows = {"literature": drawn.points, "own": drawn.own}
    return Picture("deployment_map", "Energy and terrain", Drawing(chart, rows, note, words))
