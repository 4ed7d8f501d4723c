"""The diagnosis of one run inside an analysis: made once, kept as a table and a JSON file, then reused."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from pipeline.core.errors import SlipError
from pipeline.job.keys import hash_json

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.diagnosis import Diagnosis
    from pipeline.job.work import Work
    from pipeline.store import JSON, Manifest

STAGE = "diagnosis"
DIAGNOSIS = "diagnosis.json"
VERSION = 1
_LABEL = 10


def key_diagnosis(keys: Mapping[str, str]) -> str:
    """Key of the diagnosis of a run whose stages have these keys."""
    from schemas import contract_of  # noqa: PLC0415 - brings a table library along

    return hash_json([keys["slip"], STAGE, VERSION, contract_of("ladder").version])


def has_diagnosis(manifest: Manifest | None, key: str) -> bool:
    """Whether results hold this very diagnosis."""
    if manifest is None or DIAGNOSIS not in manifest.files:
        return False
    stages = manifest.details.get("stages")
    stored = stages.get(STAGE) if isinstance(stages, dict) else None
    return isinstance(stored, dict) and stored.get("key") == key


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
        if "ladder" in previous.tables:
            generation.reuse_table("ladder")
        content: dict[str, JSON] = json.loads(previous.path(DIAGNOSIS).read_text(encoding="utf-8"))
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


def _diagnose(work: Work) -> dict[str, JSON]:
    from pipeline.diagnosis import Recording, diagnose_runs  # noqa: PLC0415 - heavy

    generation, subject = work.generation, work.subject
    recording = Recording(
        work.run,
        {name: generation.read_table(name) for name in generation.table_names},
        sha256=work.sha256,
        path=str(subject.path),
        hold_s=subject.configuration.command.hold_s,
    )
    try:
        diagnosis = diagnose_runs([recording], subject.vehicle, inputs=work.options.inputs)
    except SlipError as error:
        # A log too poor to diagnose has its slip all the same.
        finding = {"id": error.code, "severity": "warning", "text": str(error), "where": "diagnosis"}
        return {"run": work.run, "effects": [], "undecided": [], "findings": [finding], "ladder": [],
                "lines": [["missing", f"nothing can be named: {error.what}"]]}  # fmt: skip
    ladder = diagnosis.tabulate_ladder(work.run)
    if not ladder.is_empty():
        work.write("ladder", ladder)
    return {**diagnosis.to_json()[0], "lines": _list_lines(diagnosis)}


def _list_lines(diagnosis: Diagnosis) -> list[list[str]]:
    """Label and text of every line that a person reads, without the run's own."""
    from pipeline.diagnosis.words import describe_run  # noqa: PLC0415 - heavy

    lines = describe_run(diagnosis.runs[0]).splitlines()[1:]
    return [[line[:_LABEL].strip(), line[_LABEL:].rstrip()] for line in lines]
