"""Hashes of logs that are remembered, so that an unchanged log is not hashed again."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from stat import S_ISDIR

from pipeline.logs import list_files
from pipeline.store.files import hash_bytes
from pipeline.store.results_folder import Store

# What the logs' hashes were, so that an unchanged log is not hashed again: one small file a log, replaced
# whole. Writers never wait for each other, and the worst that can happen to an entry is that it is lost,
# which costs a hash. A wrong answer would need a log that changed while its path, size, modification time and
# inode did not.

IDENTITIES = "identities"
_PARTS_DIGITS = 16

_TICK_NS = 20_000_000
"""Changes within this time may leave the same modification time: clocks of kernels tick every 1 to 10 ms."""


@dataclass(frozen=True, kw_only=True)
class LogSighting:
    """What a log looked like at a moment.

    Attributes:
        path: absolute, links resolved.
        size: bytes, of all parts of a split recording.
        mtime_ns: modification time [ns since 1970], the latest of a split recording's.
        inode: number of the file in its file system.
        seen_ns: when it was looked at [ns since 1970].
        parts: hash of what the file system tells of the parts of a split recording; empty for a file.
    """

    path: str
    size: int
    mtime_ns: int
    inode: int
    seen_ns: int
    parts: str = ""

    def is_same_file(self, other: LogSighting) -> bool:
        """Whether nothing that the file system tells has changed."""
        return replace(self, seen_ns=0) == replace(other, seen_ns=0)


def see_log(path: Path) -> LogSighting:
    """Look at a log before reading it.

    Raises:
        OSError: there is no such file.
    """
    seen_ns = time.time_ns()
    status = path.stat()
    sighting = LogSighting(
        path=str(path.resolve()),
        size=status.st_size,
        mtime_ns=status.st_mtime_ns,
        inode=status.st_ino,
        seen_ns=seen_ns,
    )
    if not S_ISDIR(status.st_mode):
        return sighting
    # A part may change without its folder noticing.
    parts = {part.name: part.stat() for part in list_files(path)}
    parts_seen = [[name, part.st_size, part.st_mtime_ns, part.st_ino] for name, part in sorted(parts.items())]
    return replace(
        sighting,
        size=sum(part.st_size for part in parts.values()),
        mtime_ns=max([status.st_mtime_ns, *(part.st_mtime_ns for part in parts.values())]),
        parts=hash_bytes(json.dumps(parts_seen).encode())[:_PARTS_DIGITS],
    )


class LogIdentities:
    """The remembered hashes of a results folder.

    Args:
        store: the results they stand beside.
    """

    def __init__(self, store: Store) -> None:
        self._notes = store.notes(IDENTITIES)

    def lookup(self, path: Path) -> str | None:
        """SHA-256 of a log that has not changed since it was remembered; None when it must be hashed."""
        try:
            now = see_log(path)
            content = dict(self._notes.read(now.path) or {})
            sha256 = content.pop("sha256")
            then = LogSighting(**content)  # type: ignore[arg-type]
        except (OSError, TypeError, KeyError):
            # Whatever is wrong with an entry, hashing the log is the answer to it.
            return None
        return str(sha256) if then.is_same_file(now) else None

    def remember(self, path: Path, sha256: str, *, seen: LogSighting | None = None) -> bool:
        """Remember the hash of a log; failing to is no error.

        Args:
            path: the log.
            sha256: its hash in hexadecimal.
            seen: what `see_log` said before the log was read; with it, a log that changed while it was read
                is not remembered.

        Returns:
            Whether it was remembered.
        """
        try:
            now = see_log(path)
            if seen is not None and not (seen.is_same_file(now) and seen.seen_ns - seen.mtime_ns > _TICK_NS):
                return False
        except OSError:
            return False
        return self._notes.write(now.path, {**asdict(now), "sha256": sha256})
