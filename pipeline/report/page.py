"""The page: one file that asks the network for nothing.

Scripts run only if their hash stands in the page's content security policy, so a text out of a log could not
run even if it escaped its place. Vega evaluates its expressions with its own interpreter, without `eval`.
"""

from __future__ import annotations

import base64
import hashlib
from importlib.resources import files
from typing import TYPE_CHECKING

from pipeline.report import theme
from pipeline.report.bundle import load_bundle
from pipeline.report.figures import list_figures
from pipeline.report.scene import Scene
from pipeline.report.sections import SECTIONS, Page
from pipeline.report.sections.health import summarise_health
from pipeline.report.specs import build_spec, share_rows
from pipeline.report.words import encode_json, escape, say_date, say_distance, say_duration

if TYPE_CHECKING:
    from pipeline.report.run import RunReport


def render_report(report: RunReport) -> str:
    """The whole page of a run as HTML, with everything inside that it needs.

    Args:
        report: summary and tables of the run; figures without rows and sections without content are left out.

    Returns:
        The page; the same report gives the same text.
    """
    scene = Scene(report)
    drawn = [(figure, figure.draw(scene)) for figure in list_figures()]
    drawings = [(figure, drawing) for figure, drawing in drawn if drawing is not None]
    page = Page(report, scene, drawings)
    data = {
        "figures": {figure.id: build_spec(drawing) for figure, drawing in drawings},
        "rows": share_rows(drawing for _, drawing in drawings),
        "dark": dict(theme.DARK_TWINS),
    }
    scripts = load_scripts() if drawings else []
    body = _render_header(page) + _render_sections(page)
    return assemble_page(escape(report.text("run") or "run"), body, encode_json(data), scripts)


def _render_header(page: Page) -> str:
    report = page.report
    duration = report.part("log").get("duration_s")
    line = [
        report.text("vehicle_name") or report.text("vehicle"),
        report.text("terrain"),
        say_date(_first_stamp(page)),
        say_duration(float(duration)) if isinstance(duration, int | float) else "",
        say_distance(report.number("distance_m")) if report.number("distance_m") is not None else "",
    ]
    facts = "".join(f"<li>{escape(part)}</li>" for part in line if part)
    strip = "".join(
        f'<li class="grade-{grade}"><a href="#health">{escape(words)}</a></li>'
        for grade, words in summarise_health(report)
    )
    return (
        f'<header><h1>{escape(report.text("run") or "run")}</h1><ul class="line">{facts}</ul>'
        f'<ul class="strip" aria-label="Health of the log">{strip}</ul></header>'
    )


def _first_stamp(page: Page) -> int | None:
    for name in ("velocities", "slip", "poses"):
        table = page.report.table(name)
        if table is not None and "stamp" in table.columns:
            return int(table["stamp"][0])
    return None


def _render_sections(page: Page) -> str:
    shown = []
    for section in SECTIONS:
        content = section.render(page)
        if content:
            shown.append(
                f'<section id="{section.id}" aria-labelledby="{section.id}-title">'
                f'<h2 id="{section.id}-title">{section.title}</h2>\n{content}</section>'
            )
    return f"<main>{chr(10).join(shown)}</main>"


def load_scripts() -> list[str]:
    """What a page with figures runs: Vega, what draws, what links."""
    return [load_bundle(), "".join(_read_own(name) for name in ("plots.js", "marks.js", "page.js"))]


def assemble_page(title: str, body: str, data: str, scripts: list[str]) -> str:
    """A whole page that asks the network for nothing.

    Args:
        title: of the window, as HTML.
        body: content as HTML.
        data: figures and rows as JSON that may stand in a script element.
        scripts: JavaScript; only these run.
    """
    hashes = " ".join(f"'sha256-{_hash(script)}'" for script in scripts) or "'none'"
    policy = (
        f"default-src 'none'; script-src {hashes}; style-src 'unsafe-inline'; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )
    parts = [
        "<!DOCTYPE html>",
        '<html lang="en"><head><meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        '<meta name="color-scheme" content="light dark">',
        '<meta name="referrer" content="no-referrer">',
        f"<title>{title} \u00b7 slip</title>",
        f"<style>{_read_own('page.css')}</style></head>",
        f"<body>{body}",
        _MARKED,
        f'<script type="application/json" id="page-data">{data}</script>',
        *(f"<script>{script}</script>" for script in scripts),
        "</body></html>\n",
    ]
    return "\n".join(parts)


def _hash(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


def _read_own(name: str) -> str:
    return files("pipeline.report").joinpath(name).read_text(encoding="utf-8")


_MARKED = (
    '<div id="marked" role="status" hidden><span></span><button type="button" id="zoom-in">Zoom</button>'
    '<button type="button" id="mark-clear">Clear</button>'
    '<button type="button" id="zoom-out" hidden>Whole run</button></div>'
)
