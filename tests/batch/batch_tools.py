"""What the tests of batches share: asking for one, and reading what it left."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.batch import Request
from pipeline.batch.batch_work import work_on
from pipeline.batch.season import Line, Outcome, run_batch
from pipeline.job import Options

if TYPE_CHECKING:
    from collections.abc import Callable

HERE = Path(__file__).parent
IMPORTABLE = os.pathsep.join(map(str, (HERE, HERE.parent, HERE.parents[1])))
"""PYTHONPATH of a fresh process in which these tests can be imported."""


class Watch:
    """Remembers what it was told."""

    def __init__(self) -> None:
        self.plans: list[tuple[int, int]] = []
        self.lines: list[Line] = []

    def plan(self, todo: int, settled: int, size: int) -> None:
        assert size >= 0
        self.plans.append((todo, settled))

    def notify(self, line: Line, size: int) -> None:
        assert size >= 0
        self.lines.append(line)


def ask(
    logs: Path | str, out: Path, *, report: bool = False, force: bool = False, **changes: object
) -> Request:
    """A request with small limits."""
    given: dict[str, object] = {"jobs": 2, "settle_s": 0.0, "timeout_s": 60.0, "executor": "inline"}
    options = Options(out=out, report=report, force=force)
    return Request(targets=(str(logs),), options=options, **(given | changes))  # type: ignore[arg-type]


def batch(
    logs: Path | str, out: Path, *, work: Callable[..., object] = work_on, **changes: object
) -> Outcome:
    return run_batch(ask(logs, out, **changes), Watch(), work)  # type: ignore[arg-type]


def counts(outcome: Outcome) -> dict[str, int]:
    """The counts that are not zero."""
    return {state: count for state, count in outcome.counts.items() if count}


def read_tables(out: Path) -> dict[str, bytes]:
    """Every table and text of the results that people read, by its path."""
    return {
        str(path.relative_to(out)): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file() and path.suffix in {".parquet", ".json", ".html"} and not is_note(path, out)
    }


def is_note(path: Path, out: Path) -> bool:
    inside = path.relative_to(out).parts
    return inside[0] in {"batch", "identities"} or "latest" in inside


def start_slip(*arguments: object) -> subprocess.Popen[str]:
    """`slip` in a process group of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "pipeline", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=os.environ | {"PYTHONPATH": IMPORTABLE},
    )
