"""Whether the numbers can be trusted: losses, gaps, held poses, findings in words, topics."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.report.run import RunReport, mapping_in, number_in, objects_in
from pipeline.report.words import build_table, escape, say_bytes, say_number, say_share

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.report.sections.page import Page

_RANK = {"error": 0, "warning": 1, "info": 2}
_SEVERITY_WORDS = {"error": "do not trust", "warning": "take care", "info": "note"}
_TOPICS = {"command": "command", "wheels": "measured wheels", "pose": "pose", "imu": "IMU"}


def render_health(page: Page) -> str:
    """Findings, losses and topics."""
    report = page.report
    return _render_findings(report) + _render_losses(report) + _render_topics(report)


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
    held = report.number("held_poses")
    poses = report.table("poses")
    if held is None:
        return None
    if held > 1 and poses is not None:
        return held / poses.height
    return held if held <= 1 else None


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
    joined = " \u00b7 ".join(place)
    where = f' <span class="where">{joined}</span>' if place else ""
    return (
        f'<li class="{grade}"><span class="grade">{_SEVERITY_WORDS[grade]}</span>'
        f"<div>{escape(finding.get('text', ''))}{where} "
        f"<code>{escape(finding.get('id', ''))}</code></div></li>"
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
    joined = "".join(rows)
    return f'<p class="caption">Topics used, and why these</p><dl class="facts">{joined}</dl>' if rows else ""
