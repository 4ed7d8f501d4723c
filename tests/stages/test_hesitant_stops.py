"""A stop under commands that a driver hesitates with is one stop."""

from __future__ import annotations

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.stages.incidents import Rims, _find_stops

STEP_S = 0.05


def find(command: Floats, stopped: tuple[float, float]) -> list[tuple[float, float]]:
    """Stops of a vehicle that follows its commands but for some seconds."""
    times = np.arange(command.size) * STEP_S
    follows = np.where((times >= stopped[0]) & (times < stopped[1]), 0.0, command)
    zeros = np.zeros(command.size)
    three, moved = (np.stack((one, zeros, zeros), axis=1) for one in (command, follows))
    known = np.ones(command.size, dtype=bool)
    rims = Rims(times, command, three, known, 0.0 * three, follows, moved, follows, moved, 1.0)
    return [(start, end) for _, start, end in _find_stops(rims)]


def test_a_driver_who_hesitates_under_a_stop_does_not_hide_it() -> None:
    times = np.arange(0.0, 100.0, STEP_S)
    # Live for 1.5 s, then a dip of 0.4 s, again and again: never two seconds on end.
    command = np.where(times % 1.9 < 1.5, 0.5, 0.15)
    ((start, end),) = find(command, (50.0, 58.0))
    assert abs(start - 50.0) < 1.0
    assert abs(end - 58.0) < 1.0


def test_short_commands_with_long_pauses_do_not_add_up() -> None:
    times = np.arange(0.0, 100.0, STEP_S)
    command = np.where(times % 2.4 < 0.6, 0.5, 0.15)
    assert find(command, (50.0, 58.0)) == []
