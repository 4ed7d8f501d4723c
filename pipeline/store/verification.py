"""Are the results still what was written?"""

from bisect import bisect_left
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from pipeline.core import TooLargeError, read_bounded, walk_files
from pipeline.store.checksums import NOTES, decode_checked, parse_manifest
from pipeline.store.files import MANIFEST, MARKER, Manifest, hash_file
from pipeline.store.generation import LATEST
from pipeline.store.names import Sample, StoreError, Tally, check_home, is_file_name

RUNS = "runs"
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
            ``extra_file``, ``note_damaged``, ``path_unread``, ...
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
        """SHA-256 of a file in hexadecimal; empty when there is none."""
        path = self.locate(name)
        try:
            return "" if path.is_symlink() or not path.is_file() else hash_file(path)
        except FileNotFoundError:
            return ""

    def locate(self, name: str) -> Path:
        """The path to show."""
        return self._root / name


def examine_files(files: DiskFiles, *, sample: Sample | None = None) -> Examination:
    """Read the current results of all runs again, and hold them against their manifests.

    Older generations are not looked at: nobody reads them any more.

    Args:
        files: the results.
        sample: of the files, those that are hashed; None for all.
    """
    return _Examiner(files, sample).examine()


class _Examiner:
    def __init__(self, files: DiskFiles, sample: Sample | None) -> None:
        self._files = files
        self._unread: list[Problem] = []
        self._names = files.names(self._leave_out)
        self._sorted = sorted(self._names)
        self._sample, self._tally = sample, Tally()

    def examine(self) -> Examination:
        problems = list(self._unread)
        # A run has a link to its results only when it had a manifest.
        for home in sorted(self._find_run_folders(MANIFEST) | self._find_run_folders(LATEST)):
            problems += [replace(problem, home=home) for problem in self._examine_run(home)]
        problems += self._examine_notes()
        of_all = {name for name in self._names if is_file_name(name) and "/" not in name}
        return Examination(problems=tuple(problems), unchecked=tuple(sorted(of_all)), files=self._tally)

    def _leave_out(self, path: Path, why: str) -> None:
        self._unread.append(Problem(run="", path=path, code="left_out", what=why))

    def _find_run_folders(self, name: str) -> set[str]:
        """Folders of runs that hold a name."""
        folders = {path.removesuffix(f"/{name}") for path in self._names if path.endswith(f"/{name}")}
        # A generation's folder may hold a file of any name, and runs may stand beside it.
        return {
            home
            for home in folders
            if home.startswith(f"{RUNS}/")
            and home.count("/") in _RUN_DEPTHS
            and f"{home}/{MARKER}" not in self._names
        }

    def _examine_run(self, home: str) -> list[Problem]:
        """Problems of a run; looked at again when somebody has written it meanwhile."""
        name, run = f"{home}/{MANIFEST}", home.removeprefix(f"{RUNS}/")
        while True:
            try:
                data = self._files.read(name)
                problems = [*self._judge_run(run, home, data)]
                if not problems or self._files.read(name) == data:
                    return problems
            except OSError as error:
                code = "manifest_damaged" if isinstance(error, TooLargeError) else "disk_error"
                return [self._problem(run, name, code, _format_os_error(error))]

    def _judge_run(self, run: str, home: str, data: bytes | None) -> Iterator[Problem]:
        name = f"{home}/{MANIFEST}"
        if data is None:
            yield self._problem(run, name, "run_missing", "the manifest of the run is gone")
            return
        path = self._files.locate(home)
        try:
            manifest = parse_manifest(data, path)
        except StoreError as error:
            yield self._problem(run, home, error.code, str(error))
            return
        try:
            check_home(manifest.run, path, top=self._files.locate(RUNS))
        except StoreError as error:
            yield self._problem(run, name, error.code, error.what)
            return
        yield from self._compare(manifest, f"{home}/{manifest.folder.name}")

    def _compare(self, manifest: Manifest, folder: str) -> Iterator[Problem]:
        """Files of the current generation that are gone, changed, or more than were written."""
        expected = {f"{folder}/{name}": sha256 for name, sha256 in manifest.hashes().items()}
        start = bisect_left(self._sorted, f"{folder}/")
        inside = self._sorted[start : bisect_left(self._sorted, f"{folder}0", start)]
        for path in inside:
            if path not in expected and path != f"{folder}/{MARKER}":
                what = "the file was not written with the others"
                yield self._problem(manifest.run, path, "extra_file", what)
        for path, sha256 in expected.items():
            if not self._tally.draws(self._sample, path) and path in self._names:
                continue
            try:
                digest = self._files.hash(path)
            except OSError as error:
                yield self._problem(manifest.run, path, "disk_error", _format_os_error(error))
                continue
            if not digest:
                yield self._problem(manifest.run, path, "file_missing", "the file is gone")
            elif digest != sha256:
                what = "the file has changed since it was written"
                yield self._problem(manifest.run, path, "file_damaged", what)

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


def _format_os_error(error: OSError) -> str:
    return f"the file cannot be read: {error.strerror}"
