"""Are the results still what was written?"""

from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.core import TooLargeError, read_bounded, walk_files
from pipeline.store.checksums import NOTES, decode_checked
from pipeline.store.files import hash_file
from pipeline.store.generation import LATEST
from pipeline.store.manifests import MANIFEST, load_manifest
from pipeline.store.names import GENERATION, Sample, StoreError, Tally, check_home, is_file_name

RUNS = "runs"
_RUN_DEPTHS = (1, 2)
"""Slashes in the folder of a run, ``runs/stem`` or ``runs/folder/stem``."""


@dataclass(frozen=True)
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


def examine_results(root: Path, sample: Sample | None = None) -> Examination:
    """Read the current results of all runs again, and hold them against their manifests.

    Older generations are not looked at: nobody reads them any more.

    Args:
        root: the results folder.
        sample: of the files, those that are hashed; None for all.
    """
    return _Examiner(root, sample).examine()


class _Examiner:
    def __init__(self, root: Path, sample: Sample | None) -> None:
        self._root, self._sample, self._tally = root, sample, Tally()
        self._unread: list[Problem] = []
        start = len(str(root)) + 1
        self._names = sorted(entry.path[start:] for entry in walk_files(root, self._leave_out))

    def examine(self) -> Examination:
        problems = list(self._unread)
        for home in self._list_runs():
            problems += self._examine_run(home)
        problems += self._examine_notes()
        of_all = tuple(name for name in self._names if is_file_name(name) and "/" not in name)
        return Examination(problems=tuple(problems), unchecked=of_all, files=self._tally)

    def _leave_out(self, path: Path, why: str) -> None:
        self._unread.append(Problem(run="", path=path, code="left_out", what=why))

    def _list_runs(self) -> list[str]:
        """Folders of runs, which have a manifest, or a link that only those with one had."""
        parts = [name.rpartition("/") for name in self._names if name.startswith(f"{RUNS}/")]
        return sorted(
            {
                home
                for home, _, name in parts
                if name in (MANIFEST, LATEST)
                and home.count("/") in _RUN_DEPTHS
                and not GENERATION.fullmatch(home.rpartition("/")[2])
            }
        )

    def _examine_run(self, home: str) -> list[Problem]:
        """Problems of a run; looked at again when somebody has written it meanwhile."""
        while True:
            before = self._identify(home)
            problems = [*self._judge_run(home)]
            if not problems or self._identify(home) == before:
                return problems

    def _identify(self, home: str) -> tuple[int, int] | None:
        try:
            status = (self._root / home / MANIFEST).stat()
        except OSError:
            return None
        return status.st_ino, status.st_mtime_ns

    def _judge_run(self, home: str) -> Iterator[Problem]:
        """What is wrong with a manifest; else files that are gone, changed, or more than were written."""
        run, path = home.removeprefix(f"{RUNS}/"), self._root / home
        try:
            manifest = load_manifest(path)
            if manifest is None:
                yield Problem(run, path / MANIFEST, "run_missing", "the manifest of the run is gone", home)
                return
            check_home(manifest.run, path, top=self._root / RUNS)
        except OSError as error:
            code = "manifest_damaged" if isinstance(error, TooLargeError) else "disk_error"
            yield Problem(run, path / MANIFEST, code, _format_os_error(error), home)
            return
        except StoreError as error:
            yield Problem(run, path / MANIFEST, error.code, error.what, home)
            return
        folder = f"{home}/{manifest.folder.name}"
        start = bisect_left(self._names, f"{folder}/")
        inside = self._names[start : bisect_left(self._names, f"{folder}0", start)]
        extra = {name.removeprefix(f"{folder}/") for name in inside} - manifest.files.keys()
        checked = [(name, "extra_file", "the file was not written with the others") for name in sorted(extra)]
        for name, entry in sorted(manifest.files.items()):
            path, is_there = manifest.folder / name, f"{folder}/{name}" in inside
            checked.append((name, *self._judge_file(path, entry.sha256, is_there=is_there)))
        for name, code, what in checked:
            if code:
                yield Problem(manifest.run, manifest.folder / name, code, what, home)

    def _judge_file(self, path: Path, sha256: str, *, is_there: bool) -> tuple[str, str]:
        """Code and what is wrong with a file of a run; empty where it is not drawn, or as it was written."""
        if not self._tally.draws(self._sample, str(path.relative_to(self._root))) and is_there:
            return "", ""
        try:
            if path.is_symlink() or not path.is_file():
                return "file_missing", "the file is gone"
            is_same = hash_file(path) == sha256
        except OSError as error:
            return "disk_error", _format_os_error(error)
        return ("", "") if is_same else ("file_damaged", "the file has changed since it was written")

    def _examine_notes(self) -> Iterator[Problem]:
        for name in self._names:
            if not (name.startswith(NOTES) and name.endswith(".json")):
                continue
            path = self._root / name
            if not self._tally.draws(self._sample, name) or not path.is_file():
                continue
            try:
                decode_checked(read_bounded(path))
            except (ValueError, OSError) as error:
                why = getattr(error, "strerror", None) or error
                what = f"the note is damaged and is not used ({why}); this costs nothing but time"
                yield Problem("", path, "note_damaged", what)


def _format_os_error(error: OSError) -> str:
    return f"the file cannot be read: {error.strerror}"
