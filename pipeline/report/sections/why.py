"""Why it slipped: what the diagnosis names and cannot tell, what the drivetrain did, what the ground did."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.diagnosis.excitation import suggest_manoeuvre
from pipeline.models.catalogue import list_effects
from pipeline.report.elements import Cell, Column, Table
from pipeline.report.figures.figure import Section
from pipeline.report.run import RunReport, mapping_in, number_in, objects_in, say_ends
from pipeline.report.sections.health import list_findings
from pipeline.report.words import begin_large, say_number, say_share, say_split

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from pipeline.report.sections import Page

_MANY_FOLD = 10.0
_CHANNELS = {"x": "forward motion", "y": "sideways motion", "w": "yaw rate"}
_HEAD = (
    Column("effect"),
    Column("value", number=True),
    Column("95 %", number=True),
    Column("95 %, another run", number=True),
    Column("squared error of unseen data without it"),
)


def view_why(page: Page) -> dict[str, object]:
    """Named effects, what stays open, the split in one sentence, and the figures."""
    report = page.report
    effects = objects_in(report.diagnosis, "effects")
    rows = [row for entry in effects for row in _list_parameters(entry)]
    drivetrain, ground, cross = report.split
    signatures = {picture.title: picture for picture in page.pictures[Section.EFFECT]}
    return {
        "refused": report.is_refused,
        "diagnosed": bool(report.diagnosis),
        "named": [_view_effect(entry, signatures.get(str(entry.get("id")))) for entry in effects],
        "explained": number_in(report.diagnosis, "explained_share"),
        "table": Table("Missing from the ideal model", _HEAD, rows),
        "open": list(_list_open(report)),
        "split": None
        if drivetrain is None or ground is None or cross is None or report.is_refused
        else {"from_drivetrain": drivetrain > ground, "words": say_split(drivetrain, ground, cross)},
        "pictures": page.pictures[Section.WHY],
    }


def _view_effect(entry: Mapping[str, object], signature: object) -> dict[str, object]:
    """One named effect: what the vehicle does, what else that may be, and what was measured of it."""
    name = str(entry.get("id", ""))
    does, may_be = say_effect(entry)
    return {
        "id": name,
        "does": begin_large(does),
        "may_be": may_be,
        "alike": _list_alike(entry),
        "unless": [begin_large(str(one.get("text", ""))) for one in objects_in(entry, "unless")],
        "picture": signature,
    }


def say_effect(entry: Mapping[str, object]) -> tuple[str, str]:
    """What the vehicle does by a named effect, and what else that may be called on other grounds."""
    does, _, may_be = str(entry.get("sentence") or entry.get("id", "")).partition(": ")
    return does, may_be


def _list_alike(entry: Mapping[str, object]) -> tuple[str, str] | None:
    """Effects that draw nearly the same curve under poor driving, and what to drive to tell them apart."""
    alike = entry.get("confused_with")
    known = {effect.id: effect() for effect in list_effects()}
    names = [name for name in alike if name in known] if isinstance(alike, list | tuple) else []
    if not names or entry.get("id") not in known:
        return None
    return ", ".join(names), suggest_manoeuvre(known[str(entry["id"])], *(known[name] for name in names))


def _list_parameters(entry: Mapping[str, object]) -> list[list[str | Cell]]:
    """A row a parameter: value, interval, and with the first what the effect is worth."""
    name, same = str(entry.get("id", "")), entry.get("equivalent_to")
    notes = [f"same as {', '.join(map(str, same))}"] if isinstance(same, list) and same else []
    notes += ["tentative"] if entry.get("tentative") else []
    gain = _say_gain(number_in(entry, "gain"))
    parameters = mapping_in(entry, "parameters")
    rows: list[list[str | Cell]] = []
    for key in parameters:
        values = mapping_in(parameters, key)
        unit = values.get("unit")
        shown = str(unit).replace("^2", "\u00b2") if unit not in (None, "1", "") else ""
        rows.append(
            [
                Cell(small=key) if rows else Cell(name, small=key, notes=notes),
                Cell(say_number(number_in(values, "value"), digits=4), small=shown),
                say_ends(values, digits=4),
                say_ends(mapping_in(values, "another_run"), digits=4),
                "" if rows else gain,
            ]
        )
    return rows or [[Cell(name, notes=notes), "", "", "", gain]]


def _say_gain(gain: float | None) -> str:
    if gain is None:
        return ""
    if gain >= _MANY_FOLD:
        return f"{gain + 1.0:,.0f} times as large"
    if gain < 0.0:
        return f"{say_share(-gain)} smaller"
    return f"{say_share(gain)} larger"


def _list_open(report: RunReport) -> Iterator[tuple[str, str, str]]:
    """What cannot be told from this log, and what nothing of the catalogue takes, with its formula."""
    diagnosis = report.diagnosis
    for names, advice in report.undecided:
        yield "undecided", f"{names}: {advice}", ""
    rest = mapping_in(diagnosis, "unexplained")
    if rest:
        share = say_share(number_in(rest, "share"))
        formula = str(rest.get("formula") or "")
        example = ", for example" if formula else ""
        channel = _CHANNELS.get(str(rest.get("channel")), "motion")
        told = f"{share} of what is left in the {channel}: {rest.get('where', '')}{example}"
        yield "unexplained", told, formula
    small = [str(entry.get("id", "")) for entry in objects_in(diagnosis, "immaterial")]
    if small:
        yield "below what matters", f"{', '.join(small)}: a planner would not feel it, see the JSON", ""
    unseen = diagnosis.get("unobservable")
    if isinstance(unseen, list) and unseen:
        yield "unobservable", f"{', '.join(map(str, unseen))}: this log would not show it", ""
    known = {str(entry.get("text", "")) for entry in list_findings(report)}
    for entry in objects_in(diagnosis, "findings"):
        if str(entry.get("text", "")) not in known:
            yield "finding", str(entry.get("text", "")), ""
    left = mapping_in(diagnosis, "disturbance").get("text")
    if left and not rest:
        yield "what is left", str(left), ""
