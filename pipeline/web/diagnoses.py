"""What a diagnosis says of a run: kept with its results, or beside them where it was asked for here."""

import json
from collections.abc import Mapping
from pathlib import Path

from pipeline.analysis.diagnosis import DIAGNOSIS, read_recording
from pipeline.analysis.options import INPUTS
from pipeline.report.run import mapping_in
from pipeline.store import Manifest
from pipeline.store.files import make_folder, replace_file
from pipeline.web.runs import read_json
from pipeline.web.session import place_of_run


def read_diagnosis(results: Path, manifest: Manifest) -> Mapping[str, object] | None:
    """What is known of a run's missing effects; None where nobody has asked yet."""
    if DIAGNOSIS in manifest.files:
        return read_json(manifest.path(DIAGNOSIS)) or None
    kept = read_json(_path_of(results, manifest))
    found = kept.get("diagnosis") if kept.get("key") == manifest.key else None
    return found if isinstance(found, dict) else None


def find_formula(diagnosis: Mapping[str, object] | None) -> str | None:
    """The formula that was found for what no effect explains, as text of a model file; None without one."""
    unexplained = mapping_in(diagnosis or {}, "unexplained")
    formula = unexplained.get("formula")
    return formula if isinstance(formula, str) and formula else None


def write_diagnosis(results: Path, manifest: Manifest) -> None:
    """Diagnose a stored run and keep what comes of it beside the results; it works for many seconds.

    Raises:
        SlipError: nothing can be said of the run.
    """
    from pipeline.diagnosis import diagnose_runs  # noqa: PLC0415 - heavy, and only for the worker process

    vehicle, recording = read_recording(manifest)
    (found,) = diagnose_runs([recording], vehicle, inputs=INPUTS).to_json()
    path = _path_of(results, manifest)
    make_folder(path.parent)
    replace_file(path, json.dumps({"key": manifest.key, "diagnosis": found}).encode())


def _path_of(results: Path, manifest: Manifest) -> Path:
    return place_of_run(results, "diagnoses", manifest.run, ".json")
