"""The figures of the page as files, for papers."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pipeline.report.errors import ReportError
from pipeline.report.figures import list_figures
from pipeline.report.scene import Scene
from pipeline.report.specs import fill_spec

if TYPE_CHECKING:
    from pipeline.report.run import RunReport

FORMATS = ("svg", "pdf", "png")

_PNG_SCALE = 2.0
_ID = re.compile(r"(?<=url\(#)\w+(?=\))|(?<= id=\")\w+(?=\")")


def write_figures(
    report: RunReport,
    folder: Path,
    format: Literal["svg", "pdf", "png"],  # noqa: A002 - the word people use for it
) -> list[Path]:
    """Write every figure that the run has rows for.

    Args:
        report: the run.
        folder: where to write `<figure id>.<format>`; made when it is not there.
        format: `svg`, `pdf`, or `png` (twice the size of the page's figure).

    Returns:
        The files, in the order of the page.

    Raises:
        ReportError: the format is none of these, or the folder cannot be written.
    """
    if format not in FORMATS:
        raise ReportError(
            "figure_format_unknown",
            f"no figure can be written as {format!r}",
            hint=f"Use one of {', '.join(FORMATS)}",
        )
    import vl_convert  # noqa: PLC0415 - starts a JavaScript engine

    scene = Scene(report)
    written = []
    for figure in list_figures():
        drawing = figure.draw(scene)
        if drawing is None:
            continue
        spec = fill_spec(drawing)
        content: str | bytes
        if format == "svg":
            content = _number_ids(vl_convert.vegalite_to_svg(spec), figure.id)
        elif format == "pdf":
            content = vl_convert.vegalite_to_pdf(spec)
        else:
            content = vl_convert.vegalite_to_png(spec, scale=_PNG_SCALE)
        path = Path(folder) / f"{figure.id}.{format}"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content.encode() if isinstance(content, str) else content)
        except OSError as error:
            raise ReportError(
                "figure_not_written",
                f"a figure cannot be written: {error.strerror}",
                where=str(path),
                hint="Choose a folder that can be written with --out",
            ) from error
        written.append(path)
    return written


def _number_ids(svg: str, prefix: str) -> str:
    """Count the ids of an SVG from zero; the engine counts on from one figure to the next."""
    order = {name: f"{prefix}-{i}" for i, name in enumerate(dict.fromkeys(_ID.findall(svg)))}
    return _ID.sub(lambda found: order[found.group()], svg)
