"""Gains of a platform's own units, as a preset assumes them, against what the log says of them.

A motor controller counts speeds in a unit of its own, and how many of it are a metre a second is a setting of
each robot. The odometry that the robot computes with that setting shows it exactly; without one the poses
show it up to slip.
"""

from pipeline.recording.case import Candidate, Case
from pipeline.recording.encoders import SAME_SCALE
from pipeline.recording.findings import Finding, Severity
from pipeline.recording.geometry import roll_wheels
from pipeline.recording.motion import FEWEST_STEPS, find_one_ratio

_COMPUTED = 1.02
"""Ratio of two speeds up to which one is computed from the other with its gain: rounding, and times that
differ."""


def ask_gains(case: Case) -> Case:
    """Tell the gain of a preset's own unit that the log contradicts, with the line that corrects it."""
    made, sections = case.complete(), dict[str, list[str]]()
    for role in ("wheels", "command"):
        drive, section = getattr(case, role), getattr(made, role)
        unit = section.unit or (drive.source.signals[0].unit if drive.is_there else "")
        own = case.vehicle.units.get(unit) if case.is_known else None
        if own is not None and own.unit == "m/s" and section.scale is None:
            sections.setdefault(unit, []).append(role)
    for unit, roles in sections.items():
        ratio, source, severity = _find_ratio(case, getattr(case, roles[0]))
        if ratio is None:
            continue
        per = case.vehicle.units[unit].per
        values = {
            "by": "odometry" if source else "poses",
            "unit": unit,
            "used": per,
            "value": per / ratio,
            "scale": ratio,
            "source": source or str(case.sources.pose),
            "sections": roles,
        }
        case.findings.append(Finding("gain_assumed", severity, roles[0], values))
    return case


def _find_ratio(case: Case, drive: Candidate) -> tuple[float | None, str, Severity]:
    """A speed over that of a drive, where they differ; the topic that states it, none of poses; severity."""
    for one in (case.wheels, *case.drives):
        if one.reading.form != "body" or not one.is_measured or one.is_of(drive.source):
            continue
        said = roll_wheels(one.reading)
        if not said.is_known:
            continue
        elapsed = said.steps.end - said.steps.start
        driven = drive.reading.first.integrate(said.steps, 0.0, 0.0) / elapsed
        ratio = find_one_ratio(said.body.real / elapsed, driven, FEWEST_STEPS)
        if ratio is not None:
            is_other = not 1.0 / _COMPUTED < abs(ratio) < _COMPUTED
            return (abs(ratio) if is_other else None), str(one.source), "error"
    ratio = (
        abs(float(drive.reading.explained.ahead.gains[0])) if case.has_pose and drive.sign("ahead") else 1.0
    )
    is_other = not 1.0 / SAME_SCALE < ratio < SAME_SCALE
    return (ratio if is_other else None), "", "warning"
