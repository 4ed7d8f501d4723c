"""Page of a run; figures as files."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from pipeline.core import format_recorded, naming_os_errors, require_package
from pipeline.report import (
    Picture,
    ReportError,
    format_date,
    format_distance,
    list_ways,
)
from pipeline.report.figures import draw_figure
from pipeline.report.pages import Page
from pipeline.report.scene import RunReport, Scene
from pipeline.report.sections import list_figures, list_sections, summarise_health
from pipeline.report.theme import fill_spec


def render_report(report: RunReport) -> str:
    """Render the complete, self-contained page of a run as HTML.

    Args:
        report: summary and tables of the run; figures without rows and sections without content are omitted.

    Returns:
        The page; the same report gives the same text.
    """
    return Page(
        report.text("run") or "run",
        _list_facts(report),
        list_sections(Scene(report)),
        ways=list_ways(report.catalogue),
        strip=summarise_health(report),
    ).render()


def _draw_all(report: RunReport) -> list[Picture]:
    scene = Scene(report)
    return [picture for figure in list_figures() for picture in draw_figure(figure, scene)]


def _list_facts(report: RunReport) -> list[str]:
    tables = (report.table(name) for name in ("velocities", "slip", "poses"))
    stamp = next((int(one["stamp"][0]) for one in tables if one is not None and "stamp" in one.columns), None)
    duration, distance = report.part("log").get("duration_s"), report.number("distance_m")
    line = [
        report.text("vehicle_name") or report.text("vehicle"),
        report.text("terrain"),
        format_date(report.text("run"), stamp),
        format_recorded(duration, report.number("duration_s")) if isinstance(duration, int | float) else "",
        format_distance(distance) if distance is not None else "",
    ]
    return [fact for fact in line if fact]


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
        picture.id: ShownFigure(picture.id, _head(fill_spec(picture.drawing), picture.title))
        for picture in _draw_all(report)
    }


def _head(spec: dict[str, object], title: str) -> dict[str, object]:
    """A specification below a title: its own one, which says what is on the vertical axis, is below that."""
    own = spec.get("title", [])
    lines = [own.get("text"), own.get("subtitle")] if isinstance(own, dict) else [own]
    flat = [line for one in lines if one for line in (one if isinstance(one, list) else [one])]
    return {**spec, "title": {"text": title, "subtitle": flat} if flat else title}


def write_figures(
    report: RunReport,
    folder: Path,
    format: Format,  # noqa: A002 - the word people use for it
) -> list[Path]:
    """Write every figure for which the run has rows, in the order of the page, as `write_pictures` does."""
    return write_pictures(_draw_all(report), folder, format)


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
    require_package("vl_convert", "", "a figure")
    import vl_convert  # noqa: PLC0415 - starts a JavaScript engine

    if format == "svg":
        svg: str = vl_convert.vegalite_to_svg(spec)
        # The engine's counter of ids continues from one figure to the next.
        order = {one: f"{name}-{i}" for i, one in enumerate(dict.fromkeys(_ID.findall(svg)))}
        return _ID.sub(lambda match: order[match.group()], svg).encode()
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
