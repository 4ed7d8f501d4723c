"""The page of `slip map`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import polars as pl

from pipeline.report.deployments.figure import draw_map, number_datasets
from pipeline.report.gallery import Chapter, Picture, render_gallery
from pipeline.report.words import begin_large, build_table, escape, say_number

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


def picture_map(points: pl.DataFrame, own: pl.DataFrame) -> Picture:
    """The map as a figure.

    Args:
        points: as of `place_deployments`.
        own: as of `place_datasets`; may be empty.
    """
    high = points.filter(pl.col("zone") == "high")["key"].to_list()
    words = (
        f"{points.height} deployments of the literature and {own.height} own datasets, by kinetic energy and "
        f"terrain complexity. At high risk: {', '.join(high) or 'none'}."
    )
    return Picture("deployment_map", "The map", draw_map(points, own), words)


def render_map(
    deployments: pl.DataFrame,
    points: pl.DataFrame,
    own: pl.DataFrame,
    *,
    notes: Sequence[str],
    keys: Sequence[str],
) -> str:
    """The whole page as HTML.

    Args:
        deployments: the table of deployments.
        points: as of `place_deployments`.
        own: as of `place_datasets`.
        notes: what must be known.
        keys: run/generation of the runs counted, one text a dataset.
    """
    left = deployments.filter(~pl.col("key").is_in(points["key"].to_list()))
    told = "".join(f"<li>{escape(begin_large(note))}.</li>" for note in notes)
    runs = "".join(f"<li>{escape(line)}</li>" for line in keys)
    chapters = [
        Chapter(
            "map",
            "Who has driven what, where",
            pictures=[picture_map(points, own)],
            rest=f"<ul>{told}</ul>" if told else "",
        ),
        Chapter("own", "Own datasets", rest=_tabulate_own(own)),
        Chapter("literature", "The literature", rest=_tabulate_literature(deployments, points)),
        Chapter(
            "missing",
            "Not on the map",
            lead="<p>Mass, speed or terrain could not be found; these rows wait for somebody who knows.</p>",
            rest=f"<ul>{''.join(_list_row(row) for row in left.iter_rows(named=True))}</ul>",
        ),
        Chapter("provenance", "Runs counted", rest=f"<ul>{runs}</ul>" if runs else "<p>None.</p>"),
    ]
    facts = [f"{deployments.height} deployments", f"{points.height} on the map", f"{own.height} own datasets"]
    return render_gallery("Deployment map", facts, chapters)


def _tabulate_own(own: pl.DataFrame) -> str:
    if own.is_empty():
        return "<p>None: analyze logs, and name their terrain.</p>"
    head = [
        "dataset",
        "runs",
        "kinetic energy <small>J</small>",
        "complexity",
        "median slip <small>m/s</small>",
        "risk",
    ]
    rows = [
        [
            f"<small>{number}</small> {escape(row['dataset'])}",
            str(row["runs"]),
            say_number(row["energy"]),
            say_number(row["complexity"], digits=2),
            say_number(row["slip"]),
            row["zone"],
        ]
        for number, row in enumerate(number_datasets(own).iter_rows(named=True), start=1)
    ]
    return build_table(
        head, rows, caption="Largest kinetic energy of any run, slip over runs", numeric=(1, 2, 3, 4)
    )


def _tabulate_literature(deployments: pl.DataFrame, points: pl.DataFrame) -> str:
    head = [
        "deployment", "mass <small>kg</small>", "known", "speed <small>m/s</small>", "known",
        "kinetic energy <small>J</small>", "complexity", "risk", "publication", "remarks",
    ]  # fmt: skip
    joined = points.select("key", "complexity", "zone").join(deployments, on="key").sort("year", "key")
    signs = {"upper": "\u2264\u202f", "lower": "\u2265\u202f", "uncertain": "~\u202f"}
    rows = [
        [
            escape(row["key"]),
            say_number(row["mass_kg"]),
            escape(row["mass_status"]),
            say_number(row["speed_mps"]),
            escape(row["speed_status"]),
            signs.get(row["kinetic_energy_bound"], "") + say_number(row["kinetic_energy_j"]),
            say_number(row["complexity"], digits=2),
            row["zone"],
            f"<small>{_cite(row)}</small>",
            escape(row["remarks"] or ""),
        ]
        for row in joined.iter_rows(named=True)
    ]
    return build_table(
        head, rows, caption="Values as published; computed energies, bounds marked", numeric=(1, 3, 5, 6)
    )


def _list_row(row: Mapping[str, object]) -> str:
    return f"<li>{escape(row['key'])} <small>{_cite(row)}</small></li>"


def _cite(row: Mapping[str, object]) -> str:
    return ", ".join(escape(row[name]) for name in ("title", "venue") if row[name])
