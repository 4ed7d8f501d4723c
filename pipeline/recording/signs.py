"""Frame of the poses, where they are on the body, and the signs of the other signals."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipeline.core import enumerate_texts, format_length
from pipeline.recording.case import Case, is_crossed
from pipeline.recording.evidence import Axis, Reversal, find_frame, find_reversed
from pipeline.recording.findings import Finding
from pipeline.recording.motion import CLEAR, LEAST_NATS, compare, fit
from pipeline.recording.readings import DELAYS_S, Reading
from pipeline.sources import PoseContent

_HALF_TURN = 180.0
_AGREE = {"command": "commands", "wheels": "wheels", "gyro": "the gyro"}
_AGAINST = {"command": "the commands", "wheels": "the measured wheels", "gyro": "the gyro"}
_FAULTS = {
    "pose_backward": "the frame of the poses points to the rear, as that of a sensor that is mounted "
    "backward",
    "pose_mirrored": "the poses' frame is of the other hand, as north, east, down",
    "command_ahead": "the sign of linear.x is wrong where it is sent, or both motors are reversed",
    "command_turned": "the sign of angular.z or of the steering is inverted, or left and right are exchanged",
    "command_aside": "the sign of linear.y is wrong where it is sent",
    "command_mirrored": "left and right are exchanged where it is sent",
    "command_both": "its sign is wrong where it is sent, or both motors are wired backward",
    "wheels_both": "both encoders count backward",
    "wheels_exchanged": "left and right encoders are exchanged",
    "wheels_exchanged_both": "both encoders count backward, and are exchanged",
    "gyro": "the gyro is mounted upside down",
}
_CHANGES: Mapping[str, Mapping[str, object]] = {
    "wheels_both": {"sign": -1},
    "wheels_exchanged": {"exchanged": True},
    "wheels_exchanged_both": {"sign": -1, "exchanged": True},
}
_REMEDIES = {
    "pose_backward": " (heading_deg = 180 under [pose] in run.toml)",
    "pose_mirrored": ' (up = "-z" under [pose] in run.toml)',
    "wheels_both": " (sign = -1 under [wheels] in run.toml)",
    "wheels_exchanged": " (exchanged = true under [wheels] in run.toml)",
    "wheels_exchanged_both": " (sign = -1 and exchanged = true under [wheels] in run.toml)",
}


def ask_frame(case: Case) -> Case:
    """The frame of the motion in which the readings explain it."""
    source, section = case.sources.pose, case.configuration.pose
    if source is None or source.content is not PoseContent.POSE:
        return case
    turned, margin, other_deg = find_frame(case.motion, [drive.reading for drive in case.drives])
    if other_deg is not None and section.heading_deg is None:
        text = (
            f"the body does not follow what drives it along the headings of {source}, and a little across "
            "them: their frame may be turned by 90 degrees, which too little tells; it is taken as recorded "
            f"(heading_deg = {other_deg:.0f} under [pose] in run.toml turns it, heading_deg = 0 settles it)"
        )
        case.findings.append(Finding("pose_undecided", "warning", text, where="pose", value=other_deg))
    if not margin:
        return case
    if section.heading_deg is not None:
        text = (
            f"by the motion the heading of {source} is {turned.offset_deg:.0f} degrees off (or as much "
            "less half a turn), but [pose] in run.toml gives heading_deg, which is taken as it is given"
        )
        case.findings.append(Finding("pose_contradicted", "warning", text, where="pose", value=margin))
        return case
    if turned.flip:
        text = (
            f"the headings of {source} turn against its own path: its frame is of the other hand; "
            "correct what publishes it"
        )
        case.findings.append(Finding("pose_flipped", "error", text, where="pose", value=margin))
    return case.fit(turned)


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
    if is_crossed(command):
        what = "one side of the wheels runs backward against its command"
        mend = 'reversed = "left" or "right" under [wheels] in run.toml'
        margin: float | None = explained.sign_margin
    else:
        against = [
            verb
            for verb, sign in (("drive", command.sign("ahead")), ("turn", command.sign("turned")))
            if sign < 0
        ]
        if not against:
            return
        what = f"the wheels {enumerate_texts(against)} the other way than {command.source} commands"
        changes = {"drive": "sign = -1 and exchanged = true", "turn": "exchanged = true"}
        change = changes[against[0]] if len(against) == 1 else "sign = -1"
        if wheels.reading.form != "sides":
            change = "sign = -1"
        mend, margin = f"{change} under [wheels] in run.toml", explained.moves
    text = (
        f"{what}, and no third signal shows which of them is wrong: either the encoders ({mend}), or the "
        "command or the polarity of the motors, which are to be corrected on the robot"
    )
    case.findings.append(Finding("signs_contradict", "error", text, where="command, wheels", value=margin))


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
    _report_frame(case, up, 180.0 - (180.0 - offset) % 360.0, signs)


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
    text = (
        f"the commands of {command.source} are along the axes of a map, and the base turns them by its "
        "heading (field-centric driving): record them as they are along the body's own axes"
    )
    case.findings.append(Finding("command_of_map", "error", text, where="command", value=margin))
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
        text = (
            f"{drive.source} says a speed, and a yaw rate of zero throughout, though the vehicle turns: its "
            "errors of heading, and what they make of positions, say nothing (yaw_rate_topic and speed_topic "
            "in run.toml name two topics, as of a gyro)"
        )
        case.findings.append(Finding("no_yaw_rate", "warning", text, where=drive.source.signals[0].topic))
    return case


def _report_frame(case: Case, up: str, offset: float, signs: dict[tuple[str, Axis], int]) -> None:
    source = case.sources.pose
    who, drivers = _name_witnesses(signs, "turned"), _name_witnesses(signs, "ahead")
    if up != "z":
        direction, axis = ("down" if up.startswith("-") else "up"), up.removeprefix("-")
        what = f"the {axis} axis of the poses of {source} points {direction}"
        if axis == "z":
            what += " (north, east, down)"
        else:
            what += ", as of motion capture or of a camera's optical frame: the body turns about it"
        case.correct("pose", f"{what}, as {who} show", f'up = "{up}"', {"up": up})
    if offset:
        side = "right" if offset > 0.0 else "left"
        off = f"{abs(offset):.0f} degrees to the {side}"
        what = f"the heading of {source} is {off} of the course of {drivers}"
        if abs(offset) == _HALF_TURN:
            what = (
                f"the poses of {source} look to the rear where {drivers} drive ahead (a sensor that is "
                "mounted backward, or base_link points to the rear)"
            )
        case.correct("pose", what, f"heading_deg = {offset:g}", {"heading_deg": float(f"{offset:g}")})


def _report_fault(case: Case, fault: str, others: Sequence[str] = ()) -> None:
    """Correct or report a fault; the sign of a gyro is fitted by `stages.align`."""
    wheels = case.wheels
    drive = wheels if fault.startswith("wheels") else case.command
    if fault == "gyro" or not drive.is_there:
        return
    change: dict[str, object] = dict(_CHANGES.get(fault, {}))
    is_car = drive.reading.form == "steering"
    if change and (drive.reading.form == "sides" or (is_car and fault == "wheels_both")):
        what = f"the speed of {drive.source} counts backward" if is_car else _FAULTS[fault]
        line = ", ".join(f"{key} = {str(value).lower()}" for key, value in change.items())
        case.correct("wheels", what, line, change)
        return
    role = "wheels" if drive is wheels else "command"
    faults = "; or ".join(_FAULTS[one] for one in (fault, *others))
    text = f"{drive.source} contradicts all other signals: {faults}"
    case.findings.append(Finding(f"{role}_reversed", "error", text, where=role))


def _report_either(case: Case, made: Reversal, signs: dict[tuple[str, Axis], int]) -> None:
    """Two signals that contradict each other, with what mends the one and the other."""
    ways = (made.faults, *made.rivals)
    if all(len(names) == 1 and names[0].startswith("command") for names in ways):
        _report_fault(case, made.faults[0], [names[0] for names in made.rivals])
        return
    against = sorted({name for (name, _), sign in signs.items() if sign < 0})
    verbs = {"ahead": "drive", "turned": "turn", "aside": "move sideways"}
    axes = sorted({axis for (_, axis), sign in signs.items() if sign < 0})
    remedies = {fault: f"{text}{_REMEDIES.get(fault, '')}" for fault, text in _FAULTS.items()}
    options = "; or ".join(
        " and ".join(remedies[name] for name in names) for names in (made.faults, *made.rivals)
    )
    text = (
        f"{' and '.join(_AGAINST[name] for name in against)} and the poses "
        f"{' and '.join(verbs[axis] for axis in axes)} opposite ways, and no third signal tells which of "
        f"them is wrong: either {options}"
    )
    case.findings.append(Finding("signs_contradict", "error", text, where=f"{against[0]}, pose"))


def _name_witnesses(signs: Mapping[tuple[str, Axis], int], axis: Axis) -> str:
    """The signals that show in which way a body turns, or drives."""
    there = {name for (name, of), sign in signs.items() if sign and of == axis}
    return enumerate_texts([word for name, word in _AGREE.items() if name in there]) or "the other signals"


# Where the poses are on the body: the angle to its course, and the point about which it turns.
#
# A body on wheels moves along its own axis, but for a slide outward in turns. What is left aside goes with
# the motion ahead where the frame of the poses is turned, and with the turning where they are of another
# point.

_LEAST_RAD = 0.01
"""Least angle [rad] that is told: half a degree, as a sensor is mounted by hand."""
_LEAST_M = 0.02
"""Least distance [m] that is told, as a sensor's place is measured by hand."""


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
    if abs(of_angle) > CLEAR and abs(angle) > _LEAST_RAD:
        degrees, given = np.degrees(angle), case.configuration.pose.heading_deg or 0.0
        text = (
            f"the body moves {abs(degrees):.1f} degrees (±{1.96 * abs(degrees / of_angle):.2g}) to the "
            f"{'left' if angle > 0.0 else 'right'} of the headings of {pose}: their frame is turned, or the "
            "body crabs, as on a bent axle or along a slope; no other signal tells which (heading_deg = "
            f"{given + degrees:.1f} under [pose] in run.toml turns it)"
        )
        case.findings.append(Finding("pose_angle", "info", text, where="pose", value=angle))
    if abs(of_lever) > CLEAR and abs(lever) > _LEAST_M and known[0].form != "steering":
        text = (
            f"the body turns about a point {format_length(abs(lever))} "
            f"(±{format_length(1.96 * abs(lever / of_lever))}) "
            f"{'behind' if lever > 0.0 else 'ahead of'} that of the poses of {pose}: they are of a sensor "
            "that is mounted there, or the wheels do not grip alike front and rear"
        )
        case.findings.append(Finding("pose_lever", "info", text, where="pose", value=lever))
    return case
