"""The pages over all runs of a results folder, and their links: only to those that are there."""

from __future__ import annotations

import html
import os
import re
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from pipeline.report.catalogue import render_catalogue

if TYPE_CHECKING:
    from pipeline.store import Store

CATALOGUE = "index.html"
PAGES = {
    CATALOGUE: "All runs",
    "comparison.html": "Compare",
    "causes.html": "Causes",
    "fleet.html": "Fleet",
    "trend.html": "Trends",
    "map.html": "Map",
}
_PLACE = re.compile(r'(<nav id="pages"[^>]*>).*?(</nav>)', re.DOTALL)


def write_page(store: Store, name: str, page: str) -> Path:
    """Write one of `PAGES` with links to those that are there, and the catalogue anew, which so knows it.

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
    return place in PAGES or (place.startswith("runs/") and place.endswith("/report.html"))


def lead_up(run: str) -> str:
    """The address of the catalogue seen from the report of a run."""
    return "../" * (run.count("/") + 3) + CATALOGUE


def lead_to(results: Path, folder: Path) -> str:
    """The address of the catalogue seen from a folder anywhere; empty where there is none."""
    page = results / CATALOGUE
    if not page.is_file():
        return ""
    return quote(Path(os.path.relpath(page.resolve(), folder.resolve())).as_posix())


def _link(store: Store, name: str, page: str) -> str:
    links = "".join(
        f"<b>{title}</b>" if other == name else f'<a href="{html.escape(other)}">{title}</a>'
        for other, title in PAGES.items()
        if other in {name, CATALOGUE} or (store.root / other).is_file()
    )
    return _PLACE.sub(lambda found: found[1] + links + found[2], page, count=1)
