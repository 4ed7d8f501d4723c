"""Whether the numbers can be trusted: losses, gaps, held poses, findings in words, topics."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.report.run import RunReport, mapping_in, number_in, objects_in
from pipeline.report.words import begin_large, build_table, escape, say_bytes, say_number, say_share

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.report.sections.page import Page

_RANK = {"error": 0, "warning": 1, "info": 2}
_SEVERITY_WORDS = {"error": "do not trust", "warning": "take care", "info": "note"}
_TOPICS = {
    "command": "command",
    "wheels": "measured wheels",
    "pose": "pose",
    "imu": "IMU",
    "interval": "interval",
}


def render_health(page: Page) -> str:
    """Findings, losses and topics."""
    report = page.report
    parts = (_render_findings, _render_losses, _render_quarantine, _render_topics)
    return "".join(render(report) for render in parts)


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


def _render_findings(report: RunReport) -> str:
    findings = list_findings(report)
    if not findings:
        return "<p>Nothing was noticed that would make these numbers doubtful.</p>"
    return f'<ul class="findings">{"".join(_render_finding(finding) for finding in findings)}</ul>'


def _render_finding(finding: Mapping[str, object]) -> str:
    severity = str(finding.get("severity", "info"))
    grade = severity if severity in _RANK else "info"
    place = [escape(finding["where"])] if finding.get("where") else []
    start, end = number_in(finding, "t_start"), number_in(finding, "t_end")
    if start is not None and end is not None:
        place.append(f"{say_number(start)}\u2013{say_number(end)} s")
    elif start is not None:
        place.append(f"at {say_number(start)} s")
    place.append(f"<code>{escape(finding.get('id', ''))}</code>")
    where = " \u00b7 ".join(place)
    return (
        f'<li class="{grade}"><span class="grade">{_SEVERITY_WORDS[grade]}</span>'
        f'<div>{begin_large(escape(finding.get("text", "")))}<p class="where">{where}</p></div></li>'
    )


def _render_losses(report: RunReport) -> str:
    losses = objects_in(report.part("log"), "losses")
    if not losses:
        return ""
    rows = []
    for loss in losses:
        start, end = number_in(loss, "start_s"), number_in(loss, "end_s")
        chunks = number_in(loss, "chunks")
        rows.append(
            [
                escape(loss.get("kind", "")),
                say_bytes(number_in(loss, "bytes")),
                "\u2013" if chunks is None else f"{chunks:.0f}",
                f"{say_number(start)}\u2013{say_number(end)} s" if start is not None else "\u2013",
            ]
        )
    head = ["kind", "size", "chunks", "stretch"]
    return build_table(head, rows, caption="What the log has lost", numeric=(1, 2))


def _render_quarantine(report: RunReport) -> str:
    """Rows that broke a contract, counted by table and rule."""
    rows = []
    for table in report.part("quarantined"):
        rules = mapping_in(mapping_in(report.part("quarantined"), table), "rules")
        rows += [[escape(table), escape(rule), escape(count)] for rule, count in rules.items()]
    head = ["table", "rule", "rows"]
    return build_table(head, rows, caption="Rows set aside", numeric=(2,)) if rows else ""


def _render_topics(report: RunReport) -> str:
    topics = report.part("topics")
    rows = []
    for key, words in _TOPICS.items():
        chosen = mapping_in(topics, key) or {"topic": topics.get(key)}
        topic, reason = chosen.get("topic"), chosen.get("reason")
        if not topic and not reason:
            continue
        shown = f"<code>{escape(topic)}</code>" if topic else "none"
        because = f' <span class="because">{escape(reason)}</span>' if reason else ""
        rows.append(f"<div><dt>{words}</dt><dd>{shown}{because}</dd></div>")
    if not rows:
        return ""
    notes = topics.get("notes")
    told = "".join(f'<p class="note">{escape(note)}</p>' for note in notes) if isinstance(notes, list) else ""
    joined = "".join(rows)
    return f'<p class="caption">Topics used, and why these</p><dl class="facts">{joined}</dl>{told}'
