"""What half and double of the numbers at the head of a file change: findings and medians of logs.

    python benchmarks/constants.py FILE... [--names NAME ...] [--log LOG ...] [--factors 0.5 2] [--diagnosis]

Each number of each file is set to its value times each factor, alone, and the logs are analyzed again in this
process. Prints one line a number and factor: `same`, or what differs, and last how many numbers change an
answer. A number that is used only while modules are imported, or by compiled loops, keeps its value there: it
is `same` whatever it is.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import polars as pl
from house import list_constants, read_sources

from pipeline.core import SlipError
from pipeline.job import Options
from pipeline.job.analyze import analyze_log

ROOT = Path(__file__).parents[1]
LOGS = tuple(ROOT / "data_samples" / f"{name}.mcap" for name in ("husky_tile", "mystery_2", "warthog_ice"))
_SAME = 1e-3  # relative change of a median that nobody would see


def judge(logs: list[Path], *, diagnosis: bool) -> dict[str, float | str]:
    """Findings, medians and, where asked for, named effects with their numbers, by log and name."""
    answers: dict[str, float | str] = {}
    with tempfile.TemporaryDirectory() as folder:
        for log in logs:
            options = Options(out=Path(folder), report=False, diagnosis=diagnosis)
            try:
                summary = json.loads(json.dumps(analyze_log(log, options).summary))
            except (SlipError, ArithmeticError, LookupError, ValueError, pl.exceptions.PolarsError) as error:
                answers[f"{log.stem} fails"] = type(error).__name__
                continue
            for finding in summary["findings"]:
                answers[f"{log.stem} {finding['id']} {finding.get('where', '')}".strip()] = "found"
            answers[f"{log.stem} modulus"] = summary["median_modulus"] or 0.0
            answers[f"{log.stem} window norm"] = summary["median_window_norm"] or 0.0
            named = (summary["diagnosis"] or {}).get("effects", [])
            answers |= {f"{log.stem} {effect['id']}": "named" for effect in named}
    return answers


def compare(before: Mapping[str, float | str], after: Mapping[str, float | str]) -> str:
    """What differs, in words; `same` where nothing does."""
    differences = []
    for key in sorted(before.keys() | after.keys()):
        old, new = before.get(key, "no"), after.get(key, "no")
        if isinstance(old, float) and isinstance(new, float):
            if abs(new - old) > _SAME * abs(old):
                differences.append(f"{key} {old:.4g} -> {new:.4g}")
        elif old != new:
            differences.append(f"{'+' if old == 'no' else '-'} {key}")
    return "; ".join(differences) or "same"


@contextmanager
def replace_number(module: str, name: str, factor: float) -> Iterator[None]:
    """A number times a factor, in its module and wherever it was imported; whole numbers stay whole."""
    home = importlib.import_module(module)
    value = getattr(home, name)
    other = max(round(value * factor), 1) if isinstance(value, int) else value * factor
    others = [one for key, one in list(sys.modules.items()) if key.startswith("pipeline")]
    # A private name is another number in another file.
    holders = [home] if name.startswith("_") else [one for one in others if getattr(one, name, None) is value]
    for holder in holders:
        setattr(holder, name, other)
    try:
        yield
    finally:
        for holder in holders:
            setattr(holder, name, value)


def main() -> None:
    """Print what each number does."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--names", nargs="*", default=[])
    parser.add_argument("--log", dest="logs", nargs="*", type=Path, default=list(LOGS))
    parser.add_argument("--factors", nargs="*", type=float, default=[0.5, 2.0])
    parser.add_argument("--diagnosis", action="store_true")
    asked = parser.parse_args()
    wanted = {file.resolve().relative_to(ROOT) for file in asked.files}
    before = judge(asked.logs, diagnosis=asked.diagnosis)
    tried, deciding = 0, 0
    for source in read_sources(ROOT):
        for constant in list_constants(source) if source.path in wanted else []:
            value = getattr(importlib.import_module(source.module), constant.name)
            if not isinstance(value, int | float) or (asked.names and constant.name not in asked.names):
                continue
            changes = set[str]()
            for factor in asked.factors:
                with replace_number(source.module, constant.name, factor):
                    words = compare(before, judge(asked.logs, diagnosis=asked.diagnosis))
                changes.add(words)
                print(f"{source.path.stem}.{constant.name} = {value:g} x {factor:g}: {words}", flush=True)
            tried, deciding = tried + 1, deciding + (changes != {"same"})
    print(f"{deciding} of {tried} numbers change an answer")


if __name__ == "__main__":
    main()
