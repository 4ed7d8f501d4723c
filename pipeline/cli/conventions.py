"""What verbs share: options, where results go, what is printed, exit codes, memory that ran out."""

from __future__ import annotations

import itertools
import json
import os
import re
import shlex
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

from cyclopts import Parameter
from cyclopts.types import PositiveFloat

from pipeline import store
from pipeline.analysis import STAGE_WORDS, Options
from pipeline.batch import parse_memory_limit, parse_size
from pipeline.core import INPUTS, LONGEST_TEXT, SlipError, group_by, measure_memory, name_state, shorten

if TYPE_CHECKING:
    from pipeline.analysis.analyze import OpenedRun

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
_UNIT = re.compile(r"(?<=\d) (?=[^\W\d]|%)")  # the space between a number and its unit
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
    """Lines on stdout, each one line whatever names stand in it, folded where a screen is narrower.

    The screen is as wide as COLUMNS says, else as the terminal; a file is not folded.
    """
    columns = os.environ.get("COLUMNS", "")
    seen = shutil.get_terminal_size().columns if sys.stdout.isatty() else 0
    width = (int(columns) if columns.isdecimal() else 0) or seen
    sys.stdout.write("".join(f"{part}\n" for line in lines for part in fold_line(tidy_line(line), width)))


def fold_line(line: str, width: int) -> list[str]:
    """A line in parts of at most `width` columns, each below the field that it goes on with.

    Fields stand two spaces or more apart. What begins in the right half goes to the next line as a whole; a
    longer text is broken between its words, but not between a number and its unit. A single word that is too
    long stays as it is.
    """
    if width < _NARROWEST or len(line) <= width or line.startswith(_COPIED):
        return [line]
    starts = [match.start() for match in _FIELD.finditer(line)]
    near = [start for start in starts if start <= min(width // 2, _DEEPEST)] or starts[:1] or [0]
    later = [start for start in starts if near[-1] < start <= width]
    cut = later[-1] if later else 0
    indent = " " * (near[-1] or (_HANG if later else 0))
    wrapped = textwrap.wrap(
        _UNIT.sub("\0", line[cut:]),
        width,
        initial_indent=indent if later else "",
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [*([line[:cut].rstrip()] if later else []), *(part.replace("\0", " ") for part in wrapped)] or [""]


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
    """How many logs came out in each state, in a column of a width; of rare states only those with some."""
    return [
        f"{name_state(state):<14}{count:>{width}}"
        for state, count in counts.items()
        if count or state in _USUAL
    ]


_USUAL = ("done", "unchanged", "lossy", "failed", "quarantined")
EXPLAINED = ("refused", "lossy", "failed", "quarantined", "ignored", "growing", "left_out", "gone")
"""States of logs that need a look, in the order in which they are listed."""


_NAMED = 3
"""Logs of one reason that are named: a folder of copies may have hundreds."""


def group_reasons(logs: Iterable[tuple[str, str, str]]) -> list[tuple[list[str], str, str]]:
    """Paths of logs by their reason and hint, the most frequent first; the hint for several says LOG.

    Args:
        logs: path, reason and hint of each.
    """
    groups = group_by(((reason, hint.replace(path, "LOG")), (path, hint)) for path, reason, hint in logs)
    return [
        ([path for path, _ in members], reason, hint if len(members) > 1 else members[0][1])
        for (reason, hint), members in sorted(groups.items(), key=lambda item: -len(item[1]))
    ]


def name_some(paths: Sequence[str], *, everything: bool = False) -> list[str]:
    """Paths to be shown; of many the first, and how many others there are."""
    if everything or len(paths) <= _NAMED + 1:
        return list(paths)
    return [*paths[:_NAMED], f"and {len(paths) - _NAMED} more (--all lists them)"]


def explain_logs(title: str, logs: Iterable[tuple[str, str, str]], *, everything: bool = False) -> list[str]:
    """Paths of logs by why they came out so, and what to do, below a title; nothing without any."""
    lines = [
        text
        for paths, reason, hint in group_reasons(logs)
        for text in (
            *(f"  {path}" for path in name_some(paths, everything=everything)),
            f"      {shorten(reason, LONGEST_TEXT)}",
            *([f"      {hint}"] if hint else []),
        )
    ]
    return [title, *lines, ""] if lines else []


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


@dataclass
class Answer:
    """What a command answers on logs, also where it ends for its memory limit.

    Attributes:
        memory: the limit as it was typed, for example 2GB; None for a share of the machine's memory.
        is_json: whether it is asked for as one JSON object.
        at_work: which file is being worked on.
        list_runs: the runs so far as JSON objects.
        errors: errors as JSON objects; each affects only one log.
    """

    memory: str | None
    is_json: bool
    at_work: str = ""
    list_runs: Callable[[], Sequence[object]] = list
    errors: list[dict[str, str]] = field(default_factory=list)

    @property
    def limit_bytes(self) -> int:
        """The memory limit of the process [bytes].

        Raises:
            BatchError: ``bad_size``, ``memory_too_small``.
        """
        return int(_SHARE * measure_memory()) if self.memory is None else parse_memory_limit(self.memory)

    @contextmanager
    def attempt(self, log: str) -> Iterator[None]:
        """Work on a log, or another file: its error is printed, and the others go on."""
        self.at_work = log
        try:
            yield
        except SlipError as error:
            self._note(log, error)

    def to_json(self) -> dict[str, object]:
        """Runs and errors as one JSON object."""
        return {"runs": self.list_runs(), "errors": self.errors}

    def end(self, held: int) -> None:
        """End the process with one line; what it has written stays as it was, as after a kill."""
        what = f"the command used {held / 1e9:.2g} GB of memory, more than {self.limit_bytes / 1e9:.2g} GB"
        hint = "Give it more with --memory, or leave out what is that large"
        self._note(self.at_work, SlipError("out_of_memory", what, where=self.at_work, hint=hint))
        if self.is_json:
            # One line: those who read `watch` read line by line.
            sys.stdout.write(json.dumps(self.to_json()) + "\n")
        sys.stdout.flush()
        # Only this ends a library's computation.
        os._exit(FAILED)

    def _note(self, log: str, error: SlipError) -> None:
        print_error(error)
        self.errors.append(summarize_error(log, error))


Asked: TypeAlias = Annotated[Answer, Parameter(parse=False)]
"""The answer of the command, given by `main` to the verbs that say more at their end."""


def is_json(words: Sequence[str]) -> bool:
    """Whether these words of a command ask for one JSON object."""
    return "--json" in itertools.takewhile(lambda word: word != "--", words)


def _require_local(_kind: object, results: Path) -> None:
    """Refuse an address such as ``s3://bucket/results`` as the folder of results."""
    if re.match(r"[a-z][a-z0-9+]+:/", str(results)):
        what = "results are in a folder of this machine, and this is an address"
        hint = "Give a folder, and copy it with the tool of the object store, for example `aws s3 sync`"
        raise SlipError("results_not_local", what, where=str(results), hint=hint)


Results: TypeAlias = Annotated[Path, Parameter(help="results folder", validator=_require_local)]

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
    drove: Annotated[str | None, Parameter(help="distance driven straight by a tape, for example 2.00m")] = (
        None
    )
    turned: Annotated[PositiveFloat | None, Parameter(help="turns on the spot as counted")] = None
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


def _parse_distance(text: str | None) -> float | None:
    """A distance [m] of a text with its unit.

    Raises:
        SlipError: ``bad_distance``.
    """
    if text is None:
        return None
    match = re.fullmatch(r"(\d+\.?\d*|\.\d+) ?(m|cm|mm)", text.strip())
    if match is None or not float(match[1]):
        raise SlipError(
            "bad_distance",
            f"{text} is not a length with its unit",
            where="--drove",
            hint="Give one with its unit, m, cm or mm, as 2.00m.",
        )
    return float(match[1]) * {"mm": 1e-3, "cm": 1e-2}.get(match[2], 1.0)


def build_options(choices: Choices) -> Options:
    """Options of a job from the choices on the command line, without a report.

    Raises:
        BatchError: ``bad_size``.
    """
    said: dict[str, dict[str, object]] = {
        "vehicle": {
            "preset": choices.vehicle,
            "wheel_radius_m": choices.wheel_radius,
            "track_width_m": choices.track_width,
        },
        "run": {"dataset": choices.dataset, "terrain": choices.terrain},
        "truth": {"distance_m": _parse_distance(choices.drove), "turns": choices.turned},
        "velocity": {"yaw": choices.yaw},
    }
    given = {section: {k: v for k, v in values.items() if v is not None} for section, values in said.items()}
    overrides: dict[str, object] = {section: values for section, values in given.items() if values}
    if choices.interval == "all":
        overrides["use_intervals"] = "all"
    return Options(
        max_inflated=None if choices.max_inflated is None else parse_size(choices.max_inflated),
        out=choices.results,
        config=choices.config,
        overrides=overrides,
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


Force: TypeAlias = Annotated[bool, Parameter(help="replace files that are there", negative=())]


def require_new(*paths: Path, force: bool) -> None:
    """Refuse to write where something is: said before the work, as that would be lost.

    Args:
        paths: the files to write.
        force: whether they may be replaced.

    Raises:
        SlipError: ``file_exists``.
    """
    # A link that leads nowhere would be replaced as well.
    there = next((path for path in paths if path.exists() or path.is_symlink()), None)
    if there is not None and not force:
        hint = "Give --force to replace it, or another name"
        raise SlipError("file_exists", "the file already exists", where=str(there), hint=hint)


def open_results(results: Path) -> store.Store:
    """The results in a folder.

    Raises:
        StoreError: ``no_results``, there is no such folder.
    """
    if not results.is_dir():
        raise store.no_results(results)
    return store.Store(results)


def format_vehicle_source(source: str) -> str:
    """Where the geometry of a vehicle comes from."""
    words = "other recordings of the folder" if source == "folder" else source.replace("_", " ")
    return "geometry: estimated" if source == "fitted" else f"geometry: from {words}"


OwnEffects = Annotated[
    list[Path] | None,
    Parameter(name="--effects", help="Python file with effects of your own, which is run; may be repeated"),
]


@contextmanager
def open_shown(name: str, options: Options, *, quiet: bool) -> Iterator[OpenedRun]:
    """A run as `open_run` gives it; its progress is shown, and its note said."""
    from pipeline.analysis.analyze import open_run  # noqa: PLC0415 - heavy

    with ExitStack() as stack:
        with show_progress(Path(name).name, quiet=quiet) as progress:
            opened = stack.enter_context(open_run(name, options, progress))
        if opened.note and not quiet:
            print_note(f"slip: {opened.note}")
        yield opened
