"""Frame of the poses, where they are on the body, and the signs of the other signals."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipeline.core import Floats
from pipeline.recording.case import Case, is_crossed
from pipeline.recording.evidence import Axis, Reversal, find_frame, find_reversed
from pipeline.recording.findings import Finding
from pipeline.recording.motion import CLEAR, LEAST_NATS, compare, fit, measure_motion, measure_share
from pipeline.recording.readings import DELAYS_S, Reading
from pipeline.sources import PoseContent

_HALF_TURN = 180.0
_CHANGES: Mapping[str, Mapping[str, object]] = {
    "wheels_both": {"sign": -1},
    "wheels_exchanged": {"exchanged": True},
    "wheels_exchanged_both": {"sign": -1, "exchanged": True},
}


def ask_frame(case: Case) -> Case:
    """The frame of the motion in which the readings explain it."""
    source, section = case.sources.pose, case.configuration.pose
    if source is None or source.content is not PoseContent.POSE:
        return case
    turned, margin, other_deg = find_frame(case.motion, [drive.reading for drive in case.drives])
    if other_deg is not None and section.heading_deg is None:
        values = {"kind": "heading", "value": other_deg, "source": str(source)}
        case.findings.append(Finding("pose_undecided", "warning", "pose", values))
    if not margin:
        return case
    if turned.flip:
        flipped = {"value": margin, "source": str(source)}
        case.findings.append(Finding("pose_flipped", "error", "pose", flipped))
    return case.fit(turned)


def ask_plane(case: Case) -> Case:
    """The plane of the motion: across another axis than z only where a signal clearly agrees, and better."""
    if not case.has_pose or case.motion.up == "z":
        return case
    level = case.fit(measure_motion(case.extraction.poses(), is_level=True))
    margin = _rate_followed(case)
    if margin > max(CLEAR, _rate_followed(level)) or not level.motion.is_known:
        return case
    if case.drives:
        about = {"kind": "axis", "axis": case.motion.up, "source": str(case.sources.pose)}
        case.findings.append(Finding("pose_undecided", "warning", "pose", about))
    return level


def _rate_followed(case: Case) -> float:
    """Vuong's statistic of the motion with the signal that it follows best; zero where none is clear."""
    made = [one.explained for one in (case.gyro, *(drive.reading for drive in case.drives))]
    return max((one.moves for one in made if one.is_sure), default=0.0)


def ask_signs(case: Case) -> Case:
    """Correct what goes the other way than all other signals, or tell it."""
    if not case.is_judged:
        report = _report_signs if case.has_pose else _report_opposite
        report(case)
    if not case.wheels.is_there or not case.changes.get("wheels", {}).keys() & {"sign", "exchanged"}:
        return case
    return case.read_again("ackermann" if case.kind == "ackermann" else "differential")


def _report_opposite(case: Case) -> None:
    """Signs of the command against those of the wheels: no third signal tells which of them is wrong."""
    command, wheels = case.command, case.wheels
    explained = command.reading.explained
    if not command.is_sure:
        return
    verbs = list[str]()
    if is_crossed(command):
        change = 'reversed = "left" or "right"'
        margin: float | None = explained.sign_margin
    else:
        verbs = [
            verb
            for verb, sign in (("drive", command.sign("ahead")), ("turn", command.sign("turned")))
            if sign < 0
        ]
        if not verbs:
            return
        changes = {"drive": "sign = -1 and exchanged = true", "turn": "exchanged = true"}
        change = changes[verbs[0]] if len(verbs) == 1 else "sign = -1"
        if wheels.reading.form != "sides":
            change = "sign = -1"
        margin = explained.moves
    values = {
        "kind": "command and wheels",
        "verbs": verbs,
        "source": str(command.source),
        "change": change,
        "value": margin,
    }
    case.findings.append(Finding("signs_contradict", "error", "command, wheels", values))


def _report_signs(case: Case) -> None:
    """Correct what goes the other way than all other signals and the pose, or tell it."""
    command, wheels, motion = case.command, case.wheels, case.motion
    axes: tuple[Axis, ...] = ("ahead", "turned", "aside")
    signs = {("command", axis): command.sign(axis) for axis in axes}
    signs |= {("wheels", axis): wheels.sign_as_motion(axis) for axis in axes}
    signs["gyro", "turned"] = case.gyro.explained.sign("turned")
    up, offset = motion.up, motion.offset_deg
    if up != "z" and -1 in {sign for (_, axis), sign in signs.items() if axis == "turned"}:
        # Neither way along another axis is usual.
        up, offset = f"-{up}", -offset
        signs = {key: sign if key[1] == "ahead" else -sign for key, sign in signs.items()}
    if offset and -1 in {sign for (_, axis), sign in signs.items() if axis == "ahead"}:
        offset += 180.0
        signs = {key: sign if key[1] == "turned" else -sign for key, sign in signs.items()}
    made = find_reversed(signs)
    if made.rivals:
        _report_either(case, made, signs)
    else:
        for fault in made.faults:
            if fault == "pose_backward":
                offset += 180.0
            elif fault == "pose_mirrored":
                up, offset = up.removeprefix("-") if up.startswith("-") else f"-{up}", -offset
            else:
                _report_fault(case, fault)
    _report_frame(case, up, _wrap(offset), signs)


def rate_map_axes(reading: Reading) -> float:
    """Vuong's statistic of commands along the axes of a map against those along the body's; zero of none."""
    made = reading.explained
    if made.across is None:
        return 0.0
    along = replace(made.motion, middle=np.zeros(made.motion.middle.size), flip=False, offset_deg=0.0)
    other = reading.fit_to(along, DELAYS_S, crossed=made.crossed)
    if other.across is None:
        return 0.0
    one, own = other.across[0].blocks, made.across[0].blocks
    return compare(one, own) if float((one - own).sum()) > LEAST_NATS * along.moved.size else 0.0


def ask_axes(case: Case) -> Case:
    """Tell commands along the axes of a map, which a base that moves sideways turns by its heading."""
    command = case.command
    margin = rate_map_axes(command.reading)
    if margin < CLEAR:
        return case
    values = {"value": margin, "source": str(command.source)}
    case.findings.append(Finding("command_of_map", "error", "command", values))
    return case


def ask_yaw_rate(case: Case) -> Case:
    """Tell speeds that come without a yaw rate, as of wheels on a bus: they say nothing of the heading."""
    for drive in (case.command, case.wheels):
        made = drive.reading.explained
        if not made.is_known or drive.reading.form != "body":
            continue
        # A vehicle that is driven straight on, and drifts, does not turn round.
        if drive.reading.second.moves or np.ptp(np.cumsum(made.motion.yaw)) < np.pi:
            continue
        topic = drive.source.signals[0].topic
        case.findings.append(Finding("no_yaw_rate", "warning", topic, {"source": str(drive.source)}))
    return case


def _report_frame(case: Case, up: str, offset: float, signs: dict[tuple[str, Axis], int]) -> None:
    source = case.sources.pose
    who, drivers = _list_witnesses(signs, "turned"), _list_witnesses(signs, "ahead")
    if up != "z":
        values = {"source": str(source), "up": up, "witnesses": who}
        case.correct("pose", "axis up", values, f'up = "{up}"', {"up": up})
    if offset:
        fault = "looks to the rear" if abs(offset) == _HALF_TURN else "heading off"
        off = {"source": str(source), "offset_deg": offset, "witnesses": drivers}
        heading = float(f"{_wrap(offset + (case.configuration.pose.heading_deg or 0.0)):g}")
        case.correct("pose", fault, off, f"heading_deg = {heading:g}", {"heading_deg": heading})


def _wrap(degrees: float) -> float:
    """An angle above -180 degrees, and up to 180."""
    return _HALF_TURN - (_HALF_TURN - degrees) % 360.0


def _report_fault(case: Case, fault: str, others: Sequence[str] = ()) -> None:
    """Correct or report a fault; the sign of a gyro is fitted by `stages.align`."""
    wheels = case.wheels
    drive = wheels if fault.startswith("wheels") else case.command
    if fault == "gyro" or not drive.is_there:
        return
    change: dict[str, object] = dict(_CHANGES.get(fault, {}))
    is_car = drive.reading.form == "steering"
    if change and (drive.reading.form == "sides" or (is_car and fault == "wheels_both")):
        line = ", ".join(f"{key} = {str(value).lower()}" for key, value in change.items())
        kind = "speed backward" if is_car else fault
        case.correct("wheels", kind, {"source": str(drive.source)}, line, change)
        return
    role = "wheels" if drive is wheels else "command"
    values = {"source": str(drive.source), "faults": [fault, *others]}
    name = "wheels_reversed" if drive is wheels else "command_reversed"
    case.findings.append(Finding(name, "error", role, values))


def _report_either(case: Case, made: Reversal, signs: dict[tuple[str, Axis], int]) -> None:
    """Two signals that contradict each other, with what mends the one and the other."""
    ways = (made.faults, *made.rivals)
    if all(len(names) == 1 and names[0].startswith("command") for names in ways):
        _report_fault(case, made.faults[0], [names[0] for names in made.rivals])
        return
    against = sorted({name for (name, _), sign in signs.items() if sign < 0})
    axes = sorted({axis for (_, axis), sign in signs.items() if sign < 0})
    values = {
        "kind": "signal and poses",
        "against": against,
        "axes": axes,
        "ways": [list(names) for names in ways],
    }
    case.findings.append(Finding("signs_contradict", "error", f"{against[0]}, pose", values))


def _list_witnesses(signs: Mapping[tuple[str, Axis], int], axis: Axis) -> list[str]:
    """The signals that show in which way a body turns, or drives."""
    there = {name for (name, of), sign in signs.items() if sign and of == axis}
    return [name for name in ("command", "wheels", "gyro") if name in there]


# Where the poses are on the body: the angle to its course, and the point about which it turns.
#
# A body on wheels moves along its own axis, but for a slide outward in turns. What is left aside goes with
# the motion ahead where the frame of the poses is turned, and with the turning where they are of another
# point.

_LEAST_RAD = 0.01
"""Least angle [rad] that is told: half a degree, as a sensor is mounted by hand."""
_LEAST_M = 0.02
"""Least distance [m] that is told, as a sensor's place is measured by hand."""
_TOGETHER = 0.98
"""Share of a cause that others make up, from which on nothing tells them apart, as at one speed."""


def ask_mounting(case: Case) -> Case:
    """Tell the angle and the place of poses that are not those of the body; either may be the ground's."""
    known = [one.reading for one in (case.wheels, case.command) if one.is_sure]
    pose = case.sources.pose
    is_plain = pose is not None and pose.content is PoseContent.POSE and "pose" not in case.changes
    if not known or not is_plain or case.moves_sideways:
        return case
    motion = known[0].explained.motion
    if motion.flip or motion.offset_deg:
        return case
    ahead, elapsed = motion.body.real, motion.steps.end - motion.steps.start
    columns = np.column_stack([ahead, motion.yaw, ahead / elapsed * motion.yaw])
    made = fit(motion.body.imag, columns, motion.steps)
    (angle, lever, _), (of_angle, of_lever, _) = made.gains.tolist(), made.t.tolist()
    if abs(of_angle) > CLEAR and abs(angle) > _LEAST_RAD and _is_apart(columns, 0):
        degrees, given = float(np.degrees(angle)), case.configuration.pose.heading_deg or 0.0
        turned = {
            "value": angle,
            "half_deg": 1.96 * abs(degrees / of_angle),
            "heading_deg": given + degrees,
            "pose": str(pose),
        }
        case.findings.append(Finding("pose_angle", "info", "pose", turned))
    is_clear = abs(of_lever) > CLEAR and abs(lever) > _LEAST_M and _is_apart(columns, 1)
    if is_clear and known[0].form != "steering":
        apart = {"value": lever, "half_m": 1.96 * abs(lever / of_lever), "pose": str(pose)}
        case.findings.append(Finding("pose_lever", "info", "pose", apart))
    return case


def _is_apart(columns: Floats, index: int) -> bool:
    """Whether one of several columns, shape (n, k), is more than a sum of the others."""
    column, others = columns[:, index], np.delete(columns, index, axis=1)
    gains = np.linalg.lstsq(others, column, rcond=None)[0]
    return measure_share(column, others @ gains) < _TOGETHER
