"""What verbs print: JSON on stdout, errors and progress on stderr, and the exit codes."""

from __future__ import annotations

import json
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from pipeline.core.errors import SlipError

CLEAN = 0
FAILED = 1
USAGE = 2
LOSSY = 3

_DOING = {
    "read": "reading the log",
    "extract": "extracting commands and poses",
    "velocity": "differentiating poses",
    "slip": "computing slip",
    "aggregate": "aggregating",
    "diagnosis": "looking for missing effects",
    "report": "drawing the report",
}


def print_json(content: Mapping[str, object]) -> None:
    """One JSON object on stdout."""
    sys.stdout.write(json.dumps(content, indent=1, allow_nan=False) + "\n")


def print_error(error: SlipError) -> None:
    """One line on stderr."""
    sys.stderr.write(f"slip: {' '.join(str(error).split())}\n")


def describe_error(path: str, error: SlipError) -> dict[str, str]:
    """An error as it stands in the JSON output."""
    where = f" ({error.where})" if error.where and error.where != path else ""
    return {"path": path, "code": error.code, "message": f"{error.what}{where}", "hint": error.hint}


def exit_code(errors: Sequence[object], *, lossy: bool) -> int:
    """Exit code of a verb over several logs."""
    if errors:
        return FAILED
    return LOSSY if lossy else CLEAN


def _write_line(text: str) -> None:
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


@contextmanager
def show_progress(title: str, *, quiet: bool) -> Iterator[Callable[[str], None]]:
    """Tell on stderr what is being done: a spinner on a terminal, plain lines otherwise."""
    if quiet:
        yield lambda _stage: None
        return
    if not sys.stderr.isatty():
        yield lambda stage: _write_line(f"{title}: {_DOING.get(stage, stage)}")
        return
    from rich.console import Console  # noqa: PLC0415 - only for people at a terminal
    from rich.markup import escape  # noqa: PLC0415

    with Console(stderr=True).status(escape(title)) as status:
        yield lambda stage: status.update(f"{escape(title)}: {_DOING.get(stage, stage)}")
