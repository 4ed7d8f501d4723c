"""What is known of a model's numbers before a run is seen: observations of the numbers themselves.

p numbers, each z standard deviations from its mean, add (f + p) log(1 + sum z^2 / f) to the cost of a fit,
as one more observation (maximum a posteriori): that of a multivariate t distribution with few degrees of
freedom f (Lange, Little and Taylor, JASA 84, 1989). Where the run contradicts what was known of one number,
all of them are held less: a run with an effect that no other run had is unlike them in several. Residuals
repeat each other in time and are larger than noise, so that they say less than their summed cost. The prior
is weighed up by that `excess`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.identification.state import Free, State

# Degrees of freedom: what was known is forgotten where a run lies several deviations off.
_FREEDOM = 4.0


@dataclass(frozen=True)
class Prior:
    """Distributions of numbers that all runs share.

    Attributes:
        numbers: mean and standard deviation by label ``effect.name``, deviations positive.
        excess: cost of residuals that says as much as a cost of one would if they were independent and no
            larger than noise.
    """

    numbers: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    excess: float = 1.0

    def cost(self, state: State, free: Sequence[Free]) -> float:
        """Cost of a state's free numbers, on the scale of the summed cost of residuals."""
        if not self.numbers:
            return 0.0
        away, known = self._compare(state, free)
        count = np.count_nonzero(known)
        return self.excess * (_FREEDOM + count) * float(np.log1p(known @ away**2 / _FREEDOM))

    def weigh(self, state: State, free: Sequence[Free]) -> Floats:
        """Information on each of all free numbers, zero where nothing is known, shape (p,)."""
        away, known = self._compare(state, free)
        held = (_FREEDOM + np.count_nonzero(known)) / (_FREEDOM + known @ away**2)
        return self.excess * held * known

    def pull(self, state: State, free: Sequence[Free]) -> Floats:
        """Half the fall of the cost with each of all free numbers, shape (p,)."""
        return self.weigh(state, free) * self._compare(state, free)[0]

    def _compare(self, state: State, free: Sequence[Free]) -> tuple[Floats, Floats]:
        """Way from each number to its mean, and one over its variance; zeros where nothing is known."""
        pairs = [self._find(number) for number in free]
        away = [0.0 if one is None else one[0] - state.get(n) for one, n in zip(pairs, free, strict=True)]
        known = [0.0 if one is None else 1.0 / one[1] ** 2 for one in pairs]
        return np.array(away), np.array(known)

    def _find(self, number: Free) -> tuple[float, float] | None:
        return None if number.run is not None else self.numbers.get(number.label)


NO_PRIOR = Prior()
"""Nothing is known before."""
