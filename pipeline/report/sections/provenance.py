"""Where the numbers came from: the log, the program, the configuration."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING

from pipeline.report.run import mapping_in
from pipeline.report.words import escape

if TYPE_CHECKING:
    from pipeline.report.sections.page import Page


def render_provenance(page: Page) -> str:
    """Path and hash of the log, keys and versions, the configuration as it was used."""
    report = page.report
    log, origin = report.part("log"), report.part("provenance")
    facts = [("log", log.get("path")), ("SHA-256", log.get("sha256"))]
    facts += [("dataset", report.text("dataset")), ("rate", _say_rate(report.number("rate_hz")))]
    facts += [(name, _list_entries(mapping_in(origin, name))) for name in ("versions", "keys")]
    items = "".join(
        f"<div><dt>{escape(name)}</dt><dd><code>{escape(value)}</code></dd></div>"
        for name, value in facts
        if value
    )
    return f'<dl class="facts">{items}</dl>' + _render_configuration(origin.get("configuration"))


def _list_entries(entries: Mapping[str, object]) -> str:
    return ", ".join(f"{name} {value}" for name, value in entries.items())


def _say_rate(rate: float | None) -> str:
    return f"{rate:g} Hz" if rate is not None else ""


def _render_configuration(configuration: object) -> str:
    if not configuration:
        return ""
    if isinstance(configuration, Mapping):
        shown = json.dumps(configuration, indent=2, sort_keys=True, ensure_ascii=False, default=str)
    else:
        shown = str(configuration)
    return f"<details><summary>Configuration as it was used</summary><pre>{escape(shown)}</pre></details>"
