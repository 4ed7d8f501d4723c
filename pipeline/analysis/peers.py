"""The other runs of a dataset, beside which a report sets its own."""

import json
from collections.abc import Mapping

from pipeline.store import JSON, Manifest, Store, StoreError
from pipeline.store.manifest_file import load_manifest

_SUMMARY = "summary.json"
_MOST_RUNS = 2000
"""Beyond this a report would wait seconds for the numbers of others."""


def find_peers(store: Store, summary: Mapping[str, JSON]) -> dict[str, list[float]]:
    """Median slip moduli [m/s] of the comparable runs that the results hold already, by input.

    Comparable are runs of the same dataset with the same length scale; the same recording counts once, and
    runs with a finding that forbids conclusions do not count.

    Args:
        store: the results.
        summary: of the run itself.
    """
    homes = store.homes()
    if summary.get("terrain") in (None, "", "unknown") or len(homes) > _MOST_RUNS:
        return {}
    log = summary.get("log")
    seen = {log.get("sha256") if isinstance(log, dict) else None}
    found: dict[str, list[float]] = {}
    for home in homes:
        try:
            manifest = load_manifest(home)
        except (StoreError, OSError):
            # Whoever lists the runs is told of it; a report can do without.
            continue
        if manifest is None or manifest.run == summary.get("run"):
            continue
        if manifest.details.get("dataset") != summary.get("dataset"):
            continue
        other = _read_summary(manifest)
        sha256 = manifest.part("log").get("sha256")
        if (
            sha256 in seen
            or other.get("length_scale_m") != summary.get("length_scale_m")
            or _is_doubtful(other)
        ):
            continue
        seen.add(sha256)
        by_input = other.get("by_input")
        for name, numbers in by_input.items() if isinstance(by_input, dict) else ():
            median = numbers.get("median_modulus") if isinstance(numbers, dict) else None
            if isinstance(median, int | float):
                found.setdefault(name, []).append(float(median))
    return found


def _read_summary(manifest: Manifest) -> Mapping[str, JSON]:
    if _SUMMARY not in manifest.files:
        return {}
    try:
        content = json.loads(manifest.path(_SUMMARY).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _is_doubtful(summary: Mapping[str, JSON]) -> bool:
    findings = summary.get("findings")
    entries = findings if isinstance(findings, list) else []
    return any(isinstance(entry, dict) and entry.get("severity") == "error" for entry in entries)
