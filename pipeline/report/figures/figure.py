"""What a figure is, and where figures are found."""

from __future__ import annotations

import functools
import importlib
import pkgutil
from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import polars as pl

    from pipeline.report.scene import Scene
    from pipeline.report.vega import Chart


class Section(Enum):
    """The question of the page that a figure answers."""

    GLANCE = "glance"
    HOW_BAD = "how-bad"
    WHERE = "where"
    EFFECT = "effect"
    WHY = "why"


@dataclass(frozen=True)
class Drawing:
    """A figure of one run.

    Attributes:
        chart: a chart whose rows are named.
        rows: rows by the name that the chart uses; equal names mean equal rows in every figure.
        note: what the reader must know to trust it, for example that points were left out; may be empty.
        words: the same in a sentence or two, for people who cannot see it.
    """

    chart: Chart
    rows: Mapping[str, pl.DataFrame]
    note: str = ""
    words: str = ""


@dataclass(frozen=True)
class Figure:
    """A figure that any run may have.

    Attributes:
        title: what it shows, in a few words.
        section: the question it answers.
        draw: the function from tables to a drawing; None when there is nothing to draw.
        order: place within the section, small first.
        width: how much of a wide page it takes.
        panels: of a figure that a page sets part by part: the parts by title, empty where there is nothing.
        live: its rows that another model of the run changes.
        id: stable name, that of its file.
    """

    title: str
    section: Section
    draw: Callable[[Scene], Drawing | None]
    order: int
    width: Literal["half", "full"] = "half"
    panels: Callable[[Scene], Mapping[str, Drawing]] | None = None
    live: Callable[[Scene], Mapping[str, pl.DataFrame]] | None = None
    id: str = ""


@functools.cache
def list_figures() -> tuple[Figure, ...]:
    """All figures of this folder, in the order of the page."""
    import pipeline.report.figures as folder  # noqa: PLC0415 - the folder imports this module

    found = []
    for module in pkgutil.iter_modules(folder.__path__):
        content = vars(importlib.import_module(f"{folder.__name__}.{module.name}"))
        figure = content.get("FIGURE")
        if isinstance(figure, Figure):
            found.append(replace(figure, id=module.name))
    sections = list(Section)
    return tuple(sorted(found, key=lambda figure: (sections.index(figure.section), figure.order, figure.id)))
