"""Are the files still what was written?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pipeline.store.errors import StoreError
from pipeline.store.manifest import hash_file
from pipeline.store.manifest_file import load_manifest

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.store.manifest import Manifest


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One file that cannot be trusted.

    Attributes:
        run: the run it belongs to; its folder where the manifest itself is the problem.
        path: the file.
        code: ``file_missing``, ``file_damaged``, ``manifest_damaged``, ...
        what: what is wrong, one sentence without a full stop.
    """

    run: str
    path: Path
    code: str
    what: str


def verify_home(home: Path, *, top: Path) -> tuple[Problem, ...]:
    """Rehash the current generation in a run's folder ``home``, which stands under ``top``."""
    while True:
        try:
            manifest = load_manifest(home)
        except (StoreError, OSError) as error:
            code = error.code if isinstance(error, StoreError) else "disk_error"
            return (Problem(run=str(home.relative_to(top)), path=home, code=code, what=str(error)),)
        if manifest is None:
            return ()
        problems = _verify_files(manifest)
        if not problems or load_manifest(home) == manifest:
            return problems


def _verify_files(manifest: Manifest) -> tuple[Problem, ...]:
    expected = {entry.file: entry.sha256 for entry in manifest.tables.values()}
    expected |= {name: entry.sha256 for name, entry in manifest.files.items()}
    problems = []
    for name, sha256 in sorted(expected.items()):
        path = manifest.folder / name
        try:
            found = hash_file(path)
        except FileNotFoundError:
            problems.append(
                Problem(run=manifest.run, path=path, code="file_missing", what="the file is gone")
            )
        except OSError as error:
            what = f"the file cannot be read: {error.strerror}"
            problems.append(Problem(run=manifest.run, path=path, code="disk_error", what=what))
        else:
            if found != sha256:
                what = "the file is not what was written"
                problems.append(Problem(run=manifest.run, path=path, code="file_damaged", what=what))
    return tuple(problems)
