"""Where the bytes of a log come from: one small interface, local files and object stores behind it."""

import hashlib
import os
import stat
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Final, Protocol

from pipeline.logs.errors import LogError
from pipeline.logs.remote import RemotePath, RemoteSource

_HASH_BLOCK: Final = 1 << 20


class ByteSource(Protocol):
    """Bytes that can be read anywhere, from several threads at once."""

    size: int
    """Count of bytes."""
    name: str
    """What to call it in messages."""

    def read_at(self, offset: int, length: int) -> bytes:
        """The bytes from ``offset``; fewer than ``length`` only at the end."""


class FileSource(AbstractContextManager["FileSource"]):
    """A local file, held open for the length of a block.

    Args:
        path: the file.

    Attributes:
        size: count of bytes when it was opened.
        name: the path.

    Raises:
        LogError: ``log_not_found``, ``log_unreadable``, ``log_empty``.
    """

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        try:
            # Opening a pipe would wait for somebody to write into it.
            self._descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except FileNotFoundError:
            raise LogError(
                "log_not_found", "there is no such file", where=str(path), hint="Check the path"
            ) from None
        except OSError as error:
            what = f"the file cannot be opened ({error.strerror})"
            raise LogError("log_unreadable", what, where=self.name, hint="Check its permissions") from None
        status = os.fstat(self._descriptor)
        self.size = status.st_size
        if not stat.S_ISREG(status.st_mode):
            self.close()
            what = "it is a pipe, a socket or a device, and no file"
            raise LogError("log_unreadable", what, where=self.name, hint="Give an .mcap file")
        if self.size == 0:
            self.close()
            hint = "The recorder was stopped before it wrote anything; leave it out"
            raise LogError("log_empty", "the file holds no bytes", where=self.name, hint=hint)

    def read_at(self, offset: int, length: int) -> bytes:
        """The bytes from ``offset``; fewer than ``length`` only at the end."""
        wanted = max(0, min(length, self.size - offset))
        try:
            found = os.pread(self._descriptor, wanted, offset) if wanted else b""
            while len(found) < wanted:
                more = os.pread(self._descriptor, wanted - len(found), offset + len(found))
                if not more:
                    break
                found += more
        except OSError as error:
            what = f"bytes {offset} to {offset + wanted} cannot be read ({error.strerror})"
            hint = "Copy the file from its origin again"
            raise LogError("log_unreadable", what, where=self.name, hint=hint) from None
        return found

    def close(self) -> None:
        """Give the file back."""
        os.close(self._descriptor)

    def __exit__(self, *_exception: object) -> None:
        self.close()


def open_source(path: Path, version: str | None = None) -> AbstractContextManager[ByteSource]:
    """Open a file or an object.

    Args:
        path: the file or object.
        version: of an object, what `version_of` told when it was opened before; another one is refused.

    Raises:
        LogError: ``log_not_found``, ``log_unreadable``, ``log_empty``, ``log_changed``.
    """
    return RemoteSource(path, version) if isinstance(path, RemotePath) else FileSource(path)


def version_of(source: ByteSource) -> str | None:
    """Which version of an object is open; None for a file."""
    return source.version if isinstance(source, RemoteSource) else None


def is_fetched(source: ByteSource) -> bool:
    """Whether every byte has to come from an object store."""
    return isinstance(source, RemoteSource)


def count_fetched(sources: Sequence[ByteSource]) -> int:
    """Bytes that were fetched from object stores."""
    return sum(source.fetched for source in sources if isinstance(source, RemoteSource))


def hash_sources(sources: Sequence[ByteSource]) -> str:
    """SHA-256 (hex) of the bytes of the sources, one after the other.

    An object is not fetched for it: its version and size, as its store tells them, stand for its bytes.
    """
    if len(sources) == 1 and isinstance(sources[0], RemoteSource):
        return sources[0].version
    digest = hashlib.sha256()
    for source in sources:
        if isinstance(source, RemoteSource):
            digest.update(bytes.fromhex(source.version))
            continue
        for offset in range(0, source.size, _HASH_BLOCK):
            digest.update(source.read_at(offset, _HASH_BLOCK))
    return digest.hexdigest()
