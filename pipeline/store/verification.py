"""Are the results still what was written? The same examination for a folder and for an object store."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from pipeline.store.errors import StoreError
from pipeline.store.listing import ABSENT, LIST, Entry, entry_name, is_run_manifest, parse_entry
from pipeline.store.manifest import MANIFEST, MARKER, Manifest, hash_bytes, hash_file
from pipeline.store.manifest_file import parse_manifest, parse_marker
from pipeline.store.names import check_home, is_file_name
from pipeline.store.notes import NOTES
from pipeline.store.seals import check_seal, unseal

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping
    from pathlib import Path

    from pipeline.store.mirror import Mirror

RUNS = "runs"
_SEEN = "mirror.json"


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One file that cannot be trusted.

    Attributes:
        run: the run it belongs to; its folder where the manifest itself is the problem; empty for a file that
            belongs to none.
        path: the file.
        code: ``file_missing``, ``file_damaged``, ``manifest_damaged``, ``manifest_swapped``, ``run_missing``,
            ``not_listed``, ``name_clash``, ``old_generation``, ``list_damaged``, ``note_damaged``, ...
        what: what is wrong, one sentence without a full stop.
        home: folder of the run in the results; empty for a file that belongs to none.
    """

    run: str
    path: Path
    code: str
    what: str
    home: str = ""


@dataclass(frozen=True, kw_only=True)
class Examination:
    """What was found.

    Attributes:
        problems: what is not what was written.
        unlisted: names in the results that nothing tells the right content of: they were written before there
            was a list.
        entries: the list, by the name in the results.
    """

    problems: tuple[Problem, ...]
    unlisted: tuple[str, ...]
    entries: Mapping[str, Entry]


class DiskFiles:
    """The files of a results folder.

    Args:
        root: the folder.
    """

    def __init__(self, root: Path) -> None:
        self._root = root

    def names(self) -> Collection[str]:
        """Every name in the results; links are not followed."""
        found = set()
        for folder, _, files in os.walk(self._root):
            start = os.path.relpath(folder, self._root)
            found |= {name if start == "." else f"{start}/{name}" for name in files}
        return found

    def read(self, name: str) -> bytes | None:
        """The content of a file; None when there is none."""
        path = self.place(name)
        try:
            return path.read_bytes() if path.is_file() else None
        except FileNotFoundError:
            return None

    def hash(self, name: str) -> str:
        """SHA-256 of a file in hexadecimal; `ABSENT` when there is none."""
        path = self.place(name)
        try:
            return ABSENT if path.is_symlink() or not path.is_file() else hash_file(path)
        except FileNotFoundError:
            return ABSENT

    def place(self, name: str) -> Path:
        """The path to show."""
        return self._root / name


def examine_files(files: DiskFiles | Mirror) -> Examination:
    """Read all results again, and hold them against what says what they were."""
    return _Examiner(files).examine()


class _Examiner:
    def __init__(self, files: DiskFiles | Mirror) -> None:
        self._files = files
        self._names = files.names()
        self._entries: dict[str, Entry] = {}
        self._unlisted: list[str] = []
        # A generation's folder may hold a file of any name, and runs may stand beside it.
        self._folders = {name.rpartition("/")[0] for name in self._names if name.endswith(f"/{MARKER}")}

    def examine(self) -> Examination:
        problems = [*self._read_list()]
        listed = {name for name in self._entries if is_run_manifest(name)}
        there = {name for name in self._names if is_run_manifest(name)}
        for name in sorted((there | listed) - {f"{folder}/{MANIFEST}" for folder in self._folders}):
            home = name.removesuffix(f"/{MANIFEST}")
            problems += [replace(problem, home=home) for problem in self._examine_run(name)]
        plain = {name for name in self._names if is_file_name(name) and "/" not in name and name != _SEEN}
        for name in sorted(plain | (set(self._entries) - listed)):
            problems += self._examine_plain(name)
        problems += self._examine_notes()
        return Examination(
            problems=tuple(problems), unlisted=tuple(self._unlisted), entries=dict(self._entries)
        )

    def _read_list(self) -> Iterator[Problem]:
        for name in sorted(name for name in self._names if name.startswith(f"{LIST}/")):
            try:
                entry = self._look_up(name)
            except (ValueError, OSError) as error:
                yield self._problem("", name, "list_damaged", f"the entry of the list is damaged ({error})")
            else:
                if entry is not None:
                    self._entries[entry.path] = entry

    def _look_up(self, name: str) -> Entry | None:
        data = self._files.read(name)
        return None if data is None else parse_entry(data, name)

    def _has_newer_entry(self, name: str) -> bool:
        """Whether the entry of a file is another one by now, which is then the one that counts."""
        try:
            newer = self._look_up(entry_name(name))
        except (ValueError, OSError):
            return False
        if newer is None or newer == self._entries.get(name):
            return False
        self._entries[name] = newer
        return True

    def _examine_run(self, name: str) -> list[Problem]:
        """Problems of a run; looked at again when somebody has written it meanwhile."""
        while True:
            entry, unlisted = self._entries.get(name), len(self._unlisted)
            try:
                data = self._files.read(name)
                problems = self._judge_run(name, data, entry)
                is_clean = not problems and len(self._unlisted) == unlisted
                if is_clean or not (self._has_newer_entry(name) or self._files.read(name) != data):
                    return problems
            except OSError as error:
                return [self._problem(_place_of(name), name, "disk_error", _say(error))]
            del self._unlisted[unlisted:]

    def _judge_run(self, name: str, data: bytes | None, entry: Entry | None) -> list[Problem]:
        run = _place_of(name)
        if data is None:
            if entry is None or ABSENT in entry.sha256:
                return []
            return [self._problem(entry.run or run, name, "run_missing", "the manifest of the run is gone")]
        home = self._files.place(name).parent
        try:
            manifest = parse_manifest(data, home)
        except StoreError as error:
            return [Problem(run=run, path=home, code=error.code, what=str(error))]
        try:
            check_home(manifest.run, home, top=self._files.place(RUNS))
        except StoreError as error:
            return [Problem(run=run, path=home / MANIFEST, code=error.code, what=error.what)]
        if entry is not None and hash_bytes(data) not in entry.sha256:
            what = "the manifest is not the one that was written here last"
            return [self._problem(manifest.run, name, "manifest_swapped", what)]
        return [*self._judge_listing(name, data, entry, manifest), *self._judge_files(manifest, run)]

    def _judge_listing(
        self, name: str, data: bytes, entry: Entry | None, manifest: Manifest
    ) -> Iterator[Problem]:
        if entry is not None:
            return
        if check_seal(data):
            what = "the run is not on the list: it was copied here, or its entry is gone"
            yield self._problem(manifest.run, name, "not_listed", what)
        else:
            self._unlisted.append(name)

    def _judge_files(self, manifest: Manifest, place: str) -> Iterator[Problem]:
        folder = f"{RUNS}/{place}/{manifest.folder.name}"
        marker = self._files.read(f"{folder}/{MARKER}")
        if marker:
            try:
                is_right = parse_marker(marker) == manifest.hashes()
            except ValueError:
                is_right = False
            if not is_right:
                what = "the file is not what was written"
                yield self._problem(manifest.run, f"{folder}/{MARKER}", "file_damaged", what)
        elif marker is None:
            self._unlisted.append(f"{folder}/{MARKER}")
        yield from self._compare(manifest.run, folder, manifest.hashes())
        for earlier in manifest.earlier:
            yield from self._judge_earlier(manifest, f"{RUNS}/{place}/{earlier}")

    def _judge_earlier(self, manifest: Manifest, folder: str) -> Iterator[Problem]:
        """Problems of a generation that is not current, all of one kind: nothing is made of it any more."""
        marker = self._files.read(f"{folder}/{MARKER}")
        if not marker:
            if any(name.startswith(f"{folder}/") for name in self._names):
                self._unlisted.append(f"{folder}/{MARKER}")
            else:
                yield self._problem(manifest.run, folder, "old_generation", "the old generation is gone")
            return
        try:
            problems = [*self._compare(manifest.run, folder, parse_marker(marker))]
        except ValueError as error:
            what = f"in an old generation: the file is damaged: {error}"
            yield self._problem(manifest.run, f"{folder}/{MARKER}", "old_generation", what)
            return
        for problem in problems:
            what = f"in an old generation: {problem.what}"
            yield Problem(run=manifest.run, path=problem.path, code="old_generation", what=what)

    def _compare(self, run: str, folder: str, expected: Mapping[str, str]) -> Iterator[Problem]:
        for name, sha256 in expected.items():
            path = f"{folder}/{name}"
            try:
                found = self._files.hash(path)
            except OSError as error:
                yield self._problem(run, path, "disk_error", _say(error))
                continue
            if found == ABSENT:
                yield self._problem(run, path, "file_missing", "the file is gone")
            elif found != sha256:
                yield self._problem(run, path, "file_damaged", "the file is not what was written")

    def _examine_plain(self, name: str) -> list[Problem]:
        """Problems of a file over all runs."""
        while True:
            entry = self._entries.get(name)
            try:
                found = self._files.hash(name)
            except OSError as error:
                return [self._problem("", name, "disk_error", _say(error))]
            if entry is not None and found in entry.sha256:
                return []
            if not self._has_newer_entry(name):
                break
        if entry is None:
            self._unlisted.append(name)
            return []
        if found == ABSENT:
            return [self._problem("", name, "file_missing", "the file is gone")]
        return [self._problem("", name, "file_damaged", "the file is not what was written")]

    def _examine_notes(self) -> Iterator[Problem]:
        for name in sorted(name for name in self._names if name.startswith(NOTES) and name.endswith(".json")):
            try:
                data = self._files.read(name)
                if data is not None:
                    unseal(data)
            except (ValueError, OSError) as error:
                what = f"the note is damaged and is not used ({error}); nothing but time is lost by it"
                yield self._problem("", name, "note_damaged", what)

    def _problem(self, run: str, name: str, code: str, what: str) -> Problem:
        return Problem(run=run, path=self._files.place(name), code=code, what=what)


def _place_of(name: str) -> str:
    """Folder of a run below the folder of all runs, by the name of its manifest."""
    return name.removeprefix(f"{RUNS}/").removesuffix(f"/{MANIFEST}")


def _say(error: OSError) -> str:
    return f"the file cannot be read: {error.strerror}"
