"""Frozen answers: logs taken through the stages once, with the answer of one version of the diagnosis.

    make bench NAME=game/freeze ARGS="write FOLDER --seeds 910000-910012 [--categories C] [--recordings]"
    make bench NAME=game/freeze ARGS="compare FOLDER [--jobs 2]"

`write` fills a folder for each log: its tables, and what `slip diagnose` says of it, with the CPU time that
it took. It goes on where it was stopped. `compare` diagnoses the same tables with the code as it is now. It
prints of each log the largest relative difference of all numbers of the two answers and all else that
differs, with a summary of both where that differs, and the ratio of CPU times by category. What a log hides
is drawn again from its category and seed.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import statistics
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from measuring import RECORDINGS

from game.draw import CATEGORIES, draw_riddle, write_riddle
from game.play import THREADS, parse_seeds, score_runs
from pipeline.core import SlipError
from pipeline.estimation import diagnose_runs
from pipeline.job import Options
from pipeline.job.analyze import analyze_log
from pipeline.job.run_results import read_recording
from pipeline.store import Store

RECORDED = "recordings"
_FROZEN, _RESULTS = "frozen.json", "results"
_TIMES = frozenset({"timing", "cpu_s"})
"""Keys whose numbers no two runs of a program have in common."""

Json = Mapping[str, Any]


@dataclass(frozen=True)
class Case:
    """A frozen log: of a category and a seed, or a recording by its name."""

    category: str
    name: str

    def folder(self, root: Path) -> Path:
        """Where it stands."""
        return root / self.category / self.name


@dataclass(frozen=True)
class Comparison:
    """A frozen answer beside that of the code as it is now.

    Attributes:
        case: the log.
        summaries: both in a line.
        largest: largest relative difference of two numbers at the same place.
        at: that place.
        others: places at which anything else differs, with both values.
        cpu_s: of both [s].
    """

    case: Case
    summaries: tuple[str, str]
    largest: float
    at: str
    others: tuple[str, ...]
    cpu_s: tuple[float, float]


def freeze(case: Case, root: Path) -> str:
    """Draw a log or take a recording, run its stages and diagnose it, once.

    Returns:
        One line about it.
    """
    folder = case.folder(root)
    if (folder / _FROZEN).exists():
        return f"{case.category} {case.name}: is there"
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="freeze_") as scratch:
        if case.category == RECORDED:
            logs = [RECORDINGS / f"{case.name}.mcap"]
        else:
            riddle = draw_riddle(case.category, int(case.name), None)  # type: ignore[arg-type]
            logs = write_riddle(riddle, Path(scratch) / "run.mcap")
        for log in logs:
            analyze_log(log, Options(out=folder / _RESULTS, report=False, diagnosis=False))
    told, spent = diagnose(case, root)
    (folder / _FROZEN).write_text(json.dumps({"cpu_s": spent, "runs": told}, indent=1), encoding="utf-8")
    return f"{case.category} {case.name}: {spent:.1f} s"


def diagnose(case: Case, root: Path) -> tuple[list[dict[str, Any]], float]:
    """What `slip diagnose --json` says of a frozen log, and the CPU time that it took [s]."""
    read = [read_recording(manifest) for manifest in Store(case.folder(root) / _RESULTS).manifests()]
    begin = time.process_time()
    try:
        answer = diagnose_runs([recording for _, recording in read], read[0][0])
        told = json.loads(json.dumps(answer.to_json()))
    except SlipError as error:
        told = [{"error": error.code, "effects": [], "undecided": [], "unobservable": []}]
    return told, time.process_time() - begin


def compare(case: Case, root: Path) -> Comparison:
    """The frozen answer beside that of the code as it is now."""
    frozen = json.loads((case.folder(root) / _FROZEN).read_text(encoding="utf-8"))
    told, spent = diagnose(case, root)
    largest, at, others = 0.0, "", list[str]()
    for place, old, new in walk(frozen["runs"], told):
        ratio = measure_difference(old, new)
        if ratio is None:
            others.append(f"{place}: {_shorten(old)} -> {_shorten(new)}")
        elif ratio > largest:
            largest, at = ratio, place
    summaries = summarize(case, frozen["runs"]), summarize(case, told)
    return Comparison(case, summaries, largest, at, tuple(others), (frozen["cpu_s"], spent))


def walk(old: object, new: object, place: str = "") -> Iterator[tuple[str, object, object]]:
    """Every pair of values at the same place of two answers that differ; None where one has none."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in (*old, *(one for one in new if one not in old)):
            if key not in _TIMES:
                yield from walk(old.get(key), new.get(key), f"{place}.{key}".lstrip("."))
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for number, pair in enumerate(zip(old, new, strict=True)):
            yield from walk(*pair, f"{place}[{number}]")
    elif old != new:
        yield place, old, new


def measure_difference(old: object, new: object) -> float | None:
    """The difference of two numbers over the larger; None where one is no number."""
    if isinstance(old, bool) or isinstance(new, bool):
        return None
    if not isinstance(old, int | float) or not isinstance(new, int | float):
        return None
    return abs(new - old) / max(abs(old), abs(new))


def _shorten(value: object, most: int = 60) -> str:
    text = json.dumps(value)
    return text if len(text) <= most else f"{text[: most - 3]}..."


def summarize(case: Case, runs: Sequence[Json]) -> str:
    """What an answer comes to, in one line."""
    said = sorted(str(effect["id"]) for effect in runs[0]["effects"])
    groups = ["|".join(sorted(group["candidates"])) for group in runs[0]["undecided"]]
    ladder = runs[0].get("ladder") or [{}]
    errors = " ".join(f"{ladder[-1].get(key, float('nan')):.4f}" for key in ("t_mrmse_m", "r_mrmse_rad"))
    flag = (runs[0].get("unexplained") or {}).get("channel", "")
    verdict = ""
    if case.category != RECORDED:
        answer = draw_riddle(case.category, int(case.name), None).answer  # type: ignore[arg-type]
        score = score_runs(answer, runs)
        ways = ", ".join(f"{name} {outcome}" for name, outcome in score.outcomes.items())
        verdict = f"{ways}{f', false {list(score.false)}' if score.false else ''}; "
    return f"{verdict}{', '.join(said) or 'nothing'} {groups or ''} {flag} | {errors}"


def describe(one: Comparison, most: int = 8) -> list[str]:
    """The lines of a comparison."""
    where = f" at {one.at}" if one.at else ""
    lines = [f"{one.case.category} {one.case.name}: numbers differ by {one.largest:.1e} at most{where}"]
    lines += [f"  {other}" for other in one.others[:most]]
    if len(one.others) > most:
        lines.append(f"  and {len(one.others) - most} other places")
    if one.summaries[0] != one.summaries[1]:
        lines += [f"  before: {one.summaries[0]}", f"  after:  {one.summaries[1]}"]
    return lines


def list_cases(root: Path) -> list[Case]:
    """All that is frozen."""
    return [Case(path.parent.parent.name, path.parent.name) for path in sorted(root.glob(f"*/*/{_FROZEN}"))]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("verb", choices=["write", "compare"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=parse_seeds, default=[])
    parser.add_argument("--categories", help="with commas; all where not given")
    parser.add_argument("--recordings", action="store_true", help="write those of ../shared/logs, too")
    parser.add_argument("--jobs", type=int, default=1)


def run(given: argparse.Namespace) -> None:
    """Write or compare."""
    os.environ.update(dict.fromkeys(THREADS, "1"))
    wanted = given.categories.split(",") if given.categories else [*CATEGORIES, RECORDED]
    with ProcessPoolExecutor(given.jobs, multiprocessing.get_context("spawn")) as pool:
        if given.verb == "write":
            names = sorted(log.stem for log in RECORDINGS.glob("*.mcap")) if given.recordings else []
            cases = [Case(RECORDED, name) for name in names]
            cases += [Case(one, str(seed)) for seed in given.seeds for one in wanted if one != RECORDED]
            for line in pool.map(freeze, cases, [given.folder] * len(cases)):
                print(line, flush=True)
            return
        cases = [case for case in list_cases(given.folder) if case.category in wanted]
        ratios: dict[str, list[float]] = {}
        changed = 0
        for one in pool.map(compare, cases, [given.folder] * len(cases)):
            changed += bool(one.others) or one.largest > 0.0
            ratios.setdefault(one.case.category, []).append(one.cpu_s[1] / one.cpu_s[0])
            print(*describe(one), sep="\n", flush=True)
    for category, values in ratios.items():
        print(f"{category:12} {len(values):4} logs   CPU {statistics.median(values):.2f} of before")
    print(f"{changed} of {len(cases)} answers differ")
