"""Numbers in words: shares in percent, the same everywhere."""

import math
import re
from pathlib import Path

import pytest

from pipeline.core import format_duration, format_part, format_share, format_two

PIPELINE = Path(__file__).parents[2] / "pipeline"


def test_a_share_is_percent_with_a_space() -> None:
    for share, digits, text in [
        (0.56, 2, "56 %"),
        (0.6, 3, "60 %"),
        (0.986, 3, "98.6 %"),
        (0.0862, 2, "8.6 %"),
        (0.005, 2, "0.5 %"),
        (0.0, 2, "0 %"),
        (1.0, 2, "100 %"),
        (12.3, 2, "1230 %"),
        (-0.3, 2, "-30 %"),
        (-0.0004, 0, "0 %"),
        (0.0006, 0, "0 %"),
        (0.505, 0, "50 %"),
        (math.inf, 2, "inf %"),
    ]:
        assert format_share(share, digits) == text


def test_a_part_of_a_whole_is_never_zero_unless_it_is() -> None:
    parts = {0.56: "56 %", 0.004: "0.4 %", -0.02: "-2 %", 3e-6: "< 0.1 %", -1e-4: "< 0.1 %", 0.0: "0 %"}
    assert {part: format_part(part) for part in parts} == parts


def test_a_number_of_two_digits_has_two_after_rounding() -> None:
    for value, text in [
        (0.0, "0.0"),
        (0.5, "0.50"),
        (2.0, "2.0"),
        (9.94, "9.9"),
        (9.96, "10"),
        (-0.0996, "-0.10"),
        (99.6, "100"),
        (1234.0, "1234"),
        (0.00012, "0.00012"),
        (4.8e-10, "4.8e-10"),
        (math.nan, "nan"),
        (-math.inf, "-inf"),
    ]:
        assert format_two(value) == text


@pytest.mark.lint
def test_no_module_writes_percent_by_itself() -> None:
    """`{share:.0%}` has no space before the sign."""
    found = [
        f"{path.relative_to(PIPELINE)}: {spec}"
        for path in sorted(PIPELINE.rglob("*.py"))
        for spec in re.findall(r":[-+z0-9.]*%\}", path.read_text(encoding="utf-8"))
    ]
    assert found == []


def test_a_duration_is_said_alike_before_and_after_it_was_stored() -> None:
    assert {format_duration(seconds) for seconds in (451 * 0.05, 22.549999999998718, 22.55)} == {"22.6 s"}
