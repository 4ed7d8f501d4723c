"""What verbs share: options, where results go, what is printed, exit codes, memory that ran out."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

from cyclopts import Parameter
from cyclopts.types import PositiveFloat

from pipeline.analysis import STAGE_WORDS, Options
from pipeline.core import INPUTS, SlipError, limit_memory, measure_memory

if TYPE_CHECKING:
    from pipeline.analysis.analyze import OpenedRun
    from pipeline.store import Mirror, Store

CLEAN = 0
FAILED = 1
USAGE = 2
LOSSY = 3

_DOING = {**STAGE_WORDS, "diagnosis": "estimating effects"}

# Control characters, line separators, bidirectional formatting characters, and undecodable bytes.
_UNPRINTABLE = re.compile(
    r"[\x00-\x1f\x7f-\x9f\u2028\u2029\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)

# Start of a field; width of the narrowest screen to fold for; largest indentation of continuation lines.
_FIELD = re.compile(r"(?:^|(?<=  ))\S")
_NARROWEST = 40
_DEEPEST = 38
_HANG = 10  # of a row whose second field is far to the right, as wide as the labels of a summary

# Commands and paths, which users copy from the screen, are not folded.
_COPIED = ("next ", "play ", "page ", "report ")


def tidy_line(text: str) -> str:
    """A line as it may reach a screen: names in it must neither move the cursor nor begin a line."""
    return _UNPRINTABLE.sub(lambda match: _spell_out(match[0]), text)


def _spell_out(character: str) -> str:
    code = ord(character)
    # Surrogates that represent undecodable bytes of a file name.
    if 0xDC80 <= code <= 0xDCFF:  # noqa: PLR2004
        return f"\\x{code - 0xDC00:02x}"
    return character.encode("unicode_escape", "surrogatepass").decode("ascii")


def print_lines(lines: Iterable[str]) -> None:
    """Lines on stdout, each one line whatever names stand in it, folded where a screen is narrower."""
    width = _measure_screen()
    sys.stdout.write("".join(f"{part}\n" for line in lines for part in fold_line(tidy_line(line), width)))


def _measure_screen() -> int:
    """Columns of the terminal, or COLUMNS if set; 0 (no folding) if the output is not a terminal."""
    width = os.environ.get("COLUMNS", "")
    seen = int(width) if width.isdecimal() else 0
    return seen or (shutil.get_terminal_size().columns if sys.stdout.isatty() else 0)


def fold_line(line: str, width: int) -> list[str]:
    """A line in parts of at most `width` columns, each below the field that it goes on with.

    Fields stand two spaces or more apart. What begins in the right half goes to the next line as a whole; a
    longer text is broken between its words. A single word that is too long stays as it is.
    """
    if width < _NARROWEST or len(line) <= width or line.startswith(_COPIED):
        return [line]
    starts = [match.start() for match in _FIELD.finditer(line)]
    near = [start for start in starts if start <= min(width // 2, _DEEPEST)] or starts[:1] or [0]
    later = [start for start in starts if near[-1] < start <= width]
    hang, cut = near[-1], later[-1] if later else _find_break(line, near[-1], width)
    if cut <= hang:
        cut = line.find(" ", width)
        if cut < 0:
            return [line]
    rest, hang = line[cut:].strip(), hang or (_HANG if later else 0)
    return [line[:cut].rstrip(), *fold_line(" " * hang + rest, width)] if rest else [line[:cut].rstrip()]


def _find_break(line: str, hang: int, width: int) -> int:
    """Position of the last space within the width; a number is not separated from its unit."""
    last = cut = line.rfind(" ", hang, width + 1)
    while cut > hang and line[cut - 1].isdigit():
        cut = line.rfind(" ", hang, cut)
    return cut if cut > hang else last


def print_json(content: Mapping[str, object]) -> None:
    """One JSON object on stdout."""
    sys.stdout.write(json.dumps(content, indent=1, allow_nan=False) + "\n")


def print_result(
    content: Mapping[str, object],
    format_lines: Callable[[], Iterable[str]],
    *,
    json: bool,
    quiet: bool = False,
) -> int:
    """Print the result of a verb, as one JSON object or as lines for people; the exit code of success."""
    if json:
        print_json(content)
    elif not quiet:
        print_lines(format_lines())
    return CLEAN


def print_error(error: SlipError) -> None:
    """One line on stderr."""
    print_note(f"slip: {' '.join(str(error).split())}")


def summarize_error(path: str, error: SlipError) -> dict[str, str]:
    """An error as it stands in the JSON output."""
    where = f" ({error.where})" if error.where and error.where != path else ""
    return {"path": path, "code": error.code, "message": f"{error.what}{where}", "hint": error.hint}


def format_counts(counts: Mapping[str, int], width: int = 0) -> list[str]:
    """How many logs came out in each state, in a column of a width; none refused is nothing to say."""
    return [
        f"{format_state(state):<14}{count:>{width}}"
        for state, count in counts.items()
        if count or state != "refused"
    ]


EXPLAINED = ("refused", "lossy", "failed", "quarantined", "growing", "skipped")
"""States of logs that need a look, in the order in which they are listed."""


def explain_logs(title: str, logs: Iterable[tuple[str, str, str]]) -> list[str]:
    """Paths of logs, why they came out so, and what to do, below a title; nothing without any."""
    lines = [
        text
        for path, reason, hint in logs
        for text in (f"  {path}", f"      {reason}", *([f"      {hint}"] if hint else []))
    ]
    return ["", title, *lines] if lines else []


def format_state(state: str) -> str:
    """What a log came out as, in words."""
    words = {"lossy": "with losses", "copy": "copies", "growing": "being written"}
    return {**words, "left": "not started", "skipped": "left out"}.get(state, state)


def format_value(value: object) -> str:
    """A number with three digits; a dash where there is none."""
    return f"{value:.3g}" if isinstance(value, int | float) else "-"


def exit_code(errors: Sequence[object], *, lossy: bool) -> int:
    """Exit code of a verb over several logs."""
    if errors:
        return FAILED
    return LOSSY if lossy else CLEAN


def print_note(text: str) -> None:
    """One line on stderr, at once."""
    sys.stderr.write(f"{tidy_line(text)}\n")
    sys.stderr.flush()


def print_warnings(texts: Iterable[str]) -> None:
    """Print warnings on standard error, a line each."""
    for text in texts:
        print_note(f"slip: {text}")


@contextmanager
def show_progress(title: str, *, quiet: bool) -> Iterator[Callable[[str], None]]:
    """Tell on stderr what is being done: a spinner on a terminal, plain lines otherwise."""
    if quiet:
        yield lambda _stage: None
        return
    if not sys.stderr.isatty():
        yield lambda stage: print_note(f"{title}: {_DOING.get(stage, stage)}")
        return
    from rich.console import Console  # noqa: PLC0415 - only for people at a terminal
    from rich.markup import escape  # noqa: PLC0415

    name = escape(tidy_line(title))
    with Console(stderr=True).status(name) as status:
        yield lambda stage: status.update(f"{name}: {_DOING.get(stage) or escape(tidy_line(stage))}")


_SHARE = 0.8
"""Default memory limit as a fraction of the machine's memory; other processes need the rest."""


@contextmanager
def limited_memory(
    size: str | None,
    name_log: Callable[[], str],
    conclude: Callable[[SlipError], None],
) -> Iterator[None]:
    """End the program with one line when it holds too much memory.

    Args:
        size: memory limit, for example ``2GB``; None for a share of the machine's.
        name_log: which file is being worked on.
        conclude: prints the results so far, where JSON was asked for.

    Raises:
        BatchError: ``bad_size``.
    """
    limit = int(_SHARE * measure_memory()) if size is None else _parse_size(size)

    def give_up(held: int) -> None:
        what = f"it used {held / 1e9:.2g} GB of memory, more than {limit / 1e9:.2g} GB"
        hint = "Give it more with --memory, or leave the log out"
        error = SlipError("out_of_memory", what, where=name_log(), hint=hint)
        print_error(error)
        conclude(error)
        sys.stdout.flush()
        # Only this ends a library's computation. As after a kill, the previous results are intact.
        os._exit(FAILED)

    with limit_memory(limit, give_up):
        yield


def _parse_size(text: str) -> int:
    from pipeline.batch import parse_size  # noqa: PLC0415 - heavy

    return parse_size(text)


Results: TypeAlias = Annotated[Path, Parameter(help="results folder")]

All: TypeAlias = Annotated[bool, Parameter(name="--all", negative=())]
"""Whether to show the whole summary, or only the verdict, the main effects and the remaining error."""


@dataclass(frozen=True, kw_only=True)
class Choices:
    """What may be said on the command line in place of a configuration file."""

    vehicle: Annotated[str | None, Parameter(help="vehicle preset, for example husky_a200")] = None
    wheel_radius: Annotated[
        PositiveFloat | None, Parameter(help="wheel radius [m], in place of a vehicle")
    ] = None
    track_width: Annotated[PositiveFloat | None, Parameter(help="track width [m], in place of a vehicle")] = (
        None
    )
    dataset: Annotated[str | None, Parameter(help="dataset the run belongs to")] = None
    terrain: Annotated[str | None, Parameter(help="terrain driven on")] = None
    input: Annotated[Literal["command", "measured", "both"], Parameter(help="input of the ideal model")] = (
        "both"
    )
    config: Annotated[
        Path | None, Parameter(help="configuration file in place of run.toml beside the log")
    ] = None
    yaw: Annotated[
        Literal["pose", "imu"] | None,
        Parameter(help="source of the yaw rate in the slip tables (default: pose)"),
    ] = None
    interval: Annotated[
        Literal["recorded", "all"],
        Parameter(help="recorded: only intervals with live commands; all: the whole log"),
    ] = "recorded"
    max_inflated: Annotated[
        str | None,
        Parameter(
            help="largest decompressed size of a log, for example 20GB (default: 200 times its size, at "
            "least 512 MiB)"
        ),
    ] = None
    results: Results = Path("results")


def build_options(choices: Choices) -> Options:
    """Options of a job from the choices on the command line, without a report.

    Raises:
        BatchError: ``bad_size``.
    """
    return Options(
        max_inflated=None if choices.max_inflated is None else _parse_size(choices.max_inflated),
        out=choices.results,
        config=choices.config,
        overrides=_list_overrides(choices),
        inputs=INPUTS if choices.input == "both" else (choices.input,),
        report=False,
    )


def spell_choices(choices: Choices) -> str:
    """What was said on the command line, to be said again: ` --input measured`; empty where nothing was."""
    said = ((each.name, getattr(choices, each.name)) for each in fields(choices))
    return spell_flags({name: value for name, value in said if value != getattr(Choices(), name)})


def spell_flags(values: Mapping[str, object]) -> str:
    """Flags with their values, a space before each; what is None is left out."""
    said = {name: value for name, value in values.items() if value is not None}
    return "".join(f" --{name.replace('_', '-')} {shlex.quote(str(value))}" for name, value in said.items())


def _list_overrides(choices: Choices) -> Mapping[str, object]:
    """Configuration values from the command line."""
    said: dict[str, dict[str, object]] = {
        "vehicle": {
            "preset": choices.vehicle,
            "wheel_radius_m": choices.wheel_radius,
            "track_width_m": choices.track_width,
        },
        "run": {"dataset": choices.dataset, "terrain": choices.terrain},
        "velocity": {"yaw": choices.yaw},
    }
    given_again: dict[str, object] = {}
    for section, values in said.items():
        given = {key: value for key, value in values.items() if value is not None}
        if given:
            given_again[section] = given
    if choices.interval == "all":
        given_again["use_intervals"] = "all"
    return given_again


@dataclass(frozen=True)
class ResultsLocation:
    """Where results are.

    Attributes:
        root: their folder, or that of their mirror.
        mirror: the mirror; None for a folder.
    """

    root: Path
    mirror: Mirror | None = None

    def open_store(self) -> Store:
        """The results, with the newest index where they are on an object store.

        Raises:
            StoreError: ``no_results``, there is no such folder; or the object store does not answer.
        """
        from pipeline.store import Store, no_results  # noqa: PLC0415 - heavy

        if self.mirror is None:
            if not self.root.is_dir():
                raise no_results(self.root)
            return Store(self.root)
        self.mirror.pull_index()
        return self.mirror.store


def open_results(results: Path) -> ResultsLocation:
    """Results at a path, or at an address such as ``s3://bucket/results``.

    Raises:
        StoreError: ``no_object_store``.
    """
    from pipeline.logs import RemotePath, to_location  # noqa: PLC0415 - verbs that only help need none
    from pipeline.store import Mirror  # noqa: PLC0415 - likewise

    location = to_location(results)
    if not isinstance(location, RemotePath):
        return ResultsLocation(location)
    mirror = Mirror(str(location))
    return ResultsLocation(mirror.store.root, mirror)


def format_vehicle_source(source: str) -> str:
    """Where the geometry of a vehicle comes from."""
    words = source.replace("_", " ")
    return "geometry: estimated" if source == "fitted" else f"geometry: from {words}"


TrustCode = Annotated[
    bool,
    Parameter(name="--trust-code", help="trust the Python that the model file names, now and later"),
]


@contextmanager
def open_shown(
    name: str, options: Options, *, quiet: bool, notify: Callable[[str], None] = print_note
) -> Iterator[OpenedRun]:
    """A run as `open_run` gives it, its progress shown; ``notify`` is given its note afterwards."""
    from pipeline.analysis.analyze import open_run  # noqa: PLC0415 - heavy

    with (
        show_progress(Path(name).name, quiet=quiet) as progress,
        open_run(name, options, progress) as opened,
    ):
        yield opened
    if opened.note and not quiet:
        notify(f"slip: {opened.note}")
