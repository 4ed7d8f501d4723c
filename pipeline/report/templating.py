"""Text formatting for pages and screens, value types of pages, and rendering of HTML templates."""

from __future__ import annotations

import base64
import functools
import hashlib
import math
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from importlib.resources import files
from typing import TYPE_CHECKING, Literal

from pipeline.core.program import SlipError, format_share, naming_os_errors

if TYPE_CHECKING:
    from jinja2 import Environment

    from pipeline.report.figures import Drawing


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
_OPTION = re.compile(r"((?<![\w-])--[a-z][a-z-]*)")
"""Command line option in a text: browsers would break it after a hyphen."""
_KILOMETRE = 1000.0
_MOST_PLACES = 3
_EARLIEST_YEAR = 2000


def begin_large(text: str) -> str:
    """Capitalize the text; identifiers such as `drive_lag.tau` remain unchanged."""
    first = text.split(maxsplit=1)[0].rstrip(".,:;") if text.strip() else ""
    return text if "_" in first or "." in first else text[:1].upper() + text[1:]


def format_number(value: float | None, *, digits: int = 3) -> str:
    """Number with this many significant digits, at most three decimals; a dash if missing."""
    if value is None or not math.isfinite(value):
        return MISSING
    if value == 0.0:
        return "0"
    places = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:,.{min(places, _MOST_PLACES)}f}".replace("-", "\u2212")


def format_known_share(value: float | None) -> str:
    """Share as a percentage, a dash if missing."""
    return MISSING if value is None else format_share(value, 0).replace("-", "\u2212").replace(" ", "\u202f")


def format_split(drivetrain: float, ground: float, cross: float) -> str:
    """Split of the mean square of the slip from commands; in words if the parts cancel each other.

    Args:
        drivetrain: share between command and wheels.
        ground: share between wheels and body.
        cross: share of twice their product.
    """
    if max(drivetrain, ground) <= 1.0:
        shares = zip(("drivetrain", "ground", "cross"), (drivetrain, ground, cross), strict=True)
        return ", ".join(f"{name} {format_share(share, 0)}" for name, share in shares)
    one, two = (format_number(math.sqrt(share), digits=2) for share in (drivetrain, ground))
    return f"drivetrain and ground cancel in part: {one} and {two} times the RMS of their sum"


def format_distance(metres: float | None) -> str:
    """A distance in m or km."""
    if metres is None:
        return MISSING
    return f"{metres / _KILOMETRE:.2f} km" if metres >= _KILOMETRE else f"{metres:.0f} m"


def format_date(nanoseconds: int | None) -> str:
    """Date and time (UTC) of a stamp; empty if the clock was never set."""
    if nanoseconds is None:
        return ""
    try:
        day = datetime.fromtimestamp(nanoseconds / 1e9, UTC)
    except (OverflowError, OSError, ValueError):
        return ""
    return day.strftime("%Y-%m-%d %H:%M UTC") if day.year >= _EARLIEST_YEAR else ""


def format_bytes(count: float | None) -> str:
    """A size in bytes, kB or MB."""
    if count is None:
        return MISSING
    for unit, size in (("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count:.0f} B"


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
        "bytes": format_bytes,
        "capital": begin_large,
        "split_options": _OPTION.split,
        "distance": format_distance,
        "number": format_number,
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
    return "".join(_REPLACEMENT if _is_control(mark) else mark for mark in value)


def _is_control(mark: str) -> bool:
    return unicodedata.category(mark).startswith("C") and mark not in "\n\t"


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


@dataclass(frozen=True)
class Column:
    """Column of a table.

    Attributes:
        title: its heading.
        unit: small text after the heading.
        number: whether it is right-aligned.
    """

    title: str
    unit: str = ""
    number: bool = False


@dataclass(frozen=True)
class Cell:
    """Table cell with formatting.

    Attributes:
        text: main text.
        sub: subscript after it, as in g_x; ``after`` follows.
        before, small: small text before and after all that.
        notes: small lines below it.
        tag: bold or italics of the text.
    """

    text: str = ""
    sub: str = ""
    after: str = ""
    small: str = ""
    before: str = ""
    notes: Sequence[str] = ()
    tag: Literal["", "b", "i"] = ""


@dataclass(frozen=True)
class Table:
    """Table; the first column is the row header.

    On a narrow screen a table of many columns becomes a list of rows, each cell beside its column's title.

    Attributes:
        caption: what it shows.
        columns: the headings.
        rows: rows with one cell per column.
    """

    caption: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[str | Cell]] = field(default=())
