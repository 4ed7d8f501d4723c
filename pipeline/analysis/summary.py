"""Stored outputs of a run: its diagnosis (with it or later), its JSON summary, and package versions."""

import json
import platform
from collections.abc import Mapping
from functools import cache
from importlib.metadata import version

import polars as pl

from pipeline.analysis.work import Work
from pipeline.core import PACKAGE, SlipError, mapping_in, number_in, objects_in, read_object, read_version
from pipeline.estimation.stored_diagnosis import (
    DIAGNOSED,
    STAGE,
    _make_recording,
    _read_stored,
    has_diagnosis,
    key_diagnosis,
    show_model,
)
from pipeline.logs import ROS1_BAG, SQLITE_BAG
from pipeline.recording import Finding, list_wanted
from pipeline.recording.log_setup import LogSetup
from pipeline.results import (
    RunDiagnosis,
    find_refusal,
    parse_values,
    read_finding_table,
    read_result,
    to_json,
)
from pipeline.stages import SUMMARY_DIGITS, find_standing_share, pick_row, round_number, summarize_inputs
from pipeline.store import DIAGNOSIS, JSON, SUMMARY, Store

_Packages = Mapping[str, tuple[str, ...]]
_ALWAYS = ("numpy", "scipy", "polars", "pyarrow", "rosbags")
_CONTAINER: _Packages = {"": ("mcap",), ROS1_BAG: ("lz4",), SQLITE_BAG: ()}
_COMPRESSION: _Packages = {"zstd": ("zstandard",), "lz4": ("pyarrow",)}
_ENCODING: _Packages = {"protobuf": ("mcap", "mcap-protobuf-support")}


def list_versions(work: Work) -> dict[str, str]:
    """Versions of the packages that read this log and computed its numbers.

    Args:
        work: work whose stages and diagnosis have finished.
    """
    names = {*_ALWAYS, *_list_readers(work.setup)}
    versions = {name: _look_up(name) for name in sorted(names)}
    return {"python": platform.python_version(), PACKAGE: read_version(), **versions}


def _list_readers(setup: LogSetup) -> set[str]:
    """Packages that decompress or decode the data of a run."""
    index = setup.index
    wanted = {one.topic for one in list_wanted(setup.sources, index.types)}
    encodings = {channel.message_encoding for channel in index.channels if channel.topic in wanted}
    used = [_CONTAINER.get(name, ()) for name in index.containers]
    used += [_COMPRESSION.get(name, ()) for name in index.compressions]
    used += [_ENCODING.get(name, ()) for name in encodings]
    return {name for names in used for name in names}


@cache
def _look_up(name: str) -> str:
    return version(name)


def diagnose_work(work: Work) -> RunDiagnosis | None:
    """The run's diagnosis: reused if nothing has changed, else computed if it is requested.

    Table `slip` is given the model that was judged, now or by an earlier ``slip diagnose``, unless one was
    named with ``--model``; without a diagnosis it has none.

    Returns:
        None if it neither exists nor is requested.
    """
    generation, key = work.generation, key_diagnosis(work.keys)
    previous = generation.previous
    diagnosis: RunDiagnosis | None = None
    if previous is not None and has_diagnosis(previous, key) and not work.options.force:
        generation.reuse_file(DIAGNOSIS)
        for table in DIAGNOSED:
            if table in previous.tables:
                generation.reuse_table(table)
        diagnosis = read_result(previous.read_json(DIAGNOSIS), RunDiagnosis, previous.path(DIAGNOSIS))
    else:
        if work.options.diagnosis:
            work.progress(STAGE)
            diagnosis = _diagnose(work)
            generation.write_text(DIAGNOSIS, json.dumps(to_json(diagnosis), indent=1) + "\n")
            work.computed.append(STAGE)
        if work.options.model is None:
            length = work.setup.configuration.slip.length_scale_m
            judged = diagnosis or _read_stored(work.options.out, generation.run, key)
            show_model(generation, judged, work.vehicle, length)
    if diagnosis is None:
        return None
    work.keys = {**work.keys, STAGE: key}
    work.contexts[STAGE] = {}
    return diagnosis


def _diagnose(work: Work) -> RunDiagnosis:
    from pipeline.estimation import diagnose_runs  # noqa: PLC0415 - heavy

    generation, setup = work.generation, work.setup
    recording = _make_recording(
        work.run,
        (generation.table_names, generation.read_table),
        {"sha256": work.sha256, "path": str(setup.path)},
        setup.configuration.slip.length_scale_m,
    )
    try:
        diagnosis = diagnose_runs([recording], work.vehicle, inputs=work.options.inputs, notify=work.progress)
    except SlipError as error:
        # The slip of a log is valid even if it cannot be diagnosed.
        refusal = Finding(error.code, "warning", "diagnosis", {"error": str(error)})
        return RunDiagnosis(work.run, findings=(refusal,))
    for table in DIAGNOSED:
        frame = diagnosis.tabulate(table, work.run)
        if not frame.is_empty():
            work.write(table, frame)
    return diagnosis.runs[0]


def judge_run(findings: pl.DataFrame, diagnosis: RunDiagnosis | None) -> str:
    """The verdict on a run; without a diagnosis only the reason that forbids a fit, else empty.

    Args:
        findings: the run's findings.
        diagnosis: None if it was not requested.
    """
    noted = read_finding_table(findings) if diagnosis is None else diagnosis.findings
    if diagnosis is None and not find_refusal(noted):
        return ""
    from pipeline.words import format_refusal, format_verdict  # noqa: PLC0415 - heavy

    return format_refusal(noted) if diagnosis is None else format_verdict(diagnosis)


def summarize_run(work: Work, log: Mapping[str, JSON]) -> dict[str, JSON]:
    """The documented keys of `slip analyze --json` for one run, and additional ones.

    Args:
        work: the finished stages.
        log: facts of the recording: path, sha256, duration_s, complete, losses.
    """
    setup, generation = work.setup, work.generation
    aggregates = generation.read_table("aggregates")
    velocities = generation.read_table("velocities")
    slip = generation.read_table("slip")
    by_input = summarize_inputs(aggregates, slip)
    leading = "command" if "command" in by_input else "measured"
    whole = pick_row(aggregates, leading, "all")
    asked = "both" if len(work.options.inputs) > 1 else work.options.inputs[0]
    return {
        "run": work.run,
        "key": generation.key,
        "log": dict(log),
        "simulated": setup.index.is_simulated,
        "vehicle": setup.vehicle.id,
        "vehicle_name": setup.vehicle.name,
        "terrain": setup.terrain,
        "dataset": setup.dataset,
        "input": asked,
        "rate_hz": setup.configuration.velocity.rate_hz,
        "samples": by_input[leading]["samples"],
        "segments": velocities["segment"].n_unique(),
        "median_modulus": by_input[leading]["median_modulus"],
        "median_window_norm": by_input[leading]["median_window_norm"],
        "leading_input": leading,
        "length_scale_m": setup.configuration.slip.length_scale_m,
        "by_input": by_input,
        "split": _split(whole),
        "distance_m": round_number(whole["distance"]),
        "duration_s": round_number(whole["duration"]),
        "standing_share": round_number(find_standing_share(slip, leading)),
        "height_rate_mps": round_number(whole["height_rate"]),
        "largest_kinetic_energy_j": round_number(whole["largest_kinetic_energy"]),
        "held_poses": work.contexts["extract"].get("held_poses"),
        "timing": {
            "clocks": work.contexts["extract"].get("clocks"),
            "gyro": work.contexts["extract"].get("gyro"),
        },
        "quarantined": work.contexts["extract"].get("quarantined"),
        "topics": _summarize_topics(work),
        **setup.choice.to_json(setup.index.types),
        "findings": list_findings(generation.read_table("findings")),
    }


def _split(row: Mapping[str, float | None]) -> JSON:
    """Fractions of the mean square slip on command: drivetrain, ground, and twice their product."""
    parts = {name: row[f"{name}_mean_square"] for name in ("drivetrain", "ground", "cross")}
    present = {name: value for name, value in parts.items() if value is not None}
    total = sum(present.values())
    if len(present) < len(parts) or total <= 0.0:
        return None
    return {name: round(value / total, SUMMARY_DIGITS) for name, value in present.items()}


def _summarize_topics(work: Work) -> dict[str, JSON]:
    sources = work.setup.sources
    described: dict[str, JSON] = {}
    for role in ("command", "wheels", "pose", "imu", "interval"):
        source = getattr(sources, role)
        described[role] = None if source is None else {"topic": str(source), "reason": source.reason}
    return {**described, "notes": list(sources.notes)}


def list_findings(findings: pl.DataFrame) -> list[JSON]:
    """Findings as JSON objects, errors first."""
    columns = ["id", "severity", "text", "where", "t_start", "t_end", "value", "count", "stage", "values"]
    # Severities are an Enum, ordered from info to error.
    ordered = findings.select(columns).sort("severity", descending=True, maintain_order=True)
    return [{**row, "values": parse_values(row["values"])} for row in ordered.to_dicts()]


_MOST_RUNS = 2000
"""Largest number of runs in the results for the comparison in a report: more take seconds to read."""


def find_peers(store: Store, summary: Mapping[str, JSON]) -> dict[str, list[float]]:
    """Median slip moduli [m/s] of the comparable runs in the results, by input.

    Comparable runs have the same dataset and length scale. Each recording counts once; runs with a finding
    that forbids conclusions are excluded.

    Args:
        store: the results.
        summary: summary of the run itself.
    """
    if summary.get("terrain") in (None, "", "unknown") or len(store.run_dirs()) > _MOST_RUNS:
        return {}
    seen = {mapping_in(summary, "log").get("sha256")}
    medians: dict[str, list[float]] = {}
    # Listing the runs reports those that cannot be read; a report does not need them.
    for manifest in store.survey().manifests:
        is_same = manifest.run == summary.get("run")
        if is_same or manifest.details.get("dataset") != summary.get("dataset"):
            continue
        other = read_object(manifest.path(SUMMARY)) if SUMMARY in manifest.files else {}
        sha256 = manifest.part("log").get("sha256")
        if (
            sha256 in seen
            or other.get("length_scale_m") != summary.get("length_scale_m")
            or _is_doubtful(other)
        ):
            continue
        seen.add(sha256)
        by_input = mapping_in(other, "by_input")
        for name in by_input:
            if (median := number_in(mapping_in(by_input, name), "median_modulus")) is not None:
                medians.setdefault(name, []).append(median)
    return medians


def _is_doubtful(summary: Mapping[str, object]) -> bool:
    return any(finding.get("severity") == "error" for finding in objects_in(summary, "findings"))
