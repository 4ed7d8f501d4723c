"""Lengths of a vehicle by a tape and counted turns, for a log that has no other reference."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import starmap

import numpy as np

from pipeline.core import Floats, SlipError, arrays, format_line, format_section
from pipeline.logs import LogIndex, read_topics
from pipeline.recording.case import Case
from pipeline.recording.evidence import RIMS
from pipeline.recording.extract import Extraction, Given
from pipeline.recording.findings import Finding
from pipeline.recording.log_choice import Choice, make_stand_in
from pipeline.recording.log_columns import LogColumns
from pipeline.recording.readings import NO_SIGNAL, Held, Reading
from pipeline.recording.topic_values import list_wanted
from pipeline.sources import RADII_M, RANGES, UNKNOWN_VEHICLE, Configuration, TruthSection, choose_sources

_TAPE_M, _TAPE = 5e-3, 5e-3
"""Error of a distance by a tape: 5 mm, or half a percent of it if that is more."""
_FAR = 2.0
"""Ratio to the vehicle's own length beyond which the tape measured something else: no wheel wears so far."""
_STRAIGHT = 0.8
"""Way from start to end over the way in all, below which more than a tenth of a drive is driven back."""
_TURNS = 0.1
"""Error of counted turns: a tenth of one, as a mark on the ground shows."""
_LEAST_SWING = 0.02
"""Way back over the range of a heading or a distance, below which it is noise, and no leg."""


def measure_by_tape(
    index: LogIndex, configuration: Configuration, choice: Choice | None = None
) -> list[Finding]:
    """Wheel radius and track by what the wheels turned, or the commands said, over what a tape and turns say.

    Args:
        index: of the log.
        configuration: with the section ``[truth]``.
        choice: topics of the log and what its motion corrects; None takes topics by their names.

    Returns:
        One finding: the lengths, or why there are none, or that they contradict the vehicle or the other
        signals; none where nothing was measured by hand, or nothing turned.
    """
    truth = configuration.truth
    if truth == TruthSection():
        return []
    reading, gyro, is_rim = _read(index, configuration, choice)
    (net, path), turning = _add_up(reading.first, reading.second, reading.form)
    # Speeds of a body or of rims have a gain in place of a radius.
    is_gain = is_rim or reading.form == "body"
    known = 1.0 if is_gain else _find_radius(configuration, choice)
    is_straight = net > _STRAIGHT * path
    moved = net if is_straight else path
    taped = truth.distance_m / moved if truth.distance_m and moved > 0.0 else None
    source = reading.name
    # Of a drive that turns back a tape may have measured half.
    contradiction = _contradict(source, taped, known, choice, most=_FAR if is_straight else 2.0 * _FAR)
    if contradiction:
        return contradiction
    if taped and not is_straight:
        turned_back = {"kind": "both ways", "source": source, "share": 0.5 * (1.0 - net / path)}
        return [Finding("no_length_by_tape", "warning", "vehicle", turned_back)]
    share = _share(truth.distance_m) if truth.distance_m and taped else 0.0
    values = {"ahead" if is_gain else "wheel_radius_m": _bound(taped, share)} if taped else {}
    turns, turns_share = _count_turns(truth, gyro)
    if turns and turning > 0.0:
        angle, radius = 2.0 * np.pi * turns, taped or known
        if reading.form == "body":
            values["turning"] = _bound(angle / turning, turns_share)
        elif radius is not None:
            values["track_width_m"] = _bound(
                radius * turning / angle, turns_share + (share if taped else 0.0)
            )
        elif truth.turns:
            return [Finding("no_length_by_tape", "warning", "vehicle", {"kind": "no radius"})]
    return _show_lengths(reading, values)


def _count_turns(truth: TruthSection, gyro: Held) -> tuple[float, float]:
    """Turns as the user or else a gyro counts them, and their relative error; zero where neither does."""
    if truth.turns is not None:
        return truth.turns, _TURNS / truth.turns
    # A gyro counts turns as well as the eye.
    return (_add_legs(_accumulate(gyro)[1]) / (2.0 * np.pi), 0.01) if gyro.moves else (0.0, 0.0)


def _find_radius(configuration: Configuration, choice: Choice | None) -> float | None:
    """Wheel radius [m] that the user, the log or its motion tells; None without one."""
    if choice is None or choice.vehicle.id == UNKNOWN_VEHICLE:
        return configuration.vehicle.wheel_radius_m
    seen = None if choice.recording is None else choice.recording.geometry
    is_taken = choice.vehicle_source == "fitted" and seen is not None and seen.is_taken
    is_open = is_taken or "wheel_radius_m" in choice.vehicle.stand_ins
    return configuration.vehicle.wheel_radius_m if is_open else choice.vehicle.wheel_radius_m


def _show_lengths(reading: Reading, values: Mapping[str, Sequence[float]]) -> list[Finding]:
    """Lengths and gains with their line of run.toml, or that one is of no vehicle; nothing without any."""
    for key, (least, most) in {"wheel_radius_m": RADII_M, "track_width_m": RANGES["track_width_m"]}.items():
        if key in values and not least <= values[key][0] <= most:
            doubt: dict[str, object] = {"kind": "no vehicle", "source": reading.name, "key": key}
            doubt |= {"value": values[key][0], "least": least, "most": most}
            return [Finding("no_length_by_tape", "warning", "vehicle", doubt)]
    lengths = {key: float(f"{one[0]:.4g}") for key, one in values.items() if key.endswith("_m")}
    line = format_section("vehicle", starmap(format_line, lengths.items())) if lengths else ""
    said = {"source": reading.name, "kind": reading.form, **values, "line": line}
    return [Finding("lengths_by_tape", "warning", "vehicle", said)] if values else []


def _read(index: LogIndex, configuration: Configuration, choice: Choice | None) -> tuple[Reading, Held, bool]:
    """The wheels of a log, or else its commands, without a vehicle's lengths; its gyro; whether of rims."""
    if choice is not None and choice.recording is not None:
        configuration = choice.recording.configuration
    vehicle, where = make_stand_in(index, configuration), str(index.path)
    if choice is None:
        sources = choose_sources(index.channels, configuration, vehicle, where=where)
    else:
        sources = choice.sources
    stands_in = None if sources.pose is None else sources.pose.wheels
    source = sources.wheels or stands_in or next(iter(sources.rank_drives("wheels")), None) or sources.command
    if source is None:
        return Reading(), NO_SIGNAL, False
    is_measured = source is not sources.command
    alone = replace(sources, pose=None, wheels=source if is_measured else None, others={})
    log = LogColumns(read_topics(index, list_wanted(alone, index.types, [source])))
    given = Given(log, alone, configuration, vehicle, where=where)
    case = Case(given, Extraction(given), alone, None)
    unit = source.signals[0].unit or case.find_section(source, is_measured=is_measured).unit
    return case.read(source, is_measured=is_measured), case.read_gyro().second, unit in RIMS


def _contradict(
    source: str, taped: float | None, known: float | None, choice: Choice | None, most: float
) -> list[Finding]:
    """How a tape contradicts the vehicle or the motion that the log shows; empty where it does not.

    Args:
        source: what turned, or was commanded.
        taped: wheel radius [m], or gain of speeds, by the tape.
        known: the same by the vehicle; None if it is not known.
        choice: topics of the log; None takes them by their names.
        most: ratio of both from which on they contradict each other.
    """
    if choice is None or not taped or not known:
        return []
    is_named = choice.vehicle_source != "fitted" and not choice.vehicle.stand_ins
    pose = choice.sources.pose
    # Speeds of a log without any other reference have the unit that the tape gives them.
    is_open = known == 1.0 and not is_named and (pose is None or pose.wheels is not None)
    if is_open or 1.0 / most < taped / known < most:
        return []
    said: dict[str, object] = {
        "is_named": is_named,
        "source": source,
        "vehicle": choice.vehicle.name,
    }
    said |= {"value": known / taped} | ({} if known == 1.0 else {"radius_m": known})
    return [Finding("tape_contradicts_vehicle", "warning", "vehicle", said)]


def add_lengths(error: SlipError, known: Sequence[Finding]) -> SlipError:
    """The refusal of a log with the lengths that a tape shows all the same, and files that are not read."""
    hint = ""
    for one in known:
        if one.values.get("line"):
            hint += f" By what was measured by hand, {one.values['line']} in run.toml."
        elif one.id == "no_length_by_tape":
            hint += f" {_REFUSED[one.values['kind']]}."
        elif one.id == "file_not_read":
            hint += f" {one.values['why']}."
    return type(error)(error.code, error.what, where=error.where, hint=f"{error.hint}{hint}")


_REFUSED = {
    "both ways": "What was measured by hand shows no length, for the wheels drove forward and back, and a "
    "tape measures one way: record a drive in one direction",
    "no vehicle": "What was measured by hand gives a length that no vehicle has: give the distance of all "
    "that the log holds, and the unit of the wheel speeds (unit under [wheels] in run.toml)",
    "no radius": "Counted turns show a track only with the wheel radius: give --wheel-radius, or --drove "
    "with the distance of a straight drive in the same log",
}
"""Why there is no length by what was measured by hand, and what to do, in the refusal of a log."""


def _add_up(left: Held, right: Held, form: str) -> tuple[tuple[float, float], float]:
    """The way ahead from start to end and in all, and all turning to either side, in the signals' units."""
    times, one = _accumulate(left)
    later, other = _accumulate(right)
    if form == "sides":
        other = np.interp(times, later, other) if later.size else np.zeros_like(one)
        one, other = 0.5 * (one + other), other - one
    return (abs(float(one[-1])) if one.size else 0.0, _add_legs(one)), _add_legs(other)


def _accumulate(signal: Held) -> tuple[Floats, Floats]:
    """Times [s] of the known values, and their integral up to each."""
    known = np.isfinite(signal.values)
    times = signal.times[known]
    return times, arrays.integrate_rate(times, signal.values[known])


def _add_legs(signal: Floats) -> float:
    """Sum of the ways between the turning points of a heading or a distance: legs to either side add up."""
    if not signal.size:
        return 0.0
    least, total = _LEAST_SWING * float(np.ptp(signal)), 0.0
    begin = far = float(signal[0])
    for value in signal.tolist():
        sense = 1.0 if far >= begin else -1.0
        if sense * (value - far) > 0.0:
            far = value
        elif sense * (far - value) > least:
            total, begin, far = total + abs(far - begin), far, value
    return total + abs(far - begin)


def _share(distance_m: float) -> float:
    return max(_TAPE_M / distance_m, _TAPE)


def _bound(value: float, share: float) -> list[float]:
    """A value with the ends of the interval that a relative error allows."""
    return [value, value * (1.0 - share), value * (1.0 + share)]
