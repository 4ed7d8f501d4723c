"""Two versions on the same hidden logs: answers that changed for the better and for the worse.

    python benchmarks/hidden/paired.py before.jsonl after.jsonl

Only logs that both have played count. An answer is better when it misses less, leaves less open, or names
less that was not hidden; the sign test's p says how often chance alone would tilt the changes that far.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from records import Job, Record, read_records


def rank(record: Record) -> tuple[int, ...]:
    """How wrong an answer is, the gravest first: falsely named, missed, left open."""
    score = record.score
    flags = int(bool(score.flagged) and not record.answer.odd)
    unseen = int(bool(record.answer.odd) and not score.flagged)
    return (
        len(score.false) + flags,
        len(score.missed) + unseen,
        len(score.undecided) + len(score.unobservable),
    )


def sign_test(better: int, worse: int) -> float:
    """Two-sided p of so uneven a split of changes."""
    count = better + worse
    tail = sum(math.comb(count, k) for k in range(min(better, worse) + 1)) / 2.0**count
    return min(1.0, 2.0 * tail)


def describe_change(job: Job, before: Record, after: Record) -> str:
    """One changed answer as a line."""
    old, new = before.score, after.score
    return (
        f"  {job.category:<9}{job.seed:<8}hid {', '.join(old.truth) or 'nothing'}: named "
        f"{', '.join(old.named) or 'nothing'} -> {', '.join(new.named) or 'nothing'}"
    )


def compare(before: Mapping[Job, Record], after: Mapping[Job, Record]) -> list[str]:
    """The table, and every answer that changed for the worse."""
    jobs = [job for job in before if job in after]
    lines = [
        f"{'category':<11}{'logs':>6}{'better':>8}{'worse':>7}{'other':>7}{'p':>7}{'2 s error':>11}{'CPU':>7}"
    ]
    told: list[str] = []
    categories = dict.fromkeys(job.category for job in jobs)
    for name in (*categories, "all"):
        pairs = [(job, before[job], after[job]) for job in jobs if name in {job.category, "all"}]
        better = sum(rank(new) < rank(old) for _, old, new in pairs)
        worse = [pair for pair in pairs if rank(pair[2]) > rank(pair[1])]
        other = sum(rank(new) == rank(old) and new.score.named != old.score.named for _, old, new in pairs)
        chance = sign_test(better, len(worse))
        lines.append(
            f"{name:<11}{len(pairs):>6}{better:>8}{len(worse):>7}{other:>7}{chance:>7.2f}"
            f"{_typical_ratio([(old.score.errors[1], new.score.errors[1]) for _, old, new in pairs]):>11.3f}"
            f"{_typical_ratio([(_cpu(old), _cpu(new)) for _, old, new in pairs]):>7.2f}"
        )
        if name != "all":
            told += [describe_change(*pair) for pair in worse]
    return [*lines, "", "changed for the worse:", *told] if told else lines


def _cpu(record: Record) -> float:
    return float(record.cpu_s.get("diagnosis", math.nan))


def _typical_ratio(pairs: list[tuple[float, float]]) -> float:
    """Geometric mean of after over before."""
    logs = [math.log(new / old) for old, new in pairs if old > 0.0 and new > 0.0]
    return math.exp(sum(logs) / len(logs)) if logs else math.nan


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    given = parser.parse_args()
    sys.stdout.write("\n".join(compare(read_records([given.before]), read_records([given.after]))) + "\n")


if __name__ == "__main__":
    main()
