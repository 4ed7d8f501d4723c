"""The catalogue: one offline page over all runs, with columns that sort and a box to search in.

Logs that gave no run stand below them, with the reason.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from urllib.parse import quote

import polars as pl

from pipeline.report.elements import Column
from pipeline.report.run import mapping_in
from pipeline.report.templating import read_own, render_template
from pipeline.report.words import say_number
from pipeline.store import LOG_NOTES, Manifest, Store
from pipeline.store.queries import scan_table

_REPORT = "report.html"
_WITHOUT_RUN = ("failed", "quarantined")
_TEXTS = ("day", "vehicle", "terrain", "dataset")
_NUMBERS = {
    "duration_s": (Column("duration", "min", number=True), 1 / 60.0),
    "distance": (Column("distance", "m", number=True), 1.0),
    "command": (Column("slip on command", "m/s", number=True), 1.0),
    "measured": (Column("slip on measured", "m/s", number=True), 1.0),
    "samples": (Column("samples", number=True), 1.0),
}


def render_catalogue(store: Store) -> str:
    """The page over all runs that can be read, and the logs that gave none; equal results give equal text.

    Args:
        store: the results.
    """
    # Looking through the manifests of a long season takes a while: once for all that is asked of them.
    manifests = store.manifests()
    links = _list_links(store, manifests)
    columns = [
        Column("run"),
        *map(Column, _TEXTS),
        *(column for column, _ in _NUMBERS.values()),
        Column("log"),
    ]
    rows = [
        {
            "run": row["run"],
            "link": links.get(str(row["run"]), ""),
            "complete": row["complete"],
            "cells": list(_list_cells(row)),
        }
        for row in (_gather_rows(store, manifests) if manifests else [])
    ]
    return render_template(
        "report/templates/catalogue.html",
        title="Runs",
        style=read_own("report/catalogue.css"),
        scripts=[read_own("report/catalogue.js")],
        columns=columns,
        rows=rows,
        failed=list_failed(store),
    )


def list_failed(store: Store) -> list[dict[str, str]]:
    """Logs that gave no run in batches, by path: ``path state reason hint``; those that are gone left out."""
    found = []
    for note in store.notes(LOG_NOTES).read_all():
        path = str(mapping_in(note, "log").get("path", ""))
        if note.get("state") not in _WITHOUT_RUN or not ("://" in path or Path(path).exists()):
            continue
        found.append({"path": path} | {key: str(note.get(key) or "") for key in ("state", "reason", "hint")})
    return sorted(found, key=lambda one: one["path"])


def _gather_rows(store: Store, manifests: Sequence[Manifest]) -> list[dict[str, object]]:
    runs = scan_table("runs", root=store.root, manifests=manifests).collect()
    medians = (
        scan_table("aggregates", root=store.root, manifests=manifests)
        .filter(pl.col("subset") == "all")
        .select("run", "input", "median_modulus", "distance", "samples")
        .collect()
    )
    facts = medians.group_by("run").agg(pl.col("distance").max(), pl.col("samples").max())
    for name in ("command", "measured"):
        one = medians.filter(pl.col("input") == name).select("run", pl.col("median_modulus").alias(name))
        facts = facts.join(one, on="run", how="left")
    return runs.join(facts, on="run", how="left").sort("run").to_dicts()


def _list_links(store: Store, manifests: Sequence[Manifest]) -> Mapping[str, str]:
    """Relative address of the report of each run that has one."""
    return {
        manifest.run: quote((manifest.folder / _REPORT).relative_to(store.root).as_posix())
        for manifest in manifests
        if _REPORT in manifest.files
    }


def _list_cells(row: Mapping[str, object]) -> Iterator[tuple[Column, object, object]]:
    """Column, value to sort by, and text of a row's cells."""
    for key in _TEXTS:
        yield Column(key), row[key] or "", row[key] or ""
    for key, (column, scale) in _NUMBERS.items():
        value = row[key]
        if isinstance(value, int | float):
            scaled = value * scale
            yield column, f"{scaled:.9g}", value if isinstance(value, int) else say_number(scaled)
        else:
            yield column, "", ""
