"""Runs together on one screen: parameters of a fleet by level, their course over dates, the map."""

from pipeline.core import INPUT_WORDS, align_rows, format_count, suffix_unit
from pipeline.datasets import Band, DeploymentMap, Fleet, Series, Trend
from pipeline.models import name_number

_SLIP = {"median_modulus": "median slip modulus", "median_window_norm": "slip over 2 s windows"}
_MOST_NUMBERS = 8
"""Parameters of a vehicle on a screen of 24 lines, those of most runs first."""


def format_fleet(fleet: Fleet, *, everything: bool) -> list[str]:
    """Parameters by vehicle, with the bands of another run.

    Args:
        fleet: the parameters of all runs.
        everything: also all terrains, and why each number has its level.
    """
    lines = [fleet.summary]
    for vehicle, runs in fleet.runs.items():
        own = [one for one in fleet.numbers if one.vehicle == vehicle]
        shown = own if everything else own[:_MOST_NUMBERS]
        rows = [("level", "parameter", "value", "95 %", "another run", "unit")]
        for one in shown:
            rows.append(
                (one.level or "open", one.label, *_format_band(one.whole), suffix_unit(one.unit).strip())
            )
            is_split = everything or one.level == "terrain"
            rows += [
                ("", f"  on {name}", *_format_band(band), "")
                for name, band in one.terrains.items()
                if is_split
            ]
        lines += ["", f"{vehicle}: {format_count(len(runs), 'run')}", *align_rows(rows)] if own else []
        hidden = len(own) - len(shown)
        lines += [f"{format_count(hidden, 'more parameter')}: --all, or the page"] if hidden else []
        lines += [f"{one.label}: {one.name}, {one.because}" for one in shown if everything]
    return [*lines, *(f"! {note}" for note in fleet.notes)]


def _format_band(band: Band) -> tuple[str, str, str]:
    ends = [(band.low, band.high), (band.another_low, band.another_high)]
    texts = ["-" if low is None or high is None else f"{low:.3g} to {high:.3g}" for low, high in ends]
    return f"{band.value:.3g}", texts[0], texts[1]


def name_series(series: Series) -> str:
    """What a series is of, in words: `median slip modulus from commands`, `effective track (...)`."""
    effect, _, parameter = series.quantity.partition(".")
    if parameter:
        return f"{name_number(effect, parameter)} ({series.quantity})"
    name, _, source = series.quantity.removesuffix(")").partition(" (")
    return f"{_SLIP[name]} {INPUT_WORDS[source]}"


def format_trend(trend: Trend) -> list[str]:
    """Each series with its largest step, and notes."""
    lines = align_rows([(one.group, one.quantity, one.describe()) for one in trend.series])
    return [*lines, *(f"! {note}" for note in trend.notes)]


def format_map(drawn: DeploymentMap) -> list[str]:
    """Own datasets with their energy, complexity and measure, and notes."""
    measure, unit = drawn.measure, suffix_unit(drawn.measure.unit)
    lines = [
        f"{row['dataset']:<26}{row['energy']:>9.3g} J   complexity {row['complexity']:.1f}   "
        f"{measure.name} {'-' if row['value'] is None else format(row['value'], '.3g')}{unit}"
        for row in drawn.own.iter_rows(named=True)
    ]
    return [*lines, *(f"! {note}" for note in drawn.notes)]


def summarize_map(drawn: DeploymentMap) -> str:
    """How many deployments of the literature are on the map, and what colours own datasets."""
    total = drawn.points.height + len(drawn.missing)
    by = f"{drawn.measure.name} {INPUT_WORDS[drawn.input]}"
    return f"{drawn.points.height} of {total} deployments placed; {by}"
