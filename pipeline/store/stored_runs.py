"""Runs of a results folder: their names, the logs that they are of, their keys and files."""

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from pipeline.core import SlipError, guess_names, resolve_inside
from pipeline.logs import RemotePath, locate_recorded, spell_location, stem_of, to_location
from pipeline.store.files import JSON, Manifest
from pipeline.store.names import StoreError, encode_run, no_results
from pipeline.store.results_folder import RUNS, Store


def name_plainly(path: Path) -> str:
    r"""Name of the run of a log unless another run has it: folder/stem.

    Bytes of a file name that are not UTF-8 are written as ``\xe9``.
    """
    stem = stem_of(path)
    name = f"{path.parent.name}/{stem}" if path.parent.name else stem
    return os.fsencode(name).decode("utf-8", "backslashreplace")


def name_run(path: Path, sha256: str, store: Store) -> str:
    """Name of the run of a log: folder/stem, with eight digits of its hash if another run has that name.

    Logs of equal content share a run: a copy of a log that has results gets the name of its run.
    """
    absolute = path.resolve()
    plain = name_plainly(absolute)
    manifest = store.manifest(plain)
    if manifest is None:
        for known in store.survey().manifests:
            if known.part("log").get("sha256") == sha256:
                return known.run
        return plain
    before = manifest.part("log")
    if before.get("sha256") == sha256 or before.get("path") == spell_location(absolute):
        return plain
    return f"{plain}-{sha256[:8]}"


def find_run(text: str, store: Store) -> Manifest:
    """The current results of a run, by its name, its stem, or the path of its log.

    Raises:
        StoreError: no run matches, or several runs do.
    """
    survey = store.survey()
    manifests = survey.manifests
    if not manifests:
        unread = f"; {len(survey.errors)} cannot be read" if survey.errors else ""
        gone = "" if store.root.exists() else " (the folder of results does not exist)"
        what = f"{text!r} is neither a log nor a run: no run has been analyzed yet{gone}{unread}"
        raise StoreError("no_such_run", what, where=str(store.root), hint=ANALYZE_FIRST)
    path = spell_location(Path(text).resolve())
    fitting = [
        manifest
        for manifest in manifests
        if text in {manifest.run, manifest.run.rsplit("/", 1)[-1]} or recorded_path(manifest) == path
    ]
    if len(fitting) == 1:
        return fitting[0]
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


SUMMARY = "summary.json"


def read_choices(manifest: Manifest) -> dict[str, object]:
    """Topics and vehicle that were chosen for a stored run: ``choices`` and ``vehicle_source``."""
    summary = manifest.read_json(SUMMARY) if SUMMARY in manifest.files else {}
    return {key: summary[key] for key in ("choices", "vehicle_source") if key in summary}


def read_length_scale(manifest: Manifest) -> float:
    """Length scale of the slip modulus that a run was analyzed with [m]."""
    scale = manifest.part("configuration", "slip").get("length_scale_m")
    return float(scale) if isinstance(scale, int | float) else 1.0


WORKBENCH = "workbench"
"""Folder in the results for data of the workbench: sessions, models and requested diagnoses."""


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
