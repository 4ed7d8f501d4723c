"""The page from top to bottom: how bad, where, why, what now; first in short, then with figures.

Health of the log and provenance come last. A section is a function from the page to values and a template
that shows them; one that has nothing to say is left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pipeline.report.sections.glance import view_glance
from pipeline.report.sections.health import view_health
from pipeline.report.sections.how_bad import view_how_bad
from pipeline.report.sections.provenance import view_provenance
from pipeline.report.sections.what_now import view_what_now
from pipeline.report.sections.where import view_where
from pipeline.report.sections.why import view_why

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


SECTIONS = (
    PageSection("glance", "At a glance", view_glance),
    PageSection("how-bad", "How bad", view_how_bad),
    PageSection("where", "Where", view_where),
    PageSection("why", "Why", view_why),
    PageSection("what-now", "What now", view_what_now),
    PageSection("health", "Data health", view_health),
    PageSection("provenance", "Provenance", view_provenance),
)
