"""The four answers on one screen: how bad, where, why, what now; everything below says more."""

from __future__ import annotations

import statistics
from typing import TYPE_CHECKING

import numpy as np

from pipeline.report.run import INPUT_WORDS, RunReport, mapping_in, number_in, objects_in
from pipeline.report.sections.health import list_findings
from pipeline.report.sections.what_now import list_steps
from pipeline.report.sections.where import VERBS, find_regions
from pipeline.report.words import begin_large, escape, say_number, say_share

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.report.sections.page import Page

_MOST_REGIONS = 2
_MOST_NAMES = 3
_SPARK_BINS, _SPARK_HEIGHT = 150, 28


def render_glance(page: Page) -> str:
    """Four short answers, each a link to what is behind it; above them what forbids conclusions."""
    answers = (
        ("how-bad", "How bad", _answer_how_bad(page)),
        ("where", "Where", _answer_where(page)),
        ("why", "Why", _answer_why(page.report)),
        ("what-now", "What now", _answer_what_now(page.report)),
    )
    shown = "".join(
        f'<div><h3><a href="#{anchor}">{title}</a></h3>{content}</div>'
        for anchor, title, content in answers
        if content
    )
    return _render_doubts(page.report) + f'<div class="glance">{shown}</div>' if shown else ""


def _render_doubts(report: RunReport) -> str:
    """What forbids drawing conclusions from the numbers below; empty when nothing does."""
    errors = [finding for finding in list_findings(report) if finding.get("severity") == "error"]
    if not errors:
        return ""
    lines = "".join(f"<li>{begin_large(escape(finding.get('text', '')))}</li>" for finding in errors)
    return f'<div class="doubts"><p>Do not draw conclusions from these numbers:</p><ul>{lines}</ul></div>'


def _answer_how_bad(page: Page) -> str:
    report, name = page.report, page.report.main_input
    numbers = mapping_in(report.part("by_input"), name) or report.summary
    median = number_in(numbers, "median_modulus")
    if median is None:
        return "<p>No slip could be worked out.</p>"
    lines = [
        f'<p class="first"><b>{say_number(median)} m/s</b> median slip {INPUT_WORDS[name]}</p>',
        _draw_spark(page),
    ]
    ladder = objects_in(report.diagnosis, "ladder")
    if ladder:
        position, heading = (number_in(ladder[0], key) for key in ("t_mrmse_m", "r_mrmse_rad"))
        lines.append(
            f"<p>2 s ahead the ideal model is off by <b>{say_number(position)} m</b>, "
            f"<b>{say_number(heading)} rad</b></p>"
        )
    standing = say_standing(report)
    if standing:
        lines.append(f"<p>{standing}</p>")
    return "".join(lines)


def say_standing(report: RunReport) -> str:
    """The run beside the comparable ones, as HTML; empty where there are none."""
    name = report.main_input
    others = list(report.peers.get(name, ()))
    median = number_in(mapping_in(report.part("by_input"), name), "median_modulus")
    if not others or median is None:
        return ""
    dataset = escape(report.text("dataset"))
    usual = f"{say_number(statistics.median(others))} m/s"
    if len(others) == 1:
        more = "more" if median > others[0] else "less"
        return f"{more} than the one other run of {dataset}: {usual}"
    below = sum(other < median for other in others)
    return f"vs {len(others)} runs of {dataset}: more slip than {below}; their median {usual}"


def _draw_spark(page: Page) -> str:
    """Slip over time as a line without axes, the figure below says the rest."""
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
    return (
        f'<svg class="spark" viewBox="0 0 {_SPARK_BINS} {_SPARK_HEIGHT}" preserveAspectRatio="none" '
        f'aria-hidden="true"><path d="{"".join(path)}"/></svg>'
    )


def _answer_where(page: Page) -> str:
    name = page.report.main_input
    regions = find_regions(page.scene.sound_slip.get(name), VERBS[name])[:_MOST_REGIONS]
    if not regions:
        return "<p>Spread evenly over the run</p>" if page.scene.sound_slip else ""
    return "".join(
        f"<p><b>{words}</b>: {say_share(slip)} of the squared slip in {say_share(time)} of the time</p>"
        for words, slip, time in regions
    )


def _answer_why(report: RunReport) -> str:
    diagnosis = report.diagnosis
    effects = objects_in(diagnosis, "effects")
    if effects:
        return _tell_effects(effects, diagnosis)
    split = report.part("split")
    drivetrain, ground = number_in(split, "drivetrain"), number_in(split, "ground")
    lines = ["<p>No effect could be named as missing</p>"] if diagnosis else []
    if drivetrain is not None and ground is not None:
        parts = [(ground, "between wheels and ground"), (drivetrain, "in the drivetrain")]
        told = ", ".join(f"<b>{say_share(share)}</b> {place}" for share, place in sorted(parts, reverse=True))
        lines.append(f"<p>The slip arises: {told}</p>")
    return "".join(lines) or "<p>Not diagnosed yet</p>"


def _tell_effects(effects: list[Mapping[str, object]], diagnosis: Mapping[str, object]) -> str:
    names = [f"<b>{escape(entry.get('id', ''))}</b>" for entry in effects[:_MOST_NAMES]]
    more = len(effects) - len(names)
    lines = [f"<p>Missing: {', '.join(names)}{f' and {more} more' if more > 0 else ''}</p>"]
    ladder = objects_in(diagnosis, "ladder")
    share = number_in(diagnosis, "explained_share")
    if len(ladder) > 1:
        before, after = (say_number(number_in(rung, "t_mrmse_m")) for rung in (ladder[0], ladder[-1]))
        turn = [say_number(number_in(rung, "r_mrmse_rad")) for rung in (ladder[0], ladder[-1])]
        lines.append(
            f"<p>With them {before} \u2192 <b>{after} m</b>, {turn[0]} \u2192 <b>{turn[1]} rad</b></p>"
        )
    if share is not None:
        lines.append(f"<p>{say_share(share)} of what can be explained</p>")
    rest = mapping_in(diagnosis, "unexplained")
    if rest.get("where"):
        lines.append(f"<p>Not explained: {escape(rest['where'])}</p>")
    return "".join(lines)


def _answer_what_now(report: RunReport) -> str:
    if not report.text("run"):
        return ""
    words, command = list_steps(report)[0]
    lines = [f"<p>{words}: <code>{escape(command)}</code></p>"]
    undecided = objects_in(report.diagnosis, "undecided")
    if undecided:
        drive = str(undecided[0].get("separate_by", ""))
        names = undecided[0].get("candidates")
        between = " or ".join(map(str, names)) if isinstance(names, list) else ""
        lines.append(f"<p>To tell {escape(between)}: {escape(drive)}</p>")
    return "".join(lines)
