"""`slip fleet trend`: what moved over the runs of a vehicle."""

import json
import re
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import pytest
from comparison_store import Run, write_run
from verbs import print_verb

from pipeline.datasets.trend import Trend, follow_trend
from pipeline.report.trend_page import write_trend
from pipeline.store import Store
from pipeline.store.names import read_day

FIRST = date(2026, 4, 20)


def stamp_of(day: date) -> int:
    return int(datetime(day.year, day.month, day.day, 12, tzinfo=UTC).timestamp()) * 1_000_000_000


def drive_a_season(store: Store, tracks: list[float], *, median: float = 1.0) -> None:
    for i, track in enumerate(tracks):
        day = FIRST + timedelta(days=i)
        write_run(
            store,
            Run(
                # Names out of order: dates must come from the clock.
                name=f"run_{(7 * i) % len(tracks):02d}",
                dataset="warthog-2_gravel",
                vehicle="warthog-2",
                median=median,
                seconds=30.0,
                start_ns=stamp_of(day),
                findings=[("heading_skew", "warning", 0.1)],
                estimates=[("effective_track", "k", track, 0.004)],
            ),
        )


def follow(store: Store, **asked: object) -> Trend:
    options = {"by": ("vehicle",), "threshold": 0.1, "limits": {}, **asked}
    return follow_trend(store, **options)  # type: ignore[arg-type]


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path)


def test_a_track_that_moved_is_said_with_its_day_and_what_is_likely(store: Store) -> None:
    wobble = [0.01, -0.02, 0.015, -0.01, 0.02, -0.015, 0.0]
    tracks = [1.8 + wobble[i % 7] for i in range(13)] + [2.1 + wobble[i % 7] for i in range(6)]
    drive_a_season(store, tracks)
    found = follow(store)
    (alert,) = found.alerts
    assert alert.text == (
        "effective_track.k of warthog-2 1.8 -> 2.1 since 2026-05-03 (13 runs before, 6 since, p < 0.001): "
        "likely a change of tyre pressure or load, or other terrain"
    )
    quantities = {one.quantity for one in found.series}
    assert {"median_modulus (command)", "finding heading_skew", "warnings", "suspect share"} <= quantities
    page = write_trend(store, found).read_text(encoding="utf-8")
    assert "1.8 -&gt; 2.1 since 2026-05-03" in page
    titles = re.findall("<h3>([^<]+)</h3>", page)
    assert titles[:2] == ["Effective track (effective_track.k)", "Median slip modulus from commands [m/s]"]
    assert titles[-3:] == [
        "Value of the finding heading_skew",
        "Share of suspect samples",
        "Number of warnings",
    ]
    assert "Median norm of slip over 2 s from wheel encoders [m/s]" in titles


@pytest.mark.parametrize(
    ("table", "what"),
    [("estimates", "gone"), ("findings", "gone"), ("slip", "gone"), ("estimates", "damaged")],
)
def test_a_run_whose_table_is_gone_or_damaged_is_left_out_and_named(
    store: Store, table: str, what: str
) -> None:
    drive_a_season(store, [1.8, 1.81, 1.8, 1.81, 1.8])
    path = store.manifests()[0].path(table)
    path.unlink()
    if what == "damaged":
        path.write_bytes(b"no table")
    found = follow(store)
    assert "run_00" not in " ".join(found.keys)
    (note,) = [note for note in found.notes if "run_00" in note]
    said = {
        "gone": f"the file {table}.parquet of the results is gone; slip results verify --repair",
        "damaged": f"the table {table} cannot be read: it has changed since it was written; "
        "analyze the log again",
    }
    assert note.startswith(f"left out, {said[what]}")


def test_what_moves_with_a_parameter_is_told_with_it(store: Store) -> None:
    drive_a_season(store, [1.8, 1.81] * 5, median=1.0)
    for i in range(10, 20):
        write_run(
            store,
            Run(
                name=f"later_{i}", dataset="warthog-2_gravel", vehicle="warthog-2", median=3.0, seconds=30.0,
                start_ns=stamp_of(FIRST + timedelta(days=i)), findings=[("heading_skew", "warning", 0.3)],
                estimates=[("effective_track", "k", 2.0 + 0.01 * (i % 2), 0.004)],
            ),
        )  # fmt: skip
    found = follow(store)
    (alert,) = found.alerts
    assert alert.quantity == "effective_track.k"
    told = json.loads((write_trend(store, found).parent / "trend.json").read_text(encoding="utf-8"))
    kinds = {
        tuple(change) for part in ("series", "parameters") for one in told[part] for change in one["changes"]
    }
    (kind,) = kinds
    assert kind == ("since", "run", "before", "after", "runs_before", "runs_after", "p", "likely", "text")
    with_it = alert.text.split("; with it: ")[1]
    assert with_it.startswith("median slip modulus from commands of warthog-2 ")
    assert "finding heading_skew of warthog-2 0.1 -> 0.3" in with_it


def test_changes_not_worth_a_name_raise_no_alert(store: Store) -> None:
    drive_a_season(store, [1.8, 1.801] * 4 + [1.808, 1.807] * 4)
    found = follow(store)
    (track,) = found.parameters
    assert [change.after for change in track.changes] == pytest.approx([1.8075])
    assert not found.alerts


def test_the_exit_code_serves_a_nightly_job(store: Store) -> None:
    drive_a_season(store, [1.8, 1.8], median=1.0)
    for limit, code in (("median_modulus=9.0", 0), ("median_modulus=0.1", 4), ("nonsense", 1)):
        words = ("fleet", "trend", store.root, "--by", "vehicle", "--limit", limit, "--json")
        spoken = print_verb(*words, code=code)
        if code != 1:
            assert bool(json.loads(spoken)["alerts"]) == (code == 4)


@pytest.mark.long
@pytest.mark.parametrize("at_bound", [False, True])
def test_a_limit_holds_for_a_last_run_that_is_odd_or_at_a_bound(store: Store, *, at_bound: bool) -> None:
    wobble = [0.0, 0.004, -0.004, 0.002]
    drive_a_season(store, [0.3 + wobble[i % 4] for i in range(10)] + [0.6 + wobble[i % 4] for i in range(10)])
    write_run(
        store,
        Run(
            name="last", vehicle="warthog-2", seconds=30.0, start_ns=stamp_of(FIRST + timedelta(days=30)),
            estimates=[("effective_track", "k", 0.75, 0.004)], at_bound=at_bound,
        ),
    )  # fmt: skip
    found = follow(store, limits={"effective_track.k": 0.7})
    assert found.parameters[0].points["run"][-1] != "last"
    unsure = ", which does not determine it" if at_bound else ""
    text = f"effective_track.k of warthog-2 is 0.75 in last{unsure}, above the limit of 0.7"
    assert text in [alert.text for alert in found.alerts]


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
