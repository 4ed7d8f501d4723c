"""Names of runs for many logs at once: the same whatever the order and number of workers.

A log keeps the name it has. Equal content counts once, under the name of the first. Of new logs that would
share a name the first by path gets it plain and the others with eight digits of their hash.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.analysis.log_setup import name_plainly

_DIGITS = 8


@dataclass(frozen=True, kw_only=True)
class KnownRun:
    """A run that has results.

    Attributes:
        run: its name.
        sha256: content of its log.
        size: bytes of its log; None when the results do not say.
        is_present: whether that same content still stands there and belongs to this batch.
    """

    run: str
    sha256: str
    size: int | None
    is_present: bool


@dataclass(frozen=True, kw_only=True)
class Names:
    """Names of runs.

    Attributes:
        runs: run by path of its log.
        copies: run that has the same content, by path of the log that is only a copy.
    """

    runs: Mapping[Path, str]
    copies: Mapping[Path, str]


def list_doubtful(sizes: Mapping[Path, int], known: Sequence[KnownRun]) -> tuple[Path, ...]:
    """New logs whose content must be hashed before they can be named.

    Those that could be a copy of another log, by their size, and those that need digits of their hash.

    Args:
        sizes: bytes of every new log.
        known: the runs that have results.
    """
    taken_sizes = {run.size for run in known}
    taken_names = {run.run for run in known}
    by_size = _group(sizes, lambda path: sizes[path])
    by_name = _group(sizes, name_plainly)
    alike = {path for group in by_size if len(group) > 1 for path in group}
    alike |= {path for path, size in sizes.items() if size in taken_sizes or None in taken_sizes}
    crowded = {path for group in by_name for path in group[name_plainly(group[0]) not in taken_names :]}
    return tuple(sorted(alike | crowded))


def assign_names(new: Collection[Path], hashes: Mapping[Path, str], known: Sequence[KnownRun]) -> Names:
    """Name the runs of new logs.

    Args:
        new: logs that have no run yet.
        hashes: content of those that `list_doubtful` named and that could be read.
        known: the runs that have results.
    """
    holders = {run.sha256: run for run in known}
    taken = {run.run for run in known}
    runs: dict[Path, str] = {}
    copies: dict[Path, str] = {}
    first: dict[str, Path] = {}
    again: list[Path] = []
    for path in sorted(new):
        content = hashes.get(path, "")
        holder = holders.get(content)
        if content in first:
            again.append(path)
        elif holder is not None and holder.is_present:
            copies[path] = holder.run
        else:
            if content:
                first[content] = path
            if holder is not None:
                # The log was moved: it keeps its results.
                runs[path] = holder.run
    for path in sorted(set(new) - set(copies) - set(runs) - set(again)):
        plain = name_plainly(path)
        runs[path] = plain if plain not in taken else f"{plain}-{hashes.get(path, '')[:_DIGITS]}"
        taken.add(runs[path])
    copies |= {path: runs[first[hashes[path]]] for path in again}
    return Names(runs=runs, copies=copies)


def _group(paths: Iterable[Path], label: Callable[[Path], object]) -> list[Sequence[Path]]:
    groups: dict[object, list[Path]] = {}
    for path in sorted(paths):
        groups.setdefault(label(path), []).append(path)
    return list(groups.values())
