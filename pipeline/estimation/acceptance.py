"""The one test of whether a larger model is better: evidence, stability, and a size that matters."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.identification.parts import count_seconds

if TYPE_CHECKING:
    from pipeline.estimation.noise import Noise
    from pipeline.identification.parts import Part
    from pipeline.identification.weights import Weights

LEAST_T = 5.0
"""Evidence that names an effect, in standard errors: the largest t of some 30 candidates on logs without any
effect stays below it (`make hidden-effect CATEGORY=empty`)."""
STABLE_T = 0.5 * LEAST_T
"""Evidence that must remain without the ten seconds that contribute most: nothing is named by one event."""
LEAST_GAIN = 0.01
"""Share of the loss that an effect must take away: less is not felt in a prediction."""
DECIDED_T = 2.0
"""Standard errors by which one of two rivals must be better to be chosen beyond chance."""
_CLIP = 6.0
_CLUSTER = 4
"""Windows of half a second whose scores may depend on each other: two seconds."""


@dataclass(frozen=True)
class Improvement:
    """How much better a larger model is.

    Attributes:
        t: evidence for its additional numbers, in standard errors.
        t_stable: the same without the ten-second stretch that contributes most.
        gain: share of the smaller model's loss that it takes away.
    """

    t: float
    t_stable: float
    gain: float

    @property
    def share(self) -> float:
        """Share of the evidence that is asked."""
        return min(self.t / LEAST_T, self.t_stable / STABLE_T)

    @property
    def is_significant(self) -> bool:
        """Whether it is better beyond doubt, throughout, and by enough to matter."""
        return self.gain >= LEAST_GAIN and self.share >= 1.0


def compare(
    noise: Noise, weights: Weights, before: Floats, after: Floats, *, numbers: int = 1, shapes: int = 1
) -> Improvement:
    """Compare two models, the second of which has more numbers.

    Innovations under one noise model are compared; their variance may differ from stretch to stretch, since
    a vehicle that stands is quieter than one that turns (White, Econometrica 48, 1980).

    Args:
        noise: of the residuals.
        weights: under which the loss is measured.
        before: residuals of the first model, shape (n, 3).
        after: of the second one.
        numbers: how many more numbers the second has.
        shapes: of how many the second is the best one: the largest of as many chi-squares by chance is paid.
    """
    by_stretch = measure_evidence(noise, before, after)
    total = float(by_stretch.sum())
    free = max(numbers - 1, 0) + 2.0 * math.log(shapes)
    stable = total - float(by_stretch.max(initial=0.0))
    gain = 1.0 - weights.loss(after) / max(weights.loss(before), 1e-300)
    return Improvement(math.sqrt(max(total - free, 0.0)), math.sqrt(max(stable - free, 0.0)), gain)


def measure_evidence(noise: Noise, before: Floats, after: Floats) -> Floats:
    """Chi-square by which the second model is better, by ten-second stretch, shape (b,)."""
    old, new = noise.whiten_residual(before), noise.whiten_residual(after)
    # A model far from the truth has larger innovations than the noise: they are the scale then.
    spread = np.maximum(1.4826 * np.median(np.abs(new), axis=0), 1.0)
    old, new = old / spread, new / spread
    rows = (_cost(old) - _cost(new)).sum(axis=1)
    unit = np.unique(noise.tiles.unit, return_inverse=True)[1]
    by_stretch = np.bincount(unit, rows)
    moved = np.clip(old, -_CLIP, _CLIP) - np.clip(new, -_CLIP, _CLIP)
    score = (moved * np.clip(new, -_CLIP, _CLIP)).sum(axis=1)
    clusters = _add_clusters(score)
    inflation = max(float(clusters @ clusters) / max(float((moved**2).sum()), 1e-300), 1.0)
    evidence: Floats = by_stretch / inflation
    return evidence


def grow_evidence(part: Part, noise: Noise, before: Floats, after: Floats) -> tuple[Floats, Floats]:
    """How the t of `compare` grows with driving, at the ends of ten-second stretches.

    Returns:
        Seconds of windows until the end of each stretch, and t by then; both of shape (b,).
    """
    units = np.unique(noise.tiles.unit)
    ends = np.searchsorted(part.unit, units, side="right") - 1
    seconds = np.cumsum(count_seconds(part))[ends]
    total = np.cumsum(measure_evidence(noise, before, after))
    return seconds, np.sqrt(np.maximum(total, 0.0))


def _cost(values: Floats) -> Floats:
    """Huber's loss of innovations."""
    size = np.abs(values)
    held = np.minimum(size, _CLIP)
    return np.asarray(held * (2.0 * size - held), dtype=np.float64)


def compare_rivals(noise: Noise, one: Floats, other: Floats) -> float:
    """By how many standard errors the second of two rival models, neither a case of the other, is better.

    Source: Vuong, Econometrica 57 (1989).

    Args:
        noise: of the residuals.
        one: residuals of the first model, shape (n, 3).
        other: of the second one.
    """
    old, new = noise.whiten_residual(one), noise.whiten_residual(other)
    rows = (_cost(old) - _cost(new)).sum(axis=1)
    spread = math.sqrt(float((_add_clusters(rows) ** 2).sum()))
    return float(rows.sum()) / spread if spread > 0.0 else 0.0


def _add_clusters(rows: Floats) -> Floats:
    """Sums over the windows of each two seconds."""
    whole = rows.size // _CLUSTER * _CLUSTER
    return np.append(rows[:whole].reshape(-1, _CLUSTER).sum(axis=1), rows[whole:])
