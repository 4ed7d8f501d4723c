"""What a run asks of its drive, in which its sentences speak."""

import numpy as np
import pytest
from motion_runs import simulate, vehicle_of

from pipeline.estimation.largest import measure_asked
from pipeline.simulate.scenario import Commands

HUSKY = vehicle_of("husky_a200")


@pytest.mark.parametrize(
    ("speed", "turn", "expected"),
    [
        (0.8, 0.5, (0.8, 0.0)),  # turns while it drives
        (0.0, 1.1, (0.0, 1.1)),
    ],
    ids=["curves", "on the spot"],
)
def test_only_what_is_driven_for_two_seconds_is_asked(
    speed: float, turn: float, expected: tuple[float, float]
) -> None:
    times = np.arange(0.0, 40.0, 0.05)
    moves = (times > 4.0) & (times < 36.0)
    # A spike of a second is no motion that the drive was to make.
    spike = np.where((times > 20.0) & (times < 21.0), 2.0, 1.0)
    run = simulate({}, duration_s=40.0, played=Commands(times, speed * moves * spike, turn * moves * spike))
    asked = measure_asked([run], HUSKY)
    assert (asked.speed_mps, asked.turn_radps) == pytest.approx(expected, abs=1e-6)
