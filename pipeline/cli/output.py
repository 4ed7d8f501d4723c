"""What verbs print: JSON on stdout, errors and progress on stderr, and the exit codes."""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING

from pipeline.analysis.options import STAGE_WORDS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from pipeline.core.errors import SlipError

CLEAN = 0
FAILED = 1
USAGE = 2
LOSSY = 3

_DOING = {**STAGE_WORDS, "diagnosis": "looking for missing effects"}


# Control characters, line ends, marks that turn the direction of writing, and bytes that are no text.
_UNPRINTABLE = re.compile(
    r"[\x00-\x1f\x7f-\x9f\u2028\u2029\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)

# Where fields begin; the narrowest screen that has room for them; the column that none hangs beyond.
_FIELD = re.compile(r"(?:^|(?<=  ))\S")
_NARROWEST = 40
_DEEPEST = 38
# Commands and places, which are copied from the screen, stay in one line.
_COPIED = ("next ", "play ", "page ", "report ")


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
    """Lines on stdout, each one line whatever names stand in it, folded where a screen is narrower."""
    width = _measure_screen()
    sys.stdout.write("".join(f"{part}\n" for line in lines for part in fold_line(tidy_line(line), width)))


def _measure_screen() -> int:
    """Columns that are there, or said by COLUMNS; 0 where nobody looks: what a file takes in stays whole."""
    told = os.environ.get("COLUMNS", "")
    seen = int(told) if told.isdecimal() else 0
    return seen or (shutil.get_terminal_size().columns if sys.stdout.isatty() else 0)


def fold_line(line: str, width: int) -> list[str]:
    """A line in parts of at most `width` columns, each below the field that it goes on with.

    Fields stand two spaces or more apart. What begins in the right half goes to the next line as a whole; a
    longer text is broken between its words. A single word that is too long stays as it is.
    """
    if width < _NARROWEST or len(line) <= width or line.startswith(_COPIED):
        return [line]
    starts = [found.start() for found in _FIELD.finditer(line)]
    begun = [start for start in starts if start <= min(width // 2, _DEEPEST)] or starts[:1] or [0]
    later = [start for start in starts if begun[-1] < start <= width]
    hang, cut = begun[-1], later[-1] if later else _find_break(line, begun[-1], width)
    if cut <= hang:
        cut = line.find(" ", width)
        if cut < 0:
            return [line]
    rest = line[cut:].strip()
    return [line[:cut].rstrip(), *fold_line(" " * hang + rest, width)] if rest else [line[:cut].rstrip()]


def _find_break(line: str, hang: int, width: int) -> int:
    """The last space that a line has room for; a number stays with its unit."""
    last = cut = line.rfind(" ", hang, width + 1)
    while cut > hang and line[cut - 1].isdigit():
        cut = line.rfind(" ", hang, cut)
    return cut if cut > hang else last


def print_json(content: Mapping[str, object]) -> None:
    """One JSON object on stdout."""
    sys.stdout.write(json.dumps(content, indent=1, allow_nan=False) + "\n")


def print_result(
    content: Mapping[str, object], describe: Callable[[], Iterable[str]], *, json: bool, quiet: bool = False
) -> int:
    """Print what a verb found, as one JSON object or as lines for people; the exit code of success."""
    if json:
        print_json(content)
    elif not quiet:
        print_lines(describe())
    return CLEAN


def print_error(error: SlipError) -> None:
    """One line on stderr."""
    say(f"slip: {' '.join(str(error).split())}")


def describe_error(path: str, error: SlipError) -> dict[str, str]:
    """An error as it stands in the JSON output."""
    where = f" ({error.where})" if error.where and error.where != path else ""
    return {"path": path, "code": error.code, "message": f"{error.what}{where}", "hint": error.hint}


def say_state(state: str) -> str:
    """What a log came out as, in words."""
    words = {"lossy": "with losses", "copy": "copies", "growing": "being written"}
    return {**words, "left": "not begun", "skipped": "left out"}.get(state, state)


def say_value(value: object) -> str:
    """A number with three digits; a dash where there is none."""
    return f"{value:.3g}" if isinstance(value, int | float) else "-"


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
