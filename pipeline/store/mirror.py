"""Results on an object store, through a mirror of them in a local folder.

Names of objects are given by whoever may write to the store: each becomes a path in the mirror or an error.

Generations never change, so what was fetched once is never fetched again. A run is published as on a disk:
its files first, its manifest last, in one request that takes place as a whole or not at all. Readers
therefore see whole runs, the old or the new. There are no locks between machines: of two that write one run
at the same time the later manifest stays; share the logs with ``--shard`` instead.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.core.untrusted import MOST_BYTES, TOO_LARGE
from pipeline.store import RUNS, Store
from pipeline.store.checksums import LOG_NOTES, decode_checked, encode_checked, encode_manifest, load_manifest
from pipeline.store.files import MANIFEST, MARKER, Manifest, hash_bytes, make_folder, replace_file
from pipeline.store.names import Sample, StoreError, encode_run, is_file_name, join_inside, name_disk_errors
from pipeline.store.verification import ABSENT, SEEN, Examination, examine_files

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

_TOGETHER = 200
"""Objects fetched by one call: bounds the memory that waits to be written."""


class Mirror:
    """Results under an address such as ``s3://bucket/results``.

    Args:
        address: where they are.
        folder: where they are mirrored; by default a folder of the user's cache.

    Attributes:
        store: the mirror, for everything that reads.
    """

    def __init__(self, address: str, folder: Path | None = None) -> None:
        self.address = address.rstrip("/")
        self.store = Store(folder or _default_folder(self.address))
        self._objects = _open_objects(self.address)
        self._prefix = self.address.partition("://")[2]

    def pull_index(self) -> None:
        """Fetch what tells what there is: manifests, notes on logs, tables over all runs.

        Raises:
            StoreError: ``store_unreachable``, or the mirror cannot be written.
        """
        with self._name_errors():
            self._objects.invalidate_cache()
            listed = self._list()
        wanted = [name for name in listed if _is_index(name)]
        self._forget_gone(listed)
        self._fetch_changed({name: listed[name] for name in wanted})

    def pull_run(self, run: str) -> None:
        """Fetch the current generation of a run, if there is one.

        Raises:
            StoreError: as `pull_index`.
        """
        home = f"{RUNS}/{encode_run(run)}"
        data = self.read(f"{home}/{MANIFEST}")
        if data is None:
            return
        self._put(f"{home}/{MANIFEST}", data)
        manifest = load_manifest(self.store.root / home)
        if manifest is not None:
            self._fetch(self._list_missing(manifest, manifest.names()))

    def pull_tables(self, names: Iterable[str], manifests: Iterable[Manifest]) -> None:
        """Fetch tables of the given generations that are not here yet.

        Raises:
            StoreError: as `pull_index`.
        """
        wanted = set(names)
        missing: dict[str, str] = {}
        for manifest in manifests:
            there = [name for name in manifest.names() if name in wanted]
            missing |= self._list_missing(manifest, there)
        self._fetch(missing)

    def push_run(self, manifest: Manifest) -> None:
        """Publish a generation of the mirror: its files, then its manifest.

        Raises:
            StoreError: as `pull_index`.
        """
        home = manifest.folder.parent.relative_to(self.store.root).as_posix()
        with self._name_errors():
            there = self._list(f"{home}/{manifest.folder.name}")
            marker = manifest.folder / MARKER
            paths = [manifest.path(name) for name in manifest.names()]
            for path in [*paths, marker] if marker.exists() else paths:
                locate = path.relative_to(self.store.root).as_posix()
                if there.get(locate, {}).get("size") != path.stat().st_size:
                    self._objects.pipe_file(self._address_of(locate), path.read_bytes())
            self._objects.pipe_file(self._address_of(f"{home}/{MANIFEST}"), encode_manifest(manifest))

    def push_file(self, name: str) -> None:
        """Publish a file over all runs, if the mirror has it.

        Raises:
            StoreError: as `pull_index`.
        """
        path = join_inside(self.store.root, name)
        if path.exists():
            with self._name_errors():
                self._objects.pipe_file(self._address_of(name), path.read_bytes())

    def push_note(self, name: str) -> None:
        """Publish a note on a log.

        Raises:
            StoreError: as `pull_index`.
        """
        path = self.store.notes(LOG_NOTES).path_of(name)
        if path.exists():
            with self._name_errors():
                locate = self._address_of(path.relative_to(self.store.root).as_posix())
                self._objects.pipe_file(locate, path.read_bytes())

    def prune(self, manifests: Iterable[Manifest]) -> int:
        """Publish shorter manifests, then remove the generations that they no longer name.

        Returns:
            How many generations were removed.

        Raises:
            StoreError: as `pull_index`.
        """
        removed: set[str] = set()
        for manifest in manifests:
            home = manifest.folder.parent.relative_to(self.store.root).as_posix()
            named = {manifest.folder.name, *manifest.earlier}
            with self._name_errors():
                self._objects.pipe_file(self._address_of(f"{home}/{MANIFEST}"), encode_manifest(manifest))
                inside = [(name, name.removeprefix(f"{home}/").split("/")) for name in self._list(home)]
                doomed = [name for name, parts in inside if len(parts) > 1 and parts[0] not in named]
                if doomed:
                    self._objects.rm([self._address_of(name) for name in doomed])
            removed |= {name.rpartition("/")[0] for name in doomed}
        return len(removed)

    def examine(self, sample: Sample | None = None) -> Examination:
        """Fetch and hash everything, or a sample; what is not what was written, and what cannot be judged.

        Raises:
            StoreError: as `pull_index`.
        """
        return examine_files(self, sample=sample)

    def remove(self, name: str) -> None:
        """As `Store.remove`.

        Raises:
            StoreError: as `pull_index`.
        """
        with self._name_errors(), suppress(FileNotFoundError):
            self._objects.rm([self._address_of(name)])
        self._hold(name).unlink(missing_ok=True)

    def names(self, skip: Callable[[Path, str], None]) -> Collection[str]:
        """Every name in the results on the store, which has no folders that could be skipped.

        Raises:
            StoreError: as `pull_index`.
        """
        del skip
        with self._name_errors():
            self._objects.invalidate_cache()
            return self._list()

    def read(self, name: str) -> bytes | None:
        """The content of a small object, such as a manifest or a note; None when there is none.

        Raises:
            StoreError: as `pull_index`; ``too_large``.
        """
        with self._name_errors():
            try:
                if self._objects.size(self._address_of(name)) > MOST_BYTES:
                    raise self._too_large(name)
                content: bytes = self._objects.cat_file(self._address_of(name))
            except FileNotFoundError:
                return None
            return content

    def hash(self, name: str) -> str:
        """SHA-256 of an object in hexadecimal; empty when there is none.

        Raises:
            StoreError: as `pull_index`.
        """
        with self._name_errors():
            try:
                return hash_bytes(self._objects.cat_file(self._address_of(name)))
            except FileNotFoundError:
                return ABSENT

    def locate(self, name: str) -> Path:
        """Where an object stands, or would stand, in the mirror."""
        return self.store.root / name

    def _list(self, under: str = "") -> dict[str, Mapping[str, object]]:
        """What the store says of the objects under a prefix, by their names in the results."""
        try:
            listed = self._objects.find(self._address_of(under) if under else self.address, detail=True)
        except FileNotFoundError:
            return {}
        return {self._name_of(locate): info for locate, info in listed.items()}

    def _name_of(self, locate: str) -> str:
        """Name in the results of an object, by the store's own name or by its address."""
        plain = locate.partition("://")[2] or locate
        return plain.removeprefix("/").removeprefix(f"{self._prefix}/")

    def _address_of(self, name: str) -> str:
        return f"{self.address}/{name}"

    def _fetch_changed(self, listed: Mapping[str, Mapping[str, object]]) -> None:
        seen_file = self.store.root / SEEN
        try:
            seen = decode_checked(seen_file.read_bytes())
        except (OSError, ValueError):
            seen = {}
        tags = {
            name: f"{info.get('ETag')} {info.get('size')} {info.get('created')}"
            for name, info in listed.items()
        }
        changed = [
            name for name, tag in tags.items() if seen.get(name) != tag or not self._hold(name).exists()
        ]
        for name in changed:
            if name.endswith(".json") and int(str(listed[name].get("size") or 0)) > MOST_BYTES:
                raise self._too_large(name)
        if changed or set(seen) - {""} != set(tags):
            self._fetch(dict.fromkeys(changed, ""))
            with name_disk_errors(seen_file):
                make_folder(self.store.root)
                replace_file(seen_file, encode_checked({"": "", **tags}))

    def _forget_gone(self, listed: Mapping[str, object]) -> None:
        """Runs and notes that are not on the store any more, or not yet, are not in the mirror either."""
        notes = (self.store.root / LOG_NOTES).glob("*/*.json")
        for path in (*(home / MANIFEST for home in self.store.run_dirs()), *notes):
            name = path.relative_to(self.store.root).as_posix()
            if name not in listed:
                self._hold(name).unlink(missing_ok=True)

    def _list_missing(self, manifest: Manifest, names: Iterable[str]) -> dict[str, str]:
        """Files of a generation that the mirror has not, and their hashes."""
        hashes = manifest.hashes()
        paths = {name: manifest.path(name) for name in names}
        return {
            path.relative_to(self.store.root).as_posix(): hashes[path.relative_to(manifest.folder).as_posix()]
            for path in paths.values()
            if not path.exists()
        }

    def _fetch(self, wanted: Mapping[str, str]) -> None:
        """Fetch objects by name; those with a hash must have it."""
        names = list(wanted)
        for start in range(0, len(names), _TOGETHER):
            some = names[start : start + _TOGETHER]
            with self._name_errors():
                contents = self._objects.cat([self._address_of(name) for name in some], on_error="return")
            for locate, data in contents.items():
                name = self._name_of(locate)
                # What was removed between the listing and now is simply not there.
                if isinstance(data, FileNotFoundError):
                    continue
                if isinstance(data, Exception):
                    raise self._unreachable(data)
                if wanted.get(name) not in {"", hash_bytes(data)}:
                    raise StoreError(
                        "file_damaged",
                        "an object of the results has changed since it was written",
                        where=self._address_of(name),
                        hint="Look with `slip results verify` for what else is damaged",
                    )
                self._put(name, data)

    def _put(self, name: str, data: bytes) -> None:
        path = self._hold(name)
        with name_disk_errors(path):
            make_folder(path.parent)
            replace_file(path, data)

    def _hold(self, name: str) -> Path:
        """The path of an object in the mirror.

        Raises:
            StoreError: ``bad_object_name``.
        """
        try:
            return join_inside(self.store.root, name)
        except StoreError as error:
            raise StoreError(
                "bad_object_name",
                f"an object cannot be a file of the results: {error.what}",
                where=self.address,
                hint="Nothing was written; remove that object, and find out who put it there",
            ) from None

    @contextmanager
    def _name_errors(self) -> Iterator[None]:
        try:
            yield
        except (OSError, ImportError) as error:
            raise self._unreachable(error) from error

    def _too_large(self, name: str) -> StoreError:
        hint = "It is not fetched: look at who wrote it, and remove it"
        return StoreError("too_large", TOO_LARGE, where=self._address_of(name), hint=hint)

    def _unreachable(self, error: Exception) -> StoreError:
        return StoreError(
            "store_unreachable",
            f"the store of the results refuses a request: {' '.join(str(error).split())}",
            where=self.address,
            hint="Check the network, the bucket and your rights, then run the same command again",
        )


def _is_index(name: str) -> bool:
    """Whether an object tells what there is; a store may hold others, which are none of ours."""
    is_note = name.startswith(f"{LOG_NOTES}/")
    looks_like_a_run = name.startswith(f"{RUNS}/") and name.endswith(f"/{MANIFEST}")
    return is_note or looks_like_a_run or (is_file_name(name) and "/" not in name and name != SEEN)


def _default_folder(address: str) -> Path:
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return cache / "slip" / "results" / hashlib.sha256(address.encode()).hexdigest()[:16]


def _open_objects(address: str) -> AbstractFileSystem:
    from pipeline.logs import LogError, open_store  # noqa: PLC0415 - only where results are on an object store

    try:
        return open_store(address)
    except LogError as error:
        raise StoreError(
            "no_object_store",
            f"the store of the results cannot be reached ({error.what})",
            where=address,
            hint="pip install 'slip-pipeline[s3]', and use an s3:// address",
        ) from None
