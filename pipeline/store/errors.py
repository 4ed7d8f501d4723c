"""What can go wrong with results, in one line that says what to do."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline.core.errors import SlipError


class StoreError(SlipError):
    """Results cannot be written, read or trusted."""


_KNOWN = (
    (
        (errno.ENOSPC, errno.EDQUOT),
        "disk_full",
        "the disk of the results is full",
        (
            "Free space or choose another folder with --out, then run the same command again; "
            "the results that were there before are untouched"
        ),
    ),
    (
        (errno.EROFS,),
        "read_only",
        "the folder of the results cannot be written: its file system is read-only",
        "Choose another folder with --out or mount this one writable",
    ),
    (
        (errno.EACCES, errno.EPERM),
        "permission_denied",
        "permission denied",
        "Choose another folder with --out or give your user the right to this one",
    ),
    (
        (errno.ENOTDIR, errno.EEXIST),
        "not_a_folder",
        "there is a file where the folder of the results, or one in it, should be",
        "Choose another folder with --out, or move the file away",
    ),
    (
        (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS),
        "no_locks",
        "the file system of the results has no file locks or links",
        "Choose a folder on a local disk with --out",
    ),
)
"""Numbers of the system's errors, the code, what is wrong, and what to do."""


@contextmanager
def name_disk_errors(place: Path) -> Iterator[None]:
    """Turn an ``OSError`` of the block into a `StoreError` about ``place``.

    Args:
        place: the file or folder to name where the system's error names none.

    Raises:
        StoreError: ``disk_full``, ``read_only``, ``permission_denied``, ``not_a_folder``, ``no_locks`` or
            ``disk_error``.
    """
    try:
        yield
    except OSError as error:
        code, what = "disk_error", f"the system reports: {error.strerror or error}"
        hint = "Check the disk and run the same command again; what was there before is untouched"
        for numbers, *known in _KNOWN:
            if error.errno in numbers:
                code, what, hint = known
        raise StoreError(code, what, where=str(error.filename or place), hint=hint) from error


def left_out(place: Path, why: str) -> StoreError:
    """The error for a folder of the results that was not looked into."""
    return StoreError(
        "left_out", why, where=str(place), hint="slip makes no such folder: look at who did, and remove it"
    )
