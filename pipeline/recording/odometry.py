"""A pose compared with its own velocity: it moves as far as the speeds that are recorded with it say.

It is asked before units, clocks and roles: what a message contradicts by itself is of no other topic.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import polars as pl

from pipeline.core import Floats, SlipError, rigid
from pipeline.recording.case import Case
from pipeline.recording.evidence import RATES, SPEEDS
from pipeline.recording.findings import Finding
from pipeline.recording.motion import FEWEST_STEPS, find_one_ratio
from pipeline.recording.readings import Held, Reading
from pipeline.sources import LENGTH_UNITS, DriveForm, DriveSource, PoseContent, PoseSource

_APART = 4.0
"""Ratio of pose and speeds from which on one of them is wrong: skidding wheels turn a body a quarter as far
as they say at least."""
_ALIKE = 0.1
"""Largest absolute logarithm of two ratios that are the same: of a unit, or of the time step."""
_LENGTHS = (*SPEEDS.values(), *(1.0 / one for one in LENGTH_UNITS.values()))
"""Ratios that a unit of speeds or of positions makes."""


def ask_odometry(case: Case) -> Case:
    """Refuse a pose that contradicts the speeds of its own messages, or leave these out.

    Either a pose adds up speeds without the time step, or speeds are changes that are not divided by it: a
    command tells which of them is wrong, without one the usual speed of a vehicle, a metre or radian a
    second.
    """
    poses = [case.sources.pose, *case.sources.others.get("pose", ())]
    by_topic = {
        one.topic: one for one in poses if isinstance(one, PoseSource) and one.content is PoseContent.POSE
    }
    for source in case.sources.rank_drives("wheels"):
        pose = by_topic.get(source.signals[0].topic)
        if source.form is DriveForm.BODY and pose is not None and case.refused is None:
            case = _compare(case, source, pose)
    return case if case.refused is not None else _compare_speed(case)


def _compare(case: Case, source: DriveSource, pose: PoseSource) -> Case:
    """The case without what the pose and the speeds of one topic contradict."""
    is_used = pose == case.sources.pose
    try:
        extraction = case.extraction if is_used else case.extraction.take_pose(pose)
        is_mixed = not is_used and extraction.find_tracks() is not None
        times, moved, turned = _list_changes(extraction.poses())
    except SlipError:
        return case
    if is_mixed:
        # The speeds of two bodies are told apart by the poses that are sent with them.
        what = {"what": f"{source}: two publishers send on it by turns, whose poses go along two tracks"}
        case.findings.append(Finding("numbers_not_used", "warning", "wheels", what))
        return case.leave_out(source)
    twist = case.read(source, is_measured=True)
    if times.size < FEWEST_STEPS:
        return case
    ratios = [_find_ratio(*each) for each in ((times, moved, twist.first), (times, turned, twist.second))]
    wrong = [
        ratio is not None and _is_wrong(ratio, of)
        for ratio, of in zip(ratios, (_LENGTHS, [*RATES.values()]), strict=True)
    ]
    if not (any(wrong) or is_used) and source == case.sources.wheels:
        _correct_units(case, source, ratios)
    if not any(wrong):
        return case
    axis = 1 if wrong[1] else 0
    said = (twist.first, twist.second)[axis]
    finding = _report(case, pose.topic, times, (axis, ratios[axis] or 1.0), said)
    if finding.values["kind"] == "pose":
        return replace(case, refused=finding) if is_used else case
    case.findings.append(finding)
    return case.leave_out(source)


def _compare_speed(case: Case) -> Case:
    """The case without what contradicts: positions in use, or the velocities recorded with them."""
    pose = case.sources.pose
    if pose is None or pose.wheels is not None or pose.from_transforms:
        return case
    try:
        said = Held(*case.extraction.own_speed())
        times, moved, _ = _list_changes(case.extraction.poses())
    except SlipError:
        return case
    ratio = _find_ratio(times, moved, said) if times.size >= FEWEST_STEPS else None
    if ratio is None or not _is_wrong(ratio, _LENGTHS):
        return case
    finding = _report(case, pose.topic, times, (0, ratio), said, pose.velocity)
    if finding.values["kind"] == "pose":
        return replace(case, refused=finding)
    case.findings.append(finding)
    return case


def _report(
    case: Case, topic: str, times: Floats, apart: tuple[int, float], said: Held, velocity: str = ""
) -> Finding:
    """What of a pose and the speeds that belong to it is wrong.

    Args:
        case: the log.
        topic: of the pose.
        times: of its messages [s].
        apart: 0 of its motion, 1 of its turning; and how far it does so over what the speeds say.
        said: the speeds.
        velocity: topic of the speeds, where it is another one.
    """
    axis, ratio = apart
    step_s = float(np.median(np.diff(times)))
    values = {
        "kind": "pose" if _is_pose_wrong(case, axis, ratio, said) else "speeds",
        "value": ratio,
        "what": ("moves", "turns")[axis],
        "source": topic,
        "step_s": step_s if _is_near(ratio, 1.0 / step_s) else None,
    }
    if velocity:
        values["velocity"] = velocity
    return Finding("odometry_contradicts_itself", "warning", "pose", values)


def _correct_units(case: Case, source: DriveSource, ratios: Sequence[float | None]) -> None:
    """Units of speeds that are sent with a pose which moves as they say, but for a unit."""
    each = (("unit", "speed", "m/s", SPEEDS), ("yaw_unit", "yaw rate", "rad/s", RATES))
    for (key, what, usual, factors), ratio in zip(each, ratios, strict=True):
        names = [name for name, one in factors.items() if ratio is not None and _is_near(ratio, one)]
        if usual not in names and len(names) == 1:
            values = {"what": what, "source": str(source), "unit": names[0], "is_sure": True}
            line = f'{key} = "{names[0]}"'
            case.correct("wheels", "unit of a drive", values, line, {key: names[0]}, usual="m/s")


def _list_changes(poses: pl.DataFrame) -> tuple[Floats, Floats, Floats]:
    """Times of messages [s], and how far the pose moves [m] and turns [rad] up to each, shape (n,) each."""
    times = poses["t"].to_numpy()
    quaternion = poses.select("q_x", "q_y", "q_z", "q_w").to_numpy()
    turned = rigid.wrap_angle(np.diff(rigid.euler_from_quaternions(quaternion)[2]))
    moved = np.hypot(*(np.diff(poses[axis].to_numpy()) for axis in "xy"))
    known = np.isfinite(moved) & np.isfinite(turned) & (np.diff(times) > 0.0)
    return times[1:][known], moved[known], np.abs(turned[known])


def _find_ratio(times: Floats, changed: Floats, speed: Held) -> float | None:
    """How far a pose changes over how far speeds say it does, if that is a constant; else None."""
    if not speed.moves or times[-1] <= times[0]:
        return None
    rate = changed / np.diff(times, prepend=times[0] - float(np.median(np.diff(times))))
    ratio = find_one_ratio(rate, np.abs(np.interp(times, speed.times, speed.values)), FEWEST_STEPS)
    return ratio or None


def _is_wrong(ratio: float, units: Sequence[float]) -> bool:
    """Whether no skidding and no unit makes a ratio of a pose and its speeds."""
    is_apart = abs(np.log(ratio)) > np.log(_APART)
    return bool(is_apart and not any(_is_near(ratio, one) for one in units))


def _is_near(ratio: float, other: float) -> bool:
    return abs(float(np.log(ratio / other))) < _ALIKE


def _is_pose_wrong(case: Case, axis: int, ratio: float, said: Held) -> bool:
    """Whether the pose is, and not the speeds of its messages."""
    source, asked = case.sources.command, Reading()
    if source is not None and source.form is DriveForm.BODY:
        asked = case.read(source, is_measured=False)
    command = (asked.first, asked.second)[axis]
    usual = float(np.abs(command.grid).mean()) if command.moves else 1.0
    of_usual = float(np.abs(said.grid).mean()) / usual
    return bool(abs(np.log(of_usual * ratio)) > abs(np.log(of_usual)))
