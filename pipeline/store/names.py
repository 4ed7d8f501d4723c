"""Safe names of runs and folders, dates of runs, shares of many files, and what can go wrong with results."""

import errno
import hashlib
import re
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, date, datetime
from pathlib import Path, PurePosixPath
from types import MappingProxyType

from pipeline.core import PathError, SlipError, TooLargeError, group_by, may_lead_out, resolve_inside


class StoreError(SlipError):
    """Results cannot be written, read or trusted."""


NO_FACTS: Mapping[str, float] = MappingProxyType({})
"""Numbers of a table that has none."""


_UNTOUCHED = "then run the same command again; the results that were there before are untouched"
_FREE = f"Free space or choose another folder with --results, {_UNTOUCHED}"
_KNOWN = (
    ((errno.ENOSPC,), "disk_full", "the disk of the results is full", _FREE),
    ((errno.EDQUOT,), "quota_used_up", "your quota on the disk of the results is used up", _FREE),
    (
        (errno.EFBIG,),
        "file_limit",
        "the system stopped a write: the file would exceed its limit on the size of files",
        "Raise the limit (ulimit -f unlimited) or choose a folder on another file system with --results, "
        + _UNTOUCHED,
    ),
    (
        (errno.EROFS,),
        "read_only",
        "the folder of the results cannot be written: its file system is read-only",
        "Choose another folder with --results or mount this one writable",
    ),
    (
        (errno.EACCES, errno.EPERM),
        "permission_denied",
        "permission denied",
        "Choose another folder with --results or give your user the right to this one",
    ),
    (
        (errno.ENOENT,),
        "no_folder",
        "the folder of the results cannot be made",
        "Choose another folder with --results",
    ),
    (
        (errno.ENOTDIR, errno.EEXIST),
        "not_a_folder",
        "there is a file where the folder of the results, or one in it, should be",
        "Choose another folder with --results, or move the file away",
    ),
    (
        (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS),
        "no_locks",
        "the file system of the results has no file locks or links",
        "Choose a folder on a local disk with --results",
    ),
)
"""Numbers of the system's errors, the code, what is wrong, and what to do."""


@contextmanager
def name_disk_errors(path: Path) -> Iterator[None]:
    """Turn an ``OSError`` of the block into a `StoreError` about ``path``.

    Args:
        path: the file or folder to name where the system's error names none.

    Raises:
        StoreError: ``disk_full``, ``quota_used_up``, ``file_limit``, ``read_only``, ``permission_denied``,
            ``not_a_folder``, ``no_locks``, ``disk_error``, or ``too_large``, a file that is not read.
    """
    try:
        yield
    except TooLargeError as error:
        hint = "It is not read: look at who wrote it, and remove it"
        raise StoreError("too_large", str(error.strerror), where=str(error.filename), hint=hint) from error
    except OSError as error:
        code, what = "disk_error", f"the system reports: {error.strerror or error}"
        hint = "Check the disk and run the same command again; what was there before is untouched"
        for numbers, *known in _KNOWN:
            if error.errno in numbers:
                code, what, hint = known
        raise StoreError(code, what, where=str(error.filename or path), hint=hint) from error


def path_unread(path: Path, why: str) -> StoreError:
    """The error for a folder of the results that was not looked into."""
    return StoreError(
        "left_out", why, where=str(path), hint="slip makes no such folder: look at who did, and remove it"
    )


# Safe names: a run may be called anything, its folder may not.
#
# A run ``folder/stem`` lives in ``runs/folder/stem``. Parts that are harmless stay as they are, so that
# people find them; everything else is percent-encoded. Two different names never share a folder: `~` stands
# only before a hash, `%` only before a code, and the text before the last slash becomes one part whatever it
# holds.

LONGEST_PART = 120
"""Bytes of one part of a path; file systems allow 255, encrypted ones 143."""

_HASH_DIGITS = 16
GENERATION = re.compile(r"generation-([1-9][0-9]*)")
"""Name of the folder of a run's generation, with its number."""

_RESERVED = re.compile(rf"manifest\.json|latest|{GENERATION.pattern}", re.IGNORECASE)
_UNSAFE = frozenset('%~/\\*?"<>|')
_FILE_NAME = re.compile(r"[0-9A-Za-z_][0-9A-Za-z_. -]{0,99}(?:/[0-9A-Za-z_][0-9A-Za-z_. -]{0,99})*")


def encode_run(run: str) -> PurePosixPath:
    """The folder of a run, relative to ``runs/``: one or two safe parts.

    Args:
        run: name of the run, ``stem`` or ``folder/stem``; any text.

    Raises:
        StoreError: ``bad_run_name``, the name is empty or cannot be written as UTF-8.
    """
    if not run or any("\ud800" <= character <= "\udfff" for character in run):
        hint = "Rename the log to a name that is not empty and is valid Unicode"
        raise StoreError("bad_run_name", f"{run!r} cannot name a run", hint=hint)
    folder, slash, stem = run.rpartition("/")
    parts = (folder, stem) if slash else (stem,)
    return PurePosixPath(*(_encode_part(part) for part in parts))


def check_home(run: str, home: Path, *, top: Path) -> None:
    """Refuse a run that stands in the folder of another one, such as a copy.

    Args:
        run: name of the run, as its manifest tells it.
        home: the folder that the manifest stands in.
        top: the folder of all runs.

    Raises:
        StoreError: ``name_clash``.
    """
    encoded = str(home)[len(str(top)) + 1 :]
    # Asked for every run of a season; most are called like their folders.
    if run != encoded and (not run or str(encode_run(run)) != unicodedata.normalize("NFC", encoded)):
        raise name_clash(run, encoded, home)


def name_clash(run: str, other: str, folder: Path) -> StoreError:
    """The error for two runs in one folder."""
    return StoreError(
        "name_clash",
        f"the results of {run!r} and of {other!r} would have the same folder",
        where=str(folder),
        hint="Rename one of the logs, or give it another folder with --results",
    )


def check_file_name(name: str) -> None:
    """Refuse file names that could leave their folder or hide in it.

    Raises:
        StoreError: ``bad_file_name``.
    """
    if not is_file_name(name):
        hint = "Use letters, digits, dots, _ and -, and start with a letter or a digit"
        raise StoreError("bad_file_name", f"{name!r} cannot name a file of the results", hint=hint)


def join_inside(folder: Path, name: str) -> Path:
    """A file of the results by a name that something outside of the program gave.

    Raises:
        StoreError: ``file_outside``, the name or a link in its way leads out of the folder; ``not_a_file``.
    """
    try:
        return resolve_inside(folder, name)
    except PathError as error:
        code = "file_outside" if error.code == "path_outside" else error.code
        raise StoreError(code, error.what, where=error.where, hint=error.hint) from None


def is_file_name(name: str) -> bool:
    """Whether a name stays inside its folder: plain parts with ``/`` between them."""
    return _FILE_NAME.fullmatch(name) is not None


def _encode_part(part: str) -> str:
    normal = unicodedata.normalize("NFC", part)
    last = len(normal) - 1
    encoded = "".join(
        _encode_character(character) if _is_unsafe(character, at, last) else character
        for at, character in enumerate(normal)
    )
    if _RESERVED.fullmatch(encoded):
        encoded = _encode_character(encoded[0]) + encoded[1:]
    if may_lead_out(encoded):
        encoded = "".join(
            character if character.isascii() else _encode_character(character) for character in encoded
        )
    if normal == part and len(encoded.encode()) <= LONGEST_PART:
        return encoded or "%"
    digest = hashlib.sha256(part.encode()).hexdigest()[:_HASH_DIGITS]
    start = encoded.encode()[: LONGEST_PART - _HASH_DIGITS - 1].decode(errors="ignore")
    return f"{start}~{digest}"


def _is_unsafe(character: str, at: int, last: int) -> bool:
    if character in _UNSAFE or unicodedata.category(character) in ("Cc", "Cf", "Cn", "Co", "Zl", "Zp"):
        return True
    return character in ". " and (at in (0, last))


def _encode_character(character: str) -> str:
    return "".join(f"%{byte:02X}" for byte in character.encode())


_DRAWN_BYTES = 8


@dataclass(frozen=True)
class Sample:
    """Draws files.

    Attributes:
        share: of all, 0 to 1.
        seed: another one draws others.
    """

    share: float
    seed: str

    def takes(self, name: str) -> bool:
        """Whether a file is drawn."""
        digest = hashlib.sha256(f"{self.seed} {name}".encode("utf-8", "surrogateescape")).digest()
        return int.from_bytes(digest[:_DRAWN_BYTES], "big") < self.share * 2.0 ** (8 * _DRAWN_BYTES)


@dataclass
class Tally:
    """How many of how many were looked at.

    Attributes:
        looked_at: whose content was read.
        all: that there are.
    """

    looked_at: int = 0
    all: int = 0

    def draws(self, sample: Sample | None, name: str) -> bool:
        """Whether one more is to be looked at, which is counted."""
        is_drawn = sample is None or sample.takes(name)
        self.all += 1
        self.looked_at += is_drawn
        return is_drawn


QUARANTINE = "quarantine_"


@dataclass(frozen=True, kw_only=True)
class TableEntry:
    """What became of a frame: a table of a generation, in the file ``<table>.parquet``.

    Attributes:
        rows: rows that keep the contract.
        quarantined: rows that break it; they stand in ``quarantine_<table>.parquet``.
        contract_version: version of the contract it was written under.
        rules: how many rows broke each rule.
    """

    rows: int
    quarantined: int
    contract_version: int
    rules: Mapping[str, int] = field(default_factory=dict)


@contextmanager
def name_damage(path: Path) -> Iterator[None]:
    """Say what is wrong with a table's file that is being read.

    Raises:
        StoreError: ``file_missing`` or ``table_damaged``.
    """
    import polars as pl  # noqa: PLC0415 - heavy, and `slip --help` imports this room

    try:
        yield
    except FileNotFoundError as error:
        raise file_missing(path) from error
    # Arrow's errors are errors of values and of files.
    except (pl.exceptions.PolarsError, OSError, ValueError) as error:
        raise table_damaged(getattr(error, "strerror", None) or NOT_AS_WRITTEN, path) from error


NOT_AS_WRITTEN = "it has changed since it was written"


def table_damaged(why: str, path: Path) -> StoreError:
    """The error for a table that cannot be trusted."""
    what = f"the table {path.stem} cannot be read: {why}"
    return StoreError("table_damaged", what, where=str(path), hint="Analyze the log again with --force")


def no_results(folder: Path) -> StoreError:
    """The error for results whose folder is not there."""
    what = "there are no results: " + ("it is not a folder" if folder.exists() else "there is no such folder")
    hint = "Give their folder with --results, or make them with `slip analyze` or `slip batch`"
    return StoreError("no_results", what, where=str(folder), hint=hint)


def file_missing(path: Path) -> StoreError:
    """The error for a file that a manifest names and that is not there."""
    hint = "slip results verify --repair has the next slip batch make it again"
    what = f"the file {path.name} of the results is gone"
    return StoreError("file_missing", what, where=str(path), hint=hint)


# Dates of runs: by the name, by the clock of the log, and where the two contradict each other.

_DAY = re.compile(r"(?<!\d)(20\d\d)[-_](\d{1,2})[-_](\d{1,2})(?!\d)")


def read_day(run: str) -> str | None:
    """Date in the name of a run (`2024_8_7` or `2024-08-07`) as `2024-08-07`; None without one."""
    match = _DAY.search(run)
    if match is None:
        return None
    try:
        return date(*(int(part) for part in match.groups())).isoformat()
    except ValueError:  # no day of the calendar
        return None


_EARLIEST_YEAR = 2000
"""Year before which a clock was not set: unset ones count from 1970 or 1980, no log is so old."""
_TIME_ZONE_DAYS = 1
"""Largest difference of a local date from that in UTC [days]: time zones end at 14 h; a second day would be
another date, and zero would refuse drives in the evening."""


@dataclass(frozen=True)
class RunDates:
    """Dates of runs.

    Attributes:
        days: date of each run, for example `2024-08-07`; None where it is not known.
        notes: contradictions between names and clocks, and runs whose order their clocks do not tell.
    """

    days: Mapping[str, str | None]
    notes: tuple[str, ...]


def date_runs(starts: Mapping[str, int | None]) -> RunDates:
    """Date every run: by its name where that holds a date, else by the clock of its log.

    A start that a date in a name contradicts is a placeholder, as converters write it: other runs with the
    very same start have no date.

    Args:
        starts: timestamp of the first sample of each run [ns]; None where it is not known.
    """
    named = {run: read_day(run) for run in starts}
    clocks = {run: _read_clock(start) for run, start in starts.items()}
    refused = {starts[run] for run, clock in clocks.items() if _contradicts(named[run], clock)}
    days = {run: named[run] or (None if starts[run] in refused else clocks[run]) for run in starts}
    shared = group_by(
        ((start, None if start in refused else days[run]), run)
        for run, start in starts.items()
        if clocks[run] is not None
    )
    alone = [f"{runs[0]} ({clocks[runs[0]]})" for (start, _), runs in shared.items()
             if start in refused and len(runs) == 1]  # fmt: skip
    notes = [
        _note_refused(runs, clocks[runs[0]], named) if start in refused else _note_order(runs, start)
        for (start, _), runs in shared.items()
        if len(runs) > 1
    ]
    if alone:
        notes.append(f"the date in the name counts, and not that of the clock, of {', '.join(alone)}")
    return RunDates(days, tuple(notes))


def _note_refused(runs: Sequence[str], clock: str | None, named: Mapping[str, str | None]) -> str:
    """Note on runs with one start that a date in a name contradicts."""
    dated = sum(named[run] is not None for run in runs)
    others = "; the others have no date" if dated < len(runs) else ""
    return (
        f"the clocks of {len(runs)} runs start at the same instant of {clock}, which names contradict: "
        f"the dates in the names of {dated} count{others}"
    )


def _note_order(runs: Sequence[str], start: int | None) -> str:
    """Note on runs of one date and start."""
    instant = datetime.fromtimestamp((start or 0) // 10**9, UTC)
    return (
        f"{len(runs)} runs start at the same instant, {instant:%Y-%m-%d %H:%M:%S} UTC, and are in the "
        f"order of their names: {', '.join(sorted(runs))}"
    )


def _contradicts(named: str | None, clock: str | None) -> bool:
    """Whether two dates differ by more than time zones do."""
    if named is None or clock is None:
        return False
    return abs((date.fromisoformat(named) - date.fromisoformat(clock)).days) > _TIME_ZONE_DAYS


def _read_clock(start: int | None) -> str | None:
    """Date of a timestamp (UTC); None if the clock was not set."""
    if start is None:
        return None
    try:
        day = datetime.fromtimestamp(start / 1e9, UTC)
    except (OverflowError, OSError, ValueError):
        return None
    return day.strftime("%Y-%m-%d") if day.year >= _EARLIEST_YEAR else None
