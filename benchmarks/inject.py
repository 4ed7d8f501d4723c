"""Faults and effects injected into the real recordings: recovered, reported as the fault it is, or missed.

Asked is every recording under ../shared/logs that moves, the shortest first, with every change of
`injections.py`. A number is recovered where what was injected, put on top of what the unchanged recording
says, lies within the two intervals together, or where both cancel and nothing is named. An answer is the same
where the names are, and the numbers within the same measure; it is at the `edge` where one of the two has a
name for a number that the other one estimates alike and away from nothing, but does not name, or where it has
a name that the unchanged recording says may act, too, and the numbers that it says come with it. A name that
is the special case of one that is gone, with its number, is no extra name. `cannot`: the log is said not to
tell of it, or only of larger ones. Exit code 0; the table says what was missed.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import polars as pl
from injections import Drive, Injection, list_injections
from measuring import RECORDINGS, add_row, read_rows

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.core import SlipError
from pipeline.estimation import diagnose_runs
from pipeline.estimation.stored_diagnosis import read_recording
from pipeline.models import Number, find_effect
from pipeline.recording import Extraction, Given, extract_tables
from pipeline.recording.log_setup import set_up_log
from pipeline.results import Named
from pipeline.sources import DriveSection, DriveSource, Sources, Vehicle

STANDING = ("husky_wheels_avide2", "husky_wheels_plank")
_SURE = 1.96
# Relative change of a finding's number that is news.
_OTHER = 0.02
# Share of what was put in by which a finding's number may be off.
_MOVED = 0.2
# The same where the unchanged recording has a number that is too unsure to be told.
_UNTOLD = 0.4
_VERDICTS = ("recovered", "reported", "one of", "edge", "undecided", "cannot", "number", "missed")
Told = tuple[float, float]
_UNCHANGED = Injection("nothing", lambda tables, _: tables)
Json = dict[str, Any]


@dataclass(frozen=True)
class Answer:
    """What was said of a recording: numbers as (value, half-width) by ``effect.parameter``, and the rest.

    Attributes:
        numbers: of the effects that are named.
        findings: value by id, None where it has none.
        undecided: ids of all groups.
        unobservable: ids.
        estimates: numbers of effects that were not named.
        detectable: how large numbers would have had to be to be seen.
        rivals: numbers of effects that are one explanation of several, each in the place of the others.
    """

    numbers: Mapping[str, Told]
    findings: Mapping[str, float | None] = field(default_factory=dict)
    undecided: Sequence[str] = ()
    unobservable: Sequence[str] = ()
    estimates: Mapping[str, Told] = field(default_factory=dict)
    detectable: Mapping[str, float] = field(default_factory=dict)
    rivals: Mapping[str, Told] = field(default_factory=dict)

    @property
    def names(self) -> set[str]:
        """Ids of the effects."""
        return {label.split(".")[0] for label in self.numbers}

    def knows(self, label: str) -> bool:
        """Whether it says anything of a number."""
        return label in self.estimates or self.find_told(label) is not None

    @property
    def mentioned(self) -> set[str]:
        """Ids of the effects that are named, or one explanation of several."""
        return self.names | {*self.undecided}

    def find_told(self, label: str) -> Told | None:
        """A number that is told: of an effect that is named, or one of several."""
        return self.numbers.get(label) or self.rivals.get(label)

    def find_number(self, label: str) -> Told:
        """What is known of a number: as told, as estimated, or that it is less than would have been seen."""
        neutral = (find_neutral(label), self.detectable.get(label, 0.0))
        return self.find_told(label) or self.estimates.get(label, neutral)

    def list_labels(self, effects: Iterable[str]) -> list[str]:
        """Labels of the numbers of these of its effects."""
        return [label for label in self.numbers if label.split(".")[0] in {*effects}]

    def cannot_see(self, label: str, other: Answer) -> bool:
        """Whether it says that it does not tell of a number, or not of one as small as another answer's."""
        (effect, _), size = label.split("."), abs(other.numbers[label][0] - find_neutral(label))
        return effect in self.unobservable or size < self.detectable.get(label, 0.0)

    def nearly_names(self, label: str, other: Answer) -> bool:
        """Whether its estimate, away from nothing, is the number that another answer has a name for."""
        value, half = self.estimates.get(label, (math.nan, 0.0))
        return abs(value - find_neutral(label)) > half and is_close((value, half), other.numbers[label])


@lru_cache(maxsize=1)
def _extract(log: Path) -> tuple[Sources, Vehicle, Mapping[str, pl.DataFrame]]:
    """Sources, vehicle and tables of a recording as it is."""
    setup = set_up_log(log, Options(out=Path()))
    made = extract_tables(
        Given(setup.choice.take_log(), setup.sources, setup.configuration, setup.vehicle, str(log))
    )
    return setup.sources, setup.vehicle, made.tables


@contextmanager
def inject(log: Path, injection: Injection) -> Iterator[None]:
    """Let every reader of a recording, its examination first, see a change."""
    sources, vehicle, tables = _extract(log)
    drive = Drive(vehicle.wheel_radius_m, vehicle.track_width_m or math.nan)
    changed = injection.change(tables, drive)
    poses, imu, read_drive = Extraction.poses, Extraction.imu, Extraction.read_drive

    def read_poses(self: Extraction) -> pl.DataFrame:
        # What is found while they are read stays as it was.
        recorded = poses(self)
        return changed["poses"] if str(self.sources.pose) == str(sources.pose) else recorded

    def read_imu(self: Extraction) -> pl.DataFrame:
        recorded = imu(self)
        return changed.get("imu", recorded) if str(self.sources.imu) == str(sources.imu) else recorded

    def read_changed(
        self: Extraction, source: DriveSource | None, section: DriveSection, reader: Vehicle, *, held: bool
    ) -> pl.DataFrame:
        table = read_drive(self, source, section, reader, held=held)
        for role, own in (("commands", sources.command), ("wheels", sources.wheels)):
            is_own = source is not None and own is not None and source.signals == own.signals
            if is_own and changed.get(role) is not tables.get(role):
                # In the units of who reads it.
                return injection.change({**tables, role: table}, drive)[role]
        return table

    with (
        patch.object(Extraction, "poses", read_poses),
        patch.object(Extraction, "imu", read_imu),
        patch.object(Extraction, "read_drive", read_changed),
    ):
        yield


def ask(log: Path, injection: Injection, *, both: bool) -> Answer:
    """Analyze and diagnose a recording with a change."""
    with tempfile.TemporaryDirectory() as folder, inject(log, injection):
        manifest = analyze_log(log, Options(out=Path(folder), report=False)).manifest
        vehicle, recording = read_recording(manifest)
        inputs = ("command", "measured") if both else ("measured",)
        found = diagnose_runs([recording], vehicle, inputs=inputs)
        (told,) = found.runs
    findings = (*recording.list_findings(), *told.findings)
    estimates = {
        f"{one.effect}.{one.parameter}": (one.value, _SURE * one.standard_error)
        for one in sorted(found.estimates, key=lambda one: one.input)
    }
    return Answer(
        _list_numbers(told.effects),
        {one.id: one.value for one in findings},
        tuple(name for item in told.undecided for name in item.candidates),
        tuple(told.unobservable_why),
        estimates,
        {f"{one.id}.{one.parameter}": one.size for one in told.detectable},
        _list_values(pair for item in told.undecided for pair in item.parameters.items()),
    )


def _list_numbers(effects: Iterable[Named]) -> dict[str, Told]:
    return _list_values((effect.id, effect.parameters) for effect in effects)


def _list_values(told: Iterable[tuple[str, Mapping[str, Number]]]) -> dict[str, Told]:
    return {
        f"{effect}.{name}": (value.value, value.half)
        for effect, values in told
        for name, value in values.items()
    }


def judge(injection: Injection, before: Answer, after: Answer) -> tuple[str, list[str]]:
    """One of `_VERDICTS`, and names that the unchanged recording neither has nor considers."""
    told = [name for name in injection.findings if _is_news(name, injection.moved, before, after)]
    effects = {label.split(".")[0] for label in injection.numbers}
    along = {label.split(".")[0] for label in injection.along if comes_along(injection, label, before, after)}
    expected = before.mentioned | find_contained(before, after)
    extra = sorted(after.names - expected - effects - along)
    if told:
        # What a fault that is undone leaves to be named is no news.
        return "reported", [] if injection.moved is None else extra
    if injection.same:
        return _judge_same(before, after, extra), extra
    for effect in effects:
        labels = [label for label in injection.numbers if label.split(".")[0] == effect]
        if all(is_recovered(injection, label, before, after) for label in labels):
            return ("one of" if effect in after.undecided else "recovered"), extra
    if len(effects) > 1 and is_recovered_together(injection, before, after):
        return ("one of" if effects & {*after.undecided} else "recovered"), extra
    unseen = {
        label.split(".")[0]
        for label, change in injection.numbers.items()
        if abs(change(1.0) - 1.0) < max(after.detectable.get(label, 0.0), before.find_number(label)[1])
    }
    for verdict, ids in (
        ("number", after.names), ("undecided", after.undecided), ("cannot", {*after.unobservable, *unseen})
    ):  # fmt: skip
        if effects & {*ids}:
            return verdict, extra
    return "missed", extra


def _judge_same(before: Answer, after: Answer, extra: Sequence[str]) -> str:
    """Whether an answer is the same, or the same but for names that one of the two does not dare to say."""
    lost, come = before.names - after.mentioned, after.names - before.mentioned
    if not all(is_close(before.numbers[label], after.numbers[label]) for label in shared(before, after)):
        return "missed"
    if not lost and not come:
        return "recovered"
    if not come and all(after.cannot_see(label, before) for label in before.list_labels(lost)):
        return "cannot"
    known = all(before.nearly_names(label, after) for label in after.list_labels(extra)) and all(
        after.nearly_names(label, before) for label in before.list_labels(lost)
    )
    return "edge" if known else "missed"


def _is_news(finding: str, moved: float | None, before: Answer, after: Answer) -> bool:
    """Whether a finding is new, or says another number than it did of the unchanged recording."""
    if finding not in after.findings:
        return False
    old, new = before.findings.get(finding), after.findings[finding]
    if moved is not None and new:
        return abs(new - old - moved) < _MOVED * abs(moved) if old else new / moved > 1.0 - _UNTOLD
    return finding not in before.findings or bool(old and new and abs(math.log(abs(new / old))) > _OTHER)


def is_recovered(injection: Injection, label: str, before: Answer, after: Answer) -> bool:
    """Whether a number is what was injected on top of that of the unchanged recording.

    Where the two cancel nothing is left to be named.
    """
    (effect, _), neutral, change = label.split("."), find_neutral(label), injection.numbers[label]
    value, half = before.find_number(label)
    gain = injection.beside.get(label)
    if gain is not None and label not in before.numbers:
        # A change that is one explanation of several is one at another moment.
        value, half = neutral, 0.0
    expected = (change(value), abs(change(value + half) - change(value)))
    if gain is not None and gain not in after.numbers:
        # What the changed recording does not name stands in the number.
        share, unsure = before.find_number(gain)
        expected = (expected[0] * share, math.hypot(expected[1] * share, expected[0] * unsure))
    found = after.find_told(label)
    if found is None:
        was_there = before.find_told(label) and abs(value - neutral) > max(half, abs(expected[0] - neutral))
        # Of what the changed recording does not speak it knows as much as the unchanged one.
        unseen = (neutral, after.detectable.get(label, half))
        return bool(was_there) and is_close(expected, unseen) and effect not in after.mentioned
    # Of what the unchanged recording does not speak it knows as much as the changed one.
    return is_close(expected if before.knows(label) else (expected[0], max(expected[1], found[1])), found)


def comes_along(injection: Injection, label: str, before: Answer, after: Answer) -> bool:
    """Whether a further number that a change makes is told, and is what it makes of the unchanged one."""
    value, half = before.find_number(label)
    found = after.find_told(label)
    return found is not None and is_close((injection.along[label](value), half), found)


def is_recovered_together(injection: Injection, before: Answer, after: Answer) -> bool:
    """Whether effects that are one to first order add up to what was injected, each by its own sign.

    Ratios multiply: those of a track and of the track that contact friction contains.
    """
    moves = [_add_up(label, change(find_neutral(label)))[0] for label, change in injection.numbers.items()]
    if not all(moves) or not any(after.find_told(label) for label in injection.numbers):
        return False
    sums = []
    for answer in (before, after):
        numbers = [_add_up(label, *answer.find_number(label)) for label in injection.numbers]
        value = sum(math.copysign(1.0, move) * one for move, (one, _) in zip(moves, numbers, strict=True))
        sums.append((value, math.hypot(*(half for _, half in numbers))))
    return is_close((sums[0][0] + abs(moves[0]), sums[0][1]), sums[1])


def _add_up(label: str, value: float, half: float = 0.0) -> Told:
    """A number that adds up with others and is zero without effect: the logarithm of a ratio."""
    return (math.log(value), math.log1p(half / value)) if find_neutral(label) == 1.0 else (value, half)


def find_contained(before: Answer, after: Answer) -> set[str]:
    """Names that contain one that is gone, or are its special case, with the numbers that both have."""
    return {
        name
        for name in after.names - before.mentioned
        for gone in before.names - after.mentioned
        if (gone in find_effect(name).contains or name in find_effect(gone).contains)
        and (both := [one for one in after.list_labels([name]) if _rename(one, gone) in before.numbers])
        and all(is_close(before.numbers[_rename(label, gone)], after.numbers[label]) for label in both)
    }


def _rename(label: str, effect: str) -> str:
    """The number of that name of another effect."""
    return f"{effect}.{label.split('.')[1]}"


def find_neutral(label: str) -> float:
    """The number at which an effect does nothing."""
    effect, parameter = label.split(".")
    return find_effect(effect)().parameter(parameter).neutral


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


def score(rows: Iterable[Json]) -> list[Json]:
    """For each answer a verdict, a note, and extra names: all, those that no recording of the vehicle has,
    and their numbers that the unchanged recording does not estimate alike.
    """
    rows = list(rows)
    plain = {
        (row["log"], row["both"]): Answer(**row["answer"])
        for row in rows
        if row["injection"] == _UNCHANGED.name
    }
    known = {one.name: one for one in list_injections()}
    scored = []
    for row in rows:
        if row["injection"] not in known:
            continue
        injection, before = known[row["injection"]], plain[row["log"], row["both"]]
        if "answer" in row:
            after = Answer(**row["answer"])
            verdict, extra = judge(injection, before, after)
            text = note(injection, before, after)
        else:
            after, verdict, extra, text = before, "missed", [], row["error"]
        news = [label for label in after.list_labels(extra) if not before.nearly_names(label, after)]
        vehicle = row["log"].split("_")[0]
        usual = {name for (log, _), one in plain.items() if log.startswith(vehicle) for name in one.mentioned}
        scored.append(
            {
                **row, "verdict": verdict, "extra": extra, "foreign": [*{*extra} - usual], "news": news,
                "note": text,
            }
        )  # fmt: skip
    return scored


def describe(rows: Iterable[Json]) -> str:
    """The table: a line for each change and each recording, the sum, and every miss."""
    scored = score(rows)
    lines = []
    for key in ("injection", "log"):
        lines.append(f"{key:<44}{'asked':>6}" + "".join(f"{one:>10}" for one in (*_VERDICTS, "extra")))
        lines += [
            f"{name:<44}{len(found):>6}" + "".join(f"{count:>10}" for count in _count(found).values())
            for name in dict.fromkeys(row[key] for row in scored)
            if (found := [row for row in scored if row[key] == name])
        ]
        lines.append("")
    total, asked = _count(scored), max(len(scored), 1)
    right = total["recovered"] + total["reported"]
    foreign, news = (sum(bool(row[key]) for row in scored) for key in ("foreign", "news"))
    can = max(asked - total["cannot"], 1)
    lines += [
        f"{right} of {asked} recovered or reported ({right / asked:.0%}),",
        f"{right} of the {can} of which the log is not said not to tell ({right / can:.0%});",
        f"{total['one of']} reported as one of several explanations, with the number that was put in",
        f"({(right + total['one of']) / asked:.0%} with them); {total['undecided']} so with another number;",
        f"{total['edge']} the same but for a name at the edge of the evidence;",
        f"{total['number']} named with another number; {total['missed']} missed;",
        f"a name that the unchanged recording lacks in {total['extra']} ({total['extra'] / asked:.0%}),",
        f"that no recording of the vehicle has in {foreign} ({foreign / asked:.0%}),",
        f"whose number the unchanged recording does not estimate alike in {news} ({news / asked:.0%}).",
        "",
    ]
    for row in scored:
        if row["verdict"] not in {"recovered", "reported"} or row["extra"]:
            told = f", extra {', '.join(row['extra'])}" if row["extra"] else ""
            lines.append(f"  {row['injection']}: {row['log']} {row['verdict']}{told}; {row['note']}")
    return "\n".join(lines) + "\n"


def _count(rows: Sequence[Json]) -> dict[str, int]:
    counts = {key: sum(row["verdict"] == key for row in rows) for key in _VERDICTS}
    return counts | {"extra": sum(bool(row["extra"]) for row in rows)}


def note(injection: Injection, before: Answer, after: Answer) -> str:
    """Numbers that were asked for or changed, before and after; in brackets those without a name."""
    labels = list(injection.numbers) + [
        label for label in after.numbers if not is_close(before.find_number(label), after.numbers[label])
    ]
    parts = []
    for label in dict.fromkeys(labels):
        one, two = (
            ("{:.3g} +- {:.2g}" if answer.find_told(label) else "({:.3g} +- {:.2g})").format(
                *answer.find_number(label)
            )
            for answer in (before, after)
        )
        parts.append(f"{label} {one} -> {two}")
    gone = sorted(before.names - after.names)
    return ", ".join([*parts, *([f"no more {', '.join(gone)}"] if gone else [])])


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--logs", nargs="*", default=[""], help="words of the recordings' names")
    parser.add_argument("--only", nargs="*", default=[""], help="words of the injections' names")
    parser.add_argument("--out", type=Path, help="file to add a JSON line to for each answer")
    parser.add_argument("--resume", action="store_true", help="go on where the file of --out ends")
    parser.add_argument(
        "--table", type=Path, help="file of --out of which the table is printed, asking nothing"
    )


def run(asked: argparse.Namespace) -> int:
    if asked.table is not None:
        sys.stdout.write(describe(read_rows(asked.table)))
        return 0
    rows = read_rows(asked.out) if asked.resume else []
    done = {(row["log"], row["injection"], row["both"]) for row in rows}
    chosen = [one for one in list_injections() if any(word in one.name for word in asked.only)]
    logs = [
        log
        for log in sorted(RECORDINGS.glob("*.mcap"), key=lambda log: log.stat().st_size)
        if not log.stem.startswith(STANDING) and any(word in log.name for word in asked.logs)
    ]
    for log in logs:
        unchanged = [(_UNCHANGED, both) for both in sorted({one.both for one in chosen})]
        for injection, both in (*unchanged, *((one, one.both) for one in chosen)):
            if (log.stem, injection.name, both) in done:
                continue
            row: Json = {"log": log.stem, "injection": injection.name, "both": both}
            try:
                row["answer"] = asdict(ask(log, injection, both=both))
            except SlipError as error:
                row["error"] = str(error)
            rows.append(row)
            sys.stderr.write(f"{log.stem}: {injection.name}\n")
            add_row(asked.out, row)
    sys.stdout.write(describe(rows))
    return 0
