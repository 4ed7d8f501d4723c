"""The list of what stands in the results under a fixed name, what stands over it, and the hashes of logs."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from stat import S_ISDIR
from typing import TYPE_CHECKING

from pipeline.core.untrusted import PathError, check_name
from pipeline.logs import list_files
from pipeline.store import files
from pipeline.store.files import MANIFEST, Manifest, hash_bytes
from pipeline.store.names import StoreError, date_runs, join_inside
from pipeline.store.seals import Key, seal, unseal

if TYPE_CHECKING:
    from pipeline.store import Store

# The list of what stands in the results under a fixed name: manifests of runs, and files over all runs.
#
# What a manifest names is checked by its hash; nothing names the manifest. The list does: one small file for
# each, so that writers never wait for each other. An entry is written before its file is replaced and holds
# both hashes until it has been: killed in between, either content is right. A file that is not on the list
# was written before there was one.

LIST = "listed"
"""Folder of the list."""

ABSENT = ""
"""Stands for the hash of a file that is not there."""

_DIGITS = 32


@dataclass(frozen=True, kw_only=True)
class Entry:
    """What is known of a file.

    Attributes:
        path: its name in the results.
        sha256: hashes of what it may hold; two while it is being replaced, `ABSENT` among them where it may
            not be there.
        run: the run whose manifest it is; empty for another file.
        log: path of the log that the run was made of; empty where it is not known.
        signature: of a key over all of these; empty where none seals the results.
    """

    path: str
    sha256: tuple[str, ...]
    run: str = ""
    log: str = ""
    signature: str = ""

    def is_sealed_with(self, key: Key | None) -> bool:
        """Whether a key's signature is right; without a key there is nothing to be wrong."""
        return key is None or key.holds(self._content(), self.signature)

    def encode(self, key: Key | None) -> bytes:
        """The entry as the content of its file, sealed with a key if there is one."""
        content = self._content()
        return seal(content if key is None else {**content, "signature": key.sign(content)})

    def _content(self) -> dict[str, object]:
        return {name: value for name, value in asdict(self).items() if name != "signature"}


def entry_name(path: str) -> str:
    """Name in the results of the entry of a file."""
    return f"{LIST}/{hash_bytes(path.encode())[:_DIGITS]}.json"


def make_entry(path: str, *sha256: str, manifest: Manifest | None = None) -> Entry:
    """The entry of a file that may hold any of some contents."""
    hashes = tuple(dict.fromkeys(sha256))
    if manifest is None:
        return Entry(path=path, sha256=hashes)
    log = manifest.part("log").get("path")
    return Entry(path=path, sha256=hashes, run=manifest.run, log=log if isinstance(log, str) else "")


def parse_entry(data: bytes, name: str) -> Entry:
    """The entry in a file of the list.

    Args:
        data: its content.
        name: its name in the results.

    Raises:
        ValueError: it is damaged, or the entry of another file.
    """
    content = unseal(data)
    hashes = content.pop("sha256", None)
    texts = {key: text for key, text in content.items() if isinstance(text, str)}
    if not isinstance(hashes, list) or texts.keys() - {"signature"} != {"path", "run", "log"}:
        raise ValueError("it is not an entry of the list")
    entry = Entry(sha256=tuple(map(str, hashes)), **texts)
    try:
        check_name(entry.path, where=name)
    except PathError as error:
        raise ValueError(error.what) from None
    if entry_name(entry.path) != name:
        raise ValueError(f"it is the entry of {entry.path!r}")
    return entry


class Replacement:
    """A listed file that gets another content, in steps between which the writer may be killed.

    Args:
        root: the results folder.
        path: the file in it, whose folder exists and is locked.
        data: the new content; None to remove the file.
        manifest: what the content says, if it is a manifest.
        key: of the results.
    """

    def __init__(
        self,
        root: Path,
        path: Path,
        data: bytes | None,
        manifest: Manifest | None = None,
        *,
        key: Key | None,
    ) -> None:
        self._path, self._data, self._manifest, self._key = path, data, manifest, key
        self._name = path.relative_to(root).as_posix()
        self._entry_path = join_inside(root, entry_name(self._name))
        self._new = ABSENT if data is None else hash_bytes(data)
        self._drafted = files.temporary_beside(path)
        self.folder = self._entry_path.parent

    def draft(self) -> Path:
        """Write the entry for both contents beside the file; it has yet to be synced."""
        files.make_folder(self.folder)
        try:
            before = hash_bytes(self._path.read_bytes())
        except FileNotFoundError:
            before = ABSENT
        is_sealed = self._key is None or self._is_listed(before)
        files.draft_file(self._drafted, self._encode(self._new, *([before] if is_sealed else [])))
        return self._drafted

    def announce(self) -> None:
        """Put the entry on the list; its folder has yet to be synced."""
        self._drafted.replace(self._entry_path)

    def replace(self, *, when_written: Callable[[], None] = files.do_nothing) -> None:
        """Replace the file, and leave only the new content on the list."""
        if self._data is None:
            self._path.unlink(missing_ok=True)
        else:
            files.replace_file(self._path, self._data, when_written=when_written)
        # Whether this is done or not, the list is right.
        with suppress(OSError):
            if self._data is None:
                self._entry_path.unlink()
            else:
                files.draft_file(self._drafted, self._encode(self._new))
                self.announce()

    def discard(self) -> None:
        """Remove what a failed step left."""
        with suppress(OSError):
            self._drafted.unlink()

    def _is_listed(self, sha256: str) -> bool:
        """Whether the list says so, with the key's signature: nothing else is signed once more."""
        try:
            entry = parse_entry(self._entry_path.read_bytes(), entry_name(self._name))
        except FileNotFoundError:
            return sha256 == ABSENT
        except ValueError:
            return False
        return entry.is_sealed_with(self._key) and sha256 in entry.sha256

    def _encode(self, *sha256: str) -> bytes:
        return make_entry(self._name, *sha256, manifest=self._manifest).encode(self._key)


def replace_listed(
    root: Path, path: Path, data: bytes | None, manifest: Manifest | None = None, *, key: Key | None
) -> None:
    """Replace or remove a file and say so on the list; arguments as of `Replacement`.

    Raises:
        OSError: the old file is untouched, or the new one is there.
    """
    replacement = Replacement(root, path, data, manifest, key=key)
    try:
        files.sync_files([replacement.draft()])
        replacement.announce()
        files.sync_folder(replacement.folder)
        replacement.replace()
    finally:
        replacement.discard()


def is_run_manifest(name: str) -> bool:
    """Whether a name in the results is that of a run's manifest, if its folder is no generation."""
    parts = name.split("/")
    return parts[0] == "runs" and parts[-1] == MANIFEST and len(parts) in {3, 4}


# What stands over the list itself: which entries it has, and whether a key seals it.
#
# Both are files over all runs like any other, and on the list. The register keeps an entry from going
# unnoticed; it is renewed whenever a file over all runs is written, so that writers of runs never wait for
# each other.

REGISTER = "listed.json"
KEY_MARK = "sealed.json"


def parse_register(data: bytes | None) -> dict[str, str]:
    """Names of the files that are on the list, by the names of their entries; none where it is damaged."""
    try:
        entries = unseal(data or b"").get("entries")
    except ValueError:
        return {}
    items = entries.items() if isinstance(entries, dict) else ()
    return {name: path for name, path in items if isinstance(path, str) and entry_name(path) == name}


def renew_register(
    read: Callable[[str], bytes | None], names: Iterable[str], *, key: Key | None, without: str = ""
) -> bytes | None:
    """The register with the entries that were added to the list since.

    A register that is not what was written is left as it is, for whoever verifies the results.

    Args:
        read: the content of a file of the results by its name; None when there is none.
        names: names in the results of all entries.
        key: of the results.
        without: an entry that is about to be removed.

    Returns:
        The new content; None where nothing is to be written.
    """
    data = read(REGISTER)
    own = _read_entry(read, entry_name(REGISTER), key)
    if (data is None) != (own is None) or (data and own and hash_bytes(data) not in own.sha256):
        return None
    old = parse_register(data)
    new = {**old, entry_name(REGISTER): REGISTER}
    for name in names:
        if name not in new and name.startswith(f"{LIST}/") and name.endswith(".json"):
            entry = _read_entry(read, name, key)
            new |= {} if entry is None else {name: entry.path}
    new.pop(without, None)
    return None if new == old else seal({"entries": new})


def _read_entry(read: Callable[[str], bytes | None], name: str, key: Key | None) -> Entry | None:
    data = read(name)
    try:
        entry = None if data is None else parse_entry(data, name)
    except ValueError:
        return None
    return entry if entry is not None and entry.is_sealed_with(key) else None


def encode_mark(key: Key) -> bytes:
    """What says that results are sealed with a key, and with which."""
    return seal({"key": key.id})


def parse_mark(data: bytes | None) -> str | None:
    """Name of the key that results are sealed with; None where none seals them.

    Raises:
        ValueError: it is damaged.
    """
    return None if data is None else str(unseal(data).get("key"))


def require_key(data: bytes | None, key: Key | None, where: str) -> bool:
    """Refuse to write without the key of the results, or with another one: a seal must not get lost.

    Args:
        data: content of the mark; None when there is none.
        key: of whoever writes.
        where: the results.

    Returns:
        Whether nothing is left to do; not where there is a key and no mark.

    Raises:
        StoreError: ``key_missing``, ``other_key``, ``mark_damaged``.
    """
    try:
        known = parse_mark(data)
    except ValueError as error:
        what = f"{KEY_MARK}, which says what key seals the results, is damaged ({error})"
        hint = "Put the results back from a copy, or write to another folder with --results"
        raise StoreError("mark_damaged", what, where=where, hint=hint) from None
    if known is None:
        return key is None
    if key is None:
        what, hint = "the results are sealed with a key", "Name its file: --key FILE, or SLIP_KEY_FILE"
        raise StoreError("key_missing", what, where=where, hint=hint)
    if known != key.id:
        what, hint = (
            "the results are sealed with another key",
            "Give that one, or another folder with --results",
        )
        raise StoreError("other_key", what, where=where, hint=hint)
    return True


def not_sealed(where: str) -> StoreError:
    """The error for results that no key seals yet, of whoever writes with one."""
    return StoreError(
        "not_sealed",
        "there are results that no key seals",
        where=where,
        hint="Seal them as they are: slip results seal --key FILE; or use a new folder with --results",
    )


def changed_since_sealed(where: str) -> StoreError:
    """The error that a run is not as whoever has the key wrote it."""
    hint = "Look with `slip results verify`; --repair has the next batch make them again from the log"
    return StoreError(
        "not_sealed", "the results of the run have changed since they were sealed", where=where, hint=hint
    )


def require_unsealed(data: bytes | None, key: Key | None, where: str) -> Key:
    """The key that results are about to be sealed with.

    Args:
        data: content of the mark; None when there is none.
        key: of whoever seals.
        where: the results.

    Raises:
        StoreError: ``no_key``, ``sealed_already``.
    """
    if key is None:
        raise StoreError("no_key", "no key is given", where=where, hint="Add --key FILE")
    if data is not None:
        what, hint = (
            "the results are sealed with a key already",
            "Check them with it: slip results verify --key FILE",
        )
        raise StoreError("sealed_already", what, where=where, hint=hint)
    return key


@dataclass(frozen=True, kw_only=True)
class Partition:
    """The part of the runs that a question is about; what is not said is not asked.

    Attributes:
        vehicle: id of the vehicle.
        terrain: name of the terrain.
        dataset: name of the dataset.
        day: date of the run, ``2026-07-31``; a beginning such as ``2026-07`` stands for all in it.
    """

    vehicle: str | None = None
    terrain: str | None = None
    dataset: str | None = None
    day: str | None = None

    def select(self, manifests: Sequence[Manifest]) -> tuple[Manifest, ...]:
        """The runs that belong to it."""
        days = date_runs({one.run: one.start_ns for one in manifests}).days
        wanted = {"vehicle": self.vehicle, "terrain": self.terrain, "dataset": self.dataset}
        asked = {name: value for name, value in wanted.items() if value is not None}
        begins = self.day or ""
        return tuple(
            one
            for one in manifests
            if asked.items() <= one.summarize(None).items() and (days[one.run] or "").startswith(begins)
        )


# What the logs' hashes were, so that an unchanged log is not hashed again: one small file a log, replaced
# whole. Writers never wait for each other, and the worst that can happen to an entry is that it is lost,
# which costs a hash. A wrong answer would need a log that changed while its path, size, modification time and
# inode did not.

IDENTITIES = "identities"
_PARTS_DIGITS = 16

_TICK_NS = 20_000_000
"""Changes within this time may leave the same modification time: clocks of kernels tick every 1 to 10 ms."""


@dataclass(frozen=True, kw_only=True)
class LogSighting:
    """What a log looked like at a moment.

    Attributes:
        path: absolute, links resolved.
        size: bytes, of all parts of a split recording.
        mtime_ns: modification time [ns since 1970], the latest of a split recording's.
        inode: number of the file in its file system.
        seen_ns: when it was looked at [ns since 1970].
        parts: hash of what the file system tells of the parts of a split recording; empty for a file.
    """

    path: str
    size: int
    mtime_ns: int
    inode: int
    seen_ns: int
    parts: str = ""

    def is_same_file(self, other: LogSighting) -> bool:
        """Whether nothing that the file system tells has changed."""
        return replace(self, seen_ns=0) == replace(other, seen_ns=0)


def see_log(path: Path) -> LogSighting:
    """Look at a log before reading it.

    Raises:
        OSError: there is no such file.
    """
    seen_ns = time.time_ns()
    status = path.stat()
    sighting = LogSighting(
        path=str(path.resolve()),
        size=status.st_size,
        mtime_ns=status.st_mtime_ns,
        inode=status.st_ino,
        seen_ns=seen_ns,
    )
    if not S_ISDIR(status.st_mode):
        return sighting
    # A part may change without its folder noticing.
    parts = {part.name: part.stat() for part in list_files(path)}
    parts_seen = [[name, part.st_size, part.st_mtime_ns, part.st_ino] for name, part in sorted(parts.items())]
    return replace(
        sighting,
        size=sum(part.st_size for part in parts.values()),
        mtime_ns=max([status.st_mtime_ns, *(part.st_mtime_ns for part in parts.values())]),
        parts=hash_bytes(json.dumps(parts_seen).encode())[:_PARTS_DIGITS],
    )


class LogIdentities:
    """The remembered hashes of a results folder.

    Args:
        store: the results they stand beside.
    """

    def __init__(self, store: Store) -> None:
        self._notes = store.notes(IDENTITIES)

    def lookup(self, path: Path) -> str | None:
        """SHA-256 of a log that has not changed since it was remembered; None when it must be hashed."""
        try:
            now = see_log(path)
            content = dict(self._notes.read(now.path) or {})
            sha256 = content.pop("sha256")
            then = LogSighting(**content)  # type: ignore[arg-type]
        except (OSError, TypeError, KeyError):
            # Whatever is wrong with an entry, hashing the log is the answer to it.
            return None
        return str(sha256) if then.is_same_file(now) else None

    def remember(self, path: Path, sha256: str, *, seen: LogSighting | None = None) -> bool:
        """Remember the hash of a log; failing to is no error.

        Args:
            path: the log.
            sha256: its hash in hexadecimal.
            seen: what `see_log` said before the log was read; with it, a log that changed while it was read
                is not remembered.

        Returns:
            Whether it was remembered.
        """
        try:
            now = see_log(path)
            if seen is not None and not (seen.is_same_file(now) and seen.seen_ns - seen.mtime_ns > _TICK_NS):
                return False
        except OSError:
            return False
        return self._notes.write(now.path, {**asdict(now), "sha256": sha256})
