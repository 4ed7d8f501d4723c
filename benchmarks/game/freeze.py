"""An examination: drawn logs taken through the stages once, then diagnosed by any version and scored.

    make bench NAME=game/freeze ARGS="write FOLDER --seeds 7701-7713 [--categories C] [--closed]"
    make bench NAME=game/freeze ARGS="exam FOLDER [--jobs 2] [--answers NAME] [--input measured]"
    make bench NAME=game/freeze ARGS="compare FOLDER [--jobs 2] [--answers NAME]"

`write` fills a folder for each log, CATEGORY/SEED: its tables in results, and what it hides in truth.json.
It goes on where it was stopped. With --recordings it writes those of ../shared/logs, too. With --closed
every second seed is driven in closed loop, wherever the category leaves the driving open. `exam` diagnoses
the tables with the code as it is now, keeps the answers as NAME.json beside them, with the CPU time of each,
and prints what is right, wrong, missed and covered, by category, driving, sensors and input. `compare`
diagnoses once more. It prints of each log the largest relative difference of all numbers of the two answers
and all else that differs, with a summary of both where that differs, and the ratio of CPU times by category.
"""

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

import msgspec
from measuring import RECORDINGS

from game.draw import CATEGORIES, Answer, Riddle, draw_riddle, write_riddle
from game.play import THREADS, parse_seeds, score_runs
from game.score import TaskScore, list_misses
from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.core import INPUTS, SlipError
from pipeline.estimation import diagnose_runs
from pipeline.estimation.stored_diagnosis import read_recording
from pipeline.store import Store
from pipeline.words.objects import diagnosis_as_json

RECORDED = "recordings"
_TRUTH, _RESULTS, _ANSWERS = "truth.json", "results", "answers"
_TIMES = frozenset({"timing", "cpu_s"})
"""Keys whose numbers no two runs of a program have in common."""

Json = Mapping[str, Any]


@dataclass(frozen=True)
class Case:
    """A frozen log: of a category and a seed, or a recording by its name.

    Attributes:
        category, name: what is drawn; the seed of one in closed loop ends with `c`.
    """

    category: str
    name: str

    def draw(self) -> Riddle:
        """What a drawn log hides, and how it is made."""
        closed = self.name.endswith("c")
        return draw_riddle(self.category, int(self.name.removesuffix("c")), closed=closed)  # type: ignore[arg-type]

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
    """Draw a log or take a recording, and run its stages, once.

    Returns:
        One line about it.
    """
    folder, begin = case.folder(root), time.process_time()
    if (folder / _TRUTH).exists():
        return f"{case.category} {case.name}: is there"
    folder.mkdir(parents=True, exist_ok=True)
    answer = Answer(case.category)
    with tempfile.TemporaryDirectory(prefix="freeze_") as scratch:
        if case.category == RECORDED:
            logs = [RECORDINGS / f"{case.name}.mcap"]
        else:
            riddle = case.draw()
            answer = riddle.answer
            logs = write_riddle(riddle, Path(scratch) / "run.mcap")
        for log in logs:
            try:
                analyze_log(log, Options(out=folder / _RESULTS, report=False, diagnosis=False))
            except SlipError as error:
                return f"{case.category} {case.name}: refused: {error}"
    (folder / _TRUTH).write_bytes(msgspec.json.encode(answer))
    return f"{case.category} {case.name}: {time.process_time() - begin:.1f} s"


def read_truth(case: Case, root: Path) -> Answer:
    """What a frozen log hides; of a recording only its category."""
    return msgspec.json.decode((case.folder(root) / _TRUTH).read_bytes(), type=Answer)


def answer(
    case: Case, root: Path, answers: str, inputs: Sequence[str] = INPUTS
) -> tuple[list[dict[str, Any]], float]:
    """Diagnose a frozen log, and keep the answer beside its tables."""
    said, spent = diagnose(case, root, inputs)
    path = case.folder(root) / f"{answers}.json"
    path.write_text(json.dumps({"cpu_s": spent, "runs": said}, indent=1), encoding="utf-8")
    return said, spent


def diagnose(case: Case, root: Path, inputs: Sequence[str] = INPUTS) -> tuple[list[dict[str, Any]], float]:
    """What `slip diagnose --json` says of a frozen log, and the CPU time that it took [s]."""
    read = [read_recording(manifest) for manifest in Store(case.folder(root) / _RESULTS).manifests()]
    begin = time.process_time()
    try:
        answer = diagnose_runs([recording for _, recording in read], read[0][0], inputs=inputs)
        told = json.loads(json.dumps([diagnosis_as_json(run) for run in answer.runs]))
    except SlipError as error:
        told = [{"error": error.code, "effects": [], "undecided": [], "unobservable": []}]
    return told, time.process_time() - begin


def compare(case: Case, root: Path, answers: str = _ANSWERS) -> Comparison:
    """The frozen answer beside that of the code as it is now."""
    frozen = json.loads((case.folder(root) / f"{answers}.json").read_text(encoding="utf-8"))
    told, spent = diagnose(case, root)
    largest, at, others = 0.0, "", list[str]()
    for place, old, new in walk(frozen["runs"], told):
        ratio = measure_difference(old, new)
        if ratio is None:
            others.append(f"{place}: {_shorten(old)} -> {_shorten(new)}")
        elif ratio > largest:
            largest, at = ratio, place
    truth = read_truth(case, root)
    summaries = summarize(truth, frozen["runs"]), summarize(truth, told)
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


def summarize(truth: Answer, runs: Sequence[Json]) -> str:
    """What an answer comes to, in one line."""
    said = sorted(str(effect["id"]) for effect in runs[0]["effects"])
    groups = ["|".join(sorted(group["candidates"])) for group in runs[0]["undecided"]]
    ladder = runs[0].get("ladder") or [{}]
    errors = " ".join(f"{ladder[-1].get(key, float('nan')):.4f}" for key in ("t_mrmse_m", "r_mrmse_rad"))
    flag = (runs[0].get("unexplained") or {}).get("channel", "")
    verdict = ""
    if truth.category != RECORDED:
        score = score_runs(truth, runs)
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
    return [Case(path.parent.parent.name, path.parent.name) for path in sorted(root.glob(f"*/*/{_TRUTH}"))]


@dataclass(frozen=True)
class Marks:
    """What an answer to a frozen log comes to.

    Attributes:
        groups: the lines of the table that it belongs to.
        score: the answer beside the truth.
        cpu_s: of the diagnosis [s].
    """

    groups: tuple[str, ...]
    score: TaskScore
    cpu_s: float


def examine(case: Case, root: Path, answers: str, inputs: Sequence[str] = INPUTS) -> Marks:
    """Diagnose a frozen log and score what was said."""
    said, spent = answer(case, root, answers, inputs)
    truth = read_truth(case, root)
    driving = "closed loop" if truth.program == "closed loop" else "programs"
    tables = {
        name for manifest in Store(case.folder(root) / _RESULTS).manifests() for name in manifest.tables
    }
    sensors = "encoders" if "wheels" in tables else "no encoders"
    groups = (case.category, driving, sensors, f"by {said[0].get('input', 'none')}", "all")
    return Marks(groups, score_runs(truth, said, f"{case.category} {case.name}"), spent)


def write_marks(marks: Sequence[Marks]) -> list[str]:
    """A table: of each group of logs how many are right, how many claims are wrong, missed and covered."""
    heads = ("logs", "right", "wrong name", "other false", "hidden", "named", "open", "missed", "numbers")
    lines = [f"{'':<14}" + "".join(f"{head:>12}" for head in (*heads, "hold", "CPU [s]"))]
    names = [name for kind in zip(*(one.groups for one in marks), strict=True) for name in sorted(set(kind))]
    for group in names:
        scores = [one.score for one in marks if group in one.groups]
        wrong = sum(bool(one.wrong_names) for one in scores)
        other = sum(bool(set(one.false) - set(one.wrong_names)) for one in scores)
        outcomes = [said for one in scores for name, said in one.outcomes.items() if name != "nothing"]
        intervals = [one.holds for score in scores for one in score.intervals]
        right = sum(not one.false and set(one.outcomes.values()) == {"right"} for one in scores)
        counts = [sum(said in kinds for said in outcomes) for kinds in (_NAMED, _OPEN, _MISSED)]
        held = f"{sum(intervals) / len(intervals):.1%}" if intervals else "-"
        cpu = statistics.median(one.cpu_s for one in marks if group in one.groups)
        values = (
            len(scores),
            right,
            wrong,
            other,
            len(outcomes),
            *counts,
            len(intervals),
            held,
            f"{cpu:.2f}",
        )
        lines.append(f"{group:<14}" + "".join(f"{value:>12}" for value in values))
    return [*lines, "", *list_misses([one.score for one in marks])]


_NAMED, _OPEN, _MISSED = {"right"}, {"undecided", "unobservable"}, {"abstained", "wrong"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("verb", choices=["write", "exam", "compare"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=parse_seeds, default=[])
    parser.add_argument("--categories", help="with commas; all where not given")
    parser.add_argument("--recordings", action="store_true", help="write those of ../shared/logs, too")
    parser.add_argument("--closed", action="store_true", help="every second seed in closed loop")
    parser.add_argument("--answers", default=_ANSWERS, help="name under which `exam` keeps what was said")
    parser.add_argument("--input", choices=["both", *INPUTS], default="both", help="for `exam`")
    parser.add_argument("--jobs", type=int, default=1)


def run(given: argparse.Namespace) -> None:
    """Write, examine or compare."""
    os.environ.update(dict.fromkeys(THREADS, "1"))
    wanted = given.categories.split(",") if given.categories else [*CATEGORIES, RECORDED]
    with ProcessPoolExecutor(given.jobs, multiprocessing.get_context("spawn")) as pool:
        if given.verb == "write":
            names = sorted(log.stem for log in RECORDINGS.glob("*.mcap")) if given.recordings else []
            cases = [Case(RECORDED, name) for name in names]
            seeds = [f"{seed}{'c' * (given.closed and seed % 2)}" for seed in given.seeds]
            cases += [Case(one, seed) for seed in seeds for one in wanted if one != RECORDED]
            for line in pool.map(freeze, cases, [given.folder] * len(cases)):
                print(line, flush=True)
            return
        cases = [case for case in list_cases(given.folder) if case.category in wanted]
        count = len(cases)
        if given.verb == "exam":
            drawn = [case for case in cases if case.category != RECORDED]
            count = len(drawn)
            inputs = INPUTS if given.input == "both" else (given.input,)
            same = ([one] * count for one in (given.folder, given.answers, inputs))
            marks = list(pool.map(examine, drawn, *same))
            print(*write_marks(marks), sep="\n")
            return
        ratios: dict[str, list[float]] = {}
        changed = 0
        for one in pool.map(compare, cases, [given.folder] * count, [given.answers] * count):
            changed += bool(one.others) or one.largest > 0.0
            ratios.setdefault(one.case.category, []).append(one.cpu_s[1] / one.cpu_s[0])
            print(*describe(one), sep="\n", flush=True)
    for category, values in ratios.items():
        print(f"{category:12} {len(values):4} logs   CPU {statistics.median(values):.2f} of before")
    print(f"{changed} of {len(cases)} answers differ")
