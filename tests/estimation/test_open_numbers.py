"""A sentence tells no number that its run leaves open: it would read as if it were measured."""

from __future__ import annotations

import math

import pytest

from pipeline.estimation.diagnosis import Value
from pipeline.estimation.estimates import restore_known
from pipeline.sources import find_preset

_UNITS = {"tau": "s", "reset": "1/s", "drag": "m/s", "bound": "m/s", "scrub": "m/s", "creep": "s/m"}
_UNITS |= {"tau_mean": "s", "tau_diff": "s"}


def put_in_words(name: str, numbers: dict[str, float], known: tuple[str, ...]) -> tuple[str, str]:
    values = {
        key: Value(
            value, *((0.9 * value, 1.1 * value) if key in known else (math.nan, math.nan)), _UNITS[key]
        )
        for key, value in numbers.items()
    }
    vehicle = find_preset("warthog")
    assert vehicle is not None
    effect = restore_known(name, values)
    return effect.describe_motion(vehicle), effect.describe_clause(vehicle)


def test_numbers_that_no_driving_determined_are_not_told() -> None:
    """The gentle run on grass said `limit 5 rad/s^2`, the value that the search starts from."""
    numbers = {"tau": 0.17, "reset": 0.338, "drag": 0.08, "bound": 1.3, "scrub": 1.05, "creep": 0.07}
    motion, clause = put_in_words("wheel_servo", numbers, ("tau", "reset", "scrub"))
    assert motion == "Wheel servo: lag 0.17 s, reset 0.34/s, scrub 1.1 m/s"
    assert clause == "answers commands against a friction of 1.1 m/s"


def test_what_is_determined_is_told_as_before() -> None:
    numbers = {"tau_mean": 0.31, "tau_diff": 1.2}
    motion, _ = put_in_words("turn_lag", numbers, tuple(numbers))
    assert motion == "Turning lag: time constant 1.20 s for turning, 0.31 s for speed"


def test_without_any_number_the_name_remains() -> None:
    numbers = {"tau": 0.17, "reset": 0.338, "drag": 0.08, "bound": 1.3, "scrub": 1.05, "creep": 0.07}
    assert put_in_words("wheel_servo", numbers, ()) == ("Wheel servo", "shows wheel servo")


@pytest.mark.parametrize("known", [(), ("tau",)])
def test_an_effect_of_one_number_tells_it(known: tuple[str, ...]) -> None:
    assert put_in_words("drive_lag", {"tau": 0.3}, known)[0] == "Drive lag: time constant 0.30 s"
