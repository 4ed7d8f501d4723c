"""Results on an object store: copies of finished generations, through a folder that mirrors them.

A run is copied up as it is published on a disk: its files first, its manifest last, in one request that takes
place as a whole or not at all. Readers therefore see whole runs, the old or the new. What is missing in the
mirror, or another than on the store, is copied down. There are no locks between machines: of two that write
one run at the same time the later manifest stays, and the files of both; share the logs with ``--shard``
instead.

Names of objects are given by whoever may write to the store: each becomes a path in the mirror or an error.
"""

from __future__ import annotations

import errno
import hashlib
import os
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from glob import escape
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.store.checksums import LOG_NOTES, encode_manifest, load_manifest, parse_manifest
from pipeline.store.files import (
    MANIFEST,
    MARKER,
    Manifest,
    hash_bytes,
    hash_file,
    make_folder,
)
from pipeline.store.names import Sample, StoreError, encode_run, is_file_name, join_inside, name_disk_errors
from pipeline.store.results_folder import RUNS, Store
from pipeline.store.verification import ABSENT, Examination, examine_files

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

_OF_THE_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
"""Errors that only the disk of the mirror has."""


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
        self._listed: Mapping[str, Mapping[str, object]] = {}

    def pull_index(self) -> None:
        """Fetch what tells what there is: manifests, notes on logs, tables over all runs.

        Raises:
            StoreError: ``store_unreachable``, or the mirror cannot be written.
        """
        there = self._list()
        notes = (self.store.root / LOG_NOTES).glob("*/*.json")
        for name in map(self._name_of, (*(home / MANIFEST for home in self.store.run_dirs()), *notes)):
            if name not in there:
                self._hold(name).unlink(missing_ok=True)
        self._fetch({name: "" for name in there if _is_index(name) and not self._is_same(name)})

    def pull_run(self, run: str) -> None:
        """Fetch the current generation of a run, if there is one.

        Raises:
            StoreError: as `pull_index`; ``file_damaged``.
        """
        home = f"{RUNS}/{encode_run(run)}"
        if f"{home}/{MANIFEST}" in self._list(home):
            self._fetch({f"{home}/{MANIFEST}": ""})
            manifest = load_manifest(self.store.root / home)
            if manifest is not None:
                self._fetch(self._list_missing(manifest, manifest.names()))

    def pull_tables(self, names: Iterable[str], manifests: Iterable[Manifest]) -> None:
        """Fetch tables of the given generations that are not here yet, after `pull_index`.

        Raises:
            StoreError: as `pull_run`.
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
        self._list(self._name_of(manifest.folder))
        marker = manifest.folder / MARKER
        paths = [*map(manifest.path, manifest.names()), *([marker] if marker.exists() else [])]
        changed = [path for path in paths if not self._is_same(self._name_of(path))]
        with self._name_errors():
            self._objects.put([str(path) for path in changed], [self._address_of(path) for path in changed])
        self._publish(manifest)

    def push_file(self, path: Path) -> None:
        """Publish a file of the mirror that belongs to no generation, if it is there.

        Raises:
            StoreError: as `pull_index`.
        """
        if path.exists():
            with self._name_errors():
                self._objects.put_file(str(path), self._address_of(path))

    def prune(self, removed: Iterable[Path]) -> int:
        """Remove generations that were removed from the mirror; first, the manifests forget them.

        A run that another machine has published since is left to that one, and so is what no manifest names:
        somebody may be about to publish it.

        Returns:
            How many generations were removed.

        Raises:
            StoreError: as `pull_index`, or a manifest is damaged.
        """
        count = 0
        for home, folders in groupby(sorted(removed), key=lambda folder: folder.parent):
            ours, theirs = load_manifest(home), self.read(self._name_of(home / MANIFEST))
            published = None if theirs is None else parse_manifest(theirs, home)
            if ours is None or published is None or published.folder != ours.folder:
                continue
            self._publish(ours)
            old = [folder for folder in folders if folder.name in published.earlier]
            doomed = [name for folder in old for name in self._list(self._name_of(folder))]
            if doomed:
                with self._name_errors():
                    # Names are no patterns, even with brackets in them.
                    self._objects.rm([escape(self._address_of(name)) for name in doomed])
            count += len(old)
        return count

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
            self._objects.rm_file(self._address_of(name))
        self._hold(name).unlink(missing_ok=True)

    def names(self, skip: Callable[[Path, str], None]) -> Collection[str]:
        """Every name in the results on the store, which has no folders that could be skipped.

        Raises:
            StoreError: as `pull_index`.
        """
        del skip
        return self._list()

    def read(self, name: str) -> bytes | None:
        """The content of a small object, such as a manifest or a note; None when there is none.

        Raises:
            StoreError: as `pull_index`.
        """
        with self._name_errors():
            try:
                content: bytes = self._objects.cat_file(self._address_of(name))
            except FileNotFoundError:
                return None
            return content

    def hash(self, name: str) -> str:
        """SHA-256 of an object in hexadecimal; empty when there is none.

        Raises:
            StoreError: as `pull_index`.
        """
        content = self.read(name)
        return ABSENT if content is None else hash_bytes(content)

    def locate(self, name: str) -> Path:
        """Where an object stands, or would stand, in the mirror."""
        return self.store.root / name

    def _list(self, under: str = "") -> Mapping[str, Mapping[str, object]]:
        """What the store says of the objects under a prefix, by their names in the results."""
        self._listed = {}
        with self._name_errors(), suppress(FileNotFoundError):
            self._objects.invalidate_cache()
            listed = self._objects.find(f"{self.address}/{under}".rstrip("/"), detail=True)
            start = f"{self._prefix}/"
            self._listed = {name.lstrip("/").removeprefix(start): info for name, info in listed.items()}
        return self._listed

    def _name_of(self, path: Path) -> str:
        return path.relative_to(self.store.root).as_posix()

    def _address_of(self, name: str | Path) -> str:
        return f"{self.address}/{name if isinstance(name, str) else self._name_of(name)}"

    def _is_same(self, name: str) -> bool:
        """Whether an object is what the mirror holds: the tag of most objects is the MD5 of their content.

        What has another tag, such as an encrypted object, is copied again, which costs time only.
        """
        path, tag = self._hold(name), self._listed.get(name, {}).get("ETag")
        if tag is None or not path.is_file():
            return False
        return hashlib.md5(path.read_bytes(), usedforsecurity=False).hexdigest() == str(tag).strip('"')

    def _list_missing(self, manifest: Manifest, names: Iterable[str]) -> dict[str, str]:
        """Files of a generation that the mirror has not, or not whole, and their hashes."""
        sizes = {entry.file: entry.bytes for entry in manifest.tables.values()}
        sizes |= {name: entry.bytes for name, entry in manifest.files.items()}
        hashes, missing = manifest.hashes(), {}
        for path in map(manifest.path, names):
            name = path.relative_to(manifest.folder).as_posix()
            if not path.is_file() or path.stat().st_size != sizes[name]:
                missing[self._name_of(path)] = hashes[name]
        return missing

    def _fetch(self, wanted: Mapping[str, str]) -> None:
        """Fetch objects by name, those that are there; those with a hash must have it."""
        paths = {name: self._hold(name) for name in wanted if name in self._listed}
        if not paths:
            return
        with name_disk_errors(self.store.root):
            make_folder(self.store.root)
            # An interrupted copy never stands under its name.
            scratch = tempfile.TemporaryDirectory(prefix=".copies-", dir=self.store.root)
        with scratch as folder:
            copies = [Path(folder, str(number)) for number in range(len(paths))]
            with self._name_errors():
                self._objects.get([self._address_of(name) for name in paths], [str(copy) for copy in copies])
            for (name, path), copy in zip(paths.items(), copies, strict=True):
                if wanted[name] not in {"", hash_file(copy)}:
                    raise StoreError(
                        "file_damaged",
                        "an object of the results has changed since it was written",
                        where=self._address_of(name),
                        hint="Look with `slip results verify` for what else is damaged",
                    )
                with name_disk_errors(path):
                    make_folder(path.parent)
                    copy.replace(path)

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

    def _publish(self, manifest: Manifest) -> None:
        address = self._address_of(manifest.folder.parent / MANIFEST)
        with self._name_errors():
            self._objects.pipe_file(address, encode_manifest(manifest))

    @contextmanager
    def _name_errors(self) -> Iterator[None]:
        try:
            yield
        except (OSError, ImportError) as error:
            if isinstance(error, OSError) and error.errno in _OF_THE_DISK:
                with name_disk_errors(self.store.root):
                    raise
            what = f"the store of the results refuses a request: {' '.join(str(error).split())}"
            hint = (
                "Check the network, the bucket, your rights to it and your credentials (AWS_PROFILE, "
                "AWS_ACCESS_KEY_ID, AWS_ENDPOINT_URL), then run the same command again"
            )
            raise StoreError("store_unreachable", what, where=self.address, hint=hint) from error


def _is_index(name: str) -> bool:
    """Whether an object tells what there is; a store may hold others, which are none of ours."""
    is_note = name.startswith(f"{LOG_NOTES}/")
    looks_like_a_run = name.startswith(f"{RUNS}/") and name.endswith(f"/{MANIFEST}")
    return is_note or looks_like_a_run or (is_file_name(name) and "/" not in name)


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
