"""Diagnoses of stored runs: made, kept under a key and read back; and their model in table `slip`."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np
import polars as pl

from pipeline.core import INPUTS, PathError, SlipError
from pipeline.recording import Finding
from pipeline.results import RunDiagnosis, read_model, read_result, to_json
from pipeline.run import MotionError, load_run
from pipeline.sources import Owner, Vehicle, agree_on_vehicle, load_vehicle
from pipeline.stages import set_residuals, slip_stage, summarize_inputs
from pipeline.store import (
    DIAGNOSIS,
    JSON,
    SUMMARY,
    Generation,
    Manifest,
    Store,
    StoreError,
    hash_json,
    locate_beside,
    make_folder,
    read_length_scale,
    read_stored,
    replace_file,
    stored_contexts,
    stored_keys,
)
from schemas import contract_of

if TYPE_CHECKING:
    from pipeline.estimation.recordings import DiagnosisInput
    from pipeline.models import Model, ModelFile


_MODEL_COLUMNS = ("model_x", "model_y", "model_w", "residual_modulus")


def add_model(
    slip: pl.DataFrame,
    tables: Mapping[str, pl.DataFrame],
    file: ModelFile,
    vehicle: Vehicle,
    *,
    length: float,
    where: str,
) -> tuple[pl.DataFrame, tuple[Finding, ...]]:
    """Table `slip` with the velocity of a model and the modulus of the residual, and findings on failures.

    Args:
        slip: table `slip`; what its model columns hold is replaced.
        tables: `poses`, `alignments`, `commands`, `wheels`, `imu`, as far as the log has them.
        file: the model.
        vehicle: vehicle of the run; the model must be of its kind.
        length: length scale L [m] of the modulus.
        where: the model's origin, for errors.

    Raises:
        MotionError: the model is of another kind of vehicle.
    """
    from pipeline.estimation import Input  # noqa: PLC0415 - heavy
    from pipeline.estimation.prediction import predict_at  # noqa: PLC0415 - heavy

    slip, model = _remove_model(slip), file.model
    findings: list[Finding] = []
    if model.vehicle.kind != vehicle.kind:
        what = f"the model is of a vehicle of kind {model.vehicle.kind!r}, the run's is {vehicle.kind!r}"
        raise MotionError("wrong_model", what, where=where, hint="Give a model of this vehicle.")
    run = load_run({**tables, "slip": slip}, model.vehicle, name=where)
    parts = []
    for name in slip["input"].unique(maintain_order=True):
        part = slip.filter(pl.col("input") == name)
        try:
            predicted = predict_at(model, run, Input(name), part["t"].to_numpy())
        except SlipError as error:
            # For example dead encoders: the input exists, but a model cannot be computed from it.
            values = {"input": name, "why": str(error)}
            findings.append(Finding("model_not_followed", "warning", "model", values))
            parts.append(part)
            continue
        columns = [*predicted.T, slip_stage.find_residual_modulus(predicted, part, length=length)]
        known = np.isfinite(np.stack(columns)).all(axis=0)
        parts.append(
            part.with_columns(
                pl.Series(column, np.where(known, values, np.nan)).fill_nan(None)
                for column, values in zip(_MODEL_COLUMNS, columns, strict=True)
            )
        )
    return pl.concat(parts), tuple(findings)


def read_slip(manifest: Manifest, file: ModelFile | None = None) -> pl.DataFrame:
    """Table `slip` of a stored run, with the velocity of a model in place of the diagnosed one.

    Args:
        manifest: the run.
        file: the model; None for what was diagnosed.

    Raises:
        MotionError: the model is of another kind of vehicle.
    """
    slip = manifest.read("slip")
    if file is None:
        return slip
    tables = {name: manifest.read(name) for name in manifest.tables if name in _TABLES}
    length, vehicle = read_length_scale(manifest), load_vehicle(manifest)
    return add_model(slip, tables, file, vehicle, length=length, where=manifest.run)[0]


def _remove_model(slip: pl.DataFrame) -> pl.DataFrame:
    """Table `slip` with empty model columns."""
    return slip.with_columns(pl.lit(None, pl.Float64).alias(name) for name in _MODEL_COLUMNS)


STAGE = "diagnosis"


_TABLES = ("poses", "alignments", "commands", "wheels", "imu", "slip", "findings")


VERSION = 62


DIAGNOSED = ("ladder", "parameters", "budget", "estimates")


def key_diagnosis(keys: Mapping[str, str]) -> str:
    """Key of the diagnosis of a run whose stages have these keys."""
    # An effect is searched for by being there.
    effects = sorted(path.name for path in (Path(__file__).parents[1] / "models" / "effects").glob("*.py"))
    contracts = [contract_of(table).version for table in DIAGNOSED]
    return hash_json([keys["slip"], STAGE, VERSION, effects, *contracts])


def has_diagnosis(manifest: Manifest | None, key: str) -> bool:
    """Whether results contain the diagnosis with this key."""
    if manifest is None or DIAGNOSIS not in manifest.files:
        return False
    return manifest.part("stages", STAGE).get("key") == key


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
        slip = _remove_model(slip)
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
    diagnosis = _read_whole(manifest)
    return diagnosis if diagnosis.input else None


def read_stored_diagnosis(manifest: Manifest) -> RunDiagnosis | None:
    """The diagnosis in the results of a run, also one of an earlier version; None if there is none.

    Raises:
        StoreError: it is damaged, or of a version that this one cannot read.
    """
    return _read_whole(manifest) if DIAGNOSIS in manifest.files else None


def _read_whole(manifest: Manifest) -> RunDiagnosis:
    return read_result(manifest.read_json(DIAGNOSIS), RunDiagnosis, manifest.path(DIAGNOSIS))


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


def read_recording(manifest: Manifest) -> tuple[Vehicle, DiagnosisInput]:
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


def _make_recording(
    run: str,
    tables: tuple[Iterable[str], Callable[[str], pl.DataFrame]],
    log: Mapping[str, JSON],
    length_scale_m: float,
) -> DiagnosisInput:
    """Tables for a diagnosis, with their origin."""
    from pipeline.estimation.recordings import DiagnosisInput  # noqa: PLC0415 - heavy

    names, read = tables
    return DiagnosisInput(
        run,
        {name: read(name) for name in names if name in _TABLES},
        sha256=str(log.get("sha256", "")),
        path=str(log.get("path", "")),
        length_scale_m=length_scale_m,
    )


class _StoredDiagnosis(msgspec.Struct, frozen=True):
    """A diagnosis and the key of its inputs."""

    key: str
    diagnosis: dict[str, object]


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
    """What `keep_diagnosis` stored of a run under a key; None without it, or if it is to be made again."""
    try:
        path = locate_beside(results, "diagnoses", run, ".json")
        stored = read_stored(path, _StoredDiagnosis)
        return read_result(stored.diagnosis, RunDiagnosis, path) if stored.key == key else None
    except (StoreError, PathError):
        return None


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
    if stored_contexts(manifest)["slip"].get("model") is not None or SUMMARY not in manifest.files:
        return
    with Store(results).open_generation(manifest.run, manifest.key) as generation:
        current = generation.previous
        if current is None or current.key != manifest.key:
            return
        generation.reuse_all(SUMMARY)
        show_model(generation, diagnosis, load_vehicle(current), read_length_scale(current))
        by_input = summarize_inputs(generation.read_table("aggregates"), generation.read_table("slip"))
        summary = {**current.read_json(SUMMARY), "by_input": by_input}
        generation.write_text(SUMMARY, json.dumps(summary, indent=1) + "\n")
        generation.commit(current.details)


def _is_of(results: Path, manifest: Manifest) -> bool:
    """Whether the results hold this run as it was analyzed, if with other diagnoses or reports."""
    current = Store(results).manifest(manifest.run)
    return "slip" in stored_keys(manifest) and current is not None and current.key == manifest.key


def _key_of(manifest: Manifest) -> str:
    return key_diagnosis(stored_keys(manifest))
