"""The diagnosis of one run inside an analysis: made once, kept as a table and a JSON file, then reused."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from pipeline.analysis.geometry import Owner, agree_on_vehicle
from pipeline.analysis.keys import hash_json
from pipeline.analysis.options import INPUTS
from pipeline.analysis.work import Work, stored_keys
from pipeline.core.errors import SlipError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    import polars as pl

    from pipeline.diagnosis import Recording
    from pipeline.models import Model
    from pipeline.store import JSON, Manifest
    from pipeline.vehicles import Vehicle

STAGE = "diagnosis"
LINES = "lines"
DIAGNOSIS = "diagnosis.json"
_SUMMARY = "summary.json"
_TABLES = ("poses", "alignments", "commands", "wheels", "imu", "slip", "findings")
VERSION = 21
DIAGNOSED = ("ladder", "parameters", "budget", "estimates")


def key_diagnosis(keys: Mapping[str, str]) -> str:
    """Key of the diagnosis of a run whose stages have these keys."""
    from schemas import contract_of  # noqa: PLC0415 - brings a table library along

    return hash_json([keys["slip"], STAGE, VERSION, *(contract_of(table).version for table in DIAGNOSED)])


def has_diagnosis(manifest: Manifest | None, key: str) -> bool:
    """Whether results hold this very diagnosis."""
    if manifest is None or DIAGNOSIS not in manifest.files:
        return False
    return manifest.part("stages", STAGE).get("key") == key


def diagnose_work(work: Work) -> dict[str, JSON] | None:
    """The run's diagnosis: taken over where nothing has changed, else made where it is asked for.

    Returns:
        The JSON object of the run as in ``slip diagnose --json``, and its lines for the screen; None where it
        is neither there nor asked for.
    """
    generation, key = work.generation, key_diagnosis(work.keys)
    previous = generation.previous
    if previous is not None and has_diagnosis(previous, key) and not work.options.force:
        generation.reuse_file(DIAGNOSIS)
        for table in DIAGNOSED:
            if table in previous.tables:
                generation.reuse_table(table)
        content = previous.read_json(DIAGNOSIS)
    elif work.options.diagnosis:
        work.progress(STAGE)
        content = _diagnose(work)
        generation.write_text(DIAGNOSIS, json.dumps(content, indent=1) + "\n")
        work.computed.append(STAGE)
    else:
        return None
    work.keys = {**work.keys, STAGE: key}
    work.contexts[STAGE] = {}
    return content


def read_diagnosis(manifest: Manifest) -> dict[str, object] | None:
    """What `diagnose_work` kept with a run: the object of ``slip diagnose --json``, and its lines.

    Returns:
        None where it is not there, of another version, not of both inputs, or of a log too poor to diagnose:
        who asks again is told why.
    """
    keys = stored_keys(manifest)
    is_whole = "slip" in keys and manifest.details.get("inputs") == list(INPUTS)
    if not is_whole or not has_diagnosis(manifest, key_diagnosis(keys)):
        return None
    content = manifest.read_json(DIAGNOSIS)
    return {**content, **read_choices(manifest)} if "input" in content else None


def diagnose_stored(
    manifests: Sequence[Manifest],
    inputs: tuple[str, ...],
    known: Model | None,
    owner: Owner | None,
    budget_s: float | None,
) -> dict[str, object]:
    """Stored runs diagnosed together, and what is said of the first, as `read_diagnosis` has it.

    Args:
        manifests: of the runs.
        inputs: what the model may be fed with.
        known: say what is missing beyond it; None for the ideal model of the first run's vehicle.
        owner: whose geometry counts where vehicles differ.
        budget_s: CPU time of the search [s]; None for the usual one.

    Raises:
        SlipError: a run is too poor, or vehicles differ.
    """
    from pipeline.diagnosis import diagnose_runs  # noqa: PLC0415 - heavy
    from pipeline.diagnosis.words import list_lines  # noqa: PLC0415 - heavy

    read = [read_recording(manifest) for manifest in manifests]
    vehicles = {recording.name: vehicle for vehicle, recording in read}
    vehicle = agree_on_vehicle(read[0][0] if known is None else known.vehicle, vehicles, owner)
    recordings = [recording for _, recording in read]
    (first, *_) = diagnose_runs(recordings, vehicle, inputs=inputs, model=known, budget_s=budget_s).runs
    return {**first.to_json(), **read_choices(manifests[0]), LINES: list_lines(first)}


def _diagnose(work: Work) -> dict[str, JSON]:
    from pipeline.diagnosis import diagnose_runs  # noqa: PLC0415 - heavy
    from pipeline.diagnosis.words import list_lines  # noqa: PLC0415 - heavy

    generation, setup = work.generation, work.setup
    recording = _make_recording(
        work.run,
        (generation.table_names, generation.read_table),
        {"sha256": work.sha256, "path": str(setup.path)},
        setup.configuration.slip.length_scale_m,
    )
    try:
        diagnosis = diagnose_runs([recording], work.vehicle, inputs=work.options.inputs, tell=work.progress)
    except SlipError as error:
        # A log too poor to diagnose has its slip all the same.
        finding = {"id": error.code, "severity": "warning", "text": str(error), "where": "diagnosis"}
        return {"run": work.run, "effects": [], "undecided": [], "findings": [finding], "ladder": [],
                "lines": [["missing", f"nothing can be named: {error.what}"]]}  # fmt: skip
    for table in DIAGNOSED:
        frame = diagnosis.tabulate(table, work.run)
        if not frame.is_empty():
            work.write(table, frame)
    return {**diagnosis.to_json()[0], LINES: [list(line) for line in list_lines(diagnosis.runs[0])]}


def read_recording(manifest: Manifest) -> tuple[Vehicle, Recording]:
    """A stored run as it is diagnosed, and its vehicle.

    Raises:
        SlipError: the results do not say the vehicle, or a table of them cannot be read.
    """
    from pipeline.report.motion_run import load_vehicle  # noqa: PLC0415 - heavy, and only for stored runs

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
    """The tables that a diagnosis reads, with where they came from."""
    from pipeline.diagnosis import Recording  # noqa: PLC0415 - heavy

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
