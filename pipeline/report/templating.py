"""Text of pages and screens, what a page shows as plain values, and HTML out of templates."""

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
"""Name of an option of the command line: browsers would break it after a hyphen."""
_KILOMETRE = 1000.0
_MOST_PLACES = 3
_EARLIEST_YEAR = 2000


def begin_large(text: str) -> str:
    """The text with a capital at its start; a name of ours (`drive_lag.tau`) stays as it is written."""
    first = text.split(maxsplit=1)[0].rstrip(".,:;") if text.strip() else ""
    return text if "_" in first or "." in first else text[:1].upper() + text[1:]


def format_number(value: float | None, *, digits: int = 3) -> str:
    """A number with so many significant digits, at most three decimals; a dash when there is none."""
    if value is None or not math.isfinite(value):
        return MISSING
    if value == 0.0:
        return "0"
    places = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:,.{min(places, _MOST_PLACES)}f}".replace("-", "\u2212")


def format_known_share(value: float | None) -> str:
    """A share as a percentage, a dash when there is none."""
    return MISSING if value is None else format_share(value, 0).replace("-", "\u2212").replace(" ", "\u202f")


def format_split(drivetrain: float, ground: float, cross: float) -> str:
    """How the mean square of the slip from commands splits; in words where the parts cancel each other.

    Args:
        drivetrain: share of what happens between command and wheels.
        ground: share of what happens between wheels and body.
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
    """Day and time (UTC) of a stamp; empty where the clock was never set."""
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


# HTML out of the templates that stand beside the code; every text in it is escaped.
#
# A template is named by its path below `pipeline`. What may stand in a page as it is, is marked `safe` in
# `base.html` and nowhere else: our own style and scripts.

_REPLACEMENT = "\ufffd"


def render_template(name: str, **values: object) -> str:
    """A template filled with values; a name that the template uses and does not get is an error.

    Args:
        name: path of the template below `pipeline`.
        values: what it shows; texts are escaped, and control characters in them, also those that turn the
            writing direction, become visible marks.
    """
    return _environment().get_template(name).render(values)


def read_own(name: str) -> str:
    """A file beside the code, by its path below `pipeline`."""
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
    """A text with its control characters made visible; what is not text, or is HTML already, as it is."""
    if not isinstance(value, str) or value.isprintable() or hasattr(value, "__html__"):
        return value
    return "".join(_REPLACEMENT if _is_control(mark) else mark for mark in value)


def _is_control(mark: str) -> bool:
    return unicodedata.category(mark).startswith("C") and mark not in "\n\t"


@dataclass(frozen=True)
class Picture:
    """A figure of a page.

    Attributes:
        id: stable name, also of its file.
        title: what it shows, in a few words.
        drawing: chart, rows and words.
        width: how much of a wide page it takes, `half` or `full`.
    """

    id: str
    title: str
    drawing: Drawing
    width: str = "full"


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        title: its heading.
        unit: set small behind the heading.
        number: whether it is set flush right.
    """

    title: str
    unit: str = ""
    number: bool = False


@dataclass(frozen=True)
class Cell:
    """A cell that is more than a text.

    Attributes:
        text: what it says.
        sub: set below the line behind it, as in g_x; ``after`` follows.
        before, small: set small before and behind all that.
        notes: small lines below it.
        tag: the text in bold or italics.
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
    """A table; the first column is the row's header.

    On a narrow screen a table of many columns becomes a list of rows, each cell beside its column's title.

    Attributes:
        caption: what it shows.
        columns: the headings.
        rows: as many cells as columns each.
    """

    caption: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[str | Cell]] = field(default=())
