"""Figures as files for papers, and as objects for notebooks."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from pipeline.core.program import naming_os_errors
from pipeline.report.page import draw_pictures
from pipeline.report.scene import RunReport, Scene
from pipeline.report.templating import Picture, ReportError
from pipeline.report.theme import fill_spec

Format = Literal["svg", "pdf", "png"]
FORMATS: tuple[Format, ...] = get_args(Format)

_PNG_SCALE = 2.0
_ID = re.compile(r"(?<=url\(#)\w+(?=\))|(?<= id=\")\w+(?=\")")


@dataclass(frozen=True)
class ShownFigure:
    """Figure with its rows and title, which a notebook draws without a network.

    Attributes:
        id: stable name.
        spec: its Vega-Lite specification.
    """

    id: str
    spec: dict[str, object]

    def to_dict(self) -> dict[str, object]:
        """Return the Vega-Lite specification, for other programs."""
        return self.spec.copy()

    def save(self, path: str | Path) -> None:
        """Write the figure as `svg`, `pdf` or `png`, depending on the file name's suffix.

        Raises:
            ReportError: the suffix is another one, or the file cannot be written.
        """
        target = Path(path)
        _write(target, _render(self.id, self.spec, target.suffix.removeprefix(".")))

    def _repr_svg_(self) -> str:
        return _render(self.id, self.spec, "svg").decode()


def show_figures(report: RunReport) -> dict[str, ShownFigure]:
    """Every figure for which the run has rows, by id."""
    return {
        picture.id: ShownFigure(picture.id, {**fill_spec(picture.drawing), "title": picture.title})
        for picture in _list_pictures(report)
    }


def write_figures(
    report: RunReport,
    folder: Path,
    format: Format,  # noqa: A002 - the word people use for it
) -> list[Path]:
    """Write every figure for which the run has rows, in the order of the page, as `write_pictures` does."""
    return write_pictures(_list_pictures(report), folder, format)


def _list_pictures(report: RunReport) -> list[Picture]:
    return [picture for pictures in draw_pictures(Scene(report)).values() for picture in pictures]


def write_pictures(
    pictures: Iterable[Picture],
    folder: Path,
    format: Format,  # noqa: A002 - the word people use for it
) -> list[Path]:
    """Write figures as `<figure id>.<format>`.

    Args:
        pictures: the figures.
        folder: output folder; created if missing.
        format: `svg`, `pdf`, or `png` (twice the size of the page's figure).

    Returns:
        The files, in the order of the figures.

    Raises:
        ReportError: the format is another one, or the folder cannot be written.
    """
    written = []
    for picture in pictures:
        path = Path(folder) / f"{picture.id}.{format}"
        _write(path, _render(picture.id, fill_spec(picture.drawing), format))
        written.append(path)
    return written


def _render(name: str, spec: dict[str, object], format: str) -> bytes:  # noqa: A002 - as above
    if format not in FORMATS:
        hint = f"Use one of {', '.join(FORMATS)}"
        raise ReportError("figure_format_unknown", f"no figure can be written as {format!r}", hint=hint)
    import vl_convert  # noqa: PLC0415 - starts a JavaScript engine

    if format == "svg":
        return _number_ids(vl_convert.vegalite_to_svg(spec), name).encode()
    drawn: bytes = (
        vl_convert.vegalite_to_pdf(spec)
        if format == "pdf"
        else vl_convert.vegalite_to_png(spec, scale=_PNG_SCALE)
    )
    return drawn


def _write(path: Path, content: bytes) -> None:
    hint = "Choose a folder that can be written"
    with naming_os_errors(
        ReportError, "figure_not_written", "a figure cannot be written", where=path, hint=hint
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


def _number_ids(svg: str, prefix: str) -> str:
    """Renumber the ids of an SVG from zero; the engine's counter continues from one figure to the next."""
    order = {name: f"{prefix}-{i}" for i, name in enumerate(dict.fromkeys(_ID.findall(svg)))}
    return _ID.sub(lambda match: order[match.group()], svg)
