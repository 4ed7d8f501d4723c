"""The pages over all runs of a results folder, and their links.

Every page names all of them. One that was not there when a page was made is looked for by way of the
catalogue, which is made anew with every page: it leads on to what came since, and says how to make the rest.
"""

import html
import os
import re
from pathlib import Path
from urllib.parse import quote

from pipeline.report.catalogue import render_catalogue
from pipeline.store import Store

CATALOGUE = "index.html"
PLANS = "workbench/plans"
"""Folder of drives that were planned, by run."""
PAGES = {
    CATALOGUE: "All runs",
    "comparison.html": "Compare",
    "causes.html": "Causes",
    "fleet.html": "Fleet",
    "trend.html": "Trends",
    "map.html": "Map",
}
_MADE_BY = {
    "comparison.html": "slip compare",
    "causes.html": "slip compare --causes",
    "fleet.html": "slip fleet fit",
}
_PLACE = re.compile(r'(<nav id="pages"[^>]*>).*?(</nav>)', re.DOTALL)


def write_page(store: Store, name: str, page: str) -> Path:
    """Write one of `PAGES` with links to the others, and the catalogue anew, which so knows it.

    Other pages are left as they are: what stands in them was made by others, or is damaged.

    Raises:
        StoreError: the disk refuses.
    """
    path = store.write_results_text(name, _link(store, name, page))
    if name != CATALOGUE:
        store.write_results_text(CATALOGUE, _link(store, CATALOGUE, render_catalogue(store)))
    return path


def is_page(place: str) -> bool:
    """Whether a place in a results folder, as `runs/a/b/report.html`, is that of a page."""
    kinds = (("runs/", "/report.html"), (f"{PLANS}/", "/plan.html"))
    return place in PAGES or any(place.startswith(top) and place.endswith(name) for top, name in kinds)


def lead_up(run: str, page: str = CATALOGUE) -> str:
    """The address of a page of the results, the catalogue if none is said, seen from the report of a run."""
    return "../" * (run.count("/") + 3) + quote(page)


def lead_to(results: Path, folder: Path) -> str:
    """The address of the catalogue seen from a folder anywhere; empty where there is none."""
    page = results / CATALOGUE
    if not page.is_file():
        return ""
    return quote(Path(os.path.relpath(page.resolve(), folder.resolve())).as_posix())


def list_ways(catalogue: str) -> dict[str, str]:
    """Titles of `PAGES` and the ways to them through the catalogue; none where it has no address."""
    ways = {title: f"{catalogue}#{Path(name).stem}" for name, title in PAGES.items()}
    return ways | {PAGES[CATALOGUE]: catalogue} if catalogue else {}


def _link(store: Store, name: str, page: str) -> str:
    links = ""
    for (title, way), other in zip(list_ways(CATALOGUE).items(), PAGES, strict=True):
        stem, is_there = Path(other).stem, other == CATALOGUE or (store.root / other).is_file()
        if other == name:
            links += f"<b>{title}</b>"
        elif is_there or name != CATALOGUE:
            links += f'<a href="{html.escape(other if is_there else way)}" data-page="{stem}">{title}</a>'
        else:
            links += f'<span id="{stem}">{title}: <code>{_MADE_BY.get(other, f"slip {stem}")}</code></span>'
    return _PLACE.sub(lambda found: found[1] + links + found[2], page, count=1)
