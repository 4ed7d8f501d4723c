"""Rates of wheels from what counts their turning, and what position and velocity of a wheel say together.

A counter that runs over or is reset jumps in one step: such a jump is no motion. A position and a velocity of
one joint are compared before anything else is asked of them: their ratio does not depend on the ground.
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from pipeline.core import Floats, Ints, spread_equal
from pipeline.recording import topic_values
from pipeline.recording.findings import Finding
from pipeline.recording.motion import find_one_ratio
from pipeline.sources import list_factors

_NEIGHBOURS: Final = 2
"""Steps on either side of a jump that are those of motion."""
_FAR: Final = 5.0
"""A jump is so many times as fast as the fastest motion."""
_PERIODS: Final = tuple(2.0**bits for bits in range(8, 33))
"""Numbers of ticks after which counters begin again."""

_NEAR: Final = 0.1
"""Relative deviation of a ratio that is not one: both may be filtered."""
_EXACT: Final = 0.03
"""Relative tolerance of a ratio around that of a unit, which a gear of 60 to 1 misses."""
_STILL_RADPS: Final = 0.05
"""Rate [rad/s] below which a wheel is at rest; a wheel at rest in the whole log does not show a unit."""
_NO_VELOCITY: Final = 1e-3
"""Share of its position's rate below which a velocity is none."""
_FASTEST_RADPS: Final = 150.0
"""Rate [rad/s] beyond which none of a ground robot's wheels turns for long."""
_POSITIONS: Final = {"degrees": math.degrees(1.0), "turns": 0.5 / math.pi}
"""Units of positions, by how many make a radian."""


def find_jumps(times: Floats, series: Floats) -> Ints:
    """Steps of a counter that are no motion, as indices of the reading before each.

    Args:
        times: [s], shape (n,).
        series: what is counted, without gaps; readings may be repeated.
    """
    steps, waits = np.diff(series), np.diff(times)
    fresh = np.flatnonzero(steps)
    if fresh.size <= 2 * _NEIGHBOURS:
        return fresh[:0]
    rates = np.abs(steps[fresh]) / np.maximum(waits[fresh], float(np.median(waits)))
    # The first and the last ones have neighbours on one side only.
    padded = np.pad(rates, _NEIGHBOURS)
    shifts = (shift for shift in range(2 * _NEIGHBOURS + 1) if shift != _NEIGHBOURS)
    beside = np.max([padded[shift : shift + rates.size] for shift in shifts], axis=0)
    alone = rates > _FAR * beside
    usual = float(np.max(rates[~alone], initial=0.0))
    return fresh[alone & (rates > _FAR * usual)] if usual > 0.0 else fresh[:0]


def take_out_jumps(times: Floats, series: Floats) -> Floats:
    """A counter without its jumps: across each it goes on as around it.

    Args:
        times: [s], shape (n,).
        series: what is counted, without gaps.
    """
    jumps = find_jumps(times, series)
    if not jumps.size:
        return series
    steps, waits = np.diff(series), np.diff(times)
    usual = np.delete(np.arange(steps.size), jumps)
    rates = steps[usual] / np.maximum(waits[usual], 1e-9)
    steps[jumps] = np.interp(jumps, usual, rates) * waits[jumps]
    return np.asarray(np.concatenate((series[:1], series[0] + np.cumsum(steps))))


def unwrap_counter(count: Floats) -> Floats:
    """Unwrap a counter that begins again at a power of two, from 2^8 to 2^32."""
    if count.size < 2:  # noqa: PLR2004 - a step
        return count
    spread, largest = float(np.ptp(count)), float(np.abs(np.diff(count)).max())
    for period in _PERIODS:
        if spread <= period and largest > 0.5 * period:
            return np.asarray(np.unwrap(count, period=period), dtype=np.float64)
    return count


def differentiate_angle(times: Floats, angle: Floats) -> Floats:
    """Rate [rad/s] of a wheel angle [rad] by central differences between readings, NaN where there is none.

    A wrapped angle is unwrapped; jumps of a counter are left out.
    """
    rate = np.where(np.isfinite(angle), 0.0, np.nan)
    known = np.isfinite(angle)
    if known.sum() < 3:  # noqa: PLR2004 - a central difference needs neighbours
        return rate
    times = spread_equal(times[known])
    rate[known] = np.gradient(take_out_jumps(times, _unwrap_angle(angle[known])), times)
    return rate


def _unwrap_angle(series: Floats) -> Floats:
    """Angles of one turn [rad] as they go on; others unchanged."""
    is_wrapped = float(np.max(np.abs(np.diff(series)))) > np.pi and np.ptp(series) <= 2.0 * np.pi + 1e-6
    return np.unwrap(series) if is_wrapped else series


def report_jumps(topic: str, times: Floats, counted: Mapping[str, Floats]) -> list[Finding]:
    """A finding on counters that jump; none without one.

    Args:
        topic: where they are.
        times: [s], shape (n,).
        counted: by name.
    """
    jumps: dict[str, float] = {}
    count = 0
    for name, series in counted.items():
        known = np.isfinite(series)
        if known.sum() < topic_values.FEWEST_MESSAGES:
            continue
        read = _unwrap_angle(series[known])
        at = find_jumps(spread_equal(times[known]), read)
        if at.size:
            jumps[name], count = float(np.median(np.abs(np.diff(read)[at]))), count + at.size
    if not jumps:
        return []
    values = {"value": max(jumps.values()), "count": count, "names": list(jumps)}
    return [Finding("counter_jumps", "info", topic, values)]


@dataclass(frozen=True)
class Settled:
    """What a position and a velocity of the same joints say together.

    Attributes:
        unit: of the velocities, where the positions show another one than rad/s.
        by_position: joints whose velocity is none, or contradicts what they turn.
        findings: what was found.
    """

    unit: str = ""
    by_position: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()


def settle_joints(topic: str, velocity: Mapping[str, Floats], turned: Mapping[str, Floats]) -> Settled:
    """Compare velocities with the rates of the positions of the same joints.

    Args:
        topic: their topic.
        velocity: as recorded, by joint.
        turned: rates of their positions [rad/s], by the same names.
    """
    live = {joint: np.where(np.abs(rate) > _STILL_RADPS, rate, np.nan) for joint, rate in turned.items()}
    fewest = topic_values.FEWEST_MESSAGES
    ratios = {joint: find_one_ratio(velocity[joint], live[joint], fewest) for joint in velocity}
    gains = {joint: ratio for joint, ratio in ratios.items() if ratio is not None}
    none = tuple(joint for joint, gain in gains.items() if abs(gain) < _NO_VELOCITY)
    findings = []
    if none:
        findings.append(Finding("velocity_zero", "warning", topic, {"names": list(none)}))
    known = {joint: gain for joint, gain in gains.items() if joint not in none}
    if len(known) + len(none) < len(velocity) or not known:
        return Settled("", none, tuple(findings))
    factors = list_factors("rad/s") | {"rev/s": 2.0 * math.pi}
    unit = next((name for name, one in factors.items() if _all_near(known.values(), 1.0 / one)), "")
    if unit or _all_near(known.values(), 1.0):
        return Settled(unit, none, tuple(findings))
    if meant := next((name for name, per in _POSITIONS.items() if _all_near(known.values(), 1.0 / per)), ""):
        return Settled("", none, (*findings, Finding("position_unit", "info", topic, {"unit": meant})))
    return _choose_side(topic, known, turned, Settled("", none, tuple(findings)))


def _choose_side(
    topic: str, gains: Mapping[str, float], turned: Mapping[str, Floats], settled: Settled
) -> Settled:
    """Which of a velocity and a position is used where their ratio is constant, and that of no unit."""
    odd = {joint: gain for joint, gain in gains.items() if abs(gain - 1.0) > _NEAR}
    ratios = [{"name": joint, "ratio": gain} for joint, gain in odd.items()]
    fastest = max(float(np.nanquantile(np.abs(turned[joint]), 0.95)) for joint in odd)
    if fastest > _FASTEST_RADPS:
        values = {"kind": "positions too fast", "ratios": ratios, "value": fastest}
        finding = Finding("velocity_not_of_position", "warning", topic, values)
        return Settled("", settled.by_position, (*settled.findings, finding))
    is_opposite = all(abs(gain + 1.0) <= _NEAR for gain in odd.values())
    contradicted = {"kind": "contradicted", "ratios": ratios, "is_opposite": is_opposite}
    finding = Finding("velocity_not_of_position", "warning", topic, contradicted)
    return Settled("", (*settled.by_position, *odd), (*settled.findings, finding))


def _all_near(values: Collection[float], wanted: float) -> bool:
    return all(abs(value / wanted - 1.0) < (_NEAR if wanted == 1.0 else _EXACT) for value in values)
