"""Play the hidden-effect test: draw logs by seed, diagnose them, open the answers, print the score.

    python tests/hidden/play.py [--category single|small|equipped|sets|empty|poor|odd|rigid|all]
                                [--seeds 0-20] [--effect ID|each] [--command-line]

The same code path as `slip diagnose LOG --json`; with --command-line the program itself is run for each log.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from draw import CAR, CATEGORIES, DIFFERENTIAL, Answer, Category, draw_riddle, open_seal, write_riddle
from odd_physics import ODD
from score import Score, confusion_table, describe_rate, score_run

from pipeline.cli.verb_diagnose import _find, _read
from pipeline.diagnosis import diagnose_runs
from pipeline.job.options import Options

POOLS = {
    "single": DIFFERENTIAL + CAR,
    "small": DIFFERENTIAL + CAR,
    "odd": tuple(sorted(ODD)),
    "rigid": ("track", "payload", "small_wheels", "slope", "slow_motors"),
}


@dataclass(frozen=True)
class Job:
    """One log to draw and to diagnose."""

    category: Category
    seed: int
    effect: str | None
    by_command_line: bool


@dataclass(frozen=True)
class Played:
    """One log, diagnosed and opened."""

    job: Job
    answer: Answer
    score: Score
    seconds: float


def play(job: Job) -> Played:
    """Write a log, hand it over, and open its answer only afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "run.mcap"
        write_riddle(draw_riddle(job.category, job.seed, job.effect), log)
        begin = time.perf_counter()
        told = _ask_command_line(log) if job.by_command_line else _ask_in_process(log)
        seconds = time.perf_counter() - begin
        answer = open_seal(log.with_suffix(".sealed").read_text(encoding="ascii"))
    return Played(job, answer, score_run(answer, told), seconds)


def _ask_command_line(log: Path) -> dict[str, object]:
    command = [
        sys.executable,
        "-m",
        "pipeline",
        "diagnose",
        str(log),
        "--json",
        "--out",
        str(log.parent / "out"),
    ]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode not in {0, 3}:
        raise RuntimeError(done.stderr)
    return dict(json.loads(done.stdout)["runs"][0])


def _ask_in_process(log: Path) -> dict[str, object]:
    options = Options(out=log.parent / "out", report=False)
    manifest, _ = _find(str(log), options, quiet=True)
    vehicle, recording = _read(manifest)
    return dict(diagnose_runs([recording], vehicle).to_json()[0])


def play_all(jobs: Sequence[Job], workers: int = 2) -> list[Played]:
    """Play many jobs on two cores, in order."""
    if workers == 1 or len(jobs) == 1:
        return [play(job) for job in jobs]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        return list(pool.map(play, jobs))


def list_jobs(
    category: Category, seeds: Sequence[int], effect: str | None, *, by_command_line: bool
) -> list[Job]:
    """Jobs of one category; `each` goes through every effect."""
    pool: Sequence[str | None] = POOLS.get(category, (None,)) if effect == "each" else (effect,)
    return [Job(category, seed, name, by_command_line) for name in pool for seed in seeds]


def describe(category: str, played: Sequence[Played]) -> list[str]:
    """The rates that belong to a category, its confusion table, and every miss."""
    scores = [one.score for one in played]
    count = len(scores)
    lines = [f"== {category}: {count} logs, {sum(one.seconds for one in played) / max(count, 1):.1f} s a log"]
    if category == "empty":
        clean = sum(not s.named and not s.flagged for s in scores)
        lines.append(describe_rate("nothing named and nothing flagged", clean, count))
    elif category == "odd":
        right = sum(
            bool(set(s.flagged) & set(one.answer.channel)) for s, one in zip(scores, played, strict=True)
        )
        lowered = sum(s.formula > 0.02 for s in scores)
        lines.append(describe_rate("flagged in the right channel", right, count))
        lines.append(describe_rate("formula lowers the held-out error", lowered, count))
    elif category == "poor":
        open_ = sum(not s.missed for s in scores)
        told = sum(not s.missed and not s.found for s in scores)
        lines.append(describe_rate("undecided, unobservable, or rightly named", open_, count))
        lines.append(describe_rate("  of these undecided or unobservable", told, count))
        lines.append(describe_rate("a confident wrong name", sum(bool(s.false) for s in scores), count))
    else:
        lines.append(describe_rate("all named", sum(len(s.found) == len(s.truth) for s in scores), count))
        lines.append(describe_rate("nothing else named", sum(not s.false for s in scores), count))
        lines.append(describe_rate("exactly right", sum(s.is_exact for s in scores), count))
    lines += confusion_table(scores)
    before = [s.errors for s in scores if s.errors[0] == s.errors[0]]
    if before:
        mean = [sum(e[i] for e in before) / len(before) for i in range(3)]
        lines.append(f"2 s error, mean: before {mean[0]:.3f} m, after {mean[1]:.3f} m, floor {mean[2]:.3f} m")
    for one in played:
        if category not in {"poor", "odd"} and not one.score.is_exact:
            lines.append(
                f"  seed {one.job.seed} {one.job.effect or ''} {one.answer.program}: "
                f"hidden {one.answer.effects}, named {list(one.score.named)}, "
                f"undecided {list(one.score.undecided)}, unobservable {list(one.score.unobservable)}"
                f"{', flagged ' + one.score.flagged if one.score.flagged else ''}"
            )
        elif category == "poor" and (one.score.missed or one.score.false):
            lines.append(
                f"  seed {one.job.seed} {one.answer.program}: hidden {one.answer.effects}, "
                f"named {list(one.score.named)}"
            )
        elif category == "odd" and not set(one.score.flagged) & set(one.answer.channel):
            lines.append(
                f"  seed {one.job.seed} {one.answer.odd}: named {list(one.score.named)}, flagged "
                f"{one.score.flagged or 'nothing'}"
            )
    return lines


def main() -> None:
    """Read the command line and play."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--category", default="single", choices=[*CATEGORIES, "all"])
    parser.add_argument("--seeds", default="0", help="one seed, or first-last (the last not included)")
    parser.add_argument("--effect", default=None, help="an id, or `each`")
    parser.add_argument("--command-line", action="store_true")
    asked = parser.parse_args()
    first, _, last = asked.seeds.partition("-")
    seeds = range(int(first), int(last)) if last else [int(first)]
    for category in CATEGORIES if asked.category == "all" else (asked.category,):
        jobs = list_jobs(category, seeds, asked.effect, by_command_line=asked.command_line)
        sys.stdout.write("\n".join(describe(category, play_all(jobs))) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
