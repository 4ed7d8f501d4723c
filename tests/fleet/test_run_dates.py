"""Dates of runs where names and clocks contradict each other."""

from __future__ import annotations

import pytest

from pipeline.fleet import read_day
from pipeline.job.compared_runs import date_runs

PLACEHOLDER = 1_700_000_000_000_000_000
HOUR = 3_600_000_000_000


def test_a_start_that_a_name_contradicts_dates_no_other_run() -> None:
    found = date_runs({"ice_2024_7_30": PLACEHOLDER, "gravel": PLACEHOLDER, "tile": PLACEHOLDER + 1})
    assert found.days == {"ice_2024_7_30": "2024-07-30", "gravel": None, "tile": "2023-11-14"}
    assert found.notes == (
        (
            "the clocks of 2 runs start at the very same instant of 2023-11-14, which names contradict: "
            "the dates in the names of 1 count; the others have no date"
        ),
    )


def test_dates_in_names_count_and_the_clock_that_contradicts_is_said() -> None:
    found = date_runs(
        {"a_2024_7_30": PLACEHOLDER, "b_2024_8_1": PLACEHOLDER + HOUR, "c": PLACEHOLDER + 9 * HOUR}
    )
    assert found.days == {"a_2024_7_30": "2024-07-30", "b_2024_8_1": "2024-08-01", "c": "2023-11-15"}
    assert found.notes == (
        (
            "the date in the name counts, and not that of the clock, "
            "of a_2024_7_30 (2023-11-14), b_2024_8_1 (2023-11-14)"
        ),
    )


@pytest.mark.parametrize("name", ["night_2023_11_13", "night_2023_11_14", "night_2023_11_15"])
def test_a_local_date_is_no_contradiction(name: str) -> None:
    found = date_runs({name: PLACEHOLDER, "other": None})
    assert found.days == {name: read_day(name), "other": None}
    assert not found.notes


def test_runs_of_one_instant_are_ordered_by_name_and_that_is_said() -> None:
    found = date_runs({"b": PLACEHOLDER, "a": PLACEHOLDER, "c": PLACEHOLDER + HOUR, "unset": 0, "unset_2": 0})
    assert found.days == {
        "b": "2023-11-14",
        "a": "2023-11-14",
        "c": "2023-11-14",
        "unset": None,
        "unset_2": None,
    }
    assert found.notes == (
        (
            "2 runs start at the very same instant, 2023-11-14 22:13:20 UTC, "
            "and are in the order of their names: a, b"
        ),
    )
