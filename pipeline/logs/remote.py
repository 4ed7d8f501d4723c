"""Logs in object stores: paths such as ``s3://bucket/logs/run.mcap``, listed, and read by byte ranges.

The metadata of an object (size, ETag, time) replace the status of a file. Only the ranges that are asked for
are fetched, and all of them are of one version of the object.
"""

from __future__ import annotations

import hashlib
import io
import os
import re
import stat
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from datetime import UTC, datetime
from pathlib import Path, PosixPath
from typing import TYPE_CHECKING, Any, Final, Self
from urllib.parse import quote_from_bytes, unquote_to_bytes

from pipeline.core import MOST_BYTES, TooLargeError, name_install
from pipeline.logs.records import LogError

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

SCHEMES: Final = ("s3", "s3a", "memory")
"""Supported URL schemes; objects of ``memory`` exist only in this process."""

_LISTING_S: Final = 60
_CONNECT_S: Final = 5
_ANSWER_S: Final = 15
_ATTEMPTS: Final = 3
"""Maximum number of attempts per request, with increasing pauses, if a store is busy or unreachable."""

_ROUNDS: Final = 2
"""Rounds of these attempts: with the timeouts above, an unresponsive store takes about 90 s."""

_SCHEME = re.compile(r"^([a-z][a-z0-9+]+):/+")
_LOCAL: Final = "file://"
_TAIL: Final = 1 << 15
"""Number of bytes fetched from the end of an object when it is opened: a log's index is at its end."""


def check_scheme(url: str) -> str:
    """The URL scheme of an address.

    Raises:
        LogError: ``no_object_store``, the scheme is not supported.
    """
    scheme = url.partition(":")[0]
    if scheme not in SCHEMES:
        what = f"{scheme}:// addresses are not read"
        raise LogError("no_object_store", what, where=url, hint="Use s3://, or copy the data to this machine")
    return scheme


def open_store(url: str) -> AbstractFileSystem:
    """Open the store of an address; no request is sent yet.

    Raises:
        LogError: ``no_object_store``.
    """
    scheme = check_scheme(url)
    # Missing credentials or an unresponsive host must be reported while the user waits.
    limits: dict[str, object] = {}
    if scheme != "memory":
        retries = {"mode": "standard", "total_max_attempts": _ATTEMPTS}
        limits = {
            "config_kwargs": {"connect_timeout": _CONNECT_S, "read_timeout": _ANSWER_S, "retries": retries}
        }
    try:
        from fsspec import filesystem  # noqa: PLC0415 - an extra

        # Only the scheme is passed on, because an address may chain file systems with ``::``.
        store = filesystem(scheme, listings_expiry_time=_LISTING_S, **limits)
    except ImportError as error:
        raise LogError(
            "no_object_store",
            f"the packages that read an object store are not installed ({error})",
            where=url,
            hint=name_install("s3"),
        ) from None
    if limits:
        store.retries = _ROUNDS
    return store


@contextmanager
def _name_errors(url: str) -> Iterator[None]:
    """Turn what the libraries of a store raise into a `LogError`; what is not there stays as it is."""
    try:
        yield
    except (FileNotFoundError, LogError):
        raise
    except Exception as error:  # noqa: BLE001 - credentials, host names, XML: no common type
        said = " ".join(str(error).split()) or type(error).__name__
        raise LogError(
            "log_unreachable",
            f"the object cannot be read ({said})",
            where=url,
            hint="Check the network, your credentials (AWS_ACCESS_KEY_ID, AWS_PROFILE, AWS_ENDPOINT_URL) "
            "and your right to the bucket",
        ) from None


class RemotePath(PosixPath):
    """A path in an object store, with the methods of a local path that logs and their configuration need.

    Methods raise `FileNotFoundError`, or `LogError` (``log_unreadable``) if the store does not answer.
    """

    def __str__(self) -> str:
        return _SCHEME.sub(r"\1://", super().__str__())

    def __fspath__(self) -> str:
        return str(self)

    def resolve(self, strict: bool = False) -> Self:  # noqa: ARG002, FBT001, FBT002 - pathlib's own signature
        """The path itself: object stores have no links."""
        return self

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
        """Size, modification time, and a hash of the version in place of an inode number."""
        del follow_symlinks
        info = self._look()
        if info["type"] == "directory":
            return os.stat_result((stat.S_IFDIR, 0, 0, 1, 0, 0, 0, 0, 0, 0), {"st_mtime_ns": 0})
        moment = info.get("LastModified") or info.get("created") or datetime.fromtimestamp(0, UTC)
        aware = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
        changed_s = round(aware.timestamp(), 3)
        return os.stat_result(
            (stat.S_IFREG, int(_name_version(info)[:15], 16), 0, 1, 0, 0, info["size"], 0, int(changed_s), 0),
            {"st_mtime_ns": round(changed_s * 1000) * 10**6, "st_mtime": changed_s},
        )

    def exists(self, **_: bool) -> bool:
        """Whether there is an object or a prefix with this name."""
        return self._type() is not None

    def is_file(self, **_: bool) -> bool:
        """Whether it is an object."""
        return self._type() == "file"

    def is_dir(self, **_: bool) -> bool:
        """Whether it is a prefix."""
        return self._type() == "directory"

    def glob(self, pattern: str, **_: bool | None) -> Iterator[Self]:  # type: ignore[override]
        """Objects and prefixes directly below this prefix whose names match."""
        children = (self._name(info["name"]) for info in _list(self))
        return (child for child in children if child.match(pattern))

    def open(self, mode: str = "rb", *_: object, **__: object) -> io.BytesIO:  # type: ignore[override]
        """Content of a small object, such as a configuration.

        Raises:
            OSError: it is larger than `MOST_BYTES`.
        """
        del mode
        if self._look()["size"] > MOST_BYTES:
            raise TooLargeError(self)
        with _name_errors(str(self)):
            return io.BytesIO(open_store(str(self)).cat_file(str(self)))

    def find_objects(self) -> list[Self]:
        """All objects below this prefix, sorted."""
        with _name_errors(str(self)):
            return sorted(map(self._name, open_store(str(self)).find(str(self))))

    def refresh(self) -> None:
        """Clear the cached listings, so that objects overwritten or added since are seen."""
        open_store(str(self)).invalidate_cache()

    def _name(self, key: str) -> Self:
        """Path of a bucket and key in the same store."""
        return type(self)(f"{self.parts[0]}//{key.strip('/')}")

    def _type(self) -> str | None:
        try:
            return str(self._look()["type"])
        except FileNotFoundError:
            return None

    def _look(self) -> dict[str, Any]:
        """Metadata of the object or prefix; the listing of its parent is cached for all its objects."""
        if len(self.parts) <= 2:  # noqa: PLR2004 - scheme and bucket
            return {"type": "directory", "size": 0}
        for info in _list(self.parent):
            if self._name(info["name"]) == self:
                return info
        raise FileNotFoundError(str(self))


def _list(path: RemotePath) -> list[dict[str, Any]]:
    with _name_errors(str(path)):
        return list(open_store(str(path)).ls(str(path), detail=True))


def to_location(path: str | os.PathLike[str]) -> Path:
    """Path from text, remote if it starts with a scheme, even if `Path` has removed a slash after it."""
    if isinstance(path, RemotePath):
        return path
    text = os.fspath(path)
    if text.startswith(_LOCAL):
        return Path(os.fsdecode(unquote_to_bytes(text.removeprefix(_LOCAL))))
    return RemotePath(text) if _SCHEME.match(text) else Path(path)


def locate_recorded(address: str, *, follow_remote: bool = False) -> Path:
    """Location of a log named in results, if access is allowed: results may come from an untrusted author.

    The author chooses the address, and a request informs its owner and may use the user's credentials. Local
    paths are always allowed.

    Args:
        address: address stated in the results.
        follow_remote: whether the user allowed requests to remote addresses.

    Raises:
        LogError: ``remote_not_followed``; ``no_object_store``, its scheme is not supported.
    """
    location = to_location(address)
    if isinstance(location, RemotePath):
        check_scheme(str(location))
        if not follow_remote:
            raise LogError(
                "remote_not_followed",
                "only the results name this address, and it was not asked",
                where=str(location),
                hint="Give the address itself if you trust it",
            )
    return location


def spell_location(path: Path) -> str:
    """Convert a path to UTF-8 text; `to_location` is the inverse.

    File names are bytes. Those that are not UTF-8 are written as a URL, ``file:///logs/caf%E9.mcap``.
    """
    text = str(path)
    try:
        text.encode()
    except UnicodeEncodeError:
        return _LOCAL + quote_from_bytes(os.fsencode(path))
    return text


class RemoteSource(AbstractContextManager["RemoteSource"]):
    """One version of an object, read by ranges from several threads at once.

    The version is asked for before the first range and after the last: if the object was overwritten
    meanwhile, closing raises an error.

    Args:
        path: the object.
        version: required version, from `RemoteSource.version`; None for any.

    Attributes:
        name: address of the object.
        size: its size [bytes].
        version: identifier of the content without reading it: SHA-256 (hex) of the ETag and size.
        fetched: number of bytes fetched so far.

    Raises:
        LogError: ``log_not_found``, ``log_unreadable``, ``log_empty``, ``log_changed``.
    """

    def __init__(self, path: RemotePath, version: str | None = None) -> None:
        self.name = str(path)
        self._store = open_store(self.name)
        self._lock = threading.Lock()
        self.fetched = 0
        info = self._look()
        if info is None:
            hint = "Check bucket and key"
            raise LogError("log_not_found", "there is no such object", where=self.name, hint=hint)
        self.size, self.version = int(info["size"]), _name_version(info)
        if not self.size:
            hint = "The recorder was stopped before it wrote anything; omit this file"
            raise LogError("log_empty", "the object is empty", where=self.name, hint=hint)
        self._require(self.version if version is None else version)
        self._tail_start = max(0, self.size - _TAIL)
        self._tail = self._fetch(self._tail_start, self.size)

    def read_at(self, offset: int, length: int) -> bytes:
        """The bytes from ``offset``; fewer than ``length`` only at the end."""
        end = min(offset + max(0, length), self.size)
        if end <= offset:
            return b""
        if offset >= self._tail_start:
            return self._tail[offset - self._tail_start : end - self._tail_start]
        return self._fetch(offset, end)

    def __exit__(self, *_exception: object) -> None:
        """Refuse what was read if the object is another by now.

        Raises:
            LogError: ``log_changed``, ``log_unreadable``.
        """
        info = self._look()
        self._require("" if info is None else _name_version(info))

    def _look(self) -> dict[str, Any] | None:
        """Metadata of the object, asked for anew; None if there is no such object."""
        with _name_errors(self.name):
            try:
                return dict(self._store.info(self.name, refresh=True))
            except FileNotFoundError:
                return None

    def _require(self, version: str) -> None:
        if version != self.version:
            hint = "Wait until it is no longer written, then run the same command again"
            what = "the object was overwritten or removed while it was read"
            raise LogError("log_changed", what, where=self.name, hint=hint)

    def _fetch(self, start: int, end: int) -> bytes:
        with _name_errors(self.name):
            fetched: bytes = self._store.cat_file(self.name, start=start, end=end)
            if len(fetched) != end - start:
                raise OSError(f"{len(fetched)} of {end - start} bytes came")
        with self._lock:
            self.fetched += len(fetched)
        return fetched


def _name_version(info: dict[str, Any]) -> str:
    marks = ("ETag", "etag", "LastModified", "created", "mtime")
    tag = next((info[mark] for mark in marks if info.get(mark)), 0)
    return hashlib.sha256(f"{tag} {info.get('size')}".encode()).hexdigest()
