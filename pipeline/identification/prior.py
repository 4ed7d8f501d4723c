"""What is known of a model's numbers before a run is seen: observations of the numbers themselves.

A number with mean m and standard deviation s adds ((value - m) / s)^2 to the cost of a fit, as one more
observation (maximum a posteriori). Residuals repeat each other in time and are larger than noise, so that
they say less than their summed cost. The prior is weighed up by that `excess`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.identification.state import Free, State

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Prior:
    """Normal distributions of numbers that all runs share.

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
        values = np.array([state.get(number) for number in free])
        return float(np.sum(self.weigh(free) * (self.means(free, values) - values) ** 2))

    def pull(self, state: State, free: Sequence[Free]) -> Floats:
        """Half the fall of that cost with each number, shape (p,)."""
        values = np.array([state.get(number) for number in free])
        pull: Floats = self.weigh(free) * (self.means(free, values) - values)
        return pull

    def weigh(self, free: Sequence[Free]) -> Floats:
        """Information on each number, zero where nothing is known, shape (p,)."""
        known = [self._find(number) for number in free]
        return np.array([0.0 if one is None else self.excess / one[1] ** 2 for one in known])

    def means(self, free: Sequence[Free], values: Floats) -> Floats:
        """Means, the values themselves where nothing is known, shape (p,)."""
        known = [self._find(number) for number in free]
        return np.array([v if one is None else one[0] for one, v in zip(known, values.tolist(), strict=True)])

    def _find(self, number: Free) -> tuple[float, float] | None:
        return None if number.run is not None else self.numbers.get(number.label)


NO_PRIOR = Prior()
"""Nothing is known before."""
