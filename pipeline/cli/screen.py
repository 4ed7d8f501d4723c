"""What people see on a terminal: the summary of a run, a batch, and a log that grows."""

from __future__ import annotations

import math
import shlex
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from pipeline import words
from pipeline.cli.conventions import format_vehicle_source, print_note, tidy_line
from pipeline.core import (
    INPUT_WORDS,
    format_count,
    format_duration,
    format_errors,
    format_interval,
    format_recorded,
    format_size,
    mapping_in,
    name_state,
    number_in,
    objects_in,
)
from pipeline.report import count_serious, format_distance, format_split
from pipeline.report.scene import RunReport
from pipeline.results import RunDiagnosis, has_no_pose, key_finding, read_findings, read_result
from pipeline.words.diagnosis import has_dead_encoder, list_lines

if TYPE_CHECKING:
    from rich.progress import Progress

    from pipeline.batch.batch_run import Line


class SilentWatch:
    """Says nothing."""

    def plan(self, todo: int, settled: int, size: int) -> None:
        """Ignored."""

    def wait(self, log: str, holder: str) -> None:
        """Ignored."""

    def notify(self, line: Line, size: int) -> None:
        """Ignored."""


def _format_wait(log: str, holder: str) -> str:
    return f"{log} waits: another batch works on it, {holder}"


class LineWatch:
    """One line a log on stderr."""

    def __init__(self) -> None:
        self._started = time.monotonic()
        self._todo = self._done = self._size = self._read = 0

    def plan(self, todo: int, settled: int, size: int) -> None:
        """Say how much there is to do."""
        self._started, self._todo, self._size = time.monotonic(), todo, size
        print_note(f"{format_count(todo, 'log')} to work on ({format_size(size)}), {settled} already done")

    def wait(self, log: str, holder: str) -> None:
        """Say whom a log waits for."""
        print_note(_format_wait(log, holder))

    def notify(self, line: Line, size: int) -> None:
        """Say what came of a log and how long the rest may take."""
        self._done += 1
        self._read += size
        state = name_state(line.state)
        what = f"{state}: {line.reason}" if line.reason else state
        remaining = (
            f", about {format_duration(round(self.estimate_rest()))} left" if self._done < self._todo else ""
        )
        print_note(
            f"[{self._done}/{self._todo}] {line.run or line.path} {what} ({line.seconds:.1f} s){remaining}"
        )

    def estimate_rest(self) -> float:
        """Seconds that the rest takes if a byte of it, or else a log, takes as long as those before."""
        share = self._read / self._size if self._read else self._done / self._todo
        return (time.monotonic() - self._started) * (1.0 - share) / share


class BarWatch:
    """A bar on a terminal; only what went wrong gets a line."""

    def __init__(self, bar: Progress) -> None:
        self._bar, self._task = bar, bar.add_task("logs", total=None)

    def plan(self, todo: int, settled: int, size: int) -> None:
        """Show how much there is to do."""
        del settled, size
        self._bar.update(self._task, total=todo)

    def wait(self, log: str, holder: str) -> None:
        """Say whom a log waits for."""
        self._bar.console.print(tidy_line(_format_wait(log, holder)), markup=False, highlight=False)

    def notify(self, line: Line, size: int) -> None:
        """Move the bar on."""
        del size
        if line.reason:
            text = tidy_line(f"{line.run or line.path} {name_state(line.state)}: {line.reason}")
            self._bar.console.print(text, markup=False, highlight=False)
        self._bar.advance(self._task)


@contextmanager
def open_watch(*, quiet: bool) -> Iterator[SilentWatch | LineWatch | BarWatch]:
    """Whoever fits the place: nobody, a bar, or lines."""
    if quiet or not sys.stderr.isatty():
        yield SilentWatch() if quiet else LineWatch()
        return
    from rich.console import Console  # noqa: PLC0415 - only for people at a terminal
    from rich.progress import MofNCompleteColumn, Progress  # noqa: PLC0415 - likewise

    columns = (*Progress.get_default_columns(), MofNCompleteColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        yield BarWatch(bar)


Summary = Mapping[str, object]

_LABEL = 10
_READ_FROM_LOG = ("robot_description", "namespace", "message_types", "folder", "fitted")
_SHOWN = 6


def format_run(
    summary: Summary,
    *,
    unchanged: bool,
    twin: str = "",
    replaced: str = "",
    said: str = "",
    plan: str | None = None,
    everything: bool = False,
) -> str:
    """The summary of one run as lines of text: the verdict, the effects, what remains and what to do.

    Args:
        summary: the JSON object of the run.
        unchanged: whether nothing was computed.
        twin: a log of the same content that it shares.
        replaced: what the earlier results that this run replaces were made with, and where they are.
        said: what was chosen on the command line, to be said again by the next command.
        plan: flags of the `slip plan` that decides what is undecided; None where none does.
        everything: whether more is shown than what everybody reads.
    """
    verdict = str(summary.get("verdict") or "")
    head, first = _format_head(summary), [verdict] if verdict else []
    is_excluded = RunReport(summary).refusal
    # Those of the run and of its diagnosis that need attention, except what the verdict says.
    findings = read_findings(summary)
    known = set(map(key_finding, findings))
    own = read_findings(mapping_in(summary, "diagnosis"))
    every = [*findings, *(one for one in own if key_finding(one) not in known)]
    # If the data are invalid, this is stated first.
    lines = [*first, *head] if is_excluded else [*head[:1], *first, *head[1:]]
    lines += [
        *([] if is_excluded and not everything else _format_slip(summary, everything=everything)),
        *(_format_topics(summary) if everything else []),
        *_format_diagnosis(summary, everything=everything),
        *(_row(*row) for row in words.list_findings({"": every}, verdict, everything=everything)),
        *([_row("same", f"content as {twin}: counted once, under that name")] if twin else []),
        *([_row("replaced", f"earlier results, {replaced}")] if replaced else []),
        *_format_end(summary, said, plan, unchanged=unchanged),
    ]
    return "\n".join(tidy_line(line.rstrip()) for line in lines) + "\n"


def _number(content: Mapping[str, object], key: str, digits: int = 3, missing: str = "-") -> str:
    value = number_in(content, key)
    return missing if value is None else f"{value:.{digits}g}"


def _size(content: Mapping[str, object], key: str) -> str:
    """Two significant digits, zeros too: `2.0`."""
    value = number_in(content, key)
    return "-" if value is None else f"{value:#.2g}".removesuffix(".")


def _size_with_interval(content: Mapping[str, object], key: str) -> str:
    """A speed [m/s] with its interval where it has one."""
    value, low, high = (number_in(content, name) for name in (key, f"{key}_low", f"{key}_high"))
    if value is None or low is None or high is None:
        return f"{_size(content, key)} m/s"
    return format_interval(value, low, high, "m/s")


def _row(label: str, text: str) -> str:
    return f"{label:<{_LABEL}}{text}"


def _format_head(summary: Summary) -> list[str]:
    log = mapping_in(summary, "log")
    seconds = float(cast("float", log.get("duration_s") or 0.0))
    distance = summary.get("distance_m")
    named = [(key, str(summary[key])) for key in ("vehicle", "terrain")]
    names = [f"{key} unknown" if name == "unknown" else name for key, name in named]
    facts = [
        # Simulated terrain may have no other name.
        *dict.fromkeys(["simulated", *names] if summary.get("simulated") else names),
        format_recorded(seconds, summary.get("duration_s")),
    ]
    if isinstance(distance, (int, float)):
        facts.append(format_distance(float(distance)))
    losses = cast("Sequence[Mapping[str, object]]", log.get("losses") or [])
    gaps = [f for f in objects_in(summary, "findings") if f["id"] == "pose_gap"]
    state = "log complete" if not losses else "log with losses"
    state += f" (unchecked: {log['unchecked']})" if log.get("unchecked") else ""
    # The verdict states an error without the mark of a finding.
    findings = read_findings(summary)
    state += ", a dead encoder" * has_dead_encoder(findings)
    errors = count_serious(findings).get("error")
    state += f", {errors}" if errors else ""
    if gaps:
        count, longest = cast("int", gaps[0]["count"]), number_in(gaps[0], "value")
        how_long = "" if longest is None else f" (longest {longest:.2g} s)"
        state += f", {count} gap{'s' if count != 1 else ''} in the poses{how_long}"
    head = [f"{summary['run']}    {' · '.join(facts)}    {state}"]
    for loss in losses[:_SHOWN]:
        start, end = number_in(loss, "start_s"), number_in(loss, "end_s")
        span = "" if start is None or end is None else f" ({start:.1f} to {end:.1f} s of the log)"
        head.append(_row("lost", f"{loss['text']}{span}"))
    return head


def _format_slip(summary: Summary, *, everything: bool) -> list[str]:
    by_input = mapping_in(summary, "by_input")

    named = f"median slip modulus (L = {_number(summary, 'length_scale_m')} m)"
    if has_no_pose(read_findings(summary)):
        named += " of the drivetrain, not of the ground,"
    medians = _format_medians(by_input, "median_modulus")
    if "vehicle_fitted" in summary and "measured" in by_input:
        medians += f" ({format_vehicle_source('fitted')})"
    standing = words.describe_standing(number_in(summary, "standing_share"))
    medians += f"    {standing}" if medians and standing else ""
    if not everything:
        return [_row("slip", f"{named} {medians}")] if medians else []
    shown = [name for name in INPUT_WORDS if name in by_input]
    norms = " | ".join(_number(mapping_in(by_input, name), "median_window_norm") for name in shown)
    lines = [
        _row("slip", f"{named} {medians}"),
        _row("", f"2 s window norm {norms} m/s"),
    ]
    split = mapping_in(summary, "split")
    detail = []
    if split:
        detail.append(format_split(**{name: float(cast("float", value)) for name, value in split.items()}))
    lead = mapping_in(by_input, str(summary.get("leading_input")))
    detail.append(
        f"transitory {_number(lead, 'transitory_median_modulus')} m/s | "
        f"steady {_number(lead, 'steady_median_modulus')} m/s"
    )
    lines.append(_row("", "    ".join(detail)))
    residual = "median_residual_modulus"
    residuals = {
        name: by_input[name] for name in shown if mapping_in(by_input, name).get(residual) is not None
    }
    if residuals:
        lines.append(_row("", f"with the model: {_format_medians(residuals, residual)}"))
    return lines


def _format_medians(by_input: Mapping[str, object], key: str) -> str:
    parts = (
        f"{_size_with_interval(mapping_in(by_input, name), key)} {words}"
        for name, words in INPUT_WORDS.items()
        if name in by_input
    )
    return "    ".join(parts)


def _format_topics(summary: Summary) -> list[str]:
    topics = mapping_in(summary, "topics")
    lines: list[str] = []
    if summary.get("vehicle_source") in _READ_FROM_LOG:
        source = format_vehicle_source(str(summary["vehicle_source"]))
        lines.append(_row("vehicle", f"{summary['vehicle_name']}    {source}"))
    roles = [role for role in ("command", "wheels", "pose", "imu", "interval") if mapping_in(topics, role)]
    if roles:
        chosen = ", ".join(f"{role} {mapping_in(topics, role)['topic']}" for role in roles)
        lines.append(_row("topics", f"{chosen} (why: slip inspect)"))
    others = mapping_in(mapping_in(summary, "choices"), "pose").get("others")
    rejected = others if isinstance(others, list) else []
    lines.extend(_row("", f"{'not':<9}{other['topic']}    {other['reason']}") for other in rejected)
    return lines


def _format_diagnosis(summary: Summary, *, everything: bool) -> list[str]:
    """Lines of the diagnosis, without the verdict and the findings, which are shown elsewhere."""
    stored = mapping_in(summary, "diagnosis")
    if not stored:
        return []
    described: list[str] = []
    part = ""
    for label, text in list_lines(read_result(stored, RunDiagnosis), everything=everything):
        part = label or part
        if part not in {words.VERDICT, "findings"}:
            described.append(_row(label, text))
    return described


def _format_end(summary: Summary, said: str, plan: str | None, *, unchanged: bool) -> list[str]:
    lines = []
    if unchanged:
        lines.append(
            _row("same", "nothing was computed: log and configuration are unchanged (--force computes anew)")
        )
    stored = mapping_in(summary, "diagnosis")
    name = shlex.quote(str(summary["run"]))
    if mapping_in(mapping_in(stored, "unexplained"), "with_formula"):
        lines.append(_row("next", f"slip serve {name}    add the suggested term there"))
    elif stored.get("effects"):
        lines.append(_row("next", f"slip diagnose {name}{said} --apply model.toml"))
    elif RunReport(summary).refusal:
        log = _relative(str(mapping_in(summary, "log").get("path") or "LOG"))
        lines.append(_row("next", f"slip inspect {shlex.quote(log)}"))
    if plan is not None:
        lines.append(_row("next", f"slip plan {name}{said}{plan}    the drive that tells what is undecided"))
    report = summary.get("report")
    if isinstance(report, str):
        lines.append(_row("report", _relative(report)))
    return lines


def _relative(path: str) -> str:
    try:
        return str(Path(path).resolve().relative_to(Path.cwd()))
    except ValueError:
        return path


_EVENTS_SHOWN = 5


def format_watch(look: Mapping[str, Any]) -> list[str]:
    """What is known of a recording that is being written, as lines of a screen: what is wrong first.

    Args:
        look: an object of `pipeline.live.follow`.
    """
    slip = ", ".join(f"{value:.3g} m/s {INPUT_WORDS[name]}" for name, value in look["slip"].items())
    errors = [math.nan if one is None else one for one in (look["error"] or {}).values()]
    rows = [
        ("watching", f"{look['log']}    {'closed' if look['closed'] else 'being written'}"),
        ("not yet", look["problem"]),
        *(("faults", text) for text in look["faults"]),
        ("so far", format_duration(look["t_s"])),
        ("vehicle", look["vehicle"]),
        ("slip", slip and f"{slip} (median)"),
        ("error", errors and f"{format_errors(*errors)} over 2 s with the model so far"),
        *_list_known(look["known"]),
        *(("events", f"{one['t_start']:.1f} s: {one['text']}") for one in look["events"][-_EVENTS_SHOWN:]),
        *(("drive", text) for text in look["drive_next"]),
        ("enough", "all effects are known within 5 %: no more driving is needed" * look["enough"]),
    ]
    shown = [(label, text) for label, text in rows if text]
    labels = ["", *(label for label, _ in shown)]
    return [
        _row("" if label == last else label, text) for last, (label, text) in zip(labels, shown, strict=False)
    ]


def _list_known(numbers: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Label and text of each number: those that are known, then those that the recording leaves open."""
    rows = []
    for one in sorted(numbers, key=lambda one: not one["is_known"]):
        text = "not determined"
        if one["low"] is not None and one["high"] is not None:
            text = format_interval(one["value"], one["low"], one["high"], one["unit"])
            text = text if one["is_known"] else f"not yet known: {text}"
        label = "known" if one["is_known"] else "open"
        rows.append((label, f"{one['effect']}: {one['parameter']} {text}"))
    return rows
