"""A plan is checked on the log of its drive, and on no other."""

import numpy as np
import pytest

from pipeline.plan.plan_files import find_likeness


def draw_steps(seed: int, seconds: float) -> np.ndarray:
    """Random steps of three seconds: forward speed and yaw rate at 10 Hz, shape (n, 2)."""
    steps = np.random.default_rng(seed).uniform(-1.0, 1.0, (int(seconds / 3.0), 2))
    return np.repeat(steps, 30, axis=0)


@pytest.mark.parametrize("seed", range(5))
def test_a_plan_is_found_wherever_it_was_played(seed: int) -> None:
    asked, other = draw_steps(seed, 45.0), draw_steps(seed + 100, 600.0)
    noise = np.random.default_rng(seed).normal(0.0, 0.05, (len(asked), 2))
    assert find_likeness(asked, np.concatenate((other, asked + noise, np.zeros((50, 2))))) > 0.95
    assert find_likeness(asked, asked) == pytest.approx(1.0)
    # Stopped half-way, and then nothing.
    assert find_likeness(asked, np.concatenate((asked[: len(asked) // 2], np.zeros((300, 2))))) > 0.6
    assert find_likeness(asked, other) < 0.6
    assert find_likeness(asked, np.zeros((400, 2))) < 0.1
