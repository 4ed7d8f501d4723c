"""Spans of a series of blocks in which another hypothesis is likelier than the usual one."""

import numpy as np

from pipeline.core import Floats, find_runs

BLOCK_S = 0.5
"""Length of a block [s]: an end of a span is known to within one."""
LEVEL = 0.001
"""Probability that a run of normal driving has a span."""
LASTS_NATS = 0.1
"""Price of every block of a span [nats], so that it ends with the last block that shows it."""


def price_change(count: int) -> float:
    """Log-likelihood that a change of the hypothesis costs: any of so many blocks might have one."""
    return float(np.log(count / LEVEL))


def follow_likeliest(gains: Floats, price: float, ends: float | None = None) -> list[tuple[int, slice]]:
    """Likeliest spans of other hypotheses, with their numbers (Viterbi).

    Args:
        gains: log-likelihood of other hypotheses less that of the usual one, shape (m, k).
        price: of a change [nats]; see `price_change`.
        ends: price of the change back to the usual one, if it is another.
    """
    gains = np.column_stack((np.zeros(len(gains)), gains - LASTS_NATS))
    change = price * (1.0 - np.eye(gains.shape[1]))
    change[1:, 0] = price if ends is None else ends
    # A recording may begin and end at any time.
    score, origin = np.zeros(gains.shape[1]), np.zeros(gains.shape, dtype=np.int64)
    for k, gain in enumerate(gains):
        routes = score[:, None] - change
        origin[k] = routes.argmax(axis=0)
        score = routes.max(axis=0) + gain
    states = np.zeros(len(gains), dtype=np.int64)
    state = int(score.argmax())
    for k in range(len(gains) - 1, -1, -1):
        states[k], state = state, int(origin[k, state])
    return [
        (which - 1, slice(*one)) for which in range(1, gains.shape[1]) for one in find_runs(states == which)
    ]
