"""Whether poses and commands are what their topics claim, from simultaneous samples of a run.

And whether map scale depends on direction: ratio of pose path to wheel path by heading.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

from pipeline.core import Flags, Floats, Ints, arrays, fit_robustly, rigid, student_quantile
from pipeline.recording import Finding, measure_rest
from pipeline.run import ANSWERS_S, LIVE_SHARE, MOVING_MPS, SPAN_S, STILL_MPS
from pipeline.sources import Vehicle
from pipeline.stages.inputs import Ideal, Steps

_STEP = 0.02
"""Step of the lags that are tried [s]: a parabola through three of them interpolates."""
_FEWEST_OF_DELAY = 50
"""Least number of samples for a delay: 2.5 s at 20 Hz, four times the largest lag (0.6 s)."""
FEWEST_SAMPLES = 100
"""Least number of grid samples for any check: five seconds at 20 Hz. Half and double change no finding of
two recordings."""
_LEAST_CORRELATION = 0.7
"""Correlation below which a lag is meaningless: at this value the signals share half of their power."""


@dataclass(frozen=True)
class Delay:
    """A delay and its uncertainty.

    Attributes:
        seconds: delay of the signal; negative if it is early.
        correlation: signed correlation at that lag.
        deviation: standard deviation of the delay [s]: the power that the signals do not share, over the
            power of the signal's rate of change, over the number of independent samples.
    """

    seconds: float
    correlation: float
    deviation: float


def estimate_delay(
    times: Floats, signal: Floats, reference_times: Floats, reference: Floats, *, largest: float = 0.6
) -> Delay | None:
    """Delay of a signal against a reference.

    Args:
        times: times of the signal [s], shape (n,).
        signal: values, shape (n,).
        reference_times: times of the reference [s], increasing, shape (m,).
        reference: values, shape (m,).
        largest: largest lag tried, in both directions [s].

    Returns:
        The delay; None if the signals do not correlate, or there are fewer than `_FEWEST_OF_DELAY` samples.
    """
    if min(times.size, reference_times.size) < _FEWEST_OF_DELAY:
        return None
    centred = signal - signal.mean()
    spread = float(np.sqrt(np.mean(centred**2)))
    if spread < 1e-9 or float(np.std(reference)) < 1e-9:  # noqa: PLR2004 - constant up to rounding
        return None
    lags = np.arange(-largest, largest + _STEP / 2.0, _STEP)
    scores = np.array(
        [_correlate(centred, spread, np.interp(times - lag, reference_times, reference)) for lag in lags]
    )
    best = int(np.argmax(np.abs(scores)))
    if abs(scores[best]) < _LEAST_CORRELATION:
        return None
    sign = np.sign(scores[best]) or 1.0
    tall = sign * scores
    if 0 < best < lags.size - 1:
        before, middle, after = tall[best - 1 : best + 2]
        bend = before - 2.0 * middle + after
        shift = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
    else:
        bend, shift = 0.0, 0.0
    # The difference of the signals is correlated over about a second: seconds are counted, not samples.
    seconds = max(float(np.median(np.diff(times))) * times.size, 1.0)
    unshared = 1.0 - min(tall[best], 1.0) ** 2
    deviation = float(_STEP * np.sqrt(unshared / (seconds * -bend))) if bend < 0.0 else largest
    return Delay(float(lags[best] + shift * _STEP), float(scores[best]), deviation)


def _correlate(centred: Floats, spread: float, other: Floats) -> float:
    rest = other - other.mean()
    size = float(np.sqrt(np.mean(rest**2)))
    return float(np.mean(centred * rest)) / (spread * size) if size > 0.0 else 0.0


@dataclass(frozen=True)
class Samples:
    """Samples of one run on its grid; ideals are NaN where unknown.

    Attributes:
        times: [s], shape (n,).
        segment: number of the segment, shape (n,).
        steady: outside transitory spans, shape (n,).
        step: number of the command step, shape (n,).
        position: x, y of base_link [m], shape (n, 2).
        yaw: of base_link, unwrapped inside a segment [rad], shape (n,).
        velocity: (v_x, v_y, v_w), shape (n, 3).
        gyro: yaw rate of the gyro, NaN without one, shape (n,).
        command: ideal velocity of the command, shape (n, 3); None without commands.
        measured: ideal velocity of the measured wheels, shape (n, 3); None without encoders.
        body_commanded: whether the command was a body command.
        is_drive_alone: whether the motion is that of the measured wheels, since no pose was recorded.
    """

    times: Floats
    segment: NDArray[np.int32]
    steady: Flags
    step: NDArray[np.int32]
    position: Floats
    yaw: Floats
    velocity: Floats
    gyro: Floats
    command: Floats | None
    measured: Floats | None
    body_commanded: bool
    is_drive_alone: bool = False


def gather_samples(
    velocities: pl.DataFrame, inputs: Mapping[str, Ideal], cut: Steps, *, body_commanded: bool
) -> Samples:
    """Arrange the samples of a run on its grid for the checks.

    Args:
        velocities: table `velocities`.
        inputs: ideal velocities by input.
        cut: command steps.
        body_commanded: whether the command was a body command.
    """
    counts = np.zeros(velocities.height, dtype=bool)
    ideals: dict[str, Floats | None] = {"command": None, "measured": None}
    for name, ideal in inputs.items():
        mask = np.isfinite(ideal.velocity).all(axis=1) & ideal.active
        if mask.any():
            ideals[name] = np.where(mask[:, None], ideal.velocity, np.nan)
            counts |= mask
    gyro = velocities["v_w_imu"] if "v_w_imu" in velocities.columns else pl.Series([None] * counts.size)
    return Samples(
        velocities["t"].to_numpy(),
        velocities["segment"].to_numpy(),
        counts & ~cut.transitory,
        np.where(counts, cut.step, -1),
        velocities.select("x", "y").to_numpy(),
        velocities["yaw"].to_numpy(),
        velocities.select("v_x", "v_y", "v_w").to_numpy(),
        gyro.cast(pl.Float64).fill_null(np.nan).to_numpy(),
        ideals["command"],
        ideals["measured"],
        body_commanded,
    )


_FEWEST_SPANS = 8
"""Least number of half seconds in which poses are compared with wheels: four seconds of driving: no more may
be left of a damaged log."""
_FEWEST_MOVING = 50
"""Least number of samples in motion for that comparison."""
_SIDEWAYS = 1e-4
"""Sideways speed of a wheel odometry [m/s]: rounding. `pose_choice` tolerates 20 times as much, since it only
ranks candidates."""
_UNEVEN = 0.05
"""Fraction of that drift that uneven steps leave, and relative deviation of a step from a sensor's period."""
_FAST_STEP = 0.015
"""Half the time between two steps of fast odometry [s]: any relevant skid drifts by more."""
_ROUNDING = 5e-3
"""Relative deviation of a wheel odometry from the path of its wheels: 2.5 mm in half a metre; the noise of
localizations is 4 mm."""
_ROUNDING_OF_STEPS = 2e-3
"""The same for poses that drift as steps do: at 10 or 20 Hz they leave .0016 at most on the real recordings
(`_from_wheels` of `benchmarks/injections.py`); a higher value also accepts a skid measured to 1 mm."""
_ROUNDING_ANY_WAY = 1e-3
"""The same for a vehicle that moves sideways: without the sideways criterion, its paths must fit better."""
_SHORTEST_SILENCE_S = 1.5 * ANSWERS_S
"""Shortest zero command [s] that is checked, from `ANSWERS_S` after its beginning."""
_ZERO = 1e-6
"""Largest command that counts as zero, up to rounding [m/s, rad/s]."""


def check_independence(samples: Samples, vehicle: Vehicle, periods_s: Sequence[float]) -> list[Finding]:
    """Report poses that are integrated from the wheels: their slip is zero by construction.

    Wheel odometry never moves sideways if the vehicle cannot, while any localization has noise there; and its
    speed is that of the wheels, up to the radius and a small delay. Its heading may come from a gyro.

    Args:
        samples: of the run.
        vehicle: its vehicle.
        periods_s: periods of the wheels' readings and of the poses [s].
    """
    if samples.measured is None:
        return []
    known: Flags = np.all(np.isfinite(samples.measured), axis=1)
    first, last = list_spans(samples, known)
    moving = known & (np.abs(np.nan_to_num(samples.measured)) > STILL_MPS).any(axis=1)
    is_driven = vehicle.kinematics.has_inputs("sideways")
    if moving.sum() < _FEWEST_MOVING or first.size < _FEWEST_SPANS:
        return []
    sideways = samples.velocity[:, 1] - samples.measured[:, 1]
    keeps_straight = not is_driven and float(np.median(np.abs(sideways[moving]))) <= _SIDEWAYS
    if not (is_driven or keeps_straight):
        whole = moving[first] & moving[last]
        swing = samples.measured[:, 0] * samples.measured[:, 2]
        ways = (arrays.integrate_rate(samples.times, np.nan_to_num(rate)) for rate in (sideways, swing))
        drifted, swung = ((path[last] - path[first])[whole] for path in ways)
        if not _steps_evenly(drifted, swung, periods_s):
            return []
    ahead, aside, turning = _share_beside_wheels(samples, samples.measured, first, last)
    moved = [share for share in (ahead, aside if is_driven else None) if share is not None]
    share = max(moved) if moved else turning
    steps = _ROUNDING if keeps_straight else _ROUNDING_OF_STEPS
    if share is None or share > (_ROUNDING_ANY_WAY if is_driven else steps):
        return []
    elsewhere = turning is not None and turning > _ROUNDING
    values = {"kind": "follows the wheels", "value": share, "has_other_heading": bool(elsewhere)}
    return [Finding("pose_from_wheels", "error", "pose", values)]


def _steps_evenly(drifted: Floats, swung: Floats, periods_s: Sequence[float]) -> bool:
    """Whether all sideways motion is that of steps along the heading before or after each turn.

    Such steps drift by half a step's time multiplied by speed and yaw rate. The test uses half seconds, over
    which the deviations of single steps do not accumulate, while a skid does.

    Args:
        drifted: sideways displacement relative to the wheels in each half second [m], shape (n,).
        swung: integral of the wheels' speed times yaw rate [m/s], shape (n,).
        periods_s: possible periods of the steps [s].
    """
    if drifted.size < _FEWEST_SPANS:
        return False
    made = fit_robustly(swung[:, None], drifted)
    half_step = float(made.gains[0])
    drift = float(np.median(np.abs(half_step * swung)))
    known = any(abs(2.0 * abs(half_step) / period - 1.0) <= _UNEVEN for period in periods_s if period > 0.0)
    regular = float(np.median(np.abs(made.rest))) <= max(_UNEVEN * drift, _SIDEWAYS * SPAN_S)
    return regular and (known or abs(half_step) <= _FAST_STEP)


def list_spans(samples: Samples, known: Flags) -> tuple[Ints, Ints]:
    """First and last samples of half seconds in one segment without unknown samples, each of shape (m,)."""
    span = arrays.count_steps(samples.times, SPAN_S)
    first = np.arange(0, samples.times.size - span, span)
    last = first + span
    counted = np.concatenate(([0], np.cumsum(known)))
    whole = (counted[last + 1] - counted[first] == span + 1) & (
        samples.segment[first] == samples.segment[last]
    )
    return first[whole], last[whole]


def _share_beside_wheels(
    samples: Samples, measured: Floats, first: Ints, last: Ints
) -> tuple[float | None, float | None, float | None]:
    """Fractions of forward path, sideways path and turning over half seconds not explained by the wheels.

    Any gain is allowed (another radius, another track width), and a small delay, to first order. A fraction
    is None if there is no motion of its kind.
    """
    turned = samples.yaw[last] - samples.yaw[first]
    heading = samples.yaw[first] + 0.5 * turned
    step = samples.position[last] - samples.position[first]
    ahead = np.sum(step * np.stack((np.cos(heading), np.sin(heading)), axis=-1), axis=1)
    aside = np.sum(step * np.stack((-np.sin(heading), np.cos(heading)), axis=-1), axis=1)
    # The path along an arc is longer than its chord.
    arc = np.sinc(turned / (2.0 * np.pi))
    shares = []
    for moved, axis in ((ahead / arc, 0), (aside / arc, 1), (turned, 2)):
        rate = np.nan_to_num(measured[:, axis])
        driven = arrays.integrate_rate(samples.times, rate)
        shares.append(measure_rest(moved, driven[last] - driven[first], rate[last] - rate[first]))
    return shares[0], shares[1], shares[2]


def check_live_commands(samples: Samples, _vehicle: Vehicle) -> list[Finding]:
    """Report repeated zero commands during which the wheels turn: another source drives the vehicle.

    The drive has two seconds to come to rest. Without encoders the poses are used, which also show a vehicle
    that slides or is pushed.
    """
    if samples.command is None:
        return []
    body = samples.velocity if samples.measured is None else samples.measured
    size = np.abs(np.nan_to_num(body)).max(axis=1)
    moves = size > max(LIVE_SHARE * float(np.quantile(size, 0.99)), MOVING_MPS)
    # A comparison with an unknown command is false, so that it does not count as zero.
    silent: Flags = np.all(np.abs(samples.command) < _ZERO, axis=1)
    past: Flags = np.zeros(silent.size, dtype=bool)
    for first, end in rigid.find_runs(silent):
        since = samples.times[first:end] - samples.times[first]
        if since[-1] >= _SHORTEST_SILENCE_S:
            past[first:end] = moves[first:end] & (since > ANSWERS_S)
    count = int(past.sum())
    if count < FEWEST_SAMPLES:
        return []
    begin = float(samples.times[np.flatnonzero(past)[0]])
    values = {"kind": "zero", "count": count}
    return [Finding("stale_command", "warning", "command", values, t_start=begin)]


# A map that is scaled or sheared multiplies distances along heading h, to first order, by
# 1 + s + a cos 2h + b sin 2h. A log cannot distinguish the scale s from a wheel radius. No vehicle causes
# a and b, which follow the map's axes: an effect that turns with the vehicle is equal along all of them. The
# effect of a slope varies once per turn with the heading; it is fitted jointly, as are those of speed,
# turning and a late pose.

_CURVE_RAD = 0.5
"""Change of heading [rad] in a span above which it has no single heading."""
_LIVE = 0.2
"""Fraction of the usual largest speed above which wheels drive."""
_FEWEST = 120
"""Least number of spans of driving: one minute."""
_BLOCKS = 20
"""Number of stretches that are left out in turn, for the jackknife uncertainty of the shape."""
_SECTORS = 4
"""Pairs of opposite headings: four resolve an effect that repeats twice per turn."""
_FEWEST_SECTORS = 3
"""Least number of the four sectors with driving: two could be two roads with different ground."""
_SECTOR_SHARE = 0.08
"""Least fraction of the spans for a sector to count."""
_CHANCE = 1e-3
"""False-alarm probability on an even map if stretches are independent."""
_LEAST = 0.01
"""Least reported difference between longest and shortest direction: a tape measure is as accurate."""


def check_map_shape(samples: Samples, _vehicle: Vehicle) -> list[Finding]:
    """Report a map that is longer along one direction than across it."""
    if samples.measured is None:
        return []
    first, last = _list_straight_spans(samples, samples.measured)
    if first.size < _FEWEST or not _turns_about(samples.yaw[(first + last) // 2]):
        return []
    design, moved = _arrange(samples, samples.measured, first, last)
    stretch = np.minimum(np.arange(first.size) * _BLOCKS // first.size, _BLOCKS - 1)
    whole = fit_robustly(design, moved).gains
    others = [stretch != one for one in range(_BLOCKS)]
    without = np.array([fit_robustly(design[rows], moved[rows]).gains for rows in others])
    pair, pairs = whole[1:3], without[:, 1:3]
    freedom = _BLOCKS - 1.0
    centred = pairs - pairs.mean(axis=0)
    covariance = freedom / _BLOCKS * centred.T @ centred
    size = float(np.hypot(*pair))
    along = pair / max(size, 1e-12)
    half = student_quantile(0.95, freedom) * 2.0 * math.sqrt(float(along @ covariance @ along))
    # Hotelling's T of two numbers: its F has a quantile in closed form.
    reached = float(pair @ np.linalg.pinv(covariance) @ pair) * (freedom - 1.0) / (2.0 * freedom)
    needed = 0.5 * (freedom - 1.0) * (_CHANCE ** (-2.0 / (freedom - 1.0)) - 1.0)
    stretched = 2.0 * size
    if reached < needed or stretched < _LEAST:
        return []
    angle = math.degrees(0.5 * math.atan2(pair[1], pair[0])) % 180.0
    low, high = (max(end, 0.0) for end in (stretched - half, stretched + half))
    values = {
        "value": stretched,
        "count": int(first.size),
        "low": low,
        "high": high,
        "heading_deg": angle,
    }
    return [Finding("map_uneven", "warning", "pose", values)]


def _list_straight_spans(samples: Samples, measured: Floats) -> tuple[Ints, Ints]:
    """First and last samples of half seconds of driving along one heading, each of shape (m,)."""
    known: Flags = np.isfinite(measured).all(axis=1) & np.isfinite(samples.velocity[:, 0])
    driven = np.abs(np.nan_to_num(measured[:, 0]))
    first, last = list_spans(samples, known & (driven > _LIVE * float(np.quantile(driven, 0.95))))
    straight = np.abs(samples.yaw[last] - samples.yaw[first]) < _CURVE_RAD
    return first[straight], last[straight]


def _turns_about(heading: Floats) -> bool:
    """Whether there is driving along enough directions of the map."""
    sector = np.floor(heading / np.pi * _SECTORS).astype(np.int64) % _SECTORS
    share = np.bincount(sector, minlength=_SECTORS) / heading.size
    return int((share > _SECTOR_SHARE).sum()) >= _FEWEST_SECTORS


def _arrange(samples: Samples, measured: Floats, first: Ints, last: Ints) -> tuple[Floats, Floats]:
    """Regressors of each span's forward displacement, shape (m, 11), and the displacement [m], shape (m,)."""
    rates = (samples.velocity[:, 0], measured[:, 0])
    paths = (arrays.integrate_rate(samples.times, np.nan_to_num(rate)) for rate in rates)
    moved, driven = (path[last] - path[first] for path in paths)
    heading = 0.5 * (samples.yaw[first] + samples.yaw[last])
    once, twice = np.exp(1j * heading), np.exp(2j * heading)
    turned = samples.yaw[last] - samples.yaw[first]
    size, lasted = np.abs(driven), samples.times[last] - samples.times[first]
    columns = (
        driven, driven * twice.real, driven * twice.imag,
        size * once.real, size * once.imag, lasted * once.real, lasted * once.imag,
        driven * size, driven * turned, driven * np.abs(turned), measured[last, 0] - measured[first, 0],
    )  # fmt: skip
    # Overall gain of the wheels' path: at one speed the columns do not determine it.
    gain = float(driven @ moved) / float(driven @ driven)
    return gain * np.column_stack(columns), moved
