"""Diagnoses that were asked for later, kept beside a run's results, which stay as they are."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import msgspec

from pipeline.core.untrusted import PathError, resolve_inside
from pipeline.job.run_results import LINES, key_diagnosis, read_choices, read_diagnosis
from pipeline.job.work import stored_keys
from pipeline.store import Manifest, Store
from pipeline.store.files import make_folder, replace_file
from pipeline.store.names import encode_run

FOLDER = "workbench"
"""Where the results keep what is no result: sessions, models and diagnoses that were asked for."""
UPLOADS = f"{FOLDER}/uploads"
"""Where logs stand that come through the page, until they are analyzed: deleted then, which is no loss."""


class _StoredDiagnosis(msgspec.Struct, frozen=True):
    """A diagnosis, and the key of what it was made of."""

    key: str
    diagnosis: dict[str, object]


def locate_beside(results: Path, folder: str, run: str, suffix: str) -> Path:
    """Where something of a run is kept: in the results, which may be a stranger's.

    Raises:
        PathError: a link leads out of the results, or a pipe or device stands there.
    """
    encoded = encode_run(run)
    return resolve_inside(results, f"{FOLDER}/{folder}/{encoded.with_name(f'{encoded.name}{suffix}')}")


def find_diagnosis(results: Path, manifest: Manifest) -> dict[str, object] | None:
    """The diagnosis of a run from both inputs, as `read_diagnosis` gives it, or the one that was kept.

    Returns:
        None where neither is there, or neither is of these tables and this version.
    """
    diagnosis = read_diagnosis(manifest)
    if diagnosis is not None or not _is_of(results, manifest):
        return diagnosis
    try:
        path = locate_beside(results, "diagnoses", manifest.run, ".json")
        stored = msgspec.json.decode(path.read_bytes(), type=_StoredDiagnosis)
    except (OSError, PathError, msgspec.MsgspecError, RecursionError, UnicodeDecodeError):
        return None
    if stored.key != _key_of(manifest) or LINES not in stored.diagnosis:
        return None
    return {**stored.diagnosis, **read_choices(manifest)}


def keep_diagnosis(results: Path, manifest: Manifest, diagnosis: Mapping[str, object]) -> None:
    """Keep the diagnosis of a run from both inputs, with its lines, for who asks again.

    Nothing is kept of a run that is not of these results: it was analyzed with other choices.

    Raises:
        OSError: the results cannot be written.
        PathError: a link leads out of the results.
    """
    if _is_of(results, manifest):
        path = locate_beside(results, "diagnoses", manifest.run, ".json")
        make_folder(path.parent)
        replace_file(path, json.dumps({"key": _key_of(manifest), "diagnosis": diagnosis}).encode())


def _is_of(results: Path, manifest: Manifest) -> bool:
    return "slip" in stored_keys(manifest) and Store(results).manifest(manifest.run) == manifest


def _key_of(manifest: Manifest) -> str:
    return key_diagnosis(stored_keys(manifest))
