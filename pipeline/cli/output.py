"""What verbs print: JSON on stdout, errors and progress on stderr, and the exit codes."""

from __future__ import annotations

import json
import re
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from pipeline.core.errors import SlipError

CLEAN = 0
FAILED = 1
USAGE = 2
LOSSY = 3

_DOING = {
    "read": "reading the log",
    "extract": "extracting commands and poses",
    "align": "putting clocks and scales right",
    "velocity": "differentiating poses",
    "slip": "computing slip",
    "aggregate": "aggregating",
    "diagnosis": "looking for missing effects",
    "report": "drawing the report",
}


# Control characters, line ends, marks that turn the direction of writing, and bytes that are no text.
_UNPRINTABLE = re.compile(
    r"[\x00-\x1f\x7f-\x9f\u2028\u2029\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)


def tidy_line(text: str) -> str:
    """A line as it may reach a screen: names in it must neither move the cursor nor begin a line."""
    return _UNPRINTABLE.sub(lambda found: _spell_out(found[0]), text)


def _spell_out(character: str) -> str:
    code = ord(character)
    # Bytes of a file name that are no text come in as these.
    if 0xDC80 <= code <= 0xDCFF:  # noqa: PLR2004
        return f"\\x{code - 0xDC00:02x}"
    return character.encode("unicode_escape", "surrogatepass").decode("ascii")


def print_lines(lines: Iterable[str]) -> None:
    """Lines on stdout, each of them one line whatever names stand in it."""
    sys.stdout.write("".join(f"{tidy_line(line)}\n" for line in lines))


def print_json(content: Mapping[str, object]) -> None:
    """One JSON object on stdout."""
    sys.stdout.write(json.dumps(content, indent=1, allow_nan=False) + "\n")


def print_error(error: SlipError) -> None:
    """One line on stderr."""
    say(f"slip: {' '.join(str(error).split())}")


def describe_error(path: str, error: SlipError) -> dict[str, str]:
    """An error as it stands in the JSON output."""
    where = f" ({error.where})" if error.where and error.where != path else ""
    return {"path": path, "code": error.code, "message": f"{error.what}{where}", "hint": error.hint}


def exit_code(errors: Sequence[object], *, lossy: bool) -> int:
    """Exit code of a verb over several logs."""
    if errors:
        return FAILED
    return LOSSY if lossy else CLEAN


def say(text: str) -> None:
    """One line on stderr, at once."""
    sys.stderr.write(f"{tidy_line(text)}\n")
    sys.stderr.flush()


@contextmanager
def show_progress(title: str, *, quiet: bool) -> Iterator[Callable[[str], None]]:
    """Tell on stderr what is being done: a spinner on a terminal, plain lines otherwise."""
    if quiet:
        yield lambda _stage: None
        return
    if not sys.stderr.isatty():
        yield lambda stage: say(f"{title}: {_DOING.get(stage, stage)}")
        return
    from rich.console import Console  # noqa: PLC0415 - only for people at a terminal
    from rich.markup import escape  # noqa: PLC0415

    name = escape(tidy_line(title))
    with Console(stderr=True).status(name) as status:
        yield lambda stage: status.update(f"{name}: {_DOING.get(stage) or escape(tidy_line(stage))}")
