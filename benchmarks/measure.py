"""Measure what the tables of the handbook say, and write the tables.

What is done is kept in build/measured/<version of the diagnosis>: stopped at any
moment, the same command goes on. Each file of benchmarks/measured is written when its measurement is
complete, and the pages with it (measured_tables.py). Logs are drawn from seeds of their own for every version
of the diagnosis, so that none has been seen before. Recordings are those under ../shared/logs; without them
what needs them is left out, and it says so.
"""

import argparse
import json
import re
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from game.play import Record, read_records, read_version
from game.tables import has_wrong_name, is_clean, is_exact, is_flagged, is_narrowed, is_owned_up_to
from measured_tables import MEASURED, ROOT, list_versions
from measuring import RECORDINGS, RUNNER, read_rows
from published import PUBLISHED, ask_sets
from rivals import describe_sections

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.datasets.compare import compare_results
from pipeline.datasets.compared_runs import Question
from pipeline.store import Store

CATEGORIES = (
    "single",
    "small",
    "sets",
    "equipped",
    "cars",
    "natural",
    "late",
    "joint",
    "empty",
    "odd",
    "poor",
)
LOGS_EACH = 44
_PATIENCE_S = 900
_FIRST_SEED, _SEEDS_A_VERSION = 1_200_000, 1000
_PUBLISHED = {
    # Tile and snow as printed; ice is 3.6 times snow and 5 % below gravel, from which these two follow.
    "husky_wheels-deflated_tile_2023_12_12_16h16": ("Husky tile", 1.716, False),
    "husky_snow_boreal": ("Husky snow", 2.76, False),
    "warthog_gravel_1": ("Warthog gravel", 10.5, True),
    "warthog_wheels_ice_2024_7_30_16h30s21": ("Warthog ice", 9.9, True),
}
_RATIOS = (
    ("Husky snow over Husky tile", "Husky snow", "Husky tile", 1.6),
    ("Warthog ice over Husky snow", "Warthog ice", "Husky snow", 3.6),
    ("Warthog ice over Warthog gravel", "Warthog ice", "Warthog gravel", 0.95),
)


@dataclass(frozen=True)
class Asked:
    """What was asked for: logs of a category, logs at a time, and the folder for what is done."""

    logs: int
    jobs: int
    folder: Path


def measure_accuracy(asked: Asked) -> dict[str, object]:
    """The game of hidden effects on logs that were never drawn before."""
    first = _FIRST_SEED + _SEEDS_A_VERSION * list_versions()["diagnosis"]
    seeds = f"{first}-{first + asked.logs}"
    out = asked.folder / "played.jsonl"
    drawn = ("--category", ",".join(CATEGORIES), "--seeds", seeds)
    patience = ("--time-out", str(_PATIENCE_S), "--jobs", str(asked.jobs))
    run_beside("game/play", *drawn, *patience, "--out", str(out), "--resume")
    wanted = range(first, first + asked.logs)
    records = [one for one in read_records([out]).values() if one.job.seed in wanted]
    if late := sum(one.outcome == "timeout" for one in records):
        # A busy machine says nothing of the diagnosis.
        raise SystemExit(
            f"accuracy: {late} logs took longer than {_PATIENCE_S} s; the same command plays them again"
        )
    return {
        "command": "make bench NAME=measure ARGS=accuracy",
        "versions": {"diagnosis": list_versions()["diagnosis"]},
        "seeds": seeds,
        **summarize_records(records),
    }


def summarize_records(records: Sequence[Record]) -> dict[str, object]:
    """Counts by category, wrong names, and intervals that hold the truth."""
    rows = []
    for category in CATEGORIES:
        played = [one for one in records if one.job.category == category]
        if category == "poor" or not played:
            continue
        exact, narrowed = {"empty": (is_clean, is_clean), "odd": (is_flagged, is_owned_up_to)}.get(
            category, (is_exact, is_narrowed)
        )
        counted = played if category in {"empty", "odd"} else [one for one in played if not one.is_weak]
        rows.append(
            {
                "category": category,
                "counted": len(counted),
                "exact": sum(map(exact, counted)),
                "narrowed": sum(map(narrowed, counted)),
            }
        )
    asked = [one for one in records if one.job.category != "odd"]
    held = [one.holds for record in asked if not record.is_weak for one in record.score.intervals]
    return {
        "logs": len(asked),
        "wrong": sum(map(has_wrong_name, asked)),
        "rows": rows,
        "intervals": [{"held": sum(held), "of": len(held)}],
    }


def measure_rivals(source: str) -> Callable[[Asked], dict[str, object]]:
    """The named physics beside models of the literature and learned ones."""

    def measure(asked: Asked) -> dict[str, object]:
        rows = asked.folder / f"rivals_{source}.jsonl"
        run_beside(
            "rivals", "--results", str(asked.folder / "rivals"), "--input", source, "--rows", str(rows)
        )
        return {
            "command": f"make bench NAME=measure ARGS=rivals_{source}",
            "versions": {"diagnosis": list_versions()["diagnosis"]},
            "sections": describe_sections(read_rows(rows)),
        }

    return measure


def measure_paper(asked: Asked) -> dict[str, object]:
    """Medians of the published chain, each with the interval of its run, and their ratios."""
    store = Store(asked.folder / "paper")
    for name in _PUBLISHED:
        analyze_log(RECORDINGS / f"{name}.mcap", Options(out=store.root, report=False))
    answer = compare_results(store, Question(by=("run",), as_published=True))
    found = {row["dataset"].rsplit("/", 1)[-1]: row for row in answer.levels.to_dicts()}
    rows = [
        {"name": name, "paper": paper, "derived": derived, **round_interval(found[log])}
        for log, (name, paper, derived) in _PUBLISHED.items()
    ]
    named = {str(row["name"]): row for row in rows}
    ratios = [
        {"name": name, "paper": paper, **divide(named[above], named[below])}
        for name, above, below, paper in _RATIOS
    ]
    stages = {name: version for name, version in list_versions().items() if name in {"extract", "slip"}}
    command = "make bench NAME=measure ARGS=paper"
    return {"command": command, "versions": stages, "rows": rows, "ratios": ratios}


def measure_published(_: Asked) -> dict[str, object]:
    """What is said of public recordings with published answers."""
    rows = [{"set": name, **vars(one)} for name, one in ask_sets(PUBLISHED)]
    versions = {name: version for name, version in list_versions().items() if name in {"diagnosis", "slip"}}
    return {"command": "make bench NAME=published", "versions": versions, "rows": rows}


def round_interval(row: Mapping[str, float]) -> dict[str, float]:
    """A value and its interval."""
    return {key: round(float(row[key]), 4) for key in ("value", "low", "high")}


def divide(above: Mapping[str, object], below: Mapping[str, object]) -> dict[str, float]:
    """A ratio with its interval: both logarithms are taken as normal and independent."""
    (a, a_low, a_high), (b, b_low, b_high) = (
        [float(str(one[key])) for key in ("value", "low", "high")] for one in (above, below)
    )
    down = np.hypot(np.log(a / a_low), np.log(b_high / b))
    up = np.hypot(np.log(a_high / a), np.log(b / b_low))
    return round_interval({"value": a / b, "low": a / b * np.exp(-down), "high": a / b * np.exp(up)})


def run_beside(name: str, *words: str) -> None:
    """Run a benchmark; what it prints is kept out of ours.

    Raises:
        CalledProcessError: it failed.
    """
    subprocess.run([*RUNNER, name, *words], check=True, stdout=subprocess.DEVNULL)


def write_measured(name: str, content: Mapping[str, object]) -> None:
    """Write a file of measured numbers, short lists on one line."""
    about = {"command": content["command"], "commit": read_version(), "date": f"{datetime.now(UTC):%Y-%m-%d}"}
    text = json.dumps(about | dict(content), indent=1)
    item = r'(?:"[^"\[\]]*"|-?[\d.]+(?:e-?\d+)?)'
    short = re.sub(
        rf"\[\s+({item}(?:,\s+{item})*)\s+\]", lambda found: f"[{' '.join(found[1].split())}]", text
    )
    (MEASURED / f"{name}.json").write_text(short + "\n", encoding="utf-8")


MEASUREMENTS: dict[str, tuple[bool, Callable[[Asked], dict[str, object]]]] = {
    "paper": (True, measure_paper),
    "accuracy": (False, measure_accuracy),
    "published": (True, measure_published),
    "rivals_command": (True, measure_rivals("command")),
    "rivals_measured": (True, measure_rivals("measured")),
}
"""By the name of the file: whether recordings are needed, and what measures."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("names", nargs="*", help=f"which: {', '.join(MEASUREMENTS)} (default: all)")
    parser.add_argument("--jobs", type=int, default=2, help="logs at a time")
    parser.add_argument("--logs", type=int, default=LOGS_EACH, help="drawn logs of each category")


def run(chosen: argparse.Namespace) -> int:
    """Measure what is asked for, one after the other."""
    unknown = set(chosen.names) - set(MEASUREMENTS)
    if unknown:
        raise SystemExit(f"there is no {', '.join(sorted(unknown))}; there are {', '.join(MEASUREMENTS)}")
    folder = ROOT / "build" / "measured" / str(list_versions()["diagnosis"])
    folder.mkdir(parents=True, exist_ok=True)
    for name in chosen.names or MEASUREMENTS:
        needs_recordings, measure = MEASUREMENTS[name]
        recordings = PUBLISHED if measure is measure_published else RECORDINGS
        if needs_recordings and not any(recordings.rglob("*.mcap")):
            sys.stdout.write(f"{name}: skipped, no recordings in {recordings.name}\n")
            continue
        write_measured(name, measure(Asked(chosen.logs, chosen.jobs, folder)))
        sys.stdout.write(f"{name}: measured\n")
        sys.stdout.flush()
        run_beside("measured_tables")
    return 0
