"""Names from outside as paths: of objects, of members of a recording, in manifests, from a browser.

Whoever writes such a name decides where a file is read or written, unless it is held inside the folder that
it belongs to. Every such name goes through `resolve_inside`.
"""

from __future__ import annotations

import os
import re
import stat
import unicodedata
from typing import TYPE_CHECKING, TypeVar

from pipeline.core.errors import SlipError

if TYPE_CHECKING:
    from pathlib import Path

    AnyPath = TypeVar("AnyPath", bound=Path)

_LONGEST_PART = 255
_LONGEST_PATH = 4095
_SHOWN = 80
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
        raise _refuse("not_a_file", str(root), name, "is a pipe, a socket or a device, and no file")
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
        return "is no valid Unicode"
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
    place, mode, has_link = os.fspath(root), 0, False
    try:
        for part in name.split("/"):
            place = f"{place}/{part}"
            mode = os.lstat(place).st_mode
            has_link |= stat.S_ISLNK(mode)
        return (os.stat(place).st_mode if stat.S_ISLNK(mode) else mode), has_link  # noqa: PTH116 - of a text
    except OSError:
        return 0, has_link


def _outside(where: str, name: str, problem: str) -> PathError:
    return _refuse("path_outside", where, name, problem)


def _refuse(code: str, where: str, name: str, problem: str) -> PathError:
    shown = name if len(name) <= _SHOWN else f"{name[:_SHOWN]}..."
    hint = "It comes from outside and is not used; get the data from a source that you trust"
    return PathError(code, f"the name {shown!r} {problem}", where=where, hint=hint)
