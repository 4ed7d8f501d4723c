"""Reaching object stores: in bounded time, with plain errors, and never two versions of an object mixed."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from pipeline.logs.errors import LogError

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

Info = dict[str, object]

SCHEMES: Final = ("s3", "s3a", "memory")
"""Kinds of stores that are reached; what ``memory`` holds is in this process and gone with it."""

_LISTING_S: Final = 60
_CONNECT_S: Final = 5
_ANSWER_S: Final = 15
_ATTEMPTS: Final = 3
"""Of the request, with growing pauses, when a store is busy or gone."""

_ROUNDS: Final = 2
"""Of those attempts: together with the times above a store that is silent costs a minute and a half."""


class VersionChangedError(Exception):
    """An object is not the one that was opened."""


class _Plain:
    """A store whose every failure is an ``OSError``, whatever its libraries raise.

    Args:
        store: of fsspec.
    """

    def __init__(self, store: object) -> None:
        self._store = store

    def __getattr__(self, name: str) -> object:
        found = getattr(self._store, name)
        if not callable(found):
            return found

        def call(*given: object, **options: object) -> object:
            try:
                return found(*given, **options)
            except OSError:
                raise
            except Exception as error:
                # Missing credentials, a name that does not resolve, an answer that is no XML: no two alike.
                raise OSError(" ".join(str(error).split()) or type(error).__name__) from error

        return call


def check_scheme(url: str) -> str:
    """The kind of store of an address.

    Raises:
        LogError: ``no_object_store``, it is none that is reached.
    """
    scheme = url.partition(":")[0]
    if scheme not in SCHEMES:
        what = f"{scheme}:// addresses are not read"
        raise LogError("no_object_store", what, where=url, hint="Use s3://, or copy the data to this machine")
    return scheme


def open_store(url: str) -> AbstractFileSystem:
    """Reach the store of an address; nothing is asked of it yet.

    Raises:
        LogError: ``no_object_store``.
    """
    scheme = check_scheme(url)
    # A name without credentials or a host that is silent must be told in the time that somebody waits.
    limits: dict[str, object] = {}
    if scheme != "memory":
        retries = {"mode": "standard", "total_max_attempts": _ATTEMPTS}
        limits = {
            "config_kwargs": {"connect_timeout": _CONNECT_S, "read_timeout": _ANSWER_S, "retries": retries}
        }
    try:
        from fsspec import filesystem  # noqa: PLC0415 - an extra

        # By its name alone: an address may chain others behind ``::``.
        store = filesystem(scheme, listings_expiry_time=_LISTING_S, **limits)
    except ImportError as error:
        raise LogError(
            "no_object_store",
            f"what is needed to reach an object store is not installed ({error})",
            where=url,
            hint="pip install 'slip-pipeline[s3]'",
        ) from None
    if limits:
        store.retries = _ROUNDS
    return _Plain(store)


def unreachable(url: str, error: OSError) -> LogError:
    """The error for a store or an object that does not answer as it should."""
    return LogError(
        "log_unreadable",
        f"the object cannot be read ({' '.join(str(error).split())})",
        where=url,
        hint="Check the network, your credentials (AWS_ACCESS_KEY_ID, AWS_PROFILE, AWS_ENDPOINT_URL) "
        "and your right to the bucket",
    )


class FetchCount:
    """Bytes that this process has fetched from object stores: ``total`` so far."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.total = 0

    def add(self, count: int) -> None:
        """Count more."""
        with self._lock:
            self.total += count


FETCHED: Final = FetchCount()
"""Of this process: logs, and what configures them."""


def fetch_all(store: AbstractFileSystem, url: str) -> bytes:
    """All of a small object, counted.

    Raises:
        OSError: it cannot be read.
    """
    found: bytes = store.cat_file(url)
    FETCHED.add(len(found))
    return found


def fetch_range(
    store: AbstractFileSystem, url: str, start: int, end: int, *, known: Info, look: Callable[[], Info]
) -> bytes:
    """Bytes of the version of an object that is known, counted.

    S3 is asked for that version alone (``If-Match``), and what it says that it gave is compared. Stores
    without such a question are asked afterwards whether the object is still the same.

    Args:
        store: where it is.
        url: its address.
        start: first byte.
        end: behind the last byte.
        known: what the store said of the object when it was opened.
        look: asks the store what it says of the object now.

    Raises:
        VersionChangedError: the object is another one now.
        OSError: it cannot be read.
    """
    tag = known.get("ETag")
    if isinstance(tag, str) and tag and hasattr(store, "call_s3"):
        found = _fetch_matching(store, url, start, end, tag)
    else:
        found = store.cat_file(url, start=start, end=end)
        store.invalidate_cache()
        if describe_version(look()) != describe_version(known):
            raise VersionChangedError(url)
    FETCHED.add(len(found))
    if len(found) != end - start:
        raise OSError(f"{len(found)} of {end - start} bytes came")
    return found


def describe_version(info: Info) -> str:
    """What tells one version of an object from another."""
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
        except OSError as refused:
            if _is_refused_match(refused):
                raise VersionChangedError(url) from None
            raise
        if str(reply.get("ETag")).strip('"') != tag.strip('"'):
            raise VersionChangedError(url)
        try:
            found: bytes = sync(store.loop, reply["Body"].read)
        except Exception as broken:  # noqa: BLE001 - a connection that breaks off raises what its library likes
            error = broken
            continue
        return found
    raise OSError(f"the connection breaks off: {' '.join(str(error).split())}")


def _is_refused_match(error: OSError) -> bool:
    # s3fs hands the answer of the store on as the cause.
    answer = getattr(error.__cause__, "response", None)
    code = answer.get("Error", {}).get("Code") if isinstance(answer, dict) else None
    return code in {"PreconditionFailed", "412"}
