"""Incidents: time spans in which a run does not show a vehicle that follows its commands over the ground."""

from __future__ import annotations

import itertools
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from pipeline.core import arrays
from pipeline.core.arrays import Flags, Floats
from pipeline.core.rigid import find_runs
from pipeline.run import read_wheel_times
from pipeline.run.signals import ANSWERS_S, LIVE_SHARE, MOVING_MPS, STILL_MPS
from pipeline.stages import Finding

if TYPE_CHECKING:
    import polars as pl

    from pipeline.sources import Vehicle
    from pipeline.stages.inputs import Ideal

# Three speeds of the fastest rim are compared: of the command, of the measured wheels, of the body. Each kind
# of incident is a contradiction between them that lasts longer than a lag or a delay. Permanent behaviour of
# a vehicle is physics, not an incident: a command counts as disobeyed only if the run shows that it is
# usually followed, and a contradiction in a large part of the driving is left to the checks of the whole run.

Kind = Literal[
    "emergency_stop", "manual_driving", "pushed", "commands_silent", "stuck", "localization_frozen"
]

_MEANS: Mapping[Kind, str] = {
    "emergency_stop": "the vehicle stood still under live commands: an emergency stop, or the drive was off",
    "manual_driving": "the vehicle drove without a command: by joystick or another controller",
    "pushed": "the body moved while its wheels stood still: it was pushed or carried, or slid",
    "commands_silent": "commands stopped arriving and the vehicle stopped: a watchdog, or a lost connection",
    "stuck": "the wheels turned and the body did not move: it was stuck, dug in, or was lifted",
    "localization_frozen": "the localization repeated one pose while the wheels turned: it was lost",
}

LIVE = 0.25
"""Fraction of the usual largest speed above which a command is live: small ones may not overcome friction."""
_NOTHING = 0.01
"""Fraction of the same speed below which a command is zero."""
_HESITATES = 0.5
"""Fraction of the time of a non-live command, subtracted from the live time: two seconds cancel one."""
_SHOWS_S = 1.0
"""Least duration of a contradiction [s]: a shorter one may be the end of an ordinary motion."""
_COASTS_S = 3.0
"""Time in which drive and body come to rest, including late poses [s]; also left out after an incident."""
_SHARE_OF_GAIN = 0.15
"""Fraction of the usual motion per wheel motion below which wheels have no effect: deep snow halves it."""
_MOSTLY = 0.5
"""Majority: of similar commands at other times that must have moved the vehicle, and of a silence."""
_MOST_COMPARED = 5000
"""Samples that a command is compared with: more add no information, and the time is quadratic."""
_FEWEST_ALIKE = 40
"""Least number of samples of similar commands for a typical value: two seconds of driving."""
_ALIKE = 0.3
"""Relative distance up to which commands are similar."""
_LARGEST_SHARE = 0.3
"""Fraction of the driving above which a contradiction is a property of the run, not an incident."""
_JOINED_S = 1.5
"""Largest gap [s] between pieces of one incident."""
USUAL_S = 300.0
"""Driving time per event of a kind for it to be an incident [s]; more frequent ones are typical."""
_MARGIN_S = 0.5
"""Margin left out before an incident [s]: more than half of the 0.75 s over which poses are differentiated,
by which it appears early in velocities."""
_SMOOTH_S = 0.5
"""Width of a running mean [s], below the 0.75 s over which poses are differentiated."""
_HOLDS = 0.9
"""Fraction of its speed of a second ago that a coasting vehicle cannot retain."""

Span = tuple[Kind, float, float]
"""Kind of an incident, its start and its end [s]."""


@dataclass(frozen=True)
class Incidents:
    """Samples of the grid that are left out, shape (n,), findings, and spans of incidents."""

    excluded: Flags
    findings: tuple[Finding, ...] = field(default=())
    spans: tuple[Span, ...] = field(default=())


@dataclass(frozen=True)
class Rims:
    """Speeds of the fastest rim on the grid [m/s], shape (n,) each.

    Attributes:
        times: [s].
        command: commanded speed, zero without a valid command.
        asked: (f_x, f_y, f_w times half the track) of the command, shape (n, 3).
        is_known: whether a command is valid, or the topic is silent after its first one.
        expired: what the last command asked where it is too old to be valid, else zero, shape (n, 3).
        wheels: measured, NaN where unknown; None without encoders.
        driven: (f_x, f_y, f_w times half the track) of the wheels, zero where unknown, shape (n, 3).
        body: speed of the poses.
        moved: (v_x, v_y, v_w times half the track) of the poses, shape (n, 3).
        top: usual largest speed.
    """

    times: Floats
    command: Floats
    asked: Floats
    is_known: Flags
    expired: Floats
    wheels: Floats | None
    driven: Floats
    body: Floats
    moved: Floats
    top: float

    @property
    def goes_on(self) -> Flags:
        """Whether the vehicle moves as its last command asked, which is too old to be valid."""
        apart = np.linalg.norm((self.moved if self.wheels is None else self.driven) - self.expired, axis=1)
        goes_on: Flags = self.expired.any(axis=1) & (apart < _ALIKE * np.linalg.norm(self.expired, axis=1))
        return goes_on


def find_incidents(
    velocities: pl.DataFrame,
    tables: Mapping[str, pl.DataFrame],
    inputs: Mapping[str, Ideal],
    vehicle: Vehicle,
    hold_s: float | None,
) -> Incidents:
    """Incidents of a run on its grid.

    Args:
        velocities: table `velocities`, of poses alone.
        tables: `poses`, `commands`, `imu` as extracted.
        inputs: ideal velocities by input.
        vehicle: its track converts yaw rates to rim speeds.
        hold_s: how long a command is valid.
    """
    times = velocities["t"].to_numpy()
    rims = gather_rims(velocities, inputs, vehicle)
    nothing = Incidents(np.zeros(times.size, dtype=bool))
    if rims is None:
        return nothing
    incidents: list[Span] = []
    finders = (_find_frozen(rims, tables["poses"]), _find_silent(rims, tables, hold_s))
    taken = np.zeros(times.size, dtype=bool)
    for spans in (*finders, _find_stops(rims), _find_manual(rims), _find_stuck(rims), _find_pushed(rims)):
        for kind, start, end in spans:
            inside = taken[_slice(times, start, end)]
            # Each span is reported once, as the kind that explains it best.
            if inside.size and inside.mean() < _MOSTLY:
                incidents.append((kind, start, end))
                inside[:] = True
    lasting = _report_expired(rims)
    moving = (rims.body > LIVE_SHARE * rims.top) | (rims.command > LIVE * rims.top)
    if taken.sum() > _LARGEST_SHARE * max(int((moving | taken).sum()), 1):
        return replace(nothing, findings=lasting)
    excluded = mark_excluded(times, incidents)
    findings = [
        Finding(
            kind, "warning", f"{_MEANS[kind]}; left out of all fits",
            where="command" if kind == "commands_silent" else "pose" if kind == "localization_frozen" else "",
            t_start=start, t_end=end, value=end - start,
        )
        for kind, start, end in sorted(incidents, key=lambda one: one[1])
    ]  # fmt: skip
    ordered = tuple(sorted(incidents, key=lambda one: one[1]))
    return Incidents(excluded, (*lasting, *findings), ordered)


def _report_expired(rims: Rims) -> tuple[Finding, ...]:
    """Report a vehicle that mostly goes on as its last command asked until the next one comes."""
    stale = np.asarray(rims.expired.any(axis=1), dtype=bool)
    spans, follows = _list_spans(rims.times, stale, _SHOWS_S), rims.goes_on
    lasting = [bool(follows[last]) for _, last in spans]
    if len(spans) < 2 or float(np.mean(lasting)) < _MOSTLY:  # noqa: PLR2004 - one may be chance
        return ()
    stretches = _list_spans(rims.times, follows, 0.0)
    longest = max(float(rims.times[last] - rims.times[first]) for first, last in stretches)
    text = (
        f"in {sum(lasting)} of {len(spans)} pauses the vehicle continues its last command until the next, "
        f"for up to {longest:.1f} s beyond command.hold_s: the base holds its last command; set "
        "command.hold_s to the longest pause to include these stretches"
    )
    return (Finding("kept_command", "warning", text, where="command", value=longest, count=sum(lasting)),)


def mark_excluded(times: Floats, spans: Sequence[Span]) -> Flags:
    """Samples that incidents exclude, shape (n,)."""
    excluded = np.zeros(times.size, dtype=bool)
    for _, start, end in spans:
        excluded[_slice(times, start - _MARGIN_S, end + _COASTS_S)] = True
    return excluded


def gather_rims(velocities: pl.DataFrame, inputs: Mapping[str, Ideal], vehicle: Vehicle) -> Rims | None:
    """Speeds of the rims on the grid; None if the run is too short or without commanded motion."""
    times = velocities["t"].to_numpy()
    if times.size < _FEWEST_ALIKE:
        return None
    half = 0.5 * vehicle.kinematics.turning_width_m(vehicle)
    scale = np.array([1.0, 1.0, half])
    command, measured = inputs.get("command"), inputs.get("measured")
    moved = _smooth(times, velocities.select("v_x", "v_y", "v_w").to_numpy() * scale, _SMOOTH_S)
    asked, known = np.zeros((times.size, 3)), np.zeros(times.size, dtype=bool)
    if command is not None:
        counts = np.asarray(np.isfinite(command.velocity).all(axis=1), dtype=bool)
        asked = np.where(counts[:, None], command.velocity, 0.0) * scale
        known = np.asarray((counts | command.stale) & command.active, dtype=bool)
    driven, wheels = np.zeros((times.size, 3)), None
    if measured is not None:
        # Unknown wheels neither turn nor stand: every comparison with NaN is false.
        wheels = np.abs(measured.velocity * scale).sum(axis=1)
        driven = np.nan_to_num(measured.velocity) * scale
        known = known & np.isfinite(wheels)
    expired = np.zeros((times.size, 3)) if command is None else command.expired * scale
    size = np.abs(asked).sum(axis=1)
    largest = [one[one > 0.02] for one in (size, wheels) if one is not None]  # noqa: PLR2004 - asked at all
    if all(one.size < _FEWEST_ALIKE for one in largest):
        return None
    top = max(float(np.quantile(one, 0.95)) for one in largest if one.size)
    body = np.abs(moved).sum(axis=1)
    return Rims(times, size, asked, known, expired, wheels, driven, body, moved, top)


def _smooth(times: Floats, values: Floats, width_s: float) -> Floats:
    """Running mean over a width [s], shape (n, k)."""
    steps = arrays.count_steps(times, width_s)
    total = np.concatenate((np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)))
    low = np.maximum(np.arange(times.size) - steps // 2, 0)
    high = np.minimum(np.arange(times.size) + steps // 2 + 1, times.size)
    means: Floats = (total[high] - total[low]) / (high - low)[:, None]
    return means


def _slice(times: Floats, start: float, end: float) -> slice:
    """Samples between two times."""
    return slice(int(np.searchsorted(times, start)), int(np.searchsorted(times, end, side="right")))


def _list_spans(times: Floats, flags: Flags, least_s: float) -> list[tuple[int, int]]:
    """Runs of flags of a minimum duration, as first and last sample; none crosses a gap of the grid."""
    hole = np.flatnonzero(np.diff(times) > _JOINED_S) + 1
    spans = []
    for first, end in find_runs(flags):
        inside = hole[np.searchsorted(hole, first, side="right") : np.searchsorted(hole, end)]
        spans += [(a, b - 1) for a, b in itertools.pairwise((first, *inside.tolist(), end))]
    return [(a, b) for a, b in spans if times[b] - times[a] >= least_s]


def _list_within(rims: Rims, outer: Flags, outer_s: float, inner: Flags) -> Iterator[tuple[int, int, int]]:
    """Start of each run of a minimum duration, and first and last sample of the inner flags within it."""
    runs = _list_spans(rims.times, outer, outer_s)
    begins = [first for first, _ in runs]
    for first, last in _list_spans(rims.times, outer & inner, _SHOWS_S):
        index = bisect_right(begins, first) - 1
        if index >= 0 and last <= runs[index][1]:
            yield begins[index], first, last


def _grow(kind: Kind, rims: Rims, lasts: Flags, shows: Flags, seeds: Sequence[tuple[int, int]]) -> list[Span]:
    """Extend incidents from spans in which they are certain.

    Args:
        kind: kind of incident.
        rims: speeds of the run.
        lasts: where it may last, shape (n,).
        shows: where it is visible, shape (n,); start and end of the incident are visible samples.
        seeds: first and last samples of the certain spans, all within `lasts`.
    """
    runs = _list_spans(rims.times, lasts, 0.0)
    begins = [first for first, _ in runs]
    seen: dict[int, list[int]] = {bisect_right(begins, first) - 1: [] for first, _ in seeds}
    for first, last in _list_spans(rims.times, lasts & shows, _SHOWS_S):
        seen.get(bisect_right(begins, first) - 1, []).extend((first, last))
    grown: list[tuple[float, float]] = []
    for start_of in sorted(seen):
        ends = seen[start_of] or runs[start_of]
        start, end = float(rims.times[ends[0]]), float(rims.times[ends[-1]])
        near = bool(grown) and start - grown[-1][1] <= _JOINED_S
        grown[len(grown) - near :] = [(grown[-1][0] if near else start, end)]
    return [(kind, start, end) for start, end in grown]


def _stands(rims: Rims) -> Flags:
    """Whether the vehicle is at rest, by its wheels if measured, and by its poses."""
    if rims.wheels is None:
        still: Flags = rims.body < LIVE_SHARE * rims.top
        return still
    stands: Flags = (rims.wheels < STILL_MPS) & (rims.body < LIVE * rims.top)
    return stands


def _list_disobeyed(rims: Rims, stands: Flags, live: Flags) -> list[tuple[int, int]]:
    """First and last samples of a standstill under at least `ANSWERS_S` of live commands.

    Page's cumulative sum: a live command adds its time and another subtracts half of its time, so that a
    driver's hesitation does not restart the sum.
    """
    weight = np.where(live, 1.0, -_HESITATES)
    spans = []
    for first, last in _list_spans(rims.times, stands & rims.is_known, ANSWERS_S):
        inside = slice(first, last + 1)
        total = np.cumsum(weight[inside] * np.diff(rims.times[inside], prepend=rims.times[first]))
        lowest = np.minimum.accumulate(np.minimum(total, 0.0))
        shown = np.flatnonzero(total - lowest >= ANSWERS_S)
        if shown.size:
            start = int(np.argmin(total[: shown[0] + 1])) if lowest[shown[0]] < 0.0 else 0
            spans.append((first + start, first + int(shown[-1])))
    return spans


def _find_stops(rims: Rims) -> list[Span]:
    """Live commands under which the vehicle stands still, though similar commands move it at other times."""
    stands = _stands(rims)
    live = rims.is_known & (rims.command > LIVE * rims.top)
    stride = max(int(live.sum()) // _MOST_COMPARED, 1)
    others = np.flatnonzero(live)[::stride]
    asked, moves, fewest = rims.asked[others], ~stands[others], _FEWEST_ALIKE / stride
    seeds = []
    for first, last in _list_disobeyed(rims, stands, live):
        most = rims.asked[first + int(np.argmax(rims.command[first : last + 1]))]
        apart = _ALIKE * float(np.linalg.norm(most))
        away = (others < first - _FEWEST_ALIKE) | (others > last + _FEWEST_ALIKE)
        near = away & (np.linalg.norm(asked - most, axis=1) < apart)
        if near.sum() < fewest:
            # A command without similar ones is compared with those that are smaller in every component.
            near = away & (np.abs(asked) <= np.abs(most) + apart).all(axis=1)
        if near.sum() >= max(fewest, 1.0) and float(np.mean(moves[near])) >= _MOSTLY:
            seeds.append((first, last))
    shows = stands & rims.is_known & (rims.command > LIVE_SHARE * rims.top)
    return _grow("emergency_stop", rims, stands, shows, seeds)


def _find_manual(rims: Rims) -> list[Span]:
    """A vehicle that continues to drive, or starts, under zero commands."""
    speed, turns = (rims.body, LIVE) if rims.wheels is None else (rims.wheels, LIVE_SHARE)
    # A vehicle without a watchdog keeps its last command.
    silent = rims.is_known & (rims.command < _NOTHING * rims.top) & ~rims.goes_on
    moving, second = speed > turns * rims.top, arrays.count_steps(rims.times, 1.0)
    shows, seeds = np.zeros(silent.size, dtype=bool), []
    for quiet, first, last in _list_within(rims, silent, ANSWERS_S, moving):
        late = np.arange(first + second, last + 1)
        late = late[rims.times[late] - rims.times[quiet] > ANSWERS_S]
        # A coasting vehicle loses speed; a driven one keeps or gains speed.
        held = (speed[late] >= _HOLDS * speed[late - second]) & (speed[late] > LIVE * rims.top)
        if held.any():
            seeds.append((first, last))
        if held.any() or first > quiet + second or rims.times[last] - rims.times[quiet] > _COASTS_S:
            shows[first : last + 1] = True
    return _grow("manual_driving", rims, silent, shows, seeds)


def _find_stuck(rims: Rims) -> list[Span]:
    """Wheels that turn as usual and bring the body hardly anywhere, which a noisy pose may sway meanwhile."""
    if rims.wheels is None:
        return []
    gains = np.array([measure_gain(rims, axis) for axis in (0, 1, 2)])
    usual = _smooth(rims.times, rims.driven * gains, _SMOOTH_S)
    share, size = _find_share(usual, rims.moved), np.linalg.norm(usual, axis=1)
    turns = (rims.wheels > LIVE * rims.top) & (size > 0.5 * LIVE * rims.top)
    shows = (rims.wheels > LIVE_SHARE * rims.top) & (share < 2.0 * _SHARE_OF_GAIN)
    lasting = turns & (_smooth(rims.times, share[:, None], ANSWERS_S)[:, 0] < _SHARE_OF_GAIN)
    lasts = lasting | (turns & (share < _SHARE_OF_GAIN)) | (rims.body < LIVE_SHARE * rims.top)
    spans = _grow("stuck", rims, lasts, shows, _list_spans(rims.times, lasting, _SHOWS_S))
    return [span for span in spans if span[2] - span[1] >= ANSWERS_S]


def _find_share(brought: Floats, moved: Floats) -> Floats:
    """Share of what wheels bring that a body moves that way, at least half of any: sliding is not stuck."""
    size = np.maximum(np.linalg.norm(brought, axis=1), STILL_MPS)
    along, speed = np.sum(brought * moved, axis=1) / size, np.linalg.norm(moved, axis=1)
    return np.asarray(np.maximum(along, 0.5 * speed) / size, dtype=np.float64)


def measure_gain(rims: Rims, axis: int) -> float:
    """Usual ratio of the body's motion to that of the wheels along an axis; 0 if the wheels never moved."""
    turning = np.abs(rims.driven[:, axis]) > LIVE * rims.top
    if turning.sum() < _FEWEST_ALIKE:
        return 0.0
    return max(float(np.median(rims.moved[turning, axis] / rims.driven[turning, axis])), 0.0)


def _find_pushed(rims: Rims) -> list[Span]:
    """A body that moves after a long standstill of its wheels without commanded motion."""
    if rims.wheels is None:
        return []
    rest = (rims.wheels < STILL_MPS) & (rims.command < _NOTHING * rims.top)
    moves = rest & (rims.body > max(2.0 * LIVE_SHARE * rims.top, MOVING_MPS))
    seeds = [
        (first, last)
        for quiet, first, last in _list_within(rims, rest, _COASTS_S, moves)
        if rims.times[last] - rims.times[quiet] > _COASTS_S
    ]
    return _grow("pushed", rims, moves, moves, seeds)


def _find_silent(rims: Rims, tables: Mapping[str, pl.DataFrame], hold_s: float | None) -> list[Span]:
    """Gaps in commands that request motion, during which the vehicle comes to rest."""
    commands = tables.get("commands")
    if commands is None or commands.is_empty() or hold_s is None:
        return []
    stamps, active = read_wheel_times(commands), commands["active"].to_numpy()
    stands, silent, step = _stands(rims), list[Span](), float(np.median(np.diff(rims.times)))
    for index in np.flatnonzero((np.diff(stamps) > max(hold_s, ANSWERS_S)) & active[:-1]).tolist():
        start, end = float(stamps[index]), float(stamps[index + 1])
        before = rims.command[_slice(rims.times, start - 0.5, start)]
        # Where nothing at all was recorded, nobody knows whether it stood.
        rest = stands[_slice(rims.times, start + 0.5 * (end - start), end)].sum() * step
        asks = before.size > 0 and bool((before > LIVE_SHARE * rims.top).all())
        if asks and rest >= _MOSTLY * 0.5 * (end - start):
            silent.append(("commands_silent", start, end))
    driven = float(np.sum(np.diff(rims.times)[rims.command[1:] > 0.0]))
    return silent if len(silent) <= max(driven / USUAL_S, 1.0) else []


def _find_frozen(rims: Rims, poses: pl.DataFrame) -> list[Span]:
    """Repeats of one pose while the wheels turn."""
    if rims.wheels is None:
        return []
    times, lasts = poses["t"].to_numpy(), np.zeros(rims.times.size, dtype=bool)
    for first, end in find_runs(poses["held"].to_numpy()):
        start, last = times[max(first - 1, 0)], times[end - 1]
        if last - start >= ANSWERS_S:
            lasts[_slice(rims.times, float(start), float(last))] = True
    shows = lasts & (rims.wheels > LIVE_SHARE * rims.top)
    seeds = _list_spans(rims.times, lasts & (rims.wheels > LIVE * rims.top), ANSWERS_S)
    return _grow("localization_frozen", rims, lasts, shows, seeds)
