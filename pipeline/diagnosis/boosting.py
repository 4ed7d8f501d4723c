"""Gradient boosting: small regression trees, each fitted to what those before it leave.

Squared loss; features are sorted into bins, and a tree splits the leaf that gains most until it has ten.

Source: Friedman, Annals of Statistics 29 (2001); growth by leaf over histograms: LightGBM, Ke et al. 2017.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.arrays import Floats, Ints

if TYPE_CHECKING:
    from collections.abc import Iterator

_TREES, _RATE = 40, 0.15
_BINS = 48
_LEAVES = 10
_LEAST_ROWS = 25
_RIDGE = 5.0
_UP_TO = np.triu(np.ones((_BINS, _BINS)))


def bin_features(features: Floats) -> Ints:
    """Bins of equal counts by feature, numbered through all features, shape (n, f)."""
    shares = np.linspace(0.0, 1.0, _BINS + 1)[1:-1]
    edges = np.quantile(features, shares, axis=0).T
    columns = [np.searchsorted(*pair) for pair in zip(edges, features.T, strict=True)]
    return np.column_stack(columns) + _BINS * np.arange(features.shape[1])


def boost(bins: Ints, target: Floats, unseen: Ints) -> Floats:
    """What trees predict where they have not been fitted.

    Args:
        bins: of `bin_features`, where they are fitted, shape (n, f).
        target: there, shape (n,).
        unseen: bins where they predict, shape (m, f).
    """
    rest, everywhere = target - target.mean(), np.arange(target.size)
    predicted = np.full(unseen.shape[0], target.mean())
    for _ in range(_TREES):
        whole = _Leaf(bins, rest, everywhere, _tally(bins, rest, everywhere))
        for leaf, rows in _grow(whole, unseen, np.arange(predicted.size)):
            predicted[rows] += _RATE * leaf.value
            rest[leaf.rows] -= _RATE * leaf.value
    return predicted


@dataclass(frozen=True)
class _Leaf:
    """A leaf of a tree.

    Attributes:
        bins: of all rows.
        rest: what is left of the target, of all rows.
        rows: of the leaf.
        tally: how many of them, and the sum of what is left, by bin, shape (2, b).
    """

    bins: Ints
    rest: Floats
    rows: Ints
    tally: Floats

    @property
    def value(self) -> float:
        """What the leaf predicts."""
        return float(self.rest[self.rows].sum()) / (self.rows.size + _RIDGE)

    @cached_property
    def best(self) -> tuple[float, int]:
        """What the best split gains, and the last bin on its left."""
        count, total = self.tally.reshape(2, -1, _BINS) @ _UP_TO
        others, beyond = count[:, -1:] - count, total[:, -1:] - total
        gain = total**2 / (count + _RIDGE) + beyond**2 / (others + _RIDGE)
        gain[np.minimum(count, others) < _LEAST_ROWS] = -np.inf
        place = int(gain.argmax())
        return float(gain.flat[place]) - float(total[0, -1]) ** 2 / (count[0, -1] + _RIDGE), place

    def split(self) -> tuple[_Leaf, _Leaf]:
        """Both sides of the best split; what lies in the bins of one is what the other leaves."""
        place = self.best[1]
        left = self.bins[self.rows, place // _BINS] <= place
        sides = [self.rows[left], self.rows[~left]]
        fewer = int(sides[1].size < sides[0].size)
        counted = _tally(self.bins, self.rest, sides[fewer])
        tallies = (self.tally - counted, counted) if fewer else (counted, self.tally - counted)
        one, other = (_Leaf(self.bins, self.rest, *side) for side in zip(sides, tallies, strict=True))
        return one, other


def _tally(bins: Ints, rest: Floats, rows: Ints) -> Floats:
    found, size = bins.take(rows, axis=0).ravel(), bins.shape[1] * _BINS
    weights = np.repeat(rest[rows], bins.shape[1])
    return np.array([np.bincount(found, w, size) for w in (None, weights)])


def _grow(whole: _Leaf, unseen: Ints, rows: Ints) -> Iterator[tuple[_Leaf, Ints]]:
    """Leaves of a tree, each with the unseen rows that fall into it."""
    leaves = [(whole, rows)]
    while len(leaves) < _LEAVES:
        chosen = max(range(len(leaves)), key=lambda place: leaves[place][0].best[0])
        if not leaves[chosen][0].best[0] > 0.0:
            break
        leaf, inside = leaves.pop(chosen)
        place = leaf.best[1]
        left = unseen[inside, place // _BINS] <= place
        leaves += zip(leaf.split(), (inside[left], inside[~left]), strict=True)
    yield from leaves
