"""Pages that are not about one run: a title, chapters of text, tables and figures; offline as the report."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pipeline.report import theme
from pipeline.report.errors import ReportError
from pipeline.report.page import assemble_page, load_scripts
from pipeline.report.specs import build_spec, fill_spec, share_rows
from pipeline.report.words import encode_json, escape

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.report.figures import Drawing

_PNG_SCALE = 2.0


@dataclass(frozen=True)
class Picture:
    """A figure of a gallery.

    Attributes:
        id: stable name, also of its file.
        title: what it shows, in a few words.
        drawing: chart and rows.
        words: the same in a sentence or two, for people who cannot see it.
    """

    id: str
    title: str
    drawing: Drawing
    words: str


@dataclass(frozen=True)
class Chapter:
    """A section of a gallery.

    Attributes:
        id: anchor.
        title: heading, plain text.
        lead: HTML before the figures.
        pictures: figures, one below the other.
        rest: HTML after them.
    """

    id: str
    title: str
    lead: str = ""
    pictures: Sequence[Picture] = field(default=())
    rest: str = ""


def render_gallery(title: str, facts: Sequence[str], chapters: Sequence[Chapter]) -> str:
    """One page that asks the network for nothing.

    Args:
        title: heading, plain text.
        facts: short facts below it, plain text.
        chapters: the sections; the same ones give the same text.
    """
    pictures = [picture for chapter in chapters for picture in chapter.pictures]
    data = {
        "figures": {picture.id: build_spec(picture.drawing) for picture in pictures},
        "rows": share_rows(picture.drawing for picture in pictures),
        "dark": dict(theme.DARK_TWINS),
    }
    scripts = load_scripts()
    line = "".join(f"<li>{escape(fact)}</li>" for fact in facts)
    head = f'<header><h1>{escape(title)}</h1><ul class="line">{line}</ul></header>'
    main = "\n".join(_render_chapter(chapter) for chapter in chapters)
    body = f"{head}<main>{main}</main>"
    return assemble_page(escape(title), body, encode_json(data), scripts if pictures else [])


def write_pictures(
    pictures: Sequence[Picture],
    folder: Path,
    format: Literal["svg", "pdf", "png"],  # noqa: A002 - the word people use for it
) -> list[Path]:
    """Write figures for papers as `<figure id>.<format>`.

    Raises:
        ReportError: ``figure_not_written``, the folder cannot be written.
    """
    import vl_convert  # noqa: PLC0415 - starts a JavaScript engine

    written = []
    for picture in pictures:
        spec = fill_spec(picture.drawing)
        if format == "svg":
            content: bytes = vl_convert.vegalite_to_svg(spec).encode()
        elif format == "pdf":
            content = vl_convert.vegalite_to_pdf(spec)
        else:
            content = vl_convert.vegalite_to_png(spec, scale=_PNG_SCALE)
        path = Path(folder) / f"{picture.id}.{format}"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        except OSError as error:
            raise ReportError(
                "figure_not_written",
                f"a figure cannot be written: {error.strerror}",
                where=str(path),
                hint="Choose a results folder that can be written",
            ) from error
        written.append(path)
    return written


def _render_chapter(chapter: Chapter) -> str:
    figures = "".join(_render_picture(picture) for picture in chapter.pictures)
    inside = f'<div class="figures">{figures}</div>' if figures else ""
    return (
        f'<section id="{chapter.id}" aria-labelledby="{chapter.id}-title">'
        f'<h2 id="{chapter.id}-title">{escape(chapter.title)}</h2>\n'
        f"{chapter.lead}{inside}{chapter.rest}</section>"
    )


def _render_picture(picture: Picture) -> str:
    words = escape(picture.words)
    note = f'<p class="note">{escape(picture.drawing.note)}</p>' if picture.drawing.note else ""
    return (
        f'<figure class="full" id="figure-{picture.id}">'
        f"<figcaption><h3>{escape(picture.title)}</h3></figcaption>"
        f'<div class="plot" data-figure="{picture.id}" role="img" aria-label="{words}"></div>'
        f'<noscript><p class="note">{words}</p></noscript>{note}</figure>'
    )
