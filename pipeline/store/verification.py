"""Are the results still what was written? The same examination for a folder and for an object store."""

from bisect import bisect_left
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

from pipeline.core import TooLargeError, read_bounded, walk_files
from pipeline.store.checksums import NOTES, decode_checked, encode_marker, parse_manifest, parse_marker
from pipeline.store.files import MANIFEST, MARKER, Manifest, hash_file
from pipeline.store.generation import LATEST
from pipeline.store.names import Sample, StoreError, Tally, check_home, is_file_name

RUNS = "runs"
ABSENT = ""
"""Stands for the hash of a file that is not there."""
_RUN_DEPTHS = (1, 2)
"""Slashes in the folder of a run, ``runs/stem`` or ``runs/folder/stem``."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One file that cannot be trusted.

    Attributes:
        run: the run it belongs to; its folder where the manifest itself is the problem; empty for a file that
            belongs to none.
        path: the file.
        code: ``file_missing``, ``file_damaged``, ``manifest_damaged``, ``run_missing``, ``name_clash``,
            ``old_generation``, ``extra_file``, ``note_damaged``, ``path_unread``, ...
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
        unchecked: names in the results that no checksum covers: tables and pages over all runs, which are
            made of the runs.
        files: how many files of how many were hashed.
    """

    problems: tuple[Problem, ...]
    unchecked: tuple[str, ...]
    files: Tally = field(default_factory=Tally)


class Files(Protocol):
    """The files of results, on disk or in an object store."""

    def names(self, skip: Callable[[Path, str], None]) -> Collection[str]:
        """Every name in the results; ``skip`` is told of each folder that is not read, and why."""

    def read(self, name: str) -> bytes | None:
        """The content of a file; None when there is none."""

    def hash(self, name: str) -> str:
        """SHA-256 of a file in hexadecimal; `ABSENT` when there is none."""

    def locate(self, name: str) -> Path:
        """The path to show."""


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
            return read_bounded(path) if path.is_file() else None
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


def examine_files(files: Files, *, sample: Sample | None = None) -> Examination:
    """Read all results again, and hold them against what says what they were.

    Args:
        files: the results.
        sample: of the files, those that are hashed; None for all.
    """
    return _Examiner(files, sample).examine()


class _Examiner:
    def __init__(self, files: Files, sample: Sample | None) -> None:
        self._files = files
        self._unread: list[Problem] = []
        self._names = files.names(self._leave_out)
        self._sorted = sorted(self._names)
        self._sample, self._tally = sample, Tally()
        # A generation's folder may hold a file of any name, and runs may stand beside it.
        self._folders = {name.rpartition("/")[0] for name in self._names if name.endswith(f"/{MARKER}")}

    def examine(self) -> Examination:
        problems = list(self._unread)
        # A run has a link to its results only when it had a manifest.
        for home in sorted(self._find_folders(MANIFEST) | self._find_folders(LATEST)):
            problems += [replace(problem, home=home) for problem in self._examine_run(home)]
        problems += self._examine_notes()
        of_all = {name for name in self._names if is_file_name(name) and "/" not in name}
        return Examination(problems=tuple(problems), unchecked=tuple(sorted(of_all)), files=self._tally)

    def _find_folders(self, name: str) -> set[str]:
        """Folders of runs that hold a name."""
        folders = {path.removesuffix(f"/{name}") for path in self._names if path.endswith(f"/{name}")}
        depths = {home: home.count("/") for home in folders if home.startswith(f"{RUNS}/")}
        return {home for home, depth in depths.items() if depth in _RUN_DEPTHS} - self._folders

    def _leave_out(self, locate: Path, why: str) -> None:
        self._unread.append(Problem(run="", path=locate, code="left_out", what=why))

    def _examine_run(self, home: str) -> list[Problem]:
        """Problems of a run; looked at again when somebody has written it meanwhile."""
        name = f"{home}/{MANIFEST}"
        while True:
            try:
                data = self._files.read(name)
                problems = self._judge_run(name, data)
                if not problems or self._files.read(name) == data:
                    return problems
            except OSError as error:
                code = "manifest_damaged" if isinstance(error, TooLargeError) else "disk_error"
                return [self._problem(_folder_of(name), name, code, _format_os_error(error))]

    def _judge_run(self, name: str, data: bytes | None) -> list[Problem]:
        run = _folder_of(name)
        if data is None:
            return [self._problem(run, name, "run_missing", "the manifest of the run is gone")]
        home = self._files.locate(name).parent
        try:
            manifest = parse_manifest(data, home)
        except StoreError as error:
            return [Problem(run=run, path=home, code=error.code, what=str(error))]
        try:
            check_home(manifest.run, home, top=self._files.locate(RUNS))
        except StoreError as error:
            return [Problem(run=run, path=home / MANIFEST, code=error.code, what=error.what)]
        return [*self._judge_files(manifest, run)]

    def _judge_files(self, manifest: Manifest, locate: str) -> Iterator[Problem]:
        folder = f"{RUNS}/{locate}/{manifest.folder.name}"
        marker = self._files.read(f"{folder}/{MARKER}")
        if marker is None:
            yield self._problem(manifest.run, f"{folder}/{MARKER}", "file_missing", "the file is gone")
        elif marker != encode_marker(manifest.run, manifest.hashes()):
            what = "the file has changed since it was written"
            yield self._problem(manifest.run, f"{folder}/{MARKER}", "file_damaged", what)
        yield from self._compare(manifest.run, folder, manifest.hashes())
        for earlier in manifest.earlier:
            yield from self._judge_earlier(manifest, f"{RUNS}/{locate}/{earlier}")

    def _judge_earlier(self, manifest: Manifest, folder: str) -> Iterator[Problem]:
        """Problems of a generation that is not current, all of one kind: nothing is made of it any more."""
        marker = self._files.read(f"{folder}/{MARKER}")
        if marker is None:
            gone, what = folder, "the old generation is gone"
            if any(self._list_inside(folder)):
                gone, what = f"{folder}/{MARKER}", "in an old generation: the file is gone"
            yield self._problem(manifest.run, gone, "old_generation", what)
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

    def _examine_notes(self) -> Iterator[Problem]:
        for name in sorted(name for name in self._names if name.startswith(NOTES) and name.endswith(".json")):
            if not self._tally.draws(self._sample, name):
                continue
            try:
                data = self._files.read(name)
                if data is not None:
                    decode_checked(data)
            except (ValueError, OSError) as error:
                why = getattr(error, "strerror", None) or error
                what = f"the note is damaged and is not used ({why}); this costs nothing but time"
                yield self._problem("", name, "note_damaged", what)

    def _problem(self, run: str, name: str, code: str, what: str) -> Problem:
        return Problem(run=run, path=self._files.locate(name), code=code, what=what)


def _folder_of(name: str) -> str:
    """Folder of a run below the folder of all runs, by the name of its manifest."""
    return name.removeprefix(f"{RUNS}/").removesuffix(f"/{MANIFEST}")


def _format_os_error(error: OSError) -> str:
    return f"the file cannot be read: {error.strerror}"
