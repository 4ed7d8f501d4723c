"""Bounded reading of untrusted names, small files, JSON objects, TOML and folders; texts as safe CSV."""

from __future__ import annotations

import errno
import json
import math
import os
import re
import stat
import sys
import threading
import tomllib
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

from pipeline.core.text import SlipError, shorten

if TYPE_CHECKING:
    import polars as pl

    AnyPath = TypeVar("AnyPath", bound=Path)

# Untrusted names as paths: of objects, of members of a recording, in manifests, from a browser.
#
# Without a check, the author of such a name decides where a file is read or written. `resolve_inside` checks
# every such name and confines it to its folder.

_LONGEST_PART = 255
"""Maximum length of a file name on Linux [bytes] (NAME_MAX)."""
_LONGEST_PATH = 4095
"""Maximum length of a path on Linux [bytes] (PATH_MAX without the terminating zero)."""
_SHOWN = 80
"""Maximum number of characters of an untrusted name in an error: a line of a screen."""
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")
_ABSOLUTE = re.compile(r"[/\\]|[A-Za-z]:")
_SEPARATORS = re.compile(r"[/\\]")


class PathError(SlipError):
    """Rejection of an untrusted name."""


def resolve_inside(root: AnyPath, name: str, *, follow_links: bool = False) -> AnyPath:
    """Path of an untrusted name, confined to a folder.

    Args:
        root: the folder; its own path is trusted.
        name: path relative to it, with ``/`` between its parts.
        follow_links: whether links below the folder may lead out of it: allowed for reading files that the
            user arranged, not for writing.

    Raises:
        PathError: ``path_outside``: the name is empty, absolute, has a drive letter, a backslash, a control
            character or a part that is or may be taken for ``.`` or ``..``, is too long for a file, or a link
            leads out of the folder; ``not_a_file``: it is a pipe, a socket or a device.
    """
    problem = _find_problem(name)
    if problem:
        raise _outside(str(root), name, problem)
    path = root / name
    if len(os.fsencode(path)) > _LONGEST_PATH:
        raise _outside(str(root), name, "is too long")
    mode, has_link = _look_at(root, name)
    if has_link and not follow_links and not path.resolve().is_relative_to(root.resolve()):
        raise _outside(str(root), name, "is a link that leads out of its folder")
    # Opening a pipe or reading a device could block forever.
    if mode and not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise _refuse("not_a_file", str(root), name, "is a pipe, a socket or a device, not a file")
    return path


def _find_problem(name: str) -> str:
    """Reason to reject a name, as the end of a sentence; empty if there is none."""
    try:
        sizes = [len(part.encode()) for part in name.split("/")]
    except UnicodeEncodeError:
        return "is not valid Unicode"
    if _CONTROL.search(name) or "\\" in name:
        return "has a control character or a backslash in it"
    if 0 in sizes or _ABSOLUTE.match(_fold(name)):
        return "is empty, absolute or has an empty part"
    if may_lead_out(name):
        return "leads out of its folder"
    return "is too long" if max(sizes) > _LONGEST_PART else ""


def may_lead_out(name: str) -> bool:
    """Whether a part of a name is ``.`` or ``..``, also if spaces and look-alike characters are ignored."""
    return any(part and not part.strip(". ") for part in _SEPARATORS.split(_fold(name)))


def _fold(name: str) -> str:
    """A name with look-alike characters normalized and invisible ones removed."""
    if name.isascii():
        return name
    visible = "".join(character for character in name if unicodedata.category(character) != "Cf")
    return unicodedata.normalize("NFKC", visible)


def _look_at(root: Path, name: str) -> tuple[int, bool]:
    """Mode of the named file, 0 if there is none, and whether its path contains a link."""
    path, mode, has_link = os.fspath(root), 0, False
    try:
        for part in name.split("/"):
            path = f"{path}/{part}"
            mode = os.lstat(path).st_mode
            has_link |= stat.S_ISLNK(mode)
        return (os.stat(path).st_mode if stat.S_ISLNK(mode) else mode), has_link  # noqa: PTH116 - of a text
    except OSError:
        return 0, has_link


def _outside(where: str, name: str, problem: str) -> PathError:
    return _refuse("path_outside", where, name, problem)


def _refuse(code: str, where: str, name: str, problem: str) -> PathError:
    shown = name if len(name) <= _SHOWN else f"{name[:_SHOWN]}..."
    hint = "It comes from outside and is not used; get the data from a source that you trust"
    return PathError(code, f"the name {shown!r} {problem}", where=where, hint=hint)


# Reading untrusted TOML: bounded size, depth and numbers, one class of errors.
#
# The parser of the standard library raises a recursion error on deep nesting, takes quadratic time on long
# dotted keys, and accepts integers of any length.

LONGEST = 2_000_000
"""Maximum number of characters of a TOML text: Python parses it in two seconds."""
DEEPEST = 16
"""Maximum depth of nested tables and lists; no file of this repository has more than five."""
_LARGEST = 2**63
"""Bound of integers: 64 bits with sign, as TOML 1.0 requires."""
_LINE = re.compile(r"\(at line (\d+)")
_PART = r"""(?:[\w-]++|"[^"\n]*"|'[^'\n]*')[ \t]*"""
_LONG_KEY = re.compile(rf"(?<![\w-])(?:{_PART}\.[ \t]*){{{DEEPEST}}}")


class TomlError(Exception):
    """A text that is not valid TOML or exceeds the bounds.

    Args:
        what: what is wrong, one line without a full stop.
        line: number of the line, from one; None for the whole text.
        key: dotted name of the key it concerns; empty if there is none.
    """

    def __init__(self, what: str, line: int | None = None, key: str = "") -> None:
        super().__init__(what)
        self.what = shorten(what)
        self.line = line
        self.key = key


def parse_toml(text: str) -> dict[str, object]:
    """The tables of a TOML text.

    Raises:
        TomlError: it is not TOML, too long, nested too deeply, or contains a number of more than 64 bits.
    """
    if len(text) > LONGEST:
        raise TomlError(f"longer than {LONGEST} characters")
    long_key = _LONG_KEY.search(text)
    if long_key is not None:
        raise TomlError(f"a key of more than {DEEPEST} parts", text.count("\n", 0, long_key.start()) + 1)
    try:
        tree = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        match = _LINE.search(str(error))
        line = int(match[1]) if match else text.count("\n") + 1
        why = " ".join(str(error).split())
        raise TomlError(f"not a valid TOML file, which has one key on a line: {why}", line) from None
    except ValueError:
        raise TomlError("a number of thousands of digits") from None
    except RecursionError:
        raise TomlError(f"nested more than {DEEPEST} deep") from None
    for key, value in walk(tree):
        if isinstance(value, int) and not -_LARGEST <= value < _LARGEST:
            raise TomlError(f"the number of {key} has more than 64 bits", key=key)
    return tree


def walk(tree: Mapping[str, object]) -> Iterator[tuple[str, object]]:
    """Every value other than tables and lists, with its dotted key.

    Raises:
        TomlError: nested too deeply.
    """
    stack: list[tuple[str, object, int]] = [("", tree, 0)]
    while stack:
        key, value, depth = stack.pop()
        if depth > DEEPEST:
            raise TomlError(f"{key[:80]} is nested more than {DEEPEST} deep", key=key)
        if isinstance(value, dict):
            stack += [(f"{key}.{name}" if key else name, inner, depth + 1) for name, inner in value.items()]
        elif isinstance(value, list):
            stack += [(key, inner, depth + 1) for inner in value]
        else:
            yield key, value


def require_finite(tree: Mapping[str, object]) -> None:
    """Reject the non-finite numbers ``inf`` and ``nan``.

    Raises:
        TomlError: with the key.
    """
    for key, value in walk(tree):
        if isinstance(value, float) and not math.isfinite(value):
            raise TomlError(f"{key} = {value} is not a finite number", key=key)


MOST_LEVELS: Final = 100
"""Maximum depth of searched folders: results have 6 levels, recorders and people use fewer than 20."""

MOST_ENTRIES: Final = 20_000_000
"""Maximum number of searched files and folders: 100 times those of the results of 10,000 runs."""

Location = TypeVar("Location")
Answer = TypeVar("Answer")


def ask_within(question: Callable[[], Answer], patience_s: float) -> Answer:
    """Result of a query about a file or folder, which may be on a mount that does not answer any more.

    Args:
        question: the query; it runs in a thread of its own, which is abandoned when it does not end.
        patience_s: how long to wait for it [s].

    Raises:
        TimeoutError: there is no answer within that time.
        OSError: whatever the query raises.
    """
    answer: Future[Answer] = Future()

    def work() -> None:
        try:
            answer.set_result(question())
        except Exception as error:  # noqa: BLE001 - it is raised where it was asked
            answer.set_exception(error)

    # A thread that can be abandoned: a call to a dead mount does not return.
    threading.Thread(target=work, name="folders", daemon=True).start()
    return answer.result(patience_s)


def describe_silence(patience_s: float) -> str:
    """Why a path that did not answer within a time [s] was left out."""
    return f"it does not answer within {patience_s:g} s: is it on a mount that is gone?"


def find_existing(paths: Iterable[str], patience_s: float) -> dict[str, bool | str]:
    """Whether each path is there, or why that cannot be told.

    Args:
        paths: files and folders.
        patience_s: how long to wait for an answer [s], once for each mount that does not answer.
    """
    answers: dict[str, bool | str] = {}
    answered: set[Path] = set()
    silent: set[Path] = set()

    def look(path: Path, asked: list[Path]) -> None:
        # From the top: the first folder without an answer is the mount, and what is below it is not asked.
        for part in (*reversed(path.parents), path):
            if part not in answered:
                asked.append(part)
                part.stat()
                answered.add(part)

    for text in paths:
        path, asked = Path(text), list[Path]()
        if silent.isdisjoint((path, *path.parents)):
            try:
                ask_within(partial(look, path, asked), patience_s)
            except TimeoutError:
                silent.add(asked[-1])
            except OSError as error:
                gone = error.errno in (errno.ENOENT, errno.ENOTDIR, errno.ELOOP)
                answers[text] = False if gone else f"it cannot be read ({error.strerror or error})"
            except ValueError:
                answers[text] = False
            else:
                answers[text] = True
        answers.setdefault(text, describe_silence(patience_s))
    return answers


def walk_tree(
    top: Location,
    look: Callable[[Location], tuple[Answer, Sequence[Location], int] | None],
    skip: Callable[[Location, str], None],
) -> Iterator[Answer]:
    """Answers for a folder and all folders below it; a folder precedes those below it.

    Args:
        top: the first folder.
        look: reads a folder: the answer, the direct subfolders and the number of entries; None if the folder
            cannot be read.
        skip: called with each folder that is omitted because of the bounds, and the reason.

    Yields:
        The answers.
    """
    waiting = [(top, 0)]
    entries = 0
    while waiting:
        at, level = waiting.pop()
        if entries > MOST_ENTRIES:
            skip(at, f"more than {MOST_ENTRIES} files and folders stand before it: it is left out")
            return
        if level > MOST_LEVELS:
            skip(at, f"it is more than {MOST_LEVELS} levels of folders deep: it is left out")
            continue
        looked = look(at)
        if looked is not None:
            answer, below, count = looked
            yield answer
            entries += count
            waiting += [(folder, level + 1) for folder in reversed(below)]


def walk_files(top: Path, skip: Callable[[Path, str], None]) -> Iterator[os.DirEntry[str]]:
    """All entries below a folder except folders; links are not followed.

    Args:
        top: the folder.
        skip: called with each folder that is omitted, and the reason; not for one that no longer exists.
    """

    def look(folder: str) -> tuple[list[os.DirEntry[str]], list[str], int] | None:
        try:
            with os.scandir(folder) as listed:
                entries = list(listed)
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            skip(Path(folder), f"the folder cannot be read: {error.strerror}")
            return None
        below = [entry.path for entry in entries if entry.is_dir(follow_symlinks=False)]
        files = [entry for entry in entries if not entry.is_dir(follow_symlinks=False)]
        return files, below, len(entries)

    for files in walk_tree(str(top), look, lambda folder, why: skip(Path(folder), why)):
        yield from files


MOST_BYTES: Final = 32 * 2**20
"""Maximum size of a note, manifest, settings file or page that is read whole [bytes]: twenty times a report.
Parsed, a JSON text takes up to twenty times as much memory."""


class TooLargeError(OSError):
    """A file that is larger than `MOST_BYTES`, and is not read.

    Args:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        what = f"it has more than {MOST_BYTES // 2**20} MB, more than any such file that slip writes"
        super().__init__(errno.EFBIG, what, str(path))


def read_bounded(path: Path) -> bytes:
    """The content of a file that is small unless somebody tampered with it.

    Raises:
        OSError: it cannot be read; `TooLargeError`, it is larger than `MOST_BYTES`, and is not read whole.
    """
    with path.open("rb") as file:
        content = file.read(MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise TooLargeError(path)
    return content


def read_bounded_text(path: Path) -> str:
    """The content of such a file as text, without the mark that editors put before UTF-8.

    Raises:
        OSError: as `read_bounded`.
        UnicodeDecodeError: it is not UTF-8.
    """
    return read_bounded(path).decode("utf-8-sig")


def read_object(path: Path) -> dict[str, object]:
    """The object in a file; empty if there is none or it cannot be read."""
    try:
        content = json.loads(read_bounded(path))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def number_in(source: Mapping[str, object], key: str) -> float | None:
    """A finite number under a key, or None."""
    return _take_number(source.get(key))


def numbers_in(source: Mapping[str, object], key: str) -> list[float | None]:
    """A list of numbers under a key; other entries become None."""
    return [_take_number(entry) for entry in _take_list(source.get(key))]


def mapping_in(source: Mapping[str, object], key: str) -> Mapping[str, object]:
    """An object under a key; empty if missing."""
    value = source.get(key)
    return value if isinstance(value, Mapping) else {}


def objects_in(source: Mapping[str, object], key: str) -> list[Mapping[str, object]]:
    """A list of objects under a key; empty if missing, without entries of other types."""
    return [entry for entry in _take_list(source.get(key)) if isinstance(entry, Mapping)]


def _take_number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    # Integers as well: one of 400 digits exceeds the range of a double.
    return float(value) if abs(value) <= sys.float_info.max else None


def _take_list(value: object) -> Sequence[object]:
    return value if isinstance(value, Sequence) and not isinstance(value, str) else ()


_FORMULA = "=+\\-@\t\r\n\uff1d\uff0b\uff0d\uff20"
"""First characters of a spreadsheet formula, after OWASP, "CSV Injection"; the last four are wide forms."""


def format_csv(frame: pl.DataFrame, *, header: bool = True, digits: int | None = None) -> str:
    """A table as CSV, safe for spreadsheets: a text that looks like a formula gets a leading quote.

    Args:
        frame: a table without nested columns; numbers, also negative ones, are unchanged.
        header: whether the first line contains the column names.
        digits: significant digits; None for all.

    Raises:
        PolarsError: a column cannot be represented in CSV.
    """
    import polars as pl  # noqa: PLC0415 - heavy
    import polars.selectors as cs  # noqa: PLC0415

    names = pl.Series(frame.columns, dtype=pl.String)
    safe = dict(
        zip(frame.columns, names.to_frame("").select(quote_formulas(pl.col(""))).to_series(), strict=True)
    )
    texts = frame.with_columns(quote_formulas((cs.string() | cs.enum() | cs.categorical()).cast(pl.String)))
    rounded = texts if digits is None else texts.with_columns(cs.float().round_sig_figs(digits))
    return rounded.rename(safe).write_csv(include_header=header)


def quote_formulas(text: pl.Expr) -> pl.Expr:
    """Texts with a quote in front of those that a spreadsheet would take for formulas."""
    # Existing leading quotes get one more, so that the original text can be restored.
    return text.str.replace(f"^('*[{_FORMULA}])", "'$1")
