"""Dates of runs where names and clocks contradict each other."""

from pathlib import Path

import pytest
from comparison_store import Run, write_run

from pipeline.datasets.compared_runs import find_material
from pipeline.report import format_date, render_catalogue
from pipeline.store import Store
from pipeline.store.names import date_runs, read_day

PLACEHOLDER = 1_700_000_000_000_000_000
HOUR = 3_600_000_000_000


def test_a_start_that_a_name_contradicts_dates_no_other_run() -> None:
    found = date_runs({"ice_2024_7_30": PLACEHOLDER, "gravel": PLACEHOLDER, "tile": PLACEHOLDER + 1})
    assert found.days == {"ice_2024_7_30": "2024-07-30", "gravel": None, "tile": "2023-11-14"}
    assert found.notes == (
        (
            "the clocks of 2 runs start at the same instant of 2023-11-14, which names contradict: "
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


@pytest.mark.parametrize(
    ("name", "day"),
    [
        ("warthog_2024_8_7_11h30s30", "2024-08-07"),
        ("2026-05-03_gravel", "2026-05-03"),
        ("run_2024_13_40", None),
        ("run_2024_2_31", None),
        ("run_7", None),
    ],
)
def test_dates_in_names_are_read(name: str, day: str | None) -> None:
    assert read_day(name) == day


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
            "2 runs start at the same instant, 2023-11-14 22:13:20 UTC, "
            "and are in the order of their names: a, b"
        ),
    )


def test_the_table_of_runs_the_list_of_runs_and_a_report_have_the_dates_of_the_trend(tmp_path: Path) -> None:
    store = Store(tmp_path)
    for name in ("ice_2024_7_30", "gravel"):
        write_run(store, Run(name=name, start_ns=PLACEHOLDER))
    days = {"gravel": None, "ice_2024_7_30": "2024-07-30"}
    rows = store.query("SELECT run, day FROM runs ORDER BY run")
    assert dict(rows.iter_rows()) == days
    page = render_catalogue(store)
    assert "2024-07-30" in page
    assert "2023-11-14" not in page
    assert store.scan("runs", asked={"day": "2024-07"}).collect()["run"].to_list() == ["ice_2024_7_30"]
    assert store.scan("runs", asked={"day": "2023-11"}).collect().is_empty()
    # A question about one vehicle gives a run the date that it has among all.
    write_run(store, Run(name="moss", vehicle="jackal", start_ns=PLACEHOLDER))
    jackal = {"vehicle": "jackal"}
    assert store.query("SELECT run, day FROM runs", jackal).rows() == [("moss", None)]
    # So does a comparison that leaves the run out whose name contradicts the clock.
    write_run(
        store,
        Run(name="moss", vehicle="jackal", start_ns=PLACEHOLDER, estimates=[("drive_lag", "tau", 0.3, 0.01)]),
    )
    compared = find_material(store, ["vehicle"], trusted_only=False, tables=("estimates",))
    assert compared.labels.select("run", "day").rows() == [("moss", None)]
    assert format_date("ice_2024_7_30", PLACEHOLDER) == "2024-07-30"
    assert format_date("ice_2023_11_15", PLACEHOLDER + 60 * 10**9) == "2023-11-14 22:14 UTC"
    assert format_date("ice", PLACEHOLDER) == "", "no clock of a robot starts at a round epoch"
