"""Compared parts of a run: displacements, predictions over two seconds, first and last stretches."""

from dataclasses import dataclass, replace

import numpy as np

from pipeline.core import LONGEST_WAIT_S, ROUNDING_S, Complex, Flags, Floats, Ints, compiled
from pipeline.run.heading import Grid, has_excluded
from pipeline.run.motion_run import MotionError, MotionRun, Track
from pipeline.run.signals import HORIZON_S, SPAN_S, DriveSeries, Signal, find_fastest_wheel

# Models are compared by displacements over half a second and predictions over two seconds from a pose.
#
# Poses are averaged to nodes; windows connect nodes of one segment. No window crosses a gap, a jump, a bad
# stretch or the end of an interval with live commands.

NODE_S = 0.25
"""Step between means of poses [s]: windows overlap by half."""
STEP_S = 0.2
"""Step of the increments that models are fitted to [s]: of half a second they say little of delays, and of a
tenth nothing else."""
_LONGEST_STEP_S = 0.75
"""Longest increment [s]: three of the nodes of dense poses."""
_GATHER_S = 0.066
"""Half-width of the mean over poses [s]: of three poses at 20 Hz, which reduces noise, but no motion of half
a second."""
_DENSE_S = 0.08
"""Median period of poses [s] above which they are not averaged: 0.13 s would contain one or two."""
_LEAD_S = 0.5
"""Start of a span that is not compared without encoders [s], as the state of the drive is unknown: that of a
lag of 0.5 s decays to a third."""
_LEAST_LEAD_S = 0.02
"""`_LEAD_S` with encoders [s], after the delay of the poses: two of their periods at 100 Hz, one at 50 Hz."""
_SHORTEST_BLOCK_S = 5.0
"""Shortest block [s]: several times the correlation time of residuals (about a second)."""
_LONGEST_BLOCK_S = 12.0
"""Longest block [s]: a longer one is divided into pieces of at least half of it, so that a run of one command
step has folds, too."""


@dataclass(frozen=True)
class Nodes:
    """Groups of poses whose mean is one measurement.

    Attributes:
        poses: indices into the track of all members, shape (m,).
        first: index in `poses` of the first member of each group, shape (n,).
        count: members of each group, shape (n,).
        times: mean stamp of each group [s], shape (n,).
        piece: number of the stretch without segment end or gap, shape (n,).
    """

    poses: Ints
    first: Ints
    count: Ints
    times: Floats
    piece: Ints

    def average(self, values: Signal) -> Signal:
        """Mean over each group of values at `poses`."""
        if self.poses.size == self.first.size:
            return values
        sums: Signal = np.add.reduceat(values, self.first)
        return sums / self.count


@dataclass(frozen=True)
class Windows:
    """Pairs of nodes about half a second apart.

    Attributes:
        start, end: node indices, shape (n,).
        span_s: time between them [s], shape (n,).
        block: number of the block (command step) of each, shape (n,).
        times: start and end [s], shape (n, 2).
    """

    start: Ints
    end: Ints
    span_s: Floats
    block: Ints
    times: Floats


@dataclass(frozen=True)
class Horizons:
    """Predictions of up to two seconds: one row per predicted node.

    Attributes:
        origin: start node of the prediction, shape (n,).
        node: predicted node, shape (n,).
        number: number of the prediction, shape (n,).
        block: block of the prediction's start, shape (n,).
        times: start of the prediction and its end, shape (n, 2).
    """

    origin: Ints
    node: Ints
    number: Ints
    block: Ints
    times: Floats


def gather_nodes(track: Track, grid: Grid) -> Nodes:
    """Group poses: means over 0.13 s every quarter of a second, or single poses if they are rare."""
    span = grid.find_span(track.times)
    cut = (np.diff(track.segment) != 0) | (np.diff(span) != 0)
    piece = np.concatenate(([0], np.cumsum(cut)))
    period = np.diff(track.times)[~cut]
    usable = (span >= 0) & track.active
    if period.size == 0 or float(np.median(period)) > _DENSE_S:
        poses = np.flatnonzero(usable)
        each = np.ones(poses.size, dtype=np.int64)
        return Nodes(poses, np.arange(poses.size), each, track.times[poses], piece[poses])
    begin = track.times[np.searchsorted(piece, np.arange(int(piece[-1]) + 1))]
    since = track.times - begin[piece] - _GATHER_S
    raster = np.round(since / NODE_S)
    member = usable & (np.abs(since - raster * NODE_S) <= _GATHER_S) & (raster >= 0)
    poses = np.flatnonzero(member)
    if poses.size == 0:
        return Nodes(poses, poses, poses, track.times[poses], poses)
    label = piece[poses] * 1_000_000 + raster[poses].astype(np.int64)
    first = np.flatnonzero(np.concatenate(([True], np.diff(label) != 0)))
    count = np.diff(np.append(first, poses.size))
    times = np.add.reduceat(track.times[poses], first) / count
    return Nodes(poses, first, count, times, piece[poses][first])


def number_blocks(run: MotionRun, grid: Grid) -> Floats:
    """Starts of blocks [s]: command steps, short ones joined, long ones divided; and spans."""
    hard = grid.starts
    soft = run.step_starts
    starts: list[float] = []
    for begin, end in zip(hard.tolist(), grid.ends.tolist(), strict=True):
        inside = soft[(soft > begin) & (soft < end)]
        begins = [begin]
        for step in inside.tolist():
            if step - begins[-1] >= _SHORTEST_BLOCK_S and end - step >= _SHORTEST_BLOCK_S:
                begins.append(step)
        for first, last in zip(begins, [*begins[1:], end], strict=True):
            parts = (
                max(int((last - first) // (_LONGEST_BLOCK_S / 2.0)), 1)
                if last - first > _LONGEST_BLOCK_S
                else 1
            )
            starts += [first + (last - first) * k / parts for k in range(parts)]
    return np.array(starts)


def find_lead(run: MotionRun, delay_s: float) -> float:
    """Time after the start of a span that is not compared [s].

    With encoders, the wheel speeds at the start are known, and only the delay of the poses must pass: delayed
    poses report earlier motion. Without encoders, the state of the drive must settle first.
    """
    return _LEAD_S if run.wheels is None else max(delay_s, 0.0) + _LEAST_LEAD_S


def join_windows(run: MotionRun, grid: Grid, nodes: Nodes, lead_s: float) -> Windows:
    """All windows of half a second, a quarter of a second apart where poses are dense."""
    start = np.arange(nodes.times.size)
    at = np.searchsorted(nodes.times, nodes.times + SPAN_S)
    before = np.clip(at - 1, 0, nodes.times.size - 1)
    after = np.clip(at, 0, nodes.times.size - 1)
    nearer = np.abs(nodes.times[after] - nodes.times - SPAN_S) < np.abs(
        nodes.times[before] - nodes.times - SPAN_S
    )
    end = np.where(nearer, after, before)
    length = nodes.times[end] - nodes.times
    mask = (length > 0.6 * SPAN_S) & (length < 1.5 * SPAN_S)
    mask &= _is_clean(run, grid, nodes, (start, end), lead_s)
    start, end = start[mask], end[mask]
    times = np.column_stack((nodes.times[start], nodes.times[end]))
    blocks = number_blocks(run, grid)
    block = np.searchsorted(blocks, times.mean(axis=1), side="right") - 1
    return Windows(start, end, times[:, 1] - times[:, 0], block, times)


def join_steps(run: MotionRun, grid: Grid, nodes: Nodes, lead_s: float) -> Windows:
    """Increments from node to node that do not overlap, each from where the one before ends."""
    period = float(np.median(np.diff(nodes.times))) if nodes.times.size > 1 else STEP_S
    least, chain = STEP_S - 0.3 * period, [0]
    for index in range(1, nodes.times.size):
        is_cut = nodes.piece[index] != nodes.piece[chain[-1]]
        if is_cut or nodes.times[index] - nodes.times[chain[-1]] >= least:
            chain.append(index)
    start, end = np.array(chain[:-1], dtype=np.int64), np.array(chain[1:], dtype=np.int64)
    mask = nodes.times[end] - nodes.times[start] < _LONGEST_STEP_S
    mask &= _is_clean(run, grid, nodes, (start, end), lead_s)
    start, end = start[mask], end[mask]
    times = np.column_stack((nodes.times[start], nodes.times[end]))
    return Windows(start, end, times[:, 1] - times[:, 0], np.zeros(start.size, dtype=np.int64), times)


def join_horizons(run: MotionRun, grid: Grid, nodes: Nodes, lead_s: float) -> Horizons:
    """Consecutive predictions of two seconds."""
    ends = nodes.times + HORIZON_S
    last = np.searchsorted(nodes.times, ends + 0.13, side="right") - 1
    origin = np.arange(nodes.times.size)
    whole = (nodes.piece[last] == nodes.piece) & (nodes.times[last] > ends - 0.3)
    whole &= _is_clean(run, grid, nodes, (origin, last), lead_s)
    chosen, next_start = [], -np.inf
    for index in np.flatnonzero(whole).tolist():
        if nodes.times[index] >= next_start - ROUNDING_S:
            chosen.append(index)
            next_start = nodes.times[last[index]]
    picked = np.array(chosen, dtype=np.int64)
    counts = (last[picked] - picked) if picked.size else np.zeros(0, dtype=np.int64)
    number = np.repeat(np.arange(picked.size), counts)
    origins = picked[number]
    offset = np.arange(number.size) - np.repeat(np.cumsum(counts) - counts, counts) + 1
    node = origins + offset
    blocks = number_blocks(run, grid)
    times = np.column_stack((nodes.times[origins], nodes.times[last[origins]]))
    block = np.searchsorted(blocks, times.mean(axis=1), side="right") - 1
    return Horizons(origins, node, number, block, times)


def _is_clean(run: MotionRun, grid: Grid, nodes: Nodes, ends: tuple[Ints, Ints], lead_s: float) -> Flags:
    """Whether a stretch lies in one piece, without excluded times and the start of its span."""
    start, end = ends
    begin, stop = nodes.times[start], nodes.times[end]
    clean = (nodes.piece[start] == nodes.piece[end]) & ~has_excluded(run.excluded, begin, stop)
    span = np.clip(grid.find_span(begin), 0, grid.starts.size - 1)
    late_enough: Flags = clean & (begin - grid.starts[span] >= lead_s)
    return late_enough


_STANDING = 0.02
"""Share of the fastest speed below which wheels are at rest."""


def find_driven(run: MotionRun, driven_s: float) -> float:
    """Stamp [s] after a duration of driving [s]: wheels turn or are commanded to, and poses are known.

    Raises:
        MotionError: ``too_short``: the run contains less driving.
    """
    times = run.track.times[run.track.active]
    steps = np.diff(times)
    counts = steps < LONGEST_WAIT_S
    series = run.commands or run.wheels
    if series is not None and times.size:
        speed = find_fastest_wheel(series)
        held = np.maximum(np.searchsorted(series.times, times[1:], side="right") - 1, 0)
        counts &= speed[held] > _STANDING * speed.max()
    done = np.cumsum(np.where(counts, steps, 0.0))
    index = int(np.searchsorted(done, driven_s))
    if index >= done.size:
        what = f"it was driven for {done[-1] if done.size else 0.0:.0f} s, not for {driven_s:g} s"
        raise MotionError("too_short", what, where=run.name, hint="Take less of it, or drive longer.")
    return float(times[index + 1])


def cut_run(run: MotionRun, begin_s: float = -np.inf, end_s: float = np.inf) -> MotionRun:
    """The run with only the poses between two stamps [s]; earlier inputs are still known.

    Recorded series end with the stretch: a fit to the first seconds of a run uses nothing of the rest, except
    the alignment of its clocks.
    """
    track = run.track
    counts = track.active & (track.times >= begin_s) & (track.times <= end_s)
    streams = run.streams[run.streams <= end_s]
    commands, wheels = (
        None if series is None else _cut_series(series, end_s) for series in (run.commands, run.wheels)
    )
    track = replace(track, active=counts)
    return replace(run, track=track, streams=streams, commands=commands, wheels=wheels)


def _cut_series(series: DriveSeries, end_s: float) -> DriveSeries:
    rows = series.times <= end_s
    return series.change(series.times[rows], lambda signal: signal[rows])


def find_gaps(
    x: Floats,
    y: Floats,
    w: Floats,
    heading: Complex,
    step_s: float,
    index: Ints,
    beyond: Floats,
    first: Ints,
    start: Ints,
    end: Ints,
    frame: Complex,
    moved: Complex,
    turned: Floats,
    span_s: Floats,
) -> Floats:
    """Measured minus predicted displacement of windows between nodes, divided by their length.

    Args:
        x: predicted velocity forward on cells [m/s], shape (n,).
        y: to the left [m/s], shape (n,).
        w: predicted yaw rate [rad/s], shape (n,).
        heading: unit vectors along the measured heading on cells, shape (n,).
        step_s: width of a cell.
        index: cell edge before every pose, shape (m,).
        beyond: share of the cell between that edge and the pose, shape (m,).
        first: first pose of every node, shape (k,).
        start: node at which every window begins, shape (b,).
        end: node at which it ends, shape (b,).
        frame: rotation from the map to the frame of the window, shape (b,).
        moved: measured displacement in that frame [m], shape (b,).
        turned: measured change of heading [rad], shape (b,).
        span_s: length of the window [s], shape (b,).

    Returns:
        x, y [m/s] and w [rad/s], shape (b, 3).
    """
    gaps = np.empty((start.size, 3))
    path, angle = np.empty(x.size + 1, dtype=np.complex128), np.empty(x.size + 1)
    nodes, turns = np.empty(first.size, dtype=np.complex128), np.empty(first.size)
    _integrate(x, y, w, heading, step_s, path, angle)
    _average_nodes(path, angle, index, beyond, first, nodes, turns)
    _find_gaps(nodes, turns, start, end, frame, moved, turned, span_s, gaps)
    return gaps


@compiled(
    "void(float64[::1], float64[::1], float64[::1], complex128[::1], float64, complex128[::1], float64[::1])"
)
def _integrate(
    x: Floats, y: Floats, w: Floats, heading: Complex, step_s: float, path: Complex, angle: Floats
) -> None:
    """Path and angle at cell edges."""
    position, turn = 0j, 0.0
    path[0], angle[0] = position, turn
    for cell in range(x.size):
        position += complex(x[cell], y[cell]) * heading[cell] * step_s
        turn += w[cell] * step_s
        path[cell + 1], angle[cell + 1] = position, turn


@compiled(
    "void(complex128[::1], float64[::1], int64[::1], float64[::1], int64[::1], complex128[::1], float64[::1])"
)
def _average_nodes(
    path: Complex, angle: Floats, index: Ints, beyond: Floats, first: Ints, reached: Complex, faced: Floats
) -> None:
    """Mean of path and angle over the poses of every node."""
    for node in range(first.size):
        until = first[node + 1] if node + 1 < first.size else index.size
        position, turn = 0j, 0.0
        for pose in range(first[node], until):
            at, share = index[pose], beyond[pose]
            position += path[at] + share * (path[at + 1] - path[at])
            turn += angle[at] + share * (angle[at + 1] - angle[at])
        reached[node] = position / (until - first[node])
        faced[node] = turn / (until - first[node])


@compiled(
    "void(complex128[::1], float64[::1], int64[::1], int64[::1], complex128[::1], complex128[::1], "
    "float64[::1], float64[::1], float64[:, ::1])"
)
def _find_gaps(
    reached: Complex,
    faced: Floats,
    start: Ints,
    end: Ints,
    frame: Complex,
    moved: Complex,
    turned: Floats,
    span_s: Floats,
    gaps: Floats,
) -> None:
    """See `find_gaps`."""
    for row in range(start.size):
        gap = moved[row] - frame[row] * (reached[end[row]] - reached[start[row]])
        gaps[row, 0] = gap.real / span_s[row]
        gaps[row, 1] = gap.imag / span_s[row]
        gaps[row, 2] = (turned[row] - (faced[end[row]] - faced[start[row]])) / span_s[row]


def average_spans(
    signal: Floats,
    step_s: float,
    first: Ints,
    into_first: Floats,
    last: Ints,
    into_last: Floats,
    width_s: Floats,
) -> Floats:
    """Mean of a signal on cells over windows.

    Args:
        signal: on cells, shape (n,).
        step_s: width of a cell.
        first: cell in which every window begins, shape (b,).
        into_first: share of that cell before the start of the window, shape (b,).
        last: cell in which every window ends, shape (b,).
        into_last: share of that cell before the end of the window, shape (b,).
        width_s: length of every window [s], shape (b,).

    Returns:
        Shape (b,).
    """
    total, means = np.empty(signal.size + 1), np.empty(first.size)
    _average_spans(signal, step_s, first, into_first, last, into_last, width_s, total, means)
    return means


@compiled(
    "void(float64[::1], float64, int64[::1], float64[::1], int64[::1], float64[::1], float64[::1], "
    "float64[::1], float64[::1])"
)
def _average_spans(
    signal: Floats,
    step_s: float,
    first: Ints,
    into_first: Floats,
    last: Ints,
    into_last: Floats,
    width_s: Floats,
    total: Floats,
    means: Floats,
) -> None:
    """See `average_spans`; ``total`` takes the integral at cell edges."""
    summed = 0.0
    total[0] = summed
    for cell in range(signal.size):
        summed += signal[cell] * step_s
        total[cell + 1] = summed
    for row in range(first.size):
        begin, stop = first[row], last[row]
        before = total[begin] + into_first[row] * (total[begin + 1] - total[begin])
        after = total[stop] + into_last[row] * (total[stop + 1] - total[stop])
        means[row] = (after - before) / width_s[row]
