"""Command on a log that is being written: watch."""

from __future__ import annotations

import contextlib
import io
import json as json_format
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

from cyclopts import Parameter
from cyclopts.types import PositiveFloat

from pipeline.cli.conventions import Choices, build_options, print_lines, print_note, spell_choices
from pipeline.core import INPUT_WORDS, SlipError, format_duration, format_share, naming_os_errors, suffix_unit

if TYPE_CHECKING:
    from pipeline.job.watch import Watch

    Content = Mapping[str, object]

_QUIET_S = 30.0
_EVENTS_SHOWN = 5
_CLEAR = "\x1b[H\x1b[2J"
"""Escape sequence that moves the cursor to the top left corner and clears the screen."""


def watch(  # noqa: D417 - the shared choices document themselves
    log: Annotated[
        Path,
        Parameter(
            help="MCAP file that is being recorded, the folder it is written to, or the address of a server: "
            "ws://127.0.0.1:8765"
        ),
    ],
    /,
    *,
    choices: Annotated[Choices, Parameter(name="*")] = Choices(),  # noqa: B008 - frozen
    quiet_for: Annotated[
        PositiveFloat, Parameter(name="--for", help="end after this many seconds without new data")
    ] = _QUIET_S,
    page: Annotated[
        Path | None, Parameter(help="also write a page to this file, which reloads itself in a browser")
    ] = None,
    topic: Annotated[
        list[str] | None,
        Parameter(
            negative=(), help="of a server: record this topic, NAME or NAME=TYPE; can be given several times"
        ),
    ] = None,
    record: Annotated[
        Path | None, Parameter(help="of a server: folder of the recording; by default named by port and time")
    ] = None,
    json: bool = False,
) -> int:
    """Diagnose a recording while it is written.

    Ends when the log is closed, or on Ctrl-C, with the diagnosis of the finished log. An address is that of a
    Foxglove WebSocket or rosbridge server on this machine, whose messages are recorded.

    Args:
        json: print one JSON object a line instead of the screen.
    """
    from pipeline.job.running_log import parse_address, receive_live  # noqa: PLC0415 - heavy
    from pipeline.job.watch import Watch, choose_recording, write_statement  # noqa: PLC0415 - heavy

    options = build_options(choices)
    address = parse_address(str(log))
    with contextlib.ExitStack() as receiving:
        live = None
        if address is not None:
            live = receiving.enter_context(receive_live(address, record, topic or [], quiet_for))
        path = choose_recording(log) if live is None else live.path
        arguments = shlex.split(spell_choices(_without_results(choices)))
        watched = Watch(path, options, arguments, quiet_for, live)
        is_screen = sys.stdout.isatty() and not json
        stopped = False
        try:
            for seen in watched.follow():
                _show(seen, page, json=json, is_screen=is_screen)
                write_statement(choices.results, path, list_statements(seen))
        except KeyboardInterrupt:
            stopped = True
            print_note("slip: stopped watching; this is the diagnosis of the log so far")
    if watched.live.problem and not watched.live.slip_mps:
        print_note(f"slip: no slip was seen: {watched.live.problem}")
    return _conclude(watched, choices, page, json=json, stopped=stopped)


def _without_results(choices: Choices) -> Choices:
    """The choices for a diagnosis of the log so far, which has its own results folder."""
    return replace(choices, results=Choices().results)


def _show(seen: Content, page: Path | None, *, json: bool, is_screen: bool) -> None:
    """Show the current state: a JSON line, the redrawn screen, or lines; and the page."""
    lines = format_watch(seen)
    if json:
        sys.stdout.write(json_format.dumps({"kind": "look", **seen}, allow_nan=False) + "\n")
    else:
        sys.stdout.write(_CLEAR if is_screen else "")
        print_lines(lines if is_screen else [*lines, ""])
    sys.stdout.flush()
    if page is not None:
        _write_page(page, lines, is_live=True)


def _write_page(page: Path, lines: Sequence[str], *, is_live: bool) -> None:
    from pipeline.report import render_template  # noqa: PLC0415 - heavy
    from pipeline.store.files import replace_file  # noqa: PLC0415 - heavy

    text = render_template("report/templates/watch.html", lines=lines, is_live=is_live)
    hint = "Check the folder and its permissions."
    with naming_os_errors(SlipError, "page_unwritable", "the page cannot be written", where=page, hint=hint):
        replace_file(page, text.encode())


def _conclude(watched: Watch, choices: Choices, page: Path | None, *, json: bool, stopped: bool) -> int:
    """Diagnose the whole log with the command `slip diagnose`."""
    from pipeline.cli.verbs_effects import diagnose  # noqa: PLC0415 - heavy
    from pipeline.job.watch import write_statement  # noqa: PLC0415 - heavy

    taken = io.StringIO()
    with contextlib.redirect_stdout(taken):
        code = diagnose([str(watched.path)], choices=choices, json=json, quiet=False)
    text = taken.getvalue()
    if json:
        answer = cast("dict[str, object]", json_format.loads(text))
        sys.stdout.write(json_format.dumps({"kind": "final", "stopped": stopped, **answer}) + "\n")
    else:
        sys.stdout.write(text)
    if page is not None:
        _write_page(page, text.splitlines(), is_live=False)
    rows = list_statements(watched.to_json()) if json else [("", line) for line in text.splitlines()]
    write_statement(choices.results, watched.path, rows, ended=True)
    if not stopped:
        watched.forget()
    return code


def format_watch(seen: Content) -> list[str]:
    """What is known of a log that is being written, as lines of a screen.

    Args:
        seen: the object of `Watch.to_json`.
    """
    lines, last = [], ""
    for label, text in list_statements(seen):
        lines.append(f"{'' if label == last else label:<10}{text}")
        last = label
    return lines


def list_statements(seen: Content) -> list[tuple[str, str]]:
    """What is known of a log that is being written: a label and a text each, for screen and page.

    Args:
        seen: the object of `Watch.to_json`.
    """
    knowledge = cast("Content", seen["knowledge"])
    state = "closed" if seen["closed"] else "being written"
    size = cast("float", seen["bytes"]) / 1e6
    duration, distance = cast("float", seen["duration_s"]), cast("float", seen["distance_m"])
    rows = [
        ("watching", f"{seen['log']}    {state}"),
        ("server", str(seen.get("source") or "")),
        ("so far", f"{format_duration(duration)}, {distance:.0f} m, {size:.1f} MB"),
        ("slip", _format_medians(cast("Mapping[str, float]", seen["slip_mps"]), "over the last 10 s")),
        ("error", _format_error(seen)),
    ]
    events = cast("Sequence[Content]", seen["events"])
    rows += [
        ("events", f"{event['t_start']:.1f} to {event['t_end']:.1f} s: {event['text']}")
        for event in events[-_EVENTS_SHOWN:]
    ]
    rows += _format_knowledge(knowledge)
    if seen["problem"]:
        rows.append(("not yet", str(seen["problem"])))
    if not seen["closed"]:
        rows.append(("looked", _format_looks(seen, knowledge)))
    return [(label, text) for label, text in rows if text]


def _format_medians(medians: Mapping[str, float], when: str) -> str:
    parts = [f"{value:.3g} m/s {INPUT_WORDS.get(name, name)}" for name, value in medians.items()]
    return f"{', '.join(parts)} {when}" if parts else ""


def _format_error(seen: Content) -> str:
    """Error of the last model, held out over the log and in the last seconds."""
    error = cast("Content", seen["knowledge"]).get("error")
    now = _format_medians(cast("Mapping[str, float]", seen["error_mps"]), "now")
    return "; ".join(filter(None, [f"{error} over 2 s with the model so far" if error else "", now]))


def _format_knowledge(knowledge: Content) -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for stated in cast("Sequence[Content]", knowledge.get("stated") or []):
        numbers = cast("Mapping[str, Content]", stated["parameters"])
        known = ", ".join(f"{name} {_format_number(one)}" for name, one in numbers.items())
        rows.append(("known", f"{stated['effect']}: {known}"))
    waiting = cast("Sequence[str]", knowledge.get("waiting") or [])
    if waiting:
        rows.append(("not yet", f"to be confirmed by more driving: {', '.join(waiting)}"))
    rows += [
        ("not yet", f"undecided: {' or '.join(one)}")
        for one in cast("Sequence[Sequence[str]]", knowledge.get("undecided") or [])
    ]
    if knowledge.get("enough"):
        return [*rows, ("enough", "all effects are known to 5 %: no more driving is needed")]
    if knowledge.get("data"):
        rows.append(("data", str(knowledge["data"])))
    rows += [("drive", one) for one in cast("Sequence[str]", knowledge.get("drive") or [])]
    if knowledge.get("problem"):
        rows.append(("not yet", str(knowledge["problem"])))
    return rows


def _format_number(number: Content) -> str:
    value, low, high, share = (cast("float | None", number[key]) for key in ("value", "low", "high", "share"))
    if value is None or low is None or high is None or share is None:
        return "not determined"
    unit = suffix_unit(number["unit"])
    return f"{value:.3g}{unit} [{low:.3g}, {high:.3g}] (known to {format_share(share)})"


def _format_looks(seen: Content, knowledge: Content) -> str:
    until = cast("float | None", knowledge.get("until_s"))
    parts = [f"diagnosed up to {format_duration(until)}" if until else "not diagnosed yet"]
    parts += ["diagnosing now"] if seen["diagnosing"] else []
    return f"{', '.join(parts)}; CPU {format_share(cast('float', seen['cpu_share']))} of a core"
