"""A value and its interval as text: the digits are those that the interval supports."""

from hypothesis import given
from hypothesis import strategies as st

from pipeline.core import format_interval, split_interval


def test_digits_follow_the_interval() -> None:
    for value, low, high, unit, text in [
        (14.4012, 14.3782, 14.4242, "rad/s", "14.401 rad/s [14.378, 14.424]"),
        (1.30028, 1.2994, 1.3011, "1", "1.3003 [1.2994, 1.3011]"),
        (0.24412, 0.2311, 0.2571, "s", "0.244 s [0.231, 0.257]"),
        (0.3, 0.292, 0.308, "s", "0.300 s [0.292, 0.308]"),
        (0.4, 0.01, 1.23, "1", "0.4 [0.0, 1.2]"),
        (1512.0, 1100.0, 1900.0, "N", "1512 N [1100, 1900]"),
        (0.0, -0.02, 0.02, "m", "0.000 m [-0.020, 0.020]"),
        (2.0, 2.0, 2.0, "1", "2 [2, 2]"),
        (0.45, 0.444, 0.455, None, "0.450 [0.444, 0.455]"),
    ]:
        assert format_interval(value, low, high, unit) == text


@given(
    value=st.floats(-1e4, 1e4),
    half=st.floats(1e-5, 1e4),
    uneven=st.floats(0.1, 1.0),
    is_above=st.booleans(),
)
def test_the_ends_differ_from_the_value_as_printed(
    value: float, half: float, uneven: float, *, is_above: bool
) -> None:
    below, above = (half, uneven * half) if is_above else (uneven * half, half)
    text, low, high = split_interval(value, value - below, value + above)
    assert float(low) < float(text) < float(high)
    # What is printed is what it was, up to a unit of the last digit, which is no more than the narrower half.
    for shown, exact in ((text, value), (low, value - below), (high, value + above)):
        assert abs(float(shown) - exact) <= 0.51 * uneven * half + 1e-9


def test_a_value_that_is_rounding_has_no_more_digits_than_its_interval() -> None:
    assert split_interval(-4e-16, -32.53, 48.2) == ("0", "-33", "48")
