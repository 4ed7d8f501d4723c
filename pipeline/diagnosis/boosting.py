"""Gradient boosting: small regression trees, each fitted to what those before it leave.

Squared loss; features are sorted into bins, and a tree splits the leaf that gains most until it has ten.

Source: Friedman, Annals of Statistics 29 (2001); growth by leaf over histograms: LightGBM, Ke et al. 2017.
"""

from __future__ import annotations

import numpy as np

from pipeline.core.arrays import Bytes, Floats, Ints
from pipeline.core.compiled import compiled

_TREES, _RATE = 40, 0.15
# With 48 the same structure was said of 24 answers of recordings, and trees took a quarter longer.
_BINS = 32
_LEAVES = 10
_LEAST_ROWS = 25
_RIDGE = 5.0


def bin_features(features: Floats) -> Bytes:
    """Bins of equal counts by feature, shape (n, f)."""
    shares = np.linspace(0.0, 1.0, _BINS + 1)[1:-1]
    edges = np.quantile(features, shares, axis=0).T
    columns = [np.searchsorted(*pair) for pair in zip(edges, features.T, strict=True)]
    return np.column_stack(columns).astype(np.uint8)


def boost(bins: Bytes, target: Floats, unseen: Bytes) -> Floats:
    """What trees predict where they have not been fitted.

    Args:
        bins: of `bin_features`, where they are fitted, shape (n, f).
        target: there, shape (n,).
        unseen: bins where they predict, shape (m, f).
    """
    middle = float(target.mean())
    predicted = np.full(unseen.shape[0], middle)
    _grow_trees(np.ascontiguousarray(bins), target - middle, np.ascontiguousarray(unseen), predicted)
    return predicted


@compiled("void(uint8[:, ::1], float64[::1], uint8[:, ::1], float64[::1])")
def _grow_trees(bins: Bytes, rest: Floats, unseen: Bytes, predicted: Floats) -> None:
    """Grow trees, each on what those before it leave, and add what they predict.

    Args:
        bins: where they are fitted, shape (n, f).
        rest: what is to be predicted there; what the trees leave of it afterwards, shape (n,).
        unseen: bins where they predict, shape (m, f).
        predicted: there; added to, shape (m,).
    """
    rows, asked = np.arange(bins.shape[0]), np.arange(unseen.shape[0])
    shape = (_LEAVES, bins.shape[1], _BINS)
    # Of every leaf, by feature and bin: how many rows, and the sum of what is left in them.
    count, total = np.zeros(shape), np.zeros(shape)
    begin, end = np.zeros((2, _LEAVES), dtype=np.int64), np.zeros((2, _LEAVES), dtype=np.int64)
    gain, split = np.zeros(_LEAVES), np.zeros(_LEAVES, dtype=np.int64)
    for _ in range(_TREES):
        _tally(bins, rest, rows, count[0], total[0])
        end[0, 0], end[1, 0] = rows.size, asked.size
        gain[0], split[0] = _find_split(count[0], total[0])
        leaves = 1
        while leaves < _LEAVES:
            leaf, new = int(np.argmax(gain[:leaves])), leaves
            if not gain[leaf] > 0.0:
                break
            for side in range(2):
                order, table = (rows, bins) if side == 0 else (asked, unseen)
                inside = order[begin[side, leaf] : end[side, leaf]]
                middle = begin[side, leaf] + _part_rows(inside, table, split[leaf])
                begin[side, new], end[side, new], end[side, leaf] = middle, end[side, leaf], middle
            # What lies in the bins of one side is what the other leaves: the smaller one is counted.
            left, right = end[0, leaf] - begin[0, leaf], end[0, new] - begin[0, new]
            fewer, other = (new, leaf) if right < left else (leaf, new)
            count[other], total[other] = count[leaf], total[leaf]
            _tally(bins, rest, rows[begin[0, fewer] : end[0, fewer]], count[fewer], total[fewer])
            count[other] -= count[fewer]
            total[other] -= total[fewer]
            gain[leaf], split[leaf] = _find_split(count[leaf], total[leaf])
            gain[new], split[new] = _find_split(count[new], total[new])
            leaves += 1
        for leaf in range(leaves):
            value = _RATE * total[leaf, 0].sum() / (end[0, leaf] - begin[0, leaf] + _RIDGE)
            rest[rows[begin[0, leaf] : end[0, leaf]]] -= value
            predicted[asked[begin[1, leaf] : end[1, leaf]]] += value


@compiled("void(uint8[:, ::1], float64[::1], int64[::1], float64[:, ::1], float64[:, ::1])")
def _tally(bins: Bytes, rest: Floats, rows: Ints, count: Floats, total: Floats) -> None:
    """Count some rows, and sum what is left in them, by feature and bin."""
    count[:] = 0.0
    total[:] = 0.0
    for row in rows:
        for feature in range(bins.shape[1]):
            place = bins[row, feature]
            count[feature, place] += 1.0
            total[feature, place] += rest[row]


@compiled("Tuple((float64, int64))(float64[:, ::1], float64[:, ::1])")
def _find_split(count: Floats, total: Floats) -> tuple[float, int]:
    """What the best split of a leaf gains, and the last bin on its left, numbered through all features."""
    rows, whole = count[0].sum(), total[0].sum()
    best, last = -np.inf, 0
    for feature in range(count.shape[0]):
        below, summed = 0.0, 0.0
        for place in range(_BINS):
            below += count[feature, place]
            summed += total[feature, place]
            if min(below, rows - below) < _LEAST_ROWS:
                continue
            gained = summed**2 / (below + _RIDGE) + (whole - summed) ** 2 / (rows - below + _RIDGE)
            if gained > best:
                best, last = gained, feature * _BINS + place
    return best - whole**2 / (rows + _RIDGE), last


@compiled("int64(int64[::1], uint8[:, ::1], int64)")
def _part_rows(rows: Ints, bins: Bytes, split: int) -> int:
    """Put the rows on the left of a split before the others, each side in order; how many they are."""
    feature, last = split // _BINS, split % _BINS
    left, right, count = 0, np.empty_like(rows), 0
    for row in rows:
        if bins[row, feature] <= last:
            rows[left] = row
            left += 1
        else:
            right[count] = row
            count += 1
    rows[left:] = right[:count]
    return left
