"""What a section gets, and what it is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pipeline.report.words import escape

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pipeline.report.figures import Drawing, Figure
    from pipeline.report.figures.figure import Section
    from pipeline.report.run import RunReport
    from pipeline.report.scene import Scene


@dataclass(frozen=True)
class Page:
    """A run with its figures drawn.

    Attributes:
        report: the run.
        scene: its tables, joined and thinned.
        drawings: the figures there is something to draw for, in the order of the page.
    """

    report: RunReport
    scene: Scene
    drawings: Sequence[tuple[Figure, Drawing]]

    def render_figures(self, section: Section) -> str:
        """The figures of a section as HTML: caption, room for the chart, the same in words, notes."""
        shown = [pair for pair in self.drawings if pair[0].section is section]
        if not shown:
            return ""
        return f'<div class="figures">{"".join(self._render_figure(*pair) for pair in shown)}</div>'

    def _render_figure(self, figure: Figure, drawing: Drawing) -> str:
        words = escape(figure.describe(self.scene))
        note = f'<p class="note">{escape(drawing.note)}</p>' if drawing.note else ""
        return (
            f'<figure class="{figure.width.value}" id="figure-{figure.id}">'
            f"<figcaption><h3>{escape(figure.title)}</h3></figcaption>"
            f'<div class="plot" data-figure="{figure.id}" role="img" aria-label="{words}"></div>'
            f'<noscript><p class="note">{words}</p></noscript>{note}</figure>'
        )


@dataclass(frozen=True)
class PageSection:
    """One question of the page.

    Attributes:
        id: anchor.
        title: heading.
        render: the content as HTML without the heading; empty when there is nothing to say.
    """

    id: str
    title: str
    render: Callable[[Page], str]
