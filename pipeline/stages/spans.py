"""Spans of a run in which the wheels do not follow the command, or the body does not follow its wheels.

Each of the two pairs is fitted over the whole run, robustly: lags, gains, limits and slip that a large part
of the drive has belong to the fit. A block of half a second follows, or it stands still, or it moves in
another direction, or it moves in any way: one hypothesis holds until the gain in likelihood of another one
is worth a change. The price of a change is the only threshold. Which pair disagrees, and what moves, says
what it was.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np
import polars as pl

from pipeline.core import (
    LOG_PEAK,
    Flags,
    Floats,
    find_runs,
    find_scale,
    fit_robustly,
    list_likelihoods,
    number_stretches,
    recur,
)
from pipeline.recording import BLOCK_S, LASTS_NATS, Finding, follow_likeliest, price_change
from pipeline.run import ANSWERS_S, LIVE_SHARE, STILL_MPS
from pipeline.sources import Vehicle
from pipeline.stages.inputs import Ideal
from schemas.run_tables import EVENT_KINDS

Kind = Literal[
    "stopped", "side_stopped", "manual_driving", "pushed", "commands_silent", "stuck",
    "localization_frozen", "rotated", "lost", "outlier",
]  # fmt: skip

_BAD_POSES = ("rotated", "lost")

LIVE = 0.25
"""Fraction of the usual largest speed above which a command is live: it overcomes friction."""
_SAME = 0.03
"""Fraction of the usual largest speed below which a difference is no contradiction."""
_ENDS_NATS = -math.log(1.0 - math.exp(-LASTS_NATS))
"""Price of the end of a span [nats], with which its length has the probability that `LASTS_NATS` means.

While the source drives, what a fit does not know lasts, too: there the end costs as much as the start.
"""
_FEWEST_BLOCKS = 40
"""Least number of blocks for a fit of eighteen coefficients."""
_FEWEST_AT_REST = 8
"""Least number of blocks at rest for the noise at rest: two of them are below their quartile."""
_QUARTILE = 0.3186
"""Lower quartile of absolute values of normal noise [standard deviations]: more than half of the time at rest
may be pushed."""
_LEAST_AT_REST = 0.1 * STILL_MPS
"""Least noise at rest [m/s]: a fit to the whole drive expects as much of a vehicle that stands."""
_FRICTIONS = (0.0, 0.1, 0.15, 0.2, 0.25, 0.3)
"""Fractions of the usual largest speed up to which a command may not overcome friction: the likeliest."""
_TINY = 1e-3
"""See `fit_robustly`: what a short run does not determine stays small."""
_SLOW_S = 1.0
"""Time constant of the slowest of the lags that a fit mixes [s]."""
_COASTS_S = 3.0
"""Time in which drive and body come to rest, including late poses [s]; also left out after an incident."""
_MARGIN_S = 0.5
"""Margin left out before an incident [s]: more than half of the 0.75 s over which poses are differentiated,
by which it appears early in velocities."""
USUAL_S = 300.0
"""Driving time per event of a kind for it to be an incident [s]; more frequent ones are typical."""


class Span(NamedTuple):
    """A contradiction of poses, wheels and commands.

    Attributes:
        kind: of it.
        start, end: [s].
        value: its gain in log-likelihood; of an outlier its size over the least one.
    """

    kind: Kind
    start: float
    end: float
    value: float


@dataclass(frozen=True)
class Spans:
    """Contradictions of a run.

    Attributes:
        wrong: samples of the grid with wrong poses, shape (n,).
        excluded: samples with an incident, or about one, shape (n,).
        findings: on all of them.
        incidents: what happened to the vehicle, in order.
    """

    wrong: Flags
    excluded: Flags
    findings: tuple[Finding, ...] = field(default=())
    incidents: tuple[Span, ...] = field(default=())


@dataclass(frozen=True)
class Rims:
    """Speeds on the grid, as (x, y, w times half the track) [m/s], shape (n, 3) each.

    Attributes:
        times: [s], shape (n,).
        asked: by the command, zero without a valid one.
        is_known: whether a command is valid, or the topic is silent after its first one, shape (n,).
        expired: by the last command where it is too old to be valid, else zero.
        driven: by the measured wheels, NaN where unknown; None without encoders.
        moved: by the poses.
        top: usual largest speed of the fastest rim.
    """

    times: Floats
    asked: Floats
    is_known: Flags
    expired: Floats
    driven: Floats | None
    moved: Floats
    top: float


def gather_rims(velocities: pl.DataFrame, inputs: Mapping[str, Ideal], vehicle: Vehicle) -> Rims | None:
    """Speeds of the rims on the grid; None without commanded or measured motion."""
    times = velocities["t"].to_numpy()
    scale = np.array([1.0, 1.0, 0.5 * vehicle.kinematics.turning_width_m(vehicle)])
    command, measured = inputs.get("command"), inputs.get("measured")
    asked = expired = np.zeros((times.size, 3))
    known = np.zeros(times.size, dtype=bool)
    if command is not None:
        counts = np.asarray(np.isfinite(command.velocity).all(axis=1), dtype=bool)
        asked, expired = np.where(counts[:, None], command.velocity, 0.0) * scale, command.expired * scale
        known = np.asarray((counts | command.stale) & command.active, dtype=bool)
    driven = None if measured is None else measured.velocity * scale
    sizes = [np.abs(one).sum(axis=1) for one in (asked, driven) if one is not None]
    moving = [one[one > STILL_MPS] for one in sizes if (one > STILL_MPS).any()]
    if not moving:
        return None
    top = max(float(np.quantile(one, 0.95)) for one in moving)
    moved = velocities.select("v_x", "v_y", "v_w").to_numpy() * scale
    return Rims(times, asked, known, expired, driven, moved, top)


def mark_spans(times: Floats, spans: Sequence[Span], *, before_s: float = 0.0, after_s: float = 0.0) -> Flags:
    """Times in some spans, or up to some time before or after one, shape (n,)."""
    inside = np.zeros(times.size, dtype=bool)
    for one in spans:
        inside |= (times >= one.start - before_s) & (times <= one.end + after_s)
    return inside


def mark_incidents(times: Floats, incidents: Sequence[Span]) -> Flags:
    """Samples that incidents exclude, shape (n,)."""
    return mark_spans(times, incidents, before_s=_MARGIN_S, after_s=_COASTS_S)


def find_spans(
    velocities: pl.DataFrame,
    poses: pl.DataFrame,
    inputs: Mapping[str, Ideal],
    vehicle: Vehicle,
    hold_s: float | None,
) -> Spans:
    """Contradictions of a run.

    Args:
        velocities: table `velocities`, of poses alone.
        poses: table `poses` as extracted.
        inputs: ideal velocities by input.
        vehicle: its track converts yaw rates to rim speeds.
        hold_s: how long a command is valid.
    """
    times = velocities["t"].to_numpy()
    rims = gather_rims(velocities, inputs, vehicle)
    if rims is None:
        nothing = np.zeros(times.size, dtype=bool)
        return Spans(nothing, nothing)
    blocks = _Blocks(rims.times)
    spans, findings = _compare_command(rims, blocks, vehicle, hold_s)
    if rims.driven is not None:
        spans += _compare_wheels(rims, blocks, poses)
    spans.sort(key=lambda one: one.start)
    incidents = tuple(one for one in spans if one.kind in EVENT_KINDS)
    bad = [one for one in spans if one.kind not in EVENT_KINDS]
    wrong = mark_spans(times, bad)
    if bad:
        findings.append(_report_poses(bad, wrong, rims))
    about = {"commands_silent": "command", "localization_frozen": "pose"}
    findings += [
        Finding(
            one.kind,
            "warning",
            about.get(one.kind, ""),
            {"value": one.end - one.start},
            t_start=one.start,
            t_end=one.end,
        )
        for one in incidents
    ]
    return Spans(wrong, mark_incidents(times, incidents), tuple(findings), incidents)


def _report_poses(bad: Sequence[Span], wrong: Flags, rims: Rims) -> Finding:
    driven = np.zeros(1) if rims.driven is None else np.abs(np.nan_to_num(rims.driven)).sum(axis=1)
    share = float(wrong.sum() / max(int((driven > LIVE_SHARE * rims.top).sum()), 1))
    seconds = {kind: sum(one.end - one.start for one in bad if one.kind == kind) for kind in _BAD_POSES}
    values = {"value": share, "count": len(bad), "seconds": seconds}
    return Finding("bad_stretch", "warning", "pose", values, t_start=bad[0].start)


class _Blocks:
    """Blocks of the grid, none across a gap.

    Attributes:
        start, end: times of the first and the last sample [s], shape (m,).
        is_first: whether the block follows a gap, shape (m,).
        is_whole: whether the block is no small piece, shape (m,).
    """

    def __init__(self, times: Floats) -> None:
        period = float(np.median(np.diff(times)))
        # Where the poses jump, two segments may overlap.
        breaks = np.append(True, np.abs(np.diff(times) - period) > 0.5 * period)
        number = number_stretches(times - times[0], BLOCK_S)
        begins = np.flatnonzero(breaks | np.append(True, np.diff(number) != 0))
        self._begins, self._sizes = begins, np.diff(np.append(begins, times.size))
        self.start, self.end = times[begins], times[begins + self._sizes - 1]
        self.is_first = breaks[begins]
        self.is_whole = self._sizes > 0.5 * BLOCK_S / period

    def average(self, values: Floats) -> Floats:
        """Means of some columns, shape (m, k)."""
        return np.asarray(np.add.reduceat(values, self._begins) / self._sizes[:, None], dtype=np.float64)

    def hold_all(self, flags: Flags) -> Flags:
        """Whether all samples of a block have all of some flags, shape (m,)."""
        return np.asarray(np.logical_and.reduceat(flags.all(axis=1), self._begins), dtype=bool)

    def delay(self, values: Floats) -> Floats:
        """Values of the block before, of the same one after a gap, shape (m, k)."""
        before = np.roll(values, 1, axis=0)
        before[self.is_first] = values[self.is_first]
        return before

    def follow(self, values: Floats) -> Floats:
        """Values after a first-order lag, shape (m, k)."""
        share = float(np.exp(-BLOCK_S / _SLOW_S))
        return recur(
            np.where(self.is_first[:, None], values, (1.0 - share) * values),
            np.where(self.is_first[1:], 0.0, share),
        )

    def list_columns(self, source: Floats, top: float, friction: float) -> Floats:
        """What may follow from a source, shape (m, k).

        Args:
            source: shape (m, 3).
            top: its usual largest size.
            friction: speed of a side up to which it may differ, as a fraction of that.
        """
        sides = np.column_stack((source[:, 0] - source[:, 2], source[:, 0] + source[:, 2]))
        now = np.hstack((source, np.where(np.abs(sides) > friction * top, sides, 0.0)))
        before = self.delay(now)
        ahead, turned = source[:, :1], source[:, 2:] / top
        product = np.hstack((ahead * turned, ahead * np.abs(turned), np.abs(ahead) * turned))
        return np.hstack((now, before, self.follow(before), product))

    @property
    def price(self) -> float:
        """See `price_change`."""
        return price_change(self.start.size)

    def measure_rest(self, source: Floats, is_known: Flags) -> Floats:
        """Time [s] for which a source has been at rest at the start of every block, shape (m,)."""
        moves = (np.abs(source).sum(axis=1) > STILL_MPS) | ~is_known | self.is_first
        index = np.arange(moves.size)
        since = index - 1 - np.maximum.accumulate(np.where(moves, index, -1))
        return np.asarray(BLOCK_S * np.maximum(since, 0), dtype=np.float64)


@dataclass(frozen=True)
class _Fit:
    """How a target follows a source.

    Attributes:
        top: usual largest size of the source.
        friction: speed of a side up to which its motion differs, as a fraction of that.
        gains: coefficients of `_Blocks.list_columns`, shape (k, 3).
        target, expected: shape (m, 3).
        scale: of the noise, that at rest where the source has been at rest, shape (m, 3).
        spread: of the target itself, shape (3,).
        is_judged: blocks in which both are known, shape (m,).
        rests: blocks in which the source has been at rest, shape (m,).
    """

    top: float
    friction: float
    gains: Floats
    target: Floats
    expected: Floats
    scale: Floats
    spread: Floats
    is_judged: Flags
    rests: Flags

    @property
    def total(self) -> float:
        """Log-likelihood of all that is judged."""
        return float(self.likelihood(self.expected)[self.is_judged].sum())

    def likelihood(self, expected: Floats) -> Floats:
        """Log-likelihood of every block if something is expected, shape (m,)."""
        return np.asarray(
            sum(list_likelihoods(self.target[:, i] - expected[:, i], self.scale[:, i]) for i in range(3))
        )

    def compare(self) -> Floats:
        """Log-likelihood of other hypotheses less that of following, shape (m, 4).

        The target stands; it moves in any way; each of its parts does this or that; or its length follows,
        and its direction does not.
        """
        still, broad = (
            np.column_stack([list_likelihoods(self.target[:, i], one[:, i]) for i in range(3)])
            for one in (self.scale, np.broadcast_to(self.spread, self.scale.shape))
        )
        # Any direction is as likely, and the length is what follows.
        length, usual = (np.hypot(one[:, 0], one[:, 1]) for one in (self.target, self.expected))
        turned = (
            list_likelihoods(length - usual, self.scale[:, 0])
            - np.log(2.0 * np.pi * np.maximum(usual, self.scale[:, 0]))
            - LOG_PEAK
            + list_likelihoods(self.target[:, 2] - self.expected[:, 2], self.scale[:, 2])
        )
        parts = (still, broad, np.maximum(still, broad))
        made = np.column_stack((*(one.sum(axis=1) for one in parts), turned))
        follows = self.likelihood(self.expected)
        # What comes to rest, and stands, follows.
        follows = np.where(self.rests, np.maximum(follows, made[:, 0]), follows)
        return np.where(self.is_judged[:, None], made - follows[:, None], 0.0)

    def compare_sides(self) -> Floats:
        """The same if one side stands and the other one follows, for the right and the left, shape (m, 2)."""
        follows, (ahead, aside, turned) = self.likelihood(self.expected), self.expected.T
        rims = (0.5 * (ahead - turned), 0.5 * (ahead + turned))
        made = [
            self.likelihood(np.column_stack((rim, aside, sign * rim)))
            for rim, sign in zip(rims, (-1, 1), strict=True)
        ]
        return np.where(self.is_judged[:, None], np.column_stack(made) - follows[:, None], 0.0)


def _fit(
    blocks: _Blocks, source: Floats, target: Floats, is_known: Flags, *, is_command: bool
) -> _Fit | None:
    """Fit what a target usually does of a source; None with too little motion."""
    is_judged = is_known & blocks.is_whole
    if is_command:
        # After a gap nobody knows what its state was.
        is_judged &= ~blocks.is_first & np.append(False, is_known[:-1])
    size = np.abs(source).sum(axis=1)
    if not (size > STILL_MPS).any():
        return None
    top = float(np.quantile(size[size > STILL_MPS], 0.95))
    moves = size + np.abs(target).sum(axis=1) > 2.0 * _SAME * top
    rows = is_judged & (np.convolve(moves, np.ones(3))[1:-1] > 0.0)
    if rows.sum() < _FEWEST_BLOCKS:
        return None
    values, least = target[rows], _SAME * top
    spread = np.array([np.hypot(find_scale(values[:, i]), least) for i in range(3)])
    rest = blocks.measure_rest(source, is_judged)
    stands = target[rest >= _COASTS_S]
    at_rest, rests = np.full(3, np.inf), rest >= ANSWERS_S
    if len(stands) >= _FEWEST_AT_REST:
        at_rest = np.maximum(np.quantile(np.abs(stands), 0.25, axis=0) / _QUARTILE, _LEAST_AT_REST)
    fits = []
    for friction in _FRICTIONS if is_command else _FRICTIONS[:1]:
        columns = blocks.list_columns(source, top, friction)
        made = [
            fit_robustly(columns[rows], values[:, i], measure=find_scale, least=least, ridge=_TINY)
            for i in range(3)
        ]
        gains, moving = np.column_stack([one.gains for one in made]), np.array([one.scale for one in made])
        expected = columns @ gains
        # Of what comes to rest as much is unknown as is expected to be left of its motion.
        settling = np.minimum(np.hypot(at_rest, expected), moving)
        scale = np.where(rests[:, None], settling, moving)
        fits.append(_Fit(top, friction, gains, target, expected, scale, spread, is_judged, rests))
    return max(fits, key=lambda one: one.total)


_LONG_PAUSE_S = 2.0
"""Pause of a command from which on what moves the vehicle may be another command, and no way to a stop."""


def _moves_otherwise(
    blocks: _Blocks, asked: Floats, last: Floats, target: Floats, is_known: Flags, inside: Flags
) -> bool:
    """Whether in the pauses of a command the target follows neither the last one nor a stop.

    Args:
        blocks: of the run.
        asked: shape (m, 3).
        last: what was asked last, in the pauses, shape (m, 3).
        target: shape (m, 3).
        is_known: blocks in which the target is known, shape (m,).
        inside: those of the pauses.
    """
    usual = _fit(blocks, asked, target, is_known & ~inside, is_command=True)
    if usual is None or not inside.any():
        return False
    likelihoods = []
    for source in (asked, asked + last):
        expected = blocks.list_columns(source, usual.top, usual.friction) @ usual.gains
        beside = replace(usual, expected=expected, is_judged=inside).compare()
        likelihoods.append(float(beside[:, 1].sum()))
    return min(likelihoods) > blocks.price


def _compare_command(
    rims: Rims, blocks: _Blocks, vehicle: Vehicle, hold_s: float | None
) -> tuple[list[Span], list[Finding]]:
    """Spans in which the wheels, or the body without encoders, do not follow the command."""
    measured = rims.moved if rims.driven is None else rims.driven
    known = blocks.hold_all(np.column_stack((rims.is_known, np.isfinite(measured))))
    target = blocks.average(np.nan_to_num(measured))
    asked, last = blocks.average(rims.asked), blocks.average(rims.expired)
    fit = _fit(blocks, asked, target, known, is_command=True)
    if fit is None:
        return [], []
    silent: Flags = np.asarray(rims.expired.any(axis=1), dtype=bool)
    pauses = [(float(rims.times[a]), float(rims.times[b - 1])) for a, b in find_runs(silent)]
    spans, findings = list[Span](), list[Finding]()
    if pauses:
        # Does the base keep its last command, or does it stop?
        keeps = _fit(blocks, asked + last, target, known, is_command=True)
        longest = max(end - start for start, end in pauses)
        inside = known & (np.abs(last).sum(axis=1) > 0.0)
        if longest > _LONG_PAUSE_S and _moves_otherwise(blocks, asked, last, target, known, inside):
            values = {"value": longest, "count": len(pauses)}
            findings.append(Finding("commanded_otherwise", "warning", "command", values))
        elif keeps is not None and keeps.total - fit.total > blocks.price:
            fit, asked = keeps, asked + last
            whole = math.ceil(10.0 * ((hold_s or 0.0) + longest) + 1.0) / 10.0
            values = {"value": longest, "count": len(pauses), "hold_s": whole}
            findings.append(Finding("kept_command", "warning", "command", values))
        elif hold_s is not None:
            spans += _list_silent(rims, blocks, fit, asked + last, pauses, hold_s)
    has_sides = rims.driven is not None and vehicle.kinematics.has_inputs("left", "right")
    for one in _list_contradictions(blocks, fit, asked, has_sides=has_sides):
        if one.motion == "stands" and one.is_driven:
            spans.append(Span("stopped", one.start, one.end, one.nats))
        elif one.motion == "stands on one side" and one.is_driven:
            spans.append(Span("side_stopped", one.start, one.end, one.nats))
        elif not one.is_driven:
            spans.append(Span("manual_driving", one.start, one.end, one.nats))
    return spans, findings


class _Contradiction(NamedTuple):
    """A span in which a target does not follow its source.

    Attributes:
        start, end: [s].
        nats: gain in log-likelihood.
        is_driven: whether the source moves.
        motion: ``stands``, ``stands on one side``, ``turned`` (of the usual length), ``longer`` or
            ``shorter``: the likeliest.
    """

    start: float
    end: float
    nats: float
    is_driven: bool
    motion: str


def _list_contradictions(
    blocks: _Blocks, fit: _Fit, source: Floats, *, has_sides: bool = False
) -> list[_Contradiction]:
    gains, made = fit.compare(), []
    halves = fit.compare_sides() if has_sides else gains[:, :0]
    size = np.abs(source).sum(axis=1)
    parts = [part for _, part in follow_likeliest(gains[:, 2:], blocks.price)]
    at_rest = np.where(size[:, None] > LIVE_SHARE * fit.top, -blocks.price, gains[:, 2:])
    short = [part for _, part in follow_likeliest(at_rest, blocks.price, _ENDS_NATS)]
    parts += [one for one in short if not any(one.start < at.stop and at.start < one.stop for at in parts)]
    for part in parts:
        first, last = part.start, part.stop - 1
        stands, free, mixed, turned = gains[part].T
        # Where it shows, not where both stand.
        shown = np.maximum(np.maximum(mixed, turned), 0.0)
        moved, usual = (np.hypot(one[part, 0], one[part, 1]).sum() for one in (fit.target, fit.expected))
        is_driven = float(shown @ size[part]) > LIVE_SHARE * fit.top * float(shown.sum())
        if not is_driven:
            if _wanders(fit.target[part], fit.top):
                continue
            moves = part.start + np.flatnonzero(np.abs(fit.target[part]).sum(axis=1) > STILL_MPS)
            first, last = int(moves[0]), int(moves[-1])
        free_as = "longer" if moved > usual else "shorter"
        sums = {"stands": stands.sum(), free_as: free.sum(), "turned": turned.sum()}
        sums["stands on one side"] = max(halves[part].sum(axis=0), default=-np.inf)
        made.append(
            _Contradiction(
                float(blocks.start[first]),
                float(blocks.end[last]),
                float(max(mixed.sum(), turned.sum())),
                is_driven,
                max(sums, key=lambda one: sums[one]),
            )
        )
    return made


def _wanders(moved: Floats, top: float) -> bool:
    """Whether the poses of a vehicle at rest wander: they are slow, and they go nowhere.

    Args:
        moved: velocities of the blocks of a span, shape (m, 3).
        top: usual largest size of the source.
    """
    sizes = np.linalg.norm(moved, axis=1)
    if sizes.mean() < STILL_MPS:
        return True
    goes = float(np.linalg.norm(moved.mean(axis=0))) > 0.5 * float(sizes.mean())
    return not goes and bool(sizes.mean() < LIVE_SHARE * top)


def _list_silent(
    rims: Rims,
    blocks: _Blocks,
    fit: _Fit,
    asked: Floats,
    pauses: Sequence[tuple[float, float]],
    hold_s: float,
) -> list[Span]:
    """Pauses of the commands in which the vehicle stopped; none if that is its usual end of a motion."""
    goes_on = fit.likelihood(blocks.list_columns(asked, fit.top, fit.friction) @ fit.gains)
    stops = np.where(fit.is_judged, fit.likelihood(np.zeros_like(asked)) - goes_on, 0.0)
    total = np.append(0.0, np.cumsum(stops))
    silent = []
    for start, end in pauses:
        first, last = np.searchsorted(blocks.start, (start, end))
        nats = float(total[last] - total[first])
        if nats > 2.0 * blocks.price:
            silent.append(Span("commands_silent", start - hold_s, end, nats))
    driven_s = BLOCK_S * float((np.abs(fit.target).sum(axis=1) > LIVE_SHARE * rims.top).sum())
    return silent if len(silent) <= max(driven_s / USUAL_S, 1.0) else []


def _compare_wheels(rims: Rims, blocks: _Blocks, poses: pl.DataFrame) -> list[Span]:
    """Spans in which the body does not follow its wheels."""
    driven = np.zeros((rims.times.size, 3)) if rims.driven is None else rims.driven
    known = blocks.hold_all(np.isfinite(driven))
    source, asked = blocks.average(np.nan_to_num(driven)), blocks.average(rims.asked)
    moved = blocks.average(rims.moved)
    fit = _fit(blocks, source, moved, known, is_command=False)
    spans = list[Span]()
    for one in _list_contradictions(blocks, fit, source) if fit is not None else ():
        kind: Kind | None = None
        part = slice(*np.searchsorted(blocks.start, (one.start, one.end)))
        if not one.is_driven:
            # Wheels that are locked under a command slide.
            kind = None if np.abs(asked[part]).sum(axis=1).mean() > LIVE_SHARE * rims.top else "pushed"
        elif one.motion == "stands":
            kind = "localization_frozen" if _is_frozen(poses, one.start, one.end) else "stuck"
            brought, made = (np.abs(at[part].sum(axis=0)).sum() for at in (moved, source))
            # Wheels that spin bring less, and yet the body goes or turns somewhere.
            kind = None if kind == "stuck" and brought > LIVE_SHARE * made else kind
        elif one.motion != "shorter":
            # Wheels that spin bring less, which is no fault of the poses.
            kind = "rotated" if one.motion == "turned" else "lost"
        if kind is not None:
            spans.append(Span(kind, one.start, one.end, one.nats))
    return spans


def _is_frozen(poses: pl.DataFrame, start: float, end: float) -> bool:
    """Whether most of a span has no pose but one."""
    times = poses["t"].to_numpy()
    fresh = np.concatenate(([start], times[~poses["held"].to_numpy()], [end]))
    inside = fresh[(fresh >= start) & (fresh <= end)]
    return bool(np.max(np.diff(np.sort(inside))) > 0.5 * (end - start))
