"""What a page shows, as plain values: pictures and tables. `templates/elements.html` makes the HTML."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from pipeline.report.figures import Drawing


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
