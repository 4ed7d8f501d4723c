"""The page of a run, and what it has in common with every page of figures.

A page is one file that asks the network for nothing. Vega evaluates its expressions with its own interpreter,
without `eval`.
"""

from collections.abc import Sequence

from pipeline.core.durations import say_recorded
from pipeline.report import theme
from pipeline.report.bundle import load_bundle
from pipeline.report.elements import Picture
from pipeline.report.figures import list_figures
from pipeline.report.figures.figure import Section
from pipeline.report.pages import list_ways
from pipeline.report.run import RunReport
from pipeline.report.scene import Scene
from pipeline.report.sections import SECTIONS, Page
from pipeline.report.sections.health import summarise_health
from pipeline.report.specs import build_spec, share_rows
from pipeline.report.templating import read_own, render_template
from pipeline.report.words import say_date, say_distance


def render_report(report: RunReport) -> str:
    """The whole page of a run as HTML, with everything inside that it needs.

    Args:
        report: summary and tables of the run; figures without rows and sections without content are left out.

    Returns:
        The page; the same report gives the same text.
    """
    scene = Scene(report)
    drawn = draw_pictures(scene)
    page = Page(report, scene, drawn)
    return render_figures(
        "report/templates/run.html",
        [picture for pictures in drawn.values() for picture in pictures],
        title=report.text("run") or "run",
        ways=list_ways(report.catalogue),
        facts=_list_facts(page),
        strip=summarise_health(report),
        sections=[(section, section.view(page)) for section in SECTIONS],
    )


def draw_pictures(scene: Scene) -> dict[Section, list[Picture]]:
    """The figures there is something to draw for, by the section of the page, in its order."""
    drawn: dict[Section, list[Picture]] = {section: [] for section in Section}
    for figure in list_figures():
        for name, panel in figure.panels(scene).items() if figure.panels else ():
            drawn[figure.section].append(Picture(f"{figure.id}-{name}", name, panel, figure.width))
        drawing = None if figure.panels else figure.draw(scene)
        if drawing is not None:
            drawn[figure.section].append(Picture(figure.id, figure.title, drawing, figure.width))
    return drawn


def render_figures(template: str, pictures: Sequence[Picture], **values: object) -> str:
    """A page of figures from a template that extends `figures.html`.

    Args:
        template: its path below `pipeline`.
        pictures: the figures that it places.
        values: what else it shows: ``title`` and ``facts`` at least.
    """
    own = ("plots.js", "marks.js", "page.js")
    scripts = [load_bundle(), "".join(read_own(f"report/{name}") for name in own)] if pictures else []
    data = {
        "figures": {picture.id: build_spec(picture.drawing) for picture in pictures},
        "rows": share_rows(picture.drawing for picture in pictures),
        "dark": dict(theme.DARK_TWINS),
    }
    style = read_own("report/page.css")
    return render_template(template, style=style, scripts=scripts, data=data, pictures=pictures, **values)


def _list_facts(page: Page) -> list[str]:
    report = page.report
    duration, distance = report.part("log").get("duration_s"), report.number("distance_m")
    line = [
        report.text("vehicle_name") or report.text("vehicle"),
        report.text("terrain"),
        say_date(_first_stamp(page)),
        say_recorded(duration, report.number("duration_s")) if isinstance(duration, int | float) else "",
        say_distance(distance) if distance is not None else "",
    ]
    return [fact for fact in line if fact]


def _first_stamp(page: Page) -> int | None:
    for name in ("velocities", "slip", "poses"):
        table = page.report.table(name)
        if table is not None and "stamp" in table.columns:
            return int(table["stamp"][0])
    return None
