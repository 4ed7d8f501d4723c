"""Encoders of the wheels: dead, backward, dying, or on another scale, each read anew as corrected."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from pipeline.core import Floats, format_line
from pipeline.recording.case import Case, is_crossed
from pipeline.recording.drive import choose_sides
from pipeline.recording.findings import Finding
from pipeline.recording.motion import CLEAR, FEWEST_STEPS, Motion, compare, fit, measure_share
from pipeline.recording.outages import turns_about
from pipeline.recording.readings import SIDES, Held
from pipeline.recording.topic_values import FEWEST_MESSAGES
from pipeline.sources import DriveForm, DriveSection

_FOLLOWS = 0.5
"""Least share of a wheel's turning that the motion explains: outliers of a localization are no more."""
SAME_SCALE = 1.25
"""Ratio of two wheels' scales up to which tyres, loads and the ground may make it."""
_AGREE = 1.5
"""Ratio within which driving and turning show the same scale: on grass the sides of a Warthog turn it by 1.26
of each other."""
_EDGES = (2.0, 4.0)
"""Counts of a pulse by decoders that look at two or four of its edges, over those of one."""
_IDLE = 0.1
"""Turning over that of the others below which a wheel's encoder is not turned by the drive."""


@dataclass(frozen=True)
class Turning:
    """How a wheel turns with the motion.

    Attributes:
        gains: per metre ahead and per radian of the heading, shape (2,) [rad/m, 1].
        t: their ratios to standard errors.
        follows: whether the motion explains it.
        path: how far it turns over how far the motion says.
    """

    gains: Floats
    t: Floats
    follows: bool
    path: float = 1.0


def _is_alike(one: float, other: float) -> bool:
    """Whether the motion explains as much of the path of two wheels.

    Noise of the poses attenuates how much a wheel turns with the motion, in one more than in another.
    """
    return bool(abs(np.log(one / other)) < np.log(_AGREE))


def measure_wheel(wheel: Held, motion: Motion, late: tuple[float, float], beside: Sequence[Held]) -> Turning:
    """How a wheel turns with the motion.

    Args:
        wheel: its speed.
        motion: of the body.
        late: lag and delay of the motion after the wheels [s].
        beside: signals that are recorded throughout the steps that count, too.
    """
    nothing = Turning(np.zeros(2), np.zeros(2), follows=False)
    if wheel.is_constant:
        return nothing
    keep = np.logical_and.reduce([one.is_there(motion.steps) for one in (wheel, *beside)])
    if keep.sum() < FEWEST_STEPS:
        return nothing
    part = motion.take(keep)
    turned = wheel.integrate(part.steps, *late)
    columns = np.column_stack([part.body.real, part.yaw, part.body.imag])
    made = fit(turned, columns, part.steps)
    share = measure_share(turned, columns @ made.gains)
    path = float(np.abs(turned).sum() / max(np.abs(columns @ made.gains).sum(), 1e-9))
    return Turning(made.gains[:2], made.t[:2], share > _FOLLOWS and abs(made.t[0]) > CLEAR, path)


def find_odd_joints(
    joints: Mapping[str, Turning], sides: Mapping[str, str]
) -> tuple[dict[str, float], list[str]]:
    """Wheels that contradict all the others.

    Args:
        joints: by name.
        sides: side of each of them.

    Returns:
        Factors by name of those that count backward or on another scale, and names of those that are not
        turned by the drive, though others of their side are.
    """
    fine = [one for one in joints.values() if one.follows]
    # Two wheels that differ do not tell which one is right.
    if len(fine) < 3:  # noqa: PLR2004
        return {}, []
    usual, path = (
        float(np.median(some)) for some in ([one.gains[0] for one in fine], [one.path for one in fine])
    )
    factors, idle = {}, []
    for name, one in joints.items():
        ratio = float(one.gains[0]) / usual if usual else 0.0
        others = [other for key, other in joints.items() if key != name and sides[key] == sides[name]]
        is_scaled = ratio != 0.0 and abs(np.log(abs(ratio))) > np.log(SAME_SCALE)
        is_scaled = is_scaled and _is_alike(one.path, path)
        if one.follows and (ratio < 0.0 or is_scaled):
            size = snap(abs(ratio)) if is_scaled else 1.0
            factors[name] = float(np.sign(ratio)) / size
        elif not one.follows and abs(ratio) < _IDLE and any(other.follows for other in others):
            idle.append(name)
    # More than half of them that differ are a vehicle of another kind.
    return (factors, idle) if 2 * len(factors) < len(joints) else ({}, idle)


def compare_sides(left: Turning, right: Turning) -> float | None:
    """Scale of the left side's encoder over the right one's; None if it is the same, or not clear."""
    if not (left.follows and right.follows):
        return None
    of_speed, of_turn = (float(one / other) for one, other in zip(left.gains, right.gains, strict=True))
    # Laps of one radius do not tell what drives from what turns.
    error = np.hypot(1.0 / left.t[0], 1.0 / right.t[0])
    if of_speed <= 0.0 or abs(np.log(of_speed)) < np.log(SAME_SCALE) + CLEAR * error:
        return None
    if not _is_alike(left.path, right.path):
        return None
    turns = min(abs(left.t[1]), abs(right.t[1])) > CLEAR
    # A body that turns by something else than its wheels shows two scales.
    if turns and (of_turn >= 0.0 or abs(np.log(-of_turn / of_speed)) > np.log(_AGREE)):
        return None
    return snap(of_speed)


def snap(scale: float) -> float:
    """A scale above zero, or the ratio of decoders that it is near to: what remains may be the ground's."""
    ratios = [ratio for edge in _EDGES for ratio in (edge, 1.0 / edge)]
    return next((ratio for ratio in ratios if abs(np.log(scale / ratio)) < 0.5 * np.log(SAME_SCALE)), scale)


_STEERS = 0.2
"""Share of a body's turning that its wheels explain at most where it turns by something else."""


def _explains_more(case: Case, factors: Mapping[str, float]) -> bool:
    """Whether wheels with these factors explain the motion clearly better than without.

    Circles of one radius are explained by any scale of a side: slip of a side is no scale of its encoder. A
    body that does not turn by its wheels, as a car, tells by its way alone.
    """
    section = msgspec.structs.replace(case.complete().wheels, factors=dict(factors))
    made = case.wheels.reading.explained
    again = case.read(case.wheels.source, is_measured=True, section=section).explain(case.motion)
    if again.blocks.size != made.blocks.size:
        return False
    steers = max(again.shares[1], made.shares[1]) < _STEERS
    return steers or compare(again.blocks, made.blocks) > CLEAR


def ask_joints(case: Case) -> Case:
    """Correct single wheels that contradict all others of a topic of joints."""
    section, wheels, motion = case.complete().wheels, case.wheels, case.motion
    reading = wheels.reading
    is_free = section.factors is None and section.left is None and section.right is None
    # Of wheels that stand in for a pose each is a part of the motion.
    is_free = is_free and case.has_pose
    if wheels.source.form is not DriveForm.JOINTS or reading.form != "sides" or not is_free:
        return case
    times, rates = case.extraction.read_rates(wheels.source)
    chosen = choose_sides(sorted(rates), section)
    sides = {joint: side for side, joints in chosen.items() for joint in joints}
    late = (reading.explained.lag, reading.explained.delay)
    turning = {
        joint: measure_wheel(Held(times, rates[joint]), motion, late, reading.inputs)
        for joint in sorted(sides)
    }
    factors, idle = find_odd_joints(turning, sides)
    factors = {joint: float(f"{factor:.4g}") for joint, factor in factors.items()}
    factors = factors if _explains_more(case, factors) else {}
    for joint, factor in factors.items():
        values = {"joint": joint, "source": str(wheels.source), "factor": factor}
        line = ", ".join(f'"{name}" = {value:g}' for name, value in factors.items())
        case.correct("wheels", "joint", values, f"factors = {{{line}}}", {"factors": factors})
    for side, joints in chosen.items():
        left = [joint for joint in joints if joint not in idle]
        if left == joints or case.moves_sideways:
            continue
        lost = [joint for joint in joints if joint in idle]
        named = ", ".join(f'"{joint}"' for joint in left)
        line = f"{side} = [{named}]"
        about = {"joints": lost, "source": str(wheels.source)}
        case.correct("wheels", "idle joints", about, line, {side: left})
    return case.read_again() if factors or idle else case


def ask_scales(case: Case) -> Case:
    """Correct a side whose encoder counts on another scale than the other."""
    reading, made = case.wheels.reading, case.wheels.reading.explained
    given = case.configuration.wheels.factors or {}
    if reading.form != "sides" or not made.is_known or "factors" in case.changes.get("wheels", {}):
        return case
    sides = (reading.first, reading.second)
    left, right = (measure_wheel(one, case.motion, (made.lag, made.delay), sides) for one in sides)
    scale = compare_sides(left, right)
    if scale is None:
        return case
    counts = {"left": abs(float(left.gains[0])), "right": abs(float(right.gains[0]))}
    side, other = ("left", "right") if scale > 1.0 else ("right", "left")
    if case.is_known:
        # What does not explain all of a wheel's turning makes both seem low.
        high, low = (abs(np.log(counts[one] * case.vehicle.wheel_radius_m)) for one in (side, other))
        side, other = (other, side) if low - high > 0.5 * abs(np.log(scale)) else (side, other)
    factor = float(f"{1.0 / snap(counts[side] / counts[other]):.4g}")
    factors = {**given, side: factor * given.get(side, 1.0)}
    if not _explains_more(case, factors):
        return case
    values = {"side": side, "other": other, "factor": factor}
    line = format_line("factors", factors)
    is_corrected = case.correct("wheels", "side scale", values, line, {"factors": factors})
    return case.read_again() if is_corrected else case


def read_as_wheels(case: Case) -> Case:
    """Wheels that were read as a candidate for the command, by what the user says of wheels."""
    is_said = case.wheels.is_there and case.configuration.wheels != DriveSection()
    return case.read_again() if is_said and not case.wheels.is_measured else case


def ask_sides(case: Case) -> Case:
    """A side that is dead or counts backward."""
    is_judged = _report_sides(case)
    if "reversed" in case.changes.get("wheels", {}):
        # What is wrong beside a side that is corrected shows now.
        again = case.read_again()
        return replace(again, is_judged=again is case)
    return replace(case, is_judged=is_judged)


def _report_sides(case: Case) -> bool:
    """Whether a side is dead or counts backward, which is told or corrected."""
    command, wheels = case.command, case.wheels
    if wheels.reading.form == "sides" and _report_dead(case):
        return True
    of_wheels = wheels.is_sure and is_crossed(wheels)
    of_command = case.has_pose and command.is_sure and is_crossed(command)
    if of_wheels and not of_command:
        # Of a heading that was turned the command tells which way is ahead.
        is_behind = bool(case.motion.offset_deg) and command.sign("ahead") < 0
        is_right = (wheels.reading.explained.ahead.gains[0] > 0.0) != is_behind
        side = "right" if is_right else "left"
        margin = wheels.reading.explained.sign_margin
        case.correct(
            "wheels",
            "side backward",
            {"side": side},
            f'reversed = "{side}"',
            {"reversed": side},
            margin,
        )
        return True
    if of_command:
        explained = command.reading.explained
        # A body command reaches the right side as speed plus turn.
        is_right = (
            (explained.ahead.gains[0] < 0.0)
            if command.reading.form == "body"
            else explained.ahead.gains[0] > 0
        )
        side = "right" if is_right else "left"
        also = "encoder too" if of_wheels else "encoder right" if wheels.is_there else "no encoder"
        values = {"value": explained.sign_margin, "side": side, "kind": also}
        case.findings.append(Finding("motor_reversed", "error", "command", values))
        return True
    return False


def _report_dead(case: Case) -> bool:
    """Whether the encoder of a side is dead or silent, which is told."""
    counts = _count_messages(case)
    # Of a topic with hardly any messages nothing is known between them, whatever they say.
    silent = [side for side, count in counts.items() if count < FEWEST_MESSAGES]
    dead = silent[0] if len(silent) == 1 else case.wheels.reading.dead_side
    if not dead or (not silent and case.has_pose and turns_about(dead, case.motion, case.track_m)):
        return False
    other = next(side for side in SIDES if side != dead)
    values = {"side": dead, "other": other, "has_pose": case.has_pose}
    if silent:
        values |= {"messages": counts[dead], "of_other": counts[other]}
    case.findings.append(Finding("wheel_dead", "error", f"wheels {dead}", values))
    return True


def _count_messages(case: Case) -> dict[str, int]:
    """Messages of each side that has a topic of its own; empty where both have the same."""
    source = case.wheels.source
    topics = [signal.topic for signal in source.signals]
    if len(set(topics)) != len(SIDES):
        return {}
    columns = case.extraction.columns
    return {side: columns[topic].log_time.size for side, topic in zip(SIDES, topics, strict=True)}
