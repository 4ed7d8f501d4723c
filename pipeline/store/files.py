"""Files that are there whole or not at all, and one writer at a time."""

import errno
import os
import platform
import secrets
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from pipeline.core.untrusted import walk_files
from pipeline.store.names import StoreError, name_disk_errors, path_unread

TEMPORARY = ".tmp-"
"""How the names of unfinished files and folders begin; no reader looks at them."""

_SYNCS_AT_ONCE = 8
_NO_FOLDER_SYNC = (errno.EINVAL, errno.ENOTSUP, errno.EBADF)
_NO_LINK = (errno.EXDEV, errno.EPERM, errno.EACCES, errno.EMLINK, errno.ENOTSUP, errno.ENOSYS)


def write_new_file(path: Path, data: bytes) -> None:
    """Write a file that must not exist yet, and wait until the disk has it.

    Refusing an existing file matters: it could be a hard link into an older generation.

    Raises:
        FileExistsError: there is a file already.
        OSError: the disk is full, read-only, ...; no half-written file remains.
    """
    draft_file(path, data, lambda file: os.fsync(file.fileno()))


def do_nothing(*_: object) -> None:
    """In the place of what may be done."""


def draft_file(path: Path, data: bytes, finish: Callable[[BinaryIO], None] = do_nothing) -> None:
    """As `write_new_file`, without waiting for the disk: `sync_files` does so for many at once.

    Args:
        path: the file, which must not exist yet.
        data: the content.
        finish: called with the file when all of it is written.

    Raises:
        FileExistsError: there is a file already.
        OSError: the disk is full, read-only, ...; no half-written file remains.
    """
    with path.open("xb") as file:
        try:
            file.write(data)
            file.flush()
            finish(file)
        except BaseException:
            with suppress(OSError):
                path.unlink()
            raise


def sync_files(paths: Sequence[Path]) -> None:
    """Wait until the disk has files, and the names in folders; asked for at once, as long as for one of them.

    Raises:
        OSError: the disk did not take one of them.
    """
    if not paths:
        return
    with ThreadPoolExecutor(min(len(paths), _SYNCS_AT_ONCE), thread_name_prefix="sync") as pool:
        for _ in pool.map(_sync_path, paths):
            pass


def _sync_path(path: Path) -> None:
    if path.is_dir():
        sync_folder(path)
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def replace_file(
    path: Path, data: bytes, *, when_written: Callable[[], None] = do_nothing, durable: bool = True
) -> None:
    """Put a whole new file in the place of ``path`` in one moment; readers see the old or the new one.

    Args:
        path: the file, which need not exist yet; its folder does.
        data: the new content.
        when_written: called when the new file is on the disk, before it takes the place.
        durable: whether to wait until the disk has it.

    Raises:
        OSError: the old file is untouched and nothing else remains.
    """
    temporary = temporary_beside(path)
    try:
        (write_new_file if durable else draft_file)(temporary, data)
        when_written()
        temporary.replace(path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise
    if durable:
        sync_folder(path.parent)


def temporary_beside(path: Path) -> Path:
    """A fresh hidden name in the folder of ``path``."""
    return path.parent / f"{TEMPORARY}{os.getpid()}-{secrets.token_hex(4)}"


def sync_folder(folder: Path) -> None:
    """Wait until the disk has the names of a folder.

    Some network file systems have no such call, and a folder may be writable without being readable; the
    system then writes the names in its own time.
    """
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except PermissionError:
        return
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _NO_FOLDER_SYNC:
            raise
    finally:
        os.close(descriptor)


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, each of them durable."""
    if folder.is_dir():
        return
    make_folder(folder.parent)
    with suppress(FileExistsError):
        folder.mkdir()
    sync_folder(folder.parent)


def link_or_copy(source: Path, target: Path) -> None:
    """Give a finished file a second name, or copy it where links are impossible.

    Raises:
        FileExistsError: ``target`` exists.
        OSError: the disk is full, read-only, ...
    """
    try:
        os.link(source, target)
    except OSError as error:
        if error.errno not in _NO_LINK:
            raise
        write_new_file(target, source.read_bytes())


def remove_folder(folder: Path) -> None:
    """Remove a folder so that it never stands half empty under its own name; errors as `remove_tree`."""
    doomed = temporary_beside(folder)
    folder.rename(doomed)
    remove_tree(doomed)


def remove_tree(folder: Path) -> None:
    """Remove a folder with all that is in it.

    Raises:
        StoreError: ``path_unread``, it is nested more deeply than anything that slip makes.
        OSError: the disk refuses.
    """

    def refuse(path: Path, why: str) -> None:
        raise path_unread(path, why)

    for _ in walk_files(folder, refuse):
        pass
    shutil.rmtree(folder)


def remove_leftovers(folder: Path) -> None:
    """Remove what killed writers left in ``folder``; call only under its lock; errors as `remove_tree`."""
    for entry in sorted(folder.glob(f"{TEMPORARY}*")):
        if entry.is_dir() and not entry.is_symlink():
            remove_tree(entry)
        else:
            entry.unlink()


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
