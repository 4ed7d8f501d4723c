"""Faults and effects injected into the real recordings: recovered, told as the fault it is, or missed.

Run: python benchmarks/inject.py [--logs WORD ...] [--only WORD ...] [--out FILE [--resume]]. Every recording
under ../shared/logs that moves, with every change of `injections.py`. A number is recovered where what was
injected, put on top of what the unchanged recording says, lies within the two intervals together. An answer
is the same where the names are, and the numbers within the same measure.
Exit code 0; the table says what was missed.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

from injections import Drive, Injection, list_injections
from json_lines import add_row, read_rows

from pipeline.analysis.analyze import analyze_log
from pipeline.analysis.diagnosis import read_recording
from pipeline.analysis.options import Options
from pipeline.core.errors import SlipError
from pipeline.diagnosis import diagnose_runs
from pipeline.models import find_effect
from pipeline.stages.extract import extract_tables

if TYPE_CHECKING:
    from pipeline.logs import LogData
    from pipeline.stages.extract import Extracted
    from pipeline.vehicles import Vehicle
    from pipeline.vehicles.configuration import Configuration
    from pipeline.vehicles.sources import Sources

LOGS = Path(__file__).parents[2] / "shared" / "logs"
STANDING = ("husky_wheels_avide2", "husky_wheels_plank")
_SURE = 1.96
_VERDICTS = ("recovered", "told", "undecided", "cannot", "missed")
Json = dict[str, Any]


@dataclass(frozen=True)
class Answer:
    """What was said of a recording: names with numbers (value, half-width), findings, what it left open.

    Numbers of effects that were not named stand in `estimates`.
    """

    numbers: Mapping[str, tuple[float, float]]
    findings: tuple[str, ...]
    undecided: tuple[str, ...]
    unobservable: tuple[str, ...]
    estimates: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def names(self) -> set[str]:
        """Ids of the effects."""
        return {label.split(".")[0] for label in self.numbers}


def ask(log: Path, injection: Injection, *, both: bool) -> Answer:
    """Analyze and diagnose a recording with a change."""

    def changed(
        data: LogData, sources: Sources, configuration: Configuration, vehicle: Vehicle, *, where: str
    ) -> Extracted:
        made = extract_tables(data, sources, configuration, vehicle, where=where)
        drive = Drive(vehicle.wheel_radius_m, vehicle.track_width_m or math.nan)
        return replace(made, tables=dict(injection.change(made.tables, drive)))

    with tempfile.TemporaryDirectory() as folder, patch("pipeline.analysis.work.extract_tables", changed):
        manifest = analyze_log(log, Options(out=Path(folder), report=False)).manifest
        vehicle, recording = read_recording(manifest)
        findings = tuple(str(finding["id"]) for finding in recording.list_findings())
        inputs = ("command", "measured") if both else ("measured",)
        told = diagnose_runs([recording], vehicle, inputs=inputs).runs[0]
    numbers = {
        f"{effect.id}.{name}": (value.value, 0.5 * (value.high - value.low))
        for effect in told.effects
        for name, value in effect.parameters.items()
    }
    undecided = tuple(name for item in told.undecided for name in item.candidates)
    more = tuple(str(finding["id"]) for finding in told.findings)
    unobservable = tuple(item.id for item in told.unobservable)
    estimates = {
        f"{one.effect}.{one.parameter}": (one.value, _SURE * one.standard_error)
        for one in told.estimates
        if one.input == "measured"
    }
    return Answer(numbers, tuple(dict.fromkeys((*findings, *more))), undecided, unobservable, estimates)


def judge(
    injection: Injection, before: Answer, after: Answer, usual: AbstractSet[str] = frozenset()
) -> tuple[str, list[str]]:
    """One of `_VERDICTS`, and names without a reason: `usual` are those of the vehicle's unchanged logs."""
    if set(injection.findings) & set(after.findings) - set(before.findings):
        return "told", []
    effects = {label.split(".")[0] for label in injection.numbers}
    extra = sorted(after.names - usual - effects)
    if injection.same:
        close = all(is_close(before.numbers[label], after.numbers[label]) for label in shared(before, after))
        lost = before.names - after.names - set(after.undecided)
        return ("recovered" if close and not lost else "missed"), extra
    for effect in effects:
        labels = [label for label in injection.numbers if label.split(".")[0] == effect]
        if all(is_recovered(injection, label, before, after) for label in labels):
            return "recovered", extra
    named = effects & after.names
    if named:
        return "missed", extra
    return (
        "undecided" if effects & set(after.undecided)
        else "cannot" if effects & set(after.unobservable)
        else "missed"
    ), extra  # fmt: skip


def is_recovered(injection: Injection, label: str, before: Answer, after: Answer) -> bool:
    """Whether a number is what was injected on top of that of the unchanged recording."""
    effect, parameter = label.split(".")
    neutral = (find_effect(effect)().parameter(parameter).neutral, 0.0)
    start = before.numbers.get(label) or before.estimates.get(label, neutral)
    expected = (injection.numbers[label](start[0]), start[1])
    return label in after.numbers and is_close(expected, after.numbers[label])


def shared(before: Answer, after: Answer) -> list[str]:
    """Labels of numbers that both answers have with an interval."""
    return [
        label
        for label, (_, half) in before.numbers.items()
        if label in after.numbers and math.isfinite(half + after.numbers[label][1])
    ]


def is_close(one: tuple[float, float], other: tuple[float, float]) -> bool:
    """Whether two numbers are within their half-widths together; without an interval they are exact."""
    halves = [half if math.isfinite(half) else 0.0 for _, half in (one, other)]
    return abs(one[0] - other[0]) <= math.hypot(*halves)


def describe(rows: Iterable[Json]) -> str:
    """The table: a line an injection, and every miss."""
    by_name: dict[str, list[Json]] = defaultdict(list)
    for row in rows:
        by_name[row["injection"]].append(row)
    lines = [f"{'injected':<32}{'logs':>5}" + "".join(f"{key:>11}" for key in (*_VERDICTS, "extra names"))]
    total: dict[str, int] = defaultdict(int)
    for name, found in by_name.items():
        counts = {key: sum(row["verdict"] == key for row in found) for key in _VERDICTS}
        extra = sum(len(row["extra"]) for row in found)
        lines.append(
            f"{name:<32}{len(found):>5}" + "".join(f"{count:>11}" for count in (*counts.values(), extra))
        )
        for key, count in (*counts.items(), ("logs", len(found)), ("extra", extra)):
            total[key] += count
    right = total["recovered"] + total["told"]
    share = right / max(total["logs"], 1)
    lines.append(
        f"{right} of {total['logs']} recovered or told ({share:.0%}), {total['undecided']} undecided, of "
        f"{total['cannot']} the log is said not to tell; {total['extra']} names that no unchanged log has"
    )
    for name, found in by_name.items():
        for row in found:
            if row["verdict"] not in {"recovered", "told"} or row["extra"]:
                told = f", extra {', '.join(row['extra'])}" if row["extra"] else ""
                lines.append(f"  {name}: {row['log']} {row['verdict']}{told}; {row['note']}")
    return "\n".join(lines) + "\n"


def note(injection: Injection, before: Answer, after: Answer) -> str:
    """The numbers that were asked for, before and after."""
    labels = list(injection.numbers) or [
        label for label in shared(before, after) if not is_close(before.numbers[label], after.numbers[label])
    ]
    parts = []
    for label in labels:
        one, two = (
            "{:.3g} +- {:.2g}".format(*answer.numbers[label]) if label in answer.numbers else "-"
            for answer in (before, after)
        )
        parts.append(f"{label} {one} -> {two}")
    gone = sorted(before.names - after.names)
    return ", ".join([*parts, *([f"no more {', '.join(gone)}"] if gone else [])])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logs", nargs="*", default=[""], help="words of the recordings' names")
    parser.add_argument("--only", nargs="*", default=[""], help="words of the injections' names")
    parser.add_argument("--out", type=Path, help="file to add a JSON line to for each answer")
    parser.add_argument("--resume", action="store_true", help="go on where the file of --out ends")
    asked = parser.parse_args()
    rows = read_rows(asked.out) if asked.resume else []
    done = {(row["log"], row["injection"]) for row in rows}
    chosen = [one for one in list_injections() if any(word in one.name for word in asked.only)]
    logs = [
        log
        for log in sorted(LOGS.glob("*.mcap"))
        if not log.stem.startswith(STANDING) and any(word in log.name for word in asked.logs)
    ]
    unchanged = Injection("nothing", lambda tables, _: tables)
    plain = {(log, both): ask(log, unchanged, both=both) for log in logs for both in (False, True)}
    for log in logs:
        vehicle = log.name.split("_")[0]
        usual = {
            name
            for (other, _), answer in plain.items()
            if other.name.startswith(vehicle)
            for name in (*answer.names, *answer.undecided)
        }
        for injection in chosen:
            if (log.stem, injection.name) in done:
                continue
            before, extra = plain[log, injection.both], list[str]()
            try:
                after = ask(log, injection, both=injection.both)
                verdict, extra = judge(injection, before, after, usual)
                text = note(injection, before, after)
            except SlipError as error:
                verdict, text = "missed", str(error)
            row = {
                "log": log.stem,
                "injection": injection.name,
                "verdict": verdict,
                "extra": extra,
                "note": text,
            }
            rows.append(row)
            sys.stderr.write(f"{log.stem}: {injection.name}: {verdict} {extra or ''}\n")
            add_row(asked.out, row)
    sys.stdout.write(describe(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
