"""How far the motion was from the ideal model: the numbers, over time, and their distribution."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.report.elements import Cell, Column, Table
from pipeline.report.figures.figure import Section
from pipeline.report.run import INPUT_WORDS, RunReport, mapping_in, number_in, numbers_in
from pipeline.report.words import MISSING, say_number

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.report.sections import Page


def view_how_bad(page: Page) -> dict[str, object]:
    """Cards with the medians, slip over time, distributions, table of both inputs."""
    report = page.report
    return {
        "cards": [_view_card(name, _numbers_of(report, name)) for name in report.inputs],
        "ladder": report.ladder,
        "pictures": page.pictures[Section.HOW_BAD],
        "table": _tabulate(report),
    }


def _numbers_of(report: RunReport, name: str) -> Mapping[str, object]:
    found = mapping_in(report.part("by_input"), name)
    if found or name != report.main_input:
        return found
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
        f"; modulus with L = {scale:g} m" if scale is not None else ""
    )
    rows: list[list[str | Cell]] = [
        [words, *(column[i] for column in columns)] for i, words in enumerate(_QUANTITIES)
    ]
    head = [Column("u"), *(Column(INPUT_WORDS[name], number=True) for name in report.inputs)]
    return Table(caption, head, rows)


_QUANTITIES = (
    Cell("median modulus", small="m/s"),
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
        *(say_number(value) for value in medians + rms),
        MISSING if samples is None else f"{samples:,.0f}",
    ]
