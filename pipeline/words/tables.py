"""Tables of results: one value for the screen, Markdown and pages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pipeline.core import align_rows, suffix_unit

NOTHING = "-"
"""Text of a number that is not known."""


@dataclass(frozen=True)
class Column:
    """Column of a table.

    Attributes:
        title: its heading.
        unit: small text after the heading; `1` is none.
        number: whether it is right-aligned on a page.
        wide: whether it needs room: pages and Markdown have it, a screen does not.
    """

    title: str
    unit: str = ""
    number: bool = False
    wide: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "unit", suffix_unit(self.unit).strip())

    def __str__(self) -> str:
        return f"{self.title} [{self.unit}]" if self.unit else self.title


@dataclass(frozen=True)
class Cell:
    """Table cell with formatting.

    Attributes:
        text: main text.
        sub: subscript after it, as in g_x; ``after`` follows.
        small: small text after all that.
        notes: small lines below it.
        strong: whether the text stands out.
    """

    text: str = ""
    sub: str = ""
    after: str = ""
    small: str = ""
    notes: Sequence[str] = ()
    strong: bool = False

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True)
class Table:
    """Table; the first column is the row header.

    On a narrow page a table of many columns becomes a list of rows, each cell beside its column's title.

    Attributes:
        caption: what it shows.
        columns: the headings.
        rows: rows with one cell per column.
        note: remark below it; empty without one.
    """

    caption: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[str | Cell]] = ()
    note: str = ""

    def drop_empty(self) -> Table:
        """The table without the columns in which no row has anything."""
        some = [
            k for k in range(len(self.columns)) if any(str(row[k]) not in {"", NOTHING} for row in self.rows)
        ]
        rows = [[row[k] for k in some] for row in self.rows]
        return Table(self.caption, [self.columns[k] for k in some], rows, self.note)

    def align(self) -> list[str]:
        """The heading and the rows as lines of a screen, without wide columns; empty without rows."""
        shown = [k for k, column in enumerate(self.columns) if not column.wide]
        rows = [[str(row[k]) for k in shown] for row in (self.columns, *self.rows)]
        return align_rows(rows) if self.rows else []

    def to_markdown(self, escape: Callable[[str], str] = str) -> str:
        """The table as Markdown, wide columns too.

        Args:
            escape: what makes a text of a cell harmless in Markdown.
        """
        rows = [[escape(str(cell)) for cell in row] for row in (self.columns, *self.rows)]
        lines = [rows[0], ["---"] * len(self.columns), *rows[1:]]
        return "\n".join(f"| {' | '.join(line)} |" for line in lines)
