"""Text for the page: escaping, numbers with units, durations."""

from __future__ import annotations

import html
import json
import math
import re
import unicodedata
from datetime import UTC, datetime
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

_MISSING = "\u2013"
_MINUTE, _HOUR = 60.0, 3600.0
_KILOMETRE = 1000.0
_MOST_PLACES = 3
_EARLIEST_YEAR = 2000
_MOST_COLUMNS = 3
_MARKUP = re.compile("<[^<>]*>")


def escape(text: object) -> str:
    """A text as HTML, safe in content and in quoted attributes.

    Control characters, also those that turn the writing direction, become visible marks.
    """
    visible = "".join("\ufffd" if _is_control(mark) else mark for mark in str(text))
    return html.escape(visible, quote=True)


def _is_control(mark: str) -> bool:
    return unicodedata.category(mark).startswith("C") and mark not in "\n\t"


def begin_large(text: str) -> str:
    """The text with a capital at its start."""
    return text[:1].upper() + text[1:]


def encode_json(value: object) -> str:
    """JSON that may stand inside a script element: nothing in it can end the element or start a comment."""
    packed = json.dumps(value, separators=(",", ":"), sort_keys=True, ensure_ascii=True, allow_nan=False)
    return packed.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def say_number(value: float | None, *, digits: int = 3) -> str:
    """A number with so many significant digits, at most three decimals; a dash when there is none."""
    if value is None or not math.isfinite(value):
        return _MISSING
    if value == 0.0:
        return "0"
    places = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:,.{min(places, _MOST_PLACES)}f}".replace("-", "\u2212")


def say_share(value: float | None) -> str:
    """A share as a percentage, a dash when there is none."""
    return _MISSING if value is None else f"{value:.0%}".replace("-", "\u2212").replace("%", "\u202f%")


def say_duration(seconds: float | None) -> str:
    """A duration in the two units that matter."""
    if seconds is None:
        return _MISSING
    if seconds < _MINUTE:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < _HOUR:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def say_distance(metres: float | None) -> str:
    """A distance in m or km."""
    if metres is None:
        return _MISSING
    return f"{metres / _KILOMETRE:.2f} km" if metres >= _KILOMETRE else f"{metres:.0f} m"


def say_date(nanoseconds: int | None) -> str:
    """Day and time (UTC) of a stamp; empty where the clock was never set."""
    if nanoseconds is None:
        return ""
    try:
        day = datetime.fromtimestamp(nanoseconds / 1e9, UTC)
    except (OverflowError, OSError, ValueError):
        return ""
    return day.strftime("%Y-%m-%d %H:%M UTC") if day.year >= _EARLIEST_YEAR else ""


def say_bytes(count: float | None) -> str:
    """A size in bytes, kB or MB."""
    if count is None:
        return _MISSING
    for unit, size in (("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count:.0f} B"


def build_table(
    head: Sequence[str], rows: Iterable[Sequence[str]], *, caption: str, numeric: Sequence[int] = ()
) -> str:
    """An HTML table from cells that are HTML already; the first column is the row's header.

    On a narrow screen a table of many columns becomes a list of rows, each cell beside its column's title.

    Args:
        head: column titles as HTML.
        rows: cells as HTML, as many as ``head``.
        caption: what the table shows, plain text.
        numeric: columns set flush right.
    """

    def style(column: int) -> str:
        return ' class="number"' if column in numeric else ""

    titles = "".join(f'<th scope="col"{style(i)}>{cell}</th>' for i, cell in enumerate(head))
    titles_alone = [_MARKUP.sub("", cell).replace('"', "&quot;") for cell in head]
    lines = []
    for row in rows:
        cells = "".join(
            f'<td{style(i)} data-head="{titles_alone[i]}">{cell}</td>' for i, cell in enumerate(row) if i
        )
        lines.append(f'<tr><th scope="row">{row[0]}</th>{cells}</tr>')
    body = "\n".join(lines)
    kind = "table wide" if len(head) > _MOST_COLUMNS else "table"
    return (
        f'<p class="caption">{escape(caption)}</p>'
        f'<div class="{kind}" tabindex="0" role="region" aria-label="{escape(caption)}">'
        f'<table aria-label="{escape(caption)}"><thead><tr>{titles}</tr></thead>\n'
        f"<tbody>{body}</tbody></table></div>"
    )
