"""Frozen answers: logs taken through the stages once, with the answer of one version of the diagnosis.

    python benchmarks/hidden/freeze.py write FOLDER --seeds 910000-910012 [--categories C] [--recordings]
    python benchmarks/hidden/freeze.py compare FOLDER [--jobs 2]

`write` keeps a folder for each log: its tables, its hidden answer, and what `slip diagnose` says of it, with
the CPU time that it took. It goes on where it was stopped. `compare` diagnoses the same tables with the code
as it is now and prints every answer that differs, and the ratio of CPU times by category.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from draw import CATEGORIES, Answer, draw_riddle, open_seal, write_riddle
from play import parse_seeds
from score import score_runs

from pipeline.core import SlipError
from pipeline.estimation import Recording, diagnose_runs
from pipeline.job import Options
from pipeline.job.analyze import analyze_log
from pipeline.job.run_results import read_recording
from pipeline.sources import Vehicle
from pipeline.store import Store

LOGS = Path(__file__).parents[2] / ".." / "shared" / "logs"
RECORDINGS = "recordings"
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "POLARS_MAX_THREADS")
_ANSWER, _FROZEN, _RESULTS = "answer.sealed", "frozen.json", "results"


@dataclass(frozen=True)
class Case:
    """A frozen log: of a category and a seed, or a recording by its name."""

    category: str
    name: str

    def folder(self, root: Path) -> Path:
        """Where it is kept."""
        return root / self.category / self.name


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
        if case.category == RECORDINGS:
            logs, sealed = [LOGS / f"{case.name}.mcap"], ""
        else:
            riddle = draw_riddle(case.category, int(case.name), None)  # type: ignore[arg-type]
            logs = write_riddle(riddle, Path(scratch) / "run.mcap")
            sealed = (Path(scratch) / "run.sealed").read_text(encoding="ascii")
        for log in logs:
            analyze_log(log, Options(out=folder / _RESULTS, report=False, diagnosis=False))
    (folder / _ANSWER).write_text(sealed, encoding="ascii")
    told, spent = diagnose(case, root)
    (folder / _FROZEN).write_text(json.dumps({"cpu_s": spent, "runs": told}, indent=1), encoding="utf-8")
    return f"{case.category} {case.name}: {spent:.1f} s"


def load(case: Case, root: Path) -> tuple[Vehicle, list[Recording], Answer]:
    """The tables of a frozen log, and what it hides."""
    folder = case.folder(root)
    read = [read_recording(manifest) for manifest in Store(folder / _RESULTS).manifests()]
    sealed = (folder / _ANSWER).read_text(encoding="ascii")
    return read[0][0], [recording for _, recording in read], open_seal(sealed) if sealed else Answer({})


def diagnose(case: Case, root: Path) -> tuple[list[dict[str, Any]], float]:
    """What `slip diagnose --json` says of a frozen log, and the CPU time that it took [s]."""
    vehicle, recordings, _ = load(case, root)
    begin = time.process_time()
    try:
        told = json.loads(json.dumps(diagnose_runs(recordings, vehicle).to_json()))
    except SlipError as error:
        told = [{"error": error.code, "effects": [], "undecided": [], "unobservable": []}]
    return told, time.process_time() - begin


def compare(case: Case, root: Path) -> dict[str, Any]:
    """The frozen answer beside that of the code as it is now."""
    frozen = json.loads((case.folder(root) / _FROZEN).read_text(encoding="utf-8"))
    answer, (told, spent) = load(case, root)[2], diagnose(case, root)
    lines = [summarize(case, answer, runs) for runs in (frozen["runs"], told)]
    return {"case": case, "before": lines[0], "after": lines[1], "cpu": (frozen["cpu_s"], spent)}


def summarize(case: Case, answer: Answer, runs: Sequence[dict[str, Any]]) -> str:
    """What an answer comes to, in one line."""
    said = sorted(str(effect["id"]) for effect in runs[0]["effects"])
    groups = ["|".join(sorted(group["candidates"])) for group in runs[0]["undecided"]]
    ladder = runs[0].get("ladder") or [{}]
    errors = " ".join(f"{ladder[-1].get(key, float('nan')):.4f}" for key in ("t_mrmse_m", "r_mrmse_rad"))
    flag = (runs[0].get("unexplained") or {}).get("channel", "")
    verdict = ""
    if case.category != RECORDINGS:
        score = score_runs(answer, runs)
        verdict = "exact; " if score.is_exact else f"missed {list(score.missed)} false {list(score.false)}; "
    return f"{verdict}{', '.join(said) or 'nothing'} {groups or ''} {flag} | {errors}"


def list_cases(root: Path) -> Iterator[Case]:
    """All that is frozen."""
    for path in sorted(root.glob(f"*/*/{_FROZEN}")):
        yield Case(path.parent.parent.name, path.parent.name)


def write_all(root: Path, cases: Sequence[Case], jobs: int) -> None:
    """Freeze logs."""
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        for line in pool.map(freeze, cases, [root] * len(cases)):
            print(line, flush=True)


def compare_all(root: Path, jobs: int) -> None:
    """Print answers that differ, and CPU by category."""
    cases = list(list_cases(root))
    ratios: dict[str, list[float]] = {}
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        for line in pool.map(compare, cases, [root] * len(cases)):
            case, (before_s, after_s) = line["case"], line["cpu"]
            ratios.setdefault(case.category, []).append(after_s / before_s)
            if line["before"] != line["after"]:
                print(f"{case.category} {case.name}\n  {line['before']}\n  {line['after']}", flush=True)
    for category, values in ratios.items():
        print(f"{category:12} {len(values):4} logs   CPU {statistics.median(values):.2f} of before")


def main() -> int:
    """Read the command line and work."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("verb", choices=["write", "compare"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=parse_seeds, default=[])
    parser.add_argument("--categories", default=",".join(CATEGORIES))
    parser.add_argument("--recordings", action="store_true")
    parser.add_argument("--jobs", type=int, default=1)
    asked = parser.parse_args()
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    if asked.verb == "compare":
        compare_all(asked.folder, asked.jobs)
        return 0
    cases = [Case(RECORDINGS, log.stem) for log in sorted(LOGS.glob("*.mcap"))] if asked.recordings else []
    cases += [Case(category, str(seed)) for seed in asked.seeds for category in asked.categories.split(",")]
    write_all(asked.folder, cases, asked.jobs)
    return 0


if __name__ == "__main__":
    sys.exit(main())
