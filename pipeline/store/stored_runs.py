"""Runs of a results folder: their names, their logs and the hashes of these, their keys and files."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from shlex import quote
from stat import S_ISDIR

from pipeline.core import SlipError, group_by, guess_names, resolve_inside
from pipeline.logs import RemotePath, list_files, locate_recorded, spell_location, stem_of, to_location
from pipeline.store.files import hash_bytes
from pipeline.store.manifests import JSON, Manifest
from pipeline.store.names import StoreError, encode_run, no_results
from pipeline.store.results_folder import Store
from pipeline.store.stored_files import SUMMARY
from pipeline.store.verification import RUNS


def name_plainly(path: Path, folders: int = 1) -> str:
    r"""Name of the run of a log unless another log has it: folder/stem.

    Bytes of a file name that are not UTF-8 are written as ``\xe9``.

    Args:
        path: absolute path of the log.
        folders: number of folders in the name, where there are as many.
    """
    inside = [part for part in path.parent.parts if part != path.anchor][-folders:]
    return os.fsencode("/".join([*inside, stem_of(path)])).decode("utf-8", "backslashreplace")


def name_distinctly(logs: Mapping[Path, Path]) -> dict[Path, str]:
    """Names of the runs of logs: folder/stem, and before it as many folders as tell a log from the others.

    Logs of one folder and stem keep one name.

    Args:
        logs: absolute path of each log as its folder lists it, by links perhaps, by its path.
    """
    names = {path: name_plainly(path) for path in logs}
    for folders in range(2, max((len(listed.parts) for listed in logs.values()), default=0)):
        alike = group_by((name, path) for path, name in names.items())
        unclear = [
            path
            for paths in alike.values()
            if len({(path.parent, stem_of(path)) for path in paths}) > 1
            for path in paths
        ]
        if not unclear:
            break
        names |= {path: name_plainly(logs[path], folders) for path in unclear}
    return names


def add_digits(name: str, sha256: str) -> str:
    """Name of the run of a log whose name is that of a run with another content."""
    return f"{name}-{sha256[:_NAME_DIGITS]}"


_NAME_DIGITS = 8


def name_run(path: Path, sha256: str, store: Store) -> str:
    """Name of the run of a log: of the run of the same content, else of the same path, else a new one.

    A new one is folder/stem, with more folders before it if that is the name of a log elsewhere, and with
    eight digits of the hash behind it if it is that of a run all the same.
    """
    absolute = path.resolve()
    manifests = store.survey().manifests
    locations = {manifest.run: to_location(recorded_path(manifest)) for manifest in manifests}
    same = [manifest.run for manifest in manifests if manifest.part("log").get("sha256") == sha256]
    here = [run for run, location in locations.items() if location == absolute]
    known = [*(run for run in same if run in here), *same, *here]
    if known:
        return known[0]
    name = name_distinctly({log: log for log in (*locations.values(), absolute)})[absolute]
    return add_digits(name, sha256) if name in locations else name


def find_run(text: str, store: Store) -> Manifest:
    """The current results of a run, by its name, its stem, or the path of its log.

    Raises:
        StoreError: no run matches, or several runs do.
    """
    survey = store.survey()
    manifests = survey.manifests
    path = spell_location(Path(text).resolve())
    fitting = [
        manifest
        for manifest in manifests
        if text in {manifest.run, manifest.run.rsplit("/", 1)[-1]} or recorded_path(manifest) == path
    ]
    if len(fitting) == 1:
        return fitting[0]
    if not fitting and Path(text).exists():
        what = f"it has no results in {store.root}"
        hint = f"Analyze it first: slip analyze {quote(text)} --results {quote(str(store.root))}."
        raise StoreError("no_such_run", what, where=text, hint=hint)
    if not manifests:
        unread = f"; {len(survey.errors)} cannot be read" if survey.errors else ""
        gone = "" if store.root.exists() else " (the folder of results does not exist)"
        what = (
            f"{text!r} is neither a log nor a run: there is no such file or folder, and no run has been "
            f"analyzed yet{gone}{unread}"
        )
        raise StoreError("no_such_run", what, where=str(store.root), hint=ANALYZE_FIRST)
    names = ", ".join(manifest.run for manifest in (fitting or manifests))
    what = f"several runs are called {text!r}" if fitting else f"there is no run {text!r}"
    known = [manifest.run if "/" in text else manifest.run.rsplit("/", 1)[-1] for manifest in manifests]
    near = "" if fitting else guess_names(text, dict.fromkeys(known))
    hint = f"Say which of: {names}." if fitting else f"{near}There are: {names}."
    raise StoreError("no_such_run", what, where=str(store.root), hint=hint)


def find_log(text: str, out: Path) -> Path:
    """The log that a user refers to by its path or by the name of a run that has results.

    Raises:
        StoreError: neither matches, or the run's log no longer exists.
        LogError: as `find_recorded_log`.
    """
    path = to_location(text)
    if isinstance(path, RemotePath) or path.exists() or path.suffix:
        return path
    return find_recorded_log(find_run(text, Store(out)), hint="Give the path it has now.")


def find_recorded_log(manifest: Manifest, *, hint: str) -> Path:
    """The log of a run.

    Args:
        manifest: manifest of the run.
        hint: hint of the error if the log no longer exists.

    Raises:
        StoreError: ``log_gone``.
        LogError: ``remote_not_followed``, ``no_object_store``.
    """
    log = locate_recorded(recorded_path(manifest))
    if not log.exists():
        raise StoreError("log_gone", "the log of this run no longer exists", where=str(log), hint=hint)
    return log


def recorded_path(manifest: Manifest) -> str:
    """Path of the log of a run."""
    return str(manifest.part("log").get("path", ""))


_DIGITS = 16


def hash_json(content: object) -> str:
    """First sixteen hexadecimal digits of the SHA-256 of a JSON value with sorted keys."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:_DIGITS]


def stored_keys(manifest: Manifest | None) -> dict[str, str]:
    """Stage keys of the existing results."""
    stages = manifest.part("stages") if manifest is not None else {}
    return {name: str(entry["key"]) for name, entry in stages.items() if isinstance(entry, dict)}


def stored_contexts(manifest: Manifest) -> dict[str, Mapping[str, JSON]]:
    """Stage contexts of the existing results."""
    return {
        name: entry["context"]
        for name, entry in manifest.part("stages").items()
        if isinstance(entry, dict) and isinstance(entry.get("context"), dict)
    }


ANALYZE_FIRST = "Analyze logs first: slip analyze LOG... --results RESULTS --terrain NAME."


class NoRunsError(StoreError):
    """No run of the results fits what was asked."""


def lack_runs(code: str, what: str, root: Path, hint: str, notes: Iterable[str] = ()) -> SlipError:
    """Build the error that no run in `root` fits the request; `notes` list what was excluded.

    A folder that does not exist, a file, or a folder of other things is no results folder: then this is the
    error.
    """
    if not root.exists():
        return no_results(root)
    if root.is_file() or (root.is_dir() and any(root.iterdir()) and not (root / RUNS).is_dir()):
        what, hint = (
            "this is not a results folder",
            "Give the folder that `slip analyze` writes (default: results).",
        )
        return NoRunsError(code, what, where=str(root), hint=hint)
    return NoRunsError(code, what + "".join(f"; {note}" for note in notes), where=str(root), hint=hint)


DIAGNOSIS = "diagnosis.json"


def read_choices(manifest: Manifest) -> dict[str, object]:
    """What a run was read from: ``choices``, ``vehicle_source``, and whether the log is ``simulated``."""
    summary = manifest.read_json(SUMMARY) if SUMMARY in manifest.files else {}
    return {key: summary[key] for key in ("choices", "vehicle_source", "simulated") if key in summary}


def read_length_scale(manifest: Manifest) -> float:
    """Length scale of the slip modulus that a run was analyzed with [m]."""
    scale = manifest.part("configuration", "slip").get("length_scale_m")
    return float(scale) if isinstance(scale, int | float) else 1.0


WORKBENCH = "workbench"
"""Folder in the results for data of the workbench: models, requested diagnoses and dropped logs."""


UPLOADS = f"{WORKBENCH}/uploads"
"""Folder of logs uploaded through the page; each is deleted after its analysis."""


def locate_beside(results: Path, folder: str, run: str, suffix: str) -> Path:
    """Path of a workbench file of a run, in results that are untrusted.

    Raises:
        PathError: a link leads out of the results, or the path is a pipe or device.
    """
    encoded = encode_run(run)
    return resolve_inside(results, f"{WORKBENCH}/{folder}/{encoded.with_name(f'{encoded.name}{suffix}')}")


REPORT = "report.html"


# Hashes of logs that are remembered, so that an unchanged log is not hashed again.

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

    def remember(self, path: Path, sha256: str, *, seen: LogSighting) -> None:
        """Remember the hash of a log that did not change while it was read; failing to is no error.

        Args:
            path: the log.
            sha256: its hash in hexadecimal.
            seen: what `see_log` said before the log was read.
        """
        with suppress(OSError):
            now = see_log(path)
            if seen.is_same_file(now) and seen.seen_ns - seen.mtime_ns > _TICK_NS:
                self._notes.write(now.path, {**asdict(now), "sha256": sha256})
