"""Commands on one log: analyze, inspect, results stage; and watch, on one that is being written."""

from __future__ import annotations

import json as json_format
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter
from cyclopts.types import PositiveFloat

from pipeline import api, models, store, words
from pipeline.cli.conventions import (
    CLEAN,
    LOSSY,
    All,
    Asked,
    Choices,
    OwnEffects,
    build_options,
    exit_code,
    format_vehicle_source,
    print_json,
    print_lines,
    print_note,
    print_result,
    show_progress,
    spell_choices,
)
from pipeline.core import (
    LONGEST_NAME,
    FigureFormat,
    SlipError,
    align_rows,
    format_count,
    format_duration,
    format_section,
    format_share,
    format_size,
    mapping_in,
    name_first,
    name_install,
    shorten,
)

if TYPE_CHECKING:
    from pipeline.analysis.analyze import Outcome
    from pipeline.recording import PoseRating, Recording
    from pipeline.recording.inspection import Inspection, TopicHealth

    Content = Mapping[str, object]


def analyze(  # noqa: D417 - the shared choices document themselves
    logs: Annotated[
        list[Path],
        Parameter(
            help="MCAP files, or folders of split recordings; write -- before names that begin with a dash"
        ),
    ],
    /,
    *,
    choices: Annotated[Choices, Parameter(name="*")] = Choices(),  # noqa: B008 - frozen
    diagnosis: Annotated[bool, Parameter(negative="--no-diagnosis")] = True,
    report: Annotated[bool, Parameter(negative="--no-report")] = True,
    figures: FigureFormat | None = None,
    model: Path | None = None,
    effects: OwnEffects = None,
    force: bool = False,
    asked: Asked,
    everything: All = False,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Analyze logs: slip per time step, its causes, a summary, a report.

    Args:
        diagnosis: identify the effects that the model lacks.
        report: write report.html.
        model: a model file to compute slip relative to as well.
        figures: also write the figures in this format, for papers.
        force: compute again what is already there.
        everything: show all of the summary: where the error is, budget, limits, topics.
        json: print one JSON object instead of the summary.
        quiet: print no progress and no summary.
    """
    if effects:
        models.load_effects(effects)
    effects_wanted, report_wanted = diagnosis, report
    diagnosis &= find_spec("numba") is not None
    report &= find_spec("vl_convert") is not None
    absent = ["the effects (Numba)"] * (effects_wanted and not diagnosis)
    absent += ["the report (vl-convert)"] * (report_wanted and not report)
    if absent:
        print_note(f"slip: left out, not installed: {' and '.join(absent)}; to have it: {name_install()}")
    options = replace(build_options(choices), report=report, diagnosis=diagnosis, figures=figures)
    options = replace(options, force=force, model=model)
    outcomes: list[Outcome] = []
    asked.list_runs = lambda: [
        {**one.summary, "same_content_as": one.twin or None, "replaced": one.replaced or None}
        for one in outcomes
    ]
    if report:
        from pipeline.report.theme import warm_bundle  # noqa: PLC0415 - only for reports

        # In the background, while the log is read.
        warm_bundle()
    from pipeline.analysis.analyze import analyze_log, update_datasets  # noqa: PLC0415 - heavy

    for log in logs:
        with asked.attempt(str(log)), show_progress(log.name, quiet=quiet or json) as progress:
            outcomes.append(analyze_log(log, options, progress))
    if any(outcome.computed for outcome in outcomes):
        update_datasets(store.Store(options.out))
    if json:
        print_json(asked.to_json())
    elif not quiet:
        from pipeline.cli.screen import format_run  # noqa: PLC0415 - only for people

        said = spell_choices(choices)
        for one in outcomes:
            is_same = not one.computed
            is_open = bool(mapping_in(one.summary, "diagnosis").get("undecided"))
            plan = api.suggest_plan(str(one.summary["run"]), options) if is_open else None
            text = format_run(
                one.summary,
                unchanged=is_same,
                twin=one.twin,
                replaced=one.replaced,
                said=said,
                plan=plan,
                everything=everything,
            )
            print_lines(text.splitlines())
    return exit_code(asked.errors, lossy=any(outcome.lossy or outcome.refusal for outcome in outcomes))


_OTHER_CLOCK_S = 3600.0
"""Largest offset of stamps of the same clock as log time [s]; others are simulated, since boot, or unset."""
_LOSS = ("kind", "bytes", "chunks", "start_ns", "end_ns", "text")
_ROLES = ("command", "wheels", "pose", "imu", "interval")


def inspect(  # noqa: D417 - the shared choices document themselves
    log: Annotated[Path, Parameter(help="a log, MCAP file or folder of a split recording")],
    /,
    *,
    choices: Annotated[Choices, Parameter(name="*")] = Choices(),  # noqa: B008 - frozen
    everything: All = False,
    json: bool = False,
) -> int:
    """Show topics, rates, gaps, clocks and damage of a log.

    Shows which topics are used, and why; or why the log cannot be analyzed.

    Args:
        everything: show all topics, notes and metadata, and how the motion follows each signal.
        json: print one JSON object.
    """
    from pipeline.recording.inspection import inspect_log  # noqa: PLC0415 - heavy

    seen = inspect_log(log, build_options(choices))
    print_result(_log_as_json(seen), lambda: _format_log(seen, everything=everything), json=json)
    return LOSSY if seen.losses or seen.problem else CLEAN


def _log_as_json(seen: Inspection) -> dict[str, object]:
    index, sources = seen.index, seen.sources
    return {
        "path": str(index.path),
        "bytes": index.size_bytes,
        "profile": index.profile,
        "library": index.library,
        "duration_s": seen.duration_s,
        "messages": seen.messages,
        "messages_stated": index.message_count,
        "chunks": index.chunk_count,
        "compressions": list(index.compressions),
        "complete": not seen.losses,
        "losses": [{name: getattr(loss, name) for name in _LOSS} for loss in seen.losses],
        "unchecked": seen.unchecked or None,
        "notes": list(map(words.format_finding, seen.notes)),
        "metadata": {name: dict(record) for name, record in index.metadata.items()},
        "topics": [vars(topic) for topic in seen.topics],
        "vehicle": seen.vehicle.id if seen.vehicle else None,
        "running_gear": seen.vehicle.running_gear if seen.vehicle else None,
        "roles": {
            role: None
            if sources is None or (source := getattr(sources, role)) is None
            else {"topic": str(source), "reason": source.reason}
            for role in _ROLES
        },
        **(
            seen.choice.to_json({topic.topic: topic.type_name for topic in seen.topics})
            if seen.choice
            else {}
        ),
        "problem": None if seen.problem is None else str(seen.problem),
    }


_MOST_NOTES = 3
"""Losses, and notes, that are shown by default: the others are counted."""
_MOST_TOPICS = 10
"""Topics up to which all are shown by default: of more, those that are used."""
_MOST_ENTRIES = 100
"""Entries up to which all of a metadata record are shown."""


def _format_log(seen: Inspection, *, everything: bool) -> list[str]:
    index = seen.index
    size = f"{format_size(index.size_bytes)}, {format_duration(seen.duration_s)}"
    packing = "compression " + (name_first([name or "none" for name in index.compressions]) or "none")
    lines = [f"log       {index.path}{'' if everything else f'    {size}'}"]
    if everything:
        lines += [
            f"          {size}, {packing}",
            f"          {_format_count(seen)}",
            f"          profile {index.profile or '-'}, written by {index.library or '-'}",
        ]
    unchecked = f", unchecked: {seen.unchecked}" if seen.unchecked else ""
    noticed = () if seen.choice is None else seen.choice.findings
    dead = ", with a dead encoder" * words.has_dead_encoder(noticed)
    lines.append(f"health    {'complete' if not seen.losses else 'with losses'}{dead}{unchecked}")
    lines += _cut([f"  lost    {loss.text}" for loss in seen.losses], everything=everything)
    lines += _cut([f"  note    {words.format_finding(note)}" for note in seen.notes], everything=everything)
    if everything:
        for name, record in index.metadata.items():
            texts = [f"{key} = {' '.join(value.split())}" for key, value in record.items()]
            lines.append(f"metadata  {shorten(name, LONGEST_NAME)}: {name_first(texts, _MOST_ENTRIES)}")
    # Of a log that cannot be analyzed any topic may tell why.
    lines += ["", *_format_topics(seen, everything=everything or seen.problem is not None), ""]
    lines.append(f"vehicle   {seen.vehicle.name if seen.vehicle else 'unknown'}")
    if seen.choice is not None and seen.vehicle is not None:
        gear = ", on tracks" if seen.vehicle.running_gear == "tracks" else ""
        lines[-1] += f"{gear}    {format_vehicle_source(seen.choice.vehicle_source)}"
        fitted = seen.choice.list_fitted()
        lines += [f"          in run.toml: {format_section('vehicle', fitted)}"] if fitted else []
    lines += _format_roles(seen, everything=everything)
    notes = []
    if seen.sources is not None:
        notes += [f"choice    {note}" for note in seen.sources.notes if not note.startswith("pose")]
    if seen.choice is not None:
        if everything:
            lines += _format_ratings(seen.choice.ratings)
            lines += _format_evidence(seen.choice.recording)
        findings = sorted(seen.choice.findings, key=lambda one: one.severity == "info")
        notes += [f"note      {words.format_finding(finding)}" for finding in findings]
    lines += _cut(notes, everything=everything)
    if seen.problem:
        why = f"{seen.problem.what}. {seen.problem.hint.rstrip('.')}."
        lines.append(f"problem   the log cannot be analyzed: {why}")
    return lines


def _cut(lines: Sequence[str], *, everything: bool) -> list[str]:
    """The first lines of a list, and how many more it has."""
    if everything or len(lines) <= _MOST_NOTES:
        return list(lines)
    return [*lines[:_MOST_NOTES], f"          {len(lines) - _MOST_NOTES} more (--all)"]


def _format_roles(seen: Inspection, *, everything: bool) -> list[str]:
    """What each role is read from, and why."""
    lines = []
    for role in _ROLES if seen.sources else ():
        if source := getattr(seen.sources, role):
            lines.append(f"{role:<10}{source}    {source.reason}")
        elif role != "interval":
            lines.append(f"{role:<10}none")
        elif everything:
            lines.append(f"{role:<10}none: the whole log counts")
        others = len(seen.choice.ratings) - 1 if seen.choice else 0
        if role == "pose" and others > 0 and not everything:
            lines.append(f"          {format_count(others, 'other pose')} (--all)")
    return lines


def _format_count(seen: Inspection) -> str:
    """Number of messages that can be read, of how many where some cannot, and in how many chunks."""
    stated, chunks = seen.index.message_count, seen.index.chunk_count
    some = f" of {stated}" if seen.messages < stated else ""
    parts = f" in {format_count(chunks, 'chunk')}" if chunks else ""
    return f"{seen.messages}{some} messages{parts}"


def _format_ratings(ratings: Sequence[PoseRating]) -> list[str]:
    """Table of the ratings of the pose candidates, the chosen one first."""
    if not ratings:
        return []
    rows = [("pose candidates", "frames", "Hz", "coverage", "off wheels", "reason")]
    for rating in ratings:
        share = "-" if rating.beside_wheels is None else format_share(rating.beside_wheels)
        frames = f"{rating.parent or '?'} -> {rating.child or '?'}"
        numbers = (f"{rating.rate_hz:.3g}", format_share(rating.coverage, 0), share)
        rows.append((str(rating.source), frames, *numbers, rating.refusal or rating.reason))
    return ["", *align_rows(rows)]


def _format_evidence(recording: Recording | None) -> list[str]:
    """Table of the signals, and how the motion of the pose follows each."""
    if recording is None or not recording.evidence:
        return []
    rows = [("signals", "used as", "z", "ahead x", "turning x", "late", "")]
    for one in recording.evidence:
        used = (one.name, one.role or "not used")
        if one.margin is None:
            rows.append((*used, "-", "-", "-", "-", one.reason))
            continue
        gains = (f"{one.ahead:.4g}" if one.ahead else "-", f"{one.turned:.4g}" if one.turned else "-")
        rows.append((*used, f"{one.margin:.1f}", *gains, f"{one.late_s:.2f} s", one.reason))
    follows = "          z: how certain it is that the motion follows the signal, above 3 it is clear"
    about = f"{follows}; x: motion over signal"
    return ["", *align_rows(rows), about]


def _format_topics(seen: Inspection, *, everything: bool) -> list[str]:
    """Table of the topics, of many by default those that are used."""
    used = set() if seen.sources is None else seen.sources.topics
    everything |= len(seen.topics) <= _MOST_TOPICS
    shown = [one for one in seen.topics if everything or one.topic in used]
    others = len(seen.topics) - len(shown)
    width = max([len(topic.topic) for topic in shown] + [5])
    numbers = f"{'messages':>8}  {'Hz':>7}  {'gaps':>5}  {'longest':>8}  {'latency':>11}"
    head = f"{'topic':<{width}}  {numbers}  type"
    rows = [head, *(_format_topic(topic, width) for topic in shown)]
    return [*rows, f"{format_count(others, 'other topic')} (--all)"] if others else rows


def _format_topic(topic: TopicHealth, width: int) -> str:
    rate = "-" if topic.rate_hz is None else f"{topic.rate_hz:.4g}"
    gap = "-" if topic.largest_gap_s is None else f"{topic.largest_gap_s:.3g} s"
    late = "-" if topic.latency_s is None else f"{topic.latency_s * 1e3:.0f} ms"
    if topic.latency_s is not None and abs(topic.latency_s) > _OTHER_CLOCK_S:
        late = "other clock"
    return (
        f"{topic.topic:<{width}}  {topic.messages:>8}  {rate:>7}  "
        f"{topic.gaps:>5}  {gap:>8}  {late:>11}  {topic.type_name}"
    )


def stage(  # noqa: D417 - the shared choices document themselves
    name: Literal["extract", "velocity", "slip", "aggregate"],
    log: Annotated[str, Parameter(help="a log, or the name of a run that has results")],
    /,
    *,
    choices: Annotated[Choices, Parameter(name="*")] = Choices(),  # noqa: B008 - frozen
    force: bool = False,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Run one stage of a log.

    Stages before it are reused where nothing changed.

    Args:
        name: the stage.
        force: compute again what is already there.
        json: print one JSON object.
        quiet: print nothing.
    """
    from pipeline.analysis.analyze import analyze_log  # noqa: PLC0415 - heavy

    options = replace(build_options(choices), force=force, through=name)
    path = store.find_log(log, options.out)
    with show_progress(path.name, quiet=quiet or json) as progress:
        outcome = analyze_log(path, options, progress)
    tables = {table: entry.rows for table, entry in sorted(outcome.manifest.tables.items())}
    content = {"run": outcome.manifest.run, "computed": list(outcome.computed), "rows": tables}
    done = ", ".join(outcome.computed) or "nothing: all files are up to date"
    lines = [f"run       {outcome.manifest.run}", f"computed  {done}"]
    lines += [f"  {table:<12}{rows:>9} rows" for table, rows in tables.items()]
    lines += [f"replaced  earlier results, {outcome.replaced}"] if outcome.replaced else []
    print_result(content, lambda: [*lines, f"in        {outcome.manifest.folder}"], json=json, quiet=quiet)
    return LOSSY if outcome.lossy else CLEAN


_CLEAR = "\x1b[H\x1b[2J"
"""Escape sequence that moves the cursor to the top left corner and clears the screen."""


def watch(  # noqa: D417 - the shared choices document themselves
    log: Annotated[Path, Parameter(help="MCAP file that is being recorded, or the folder it is written to")],
    /,
    *,
    choices: Annotated[Choices, Parameter(name="*")] = Choices(),  # noqa: B008 - frozen
    every: PositiveFloat = 10.0,
    quiet_for: Annotated[PositiveFloat, Parameter(name="--for")] = 30.0,
    json: bool = False,
) -> int:
    """Analyze a recording again and again while it is written.

    Shows what is known so far, and what to drive for the rest, until the recording is closed or Ctrl-C.

    Args:
        every: shortest time from one look to the next [s]; a look takes a third of a core at most.
        quiet_for: end after this many seconds without new data.
        json: print one JSON object a line instead of the screen.
    """
    from pipeline.cli.screen import format_watch  # noqa: PLC0415 - heavy
    from pipeline.live import choose_recording, follow  # noqa: PLC0415 - heavy

    path, problem = choose_recording(log), ""
    try:
        for look in follow(path, shlex.split(spell_choices(choices)), every_s=every, quiet_s=quiet_for):
            problem = look["problem"]
            if json:
                sys.stdout.write(json_format.dumps(look, allow_nan=False) + "\n")
            else:
                sys.stdout.write(_CLEAR if sys.stdout.isatty() else "")
                print_lines([*format_watch(look), ""])
            sys.stdout.flush()
    except KeyboardInterrupt:
        print_note("slip: stopped; the recording goes on")
        return CLEAN
    if problem:
        raise SlipError("nothing_known", problem, where=str(path), hint="See `slip inspect` of it")
    print_note(f"slip: the recording has ended; slip analyze {shlex.quote(str(path))} makes its report")
    return CLEAN
