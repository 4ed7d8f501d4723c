"""One writer at a time: an advisory lock on a file, released by the system when its holder dies."""

import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pipeline.store.errors import StoreError, name_disk_errors

_RETRY_S = 0.02


@contextmanager
def hold_lock(path: Path, *, patience_s: float) -> Iterator[None]:
    """Hold the lock file ``path`` for the length of the block.

    The file stays: removing it would let two writers hold two files of one name. What stands in it only
    serves the message to those who wait.

    A file system without locks (some network mounts) is refused: a file that merely exists would outlive a
    writer that was killed.

    Args:
        path: the lock file; its folder exists.
        patience_s: how long to wait for another holder.

    Raises:
        StoreError: ``locked``, another process held the lock all that time; or the disk refuses.
    """
    from filelock import FileLock, Timeout  # noqa: PLC0415 - heavy, and only writers need it

    lock = FileLock(path, thread_local=False, fallback_to_soft=False, preserve_lock_file=True)
    with name_disk_errors(path):
        try:
            lock.acquire(timeout=patience_s, poll_interval=_RETRY_S)
        except Timeout as error:
            raise StoreError(
                "locked",
                f"{_read_holder(path)} has been writing here for more than {patience_s:g} s",
                where=str(path.parent),
                hint="Wait until it is done or stop it, then run the same command again",
            ) from error
    try:
        # The note is a courtesy: a full disk must be reported by what needs the space.
        with suppress(OSError):
            path.write_text(f"process {os.getpid()} on {platform.node()}", encoding="utf-8")
        yield
    finally:
        lock.release()


def _read_holder(path: Path) -> str:
    with suppress(OSError):
        return path.read_text(encoding="utf-8", errors="replace")[:200] or "another process"
    return "another process"
