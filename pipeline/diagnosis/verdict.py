"""Whether one model is better than another on data that neither has seen: blocked cross-validation.

Residuals of field data are autocorrelated, so that textbook tests name what is not there. Here the unit is a
stretch of ten seconds.
"""

import math
from dataclasses import dataclass
from functools import partial

import numpy as np

from pipeline.core.arrays import Floats, Ints
from pipeline.core.parallel import map_parallel
from pipeline.identification.growth import pick_points
from pipeline.identification.parts import Part, count_seconds
from pipeline.identification.weights import Weights

LEAST_GAIN = 0.01
LEAST_T = 2.2
_FEWEST_WINDOWS = 6
_FEWEST_ACTIVE = 2.5
# In shorter stretches neighbours are not quite independent: more is asked of them.
SHORT_S = 3.0
_SHORT_T = 3.5
_FAINT_Z = 1.5
_RARE_GAIN = 0.02
_RARE_Z = 3.0
_RARE_T = 1.5
LEAST_STRETCHES = 1.7
_LAGS = 8
_NO_NOISE = 1e-12


@dataclass(frozen=True)
class Verdict:
    """How much better a model is.

    Attributes:
        gain: share of the other's held-out loss that it takes away.
        z: the same against the noise that the better model leaves: for an effect that acts in two or three
            stretches only, but there beyond doubt.
        t: largest of three block t values: of the loss difference, of the log ratio of losses, and of the
            loss taken away in proportion to how far predictions moved.
    """

    gain: float
    t: float
    z: float

    @property
    def evidence(self) -> float:
        """Share of the evidence that is asked."""
        common = min(self.t / LEAST_T, self.z / _FAINT_Z)
        rare = min(self.t / _RARE_T, self.z / _RARE_Z) if self.gain >= _RARE_GAIN else 0.0
        return max(common, rare)

    def accepts(self, least_gain: float = LEAST_GAIN) -> bool:
        """Whether it is better beyond doubt."""
        return self.gain >= least_gain and self.evidence >= 1.0


def compare(part: Part, weights: Weights, before: Floats, after: Floats) -> Verdict:
    """Judge held-out residuals of two models under one weights."""
    old, new = weights.cost(before), weights.cost(after)
    gain = 1.0 - float(new.sum()) / max(float(old.sum()), 1e-12)
    moved = (((before - after) / weights.scale) ** 2).sum(axis=1)
    stretch = part.number_stretches(SHORT_S)
    # As if all channels were as noisy as the noisiest: thresholds of z are made for it.
    noise = float(measure_repeated(part, after / weights.scale).max())
    deviation = 2.0 * math.sqrt(noise * float(moved.sum()))
    z = _normal_t(_add_up(stretch, old - new), _add_up(stretch, moved), deviation)
    return Verdict(gain, _find_t(part.unit, stretch, old, new, moved), z)


def grow_t(part: Part, weights: Weights, before: Floats, after: Floats) -> tuple[Floats, Floats]:
    """How the t of `compare` grows, at the ends of stretches of three seconds, of sixty at most.

    Returns:
        Seconds of windows until the end of each stretch, and t by then; both of shape (k,).
    """
    old, new = weights.cost(before), weights.cost(after)
    moved = (((before - after) / weights.scale) ** 2).sum(axis=1)
    stretch = part.number_stretches(SHORT_S)
    ends = np.flatnonzero(np.diff(stretch, append=-1)) + 1
    ends = ends[pick_points(ends.size)]
    seconds = np.cumsum(count_seconds(part))[ends - 1]
    t = map_parallel(partial(_find_t_until, (part.unit, stretch, old, new, moved)), ends.tolist())
    return seconds, np.array(t)


def _find_t_until(known: tuple[Ints, Ints, Floats, Floats, Floats], end: int) -> float:
    unit, stretch, old, new, moved = known
    return _find_t(unit[:end], stretch[:end], old[:end], new[:end], moved[:end])


def _add_up(label: Ints, values: Floats) -> Floats:
    return np.asarray(np.bincount(label, values), dtype=np.float64)


def _find_t(unit: Ints, stretch: Ints, old: Floats, new: Floats, moved: Floats) -> float:
    """See `Verdict`; of costs by window."""
    count = np.bincount(unit)
    kept = count >= min(_FEWEST_WINDOWS, int(count.max()))
    sums_old, sums_new = _add_up(unit, old)[kept], _add_up(unit, new)[kept]
    difference = sums_old - sums_new
    ratio = np.log(np.maximum(sums_old, 1e-9) / np.maximum(sums_new, 1e-9))
    action = _add_up(unit, moved)[kept]
    short = _ratio_t(_add_up(stretch, old - new), _add_up(stretch, moved)) * LEAST_T / _SHORT_T
    return max(_block_t(difference), _block_t(ratio), _ratio_t(difference, action), short)


def _ratio_t(difference: Floats, action: Floats) -> float:
    """Evidence where an effect acts in few stretches: is the loss taken away where predictions moved?

    If the effect is real the loss falls in each stretch in proportion to how far it moved the prediction
    there; the spread about that proportion, with each stretch's own leverage taken out, is the noise.
    """
    total = float(action.sum())
    if total <= 0.0:
        return 0.0
    leverage = action / total
    if 1.0 / float(np.sum(leverage**2)) < _FEWEST_ACTIVE:
        return 0.0
    slope = float(difference.sum()) / total
    rest = (difference - slope * action) / (1.0 - leverage)
    spread = float(np.sqrt(np.sum(rest**2)))
    return float(difference.sum()) / spread if spread > 0.0 else 0.0


def _normal_t(difference: Floats, action: Floats, deviation: float) -> float:
    """Loss taken away over its deviation if the better model's residuals were all the noise there is."""
    total = float(action.sum())
    if total <= 0.0 or total**2 / float(np.sum(action**2)) < LEAST_STRETCHES:
        return 0.0
    return float(difference.sum()) / deviation


def measure_repeated(part: Part, rest: Floats) -> Floats:
    """Variance of weighted residuals times how often neighbours repeat them, by channel, shape (3,).

    The variance of a sum of such residuals is that of its terms' squares times these.
    """
    repeated = np.full(rest.shape[1], _NO_NOISE)
    for channel in part.channels:
        clipped = np.clip(rest[part.live, channel], -3.0, 3.0)
        repeated[channel] = float(np.mean(clipped**2))
        for lag in range(1, _LAGS):
            repeated[channel] += 2.0 * max(float(np.mean(clipped[lag:] * clipped[:-lag])), 0.0)
    return repeated


def _block_t(values: Floats) -> float:
    if values.size < 3:  # noqa: PLR2004 - no spread to judge by
        return 0.0
    spread = float(np.std(values, ddof=1)) / np.sqrt(values.size)
    return float(values.mean()) / spread if spread > 0.0 else 0.0
