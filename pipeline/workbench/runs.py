"""The list of runs, for the page."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from pipeline.workbench.errors import WorkbenchError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.store import Manifest, Store

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
    log = summary.get("log")
    log = log if isinstance(log, dict) else {}
    findings = summary.get("findings")
    findings = findings if isinstance(findings, list) else []
    return {
        "run": manifest.run,
        **{key: summary.get(key) for key in _KEYS},
        "sha256": log.get("sha256"),
        "duration_s": log.get("duration_s"),
        "complete": log.get("complete"),
        "losses": log.get("losses") or [],
        "findings": [
            {key: entry.get(key) for key in ("id", "severity", "text")}
            for entry in findings
            if isinstance(entry, dict)
        ],
        "report": "report.html" in manifest.files,
    }


def read_summary(manifest: Manifest) -> Mapping[str, object]:
    """The stored summary; empty where there is none."""
    if "summary.json" not in manifest.files:
        return {}
    found = json.loads(manifest.path("summary.json").read_text(encoding="utf-8"))
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
