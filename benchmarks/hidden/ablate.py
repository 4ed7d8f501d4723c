"""Which rules of the diagnosis pay: each off in turn, on hidden logs and on real recordings.

    python benchmarks/hidden/ablate.py --seeds 81000-81040 --out ablation.jsonl [--jobs 2]
    python benchmarks/hidden/ablate.py ...the same... --resume
    python benchmarks/hidden/ablate.py --table ablation.jsonl

Each log is diagnosed with all rules; a rule that acted on it is then turned off and the log is diagnosed
again. An answer without a rule is better or worse as in `paired`. Of recordings nobody knows the answer: the
table counts those whose names change, and how the 2 s error moves.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pebble import ProcessPool

sys.path.insert(0, str(Path(__file__).parent))

from draw import CATEGORIES, Answer, draw_riddle, write_riddle
from paired import rank, sign_test
from play import parse_seeds
from rules import RULES, watch
from score import Score, score_run

from pipeline.estimation import Recording, diagnose_runs
from pipeline.job import Options
from pipeline.job.analyze import analyze_log
from pipeline.job.run_results import read_recording
from pipeline.sources import Vehicle

_LOGS = Path(__file__).parents[2] / ".." / "shared" / "logs"
_RECORDINGS = "recordings"
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "POLARS_MAX_THREADS")
_ALL = "all rules"

Line = dict[str, Any]


@dataclass(frozen=True)
class Judged:
    """An answer with the score that `paired.rank` asks for."""

    answer: Answer
    score: Score


def ablate(category: str, seed: int, name: str) -> Line:
    """One log with all rules, then without each that acted on it.

    Args:
        category: of `draw.CATEGORIES`, or `recordings`.
        seed: from which it is drawn.
        name: of the recording.

    Returns:
        The line of the results: what was said with all rules, and what changed without each.
    """
    with tempfile.TemporaryDirectory(prefix="ablate_") as folder:
        if category == _RECORDINGS:
            log, answer = _LOGS / f"{name}.mcap", Answer({})
        else:
            riddle = draw_riddle(category, seed, None)
            log, answer = Path(folder) / "run.mcap", riddle.answer
            write_riddle(riddle, log)
        options = Options(out=Path(folder) / "out", report=False, diagnosis=False)
        vehicle, recording = read_recording(analyze_log(log, options).manifest)
    with watch(RULES) as acted:
        full = _ask(vehicle, recording, answer)
    without: dict[str, Line] = {}
    for rule in RULES:
        if rule.name in acted:
            with rule.off():
                without[rule.name] = _ask(vehicle, recording, answer)
    return {"category": category, "seed": seed, "name": name, _ALL: full, "without": without}


def _ask(vehicle: Vehicle, recording: Recording, answer: Answer) -> Line:
    told = diagnose_runs([recording], vehicle).to_json()[0]
    score = score_run(answer, told)
    ladder = told["ladder"]
    last = ladder[-1] if isinstance(ladder, list) and ladder else {}
    findings = [str(item["id"]) for item in told["findings"]]
    return {
        "rank": rank(Judged(answer, score)),
        "named": sorted(score.named),
        "open": sorted(score.groups),
        "flagged": score.flagged,
        "tentative": sorted(str(e["id"]) for e in told["effects"] if e["tentative"]),
        "hidden": sorted(score.truth),
        "errors": [last.get(key) for key in ("t_mrmse_m", "r_mrmse_rad")]
        if isinstance(last, Mapping)
        else [],
        "cut": "search_cut" in findings,
    }


def list_jobs(seeds: Iterable[int], *, recordings: bool) -> Iterator[tuple[str, int, str]]:
    """Arguments of `ablate`: all categories of every seed, then the recordings where they are."""
    for seed in seeds:
        for category in CATEGORIES:
            yield category, seed, ""
    if recordings:
        for log in sorted(_LOGS.glob("*.mcap")):
            yield _RECORDINGS, 0, log.stem


def write_table(lines: Iterable[Line]) -> str:
    """What turning off each rule changes."""
    lines = list(lines)
    drawn = [line for line in lines if line["category"] != _RECORDINGS]
    real = [line for line in lines if line["category"] == _RECORDINGS]
    rows = [
        f"{len(drawn)} drawn logs, {len(real)} recordings; better and worse: answers without the rule",
        (
            f"{'rule':<20}{'acted':>6}{'better':>8}{'worse':>7}{'other':>7}{'p':>8}{'2 s error':>11}"
            f"{'recordings':>12}{'2 s error':>11}  what it does"
        ),
    ]
    for rule in RULES:
        pairs = [pair for line in drawn if (pair := _pair(line, rule.name))]
        better = sum(tuple(off["rank"]) < tuple(on["rank"]) for on, off in pairs)
        worse = sum(tuple(off["rank"]) > tuple(on["rank"]) for on, off in pairs)
        other = sum(_differ(on, off) for on, off in pairs) - better - worse
        found = [pair for line in real if (pair := _pair(line, rule.name))]
        changed = sum(_differ(on, off) for on, off in found)
        rows.append(
            f"{rule.name:<20}{len(pairs):>6}{better:>8}{worse:>7}{max(other, 0):>7}"
            f"{sign_test(better, worse):>8.3f}{_ratio(pairs):>11.4f}{changed:>12}{_ratio(found):>11.4f}"
            f"  {rule.says}"
        )
    return "\n".join(rows)


def _pair(line: Line, rule: str) -> tuple[Line, Line] | None:
    on, without = line[_ALL], line["without"]
    off = without.get(rule) if isinstance(without, dict) else None
    return (on, off) if isinstance(on, dict) and isinstance(off, dict) else None


def _differ(on: Line, off: Line) -> bool:
    return any(on[key] != off[key] for key in ("named", "open", "flagged", "tentative"))


def _ratio(pairs: Iterable[tuple[Line, Line]]) -> float:
    """Geometric mean of errors without the rule over those with it."""
    logs = [
        math.log(new / old)
        for on, off in pairs
        for old, new in zip(on["errors"], off["errors"], strict=True)
        if isinstance(old, float) and isinstance(new, float) and old > 0.0 and new > 0.0
    ]
    return math.exp(sum(logs) / len(logs)) if logs else math.nan


def read_lines(path: Path) -> list[Line]:
    """Lines of a file of results; none where it is not there."""
    return [json.loads(text) for text in path.read_text().splitlines()] if path.is_file() else []


def main() -> int:
    """Read the command line, ablate, print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", default=list(range(81000, 81040)), type=parse_seeds)
    parser.add_argument("--jobs", default=1, type=int)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--no-recordings", action="store_true")
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--table", type=Path)
    asked = parser.parse_args()
    if asked.table:
        sys.stdout.write(write_table(read_lines(asked.table)) + "\n")
        return 0
    if asked.out and asked.out.exists() and not asked.resume:
        parser.error(f"{asked.out} is there: say --resume to go on with it, or give another name")
    done = read_lines(asked.out) if asked.out and asked.resume else []
    known = {(line["category"], line["seed"], line["name"]) for line in done}
    jobs = [j for j in list_jobs(asked.seeds, recordings=not asked.no_recordings) if j not in known]
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    spawn = multiprocessing.get_context("spawn")
    # The pool of the standard library hangs where its only worker is replaced.
    with ProcessPool(asked.jobs, max_tasks=50, context=spawn) as pool:
        for count, future in enumerate(as_completed([pool.schedule(ablate, job) for job in jobs]), start=1):
            try:
                line = future.result()
            except Exception as error:  # noqa: BLE001 - a log that fails costs itself, and is said
                sys.stderr.write(f"failed: {type(error).__name__}: {error}\n")
                continue
            done.append(line)
            if asked.out:
                with asked.out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(line) + "\n")
            sys.stderr.write(f"\r{count} of {len(jobs)} logs ")
    sys.stdout.write("\n" + write_table(done) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
