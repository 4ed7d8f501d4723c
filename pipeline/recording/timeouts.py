"""When a command acts, and how long: it is held where no other follows, or until a time-out of the drive.

The time from the last command to half the speed is the time-out and the response time of the drive. That is
measured where the drive is told to stop. If it never is, its dead time is measured where it starts, and how
slowly it stops in the silences themselves.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from pipeline.core import (
    CONFIDENCE,
    NORMAL_95,
    Floats,
    Ints,
    fit_robustly,
    format_line,
    robust_spread,
    student_quantile,
)
from pipeline.recording.case import Case
from pipeline.recording.findings import Finding
from pipeline.recording.geometry import roll_wheels
from pipeline.recording.motion import CLEAR, LEAST_NATS, NO_MOTION, Motion, compare
from pipeline.recording.readings import (
    DELAYS_S,
    GRID_S,
    NO_SIGNAL,
    SIDES,
    UNEXPLAINED,
    Bent,
    Explained,
    Held,
    Reading,
)
from pipeline.run import IN_BURSTS, LIVE_SHARE

_PERIODS = 3.0
"""Gap in the commands [usual periods] above which they are silent: a shorter one is jitter."""
_STEADY_S = 0.5
"""Time [s] of steady commands and speed before a stop; otherwise the speed falls for another reason."""
_ALIKE = 0.1
"""Largest relative variation of a steady speed."""
_LONGEST_S = 4.0
"""Time [s] for which the speed is observed after a stop: drives reach half of it in less."""
_HOLE = 1.5
"""Distance of two steps of the motion [usual ones] that may hide a stop."""
_FEWEST = 3
"""Least number of silences, and of ordinary stops, for a typical value; and of steps of a steady speed."""
_OBEYED = 0.8
"""Least fraction of long silences in which the base stops: otherwise unrecorded commands drive it."""
_LATER_S = 0.3
"""Time [s] beyond the longest stop after which a silence must show a stop."""
_KNOWN = 0.3
"""Largest half-width of the interval, as a fraction of the time-out, that is reported."""
_QUARTER = 0.25
"""Part of a change of speed at which its first and its last quarter end."""
_CURVES = (math.log(2.0) / math.log(3.0), 1.0)
"""Time of the first half of a change of speed [times of the middle half]: of a first-order lag, of a ramp."""
_JUMP = 1.5
"""Time [steps] of the middle half of a jump in `Motion.rates`, which are means over three steps."""
_FAR = 3.0
"""Residual [robust spreads] that counts as no more than this: the interval is for the others."""
_MOST = 400
"""Number of stops that are evaluated: more add no information."""


@dataclass(frozen=True)
class CommandTimeout:
    """Time after the last command at which the base begins to stop.

    Attributes:
        seconds: the time.
        low, high: its 95 % interval [s].
        silences: number of stops used.
    """

    seconds: float
    low: float
    high: float
    silences: int


def ask_timeout(case: Case) -> Case:
    """Hold the command as long as what follows it does; wheels show it best."""
    command, wheels, motion = case.command, case.wheels, case.motion
    rolled = NO_MOTION
    if len(wheels.reading.inputs) == len(SIDES) and wheels.reading.form != "steering":
        rolled = roll_wheels(wheels.reading)
    is_sides = rolled.is_known and wheels.reading.form == "sides"
    width = 1.0 if is_sides else case.vehicle.kinematics.turning_width_m(case.vehicle)
    shown_by = rolled if rolled.is_known else motion
    timeout = find_timeout(command.reading, shown_by, 0.5 * width)
    bursts = None if timeout is not None else find_hold(command.reading, shown_by)
    timeout = timeout or bursts
    if timeout is None:
        return case
    given_s = case.configuration.command.hold_s
    in_bursts = bursts is not None and not given_s
    if bursts is not None and in_bursts:
        timeout = _take_as_fast(command.reading, bursts, motion)
    hold_s = given_s or timeout.seconds
    case.changes.setdefault("command", {})["hold_s"] = hold_s
    case.findings.append(_report(timeout, hold_s, in_bursts=in_bursts))
    held = hold(command.reading, hold_s).fitted(motion)
    return replace(case, command=replace(command, reading=held), in_bursts=in_bursts)


_GAINS = (0.8, 1.25)
"""Gains that another time-out may explain: those of a drive whose commands have the unit of its motion."""


def _take_as_fast(reading: Reading, bursts: CommandTimeout, motion: Motion) -> CommandTimeout:
    """The time-out with which the body moves as far as commanded, unless a gain is too large for that.

    A burst is as long as the time-out and as fast as a gain: their product alone is well known.
    """
    held = hold(reading, bursts.seconds)
    made, first = held.explain(motion), held.first
    if reading.form != "body" or not made.is_known:
        return bursts
    times, values = reading.first.times, np.abs(reading.first.values)
    held_s = np.minimum(np.diff(times, append=np.inf), bursts.seconds)
    # Bursts that are cut into cells of the grid are longer or shorter than they are.
    longer = float(np.abs(first.grid).sum()) * GRID_S / max(float(values @ held_s), 1e-9)
    # Over whole blocks a lag that is not quite right is none.
    block, steps = made.motion.steps.block, made.motion.steps
    ways = (held.columns(steps, made.lag, made.delay, crossed=False)[0], made.motion.body.real)
    asked, moved = (np.bincount(block, weights=one) for one in ways)
    gain = float(asked @ moved) / max(float(asked @ asked), 1e-9) * longer
    if not _GAINS[0] < gain < _GAINS[1]:
        return bursts
    seconds = gain * bursts.seconds
    low, high = min(bursts.low, seconds), max(bursts.high, seconds)
    return CommandTimeout(seconds, low, high, bursts.silences)


def _report(timeout: CommandTimeout, hold_s: float, *, in_bursts: bool) -> Finding:
    values = {
        "value": timeout.seconds,
        "count": timeout.silences,
        "low": timeout.low,
        "high": timeout.high,
        "hold_s": hold_s,
    }
    if in_bursts:
        return Finding(IN_BURSTS, "warning", "command", values)
    return Finding("command_timeout", "info", "command", values)


def find_timeout(reading: Reading, motion: Motion, lever: float) -> CommandTimeout | None:
    """Time-out of a base; None if its silences do not show one.

    Args:
        reading: the command.
        motion: of the wheels, or of the body, in any unit.
        lever: half the width of the vehicle, in that unit.
    """
    if not reading.inputs or reading.inputs[0].times.size < _FEWEST:
        return None
    run = _Run(reading, motion, lever)
    silences = run.find_silences()
    ordinary = run.find_stops() if silences.size else silences
    stands_in = bool(silences.size) and len(ordinary) < _FEWEST
    if stands_in:
        # A drive may start faster than it stops, or slower: compare the dead times.
        ordinary, silences = (one[np.isfinite(one[:, 2])] for one in (run.find_starts(), silences))
    if min(len(ordinary), len(silences)) < _FEWEST:
        return None
    # The duration of a ramp depends on the speed, that of a lag does not: compare stops at the same speed.
    both: Floats = np.concatenate((ordinary, silences))
    is_silent = np.arange(len(both)) >= len(ordinary)
    design: Floats = np.column_stack((is_silent, np.ones(len(both)), both[:, 1]))
    times = [both[:, 0]]
    if stands_in:
        sharp = np.sqrt(np.maximum(both[:, 2] ** 2 - (_JUMP * run.step) ** 2, 0.0))
        times = [both[:, 0] - curve * middle for curve in _CURVES for middle in (both[:, 2], sharp)]
    ranges = np.array([_compare(design, one, run.step) for one in times])
    low, high = float(ranges.min()), float(ranges.max())
    seconds = 0.5 * (low + high)
    if not 0.5 * (high - low) <= _KNOWN * seconds:
        return None
    return CommandTimeout(seconds, low, high, len(silences))


_HOLDS_S = np.array(
    [0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.6, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0, 3.0]
)
"""Times [s] for which bases hold a command, .25 to 1 s by their documentation, each near enough to the next
that one between them is likelier than none."""
_PARTS = 4
"""Parts into which the intervals beside the likeliest of them are divided: of a hundredth of a second."""
_FEWEST_WAITS = 10
"""Least number of waits between live commands, each of which ends a motion that is known from its start."""
_WAITING = 0.2
"""Least share of the time that is such waits: otherwise the ordinary stops decide."""
_NATS = 0.5 * NORMAL_95**2
"""Loss of log-likelihood at the ends of a 95 % interval of one number."""


def find_hold(reading: Reading, motion: Motion) -> CommandTimeout | None:
    """Time-out of a base that waits less than its commands are apart, by likelihood; None if it has none.

    A commander that sends at changes alone, or once a second, leaves no ordinary stop to compare with: the
    base moves in bursts, which another hold time explains.

    Args:
        reading: the command.
        motion: of the wheels, or of the body, in any unit.
    """
    stamps = reading.inputs[0].times if reading.inputs else np.zeros(0)
    waits = np.diff(stamps)
    asked = np.logical_or.reduce(
        [one.values != 0.0 for one in reading.inputs if one.times.size == stamps.size]
    )
    waits = waits[asked[:-1]] if waits.size else waits
    long = waits[waits > _HOLDS_S[0]]
    if long.size < _FEWEST_WAITS or float(long.sum()) < _WAITING * float(np.ptp(stamps)):
        return None
    made = reading.explain(motion)
    if not made.is_known:
        return None
    part, crossed = made.motion, made.crossed

    def rate(seconds: float) -> Floats:
        return hold(reading, seconds).fit_to(part, DELAYS_S, crossed=crossed).blocks

    holds = _HOLDS_S[float(np.quantile(long, 0.9)) > _HOLDS_S]
    blocks = {seconds: rate(seconds) for seconds in holds.tolist()}
    if not blocks:
        return None
    best = max(blocks, key=lambda seconds: float(blocks[seconds].sum()))
    at = int(np.searchsorted(_HOLDS_S, best))
    ends = _HOLDS_S[[max(at - 1, 0), min(at + 1, _HOLDS_S.size - 1)]]
    for one in np.linspace(ends[0], ends[1], 2 * _PARTS + 1).tolist():
        blocks.setdefault(one, rate(one))
    best = max(blocks, key=lambda seconds: float(blocks[seconds].sum()))
    if compare(blocks[best], made.blocks) < CLEAR:
        return None
    tried, nats = np.array(sorted((one, float(each.sum())) for one, each in blocks.items())).T
    likely = tried[nats > nats.max() - _NATS]
    step = float(np.ptp(ends)) / (2 * _PARTS)
    known = float(tried[np.argmax(nats)])
    return CommandTimeout(known, float(likely[0]) - step, float(likely[-1]) + step, int(np.sum(long > known)))


def _compare(design: Floats, times: Floats, step: float) -> tuple[float, float]:
    """The 95 % interval of the first coefficient of times that are known to a step."""
    made = fit_robustly(design, times)
    # A fit to n points passes through as many of them as it has coefficients: these show no spread.
    shown = np.sort(np.abs(made.rest))[made.gains.size :]
    clipped = np.minimum(shown, _FAR * robust_spread(shown))
    spread = max(math.sqrt(float(np.mean(clipped**2))), step / math.sqrt(12.0))
    share = math.sqrt(float(np.linalg.pinv(design.T @ design)[0, 0]))
    half = student_quantile(CONFIDENCE, float(shown.size)) * spread * share
    return float(made.gains[0]) - half, float(made.gains[0]) + half


class _Run:
    """What a drive is asked, and how fast its fastest side moves; see `find_timeout`."""

    def __init__(self, reading: Reading, motion: Motion, lever: float) -> None:
        self.stamps = reading.inputs[0].times
        inputs = [one for one in reading.inputs if one.times.size == self.stamps.size]
        asked = np.column_stack([np.where(one.live, one.values, 0.0) for one in inputs])
        self.asked = asked / np.maximum(np.sqrt(np.mean(asked**2, axis=0)), 1e-9)
        self.size = np.linalg.norm(self.asked, axis=1)
        self.live = self.size > LIVE_SHARE * float(np.quantile(self.size, 0.95))
        self.quiet = np.diff(self.stamps) > _PERIODS * _find_period(reading)
        self.times, velocity = motion.rates
        self.speed = np.abs(velocity[:, 0]) + lever * np.abs(velocity[:, 2])
        self.step = float(np.median(np.diff(self.times)))

    def find_silences(self) -> Floats:
        """Times from last commands to half the speed [s], that speed, and durations [s], shape (k, 3).

        A duration is that from three quarters to one quarter of the speed, NaN where it is not known. There
        are no stops if they are too few, or the base goes on.
        """
        last = np.flatnonzero(self.quiet & self.live[:-1])
        ends = np.minimum(self.stamps[last + 1], self.stamps[last] + _LONGEST_S)
        halves = self._watch_stops(last, self.stamps[last], ends)
        known = np.isfinite(halves[:, 0])
        longest = float(np.max(halves[known, 0], initial=0.0)) + _LATER_S
        goes_on = np.isinf(halves[:, 0]) & (ends - self.stamps[last] > longest)
        is_obeyed = known.sum() >= max(_FEWEST, _OBEYED * (known.sum() + goes_on.sum()))
        return halves[known] if is_obeyed else halves[:0]

    def find_stops(self) -> Floats:
        """The same from the first command of zero on."""
        last = np.flatnonzero(~self.quiet & self.live[:-1] & (self.size[1:] == 0.0))
        starts, on = self.stamps[last + 1], np.append(self.stamps[self.size > 0.0], np.inf)
        ends = np.minimum(on[np.searchsorted(on, starts)], starts + _LONGEST_S)
        halves = self._watch_stops(last, starts, ends)
        return halves[np.isfinite(halves[:, 0])]

    def _watch_stops(self, last: Ints, starts: Floats, ends: Floats) -> Floats:
        """Times from starts to half the speed, infinite if it is not reached, NaN if they are not known."""
        halves: Floats = np.full((last.size, 3), np.nan)
        for at in range(0, last.size, max(last.size // _MOST, 1)):
            row, start = int(last[at]), float(starts[at])
            if self.stamps[row] - self._follow(row, -1) >= _STEADY_S:
                halves[at] = self._find_half(start, float(ends[at]), start)
        return halves

    def find_starts(self) -> Floats:
        """The same from the first command after a rest on, by the speed that it leads to."""
        first = 1 + np.flatnonzero((self.quiet | (self.size[:-1] == 0.0)) & self.live[1:])
        halves: Floats = np.full((first.size, 3), np.nan)
        for at in range(0, first.size, max(first.size // _MOST, 1)):
            start = float(self.stamps[first[at]])
            until = min(self._follow(int(first[at]), 1), start + _LONGEST_S)
            if until - start >= 2.0 * _STEADY_S:
                halves[at] = self._find_half(start, until, until, rises=True)
        return halves[np.isfinite(halves[:, 0])]

    def _follow(self, row: int, step: int) -> float:
        """Stamp [s] of the last command before (step = -1) or after one up to which all are like it."""
        end = int(np.searchsorted(self.stamps, self.stamps[row] + step * _LONGEST_S))
        at = np.arange(row, min(end, self.stamps.size - 1) + step, step)
        unlike = np.abs(self.asked[at] - self.asked[row]).max(axis=1) > _ALIKE * self.size[row]
        unlike[1:] |= self.quiet[np.minimum(at[1:], at[:-1])]
        return float(self.stamps[at[np.argmax(unlike) - 1] if unlike.any() else at[-1]])

    def _find_half(
        self, start: float, end: float, steady: float, *, rises: bool = False
    ) -> tuple[float, float, float]:
        """Time from a start to half the speed that is steady up to a time, that speed, and the duration."""
        edges = np.searchsorted(self.times, (steady - _STEADY_S, steady, start, end))
        first, last, now, stop = edges.tolist()
        held = self.speed[first:last]
        level = float(np.median(held)) if held.size >= _FEWEST else 0.0
        if not now or not level or np.ptp(held) > 2.0 * _ALIKE * level:
            return math.nan, math.nan, math.nan
        times, part = self.times[now - 1 : stop], self.speed[now - 1 : stop] / level
        done = part if rises else 1.0 - part
        over = np.flatnonzero(done > 0.5)  # noqa: PLR2004 - half
        reached = int(over[0]) if over.size else times.size
        is_hole = np.diff(np.append(times, end)) > _HOLE * self.step
        if not reached or is_hole[:reached].any():
            return math.nan, math.nan, math.nan
        if not over.size:
            return math.inf, level, math.nan
        half = _cross(times, done, reached, 0.5)
        before = np.flatnonzero(done[:reached] <= _QUARTER)
        after = np.flatnonzero(done > 1.0 - _QUARTER)
        if not before.size or not after.size or is_hole[: after[0]].any():
            return half - start, level, math.nan
        begins = _cross(times, done, int(before[-1]) + 1, _QUARTER)
        return half - start, level, _cross(times, done, int(after[0]), 1.0 - _QUARTER) - begins


def _cross(times: Floats, values: Floats, row: int, value: float) -> float:
    """Time at which values that exceed one from this row on reach it."""
    share = (value - values[row - 1]) / (values[row] - values[row - 1])
    return float(times[row - 1] + share * (times[row] - times[row - 1]))


def _find_period(reading: Reading) -> float:
    return max(float(np.median(np.diff(reading.inputs[0].times))), 1e-3)


def hold(reading: Reading, seconds: float) -> Reading:
    """A command that is zero from a time [s] after its last message on, until the next one."""
    if not reading.inputs:
        return reading
    period = _find_period(reading)
    first, second, third = (
        NO_SIGNAL if one is NO_SIGNAL or isinstance(one, Bent) else _hold(one, seconds, period)
        for one in (reading.first, reading.second, reading.third)
    )
    if isinstance(reading.second, Bent):
        second = reading.second.drive(first)
    return replace(reading, first=first, second=second, third=third, explained=UNEXPLAINED)


def _hold(one: Held, seconds: float, period: float) -> Held:
    """A signal whose silences are filled: with its last value, then with zero."""
    if one.times.size < 2:  # noqa: PLR2004 - one message has no gap
        return one
    gaps = np.diff(one.times)
    times, values, live = [one.times], [one.values], [one.live]
    for row in np.flatnonzero(gaps > min(seconds, _PERIODS * period)).tolist():
        # Signals are read on a grid: samples nearer to each other say nothing more.
        step = max(period, GRID_S)
        # None at the next message itself, which it would replace.
        end = gaps[row] - 0.5 * GRID_S
        after = np.arange(step, end, step)
        if seconds < end:
            after = np.sort(np.append(after, seconds))
        times.append(one.times[row] + after)
        values.append(np.where(after < seconds, one.values[row], 0.0))
        live.append(np.full(after.size, one.live[row]))
    order = np.argsort(np.concatenate(times), kind="stable")
    filled = (np.concatenate(each)[order] for each in (times, values, live))
    return Held(next(filled), next(filled), may_stand=one.may_stand, counts=next(filled).astype(bool))


# When a command acts: never before it is sent, and how late.

_ERROR_S = 0.06
"""Error of a delay [s] beyond that of its fit: over the platforms and cases that are drawn without a delay it
is found from -.04 to .06 s, by values that are held and by a lag that stands for a part of it."""
_EARLIER_S = np.arange(-3.0, DELAYS_S[0], 0.05)
"""Delays [s] of commands that are stamped after nearly all that they do."""

_AS_MUCH = 0.3
"""Share by which a delay may differ from the one that is configured where it is its mirror image."""


def ask_delay(case: Case) -> Case:
    """Correct the times of a command that acts before it is sent, and tell a dead time.

    Three readings are compared: it acts before its stamp, which no command does; at once, however slowly what
    it drives follows; or after a dead time, as that of a drive, or of stamps that are early. Of poses, which
    are late themselves, the first one alone says something.
    """
    command, is_driven = case.command, case.driven.is_known
    given = case.configuration.command.late_s
    if not command.is_sure or given is not None:
        seen = command.reading.explained.delay
        # Stamps that were not late are early by what is taken off them.
        if command.is_sure and given and abs(given) > _ERROR_S and abs(seen / given - 1.0) < _AS_MUCH:
            values = {"source": str(command.source), "value": seen, "given": format_line("late_s", given)}
            case.findings.append(Finding("late_as_configured", "warning", "command", values))
        return case
    reading = command.reading
    if is_driven:
        followed, beside = "wheels", [one.topic for one in case.wheels.source.signals]
        made = _compare_delays(replace(reading, third=NO_SIGNAL, third_crossed=NO_SIGNAL), case.driven)
    elif case.sources.pose is not None:
        followed, beside = "pose", [case.sources.pose.topic]
        made = _compare_delays(reading, reading.explained)
    else:
        return case
    if made is None or (made.delay > 0.0 and not is_driven):
        return case
    if made.delay > 0.0:
        values = {
            "value": made.delay,
            "lag_s": made.lag,
            "source": str(command.source),
            "followed": followed,
        }
        case.findings.append(Finding("command_delay", "info", "command", values))
        return case
    late = round(-made.delay, 2)
    topics = [*(one.topic for one in command.source.signals), *beside]
    clocks = {case.extraction.clocks[topic].clock for topic in topics if topic in case.extraction.clocks}
    by_body = reading.explained.delay < -_ERROR_S
    if clocks == {"header"} and not by_body:
        # Times of recording are late by the way there; of two clocks either may be wrong.
        early = {"value": late, "source": str(command.source), "followed": followed}
        case.findings.append(Finding("command_late", "warning", "command", early))
        return case
    wrong = {"source": str(command.source), "late_s": late, "followed": followed}
    case.correct("command", "late stamps", wrong, f"late_s = {late:g}", {"late_s": late})
    return replace(case, driven=replace(made, delay=made.delay + late)) if is_driven else case


def _compare_delays(reading: Reading, made: Explained) -> Explained | None:
    """The fit with a delay; None where it is not clearly better than a lag alone.

    Args:
        reading: the command.
        made: its fit with the usual delays.
    """
    if made.delay <= DELAYS_S[0]:
        made = reading.fit_to(made.motion, _EARLIER_S, crossed=made.crossed)
    if abs(made.delay) <= _ERROR_S:
        return None
    at_once = reading.fit_to(made.motion, np.zeros(1), crossed=made.crossed)
    nats = float((made.blocks - at_once.blocks).sum()) / made.motion.moved.size
    return made if nats > LEAST_NATS and compare(made.blocks, at_once.blocks) > CLEAR else None
