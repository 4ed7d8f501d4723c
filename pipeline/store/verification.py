"""Are the results still what was written? The same examination for a folder and for an object store."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pipeline.core.untrusted import walk_files
from pipeline.store.files import MANIFEST, MARKER, Manifest, do_nothing, hash_bytes, hash_file
from pipeline.store.listing import (
    ABSENT,
    KEY_MARK,
    LIST,
    REGISTER,
    Entry,
    entry_name,
    is_run_manifest,
    parse_entry,
    parse_mark,
    parse_register,
)
from pipeline.store.names import Sample, StoreError, Tally, check_home, is_file_name
from pipeline.store.seals import NOTES, Key, check_seal, encode_marker, parse_manifest, parse_marker, unseal

if TYPE_CHECKING:
    from pipeline.store.mirror import Mirror

RUNS = "runs"
Seal = Literal["none", "not_checked", "checked"]
SEEN = "mirror.json"


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One file that cannot be trusted.

    Attributes:
        run: the run it belongs to; its folder where the manifest itself is the problem; empty for a file that
            belongs to none.
        path: the file.
        code: ``file_missing``, ``file_damaged``, ``manifest_damaged``, ``manifest_swapped``, ``run_missing``,
            ``not_listed``, ``not_sealed``, ``other_key``, ``name_clash``, ``old_generation``, ``extra_file``,
            ``list_damaged``, ``note_damaged``, ``path_unread``, ...
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
        seal: whether a key seals the results: ``none``; ``not_checked``, there was none to check it with;
            ``checked``, with what came of it among the problems.
        files: how many files of how many were hashed.
    """

    problems: tuple[Problem, ...]
    unlisted: tuple[str, ...]
    entries: Mapping[str, Entry]
    seal: Seal = "none"
    files: Tally = field(default_factory=Tally)


class DiskFiles:
    """The files of a results folder.

    Args:
        root: the folder.
    """

    def __init__(self, root: Path) -> None:
        self._root = root

    def names(self, skip: Callable[[Path, str], None]) -> Collection[str]:
        """Every name in the results; links are not followed.

        Args:
            skip: told of each folder that is left out, and why.
        """
        start = len(str(self._root)) + 1
        return {entry.path[start:] for entry in walk_files(self._root, skip)}

    def read(self, name: str) -> bytes | None:
        """The content of a file; None when there is none."""
        path = self.locate(name)
        try:
            return path.read_bytes() if path.is_file() else None
        except FileNotFoundError:
            return None

    def hash(self, name: str) -> str:
        """SHA-256 of a file in hexadecimal; `ABSENT` when there is none."""
        path = self.locate(name)
        try:
            return ABSENT if path.is_symlink() or not path.is_file() else hash_file(path)
        except FileNotFoundError:
            return ABSENT

    def locate(self, name: str) -> Path:
        """The path to show."""
        return self._root / name


def examine_files(
    files: DiskFiles | Mirror, *, key: Key | None = None, sample: Sample | None = None
) -> Examination:
    """Read all results again, and hold them against what says what they were.

    Args:
        files: the results.
        key: that seals them.
        sample: of the files, those that are hashed; None for all.
    """
    return _Examiner(files, key, sample).examine()


def seal_entries(files: DiskFiles | Mirror, key: Key) -> Iterator[tuple[str, bytes]]:
    """Entries of the list and markers of generations, sealed with a key: names and contents.

    Raises:
        StoreError: ``not_whole``, something is wrong with the results, or nothing says that it is not.
    """
    seen = examine_files(files)
    if seen.problems or seen.unlisted:
        first = seen.problems[0].path if seen.problems else files.locate(seen.unlisted[0])
        what = f"{len(seen.problems) + len(seen.unlisted)} of the files may not be what was written"
        hint = "See `slip results verify`, and its --repair; only intact results are sealed"
        raise StoreError("not_whole", what, where=str(first), hint=hint)
    for entry in seen.entries.values():
        yield entry_name(entry.path), replace(entry, signature="").encode(key)
    for name in files.names(do_nothing):
        data = files.read(name) if name.endswith(f"/{MARKER}") else None
        if data:
            run = str(unseal(data).get("run"))
            yield name, encode_marker(run, parse_marker(data), key)


class _Examiner:
    def __init__(self, files: DiskFiles | Mirror, key: Key | None, sample: Sample | None) -> None:
        self._files = files
        self._unread: list[Problem] = []
        self._names = files.names(self._leave_out)
        self._sorted = sorted(self._names)
        self._entries: dict[str, Entry] = {}
        self._unlisted: list[str] = []
        self._registered = self._read_register()
        self._key, self._sample, self._tally = key, sample, Tally()
        self._seal: Seal = "none"
        # A generation's folder may hold a file of any name, and runs may stand beside it.
        self._folders = {name.rpartition("/")[0] for name in self._names if name.endswith(f"/{MARKER}")}

    def examine(self) -> Examination:
        problems = [*self._unread, *self._judge_key(), *self._read_list()]
        listed = {name for name in {*self._entries, *self._registered} if is_run_manifest(name)}
        there = {name for name in self._names if is_run_manifest(name)}
        for name in sorted((there | listed) - {f"{folder}/{MANIFEST}" for folder in self._folders}):
            home = name.removesuffix(f"/{MANIFEST}")
            problems += [replace(problem, home=home) for problem in self._examine_run(name)]
        plain = {name for name in self._names if is_file_name(name) and "/" not in name and name != SEEN}
        for name in sorted(plain | ({*self._entries, *self._registered} - listed)):
            problems += self._examine_plain(name)
        problems += self._examine_notes()
        return Examination(
            problems=tuple(problems),
            unlisted=tuple(self._unlisted),
            entries=dict(self._entries),
            seal=self._seal,
            files=self._tally,
        )

    def _leave_out(self, locate: Path, why: str) -> None:
        self._unread.append(Problem(run="", path=locate, code="left_out", what=why))

    def _read_register(self) -> set[str]:
        """Names that were on the list when it was last renewed."""
        try:
            return set(parse_register(self._files.read(REGISTER)).values())
        except OSError:
            # It is a file over all runs as well, and looked at as one.
            return set()

    def _has_lost_entry(self, name: str) -> bool:
        """Whether the entry of a file is gone that was there."""
        # What is meant to go is taken off the register first.
        return name in self._registered and name in self._read_register()

    def _judge_key(self) -> Iterator[Problem]:
        """Whether the key is that of the results; without one it is only noted that they have one."""
        try:
            mark = parse_mark(self._files.read(KEY_MARK))
        except (ValueError, OSError):
            mark = ""
        if self._key is None:
            self._seal = "none" if mark is None else "not_checked"
            return
        self._seal = "checked"
        if mark == self._key.id:
            return
        # One sentence for all: none of the entries can be right.
        self._key = None
        code, what = "other_key", "the results are sealed with another key"
        if mark is None:
            what = "the results are not sealed with the key: the seal was taken away, or never made"
            code = "not_sealed"
        yield self._problem("", KEY_MARK, code, what)

    def _read_list(self) -> Iterator[Problem]:
        for name in sorted(name for name in self._names if name.startswith(f"{LIST}/")):
            try:
                entry = self._look_up(name)
            except (ValueError, OSError) as error:
                yield self._problem("", name, "list_damaged", f"the entry of the list is damaged ({error})")
            else:
                if entry is not None:
                    self._entries[entry.path] = entry
                    if not entry.is_sealed_with(self._key):
                        what = f"its entry on the list, {name}, is not sealed with the key"
                        yield replace(
                            self._problem(entry.run, entry.path, "not_sealed", what),
                            home=entry.path.removesuffix(f"/{MANIFEST}") if entry.run else "",
                        )

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
                return [self._problem(_folder_of(name), name, "disk_error", _format_os_error(error))]
            del self._unlisted[unlisted:]

    def _judge_run(self, name: str, data: bytes | None, entry: Entry | None) -> list[Problem]:
        run = _folder_of(name)
        if data is None:
            return [*self._judge_missing(name, entry)]
        home = self._files.locate(name).parent
        try:
            manifest = parse_manifest(data, home)
        except StoreError as error:
            return [Problem(run=run, path=home, code=error.code, what=str(error))]
        try:
            check_home(manifest.run, home, top=self._files.locate(RUNS))
        except StoreError as error:
            return [Problem(run=run, path=home / MANIFEST, code=error.code, what=error.what)]
        if entry is not None and hash_bytes(data) not in entry.sha256:
            what = "the manifest is not the one that was written here last"
            return [self._problem(manifest.run, name, "manifest_swapped", what)]
        is_sealed = check_seal(data)
        return [
            *self._judge_listing(name, entry, manifest, is_sealed=is_sealed),
            *self._judge_files(manifest, run, is_sealed=is_sealed),
        ]

    def _judge_missing(self, name: str, entry: Entry | None) -> Iterator[Problem]:
        run, what = _folder_of(name), "the manifest of the run is gone"
        if entry is None and self._has_lost_entry(name):
            yield self._problem(run, name, "run_missing", f"{what}, and so is its entry on the list")
        elif entry is not None and ABSENT not in entry.sha256:
            yield self._problem(entry.run or run, name, "run_missing", what)

    def _judge_listing(
        self, name: str, entry: Entry | None, manifest: Manifest, *, is_sealed: bool
    ) -> Iterator[Problem]:
        if entry is not None:
            return
        if is_sealed or self._has_lost_entry(name):
            what = "the run is not on the list: it was copied here, or its entry is gone"
            yield self._problem(manifest.run, name, "not_listed", what)
        else:
            self._unlisted.append(name)

    def _judge_files(self, manifest: Manifest, locate: str, *, is_sealed: bool) -> Iterator[Problem]:
        folder = f"{RUNS}/{locate}/{manifest.folder.name}"
        marker = self._files.read(f"{folder}/{MARKER}")
        if marker:
            try:
                is_right = parse_marker(marker, self._key) == manifest.hashes()
            except ValueError:
                is_right = False
            if not is_right:
                what = "the file has changed since it was written"
                yield self._problem(manifest.run, f"{folder}/{MARKER}", "file_damaged", what)
        elif marker is None and is_sealed:
            yield self._problem(manifest.run, f"{folder}/{MARKER}", "file_missing", "the file is gone")
        elif marker is None:
            self._unlisted.append(f"{folder}/{MARKER}")
        yield from self._compare(manifest.run, folder, manifest.hashes())
        for earlier in manifest.earlier:
            yield from self._judge_earlier(manifest, f"{RUNS}/{locate}/{earlier}")

    def _judge_earlier(self, manifest: Manifest, folder: str) -> Iterator[Problem]:
        """Problems of a generation that is not current, all of one kind: nothing is made of it any more."""
        marker = self._files.read(f"{folder}/{MARKER}")
        if not marker:
            if marker is not None:
                self._unlisted.append(f"{folder}/{MARKER}")
                return
            gone, what = folder, "the old generation is gone"
            if any(self._list_inside(folder)):
                gone, what = f"{folder}/{MARKER}", "in an old generation: the file is gone"
            yield self._problem(manifest.run, gone, "old_generation", what)
            return
        try:
            problems = [*self._compare(manifest.run, folder, parse_marker(marker, self._key))]
        except ValueError as error:
            what = f"in an old generation: the file is damaged: {error}"
            yield self._problem(manifest.run, f"{folder}/{MARKER}", "old_generation", what)
            return
        for problem in problems:
            what = f"in an old generation: {problem.what}"
            yield Problem(run=manifest.run, path=problem.path, code="old_generation", what=what)

    def _compare(self, run: str, folder: str, expected: Mapping[str, str]) -> Iterator[Problem]:
        for path in self._list_inside(folder):
            if path[len(folder) + 1 :] not in expected and path != f"{folder}/{MARKER}":
                yield self._problem(run, path, "extra_file", "the file was not written with the others")
        for name, sha256 in expected.items():
            path = f"{folder}/{name}"
            if not self._tally.draws(self._sample, path) and path in self._names:
                continue
            try:
                digest = self._files.hash(path)
            except OSError as error:
                yield self._problem(run, path, "disk_error", _format_os_error(error))
                continue
            if digest == ABSENT:
                yield self._problem(run, path, "file_missing", "the file is gone")
            elif digest != sha256:
                yield self._problem(run, path, "file_damaged", "the file has changed since it was written")

    def _list_inside(self, folder: str) -> Iterator[str]:
        """Names below a folder."""
        for at in range(bisect_left(self._sorted, f"{folder}/"), len(self._sorted)):
            if not self._sorted[at].startswith(f"{folder}/"):
                return
            yield self._sorted[at]

    def _examine_plain(self, name: str) -> list[Problem]:
        """Problems of a file over all runs."""
        is_there = name in self._names and name in self._entries
        if not self._tally.draws(self._sample, name) and is_there:
            return []
        while True:
            entry = self._entries.get(name)
            try:
                digest = self._files.hash(name)
            except OSError as error:
                return [self._problem("", name, "disk_error", _format_os_error(error))]
            if entry is not None and digest in entry.sha256:
                return []
            if not self._has_newer_entry(name):
                break
        return [*self._judge_plain(name, entry, digest)]

    def _judge_plain(self, name: str, entry: Entry | None, digest: str) -> Iterator[Problem]:
        if entry is None and not self._has_lost_entry(name):
            # A link or a pipe was never written.
            self._unlisted += [] if digest == ABSENT else [name]
        elif digest == ABSENT:
            yield self._problem("", name, "file_missing", "the file is gone")
        elif entry is None:
            yield self._problem("", name, "not_listed", "its entry on the list is gone")
        else:
            yield self._problem("", name, "file_damaged", "the file has changed since it was written")

    def _examine_notes(self) -> Iterator[Problem]:
        for name in sorted(name for name in self._names if name.startswith(NOTES) and name.endswith(".json")):
            if not self._tally.draws(self._sample, name):
                continue
            try:
                data = self._files.read(name)
                if data is not None:
                    unseal(data)
            except (ValueError, OSError) as error:
                what = f"the note is damaged and is not used ({error}); this costs nothing but time"
                yield self._problem("", name, "note_damaged", what)

    def _problem(self, run: str, name: str, code: str, what: str) -> Problem:
        return Problem(run=run, path=self._files.locate(name), code=code, what=what)


def _folder_of(name: str) -> str:
    """Folder of a run below the folder of all runs, by the name of its manifest."""
    return name.removeprefix(f"{RUNS}/").removesuffix(f"/{MANIFEST}")


def _format_os_error(error: OSError) -> str:
    return f"the file cannot be read: {error.strerror}"
