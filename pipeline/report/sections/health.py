"""Whether the numbers can be trusted: losses, gaps, held poses, findings in words, topics."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.report.elements import Column, Table
from pipeline.report.run import RunReport, mapping_in, number_in, objects_in
from pipeline.report.words import MISSING, say_bytes, say_number, say_share

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from pipeline.report.sections import Page

_RANK = {"error": 0, "warning": 1, "info": 2}
_SEVERITY_WORDS = {"error": "do not trust", "warning": "take care", "info": "note"}
_TOPICS = {
    "command": "command",
    "wheels": "measured wheels",
    "pose": "pose",
    "imu": "IMU",
    "interval": "interval",
}


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
    """Findings of the summary, or else of the table, the gravest first."""
    found = report.items("findings")
    table = report.table("findings")
    if not found and table is not None:
        found = list(table.iter_rows(named=True))
    return sorted(found, key=lambda finding: _RANK.get(str(finding.get("severity")), len(_RANK)))


def summarise_health(report: RunReport) -> list[tuple[str, str]]:
    """Grade (`good`, `note`, `warning`, `error`) and words for the strip at the head of the page."""
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
    held = _held_share(report)
    if held is not None:
        strip.append(
            ("good", "no held poses") if held == 0 else ("note", f"{say_share(held)} of the poses held")
        )
    findings = [str(finding.get("severity")) for finding in list_findings(report)]
    for severity, word in (("error", "error"), ("warning", "warning")):
        count = findings.count(severity)
        if count:
            strip.append((severity, f"{count} {word}{'s' if count > 1 else ''}"))
    return strip


def _held_share(report: RunReport) -> float | None:
    """Share of held poses; the summary may tell the share or, as a whole number, the count."""
    held, poses = report.summary.get("held_poses"), report.table("poses")
    if isinstance(held, float):
        return held
    if isinstance(held, int) and (poses is not None or held == 0):
        return held / poses.height if poses is not None else 0.0
    return None


def _view_finding(finding: Mapping[str, object]) -> dict[str, object]:
    severity = str(finding.get("severity", "info"))
    grade = severity if severity in _RANK else "info"
    places = [str(finding["where"])] if finding.get("where") else []
    start, end = number_in(finding, "t_start"), number_in(finding, "t_end")
    if start is not None:
        places.append(f"at {say_number(start)} s" if end is None else _say_stretch(start, end))
    return {
        "grade": grade,
        "word": _SEVERITY_WORDS[grade],
        "text": str(finding.get("text", "")),
        "places": places,
        "id": finding.get("id", ""),
    }


def _say_stretch(start: float | None, end: float | None) -> str:
    return MISSING if start is None else f"{say_number(start)}\u2013{say_number(end)} s"


def _tabulate_losses(report: RunReport) -> Table:
    rows = []
    for loss in objects_in(report.part("log"), "losses"):
        chunks = number_in(loss, "chunks")
        rows.append(
            [
                str(loss.get("kind", "")),
                say_bytes(number_in(loss, "bytes")),
                MISSING if chunks is None else f"{chunks:.0f}",
                _say_stretch(number_in(loss, "start_s"), number_in(loss, "end_s")),
            ]
        )
    head = (Column("kind"), Column("size", number=True), Column("chunks", number=True), Column("stretch"))
    return Table("What the log has lost", head, rows)


def _tabulate_quarantine(report: RunReport) -> Table:
    """Rows that broke a contract, counted by table and rule."""
    broken = report.part("quarantined")
    rows = [
        [table, rule, str(count)]
        for table in broken
        for rule, count in mapping_in(mapping_in(broken, table), "rules").items()
    ]
    return Table("Rows set aside", (Column("table"), Column("rule"), Column("rows", number=True)), rows)


def _list_topics(report: RunReport) -> Iterator[tuple[str, object, object]]:
    """What it serves as, the topic, and why this one."""
    topics = report.part("topics")
    for key, words in _TOPICS.items():
        chosen = mapping_in(topics, key) or {"topic": topics.get(key)}
        topic, reason = chosen.get("topic"), chosen.get("reason")
        if topic or reason:
            yield words, topic, reason
