"""`slip inspect`: what a log holds, how healthy it is, and which topics would serve."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from pipeline.cli.choices import Choices, build_options
from pipeline.cli.output import CLEAN, LOSSY, print_result
from pipeline.core.durations import say_duration

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.analysis.inspection import Inspection, TopicHealth
    from pipeline.stages.extract.choice import PoseRating

_OTHER_CLOCK_S = 3600.0
"""Stamps further from the log time are of another clock: simulated time, time since boot, time never set."""
_LOSS = ("kind", "bytes", "chunks", "start_ns", "end_ns", "text")
_ROLES = ("command", "wheels", "pose", "imu", "interval")


def inspect(  # noqa: D417 - the shared choices document themselves
    log: Annotated[Path, Parameter(help="a log, MCAP file or folder of a split recording")],
    /,
    *,
    choices: Annotated[Choices, Parameter(name="*")] = Choices(),  # noqa: B008 - frozen
    json: bool = False,
) -> int:
    """Show topics, rates, gaps, clocks and damage of a log, and which topics would serve, and why.

    Args:
        json: print one JSON object.
    """
    from pipeline.analysis.inspection import inspect_log  # noqa: PLC0415 - heavy

    options = build_options(choices)
    seen = inspect_log(
        log, config=options.config, overrides=options.overrides, max_inflated=options.max_inflated
    )
    print_result(_as_json(seen), lambda: _describe(seen), json=json)
    return LOSSY if seen.losses else CLEAN


def _as_json(seen: Inspection) -> dict[str, object]:
    index, sources = seen.index, seen.sources
    return {
        "path": str(index.path),
        "bytes": index.size_bytes,
        "profile": index.profile,
        "library": index.library,
        "duration_s": index.duration_s,
        "messages": index.message_count,
        "chunks": index.chunk_count,
        "compressions": list(index.compressions),
        "complete": not seen.losses,
        "losses": [{name: getattr(loss, name) for name in _LOSS} for loss in seen.losses],
        "unchecked": seen.unchecked or None,
        "notes": list(seen.notes),
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
        "problem": seen.problem or None,
    }


def _describe(seen: Inspection) -> list[str]:
    from pipeline.logs import shorten  # noqa: PLC0415 - heavy

    index = seen.index
    packing = "compression " + (", ".join(name or "none" for name in index.compressions) or "none")
    lines = [
        f"log       {index.path}",
        f"          {index.size_bytes / 1e6:.1f} MB, {say_duration(index.duration_s)}, {packing}",
        f"          {index.message_count} messages in {index.chunk_count} chunks",
        f"          profile {index.profile or '-'}, written by {index.library or '-'}",
        f"health    {'complete' if not seen.losses else 'with losses'}"
        + (f", unchecked: {seen.unchecked}" if seen.unchecked else ""),
    ]
    lines += [f"  lost    {loss.text}" for loss in seen.losses]
    lines += [f"  note    {note}" for note in seen.notes]
    for name, record in index.metadata.items():
        lines.append(
            f"metadata  {name}: " + ", ".join(f"{key} = {shorten(value)}" for key, value in record.items())
        )
    lines += ["", *_describe_topics(seen.topics), ""]
    lines.append(f"vehicle   {seen.vehicle.name if seen.vehicle else 'unknown'}")
    if seen.choice is not None and seen.vehicle is not None:
        gear = ", on tracks" if seen.vehicle.running_gear == "tracks" else ""
        lines[-1] += f"{gear}    told by: {seen.choice.vehicle_source.replace('_', ' ')}"
    if seen.sources is not None:
        for role in _ROLES:
            source = getattr(seen.sources, role)
            lines.append(f"{role:<10}{f'{source}    {source.reason}' if source else '-'}")
        lines += [f"          {note}" for note in seen.sources.notes if not note.startswith("pose")]
    if seen.choice is not None:
        lines += _describe_ratings(seen.choice.ratings)
        lines += [f"note      {finding.text}" for finding in seen.choice.findings]
    if seen.problem:
        lines.append(f"problem   {seen.problem}")
    return lines


def _describe_ratings(ratings: Sequence[PoseRating]) -> list[str]:
    """What every candidate for the pose is worth, the chosen one first."""
    if not ratings:
        return []
    rows = [("pose candidates", "frames", "new Hz", "of time", "not wheels'", "verdict")]
    for rating in ratings:
        share = "-" if rating.beside_wheels is None else f"{rating.beside_wheels:.1%}"
        frames = f"{rating.parent or '?'} -> {rating.child or '?'}"
        numbers = (f"{rating.rate_hz:.3g}", f"{rating.coverage:.0%}", share)
        rows.append((str(rating.source), frames, *numbers, rating.refused or rating.reason))
    widths = [max(len(row[column]) for row in rows) for column in range(5)]
    return [
        "",
        *(
            "  ".join([*(f"{cell:<{w}}" for cell, w in zip(row, widths, strict=False)), row[5]])
            for row in rows
        ),
    ]


def _describe_topics(topics: Sequence[TopicHealth]) -> list[str]:
    width = max([len(topic.topic) for topic in topics] + [5])
    numbers = f"{'messages':>8}  {'Hz':>7}  {'gaps':>5}  {'longest':>8}  {'late':>11}"
    head = f"{'topic':<{width}}  {numbers}  type"
    return [head, *(_describe_topic(topic, width) for topic in topics)]


def _describe_topic(topic: TopicHealth, width: int) -> str:
    rate = "-" if topic.rate_hz is None else f"{topic.rate_hz:.4g}"
    gap = "-" if topic.largest_gap_s is None else f"{topic.largest_gap_s:.3g} s"
    late = "-" if topic.latency_s is None else f"{topic.latency_s * 1e3:.0f} ms"
    if topic.latency_s is not None and abs(topic.latency_s) > _OTHER_CLOCK_S:
        late = "other clock"
    return (
        f"{topic.topic:<{width}}  {topic.messages:>8}  {rate:>7}  "
        f"{topic.gaps:>5}  {gap:>8}  {late:>11}  {topic.type_name}"
    )
