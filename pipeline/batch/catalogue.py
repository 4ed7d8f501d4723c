"""The catalogue: one offline page over all runs, with columns that sort and a box to search in."""

from __future__ import annotations

import base64
import hashlib
from dataclasses import dataclass
from importlib.resources import files
from typing import TYPE_CHECKING
from urllib.parse import quote

import polars as pl

from pipeline.report.words import escape, say_number
from pipeline.store.queries import scan_table

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.store import Manifest, Store

_REPORT = "report.html"


@dataclass(frozen=True)
class _Column:
    key: str
    title: str
    unit: str = ""
    scale: float = 1.0
    is_number: bool = False


_COLUMNS = (
    _Column("day", "day"),
    _Column("vehicle", "vehicle"),
    _Column("terrain", "terrain"),
    _Column("dataset", "dataset"),
    _Column("duration_s", "duration", "min", 1 / 60.0, is_number=True),
    _Column("distance", "distance", "m", is_number=True),
    _Column("command", "slip on command", "m/s", is_number=True),
    _Column("measured", "slip on measured", "m/s", is_number=True),
    _Column("samples", "samples", is_number=True),
)


def render_catalogue(store: Store) -> str:
    """The page over all runs that can be read; the same results give the same text.

    Args:
        store: the results.
    """
    # Looking through the manifests of a long season takes a while: once for all that is asked of them.
    manifests = store.manifests()
    rows = _gather_rows(store, manifests)
    links = _list_links(store, manifests)
    titles = "".join(
        f'<th scope="col"{_style(column)}><button type="button">{escape(_title(column))}</button></th>'
        for column in (_Column("run", "run"), *_COLUMNS, _Column("state", "log"))
    )
    lines = [_render_row(row, links[str(row["run"])]) for row in rows]
    table = (
        f'<div class="scroll"><table aria-label="Runs"><thead><tr>{titles}</tr></thead>\n'
        f"<tbody>{chr(10).join(lines)}</tbody></table></div>"
    )
    count = f"{len(rows)} of {len(rows)} runs"
    box = (
        '<input id="wanted" type="search" placeholder="Search" aria-label="Search">'
        f'<span id="shown">{count}</span>'
    )
    lead = "<p>Median slip modulus a run; a click on a title sorts, a run leads to its report.</p>"
    return _assemble(f"<h1>Runs</h1>{lead}{box}{table}")


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
    """Relative address of each run's report, or of its folder where it has none."""
    links: dict[str, str] = {}
    for manifest in manifests:
        place = manifest.folder / _REPORT if _REPORT in manifest.files else manifest.folder
        links[manifest.run] = quote(place.relative_to(store.root).as_posix())
    return links


def _render_row(row: Mapping[str, object], link: str) -> str:
    cells = "".join(_render_cell(column, row[column.key]) for column in _COLUMNS)
    state = "complete" if row["complete"] else "losses"
    bad = "" if row["complete"] else ' class="bad"'
    name = f'<th scope="row"><a href="{escape(link)}">{escape(row["run"])}</a></th>'
    return f"<tr>{name}{cells}<td{bad}>{state}</td></tr>"


def _render_cell(column: _Column, value: object) -> str:
    if isinstance(value, int | float):
        scaled = value * column.scale
        shown = f"{value}" if isinstance(value, int) else say_number(scaled)
        return f'<td class="number" data-value="{scaled:.9g}">{shown}</td>'
    return f'<td{_style(column)} data-value="{escape(value or "")}">{escape(value or "")}</td>'


def _style(column: _Column) -> str:
    return ' class="number"' if column.is_number else ""


def _title(column: _Column) -> str:
    return f"{column.title} [{column.unit}]" if column.unit else column.title


def _assemble(body: str) -> str:
    script = _read_own("catalogue.js")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; "
        "base-uri 'none'; form-action 'none'"
    )
    head: Sequence[str] = (
        "<!DOCTYPE html>",
        '<html lang="en"><head><meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        '<meta name="color-scheme" content="light dark">',
        "<title>Runs \u00b7 slip</title>",
        f"<style>{_read_own('catalogue.css')}</style></head>",
    )
    return "\n".join((*head, f"<body>{body}", f"<script>{script}</script>", "</body></html>\n"))


def _read_own(name: str) -> str:
    return files("pipeline.batch").joinpath(name).read_text(encoding="utf-8")
