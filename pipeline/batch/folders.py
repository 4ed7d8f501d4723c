"""Looking into folders that anything may stand in: link cycles, dead mounts, folders that may not be read.

Whatever cannot be looked at is named and left out; the rest is found all the same.
"""

import errno
import fnmatch
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TypeVar

from pipeline.core.walk import walk_tree
from pipeline.logs import SUFFIXES

_MAGIC = frozenset("*?[")

Answer = TypeVar("Answer")


@dataclass(frozen=True)
class Skipped:
    """Something that was left out, and why."""

    path: Path
    reason: str


@dataclass(frozen=True)
class Folder:
    """What stands in a folder, without what is hidden.

    Attributes:
        path: absolute, links resolved.
        folders: the folders in it by name; absolute, links resolved.
        files: the regular files in it, likewise.
    """

    path: Path
    folders: Mapping[str, Path]
    files: Mapping[str, Path]


class _Helper:
    """A thread that may be left behind: a call to a mount that is gone does not come back."""

    def __init__(self) -> None:
        self._asked: SimpleQueue[Callable[[], object]] = SimpleQueue()
        self._answers: SimpleQueue[tuple[object, Exception | None]] = SimpleQueue()
        threading.Thread(target=self._work, name="folders", daemon=True).start()

    def ask(self, question: Callable[[], object], patience_s: float) -> object:
        self._asked.put(question)
        answer, error = self._answers.get(timeout=patience_s)
        if error is not None:
            raise error
        return answer

    def _work(self) -> None:
        while True:
            try:
                self._answers.put((self._asked.get()(), None))
            except Exception as error:  # noqa: BLE001 - it is raised where it was asked
                self._answers.put((None, error))


@dataclass
class Looker:
    """Looks at files and folders for no longer than somebody waits.

    Attributes:
        patience_s: longest time for one look [s].
        skipped: what could not be looked at.
    """

    patience_s: float
    skipped: list[Skipped] = field(default_factory=list)
    _helper: _Helper = field(default_factory=_Helper)

    def ask(self, place: Path, question: Callable[[], Answer]) -> Answer | None:
        """The answer to a question about a place; None, and a note, where there is none."""
        try:
            return self._helper.ask(question, self.patience_s)  # type: ignore[return-value]
        except Empty:
            self._helper = _Helper()
            self.skip(
                place, f"it does not answer within {self.patience_s:g} s: is it on a mount that is gone?"
            )
        except OSError as error:
            self.skip(place, f"it cannot be looked at ({error.strerror or error})")
        return None

    def skip(self, place: Path, reason: str) -> None:
        """Note that something is left out."""
        self.skipped.append(Skipped(place, reason))

    def walk(self, top: Path) -> Iterator[Folder]:
        """Every folder at and below one, each once, also where links lead in circles."""
        seen: set[tuple[int, int]] = set()

        def look(place: Path) -> tuple[Folder, list[Path], int] | None:
            looked = self._look_into(place)
            if looked is None or looked[0] in seen:
                return None
            seen.add(looked[0])
            folder = looked[1]
            return folder, list(folder.folders.values()), len(folder.folders) + len(folder.files)

        return walk_tree(top, look, self.skip)

    def expand(self, pattern: Path) -> Iterator[Path]:
        """Files and folders that a glob means; ``**`` are all folders below, links in circles once."""
        parts = pattern.parts
        plain = next(number for number, part in enumerate(parts) if _MAGIC & set(part))
        yield from self._expand(Path(*parts[:plain]).absolute(), parts[plain:])

    def _expand(self, base: Path, parts: Sequence[str]) -> Iterator[Path]:
        if not parts:
            yield base
            return
        if parts[0] == "**":
            for folder in self.walk(base):
                yield from self._expand(folder.path, parts[1:])
                if len(parts) == 1:
                    yield from folder.files.values()
            return
        if not _MAGIC & set(parts[0]):
            place = base / parts[0]
            if self.ask(place, place.exists):
                yield from self._expand(place, parts[1:])
            return
        looked = self._look_into(base)
        if looked is not None:
            here = {**looked[1].folders, **(looked[1].files if len(parts) == 1 else {})}
            for name in sorted(fnmatch.filter(here, parts[0])):
                yield from self._expand(here[name], parts[1:])

    def _look_into(self, place: Path) -> tuple[tuple[int, int], Folder] | None:
        """A folder, and what tells it from every other."""
        listed = self.ask(place, lambda: _list(place))
        if listed is None:
            return None
        number, entries = listed
        kinds: dict[str, dict[str, Path]] = {"folder": {}, "file": {}}
        for entry in sorted(entries, key=lambda entry: entry.name):
            # Hidden names are those of copies under way and of caches.
            if entry.name.startswith("."):
                continue
            path = Path(entry.path)
            told = (
                self.ask(path, partial(_follow, entry)) if entry.is_symlink() else (_tell_kind(entry), path)
            )
            if told is None:
                continue
            kind, leads_to = told
            if kind in kinds:
                kinds[kind][entry.name] = leads_to
            elif entry.name.endswith(SUFFIXES):
                self.skip(path, kind)
        return number, Folder(place, kinds["folder"], kinds["file"])


def _list(place: Path) -> tuple[tuple[int, int], list[os.DirEntry[str]]]:
    status = place.stat()
    with os.scandir(place) as entries:
        return (status.st_dev, status.st_ino), list(entries)


def _follow(entry: os.DirEntry[str]) -> tuple[str, Path]:
    """What a link leads to, and where that is."""
    try:
        return _tell_kind(entry), Path(os.path.realpath(entry.path))
    except OSError as error:
        if error.errno != errno.ELOOP:
            raise
        return "it is a link to itself", Path(entry.path)


def _tell_kind(entry: os.DirEntry[str]) -> str:
    """What an entry is: ``folder``, ``file``, or why it is neither."""
    if entry.is_dir():
        return "folder"
    if entry.is_file():
        return "file"
    if entry.is_symlink() and not os.path.exists(entry.path):  # noqa: PTH110 - not of a path, but of an entry
        return "it is a link to nothing"
    return "it is a pipe, a socket or a device, and no file"
