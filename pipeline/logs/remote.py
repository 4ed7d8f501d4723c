"""Logs in object stores, such as ``s3://bucket/logs/run.mcap``, read by byte ranges with timeouts."""

from __future__ import annotations

import hashlib
import io
import os
import re
import stat
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from pathlib import Path, PosixPath
from typing import TYPE_CHECKING, Final, Self, cast
from urllib.parse import quote_from_bytes, unquote_to_bytes

from pipeline.core import MOST_BYTES, TooLargeError
from pipeline.logs.records import LogError

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

Info = dict[str, object]

SCHEMES: Final = ("s3", "s3a", "memory")
"""Supported URL schemes; objects of ``memory`` exist only in this process."""

_LISTING_S: Final = 60
_CONNECT_S: Final = 5
_ANSWER_S: Final = 15
_ATTEMPTS: Final = 3
"""Maximum number of attempts per request, with increasing pauses, if a store is busy or unreachable."""

_ROUNDS: Final = 2
"""Rounds of these attempts: with the timeouts above, an unresponsive store takes about 90 s."""


class VersionChangedError(Exception):
    """An object differs from the version that was opened."""


class _Plain:
    """Wrapper of a store that converts all exceptions of its libraries to ``OSError``.

    Args:
        store: file system of fsspec.
    """

    def __init__(self, store: object) -> None:
        self._store = store

    def __getattr__(self, name: str) -> object:
        attribute = getattr(self._store, name)
        if not callable(attribute):
            return attribute

        def call(*given: object, **options: object) -> object:
            try:
                return attribute(*given, **options)
            except OSError:
                raise
            except Exception as error:
                # Missing credentials, an unresolved name or invalid XML raise unrelated types of exceptions.
                raise OSError(" ".join(str(error).split()) or type(error).__name__) from error

        return call


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
            hint="pip install 'slip-pipeline[s3]'",
        ) from None
    if limits:
        store.retries = _ROUNDS
    return _Plain(store)


def unreachable(url: str, error: OSError) -> LogError:
    """Error for a store or an object that cannot be read."""
    return LogError(
        "log_unreadable",
        f"the object cannot be read ({' '.join(str(error).split())})",
        where=url,
        hint="Check the network, your credentials (AWS_ACCESS_KEY_ID, AWS_PROFILE, AWS_ENDPOINT_URL) "
        "and your right to the bucket",
    )


class FetchCount:
    """Count of the bytes that this process has fetched from object stores, in ``total``."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.total = 0

    def add(self, count: int) -> None:
        """Add to the total."""
        with self._lock:
            self.total += count


FETCHED: Final = FetchCount()
"""Count of this process, for logs and their configuration."""


def fetch_all(store: AbstractFileSystem, url: str) -> bytes:
    """Fetch all of a small object, and count its bytes.

    Raises:
        OSError: it cannot be read.
    """
    fetched: bytes = store.cat_file(url)
    FETCHED.add(len(fetched))
    return fetched


def fetch_range(
    store: AbstractFileSystem, url: str, start: int, end: int, *, known: Info, look: Callable[[], Info]
) -> bytes:
    """Fetch a byte range of a known version of an object, and count its bytes.

    An S3 request is conditional on this version (``If-Match``), and the version in the response is compared.
    For stores without conditional requests, the version is compared after the request.

    Args:
        store: store of the object.
        url: address of the object.
        start: offset of the first byte.
        end: offset after the last byte.
        known: metadata of the object when it was opened.
        look: requests the current metadata of the object.

    Raises:
        VersionChangedError: the object has changed.
        OSError: it cannot be read.
    """
    tag = known.get("ETag")
    if isinstance(tag, str) and tag and hasattr(store, "call_s3"):
        fetched = _fetch_matching(store, url, start, end, tag)
    else:
        fetched = store.cat_file(url, start=start, end=end)
        store.invalidate_cache()
        if format_version(look()) != format_version(known):
            raise VersionChangedError(url)
    FETCHED.add(len(fetched))
    if len(fetched) != end - start:
        raise OSError(f"{len(fetched)} of {end - start} bytes came")
    return fetched


def format_version(info: Info) -> str:
    """Identifier of an object's version: its version id, ETag or time, and its size."""
    marks = ("VersionId", "ETag", "etag", "LastModified", "created", "mtime")
    tag = next((info[mark] for mark in marks if info.get(mark)), 0)
    return f"{tag} {info.get('size')}"


def _fetch_matching(store: AbstractFileSystem, url: str, start: int, end: int, tag: str) -> bytes:
    from fsspec.asyn import sync  # noqa: PLC0415 - an extra

    bucket, key, _ = store.split_path(url)
    error: Exception = OSError("nothing came")
    for _ in range(_ATTEMPTS):
        try:
            reply = store.call_s3(
                "get_object", Bucket=bucket, Key=key, Range=f"bytes={start}-{end - 1}", IfMatch=tag
            )
        except OSError as mismatch:
            if _is_changed(mismatch):
                raise VersionChangedError(url) from None
            raise
        if str(reply.get("ETag")).strip('"') != tag.strip('"'):
            raise VersionChangedError(url)
        try:
            fetched: bytes = sync(store.loop, reply["Body"].read)
        except Exception as broken:  # noqa: BLE001 - broken connections raise exceptions of no common type
            error = broken
            continue
        return fetched
    raise OSError(f"the connection was interrupted: {' '.join(str(error).split())}")


def _is_changed(error: OSError) -> bool:
    # s3fs stores the response of the store in the cause of the error.
    answer = getattr(error.__cause__, "response", None)
    code = answer.get("Error", {}).get("Code") if isinstance(answer, dict) else None
    return code in {"PreconditionFailed", "412"}


# Logs in object stores: paths such as ``s3://bucket/logs/run.mcap``, read by byte ranges.
#
# The metadata of an object (size, ETag, time) replaces the status of a file. Only requested ranges are
# fetched, and their bytes are counted.

_SCHEME = re.compile(r"^([a-z][a-z0-9+]+):/+")
_LOCAL: Final = "file://"
_TAIL: Final = 1 << 15
"""Number of bytes fetched from the end of an object when it is opened: a log's index is at its end."""

_OPENINGS: Final = 3
"""Maximum number of attempts to open an object that changes between its lookup and the first read."""


class RemotePath(PosixPath):
    """A path in an object store, with the methods of a local path that a batch uses."""

    def __str__(self) -> str:
        return _SCHEME.sub(r"\1://", super().__str__())

    def __fspath__(self) -> str:
        return str(self)

    def resolve(self, strict: bool = False) -> Self:  # noqa: ARG002, FBT001, FBT002 - pathlib's own signature
        """The path itself: object stores have no links."""
        return self

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
        """Size, modification time, and a hash of the version instead of an inode number.

        Raises:
            FileNotFoundError: there is no such object or prefix.
            LogError: ``log_unreadable``, the store cannot be read.
        """
        del follow_symlinks
        info = self.look()
        if info["type"] == "directory":
            return os.stat_result((stat.S_IFDIR, 0, 0, 1, 0, 0, 0, 0, 0, 0), {"st_mtime_ns": 0})
        inode = int(_name_version(info)[:15], 16)
        size = cast("int", info["size"])
        moment = _read_time(info)
        plain = (stat.S_IFREG, inode, 0, 1, 0, 0, size, 0, moment // 10**9, 0)
        return os.stat_result(plain, {"st_mtime_ns": moment, "st_mtime": moment / 1e9})

    def exists(self, **_: bool) -> bool:
        """Whether there is an object or a prefix with this name."""
        return bool(self._type())

    def is_file(self, **_: bool) -> bool:
        """Whether it is an object."""
        return self._type() == "file"

    def is_dir(self, **_: bool) -> bool:
        """Whether it is a prefix."""
        return self._type() == "directory"

    def glob(self, pattern: str, **_: bool | None) -> Iterator[Self]:  # type: ignore[override]
        """Objects and prefixes directly below this prefix whose names match."""
        for info in self._list(str(self)):
            child = type(self)(_add_scheme(self, str(info["name"])))
            if child.match(pattern):
                yield child

    def open(self, mode: str = "rb", *_: object, **__: object) -> io.BytesIO:  # type: ignore[override]
        """Content of a small object, such as a configuration.

        Raises:
            OSError: it cannot be read, or is larger than `MOST_BYTES`.
        """
        del mode
        if cast("int", self.look()["size"]) > MOST_BYTES:
            raise TooLargeError(self)
        return io.BytesIO(self.read_bytes())

    def read_bytes(self) -> bytes:
        """Content of the object."""
        return fetch_all(open_store(str(self)), str(self))

    def read_text(self, encoding: str | None = None, errors: str | None = None, **_: str) -> str:
        """Content of the object as text."""
        return self.read_bytes().decode(encoding or "utf-8", errors or "strict")

    def find_objects(self) -> list[Self]:
        """All objects below this prefix, sorted."""
        try:
            names = open_store(str(self)).find(str(self), detail=True)
        except OSError as error:
            raise unreachable(str(self), error) from None
        return sorted(type(self)(_add_scheme(self, name)) for name in names)

    def version(self) -> str:
        """Identifier of the content without reading it: SHA-256 (hex) of the version (ETag) and size.

        Raises:
            FileNotFoundError: there is no such object.
        """
        return _name_version(self.look())

    def refresh(self) -> None:
        """Clear the cached listings, so that objects overwritten or added since are seen."""
        open_store(str(self)).invalidate_cache()

    def _type(self) -> str:
        try:
            return str(self.look()["type"])
        except FileNotFoundError:
            return ""

    def look(self) -> Info:
        """Metadata of the object or prefix; one listing of the parent is cached for all its objects.

        Raises:
            FileNotFoundError: there is no such object or prefix.
            LogError: ``log_unreadable``, the store cannot be read.
        """
        if len(self.parts) <= 2:  # noqa: PLR2004 - scheme and bucket
            return {"type": "directory", "size": 0}
        plain = "/".join(self.parts[1:])
        for info in self._list(str(self.parent)):
            if str(info["name"]).strip("/") == plain:
                return info
        raise FileNotFoundError(str(self))

    def _list(self, url: str) -> list[Info]:
        try:
            listed: list[Info] = open_store(url).ls(url, detail=True)
        except FileNotFoundError:
            raise
        except OSError as error:
            raise unreachable(str(self), error) from None
        return listed


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

    All ranges are from the version that was opened: if the object is overwritten, reading raises an error.

    Args:
        path: the object.
        version: required version, from `RemoteSource.version`; None for any.

    Attributes:
        size: size when it was opened [bytes].
        name: address of the object.
        version: result of `RemotePath.version` when it was opened.
        fetched: number of bytes fetched so far.

    Raises:
        LogError: ``log_not_found``, ``log_unreadable``, ``log_empty``, ``log_changed``.
    """

    def __init__(self, path: RemotePath, version: str | None = None) -> None:
        self._path, self.name = path, str(path)
        self._store = open_store(self.name)
        self._lock = threading.Lock()
        self.fetched = 0
        # The cached metadata may be out of date: the first read fails if they are, and is then repeated.
        for attempt in range(_OPENINGS):
            if attempt:
                path.refresh()
            self._info = self._look()
            self.size = cast("int", self._info["size"])
            self.version = _name_version(self._info)
            self._tail_start = max(0, self.size - _TAIL)
            try:
                if version is None or version == self.version:
                    self._tail = self._fetch(self._tail_start, self.size)
                    return
            except LogError as error:
                if error.code != "log_changed":
                    raise
        raise _changed(path)

    def _look(self) -> Info:
        try:
            info = self._path.look()
        except FileNotFoundError:
            raise LogError(
                "log_not_found", "there is no such object", where=str(self._path), hint="Check bucket and key"
            ) from None
        if not info.get("size"):
            hint = "The recorder was stopped before it wrote anything; omit this file"
            raise LogError("log_empty", "the object is empty", where=str(self._path), hint=hint)
        return info

    def read_at(self, offset: int, length: int) -> bytes:
        """The bytes from ``offset``; fewer than ``length`` only at the end."""
        end = min(offset + max(0, length), self.size)
        if end <= offset:
            return b""
        if offset >= self._tail_start:
            return self._tail[offset - self._tail_start : end - self._tail_start]
        return self._fetch(offset, end)

    def _fetch(self, start: int, end: int) -> bytes:
        try:
            url, look = str(self._path), self._path.look
            fetched = fetch_range(self._store, url, start, end, known=self._info, look=look)
        except (VersionChangedError, FileNotFoundError):
            raise _changed(self._path) from None
        except OSError as error:
            raise unreachable(str(self._path), error) from None
        with self._lock:
            self.fetched += len(fetched)
        return fetched

    def __exit__(self, *_exception: object) -> None:
        """Do nothing: no resource is open."""


def _add_scheme(base: RemotePath, name: str) -> str:
    return f"{base.parts[0]}//{name.strip('/')}"


def _name_version(info: Info) -> str:
    return hashlib.sha256(format_version(info).encode()).hexdigest()


def _read_time(info: Info) -> int:
    moment = info.get("LastModified") or info.get("created")
    if not isinstance(moment, datetime):
        return 0
    aware = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return round(aware.timestamp() * 1000) * 1_000_000


def _changed(path: RemotePath) -> LogError:
    hint = "Wait until it is no longer written, then run the same command again"
    return LogError(
        "log_changed", "the object was overwritten or removed while it was read", where=str(path), hint=hint
    )
