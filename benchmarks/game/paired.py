"""Two versions on the same hidden logs: answers that changed for the better and for the worse.

    make bench NAME=game/paired ARGS="before.jsonl after.jsonl"

Only logs that both have played count. An answer is better when it names less that was not hidden, misses
less, or leaves less open; the sign test's p says how often chance alone would tilt the changes that far.
"""

import argparse
import math
from collections.abc import Iterable, Mapping
from pathlib import Path

from game.play import Job, Record, read_records


def rank(record: Record) -> tuple[int, ...]:
    """How wrong an answer is, the gravest first: falsely claimed, missed, left open."""
    outcomes = list(record.score.outcomes.values())
    missed, open_ones = ("abstained", "wrong"), ("undecided", "unobservable")
    return (
        len(record.score.false),
        sum(one in missed for one in outcomes),
        sum(one in open_ones for one in outcomes),
    )


def sign_test(better: int, worse: int) -> float:
    """Two-sided p of so uneven a split of changes."""
    count = better + worse
    tail = sum(math.comb(count, k) for k in range(min(better, worse) + 1)) / 2.0**count
    return min(1.0, 2.0 * tail)


def compare(before: Mapping[Job, Record], after: Mapping[Job, Record]) -> list[str]:
    """The table, and every answer that changed for the worse."""
    jobs = [job for job in before if job in after]
    lines = [
        f"{'category':<11}{'logs':>6}{'better':>8}{'worse':>7}{'other':>7}{'p':>7}{'2 s error':>11}{'CPU':>7}"
    ]
    told: list[str] = []
    for name in (*dict.fromkeys(job.category for job in jobs), "all"):
        pairs = [(before[job], after[job]) for job in jobs if name in {job.category, "all"}]
        better = sum(rank(new) < rank(old) for old, new in pairs)
        worse = [pair for pair in pairs if rank(pair[1]) > rank(pair[0])]
        other = sum(rank(new) == rank(old) and new.score.named != old.score.named for old, new in pairs)
        errors = _typical_ratio((old.errors[1], new.errors[1]) for old, new in pairs)
        cpu = _typical_ratio((old.cpu_s.get("diagnosis"), new.cpu_s.get("diagnosis")) for old, new in pairs)
        lines.append(
            f"{name:<11}{len(pairs):>6}{better:>8}{len(worse):>7}{other:>7}"
            f"{sign_test(better, len(worse)):>7.2f}{errors:>11.3f}{cpu:>7.2f}"
        )
        if name != "all":
            told += [_describe_change(*pair) for pair in worse]
    return [*lines, "", "changed for the worse:", *told] if told else lines


def _describe_change(old: Record, new: Record) -> str:
    hidden = ", ".join(sorted(old.answer.effects)) or old.answer.odd or "nothing"
    named = [", ".join(one.score.named) or "nothing" for one in (old, new)]
    return f"  {old.job.category:<9}{old.job.seed:<8}hid {hidden}: named {' -> '.join(named)}"


def _typical_ratio(pairs: Iterable[tuple[float | None, float | None]]) -> float:
    """Geometric mean of after over before."""
    logs = [math.log(new / old) for old, new in pairs if old and new]
    return math.exp(sum(logs) / len(logs)) if logs else math.nan


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)


def run(given: argparse.Namespace) -> None:
    """Print the table."""
    print(*compare(read_records([given.before]), read_records([given.after])), sep="\n")
