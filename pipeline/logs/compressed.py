"""MCAP files that rosbag2 compressed as a whole (``compression_mode: file``), inflated for random access.

What was inflated stands in temporary files without a name, which the system removes when the process ends.
The variable TMPDIR of the environment names the folder for them.
"""

import os
import tempfile
import weakref
from pathlib import Path
from typing import IO, Final

import zstandard

from pipeline.core import Newest, format_size
from pipeline.logs.catalog import limit_inflated
from pipeline.logs.records import LogError

COMPRESSED: Final = (".zstd", ".zst")
"""Suffixes of files that are compressed as a whole, after their own."""
_READ: Final = 2 << 10
"""Bytes that are inflated at once: 2 KiB of zeros are at most 64 MiB."""


class _Inflated:
    """An unnamed file, open as long as it is kept."""

    def __init__(self, opened: IO[bytes]) -> None:
        self.descriptor = os.dup(opened.fileno())
        weakref.finalize(self, os.close, self.descriptor)


_NEWEST: Final = Newest[_Inflated](16)
"""The files inflated last: a recording is cataloged, read and hashed one after the other."""


def uncompressed_name(path: Path) -> str:
    """Name of a file without the suffix of its compression: ``run.mcap`` of ``run.mcap.zstd``."""
    return path.with_suffix("").name if path.suffix in COMPRESSED else path.name


def open_inflated(path: Path, descriptor: int) -> int:
    """A descriptor of the inflated content of a compressed file.

    Args:
        path: the file.
        descriptor: of the open file.

    Raises:
        LogError: ``log_unreadable``, it is damaged or cut off; ``log_unreachable``, there is no room for its
            content; ``too_large``.
    """
    status = os.fstat(descriptor)

    def inflate() -> _Inflated:
        with os.fdopen(os.dup(descriptor), "rb") as source, tempfile.TemporaryFile(prefix="slip-") as target:
            _inflate(path, status.st_size, source, target)
            return _Inflated(target)

    return os.dup(_NEWEST.recall((path, status.st_size, status.st_mtime_ns), inflate).descriptor)


def _inflate(path: Path, size: int, source: IO[bytes], target: IO[bytes]) -> None:
    most, total = limit_inflated(size, None), 0
    frame: zstandard.ZstdDecompressionObj | None = None
    rest = b""
    try:
        while rest or (rest := source.read(_READ)):
            if frame is None or frame.eof:
                frame = zstandard.ZstdDecompressor().decompressobj()
            total += target.write(frame.decompress(rest))
            rest = frame.unused_data if frame.eof else b""
            if total > most:
                what = f"it inflates to more than {format_size(most)}, which no recording of its size does"
                raise LogError("too_large", what, where=str(path), hint="Unpack it: zstd -d")
        target.flush()
    except zstandard.ZstdError as error:
        raise _refuse_damage(path, f"damaged ({error})", total) from None
    except OSError as error:
        what = f"its content cannot be unpacked into {tempfile.gettempdir()} ({error.strerror})"
        hint = "Set TMPDIR to a folder with more room, or unpack it: zstd -d"
        raise LogError("log_unreachable", what, where=str(path), hint=hint) from None
    if frame is None or not frame.eof:
        raise _refuse_damage(path, "cut off", total)


def _refuse_damage(path: Path, how: str, total: int) -> LogError:
    what = f"the compressed file is {how}, after {format_size(total)} of its content"
    return LogError("log_unreadable", what, where=str(path), hint="Copy it from its origin again")
