"""One time base for all topics of a log.

Every topic has the recorder's log time; most have a header stamp, set at the measurement. Stamps are
preferred, since recording delays do not affect them. A clock that jumps while the recorder's does not is
corrected through the log time; the position of the jump is stored, so that no segment crosses it. Where the
recorder's own clock jumps over hours, all topics are silent at once, and the time between is closed.
"""

import itertools
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np

from pipeline.core import PAUSE_NS, Flags, Floats, Ints, robust_spread
from pipeline.logs import LATEST_NS
from pipeline.recording import clock_maps
from pipeline.recording.findings import Finding, Severity, StageError

Stamps = Ints

DAY_NS = 86_400 * 10**9
"""Stamps [ns] before the second day of 1970 are of a clock that was not set, or has another origin."""
_BACKWARD_NS = 20_000_000
"""A larger step back [ns] is a clock jump: messages of one topic overtake each other by less. Forward steps
need `JUMP_NS`, since delays occur."""
_EARLY_NS = 5_000_000
"""A stamp this much [ns] later than its recording proves two clocks: synchronized ones differ by less."""
_APART_NS = 1_000_000_000
"""Clock difference [ns] above which clocks are joined; a smaller one is a delay, which the gyro or the wheels
measure."""
_AROUND = 20
"""Messages on each side of a jump for the median offset, which single delayed messages do not change."""
_BIN_NS = 500_000_000
"""Width of a bin [ns] in which the messages of a topic are counted."""
_FREQUENT = 4
"""Messages per bin at which twice as many are distinguished from chance."""
_DENSE = 1.6
"""Ratio to the usual number of messages in a bin above which the recorder's clock repeated it: closer to two
than to one."""
_SHARE = 0.8
"""Share of the topics that are dense where the recorder's clock repeated a time."""
_OTHER_RATE = 5e-3
"""Difference in rate that no two real clocks have; simulated time does."""
_BENT_S = 0.3
"""Deviation [s] larger than network delays: the clock itself stopped, or ran faster."""
_AT_ONCE = 0.1
"""Fraction of the period below which two messages were simultaneous."""
_BUNCHED = 0.25
"""Fraction of simultaneous messages above which a bridge delays them: with bunches of two it is a half."""
_PACE_NS = 5e9
"""Time [ns] over which a sender's rate is measured: 25 times a delay of 0.2 s."""
_FEWEST_OF_PACE = 100
"""Least number of messages for the rate: independent ones vary by 10 %, twice `_STEADY`."""
_USUAL_SHARE = 0.99
"""Quantile of gaps between messages that are not holes."""
_STEADY = 0.05
"""Relative variation of a steady rate: bridge delays of .2 s change 5 s by 2 %, random 10 Hz ones by 14 %."""
_HELD_UP_SHARE = 0.95
"""Quantile of delays that is reported: a few are a hole of the network."""
_LEAST_HELD_UP_S = 0.03
"""Least delay of a bunch [s], below a command period: two simultaneous messages are not a bunch."""
_HOLE_PERIODS = 8.0
"""Usual periods that a hole of a slow topic exceeds: bunches of eight cause gaps of as many."""
_CLOSED_NS = 10_000_000_000
"""Length of such a silence [ns] if no stamp tells how long it was: a `arrays.STRETCH_S`, longer than all
waits and holds of a drive, so that nothing crosses it."""
_HOLE_NS = 1_000_000_000
"""Gap [ns] above which a line is interrupted: bridges delay messages by less."""
_TICKS_NS = tuple(
    round(tick * 1e9) for tick in (60.0, 10.0, 1.0, 0.5, 0.25, 0.2, 0.1, 0.05, 0.04, 0.02, 0.01)
)
"""Resolutions [ns] of clocks that are read too coarsely, the coarsest first."""
_ON_TICK_NS = 20_000
"""Distance [ns] of a stamp from a multiple of its clock's resolution: decimals in a double are as near."""
_TOO_COARSE = 2.5
"""Periods of a topic that a resolution lasts from which on stamps do not tell its messages apart."""
_REACH = 25
"""Messages on each side for a line: fifty include several bunches of ten."""


@dataclass(frozen=True)
class Recorded:
    """Times of one topic's messages, in nanoseconds, in log-time order.

    Attributes:
        topic: name of the topic.
        log_time: when the recorder wrote each message.
        publish_time: when it was published.
        header_time: the header's stamp; None for types without one.
        clock: time that the configuration requests; None for an automatic choice.
    """

    topic: str
    log_time: Stamps
    publish_time: Stamps
    header_time: Stamps | None
    clock: str | None = None

    @property
    def is_stamped(self) -> bool:
        """Whether header stamps tell messages apart: some drivers never set them, or set them once."""
        header = self.header_time
        return header is not None and bool(np.ptp(header) if header.size > 1 else header.any())


@dataclass(frozen=True)
class TopicClock:
    """Resulting times of one topic.

    Attributes:
        topic: name of the topic.
        clock: `header`, `log` or `publish`.
        stamp: chosen times [ns] in the common time base, in message order.
        usable: whether each stamp is valid.
        breaks: log times [ns] at which the topic's clock jumped.
        latency_s: median of log time minus stamp.
    """

    topic: str
    clock: str
    stamp: Stamps
    usable: Flags
    breaks: tuple[int, ...] = ()
    latency_s: float = 0.0
    findings: tuple[Finding, ...] = field(default=())


def align_clocks(recorded: Mapping[str, Recorded]) -> tuple[dict[str, TopicClock], list[Finding]]:
    """Choose one time per topic and bring all topics to one time base.

    Args:
        recorded: times of each role's topic, by a key of the caller.

    Returns:
        The clocks by the same keys, and findings.

    Raises:
        StageError: ``no_clock``, the chosen time of a topic stands still.
    """
    recorded, coarse = _leave_coarse_stamps(recorded)
    pauses = find_pauses(times.log_time for times in recorded.values())
    recorded, simulated = _follow_simulated_time(_close_pauses(recorded, pauses))
    recorded, drifts = _take_off_drift(recorded)
    recorded, bunches = _spread_bunches(recorded)
    findings = coarse + simulated + drifts + bunches
    if pauses:
        longest, count = max(after - last for last, after in pauses) / 1e9, len(pauses)
        values = {"kind": "pause of topics in use", "value": longest, "count": count}
        jump = Finding("clock_jump", "warning", "recorder", values)
        findings.insert(0, jump)
    unset = sum(int((times.log_time >= LATEST_NS).sum()) for times in recorded.values())
    if unset:
        findings.insert(
            0, Finding("clock_unset", "warning", "recorder", {"kind": "recorder", "count": unset})
        )
    clocks = {key: _read_clock(times) for key, times in recorded.items()}
    for clock in clocks.values():
        _require_advance(clock)
    findings += [finding for clock in clocks.values() for finding in clock.findings]
    findings += _check_early_stamps(clocks)
    shifted, joined = _join_time_bases(clocks)
    single, repeated = drop_repeated_stamps(shifted)
    return single, findings + joined + repeated


def _leave_coarse_stamps(recorded: Mapping[str, Recorded]) -> tuple[dict[str, Recorded], list[Finding]]:
    """Topics without stamps that are too coarse for their rate: these are no times of their messages."""
    plain, findings = dict(recorded), []
    for key, times in recorded.items():
        tick = _find_tick_ns(times)
        if not tick:
            continue
        plain[key] = replace(times, header_time=None)
        period = float(np.median(np.diff(times.log_time))) / 1e9
        values = {"value": tick / 1e9, "period_s": period}
        findings.append(Finding("coarse_stamps", "warning", times.topic, values))
    return plain, findings


def _find_tick_ns(times: Recorded) -> int:
    """Resolution of a topic's stamps [ns], where it is too coarse for its rate; zero otherwise."""
    header, log = times.header_time, times.log_time
    if header is None or times.clock is not None or not times.is_stamped or log.size < _FEWEST_OF_PACE:
        return 0
    period, distinct = float(np.median(np.diff(log))), np.unique(header).size
    if period <= 0.0 or distinct * _TOO_COARSE > log.size:
        return 0
    off = ((header + tick // 2) % tick - tick // 2 for tick in _TICKS_NS)
    ticks = zip(_TICKS_NS, (float(np.quantile(np.abs(one), _USUAL_SHARE)) for one in off), strict=True)
    return next((tick for tick, far in ticks if far <= _ON_TICK_NS and tick > _TOO_COARSE * period), 0)


def _require_advance(clock: TopicClock) -> None:
    """Refuse a topic whose messages have no time.

    Raises:
        StageError: ``no_clock``.
    """
    times = clock.stamp[clock.usable]
    if times.size >= clock_maps.FEWEST_PIECES and not np.ptp(times):
        which = "stamps" if clock.clock == "header" else f"{clock.clock} times"
        what = f"the {which} of {clock.topic} stand still, and it has no other clock"
        hint = "Record it with a clock that is set, or as a type with a header."
        raise StageError("no_clock", what, where=clock.topic, hint=hint)


def find_pauses(log_times: Iterable[Stamps]) -> list[tuple[int, int]]:
    """Silences longer than a drive's: last log time before and first one after each [ns].

    Args:
        log_times: of every topic [ns], in any order; none of no topic.
    """
    # Each topic is nearly in order: a stable sort merges them.
    log = np.sort(np.concatenate([np.empty(0, dtype=np.int64), *log_times]), kind="stable")
    last = np.flatnonzero(np.diff(log) > PAUSE_NS)
    return list(zip(log[last].tolist(), log[last + 1].tolist(), strict=True))


def _close_pauses(
    recorded: Mapping[str, Recorded], pauses: Sequence[tuple[int, int]]
) -> Mapping[str, Recorded]:
    """Close the silences of a recording, so that nothing depends on how far a clock was set.

    What was recorded before moves towards what follows: a clock that was set is right afterwards. Stamps that
    went on through a silence tell how long it was, and stay.
    """
    closed = dict(recorded)
    for last, after in pauses:
        offsets = {key: _compare_offsets(times, last) for key, times in recorded.items()}
        # Stamps that went on: their offset to the log leaped.
        passed = [after - last + round(off[1] - off[0]) for off in offsets.values() if off is not None]
        known = [one for one in passed if 0 < one < PAUSE_NS]
        shift = after - last - (round(float(np.median(known))) if known else _CLOSED_NS)
        for key, times in recorded.items():
            now, header, off = closed[key], times.header_time, offsets[key]
            moved = np.where(times.log_time <= last, shift, 0)
            stamps = now.header_time
            if header is not None and stamps is not None and times.is_stamped:
                if off is None:
                    stamps = stamps + moved
                elif not 0 < after - last + off[1] - off[0] < PAUSE_NS:
                    # The last stamps of the former clock are recorded by the new one.
                    stamps = stamps + np.where(header - off[0] <= (last + after) / 2.0, shift, 0)
            log_time, publish_time = now.log_time + moved, now.publish_time + moved
            closed[key] = replace(now, log_time=log_time, publish_time=publish_time, header_time=stamps)
    return closed


def _compare_offsets(times: Recorded, last: int) -> tuple[float, float] | None:
    """Offset from log to stamps before and after a silence that begins at ``last`` [ns]; None if unknown."""
    index = int(np.searchsorted(times.log_time, last, side="right"))
    if times.header_time is None or not 0 < index < times.log_time.size:
        return None
    offset = times.header_time - times.log_time
    before, after = offset[max(index - _AROUND, 0) : index], offset[index : index + _AROUND]
    return float(np.median(before)), float(np.median(after))


def _follow_simulated_time(
    recorded: Mapping[str, Recorded],
) -> tuple[Mapping[str, Recorded], list[Finding]]:
    """Log times on the clock of the stamps if its rate differs from the recorder's.

    In simulation stamps count simulated time, which may run slower or faster than the recorder's clock and
    stop intermittently. The topic with most such stamps gives the stamps' clock at every moment; all log
    times are mapped through it, so that topics without stamps fit, and so are stamps that are the recorder's
    time themselves.
    """
    stamped = sorted(
        (times for times in recorded.values() if times.clock is None and times.is_stamped),
        key=lambda times: -times.log_time.size,
    )
    for leading in stamped:
        clock_map = clock_maps.map_clock(leading.log_time, cast("Stamps", leading.header_time))
        if clock_map is not None and _is_simulated(clock_map):
            return _follow(recorded, clock_map, leading.topic)
    return recorded, []


def _is_simulated(clock_map: clock_maps.ClockMap) -> bool:
    """Whether stamps have another rate than the recorder's time, or an uneven rate and another origin."""
    # A leap of the clock changes the rate of the whole run, varying delays change that of its pieces.
    off, span = (
        min(abs(clock_map.usual_rate - 1.0), abs(clock_map.rate - 1.0)),
        float(clock_map.log[-1] - clock_map.log[0]),
    )
    if off >= _OTHER_RATE and off * span >= clock_maps.JUMP_NS:
        return True
    apart = abs(float(np.median(clock_map.log - clock_map.stamp)))
    return apart > DAY_NS and clock_map.bend_s > _BENT_S and not clock_map.leaps


def _follow(
    recorded: Mapping[str, Recorded], clock_map: clock_maps.ClockMap, leading: str
) -> tuple[Mapping[str, Recorded], list[Finding]]:
    mapped, real = {}, []
    for key, times in recorded.items():
        header, log = times.header_time, clock_map.follow(times.log_time)
        if header is not None and times.is_stamped:
            away = [abs(float(np.median(clock - header))) for clock in (times.log_time, log)]
            if away[0] < _APART_NS < away[1]:
                header = clock_map.follow(header)
                real.append(times.topic)
        publish = clock_map.follow(times.publish_time)
        mapped[key] = replace(times, log_time=log, publish_time=publish, header_time=header)
    severity: Severity = "info" if abs(clock_map.rate - 1.0) < _OTHER_RATE else "warning"
    values = {"value": clock_map.rate, "other_topics": real}
    return mapped, [Finding("simulated_time", severity, leading, values)]


def _take_off_drift(recorded: Mapping[str, Recorded]) -> tuple[dict[str, Recorded], list[Finding]]:
    """Stamps at the rate of the recorder's clock, which removes drift between unsynchronized computers.

    If the delays of a topic are too uneven for an estimate, it gets the drift of the others, if compatible.
    """
    headers = {
        key: times.header_time
        for key, times in recorded.items()
        if times.header_time is not None and times.clock is None and times.is_stamped
    }
    counts = {
        key: header > DAY_NS if float(np.median(header)) > DAY_NS else np.ones(header.size, dtype=bool)
        for key, header in headers.items()
    }
    drifts = {
        key: clock_maps.measure_drift(recorded[key].log_time[counts[key]], header[counts[key]])
        for key, header in headers.items()
    }
    known = [drift for drift in drifts.values() if drift.is_certain]
    if not known:
        return dict(recorded), []
    best = min(known, key=lambda drift: drift.scatter)
    findings, steady = [], dict(recorded)
    for key, own in drifts.items():
        # Topics of one computer share one drift, which is estimated best where delays vary least.
        drift = best if own.is_same(best) else own
        if not drift.is_certain:
            continue
        header, used, topic, rate = headers[key], counts[key], recorded[key].topic, drift.rate
        change = np.where(used, np.rint(-rate * (header - drift.find_agreement())), 0.0).astype(np.int64)
        steady[key] = replace(recorded[key], header_time=header + change)
        run_away = abs(rate) * float(np.ptp(header[used])) / 1e9
        findings.append(Finding("clock_drift", "info", topic, {"value": rate * 1e6, "run_s": run_away}))
    return steady, findings


def _spread_bunches(recorded: Mapping[str, Recorded]) -> tuple[dict[str, Recorded], list[Finding]]:
    """Sending times of topics without stamps that a bridge recorded in bunches."""
    findings, even = [], dict(recorded)
    for key, times in recorded.items():
        if times.clock is not None or times.is_stamped:
            continue
        log = _draw_evenly(times.log_time)
        if log is times.log_time:
            continue
        even[key] = replace(times, log_time=log)
        late = _find_held_up_s(times.log_time, log)
        findings.append(Finding("bunched_times", "info", times.topic, {"value": late}))
    return even, findings


def _draw_evenly(log_time: Stamps) -> Stamps:
    """Arrival times of bunched messages at the rate of their sender.

    The messages of a steady sender lie on a line over their number, and a bridge only delays them: the line
    is below all of them. It is estimated for every message from its neighbours, so that it follows the
    sender's rate; holes interrupt it.

    Args:
        log_time: log times of a topic [ns], increasing, shape (n,).

    Returns:
        Times [ns], shape (n,); unchanged if messages did not arrive in bunches.
    """
    gaps = np.diff(log_time).astype(np.float64)
    if gaps.size < _REACH:
        return log_time
    period = float(gaps[gaps <= np.quantile(gaps, _USUAL_SHARE)].mean())
    if float(np.mean(gaps < _AT_ONCE * period)) < _BUNCHED or not _is_steady(log_time, period):
        return log_time
    even = (log_time - log_time[0]).astype(np.float64)
    holes = np.flatnonzero(gaps > max(_HOLE_NS, _HOLE_PERIODS * period)) + 1
    for part in np.split(np.arange(even.size), holes):
        if part.size > 2 * _REACH:
            even[part] = np.minimum(_draw_below(even[part]), even[part])
    spread: Stamps = log_time[0] + np.rint(np.maximum.accumulate(even)).astype(np.int64)
    return spread if _find_held_up_s(log_time, spread) > _LEAST_HELD_UP_S else log_time


def _is_steady(log_time: Stamps, period: float) -> bool:
    """Whether equal numbers of messages take equal times, unlike those of a hand on a joystick."""
    many = max(round(_PACE_NS / period), _FEWEST_OF_PACE) if period > 0.0 else log_time.size
    took = np.diff(log_time[::many]).astype(np.float64)
    if took.size < clock_maps.FEWEST_PIECES:
        return False
    usual = float(np.median(took))
    return robust_spread(took - usual) < _STEADY * usual


def _find_held_up_s(log_time: Stamps, spread: Stamps) -> float:
    """Delay of the bunches [s], a high quantile."""
    return float(np.quantile(log_time - spread, _HELD_UP_SHARE)) / 1e9


def _draw_below(times: Floats) -> Floats:
    number = np.arange(times.size)
    period = float(times[-1] - times[0]) / (times.size - 1)
    above = times - period * number
    windows = np.lib.stride_tricks.sliding_window_view
    least = windows(np.pad(above, _REACH, mode="edge"), 2 * _REACH + 1).min(axis=1)
    # Minimum over the neighbours, then its mean: a smooth line below the messages.
    smooth = windows(np.pad(least, _REACH, mode="edge"), 2 * _REACH + 1).mean(axis=1)
    drawn: Floats = smooth + period * number
    return drawn


def _read_clock(times: Recorded) -> TopicClock:
    """The chosen time of one topic, with jumps corrected."""
    if times.clock == "publish":
        return TopicClock(times.topic, "publish", times.publish_time, times.publish_time > 0)
    header = times.header_time
    if times.clock == "log" or header is None or not times.is_stamped:
        findings: list[Finding] = []
        if header is not None and not times.is_stamped:
            same = "the same" if header.any() else "zero"
            findings.append(Finding("no_header_stamp", "warning", times.topic, {"stamps": same}))
        usable = np.ones(times.log_time.size, dtype=bool)
        return TopicClock(times.topic, "log", times.log_time, usable, findings=tuple(findings))
    stamp, breaks, findings = _mend_jumps(times.topic, header, times.log_time)
    usable, latency = np.ones(stamp.size, dtype=bool), float(np.median(times.log_time - stamp)) / 1e9
    return TopicClock(times.topic, "header", stamp, usable, breaks, latency, tuple(findings))


def _flag_placed(topic: str, count: int) -> Finding:
    return Finding("clock_unset", "warning", topic, {"kind": "stamps", "count": count})


def _mend_jumps(
    topic: str, header: Stamps, log_time: Stamps
) -> tuple[Stamps, tuple[int, ...], list[Finding]]:
    """Shift each stretch of constant clock offset onto the longest one without stamps of the future."""
    if header.size < 2:  # noqa: PLR2004 - one message shows no jump
        return header, (), []
    offset = header - log_time
    # Messages of both clocks may alternate: those of a clock that is not set yet do not end a stretch.
    is_early = (header < DAY_NS) & (np.median(header) > DAY_NS)
    early, known = np.flatnonzero(is_early), np.flatnonzero(~is_early)
    passed, recorded = np.diff(header[known]), np.diff(log_time[known])
    period = float(np.median(passed)) if passed.size else 0.0
    # Messages that a busy recorder writes late have their usual stamps: only the log times jump.
    jumped = np.abs(passed - period) >= np.abs(recorded - period)
    # A delay that ends takes stamps forward, too, but to no time after that of their recording.
    is_far = np.abs(np.diff(offset[known])) > np.where(
        _is_future(offset[known[:-1]], offset[known[1:]]), _BACKWARD_NS, clock_maps.JUMP_NS
    )
    candidates = np.flatnonzero((is_far & jumped) | (passed < -_BACKWARD_NS))
    edges = [0]
    for index in candidates:
        before = np.median(offset[known[max(edges[-1], index + 1 - _AROUND) : index + 1]])
        after = np.median(offset[known[index + 1 : index + 1 + _AROUND]])
        moved = after - before
        least = _BACKWARD_NS if _is_future(before, after) else clock_maps.JUMP_NS
        if moved > least or moved < -_BACKWARD_NS:
            edges.append(int(index) + 1)
    edges.append(known.size)
    spans = [known[a:b] for a, b in itertools.pairwise(edges)]
    usual = [float(np.median(offset[span])) for span in sorted(spans, key=len, reverse=True)]
    right = next((one for one in usual if one <= _EARLY_NS), usual[0])
    stamp = header.copy()
    findings: list[Finding] = []
    largest, jumps = 0.0, 0
    if early.size:
        stamp[early] += round(right - float(np.median(offset[early])))
        findings.append(_flag_placed(topic, early.size))
    for span in spans:
        shift = right - float(np.median(offset[span]))
        if abs(shift) < _BACKWARD_NS:
            continue
        stamp[span] += round(shift)
        if header[span[0]] < DAY_NS < stamp[span[0]]:
            findings.append(_flag_placed(topic, span.size))
        else:
            jumps += 1
            largest = max(largest, abs(shift))
    if jumps:
        values = {"kind": "jump", "value": largest / 1e9, "count": jumps}
        findings.append(Finding("clock_jump", "warning", topic, values))
    breaks = [int(log_time[span[0]]) for span in spans[1:]]
    if early.size and early[-1] + 1 < header.size:
        breaks = sorted({*breaks, int(log_time[early[-1] + 1])})
    return stamp, tuple(breaks), findings


def _is_future(before: Ints | float, after: Ints | float) -> Flags | bool:
    """Whether offsets of stamps [ns] lead from what was recorded after its stamp to what was before it."""
    return (before <= _EARLY_NS) & (after > _EARLY_NS)


def _check_early_stamps(clocks: Mapping[str, TopicClock]) -> list[Finding]:
    """Report stamps later than their recording, which prove that two clocks disagree."""
    return [
        Finding("stamp_after_log_time", "warning", clock.topic, {"value": clock.latency_s})
        for clock in clocks.values()
        if clock.clock == "header" and clock.latency_s * 1e9 < -_EARLY_NS
    ]


def _join_time_bases(
    clocks: dict[str, TopicClock],
) -> tuple[dict[str, TopicClock], list[Finding]]:
    """Join clocks that differ by more than a second, through the log time that all share."""
    stamped = {key: clock for key, clock in clocks.items() if clock.clock == "header"}
    if not stamped:
        return clocks, []
    findings = []
    latencies = sorted(clock.latency_s for clock in stamped.values())
    # Of two clocks the one counts that is nearer to the recorder's.
    home = min(latencies[(len(latencies) - 1) // 2], latencies[len(latencies) // 2], key=abs)
    joined = dict(clocks)
    for key, clock in clocks.items():
        away = clock.latency_s - home
        if abs(away) * 1e9 < _APART_NS:
            continue
        if clock.clock == "header":
            shift = round(away * 1e9)
            values = {"kind": "stamps", "value": away}
        else:
            shift = round(-home * 1e9)
            values = {"kind": "log times", "value": away, "recorder_s": home}
        from pipeline.models import Late, find_late_effect  # noqa: PLC0415 - heavy

        name = find_late_effect(Late.POSES).id
        findings.append(Finding(name, "warning", clock.topic, values))
        joined[key] = replace(clock, stamp=clock.stamp + shift, findings=())
    return joined, findings


def drop_repeated_stamps(
    clocks: Mapping[str, TopicClock],
) -> tuple[dict[str, TopicClock], list[Finding]]:
    """Leave out messages recorded while the recorder's clock repeated a time span.

    When that clock is set back, log times and stamps repeat, and a log sorted by log time mixes both passes.
    The topics are then twice as dense for this span, but for transforms, where one of equal stamps is left.
    The pass of a message is unknown, so messages of both are left out, and the gap ends the segment.
    """
    counts = {
        key: _count_messages(clock.stamp[clock.usable]) for key, clock in clocks.items() if clock.usable.any()
    }
    dense: list[list[int]] = []
    for places, sizes in counts.values():
        usual = float(np.median(sizes))
        if usual >= _FREQUENT:
            dense.append(places[sizes > _DENSE * usual].tolist())
    least = max(2.0, _SHARE * len(dense))
    twice = sorted(
        index for index, count in Counter(itertools.chain.from_iterable(dense)).items() if count >= least
    )
    if not twice:
        return dict(clocks), []
    edges = {index + offset for index in twice for offset in (-1, 0, 1)}
    single = {}
    for key, clock in clocks.items():
        inside = np.isin(clock.stamp // _BIN_NS, sorted(edges))
        single[key] = replace(clock, usable=clock.usable & ~inside)
    seconds = len(twice) * _BIN_NS / 1e9
    values = {"kind": "put back", "value": seconds, "count": 1}
    return single, [Finding("clock_jump", "warning", "recorder", values)]


def _count_messages(stamp: Stamps) -> tuple[Stamps, Ints]:
    """Numbers of the half-second bins that contain messages, and the count of each."""
    places, sizes = np.unique(stamp // _BIN_NS, return_counts=True)
    return places, sizes.astype(np.int64)
