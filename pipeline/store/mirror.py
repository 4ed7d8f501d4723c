"""Results on an object store, through a mirror of them in a local folder.

Generations never change, so what was fetched once is never fetched again. A run is published as on a disk:
its files first, its manifest last, in one request that takes place as a whole or not at all. Readers
therefore see whole runs, the old or the new. There are no locks between machines: of two that write one run
at the same time the later manifest stays; share the logs with ``--shard`` instead.
"""

from __future__ import annotations

import hashlib
import json
import os
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, cast

from pipeline.store.errors import StoreError
from pipeline.store.files import make_folder, replace_file
from pipeline.store.manifest import MANIFEST, hash_bytes
from pipeline.store.manifest_file import encode_manifest, load_manifest
from pipeline.store.names import encode_run
from pipeline.store.notes import LOG_NOTES
from pipeline.store.results import RUNS, Store
from pipeline.store.verification import Problem

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from pipeline.store.manifest import Manifest

_SEEN = "mirror.json"
_TOGETHER = 200
"""Objects fetched by one call: bounds the memory that waits to be written."""


class _Objects(Protocol):
    """What is used of fsspec."""

    def find(self, path: str, *, detail: bool) -> Mapping[str, Mapping[str, object]]: ...

    def cat(self, path: list[str], *, on_error: str) -> Mapping[str, bytes | Exception]: ...

    def cat_file(self, path: str) -> bytes: ...

    def pipe_file(self, path: str, value: bytes) -> None: ...

    def rm(self, path: list[str]) -> None: ...

    def invalidate_cache(self) -> None: ...


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
            found = self._list()
        wanted = [
            name
            for name in found
            if name.endswith(f"/{MANIFEST}") or name.startswith(f"{LOG_NOTES}/") or "/" not in name
        ]
        self._forget_gone(found)
        self._fetch_changed({name: found[name] for name in wanted})

    def pull_run(self, run: str) -> None:
        """Fetch the current generation of a run, if there is one.

        Raises:
            StoreError: as `pull_index`.
        """
        home = f"{RUNS}/{encode_run(run)}"
        with self._name_errors():
            try:
                data = self._objects.cat_file(self._place(f"{home}/{MANIFEST}"))
            except FileNotFoundError:
                return
        self._put(f"{home}/{MANIFEST}", data)
        manifest = load_manifest(self.store.root / home)
        if manifest is not None:
            self._fetch_missing(manifest, manifest.names())

    def pull_tables(self, names: Iterable[str], manifests: Iterable[Manifest]) -> None:
        """Fetch tables of the given generations that are not here yet.

        Raises:
            StoreError: as `pull_index`.
        """
        wanted = set(names)
        missing: list[str] = []
        for manifest in manifests:
            there = [name for name in manifest.names() if name in wanted]
            missing += self._list_missing(manifest, there)
        self._fetch(missing)

    def push_run(self, manifest: Manifest) -> None:
        """Publish a generation of the mirror: its files, then its manifest.

        Raises:
            StoreError: as `pull_index`.
        """
        home = manifest.folder.parent.relative_to(self.store.root).as_posix()
        with self._name_errors():
            there = self._list(f"{home}/{manifest.folder.name}")
            for name in manifest.names():
                path = manifest.path(name)
                place = path.relative_to(self.store.root).as_posix()
                if there.get(place, {}).get("size") != path.stat().st_size:
                    self._objects.pipe_file(self._place(place), path.read_bytes())
            self._objects.pipe_file(self._place(f"{home}/{MANIFEST}"), encode_manifest(manifest))

    def push_file(self, name: str) -> None:
        """Publish a file of the results that belongs to no run, if the mirror has it.

        Raises:
            StoreError: as `pull_index`.
        """
        path = self.store.root / name
        if path.exists():
            with self._name_errors():
                self._objects.pipe_file(self._place(name), path.read_bytes())

    def push_note(self, name: str) -> None:
        """Publish a note on a log.

        Raises:
            StoreError: as `pull_index`.
        """
        path = self.store.notes(LOG_NOTES).path_of(name)
        self.push_file(path.relative_to(self.store.root).as_posix())

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
                self.push_file(f"{home}/{MANIFEST}")
                inside = [(name, name.removeprefix(f"{home}/").split("/")) for name in self._list(home)]
                doomed = [name for name, parts in inside if len(parts) > 1 and parts[0] not in named]
                if doomed:
                    self._objects.rm([self._place(name) for name in doomed])
            removed |= {name.rpartition("/")[0] for name in doomed}
        return len(removed)

    def verify(self) -> tuple[Problem, ...]:
        """Fetch and hash every file of every current generation; what differs from its manifest."""
        problems: list[Problem] = []
        for manifest in self.store.manifests():
            expected = {entry.file: entry.sha256 for entry in manifest.tables.values()}
            expected |= {name: entry.sha256 for name, entry in manifest.files.items()}
            for name, sha256 in sorted(expected.items()):
                path = manifest.folder / name
                problem = self._check(path, sha256)
                if problem is not None:
                    problems.append(Problem(run=manifest.run, path=path, code=problem[0], what=problem[1]))
        return tuple(problems)

    def _check(self, path: Path, sha256: str) -> tuple[str, str] | None:
        place = self._place(path.relative_to(self.store.root).as_posix())
        with self._name_errors():
            try:
                data = self._objects.cat_file(place)
            except FileNotFoundError:
                return "file_missing", "the object is gone"
        return None if hash_bytes(data) == sha256 else ("file_damaged", "the object is not what was written")

    def _list(self, under: str = "") -> dict[str, Mapping[str, object]]:
        """What the store says of the objects under a prefix, by their names in the results."""
        try:
            found = self._objects.find(self._place(under) if under else self.address, detail=True)
        except FileNotFoundError:
            return {}
        start = len(self._prefix) + 1
        return {name.strip("/")[start:]: info for name, info in found.items()}

    def _place(self, name: str) -> str:
        return f"{self.address}/{name}"

    def _fetch_changed(self, found: Mapping[str, Mapping[str, object]]) -> None:
        seen_file = self.store.root / _SEEN
        try:
            seen = json.loads(seen_file.read_bytes())
        except (OSError, ValueError):
            seen = {}
        tags = {
            name: f"{info.get('ETag')} {info.get('size')} {info.get('created')}"
            for name, info in found.items()
        }
        changed = [
            name
            for name, tag in tags.items()
            if seen.get(name) != tag or not (self.store.root / name).exists()
        ]
        if changed or set(seen) != set(tags):
            self._fetch(changed)
            make_folder(self.store.root)
            replace_file(seen_file, json.dumps(tags, sort_keys=True).encode())

    def _forget_gone(self, found: Mapping[str, object]) -> None:
        """Runs and notes that are not on the store any more, or not yet, are not in the mirror either."""
        for path in self.store.homes():
            name = (path / MANIFEST).relative_to(self.store.root).as_posix()
            if name not in found:
                (path / MANIFEST).unlink(missing_ok=True)
        for path in (self.store.root / LOG_NOTES).glob("*/*.json"):
            if path.relative_to(self.store.root).as_posix() not in found:
                path.unlink(missing_ok=True)

    def _fetch_missing(self, manifest: Manifest, names: Iterable[str]) -> None:
        self._fetch(self._list_missing(manifest, names))

    def _list_missing(self, manifest: Manifest, names: Iterable[str]) -> list[str]:
        paths = (manifest.path(name) for name in names)
        return [path.relative_to(self.store.root).as_posix() for path in paths if not path.exists()]

    def _fetch(self, names: list[str]) -> None:
        for start in range(0, len(names), _TOGETHER):
            some = names[start : start + _TOGETHER]
            with self._name_errors():
                found = self._objects.cat([self._place(name) for name in some], on_error="return")
            start_of_name = len(self._prefix) + 1
            for place, data in found.items():
                # What was removed between the listing and now is simply not there.
                if isinstance(data, FileNotFoundError):
                    continue
                if isinstance(data, Exception):
                    raise self._unreachable(data)
                plain = place.partition("://")[2] or place
                self._put(plain.strip("/")[start_of_name:], data)

    def _put(self, name: str, data: bytes) -> None:
        path = self.store.root / name
        make_folder(path.parent)
        replace_file(path, data)

    @contextmanager
    def _name_errors(self) -> Iterator[None]:
        try:
            yield
        except (OSError, ImportError) as error:
            raise self._unreachable(error) from error

    def _unreachable(self, error: Exception) -> StoreError:
        return StoreError(
            "store_unreachable",
            f"the store of the results does not do what is asked: {' '.join(str(error).split())}",
            where=self.address,
            hint="Check the network, the bucket and your rights, then run the same command again",
        )


def _default_folder(address: str) -> Path:
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return cache / "slip" / "results" / hashlib.sha256(address.encode()).hexdigest()[:16]


def _open_objects(address: str) -> _Objects:
    from pipeline.logs import LogError, open_store  # noqa: PLC0415 - only where results are on an object store

    try:
        return cast("_Objects", open_store(address))
    except LogError as error:
        raise StoreError(
            "no_object_store",
            f"the store of the results cannot be reached ({error.what})",
            where=address,
            hint="pip install 'slip-pipeline[s3]', and use an s3:// address",
        ) from None
