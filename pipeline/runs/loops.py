"""Compiled loops over the cells of a run: what a velocity on cells comes to at poses and over windows."""

import numpy as np

from pipeline.core.arrays import Complex, Floats, Ints
from pipeline.core.compiled import compiled


@compiled(
    "float64[:, ::1](float64[::1], float64[::1], float64[::1], complex128[::1], float64, int64[::1], "
    "float64[::1], int64[::1], int64[::1], int64[::1], complex128[::1], complex128[::1], float64[::1], "
    "float64[::1])"
)
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
    """Measured less predicted displacement of windows between nodes, over their length.

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
        frame: turns the map into the frame of the window, shape (b,).
        moved: measured displacement in that frame [m], shape (b,).
        turned: measured change of heading [rad], shape (b,).
        span_s: length of the window [s], shape (b,).

    Returns:
        x, y [m/s] and w [rad/s], shape (b, 3).
    """
    cells = x.size
    path, angle = np.empty(cells + 1, dtype=np.complex128), np.empty(cells + 1)
    place, turn = 0j, 0.0
    path[0], angle[0] = place, turn
    for cell in range(cells):
        place += complex(x[cell], y[cell]) * heading[cell] * step_s
        turn += w[cell] * step_s
        path[cell + 1], angle[cell + 1] = place, turn
    nodes = first.size
    reached, faced = np.empty(nodes, dtype=np.complex128), np.empty(nodes)
    for node in range(nodes):
        until = first[node + 1] if node + 1 < nodes else index.size
        place, turn = 0j, 0.0
        for pose in range(first[node], until):
            at, share = index[pose], beyond[pose]
            place += path[at] + share * (path[at + 1] - path[at])
            turn += angle[at] + share * (angle[at + 1] - angle[at])
        reached[node] = place / (until - first[node])
        faced[node] = turn / (until - first[node])
    gaps = np.empty((start.size, 3))
    for row in range(start.size):
        gap = moved[row] - frame[row] * (reached[end[row]] - reached[start[row]])
        gaps[row, 0] = gap.real / span_s[row]
        gaps[row, 1] = gap.imag / span_s[row]
        gaps[row, 2] = (turned[row] - (faced[end[row]] - faced[start[row]])) / span_s[row]
    return gaps


@compiled(
    "float64[::1](float64[::1], float64, int64[::1], float64[::1], int64[::1], float64[::1], float64[::1])"
)
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
        into_first: share of that cell that lies before it, shape (b,).
        last: cell in which every window ends, shape (b,).
        into_last: share of that cell that lies before its end, shape (b,).
        width_s: length of every window [s], shape (b,).

    Returns:
        Shape (b,).
    """
    total = np.empty(signal.size + 1)
    summed = 0.0
    total[0] = summed
    for cell in range(signal.size):
        summed += signal[cell] * step_s
        total[cell + 1] = summed
    means = np.empty(first.size)
    for row in range(first.size):
        begin, stop = first[row], last[row]
        before = total[begin] + into_first[row] * (total[begin + 1] - total[begin])
        after = total[stop] + into_last[row] * (total[stop + 1] - total[stop])
        means[row] = (after - before) / width_s[row]
    return means
