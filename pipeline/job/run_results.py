"""Stored outputs of a run: its diagnosis (with it or later), its JSON summary, and package versions."""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import polars as pl

from pipeline.core import PACKAGE, SlipError, read_version
from pipeline.core.untrusted import (
    PathError,
    mapping_in,
    number_in,
    objects_in,
    read_bounded,
    read_object,
    resolve_inside,
)
from pipeline.job import INPUTS, JobError
from pipeline.job.keys import LogSetup, Owner, agree_on_vehicle, hash_json
from pipeline.job.work import Work, add_model, remove_model, stored_contexts, stored_keys
from pipeline.logs import ROS1_BAG, SQLITE_BAG
from pipeline.results import Finding, RunDiagnosis, read_result, to_json
from pipeline.results.reading import read_findings, read_model
from pipeline.stages.reading import list_wanted
from pipeline.stages.slip_stage import set_residuals
from pipeline.store import JSON, Generation, Manifest, Store, StoreError
from pipeline.store.checksums import load_manifest
from pipeline.store.files import make_folder, replace_file
from pipeline.store.names import encode_run

if TYPE_CHECKING:
    from pipeline.estimation import Recording
    from pipeline.models import Model
    from pipeline.sources import Vehicle

_Packages = Mapping[str, tuple[str, ...]]
_ALWAYS = ("numpy", "scipy", "polars", "pyarrow")
_CONTAINER: _Packages = {"": ("mcap",), ROS1_BAG: ("rosbags", "lz4"), SQLITE_BAG: ("rosbags", "apsw")}
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


STAGE = "diagnosis"
DIAGNOSIS = "diagnosis.json"
_SUMMARY = "summary.json"
_TABLES = ("poses", "alignments", "commands", "wheels", "imu", "slip", "findings")
VERSION = 47
DIAGNOSED = ("ladder", "parameters", "budget", "estimates")


def key_diagnosis(keys: Mapping[str, str]) -> str:
    """Key of the diagnosis of a run whose stages have these keys."""
    from schemas import contract_of  # noqa: PLC0415 - brings a table library along

    # An effect is searched for by being there.
    effects = sorted(path.name for path in (Path(__file__).parents[1] / "models" / "effects").glob("*.py"))
    contracts = [contract_of(table).version for table in DIAGNOSED]
    return hash_json([keys["slip"], STAGE, VERSION, effects, *contracts])


def has_diagnosis(manifest: Manifest | None, key: str) -> bool:
    """Whether results contain the diagnosis with this key."""
    if manifest is None or DIAGNOSIS not in manifest.files:
        return False
    return manifest.part("stages", STAGE).get("key") == key


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
        diagnosis = read_result(previous.read_json(DIAGNOSIS), RunDiagnosis)
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


def show_model(
    generation: Generation, diagnosis: RunDiagnosis | None, vehicle: Vehicle, length: float
) -> None:
    """Fill the model columns of table `slip`, and their medians, with the model that a diagnosis judged.

    Args:
        generation: generation with the tables of all stages.
        diagnosis: of the run; where it has no model, the columns become empty.
        vehicle: vehicle of the run.
        length: length scale L [m] of the moduli.
    """
    slip = generation.read_table("slip")
    file = None if diagnosis is None else read_model(diagnosis)
    if file is not None:
        tables = {name: generation.read_table(name) for name in generation.table_names if name in _TABLES}
        slip, _ = add_model(slip, tables, file, vehicle, length=length, where=generation.run)
    elif slip["model_x"].null_count() < slip.height:
        slip = remove_model(slip)
    else:
        return
    generation.replace_table("slip", slip)
    generation.replace_table("aggregates", set_residuals(generation.read_table("aggregates"), slip))


def read_diagnosis(manifest: Manifest) -> RunDiagnosis | None:
    """Diagnosis that `diagnose_work` stored.

    Returns:
        None if it is missing, of another version, not of both inputs, or of a log that cannot be diagnosed;
        a new diagnosis then reports the reason.
    """
    keys = stored_keys(manifest)
    is_whole = "slip" in keys and manifest.details.get("inputs") == list(INPUTS)
    if not is_whole or not has_diagnosis(manifest, key_diagnosis(keys)):
        return None
    diagnosis = read_result(manifest.read_json(DIAGNOSIS), RunDiagnosis)
    return diagnosis if diagnosis.input else None


def read_stored_diagnosis(manifest: Manifest) -> RunDiagnosis | None:
    """The diagnosis in the results of a run, also one of an earlier version.

    Returns:
        None if there is none, or one of a version that this one cannot read.

    Raises:
        StoreError: it is damaged.
    """
    if DIAGNOSIS not in manifest.files:
        return None
    with suppress(msgspec.ValidationError):
        return read_result(manifest.read_json(DIAGNOSIS), RunDiagnosis)
    return None


def diagnose_stored(
    manifests: Sequence[Manifest],
    inputs: tuple[str, ...],
    known: Model | None,
    owner: Owner | None,
    budget_s: float | None,
) -> RunDiagnosis:
    """Diagnose stored runs jointly; return the diagnosis of the first.

    Args:
        manifests: manifests of the runs.
        inputs: allowed inputs of the model.
        known: base model to extend; None for the ideal model of the first run's vehicle.
        owner: geometry to use where vehicles differ.
        budget_s: CPU time limit of the search [s]; None for the default.

    Raises:
        SlipError: a run has insufficient data, or vehicles differ.
    """
    from pipeline.estimation import diagnose_runs  # noqa: PLC0415 - heavy

    read = [read_recording(manifest) for manifest in manifests]
    vehicles = {recording.name: vehicle for vehicle, recording in read}
    vehicle = agree_on_vehicle(None if known is None else known.vehicle, vehicles, owner)
    recordings = [recording for _, recording in read]
    return diagnose_runs(recordings, vehicle, inputs=inputs, model=known, budget_s=budget_s).runs[0]


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
        return RunDiagnosis(work.run, findings=(Finding(error.code, str(error), "diagnosis", "warning"),))
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
    from pipeline.words.verdict import format_refusal, format_verdict  # noqa: PLC0415 - heavy

    if diagnosis is None:
        return format_refusal(read_findings({"findings": findings.to_dicts()}))
    return format_verdict(diagnosis)


def load_vehicle(manifest: Manifest) -> Vehicle:
    """Vehicle that a run was analyzed with.

    Raises:
        JobError: ``no_vehicle``, the results do not contain it.
    """
    from pipeline.sources import Vehicle  # noqa: PLC0415 - heavy

    try:
        return msgspec.convert(manifest.details.get("vehicle"), Vehicle, strict=False)
    except msgspec.ValidationError as error:
        hint = "Analyze the log again with --force."
        raise JobError(
            "no_vehicle", "the results do not say which vehicle the run is of", where=manifest.run, hint=hint
        ) from error


def read_recording(manifest: Manifest) -> tuple[Vehicle, Recording]:
    """Vehicle and input data of a diagnosis from a stored run.

    Raises:
        SlipError: the results do not contain the vehicle, or a table cannot be read.
    """
    recording = _make_recording(
        manifest.run,
        (manifest.tables, manifest.read),
        manifest.part("log"),
        read_length_scale(manifest),
    )
    return load_vehicle(manifest), recording


def read_choices(manifest: Manifest) -> dict[str, object]:
    """Topics and vehicle that were chosen for a stored run: ``choices`` and ``vehicle_source``."""
    summary = manifest.read_json(_SUMMARY) if _SUMMARY in manifest.files else {}
    return {key: summary[key] for key in ("choices", "vehicle_source") if key in summary}


def _make_recording(
    run: str,
    tables: tuple[Iterable[str], Callable[[str], pl.DataFrame]],
    log: Mapping[str, JSON],
    length_scale_m: float,
) -> Recording:
    """Tables for a diagnosis, with their origin."""
    from pipeline.estimation import Recording  # noqa: PLC0415 - heavy

    names, read = tables
    return Recording(
        run,
        {name: read(name) for name in names if name in _TABLES},
        sha256=str(log.get("sha256", "")),
        path=str(log.get("path", "")),
        length_scale_m=length_scale_m,
    )


def read_length_scale(manifest: Manifest) -> float:
    """Length scale of the slip modulus that a run was analyzed with [m]."""
    scale = manifest.part("configuration", "slip").get("length_scale_m")
    return float(scale) if isinstance(scale, int | float) else 1.0


_DIGITS = 6


def summarize_run(work: Work, log: Mapping[str, JSON]) -> dict[str, JSON]:
    """The documented keys of `slip analyze --json` for one run, and additional ones.

    Args:
        work: the finished stages.
        log: facts of the recording: path, sha256, duration_s, complete, losses.
    """
    setup, generation = work.setup, work.generation
    aggregates = generation.read_table("aggregates")
    velocities = generation.read_table("velocities")
    by_input = _summarize_inputs(aggregates)
    leading = "command" if "command" in by_input else "measured"
    whole = _row(aggregates, leading, "all")
    asked = "both" if len(work.options.inputs) > 1 else work.options.inputs[0]
    return {
        "run": work.run,
        "key": generation.key,
        "log": dict(log),
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
        "distance_m": _rounded(whole["distance"]),
        "duration_s": _rounded(whole["duration"]),
        "height_rate_mps": _rounded(whole["height_rate"]),
        "largest_kinetic_energy_j": _rounded(whole["largest_kinetic_energy"]),
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


def _summarize_inputs(aggregates: pl.DataFrame) -> dict[str, dict[str, JSON]]:
    names = aggregates["input"].unique(maintain_order=True)
    return {name: _summarize_input(aggregates, name) for name in names}


def _summarize_input(aggregates: pl.DataFrame, name: str) -> dict[str, JSON]:
    rows = {subset: _row(aggregates, name, subset) for subset in ("all", "transitory", "steady")}
    whole = rows["all"]
    return {
        "samples": int(whole["samples"] or 0),
        "windows": int(whole["windows"] or 0),
        "median_modulus": _rounded(whole["median_modulus"]),
        "median_window_norm": _rounded(whole["median_window_norm"]),
        "median_residual_modulus": _rounded(whole["median_residual_modulus"]),
        "rms": [_rounded(whole[f"rms_{axis}"]) for axis in "xyw"],
        "transitory_median_modulus": _rounded(rows["transitory"]["median_modulus"]),
        "steady_median_modulus": _rounded(rows["steady"]["median_modulus"]),
    }


def _row(aggregates: pl.DataFrame, name: str, subset: str) -> dict[str, float | None]:
    return aggregates.filter((pl.col("input") == name) & (pl.col("subset") == subset)).row(0, named=True)


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(float(value), _DIGITS)


def _split(row: Mapping[str, float | None]) -> JSON:
    """Fractions of the mean square slip on command: drivetrain, ground, and twice their product."""
    parts = {name: row[f"{name}_mean_square"] for name in ("drivetrain", "ground", "cross")}
    present = {name: value for name, value in parts.items() if value is not None}
    total = sum(present.values())
    if len(present) < len(parts) or total <= 0.0:
        return None
    return {name: round(value / total, _DIGITS) for name, value in present.items()}


def _summarize_topics(work: Work) -> dict[str, JSON]:
    sources = work.setup.sources
    described: dict[str, JSON] = {}
    for role in ("command", "wheels", "pose", "imu", "interval"):
        source = getattr(sources, role)
        described[role] = None if source is None else {"topic": str(source), "reason": source.reason}
    return {**described, "notes": list(sources.notes)}


def list_findings(findings: pl.DataFrame) -> list[JSON]:
    """Findings as JSON objects, errors first."""
    columns = ["id", "severity", "text", "where", "t_start", "t_end", "value", "count", "stage"]
    # Severities are an Enum, ordered from info to error.
    return list(findings.select(columns).sort("severity", descending=True, maintain_order=True).to_dicts())


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
    run_dirs = store.run_dirs()
    if summary.get("terrain") in (None, "", "unknown") or len(run_dirs) > _MOST_RUNS:
        return {}
    seen = {mapping_in(summary, "log").get("sha256")}
    medians: dict[str, list[float]] = {}
    for home in run_dirs:
        try:
            manifest = load_manifest(home)
        except (StoreError, OSError):
            # Listing the runs reports the error; a report does not need this run.
            continue
        if manifest is None or manifest.run == summary.get("run"):
            continue
        if manifest.details.get("dataset") != summary.get("dataset"):
            continue
        other = read_object(manifest.path(_SUMMARY)) if _SUMMARY in manifest.files else {}
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


FOLDER = "workbench"
"""Folder in the results for data of the workbench: sessions, models and requested diagnoses."""
UPLOADS = f"{FOLDER}/uploads"
"""Folder of logs uploaded through the page; each is deleted after its analysis."""


class _StoredDiagnosis(msgspec.Struct, frozen=True):
    """A diagnosis and the key of its inputs."""

    key: str
    diagnosis: dict[str, object]


def locate_beside(results: Path, folder: str, run: str, suffix: str) -> Path:
    """Path of a workbench file of a run, in results that are untrusted.

    Raises:
        PathError: a link leads out of the results, or the path is a pipe or device.
    """
    encoded = encode_run(run)
    return resolve_inside(results, f"{FOLDER}/{folder}/{encoded.with_name(f'{encoded.name}{suffix}')}")


def find_diagnosis(results: Path, manifest: Manifest) -> RunDiagnosis | None:
    """The diagnosis of a run from both inputs: that of `read_diagnosis`, or one of `keep_diagnosis`.

    Returns:
        None if neither exists for these tables and this version.
    """
    diagnosis = read_diagnosis(manifest)
    if diagnosis is not None or not _is_of(results, manifest):
        return diagnosis
    return _read_stored(results, manifest.run, _key_of(manifest))


def _read_stored(results: Path, run: str, key: str) -> RunDiagnosis | None:
    """What `keep_diagnosis` stored of a run under a key."""
    try:
        path = locate_beside(results, "diagnoses", run, ".json")
        stored = msgspec.json.decode(read_bounded(path), type=_StoredDiagnosis)
    except (OSError, PathError, msgspec.MsgspecError, RecursionError, UnicodeDecodeError):
        return None
    return read_result(stored.diagnosis, RunDiagnosis) if stored.key == key else None


def keep_diagnosis(results: Path, manifest: Manifest, diagnosis: RunDiagnosis) -> None:
    """Store the diagnosis of a run from both inputs for later requests.

    Table `slip` is given its model, unless the run was analyzed with another one. Nothing is stored for a run
    that is not of these results, as it was analyzed with other options.

    Raises:
        OSError: the results cannot be written.
        SlipError: another process writes them, or a link leads out of them.
    """
    if not _is_of(results, manifest):
        return
    path = locate_beside(results, "diagnoses", manifest.run, ".json")
    make_folder(path.parent)
    replace_file(path, json.dumps({"key": _key_of(manifest), "diagnosis": to_json(diagnosis)}).encode())
    if stored_contexts(manifest)["slip"].get("model") is not None or _SUMMARY not in manifest.files:
        return
    with Store(results).open_generation(manifest.run, manifest.key) as generation:
        current = generation.previous
        if current is None or current.key != manifest.key:
            return
        generation.reuse_all(_SUMMARY)
        show_model(generation, diagnosis, load_vehicle(current), read_length_scale(current))
        by_input = _summarize_inputs(generation.read_table("aggregates"))
        summary = {**current.read_json(_SUMMARY), "by_input": by_input}
        generation.write_text(_SUMMARY, json.dumps(summary, indent=1) + "\n")
        generation.commit(current.details)


def _is_of(results: Path, manifest: Manifest) -> bool:
    """Whether the results hold this run as it was analyzed, if with other diagnoses or reports."""
    current = Store(results).manifest(manifest.run)
    return "slip" in stored_keys(manifest) and current is not None and current.key == manifest.key


def _key_of(manifest: Manifest) -> str:
    return key_diagnosis(stored_keys(manifest))
