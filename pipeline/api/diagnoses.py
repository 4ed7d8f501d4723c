"""Diagnoses of runs of one vehicle together; that of a single run is stored, or was."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from pipeline.api.opening import ReadRun
from pipeline.core import INPUTS, SlipError
from pipeline.estimation import diagnose_runs, parse_budget
from pipeline.estimation.stored_diagnosis import find_diagnosis, keep_diagnosis, read_slip
from pipeline.models import ModelFile
from pipeline.results import RunDiagnosis
from pipeline.sources import Owner, agree_on_vehicle

__all__ = ["diagnose_together", "parse_budget", "read_slip"]


def diagnose_together(
    group: Sequence[ReadRun],
    results: Path,
    *,
    inputs: tuple[str, ...] = INPUTS,
    known: ModelFile | None = None,
    owner: Owner | None = None,
    budget_s: float | None = None,
    notify: Callable[[str], None] | None = None,
    warn: Callable[[str], None] | None = None,
) -> Sequence[RunDiagnosis]:
    """Diagnose runs of one vehicle together; a single one with default options is stored, or was.

    Args:
        group: the runs, at least one.
        results: folder of results.
        inputs: allowed inputs of the model.
        known: only effects beyond this model are estimated; None for the ideal model.
        owner: whose geometry is used where the runs are of another vehicle than the model.
        budget_s: CPU time of the search [s]; None for as long as it needs.
        notify: called with what is being done.
        warn: called with the reason why a diagnosis could not be stored.

    Raises:
        SlipError: a run has insufficient data, or vehicles differ.
    """
    first = group[0]
    keeps = known is None and budget_s is None and inputs == INPUTS and len(group) == 1
    if keeps and (stored := find_diagnosis(results, first.manifest)) is not None:
        return [stored]
    vehicles = {one.recording.name: one.vehicle for one in group}
    runs = diagnose_runs(
        [one.recording for one in group],
        agree_on_vehicle(None if known is None else known.model.vehicle, vehicles, owner),
        inputs=inputs,
        model=None if known is None else known.model,
        budget_s=budget_s,
        notify=notify,
    ).runs
    if keeps:
        try:
            keep_diagnosis(results, first.manifest, runs[0])
        except (OSError, SlipError) as error:
            if warn is not None:
                warn(f"the diagnosis was not saved: {error}")
    return runs
