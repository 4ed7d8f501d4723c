"""Sections of the page in order: how bad, where, why, what now; first a summary, then with figures."""

from __future__ import annotations

import shlex
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.core.json_objects import mapping_in, number_in, numbers_in, objects_in
from pipeline.core.program import INPUT_WORDS
from pipeline.estimation.error_regions import format_errors
from pipeline.report.figures.figure import Section
from pipeline.report.scene import RunReport, Scene
from pipeline.report.sections_why import format_row, list_findings, view_health, view_provenance, view_why
from pipeline.report.templating import MISSING, Cell, Column, Picture, Table, format_number

_MOST_REGIONS = 2
_SPARK_BINS, _SPARK_HEIGHT = 150, 28


def view_glance(page: Page) -> dict[str, object]:
    """Four short answers, each linked to its section; above them findings that forbid conclusions."""
    report, name = page.report, page.report.main_input
    main, minor = report.effects
    verdict = report.verdict
    doubts = (str(one.get("text", "")) for one in list_findings(report) if one.get("severity") == "error")
    return {
        "verdict": verdict,
        "doubts": [text for text in doubts if text.casefold() not in verdict.casefold()],
        "input": INPUT_WORDS[name],
        "median": number_in(mapping_in(report.part("by_input"), name) or report.summary, "median_modulus"),
        "spark": _draw_spark(page),
        "spark_box": f"0 0 {_SPARK_BINS} {_SPARK_HEIGHT}",
        "standing": format_standing(report),
        "regions": list_regions(report, _MOST_REGIONS),
        "pictures": page.pictures[Section.GLANCE],
        "refusal": report.refusal,
        "diagnosed": bool(report.diagnosis),
        "effects": [format_row(entry) for entry in main],
        "more_effects": len(minor),
        "unexplained": mapping_in(report.diagnosis, "unexplained").get("where"),
        "split": _order_split(report),
        "step": list_steps(report)[0] if report.text("run") else None,
        "undecided": next(iter(report.undecided), None),
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
        return f"{comparative} than the one other run of {dataset}: {usual}"
    below = sum(other < median for other in others)
    return f"vs {len(others)} runs of {dataset}: more slip than {below}; their median {usual}"


def _order_split(report: RunReport) -> list[tuple[float, str]]:
    """Shares of ground and drivetrain, the larger first; empty if unknown."""
    drivetrain, ground, _ = report.split
    if drivetrain is None or ground is None:
        return []
    return sorted(
        [(ground, "in the ground (wheels to body)"), (drivetrain, "in the drivetrain (command to wheels)")],
        reverse=True,
    )


def _draw_spark(page: Page) -> str:
    """Sparkline of slip over time as an SVG path; the figure below shows details."""
    frame = page.scene.slip.get(page.report.main_input)
    if frame is None or frame.height < _SPARK_BINS:
        return ""
    times, modulus = frame["t"].to_numpy(), frame["modulus"].to_numpy()
    edges = np.linspace(times[0], times[-1], _SPARK_BINS + 1)
    which = np.clip(np.searchsorted(edges, times, side="right") - 1, 0, _SPARK_BINS - 1)
    count = np.bincount(which, minlength=_SPARK_BINS)
    mean = np.bincount(which, np.minimum(modulus, page.scene.modulus_cap), minlength=_SPARK_BINS)
    height = mean / np.maximum(count, 1) / max(page.scene.modulus_cap, 1e-9) * (_SPARK_HEIGHT - 2)
    path, pen = [], "M"
    for number, there in enumerate((count > 0).tolist()):
        if there:
            path.append(f"{pen}{number} {_SPARK_HEIGHT - 1 - height[number]:.1f}")
        pen = "L" if there else "M"
    return "".join(path)


def view_how_bad(page: Page) -> dict[str, object]:
    """Cards with the medians, slip over time, distributions, table of both inputs."""
    report = page.report
    return {
        "refusal": report.refusal,
        "cards": [_view_card(name, _numbers_of(report, name)) for name in report.inputs],
        "ladder": [format_errors(step) for step in report.ladder],
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
    caption = "Slip g = f(u) \u2212 v of the ideal model" + (
        f"; slip speed with L = {scale:g} m" if scale is not None else ""
    )
    rows: list[list[str | Cell]] = [
        [words, *(column[i] for column in columns)] for i, words in enumerate(_QUANTITIES)
    ]
    head = [Column("u"), *(Column(INPUT_WORDS[name], number=True) for name in report.inputs)]
    return Table(caption, head, rows)


_QUANTITIES = (
    Cell("median slip speed", small="m/s"),
    Cell("median 2 s window norm", small="m/s"),
    Cell("rms g", sub="x", after=", forward", small="m/s"),
    Cell("rms g", sub="y", after=", sideways", small="m/s"),
    Cell("rms g", sub="w", after=", yaw rate", small="rad/s"),
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
    return {"regions": list_regions(page.report), "pictures": page.pictures[Section.WHERE]}


def list_regions(report: RunReport, most: int = 3) -> list[tuple[str, str]]:
    """Regions of the ideal model's error, as on the screen: each with its part of the error."""
    if report.is_refused:
        return []
    regions = []
    for entry in objects_in(report.diagnosis, "where")[:most]:
        region, text = str(entry.get("region", "")), str(entry.get("text", ""))
        regions.append((region, text.removeprefix(region).removeprefix(": ")))
    return regions


def view_what_now(page: Page) -> dict[str, object]:
    """Commands for the next steps, and whether a drive could decide anything that is open."""
    if not page.report.text("run"):
        return {"steps": [], "settled": False, "planned": {}}
    diagnosis = page.report.diagnosis
    settled = bool(diagnosis.get("effects")) and not any(
        diagnosis.get(key) for key in ("undecided", "unobservable", "unexplained")
    )
    return {"steps": list_steps(page.report), "settled": settled, "planned": page.report.planned}


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
    if not diagnosis:
        return [("Estimate the effects that the model lacks", f"slip diagnose {name}")]
    steps = []
    if diagnosis.get("effects"):
        steps.append(("Save the estimated model", f"slip diagnose {name} --apply model.toml"))
        steps.append(("Export it to the controller", "slip model export model.toml --to ros2_control"))
        against = f"slip model compare model.toml --against literature --on {name}"
        steps.append(("Compare it with models of the literature", against))
        if mapping_in(diagnosis, "learned").get("kept"):
            learn = f"slip model add model.toml learned_term --on {name}"
            steps.append(("Put a learned term on top of it", learn))
    if diagnosis.get("undecided") or diagnosis.get("unobservable"):
        what = "is undecided" if diagnosis.get("undecided") else "is not observable"
        steps += [
            (f"Plan a drive that determines what {what}, where one can", f"slip plan {name} --folder plan"),
            ("Look at plan/plan.html, lift the wheels, and play it", "ros2 bag play plan/plan.mcap"),
            ("Check the plan against the drive", "slip plan --check plan NEW.mcap"),
        ]
    steps.append(("Try other effects, and plan the next drive, in the browser", "slip serve"))
    if diagnosis.get("unexplained"):
        steps.append(("Write the effect that explains the rest yourself", "slip model new-effect mine.py"))
    return steps


# Sections of the page in order: how bad, where, why, what now; first a summary, then with figures.
#
# Health of the log and provenance come last. A section is a function from the page to values, and a template
# that shows them; empty sections are omitted.


@dataclass(frozen=True)
class Page:
    """Run with its figures drawn.

    Attributes:
        report: the run.
        scene: its tables, joined and thinned.
        pictures: figures with something to draw by section, in the order of the page.
    """

    report: RunReport
    scene: Scene
    pictures: Mapping[Section, Sequence[Picture]]


@dataclass(frozen=True)
class PageSection:
    """One section of the page.

    Attributes:
        id: anchor, and the name of its template in `templates/sections`.
        title: heading.
        view: function that returns the values for the template; a section without values is omitted.
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
