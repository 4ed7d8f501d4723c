"""Logs on object stores: paths such as ``s3://bucket/logs/run.mcap``, read by ranges.

What a store says of an object (size, ETag, time) stands in the place of what a file system says of a file.
Only the ranges that are asked for are fetched, and they are counted.
"""

from __future__ import annotations

import hashlib
import os
import re
import stat
import threading
from datetime import UTC, datetime
from pathlib import Path, PosixPath
from typing import TYPE_CHECKING, Final, Protocol, cast

from pipeline.logs.errors import LogError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import TracebackType
    from typing import Self

_SCHEME = re.compile(r"^([a-z][a-z0-9+]+):/+")
_LISTING_S: Final = 60
_TAIL: Final = 1 << 15
"""A log's index stands at its end: one request fetches the end at once."""


class _FileSystem(Protocol):
    """What is used of fsspec."""

    def ls(self, path: str, detail: bool) -> list[dict[str, object]]: ...  # noqa: FBT001
    def find(self, path: str, detail: bool) -> dict[str, dict[str, object]]: ...  # noqa: FBT001
    def cat_file(self, path: str, *, start: int | None = None, end: int | None = None) -> bytes: ...


class RemotePath(PosixPath):
    """A path on an object store; it answers what a batch asks of a local one."""

    def __str__(self) -> str:
        return _SCHEME.sub(r"\1://", super().__str__())

    def __fspath__(self) -> str:
        return str(self)

    def resolve(self, strict: bool = False) -> Self:  # noqa: ARG002, FBT001, FBT002 - pathlib's own signature
        """Itself: there are no links."""
        return self

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
        """Size, time, and a number made of the ETag in the place of an inode.

        Raises:
            FileNotFoundError: there is no such object or prefix.
        """
        del follow_symlinks
        info = self._look()
        if info["type"] == "directory":
            return os.stat_result((stat.S_IFDIR, 0, 0, 1, 0, 0, 0, 0, 0, 0), {"st_mtime_ns": 0})
        inode = int(_name_version(info)[:15], 16)
        size = cast("int", info["size"])
        moment = _read_time(info)
        plain = (stat.S_IFREG, inode, 0, 1, 0, 0, size, 0, moment // 10**9, 0)
        return os.stat_result(plain, {"st_mtime_ns": moment, "st_mtime": moment / 1e9})

    def exists(self, **_: bool) -> bool:
        """Whether there is an object or a prefix of that name."""
        try:
            self._look()
        except OSError:
            return False
        return True

    def is_file(self, **_: bool) -> bool:
        """Whether it is an object."""
        return self._type() == "file"

    def is_dir(self, **_: bool) -> bool:
        """Whether it is a prefix."""
        return self._type() == "directory"

    def glob(self, pattern: str, **_: bool | None) -> Iterator[Self]:  # type: ignore[override]
        """Objects right below this prefix whose names fit."""
        for info in _open_store(str(self)).ls(str(self), detail=True):
            child = type(self)(_add_scheme(self, str(info["name"])))
            if child.match(pattern):
                yield child

    def read_bytes(self) -> bytes:
        """All of an object."""
        return _open_store(str(self)).cat_file(str(self))

    def read_text(self, encoding: str | None = None, errors: str | None = None, **_: str) -> str:
        """All of an object as text."""
        return self.read_bytes().decode(encoding or "utf-8", errors or "strict")

    def find_objects(self) -> list[Self]:
        """Every object under this prefix, sorted."""
        found = _open_store(str(self)).find(str(self), detail=True)
        return sorted(type(self)(_add_scheme(self, name)) for name in found)

    def version(self) -> str:
        """What tells this content from another without reading it: 64 hexadecimal digits of ETag and size.

        Raises:
            FileNotFoundError: there is no such object.
        """
        return _name_version(self._look())

    def _type(self) -> str:
        try:
            return str(self._look()["type"])
        except OSError:
            return ""

    def _look(self) -> dict[str, object]:
        """What the store says of it; one listing answers for all its neighbours."""
        if len(self.parts) <= 2:  # noqa: PLR2004 - scheme and bucket
            return {"type": "directory", "size": 0}
        plain = "/".join(self.parts[1:])
        for info in _open_store(str(self)).ls(str(self.parent), detail=True):
            if str(info["name"]).strip("/") == plain:
                return info
        raise FileNotFoundError(str(self))


def to_location(path: str | os.PathLike[str]) -> Path:
    """A path, remote where it begins with a scheme; also one that `Path` has taken a slash from."""
    if isinstance(path, RemotePath):
        return path
    text = os.fspath(path)
    return RemotePath(text) if _SCHEME.match(text) else Path(path)


class RemoteSource:
    """An object that is read by ranges, from several threads at once.

    Args:
        path: the object.

    Raises:
        LogError: ``log_not_found``, ``log_unreadable``, ``log_empty``.
    """

    def __init__(self, path: RemotePath) -> None:
        self._path = path
        self._store = _open_store(str(path))
        self._lock = threading.Lock()
        self._fetched = 0
        try:
            self._size = path.stat().st_size
            self._version = path.version()
        except FileNotFoundError:
            raise LogError(
                "log_not_found", "there is no such object", where=str(path), hint="Check bucket and key"
            ) from None
        except OSError as error:
            raise _unreadable(path, error) from None
        if self._size == 0:
            raise LogError(
                "log_empty",
                "the object holds no bytes",
                where=str(path),
                hint="The recorder was stopped before it wrote anything; leave it out",
            )
        self._tail_start = max(0, self._size - _TAIL)
        self._tail = self._fetch(self._tail_start, self._size)

    @property
    def size(self) -> int:
        """Count of bytes when it was opened."""
        return self._size

    @property
    def name(self) -> str:
        """The address."""
        return str(self._path)

    @property
    def version(self) -> str:
        """As `RemotePath.version`, when it was opened."""
        return self._version

    @property
    def fetched(self) -> int:
        """Bytes that were fetched so far."""
        return self._fetched

    def read_at(self, offset: int, length: int) -> bytes:
        """The bytes from ``offset``; fewer than ``length`` only at the end."""
        end = min(offset + max(0, length), self._size)
        if end <= offset:
            return b""
        if offset >= self._tail_start:
            return self._tail[offset - self._tail_start : end - self._tail_start]
        return self._fetch(offset, end)

    def close(self) -> None:
        """Nothing is held."""

    def _fetch(self, start: int, end: int) -> bytes:
        try:
            found = self._store.cat_file(str(self._path), start=start, end=end)
        except OSError as error:
            raise _unreadable(self._path, error) from None
        with self._lock:
            self._fetched += len(found)
        return found

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _open_store(url: str) -> _FileSystem:
    try:
        from fsspec.core import url_to_fs  # noqa: PLC0415 - an extra

        store, _ = url_to_fs(url, listings_expiry_time=_LISTING_S)
    except ImportError as error:
        raise LogError(
            "no_object_store",
            f"what is needed to reach an object store is not installed ({error})",
            where=url,
            hint="pip install 'slip-pipeline[s3]'",
        ) from None
    except ValueError as error:
        raise LogError(
            "no_object_store", f"there is no such kind of store ({error})", where=url, hint="Use s3://"
        ) from None
    return cast("_FileSystem", store)


def _add_scheme(base: RemotePath, name: str) -> str:
    return f"{base.parts[0]}//{name.strip('/')}"


def _name_version(info: dict[str, object]) -> str:
    tag = info.get("VersionId") or info.get("ETag") or info.get("etag") or _read_time(info)
    return hashlib.sha256(f"{tag} {info.get('size')}".encode()).hexdigest()


def _read_time(info: dict[str, object]) -> int:
    moment = info.get("LastModified") or info.get("created")
    if not isinstance(moment, datetime):
        return 0
    aware = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return round(aware.timestamp() * 1000) * 1_000_000


def _unreadable(path: RemotePath, error: OSError) -> LogError:
    return LogError(
        "log_unreadable",
        f"the object cannot be read ({' '.join(str(error).split())})",
        where=str(path),
        hint="Check the network and your right to the bucket",
    )
