"""Page of a run, and common parts of all pages with figures; figures as files.

A page is one file without network requests. Vega evaluates its expressions with its own interpreter, without
`eval`.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Literal, get_args

from pipeline.core import format_recorded, naming_os_errors, require_package
from pipeline.report import (
    Picture,
    ReportError,
    format_date,
    format_distance,
    list_ways,
    read_own,
    render_template,
    theme,
)
from pipeline.report.figures import Figure, draw_figure
from pipeline.report.scene import RunReport, Scene
from pipeline.report.sections import SECTIONS, list_figures, summarise_health
from pipeline.report.theme import build_spec, fill_spec, load_bundle, share_rows


def render_report(report: RunReport) -> str:
    """Render the complete, self-contained page of a run as HTML.

    Args:
        report: summary and tables of the run; figures without rows and sections without content are omitted.

    Returns:
        The page; the same report gives the same text.
    """
    scene = Scene(report)
    drawn = [_draw(section.figures, scene) for section in SECTIONS]
    return render_figures(
        "report/templates/run.html",
        list(chain.from_iterable(drawn)),
        title=report.text("run") or "run",
        ways=list_ways(report.catalogue),
        facts=_list_facts(report),
        strip=summarise_health(report),
        stretch=scene.stretch,
        sections=[
            (section, section.view(report), section.sum_up and section.sum_up(report), pictures)
            for section, pictures in zip(SECTIONS, drawn, strict=True)
        ],
        # Without a model to look at, the map is what there is to see.
        opened=() if drawn[0] else ("where",),
    )


def _draw(figures: Iterable[Figure], scene: Scene) -> list[Picture]:
    return [picture for figure in figures for picture in draw_figure(figure, scene)]


def render_figures(template: str, pictures: Sequence[Picture], **values: object) -> str:
    """Render a page of figures from a template that extends `figures.html`.

    Args:
        template: path of the template below `pipeline`.
        pictures: the figures of the page.
        values: other values: at least ``title`` and ``facts``.
    """
    own = ("plots.js", "marks.js", "cursor.js", "page.js")
    scripts = [load_bundle(), "".join(read_own(f"report/{name}") for name in own)] if pictures else []
    data = {
        "figures": {picture.id: build_spec(picture.drawing) for picture in pictures},
        "rows": share_rows(picture.drawing for picture in pictures),
        "dark": dict(theme.DARK_TWINS),
    }
    style = read_own("report/page.css")
    return render_template(template, style=style, scripts=scripts, data=data, pictures=pictures, **values)


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
        picture.id: ShownFigure(picture.id, {**fill_spec(picture.drawing), "title": picture.title})
        for picture in _draw(list_figures(), Scene(report))
    }


def write_figures(
    report: RunReport,
    folder: Path,
    format: Format,  # noqa: A002 - the word people use for it
) -> list[Path]:
    """Write every figure for which the run has rows, in the order of the page, as `write_pictures` does."""
    return write_pictures(_draw(list_figures(), Scene(report)), folder, format)


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
