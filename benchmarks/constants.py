"""What half and double of the numbers at the head of a file change: findings and medians of logs.

Each number of the files, where none is given of all rooms that decide answers, or each of a random sample of
them, is set to its value times each factor, alone, and the logs are analyzed again in this process. Prints
one line a number and factor: `same`, or what differs, and last how many numbers change what is said (a named
effect or a finding) and how many a median. A number that is used only while modules are imported, or by
compiled loops, keeps its value there: it is `same` whatever it is.
"""

import argparse
import importlib
import json
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import polars as pl
from house import EXPLAINED, list_constants, read_sources

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.core import SlipError

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


def compare(before: Mapping[str, float | str], after: Mapping[str, float | str]) -> list[str]:
    """What differs, in words: what is said begins with + or -, a median with its log."""
    differences: list[str] = []
    for key in sorted(before.keys() | after.keys()):
        old, new = before.get(key, "no"), after.get(key, "no")
        if isinstance(old, float) and isinstance(new, float):
            if abs(new - old) > _SAME * abs(old):
                differences.append(f"{key} {old:.4g} -> {new:.4g}")
        elif old != new:
            differences.append(f"{'+' if old == 'no' else '-'} {key}")
    return differences


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


def choose_numbers(files: Sequence[Path], names: Sequence[str]) -> list[tuple[str, str, float]]:
    """Module, name and value of the numbers of some files, without files of all rooms that decide answers."""
    wanted = {file.resolve().relative_to(ROOT) for file in files}
    chosen = []
    for source in read_sources(ROOT):
        if source.path in wanted if wanted else source.path.parts[1] in EXPLAINED:
            for constant in list_constants(source):
                value = getattr(importlib.import_module(source.module), constant.name)
                if isinstance(value, int | float) and (not names or constant.name in names):
                    chosen.append((source.module, constant.name, value))
    return chosen


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--names", nargs="*", default=[])
    parser.add_argument("--sample", type=int, help="how many of these numbers, at random")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--log", dest="logs", nargs="*", type=Path, default=list(LOGS))
    parser.add_argument("--factors", nargs="*", type=float, default=[0.5, 2.0])
    parser.add_argument("--diagnosis", action="store_true")


def run(asked: argparse.Namespace) -> None:
    """Print what each number does."""
    numbers = every = choose_numbers(asked.files, asked.names)
    if asked.sample is not None:
        chance = np.random.default_rng(asked.seed)
        numbers = [every[index] for index in chance.permutation(len(every))[: asked.sample]]
    before = judge(asked.logs, diagnosis=asked.diagnosis)
    speaking, moving = 0, 0
    for module, name, value in numbers:
        changes = list[str]()
        for factor in asked.factors:
            with replace_number(module, name, factor):
                differences = compare(before, judge(asked.logs, diagnosis=asked.diagnosis))
            words = "; ".join(differences) or "same"
            print(f"{module.removeprefix('pipeline.')}.{name} = {value:g} x {factor:g}: {words}", flush=True)
            changes += differences
        speaking += any(one[0] in "+-" for one in changes)
        moving += any(one[0] not in "+-" for one in changes)
    print(
        f"{speaking} of {len(numbers)} numbers, {len(every)} in all, change what is said, {moving} a median"
    )
