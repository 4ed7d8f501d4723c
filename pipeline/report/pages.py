"""The pages over all runs of a results folder, and the links between them: only to those that are there."""

from __future__ import annotations

import html
import os
import re
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

if TYPE_CHECKING:
    from pipeline.store import Store

CATALOGUE = "index.html"
PAGES = {
    CATALOGUE: "All runs",
    "comparison.html": "Compare",
    "causes.html": "Causes",
    "trend.html": "Trends",
    "map.html": "Map",
}
_PLACE = re.compile(r'(<nav id="pages"[^>]*>).*?(</nav>)', re.DOTALL)


def write_page(store: Store, name: str, page: str) -> Path:
    """Write one of `PAGES`, and link it and those that are there to each other.

    Raises:
        StoreError: the disk refuses.
    """
    if not (store.root / name).is_file():
        # A new page: the others are to know of it.
        store.write_results_text(name, page)
        for other in (other for other in PAGES if other != name and (store.root / other).is_file()):
            text = (store.root / other).read_text(encoding="utf-8")
            store.write_results_text(other, _link(store, other, text))
    return store.write_results_text(name, _link(store, name, page))


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
        if other == name or (store.root / other).is_file()
    )
    return _PLACE.sub(lambda found: found[1] + links + found[2], page, count=1)
