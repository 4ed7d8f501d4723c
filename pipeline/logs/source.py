"""Byte sources of logs (local files and object stores), and reading on several threads."""

import hashlib
import os
import stat
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, suppress
from itertools import islice
from pathlib import Path
from typing import Final, Protocol, TypeVar

from pipeline.core import guess_names
from pipeline.logs.records import LogError
from pipeline.logs.remote import RemotePath, RemoteSource

_HASH_BLOCK: Final = 1 << 20
_MOST_NEIGHBOURS: Final = 1000
"""Maximum number of folder entries compared with a mistyped name: more take longer than a manual look."""


class ByteSource(Protocol):
    """Bytes with random access, readable from several threads at once."""

    size: int
    """Count of bytes."""
    name: str
    """Name used in messages."""

    def read_at(self, offset: int, length: int) -> bytes:
        """The bytes from ``offset``; fewer than ``length`` only at the end."""


def _list_neighbours(path: Path) -> list[str]:
    """Names beside a path with its suffix; all names if it has none."""
    with suppress(OSError), os.scandir(path.parent) as entries:
        beside = [entry.name for entry in islice(entries, _MOST_NEIGHBOURS)]
        return [name for name in beside if path.suffix in {"", Path(name).suffix}]
    return []


class FileSource(AbstractContextManager["FileSource"]):
    """A local file, open for the duration of a `with` block.

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
            # Without O_NONBLOCK, opening a pipe would wait for a writer.
            self._descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except FileNotFoundError:
            hint = f"{guess_names(path.name, _list_neighbours(path), end=path.suffix)}Check the path"
            raise LogError("log_not_found", "there is no such file", where=str(path), hint=hint) from None
        except OSError as error:
            what = f"the file cannot be opened ({error.strerror})"
            raise LogError("log_unreadable", what, where=self.name, hint="Check its permissions") from None
        status = os.fstat(self._descriptor)
        self.size = status.st_size
        if not stat.S_ISREG(status.st_mode):
            self.close()
            what = "it is a pipe, a socket or a device, not a file"
            raise LogError("log_unreadable", what, where=self.name, hint="Give an .mcap file")
        if self.size == 0:
            self.close()
            hint = "The recorder was stopped before it wrote anything; omit this file"
            raise LogError("log_empty", "the file is empty", where=self.name, hint=hint)

    def read_at(self, offset: int, length: int) -> bytes:
        """The bytes from ``offset``; fewer than ``length`` only at the end."""
        wanted = max(0, min(length, self.size - offset))
        try:
            data = os.pread(self._descriptor, wanted, offset) if wanted else b""
            while len(data) < wanted:
                added = os.pread(self._descriptor, wanted - len(data), offset + len(data))
                if not added:
                    break
                data += added
        except OSError as error:
            what = f"bytes {offset} to {offset + wanted} cannot be read ({error.strerror})"
            hint = "Copy the file from its origin again"
            raise LogError("log_unreadable", what, where=self.name, hint=hint) from None
        return data

    def close(self) -> None:
        """Close the file."""
        os.close(self._descriptor)

    def __exit__(self, *_exception: object) -> None:
        self.close()


def open_source(path: Path, version: str | None = None) -> AbstractContextManager[ByteSource]:
    """Open a file or an object.

    Args:
        path: the file or object.
        version: of an object, the result of `version_of` when it was last opened; another is refused.

    Raises:
        LogError: ``log_not_found``, ``log_unreadable``, ``log_empty``, ``log_changed``.
    """
    return RemoteSource(path, version) if isinstance(path, RemotePath) else FileSource(path)


def version_of(source: ByteSource) -> str | None:
    """Version of the open object; None for a file."""
    return source.version if isinstance(source, RemoteSource) else None


def is_fetched(source: ByteSource) -> bool:
    """Whether every byte is fetched from an object store."""
    return isinstance(source, RemoteSource)


def count_fetched(sources: Sequence[ByteSource]) -> int:
    """Number of bytes fetched from object stores."""
    return sum(source.fetched for source in sources if isinstance(source, RemoteSource))


def hash_sources(sources: Sequence[ByteSource]) -> str:
    """SHA-256 (hex) of the concatenated bytes of the sources.

    An object is not fetched: the version and size reported by its store represent its bytes.
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


Item = TypeVar("Item")
Result = TypeVar("Result")


def usable_threads() -> int:
    """Number of threads that this process may use.

    This is the number of cores it may run on, or ``POLARS_MAX_THREADS`` if that is less: a caller that runs
    many processes at once sets it to limit each of them.
    """
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    limit = os.environ.get("POLARS_MAX_THREADS", "")
    return max(1, min(cores, int(limit))) if limit.isdigit() else cores


def map_in_order(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    threads: int,
    *,
    weigh: Callable[[Item], int] = lambda _item: 0,
    limit: int = 0,
) -> Iterator[Result]:
    """Apply ``function`` to every item; yields results in order, about two per thread waiting at most.

    Args:
        function: called on other threads; with one thread it is called on this one.
        items: its arguments.
        threads: number of calls that run at once.
        weigh: weight of an item, from the start of its processing until its result has been used.
        limit: maximum total weight at once; an item that exceeds it is processed alone.
    """
    if threads <= 1:
        for item in items:
            yield function(item)
        return
    with ThreadPoolExecutor(threads, thread_name_prefix="log") as pool:
        waiting: deque[tuple[Future[Result], int]] = deque()
        held = 0
        try:
            for item in items:
                weight = weigh(item)
                while waiting and (len(waiting) > 2 * threads or held + weight > limit):
                    # The caller uses a yielded result until it asks for the next one.
                    future, freed = waiting.popleft()
                    yield future.result()
                    held -= freed
                waiting.append((pool.submit(function, item), weight))
                held += weight
            while waiting:
                yield waiting.popleft()[0].result()
        finally:
            for future, _ in waiting:
                future.cancel()
