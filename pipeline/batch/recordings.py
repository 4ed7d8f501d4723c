"""Finding recordings: files, folders, globs, lists; a split one is one, one in the making is none."""

from __future__ import annotations

import fnmatch
import glob
import os
import re
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.batch.errors import BatchError
from pipeline.logs import RemotePath

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

SUFFIX = ".mcap"
LISTING = "metadata.yaml"
_MAGIC = b"\x89MCAP0\r\n"
_GLOB = re.compile(r"[*?\[]")


@dataclass(frozen=True)
class Found:
    """What was found.

    Attributes:
        recordings: files, and folders of split recordings, absolute, sorted.
        growing: recordings that are still being written.
    """

    recordings: tuple[Path, ...]
    growing: tuple[Path, ...] = field(default=())


def find_recordings(targets: Sequence[str], *, settle_s: float) -> Found:
    """Find the recordings that are meant.

    Args:
        targets: an MCAP file; a folder, searched to its depths; a glob such as ``2026/**/*.mcap``; or
            ``@list.txt``, a text file with one of these a line (``#`` begins a comment).
        settle_s: a recording without a proper end that changed within this time is still being written [s].

    Raises:
        BatchError: ``logs_not_found``, ``list_unreadable``.
    """
    found: set[Path] = set()
    for target in _expand_lists(targets):
        found |= set(_find_in(target))
    growing = {path for path in found if _is_growing(path, settle_s)}
    return Found(tuple(sorted(found - growing)), tuple(sorted(growing)))


def _expand_lists(targets: Iterable[str]) -> Iterator[str]:
    for target in targets:
        if not target.startswith("@"):
            yield target
            continue
        path = Path(target[1:])
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise BatchError(
                "list_unreadable",
                f"the list of logs cannot be read: {error}",
                where=str(path),
                hint="Give a text file with one log, folder or glob a line",
            ) from None
        plain = (line.partition("#")[0].strip() for line in lines)
        for line in filter(None, plain):
            # A list speaks of what stands beside it, wherever it is read from.
            yield str(path.parent / Path(line).expanduser())


def _find_in(target: str) -> Iterator[Path]:
    if "://" in target:
        yield from _find_remote(RemotePath(target))
        return
    path = Path(target).expanduser()
    if path.is_file():
        yield path.resolve()
    elif path.is_dir():
        yield from _walk(path.resolve())
    elif _GLOB.search(target):
        for match in sorted(glob.glob(str(path), recursive=True)):  # noqa: PTH207 - knows absolute patterns
            inside = Path(match).resolve()
            if inside.is_dir():
                yield from _walk(inside)
            elif inside.suffix == SUFFIX:
                yield _parent_recording(inside) or inside
    else:
        raise BatchError(
            "logs_not_found",
            "there is no such file or folder",
            where=target,
            hint="Check the path; quote a glob so that the shell leaves it alone",
        )


def _walk(top: Path) -> Iterator[Path]:
    for place, folders, names in os.walk(top, followlinks=True):
        # Hidden names are those of copies under way and of caches.
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        folder = Path(place)
        logs = sorted(name for name in names if name.endswith(SUFFIX) and not name.startswith("."))
        parts = set(list_parts(folder, logs, is_listed=LISTING in names))
        if parts:
            yield folder.resolve()
        yield from ((folder / name).resolve() for name in logs if name not in parts)


def list_parts(folder: Path, names: Iterable[str], *, is_listed: bool) -> list[str]:
    """Names of the files that are parts of one recording, as rosbag2 lays it out in a folder.

    Args:
        folder: the folder.
        names: names of the logs in it.
        is_listed: whether a ``metadata.yaml`` makes the folder a recording.
    """
    if is_listed:
        return list(names)
    pattern = re.compile(re.escape(folder.name) + r"_\d+\.mcap")
    return [name for name in names if pattern.fullmatch(name)]


def _find_remote(target: RemotePath) -> Iterator[Path]:
    """Recordings under a prefix, or the one at an address; objects are there whole or not at all."""
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
    objects = [found for found in top.find_objects() if not found.name.startswith(".")]
    if top != target:
        objects = [found for found in objects if fnmatch.fnmatchcase(str(found), str(target))]
    listed = {found.parent for found in objects if found.name == LISTING}
    for found in objects:
        if found.suffix == SUFFIX:
            folder = found.parent
            is_part = bool(list_parts(folder, [found.name], is_listed=folder in listed))
            yield folder if is_part else found


def _parent_recording(log: Path) -> Path | None:
    folder = log.parent
    listed = (folder / LISTING).is_file()
    return folder if list_parts(folder, [log.name], is_listed=listed) else None


def _is_growing(path: Path, settle_s: float) -> bool:
    """Whether a recorder or a copy is still writing it: no proper end, and changed a moment ago."""
    if isinstance(path, RemotePath):
        return False
    try:
        files = sorted(path.glob(f"*{SUFFIX}")) if path.is_dir() else [path]
        touched = max((file.stat().st_mtime for file in files), default=0.0)
        if time.time() - touched > settle_s:
            return False
        # The recorder of a split recording writes the listing last of all.
        unlisted = path.is_dir() and not (path / LISTING).is_file()
        return unlisted or not all(_ends_well(file) for file in files)
    except OSError:
        # It vanished or cannot be read: whoever analyzes it will say so.
        return False


def _ends_well(file: Path) -> bool:
    with file.open("rb") as stream:
        size = stream.seek(0, os.SEEK_END)
        if size < 2 * len(_MAGIC):
            return False
        stream.seek(size - len(_MAGIC))
        return stream.read() == _MAGIC
