"""Sections of the page: causes of slip, data health, provenance."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from pipeline.core import format_size, mapping_in, number_in, objects_in, split_interval
from pipeline.models import AT_BOUND, UNDETERMINED, list_effects, name_term, suggest_manoeuvre
from pipeline.report import (
    MISSING,
    Cell,
    Column,
    Picture,
    Table,
    begin_large,
    count_serious,
    format_known_share,
    format_number,
    format_split,
    set_squares,
)
from pipeline.report.figures import Section
from pipeline.report.scene import RunReport, Scene
from pipeline.results import Named
from pipeline.words import (
    describe_cause,
    describe_motion,
    describe_rest,
    describe_unexplained,
    format_remaining_error,
    format_short,
    format_suggestion,
    list_largest_falls,
    list_terms,
)

_RANK = {"error": 0, "warning": 1, "info": 2}
_SEVERITY_WORDS = {"error": "do not trust", "warning": "take care", "info": "note"}
_TOPICS = {
    "command": "command",
    "wheels": "measured wheels",
    "pose": "pose",
    "imu": "IMU",
    "interval": "interval",
}


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


def view_health(page: Page) -> dict[str, object]:
    """Findings, losses and topics."""
    report = page.report
    notes = report.part("topics").get("notes")
    return {
        "findings": [_view_finding(finding) for finding in list_findings(report)],
        "losses": _tabulate_losses(report),
        "quarantine": _tabulate_quarantine(report),
        "topics": list(_list_topics(report)),
        "topic_notes": notes if isinstance(notes, list) else [],
    }


def list_findings(report: RunReport) -> list[Mapping[str, object]]:
    """Findings of the summary, or otherwise of the table, the most severe first."""
    findings = report.items("findings")
    table = report.table("findings")
    if not findings and table is not None:
        findings = list(table.iter_rows(named=True))
    return sorted(findings, key=lambda finding: _RANK.get(str(finding.get("severity")), len(_RANK)))


def summarise_health(report: RunReport) -> list[tuple[str, str]]:
    """Grade (`good`, `note`, `warning`, `error`) and text for the strip at the head of the page."""
    log = report.part("log")
    losses = objects_in(log, "losses")
    complete = log.get("complete") is not False and not losses
    strip = [("good", "log complete") if complete else ("error", f"log has losses ({max(len(losses), 1)})")]
    if log.get("unchecked"):
        strip.append(("note", "log unchecked"))
    segments = report.number("segments")
    if segments is not None:
        gaps = int(segments) - 1
        strip.append(("good", "no gaps") if gaps <= 0 else ("note", f"{int(segments):,} segments"))
    findings = list_findings(report)
    repeated = next((number_in(one, "value") for one in findings if one.get("id") == "held_poses"), None)
    if repeated is not None:
        strip.append(("note", f"{format_known_share(repeated)} of the poses repeated"))
    elif report.number("held_poses") == 0:
        strip.append(("good", "no repeated poses"))
    strip.extend(count_serious(findings).items())
    return strip


def _view_finding(finding: Mapping[str, object]) -> dict[str, object]:
    severity = str(finding.get("severity", "info"))
    grade = severity if severity in _RANK else "info"
    places = [str(finding["where"])] if finding.get("where") else []
    start, end = number_in(finding, "t_start"), number_in(finding, "t_end")
    if start is not None:
        places.append(f"at {format_number(start)} s" if end is None else _format_stretch(start, end))
    return {
        "grade": grade,
        "word": _SEVERITY_WORDS[grade],
        "text": str(finding.get("text", "")),
        "places": places,
        "id": finding.get("id", ""),
    }


def _format_stretch(start: float | None, end: float | None) -> str:
    return MISSING if start is None else f"{format_number(start)}\u2013{format_number(end)} s"


def _tabulate_losses(report: RunReport) -> Table:
    rows = []
    for loss in objects_in(report.part("log"), "losses"):
        chunks, size = number_in(loss, "chunks"), number_in(loss, "bytes")
        rows.append(
            [
                str(loss.get("kind", "")),
                MISSING if size is None else format_size(size),
                MISSING if chunks is None else f"{chunks:.0f}",
                _format_stretch(number_in(loss, "start_s"), number_in(loss, "end_s")),
            ]
        )
    head = (Column("kind"), Column("size", number=True), Column("chunks", number=True), Column("stretch"))
    return Table("What the log has lost", head, rows)


def _tabulate_quarantine(report: RunReport) -> Table:
    """Rows that violated a contract, counted by table and rule."""
    broken = report.part("quarantined")
    rows = [
        [table, rule, str(count)]
        for table in broken
        for rule, count in mapping_in(mapping_in(broken, table), "rules").items()
    ]
    return Table("Rows set aside", (Column("table"), Column("rule"), Column("rows", number=True)), rows)


def _list_topics(report: RunReport) -> Iterator[tuple[str, object, object]]:
    """Use of a topic, its name, and the reason for its choice."""
    topics = report.part("topics")
    for key, words in _TOPICS.items():
        chosen = mapping_in(topics, key) or {"topic": topics.get(key)}
        topic, reason = chosen.get("topic"), chosen.get("reason")
        if topic or reason:
            yield words, topic, reason


def view_provenance(page: Page) -> dict[str, object]:
    """Path and hash of the log, keys and versions, the effective configuration."""
    report = page.report
    log, origin = report.part("log"), report.part("provenance")
    rate = report.number("rate_hz")
    facts = [
        ("log", log.get("path")),
        ("SHA-256", log.get("sha256")),
        ("dataset", report.text("dataset")),
        ("rate", f"{rate:g} Hz" if rate is not None else ""),
    ]
    facts += [
        (name, ", ".join(f"{key} {value}" for key, value in mapping_in(origin, name).items()))
        for name in ("versions", "keys")
    ]
    configuration = origin.get("configuration")
    if isinstance(configuration, Mapping):
        configuration = configuration and json.dumps(
            configuration, indent=2, sort_keys=True, ensure_ascii=False, default=str
        )
    return {"facts": [fact for fact in facts if fact[1]], "configuration": configuration}


_MANY_FOLD = 10.0
_PATHS = {"wheels": "from command to wheels", "measured": "from wheels to body"}
"""Paths on which effects are judged where wheels are measured; errors of one are not those of the other."""
_HEAD = (
    Column("effect"),
    Column("value", number=True),
    Column("95 %", number=True),
    Column("95 %, another run", number=True),
    Column("held-out squared error over half a second without it"),
)


def format_remaining(report: RunReport) -> str:
    """Format the error of the model relative to the noise floor; empty if unknown."""
    diagnosis = report.diagnosis
    if len(diagnosis.ladder) < 2 or diagnosis.noise_floor is None:  # noqa: PLR2004 - without an effect nothing remains
        return ""
    return format_remaining_error(
        diagnosis.ladder[-1].t_mrmse_m, diagnosis.noise_floor.t_mrmse_m, diagnosis.explained_share
    )


def view_why(page: Page) -> dict[str, object]:
    """Effects, open questions, the split in one sentence, and the figures."""
    report = page.report
    main, minor = report.effects
    rows = [row for entry in (*main, *minor) for row in _list_parameters(entry)]
    drivetrain, ground, cross = report.split
    signatures = {picture.id: picture for picture in page.pictures[Section.EFFECT]}
    return {
        "refusal": report.refusal,
        "diagnosed": report.is_diagnosed,
        "named": [_view_effect(report, entry, signatures.get(f"signature-{entry.id}")) for entry in main],
        "smaller": [_view_effect(report, entry, signatures.get(f"signature-{entry.id}")) for entry in minor],
        "groups": report.small_groups,
        "undecided": bool(report.undecided),
        "remaining": format_remaining(report),
        "table": Table("Effects", _HEAD, rows),
        "open": list(_list_open(report)),
        "split": None
        if drivetrain is None or ground is None or cross is None or report.is_refused
        else {"from_drivetrain": drivetrain > ground, "words": format_split(drivetrain, ground, cross)},
        "pictures": page.pictures[Section.WHY],
    }


def _view_effect(report: RunReport, effect: Named, signature: object) -> dict[str, object]:
    """One effect: description, possible causes, and its measured signature."""
    return {
        "id": effect.id,
        "does": begin_large(set_squares(describe_motion(effect, report.diagnosis))),
        "value": set_squares(format_short(effect)),
        "fall": list_largest_falls(report.diagnosis).get(effect.id, "").replace("->", "\u2192"),
        "may_be": set_squares(describe_cause(effect)),
        "alike": _list_alike(effect),
        "picture": signature,
    }


def _list_alike(effect: Named) -> tuple[str, str] | None:
    """Effects that are easily confused with this one, and the drive that would separate them."""
    known = {kind.id: kind() for kind in list_effects()}
    names = [name for name in effect.confused_with if name in known]
    if not names or effect.id not in known:
        return None
    return ", ".join(map(name_term, names)), suggest_manoeuvre(
        known[effect.id], *(known[name] for name in names)
    )


def _list_parameters(effect: Named) -> list[list[str | Cell]]:
    """One row per parameter: value, interval, and in the first row the gain of the effect."""
    notes = [f"same as {', '.join(effect.equivalent_to)}"] if effect.equivalent_to else []
    gain = _format_gain(effect.gain)
    without = Cell(gain, small=_PATHS.get(effect.path, "")) if gain else ""
    rows: list[list[str | Cell]] = []
    for key, value in effect.parameters.items():
        shown = "" if value.unit in {"1", ""} else set_squares(value.unit)
        doubts = [AT_BOUND if value.at_bound else UNDETERMINED] if value.is_undetermined else []
        text, ends = _format_within(value.value, value.low, value.high)
        rows.append(
            [
                Cell(small=key) if rows else Cell(effect.id, small=key, notes=notes),
                Cell(text, small=shown, notes=doubts),
                ends,
                _format_within(value.value, value.another_run.low, value.another_run.high)[1],
                "" if rows else without,
            ]
        )
    return rows or [[Cell(effect.id, notes=notes), "", "", "", without]]


def _format_within(value: float, low: float, high: float) -> tuple[str, str]:
    """A value, and an interval about it with the digits that it supports; empty where unknown."""
    if not math.isfinite(value + low + high):
        return format_number(value, digits=4) if math.isfinite(value) else "", ""
    text, *both = split_interval(value, low, high)
    return text, " to ".join(both)


def _format_gain(gain: float) -> str:
    if not math.isfinite(gain):
        return ""
    if gain >= _MANY_FOLD:
        return f"x {gain + 1.0:,.0f}"
    return f"x {gain + 1.0:.3g}"


def _list_open(report: RunReport) -> Iterator[tuple[str, str, str]]:
    """What this log does not determine, and what no effect of the catalogue explains, with its formula."""
    diagnosis = report.diagnosis
    for names, advice in report.undecided:
        yield "undecided", f"{names}: {advice}", ""
    if diagnosis.unexplained is not None:
        rest = diagnosis.unexplained
        terms = list_terms(rest)
        texts = [describe_unexplained(rest), *terms, format_suggestion(rest)]
        # A formula that is too long for a line is nothing that anybody reads.
        yield "unexplained", "; ".join(filter(None, texts)), (rest.formula or "") if terms else ""
    if diagnosis.unobservable_why:
        yield "not observable in this log", ", ".join(map(name_term, diagnosis.unobservable_why)), ""
    known = {str(entry.get("text", "")) for entry in list_findings(report)}
    for finding in diagnosis.findings:
        if finding.text not in known:
            yield "finding", finding.text, ""
    if diagnosis.disturbance is not None and diagnosis.unexplained is None:
        yield "residual", describe_rest(diagnosis), ""
