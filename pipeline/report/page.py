"""Page of a run: its sections (why and health: `sections_why`), its figures, also as files."""

import re
import shlex
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from pipeline.core import (
    INPUT_WORDS,
    FigureFormat,
    format_recorded,
    mapping_in,
    naming_os_errors,
    number_in,
    numbers_in,
    require_package,
)
from pipeline.report import (
    MISSING,
    Cell,
    Column,
    Picture,
    ReportError,
    Table,
    format_date,
    format_distance,
    format_number,
    list_ways,
    read_own,
    render_template,
    theme,
)
from pipeline.report.figures import Section, draw_figure, list_figures
from pipeline.report.scene import RunReport, Scene
from pipeline.report.sections_why import (
    Page,
    format_remaining,
    list_findings,
    summarise_health,
    view_health,
    view_provenance,
    view_why,
)
from pipeline.report.theme import build_spec, fill_spec, load_bundle, share_rows
from pipeline.results import has_no_pose, read_findings
from pipeline.store import Store
from pipeline.words import describe_regions, format_step, name_span, suggest_export

_STEPS_SHOWN = 3
"""Next steps that are shown; the others are folded."""


def view_glance(page: Page) -> dict[str, object]:
    """The verdict, findings that forbid conclusions, and the half minute with the largest error."""
    report, verdict = page.report, page.report.verdict
    doubts = (str(one.get("text", "")) for one in list_findings(report) if one.get("severity") == "error")
    return {
        "verdict": verdict,
        "doubts": [text for text in doubts if text.casefold() not in verdict.casefold()],
        "refusal": report.refusal,
        "stretch": page.scene.stretch,
        "pictures": page.pictures[Section.GLANCE],
    }


def format_standing(report: RunReport) -> str:
    """Compare the run with comparable ones; empty if there are none."""
    name = report.main_input
    others = list(report.peers.get(name, ()))
    median = number_in(mapping_in(report.part("by_input"), name), "median_modulus")
    if not others or median is None:
        return ""
    dataset = report.text("dataset")
    usual = f"{format_number(statistics.median(others))} m/s"
    if len(others) == 1:
        comparative = "more" if median > others[0] else "less"
        return f"{comparative} slip than the one other run of {dataset}: {usual}"
    below = sum(other < median for other in others)
    return f"more slip than {below} of the {len(others)} other runs of {dataset}; their median is {usual}"


def view_how_bad(page: Page) -> dict[str, object]:
    """Cards with the medians, slip over time, distributions, table of both inputs."""
    report = page.report
    return {
        "refusal": report.refusal,
        "cards": [_view_card(name, _numbers_of(report, name)) for name in report.inputs],
        "standing": format_standing(report),
        "ladder": [format_step(step) for step in report.diagnosis.ladder],
        "pictures": page.pictures[Section.HOW_BAD],
        "table": _tabulate(report),
    }


def _numbers_of(report: RunReport, name: str) -> Mapping[str, object]:
    numbers = mapping_in(report.part("by_input"), name)
    if numbers or name != report.main_input:
        return numbers
    return {key: report.summary.get(key) for key in ("samples", "median_modulus", "median_window_norm")}


def _view_card(name: str, numbers: Mapping[str, object]) -> dict[str, object]:
    return {
        "input": name,
        "words": INPUT_WORDS[name],
        "median": number_in(numbers, "median_modulus"),
        "norm": number_in(numbers, "median_window_norm"),
        "transitory": number_in(numbers, "transitory_median_modulus"),
        "steady": number_in(numbers, "steady_median_modulus"),
    }


def _tabulate(report: RunReport) -> Table | None:
    columns = [_list_numbers(_numbers_of(report, name)) for name in report.inputs]
    if not columns:
        return None
    scale = report.number("length_scale_m")
    caption = "Slip g = f(u) \u2212 v of the ideal model"
    caption += "" if scale is None else f"; slip modulus with L = {scale:g} m"
    if has_no_pose(read_findings(report.summary)):
        caption += "; v is that of the measured wheels: no pose is recorded"
    rows: list[list[str | Cell]] = [[words, *(c[i] for c in columns)] for i, words in enumerate(_QUANTITIES)]
    head = [Column("u"), *(Column(INPUT_WORDS[name], number=True) for name in report.inputs)]
    return Table(caption, head, rows)


_QUANTITIES = (
    Cell("median slip modulus", small="m/s"),
    Cell("median 2 s window norm", small="m/s"),
    Cell("RMS g", sub="x", after=", forward", small="m/s"),
    Cell("RMS g", sub="y", after=", lateral", small="m/s"),
    Cell("RMS g", sub="w", after=", yaw rate", small="rad/s"),
    Cell("time steps"),
)


def _list_numbers(numbers: Mapping[str, object]) -> list[str]:
    """Cells in the order of the quantities."""
    rms = [*numbers_in(numbers, "rms"), None, None, None][:3]
    medians = [number_in(numbers, name) for name in ("median_modulus", "median_window_norm")]
    samples = number_in(numbers, "samples")
    return [
        *(format_number(value) for value in medians + rms),
        MISSING if samples is None else f"{samples:,.0f}",
    ]


def view_where(page: Page) -> dict[str, object]:
    """Regions with the largest error, linked figures, and controls to mark time without a mouse."""
    report, pictures = page.report, page.pictures[Section.WHERE]
    moments = [
        {"of": one, "spans": [(span, name_span(span)) for span in one.spans[:3]]}
        for one in report.diagnosis.when
    ]
    return {"regions": list_regions(report), "moments": moments, "pictures": pictures}


def list_regions(report: RunReport, most: int = 3) -> list[tuple[str, str]]:
    """Regions of the ideal model's error, as on the screen: each with its part of the error."""
    if report.is_refused:
        return []
    parted = (text.partition(": ") for text in describe_regions(report.diagnosis.where)[:most])
    return [(region, part) for region, _, part in parted]


def view_what_now(page: Page) -> dict[str, object]:
    """Commands for the next steps, and whether a drive could decide anything that is open."""
    if not page.report.text("run"):
        return {"steps": [], "more": [], "settled": False, "planned": {}}
    diagnosis = page.report.diagnosis
    is_open = diagnosis.undecided or diagnosis.unobservable_why or diagnosis.unexplained
    settled = bool(diagnosis.effects) and not is_open
    steps = list_steps(page.report)
    return {
        "steps": steps[:_STEPS_SHOWN],
        "more": steps[_STEPS_SHOWN:],
        "settled": settled,
        "planned": page.report.planned,
    }


def list_steps(report: RunReport) -> list[tuple[str, str]]:
    """Next steps with their commands, in descending order of usefulness."""
    if report.is_refused:
        return _list_mending_steps(report)
    run = report.text("run")
    # A run name with a leading dash would be read as an option.
    name = shlex.quote(run) if not run.startswith("-") else shlex.quote(f"./{run}")
    return [
        *_list_model_steps(report, name),
        ("Compare with other vehicles and terrains", "slip compare"),
        ("Look at slip in the viewer that plays the log", f"slip export {name} --to mcap"),
    ]


def _list_mending_steps(report: RunReport) -> list[tuple[str, str]]:
    """Steps for a run without valid numbers: inspect the log, correct it, analyze again."""
    log = shlex.quote(str(report.part("log").get("path") or "run.mcap"))
    return [
        ("List the contents of the log", f"slip inspect {log}"),
        ("Correct what the findings report, then analyze again", f"slip analyze {log}"),
    ]


def _list_model_steps(report: RunReport, name: str) -> list[tuple[str, str]]:
    diagnosis = report.diagnosis
    if not report.is_diagnosed:
        return [("Estimate the effects that the model lacks", f"slip diagnose {name}")]
    steps = []
    if diagnosis.has_suggestion:
        steps.append(("Add the suggested term, and see the error fall", f"slip serve {name}"))
    if diagnosis.effects:
        steps.append(("Save the estimated model", f"slip diagnose {name} --apply model.toml"))
        kind = "" if diagnosis.vehicle is None else diagnosis.vehicle.kind
        steps.append(("Export it to the controller", suggest_export(kind, "model.toml")))
        against = f"slip model compare model.toml --against literature --on {name}"
        steps.append(("Compare it with models of the literature", against))
    if diagnosis.undecided or diagnosis.unobservable_why:
        what = "is undecided" if diagnosis.undecided else "is not observable"
        steps += [
            (f"Plan a drive that determines what {what}, where one can", f"slip plan {name} --folder plan"),
            ("Look at plan/plan.html, lift the wheels, and play it", "ros2 bag play plan/plan.mcap"),
            ("Check the plan against the drive", "slip plan --check plan NEW.mcap"),
        ]
    steps.append(("Try other effects, and plan the next drive, in the browser", f"slip serve {name}"))
    if diagnosis.unexplained:
        steps.append(("Write the effect that explains the rest yourself", "slip model new-effect mine.py"))
    return steps


def view_rest(page: Page) -> dict[str, object]:
    """Figures of what the effects carry and of what they leave."""
    return {"pictures": page.pictures[Section.REST]}


# Sections of the page in order: the verdict with the first picture, the effects, what to do next; the rest is
# folded behind a line that says what is there.
#
# A section is a function from the page to values, and a template that shows them; empty sections are omitted.


@dataclass(frozen=True)
class PageSection:
    """One section of the page.

    Attributes:
        id: anchor, and the name of its template in `templates/sections`.
        title: heading.
        view: function that returns the values for the template; a section without values is omitted.
        sum_up: function that returns the line beside the heading of a folded section; None for one that is
            always open.
    """

    id: str
    title: str
    view: Callable[[Page], Mapping[str, object]]
    sum_up: Callable[[Page], str] | None = None


def sum_up_where(page: Page) -> str:
    """The region that carries most of the ideal model's error."""
    if not page.report.diagnosis.ladder:
        return ""
    regions = [f"{region}: {part}" for region, part in list_regions(page.report, 1)]
    return regions[0] if regions else "the error is spread evenly over the run"


def sum_up_slip(page: Page) -> str:
    """The median slip from each input."""
    report = page.report
    if report.is_refused:
        return ""
    medians = {name: number_in(_numbers_of(report, name), "median_modulus") for name in report.inputs}
    texts = [
        f"{format_number(one, digits=2)} m/s {INPUT_WORDS[name]}"
        for name, one in medians.items()
        if one is not None
    ]
    return f"median slip modulus {', '.join(texts)}" if texts else ""


def sum_up_rest(page: Page) -> str:
    """The error of the model beside the noise floor."""
    ideal = "that of the ideal model: no effect was added"
    return format_remaining(page.report) or (ideal if page.report.diagnosis.ladder else "")


def sum_up_health(page: Page) -> str:
    """Losses, gaps and serious findings."""
    return ", ".join(words for _, words in summarise_health(page.report))


SECTIONS = (
    PageSection("glance", "At a glance", view_glance),
    PageSection("why", "Effects", view_why),
    PageSection("what-now", "What to do next", view_what_now),
    PageSection("where", "Where", view_where, sum_up_where),
    PageSection("how-bad", "How much slip", view_how_bad, sum_up_slip),
    PageSection("rest", "Remaining error", view_rest, sum_up_rest),
    PageSection("health", "Data health", view_health, sum_up_health),
    PageSection(
        "provenance",
        "Provenance",
        view_provenance,
        lambda page: str(page.report.part("log").get("path") or ""),
    ),
)

# Page of a run, and common parts of all pages with figures.
#
# A page is one file without network requests. Vega evaluates its expressions with its own interpreter,
# without `eval`.


def render_report(report: RunReport) -> str:
    """Render the complete, self-contained page of a run as HTML.

    Args:
        report: summary and tables of the run; figures without rows and sections without content are omitted.

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
        sections=[
            (section, section.view(page), section.sum_up and section.sum_up(page)) for section in SECTIONS
        ],
        # Without a model to look at, the map is what there is to see.
        opened=() if drawn[Section.GLANCE] else ("where",),
    )


def draw_pictures(scene: Scene) -> dict[Section, list[Picture]]:
    """Figures with something to draw, by section of the page, in its order."""
    drawn: dict[Section, list[Picture]] = {section: [] for section in Section}
    for figure in list_figures():
        drawn[figure.section] += draw_figure(figure, scene)
    return drawn


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


def _list_facts(page: Page) -> list[str]:
    report = page.report
    duration, distance = report.part("log").get("duration_s"), report.number("distance_m")
    line = [
        report.text("vehicle_name") or report.text("vehicle"),
        report.text("terrain"),
        format_date(report.text("run"), _first_stamp(page)),
        format_recorded(duration, report.number("duration_s")) if isinstance(duration, int | float) else "",
        format_distance(distance) if distance is not None else "",
    ]
    return [fact for fact in line if fact]


def _first_stamp(page: Page) -> int | None:
    for name in ("velocities", "slip", "poses"):
        table = page.report.table(name)
        if table is not None and "stamp" in table.columns:
            return int(table["stamp"][0])
    return None


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
    require_package("vl_convert", "report", "a figure")
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


def add_figures(
    store: Store, draw: Callable[[], Iterable[Picture]], figures: FigureFormat | None
) -> dict[str, Path]:
    """Write figures to `figures/` if a format is given; return the files by name."""
    if figures is None:
        return {}
    return {path.name: path for path in write_pictures(draw(), store.root / "figures", figures)}
