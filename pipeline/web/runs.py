"""The list of runs, for the page."""

import json
from collections.abc import Mapping
from pathlib import Path

import msgspec

from pipeline.report.run import mapping_in, objects_in
from pipeline.store import Manifest, Store
from pipeline.web.errors import WorkbenchError

_LONGEST = 500
"""Characters of a text that a log wrote; longer ones are cut on the page."""

_KEYS = (
    "vehicle",
    "vehicle_name",
    "terrain",
    "dataset",
    "median_modulus",
    "length_scale_m",
    "distance_m",
    "leading_input",
)


def list_runs(store: Store) -> dict[str, object]:
    """Every run with the numbers that the list shows and sorts by, and those that cannot be read."""
    survey = store.survey()
    return {
        "runs": [describe_run(manifest) for manifest in survey.manifests],
        "errors": [{"code": error.code, "message": str(error)} for error in survey.errors],
    }


def describe_run(manifest: Manifest) -> dict[str, object]:
    """One run."""
    summary = read_summary(manifest)
    log = mapping_in(summary, "log")
    return {
        "run": manifest.run,
        **{key: _cut(summary.get(key)) for key in _KEYS},
        "sha256": _cut(log.get("sha256")),
        "duration_s": _cut(log.get("duration_s")),
        "complete": log.get("complete") is True,
        "losses": _cut_all(log, "losses", ("kind", "text")),
        "findings": _cut_all(summary, "findings", ("id", "severity", "text")),
        "report": "report.html" in manifest.files,
    }


def _cut_all(of: Mapping[str, object], name: str, keys: tuple[str, ...]) -> list[dict[str, object]]:
    return [{key: _cut(entry.get(key)) for key in keys} for entry in objects_in(of, name)]


def _cut(value: object) -> object:
    """A number or a text that is not too long; None for anything else."""
    if isinstance(value, str):
        return value if len(value) <= _LONGEST else f"{value[:_LONGEST]} \u2026"
    return value if isinstance(value, int | float) else None


def read_summary(manifest: Manifest) -> dict[str, object]:
    """The stored summary; empty where there is none that can be read."""
    return read_json(manifest.path("summary.json")) if "summary.json" in manifest.files else {}


def read_json(path: Path) -> dict[str, object]:
    """The object in a file; empty where there is none that can be read."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        # What is half of a character in there cannot be sent on.
        msgspec.json.encode(found)
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def find_run(store: Store, run: str) -> Manifest:
    """The current results of a run.

    Raises:
        WorkbenchError: ``no_such_run``.
    """
    manifest = store.manifest(run) if run else None
    if manifest is None:
        raise WorkbenchError(
            "no_such_run", "there is no such run", where=run, hint="Choose one of the list, or drop a log."
        )
    return manifest
