"""Search for recordings in arbitrary folders; split recordings are merged, unfinished ones left out."""

import errno
import fnmatch
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TypeVar

from pipeline.batch import BatchError
from pipeline.core import ask_within, describe_silence, walk_tree
from pipeline.logs import SUFFIXES, RemotePath, is_finished, judge_content, list_files
from pipeline.logs.index import LISTING, are_separate, split_number

# Reading of arbitrary folders: link cycles, dead mounts, folders without permission.
#
# Whatever cannot be read is reported and skipped; everything else is still found.

_MAGIC = frozenset("*?[")
_LIKE_SUFFIX = re.compile(r"\.(mcap|db3|bag)(?![a-z0-9])", re.IGNORECASE)
"""In names of recordings, also of rotated, renamed and packed ones: ``run.mcap.1``, ``RUN.MCAP``."""

Answer = TypeVar("Answer")


@dataclass(frozen=True)
class Skipped:
    """Skipped path.

    Attributes:
        path: file, folder or other entry.
        reason: why.
        hint: what to do.
        is_entry: whether its folder was read, and what it is is known: nothing waits for an answer.
    """

    path: Path
    reason: str
    hint: str = ""
    is_entry: bool = False


@dataclass(frozen=True)
class Folder:
    """Contents of a folder, without hidden entries.

    Attributes:
        path: absolute, links resolved.
        folders: subfolders by name; absolute, links resolved.
        files: regular files, likewise.
        identity: that no other folder has.
    """

    path: Path
    folders: Mapping[str, Path]
    files: Mapping[str, Path]
    identity: tuple[int, int]


@dataclass
class Looker:
    """Reads files and folders with a time limit.

    Attributes:
        patience_s: time limit of one access [s].
        skipped: paths that could not be read.
        tops: folders that were asked for; links resolved.
        globs: globs that were asked for, absolute.
        links: the link by which each path outside of them was found.
    """

    patience_s: float
    skipped: list[Skipped] = field(default_factory=list)
    tops: list[Path] = field(default_factory=list)
    globs: list[str] = field(default_factory=list)
    links: dict[Path, Path] = field(default_factory=dict)

    def ask(self, path: Path, question: Callable[[], Answer]) -> Answer | None:
        """Result of a query about a path; None, with a note in `skipped`, if there is none."""
        try:
            return ask_within(question, self.patience_s)
        except TimeoutError:
            self.skip(path, describe_silence(self.patience_s))
        except OSError as error:
            self.skip(path, f"it cannot be read ({error.strerror or error})")
        return None

    def skip(self, path: Path, reason: str) -> None:
        """Record a path as skipped."""
        self.skipped.append(Skipped(path, reason))

    def leave(self, path: Path, reason: str, hint: str = "") -> None:
        """Record an entry of a folder as skipped, of which is known what it is."""
        self.skipped.append(Skipped(path, reason, hint, is_entry=True))

    def is_recording(self, path: Path) -> bool:
        """Whether a file is to be read, by its name, or by its content where something follows the suffix."""
        if path.name.endswith(SUFFIXES):
            return True
        if not _LIKE_SUFFIX.search(path.name):
            return False
        content = self.ask(path, lambda: judge_content(path))
        if content is not None and content.packed is not None:
            self.leave(path, *content.packed)
        return content is not None and content.is_read

    def walk(self, top: Path) -> Iterator[Folder]:
        """Every folder at and below a path, each once, also with cyclic links."""
        seen: set[tuple[int, int]] = set()

        def look(path: Path) -> tuple[Folder, list[Path], int] | None:
            folder = self._look_into(path)
            if folder is None or folder.identity in seen:
                return None
            seen.add(folder.identity)
            return folder, list(folder.folders.values()), len(folder.folders) + len(folder.files)

        return walk_tree(top, look, self.skip)

    def expand(self, pattern: Path) -> Iterator[Path]:
        """Files and folders that match a glob; ``**`` is any folder below, each once."""
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
            inner = base / parts[0]
            if self.ask(inner, inner.exists):
                yield from self._expand(inner, parts[1:])
            return
        if (inside := self._look_into(base)) is not None:
            here = {**inside.folders, **(inside.files if len(parts) == 1 else {})}
            for name in sorted(fnmatch.filter(here, parts[0])):
                yield from self._expand(here[name], parts[1:])

    def _look_into(self, folder: Path) -> Folder | None:
        """Contents of a folder."""
        listed = self.ask(folder, lambda: _list(folder))
        if listed is None:
            return None
        identity, entries = listed
        kinds: dict[str, dict[str, Path]] = {"folder": {}, "file": {}}
        for entry in sorted(entries, key=lambda entry: entry.name):
            # Copies in progress and caches have hidden names.
            if entry.name.startswith("."):
                continue
            path = Path(entry.path)
            known = (
                self.ask(path, partial(_follow, entry)) if entry.is_symlink() else (_find_kind(entry), path)
            )
            if known is None:
                continue
            kind, leads_to = known
            if kind in kinds:
                kinds[kind][entry.name] = leads_to
                if leads_to != path and not any(map(leads_to.is_relative_to, self.tops)):
                    self.links.setdefault(leads_to, path)
            # A link that leads nowhere, of another suffix, was one to neither a log nor a folder.
            elif entry.name.endswith(SUFFIXES) or (kind in _DEAD and not path.suffix):
                self.leave(path, kind)
        return Folder(folder, kinds["folder"], kinds["file"], identity)


NO_FILE = "it is a pipe, a socket or a device, not a file"
_DEAD = (_TO_NOTHING, _TO_ITSELF) = ("it is a link to nothing", "it is a link to itself")


def _list(path: Path) -> tuple[tuple[int, int], list[os.DirEntry[str]]]:
    status = path.stat()
    with os.scandir(path) as entries:
        return (status.st_dev, status.st_ino), list(entries)


def _follow(entry: os.DirEntry[str]) -> tuple[str, Path]:
    """Type of a link's target, and its path."""
    try:
        return _find_kind(entry), Path(os.path.realpath(entry.path))
    except OSError as error:
        if error.errno != errno.ELOOP:
            raise
        return _TO_ITSELF, Path(entry.path)


def _find_kind(entry: os.DirEntry[str]) -> str:
    """Type of an entry: ``folder``, ``file``, or why it is neither."""
    if entry.is_dir():
        return "folder"
    if entry.is_file():
        return "file"
    if entry.is_symlink() and not os.path.exists(entry.path):  # noqa: PTH110 - not of a path, but of an entry
        return _TO_NOTHING
    return NO_FILE


_GLOB = re.compile(r"[*?\[]")

PATIENCE_S = 30.0
"""Time limit of one access to a file or folder [s]: a dead mount does not answer."""

_LONGEST_LOOK_S = 5.0
"""Longest time between two size checks of logs with a change time in the future [s]."""


@dataclass(frozen=True)
class Recordings:
    """Result of a search.

    Attributes:
        recordings: files, and folders of split recordings, absolute, sorted.
        growing: recordings that are still being written.
        skipped: skipped paths with reasons: folders that cannot be read, pipes, broken links.
        links: the link by which each path outside of the folders was found.
        tops: the folders that were searched.
        globs: the globs that were expanded, absolute.
    """

    recordings: tuple[Path, ...]
    growing: tuple[Path, ...] = field(default=())
    skipped: tuple[Skipped, ...] = field(default=())
    links: Mapping[Path, Path] = field(default_factory=dict, compare=False)
    tops: tuple[Path, ...] = field(default=(), compare=False)
    globs: tuple[str, ...] = field(default=(), compare=False)

    def covers(self, folder: Path) -> bool:
        """Whether all recordings in a folder and below it were looked for."""
        return any(folder.resolve().is_relative_to(top) for top in self.tops)

    def would_list(self, path: Path) -> bool:
        """Whether a recording would have been found if it were there."""
        names = (path, self.name_listed(path))
        return any(name.is_relative_to(top) for name in names for top in self.tops) or any(
            fnmatch.fnmatchcase(str(name), glob) for name in names for glob in self.globs
        )

    def name_listed(self, path: Path) -> Path:
        """The path of a recording as its folder lists it: by the links that lead to it."""
        for part in (path, *path.parents):
            link = self.links.get(part)
            if link is not None and not link.is_relative_to(part):
                return self.name_listed(link) / path.relative_to(part)
        return path


def find_recordings(targets: Sequence[str], *, settle_s: float, patience_s: float = PATIENCE_S) -> Recordings:
    """Find the recordings of the given targets.

    Args:
        targets: an MCAP file or a bag; a folder, searched recursively; a glob such as ``2026/**/*.mcap``;
            or ``@list.txt``, a text file with one of these per line (``#`` begins a comment).
        settle_s: a recording without a proper end that changed within this time is still being written [s];
            one with a change time in the future is, if it grows between two checks.
        patience_s: time limit of one access to a file or folder [s].

    Raises:
        BatchError: ``logs_not_found``: a target or all of them hold nothing, where there are any;
            ``list_unreadable``.
        LogError: ``log_unreachable``, an object store does not answer.
    """
    looker = Looker(patience_s)
    listed: set[Path] = set()
    for target in _expand_lists(targets):
        listed |= set(_find_in(target, looker))
    if targets and not listed and not looker.skipped:
        raise _refuse(", ".join(targets))
    growing = _find_growing(listed, settle_s, looker)
    silent = {each.path for each in looker.skipped}
    skipped = {each.path: each for each in looker.skipped}
    return Recordings(
        tuple(sorted(listed - growing - silent)),
        tuple(sorted(growing - silent)),
        tuple(skipped[path] for path in sorted(skipped)),
        looker.links,
        tuple(looker.tops),
        tuple(looker.globs),
    )


def list_named(names: str) -> list[str]:
    """Logs and runs named in a text, separated by commas; folders and globs are expanded.

    Raises:
        BatchError: ``logs_not_found``: a folder, a glob or a list contains no log; as `find_recordings`.
    """
    words = [names] if _is_there(names) else [word.strip() for word in names.split(",")]
    resolved: list[str] = []
    for word in filter(None, words):
        if not (word.startswith("@") or (_is_there(word) and Path(word).is_dir()) or _GLOB.search(word)):
            resolved.append(word)
            continue
        recordings = find_recordings([word], settle_s=0.0).recordings
        if not recordings:
            raise _refuse(word)
        resolved += map(str, recordings)
    return resolved


def _refuse(where: str) -> BatchError:
    hint = "Recordings are files that end in .mcap, .mcap.zstd, .db3 or .bag, and folders of rosbag2"
    return BatchError("logs_not_found", "there is no recording in it", where=where, hint=hint)


def _is_there(name: str) -> bool:
    """Whether a name is that of a file or folder; a comma-separated list may exceed the name limit."""
    try:
        return Path(name).exists()
    except OSError:
        return False


def _expand_lists(targets: Iterable[str]) -> Iterator[str]:
    for target in targets:
        if not target.startswith("@"):
            yield target
            continue
        path = Path(target[1:])
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            hint = "Give a text file with one log, folder or glob a line"
            raise BatchError(
                "list_unreadable", f"the list of logs cannot be read: {error}", where=str(path), hint=hint
            ) from None
        plain = (line.partition("#")[0].strip() for line in lines)
        for line in filter(None, plain):
            # Paths in a list are relative to the list itself.
            yield str(path.parent / Path(line).expanduser())


def _find_in(target: str, looker: Looker) -> Iterator[Path]:
    if "://" in target:
        yield from _find_remote(RemotePath(target), looker)
        return
    path = Path(target).expanduser()
    before = len(looker.skipped)
    real = looker.ask(path, lambda: Path(os.path.realpath(path)))
    if real is not None and looker.ask(real, real.is_file):
        yield real
    elif real is not None and looker.ask(real, real.is_dir):
        looker.tops.append(real)
        for folder in looker.walk(real):
            yield from _list_recordings(folder, looker)
    elif _GLOB.search(target):
        looker.globs.append(str(path.absolute()))
        for match in looker.expand(path):
            yield from _find_match(match, looker)
    elif real is not None and looker.ask(real, real.exists):
        looker.leave(real, NO_FILE)
    elif len(looker.skipped) == before:
        hint = "Check the path; quote a glob so that the shell does not expand it"
        raise BatchError("logs_not_found", "there is no such file or folder", where=target, hint=hint)


def _find_match(match: Path, looker: Looker) -> Iterator[Path]:
    """Recordings of a file or folder that matches a glob."""
    if looker.ask(match, match.is_dir):
        for folder in looker.walk(match):
            yield from _list_recordings(folder, looker)
    elif looker.ask(match, match.is_file) and looker.is_recording(match):
        yield looker.ask(match, lambda: _parent_recording(match) or match) or match


def _list_recordings(folder: Folder, looker: Looker) -> Iterator[Path]:
    is_listed = LISTING in folder.files
    parts = set(list_parts(folder.path, folder.files, is_listed=is_listed))
    if len(parts) > 1 and not is_listed:
        files = sorted((folder.files[name] for name in parts), key=split_number)
        parts = set() if looker.ask(folder.path, partial(are_separate, files)) else parts
    if parts:
        yield folder.path
    for name, file in folder.files.items():
        if name not in parts and looker.is_recording(file):
            yield file


def list_parts(folder: Path, names: Iterable[str], *, is_listed: bool) -> list[str]:
    """Names of the files that are parts of one recording, in the folder layout of rosbag2.

    Args:
        folder: the folder.
        names: names of files in it; one that is no plain name of a recording is no part.
        is_listed: whether a ``metadata.yaml`` marks the folder as a recording.
    """
    # A ROS 1 bag is always a recording of its own.
    parts = [name for name in names if name.endswith(SUFFIXES) and not name.endswith(".bag")]
    if is_listed:
        return parts
    pattern = re.compile(re.escape(folder.name) + r"_\d+\.[\w.]+")
    return [name for name in parts if pattern.fullmatch(name)]


def _find_remote(target: RemotePath, looker: Looker) -> Iterator[Path]:
    """Recordings under a prefix, or the one at an address; objects are always complete."""
    target.refresh()
    base, _, pattern = str(target).partition("*")
    if not pattern and target.is_file():
        yield target
        return
    top = RemotePath(base.rpartition("/")[0]) if _GLOB.search(str(target)) else target
    if not top.is_dir():
        raise BatchError(
            "logs_not_found", "there is no such object or prefix", where=str(target), hint="Check the address"
        )
    objects = [one for one in top.find_objects() if not one.name.startswith(".")]
    if top != target:
        objects = [one for one in objects if fnmatch.fnmatchcase(str(one), str(target))]
    listed = {one.parent for one in objects if one.name == LISTING}
    for one in objects:
        if looker.is_recording(one):
            folder = one.parent
            is_part = bool(list_parts(folder, [one.name], is_listed=folder in listed))
            yield folder if is_part else one


def _parent_recording(log: Path) -> Path | None:
    folder = log.parent
    listed = (folder / LISTING).is_file()
    if not list_parts(folder, [log.name], is_listed=listed):
        return None
    files = list_files(folder)
    parts = set(list_parts(folder, [file.name for file in files], is_listed=listed))
    return None if not listed and are_separate(file for file in files if file.name in parts) else folder


def _find_growing(listed: Iterable[Path], settle_s: float, looker: Looker) -> set[Path]:
    """Recordings still being written by a recorder or copied: no proper end, and changed recently."""
    growing: set[Path] = set()
    ahead: dict[Path, int | None] = {}
    for path in listed:
        if isinstance(path, RemotePath):
            continue
        age_s = looker.ask(path, partial(_measure_age, path, settle_s))
        if age_s is not None and age_s < 0.0:
            ahead[path] = looker.ask(path, partial(_measure, path))
        elif age_s is not None:
            growing.add(path)
    if ahead and settle_s > 0.0:
        # After a change time in the future only growth shows whether it is being written.
        time.sleep(min(settle_s, _LONGEST_LOOK_S))
        growing |= {path for path, size in ahead.items() if looker.ask(path, partial(_measure, path)) != size}
    return growing


def _measure_age(path: Path, settle_s: float) -> float | None:
    """Seconds since the last change of a recording without a proper end; None if older or finished."""
    # Files that vanish or cannot be read are reported by the later analysis.
    with suppress(OSError):
        files = _list_files(path)
        age_s = time.time() - max((file.stat().st_mtime for file in files), default=0.0)
        if age_s > settle_s:
            return None
        # The recorder of a split recording writes the listing last.
        unlisted = path.is_dir() and not (path / LISTING).is_file()
        if unlisted or not all(is_finished(file) for file in files):
            return age_s
    return None


def _measure(path: Path) -> int:
    with suppress(OSError):
        return sum(file.stat().st_size for file in _list_files(path))
    return 0


def _list_files(path: Path) -> list[Path]:
    return list_files(path) if path.is_dir() else [path]
