"""The four answers on one screen: how bad, where, why, what now; everything below says more."""

from __future__ import annotations

import statistics
from typing import TYPE_CHECKING

import numpy as np

from pipeline.report.figures.figure import Section
from pipeline.report.run import INPUT_WORDS, RunReport, mapping_in, number_in, objects_in
from pipeline.report.sections.health import list_findings
from pipeline.report.sections.what_now import list_steps
from pipeline.report.sections.where import list_regions
from pipeline.report.sections.why import say_effect
from pipeline.report.words import say_number

if TYPE_CHECKING:
    from pipeline.report.sections import Page

_MOST_REGIONS = 2
_MOST_NAMES = 3
_SPARK_BINS, _SPARK_HEIGHT = 150, 28


def view_glance(page: Page) -> dict[str, object]:
    """Four short answers, each a link to what is behind it; above them what forbids conclusions."""
    report, name = page.report, page.report.main_input
    effects = objects_in(report.diagnosis, "effects")
    return {
        "doubts": [
            str(finding.get("text", ""))
            for finding in list_findings(report)
            if finding.get("severity") == "error"
        ],
        "input": INPUT_WORDS[name],
        "median": number_in(mapping_in(report.part("by_input"), name) or report.summary, "median_modulus"),
        "spark": _draw_spark(page),
        "spark_box": f"0 0 {_SPARK_BINS} {_SPARK_HEIGHT}",
        "ladder": report.ladder,
        "standing": say_standing(report),
        "regions": list_regions(report, _MOST_REGIONS),
        "pictures": page.pictures[Section.GLANCE],
        "refused": report.is_refused,
        "diagnosed": bool(report.diagnosis),
        "effects": [say_effect(entry) for entry in effects[:_MOST_NAMES]],
        "more_effects": len(effects[_MOST_NAMES:]),
        "explained": number_in(report.diagnosis, "explained_share"),
        "unexplained": mapping_in(report.diagnosis, "unexplained").get("where"),
        "split": _order_split(report),
        "step": list_steps(report)[0] if report.text("run") else None,
        "undecided": next(iter(report.undecided), None),
    }


def say_standing(report: RunReport) -> str:
    """The run beside the comparable ones; empty where there are none."""
    name = report.main_input
    others = list(report.peers.get(name, ()))
    median = number_in(mapping_in(report.part("by_input"), name), "median_modulus")
    if not others or median is None:
        return ""
    dataset = report.text("dataset")
    usual = f"{say_number(statistics.median(others))} m/s"
    if len(others) == 1:
        more = "more" if median > others[0] else "less"
        return f"{more} than the one other run of {dataset}: {usual}"
    below = sum(other < median for other in others)
    return f"vs {len(others)} runs of {dataset}: more slip than {below}; their median {usual}"


def _order_split(report: RunReport) -> list[tuple[float, str]]:
    """Shares of ground and drivetrain, the larger first; empty where they are not known."""
    drivetrain, ground, _ = report.split
    if drivetrain is None or ground is None:
        return []
    return sorted([(ground, "between wheels and ground"), (drivetrain, "in the drivetrain")], reverse=True)


def _draw_spark(page: Page) -> str:
    """Slip over time as the path of a line without axes; the figure below says the rest."""
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
