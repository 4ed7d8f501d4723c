"""One writer at a time: an advisory lock on a file, released by the system when its holder dies."""

from __future__ import annotations

import errno
import fcntl
import os
import platform
import time
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from pipeline.store.errors import StoreError, name_disk_errors

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

_RETRY_S = 0.02
_BUSY = (errno.EWOULDBLOCK, errno.EACCES)


@contextmanager
def hold_lock(path: Path, *, patience_s: float) -> Iterator[None]:
    """Hold the lock file ``path`` for the length of the block.

    The file stays: removing it would let two writers hold two files of one name. What stands in it only
    serves the message to those who wait.

    Args:
        path: the lock file; its folder exists.
        patience_s: how long to wait for another holder.

    Raises:
        StoreError: ``locked``, another process held the lock all that time; or the disk refuses.
    """
    with name_disk_errors(path):
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        with name_disk_errors(path):
            _wait_for_lock(descriptor, path, patience_s)
        # The note is a courtesy: a full disk must be reported by what needs the space.
        with suppress(OSError):
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"process {os.getpid()} on {platform.node()}".encode(), 0)
        try:
            yield
        finally:
            fcntl.flock(descriptor, fcntl.LOCK_UN)
    finally:
        os.close(descriptor)


def _wait_for_lock(descriptor: int, path: Path, patience_s: float) -> None:
    deadline = time.monotonic() + patience_s
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in _BUSY:
                raise
        else:
            return
        if time.monotonic() >= deadline:
            holder = os.pread(descriptor, 200, 0).decode(errors="replace") or "another process"
            raise StoreError(
                "locked",
                f"{holder} has been writing here for more than {patience_s:g} s",
                where=str(path.parent),
                hint="Wait until it is done or stop it, then run the same command again",
            )
        time.sleep(_RETRY_S)
