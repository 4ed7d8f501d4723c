"""Spans in which an encoder reads nothing while the command and the poses go on.

Three signals vote: in every block of half a second the reading of a side follows the poses, or it follows the
command, as where a wheel is blocked or spins; or it follows neither: it repeats a value, or is noise. One
hypothesis holds until the gain in likelihood of another one is worth a change. A span counts where the body
moves as commanded, so that only the encoder can be wrong.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from pipeline.core import Flags, Floats, Ints, find_scale, fit_robustly, list_likelihoods
from pipeline.recording.case import Case
from pipeline.recording.findings import Finding
from pipeline.recording.hypotheses import BLOCK_S, follow_likeliest, price_change
from pipeline.recording.motion import NO_MOTION, STEP_S, Motion, Steps
from pipeline.recording.readings import NO_SIGNAL, SIDES, UNEXPLAINED, Held, Reading
from pipeline.run import LIVE_SHARE
from pipeline.sources import OutageSection

_LEAST = 0.03
"""Fraction of the usual largest speed of a side below which a difference is no contradiction."""
_SILENT_S = 2.0
"""Shortest silence of a side that is told [s]: shorter ones are bridged, or lost messages."""
_FEWEST_BLOCKS = 40
"""Least number of blocks for a judgment: twenty seconds."""
_STILL = 1e-6
"""Speed below which a body stands throughout, for a scale above zero."""
_SMALLEST_PART = 20
"""Least number of blocks of the part of a run in which an encoder may have been alive."""
_PARTS = 8
"""Number of parts of the finest division in which a living encoder is looked for."""
_ALONG = 0.1
"""Extent of a drive across its main direction, of speeds and yaw rates, over that along it, from which on it
tells of both: noise of poses is less."""
_ASIDE = 0.3
"""Part of a drive across its main direction, over its usual size, of which it tells nothing."""
_LEVERS_M = (0.05, 2.0)
"""Distances [m] of a vehicle's middle from its wheels."""
_EXACT = 0.95
"""Share of the readings that are one value, from which on an encoder holds it."""


@dataclass(frozen=True)
class Outage:
    """A span without readings of a side.

    Attributes:
        side: name of the signal, or ``both``.
        start, end: in the time of the motion [s].
        reads: ``nothing``, ``zero``, ``one value`` or ``noise``.
        nats: gain in log-likelihood; infinite where there are no readings at all.
    """

    side: str
    start: float
    end: float
    reads: str
    nats: float


@dataclass(frozen=True)
class _Blocks:
    """Sums of the motion's steps over half a second.

    Attributes:
        steps: the steps.
        label: number of the block of each step.
        elapsed: length of the steps of each block [s], shape (m,).
        begins: first step of each block, shape (m,).
        breaks: whether a block does not follow the one before, shape (m,).
    """

    steps: Steps
    label: Ints
    elapsed: Floats
    begins: Ints
    breaks: Flags

    def average(self, values: Floats) -> Floats:
        """Rates of some increments, shape (m,)."""
        return np.asarray(np.bincount(self.label, values) / self.elapsed, dtype=np.float64)

    def hold_all(self, flags: Flags) -> Flags:
        """Whether all steps of a block have a flag, shape (m,)."""
        return np.asarray(np.bincount(self.label, ~flags) == 0, dtype=bool)

    def spread(self, values: Floats) -> Floats:
        """Columns of a block, of the one before and of the one after it, shape (m, 3 k)."""
        before, after = np.roll(values, 1, axis=0), np.roll(values, -1, axis=0)
        before[self.breaks] = values[self.breaks]
        ends = np.roll(self.breaks, -1)
        after[ends] = values[ends]
        return np.hstack((values, before, after))


def _cut(steps: Steps) -> _Blocks:
    number = np.floor((steps.start - steps.start[0]) / BLOCK_S).astype(np.int64)
    numbers, begins, label = np.unique(number, return_index=True, return_inverse=True)
    elapsed = np.asarray(np.bincount(label, steps.end - steps.start), dtype=np.float64)
    return _Blocks(steps, label, elapsed, begins, np.append(True, np.diff(numbers) > 1))


@dataclass(frozen=True)
class _Follows:
    """How likely each block of a series is if it follows another one, and what it would be there.

    Attributes:
        expected: shape (m,).
        scale: of the noise.
        spanned: whether the blocks of the fit tell what it would be in each block, shape (m,).
    """

    expected: Floats
    scale: float
    spanned: Flags

    def rate(self, values: Floats) -> Floats:
        """Log-likelihood of every block, shape (m,)."""
        return list_likelihoods(values - self.expected, self.scale)


def _fit(columns: Floats, values: Floats, rows: Flags, least: float) -> _Follows:
    made = fit_robustly(columns[rows], values[rows])
    spanned = _find_spanned(columns[:, : columns.shape[1] // 3], rows)
    return _Follows(columns @ made.gains, float(np.hypot(find_scale(made.rest), least)), spanned)


def _find_spanned(moved: Floats, rows: Flags) -> Flags:
    """Whether some blocks drive as each block does, shape (m,): pivots about one wheel do not.

    Args:
        moved: rates ahead and of the heading, shape (m, 2), or of the wheels that are given, shape (m, 1), by
            which alone nothing is dead.
        rows: blocks of which is known how a side turns with them, shape (m,).
    """
    if moved.shape[1] == 1:
        return np.zeros(rows.size, dtype=bool)
    size = np.sqrt((moved**2).mean(axis=0))
    drives = moved / np.where(size > 0.0, size, 1.0)
    _, extent, axes = np.linalg.svd(drives[rows], full_matrices=False)
    unknown = axes[extent < _ALONG * extent[0]]
    aside = np.abs(drives @ unknown.T).max(axis=1, initial=0.0)
    return np.asarray(aside < _ASIDE, dtype=bool)


def find_outages(
    sides: Mapping[str, Held],
    late: tuple[float, float],
    command: Reading,
    motion: Motion,
    track_m: float | None = None,
) -> list[Outage]:
    """Spans in which a side's encoder reads nothing.

    Args:
        sides: readings by name.
        late: lag and delay of the motion after the wheels [s].
        command: fitted to the motion; nothing without one that is followed.
        motion: of the poses; `NO_MOTION` where no pose is recorded.
        track_m: distance of the sides, if it is given: what turns as these wheels would is no dead encoder.
    """
    if motion.is_known:
        steps = motion.steps
    else:
        ends = [one.times[[0, -1]] for one in sides.values()]
        edges = np.arange(min(start for start, _ in ends), max(end for _, end in ends), STEP_S)
        steps = Steps(edges[:-1], edges[1:])
    blocks = _cut(steps)
    if blocks.elapsed.size < _FEWEST_BLOCKS:
        return []
    moved = asked = None
    if motion.is_known:
        moved = _average(motion, blocks)
    known = np.ones(blocks.elapsed.size, dtype=bool)
    if command.explained.is_known:
        made = command.explained
        known = blocks.hold_all(np.logical_and.reduce([one.is_there(steps) for one in command.inputs]))
        columns = command.columns(steps, made.lag, made.delay, crossed=False)
        asked = np.column_stack([blocks.average(one) for one in columns])
    sources = [blocks.spread(one) for one in (moved, asked) if one is not None]
    if not sources:
        # Nothing tells when they should turn.
        return []
    read = {
        name: _read_side(
            name, side, late, blocks, known, [*sources, *_roll_given(name, moved, blocks, track_m)]
        )
        for name, side in sides.items()
    }
    goes_on = None
    if moved is not None and asked is not None:
        goes_on = _rate_going_on(moved, sources[1], known)
    outages: list[Outage] = []
    for name, side in sides.items():
        one, beside = read[name], goes_on
        if one is None:
            # Too little is read for a judgment of it, and silence needs none.
            size = np.abs(sources[0][:, :2]).sum(axis=1)
            outages += _list_silent(name, side, blocks, size, float(np.quantile(size, 0.95)))
            continue
        if beside is None:
            # With one witness alone the other side is the second one.
            others = [other for key, other in read.items() if key != name and other is not None]
            beside = others[0].usual - others[0].broad if others else np.zeros(known.size)
        outages += _list_dead(one, blocks, beside, track_m)
    return _join_sides(sorted(outages, key=lambda one: one.start))


def turns_about(side: str, motion: Motion, track_m: float | None) -> bool:
    """Whether a body turns about the wheels of one side throughout; see `_turns_about`."""
    return motion.is_known and _turns_about(side, _average(motion, _cut(motion.steps)), track_m)


def _average(motion: Motion, blocks: _Blocks) -> Floats:
    """Rates ahead and of the heading in blocks, shape (m, 2)."""
    return np.column_stack([blocks.average(one) for one in (motion.body.real, motion.yaw)])


def _turns_about(side: str, moved: Floats, track_m: float | None) -> bool:
    """Whether a body turns about the wheels of one side: its speed and its yaw rate go together.

    Then wheels that stand explain what it does, and a dead encoder is not needed for it.

    Args:
        side: ``left`` or ``right``.
        moved: rates ahead and of the heading in blocks, shape (m, 2).
        track_m: distance of the sides. The middle is half of it from these wheels, or up to three times that
            where wheels slip to the side in turns. None for any that vehicles have.
    """
    usual = np.quantile(np.abs(moved), 0.95, axis=0, method="nearest") if moved.size else np.zeros(2)
    ahead, turned = moved[(np.abs(moved) > LIVE_SHARE * usual).any(axis=1)].T
    if ahead.size < _SMALLEST_PART or not usual.all():
        return False
    made = fit_robustly(turned[:, None], ahead)
    lever = float(made.gains[0]) * (1.0 if side == "left" else -1.0)
    low, high = _LEVERS_M if track_m is None else (0.25 * track_m, 1.5 * track_m)
    return low < lever < high and find_scale(made.rest) < _ASIDE * find_scale(ahead)


def _roll_given(name: str, moved: Floats | None, blocks: _Blocks, track_m: float | None) -> list[Floats]:
    """Columns of a side that rolls as the body moves, by the track that is given; none without one."""
    if moved is None or track_m is None or name not in SIDES:
        return []
    half = 0.5 * track_m * (1.0 if name == "right" else -1.0)
    return [blocks.spread((moved[:, 0] + half * moved[:, 1])[:, None])]


@dataclass(frozen=True)
class _Side:
    """A side's readings in blocks.

    Attributes:
        name: of the side.
        signal: its readings.
        delay: of the motion after them [s].
        sources: columns of what they may follow.
        values: mean speed, shape (m,).
        there: whether it is read, shape (m,).
        fits: how it follows each source.
        usual: log-likelihood of following the nearest of them, shape (m,).
        broad: that of noise, shape (m,).
        top: usual largest speed.
    """

    name: str
    signal: Held
    delay: float
    sources: Sequence[Floats]
    values: Floats
    there: Flags
    fits: Sequence[_Follows]
    usual: Floats
    broad: Floats
    top: float


def _read_side(
    name: str,
    side: Held,
    late: tuple[float, float],
    blocks: _Blocks,
    known: Flags,
    sources: Sequence[Floats],
) -> _Side | None:
    """How a side follows the sources; None if too little is read, or it follows none in any part."""
    there = blocks.hold_all(side.is_there(blocks.steps)) & known if side.moves else known & False
    if there.sum() < _SMALLEST_PART:
        return None
    values = blocks.average(side.integrate(blocks.steps, *late))
    top = float(np.quantile(np.abs(values[there]), 0.95))
    least = _LEAST * top
    if top == 0.0:
        return None
    broad = list_likelihoods(values, float(np.hypot(find_scale(values[there]), least)))
    fits, gain = _follow_best(values, there, sources, broad, least)
    if gain < price_change(values.size):
        return None
    usual = np.max([one.rate(values) for one in fits], axis=0)
    return _Side(name, side, late[1], sources, values, there, fits, usual, broad, top)


def _join_sides(outages: Sequence[Outage]) -> list[Outage]:
    """Outages in order; those of two sides at once are one."""
    made = list[Outage]()
    for one in outages:
        last = made[-1] if made else one
        apart = max(abs(last.start - one.start), abs(last.end - one.end) if one.end != last.end else 0.0)
        if last.side != one.side and not apart > _SILENT_S:
            made[-1] = Outage(
                "both", min(last.start, one.start), max(last.end, one.end), one.reads, last.nats + one.nats
            )
        else:
            made.append(one)
    return made


def _rate_going_on(moved: Floats, asked: Floats, known: Flags) -> Floats:
    """Gain in likelihood of a body that moves as commanded over one that does not, shape (m,)."""
    gain = np.zeros(known.size)
    for values in moved.T:
        least = _LEAST * float(np.quantile(np.abs(values), 0.95)) + _STILL
        fit = _fit(asked, values, known, least)
        gain += fit.rate(values) - list_likelihoods(values, float(np.hypot(find_scale(values[known]), least)))
    return np.where(known, gain, 0.0)


def _list_dead(one: _Side, blocks: _Blocks, goes_on: Floats, track_m: float | None) -> list[Outage]:
    """Spans in which the readings are none, and silences of a side.

    Args:
        one: the readings in blocks.
        blocks: of the motion.
        goes_on: gain in likelihood where the other signals agree, shape (m,).
        track_m: distance of the sides, if it is given.
    """
    gains = np.column_stack((_rate_repeating(one.values, one.fits), one.broad)) - one.usual[:, None]
    gains[~(one.there & np.any([fit.spanned for fit in one.fits], axis=0))] = 0.0
    price, made = price_change(one.values.size), list[Outage]()
    ends = np.append(blocks.steps.start[blocks.begins], np.inf)
    ends[0] = -np.inf
    for which, part in follow_likeliest(gains, price):
        start, end = float(ends[part.start]) - one.delay, float(ends[part.stop]) - one.delay
        span = _describe(one.name, one.signal, start, end, float(gains[part, which].sum()))
        # A wheel may have turned at one speed before its encoder holds a value.
        inside = (ends[:-1][part] >= span.start + one.delay) & (ends[:-1][part] < span.end + one.delay)
        rows = np.arange(part.start, part.stop)[inside]
        columns = [each[rows] for each in one.sources]
        should_turn = _should_turn(one.fits[0].expected[rows], one.top) and goes_on[rows].sum() > price
        if should_turn and not _follows_otherwise(
            one.values[rows], columns, one.fits, span, 2.0 * price, track_m
        ):
            made.append(span)
    return made + _list_silent(one.name, one.signal, blocks, one.fits[0].expected, one.top)


def _follows_otherwise(
    values: Floats,
    sources: Sequence[Floats],
    fits: Sequence[_Follows],
    outage: Outage,
    price: float,
    track_m: float | None,
) -> bool:
    """Whether a source explains a span by numbers of its own, as on other ground or at a limit.

    Noise is what nothing explains. A value that stands throughout is one that no source has; that of zero is
    explained by no gain at all, but by a body that turns about the wheels that stand.
    """
    if outage.reads == "zero":
        return outage.side in SIDES and _turns_about(outage.side, sources[0][:, :2], track_m)
    # The blocks of each source and those before them, not as many numbers as there are blocks.
    counts = [min(columns.shape[1] // 3 * 2, values.size // 3) for columns in sources]
    rests = [fit_robustly(one[:, :count], values).rest for one, count in zip(sources, counts, strict=True)]
    least = min(one.scale for one in fits)
    if outage.reads == "one value":
        stands = float(_rate_repeating(values, fits).sum())
        return max(float(list_likelihoods(rest, least).sum()) for rest in rests) > stands - price
    plain = float(list_likelihoods(values, float(np.hypot(find_scale(values), least))).sum())
    return any(
        float(list_likelihoods(rest, float(np.hypot(find_scale(rest), least))).sum())
        > plain + 0.5 * count * np.log(values.size)
        for rest, count in zip(rests, counts, strict=True)
    )


def _describe(name: str, side: Held, start: float, end: float, nats: float) -> Outage:
    """The span with the readings that repeat, from the first one on."""
    first, last = np.searchsorted(side.times, (start, end)).tolist()
    kinds, counts = np.unique(side.values[first:last], return_counts=True)
    value = float(kinds[np.argmax(counts)]) if kinds.size else np.nan
    same = side.values == value
    repeats = first + np.flatnonzero(same[first:last])
    # Most readings are the same, and all between the first and the last of them, but for a few.
    if repeats.size < max(2.0, 0.5 * (last - first)) or same[repeats[0] : repeats[-1]].mean() < _EXACT:
        return Outage(name, start, end, "noise", nats)
    first, last = int(repeats[0]), int(repeats[-1]) + 1
    while first > 0 and same[first - 1]:
        first -= 1
    while last < same.size and same[last]:
        last += 1
    start = float(side.times[first]) if first else -np.inf
    end = float(side.times[last]) if last < same.size else np.inf
    return Outage(name, start, end, "zero" if value == 0.0 else "one value", nats)


def _follow_best(
    values: Floats, there: Flags, sources: Sequence[Floats], broad: Floats, least: float
) -> tuple[list[_Follows], float]:
    """How a side follows each source in the part of the run in which it does so best, and by how much.

    An encoder may be dead in most of it: following counts by what it gains over noise and over one value.
    """
    best, most = list[_Follows](), 0.0
    number, divided = np.arange(values.size), 1
    while divided <= _PARTS:
        for part in range(divided):
            rows = there & (number * divided // values.size == part)
            if rows.sum() < _SMALLEST_PART:
                continue
            fits, gain = _rate_following(values, rows, sources, broad, least)
            lives = there & (gain > 0.0)
            if lives.sum() >= _SMALLEST_PART:
                fits, gain = _rate_following(values, lives, sources, broad, least)
            total = float(np.maximum(gain, 0.0)[there].sum())
            if total > most:
                most, best = total, fits
        divided *= 2
    return best, most


def _rate_following(
    values: Floats, rows: Flags, sources: Sequence[Floats], broad: Floats, least: float
) -> tuple[list[_Follows], Floats]:
    """Fits to some blocks, and the gain in likelihood of following over noise and over one value."""
    fits = [_fit(columns, values, rows, least) for columns in sources]
    usual = np.max([one.rate(values) for one in fits], axis=0)
    return fits, usual - np.maximum(broad, _rate_repeating(values, fits))


def _rate_repeating(values: Floats, fits: Sequence[_Follows]) -> Floats:
    """Log-likelihood of every block if it has the value of the one before."""
    return list_likelihoods(np.diff(values, prepend=values[0]), min(one.scale for one in fits))


def _should_turn(expected: Floats, top: float) -> bool:
    """Whether the wheels of a side should turn for long enough in some blocks."""
    return bool((np.abs(expected) > LIVE_SHARE * top).sum() * BLOCK_S > 0.5 * _SILENT_S)


def _list_silent(name: str, side: Held, blocks: _Blocks, expected: Floats, top: float) -> list[Outage]:
    """Silences of a side in which it should turn."""
    steps = blocks.steps
    begins = steps.start[blocks.begins]
    edges = np.concatenate(([steps.start[0]], side.times, [steps.end[-1]]))
    made = []
    for index in np.flatnonzero(np.diff(edges) > _SILENT_S).tolist():
        start, end = edges[index], edges[index + 1]
        inside = (begins >= start) & (begins + BLOCK_S <= end)
        if _should_turn(expected[inside], top):
            is_first, is_last = index == 0, index == side.times.size
            made.append(
                Outage(
                    name,
                    -np.inf if is_first else float(start),
                    np.inf if is_last else float(end),
                    "nothing",
                    np.inf,
                )
            )
    return made


def ask_outages(case: Case) -> Case:
    """Leave out where an encoder reads nothing while all else goes on."""
    wheels = case.wheels
    reading, section = wheels.reading, case.complete().wheels
    if section.ignore is not None or reading.dead_side or not reading.inputs:
        return case
    names = SIDES if reading.form == "sides" else ("both",)
    sides = {
        name: one
        for name, one in zip(names, (reading.first, reading.second), strict=False)
        if one is not NO_SIGNAL
    }
    late = (reading.explained.lag, reading.explained.delay)
    asked = case.command.reading if case.command.is_sure else Reading()
    poses = case.motion if case.has_pose else NO_MOTION
    track_m = case.track_m if reading.form == "sides" else None
    outages = find_outages(sides, late, asked, poses, track_m)
    if not outages:
        return case
    kind = "ackermann" if reading.form == "steering" else "differential"
    table = case.extraction.read_drive(
        wheels.source, section, case.make_unit(wheels.source, kind), held=False
    )
    stamps = table["t"].to_numpy()
    clock = (table["log_time"].to_numpy() - case.extraction.data.index.start_ns) / 1e9
    there = {
        "command": asked.inputs,
        "pose": poses.is_known,
        "other wheels": not (asked.inputs and poses.is_known),
    }
    witnesses = [name for name, is_there in there.items() if is_there]
    stretches, spans = list[dict[str, object]](), []
    for one in outages:
        inside = (stamps >= one.start) & (stamps < one.end)
        columns = [name for name in (*SIDES, "speed") if one.side in {name, "both"}]
        is_read = table.filter(pl.Series(inside)).filter(pl.any_horizontal(pl.col(columns).is_finite()))
        ends = [max(one.start, stamps[0]), *is_read["t"].to_list(), min(one.end, stamps[-1])]
        is_silent = is_read.height < 2 or max(np.diff(ends)) > 0.5 * (ends[-1] - ends[0])  # noqa: PLR2004
        reads = "nothing" if is_silent else one.reads
        start, end = (
            at if np.isinf(at) else float(np.interp(at, stamps, clock)) for at in (one.start, one.end)
        )
        known = {name: at for name, at in (("start_s", start), ("end_s", end)) if np.isfinite(at)}
        stretches.append({"side": one.side, "reads": reads, **known})
        # In hundredths, which the line of the text has as well.
        first = None if np.isinf(start) else float(np.floor(1e2 * start) / 1e2)
        last = None if np.isinf(end) else float(np.ceil(1e2 * end) / 1e2)
        spans.append(OutageSection(side=one.side, start_s=first, end_s=last))  # type: ignore[arg-type]
    case.changes.setdefault("wheels", {})["ignore"] = spans
    values = {
        "count": len(outages),
        "stretches": stretches,
        "witnesses": witnesses,
        "line": f"ignore = {write_spans(spans)}",
    }
    begin = None if np.isinf(outages[0].start) else outages[0].start
    case.findings.append(Finding("encoder_dead", "warning", "wheels", values, t_start=begin))
    # What it was fitted by is wrong.
    unread = replace(wheels, reading=replace(reading, explained=UNEXPLAINED))
    return replace(case, wheels=unread).read_again(
        "ackermann" if reading.form == "steering" else "differential"
    )


def write_spans(spans: Sequence[OutageSection]) -> str:
    """As a line of TOML."""
    parts = []
    for one in spans:
        ends = {"start_s": one.start_s, "end_s": one.end_s}
        keys = [f'side = "{one.side}"', *(f"{key} = {at:.10g}" for key, at in ends.items() if at is not None)]
        parts.append(f"{{{', '.join(keys)}}}")
    return f"[{', '.join(parts)}]"
