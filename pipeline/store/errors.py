"""What can go wrong with results, in one line that says what to do."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline.core.errors import SlipError


class StoreError(SlipError):
    """Results cannot be written, read or trusted."""


_FULL = (errno.ENOSPC, errno.EDQUOT)
_FORBIDDEN = (errno.EACCES, errno.EPERM)
_NO_FOLDER = (errno.ENOTDIR, errno.EEXIST)
_NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS)


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
        where = str(error.filename or place)
        if error.errno in _FULL:
            raise StoreError(
                "disk_full",
                "the disk of the results is full",
                where=where,
                hint="Free space or choose another folder with --out, then run the same command again; "
                "the results that were there before are untouched",
            ) from error
        if error.errno == errno.EROFS:
            raise StoreError(
                "read_only",
                "the folder of the results cannot be written: its file system is read-only",
                where=where,
                hint="Choose another folder with --out or mount this one writable",
            ) from error
        if error.errno in _FORBIDDEN:
            raise StoreError(
                "permission_denied",
                "permission denied",
                where=where,
                hint="Choose another folder with --out or give your user the right to this one",
            ) from error
        if error.errno in _NO_FOLDER:
            raise StoreError(
                "not_a_folder",
                "there is a file where the folder of the results, or one in it, should be",
                where=where,
                hint="Choose another folder with --out, or move the file away",
            ) from error
        if error.errno in _NO_LOCKS:
            raise StoreError(
                "no_locks",
                "the file system of the results has no file locks or links",
                where=where,
                hint="Choose a folder on a local disk with --out",
            ) from error
        raise StoreError(
            "disk_error",
            f"the system reports: {error.strerror or error}",
            where=where,
            hint="Check the disk and run the same command again; what was there before is untouched",
        ) from error
