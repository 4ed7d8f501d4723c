"""Runs that are judged together: which of them take part, and what the others say of one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import msgspec

from pipeline.core import SlipError
from pipeline.estimation.conclude import refuse
from pipeline.estimation.diagnosis import Diagnosis
from pipeline.recording import Finding
from pipeline.results import RunDiagnosis, find_refusal
from pipeline.run import MotionRun, load_run
from pipeline.stages import WRONG_RADIUS, find_gain_of, is_grip

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from pipeline.estimation.recordings import DiagnosisInput
    from pipeline.sources import Vehicle


@dataclass(frozen=True)
class Member:
    """A run that takes part.

    Attributes:
        recording: its tables.
        run: the same as arrays.
    """

    recording: DiagnosisInput
    run: MotionRun


def judge_together(
    recordings: Sequence[DiagnosisInput],
    vehicle: Vehicle,
    source: str,
    judge: Callable[[Sequence[Member]], Diagnosis],
) -> Diagnosis:
    """Judge the runs that can be judged, together; those that cannot follow them, each with its reason.

    Args:
        recordings: runs of one vehicle.
        vehicle: it.
        source: input of the models, for runs that do not take part.
        judge: makes the diagnosis.

    Raises:
        SlipError: that of the last run, where none can be judged.
    """
    taken, out = list[Member](), list[RunDiagnosis]()
    problem: SlipError | None = None
    for recording in recordings:
        if find_refusal(recording.list_findings()):
            out.append(refuse(recording, source, recordings))
            continue
        try:
            run = load_run(recording.tables, vehicle, name=recording.name, sha256=recording.sha256)
            taken.append(Member(recording, run))
        except SlipError as error:
            problem = error
            out.append(_leave_out(recording, source, recordings, error))
    while taken:
        try:
            judged = judge(taken)
        except SlipError as error:
            about = error.where.split(", ")
            lost = [one for one in taken if one.run.name in about]
            if not lost or len(lost) == len(taken):
                raise
            taken = [one for one in taken if one not in lost]
            out += [_leave_out(one.recording, source, recordings, error) for one in lost]
        else:
            excused = _excuse([one.recording for one in taken], vehicle)
            runs = (_swap_finding(one, excused.get(one.run)) for one in judged.runs)
            return replace(judged, runs=(*runs, *out))
    if problem is not None:
        raise problem
    return Diagnosis(tuple(out))


def _leave_out(
    recording: DiagnosisInput, source: str, recordings: Sequence[DiagnosisInput], error: SlipError
) -> RunDiagnosis:
    finding = Finding(error.code, "warning", "diagnosis", {"kind": "left out", "error": error.what})
    refused = refuse(recording, source, recordings)
    return msgspec.structs.replace(refused, findings=(finding, *refused.findings))


def _excuse(recordings: Sequence[DiagnosisInput], vehicle: Vehicle) -> Mapping[str, Finding]:
    """What a finding of a wrong wheel radius is where other runs contradict that radius, by run."""
    gains, claimed = list[float](), dict[str, float]()
    for recording in recordings:
        claim = next((one for one in recording.list_findings() if one.id == WRONG_RADIUS), None)
        slip = recording.tables.get("slip")
        if claim is not None and claim.value is not None:
            claimed[recording.name] = claim.value / vehicle.wheel_radius_m
        elif slip is not None and (gain := find_gain_of(slip)) is not None:
            gains.append(gain)
    return {
        run: Finding("slippery_ground", "info", "wheels", {"value": gain})
        for run, gain in claimed.items()
        if is_grip(gain, gains)
    }


def _swap_finding(run: RunDiagnosis, excused: Finding | None) -> RunDiagnosis:
    if excused is None:
        return run
    findings = (excused if one.id == WRONG_RADIUS else one for one in run.findings)
    return msgspec.structs.replace(run, findings=tuple(findings))
