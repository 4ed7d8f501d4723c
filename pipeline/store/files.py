"""Files that are there whole or not at all, folders, and locks: one writer at a time."""

import errno
import fcntl
import hashlib
import os
import platform
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from pipeline.core import walk_files
from pipeline.store.names import StoreError, name_disk_errors, path_unread

TEMPORARY = ".tmp-"
"""How the names of unfinished files begin; no reader looks at them."""

_NO_FOLDER_SYNC = (errno.EINVAL, errno.ENOTSUP, errno.EBADF, errno.EACCES)


def write_file(path: Path, data: bytes, *, durable: bool) -> None:
    """Write a file that must not exist yet: it could be a hard link into an older generation.

    Args:
        path: the file; its folder exists.
        data: the content.
        durable: whether to wait until the disk has it.

    Raises:
        FileExistsError: there is a file already.
        OSError: the disk is full, read-only, ...
    """
    with path.open("xb") as file:
        file.write(data)
        if durable:
            file.flush()
            os.fsync(file.fileno())


def sync_path(path: Path) -> None:
    """Wait until the disk has a file, or the names in a folder.

    Some network file systems cannot be asked for the latter, and a folder may be writable without being
    readable; the system then writes the names in its own time.

    Raises:
        OSError: the disk did not take it.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        if error.errno not in _NO_FOLDER_SYNC or not path.is_dir():
            raise


def replace_file(path: Path, data: bytes, *, durable: bool = True) -> None:
    """Put a whole new file in the place of ``path`` in one moment; readers see the old or the new one.

    Args:
        path: the file, which need not exist yet; its folder does.
        data: the new content.
        durable: whether to wait until the disk has it.

    Raises:
        OSError: the old file is untouched and nothing else remains.
    """
    temporary = temporary_beside(path)
    try:
        write_file(temporary, data, durable=durable)
        temporary.replace(path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise
    if durable:
        sync_path(path.parent)


def temporary_beside(path: Path) -> Path:
    """A fresh hidden name in the folder of ``path``."""
    return path.parent / f"{TEMPORARY}{os.getpid()}-{secrets.token_hex(4)}"


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, each of them durable."""
    if folder.is_dir():
        return
    make_folder(folder.parent)
    with suppress(FileExistsError):
        folder.mkdir()
    sync_path(folder.parent)


def link_or_copy(source: Path, target: Path) -> None:
    """Give a finished file a second name, or copy it where links are impossible.

    Raises:
        OSError: the disk is full, read-only, ...
    """
    try:
        os.link(source, target)
    except OSError:
        write_file(target, source.read_bytes(), durable=False)


def remove(path: Path) -> None:
    """Remove a file, a link, or a folder with all that is in it; call only under the lock of its folder.

    Raises:
        StoreError: ``left_out``, a folder is nested more deeply than anything that slip makes.
        OSError: the disk refuses.
    """

    def refuse(folder: Path, why: str) -> None:
        raise path_unread(folder, why)

    if path.is_symlink() or not path.is_dir():
        path.unlink(missing_ok=True)
        return
    for _ in walk_files(path, refuse):
        pass
    shutil.rmtree(path)


_RETRY_S = 0.02


@contextmanager
def hold_lock(path: Path, *, patience_s: float) -> Iterator[None]:
    """Hold the lock file ``path`` for the length of the block.

    The file stays: removing it would let two writers hold two files of one name. What stands in it only
    serves the message to those who wait, and who ask.

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
                f"{read_holder(path)} has been writing here for more than {patience_s:g} s",
                where=str(path.parent),
                hint="Wait until it is done or stop it, then run the same command again",
            ) from error
    try:
        # The note is a courtesy: a full disk must be reported by what needs the space.
        with suppress(OSError):
            since = f"{datetime.now().astimezone():%Y-%m-%d %H:%M}"
            path.write_text(f"process {os.getpid()} on {platform.node()} (since {since})", encoding="utf-8")
        yield
    finally:
        # Nobody holds it then, and a run's folder does not hang on who made it, and when.
        with suppress(OSError):
            path.write_bytes(b"")
        lock.release()


def read_holder(path: Path) -> str:
    """Who holds a lock, as its file says."""
    with suppress(OSError):
        return path.read_text(encoding="utf-8", errors="replace")[:200] or "another process"
    return "another process"


def find_holder(path: Path) -> str:
    """Who holds a lock now, as its file says; empty where nobody does.

    What a killed holder noted is still there; it does not count. Nothing is written.
    """
    with suppress(OSError), path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return read_holder(path)
    return ""


def hash_bytes(data: bytes) -> str:
    """SHA-256 in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def hash_file(path: Path) -> str:
    """SHA-256 of a file in hexadecimal.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
