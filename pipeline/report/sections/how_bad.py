"""How far the motion was from the ideal model: the numbers, over time, and their distribution."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.report.figures.figure import Section
from pipeline.report.run import INPUT_WORDS, RunReport, mapping_in, number_in, numbers_in, objects_in
from pipeline.report.words import build_table, escape, say_number

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.report.sections.page import Page


def render_how_bad(page: Page) -> str:
    """Cards with the medians, slip over time, distributions, table of both inputs."""
    report = page.report
    cards = "".join(_render_card(name, _numbers_of(report, name)) for name in report.inputs)
    lead = (
        f'<div class="cards">{cards}</div>' if cards else '<p class="lead">No slip could be worked out.</p>'
    )
    return lead + _render_horizon(report) + page.render_figures(Section.HOW_BAD) + _render_table(report)


def _render_horizon(report: RunReport) -> str:
    """What a planner would feel: how far the ideal model is off after two seconds, and the named one."""
    ladder = objects_in(report.diagnosis, "ladder")
    if not ladder:
        return ""
    first, last = ladder[0], ladder[-1]
    ends = [
        f"<b>{say_number(number_in(rung, 't_mrmse_m'))} m</b> and "
        f"<b>{say_number(number_in(rung, 'r_mrmse_rad'))} rad</b>"
        for rung in (first, last)
    ]
    rest = f"; with the named effects {ends[1]}" if len(ladder) > 1 else ""
    return (
        f'<p class="lead">Two seconds ahead the ideal model is off by {ends[0]}{rest}, on data not seen.</p>'
    )


def _numbers_of(report: RunReport, name: str) -> Mapping[str, object]:
    found = mapping_in(report.part("by_input"), name)
    if found or name != report.main_input:
        return found
    return {key: report.summary.get(key) for key in ("samples", "median_modulus", "median_window_norm")}


def _render_card(name: str, numbers: Mapping[str, object]) -> str:
    median = say_number(number_in(numbers, "median_modulus"))
    norm = say_number(number_in(numbers, "median_window_norm"))
    transitory = number_in(numbers, "transitory_median_modulus")
    steady = number_in(numbers, "steady_median_modulus")
    split = (
        f"<div><dt>transitory</dt><dd>{say_number(transitory)} m/s</dd></div>"
        f"<div><dt>steady</dt><dd>{say_number(steady)} m/s</dd></div>"
        if transitory is not None or steady is not None
        else ""
    )
    return (
        f'<div class="card {escape(name)}"><p class="what">median slip <b>{INPUT_WORDS[name]}</b></p>'
        f'<p class="big">{median} <span>m/s</span></p>'
        f"<dl>{split}<div><dt>2 s window norm</dt><dd>{norm} m/s</dd></div></dl></div>"
    )


def _render_table(report: RunReport) -> str:
    columns = [_list_numbers(_numbers_of(report, name)) for name in report.inputs]
    if not columns:
        return ""
    scale = report.number("length_scale_m")
    caption = "Slip g = f(u) \u2212 v of the ideal model" + (
        f"; modulus with L = {scale:g} m" if scale is not None else ""
    )
    rows = [[words, *(column[i] for column in columns)] for i, words in enumerate(_QUANTITIES)]
    head = ["u", *(INPUT_WORDS[name] for name in report.inputs)]
    return build_table(head, rows, caption=caption, numeric=range(1, len(head)))


_QUANTITIES = (
    "median modulus <small>m/s</small>",
    "median 2 s window norm <small>m/s</small>",
    "rms g<sub>x</sub>, forward <small>m/s</small>",
    "rms g<sub>y</sub>, sideways <small>m/s</small>",
    "rms g<sub>w</sub>, yaw rate <small>rad/s</small>",
    "time steps",
)


def _list_numbers(numbers: Mapping[str, object]) -> list[str]:
    """Cells in the order of the quantities."""
    rms = [*numbers_in(numbers, "rms"), None, None, None][:3]
    medians = [number_in(numbers, name) for name in ("median_modulus", "median_window_norm")]
    samples = number_in(numbers, "samples")
    return [
        *(say_number(value) for value in medians + rms),
        "\u2013" if samples is None else f"{samples:,.0f}",
    ]
