"""Looking through folders that anybody may have made: without recursion, and within bounds."""

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final, TypeVar

MOST_LEVELS: Final = 100
"""Levels of folders that are looked through: results have 6, recorders and people need fewer than 20."""

MOST_ENTRIES: Final = 20_000_000
"""Files and folders that are looked at: 100 times what a season of 10,000 runs leaves in its results."""

Place = TypeVar("Place")
Answer = TypeVar("Answer")


def walk_tree(
    top: Place,
    look: Callable[[Place], tuple[Answer, Sequence[Place], int] | None],
    skip: Callable[[Place, str], None],
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
        place, level = waiting.pop()
        if entries > MOST_ENTRIES:
            skip(place, f"more than {MOST_ENTRIES} files and folders stand before it: it is left out")
            return
        if level > MOST_LEVELS:
            skip(place, f"it is more than {MOST_LEVELS} levels of folders deep: it is left out")
            continue
        looked = look(place)
        if looked is not None:
            answer, below, count = looked
            yield answer
            entries += count
            waiting += [(folder, level + 1) for folder in reversed(below)]


def walk_files(top: Path, skip: Callable[[Path, str], None]) -> Iterator[os.DirEntry[str]]:
    """Everything below a folder that is no folder itself; links are not followed.

    Args:
        top: the folder.
        skip: told of each folder that is left out, and why; not of one that is gone by now.
    """

    def look(folder: str) -> tuple[list[os.DirEntry[str]], list[str], int] | None:
        try:
            with os.scandir(folder) as found:
                entries = list(found)
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
