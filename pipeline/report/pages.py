"""What all pages are: a title and sections. A section is a template and what it shows.

Most sections are plain: sentences, tables, figures and lists in that order. A page is one file without
network requests. Vega evaluates its expressions with its own interpreter, without `eval`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from pipeline.report import Picture, read_own, render_template, theme
from pipeline.report.theme import build_spec, load_bundle, share_rows
from pipeline.words import Table


@dataclass(frozen=True)
class Section:
    """Section of a page; it is left out where its template has nothing to show.

    Attributes:
        id: anchor.
        title: heading.
        lines: sentences without a period.
        tables: tables; all but the first are folded behind their captions.
        pictures: figures.
        items: texts of a list.
        warnings: texts of a list that stands out.
        brief: line beside the heading of a section that is folded; None for one that is always open.
        is_open: whether a folded section is open at first.
        template: name of its template in `templates/sections`.
        view: other values for the template.
    """

    id: str
    title: str
    lines: Sequence[str] = ()
    pictures: Sequence[Picture] = ()
    tables: Sequence[Table] = ()
    items: Sequence[str] = ()
    warnings: Sequence[str] = ()
    brief: str | None = None
    is_open: bool = False
    template: str = "plain"
    view: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class Page:
    """Page with its sections.

    Attributes:
        title: its heading.
        facts: short texts below it.
        sections: in order.
        ways: addresses of other pages, by what their links say.
        strip: grade (`good`, `note`, `warning`, `error`) and text of lights below the facts.
    """

    title: str
    facts: Sequence[str]
    sections: Sequence[Section]
    ways: Mapping[str, str] = field(default_factory=dict)
    strip: Sequence[tuple[str, str]] = ()

    @property
    def pictures(self) -> list[Picture]:
        """All figures, in order."""
        return [picture for section in self.sections for picture in section.pictures]

    def render(self) -> str:
        """The complete, self-contained page as HTML; the same content gives the same text."""
        pictures = self.pictures
        own = ("plots.js", "marks.js", "cursor.js", "page.js")
        data = {
            "figures": {picture.id: build_spec(picture.drawing) for picture in pictures},
            "rows": share_rows(picture.drawing for picture in pictures),
            "dark": dict(theme.DARK_TWINS),
        }
        return render_template(
            "report/templates/page.html",
            page=self,
            style=read_own("report/page.css"),
            scripts=[load_bundle(), "".join(read_own(f"report/{name}") for name in own)] if pictures else [],
            data=data,
            title=self.title,
        )
