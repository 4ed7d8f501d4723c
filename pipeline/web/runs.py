"""Stored runs, as the page lists them."""

import msgspec

from pipeline.core import pick
from pipeline.results import find_refusal, read_findings
from pipeline.store import MANIFEST, REPORT, Manifest, Store, StoreError, read_stored
from pipeline.web import WorkbenchError
from pipeline.words import format_finding


class _Loss(msgspec.Struct):
    kind: str = ""
    text: str = ""


class _Log(msgspec.Struct):
    sha256: str | None = None
    duration_s: float | None = None
    complete: bool = False
    losses: list[_Loss] = []


class _Summary(msgspec.Struct):
    """What the page says of a run."""

    vehicle: str | None = None
    vehicle_name: str | None = None
    terrain: str | None = None
    dataset: str | None = None
    median_modulus: float | None = None
    length_scale_m: float | None = None
    distance_m: float | None = None
    leading_input: str | None = None
    verdict: str | None = None
    findings: list[dict[str, object]] = []
    log: _Log = msgspec.field(default_factory=_Log)


def summarize_run(manifest: Manifest) -> dict[str, object]:
    """Values of one run for the list."""
    try:
        summary = read_stored(manifest.path("summary.json"), _Summary)
    except StoreError:
        summary = _Summary()
    content = msgspec.to_builtins(summary)
    findings = read_findings(content)
    refusal = find_refusal(findings)
    return {
        **content,
        **content.pop("log"),
        "findings": [{**pick(one, "id", "severity"), "text": format_finding(one)} for one in findings],
        "run": manifest.run,
        "analyzed_s": (manifest.folder.parent / MANIFEST).stat().st_mtime,
        "refusal": "" if refusal is None else format_finding(refusal),
        "report": REPORT in manifest.files,
    }


def find_run(store: Store, run: str) -> Manifest:
    """The current results of a run.

    Raises:
        WorkbenchError: ``no_such_run``.
    """
    manifest = store.manifest(run) if run else None
    if manifest is None:
        hint = "Choose one of the list, or drop a log."
        raise WorkbenchError("no_such_run", "there is no such run", where=run, hint=hint)
    return manifest
