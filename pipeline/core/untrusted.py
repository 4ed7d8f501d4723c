"""Names, TOML files and folders that anybody may have made, read within bounds."""

from __future__ import annotations

import math
import os
import re
import stat
import tomllib
import unicodedata
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

from pipeline.core.program import SlipError, shorten

# Names from outside as paths: of objects, of members of a recording, in manifests, from a browser.
#
# Whoever writes such a name decides where a file is read or written, unless it is held inside the folder that
# it belongs to. Every such name goes through `resolve_inside`.

if TYPE_CHECKING:
    AnyPath = TypeVar("AnyPath", bound=Path)

_LONGEST_PART = 255
"""Bytes of a file's name on Linux (NAME_MAX)."""
_LONGEST_PATH = 4095
"""Bytes of a path on Linux (PATH_MAX, less the zero at its end)."""
_SHOWN = 80
"""Characters of a name from outside that an error shows: a line of a screen."""
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")
_ABSOLUTE = re.compile(r"[/\\]|[A-Za-z]:")
_SEPARATORS = re.compile(r"[/\\]")


class PathError(SlipError):
    """A name from outside that does not stay inside its folder."""


def resolve_inside(root: AnyPath, name: str, *, follow_links: bool = False) -> AnyPath:
    """The path that a name from outside stands for, held inside a folder.

    Args:
        root: the folder, whose own place is trusted.
        name: relative to it, with ``/`` between its parts.
        follow_links: whether links below the folder may lead out of it: where the user's own arrangement of
            files is read, not where anything is written.

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
    # Opening a pipe would wait for ever, reading a device as well.
    if mode and not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise _refuse("not_a_file", str(root), name, "is a pipe, a socket or a device, not a file")
    return path


def check_name(name: str, *, where: str) -> None:
    """Refuse what `resolve_inside` refuses whatever there is on the disk.

    Args:
        name: as of `resolve_inside`.
        where: what to name in the error.

    Raises:
        PathError: ``path_outside``.
    """
    problem = _find_problem(name)
    if problem:
        raise _outside(where, name, problem)


def _find_problem(name: str) -> str:
    """Why a name may lead elsewhere, for the end of a sentence; empty when it cannot."""
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
    """Whether a part of a name is ``.`` or ``..``, or is where spaces or look-alikes do not count."""
    return any(part and not part.strip(". ") for part in _SEPARATORS.split(_fold(name)))


def _fold(name: str) -> str:
    """What a careless reader may take a name for: look-alikes made plain, invisible characters dropped."""
    if name.isascii():
        return name
    visible = "".join(character for character in name if unicodedata.category(character) != "Cf")
    return unicodedata.normalize("NFKC", visible)


def _look_at(root: Path, name: str) -> tuple[int, bool]:
    """Mode of what a name stands for, 0 where there is nothing, and whether a link is in its way."""
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


# Reading TOML that anybody may have written: bounded size, depth and numbers, one kind of error.
#
# The parser of the standard library ends with a recursion error on deep nesting, takes the square of the time
# on long dotted keys, and knows whole numbers of any length.

LONGEST = 2_000_000
"""Characters of a TOML text, which takes Python two seconds to parse."""
DEEPEST = 16
"""Tables and lists within each other; no file of this repository has more than five."""
_LARGEST = 2**63
"""Whole numbers stay below it, as TOML 1.0 asks."""
_LINE = re.compile(r"\(at line (\d+)")
_PART = r"""(?:[\w-]++|"[^"\n]*"|'[^'\n]*')[ \t]*"""
_LONG_KEY = re.compile(rf"(?<![\w-])(?:{_PART}\.[ \t]*){{{DEEPEST}}}")


class TomlError(Exception):
    """A text that is no TOML, or none that anybody would write.

    Args:
        what: what is wrong, one line without a full stop.
        line: where, counted from one; None for the whole text.
        key: dotted name of the key it concerns; empty where there is none.
    """

    def __init__(self, what: str, line: int | None = None, key: str = "") -> None:
        super().__init__(what)
        self.what = shorten(what)
        self.line = line
        self.key = key


def parse_toml(text: str) -> dict[str, object]:
    """The tables of a TOML text.

    Raises:
        TomlError: it is not TOML, too long, nested too deeply, or holds a number beyond 64 bits.
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
        raise TomlError(f"not a valid TOML file: {' '.join(str(error).split())}", line) from None
    except ValueError:
        raise TomlError("a number of thousands of digits") from None
    except RecursionError:
        raise TomlError(f"nested more than {DEEPEST} deep") from None
    for key, value in walk(tree):
        if isinstance(value, int) and not -_LARGEST <= value < _LARGEST:
            raise TomlError(f"the number of {key} has more than 64 bits", key=key)
    return tree


def walk(tree: Mapping[str, object]) -> Iterator[tuple[str, object]]:
    """Every value that is no table and no list, with its dotted key.

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
    """Refuse ``inf`` and ``nan`` where they can mean nothing.

    Raises:
        TomlError: with the key.
    """
    for key, value in walk(tree):
        if isinstance(value, float) and not math.isfinite(value):
            raise TomlError(f"{key} = {value} is not a finite number", key=key)


MOST_LEVELS: Final = 100
"""Levels of folders that are looked through: results have 6, recorders and people need fewer than 20."""

MOST_ENTRIES: Final = 20_000_000
"""Files and folders that are looked at: 100 times what a season of 10,000 runs leaves in its results."""

Location = TypeVar("Location")
Answer = TypeVar("Answer")


def walk_tree(
    top: Location,
    look: Callable[[Location], tuple[Answer, Sequence[Location], int] | None],
    skip: Callable[[Location, str], None],
) -> Iterator[Answer]:
    """What is found in a folder and in every folder below it, in the order of a reader.

    Args:
        top: where to begin.
        look: finds what is in a folder: the answer, the folders right below, and the count of entries; None
            where it cannot be looked into.
        skip: told of each folder that is left out because of the bounds, and why.

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
    """Everything below a folder that is not a folder itself; links are not followed.

    Args:
        top: the folder.
        skip: told of each folder that is left out, and why; not of one that is gone by now.
    """

    def look(folder: str) -> tuple[list[os.DirEntry[str]], list[str], int] | None:
        try:
            with os.scandir(folder) as listed:
                entries = list(listed)
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            skip(Path(folder), f"the folder cannot be looked into: {error.strerror}")
            return None
        below = [entry.path for entry in entries if entry.is_dir(follow_symlinks=False)]
        files = [entry for entry in entries if not entry.is_dir(follow_symlinks=False)]
        return files, below, len(entries)

    for files in walk_tree(str(top), look, lambda folder, why: skip(Path(folder), why)):
        yield from files
