"""A sentence tells no number that its run leaves open: it would read as if it were measured."""

from __future__ import annotations

import math

import pytest

from pipeline.estimation.diagnosis import Value
from pipeline.estimation.estimates import restore_known
from pipeline.sources import find_preset

_UNITS = {"tau": "s", "reset": "1/s", "scrub": "rad/s", "windup": "rad/s", "effort": "rad/s^2", "drag": "1"}


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
    numbers = {"tau": 0.44, "reset": 0.338, "scrub": 1.05, "windup": 1.1, "effort": 5.0}
    motion, clause = put_in_words("turn_servo", numbers, ("tau", "reset", "scrub"))
    assert motion == "Turn servo: lag 0.44 s, friction 1.1 rad/s"
    assert clause == "answers turns 0.44 s late against friction"
    motion, _ = put_in_words("speed_servo", {"tau": 0.31, "drag": 0.04, "effort": 5.0}, ("tau", "drag"))
    assert motion == "Speed servo: lag 0.31 s, drag 0.04"


def test_what_is_determined_is_told_as_before() -> None:
    numbers = {"tau": 0.31, "drag": 0.04, "effort": 4.0}
    motion, _ = put_in_words("speed_servo", numbers, tuple(numbers))
    assert motion == "Speed servo: lag 0.31 s, limit 4 m/s^2, drag 0.04"


def test_without_any_number_the_name_remains() -> None:
    numbers = {"tau": 0.31, "drag": 0.04, "effort": 4.0}
    assert put_in_words("speed_servo", numbers, ()) == ("Speed servo", "shows speed servo")


@pytest.mark.parametrize("known", [(), ("tau",)])
def test_an_effect_of_one_number_tells_it(known: tuple[str, ...]) -> None:
    assert put_in_words("drive_lag", {"tau": 0.3}, known)[0] == "Drive lag: time constant 0.30 s"
