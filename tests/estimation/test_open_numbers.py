"""A sentence tells no number that its run leaves open: it would read as if it were measured."""

from __future__ import annotations

import math

import pytest

from pipeline.estimation.diagnosis import Value
from pipeline.estimation.estimates import restore_known
from pipeline.sources import Vehicle, find_preset

_UNITS = {
    "tau": "s",
    "tau_mean": "s",
    "tau_diff": "s",
    "friction": "1",
    "creep": "1",
    "k": "1",
    "gyration": "1",
}


def find_vehicle() -> Vehicle:
    vehicle = find_preset("warthog")
    assert vehicle is not None
    return vehicle


def put_in_words(name: str, numbers: dict[str, float], known: tuple[str, ...]) -> tuple[str, str]:
    values = {
        key: Value(
            value, *((0.9 * value, 1.1 * value) if key in known else (math.nan, math.nan)), _UNITS[key]
        )
        for key, value in numbers.items()
    }
    effect, vehicle = restore_known(name, values), find_vehicle()
    return effect.describe_motion(vehicle), effect.describe_clause(vehicle)


def test_numbers_that_no_driving_determined_are_not_told() -> None:
    """The gentle run on grass said `limit 5 rad/s^2`, the value that the search starts from."""
    numbers = {"friction": 0.41, "creep": 0.2, "k": 1.69, "gyration": 1.0}
    motion, clause = put_in_words("contact_friction", numbers, ("k",))
    assert motion == "Contact friction: effective track 1.69 times nominal"
    assert clause == "shows signs of contact friction"
    assert "0.41" in put_in_words("contact_friction", numbers, ("friction",))[1]


def test_what_is_determined_is_told_as_before() -> None:
    numbers = {"tau_mean": 0.31, "tau_diff": 1.2}
    motion, _ = put_in_words("turn_lag", numbers, tuple(numbers))
    assert motion == "Turning lag: time constant 1.20 s for turning, 0.31 s for speed"


def test_without_any_number_the_name_remains() -> None:
    numbers = {"friction": 0.41, "creep": 0.2, "k": 1.69, "gyration": 1.0}
    assert put_in_words("contact_friction", numbers, ()) == (
        "Contact friction",
        "shows signs of contact friction",
    )


@pytest.mark.parametrize("known", [(), ("tau",)])
def test_an_effect_of_one_number_tells_it(known: tuple[str, ...]) -> None:
    assert put_in_words("drive_lag", {"tau": 0.3}, known)[0] == "Drive lag: time constant 0.30 s"


def test_a_sentence_has_the_digits_that_the_interval_supports() -> None:
    wide, narrow = (Value(0.4213, 0.4213 - half, 0.4213 + half, "s") for half in (0.26, 0.0018))
    said = [
        restore_known("clock_offset", {"d": one}).describe_clause(find_vehicle()) for one in (wide, narrow)
    ]
    assert said == ["the poses are stamped 420 ms late", "the poses are stamped 421 ms late"]
    assert [str(one) for one in (wide, narrow)] == ["0.42 s [0.16, 0.68]", "0.4213 s [0.4195, 0.4231]"]
    # Without an interval nothing is known of the digits, and one remains however wide it is.
    assert str(Value(0.4213, math.nan, math.nan, "s")).startswith("0.421 s")
    assert str(Value(-0.4213, -5.0, 5.0, "1")) == "-0.4 [-5.0, 5.0]"
