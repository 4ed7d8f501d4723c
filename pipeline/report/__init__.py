"""Figures and the offline page of a run; here what all pages share, and the page that leads to them.

Shared are formatted text, values, templates, and links between pages; the catalogue lists all runs.

A figure is one file in `pipeline.report.figures`: a function from tables to a Vega-Lite chart. A section of
the page is a function from the report to values, and a template that shows them. All numbers come from the
tables and the summary.
"""

from __future__ import annotations

import base64
import functools
import hashlib
import math
import os
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, date, datetime
from functools import partial
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import polars as pl

from pipeline.core import (
    LONGEST_TEXT,
    SlipError,
    find_existing,
    format_count,
    format_part,
    format_share,
    mapping_in,
    name_state,
    naming_os_errors,
    objects_in,
    shorten,
    suffix_unit,
)
from pipeline.datasets import note_robots
from pipeline.recording import Finding
from pipeline.results import read_finding_table
from pipeline.store import (
    LAST_BATCH,
    LOG_NOTES,
    LOG_STATES,
    MANIFEST,
    RUNS,
    Manifest,
    Store,
    date_runs,
    encode_run,
    read_last_batch,
    recorded_path,
)
from pipeline.words import NOTHING, Column, describe_batch, format_other_vehicles

if TYPE_CHECKING:
    from jinja2 import Environment

    from pipeline.report.theme import Drawing


class ReportError(SlipError):
    """A report or a figure cannot be made or written."""


writing_export = partial(
    naming_os_errors,
    ReportError,
    "export_not_written",
    "cannot be written",
    hint="Choose another place with --file.",
)

MISSING = "\u2013"
_SQUARE = re.compile(r"\b(m|rad|s)\^2")
_LITERAL = re.compile(r"(`[^`]+`|(?<![\w-])--[a-z][a-z-]*)")
"""Command in backquotes, or option of one, in a text: browsers would break an option after a hyphen."""
_KILOMETRE = 1000.0
_MOST_PLACES = 3
_EARLIEST_YEAR = 2000
_ROUND_NS, _NEAR_NS = 10**17, 10**9
"""A start within a second after a multiple of 1e8 s, as 1.7e9 s, is that of a converter [ns]."""
_MINUS = re.compile(r"(?<![\w.)\]-])-(?=\.?\d)")
"""Hyphen in front of a number."""
_LABEL_LENGTH = 40
"""Characters of an axis' label that stand beside a figure without making it narrow."""


def begin_large(text: str) -> str:
    """Capitalize the text; identifiers such as `drive_lag.tau` remain unchanged."""
    first = text.split(maxsplit=1)[0].rstrip(".,:;") if text.strip() else ""
    return text if "_" in first or "." in first else text[:1].upper() + text[1:]


def label_names(names: Sequence[str]) -> dict[str, str]:
    """Labels for an axis, all different: names without their common folder, long ones cut in the middle."""
    shared = os.path.commonprefix(list(names)).rpartition("/")[0]  # noqa: RUF071 - cut at a slash
    # Labels of several columns have spaces about their slashes.
    start = 0 if not shared or shared.endswith(" ") else len(shared) + 1
    for most in range(_LABEL_LENGTH, max(map(len, names), default=0) + _LABEL_LENGTH):
        labels = {name: _cut_middle(name[start:], most) for name in names}
        if len(set(labels.values())) == len(set(names)):
            return labels
    return {name: name for name in names}


def _cut_middle(text: str, most: int) -> str:
    head = (most - 1) // 2
    return text if len(text) <= most else f"{text[:head]}\u2026{text[head + 1 - most :]}"


def set_squares(text: str) -> str:
    """Units of a text with squares as a page sets them: m/s\u00b2 for m/s^2."""
    return _SQUARE.sub("\\1\u00b2", text)


def set_numbers(text: str) -> str:
    """Numbers of a text as a page sets them: with a minus, an arrow, or a dash where unknown."""
    return MISSING if text == NOTHING else _MINUS.sub("\u2212", text).replace(" -> ", " \u2192 ")


def bracket_unit(unit: str) -> str:
    """A unit in brackets behind the name of a quantity; empty for a plain number."""
    return set_squares(f" [{unit}]") if suffix_unit(unit) else ""


def format_number(value: float | None, *, digits: int = 3) -> str:
    """Number with this many significant digits, at most three decimals; a dash if missing."""
    if value is None or not math.isfinite(value):
        return MISSING
    if value == 0.0:
        return "0"
    # Of 0.9999 the first of three digits is that of 1.00.
    first = math.floor(math.log10(abs(float(f"{value:.{digits - 1}e}"))))
    places = max(0, digits - 1 - first)
    return f"{value:z,.{min(places, _MOST_PLACES)}f}".replace("-", "\u2212")


def format_known_share(value: float | None) -> str:
    """Share as a percentage, a dash if missing."""
    return MISSING if value is None else format_part(value).replace("-", "\u2212").replace(" ", "\u202f")


def format_split(drivetrain: float, ground: float, cross: float) -> str:
    """Split of the mean square of the slip from commands; in words if the parts cancel each other.

    Args:
        drivetrain: share between command and wheels.
        ground: share between wheels and body.
        cross: share of twice their product.
    """
    if max(drivetrain, ground) <= 1.0:
        parts = {"drivetrain": drivetrain, "ground": ground}
        parts["cancelling each other" if cross < 0.0 else "acting together"] = cross
        return ", ".join(f"{name} {format_share(share, 0)}" for name, share in parts.items()).replace(
            "-", "\u2212"
        )
    one, two = (format_number(math.sqrt(share), digits=2) for share in (drivetrain, ground))
    return f"drivetrain and ground cancel in part: {one} and {two} times the RMS of their sum"


def format_distance(metres: float | None) -> str:
    """A distance in m or km."""
    if metres is None:
        return MISSING
    return f"{metres / _KILOMETRE:.2f} km" if metres >= _KILOMETRE else f"{metres:.0f} m"


def count_serious(findings: Iterable[Finding]) -> dict[str, str]:
    """Number of findings of each serious severity as text, such as `2 warnings`."""
    severities = [finding.severity for finding in findings]
    counts = {name: severities.count(name) for name in ("error", "warning")}
    return {name: f"{count} {name}{'s' if count > 1 else ''}" for name, count in counts.items() if count}


def format_date(run: str, nanoseconds: int | None) -> str:
    """Start of a run: date and time (UTC) of its first stamp; empty if the clock was never set.

    Where a date in the name contradicts the clock, that date counts, as everywhere. A start at a round epoch,
    as 1.7e9 s, is one that a converter set.
    """
    dates = date_runs({run: nanoseconds})
    if dates.notes or nanoseconds is None:
        return dates.days[run] or ""
    try:
        day = datetime.fromtimestamp(nanoseconds / 1e9, UTC)
    except (OverflowError, OSError, ValueError):
        return ""
    is_set = day.year >= _EARLIEST_YEAR and nanoseconds % _ROUND_NS >= _NEAR_NS
    return day.strftime("%Y-%m-%d %H:%M UTC") if is_set else ""


# HTML from the templates beside the code; all texts are escaped.
#
# A template is named by its path below `pipeline`. Only `base.html` marks content as `safe`: our own style
# and scripts.

_REPLACEMENT = "\ufffd"


def render_template(name: str, **values: object) -> str:
    """Render a template; an undefined name in the template is an error.

    Args:
        name: path of the template below `pipeline`.
        values: its values; texts are escaped, and control characters, including those that change the writing
            direction, become visible marks.
    """
    return _environment().get_template(name).render(values)


def read_own(name: str) -> str:
    """Read a file beside the code, by its path below `pipeline`."""
    return files("pipeline").joinpath(name).read_text(encoding="utf-8")


@functools.cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined  # noqa: PLC0415 - only pages need it

    environment = Environment(
        loader=PackageLoader("pipeline", ""),
        autoescape=True,
        finalize=show_text,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "capital": begin_large,
        "squares": set_squares,
        "split_literals": _LITERAL.split,
        "distance": format_distance,
        "number": format_number,
        "numeral": set_numbers,
        "sha256": lambda text: base64.b64encode(hashlib.sha256(text.encode()).digest()).decode(),
        "share": format_known_share,
    }
    environment.policies["json.dumps_kwargs"] = {
        "allow_nan": False,
        "separators": (",", ":"),
        "sort_keys": True,
    }
    return environment


def show_text(value: object) -> object:
    """Make control characters of a text visible; other types and HTML are returned unchanged."""
    if not isinstance(value, str) or value.isprintable() or hasattr(value, "__html__"):
        return value
    return "".join(
        _REPLACEMENT if mark not in "\n\t" and unicodedata.category(mark).startswith("C") else mark
        for mark in value
    )


@dataclass(frozen=True)
class Picture:
    """Figure of a page.

    Attributes:
        id: stable name, also of its file.
        title: what it shows, in a few words.
        drawing: chart, rows and words.
        width: share of a wide page's width, `half` or `full`.
    """

    id: str
    title: str
    drawing: Drawing
    width: str = "full"


# Catalogue: one offline page over all runs, with sortable columns and a search box.
#
# Logs that gave no run are listed below them, with the reason.

_REPORT = "report.html"
_VERDICT = 500
_WITHOUT_RUN = ("failed", "quarantined", "copy", "ignored")
_TEXTS = ("day", "vehicle", "terrain", "dataset")
_NUMBERS = {
    "duration_s": (Column("duration", "min", number=True), 1 / 60.0),
    "distance": (Column("distance", "m", number=True), 1.0),
    "command": (Column("slip from commands", "m/s", number=True), 1.0),
    "measured": (Column("slip from wheel encoders", "m/s", number=True), 1.0),
    "ideal": (Column("error over 2 s, ideal", "m", number=True), 1.0),
    "model": (Column("error over 2 s, model", "m", number=True), 1.0),
}


def render_catalogue(store: Store) -> str:
    """Render the page over all readable runs, and the logs that gave none; deterministic.

    Args:
        store: the results.
    """
    # Reading the manifests of a long season takes time, so they are read only once.
    manifests = store.manifests()
    links = {
        manifest.run: quote((manifest.folder / _REPORT).relative_to(store.root).as_posix())
        for manifest in manifests
        if _REPORT in manifest.files
    }
    # Results may be untrusted: texts may have any length.
    verdicts = {one.run: shorten(str(one.details.get("verdict") or ""), _VERDICT) for one in manifests}
    gathered = _gather_rows(store, manifests) if manifests else []
    # Columns that no run has a number for would only make the table wide.
    numbers = [key for key in _NUMBERS if any(isinstance(row[key], int | float) for row in gathered)]
    columns = [
        Column("run"),
        *map(Column, _TEXTS),
        *(_NUMBERS[key][0] for key in numbers),
        Column("log"),
    ]
    noted = list_noted(store)
    rows = [
        {
            "run": row["run"],
            "link": links.get(str(row["run"]), ""),
            "verdict": verdicts.get(str(row["run"]), ""),
            "log": shorten(str(row["log"] or ""), LONGEST_TEXT),
            "complete": row["complete"],
            "cells": list(_list_cells(row, numbers)),
        }
        for row in gathered
    ]
    return render_template(
        "report/templates/catalogue.html",
        title="Runs",
        style=read_own("report/catalogue.css"),
        scripts=[read_own("report/catalogue.js")],
        columns=columns,
        rows=rows,
        batch=_format_batch(store),
        notes=[*note_robots(manifests), *note_vehicles(manifests)],
        dated=_date_errors(gathered),
        counts=[
            f"{count} {'copy' if (state, count) == ('copy', 1) else name_state(state)}"
            for state, count in count_logs(noted).items()
            if count
        ],
        explained=[_explain(one) for one in noted if one["state"] != "done"],
    )


def note_vehicles(manifests: Iterable[Manifest]) -> list[str]:
    """Sentences on runs whose log indicates another vehicle than the one that is stated for it."""
    contradictions: list[tuple[str, Mapping[str, Any]]] = []
    for manifest in manifests:
        # A damaged table is told by whoever verifies the results.
        with suppress(SlipError):
            findings = read_finding_table(manifest.read("findings"))
            contradictions += [
                (manifest.run, one.values)
                for one in findings
                if one.id == "vehicle_contradiction" and "indicated" in one.values
            ]
    return format_other_vehicles(contradictions)


def _explain(noted: Mapping[str, str]) -> dict[str, str]:
    """A log that needs a look, in words."""
    if noted["state"] == "copy":
        return {**noted, "reason": f"the same content as {noted['reason']}"}
    return {**noted, "state": name_state(noted["state"])}


def list_noted(store: Store) -> list[dict[str, str]]:
    """What became of each log, by path: ``path state reason hint``; without those since removed or moved.

    Of several logs of one run the first that is there counts, and the others are copies of it; where none is
    there any more, the first is gone; without results it does not count. One of which nobody can say whether
    it is there is left out, as are the paths that the last batch could not look at.
    """
    noted: list[dict[str, str]] = []
    absent: list[tuple[str, str, str, str]] = []
    holders: set[str] = set()
    notes = {str(mapping_in(note, "log").get("path", "")): note for note in store.notes(LOG_NOTES).read_all()}
    existing = find_existing((path for path in sorted(notes) if "://" not in path), _PATIENCE_S)
    for path, note in sorted(notes.items()):
        texts = {key: shorten(str(note.get(key) or ""), LONGEST_TEXT) for key in ("state", "reason", "hint")}
        # A log that cannot show slip has results or none.
        run = str(note.get("run") or "")
        has_run = bool(note.get("key")) and texts["state"] not in _WITHOUT_RUN
        is_there = existing.get(path, True)
        if is_there is not True:
            if is_there:
                absent.append((path, run if has_run else "", "left_out", is_there))
            elif has_run and (store.root / RUNS / encode_run(run) / MANIFEST).exists():
                absent.append((path, run, "gone", _GONE))
            continue
        if has_run and run in holders:
            texts = {"state": "copy", "reason": run, "hint": ""}
        elif has_run:
            holders.add(run)
        noted.append({"path": path} | texts)
    for path, run, state, reason in absent:
        if not run or run not in holders:
            holders.add(run)
            noted.append({"path": path, "state": state, "reason": reason, "hint": ""})
    folder, name = LAST_BATCH
    known = {one["path"] for one in noted}
    noted += [
        {"path": str(one["path"]), "state": "left_out"}
        | {key: str(one.get(key) or "") for key in ("reason", "hint")}
        for one in objects_in(store.notes(folder).read(name) or {}, "left_out")
        if one.get("path") not in known
    ]
    return sorted(noted, key=lambda one: one["path"])


def mark_batch(store: Store) -> None:
    """Bring what the catalogue says of the last batch up to date, without making the page again.

    Raises:
        StoreError: the disk reports an error.
    """
    text = escape(_format_batch(store))
    store.edit_results_text(
        CATALOGUE, partial(_BATCH.sub, lambda match: f"{match[1]}{text}{match[2]}", count=1)
    )


def _format_batch(store: Store) -> str:
    said = describe_batch(read_last_batch(store))
    return f"The last batch {said}." if said else ""


_BATCH = re.compile(r'(<p id="batch">).*?(</p>)', re.DOTALL)


_GONE = "the log is not there any more; its results are kept"


_PATIENCE_S = 5.0
"""How long the mount of a log may take to answer [s]: a dead one never does."""


def count_logs(noted: Iterable[Mapping[str, str]]) -> dict[str, int]:
    """How many logs of `list_noted` came out how, by each of `LOG_STATES`: the numbers of every face."""
    states = [one["state"] for one in noted]
    return {state: states.count(state) for state in LOG_STATES}


def _gather_rows(store: Store, manifests: Sequence[Manifest]) -> list[dict[str, object]]:
    runs = store.scan("runs", manifests).collect()
    medians = (
        store.scan("aggregates", manifests)
        .filter(pl.col("subset") == "all")
        .select("run", "input", "median_modulus", "distance")
        .collect()
    )
    # Those of the commands where they were recorded, as everywhere.
    facts = medians.sort("input").group_by("run").agg(pl.col("distance").first())
    for name in ("command", "measured"):
        one = medians.filter(pl.col("input") == name).select("run", pl.col("median_modulus").alias(name))
        facts = facts.join(one, on="run", how="left")
    steps = (
        store.scan("ladder", manifests)
        .filter(pl.col("kind").cast(pl.String) == "rung")
        .sort("rung")
        .collect()
    )
    ends = steps.group_by("run").agg(
        pl.col("t_mrmse").first().alias("ideal"), pl.col("t_mrmse").last().alias("model")
    )
    return runs.join(facts, on="run", how="left").join(ends, on="run", how="left").sort("run").to_dicts()


def _date_errors(rows: Sequence[Mapping[str, object]]) -> dict[str, object] | None:
    """Errors over 2 s over the dates of runs, as shares of a figure's width and height; None for one date.

    Returns:
        ``points``; ``heights`` and ``dates``, the labels of both axes by their shares; and ``vehicles`` by
        the number of their colour, those with the most runs first.
    """
    known = [
        (date.fromisoformat(str(row["day"])).toordinal(), ideal, model, row)
        for row in rows
        if row["day"]
        and isinstance(ideal := row["ideal"], float)
        and isinstance(model := row["model"], float)
        and math.isfinite(ideal + model)
    ]
    days = sorted({day for day, *_ in known})
    if len(days) < 2:  # noqa: PLR2004 - dates have an order from two on
        return None
    most = max(max(ideal, model) for _, ideal, model, _ in known) or 1.0
    step = next(step for step in _list_steps() if step * _MOST_HEIGHTS >= most)
    top, span = step * math.ceil(most / step), days[-1] - days[0]
    counts = Counter(str(row["vehicle"] or _NO_VEHICLE) for *_, row in known)
    vehicles = [name for name, _ in sorted(counts.items(), key=lambda item: (-item[1], item[0]))]
    others = min(len(vehicles), _COLOURS)
    numbers = {name: min(number, others) for number, name in enumerate(vehicles)}
    labels = vehicles[:others]
    if len(vehicles) > others:
        labels.append(format_count(len(vehicles) - others, "other vehicle"))
    points = [
        {
            "x": (day - days[0]) / span,
            "ideal": ideal / top,
            "model": model / top,
            "run": str(row["run"]),
            "vehicle": (number := numbers[str(row["vehicle"] or _NO_VEHICLE)]),
            # Vehicles of one day stand side by side.
            "shift": round(_APART_PX * (number - (len(labels) - 1) / 2), 1),
        }
        for day, ideal, model, row in sorted(known, key=lambda one: (one[0], str(one[3]["run"])))
    ]
    marked = sorted({0, span // 2, span})
    return {
        "points": points,
        "heights": {number * step / top: f"{number * step:g}" for number in range(round(top / step) + 1)},
        "dates": {day / span: date.fromordinal(days[0] + day).isoformat() for day in marked},
        "vehicles": labels,
    }


_MOST_HEIGHTS = 4
_COLOURS = 6
"""Vehicles with a colour of their own in the catalogue's style; the others share one."""
_APART_PX = 6.0
_NO_VEHICLE = "unknown vehicle"


def _list_steps() -> Iterator[float]:
    """Steps between the labels of an axis."""
    for exponent in range(-6, 300):
        yield from (digit * 10.0**exponent for digit in (1, 2, 5))


def _list_cells(row: Mapping[str, object], numbers: Sequence[str]) -> Iterator[tuple[Column, object, object]]:
    """Column, value to sort by, and text of a row's cells."""
    for key in _TEXTS:
        yield Column(key), row[key] or "", row[key] or ""
    for key in numbers:
        column, scale = _NUMBERS[key]
        value = row[key]
        if isinstance(value, int | float):
            scaled = value * scale
            yield column, f"{scaled:.9g}", value if isinstance(value, int) else format_number(scaled)
        else:
            yield column, "", ""


# Pages over all runs of a results folder, and their links.
#
# Every page links the existing others; writing one brings the links of the others up to date.

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
}
_PLACE = re.compile(r'(<nav id="pages"[^>]*>).*?(</nav>)', re.DOTALL)


def write_page(store: Store, name: str, page: str) -> Path:
    """Write one of `PAGES` with links to the others, rewrite the catalogue, and renew the others' links.

    Pages that are not as they were written, because they are damaged or of another origin, are not changed.

    Raises:
        StoreError: the disk reports an error.
    """
    path = store.write_results_text(name, _link(store, name, page))
    if name != CATALOGUE:
        for other in PAGES:
            if other not in (CATALOGUE, name):
                store.edit_results_text(other, partial(_link, store, other))
        store.write_results_text(CATALOGUE, _link(store, CATALOGUE, render_catalogue(store)))
    return path


def is_page(path: str) -> bool:
    """Whether a path in a results folder, for example `runs/a/b/report.html`, is that of a page."""
    kinds = (("runs/", "/report.html"), (f"{PLANS}/", "/plan.html"))
    return path in PAGES or any(path.startswith(top) and path.endswith(name) for top, name in kinds)


def lead_up(run: str, page: str = CATALOGUE) -> str:
    """Address of a page of the results, by default the catalogue, relative to the report of a run."""
    return "../" * (len(encode_run(run).parts) + 2) + quote(page)


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
