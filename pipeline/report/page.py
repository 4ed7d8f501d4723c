"""Page of a run, the catalogue, links between pages, and the JavaScript that draws the figures."""

import contextlib
import hashlib
import os
import re
import subprocess
import threading
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from urllib.parse import quote

import polars as pl

from pipeline.core.json_objects import mapping_in
from pipeline.core.program import format_recorded, python_command, shorten
from pipeline.report import theme
from pipeline.report.figures import list_figures
from pipeline.report.figures.figure import Section
from pipeline.report.scene import RunReport, Scene
from pipeline.report.sections import SECTIONS, Page
from pipeline.report.sections_why import summarise_health
from pipeline.report.templating import (
    Column,
    Picture,
    format_date,
    format_distance,
    format_number,
    read_own,
    render_template,
)
from pipeline.report.theme import build_spec, share_rows
from pipeline.store import LOG_NOTES, Manifest, Store
from pipeline.store.parquet_tables import scan_table

# Drawing JavaScript: Vega, Vega-Lite and Vega-Embed, from the Python package that contains them.
#
# Bundling takes most of a second and always gives the same text, so it is cached in the user's cache folder.
# A missing, damaged or read-only cache only costs that second.

_DIGEST_LENGTH = 64
_EXPOSE = "window.vegaEmbed = vegaEmbed;"


def load_bundle() -> str:
    """Script that defines ``vegaEmbed`` on the window, suitable for a script element."""
    path = cache_path()
    cached = _read_checked(path)
    if cached is not None:
        return cached
    import vl_convert  # noqa: PLC0415 - starting its JavaScript engine is what the cache avoids

    # A closing tag inside a string literal would end the script element.
    script: str = (
        vl_convert.javascript_bundle(_EXPOSE).replace("</script", "<\\/script").replace("<!--", "<\\!--")
    )
    _write_checked(path, script)
    return script


def warm_bundle() -> None:
    """Bundle in a separate process, so that it overlaps with reading the log.

    The bundler holds the interpreter lock while it works, so a thread would not help. Returns immediately;
    does nothing if the cache is filled or cannot be written.
    """
    path = cache_path()
    if path.is_file() or not _can_write(path.parent):
        return
    threading.Thread(target=_bundle_apart, name="bundle", daemon=True).start()


def _bundle_apart() -> None:
    with contextlib.suppress(OSError):
        subprocess.run(  # noqa: S603 - our own words
            python_command("-c", "from pipeline.report.page import load_bundle; load_bundle()"),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            check=False,
        )


def cache_path() -> Path:
    """Cache path of the bundle of the installed version."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    what = hashlib.sha256(_EXPOSE.encode()).hexdigest()[:8]
    return Path(base) / "slip" / f"vega-{version('vl-convert-python')}-{what}.js"


def _read_checked(path: Path) -> str | None:
    try:
        content = path.read_bytes()
    except OSError:
        return None
    digest, _, script = content.partition(b"\n")
    if len(digest) != _DIGEST_LENGTH or hashlib.sha256(script).hexdigest().encode() != digest:
        return None
    return script.decode()


def _write_checked(path: Path, script: str) -> None:
    from pipeline.store.files import replace_file  # noqa: PLC0415 - only where it is not cached yet

    body = script.encode()
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, hashlib.sha256(body).hexdigest().encode() + b"\n" + body, durable=False)


def _can_write(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)


# Catalogue: one offline page over all runs, with sortable columns and a search box.
#
# Logs that gave no run are listed below them, with the reason.

_REPORT = "report.html"
_VERDICT = 500
_WITHOUT_RUN = ("failed", "quarantined")
_TEXTS = ("day", "vehicle", "terrain", "dataset")
_NUMBERS = {
    "duration_s": (Column("duration", "min", number=True), 1 / 60.0),
    "distance": (Column("distance", "m", number=True), 1.0),
    "command": (Column("slip from commands", "m/s", number=True), 1.0),
    "measured": (Column("slip from wheel encoders", "m/s", number=True), 1.0),
    "samples": (Column("samples", number=True), 1.0),
}


def render_catalogue(store: Store) -> str:
    """Render the page over all readable runs, and the logs that gave none; deterministic.

    Args:
        store: the results.
    """
    # Reading the manifests of a long season takes time, so they are read only once.
    manifests = store.manifests()
    links = _list_links(store, manifests)
    # Results may be untrusted: texts may have any length.
    verdicts = {one.run: shorten(str(one.details.get("verdict") or ""), _VERDICT) for one in manifests}
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
            "verdict": verdicts.get(str(row["run"]), ""),
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
    """Logs that gave no run in batches, by path: ``path state reason hint``; without those since removed."""
    failed = []
    for note in store.notes(LOG_NOTES).read_all():
        path = str(mapping_in(note, "log").get("path", ""))
        if note.get("state") not in _WITHOUT_RUN or not ("://" in path or Path(path).exists()):
            continue
        failed.append({"path": path} | {key: str(note.get(key) or "") for key in ("state", "reason", "hint")})
    return sorted(failed, key=lambda one: one["path"])


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
            yield column, f"{scaled:.9g}", value if isinstance(value, int) else format_number(scaled)
        else:
            yield column, "", ""


# Pages over all runs of a results folder, and their links.
#
# A page links the existing ones. Every page links the catalogue, which is rewritten with every page and so
# links later ones.

CATALOGUE = "index.html"
PLANS = "workbench/plans"
"""Folder of planned drives, by run."""
PAGES = {
    CATALOGUE: "All runs",
    "comparison.html": "Compare",
    "causes.html": "Causes",
    "fleet.html": "Fleet",
    "trend.html": "Trends",
    "map.html": "Map",
    "terrain.html": "Terrain",
}
_PLACE = re.compile(r'(<nav id="pages"[^>]*>).*?(</nav>)', re.DOTALL)


def write_page(store: Store, name: str, page: str) -> Path:
    """Write one of `PAGES` with links to the others, and rewrite the catalogue, which then links it.

    Other pages are not changed: others may have written them, or they may be damaged.

    Raises:
        StoreError: the disk reports an error.
    """
    path = store.write_results_text(name, _link(store, name, page))
    if name != CATALOGUE:
        store.write_results_text(CATALOGUE, _link(store, CATALOGUE, render_catalogue(store)))
    return path


def is_page(path: str) -> bool:
    """Whether a path in a results folder, for example `runs/a/b/report.html`, is that of a page."""
    kinds = (("runs/", "/report.html"), (f"{PLANS}/", "/plan.html"))
    return path in PAGES or any(path.startswith(top) and path.endswith(name) for top, name in kinds)


def lead_up(run: str, page: str = CATALOGUE) -> str:
    """Address of a page of the results, by default the catalogue, relative to the report of a run."""
    return "../" * (run.count("/") + 3) + quote(page)


def lead_to(results: Path, folder: Path) -> str:
    """Address of the catalogue relative to any folder; empty without a catalogue."""
    page = results / CATALOGUE
    if not page.is_file():
        return ""
    return quote(Path(os.path.relpath(page.resolve(), folder.resolve())).as_posix())


def list_ways(catalogue: str) -> dict[str, str]:
    """Links from a report or a plan to the pages over all runs; none without an address of the catalogue."""
    return {PAGES[CATALOGUE]: catalogue} if catalogue else {}


def _link(store: Store, name: str, page: str) -> str:
    links = ""
    for other, title in PAGES.items():
        if other == name:
            links += f"<b>{title}</b>"
        elif other == CATALOGUE or (store.root / other).is_file():
            links += f'<a href="{other}">{title}</a>'
    return _PLACE.sub(lambda match: match[1] + links + match[2], page, count=1)


# Page of a run, and common parts of all pages with figures.
#
# A page is one file without network requests. Vega evaluates its expressions with its own interpreter,
# without `eval`.


def render_report(report: RunReport) -> str:
    """Render the complete, self-contained page of a run as HTML.

    Args:
        report: summary and tables of the run; figures without rows and sections without content are omitted.

    Returns:
        The page; the same report gives the same text.
    """
    scene = Scene(report)
    drawn = draw_pictures(scene)
    page = Page(report, scene, drawn)
    return render_figures(
        "report/templates/run.html",
        [picture for pictures in drawn.values() for picture in pictures],
        title=report.text("run") or "run",
        ways=list_ways(report.catalogue),
        facts=_list_facts(page),
        strip=summarise_health(report),
        sections=[(section, section.view(page)) for section in SECTIONS],
    )


def draw_pictures(scene: Scene) -> dict[Section, list[Picture]]:
    """Figures with something to draw, by section of the page, in its order."""
    drawn: dict[Section, list[Picture]] = {section: [] for section in Section}
    for figure in list_figures():
        for name, panel in figure.panels(scene).items() if figure.panels else ():
            drawn[figure.section].append(Picture(f"{figure.id}-{name}", name, panel, figure.width))
        drawing = None if figure.panels else figure.draw(scene)
        if drawing is not None:
            drawn[figure.section].append(Picture(figure.id, figure.title, drawing, figure.width))
    return drawn


def render_figures(template: str, pictures: Sequence[Picture], **values: object) -> str:
    """Render a page of figures from a template that extends `figures.html`.

    Args:
        template: path of the template below `pipeline`.
        pictures: the figures of the page.
        values: other values: at least ``title`` and ``facts``.
    """
    own = ("plots.js", "marks.js", "page.js")
    scripts = [load_bundle(), "".join(read_own(f"report/{name}") for name in own)] if pictures else []
    data = {
        "figures": {picture.id: build_spec(picture.drawing) for picture in pictures},
        "rows": share_rows(picture.drawing for picture in pictures),
        "dark": dict(theme.DARK_TWINS),
    }
    style = read_own("report/page.css")
    return render_template(template, style=style, scripts=scripts, data=data, pictures=pictures, **values)


def _list_facts(page: Page) -> list[str]:
    report = page.report
    duration, distance = report.part("log").get("duration_s"), report.number("distance_m")
    line = [
        report.text("vehicle_name") or report.text("vehicle"),
        report.text("terrain"),
        format_date(_first_stamp(page)),
        format_recorded(duration, report.number("duration_s")) if isinstance(duration, int | float) else "",
        format_distance(distance) if distance is not None else "",
    ]
    return [fact for fact in line if fact]


def _first_stamp(page: Page) -> int | None:
    for name in ("velocities", "slip", "poses"):
        table = page.report.table(name)
        if table is not None and "stamp" in table.columns:
            return int(table["stamp"][0])
    return None
