"""Why it slipped: what the diagnosis names and cannot tell, what the drivetrain did, what the ground did."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.report.figures.figure import Section
from pipeline.report.run import mapping_in, number_in, objects_in
from pipeline.report.sections.health import list_findings
from pipeline.report.words import build_table, escape, say_number, say_share

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.report.run import RunReport
    from pipeline.report.sections.page import Page

_MANY_FOLD = 10.0


def render_why(page: Page) -> str:
    """Named effects, what stays open, the split in one sentence, and the figures."""
    parts = [_render_named(page.report), _render_open(page.report), _render_split(page.report)]
    return "".join(parts) + page.render_figures(Section.WHY)


def _render_named(report: RunReport) -> str:
    """The effects that are missing from the ideal model, with their numbers."""
    diagnosis = report.diagnosis
    if not diagnosis:
        return ""
    effects = objects_in(diagnosis, "effects")
    if not effects:
        return '<p class="lead">No effect could be named as missing from the ideal model.</p>'
    names = ", ".join(f"<b>{escape(entry.get('id', ''))}</b>" for entry in effects)
    share = number_in(diagnosis, "explained_share")
    explained = (
        f" The model with them explains {say_share(share)} of what can be explained."
        if share is not None
        else ""
    )
    rows = [row for entry in effects for row in _list_parameters(entry)]
    table = build_table(
        ["effect", "value", "95 %", "without it"],
        rows,
        caption="Missing from the ideal model",
        numeric=(1, 2),
    )
    return f'<p class="lead">Missing from the ideal model: {names}.{explained}</p>{table}'


def _list_parameters(entry: Mapping[str, object]) -> list[list[str]]:
    name, gain = escape(entry.get("id", "")), number_in(entry, "gain")
    same = entry.get("equivalent_to")
    also = (
        f"<br><small>same as {escape(', '.join(map(str, same)))}</small>"
        if isinstance(same, list) and same
        else ""
    )
    doubt = "<br><small>tentative</small>" if entry.get("tentative") else ""
    parameters = mapping_in(entry, "parameters")
    rows = []
    for number, key in enumerate(parameters):
        values = mapping_in(parameters, key)
        unit = values.get("unit")
        shown = f" <small>{escape(unit).replace('^2', '²')}</small>" if unit not in (None, "1", "") else ""
        low, high = number_in(values, "low"), number_in(values, "high")
        rows.append(
            [
                f"{name} <small>{escape(key)}</small>{also}{doubt}"
                if number == 0
                else f"<small>{escape(key)}</small>",
                say_number(number_in(values, "value"), digits=4) + shown,
                "" if low is None else f"{say_number(low, digits=4)} to {say_number(high, digits=4)}",
                _say_gain(gain) if number == 0 else "",
            ]
        )
    return rows or [[f"{name}{also}{doubt}", "", "", _say_gain(gain)]]


def _say_gain(gain: float | None) -> str:
    if gain is None:
        return ""
    if gain >= _MANY_FOLD:
        return f"the loss is {gain + 1.0:,.0f} times as high"
    return f"the loss rises by {say_share(gain)}"


def _render_open(report: RunReport) -> str:
    """What cannot be told from this log, and what nothing of the catalogue takes."""
    diagnosis = report.diagnosis
    told = []
    for entry in objects_in(diagnosis, "undecided"):
        candidates = entry.get("candidates")
        names = " or ".join(map(str, candidates)) if isinstance(candidates, list) else ""
        told.append(("undecided", f"{names}: {entry.get('separate_by', '')}"))
    rest = mapping_in(diagnosis, "unexplained")
    if rest:
        share = say_share(number_in(rest, "share"))
        formula = f", for example {rest['formula']}" if rest.get("formula") else ""
        channel = _CHANNELS.get(str(rest.get("channel")), "motion")
        told.append(
            ("unexplained", f"{share} of what is left in the {channel}: {rest.get('where', '')}{formula}")
        )
    unseen = diagnosis.get("unobservable")
    if isinstance(unseen, list) and unseen:
        told.append(("unobservable", f"{', '.join(map(str, unseen))}: this log would not show it"))
    known = {str(entry.get("text", "")) for entry in list_findings(report)}
    told += [
        ("finding", str(entry.get("text", "")))
        for entry in objects_in(diagnosis, "findings")
        if str(entry.get("text", "")) not in known
    ]
    left = mapping_in(diagnosis, "disturbance").get("text")
    if left and not rest:
        told.append(("what is left", str(left)))
    items = "".join(f"<div><dt>{word}</dt><dd>{escape(text)}</dd></div>" for word, text in told)
    return f'<dl class="facts open">{items}</dl>' if items else ""


def _render_split(report: RunReport) -> str:
    split = report.part("split")
    shares = {name: number_in(split, name) for name in ("drivetrain", "ground", "cross")}
    if shares["drivetrain"] is None or shares["ground"] is None:
        return ""
    larger = "drivetrain" if shares["drivetrain"] > shares["ground"] else "ground"
    return (
        f'<p class="lead split">Most of the slip on command arises {_PLACES[larger]}: drivetrain '
        f"{say_share(shares['drivetrain'])}, ground {say_share(shares['ground'])}, "
        f"cross term {say_share(shares['cross'])} of the mean square.</p>"
    )


_CHANNELS = {"x": "forward motion", "y": "sideways motion", "w": "yaw rate"}
_PLACES = {
    "drivetrain": "between command and wheels",
    "ground": "between wheels and ground",
}
