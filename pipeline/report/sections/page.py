"""What a section gets, and what it is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from pipeline.report.elements import Picture
    from pipeline.report.figures.figure import Section
    from pipeline.report.run import RunReport
    from pipeline.report.scene import Scene


@dataclass(frozen=True)
class Page:
    """A run with its figures drawn.

    Attributes:
        report: the run.
        scene: its tables, joined and thinned.
        pictures: by section, the figures there is something to draw for, in the order of the page.
    """

    report: RunReport
    scene: Scene
    pictures: Mapping[Section, Sequence[Picture]]


@dataclass(frozen=True)
class PageSection:
    """One question of the page.

    Attributes:
        id: anchor, and the name of its template in `templates/sections`.
        title: heading.
        view: the values that the template shows; one that comes out empty is left out of the page.
    """

    id: str
    title: str
    view: Callable[[Page], Mapping[str, object]]
