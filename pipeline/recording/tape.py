"""Lengths of a vehicle by a tape and counted turns, for a log that has no other reference."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipeline.core import Floats, SlipError, arrays
from pipeline.logs import LogIndex, read_topics
from pipeline.recording.case import Case
from pipeline.recording.extract import Extraction, Given
from pipeline.recording.findings import Finding
from pipeline.recording.log_choice import Choice, make_stand_in
from pipeline.recording.log_columns import LogColumns
from pipeline.recording.readings import NO_SIGNAL, Held, Reading
from pipeline.recording.topic_values import list_wanted
from pipeline.sources import Configuration, TruthSection, choose_sources

_TAPE_M, _TAPE = 5e-3, 5e-3
"""Error of a distance by a tape: 5 mm, or half a percent of it if that is more."""
_FAR = 2.0
"""Ratio to the vehicle's own length beyond which the tape measured something else: no wheel wears so far."""
_TURNS = 0.1
"""Error of counted turns: a tenth of one, as a mark on the ground shows."""
_LEAST_SWING = 0.02
"""Turning back over the range of the heading, below which it is no leg of its own: the noise of a drive."""


def measure_by_tape(
    index: LogIndex, configuration: Configuration, choice: Choice | None = None
) -> list[Finding]:
    """Wheel radius and track by what the wheels turned, or the commands said, over what a tape and turns say.

    Args:
        index: of the log.
        configuration: with the section ``[truth]``.
        choice: topics of the log and what its motion corrects; None takes topics by their names.

    Returns:
        One finding, or none where nothing was measured by hand, or nothing turned; or that it contradicts the
        vehicle, where the log or the user names one.
    """
    truth = configuration.truth
    if truth == TruthSection():
        return []
    reading, gyro = _read(index, configuration, choice)
    first, second = _add_up(reading.first, reading.second, reading.form)
    turns, turns_error = truth.turns, _TURNS
    if turns is None and gyro.moves:
        # A gyro counts turns as well as the eye.
        turns = _count_both_ways(_accumulate(gyro)[1]) / (2.0 * np.pi)
        turns_error = 0.01 * turns
    angle = 2.0 * np.pi * (turns or 0.0)
    values: dict[str, object] = {"source": reading.name, "kind": reading.form}
    if reading.form == "body":
        if truth.distance_m and first > 0.0:
            values["ahead"] = _bound(truth.distance_m / first, _share(truth.distance_m))
        if angle and second > 0.0:
            values["turning"] = _bound(angle / second, turns_error / (turns or 1.0))
    elif reading.form == "sides":
        radius, share = configuration.vehicle.wheel_radius_m, 0.0
        if truth.distance_m and first > 0.0:
            radius, share = truth.distance_m / first, _share(truth.distance_m)
            values["wheel_radius_m"] = _bound(radius, share)
        if radius and angle and second > 0.0:
            values["track_width_m"] = _bound(radius * second / angle, share + turns_error / (turns or 1.0))
    known = {key: one for key, one in values.items() if isinstance(one, list)}
    values["line"] = "; ".join(f"{key} = {one[0]:.4g}" for key, one in known.items() if key.endswith("_m"))
    if not known:
        return []
    return _contradict_vehicle(values, choice) or [Finding("lengths_by_tape", "warning", "vehicle", values)]


def _read(index: LogIndex, configuration: Configuration, choice: Choice | None) -> tuple[Reading, Held]:
    """The wheels of a log, or else its commands, without a vehicle's lengths; and its gyro."""
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
        return Reading(), NO_SIGNAL
    is_measured = source is not sources.command
    alone = replace(sources, pose=None, wheels=source if is_measured else None, others={})
    log = LogColumns(read_topics(index, list_wanted(alone, index.types, [source])))
    given = Given(log, alone, configuration, vehicle, where=where)
    case = Case(given, Extraction(given), alone, None)
    return case.read(source, is_measured=is_measured), case.read_gyro().second


def _contradict_vehicle(values: Mapping[str, object], choice: Choice | None) -> list[Finding]:
    """That a tape contradicts the vehicle that the log or the user names; else nothing."""
    taped = values.get("ahead") or values.get("wheel_radius_m")
    is_known = choice is not None and choice.vehicle_source != "fitted" and not choice.vehicle.stand_ins
    if choice is None or not is_known or not isinstance(taped, list):
        return []
    radius = choice.vehicle.wheel_radius_m
    ratio = taped[0] / (radius if values["kind"] == "sides" else 1.0)
    if 1.0 / _FAR < ratio < _FAR:
        return []
    said = {"source": values["source"], "vehicle": choice.vehicle.name, "value": 1.0 / ratio}
    said |= {"radius_m": radius} if values["kind"] == "sides" else {}
    return [Finding("tape_contradicts_vehicle", "warning", "vehicle", said)]


def add_lengths(error: SlipError, by_tape: Sequence[Finding]) -> SlipError:
    """The refusal of a log with the lengths that a tape shows all the same."""
    lines = [one.values["line"] for one in by_tape if one.values["line"]]
    hint = "".join(f" By what was measured by hand, [vehicle] {line}." for line in lines)
    return type(error)(error.code, error.what, where=error.where, hint=f"{error.hint}{hint}")


def _add_up(left: Held, right: Held, form: str) -> tuple[float, float]:
    """The way ahead from start to end, and all turning to either side, in the signals' own units."""
    times, one = _accumulate(left)
    later, other = _accumulate(right)
    if form == "sides":
        other = np.interp(times, later, other) if later.size else np.zeros_like(one)
        one, other = 0.5 * (one + other), other - one
    return abs(float(one[-1])) if one.size else 0.0, _count_both_ways(other)


def _accumulate(signal: Held) -> tuple[Floats, Floats]:
    """Times [s] of the known values, and their integral up to each."""
    known = np.isfinite(signal.values)
    times = signal.times[known]
    return times, arrays.integrate_rate(times, signal.values[known])


def _count_both_ways(heading: Floats) -> float:
    """Sum of the ways between the turning points of a heading: legs to the left and to the right add up."""
    if not heading.size:
        return 0.0
    least, total = _LEAST_SWING * float(np.ptp(heading)), 0.0
    begin = far = float(heading[0])
    for value in heading.tolist():
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
