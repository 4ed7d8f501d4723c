"""Notes on runs of one vehicle whose logs were corrected in different ways."""

import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence

import polars as pl

from pipeline.core import NORMAL_95, enumerate_texts, format_line, group_by, mapping_in, name_first
from pipeline.recording import SURE, Finding, are_apart
from pipeline.results import read_finding_table
from pipeline.sources import AS_RECORDED
from pipeline.store import JSON, SUMMARY, Manifest, Store, StoreError

_KEY = re.compile(r"(\w+) = ")
_OF_ONE_RECORDING = {"time", "late_s"}
"""Keys of corrections that are of a recording, and of no vehicle."""


def note_corrections(store: Store, manifests: Iterable[Manifest]) -> list[str]:
    """Notes on what cannot be so: wiring, units and frames of a vehicle are the same in all of its runs.

    Runs are compared whose signals are of the same topics, by the keys that were corrected in one of them. It
    makes no difference whether the program or the user set such a key.

    Args:
        store: the results.
        manifests: runs; those with a damaged table are left out.
    """
    manifests = [one for one in manifests if not one.find_damage(["findings"])]
    of_interest = pl.col("id").str.ends_with("_corrected") | pl.col("id").is_in(["pose_turned", *_MOUNTINGS])
    rows = store.scan("findings", manifests).filter(of_interest).sort("run").collect()
    vehicles = {one.run: str(one.part("vehicle").get("id") or "unknown") for one in manifests}
    findings = [
        (str(run), finding)
        for (run,), part in rows.partition_by("run", as_dict=True).items()
        for finding in read_finding_table(part)
    ]
    corrected = group_by(
        ((vehicles[run], one.where), (run, str(one.values.get("line"))))
        for run, one in findings
        if one.values.get("kind") == "corrected"
    )
    notes = list[str]()
    for (vehicle, section), lines in corrected.items():
        own = [one for one in manifests if vehicles[one.run] == vehicle]
        keys = {key for _, line in lines for key in _KEY.findall(line)} - _OF_ONE_RECORDING
        for topic, alike in group_by((read_topic(one, section), one) for one in own).items():
            if topic and not {run for run, _ in lines}.isdisjoint(one.run for one in alike):
                notes.append(_compare_lines(f"{vehicle} ({topic})", section, keys, alike))
    mounted = group_by(
        ((vehicles[run], one.id, str(one.values.get("pose"))), (run, one))
        for run, one in findings
        if one.id in _MOUNTINGS
    )
    for (vehicle, name, pose), seen in mounted.items():
        notes.append(_compare_mountings(f"{vehicle} ({pose})", name, seen))
    return [note for note in notes if note]


def read_topic(manifest: Manifest, role: str) -> str:
    """Topics of a role in a run; empty where it has none, or they are not known."""
    try:
        summary = manifest.read_json(SUMMARY) if SUMMARY in manifest.files else {}
    except StoreError:
        return ""
    return str(mapping_in(mapping_in(summary, "topics"), role).get("topic") or "")


def _compare_lines(of: str, section: str, keys: Collection[str], manifests: Iterable[Manifest]) -> str:
    """A note on runs with different lines of a section; empty where all are alike."""
    usual = AS_RECORDED[section]
    groups: list[tuple[dict[str, JSON], list[str]]] = []
    for manifest in manifests:
        known = manifest.part("configuration", section)
        given = {key: known[key] for key in sorted(keys & known.keys())}
        lines: dict[str, JSON] = {
            key: value for key, value in given.items() if value not in (None, usual.get(key))
        }
        own = next((runs for other, runs in groups if _are_alike(lines, other)), None)
        if own is None:
            groups.append((lines, [manifest.run]))
        else:
            own.append(manifest.run)
    if len(groups) == 1:
        return ""
    said = [f"{_format_lines(lines) or 'as recorded'} in {name_first(runs)}" for lines, runs in groups]
    return (
        f"runs of {of} are read in different ways, though the wiring, units and frames of a vehicle are the "
        f"same in all: {'; '.join(said)}. Set what is right under [{section}] in the run.toml of the others, "
        "or in fleet.toml above all, unless the vehicle was changed between them"
    )


def _are_alike(one: JSON, other: JSON) -> bool:
    """Whether values of a key are the same, or measured numbers that do not contradict each other."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(_are_alike(one[key], other[key]) for key in one)
    if isinstance(one, int | float) and isinstance(other, int | float):
        return one == other or not are_apart((one, other))
    return one == other


def _format_lines(lines: Mapping[str, JSON]) -> str:
    """Keys of run.toml with their values."""
    return enumerate_texts([format_line(key, value) for key, value in lines.items()])


_MOUNTINGS = {
    "pose_angle": ("heading_deg", "half_deg", "degrees", "moves at different angles to the headings"),
    "pose_lever": ("value", "half_m", "m", "turns about points at different distances behind that"),
}
"""Value, half of its 95 % interval, their unit, and what differs, by the id of the finding."""


def _compare_mountings(of: str, name: str, seen: Sequence[tuple[str, Finding]]) -> str:
    """A note on runs whose poses are seen to be mounted in different ways; empty where intervals agree."""
    value_key, half_key, unit, what = _MOUNTINGS[name]
    numbers = [
        (run, float(value), float(half))
        for run, finding in seen
        if isinstance(value := finding.values.get(value_key), int | float)
        and isinstance(half := finding.values.get(half_key), int | float)
    ]
    if not numbers:
        return ""
    low = min(numbers, key=lambda one: one[1] + one[2])
    high = max(numbers, key=lambda one: one[1] - one[2])
    if high[1] - low[1] <= SURE * math.hypot(low[2], high[2]) / NORMAL_95:
        return ""
    ends = [f"{value:.2g} {unit} (±{half:.2g}) in {run}" for run, value, half in (low, high)]
    return (
        f"in runs of {of} the body {what} of its poses: {' to '.join(ends)}. A sensor stays where it is "
        "mounted, so such numbers are the vehicle's motion, as a slide in turns or on a slope: correct no "
        "run by its own, unless the sensor was moved between them"
    )
