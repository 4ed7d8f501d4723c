"""The page of `slip map`."""

import polars as pl

from pipeline.fleet.measures import Measure
from pipeline.fleet.place import DeploymentMap
from pipeline.report.deployments.figure import draw_map, number_datasets
from pipeline.report.elements import Cell, Column, Picture, Table
from pipeline.report.page import render_figures
from pipeline.report.run import INPUT_WORDS
from pipeline.report.words import say_number

_LITERATURE = (
    Column("deployment"), Column("mass", "kg", number=True), Column("known"),
    Column("speed", "m/s", number=True), Column("known"), Column("kinetic energy", "J", number=True),
    Column("complexity", number=True), Column("risk"), Column("publication"), Column("remarks"),
)  # fmt: skip


def picture_map(drawn: DeploymentMap) -> Picture:
    """The map as a figure."""
    points, own, measure = drawn.points, drawn.own, drawn.measure
    high = points.filter(pl.col("zone") == "high")["key"].to_list()
    words = (
        f"{points.height} deployments of the literature and {own.height} own datasets, by kinetic energy and "
        f"terrain complexity. At high risk: {', '.join(high) or 'none'}."
    )
    about = f"{measure.name} {INPUT_WORDS[drawn.input]} [{measure.unit}]"
    return Picture("deployment_map", "The map", draw_map(points, own, about, words))


def render_map(drawn: DeploymentMap) -> str:
    """The whole page as HTML."""
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
            say_number(row["energy"]),
            say_number(row["complexity"], digits=2),
            say_number(row["value"]),
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
            say_number(row["mass_kg"]),
            str(row["mass_status"]),
            say_number(row["speed_mps"]),
            str(row["speed_status"]),
            signs.get(row["kinetic_energy_bound"], "") + say_number(row["kinetic_energy_j"]),
            say_number(row["complexity"], digits=2),
            row["zone"],
            Cell(small=", ".join(filter(None, (row["title"], row["venue"])))),
            row["remarks"] or "",
        ]
        for row in joined.iter_rows(named=True)
    ]
    return Table("Values as published; computed energies, bounds marked", _LITERATURE, rows)
